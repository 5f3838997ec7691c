"""Image sequences: what a tracker is run on, and how its frames are decoded."""

from __future__ import annotations

import contextlib
import math
import struct
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.decoding import Budget, allowing, read_bytes
from lae_sim.errors import LaeError

_THREADS = 4
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG, _SCAN, _END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"

Image = npt.NDArray[np.uint8]
"""A frame as OpenCV has it: uint8 [H, W, 3], blue, green, red."""


@dataclass(frozen=True, eq=False, repr=False)
class ImageSequence:
    """One sequence of a dataset.

    Attributes:
        name: the sequence's name, unique within its dataset.
        truth: ground truth boxes ``x, y, w, h`` in pixels, float64 [T, 4]; NaN = none. The first
            row is the initial box.
        read: ``read(frame)`` decodes (or renders) a frame, in any order, from any thread.
        attributes: the dataset's attributes of the sequence, such as ``"Occlusion"``.
        visible: False where the dataset says that the target is absent or fully covered, bool [T];
            None = it says nothing.
        arrival_ns: when each frame arrives, ns after the first, int64 [T], ascending from 0; None =
            at the dataset's frame rate.
    """

    name: str
    truth: Floats
    read: Callable[[int], Image]
    attributes: tuple[str, ...] = ()
    visible: Bools | None = None
    arrival_ns: Ints | None = None

    def __len__(self) -> int:
        """Number of frames T."""
        return len(self.truth)

    def __repr__(self) -> str:
        return f"<ImageSequence {self.name!r}: {len(self):,} frames>"


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Sequences that belong together.

    Attributes:
        name: the dataset's name, such as ``"DTB70"``.
        fps: its frame rate, frames per second, exact.
        sequences: sorted by name.
        frame_times: how frames come where image numbers are missing: ``"numbers"`` or ``"even"``;
            None where none is.
        notes: what a user should know of them: files beside the images and the truth that could not
            be read and why, and image numbers that are missing.
    """

    name: str
    fps: Fraction
    sequences: Sequence[ImageSequence]
    frame_times: str | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<Dataset {self.name!r}: {len(self.sequences)} sequences at {self.fps} fps>"


def read_image(path: Path) -> Image:
    """Decode an image file as uint8 [H, W, 3]; grey and 16-bit images are converted.

    The pixels are as stored: an orientation in the file's metadata is ignored, since annotations
    are of the stored pixels.

    Raises:
        LaeError: if the file is missing, no image, cut off, or takes too much memory.
    """
    import cv2

    data = read_bytes(path, Budget(path))
    Budget(path).take(3 * math.prod(_declared_size(data)))
    # Many builds of OpenCV decode a JPEG that was cut off, and fill the rest with grey.
    cut = data.startswith(_JPEG) and data.find(_END, max(data.rfind(_SCAN), 0)) < 0
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = None
    with contextlib.suppress(cv2.error):  # of a damaged header
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and not cut else None
    if image is None:
        state = "empty" if not data else "cut off" if cut else "damaged, or no image"
        raise LaeError(f"{path}: cannot be decoded: the file is {state}")
    return np.asarray(image, np.uint8)


def _declared_size(data: bytes) -> tuple[int, int]:
    """Width and height that the head of a PNG, BMP or JPEG file declares; 0, 0 of any other."""
    if data.startswith(_PNG) and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    if data.startswith(b"BM") and len(data) >= 26:
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)  # a negative height means from the top
    at = 2 if data.startswith(_JPEG) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of a frame
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 1 if marker == 0xFF else 2 + length  # fill bytes, or another segment
    return 0, 0


class Video:
    """A video file: ``video(frame)`` decodes a frame, in any order, from any thread.

    Seeking in a video is inexact in many containers, so frames are counted by decoding: going
    forward decodes what is between, and going back starts again. So are all frames at first, since
    headers are often wrong.

    Attributes:
        fps: frames per second, exact; None where the file does not say.

    Raises:
        LaeError: if the file is missing or holds no frames that can be decoded.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._restart()
        self.fps = _exact_rate(self._capture)
        self._length = 0
        while self._capture.grab():
            self._length += 1
        if not self._length:
            raise LaeError(f"{path}: no frame of this video can be decoded")
        self._restart()

    def __len__(self) -> int:
        """Number of frames that can be decoded."""
        return self._length

    def __call__(self, frame: int) -> Image:
        """Decode a frame, uint8 [H, W, 3].

        Raises:
            LaeError: if it cannot be decoded.
        """
        with self._lock:
            if frame not in self._recent:
                if frame < self._next:
                    self._restart()
                while self._next <= frame:
                    decoded, image = self._capture.read()
                    if not decoded:
                        raise LaeError(f"{self._path}: frame {self._next} cannot be decoded")
                    # Threads that read one block ask for its frames slightly out of order.
                    self._recent[self._next] = image
                    self._recent.pop(self._next - 2 * _THREADS, None)
                    self._next += 1
            return self._recent[frame].copy()

    def _restart(self) -> None:
        import cv2

        if not self._path.is_file():
            raise LaeError(f"{self._path}: no such file")
        self._capture: Any = cv2.VideoCapture(str(self._path))
        if not self._capture.isOpened():
            raise LaeError(f"{self._path}: not a video that OpenCV can open")
        self._recent: dict[int, Image] = {}
        self._next = 0


class Buffered:
    """Reads ahead: ``buffered(frame)`` is ``read(frame)``, decoded a block at a time.

    A frame that is not held is decoded together with the frames after it, in a few threads, before
    the call returns. Nothing runs between calls: a thread that decoded in the background would
    take time from the tracker that is being timed. Of frames asked for at equal steps, only those
    are decoded.

    Args:
        read: decodes a frame; called from several threads.
        length: number of frames.
        size, max_bytes: bounds of what is held, but at least one frame.
    """

    def __init__(
        self,
        read: Callable[[int], Image],
        length: int,
        size: int = 16,
        max_bytes: int = 256 << 20,
    ) -> None:
        self._read, self._length = read, length
        self._size, self._max_bytes = size, max_bytes
        self._held: dict[int, Image | Exception] = {}
        self._asked = [0, 0]  # the last two

    def __call__(self, frame: int) -> Image:
        """The frame, uint8 [H, W, 3].

        Raises:
            Exception: what ``read`` raised for this frame; a block's other frames are unharmed.
        """
        before, last = self._asked
        self._asked = [last, frame]
        if frame not in self._held:
            first = self._read(frame)
            step = frame - last if frame - last == last - before > 0 else 1
            count = min(self._size, self._max_bytes // max(first.nbytes, 1))
            ahead = range(frame + step, min(frame + step * count, self._length), step)
            with ThreadPoolExecutor(_THREADS) as pool:
                read = allowing(self._attempt)
                self._held = {frame: first, **dict(zip(ahead, pool.map(read, ahead)))}
        image = self._held[frame]
        if isinstance(image, Exception):
            raise image
        return image.copy()

    def _attempt(self, frame: int) -> Image | Exception:
        try:
            return self._read(frame)
        except Exception as error:  # raised when, and only if, this frame is asked for
            return error


def _exact_rate(capture: Any) -> Fraction | None:
    """The rate that a container's rounded float means: 29.97 is 30000/1001."""
    import cv2

    rate = float(capture.get(cv2.CAP_PROP_FPS))
    if not 0 < rate < 10_000:
        return None
    usual = Fraction(round(rate)), Fraction(round(rate * 1.001) * 1000, 1001)
    meant = [fps for fps in usual if abs(float(fps) / rate - 1) < 2e-5]
    return meant[0] if meant else Fraction(rate).limit_denominator(1000)
