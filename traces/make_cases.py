"""Make the valid and invalid traces that other readers can be tested with.

``python traces/make_cases.py [FOLDER]`` writes ``cases/valid/*.parquet``,
``cases/invalid/*.parquet`` and ``cases/invalid/expected.json``, which gives the words that the
refusal of each must have. It uses pyarrow alone, so that it can break every rule.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

Columns = dict[str, list[Any]]
Types = dict[str, pa.DataType]
Document = dict[str, Any]

TYPES: Types = {
    "sequence": pa.string(),
    "frame": pa.int32(),
    **{name: pa.float64() for name in ("truth_x", "truth_y", "truth_w", "truth_h", *"xywh")},
    "elapsed_ns": pa.int64(),
    "score": pa.float32(),
    "arrival_ns": pa.int64(),
    "visible": pa.bool_(),
    **{
        f"stage_{name}_ns": pa.int64()
        for name in ("decode", "inference", "warp_2", "queue", "tracker")
    },
}
DOCUMENT: Document = {
    "format": "lae-trace",
    "version": "1.0",
    "fps": "30",
    "schedule": {"kind": "every-frame"},
}

NEWER: Document = {**DOCUMENT, "version": "1.1"}
LOGGED: Document = {
    **NEWER,
    "schedule": {"kind": "real-time", "policy": "recorded"},
    "timing": {"source": "measured", "clock": "receive times of the bag"},
    "log": {
        "format": "ros",
        "images": "/camera/image",
        "boxes": "/tracker/box",
        "matched_by": "equal stamps",
        "arrivals": "received",
        "clock_offset_ns": -12_000_000,
        "clock_offset_source": "estimated",
        "camera_delay_ns": {"least": 0, "median": 1_000_000, "most": 9_000_000},
        "initial_box": "first output",
    },
}
RESTARTS: Document = {**NEWER, "schedule": {"kind": "restarts"}}


def good() -> Columns:
    """Two sequences of four frames, moving right and down."""
    names = ["a"] * 4 + ["b"] * 4
    frames = [0, 1, 2, 3] * 2
    columns: Columns = {"sequence": names, "frame": frames}
    for prefix, offset in (("truth_", 0.0), ("", 1.0)):
        columns[f"{prefix}x"] = [100.0 + 8 * frame + offset * (frame > 0) for frame in frames]
        columns[f"{prefix}y"] = [50.0 + 4 * frame for frame in frames]
        columns[f"{prefix}w"] = [40.0] * 8
        columns[f"{prefix}h"] = [30.0] * 8
    columns["elapsed_ns"] = [90_000_000, *[20_000_000 + 1000 * i for i in range(7)]]
    columns["score"] = [None] + [0.5] * 7
    return columns


def changed(column: str, row: int, value: Any) -> Columns:
    """The good columns with one value changed."""
    columns = good()
    columns[column][row] = value
    return columns


def without(*names: str) -> Columns:
    """The good columns without some."""
    return {name: values for name, values in good().items() if name not in names}


def mapped(function: Callable[[Any], Any], column: str) -> Columns:
    """The good columns with one of them mapped."""
    columns = good()
    columns[column] = [function(value) for value in columns[column]]
    return columns


def rows(order: list[int]) -> Columns:
    """Some of the good rows, in an order."""
    return {name: [values[row] for row in order] for name, values in good().items()}


def corners(*prefixes: str) -> Columns:
    """Boxes written as x1, y1, x2, y2."""
    columns = good()
    for prefix in prefixes:
        for size, start in (("w", "x"), ("h", "y")):
            columns[prefix + size] = [
                a + b for a, b in zip(columns[prefix + start], columns[prefix + size])
            ]
    return columns


def skipping() -> Columns:
    """A real-time run that skipped frame 1 of each sequence."""
    columns = good()
    for name in (*"xywh", "elapsed_ns", "score"):
        columns[name][1] = columns[name][5] = None
    return columns


def restarts(*names: str) -> Columns:
    """Restarts that jump from row 0 to row 2 and follow for a frame."""
    columns = skipping()
    columns["sequence"] = [name for name in names for _ in range(4)]
    return columns


def arriving(*changes: tuple[int, Any]) -> Columns:
    """The good columns with the times at which frames arrived: frame 2 late, 3 after a gap."""
    times = [0, 33_333_333, 69_000_000, 166_666_667] * 2
    for row, value in changes:
        times[row] = value
    return {**good(), "arrival_ns": times}


def flagged(*flags: Any) -> Columns:
    """The good columns with flags of the frames of ``a``; nothing is said of ``b``."""
    return {**good(), "visible": [*flags, *[None] * 4]}


def staged(columns: Columns, *changes: tuple[int, Any]) -> Columns:
    """Columns with the times of stages: all of frame 1 of ``b``, nothing of frame 0 of ``a``."""
    decode = [None, *range(1_000_000, 1_000_007)]
    inference = [None, 0, 8_000_000, 9_000_000, None, 19_003_996, 0, None]
    for row, value in changes:
        inference[row] = value
    stages = {"stage_decode_ns": decode, "stage_inference_ns": inference}
    skipped = [ns is None for ns in columns["elapsed_ns"]]
    return {**columns, **{
        name: [None if skip else ns for ns, skip in zip(values, skipped)]
        for name, values in stages.items()
    }}  # fmt: skip


def logged() -> Columns:
    """A real-time run whose frames queued: what waiting and the calls took."""
    columns = skipping()
    # of ``a`` a call began before the last had ended
    waited = [0, None, 4_000_000, None, 0, None, 0, 0]
    calls = [
        None if ns is None or wait is None else ns - wait
        for ns, wait in zip(columns["elapsed_ns"], waited)
    ]
    stages = {"stage_queue_ns": waited, "stage_tracker_ns": calls}
    return {**columns, "arrival_ns": arriving()["arrival_ns"], **stages}


def no_truth() -> Columns:
    """Truth that is missing in two frames."""
    columns = good()
    for name in ("truth_x", "truth_y", "truth_w", "truth_h"):
        columns[name][2] = columns[name][5] = None
    return columns


def write(path: Path, columns: Columns, document: Any = DOCUMENT, types: Types = TYPES) -> None:
    """Write a table with metadata: an object as JSON, bytes as they are, None for none."""
    table = pa.table({name: pa.array(values, types[name]) for name, values in columns.items()})
    if document is not None:
        text = document if isinstance(document, bytes) else json.dumps(document).encode()
        table = table.replace_schema_metadata({"lae_sim": text})
    pq.write_table(table, path)


def write_valid(folder: Path) -> None:
    """Write files that every reader must accept."""
    real_time = {**DOCUMENT, "schedule": {"kind": "real-time", "policy": "latest"}}
    full = {
        **DOCUMENT,
        "fps": "30000/1001",
        "tracker": {
            "name": "example",
            "settings": {"scale": 2},
            "search": {"half_side": 1.25, "window": True, "source": "crops of 128 and 256 pixels"},
        },
        "device": {
            "model": "board",
            "power_mode": "15W",
            "energy": {
                "calls": 4,
                "seconds": 0.08,
                "power_w": {"VDD_IN": 9.5, "VDD_SOC": 1.25},
                "idle_w": {"VDD_IN": 5.0, "VDD_SOC": 1.0},
                "total": ["VDD_IN"],
                "joules_per_frame": 0.19,
                "joules_per_frame_above_idle": 0.09,
            },
            "clocks": {"cpu_mhz": 1728.0, "gpu_mhz": 918.0},
            "slowdowns": {"software power cap": 0.25},
            "unread": {"VDD_SOC": 0.1},
            "beside": [
                {
                    "command": "./encode.sh",
                    "exit": 1,
                    "seconds": 2.5,
                    "sequences": 1,
                    "of_sequences": 2,
                }
            ],
        },
        "timing": {"source": "measured", "clock": "perf_counter_ns", "warmup_calls": 3},
        "dataset": {"name": "example"},
        "sequences": {
            "a": {
                "image_size": [640, 480],
                "attributes": ["Occlusion"],
                "sampled": {"calls": 2, "seconds": 0.04, "power_w": {"VDD_IN": 9.5}},
            }
        },
        "a key of the future": [1, {"x": None}],
    }
    dictionary = pa.dictionary(pa.int32(), pa.string())
    write(folder / "minimal.parquet", good())
    write(folder / "full-metadata.parquet", good(), full)
    write(folder / "minor-version.parquet", good(), {**DOCUMENT, "version": "1.7"})
    write(folder / "real-time.parquet", skipping(), real_time)
    write(folder / "restarts.parquet", restarts("a+b@c@0+2", "a@12+2"), RESTARTS)
    write(folder / "missing-truth.parquet", no_truth())
    write(folder / "no-truth-columns.parquet", without("truth_x", "truth_y", "truth_w", "truth_h"))
    write(folder / "no-score-column.parquet", without("score"))
    write(folder / "arrivals.parquet", arriving(), NEWER)
    write(folder / "flags-of-absence.parquet", flagged(True, None, False, True), NEWER)
    newer_real_time = {**NEWER, "schedule": real_time["schedule"]}
    write(folder / "stages.parquet", staged(good()), NEWER)
    write(folder / "stages-of-a-real-time-run.parquet", staged(skipping()), newer_real_time)
    own = {**good(), "stage_warp_2_ns": [None] * 4 + [0, 5, 6, 7]}
    write(folder / "stage-of-ones-own.parquet", own, NEWER)
    write(folder / "log.parquet", logged(), LOGGED)
    write(folder / "all-of-1.1.parquet",
          staged({**flagged(True, True, True, False), **arriving()}), NEWER)  # fmt: skip
    write(folder / "zero-time.parquet", mapped(lambda _: 0, "elapsed_ns"))
    write(folder / "one-frame.parquet", rows([0]))
    write(folder / "large-string.parquet", good(), types={**TYPES, "sequence": pa.large_string()})
    write(folder / "dictionary.parquet", good(), types={**TYPES, "sequence": dictionary})


def write_invalid(folder: Path) -> None:
    """Write files that every reader must refuse, and the words that lae_sim refuses them with."""
    expected: dict[str, list[str]] = {}

    def bad(name: str, *words: str, columns: Columns | None = None, **how: Any) -> None:
        write(folder / f"{name}.parquet", good() if columns is None else columns, **how)
        expected[f"{name}.parquet"] = list(words)

    def bad_document(name: str, *words: str, **changes: Any) -> None:
        bad(name, *words, document={**DOCUMENT, **changes})

    bad("metadata-missing", "lae_sim", "missing", document=None)
    bad("metadata-not-json", "JSON", document=b"{fps: 30}")
    bad("metadata-not-utf8", "JSON", document=b'{"format": "\xff"}')
    bad("metadata-not-object", "object", document=[1, 2])
    bad_document("format-other", "format", format="other")
    bad_document("version-2", "2.0", "install", version="2.0")
    bad_document("version-number", "version", version=1.0)
    bad_document("fps-number", "fps", "text", fps=30)
    bad_document("fps-zero", "fps", "above zero", fps="0")
    bad_document("fps-division-by-zero", "fps", fps="30/0")
    bad_document("fps-exponent", "fps", fps="3e1")
    bad_document("kind-unknown", "schedule.kind", schedule={"kind": "sometimes"})
    bad_document("schedule-missing", "schedule.kind", schedule=None)
    bad_document("image-size-text", "image_size", sequences={"a": {"image_size": "640x480"}})
    bad_document("attributes-text", "attributes", sequences={"a": {"attributes": "Occlusion"}})
    bad_document("tracker-text", "tracker", tracker="example")
    bad_document("text-escape", "tracker.name", "control character", tracker={"name": "\x1b[2J"})
    bad_document("text-newline", "note", "control character", note=["one", "two\nthree"])
    bad_document("text-in-key", "control character", settings={"\0": 1})
    bad_document("text-half-character", "tracker.name", "Unicode", tracker={"name": "\ud800"})
    for name, word, search in (
        ("search-text", "search", "near"),
        ("search-without-side", "half_side", {"window": True}),
        ("search-side-zero", "half_side", {"half_side": 0}),
        ("search-side-true", "half_side", {"half_side": True}),
        ("search-window-number", "window", {"half_side": 1.0, "window": 1}),
        ("search-source-number", "source", {"half_side": 1.0, "source": 127}),
    ):
        bad_document(name, f"tracker.{'' if word == 'search' else 'search.'}{word}",
                     tracker={"search": search})  # fmt: skip
    for name, restart in (("restart-without-gap", "b@3"), ("restart-gap-zero", "b@3+0")):
        bad(name, "sequence", repr(restart), "SEQUENCE@START+GAP",
            columns=restarts("a@0+2", restart), document=RESTARTS)  # fmt: skip

    bad("column-missing", "elapsed_ns", "missing", columns=without("elapsed_ns"))
    bad("truth-column-missing", "truth_w", "missing", columns=without("truth_w"))
    seconds = {**TYPES, "elapsed_ns": pa.float64()}
    in_seconds = mapped(lambda ns: ns / 1e9, "elapsed_ns")
    bad("times-in-seconds", "elapsed_ns", "seconds", columns=in_seconds, types=seconds)
    bad("frame-as-text", "frame", "int32", columns=mapped(str, "frame"),
        types={**TYPES, "frame": pa.string()})  # fmt: skip
    bad("box-in-float32", "'x'", "double", types={**TYPES, "x": pa.float32()})

    bad("sequences-unsorted", "'a'", "not sorted", columns=rows([4, 5, 6, 7, 0, 1, 2, 3]))
    bad("sequence-in-two-parts", "'a'", "not sorted", columns=rows([0, 1, 4, 5, 2, 3]))
    bad("sequence-null", "sequence", "null", columns=changed("sequence", 0, None))
    bad("frame-gap", "'a'", "frame 3", "missing", columns=rows([0, 1, 3, 4]))
    bad("frame-twice", "'b'", "frame 1", "twice", columns=rows([0, 4, 5, 5, 6]))
    bad("frames-unsorted", "frame 1", "not sorted", columns=rows([0, 1, 2, 3, 4, 5, 6, 5]))
    bad("frames-from-one", "start at frame 0", columns=mapped(lambda i: i + 1, "frame"))
    bad("frames-do-not-start-at-zero", "'b'", "start at frame 0", columns=rows([0, 6, 7]))

    bad("box-half-null", "'w'", "'a'", "frame 2", "null", columns=changed("w", 2, None))
    bad("truth-half-null", "'truth_y'", "frame 2", "null", columns=changed("truth_y", 2, None))
    bad("time-null", "elapsed_ns", "frame 2", "null", columns=changed("elapsed_ns", 2, None))
    first_skipped = good()
    for name in (*"xywh", "elapsed_ns"):
        first_skipped[name][4] = None
    bad("frame-0-not-processed", "'b'", "frame 0", columns=first_skipped)
    bad("box-nan", "'h'", "'b'", "frame 3", "nan", columns=changed("h", 7, float("nan")))
    bad("truth-infinite", "truth_x", "inf", columns=changed("truth_x", 1, float("inf")))
    for name, value in (("score-nan", float("nan")), ("score-infinite", float("inf"))):
        bad(name, "score", "'a'", "frame 2", "finite or null", columns=changed("score", 2, value))
    named = mapped(lambda name: f"{name}\r", "sequence")
    bad("sequence-control-character", "sequence", "control character", columns=named)
    bad("time-negative", "elapsed_ns", "negative", columns=changed("elapsed_ns", 3, -5))

    for name, row, words, change in (
        ("arrival-null", 5, ["'b'", "frame 1", "null"], None),
        ("arrival-twice", 2, ["'a'", "frame 2", "not after"], 33_333_333),
        ("arrivals-not-ascending", 7, ["'b'", "frame 3", "not after"], 1),
        ("arrivals-not-from-zero", 4, ["'b'", "frame 0", "count from frame 0"], 1_000_000),
    ):
        bad(name, "arrival_ns", *words, columns=arriving((row, change)), document=NEWER)
    in_seconds = {**good(), "arrival_ns": [0.0, 0.03, 0.07, 0.17] * 2}
    bad("arrivals-in-seconds", "arrival_ns", "seconds", columns=in_seconds, document=NEWER,
        types={**TYPES, "arrival_ns": pa.float64()})  # fmt: skip
    in_ms = {**good(), "arrival_ns": [0, 33, 69, 167] * 2}
    bad("arrivals-in-milliseconds", "arrival_ns", "milliseconds", columns=in_ms, document=NEWER)
    bad("flags-as-numbers", "visible", "bool", columns=flagged(1, 1, 0, 1), document=NEWER,
        types={**TYPES, "visible": pa.int8()})  # fmt: skip

    for name, row, words, change in (
        ("stage-negative", 2, ["'a'", "frame 2", "negative"], -1),
        ("stage-longer-than-the-call", 6, ["'b'", "frame 2", "longer"], 30_000_000),
        ("stages-longer-together", 5, ["'b'", "frame 1", "longer"], 19_003_997),
    ):
        bad(name, "stage_inference_ns", *words, columns=staged(good(), (row, change)),
            document=NEWER)  # fmt: skip
    unprocessed = {**skipping(), "stage_decode_ns": [1000] * 8}
    bad("stage-of-a-skipped-frame", "stage_decode_ns", "'a'", "frame 1", "not processed",
        columns=unprocessed, document=NEWER)  # fmt: skip
    in_seconds = {**good(), "stage_decode_ns": [0.001] * 8}
    bad("stage-in-seconds", "stage_decode_ns", "seconds", columns=in_seconds, document=NEWER,
        types={**TYPES, "stage_decode_ns": pa.float64()})  # fmt: skip
    bad("stage-name", "stage_Decode_ns", "small letters", document=NEWER,
        columns={**good(), "stage_Decode_ns": [1000] * 8},
        types={**TYPES, "stage_Decode_ns": pa.int64()})  # fmt: skip

    in_ms = mapped(lambda ns: ns // 1_000_000, "elapsed_ns")
    bad("times-in-milliseconds", "elapsed_ns", "milliseconds", columns=in_ms)
    in_us = mapped(lambda ns: ns // 1000, "elapsed_ns")
    bad("times-in-microseconds", "elapsed_ns", "microseconds", columns=in_us)
    bad("boxes-as-corners", "x1, y1, x2, y2", columns=corners(""))
    bad("truth-as-corners", "x1, y1, x2, y2", columns=corners("truth_"))
    bad("both-as-corners", "x1, y1, x2, y2", columns=corners("", "truth_"))

    bad("no-rows", "empty", columns={name: [] for name in good()})
    whole = (folder / "no-rows.parquet").read_bytes()
    for name, content in {
        "truncated": whole[: len(whole) // 2],
        "not-parquet": b"sequence,frame,x,y,w,h\n" * 20,
        "empty-file": b"",
    }.items():
        (folder / f"{name}.parquet").write_bytes(content)
        expected[f"{name}.parquet"] = ["Parquet"]
    text = json.dumps(dict(sorted(expected.items())), indent=1)
    (folder / "expected.json").write_text(text + "\n", encoding="utf-8")


def main() -> None:
    """Write the cases into a folder, by default ``cases`` beside this file."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "cases"
    for kind in ("valid", "invalid"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    write_valid(folder / "valid")
    write_invalid(folder / "invalid")


if __name__ == "__main__":
    main()
