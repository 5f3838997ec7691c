"""Further passes of a tracker: told apart by kind, and given to the traces that they go with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from lae_sim.errors import LaeError
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata


def split_passes(passes: Iterable[Trace]) -> tuple[tuple[Trace, ...], tuple[Trace, ...]]:
    """Passes of every N-th frame, and gap passes, told apart by their metadata."""
    every = tuple(passes)
    gaps = tuple(trace for trace in every if trace.metadata.kind == "restarts")
    return tuple(trace for trace in every if trace not in gaps), gaps


class Described(Protocol):
    """What has the metadata of a trace: a trace, or what stands for one."""

    @property
    def metadata(self) -> Metadata:
        """What the trace says of itself."""


Pass = TypeVar("Pass", bound=Described)


def passes_for(traces: Sequence[Described], passes: Sequence[Pass]) -> list[tuple[Pass, ...]]:
    """The passes that go with each of some traces: those of its tracker and dataset.

    A single trace has all of them, whatever they say of themselves.

    Raises:
        LaeError: if a pass goes with none of several traces.
    """
    if len(traces) == 1:
        return [tuple(passes)]
    for each in passes:
        if not any(trace.metadata.goes_with(each.metadata) for trace in traces):
            raise LaeError(
                f"a pass is of {each.metadata.tracker} on {each.metadata.dataset}: none of the "
                "traces is of the same tracker and dataset"
            )
    return [
        tuple(each for each in passes if trace.metadata.goes_with(each.metadata))
        for trace in traces
    ]
