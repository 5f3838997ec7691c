"""Trace files: round trips bit for bit, what other writers may do, and writing whole or not."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from witness import BOX, MINIMAL, TRUTH, TYPES, assert_same, columns_of, moving, same, write_plain

import lae_sim.trace.file
from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError, TraceError
from lae_sim.trace.file import Trace, read_held, read_trace, validate, write_trace
from lae_sim.trace.locate import digest
from lae_sim.trace.locate import opened as opened_there
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import STAGES, Recording, batched

EVERY = Metadata.new("30", "every-frame")


def sparse(length: int, seed: int = 0, name: str = "a") -> Recording:
    """A recording with missing truth, skipped frames and missing scores."""
    full = moving(length, seed, name)
    random = np.random.default_rng(seed + 1000)
    skipped = random.random(length) < 0.4
    skipped[0] = False
    truth, boxes = full.truth.copy(), full.boxes.copy()
    elapsed, score = full.elapsed_ns.copy(), full.score.copy()
    truth[random.random(length) < 0.3] = np.nan
    boxes[skipped], elapsed[skipped], score[skipped] = np.nan, -1, np.nan
    score[random.random(length) < 0.2] = np.nan
    return Recording(name, truth, boxes, elapsed, score)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "trace.parquet"


@pytest.fixture
def group() -> list[Recording]:
    """Sequences of several lengths, sorted by name; also names that need care."""
    names = sorted(["A b", "Z", "a", "a'b", "aa", "../x", "é", "\u202e", "\U0001f600", "x" * 3000])
    return [sparse(1 + 7 * i, i, name) for i, name in enumerate(names)]


def test_values_come_back_bit_for_bit(path: Path, group: list[Recording]) -> None:
    write_trace(Trace(EVERY, group), path)
    trace = read_trace(path)
    assert_same(trace, group)
    assert_same(trace, group)  # a trace can be read again
    assert trace.metadata == EVERY
    validate(path)


def test_extreme_values_come_back_bit_for_bit(path: Path) -> None:
    tiny, huge = 5e-324, 123456789.123456789
    boxes = [[-0.0, 0.0, tiny, 1.0], [huge, -huge, 2.0, 3.0], [0.1, 1 / 3, 2**29 + 2**-23, 1e9]]
    recording = Recording.new(
        "a", [[1, 1, 1, 1]] * 3, boxes, [0, 2**63 - 1, 1], [-70, -1e-45, 3e38]
    )
    write_trace(Trace(EVERY, [recording]), path)
    assert_same(read_trace(path), [recording])


@given(lengths=st.lists(st.integers(1, 40), min_size=1, max_size=6), batch=st.integers(1, 50))
@settings(max_examples=40)
def test_sequences_may_straddle_batches_and_row_groups(
    tmp_path_factory: pytest.TempPathFactory, lengths: list[int], batch: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "straddling.parquet"
    group = [sparse(length, i, f"s{i}") for i, length in enumerate(lengths)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lae_sim.trace.file, "BATCH_ROWS", batch)
        write_trace(Trace(EVERY, group), path)
        assert_same(read_trace(path), group)
        write_plain(path, columns_of(group), row_group_size=17)
        assert_same(read_trace(path), group)


def test_many_rows_make_several_row_groups(path: Path) -> None:
    group = [moving(30_000, i, f"s{i}") for i in range(5)]
    write_trace(Trace(EVERY, group), path)
    assert pq.ParquetFile(path).num_row_groups > 1
    assert_same(read_trace(path), group)


def test_reading_stops_where_the_reader_stops(path: Path, monkeypatch: Any) -> None:
    group = [moving(50, i, f"s{i}") for i in range(9)]
    columns = columns_of(group)
    columns["x"][-1] = None  # a fault in the last rows
    write_plain(path, columns)
    monkeypatch.setattr(lae_sim.trace.file, "BATCH_ROWS", 60)
    assert same(next(iter(read_trace(path))), group[0])
    with pytest.raises(TraceError):
        validate(path)


def test_some_sequences_can_be_chosen(path: Path, group: list[Recording]) -> None:
    write_trace(Trace(EVERY, group), path)
    chosen = read_trace(path, ["aa", "A b"])
    assert [r.name for r in chosen] == ["A b", "aa"]
    with pytest.raises(LaeError, match="no sequence 'Bird', 'Car2'"):
        list(read_trace(path, ["Car2", "aa", "Bird"]))


def test_what_is_written_is_as_the_format_says(path: Path, group: list[Recording]) -> None:
    write_trace(Trace(EVERY, group), path)
    schema = pq.read_schema(path)
    assert dict(zip(schema.names, schema.types)) == TYPES
    assert [f.name for f in schema if not f.nullable] == ["sequence", "frame"]
    assert b"lae_sim" in schema.metadata


def test_the_same_recordings_make_the_same_file(tmp_path: Path, group: list[Recording]) -> None:
    for name in ("one", "two"):
        write_trace(Trace(EVERY, group), tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


# ------------------------------------------------------------------------------ optional columns


def arriving(recording: Recording, seed: int = 0) -> Recording:
    steps = np.random.default_rng(seed).integers(2_000_000, 90_000_000, len(recording))
    return replace(recording, arrival_ns=np.cumsum(steps) - steps[0])


def flagged(recording: Recording, seed: int = 0) -> Recording:
    return replace(recording, visible=np.random.default_rng(seed).random(len(recording)) < 0.7)


def staged(recording: Recording, names: Sequence[str] = STAGES, seed: int = 0) -> Recording:
    """With times of stages of most of the processed frames, of at least one of them each."""
    random, stages = np.random.default_rng(seed), {}
    for name in names:
        ns = random.integers(0, np.maximum(recording.elapsed_ns, 0) // len(names) + 1)
        unknown = (recording.elapsed_ns < 0) | (random.random(len(recording)) < 0.3)
        unknown[0] = False
        stages[name] = np.where(unknown, -1, ns)
    return replace(recording, stages=stages)


def columns_in(path: Path) -> set[str]:
    return set(pq.read_schema(path).names) - TYPES.keys()


def version_in(path: Path) -> Any:
    return read_trace(path).metadata.document["version"]


@given(
    kinds=st.lists(
        st.tuples(
            st.integers(1, 30), st.booleans(), st.lists(st.sampled_from(STAGES), unique=True)
        ),
        min_size=1,
        max_size=5,
    ),
    arrives=st.booleans(),
    batch=st.integers(1, 40),
)
@settings(max_examples=40)
def test_optional_columns_come_back(
    tmp_path_factory: pytest.TempPathFactory,
    kinds: list[tuple[int, bool, list[str]]],
    arrives: bool,
    batch: int,
) -> None:
    path = tmp_path_factory.getbasetemp() / "optional.parquet"
    group = []
    for i, (length, says, stages) in enumerate(kinds):
        recording = staged(sparse(length, i, f"s{i}"), stages, i)
        recording = arriving(recording, i) if arrives else recording
        group.append(flagged(recording, i) if says else recording)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lae_sim.trace.file, "BATCH_ROWS", batch)
        write_trace(Trace(EVERY, group), path)
        assert_same(read_trace(path), group)
        held_back = read_trace(path, group[-1].name)
        assert_same(held_back, group[-1:])
    has = {"arrival_ns": arrives, "visible": any(says for _, says, _ in kinds)}
    expected = {name for name in has if has[name]}
    expected |= {f"stage_{stage}_ns" for _, _, stages in kinds for stage in stages}
    assert columns_in(path) == expected
    assert version_in(path) == ("1.1" if expected else "1.0")
    assert set(read_trace(path).columns) == expected
    assert set(read_trace(path).to_frame().columns) == TYPES.keys() | expected


def test_a_file_without_them_keeps_its_bytes(tmp_path: Path, group: list[Recording]) -> None:
    write_trace(Trace(EVERY, group), tmp_path / "one")
    write_trace(Trace(EVERY, iter(group), columns=frozenset()), tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert version_in(tmp_path / "one") == "1.0"


def test_a_frame_of_which_nothing_is_said_counts_as_visible(path: Path) -> None:
    columns = columns_of([moving(4, 0, "a"), moving(2, 0, "b")])
    columns["visible"] = [None, False, True, None, None, None]
    write_plain(path, columns, {**MINIMAL, "version": "1.1"})
    a, b = read_trace(path)
    assert a.visible is not None
    assert a.visible.tolist() == [True, False, True, True]
    assert b.visible is None


def test_the_columns_of_stages_are_in_their_order_and_encoded_as_suggested(path: Path) -> None:
    group = [staged(moving(9, 0, "a"), ["warp", "postprocess"]), staged(moving(9, 1, "b"))]
    write_trace(Trace(EVERY, group), path)
    file = pq.ParquetFile(path)
    columns = [f"stage_{name}_ns" for name in (*STAGES, "warp")]
    assert file.schema_arrow.names[-5:] == columns
    assert {file.schema_arrow.field(name).type for name in columns} == {pa.int64()}
    group_of_rows = file.metadata.row_group(0)
    for i in range(group_of_rows.num_columns):
        column = group_of_rows.column(i)
        if column.path_in_schema in columns:
            assert "DELTA_BINARY_PACKED" in column.encodings


def test_what_nobody_says_of_a_stage_is_unknown(path: Path) -> None:
    columns = columns_of([moving(3, 0, "a"), moving(2, 0, "b")])
    columns["stage_own_2_ns"] = [None, 0, 7, None, None]
    write_plain(path, columns, {**MINIMAL, "version": "1.1"})
    a, b = read_trace(path)
    assert {name: ns.tolist() for name, ns in a.stages.items()} == {"own_2": [-1, 0, 7]}
    assert b.stages == {}
    assert read_trace(path).to_frame()["stage_own_2_ns"].tolist()[:3] == [-1, 0, 7]


def test_readers_of_version_1_0_read_the_rest(path: Path) -> None:
    """A reader of version 1.0 takes the columns that it knows by name."""
    group = [staged(sparse(30, 1, "a")), sparse(3, 2, "b")]
    write_trace(Trace(EVERY, group), path)
    pq.write_table(pq.read_table(path, columns=list(TYPES)), path)
    assert_same(read_trace(path), [replace(recording, stages={}) for recording in group])


def test_a_stream_may_not_have_a_column_that_was_not_foreseen(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = [sparse(9, i, f"s{i}") for i in range(4)]
    group[2] = flagged(group[2])
    monkeypatch.setattr(lae_sim.trace.recording.batched, "__defaults__", (10, 0))
    with pytest.raises(TraceError, match=r"sequence 's2' has visible, which the first ones lack"):
        write_trace(Trace(EVERY, iter(group)), path)
    assert not path.exists()
    write_trace(Trace(EVERY, iter(group), columns=frozenset({"visible"})), path)
    assert_same(read_trace(path), group)
    write_trace(Trace(EVERY, group), path)  # all of a list is looked at
    assert_same(read_trace(path), group)


def test_a_recording_without_arrivals_among_others_is_refused(path: Path) -> None:
    group = [arriving(sparse(9, 0, "a")), sparse(9, 1, "b")]
    with pytest.raises(TraceError, match=r"'arrival_ns', sequence 'b', frame 0: null"):
        write_trace(Trace(EVERY, group), path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"visible": [True]}, "differ in length"),
        ({"visible": [1, 0]}, "True or False"),
        ({"arrival_ns": [0, 0.5]}, "whole nanoseconds"),
        ({"arrival_ns": [0]}, "differ in length"),
        ({"stages": {"decode": [0]}}, "differ in length: .*stage_decode_ns"),
        ({"stages": {"decode": [0, 0.5]}}, "stage_decode_ns: times are whole nanoseconds"),
        ({"stages": {"De code": [0, 5]}}, "'De code' is no name of a stage: small letters"),
        ({"stages": {"": [0, 5]}}, "'' is no name of a stage"),
    ],
)
def test_what_a_recording_is_made_of_is_checked(given: dict[str, Any], message: str) -> None:
    boxes = [[1, 2, 3, 4]] * 2
    with pytest.raises(LaeError, match=message):
        Recording.new("a", boxes, boxes, [1, 2], **given)


# ------------------------------------------------------------------------ files of other writers

DICTIONARY = pa.dictionary(pa.int8(), pa.string())


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"types": {"sequence": pa.large_string()}},
        {"types": {"sequence": DICTIONARY}},
        {"types": {"sequence": pa.dictionary(pa.int32(), pa.large_string())}},
        {"types": {"frame": pa.dictionary(pa.int32(), pa.int32())}},
        {"types": {"elapsed_ns": pa.dictionary(pa.int32(), pa.int64())}},
        {"compression": "none", "use_dictionary": False},
        {"compression": "gzip", "data_page_version": "2.0"},
        {"row_group_size": 1},
        {"data_page_size": 64, "write_batch_size": 7},
        {"write_statistics": False},
    ],
    ids=str,
)
def test_files_of_plain_pyarrow_are_read(path: Path, options: dict[str, Any]) -> None:
    group = [sparse(30, 1, "a"), sparse(3, 2, "b"), sparse(40, 3, "c")]
    columns = columns_of(group)
    types = {**TYPES, **options.get("types", {})}
    arrays = {}
    for name, values in columns.items():
        wanted = types[name]
        if pa.types.is_dictionary(wanted):
            array = pa.array(values, wanted.value_type).dictionary_encode().cast(wanted)
        else:
            array = pa.array(values, wanted)
        arrays[name] = array
    write_plain(path, arrays, **{k: v for k, v in options.items() if k != "types"})
    assert_same(read_trace(path), group)


def test_a_dictionary_may_say_a_name_twice(path: Path) -> None:
    columns = columns_of([moving(4)])
    names = pa.DictionaryArray.from_arrays(pa.array([0, 1, 0, 1], pa.int32()), pa.array(["a", "a"]))
    assert_same(read_trace(write_plain(path, {**columns, "sequence": names})), [moving(4)])


def test_files_of_pandas_are_read(path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    columns = columns_of([moving(20)])
    frame = pandas.DataFrame(columns).astype({"frame": "int32", "score": "float32"})
    table = pa.Table.from_pandas(frame)
    text = Metadata.new("30", "every-frame").dumps()
    metadata = {**table.schema.metadata, b"lae_sim": text}
    pq.write_table(table.replace_schema_metadata(metadata), path)
    assert_same(read_trace(path), [moving(20)])


def test_columns_may_come_in_any_order_and_extra_ones_are_ignored(path: Path) -> None:
    group = [sparse(30, 1, "a"), sparse(3, 2, "b")]
    columns = dict(reversed(columns_of(group).items()))
    rows = len(columns["x"])
    extra = {"x.y": [1] * rows, "note": ["n"] * rows, "nested": [{"x": 2.0, "frame": 7}] * rows}
    assert_same(read_trace(write_plain(path, {**extra, **columns})), group)


def test_scores_and_truth_are_optional(path: Path) -> None:
    full = moving(20)
    columns = columns_of([full])
    bare = {k: v for k, v in columns.items() if k not in (*TRUTH, "score")}
    (found,) = read_trace(write_plain(path, bare))
    assert np.isnan(found.truth).all()
    assert found.truth.shape == (20, 4)
    assert np.isnan(found.score).all()
    assert found.score.dtype == np.float32
    assert found.boxes.tobytes() == full.boxes.tobytes()


@pytest.mark.parametrize("column", [c for c in TYPES if c != "score"])
def test_a_missing_column_is_named(path: Path, column: str) -> None:
    columns = columns_of([moving(5)])
    del columns[column]
    with pytest.raises(TraceError, match=f"trace.parquet: column '{column}' is missing"):
        read_trace(write_plain(path, columns))


@pytest.mark.parametrize(
    ("column", "wrong"),
    [
        *((name, pa.float32()) for name in TRUTH + BOX),
        ("frame", pa.int64()),
        ("frame", pa.uint32()),
        ("frame", pa.float64()),
        ("elapsed_ns", pa.int32()),
        ("elapsed_ns", pa.uint64()),
        ("elapsed_ns", pa.duration("ns")),
        ("score", pa.float64()),
        ("score", pa.string()),
        ("sequence", pa.binary()),
    ],
)
def test_a_column_of_another_type_is_named(path: Path, column: str, wrong: pa.DataType) -> None:
    columns = columns_of([moving(5)])
    array = pa.array(columns[column], TYPES[column])
    if column == "score" and wrong == pa.string():
        columns[column] = pa.array(["high"] * 5)
    else:
        columns[column] = array.cast(wrong, safe=False)
    with pytest.raises(TraceError, match=f"trace.parquet: column '{column}' is .*, must be"):
        read_trace(write_plain(path, columns))


def test_a_column_that_is_there_twice_is_refused(path: Path) -> None:
    columns = columns_of([moving(5)])
    arrays = [pa.array(values, TYPES[name]) for name, values in columns.items()]
    table = pa.Table.from_arrays([*arrays, arrays[3]], names=[*columns, "x"])
    pq.write_table(table.replace_schema_metadata({"lae_sim": EVERY.dumps()}), path)
    with pytest.raises(TraceError, match="column 'x' is there 2 times"):
        read_trace(path)


@pytest.mark.parametrize("kind", [pa.float64(), pa.float32()])
def test_times_as_fractions_are_guessed_to_be_seconds(path: Path, kind: pa.DataType) -> None:
    columns = columns_of([moving(5)])
    columns["elapsed_ns"] = [0.047] * 5
    with pytest.raises(TraceError, match=r"column 'elapsed_ns' is .*seconds or milliseconds"):
        read_trace(write_plain(path, columns, types={"elapsed_ns": kind}))


def test_unknown_metadata_keys_are_kept(path: Path) -> None:
    more = {"mine": {"deep": [1, 2.5, None, "é\u2028", True]}, "big": 2**70, "": 0}
    metadata = Metadata.parse(write_and_dump(path, {**MINIMAL, **more}))
    assert {k: metadata.document[k] for k in more} == more
    write_trace(Trace(metadata, [moving(3)]), path)
    assert read_trace(path).metadata == metadata


def write_and_dump(path: Path, document: dict[str, Any]) -> bytes:
    return read_trace(write_plain(path, columns_of([moving(3)]), document)).metadata.dumps()


# ------------------------------------------------------------------------------- damaged files


def test_a_file_that_is_not_there(path: Path) -> None:
    with pytest.raises(TraceError, match=r"trace.parquet: no such file"):
        read_trace(path)


@pytest.mark.parametrize(
    "content",
    [b"", b"PAR1", b"PAR1PAR1", b"not a parquet file at all", b"\0" * 1000, b"x,y,w,h\n1,2,3,4\n"],
)
def test_a_file_that_is_not_parquet(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(TraceError, match=r"trace.parquet: not a readable Parquet file"):
        read_trace(path)


def test_a_folder_is_not_a_trace(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match="a folder, not a file"):
        read_trace(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes")
def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    """Opening it would wait for a writer for ever."""
    os.mkfifo(tmp_path / "pipe.parquet")
    os.symlink("pipe.parquet", tmp_path / "link.parquet")
    for name in ("pipe.parquet", "link.parquet"):
        with pytest.raises(TraceError, match=f"{name}: a pipe, not a file"):
            read_trace(tmp_path / name)
        with pytest.raises(LaeError, match="a pipe, not a file"):
            digest(str(tmp_path / name))
    with pytest.raises(TraceError, match="a device, not a file"):
        validate(os.devnull)


def test_a_truncated_file(path: Path) -> None:
    write_trace(Trace(EVERY, [moving(500)]), path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(TraceError, match="not a readable Parquet file"):
        read_trace(path)


def test_a_parquet_file_without_our_metadata(path: Path) -> None:
    with pytest.raises(TraceError, match="metadata key 'lae_sim' is missing: is this a lae_sim"):
        read_trace(write_plain(path, columns_of([moving(3)]), metadata=None))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (b"{", "not valid JSON"),
        (b"\xff", "not valid JSON"),
        (b"[]", "must be a JSON object"),
        (b"{}", "key 'format'"),
    ],
)
def test_faulty_metadata_names_the_file(path: Path, text: bytes, problem: str) -> None:
    with pytest.raises(TraceError, match=f"trace.parquet: metadata .*{problem}"):
        read_trace(write_plain(path, columns_of([moving(3)]), text))


def test_a_newer_major_version_is_refused_and_a_newer_minor_one_is_read(path: Path) -> None:
    columns = columns_of([moving(3)])
    with pytest.raises(TraceError, match=r"trace.parquet: .*version 2.0.*reads version 1"):
        read_trace(write_plain(path, columns, {**MINIMAL, "version": "2.0"}))
    assert_same(read_trace(write_plain(path, columns, {**MINIMAL, "version": "1.7"})), [moving(3)])


def test_a_trace_without_rows(path: Path) -> None:
    columns: dict[str, list[Any]] = {name: [] for name in TYPES}
    with pytest.raises(TraceError, match=r"trace.parquet: the trace is empty"):
        validate(write_plain(path, columns))


# ---------------------------------------------------------------------- written whole or not at all


def interrupted(error: BaseException) -> Iterator[Recording]:
    yield moving(70_000, name="a")
    raise error


@pytest.mark.parametrize(
    "error", [RuntimeError("no GPU"), KeyboardInterrupt("Ctrl-C"), OSError("no USB")]
)
@pytest.mark.parametrize("existed", [True, False])
def test_an_interrupted_write_leaves_what_was_there(
    tmp_path: Path, path: Path, error: BaseException, existed: bool
) -> None:
    if existed:
        path.write_text("old")
    with pytest.raises((type(error), LaeError), match=str(error)):
        write_trace(Trace(EVERY, interrupted(error)), path)
    assert [p.name for p in tmp_path.iterdir()] == (["trace.parquet"] if existed else [])
    assert not existed or path.read_text() == "old"


def test_a_faulty_recording_is_not_written(tmp_path: Path, path: Path) -> None:
    path.write_text("old")
    for faulty in (
        [moving(3, name="b"), moving(3, name="a")],
        [moving(3), moving(3)],
        [moving(3, name="")],
        [Recording.new("a", np.ones((2, 4)), [[1, 2, 3, np.inf]] * 2, [0, 0])],
        [Recording.new("a", np.ones((2, 4)), [[1, 2, 3, np.nan]] * 2, [0, 0])],
        [Recording.new("a", np.ones((2, 4)), np.ones((2, 4)), [0, -7])],
        [Recording.new("a", np.ones((2, 4)), np.ones((2, 4)), [-1, 7])],
        [Recording.new("a", np.ones((2, 4)), [[1, 2, 3, 4], [np.nan] * 4], [0, -7])],
        [Recording.new("a", np.ones((2, 4)), np.ones((2, 4)), [47, 46])],
    ):
        with pytest.raises(TraceError, match=r"trace.parquet: column"):
            write_trace(Trace(EVERY, faulty), path)
        assert path.read_text() == "old"
        assert len(list(tmp_path.iterdir())) == 1


def test_a_name_that_is_not_unicode_is_refused(path: Path) -> None:
    with pytest.raises(LaeError):
        write_trace(Trace(EVERY, [moving(3, name="a\ud800")]), path)
    assert not path.exists()


@pytest.mark.parametrize("group", [[], [Recording.new("a", [], [], [])]], ids=["none", "no frames"])
def test_a_trace_that_could_not_be_read_is_not_written(path: Path, group: list[Recording]) -> None:
    with pytest.raises(TraceError):
        write_trace(Trace(EVERY, group), path)
    assert not path.exists()


def test_a_folder_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"cannot write .*trace.parquet: No such file"):
        write_trace(Trace(EVERY, [moving(3)]), tmp_path / "no" / "trace.parquet")


def test_writing_streams_its_recordings(path: Path) -> None:
    alive: list[int] = []

    def endless() -> Iterator[Recording]:
        for i in range(6):
            alive.append(i)
            yield moving(30_000, i, f"s{i}")

    write_trace(Trace(EVERY, endless()), path)
    assert alive == list(range(6))
    assert len(list(read_trace(path))) == 6


@given(st.lists(st.integers(1, 9), max_size=20), st.integers(1, 20))
@settings(max_examples=40)
def test_batched_keeps_the_order_and_closes_a_group_once_it_is_full(
    lengths: list[int], rows: int
) -> None:
    items = [range(length) for length in lengths]
    groups = list(batched(items, rows))
    assert [item for group in groups for item in group] == items
    for group in groups[:-1]:
        assert sum(map(len, group)) >= rows > sum(map(len, group[:-1]))
    assert all(groups)


def test_a_sequence_that_would_take_too_much_memory(path: Path) -> None:
    write_trace(Trace(EVERY, [sparse(9000, 1, "a"), sparse(9000, 2, "b")]), path)
    with max_decoded("1MiB"):  # it counts one sequence at a time
        assert len(list(read_trace(path))) == 2
    with max_decoded("900KiB"), pytest.raises(TraceError, match=r"trace\.parquet: would take more"):
        list(read_trace(path))


def test_a_column_that_would_take_too_much_memory(path: Path) -> None:
    columns = columns_of([moving(40, 1, "a")])
    columns["sequence"] = ["a" * 3_000_000] * 40
    write_plain(path, columns)
    for read in (list, lambda trace: trace.names):
        with max_decoded("1MiB"), pytest.raises(TraceError, match=r"trace\.parquet: would take"):
            read(read_trace(path))


def test_metadata_that_would_take_too_much_memory(path: Path) -> None:
    many = {f"s{k}": {"attributes": ["x"]} for k in range(9000)}
    write_trace(Trace(Metadata.new("30", "every-frame", sequences=many), [sparse(9)]), path)
    with max_decoded("1MiB"), pytest.raises(TraceError, match=r"trace\.parquet: would take more"):
        read_trace(path)
    assert len(read_trace(path)) == 1


def test_a_trace_that_is_held_is_what_is_read_and_opened_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = "traces/synthetic-slow.parquet"
    opened: list[str] = []

    def counting(name: str) -> Any:
        opened.append(name)
        return opened_there(name)

    monkeypatch.setattr(lae_sim.trace.file, "opened", counting)
    held = read_held(path)
    assert opened == [path]
    assert isinstance(held.recordings, list)
    both = zip(held, read_trace(path), strict=True)
    assert all(np.array_equal(a.boxes, b.boxes, equal_nan=True) for a, b in both)
    some = read_held(path, ["boat-calm"])
    assert [recording.name for recording in some] == ["boat-calm"]
    large = read_held(path, frames=2_399)
    assert not isinstance(large.recordings, list)
    assert large.names == held.names
