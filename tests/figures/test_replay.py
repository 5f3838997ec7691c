import io
from fractions import Fraction

import numpy as np
import pytest
from places import TRACES

import lae_sim
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.evaluation.pairing import pair
from lae_sim.evaluation.totals import CurveTotals
from lae_sim.figures import replay as plots
from lae_sim.figures.style import save

FORECASTERS = {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman}


def curves_of(trace):
    return curves_in(evaluate_runs(lae_sim.replay_trace(trace), trace.metadata, FORECASTERS))


def curves_in(evaluation):
    totals = CurveTotals()
    totals.add(evaluation)
    return plots.mean_curves(totals, list(FORECASTERS))


@pytest.fixture
def trace():
    return lae_sim.read_trace(TRACES / "synthetic-slow.parquet", ["boat-calm", "car-chase"])


def test_curves_average_to_the_scores(trace):
    runs = list(lae_sim.replay_trace(trace))
    found = evaluate_runs(runs, trace.metadata, FORECASTERS, [Fraction(1, 2)])
    curves = curves_in(found)
    assert list(curves) == ["offline", "hold", "kalman"]
    assert curves["offline"][0].mean() == pytest.approx(found.offline["auc"].mean())
    for f, name in enumerate(FORECASTERS):
        success, precision = curves[name]
        assert success.mean() == pytest.approx(found.scores["auc"][f].mean())
        assert precision[20] == pytest.approx(found.scores["dp20"][f].mean())


def test_a_real_time_trace_has_no_offline_curve():
    trace = lae_sim.read_trace(TRACES / "synthetic-slow-realtime.parquet")
    curves = curves_of(trace)
    assert list(curves) == ["hold", "kalman"]


def test_success_and_precision_draws_a_line_for_each_curve(trace):
    curves = curves_of(trace)
    figure = plots.success_and_precision(curves, "title")
    left, right = figure.axes
    assert [len(axes.lines) for axes in (left, right)] == [3, 3]
    np.testing.assert_array_equal(left.lines[2].get_ydata(), curves["kalman"][0])
    [legend] = figure.legends
    assert legend.get_texts()[1].get_text().startswith("hold [")


def test_timeline_shows_frames_and_who_answers_them(trace):
    run = next(iter(lae_sim.replay_trace(trace)))
    figure = plots.timeline_figure(run, first=20, count=10)
    [axes] = figure.axes
    written = [text.get_text() for text in axes.texts]
    pairing = pair([run.schedule], [Fraction(0)])
    spans = zip(pairing.frames, pairing.first[:, 0], pairing.end[:, 0])
    source = {i: j for j, first, end in spans for i in range(first, end)}
    answers = [text for text in axes.texts if getattr(text, "xy", (0, 0))[1] == -0.4]
    assert [int(text.get_text()) for text in answers] == [source[i] for i in range(20, 30)]
    assert {str(frame) for frame in range(20, 30)} <= set(written)
    figure.savefig(io.BytesIO())


def test_saving_says_which_endings_there_are(trace, tmp_path):
    curves = curves_of(trace)
    figure = plots.success_and_precision(curves)
    save(figure, str(tmp_path / "a.svg"))
    assert (tmp_path / "a.svg").read_text().startswith("<?xml")
    with pytest.raises(lae_sim.LaeError, match=r"name a \.png"):
        save(figure, str(tmp_path / "a.docx"))


@pytest.mark.parametrize("name", ["otb", "exclude", "got10k"])
def test_curves_leave_out_the_sequences_that_the_scores_do(name):
    box = np.tile([100.0, 50, 40, 30], (5, 1))
    lost = np.where(np.arange(5)[:, None] == 0, [[0.0, 0, 0, 0]], box)
    recordings = [
        lae_sim.Recording.new("a", box, box, np.full(5, 10**6)),
        lae_sim.Recording.new("b", lost, box + 900, np.full(5, 10**6)),
        lae_sim.Recording.new("c", np.full((5, 4), np.nan), box, np.full(5, 10**6)),
    ]
    trace = lae_sim.Trace(lae_sim.Metadata.new("30", "every-frame"), recordings)
    convention = lae_sim.CONVENTIONS[name]
    found = evaluate_runs(
        lae_sim.replay_trace(trace), trace.metadata, FORECASTERS, convention=convention
    )
    curves = curves_in(found)
    for f, forecaster in enumerate(FORECASTERS):
        success, precision = curves[forecaster]
        assert success.mean() == pytest.approx(np.nanmean(found.scores["auc"][f]))
        assert precision[20] == pytest.approx(np.nanmean(found.scores["dp20"][f]))
