"""What tables and pictures of a study choose, where it has more than they can hold.

One setting of each trace stands for all: the first that the study names, at scale 1 if it has that.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.comparison.statistics import by_attribute
from lae_sim.errors import LaeError
from lae_sim.report.table import printable
from lae_sim.study.summary import MEAN, Row, Scores

if TYPE_CHECKING:
    from pandas import DataFrame

    from lae_sim.study.run import StudyResults


def run_of(row: Mapping[str, Any]) -> str:
    """The trace of a row of the summary, and where its times come from, if from another."""
    trace, times = str(row["trace"]), row["times_from"]
    return trace if times == trace else f"{trace} at {times}"


def setting_of(row: Mapping[str, Any]) -> tuple[str, ...]:
    """The setting of a row of the summary, but for where its times come from."""
    return tuple(str(row[name]) for name in SETTINGS[1:])


@dataclass(frozen=True, eq=False)
class View:
    """A study, as tables and pictures look at it.

    Attributes:
        results: the study's.
    """

    results: StudyResults

    @cached_property
    def rows(self) -> list[Row]:
        """Rows with intervals (see :func:`lae_sim.report.study_view.primary`)."""
        return primary(self.results.summary)

    @cached_property
    def chosen(self) -> dict[str, tuple[str, ...]]:
        """The setting that stands for all, of each run."""
        found: dict[str, tuple[str, ...]] = {}
        for row in self.rows:
            first = found.setdefault(run_of(row), setting_of(row))
            if row["scale"] == "1" and first[SETTINGS.index("scale") - 1] != "1":
                found[run_of(row)] = setting_of(row)
        return found

    @cached_property
    def standing(self) -> list[Row]:
        """The rows of the settings that stand for all."""
        return [row for row in self.rows if self.stands(row)]

    def stands(self, row: Mapping[str, Any]) -> bool:
        """Whether a row's setting stands for all."""
        return self.chosen[run_of(row)] == setting_of(row)

    @cached_property
    def names(self) -> dict[str, str]:
        """Names of the runs: their trackers, where these tell the runs of each dataset apart."""
        runs = {run_of(row): (row["dataset"], row["tracker"]) for row in self.rows}
        alone = len({*runs.values()}) == len(runs)
        alone &= all(tracker != "unknown" for _, tracker in runs.values())
        return {run: printable(tracker if alone else run) for run, (_, tracker) in runs.items()}

    @cached_property
    def forecasters(self) -> tuple[str, ...]:
        """Names, hold first."""
        return tuple(dict.fromkeys(["hold", *(row["forecaster"] for row in self.rows)]))

    @cached_property
    def attributes(self) -> DataFrame | None:
        """What :func:`.statistics.by_attribute` says of each dataset that has attributes.

        At the first sigma and the settings that stand for all, after a column ``dataset``; None if
        there are no attributes or the study wants none.
        """
        import pandas as pd

        study, parts = self.results.plan.study, []
        chosen = [s for s in self.results.scores if study.attributes and self.stands(row_of(s))]
        for dataset in dict.fromkeys(scores.source.metadata.dataset for scores in chosen):
            ours = [scores for scores in chosen if scores.source.metadata.dataset == dataset]
            attributes = {
                (dataset, sequence): tuple(map(printable, s.source.metadata.attributes(sequence)))
                for s in ours
                for sequence in s.sequences
            }
            if any(attributes.values()):
                rows = [row for scores in ours for row in self._tidy(scores)]
                settings: dict[str, Any] = {"baselines": ("hold",), "metrics": ("auc",)}
                try:
                    found = by_attribute(
                        pd.DataFrame(rows), attributes, **settings, seed=study.seed
                    )
                except LaeError:
                    continue  # no sequence has a score of every forecaster
                parts.append(found.assign(dataset=printable(dataset)))
        return pd.concat(parts, ignore_index=True) if parts else None

    def _tidy(self, scores: Scores) -> Iterable[Row]:
        """The AUC of each sequence, as :mod:`lae_sim.comparison.statistics` wants it."""
        row = row_of(scores)
        row |= {"trace": self.names[run_of(row)], "scale": eval_scale(row["scale"])}
        values = {row["forecaster"]: scores.means["auc"][:, 0]}
        if row["forecaster"] == "hold":
            values["offline"] = scores.once["offline_auc"]
        for forecaster, aucs in values.items():
            row |= {"forecaster": forecaster, "sigma": 0.0, "metric": "auc"}
            for s in np.flatnonzero(~np.isnan(aucs)).tolist():
                yield {**row, "sequence": scores.sequences[s], "value": float(aucs[s])}


def row_of(scores: Scores) -> dict[str, Any]:
    """What says which scores these are, as the rows of the summary say it."""
    return {
        **scores.setting.columns(),
        "dataset": scores.source.metadata.dataset,
        "convention": scores.convention,
        "forecaster": scores.forecaster,
        "sigma": str(scores.setting.world.sigmas[0]),
    }


def shared_setting(rows: Sequence[Mapping[str, Any]], but: str = "") -> str:
    """What some rows have in common, in words; one key may be left out."""
    parts = []
    labels = ("policy", "world", "latency", "times x", "convention")
    for name, label in zip(SETTINGS[1:], labels):
        values = {str(row[name]) for row in rows}
        value = (
            values.pop() if len(values) == 1 else "of each trace" if name == "fps" else "various"
        )
        unit = " fps" if name == "fps" and value[0].isdigit() else ""
        parts += [f"{label} {value}{unit}"] if name != but else []
    sigma = rows[0]["sigma"]
    told = "mean over sigma = 0, 0.02, ..., 1" if sigma == MEAN else f"sigma {sigma}"
    return ", ".join(parts if but == "sigma" else [*parts, told])


SETTINGS = ("times_from", "policy", "fps", "latency", "scale", "convention")


def primary(rows: Sequence[Row]) -> list[Row]:
    """The rows that have intervals: those of the first sigma, or of the mean over the grid of them.

    The latter say how stale answers are at the first sigma.
    """
    keys = ("trace", "forecaster", *SETTINGS)
    first: dict[tuple[Any, ...], Row] = {}
    last: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        key = tuple(row[name] for name in keys)
        first.setdefault(key, row)
        last[key] = row
    grid = any(row["sigma"] == MEAN for row in rows)
    return [{**first[key], **last[key]} if grid else first[key] for key in first]


def several(rows: Sequence[Row]) -> list[str]:
    """Settings that differ between rows."""
    own = {"times_from": "trace"}
    return [
        name
        for name in SETTINGS
        if any(row[name] != (row[own[name]] if name in own else rows[0][name]) for row in rows)
    ]


def eval_scale(text: str) -> float:
    """A scale such as ``"137/100"`` as a number."""
    from fractions import Fraction

    return float(Fraction(text))
