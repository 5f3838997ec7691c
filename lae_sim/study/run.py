"""Running a study: the plan's cells, on whatever workers there are, and what comes out of them."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from lae_sim import __version__
from lae_sim._compiled import amount
from lae_sim.comparison.pairs import Pairs
from lae_sim.errors import LaeError
from lae_sim.evaluation.caveats import at_the_floor, floor_notes
from lae_sim.files import check_distinct, csv_cell, text_digest, written_whole
from lae_sim.forecast.base import AnyFactory
from lae_sim.learning.registry import files_named
from lae_sim.replay.pipeline import times_named
from lae_sim.study.cells import Result, Task
from lae_sim.study.comparisons import PairsFile, Rivals, rivals_of
from lae_sim.study.deployment import Curve, Search, requirement, searches
from lae_sim.study.executors import RunAll, at_work, cores, run_here
from lae_sim.study.plan import Plan, make_plan, tasks
from lae_sim.study.records import MEAN, Comparison, Failure, Record, Requirement, SummaryRow
from lae_sim.study.spec import Study
from lae_sim.study.store import Documents, Store
from lae_sim.study.summary import (
    Scores,
    rankings_of,
    read_scores,
    summarise_study,
)
from lae_sim.study.uncertainty import Answers, Resamples
from lae_sim.study.verdict import verdict
from lae_sim.study.work import (
    Batch,
    Description,
    Done,
    Work,
    attempt,
    attempt_batch,
    batches,
    seconds,
)
from lae_sim.trace.describe import is_measured
from lae_sim.trace.locate import digest

if TYPE_CHECKING:
    from pandas import DataFrame


PAIRS = "comparisons.parquet"
"""The file of all pairs of traces."""

TABLES = "tables"
"""The document that says what the files of the summary were made of."""

ANSWERS = "answers"
"""The document of what resampling the scores said (see :class:`.uncertainty.Answers`)."""

FEW = 30_000
"""Pairs, counted twice, that are sooner compared here than handed to workers."""


ALONE = 1.0
"""Seconds of work for which no other process is started: that alone takes half of it."""


@dataclass(frozen=True, eq=False, repr=False)
class StudyResults:
    """The results of a study.

    Attributes:
        folder: where it is kept.
        plan: what was computed.
        scores: of every finished trace, setting, convention and forecaster.
        summary: means (see :func:`lae_sim.study.summary.summarise_study`).
        comparisons: pairs of traces, those of each setting with its best if there are too many to
            hold (see :data:`lae_sim.study.comparisons.MOST`): all are in ``comparisons.parquet``.
        pairs: how many there are in all.
        required: what a required AUC asks for (see :func:`lae_sim.study.deployment.requirement`).
        traces: what ``lae-sim show --json`` says of each trace, as it says it.
        computed: how many cells were computed now, and not found finished.
        failures: what could not be computed, and why.
        training: what to say of the forecasters that were trained.

    Example:
        >>> import tempfile
        >>> import lae_sim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     results = lae_sim.run_study(
        ...         traces="traces/synthetic-slow.parquet", folder=folder, workers=1, report=False
        ...     )
        ...     results.to_frame().shape
        (16, 43)
        >>> results
        <StudyResults of 2 settings, 2 cells in ...>
        >>> results.summary_frame()[["forecaster", "auc", "vs_hold_auc"]].round(3)
          forecaster    auc  vs_hold_auc
        0       hold  0.572          NaN
        1     kalman  0.629        0.057
        >>> print(*results.verdict())
        slow-and-accurate with kalman is best: AUC 0.629 [0.573, 0.687]; no difference shown: ...
    """

    folder: Path
    plan: Plan
    scores: tuple[Scores, ...]
    summary: tuple[SummaryRow, ...]
    comparisons: tuple[Comparison, ...]
    pairs: int
    required: tuple[Requirement, ...]
    traces: Sequence[Mapping[str, Any]]
    computed: int
    failures: tuple[Failure, ...]
    training: tuple[str, ...] = ()

    def to_frame(self) -> DataFrame:
        """Every score of every sequence, repetition and sigma (see :mod:`lae_sim.study.rows`)."""
        import pyarrow as pa

        store = Store(self.folder)
        store.open()
        tables = [store.rows(cell) for cell in self.plan.cells if store.has(cell)]
        return pa.concat_tables(tables).to_pandas()

    def summary_frame(self) -> DataFrame:
        """The summary as a table: the columns of ``summary.csv``."""
        import pandas as pd

        return pd.DataFrame(flat_rows(self.summary))

    def score_names(self) -> list[str]:
        """The columns of :meth:`score_rows`."""
        flat = (record.flat() for record in self.summary)
        return [*dict.fromkeys(chain.from_iterable(flat)), "over_sigmas"]

    def score_rows(self) -> Iterator[dict[str, Any]]:
        """The rows of the summary with all numbers as numbers.

        World rates and scales are floats, and so is sigma, which is unknown where scores are means
        over the grid of sigmas; ``over_sigmas`` says so.
        """
        for record in self.summary:
            over = record.sigma == MEAN
            numbers = {
                "fps": float(record.fps),
                "scale": float(record.scale),
                "sigma": math.nan if over else float(record.sigma),
            }
            yield {**record.flat(), **numbers, "over_sigmas": over}

    def __repr__(self) -> str:
        cells, failed = len(self.plan.cells), len(self.failures)
        more = f", {failed} of its parts failed" if failed else ""
        return (
            f"<StudyResults of {len(self.scores)} settings, {cells} cells in {self.folder}{more}>"
        )

    def _repr_html_(self) -> str:
        table = self.summary_frame()
        several = [name for name in table.columns[:12] if table[name].nunique() > 1]
        shown = list(dict.fromkeys(["trace", *several, "forecaster", "sigma", "auc", "dp20"]))
        html: str = table[shown].to_html(index=False, float_format="{:.4f}".format, na_rep="-")
        return html

    def init_sources(self, assumed: bool = False) -> list[str]:
        """How one knows what initialisations cost, and at which latencies.

        Args:
            assumed: whether those are left out that were measured.
        """
        latencies: dict[str, dict[str, None]] = {}
        for row in self.summary:
            if not (assumed and is_measured(row.init_source)):
                unscaled = row.init_source.removesuffix(f" x {row.scale}")
                latencies.setdefault(unscaled, {})[row.latency] = None
        return [f"initialisation at {', '.join(some)}: {how}" for how, some in latencies.items()]

    def ranked_by(self) -> list[str]:
        """By what is ranked, compared and tested, and why; nothing where nothing is modelled."""
        rankings = dict.fromkeys(rankings_of(self.scores).values())
        return [str(ranking) for ranking in rankings if ranking.reason]

    def timing_sources(self) -> list[str]:
        """Where the times of traces are from, as far as these say so."""
        return self._of_traces(
            (source.input.label, f"times: {source.metadata.timing_note}")
            for source in self.plan.sources
            if source.metadata.timing_note
        )

    def search_sources(self) -> list[str]:
        """What is known of the reach of the trackers of traces, where something is modelled."""
        return self._of_traces(
            (scores.setting.trace.label, f"modelled: {source}")
            for scores in self.scores
            for source in scores.reach_sources
        )

    def _of_traces(self, said: Iterable[tuple[str, str]]) -> list[str]:
        """What is said of traces by their labels, each once, and of which of them."""
        labels: dict[str, dict[str, None]] = {}
        for label, text in said:
            labels.setdefault(text, {})[label] = None
        count = len(self.plan.sources)
        return [
            f"{'all traces' if len(some) == count > 1 else ', '.join(some)}: {text}"
            for text, some in labels.items()
        ]

    def notes(self) -> list[str]:
        """What keeps the figures from being what their names promise, each once."""
        members: dict[str, set[tuple[str, ...]]] = {}
        for scores in self.scores:
            members.setdefault(scores.source.metadata.dataset, set()).add(scores.sequences)
        notes = [
            f"{dataset}: its traces do not have the same sequences: compare no means"
            for dataset, sequences in members.items()
            if len(sequences) > 1
        ]
        notes += [*self.timing_sources(), *self.init_sources(assumed=True), *self.training]
        notes += self.search_sources()
        if any(scores.known is False for scores in self.scores):
            notes.append(
                'measure c: lae-sim profile --gaps, then passes = ["TRACE.gaps.parquet"]; or name '
                'it: search = "c=0.7"; search = "off" leaves the model out'
            )
        notes += [note for scores in self.scores for note in scores.notes]
        notes += floor_notes(
            row.trace + (f" x {row.scale}" if row.scale != 1 else "")
            for row in self.summary
            if row.sigma == 0 and row.staleness
            if at_the_floor(row.skip_rate, row.staleness.mismatch_mean)
        )
        for trace in self.traces:
            notes += [f"{trace['trace']}: {text}" for text in trace["warnings"]]
        return list(dict.fromkeys(notes))

    def verdict(self) -> list[str]:
        """What it comes to, in words (see :func:`lae_sim.study.verdict.verdict`)."""
        return verdict(self.summary, self.required)

    def document(self) -> dict[str, Any]:
        """All but the scores of single sequences, as ``study.json`` holds it."""
        parts = self._document().items()
        return {key: [*each] if isinstance(each, Iterator) else each for key, each in parts}

    def _document(self) -> dict[str, Any]:
        """The same, its lists of what may be many as they are gone through."""
        return {
            "format": "lae-study",
            "version": "1.0",
            "lae_sim": __version__,
            "study": self.plan.study.document(),
            "verdict": self.verdict(),
            "cells": len(self.plan.cells),
            "failures": flat_rows(self.failures),
            "notes": self.notes(),
            "summary": (record.flat() for record in self.summary),
            "comparisons": (record.flat() for record in self.comparisons),
            "required": (record.flat() for record in self.required),
            "traces": iter(self.traces),
        }


def compute_study(
    study: Study,
    folder: str | os.PathLike[str],
    base: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[str, int, int], object] = lambda what, done, total: None,
    then: Callable[[StudyResults, RunAll], object] = lambda results, run: None,
) -> StudyResults:
    """Compute what is not yet finished, and sum up.

    Args:
        study: what is asked for.
        folder: where results are kept; finished cells found there are not computed again.
        base: the folder that relative paths of traces are from; the current one by default.
        workers: processes on this machine; by default one for each core, or this one alone where
            there is little to do. No result depends on it.
        scheduler: address of a Dask cluster to compute on instead, such as ``tcp://host:8786``;
            its workers must see the traces under the same paths.
        progress: told what is going on, how much of it is done, and of how much.
        then: what is done in the end, with the results and the workers of this machine.

    Raises:
        LaeError: if the study cannot be planned, nothing could be computed, or a worker died.
    """
    plan = make_plan(study, base)
    names = [*study.forecasters, *filter(None, study.pre_forecaster), *study.policies]
    names += [*study.times, *(time for each in study.pipelines for time in times_named(each))]
    files = [file for name in names for file in files_named(name)]
    check_inputs(folder, [*(source.input.path for source in plan.sources), *files])
    store = Store(folder)
    with store.locked():
        return _run(plan, store, workers, scheduler, progress, then)


def check_inputs(folder: str | os.PathLike[str], inputs: Sequence[str | os.PathLike[str]]) -> None:
    """Check that what a study writes, or takes away, is nothing that it reads, and only files.

    Raises:
        LaeError: if it is, or if a folder stands where a file is to be, or a file for a folder.
    """
    written = [Path(folder, f"{name}.csv") for name in ("summary", "comparisons", "required")]
    names = ("study.json", "report.html", "contents.json", PAIRS)
    written += [Path(folder, name) for name in names]
    folders = [Path(folder, name) for name in ("figures", "tables")]
    inside = [path for each in folders for path in each.glob("*")]
    for path in (*written, *(path for path in inside if path.suffix)):
        if path.exists() and not path.is_file():
            raise LaeError(f"{path}: is there already and is not a file: move it away")
    for each in folders:
        if each.exists() and not each.is_dir():
            raise LaeError(f"{each}: is there already and is not a folder: move it away")
    check_distinct([*written, *inside], inputs)


def _run(
    plan: Plan,
    store: Store,
    workers: int | None,
    scheduler: str | None,
    progress: Callable[[str, int, int], object],
    then: Callable[[StudyResults, RunAll], object],
) -> StudyResults:
    study = plan.study
    store.prepare(plan.cells)
    asked = searches(plan.cells, study.require_auc) if study.require_auc else []
    described = [Description(source.input, study.sequences) for source in plan.sources]
    cells = [cell for cell in plan.cells if not store.has(cell)]
    sought = [search for search in asked if not store.holds(search.key)]
    needed = {*(cell.forecaster for cell in cells), *(each.cell.forecaster for each in sought)}
    factories, training = _factories(plan, needed, store, lambda what: progress(what, 0, 1))
    works: list[Work] = [
        *(each for each in described if not store.holds(each.key)),
        *tasks(cells, factories),
        *(replace(search, factory=factories[search.cell.forecaster]) for search in sought),
    ]
    frames = {source.input: source.frames for source in plan.sources}
    pieces = [*batches(works, frames)]
    if workers is None:
        workers = cores() if seconds(works, frames) > ALONE else 1
    workers = min(workers, max(len(pieces), 1))
    share = sum(
        amount(frames[cell.setting.trace] * cell.setting.count, len(study.sigmas)) for cell in cells
    )
    attempted = partial(attempt_batch, share=share // workers)
    failures: list[Failure] = []
    computed = 0
    # closed whatever happens here, or workers would outlive the study
    with at_work(workers, scheduler) as run:
        with closing(run(attempted, pieces)) as attempts:
            for done, (batch, result) in enumerate(attempts, 1):
                progress("", done, len(pieces))
                computed += _keep(batch, result, store, failures)
        scores = tuple(read_scores(plan, store))
        if not scores:
            raise LaeError(f"nothing could be computed: {failures[0].reason}")
        compared = _compare(scores, study.seed, store, run, failures, progress)
        progress("summing up", len(pieces), len(pieces))
        answers = Answers(store.document(ANSWERS))
        summary = tuple(summarise_study(scores, study.seed, answers=answers, run=run))
        if answers.differ:
            store.keep(ANSWERS, answers.document())
        curves = ((search, store.document(search.key)) for search in asked)
        results = StudyResults(
            folder=store.folder,
            plan=plan,
            scores=scores,
            summary=summary,
            comparisons=compared[0],
            pairs=compared[1],
            required=tuple(
                requirement(search, Curve(**curve), auc)
                for search, curve in curves
                if curve
                for auc in search.required
            ),
            traces=Documents(
                store.document, [each.key for each in described if store.holds(each.key)]
            ),
            computed=computed,
            failures=tuple(sorted(failures, key=lambda failure: str(failure.flat()))),
            training=tuple(training),
        )
        _write(results, store)
        then(results, run_here if scheduler else run)
        return results


def _keep(batch: Batch, done: Done, store: Store, failures: list[Failure]) -> int:
    """Keep what came of a batch; how many cells were computed."""
    results: list[Result] = []
    documents = {}
    for work, found in zip(batch.works, done.found):
        if isinstance(found, Failure):
            failures.append(found)
        elif isinstance(work, Task):
            failures += [each for each in found if isinstance(each, Failure)]
            results += [each for each in found if isinstance(each, Result)]
        elif isinstance(work, (Description, Search)):
            documents[work.key] = found
    store.put(results, documents, done.rows)
    return len(results)


def _compare(
    scores: Sequence[Scores],
    seed: int,
    store: Store,
    run: RunAll,
    failures: list[Failure],
    progress: Callable[[str, int, int], object],
) -> tuple[tuple[Comparison, ...], int]:
    """The pairs that are held (see :data:`.comparisons.MOST`), and how many there are in all.

    They are computed on the workers, but for a few, and kept in the file of all pairs.
    """
    rivals = rivals_of(scores, rankings_of(scores), seed)
    pairs = PairsFile(store.folder / PAIRS, store.document("pairs"))
    if not rivals:
        pairs.path.unlink(missing_ok=True)
        return (), 0
    missing = [each for each in rivals if each.key not in pairs.places]
    if missing or [each.key for each in rivals] != list(pairs.places):
        few = sum(len(each.members) ** 2 for each in missing) < FEW
        with closing((run_here if few else run)(attempt, missing)) as attempts:
            early: dict[str, Pairs | None] = {}  # before their turn
            done = 0

            def found(wanted: Rivals) -> Pairs | None:
                """The pairs of some rivals, when their turn has come; None of what failed."""
                nonlocal done
                while wanted.key not in early:
                    each, result = next(attempts)
                    done += 1
                    if not few:
                        progress("pairs of traces", done, len(missing))
                    is_failure = isinstance(result, Failure)
                    failures.extend([result] if is_failure else [])
                    early[each.key] = None if is_failure else result
                return early.pop(wanted.key)

            pairs.write(rivals, found)
        store.keep("pairs", pairs.document())
    return tuple(pairs.records(rivals)), pairs.total


def _factories(
    plan: Plan, needed: set[str], store: Store, progress: Callable[[str], object]
) -> tuple[dict[str, AnyFactory], list[str]]:
    """A factory for each forecaster needed, and what to say of training, now or before."""
    key = f"{plan.training}-training"
    if needed.isdisjoint(plan.trainers):
        ready = {name: each for name, each in plan.forecasters.items() if name in needed}
        before = store.document(key) if plan.trainers else None
        return cast(dict[str, AnyFactory], ready), (before or {}).get("notes", [])
    factories, notes = plan.trained(progress)
    store.keep(key, {"notes": notes})
    return factories, notes


def _write(results: StudyResults, store: Store) -> None:
    """Write the summary, as CSV and JSON, unless those are there that were written of the same."""
    tables: dict[str, Sequence[Record]] = {
        "summary.csv": results.summary,
        "comparisons.csv": results.comparisons,
        "required.csv": results.required,
    }
    paths = [results.folder / name for name in ("study.json", *tables)]
    if (before := store.document(TABLES)) and before == _written(results, paths):
        return
    for name, records in tables.items():
        path = results.folder / name
        if records:
            write_csv(records, path)
        else:
            path.unlink(missing_ok=True)
    with (
        written_whole(results.folder / "study.json") as temporary,
        open(temporary, "w", encoding="utf-8") as file,
    ):
        file.writelines(_json(results._document()))
    store.keep(TABLES, _written(results, paths))


def _written(results: StudyResults, paths: Sequence[Path]) -> dict[str, Any]:
    """Digests of all that the summary depends on, and of those of its files that are there."""
    plan = results.plan
    made_of = (
        __version__,
        Resamples(plan.study.seed).key(),
        plan.study.document(),
        [(source.input.label, source.input.digest) for source in plan.sources],
        [cell.key for cell in plan.cells],
        [failure.flat() for failure in results.failures],
        results.training,
    )
    files = {path.name: digest(str(path)) for path in paths if path.exists()}
    return {"of": text_digest(repr(made_of)), "files": files}


def _json(document: Mapping[str, Any]) -> Iterator[str]:
    """The text of a document, a line of its lists at a time: as a whole it may be large."""
    yield "{"
    for place, (key, value) in enumerate(document.items()):
        yield f"{', ' * bool(place)}{json.dumps(key)}: "
        if isinstance(value, (list, Iterator)):
            yield "["
            for i, each in enumerate(value):
                yield f"{', ' * bool(i)}{json.dumps(each, allow_nan=False)}"
            yield "]"
        else:
            yield json.dumps(value, allow_nan=False)
    yield "}"


def write_csv(records: Sequence[Record], path: Path) -> None:
    """Write records as CSV, whole or not at all; what is unknown is empty."""
    columns = list(dict.fromkeys(chain.from_iterable(record.flat() for record in records)))
    with (
        written_whole(path) as temporary,
        open(temporary, "w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for record in records:
            row = record.flat()
            writer.writerow([csv_cell(row.get(name)) for name in columns])


def flat_rows(records: Sequence[Record]) -> list[dict[str, Any]]:
    """Records as JSON and CSV hold them; for a table of pandas too."""
    return [record.flat() for record in records]
