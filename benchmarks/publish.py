"""Writes what ``bench.py`` measures onto docs/results/speed.md: ``python benchmarks/publish.py``.

It measures everything, on an idle machine for some 20 minutes, or takes what was measured before:
``--measured FILE`` with what ``bench.py --json`` printed. On the page the table of targets stands
in the block after ``<!-- measured: targets -->``, likewise that of each part, and the date, the
machine and the versions in the paragraph after ``<!-- measured: circumstances -->``.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from bench import HEADS, Report, report

PAGE = Path(__file__).parents[1] / "docs" / "results" / "speed.md"


def published(page: str, found: Report) -> str:
    """The page with what was measured."""
    tables = {"targets": found.targets(), **{name: found.part(name) for name in HEADS}}
    for name, text in tables.items():
        page = replaced(page, rf"(<!-- measured: {name} -->\n```text\n).*?(\n```)", text)
    pattern = r"(<!-- measured: circumstances -->\n).*?(\n\n)"
    return replaced(page, pattern, found.circumstances())


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
    parser.add_argument("--measured", type=Path, metavar="FILE", help="of bench.py --json")
    file = parser.parse_args().measured
    found = Report.read(file.read_text(encoding="utf-8")) if file else report(quick=False)
    PAGE.write_text(published(PAGE.read_text(encoding="utf-8"), found), encoding="utf-8")


if __name__ == "__main__":
    main()
