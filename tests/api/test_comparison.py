"""Comparing forecasters in one call, against the rooms below and against the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import run_here
from matplotlib.figure import Figure
from nasty import NASTY, nasty_traces
from places import REPOSITORY, TRACES

import lae_sim
from lae_sim.comparison.forecasters import score_forecasters
from lae_sim.comparison.statistics import over_sigmas, summarise
from lae_sim.learning.trainers import KalmanTrainer

SLOW, FAST = TRACES / "synthetic-slow.parquet", TRACES / "synthetic-fast.parquet"


@pytest.fixture(scope="module")
def result() -> lae_sim.ComparisonResult:
    return lae_sim.compare_forecasters(
        [SLOW, FAST], forecasters=["kalman", "least-squares"], search="off"
    )


def test_scores_are_those_of_evaluating(result: lae_sim.ComparisonResult) -> None:
    table = result.to_frame().query("metric == 'auc' and forecaster != 'offline'")
    evaluated = lae_sim.evaluate([SLOW, FAST], forecasters=["kalman", "least-squares"]).to_frame()
    keys = ["trace", "sequence", "forecaster"]
    values, expected = (each.set_index(keys).sort_index() for each in (table, evaluated))
    pd.testing.assert_series_equal(values["value"], expected["auc"], check_names=False)
    offline = result.to_frame().query("metric == 'auc' and forecaster == 'offline'")
    once = evaluated.query("forecaster == 'hold'")
    np.testing.assert_array_equal(
        offline.set_index(["trace", "sequence"]).sort_index()["value"],
        once.set_index(["trace", "sequence"]).sort_index()["offline_auc"],
    )


def test_the_summary_is_that_of_the_room_below(result: lae_sim.ComparisonResult) -> None:
    traces = {path.name: lae_sim.read_trace(path) for path in (SLOW, FAST)}
    forecasters = {
        name: lae_sim.load_forecaster(name) for name in ("hold", "kalman", "least-squares")
    }
    scores = score_forecasters(traces, forecasters, [lae_sim.World.of(search="off")])
    expected = summarise(scores, metrics=("auc", "dp20"), seed=0)
    pd.testing.assert_frame_equal(result.summary, expected)
    means = result.to_frame().groupby(["trace", "forecaster", "metric"])["value"].mean()
    for row in result.summary.itertuples():
        if row.trace in traces:
            assert row.mean == pytest.approx(means[row.trace, row.forecaster, row.metric])


def test_the_command_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    path = "traces/synthetic-slow.parquet"
    settings = {"latency": ["constant:20ms", "constant:47ms"], "scale": [1.5], "seed": 3}
    result = lae_sim.compare_forecasters(path, forecasters="kalman", **settings)
    options = "--latency constant:20ms constant:47ms --latency-scale 1.5 --seed 3 --attributes"
    done = run_here("compare", path, "--forecaster", "kalman", *options.split(), "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    for key, table in (("summary", result.summary), ("attributes", result.attributes)):
        rows = json.loads(table.to_json(orient="records", double_precision=15))
        assert len(rows) == len(document[key])
        for row, printed in zip(rows, document[key], strict=True):
            modelled = printed.pop("modelled", None) or {}
            assert set(modelled) >= {"c_known", "auc", "auc_low", "auc_high"} or not modelled
            for name, value in modelled.items():
                own = name in ("c_known", "lost_share")
                assert row.pop(name if own else f"modelled_{name}") == pytest.approx(value)
            row = {name: value for name, value in row.items() if name in printed}
            assert row == pytest.approx(printed, abs=1e-9)
    assert document["notes"] == result.notes


def test_what_must_be_trained_is_trained_on_other_sequences() -> None:
    result = lae_sim.compare_forecasters(SLOW, forecasters=["tuned-kalman"], folds=4)
    assert any("trained in 4 folds" in note for note in result.notes)
    same = lae_sim.compare_forecasters(SLOW, forecasters={"mine": KalmanTrainer()}, folds=4)
    by_class = lae_sim.compare_forecasters(SLOW, forecasters=KalmanTrainer, folds=4)
    scores = [
        each.to_frame().query("forecaster == @name", local_dict={"name": name})["value"].to_numpy()
        for each, name in ((result, "tuned-kalman"), (same, "mine"), (by_class, "KalmanTrainer"))
    ]
    np.testing.assert_array_equal(scores[0], scores[1])
    np.testing.assert_array_equal(scores[0], scores[2])


def test_the_grid_is_compared_as_means() -> None:
    result = lae_sim.compare_forecasters(SLOW, forecasters="kalman", sigma="grid", search="off")
    assert result.metrics == ("mauc", "mdp20")
    assert set(result.summary["metric"]) == {"mauc", "mdp20"}
    pd.testing.assert_frame_equal(
        result.summary, summarise(over_sigmas(result.scores), metrics=("mauc", "mdp20"), seed=0)
    )
    (row,) = result.summary.query("metric == 'mauc' and forecaster == 'kalman'").itertuples()
    one_by_one = lae_sim.evaluate(SLOW, sigma="grid").summary.query("forecaster == 'kalman'")
    assert row.mean == pytest.approx(one_by_one["auc"].mean())


def test_open_traces_keep_the_sequences_that_are_asked_for() -> None:
    trace = lae_sim.read_trace(SLOW)
    asked = ["boat-calm", "bike-pan", "car-chase"]
    opened = lae_sim.compare_forecasters(trace, forecasters="kalman", sequences=asked)
    path = lae_sim.compare_forecasters(SLOW, forecasters="kalman", sequences=asked)
    assert set(opened.to_frame()["sequence"]) == set(asked)
    pd.testing.assert_frame_equal(opened.to_frame(), path.to_frame())


def test_displays(result: lae_sim.ComparisonResult) -> None:
    text = repr(result)
    assert text.startswith("<ComparisonResult of synthetic-slow.parquet, recorded and ")
    assert "AUC hold 0.5722, kalman 0.6291" in text
    assert len(text) < 200
    assert "kalman" in str(result)
    assert "forecaster" in str(result)
    assert result._repr_html_().startswith("<table")
    figure = result.plot()
    assert isinstance(figure, Figure)
    assert figure.axes


def test_html_escapes_names(tmp_path: Path) -> None:
    paths = nasty_traces(tmp_path)
    result = lae_sim.compare_forecasters(
        {NASTY: paths[0]}, forecasters={f"mine {NASTY}": lae_sim.Kalman}
    )
    html = result._repr_html_()
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    assert "\n" not in repr(result)


def test_a_progress_bar_counts_steps(capsys: pytest.CaptureFixture[str]) -> None:
    lae_sim.compare_forecasters(SLOW, forecasters="kalman")
    assert capsys.readouterr() == ("", "")
    lae_sim.compare_forecasters([SLOW, FAST], forecasters="kalman", scale=[1, 2], progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "4/4" in err
    told = []
    lae_sim.compare_forecasters(SLOW, forecasters="kalman", progress=lambda *e: told.append(e))
    assert told == [(1, 1, "synthetic-slow.parquet, recorded")]


FAR = {"latency": "constant:90ms,init=600ms", "sequences": ("bike-pan", "car-chase", "truck-far")}


def test_forecasters_are_ranked_by_the_model_where_the_reach_is_known() -> None:
    result = lae_sim.compare_forecasters(SLOW, forecasters="kalman", search="c=0.3", **FAR)
    assert result.ranking.modelled
    assert result.metrics == ("modelled_auc", "modelled_dp20", "auc", "dp20")
    assert result.notes[-1] == "ranked by the modelled scores: the reach is given or measured"
    evaluated = lae_sim.evaluate(SLOW, search="c=0.3", **FAR)
    means = evaluated.summary.set_index("forecaster")
    summary = result.summary.set_index(["metric", "forecaster"])
    for name in ("hold", "kalman"):
        for metric in result.metrics:
            assert summary.loc[(metric, name), "mean"] == pytest.approx(means.loc[name, metric])
        for end in ("modelled_auc", "modelled_auc_low", "modelled_dp20_high"):
            assert summary.loc[("auc", name), end] == means.loc[name, end]
    won = means.loc["kalman", "modelled_auc"] - means.loc["hold", "modelled_auc"]
    assert summary.loc[("modelled_auc", "kalman"), "vs_hold"] == pytest.approx(won)
    assert "modelled AUC" in str(result)
    assert "modelled AUC hold" in repr(result)
    assert isinstance(result.plot(), Figure)
    assert set(result.attributes["metric"]) == set(result.metrics)


def test_a_comparison_over_the_grid_calls_its_means_mauc() -> None:
    result = lae_sim.compare_forecasters(SLOW, forecasters="kalman", sigma="grid")
    mean = result.summary.set_index(["metric", "forecaster"]).loc[("mauc", "hold"), "mean"]
    assert f": mAUC hold {mean:.4f}, kalman " in repr(result)


def test_an_assumed_range_does_not_rank() -> None:
    plain, beside = (
        lae_sim.compare_forecasters(SLOW, forecasters="kalman", search=search, **FAR)
        for search in ("off", "trace")
    )
    assert not beside.ranking.modelled
    assert beside.metrics == plain.metrics == ("auc", "dp20")
    assert beside.notes[-1] == (
        "ranked by the scores of the recorded boxes: the reach is unknown, and the model's are for "
        "a range of it"
    )
    assert any("measure c: lae-sim profile --gaps" in note for note in beside.notes)
    pd.testing.assert_frame_equal(beside.summary[list(plain.summary)], plain.summary)
    hold = beside.summary.query("forecaster == 'hold' and metric == 'auc'").iloc[0]
    assert not hold["c_known"]
    assert hold["modelled_auc_low"] <= hold["modelled_auc"] <= hold["modelled_auc_high"]
    assert hold["modelled_auc"] < hold["mean"]
    assert beside.summary.query("forecaster == 'offline'")["modelled_auc"].isna().all()
    text = str(beside)
    assert "modelled AUC" in text.splitlines()[2]
    assert "modelled" not in str(plain)
    assert (plain.search, plain.notes) == (
        [],
        [note for note in beside.notes if note in plain.notes],
    )


def test_means_over_the_grid_are_modelled_too() -> None:
    result = lae_sim.compare_forecasters(
        SLOW, forecasters="hold", search="c=0.3", sigma="grid", **FAR
    )
    assert result.metrics == ("modelled_mauc", "modelled_mdp20", "mauc", "mdp20")
    (row,) = result.summary.query("metric == 'modelled_mauc' and forecaster == 'hold'").itertuples()
    single = lae_sim.evaluate(SLOW, search="c=0.3", sigma="grid", **FAR).summary
    single = single.query("forecaster == 'hold'")
    assert row.mean == pytest.approx(single["modelled_auc"].mean())
    assert row.modelled_mauc == pytest.approx(row.mean)
    assert single["modelled_auc_low"].mean() - 1e-9 <= row.modelled_mauc_low < row.mean
    assert "modelled mAUC" in str(result)


def test_a_pre_forecaster_says_where_the_tracker_searches() -> None:
    result = lae_sim.compare_forecasters(
        SLOW, forecasters="kalman", search="c=0.3", pre_forecaster="kalman", keep_size=True, **FAR
    )
    means = lae_sim.evaluate(
        SLOW, search="c=0.3", pre_forecaster="kalman", keep_size=True, **FAR
    ).summary.set_index("forecaster")
    summary = result.summary.set_index(["metric", "forecaster"])
    for name in ("hold", "kalman"):
        expected = means.loc[name, "modelled_auc"]
        assert summary.loc[("modelled_auc", name), "mean"] == pytest.approx(expected)
    assert any(note.startswith("pre-forecaster kalman says where") for note in result.notes)
