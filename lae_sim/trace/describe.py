"""Statistics of the processing times in a trace: distribution, drift over the run, stalls."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lae_sim._arrays import Floats, Ints
from lae_sim.trace.metadata import TRACES_TIMES
from lae_sim.trace.recording import Recording, in_order

if TYPE_CHECKING:
    from lae_sim.trace.file import Trace
    from lae_sim.trace.metadata import Metadata

STALL = 10
"""A call is a stall if it takes more than so many times the median."""


ASSUMED = "assumed: "
AS_A_FRAME = f"{ASSUMED}as a frame"
"""What is said of the source of initialisation times that nobody has measured."""


@dataclass(frozen=True)
class InitCost:
    """What the initialisations of some sequences cost, and how one knows.

    Attributes:
        mean_ms, min_ms, max_ms: over the sequences, ms.
        source: ``"measured"``, ``"assumed: ..."``, ``"given by ..."`` or ``"the trace's times:
            ..."`` (see :meth:`lae_sim.replay.world.World.init_source`), perhaps with a scale.
    """

    mean_ms: float
    min_ms: float
    max_ms: float
    source: str

    @classmethod
    def of(cls, init_ns: Ints, source: str) -> InitCost:
        """Of the times of some initialisations, ns, int64 [S], S > 0."""
        ms = init_ns / 1e6
        return cls(float(ms.mean()), float(ms.min()), float(ms.max()), source)

    @property
    def is_measured(self) -> bool:
        """Whether the times, before they were scaled, were measured somewhere."""
        return is_measured(self.source)

    def __str__(self) -> str:
        """A sentence."""
        mean, least, most = map(in_ms, (self.mean_ms, self.min_ms, self.max_ms))
        cost = f"initialisation costs {mean}"
        if least != most:
            cost += f" on average ({least} to {most})"
        if self.source.startswith(AS_A_FRAME):
            return f"{cost}, the same as a frame: an assumption; name it with ,init=TIME"
        if self.source.startswith(ASSUMED):
            return f"{cost}: an assumption"
        if self.source.startswith(TRACES_TIMES) and not self.is_measured:
            return f"{cost}: an assumption ({self.source})"
        return f"{cost}, {self.source}"


def is_measured(source: str) -> bool:
    """Whether a source of an :class:`InitCost` is a measurement."""
    return source.removeprefix(TRACES_TIMES).startswith("measured")


def in_ms(ms: float) -> str:
    """A time in words, to three digits or to the millisecond."""
    return f"{ms:,.0f} ms" if ms >= 1000 else f"{ms:.3g} ms"


@dataclass(frozen=True, eq=False)
class SequenceTimes:
    """What the calls of one sequence took.

    Attributes:
        name: the sequence's name.
        init_ns: time of the initialisation on frame 0, ns.
        frames: the other frames that were processed, int32 [n].
        elapsed_ns: their times in ns, int64 [n].
        stages: parts of them by the name of the stage, int64 [n] each, -1 where unknown.
    """

    name: str
    init_ns: int
    frames: npt.NDArray[np.int32]
    elapsed_ns: Ints
    stages: Mapping[str, Ints] = field(default_factory=dict)

    @classmethod
    def of(cls, recording: Recording) -> SequenceTimes:
        """The times of a recording."""
        frames = np.flatnonzero(recording.elapsed_ns >= 0)[1:].astype(np.int32)
        init = int(recording.elapsed_ns[0])
        stages = {name: ns[frames] for name, ns in recording.stages.items()}
        return cls(recording.name, init, frames, recording.elapsed_ns[frames], stages)


def summary(elapsed_ns: Ints) -> dict[str, float]:
    """Number, quantiles and mean of times, ms, and ``fps``, calls per second of computing."""
    if not len(elapsed_ns):
        return {"n": 0}
    p50, p90, p95, p99, top = (np.quantile(elapsed_ns, [0.5, 0.9, 0.95, 0.99, 1]) / 1e6).tolist()
    mean = float(elapsed_ns.mean()) / 1e6
    figures = {"n": len(elapsed_ns), "mean_ms": mean, "median_ms": p50, "p90_ms": p90}
    figures |= {"p95_ms": p95, "p99_ms": p99, "max_ms": top}
    return figures | ({"fps": 1e3 / mean} if mean else {})


def stage_times(sequences: Sequence[SequenceTimes]) -> list[dict[str, Any]]:
    """What the stages of the calls take, in their order, and last what is left to none of them.

    Returns:
        For each ``stage``, None for what is left: ``n``, the calls that tell, ``mean_ms``,
        ``median_ms``, ``p95_ms``, and its ``share`` of the time of these calls. Empty without
        stages.
    """
    names = in_order({name for sequence in sequences for name in sequence.stages})
    if not names:
        return []
    elapsed_ns = np.concatenate([sequence.elapsed_ns for sequence in sequences])
    unknown = [np.full(len(sequence.elapsed_ns), -1) for sequence in sequences]
    parts = np.array(
        [np.concatenate([s.stages.get(n, u) for s, u in zip(sequences, unknown)]) for n in names]
    )
    rest = elapsed_ns - np.maximum(parts, 0).sum(0)
    rows: list[dict[str, Any]] = []
    for name, ns in zip([*names, None], [*parts, np.where((parts >= 0).any(0), rest, -1)]):
        found = summary(ns[ns >= 0])
        if found["n"]:
            figures = {key: found[key] for key in ("n", "mean_ms", "median_ms", "p95_ms")}
            share = float(ns[ns >= 0].sum() / max(elapsed_ns[ns >= 0].sum(), 1))
            rows.append({"stage": name, **figures, "share": share})
    return rows


def share_slower(elapsed_ns: Ints, fps: Fraction) -> float:
    """Share of the calls that take longer than the interval between frames, exactly."""
    return float(np.mean(elapsed_ns > 10**9 // fps)) if len(elapsed_ns) else 0.0


def histogram(elapsed_ns: Ints) -> dict[str, Any]:
    """Counts of times between round ``edges_ms``, and of outliers ``below`` and ``above`` them.

    The edges hold 96 % of the times; where these are more than a factor of 8 apart, the bins grow
    with the time.

    Args:
        elapsed_ns: times in ns, int64 [n], n > 0.
    """
    ms = elapsed_ns / 1e6
    low, high = np.quantile(ms, [0.02, 0.98]).tolist()
    if high > 8 * low > 0:
        around = np.geomspace(0.95 * low, 1.05 * high, 14)
        edges = np.array([float(f"{edge:.2g}") for edge in around])
    else:
        step = float(f"{max(high - low, high / 50, 1e-6) / 12:.1g}")
        edges = np.round(step * np.arange(low // step, high // step + 2), 9)
    return {
        "edges_ms": edges.tolist(),
        "counts": np.histogram(ms, edges)[0].tolist(),
        "below": int((ms < edges[0]).sum()),
        "above": int((ms > edges[-1]).sum()),
    }


def drift(sequences: Sequence[SequenceTimes]) -> dict[str, Any]:
    """Whether the tracker became slower, from sequences in the order in which they were run.

    Compared are the medians of sequences, or of 30 parts of the run if there are fewer than 15
    sequences: the first third with the last, by the rank test of Mann and Whitney (1947).

    Returns:
        ``tenths_ms``, medians of the tenths of the run; ``ratio``, the last third to the first;
        ``slower``, where it exceeds 1.1 and not by chance (1 %, one-sided). Empty if there are
        fewer than 100 calls.
    """
    times = [sequence.elapsed_ns for sequence in sequences if len(sequence.elapsed_ns)]
    run = np.concatenate(times) if times else np.zeros(0)
    if len(run) < 100:
        return {}
    medians = _medians(times if len(times) >= 15 else np.array_split(run, 30))
    third = len(medians) // 3
    first, last = np.sort(medians[:third]), medians[-third:]
    # how often a value of the last third exceeds one of the first, ties counting half
    wins = sum(np.searchsorted(first, last, side).sum() / 2 for side in ("left", "right"))
    z = (wins - third**2 / 2) / math.sqrt(third**2 * (2 * third + 1) / 12)
    ratio = _median(last) / max(_median(first), 1e-6)
    return {
        "tenths_ms": _medians(np.array_split(run, 10)).tolist(),
        "ratio": ratio,
        "slower": bool(ratio > 1.1 and z > 2.33),
    }


def first_calls(sequences: Sequence[SequenceTimes]) -> dict[str, float]:
    """The first call after each initialisation: median, ms, and ratio to the sequence's others."""
    times = [sequence.elapsed_ns for sequence in sequences if len(sequence.elapsed_ns) > 1]
    if not times:
        return {}
    ratios = [part[0] / max(_median(part[1:]), 1.0) for part in times]
    return {
        "median_ms": _median(np.array([part[0] for part in times])) / 1e6,
        "ratio": _median(np.array(ratios)),
    }


def stalls(sequences: Sequence[SequenceTimes]) -> list[dict[str, Any]]:
    """Calls that took over ten times the median of the run and of their sequence, longest first."""
    times = [sequence.elapsed_ns for sequence in sequences]
    middle = _median(np.concatenate(times)) if sum(map(len, times)) else 0
    longer = []
    for sequence in sequences:
        ns = sequence.elapsed_ns
        for call in np.flatnonzero(ns > STALL * max(middle, _median(ns) if len(ns) else 0)):
            stall = {"sequence": sequence.name, "frame": int(sequence.frames[call])}
            longer.append({**stall, "ms": int(ns[call]) / 1e6, "first_call": bool(call == 0)})
    return sorted(longer, key=lambda stall: -stall["ms"])


def _medians(parts: Sequence[Any]) -> Floats:
    """Medians of arrays of ns, ms."""
    return np.array([_median(part) for part in parts]) / 1e6


def _median(values: npt.NDArray[Any]) -> float:
    """What ``np.median`` is of some numbers, five times as fast where they are few."""
    middle = (len(values) - 1) // 2, len(values) // 2
    low, high = np.partition(values, middle)[[*middle]].tolist()
    return (float(low) + float(high)) / 2


Facts = dict[str, Any]


def throttling(
    before: Mapping[str, Any],
    during: Sequence[Mapping[str, Any]],
    after: Mapping[str, Any],
    slowdowns: Mapping[str, float] | None = None,
) -> str | None:
    """What readings say of throttling during a profile, in one sentence; None if nothing.

    Clocks are compared between the first and the last third of the readings, the highest of each,
    since a clock that was read in a pause is low for another reason. 10 % is a fall.

    Args:
        before: what ``readings`` returned before the profile.
        during: what it returned in the course of it.
        after: what it returned at the end.
        slowdowns: shares of the time of calls during which the GPU gave a reason to slow down,
            which say more than readings.
    """
    signs = []
    everything = [before, *during, after]
    counters = [r["throttle_events"] for r in everything if "throttle_events" in r]
    for name in counters[0] if counters else ():
        if (rise := counters[-1].get(name, 0) - counters[0][name]) > 0:
            signs.append(f"{name} rose by {rise}")
    for reason, share in (slowdowns or {}).items():
        signs.append(f"the GPU reported {reason} during {100 * share:.3g}% of the calls' time")
    counted = [] if slowdowns else during
    for reason, count in Counter(s for r in counted for s in r.get("gpu_slowdowns", ())).items():
        signs.append(f"the GPU reported {reason} in {count} of {len(during)} readings")
    for unit in ("CPU", "GPU"):
        for key, readings in (("allowed", everything), ("highest", during)):
            mhz = [r.get(f"{unit.lower()}_mhz", {}).get(key) for r in readings]
            known = [value for value in mhz if value] or [0]
            third = -(-len(known) // 3)
            first, last = max(known[:third]), max(known[-third:])
            if last < 0.9 * first:
                signs.append(f"the {unit}'s {key} clock fell from {first:,.0f} to {last:,.0f} MHz")
    return "throttling: " + "; ".join(signs) if signs else None


def gathered(**parts: Callable[[], Any]) -> Facts:
    """What the functions return, without what is empty or fails."""
    facts = {}
    for name, part in parts.items():
        try:
            value = part()
            json.dumps(value, allow_nan=False)  # an infinity is such an oddity too
        except Exception:  # no oddity of a system file may end a profile of an hour
            continue
        if value not in (None, "", {}, []):
            facts[name] = value
    return facts


Report = dict[str, Any]


_NOT_SHOWN = ("format", "version", "fps", "sequences", "failures")


def describe(trace: Trace, path: str) -> tuple[Report, list[SequenceTimes]]:
    """What ``--json`` prints of a trace, and its times in the order in which they were taken.

    Args:
        trace: the trace; it is read once.
        path: the file that it is from.

    Raises:
        TraceError: if it is not a valid trace.
    """
    import numpy as np

    metadata = trace.metadata
    entries = metadata.document.get("sequences", {})
    resized = frozenset(metadata.resized)
    sequences, frames, with_truth, sizes = [], 0, 0, Counter[str]()
    apart: list[float] = []
    for recording in trace:
        sequences.append(SequenceTimes.of(recording))
        frames += len(recording)
        with_truth += int((~np.isnan(recording.truth[:, 0])).sum())
        if recording.arrival_ns is not None:
            apart.append(float(np.diff(recording.arrival_ns).max(initial=0)) / 1e6)
        size = metadata.image_size(recording.name)
        changing = " (changing)" if recording.name in resized else ""
        sizes[f"{size[0]}x{size[1]}{changing}" if size else "unknown"] += 1
    order = {s.name: entries.get(s.name, {}).get("order") for s in sequences}
    ordered = all(isinstance(place, int) for place in order.values())
    if ordered:
        sequences.sort(key=lambda s: order[s.name])
    calls = np.concatenate([s.elapsed_ns for s in sequences])
    failures = metadata.document.get("failures")
    lost = [entries.get(s.name, {}).get("lost") for s in sequences]
    report = {
        "trace": path,
        "fps": str(metadata.fps),
        "longest_interval_ms": max(apart) if apart else None,
        "provenance": {k: v for k, v in metadata.document.items() if k not in _NOT_SHOWN},
        "sequences": len(sequences),
        "world_frames": frames,
        "processed": len(calls) + len(sequences),
        "with_truth": with_truth,
        "image_sizes": dict(sizes.most_common()),
        "lost": sum(lost) if all(isinstance(n, int) for n in lost) else None,
        "failures": failures if isinstance(failures, list) else [],
        "init": asdict(InitCost.of(np.array([s.init_ns for s in sequences]), metadata.init_source)),
        "times": {
            "calls": summary(calls),
            "initialisations": summary(np.array([s.init_ns for s in sequences])),
            "stages": stage_times(sequences),
            "frame_interval_ms": float(1000 / metadata.fps),
            "slower_than_frames": share_slower(calls, metadata.fps),
            "histogram": histogram(calls) if len(calls) else None,
            "first_calls": first_calls(sequences),
            "order_known": ordered,
            "drift": drift(sequences),
            "stalls": stalls(sequences),
        },
    }
    return {**report, "warnings": list(_warnings(report, metadata))}, sequences


def _warnings(report: Report, metadata: Metadata) -> Iterator[str]:
    """What a user should know before trusting the times."""
    first, drift = report["times"]["first_calls"], report["times"]["drift"]
    if first and first["ratio"] > 1.5:
        took = f"{first['median_ms']:.3g} ms, {first['ratio']:.2g} x the median of the others"
        yield f"the first call after an initialisation takes {took}: warm up"
    if drift and drift["slower"]:
        longer = f"took {100 * drift['ratio'] - 100:.0f}% longer than the first third"
        yield f"the last third of the run {longer}: heat, throttling, or harder sequences"
    device = metadata.document.get("device", {})
    taken = device.get("readings", {})
    warnings = gathered(  # whatever another program wrote there
        busy=lambda: _busy(taken["before"]["load"][0], device["cpu"]),
        threads=lambda: _beyond(metadata.document["timing"]),
        throttled=lambda: throttling(
            taken.get("before", {}),
            taken.get("during", []),
            taken.get("after", {}),
            device.get("slowdowns"),
        ),
        unread=lambda: _unread(device.get("unread", {})),
    )
    yield from warnings.values()
    loads = device.get("beside")
    for load in loads if isinstance(loads, list) else ():
        yield from gathered(left=lambda load=load: _left(load)).values()  # type: ignore[misc]


def _unread(shares: Mapping[str, float]) -> str:
    """Which sensors of power and clocks failed."""
    parts = [f"{name} in {100 * share:.3g}% of its readings" for name, share in shares.items()]
    return f"sensors failed: {'; '.join(parts)}" if parts else ""


def _left(load: Mapping[str, Any]) -> str | None:
    """Whether a program that was to run beside the tracker ended before it did."""
    if load["exit"] is None:
        return None
    there = f"it was there for {load['sequences']} of {load['of_sequences']} sequences"
    return f"{load['command']!r} ended by itself after {load['seconds']:.3g} s: {there}"


def _beyond(timing: Mapping[str, Any]) -> str | None:
    """Whether the tracker used more cores than it was asked to."""
    asked, used = timing["threads"]["asked"], timing["cpu_share"]
    if used <= 1.1 * asked:
        return None
    return f"--threads {asked} was not obeyed by all libraries: {used:.2g} cores were busy"


def _busy(load: float, cpu: Mapping[str, Any]) -> str | None:
    """Whether other programs were running when the profile began."""
    cores = cpu.get("affinity") or cpu["cores"]
    if load <= cores / 2:
        return None
    return f"the load before the profile was {load:.1f} on {cores} cores: other programs were busy"
