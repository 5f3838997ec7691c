"""Figures for a paper: their size, that lines differ in grey print, and the same bytes."""

from __future__ import annotations

import re
from itertools import combinations
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lae_sim.figures.column import COLUMN, column_figure, column_files, field_score
from lae_sim.figures.lines import Curve, Line, Panel, panel_in_column, panels_of
from lae_sim.figures.style import forecaster_styles, paper_styles
from lae_sim.learning.registry import BUILT_IN


def curves() -> list[Curve]:
    names = ["hold", "kalman", "offline"]
    styles = paper_styles(names)
    return [
        Curve(name, np.full(21, 0.5 + 0.1 * f), np.linspace(0, 0.5 + 0.1 * f, 51), styles[name])
        for f, name in enumerate(names)
    ]


def sizes(figure: Figure) -> set[float]:
    """Of all letters in a figure, points."""
    [axes] = figure.axes
    [legend] = figure.legends
    return {
        text.get_fontsize()
        for text in (axes.xaxis.label, *axes.get_xticklabels(), *legend.get_texts())
    }


def test_a_figure_fits_a_column_and_has_no_title() -> None:
    for figure in map(panel_in_column, panels_of(curves())):
        assert figure.get_figwidth() == COLUMN == 3.4
        assert 1.5 < figure.get_figheight() < 3
        assert sizes(figure) == {7.5, 8}
        [axes] = figure.axes
        assert axes.get_title() == figure.get_suptitle() == ""
        assert "STIXGeneral" in axes.xaxis.label.get_fontfamily()


def test_a_title_is_left_out() -> None:
    def draw(axes: Axes) -> None:
        axes.plot([0, 1])
        axes.set_title("what the caption says")

    figure = column_figure(draw)
    assert figure.axes[0].get_title() == ""
    assert not figure.legends  # of one line there is none


def test_legends_hold_scores_as_papers_write_them_the_best_first() -> None:
    success, precision = map(panel_in_column, panels_of(curves()))
    texts = [[text.get_text() for text in f.legends[0].get_texts()] for f in (success, precision)]
    assert texts[0] == ["offline [.700]", "kalman [.600]", "hold [.500]"]
    assert texts[1] == ["offline [.280]", "kalman [.240]", "hold [.200]"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.5534, ".553"), (0.0, ".000"), (1.0, "1.000"), (-0.02, "-.020"), (None, "-")],
)
def test_scores_have_no_zero_before_the_point(value: float | None, text: str) -> None:
    assert field_score(value) == text


def test_lines_differ_in_marker_and_dashes_without_their_colours() -> None:
    styles = paper_styles(["offline", *BUILT_IN][:5])
    assert all(styles[name]["color"] == forecaster_styles([name])[name]["color"] for name in styles)
    for one, other in combinations(styles.values(), 2):
        assert one["linestyle"] != other["linestyle"]
        assert one.get("marker") != other.get("marker")


def test_many_points_have_few_markers_not_above_each_other() -> None:
    x = np.arange(51.0)
    styles = paper_styles(["hold", "kalman"])
    lines = [Line(name, x, x, style) for name, style in styles.items()]
    [axes] = panel_in_column(Panel("", "x", "y", lines)).axes
    places = [line.get_markevery() for line in axes.lines]
    marked = [set(range(51)[first::every]) for first, every in places]
    assert all(8 <= len(each) <= 12 for each in marked)
    assert not marked[0] & marked[1]
    assert all(line.get_marker() not in ("", "None") for line in axes.lines)


def test_files_are_the_same_bytes_and_hold_their_fonts() -> None:
    success, _ = panels_of(curves())
    files, again = (column_files(panel_in_column(success)) for _ in range(2))
    assert files == again
    pdf_bytes, svg_bytes = files["pdf"], files["svg"]
    assert b"/FontFile2" in pdf_bytes  # TrueType, embedded
    assert b"/Type3" not in pdf_bytes
    assert b"CreationDate" not in pdf_bytes
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+)", pdf_bytes)
    assert box is not None
    assert float(box[1]) == pytest.approx(3.4 * 72)
    root = ElementTree.fromstring(svg_bytes)
    assert not list(root.iter("{http://www.w3.org/2000/svg}text"))  # letters are paths
    assert b"<dc:date>" not in svg_bytes


def test_names_in_any_letters_are_drawn() -> None:
    def draw(axes: Axes) -> None:
        axes.plot([0, 1], label="追踪 $x^2_")
        axes.plot([1, 0], label="a_b\x00")

    assert [*column_files(column_figure(draw))] == ["pdf", "svg"]
