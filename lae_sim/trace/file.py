"""Traces: a tracker's boxes and processing times on every world frame, in Parquet.

The format is specified in ``traces/FORMAT.md``. Reading streams, so that memory does not grow with
the file, and a trace is written whole or not at all. Nothing in a trace is ever executed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.decoding import Budget, json_memory
from lae_sim.errors import LaeError, TraceError, hint, listed, shown
from lae_sim.files import sequence_names, written_whole
from lae_sim.trace.checks import COLUMN_TYPES, RowChecker, check_schema
from lae_sim.trace.columns import Nullable, Rows, checksums
from lae_sim.trace.locate import is_url, opened
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import (
    BATCH_ROWS,
    Recording,
    batched,
    in_order,
    is_optional,
    stage_column,
    stage_of,
)

if TYPE_CHECKING:
    from pandas import DataFrame

HELD_FRAMES = 1 << 18
_FLOATS, _INTEGERS = ("double", "float32"), ("int32", "int64")
_ROW_BYTES = 8 + 3 * 8 * 4 + 4  # truth, box and what is put together of them, time and score


@dataclass(frozen=True, eq=False, repr=False)
class Trace:
    """A trace: its metadata, and its recordings sorted by name.

    Iterate over it to get the recordings; a trace that was read from a file is read again, batch by
    batch, on every iteration. ``trace["Gull2"]`` is one of them; ``len(trace)`` and ``trace.names``
    read the names alone.

    Attributes:
        metadata: what the trace says of itself.
        recordings: one per sequence.
        frames: world frames of all its sequences together, where known.
        columns: the optional columns that its recordings may have: ``arrival_ns``, ``visible`` and
            those of stages. Only of a stream need they be given, to be written with those that its
            first recording lacks.

    Example:
        >>> import lae_sim
        >>> trace = lae_sim.read_trace("traces/synthetic-slow.parquet")
        >>> trace
        <Trace of 'slow-and-accurate' on 'synthetic': 8 sequences, 2,400 frames at 30 fps>
        >>> trace.names[:2], len(trace), len(trace["boat-calm"])
        (('bike-pan', 'boat-calm'), 8, 300)
    """

    metadata: Metadata
    recordings: Iterable[Recording]
    frames: int | None = None
    columns: frozenset[str] = frozenset()

    def __iter__(self) -> Iterator[Recording]:
        return iter(self.recordings)

    def __bool__(self) -> bool:
        return True  # a trace that is there; its length may have to be read

    def to_frame(self) -> DataFrame:
        """A row per world frame of every sequence, with the columns of the trace format."""
        import pandas as pd

        return pd.concat([recording.to_frame() for recording in self], ignore_index=True)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of the sequences, sorted."""
        if isinstance(self.recordings, _StoredRecordings):
            return tuple(self.recordings.lengths())
        return tuple(recording.name for recording in self.recordings)

    @property
    def has_arrivals(self) -> bool:
        """Whether it says when each frame arrived."""
        known = self.recordings if isinstance(self.recordings, Sequence) else ()
        return "arrival_ns" in self.columns or any(r.arrival_ns is not None for r in known)

    def chosen(self, sequences: str | Iterable[str]) -> Trace:
        """The trace with some of its sequences only; of a file their names alone are read.

        Raises:
            LaeError: if none is named, or one is not there.
        """
        keep = frozenset(sequence_names(sequences))
        if isinstance(self.recordings, _StoredRecordings):
            if keep == self.recordings.keep:
                return self
            stored = self.recordings.only(keep)
            return replace(self, recordings=stored, frames=sum(stored.lengths().values()))
        kept = [recording for recording in self.recordings if recording.name in keep]
        if missing := keep.difference(recording.name for recording in kept):
            raise LaeError(f"the trace has no sequence {_listed(missing, self.names)}")
        return replace(self, recordings=kept, frames=sum(map(len, kept)))

    def __len__(self) -> int:
        """Number of sequences."""
        return len(self.names)

    def __getitem__(self, name: str) -> Recording:
        return next(iter(self.chosen([name])))

    def __repr__(self) -> str:
        about = f"{len(self):,} sequence{'s' * (len(self) != 1)}"
        if self.frames is not None:
            about += f", {self.frames:,} frames"
        tracker, dataset = self.metadata.tracker, self.metadata.dataset
        return f"<Trace of {tracker!r} on {dataset!r}: {about} at {self.metadata.fps} fps>"


def read_trace(path: str | os.PathLike[str], sequences: str | Iterable[str] | None = None) -> Trace:
    """Open a trace; the recordings are read and checked while one iterates over them.

    Args:
        path: the Parquet file, or the URL of one (``s3://…``; see :mod:`lae_sim.trace.locate`).
        sequences: names to keep; all by default.

    Raises:
        TraceError: here or during iteration, if the file is not a valid trace; it names the file,
            column, sequence and frame, and the likely cause.
        LaeError: if a sequence that is named is not there.

    Example:
        >>> import lae_sim
        >>> trace = lae_sim.read_trace("traces/synthetic-slow.parquet", sequences="boat-calm")
        >>> [(recording.name, len(recording)) for recording in trace]
        [('boat-calm', 300)]
    """
    if not isinstance(path, (str, os.PathLike)):
        raise LaeError(f"path: a trace is read from a path or a URL, not {shown(path)}")
    return _StoredRecordings(os.fspath(path)).trace(sequences)


def read_held(
    path: str | os.PathLike[str],
    sequences: Iterable[str] | None = None,
    frames: int = HELD_FRAMES,
) -> Trace:
    """The same, with the recordings in memory if these have at most so many world frames.

    Raises:
        TraceError: if it is not a valid trace.
        LaeError: as :func:`read_trace`.
    """
    stored = _StoredRecordings(os.fspath(path))
    with stored.opened() as file:  # once for all that is read of it
        trace = replace(stored, file=file).trace(sequences)
        if trace.frames is not None and trace.frames <= frames:
            # (a list of the trace itself would ask for its length first)
            return replace(trace, recordings=list(trace.recordings))
    return stored.trace(sequences)


def validate(path: str | os.PathLike[str]) -> None:
    """Read a whole trace and check it.

    Args:
        path: the file, or its URL.

    Raises:
        TraceError: at the first fault.

    Example:
        >>> import lae_sim
        >>> lae_sim.validate("traces/synthetic-slow.parquet")
        >>> lae_sim.validate("traces/cases/invalid/time-negative.parquet")
        Traceback (most recent call last):
        ...
        lae_sim.errors.TraceError: ... column 'elapsed_ns', sequence 'a', frame 3: negative time ...
    """
    for _ in read_trace(path):
        pass


def write_trace(trace: Trace, path: str | os.PathLike[str]) -> None:
    """Write a trace, whole or not at all; recordings stream through.

    Args:
        trace: what to write; its recordings are sorted by name.
        path: the file, in a folder that is there.

    Raises:
        TraceError: if the recordings are not sorted by name or break the format, or one that was
            not foreseen has a column which those before it lack (see :attr:`Trace.columns`).
        LaeError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> import lae_sim
        >>> slow = lae_sim.read_trace("traces/synthetic-slow.parquet")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     lae_sim.write_trace(slow.chosen("boat-calm"), f"{folder}/one.parquet")
        ...     lae_sim.read_trace(f"{folder}/one.parquet")
        <Trace of 'slow-and-accurate' on 'synthetic': 1 sequence, 300 frames at 30 fps>
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not isinstance(trace, Trace) or not isinstance(path, (str, os.PathLike)):
        raise LaeError(f"write_trace takes a trace and a path, not {shown(trace)}, {shown(path)}")
    groups = batched(trace)
    first = next(groups, [])
    columns = _columns(trace, first)
    stages = [stage_column(name) for name in in_order(filter(None, map(stage_of, columns)))]
    types = {**COLUMN_TYPES, "score": "float32", **dict.fromkeys(stages, "int64")}
    kept = [name for name in types if not is_optional(name) or name in columns]
    metadata = trace.metadata.with_columns() if columns else trace.metadata
    never_null = ("sequence", "frame", "arrival_ns")
    schema = pa.schema(
        [pa.field(name, types[name], nullable=name not in never_null) for name in kept],
        {"lae_sim": metadata.dumps()},
    )
    check = RowChecker(str(path), metadata.profiled, restarts=metadata.kind == "restarts")
    with (
        written_whole(path) as temporary,
        pa.OSFile(os.fsencode(temporary), "wb") as sink,  # whose name need not be UTF-8
        pq.ParquetWriter(
            sink,
            schema,
            compression="zstd",
            compression_level=1,
            use_dictionary=["sequence"],
            column_encoding={
                name: "BYTE_STREAM_SPLIT" if types[name] in _FLOATS else "DELTA_BINARY_PACKED"
                for name in kept
                if types[name] in (*_FLOATS, *_INTEGERS)
            },
            **checksums("write_page_checksum"),
        ) as writer,
    ):
        for group in chain([first], groups) if first else ():
            for recording in group:
                if not len(recording):
                    raise TraceError(f"{path}: sequence {recording.name!r} has no frames")
                if more := recording.columns.keys() - columns:
                    raise TraceError(
                        f"{path}: sequence {recording.name!r} has {', '.join(sorted(more))}, which "
                        "the first ones lack: name such columns when the trace is made "
                        "(Trace(columns=...)), or give it a list of recordings"
                    )
            rows = Rows.of_recordings(group, columns)
            check(rows)
            writer.write_batch(rows.to_batch(schema))
        if not first:
            raise TraceError(f"{path}: the trace is empty")


def _columns(trace: Trace, first: Sequence[Recording]) -> frozenset[str]:
    """The optional columns of a trace that is to be written, as far as its start can tell."""
    known = isinstance(trace.recordings, Sequence)
    some: Iterable[Recording] = trace if known else first
    columns = frozenset(name for recording in some for name in recording.columns)
    return columns if known else columns | trace.columns


def trace_at(path: str | os.PathLike[str]) -> Metadata | None:
    """What a trace says of itself; None if there is no file, or one that is no trace."""
    try:
        return read_trace(path).metadata if os.path.isfile(path) else None
    except LaeError:
        return None


def check_replaces(path: str | os.PathLike[str], tracker: str, dataset: str) -> None:
    """Check that a trace would replace nothing but one of the same tracker and dataset.

    Raises:
        LaeError: if another one, or a file that is no trace, is there.
    """
    if not os.path.isfile(path) or not os.path.getsize(path):
        return
    found = trace_at(path)
    if found is None:
        raise LaeError(f"{path} is there already and is no trace; --force replaces it")
    if (found.tracker, found.dataset) != (tracker, dataset):
        raise LaeError(
            f"{path} is there already, a trace of {shown(found.tracker)} on "
            f"{shown(found.dataset)}; --force replaces it"
        )


@dataclass(frozen=True)
class _StoredRecordings:
    """The recordings of a file, read anew on each iteration.

    Attributes:
        path: of the file.
        keep: names of the sequences; None for all.
        profiled, restarts: see :class:`RowChecker`.
        file: itself, while somebody has it open; otherwise it is opened each time.
    """

    path: str
    keep: frozenset[str] | None = None
    profiled: bool = False
    restarts: bool = False
    file: Any = None

    def trace(self, sequences: str | Iterable[str] | None) -> Trace:
        """The trace of the file, with some of its sequences or all."""
        metadata, rows, columns = self.describe()
        stored = replace(self, profiled=metadata.profiled, restarts=metadata.kind == "restarts")
        trace = Trace(metadata, stored, rows, columns)
        return trace if sequences is None else trace.chosen(sequences)

    def describe(self) -> tuple[Metadata, int, frozenset[str]]:
        """The file's metadata, its number of rows, and the optional columns that it has."""
        with self.opened() as file:
            check_schema(file.schema_arrow, self.path)
            stored = (file.schema_arrow.metadata or {}).get(b"lae_sim")
            if stored is None:
                raise TraceError(
                    f"{self.path}: metadata key 'lae_sim' is missing: is this a lae_sim trace? "
                    "See 'lae-sim convert --help' to make one"
                )
            Budget(self.path, TraceError).take(json_memory(stored))
            try:
                columns = frozenset(filter(is_optional, file.schema_arrow.names))
                return Metadata.parse(stored), file.metadata.num_rows, columns
            except TraceError as error:
                raise TraceError(f"{self.path}: {error}") from error

    def lengths(self) -> dict[str, int]:
        """World frames of each sequence that is kept, by name, sorted; no other column is read.

        Raises:
            LaeError: if one that is to be kept is not there.
        """
        found: dict[str, int] = {}
        with self.opened() as file:
            self._check_sizes(file.metadata.row_group(g) for g in range(file.num_row_groups))
            for batch in file.iter_batches(2 * BATCH_ROWS, columns=["sequence"], use_threads=False):
                for each in batch.column(0).value_counts().to_pylist():
                    found[each["values"]] = found.get(each["values"], 0) + each["counts"]
        found.pop(None, None)  # type: ignore[call-overload]  # a fault that reading will find
        if self.keep is not None:
            if missing := self.keep - found.keys():
                raise LaeError(f"{self.path}: no sequence {_listed(missing, found)}")
            found = {name: found[name] for name in self.keep}
        return dict(sorted(found.items()))

    def only(self, names: frozenset[str]) -> _StoredRecordings:
        """Some of the sequences.

        Raises:
            LaeError: if one is not among those that are kept.
        """
        if self.keep is not None and not names <= self.keep:
            missing = _listed(names - self.keep, self.keep)
            raise LaeError(f"{self.path}: of those chosen, no sequence {missing}")
        return replace(self, keep=names)

    def __iter__(self) -> Iterator[Recording]:
        missing = set(self.keep or ())
        for recording in self._all():
            if self.keep is None or recording.name in self.keep:
                missing.discard(recording.name)
                yield recording
        if missing:
            raise LaeError(f"{self.path}: no sequence {_listed(missing)}")

    def _all(self) -> Iterator[Recording]:
        """Recordings, put together again where a batch ends inside one."""
        check = RowChecker(self.path, self.profiled, self.restarts)
        parts: list[Recording] = []
        budget = Budget(self.path, TraceError)
        for rows in self._rows():
            check(rows)
            for recording in rows.recordings():
                if parts and recording.name != parts[0].name:
                    yield _joined(parts)
                    parts, budget = [], Budget(self.path, TraceError)
                budget.take((_ROW_BYTES + 8 * len(recording.stages)) * len(recording))
                parts.append(recording)
        if not parts:
            raise TraceError(f"{self.path}: the trace is empty")
        yield _joined(parts)

    def _rows(self) -> Iterator[Rows]:
        with self.opened() as file:
            there = file.schema_arrow.names
            present = [name for name in there if name in COLUMN_TYPES or is_optional(name)]
            groups = [file.metadata.row_group(g) for g in range(file.num_row_groups)]
            if sum(group.num_rows for group in groups) != file.metadata.num_rows:
                raise TraceError(f"{self.path}: the file is damaged: its row counts disagree")
            self._check_sizes(groups)
            # twice, since row groups end with the sequence that fills them; memory is taken for all
            rows = min(2 * BATCH_ROWS, max((group.num_rows for group in groups), default=1))
            batches = file.iter_batches(max(rows, 1), columns=present, use_threads=False)
            for batch in batches:
                if batch.num_rows:
                    yield Rows.of_batch(batch)

    def _check_sizes(self, groups: Iterable[Any]) -> None:
        """Check what a column of a row group takes, of which a page is decoded at a time."""
        for group in groups:
            budget = Budget(self.path, TraceError)
            if group.total_byte_size > budget.left:  # uncompressed
                columns = (group.column(c) for c in range(group.num_columns))
                budget.take(max(column.total_uncompressed_size for column in columns))

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """The file, open."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self.file is not None:
            yield self.file
            return
        try:
            with (
                opened(self.path) as source,
                pq.ParquetFile(
                    source,
                    read_dictionary=["sequence"],
                    pre_buffer=False,
                    **checksums("page_checksum_verification"),
                ) as file,
            ):
                yield file
        except FileNotFoundError as error:
            raise TraceError(f"{self.path}: no such file") from error
        except KeyError as error:  # from read_dictionary
            raise TraceError(
                f"{self.path}: column 'sequence' is missing: is this a lae_sim trace?"
            ) from error
        except (pa.ArrowException, OSError, ValueError) as error:  # not for want of memory
            if not is_url(self.path) and not os.path.lexists(self.path):
                raise TraceError(f"{self.path}: no such file") from error  # constant:47ms, too
            raise TraceError(f"{self.path}: not a readable Parquet file: {error}") from error
        except Exception as error:
            if isinstance(error, LaeError) or not is_url(self.path):
                raise
            raise TraceError(f"{self.path}: {type(error).__name__}: {error}") from error


def _listed(missing: Iterable[str], known: Iterable[str] = ()) -> str:
    """Sequences that are not there, with what may have been meant by one."""
    names = sorted(missing, key=str)
    return listed(map(repr, names)) + (hint(names[0], known) if len(names) == 1 else "")


def _joined(parts: list[Recording]) -> Recording:
    if len(parts) == 1:
        return parts[0]
    names = {name for part in parts for name in part.columns}
    said = {name: Nullable.of_recordings(name, parts).values for name in names}
    return Recording(
        parts[0].name,
        np.concatenate([part.truth for part in parts]),
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.elapsed_ns for part in parts]),
        np.concatenate([part.score for part in parts]),
        said.pop("arrival_ns", None),
        said.pop("visible", None),
        {str(stage_of(name)): values for name, values in said.items()},
    )
