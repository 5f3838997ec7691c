"""The learned forecaster: its formulas against an independent witness, its symmetries, its file."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import random_learned, random_network
from places import TRACES
from walks import lanes_and_queries, one_lane, streaming

import lae_sim
from lae_sim.errors import LaeError
from lae_sim.forecast.base import Lanes, forecast
from lae_sim.forecast.guard import Guarded
from lae_sim.forecast.learned import (
    INPUTS,
    OUTPUTS,
    SHIPPED,
    Learned,
    Past,
    read_learned,
    rows_of,
    shipped,
    write_learned,
)
from lae_sim.forecast.network import Network
from lae_sim.learning.trainers import NetworkTrainer

LEARNED = random_learned()
CASES = lanes_and_queries(jumps=0.02, least=10.0)


def with_boxes(lanes: Lanes, boxes: np.ndarray) -> Lanes:
    return replace(lanes, boxes=boxes)


def with_times(lanes: Lanes, frame: np.ndarray, seed: int) -> tuple[Lanes, np.ndarray]:
    """The same in a world whose frames arrive unevenly."""
    late = np.random.default_rng(seed).uniform(0, 0.9, 10_000)
    late[0] = 0
    times = lanes.frames + late[lanes.frames]
    return replace(lanes, frames=times, numbers=lanes.frames), frame + late[frame]


# ------------------------------------------------------- an independent witness, in whole numbers


def half_even(value: float | Fraction) -> int:
    return round(value)


class Witness:
    """One sequence, in plain Python: ints where numbers are whole, else floats one by one."""

    def __init__(self, learned: Learned, box: list[float]) -> None:
        self.layers = [
            ([[int(each) for each in row] for row in weight.tolist()], list(map(int, bias)))
            for weight, bias in zip(learned.network.weights, learned.network.biases)
        ]
        self.frames: list[float] = [0]
        self.boxes = [box]

    def update(self, frame: float, box: list[float]) -> None:
        self.frames.append(frame)
        self.boxes.append(box)

    def place(self, k: int) -> tuple[float, float, float, float, float]:
        x, y, w, h = self.boxes[k]
        wide, high = max(w, 1.0), max(h, 1.0)
        return x + w / 2, y + h / 2, wide, high, math.sqrt(wide * high)

    def velocity(self, k: int) -> list[int]:
        """Of output k, in 2**-20: zeros of output 0."""
        if k == 0:
            return [0, 0, 0, 0]
        interval = float(self.frames[k] - self.frames[k - 1])
        (x0, y0, w0, h0, _), (x, y, w, h, size) = self.place(k - 1), self.place(k)
        moves = [(x - x0) / size, (y - y0) / size]
        moves += [2 * (w - w0) / (w + w0), 2 * (h - h0) / (h + h0)]
        return [half_even(min(max(move / interval, -8.0), 8.0) * 2**20) for move in moves]

    def seen(self, k: int) -> list[int]:
        """Six numbers of output k."""
        if k == 0:
            return [0] * 6
        interval = float(self.frames[k] - self.frames[k - 1])
        steep = [20.0 * (each / 2**20) for each in self.velocity(k)]
        bent = [half_even(each / math.sqrt(1.0 + abs(each)) * 4096) for each in steep]
        return [*bent, half_even(interval / (interval + 4.0) * 4096), 4096]

    def answers(self, inputs: list[int]) -> list[int]:
        for number, (weight, bias) in enumerate(self.layers):
            if number:
                inputs = [min(max(value, 0), 2**20) for value in inputs]
            sums = list(bias)
            for value, row in zip(inputs, weight):
                sums = [a + value * b for a, b in zip(sums, row)]
            inputs = [half_even(Fraction(value, 4096)) for value in sums]
        return [min(max(value, -(2**20)), 2**20) for value in inputs]

    def predict(self, frame: float) -> list[float]:
        now = len(self.boxes) - 1
        ahead = float(frame - self.frames[now])
        if ahead <= 0 or now == 0:
            return list(self.boxes[now])
        last = [max(now - j, 0) for j in range(8)]
        opening = [k if k <= now else 0 for k in (1, 2, 3)]
        motion = [self.velocity(k) for k in last]
        ways = [sum(Fraction(v[a], 2**j) for j, v in enumerate(motion)) for a in (0, 1)]
        signs = [(way > 0) - (way < 0) for way in ways]
        inputs = []
        for k in (*last, *opening):
            row = self.seen(k)
            inputs += [row[0] * signs[0], row[1] * signs[1], *row[2:]]
        x, y, w, h, size = self.place(now)
        parts = size / (size + 50.0), w / (w + h), float(now) / (now + 8.0)
        inputs += [half_even(part * 4096) for part in parts]
        answers = self.answers(inputs)
        near, far = ahead / (ahead + 2.0), ahead / (ahead + 8.0)
        change = []
        for a in range(4):
            rates = []
            for r in range(3):
                weights = answers[(r + 3 * (a >= 2)) * 8 :][:8]
                mixed = sum(Fraction(c * v[a], 2**32) for c, v in zip(weights, motion))
                more = Fraction(answers[48 + 4 * r + a], 4096 * 16)
                rates.append(float(mixed + more * (signs[a] if a < 2 else 1)))
            offset = float(Fraction(answers[60 + a], 4096 * 8) * (signs[a] if a < 2 else 1))
            change.append((rates[0] + rates[1] * near + rates[2] * far) * ahead + offset)
        dw, dh = (min(max(each, -1.0), 1.0) for each in change[2:])
        wide, high = w * (2 + dw) / (2 - dw), h * (2 + dh) / (2 - dh)
        return [x + change[0] * size - wide / 2, y + change[1] * size - high / 2, wide, high]


@given(case=lanes_and_queries(), seed=st.integers(0, 3), timed=st.booleans())
@settings(max_examples=25)
def test_an_independent_witness_gives_the_same_bits(case: Any, seed: int, timed: bool) -> None:
    lanes, item, frame = case
    learned = random_learned(seed, hidden=8)
    if timed:
        lanes, frame = with_times(lanes, frame, seed)
    if len(item) > 12:  # the witness is slow
        item, frame = item[:: len(item) // 12], frame[:: len(item) // 12]
    expected = forecast(
        lambda box, size: Witness(learned, list(box)),
        replace(lanes, numbers=None),
        item,
        frame,
    )
    found = forecast(learned, lanes, item, frame)
    assert found.tobytes() == expected.tobytes()


def test_values_that_were_computed_once() -> None:
    """Where they differ, every file that was written means something else than it did."""
    shapes = [(INPUTS, 8), (8, OUTPUTS)]
    network = Network.rounded(
        [(np.arange(n * m).reshape(n, m) * 7919 % 2001 - 1000) / 4096 for n, m in shapes],
        [(np.arange(m) * 104_729 % 1001 - 500) / 4096 for _, m in shapes],
        {},
    )
    boxes = 20 + np.arange(48).reshape(12, 4) ** 2 * 7919 % 31 / 4
    lanes = one_lane(boxes, np.arange(12) * 2)
    found = forecast(Learned(network), lanes, np.array([1, 5, 11]), np.array([3, 17, 30]))
    assert network.digest == "1eca796dc3119f4dedbdf6560d56f51cfbc2e3808fde97e90dec4fdcea218c2f"
    assert found.tolist() == [
        [21.71399175324997, 22.490642874771794, 21.606286723077304, 21.075530173201972],
        [36.9739782331291, 14.301081379242003, 28.23893947512455, 49.713805259297494],
        [36.79754331723779, 16.35304593335632, 30.01146040713429, 46.729991336375846],
    ]


# ------------------------------------------------------------------------ one, many, in any company


@given(case=CASES, timed=st.booleans(), seed=st.integers(0, 9))
@settings(max_examples=40)
def test_it_streams_as_it_answers_for_lanes_to_the_last_bit(
    case: Any, timed: bool, seed: int
) -> None:
    lanes, item, frame = case
    learned = random_learned(seed)
    if timed:
        lanes, frame = with_times(lanes, frame, seed)
    number = lanes.numbers[item] if lanes.numbers is not None else None
    found = forecast(learned, lanes, item, frame, number=number)
    assert found.tobytes() == streaming(learned, lanes, item, frame).tobytes()


@pytest.mark.parametrize("count", [1, 2, 7, 64, 333])
@pytest.mark.parametrize("part", [1 << 12, 100, 1])
def test_answers_are_the_same_bits_for_any_number_of_lanes(
    count: int, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if count * 20 // part > 1000:
        part *= 64
    monkeypatch.setattr("lae_sim.forecast.learned._PART", part)
    rng = np.random.default_rng(5)
    length = 20
    boxes = np.cumsum(rng.normal(0, 3, (count, length, 4)), axis=1) + [300, 200, 60, 40]
    frames = np.tile(np.arange(length) * 2, count)
    offsets = np.arange(count + 1) * length
    lanes = Lanes(offsets, frames, boxes.reshape(-1, 4), np.full((count, 2), np.inf))
    item = np.arange(count * length)
    found = forecast(LEARNED, lanes, item, frames + 3).reshape(count, length, 4)
    for k in {0, count // 2, count - 1}:
        one, _, _ = lanes.chosen(np.arange(count) == k, item)
        alone = np.arange(length)
        assert forecast(LEARNED, one, alone, one.frames + 3).tobytes() == found[k].tobytes()
        if k == 0:
            streamed = streaming(LEARNED, one, alone, one.frames + 3)
            assert streamed.tobytes() == found[k].tobytes()


WANDERING = """
import numpy as np
from lae_sim.forecast.base import Lanes, forecast
from lae_sim.forecast.learned import shipped

rng, length = np.random.default_rng(6), 30
boxes = np.cumsum(rng.normal(0, 3, (40, length, 4)), axis=1) + [300, 200, 60, 40]
frames, item = np.tile(np.arange(length) * 2, 40), np.arange(40 * length)
lanes = Lanes(np.arange(41) * length, frames, boxes.reshape(-1, 4), np.full((40, 2), np.inf))
print(forecast(shipped(), lanes, item, frames + 3).tobytes().hex())
"""


def computed_with(kernel: str, threads: int) -> str:
    """Forecasts by a process whose BLAS has a processor's kernel and so many threads."""
    settings = {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": str(threads)}
    command = [sys.executable, "-c", WANDERING]
    return subprocess.check_output(command, env={**os.environ, **settings}, text=True)


def test_answers_are_the_same_bits_on_other_processors() -> None:
    """OpenBLAS has kernels for each, which add up in other orders: floats in general differ."""
    found = computed_with("Nehalem", threads=1)
    assert len(found) > 1000
    assert found == computed_with("Haswell", threads=3)


class Kept:
    """Stands for a network, and keeps what it is shown."""

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        self.inputs = inputs.copy()
        return np.zeros((OUTPUTS, inputs.shape[1]))


@given(case=CASES)
@settings(max_examples=30)
def test_what_is_seen_in_training_is_what_is_seen_in_forecasts(case: Any) -> None:
    """Windows are gathered for the one, and slices for the other."""
    lanes, item, frame = case
    network: Any = Kept()
    forecast(Learned(network), lanes, item, frame)
    past = Past.of(lanes)
    window = past.window(np.arange(len(lanes.frames)))
    expected = rows_of(past.velocity, past.interval)[:, window.T].swapaxes(0, 1)
    seen = network.inputs[:-3].reshape(expected.shape)
    np.testing.assert_array_equal(seen[:, 2:], expected[:, 2:])  # all but x and y, mirrored here


# -------------------------------------------------------------------------------------- symmetries


def exact(lanes: Lanes) -> Lanes:
    """Boxes in quarters of a pixel: mirroring and moving them rounds nothing."""
    return with_boxes(lanes, np.round(lanes.boxes * 4) / 4)


@given(case=CASES)
@settings(max_examples=30)
def test_a_mirrored_world_is_answered_by_mirrored_boxes(case: Any) -> None:
    lanes, *queries = case
    lanes = exact(lanes)
    found = forecast(LEARNED, lanes, *queries)
    for axis in (0, 1):
        mirrored = lanes.boxes.copy()
        mirrored[:, axis] = 640 - mirrored[:, axis] - mirrored[:, 2 + axis]
        answer = forecast(LEARNED, with_boxes(lanes, mirrored), *queries)
        answer[:, axis] = 640 - answer[:, axis] - answer[:, 2 + axis]
        np.testing.assert_allclose(answer, found, rtol=1e-12, atol=1e-9)


def test_a_target_at_rest_goes_neither_way() -> None:
    lanes = one_lane([[300, 200, 40, 30]] * 9, range(0, 18, 2))
    x, y, w, h = forecast(LEARNED, lanes, np.array([8]), np.array([30]))[0]
    assert [x + w / 2, y + h / 2] == pytest.approx([320, 215], abs=1e-9)
    lanes.boxes[:, 1] += np.arange(9)  # down alone
    x, y, w, h = forecast(LEARNED, lanes, np.array([8]), np.array([30]))[0]
    assert x + w / 2 == pytest.approx(320, abs=1e-9)
    assert abs(y + h / 2 - 223) > 0.1


@given(case=CASES)
@settings(max_examples=30)
def test_where_the_world_begins_does_not_matter(case: Any) -> None:
    lanes, *queries = case
    lanes, shift = exact(lanes), np.array([100, -50, 0, 0])
    answer = forecast(LEARNED, with_boxes(lanes, lanes.boxes + shift), *queries) - shift
    np.testing.assert_allclose(answer, forecast(LEARNED, lanes, *queries), rtol=1e-12, atol=1e-9)


def test_only_the_last_outputs_and_the_first_matter() -> None:
    rng = np.random.default_rng(0)
    boxes = np.cumsum(rng.normal(0, 3, (20, 4)), axis=0) + [300, 200, 60, 40]
    now, frame = np.array([19]), np.array([45])
    frames = np.arange(20) * 2

    def answer(changed: int) -> bytes:
        other = boxes.copy()
        other[changed] += 5
        return forecast(LEARNED, one_lane(other, frames), now, frame).tobytes()

    found = forecast(LEARNED, one_lane(boxes, frames), now, frame).tobytes()
    seen = [k for k in range(20) if answer(k) != found]
    assert seen == [0, 1, 2, 3, *range(11, 20)]


# --------------------------------------------------------------------------------------- odd boxes


@pytest.mark.parametrize("first", [[3.3, 4.1, 0.7, 0.1], [0.1, 0.2, 30, 20], [-5, 7, 0, 0]])
def test_without_an_output_after_the_first_the_box_stands(first: list[float]) -> None:
    lanes = one_lane([first, [3.25, 4, 0, 0.5]], [0, 1])
    item, frame = np.array([0, 0, 1]), np.array([0, 500, 1])
    for answers in (forecast(LEARNED, lanes, item, frame), streaming(LEARNED, lanes, item, frame)):
        assert answers.tolist() == lanes.boxes[item].tolist()


@pytest.mark.parametrize("size", [1e3, 1e6, 1e12, 1e100])
def test_odd_boxes_and_long_horizons_are_answered(size: float) -> None:
    boxes = [
        [0, 0, 10, 10], [size, -size, 0, 3], [5, 5, size, 1e-3], [6, 6, 20, 20], [6, 6, -4, 20],
        [1e-300, 0, 1e-300, 5e-324], [0, 0, size, size], [size, size, size, 1],
    ]  # fmt: skip
    lanes = one_lane(boxes, [0, 1, 2, 2000, 2001, 2002, 10**9, 10**9 + 1])
    item = np.repeat(np.arange(len(boxes)), 3)
    frame = lanes.frames[item] + np.tile([1, 10**6, 2**52], len(boxes))
    found = forecast(LEARNED, lanes, item, frame)
    assert np.isfinite(found).all()
    assert (found[3:, 2:][lanes.frames[item[3:]] < frame[3:]] > 0).all()
    assert found.tobytes() == streaming(LEARNED, lanes, item, frame).tobytes()


# --------------------------------------------------------------------------------------- its file


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_learned(LEARNED, tmp_path / "f.npz")
    found = read_learned(tmp_path / "f.npz")
    assert found.document == LEARNED.document == {"sequences": ["s0", "s1"], "seed": 0}
    assert found.network.digest == LEARNED.network.digest
    lanes = one_lane(np.cumsum(np.ones((9, 4)), axis=0) + 20, np.arange(9))
    queries = np.arange(9), np.arange(9) + 4
    assert (
        forecast(found, lanes, *queries).tobytes() == forecast(LEARNED, lanes, *queries).tobytes()
    )


@pytest.mark.parametrize("sequences", [None, [1], 3, "abc", {"a": 1}, [["a"]]])
def test_a_file_that_names_no_sequences_is_refused(sequences: Any, tmp_path: Path) -> None:
    network = random_network([INPUTS, 4, OUTPUTS], document={"sequences": sequences})
    write_learned(Learned(network), tmp_path / "f.npz")
    with pytest.raises(LaeError, match=r"f\.npz: not a forecaster that lae-sim train wrote: no na"):
        read_learned(tmp_path / "f.npz")


def test_a_network_of_another_shape_is_refused(tmp_path: Path) -> None:
    write_learned(Learned(random_network([INPUTS, 4, OUTPUTS - 1])), tmp_path / "f.npz")
    with pytest.raises(LaeError, match=r"not a forecaster that lae-sim train wrote: .answers 63"):
        read_learned(tmp_path / "f.npz")
    with pytest.raises(LaeError, match=r"none\.npz: no such file"):
        read_learned(tmp_path / "none.npz")


def test_notes_tell_the_weights_and_what_was_seen() -> None:
    digest = f"weights {LEARNED.network.digest[:16]}"
    assert LEARNED.notes(["s2"]) == [digest]
    assert LEARNED.notes(["s1", "x"]) == [digest, "trained on 1 of these 2 sequences"]
    assert random_learned(1).notes([]) != [digest]


# --------------------------------------------------------------------------------- what is shipped


def test_the_shipped_weights_are_small_and_of_no_real_sequence() -> None:
    assert os.path.getsize(SHIPPED) < 300_000
    found = shipped()
    assert isinstance(found, Guarded)
    assert isinstance(found.base, Learned)
    assert found.base.document.get("sequences") == []
    assert found.base.document["made_up"] > 0
    assert json.dumps(dict(found.base.document))
    assert found.notes(["car-chase"]) == [f"weights {found.base.network.digest[:16]}"]


def test_the_shipped_forecaster_needs_no_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    trace = TRACES / "synthetic-slow.parquet"
    result = lae_sim.evaluate(trace, forecasters=["hold", "learned"])
    auc = dict(zip(*(result.to_frame()[name] for name in ("forecaster", "auc"))))
    assert auc["learned"] > auc["hold"] + 0.02
    with pytest.raises(LaeError, match=r"training needs torch: pip install 'lae-sim\[torch\]'"):
        NetworkTrainer().fit(None)  # type: ignore[arg-type]


@given(case=lanes_and_queries(), timed=st.booleans())
@settings(max_examples=20)
def test_the_shipped_forecaster_streams_as_it_answers_for_lanes(case: Any, timed: bool) -> None:
    lanes, item, frame = case
    if timed:
        lanes, frame = with_times(lanes, frame, 0)
    found = forecast(shipped(), lanes, item, frame)
    assert np.isfinite(found).all()
    assert found.tobytes() == streaming(shipped(), lanes, item, frame).tobytes()
