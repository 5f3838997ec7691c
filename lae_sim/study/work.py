"""The pieces of work that a study hands to its workers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

from lae_sim import __version__
from lae_sim._compiled import expect
from lae_sim.errors import LaeError, explained
from lae_sim.files import text_digest
from lae_sim.study.cells import Cell, Input, Result, Setting, Task, compute
from lae_sim.study.comparisons import Rivals
from lae_sim.study.deployment import Search, measured
from lae_sim.study.records import Failure
from lae_sim.study.rows import RowsFile
from lae_sim.trace.file import Trace, read_held
from lae_sim.trace.locate import digest, stamp


@dataclass(frozen=True)
class Description:
    """A trace that is to be described, as ``lae-sim show`` does.

    Attributes:
        trace: which.
        sequences: those wanted; all if empty.
    """

    trace: Input
    sequences: tuple[str, ...]

    @property
    def key(self) -> str:
        """Digest of all that the description depends on."""
        return text_digest(repr((__version__, self.trace.label, self.trace.digest, self.sequences)))


Work: TypeAlias = Description | Task | Search | Rivals

BATCH = 1 << 16
"""World frames that small pieces of work come to together, about, each as often as it is scored."""

_TRIED = 60  # scales, in a search
_EACH, _FRAME = 1.5e-3, 0.35e-6  # seconds that a piece takes, and a frame each time it is scored


@dataclass(frozen=True)
class Batch:
    """Pieces of work that are done one after another, in one process.

    Attributes:
        works: of one trace after another.
    """

    works: tuple[Work, ...]


@dataclass(frozen=True)
class Done:
    """What came of a batch.

    Attributes:
        found: of each piece (see :func:`attempt`).
        rows: the file of all cells' rows, if the batch has several tasks; else empty.
    """

    found: tuple[Any, ...]
    rows: bytes = b""


def batches(works: Iterable[Work], frames: Mapping[Input, int]) -> Iterator[Batch]:
    """Small pieces of work together, a large one alone, those of a trace after one another.

    Args:
        works: descriptions, tasks and searches.
        frames: world frames of each trace.
    """
    by_trace: dict[Input, list[Work]] = {}
    for work in works:
        by_trace.setdefault(_inputs(work)[0], []).append(work)
    together: list[Work] = []
    cost = 0
    for trace, some in by_trace.items():
        first = 2 if isinstance(some[0], Description) else 1  # with what it is read for anyway
        for unit in (some[:first], *([work] for work in some[first:])):
            own = sum(frames[trace] * _times_scored(work) for work in unit)
            if together and cost + own > BATCH:
                yield Batch(tuple(together))
                together, cost = [], 0
            together += unit
            cost += own
    if together:
        yield Batch(tuple(together))


def seconds(works: Iterable[Work], frames: Mapping[Input, int]) -> float:
    """How long work takes in one process, about: of the same order, wherever that is."""
    scored = (frames[_inputs(work)[0]] * _times_scored(work) for work in works)
    return sum(_EACH + _FRAME * each for each in scored)


def _times_scored(work: Work) -> int:
    """How often the frames of its trace are scored, about."""
    if isinstance(work, Task):
        setting = work.cells[0].setting
        return setting.count * (len(work.cells) + len(setting.world.sigmas) // 8)
    return _TRIED * work.cell.setting.count if isinstance(work, Search) else 1


def attempt_batch(batch: Batch, share: int = 0) -> Done:
    """Do the pieces of a batch, on some worker.

    Args:
        batch: which.
        share: how much a worker does in the whole study (see :func:`lae_sim._compiled.amount`).
    """
    expect(share)
    tasks = [work for work in batch.works if isinstance(work, Task)]
    shared = RowsFile() if len(tasks) > 1 else None
    traces = _Traces()
    together = _together(tasks, traces, shared) if shared is not None else {}
    found = tuple(
        together[id(work)] if id(work) in together else attempt(work, traces, shared)
        for work in batch.works
    )
    return Done(found, b"" if shared is None else shared.finish())


def _together(tasks: Sequence[Task], traces: _Traces, shared: RowsFile) -> dict[int, list[Result]]:
    """The results of tasks by their identities; nothing where one fails, so that each is alone."""
    before = shared.rows
    try:
        with explained("failed"):
            for task in tasks:
                _check(task)
            settings = [task.cells[0].setting for task in tasks]
            read = [traces.read(each.trace, each.sequences) for each in settings]
            return dict(zip(map(id, tasks), compute(tasks, read, shared)))
    except LaeError:
        shared.undo(before)
        return {}


class _Traces:
    """The traces that have been read, for the pieces of work of a batch."""

    def __init__(self) -> None:
        self._read: dict[tuple[Input, tuple[str, ...]], Trace] = {}

    def read(self, trace: Input, sequences: tuple[str, ...]) -> Trace:
        """A trace, which is read once."""
        key = trace, sequences
        if key not in self._read:
            self._read[key] = read_held(trace.path, sequences or None)
        return self._read[key]


def attempt(work: Work, traces: _Traces | None = None, shared: RowsFile | None = None) -> Any:
    """Do a piece of work; what cannot be done is a :class:`Failure`.

    Args:
        work: what to do.
        traces: what was read before, for pieces of work on the same trace.
        shared: the file of the rows of several cells.

    Returns:
        Of a description or a search its document, of a task the result or failure of each cell, of
        rivals their pairs.
    """
    try:
        with explained("failed"):
            _check(work)
            return _performed(work, traces or _Traces(), shared)
    except LaeError as error:
        return Failure(work_in_words(work), str(error))


def _check(work: Work) -> None:
    """Check that the files are as they were when the study was planned."""
    for trace in _inputs(work):
        if stamp(trace.path) != trace.stamp and digest(trace.path) != trace.digest:
            raise LaeError(f"{trace.path}: changed since the study began: run it again")


def _performed(work: Work, traces: _Traces, shared: RowsFile | None) -> Any:
    if isinstance(work, Task):
        setting = work.cells[0].setting
        return _cell_by_cell(work, traces.read(setting.trace, setting.sequences), shared)
    if isinstance(work, Search):
        return asdict(measured(work))
    if isinstance(work, Rivals):
        return work.pairs()
    from lae_sim.trace.describe import describe

    return describe(traces.read(work.trace, work.sequences), work.trace.label)[0]


def _cell_by_cell(task: Task, trace: Trace, shared: RowsFile | None) -> list[Result | Failure]:
    """The cells together; where that fails, each alone, so that one does not cost the others."""
    before = 0 if shared is None else shared.rows
    try:
        with explained("failed"):
            return [*compute([task], [trace], shared)[0]]
    except LaeError as error:
        if shared is not None:
            shared.undo(before)
        if len(task.cells) == 1:
            return [Failure(cell_in_words(task.cells[0]), str(error))]
    alone = [
        Task((cell,), {cell.forecaster: task.factories[cell.forecaster]}) for cell in task.cells
    ]
    results = [result for one in alone for result in _cell_by_cell(one, trace, shared)]
    reasons = {result.reason if isinstance(result, Failure) else "" for result in results}
    if len(reasons) == 1 and reasons != {""}:
        raise LaeError(*reasons)  # it lies with the replay
    return results


def _inputs(work: Work) -> list[Input]:
    if isinstance(work, Rivals):
        return []
    if isinstance(work, Description):
        return [work.trace]
    return _setting(work).inputs


def _setting(work: Task | Search) -> Setting:
    return work.cells[0].setting if isinstance(work, Task) else work.cell.setting


def work_in_words(work: Work) -> str:
    """What a piece of work is about, in words."""
    if isinstance(work, Description):
        return work.trace.label
    if isinstance(work, Rivals):
        return f"pairs of traces: {', '.join(work.setting.values())}"
    if isinstance(work, Search):
        cell = work.cell
        asked = ", ".join(f"{float(auc):g}" for auc in work.required)
        return f"AUC {asked} of {cell.forecaster}: {_in_words(cell.setting, False)}"
    return _in_words(_setting(work))


def _in_words(setting: Setting, scale: bool = True) -> str:
    factor = f" x {setting.world.scale}" if scale and setting.world.scale != 1 else ""
    searched = (
        "" if setting.world.search in ("off", "trace") else f", search {setting.world.search}"
    )
    if setting.world.pre_forecaster is not None:
        searched += f", pre-forecaster {setting.pre_forecaster}"
    times = f"{setting.latency}{factor}"
    return f"{setting.run}, {setting.policy}, {setting.fps} fps, {times}{searched}"


def cell_in_words(cell: Cell) -> str:
    """What a cell is about, in words."""
    return f"{_in_words(cell.setting)}, {cell.forecaster}, {cell.convention}"
