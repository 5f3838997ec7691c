"""Processing times that were not measured per frame: constants, and mean frame rates."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from lae_sim.datasets.numbers import read_text
from lae_sim.decoding import Budget
from lae_sim.engine.clock import fitting, parse_duration, parse_fps, split_init
from lae_sim.errors import LaeError, listed, shown

NO_TIMES = "give --time constant:47ms, --time mean-fps:120 or --time mean-fps:FILE.csv"


@dataclass(frozen=True)
class GivenTimes:
    """Processing times that were not measured per frame.

    Attributes:
        source: what the trace says of them.
        constant_ns: one time for all, or None.
        per_sequence: frames (if stated) and time in ns of each sequence.
        init_ns: the time of the initialisation, if it is not that of a frame.
        file: where they were read, if from a file.
    """

    source: str
    constant_ns: int | None
    per_sequence: Mapping[str, tuple[int | None, int]]
    init_ns: int | None = None
    file: Path | None = None

    def of(self, sequence: str, frames: int) -> int:
        """The time of every frame of a sequence of ``frames`` frames, ns.

        Raises:
            LaeError: if it is not there, or is that of another number of frames.
        """
        if self.constant_ns is not None:
            return self.constant_ns
        if sequence not in self.per_sequence:
            raise LaeError(f"{self.file}: no row for sequence {sequence!r}")
        stated, elapsed_ns = self.per_sequence[sequence]
        if stated not in (None, frames):
            raise LaeError(
                f"{self.file}: sequence {sequence!r} has {stated} frames there and {frames} here"
            )
        return elapsed_ns


def given_times(text: str, tracker: str) -> GivenTimes | None:
    """Times by the names that command lines use; None means the measured ones.

    Args:
        text: ``measured``, ``constant:47ms``, ``mean-fps:120`` or ``mean-fps:FILE.csv`` (columns
            sequence, fps and perhaps tracker, frames; or tracker and fps, one rate for all its
            sequences); all but the first may end in ``,init=800ms``, what the initialisation takes.
        tracker: whose rows to take where the file has several trackers.

    Raises:
        LaeError: if there is no such name, or the file lacks the tracker or a column.
    """
    if text == "measured":
        return None
    name = text.partition(":")[0] if isinstance(text, str) else None
    if name not in ("constant", "mean-fps"):
        raise LaeError(f"time: no {text!r:.40}: use the measured ones, or {NO_TIMES}")
    times, init_ns = split_init(text, path=name == "mean-fps")
    _, _, value = times.partition(":")
    init = "" if init_ns is None else f", initialisation {init_ns / 1e6:g} ms"
    if name == "constant":
        amount = re.sub(r"(?<=\d)(?=[a-z])", " ", value)
        source = f"constant {amount}{init}, not measured"
        return GivenTimes(source, parse_duration(value), {}, init_ns)
    if not value.lower().endswith(".csv"):
        source = f"mean fps {value} given{init}, not measured per frame"
        return GivenTimes(source, frame_ns(parse_fps(value)), {}, init_ns)
    path = Path(value)
    rows = dict(_mean_fps_rows(path, tracker))
    source = f"from {path.name}{init}, not measured per frame"
    if None in rows:
        return GivenTimes(f"mean fps of the tracker {source}", rows[None][1], {}, init_ns, path)
    by_sequence = {name: time for name, time in rows.items() if name is not None}
    return GivenTimes(f"mean fps of each sequence {source}", None, by_sequence, init_ns, path)


def frame_ns(fps: Fraction) -> int:
    """The time of one frame at a mean rate, ns, rounded half to even.

    Raises:
        LaeError: if a frame takes too long, or less than 1 ns.
    """
    if fps > 10**9:
        raise LaeError(f"a mean of more than {10**9:,} fps: a frame takes 1 ns at least")
    return fitting(round(10**9 / fps), f"a mean of {float(fps):g} fps")


def _mean_fps_rows(path: Path, tracker: str) -> Iterator[tuple[str | None, tuple[int | None, int]]]:
    """Sequence, frames (if stated) and time in ns of each row of a table of mean fps.

    Without a column of sequences, the tracker's only row is that of sequence None.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, Budget(path)), newline="")))
    except csv.Error as error:
        raise LaeError(f"{path}: cannot be read: {error}") from error
    if not rows or "fps" not in rows[0] or not {"sequence", "tracker"} & set(rows[0]):
        raise LaeError(
            f"{path}: needs a header with the columns sequence and fps, or tracker and fps, "
            "separated by commas"
        )
    trackers = sorted({row["tracker"] or "" for row in rows if "tracker" in row})
    if trackers and tracker not in trackers:
        raise LaeError(
            f"{path}: has {listed(trackers)}, not {shown(tracker)}; if it is there under another "
            "name, give that with --tracker; if it is not, add its rate or give --time mean-fps:120"
        )
    seen = set()
    for number, row in enumerate(rows, 2):
        if row.get("tracker", tracker) != tracker:
            continue
        sequence = row.get("sequence")
        if sequence in seen:
            raise LaeError(
                f"{path}, line {number}: a second row for {shown(sequence or tracker)}; keep one"
            )
        seen.add(sequence)
        try:
            frames = int(row["frames"]) if row.get("frames") else None
            yield sequence, (frames, frame_ns(parse_fps(row["fps"] or "")))
        except (LaeError, ValueError) as error:
            raise LaeError(f"{path}, line {number}: {error}") from error
