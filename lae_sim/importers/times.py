"""Measured processing times in text files, and the unit that they are in.

Files of times rarely name their unit. Numbers that are the seconds of a frame by any reckoning are
taken as such; of others the user is asked: a wrong guess makes a wrong score that looks right.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.numbers import NUMBER, read_cells, read_lines
from lae_sim.engine.clock import MAX_INT64, UNIT_NS
from lae_sim.errors import LaeError, hint, listed, shown

CUMULATIVE = "cumulative-"
UNITS = ("s", "ms", "us", "ns", "fps", *(f"{CUMULATIVE}{unit}" for unit in ("s", "ms", "us", "ns")))
"""Units of a time of each frame, a rate, and units of the time since the start."""

_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_SAFE_MS = (0.5, 250.0)
_POSSIBLE_MS = (0.05, 10_000.0)
# Frames of one tracker differ: medians of KCF's files on OTB100 are from 0.5 to 108 ms.
_MOST_RATIO = 100
_FEW_ROWS = 6
_LONGEST_START_S = 600
_IN_A_HEADER = re.compile(
    r"(?:^|[^a-z])(?:(?P<ms>ms|msecs?|milli(?:second)?s?)|(?P<us>us|\u00b5s|\u03bcs|micro(?:second)?s?)"
    r"|(?P<ns>ns|nano(?:second)?s?)|(?P<fps>fps)|(?P<s>s|secs?|seconds?))(?:[^a-z]|$)"
)


@dataclass(frozen=True, eq=False)
class MeasuredTimes:
    """The times of one sequence.

    Attributes:
        sequence: its name.
        path: the file that they were read from.
        elapsed_ns: of each frame, ns, int64 [n].
        unit: one of :data:`UNITS`, if it was said; otherwise they were read as seconds.
    """

    sequence: str
    path: Path
    elapsed_ns: Ints
    unit: str | None


def parse_unit(unit: str | None) -> str | None:
    """A unit of :data:`UNITS`, or None.

    Raises:
        LaeError: if it is none of them.
    """
    if unit is not None and unit not in UNITS:
        raise LaeError(
            f"time_unit: no {shown(unit)}: there are {', '.join(UNITS)}{hint(unit, UNITS)}"
        )
    return unit


def read_times(path: Path, unit: str | None = None, column: int = 0) -> tuple[Ints, str | None]:
    """Times as exact whole nanoseconds, rounded half to even.

    A first row of text is a header; it may name the unit, as ``time_ms`` does.

    Args:
        path: a text file with a row for each frame.
        unit: one of :data:`UNITS`. None means that of the header, or else seconds a frame.
        column: which column to take.

    Returns:
        Times of each frame, int64 [rows], and their unit; None if neither the caller nor a header
        says it. :func:`check_seconds` judges whether such times can be seconds.

    Raises:
        LaeError: if a cell is no time, the column is not there, or rows that nobody says are times
            of each frame ascend like times since the start.
    """
    parse_unit(unit)
    rows = read_cells(path, lines=_header_as_one_cell(read_lines(path)))
    if column >= len(rows[0]):
        raise LaeError(f"{path}: has {len(rows[0])} columns of times, not {column + 1}")
    cells = [row[column] for row in rows]
    first_line = 1
    if _is_header(cells[0]):
        unit = unit or _named_in(cells[0])
        cells, first_line = cells[1:], 2
    values = []
    for number, cell in enumerate(cells, first_line):
        if not NUMBER.match(cell) or cell.startswith("-"):
            raise LaeError(f"{path}, line {number}: {cell[:40]!r} is not a processing time")
        values.append(Fraction(cell))
        if values[-1] > MAX_INT64:  # in whatever unit
            raise LaeError(f"{path}, line {number}: {cell[:40]} is too long a time")
    if len(rows[0]) > 1 and _counts(values):
        raise LaeError(
            f"{path}: its column {column + 1} counts the frames, {values[0]} to {values[-1]}: keep "
            "the column of times only"
        )
    if unit is None and looks_cumulative(np.array(values, np.float64)):
        raise LaeError(f"{path}: {_question_of_sums(values)}")
    return _elapsed(values, unit or "s", path, first_line), unit


def _header_as_one_cell(lines: Sequence[str]) -> list[str]:
    """The lines, with a first one such as ``# Time (ms)`` as the name of the only column."""
    first = lines[0].lstrip("# ")
    if len(lines) > 1 and first[:1].isalpha() and NUMBER.match(lines[1]):
        return ["_".join(first.split()), *lines[1:]]
    return list(lines)


def _counts(values: Sequence[Fraction]) -> bool:
    """Whether values are those of whole numbers one after the other."""
    return len(values) >= _FEW_ROWS and all(v == values[0] + k for k, v in enumerate(values))


def _is_header(cell: str) -> bool:
    return cell[:1].isalpha() and ("time" in cell.lower() or _named_in(cell) is not None)


def _named_in(header: str) -> str | None:
    """The unit that a header such as ``time_ms`` or ``Time(s)`` names."""
    match = _IN_A_HEADER.search(header.lower())
    unit = match.lastgroup if match else None
    if unit in UNIT_NS and re.search("cumulative|since", header.lower()):
        return f"{CUMULATIVE}{unit}"
    return unit


def _elapsed(values: Sequence[Fraction], unit: str, path: Path, first_line: int) -> Ints:
    """Nanoseconds of each frame, int64 [n]."""
    sums = unit.startswith(CUMULATIVE)
    scale = UNIT_NS.get(unit.removeprefix(CUMULATIVE), 0)
    times = []
    before = Fraction(0)
    for number, value in enumerate(values, first_line):
        where = f"{path}, line {number}"
        if unit == "fps":
            if not value:
                raise LaeError(f"{where}: 0 frames per second is no rate")
            time = UNIT_NS["s"] / value
        else:
            time = (value - before) * scale
        if time < 0:
            raise LaeError(f"{where}: the time since the start goes back: is it {CUMULATIVE[:-1]}?")
        if time > MAX_INT64:
            raise LaeError(f"{where}: {float(value):g} {unit} is too long a time")
        times.append(round(time))
        before = value if sums else before
    if sums and len(times) > 1 and times[0] > _LONGEST_START_S * UNIT_NS["s"]:
        raise LaeError(
            f"{path}: begins at {times[0] / 1e9:,.0f} s: readings of a clock; subtract that of the "
            "start, when the initialisation began"
        )
    return np.array(times, np.int64)


def looks_cumulative(values: Floats | Ints) -> bool:
    """Whether values ascend from row to row, as times since the start do and frames' own do not.

    Args:
        values: of each frame, [n]; in any unit.
    """
    if len(values) < 3:
        return False
    steps = np.diff(values)
    ascends = steps.min() >= 0 and np.count_nonzero(steps) > len(steps) / 2
    # that a few do by chance is no wonder, but then their sum does not grow by one frame's each
    return bool(ascends and (len(values) >= _FEW_ROWS or values[-1] >= values[0] * len(values) / 2))


def check_seconds(times: Sequence[MeasuredTimes]) -> None:
    """Check that a tracker's times whose unit nobody said can be seconds of a frame.

    Their median has to be from 0.5 to 250 ms, and no file may be far off both that and the others.

    Raises:
        LaeError: if they cannot; it asks for the unit.
    """
    unsaid = [each for each in times if each.unit is None]
    if unsaid and not any(each.elapsed_ns.any() for each in unsaid):
        raise LaeError(
            f"{unsaid[0].path}: all times are 0, as if none had been measured: give --time "
            "constant:47ms, or --time-unit s if they are right"
        )
    unsaid = [each for each in unsaid if each.elapsed_ns.any()]
    if not unsaid:
        return
    low, high = (ms / 1e3 for ms in _SAFE_MS)
    overall = _median(np.concatenate([each.elapsed_ns for each in unsaid]))
    medians = [_median(each.elapsed_ns) for each in unsaid]
    middle = math.sqrt(low * high)
    worst = max(range(len(unsaid)), key=lambda k: abs(math.log(medians[k] / middle)))
    median, path = medians[worst], unsaid[worst].path
    alike = max(median, overall) <= _MOST_RATIO * min(median, overall)
    if low <= median <= high or (low <= overall <= high and alike):
        return
    raise LaeError(
        f"{path}: the unit of its times is not known (median {median:g}): add "
        f"{_choices(median, '')}"
    )


def _question_of_sums(values: Sequence[Fraction]) -> str:
    """What to ask where values look cumulative."""
    step = float((values[-1] - values[0]) / (len(values) - 1))
    return (
        f"its times ascend from row to row, {float(values[0]):g} to {float(values[-1]):g}: add "
        f"{_choices(step, CUMULATIVE)}, for the time since the start, or that of each frame's own "
        f"time ({', '.join(UNITS[:5])})"
    )


def _choices(typical: float, prefix: str) -> str:
    """The units in which a number may be the time of a frame, with what it is then."""
    in_ms = {unit: typical * ns / 1e6 for unit, ns in UNIT_NS.items()}
    if not prefix:
        in_ms["fps"] = 1e3 / typical
    low, high = _POSSIBLE_MS
    possible = {unit: in_ms[unit] for unit in UNITS if low <= in_ms.get(unit, 0) <= high}
    choices = [
        f"--time-unit {prefix}{unit} ({float(f'{ms:.3g}'):,g} ms a frame)"
        for unit, ms in possible.items()
    ]
    return " or ".join(choices) or f"--time-unit with it, one of {', '.join(UNITS)}"


def understood(times: Sequence[MeasuredTimes]) -> str:
    """What times were read as, in words."""
    words = []
    for unit in sorted({each.unit for each in times}, key=lambda each: each or ""):
        if unit is None:
            words.append("seconds per frame, as no unit was given")
        elif unit == "fps":
            words.append("frames per second of each frame")
        elif unit.startswith(CUMULATIVE):
            words.append(f"{_NAMES[unit.removeprefix(CUMULATIVE)]} since the start")
        else:
            words.append(f"{_NAMES[unit]} per frame")
    return " and ".join(words)


def ascending_note(times: Sequence[MeasuredTimes]) -> str | None:
    """What to say of times that look cumulative, though the user said that they are not."""
    names = [
        each.sequence
        for each in times
        if not (each.unit or "").startswith(CUMULATIVE) and looks_cumulative(each.elapsed_ns)
    ]
    if not names:
        return None
    return (
        f"times ascend from row to row in {len(names)} of {len(times)} sequences "
        f"({listed(names, 3)}); if they are since the start, --time-unit {CUMULATIVE}s, -ms, "
        "-us or -ns says so"
    )


def _median(elapsed_ns: Ints) -> float:
    """The lower median of those above zero, seconds."""
    ordered = np.sort(elapsed_ns[elapsed_ns > 0])
    return float(ordered[(len(ordered) - 1) // 2]) / 1e9
