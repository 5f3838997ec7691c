"""The cases of the exact-arithmetic oracle in ../shared/conformance."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import SHARED

from lae_sim.engine.clock import Clock, parse_fps
from lae_sim.evaluation.evaluate import answers, evaluate_runs
from lae_sim.evaluation.metrics import find_convention
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.run import Run, replay_sequence
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

CASES = sorted((SHARED / "conformance").glob("*.json"))


@pytest.fixture(params=[path.stem for path in CASES] or ["absent"])
def case(request: pytest.FixtureRequest, conformance: Path) -> dict[str, Any]:
    return json.loads((conformance / f"{request.param}.json").read_text())


@pytest.fixture(params=["in memory", "through a file"])
def run(request: pytest.FixtureRequest, case: dict[str, Any], tmp_path: Path) -> Run:
    truth = [[np.nan] * 4 if box is None else box for box in case["truth"]]
    recording = Recording.new(case["name"], truth, case["boxes"], case["elapsed_ns"])
    clock = Clock.at(parse_fps(case["fps"]))
    if request.param == "through a file":
        path = tmp_path / "case.parquet"
        write_trace(Trace(Metadata.new(case["fps"], "every-frame"), [recording]), path)
        trace = read_trace(path)
        clock = Clock.at(trace.metadata.fps)
        (recording,) = trace
    return replay_sequence(recording, clock)


@pytest.fixture
def metadata(case: dict[str, Any]) -> Metadata:
    return Metadata.new(case["fps"], "every-frame")


def test_there_are_cases(conformance: Path) -> None:
    assert len(CASES) >= 19


def test_processed_frames_start_and_ready_ticks(case: dict[str, Any], run: Run) -> None:
    schedule = run.schedule
    assert schedule.clock.ticks_per_ns == case["expected"]["ticks_per_ns"]
    processed = np.stack([schedule.frames, schedule.start, schedule.ready], axis=1)
    assert processed.tolist() == case["expected"]["processed"]


def test_pairings_and_kalman_boxes(case: dict[str, Any], run: Run, metadata: Metadata) -> None:
    expected = case["expected"]
    for sigma, paired in expected["paired"].items():
        told = answers(run, metadata, "kalman", load_forecaster("kalman"), Fraction(sigma))
        assert told.source_frame.tolist() == paired
        boxes = np.array(expected["kalman"][sigma])
        assert told.boxes.shape == boxes.shape
        assert np.abs(told.boxes - boxes).max() < 1e-6


def test_metrics(case: dict[str, Any], run: Run, metadata: Metadata) -> None:
    metrics = case["expected"]["metrics"]
    sigmas = sorted(map(Fraction, metrics))
    names = {Fraction(text): text for text in metrics}
    forecasters = {name: load_forecaster(name) for name in next(iter(metrics.values()))}
    conventions = metrics["0"]["hold"]
    assert set(forecasters) == {"hold", "kalman"}
    assert set(conventions) == {"pysot", "exclude"}
    for convention in conventions:
        found = evaluate_runs([run], metadata, forecasters, sigmas, find_convention(convention))
        for f, forecaster in enumerate(forecasters):
            for m, sigma in enumerate(sigmas):
                for metric, value in metrics[names[sigma]][forecaster][convention].items():
                    score = found.scores[metric][f, 0, m]
                    assert score == pytest.approx(value, abs=1e-9, rel=0)
