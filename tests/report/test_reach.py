"""What is said and drawn of a gap pass."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lae_sim.boxes import search_side
from lae_sim.figures.style import save
from lae_sim.report.reach import ReachReport, _wilson, reach_figure
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

BOX = [100.0, 100.0, 20.0, 20.0]
SIDE = float(search_side(np.array(BOX)))
NONE = [np.nan] * 4


def restart(name: str, distance: float, found: list[bool | None]) -> Recording:
    """A jump of one frame, and every frame followed; None is a frame without truth."""
    there = [BOX[0] + distance * SIDE, *BOX[1:]]
    truth = [BOX] + [NONE if hit is None else there for hit in found]
    boxes = [BOX] + [there if hit else [900.0, 9, 20, 20] for hit in found]
    return Recording.new(name, truth, boxes, [5_000_000] * len(boxes))


def gap_pass(*recordings: Recording, **tracker: Any) -> Trace:
    metadata = Metadata.new(30, "restarts", tracker={"name": "mine", **tracker})
    return Trace(metadata, sorted(recordings, key=lambda recording: recording.name))


def sampled(reach: float, count: int = 120) -> list[Recording]:
    return [
        restart(f"a@{1 + k}+1", d, [d < reach]) for k, d in enumerate(np.linspace(0, 1.49, count))
    ]


def test_the_curve_and_the_bins() -> None:
    search = {"half_side": 1.0, "source": "its paper"}
    report = ReachReport.of(gap_pass(*sampled(0.65), search=search))
    document = report.document()
    assert document["centre"] == pytest.approx(0.65, abs=0.02)
    assert document["restarts"] == 120
    assert document["found"] == sum(each["found"] for each in document["bins"])
    assert document["declared"] == {"half_side": 1.0, "window": None, "source": "its paper"}
    shares = {each["start"]: each["share"] for each in document["bins"]}
    assert (shares[0.3], shares[0.9]) == (1.0, 0.0)
    assert 0 < shares[0.6] < 1
    assert all(0 <= b["share_low"] <= b["share"] <= b["share_high"] <= 1 for b in document["bins"])
    json.dumps(document, allow_nan=False)
    text = report.text()
    assert "centre 0.6" in text
    assert "declared: up to 1 (its paper)" in text
    assert max(map(len, text.splitlines())) <= 100


@pytest.mark.parametrize(
    ("restarts", "said"),
    [
        (sampled(9.0), "120 of 120 restarts found their target, so at least 1.49"),
        (sampled(-1.0), "0 of 120 restarts found their target, so at most 0.00"),
        (sampled(0.7, 5), "5 restarts, and 20 are needed"),
        ([restart("a@0+1", 0.5, [None])], "0 restarts"),
    ],
)
def test_a_reach_that_is_not_known(restarts: list[Recording], said: str, tmp_path: Path) -> None:
    report = ReachReport.of(gap_pass(*restarts))
    assert said in report.text()
    assert report.document()["centre"] is None
    save(reach_figure([report]), str(tmp_path / "reach.svg"))


@pytest.mark.parametrize(
    ("outcomes", "said", "signs"),
    [
        ([[True], [True], [False]], "found up to gap 2", ["+", "+", "-"]),
        ([[False], [False]], "lost from gap 1 on", ["-", "-"]),
        ([[True], [True]], "found up to gap 2, the largest", ["+", "+"]),
        ([[True], [False], [True]], "found 1, 3", ["+", "-", "+"]),
        ([[False, False, True]], "lost from gap 1 on", ["+2"]),
        ([[None, True], [None]], "unknown", ["+1", "?"]),
    ],
)
def test_what_own_jumps_come_to(outcomes: list[Any], said: str, signs: list[str]) -> None:
    recordings = []
    for gap, found in enumerate(outcomes, 1):
        jump = restart("x", 0.5, found)
        pad = [[BOX] * (gap - 1), [NONE] * (gap - 1)]
        truth = [BOX, *pad[0], *jump.truth[1:].tolist()]
        boxes = [BOX, *pad[1], *jump.boxes[1:].tolist()]
        times = np.where(np.isnan(np.array(boxes)[:, 0]), -1, 5_000_000)
        recordings.append(Recording.new(f"car@0+{gap}", truth, boxes, times))
    lines = ReachReport.of(gap_pass(*recordings)).text().splitlines()
    (row,) = [line for line in lines if line.startswith("car")]
    assert row.split("  ")[2].strip() == said or said in row
    assert row.split()[-len(signs) :] == signs


def test_wilsons_interval_by_hand() -> None:
    # Brown, Cai and DasGupta, "Interval estimation for a binomial proportion" (2001)
    assert _wilson(0, 10) == pytest.approx((0, 0.2775), abs=1e-4)
    assert _wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)


def test_a_picture_of_several(tmp_path: Path) -> None:
    own = [restart("a@0+1", 0.2, [True]), restart("b@0+1", 0.9, [False])]
    reports = [ReachReport.of(gap_pass(*sampled(c), *own)) for c in (0.5, 0.9)]
    save(reach_figure(reports), str(tmp_path / "reach.svg"))
    assert (tmp_path / "reach.svg").read_text().count("<svg") == 1
