"""The timeline of a replay: a Trace Event file, as Perfetto opens it, or a picture.

Each sequence is a process of the trace, on its own clock: all begin at 0, so that instants are
those of the event log. Its threads are the camera, the tracker, the forecasters and the queries.
All events are slices, which show their names: a frame lasts until the next one arrives, an answer
until the next query, a forecaster's state until its next update. Instants in microseconds are
rounded down to whole nanoseconds; the exact ticks are among each slice's arguments. With a negative
sigma all instants, not the ticks, are later by the least whole number of frames that puts the first
query at 0 or after: Perfetto drops what comes before.

Source: "Trace Event Format" (Google, 2016); https://ui.perfetto.dev opens the files.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from itertools import count, islice
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.errors import LaeError
from lae_sim.evaluation.evaluate import Observer, ScoredRun
from lae_sim.evaluation.pairing import Pairing, pair
from lae_sim.files import written_whole
from lae_sim.replay.run import Run
from lae_sim.report.export import sigma_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def trace_events(
    run: Run,
    sigma: Fraction,
    costs: Mapping[str, int],
    process: int = 1,
    pairings: Mapping[int, Pairing] | None = None,
) -> Iterator[TraceEvent]:
    """The Trace Events of one sequence.

    Args:
        run: the sequence, of which no two calls overlap.
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
    clock, ticks_per_ns = schedule.clock, schedule.clock.ticks_per_ns
    early = max(ceil(-sigma), 0) * clock.frame_ticks
    # a thread of its process's number would be its main thread, which Perfetto shows first; flows
    # are told apart over the whole file
    tracks, flows = count(1000 * process), count(process << 32)

    def query(frame: int) -> int:
        return clock.query(frame, sigma)

    def shown_ns(tick: int) -> int:
        return (tick + early) // ticks_per_ns

    def named(kind: str, number: int, name: str) -> Iterator[TraceEvent]:
        place = {"ph": "M", "pid": process, "tid": number}
        yield {**place, "name": f"{kind}_name", "args": {"name": name}}
        yield {**place, "name": f"{kind}_sort_index", "args": {"sort_index": number}}

    def mark(phase: str, track: int, tick: int, **more: Any) -> TraceEvent:
        return {"ph": phase, "pid": process, "tid": track, "ts": shown_ns(tick) / 1000, **more}

    def span(track: int, name: str, start: int, end: int, **details: Any) -> TraceEvent:
        length_ns = shown_ns(end) - shown_ns(start)
        return mark("X", track, start, dur=length_ns / 1000, name=name, args=details)

    yield from named("process", process, run.recording.name)
    camera, tracker = next(tracks), next(tracks)
    yield from named("thread", camera, "camera")
    processed = set(schedule.frames.tolist())
    for frame in range(schedule.length):
        skipped = frame not in processed
        tick = clock.arrival(frame)
        details = {"frame": frame, "skipped": skipped, "tick": tick}
        name = f"skipped {frame}" if skipped else f"frame {frame}"
        yield span(camera, name, tick, clock.arrival(frame + 1), **details)
    yield from named("thread", tracker, "tracker")
    start, ready = schedule.start.tolist(), schedule.ready.tolist()
    for frame, begin, end in zip(schedule.frames.tolist(), start, ready):
        details = {"frame": frame, "start_ticks": begin, "ready_ticks": end}
        yield span(tracker, f"frame {frame}", begin, end, **details)

    free = pairings[0].first[:, 0]
    for cost_ns in dict.fromkeys(costs.values()):
        pairing = pairings[cost_ns]
        first, end_frame = pairing.first[:, 0], pairing.end[:, 0]
        used = (end_frame > first).nonzero()[0].tolist()
        spans = [(k, int(pairing.frames[k]), int(first[k]), int(end_frame[k])) for k in used]
        names = [name for name, cost in costs.items() if cost == cost_ns]
        for name in names:
            track = next(tracks)
            yield from named("thread", track, f"forecaster {name}")
            for k, source, begin, end in spans:
                details = {"source_frame": source, "tick": query(begin)}
                if cost_ns:
                    details |= {"cost_ns": cost_ns, "delayed_queries": begin - int(free[k])}
                state = f"update {source}" if source else "initial box"
                yield span(track, state, query(begin), query(end), **details)
        track = next(tracks)
        shared = len(names) == len(costs)
        yield from named("thread", track, "queries" if shared else f"queries {', '.join(names)}")
        for k, source, begin, end in spans:
            for frame in range(begin, end):
                details = {"frame": frame, "source_frame": source, "age_frames": frame - source}
                details |= {"tick": query(frame)}
                answer = f"{source} answers {frame}"
                yield span(track, answer, query(frame), query(frame + 1), **details)
                if frame == begin and source:
                    flow = {"id": next(flows), "cat": "answer", "name": "answers"}
                    yield mark("s", tracker, start[k], **flow)
                    yield mark("f", track, query(frame), bp="e", **flow)
