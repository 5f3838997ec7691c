"""The timeline of a replay: a Trace Event file, as Perfetto opens it, or a picture.

Each sequence is a process of the trace, on its own clock: all begin at 0, so that instants are
those of the event log. Its threads are the camera, the tracker, the forecasters and the queries.
These events are slices, which show their names: a frame lasts until the next one arrives, an answer
until the next query, a forecaster's state until its next update. A pipeline has a thread for each
worker of a stage and each place at a resource, counters of the frames that wait, and instants at
which frames are delivered and dropped. Instants in microseconds are rounded down to whole
nanoseconds; the exact ticks are among each slice's arguments. With a negative sigma all instants,
not the ticks, are later by the least whole number of frames that puts the first query at 0 or
after: Perfetto drops what comes before.

Source: "Trace Event Format" (Google, 2016); https://ui.perfetto.dev opens the files.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from itertools import count, islice
from math import ceil, inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lae_sim.engine.scheduler import Schedule
from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import Observer, ScoredRun
from lae_sim.evaluation.pairing import Pairing, pair
from lae_sim.files import written_whole
from lae_sim.replay.run import Run
from lae_sim.report.export import sigma_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lae_sim.engine.stages import StageLog

TraceEvent = dict[str, Any]
"""One object of the Trace Event Format."""


@contextmanager
def timeline_file(path: str, sigma: Fraction, costs: Mapping[str, int]) -> Iterator[Observer]:
    """Write a timeline: of all sequences as Trace Events (.json), of the first one as a picture.

    Args:
        path: a .json, .png, .svg or .pdf file.
        sigma: permitted latency of the queries, frames.
        costs: what an answer of each forecaster costs, ns.

    Raises:
        LaeError: if the ending is none of these, or a picture is to show forecasters that cost.
    """
    ending = Path(path).suffix.lower()
    if ending == ".json":
        with _events_file(path, sigma, costs) as observer:
            yield observer
        return
    if ending not in (".png", ".svg", ".pdf"):
        raise LaeError(
            f"cannot draw a timeline to {path}: name a .json file, for Perfetto, or a .png, .svg "
            "or .pdf picture"
        )
    if any(costs.values()):
        raise LaeError(f"the picture {path} cannot show what forecasters cost: name a .json file")
    from lae_sim.figures.replay import timeline_figure
    from lae_sim.figures.style import save

    pictures: list[Figure] = []

    def draw_first(scored: ScoredRun) -> None:
        if not pictures:
            picture = timeline_figure(scored.run, sigma, pairing=scored.pairing(sigma))
            pictures.append(picture)

    yield draw_first
    save(pictures[0], path)


@contextmanager
def _events_file(path: str, sigma: Fraction, costs: Mapping[str, int]) -> Iterator[Observer]:
    """Write the events of each sequence as it comes, some thousands a line."""
    head = {"displayTimeUnit": "ms", "otherData": {"sigma": sigma_text(sigma)}}
    with written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(head)[:-1] + ', "traceEvents": [')
        processes, separator = count(1), "\n"

        def observer(scored: ScoredRun) -> None:
            nonlocal separator
            pairings = {cost: scored.pairing(sigma, cost) for cost in {0, *costs.values()}}
            events = trace_events(scored.run, sigma, costs, next(processes), pairings)
            while some := list(islice(events, 4096)):
                file.write(separator + json.dumps(some, separators=(",", ":"))[1:-1])
                separator = ",\n"

        yield observer
        file.write("\n]}\n")


class _Process:
    """Makes the events of one process of the trace."""

    def __init__(self, number: int, ticks_per_ns: int, early: int) -> None:
        self._number, self._ticks_per_ns, self._early = number, ticks_per_ns, early
        # a thread of its process's number would be its main thread, which Perfetto shows first
        self._tracks = count(1000 * number)

    def track(self) -> int:
        """The number of a new thread."""
        return next(self._tracks)

    def thread(self, track: int, name: str) -> Iterator[TraceEvent]:
        """The name and the place of a thread."""
        return self.named("thread", track, name)

    def named(self, kind: str, number: int, name: str) -> Iterator[TraceEvent]:
        """The name and the place of a thread or of the process."""
        place = {"ph": "M", "pid": self._number, "tid": number}
        yield {**place, "name": f"{kind}_name", "args": {"name": name}}
        yield {**place, "name": f"{kind}_sort_index", "args": {"sort_index": number}}

    def mark(self, phase: str, track: int, tick: int, **more: Any) -> TraceEvent:
        """An event of one instant."""
        ts = self._ns(tick) / 1000
        return {"ph": phase, "pid": self._number, "tid": track, "ts": ts, **more}

    def span(self, track: int, name: str, start: int, end: int, **details: Any) -> TraceEvent:
        """A slice."""
        length_ns = self._ns(end) - self._ns(start)
        return self.mark("X", track, start, dur=length_ns / 1000, name=name, args=details)

    def _ns(self, tick: int) -> int:
        return (tick + self._early) // self._ticks_per_ns


def _call(frame: int, begin: int, end: int) -> dict[str, int]:
    """What is said of the work on a frame."""
    return {"frame": frame, "start_ticks": begin, "ready_ticks": end}


def _pipeline_events(
    events: _Process, schedule: Schedule
) -> Generator[TraceEvent, None, dict[int, int]]:
    """The threads of a pipeline's stages and resources; the thread of each of the tracker's calls.

    Workers of a stage are alike: a frame goes to the first that is free.
    """
    from lae_sim.engine.stages import Drop, PipelineSchedule  # with SimPy, which few replays need
    from lae_sim.evaluation.pipeline import WHY, shared_out

    assert isinstance(schedule, PipelineSchedule)
    pipeline, end = schedule.pipeline, schedule.clock.end(schedule.length)
    track = events.track()
    yield from events.thread(track, "delivery")
    for frame, tick in enumerate(schedule.delivered.tolist()):
        lost = tick < 0
        tick = schedule.clock.arrival(frame) if lost else tick
        name = f"lost {frame}" if lost else f"delivered {frame}"
        yield events.mark("i", track, tick, s="t", name=name, args={"frame": frame, "tick": tick})
    calls: dict[int, int] = {}
    holding: dict[str, list[tuple[int, int, str, int]]] = {name: [] for name in pipeline.resources}
    for stage in pipeline.stages:
        log = schedule.stages[stage.name]
        columns = (log.arrived, log.taken, log.started, log.finished, log.left, log.gone)
        rows = [(frame, *row) for frame, row in enumerate(zip(*(c.tolist() for c in columns)))]
        held = [(row[2], _free_again(row), row) for row in rows if row[2] >= 0]
        tracks = [events.track() for _ in range(stage.workers)]
        for number, track in enumerate(tracks, 1):
            yield from events.thread(track, _numbered(stage.name, number, len(tracks)))
        for worker, (frame, _, taken, started, finished, left, gone) in shared_out(held):
            track, until = tracks[worker], started if started >= 0 else gone
            if until > taken:
                yield events.span(track, f"{frame} waits for {stage.resource}", taken, until)
            if started >= 0:
                details = _call(frame, started, finished)
                yield events.span(track, f"frame {frame}", started, finished, **details)
                if left < 0:  # it was still when all was over
                    left = max(finished, end)
                if left > finished:
                    yield events.span(track, f"{frame} is blocked", finished, left)
                if stage.resource is not None:
                    holding[stage.resource].append((started, finished, stage.name, frame))
                if stage.name == pipeline.tracker:
                    calls[frame] = track
        if dropped := [frame for frame, why in enumerate(log.dropped.tolist()) if why]:
            track = events.track()
            yield from events.thread(track, f"{stage.name}: dropped")
            for frame in dropped:
                why, tick = WHY[Drop(log.dropped[frame])], int(log.gone[frame])
                details = {"frame": frame, "tick": tick}
                yield events.mark("i", track, tick, s="t", name=f"{frame}: {why}", args=details)
        yield from _queue_events(events, f"{stage.name}: queue", log)
    for name, uses in holding.items():
        tracks = [events.track() for _ in range(pipeline.resources[name])]
        for number, track in enumerate(tracks, 1):
            yield from events.thread(track, _numbered(name, number, len(tracks)))
        for place, (begin, end, user, frame) in shared_out([(u[0], u[1], u) for u in uses]):
            yield events.span(
                tracks[place], f"{user} {frame}", begin, end, **_call(frame, begin, end)
            )
    return calls


def _free_again(row: tuple[int, ...]) -> float:
    """When the worker that took a frame is free for the next one."""
    *_, left, gone = row
    return left if left >= 0 else gone if gone >= 0 else inf


def _queue_events(events: _Process, name: str, log: StageLog) -> Iterator[TraceEvent]:
    """How many frames wait, whenever that changes."""
    waited = (log.arrived >= 0) & ((log.taken >= 0) | (log.gone > log.arrived))
    until = np.where(log.taken >= 0, log.taken, log.gone)[waited]
    ticks, places = np.unique(np.concatenate([log.arrived[waited], until]), return_inverse=True)
    change = np.repeat([1, -1], len(until))
    for tick, length in zip(ticks.tolist(), np.bincount(places, change).cumsum().tolist()):
        yield events.mark("C", 0, tick, name=name, args={"frames": int(length)})


def _numbered(name: str, number: int, count: int) -> str:
    return name if count == 1 else f"{name} {number}"


def trace_events(
    run: Run,
    sigma: Fraction,
    costs: Mapping[str, int],
    process: int = 1,
    pairings: Mapping[int, Pairing] | None = None,
) -> Iterator[TraceEvent]:
    """The Trace Events of one sequence.

    Args:
        run: the sequence; no two calls overlap, but those of a pipeline's tracker may.
        sigma: permitted latency of the queries, frames.
        costs: what an answer of each forecaster costs, ns. Forecasters whose answers cost the same
            share a track of queries.
        process: the number of the sequence in the trace, from 1.
        pairings: of the run at that sigma, at no cost and at each of the costs, where they are
            known already.
    """
    schedule = run.schedule
    if pairings is None:
        pairings = {cost: pair([schedule], [sigma], cost) for cost in {0, *costs.values()}}
    clock = schedule.clock
    early = max(ceil(-sigma), 0) * clock.frame_ticks
    events, flows = _Process(process, clock.ticks_per_ns, early), count(process << 32)
    span, mark, named = events.span, events.mark, events.thread

    def query(frame: int) -> int:
        return clock.query(frame, sigma)

    yield from events.named("process", process, run.recording.name)
    camera = events.track()
    yield from named(camera, "camera")
    processed = set(schedule.frames.tolist())
    for frame in range(schedule.length):
        skipped = frame not in processed
        tick = clock.arrival(frame)
        details = {"frame": frame, "skipped": skipped, "tick": tick}
        name = f"skipped {frame}" if skipped else f"frame {frame}"
        yield span(camera, name, tick, clock.arrival(frame + 1), **details)
    start, ready = schedule.start.tolist(), schedule.ready.tolist()
    if schedule.visible is not None:  # only those of pipelines are later than they are ready
        calls = yield from _pipeline_events(events, schedule)
    else:
        tracker = events.track()
        calls = dict.fromkeys(schedule.frames.tolist(), tracker)
        yield from named(tracker, "tracker")
        for frame, begin, end in zip(calls, start, ready):
            yield span(tracker, f"frame {frame}", begin, end, **_call(frame, begin, end))

    free = pairings[0].first[:, 0]
    for cost_ns in dict.fromkeys(costs.values()):
        pairing = pairings[cost_ns]
        first, end_frame = pairing.first[:, 0], pairing.end[:, 0]
        used = (end_frame > first).nonzero()[0].tolist()
        spans = [(k, int(pairing.frames[k]), int(first[k]), int(end_frame[k])) for k in used]
        names = [name for name, cost in costs.items() if cost == cost_ns]
        for name in names:
            track = events.track()
            yield from named(track, f"forecaster {name}")
            for k, source, begin, end in spans:
                details = {"source_frame": source, "tick": query(begin)}
                if cost_ns:
                    details |= {"cost_ns": cost_ns, "delayed_queries": begin - int(free[k])}
                state = f"update {source}" if source else "initial box"
                yield span(track, state, query(begin), query(end), **details)
        track = events.track()
        shared = len(names) == len(costs)
        yield from named(track, "queries" if shared else f"queries {', '.join(names)}")
        for k, source, begin, end in spans:
            for frame in range(begin, end):
                details = {"frame": frame, "source_frame": source, "age_frames": frame - source}
                details |= {"tick": query(frame)}
                answer = f"{source} answers {frame}"
                yield span(track, answer, query(frame), query(frame + 1), **details)
                if frame == begin and source:
                    flow = {"id": next(flows), "cat": "answer", "name": "answers"}
                    yield mark("s", calls[source], start[k], **flow)
                    yield mark("f", track, query(frame), bp="e", **flow)
