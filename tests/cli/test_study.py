"""Studies as a user runs them: figures, resuming, workers, clusters, and what goes wrong."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import ENVIRONMENT, command, run_here, run_process
from networks import random_learned
from places import REPOSITORY
from restarted import gap_pass

import lae_sim
from lae_sim.cli.study import main
from lae_sim.comparison.forecasters import score_forecasters
from lae_sim.comparison.pairs import Pairs
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.forecast.learned import write_learned
from lae_sim.learning.trainers import KalmanTrainer
from lae_sim.replay.latency import bootstrap, by_frame, constant, scaled
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.study import rows as cell_rows
from lae_sim.study.comparisons import Rivals
from lae_sim.study.run import StudyResults, compute_study, flat_rows
from lae_sim.study.spec import Study

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
FAST = REPOSITORY / "traces" / "synthetic-fast.parquet"
REAL_TIME = REPOSITORY / "traces" / "synthetic-slow-realtime.parquet"
FEW = ("bike-pan", "car-chase", "person-crowd")

OWN = """
import functools

class EveryOther:
    def __call__(self, clock, calls):
        last, _, now = calls[-1]
        frame = last + 2
        return frame, max(now, frame * clock.frame_ticks)

policy = EveryOther()

class Stay:
    def __init__(self, box, image_size=None):
        self.box = box
    def update(self, frame, box):
        pass
    def predict(self, frame):
        return self.box

class Deadly(Stay):
    def __init__(self, box, image_size=None):
        import os
        os.kill(os.getpid(), 9)

class Confused(Stay):
    def __init__(self, box, image_size=None):
        raise ZeroDivisionError("of my own")

def lazy(box, image_size=None, step=1):
    return Stay(box)

partial = functools.partial(lazy, step=2)
"""


def run(folder: Path, study: Study | None = None, workers: int = 1, **more: Any) -> StudyResults:
    study = study or Study((str(SLOW), str(FAST)), sequences=FEW, **more)
    return compute_study(study, folder, workers=workers)


def contents(folder: Path) -> dict[str, bytes]:
    """Everything that a study left, by its path; reports of the traces name no worker."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def toml(folder: Path, **keys: Any) -> Path:
    path = folder / "study.toml"
    keys = {"traces": [str(SLOW), str(FAST)], "sequences": list(FEW), **keys}
    path.write_text("\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items()))
    return path


def study_command(*arguments: object, cwd: Path, status: int = 0) -> str:
    return checked(run_process("study", *arguments, cwd=cwd), status)


def study_here(*arguments: object, cwd: Path, status: int = 0) -> str:
    """The same in this process, which is faster."""
    return checked(run_here("study", *arguments, cwd=cwd), status)


def checked(done: subprocess.CompletedProcess[str], status: int) -> str:
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr if status == 2 else done.stdout


# ------------------------------------------------------------------------------ figures


def test_every_row_is_what_replaying_and_scoring_one_by_one_gives(tmp_path: Path) -> None:
    scales, sigmas = (Fraction(1, 2), Fraction(3)), (Fraction(0), Fraction(1, 3))
    latencies = ("recorded", "bootstrap", "constant:47ms")
    results = run(
        tmp_path, scales=scales, sigmas=sigmas, latencies=latencies, repetitions=3, seed=5, block=7
    )
    table = results.to_frame().set_index(
        ["trace", "latency", "scale", "forecaster", "repetition", "sequence", "sigma"]
    )
    assert len(table) == 2 * 5 * 2 * 2 * 3 * 2
    assert table.index.is_unique
    forecasters = {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman}
    for label, path in {"synthetic-slow": SLOW, "synthetic-fast": FAST}.items():
        trace = lae_sim.read_trace(path, FEW)
        for latency, repetition in [*((name, 0) for name in latencies), ("bootstrap", 2)]:
            source = {
                "recorded": by_frame,
                "bootstrap": bootstrap(5, 7, repetition),
                "constant:47ms": constant(ns=47_000_000),
            }[latency]
            for scale in scales:
                runs = [*lae_sim.replay_trace(trace, latency=scaled(source, scale))]
                found = evaluate_runs(runs, trace.metadata, forecasters, sigmas)
                for f, forecaster in enumerate(forecasters):
                    for s, name in enumerate(FEW):
                        for m, sigma in enumerate(sigmas):
                            row = table.loc[
                                (label, latency, str(scale), forecaster, repetition, name,
                                 float(sigma))
                            ]  # fmt: skip
                            assert row["auc"] == found.scores["auc"][f, s, m]
                            assert row["norm_auc"] == found.scores["norm_auc"][f, s, m]
                            assert row["offline_dp20"] == found.offline["dp20"][s]
                            assert row["processed"] == found.replay.processed[s]
                            assert row["mismatch_max"] == found.staleness.mismatch_max[s, m]
                            assert row["longest_hold"] == found.staleness.longest_hold[s, m]
                            assert row["failure_frame"] == found.failure[f, s, m]
                            assert row["approximate_outputs"] == found.replay.departures[s]
                            assert row["elapsed_ms"] == pytest.approx(
                                runs[s].schedule.elapsed_ns[1:].mean() / 1e6
                            )


def test_a_sweep_of_the_initialisation_is_the_single_replays(tmp_path: Path) -> None:
    results = run(
        tmp_path, latencies=("bootstrap", "constant:20ms"), init=("0s", "1s"), repetitions=2, seed=5
    )
    table = results.to_frame().set_index(["trace", "latency", "forecaster", "repetition"])
    table = table.sort_index(kind="stable")
    for latency, named in (
        ("constant:20ms,init=1s", "constant:20ms,init=1s"),
        ("constant:20ms,init=0s", "constant:20ms,init=0s"),
        ("bootstrap,init=1s", "bootstrap:5:30,init=1s"),
    ):
        one = lae_sim.evaluate(SLOW, latency=named, sequences=FEW).to_frame()
        expected = one[one["forecaster"] == "kalman"]["auc"].tolist()
        found = table.loc[("synthetic-slow", latency, "kalman", 0)]
        assert found["auc"].tolist() == pytest.approx(expected, abs=1e-12)
        assert set(found["init_ms"]) == {0.0 if "0s" in latency else 1000.0}
    sources = {(row.latency, row.init_source) for row in results.summary}
    assert ("bootstrap,init=0s", "assumed: 0 ms") in sources
    notes = results.notes()
    assert "initialisation at bootstrap,init=1s, constant:20ms,init=1s: assumed: 1000 ms" in notes
    lae_sim.write_report(results, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Over time of an initialisation: policy latest" in page
    assert "assumed: 1000 ms" in page


def test_the_summary_has_the_means_of_replay(tmp_path: Path) -> None:
    results = run(tmp_path, sigmas=SIGMA_GRID)
    trace = lae_sim.read_trace(SLOW, FEW)
    found = evaluate_runs(
        lae_sim.replay_trace(trace),
        trace.metadata,
        {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman},
        SIGMA_GRID,
    )
    rows = {(r["trace"], r["forecaster"], r["sigma"]): r for r in flat_rows(results.summary)}
    kalman = rows["synthetic-slow", "kalman", "mean"]
    assert kalman["auc"] == pytest.approx(found.scores["auc"][1].mean())
    assert kalman["dp20"] == pytest.approx(found.scores["dp20"][1].mean())
    hold, offline = found.scores["auc"][0].mean(), found.offline["auc"].mean()
    assert kalman["recovered_auc"] == pytest.approx((kalman["auc"] - hold) / (offline - hold))
    assert kalman["auc_low"] < kalman["auc"] < kalman["auc_high"]
    first = rows["synthetic-slow", "hold", "0"]
    assert first["auc"] == pytest.approx(found.scores["auc"][0, :, 0].mean())
    mismatch = found.staleness.mismatch_sum[:, 0].sum() / found.replay.frames.sum()
    assert first["age_ms"] == pytest.approx(1000 / 30 * mismatch)
    assert first["longest_stale_ms"] == pytest.approx(
        1000 / 30 * found.staleness.longest_hold[:, 0].max()
    )
    assert first["skip_rate"] == pytest.approx(
        1 - found.replay.processed.sum() / found.replay.frames.sum()
    )
    assert "auc_low" not in rows["synthetic-slow", "hold", "1/50"]


LATE = lae_sim.Pipeline(
    [lae_sim.Stage("decode", "6ms"), lae_sim.Stage("tracker", queue=3)],
    camera=lae_sim.Camera(delivery="8ms", jitter="uniform:0ms-8ms:1", drops=[7]),
    name="late",
)


def test_pipelines_stand_beside_the_policies_as_replay_has_them(tmp_path: Path) -> None:
    pipelines = {"late": LATE, "two": {"stages": [{"name": "tracker", "workers": 2}]}}
    study = Study((str(SLOW), str(FAST)), sequences=FEW, pipelines=pipelines, sigmas=(0, 1))
    results = run(tmp_path, study)
    found = lae_sim.evaluate(
        [SLOW, FAST], sequences=FEW, sigma=[0, 1], policy="latest", search="trace"
    ).summary
    piped = lae_sim.evaluate(
        [SLOW, FAST], sequences=FEW, sigma=[0, 1], pipeline=list(study.pipelines)
    ).summary
    expected = {
        (row.trace.removesuffix(".parquet"), row.policy, row.forecaster, row.sigma): row
        for row in pd.concat([found, piped]).itertuples()
    }
    rows = [row for row in results.summary if row.sigma != lae_sim.study.records.MEAN]
    assert {row.policy for row in rows} == {"latest", "pipeline:late", "pipeline:two"}
    assert len(rows) == len(expected) == 24
    for row in rows:
        same = expected[row.trace, row.policy, row.forecaster, float(row.sigma)]
        assert row.scores["auc"] == pytest.approx(same.auc)
        assert row.scores["dp20"] == pytest.approx(same.dp20)
        assert row.staleness is not None  # LAE's, not that from the capture on
        assert row.staleness.age_ms == pytest.approx(same.age_ms)


def test_another_pipeline_of_the_same_name_is_computed_anew(tmp_path: Path) -> None:
    def computed(queue: int) -> int:
        text = f'[[stages]]\nname = "tracker"\ntime = "47ms"\nqueue = {queue}\n'
        (tmp_path / "mine.toml").write_text(text)
        path = tmp_path / "study.toml"
        path.write_text(
            f'traces = "{SLOW}"\nsequences = ["boat-calm"]\npolicies = []\n'
            '[pipelines]\nmine = "mine.toml"\n'
        )
        study = lae_sim.read_study(path)
        results = compute_study(study, tmp_path / "out", tmp_path, workers=1)
        (hold,) = (row for row in results.summary if row.forecaster == "hold")
        assert hold.policy == "pipeline:mine"
        return results.computed

    assert [computed(1), computed(1), computed(10), computed(1)] == [2, 0, 2, 0]


def test_success_and_precision_curves_are_kept(tmp_path: Path) -> None:
    results = run(tmp_path)
    for scores in results.scores:
        (about,) = scores.about
        assert np.mean(about["curves"]["success"]) == pytest.approx(scores.means["auc"].mean())
        assert about["curves"]["precision"][20] == pytest.approx(scores.means["dp20"].mean())
        offline = scores.once["offline_auc"].mean()
        assert np.mean(about["curves"]["offline_success"]) == pytest.approx(offline)


def test_repetitions_are_dealt_out_in_chunks_that_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    more: dict[str, Any] = {"latencies": ("bootstrap",), "repetitions": 5, "search": ("c=0.3",)}
    more["scales"] = (Fraction(3),)
    whole = run(tmp_path / "a", **more)
    monkeypatch.setattr("lae_sim.study.plan.CHUNK_FRAMES", 2 * 2400)
    parts = run(tmp_path / "b", **more)
    assert len(parts.plan.cells) == 3 * len(whole.plan.cells)
    keys = ["trace", "forecaster", "repetition", "sequence"]
    tables = [r.to_frame().sort_values(keys, ignore_index=True) for r in (whole, parts)]
    pd.testing.assert_frame_equal(*tables)
    assert whole.summary == parts.summary
    assert whole.comparisons == parts.comparisons
    assert all(row.ranked_by == "modelled" for row in whole.summary)


def test_jitter_has_its_own_interval_and_probability(tmp_path: Path) -> None:
    results = run(tmp_path, latencies=("recorded", "bootstrap"), repetitions=20)
    rows = {(row["trace"], row["latency"]): row
            for row in flat_rows(results.summary) if row["forecaster"] == "hold"}  # fmt: skip
    drawn = rows["synthetic-slow", "bootstrap"]
    table = results.to_frame().query(
        "trace == 'synthetic-slow' and latency == 'bootstrap' and forecaster == 'hold'"
    )
    means = table.groupby("repetition")["auc"].mean()
    assert len(means) == drawn["repetitions"] == 20
    ends = np.quantile(means, [0.025, 0.975])
    assert [drawn["auc_jitter_low"], drawn["auc_jitter_high"]] == pytest.approx(ends.tolist())
    assert "auc_jitter_low" not in rows["synthetic-slow", "recorded"]
    for pair in flat_rows(results.comparisons):
        a, b = (
            results.to_frame()
            .query(f"trace == '{name}' and latency == '{pair['latency']}'")
            .query(f"forecaster == '{pair['forecaster']}'")
            .groupby("repetition")["auc"].mean().to_numpy()
            for name in (pair["a"], pair["b"])
        )  # fmt: skip
        wins = (a[:, None] > b).mean() + (a[:, None] == b).mean() / 2
        assert pair["better_here"] == (None if len(a) == 1 else pytest.approx(wins))
        assert pair["difference"] == pytest.approx(a.mean() - b.mean())


def test_times_of_another_device(tmp_path: Path) -> None:
    slow = lae_sim.read_trace(SLOW)
    device = {"model": "other"}
    document = {**slow.metadata.document, "device": device}
    recordings = [lae_sim.Recording.new(r.name, r.truth, r.boxes, r.elapsed_ns * 2) for r in slow]
    other = tmp_path / "other.parquet"
    lae_sim.write_trace(lae_sim.Trace(lae_sim.Metadata.of(document), recordings), other)
    results = run(
        tmp_path / "out",
        Study((str(SLOW), str(FAST)), timing=(str(other),), sequences=FEW, forecasters=("hold",)),
    )
    assert {(row["trace"], row["times_from"]) for row in flat_rows(results.summary)} == {
        ("synthetic-slow", "synthetic-slow"),
        ("synthetic-slow", "other"),
        ("synthetic-fast", "synthetic-fast"),
    }
    twice = run(tmp_path / "twice", forecasters=("hold",), scales=(Fraction(2),))
    theirs = next(row["auc"] for row in flat_rows(results.summary) if row["times_from"] == "other")
    assert theirs == next(
        r["auc"] for r in flat_rows(twice.summary) if r["trace"] == "synthetic-slow"
    )


def test_what_a_required_auc_asks_for_is_true(tmp_path: Path) -> None:
    study = Study((str(SLOW),), forecasters=("hold",), require_auc=Fraction(55, 100))
    (found,) = flat_rows(run(tmp_path, study).required)
    trace = lae_sim.read_trace(SLOW)

    def auc(scale: str) -> float:
        source = scaled(by_frame, Fraction(scale))
        runs = lae_sim.replay_trace(trace, latency=source)
        scores = evaluate_runs(runs, trace.metadata, {"hold": lae_sim.Hold}).scores["auc"]
        return float(scores.mean())

    assert found["auc"] == pytest.approx(auc(found["scale"]))
    assert found["beyond_auc"] == pytest.approx(auc(found["beyond"]))
    assert found["beyond_auc"] < 0.55 <= found["auc"]
    assert Fraction(found["beyond"]) - Fraction(found["scale"]) == Fraction(1, 100)
    assert found["speed_up"] == pytest.approx(1 / Fraction(found["scale"]))
    assert found["fps_at_most"] == pytest.approx(30 * Fraction(found["scale"]))
    paid = replace(study, costs=("hold=1ms",))  # whose time is not one in frames
    assert run(tmp_path / "paid", paid).required[0].fps_at_most is None
    study = Study((str(SLOW),), forecasters=("hold",), require_auc=Fraction(9, 10))
    (never,) = flat_rows(run(tmp_path / "never", study).required)
    assert (never["scale"], never["speed_up"], never["beyond"]) == (None, None, "0")
    assert never["auc_without_latency"] < 0.9


FAR: dict[str, Any] = {"latencies": ("constant:90ms,init=600ms",), "search": ("c=0.3",)}


def test_modelled_scores_are_those_of_replay(tmp_path: Path) -> None:
    results = run(tmp_path, sigmas=SIGMA_GRID, **FAR)
    single = lae_sim.evaluate(
        SLOW, latency=FAR["latencies"][0], search="c=0.3", sigma="grid", sequences=FEW
    )
    keys = ["sequence", "forecaster", "sigma"]
    table = results.to_frame().query("trace == 'synthetic-slow'").set_index(keys).sort_index()
    expected = single.to_frame().set_index(keys).sort_index()
    for name in ("modelled_auc", "modelled_auc_low", "modelled_auc_high", "modelled_dp20_high"):
        np.testing.assert_array_equal(table[name], expected[name])
    assert (table["lost_share"] > 0).any()
    rows = {(r["trace"], r["forecaster"], r["sigma"]): r for r in flat_rows(results.summary)}
    means = single.summary.set_index(["forecaster", "sigma"])
    for forecaster in ("hold", "kalman"):
        first = rows["synthetic-slow", forecaster, "0"]
        for name in ("modelled_auc", "modelled_auc_low", "modelled_auc_high", "modelled_dp20_low"):
            assert first[name] == pytest.approx(means.loc[(forecaster, 0.0), name], abs=1e-11)
        assert first["c_known"]
        assert 0 < first["lost_share"] < 1
        over = rows["synthetic-slow", forecaster, "mean"]
        assert over["modelled_auc"] == pytest.approx(means.loc[forecaster]["modelled_auc"].mean())
        assert over["modelled_auc_low"] < over["modelled_auc"] < over["modelled_auc_high"]
        later = rows["synthetic-slow", forecaster, "1/50"]
        assert later["modelled_auc"] == pytest.approx(means.loc[(forecaster, 0.02), "modelled_auc"])
        assert "modelled_auc_low" not in later


def test_a_known_reach_ranks_by_the_model_and_an_assumed_one_does_not(tmp_path: Path) -> None:
    results = run(tmp_path, **{**FAR, "search": ("c=0.3", "trace", "off")})
    table = results.to_frame().set_index(["search", "trace", "forecaster", "sequence"])
    table = table.sort_index()
    by_search = {"c=0.3": "modelled", "trace": "recorded", "off": "recorded"}
    for row in results.summary:
        assert row.ranked_by == by_search[row.search]
        scores = table.loc[(row.search, row.trace, row.forecaster)]
        hold = table.loc[(row.search, row.trace, "hold")]
        name = "modelled_auc" if row.ranked_by == "modelled" else "auc"
        assert row.score("auc") == pytest.approx(scores[name].mean())
        if row.forecaster == "kalman":
            certainty = row.certainty("auc")
            assert certainty is not None
            assert certainty.vs_hold is not None
            won = scores[name].mean() - hold[name].mean()
            assert certainty.vs_hold.value == pytest.approx(won)
        assert (row.modelled is None) == (row.search == "off")
        assert ("modelled_auc" in row.flat()) == (row.search != "off")
    for pair in results.comparisons:
        name = "modelled_auc" if pair.ranked_by == "modelled" else "auc"
        a, b = (table.loc[(pair.search, each, pair.forecaster), name] for each in (pair.a, pair.b))
        assert pair.ranked_by == by_search[pair.search]
        assert pair.difference.value == pytest.approx(a.mean() - b.mean())
    assert "all traces: modelled: c = 0.3, as given" in results.notes()
    assert results.ranked_by() == [
        "ranked by the modelled scores: the reach is given or measured",
        "ranked by the scores of the recorded boxes: the reach is unknown, and the model's are for "
        "a range of it",
    ]
    off = run(tmp_path / "off", **{**FAR, "search": ("off",)})
    assert not any("model" in note for note in off.notes())
    assert off.ranked_by() == []
    recorded = {(r.trace, r.forecaster): r for r in results.summary if r.search == "off"}
    assert {(r.trace, r.forecaster): r for r in off.summary} == recorded


def test_the_tables_and_the_page_say_by_what_they_rank(tmp_path: Path) -> None:
    keys = {"latencies": [FAR["latencies"][0]], "search": ["c=0.3", "off"]}
    alone = ("--workers", 1)
    printed = study_here(toml(tmp_path, **keys), *alone, cwd=tmp_path)
    caption, header, *_ = printed.partition("\n\n")[2].splitlines()  # after the verdict
    assert "ranked by" in header
    assert "modelled scores, and recorded" in caption
    assert "not computed" not in printed
    assert "the reach is given or measured" in " ".join(printed.split())
    one = study_here(toml(tmp_path, **{**keys, "search": "c=0.3"}), *alone, cwd=tmp_path)
    assert "best: modelled AUC" in one.partition("\n\n")[0]
    caption = one.partition("\n\n")[2].splitlines()[0]
    assert caption.endswith("sigma 0, modelled scores")
    assert "Trackers against each other, by the modelled AUC" in one
    page = (tmp_path / "study-results" / "report.html").read_text()
    assert "all traces: modelled: c = 0.3, as given" in page
    assert "ranked by the modelled scores: the reach is given or measured" in page
    assert ", of the recorded boxes" in page  # the curves
    ranking = pd.read_csv(tmp_path / "study-results" / "tables" / "ranking.csv")
    assert ranking["modelled_auc"].is_monotonic_decreasing
    assert (ranking["modelled_auc_low"] < ranking["modelled_auc"]).all()
    summary = pd.read_csv(tmp_path / "study-results" / "summary.csv")
    best = summary.sort_values("modelled_auc", ascending=False)
    np.testing.assert_array_equal(ranking["modelled_auc"], best["modelled_auc"])
    np.testing.assert_array_equal(
        ranking["vs_hold_auc"].fillna(0), best["vs_hold_modelled_auc"].fillna(0)
    )
    off = study_here(toml(tmp_path, **{**keys, "search": "off"}), *alone, cwd=tmp_path)
    assert "model" not in off
    assert "ranked" not in off


def test_a_sweep_of_the_reach_is_drawn(tmp_path: Path) -> None:
    results = run(tmp_path, **{**FAR, "search": ("c=0.2", "c=0.3", "c=0.4")})
    lae_sim.write_report(results, tmp_path / "page.html")
    assert "Over reach c: policy latest" in (tmp_path / "page.html").read_text()


def test_gap_passes_find_their_traces_and_are_inputs(tmp_path: Path) -> None:
    gaps = gap_pass(lae_sim.read_trace(SLOW).metadata, tmp_path / "slow.gaps.parquet")
    study = Study(
        (str(SLOW), str(FAST)), sequences=FEW, passes=(str(gaps),), latencies=FAR["latencies"]
    )
    results = run(tmp_path / "out", study)
    rows = {(row.trace, row.forecaster): row for row in results.summary}
    expected = lae_sim.evaluate(
        SLOW, latency=FAR["latencies"][0], passes=gaps, sequences=FEW
    ).summary.set_index("forecaster")
    for forecaster in ("hold", "kalman"):
        row = rows["synthetic-slow", forecaster].flat()
        assert row["c_known"]
        for name in ("modelled_auc", "modelled_auc_low", "modelled_auc_high", "modelled_dp20_low"):
            assert row[name] == pytest.approx(expected.loc[forecaster, name], abs=1e-11)
        fast = rows["synthetic-fast", forecaster]
        assert fast.modelled is not None
        assert not fast.modelled.known
        assert fast.ranked_by == "recorded"  # as is all that it is compared with
    assert results.plan.sources[-1].input.path == str(gaps)
    assert run(tmp_path / "out", study).computed == 0
    gap_pass(lae_sim.read_trace(SLOW).metadata, gaps, centre=0.5)
    assert run(tmp_path / "out", study).computed == 2  # those of its trace
    alone = gap_pass(lae_sim.read_trace(FAST).metadata, tmp_path / "fast.gaps.parquet")
    only = replace(study, traces=(str(SLOW),), passes=(str(alone),))
    assert run(tmp_path / "only", only).scores[0].known  # a single trace takes what it is given
    strange = replace(study, traces=(str(SLOW), str(REAL_TIME)), passes=(str(alone),))
    with pytest.raises(LaeError, match=r"a pass is of fast-and-rough on synthetic: none of the"):
        run(tmp_path / "strange", strange)


def test_strided_passes_go_with_random_times(tmp_path: Path) -> None:
    slow = lae_sim.read_trace(SLOW)
    document = json.loads(json.dumps(slow.metadata.document))
    document["schedule"]["stride"] = "2"
    recordings = [lae_sim.Recording.new(r.name, r.truth, r.boxes + 3, r.elapsed_ns) for r in slow]
    strided = tmp_path / "strided.parquet"
    lae_sim.write_trace(lae_sim.Trace(lae_sim.Metadata.of(document), recordings), strided)
    study = Study(
        (str(SLOW),), sequences=FEW, passes=(str(strided),), latencies=("bootstrap",),
        scales=(Fraction(3),), repetitions=2, seed=5, search=("c=0.3",),
    )  # fmt: skip
    table = run(tmp_path / "out", study).to_frame().query("repetition == 0")
    expected = lae_sim.evaluate(
        SLOW, latency="bootstrap:5:30", scale=3, passes=strided, sequences=FEW, search="c=0.3"
    ).to_frame()
    keys = ["forecaster", "sequence"]
    for name in ("auc", "modelled_auc"):
        got, wanted = (each.set_index(keys).sort_index()[name] for each in (table, expected))
        np.testing.assert_array_equal(got, wanted)
    plain = lae_sim.evaluate(SLOW, latency="bootstrap:5:30", scale=3, sequences=FEW).to_frame()
    assert not np.array_equal(plain["auc"], expected["auc"])


def test_the_four_rows_of_the_paper(tmp_path: Path) -> None:
    results = run(
        tmp_path, Study((str(SLOW),), sequences=FEW, pre_forecaster=("none", "kalman"),
                        keep_size=True, **FAR),
    )  # fmt: skip
    assert len({cell.key for cell in results.plan.cells}) == 4
    rows = {(row.pre_forecaster, row.forecaster): row for row in results.summary}
    for name, pre in (("none", {}), ("kalman, size kept", {"keep_size": True})):
        expected = lae_sim.evaluate(
            SLOW, latency=FAR["latencies"][0], search="c=0.3", sequences=FEW,
            pre_forecaster="kalman" if pre else None, **pre,
        ).summary.set_index("forecaster")  # fmt: skip
        for forecaster in ("hold", "kalman"):
            modelled = rows[name, forecaster].modelled
            assert modelled is not None
            assert modelled.scores["auc"] == pytest.approx(expected.loc[forecaster, "modelled_auc"])
    assert rows["none", "hold"].modelled != rows["kalman, size kept", "hold"].modelled
    for name, said in (
        ("nobody", "pre_forecaster: no forecaster 'nobody'"),
        ("tuned-kalman", "pre_forecaster: tuned-kalman must be trained"),
    ):
        with pytest.raises(LaeError, match=said):
            run(tmp_path / "none", pre_forecaster=(name,))


def test_a_required_auc_is_that_of_the_ranking(tmp_path: Path) -> None:
    study = Study(
        (str(SLOW),), sequences=FEW, forecasters=("hold",), require_auc=Fraction(45, 100),
        latencies=("constant:90ms",), search=("c=0.3", "off"),
    )  # fmt: skip
    modelled, recorded = run(tmp_path, study).required
    assert (modelled.ranked_by, recorded.ranked_by) == ("modelled", "recorded")

    def auc(scale: Fraction | None, name: str) -> float:
        found = lae_sim.evaluate(
            SLOW, latency="constant:90ms", scale=scale, search="c=0.3", sequences=FEW
        ).summary.query("forecaster == 'hold'")
        return float(found["auc" if found["exact"].all() else name].iloc[0])

    for one, name in ((modelled, "modelled_auc"), (recorded, "auc")):
        assert one.auc == pytest.approx(auc(one.scale, name))
        assert one.beyond_auc == pytest.approx(auc(one.beyond, name))
    assert modelled.scale is not None
    assert recorded.scale is not None
    assert modelled.scale < recorded.scale


def test_times_that_belong_to_no_trace_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"timing: .*none of the traces is of the same tracker"):
        run(tmp_path, Study((str(SLOW),), timing=(str(FAST),)))
    assert not list(tmp_path.iterdir())


def test_what_the_means_rest_on_is_said(tmp_path: Path) -> None:
    few = tmp_path / "few.parquet"
    trace = lae_sim.read_trace(SLOW, FEW[:2])
    lae_sim.write_trace(trace, few)
    study = Study((str(FAST), str(few)), sequences=(), costs=("kalman=2ms",))
    notes = run(tmp_path / "out", study).notes()
    assert "synthetic: its traces do not have the same sequences: compare no means" in notes
    assert "all traces: times: synthetic (made up, not measured)" in notes
    assert "answers come later by what forecasting costs: kalman 2000 us" in notes
    floor = "a floor of one frame for synthetic-fast, though almost no frame is skipped: "
    assert [note.startswith(floor) for note in notes if "floor" in note] == [True]


# ------------------------------------------------------------------------------ resuming


@pytest.fixture
def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each piece of work by itself, and each cell in a file of its own, as if they were large."""
    monkeypatch.setattr("lae_sim.study.work.BATCH", 1)


@pytest.mark.usefixtures("one_by_one")
def test_only_what_is_missing_or_changed_is_computed(tmp_path: Path) -> None:
    mine = tmp_path / "mine.parquet"
    shutil.copy(SLOW, mine)
    out = tmp_path / "out"
    study = Study((str(mine), str(FAST)), sequences=FEW)
    first = run(out, study)
    assert (first.computed, len(list((out / "results").iterdir()))) == (4, 4)
    before = contents(out)
    assert run(out, study).computed == 0
    assert contents(out) == before

    next(iter((out / "results").glob("*.parquet"))).unlink()
    assert run(out, study).computed == 1
    assert contents(out) == before

    more = Study((str(mine), str(FAST)), sequences=FEW, forecasters=("hold", "constant-velocity"))
    changed = run(out, more)  # kalman is set aside
    assert changed.computed == 2
    assert set(changed.to_frame()["forecaster"]) == {"hold", "constant-velocity"}
    assert set(pd.read_parquet(out / "results")["forecaster"]) == {"hold", "constant-velocity"}
    assert run(out, study).computed == 0  # and taken back
    assert set(pd.read_parquet(out / "results")["forecaster"]) == {"hold", "kalman"}

    shutil.copy(FAST, mine)  # other content under the same name
    assert run(out, study).computed == 2
    rows = {(row["trace"], row["forecaster"]): row["auc"] for row in flat_rows(first.summary)}
    again = {(r["trace"], r["forecaster"]): r["auc"] for r in flat_rows(run(out, study).summary)}
    assert again["mine", "hold"] == rows["synthetic-fast", "hold"] != rows["mine", "hold"]


def test_small_cells_share_files_that_are_divided_when_a_study_wants_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scales = tuple(map(Fraction, (1, 2, 3)))
    whole = Study((str(SLOW), str(FAST)), sequences=FEW, scales=scales)
    part = Study((str(FAST),), sequences=FEW, scales=scales[1:])
    out, alone = tmp_path / "out", tmp_path / "alone"
    assert run(out, whole).computed == 12
    assert len(list((out / "results").iterdir())) == 1
    kept = run(out, part)
    assert kept.computed == 0
    table = pd.read_parquet(out / "results")
    assert set(table["scale"]) == {"2", "3"}
    assert len(list((out / "results").iterdir())) == len(list((out / "unused").iterdir())) == 1
    with monkeypatch.context() as patched:
        patched.setattr("lae_sim.study.work.BATCH", 1)
        fresh = run(alone, part)
        assert len(list((alone / "results").iterdir())) == 4
    assert (fresh.summary, fresh.comparisons) == (kept.summary, kept.comparisons)
    pd.testing.assert_frame_equal(fresh.to_frame(), kept.to_frame())
    again = run(out, whole)
    assert again.computed == 0
    assert len(again.to_frame()) == 12 * len(FEW)
    assert not list((out / "unused").iterdir())


def test_what_was_computed_before_a_cell_failed_is_not_kept_twice(tmp_path: Path) -> None:
    (tmp_path / "confused_of_study.py").write_text(OWN)
    path = toml(
        tmp_path, forecasters=["confused_of_study:Confused"], conventions=["pysot", "otb"],
        scales=[1, 2],
    )  # fmt: skip
    study_command(path, "--no-report", "--out", tmp_path / "out", cwd=tmp_path, status=1)
    table = pd.read_parquet(tmp_path / "out" / "results")
    assert len(list((tmp_path / "out" / "results").iterdir())) == 1
    assert set(table["forecaster"]) == {"hold"}
    assert not table.duplicated(["trace", "scale", "convention", "sequence"]).any()


def test_pairs_are_kept_and_only_those_of_others_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study((str(SLOW), str(FAST)), sequences=FEW)
    first = run(tmp_path, study)
    before = contents(tmp_path)
    compared: list[str] = []
    pairs = Rivals.pairs

    def counted(rivals: Rivals) -> Pairs:
        compared.append(rivals.setting["forecaster"])
        return pairs(rivals)

    monkeypatch.setattr(Rivals, "pairs", counted)
    again = run(tmp_path, study)
    assert (compared, again.comparisons, contents(tmp_path)) == ([], first.comparisons, before)
    more = Study((str(SLOW), str(FAST)), sequences=FEW, forecasters=("constant-velocity", "kalman"))
    assert len(run(tmp_path, more).comparisons) == 3
    assert compared == ["constant-velocity"]
    table = pd.read_parquet(tmp_path / "comparisons.parquet")
    csv = pd.read_csv(tmp_path / "comparisons.csv", dtype={"fps": str, "scale": str, "sigma": str})
    pd.testing.assert_frame_equal(table[csv.columns], csv, check_dtype=False)
    with open(tmp_path / "comparisons.parquet", "ab") as file:
        file.write(b"cut")
    compared.clear()
    run(tmp_path, more)
    assert compared == ["hold", "constant-velocity", "kalman"]


def test_what_was_resampled_is_kept_until_something_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lae_sim.study import summary, uncertainty

    mine, out = tmp_path / "mine.parquet", tmp_path / "out"
    shutil.copy(SLOW, mine)
    study = Study((str(mine), str(FAST)), sequences=FEW)
    first = run(out, study)
    before = contents(out)
    asked: list[str] = []

    def counted(kind: str) -> Callable[..., Any]:
        answered = getattr(uncertainty, kind)

        def count(some: Sequence[Any], how: Any) -> Any:
            asked.extend([kind] * len(some))
            return answered(some, how)

        return count

    def asked_now(study: Study) -> dict[str, int]:
        asked.clear()
        results = run(out, study)
        there = {kind: asked.count(kind) for kind in ("uncertainties", "differences")}
        assert results.summary == tuple(summary.summarise_study(results.scores, study.seed))
        return there

    for kind in ("uncertainties", "differences"):
        monkeypatch.setattr(summary, kind, counted(kind))
    none, everything = (dict(zip(("uncertainties", "differences"), n)) for n in ((0, 0), (8, 3)))
    again = run(out, study)
    assert (asked, again.summary, contents(out)) == ([], first.summary, before)
    assert asked_now(replace(study, seed=1)) == everything  # of 4 cells AUC and DP; of 3 worse
    assert asked_now(study) == everything  # the last study's are kept, no others
    assert asked_now(replace(study, conventions=("pysot", "otb"))) == everything  # of the new one
    assert asked_now(study) == none
    _edited(out / "about" / "answers.json")
    assert asked_now(study) == everything
    kept = "about/answers.json"
    assert contents(out)[kept] == before[kept]
    shutil.copy(FAST, mine)
    assert asked_now(study)["uncertainties"] == 4
    answers = uncertainty.Answers()
    for resamples, more in ((10, 8), (10, 0), (11, 8)):
        asked.clear()
        summary.summarise_study(first.scores, resamples=resamples, answers=answers)
        assert asked.count("uncertainties") == more


def test_the_summary_of_a_finished_study_is_not_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study((str(SLOW), str(FAST)), sequences=FEW)
    first = run(tmp_path, study)
    before = contents(tmp_path)
    written: list[str] = []
    write = lae_sim.study.run.write_csv
    monkeypatch.setattr(
        "lae_sim.study.run.write_csv",
        lambda records, path: (written.append(path.name), write(records, path)),
    )
    again = run(tmp_path, study)
    assert (written, contents(tmp_path)) == ([], before)
    assert list(again.traces) == list(first.traces) == again.traces[:]
    assert len(again.traces) == 2
    both = ["summary.csv", "comparisons.csv"]
    for damage in (Path.unlink, _edited):
        for name in ("summary.csv", "study.json"):
            damage(tmp_path / name)
            run(tmp_path, study)
            assert (written, contents(tmp_path)) == (both, before)
            written.clear()
    (tmp_path / "required.csv").write_text("of another study")
    run(tmp_path, study)
    assert (written, contents(tmp_path)) == (both, before)
    run(tmp_path, replace(study, seed=1))
    assert written == both * 2
    assert contents(tmp_path)["study.json"] != before["study.json"]


def test_of_many_pairs_those_with_the_best_are_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        shutil.copy(SLOW if name == "b" else FAST, tmp_path / f"{name}.parquet")
    study = Study((str(tmp_path / "*.parquet"),), sequences=FEW, forecasters=("hold",))
    whole = run(tmp_path / "out", study)
    assert [(pair.a, pair.b) for pair in whole.comparisons] == [("a", "b"), ("a", "c"), ("b", "c")]
    monkeypatch.setattr("lae_sim.study.comparisons.MOST", 2)
    some = run(tmp_path / "out", study)
    best = max(some.summary, key=lambda row: row.scores["auc"]).run
    assert some.pairs == whole.pairs == 3
    assert some.comparisons == tuple(p for p in whole.comparisons if best in (p.a, p.b))
    assert len(pd.read_parquet(tmp_path / "out" / "comparisons.parquet")) == 3


@pytest.mark.parametrize(
    ("keys", "cells", "changed"),
    [
        ({"forecasters": ["code_of_study:partial"]}, 2, 1),
        ({"policies": ["latest", "code_of_study:policy"]}, 4, 2),
    ],
)
def test_the_code_of_a_plug_in_is_an_input(
    keys: dict[str, Any], cells: int, changed: int, tmp_path: Path
) -> None:
    (tmp_path / "code_of_study.py").write_text(OWN)
    path = toml(tmp_path, traces=[str(FAST)], **keys)
    asked = (path, "--no-report", "--workers", 1)
    for computed in (cells, 0):
        assert f"{computed} of them computed" in study_command(*asked, cwd=tmp_path)
    (tmp_path / "code_of_study.py").write_text(OWN + "# changed\n")
    assert f"{changed} of them computed" in study_command(*asked, cwd=tmp_path)


@pytest.mark.parametrize("name", ["learned", "guarded+learned:f.npz"])
def test_the_weights_of_a_network_are_an_input(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lae_sim.forecast.learned.SHIPPED", tmp_path / "f.npz")
    study = Study((str(FAST),), forecasters=("hold", name))
    for seed, computed in ((0, 2), (0, 0), (1, 1)):
        write_learned(random_learned(seed), "f.npz")
        results = run(tmp_path / "out", study)
        assert results.computed == computed
        assert any(random_learned(seed).network.digest[:16] in note for note in results.notes())


def test_what_is_trained_is_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = Study((str(SLOW),), forecasters=("tuned-kalman",))
    results = run(tmp_path, study)
    notes = results.notes()
    assert any("trained in 5 folds over 8 sequences" in note for note in notes)
    table = score_forecasters({"slow": lae_sim.read_trace(SLOW)}, {"tuned-kalman": KalmanTrainer()})
    scores = table.query("forecaster == 'tuned-kalman' and metric == 'auc'").set_index("sequence")
    found = results.to_frame().query("forecaster == 'tuned-kalman'").set_index("sequence")
    assert found["auc"].to_dict() == scores["value"].to_dict()
    monkeypatch.setattr("lae_sim.study.plan.fitted", None)
    again = run(tmp_path, study)
    assert (again.computed, again.notes()) == (0, notes)


def test_a_study_that_was_killed_goes_on(tmp_path: Path) -> None:
    path = toml(
        tmp_path, scales=[1, 2, 3, 4, 5, 6, 7, 8], latencies=["recorded", "bootstrap"],
        repetitions=40,
    )  # fmt: skip
    out = tmp_path / "out"
    asked = command("study", path, "--out", out, "--workers", 1, "--no-report")
    with subprocess.Popen(asked, env=ENVIRONMENT, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120
        while len(list(out.glob("results/[!.]*.parquet"))) < 3 and time.monotonic() < deadline:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    names = ["trace", "latency", "scale", "forecaster"]
    done = len(pd.read_parquet(out / "results")[names].drop_duplicates())
    assert 3 <= done < 64
    told = study_command(*asked[6:], cwd=tmp_path)
    assert f"64 cells, {64 - done} of them computed now" in told
    whole = tmp_path / "whole"
    study_here(path, "--out", whole, "--workers", 1, "--no-report", cwd=tmp_path)
    left = {k: v for k, v in contents(out).items() if not Path(k).name.startswith(".")}
    assert left == contents(whole)


# ------------------------------------------------------------------------------ workers


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study with everything in it, computed in this process."""
    folder = tmp_path_factory.mktemp("alone")
    compute_study(BROAD, folder, workers=1)
    return folder


BROAD = Study(
    (str(SLOW), str(FAST)),
    sequences=FEW,
    latencies=("recorded", "bootstrap", "lognormal"),
    scales=(Fraction(1), Fraction(2)),
    repetitions=6,
    require_auc=Fraction(1, 2),
)


def test_results_are_the_same_bytes_for_any_number_of_workers(alone: Path, tmp_path: Path) -> None:
    compute_study(BROAD, tmp_path, workers=3)
    assert contents(tmp_path) == contents(alone)


MORTAL = """
import multiprocessing
import os
import pathlib
import signal

class Mortal:
    def __init__(self, box, image_size=None):
        self.box = box
        if multiprocessing.parent_process():  # in a worker
            take_a_life()
    def update(self, frame, box):
        self.box = box
    def predict(self, frame):
        return self.box

def take_a_life():
    for life in sorted(pathlib.Path(__file__).with_name("lives").iterdir()):
        try:
            life.unlink()
        except FileNotFoundError:  # another worker took it
            continue
        if life.name == "last":
            os.kill(os.getpid(), signal.SIGKILL)
        return
"""


@pytest.mark.filterwarnings("default")  # Dask's own
def test_a_cluster_that_loses_a_worker_gives_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra distributed is not there")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("lae_sim.study.work.BATCH", 1)  # each piece of work is handed out alone
    (tmp_path / "mortal_of_study.py").write_text(MORTAL)
    forecasters = ("hold", "kalman", "mortal_of_study:Mortal")
    smaller: dict[str, Any] = {
        "sequences": FEW[:2],
        "latencies": BROAD.latencies[:2],
        "repetitions": 2,
    }
    study = replace(BROAD, forecasters=forecasters, **smaller)
    compute_study(study, tmp_path / "alone", workers=1)
    # more lives than the six pieces of work take that are handed out before one is finished
    (tmp_path / "lives").mkdir()
    for life in [*map(str, range(10, 34)), "last"]:
        (tmp_path / "lives" / life).touch()
    finished: list[int] = []

    def progress(what: str, done: int, total: int) -> None:
        finished.extend([done] if (tmp_path / "lives" / "last").exists() else [])

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        results = compute_study(
            study, tmp_path / "out", scheduler=cluster.scheduler_address, progress=progress
        )
    assert not [*(tmp_path / "lives").iterdir()]
    assert 0 < max(finished) < 22  # pieces when a worker was lost
    assert not results.failures
    assert contents(tmp_path / "out") == contents(tmp_path / "alone")


def test_without_a_scheduler_at_the_address(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra distributed is not there")
    path = toml(tmp_path)
    told = study_here(path, "--scheduler", "tcp://127.0.0.1:9", cwd=tmp_path, status=2)
    assert "no Dask scheduler at 'tcp://127.0.0.1:9'" in told


# ------------------------------------------------------------------------------ what goes wrong


def test_what_cannot_be_computed_is_told_and_the_rest_is_done(tmp_path: Path) -> None:
    conventions = ["pysot", "otb"]  # a replay that cannot be done is one failure for both
    path = toml(
        tmp_path, traces=[str(SLOW), str(REAL_TIME)], scales=[1, 2], conventions=conventions
    )
    told = study_here(path, "--no-report", "--json", "--workers", 1, cwd=tmp_path, status=1)
    document = json.loads(told)
    (failure,) = document["failures"]
    assert "synthetic-slow-realtime" in failure["of"]
    assert "the tracker skipped it" in failure["reason"]
    found = {(row["trace"], row["scale"]) for row in document["summary"]}
    assert ("synthetic-slow-realtime", "1") in found
    assert ("synthetic-slow-realtime", "2") not in found
    assert json.loads((tmp_path / "study-results" / "study.json").read_text()) == document


def test_an_own_policy_is_replayed_in_simpy_which_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "policy_of_study.py").write_text(OWN)
    results = run(tmp_path / "out", policies=("latest", "policy_of_study:policy"))
    engines = {row["policy"]: row["engine"] for row in flat_rows(results.summary)}
    assert engines == {"latest": "batch", "policy_of_study:policy": "simpy"}
    every = run(tmp_path / "every", policies=("every:2",))
    own = [row["auc"] for row in flat_rows(results.summary) if row["engine"] == "simpy"]
    assert own == [row["auc"] for row in flat_rows(every.summary)]


def test_a_worker_that_dies_is_told_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "deadly_of_study.py").write_text(OWN)
    path = toml(tmp_path, forecasters=["deadly_of_study:Deadly"], scales=[*range(1, 31)])
    told = study_command(path, "--workers", 2, cwd=tmp_path, status=2)
    assert "a worker died" in told
    assert "the same command goes on from there" in told
    assert told.count("\n") == 1


def test_a_forecaster_that_fails_costs_itself_alone(tmp_path: Path) -> None:
    (tmp_path / "confused_of_study.py").write_text(OWN)
    path = toml(tmp_path, forecasters=["kalman", "confused_of_study:Confused"])
    for workers in (1, 2):
        told = study_command(
            path, "--no-report", "--json", "--workers", workers, cwd=tmp_path, status=1
        )
        document = json.loads(told)
        assert {row["forecaster"] for row in document["summary"]} == {"hold", "kalman"}
        assert len(document["failures"]) == 2
        for failure in document["failures"]:
            assert "confused_of_study:Confused" in failure["of"]
            assert "ZeroDivisionError: of my own" in failure["reason"]


@pytest.mark.usefixtures("one_by_one")
def test_a_trace_that_changes_meanwhile_is_not_taken_for_what_it_was(tmp_path: Path) -> None:
    mine = tmp_path / "mine.parquet"
    shutil.copy(FAST, mine)

    def progress(what: str, done: int, total: int) -> None:
        if done == 1:
            shutil.copy(SLOW, mine)

    study = Study((str(mine),), sequences=FEW, scales=(Fraction(1), Fraction(2)))
    found = compute_study(study, tmp_path / "out", workers=1, progress=progress)
    assert found.computed == 2  # with the description of the trace, which is read for both
    assert ["changed since the study began" in each.reason for each in found.failures] == [True]
    assert {row.scale for row in found.summary} == {Fraction(1)}
    shutil.copy(FAST, mine)
    assert run(tmp_path / "out", study).computed == 2


def test_files_of_alike_names_keep_apart(tmp_path: Path) -> None:
    shutil.copy(SLOW, tmp_path / "a")
    shutil.copy(FAST, tmp_path / "a.parquet")
    study = Study((str(tmp_path / "a"), str(tmp_path / "a.parquet")), sequences=FEW)
    rows = flat_rows(run(tmp_path / "out", study).summary)
    assert len({row["auc"] for row in rows}) == len(rows) == 4


def test_a_folder_has_one_study_at_a_time(tmp_path: Path) -> None:
    from lae_sim.study.store import Store

    message = f"another study is at work there .process {os.getpid()} on .*wait"
    with Store(tmp_path).locked(), pytest.raises(LaeError, match=message):
        run(tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "mine.parquet").write_text("mine")
    with pytest.raises(LaeError, match="not of a study"):
        run(tmp_path)
    assert (tmp_path / "results" / "mine.parquet").read_text() == "mine"


def test_a_tracker_slower_than_its_sequences_has_no_time_of_a_call(tmp_path: Path) -> None:
    results = run(tmp_path, latencies=("constant:100s",), forecasters=("hold",))
    assert {row["elapsed_ms"] for row in flat_rows(results.summary)} == {None}
    assert not any(row["pareto"] for row in flat_rows(results.summary))
    lae_sim.write_report(results, tmp_path / "report.html")
    lae_sim.write_tables(results, tmp_path / "tables")


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"forecasters": ["kalmann"]}, "no forecaster 'kalmann'"),
        ({"traces": ["nothing/*.parquet"]}, "nothing/*.parquet: no trace is there"),
        ({"sequences": ["none"]}, "no sequence 'none'"),
        ({"scale": 2}, "unknown key 'scale': did you mean 'scales'?"),
        ({"costs": ["imm=2ms"]}, "there is no forecaster 'imm' here"),
    ],
)
def test_bad_studies_are_one_line_and_leave_nothing(
    keys: dict[str, Any], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = toml(tmp_path, **keys)
    assert main([str(path), "--out", str(tmp_path / "out"), "--workers", "1"]) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert told.err.count("\n") == 1
    assert not list((tmp_path / "out").glob("*.csv"))


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(LaeError, match="not of a study"):
        run(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of four cells, which are in one file."""
    folder = tmp_path_factory.mktemp("finished")
    run(folder)
    return folder


def _cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-50])


def _edited(path: Path) -> None:
    path.write_text(path.read_text().replace("1", "2", 1))


@pytest.mark.parametrize(
    "damage",
    [
        _cut_off,
        _edited,
        Path.unlink,
        lambda path: path.write_text("{"),
        lambda path: path.write_text("[1, 2]"),
        lambda path: path.write_text('{"notes": 1}'),
        lambda path: path.write_text("[" * 100_000),
        lambda path: path.write_bytes(b"\xff"),
    ],
)
def test_what_is_not_as_it_was_written_is_computed_again(
    finished: Path, tmp_path: Path, damage: Callable[[Path], object]
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "study"))
    whole = contents(folder)
    for path in (folder / "about").glob("*.json"):
        damage(path)
    assert run(folder).computed == 4
    assert contents(folder) == whole


@pytest.mark.usefixtures("one_by_one")
def test_a_cell_that_is_cut_off_is_computed_again(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    run(folder)
    (folder / "results" / "notes.txt").write_text("foreign")
    (folder / "about" / "mine").mkdir()
    whole = contents(folder)
    _cut_off(next(iter((folder / "results").glob("*.parquet"))))
    assert run(folder).computed == 1
    assert contents(folder) == whole


def test_a_cell_of_other_columns_says_what_to_do(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "study"))
    path = next(iter((folder / "results").glob("*.parquet")))
    size = path.stat().st_size
    pd.read_parquet(path)[["trace", "sigma"]].iloc[:1].to_parquet(path)
    other = path.read_bytes()
    path.write_bytes(b"PAR1" + b"\0" * (size - len(other)) + other[4:])  # as long as before
    with pytest.raises(LaeError, match=f"{path.name}: damaged: delete it"):
        run(folder)


@pytest.mark.parametrize(
    "name",
    [
        "summary.csv",
        "study.json",
        "report.html",
        "tables/ranking.tex",
        "tables",
        "figures",
        "contents.json",
    ],
)
def test_what_could_not_be_written_is_said_before_the_work(name: str, tmp_path: Path) -> None:
    run(tmp_path / "study")  # so that it is the folder of a study
    shutil.rmtree(tmp_path / "study" / "results")
    (tmp_path / "study" / "results").mkdir()
    place = tmp_path / "study" / name
    place.unlink(missing_ok=True)
    place.parent.mkdir(exist_ok=True)
    if name in ("tables", "figures"):
        place.write_text("mine")
    else:
        place.mkdir()
    with pytest.raises(LaeError, match=f"{place.name}: is there already"):
        run(tmp_path / "study")
    assert not list((tmp_path / "study" / "results").iterdir())


def test_the_columns_are_those_that_are_documented(tmp_path: Path) -> None:
    table = run(tmp_path).to_frame()
    assert list(table) == list(cell_rows.COLUMNS)
