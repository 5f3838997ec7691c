"""Evaluating in one call, against the rooms below and against the command line."""

from __future__ import annotations

import json
import pickle
import sys
import types
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import run_here
from matplotlib.figure import Figure
from nasty import NASTY, nasty_traces
from places import REPOSITORY, TRACES
from restarted import gap_pass

import lae_sim
from lae_sim.api.evaluation import SETTING
from lae_sim.boxes import iou
from lae_sim.engine import Clock, every
from lae_sim.evaluation import answers, evaluate_runs, success_curve
from lae_sim.evaluation.metrics import METRICS, PYSOT
from lae_sim.forecast import ConstantVelocity
from lae_sim.replay.latency import constant

SLOW, FAST = TRACES / "synthetic-slow.parquet", TRACES / "synthetic-fast.parquet"
TWO = {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman}


@pytest.fixture(scope="module")
def result() -> lae_sim.EvaluationResult:
    return lae_sim.evaluate(SLOW, latency="constant:47ms", sigma=[0, "1/2"])


@pytest.fixture(scope="module")
def by_hand() -> Any:
    """The same scores from the rooms below."""
    trace = lae_sim.read_trace(SLOW)
    clock = Clock.at(trace.metadata.fps)
    runs = [lae_sim.replay_sequence(each, clock, constant("47ms")) for each in trace]
    return evaluate_runs(runs, trace.metadata, TWO, (Fraction(0), Fraction(1, 2)))


# ---------------------------------------------------------------------------------------- scores


def test_scores_are_those_of_replaying_and_scoring_by_hand(
    result: lae_sim.EvaluationResult, by_hand: Any
) -> None:
    table = result.to_frame().set_index(["forecaster", "sequence", "sigma"]).sort_index()
    assert len(table) == 2 * 8 * 2
    for f, forecaster in enumerate(TWO):
        for s, sequence in enumerate(by_hand.replay.sequences):
            for m, sigma in enumerate((0.0, 0.5)):
                row = table.loc[(forecaster, sequence, sigma)]
                for metric in METRICS:
                    assert row[metric] == by_hand.scores[metric][f, s, m]
                    assert row[f"offline_{metric}"] == by_hand.offline[metric][s]
                assert row["world_frames"] == by_hand.replay.frames[s]
                assert row["processed"] == by_hand.replay.processed[s]
                assert row["approximate_outputs"] == by_hand.replay.departures[s]
                mean = by_hand.staleness.mismatch_sum[s, m] / by_hand.replay.frames[s]
                assert row["mismatch_mean"] == mean


def test_the_summary_is_the_mean_of_the_sequences(result: lae_sim.EvaluationResult) -> None:
    means = result.to_frame().groupby(["forecaster", "sigma"], sort=False).mean(numeric_only=True)
    summary = result.summary.set_index(["forecaster", "sigma"])
    assert len(summary) == 4
    for place in ("", "offline_"):
        for metric in METRICS:
            column = f"{place}{metric}"
            np.testing.assert_allclose(
                summary[column], means.loc[summary.index, column], atol=1e-12
            )
    hold, kalman = summary.loc[("hold", 0)], summary.loc[("kalman", 0)]
    lost = hold["offline_auc"] - hold["auc"]
    assert kalman["recovered_auc"] == pytest.approx((kalman["auc"] - hold["auc"]) / lost)
    assert np.isnan(hold["recovered_auc"])
    assert set(summary["sequences"]) == {8}


def test_tables_are_tidy(result: lae_sim.EvaluationResult) -> None:
    for table in (result.summary, result.to_frame()):
        assert isinstance(table, pd.DataFrame)
        assert list(table.columns[: len(SETTING)]) == list(SETTING)
        assert set(table["trace"]) == {"synthetic-slow.parquet"}
        assert set(table["latency"]) == {"constant:47ms"}
        assert set(table["fps"]) == {30.0}
        assert all(table[metric].dtype == np.float64 for metric in METRICS)
    assert not result.to_frame().duplicated(["sequence", "forecaster", "sigma"]).any()


def test_answers_are_those_of_the_room_below(result: lae_sim.EvaluationResult) -> None:
    trace = lae_sim.read_trace(SLOW)
    run = lae_sim.replay_sequence(trace["car-occluded"], Clock.at(Fraction(30)), constant("47ms"))
    for sigma in (Fraction(0), Fraction(1, 2)):
        expected = answers(run, trace.metadata, "kalman", lae_sim.Kalman, sigma)
        found = result.answers("car-occluded", "kalman", sigma=sigma)
        np.testing.assert_array_equal(found[list("xywh")], expected.boxes)
        np.testing.assert_array_equal(found["source_frame"], expected.source_frame)
        np.testing.assert_array_equal(found["frame"], np.arange(len(run)))
        truth = run.recording.truth
        np.testing.assert_array_equal(found[["truth_x", "truth_y", "truth_w", "truth_h"]], truth)
        np.testing.assert_array_equal(found["iou"], iou(expected.boxes, truth))
        row = result.to_frame().query(
            "sequence == 'car-occluded' and forecaster == 'kalman' and sigma == @at",
            local_dict={"at": float(sigma)},
        )
        curve = success_curve(truth, expected.boxes, PYSOT)
        assert row["auc"].item() == pytest.approx(curve.mean(), abs=1e-12)
    first = result.answers("car-occluded", "kalman")
    pd.testing.assert_frame_equal(first, result.answers("car-occluded", "kalman", sigma=0))


def test_answers_of_several_traces_are_told_apart_by_name() -> None:
    result = lae_sim.evaluate([SLOW, FAST], forecasters="hold", sequences="boat-calm")
    with pytest.raises(lae_sim.LaeError, match="trace: name one of synthetic-slow"):
        result.answers("boat-calm", "hold")
    found = [
        result.answers("boat-calm", "hold", trace=path.name)["source_frame"].mean()
        for path in (SLOW, FAST)
    ]
    assert found[0] < found[1]


# ----------------------------------------------------------------------------- the command line


def command(*arguments: object) -> dict[str, Any]:
    done = run_here("replay", *arguments, "--json", cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    return document


SLOW_HERE, FAST_HERE = "traces/synthetic-slow.parquet", "traces/synthetic-fast.parquet"
SAME: list[tuple[Sequence[str], dict[str, Any], Sequence[str]]] = [
    ([SLOW_HERE], {}, []),
    (
        [SLOW_HERE, FAST_HERE],
        {
            "forecasters": ["hold", "imm", "kalman:q=3,decay=0.99"],
            "sigma": [0, 0.1, "1/3"],
            "sequences": "boat-calm",  # since imm takes its time
        },
        [
            *("--forecaster", "hold", "imm", "kalman:q=3,decay=0.99"),
            *("--sigma", "0", "0.1", "1/3", "--sequence", "boat-calm"),
        ],
    ),
    (
        [SLOW_HERE],
        {"latency": "constant:47ms", "scale": [0.1, 1.5], "fps": [30, "30000/1001"]},
        [
            "--latency",
            "constant:47ms",
            "--latency-scale",
            "0.1",
            "1.5",
            "--fps",
            "30",
            "30000/1001",
        ],
    ),
    (
        [SLOW_HERE],
        {"timing": "traces/synthetic-slow-realtime.parquet", "latency": "by-call"},
        ["--timing", "traces/synthetic-slow-realtime.parquet", "--latency", "by-call"],
    ),
    ([FAST_HERE], {"sigma": "grid", "convention": "otb"}, ["--sigma-grid", "--convention", "otb"]),
    (
        [SLOW_HERE],
        {"costs": {"kalman": "2ms"}, "policy": "every:2", "sequences": ["boat-calm", "bike-pan"]},
        ["--cost", "kalman=2ms", "--policy", "every:2", "--sequence", "boat-calm", "bike-pan"],
    ),
]


@pytest.mark.parametrize(("traces", "settings", "options"), SAME, ids=range(len(SAME)))
def test_a_document_is_what_the_command_prints(
    traces: Sequence[str],
    settings: dict[str, Any],
    options: Sequence[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(REPOSITORY)
    result = lae_sim.evaluate(list(traces), **settings)
    assert json.loads(json.dumps(result.document())) == command(*traces, *options)
    detailed = result.document(per_sequence=True, attributes=True)
    printed = command(*traces, *options, "--per-sequence", "--attributes")
    assert json.loads(json.dumps(detailed)) == printed


# ------------------------------------------------------------------------------------- arguments


def test_numbers_are_exact_as_they_are_written() -> None:
    result = lae_sim.evaluate(SLOW, scale=[1.5, 0.1, "1/3", 2, np.float64(0.25), np.int64(3)])
    scales = [part.scenario.world.scale for part in result.parts]
    expected = [Fraction(3, 2), Fraction(1, 10), Fraction(1, 3), Fraction(2), Fraction(1, 4), 3]
    assert scales == expected
    assert all(type(scale.numerator) is int for scale in scales)
    world = lae_sim.evaluate(SLOW, fps=29.97, sigma=0.02).parts[0].scenario.world
    assert (world.fps, world.sigmas) == (Fraction(2997, 100), (Fraction(1, 50),))
    assert lae_sim.evaluate(SLOW, sigma="grid").parts[0].scenario.world.sigmas == (
        lae_sim.SIGMA_GRID
    )


def test_a_sweep_is_every_combination() -> None:
    result = lae_sim.evaluate(
        SLOW,
        forecasters="hold",
        policy=["latest", "fifo"],
        fps=[15, 30],
        latency=["recorded", "constant:20ms"],
        scale=[1, 2],
        sequences="boat-calm",
    )
    assert len(result.parts) == len(result.summary) == 16
    assert not result.summary.duplicated(["policy", "fps", "latency", "scale"]).any()
    alone = lae_sim.evaluate(
        SLOW, forecasters="hold", policy="fifo", fps=15, scale=2, sequences="boat-calm"
    )
    row = result.summary.query(
        "policy == 'fifo' and fps == 15 and scale == 2 and latency == 'recorded'"
    )
    assert row["auc"].item() == alone.summary["auc"].item()
    assert "and 15 more" in repr(result)


@dataclass
class EverySecond:
    """A policy that has no hash, as a user may write one."""

    n: int = 2

    def __call__(self, clock: Clock, calls: Sequence[Any]) -> tuple[int, int]:
        frame, _, ready = calls[-1]
        following = frame + self.n
        return following, max(ready, following * clock.frame_ticks)


def test_a_policy_of_ones_own_and_a_latency_of_ones_own() -> None:
    result = lae_sim.evaluate(SLOW, policy=[EverySecond(), "every:2", every(2)])
    assert result.summary["auc"].nunique() == 2  # of hold and of kalman
    assert set(result.summary["policy"]) == {"EverySecond", "every:2"}

    def forty_seven(recording: lae_sim.Recording) -> Any:
        return lambda frame: 47_000_000

    own = lae_sim.evaluate(SLOW, latency=[forty_seven, constant("47ms"), "constant:47ms"])
    assert own.summary["auc"].nunique() == 2
    assert list(own.summary["latency"].unique()) == ["forty_seven", "constant:47ms"]
    with pytest.raises(lae_sim.LaeError, match="latency: two are called '<lambda>'"):
        lae_sim.evaluate(SLOW, latency=[lambda r: int, lambda r: abs])


class Counted:
    """A latency that its first call decides: another one for each time that it is made."""

    made = 0

    def __init__(self) -> None:
        Counted.made += 1

    def __call__(self, recording: lae_sim.Recording) -> Any:
        return lambda frame: 47_000_000


def test_a_plug_in_is_made_once_for_all_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "counted", types.SimpleNamespace(Counted=Counted))
    Counted.made = 0
    result = lae_sim.evaluate(SLOW, latency="counted:Counted", scale=[1, 2, 3])
    assert Counted.made == 1
    assert set(result.summary["latency"]) == {"counted:Counted"}


def test_iterators_are_read_once() -> None:
    names = ["boat-calm", "car-chase"]
    result = lae_sim.evaluate(SLOW, sigma=iter([0, 0.5]), scale=iter([1, 2]), sequences=iter(names))
    table = result.to_frame()
    assert set(table["sequence"]) == set(names)
    assert set(table["sigma"]) == {0.0, 0.5}


def test_a_world_can_be_sent_to_a_worker() -> None:
    world = lae_sim.World.of(latency=constant("47ms"), policy=every(2), scale=1.5)
    assert pickle.loads(pickle.dumps(world)) == world
    assert hash(world) == hash(
        lae_sim.World.of(latency=constant("47ms"), policy=every(2), scale=1.5)
    )


class Drift:
    """A forecaster of one's own."""

    def __init__(self, box: Sequence[float], image_size: Any = None) -> None:
        self.box = box

    def update(self, frame: int, box: Sequence[float]) -> None:
        self.box = box

    def predict(self, frame: int) -> Sequence[float]:
        return self.box


def test_forecasters_of_ones_own() -> None:
    result = lae_sim.evaluate(SLOW, forecasters=[Drift, "kalman", ConstantVelocity])
    scores = result.summary.set_index("forecaster")["auc"]
    assert list(scores.index) == ["hold", "Drift", "kalman", "ConstantVelocity"]
    assert scores["Drift"] == scores["hold"]
    factory = lae_sim.load_forecaster("kalman:q=3")
    named = {"paper": "kalman", "agile": factory, "mine": lambda box, size: Drift(box)}
    aliases = lae_sim.evaluate(SLOW, forecasters=named).summary.set_index("forecaster")["auc"]
    assert list(aliases.index) == ["hold", "paper", "agile", "mine"]
    assert aliases["paper"] == scores["kalman"] != aliases["agile"]
    assert aliases["mine"] == scores["hold"]


def test_times_and_passes_may_be_open_traces() -> None:
    timing = lae_sim.read_trace(FAST)
    opened = lae_sim.evaluate(SLOW, timing=timing, scale=[1, 2])
    path = lae_sim.evaluate(SLOW, timing=FAST, scale=[1, 2])
    pd.testing.assert_frame_equal(opened.to_frame(), path.to_frame())
    assert opened.document()["traces"] == path.document()["traces"]


def test_of_several_traces_each_pass_goes_with_its_own(tmp_path: Path) -> None:
    slow = lae_sim.read_trace(SLOW)
    gaps = gap_pass(slow.metadata, tmp_path / "slow.gaps.parquet")
    result = lae_sim.evaluate([SLOW, FAST], passes=gaps, latency="constant:80ms")
    known = [part["search"]["c_known"] for part in result.document()["traces"]]
    assert known == [True, False]
    about = {"tracker": {"name": "another"}, "dataset": slow.metadata.document["dataset"]}
    other = gap_pass(lae_sim.Metadata.new("30", "every-frame", **about), tmp_path / "other.parquet")
    with pytest.raises(lae_sim.LaeError, match="a pass is of another on synthetic: none of the"):
        lae_sim.evaluate([SLOW, FAST], passes=other)


def test_a_world_does_not_forget_its_pre_forecaster() -> None:
    world = lae_sim.World.of(latency="constant:80ms", search="c=0.3", pre_forecaster="kalman")
    with pytest.raises(lae_sim.LaeError, match="pre_forecaster: give what 'kalman' stands for"):
        world.replay(SLOW)
    runs = world.replay(SLOW, pre_forecaster=lae_sim.load_forecaster("kalman"))
    assert all(run.modelled.forecast for run in runs)


def test_a_result_may_be_gone_through_again(result: lae_sim.EvaluationResult) -> None:
    runs = result.parts[0].scenario.runs
    assert [run.recording.name for run in runs] == [run.recording.name for run in runs]
    assert len(list(runs)) == 8


# -------------------------------------------------------------------------------------- displays


def test_repr_is_short(result: lae_sim.EvaluationResult, by_hand: Any) -> None:
    hold, kalman = by_hand.scores["auc"][:, :, 0].mean(axis=1)
    assert repr(result) == (
        "<EvaluationResult of synthetic-slow.parquet, constant:47ms: "
        f"AUC hold {hold:.4f}, kalman {kalman:.4f}>"
    )


def test_html_shows_what_differs_and_the_notes(result: lae_sim.EvaluationResult) -> None:
    html = result._repr_html_()
    assert html.startswith("<table")
    assert "<th>policy</th>" not in html
    assert "<th>sigma</th>" in html
    assert "approximate" in html
    assert "<th>policy</th>" in lae_sim.evaluate(SLOW, policy=["latest", "fifo"])._repr_html_()


def test_html_escapes_names(tmp_path: Path) -> None:
    paths = nasty_traces(tmp_path)
    trace = lae_sim.read_trace(paths[0])
    for result in (
        lae_sim.evaluate({NASTY: paths[0], "b": paths[1]}, forecasters={NASTY: lae_sim.Hold}),
        lae_sim.evaluate(lae_sim.Trace(trace.metadata, list(trace))),
    ):
        html = result._repr_html_()
        assert "<script" not in html
        assert "&lt;script&gt;" in html
        assert repr(result).startswith("<EvaluationResult of ")
        assert "\n" not in repr(result)


@pytest.mark.parametrize("traces", [[SLOW], [SLOW, FAST]])
def test_a_plot_has_a_line_for_each_trace_and_forecaster(traces: list[Path]) -> None:
    figure = lae_sim.evaluate(traces).plot()
    assert isinstance(figure, Figure)
    names = [[line.get_label().partition(" [")[0] for line in axes.lines] for axes in figure.axes]
    expected = ["offline", "hold", "kalman"]
    if len(traces) > 1:
        expected = [f"{path.stem}: {name}" for path in traces for name in expected]
    assert names == [expected, expected]
    assert [len(axes.lines[0].get_ydata()) for axes in figure.axes] == [21, 51]


def test_a_plot_of_a_sweep_is_over_what_was_swept() -> None:
    result = lae_sim.evaluate(SLOW, scale=[0.5, 1, 2])
    figure = result.plot()
    (auc, *_) = figure.axes
    lines = {line.get_label(): line for line in auc.lines}
    for forecaster in TWO:
        (line,) = [line for label, line in lines.items() if forecaster in label]
        expected = result.summary.query("forecaster == @forecaster")["auc"]
        np.testing.assert_allclose(np.sort(line.get_ydata()), np.sort(expected), atol=1e-12)


def test_a_plot_of_several_latencies_or_policies_has_all_of_them() -> None:
    latencies = ["constant:20ms", "constant:47ms"]
    figure = lae_sim.evaluate(SLOW, latency=latencies, policy=["latest", "fifo"]).plot()
    names = [line.get_label().partition(" [")[0] for line in figure.axes[0].lines]
    worlds = [f"{policy}, {latency}" for policy in ("latest", "fifo") for latency in latencies]
    assert names == [f"{w}: {name}" for w in worlds for name in ("offline", "hold", "kalman")]
    swept = lae_sim.evaluate(SLOW, latency=latencies, scale=[1, 2], forecasters="hold").plot()
    assert [axes.get_title() for axes in swept.axes[::2]] == latencies


def test_traces_of_different_rates_are_no_sweep(tmp_path: Path) -> None:
    trace = lae_sim.read_trace(SLOW)
    slower = lae_sim.Trace(lae_sim.Metadata.new(15, "every-frame"), list(trace))
    figure = lae_sim.evaluate({"a": trace, "b": slower}, forecasters="hold").plot()
    names = [line.get_label().partition(" [")[0] for line in figure.axes[0].lines]
    assert names == ["a: offline", "a: hold", "b: offline", "b: hold"]


def test_notebooks_show_a_figure_without_pyplot(result: lae_sim.EvaluationResult) -> None:
    png = result.plot()._repr_png_()  # type: ignore[attr-defined]
    assert png.startswith(b"\x89PNG")


def test_a_progress_bar_counts_world_frames(capsys: pytest.CaptureFixture[str]) -> None:
    lae_sim.evaluate(SLOW)
    assert capsys.readouterr() == ("", "")  # nobody looks
    lae_sim.evaluate(SLOW, progress=True, sequences=["boat-calm", "bike-pan"], scale=[1, 2])
    out, err = capsys.readouterr()
    assert out == ""
    assert "100%" in err
    assert "1.20k/1.20k" in err
    lae_sim.evaluate(SLOW, progress=False)
    assert capsys.readouterr() == ("", "")
    told = []
    lae_sim.evaluate(SLOW, sequences="boat-calm", progress=lambda *each: told.append(each))
    assert told == [(300, 300, "")]
    assert capsys.readouterr() == ("", "")
    with pytest.raises(
        lae_sim.LaeError, match="progress: 'yes' is neither true, false nor a function"
    ):
        lae_sim.evaluate(SLOW, progress="yes")


def test_a_video_without_truth_shows_itself_without_a_score(tmp_path: Path) -> None:
    trace = lae_sim.read_trace(SLOW, ["boat-calm"])
    [one] = trace
    one.truth[1:] = np.nan
    path = tmp_path / "video.parquet"
    lae_sim.write_trace(lae_sim.Trace(trace.metadata, [one]), path)
    result = lae_sim.evaluate(path)
    assert repr(result).endswith(": AUC hold -, kalman ->")
    assert result.summary[["auc", "dp20", "offline_auc"]].isna().all(axis=None)
    assert "nan" not in result._repr_html_().lower()
    with pytest.raises(
        lae_sim.LaeError, match="nothing to draw: no sequence has a ground truth after"
    ):
        result.plot()
