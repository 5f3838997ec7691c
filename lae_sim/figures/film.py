"""Boxes and captions drawn on frames, with OpenCV."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats
from lae_sim.boxes import iou
from lae_sim.datasets.frames import Image
from lae_sim.errors import LaeError
from lae_sim.figures.style import forecaster_colours

if TYPE_CHECKING:
    from lae_sim.datasets.frames import ImageSequence
    from lae_sim.evaluation.evaluate import Answers
    from lae_sim.forecast.base import AnyFactory
    from lae_sim.replay.run import Run
    from lae_sim.trace.metadata import Metadata

WHITE, DARK = (255, 255, 255), (24, 24, 24)
Colour = tuple[int, int, int]
"""Blue, green, red."""


def colours_of(names: Iterable[str]) -> dict[str, Colour]:
    """The colour of each forecaster, as in all figures."""
    found = {}
    for name, colour in forecaster_colours(names).items():
        red, green, blue = bytes.fromhex(colour[1:])
        found[name] = (blue, green, red)
    return found


def draw_frame(
    image: Image,
    boxes: Mapping[str, npt.ArrayLike],
    truth: npt.ArrayLike | None = None,
    caption: Sequence[str] = (),
    width: int | None = None,
) -> Image:
    """Draw boxes on a copy of a frame, and what they are below it.

    The truth is white; forecasters have their colours, and their IoU with the truth.

    Args:
        image: uint8 [H, W, 3].
        boxes: ``x, y, w, h`` in pixels by name; NaN = none.
        truth: the ground truth, likewise.
        caption: words to put below.
        width: of the picture, pixels; by default the image's, but at least 640.
    """
    import cv2

    width = width or max(image.shape[1], 640)
    scale = width / image.shape[1]
    size = width, max(round(image.shape[0] * scale), 1)
    shrink = scale < 1
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    line = max(width // 320, 1)
    shown = [] if truth is None else [("truth", _row(truth), WHITE)]
    colours = colours_of(boxes)
    for name, box in boxes.items():
        shown.append((name + _overlap(truth, box), _row(box), colours[name]))
    for _, row, colour in shown:
        if np.isfinite(row).all():
            corners = np.concatenate([row[:, :2], row[:, :2] + row[:, 2:]]) * scale
            low, high = map(tuple, np.clip(np.rint(corners), -(2**14), 2**14).astype(int).tolist())
            cv2.rectangle(picture, low, high, (0, 0, 0), line + max(line // 2, 2), cv2.LINE_AA)
            cv2.rectangle(picture, low, high, colour, line, cv2.LINE_AA)
    lines = [[(text, WHITE) for text in caption], [(text, colour) for text, _, colour in shown]]
    bands = [_line(items, width) for items in lines if items]
    return np.concatenate([np.asarray(picture, np.uint8), *bands])


def fitted(picture: Image, height: int, width: int) -> Image:
    """A picture in another size, as large as it fits, on black."""
    import cv2

    if picture.shape[:2] == (height, width):
        return picture
    scale = min(height / picture.shape[0], width / picture.shape[1])
    across = min(max(round(picture.shape[1] * scale), 1), width)
    down = min(max(round(picture.shape[0] * scale), 1), height)
    filled = np.zeros((height, width, 3), np.uint8)
    filled[:down, :across] = cv2.resize(picture, (across, down), interpolation=cv2.INTER_AREA)
    return filled


def film_strip(pictures: Sequence[Image], columns: int | None = None) -> Image:
    """Put pictures of one size side by side, row by row.

    Args:
        pictures: uint8 [H, W, 3] each.
        columns: pictures in a row; by default so that the strip is about 16:9.

    Raises:
        LaeError: if there are none, or their sizes differ.
    """
    if len({picture.shape for picture in pictures}) != 1:
        raise LaeError("a film strip needs pictures of one size, and at least one")
    height, width = pictures[0].shape[:2]
    across = columns or int(np.ceil(np.sqrt(len(pictures) * height / width * 16 / 9)))
    gap = max(width // 160, 1)
    rows = -(-len(pictures) // across)
    across = columns or -(-len(pictures) // rows)  # as few empty places as can be
    strip = np.full((rows * (height + gap) - gap, across * (width + gap) - gap, 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // across) * (height + gap), (number % across) * (width + gap)
        strip[top : top + height, left : left + width] = picture
    return strip


def _row(box: npt.ArrayLike) -> Floats:
    return np.asarray(box, np.float64).reshape(1, 4)


def _overlap(truth: npt.ArrayLike | None, box: npt.ArrayLike) -> str:
    if truth is None:
        return ""
    none = np.isnan(_row(truth)).any()
    return " IoU -" if none else f" IoU {iou(_row(truth), _row(box))[0]:.2f}"


def _line(items: Sequence[tuple[str, Colour]], width: int) -> Image:
    """A dark band with words in their colours, smaller where they would not fit."""
    import cv2

    font, height = cv2.FONT_HERSHEY_SIMPLEX, max(width // 26, 15)
    lengths = [cv2.getTextSize(f"{text}   ", font, 1.0, 1)[0][0] for text, _ in items]
    scale = min(height / 44, width / (sum(lengths) + 20))
    band = np.full((height, width, 3), DARK, np.uint8)
    for (text, colour), before in zip(items, np.cumsum([20, *lengths])):
        place = round(scale * before), round(0.72 * height)
        thick = max(round(1.5 * scale), 1)
        cv2.putText(band, text, place, font, scale, colour, thick, cv2.LINE_AA)
    return band


def writes_h264() -> bool:
    """Whether films are H.264: whether PyAV is there, with its encoder."""
    try:
        from av.codec import codecs_available
    except ImportError:
        return False
    return "libx264" in codecs_available


Writer = Iterator[Callable[[Image], object]]
"""Gives a function that adds a picture to a film, uint8 [H, W, 3] of even sides."""


@contextmanager
def _h264(path: Path, fps: Fraction, width: int, height: int) -> Writer:
    """Write H.264 with PyAV, in the pixel format that all players take."""
    import av

    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream(
            "libx264", fps.limit_denominator(10**6), options={"crf": "20", "threads": "1"}
        )
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

        def write(picture: Image) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))

        yield write
        container.mux(stream.encode(None))


@contextmanager
def _mpeg4(path: Path, fps: Fraction, width: int, height: int) -> Writer:
    """Write MPEG-4 Part 2 with OpenCV, which says of nothing that it failed."""
    import cv2

    log = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_ERROR)  # it warns of each frame that it cannot write
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"mp4v"), float(fps), (width, height)
    )
    try:
        yield writer.write
    finally:
        writer.release()
        log.setLogLevel(level)


def frames_in(path: Path) -> int:
    """The number of frames that a film says it has; 0 if it cannot be read."""
    import cv2

    return max(0, int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)))


@dataclass(frozen=True, eq=False)
class Scene:
    """A replayed sequence with its frames: ``scene.draw(frame)`` is a picture of one.

    Attributes:
        run: the replayed sequence.
        images: the same sequence's frames.
        answers: what each forecaster answers for every world frame, by name.

    Example:
        >>> import lae_sim
        >>> images = lae_sim.find_dataset(sequences="car").sequences[0]
        >>> times = [47_000_000] * len(images)
        >>> recording = lae_sim.Recording.new("car", images.truth, images.truth, times)
        >>> trace = lae_sim.Trace(lae_sim.Metadata.new(30, "every-frame"), [recording])
        >>> run = next(iter(lae_sim.replay_trace(trace)))
        >>> scene = lae_sim.Scene.of(run, images, trace.metadata, {"hold": lae_sim.Hold})
        >>> scene.draw(20).shape
        (408, 640, 3)
    """

    run: Run
    images: ImageSequence
    answers: Mapping[str, Answers]

    @classmethod
    def of(
        cls,
        run: Run,
        images: ImageSequence,
        metadata: Metadata,
        forecasters: Mapping[str, AnyFactory],
    ) -> Scene:
        """The scene of a run and what forecasters make of it (see :func:`.evaluate.answers`).

        Raises:
            LaeError: if the frames are not as many as the run's.
        """
        from lae_sim.evaluation.evaluate import answers

        if len(images) != len(run):
            raise LaeError(
                f"sequence {run.recording.name!r} has {len(run)} frames in the trace and "
                f"{len(images)} images: is this the dataset that it was recorded on?"
            )
        found = {
            name: answers(run, metadata, name, factory) for name, factory in forecasters.items()
        }
        return cls(run, images, found)

    def draw(self, frame: int, width: int | None = None) -> Image:
        """Draw the boxes for a world frame on it; see `lae_sim.figures.film.draw_frame`.

        Raises:
            LaeError: if there is no such frame, or it cannot be read.
        """
        last = len(self.run) - 1
        if not 0 <= frame <= last:
            raise LaeError(f"sequence {self.run.recording.name!r} has frames 0 to {last}")
        source = next(iter(self.answers.values())).source_frame[frame]
        caption = (
            self.run.recording.name,
            f"frame {frame} of {last + 1}",
            f"{self.run.schedule.clock.arrival_ms(frame) / 1000:.3f} s",
            f"output of frame {source}, {frame - source} before",
        )
        boxes = {name: found.boxes[frame] for name, found in self.answers.items()}
        truth = self.run.recording.truth[frame]
        return draw_frame(self.images.read(frame), boxes, truth, caption, width)

    def film(self, path: str | Path) -> None:
        """Write an MP4 of all frames, whole or not at all, with a progress bar on a terminal.

        It shows as many frames a second as the world does, whenever each of them arrived. It is
        H.264, which browsers play, if PyAV is there (``pip install 'lae-sim[film]'``), and MPEG-4
        Part 2 by OpenCV otherwise.

        Raises:
            LaeError: if it cannot be written, or a frame cannot be read.
        """
        from lae_sim.files import written_whole
        from lae_sim.progress import ProgressBar

        first = self.draw(0)
        fill = [(0, side % 2) for side in first.shape[:2]] + [(0, 0)]  # codecs need even sides
        height, width = np.pad(first, fill).shape[:2]
        writer = _h264 if writes_h264() else _mpeg4
        bar = ProgressBar(Path(path).name, "frames")
        with written_whole(path) as temporary, bar:
            with writer(temporary, self.run.schedule.clock.fps, width, height) as write:
                for frame in range(len(self.run)):
                    picture = fitted(self.draw(frame), *first.shape[:2])
                    write(np.pad(picture, fill, "edge"))
                    bar(frame + 1, len(self.run))
            written = frames_in(temporary)
            if written != len(self.run):
                raise LaeError(
                    f"cannot write {path}: only {written} of {len(self.run)} frames were written: "
                    "the disk is full, or OpenCV has no codec"
                )

    def strip(self, frames: Sequence[int], width: int = 640) -> Image:
        """Pictures of some frames side by side, each ``width`` pixels wide."""
        pictures = [self.draw(frame, width) for frame in frames]
        return film_strip([fitted(picture, *pictures[0].shape[:2]) for picture in pictures])
