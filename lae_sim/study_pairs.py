"""Traces of a study against each other: paired differences, tests, and the odds of one run."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from lae_sim.boxes import Floats
from lae_sim.pairing import SIGMA_GRID
from lae_sim.statistics import Counts, bootstrap_counts, resampled_means, signed_rank_p
from lae_sim.study_summary import MEAN, RESAMPLES, Row, Scores, ends


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
    whole = set(SIGMA_GRID) == set(a.setting.sigmas)
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
        "scale": str(setting.scale),
        "convention": a.convention,
        "forecaster": a.forecaster,
        "sigma": MEAN if whole else str(setting.sigmas[0]),
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
