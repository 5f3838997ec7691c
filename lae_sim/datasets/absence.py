"""Flags of absence: the frames in which a dataset says that its target is not to be seen.

Known are those of LaSOT (``full_occlusion.txt``, ``out_of_view.txt``; in its evaluation toolkit
``absent/<seq>.txt``), of GOT-10k (``absence.label``, ``cover.label``), of NfS (in its truth), of
AVisT (``full_occlusion/<seq>_full_occlusion.txt``, ``out_of_view/<seq>_out_of_view.txt``) and of
VOT's long-term and depth challenges (``full-occlusion.tag``, ``out-of-frame.tag``, and not
``occlusion.tag``, which may be of a part of the target).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lae_sim._arrays import Bools
from lae_sim.datasets.attributes import left_out
from lae_sim.datasets.nfs import read_lost
from lae_sim.datasets.numbers import NUMBER, read_lines
from lae_sim.errors import LaeError, shown

# The values that a file may hold, and those of them that say that the target is absent.
_FLAG = (range(2), (1,))
# Eighths of the target that are visible, from 0 to 8: the GOT-10k toolkit takes 0 for not visible
# (got10k/experiments/got10k.py, https://github.com/got-10k/toolkit).
_COVER = (range(9), (0,))
_Rule = tuple[range, tuple[int, ...]]

_BESIDE_TRUTH: Mapping[str, _Rule] = {
    "full_occlusion.txt": _FLAG,
    "out_of_view.txt": _FLAG,
    "full-occlusion.tag": _FLAG,
    "out-of-frame.tag": _FLAG,
    "absence.label": _FLAG,
    "cover.label": _COVER,
}
_OF_FLAT_FILES: Mapping[str, _Rule] = {
    "absent/{}.txt": _FLAG,
    "../full_occlusion/{}_full_occlusion.txt": _FLAG,
    "../out_of_view/{}_out_of_view.txt": _FLAG,
}


@dataclass(frozen=True)
class Flags:
    """A dataset's flags of absence, as far as they could be read.

    Attributes:
        visible: of the sequences that have any: False where the target is absent or fully covered,
            bool [T].
        notes: which were left out, and why.
    """

    visible: Mapping[str, Bools]
    notes: tuple[str, ...] = ()


def absence_files(truth: Path) -> dict[Path, _Rule]:
    """The files with flags of absence that go with a file of ground truth."""
    folder = truth.parent
    if truth.name.startswith("groundtruth"):
        files = {folder / name: rule for name, rule in _BESIDE_TRUTH.items()}
    else:
        files = {folder / name.format(truth.stem): rule for name, rule in _OF_FLAT_FILES.items()}
    return {path: rule for path, rule in files.items() if path.is_file()}


def read_flags(truth: Mapping[str, Path], frames: Mapping[str, int]) -> Flags:
    """Where targets are visible, as far as the dataset says so.

    Such files are an extra: where one is damaged, none of the sequence's flags count, and a note
    says so.

    Args:
        truth: the file of ground truth of each sequence.
        frames: how many frames each has.
    """
    visible: dict[str, Bools] = {}
    errors = []
    for name, file in truth.items():
        try:
            flags = _read(file, frames[name])
        except LaeError as error:
            errors.append(error)
            continue
        if flags is not None:
            visible[name] = flags
    return Flags(visible, left_out("flags of absence", errors, len(truth)))


def _read(truth: Path, frames: int) -> Bools | None:
    absent = [_absent(path, rule, frames) for path, rule in absence_files(truth).items()]
    lost = read_lost(truth, frames)
    absent += [] if lost is None else [lost]
    return ~np.logical_or.reduce(absent) if absent else None


def _absent(path: Path, rule: _Rule, frames: int) -> Bools:
    cells = re.findall(r"[^\s,;]+", " ".join(read_lines(path)))
    known, absent = rule
    for cell in cells:
        if not (NUMBER.match(cell) and float(cell) in known):
            raise LaeError(
                f"{path}: flags are whole numbers from 0 to {known[-1]}, not {shown(cell)}"
            )
    values = np.array(cells, np.float64)
    if path.suffix == ".tag" and len(values) < frames:  # the VOT toolkit takes 0 for the rest
        values = np.pad(values, (0, frames - len(values)))
    if len(values) != frames:
        raise LaeError(f"{path}: {len(values)} flags, and there are {frames} frames")
    flags: Bools = np.isin(values, absent)
    return flags
