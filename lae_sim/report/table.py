"""Tables for a page, as CSV and as LaTeX."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Entry:
    """One cell of a table.

    Attributes:
        text: as people read it.
        value: what it is sorted by, and what CSV holds; None if unknown.
        ends: of an interval.
        rank: 1 or 2 if it is the best or second best of its column.
    """

    text: str
    value: float | str | None
    ends: tuple[float, float] | None = None
    rank: int = 0


@dataclass(frozen=True)
class Table:
    """A table for a page, CSV and LaTeX.

    Attributes:
        name: of its files.
        caption: what it shows.
        header: of the columns.
        rows: an entry per column.
        left: so many first columns hold names.
        groups: titles above the other columns, each with the number of its columns.
        paper: places of the columns, and of the rows, that fit in a paper; all if None.
        paper_caption: what these show, if it is less.
    """

    name: str
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[Entry, ...], ...]
    left: int
    groups: tuple[tuple[str, int], ...] = ()
    paper: tuple[Sequence[int], Sequence[int]] | None = None
    paper_caption: str = ""


def printable(text: object) -> str:
    """Text without line breaks and control characters, whatever a file holds."""
    return "".join(c if c.isprintable() else " " for c in str(text))


def write_csv(table: Table, path: Path) -> None:
    """Write a table as CSV, with numbers in full; what is unknown is empty."""
    above = [title for title, count in table.groups for _ in range(count)]
    titles = [
        f"{above[c - table.left]} {title}" if above and c >= table.left else title
        for c, title in enumerate(
            f"{before} {title}" if title == "Δ" else title
            for before, title in zip(("", *table.header), table.header)
        )
    ]
    wide = [any(row[c].ends for row in table.rows) for c in range(len(titles))]
    header: list[str] = []
    for title, has_ends in zip(titles, wide):
        header += [title, f"{title} low", f"{title} high"] if has_ends else [title]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for row in table.rows:
            line: list[Any] = []
            for entry, has_ends in zip(row, wide):
                line += [entry.value, *(entry.ends or (None, None))] if has_ends else [entry.value]
            writer.writerow(line)


def latex(table: Table) -> str:
    """A table in LaTeX, of the package booktabs."""
    columns, lines = table.paper or (range(len(table.header)), range(len(table.rows)))
    left = sum(c < table.left for c in columns)
    text = [
        rf"% {printable(table.paper_caption or table.caption)}",
        r"% \usepackage{booktabs}; if it is too wide: \usepackage{adjustbox} and",
        rf"% \adjustbox{{max width=\linewidth}}{{\input{{{table.name}}}}}",
        rf"\begin{{tabular}}{{@{{}}{'l' * left}{'r' * (len(columns) - left)}@{{}}}}",
        r"\toprule",
    ]
    if table.groups:
        titles = [rf"\multicolumn{{{n}}}{{c}}{{{tex(title)}}}" for title, n in table.groups]
        text.append(" & ".join([*[""] * left, *titles]) + r" \\")
        begins = [left + 1 + sum(n for _, n in table.groups[:g]) for g in range(len(titles))]
        text.append("".join(
            rf"\cmidrule(lr){{{begin}-{begin + n - 1}}}"
            for begin, (_, n) in zip(begins, table.groups)
        ))  # fmt: skip
    text += [" & ".join(tex(table.header[c]) for c in columns) + r" \\", r"\midrule"]
    previous = None
    for number_, i in enumerate(lines):
        row = table.rows[i]
        if table.groups and number_ and row[0] != previous:
            text.append(r"\midrule")
        cells = [_ranked(row[c]) for c in columns]
        if table.groups and row[0] == previous:
            cells[0] = ""
        previous = row[0]
        text.append(" & ".join(cells) + r" \\")
    return "\n".join([*text, r"\bottomrule", r"\end{tabular}", ""])


def _ranked(entry: Entry) -> str:
    marks = ("{}", r"\textbf{{{}}}", r"\underline{{{}}}")
    return marks[entry.rank].format(tex(entry.text))


_TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\char34{}",
    "[": "{[}", "Δ": r"$\Delta$", "★": r"$\star$", **{c: "\\" + c for c in "&%$#_{}"},
}  # fmt: skip


def tex(text: str) -> str:
    """Text for LaTeX: what is special there is escaped, and a minus is one."""
    escaped = "".join(_TEX.get(c, c) for c in printable(text))
    return "--" if escaped == "-" else re.sub(r"(?<![\w.-])-(?=\d)", "$-$", escaped)


def table(header: Sequence[str], lines: Sequence[Sequence[str]], left: int = 2) -> str:
    """Aligned columns of text: the first ``left`` to the left, the others to the right."""
    columns = list(zip(header, *lines))
    widths = [max(map(len, column)) for column in columns]

    def aligned(cells: Sequence[str]) -> str:
        padded = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths))
        ]
        return "  ".join(padded).rstrip()

    return "\n".join(
        [aligned(header), aligned(["-" * width for width in widths])] + [*map(aligned, lines)]
    )


METRIC_LABELS = {
    "auc": "AUC",
    "dp20": "DP@20",
    "norm_dp20": "norm. P",
    "norm_auc": "norm. AUC",
    "mauc": "mAUC",
    "mdp20": "mDP@20",
}


def setting_label(latency: str, scale: float) -> str:
    """A latency and its scale, such as ``"recorded x 2"``."""
    return latency if scale == 1 else f"{latency} x {scale:g}"


def p_label(p: float) -> str:
    """A p value as text: ``"0.013"``, ``"<0.001"``, or ``"-"`` if it is NaN."""
    return "<0.001" if p < 0.001 else number_text(p, "{:.3f}")


def number_text(value: float, form: str) -> str:
    """A number, or a dash for what is unknown."""
    return "-" if np.isnan(value) else form.format(value)
