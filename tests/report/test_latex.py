"""Tables in LaTeX: their environment, both widths, numbers as papers write them, hostile names."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from lae_sim.report.latex import latex_of, tex
from lae_sim.report.table import PERCENT, SCORE, SIGNED, Cell, Column, Number, Table, p_label

COLUMNS = [
    Column("tracker", "name", is_label=True),
    Column("AUC", "auc", SCORE),
    Column("lost", "lost", PERCENT),
]
RECORDS = [
    {"name": "slow\n", "auc": 0.51249, "auc_low": 0.4, "auc_high": 0.6, "lost": -0.48751},
    {"name": "fast & rough", "auc": None, "lost": None},
]
TABLE = Table.of(COLUMNS, RECORDS, "t", "What there is")


def rows_of(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.endswith(r" \\")]


def test_golden_latex() -> None:
    rows = (
        (Cell("A_1", "A_1"), Cell("hold", "hold"), Cell("0.512", 0.512, rank=2)),
        (Cell("A_1", "A_1"), Cell("kalman", "kalman"), Cell("-0.600", -0.6, rank=1)),
        (Cell("B", "B"), Cell("hold", "hold"), Cell("-", None)),
    )
    columns = (
        Column("tracker", str, is_label=True),
        Column("f", str, is_label=True),
        Column("Δ", str, SCORE, group="D&D"),
    )
    table = Table("t", "What 50% is", columns, rows)
    assert latex_of(table) == "\n".join([
        r"% \usepackage{booktabs,graphicx}",
        r"\begin{table}[t]",
        r"\caption{What 50\% is.}",
        r"\label{tab:t}",
        r"\smallskip\centering\footnotesize",
        r"\setlength{\tabcolsep}{3pt}",
        r"\sbox0{%",
        r"\begin{tabular}{@{}llr@{}}",
        r"\toprule",
        r" &  & \multicolumn{1}{c}{D\&D} \\",
        r"\cmidrule(lr){3-3}",
        r"tracker & f & $\Delta$ \\",
        r"\midrule",
        r"A\_1 & hold & \underline{.512} \\",
        r" & kalman & \textbf{$-$.600} \\",
        r"\midrule",
        r"B & hold & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"}%",
        r"\ifdim\wd0>\linewidth\resizebox{\linewidth}{!}{\usebox0}\else\usebox0\fi",
        r"\end{table}",
        "",
    ])  # fmt: skip


def test_the_short_form_has_no_intervals_and_the_long_one_spans_both_columns() -> None:
    short, long = latex_of(TABLE), latex_of(TABLE, is_long=True)
    assert rows_of(short)[1] == r"slow\textbackslash{}n & .512 & $-$48.8\% \\"
    assert rows_of(long)[1] == r"slow\textbackslash{}n & .512 {[}.400, .600] & $-$48.8\% \\"
    assert [r"\begin{table}[t]" in short, r"\begin{table*}[t]" in long] == [True, True]
    labels = [re.findall(r"\\label{(.*)}", text) for text in (short, long)]
    assert labels == [["tab:t"], ["tab:t-long"]]
    assert rows_of(short)[2] == r"fast \& rough & -- & -- \\"


def test_only_scores_lose_their_zeros() -> None:
    record = {"score": 0.05, "won": -0.022, "p": 0.0004, "ms": 0.5, "share": 0.005, "one": 1.0}
    forms = (SCORE, SIGNED, p_label, Number(".1f"), PERCENT, SCORE)
    columns = [Column(key, key, form) for key, form in zip(record, forms)]
    [_, row] = rows_of(latex_of(Table.of(columns, [record], "t")))
    expected = r".050 & $-$.022 & \textless{}.001 & 0.5 & 0.5\% & 1.000 \\"
    assert row == expected


def test_braces_and_environments_are_closed() -> None:
    for is_long in (False, True):
        text = latex_of(replace(TABLE, caption=r"{50% \ of $x_1$}"), is_long=is_long)
        bare = re.sub(r"\\[{}\\]|(?m:^%.*$)", "", text)
        assert bare.count("{") == bare.count("}")
        assert re.findall(r"begin{(.*?)}", text) == re.findall(r"end{(.*?)}", text)[::-1]


def test_latex_escapes() -> None:
    assert tex("a_b & 50% #1 $x$ {~^\\}") == (
        r"a\_b \& 50\% \#1 \$x\$ \{\textasciitilde{}\textasciicircum{}\textbackslash{}\}"
    )
    assert tex("x\ny\x00") == r"x\textbackslash{}ny\textbackslash{}x00"
    assert tex("DTB70-ECO 0.1 [-0.2, -3]") == "DTB70-ECO 0.1 {[}$-$0.2, $-$3]"
    assert tex("[-.05, +.1]") == "{[}$-$.05, +.1]"
    assert tex("over σ") == r"over $\sigma$"  # noqa: RUF001


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("*", "{*}"),  # the star of the line break before it
        ("[x]", "{[}x]"),  # its optional argument
        ("?`", "?{}`"),  # a ligature for the Spanish question mark
        ("!`a``b", "!{}`a`{}`b"),
        ("--", "-{}-"),
        ("a---b", "a-{}-{}-b"),
        ("-", "-"),
        ("it''s", "it'{}'s"),
        ("\\", r"\textbackslash{}"),
        ('a<b>|c"', r"a\textless{}b\textgreater{}\textbar{}c\char34{}"),
        ("Müller", "Müller"),
    ],
)
def test_latex_holds_hostile_names(name: str, written: str) -> None:
    table = Table.of(COLUMNS[:2], [{"name": name}], "t")
    lines = latex_of(table).splitlines()
    assert rf"{written} & -- \\" in lines
    assert not any(line.startswith("% compile") for line in lines)


def test_latex_says_what_pdflatex_has_no_font_for() -> None:
    text = latex_of(Table.of(COLUMNS[:1], [{"name": "追踪"}], "t"))
    assert "% compile with lualatex or xelatex, and a font for 踪追" in text.splitlines()
    assert r"追踪 \\" in text.splitlines()
