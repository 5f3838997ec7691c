"""Tables of plain numbers in text files: annotations, boxes, processing times.

Columns are separated by commas, tabs, spaces or semicolons. A table that is not perfectly regular
is refused with its file and line, since a shifted row shifts every frame after it.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.datasets.foreign import HEAD_BYTES, foreign
from lae_sim.decoding import Budget, read_bytes
from lae_sim.errors import LaeError

# A cell as a str, and its place in a list.
_CELL_BYTES = 64
_SEPARATOR = re.compile(r"\s*[,;]\s*|\s+")
# 10,5;20,5 or 10,5 20,5: two numbers with decimal commas, or two points of a polygon?
_COMMA = re.compile(r"[0-9],[0-9]")
_NO_COMMA = re.compile(r"[0-9](?:\s*;\s*|\s+)[-+.0-9]")
# Lengths are bounded, so that no number needs more than moderate exact arithmetic.
NUMBER = re.compile(r"[+-]?(?:[0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,3})?\Z")
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file, stripped, without empty ones at the end.

    Raises:
        LaeError: if the file cannot be read, is empty, looks like another format (it says which),
            or would take too much memory (see :func:`lae_sim.decoding.max_decoded`).
    """
    lines = [line.strip() for line in read_text(path, Budget(path)).splitlines()]
    while lines and not lines[-1]:
        lines.pop()
    if not lines:
        raise LaeError(f"{path}: the file is empty")
    return lines


def read_cells(
    path: Path, absent: bool = False, lines: Sequence[str] | None = None
) -> list[list[str]]:
    """The cells of a text table, row by row; all rows have the same number of cells.

    Args:
        path: the text file.
        absent: whether a row may be a single 0, or NaN only, however many: so VOT writes that there
            is no target. It becomes a row of NaN.
        lines: of the file, if they have been read.

    Raises:
        LaeError: if the file cannot be read, is empty, has an empty line inside, is ragged, or
            would take too much memory (see :func:`lae_sim.decoding.max_decoded`).
    """
    budget = Budget(path)
    rows: list[list[str]] = []
    no_target: list[int] = []
    width = 0
    for number, line in enumerate(read_lines(path) if lines is None else lines, 1):
        if not line:
            raise LaeError(f"{path}, line {number}: empty line; every frame needs its row")
        if _COMMA.search(line) and _NO_COMMA.search(line):
            raise LaeError(
                f"{path}, line {number}: {line[:40]!r} separates by commas and by something else; "
                "write decimal points, and one separator"
            )
        row = _SEPARATOR.split(line.rstrip(",;").rstrip())
        budget.take(_CELL_BYTES * (len(row) + 1))
        if absent and (row == ["0"] or {cell.lower() for cell in row} == {"nan"}):
            no_target.append(number - 1)
        elif len(row) != (width or len(row)):
            raise LaeError(
                f"{path}, line {number}: {len(row)} columns, and the lines before have {width}"
            )
        else:
            width = len(row)
        rows.append(row)
    if _are_decimal_commas(rows):
        raise LaeError(
            f"{path}, line 1: {','.join(rows[0])!r:.40} looks like a number with a decimal "
            "comma; write decimal points"
        )
    width = width or max(map(len, rows))
    for index in no_target:
        rows[index] = ["nan"] * width
    return rows


def read_numbers(
    path: Path, nan: bool = False, absent: bool = False, lines: Sequence[str] | None = None
) -> Floats:
    """A table of numbers, float64 [rows, columns].

    Args:
        path: the text file.
        nan: whether a cell may be NaN.
        absent, lines: see :func:`read_cells`.

    Raises:
        LaeError: if the file is not a table of finite numbers; it names the line.
    """
    rows = read_cells(path, absent, lines)
    table = np.array([[_number(cell) for cell in row] for row in rows], np.float64)
    for row, column in np.argwhere(~np.isfinite(table)):
        cell = rows[row][column]
        if not (nan and cell.lower() == "nan"):
            header = row == 0 < len(rows) - 1 and _is_header(rows)
            raise LaeError(
                f"{path}, line {row + 1}: {cell[:40]!r} is not a number"
                + ("; the line looks like a header: remove it" if header else "")
            )
    return table


def _are_decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    """Whether two columns look like one of numbers such as 0,047 rather than two of whole ones."""
    if not all(len(row) == 2 and row[0].isdigit() and row[1].isdigit() for row in rows):
        return False
    return all(row[0] == "0" for row in rows) or any(re.match("0[0-9]", row[1]) for row in rows)


def _is_header(rows: Sequence[Sequence[str]]) -> bool:
    """Whether the first row names columns of numbers."""
    named = all(re.match(r"[^\W\d]", cell.strip("#\"' ")) for cell in rows[0] if cell != "#")
    return named and all(NUMBER.match(cell) for row in rows[1:2] for cell in row)


def _number(cell: str) -> float:
    """The number, or NaN if the cell is none (Python's float would admit ``1_000``)."""
    return float(cell) if NUMBER.match(cell) else float("nan")


def read_text(path: Path, budget: Budget) -> str:
    """A text file in UTF-8, or in UTF-16 with a mark at its beginning.

    Args:
        path: the file.
        budget: what it and its lines take in memory is taken from it.

    Raises:
        LaeError: if it cannot be read, is no such text, or takes too much.
    """
    data = read_bytes(path, budget)
    budget.take(len(data) + _CELL_BYTES * data.count(b"\n"))  # as text, and its lines
    other = foreign(data[:HEAD_BYTES])
    if other is not None:
        raise LaeError(f"{path}: {other}")
    utf_16 = data.startswith(_UTF_16)  # as Windows' shell writes it
    if not utf_16 and b"\0" in data[:4]:
        raise LaeError(f"{path}: not a text file in UTF-8 but in UTF-16: save it as UTF-8")
    try:
        return data.decode("utf-16" if utf_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise LaeError(f"{path}: not a text file") from error
