"""Ground truth of tracking datasets, in their official folder layouts or as flat files.

Known layouts: OTB100 and DTB70 (``<seq>/groundtruth_rect.txt``), GOT-10k, VOT and LaSOT
(``<seq>/groundtruth.txt``, also in the folders of GOT-10k's splits, of LaSOT's classes and of a
VOT workspace), UAVDT (``anno/<seq>_gt.txt``), UAV123, UAV123_10fps and UAV20L
(``anno/<dataset>/<seq>.txt``), VisDrone-SOT (``annotations/<seq>.txt``), NfS as it is downloaded
(``<seq>/<frames per second>/<seq>.txt``), and any folder of ``<seq>.txt``.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.datasets.foreign import foreign_columns, foreign_file
from lae_sim.datasets.nfs import find_nfs, is_vatic, rate_of, read_vatic
from lae_sim.datasets.numbers import read_lines, read_numbers
from lae_sim.errors import LaeError, listed

_PER_SEQUENCE = re.compile(r"groundtruth(?:_rect)?(?:\.([0-9]))?\.txt\Z")
_NOT_SEQUENCES = ("readme", "list", "license")
_ANNOTATION_FOLDERS = ("annotations", "anno")
ATTRIBUTE_FOLDERS = ("att", "attributes")
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
        return GroundTruth(root, "unknown", {name: root}, rate_of(root))
    if not root.is_dir():
        raise LaeError(f"{root}: no such folder; give the dataset's folder")
    files = _in_sequence_folders(root) or find_nfs(root, fps) or _flat(_annotation_folder(root))
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
    return GroundTruth(root, _dataset(first), dict(sorted(files.items())), rate_of(first))


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
    if is_vatic(lines[0]):
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


def _in_sequence_folders(root: Path) -> dict[str, Path]:
    """``<seq>/groundtruth_rect.txt``; with ``.1`` and ``.2`` for two targets in one video."""
    folders = _folders(root)
    nested = (path for folder in folders for path in _folders(folder) if _is_nested(path))
    return _per_sequence([root, *folders]) or _per_sequence(nested)


def _instead(root: Path) -> str | None:
    """What lies in a folder without ground truth that is known here, in words."""
    paths = itertools.chain(root.glob("*"), root.glob("*/*"), root.glob("*/gt/gt.txt"))
    table = None
    for path in itertools.islice(paths, _MOST_LOOKED_AT):
        if path.suffix.lower() in _TABLES and path.name != "attributes.csv" and path.is_file():
            table = table or path
        if path.suffix.lower() not in _CONTAINERS or not path.is_file():
            continue
        other = foreign_file(path)
        if other is None and path.suffix.lower() == ".txt":
            with suppress(LaeError):
                other = foreign_columns(read_numbers(path, nan=True))
        if other is not None:
            return f"{path} {other}"
    if table is not None:
        return f"is {table} a table? Name it <seq>.txt, a line x,y,w,h for each frame"
    inner = next(root.glob("*/*/groundtruth*.txt"), None)
    return f"{inner.parents[1]} has some: give the folder of one dataset" if inner else None


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
    if folder.name in ATTRIBUTE_FOLDERS:
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
    if rate_of(file) is not None:
        return folder.parent.parent.name
    return folder.parent.name if folder.name in _ANNOTATION_FOLDERS else folder.name
