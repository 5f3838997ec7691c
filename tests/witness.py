"""Independent models of DESIGN sections 2, 4, 5: slow, obvious, sharing no code with lae_sim.

``event_driven`` plays the whole world in SimPy: camera, tracker, forecasters and queries are
processes. ``schedule_latest``, ``psi`` and ``Scores`` are a plain oracle in fractions. The rest
builds inputs for the tests.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import simpy
from hypothesis import strategies as st

from lae_sim.replay.world import SIGMA_GRID
from lae_sim.trace.recording import Recording

with warnings.catch_warnings():
    # filterpy < 2 has unescaped backslashes in its docstrings
    warnings.filterwarnings("ignore", "invalid escape sequence", DeprecationWarning)
    warnings.filterwarnings("ignore", "invalid escape sequence", SyntaxWarning)
    from filterpy.kalman import KalmanFilter

SECOND = 10**9

Box = Sequence[float]


# ----------------------------------------------------------------- matrices of the paper's filter


class DenseKalman:
    """The paper's filter with its 8 x 8 matrices, written out."""

    def __init__(self, box: Box) -> None:
        self.restart(0, box)

    def restart(self, frame: int, box: Box) -> None:
        self.frame = frame
        self.state = np.concatenate([np.asarray(box, float), np.zeros(4)])
        self.covariance = 100.0 * np.eye(8)

    @staticmethod
    def transition(interval: float) -> np.ndarray:
        return np.block([[np.eye(4), interval * np.eye(4)], [np.zeros((4, 4)), np.eye(4)]])

    def update(self, frame: int, box: Box) -> None:
        interval = frame - self.frame
        f = self.transition(interval)
        self.state = f @ self.state
        self.covariance = f @ self.covariance @ f.T + interval**2 * np.eye(8)
        h = np.hstack([np.eye(4), np.zeros((4, 4))])
        s = h @ self.covariance @ h.T + 10.0 * np.eye(4)
        k = self.covariance @ h.T @ np.linalg.inv(s)
        self.state = self.state + k @ (np.asarray(box, float) - h @ self.state)
        self.covariance = (np.eye(8) - k @ h) @ self.covariance
        self.frame = frame

    def predict(self, frame: int) -> np.ndarray:
        return (self.transition(frame - self.frame) @ self.state)[:4]


class FilterpyKalman:
    """The paper's filter in filterpy."""

    def __init__(self, box: Box) -> None:
        self.filter = KalmanFilter(dim_x=8, dim_z=4)
        self.filter.x = np.concatenate([np.asarray(box, float), np.zeros(4)]).reshape(8, 1)
        self.filter.P = 100.0 * np.eye(8)
        self.filter.R = 10.0 * np.eye(4)
        self.filter.H = np.hstack([np.eye(4), np.zeros((4, 4))])
        self.frame = 0

    def update(self, frame: int, box: Box) -> None:
        interval = frame - self.frame
        self.filter.predict(F=DenseKalman.transition(interval), Q=interval**2 * np.eye(8))
        self.filter.update(np.asarray(box, float).reshape(4, 1))
        self.frame = frame

    def predict(self, frame: int) -> np.ndarray:
        return (DenseKalman.transition(frame - self.frame) @ self.filter.x)[:4, 0]


class DenseLaePvt(DenseKalman):
    """The released code's restart, clipping and fallback around the dense filter.

    ``hits`` counts how often each branch was taken, over all instances.
    """

    hits: dict[str, int]

    def __init__(self, box: Box, image_size: tuple[int, int] | None = None) -> None:
        super().__init__(box)
        self.raw = [float(v) for v in box]
        self.image_size = image_size

    def update(self, frame: int, box: Box) -> None:
        self.raw = [float(v) for v in box]
        if overlap(DenseKalman.predict(self, frame).tolist(), self.raw) < 0.3:
            self.hits["restart"] += 1
            self.restart(frame, box)
        else:
            self.hits["update"] += 1
            super().update(frame, box)

    def predict(self, frame: int) -> np.ndarray:
        x, y, w, h = super().predict(frame).tolist()
        positive = w > 0 and h > 0
        if self.image_size is not None:
            width, height = self.image_size
            x1, x2 = min(max(x, 0), width), min(max(x + w, 0), width)
            y1, y2 = min(max(y, 0), height), min(max(y + h, 0), height)
            clipped = [x1, y1, x2 - x1, y2 - y1]
            self.hits["clipped"] += max(abs(a - b) for a, b in zip(clipped, (x, y, w, h))) > 1e-6
            x, y, w, h = clipped
        if not positive:
            self.hits["not positive"] += 1
            return np.array(self.raw)
        if int(w) * int(h) < 75:
            self.hits["too small"] += 1
            return np.array(self.raw)
        return np.array([x, y, w, h])


def overlap(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """Intersection over union of two boxes, in the numbers they are made of."""
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    union = a[2] * a[3] + b[2] * b[3] - shared
    return shared / union if union > 0 else 0


# ------------------------------------------------------------------ the event-driven world in SimPy

CAMERA, TRACKER, QUERY = 1, 2, 4


@dataclass
class Told:
    """What the event-driven world said for one sigma: psi and the answers, per world frame."""

    psi: list[int]
    boxes: list[np.ndarray]


def event_driven(
    fps: Fraction,
    elapsed_ns: Sequence[int],
    boxes: Sequence[Box],
    sigmas: Sequence[Fraction],
    make: Callable[[Box], Any] = DenseKalman,
) -> tuple[list[tuple[int, int, int]], list[Told]]:
    """Play the world: processed (frame, start, ready) in ticks, and per sigma the answers.

    The clock counts 1/b of lae_sim's ticks, with b the common denominator of the sigmas. At equal
    instants the camera goes first, then the tracker, then the queries.
    """
    b = math.lcm(*(sigma.denominator for sigma in sigmas)) if sigmas else 1
    tick = fps.numerator * b  # per ns
    interval = fps.denominator * SECOND * b
    length = len(boxes)
    first_query = min([0, *(int(sigma * interval) for sigma in sigmas)])
    env = simpy.Environment(initial_time=first_query)
    processed: list[tuple[int, int, int]] = []
    outputs: list[int] = []
    world: dict[str, Any] = {"newest": -1, "over": False, "news": env.event()}

    def at(instant: int, priority: int) -> simpy.Event:
        event = simpy.Event(env)
        event._ok, event._value = True, None
        env.schedule(event, priority=priority, delay=instant - env.now)
        return event

    def announce() -> None:
        news, world["news"] = world["news"], env.event()
        news.succeed()

    def camera() -> Generator[simpy.Event, Any, None]:
        for i in range(length):
            yield at(i * interval, CAMERA)
            world["newest"] = i
            announce()
        yield at(length * interval, CAMERA)
        world["over"] = True
        announce()

    def tracker() -> Generator[simpy.Event, Any, None]:
        last = -1
        while True:
            while world["newest"] <= last and not world["over"]:
                yield world["news"]
            if world["over"]:
                return
            frame, start = world["newest"], env.now
            yield at(start + elapsed_ns[frame] * tick, TRACKER)
            processed.append((frame, start, env.now))
            outputs.append(frame)
            last = frame

    def forecaster(mailbox: simpy.Store, told: Told) -> Generator[simpy.Event, Any, None]:
        model, fed = make(boxes[0]), 0
        while True:
            world_frame, source = yield mailbox.get()
            if source != fed:
                model.update(source, boxes[source])
                fed = source
            told.psi.append(source)
            told.boxes.append(np.asarray(model.predict(world_frame), float))

    def queries(sigma: Fraction, mailbox: simpy.Store) -> Generator[simpy.Event, Any, None]:
        for i in range(length):
            instant = (i + sigma) * interval
            assert instant.denominator == 1
            yield at(int(instant), QUERY)
            mailbox.put((i, outputs[-1] if outputs else 0))

    env.process(camera())
    env.process(tracker())
    tellings = []
    for sigma in sigmas:
        mailbox, told = simpy.Store(env), Told([], [])
        tellings.append(told)
        env.process(forecaster(mailbox, told))
        env.process(queries(sigma, mailbox))
    env.run()
    return [(f, start // b, ready // b) for f, start, ready in processed], tellings


# ------------------------------------------------------------------------ the oracle in fractions


def schedule_latest(
    fps: Fraction, elapsed_ns: Sequence[int]
) -> list[tuple[int, Fraction, Fraction]]:
    """DESIGN 2.1-2.4: (frame, start, ready) in seconds."""
    length = len(elapsed_ns)
    ready = Fraction(elapsed_ns[0], SECOND)
    done = [(0, Fraction(0), ready)]
    while ready < length / fps:
        arrived = max(i for i in range(length) if i / fps <= ready)
        frame = arrived if arrived > done[-1][0] else arrived + 1
        if frame >= length:
            break
        start = max(ready, frame / fps)
        ready = start + Fraction(elapsed_ns[frame], SECOND)
        done.append((frame, start, ready))
    return done


def psi(
    done: Iterable[tuple[int, Fraction, Fraction]], fps: Fraction, length: int, sigma: Fraction
) -> list[int]:
    """DESIGN 2.5: the frame whose output answers each query."""
    done = list(done)
    return [
        max([0, *(frame for frame, _, ready in done if ready <= (i + sigma) / fps)])
        for i in range(length)
    ]


def follow(psis: Sequence[int], boxes: Sequence[Box], make: Callable[[Box], Any]) -> np.ndarray:
    """DESIGN 4: the post-forecaster's answer for each world frame."""
    model, fed, told = make(boxes[0]), 0, []
    for i, source in enumerate(psis):
        if source != fed:
            model.update(source, boxes[source])
            fed = source
        told.append(model.predict(i))
    return np.array(told, float)


def scores(
    truth: Sequence[Box | None],
    answers: Sequence[Box],
    convention: str,
    number: Any = Fraction,
    visible: Sequence[bool] | None = None,
) -> dict[str, Any]:
    """AUC and DP of one sequence by the table of DESIGN 5; None = the sequence leaves the mean."""
    steps = 100 if convention == "got10k-101" else 20
    leaves_out = convention in ("lasot", "got10k", "got10k-101", "exclude")
    passed = [0] * (steps + 1)
    near = [0] * 51
    counted = 0
    if all(box is None or min(box[2:]) <= 0 for box in truth[1:] or truth):
        return {"auc": None, "dp20": None}  # there is no more than the initial box
    before: Box = answers[0]
    for i, (true, answer) in enumerate(zip(truth, answers)):
        box = None if true is None else [number(v) for v in true]
        if convention == "otb" and not (all(map(math.isfinite, answer)) and min(answer[2:]) > 0):
            answer = before
        before = answer
        told = [number(v) for v in answer]
        if convention == "otb" and i == 0 and box is not None:
            told = box
        if box is None:
            valid = False
        elif convention in ("pysot", "exclude"):
            valid = box[2] > 0 and box[3] > 0
        elif convention in ("elae", "otb"):
            valid = min(box) > 0
        else:
            valid = True
        if convention == "lasot" and visible is not None and not visible[i]:
            valid = False
        counted += valid or not leaves_out or convention == "lasot"
        if not valid and leaves_out:
            continue
        if valid:
            iou = overlap(box, told)
            for k in range(steps + 1):
                passed[k] += iou > number(k) / steps
        if leaves_out or convention == "otb":
            ok = valid
        else:
            ok = box is not None and min(_centre(box)) > 0
        for pixels in range(51):
            if not ok:
                near[pixels] += 1
            else:
                (ax, ay), (bx, by) = _centre(box), _centre(told)
                near[pixels] += (ax - bx) ** 2 + (ay - by) ** 2 <= pixels**2
    if not counted:
        return {"auc": None, "dp20": None}
    auc = number(sum(passed)) / ((steps + 1) * counted)
    dp = number(near[20]) / counted
    if convention == "otb":
        return {"auc": auc if any(passed) else None, "dp20": dp if any(near) else None}
    return {"auc": auc, "dp20": dp}


def _centre(box: Sequence[Any]) -> tuple[Any, Any]:
    return box[0] + (box[2] - 1) / 2, box[1] + (box[3] - 1) / 2


# ------------------------------------------------------------------------------ inputs for tests

RATES = ("30", "25", "10", "50", "30000/1001", "29.97", "24000/1001")


@st.composite
def times(draw: st.DrawFn, fps: Fraction, length: int) -> list[int]:
    """Processing times that like to end exactly on, or 1 ns beside, an arrival or a query."""
    interval = SECOND / fps
    one = st.one_of(
        st.builds(
            lambda k, d: max(0, int(k * interval / 2) + d),
            st.integers(0, 9),
            st.sampled_from([0, 0, 0, 1, -1]),
        ),
        st.builds(
            lambda k, d: max(0, int(k * interval / 50) + d),
            st.integers(1, 149),
            st.sampled_from([0, 0, 0, 1, -1]),
        ),
        st.just(0),
        st.integers(int(interval) // 10, int(interval) * 4),
        st.builds(lambda k: int(k * interval), st.integers(10, 80)),
    )
    favourite = draw(one)
    return draw(st.lists(st.one_of(st.just(favourite), one), min_size=length, max_size=length))


@st.composite
def worlds(draw: st.DrawFn, longest: int = 30) -> tuple[Fraction, list[int], list[list[float]]]:
    """A frame rate, processing times, and boxes on a grid of quarter pixels."""
    fps = Fraction(draw(st.sampled_from(RATES)))
    length = draw(st.integers(1, longest))
    elapsed = draw(times(fps, length))
    steps = draw(st.lists(st.integers(-60, 60), min_size=4 * length, max_size=4 * length))
    drift = np.cumsum(np.array(steps).reshape(-1, 4), axis=0)
    boxes = np.array([400, 300, 200, 160]) + drift
    boxes[:, 2:] = np.maximum(boxes[:, 2:], 4)
    return fps, elapsed, (boxes / 4).tolist()


SIGMAS = st.one_of(
    st.just(list(SIGMA_GRID)),
    st.sets(
        st.one_of(
            st.builds(Fraction, st.integers(-60, 120), st.just(50)),
            st.builds(Fraction, st.integers(-4, 8), st.just(3)),
            st.builds(Fraction, st.integers(-4, 8), st.just(2)),
        ),
        min_size=1,
        max_size=5,
    ).map(sorted),
)


def moving(length: int, seed: int = 0, name: str = "a", elapsed: int = 47_000_000) -> Recording:
    """A recording of a target that walks about, with truth and scores on every frame."""
    random = np.random.default_rng(seed)
    steps = random.normal(0, [4, 4, 1, 1], (length, 4))
    truth = np.array([200.0, 150, 40, 30]) + np.cumsum(steps, axis=0)
    truth[:, 2:] = np.clip(truth[:, 2:], 20, 60)
    boxes = truth + random.normal(0, 0.7, (length, 4))
    jitter = random.integers(0, 9_000_000, length)
    return Recording.new(name, truth, boxes, elapsed + jitter, random.random(length))


def columns_of(recordings: Sequence[Recording]) -> dict[str, list[Any]]:
    """The columns of a trace as plain lists, None where null."""

    def column(values: Iterable[float]) -> list[float | None]:
        return [None if math.isnan(v) else v for v in values]

    def of(attribute: str, i: int) -> list[float | None]:
        return [v for r in recordings for v in column(getattr(r, attribute)[:, i].tolist())]

    return {
        "sequence": [r.name for r in recordings for _ in range(len(r))],
        "frame": [i for r in recordings for i in range(len(r))],
        **{name: of("truth", i) for i, name in enumerate(TRUTH)},
        **{name: of("boxes", i) for i, name in enumerate(BOX)},
        "elapsed_ns": [None if t < 0 else t for r in recordings for t in r.elapsed_ns.tolist()],
        "score": [v for r in recordings for v in column(r.score.tolist())],
    }


TRUTH = ("truth_x", "truth_y", "truth_w", "truth_h")
BOX = ("x", "y", "w", "h")
TYPES = {
    "sequence": pa.string(),
    "frame": pa.int32(),
    **dict.fromkeys(TRUTH + BOX, pa.float64()),
    "elapsed_ns": pa.int64(),
    "score": pa.float32(),
}
MINIMAL = {
    "format": "lae-trace",
    "version": "1.0",
    "fps": "30",
    "schedule": {"kind": "every-frame"},
}


def write_plain(
    path: Path,
    columns: dict[str, Any],
    metadata: Any = MINIMAL,
    types: dict[str, pa.DataType] | None = None,
    **options: Any,
) -> Path:
    """Write columns with plain pyarrow, as someone else would.

    ``metadata`` is the document, or its bytes, or None for none; ``types`` replaces column types.
    """
    kinds = {**TYPES, **(types or {})}
    arrays = {
        name: values if isinstance(values, pa.Array) else pa.array(values, kinds.get(name))
        for name, values in columns.items()
    }
    table = pa.table(arrays)
    if metadata is not None:
        text = metadata if isinstance(metadata, bytes) else json.dumps(metadata).encode()
        table = table.replace_schema_metadata({"lae_sim": text})
    pq.write_table(table, path, **options)
    return path


def same(a: Recording, b: Recording) -> bool:
    """Whether two recordings are equal bit for bit."""
    one, two = (
        {name: getattr(r, name) for name in ("truth", "boxes", "elapsed_ns", "score")} | r.columns
        for r in (a, b)
    )
    return (a.name, one.keys()) == (b.name, two.keys()) and all(
        values.dtype == two[name].dtype
        and values.shape == two[name].shape
        and values.tobytes() == two[name].tobytes()
        for name, values in one.items()
    )


def assert_same(found: Any, expected: list[Recording]) -> None:
    found = list(found)
    assert [r.name for r in found] == [r.name for r in expected]
    assert all(same(a, b) for a, b in zip(found, expected))
