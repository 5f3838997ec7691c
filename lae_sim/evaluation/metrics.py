"""Success and precision under the conventions of the toolkits in use.

Success (Wu et al., OTB 2013): the share of frames with IoU > t; its AUC is the mean over thresholds
t. Precision: the share of frames whose centre error is <= t pixels; DP is at 20. Normalised
precision (Mueller et al., TrackingNet 2018): the error over the truth's width and height, at 0.20,
and the mean over 0, 0.01, ..., 0.50. With strict IoU > t and t up to 1, a perfect tracker's AUC is
20/21. Toolkits disagree on frames without a valid truth, by up to 30 points on the same boxes, so
each convention has a name. None of them scores a sequence without any truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lae_sim._arrays import Bools, Floats, Ints
from lae_sim.boxes import centre, iou
from lae_sim.errors import LaeError, hint, shown

CENTRE_THRESHOLDS = np.arange(51, dtype=np.float64)
NORM_THRESHOLDS = np.arange(51) / 100
DP_PIXELS = 20.0
NORM_DP = 0.20


@dataclass(frozen=True)
class Convention:
    """How a toolkit counts frames and thresholds.

    Attributes:
        name: its name here.
        valid: the truth counts for success if ``"size"`` (w > 0 and h > 0), ``"positive"`` (all of
            x, y, w, h > 0) or ``"finite"`` (no NaN).
        leaves_out: frames without a valid truth leave both metrics. Otherwise they are misses of
            success, and *hits* of precision.
        by_visible: so do frames whose target is said to be absent, as if they had no truth.
        of_all: shares are of all frames, those that are left out too.
        by_centre: the truth counts for precision where its centre is > 0 in x and y. Otherwise, and
            where frames are left out, it counts where it does for success.
        thresholds: number of IoU thresholds, evenly spaced from 0 to 1.
        first_frame_is_truth: the answer for frame 0 is replaced by the truth.
        keeps_answer: an answer that is not finite or has no positive size takes the one for the
            frame before.
        drops_zeros: sequences whose curve is 0 everywhere leave the mean over sequences.
    """

    name: str
    valid: Literal["size", "positive", "finite"]
    leaves_out: bool = False
    by_visible: bool = False
    of_all: bool = False
    by_centre: bool = True
    thresholds: int = 21
    first_frame_is_truth: bool = False
    keeps_answer: bool = False
    drops_zeros: bool = False

    @property
    def iou_thresholds(self) -> Floats:
        """IoU thresholds, float64, ascending."""
        steps = self.thresholds - 1
        return np.arange(self.thresholds) / steps

    def truth_of(self, truth: Floats, visible: Bools | None) -> Floats:
        """The truth that answers are held against, float64 [T, 4]; NaN = none.

        Args:
            truth: of every world frame, float64 [T, 4].
            visible: False where the target is said to be absent, bool [T]; None = nothing is said.
        """
        if not self.by_visible or visible is None:
            return truth
        return np.where(visible[:, None], truth, np.nan)

    def valid_success(self, truth: Floats) -> Bools:
        """Where the truth counts for success, bool [n]."""
        if self.valid == "size":
            return _all(truth[:, 2:] > 0)
        if self.valid == "positive":
            return _all(truth > 0)
        return _all(~np.isnan(truth))

    def valid_precision(self, truth: Floats) -> Bools:
        """Where the truth counts for precision, bool [n]."""
        if self.leaves_out or not self.by_centre:
            return self.valid_success(truth)
        return _all(centre(truth) > 0)

    def kept(self, answers: Floats) -> Ints:
        """Which answer counts for each frame of one sequence, int64 [T].

        Args:
            answers: for every world frame, float64 [T, 4].
        """
        frames = np.arange(len(answers))
        if not self.keeps_answer:
            return frames
        # calcSeqErrRobust.m of the OTB toolkit, before it replaces the first answer by the truth
        return np.maximum.accumulate(np.where(is_box(answers), frames, 0))


CONVENTIONS = {
    convention.name: convention
    for convention in (
        Convention("pysot", "size"),
        Convention("elae", "positive"),
        Convention(
            "otb",
            "positive",
            by_centre=False,
            first_frame_is_truth=True,
            keeps_answer=True,
            drops_zeros=True,
        ),
        # calc_seq_err_robust.m and eval_tracker.m of the LaSOT toolkit: absent frames are removed,
        # and the sums divided by all frames (https://github.com/HengLan/LaSOT_Evaluation_Toolkit)
        Convention("lasot", "finite", leaves_out=True, by_visible=True, of_all=True),
        Convention("got10k", "finite", leaves_out=True),
        Convention("got10k-101", "finite", leaves_out=True, thresholds=101),
        Convention("exclude", "size", leaves_out=True),
    )
}
"""How frames and thresholds count, by the names that arguments take.

Example:
    >>> import lae_sim
    >>> list(lae_sim.CONVENTIONS)
    ['pysot', 'elae', 'otb', 'lasot', 'got10k', 'got10k-101', 'exclude']
    >>> lae_sim.CONVENTIONS["got10k"].leaves_out
    True
"""


PYSOT = CONVENTIONS["pysot"]
"""The default: LAE-PVT and PVT++ use it."""


def find_convention(name: str) -> Convention:
    """A convention by name.

    Raises:
        LaeError: if there is none of that name.
    """
    if not isinstance(name, str) or name not in CONVENTIONS:
        known = ", ".join(CONVENTIONS) + hint(name, CONVENTIONS)
        raise LaeError(f"no convention {shown(name)}: there are {known}")
    return CONVENTIONS[name]


UNSCORED = "no sequence has a ground truth after its first frame"
"""Why there are no scores where :func:`is_scored` says so of all sequences."""


def is_scored(truth: Floats) -> bool:
    """Whether a sequence has a truth to score by: one on any frame after the first.

    The first may be no more than the box that initialises the tracker, as of a video or of a test
    set whose annotations are held back. A sequence of one frame is scored by it.

    Args:
        truth: of every world frame, float64 [T, 4]; NaN, or of no size, is none.
    """
    return bool(_all(truth[min(1, len(truth) - 1) :, 2:] > 0).any())


def is_box(boxes: Floats) -> Bools:
    """Where boxes are finite and have a positive size, bool [n]."""
    return _all(np.isfinite(boxes)) & _all(boxes[:, 2:] > 0)


METRICS = ("auc", "dp20", "norm_dp20", "norm_auc")
"""The scores of a sequence."""


@dataclass(frozen=True)
class FrameCounts:
    """What each answered frame adds to each metric's sum, before dividing.

    Attributes:
        success: IoU thresholds passed, whole numbers, float64 [n].
        precision: centre error thresholds passed, of 0..50 px, whole numbers, float64 [n].
        norm_dp: whether the normalised error is <= 0.20, bool [n].
        norm: normalised thresholds passed, whole numbers, float64 [n].
        apart: whether the truth counts for success and the answer does not overlap it at all, bool
            [n]: a failure, as VOT has it (Kristan et al., 2013).
    """

    success: Floats
    precision: Floats
    norm_dp: Bools
    norm: Floats
    apart: Bools

    @property
    def dp(self) -> Bools:
        """Whether the centre error is <= 20 px, bool [n]."""
        within: Bools = self.precision > CENTRE_THRESHOLDS[-1] - DP_PIXELS
        return within

    @property
    def within50(self) -> Bools:
        """Whether the centre error is <= 50 px, bool [n]."""
        return self.precision > 0


def frame_counts(
    truth: Floats, answers: Floats, frames: Ints, convention: Convention
) -> FrameCounts:
    """Count what each answer is worth.

    Args:
        truth, answers: boxes, float64 [n, 4]; a NaN truth is none.
        frames: the world frame of each, int64 [n].
        convention: which frames count.
    """
    if convention.first_frame_is_truth:
        answers = np.where((frames == 0)[:, None], truth, answers)
    truth, answers = np.asfortranarray(truth), np.asfortranarray(answers)  # fast by columns
    valid = convention.valid_success(truth)
    overlap = iou(truth, answers)
    overlap[~valid] = 0.0

    x, y = (centre(answers) - centre(truth)).T
    valid_centre = convention.valid_precision(truth)
    invalid_error = np.inf if convention.leaves_out else -1.0
    error = np.where(valid_centre, _length(x, y), invalid_error)
    w, h = np.where(truth[:, 2:] > 0, truth[:, 2:], np.nan).T
    with np.errstate(over="ignore"):  # a truth of almost no size: an infinite error is a miss
        norm_error = np.where(valid_centre, _length(x / w, y / h), invalid_error)
    # fmin: an error of NaN passes no threshold
    norm_error = np.fmin(np.maximum(norm_error, 0.0), 1.0)
    most = len(CENTRE_THRESHOLDS)
    norm_most = len(NORM_THRESHOLDS)
    return FrameCounts(
        success=_below(overlap, convention.thresholds - 1),
        precision=most - np.ceil(np.fmin(np.maximum(error, 0.0), most)),
        norm_dp=norm_error <= NORM_DP,
        norm=norm_most - np.minimum(_below(norm_error, 100), norm_most),
        apart=valid & (overlap == 0),
    )


def _below(values: Floats, steps: int) -> Floats:
    """How many of the thresholds 0, 1 / steps, 2 / steps, ... are below values in 0..1; exact.

    ``floor(values * steps)`` errs by rounding, but only where the threshold of that number is
    itself in doubt: all before it are below the value, and none after it is.
    """
    whole = np.floor(values * steps)
    below: Floats = whole + (whole / steps < values)
    return below


def _all(flags: Bools) -> Bools:
    """Where all columns hold."""
    every = flags[:, 0].copy()
    for column in flags.T[1:]:
        every &= column
    return every


def _length(x: Floats, y: Floats) -> Floats:
    length: Floats = np.square(x)
    length += np.square(y)
    return np.sqrt(length, out=length)


def success_curve(
    truth: Floats, answers: Floats, convention: Convention, visible: Bools | None = None
) -> Floats:
    """Success over the convention's IoU thresholds for one sequence, float64 [thresholds].

    It is NaN without a truth to score by (:func:`is_scored`).

    Args:
        truth, answers: boxes of every world frame, float64 [T, 4].
        convention: which frames count.
        visible: False where the target is said to be absent, bool [T]; None = nothing is said.
    """
    answers = answers[convention.kept(answers)]
    known = convention.truth_of(truth, visible)
    counts = frame_counts(known, answers, np.arange(len(truth)), convention)
    passed = counts.success[:, None] > np.arange(convention.thresholds)
    return _shares(passed, convention.valid_success(known), truth, convention)


def precision_curve(
    truth: Floats, answers: Floats, convention: Convention, visible: Bools | None = None
) -> Floats:
    """Precision over 0, 1, ..., 50 px for one sequence, float64 [51].

    It is NaN without a truth to score by (:func:`is_scored`).

    Args:
        truth, answers: boxes of every world frame, float64 [T, 4].
        convention: which frames count.
        visible: False where the target is said to be absent, bool [T]; None = nothing is said.
    """
    answers = answers[convention.kept(answers)]
    if convention.first_frame_is_truth:
        answers = np.concatenate([truth[:1], answers[1:]])
    known = convention.truth_of(truth, visible)
    valid = convention.valid_precision(known)
    error = np.where(valid, _length(*(centre(answers) - centre(known)).T), -1.0)
    return _shares(error[:, None] <= CENTRE_THRESHOLDS, valid, truth, convention)


def _shares(passed: Bools, valid: Bools, truth: Floats, convention: Convention) -> Floats:
    """The share of the frames that count which passed each threshold, from bool [T, N]."""
    if convention.leaves_out:
        passed = passed[valid]
    frames = len(valid) if convention.of_all else len(passed)
    scored = frames > 0 and is_scored(truth)
    shares: Floats = passed.sum(axis=0) / (frames if scored else np.nan)
    return shares
