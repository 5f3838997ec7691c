"""Conversions, from Python; the command line's tests say the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lae_sim.errors import LaeError
from lae_sim.importers.convert import convert_results

BOXES = np.array([[10 + i, 20, 30, 40] for i in range(6)], float)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ground truth ``D`` of three sequences, and results ``kcf.npz`` of two of them."""
    (tmp_path / "D").mkdir()
    for name in "abc":
        np.savetxt(tmp_path / "D" / f"{name}.txt", BOXES, "%g", ",")
    np.savez(tmp_path / "kcf.npz", a=BOXES + 1, b=BOXES + 2)
    return tmp_path


def test_results_become_a_trace(folder: Path) -> None:
    progress: list[tuple[int, int]] = []
    trace, summary = convert_results(
        folder / "kcf.npz",
        str(folder / "D"),
        time="constant:47ms",
        device="a desk",
        progress=lambda done, total: progress.append((done, total)),
    )
    assert progress == [(1, 2), (2, 2)]
    assert [recording.name for recording in trace] == ["a", "b"]
    assert [recording.elapsed_ns.tolist() for recording in trace] == [[47_000_000] * 6] * 2
    assert (trace.metadata.tracker, trace.metadata.device) == ("kcf", "a desk")
    assert (summary.format, summary.frames, summary.median_ms) == ("npz", 12, 47)
    assert summary.without_results == ["c"]
    assert set(summary.files) == {folder / "kcf.npz", *(folder / "D").iterdir()}
    document = summary.document("t.parquet")
    assert document["trace"] == "t.parquet"
    assert "files" not in document


def test_other_truth_for_a_sequence(folder: Path) -> None:
    np.savetxt(folder / "other.txt", BOXES + 5, "%g", ",")
    trace, _ = convert_results(
        folder / "kcf.npz",
        folder / "D",
        time="mean-fps:20",
        sequences=["a"],
        truth_files={"a": str(folder / "other.txt")},
    )
    (recording,) = trace
    np.testing.assert_array_equal(recording.truth, BOXES + 5)
    with pytest.raises(LaeError, match="no results of sequence c"):
        convert_results(folder / "kcf.npz", folder / "D", time="mean-fps:20", exclude=["c"])
