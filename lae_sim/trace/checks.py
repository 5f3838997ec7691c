"""The rules of the trace format, each with a message that says where and guesses why."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, NoReturn

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import MOST_PIXELS, iou
from lae_sim.errors import LaeError, TraceError
from lae_sim.trace.columns import BOX, TRUTH, Nullable, Rows
from lae_sim.trace.metadata import text_fault
from lae_sim.trace.recording import OPTIONAL_COLUMNS, stage_column, stage_of
from lae_sim.trace.restarts import is_restart

COLUMN_TYPES = {
    "sequence": "string",
    "frame": "int32",
    **dict.fromkeys(TRUTH + BOX, "double"),
    "elapsed_ns": "int64",
    "score": "float",
    "arrival_ns": "int64",
    "visible": "bool",
}
OPTIONAL = (*TRUTH, "score", *OPTIONAL_COLUMNS)
# No known tracker does 5,000 frames/s, so a shorter typical time is in another unit.
_LEAST_TYPICAL_NS = 200_000
_SAMPLE_ROWS = 10_000  # of each batch, to tell boxes from corners


def check_schema(schema: Any, where: str) -> None:
    """Check that an Arrow schema has the columns of the format with their types.

    Raises:
        TraceError: for the first column that is missing or of another type.
    """
    there = Counter(schema.names)
    for name, expected in {**COLUMN_TYPES, **_stage_types(there, where)}.items():
        if there[name] > 1:
            raise TraceError(f"{where}: column {name!r} is there {there[name]} times")
        if not there[name]:
            if name in OPTIONAL and not (name in TRUTH and set(TRUTH) & set(there)):
                continue
            raise TraceError(f"{where}: column {name!r} is missing: is this a lae_sim trace?")
        actual = _type_name(schema.field(name).type)
        if actual != expected:
            raise TraceError(
                f"{where}: column {name!r} is {actual}, must be {expected}"
                + _cause_of_type(name, actual)
            )


def _stage_types(columns: Iterable[str], where: str) -> dict[str, str]:
    """The types of those columns that have the times of stages."""
    types = {}
    for column in columns:
        if found := re.fullmatch("(?s)stage_(.*)_ns", column):
            try:
                types[stage_column(found[1])] = "int64"
            except LaeError as error:
                raise TraceError(f"{where}: column {column!r:.100}: {error}") from error
    return types


def _type_name(arrow_type: Any) -> str:
    import pyarrow as pa

    if pa.types.is_dictionary(arrow_type):
        arrow_type = arrow_type.value_type
    return "string" if pa.types.is_large_string(arrow_type) else str(arrow_type)


def _cause_of_type(name: str, actual: str) -> str:
    if name.endswith("_ns") and actual in ("double", "float", "halffloat"):
        return ": are these seconds or milliseconds? Write whole nanoseconds"
    return ""


class RowChecker:
    """Checks the rows of a trace in file order, batch by batch.

    Attributes:
        where: the file's name, for messages.
        profiled: whether units are known, so that none need be guessed from unlikely values.
        restarts: whether the sequences are restarts, which are called so.
    """

    def __init__(self, where: str, profiled: bool = False, restarts: bool = False) -> None:
        self.where = where
        self.profiled = profiled
        self.restarts = restarts
        self._last_name: str | None = None
        self._next_frame = 0
        self._last_arrival_ns = 0

    def __call__(self, rows: Rows) -> None:
        """Check rows that follow the ones before.

        Raises:
            TraceError: at the first fault of each kind.
        """
        self._check_order(rows)
        self._check_nulls(rows)
        self._check_values(rows)
        if "arrival_ns" in rows.optional:
            self._check_arrivals(rows, rows.optional["arrival_ns"])
        self._check_stages(rows)
        if not self.profiled:
            self._check_units(rows)

    def _fail(self, rows: Rows, row: int, column: str, problem: str) -> NoReturn:
        run = int(np.searchsorted(rows.starts, row, "right")) - 1
        raise TraceError(
            f"{self.where}: column {column!r}, sequence {rows.names[run]!r}, "
            f"frame {rows.frame[row]}: {problem}"
        )

    def _check_order(self, rows: Rows) -> None:
        first_frames = np.zeros(len(rows.names), np.int64)
        for run, name in enumerate(rows.names):
            fault = text_fault(name) if name else "is null or empty"
            if fault is not None:
                self._fail(rows, int(rows.starts[run]), "sequence", f"the name {fault}")
            if self.restarts and not is_restart(name):
                problem = "a restart is called SEQUENCE@START+GAP, such as 'car@12+6'"
                self._fail(rows, int(rows.starts[run]), "sequence", problem)
            if run == 0 and name == self._last_name:
                first_frames[0] = self._next_frame
            elif self._last_name is not None and name <= self._last_name:
                self._fail(
                    rows,
                    int(rows.starts[run]),
                    "sequence",
                    f"rows are not sorted by sequence (it follows {self._last_name!r})",
                )
            self._last_name = name
        lengths = np.diff(rows.starts)
        expected = np.arange(len(rows.frame)) - np.repeat(rows.starts[:-1] - first_frames, lengths)
        wrong = np.flatnonzero(rows.frame != expected)
        if len(wrong):
            row = int(wrong[0])
            self._fail(
                rows, row, "frame", _cause_of_order(int(rows.frame[row]), int(expected[row]))
            )
        self._next_frame = int(expected[-1]) + 1

    def _check_nulls(self, rows: Rows) -> None:
        for columns, null in ((TRUTH, rows.truth_null), (BOX, rows.box_null)):
            if null.any() and (differ := null[:, 1:] != null[:, :1]).any():
                row = int(np.argmax(differ.any(axis=1)))
                column = columns[int(np.argmax(null[row]))]
                self._fail(rows, row, column, f"null, but not all of {', '.join(columns)} are")
        unlike = np.flatnonzero(rows.elapsed_null != rows.box_null[:, 0])
        if len(unlike):
            row = int(unlike[0])
            if rows.elapsed_null[row]:
                self._fail(rows, row, "elapsed_ns", "null, but the frame has a box")
            self._fail(rows, row, "x", "null, but the frame has a time; a lost target needs a box")
        first = rows.starts[:-1][rows.frame[rows.starts[:-1]] == 0]
        missing = first[rows.elapsed_null[first]]
        if len(missing):
            self._fail(
                rows, int(missing[0]), "x", "frame 0 initialises the tracker and needs a box"
            )

    def _check_values(self, rows: Rows) -> None:
        for columns, values, null in (
            (TRUTH, rows.truth, rows.truth_null),
            (BOX, rows.boxes, rows.box_null),
        ):
            bad = ~(np.abs(values) <= MOST_PIXELS) & ~null
            if bad.any():
                row, i = (int(index) for index in np.argwhere(bad)[0])
                value = values[row, i]
                cause = "not a number; write null for none"
                if np.isfinite(value):
                    cause = "beyond any image"
                self._fail(rows, row, columns[i], f"{value} is {cause}")
        no_score = np.flatnonzero(~np.isfinite(rows.score) & ~rows.score_null)
        if len(no_score):
            row = int(no_score[0])
            self._fail(rows, row, "score", f"{rows.score[row]}: a score is finite or null")
        negative = np.flatnonzero((rows.elapsed_ns < 0) & ~rows.elapsed_null)
        if len(negative):
            row = int(negative[0])
            self._fail(rows, row, "elapsed_ns", f"negative time {rows.elapsed_ns[row]} ns")

    def _check_arrivals(self, rows: Rows, arrival_ns: Nullable) -> None:
        times, null = arrival_ns.values, arrival_ns.null
        if null.any():
            problem = "null: give every frame of the trace the time when it arrived, or none"
            self._fail(rows, int(np.argmax(null)), "arrival_ns", problem)
        first = np.flatnonzero(rows.frame == 0)
        late = first[times[first] != 0]
        if len(late):
            row = int(late[0])
            self._fail(
                rows, row, "arrival_ns", f"{times[row]}: times count from frame 0, which is at 0"
            )
        before = np.concatenate([[self._last_arrival_ns], times[:-1]])
        wrong = np.flatnonzero((times <= before) & (rows.frame > 0))
        if len(wrong):
            row = int(wrong[0])
            problem = f"{times[row]} ns, not after the frame before ({before[row]} ns)"
            self._fail(rows, row, "arrival_ns", problem)
        self._last_arrival_ns = int(times[-1])

    def _check_stages(self, rows: Rows) -> None:
        left = rows.elapsed_ns.copy()
        for name in filter(stage_of, rows.optional):
            column = rows.optional[name]
            known = ~column.null
            for wrong, problem in (
                (known & rows.elapsed_null, "a time, but the frame was not processed"),
                (known & (column.values < 0), "negative time {0} ns"),
                (
                    known & (column.values > left),
                    "{0} ns: the parts of elapsed_ns take longer than it, {1} ns",
                ),
            ):
                if wrong.any():
                    row = int(np.argmax(wrong))
                    text = problem.format(column.values[row], rows.elapsed_ns[row])
                    self._fail(rows, row, name, text)
            left -= np.where(known, column.values, 0)

    def _check_units(self, rows: Rows) -> None:
        times = rows.elapsed_ns[rows.elapsed_ns > 0]
        typical = float(np.median(times)) if len(times) > 1 else 0.0
        if 2 <= typical < _LEAST_TYPICAL_NS:
            row = int(np.argmax(rows.elapsed_ns > 0))
            self._fail(rows, row, "elapsed_ns", _cause_of_times(f"median {typical:g}", typical))
        if "arrival_ns" in rows.optional and len(rows.frame) > 1:
            steps = np.diff(rows.optional["arrival_ns"].values)[rows.frame[1:] > 0]
            typical = float(np.median(steps)) if len(steps) else 0.0
            if 1 <= typical < _LEAST_TYPICAL_NS:
                problem = _cause_of_times(f"{typical:g} from frame to frame", typical)
                self._fail(rows, int(np.argmax(rows.frame > 0)), "arrival_ns", problem)
        corners = "boxes look like x1, y1, x2, y2; write x, y, w, h"
        truth, boxes = rows.truth[:_SAMPLE_ROWS], rows.boxes[:_SAMPLE_ROWS]
        starts = rows.starts[rows.starts < len(truth)]
        for columns, some in ((TRUTH, truth), (BOX, boxes)):
            if _move_like_corners(some, starts):
                self._fail(rows, 0, columns[2], corners)
        column = _fit_as_corners(truth, boxes)
        if column is not None:
            self._fail(rows, 0, column, corners)


def _cause_of_order(frame: int, expected: int) -> str:
    if expected == 0:
        return "a sequence must start at frame 0" + (" (count from 0)" if frame == 1 else "")
    if frame == expected - 1:
        return "the frame is there twice"
    if frame > expected:
        return f"{frame - expected} missing from frame {expected} on; write every world frame"
    return "rows are not sorted by frame"


def _cause_of_times(seen: str, typical: float) -> str:
    unit = "milliseconds" if typical < 1000 else "microseconds"
    return f"times look like {unit} ({seen}); write ns"


def _move_like_corners(boxes: Floats, starts: Ints) -> bool:
    """Whether "width" and "height" follow x and y one for one, as x2 and y2 do."""
    known: Bools = ~np.isnan(boxes[:, 0])
    if not known.any() or (boxes[known, 2:] < boxes[known, :2]).any():
        return False
    steps = np.diff(boxes, axis=0)
    steps[starts[1:] - 1] = np.nan  # between two sequences
    travel = np.nansum(np.abs(steps[:, :2]))
    return bool(travel > 10 and np.nansum(np.abs(steps[:, 2:] - steps[:, :2])) < 0.8 * travel)


def _fit_as_corners(truth: Floats, boxes: Floats) -> str | None:
    """The column that makes boxes and truth match much worse than if it were that of corners."""
    known: Bools = ~np.isnan(truth[:, 0]) & ~np.isnan(boxes[:, 0])
    if not known.any():
        return None
    truth, boxes = (np.asfortranarray(some[known]) for some in (truth, boxes))  # fast by columns
    much_better = iou(truth, boxes).mean() + 0.3
    if much_better >= 1:
        return None
    for column, corners, others in (("w", boxes, truth), ("truth_w", truth, boxes)):
        sizes = np.column_stack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
        if iou(others, sizes).mean() > much_better:
            return column
    return None
