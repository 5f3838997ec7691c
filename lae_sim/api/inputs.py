"""Arguments as people give them: traces and forecasters."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from lae_sim.errors import LaeError
from lae_sim.files import labels
from lae_sim.replay.world import TraceLike, open_trace, several
from lae_sim.trace.file import Trace
from lae_sim.trace.locate import find_traces

if TYPE_CHECKING:
    from lae_sim.forecast.base import AnyFactory
    from lae_sim.learning.folds import Trainer

Forecasters: TypeAlias = (
    "str | AnyFactory | Trainer | Iterable[str | AnyFactory | Trainer] | "
    "Mapping[str, AnyFactory | Trainer]"
)
"""Forecasters by name, as classes or factories, or as a mapping from names to these."""


def labelled_traces(
    traces: TraceLike | Sequence[TraceLike] | Mapping[str, TraceLike],
    sequences: Iterable[str] | None = None,
) -> dict[str, Trace]:
    """Open traces, by the names they have in tables.

    Args:
        traces: a trace, several, or a mapping from names to traces; each is an open one, or a path,
            folder, glob or URL. Files are named by themselves where that tells them apart.
        sequences: those to read of files; all by default.

    Raises:
        LaeError: if there is none, one is missing or damaged, or two have the same name.
    """
    names = None if sequences is None else frozenset(several(sequences))
    if isinstance(traces, Mapping):
        return {label: open_trace(trace, names) for label, trace in traces.items()}
    opened: list[tuple[str, Trace]] = []
    for trace in several(traces):
        if isinstance(trace, Trace):
            opened.append((trace.metadata.tracker, trace))
        elif isinstance(trace, (str, os.PathLike)):
            opened += [(path, open_trace(path, names)) for path in find_traces([os.fspath(trace)])]
        else:
            raise LaeError(
                f"traces: a trace is a path, a URL or what read_trace gives, not {trace!r:.60}"
            )
    if not opened:
        raise LaeError("traces: name at least one")
    found = dict(zip(labels([name for name, _ in opened]), (trace for _, trace in opened)))
    if len(found) < len(opened):
        raise LaeError("traces: several have the same name: give a mapping from names to traces")
    return found


def forecaster_names(forecasters: Forecasters) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The names of forecasters, and what those that are not named stand for.

    Raises:
        LaeError: if one is neither a name nor something that makes forecasters.
    """
    if isinstance(forecasters, Mapping):
        return tuple(forecasters), dict(forecasters)
    names: list[str] = []
    objects: dict[str, Any] = {}
    for each in several(forecasters):
        if isinstance(each, str):
            names.append(each)
        elif callable(each) or hasattr(each, "fit"):
            name = str(getattr(each, "__name__", type(each).__name__))
            names.append(name)
            objects[name] = each
        else:
            raise LaeError(f"forecasters: {each!r:.60} is neither a name nor makes forecasters")
    return tuple(dict.fromkeys(names)), objects
