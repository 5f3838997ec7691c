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


def test_the_rate_of_nfs_is_that_of_its_set(tmp_path: Path) -> None:
    row = '0 {0} 20 {1} 60 {2} 0 0 0 "ball"\n'
    rows = "".join(row.format(10 + i, 40 + i, i + 1) for i in range(16))
    for rate in ("30", "240"):
        path = tmp_path / "NfS" / "ball" / rate / "ball.txt"
        path.parent.mkdir(parents=True)
        path.write_text(rows)
    boxes = np.array([[10 + i, 20, 30, 40] for i in range(16)], float)
    for fps, every in ((30, 8), (240, 1)):
        np.savez(tmp_path / "kcf.npz", ball=boxes[::every])
        trace, summary = convert_results(
            tmp_path / "kcf.npz", tmp_path / "NfS", fps=fps, time="constant:1ms"
        )
        assert (summary.fps, trace.metadata.fps) == (str(fps), fps)
        np.testing.assert_array_equal(trace["ball"].truth, boxes[::every])
    with pytest.raises(LaeError, match="say which is meant with --fps 30 or --fps 240"):
        convert_results(tmp_path / "kcf.npz", tmp_path / "NfS", time="constant:1ms")


def test_what_optional_files_are_left_out_is_said(folder: Path) -> None:
    (folder / "attributes.csv").write_text("sequence,Occlusion\na,maybe\n")
    trace, summary = convert_results(folder / "kcf.npz", folder / "D", time="constant:1ms")
    assert trace.metadata.attributes("a") == ()
    assert summary.notes == [
        f"attributes are left out: {folder / 'attributes.csv'}, line 2: needs a name and 1 flags "
        "0 or 1"
    ]
