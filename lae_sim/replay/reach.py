"""A tracker's reach: how far from its last answer it still finds its target.

Restarts measure it. A tracker is initialised on the truth of a frame, and the next frame that it is
given is some frames later, when the target is some distance away. How often it is found falls with
that distance; the curve is the reach (a distribution, not a number: see :class:`Reach`). Distances
are ``max(|dx|, |dy|)`` between centres in units of :func:`lae_sim.boxes.search_side`, since search
regions are squares that grow with the target.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import iou, search_distance
from lae_sim.errors import LaeError
from lae_sim.trace.file import Trace
from lae_sim.trace.recording import Recording
from lae_sim.trace.restarts import RestartName

FOUND_IOU = 0.3
"""An answer that overlaps the truth more has found the target."""

LAPSE = 0.02
"""Share of targets that are missed however near they are: occluded, blurred, or wrongly annotated.
Without it, one such miss beside the start would widen the whole curve."""

LEAST_RESTARTS = 20
"""Fewer say nothing of a curve."""

# What is believed of the curve before any restart: the centre within a few search sides, and the
# logarithm of the spread, each a normal distribution (mean, standard deviation). Some hundred
# restarts outweigh it; data that a step separates need it, since they fit ever smaller spreads.
_CENTRE, _LOG_SPREAD = (0.75, 1.0), (float(np.log(0.1)), 1.0)
_CLOSE = 1e-9  # a step of centre and log spread that ends a fit


@dataclass(frozen=True)
class Restart:
    """One restart, and whether the target was found after its jump.

    Attributes:
        sequence: name of the sequence.
        start: frame on whose truth the tracker was initialised.
        gap: frames from there to the next frame that it was given.
        distance: how far the target had moved, in units of ``search_side`` of the start's truth.
        found: whether the answer overlaps the truth by more than :data:`FOUND_IOU`.
    """

    sequence: str
    start: int
    gap: int
    distance: float
    found: bool


@dataclass(frozen=True, eq=False)
class OwnJump:
    """A sequence's own jump: from the initialisation on its first frame, then followed a little.

    Attributes:
        sequence: name of the sequence.
        gap: the frame that followed frame 0.
        distance: how far the target had moved (see :class:`Restart`); NaN if that is unknown.
        frames: the frames processed after frame 0, ascending, the first ``gap``: int64 [n].
        answers: the tracker's box for each, float64 [n, 4].
        truth: the truth of each, float64 [n, 4]; NaN = none.
        found: whether the two overlap by more than :data:`FOUND_IOU`, bool [n]; False where there
            is no truth.
    """

    sequence: str
    gap: int
    distance: float
    frames: Ints
    answers: Floats
    truth: Floats
    found: Bools


@dataclass(frozen=True)
class Reach:
    """The share of targets that a tracker finds at a distance: a logistic curve that falls.

    ``P(found | d) = (1 - LAPSE) / (1 + exp((d - centre) / spread))``. Apart from lapses, that is
    how often a reach drawn from the logistic distribution exceeds ``d``.

    Attributes:
        centre: median of the reach, in units of ``search_side``.
        spread: scale of the logistic distribution.
        centre_error, spread_error: their standard errors.
        restarts: how many it was fitted to.
    """

    centre: float
    spread: float
    centre_error: float
    spread_error: float
    restarts: int

    @property
    def deviation(self) -> float:
        """Standard deviation of the reach, in units of ``search_side``."""
        return self.spread * math.pi / math.sqrt(3)

    def quantiles(self, n: int) -> Floats:
        """``n`` reaches that stand for the distribution, float64 [n], ascending, none below 0.

        They are its quantiles at ``(k + 1/2) / n``, k = 0, ..., n - 1.
        """
        p = (np.arange(n) + 0.5) / n
        reaches: Floats = np.maximum(self.centre + self.spread * np.log(p / (1 - p)), 0.0)
        return reaches

    def found(self, distance: npt.ArrayLike) -> Floats:
        """The share of targets found at a distance, of the shape of ``distance``."""
        z = (np.asarray(distance, np.float64) - self.centre) / self.spread
        share: Floats = (1 - LAPSE) * _logistic(-z)
        return share


def restarts_of(trace: Trace) -> list[Restart]:
    """The restarts of a gap pass whose truth is known, in the order of the trace.

    A sequence's own jumps are among them. Where it is not known how far the target moved, since
    the truth of one of the two frames is missing or has no size, the restart is left out.

    Raises:
        LaeError: if the trace is of another kind, or damaged.
    """
    found = []
    for name, recording in _restarted(trace):
        distance = _distance(recording, name.gap)
        if not np.isnan(distance):
            gap = slice(name.gap, name.gap + 1)
            hit = iou(recording.boxes[gap], recording.truth[gap])[0] > FOUND_IOU
            found.append(Restart(*name, distance, bool(hit)))
    return found


def own_jumps(trace: Trace) -> dict[str, list[OwnJump]]:
    """The own jumps of each sequence in a gap pass, gaps ascending: the restarts on frame 0.

    Raises:
        LaeError: if the trace is of another kind, or damaged.
    """
    jumps: dict[str, list[OwnJump]] = {}
    for name, recording in _restarted(trace):
        if name.start:
            continue
        frames = np.flatnonzero(recording.elapsed_ns >= 0)[1:]
        answers, truth = recording.boxes[frames], recording.truth[frames]
        hits = iou(answers, truth) > FOUND_IOU
        jump = OwnJump(
            name.sequence, name.gap, _distance(recording, name.gap), frames, answers, truth, hits
        )
        jumps.setdefault(name.sequence, []).append(jump)
    return {name: sorted(each, key=lambda jump: jump.gap) for name, each in jumps.items()}


def fit_reach(restarts: Iterable[Restart]) -> Reach | None:
    """The reach that restarts show, by maximum likelihood with a weak prior.

    The order of the restarts does not matter. Of each standard error the larger of two is given:
    that of the expected information, which takes restarts as independent of each other, and that
    of sequences that differ (the sandwich of Huber, 1967, with a sequence's restarts as one: Liang
    and Zeger, Biometrika 1986). On real sequences the second is several times the first.

    Returns:
        The curve; None if there are fewer than :data:`LEAST_RESTARTS`, or the target was always
        found or never: then the centre is only bounded.
    """
    outcomes = sorted((each.distance, each.found, each.sequence) for each in restarts)
    distance, found = np.array([row[:2] for row in outcomes], np.float64).reshape(-1, 2).T
    if len(outcomes) < LEAST_RESTARTS or found.all() or not found.any():
        return None
    prior = np.array([_CENTRE, _LOG_SPREAD])
    believed, precision = prior[:, 0], np.diag(prior[:, 1] ** -2.0)

    def objective(at: Floats) -> float:
        share = _share(at, distance)
        off = at - believed
        likelihood = np.where(found, np.log(share), np.log1p(-share)).sum()
        return float(likelihood - off @ precision @ off / 2)

    def slopes_and_information(at: Floats) -> tuple[Floats, Floats]:
        centre, spread = at[0], np.exp(at[1])
        share = _share(at, distance)
        steep = share * (1 - share / (1 - LAPSE))  # d share / d(-z), z = (d - centre) / spread
        by = steep * np.stack([np.full_like(distance, 1 / spread), (distance - centre) / spread])
        variance = share * (1 - share)
        return by * ((found - share) / variance), (by / variance) @ by.T + precision

    at = believed
    value = objective(at)
    for _ in range(200):  # Fisher's scoring; a handful of steps where the data are plenty
        slopes, information = slopes_and_information(at)
        step = np.linalg.solve(information, slopes.sum(axis=1) - precision @ (at - believed))
        while objective(at + step) < value and np.abs(step).max() > _CLOSE:
            step = step / 2
        at = at + step
        value = objective(at)
        if np.abs(step).max() <= _CLOSE:
            break
    slopes, information = slopes_and_information(at)
    covariance = np.linalg.inv(information)
    sandwich = covariance @ _between(slopes, [row[2] for row in outcomes]) @ covariance
    errors = np.sqrt(np.maximum(np.diag(covariance), np.diag(sandwich)))
    spread = float(np.exp(at[1]))
    return Reach(float(at[0]), spread, float(errors[0]), spread * float(errors[1]), len(outcomes))


def _between(slopes: Floats, sequences: Sequence[str]) -> Floats:
    """Covariance of the slopes of the likelihood between sequences, float64 [2, 2]; 0 of one."""
    names, which = np.unique(sequences, return_inverse=True)
    sums = np.array([np.bincount(which, row, len(names)) for row in slopes], np.float64)
    return sums @ sums.T * (len(names) / (len(names) - 1) if len(names) > 1 else 0.0)


def _share(at: Floats, distance: Floats) -> Floats:
    """P(found) for centre and log spread, kept off 0 so that its logarithm is finite."""
    z = (distance - at[0]) / np.exp(at[1])
    share: Floats = np.maximum((1 - LAPSE) * _logistic(-z), 1e-300)
    return share


def _logistic(z: Floats) -> Floats:
    """``1 / (1 + exp(-z))`` without overflow."""
    values: Floats = np.exp(-np.logaddexp(0.0, -z))
    return values


def _distance(recording: Recording, gap: int) -> float:
    """How far the target moved from the start, in units of its search side; NaN if unknown."""
    before, after = recording.truth[:1], recording.truth[gap : gap + 1]
    has_size = (after[:, 2:] > 0).all()
    return float(search_distance(before, after)[0]) if has_size else np.nan


def _restarted(trace: Trace) -> Iterator[tuple[RestartName, Recording]]:
    """The restarts of a gap pass, each with its recording: no truth where the target is absent."""
    if trace.metadata.kind != "restarts":
        raise LaeError(
            f"a trace of kind {trace.metadata.kind} has no restarts: "
            "give what 'lae-sim profile --gaps' left"
        )
    for recording in trace:
        name = RestartName.parse(recording.name)
        if name.gap >= len(recording) or recording.elapsed_ns[name.gap] < 0:
            raise LaeError(
                f"restart {recording.name!r}: frame {name.gap}, after the gap, was not processed"
            )
        if (recording.elapsed_ns[1 : name.gap] >= 0).any():
            raise LaeError(
                f"restart {recording.name!r}: a frame before {name.gap} was processed, so that was "
                "not the gap"
            )
        if recording.visible is not None:
            seen = np.where(recording.visible[:, None], recording.truth, np.nan)
            recording = replace(recording, truth=seen)
        yield name, recording
