"""The rows of a trace as flat columns: between Parquet and recordings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.trace.recording import OPTIONAL_COLUMNS, Recording, is_optional, stage_of

TRUTH = ("truth_x", "truth_y", "truth_w", "truth_h")
BOX = ("x", "y", "w", "h")


@dataclass(frozen=True)
class Nullable:
    """The values of a column that a trace may lack, [n], and where they are null, bool [n]."""

    values: npt.NDArray[Any]
    null: Bools

    @classmethod
    def of_recordings(cls, name: str, recordings: Sequence[Recording]) -> Nullable:
        """That of an optional column; null in those recordings that lack it."""
        found = [recording.columns.get(name) for recording in recordings]
        lengths = [len(recording) for recording in recordings]
        filled = [
            # -1 is a time that is unknown, and True as a flag
            np.full(length, -1, OPTIONAL_COLUMNS.get(name, np.int64)) if values is None else values
            for values, length in zip(found, lengths)
        ]
        values, null = np.concatenate(filled), np.repeat([v is None for v in found], lengths)
        return cls(values, null if stage_of(name) is None else null | (values == -1))

    def of_run(self, run: slice) -> Nullable | None:
        """That of a sequence's rows; None if nothing is said in any of them."""
        null = self.null[run]
        return None if null.all() else Nullable(self.values[run], null)


@dataclass(frozen=True)
class Rows:
    """Consecutive rows of a trace, n of them, of which each run of equal names is a sequence.

    Attributes:
        names: the name of each run.
        starts: first row of each run, and n: int64 [runs + 1].
        frame: int64 [n].
        truth, boxes: float64 [n, 4], NaN where null.
        truth_null, box_null: bool [n, 4].
        elapsed_ns: int64 [n], -1 where null.
        elapsed_null: bool [n].
        score: float32 [n], NaN where null.
        score_null: bool [n].
        optional: the optional columns that are there, by name.
    """

    names: list[str]
    starts: Ints
    frame: Ints
    truth: Floats
    truth_null: Bools
    boxes: Floats
    box_null: Bools
    elapsed_ns: Ints
    elapsed_null: Bools
    score: npt.NDArray[np.float32]
    score_null: Bools
    optional: Mapping[str, Nullable] = field(default_factory=dict)

    @classmethod
    def of_recordings(cls, recordings: Sequence[Recording], columns: Iterable[str] = ()) -> Rows:
        """The rows of whole recordings, with optional columns that they have or that are named."""
        names = {*columns, *(name for recording in recordings for name in recording.columns)}
        lengths = [len(recording) for recording in recordings]
        truth = np.concatenate([recording.truth for recording in recordings])
        boxes = np.concatenate([recording.boxes for recording in recordings])
        elapsed = np.concatenate([recording.elapsed_ns for recording in recordings])
        score = np.concatenate([recording.score for recording in recordings])
        return cls(
            names=[recording.name for recording in recordings],
            starts=np.cumsum([0, *lengths]),
            frame=np.concatenate([np.arange(length) for length in lengths]),
            truth=truth,
            truth_null=np.isnan(truth),
            boxes=boxes,
            box_null=np.isnan(boxes),
            elapsed_ns=elapsed,
            elapsed_null=elapsed == -1,
            score=score,
            score_null=np.isnan(score),
            optional={name: Nullable.of_recordings(name, recordings) for name in names},
        )

    @classmethod
    def of_batch(cls, batch: Any) -> Rows:
        """The rows of an Arrow record batch whose names are dictionary-encoded."""
        column = dict(zip(batch.schema.names, batch.columns))
        indices = column["sequence"].indices
        dictionary = [*column["sequence"].dictionary.to_pylist(), ""]
        column["sequence"].validate(full=True)
        codes = np.where(is_null(indices), len(dictionary) - 1, to_numpy(indices, np.int32))
        edges = np.flatnonzero(np.diff(codes)) + 1
        starts = np.concatenate([[0], edges, [len(codes)]])
        truth, truth_null = _boxes(column, TRUTH, len(codes))
        boxes, box_null = _boxes(column, BOX, len(codes))
        elapsed_null = is_null(column["elapsed_ns"])
        score, score_null = np.full(len(codes), np.nan, np.float32), np.ones(len(codes), np.bool_)
        if "score" in column:
            score_null = is_null(column["score"])
            score[~score_null] = to_numpy(column["score"], np.float32)[~score_null]
        return cls(
            names=[dictionary[code] for code in codes[starts[:-1]]],
            starts=starts,
            frame=to_numpy(column["frame"], np.int32).astype(np.int64),
            truth=truth,
            truth_null=truth_null,
            boxes=boxes,
            box_null=box_null,
            elapsed_ns=np.where(elapsed_null, -1, to_numpy(column["elapsed_ns"], np.int64)),
            elapsed_null=elapsed_null,
            score=score,
            score_null=score_null,
            optional={
                name: Nullable(
                    to_numpy(column[name], OPTIONAL_COLUMNS.get(name, np.int64)),
                    is_null(column[name]),
                )
                for name in column
                if is_optional(name)
            },
        )

    def to_batch(self, schema: Any) -> Any:
        """The rows as an Arrow record batch of the schema, which may have optional columns."""
        import pyarrow as pa

        codes = np.repeat(np.arange(len(self.names), dtype=np.int32), np.diff(self.starts))
        names = pa.DictionaryArray.from_arrays(from_numpy(codes), from_texts(self.names))
        columns = [
            names.cast(pa.string()),
            from_numpy(self.frame.astype(np.int32)),
            *(from_numpy(self.truth[:, i], ~self.truth_null[:, i]) for i in range(4)),
            *(from_numpy(self.boxes[:, i], ~self.box_null[:, i]) for i in range(4)),
            from_numpy(self.elapsed_ns, ~self.elapsed_null),
            from_numpy(self.score, ~self.score_null),
        ]
        for name in schema.names[len(columns) :]:
            column = self.optional[name]
            columns.append(from_numpy(column.values, ~column.null))
        return pa.RecordBatch.from_arrays(columns, schema=schema)

    def recordings(self) -> Iterator[Recording]:
        """Each run of rows as a recording."""
        for name, start, end in zip(self.names, self.starts[:-1], self.starts[1:]):
            run = slice(start, end)
            said = {column: values.of_run(run) for column, values in self.optional.items()}
            arrived, visible = said.pop("arrival_ns", None), said.pop("visible", None)
            yield Recording(
                name,
                self.truth[run],
                self.boxes[run],
                self.elapsed_ns[run],
                self.score[run],
                None if arrived is None else arrived.values,
                # a frame of which nothing is said counts as one where the target is visible
                None if visible is None else visible.values | visible.null,
                {
                    str(stage_of(column)): np.where(each.null, -1, each.values)
                    for column, each in said.items()
                    if each is not None
                },
            )


def _boxes(column: dict[str, Any], names: tuple[str, ...], n: int) -> tuple[Floats, Bools]:
    """Four columns as boxes and where they are null; columns that are absent are all null."""
    boxes = np.full((n, 4), np.nan)
    null = np.ones((n, 4), np.bool_)
    for i, name in enumerate(names):
        if name in column:
            values = to_numpy(column[name], np.float64)
            null[:, i] = is_null(column[name])
            boxes[:, i] = np.where(null[:, i], np.nan, values) if null[:, i].any() else values
    return boxes, null


def checksums(option: str) -> dict[str, bool]:
    """The option that writes or checks page checksums, where pyarrow has it (15 and newer)."""
    import pyarrow as pa

    return {option: True} if int(pa.__version__.split(".")[0]) >= 15 else {}


def from_numpy(values: npt.NDArray[Any], valid: npt.NDArray[np.bool_] | None = None) -> Any:
    """An Arrow array of one-dimensional numbers; null where ``valid`` is false."""
    import pyarrow as pa

    data = np.ascontiguousarray(values)
    if data.dtype == np.bool_:
        data = np.packbits(data, bitorder="little")
    bitmap = None
    if valid is not None and not valid.all():
        bitmap = pa.py_buffer(np.packbits(valid, bitorder="little").tobytes())
    arrow_type = pa.from_numpy_dtype(values.dtype)
    return pa.Array.from_buffers(arrow_type, len(values), [bitmap, pa.py_buffer(data)])


def from_texts(texts: Sequence[str], times: int = 1) -> Any:
    """An Arrow array of texts, each so many times in a row."""
    import pyarrow as pa

    encoded = [text.encode() for text in texts]
    sizes = np.repeat(np.array([len(text) for text in encoded], np.int32), times)
    ends = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    joined = b"".join(text * times for text in encoded)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(joined)]
    return pa.Array.from_buffers(pa.string(), len(sizes), buffers)


def from_values(values: Sequence[Any], kind: Any) -> Any:
    """An Arrow array of plain values of one type; null where one is None.

    Args:
        values: of that type each, or None.
        kind: Arrow's string, bool, int64, float64 or null.
    """
    import pyarrow as pa

    valid = np.array([value is not None for value in values], np.bool_)
    if kind == pa.null():
        return pa.nulls(len(values))
    if kind == pa.string():
        texts = from_texts(["" if value is None else value for value in values])
        bitmap = pa.py_buffer(np.packbits(valid, bitorder="little").tobytes())
        buffers = [None if valid.all() else bitmap, *texts.buffers()[1:]]
        return pa.Array.from_buffers(kind, len(values), buffers)
    dtype = {pa.bool_(): np.bool_, pa.int64(): np.int64, pa.float64(): np.float64}[kind]
    return from_numpy(np.array([0 if value is None else value for value in values], dtype), valid)


def to_numpy(array: Any, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """The values of a primitive Arrow array; what stands where it is null is arbitrary."""
    data = array.buffers()[1]
    if data is None:
        return np.zeros(len(array), dtype)
    if dtype is np.bool_:
        return _bits(data, array)
    return np.frombuffer(data, dtype, len(array), array.offset * np.dtype(dtype).itemsize)


def _bits(buffer: Any, array: Any) -> npt.NDArray[np.bool_]:
    """The bits of an Arrow array's buffer, bool [n]."""
    end = array.offset + len(array)
    bits = np.unpackbits(np.frombuffer(buffer, np.uint8), count=end, bitorder="little")
    return bits[array.offset :].astype(np.bool_)


def is_null(array: Any) -> npt.NDArray[np.bool_]:
    """Where an Arrow array is null, bool [n]."""
    bitmap = array.buffers()[0]
    if bitmap is None or not array.null_count:
        return np.zeros(len(array), np.bool_)
    return ~_bits(bitmap, array)
