"""What ``lae-sim show`` prints for people."""

from __future__ import annotations

import math
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

from lae_sim.sensors import gathered

Report = dict[str, Any]

_WIDTH, _INDENT, _BAR, _MOST = 96, 13, 50, 20
_HEADS = ("name", "model", "version", "kind", "source", "policy")


def overview(report: Report) -> str:
    """A trace's report (see ``lae_sim.show.describe``) in lines that fit the terminal."""
    provenance = dict(report["provenance"])
    times = report["times"]
    lines = [_words(report["trace"]), ""]
    for key in dict.fromkeys(["tracker", "device", "timing", "schedule", "dataset", *provenance]):
        if key in provenance:
            lines += _section(key.replace("_", " "), provenance[key])
    lines.append(_entry("frames", _frames(report)))
    if failures := report["failures"]:
        lines.append(_entry("failures", f"{len(failures)}: {_words(failures[:5])}"))
    lines += _readings(provenance.get("device"))
    lines += ["", *_times(times)]
    if times["histogram"]:
        lines += ["", *_histogram(times["histogram"], times["frame_interval_ms"])]
    lines += ["", *_drift(times), *_stalls(times["stalls"])]
    return "\n".join(lines + [_entry("warning", text) for text in report["warnings"]]).rstrip()


def _entry(label: str, text: str) -> str:
    label = _words(label)[: _INDENT - 1].ljust(_INDENT)
    width = max(60, min(_WIDTH, shutil.get_terminal_size((_WIDTH, 24)).columns))
    return textwrap.fill(text, width, initial_indent=label, subsequent_indent=" " * _INDENT)


def _section(label: str, section: Any) -> list[str]:
    """A value of the metadata: what is short on its first line, objects and lists on their own."""
    if not isinstance(section, dict):
        return [_entry(label, _words(section))]
    inner = {k: v for k, v in section.items() if isinstance(v, dict) or k == "power_mode"}
    inner.pop("readings", None)
    short = {k: v for k, v in section.items() if k not in inner and k != "readings"}
    lines = [_entry(label, _words(short))] if short or inner else []
    return lines + [_entry(f"  {k.replace('_', ' ')}", _words(v)) for k, v in inner.items() if v]


def _words(value: Any, depth: int = 0) -> str:
    """A JSON value in words, names first; whatever is in it, it is short and safe to print."""
    if depth > 4:
        return "..."
    if isinstance(value, dict):
        heads = [_words(value[key], depth + 1) for key in _HEADS if value.get(key)]
        rest = [_item(k, v, depth) for k, v in value.items() if k not in _HEADS and v is not None]
        return ", ".join([*([" ".join(heads)] if heads else []), *_first(rest)])
    if isinstance(value, list):
        return "; ".join(_first([_words(item, depth + 1) for item in value[: _MOST + 1]]))
    if isinstance(value, float):
        return f"{value:.6g}"
    text = re.sub(r"\b([0-9a-f]{12})[0-9a-f]{8,}\b", r"\1...", str(value)[:300])
    return "".join(c if c.isprintable() else "?" for c in text)


def _first(words: list[str]) -> list[str]:
    return words if len(words) <= _MOST else [*words[:_MOST], "..."]


def _item(key: str, value: Any, depth: int) -> str:
    name = _words(key.replace("_", " "))
    if isinstance(value, bool):
        return name if value else f"not {name}"
    if key.endswith("_bytes") and isinstance(value, int) and abs(value) < 2**63:
        return f"{name[:-6]} {value / 2**30:.1f} GiB"
    return f"{name} {_words(value, depth + 1)}"


def _frames(report: Report) -> str:
    frames, processed = report["world_frames"], report["processed"]
    parts = [
        f"{frames:,} in {report['sequences']:,} sequences at {report['fps']} fps",
        "all processed" if processed == frames else f"{processed:,} processed",
        "all with truth" if report["with_truth"] == frames else f"{report['with_truth']:,} truths",
    ]
    sizes = [size for size in report["image_sizes"] if size != "unknown"]
    if sizes:
        parts.append(", ".join(sizes[:4]) + (" and others" if len(sizes) > 4 else "") + " px")
    if report["lost"] is not None:
        parts.append(f"target not found in {report['lost']:,}")
    return "; ".join(parts)


_FIGURES: dict[str, Callable[[Any], float]] = {
    "CPU clock, MHz": lambda taken: taken["cpu_mhz"]["highest"],
    "CPU clock allowed": lambda taken: taken["cpu_mhz"]["allowed"],
    "GPU clock, MHz": lambda taken: taken["gpu_mhz"]["highest"],
    "hottest zone, C": lambda taken: max(taken["temperatures_c"].values()),
    "largest rail, W": lambda taken: max(taken["power_w"].values()),
    "load, 1 minute": lambda taken: taken["load"][0],
    "memory free, GiB": lambda taken: taken["memory_available_bytes"] / 2**30,
}


def _readings(device: Any) -> list[str]:
    """Clocks, temperatures and load before, during and after; nothing where there are none."""
    from lae_sim.report import table

    # another program may have written anything there
    found = gathered(taken=lambda: dict(device["readings"])).get("taken", {})
    lines = []
    for name, figure in _FIGURES.items():
        cells = [_range(found.get(when), figure) for when in ("before", "during", "after")]
        if any(cells):
            lines.append([name, *cells])
    header = ["readings", "before", "during", "after"]
    return ["", *table(header, lines, left=1).splitlines()] if lines else []


def _range(taken: Any, figure: Callable[[Any], float]) -> str:
    """The lowest and highest value of a figure in one reading or several."""
    series = taken if isinstance(taken, list) else [taken]
    found = [gathered(value=lambda one=one: float(figure(one))) for one in series]  # type: ignore[misc]
    values = sorted(one["value"] for one in found if one)
    return " to ".join(dict.fromkeys(map(_figure, values[:1] + values[-1:])))


def _times(times: Mapping[str, Any]) -> list[str]:
    from lae_sim.report import table

    names = ("mean_ms", "median_ms", "p90_ms", "p95_ms", "p99_ms", "max_ms", "fps")
    lines = [
        [kind, f"{found['n']:,}", *(_figure(found.get(name)) for name in names)]
        for kind in ("calls", "initialisations")
        if (found := times[kind])["n"]
    ]
    header = ["times, ms", "n", *(name.removesuffix("_ms") for name in names)]
    share, interval = 100 * times["slower_than_frames"], _figure(times["frame_interval_ms"])
    late = f"{share:.3g}% of the calls take longer than the interval between frames, {interval} ms"
    return [*table(header, lines, left=1).splitlines(), late]


def _figure(value: float | None) -> str:
    """Three digits, or all before the point."""
    if value is None:
        return "-"
    return f"{value:,.{max(0, min(3, 2 - math.floor(math.log10(abs(value) or 1))))}f}"


def _histogram(found: Mapping[str, Any], interval: float) -> list[str]:
    """Bars, an eighth of a column fine where the terminal can show it."""
    edges = [f"{edge:g}" for edge in found["edges_ms"]]
    rows = [(f"{a} - {b}", n) for a, b, n in zip(edges, edges[1:], found["counts"])]
    rows = [(f"< {edges[0]}", found["below"]), *rows, (f"> {edges[-1]}", found["above"])]
    rows = [row for i, row in enumerate(rows) if row[1] or 0 < i < len(rows) - 1]
    most, wide = max(n for _, n in rows), max(len(label) for label, _ in rows)
    eighths = " ▏▎▍▌▋▊▉█"
    fine = _can_print(eighths)
    lines = []
    for label, n in rows:
        length = -(-8 * _BAR * n // most)  # what is there is seen
        bar = "█" * (length // 8) + eighths[length % 8].strip() if fine else "#" * -(-length // 8)
        lines.append(f"{label:>{wide}}  {n:>9,}  {bar}".rstrip())
    return [f"{'ms':>{wide}}  {'calls':>9}", *lines]


def _can_print(text: str) -> bool:
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except (LookupError, UnicodeEncodeError):
        return False
    return True


def _drift(times: Mapping[str, Any]) -> list[str]:
    drift = times["drift"]
    if not drift:
        return []
    order = "" if times["order_known"] else " (sequences by name: their order is unknown)"
    ratios = f"last third to first: {drift['ratio']:.2f} over the run"
    if drift["ratio"] > 1.1 and not drift["slower"]:
        ratios += " (within chance)"
    if drift["within"] is not None:
        ratios += f", {drift['within']:.2f} within sequences"
    tenths = "  ".join(map(_figure, drift["tenths_ms"]))
    return [f"medians of tenths of the run, ms{order}", f"  {tenths}", ratios, ""]


def _stalls(stalls: list[dict[str, Any]], most: int = 10) -> list[str]:
    if not stalls:
        return []
    lines = [f"stalls: {len(stalls):,} calls took over 10 x the median of run and sequence"]
    listed = sorted(stalls, key=lambda stall: bool(stall["first_call"]))
    for stall in listed[:most]:
        note = ": first call after initialisation" if stall["first_call"] else ""
        where = f"{_words(stall['sequence'])}, frame {stall['frame']:,}"
        lines.append(f"{_figure(stall['ms']):>10} ms  {where}{note}")
    if len(stalls) > most:
        first = sum(stall["first_call"] for stall in listed[most:])
        lines.append(
            f"{'...':>10}     and {len(stalls) - most:,} more, {first:,} of them first calls"
        )
    return [*lines, ""]
