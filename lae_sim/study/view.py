"""What tables and pictures of a study choose, where it has more than they can hold.

One setting of each trace stands for all: the first that the study names, at scale 1 if it has that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import by_attribute
from lae_sim.errors import LaeError, shown, visible
from lae_sim.evaluation.modelled import Ranking
from lae_sim.study.records import MEAN, Comparison, Requirement, SummaryRow
from lae_sim.study.summary import Scores, ranked, rankings_of
from lae_sim.study.verdict import names_of

if TYPE_CHECKING:
    from pandas import DataFrame

    from lae_sim.study.run import StudyResults


SETTINGS = ("policy", "fps", "latency", "scale", "search", "pre_forecaster", "convention")
"""What says how a trace is replayed and scored, but for where its times come from."""


def run_of(row: SummaryRow | Requirement) -> str:
    """The trace of a row, and where its times come from, if from another."""
    return row.run


def setting_of(row: SummaryRow | Comparison) -> tuple[str | Fraction, ...]:
    """The values of `SETTINGS` in a row."""
    return tuple(getattr(row, name) for name in SETTINGS)


@dataclass(frozen=True, eq=False)
class View:
    """A study, as tables and pictures look at it.

    Attributes:
        results: the study's.
    """

    results: StudyResults

    def __post_init__(self) -> None:
        from lae_sim.study.run import StudyResults

        if not isinstance(self.results, StudyResults):
            raise LaeError(f"results: what run_study gives, not {shown(self.results)}")

    @cached_property
    def rows(self) -> list[SummaryRow]:
        """The rows that have intervals: of the first sigma, or of the mean over the grid of them.

        The latter say how stale answers are at the first sigma.
        """
        last = {(run_of(r), setting_of(r), r.forecaster): r for r in self.results.summary}
        if not any(row.sigma == MEAN for row in last.values()):
            return list(self._first.values())
        pairs = zip(last.values(), self._first.values())
        return [replace(row, staleness=first.staleness) for row, first in pairs]

    @cached_property
    def _first(self) -> dict[tuple[Any, ...], SummaryRow]:
        """The rows of the first sigma, by run, setting and forecaster."""
        rows: dict[tuple[Any, ...], SummaryRow] = {}
        for row in self.results.summary:
            rows.setdefault((run_of(row), setting_of(row), row.forecaster), row)
        return rows

    def row_of(self, scores: Scores) -> SummaryRow:
        """The row of the summary that has the means of scores at the first sigma."""
        setting = scores.setting
        world = setting.policy, setting.fps, setting.latency, setting.world.scale
        searched = setting.world.search, setting.pre_forecaster
        values = (*world, *searched, scores.convention)
        return self._first[setting.run, values, scores.forecaster]

    @cached_property
    def rankings(self) -> dict[tuple[str, ...], Ranking]:
        """By what the scores of each group are ranked and compared."""
        return rankings_of(self.results.scores)

    @cached_property
    def chosen(self) -> dict[str, tuple[str | Fraction, ...]]:
        """The setting that stands for all, of each run."""
        chosen: dict[str, SummaryRow] = {}
        for row in self.rows:
            first = chosen.setdefault(run_of(row), row)
            if row.scale == 1 and first.scale != 1:
                chosen[run_of(row)] = row
        return {run: setting_of(row) for run, row in chosen.items()}

    @cached_property
    def standing(self) -> list[SummaryRow]:
        """The rows of the settings that stand for all."""
        return [row for row in self.rows if self.stands(row)]

    def stands(self, row: SummaryRow) -> bool:
        """Whether a row's setting stands for all."""
        return self.chosen[run_of(row)] == setting_of(row)

    @cached_property
    def names(self) -> dict[str, str]:
        """Names of the runs (see :func:`lae_sim.study.verdict.names_of`)."""
        return names_of(self.rows)

    @cached_property
    def forecasters(self) -> tuple[str, ...]:
        """Names, hold first."""
        return tuple(dict.fromkeys(["hold", *(row.forecaster for row in self.rows)]))

    @cached_property
    def attributes(self) -> DataFrame | None:
        """What :func:`.statistics.by_attribute` says of each dataset that has attributes.

        At the first sigma and the settings that stand for all, after a column ``dataset``; None if
        there are no attributes or the study wants none.
        """
        study, parts = self.results.plan.study, []
        scored = self.results.scores if study.attributes else ()
        groups: dict[str, list[Scores]] = {}
        for scores in scored:
            if self.stands(self.row_of(scores)):
                groups.setdefault(scores.source.metadata.dataset, []).append(scores)
        for dataset, group in groups.items():
            attributes = {
                (dataset, sequence): tuple(map(visible, s.source.metadata.attributes(sequence)))
                for s in group
                for sequence in s.sequences
            }
            if any(attributes.values()):
                import pandas as pd

                table = pd.DataFrame([row for scores in group for row in self._tidy(scores)])
                try:
                    found = by_attribute(
                        table, attributes, baselines=("hold",), metrics=("auc",), seed=study.seed
                    )
                except LaeError:
                    continue  # no sequence has a score of every forecaster
                parts.append(found.assign(dataset=visible(dataset)))
        if not parts:
            return None
        return pd.concat(parts, ignore_index=True)

    def _tidy(self, scores: Scores) -> Iterable[dict[str, str | float]]:
        """The AUC of each sequence, as :mod:`lae_sim.comparison.statistics` wants it."""
        row = self.row_of(scores)
        aucs = {row.forecaster: ranked(scores.means, self.rankings[scores.group])[:, 0]}
        if row.forecaster == "hold":
            aucs["offline"] = scores.once["offline_auc"]
        for forecaster, values in aucs.items():
            for s in np.flatnonzero(~np.isnan(values)).tolist():
                yield {
                    "trace": self.names[run_of(row)],
                    "dataset": row.dataset,
                    "latency": row.latency,
                    "scale": float(row.scale),
                    "sigma": 0.0,
                    "forecaster": forecaster,
                    "metric": "auc",
                    "sequence": scores.sequences[s],
                    "value": float(values[s]),
                }


def score_name(metric: str, rows: Sequence[SummaryRow | Comparison]) -> str:
    """What a score of some rows is called: ``"AUC"``, or ``"mAUC"`` over the grid of sigmas."""
    return f"m{metric}" if rows and rows[0].sigma == MEAN else metric


def shared_setting(rows: Sequence[SummaryRow], but: str = "") -> str:
    """What some rows have in common, in words; one key may be left out."""
    parts = []
    labels = ("policy", "world", "latency", "times x", "search", "pre-forecaster", "convention")
    for name, label in zip(SETTINGS, labels):
        values = {str(getattr(row, name)) for row in rows}
        if values in ({"off"}, {"none"}):
            continue
        value = (
            values.pop() if len(values) == 1 else "of each trace" if name == "fps" else "various"
        )
        unit = " fps" if name == "fps" and value[0].isdigit() else ""
        parts += [f"{label} {value}{unit}"] if name != but else []
    sigma = rows[0].sigma
    text = "mean over sigma = 0, 0.02, ..., 1" if sigma == MEAN else f"sigma {sigma}"
    ranked_by = {row.ranked_by for row in rows}
    parts += [] if but == "sigma" else [text]
    if "modelled" in ranked_by:
        parts.append("modelled scores" if len(ranked_by) == 1 else "modelled scores, and recorded")
    return ", ".join(parts)


def several(rows: Sequence[SummaryRow]) -> list[str]:
    """Settings that differ between rows."""
    elsewhere = any(row.times_from != row.trace for row in rows)
    differ = [name for name in SETTINGS if len({getattr(row, name) for row in rows}) > 1]
    return ["times_from"] * elsewhere + differ
