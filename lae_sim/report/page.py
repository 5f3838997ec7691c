"""The report of a study: one HTML page that needs nothing else.

It can be read without its script, which sorts tables, chooses their columns, saves figures and
moves through sequences. The template escapes all text, and the page's own policy lets no other
script run and nothing be fetched.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import TYPE_CHECKING, Any

from lae_sim import __version__
from lae_sim.errors import listed, visible
from lae_sim.evaluation.metrics import CONVENTIONS, Convention
from lae_sim.figures import study as study_figures
from lae_sim.figures.study import SWEEPS, Picture
from lae_sim.figures.style import BLUE, VERMILION, svg_of
from lae_sim.files import written_whole
from lae_sim.report import study_tables
from lae_sim.report.closeup import CloseUp, close_ups
from lae_sim.report.inline import dark_colours, inlined, variable
from lae_sim.report.study_tables import MOST_LINES, MOST_ROWS, some_of
from lae_sim.report.table import COUNT, PERCENT, Column, Number, Table
from lae_sim.study.verdict import shortfalls
from lae_sim.study.view import View

if TYPE_CHECKING:
    from lae_sim.study.run import StudyResults

STALLS, MOST_NAMES = 5, 3
"""Stalls that are listed of each trace, and traces that are named for what they share."""


@dataclass(frozen=True)
class Entry:
    """Something that can be unfolded.

    Attributes:
        title: what is seen before.
        document: what is shown as JSON.
        warnings, texts: lists before it.
    """

    title: str
    document: str
    warnings: Sequence[str] = ()
    texts: Sequence[str] = ()


@dataclass(frozen=True)
class Section:
    """A section of the page; what is empty is not shown.

    Attributes:
        anchor, title: its link and heading.
        texts: a list.
        facts: definitions.
        meanings: those of the table's columns.
        pictures: before the table.
        table: can be sorted.
        close_ups: sequences frame by frame.
        entries: things that can be unfolded.
    """

    anchor: str
    title: str
    texts: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    meanings: Mapping[str, str] = field(default_factory=dict)
    pictures: Sequence[Picture] = ()
    table: Table | None = None
    close_ups: Sequence[CloseUp] = ()
    entries: Sequence[Entry] = ()

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to show."""
        return not any(getattr(self, each.name) for each in fields(self)[2:])


def write_report(
    results: StudyResults | View,
    path: str | os.PathLike[str],
    root: str | os.PathLike[str] | None = None,
) -> None:
    """Write the report.

    Args:
        results: of a study, or a view of them; the same ones give the same bytes.
        path: of the page.
        root: folder of the dataset, whose images a few sequences are shown with; synthetic ones
            need none.

    Raises:
        LaeError: if the file cannot be written.

    Example:
        >>> import pathlib, tempfile
        >>> import lae_sim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     results = lae_sim.run_study(
        ...         traces="traces/synthetic-slow.parquet", folder=folder, workers=1, report=False
        ...     )
        ...     lae_sim.write_report(results, f"{folder}/page.html")
        ...     print(pathlib.Path(folder, "page.html").read_text("utf-8").split()[0])
        <!DOCTYPE
    """
    with written_whole(path) as temporary:
        view = results if isinstance(results, View) else View(results)
        temporary.write_text(page(view, root), "utf-8", "backslashreplace")


def page(view: View, root: str | os.PathLike[str] | None = None) -> str:
    """The report's HTML (see :func:`write_report`)."""
    sections = page_sections(view, root)
    drawn = {name: draw() for name, draw in page_drawings(sections).items()}
    return page_of(view, sections, drawn)


def page_drawings(sections: Iterable[Section]) -> dict[str, Callable[[], str]]:
    """What draws each picture of some sections, by its name; it can be pickled."""
    return {
        f"{section.anchor}-{number}": partial(_drawn, picture, f"{section.anchor}-{number}")
        for section in sections
        for number, picture in enumerate(section.pictures, 1)
        if picture.draw is not None
    }


def _drawn(picture: Picture, name: str) -> str:
    """A picture as a part of the page; the name sets its identifiers apart."""
    assert picture.draw is not None
    return inlined(svg_of(picture.draw()), picture.caption, name)


def page_of(view: View, sections: Sequence[Section], drawn: Mapping[str, str]) -> str:
    """The page of some sections, with what came of their :func:`page_drawings`."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("lae_sim.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "visible": visible,
        "variable": variable,
        "base64": lambda data: base64.b64encode(data).decode(),
        "sha256": lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode(),
    }
    datasets = dict.fromkeys(visible(row.dataset) for row in view.results.summary)
    return environment.get_template("page.html").render(
        title=f"Latency-aware study: {', '.join(datasets)}",
        conclusion=view.results.verdict(),
        facts=_facts(view),
        sections=sections,
        style=page_file("page.css"),
        drawn=drawn,
        dark=page_file("dark.css") + _dark_figures(sections, drawn.values()),
        script=page_file("page.js"),
    )


def _dark_figures(sections: Iterable[Section], drawn: Iterable[str]) -> str:
    """The rule of CSS that makes the colours of figures those of a dark page."""
    colours = (
        " ".join(each.colours.values()) for section in sections for each in section.close_ups
    )
    variables = {**dark_colours([BLUE, VERMILION]), **dark_colours([*drawn, *colours])}
    return f":root {{ {'; '.join(f'{name}: {colour}' for name, colour in variables.items())} }}"


def page_file(name: str) -> str:
    """The page's CSS or JavaScript."""
    from importlib.resources import files

    return (files("lae_sim.report") / "templates" / name).read_text("utf-8")


def _facts(view: View) -> dict[str, str]:
    """What was studied, in a few lines."""
    rows, results = view.rows, view.results
    shares = [row.approximate_share for row in rows if not row.exact]
    replays = "every replay is exact"
    if shares:
        replays = (
            f"{sum(row.exact for row in rows):,} of {len(rows):,} rows are exact; in the others "
            f"up to {100 * max(shares):.3g}% of the outputs follow another frame than when "
            "recorded, which makes a tracker that remembers look better than it is"
        )
    repeated = max(row.repetitions for row in rows)
    facts = {
        "traces": f"{len(results.traces)}; trackers: {len({row.tracker for row in rows})}",
        "forecasters": ", ".join(dict.fromkeys(row.forecaster for row in rows)),
        "cells": f"{len(results.plan.cells):,}, {len(results.failures):,} pieces failed",
        "repetitions": f"{repeated:,} of random latencies" if repeated > 1 else "1",
        "replays": replays,
        **_search_facts(results),
        "initialisation": "; ".join(results.init_sources()),
        "uncertainty": "[ ]: 95 % percentile bootstrap over sequences, seed "
        f"{results.plan.study.seed}; p: Wilcoxon's signed-rank test, in the conclusion corrected "
        "by Holm's method for the number of those compared with the best",
        "made with": f"lae_sim {__version__}",
    }
    times = "; ".join(results.timing_sources())
    return {**facts, **({"times": times} if times else {})}


def _search_facts(results: StudyResults) -> dict[str, str]:
    """What modelled scores rest on, and by what is ranked; empty where nothing is modelled."""
    if not (sources := results.search_sources()):
        return {}
    traces: dict[str, list[str]] = {}
    for source in sources:
        trace, _, what = source.partition(": ")
        traces.setdefault(what, []).append(trace)
    said = [f"{listed(some, MOST_NAMES)}: {what}" for what, some in traces.items()]
    return {"search model": "; ".join(said), "ranking": "; ".join(results.ranked_by())}


def page_sections(view: View, root: str | os.PathLike[str] | None = None) -> list[Section]:
    """The sections of a study's page that are not empty, their pictures not drawn yet."""
    return [section for section in _sections(view, root) if not section.is_empty]


def _sections(view: View, root: str | os.PathLike[str] | None) -> Iterator[Section]:
    results = view.results
    failures = [f"{failure.of}: {failure.reason}" for failure in results.failures]
    yield Section("failures", "Failures", texts=some_of(failures, "study.json"))
    ranking = study_tables.ranking(view, most=MOST_ROWS)
    meanings = {column.title: column.meaning for column in ranking.columns if column.meaning}
    yield Section("ranking", "Ranking", meanings=meanings, table=ranking)
    yield Section("table2", "With and without forecasters", table=study_tables.table2(view))
    yield Section("curves", "Success and precision", pictures=[*study_figures.curves(view)])
    sweeps = _known(*(study_figures.sweep(view, key) for key in SWEEPS))
    yield Section("sweeps", "Over permitted latency, speed and rate", pictures=sweeps)
    front = _known(study_figures.front(view))
    yield Section("front", "Accuracy against time", pictures=front)
    energy = _known(study_figures.front(view, study_figures.ENERGY))
    yield Section("energy", "Accuracy against energy", pictures=energy)
    yield Section("gains", "What forecasters win", pictures=_known(study_figures.gains(view)))
    sequences, texts = close_ups(view, root)
    yield Section("sequences", "Frame by frame", texts=texts, close_ups=sequences)
    if attributes := study_tables.attribute_table(view):
        pictures = [*study_figures.attributes(view)]
        yield Section(
            "attributes",
            "Attributes",
            pictures=pictures,
            table=attributes.first(MOST_ROWS, "tables/attributes.csv"),
        )
    if results.comparisons:
        compared = study_tables.comparison_table(view)
        yield Section("comparisons", "Trackers against each other", table=compared)
    if results.required:
        required = study_tables.required_table(view).first(MOST_ROWS, "required.csv")
        texts = shortfalls(results.required, view.names)
        yield Section("required", "What the required AUC asks for", texts=texts, table=required)
    histograms = _known(study_figures.histograms(view))
    yield Section(
        "times",
        "Processing times",
        pictures=histograms,
        table=_times(results).first(MOST_ROWS, "study.json"),
    )
    digests = {source.input.label: source.input.digest for source in results.plan.sources}
    traces = [
        _provenance(trace, digests.get(trace["trace"], "unknown"))
        for trace in results.traces[:MOST_LINES]
    ]
    left = len(results.traces) - len(traces)
    texts = [f"the first {len(traces)}; {left:,} more are in study.json"] if left else []
    yield Section("traces", "Traces", texts=texts, entries=traces)
    used = dict.fromkeys(row.convention for row in results.summary)
    conventions = {name: convention_in_words(CONVENTIONS[name]) for name in used}
    yield Section("conventions", "Conventions", facts=conventions)
    yield Section("notes", "Notes", texts=some_of(results.notes(), "study.json"))
    asked = Entry("What was asked for", _json(results.plan.study.document()))
    yield Section("study", "The study", entries=[asked])


def _known(*pictures: Picture | None) -> list[Picture]:
    return [picture for picture in pictures if picture is not None]


def _json(document: Any) -> str:
    text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False)
    return visible(text, keep="\n")


def _times(results: StudyResults) -> Table:
    """A row per trace: how its processing times are distributed."""
    rows = [
        {
            "trace": trace["trace"],
            **trace["times"]["calls"],
            "slower": trace["times"]["slower_than_frames"],
            "drift": trace["times"]["drift"].get("ratio"),
            "stalls": len(trace["times"]["stalls"]),
        }
        for trace in results.traces
    ]
    ms = Number(".1f")
    columns = [
        Column("trace", "trace", is_label=True),
        Column("calls", "n", COUNT),
        Column("median ms", "median_ms", ms),
        Column("p95", "p95_ms", ms),
        Column("p99", "p99_ms", ms),
        Column("longest", "max_ms", ms),
        Column("slower than frames", "slower", PERCENT),
        Column("drift", "drift", Number(".2f")),
        Column("stalls", "stalls", COUNT),
    ]
    caption = (
        "Times of the calls but the initialisations; drift: the last third of the run to the "
        "first; stalls: calls of over ten times the median"
    )
    return Table.of(columns, rows, "times", caption)


def _provenance(trace: Mapping[str, Any], digest: str) -> Entry:
    """What a trace says of itself, and what to know of its times."""
    stalls = trace["times"]["stalls"]
    texts = [
        f"{trace['world_frames']:,} frames in {trace['sequences']:,} sequences at {trace['fps']} "
        f"fps; {trace['processed']:,} processed, {trace['with_truth']:,} with truth; images: "
        + ", ".join(trace["image_sizes"]),
        f"SHA-256 of the file: {digest}",
    ]
    texts += [
        f"stall: {stall['ms']:.1f} ms in {stall['sequence']}, frame {stall['frame']}"
        + (" (first call after the initialisation)" if stall["first_call"] else "")
        for stall in stalls[:STALLS]
    ]
    texts += [f"{len(stalls) - STALLS:,} more stalls"] if len(stalls) > STALLS else []
    name = visible(trace["trace"])
    return Entry(name, _json(trace["provenance"]), trace["warnings"], texts)


def convention_in_words(convention: Convention) -> str:
    """How a convention counts, in words."""
    valid = {
        "size": "its width and height are > 0",
        "positive": "x, y, width and height are > 0",
        "finite": "it has no NaN",
    }[convention.valid]
    if convention.by_visible:
        valid += " and the target is not said to be absent"
    divided = ", but are divided by" if convention.of_all else ""
    invalid = (
        f"frames without leave both metrics{divided}"
        if convention.leaves_out
        else "others are misses of AUC, "
        + (
            "and hits of DP where the truth's centre is not > 0"
            if convention.by_centre
            else "and hits of DP"
        )
    )
    parts = [f"AUC is the mean over {convention.thresholds} thresholds of the share of frames with "
             f"IoU > t, so that a perfect tracker has {1 - 1 / convention.thresholds:.3f}",
             f"the truth counts if {valid}; {invalid}"]  # fmt: skip
    if convention.first_frame_is_truth:
        parts.append("the answer for frame 0 is replaced by the truth")
    if convention.keeps_answer:
        parts.append("an answer of no size takes the one for the frame before")
    if convention.drops_zeros:
        parts.append("sequences that score 0 everywhere leave the mean")
    return "; ".join(parts) + ". DP: share of frames with a centre error of at most 20 px."
