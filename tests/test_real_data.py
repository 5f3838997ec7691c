"""The figures of DESIGN 6, on real trackers; skipped where the data is absent."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from witness import scores

from lae_sim.engine.clock import Clock
from lae_sim.evaluation.caveats import left_search
from lae_sim.evaluation.evaluate import Evaluation, evaluate_runs
from lae_sim.evaluation.metrics import find_convention, precision_curve, success_curve
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.latency import by_frame, constant, scaled
from lae_sim.replay.run import replay_sequence
from lae_sim.replay.world import SIGMA_GRID, replay_trace
from lae_sim.study.run import compute_study, flat_rows
from lae_sim.study.spec import Study
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

METADATA = Metadata.new("30", "every-frame")
CLOCK = Clock.at(Fraction(30))
FORECASTERS = {name: load_forecaster(name) for name in ("hold", "kalman")}


def stored(recordings: Iterator[Recording], folder: Path) -> Trace:
    path = folder / "trace.parquet"
    write_trace(Trace(METADATA, recordings), path)
    return read_trace(path)


@pytest.fixture(scope="module")
def ortrack(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Trace:
    dataset = "VisDrone-SOT-test-dev"
    results = shared_data / "results_with_times" / dataset / "ORTrack-DeiT-tiny"

    def recordings() -> Iterator[Recording]:
        for path in sorted(results.glob("*_s.txt")):
            truth = np.loadtxt(shared_data / dataset / "anno" / path.name, delimiter=",")
            seconds = np.loadtxt(results / f"{path.stem}_time.txt")
            boxes = np.loadtxt(path, delimiter=",")
            yield Recording.new(path.stem, truth, boxes, np.rint(seconds * 1e9))

    return stored(recordings(), tmp_path_factory.mktemp("ortrack"))


@pytest.fixture(scope="module")
def nanotrack(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Trace:
    def recordings() -> Iterator[Recording]:
        with np.load(shared_data / "results_boxes" / "DTB70" / "NanoTrackV3.npz") as boxes:
            for name in sorted(boxes.files):
                truth = np.loadtxt(shared_data / "DTB70" / "anno" / f"{name}.txt", delimiter=",")
                yield Recording.new(name, truth, boxes[name], np.full(len(truth), 47_000_000))

    return stored(recordings(), tmp_path_factory.mktemp("nanotrack"))


def means(found: Evaluation) -> dict[str, tuple[float, float]]:
    """AUC and DP of each forecaster, over sequences and then sigmas, to four decimals."""
    auc, dp = (found.scores[metric].mean(axis=(1, 2)) for metric in ("auc", "dp20"))
    return {name: (round(a, 4), round(d, 4)) for name, a, d in zip(FORECASTERS, auc, dp)}


@pytest.mark.parametrize(
    ("factor", "processed", "mismatch", "hold", "kalman"),
    [
        (1, 19_427, 20_351, (0.5013, 0.6930), (0.5063, 0.7137)),
        (2, 15_401, 47_022, (0.4772, 0.6624), (0.4929, 0.7025)),
        (4, 7_742, 85_214, (0.4477, 0.6523), (0.4682, 0.6838)),
    ],
)
def test_ortrack_on_visdrone(
    ortrack: Trace,
    factor: int,
    processed: int,
    mismatch: int,
    hold: tuple[float, float],
    kalman: tuple[float, float],
) -> None:
    source = scaled(by_frame, Fraction(factor))
    runs = [replay_sequence(recording, CLOCK, source) for recording in ortrack]
    found = evaluate_runs(runs, METADATA, FORECASTERS)
    assert len(found.replay.sequences) == 20
    assert found.replay.frames.sum() == 19_433
    assert found.replay.processed.sum() == processed
    assert found.staleness.mismatch_sum.sum() == mismatch
    assert means(found) == {"hold": hold, "kalman": kalman}
    assert found.offline["auc"].mean().round(4) == 0.5147
    assert found.offline["dp20"].mean().round(4) == 0.7189


def test_nanotrack_on_dtb70_at_47_ms(nanotrack: Trace) -> None:
    runs = [replay_sequence(recording, CLOCK) for recording in nanotrack]
    found = evaluate_runs(runs, METADATA, FORECASTERS)
    assert len(found.replay.sequences) == 70
    assert found.replay.processed.sum() == 11_226
    assert found.staleness.mismatch_sum.sum() == 40_315
    assert means(found) == {"hold": (0.4233, 0.5566), "kalman": (0.5300, 0.7221)}
    assert found.offline["auc"].mean().round(3) == 0.628
    assert found.offline["dp20"].mean().round(3) == 0.815


def test_nanotrack_over_the_grid_of_permitted_latencies(nanotrack: Trace) -> None:
    source = constant(ns=47_000_000)
    runs = [replay_sequence(recording, CLOCK, source) for recording in nanotrack]
    found = evaluate_runs(runs, METADATA, FORECASTERS, SIGMA_GRID)
    assert means(found) == {"hold": (0.4560, 0.6086), "kalman": (0.5485, 0.7475)}


def test_studies_reach_the_same_figures_in_batches(
    ortrack: Trace, nanotrack: Trace, tmp_path: Path
) -> None:
    write_trace(nanotrack, tmp_path / "nano.parquet")
    write_trace(ortrack, tmp_path / "ortrack.parquet")
    nano = Study((str(tmp_path / "nano.parquet"),), sigmas=SIGMA_GRID)
    scales = (Fraction(1), Fraction(2), Fraction(4))
    slower = Study((str(tmp_path / "ortrack.parquet"),), scales=scales)
    rows = flat_rows(
        [
            *compute_study(nano, tmp_path / "a", workers=1).summary,
            *compute_study(slower, tmp_path / "b", workers=1).summary,
        ]
    )
    assert {row["engine"] for row in rows} == {"batch"}
    found = {
        (row["trace"], row["scale"], row["sigma"], row["forecaster"]): (
            round(row["auc"], 4),
            round(row["dp20"], 4),
        )
        for row in rows
    }
    assert found["nano", "1", "mean", "hold"] == (0.4560, 0.6086)
    assert found["nano", "1", "mean", "kalman"] == (0.5485, 0.7475)
    assert found["nano", "1", "0", "kalman"] == (0.5300, 0.7221)
    assert found["ortrack", "1", "0", "hold"] == (0.5013, 0.6930)
    assert found["ortrack", "2", "0", "kalman"] == (0.4929, 0.7025)
    assert found["ortrack", "4", "0", "kalman"] == (0.4682, 0.6838)


def test_offline_values_do_not_depend_on_latency(nanotrack: Trace) -> None:
    runs = [replay_sequence(r, CLOCK, constant(ns=0)) for r in list(nanotrack)[:5]]
    found = evaluate_runs(runs, METADATA, FORECASTERS)
    for metric, offline in found.offline.items():
        assert found.scores[metric][0, :, 0].tolist() == offline.tolist()


@pytest.mark.parametrize(("init", "count"), [("300ms", 13), ("500ms", 29), ("1s", 44)])
def test_targets_of_dtb70_leave_the_search_region_during_a_slow_initialisation(
    nanotrack: Trace, init: str, count: int
) -> None:
    runs = replay_trace(nanotrack, latency=f"constant:47ms,init={init}")
    found = evaluate_runs(runs, METADATA, {"hold": FORECASTERS["hold"]}).replay
    assert len(left_search(found)) == count


def test_otb_on_uavdt_whose_truths_reach_over_the_border(shared_data: Path) -> None:
    otb = find_convention("otb")
    found, expected = [], []
    with np.load(shared_data / "results_boxes" / "UAVDT" / "KCF_GaussHog.npz") as results:
        for name in results.files:
            truth = np.loadtxt(shared_data / "UAVDT" / "anno" / f"{name}.txt", delimiter=",")
            boxes = results[name].astype(float)
            success, precision = (f(truth, boxes, otb) for f in (success_curve, precision_curve))
            found.append((success.mean(), precision[20]))
            if name in ("S0304", "S1601"):  # where it matters, and not too long
                values = scores(truth.tolist(), boxes.tolist(), "otb", float)
                expected.append((values["auc"], values["dp20"]))
                assert found[-1] == pytest.approx(expected[-1], abs=1e-12)
    assert len(expected) == 2
    assert np.round(np.mean(found, axis=0), 3).tolist() == [0.29, 0.571]
