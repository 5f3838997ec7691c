"""Sequences of a study looked at frame by frame: what was processed when, and what it answered.

A page can hold a few of them, with pictures of a part of their frames: see ``MOST_SEQUENCES``,
``MOST_FRAMES`` and ``MOST_BYTES``.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.boxes import iou
from lae_sim.datasets.frames import Image
from lae_sim.errors import LaeError, explained
from lae_sim.evaluation.evaluate import Answers, answers
from lae_sim.figures.film import Scene, images_of
from lae_sim.figures.style import forecaster_colours
from lae_sim.forecast.base import AnyFactory
from lae_sim.learning.folds import Trainer
from lae_sim.replay.run import Run
from lae_sim.study.cells import replayed
from lae_sim.study.records import SummaryRow
from lae_sim.study.summary import Scores, ranked
from lae_sim.study.view import View, run_of
from lae_sim.trace.file import read_held

if TYPE_CHECKING:
    from lae_sim.datasets.frames import ImageSequence
    from lae_sim.trace.metadata import Metadata

MOST_SEQUENCES, MOST_FORECASTERS = 3, 3
"""How many sequences are looked at, and forecasters in each, hold among them."""
MOST_FRAMES, MOST_PICTURES = 1500, 100
"""World frames of a sequence from its start, and pictures of successive ones among them."""
MOST_BYTES = 600_000
"""Of the pictures of a sequence, together."""
PICTURE_WIDTH, TARGET_WIDTH, QUALITY = 320, 200, 55
"""Of the pictures and of those of the target, at most: pixels; and percent, as JPEG has it."""
AROUND = 3
"""Sides of the target (the larger one) that a picture of it is wide."""

PIXELS = 8
"""Of the timeline for each frame interval."""
IOU_HEIGHT, AGE_HEIGHT, LANE_HEIGHT = 100, 40, 14
"""Of the plots and lanes of the timeline, pixels."""


@dataclass(frozen=True)
class Still:
    """A picture of a frame.

    Attributes:
        whole: the frame, small, a JPEG file.
        target: what is around the truth, likewise; empty if there is no truth.
        place: where that is, ``x, y, w, h`` in pixels of the frame.
    """

    whole: bytes
    target: bytes = b""
    place: tuple[int, int, int, int] = (0, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class CloseUp:
    """A sequence of a page.

    Attributes:
        run: the replayed sequence.
        why: why it was chosen.
        answers: what forecasters answer for every world frame, by name; hold is the first.
        size: width and height of its images, or of what holds all boxes, pixels.
        first: the frame of the first picture.
        pictures: of successive frames; none if there are no images.
    """

    run: Run
    why: str
    answers: Mapping[str, Answers]
    size: tuple[float, float]
    first: int
    pictures: Sequence[Still]

    @property
    def name(self) -> str:
        """The sequence's."""
        return self.run.recording.name

    @property
    def length(self) -> int:
        """World frames that are shown."""
        return min(len(self.run), MOST_FRAMES)

    @property
    def start(self) -> int:
        """The frame that is shown first."""
        return self.first + len(self.pictures) // 2

    @property
    def still(self) -> Still | None:
        """The picture of that frame."""
        return self.pictures[self.start - self.first] if self.pictures else None

    @property
    def colours(self) -> dict[str, str]:
        """Those of the forecasters."""
        return forecaster_colours(self.answers)

    @cached_property
    def overlaps(self) -> dict[str, Floats]:
        """The IoU of each forecaster with the truth, float64 [T]; NaN where there is no truth."""
        truth = self.run.recording.truth
        known = ~np.isnan(truth[:, 0])
        return {
            name: np.where(known, iou(truth, found.boxes), np.nan)
            for name, found in self.answers.items()
        }

    @cached_property
    def arrivals(self) -> Floats:
        """When each frame arrives, and one more, in nominal frame intervals, float64 [T + 1]."""
        clock = self.run.schedule.clock
        ticks = [clock.arrival(frame) for frame in range(self.length)]
        end = ticks[-1] + clock.frame_ticks
        return np.array([*ticks, end], np.float64) / clock.frame_ticks

    @property
    def width(self) -> float:
        """Of the timeline, pixels."""
        return float(PIXELS * self.arrivals[-1])

    @property
    def pictured(self) -> tuple[float, float]:
        """Where the frames with pictures begin on the timeline, and how wide they are, pixels."""
        begin, end = PIXELS * self.arrivals[[self.first, self.first + len(self.pictures)]]
        return float(begin), float(end - begin)

    def frames(self, taken: bool) -> str:
        """A path of the frames that were processed, or of those that were skipped."""
        processed = np.isin(np.arange(self.length), self.run.schedule.frames)
        at = self.arrivals[:-1][processed == taken]
        return _bars(at, np.full(len(at), 0.6))

    def calls(self) -> str:
        """A path of the times when the tracker was busy."""
        schedule = self.run.schedule
        interval = schedule.clock.frame_ticks
        shown = schedule.start < self.arrivals[-1] * interval
        start, ready = schedule.start[shown] / interval, schedule.ready[shown] / interval
        return _bars(start, np.minimum(ready, self.arrivals[-1]) - start - 0.12)

    def ages(self) -> str:
        """A path of how many frames old the answers are."""
        age = self.age[: self.length] * AGE_HEIGHT / max(self.oldest, 1)
        steps = [
            f"V{AGE_HEIGHT - high:.3g}H{PIXELS * x:.6g}" for high, x in zip(age, self.arrivals[1:])
        ]
        return f"M0 {AGE_HEIGHT}{''.join(steps)}V{AGE_HEIGHT}z"

    @cached_property
    def age(self) -> Any:
        """How many frames the answers are behind, int64 [T]."""
        source = next(iter(self.answers.values())).source_frame
        return np.arange(len(source)) - source

    @property
    def oldest(self) -> int:
        """The largest age that is shown, frames."""
        return int(self.age[: self.length].max())

    def line(self, forecaster: str) -> str:
        """A path of a forecaster's IoU."""
        path, command = [], "M"
        for x, y in zip(PIXELS * self.arrivals, self.overlaps[forecaster][: self.length]):
            if np.isnan(y):
                command = "M"
            else:
                path.append(f"{command}{x:.6g} {IOU_HEIGHT * (1 - y):.3g}")
                command = "L"
        return "".join(path)

    def ticks(self) -> Iterator[tuple[float, int]]:
        """Places of the timeline that are named, and their frames."""
        for frame in range(0, self.length, 10):
            yield float(PIXELS * self.arrivals[frame]), frame

    @property
    def boxes(self) -> dict[str, Sequence[float] | None]:
        """The boxes at the start, the truth and those of forecasters; None if there is none."""
        found = {"truth": self.run.recording.truth, **{n: a.boxes for n, a in self.answers.items()}}
        return {
            name: _plain(boxes[self.start : self.start + 1])[0] for name, boxes in found.items()
        }

    def document(self) -> str:
        """What the script of the page shows of each frame, as JSON."""
        shown = slice(self.length)
        truth, answered = self.run.recording.truth, self.answers.values()
        return json.dumps(
            {
                "pixels": PIXELS,
                "fps": float(self.run.schedule.clock.fps),
                "arrivals": np.round(self.arrivals[:-1], 3).tolist(),
                "ages": self.age[shown].tolist(),
                "boxes": [_plain(each[shown]) for each in (truth, *(a.boxes for a in answered))],
                "overlaps": [
                    [None if np.isnan(each) else round(each, 3) for each in values[shown].tolist()]
                    for values in self.overlaps.values()
                ],
                "first": self.first,
                "pictures": [
                    [_base64(each.whole), _base64(each.target), *each.place]
                    for each in self.pictures
                ],
            },
            separators=(",", ":"),
        )


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _bars(starts: Floats, lengths: Floats) -> str:
    """A path of bars."""
    return "".join(
        f"M{PIXELS * x:.6g} 0h{PIXELS * w:.4g}v{LANE_HEIGHT}h-{PIXELS * w:.4g}z"
        for x, w in zip(starts, np.maximum(lengths, 0.08))
    )


def _plain(boxes: Floats) -> list[Any]:
    """Boxes as JSON holds them; None if there is none."""
    known = np.isfinite(boxes.sum(axis=1)).tolist()
    return [row if ok else None for row, ok in zip(np.round(boxes, 1).tolist(), known)]


def close_ups(
    view: View, root: str | os.PathLike[str] | None = None
) -> tuple[list[CloseUp], list[str]]:
    """A few sequences of the best tracker of a study, at the setting that stands for all.

    They are those where its best forecaster wins most over hold, least, and as much as in half of
    them. Their traces are replayed again.

    Args:
        view: of the study.
        root: where the images of its first dataset are; synthetic sequences need none.

    Returns:
        The sequences, and what is to be said of them.
    """
    of_run = _best_run(view)
    rows = {name: view.row_of(scores) for name, scores in of_run.items()}
    factories = _factories(view, rows)
    setting = of_run["hold"].setting
    chosen = _chosen(view, of_run, next(reversed(factories)))
    said = [
        f"{len(chosen)} of {len(of_run['hold'].sequences):,} sequences of "
        f"{view.names[run_of(rows['hold'])]}, the best of the ranking, at the first sigma"
    ]
    if len(factories) < len(rows):
        said[0] += f"; of the forecasters {', '.join(factories)}"
    if any(row.modelled for row in rows.values()):
        said[0] += "; of the recorded boxes"
    try:
        with explained("failed"):
            trace = read_held(setting.trace.path, tuple(chosen))
            runs = {run.recording.name: run for run in reversed([*replayed(setting, trace)])}
            costs = {cell.forecaster: cell.cost_ns for cell in view.results.plan.cells}
            sigma = setting.world.sigmas[0]
            answered = {
                name: {
                    forecaster: answers(
                        runs[name], trace.metadata, forecaster, factory, sigma, costs[forecaster]
                    )
                    for forecaster, factory in factories.items()
                }
                for name in chosen
            }
    except LaeError as error:
        return [], [f"no sequence can be looked at: {error}"]
    found = []
    for name, why in chosen.items():
        images, problem = _images(runs[name], trace.metadata, root)
        said += [problem] if problem and problem not in said else []
        found.append(_close_up(runs[name], why, answered[name], trace.metadata, images))
    return found, said


def _best_run(view: View) -> dict[str, Scores]:
    """The scores of the best run of the first dataset, by forecaster."""
    dataset = view.standing[0].dataset
    rows = [row for row in view.standing if row.dataset == dataset]
    run = run_of(max(rows, key=lambda row: row.score("auc") or 0))
    standing = [scores for scores in view.results.scores if view.stands(view.row_of(scores))]
    return {scores.forecaster: scores for scores in standing if scores.setting.run == run}


def _factories(view: View, rows: Mapping[str, SummaryRow]) -> dict[str, AnyFactory]:
    """Hold and the best of the others that need not be trained, the best last."""
    known = view.results.plan.forecasters
    ready = {name: each for name, each in known.items() if not isinstance(each, Trainer)}
    others = sorted(
        (name for name in rows if name in ready and name != "hold"),
        key=lambda name: rows[name].score("auc") or 0,
    )
    return {name: ready[name] for name in ("hold", *others[1 - MOST_FORECASTERS :])}


def _chosen(view: View, of_run: Mapping[str, Scores], forecaster: str) -> dict[str, str]:
    """Sequences, and why each of them."""

    def aucs(name: str) -> Floats:
        scores = of_run[name]
        values: Floats = ranked(scores.means, view.rankings[scores.group])[:, 0]
        return values

    gains = aucs(forecaster) - (0 if forecaster == "hold" else aucs("hold"))
    order = [s for s in np.argsort(-gains, kind="stable").tolist() if np.isfinite(gains[s])]
    what = "AUC {:.3f}" if forecaster == "hold" else f"AUC {{:+.3f}} from hold to {forecaster}"
    found: dict[str, str] = {}
    for place, words in ((0, "the most"), (-1, "the least"), (len(order) // 2, "the median")):
        if order:
            s = order[place]
            found.setdefault(of_run["hold"].sequences[s], f"{what.format(gains[s])}: {words}")
    return dict([*found.items()][:MOST_SEQUENCES])


def _images(
    run: Run, metadata: Metadata, root: str | os.PathLike[str] | None
) -> tuple[ImageSequence | None, str]:
    """The images of a sequence, or why there are none."""
    try:
        images = images_of(run.recording, metadata, root)
        Scene.of(run, images, metadata, {}).images.read(0)
    except LaeError as error:
        if root is not None:
            return None, f"{run.recording.name}: no frames: {error}"
        return None, "without frames: lae-sim study --root says where the dataset's images are"
    return images, ""


def _close_up(
    run: Run,
    why: str,
    answered: Mapping[str, Answers],
    metadata: Metadata,
    images: ImageSequence | None,
) -> CloseUp:
    """A sequence, with pictures of where the last forecaster differs most from hold."""
    bare = CloseUp(run, why, answered, (1, 1), 0, ())
    overlaps = [*bare.overlaps.values()]
    telling = np.nan_to_num(overlaps[-1] - overlaps[0] if len(overlaps) > 1 else -overlaps[0])
    count = min(MOST_PICTURES, bare.length)
    sums = np.convolve(telling[: bare.length], np.ones(count), "valid")
    first = int(np.argmax(sums))
    if images is None:
        size = _extent([run.recording.truth, *(each.boxes for each in answered.values())])
        if sizes := metadata.image_sizes(run.recording.name):
            size = sizes.at(0)
        return CloseUp(run, why, answered, size, first + count // 2, ())
    height, width = images.read(first).shape[:2]
    pictures = _pictures(images, run.recording.truth, range(first, first + count))
    return CloseUp(run, why, answered, (width, height), first, [*pictures])


def _extent(boxes: Iterable[Floats]) -> tuple[float, float]:
    """Width and height of what holds some boxes, pixels."""
    ends = np.concatenate([each[:, :2] + each[:, 2:] for each in boxes])
    width, height = np.ceil(np.nanmax(np.where(np.isfinite(ends), ends, np.nan), axis=0))
    return max(float(width), 1.0), max(float(height), 1.0)


def _pictures(images: ImageSequence, truth: Floats, frames: range) -> Iterator[Still]:
    """Pictures of frames, as many as may be."""
    total = 0
    for frame in frames:
        image = images.read(frame)
        whole = _jpeg(image, PICTURE_WIDTH)
        still = Still(whole)
        height, width = image.shape[:2]
        x, y, w, h = truth[frame].tolist()
        if x == x:
            reach = AROUND * max(w, h, 8) / 2
            left, right = (round(min(max(x + w / 2 + s * reach, 0), width)) for s in (-1, 1))
            top, bottom = (round(min(max(y + h / 2 + s * reach, 0), height)) for s in (-1, 1))
            if left < right and top < bottom:
                target = _jpeg(image[top:bottom, left:right], TARGET_WIDTH)
                still = Still(whole, target, (left, top, right - left, bottom - top))
        total += len(still.whole) + len(still.target)
        if total > MOST_BYTES:
            return
        yield still


def _jpeg(image: Image, most: int) -> bytes:
    """A JPEG file of an image, so many pixels wide at most."""
    import cv2

    height, width = image.shape[:2]
    if width > most:
        size = most, max(1, round(height * most / width))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return encoded.tobytes()
