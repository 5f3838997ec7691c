"""Arguments as people give them, each checked, and named in what it raises."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from lae_sim.engine.clock import whole
from lae_sim.errors import LaeError, shown, visible
from lae_sim.files import sequence_names
from lae_sim.forecast.base import Hold, own_factory
from lae_sim.forecast.costs import parse_cost
from lae_sim.learning.registry import find_camera
from lae_sim.replay.names import named, several
from lae_sim.replay.world import TraceLike, open_trace
from lae_sim.trace.file import Trace
from lae_sim.trace.locate import find_traces

if TYPE_CHECKING:
    from lae_sim.engine.pipeline import Pipeline
    from lae_sim.forecast.base import AnyFactory
    from lae_sim.forecast.camera import Camera
    from lae_sim.learning.folds import Trainer

Traces: TypeAlias = "TraceLike | Sequence[TraceLike] | Mapping[str, TraceLike]"
"""A trace, several, or a mapping from names to traces."""

Forecasters: TypeAlias = (
    "str | AnyFactory | Trainer | Iterable[str | AnyFactory | Trainer] | "
    "Mapping[str, str | AnyFactory | Trainer]"
)
"""Forecasters by name, as classes or factories, or as a mapping from names to these."""

Pipelines: TypeAlias = (
    "Pipeline | str | os.PathLike[str] | Sequence[Pipeline | str | os.PathLike[str]] | None"
)
"""A pipeline, or the path of its file, or several."""

Costs: TypeAlias = "str | Iterable[str] | Mapping[str, str]"
"""What forecasting costs: ``"2ms"``, ``"kalman=2ms"``, or ``{"kalman": "2ms"}``."""


def labelled_traces(traces: Traces, sequences: Iterable[str] | None = None) -> dict[str, Trace]:
    """Open traces, by the names they have in tables.

    Args:
        traces: each is an open one, or a path, folder, glob or URL. Those of files are named by
            them, by their paths where that is needed to tell them apart; others by their trackers.
        sequences: those wanted; all by default.

    Raises:
        LaeError: if there is no trace, one is missing or damaged or lacks a sequence, or two have
            the same name.
    """
    wanted = None if sequences is None else sequence_names(sequences)
    opened = [
        (label, named("traces", partial(open_trace, sequences=wanted), trace))
        for label, trace in _with_labels(traces)
    ]
    if not opened:
        raise LaeError("traces: name at least one")
    names = [label for label, _ in opened]
    if not isinstance(traces, Mapping):
        short = [Path(label).name if path_of(trace) else label for label, trace in opened]
        names = [*map(visible, short if len(set(short)) == len(short) else names)]
    found = dict(zip(names, (trace for _, trace in opened)))
    if len(found) < len(opened):
        raise LaeError("traces: several have the same name: give a mapping from names to traces")
    return found


def path_of(trace: Trace) -> str | None:
    """The path or URL that a trace was read from; None if from none."""
    path: str | None = getattr(trace.recordings, "path", None)
    return path


def _with_labels(traces: Traces) -> Iterator[tuple[str, TraceLike]]:
    if isinstance(traces, Mapping):
        for label, trace in traces.items():
            if not isinstance(label, str):
                raise LaeError(f"traces: the name of a trace is text, not {shown(label)}")
            yield label, trace
        return
    for trace in several(traces):
        if isinstance(trace, (str, os.PathLike)):
            paths = named("traces", find_traces, [os.fspath(trace)])
            yield from ((path, path) for path in paths)
        else:
            opened = named("traces", open_trace, trace)
            yield path_of(opened) or opened.metadata.tracker, opened


def named_forecasters(forecasters: Forecasters) -> dict[str, Any]:
    """Forecasters by name: text that is still to be looked up, or what makes forecasters.

    Raises:
        LaeError: if there is none, one is neither a name nor makes forecasters, or two have the
            same name.
    """
    if isinstance(forecasters, Mapping):
        pairs = list(forecasters.items())
    else:
        pairs = [(_name_of(each), each) for each in several(forecasters)]
    found: dict[str, Any] = {}
    for name, each in pairs:
        made = _maker(name, each)
        if name in found and found[name] != made:
            raise LaeError(f"forecasters: two are called {name!r}: give a mapping from names")
        if name == "hold" and made not in ("hold", Hold):
            raise LaeError("forecasters: 'hold' is the baseline: give yours another name")
        found[name] = made
    if not found:
        raise LaeError("forecasters: name at least one, such as 'kalman'")
    return found


def _name_of(forecaster: Any) -> str:
    if isinstance(forecaster, str):
        return forecaster
    return str(getattr(forecaster, "__name__", type(forecaster).__name__))


def _maker(name: Any, forecaster: Any) -> Any:
    """A name, or what makes forecasters; of a class of trainers, a trainer."""
    if not isinstance(name, str):
        raise LaeError(f"forecasters: the name of a forecaster is text, not {shown(name)}")
    if hasattr(forecaster, "fit"):
        return forecaster() if isinstance(forecaster, type) else forecaster
    if isinstance(forecaster, str):
        return forecaster
    if not (callable(forecaster) or hasattr(forecaster, "for_sequence")):
        raise LaeError(f"forecasters: {shown(forecaster)} is neither a name nor makes forecasters")
    return own_factory("forecasters", forecaster)


def cost_texts(costs: Costs) -> tuple[str, ...]:
    """Costs as command lines have them.

    Raises:
        LaeError: if one is no duration, and not ``"measured"``.
    """
    texts = (
        [f"{name}={cost}" for name, cost in costs.items()]
        if isinstance(costs, Mapping)
        else several(costs)
    )
    for text in texts:
        if not isinstance(text, str):
            raise LaeError(f"costs: {shown(text)} is not text, such as '2ms' or 'kalman=2ms'")
        named("costs", parse_cost, text.rpartition("=")[2])
    return tuple(texts)


def check_frames(forecasters: Mapping[str, Any], root: object) -> None:
    """Check that the frames are given, if a forecaster needs them.

    Raises:
        LaeError: if they are not.
    """
    for each in forecasters.values():
        if root is None and isinstance(each, str) and each.startswith("camera+"):
            raise LaeError(f"root: {each} needs the frames: give the dataset's folder with --root")


def camera_of(
    root: str | os.PathLike[str] | None,
    dataset: str | None,
    sequences: Iterable[str] | None,
    fps: Fraction,
    lag: int | None,
) -> Camera | None:
    """The camera's motion (see :func:`lae_sim.learning.registry.find_camera`).

    Raises:
        LaeError: if the frames cannot be found.
    """
    if root is None:
        return None
    if not isinstance(root, (str, os.PathLike)):
        raise LaeError(f"root: the dataset's folder is a path, not {shown(root)}")
    if lag is not None:
        lag = named("camera_lag", whole, lag)
    names = None if sequences is None else sequence_names(sequences)
    return find_camera(os.fspath(root), dataset, names, fps, lag)
