"""The learned forecaster: its file, its symmetries, and what happens without torch."""

from __future__ import annotations

import io
import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from places import TRACES
from walks import lanes_and_queries, one_lane

from lae_sim.errors import LaeError
from lae_sim.forecast.base import Lanes, forecast
from lae_sim.forecast.learned import FORMAT, read_learned, write_learned
from lae_sim.learning.registry import load_forecaster
from lae_sim.learning.trainers import NetworkTrainer


def with_boxes(lanes: Lanes, boxes: np.ndarray) -> Lanes:
    return Lanes(lanes.offsets, lanes.frames, boxes, lanes.image_sizes)


CASES = lanes_and_queries(jumps=0.02, least=10.0)


@given(case=CASES)
@settings(max_examples=20)
def test_a_mirrored_world_is_answered_by_mirrored_boxes(learned: Any, case: Any) -> None:
    lanes, *queries = case
    found = forecast(learned, lanes, *queries)
    for axis in (0, 1):
        mirrored = lanes.boxes.copy()
        mirrored[:, axis] = 640 - mirrored[:, axis] - mirrored[:, 2 + axis]
        answer = forecast(learned, with_boxes(lanes, mirrored), *queries)
        answer[:, axis] = 640 - answer[:, axis] - answer[:, 2 + axis]
        np.testing.assert_allclose(answer, found, rtol=0, atol=2e-3)


@given(case=CASES)
@settings(max_examples=20)
def test_where_the_world_begins_does_not_matter(learned: Any, case: Any) -> None:
    lanes, *queries = case
    shift = np.array([100, -50, 0, 0])
    answer = forecast(learned, with_boxes(lanes, lanes.boxes + shift), *queries) - shift
    np.testing.assert_allclose(answer, forecast(learned, lanes, *queries), rtol=0, atol=2e-3)


def test_without_an_output_after_the_first_the_box_stands(learned: Any) -> None:
    lanes = one_lane([[3.25, 4, 30, 20], [3.25, 4, 0, 0.5]], [0, 1])
    item, frame = np.array([0, 0, 1]), np.array([0, 500, 1])
    assert forecast(learned, lanes, item, frame).tolist() == lanes.boxes[item].tolist()


def test_odd_boxes_and_long_horizons_are_answered(learned: Any) -> None:
    boxes = [[0, 0, 10, 10], [1e6, -1e6, 0, 3], [5, 5, 1e5, 1e-3], [6, 6, 20, 20]]
    lanes = one_lane(boxes, [0, 1, 2, 2000])
    item = np.repeat(np.arange(4), 2)
    frame = lanes.frames[item] + np.tile([1, 10**6], 4)
    assert np.isfinite(forecast(learned, lanes, item, frame)).all()


# --------------------------------------------------------------------------------------- its file


@pytest.fixture(scope="module")
def stored(learned: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("learned") / "f.pt"
    write_learned(learned.rule, path)
    return path


def rewritten(torch: Any, stored: Path, **changes: Any) -> bytes:
    document = {**torch.load(stored, weights_only=True), **changes}
    found = io.BytesIO()
    torch.save({key: value for key, value in document.items() if value is not None}, found)
    return found.getvalue()


@given(case=CASES)
@settings(max_examples=10)
def test_what_is_written_is_read(learned: Any, stored: Path, case: Any) -> None:
    found = read_learned(stored)
    assert found.rule.document == learned.rule.document
    assert found.rule.trained_on == ["s0", "s1"]
    assert forecast(found, *case).tobytes() == forecast(learned, *case).tobytes()


def refused(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(LaeError, match=r"not a forecaster that lae-sim train wrote") as caught:
        read_learned(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert "weights_only" not in message  # torch advises to execute what is in the file


def test_a_truncated_file_is_refused(torch: Any, stored: Path, tmp_path: Path) -> None:
    whole = stored.read_bytes()
    for share in range(40):
        refused(tmp_path / "f.pt", whole[: len(whole) * share // 40])
    for short in (1, 2, 22, 100):
        refused(tmp_path / "f.pt", whole[:-short])


def test_a_damaged_file_is_refused_or_read(torch: Any, stored: Path, tmp_path: Path) -> None:
    whole, random = stored.read_bytes(), np.random.default_rng(0)
    path, errors = tmp_path / "f.pt", 0
    places = [*random.integers(0, len(whole), 60), *random.integers(0, 1500, 40)]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << random.integers(8)
        path.write_bytes(damaged)
        with suppress(LaeError):
            read_learned(path)
            continue
        errors += 1
    assert errors > 5


class Runs:
    """A pickle of this touches a file where it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def test_nothing_in_a_file_is_executed(torch: Any, stored: Path, tmp_path: Path) -> None:
    trap = tmp_path / "executed"
    refused(tmp_path / "f.pt", pickle.dumps(Runs(trap)))
    refused(
        tmp_path / "f.pt", pickle.dumps({"format": FORMAT, "version": 1, "network": Runs(trap)})
    )
    refused(tmp_path / "f.pt", rewritten(torch, stored, network=Runs(trap)))
    refused(tmp_path / "f.pt", rewritten(torch, stored, extra=Runs(trap)))
    assert not trap.exists()
    pickle.loads(pickle.dumps(Runs(trap)))
    assert trap.exists()  # the trap works


def test_a_file_of_something_else_is_refused(
    torch: Any, learned: Any, stored: Path, tmp_path: Path
) -> None:
    weights = learned.rule.network.state_dict()
    first = next(iter(weights))
    networks: list[Any] = [
        {**weights, first: weights[first][:, :-1]},
        {**weights, first: weights[first] * float("nan")},
        {**weights, first: weights[first] + float("inf")},
        {name: value for name, value in weights.items() if name != first},
        {**weights, "more": weights[first]},
        {**weights, first: [1.0]},
        [],
        None,
    ]
    path = tmp_path / "f.pt"
    for network in networks:
        refused(path, rewritten(torch, stored, network=network))
    for change in (
        {"format": "lae-trace"}, {"format": None}, {"version": 2}, {"version": "1"},
        {"sequences": None}, {"sequences": [1]}, {"sequences": 3}, {"sequences": "abc"},
    ):  # fmt: skip
        refused(path, rewritten(torch, stored, **change))
    for thing in ([], 3, "text", weights, weights[first]):
        found = io.BytesIO()
        torch.save(thing, found)
        refused(path, found.getvalue())
    for junk in (b"", b"PK", b"\x80\x02.", b"junk\n" * 99, b"PAR1" * 9, stored.read_bytes()[::-1]):
        refused(path, junk)
    refused(path, (TRACES / "synthetic-fast.parquet").read_bytes())


def test_a_path_that_is_no_file(torch: Any, learned: Any, tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"none\.pt: no such file"):
        read_learned(tmp_path / "none.pt")
    with pytest.raises(LaeError, match="not a forecaster"):
        read_learned(tmp_path)
    with pytest.raises(LaeError, match="cannot write"):
        write_learned(learned.rule, tmp_path / "none" / "f.pt")


def test_without_torch_it_is_said_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    for use in (
        lambda: read_learned(tmp_path / "f.pt"),
        lambda: load_forecaster("learned:f.pt"),
        lambda: NetworkTrainer().fit(None),  # type: ignore[arg-type]
    ):
        with pytest.raises(LaeError, match=r"needs torch: pip install 'lae-sim\[torch\]'"):
            use()
