"""Faulty rows: the message names file, column, sequence and frame, and guesses the cause."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from witness import BOX, MINIMAL, TRUTH, columns_of, moving, write_plain

import lae_sim.trace.file
from lae_sim.errors import TraceError
from lae_sim.trace.file import Trace, read_trace, validate, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

Columns = dict[str, list[Any]]
EVERY = Metadata.new("30", "every-frame")
GROUP = [moving(20, 1, "Car1"), moving(20, 2, "Gull2")]
ROW, FRAME = 25, 5  # row 25 is frame 5 of Gull2


def put(column: str, value: Any, row: int = ROW) -> Callable[[Columns], None]:
    def edit(columns: Columns) -> None:
        columns[column][row] = value

    return edit


def put_box(names: tuple[str, ...], value: Any, row: int = ROW) -> Callable[[Columns], None]:
    def edit(columns: Columns) -> None:
        for name in names:
            columns[name][row] = value

    return edit


def without_row(row: int) -> Callable[[Columns], None]:
    def edit(columns: Columns) -> None:
        for values in columns.values():
            del values[row]

    return edit


def twice(row: int) -> Callable[[Columns], None]:
    def edit(columns: Columns) -> None:
        for values in columns.values():
            values.insert(row, values[row])

    return edit


def swapped(a: int, b: int) -> Callable[[Columns], None]:
    def edit(columns: Columns) -> None:
        for values in columns.values():
            values[a], values[b] = values[b], values[a]

    return edit


def sequences_swapped(columns: Columns) -> None:
    for values in columns.values():
        values[:] = values[20:] + values[:20]


def interleaved(columns: Columns) -> None:
    for values in columns.values():
        values[:] = [values[i // 2 + 20 * (i % 2)] for i in range(40)]


def counted_from_1(columns: Columns) -> None:
    columns["frame"] = [frame + 1 for frame in columns["frame"]]


def unprocessed(row: int) -> Callable[[Columns], None]:
    return put_box((*BOX, "elapsed_ns", "score"), None, row)


FAULTS = [
    # edit, column, sequence, frame, cause
    (without_row(ROW), "frame", "Gull2", 6, "missing"),
    (twice(ROW), "frame", "Gull2", 5, "twice"),
    (swapped(ROW, ROW + 1), "frame", "Gull2", 6, "missing"),
    (swapped(3, 7), "frame", "Car1", 7, "missing"),
    (without_row(20), "frame", "Gull2", 1, "must start at frame 0"),
    (without_row(0), "frame", "Car1", 1, "must start at frame 0"),
    (counted_from_1, "frame", "Car1", 1, "count from 0"),
    (put("frame", -5), "frame", "Gull2", -5, "not sorted by frame"),
    (sequences_swapped, "sequence", "Car1", 0, "not sorted by sequence .*'Gull2'"),
    (interleaved, "sequence", "Car1", 1, "not sorted by sequence"),
    (put("sequence", None, 20), "sequence", "", 0, "null or empty"),
    (put("sequence", ""), "sequence", "", 5, "null or empty"),
    *((put(name, None), name, "Gull2", 5, "null, but not all of x, y, w, h") for name in BOX),
    *((put(name, None), name, "Gull2", 5, "null, but not all of truth_x") for name in TRUTH),
    (put("elapsed_ns", None), "elapsed_ns", "Gull2", 5, "null, but the frame has a box"),
    (put_box(BOX, None), "x", "Gull2", 5, "null, but the frame has a time"),
    (unprocessed(20), "x", "Gull2", 0, "frame 0 initialises the tracker and needs a box"),
    (unprocessed(0), "x", "Car1", 0, "frame 0 initialises the tracker and needs a box"),
    *((put(name, math.nan), name, "Gull2", 5, "nan is not a number; write null") for name in BOX),
    *((put(name, math.nan), name, "Gull2", 5, "nan is not a number") for name in TRUTH),
    (put("h", math.inf), "h", "Gull2", 5, "inf is not a number"),
    (put("truth_w", -math.inf), "truth_w", "Gull2", 5, "-inf is not a number"),
    (put("elapsed_ns", -1), "elapsed_ns", "Gull2", 5, "negative time -1 ns"),
    (put("elapsed_ns", -(2**63)), "elapsed_ns", "Gull2", 5, "negative time"),
    (put("score", math.inf), "score", "Gull2", 5, "inf: a score is finite or null"),
    (put("score", -math.inf), "score", "Gull2", 5, "-inf: a score is finite or null"),
    (put("score", math.nan), "score", "Gull2", 5, "nan: a score is finite or null"),
]


@pytest.mark.parametrize("batch", [1 << 16, 7, 1])
@pytest.mark.parametrize(("edit", "column", "sequence", "frame", "cause"), FAULTS)
def test_a_fault_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    batch: int,
    edit: Callable[[Columns], None],
    column: str,
    sequence: str,
    frame: int,
    cause: str,
) -> None:
    columns = columns_of(GROUP)
    edit(columns)
    path = write_plain(tmp_path / "faulty.parquet", columns)
    monkeypatch.setattr(lae_sim.trace.file, "BATCH_ROWS", batch)
    where = f"faulty.parquet: column '{column}', sequence '{sequence}', frame {frame}: .*"
    with pytest.raises(TraceError, match=where + f"({cause})"):
        validate(path)


UNFIT = ["\0", "\t", "\n", "\r", "\x1b", "\x7f", "\x85"]


@pytest.mark.parametrize("character", UNFIT)
def test_a_name_has_no_control_characters(tmp_path: Path, character: str) -> None:
    name = f"Gull2{character}[2J"
    path = write_plain(tmp_path / "faulty.parquet", columns_of([moving(3, 0, name)]))
    message = re.escape(f"the name holds the control character {character!r}")
    for attempt in (validate, lambda path: write_trace(Trace(EVERY, [moving(3, 0, name)]), path)):
        with pytest.raises(TraceError, match=message) as caught:
            attempt(path)
        assert str(caught.value).isprintable()


def test_a_name_is_unicode(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="the name is not Unicode text"):
        write_trace(Trace(EVERY, [moving(3, 0, "Gull2\udcff")]), tmp_path / "faulty.parquet")


def test_an_infinite_score_is_not_written(tmp_path: Path) -> None:
    recording = moving(3, 0, "a")
    recording.score[2] = np.inf
    with pytest.raises(TraceError, match="'a', frame 2: inf: a score is finite or null"):
        write_trace(Trace(EVERY, [recording]), tmp_path / "faulty.parquet")
    assert not (tmp_path / "faulty.parquet").exists()


NEWER = {**MINIMAL, "version": "1.1"}


@pytest.mark.parametrize("batch", [1 << 16, 7, 1])
@pytest.mark.parametrize(
    ("row", "value", "sequence", "frame", "cause"),
    [
        (ROW, None, "Gull2", 5, "null"),
        (0, None, "Car1", 0, "null"),
        (ROW, 4 * 33_000_000, "Gull2", 5, "not after the frame before"),
        (ROW, -1, "Gull2", 5, "not after"),
        (ROW, 2**63 - 1, "Gull2", 6, "not after"),
        (20, 5, "Gull2", 0, "count from frame 0"),
        (0, -5, "Car1", 0, "count from frame 0"),
    ],
)
def test_a_fault_in_arrivals_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    batch: int,
    row: int,
    value: Any,
    sequence: str,
    frame: int,
    cause: str,
) -> None:
    columns = {**columns_of(GROUP), "arrival_ns": [33_000_000 * i for i in range(20)] * 2}
    validate(write_plain(tmp_path / "faulty.parquet", columns, NEWER))
    columns["arrival_ns"][row] = value
    path = write_plain(tmp_path / "faulty.parquet", columns, NEWER)
    monkeypatch.setattr(lae_sim.trace.file, "BATCH_ROWS", batch)
    where = f"faulty.parquet: column 'arrival_ns', sequence '{sequence}', frame {frame}: .*"
    with pytest.raises(TraceError, match=where + f"({cause})"):
        validate(path)


@pytest.mark.parametrize("batch", [1 << 16, 7, 1])
@pytest.mark.parametrize(
    ("column", "row", "value", "cause"),
    [
        ("stage_decode_ns", ROW, -1, "negative time -1 ns"),
        ("stage_decode_ns", ROW, -(2**63), "negative"),
        ("stage_inference_ns", ROW, 2**63 - 1, "take longer than it, 20000000 ns"),
        ("stage_inference_ns", ROW, 20_000_001 - 3_000_000, "take longer than it, 20000000 ns"),
        ("elapsed_ns", ROW, 10_999_999, "take longer than it, 10999999 ns"),
    ],
)
def test_a_fault_in_stages_is_named(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    batch: int,
    column: str,
    row: int,
    value: int,
    cause: str,
) -> None:
    columns = {
        **columns_of(GROUP),
        "elapsed_ns": [20_000_000] * 40,
        "stage_decode_ns": [3_000_000] * 40,
        "stage_inference_ns": [None] * 10 + [8_000_000] * 29 + [17_000_000],
    }
    validate(write_plain(tmp_path / "faulty.parquet", columns, NEWER))
    columns[column][row] = value
    path = write_plain(tmp_path / "faulty.parquet", columns, NEWER)
    monkeypatch.setattr(lae_sim.trace.file, "BATCH_ROWS", batch)
    named = "stage_inference_ns" if column == "elapsed_ns" else column
    where = f"faulty.parquet: column '{named}', sequence 'Gull2', frame 5: "
    with pytest.raises(TraceError, match=where + ".*" + cause):
        validate(path)


def test_a_frame_that_was_not_processed_has_no_stages(tmp_path: Path) -> None:
    columns = {**columns_of(GROUP), "stage_warp_ns": [None] * 39 + [0]}
    unprocessed(ROW)(columns)
    validate(write_plain(tmp_path / "valid.parquet", columns, NEWER))
    columns["stage_warp_ns"][ROW] = 0
    path = write_plain(tmp_path / "faulty.parquet", columns, NEWER)
    with pytest.raises(TraceError, match=r"'stage_warp_ns', .*frame 5: .*not processed"):
        validate(path)


@pytest.mark.parametrize("name", ["Decode", "decode-2", "2d", "", "_x", "décode", "a b", "a\n"])
def test_a_column_that_would_be_a_stages_is_called_so(tmp_path: Path, name: str) -> None:
    columns = {**columns_of(GROUP), f"stage_{name}_ns": [0] * 40}
    path = write_plain(tmp_path / "faulty.parquet", columns, NEWER)
    said = f"column {f'stage_{name}_ns'!r}: {name!r} is no name"
    with pytest.raises(TraceError, match=re.escape(said)):
        validate(path)


def test_other_columns_may_be_called_nearly_so(tmp_path: Path) -> None:
    more = dict.fromkeys(["stage_ns", "stage_decode_ms", "stages_x_ns", "Stage_x_ns"], ["x"] * 40)
    path = write_plain(tmp_path / "valid.parquet", {**columns_of(GROUP), **more})
    assert not read_trace(path).columns
    validate(path)


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("stage_warp_ns", [0.001] * 40, "is double, must be int64.*seconds"),
        ("stage_warp_ns", ["1"] * 40, "is string, must be int64"),
        ("arrival_ns", [i / 30 for i in range(20)] * 2, "is double, must be int64.*seconds"),
        ("visible", [1] * 40, "is int64, must be bool"),
        ("visible", ["yes"] * 40, "is string, must be bool"),
        ("arrival_ns", [33 * i for i in range(20)] * 2, "look like milliseconds .33 from frame"),
    ],
)
def test_optional_columns_of_other_types_are_named(
    tmp_path: Path, column: str, values: list[Any], message: str
) -> None:
    columns = {**columns_of(GROUP), column: values}
    path = write_plain(tmp_path / "faulty.parquet", columns, NEWER)
    with pytest.raises(TraceError, match=f"column '{column}'.*{message}"):
        validate(path)


def test_the_rows_before_the_edits_are_valid(tmp_path: Path) -> None:
    validate(write_plain(tmp_path / "valid.parquet", columns_of(GROUP)))


@pytest.mark.parametrize("edit", [put_box(TRUTH, None), unprocessed(ROW), unprocessed(39)])
def test_missing_truth_and_skipped_frames_are_valid(
    tmp_path: Path, edit: Callable[[Columns], None]
) -> None:
    columns = columns_of(GROUP)
    edit(columns)
    validate(write_plain(tmp_path / "valid.parquet", columns))


# ------------------------------------------------------------------------------- other units


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        ([47, 46, 48, 47], "milliseconds"),
        ([163, 14074, 16, 15], "milliseconds"),  # a warm-up stall does not hide the rest
        ([3, 2, 2, 2], "milliseconds"),
        ([4700, 5100, 4800, 4900], "microseconds"),
        ([15_547, 15_601, 15_300, 16_000], "microseconds"),
        ([47_000, 46_000, 48_100, 47_300], "microseconds"),  # the Jetson of the paper
    ],
)
def test_times_in_another_unit_are_guessed(tmp_path: Path, times: list[int], unit: str) -> None:
    columns = columns_of([moving(20, 2, "Gull2")])
    columns["elapsed_ns"] = times * 5
    path = write_plain(tmp_path / "faulty.parquet", columns)
    where = r"faulty.parquet: column 'elapsed_ns', sequence 'Gull2', frame 0: .*"
    with pytest.raises(TraceError, match=where + f"look like {unit}.*write ns"):
        validate(path)


@pytest.mark.parametrize(
    "times",
    [
        [0, 0, 0, 0],  # a tracker without cost, as in tests
        [1, 1, 1, 1],
        [300_000, 310_000, 290_000, 295_000],  # MOSSE: 3,000 frames/s
        [47_000_000, 14_000_000_000, 1, 48_000_000],
        [2**63 - 1] * 4,
    ],
)
def test_other_times_are_taken_as_they_are(tmp_path: Path, times: list[int]) -> None:
    columns = columns_of([moving(20)])
    columns["elapsed_ns"] = times * 5
    validate(write_plain(tmp_path / "valid.parquet", columns))


def corners(boxes: np.ndarray) -> np.ndarray:
    return np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)


@pytest.mark.parametrize("which", ["boxes", "truth", "both", "boxes without truth"])
@pytest.mark.parametrize("seed", range(4))
def test_boxes_as_corners_are_guessed(tmp_path: Path, which: str, seed: int) -> None:
    fine = moving(60, seed, "Gull2")
    truth = corners(fine.truth) if which in ("truth", "both") else fine.truth
    if which == "boxes without truth":
        truth = np.full((60, 4), np.nan)
    boxes = fine.boxes if which == "truth" else corners(fine.boxes)
    recording = Recording.new("Gull2", truth, boxes, fine.elapsed_ns)
    path = write_plain(tmp_path / "faulty.parquet", columns_of([recording]))
    where = r"faulty.parquet: column '(truth_)?w', sequence 'Gull2', frame \d+: .*"
    with pytest.raises(TraceError, match=where + "look like x1, y1, x2, y2; write x, y, w, h"):
        validate(path)


@pytest.mark.parametrize("which", ["boxes", "truth"])
def test_corners_of_a_still_target_are_guessed_from_the_other_boxes(
    tmp_path: Path, which: str
) -> None:
    still = np.tile([300.0, 200, 40, 30], (20, 1))
    truth, boxes = (still, corners(still)) if which == "boxes" else (corners(still), still)
    recording = Recording.new("Gull2", truth, boxes, [47_000_000] * 20)
    with pytest.raises(TraceError, match="x1, y1, x2, y2"):
        validate(write_plain(tmp_path / "faulty.parquet", columns_of([recording])))


@pytest.mark.parametrize("seed", range(8))
def test_honest_boxes_are_not_taken_for_corners(tmp_path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    near = moving(60, seed, "a")
    lost = Recording.new("b", near.truth, near.truth + 200, near.elapsed_ns)
    # a target that grows as it moves away from the corner, and one that fills the image
    grows = np.cumsum(random.uniform(0, 3, (60, 4)), axis=0) + [10, 10, 60, 60]
    whole = np.array([0, 0, 640, 360]) + random.normal(0, 3, (60, 4))
    group = [
        near,
        lost,
        Recording.new("c", grows, grows, near.elapsed_ns),
        Recording.new("d", whole, whole, near.elapsed_ns),
    ]
    path = tmp_path / "valid.parquet"
    write_trace(Trace(read_metadata(tmp_path), group), path)
    validate(path)


def read_metadata(folder: Path) -> Any:
    return read_trace(write_plain(folder / "any.parquet", columns_of([moving(2)]))).metadata
