"""The gap pass: which restarts are made, within what time, and what they leave."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import FakeTimed, bright_frame
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.boxes import search_side
from lae_sim.datasets.frames import Dataset, Image, ImageSequence
from lae_sim.engine.clock import parse_budget
from lae_sim.errors import LaeError
from lae_sim.profile.gaps import (
    FOLLOWED,
    OWN_GAPS,
    GapPlan,
    Gaps,
    Start,
    _ReadAhead,
    evenly,
    own_starts,
    sampled_starts,
)
from lae_sim.profile.journal import Journal
from lae_sim.profile.live import LiveRun
from lae_sim.profile.passes import Failure, Pass, run_pass, write_pass
from lae_sim.profile.run import ProfilePlan, run_profile
from lae_sim.profile.timed import Answer, TrackerError
from lae_sim.replay.reach import fit_reach, own_jumps, restarts_of
from lae_sim.trace.file import Trace, read_trace, validate
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.restarts import RestartName

SIDE = float(search_side(np.array([0.0, 0, 12, 10])))


def wandering(name: str, length: int = 200, seed: int = 0) -> ImageSequence:
    """A target that changes its velocity now and then, at whole pixels."""
    random = np.random.default_rng([seed, len(name), ord(name[0])])
    velocity = np.repeat(random.integers(-3, 4, (length // 10 + 1, 2)), 10, axis=0)[:length]
    path = 200 + np.cumsum(velocity, axis=0)
    truth = np.column_stack([path, np.tile([12, 10], (length, 1))]).astype(float)
    truth[:, :2] = np.clip(truth[:, :2], 0, 388)
    size = (400, 400)
    return ImageSequence(name, truth, lambda i: bright_frame(*truth[i, :2], size=size))


def dataset(*names: str) -> Dataset:
    return Dataset("wandering", Fraction(30), [wandering(name) for name in names])


class Reaching(FakeTimed):
    """Finds the bright target if it is nearer than a reach, which is drawn at initialisations."""

    def __init__(
        self,
        reaches: Sequence[float],
        init_s: float = 0.0,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        super().__init__()
        self._reaches, self._init_s, self.sleep, self.inits = reaches, init_s, sleep, 0

    def init(self, frame: Image, box: Sequence[float]) -> Answer:
        self.sleep(self._init_s)
        self._limit = self._reaches[self.inits % len(self._reaches)] * SIDE
        self.inits += 1
        return super().init(frame, box)

    def track(self, frame: Image, search: Sequence[float] | None = None) -> Answer:
        rows, columns = np.nonzero(frame[:, :, 0])
        x, y, w, h = self._seen
        there = float(columns.min()), float(rows.min())
        if max(abs(there[0] - x), abs(there[1] - y)) >= self._limit:
            return Answer(None, None, 1_000_000, 5)
        self._seen = (*there, w, h)
        return Answer(self._seen, 0.5, 1_000_000, 5)


def gap_pass(
    folder: Path, data: Dataset, tracker: FakeTimed, budget: str = "10m", half_side: Any = None
) -> tuple[Trace, list[str], list[Failure]]:
    """The trace of a gap pass, its notices and failures."""
    notices: list[str] = []
    options = {"tracker": tracker}
    gaps = Gaps(data, options, parse_budget(budget), half_side, notices.append)
    metadata = Metadata.new(
        "30",
        "restarts",
        device={"readings": {"before": {}}},
        timing={"clock": "made up", "source": "measured"},
    )
    task = Pass(
        "gaps",
        folder / "t.gaps.parquet",
        metadata,
        gaps.run,
        work=gaps.calls,
        ahead=False,
        prepare=gaps.prepare,
        schedule=gaps.schedule,
    )
    journal = Journal(folder / "t.unfinished", {}, resume=(folder / "t.unfinished").exists())
    task.prepare(journal)
    done: list[int] = []
    failures = run_pass(task, data, tracker, journal, 0, done.append)
    assert sum(done) == sum(map(gaps.calls, data.sequences))
    assert write_pass(task, journal, failures)
    validate(task.path)
    return read_trace(task.path), notices, failures


@pytest.mark.parametrize("centre", [0.55, 0.9])
def test_the_reach_of_a_tracker_is_measured(tmp_path: Path, centre: float) -> None:
    trace, notices, failures = gap_pass(tmp_path, dataset(*"abcd"), Reaching([centre]))
    assert (notices, failures) == ([], [])
    restarts = restarts_of(trace)
    assert all(each.found == (each.distance < centre) for each in restarts if each.start)
    reach = fit_reach(restarts)
    assert reach is not None
    assert reach.centre == pytest.approx(centre, abs=0.05)
    assert reach.spread < 0.03
    assert trace.metadata.document["schedule"] == {
        "kind": "restarts",
        "own_jumps": 4 * len(OWN_GAPS),
        "restarts": 1000,
        "budget": "600 s",
    }
    assert trace.metadata.document["version"] == "1.1"


def test_the_spread_of_a_reach_is_measured(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    reaches = random.logistic(0.7, 0.1, 5000)
    trace, _, _ = gap_pass(tmp_path, dataset(*"abcdef"), Reaching(reaches.tolist()))
    reach = fit_reach(restarts_of(trace))
    assert reach is not None
    assert abs(reach.centre - 0.7) < 4 * reach.centre_error
    assert abs(reach.spread - 0.1) < 4 * reach.spread_error


def test_own_jumps_are_followed(tmp_path: Path) -> None:
    trace, _, _ = gap_pass(tmp_path, dataset("a", "b"), Reaching([0.8]))
    jumps = own_jumps(trace)
    assert list(jumps) == ["a", "b"]
    for name, each in jumps.items():
        assert [jump.gap for jump in each] == list(OWN_GAPS)
        for jump in each:
            assert (jump.frames - jump.gap).tolist() == list(FOLLOWED)
            assert jump.truth.tolist() == wandering(name).truth[jump.frames].tolist()
    calls = sum(len(jump.frames) for jump in jumps["a"])
    assert calls == 63


def test_rows_are_those_of_the_sequence(tmp_path: Path) -> None:
    trace, _, _ = gap_pass(tmp_path, dataset("a b", "a"), Reaching([0.8]))
    names = [recording.name for recording in trace]
    assert names == sorted(names)
    recording = next(each for each in trace if "@0+" not in each.name)
    sequence, start, gap = RestartName.parse(recording.name)
    truth = wandering(sequence).truth[start : start + gap + 1]
    assert recording.truth.tolist() == truth.tolist()
    assert recording.boxes[0].tolist() == truth[0].tolist()
    assert np.flatnonzero(recording.elapsed_ns >= 0).tolist() == [0, gap]


def test_distances_are_spread_evenly_up_to_beyond_the_declared_region(tmp_path: Path) -> None:
    found = sampled_starts(dataset(*"abcd").sequences, 480, farthest=1.25)
    starts = [start for each in found.values() for start in each]
    truth = {name: wandering(name).truth for name in "abcd"}
    moved = [truth[s][i + k, :2] - truth[s][i, :2] for (s, i, k) in (each.name for each in starts)]
    distances = np.abs(moved).max(axis=1) / SIDE
    counts = np.histogram(distances, 12, (0, 1.25))[0]
    assert counts.tolist() == [40] * 12
    assert len(starts) == len({start.name for start in starts})
    assert all(start.name.start > 0 for start in starts)
    by_sequence = [len(each) for each in found.values()]
    assert max(by_sequence) - min(by_sequence) <= 12  # one a part
    assert found == sampled_starts(dataset(*"abcd").sequences, 480, farthest=1.25)
    assert max(np.abs(distances)) < 1.25


def test_fewer_restarts_where_there_are_no_more() -> None:
    short = ImageSequence("s", wandering("a").truth[:6], wandering("a").read)
    starts = sampled_starts([short], 1000, 1.25)["s"]
    assert 0 < len(starts) <= 4 + 3 + 2 + 1
    assert sampled_starts([short], 0, 1.25) == {"s": []}
    still = ImageSequence("s", np.tile([1.0, 2, 12, 10], (50, 1)), short.read)
    assert len(sampled_starts([still], 1000, 1.25)["s"]) > 100
    lost = np.full((50, 4), np.nan)
    lost[0] = [1, 2, 12, 10]
    unknown = ImageSequence("s", lost, short.read)
    assert sampled_starts([unknown], 1000, 1.25) == {"s": []}
    assert own_starts(unknown, OWN_GAPS) == []


def test_nothing_starts_from_or_jumps_to_frames_without_the_target(tmp_path: Path) -> None:
    visible = np.ones(200, np.bool_)
    visible[40:90] = False
    hidden = replace(wandering("a"), visible=visible)
    starts = sampled_starts([hidden], 1000, 1.25)["a"]
    assert len(starts) > 100
    assert all(
        visible[frame]
        for start in starts
        for frame in (start.name.start, start.name.start + start.name.gap)
    )
    assert [start.name.gap for start in own_starts(hidden, (5, 40, 60, 95))] == [5, 95]
    trace, _, _ = gap_pass(tmp_path, Dataset("d", Fraction(30), [hidden]), Reaching([0.7]))
    assert all(recording.visible is not None for recording in trace)
    for jump in own_jumps(trace)["a"]:  # what follows a jump may be absent, and is no truth then
        assert np.isnan(jump.truth[:, 0]).tolist() == (~visible[jump.frames]).tolist()


def test_own_jumps_of_a_short_sequence_end_with_it() -> None:
    short = ImageSequence("s", wandering("a").truth[:9], wandering("a").read)
    assert [start.frames for start in own_starts(short, OWN_GAPS)] == [
        (0, 3, 5, 7), (0, 5, 7), (0, 7)
    ]  # fmt: skip


@given(st.integers(0, 500), st.lists(st.integers(0, 60), min_size=1, max_size=12))
def test_supplies_are_shared_evenly(total: int, supplies: list[int]) -> None:
    taken = evenly(total, np.array(supplies))
    assert taken.sum() == min(total, sum(supplies))
    assert (taken <= supplies).all()
    full = [t for t, supply in zip(taken, supplies, strict=True) if t == supply]
    others = [t for t, supply in zip(taken, supplies, strict=True) if t < supply]
    if others:
        assert max(others) - min(others) <= 1
        assert max(full, default=0) <= max(others) + 1


@given(st.floats(0, 3600), st.integers(1, 200), st.floats(1e-4, 4), st.floats(1e-4, 1))
def test_a_plan_keeps_its_budget_and_its_own_jumps_first(
    budget: float, sequences: int, init: float, call: float
) -> None:
    plan = GapPlan.within(budget, sequences, init, call)
    one = sequences * (init + len(FOLLOWED) * call)
    spent = len(plan.own_gaps) * one + plan.sampled * (init + call)
    assert spent <= budget * (1 + 1e-9)
    assert list(plan.own_gaps) == sorted(set(plan.own_gaps) & set(OWN_GAPS))
    if plan.sampled > one / (init + call) + 1:
        assert plan.own_gaps == OWN_GAPS


def test_few_own_jumps_are_spread_over_the_gaps() -> None:
    plans = [GapPlan.within(own, 1, 1.0, 0.0).own_gaps for own in (1, 3, 9)]
    assert plans == [(14,), (5, 14, 40), OWN_GAPS]


class Clock:
    """Stands in for ``time`` in the gap pass: its seconds pass only when they are told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr("lae_sim.profile.gaps.time", made)
    return made


def test_a_budget_makes_fewer_and_says_so(tmp_path: Path, clock: Clock) -> None:
    tracker, data = Reaching([0.7], init_s=0.02, sleep=clock.sleep), dataset("a", "b")
    trace, notices, _ = gap_pass(tmp_path, data, tracker, budget="1s")
    assert clock.now < 1.1  # three restarts that tell how long one takes, and those within 1 s
    schedule = trace.metadata.document["schedule"]
    # 0.85 s are planned for: all 18 own jumps, and restarts of 0.02 s each in what they leave
    assert (schedule["own_jumps"], schedule["restarts"]) == (18, 24)
    assert schedule["budget"] == "1 s"
    assert schedule["left_out"] == {"own_jumps": 0, "restarts": 976}
    assert notices == [
        "gaps: an initialisation takes 0.02 s here, a call 0 s: within 1 s 18 of 18 own jumps and "
        "24 of 1,000 restarts; a larger budget makes more"
    ]


def test_what_takes_longer_than_it_did_ends_with_the_budget(tmp_path: Path, clock: Clock) -> None:
    tracker, data = Reaching([0.7], init_s=0.02, sleep=clock.sleep), dataset("a", "b")

    def slower(seconds: float) -> None:
        clock.sleep(seconds if tracker.inits < 3 else 3 * seconds)

    tracker.sleep = slower
    trace, _, _ = gap_pass(tmp_path, data, tracker, budget="1s")
    assert clock.now < 1.2
    schedule = trace.metadata.document["schedule"]
    assert 0 < schedule["own_jumps"] + schedule["restarts"] < 18


def test_what_only_the_first_frame_takes_is_not_counted_again_and_again(
    tmp_path: Path, clock: Clock
) -> None:
    slow: set[str] = set()

    def opened(name: str) -> ImageSequence:
        made = wandering(name)

        def read(frame: int) -> Image:
            if name not in slow:
                slow.add(name)
                clock.sleep(0.3)
            return made.read(frame)

        return ImageSequence(name, made.truth, read)

    data = Dataset("d", Fraction(30), [opened("a"), opened("b")])
    trace, notices, _ = gap_pass(tmp_path, data, Reaching([0.7]), budget="1s")
    assert notices == []
    assert trace.metadata.document["schedule"]["restarts"] == 1000


def test_all_that_there_are_is_not_fewer(tmp_path: Path) -> None:
    gentle = ImageSequence("s", np.tile([10.0, 10, 12, 10], (8, 1)), wandering("a").read)
    notices: list[str] = []
    data, options = Dataset("d", Fraction(30), [gentle]), {"tracker": FakeTimed()}
    gaps = Gaps(data, options, 10**8, None, notices.append)
    gaps.prepare(Journal(tmp_path / "t.unfinished", {}, resume=False))
    assert gaps.calls(gentle) > 0
    assert notices == []


def test_the_rest_is_left_out_when_the_tracker_becomes_slow(tmp_path: Path) -> None:
    class Slower(Reaching):
        def init(self, frame: Image, box: Sequence[float]) -> Answer:
            self._init_s = 0.0 if self.inits < 3 else 0.03
            return super().init(frame, box)

    trace, _, _ = gap_pass(tmp_path, dataset("a", "b"), Slower([0.7]), budget="2s")
    schedule = trace.metadata.document["schedule"]
    assert schedule["own_jumps"] > 13  # there is time kept for those of the second sequence
    assert schedule["restarts"] < 100
    assert schedule["left_out"]["restarts"] == 1000 - schedule["restarts"]


def test_a_plan_stays_when_it_is_resumed(tmp_path: Path) -> None:
    folder = tmp_path / "t.unfinished"
    decisions = iter([{"sampled": 3}, {"sampled": 4}])
    for resume in (False, True):
        assert Journal(folder, {}, resume).decided("gaps", lambda: next(decisions)) == {
            "sampled": 3
        }


def test_restarts_that_fail_are_told_and_the_others_kept(tmp_path: Path) -> None:
    class Picky(Reaching):
        def init(self, frame: Image, box: Sequence[float]) -> Answer:
            if self.inits % 10 == 9:
                self.inits += 1
                raise TrackerError("not this one")
            return super().init(frame, box)

    trace, _, failures = gap_pass(tmp_path, dataset("a", "b"), Picky([0.7]))
    told = trace.metadata.document["failures"]
    assert len(told) == len(failures) > 50
    assert "not this one" in told[0]["reason"]
    names = {recording.name for recording in trace}
    assert not names & {failure.sequence for failure in failures}
    schedule = trace.metadata.document["schedule"]
    assert sum(schedule["left_out"].values()) == len(failures)


def test_no_truth_no_restarts(tmp_path: Path) -> None:
    notices: list[str] = []
    lost = np.full((50, 4), np.nan)
    lost[0] = [1, 2, 12, 10]
    data = Dataset("d", Fraction(30), [ImageSequence("s", lost, wandering("a").read)])
    gaps = Gaps(data, {"tracker": FakeTimed()}, 10**9, None, notices.append)
    gaps.prepare(Journal(tmp_path / "t.unfinished", {}, resume=False))
    assert "no restarts" in notices[0]
    assert gaps.run(data.sequences[0], lambda n: None) == []


def test_frames_are_read_once_in_their_order() -> None:
    read: list[int] = []

    def frame(index: int) -> Image:
        read.append(index)
        if index == 9:
            raise LaeError("damaged")
        return np.full((1, 1, 3), index, np.uint8)

    starts = [Start(RestartName("s", i, k), (0, k)) for i, k in ((1, 8), (2, 3), (2, 10), (5, 4))]
    ahead = _ReadAhead(frame, starts)
    for start in starts:
        for index in start.read:
            if index == 9:
                with pytest.raises(LaeError, match="damaged"):
                    ahead(index)
            else:
                assert ahead(index)[0, 0, 0] == index
        ahead.done(start)
    assert read == [1, 2, 5, 9, 12]
    assert not ahead._held


QUICK = """
import numpy as np

class Quick:
    def init(self, frame, box):
        self.box = list(box)

    def track(self, frame):
        rows, columns = np.nonzero(frame[:, :, 0])
        return [int(columns.min()), int(rows.min()), *self.box[2:]]

    def describe(self):
        return {"search": {"half_side": 1.0}}
"""


def test_an_interrupted_gap_pass_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "quick_tracker.py").write_text(QUICK)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("a", "b"):
        (tmp_path / "data" / name / "img").mkdir(parents=True)
        boxes = [(5 + 2 * i, 20, 12, 10) for i in range(40)]
        for i, (x, y, _, _) in enumerate(boxes):
            picture = tmp_path / "data" / name / "img" / f"{i + 1:04}.png"
            cv2.imwrite(str(picture), bright_frame(x, y))
        text = "\n".join(",".join(map(str, box)) for box in boxes)
        (tmp_path / "data" / name / "groundtruth_rect.txt").write_text(text + "\n")
    out = tmp_path / "t.parquet"
    plan = ProfilePlan.of(
        tracker="quick_tracker:Quick", root=tmp_path / "data", in_process=True, gaps="5h"
    )

    def interrupt(done: int, total: int) -> None:
        if done > 80 + (total - 80) * 0.8:  # in the second sequence of the gap pass
            raise KeyboardInterrupt

    notices: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        run_profile(plan, out, progress=interrupt, notice=notices.append)
    assert "--resume goes on" in notices[-1]
    part = read_trace(tmp_path / "t.gaps.parquet")
    assert {RestartName.parse(name).sequence for name in part.names} == {"a"}
    with pytest.raises(LaeError, match="with gaps '18000 s', not '60 s'"):
        run_profile(replace(plan, gaps=parse_budget("1m")), out, resume=True)
    profile = run_profile(plan, out, resume=True)
    whole = read_trace(tmp_path / "t.gaps.parquet")
    assert set(part.names) < set(whole.names)
    assert {RestartName.parse(name).sequence for name in whole.names} == {"a", "b"}
    assert "left_out" not in profile.traces[1].schedule
    kept = {recording.name: recording for recording in whole}
    for recording in part:
        assert (kept[recording.name].elapsed_ns == recording.elapsed_ns).all()
    assert whole.metadata.search is not None
    assert max(each.distance for each in restarts_of(whole) if each.start) < 1.25


def test_gaps_in_a_plan() -> None:
    assert ProfilePlan.of().gaps is None
    assert ProfilePlan.of(gaps=False).gaps is None
    assert ProfilePlan.of(gaps=True).gaps == 1800 * 10**9
    assert ProfilePlan.of(gaps="10m").gaps == 600 * 10**9
    assert ProfilePlan.of(gaps="1.5h").gaps == 5400 * 10**9
    for wrong in ("10", "10ms", "0s", 10, "-3m"):
        with pytest.raises(LaeError, match=r"gaps: .*such as 10m"):
            ProfilePlan.of(gaps=wrong)
    with pytest.raises(LaeError, match="every-frame"):
        ProfilePlan.of(gaps=True, mode="real-time")


def test_a_run_is_what_other_passes_make(tmp_path: Path) -> None:
    data = dataset("a")
    gaps = Gaps(data, {"tracker": Reaching([0.7])}, 10**12, None, print)
    gaps.prepare(Journal(tmp_path / "t.unfinished", {}, resume=False))
    made = gaps.run(data.sequences[0], lambda n: None)
    assert all(isinstance(run, LiveRun) for run in made)
    assert json.dumps(gaps.schedule([run.recording.name for run in made]))
