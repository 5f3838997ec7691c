"""What ``lae-sim show`` prints for people."""

from __future__ import annotations

import math
import re
import shutil
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from lae_sim.errors import visible
from lae_sim.figures.style import BLUE, SKY_BLUE, VERMILION, new_figure, save, styled
from lae_sim.figures.times import draw_times, name_durations
from lae_sim.report.table import COUNT, Column, Number, Table, text_of
from lae_sim.trace.describe import InitCost, Report, gathered
from lae_sim.trace.energy import Energy

if TYPE_CHECKING:
    from lae_sim.profile.passes import PassSummary
    from lae_sim.trace.describe import SequenceTimes

_WIDTH, _INDENT, _BAR, _STALLS = 96, 13, 50, 10
_UNNAMED = ("name", "model", "kind", "source", "file")  # whose values say what they are
_JOULES = Number(".3g")
_MEASURED = ("readings", "energy", "clocks", "slowdowns", "unread", "beside")  # told apart
_FIGURES: dict[str, Callable[[Any], float]] = {
    "CPU clock, MHz": lambda taken: taken["cpu_mhz"]["highest"],
    "CPU clock allowed": lambda taken: taken["cpu_mhz"]["allowed"],
    "GPU clock, MHz": lambda taken: taken["gpu_mhz"]["highest"],
    "hottest zone, C": lambda taken: max(taken["temperatures_c"].values()),
    "load, 1 minute": lambda taken: taken["load"][0],
}


def overview(report: Mapping[str, Any]) -> str:
    """A trace's report (see ``lae_sim.trace.describe.describe``) in lines that fit the terminal."""
    provenance, times, failures = report["provenance"], report["times"], report["failures"]
    lines = [_words(report["trace"]), ""]
    for key in dict.fromkeys(["tracker", "device", "timing", "schedule", "dataset", *provenance]):
        if key == "device" and isinstance(provenance.get(key), dict):
            device = {k: v for k, v in provenance[key].items() if k not in _MEASURED}
            lines += [*_section(key, device), *_beside(provenance[key])]
        elif key in provenance:
            lines += _section(key, provenance[key])
    lines.append(_entry("frames", _frames(report)))
    if failures:
        lines.append(_entry("failures", f"{len(failures)}: {_words(failures[:5])}"))
    lines += [*_readings(provenance.get("device")), *_power(provenance), "", *_times(report)]
    if times["stages"]:
        lines += ["", *_stages(times["stages"])]
    if times["histogram"]:
        lines += ["", *_histogram(times["histogram"])]
    lines += ["", *_drift(times), *_stalls(times["stalls"])]
    return "\n".join(lines + [_entry("warning", text) for text in report["warnings"]]).rstrip()


def _entry(label: str, value: Any) -> str:
    label = f"{_words(label.replace('_', ' ')):.40} ".ljust(_INDENT)
    width = max(60, min(_WIDTH, shutil.get_terminal_size((_WIDTH, 24)).columns))
    words = textwrap.shorten(_words(value), 1000)
    return textwrap.fill(words, width, initial_indent=label, subsequent_indent=" " * _INDENT)


def _section(label: str, section: Any) -> list[str]:
    """A value of the metadata; the objects in it on lines of their own."""
    if not isinstance(section, dict):
        return [_entry(label, section)]
    section = dict(_told(key, value) for key, value in section.items())
    inner = {key: value for key, value in section.items() if value and _has_keys(value)}
    lines = [_entry(label, {key: value for key, value in section.items() if key not in inner})]
    lines += [_entry(f"  {key}", inner[key]) for key in inner]
    return [line for line in lines if line]  # an empty object has none


def _has_keys(value: Any) -> bool:
    """Whether it is an object, or a list of such."""
    items = value if isinstance(value, list) else [value]
    return all(isinstance(item, dict) for item in items)


def _told(key: str, value: Any) -> tuple[str, Any]:
    """A key and its value as people read them: times in ms rather than ns."""
    if not key.endswith("_ns"):
        return key, value
    if isinstance(value, dict):
        return key[:-3], {name: _told(f"{name}_ns", each)[1] for name, each in value.items()}
    if isinstance(value, int) and abs(value) < 2**63:
        return key[:-3], f"{value / 1e6:.12g} ms"
    return key, value


def _words(value: Any, depth: int = 0) -> str:
    """A JSON value in words that are safe to print, whatever is in it."""
    if depth > 4:
        return "..."
    if isinstance(value, dict):
        keys = sorted(value, key=lambda key: key not in _UNNAMED)
        return ", ".join(_item(k, value[k], depth) for k in keys if value[k] is not None)
    if isinstance(value, list):
        found = Counter(_words(item, depth + 1) for item in value)
        return "; ".join(text if n == 1 else f"{n} x {text}" for text, n in found.items())
    if isinstance(value, float):
        return f"{value:.6g}"
    return visible(re.sub(r"\b([0-9a-f]{12})[0-9a-f]{8,}\b", r"\1...", str(value)[:300]))


def _item(key: str, value: Any, depth: int) -> str:
    name = _words(key.replace("_", " "))
    if isinstance(value, bool):
        return name if value else f"not {name}"
    if key.endswith("_bytes") and isinstance(value, int) and abs(value) < 2**63:
        return f"{name[:-6]} {value / 2**30:.1f} GiB"
    if key == "cpu_share" and isinstance(value, (int, float)):
        return f"used {value:.2g} cores"
    words = _words(value, depth + 1)
    return words if key in _UNNAMED else f"{name} {words}"


def _frames(report: Mapping[str, Any]) -> str:
    frames, processed = report["world_frames"], report["processed"]
    parts = [
        f"{frames:,} in {report['sequences']:,} sequences at {report['fps']} fps",
        "all processed" if processed == frames else f"{processed:,} processed",
        "all with truth" if report["with_truth"] == frames else f"{report['with_truth']:,} truths",
    ]
    if report["longest_interval_ms"] is not None:
        parts[0] += (
            f", arriving at times of their own, up to {report['longest_interval_ms']:.3g} ms apart"
        )
    sizes = [size for size in report["image_sizes"] if size != "unknown"]
    if sizes:
        parts.append(", ".join(sizes[:4]) + (" and others" if len(sizes) > 4 else "") + " px")
    if report["lost"] is not None:
        parts.append(f"target not found in {report['lost']:,}")
    return "; ".join(parts)


def _readings(device: Any) -> list[str]:
    """Clocks, temperatures and load before, during and after; nothing where there are none."""
    # another program may have written anything there
    found = gathered(taken=lambda: dict(device["readings"])).get("taken", {})

    def reading(when: str) -> Column:
        return Column(when, lambda row: _range(found.get(when), row[1]))

    columns = [Column("readings", itemgetter(0), is_label=True)]
    columns += map(reading, ("before", "during", "after"))
    table = Table.of(columns, _FIGURES.items())
    table = replace(table, rows=tuple(row for row in table.rows if any(c.text for c in row[1:])))
    return ["", *text_of(table).splitlines()] if table.rows else []


def _range(taken: Any, figure: Callable[[Any], float]) -> str:
    """The lowest and highest value of a figure in one reading or several."""
    values: list[float] = []
    for one in taken if isinstance(taken, list) else [taken]:
        values += gathered(value=lambda one=one: float(figure(one))).values()  # type: ignore[misc]
    return " to ".join(dict.fromkeys(map(_figure, [min(values), max(values)]))) if values else ""


def _beside(device: Mapping[str, Any]) -> list[str]:
    """What else ran while the tracker was measured."""
    loads = device.get("beside")
    known = [load for load in loads if isinstance(load, dict)] if isinstance(loads, list) else []
    return [_entry("  beside", load.get("command")) for load in known]


def _power(provenance: Mapping[str, Any]) -> list[str]:
    """Power, energy and clocks during the calls; nothing where they were not sampled."""
    energy, lines = Energy.of(provenance), []
    if energy is not None:
        columns = [
            Column("power, W", itemgetter(0), is_label=True),
            Column("during calls", itemgetter(1), _figure),
            Column("at rest", lambda row: energy.idle_w.get(row[0]), _figure),
        ]
        rails = sorted(energy.power_w.items(), key=lambda rail: rail[0] not in energy.total)
        table = Table.of(columns, rails)
        lines += ["", *text_of(table).splitlines(), *_joules(energy)]
    # another program may have written anything there
    clocks = gathered(
        mhz=lambda: {k: f"{v:,.0f}" for k, v in provenance["device"]["clocks"].items()}
    )
    for name, mhz in clocks.get("mhz", {}).items():
        lines.append(f"{_words(name.removesuffix('_mhz').upper())} at {mhz} MHz during the calls")
    return ["", *lines] if lines and energy is None else lines


def _joules(energy: Energy) -> Iterator[str]:
    """Sentences about the energy of a call."""
    joules, above = energy.joules_per_frame, energy.joules_above_idle
    rails = _words(" + ".join(energy.total))
    if joules is None:
        yield "the power of the whole device is not known"
        return
    more = "" if above is None else f", {_JOULES(above)} J of it above that at rest"
    yield f"a call takes {_JOULES(joules)} J ({rails}){more}; initialisations are not counted"


def _times(report: Mapping[str, Any]) -> list[str]:
    times = report["times"]
    names = ("mean_ms", "median_ms", "p90_ms", "p95_ms", "p99_ms", "max_ms", "fps")
    columns = [
        Column("times, ms", "kind", is_label=True),
        Column("n", "n", COUNT),
        *(Column(name.removesuffix("_ms"), name, _figure) for name in names),
    ]
    kinds = [{**times[kind], "kind": kind} for kind in ("calls", "initialisations")]
    table = Table.of(columns, [each for each in kinds if each["n"]])
    share, interval = 100 * times["slower_than_frames"], _figure(times["frame_interval_ms"])
    late = f"{share:.3g}% of the calls take longer than the interval between frames, {interval} ms"
    return [*text_of(table).splitlines(), late, _words(InitCost(**report["init"]))]


def _stages(stages: Sequence[Mapping[str, Any]]) -> list[str]:
    """What each stage of the calls takes."""
    columns = [
        Column("stages, ms", lambda row: row["stage"] or "(the rest)", is_label=True),
        Column("n", "n", COUNT),
        *(Column(name, f"{name}_ms", _figure) for name in ("median", "p95")),
        Column("share", "share", lambda share: f"{100 * share:.1f}%"),
    ]
    return text_of(Table.of(columns, stages)).splitlines()


def _figure(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:,.{max(0, min(3, 2 - math.floor(math.log10(abs(value) or 1))))}f}"


def _histogram(found: Mapping[str, Any]) -> list[str]:
    edges = [f"{edge:g}" for edge in found["edges_ms"]]
    labels = [f"< {edges[0]}", *(f"{a} - {b}" for a, b in pairwise(edges)), f"> {edges[-1]}"]
    counts = [found["below"], *found["counts"], found["above"]]
    most, wide = max(counts), max(map(len, labels))
    lines = [f"{'ms':>{wide}}  {'calls':>9}"]
    for label, n in zip(labels, counts):
        bar = "#" * -(-_BAR * n // most)  # what is there is seen
        lines.append(f"{label:>{wide}}  {n:>9,}  {bar}".rstrip())
    return lines


def _drift(times: Mapping[str, Any]) -> list[str]:
    drift = times["drift"]
    if not drift:
        return []
    order = "" if times["order_known"] else " (sequences by name: their order is unknown)"
    chance = " (within chance)" if drift["ratio"] > 1.1 and not drift["slower"] else ""
    return [
        f"medians of tenths of the run, ms{order}",
        f"  {'  '.join(map(_figure, drift['tenths_ms']))}",
        f"last third to first: {drift['ratio']:.2f}{chance}",
        "",
    ]


def _stalls(stalls: list[dict[str, Any]]) -> list[str]:
    if not stalls:
        return []
    lines = [f"stalls: {len(stalls):,} calls took over 10 x the median of run and sequence"]
    listed = sorted(stalls, key=lambda stall: bool(stall["first_call"]))
    for stall in listed[:_STALLS]:
        note = ": first call after initialisation" if stall["first_call"] else ""
        where = f"{_words(stall['sequence'])}, frame {stall['frame']:,}"
        lines.append(f"{_figure(stall['ms']):>10} ms  {where}{note}")
    if left := listed[_STALLS:]:
        first = sum(stall["first_call"] for stall in left)
        lines.append(f"{'...':>10}     and {len(left):,} more, {first:,} of them first calls")
    return [*lines, ""]


def profile_table(passes: Sequence[PassSummary], width: int | None = None) -> str:
    """What a profile's passes left: a line per trace.

    Args:
        passes: what they left.
        width: as of :func:`lae_sim.report.table.text_of`.
    """
    ms = Number(".2f")
    columns = [
        Column("trace", "trace", is_label=True),
        Column("sequences", "sequences", COUNT),
        Column("frames", "world_frames", COUNT),
        Column("processed", "processed", COUNT, importance=3),
        Column("lost", "lost", COUNT, importance=3),
        Column("init ms", "init_ms", ms),
        Column("median ms", "median_ms", ms, importance=9),
        Column("p95 ms", "p95_ms", ms),
    ]
    if any(each.joules_per_frame is not None for each in passes):
        columns.append(Column("J/frame", "joules_per_frame", _JOULES))
    return text_of(Table.of(columns, passes), width=width)


@styled
def plot_times(found: Sequence[tuple[Report, Sequence[SequenceTimes]]], path: str) -> None:
    """Draw, for each trace, a histogram of its times, and the times over the run."""
    figure = new_figure(11, 3.6 * len(found))
    rows = figure.subplots(len(found), 2, squeeze=False, width_ratios=(1, 2))
    for (left, right), (report, sequences) in zip(rows, found):
        times = report["times"]
        if times["histogram"]:
            draw_times(left, times)
        start = 0
        for number, sequence in enumerate(sequences):
            places = range(start, start := start + len(sequence.elapsed_ns))
            ms, colour = sequence.elapsed_ns / 1e6, (BLUE, SKY_BLUE)[number % 2]
            right.plot(places, ms, ".", ms=1.5, color=colour, rasterized=True)
        order = "as they were run" if times["order_known"] else "in order of their names"
        right.set(xlabel=f"calls, sequences {order}", ylabel="time (ms)")
        if times["histogram"] and times["calls"]["max_ms"] > 5 * times["calls"]["median_ms"]:
            right.set(yscale="log", ylabel="time")
            name_durations(right.yaxis, *right.get_ylim())
        right.axhline(times["frame_interval_ms"], color=VERMILION, ls="--", lw=1)
        right.set_title(f"{report['trace']} (dashed: the interval between frames)", fontsize=9)
    save(figure, path)
