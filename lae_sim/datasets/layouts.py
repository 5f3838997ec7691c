"""Datasets by name and folder: official layouts, plain folders of images, videos.

The ground truth says which sequences there are (see ``annotations``), and each one's images are
looked for where the official layouts have them; so no layout needs to be named.
"""

from __future__ import annotations

import difflib
import itertools
import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.datasets.absence import read_flags
from lae_sim.datasets.annotations import find_truth, read_truth
from lae_sim.datasets.attributes import read_attributes
from lae_sim.datasets.dropped import arrivals, ask, check_frame_times, missing, note, numbers_in
from lae_sim.datasets.frames import Dataset, Image, ImageSequence, Video, read_image
from lae_sim.datasets.names import SequenceNames
from lae_sim.datasets.synthetic import synthetic_dataset
from lae_sim.engine.clock import Number, parse_fps
from lae_sim.errors import LaeError, listed, shown
from lae_sim.files import sequence_names

_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
_FPS = {"UAV123_10fps": 10, "GOT-10k": 10}  # the others have 30
_SPELLINGS = {"uav123@10fps": "UAV123_10fps", "got10k": "GOT-10k", "got-10k": "GOT-10k"}
_BESIDE_TRUTH = ("img", "color", "")
_BESIDE_ANNOTATIONS = (
    "sequences/{}",
    "UAV-benchmark-S/{}",
    "data_seq/UAV123/{}",
    "data_seq/UAV123_10fps/{}",
    "data_seq/{}",
    "frames/{}",
    "{}/img",
    "{}",
)
# The number of the first image of OTB100's sequences that start late, by name and number of
# annotations: the benchmark's sequence configuration (https://github.com/jwlim/tracker_benchmark).
_OTB_FIRST = {
    ("BlurCar1", 742): 247,
    ("BlurCar3", 357): 3,
    ("BlurCar4", 380): 18,
    ("David", 471): 300,
    ("Tiger1", 349): 6,
}
# UAV123's clips <video>_1, <video>_2, ... share the video's images. Each starts with the last
# image of the one before, but for these (the dataset's configSeqs.m). At 10 frames/s every third
# image is left.
_CLIP = re.compile(r"(.+)_([1-9])\Z")
_CLIP_FIRST = {"bird1_2": 775, "bird1_3": 1573, "uav1_3": 2473}


def find_dataset(
    name: str | None = None,
    root: str | Path | None = None,
    sequences: str | Sequence[str] | None = None,
    box: Sequence[float] | None = None,
    fps: Number | None = None,
    frame_times: str | None = None,
) -> Dataset:
    """Find a dataset's images and ground truth.

    Args:
        name: what the dataset is called, such as ``"DTB70"``; by default as its folder. It chooses
            among several sets of annotations (UAV123 and UAV20L share a folder) and the frame
            rate.
        root: the dataset's folder, a folder of images, or a video file; by default the embedded
            synthetic dataset.
        sequences: names of those wanted; all by default.
        box: the first box ``x, y, w, h`` in pixels, for images or a video without ground truth.
        fps: frames per second; by default the dataset's (30, or 10 for UAV123_10fps and GOT-10k)
            or the video's own. Of NfS it chooses the set, of 30 or 240.
        frame_times: where numbers are missing among a sequence's images, as if the camera had
            dropped frames: ``"numbers"`` lets each image come at the time of its number, ``"even"``
            one after another. Without it such images are refused.

    Returns:
        The dataset. Where only the first box is known, the truth after it is NaN.

    Raises:
        LaeError: if something is missing or does not fit; it says what, and where.

    Example:
        >>> import lae_sim
        >>> dataset = lae_sim.find_dataset("synthetic", sequences=["car", "race"])
        >>> dataset.name, dataset.fps, [sequence.name for sequence in dataset.sequences]
        ('synthetic', Fraction(30, 1), ['car', 'race'])
        >>> dataset.sequences[0].read(0).shape
        (360, 640, 3)
    """
    sequences = None if sequences is None else sequence_names(sequences)
    fps = None if fps is None else parse_fps(fps)
    check_frame_times(frame_times)
    if box is not None and len(box) != 4:
        raise LaeError(f"box: x, y, w, h in pixels, not {shown(box)}")
    if not isinstance(root, (str, os.PathLike, type(None))):
        raise LaeError(f"root: the dataset's folder is a path, not {shown(root)}")
    if root is None:
        if box is not None:
            raise LaeError(
                "--box is of a video or images of yours: name them with --root (root=...)"
            )
        if name not in (None, "synthetic"):
            raise LaeError(
                f"give the folder of {name} with --root (root=...); only synthetic needs none"
            )
        synthetic = {sequence.name: sequence for sequence in synthetic_dataset().sequences}
        chosen = _choose(sequences, synthetic, "the synthetic dataset")
        return Dataset("synthetic", fps or Fraction(30), [synthetic[name] for name in chosen])
    root = Path(root)
    if root.is_file() or box is not None:
        return _without_truth(name, root, sequences, box, fps, frame_times)
    name = _SPELLINGS.get((name or "").lower(), name)
    named = root / "anno" / name if name else root
    truth = find_truth(named if named.is_dir() else root, fps)
    if name is None:
        first = next(iter(truth.files))
        name = "GOT-10k" if first.startswith("GOT-10k_") else truth.dataset
    attributes = read_attributes(truth)
    files = {each: truth.files[each] for each in _choose(sequences, truth.files, str(root))}
    found = [
        _sequence(root, each, file, attributes.of.get(each, ())) for each, file in files.items()
    ]
    flags = read_flags(files, {sequence.name: len(sequence) for sequence, _ in found})
    flagged = [
        (replace(sequence, visible=flags.visible.get(sequence.name)), numbers)
        for sequence, numbers in found
    ]
    fps = fps or truth.fps or Fraction(_FPS.get(name, 30))
    return _timed(name, fps, flagged, frame_times, (*attributes.notes, *flags.notes))


def _timed(
    name: str,
    fps: Fraction,
    sequences: Sequence[tuple[ImageSequence, Sequence[int]]],
    frame_times: str | None,
    notes: tuple[str, ...] = (),
) -> Dataset:
    """The dataset of sequences with the numbers of their images."""
    made = [sequence for sequence, _ in sequences]
    gaps = [(sequence.name, numbers) for sequence, numbers in sequences if missing(numbers)]
    if not gaps:
        return Dataset(name, fps, made, notes=notes)
    if frame_times is None:
        raise ask(*gaps[0], fps)
    if frame_times == "numbers":  # of all: a trace has the times of every frame, or of none
        made = [replace(each, arrival_ns=arrivals(numbers, fps)) for each, numbers in sequences]
    of_gaps = note((gap for gap, _ in gaps), frame_times)
    return Dataset(name, fps, made, frame_times, (*notes, of_gaps))


def _without_truth(
    name: str | None,
    root: Path,
    sequences: Sequence[str] | None,
    box: Sequence[float] | None,
    fps: Fraction | None,
    frame_times: str | None,
) -> Dataset:
    """A video or a folder of images of which only the first box is known."""
    if not root.exists():
        raise LaeError(f"{root}: no such file or folder")
    sequence = root.resolve().stem if root.is_file() else root.resolve().name
    _choose(sequences, [sequence], str(root))
    if box is None:
        raise LaeError(f"{root}: a video needs the target's first box: --box x,y,w,h")
    read: Callable[[int], Image]
    numbers: Sequence[int] = ()
    if root.is_file():
        read = video = Video(root)
        length, fps = len(video), fps or video.fps
        if fps is None:
            raise LaeError(f"{root}: does not say its frame rate; give it with --fps")
    else:
        if any(root.glob("groundtruth*.txt")):
            raise LaeError(f"{root}: has ground truth; --box is for images without")
        paths = _list_images(root / "img") or _list_images(root)
        if not paths:
            raise LaeError(f"{root}: no images there; --box needs a folder of images, or a video")
        read, length = partial(_read, sequence, paths), len(paths)
        numbers = _numbers(paths)
    truth = _only_first(np.array([box], np.float64), length)
    images = [(ImageSequence(sequence, truth, read), numbers)]
    return _timed(name or sequence, fps or Fraction(30), images, frame_times)


def _sequence(
    root: Path, name: str, file: Path, attributes: tuple[str, ...]
) -> tuple[ImageSequence, Sequence[int]]:
    """A sequence, and the numbers of its images."""
    paths, first = _find_images(root, name, file)
    truth = read_truth(file, len(paths))
    if len(truth) == 1:
        truth = _only_first(truth, len(paths))
    if len(paths) > len(truth):
        number = first or _OTB_FIRST.get((name, len(truth)))
        paths = _part(paths, number, len(truth), f"{paths[0].parent}, sequence {name!r}")
    if len(paths) < len(truth):
        raise LaeError(
            f"sequence {name!r}: {len(paths)} images in {paths[0].parent}, but {len(truth)} "
            f"annotations in {file}"
        )
    made = ImageSequence(name, truth, partial(_read, name, paths), attributes)
    return made, _numbers(paths)


def _find_images(root: Path, name: str, file: Path) -> tuple[list[Path], int | None]:
    """A sequence's images, and the number of its first one if others share the folder."""
    home, clip = file.parent, _CLIP.match(name)
    if file.name.startswith("groundtruth"):
        bases, patterns, folders = [home], list(_BESIDE_TRUTH), [name]
    else:
        bases = [root, home, home.parent, home.parent.parent]
        patterns, folders = list(_BESIDE_ANNOTATIONS), [name, *([clip[1]] if clip else [])]
    for folder in folders:
        for base, pattern in itertools.product(bases, patterns):
            paths = _list_images(base / pattern.format(folder))
            if paths:
                return paths, _clip_first(file) if folder != name else None
    looked = ", ".join(pattern.format(name) for pattern in patterns if pattern)
    raise LaeError(
        f"sequence {name!r}: no images found in {bases[0]}; looked in it, and in {looked}"
    )


def image_numbers(root: Path, name: str, file: Path, length: int) -> list[int]:
    """The numbers of a sequence's images, where they are beside its ground truth; else none.

    Args:
        root: the dataset's folder.
        name: the sequence's.
        file: its ground truth.
        length: number of frames.
    """
    try:
        paths, first = _find_images(root, name, file)
    except LaeError:
        return []
    numbers = _numbers(paths)
    if len(numbers) > length:
        first = first or _OTB_FIRST.get((name, length))
        start = numbers.index(first) if first in numbers else 0
        numbers = numbers[start : start + length]
    return numbers if len(numbers) == length else []


def _clip_first(file: Path) -> int:
    """The number of the first image of one of UAV123's clips, from the lengths before it."""
    first = _CLIP_FIRST.get(file.stem)
    if first:
        return (first - 1) // 3 + 1 if "10fps" in file.parent.name else first
    clip = _CLIP.match(file.stem)
    if not clip or clip[2] == "1":
        return 1
    before = file.with_name(f"{clip[1]}_{int(clip[2]) - 1}.txt")
    return _clip_first(before) + len(read_truth(before)) - 1


def _part(paths: list[Path], first: int | None, length: int, where: str) -> list[Path]:
    """``length`` images from number ``first``, or from the start; none may be missing between."""
    numbers = _numbers(paths)
    start = 0
    if first is not None:
        if first not in numbers:
            raise LaeError(f"{where}: no image number {first}, where the sequence starts")
        start = numbers.index(first)
    part = slice(start, start + length)
    doubtful = [
        *missing(numbers[part]),
        *(a for a, b in itertools.pairwise(numbers[part]) if a == b),
    ]
    if doubtful:
        raise LaeError(
            f"{where}: image number {doubtful[0]} is missing, or there twice, and there are "
            f"{len(paths)} images for {length} annotations: leave those that are annotated"
        )
    return paths[part]


def _numbers(paths: Sequence[Path]) -> list[int]:
    return numbers_in([path.stem for path in paths])


def _list_images(folder: Path) -> list[Path]:
    """The images in a folder, in the order of the numbers in their names."""
    if not folder.is_dir():
        return []
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    return sorted((path for path in paths if not path.name.startswith(".")), key=_natural)


def _natural(path: Path) -> list[str | int]:
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path.name)]


def _read(name: str, paths: list[Path], frame: int) -> Image:
    try:
        return read_image(paths[frame])
    except LaeError as error:
        raise LaeError(f"sequence {name!r}, frame {frame}: {error}") from error


def _only_first(first: Floats, length: int) -> Floats:
    truth = np.full((max(length, 1), 4), np.nan)
    truth[0] = first[0]
    return truth


def _choose(wanted: Sequence[str] | None, available: Iterable[str], where: str) -> list[str]:
    """The wanted names of those available, in their order; all of them if none is named."""
    names = list(available)
    known = SequenceNames(names)
    chosen = set()
    for name in wanted or ():
        meant = known.meant(name)
        if len(meant) != 1:
            close = difflib.get_close_matches(name, names) or names[:3]
            raise LaeError(
                f"{where}: no sequence {shown(name)} among {len(names)}; there is {listed(close)}"
            )
        chosen.update(meant)
    return [name for name in names if not wanted or name in chosen]
