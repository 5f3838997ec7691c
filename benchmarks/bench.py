"""Speed and memory beside their targets: ``make bench`` or ``python benchmarks/bench.py``.

Everything is measured in one run, ratios side by side, some 20 minutes on two idle cores, with
``--quick`` two or three: each thing once, and without what takes long. ``--json`` prints the same
for programs; ``publish.py`` writes it onto the site. Targets (``targets.py``) are for a machine
that does nothing else: the load before and after tells whether it did.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path
from typing import Any

import profiling
import replays
import study
from targets import Line, verdicts

from lae_sim import __version__
from lae_sim.profile import describe_device
from lae_sim.report.table import aligned

LIBRARIES = ("numpy", "numba", "pyarrow", "simpy", "filterpy")
HEADS = {
    "replays": replays.HEAD,
    "stopwatch": profiling.HEAD,
    "studies": study.HEAD,
    "kernels": replays.HEAD,
}


@dataclass(frozen=True)
class Report:
    """What was measured.

    Attributes:
        date: in words.
        machine: cores and processor.
        quick: whether each thing was measured once, and what takes long was left out.
        load: processes at work on average, before and after.
        versions: of Python and packages; empty of those that are not installed.
        parts: lines of measurements, by the keys of :data:`HEADS`.
    """

    date: str
    machine: str
    quick: bool
    load: tuple[float, float]
    versions: Mapping[str, str]
    parts: Mapping[str, Sequence[Line]]

    @classmethod
    def read(cls, text: str) -> Report:
        """What ``--json`` printed."""
        found = json.loads(text)
        del found["targets"]
        parts = {name: [Line(**line) for line in lines] for name, lines in found["parts"].items()}
        return cls(**{**found, "parts": parts})

    def document(self) -> dict[str, Any]:
        """All of it, and the verdicts, for JSON."""
        lines = [*chain.from_iterable(self.parts.values())]
        return {**asdict(self), "targets": [each.document() for each in verdicts(lines)]}

    def circumstances(self) -> str:
        """When, on what, and with which versions."""
        versions = ", ".join(
            f"{name} {number}" if number else f"no {name}" for name, number in self.versions.items()
        )
        before, after = self.load
        return (
            f"Measured {'once ' if self.quick else ''}on {self.date}, on {self.machine},\n"
            f"load {before:.1f} before and {after:.1f} after: {versions}."
        )

    def targets(self) -> str:
        """The table of targets and verdicts."""
        lines = [*chain.from_iterable(self.parts.values())]
        rows = [each.row for each in verdicts(lines)]
        return aligned(["work", "measured", "target", "verdict"], rows, labels=1)

    def part(self, name: str) -> str:
        """The table of one part."""
        return aligned(HEADS[name], [line.row for line in self.parts[name]])


def measured(quick: bool) -> Iterator[tuple[str, list[Line]]]:
    """Lines of measurements and the part that they are of; last those that load numba.

    Args:
        quick: each once, and without what takes long.
    """
    rounds = 1 if quick else 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for lines in replays.measured(folder, quick):
            yield "replays", lines
        yield "stopwatch", profiling.measured(quick)
        for lines in study.measured(folder, quick):
            yield "studies", lines
        yield "kernels", study.pair_lines(rounds)
        yield "kernels", study.lane_lines(rounds)
        yield "kernels", replays.kernel_lines(replays.write_one(folder), rounds)


def report(quick: bool) -> Report:
    """Measure everything; what has been measured is told on the way."""
    before = os.getloadavg()[0]
    parts: dict[str, list[Line]] = {name: [] for name in HEADS}
    for name, lines in measured(quick):
        parts[name] += lines
        print(f"{name}: {lines[0].cells[0]}", file=sys.stderr)
    cpu = describe_device().get("cpu", {})
    cores, processor = cpu.get("cores", os.cpu_count()), cpu.get("name", platform.machine())
    return Report(
        date=f"{datetime.now(timezone.utc):%d %B %Y, %H:%M} UTC",
        machine=f"{cores} cores of {processor}",
        quick=quick,
        load=(before, os.getloadavg()[0]),
        versions={
            "lae_sim": __version__,
            "Python": platform.python_version(),
            **{name: installed(name) for name in LIBRARIES},
        },
        parts=parts,
    )


def installed(package: str) -> str:
    """The version of a package; empty if it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="in two or three minutes")
    parser.add_argument("--json", action="store_true", help="all of it, for programs")
    arguments = parser.parse_args()
    found = report(arguments.quick)
    if arguments.json:
        print(json.dumps(found.document(), indent=1))
    else:
        tables = [f"{name}\n\n{found.part(name)}" for name in HEADS]
        print("\n\n".join([found.circumstances(), found.targets(), *tables]))


if __name__ == "__main__":
    main()
