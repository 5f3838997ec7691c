"""What ``lae-sim replay`` does with each trace: replayed in one world or several, and scored."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING

from lae_sim.errors import LaeError
from lae_sim.options import parse_latency, parse_policy
from lae_sim.zoo import find_camera, load_forecaster

if TYPE_CHECKING:
    from lae_sim.clock import Clock
    from lae_sim.forecast import AnyFactory
    from lae_sim.metrics import Convention
    from lae_sim.report import Report
    from lae_sim.run import Run
    from lae_sim.trace import Trace


@dataclass(frozen=True)
class Job:
    """One trace and how it is replayed and scored.

    Attributes:
        path: the trace's file.
        label: its name in tables and pictures.
        trace: the trace.
        timing: the trace that the times come from, if it is another.
        clock: the world's clock.
        scale: exact factor on all times.
        runs: replays the sequences, from the first, each time it is called.
        at_arrival: whether outputs count from their own frames' arrival.
        forecasters: factories by name; hold, the baseline of all comparisons, is always there.
        costs: what an answer of each forecaster costs, ns.
        sigmas: permitted latencies, ascending.
        convention: how frames and thresholds count.
    """

    path: str
    label: str
    trace: Trace
    timing: Trace | None
    clock: Clock
    scale: Fraction
    runs: Callable[[], Iterator[Run]]
    at_arrival: bool
    forecasters: Mapping[str, AnyFactory]
    costs: Mapping[str, int]
    sigmas: Sequence[Fraction]
    convention: Convention


def jobs_of(
    path: str, label: str, arguments: argparse.Namespace, sigmas: Sequence[Fraction]
) -> Iterator[Job]:
    """The jobs of one trace: for each frame rate, one for each scale of the times."""
    from lae_sim.clock import Clock
    from lae_sim.costs import resolve_costs
    from lae_sim.latency import scaled
    from lae_sim.metrics import find_convention
    from lae_sim.run import replay_trace
    from lae_sim.trace import read_trace

    policy, at_arrival = parse_policy(arguments.policy)
    if at_arrival and any(sigmas):
        raise LaeError("vot-realtime never scores latency: it goes with no permitted latency")
    if at_arrival and arguments.cost:
        raise LaeError("vot-realtime never scores latency: it goes with no --cost")
    if at_arrival and arguments.timeline:
        raise LaeError("vot-realtime never scores latency: it goes with no --timeline")
    latency = parse_latency(arguments.latency)
    trace = read_trace(path, arguments.sequence)
    timing = read_trace(arguments.timing) if arguments.timing else None
    strided = [read_trace(pass_, arguments.sequence) for pass_ in arguments.strided]
    if arguments.attributes and not trace.metadata.names_attributes:
        raise LaeError(f"{path}: the trace names no attributes of its sequences")
    names = dict.fromkeys(["hold", *arguments.forecaster])
    costs: dict[str, int] | None = None
    for fps in arguments.fps or [trace.metadata.fps]:
        camera = find_camera(
            arguments.root, arguments.dataset, arguments.sequence, fps, arguments.camera_lag
        )
        forecasters = {name: load_forecaster(name, camera) for name in names}
        if costs is None:  # measured once: a sweep is of nothing else
            costs = resolve_costs(arguments.cost, forecasters, trace)
        for scale in arguments.latency_scale:
            source = scaled(latency, scale)
            yield Job(
                path=path,
                label=label,
                trace=trace,
                timing=timing,
                clock=Clock.at(fps),
                scale=scale,
                runs=partial(replay_trace, trace, fps, source, policy, timing, strided),
                at_arrival=at_arrival,
                forecasters=forecasters,
                costs=costs,
                sigmas=sigmas,
                convention=find_convention(arguments.convention),
            )


def report(
    job: Job, sinks: Sequence[Callable[[Run], None]], arguments: argparse.Namespace
) -> Report:
    """Replay and score one trace, giving each run to the sinks."""
    from lae_sim.costs import cost_notes
    from lae_sim.evaluation import evaluate
    from lae_sim.notes import SkippedStalls, notes_on
    from lae_sim.report import attribute_members, trace_report

    metadata = job.trace.metadata
    stalls = SkippedStalls()
    if arguments.latency == "recorded" and job.timing is None:
        sinks = [*sinks, stalls]
    runs = _written(_progress(job.runs(), job.path, job.trace.frames), sinks)
    evaluation = evaluate(
        runs, metadata, job.forecasters, job.sigmas, job.convention, job.at_arrival, job.costs
    )
    members = attribute_members(metadata, evaluation.sequences)
    notes = notes_on(evaluation, metadata, job.convention, job.forecasters, job.at_arrival)
    figures = trace_report(
        evaluation,
        job.clock,
        list(job.forecasters),
        job.sigmas,
        job.convention.name,
        members if arguments.attributes else None,
        arguments.per_sequence,
    )
    return {
        "trace": job.path,
        "tracker": metadata.tracker,
        "dataset": metadata.dataset,
        "device": metadata.device,
        "strided": arguments.strided,
        "times_from": arguments.timing or job.path,
        "times_note": (job.timing or job.trace).metadata.timing_note,
        "fps": str(job.clock.fps),
        "policy": arguments.policy,
        "latency": arguments.latency,
        "latency_scale": str(job.scale),
        "convention": job.convention.name,
        "forecaster_cost_ns": dict(job.costs),
        "notes": [*notes, *stalls.notes(), *cost_notes(job.costs)],
        **figures,
    }


def _written(runs: Iterable[Run], sinks: Sequence[Callable[[Run], None]]) -> Iterator[Run]:
    """The runs, each given to every sink as it passes."""
    for run in runs:
        for sink in sinks:
            sink(run)
        yield run


def _progress(runs: Iterable[Run], path: str, frames: int | None) -> Iterator[Run]:
    """The runs, with a progress bar if the standard error stream is a terminal."""
    from tqdm import tqdm

    with tqdm(total=frames, desc=path, unit=" frames", unit_scale=True, disable=None) as bar:
        for run in runs:
            yield run
            bar.update(len(run))
