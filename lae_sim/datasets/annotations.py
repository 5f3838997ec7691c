"""Ground truth of tracking datasets, in their official folder layouts or as flat files.

Known layouts: OTB100 and DTB70 (``<seq>/groundtruth_rect.txt``), GOT-10k, VOT and LaSOT
(``<seq>/groundtruth.txt``, also in the folders of GOT-10k's splits, of LaSOT's classes and of a
VOT workspace), UAVDT (``anno/<seq>_gt.txt``), UAV123, UAV123_10fps and UAV20L
(``anno/<dataset>/<seq>.txt``), VisDrone-SOT (``annotations/<seq>.txt``), and any folder of
``<seq>.txt``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.datasets.numbers import read_numbers
from lae_sim.errors import LaeError, listed

_PER_SEQUENCE = re.compile(r"groundtruth(?:_rect)?(?:\.([0-9]))?\.txt\Z")
_NOT_SEQUENCES = ("readme", "list", "license")
_ANNOTATION_FOLDERS = ("annotations", "anno")
_ATTRIBUTE_FOLDERS = ("att", "attributes")

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
_ATTRIBUTES_BY_SUFFIX = {"_att": _UAVDT, "_attr": _VISDRONE, "": _UAV123}


@dataclass(frozen=True)
class GroundTruth:
    """The ground truth files of a dataset.

    Attributes:
        root: the folder (or the file) that was given.
        dataset: the dataset's name, as its folder is called.
        files: the annotation file of each sequence, sorted by name.
    """

    root: Path
    dataset: str
    files: Mapping[str, Path]

    def with_files(self, files: Mapping[str, Path]) -> GroundTruth:
        """The same with other files for some sequences."""
        return replace(self, files=dict(sorted({**self.files, **files}.items())))

    def match(self, name: str, with_tracker: bool = False) -> str | None:
        """The sequence that a results file means by ``name``, if there is one.

        Toolkits write ``uav_bike1`` for ``bike1``, ``Jogging.1`` or ``Jogging_1`` for
        ``Jogging-1``, ``Human4`` for ``Human4-2``, and change capitals.

        Args:
            name: as the results have it.
            with_tracker: whether ``_<tracker>`` may follow the sequence's name.
        """
        bare = name.removeprefix("uav_")
        for guess in (name, bare, re.sub(r"[._]([0-9])\Z", r"-\1", name)):
            if guess in self.files:
                return guess
        if f"{name}-2" in self.files and f"{name}-1" not in self.files:
            return f"{name}-2"
        alike = [known for known in self.files if known.casefold() == bare.casefold()]
        if not alike and with_tracker:
            folded = bare.casefold()
            alike = [known for known in self.files if folded.startswith(f"{known.casefold()}_")]
            alike = sorted(alike, key=len)[-1:]
        return alike[0] if len(alike) == 1 else None


def find_truth(root: Path) -> GroundTruth:
    """Find the annotation files of a dataset.

    Args:
        root: the dataset's folder, its folder of annotations, or one annotation file.

    Raises:
        LaeError: if nothing is found, or there is more than one set of annotations.
    """
    if root.is_file():
        folder = root.resolve().parent
        named = _PER_SEQUENCE.match(root.name)
        return GroundTruth(root, "unknown", {folder.name if named else root.stem: root})
    if not root.is_dir():
        raise LaeError(f"{root}: no such folder; give the dataset's folder")
    files = _in_sequence_folders(root) or _flat(_annotation_folder(root))
    if not files:
        raise LaeError(
            f"{root}: no ground truth found; looked for <seq>/groundtruth_rect.txt, anno/<seq>.txt,"
            " anno/<dataset>/<seq>.txt, annotations/<seq>.txt and <seq>.txt"
        )
    return GroundTruth(root, _dataset(next(iter(files.values()))), dict(sorted(files.items())))


def read_truth(path: Path) -> Floats:
    """Ground truth boxes ``x, y, w, h`` in pixels, float64 [T, 4]; a row of NaN = none.

    Polygons of four corners (8 columns) become the axis-aligned boxes around them.

    Raises:
        LaeError: if the file has neither 4 nor 8 columns, or a row is NaN in part.
    """
    table = read_numbers(path, nan=True)
    columns = table.shape[1]
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


def read_attributes(truth: GroundTruth) -> dict[str, tuple[str, ...]]:
    """The dataset's attributes of each sequence, such as ``"Occlusion"``; empty if it has none.

    They come from ``attributes.csv`` (``sequence,Attribute 1,...`` with flags 0 or 1) beside the
    annotations, or from the official folders ``att`` and ``attributes``.

    Raises:
        LaeError: if a file of attributes is damaged.
    """
    anchors = dict.fromkeys(
        anchor
        for file in truth.files.values()
        for anchor in (truth.root, file.parent, file.parent.parent)
    )
    for anchor in anchors:
        if (anchor / "attributes.csv").is_file():
            return _from_csv(anchor / "attributes.csv", truth.files)
    attributes = {}
    folders = [anchor / name for anchor in anchors for name in _ATTRIBUTE_FOLDERS]
    folders = [folder for folder in folders if folder.is_dir()]
    for sequence in truth.files:
        for folder in folders:
            for suffix, names in _ATTRIBUTES_BY_SUFFIX.items():
                path = folder / f"{sequence}{suffix}.txt"
                if sequence not in attributes and path.is_file():
                    attributes[sequence] = _from_flags(path, names)
    return attributes


def _in_sequence_folders(root: Path) -> dict[str, Path]:
    """``<seq>/groundtruth_rect.txt``; with ``.1`` and ``.2`` for two targets in one video."""
    folders = _folders(root)
    nested = (path for folder in folders for path in _folders(folder) if _is_nested(path))
    return _per_sequence([root, *folders]) or _per_sequence(nested)


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
    return folder.parent.name if folder.name in _ANNOTATION_FOLDERS else folder.name


def _from_csv(path: Path, sequences: Iterable[str]) -> dict[str, tuple[str, ...]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            header, *rows = csv.reader(file)
    except (OSError, ValueError, csv.Error) as error:
        raise LaeError(f"{path}: not a table of attributes: {error}") from error
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


def _from_flags(path: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    flags = read_numbers(path).ravel()
    if len(flags) != len(names) or not np.isin(flags, (0, 1)).all():
        raise LaeError(f"{path}: needs {len(names)} flags 0 or 1: {', '.join(names)}")
    return _flagged(names, [str(int(flag)) for flag in flags])


def _flagged(names: Iterable[str], flags: Iterable[str]) -> tuple[str, ...]:
    return tuple(name for name, flag in zip(names, flags) if flag == "1")


_PART_OF_VIDEO = re.compile(r"[-_.](\d{1,2}|s)\Z")


def video_of(sequence: str) -> str:
    """The video that a sequence is part of, by its name.

    A number or an ``s`` at the end tells parts apart: ``car1_1``, ``car1_2`` and ``car1_s`` are one
    video, and so are ``Jogging-1`` and ``Jogging-2``.
    """
    return _PART_OF_VIDEO.sub("", sequence)
