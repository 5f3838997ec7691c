"""The search model: a tracker finds its target only near the place where it searches.

A replay takes the box of a frame from a pass on which the tracker saw other frames before it, so it
finds the target again after any gap. A real tracker searches near its last answer. The model asks,
wherever the replay jumps farther than the pass did, whether the recorded box is *in reach* of that
answer; if not the tracker is *lost*, and answers what it answered last, until the recorded box of
a later frame is in reach again::

    recorded     b0 . b2 . . b5 b6 b7 b8        the replay jumps from 2 to 5: is b5 near b2?
    in reach     b0 . b2 . . b5 b6 b7 b8        yes: as recorded
    lost         b0 . b2 . . b2 b2 b7 b8        no; nor is b6, but b7 is near b2 again

No rule looks at the truth. How far a tracker reaches is a property of the tracker, measured by
restarts (:mod:`lae_sim.replay.reach`), and a distribution: a run draws it once, since what makes a
tracker miss a target lasts. The model of a run is what all likely reaches make of it, as few
distinct *outcomes* with their weights.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import lru_cache
from math import ceil, inf, log
from operator import index
from typing import Any

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import iou, resized, search_distance, search_region, search_side
from lae_sim.errors import LaeError, explained, listed
from lae_sim.forecast.base import AnyFactory, Forecaster, factory_for, resize
from lae_sim.replay.reach import (
    FOUND_IOU,
    OwnJump,
    Reach,
    Restart,
    fit_reach,
    own_jumps,
    restarts_of,
)
from lae_sim.replay.strides import phases
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import ImageSizes, Metadata
from lae_sim.trace.recording import Recording

SEARCHES = "off, trace, c=0.7, c=0.6-1.0"
"""How a search may be named."""

UNKNOWN_REACH = (0.6, 1.0)
"""The range that is shown where a tracker's reach is unknown, in units of its search region's half
side; that itself is 1 search side unless the tracker declares another. The measured reaches of four
trackers are .55 to .7 of what they declare."""

DRAWS = 40
"""Quantiles of the reach that stand for its distribution."""

_AGAIN = {True: 0.9, False: 0.1}
"""How often a lost target is found when it is in reach again. A tracker that learns learns whatever
it sees while it is lost; where that mattered in ``benchmarks/census.py``, eleven of fifteen closed
loops were nearer to never. The weights leave the mean nearly alone, and widen the interval."""

_NUMBER = re.compile(r"([0-9]+\.?[0-9]*|\.[0-9]+|inf)\Z")

_LEAST_SIDE = 1e-9  # pixels; of a box without a size, since infinity times 0 is NaN
_AS_LARGE = 0.25  # log of the ratio of two gaps up to which one says what comes of the other


@dataclass(frozen=True)
class ReachRange:
    """A reach as it is given: one number, or a range in which it is said to be.

    Attributes:
        low, high: in units of :func:`lae_sim.boxes.search_side`; equal if it is one number.
    """

    low: float
    high: float


def parse_search(text: str) -> str | ReachRange:
    """What is assumed of a tracker's reach: ``"off"``, ``"trace"``, ``"c=0.7"``, ``"c=0.6-1.0"``.

    Raises:
        LaeError: if the text is none of these.
    """
    if text in ("off", "trace"):
        return text
    name, equals, value = text.partition("=")
    try:
        if name != "c" or not equals:
            raise LaeError("unknown")
        first, dash, last = value.partition("-")
        low = _reach(first)
        high = _reach(last) if dash else low
        if low > high:
            raise LaeError("descends")
    except LaeError as error:
        raise LaeError(
            f"no search {text!r}: there are {SEARCHES}, where c is the reach in units of the "
            "search side, from 0 to inf"
        ) from error
    return ReachRange(low, high)


def _reach(text: str) -> float:
    if not _NUMBER.match(text):
        raise LaeError(f"{text!r} is no number from 0 on")
    return float(text)


@dataclass(frozen=True, eq=False)
class SearchModel:
    """What is known of where a tracker finds its target, and of where it searches.

    Attributes:
        reaches: reaches in units of :func:`lae_sim.boxes.search_side`, float64 [C], ascending, each
            as likely as the others; where the reach is not ``known`` the low end, the middle and
            the high end of a range.
        known: whether the reach was given or measured.
        source: where it is from, for reports.
        reach: the curve that restarts show, if there are any.
        jumps: own jumps by sequence, which outrank the curve.
        pre_forecaster: makes what says where the tracker searches, if that is not its last answer.
        keep_size: whether it says the centre only, and the size is that of the last answer.
    """

    reaches: Floats
    known: bool
    source: str
    reach: Reach | None = None
    jumps: Mapping[str, Sequence[OwnJump]] = field(default_factory=dict)
    pre_forecaster: AnyFactory | None = None
    keep_size: bool = False

    def outcomes(
        self,
        recording: Recording,
        frames: Ints,
        recorded: Sequence[RecordedAnswers],
        image_sizes: ImageSizes | None = None,
        times: Sequence[Any] | None = None,
    ) -> Outcomes:
        """What a tracker of each likely reach would have answered.

        Args:
            recording: the sequence, for the boxes of frames that own jumps went to.
            frames: processed frames, int64 [n].
            recorded: recorded answers for these frames: those that are replayed, and those of other
                runs that are likely.
            image_sizes: for the pre-forecaster, if known.
            times: the frames as the pre-forecaster is given them (``Clock.frame_time``), where they
                arrive at times of their own.
        """
        asked = frames.tolist() if times is None else times
        jumps = [jump for jump in self.jumps.get(recording.name, ()) if _recorded(recording, jump)]
        reaches = _within(self.reaches, recording, jumps) if self.known else self.reaches
        resumed = _resumed(recording, frames, jumps)
        rows = 1 if self.known else len(reaches)
        found: dict[bytes, tuple[Floats, float]] = {}
        weights: dict[bytes, Floats] = {}
        total = sum(answers.weight for answers in recorded)
        for answers in recorded:
            share = answers.weight / total
            walk = self._walker(recording, asked, answers, resumed, image_sizes)
            for again, part in _AGAIN.items() if self.reach is not None else ((True, 1.0),):
                each = share * part / (len(reaches) if self.known else 1)
                same_to = -inf
                for c, reach in enumerate(reaches.tolist()):
                    if reach > same_to:
                        boxes, lost, same_to = walk(reach, again)
                        key = boxes.tobytes()
                        found.setdefault(key, (boxes, float(lost.mean())))
                        weight = weights.setdefault(key, np.zeros(rows))
                    weight[0 if self.known else c] += each
        return Outcomes(
            tuple(boxes for boxes, _ in found.values()),
            np.array([lost for _, lost in found.values()]),
            np.stack(list(weights.values()), axis=1),
            self.known,
            self.pre_forecaster is not None,
        )

    def _walker(
        self,
        recording: Recording,
        frames: Sequence[Any],
        answers: RecordedAnswers,
        resumed: tuple[int, bool],
        image_sizes: ImageSizes | None,
    ) -> Callable[[float, bool], tuple[Floats, Bools, float]]:
        """What makes a run of a reach, and of whether a lost target is found again.

        It answers boxes [n, 4], which of them are lost [n], and the reach up to which it is so.
        """
        if self.pre_forecaster is None:
            return _Walk(answers, resumed)
        with explained(f"sequence {recording.name!r}: the pre-forecaster"):
            factory = factory_for(self.pre_forecaster, recording)

        def walk(reach: float, again: bool) -> tuple[Floats, Bools, float]:
            with explained(f"sequence {recording.name!r}: the pre-forecaster"):
                first = None if image_sizes is None else image_sizes.at(0)
                forecaster = factory(answers.boxes[0].tolist(), first)
                return _forecast_walk(
                    frames, answers, resumed, reach, again, forecaster, self.keep_size, image_sizes
                )

        return walk


@dataclass(frozen=True, eq=False)
class RecordedAnswers:
    """What a pass recorded for the frames that a replay processes.

    Attributes:
        boxes: float64 [n, 4].
        farther: whether the replay comes to a frame from farther back than the pass did, bool [n].
        weight: how likely they are, compared with others.
    """

    boxes: Floats
    farther: Bools
    weight: float = 1.0


@dataclass(frozen=True, eq=False)
class Outcomes:
    """The distinct runs that likely reaches make of one, R of them.

    Attributes:
        boxes: of the processed frames in each, R times float64 [n, 4].
        lost_share: share of the processed frames that each answers while it is lost, float64 [R].
        weights: how likely each is, float64 [1, R]; where the reach is not ``known`` a row for the
            low end, the middle and the high end of its range, float64 [3, R]. Rows add up to 1.
        known: whether the reach is.
        forecast: whether a pre-forecaster said where to search.
    """

    boxes: tuple[Floats, ...]
    lost_share: Floats
    weights: Floats
    known: bool
    forecast: bool = False

    @property
    def likeliest(self) -> Floats:
        """The boxes of the likeliest run, float64 [n, 4]; of the middle of an assumed range."""
        return self.boxes[int(self.weights[len(self.weights) // 2].argmax())]


class _Walk:
    """Runs of a tracker that searches at its last answer.

    It jumps from event to event: up to the next jump that is out of reach, all is as recorded; from
    there up to the next box in reach, nothing changes.
    """

    def __init__(self, answers: RecordedAnswers, resumed: tuple[int, bool]) -> None:
        self._boxes, self._farther = answers.boxes, answers.farther
        self._middle = answers.boxes[:, :2] + answers.boxes[:, 2:] / 2
        self._side = np.maximum(search_side(answers.boxes), _LEAST_SIDE)
        self._offset = np.abs(np.diff(self._middle, axis=0)).max(axis=1, initial=0.0)
        self._resumed = resumed

    def __call__(self, reach: float, again: bool) -> tuple[Floats, Bools, float]:
        n = len(self._boxes)
        source = np.arange(n)  # the output whose recorded box each output answers
        same_to = inf
        out = self._farther[1:] & ~(self._offset < reach * self._side[:-1])
        fails = np.flatnonzero(out) + 1
        k, found = self._resumed
        source[1:k] = 0
        k += found  # that output is as recorded, whatever the reach
        while k < n:
            if found:
                at = int(np.searchsorted(fails, k))
                if at == len(fails):
                    break
                k = int(fails[at])
            last = int(source[k - 1])
            rest = slice(k, None if again else k + 1)
            offset = np.abs(self._middle[rest] - self._middle[last]).max(axis=1)
            near = offset < reach * self._side[last]
            lost = int(near.argmax()) if near.any() else n - k
            source[k : k + lost] = last
            if lost:
                same_to = min(same_to, float(offset[:lost].min()) / float(self._side[last]))
            k, found = k + lost + 1, True
        return self._boxes[source], source != np.arange(n), same_to * (1 - 1e-12)


def _forecast_walk(
    frames: Sequence[Any],
    answers: RecordedAnswers,
    resumed: tuple[int, bool],
    reach: float,
    again: bool,
    forecaster: Forecaster,
    keep_size: bool,
    image_sizes: ImageSizes | None,
) -> tuple[Floats, Bools, float]:
    """The run of a tracker that searches where a pre-forecaster says; every call is tested."""
    rows = answers.boxes.tolist()
    answered, lost = [rows[0]], [False]
    same_to = inf
    resumed_at, found = resumed
    for k, (frame, box) in enumerate(zip(frames[1:], rows[1:]), 1):
        resize(forecaster, image_sizes, index(frame))
        predicted = forecaster.predict(frame)
        if keep_size:
            predicted = resized(predicted, answered[-1])
        size = None if image_sizes is None else image_sizes.at(index(frame))
        centre_x, centre_y, w, h = search_region(predicted, size)
        missed = k < resumed_at or (lost[-1] and k > resumed_at and not again)
        if not missed and (k > resumed_at or not found):
            offset = max(abs(box[0] + box[2] / 2 - centre_x), abs(box[1] + box[3] / 2 - centre_y))
            side = search_side(np.array([0.0, 0.0, w, h])).item()
            missed = not offset < reach * side
            if missed:
                same_to = min(same_to, offset / side)
        answered.append([centre_x - w / 2, centre_y - h / 2, w, h] if missed else box)
        lost.append(missed)
        forecaster.update(frame, answered[-1])
    return np.array(answered), np.array(lost), same_to * (1 - 1e-12)


def _within(reaches: Floats, recording: Recording, jumps: Sequence[OwnJump]) -> Floats:
    """Reaches that agree with a sequence's own jumps, where these agree with each other."""
    low, high = 0.0, inf
    for jump in jumps:
        distance, after = _outcome(recording, jump)
        if after == 0:
            low = max(low, distance)
        elif distance < high:
            high = distance
    return np.clip(reaches, low, high) if low <= high else reaches


def _resumed(recording: Recording, frames: Ints, jumps: Sequence[OwnJump]) -> tuple[int, bool]:
    """The output up to which a sequence's own jump says all, and whether it is found there.

    Where a sequence was seen to jump from its initialisation about as far as the first output does,
    it is known when the tracker finds the target again, or how long it does not. Before that output
    it is lost; without such a jump that is before the first, and the reach decides of all.
    """
    if len(frames) < 2:
        return 0, True
    first = int(frames[1])
    alike = [(abs(log(jump.gap / first)), jump) for jump in jumps if first > 2]
    alike = [each for each in alike if each[0] < _AS_LARGE]
    if not alike:
        return 0, True
    jump = min(alike, key=lambda each: (each[0], each[1].gap))[1]
    _, after = _outcome(recording, jump)
    if after is None:  # not while it was followed
        followed = int(jump.frames[-1]) - jump.gap
        return int(np.searchsorted(frames, first + followed, "right")), False
    return int(np.searchsorted(frames, first + after)), True


def _recorded(recording: Recording, jump: OwnJump) -> bool:
    """Whether the recording has boxes of all frames after the jump; it may be of fewer frames."""
    if not len(jump.frames) or jump.frames[-1] >= len(recording):
        return False
    return bool(np.isfinite(recording.boxes.take(jump.frames, axis=0)).all())


def _outcome(recording: Recording, jump: OwnJump) -> tuple[float, int | None]:
    """How far the recorded box was from the first one, in search sides, and when it was found.

    That is the number of frames after the jump until an answer overlaps the recorded box; None if
    none does. The truth has no say, as everywhere in the model.
    """
    recorded = recording.boxes.take(jump.frames, axis=0)
    (distance,) = search_distance(recording.boxes[:1], recorded[:1]).tolist()
    hits = np.flatnonzero(iou(jump.answers, recorded) > FOUND_IOU)
    return distance, int(jump.frames[hits[0]]) - jump.gap if len(hits) else None


def find_search(
    text: str,
    metadata: Metadata,
    gaps: Iterable[Trace] = (),
    pre_forecaster: AnyFactory | None = None,
    keep_size: bool = False,
) -> SearchModel | None:
    """What a trace and gap passes of its tracker know of its reach, or what is said of it instead.

    Args:
        text: see :func:`parse_search`.
        metadata: of the trace.
        gaps: traces of restarts.
        pre_forecaster, keep_size: see :class:`SearchModel`.

    Returns:
        None if the model is off, or the trace was recorded with a pre-forecaster.

    Raises:
        LaeError: if the text is no search, a trace is damaged, or both trace and replay have a
            pre-forecaster.
    """
    asked = parse_search(text)
    searched = metadata.pre_forecaster
    if searched is not None and pre_forecaster is not None:
        raise LaeError(
            f"the trace was recorded with the pre-forecaster {searched!r}: another one goes with a "
            "trace that was recorded without"
        )
    if asked == "off" or searched is not None:  # the model would have to search where that one did
        return None
    reach: Reach | None = None
    jumps: Mapping[str, Sequence[OwnJump]] = {}
    known, low, high = False, 0.0, 0.0
    if isinstance(asked, ReachRange):
        low, high, known = asked.low, asked.high, asked.low == asked.high
        source = f"c = {low:g}" + ("" if known else f" to {high:g}") + ", as given"
    else:
        gaps = tuple(gaps)
        reach, restarts, jumps = _measured(gaps, metadata.dataset)
        measured = f"{restarts:,} restart{'s' * (restarts != 1)}{_of_others(gaps, metadata)}"
        if reach is not None:
            known = True
            source = f"c = {reach.centre:.2f}, spread {reach.spread:.2f}, measured by {measured}"
        else:
            declared = metadata.search
            side = 1.0 if declared is None else declared.half_side
            low, high = (each * side for each in UNKNOWN_REACH)
            why = f" (not shown by {measured})" if gaps else ""
            source = f"c is unknown{why}, {low:g} to {high:g} assumed"
    if reach is not None:
        reaches = reach.quantiles(DRAWS)
    elif known:
        reaches = np.array([low])
    else:
        reaches = np.array([low, (low + high) / 2, high])
    return SearchModel(reaches, known, source, reach, jumps, pre_forecaster, keep_size)


@lru_cache(maxsize=8)  # a sweep asks in every world
def _measured(
    gaps: tuple[Trace, ...], dataset: str
) -> tuple[Reach | None, int, Mapping[str, Sequence[OwnJump]]]:
    """The curve that some gap passes show together, of how many restarts, and own jumps.

    A restart that two passes made counts once. Own jumps, by sequence, are those of a dataset: what
    is called alike in another is another sequence.
    """
    jumps: dict[str, list[OwnJump]] = {}
    restarts: dict[tuple[str, str, int, int], Restart] = {}
    for trace in gaps:
        of = trace.metadata.dataset
        if of == dataset or "unknown" in (of, dataset):
            for name, own in own_jumps(trace).items():
                jumps.setdefault(name, []).extend(own)
        for each in restarts_of(trace):
            restarts[of, each.sequence, each.start, each.gap] = each
    return fit_reach(restarts.values()), len(restarts), jumps


def _of_others(gaps: Iterable[Trace], metadata: Metadata) -> str:
    """Of which other trackers and datasets some gap passes are, in words; empty if of none."""
    all_of = [each.metadata for each in gaps]
    others = [of for of in all_of if not metadata.goes_with(of)]
    names = dict.fromkeys(f"of {of.tracker} on {of.dataset}" for of in others)
    some = ", some" if others and len(others) < len(all_of) else ""
    return f"{some} {listed(names)}" if others else ""


def phase_answers(
    stride: Fraction, recording: Recording, frames: Ints, weight: float
) -> list[RecordedAnswers]:
    """What each phase of a pass recorded for some frames, as a run of its own.

    A pass holds the box of a frame from the first phase that processed it. A phase's boxes of other
    frames are interpolated between its own, of which the nearest are at most a few frames away.

    Args:
        stride: of the pass.
        recording: of the pass.
        frames: int64 [n].
        weight: of all phases together.
    """
    seen = np.zeros(len(recording), bool)
    answers = []
    for held in phases(stride, len(recording)):
        own = held[~seen[held] | (held == 0)]
        seen[own] = True
        own = own[np.isfinite(recording.boxes[own, 0])]  # a real-time trace lacks some
        columns = [np.interp(frames, own, column) for column in recording.boxes[own].T]
        farther = np.diff(frames, prepend=0) > ceil(stride)
        answers.append(RecordedAnswers(np.stack(columns, axis=1), farther))
    return [replace(each, weight=weight / len(answers)) for each in answers]
