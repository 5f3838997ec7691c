"""Files that a replay can leave: answers, schedules, events, and results for other toolkits."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import Observer, ScoredRun
from lae_sim.evaluation.events import event_log
from lae_sim.files import NAME_MAX, file_names, staged_folder, written_whole
from lae_sim.trace.columns import from_numpy, from_texts
from lae_sim.trace.recording import BATCH_ROWS


@contextmanager
def outputs_file(path: str, asked: Sequence[tuple[str, Fraction]]) -> Iterator[Observer]:
    """Write every answer: sequence, frame, sigma, forecaster, source_frame, x, y, w, h.

    Args:
        path: the Parquet file.
        asked: forecasters and permitted latencies, in the order of the rows of a sequence.
    """
    import pyarrow as pa

    schema = pa.schema(
        [
            ("sequence", pa.string()),
            ("frame", pa.int32()),
            ("sigma", pa.float64()),
            ("forecaster", pa.string()),
            ("source_frame", pa.int32()),
            *((name, pa.float64()) for name in "xywh"),
        ]
    )
    with _parquet(path, schema) as write:

        def observer(scored: ScoredRun) -> None:
            for forecaster, sigma in asked:
                answers = scored.answers[forecaster, sigma]
                length = len(answers.boxes)
                write(
                    from_texts([scored.run.recording.name], length),
                    from_numpy(np.arange(length, dtype=np.int32)),
                    from_numpy(np.full(length, float(sigma))),
                    from_texts([forecaster], length),
                    from_numpy(answers.source_frame.astype(np.int32)),
                    *(from_numpy(answers.boxes[:, i]) for i in range(4)),
                )

        yield observer


@contextmanager
def schedule_file(path: str, clock: Clock) -> Iterator[Observer]:
    """Write every processed frame: sequence, frame, start_ticks, ready_ticks.

    The file's metadata holds ``ticks_per_ns`` and ``fps`` as text.
    """
    import pyarrow as pa

    schema = pa.schema(
        [
            ("sequence", pa.string()),
            ("frame", pa.int32()),
            ("start_ticks", pa.int64()),
            ("ready_ticks", pa.int64()),
        ],
        {"ticks_per_ns": str(clock.ticks_per_ns), "fps": str(clock.fps)},
    )
    with _parquet(path, schema) as write:

        def observer(scored: ScoredRun) -> None:
            schedule = scored.run.schedule
            write(
                from_texts([scored.run.recording.name], len(schedule.frames)),
                from_numpy(schedule.frames.astype(np.int32)),
                from_numpy(schedule.start),
                from_numpy(schedule.ready),
            )

        yield observer


@contextmanager
def events_file(path: str, sigma: Fraction) -> Iterator[Observer]:
    """Write the event log as JSON lines: sequence, tick, ms, event, frame, source_frame."""
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as lines:

        def observer(scored: ScoredRun) -> None:
            run = scored.run
            ticks_per_ms = run.schedule.clock.ticks_per_ns * 10**6
            for event in event_log(run, sigma, scored.pairing(sigma)):
                record = {
                    "sequence": run.recording.name,
                    "tick": event.tick,
                    "ms": event.tick / ticks_per_ms,
                    "event": event.kind,
                    "frame": event.frame,
                    "source_frame": event.source_frame,
                }
                lines.write(json.dumps(record) + "\n")

        yield observer


@contextmanager
def result_folders(folder: str, names: Mapping[tuple[str, Fraction], str]) -> Iterator[Observer]:
    """Write result text files as the pysot toolkit reads them: ``folder/name/sequence.txt``.

    Args:
        folder: where the result folders go; made if needed.
        names: the name of the result folder for each forecaster and sigma.

    Raises:
        LaeError: if a result folder is there already, or a sequence's name is no file name.
    """
    root = Path(folder)
    for name in names.values():
        if (root / name).exists():
            raise LaeError(
                f"{root / name} is there already: move it away, or choose another folder"
            )
    made = not root.exists()
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LaeError(f"cannot write to {root}: {error.strerror}") from error
    try:
        with staged_folder(root) as staging:
            for name in names.values():
                (staging / name).mkdir()

            def observer(scored: ScoredRun) -> None:
                sequence = scored.run.recording.name
                file = f"{sequence}.txt"
                if (
                    sequence != os.path.basename(sequence)
                    or "\0" in sequence
                    or sequence in (".", "..")
                    or len(os.fsencode(file)) > NAME_MAX
                ):
                    raise LaeError(f"sequence {sequence!r} cannot be the name of a file")
                for asked, name in names.items():
                    path = staging / name / file
                    if path.exists():  # on a disk that ignores case
                        raise LaeError(f"{root}: cannot hold {file!r} and another in other case")
                    path.write_text(_text(scored.answers[asked].boxes), encoding="ascii")

            yield observer
            for name in names.values():
                os.replace(staging / name, root / name)
    finally:
        if made:
            with suppress(OSError):  # it stays if it has come to hold something
                root.rmdir()


def _text(boxes: Floats) -> str:
    return "".join(",".join(map(repr, row)) + "\n" for row in boxes.tolist())


@contextmanager
def _parquet(path: str, schema: Any) -> Iterator[Callable[..., None]]:
    """A function that writes columns of the schema to a file that appears whole."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    with (
        written_whole(path) as temporary,
        pa.OSFile(os.fsencode(temporary), "wb") as sink,
        pq.ParquetWriter(sink, schema, compression="zstd") as writer,
    ):
        pending: list[Any] = []

        def write(*columns: Any) -> None:
            pending.append(pa.record_batch(list(columns), schema=schema))
            if sum(batch.num_rows for batch in pending) >= BATCH_ROWS:
                flush()

        def flush() -> None:  # one row group for many small sequences
            writer.write_table(pa.Table.from_batches(pending, schema))
            pending.clear()

        yield write
        flush()


def sigma_text(sigma: Fraction) -> str:
    """A permitted latency as a short exact number: ``0.5``, ``1/3``."""
    short = f"{float(sigma):g}"
    return short if "e" not in short and Fraction(short) == sigma else str(sigma)


def result_names(
    stem: str, forecasters: Sequence[str], sigmas: Sequence[Fraction]
) -> dict[tuple[str, Fraction], str]:
    """Names of result folders: trace, forecaster, and sigma where it is not 0."""
    asked = [(forecaster, sigma) for forecaster in forecasters for sigma in sigmas]
    names = [
        f"{stem}-{forecaster.replace(':', '.')}"
        + (f"-sigma{sigma_text(sigma).replace('/', '_')}" if sigma else "")
        for forecaster, sigma in asked
    ]
    return dict(zip(asked, file_names(names)))
