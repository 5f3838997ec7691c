"""Logs as traces that replay as they were recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.engine.clock import Clock, parse_fps
from lae_sim.errors import LaeError
from lae_sim.importers.measured import convert_log
from lae_sim.replay.recorded import AsRecorded
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.file import Trace

HEADER = "frame,captured_ns,arrived_ns,started_ns,ready_ns,x,y,w,h"
MS = 10**6


def written(folder: Path, rows: list[list[Any]], header: str = HEADER) -> Path:
    path = folder / "flight.csv"
    lines = [",".join("" if cell is None else str(cell) for cell in row) for row in rows]
    path.write_text("\n".join([header, *lines]))
    return path


def replayed(trace: Trace) -> dict[int, int]:
    """When the output of each frame is ready, ns after frame 0 arrived."""
    [recording] = trace
    clock = Clock.at(trace.metadata.fps)
    run = replay_sequence(recording, clock, policy=AsRecorded())
    assert run.departures == 0
    ready = (run.schedule.ready // clock.ticks_per_ns).tolist()
    return dict(zip(run.schedule.frames.tolist(), ready))


def rows_of(arrived: list[int], outputs: dict[int, tuple[int | None, int]]) -> list[list[Any]]:
    """A row for each frame; of some when their calls began (if known), and were ready."""
    rows: list[list[Any]] = []
    for frame, at in enumerate(arrived):
        begun, ready = outputs.get(frame, (None, None))
        box = [frame + 0.25, 2, 3, 4] if ready is not None else [None] * 4
        rows.append([frame, at - 5 * MS, at, begun, ready, *box])
    return rows


@st.composite
def logs(draw: st.DrawFn) -> tuple[list[int], dict[int, tuple[int | None, int]]]:
    """Frames, some of which are processed: in turn, in a queue, or several at once."""
    steps = draw(st.lists(st.integers(1, 80 * MS), min_size=0, max_size=25))
    base = draw(st.integers(-(10**15), 10**18))
    arrived = [base]
    for step in steps:
        arrived.append(arrived[-1] + step)
    processed = sorted({0, *draw(st.sets(st.integers(0, len(steps))))})
    outputs: dict[int, tuple[int | None, int]] = {}
    ready = arrived[0]
    for frame in processed:
        ready = max(ready, arrived[frame]) + draw(st.integers(0, 200 * MS))
        begun = draw(st.none() | st.integers(arrived[frame], ready))
        outputs[frame] = begun, ready
    return arrived, outputs


@given(logs(), st.sampled_from(["30", "30000/1001", "29.97", "7"]))
def test_every_output_is_ready_when_the_log_says(
    tmp_path_factory: pytest.TempPathFactory,
    log: tuple[list[int], dict[int, tuple[int | None, int]]],
    fps: str,
) -> None:
    arrived, outputs = log
    path = written(tmp_path_factory.mktemp("log"), rows_of(arrived, outputs))
    trace, summary = convert_log(path, fps=fps)
    # outputs that begin when the stream has ended are seen by no query
    end = arrived[-1] + 10**9 / parse_fps(fps)
    seen: dict[int, int] = {}
    free = arrived[0]
    for frame, (_, ready) in outputs.items():
        if seen and max(free, arrived[frame]) >= end:
            break
        seen[frame] = ready - arrived[0]
        free = ready
    assert replayed(trace) == seen
    [recording] = trace
    assert recording.arrival_ns is not None
    assert recording.arrival_ns.tolist() == [at - arrived[0] for at in arrived]
    assert recording.boxes[list(seen), 0].tolist() == [frame + 0.25 for frame in seen]
    for frame, (begun, ready) in outputs.items():
        if recording.stages and frame in seen:
            known = recording.stages["tracker"][frame]
            assert known in (-1, ready - (begun or 0))
    left_out = len(outputs) - len(seen)
    assert any(note.startswith(f"{left_out:,} outputs that") for note in summary.notes) == (
        left_out > 0
    )


def test_a_queue_and_stages_that_overlap(tmp_path: Path) -> None:
    arrived = [0, 10 * MS, 20 * MS, 30 * MS, 40 * MS]
    outputs = {
        0: (2 * MS, 25 * MS),  # waited 2 ms
        1: (25 * MS, 45 * MS),  # had queued
        2: (30 * MS, 60 * MS),  # begun while frame 1 was worked on
        4: (61 * MS, 70 * MS),
    }
    trace, summary = convert_log(written(tmp_path, rows_of(arrived, outputs)), fps=20)
    [recording] = trace
    processed = [0, 1, 2, 4]
    assert recording.elapsed_ns.tolist() == [25 * MS, 20 * MS, 15 * MS, -1, 10 * MS]
    assert recording.stages["queue"][processed].tolist() == [2 * MS, 0, -1, MS]
    assert recording.stages["tracker"][processed].tolist() == [23 * MS, 20 * MS, -1, 9 * MS]
    assert "1 calls began before the one before was ready: their times reach from output to " in (
        " ".join(summary.notes)
    )
    assert trace.metadata.with_columns().document["version"] == "1.1"


def test_outputs_out_of_order_are_left_out(tmp_path: Path) -> None:
    arrived = [0, 10 * MS, 20 * MS]
    outputs = {0: (None, 15 * MS), 1: (None, 60 * MS), 2: (None, 50 * MS)}
    trace, summary = convert_log(written(tmp_path, rows_of(arrived, outputs)), fps=20)
    assert replayed(trace) == {0: 15 * MS, 2: 50 * MS}
    left = "1 outputs of frames older than one whose output was ready are left out"
    assert left in summary.notes


def test_an_output_that_begins_as_the_stream_ends_is_left_out(tmp_path: Path) -> None:
    outputs = {0: (None, 60 * MS), 1: (None, 61 * MS)}  # at 20 frames/s it ends at 10 + 50 ms
    trace, summary = convert_log(written(tmp_path, rows_of([0, 10 * MS], outputs)), fps=20)
    assert replayed(trace) == {0: 60 * MS}
    assert "1 outputs that began after the stream had ended are left out" in summary.notes
    outputs[0] = None, 60 * MS - 1
    trace, _ = convert_log(written(tmp_path, rows_of([0, 10 * MS], outputs)), fps=20)
    assert replayed(trace) == {0: 60 * MS - 1, 1: 61 * MS}


def test_the_first_output_may_be_of_a_later_frame(tmp_path: Path) -> None:
    outputs = {0: (None, 60 * MS), 1: (None, 30 * MS), 2: (None, 70 * MS)}
    rows = rows_of([0, 10 * MS, 20 * MS], outputs)
    trace, summary = convert_log(written(tmp_path, rows), fps=20)
    assert replayed(trace) == {0: 20 * MS, 1: 60 * MS}  # frames 1 and 2
    assert "1 outputs from before the first frame are left out" in summary.notes


def test_the_initial_box(tmp_path: Path) -> None:
    arrived = [k * 33 * MS for k in range(6)]
    outputs = {2: (None, 90 * MS), 4: (None, 140 * MS)}
    path = written(tmp_path, rows_of(arrived, outputs))
    trace, summary = convert_log(path, fps=30)
    assert (len(trace["flight"]), trace.metadata.document["log"]["initial_box"]) == (
        4,
        "first output",
    )
    assert replayed(trace) == {0: 24 * MS, 2: 74 * MS}
    assert "2 frames before the first output are left out" in summary.notes
    assert summary.timing["note"] == (
        "the first output's time stands for that of the initialisation"
    )
    trace, summary = convert_log(path, fps=30, init_box=(1, 2, 3, 4))
    assert trace["flight"].boxes[0].tolist() == [1, 2, 3, 4]
    assert replayed(trace) == {0: 0, 2: 90 * MS, 4: 140 * MS}
    assert "which takes no time here" in summary.timing["note"]
    outputs[0] = None, 31 * MS
    path = written(tmp_path, rows_of(arrived, outputs))
    trace, summary = convert_log(path, fps=30, init_box=(1, 2, 3, 4))
    assert trace["flight"].boxes[0].tolist() == [1, 2, 3, 4]  # rather than what it answered
    assert replayed(trace) == {0: 31 * MS, 2: 90 * MS, 4: 140 * MS}


def test_an_output_without_a_box(tmp_path: Path) -> None:
    rows = rows_of([0, 33 * MS, 66 * MS], {0: (None, MS), 1: (None, 40 * MS), 2: (None, 70 * MS)})
    rows[1][-4:] = [None] * 4
    trace, summary = convert_log(written(tmp_path, rows), fps=30)
    assert trace["flight"].boxes[:, 0].tolist() == [0.25, 0.25, 2.25]
    assert replayed(trace) == {0: MS, 1: 40 * MS, 2: 70 * MS}
    assert summary.held == {"flight": 1}


def test_capture_times_in_place_of_arrivals(tmp_path: Path) -> None:
    header = "frame,captured_ms,ready_s,x,y,w,h"
    rows = [[0, 0, 3600.030, 1, 2, 3, 4], [1, 33, None] + [None] * 4, [2, 66, 3600.1, 1, 2, 3, 4]]
    path = written(tmp_path, rows, header)
    with pytest.raises(
        LaeError, match=r"with the same clock the quickest frame arrives 3,600 s aft"
    ):
        convert_log(path, fps=30)
    trace, summary = convert_log(path, fps=30, clock_offset="3600s")
    assert replayed(trace) == {0: 30 * MS, 2: 100 * MS}
    assert trace.metadata.document["log"] == {
        "format": "csv", "arrivals": "captured", "initial_box": "first output",
        "clock_offset_ns": 3600 * 10**9, "clock_offset_source": "given",
    }  # fmt: skip
    trace, summary = convert_log(path, fps=30, clock_offset="estimate")
    assert replayed(trace) == {0: 0, 2: 70 * MS}
    assert any("an estimate, by which the quickest frame takes no time from capture to output" in n
               for n in summary.notes)  # fmt: skip
    with pytest.raises(LaeError, match="line 2: no time when the frame was received"):
        convert_log(path, fps=30, arrivals="received")


def test_the_rate_is_estimated_in_the_open(tmp_path: Path) -> None:
    arrived = [round(k * 1001e9 / 30000) + k % 3 for k in range(20)]
    path = written(tmp_path, rows_of(arrived, {0: (None, 40 * MS)}))
    trace, summary = convert_log(path)
    assert trace.metadata.document["fps"] == summary.fps == "29.97"
    estimated = "29.97 frames/s is estimated, from the median time between frames (--fps)"
    assert any(note.startswith(estimated) for note in summary.notes)
    with pytest.raises(LaeError, match="too few frames to tell their rate: give it by --fps"):
        convert_log(written(tmp_path, rows_of([0], {0: (None, 40 * MS)})))


def test_truth_of_a_file(tmp_path: Path) -> None:
    path = written(tmp_path, rows_of([0, 33 * MS, 66 * MS], {1: (None, 40 * MS)}))
    truth = tmp_path / "truth.txt"
    truth.write_text("1,2,3,4\n2,2,3,4\n3,2,3,4\n")
    trace, summary = convert_log(path, fps=30, truth=truth)
    assert trace["flight"].truth[:, 0].tolist() == [2, 3]
    assert not [note for note in summary.notes if "ground truth" in note]
    assert truth in summary.files
    truth.write_text("1,2,3,4\n")
    with pytest.raises(
        LaeError, match=r"truth.txt: 1 rows of ground truth, and the log has 3 frames"
    ):
        convert_log(path, fps=30, truth=truth)
    _, summary = convert_log(path, fps=30)
    assert any(note.startswith("no ground truth") for note in summary.notes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            (1, 2, -1),
            r"line 3: received 1e-06 ms before the frame ahead of it: frames come one aft",
        ),
        ((0, 4, -MS), r"line 2: ready 1 ms before its frame arrived; if the log received"),
        ((0, 3, -2 * MS), r"line 2: started 2 ms before its frame arrived"),
        ((0, 3, 41 * MS), r"line 2: started 1 ms after it was ready"),
        ((0, 4, 10**18), r"line 2: ready 1e\+09 s after its frame arrived: are the clocks one\?"),
    ],
)
def test_times_that_cannot_be(tmp_path: Path, change: tuple[int, int, int], message: str) -> None:
    rows = rows_of([0, 33 * MS], {0: (5 * MS, 40 * MS)})
    row, column, value = change
    rows[row][column] = value
    with pytest.raises(LaeError, match=message):
        convert_log(written(tmp_path, rows), fps=30)


def test_logs_without_anything(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"flight.csv: no outputs"):
        convert_log(written(tmp_path, rows_of([0, 33 * MS], {})), fps=30)
    rows = rows_of([0], {0: (None, 1)})
    rows[0][-4:] = [None] * 4
    with pytest.raises(LaeError, match=r"flight.csv: no output has a box"):
        convert_log(written(tmp_path, rows), fps=30)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"arrivals": "sent"}, r"arrivals: no 'sent': there are received and captured"),
        ({"gaps": "lost"}, r"gaps: no 'lost': there are dropped and skipped"),
        ({"box_topic": "/box", "match": "20ms"}, r"boxes, match: of bags, and .*csv is a table"),
        ({"format": "npz"}, r"neither a ROS bag nor a .csv file"),
        ({"fps": "0"}, r"above zero"),
    ],
)
def test_options_that_do_not_fit(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    path = written(tmp_path, rows_of([0, 33 * MS], {0: (None, 40 * MS)}))
    with pytest.raises(LaeError, match=message):
        convert_log(path, **options)


def test_what_is_no_log(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match="no such file or folder"):
        convert_log(tmp_path / "nowhere.mcap")
    with pytest.raises(LaeError, match="log: a path, not 3"):
        convert_log(3)  # type: ignore[arg-type]
    with pytest.raises(
        LaeError, match=r"neither a ROS bag nor a .csv file: say which with --format"
    ):
        convert_log(tmp_path)


def test_names_and_the_image_size(tmp_path: Path) -> None:
    path = written(tmp_path, rows_of([0, 33 * MS], {0: (None, 40 * MS)}))
    trace, summary = convert_log(
        path, fps=30, tracker="kcf", device="Orin", dataset="field", image_size=(1280, 720)
    )
    metadata = trace.metadata
    assert (metadata.tracker, metadata.device, metadata.dataset) == ("kcf", "Orin", "field")
    assert metadata.image_size("flight") == (1280, 720)
    assert (summary.tracker, summary.dataset, summary.median_ms) == ("kcf", "field", 40)
    assert metadata.profiled
    assert np.isnan(trace["flight"].score).all()
