"""Comparing forecasters in one call."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from lae_sim.api.inputs import (
    Costs,
    Forecasters,
    Traces,
    camera_of,
    check_frames,
    cost_texts,
    labelled_traces,
    named_forecasters,
)
from lae_sim.comparison.forecasters import OFFLINE, score_forecasters, steps
from lae_sim.comparison.statistics import by_attribute, over_sigmas, summarise
from lae_sim.engine.clock import Number, whole
from lae_sim.engine.scheduler import Policy, scores_latency
from lae_sim.errors import LaeError
from lae_sim.evaluation.metrics import find_convention
from lae_sim.evaluation.modelled import Ranking
from lae_sim.files import sequence_names
from lae_sim.learning.registry import COMPARED, load_any, load_forecaster
from lae_sim.progress import ProgressBar, ShowProgress
from lae_sim.replay.latency import LatencySource
from lae_sim.replay.names import named
from lae_sim.replay.world import SIGMA_GRID, TraceLike, World, open_others

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from lae_sim.figures.column import ColumnFigure
    from lae_sim.trace.file import Trace


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonResult:
    """What :func:`compare_forecasters` found.

    Attributes:
        traces: by name.
        scores: the tidy table of :func:`lae_sim.comparison.forecasters.score_forecasters`.
        whole_grid: whether the scores are compared as means over the whole grid of sigmas.
        seed: of the bootstrap.

    Example:
        >>> import lae_sim
        >>> result = lae_sim.compare_forecasters(
        ...     "traces/synthetic-slow.parquet", forecasters=["kalman", "least-squares"]
        ... )
        >>> table = result.summary.query("metric == 'auc'").set_index("forecaster")
        >>> table["mean"].round(4).to_dict()
        {'hold': 0.5722, 'kalman': 0.6291, 'least-squares': 0.6375, 'offline': 0.7773}
        >>> result.plot()
        <Figure ...>
    """

    traces: Mapping[str, Trace]
    scores: DataFrame
    whole_grid: bool
    seed: int

    @property
    def ranking(self) -> Ranking:
        """By which scores forecasters are compared: the modelled ones, or the recorded boxes'."""
        return Ranking(**self.scores.attrs["ranking"])

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics that are compared, the first with tests; others of the recorded boxes last.

        ``("auc", "dp20")``, or ``("modelled_auc", "modelled_dp20", "auc", "dp20")``; over the grid
        of sigmas their means, ``"mauc"``, ...
        """
        recorded = ("mauc", "mdp20") if self.whole_grid else ("auc", "dp20")
        if not self.ranking.modelled:
            return recorded
        return (*(f"modelled_{metric}" for metric in recorded), *recorded)

    @property
    def notes(self) -> list[str]:
        """What was trained, what initialisation costs, which replays are approximations, ...

        Where something is modelled the last says by what is ranked.
        """
        notes: list[str] = self.scores.attrs["notes"]
        return [*notes, str(self.ranking)] if self.search else notes

    @property
    def search(self) -> list[dict[str, Any]]:
        """What the search model rests on in each replay of which it says something."""
        search: list[dict[str, Any]] = self.scores.attrs["search"]
        return search

    @property
    def init(self) -> list[dict[str, Any]]:
        """What initialisations cost in each replay (see :class:`lae_sim.trace.describe.InitCost`).

        ``left_search`` names the sequences whose target leaves the search region meanwhile.
        """
        costs: list[dict[str, Any]] = self.scores.attrs["init"]
        return costs

    @cached_property
    def summary(self) -> DataFrame:
        """Means, paired differences and shares of the loss recovered, with intervals and tests.

        See :func:`lae_sim.comparison.statistics.summarise`. Where something is modelled there are
        more columns: the search model's mean scores and the ends of their intervals,
        ``modelled_auc``, ``modelled_auc_low``, ...; ``c_known`` and ``lost_share``; NaN where a
        replay is exact, and in the rows of all traces.
        """
        return self._with_modelled(summarise(self._compared, metrics=self.metrics, seed=self.seed))

    def _with_modelled(self, summary: DataFrame) -> DataFrame:
        import pandas as pd

        keys = ["trace", "latency", "scale", "sigma", "forecaster"]
        rows = [
            {
                (key if key in (*keys, "c_known", "lost_share") else f"modelled_{key}"): value
                for key, value in row.items()
                if key != "over_sigmas"
            }
            for row in self.scores.attrs["modelled"]
            if row["over_sigmas"] == self.whole_grid
        ]
        if not rows:
            return summary
        joined = summary.merge(pd.DataFrame(rows), on=keys, how="left")
        joined.attrs |= summary.attrs
        return joined

    @cached_property
    def attributes(self) -> DataFrame:
        """The same for the sequences of each attribute of the datasets."""
        members = {
            (trace.metadata.dataset, name): trace.metadata.attributes(name)
            for trace in self.traces.values()
            for name in self.scores.loc[
                self.scores["dataset"] == trace.metadata.dataset, "sequence"
            ].unique()
        }
        return by_attribute(self._compared, members, metrics=self.metrics, seed=self.seed)

    @cached_property
    def _compared(self) -> DataFrame:
        return over_sigmas(self.scores) if self.whole_grid else self.scores

    def to_frame(self) -> DataFrame:
        """Every score: a row per trace, sequence, latency, scale, forecaster, sigma and metric."""
        return self.scores

    def plot(self) -> Figure:
        """The mean of each forecaster with its interval, and the share recovered beside it."""
        from lae_sim.figures.forecasters import overview

        return overview(self.summary, self.metrics[0])

    def write(
        self,
        folder: str | os.PathLike[str],
        documents: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        """Write what a paper needs: figures and tables (see :mod:`lae_sim.report.paper`).

        Args:
            folder: where to; made if it is not there.
            documents: JSON objects to write there too, by the name of their file.

        Raises:
            LaeError: if a file cannot be written.
        """
        from lae_sim.figures.column import drawn
        from lae_sim.report.comparison import paper_tables
        from lae_sim.report.paper import Paper, write_paper

        metadata = {name: trace.metadata for name, trace in self.traces.items()}
        attributes = self.attributes if self._names_attributes else None
        tables = paper_tables(self.summary, self.metrics, metadata, attributes)
        frames = {"scores": self.summary, "sequences": self.scores}
        figures = map(drawn, self._figures())
        write_paper(Paper(figures, tables, frames, documents or {}), folder)

    @property
    def _names_attributes(self) -> bool:
        return any(trace.metadata.names_attributes for trace in self.traces.values())

    def _figures(self) -> Iterator[ColumnFigure]:
        from lae_sim.figures.forecasters import (
            attributes_in_columns,
            comparison_in_columns,
            sweeps_in_columns,
        )

        yield from comparison_in_columns(self.summary, self.metrics[:2])
        if self.whole_grid:  # over which the summary has means
            metrics = ("auc", "dp20")
            by_sigma = summarise(self.scores, metrics=metrics, resamples=1, seed=self.seed)
            yield from sweeps_in_columns(by_sigma, metrics)
        else:
            yield from sweeps_in_columns(self.summary, self.metrics[:2])
        if self._names_attributes:
            yield from attributes_in_columns(self.attributes, self.metrics[0])

    def __str__(self) -> str:
        from lae_sim.report.comparison import comparison_table

        return "\n\n".join([comparison_table(self.summary), *self.notes])

    def __repr__(self) -> str:
        from lae_sim.figures.labels import METRIC_LABELS
        from lae_sim.report.table import FINE_SCORE

        table = self.summary[self.summary["metric"] == self.metrics[0]]
        first = table.drop_duplicates("forecaster")
        scores = ", ".join(f"{row.forecaster} {FINE_SCORE(row.mean)}" for row in first.itertuples())
        score = METRIC_LABELS[self.metrics[0]]
        setting = f"{first['trace'].iloc[0]}, {first['latency'].iloc[0]}"
        more = len(table.drop_duplicates(["trace", "latency", "scale", "sigma"])) - 1
        setting += f" and {more} more" * bool(more)
        return " ".join(f"<ComparisonResult of {setting}: {score} {scores}>".split())

    def _repr_html_(self) -> str:
        from html import escape

        table = self.summary[self.summary["metric"] == self.metrics[0]]
        settings = ("trace", "latency", "scale", "sigma")
        shown = [
            *(name for name in settings if table[name].nunique() > 1 or name == "trace"),
            *("forecaster", "sequences", "mean", "low", "high", "recovered"),
            *("vs_hold", "vs_hold_low", "vs_hold_high", "vs_hold_p"),
        ]
        html: str = table[shown].to_html(index=False, float_format="{:.4f}".format, na_rep="-")
        return html + "".join(f"<p>{escape(note)}</p>" for note in self.notes)


def compare_forecasters(
    traces: Traces,
    *,
    forecasters: Forecasters = COMPARED,
    sigma: Number | Iterable[Number] = 0,
    latency: str | LatencySource | Sequence[str | LatencySource] = "recorded",
    scale: Number | Sequence[Number] = 1,
    fps: Number | None = None,
    policy: str | Policy | None = None,
    passes: TraceLike | Sequence[TraceLike] = (),
    search: str = "trace",
    pre_forecaster: str | None = None,
    keep_size: bool = False,
    convention: str = "pysot",
    costs: Costs = (),
    sequences: str | Iterable[str] | None = None,
    root: str | os.PathLike[str] | None = None,
    dataset: str | None = None,
    camera_lag: int | None = None,
    folds: int = 5,
    seed: int = 0,
    progress: ShowProgress = None,
    forget_arrivals: bool = False,
) -> ComparisonResult:
    """Which forecaster helps, by how much, and how sure that is.

    Forecasters that must be trained (``"tuned-kalman"``, ``"trained"``, your own trainers) are
    trained across folds, and scored only on sequences that they have not seen.

    Args:
        traces: a trace, several, or a mapping from names to traces: paths, folders, globs, URLs, or
            what :func:`read_trace` gives.
        forecasters: names, classes, factories or trainers, or a mapping from names to these;
            ``"hold"`` and the tracker's own ``offline`` score are always compared.
        sigma: permitted latencies in frames, or ``"grid"``, whose scores are compared as means.
        latency, scale: one or several, one after another, as in :func:`evaluate`.
        fps, policy, convention, costs, sequences, forget_arrivals: as in :func:`evaluate`.
        passes, search, pre_forecaster, keep_size: as in :func:`evaluate`; of several traces, each
            pass goes with those of its tracker and dataset. Forecasters are compared by the
            modelled scores where the reach is known (see
            :class:`lae_sim.evaluation.modelled.Ranking`).
        root, dataset, camera_lag: the frames, for ``camera+NAME`` (see
            :func:`lae_sim.learning.registry.find_camera`).
        folds: in how many parts the sequences are dealt out, if anything is trained.
        seed: of folds, training and bootstrap.
        progress: whether to show a progress bar, by default on a terminal and in a notebook; or a
            function, which is told: ``progress(done, total, what)``.

    Raises:
        LaeError: if an argument is impossible, a file is missing, or a frame is asked for that a
            trace lacks; it says which.

    Example:
        >>> import lae_sim
        >>> lae_sim.compare_forecasters("traces/synthetic-slow.parquet", forecasters="kalman")
        <ComparisonResult of synthetic-slow.parquet, recorded: AUC hold 0.5722, kalman 0.6291, ...>
    """
    wanted = None if sequences is None else sequence_names(sequences)
    opened = labelled_traces(traces, wanted)
    makers = named_forecasters(forecasters)
    if OFFLINE in makers:
        raise LaeError(
            "forecasters: offline is always in the table: the tracker's own boxes, without latency"
        )
    check_frames(makers, root)
    folds = named("folds", whole, folds)
    if folds < 2:
        raise LaeError("folds: training on some sequences to score others needs at least two folds")
    seed = named("seed", whole, seed)
    kinds = {(trace.metadata.dataset, trace.metadata.fps) for trace in opened.values()}
    if root is not None and len(kinds) > 1:
        raise LaeError("root: the folder of one dataset: compare its traces by themselves")
    worlds = World.sweep(
        fps=fps,
        policy=policy,
        latency=latency,
        scale=scale,
        sigma=sigma,
        search=search,
        pre_forecaster=pre_forecaster,
        keep_size=keep_size,
        forget_arrivals=forget_arrivals,
        convention=convention,
        costs=cost_texts(costs),
        **open_others(None, passes),
    )
    find_convention(convention)
    if len({(world.fps, world.policy_label) for world in worlds}) > 1:
        raise LaeError("fps and policy: one of each: compare under others by themselves")
    if not scores_latency(worlds[0].rule()):
        named_policy = worlds[0].policy_label
        raise LaeError(f"policy: {named_policy} never scores latency: there is nothing to forecast")
    rate = worlds[0].fps or next(iter(opened.values())).metadata.fps
    camera = camera_of(root, dataset, wanted, rate, camera_lag)
    ready: dict[str, Any] = {
        name: load_any(each, camera) if isinstance(each, str) else each
        for name, each in {"hold": "hold", **makers}.items()
    }
    searches = None if pre_forecaster is None else load_forecaster(pre_forecaster, camera)
    total, done = steps(opened, ready, worlds, folds), 0
    with ProgressBar("compare", "steps", progress) as bar:

        def advance(what: str) -> None:
            nonlocal done
            done += 1
            bar(done, total, what)

        scores = score_forecasters(opened, ready, worlds, folds, seed, advance, searches)
    return ComparisonResult(opened, scores, worlds[0].sigmas == SIGMA_GRID, seed)
