"""Tables of plain numbers in text files: annotations, boxes, processing times.

Columns are separated by commas, tabs, spaces or semicolons. A table that is not perfectly regular
is refused with its file and line, since a shifted row shifts every frame after it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.foreign import HEAD_BYTES, foreign
from lae_sim.engine.clock import MAX_INT64, UNIT_NS
from lae_sim.errors import LaeError
from lae_sim.files import check_regular

_MAX_BYTES = 1 << 28
_SEPARATOR = re.compile(r"\s*[,;]\s*|\s+")
# 10,5;20,5 or 10,5 20,5: two numbers with decimal commas, or two points of a polygon?
_COMMA = re.compile(r"[0-9],[0-9]")
_NO_COMMA = re.compile(r"[0-9](?:\s*;\s*|\s+)[-+.0-9]")
# Lengths are bounded, so that no number needs more than moderate exact arithmetic.
_NUMBER = re.compile(r"[+-]?(?:[0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,3})?\Z")
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_UNITS_OF_ONE_FRAME = ((10**6, "ns"), (10**3, "us"), (1, "ms"))  # least median that looks so


def read_lines(path: Path) -> list[str]:
    """The lines of a text file, stripped, without empty ones at the end.

    Raises:
        LaeError: if the file cannot be read, is empty, or looks like another format: it says which.
    """
    lines = [line.strip() for line in _text(path).splitlines()]
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
        LaeError: if the file cannot be read, is empty, has an empty line inside, or is ragged.
    """
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
        if absent and (row == ["0"] or {cell.lower() for cell in row} == {"nan"}):
            no_target.append(number - 1)
        elif len(row) != (width or len(row)):
            raise LaeError(
                f"{path}, line {number}: {len(row)} columns, and the lines before have {width}"
            )
        else:
            width = len(row)
        rows.append(row)
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


def _is_header(rows: Sequence[Sequence[str]]) -> bool:
    """Whether the first row names columns of numbers."""
    named = all(re.match(r"[^\W\d]", cell.strip("#\"' ")) for cell in rows[0] if cell != "#")
    return named and all(_NUMBER.match(cell) for row in rows[1:2] for cell in row)


def read_durations(path: Path, unit: str | None = None, column: int = 0) -> Ints:
    """Durations as exact whole nanoseconds, int64 [rows], rounded half to even.

    Args:
        path: a text file with a row for each frame.
        unit: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``. None means seconds, but only if the numbers
            look like seconds a frame.
        column: which column to take.

    Raises:
        LaeError: if a cell is not a duration, the column is not there, or the numbers look like
            another unit.
    """
    rows = read_cells(path)
    if column >= len(rows[0]):
        raise LaeError(f"{path}: has {len(rows[0])} columns of times, not {column + 1}")
    scale = UNIT_NS[unit or "s"]
    times = []
    for number, row in enumerate(rows, 1):
        cell = row[column]
        if not _NUMBER.match(cell) or cell.startswith("-"):
            raise LaeError(f"{path}, line {number}: {cell[:40]!r} is not a processing time")
        times.append(round(Fraction(cell) * scale))
        if times[-1] > MAX_INT64:
            raise LaeError(f"{path}, line {number}: {cell[:40]} {unit or 's'} is too long a time")
    if unit is None:
        check_seconds(times, str(path))
    return np.array(times, np.int64)


def check_seconds(elapsed_ns: Sequence[int], where: str) -> None:
    """Check that times which were read as seconds are plausible as such.

    Raises:
        LaeError: if the median looks like another unit; it says which.
    """
    ordered = sorted(time for time in elapsed_ns if time > 0)
    if not ordered:
        return
    median = ordered[len(ordered) // 2] / 1e9
    for least, unit in _UNITS_OF_ONE_FRAME:
        if median > least:
            raise LaeError(
                f"{where}: the times look like {unit} (median {median:g}): add --time-unit {unit}, "
                "or --time-unit s if they are seconds"
            )
    if median < 1e-5:
        raise LaeError(
            f"{where}: the times are too short for seconds (median {median:g}): add --time-unit "
            "with their unit, or --time-unit s if they are seconds"
        )


def _number(cell: str) -> float:
    """The number, or NaN if the cell is none (Python's float would admit ``1_000``)."""
    return float(cell) if _NUMBER.match(cell) else float("nan")


def _text(path: Path) -> str:
    check_regular(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise LaeError(f"{path}: too large for a table of numbers")
        data = path.read_bytes()
        other = foreign(data[:HEAD_BYTES])
        if other is not None:
            raise LaeError(f"{path}: {other}")
        # Windows' shell writes UTF-16
        return data.decode("utf-16" if data[:2] in _UTF_16 else "utf-8-sig")
    except FileNotFoundError as error:
        raise LaeError(f"{path}: no such file") from error
    except OSError as error:
        raise LaeError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise LaeError(f"{path}: not a text file") from error
