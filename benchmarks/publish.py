"""Writes what the benchmarks print into docs/results/speed.md: ``python benchmarks/publish.py``.

It runs run.py, profiling.py and study.py, on an idle machine for half an hour, or takes what they
printed before: ``--logs FOLDER`` with run.txt, profiling.txt and study.txt. On the page each stands
in the block after ``<!-- made by benchmarks/NAME.py -->``, and the date, the machine and the
versions in the paragraph after ``<!-- made by benchmarks/publish.py -->``.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path

from lae_sim import __version__
from lae_sim.profile import describe_device

FOLDER = Path(__file__).parent
PAGE = FOLDER.parent / "docs" / "results" / "speed.md"
NAMES = ("run", "profiling", "study")
LIBRARIES = ("numpy", "simpy", "filterpy", "pyarrow")


def printed(name: str) -> str:
    """What a benchmark prints."""
    command = [sys.executable, FOLDER / f"{name}.py"]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, encoding="utf-8").stdout


def machine(when: str) -> str:
    """When, on what, and with which versions."""
    cpu = describe_device().get("cpu", {})
    cores, name = cpu.get("cores", os.cpu_count()), cpu.get("name", platform.machine())
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return (
        f"Measured on {when}, on {cores} cores of {name}:\n"
        f"lae_sim {__version__}, Python {platform.python_version()}, {libraries}."
    )


def day(seconds: float) -> str:
    """The day of a time since the epoch."""
    return f"{datetime.fromtimestamp(seconds, timezone.utc):%d %B %Y}"


def published(page: str, logs: Path | None) -> str:
    """The page with what the benchmarks print now, or printed into a folder."""
    if logs is not None:
        texts = {name: (logs / f"{name}.txt").read_text("utf-8") for name in NAMES}
        when = day(min((logs / f"{name}.txt").stat().st_mtime for name in NAMES))
    else:
        when = f"{day(time.time())} with a load of {os.getloadavg()[0]:.1f} before"
        texts = {name: printed(name) for name in NAMES}
    for name, text in texts.items():
        page = replaced(
            page, rf"(<!-- made by benchmarks/{name}\.py -->\n```text\n).*?(\n```)", text
        )
    return replaced(page, r"(<!-- made by benchmarks/publish\.py -->\n).*?(\n\n)", machine(when))


def replaced(page: str, pattern: str, text: str) -> str:
    """The page with the text between the two groups of a pattern.

    Raises:
        ValueError: if there is not one such place.
    """
    made, count = re.subn(pattern, lambda at: at[1] + text.strip() + at[2], page, flags=re.S)
    if count != 1:
        raise ValueError(f"{count} places for {pattern!r} on the page")
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--logs", type=Path, metavar="FOLDER", help="what was printed before")
    logs = parser.parse_args().logs
    page = published(PAGE.read_text(encoding="utf-8"), logs)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
