"""Hostile and damaged files: an error of ours or a valid read, never anything else."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import BOX, MINIMAL, TRUTH, TYPES, columns_of, moving, same, write_plain

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import fifo, latest, shrinking_tail, vot_realtime
from lae_sim.errors import LaeError, TraceError
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.forecast.base import Hold
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt
from lae_sim.replay.latency import by_call, by_frame, constant, lognormal, resampled
from lae_sim.replay.run import Run, replay_sequence
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

OLD_ARROW = int(pa.__version__.split(".")[0]) < 15
FORECASTERS = {"hold": Hold, "kalman": Kalman, "kalman-lae-pvt": KalmanLaePvt}

Found = tuple[Metadata, list[Recording]]


def named(error: TraceError, path: Path) -> None:
    """Every message begins with the file's name."""
    assert str(error).startswith(f"{path}: ")


def use(path: Path) -> Found | None:
    """Read a file and do with it what one does; None if an error of ours came of it."""
    try:
        trace = read_trace(path)
        recordings = list(trace)
    except TraceError as error:
        named(error, path)
        return None
    clock = Clock.at(trace.metadata.fps)
    for recording in recordings:
        for source in (by_frame, by_call, constant(ns=1), resampled(1), lognormal(1)):
            for policy in (latest, fifo, shrinking_tail(ns=50_000_000), vot_realtime()):
                with suppress(LaeError):
                    run = replay_sequence(recording, clock, source, policy)
                    if source is by_frame and policy is latest:
                        evaluate_runs([run], trace.metadata, FORECASTERS, SIGMA_GRID[::10])
    return trace.metadata, recordings


# ----------------------------------------------------------------------------- damaged bytes


@pytest.fixture(scope="module")
def original() -> Found:
    """Two sequences with skipped frames and missing truth, score and all."""
    a, b = moving(40, 1, "a"), moving(30, 2, "b")
    b.truth[3], b.boxes[5:8], b.elapsed_ns[5:8], b.score[5:8] = np.nan, np.nan, -1, np.nan
    metadata = Metadata.new("30", "real-time", tracker={"name": "t"}, mine=[1, "two"])
    return metadata, [a, b]


@pytest.fixture(scope="module")
def content(original: Found, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("fuzz") / "trace.parquet"
    write_trace(Trace(*original), path)
    return path.read_bytes()


def read(path: Path) -> Found | None:
    try:
        trace = read_trace(path)
        return trace.metadata, list(trace)
    except TraceError as error:
        named(error, path)
        return None


def footer_of(content: bytes) -> int:
    """Where the footer begins: it has no checksum, while every data page has."""
    (size,) = struct.unpack("<I", content[-8:-4])
    return len(content) - 8 - size


def flipped(content: bytes, bits: list[int]) -> bytes:
    damaged = bytearray(content)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


@pytest.mark.skipif(OLD_ARROW, reason="pages have no checksums before pyarrow 15")
def test_a_flipped_bit_of_the_data_is_found_or_changes_nothing(
    tmp_path: Path, content: bytes, original: Found
) -> None:
    random = np.random.default_rng(20)
    path = tmp_path / "trace.parquet"
    footer = footer_of(content)
    found = 0
    for bit in [10 * 8 + 6, *random.integers(0, footer * 8, 700).tolist()]:
        path.write_bytes(flipped(content, [bit]))
        result = read(path)
        if result is None:
            found += 1
            continue
        assert result[0] == original[0], bit
        assert len(result[1]) == 2, bit
        assert all(same(a, b) for a, b in zip(result[1], original[1])), bit
    assert found > 500


def test_a_flipped_bit_of_the_footer_changes_no_box_and_no_time(
    tmp_path: Path, content: bytes, original: Found
) -> None:
    # Parquet's footer has no checksum. A flip there can make another valid document of our
    # metadata, or rename the column of scores so that there are none; it can do no more.
    random = np.random.default_rng(21)
    path = tmp_path / "trace.parquet"
    footer = footer_of(content) * 8
    clean = 0
    for bit in random.choice(np.arange(footer, len(content) * 8), 700, replace=False).tolist():
        path.write_bytes(flipped(content, [bit]))
        result = read(path)
        if result is None:
            continue
        clean += 1
        for found, expected in zip(result[1], original[1]):
            scored = expected
            if np.isnan(found.score).all():
                scored = replace(expected, score=np.full(len(expected), np.nan, np.float32))
            assert same(found, scored), bit
        assert len(result[1]) == 2, bit
    assert clean > 100


@pytest.mark.parametrize("count", [1, 69, 71, 8000])
def test_a_footer_that_miscounts_its_rows_is_refused(
    tmp_path: Path, content: bytes, count: int
) -> None:
    # Thrift writes the 70 rows of file, row group and columns as this zigzag varint.
    path = tmp_path / "trace.parquet"
    footer = footer_of(content)
    places = [i for i in range(footer, len(content) - 8) if content[i : i + 2] == b"\x8c\x01"]
    assert len(places) > 2
    for place in places:
        damaged = bytearray(content)
        damaged[place : place + 2] = [(2 * count & 0x7F) | 0x80, 2 * count >> 7]
        path.write_bytes(bytes(damaged))
        result = read(path)
        assert result is None or [len(r) for r in result[1]] == [40, 30]


@pytest.mark.parametrize("seed", range(4))
def test_several_flipped_bits_anywhere(tmp_path: Path, content: bytes, seed: int) -> None:
    random = np.random.default_rng(seed)
    path = tmp_path / "trace.parquet"
    for _ in range(60):
        bits = random.integers(0, len(content) * 8, random.integers(2, 9)).tolist()
        path.write_bytes(flipped(content, bits))
        read(path)


def test_a_truncated_file_is_refused(tmp_path: Path, content: bytes) -> None:
    random = np.random.default_rng(0)
    path = tmp_path / "trace.parquet"
    lengths = {*range(0, 16), *range(len(content) - 16, len(content))}
    for length in sorted(lengths | set(random.integers(0, len(content), 150).tolist())):
        path.write_bytes(content[:length])
        assert read(path) is None


def test_a_file_with_a_hole_or_a_tail_is_refused_or_read_as_it_was(
    tmp_path: Path, content: bytes, original: Found
) -> None:
    random = np.random.default_rng(0)
    path = tmp_path / "trace.parquet"
    for _ in range(100):
        a, b = sorted(random.integers(0, len(content), 2).tolist())
        for damaged in (content[:a] + content[b:], content[:b] + content[a:], content + b"x" * a):
            path.write_bytes(damaged)
            result = read(path)
            assert result is None or all(same(a, b) for a, b in zip(result[1], original[1]))


# ----------------------------------------------------------------------------- hostile metadata

ROWS = columns_of([moving(12, 1, "a"), moving(7, 2, "b")])

JSON = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.integers(-(10**60), 10**60),
        st.floats(),
        st.text(st.characters(), max_size=8),
        st.sampled_from(["30", "1/0", "1e9", "lae-trace", "real-time", "1.0", "\ud800", "\0"]),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.text(max_size=8), inner, max_size=3),
        st.fixed_dictionaries({"kind": inner}),
        st.fixed_dictionaries({"a": inner, "b": inner}),
        st.fixed_dictionaries({"image_size": inner, "attributes": inner}),
        st.fixed_dictionaries({"image_size": st.just([64, 36]), "image_sizes": inner}),
        st.lists(st.lists(st.integers(0, 64), min_size=3, max_size=3), max_size=3),
        st.fixed_dictionaries({"name": inner, "model": inner, "source": inner}),
    ),
    max_leaves=8,
)
KEYS = [*MINIMAL, "tracker", "device", "timing", "dataset", "sequences"]


def exercise(metadata: Metadata) -> None:
    """Whatever was parsed can be asked and written, and comes back as it was."""
    assert isinstance(metadata.tracker, str)
    assert isinstance(metadata.device, str)
    assert metadata.timing_note is None or isinstance(metadata.timing_note, str)
    assert metadata.fps > 0
    for name in ("a", "b", "c"):
        assert all(isinstance(attribute, str) for attribute in metadata.attributes(name))
        size, sizes = metadata.image_size(name), metadata.image_sizes(name)
        assert size is None or (min(size) > 0 and all(type(side) is int for side in size))
        assert (None if sizes is None else sizes.at(0)) == size
        assert name not in metadata.resized or (sizes is not None and sizes.change)
    assert Metadata.parse(metadata.dumps()) == metadata


@given(st.dictionaries(st.sampled_from(KEYS), JSON, max_size=4), st.booleans())
@settings(max_examples=250)
def test_any_document_is_read_or_refused(changes: dict[str, Any], valid_else: bool) -> None:
    document = {**(MINIMAL if valid_else else {}), **changes}
    try:
        metadata = Metadata.parse(json.dumps(document).encode())
    except TraceError:
        return
    exercise(metadata)


@given(st.binary(max_size=60) | st.text(max_size=40).map(lambda t: t.encode("utf-8", "replace")))
def test_any_bytes_are_refused(text: bytes) -> None:
    with pytest.raises(TraceError):
        Metadata.parse(text)


def nested(depth: int, inside: str = "") -> bytes:
    deep = "[" * depth + inside + "]" * depth
    return json.dumps(MINIMAL)[:-1].encode() + b', "deep": ' + deep.encode() + b"}"


@pytest.mark.parametrize("depth", [*range(50, 1200, 50), 10_000, 200_000])
def test_deep_nesting_is_read_and_can_be_written_or_is_refused(depth: int) -> None:
    for text in (nested(depth), nested(depth).replace(b"[", b'{"a":').replace(b"]", b"}")):
        try:
            metadata = Metadata.parse(text)
        except TraceError:
            continue
        with suppress(LaeError):
            assert Metadata.parse(metadata.dumps()).fps == 30


HOSTILE = [
    b"",
    b"\0",
    b"null",
    b"\xff\xfe{}",
    b"\xef\xbb\xbf" + json.dumps(MINIMAL).encode(),
    json.dumps(MINIMAL).encode("utf-16"),
    json.dumps(MINIMAL).encode()[:-1],
    json.dumps(MINIMAL).encode() * 2,
    b'{"format": "lae-trace", "version": "1.0", "fps": "30", "schedule": NaN}',
    json.dumps({**MINIMAL, "x": float("nan")}).encode(),
    json.dumps({**MINIMAL, "x": float("inf")}).encode(),
    nested(100_000),
    nested(1, "1" * 100_000),
    nested(1, "9" * 4000),
    nested(1, "1e400"),
    nested(1, "-1e999"),
    nested(1, "1e-999"),
    nested(1, '"\\ud800"'),
    nested(1, '"\\u0000"'),
    *(
        json.dumps({**MINIMAL, "fps": fps}).encode()
        for fps in [
            "1/0",
            "1e9",
            "0",
            "-1",
            "1" * 5000,
            "999999999999",
            "1/999999999999",
            "999999999999/999999999998",
            "0.000000000001",
            "\u0663\u0660",
            "1/\u0660",
            "\ud800",
            "30\0",
            30,
            [],
        ]
    ),
    *(
        json.dumps({**MINIMAL, "version": version}).encode()
        for version in ["999.0", "1", "1." + "9" * 5000, "\u0661.\u0660", 1.0, None, "-1.0"]
    ),
    json.dumps({**MINIMAL, "sequences": {"a": {"image_size": [10**400, 1]}}}).encode(),
    json.dumps({**MINIMAL, "sequences": {"a": {"image_size": [1, 1]}}}).encode(),
    json.dumps(
        {
            **MINIMAL,
            "sequences": {"a": {"image_size": [1, 1], "image_sizes": [[0, 1, 1], [5, 2, 2]]}},
        }
    ).encode(),
    json.dumps({**MINIMAL, "sequences": {"\ud800": {"attributes": ["\ud800"]}}}).encode(),
    json.dumps(
        {**MINIMAL, "tracker": {"name": {"a": [None]}}, "device": {"model": 1e300}}
    ).encode(),
]


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: repr(text[-50:]))
def test_hostile_metadata_in_a_file(tmp_path: Path, text: bytes) -> None:
    found = use(write_plain(tmp_path / "trace.parquet", ROWS, text))
    if found is not None:
        exercise(found[0])
        write_trace(Trace(*found), tmp_path / "copy.parquet")
        assert read_trace(tmp_path / "copy.parquet").metadata == found[0]


# ------------------------------------------------------------------------------ hostile values

TYPE_POOL = [
    pa.null(),
    pa.bool_(),
    pa.int8(),
    pa.uint64(),
    pytest.param(pa.float16(), marks=pytest.mark.skipif(OLD_ARROW, reason="needs pyarrow 15")),
    pa.float64(),
    pa.string(),
    pa.large_string(),
    pa.binary(),
    pa.date32(),
    pa.timestamp("ns"),
    pa.duration("ns"),
    pa.decimal128(20, 3),
    pa.list_(pa.float64()),
    pa.list_(pa.float64(), 4),
    pa.struct([("x", pa.float64())]),
    pa.map_(pa.string(), pa.int64()),
    pa.dictionary(pa.int32(), pa.string()),
]


@pytest.mark.parametrize("kind", TYPE_POOL, ids=str)
def test_columns_of_wrong_types(tmp_path: Path, kind: pa.DataType) -> None:
    path = tmp_path / "trace.parquet"
    for column in TYPES:
        rows = len(ROWS["x"])
        if pa.types.is_dictionary(kind):
            array = pa.array(["a"] * rows).dictionary_encode()
        else:
            array = pa.nulls(rows, kind)
        if kind == pa.float16():
            array = pa.array([np.float16(1)] * rows, kind)
        assert read(write_plain(path, {**ROWS, column: array})) is None or (
            TYPES[column] in (kind, pa.string())
        )


def edited(**changes: Any) -> dict[str, Any]:
    columns = {name: list(values) for name, values in ROWS.items()}
    for name, value in changes.items():
        columns[name] = value(columns[name]) if callable(value) else [value] * len(columns[name])
    return columns


def at(row: int, value: Any) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [*values[:row], value, *values[row + 1 :]]


def renamed(name: str) -> Callable[[list[Any]], list[Any]]:
    return lambda values: ["a" if value == "a" else name for value in values]


BIG, SMALL = 2**63 - 1, -(2**63)
HUGE = 1.7976931348623157e308


@pytest.mark.parametrize(
    "columns",
    [
        edited(elapsed_ns=BIG),
        edited(elapsed_ns=SMALL),
        *(edited(elapsed_ns=at(row, BIG)) for row in (0, 1, 11, 12, 18)),
        *(edited(elapsed_ns=at(row, 2**58)) for row in (0, 1, 11, 12, 18)),
        edited(frame=at(18, 2**31 - 1)),
        edited(frame=-1),
        edited(frame=0),
        *(edited(**{name: HUGE}) for name in (*TRUTH, *BOX)),
        edited(**dict.fromkeys((*TRUTH, *BOX), HUGE)),
        edited(**dict.fromkeys((*TRUTH, *BOX), -HUGE)),
        edited(**dict.fromkeys(BOX, 1e200)),
        edited(**dict.fromkeys(BOX, 5e-324)),
        edited(**dict.fromkeys((*TRUTH, *BOX), 0.0)),
        edited(w=-5.0, h=-5.0),
        edited(x=at(3, float("inf"))),
        edited(score=at(3, float("inf"))),
        edited(score=at(3, -3e38)),
        *(
            edited(sequence=renamed(name))
            for name in ["b\0", "b\n", "bb/../x", "b" * 100_000, "b\u202e", "b,", "b\x1b[2J"]
        ),
        edited(sequence=renamed("a\0")),
        edited(sequence=""),
        edited(sequence=None),
    ],
)
def test_hostile_values(tmp_path: Path, columns: dict[str, Any]) -> None:
    found = use(write_plain(tmp_path / "trace.parquet", columns))
    if found is not None:
        write_trace(Trace(*found), tmp_path / "copy.parquet")
        again = list(read_trace(tmp_path / "copy.parquet"))
        assert all(same(a, b) for a, b in zip(again, found[1]))


@pytest.mark.parametrize("kind", [pa.string(), pa.large_string()])
def test_names_that_are_not_utf8(tmp_path: Path, kind: pa.DataType) -> None:
    raw = pa.array(
        [b"\xff\xfe"] * len(ROWS["x"]), pa.binary() if kind == pa.string() else pa.large_binary()
    )
    names = pa.Array.from_buffers(kind, len(raw), raw.buffers())
    assert use(write_plain(tmp_path / "trace.parquet", {**ROWS, "sequence": names})) is None


@given(st.data())
@settings(max_examples=80)
def test_random_edits_of_rows(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    values = {
        "sequence": st.text(st.characters(codec="utf-8"), max_size=4) | st.none(),
        "frame": st.integers(-(2**31), 2**31 - 1),
        "elapsed_ns": st.integers(SMALL, BIG) | st.none(),
        "score": st.floats(width=32) | st.none(),
        **dict.fromkeys((*TRUTH, *BOX), st.floats() | st.none()),
    }
    columns = edited()
    for _ in range(data.draw(st.integers(1, 4))):
        name = data.draw(st.sampled_from(list(TYPES)))
        row = data.draw(st.integers(0, len(columns[name]) - 1))
        columns[name][row] = data.draw(values[name])
    use(write_plain(tmp_path_factory.getbasetemp() / "edited.parquet", columns))


def scored_at_arrival(run: Run) -> Run:
    return replace(run, schedule=replace(run.schedule, scores_latency=False))


@given(st.integers(0, 2**62), st.sampled_from(["1/999999999999", "999999999999", "29.97"]))
@settings(max_examples=40)
def test_any_time_at_any_rate_is_replayed_or_refused(elapsed: int, fps: str) -> None:
    boxes = np.ones((5, 4))
    recording = Recording.new("a", boxes, boxes, [elapsed] * 5)
    metadata = Metadata.new(fps, "every-frame")
    for policy in (latest, fifo, shrinking_tail(ns=elapsed), vot_realtime()):
        with suppress(LaeError):
            run = replay_sequence(recording, Clock.at(Fraction(fps)), policy=policy)
            evaluate_runs([scored_at_arrival(run)], metadata, {"k": Kalman}, SIGMA_GRID)
