"""The attributes that datasets give their sequences, such as occlusion."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lae_sim.datasets.annotations import ATTRIBUTE_FOLDERS, GroundTruth
from lae_sim.datasets.numbers import read_numbers, read_text
from lae_sim.decoding import Budget
from lae_sim.errors import LaeError

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

_ATTRIBUTES_BY_SUFFIX = {
    "_att": (_UAVDT,),
    "_attr": (_VISDRONE,),
    "": (_UAV123, _DTB70, _DTB70[:10]),
}


@dataclass(frozen=True)
class Attributes:
    """A dataset's attributes, as far as they could be read.

    Attributes:
        of: those of each sequence, such as ``"Occlusion"``; empty if the dataset has none.
        notes: which files were left out, and why.
    """

    of: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


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
    folders = [anchor / name for anchor in anchors for name in ATTRIBUTE_FOLDERS]
    folders = [folder for folder in folders if folder.is_dir()]
    for sequence, folder in itertools.product(truth.files, folders):
        for suffix, known in _ATTRIBUTES_BY_SUFFIX.items():
            path = folder / f"{sequence}{suffix}.txt"
            if sequence not in attributes and path.is_file():
                try:
                    attributes[sequence] = _from_flags(path, known)
                except LaeError as error:
                    damaged.setdefault(sequence, error)
    errors = [error for name, error in damaged.items() if name not in attributes]
    return Attributes(attributes, left_out("attributes", errors, len(truth.files)))


def left_out(what: str, errors: Sequence[LaeError], sequences: int) -> tuple[str, ...]:
    """A note on what could not be read of some of the sequences, if there are any."""
    if not errors:
        return ()
    return (f"{what} of {len(errors)} of {sequences} sequences are left out, such as {errors[0]}",)


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
