"""The summary of a study: means with intervals, what latency costs, how stale answers are.

Two things are uncertain, and told apart. *Sequences*: 95 % percentile bootstrap over them, of the
scores averaged over the repetitions; *jitter*: the range that holds 95 % of the repetitions' means,
for these very sequences. Resamples depend on the seed and the number of sequences alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import combinations
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.comparison.statistics import Counts, bootstrap_counts, resampled_means, signed_rank_p
from lae_sim.engine.clock import Clock
from lae_sim.evaluation.metrics import METRICS
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.study.cells import Cell, Setting
from lae_sim.study.plan import Plan, Source
from lae_sim.study.rows import COLUMNS, read_rows
from lae_sim.study.store import Store
from lae_sim.trace.columns import to_numpy

RESAMPLES = 10_000
MEAN = "mean"
"""Stands for sigma where scores are plain means over all permitted latencies (mAUC, mDP)."""

Row = dict[str, Any]
_TAILS = (0.025, 0.975)


@dataclass(frozen=True, eq=False)
class Scores:
    """The finished cells of one trace, setting, convention and forecaster, all repetitions.

    Attributes:
        source: the trace.
        setting: the first of the settings, which differ in their repetitions.
        forecaster, convention: names.
        sequences: names, S of them.
        means: per score over the repetitions, float64 [S, M] in 0..1; and of ``mismatch_mean``;
            of ``mismatch_max`` and ``longest_hold`` the largest (frames).
        repeated: ``auc``, ``dp20`` and ``failure_frame`` at the first sigma, float64 [R, S].
        over_sigmas: ``auc`` and ``dp20`` as plain means over sigma, float64 [R, S].
        once: means by sequence of ``world_frames``, ``processed``, ``elapsed_ms`` and the offline
            scores, float64 [S].
        about: of each cell (see :class:`lae_sim.study.cells.Result`).
    """

    source: Source
    setting: Setting
    forecaster: str
    convention: str
    sequences: tuple[str, ...]
    means: Mapping[str, Floats]
    repeated: Mapping[str, Floats]
    over_sigmas: Mapping[str, Floats]
    once: Mapping[str, Floats]
    about: tuple[Mapping[str, Any], ...]

    @property
    def group(self) -> tuple[str, ...]:
        """What scores must share to be compared: dataset, world, latency, convention."""
        setting = self.setting
        return (
            self.source.metadata.dataset,
            setting.policy,
            str(setting.fps),
            setting.latency,
            str(setting.world.scale),
            self.convention,
        )


_WORST = {"mismatch_max", "longest_hold"}
_STALENESS = ("mismatch_mean", *sorted(_WORST))
_REPEATED = ("auc", "dp20", "failure_frame")
_ONCE = ("world_frames", "processed", "elapsed_ms", *(f"offline_{m}" for m in METRICS))


def read_scores(plan: Plan, store: Store) -> Iterator[Scores]:
    """The finished cells of a study, in the order of the plan; one after another."""
    sources = {source.input: source for source in plan.sources}
    together: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in plan.cells:
        same = replace(cell.setting, first=0, count=1)
        together.setdefault((same, cell.forecaster, cell.setting.world.convention), []).append(cell)
    for cells in together.values():
        if all(store.has(cell) for cell in cells):
            yield _read(cells, sources[cells[0].setting.trace], store)


def _read(cells: Sequence[Cell], source: Source, store: Store) -> Scores:
    """The scores of cells that differ in their repetitions alone."""
    first = cells[0]
    count = len(first.setting.world.sigmas)
    numbers = [*METRICS, *_STALENESS]
    found: dict[str, Any] = {}
    repeated: dict[str, list[Floats]] = {name: [] for name in _REPEATED}
    over_sigmas: dict[str, list[Floats]] = {name: [] for name in ("auc", "dp20")}
    names: tuple[str, ...] = ()
    for cell in cells:
        wanted = dict.fromkeys([*numbers, *_REPEATED, *_ONCE, "sequence", "repetition"])
        rows = read_rows(store.rows(cell), list(wanted))

        def column(name: str, rows: Any = rows) -> Floats:
            return to_numpy(rows.column(name).chunk(0), COLUMNS[name]).astype(np.float64)

        entries = rows.num_rows // count
        sequences = rows.column("sequence").chunk(0)  # its take would import pyarrow.compute
        told = [sequences[row].as_py() for row in range(0, rows.num_rows, count)]
        names = tuple(sorted(set(told)))
        place = {name: s for s, name in enumerate(names)}
        order = np.lexsort((  # by repetition, then by sequence
            np.array([place[name] for name in told]), column("repetition")[::count],
        ))  # fmt: skip
        shape = (cell.setting.count, len(names), count)
        for name in dict.fromkeys([*numbers, *_REPEATED, *_ONCE]):
            values = column(name).reshape(entries, count)[order].reshape(shape)
            if name in _REPEATED:
                repeated[name].append(values[:, :, 0])
            if name in over_sigmas:
                over_sigmas[name].append(values.mean(axis=2))
            values = values[:, :, 0] if name in _ONCE else values
            # one after another from the first repetition on, however they were dealt out
            before = [found[name][None]] if name in found else []
            combine = np.maximum if name in _WORST else np.add
            found[name] = combine.reduce(np.concatenate([*before, values]))
    count = sum(cell.setting.count for cell in cells)
    for name in found.keys() - _WORST:
        found[name] = found[name] / count
    return Scores(
        source=source,
        setting=first.setting,
        forecaster=first.forecaster,
        convention=first.setting.world.convention,
        sequences=names,
        means={name: found[name] for name in numbers},
        repeated={name: np.concatenate(parts) for name, parts in repeated.items()},
        over_sigmas={name: np.concatenate(parts) for name, parts in over_sigmas.items()},
        once={name: found[name] for name in _ONCE},
        about=tuple(store.about(cell) for cell in cells),
    )


def summarise_study(
    scores: Sequence[Scores], seed: int = 0, resamples: int = RESAMPLES
) -> list[Row]:
    """A row per trace, setting, convention, forecaster and sigma, and one of their means.

    Args:
        scores: all of a study.
        seed: of the resamples.
        resamples: of the bootstrap.

    Returns:
        Rows with the columns of the README; what is unknown is None. Intervals and tests stand in
        the rows of the first sigma and of the mean over sigma.
    """
    hold = {(*_identity(s),): s for s in scores if s.forecaster == "hold"}
    counts: dict[int, Counts] = {}
    rows: list[Row] = []
    rivals: dict[tuple[Any, ...], list[Row]] = {}
    for each in scores:
        ours = [*_rows(each, hold.get(_identity(each)), seed, resamples, counts)]
        for row in ours:
            rival = (*each.group, each.sequences, each.forecaster, row["sigma"])
            rivals.setdefault(rival, []).append(row)
        rows += ours
    for group in rivals.values():
        _mark_front(group)
    return rows


def _identity(scores: Scores) -> tuple[Any, ...]:
    """What a forecaster and hold share."""
    return (scores.setting.trace, scores.setting.timing, *scores.group)


def _rows(
    scores: Scores, hold: Scores | None, seed: int, resamples: int, counts: dict[int, Counts]
) -> Iterator[Row]:
    setting, metadata = scores.setting, scores.source.metadata
    clock = Clock.at(setting.fps)
    departures = sum(about["approximate_outputs"] for about in scores.about)
    calls = sum(about["calls"] for about in scores.about)
    told = {
        "trace": setting.trace.label,
        "tracker": metadata.tracker,
        "dataset": metadata.dataset,
        "device": metadata.device,
        **setting.columns(),
        "convention": scores.convention,
        "forecaster": scores.forecaster,
        "sequences": len(scores.sequences),
        "repetitions": len(scores.repeated["auc"]),
        "engine": scores.about[0]["engine"],
        "exact": departures == 0,
        "approximate_share": departures / calls if calls else 0.0,
        "elapsed_ms": _mean(scores.once["elapsed_ms"]),
        "skip_rate": float(1 - scores.once["processed"].sum() / scores.once["world_frames"].sum()),
    }
    offline = {f"offline_{m}": _mean(scores.once[f"offline_{m}"]) for m in METRICS}
    frames = scores.once["world_frames"]
    for s, sigma in enumerate(setting.world.sigmas):
        at = {metric: scores.means[metric][:, s] for metric in METRICS}
        row: Row = {**told, "sigma": str(sigma), **{m: _mean(v) for m, v in at.items()}, **offline}
        if s == 0:
            row |= _uncertain(scores, hold, "repeated", seed, resamples, counts)
        row |= _stale(scores, s, sigma, clock, frames)
        yield row
    if set(SIGMA_GRID) <= set(setting.world.sigmas):
        grid = [s for s, sigma in enumerate(setting.world.sigmas) if sigma in SIGMA_GRID]
        means = {m: _mean_of_means(scores.means[m][:, grid]) for m in METRICS}
        row = {**told, "sigma": MEAN, **means, **offline}
        if len(grid) == len(setting.world.sigmas):
            row |= _uncertain(scores, hold, "over_sigmas", seed, resamples, counts)
        yield row


def _uncertain(
    scores: Scores,
    hold: Scores | None,
    which: str,
    seed: int,
    resamples: int,
    counts: dict[int, Counts],
) -> Row:
    """Intervals of the means, what is won over hold, and the share of the loss recovered."""
    found: Row = {}
    for metric in ("auc", "dp20"):
        ours = getattr(scores, which)[metric]
        base = None if hold is None or hold is scores else getattr(hold, which)[metric]
        offline = scores.once[f"offline_{metric}"]
        kept = ~np.isnan(ours.mean(axis=0))
        if base is not None:
            kept &= ~np.isnan(base.mean(axis=0))
        if not kept.any():
            continue
        count = int(kept.sum())
        if count not in counts:
            counts[count] = bootstrap_counts(count, resamples, seed)
        mean = ours[:, kept].mean(axis=0)
        bare = mean if base is None else base[:, kept].mean(axis=0)
        rows = np.stack([mean, bare, offline[kept] - bare])
        resampled, held, lost = resampled_means(rows, counts[count])
        found[f"{metric}_low"], found[f"{metric}_high"] = ends(resampled)
        if len(ours) > 1:
            jitter = ends(ours[:, kept].mean(axis=1))
            found[f"{metric}_jitter_low"], found[f"{metric}_jitter_high"] = jitter
        if base is None:
            continue
        won = resampled - held
        found[f"vs_hold_{metric}"] = float(mean.mean() - bare.mean())
        found[f"vs_hold_{metric}_low"], found[f"vs_hold_{metric}_high"] = ends(won)
        found[f"vs_hold_{metric}_p"] = signed_rank_p(np.round(mean - bare, 12))
        if not np.isnan(offline[kept]).any():
            loss = float(offline[kept].mean() - bare.mean())
            if loss > 0:
                found[f"recovered_{metric}"] = float(mean.mean() - bare.mean()) / loss
            if (lost > 0).all():
                shares = ends(won / lost)
                found[f"recovered_{metric}_low"], found[f"recovered_{metric}_high"] = shares
    return found


def _stale(scores: Scores, s: int, sigma: Fraction, clock: Clock, frames: Floats) -> Row:
    """How old answers are, and how long the target is held, in world time."""
    mismatch = scores.means["mismatch_mean"][:, s] * frames
    mean = float(mismatch.sum() / frames.sum())
    frame_ms = clock.milliseconds(1)
    row = {
        "mismatch_mean": mean,
        "age_ms": (mean + float(sigma)) * frame_ms,
        "age_max_ms": float(scores.means["mismatch_max"][:, s].max() + sigma) * frame_ms,
        "longest_stale_ms": float(scores.means["longest_hold"][:, s].max()) * frame_ms,
    }
    if s:
        return row
    failure = scores.repeated["failure_frame"]
    failed = failure < frames
    median = _median_survival(failure.ravel(), failed.ravel(), frame_ms)
    return {**row, "failed": float(failed.mean()), "time_to_failure_ms": median}


def _median_survival(times: Floats, failed: Any, frame_ms: float) -> float | None:
    """Median time to failure, ms; None if less than half fail.

    Sequences that end without failure are censored: the estimate is that of Kaplan and Meier,
    "Nonparametric Estimation from Incomplete Observations", 1958.
    """
    alive = Fraction(1)
    for time in np.unique(times[failed]):
        lost = np.count_nonzero(failed & (times == time))
        alive *= 1 - Fraction(int(lost), int(np.count_nonzero(times >= time)))
        if alive <= Fraction(1, 2):
            return float(time) * frame_ms
    return None


def _mark_front(group: Sequence[Row]) -> None:
    """Mark the Pareto front of rivals: no other has a higher AUC and faster calls.

    Rivals are the traces with the same sequences, world, latency, convention, forecaster and sigma.
    """
    known = [row for row in group if row["auc"] is not None and row["elapsed_ms"] is not None]
    for row in group:
        row["pareto"] = any(row is one for one in known) and not any(
            other["auc"] >= row["auc"]
            and other["elapsed_ms"] <= row["elapsed_ms"]
            and (other["auc"], other["elapsed_ms"]) != (row["auc"], row["elapsed_ms"])
            for other in known
        )


def ends(samples: Floats) -> tuple[float, float]:
    """The range of the middle 95 % of samples."""
    low, high = np.quantile(samples, _TAILS).tolist()
    return low, high


def _mean(values: Floats) -> float | None:
    """Mean of the sequences that have a value."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


def _mean_of_means(values: Floats) -> float | None:
    """Plain mean over sigma of the means over sequences; values are [S, M]."""
    means = [_mean(values[:, s]) for s in range(values.shape[1])]
    known = [mean for mean in means if mean is not None]
    return float(np.mean(known)) if len(known) == len(means) else None


def compare_traces(
    scores: Sequence[Scores], seed: int = 0, resamples: int = RESAMPLES
) -> list[Row]:
    """Traces of one dataset against each other: in every setting, with every forecaster.

    Returns:
        A row per pair, at the first sigma (or, on the whole grid of sigmas, of the means over it):
        ``difference`` of the mean AUC with its interval; ``p`` of Wilcoxon's signed-rank test over
        the sequences, and ``p_holm``, corrected for the number of pairs of its group (Holm, "A
        Simple Sequentially Rejective Multiple Test Procedure", 1979); ``better_here``, how probable
        it is that one run of A beats one of B on these sequences (a tie counts half; None without
        jitter), and ``better``, the same on other sequences like these (bootstrap, a repetition
        drawn for each sequence).
    """
    together: dict[tuple[str, ...], list[Scores]] = {}
    for each in scores:
        together.setdefault((*each.group, each.forecaster), []).append(each)
    counts: dict[int, Counts] = {}
    rows = []
    for group in together.values():
        ours = [_pair(a, b, seed, resamples, counts) for a, b in combinations(group, 2)]
        known = [row for row in ours if row is not None]
        previous = 0.0
        for rank, row in enumerate(sorted(known, key=lambda row: row["p"])):
            previous = row["p_holm"] = max(previous, min(1.0, row["p"] * (len(known) - rank)))
        rows += known
    return rows


def _pair(a: Scores, b: Scores, seed: int, resamples: int, counts: dict[int, Counts]) -> Row | None:
    """A against B; None if they have no sequences in common that count."""
    whole = set(SIGMA_GRID) == set(a.setting.world.sigmas)
    which = "over_sigmas" if whole else "repeated"
    both = sorted(set(a.sequences) & set(b.sequences))
    ours, theirs = (
        getattr(one, which)["auc"][:, [one.sequences.index(name) for name in both]]
        for one in (a, b)
    )
    kept = ~np.isnan(ours.mean(axis=0) + theirs.mean(axis=0))
    if not kept.any():
        return None
    ours, theirs = ours[:, kept], theirs[:, kept]
    count = ours.shape[1]
    if count not in counts:
        counts[count] = bootstrap_counts(count, resamples, seed)
    difference = ours.mean(axis=0) - theirs.mean(axis=0)
    (margins,) = resampled_means(difference[None], counts[count])
    low, high = ends(margins)
    jitter = len(ours) > 1 or len(theirs) > 1
    if jitter:
        margins = _drawn_margins(ours, theirs, counts[count], seed)
    here = np.sign(np.round(ours.mean(axis=1)[:, None] - theirs.mean(axis=1), 12))
    setting = a.setting
    return {
        "dataset": a.source.metadata.dataset,
        "policy": setting.policy,
        "fps": str(setting.fps),
        "latency": setting.latency,
        "scale": str(setting.world.scale),
        "convention": a.convention,
        "forecaster": a.forecaster,
        "sigma": MEAN if whole else str(setting.world.sigmas[0]),
        "a": setting.run,
        "b": b.setting.run,
        "sequences": count,
        "difference": float(difference.mean()),
        "difference_low": low,
        "difference_high": high,
        "p": signed_rank_p(np.round(difference, 12)),
        "better_here": float((here.mean() + 1) / 2) if jitter else None,
        "better": float((np.sign(np.round(margins, 12)).mean() + 1) / 2),
    }


def _drawn_margins(ours: Floats, theirs: Floats, counts: Counts, seed: int) -> Floats:
    """Differences in resamples of the sequences, each with a repetition drawn for each sequence."""
    resamples, count = counts.shape
    random = np.random.Generator(np.random.PCG64([seed, count, len(ours), len(theirs)]))
    margins = np.zeros(resamples)
    for s in range(count):  # one sequence after another: resamples x sequences would be large
        run = ours[random.integers(0, len(ours), resamples), s]
        margins += (
            counts[:, s] / count * (run - theirs[random.integers(0, len(theirs), resamples), s])
        )
    return margins
