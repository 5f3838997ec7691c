"""Ground truth of tracking datasets, in their official folder layouts or as flat files.

Known layouts: OTB100 and DTB70 (``<seq>/groundtruth_rect.txt``), GOT-10k, VOT and LaSOT
(``<seq>/groundtruth.txt``, also in the folders of GOT-10k's splits, of LaSOT's classes and of a
VOT workspace), UAVDT (``anno/<seq>_gt.txt``), UAV123, UAV123_10fps and UAV20L
(``anno/<dataset>/<seq>.txt``), VisDrone-SOT (``annotations/<seq>.txt``), NfS as it is downloaded
(``<seq>/<frames per second>/<seq>.txt``), and any folder of ``<seq>.txt``.
"""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from math import gcd
from pathlib import Path

import numpy as np

from lae_sim._arrays import Bools, Floats
from lae_sim.datasets.foreign import HEAD_BYTES, foreign, foreign_columns
from lae_sim.datasets.numbers import read_lines, read_numbers, read_text
from lae_sim.decoding import Budget
from lae_sim.errors import LaeError, listed

_PER_SEQUENCE = re.compile(r"groundtruth(?:_rect)?(?:\.([0-9]))?\.txt\Z")
_NOT_SEQUENCES = ("readme", "list", "license")
_ANNOTATION_FOLDERS = ("annotations", "anno")
_ATTRIBUTE_FOLDERS = ("att", "attributes")
_NFS_RATES = ("30", "240")
_NFS_THINNED = 8  # the truth of its 30 frames/s is that of 240
# A row of VATIC, from which NfS is (https://github.com/cvondrick/vatic): track, corners, frame,
# lost (outside of the view), occluded, generated (interpolated), label.
_VATIC = re.compile(
    r"([0-9]{1,9})"
    + r"\s+(-?[0-9]{1,9}(?:\.[0-9]{0,9})?)" * 4
    + r"\s+([0-9]{1,9})"
    + r"\s+([01])" * 3
    + r'\s+"'
)
_MOST_GAPS = 100
# What may be in place of ground truth, and is worth a look at how it begins.
_CONTAINERS = (
    ".json",
    ".xml",
    ".zip",
    ".tar",
    ".gz",
    ".tgz",
    ".7z",
    ".rar",
    ".txt",
    ".html",
    ".mat",
    ".npy",
    ".npz",
    ".pkl",
    ".xlsx",
    ".ods",
)
_TABLES = (".csv", ".tsv", ".dat")
_MOST_LOOKED_AT = 2000

# The first ten are named so by the toolkit's experiments/perfPlot.m, and the paper (Li and Yeung,
# "Visual Object Tracking for Unmanned Aerial Vehicles", 2017) has motion blur besides
# (https://github.com/flyers/drone-tracking).
_DTB70 = (
    "Scale variation",
    "Aspect ratio variation",
    "Occlusion",
    "Deformation",
    "Fast camera motion",
    "In-plane rotation",
    "Out-of-plane rotation",
    "Out-of-view",
    "Background clutter",
    "Similar objects around",
    "Motion blur",
)
_UAV123 = (
    "Scale variation",
    "Aspect ratio change",
    "Low resolution",
    "Fast motion",
    "Full occlusion",
    "Partial occlusion",
    "Out-of-view",
    "Background clutter",
    "Illumination variation",
    "Viewpoint change",
    "Camera motion",
    "Similar object",
)
_UAVDT = (
    "Background clutter",
    "Camera motion",
    "Object motion",
    "Small object",
    "Illumination variations",
    "Object blur",
    "Scale variations",
    "Long-term tracking",
    "Large occlusion",
)
_VISDRONE = (
    "Aspect Ratio Change",
    "Background Clutter",
    "Camera Motion",
    "Fast Motion",
    "Full Occlusion",
    "Illumination Variation",
    "Low Resolution",
    "Out-of-View",
    "Partial Occlusion",
    "Similar Object",
    "Scale Variation",
    "Viewpoint Change",
)
_ATTRIBUTES_BY_SUFFIX = {"_att": (_UAVDT,), "_attr": (_VISDRONE,), "": (_UAV123, _DTB70, _DTB70[:10])}


@dataclass(frozen=True)
class GroundTruth:
    """The ground truth files of a dataset.

    Attributes:
        root: the folder (or the file) that was given.
        dataset: the dataset's name, as its folder is called.
        files: the annotation file of each sequence, sorted by name.
        fps: frames per second, if the layout says so.
    """

    root: Path
    dataset: str
    files: Mapping[str, Path]
    fps: Fraction | None = None

    def with_files(self, files: Mapping[str, Path]) -> GroundTruth:
        """The same with other files for some sequences."""
        return replace(self, files=dict(sorted({**self.files, **files}.items())))


@dataclass(frozen=True)
class Attributes:
    """A dataset's attributes, as far as they could be read.

    Attributes:
        of: those of each sequence, such as ``"Occlusion"``; empty if the dataset has none.
        notes: which files were left out, and why.
    """

    of: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def find_truth(root: Path, fps: Fraction | None = None) -> GroundTruth:
    """Find the annotation files of a dataset.

    Args:
        root: the dataset's folder, its folder of annotations, or one annotation file.
        fps: frames per second, to choose between sets that differ in it (NfS).

    Raises:
        LaeError: if nothing is found, or there is more than one set of annotations.
    """
    if root.is_file():
        folder = root.resolve().parent
        named = _PER_SEQUENCE.match(root.name)
        name = folder.name if named else root.stem
        return GroundTruth(root, "unknown", {name: root}, _rate(root))
    if not root.is_dir():
        raise LaeError(f"{root}: no such folder; give the dataset's folder")
    files = _in_sequence_folders(root) or _nfs(root, fps) or _flat(_annotation_folder(root))
    if not files:
        raise LaeError(
            f"{root}: no ground truth found; "
            + (
                _instead(root)
                or "looked for <seq>/groundtruth_rect.txt, anno/<seq>.txt, "
                "anno/<dataset>/<seq>.txt, annotations/<seq>.txt and <seq>.txt"
            )
        )
    first = next(iter(files.values()))
    return GroundTruth(root, _dataset(first), dict(sorted(files.items())), _rate(first))


def read_truth(path: Path, frames: int | None = None) -> Floats:
    """Ground truth boxes ``x, y, w, h`` in pixels, float64 [T, 4]; a row of NaN = none.

    Polygons of four corners (8 columns) become the axis-aligned boxes around them. A row that is 0
    or NaN only is none (VOT). Rows of VATIC, from corner to corner, are read too (NfS); those of
    NfS's 30 frames/s are every eighth.

    Args:
        path: the annotation file.
        frames: how many the sequence has, if known: how NfS is thinned out, or ends a frame early
            or late, shows only beside it.

    Raises:
        LaeError: if the file has neither 4 nor 8 columns, or looks like another format: it says
            which; or if a row is NaN in part.
    """
    lines = read_lines(path)
    if _VATIC.match(lines[0]):
        return read_vatic(path, lines, frames)[0]
    table = read_numbers(path, nan=True, absent=True, lines=lines)
    columns = table.shape[1]
    other = foreign_columns(table)
    if other is not None:
        raise LaeError(f"{path}: {other}")
    if columns not in (4, 8):
        raise LaeError(f"{path}: {columns} columns; ground truth has 4 (x, y, w, h) or 8 (corners)")
    unknown = np.isnan(table)
    partly = np.flatnonzero(unknown.any(axis=1) != unknown.all(axis=1))
    if len(partly):
        raise LaeError(
            f"{path}, line {partly[0] + 1}: NaN in some columns; write it in all or none"
        )
    if columns == 4:
        return table
    corners = table.reshape(-1, 4, 2)
    least, most = corners.min(axis=1), corners.max(axis=1)
    return np.concatenate([least, most - least], axis=1)


def read_lost(path: Path, frames: int | None = None) -> Bools | None:
    """Whether the target is lost, out of view, by an annotation file that says so: bool [T].

    Args:
        path, frames: as of :func:`read_truth`.

    Returns:
        None if the file is not of VATIC, and holds no such flags.

    Raises:
        LaeError: as :func:`read_truth`.
    """
    lines = read_lines(path)
    return read_vatic(path, lines, frames)[1] if _VATIC.match(lines[0]) else None


def read_vatic(path: Path, lines: Sequence[str], frames: int | None = None) -> tuple[Floats, Bools]:
    """One target that was annotated with VATIC.

    Args:
        path: the file.
        lines: of it.
        frames: see :func:`read_truth`.

    Returns:
        Boxes ``x, y, w, h`` in pixels, float64 [T, 4], a row of NaN = none; and whether the target
        is lost there, out of view, bool [T].

    Raises:
        LaeError: if a row is another, or of another target, or frames are there twice.
    """
    rows = []
    for number, line in enumerate(lines, 1):
        match = _VATIC.match(line)
        if match is None:
            raise LaeError(
                f"{path}, line {number}: not a row of VATIC as line 1 is: id xmin ymin xmax ymax "
                'frame lost occluded generated "label"'
            )
        rows.append([float(cell) for cell in match.groups()])
        if rows[-1][0] != rows[0][0]:
            raise LaeError(
                f"{path}, line {number}: another target (id {match[1]}); keep the rows of one"
            )
        if number > 1 and rows[-1][5] <= rows[-2][5]:
            raise LaeError(f"{path}, line {number}: frame {match[6]} is there twice, or too late")
    table = np.array(rows)
    at = (table[:, 5] - table[0, 5]).astype(np.int64)
    at //= gcd(*at.tolist()) or 1
    if at[-1] > _MOST_GAPS * len(at):
        raise LaeError(f"{path}: frames up to {table[-1, 5]:.0f}, of which it has {len(at)}")
    boxes, lost = np.full((at[-1] + 1, 4), np.nan), np.zeros(at[-1] + 1, bool)
    boxes[at] = np.concatenate([table[:, 1:3], table[:, 3:5] - table[:, 1:3]], axis=1)
    lost[at] = table[:, 6] == 1
    if frames is None:
        return boxes, lost
    taken = _rows_of(len(lost), frames, path)
    boxes, lost = boxes[taken], lost[taken]
    if len(lost) == frames - 1:
        boxes, lost = np.append(boxes, [[np.nan] * 4], axis=0), np.append(lost, False)
    return boxes, lost


def read_attributes(truth: GroundTruth) -> Attributes:
    """The dataset's attributes of each sequence.

    They come from ``attributes.csv`` (``sequence,Attribute 1,...`` with flags 0 or 1) beside the
    annotations, or from the official folders ``att`` and ``attributes``. A file that is damaged, or
    of another number of flags than is known, is left out with a note: nothing depends on it.
    """
    anchors = dict.fromkeys(
        anchor
        for file in truth.files.values()
        for anchor in (truth.root, file.parent, file.parent.parent)
    )
    for anchor in anchors:
        if (anchor / "attributes.csv").is_file():
            try:
                return Attributes(_from_csv(anchor / "attributes.csv", truth.files))
            except LaeError as error:
                return Attributes(notes=(f"attributes are left out: {error}",))
    attributes: dict[str, tuple[str, ...]] = {}
    damaged: dict[str, LaeError] = {}
    folders = [anchor / name for anchor in anchors for name in _ATTRIBUTE_FOLDERS]
    folders = [folder for folder in folders if folder.is_dir()]
    for sequence, folder in itertools.product(truth.files, folders):
        for suffix, known in _ATTRIBUTES_BY_SUFFIX.items():
            path = folder / f"{sequence}{suffix}.txt"
            if sequence not in attributes and path.is_file():
                try:
                    attributes[sequence] = _from_flags(path, known)
                except LaeError as error:
                    damaged.setdefault(sequence, error)
    damaged = {name: error for name, error in damaged.items() if name not in attributes}
    if not damaged:
        return Attributes(attributes)
    note = f"attributes of {len(damaged)} of {len(truth.files)} sequences are left out, such as "
    return Attributes(attributes, (note + str(next(iter(damaged.values()))),))


def _in_sequence_folders(root: Path) -> dict[str, Path]:
    """``<seq>/groundtruth_rect.txt``; with ``.1`` and ``.2`` for two targets in one video."""
    folders = _folders(root)
    nested = (path for folder in folders for path in _folders(folder) if _is_nested(path))
    return _per_sequence([root, *folders]) or _per_sequence(nested)


def _nfs(root: Path, fps: Fraction | None) -> dict[str, Path]:
    """``<seq>/<rate>/<seq>.txt`` of one rate."""
    rates: dict[str, dict[str, Path]] = {}
    for folder in [root, *_folders(root)]:
        name = folder.resolve().name
        for rate in _NFS_RATES:
            path = folder / rate / f"{name}.txt"
            if path.is_file():
                rates.setdefault(rate, {})[name] = path
    if not rates:
        return {}
    if fps is None and len(rates) > 1:
        raise LaeError(
            f"{root}: NfS at {' and '.join(rates)} frames per second: say which is meant with "
            f"{' or '.join(f'--fps {rate}' for rate in rates)}"
        )
    rate = next(iter(rates)) if fps is None else str(fps)
    if rate not in rates:
        raise LaeError(f"{root}: NfS at {' and '.join(rates)} frames per second, not at {rate}")
    return rates[rate]


def _rate(file: Path) -> Fraction | None:
    """The frames per second that NfS's layout says."""
    folder = file.resolve().parent
    if folder.name not in _NFS_RATES or folder.parent.name != file.stem:
        return None
    return Fraction(folder.name)


def _rows_of(count: int, frames: int, path: Path) -> slice:
    """Which of NfS's rows are the truth of so many frames, if it fits but for the last one.

    The files of 30 and of 240 frames/s are the same, and for the former every eighth row counts; so
    do the GOT-10k toolkit and others (https://github.com/got-10k/toolkit).

    Raises:
        LaeError: if what should have 30 frames/s has as many frames as the truth of 240.
    """
    step = 1
    if _rate(path) == 30:
        thinned = -(-count // _NFS_THINNED)
        if count != frames and abs(thinned - frames) <= 1:
            step, count = _NFS_THINNED, thinned
        elif abs(count - frames) <= 1 and _is_same(path, path.parent.with_name("240") / path.name):
            raise LaeError(
                f"{path}: NfS's truth of 240 frames per second, and what has as many frames is of "
                "240 too: --fps 240"
            )
    return slice(0, frames * step if count == frames + 1 else None, step)


def _is_same(file: Path, other: Path) -> bool:
    return other.is_file() and file.read_bytes() == other.read_bytes()


def _instead(root: Path) -> str | None:
    """What lies in a folder without ground truth that is known here, in words."""
    paths = itertools.chain(root.glob("*"), root.glob("*/*"), root.glob("*/gt/gt.txt"))
    table = None
    for path in itertools.islice(paths, _MOST_LOOKED_AT):
        if path.suffix.lower() in _TABLES and path.name != "attributes.csv" and path.is_file():
            table = table or path
        if path.suffix.lower() not in _CONTAINERS or not path.is_file():
            continue
        try:
            with path.open("rb") as file:
                other = foreign(file.read(HEAD_BYTES))
            if other is None and path.suffix.lower() == ".txt":
                other = foreign_columns(read_numbers(path, nan=True))
        except (OSError, LaeError):
            continue
        if other is not None:
            return f"{path} {other}"
    if table is not None:
        return f"is {table} a table? Name it <seq>.txt, a line x,y,w,h for each frame"
    return None


def _is_nested(folder: Path) -> bool:
    """Whether a sequence's folder is in that of a class, a split or a VOT workspace's sequences."""
    outer = folder.parent.name
    return outer == "sequences" or folder.name.startswith((f"{outer}-", "GOT-10k_"))


def _per_sequence(folders: Iterable[Path]) -> dict[str, Path]:
    files = {}
    for folder in folders:
        for path in sorted(folder.glob("groundtruth*.txt")):
            match = _PER_SEQUENCE.match(path.name)
            if match:
                name = folder.resolve().name
                files[f"{name}-{match[1]}" if match[1] else name] = path
    return files


def _folders(root: Path) -> list[Path]:
    return sorted(path for path in root.iterdir() if path.is_dir())


def _annotation_folder(root: Path) -> Path:
    """The folder that holds ``<seq>.txt``."""
    for name in _ANNOTATION_FOLDERS:
        folder = root / name
        if not folder.is_dir():
            continue
        if _flat(folder):
            return folder
        inner = {path.name: path for path in _folders(folder) if _flat(path)}
        if root.resolve().name in inner:
            return inner[root.resolve().name]
        if len(inner) > 1:
            raise LaeError(
                f"{folder}: holds the ground truth of {listed(inner)}; give one of them, "
                f"such as {next(iter(inner.values()))}"
            )
        if inner:
            return next(iter(inner.values()))
    return root


def _flat(folder: Path) -> dict[str, Path]:
    """``<seq>.txt``, or ``<seq>_gt.txt`` if all are named so."""
    if folder.name in _ATTRIBUTE_FOLDERS:
        return {}
    paths = [
        path
        for path in sorted(folder.glob("*.txt"))
        if not path.name.startswith(".") and not path.stem.lower().startswith(_NOT_SEQUENCES)
    ]
    suffix = "_gt" if paths and all(path.stem.endswith("_gt") for path in paths) else ""
    return {path.stem.removesuffix(suffix): path for path in paths}


def _dataset(file: Path) -> str:
    folder = file.resolve().parent
    if _PER_SEQUENCE.match(file.name):
        return (folder.parent.parent if _is_nested(folder) else folder.parent).name
    if _rate(file) is not None:
        return folder.parent.parent.name
    return folder.parent.name if folder.name in _ANNOTATION_FOLDERS else folder.name


def _from_csv(path: Path, sequences: Iterable[str]) -> dict[str, tuple[str, ...]]:
    try:
        header, *rows = csv.reader(io.StringIO(read_text(path, Budget(path)), newline=""))
    except (ValueError, csv.Error) as error:
        raise LaeError(f"{path}: not a table of attributes: {error}") from error
    if not header:
        raise LaeError(f"{path}, line 1: needs a header: sequence, and the attributes' names")
    known = set(sequences)
    attributes = {}
    for number, row in enumerate(rows, 2):
        if len(row) != len(header) or set(row[1:]) - {"0", "1"}:
            raise LaeError(
                f"{path}, line {number}: needs a name and {len(header) - 1} flags 0 or 1"
            )
        if row[0] in known:
            attributes[row[0]] = _flagged(header[1:], row[1:])
    return attributes


def _from_flags(path: Path, known: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """The attributes that are flagged; which they are, their number says."""
    flags = read_numbers(path).ravel()
    for names in known:
        if len(flags) == len(names) and np.isin(flags, (0, 1)).all():
            return _flagged(names, [str(int(flag)) for flag in flags])
    counts = " or ".join(str(len(names)) for names in known)
    raise LaeError(f"{path}: needs {counts} flags 0 or 1")


def _flagged(names: Iterable[str], flags: Iterable[str]) -> tuple[str, ...]:
    return tuple(name for name, flag in zip(names, flags) if flag == "1")


_PART_OF_VIDEO = re.compile(r"[-_.](\d{1,2}|s)\Z")


def video_of(sequence: str) -> str:
    """The video that a sequence is part of, by its name.

    A number or an ``s`` at the end tells parts apart: ``car1_1``, ``car1_2`` and ``car1_s`` are one
    video, and so are ``Jogging-1`` and ``Jogging-2``.
    """
    return _PART_OF_VIDEO.sub("", sequence)
