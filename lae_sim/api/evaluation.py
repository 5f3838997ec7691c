"""Replaying and scoring traces in one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim._compiled import amount, expect
from lae_sim.api.inputs import (
    Costs,
    Forecasters,
    Pipelines,
    Traces,
    camera_of,
    check_frames,
    cost_texts,
    labelled_traces,
    named_forecasters,
    path_of,
)
from lae_sim.boxes import iou
from lae_sim.engine.clock import Number, exact
from lae_sim.engine.scheduler import Policy, scores_latency
from lae_sim.errors import LaeError, hint, listed, shown
from lae_sim.evaluation.caveats import SkippedStalls, notes_on
from lae_sim.evaluation.evaluate import Evaluation, Observer, answers, evaluate_groups
from lae_sim.evaluation.metrics import METRICS, UNSCORED, find_convention
from lae_sim.evaluation.modelled import FIGURES
from lae_sim.evaluation.totals import Totals, search_report
from lae_sim.files import sequence_names
from lae_sim.forecast.base import AnyFactory
from lae_sim.forecast.costs import cost_notes, resolve_costs
from lae_sim.learning.registry import load_forecaster
from lae_sim.progress import ProgressBar, ShowProgress
from lae_sim.replay.latency import LatencySource
from lae_sim.replay.names import label_of, named
from lae_sim.replay.passes import passes_for
from lae_sim.replay.run import Run, Runs
from lae_sim.replay.world import TraceLike, World, open_others, open_trace
from lae_sim.report.replay import SequenceRows, attribute_members, paper_tables, trace_report
from lae_sim.report.table import FINE_SCORE
from lae_sim.trace.describe import InitCost
from lae_sim.trace.file import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from lae_sim._arrays import Floats
    from lae_sim.evaluation.pipeline import PipelineTotals
    from lae_sim.figures.column import ColumnFigure
    from lae_sim.figures.lines import Panel


@dataclass(frozen=True, eq=False)
class Scenario:
    """One trace in one world, with the forecasters that are scored there.

    Attributes:
        label: the trace's name in tables and pictures.
        trace: the trace.
        world: how it is replayed and scored.
        runs: its sequences, replayed anew each time one goes through them.
        forecasters: factories by name; hold, the baseline of all comparisons, is always there.
        costs: what an answer of each forecaster costs, ns; 0 if not named.
    """

    label: str
    trace: Trace
    world: World
    runs: Runs
    forecasters: Mapping[str, AnyFactory]
    costs: Mapping[str, int]

    def evaluate(
        self,
        *,
        attributes: bool = True,
        sequences: bool = True,
        curves_at: Fraction | None = None,
        observers: Sequence[Observer] = (),
        observed: Collection[tuple[str, Fraction]] = (),
        progress: Callable[[int], object] = lambda frames: None,
    ) -> Evaluated:
        """Replay and score.

        Args:
            attributes: whether to keep the scores of the dataset's attributes apart.
            sequences: whether to keep the scores of each sequence.
            curves_at, observers, observed: see
                :func:`lae_sim.evaluation.evaluate.evaluate_groups`.
            progress: called with the world frames of each run.
        """
        metadata, convention = self.trace.metadata, find_convention(self.world.convention)
        stalls = SkippedStalls()
        if self.world.times_kind == "recorded" and self.world.timing is None:
            observers = [*observers, stalls]
        pipeline = None
        if self.world.pipeline is not None:
            from lae_sim.evaluation.pipeline import PipelineTotals

            pipeline = PipelineTotals(self.world.pipeline, self.world.sigmas)
            observers = [*observers, pipeline]

        def runs() -> Iterator[Run]:
            for run in self.runs:
                yield run
                progress(len(run))

        names = list(self.forecasters)
        expect(amount(self.trace.frames or 0, len(self.world.sigmas)) * len(names))
        totals, rows = Totals(names.index("hold")), SequenceRows(names)
        for part in evaluate_groups(
            runs(),
            metadata,
            self.forecasters,
            self.world.sigmas,
            convention,
            self.costs,
            curves_at=curves_at,
            observers=observers,
            observed=observed,
        ):
            named = part.replay.sequences if attributes else ()
            totals.add(part, attribute_members(metadata, named))
            if sequences:
                rows.add(part)
        notes = notes_on(totals.replay, metadata, convention, self.forecasters)
        notes += [*self.runs.notes(), *stalls.notes(), *cost_notes(self.costs)]
        return Evaluated(self, totals, rows, tuple(notes), pipeline)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """The scores of a scenario.

    Attributes:
        scenario: what was replayed and scored.
        totals: its scores over all sequences, and over those of each attribute.
        rows: the scores of each sequence, if they were kept.
        notes: what keeps the scores from being what they seem, a sentence each.
        pipeline: what happened at its stages; None where there is none.
    """

    scenario: Scenario
    totals: Totals
    rows: SequenceRows
    notes: tuple[str, ...]
    pipeline: PipelineTotals | None = None

    @property
    def init(self) -> InitCost:
        """What initialisations cost."""
        source = self.scenario.world.init_source(self.scenario.runs.times.metadata)
        return InitCost.of(self.totals.replay.init_ns, source)

    def document(self, attributes: bool = False, per_sequence: bool = False) -> dict[str, Any]:
        """The scores as a JSON object, as ``lae-sim replay --json`` has them."""
        scenario, world = self.scenario, self.scenario.world
        metadata, runs = scenario.trace.metadata, scenario.runs
        path = path_of(scenario.trace) or scenario.label
        document = {
            "trace": path,
            "tracker": metadata.tracker,
            "dataset": metadata.dataset,
            "device": metadata.device,
            "strided": [path_of(trace) or "an open trace" for trace in runs.strided],
            "gap_passes": [path_of(trace) or "an open trace" for trace in runs.gap_passes],
            "search": search_report(runs.search, world.pre_forecaster, self.totals.modelled),
            "times_from": path if runs.timing is None else path_of(runs.timing) or "an open trace",
            "times_note": runs.times.metadata.timing_note,
            "fps": str(runs.clock.fps),
            "arrivals": runs.arrivals,
            "policy": world.policy_label,
            "latency": label_of(world.latency),
            "latency_scale": str(world.scale),
            "convention": world.convention,
            "forecaster_cost_ns": dict(scenario.costs),
            "notes": list(self.notes),
            **trace_report(
                self.totals,
                runs.clock,
                list(scenario.forecasters),
                world.sigmas,
                world.convention,
                self.init,
                self.rows if per_sequence else None,
                attributes,
            ),
        }
        if self.pipeline is not None:
            document["pipeline"] = self.pipeline.report()
            delays = {float(s): self.pipeline.answer_delay_ms(s) for s in world.sigmas}
            for result in document["results"]:  # LAE's age knows no camera
                result["capture_age_ms"] = result["age_ms"] + delays[result["sigma"]]
        return document


def scenarios(
    traces: Mapping[str, Trace],
    worlds: Sequence[World],
    *,
    forecasters: Mapping[str, str | AnyFactory] | None = None,
    sequences: Iterable[str] | None = None,
    root: str | os.PathLike[str] | None = None,
    dataset: str | None = None,
    camera_lag: int | None = None,
) -> list[Scenario]:
    """Each trace in each world; what names stand for is found here, before any work.

    Of several traces, each pass goes with those of its tracker and dataset.

    Args:
        traces: traces by name.
        worlds: how they are replayed and scored.
        forecasters: what the names of the worlds' forecasters stand for, if not for themselves.
        sequences: those of the traces, if not all, to read of passes too.
        root, dataset, camera_lag: see :func:`lae_sim.learning.registry.find_camera`.

    Raises:
        LaeError: if there is no such convention, forecaster, or trace of times or passes, or a pass
            goes with none of several traces.
    """
    found = []
    own = {
        passes: passes_for([*traces.values()], [*map(open_trace, passes)])
        for passes in dict.fromkeys(world.passes for world in worlds)
    }
    names = None if sequences is None else list(sequences)
    for place, (label, trace) in enumerate(traces.items()):
        costs: dict[str, int] | None = None
        made: dict[tuple[Fraction, str], AnyFactory] = {}  # once for all worlds of a rate
        for world in [each.settled(trace) for each in worlds]:
            find_convention(world.convention)
            rate = trace.metadata.fps if world.fps is None else world.fps
            wanted = list(dict.fromkeys(["hold", *world.forecasters]))
            searching = [] if world.pre_forecaster is None else [world.pre_forecaster]
            if any((rate, name) not in made for name in [*wanted, *searching]):
                camera = camera_of(root, dataset, names, rate, camera_lag)
            for name in [*wanted, *searching]:
                each = (forecasters or {}).get(name, name)
                if (rate, name) not in made:
                    loaded = load_forecaster(each, camera) if isinstance(each, str) else each
                    made[rate, name] = loaded
            searches = made[rate, searching[0]] if searching else None
            with_own = replace(world, passes=own[world.passes][place])
            runs = with_own.replay(trace, names, pre_forecaster=searches)
            factories = {name: made[rate, name] for name in wanted}
            if costs is None:  # measured once: a sweep is of nothing else
                costs = resolve_costs(world.costs, factories, trace)
            found.append(Scenario(label, trace, world, runs, factories, costs))
    return found


SETTING = (
    *("trace", "tracker", "dataset", "times_from"),
    *("policy", "fps", "latency", "scale", "convention"),
)


@dataclass(frozen=True, eq=False, repr=False)
class EvaluationResult:
    """What :func:`evaluate` found.

    Attributes:
        parts: one per trace and world.

    Example:
        >>> import lae_sim
        >>> result = lae_sim.evaluate("traces/synthetic-slow.parquet", scale=[1, 2])
        >>> result.summary[["scale", "forecaster", "auc", "recovered_auc"]].round(3)
           scale forecaster    auc  recovered_auc
        0    1.0       hold  0.572            NaN
        1    1.0     kalman  0.629          0.278
        2    2.0       hold  0.439            NaN
        3    2.0     kalman  0.501          0.182
        >>> result.answers("boat-calm", "kalman")[["frame", "source_frame", "iou"]].round(3).tail(2)
             frame  source_frame    iou
        298    298           296  0.936
        299    299           297  0.908
        >>> result.plot()
        <Figure ...>
    """

    parts: tuple[Evaluated, ...]

    @cached_property
    def summary(self) -> DataFrame:
        """Mean scores: a row per trace, world, forecaster and permitted latency.

        Columns: what the row is of (:data:`SETTING`, forecaster, sigma), the number of sequences,
        the scores and offline scores in 0..1, the share of the latency loss ``recovered`` (NaN if
        unknown), ``modelled_auc`` and ``modelled_dp20`` under the search model with the ends of
        their intervals, ``_low`` and ``_high`` (NaN where the replay is exact), ``mismatch_mean``
        in frames, ``age_ms``, ``skip_rate``, and ``exact``: whether every output follows the frame
        that it followed when it was recorded.
        """
        import pandas as pd

        rows = []
        for part in self.parts:
            document = part.document()
            offline = document["offline"] or dict.fromkeys(METRICS)
            for result in document["results"]:
                modelled = result["modelled"] or dict.fromkeys(FIGURES)
                rows.append(
                    {
                        **_setting(part.scenario),
                        "forecaster": result["forecaster"],
                        "sigma": result["sigma"],
                        "sequences": document["sequences"],
                        **{metric: result[metric] for metric in METRICS},
                        **{f"offline_{metric}": offline[metric] for metric in METRICS},
                        "recovered_auc": result["recovered_auc"],
                        "recovered_dp20": result["recovered_dp20"],
                        **{f"modelled_{name}": modelled[name] for name in FIGURES},
                        "mismatch_mean": result["mismatch_mean"],
                        "age_ms": result["age_ms"],
                        "skip_rate": document["skip_rate"],
                        "exact": document["exact"],
                    }
                )
        numbers = [f"{place}{metric}" for place in ("", "offline_") for metric in METRICS]
        numbers += ["recovered_auc", "recovered_dp20", *(f"modelled_{name}" for name in FIGURES)]
        return pd.DataFrame(rows).astype(dict.fromkeys(numbers, "float64"))

    @cached_property
    def notes(self) -> list[str]:
        """What keeps the scores from being what they seem, each once."""
        several = len({part.scenario.label for part in self.parts}) > 1
        notes = [
            (f"{part.scenario.label}: " if several else "") + note
            for part in self.parts
            for note in (*part.notes, *_assumption(part), *_exactness(part))
        ]
        return list(dict.fromkeys(notes))

    def to_frame(self) -> DataFrame:
        """Every score: a row per trace, world, sequence, forecaster and permitted latency.

        Columns: :data:`SETTING`, sequence, forecaster, sigma; the scores and offline scores in
        0..1 (NaN where the sequence leaves the mean); ``modelled_auc``, ``modelled_dp20`` and the
        ends of their intervals (NaN where the replay is exact); ``world_frames``, ``processed`` and
        ``approximate_outputs``; ``mismatch_mean`` in frames.
        """
        import pandas as pd

        tables = []
        for part in self.parts:
            sigmas = [float(sigma) for sigma in part.scenario.world.sigmas]
            for scored in part.rows.parts:
                table = _sequence_table(scored, list(part.scenario.forecasters), sigmas)
                tables.append(table.assign(**_setting(part.scenario)))
        joined = pd.concat(tables, ignore_index=True)
        first = [*SETTING, "sequence", "forecaster", "sigma"]
        return joined[[*first, *joined.columns.difference(first, sort=False)]]

    def answers(
        self,
        sequence: str,
        forecaster: str,
        *,
        trace: str | None = None,
        sigma: Number | None = None,
    ) -> DataFrame:
        """What a forecaster answered for every world frame of a sequence.

        Args:
            sequence: its name.
            forecaster: its name.
            trace: the trace's name, if there are several; of several worlds the first is taken.
            sigma: the permitted latency; the first by default.

        Returns:
            A row per world frame: ``frame``; the answer ``x, y, w, h`` in pixels; ``source_frame``,
            the frame of the output that it comes from; the truth ``truth_x`` to ``truth_h``; the
            ``iou`` of the two; ``visible``, where the trace says whether the target is.

        Raises:
            LaeError: if there is no such trace, sequence, forecaster or permitted latency.
        """
        import pandas as pd

        scenario = self._scenario(trace)
        if forecaster not in scenario.forecasters:
            known = ", ".join(scenario.forecasters)
            raise LaeError(f"forecaster: no {shown(forecaster)} here: there are {known}")
        sigmas = scenario.world.sigmas
        chosen = sigmas[0] if sigma is None else named("sigma", exact, sigma)
        if chosen not in sigmas:
            raise LaeError(f"sigma: {chosen} is not evaluated here: evaluate(sigma=...) does so")
        run = next((run for run in scenario.runs if run.recording.name == sequence), None)
        if run is None:
            known = hint(sequence, scenario.trace.names)
            raise LaeError(f"sequence: no {shown(sequence)} in {scenario.label}{known}")
        found = answers(
            run,
            scenario.trace.metadata,
            forecaster,
            scenario.forecasters[forecaster],
            chosen,
            scenario.costs.get(forecaster, 0),
        )
        truth, visible = run.recording.truth, run.recording.visible
        return pd.DataFrame(
            {
                "frame": np.arange(len(run)),
                **dict(zip("xywh", found.boxes.T)),
                "source_frame": found.source_frame,
                **dict(zip(("truth_x", "truth_y", "truth_w", "truth_h"), truth.T)),
                "iou": iou(found.boxes, truth),
                **({} if visible is None else {"visible": visible}),
            }
        )

    def plot(self) -> Figure:
        """Success and precision of all traces, or of a sweep how AUC and DP change over it."""
        return plot_evaluations(self.parts)

    def plot_waterfall(self) -> Figure:
        """Where the time goes in pipelines, from a frame's capture to its answer.

        Raises:
            LaeError: if none was replayed, or none has answered a frame.
        """
        return plot_waterfalls(self.parts)

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Write what a paper needs: figures and tables (see :mod:`lae_sim.report.paper`).

        Raises:
            LaeError: if a file cannot be written.
        """
        from lae_sim.figures.column import drawn
        from lae_sim.report.paper import Paper, write_paper

        document = self.document(attributes=True)
        write_paper(
            Paper(
                map(drawn, figures_for_paper(self.parts)),
                paper_tables(document["traces"], [part.scenario.label for part in self.parts]),
                {"scores": self.summary, "sequences": self.to_frame()},
                {"replay.json": document},
            ),
            folder,
        )

    def document(self, attributes: bool = False, per_sequence: bool = False) -> dict[str, Any]:
        """All of it as one JSON object, as ``lae-sim replay --json`` prints it."""
        from lae_sim import __version__

        traces = [part.document(attributes, per_sequence) for part in self.parts]
        return {"format": "lae-replay", "version": "1.0", "lae_sim": __version__, "traces": traces}

    def _scenario(self, trace: str | None) -> Scenario:
        named = {part.scenario.label: part.scenario for part in reversed(self.parts)}
        if trace is None and len(named) == 1:
            return next(iter(named.values()))
        if trace not in named:
            raise LaeError(f"trace: name one of {listed(reversed(named))}")
        return named[trace]

    def __repr__(self) -> str:
        first, count = self.parts[0], len(self.parts)
        rows = self.summary.head(len(first.scenario.forecasters) * len(first.scenario.world.sigmas))
        rows = rows.drop_duplicates("forecaster")
        scores = ", ".join(f"{row.forecaster} {FINE_SCORE(row.auc)}" for row in rows.itertuples())
        more = f" and {count - 1} more" if count > 1 else ""
        setting = f"{first.scenario.label}, {first.scenario.world.label()}"
        return " ".join(f"<EvaluationResult of {setting}{more}: AUC {scores}>".split())

    def _repr_html_(self) -> str:
        from html import escape

        table = self.summary
        shown = [
            *(name for name in SETTING if table[name].nunique() > 1 or name == "trace"),
            *("forecaster", "sigma", "sequences", "auc", "offline_auc", "recovered_auc", "dp20"),
            *("age_ms", "exact"),
        ]
        html: str = table[shown].to_html(index=False, float_format="{:.4f}".format, na_rep="-")
        return html + "".join(f"<p>{escape(note)}</p>" for note in self.notes)


def _setting(scenario: Scenario) -> dict[str, Any]:
    """What the rows of a scenario are of, by the names of :data:`SETTING`."""
    metadata, world, timing = scenario.trace.metadata, scenario.world, scenario.runs.timing
    values = (
        scenario.label,
        metadata.tracker,
        metadata.dataset,
        scenario.label if timing is None else Path(path_of(timing) or timing.metadata.device).name,
        world.policy_label,
        float(scenario.runs.clock.fps),
        label_of(world.latency),
        float(world.scale),
        world.convention,
    )
    return dict(zip(SETTING, values))


def _sequence_table(
    scored: Evaluation, forecasters: Sequence[str], sigmas: Sequence[float]
) -> DataFrame:
    """The scores of some sequences: a row per forecaster, sequence and permitted latency."""
    import pandas as pd

    replay, axes = scored.replay, [forecasters, scored.replay.sequences, sigmas]
    index = pd.MultiIndex.from_product(axes, names=["forecaster", "sequence", "sigma"])
    frames = replay.frames[:, None]
    columns: dict[str, Any] = {metric: scored.scores[metric] for metric in METRICS}
    columns |= {f"offline_{metric}": scored.offline[metric][:, None] for metric in METRICS}
    columns |= {
        f"modelled_{name}": np.where(scored.modelled.applies[:, None], values, np.nan)
        for name, values in scored.modelled.figures().items()
    }
    columns |= {
        "world_frames": frames,
        "processed": replay.processed[:, None],
        "approximate_outputs": replay.departures[:, None],
        "mismatch_mean": scored.staleness.mismatch_sum / frames,
    }
    shape = tuple(map(len, axes))
    flat = {name: np.broadcast_to(values, shape).ravel() for name, values in columns.items()}
    return pd.DataFrame(flat, index).reset_index()


def _assumption(part: Evaluated) -> list[str]:
    return [] if part.init.is_measured else [str(part.init)]


def _exactness(part: Evaluated) -> list[str]:
    share = part.totals.replay.approximate_share
    if not share:
        return []
    return [
        f"approximate: {100 * share:.3g}% of the outputs follow another frame than "
        "when recorded; a tracker that searches near its last answer would do worse"
    ]


@dataclass(frozen=True)
class _Plotted:
    """What figures of evaluations show.

    Attributes:
        at: the permitted latency of a sweep's scores.
        runs: what tells the parts apart, but for what is swept: one tuple a part.
        several: the names of what is in these tuples.
        swept: ``fps`` and ``latency_scale``, as far as they vary.
        setting: what all have in common, in words.
    """

    at: Fraction
    runs: Sequence[tuple[str, ...]]
    several: Sequence[str]
    swept: Sequence[str]
    setting: str

    @classmethod
    def of(cls, parts: Sequence[Evaluated], sigma: Fraction | None) -> _Plotted:
        from lae_sim.report.export import sigma_text

        first = parts[0].scenario
        at = first.world.sigmas[0] if sigma is None else sigma
        settings = [_setting(part.scenario) for part in parts]
        several = [
            name
            for name in ("trace", "policy", "latency")
            if len({setting[name] for setting in settings}) > 1
        ]
        setting = "" if "trace" in several else f"{first.label}: "
        setting += f"sigma {sigma_text(at)}, convention {first.world.convention}"
        runs = [tuple(setting[name] for name in several) for setting in settings]
        swept = [
            key
            for key, name in (("fps", "fps"), ("latency_scale", "scale"))
            if len({(run, each[name]) for run, each in zip(runs, settings)}) > len(set(runs))
        ]
        return cls(at, runs, several, swept, setting)

    def curves(self, parts: Sequence[Evaluated]) -> dict[str, tuple[Floats, Floats]]:
        """Success and precision by name (see :func:`.figures.replay.success_and_precision`)."""
        from lae_sim.figures.replay import mean_curves

        curves = {}
        for part, run in zip(parts, self.runs):
            if "trace" in self.several:
                run = (str(Path(run[0]).with_suffix("")), *run[1:])
            prefix = f"{', '.join(run)}: " if run else ""
            found = mean_curves(part.totals.curves, list(part.scenario.forecasters))
            curves.update({prefix + name: curve for name, curve in found.items()})
        return curves


def plot_evaluations(parts: Sequence[Evaluated], sigma: Fraction | None = None) -> Figure:
    """Success and precision of evaluations, or of a sweep how AUC and DP change over it.

    Args:
        parts: of one or several traces, in one world or several.
        sigma: the permitted latency of a sweep's scores; the first by default. Success and
            precision are at the first in any case.

    Raises:
        LaeError: if no sequence is scored.
    """
    from lae_sim.figures.replay import success_and_precision, sweep_figure

    if not any(part.totals.replay.scored.any() for part in parts):
        raise LaeError(f"nothing to draw: {UNSCORED}")
    plotted = _Plotted.of(parts, sigma)
    if plotted.swept:
        reports = [part.document() for part in parts]
        names = [", ".join(run) for run in plotted.runs]
        return sweep_figure(reports, names, float(plotted.at), plotted.swept, plotted.setting)
    return success_and_precision(plotted.curves(parts), plotted.setting)


def plot_waterfalls(parts: Sequence[Evaluated]) -> Figure:
    """Where the time goes in pipelines, from a frame's capture to its answer, a panel for each.

    Args:
        parts: of one or several traces, in one world or several.

    Raises:
        LaeError: if none was replayed through a pipeline, or none of its frames was answered.
    """
    from lae_sim.figures.pipeline import waterfall_figure

    return waterfall_figure(*_waterfalls(parts))


_TOLD = {"fps": "{:g} fps", "scale": "times x {:g}"}


def _waterfalls(parts: Sequence[Evaluated]) -> tuple[list[dict[str, Any]], list[str]]:
    """The documents of pipelines that have answered, and a name for each."""
    reports, settings = [], []
    for part in parts:
        if part.pipeline is not None and part.pipeline.outputs:
            reports.append(part.document())
            settings.append({**_setting(part.scenario), "policy": part.pipeline.pipeline.name})
    if not reports:
        raise LaeError("nothing to draw a waterfall of: no pipeline has answered a frame")
    several = len({setting["policy"] for setting in settings})
    telling = [
        name
        for name in ("trace", "latency", "fps", "scale")
        if len({(setting["policy"], setting[name]) for setting in settings}) > several
    ]
    names = [
        ", ".join([
            setting["policy"],
            *(_TOLD.get(name, "{}").format(setting[name]) for name in telling),
        ])
        for setting in settings
    ]  # fmt: skip
    return reports, names


def _metric(panel: Panel) -> str:
    """The metric of a panel, as files are named."""
    return panel.ylabel.lower().replace(" at 20 px", "20")


def figures_for_paper(
    parts: Sequence[Evaluated], sigma: Fraction | None = None
) -> Iterator[ColumnFigure]:
    """The same in the style of a paper; then scores over sigma, waterfalls, and a timeline.

    The timeline is of the first sequence of the first trace, if its policy scores latency.
    """
    from lae_sim.figures.column import ColumnFigure
    from lae_sim.figures.lines import panel_in_column
    from lae_sim.figures.replay import (
        curves_for_paper,
        sigma_panels,
        sweep_panels,
        timeline_for_paper,
    )

    plotted = _Plotted.of(parts, sigma)
    reports = [part.document() for part in parts]
    names = [", ".join(run) for run in plotted.runs]
    if plotted.swept:
        at, swept = float(plotted.at), plotted.swept
        for panel in sweep_panels(reports, names, at, swept, of_paper=True):
            yield ColumnFigure(
                f"{_metric(panel)}-over-{swept[0]}-{panel.title}",
                f"{panel.ylabel} over the {panel.xlabel}; {panel.title} {plotted.setting}",
                partial(panel_in_column, panel),
            )
    else:
        yield from curves_for_paper(plotted.curves(parts), plotted.setting)
    for part, report, name in zip(parts, reports, names):
        if len(part.scenario.world.sigmas) > 1 and not plotted.swept:
            for panel in sigma_panels(report):
                yield ColumnFigure(
                    f"{_metric(panel)}-over-sigma-{name}",
                    f"{panel.ylabel} over the {panel.xlabel}; {part.scenario.label}",
                    partial(panel_in_column, panel),
                )
    if any(part.pipeline is not None and part.pipeline.outputs for part in parts):
        from lae_sim.figures.pipeline import waterfalls_for_paper

        yield from waterfalls_for_paper(*_waterfalls(parts))
    first = parts[0].scenario
    if scores_latency(first.world.rule()) and not any(first.costs.values()):
        yield timeline_for_paper(next(iter(first.runs)), plotted.at)


def evaluate(
    traces: Traces,
    *,
    forecasters: Forecasters = ("hold", "kalman"),
    sigma: Number | Iterable[Number] = 0,
    latency: str | LatencySource | Sequence[str | LatencySource] = "recorded",
    scale: Number | Sequence[Number] = 1,
    fps: Number | Sequence[Number] | None = None,
    policy: str | Policy | Sequence[str | Policy] | None = None,
    timing: TraceLike | None = None,
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
    progress: ShowProgress = None,
    forget_arrivals: bool = False,
    pipeline: Pipelines = None,
) -> EvaluationResult:
    """Replay traces and score them, latency counted.

    What is a name, a duration or a number on the command line is one here too. Several latencies,
    scales, rates or policies are a sweep: every combination is replayed.

    Args:
        traces: a trace, several, or a mapping from names to traces: paths, folders, globs, URLs, or
            what :func:`read_trace` gives.
        forecasters: names, classes or factories, or a mapping from names to these; ``"hold"``, the
            baseline, is always scored.
        sigma: permitted latencies in frames, or ``"grid"`` for 0, 0.02, ..., 1.
        latency: where processing times come from, such as ``"recorded"``, ``"constant:47ms"`` or,
            with the initialisation told apart, ``"constant:47ms,init=800ms"``.
        scale: exact factor on all times: ``1.5`` is 3/2, ``0.1`` is 1/10.
        fps: frames that the world shows per second, such as ``30`` or ``"30000/1001"``.
        policy: which frame a free tracker takes, such as ``"latest"`` or ``"fifo"``; by default
            ``"recorded"`` of a measured log, ``"latest"`` of any other trace.
        timing: another device's trace of the same sequences, to take the times from.
        passes: further traces of the same tracker: at other strides, and gap passes; of several
            traces, each pass goes with those of its tracker and dataset.
        search: how far the tracker finds its target: ``"trace"`` (what trace and gap passes know),
            ``"c=0.7"``, ``"c=0.6-1.0"`` or ``"off"`` (see
            :func:`lae_sim.replay.search.parse_search`).
        pre_forecaster: the forecaster that says where the tracker searches; its worth is modelled.
        keep_size: whether it says the centre only.
        convention: how frames and thresholds count.
        costs: what forecasting costs: ``"2ms"``, ``"kalman=2ms"`` or ``{"kalman": "2ms"}``.
        sequences: those wanted; all by default.
        root, dataset, camera_lag: the frames, for ``camera+NAME`` (see
            :func:`lae_sim.learning.registry.find_camera`).
        progress: whether to show a progress bar, by default on a terminal and in a notebook; or a
            function, which is told: ``progress(done, total, what)``.
        forget_arrivals: let frames arrive evenly also where a trace says when each of them did,
            which is needed for another rate.
        pipeline: stages around the tracker, or the path of a TOML file of them; or several.

    Raises:
        LaeError: if an argument is impossible, a file is missing, or a frame is asked for that a
            trace lacks; it says which.

    Example:
        >>> import lae_sim
        >>> result = lae_sim.evaluate("traces/synthetic-slow.parquet", latency="constant:47ms")
        >>> result
        <EvaluationResult of synthetic-slow.parquet, constant:47ms: AUC hold 0.5791, kalman 0.6414>
        >>> result.to_frame().groupby("forecaster")["auc"].mean().round(4).to_dict()
        {'hold': 0.5791, 'kalman': 0.6414}
    """
    wanted = None if sequences is None else sequence_names(sequences)
    opened = labelled_traces(traces, wanted)
    makers = named_forecasters(forecasters)
    check_frames(makers, root)
    worlds = World.sweep(
        fps=fps,
        policy=policy,
        latency=latency,
        scale=scale,
        search=search,
        pre_forecaster=pre_forecaster,
        keep_size=keep_size,
        forget_arrivals=forget_arrivals,
        pipeline=pipeline,
        sigma=sigma,
        convention=convention,
        forecasters=makers,
        costs=cost_texts(costs),
        **open_others(timing, passes),
    )
    asked = scenarios(
        opened,
        worlds,
        forecasters=makers,
        sequences=wanted,
        root=root,
        dataset=dataset,
        camera_lag=camera_lag,
    )
    with scenario_bar(asked, progress) as advance:
        return EvaluationResult(tuple(scenario.evaluate(progress=advance) for scenario in asked))


@contextmanager
def scenario_bar(
    asked: Sequence[Scenario], show: ShowProgress = None
) -> Iterator[Callable[[int], object]]:
    """A progress bar over the world frames of scenarios, and what moves it by so many frames."""
    known = [scenario.trace.frames for scenario in asked]
    total = None if None in known else sum(map(int, known))  # type: ignore[arg-type]
    done = 0
    with ProgressBar("replay", "frames", show) as bar:

        def advance(frames: int) -> None:
            nonlocal done
            done += frames
            bar(done, total)

        yield advance
