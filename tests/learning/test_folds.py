"""What forecasters learn from, and that none learns from what it is scored on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import moving, psi, schedule_latest, worlds

from lae_sim.comparison.forecasters import score_forecasters
from lae_sim.datasets.names import video_of
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.forecast.base import Hold
from lae_sim.learning.folds import CrossFitted, Examples, assign_folds, cross_fitted
from lae_sim.replay.latency import constant
from lae_sim.replay.run import replay_sequence
from lae_sim.replay.world import World
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

CLOCK = Clock.at(Fraction(30))
Rows = list[tuple[str, int, int, list[float], list[float], list[float]]]


def examples_of(recordings: Sequence[Recording], **how: Any) -> Examples:
    return Examples.of([replay_sequence(recording, CLOCK, **how) for recording in recordings])


def rows_of(examples: Examples) -> Rows:
    """Sequence, frame asked for, frame last known, its box, truth and own box of each query."""
    lanes = examples.lanes
    return [
        (
            examples.sequences[int(lanes.lane(np.array([item]))[0])],
            int(frame),
            int(lanes.frames[item]),
            lanes.boxes[item].tolist(),
            truth.tolist(),
            own.tolist(),
        )
        for item, frame, truth, own in zip(
            examples.item.tolist(), examples.frame, examples.truth, examples.boxes
        )
    ]


@given(data=st.data())
@settings(max_examples=25)
def test_examples_are_what_a_plain_loop_over_the_frames_finds(data: st.DataObject) -> None:
    fps, *first = data.draw(worlds(20))
    group = [first, *(data.draw(worlds(12))[1:] for _ in range(data.draw(st.integers(0, 2))))]
    recordings = []
    for k, (elapsed, boxes) in enumerate(group):
        truth = np.array(boxes) + 0.25
        unknown = data.draw(st.lists(st.booleans(), min_size=len(truth), max_size=len(truth)))
        truth[unknown] = np.nan
        recordings.append(Recording.new(f"s{k}", truth, boxes, elapsed))
    found = Examples.of([replay_sequence(recording, Clock.at(fps)) for recording in recordings])
    assert found.sequences == tuple(recording.name for recording in recordings)
    expected: Rows = []
    for k, recording in enumerate(recordings):
        times = recording.elapsed_ns.tolist()
        known = psi(schedule_latest(fps, times), fps, len(times), Fraction(0))
        low, high = found.lanes.offsets[k : k + 2]
        assert found.lanes.frames[low:high].tolist() == sorted({0, *known})
        expected += [
            (recording.name, i, j, *(a.tolist() for a in (recording.boxes[j], truth, own)))
            for i, (j, truth, own) in enumerate(zip(known, recording.truth, recording.boxes))
        ]
    np.testing.assert_equal(rows_of(found), expected)  # NaN equals NaN
    assert (np.diff(found.item) >= 0).all()


def test_a_real_time_trace_has_no_box_of_the_frames_it_skipped() -> None:
    whole = moving(12, elapsed=70_000_000)
    frames = replay_sequence(whole, CLOCK).schedule.frames
    boxes, elapsed = np.full((12, 4), np.nan), np.full(12, -1)
    boxes[frames], elapsed[frames] = whole.boxes[frames], whole.elapsed_ns[frames]
    found = examples_of([Recording.new("a", whole.truth, boxes, elapsed)])
    expected = examples_of([whole])
    for name in ("item", "frame", "truth"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(found.lanes.boxes, expected.lanes.boxes)
    np.testing.assert_array_equal(np.isnan(found.boxes[:, 0]), ~np.isin(found.frame, frames))


A, B, C = (moving(n, seed, name) for n, seed, name in ((20, 1, "a"), (9, 2, "b"), (30, 3, "c")))


def test_joined_examples_are_those_of_its_parts() -> None:
    parts = [examples_of([A, C]), examples_of([B, C], source=constant(ns=90_000_000))]
    joined = Examples.joined(parts)
    assert joined.sequences == ("a", "c", "b", "c")
    assert rows_of(joined) == rows_of(parts[0]) + rows_of(parts[1])
    assert rows_of(Examples.joined(parts[:1])) == rows_of(parts[0])
    assert (np.diff(joined.item) >= 0).all()
    assert joined.lanes.image_sizes.shape == (4, 2)


def test_without_some_sequences_their_queries_are_gone_and_the_others_count_as_before() -> None:
    joined = Examples.joined([examples_of([A, B]), examples_of([B, C])])
    left = joined.without({"b", "no such"})
    assert rows_of(left) == [row for row in rows_of(joined) if row[0] != "b"]
    assert left.sequences == ("a", "c")
    sums = np.bincount(left.lanes.lane(left.item), left.weight, 2)
    assert sums == pytest.approx([1, 1])
    assert left.weight[0] == pytest.approx(1 / len(A))
    none = joined.without("abc")
    assert (len(none.item), none.weight.shape) == (0, (0,))


@pytest.mark.parametrize(
    ("name", "video"),
    [
        ("car1_1", "car1"), ("car1_12", "car1"), ("car1_s", "car1"), ("car1", "car1"),
        ("Jogging-1", "Jogging"), ("Jogging.2", "Jogging"), ("uav00074_04320_s", "uav00074_04320"),
        ("uav00074_04320", "uav00074_04320"), ("Val_000001", "Val_000001"), ("Sheep1", "Sheep1"),
        ("S0101", "S0101"), ("boat_sail", "boat_sail"), ("", ""), ("a_1\n", "a_1\n"),
    ],
)  # fmt: skip
def test_the_video_of_a_sequence(name: str, video: str) -> None:
    assert video_of(name) == video


@given(
    names=st.sets(st.from_regex(r"[a-d]{1,2}[0-3]?(_[0-9s])?", fullmatch=True), min_size=1),
    folds=st.integers(2, 7),
    seed=st.integers(0, 3),
)
def test_folds_keep_videos_together_and_are_even(names: set[str], folds: int, seed: int) -> None:
    videos = {video_of(name) for name in names}
    if len(videos) < 2:
        with pytest.raises(LaeError, match="only one video"):
            assign_folds(names, folds, seed)
        return
    dealt = assign_folds(sorted(names), folds, seed)
    assert dealt == assign_folds([*sorted(names, reverse=True), *names], folds, seed)
    assert set(dealt) == names
    of_video = {video_of(name): fold for name, fold in dealt.items()}
    assert dealt == {name: of_video[video_of(name)] for name in names}
    sizes = [list(of_video.values()).count(fold) for fold in range(min(folds, len(videos)))]
    assert sum(sizes) == len(videos)
    assert max(sizes) - min(sizes) <= 1


def test_another_seed_deals_otherwise_and_the_same_one_the_same_for_ever() -> None:
    names = [f"v{k:02}x" for k in range(40)]
    dealt = [assign_folds(names, 5, seed) for seed in range(3)]
    assert dealt[0] != dealt[1] != dealt[2]
    assert [dealt[0][name] for name in names[:10]] == [1, 0, 2, 1, 3, 0, 4, 4, 2, 2]


@pytest.mark.parametrize("folds", [-1, 0, 1])
def test_one_fold_is_none(folds: int) -> None:
    with pytest.raises(LaeError, match="two folds"):
        assign_folds("abc", folds)


# ------------------------------------------------------------- nobody is scored on what it has seen

NAMES = ["car1_1", "car1_2", "car1_s", "dog", "Jogging-1", "Jogging-2", "kite", "van", "zebra"]
RECORDINGS = [moving(24 + k, k, name) for k, name in enumerate(sorted(NAMES))]
OWNER: Mapping[bytes, str] = {
    row.tobytes(): recording.name
    for recording in RECORDINGS
    for row in np.concatenate([recording.truth, recording.boxes])
}
"""Whose a row of truth or of boxes is: told by its bits, not by any bookkeeping."""


@dataclass
class FakeTrainer:
    """Keeps whose truth and boxes it was asked about, and for whom its forecasters answered."""

    seen: list[set[str]] = field(default_factory=list)
    scored: list[tuple[int, str]] = field(default_factory=list)

    def fit(self, examples: Examples, seed: int) -> Any:
        rows = np.concatenate([examples.truth, examples.boxes, examples.lanes.boxes[examples.item]])
        self.seen.append({OWNER[row.tobytes()] for row in rows})
        assert self.seen[-1] == {row[0] for row in rows_of(examples)}
        return Fitted(self, len(self.seen) - 1)


@dataclass
class Fitted:
    trainer: FakeTrainer
    call: int

    def for_sequence(self, sequence: Any) -> Any:
        whose = {OWNER[row.tobytes()] for row in sequence.truth}
        assert whose == {sequence.name}
        self.trainer.scored.append((self.call, sequence.name))
        return Hold


def assert_honest(trainer: FakeTrainer, folds: int, names: Sequence[str] = NAMES) -> None:
    """Each fold's forecaster has seen all videos but those that it was scored on."""
    assert len(trainer.seen) == folds
    assert {name for _, name in trainer.scored} == set(names)
    for call, seen in enumerate(trainer.seen):
        scored = {name for at, name in trainer.scored if at == call}
        assert {video_of(name) for name in scored}.isdisjoint(video_of(name) for name in seen)
        assert scored | seen == set(names)
        assert scored
        assert seen


@given(folds=st.integers(2, 12), seed=st.integers(0, 99))
@settings(max_examples=15)
def test_no_fold_is_trained_on_the_sequences_it_is_scored_on(folds: int, seed: int) -> None:
    trainer = FakeTrainer()
    runs = [replay_sequence(recording, CLOCK) for recording in RECORDINGS]
    dealt = assign_folds(NAMES, folds, seed)
    told: list[None] = []
    fitted = cross_fitted(trainer, Examples.of(runs), dealt, seed, lambda: told.append(None))
    evaluate_runs(runs, Metadata.new("30", "every-frame"), {"fake": fitted})
    assert len(told) == len(trainer.seen)
    assert_honest(trainer, min(folds, 6))


@pytest.mark.parametrize("folds", [2, 4, 50])
def test_no_comparison_scores_what_it_has_trained_on(folds: int) -> None:
    """Two traces share sequences; all replays of a sequence are held out together."""
    metadata = Metadata.new("30", "every-frame")
    traces = {"one": Trace(metadata, RECORDINGS[:6]), "two": Trace(metadata, RECORDINGS[2:])}
    worlds = World.sweep(latency=["recorded", "constant:95ms"], scale=[1, 2])
    trainers = {"fake": FakeTrainer(), "other": FakeTrainer()}
    table = score_forecasters(traces, trainers, worlds, folds=folds, seed=folds)
    for trainer in trainers.values():
        assert_honest(trainer, min(folds, 6))
        assert len(trainer.scored) == 4 * (6 + 7)
    scores = table.pivot_table(
        index=["trace", "sequence", "latency", "scale", "metric"],
        columns="forecaster",
        values="value",
    )
    np.testing.assert_array_equal(scores["fake"], scores["hold"])
    rows = table.query("forecaster == 'fake' and not metric.str.startswith('modelled')")
    assert len(rows) == 4 * 13 * 4
    [note] = [note for note in table.attrs["notes"] if "folds" in note]
    assert f"trained in {min(folds, 6)} folds over 9 sequences" in note


def test_the_two_traces_are_no_way_around_it() -> None:
    """The same video under another name in another trace counts as seen."""
    metadata = Metadata.new("30", "every-frame")
    traces = {
        name: Trace(metadata, [r for r in RECORDINGS if r.name in kept])
        for name, kept in {"one": ("car1_1", "dog"), "two": ("car1_2", "van")}.items()
    }
    trainer = FakeTrainer()
    score_forecasters(traces, {"fake": trainer}, folds=3)
    assert_honest(trainer, 3, ["car1_1", "car1_2", "dog", "van"])


def test_the_seed_reaches_the_trainer_and_a_factory_its_fold() -> None:
    class Seeded:
        def fit(self, examples: Examples, seed: int) -> Any:
            return lambda box, size: (seed, len(examples.item))

    folds = {"a": 0, "b": 1, "c": 1}
    fitted = cross_fitted(Seeded(), examples_of([A, B, C]), folds, seed=7)
    assert isinstance(fitted, CrossFitted)
    told = [fitted.for_sequence(recording)([0] * 4, None) for recording in (A, B, C)]
    assert told == [(7, 39), (7, 20), (7, 20)]
