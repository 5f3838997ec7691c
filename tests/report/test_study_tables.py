"""Tables of studies: figures of the summary, and LaTeX and CSV that hold whatever names hold."""

from __future__ import annotations

import csv
import dataclasses
import html
import pickle
import re
from fractions import Fraction

import pytest
from nasty import nasty_traces

from lae_sim.errors import visible
from lae_sim.figures.study import (
    MOST_NAMED,
    Point,
    _draw_fronts,
    _fronts,
    front,
    gains,
    study_in_columns,
    sweep,
)
from lae_sim.figures.style import GREY
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.report.latex import latex_of
from lae_sim.report.page import page, page_drawings, page_sections
from lae_sim.report.study_tables import (
    comparison_table,
    ranking,
    required_table,
    study_text,
    table2,
    write_tables,
)
from lae_sim.report.table import text_of
from lae_sim.study.records import MEAN
from lae_sim.study.run import StudyResults, compute_study, flat_rows
from lae_sim.study.spec import Study
from lae_sim.study.verdict import device_in_words
from lae_sim.study.view import View, run_of, setting_of


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> StudyResults:
    folder = tmp_path_factory.mktemp("nasty")
    study = Study(
        tuple(nasty_traces(folder)),
        scales=(Fraction(1, 2), Fraction(1), Fraction(2)),
        require_auc=Fraction(1, 2),
    )
    return compute_study(study, folder / "results", workers=1)


def test_ranking_says_what_the_summary_says(results):
    table = ranking(View(results))
    assert table.header[:4] == ("tracker", "forecaster", "dataset", "scale")
    found = {}
    for row in table.rows:
        entries = dict(zip(table.header, row))
        key = (
            entries["scale"].text,
            entries["tracker"].text[-3:],
            entries["forecaster"].text,
        )
        found[key] = entries
    assert len(found) == len(results.summary) == 12
    for row in flat_rows(results.summary):
        ours = found[row["scale"], row["trace"], row["forecaster"]]
        assert ours["AUC"].value == row["auc"]
        assert ours["AUC"].interval == (row["auc_low"], row["auc_high"])
        assert ours["change"].value == pytest.approx(row["auc"] / row["offline_auc"] - 1)
        assert ours["age ms"].value == row["age_ms"]
        assert ours["front"].value == row["pareto"]
        assert (ours["replay"].text == "exact") == row["exact"]
    aucs = [row[table.header.index("AUC")].value for row in table.rows[:4]]
    assert aucs == sorted(aucs, reverse=True)


def test_table2_shows_scale_1_and_changes(results):
    table = table2(View(results))
    summary = {
        (r["trace"], r["forecaster"]): r for r in flat_rows(results.summary) if r["scale"] == "1"
    }
    assert [row[1].text for row in table.rows] == ["offline", "hold", "kalman"] * 2
    for row in table.rows:
        hold = summary[row[0].text[-3:], "hold"]
        if row[1].text == "kalman":
            kalman = summary[row[0].text[-3:], "kalman"]
            assert row[2].value == kalman["auc"]
            assert row[3].value == pytest.approx(kalman["auc"] / hold["auc"] - 1)
        elif row[1].text == "hold":
            assert row[5].value == pytest.approx(hold["dp20"] / hold["offline_dp20"] - 1)
    online = [row for row in table.rows if row[1].text != "offline"]
    best = max(online, key=lambda row: row[2].value)
    assert best[2].rank == 1
    assert all(row[2].rank == 0 for row in table.rows if row[1].text == "offline")


def test_pairs_and_requirements(results):
    view = View(results)
    [*names, _, p, holm, _, _] = comparison_table(view).header
    assert names == ["scale", "forecaster", "a", "b", "n"]
    assert (p, holm) == ("p", "p (Holm)")
    table = required_table(view)
    assert table.header[:6] == (
        "tracker",
        "forecaster",
        "AUC asked",
        "ms per frame",
        "fps",
        "device",
    )
    assert [row[0].value[-3:] for row in table.rows] == ["one", "one", "two", "two"]
    for row, found in zip(table.rows, results.required, strict=True):
        assert row[2].value == 0.5
        assert row[3].value == found.safe_ms_per_frame
        assert row[4].value == found.safe_frames_per_second
        assert row[5].text == device_in_words(found)
        assert row[5].value == (None if found.safe_scale is None else float(found.safe_scale))


@pytest.mark.parametrize("write", [text_of, latex_of])
def test_only_no_latency_at_all_is_no_time_and_no_rate(results, write):
    never = dataclasses.replace(
        results.required[0], safe_scale=Fraction(0), safe_ms_per_frame=None, fps_at_most=0.0
    )
    table = required_table(View(dataclasses.replace(results, required=(never,))))
    [row] = table.rows
    entries = dict(zip(table.header, row))
    assert entries["device"].text == "only without latency"
    assert {entries[name].text for name in ("ms per frame", "fps", "or world fps")} == {"-"}
    assert "inf" not in write(table)


def test_the_text_and_the_page_begin_with_the_verdict(results):
    view, lines = View(results), results.verdict()
    assert lines
    assert study_text(view).replace("\n", " ").startswith(" ".join(lines))
    text = html.unescape(page(view))
    places = [text.index(visible(line)) for line in lines]
    assert places == sorted(places)
    assert places[-1] < text.index("<nav")


def test_the_ranking_says_how_far_each_is_behind_the_best(results):
    table = ranking(View(results))
    for row in table.rows[:4]:
        entries = dict(zip(table.header, row))
        is_best = row is table.rows[0]
        assert (entries["vs best"].value is None) == (entries["p (best)"].value is None) == is_best
    best, *others = (dict(zip(table.header, row))["AUC"].value for row in table.rows[:4])
    gaps = [dict(zip(table.header, row))["vs best"].value for row in table.rows[1:4]]
    assert gaps == pytest.approx([auc - best for auc in others])


def test_a_mean_over_sigma_shows_no_interval_of_a_single_one(tmp_path):
    study = Study(tuple(nasty_traces(tmp_path)), sigmas=SIGMA_GRID, attributes=False)
    results = compute_study(study, tmp_path / "results", workers=1)
    rows = View(results).rows
    means = [row for row in results.summary if row.sigma == MEAN]
    assert [row.uncertainty for row in rows] == [row.uncertainty for row in means]
    assert all(row.staleness is not None for row in rows)  # that is of the first sigma


@pytest.fixture(scope="module")
def over_grid(tmp_path_factory: pytest.TempPathFactory) -> StudyResults:
    folder = tmp_path_factory.mktemp("grid")
    study = Study(tuple(nasty_traces(folder)), sigmas=SIGMA_GRID, require_auc=Fraction(1, 2))
    return compute_study(study, folder / "results", workers=1)


def test_means_over_sigma_have_their_own_names(over_grid, tmp_path):
    view = View(over_grid)
    means = {(run_of(row), row.forecaster): row for row in over_grid.summary if row.sigma == MEAN}
    assert any(row.scores["auc"] != view._first[key].scores["auc"] for key, row in (
        ((run_of(row), setting_of(row), row.forecaster), row) for row in means.values()
    ))  # fmt: skip
    table = ranking(view)
    assert {"mAUC", "mDP", "offline", "offline DP"} < set(table.header)
    assert not {"AUC", "DP"} & set(table.header)
    for row in table.rows:
        entries = dict(zip(table.header, row))
        key = next(k for k in means if (view.names[k[0]], k[1]) == (row[0].text, row[1].text))
        assert entries["mAUC"].value == means[key].scores["auc"]
        assert entries["mDP"].value == means[key].scores["dp20"]
    assert table.caption.startswith("The best mAUC of each setting first")
    assert "mAUC of a - b" in comparison_table(view).header
    for column in table.columns:  # what is without latency knows no sigma
        wrong = r"(?<!m)(AUC|DP)\b" if not column.title.startswith("offline") else r"m(AUC|DP)\b"
        assert not re.search(wrong, f"{column.title} {column.meaning}")
    required = required_table(view)  # at the first sigma
    assert "AUC there" in required.header
    assert required.caption.endswith("for the required AUC at sigma 0")
    write_tables(over_grid, tmp_path)
    assert " & mAUC & " in (tmp_path / "ranking.tex").read_text()
    text = study_text(view)
    assert "mAUC: with its 95 % interval" in text.replace("\n", " ")
    assert "mAUC won over hold" in text.replace("\n", " ")
    heading = next(line for line in text.splitlines() if line.startswith("tracker "))
    assert {"mAUC", "mDP"} < set(heading.split())


def test_pictures_over_sigma_are_called_mauc(over_grid, results):
    for study, name in ((over_grid, "mAUC"), (results, "AUC")):
        view = View(study)
        assert front(view).caption.startswith(f"{name} against")
        assert {axes.get_ylabel() for axes in front(view).draw().axes} == {name}
        figure = gains(view).draw()
        assert figure.axes[0].get_xlabel() == f"{name} won over hold"


def test_the_front_names_each_tracker_beside_its_best_point(results):
    view, [row, *_] = View(results), results.summary
    held = [("MCCT", 116, 0.245), ("KCF", 4, 0.254), ("SiamAPN", 47, 0.36), ("UDT", 19, 0.381)]
    best = [("MCCT", 116, 0.357), ("KCF", 4, 0.274), ("SiamAPN", 47, 0.452), ("UDT", 19, 0.411)]
    points = [
        Point(dataclasses.replace(row, trace=run, times_from=run), ms, auc)
        for run, ms, auc in (*held, *best)
    ]
    view.__dict__["names"] = {run: run for run, _, _ in best}
    [axes] = _draw_fronts(_fronts(view, points)).axes
    labels = {text.get_text(): text.xy for text in axes.texts}
    assert labels == {run: (ms, auc) for run, ms, auc in best}


def test_of_many_trackers_the_front_names_the_best_and_shows_the_others_in_grey(results):
    view, [row, *_] = View(results), results.summary
    ends = {f"T{i}": (10 + i, i / 50, i in (3, 30)) for i in range(40)}
    points = [
        Point(dataclasses.replace(row, trace=run, times_from=run, pareto=is_best), ms, auc)
        for run, (ms, auc, is_best) in ends.items()
    ]
    view.__dict__["names"] = {run: run for run in ends}
    [axes] = _draw_fronts(_fronts(view, points)).axes
    named = {text.get_text() for text in axes.texts}
    assert named == {"T3", *(f"T{i}" for i in range(39, 40 - MOST_NAMED, -1))}
    [others] = [line for line in axes.lines if len(line.get_xdata()) == 40 - MOST_NAMED]
    assert others.get_color() == GREY
    assert set(others.get_xdata()) == {ms for run, (ms, *_) in ends.items() if run not in named}


def test_of_many_datasets_a_few_are_drawn_and_the_captions_say_so(results):
    many = tuple(
        dataclasses.replace(row, trace=f"T{i}", times_from=f"T{i}", dataset=f"D{i}")
        for i in range(20)
        for row in results.summary
    )
    view = View(dataclasses.replace(results, summary=many))
    drawing = front(view)
    assert "; the first 3 of 20 datasets" in drawing.caption
    assert [axes.get_title() for axes in drawing.draw().axes] == ["D0", "D1", "D2"]
    over_scale = sweep(view, "scale")
    assert "; the first 3 of 20 datasets" in over_scale.caption
    assert len(over_scale.draw().axes) == 2 * 3
    assert front(View(results)).caption.count("datasets") == 0


def test_gains_are_where_the_summary_has_them(results):
    rows = {run_of(row): row for row in View(results).standing if row.forecaster == "kalman"}
    won, recovered = gains(View(results)).draw().axes
    assert recovered.get_xlabel() == "latency loss recovered (%)"
    [names] = {tuple(label.get_text() for label in won.get_yticklabels())}
    [dots] = [line for line in won.lines if line.get_label() == "kalman"]
    [ends] = [each.get_segments() for each in won.collections]
    assert len(names) == len(dots.get_xdata()) == len(ends) == len(rows) == 2
    for x, segment in zip(dots.get_xdata(), ends):
        [gain] = [r.certainty("auc").vs_hold for r in rows.values()
                  if r.certainty("auc").vs_hold.value == x]  # fmt: skip
        assert segment[:, 0].tolist() == [gain.interval.low, gain.interval.high]


def test_what_is_drawn_can_go_to_workers(results):
    view = View(results)
    for figure in study_in_columns(view):
        assert len(pickle.dumps(figure)) < 20_000
    drawings = page_drawings(page_sections(view))
    text = page(view)
    for draw in drawings.values():
        assert len(pickle.dumps(draw)) < 50_000
    name, draw = next(iter(drawings.items()))
    picture = pickle.loads(pickle.dumps(draw))()
    assert name.startswith("curves-")
    assert picture in text


def test_what_is_said_of_all_traces_is_said_once(results):
    assert results._of_traces([("a", "x"), ("b", "y"), ("a", "x")]) == ["a: x", "b: y"]
    assert results._of_traces([("a", "x"), ("b", "x")]) == ["all traces: x"]


def test_files(results, tmp_path):
    write_tables(results, tmp_path / "new" / "tables")
    names = {"ranking", "table2", "attributes", "comparisons", "required"}
    files = {path.name for path in (tmp_path / "new" / "tables").iterdir()}
    kinds = (".csv", ".parquet", ".tex", "-long.tex")
    assert files == {f"{name}{kind}" for name in names for kind in kinds}
    with open(tmp_path / "new" / "tables" / "ranking.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["tracker"].count("<script>") for row in rows} == {1}
    assert float(rows[0]["auc_low"]) <= float(rows[0]["auc"]) <= float(rows[0]["auc_high"])
    text = (tmp_path / "new" / "tables" / "ranking-long.tex").read_text()
    body = [line for line in text.splitlines() if not line.startswith("%")]
    assert all(line.count(r"\&") == 1 for line in body if "script" in line)
    assert len([line for line in body if line.endswith(r" \\")]) == 1 + 4  # scale 1 alone
