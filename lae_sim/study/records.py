"""The records of a study's results, and the flat rows that its JSON and CSV files hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from lae_sim.comparison.statistics import Difference, Interval, Recovered

MEAN = "mean"
"""Stands for sigma where scores are plain means over all permitted latencies (mAUC, mDP)."""

Plain = str | int | float | None


def run_name(trace: str, times_from: str) -> str:
    """The name of a trace with its times: that of another trace too, if they come from there."""
    return trace if times_from == trace else f"{trace} at {times_from}"


class Record:
    """What the results of a study consist of."""

    __slots__ = ()

    def flat(self) -> dict[str, Plain]:
        """The flat row of JSON and CSV: unknown values are None, what is not asked has no key."""
        return _plain(self)


def _plain(record: Any, until: str = "") -> dict[str, Plain]:
    """The fields of a record, up to one of them; exact numbers as text."""
    row: dict[str, Plain] = {}
    for name in record.__dataclass_fields__:
        if name == until:
            break
        value = getattr(record, name)
        row[name] = str(value) if isinstance(value, Fraction) else value
    return row


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """How sure the mean of a score is, and what is won over hold.

    Attributes:
        interval: of the mean over sequences, bootstrapped.
        jitter: the range of 95 % of the repetitions' means; None of one repetition.
        vs_hold: the paired difference to hold; None of hold itself.
        recovered: the share of the loss won back; None of hold, and where a trace lacks boxes.
    """

    interval: Interval
    jitter: Interval | None = None
    vs_hold: Difference | None = None
    recovered: Recovered | None = None

    def columns(self, metric: str) -> dict[str, Plain]:
        """Values by their keys in a flat row."""
        is_modelled = metric.startswith("modelled_")  # whose own interval is the model's
        row = self.interval.columns(f"{metric}_bootstrap" if is_modelled else metric)
        if self.jitter is not None:
            row |= self.jitter.columns(f"{metric}_jitter")
        if self.vs_hold is not None:
            name = f"vs_hold_{metric}"
            row |= {name: self.vs_hold.value, **self.vs_hold.interval.columns(name)}
            row[f"{name}_p"] = self.vs_hold.p
        if self.recovered is not None:
            name = f"recovered_{metric}"
            if self.recovered.share is not None:
                row[name] = self.recovered.share
            if self.recovered.interval is not None:
                row |= self.recovered.interval.columns(name)
        return dict(row)


@dataclass(frozen=True, slots=True)
class Behind:
    """How far a tracker and forecaster is behind the best of its setting.

    Attributes:
        best: run and forecaster of the best.
        difference: of the mean AUC that is ranked, to the best's, paired over the sequences.
        p_holm: p of the difference, corrected for the number of those compared with the best.
    """

    best: tuple[str, str]
    difference: Difference
    p_holm: float

    def columns(self) -> dict[str, Plain]:
        """Values by their keys in a flat row."""
        name = "vs_best_auc"
        return {
            "best": " with ".join(self.best),
            name: self.difference.value,
            **self.difference.interval.columns(name),
            f"{name}_p": self.difference.p,
            f"{name}_p_holm": self.p_holm,
        }


@dataclass(frozen=True, slots=True)
class Staleness:
    """How old answers are, and when they first miss the target.

    Attributes:
        mismatch_mean: age of the outputs that answer, frames.
        age_ms, age_max_ms: the same in world time, sigma included; mean and largest.
        longest_stale_ms: longest time that one output answered.
        failed: share of sequences and repetitions in which an answer misses the target wholly;
            only at the first sigma, and of those with a truth to score by.
        time_to_failure_ms: median time to the first such answer (Kaplan and Meier); None if less
            than half fail.
    """

    mismatch_mean: float
    age_ms: float
    age_max_ms: float
    longest_stale_ms: float
    failed: float | None = None
    time_to_failure_ms: float | None = None

    def columns(self) -> dict[str, Plain]:
        """Values by their keys in a flat row."""
        return _plain(self, until="failed" if self.failed is None else "")


@dataclass(frozen=True, slots=True)
class Consumption:
    """What a tracker takes from its device, where the power during its calls was measured.

    Attributes:
        joules_per_frame: energy of the device during a call, J.
        joules_above_idle: the part above the power at rest, J; None if that was not measured.
        watts: mean power of the device while it tracks in this world: that at rest, and what each
            processed frame takes above it; None if that is not known.
        pareto: whether no other trace takes less energy for a call and is better.
    """

    joules_per_frame: float
    joules_above_idle: float | None
    watts: float | None
    pareto: bool = False

    def columns(self, auc: float | None) -> dict[str, Plain]:
        """Values by their keys in a flat row, with the AUC that is ranked."""
        return {
            "joules_per_frame": self.joules_per_frame,
            "joules_above_idle": self.joules_above_idle,
            "watts": self.watts,
            "auc_per_watt": None if auc is None or not self.watts else auc / self.watts,
            "energy_pareto": self.pareto,
        }


@dataclass(frozen=True, slots=True)
class Modelled:
    """Mean scores under the search model.

    Attributes:
        known: whether the reach is known (see :class:`lae_sim.evaluation.modelled.ModelledScores`).
        lost_share: share of the outputs answered while the target is lost.
        scores: mean AUC and DP in 0..1; None if unknown.
        intervals: of these, as far as reach, phases and what is unexplained go; in the rows of the
            first sigma and of the mean over the grid.
    """

    known: bool
    lost_share: float
    scores: Mapping[str, float | None]
    intervals: Mapping[str, Interval] = field(default_factory=dict)

    def columns(self) -> dict[str, Plain]:
        """Values by their keys in a flat row."""
        row: dict[str, Plain] = {"c_known": self.known, "lost_share": self.lost_share}
        for metric, score in self.scores.items():
            row[f"modelled_{metric}"] = score
            if metric in self.intervals:
                row |= self.intervals[metric].columns(f"modelled_{metric}")
        return row


@dataclass(frozen=True, slots=True)
class SummaryRow(Record):
    """The means of one trace, setting, convention, forecaster and sigma.

    Attributes:
        trace, tracker, dataset, device: of the boxes.
        times_from: the trace that the times come from.
        policy, fps, latency, scale, search, pre_forecaster: how it was replayed.
        convention, forecaster: names.
        sequences, repetitions: how many.
        engine: ``"batch"`` or ``"simpy"``.
        exact: whether every output follows the same frame as when recorded.
        approximate_share: of the outputs, those that do not.
        elapsed_ms: mean time of a call but the initialisation; None without such a call.
        init_ms: mean time of an initialisation.
        init_source: how one knows that (see :class:`lae_sim.trace.describe.InitCost`).
        skip_rate: share of frames never processed.
        sigma: permitted latency, frames, or ``MEAN`` over the grid of them.
        scores, offline: mean of each metric in 0..1, under and without latency; None if unknown.
        uncertainty: of AUC and DP, in the rows of the first sigma and of the mean over the grid;
            where the reach is known of ``modelled_auc`` and ``modelled_dp20`` too.
        staleness: of each sigma; None of their mean.
        energy: of a call; None where the device's power was not measured, or the times are not
            those that were.
        modelled: scores under the search model; None where it says nothing.
        ranked_by: ``"modelled"`` or ``"recorded"`` (see
            :class:`lae_sim.evaluation.modelled.Ranking`).
        pareto: whether no other trace is both faster and better.
        behind: how far it is behind the best; None of the best itself, and in rows without
            intervals.
    """

    trace: str
    tracker: str
    dataset: str
    device: str
    times_from: str
    policy: str
    fps: Fraction
    latency: str
    scale: Fraction
    search: str
    pre_forecaster: str
    convention: str
    forecaster: str
    sequences: int
    repetitions: int
    engine: str
    exact: bool
    approximate_share: float
    elapsed_ms: float | None
    init_ms: float
    init_source: str
    skip_rate: float
    sigma: Fraction | str
    scores: Mapping[str, float | None]
    offline: Mapping[str, float | None]
    uncertainty: Mapping[str, Uncertainty] = field(default_factory=dict)
    staleness: Staleness | None = None
    energy: Consumption | None = None
    modelled: Modelled | None = None
    ranked_by: str = "recorded"
    pareto: bool = False
    behind: Behind | None = None

    @property
    def run(self) -> str:
        """The trace, and where its times come from, if from another."""
        return run_name(self.trace, self.times_from)

    def score(self, metric: str) -> float | None:
        """Mean AUC or DP as it is ranked: modelled, or of the recorded boxes."""
        if self.ranked_by == "modelled" and self.modelled is not None:
            return self.modelled.scores[metric]
        return self.scores[metric]

    def certainty(self, metric: str) -> Uncertainty | None:
        """How sure that is."""
        ranked = f"modelled_{metric}" if self.ranked_by == "modelled" else metric
        return self.uncertainty.get(ranked, self.uncertainty.get(metric))

    def flat(self) -> dict[str, Plain]:
        """The flat row of JSON and CSV: unknown values are None, what is not asked has no key."""
        row = {**_plain(self, until="scores"), **self.scores}
        row |= {f"offline_{metric}": value for metric, value in self.offline.items()}
        for metric, uncertainty in self.uncertainty.items():
            row |= uncertainty.columns(metric)
        if self.staleness is not None:
            row |= self.staleness.columns()
        if self.energy is not None:
            row |= self.energy.columns(self.score("auc"))
        if self.modelled is not None:
            row |= self.modelled.columns()
        row |= {"ranked_by": self.ranked_by, "pareto": self.pareto}
        return row if self.behind is None else row | self.behind.columns()


@dataclass(frozen=True, slots=True)
class Comparison(Record):
    """Two traces of one dataset against each other, in one setting, with one forecaster.

    Attributes:
        dataset, policy, fps, latency, scale, search, pre_forecaster, convention, forecaster, sigma:
            what they share.
        a, b: the traces, with that of their times, if from another.
        sequences: how many both have a score of.
        difference: of the mean AUC, a - b, paired over the sequences.
        better_here: how probable it is that one run of a beats one of b on these sequences (a tie
            counts half); None without jitter.
        better: the same on other sequences like these.
        p_holm: p of the difference, corrected for the number of pairs of its group.
        ranked_by: whose AUC it is, ``"modelled"`` or ``"recorded"``.
    """

    dataset: str
    policy: str
    fps: Fraction
    latency: str
    scale: Fraction
    search: str
    pre_forecaster: str
    convention: str
    forecaster: str
    sigma: Fraction | str
    a: str
    b: str
    sequences: int
    difference: Difference
    better_here: float | None
    better: float
    p_holm: float = 1.0
    ranked_by: str = "recorded"

    def flat(self) -> dict[str, Plain]:
        """The flat row of JSON and CSV."""
        return {
            **_plain(self, until="difference"),
            "difference": self.difference.value,
            **self.difference.interval.columns("difference"),
            "p": self.difference.p,
            "better_here": self.better_here,
            "better": self.better,
            "p_holm": self.p_holm,
            "ranked_by": self.ranked_by,
        }


@dataclass(frozen=True, slots=True)
class Requirement(Record):
    """What a required AUC asks of a device and of the world.

    Attributes:
        trace, times_from, policy, fps, latency, search, pre_forecaster, convention, forecaster,
            sigma: where it is asked.
        required_auc: the mean AUC.
        scale: the scale of all times, in hundredths, at which bisection ends, as if the AUC fell
            steadily (as version 0.1 has it); None if it is not even reached without latency.
        auc: the mean AUC there.
        beyond: the hundredth after it; None if the largest that is tried is enough.
        beyond_auc: the mean AUC there, too low.
        auc_without_latency: the mean AUC at scale 0.
        speed_up: how much faster the device must be, 1 / scale; None without a scale above 0.
        fps_at_most: how fast the world may move, with the recorded motion from frame to frame;
            None where a cost or a policy has a time of its own.
        ranked_by: whose AUC it is, ``"modelled"`` or ``"recorded"``.
        safe_scale: the scale up to which times may be stretched from 1 on and the AUC is reached at
            every scale tried on the way; where it is not at 1, the largest below at which it is.
            It is `scale` wherever the AUC falls steadily.
        safe_auc, next_auc: the mean AUC there, and one hundredth after.
        safe_ms_per_frame: mean time of a call there, the initialisations apart; None without a
            call, and where only no latency at all is enough.
        stretches: the first and last of each row of scales tried at which the AUC is reached.
    """

    trace: str
    times_from: str
    policy: str
    fps: Fraction
    latency: str
    search: str
    pre_forecaster: str
    convention: str
    forecaster: str
    sigma: Fraction
    required_auc: float
    scale: Fraction | None
    auc: float | None
    beyond: Fraction | None
    beyond_auc: float | None
    auc_without_latency: float
    speed_up: float | None
    fps_at_most: float | None
    ranked_by: str = "recorded"
    safe_scale: Fraction | None = None
    safe_auc: float | None = None
    next_auc: float | None = None
    safe_ms_per_frame: float | None = None
    stretches: tuple[tuple[Fraction, Fraction], ...] = ()

    @property
    def run(self) -> str:
        """The trace, and where its times come from, if from another."""
        return run_name(self.trace, self.times_from)

    @property
    def safe_frames_per_second(self) -> float | None:
        """How many frames a tracker processes per second at `safe_ms_per_frame`."""
        return None if self.safe_ms_per_frame is None else 1000 / self.safe_ms_per_frame

    def flat(self) -> dict[str, Plain]:
        """The flat row of JSON and CSV."""
        return {
            **_plain(self, until="stretches"),
            "safe_frames_per_second": self.safe_frames_per_second,
            "stretches": ", ".join(f"{float(a):g} to {float(b):g}" for a, b in self.stretches),
        }


@dataclass(frozen=True, slots=True)
class Failure(Record):
    """A piece of work that could not be done.

    Attributes:
        of: what it is about, in words.
        reason: why, in a line or two.
    """

    of: str
    reason: str
