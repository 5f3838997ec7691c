"""The report of a study: one HTML page that needs nothing else.

Pictures are SVG files within the page, as images, so that nothing in them is looked up or run. All
text is escaped, and the page's own policy lets no script run but the one that sorts tables.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from lae_sim import __version__
from lae_sim.evaluation.metrics import CONVENTIONS, Convention
from lae_sim.files import written_whole
from lae_sim.report import study_figures, study_tables
from lae_sim.report.study_figures import SWEEPS, Picture
from lae_sim.report.study_tables import LEGEND
from lae_sim.report.study_view import View, primary
from lae_sim.report.table import Entry, Table, printable

if TYPE_CHECKING:
    from lae_sim.study.run import StudyResults

STALLS = 5
"""Stalls that are listed of each trace."""

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2330; --soft: #5b6475; --page: #fff; --line: #d5dae3;
  --head: #eef1f6; --mark: #fff6d8; --link: #0b5cad }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ef; --soft: #a3adbd; --page: #14181f;
  --line: #38404d; --head: #212835; --mark: #3b3418; --link: #7db7f5 } }
* { box-sizing: border-box }
body { margin: 0 auto; max-width: 82rem; padding: 1.5rem 1.5rem 4rem; background: var(--page);
  color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif }
h1 { font-size: 1.9rem; line-height: 1.2; margin: .5rem 0 }
h2 { font-size: 1.35rem; margin: 2.8rem 0 .6rem; padding-top: .8rem;
  border-top: 1px solid var(--line) }
p, ul, dl { max-width: 46rem }
a { color: var(--link) }
nav ul { columns: 15rem; padding-left: 1.2rem }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.2rem }
dt { color: var(--soft) } dd { margin: 0; overflow-wrap: anywhere }
.scroll { overflow: auto; max-height: 85vh; border: 1px solid var(--line); border-radius: 6px;
  margin: .8rem 0 }
table { border-collapse: separate; border-spacing: 0; font-size: .84rem; width: 100%;
  font-variant-numeric: tabular-nums }
caption { text-align: left; padding: .5rem .7rem; color: var(--soft) }
caption span { position: sticky; left: .7rem; display: inline-block; max-width: min(46rem, 90vw) }
th, td { padding: .28rem .7rem; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line) }
thead th, thead td { position: sticky; top: 0; z-index: 2; background: var(--head) }
thead tr:nth-child(2) th { top: 1.9rem }
thead tr.groups > * { text-align: center; height: 1.9rem }
tr > th.name:first-child { position: sticky; left: 0 } thead th.name:first-child { z-index: 3 }
tbody th.name:first-child { background: var(--page); z-index: 1 }
th.name { text-align: left; font-weight: 400 } thead th { font-weight: 600 }
th button { all: unset; cursor: pointer } th button:focus-visible { outline: 2px solid var(--link) }
th button::after { content: " \\2195"; color: var(--soft) }
th[aria-sort=ascending] button::after { content: " \\2191"; color: inherit }
th[aria-sort=descending] button::after { content: " \\2193"; color: inherit }
tbody tr:hover > * { background: var(--head) }
.second { text-decoration: underline }
figure { margin: 1rem 0 1.6rem }
figure img { display: block; max-width: 100%; height: auto; background: #fff; padding: .5rem;
  border: 1px solid var(--line); border-radius: 6px }
figcaption { color: var(--soft); font-size: .9rem; max-width: 46rem; margin-top: .4rem }
details { margin: .5rem 0; border: 1px solid var(--line); border-radius: 6px; padding: .3rem .8rem }
summary { cursor: pointer; font-weight: 600 }
pre { overflow-x: auto; font-size: .8rem; line-height: 1.4 }
.warning { background: var(--mark); padding: .1rem .4rem; border-radius: 4px }
@media print { body { max-width: none; font-size: 11px } .scroll { max-height: none;
  overflow: visible; border: 0 } nav { display: none }
  thead th, thead td, tr > th.name:first-child { position: static }
  figure, tr { break-inside: avoid } h2 { break-after: avoid }
  table { font-size: 7px } th, td { padding: 1px 3px } }
"""

_SCRIPT = """
"use strict";
function order(values, descending) {
  const known = v => v !== null && v !== "";
  const less = (a, b) => typeof a === "number" && typeof b === "number" ? a - b
    : String(a).localeCompare(String(b), "en", { numeric: true });
  return values.map((_, i) => i).sort((i, j) => {
    const a = values[i], b = values[j];
    if (!known(a) || !known(b)) return known(b) - known(a) || i - j;
    return (descending ? less(b, a) : less(a, b)) || i - j;
  });
}
function value(cell) {
  if (!cell.hasAttribute("data-v")) return cell.textContent;
  const text = cell.getAttribute("data-v");
  return text === "" ? null : Number(text);
}
function sortable(table) {
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const body = table.tBodies[0], rows = [...body.rows];
      const values = rows.map(row => value(row.cells[column]));
      const sorted = head.getAttribute("aria-sort");
      const numbers = values.some(v => typeof v === "number");
      const descending = sorted ? sorted === "ascending" : numbers;
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      body.append(...order(values, descending).map(i => rows[i]));
    });
  });
}
if (typeof document !== "undefined") document.querySelectorAll("table.sortable").forEach(sortable);
"""

_PAIRS = (
    "<p><i>a better here</i>: probability that one run of a beats one of b on these sequences; "
    "<i>a better</i>: on others like them. p: Wilcoxon's signed-rank test; Holm: corrected for the "
    "number of pairs of a setting.</p>"
)

Section = tuple[str, str, Iterable[str]]


def write_report(results: StudyResults | View, path: str | os.PathLike[str]) -> None:
    """Write the report.

    Args:
        results: of a study, or a view of them; the same ones give the same bytes.
        path: of the page.

    Raises:
        LaeError: if the file cannot be written.
    """
    with written_whole(path) as temporary:
        view = results if isinstance(results, View) else View(results)
        temporary.write_text(page(view), "utf-8")


def page(view: View) -> str:
    """The report's HTML."""
    results = view.results
    sections = [
        (anchor, title, text)
        for anchor, title, parts in _sections(view)
        if (text := "\n".join(parts))
    ]
    contents = "".join(f'<li><a href="#{a}">{escape(t)}</a></li>' for a, t, _ in sections)
    body = "\n".join(
        f'<section id="{a}"><h2>{escape(t)}</h2>\n{text}\n</section>' for a, t, text in sections
    )
    allowed = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-"
    datasets = dict.fromkeys(printable(row["dataset"]) for row in results.summary)
    title = f"Latency-aware study: {', '.join(datasets)}"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}{allowed}'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<header><h1>{escape(title)}</h1>
{_facts(results)}
</header>
<nav aria-label="Contents"><ul>{contents}</ul></nav>
<main>
{body}
</main>
<script>{_SCRIPT}</script>
</body>
</html>
"""


def _facts(results: StudyResults) -> str:
    """What was studied, in a few lines."""
    rows, study = primary(results.summary), results.plan.study
    shares = [row["approximate_share"] for row in rows if not row["exact"]]
    told = "every replay is exact"
    if shares:
        told = (
            f"{sum(row['exact'] for row in rows):,} of {len(rows):,} rows are exact; in the others "
            f"up to {100 * max(shares):.3g}% of the outputs follow another frame than when "
            "recorded, which makes a tracker that remembers look better than it is"
        )
    repeated = max(row["repetitions"] for row in rows)
    facts = {
        "traces": f"{len(results.traces)}; trackers: {len({row['tracker'] for row in rows})}",
        "forecasters": ", ".join(dict.fromkeys(row["forecaster"] for row in rows)),
        "cells": f"{len(results.plan.cells):,}, {len(results.failures):,} pieces failed",
        "repetitions": f"{repeated:,} of random latencies" if repeated > 1 else "1",
        "replays": told,
        "uncertainty": f"[ ]: 95 % percentile bootstrap over sequences, seed {study.seed}",
        "made with": f"lae_sim {__version__}",
    }
    made_up = [
        f"{source.input.label}: {source.metadata.timing_note}"
        for source in results.plan.sources
        if source.metadata.timing_note
    ]
    return _pairs({**facts, **({"times": "; ".join(made_up)} if made_up else {})})


def _sections(view: View) -> Iterator[Section]:
    results = view.results
    ranking = study_tables.ranking(view)
    meanings = {title: LEGEND[title] for title in ranking.header if title in LEGEND}
    columns = f"<details><summary>What the columns mean</summary>{_pairs(meanings)}</details>"
    yield "failures", "Failures", _list([f"{f['of']}: {f['reason']}" for f in results.failures])
    yield "ranking", "Ranking", [columns, _table(ranking)]
    yield "table2", "With and without forecasters", [_table(study_tables.table2(view))]
    yield "curves", "Success and precision", _figures(study_figures.curves(view))
    swept = (study_figures.sweep(view, key) for key in SWEEPS)
    yield "sweeps", "Over permitted latency, speed and rate", _figures(swept)
    yield "front", "Accuracy against time", _figures([study_figures.front(view)])
    yield "gains", "What forecasters win", _figures([study_figures.gains(view)])
    if table := study_tables.attribute_table(view):
        shown = [*_figures(study_figures.attributes(view)), _table(table)]
        yield "attributes", "Attributes", shown
    if results.comparisons:
        shown = [_PAIRS, _table(study_tables.comparison_table(view))]
        yield "comparisons", "Trackers against each other", shown
    if results.required:
        shown = [_table(study_tables.required_table(view))]
        yield "required", "What the required AUC asks for", shown
    pictures = _figures([study_figures.histograms(view)])
    yield "times", "Processing times", [*pictures, _table(_times(results))]
    digests = {source.input.label: source.input.digest for source in results.plan.sources}
    told = [_provenance(trace, digests.get(trace["trace"], "unknown")) for trace in results.traces]
    yield "traces", "Traces", told
    used = dict.fromkeys(row["convention"] for row in results.summary)
    meant = {name: told_convention(CONVENTIONS[name]) for name in used}
    yield "conventions", "Conventions", [_pairs(meant)]
    yield "notes", "Notes", _list(results.notes())
    asked = _json(results.plan.study.document())
    yield "study", "The study", [f"<details><summary>What was asked for</summary>{asked}</details>"]


def _list(texts: Sequence[str], kind: str = "") -> list[str]:
    items = "".join(f"<li{kind}>{escape(printable(text))}</li>" for text in texts)
    return [f"<ul>{items}</ul>"] if items else []


def _json(document: Any) -> str:
    text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False)
    return f"<pre>{escape(text)}</pre>"


def _figures(pictures: Iterable[Picture | None]) -> Iterator[str]:
    return (_figure(picture) for picture in pictures if picture is not None)


def _figure(picture: Picture) -> str:
    caption = escape(picture.caption)
    if not picture.svg:
        return f"<p>{caption}</p>"
    image = base64.b64encode(picture.svg).decode()
    return (
        f'<figure><img alt="{caption}" src="data:image/svg+xml;base64,{image}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _table(table: Table) -> str:
    """A table that can be sorted, where scripts run."""
    groups = ""
    if table.groups:
        cells = "".join(
            f'<th colspan="{count}" scope="colgroup">{escape(title)}</th>'
            for title, count in table.groups
        )
        groups = f'<tr class="groups"><td colspan="{table.left}"></td>{cells}</tr>'
    heads = "".join(
        f'<th scope="col"{_named(c < table.left)}{_meaning(title)}>{escape(title)}</th>'
        for c, title in enumerate(table.header)
    )
    lines = "\n".join(
        "<tr>" + "".join(_cell(entry, c < table.left) for c, entry in enumerate(row)) + "</tr>"
        for row in table.rows
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(table.name)}">'
        f'<table class="sortable"><caption><span>{escape(table.caption)}</span></caption>'
        f"<thead>{groups}<tr>{heads}</tr></thead><tbody>\n{lines}\n</tbody></table></div>"
    )


def _named(name: bool) -> str:
    return ' class="name"' if name else ""


def _meaning(title: str) -> str:
    return f' title="{escape(LEGEND[title])}"' if title in LEGEND else ""


def _cell(entry: Entry, name: bool) -> str:
    text = escape(entry.text)
    if name:
        return f'<th scope="row" class="name">{text}</th>'
    text = ("{}", "<b>{}</b>", '<span class="second">{}</span>')[entry.rank].format(text)
    if isinstance(entry.value, str):
        return f"<td>{text}</td>"
    return f'<td data-v="{"" if entry.value is None else entry.value}">{text}</td>'


def _pairs(facts: dict[str, str]) -> str:
    told = (f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return f"<dl>{''.join(told)}</dl>"


def _times(results: StudyResults) -> Table:
    """A row per trace: how its processing times are distributed."""
    rows = []
    for trace in results.traces:
        times, name = trace["times"], printable(trace["trace"])
        calls, share, stalls = times["calls"], times["slower_than_frames"], len(times["stalls"])
        rows.append((
            Entry(name, name), Entry(f"{calls['n']:,}", calls["n"]),
            *(_number(calls.get(f"{key}_ms"), ".1f") for key in ("median", "p95", "p99", "max")),
            Entry(f"{100 * share:.1f}%", share), _number(times["drift"].get("ratio"), ".2f"),
            Entry(f"{stalls:,}", stalls),
        ))  # fmt: skip
    header = ("trace", "calls", "median ms", "p95", "p99", "longest", "slower than frames", "drift")
    caption = (
        "Times of the calls but the initialisations; drift: the last third of the run to the "
        "first; stalls: calls of over ten times the median"
    )
    return Table("times", caption, (*header, "stalls"), tuple(rows), 1)


def _number(value: float | None, form: str) -> Entry:
    return Entry("-" if value is None else f"{value:{form}}", value)


def _provenance(trace: dict[str, Any], digest: str) -> str:
    """What a trace says of itself, and what to know of its times."""
    stalls = trace["times"]["stalls"]
    told = [
        f"stall: {stall['ms']:.1f} ms in {stall['sequence']}, frame {stall['frame']}"
        + (" (first call after the initialisation)" if stall["first_call"] else "")
        for stall in stalls[:STALLS]
    ]
    told += [f"{len(stalls) - STALLS:,} more stalls"] if len(stalls) > STALLS else []
    frames = (
        f"{trace['world_frames']:,} frames in {trace['sequences']:,} sequences at {trace['fps']} "
        f"fps; {trace['processed']:,} processed, {trace['with_truth']:,} with truth; images: "
        + ", ".join(trace["image_sizes"])
    )
    lists = [
        *_list(trace["warnings"], ' class="warning"'),
        *_list([frames, f"SHA-256 of the file: {digest}", *told]),
    ]
    name = escape(printable(trace["trace"]))
    about = _json(trace["provenance"])
    return f"<details><summary>{name}</summary>{''.join(lists)}{about}</details>"


def told_convention(convention: Convention) -> str:
    """How a convention counts, in words."""
    valid = {
        "size": "its width and height are > 0",
        "positive": "x, y, width and height are > 0",
        "finite": "it has no NaN",
    }[convention.valid]
    invalid = (
        "frames without leave both metrics"
        if convention.leaves_out
        else "others are misses of AUC, and hits of DP where the truth's centre is not > 0"
    )
    parts = [f"AUC is the mean over {convention.thresholds} thresholds of the share of frames with "
             f"IoU > t, so that a perfect tracker has {1 - 1 / convention.thresholds:.3f}",
             f"the truth counts if {valid}; {invalid}"]  # fmt: skip
    if convention.first_frame_is_truth:
        parts.append("the answer for frame 0 is replaced by the truth")
    if convention.drops_zeros:
        parts.append("sequences that score 0 everywhere leave the mean")
    return "; ".join(parts) + ". DP: share of frames with a centre error of at most 20 px."
