"""Files that appear whole or not at all, and how much may be decoded of one."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from lae_sim.errors import LaeError
from lae_sim.files import Budget, TooLargeError, allowing, max_decoded, parse_size, written_whole


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    with written_whole(target) as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path  # so that the rename stays on one file system
        assert not target.exists()
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.skipif(os.name == "nt", reason="Windows cannot replace an open file")
def test_an_old_file_stands_until_then(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    with target.open() as reader:
        with written_whole(target) as temporary:
            temporary.write_text("new")
            assert target.read_text() == "old"
        assert target.read_text() == "new"
        assert reader.read() == "old"  # whoever has it open keeps the whole old file


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, GeneratorExit])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")

    def fail_halfway() -> None:
        with written_whole(target) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail_halfway()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_relative_path_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with written_whole("out.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "out.txt").read_text() == "new"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_the_file_has_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "usual").write_text("")
    with written_whole(tmp_path / "ours") as temporary:
        temporary.write_text("")
    modes = {stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert len(modes) == 1


def test_a_killed_writer_leaves_the_old_file(tmp_path: Path, repository: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    program = """if True:
        import os, sys
        from lae_sim.files import written_whole
        with written_whole(sys.argv[1]) as temporary:
            temporary.write_text("half")
            os._exit(9)
    """
    command = [sys.executable, "-c", program, str(target)]
    assert subprocess.run(command, cwd=repository, check=False).returncode == 9
    assert target.read_text() == "old"


@pytest.mark.parametrize("name", ["no/such/folder/out.txt", "x" * 300])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    with (
        pytest.raises(LaeError, match=r"cannot write .*(out.txt|xxx)"),
        written_whole(tmp_path / name),
    ):
        pytest.fail("there is nothing to write to")


def test_a_folder_in_the_place_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with (
        pytest.raises(LaeError, match="cannot write"),
        written_whole(tmp_path / "out") as temporary,
    ):
        temporary.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


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
