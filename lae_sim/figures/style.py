"""One style of all figures: a forecaster has one colour wherever it is drawn, and so has a tracker.

The colours of forecasters hang on their names, so that they are the same in all reports, films and
notebooks; those of trackers on their order in a report.

Sources: Okabe and Ito, "Color Universal Design" (2008); Tol, "Colour Schemes" (2021), muted.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar
from zlib import crc32

from lae_sim.errors import LaeError, visible
from lae_sim.files import written_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Style = dict[str, Any]
"""Keyword arguments of Matplotlib's ``plot``: colour, marker, line."""

BLUE, SKY_BLUE, VERMILION, GREY = "#0072B2", "#56B4E9", "#D55E00", "#666666"
_FORECASTERS = {
    "hold": "#E69F00",
    "kalman": BLUE,
    "constant-velocity": "#009E73",
    "kalman-lae-pvt": SKY_BLUE,
    "g-h": "#CC79A7",
    "imm": "#332288",
    "least-squares": VERMILION,
    "learned": "#999933",
    "trained": "#A65628",
    "tuned-kalman": "#882255",
    "oracle": "#888888",
}
_OTHERS = ("#44AA99", "#AA4499", "#117733", "#DDCC77", "#661100", "#6699CC", "#CC6677")
_TRACKERS = (
    BLUE, VERMILION, "#009E73", "#CC79A7", "#E69F00", SKY_BLUE, "#332288", "#999933"
)  # fmt: skip
_MARKERS = "osD^vP*X"
_LINES = ("-", "-.", (0, (3, 1, 1, 1, 1, 1)), (0, (5, 1)), (0, (1, 1)))
_LOOK = {
    "text.parse_math": False,  # names hold what they hold
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.3,
    "font.size": 9,
    "legend.frameon": False,
}


def forecaster_colours(names: Iterable[str]) -> dict[str, str]:
    """The colour of each forecaster, ``"#RRGGBB"``, and black for offline.

    Built-in ones have their own. Any other has one that its name decides, or the next that is free.
    """
    names = list(dict.fromkeys(names))
    colours = {name: _FORECASTERS[name] for name in names if name in _FORECASTERS}
    for name in names:
        first = crc32(name.encode()) % len(_OTHERS)
        wanted = (*_OTHERS[first:], *_OTHERS[:first], *_FORECASTERS.values())
        free = (colour for colour in wanted if colour not in colours.values())
        colours.setdefault(name, next(free, wanted[0]))
    return {name: "#000000" if name == "offline" else colours[name] for name in names}


def forecaster_styles(names: Iterable[str]) -> dict[str, Style]:
    """Colour, marker and line of each forecaster; offline, which is none, is dashed."""
    palette = [*_FORECASTERS.values(), *_OTHERS]
    return {
        name: {"color": colour, "linestyle": "--"}
        if name == "offline"
        else {
            "color": colour,
            "linestyle": "-",
            "marker": _MARKERS[palette.index(colour) % len(_MARKERS)],
            "markersize": 4,
        }
        for name, colour in forecaster_colours(names).items()
    }


def forecaster_lines(names: Iterable[str]) -> dict[str, Any]:
    """A kind of line for each forecaster, where colours are trackers'; hold is dotted."""
    fixed = {"hold": ":", "offline": "--"}
    others = [name for name in names if name not in fixed]
    return {**fixed, **{name: _LINES[i % len(_LINES)] for i, name in enumerate(others)}}


def paper_styles(names: Iterable[str]) -> dict[str, Style]:
    """Colour, marker and line of each forecaster, which differ in grey print too."""
    names = list(names)
    styles, lines = forecaster_styles(names), forecaster_lines(names)
    return {name: {**styles[name], "linestyle": lines[name]} for name in names}


def tracker_styles(names: Iterable[str]) -> dict[str, Style]:
    """Colour and marker of each tracker (or trace) of a report."""
    n = len(_TRACKERS)
    return {
        name: {
            "color": _TRACKERS[i % n],
            "marker": _MARKERS[(i + i // n) % len(_MARKERS)],
            "markersize": 4,
        }
        for i, name in enumerate(dict.fromkeys(names))
    }


P = ParamSpec("P")
T = TypeVar("T")


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Have a function draw in the style of all figures."""

    @wraps(draw)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> T:
        import matplotlib
        from cycler import cycler

        look: dict[Any, Any] = {**_LOOK, "axes.prop_cycle": cycler(color=_TRACKERS)}
        with matplotlib.rc_context(look):
            return draw(*args, **kwargs)

    return in_style


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, of its own: pyplot would keep a list of all.

    A notebook shows it as a picture, whether or not Matplotlib is set up there.
    """
    return _figure_class()(figsize=(width, height), layout="constrained")


@cache
def _figure_class() -> type[Figure]:
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        def _repr_png_(self) -> bytes:
            picture = io.BytesIO()
            self.savefig(picture, format="png", dpi=100)
            return picture.getvalue()

    ShownFigure.__name__ = ShownFigure.__qualname__ = "Figure"
    return ShownFigure


def panel_grid(
    count: int, columns: int, width: float, height: float, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, row by row, each of some inches."""
    columns = min(count, columns)
    rows = -(-count // columns)
    figure = new_figure(max(7.0, width * columns), 0.8 + height * rows)
    panels: list[Axes] = figure.subplots(rows, columns, squeeze=False, **shared).ravel().tolist()
    for axes in panels[count:]:
        axes.remove()
    return figure, panels[:count]


def legend_below(figure: Figure, names: Sequence[str] = ()) -> None:
    """One legend of all panels, below them, in as many columns as fit."""
    handles = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels())
    }
    shown = [name for name in names if name in handles] or list(handles)
    columns = max(1, min(5, 150 // (max(map(len, shown), default=0) + 8)))
    chosen = [handles[name] for name in shown]
    figure.legend(chosen, shown, loc="outside lower center", ncols=min(columns, len(shown) or 1))


def check_format(path: str) -> None:
    """Check that a picture can be drawn to a file of this name.

    Raises:
        LaeError: if its ending is not known.
    """
    if Path(path).suffix[1:].lower() not in new_figure(1, 1).canvas.get_supported_filetypes():
        raise LaeError(f"cannot draw to {path}: name a .png, .svg or .pdf file")


@contextmanager
def any_names(figure: Figure) -> Iterator[None]:
    """Let a figure hold names in any letters, those that its font lacks as boxes."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(visible(text.get_text(), keep="\n"))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing", category=UserWarning)
        yield


def save(figure: Figure, path: str) -> None:
    """Write a figure to a file whose ending says the format.

    Raises:
        LaeError: if it cannot be written, or the ending is not known.
    """
    check_format(path)
    with written_whole(path) as temporary, any_names(figure):
        figure.savefig(temporary, format=Path(path).suffix[1:].lower(), dpi=150)


def laid_out(figure: Figure) -> None:
    """Find the places of what is in a figure, once: to save it would find them twice a file."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
    figure.set_layout_engine("none")


def svg_of(figure: Figure) -> bytes:
    """A figure as SVG, with its text as text; the same figure gives the same bytes."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    file = io.BytesIO()
    settings: dict[Any, Any] = {"svg.hashsalt": "lae_sim", "svg.fonttype": "none"}
    with matplotlib.rc_context(settings), any_names(figure):
        laid_out(figure)
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(file, metadata=dict.fromkeys(("Date", "Creator")))
    return file.getvalue()
