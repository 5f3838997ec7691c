"""The rows of a study's cells: every score of every sequence, repetition and sigma."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import Evaluation
from lae_sim.evaluation.metrics import METRICS
from lae_sim.evaluation.modelled import FIGURES
from lae_sim.trace.columns import from_numpy, from_texts

COLUMNS = {
    "trace": "string",
    "tracker": "string",
    "dataset": "string",
    "times_from": "string",
    "policy": "string",
    "fps": "string",
    "latency": "string",
    "scale": "string",
    "search": "string",
    "pre_forecaster": "string",
    "convention": "string",
    "forecaster": "string",
    "sequence": "string",
    "repetition": "int32",
    "sigma": "float64",
    "world_frames": "int32",
    "processed": "int32",
    "approximate_outputs": "int32",
    "elapsed_ms": "float64",
    "init_ms": "float64",
    "mismatch_mean": "float64",
    "mismatch_max": "int32",
    "longest_hold": "int32",
    "age_mean": "float64",
    "age_max": "float64",
    "longest_stale": "float64",
    "failure_frame": "int32",
    "failure_time": "float64",
    **dict.fromkeys(METRICS, "float64"),
    **{f"offline_{metric}": "float64" for metric in METRICS},
    **{f"modelled_{name}": "float64" for name in FIGURES},
    "lost_share": "float64",
}
"""Columns of the results, and their types.

``elapsed_ms`` is the mean time of the calls but the initialisation, ``init_ms`` the latter's;
``longest_hold`` and the mismatches are in frames, ``failure_frame`` is the first whose answer does
not overlap the truth (``world_frames`` if there is none, -1 without a truth to score by);
``longest_stale``, the ages (without the permitted latency) and ``failure_time`` are the same by
when frames arrive, in nominal frame intervals. Scores are in 0..1, NaN where the sequence leaves
the mean or, offline, where the trace lacks boxes. The modelled ones are those under the search
model, with the ends of their intervals, and ``lost_share`` is the share of the outputs answered
while the target is lost: NaN where the replay is exact, or the
model off.
"""


class RowsFile:
    """A Parquet file in memory, of the rows of one cell or of several."""

    def __init__(self) -> None:
        import pyarrow.parquet as pq

        self.rows = 0
        self._file = io.BytesIO()
        texts = [name for name, kind in COLUMNS.items() if kind == "string"]
        self._writer = pq.ParquetWriter(
            self._file, _schema(), compression="zstd", use_dictionary=texts
        )
        self._waiting: list[Any] = []

    def write(self, batch: Any, soon: bool = True) -> None:
        """Add rows; those that need not be written soon share a row group with what follows."""
        self._waiting.append(batch)
        self.rows += batch.num_rows
        if soon:
            self._flush()

    def undo(self, rows: int) -> None:
        """Take away what was written after so many rows, and not soon."""
        while self.rows > rows:
            self.rows -= self._waiting.pop().num_rows

    def _flush(self) -> None:
        import pyarrow as pa

        if self._waiting:
            self._writer.write_table(pa.Table.from_batches(self._waiting).combine_chunks())
        self._waiting.clear()

    def finish(self) -> bytes:
        """The file's bytes."""
        self._flush()
        self._writer.close()
        return self._file.getvalue()


class CellRows:
    """Writes the rows of one cell, group after group.

    Args:
        sigmas: the permitted latencies.
        about: the columns that are the same in all rows.
        shared: the file that other cells' rows are in too; by default it has one of its own.
    """

    def __init__(
        self, sigmas: Sequence[Fraction], about: Mapping[str, str], shared: RowsFile | None = None
    ) -> None:
        self._sigmas = np.array([float(sigma) for sigma in sigmas])
        self._about = about
        self._schema = _schema()
        self._file = RowsFile() if shared is None else shared
        self._is_alone = shared is None
        self._waiting: list[Any] = []

    def add(self, part: Evaluation, f: int, repetitions: npt.NDArray[np.int32]) -> None:
        """Add a row for each sequence of a part and each sigma."""
        import pyarrow as pa

        count = len(self._sigmas)
        replay, staleness = part.replay, part.staleness
        calls = np.where(replay.processed > 1, replay.processed - 1, np.nan)
        once: dict[str, npt.NDArray[Any]] = {  # by sequence
            "repetition": repetitions,
            "world_frames": replay.frames,
            "processed": replay.processed,
            "approximate_outputs": replay.departures,
            "elapsed_ms": replay.calls_ns / calls / 1e6,
            "init_ms": replay.init_ns / 1e6,
            **{f"offline_{metric}": part.offline[metric] for metric in METRICS},
            "lost_share": np.where(part.modelled.applies, part.modelled.lost_share, np.nan),
        }
        values = {name: np.repeat(column, count) for name, column in once.items()}
        values |= {  # by sequence and sigma
            "mismatch_mean": (staleness.mismatch_sum / replay.frames[:, None]).ravel(),
            "mismatch_max": staleness.mismatch_max.ravel(),
            "longest_hold": staleness.longest_hold.ravel(),
            "age_mean": (staleness.age_sum / replay.frames[:, None]).ravel(),
            "age_max": staleness.age_max.ravel(),
            "longest_stale": staleness.longest_stale.ravel(),
            "failure_frame": part.failure[f].ravel(),
            "failure_time": part.failure_time[f].ravel(),
            **{metric: part.scores[metric][f].ravel() for metric in METRICS},
            **_modelled(part, f),
        }
        values["sigma"] = np.tile(self._sigmas, len(replay.sequences))
        rows = len(values["sigma"])
        columns = {
            # not pa.repeat, which imports pandas
            **{name: from_texts([text], rows) for name, text in self._about.items()},
            "sequence": from_texts(replay.sequences, count),
            **{name: from_numpy(column.astype(COLUMNS[name])) for name, column in values.items()},
        }
        arrays = [columns[name] for name in COLUMNS]
        rows_of_part = pa.record_batch(arrays, schema=self._schema)
        if self._is_alone:
            self._file.write(rows_of_part)
        else:
            self._waiting.append(rows_of_part)  # a cell's rows stand together

    def finish(self) -> tuple[bytes, int, int]:
        """The file's bytes, none of a shared one; the first row in it, and how many."""
        if self._is_alone:
            return self._file.finish(), 0, self._file.rows
        first = self._file.rows
        for batch in self._waiting:
            self._file.write(batch, soon=False)
        return b"", first, self._file.rows - first


def _modelled(part: Evaluation, f: int) -> dict[str, Floats]:
    """The modelled scores of a forecaster by sequence and sigma."""
    applies = part.modelled.applies[:, None]
    return {
        f"modelled_{name}": np.where(applies, values[f], np.nan).ravel()
        for name, values in part.modelled.figures().items()
    }


@cache
def _schema() -> Any:
    import pyarrow as pa

    return pa.schema([pa.field(name, kind) for name, kind in COLUMNS.items()])


def read_rows(path: Path, columns: Sequence[str] | None = None) -> Any:
    """Some columns of a file of rows, or all, as one Arrow table of one chunk.

    Raises:
        LaeError: if the file is damaged; it says what to do.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pa.OSFile(os.fsencode(path)) as source, pq.ParquetFile(source) as file:
            if not file.schema_arrow.equals(_schema()):
                raise ValueError("other columns")
            return file.read(columns).combine_chunks()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise LaeError(f"{path}: damaged: delete it, and run the study again") from error
