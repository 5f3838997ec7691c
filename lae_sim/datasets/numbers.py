"""Tables of plain numbers in text files: annotations, boxes, processing times.

Columns are separated by commas, tabs, spaces or semicolons. A table that is not perfectly regular
is refused with its file and line, since a shifted row shifts every frame after it.
"""

from __future__ import annotations

import codecs
import re
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError
from lae_sim.files import Budget

# A cell as a str, and its place in a list.
_CELL_BYTES = 64
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_SEPARATOR = re.compile(r"\s*[,;]\s*|\s+")
# Lengths are bounded, so that no number needs more than moderate exact arithmetic.
NUMBER = re.compile(r"[+-]?(?:[0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,3})?\Z")


def read_cells(path: Path) -> list[list[str]]:
    """The cells of a text table, row by row; all rows have the same number of cells.

    Raises:
        LaeError: if the file cannot be read, is empty, has an empty line inside, is ragged, or
            would take too much memory (see :func:`lae_sim.files.max_decoded`).
    """
    budget = Budget(path)
    lines = [line.strip() for line in read_text(path, budget).splitlines()]
    while lines and not lines[-1]:
        lines.pop()
    if not lines:
        raise LaeError(f"{path}: the file is empty")
    rows: list[list[str]] = []
    for number, line in enumerate(lines, 1):
        if not line:
            raise LaeError(f"{path}, line {number}: empty line; every frame needs its row")
        row = _SEPARATOR.split(line.rstrip(",;").rstrip())
        if len(row) != len(rows[0] if rows else row):
            raise LaeError(
                f"{path}, line {number}: {len(row)} columns, and the lines before have "
                f"{len(rows[0])}"
            )
        budget.take(_CELL_BYTES * (len(row) + 1))
        rows.append(row)
    return rows


def read_numbers(path: Path, nan: bool = False) -> Floats:
    """A table of numbers, float64 [rows, columns].

    Args:
        path: the text file.
        nan: whether a cell may be NaN.

    Raises:
        LaeError: if the file is not a table of finite numbers; it names the line.
    """
    rows = read_cells(path)
    table = np.array([[_number(cell) for cell in row] for row in rows], np.float64)
    for row, column in np.argwhere(~np.isfinite(table)):
        cell = rows[row][column]
        if not (nan and cell.lower() == "nan"):
            raise LaeError(f"{path}, line {row + 1}: {cell[:40]!r} is not a number")
    return table


def _number(cell: str) -> float:
    """The number, or NaN if the cell is none (Python's float would admit ``1_000``)."""
    return float(cell) if NUMBER.match(cell) else float("nan")


def read_text(path: Path, budget: Budget) -> str:
    """A text file in UTF-8, with a mark at its beginning or without.

    Args:
        path: the file.
        budget: what it and its lines take in memory is taken from it.

    Raises:
        LaeError: if it cannot be read, is no such text, or takes too much.
    """
    try:
        budget.take(path.stat().st_size)
        data = path.read_bytes()
        budget.take(len(data) + _CELL_BYTES * data.count(b"\n"))  # as text, and its lines
        if data.startswith(_UTF16) or b"\0" in data[:4]:
            raise LaeError(f"{path}: not a text file in UTF-8 but in UTF-16: save it as UTF-8")
        return data.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise LaeError(f"{path}: no such file") from error
    except OSError as error:
        raise LaeError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LaeError(f"{path}: not a text file") from error
