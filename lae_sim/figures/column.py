"""Figures for a paper: one column wide, lines that differ in grey print, fonts in the file.

They have no title: the paper's caption says what they show. The same figure gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any

from lae_sim.figures.style import any_names, laid_out, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMN = 3.4
"""Inches: what fits a column of the usual two-column papers."""

_LEGEND_ROW, _CHARACTER = 0.135, 0.058  # inches that a row and a letter of a legend take
_LOOK = {
    "text.parse_math": False,  # names hold what they hold
    "font.family": ["STIXGeneral", "DejaVu Sans"],  # as papers' text is; the latter has more signs
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 2.6,  # as long as the longest pattern of dashes
    "legend.columnspacing": 1.0,
    "legend.labelspacing": 0.25,
    "legend.borderpad": 0.2,
    "lines.linewidth": 1.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "figure.constrained_layout.h_pad": 0.02,
    "figure.constrained_layout.w_pad": 0.02,
}
_FILES = {"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "lae_sim"}


@dataclass(frozen=True, eq=False)
class ColumnFigure:
    """A figure for a paper, not yet drawn.

    Attributes:
        name: of its files.
        caption: what it shows, and what was chosen of more.
        draw: draws it; can be pickled where workers are to.
    """

    name: str
    caption: str
    draw: Callable[[], Figure]


@dataclass(frozen=True, eq=False)
class DrawnFigure:
    """A figure for a paper.

    Attributes:
        name: of its files.
        caption: what it shows, and what was chosen of more.
        files: by their endings, ``"pdf"`` and ``"svg"``.
    """

    name: str
    caption: str
    files: Mapping[str, bytes]


def drawn(figure: ColumnFigure) -> DrawnFigure:
    """A figure, drawn."""
    return DrawnFigure(figure.name, figure.caption, column_files(figure.draw()))


def field_score(value: float | None) -> str:
    """A score as papers write it: ``".553"``; a dash if it is not known."""
    if value is None or value != value:
        return "-"
    return f"{value:.3f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.3f}"


def column_figure(
    draw: Callable[[Axes], object], height: float = 2.0, width: float = COLUMN
) -> Figure:
    """A figure of one pair of axes in the style of a paper, its legend below.

    Args:
        draw: draws into the axes; a title that it sets is left out.
        height: inches, without the legend.
        width: inches.
    """
    import matplotlib

    look: dict[Any, Any] = _LOOK
    with matplotlib.rc_context(look):
        figure = new_figure(width, height)
        axes = figure.subplots()
        draw(axes)
        axes.set_title("")
        for line in axes.lines:
            line.set_markersize(min(line.get_markersize(), 3.2))
            line.set_markeredgewidth(0.7)
        handles, labels = axes.get_legend_handles_labels()
        unique = dict(zip(labels, handles))
        if len(unique) > 1:
            column = 0.45 + _CHARACTER * max(map(len, unique))
            columns = max(1, min(4, len(unique), int(width / column)))
            figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=columns)
            figure.set_figheight(height + _LEGEND_ROW * -(-len(unique) // columns))
    return figure


def column_files(figure: Figure) -> dict[str, bytes]:
    """A figure as files by their endings, ``"pdf"`` and ``"svg"``: of the same bytes each time."""
    import matplotlib
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    settings: dict[Any, Any] = {**_LOOK, **_FILES}
    pdf, svg = BytesIO(), BytesIO()
    with matplotlib.rc_context(settings), any_names(figure):
        laid_out(figure)  # once for both
        nothing = dict.fromkeys(("CreationDate", "Creator", "Producer"))
        canvas: Any = FigureCanvasPdf(figure)
        canvas.print_pdf(pdf, metadata=nothing)
        canvas = FigureCanvasSVG(figure)
        canvas.print_svg(svg, metadata=dict.fromkeys(("Date", "Creator")))
    return {"pdf": pdf.getvalue(), "svg": svg.getvalue()}
