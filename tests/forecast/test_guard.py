"""The guard: hold answers where the base has lately been worse, and only there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import random_learned
from walks import lanes_and_queries, one_lane, streaming
from witness import moving

from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import answers, evaluate_runs
from lae_sim.forecast.base import ConstantVelocity, Hold, Lanes, Oracle, forecast
from lae_sim.forecast.camera import Camera, CameraCompensated
from lae_sim.forecast.filters import GH
from lae_sim.forecast.guard import Guarded, guarded
from lae_sim.forecast.kalman import Kalman
from lae_sim.forecast.window import LeastSquares, Windowed
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.latency import constant
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording


@dataclass
class Off:
    """Holds, but is off by so much in x, y of the centre, w and h, as of some outputs."""

    by: tuple[float, float, float, float]
    begin: int = 0
    end: int = 10**9

    def __call__(self, box: Any, image_size: Any = None) -> Any:
        return _Off(self, box)


class _Off:
    def __init__(self, off: Off, box: Any) -> None:
        self.off, self.box, self.outputs = off, box, 0

    def update(self, frame: float, box: Any) -> None:
        self.box, self.outputs = box, self.outputs + 1

    def predict(self, frame: float) -> list[float]:
        x, y, w, h = self.box
        if self.off.begin <= self.outputs < self.off.end:
            dx, dy, dw, dh = self.off.by
            return [x + dx - dw / 2, y + dy - dh / 2, w + dw, h + dh]
        return [x, y, w, h]


def centred(boxes: Any) -> np.ndarray:
    """x and y of the centre, w, h."""
    boxes = np.array(boxes, float)
    return np.concatenate([boxes[..., :2] + boxes[..., 2:] / 2, boxes[..., 2:]], axis=-1)


def asked(factory: Any, lanes: Lanes, ahead: int = 3) -> np.ndarray:
    """Forecasts as of every item."""
    item = np.arange(len(lanes.frames))
    return forecast(factory, lanes, item, lanes.frames[item] + ahead)


def still(length: int = 12) -> Lanes:
    return one_lane([[100, 80, 40, 40]] * length, range(length))


def straight(length: int = 30) -> Lanes:
    """Constant motion and growth."""
    boxes = np.array([100.0, 80, 40, 40]) + np.arange(length)[:, None] * [5, 3, 4, 4.5]
    return one_lane(boxes, range(length))


# ----------------------------------------------------------------------------------- when it holds


def test_what_is_never_worse_is_not_touched() -> None:
    found = asked(guarded(ConstantVelocity), straight())
    assert found.tobytes() == asked(ConstantVelocity, straight()).tobytes()
    assert found.tobytes() != asked(Hold, straight()).tobytes()
    for lanes in (still(), straight()):
        assert asked(guarded(Hold), lanes).tobytes() == asked(Hold, lanes).tobytes()


@pytest.mark.parametrize("coordinate", range(4))
def test_hold_answers_in_the_coordinate_that_is_wrong(coordinate: int) -> None:
    lanes, wrong = still(), np.where(np.arange(4) == coordinate, 20.0, 0.0)
    base: Any = Off(tuple(wrong.tolist()))
    found, expected = centred(asked(guarded(base), lanes)), centred(asked(base, lanes))
    expected[2:, coordinate] = centred(lanes.boxes)[2:, coordinate]
    judged = [0, 1, *range(6, 12)]  # not before the second output; sides are believed for longer
    np.testing.assert_allclose(found[judged], expected[judged], rtol=0, atol=1e-12)


def test_only_the_wrong_coordinates_are_held() -> None:
    class Base(ConstantVelocity):
        def predict(self, frame: float) -> Any:  # type: ignore[override]
            x, y, w, h = super().predict(frame)  # type: ignore[arg-type]
            return [x + 20, y + 10, w, h - 20]  # the centre's y is right

    lanes = straight()
    base, found = centred(asked(Base, lanes)), centred(asked(guarded(Base), lanes))
    held = centred(lanes.boxes)
    np.testing.assert_allclose(found[9:, [0, 3]], held[9:, [0, 3]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[:, 1:3], base[:, 1:3], rtol=0, atol=1e-9)


def test_a_small_error_counts_for_nothing_and_one_jump_for_little() -> None:
    lanes = still()
    for by in ((0.05, 0.05, 0, 0), (0, 0, 1.5, 1.5)):
        base = Off(by)
        assert asked(guarded(base), lanes).tobytes() == asked(base, lanes).tobytes()
    # Errors count for one target size at most, so a far one is forgotten as soon as a near one.
    ends = []
    for far in (60.0, 1e9):
        base = Off((far, 0, 0, 0), begin=4, end=5)
        state = [_held_from(base, k) for k in range(60)]
        assert state[5]
        ends.append(state.index(False, 5))
    assert ends[0] == ends[1]


def _held_from(base: Off, output: int) -> bool:
    """Whether x is held as of an output of a target that stands still."""
    forecaster: Any = guarded(base)([100.0, 80.0, 40.0, 40.0], None)  # type: ignore[operator]
    for k in range(1, output + 1):
        forecaster.update(k, [100.0, 80.0, 40.0, 40.0])
    return bool(forecaster._held[0])


def test_it_is_believed_again_later_than_it_was_doubted() -> None:
    """Between the two thresholds the state stays as it is."""

    def x(errors: list[float]) -> list[bool]:
        """Whether x is held after each output of a target that moves by 4 pixels a frame."""
        held = []
        forecaster = Guarded(lambda box, size: base)([100.0, 80, 40, 40])
        for k, error in enumerate(errors, start=1):
            base.error = error
            forecaster.update(k, [100.0 + 4 * k, 80, 40, 40])
            held.append(abs(forecaster.predict(k + 1)[0] - (100 + 4 * k)) < 1e-9)
        return held

    class Moves:
        error = 0.0

        def __init__(self) -> None:
            self.k, self.box = 0, [100.0, 80, 40, 40]

        def update(self, frame: int, box: Any) -> None:
            self.k, self.box = frame, box

        def predict(self, frame: int) -> list[float]:
            return [self.box[0] + 4 * (frame - self.k) + self.error, *self.box[1:]]

    base: Any = Moves()
    assert not any(x([5.0] * 40))  # a quarter worse than hold: not believed
    base = Moves()
    found = x([8.0] * 20 + [5.0] * 80)
    assert found[1:] == [True] * (len(found) - 1)  # but neither is it forgotten
    base = Moves()
    found = x([8.0] * 20 + [2.0] * 80)
    assert found[-1] is False
    assert found[1] is True
    assert found[1:] == sorted(found[1:], reverse=True)  # it changes once


def test_nothing_later_than_an_output_tells_on_it() -> None:
    rng = np.random.default_rng(0)
    boxes = np.cumsum(rng.normal(0, 4, (40, 4)), axis=0) + [300, 200, 80, 60]
    whole = asked(guarded(Kalman), one_lane(boxes, range(40)))
    for length in (1, 2, 3, 17):
        part = asked(guarded(Kalman), one_lane(boxes[:length], range(length)))
        assert part.tobytes() == whole[:length].tobytes()


def test_the_truth_plays_no_part() -> None:
    """Recordings that differ in the truth have the same forecasts."""
    recording = moving(60, 3)
    truth = recording.truth.copy()
    truth[1:] = truth[1:, [1, 0, 3, 2]] * 1.5
    metadata = Metadata.new("30", "every-frame")
    runs = [
        replay_sequence(each, Clock.at(Fraction(30)), constant(ns=90_000_000))
        for each in (recording, replace(recording, truth=truth))
    ]
    for name, equal in (("guarded+kalman", True), ("learned", True), ("oracle", False)):
        one, other = (answers(run, metadata, name, load_forecaster(name)).boxes for run in runs)
        assert (one.tobytes() == other.tobytes()) is equal


# ------------------------------------------------------------------------- one and many, any base


BASES: dict[str, Any] = {
    "hold": Hold,
    "constant-velocity": ConstantVelocity,
    "kalman": Kalman,
    "least-squares": Windowed(LeastSquares()),
    "g-h": GH(),
    "learned": random_learned(),
    "off": Off((9.0, 0.0, 20.0, 0.0), 3, 6),
}


@pytest.mark.parametrize("name", BASES)
@given(case=lanes_and_queries(), timed=st.booleans())
@settings(max_examples=12)
def test_it_streams_as_it_answers_for_lanes(name: str, case: Any, timed: bool) -> None:
    lanes, item, frame = case
    if timed:
        late = np.random.default_rng(1).uniform(0, 0.9, 10_000)
        lanes = replace(lanes, frames=lanes.frames + late[lanes.frames] * (lanes.frames > 0))
        frame = frame + late[frame] * (frame > 0)
    factory: Any = guarded(BASES[name])
    found, expected = forecast(factory, lanes, item, frame), streaming(factory, lanes, item, frame)
    if name == "least-squares":  # its own lanes differ in the last bits
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    else:
        assert found.tobytes() == expected.tobytes()


def test_many_lanes_are_answered_as_each_alone() -> None:
    rng = np.random.default_rng(2)
    lengths = rng.integers(1, 30, 50)
    boxes = np.concatenate(
        [np.cumsum(rng.normal(0, 5, (n, 4)), axis=0) + [300, 200, 90, 80] for n in lengths]
    )
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    frames = np.concatenate([np.arange(n) * 2 for n in lengths])
    lanes = Lanes(offsets, frames, boxes, np.full((50, 2), np.inf))
    for base in (Kalman, random_learned()):
        whole = asked(guarded(base), lanes)
        assert whole.tobytes() != asked(base, lanes).tobytes()  # it does hold somewhere
        for k in (0, 7, 49):
            part, _, _ = lanes.chosen(np.arange(50) == k, np.arange(0))
            alone = asked(guarded(base), part)
            assert alone.tobytes() == whole[offsets[k] : offsets[k + 1]].tobytes()


def evaluated(recording: Recording, makers: dict[str, Any]) -> dict[str, float]:
    run = replay_sequence(recording, Clock.at(Fraction(30)), constant(ns=90_000_000))
    found = evaluate_runs([run], Metadata.new("30", "every-frame"), makers, [Fraction(0)])
    return dict(zip(makers, found.scores["auc"][:, 0, 0].tolist()))


@pytest.mark.parametrize("arrivals", [False, True])
def test_a_base_that_knows_the_sequence_is_guarded_too(arrivals: bool) -> None:
    """Also where frames arrive at times of their own, and the base looks up a frame's number."""
    recording = moving(60, 3)
    if arrivals:
        late = np.random.default_rng(0).integers(0, 20_000_000, 60)
        late[0] = 0
        times = np.arange(60) * 1_000_000_000 // 30 + late
        recording = replace(recording, arrival_ns=times)
    found = evaluated(recording, {"hold": Hold, "oracle": Oracle(), "guarded": guarded(Oracle())})
    assert found["oracle"] >= found["guarded"] > found["hold"]


def test_what_the_base_says_of_itself_is_passed_on() -> None:
    learned = random_learned()
    assert guarded(learned).notes(["s1"]) == learned.notes(["s1"])  # type: ignore[union-attr]
    camera = CameraCompensated(learned, Camera({}, Fraction(30)))
    over: Any = guarded(camera)
    assert over.sees_frames
    assert over.notes(["s1"]) == camera.notes(["s1"])
    assert guarded(Hold).notes(["s1"]) == []  # type: ignore[union-attr]
    assert not Guarded(Kalman).by_number
    assert Guarded(GH()).by_number  # box after box, since it may look frames up


def test_a_base_that_follows_the_size_of_images_is_told() -> None:
    told: list[Any] = []

    class Follows(Hold):
        def resize(self, image_size: Any) -> None:
            told.append(image_size)

    forecaster: Any = guarded(Follows)([0.0, 0.0, 9.0, 9.0], (64, 36))  # type: ignore[operator]
    forecaster.resize((32, 18))
    assert told == [(32, 18)]
    forecaster = guarded(Hold)([0.0, 0.0, 9.0, 9.0], (64, 36))  # type: ignore[operator]
    forecaster.resize((32, 18))  # which hold does not mind


def test_a_base_that_fails_is_reported() -> None:
    class Fails(Hold):
        def predict(self, frame: int) -> Any:
            raise ValueError("no idea")

    item = np.arange(3)
    with pytest.raises(LaeError, match="ValueError: no idea"):
        forecast(Guarded(Fails), still(3), item, item + 1, "mine")
