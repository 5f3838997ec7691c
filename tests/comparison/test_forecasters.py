"""Comparing forecasters: every value of the tidy table is what ``evaluate`` gives directly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from places import TRACES
from restarted import gap_pass

from lae_sim.comparison.forecasters import score_forecasters, steps
from lae_sim.comparison.statistics import summarise
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import fifo
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.evaluation.metrics import METRICS, find_convention
from lae_sim.forecast.base import ConstantVelocity, Hold, Oracle
from lae_sim.forecast.kalman import Kalman
from lae_sim.learning.folds import Examples, assign_folds
from lae_sim.learning.registry import load_any
from lae_sim.learning.trainers import KalmanTrainer
from lae_sim.replay.latency import by_frame, constant, scaled
from lae_sim.replay.run import Runs
from lae_sim.replay.world import World, replay_trace
from lae_sim.trace.file import Trace, read_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

SEQUENCES = ["bike-pan", "car-chase", "person-crowd"]
FORECASTERS = {"kalman": Kalman, "velocity": ConstantVelocity}
KEYS = ["trace", "dataset", "sequence", "latency", "scale", "forecaster", "sigma", "metric"]


@pytest.fixture(scope="module")
def slow() -> Trace:
    return read_trace(TRACES / "synthetic-slow.parquet", SEQUENCES)


@pytest.fixture(scope="module")
def fast() -> Trace:
    return read_trace(TRACES / "synthetic-fast.parquet", SEQUENCES)


def values(table: pd.DataFrame, **wanted: Any) -> np.ndarray:
    """The values of some rows in order."""
    for key, value in wanted.items():
        table = table[table[key] == value]
    return table["value"].to_numpy()


def test_columns_and_rows(slow: Trace) -> None:
    table = score_forecasters({"slow": slow}, FORECASTERS, [World.of(search="off")])
    assert list(table) == [*KEYS, "value"]
    assert not table.duplicated(KEYS).any()
    assert len(table) == 4 * 4 * 3  # metrics, forecasters with hold and offline, sequences
    assert list(table["forecaster"].unique()) == ["hold", "kalman", "velocity", "offline"]
    assert list(table["sequence"].unique()) == SEQUENCES
    assert set(table["dataset"]) == {"synthetic"}
    assert set(table["metric"]) == set(METRICS)
    assert list(table.index) == list(range(len(table)))
    assert [str(kind) for kind in table[["scale", "sigma", "value"]].dtypes] == ["float64"] * 3


def test_every_value_is_what_evaluate_gives(slow: Trace, fast: Trace) -> None:
    sources = {"recorded": by_frame, "constant:90ms": constant(ns=90_000_000)}
    scales, sigmas = [Fraction(1, 2), Fraction(2)], [Fraction(0), Fraction(1, 3), Fraction(1)]
    fps, convention = Fraction(25), find_convention("otb")
    worlds = World.sweep(
        fps=fps,
        policy=fifo,
        latency=list(sources),
        scale=scales,
        sigma=sigmas,
        convention="otb",
        search="off",
    )
    traces = {"slow": slow, "fast": fast}
    table = score_forecasters(traces, FORECASTERS, worlds)
    keys = ["trace", "latency", "scale", "metric", "forecaster", "sigma"]
    got = table.groupby(keys)["value"].agg(list).to_dict()
    expected = {}
    ready = {"hold": Hold, **FORECASTERS}
    for label, trace in traces.items():
        for latency, source in sources.items():
            for scale in scales:
                runs = Runs(trace, Clock.at(fps), scaled(source, scale), fifo)
                found = evaluate_runs(runs, trace.metadata, ready, sigmas, convention)
                for m in METRICS:
                    here = label, latency, float(scale), m
                    for k, sigma in enumerate(map(float, sigmas)):
                        expected[(*here, "offline", sigma)] = found.offline[m].tolist()
                        for f, name in enumerate(ready):
                            expected[(*here, name, sigma)] = found.scores[m][f, :, k].tolist()
    assert got == expected


def test_the_order_of_the_traces_does_not_change_a_value(slow: Trace, fast: Trace) -> None:
    trainer = KalmanTrainer(q=(0.3, 3.0), decay=(0.95, 1.0), state=("corner",))
    forecasters = {**FORECASTERS, "tuned": trainer}
    one = score_forecasters({"slow": slow, "fast": fast}, forecasters, folds=3)
    other = score_forecasters({"fast": fast, "slow": slow}, forecasters, folds=3)
    assert one["trace"].iloc[0] == "slow" != other["trace"].iloc[0]
    one, other = (table.sort_values(KEYS, ignore_index=True) for table in (one, other))
    pd.testing.assert_frame_equal(one, other, check_exact=True)


class Spy:
    """A trainer that remembers what it was shown; what it makes answers with the oldest box."""

    def __init__(self) -> None:
        self.shown: list[set[str]] = []
        self.seeds: list[int] = []

    def fit(self, examples: Examples, seed: int) -> Any:
        seen = examples.lanes.lane(examples.item)
        self.shown.append({examples.sequences[lane] for lane in seen})
        self.seeds.append(seed)
        return Hold


def test_nothing_is_trained_on_what_it_is_scored_on(slow: Trace, fast: Trace) -> None:
    spy = Spy()
    told: list[str] = []
    worlds = World.sweep(scale=[1, 2])
    arguments = ({"slow": slow, "fast": fast}, {"spy": spy, **FORECASTERS}, worlds)
    table = score_forecasters(*arguments, folds=3, seed=7, progress=told.append)
    folds = assign_folds(SEQUENCES, 3, 7)
    everything = set(SEQUENCES)
    assert spy.shown == [
        everything - {name for name in SEQUENCES if folds[name] == k} for k in (0, 1, 2)
    ]
    assert spy.seeds == [7] * 3
    assert told[:3] == ["training spy"] * 3
    assert told[3:] == ["slow, recorded", "slow, recorded x 2", "fast, recorded"] + told[-1:]
    assert len(told) == steps(*arguments, folds=3)
    np.testing.assert_array_equal(values(table, forecaster="spy"), values(table, forecaster="hold"))
    [note] = [note for note in table.attrs["notes"] if note.startswith("spy")]
    assert "trained in 3 folds over 3 sequences" in note
    assert "seed 7" in note


def test_notes_say_what_is_approximate(slow: Trace) -> None:
    worlds = World.sweep(latency=["constant:1ms", "constant:90ms"], search="off")
    notes = score_forecasters({"slow": slow}, {}, worlds).attrs["notes"]
    assumed = "ms, the same as a frame: an assumption; name it with ,init=TIME"
    assert notes == [
        f"slow, constant:1ms: initialisation costs 1 {assumed}",
        f"slow, constant:90ms: initialisation costs 90 {assumed}",
        "slow, constant:90ms: approximate, 100% of the outputs follow another frame than when "
        "recorded",
    ]


def test_a_real_time_trace_is_exact_and_has_no_offline_scores() -> None:
    trace = read_trace(TRACES / "synthetic-slow-realtime.parquet", SEQUENCES)
    table = score_forecasters({"run": trace}, FORECASTERS)
    assert np.isnan(values(table, forecaster="offline")).all()
    assert np.isfinite(table["value"][table["forecaster"] != "offline"]).all()
    assert not [note for note in table.attrs["notes"] if "approximate" in note]
    every_frame = read_trace(TRACES / "synthetic-slow.parquet", SEQUENCES)
    again = score_forecasters({"run": every_frame}, FORECASTERS, [World(search="off")])
    known = table["forecaster"] != "offline"
    pd.testing.assert_frame_equal(table[known], again[known], check_exact=True)
    with pytest.raises(LaeError, match="the trace has no box for it"):
        score_forecasters({"run": trace}, FORECASTERS, [World(latency="constant:1ms")])


def test_costs_delay_the_answers(slow: Trace) -> None:
    free = score_forecasters({"slow": slow}, FORECASTERS)
    table = score_forecasters({"slow": slow}, FORECASTERS, [World(costs=("kalman=40ms",))])
    costs = {"kalman": 40_000_000}
    runs = list(replay_trace(slow))
    found = evaluate_runs(runs, slow.metadata, {"kalman": Kalman}, costs=costs)
    got = values(table, forecaster="kalman", metric="auc")
    np.testing.assert_array_equal(got, found.scores["auc"][0, :, 0])
    assert got.mean() < values(free, forecaster="kalman", metric="auc").mean()
    for name in ("hold", "velocity", "offline"):
        got, expected = values(table, forecaster=name), values(free, forecaster=name)
        np.testing.assert_array_equal(got, expected)
    assert [note for note in table.attrs["notes"] if "kalman 40000 us" in note]
    with pytest.raises(LaeError, match="no forecaster 'nobody'"):
        score_forecasters({"slow": slow}, FORECASTERS, [World(costs=("nobody=1ms",))])


def test_forecasters_that_must_know_their_sequence(slow: Trace) -> None:
    table = score_forecasters({"slow": slow}, {"oracle": Oracle})
    got = values(table, forecaster="oracle", metric="auc")
    np.testing.assert_allclose(got, 20 / 21, rtol=0, atol=1e-12)


def test_what_cannot_be_compared(slow: Trace) -> None:
    with pytest.raises(LaeError, match="nothing to compare"):
        score_forecasters({}, FORECASTERS)
    with pytest.raises(LaeError, match="offline is the name of the tracker's own scores"):
        score_forecasters({"slow": slow}, {"offline": Kalman})
    alone = read_trace(TRACES / "synthetic-slow.parquet", SEQUENCES[:1])
    with pytest.raises(LaeError, match="only one video"):
        score_forecasters({"slow": alone}, {"tuned-kalman": load_any("tuned-kalman")})
    [one] = alone
    bare = replace(alone, recordings=[replace(one, truth=np.full_like(one.truth, np.nan))])
    with pytest.raises(LaeError, match="nothing to compare: no sequence has a ground truth"):
        score_forecasters({"slow": bare}, {"tuned-kalman": load_any("tuned-kalman")})


def test_a_sequence_without_truth_has_no_value_where_the_convention_leaves_it_out() -> None:
    boxes = np.tile([10.0, 10, 20, 20], (9, 1))
    truth = np.full((9, 4), np.nan)
    recordings = [
        Recording.new("bare", truth, boxes, np.full(9, 10**7)),
        Recording.new("good", boxes, boxes, np.full(9, 10**7)),
    ]
    trace = Trace(Metadata.new("30", "every-frame"), recordings)
    table = score_forecasters({"a": trace}, FORECASTERS, [World(convention="exclude")])
    assert np.isnan(values(table, sequence="bare")).all()
    assert np.isfinite(values(table, sequence="good")).all()
    assert [note for note in table.attrs["notes"] if "no ground truth" in note]
    assert set(summarise(table, resamples=10)["sequences"]) == {1}


LATENCIES = [f"constant:{ms}ms" for ms in (20, 47, 68, 167)]


@pytest.mark.parametrize(
    ("name", "shares", "exact"),
    [
        ("kalman", [49.9, 52.0, 48.6, 28.3], True),
        ("least-squares", [69, 56, 50, 28], False),
    ],
)
def test_nanotrack_on_dtb70(
    shared_data: Path, name: str, shares: Sequence[float], exact: bool
) -> None:
    """Issue 4's figures of the paper's filter, and what least squares must reach."""

    def recordings() -> Any:
        with np.load(shared_data / "results_boxes" / "DTB70" / "NanoTrackV3.npz") as boxes:
            for sequence in sorted(boxes.files):
                path = shared_data / "DTB70" / "anno" / f"{sequence}.txt"
                truth = np.loadtxt(path, delimiter=",")
                times = np.full(len(truth), 47_000_000)
                yield Recording.new(sequence, truth, boxes[sequence], times)

    trace = Trace(Metadata.new("30", "every-frame"), list(recordings()))
    table = score_forecasters(
        {"nano": trace}, {name: load_any(name)}, World.sweep(latency=LATENCIES)
    )
    summary = summarise(table, metrics=["auc"], resamples=10)
    ours = summary[summary["forecaster"] == name]
    assert list(ours["latency"]) == LATENCIES
    assert set(ours["sequences"]) == {70}
    found = 100 * ours["recovered"].to_numpy()
    if exact:
        np.testing.assert_allclose(found, shares, rtol=0, atol=0.1)
    else:
        assert (found >= shares).all(), found


def test_modelled_scores_stand_beside_and_stop_at_exact_replays(slow: Trace) -> None:
    worlds = World.sweep(latency=["constant:1ms", "constant:90ms"], search="c=0.3")
    table = score_forecasters({"slow": slow}, FORECASTERS, worlds)
    modelled = {f"modelled_{m}{end}" for m in ("auc", "dp20") for end in ("", "_low", "_high")}
    assert set(table["metric"]) == {*METRICS, *modelled}
    for world in worlds:
        names = {"hold": Hold, **FORECASTERS}
        found = evaluate_runs(world.replay(slow), slow.metadata, names).modelled
        for f, forecaster in enumerate(names):
            for end, expected in (("", found.mean), ("_low", found.low), ("_high", found.high)):
                got = values(
                    table,
                    latency=world.latency,
                    forecaster=forecaster,
                    metric=f"modelled_auc{end}",
                )
                np.testing.assert_array_equal(got, expected["auc"][f, :, 0])
    exact = table[table["latency"] == "constant:1ms"]
    for name in modelled:
        recorded = name.split("_")[1]
        np.testing.assert_array_equal(
            values(exact, metric=name), values(exact, metric=recorded), name
        )
    for row in table.attrs["modelled"]:
        assert row["latency"] == "constant:90ms"
        chosen = values(
            table,
            latency="constant:90ms",
            forecaster=row["forecaster"],
            metric="modelled_auc",
        )
        assert row["auc"] == pytest.approx(chosen.mean(), abs=1e-12)
        assert row["auc_low"] < row["auc"] < row["auc_high"]
    assert table.attrs["ranking"]["modelled"]


def test_passes_find_the_trace_of_their_tracker(slow: Trace, fast: Trace, tmp_path: Path) -> None:
    gaps = read_trace(gap_pass(slow.metadata, tmp_path / "slow.gaps.parquet"))
    worlds = [World.of(latency="constant:90ms", passes=[gaps])]
    table = score_forecasters({"slow": slow, "fast": fast}, {}, worlds)
    known = {row["trace"]: row["c_known"] for row in table.attrs["search"]}
    assert known == {"slow": True, "fast": False}
    assert table.attrs["ranking"] == {
        "modelled": False,
        "reason": "the reach is unknown, and the model's are for a range of it",
    }
    alone = score_forecasters({"fast": fast}, {}, worlds)  # is asked to take it
    assert alone.attrs["search"][0]["c_known"]
    stranger = Trace(Metadata.new("30", "restarts", tracker={"name": "stranger"}), list(gaps))
    strange = [World.of(passes=[stranger])]
    with pytest.raises(LaeError, match="a pass is of stranger on unknown: none of the traces"):
        score_forecasters({"slow": slow, "fast": fast}, {}, strange)


def test_what_is_trained_learns_from_the_recorded_boxes(slow: Trace) -> None:
    class Remembers:
        def __init__(self) -> None:
            self.fed: list[np.ndarray] = []

        def fit(self, examples: Examples, seed: int) -> type[Hold]:
            self.fed.append(examples.lanes.boxes)
            return Hold

    one, other = Remembers(), Remembers()
    for trainer, search in ((one, "off"), (other, "c=0.1")):
        world = World(latency="constant:90ms", search=search)
        score_forecasters({"slow": slow}, {"spy": trainer}, [world], folds=3)
    for a, b in zip(one.fed, other.fed, strict=True):
        np.testing.assert_array_equal(a, b)


def test_worlds_share_their_search_model(slow: Trace) -> None:
    worlds = [World(search="off"), World(search="c=0.3")]
    with pytest.raises(LaeError, match="share their passes and their search model"):
        score_forecasters({"slow": slow}, {}, worlds)
