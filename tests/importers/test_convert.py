"""Conversions, from Python; the command line's tests say the rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

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


@pytest.mark.parametrize("suffix", [".txt", ".mat"])
def test_one_of_several_trackers_in_a_folder(folder: Path, suffix: str) -> None:
    results = folder / "all"
    results.mkdir()
    for name, tracker in (
        ("a", "KCF"),
        ("b", "KCF"),
        ("a", "MY_KCF"),
        ("zzz", "ECO"),
        ("b", "ECO"),
    ):
        path = results / f"{name}_{tracker}{suffix}"
        if suffix == ".txt":
            np.savetxt(path, BOXES + len(tracker), "%g", ",")
        else:
            scipy.io.savemat(path, {"res": BOXES + len(tracker)})
    settings: dict[str, Any] = {"time": "mean-fps:20"}
    with pytest.raises(LaeError, match=r"results of 3 trackers \(ECO, KCF, MY_KCF\); choose one"):
        convert_results(results, folder / "D", **settings)
    with pytest.raises(LaeError, match=r"none is 'KFC'; did you mean 'KCF'"):
        convert_results(results, folder / "D", tracker="KFC", **settings)
    trace, summary = convert_results(results, folder / "D", tracker="KCF", **settings)
    assert [recording.name for recording in trace] == ["a", "b"]
    np.testing.assert_array_equal(trace["a"].boxes, BOXES + 3)
    assert (summary.tracker, summary.other_trackers) == ("KCF", ["ECO", "MY_KCF"])
    # without truth is only what is the tracker's own
    with pytest.raises(LaeError, match="no ground truth for zzz_ECO, of 5 results; --skip-missing"):
        convert_results(results, folder / "D", tracker="ECO", **settings)
    _, summary = convert_results(
        results, folder / "D", tracker="ECO", skip_missing=True, **settings
    )
    assert (summary.sequences, summary.without_truth) == (1, ["zzz_ECO"])


def test_what_follows_a_sequence_is_no_tracker_beside_files_that_name_none(folder: Path) -> None:
    results = folder / "kcf"
    results.mkdir()
    for name in ("a", "b", "b_MY", "c_s"):
        np.savetxt(results / f"{name}.txt", BOXES + len(name), "%g", ",")
    settings: dict[str, Any] = {"time": "mean-fps:20"}
    refused = (
        "no ground truth for b_MY, c_s, of 4 results; --skip-missing leaves them out, "
        "--tracker MY takes its own alone"
    )
    with pytest.raises(LaeError, match=refused):
        convert_results(results, folder / "D", **settings)
    with pytest.raises(LaeError, match=refused):  # a name for them, and b_MY is still no sequence
        convert_results(results, folder / "D", tracker="mine", **settings)
    trace, summary = convert_results(results, folder / "D", skip_missing=True, **settings)
    assert (summary.tracker, trace.names) == ("kcf", ("a", "b"))
    assert summary.without_truth == ["b_MY", "c_s"]
    trace, summary = convert_results(results, folder / "D", tracker="MY", **settings)
    np.testing.assert_array_equal(trace["b"].boxes[1:], BOXES[1:] + 4)
    assert (trace.names, summary.tracker) == (("b",), "MY")
    assert summary.notes == [
        "results whose names tell no tracker are left out beside those of MY: a, b"
    ]


def test_names_say_which_tracker_it_was(folder: Path) -> None:
    results = folder / "results"
    results.mkdir()
    for name in "ab":
        np.savetxt(results / f"nfs_{name}_C-COT.txt", BOXES, "%g", ",")
    _, summary = convert_results(results, folder / "D", time="mean-fps:20")
    assert (summary.tracker, summary.sequences) == ("C-COT", 2)
    _, summary = convert_results(results, folder / "D", time="mean-fps:20", tracker="mine")
    assert summary.tracker == "mine"


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


def test_the_last_box_stands_where_the_tracker_has_none(folder: Path) -> None:
    boxes = BOXES + 1
    boxes[[0, 2, 3]] = np.nan
    np.savez(folder / "TLD.npz", a=boxes, b=BOXES, c=np.where(np.eye(6, 1) == 1, np.nan, BOXES))
    trace, summary = convert_results(folder / "TLD.npz", folder / "D", time="mean-fps:20")
    held = [BOXES[0], *(BOXES[[1, 1, 1, 4, 5]] + 1)]  # the first is the box that it was given
    np.testing.assert_array_equal(trace["a"].boxes, held)
    assert summary.held == {"a": 2}
    assert summary.row_0_from_truth == []
    entries = trace.metadata.document["sequences"]
    assert {name: entry["lost"] for name, entry in entries.items()} == {"a": 2, "b": 0, "c": 0}
    np.savez(folder / "TLD.npz", a=boxes * np.nan)
    with pytest.raises(LaeError, match="'a': holds no box at all"):
        convert_results(folder / "TLD.npz", folder / "D", time="mean-fps:20")
    truth = BOXES.copy()
    truth[0] = np.nan
    np.savetxt(folder / "D" / "a.txt", truth, "%g", ",")
    np.savez(folder / "TLD.npz", a=boxes)
    with pytest.raises(LaeError, match=r"TLD\.npz: row 1 has no box, and neither has the ground"):
        convert_results(folder / "TLD.npz", folder / "D", time="mean-fps:20")


def test_two_sequences_that_a_name_may_mean_are_a_question(folder: Path) -> None:
    for number in "12":
        np.savetxt(folder / "D" / f"Jogging-{number}.txt", BOXES, "%g", ",")
    np.savez(folder / "kcf.npz", Jogging=BOXES)
    with pytest.raises(LaeError, match=r"kcf\.npz: is it of sequence Jogging-1 or Jogging-2\? .*"):
        convert_results(folder / "kcf.npz", folder / "D", time="mean-fps:20")
    trace, _ = convert_results(
        folder / "kcf.npz",
        folder / "D",
        time="mean-fps:20",
        truth_files={"Jogging": folder / "D" / "Jogging-2.txt"},
    )
    assert [recording.name for recording in trace] == ["Jogging"]


def test_a_vot_experiment_is_in_its_trackers_folder(folder: Path) -> None:
    path = folder / "results" / "TRK" / "unsupervised" / "a" / "a_001.txt"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(["1", *(",".join(map(str, box)) for box in BOXES[1:])]))
    trace, summary = convert_results(path.parents[1], folder / "D", time="mean-fps:20")
    assert (summary.tracker, summary.held) == ("TRK", {})
    np.testing.assert_array_equal(trace["a"].boxes, BOXES)
