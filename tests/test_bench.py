"""What ``make bench`` says of measurements, and what becomes of them on the page about speed."""

from __future__ import annotations

import json
from typing import Any

import pytest
from places import benchmark

targets, bench, publish = map(benchmark, ("targets", "bench", "publish"))


def report(**parts: list[Any]) -> Any:
    """Measurements of some parts, a line of the others."""
    line = targets.Line(["what", "how \\1", "1 s", "1.00"])
    return bench.Report(
        date="1 May 2026, 12:00 UTC",
        machine="2 cores of a processor",
        quick=False,
        load=(0.25, 1.75),
        versions={"lae_sim": "0.2.0", "numba": ""},
        parts={name: parts.get(name, [line]) for name in bench.HEADS},
    )


def test_a_verdict_is_of_the_worst_line() -> None:
    found = report(
        replays=[
            targets.Line(["a", "", "", ""], {"script-hold": 7.0, "trace-hold": 2.5}),
            targets.Line(["b", "", "", ""], {"script-hold": 5.0, "trace-hold": 2.0}),
        ]
    )
    by_work = {each["work"]: each for each in found.document()["targets"]}
    assert len(by_work) == len(targets.TARGETS)
    for key, figure, met in (
        ("script-hold", 5.0, False),  # at least 6
        ("trace-hold", 2.5, True),  # at most 2.5
        ("compare", None, None),
    ):
        each = by_work[targets.TARGETS[key].work]
        assert (each["measured"], each["met"]) == (figure, met)
    lines = found.targets().splitlines()
    ends = {line.split("  ")[0]: line.split()[-1] for line in lines}
    assert ends[targets.TARGETS["script-hold"].work] == "missed"
    assert ends[targets.TARGETS["trace-hold"].work] == "met"
    assert ends[targets.TARGETS["compare"].work] == "measured"
    assert lines[2 + list(targets.TARGETS).index("compare")].endswith("<= 2 s  not measured")
    assert (
        found.part("replays").splitlines()[2].endswith(">= 6 x as fast, <= 2.5 x reading the file")
    )


def test_the_page_has_a_place_for_each_part() -> None:
    page = publish.PAGE.read_text(encoding="utf-8")
    found = report(kernels=[targets.Line(["k", "", "", ""], {"kalman-lanes": 0.01})])
    # through what bench.py --json prints
    made = publish.published(page, bench.Report.read(json.dumps(found.document())))
    tables = {"targets": found.targets(), **{name: found.part(name) for name in bench.HEADS}}
    for name, table in tables.items():
        assert f"<!-- measured: {name} -->\n```text\n{table}\n```\n" in made
    assert (
        "Measured on 1 May 2026, 12:00 UTC, on 2 cores of a processor,\n"
        "load 0.2 before and 1.8 after: lae_sim 0.2.0, no numba.\n\n" in made
    )
    headings = [line for line in page.splitlines() if line.startswith("#")]
    assert [line for line in made.splitlines() if line.startswith("#")] == headings


def test_a_page_without_a_place_is_an_error() -> None:
    with pytest.raises(ValueError, match="0 places"):
        publish.replaced("# Speed\n", "(a).*(b)", "text")
