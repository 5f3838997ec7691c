"""How much memory what is in a file may take."""

from __future__ import annotations

from pathlib import Path

import pytest

from lae_sim.decoding import (
    Budget,
    TooLargeError,
    allowing,
    max_decoded,
    parse_size,
    read_bytes,
)
from lae_sim.errors import LaeError


@pytest.mark.parametrize(
    ("size", "count"),
    [("256MiB", 256 << 20), ("1GiB", 1 << 30), ("2 kB".upper(), 2048), ("7", 7), (7, 7)],
)
def test_sizes(size: str | int, count: int) -> None:
    assert parse_size(size) == count


@pytest.mark.parametrize("size", ["0", "-1", "1.5GiB", "much", "1XB", "", 0, -1, None, 1.0, True])
def test_what_is_no_size(size: object) -> None:
    with pytest.raises(LaeError, match="is no size in memory: write it as 256MiB or 1GiB"):
        parse_size(size)  # type: ignore[arg-type]


def left(_: object) -> int:
    return Budget("a file").left


def test_a_budget_is_that_of_the_block() -> None:
    assert left(None) == 256 << 20
    with max_decoded("1MiB"):
        budget = Budget("a.mat")
        budget.take(1 << 20)
        with pytest.raises(TooLargeError, match=r"a\.mat: would take more than 1 MiB of memory"):
            budget.take(1)
        elsewhere = allowing(left)
        with max_decoded("2GiB"):
            assert left(None) == 2 << 30
        assert left(None) == 1 << 20
    assert left(None) == 256 << 20
    assert elsewhere(None) == 1 << 20  # as in another process


def test_a_file_is_read_within_its_budget(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"12345678")
    with max_decoded(8):
        assert read_bytes(path, Budget(path)) == b"12345678"
    with max_decoded(7), pytest.raises(TooLargeError, match=r"a\.bin: would take more than"):
        read_bytes(path, Budget(path))
    with pytest.raises(LaeError, match="none: no such file"):
        read_bytes(tmp_path / "none", Budget(path))
    with pytest.raises(LaeError, match="a folder, not a file"):
        read_bytes(tmp_path, Budget(path))
