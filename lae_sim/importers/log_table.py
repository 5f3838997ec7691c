"""Logs as tables: a CSV file with a row for each frame of the camera."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

from lae_sim.datasets.numbers import NUMBER, read_text
from lae_sim.decoding import Budget
from lae_sim.engine.clock import UNIT_NS, fitting
from lae_sim.errors import LaeError, hint, listed
from lae_sim.importers.logs import Box, Log, LoggedFrame, LoggedOutput

TIMES = ("captured", "arrived", "started", "ready")
BOX = ("x", "y", "w", "h")
TRUTH = ("truth_x", "truth_y", "truth_w", "truth_h")
COLUMNS = ("frame", *TIMES, *BOX, "score", *TRUTH)

_UNITS = {"\u00b5s": "us", "\u03bcs": "us", "sec": "s", "msec": "ms", "usec": "us", "nsec": "ns"}
_HEADER = re.compile(
    r"(?P<name>[a-z_]+?)"
    r"(?:[ _]*[\[(]\s*(?P<bracket>[^\])]*?)\s*[\])]|[ _](?P<tail>[a-z\u00b5\u03bc]+))?\Z"
)
_CELL_BYTES = 64
_NONE = ("", "nan", "null", "none", "-")
_MOST_GAP = 1_000_000
_MOST = 10**19


def read_table(path: Path, gaps: str | None = None) -> Log:
    """The log that a table holds.

    The header names the columns, and the unit of each time: ``ready_ms``, ``ready [us]``,
    ``captured_s``. There are ``frame``, ``ready``, ``x``, ``y``, ``w``, ``h``, and ``arrived`` or
    ``captured``, at least; ``started``, ``score`` and ``truth_x`` ... ``truth_h`` may be there.
    Times are decimals, read exactly and rounded to ns, half to even. A row without ``ready`` is a
    frame that was not processed; one without a box, where the tracker found none.

    Args:
        path: a file of commas, semicolons or tabs.
        gaps: what frame numbers that are missing mean: ``"dropped"`` frames that the camera never
            sent, or ``"skipped"`` ones, which came, and which the log left out.

    Raises:
        LaeError: if it is no such table; it names the line.
    """
    budget = Budget(path)
    lines = read_text(path, budget).splitlines()
    while lines and not lines[-1].strip(" ,;\t"):
        lines.pop()
    if len(lines) < 2:
        raise LaeError(f"{path}: no rows: the first line names the columns, then comes one a frame")
    separator = max(",;\t", key=lines[0].count)
    rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    units, others = _columns(path, next(rows))
    reader = _Rows(path, units)
    frames: list[LoggedFrame] = []
    outputs: list[LoggedOutput] = []
    truth: dict[int, Box] = {}
    interpolated = 0
    before: int | None = None
    for line, cells in enumerate(rows, 2):
        budget.take(_CELL_BYTES * (len(cells) + 1))
        row = reader.row(line, cells)
        number = row.number()
        if before is not None and number <= before:
            raise LaeError(f"{row.where}: frame {number} does not come after frame {before}")
        frame = LoggedFrame(row.where, row.time("captured"), row.time("arrived"))
        if before is not None and number > before + 1:
            if gaps is None or number - before > _MOST_GAP:
                raise LaeError(
                    f"{row.where}: frame {number} follows frame {before}: were those between never "
                    "sent (--gaps dropped), or skipped, and left out of the log (--gaps skipped)?"
                )
            if gaps == "skipped":
                budget.take(2 * _CELL_BYTES * (number - before))
                filled = _between(frames[-1], frame, number - before)
                frames += filled
                interpolated += len(filled)
        before = number
        if box := row.box(TRUTH):
            truth[len(frames)] = box
        output = row.output(len(frames))
        if output is not None:
            outputs.append(output)
        frames.append(frame)
    facts = {"format": "csv", **({} if gaps is None else {"gaps": gaps})}
    notes = [f"columns left out: {listed(others)}"] if others else []
    return Log(frames, outputs, path.stem, facts, truth, None, interpolated, tuple(notes))


def _columns(path: Path, header: Sequence[str]) -> tuple[dict[str, tuple[int, int]], list[str]]:
    """The place of each column, with its unit in ns if it is a time; and the names of others."""
    found: dict[str, tuple[int, int]] = {}
    others = []
    for place, cell in enumerate(header):
        text = cell.strip().strip("\"'#").strip().lower()
        match = _HEADER.match(text)
        name, unit = text, None
        if match is not None and text not in COLUMNS:
            name = match["name"]
            unit = match["tail"] if match["bracket"] is None else match["bracket"]
        if name not in COLUMNS or (unit is not None and name not in TIMES):
            others.append(cell.strip())
            continue
        scale = 1
        if name in TIMES:
            unit = _UNITS.get(unit or "", unit)
            if unit not in UNIT_NS:
                raise LaeError(
                    f"{path}, line 1: {cell.strip()!r} names no unit of its times: write "
                    f"{name}_s, {name}_ms, {name}_us or {name}_ns"
                )
            scale = UNIT_NS[unit]
        if name in found:
            raise LaeError(f"{path}, line 1: column {name!r} is there twice")
        found[name] = place, scale
    missing = [name for name in ("frame", "ready", *BOX) if name not in found]
    if missing or not {"arrived", "captured"} & {*found}:
        missing = missing or ["arrived (or captured)"]
        near = hint(missing[0], [other.lower() for other in others])
        raise LaeError(f"{path}, line 1: no column {listed(missing)}{near}")
    if len(present := {*TRUTH} & {*found}) not in (0, 4):
        raise LaeError(f"{path}, line 1: of {', '.join(TRUTH)} only {', '.join(sorted(present))}")
    return found, others


def _between(before: LoggedFrame, after: LoggedFrame, steps: int) -> list[LoggedFrame]:
    """The frames that are missing between two, at even steps."""

    def at(step: int, begin: int | None, end: int | None) -> int | None:
        return None if begin is None or end is None else begin + (end - begin) * step // steps

    return [
        LoggedFrame(
            f"{after.where} (a frame before it)",
            at(step, before.captured_ns, after.captured_ns),
            at(step, before.arrived_ns, after.arrived_ns),
        )
        for step in range(1, steps)
    ]


class _Rows:
    """Reads rows by the columns of a header."""

    def __init__(self, path: Path, columns: Mapping[str, tuple[int, int]]) -> None:
        self.path = path
        self.columns = columns

    def row(self, line: int, cells: Sequence[str]) -> _Row:
        where = f"{self.path}, line {line}"
        if len(cells) <= max(place for place, _ in self.columns.values()):
            raise LaeError(f"{where}: {len(cells)} cells, fewer than the header has")
        found = {name: cells[place].strip() for name, (place, _) in self.columns.items()}
        return _Row(where, found, self.columns)


class _Row:
    """One of them: its cells by the names of the columns."""

    def __init__(
        self, where: str, cells: Mapping[str, str], columns: Mapping[str, tuple[int, int]]
    ) -> None:
        self.where = where
        self.cells = cells
        self.columns = columns

    def _exact(self, name: str) -> Fraction | None:
        cell = self.cells.get(name, "")
        if cell.lower() in _NONE:
            return None
        if not NUMBER.match(cell):
            raise LaeError(f"{self.where}: {name} is {cell[:40]!r}, not a number")
        value = Fraction(cell)
        if abs(value) > _MOST:
            raise LaeError(f"{self.where}: {name} is {cell[:40]!r}, an impossible number")
        return value

    def number(self) -> int:
        number = self._exact("frame")
        if number is None or number.denominator != 1:
            raise LaeError(f"{self.where}: frame is {self.cells['frame'][:40]!r}, no whole number")
        return int(number)

    def time(self, name: str) -> int | None:
        exact = self._exact(name)
        if exact is None:
            return None
        return fitting(round(exact * self.columns[name][1]), f"{self.where}: {name}")

    def box(self, names: Sequence[str]) -> Box | None:
        numbers = [self._exact(name) for name in names]
        known = [float(number) for number in numbers if number is not None]
        if len(known) not in (0, 4):
            absent = [name for name, number in zip(names, numbers) if number is None]
            raise LaeError(f"{self.where}: a box without {', '.join(absent)}")
        return (known[0], known[1], known[2], known[3]) if known else None

    def output(self, frame: int) -> LoggedOutput | None:
        ready, box, score = self.time("ready"), self.box(BOX), self._exact("score")
        if ready is None:
            if box is not None:
                raise LaeError(f"{self.where}: a box, and no time when it was ready")
            return None
        certain = None if score is None else float(score)
        return LoggedOutput(self.where, frame, box, ready, self.time("started"), certain)
