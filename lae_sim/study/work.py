"""The pieces of work that a study hands to its workers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

from lae_sim import __version__
from lae_sim._compiled import expect
from lae_sim.errors import LaeError, explained
from lae_sim.files import text_digest
from lae_sim.study.cells import Cell, Input, Result, Setting, Task, compute
from lae_sim.study.deployment import Search, measured
from lae_sim.study.records import Failure
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


Work: TypeAlias = Description | Task | Search


def attempt(work: Work, share: int = 0) -> Any:
    """Do a piece of work, on some worker; what cannot be done is a :class:`Failure`.

    Args:
        work: which.
        share: how much a worker does in the whole study (see :func:`lae_sim._compiled.amount`).

    Returns:
        Of a description or a search its document, of a task the result or failure of each cell.
    """
    expect(share)
    try:
        with explained("failed"):
            for trace in _inputs(work):
                if stamp(trace.path) != trace.stamp and digest(trace.path) != trace.digest:
                    raise LaeError(f"{trace.path}: changed since the study began: run it again")
            return _performed(work)
    except LaeError as error:
        return Failure(work_in_words(work), str(error))


def _performed(work: Work) -> Any:
    if isinstance(work, Task):
        return _cell_by_cell(work)
    if isinstance(work, Search):
        return asdict(measured(work))
    from lae_sim.trace.describe import describe
    from lae_sim.trace.file import read_trace

    trace = read_trace(work.trace.path, work.sequences or None)
    return describe(trace, work.trace.label)[0]


def _cell_by_cell(task: Task) -> list[Result | Failure]:
    """The cells together; where that fails, each alone, so that one does not cost the others."""
    try:
        with explained("failed"):
            return list(compute(task))
    except LaeError as error:
        if len(task.cells) == 1:
            return [Failure(cell_in_words(task.cells[0]), str(error))]
    alone = [
        Task((cell,), {cell.forecaster: task.factories[cell.forecaster]}) for cell in task.cells
    ]
    results = [result for one in alone for result in _cell_by_cell(one)]
    reasons = {result.reason if isinstance(result, Failure) else "" for result in results}
    if len(reasons) == 1 and reasons != {""}:
        raise LaeError(*reasons)  # it lies with the replay
    return results


def _inputs(work: Work) -> list[Input]:
    if isinstance(work, Description):
        return [work.trace]
    return _setting(work).inputs


def _setting(work: Task | Search) -> Setting:
    return work.cells[0].setting if isinstance(work, Task) else work.cell.setting


def work_in_words(work: Work) -> str:
    """What a piece of work is about, in words."""
    if isinstance(work, Description):
        return work.trace.label
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
