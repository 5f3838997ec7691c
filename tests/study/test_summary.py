"""Records of a study: flat only in files, kept as they are, and the front of rivals."""

from __future__ import annotations

import dataclasses
import json
from fractions import Fraction

import numpy as np
import pytest
from places import REPOSITORY
from schemas import check

from lae_sim.comparison.statistics import Difference, Interval, Recovered
from lae_sim.figures.study import ENERGY, front
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.report.page import page_sections
from lae_sim.report.study_tables import ranking, study_text
from lae_sim.study.records import (
    Consumption,
    Failure,
    Modelled,
    Staleness,
    SummaryRow,
    Uncertainty,
)
from lae_sim.study.run import compute_study, write_csv
from lae_sim.study.spec import Study
from lae_sim.study.summary import _front, _median_survival
from lae_sim.study.view import View
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
FAST = REPOSITORY / "traces" / "synthetic-fast.parquet"


def summary_row(**values):
    row = SummaryRow(
        trace="a",
        tracker="A",
        dataset="D",
        device="unknown",
        times_from="a",
        policy="latest",
        fps=Fraction(30000, 1001),
        latency="recorded",
        scale=Fraction(3, 2),
        search="off",
        pre_forecaster="none",
        convention="pysot",
        forecaster="kalman",
        sequences=3,
        repetitions=1,
        engine="batch",
        exact=True,
        approximate_share=0.0,
        elapsed_ms=None,
        init_ms=80.0,
        init_source="measured",
        skip_rate=0.5,
        sigma=Fraction(1, 50),
        scores={"auc": 0.5, "dp20": None},
        offline={"auc": 0.6, "dp20": None},
    )
    return dataclasses.replace(row, **values)


HEAD = [
    "trace", "tracker", "dataset", "device", "times_from", "policy", "fps", "latency", "scale",
    "search", "pre_forecaster", "convention", "forecaster", "sequences", "repetitions", "engine",
    "exact",
    "approximate_share", "elapsed_ms", "init_ms", "init_source", "skip_rate", "sigma",
    "auc", "dp20", "offline_auc", "offline_dp20",
]  # fmt: skip


def test_a_flat_row_has_exact_numbers_as_text_and_no_key_of_what_was_not_asked():
    row = summary_row().flat()
    assert list(row) == [*HEAD, "ranked_by", "pareto"]
    assert (row["fps"], row["scale"], row["sigma"]) == ("30000/1001", "3/2", "1/50")
    assert (row["elapsed_ms"], row["dp20"], row["pareto"]) == (None, None, False)


def test_a_flat_row_has_all_that_is_known_in_order():
    ends = Interval(0.1, 0.2)
    auc = Uncertainty(ends, ends, Difference(0.1, ends, 0.5, 2, 1), Recovered(0.3, ends))
    whole = Staleness(1.0, 33.0, 66.0, 99.0, 0.5, None)
    row = summary_row(uncertainty={"auc": auc}, staleness=whole, pareto=True).flat()
    assert list(row)[len(HEAD) :] == [
        "auc_low", "auc_high", "auc_jitter_low", "auc_jitter_high",
        "vs_hold_auc", "vs_hold_auc_low", "vs_hold_auc_high", "vs_hold_auc_p",
        "recovered_auc", "recovered_auc_low", "recovered_auc_high",
        "mismatch_mean", "age_ms", "age_max_ms", "longest_stale_ms",
        "failed", "time_to_failure_ms", "ranked_by", "pareto",
    ]  # fmt: skip
    assert (row["failed"], row["time_to_failure_ms"], row["pareto"]) == (0.5, None, True)
    later = dataclasses.replace(whole, failed=None)
    assert list(later.columns()) == ["mismatch_mean", "age_ms", "age_max_ms", "longest_stale_ms"]


def test_what_is_modelled_has_keys_of_its_own():
    modelled = Modelled(True, 0.25, {"auc": 0.4, "dp20": None}, {"auc": Interval(0.3, 0.45)})
    uncertainty = {
        "auc": Uncertainty(Interval(0.45, 0.55)),
        "modelled_auc": Uncertainty(Interval(0.2, 0.6), recovered=Recovered(0.1, None)),
    }
    row = summary_row(modelled=modelled, uncertainty=uncertainty)
    flat = row.flat()
    assert list(flat)[len(HEAD) :] == [
        "auc_low", "auc_high", "modelled_auc_bootstrap_low", "modelled_auc_bootstrap_high",
        "recovered_modelled_auc", "c_known", "lost_share",
        "modelled_auc", "modelled_auc_low", "modelled_auc_high", "modelled_dp20",
        "ranked_by", "pareto",
    ]  # fmt: skip
    assert (flat["modelled_auc_low"], flat["modelled_auc_bootstrap_low"]) == (0.3, 0.2)
    assert (row.score("auc"), row.certainty("auc")) == (0.5, uncertainty["auc"])
    ranked = dataclasses.replace(row, ranked_by="modelled")
    assert (ranked.score("auc"), ranked.score("dp20")) == (0.4, None)
    assert ranked.certainty("auc") == uncertainty["modelled_auc"]
    exact = summary_row(ranked_by="modelled", uncertainty={"auc": uncertainty["auc"]})
    assert (exact.score("auc"), exact.certainty("auc")) == (0.5, uncertainty["auc"])


@pytest.mark.parametrize(
    ("recovered", "keys"),
    [
        (Recovered(None, None), []),
        (Recovered(0.5, None), ["recovered_auc"]),
        (Recovered(None, Interval(0, 1)), ["recovered_auc_low", "recovered_auc_high"]),
    ],
)
def test_what_is_unknown_of_the_recovered_share_has_no_key(recovered, keys):
    uncertainty = Uncertainty(Interval(0, 1), recovered=recovered)
    assert list(uncertainty.columns("auc")) == ["auc_low", "auc_high", *keys]


def test_records_do_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        summary_row().pareto = True
    with pytest.raises(TypeError, match="item assignment"):
        Failure("a", "b")["reason"] = "c"


def test_records_hold_what_the_files_say(tmp_path):
    study = Study(
        (str(SLOW), str(FAST)),
        sequences=("bike-pan", "car-chase", "person-crowd"),
        sigmas=SIGMA_GRID,
        require_auc=Fraction(1, 2),
    )
    results = compute_study(study, tmp_path, workers=1)
    rows = {(row.trace, row.forecaster, row.sigma): row for row in results.summary}
    kalman = rows["synthetic-slow", "kalman", "mean"]
    uncertainty = kalman.uncertainty["auc"]
    flat = kalman.flat()
    assert uncertainty.interval == Interval(flat["auc_low"], flat["auc_high"])
    assert uncertainty.vs_hold.value == flat["vs_hold_auc"]
    assert uncertainty.recovered.share == flat["recovered_auc"]
    assert (uncertainty.jitter, kalman.staleness) == (None, None)
    assert rows["synthetic-slow", "hold", "mean"].uncertainty["auc"].vs_hold is None
    assert rows["synthetic-slow", "hold", Fraction(0)].staleness.failed is not None
    assert rows["synthetic-slow", "hold", Fraction(1, 50)].staleness.failed is None
    assert rows["synthetic-slow", "hold", Fraction(1, 50)].uncertainty == {}
    document = json.loads((tmp_path / "study.json").read_text())
    for name in ("summary", "comparisons", "required", "failures"):
        assert document[name] == [record.flat() for record in getattr(results, name)]
    [pair, _] = results.comparisons
    assert (pair.a, pair.b, pair.sequences) == ("synthetic-slow", "synthetic-fast", 3)
    assert pair.p_holm == pair.difference.p  # of one pair


def test_a_table_has_a_column_for_every_key_of_any_row(tmp_path):
    interval = {"auc": Uncertainty(Interval(0.25, 0.75))}
    write_csv([summary_row(), summary_row(uncertainty=interval)], tmp_path / "a.csv")
    header, first, second = (tmp_path / "a.csv").read_text().splitlines()
    assert header.split(",") == [*HEAD, "ranked_by", "pareto", "auc_low", "auc_high"]
    assert first.endswith(",False,,")
    assert second.endswith(",False,0.25,0.75")


def test_the_front_is_of_those_that_nobody_beats_in_both():
    rows = [
        summary_row(scores={"auc": auc}, elapsed_ms=ms)
        for auc, ms in [
            (0.5, 10),
            (0.6, 20),
            (0.5, 20),
            (0.4, 30),
            (0.6, 20),
            (None, 1),
            (0.9, None),
        ]
    ]
    assert _front(rows) == [0, 1, 4]


def test_half_is_half_where_floats_would_miss_it():
    # survival 2/3 x 3/4 = 1/2; in every such case
    for count in range(2, 40):
        times, failed = np.arange(1.0, count + 1), np.ones(count, bool)
        assert _median_survival(times, failed) == (count + 1) // 2
    assert _median_survival(np.array([1.0, 2, 3]), np.array([True, False, False])) is None
    # censored before the failures: 1, then 1 - 1/2
    assert _median_survival(np.array([1.0, 2, 3]), np.array([False, True, False])) == 2


def with_power(path, out, watts, idle=None, source="measured"):
    """A trace whose device took so many watts during calls, and at rest."""
    trace = read_trace(path)
    energy = {"calls": 10, "seconds": 1.0, "power_w": {"VDD_IN": watts}, "total": ["VDD_IN"]}
    energy |= {} if idle is None else {"idle_w": {"VDD_IN": idle}}
    document = dict(trace.metadata.document)
    document |= {"device": {"model": "board", "energy": energy}, "timing": {"source": source}}
    write_trace(Trace(Metadata.of(document), list(trace)), out)
    return out


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A study of two traces with power, and one without."""
    folder = tmp_path_factory.mktemp("power")
    traces = (
        with_power(SLOW, folder / "slow.parquet", 20.0, 4.0),
        with_power(FAST, folder / "fast.parquet", 5.0),
        FAST,
    )
    study = Study(traces, scales=(Fraction(1), Fraction(2)), forecasters=("hold",))
    return compute_study(study, folder / "results", workers=1)


def test_the_energy_of_calls_is_told_where_their_power_was_measured(measured):
    rows = {(row.trace, row.scale): row for row in measured.summary}
    slow, fast = rows["slow", 1], rows["fast", 1]
    assert slow.energy.joules_per_frame == pytest.approx(20 * slow.elapsed_ms / 1e3)
    assert slow.energy.joules_above_idle == pytest.approx(16 * slow.elapsed_ms / 1e3)
    per_second = 30 * (1 - slow.skip_rate)
    assert slow.energy.watts == pytest.approx(4 + slow.energy.joules_above_idle * per_second)
    assert 4 < slow.energy.watts <= 20.01  # it is busy nearly all of the time
    flat = slow.flat()
    assert flat["auc_per_watt"] == pytest.approx(slow.score("auc") / slow.energy.watts)
    assert (fast.energy.joules_above_idle, fast.energy.watts) == (None, None)
    assert fast.flat()["auc_per_watt"] is None
    # times that are stretched are no device's whose power is known
    assert rows["slow", 2].energy is None
    assert rows["synthetic-fast", 1].energy is None
    assert "joules_per_frame" not in rows["synthetic-fast", 1].flat()
    check(measured.document(), "study")


def test_the_front_of_energy_stands_beside_that_of_time(measured):
    rows = {row.trace: row for row in measured.summary if row.scale == 1}
    assert rows["fast"].energy.pareto
    expected = rows["slow"].score("auc") > rows["fast"].score("auc")
    assert rows["slow"].energy.pareto == expected
    view = View(measured)
    picture = front(view, ENERGY)
    assert picture.caption.startswith("AUC against the energy of the device during a call")
    assert picture.draw().axes[0].get_xlabel() == "energy of a call (J)"
    titles = [section.title for section in page_sections(view)]
    assert titles.index("Accuracy against energy") == titles.index("Accuracy against time") + 1
    header = ranking(view).header
    assert [name for name in header if name in ("J/frame", "W", "AUC/W", "energy front")] == [
        "J/frame",
        "W",
        "AUC/W",
        "energy front",
    ]
    assert "AUC/W" in study_text(measured, None)


@pytest.mark.parametrize(
    ("latency", "is_told"),
    [("by-call", True), ("resample", True), ("constant:47ms", False), ("recorded,init=1s", True)],
)
def test_times_that_were_not_measured_have_no_energy(tmp_path, latency, is_told):
    trace = with_power(FAST, tmp_path / "fast.parquet", 5.0, 4.0)
    study = Study((trace,), latencies=(latency,), forecasters=("hold",))
    (row,) = compute_study(study, tmp_path / "results", workers=1).summary
    assert (row.energy is not None) == is_told


def test_times_that_a_trace_does_not_call_measured_have_no_energy(tmp_path):
    trace = with_power(FAST, tmp_path / "fast.parquet", 5.0, source="constant 47 ms, not measured")
    study = Study((trace,), forecasters=("hold",))
    (row,) = compute_study(study, tmp_path / "results", workers=1).summary
    assert row.energy is None


def test_rivals_are_ordered_by_energy_too():
    def row(auc, joules):
        spent = None if joules is None else Consumption(joules, None, None)
        return summary_row(scores={"auc": auc, "dp20": None}, elapsed_ms=1.0, energy=spent)

    rivals = [row(0.5, 2.0), row(0.6, 3.0), row(0.4, 2.5), row(0.9, None)]
    assert _front(rivals, lambda each: each.energy and each.energy.joules_per_frame) == [0, 1]
