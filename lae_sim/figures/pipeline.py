"""Waterfalls of pipelines: where the time goes, from a frame's capture to its answer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from textwrap import fill
from typing import TYPE_CHECKING, Any

from lae_sim.engine.pipeline import CAMERA
from lae_sim.figures.column import COLUMN, ColumnFigure, column_figure
from lae_sim.figures.labels import bottleneck_text
from lae_sim.figures.style import BLUE, SKY_BLUE, Style, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Report = dict[str, Any]
"""What is said of a trace that was replayed through a pipeline (docs/reference/json.md)."""

_PARTS: Mapping[str, tuple[str, Style]] = {
    "exposure": ("exposure", {"color": "#CFE8F7", "hatch": ""}),
    "delivery": ("delivery", {"color": SKY_BLUE, "hatch": "...."}),
    "queue": ("in the queue", {"color": "white", "hatch": "/////"}),
    "resource": ("for its resource", {"color": "#DDDDDD", "hatch": "xxxxx"}),
    "work": ("work", {"color": BLUE, "hatch": ""}),
    "blocked": ("blocked", {"color": "#777777", "hatch": "-----"}),
}
"""What the parts of a way are called and look like: of other lightness or hatch in grey print."""

_WIDTH = 8.0  # inches


@styled
def waterfall_figure(reports: Sequence[Report], labels: Sequence[str]) -> Figure:
    """Where the time goes from a frame's capture to its answer, a panel for each pipeline.

    Each row is a stage, and begins at the mean age at which frames come to it; the thin line goes
    on to the age that 95 % of them stay within. The diamond below is how old answers are when they
    are asked for. Rows of stages and resources that are too slow say so.

    Args:
        reports: of traces that were replayed through a pipeline.
        labels: what each is called.
    """
    heights = [0.55 + 0.27 * (len(_rows(report)) + 1) for report in reports]
    figure = new_figure(_WIDTH, sum(heights) + 0.7)
    panels: list[Axes] = figure.subplots(
        len(reports), 1, sharex=True, squeeze=False, height_ratios=heights
    )[:, 0].tolist()
    right = 0.0
    for axes, report, label in zip(panels, reports, labels):
        right = max(right, draw_waterfall(axes, report))
        said = f"{label}: {bottleneck_text(report['pipeline'])}"
        axes.set_title(fill(said, 98), loc="left", fontsize=8.5)
        axes.label_outer()
    panels[0].set_xlim(0, right)  # of all
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels())
    }
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


def waterfalls_for_paper(
    reports: Sequence[Report], labels: Sequence[str]
) -> Iterator[ColumnFigure]:
    """The same, a figure for each pipeline."""
    for report, label in zip(reports, labels):
        pipeline = report["pipeline"]
        end = f"-{label}" if len(reports) > 1 else ""
        yield ColumnFigure(
            f"waterfall{end}",
            f"{pipeline['name']}, {report['trace']}: where the time goes from a frame's capture "
            "to its answer (means; lines to the age that 95 % stay within). "
            f"{bottleneck_text(pipeline)}",
            partial(
                column_figure,
                partial(draw_waterfall, report=report, width=COLUMN, size=6.5),
                0.42 + 0.21 * (len(_rows(report)) + 1),
                COLUMN,
            ),
        )


def draw_waterfall(axes: Axes, report: Report, width: float = _WIDTH, size: float = 8) -> float:
    """One pipeline's, its first row on top.

    Args:
        axes: where to.
        report: of a trace that was replayed through a pipeline.
        width: of the figure, inches.
        size: of letters, points.

    Returns:
        The right end of the axis, ms.
    """
    pipeline, result = report["pipeline"], report["results"][0]
    rows = _rows(report)
    begin, notes = 0.0, []
    for row, (name, steps) in enumerate(rows.items()):
        for step in steps:
            label, style = _PARTS[step["part"]]
            look = {"edgecolor": "black", "linewidth": 0.5, "height": 0.62, **style}
            look["facecolor"] = look.pop("color")
            axes.barh(row, step["mean_ms"], left=begin, label=label, **look)
            begin = step["capture_age_ms"]
        end = steps[-1]
        axes.plot([begin, end["capture_age_p95_ms"]], [row, row], color="black", linewidth=0.8)
        axes.plot(end["capture_age_p95_ms"], row, "|", color="black", markersize=5)
        notes.append((row, max(begin, end["capture_age_p95_ms"]), _note(pipeline, name, begin)))
    age = result["capture_age_ms"]
    axes.plot(age, len(rows), "D", color="black", markersize=4)
    notes.append((len(rows), age, f"{age:.0f} ms"))
    for row, place, note in notes:
        axes.annotate(
            note, (place, row), (4, 0), textcoords="offset points", va="center", fontsize=size
        )
    letter = 0.0065 * size / (0.75 * width)  # of the axes' width, about
    right = max(at / max(0.25, 0.97 - letter * len(note)) for _, at, note in notes) or 1
    axes.set_xlim(0, right)
    names = [*(_named(pipeline, name) for name in rows), "when queried"]
    axes.set_yticks(range(len(names)), names)
    axes.set(ylim=(len(rows) + 0.6, -0.6), xlabel="age since capture (ms)")
    axes.grid(axis="y", visible=False)
    for text, name in zip(axes.get_yticklabels(), rows):
        if _is_slow(pipeline, name):
            text.set_fontweight("bold")
    return right


def _rows(report: Report) -> dict[str, list[dict[str, Any]]]:
    """The parts of the way of each stage, those that take no time but the last left out."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for step in report["pipeline"]["waterfall"]:
        rows.setdefault(step["stage"], []).append(step)
    if not rows[CAMERA][-1]["capture_age_p95_ms"]:
        del rows[CAMERA]
    return {
        name: [step for step in steps if step["p95_ms"] or step["part"] == "work"] or steps[-1:]
        for name, steps in rows.items()
    }


def _stage(pipeline: Report, name: str) -> Report:
    return next((each for each in pipeline["stages"] if each["stage"] == name), {})


def _is_slow(pipeline: Report, name: str) -> bool:
    """Whether a stage, or the resource that it needs, is the one that is too slow."""
    slow, stage = pipeline["bottleneck"], _stage(pipeline, name)
    if slow is None or slow["kind"] == "bursts" or not stage:
        return False
    return bool(slow["name"] == (stage["resource"] if slow["kind"] == "resource" else name))


def _named(pipeline: Report, name: str) -> str:
    stage = _stage(pipeline, name)
    return f"{name} ({stage['resource']})" if stage.get("resource") else name


def _note(pipeline: Report, name: str, age: float) -> str:
    """What is said behind a row: the age, and whether frames are lost there, and why."""
    stage = _stage(pipeline, name)
    lost = pipeline["camera"]["lost"] if not stage else sum(stage["dropped"].values())
    came = stage["arrived"] if stage else pipeline["camera"]["frames"]
    said = [f"{age:.0f} ms"]
    if _is_slow(pipeline, name):
        slow = pipeline["bottleneck"]
        what = f"{slow['name']} " if slow["kind"] == "resource" else ""
        said.append(f"{what}too slow: {slow['load']:.0%}")
    if lost / max(came, 1) >= 0.005:
        said.append(f"{lost / came:.0%} lost")
    return ", ".join(said)
