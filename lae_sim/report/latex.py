r"""Tables in LaTeX, in the environment ``table``, with caption and label, for ``\\input``.

They need the packages booktabs and graphicx. A table has two forms: a short one that fits a column,
and a long one, a ``table*``, that fits a page of two columns. Scores are written as papers do,
without the zero before the point; one that is still too wide is made smaller.
"""

from __future__ import annotations

import re

from lae_sim.errors import visible
from lae_sim.report.table import (
    FINE_SCORE,
    SCORE,
    SIGNED,
    UNKNOWN,
    Cell,
    Column,
    Table,
    p_label,
)

_BELOW_ONE = (SCORE, FINE_SCORE, SIGNED, p_label)  # forms of what papers write without the zero


def latex_of(table: Table, is_long: bool = False) -> str:
    r"""A table in LaTeX.

    Names are written as they are, in UTF-8, which LaTeX reads by default; where they have letters
    for which pdflatex has no font, a comment says so.

    Args:
        table: the table, of few columns if it is to fit a column.
        is_long: whether it may be as wide as both columns of a page. Its label ends in ``-long``
            then, so that a paper may have both, and it has intervals.
    """
    environment = "table*" if is_long else "table"
    label = f"tab:{table.name}{'-long' if is_long else ''}"
    text = [
        r"% \usepackage{booktabs,graphicx}",
        rf"\begin{{{environment}}}[t]",
        rf"\caption{{{tex(table.caption)}.}}",
        rf"\label{{{label}}}",
        r"\smallskip\centering\footnotesize",
        rf"\setlength{{\tabcolsep}}{{{4 if is_long else 3}pt}}",
        r"\sbox0{%",
        *_tabular(table, is_long),
        r"}%",
        r"\ifdim\wd0>\linewidth\resizebox{\linewidth}{!}{\usebox0}\else\usebox0\fi",
        rf"\end{{{environment}}}",
        "",
    ]
    if foreign := sorted({c for c in "".join(text) if not _has_font(c)}):
        text.insert(1, f"% compile with lualatex or xelatex, and a font for {''.join(foreign)}")
    return "\n".join(text)


def _tabular(table: Table, intervals: bool) -> list[str]:
    labels, groups = table.labels, table.groups
    text = [
        rf"\begin{{tabular}}{{@{{}}{'l' * labels}{'r' * (len(table.columns) - labels)}@{{}}}}",
        r"\toprule",
    ]
    if groups:
        titles = [rf"\multicolumn{{{n}}}{{c}}{{{tex(title)}}}" for title, n in groups]
        text.append(" & ".join([*[""] * labels, *titles]) + r" \\")
        begins = [labels + 1 + sum(n for _, n in groups[:g]) for g in range(len(groups))]
        text.append("".join(
            rf"\cmidrule(lr){{{begin}-{begin + n - 1}}}" for begin, (_, n) in zip(begins, groups)
        ))  # fmt: skip
    text += [" & ".join(map(tex, table.header)) + r" \\", r"\midrule"]
    previous = None
    for row in table.rows:
        cells = [_cell(*each, intervals) for each in zip(table.columns, row)]
        if groups and row[0] == previous:
            cells[0] = ""
        elif groups and previous is not None:
            text.append(r"\midrule")
        previous = row[0]
        text.append(" & ".join(cells) + r" \\")
    return [*text, r"\bottomrule", r"\end{tabular}"]


def _cell(column: Column, cell: Cell, interval: bool) -> str:
    """A cell: the best in bold, the second underlined."""
    if cell == UNKNOWN:
        return "--"
    text = cell.text if interval or cell.interval is None else column.form(cell.value)
    if column.form in _BELOW_ONE:
        text = re.sub(r"(?<![\d.])0(?=\.\d)", "", text)
    marks = ("{}", r"\textbf{{{}}}", r"\underline{{{}}}")
    return marks[cell.rank].format(tex(text))


def _has_font(character: str) -> bool:
    """Whether pdflatex can set a character: Latin 1 and 2, and some punctuation."""
    return character < "\u0180" or "\u2013" <= character <= "\u2026"


_TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\char34{}",
    "[": "{[}", "*": "{*}", "Δ": r"$\Delta$", "★": r"$\star$", "σ": r"$\sigma$",  # noqa: RUF001
    **{c: "\\" + c for c in "&%$#_{}"},
}  # fmt: skip


def tex(text: str) -> str:
    """Text for LaTeX: what is special there is escaped, and a minus is one.

    So are a star and a bracket, which the end of the line above would take for its own, and no two
    signs melt into one, as ``--`` and ``?`` with a grave accent would.
    """
    escaped = "".join(_TEX.get(c, c) for c in visible(text))
    minus = re.sub(r"(?<![\w.-])-(?=\.?\d)", "$-$", escaped)
    return re.sub(r"(?<=[-'`,?!])(?=[-'`,])", "{}", minus)
