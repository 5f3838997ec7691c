"""Results of other toolkits on every frame: text, MATLAB, JSON, npz.

Each reader gives the boxes and, where the files have them, the times. Real-time runs are read by
:mod:`lae_sim.importers.lae_pvt`.
"""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from lae_sim._arrays import Floats, Ints
from lae_sim.datasets.foreign import Foreign, foreign, foreign_columns, foreign_file, recognised
from lae_sim.datasets.numbers import read_lines, read_numbers
from lae_sim.decoding import Budget
from lae_sim.errors import LaeError, one_line
from lae_sim.files import check_regular
from lae_sim.importers.matlab import load_matlab
from lae_sim.importers.otb import load_json, read_run
from lae_sim.importers.times import read_times

FORMATS = ("got10k", "pytracking", "ope", "mat", "json", "npz", "lae-pvt")

_SUFFIXES = {
    ".json": "json",
    ".mat": "mat",
    ".npz": "npz",
    ".pickle": "lae-pvt",
    ".pkl": "lae-pvt",
}
# What toolkits write beside the boxes.
_NOT_BOXES = ("_time", "_all_boxes", "_all_scores", "_scores", "_confidence", "_conf")
# What the VOT toolkit writes in place of a region: nothing known, the tracker starts, it failed.
_VOT_UNKNOWN, _VOT_START, _VOT_FAILED = "0", "1", "2"
_SIGNED_NAN = re.compile(r"[-+]?\bnan\b(?:\(ind\))?", re.IGNORECASE)  # C's printf


@dataclass(frozen=True)
class Source:
    """Where the results of one sequence lie.

    Attributes:
        name: the sequence as the files call it.
        path: the file of boxes.
        times: the file of measured times, if there is one.
    """

    name: str
    path: Path
    times: Path | None = None


@dataclass(frozen=True)
class Results:
    """What a tracker did on every frame of one sequence.

    Attributes:
        boxes: ``x, y, w, h`` in pixels, float64 [n, 4]; a row of NaN = the tracker has none.
        elapsed_ns: measured times in ns, int64 [n], if there are any.
        mean_fps: mean frames per second, where the file says only that.
        unit: of measured times, if it was said (see :func:`lae_sim.importers.times.read_times`).
    """

    boxes: Floats
    elapsed_ns: Ints | None = None
    mean_fps: Fraction | None = None
    unit: str | None = None


def find_results(path: Path, wanted: str = "auto", repetition: int = 1) -> tuple[str, list[Source]]:
    """Find the results files of one tracker.

    Args:
        path: the tracker's folder, or the file of one sequence, or an ``.npz`` of all.
        wanted: a name of ``FORMATS``, or ``"auto"``.
        repetition: which run to take where the toolkit repeats them, from 1.

    Returns:
        The format, and the sources sorted by name.

    Raises:
        LaeError: if there are no results, results of several formats, or none of the one wanted.
    """
    if not path.exists():
        raise LaeError(f"{path}: no such file or folder of results")
    if not path.is_dir():
        check_regular(path)
    by_format = _by_format(path, repetition)
    if wanted == "auto" and len(by_format) > 1:
        by_format.pop("json", None)  # settings or a summary beside results
    elif wanted != "auto":
        kind = "text" if wanted in ("got10k", "pytracking", "ope") else wanted
        by_format = {kind: by_format[kind]} if kind in by_format else {}
    if not by_format:
        raise LaeError(
            f"{path}: no results found{'' if wanted == 'auto' else f' of format {wanted}'}; looked "
            "for <seq>.txt, <seq>/<seq>_001.txt, .mat, .json, .npz and .pkl files"
            f"{_found_instead(path)}"
        )
    if len(by_format) > 1:
        raise LaeError(f"{path}: holds {' and '.join(by_format)} results; say which with --format")
    [(kind, sources)] = by_format.items()
    if kind == "text":
        kind = wanted if wanted != "auto" else _text_format(sources)
    return kind, sorted(sources, key=lambda source: source.name)


def read_results(
    kind: str, source: Source, repetition: int, unit: str | None, measured: bool
) -> Results:
    """Read one sequence.

    Args:
        kind: a name of ``FORMATS``, but not ``"lae-pvt"``.
        source: its files.
        repetition: which run to take where the files repeat them, from 1.
        unit: of the measured times (see :func:`lae_sim.importers.times.read_times`).
        measured: whether measured times are to be read.

    Raises:
        LaeError: if a file is damaged or is not of the format.
    """
    if kind in ("mat", "json"):
        return _read_otb(source.path)
    if kind == "npz":
        return Results(_npz_boxes(source.path, source.name))
    boxes = _text_boxes(source.path)
    if source.times is None or not measured or kind == "ope":
        return Results(boxes)
    elapsed_ns, stated = read_times(source.times, unit, repetition - 1)
    return Results(boxes, elapsed_ns, unit=stated)


def _read_otb(path: Path) -> Results:
    """Read ``res`` and ``fps``, alone or in ``results`` as the OTB toolkit has them."""
    with recognised(path, b"MATLAB", b"\x89HDF"):
        content = load_json(path) if path.suffix.lower() == ".json" else load_matlab(path)
        boxes, mean_fps = read_run(content, str(path))
    return Results(_checked_boxes(boxes, str(path)), mean_fps=mean_fps)


def _text_boxes(path: Path) -> Floats:
    """Boxes of a text file; NaN where it says that the tracker has none.

    Raises:
        LaeError: if they are no boxes, or those of a tracker that was started again.
    """
    lines = [_SIGNED_NAN.sub("nan", line) for line in read_lines(path)]
    if _VOT_FAILED in lines or lines.count(_VOT_START) > 1:
        raise LaeError(
            f"{path}: VOT's supervised results (1 = start, 2 = failure): restarted runs cannot be "
            "replayed; use those of its unsupervised, longterm or realtime experiment"
        )
    if lines[0] == _VOT_START:
        lines[0] = _VOT_UNKNOWN
    first = next((line for line in lines if line != _VOT_UNKNOWN), "")
    other = foreign(first.encode())
    if other is not None:
        raise LaeError(f"{path}: {other}")
    table = read_numbers(path, nan=True, absent=True, lines=lines)
    other = foreign_columns(table) if table.shape[1] != 4 else None
    if other is None and table.shape[1] == 8:
        other = Foreign("polygons of four corners", "write x,y,w,h of the box around each")
    if other is not None:
        raise LaeError(f"{path}: {other}")
    return _checked_boxes(table, str(path))


def _by_format(path: Path, repetition: int) -> dict[str, list[Source]]:
    by_format: dict[str, list[Source]] = {}
    if path.is_file():
        files = [path]
    else:
        visible = (file for file in path.iterdir() if not file.name.startswith("."))
        files = sorted(file for file in visible if file.is_file())
        run = f"_{repetition:03}"
        repeated = [folder / f"{folder.name}{run}.txt" for folder in sorted(path.iterdir())]
        for file in repeated:
            if file.is_file():
                times = _first_file(file.with_name(f"{file.parent.name}_time.txt"))
                by_format.setdefault("text", []).append(Source(file.parent.name, file, times))
    for file in files:
        kind = _SUFFIXES.get(file.suffix.lower())
        if kind == "npz":
            by_format.setdefault(kind, []).extend(Source(name, file) for name in _npz_names(file))
        elif kind:
            by_format.setdefault(kind, []).append(Source(file.stem, file))
        elif file.suffix.lower() == ".txt" and not file.stem.endswith(_NOT_BOXES):
            name = f"{file.stem}_time{file.suffix}"
            times = _first_file(file.with_name(name), file.parent / "times" / name)
            by_format.setdefault("text", []).append(Source(file.stem, file, times))
    return by_format


def _found_instead(path: Path) -> str:
    """What there is in place of results, to end a message with."""
    if path.is_dir():
        for folder in sorted(path.iterdir()):
            with suppress(LaeError, OSError):
                if folder.is_dir() and _by_format(folder, 1):
                    return f"; give the folder of one tracker, such as {folder}"
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in [file for file in files if file.is_file()][:5]:
        other = foreign_file(file)
        if other is not None:
            return f"; {file.name} {other}"
        if file.suffix.lower() in (".csv", ".tsv", ".dat", ""):
            return f"; is {file.name} a table? Name it <seq>.txt, a line x,y,w,h for each frame"
    return "; give the folder of one tracker"


def _first_file(*paths: Path) -> Path | None:
    return next((path for path in paths if path.is_file()), None)


def _text_format(sources: list[Source]) -> str:
    """Which toolkit wrote text results: pytracking separates by tabs."""
    if not any(source.times for source in sources):
        return "ope"
    with sources[0].path.open("rb") as file:
        return "pytracking" if b"\t" in file.readline(1000) else "got10k"


def _checked_boxes(boxes: Any, where: str) -> Floats:
    if not (isinstance(boxes, np.ndarray) and boxes.dtype.kind in "iuf" and boxes.ndim == 2):
        raise LaeError(f"{where}: boxes must be a table of numbers")
    if boxes.shape[1] != 4 and not np.isnan(boxes).all():
        raise LaeError(f"{where}: {boxes.shape[1]} columns; boxes have 4: x, y, w, h")
    table = boxes.astype(np.float64, copy=False)
    lost = np.isnan(table).all(axis=1)
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1) & ~lost)
    if len(bad):
        raise LaeError(
            f"{where}: the box in row {bad[0] + 1} is not finite; where the tracker has none, "
            "write NaN in all four columns"
        )
    if lost.all():
        raise LaeError(f"{where}: holds no box at all; --exclude leaves its sequence out")
    return table


def _npz_names(path: Path) -> list[str]:
    with recognised(path, b"PK"):
        try:
            with ZipFile(path) as archive:
                entries = archive.infolist()
        except Exception as error:  # a damaged file can raise anything
            raise LaeError(f"{path}: not a readable .npz file: {error!s:.200}") from error
    Budget(path).take(sum(entry.file_size for entry in entries))
    return [entry.filename.removesuffix(".npy") for entry in entries]


def _npz_boxes(path: Path, name: str) -> Floats:
    try:
        with ZipFile(path) as archive:
            member = f"{name}.npy" if f"{name}.npy" in archive.NameToInfo else name
            with archive.open(member) as file:
                shape, kind = _npy_header(file)
            # as it is stored, and as float64
            Budget(path).take(math.prod(shape) * (kind.itemsize + np.dtype(np.float64).itemsize))
            with archive.open(member) as file:
                boxes = np.lib.format.read_array(file, allow_pickle=False)
    except (LaeError, MemoryError):
        raise
    except Exception as error:  # a damaged file can raise anything
        text = one_line(str(error))[:200]  # NumPy quotes the whole head
        raise LaeError(f"{path}: array {name[:80]!r} cannot be read: {text}") from error
    return _checked_boxes(boxes, f"{path}, array {name!r}")


def _npy_header(file: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array of NumPy's format."""
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, _, kind = read(file)
    return shape, kind
