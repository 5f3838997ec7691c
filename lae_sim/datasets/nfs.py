"""Need for Speed as it is downloaded: ``<seq>/<frames per second>/<seq>.txt`` in rows of VATIC.

The files of 30 and of 240 frames/s are the same, and for the former every eighth row counts; so do
the GOT-10k toolkit and others (https://github.com/got-10k/toolkit).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction
from math import gcd
from pathlib import Path

import numpy as np

from lae_sim._arrays import Bools, Floats
from lae_sim.datasets.numbers import read_lines
from lae_sim.errors import LaeError

_RATES = ("30", "240")
_THINNED = 8  # the truth of its 30 frames/s is that of 240
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


def find_nfs(root: Path, fps: Fraction | None) -> dict[str, Path]:
    """The annotation file of each sequence in a folder, or of the one whose folder it is.

    Args:
        root: the folder.
        fps: frames per second, to choose between its two sets.

    Raises:
        LaeError: if both sets are there and none is chosen, or the chosen one is not there.
    """
    rates: dict[str, dict[str, Path]] = {}
    for folder in [root, *sorted(path for path in root.iterdir() if path.is_dir())]:
        name = folder.resolve().name
        for rate in _RATES:
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


def rate_of(file: Path) -> Fraction | None:
    """The frames per second that the layout says of a file; None if it is not of NfS."""
    folder = file.resolve().parent
    if folder.name not in _RATES or folder.parent.name != file.stem:
        return None
    return Fraction(folder.name)


def is_vatic(line: str) -> bool:
    """Whether a line of a file is a row of VATIC."""
    return _VATIC.match(line) is not None


def read_lost(path: Path, frames: int | None = None) -> Bools | None:
    """Whether the target is lost, out of view, by an annotation file that says so: bool [T].

    Args:
        path, frames: as of :func:`lae_sim.datasets.annotations.read_truth`.

    Returns:
        None if the file is not of VATIC, and holds no such flags.

    Raises:
        LaeError: as :func:`lae_sim.datasets.annotations.read_truth`.
    """
    lines = read_lines(path)
    return read_vatic(path, lines, frames)[1] if is_vatic(lines[0]) else None


def read_vatic(path: Path, lines: Sequence[str], frames: int | None = None) -> tuple[Floats, Bools]:
    """One target that was annotated with VATIC.

    Args:
        path: the file.
        lines: of it.
        frames: how many the sequence has, if known (see
            :func:`lae_sim.datasets.annotations.read_truth`).

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


def _rows_of(count: int, frames: int, path: Path) -> slice:
    """Which rows are the truth of so many frames, if it fits but for the last one.

    Raises:
        LaeError: if what should have 30 frames/s has as many frames as the truth of 240.
    """
    step = 1
    if rate_of(path) == 30:
        thinned = -(-count // _THINNED)
        if count != frames and abs(thinned - frames) <= 1:
            step, count = _THINNED, thinned
        elif abs(count - frames) <= 1 and _is_same(path, path.parent.with_name("240") / path.name):
            raise LaeError(
                f"{path}: NfS's truth of 240 frames per second, and what has as many frames is of "
                "240 too: --fps 240"
            )
    return slice(0, frames * step if count == frames + 1 else None, step)


def _is_same(file: Path, other: Path) -> bool:
    return other.is_file() and file.read_bytes() == other.read_bytes()
