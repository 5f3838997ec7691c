"""Profiles of frames that arrive at times of their own: the trace keeps them, a replay repeats."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import FakeTimed, bright_frame, bright_sequence
from hypothesis import given
from hypothesis import strategies as st

import lae_sim
from lae_sim.cli import convert, profile, replay, show, study
from lae_sim.datasets.frames import Dataset
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, fifo, latest, shrinking_tail
from lae_sim.engine.scheduler import Policy
from lae_sim.errors import LaeError
from lae_sim.forecast.kalman import Kalman
from lae_sim.profile.gaps import Gaps, Start
from lae_sim.profile.live import run_every_frame, run_real_time
from lae_sim.profile.passes import parse_timing
from lae_sim.replay.world import replay_trace
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.restarts import RestartName

cv2 = pytest.importorskip("cv2", reason="frames are decoded with OpenCV")

CLOCK = Clock.at(Fraction(30))
POLICIES = {"latest": latest, "fifo": fifo, "every:2": every(2),
            "shrinking-tail:47ms": shrinking_tail("47ms")}  # fmt: skip
PATH = [(5.0 + 2 * i, 8.0 + i) for i in range(16)]
NUMBERS = [1, 2, 3, 4, 5, 7, 9, 11, 13, 15]
AT = [round(Fraction((n - 1) * 10**9, 30)) for n in NUMBERS]


@given(
    st.lists(st.integers(1_000_000, 90_000_000), min_size=1, max_size=15),
    st.lists(st.integers(1_000_000, 120_000_000), min_size=1, max_size=5),
    st.sampled_from(sorted(POLICIES)),
)
def test_a_replay_of_a_profile_is_the_profile(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int], times: list[int], name: str
) -> None:
    arrival_ns = np.cumsum([0, *steps])
    sequence = replace(bright_sequence(PATH[: len(arrival_ns)]), arrival_ns=arrival_ns)
    policy: Policy = POLICIES[name]
    run = run_real_time(sequence, FakeTimed(times), CLOCK, policy)
    path = tmp_path_factory.mktemp("t") / "t.parquet"
    metadata = Metadata.new("30", "real-time", timing={"clock": "made up"})
    write_trace(Trace(metadata, [run.recording]), path)
    (found,) = replay_trace(read_trace(path), policy=policy)
    assert found.departures == 0
    assert found.recording.arrival_ns is not None
    assert found.recording.arrival_ns.tolist() == arrival_ns.tolist()
    assert found.schedule.frames.tolist() == run.frames.tolist()
    assert found.schedule.elapsed_ns.tolist() == run.recording.elapsed_ns[run.frames].tolist()
    assert found.boxes.tolist() == run.recording.boxes[run.frames].tolist()


def test_a_pre_forecaster_is_given_arrival_times() -> None:
    seen: list[tuple[float, int]] = []

    class Mine(Kalman):
        def predict(self, frame: int) -> Sequence[float]:
            seen.append((frame, index(frame)))
            return super().predict(frame)

    arrivals = np.arange(10) * 40_000_000
    arrivals[5:] += 40_000_000  # one was dropped
    sequence = replace(bright_sequence(PATH[:10]), arrival_ns=arrivals)
    for clock in (Clock.at(Fraction(25)),):
        run_every_frame(sequence, FakeTimed(), pre_forecaster=Mine, clock=clock)
        run_real_time(sequence, FakeTimed(), clock, pre_forecaster=Mine)
    assert seen == 2 * [(float(i + (i >= 5)), i) for i in range(1, 10)]


def test_a_restart_has_the_arrivals_of_its_frames() -> None:
    arrivals = np.array(AT)
    sequence = replace(bright_sequence(PATH[:10]), arrival_ns=arrivals)
    data = Dataset("d", Fraction(30), [sequence])
    gaps = Gaps(data, {"tracker": FakeTimed()}, 10**9, None, lambda text: None)
    start = Start(RestartName("bright", 4, 3), (0, 3))
    live = gaps._live(start, sequence, sequence.read)
    for frame in start.frames:
        live(frame)
    found = live.result(np.array(start.frames)).recording.arrival_ns
    assert found is not None
    assert found.tolist() == (arrivals[4:8] - arrivals[4]).tolist()


def test_other_devices_times_of_other_arrivals_are_refused(tmp_path: Path) -> None:
    sequence = replace(bright_sequence(PATH[:10]), arrival_ns=np.array(AT))
    run = run_every_frame(sequence, FakeTimed())
    metadata = Metadata.new("30", "every-frame", timing={"clock": "made up"})
    write_trace(Trace(metadata, [run.recording]), tmp_path / "t.parquet")
    _, timing = parse_timing(str(tmp_path / "t.parquet"))
    assert timing(sequence)(3) == 1_000_000
    for other in (None, np.array([*AT[:-1], AT[-1] + 1])):
        with pytest.raises(LaeError, match="arrived at other times than they do here"):
            timing(replace(sequence, arrival_ns=other))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose camera dropped frames, and one whose camera dropped none."""
    root = tmp_path_factory.mktemp("data") / "dropped"
    for name, numbers in (("ball", NUMBERS), ("whole", list(range(1, 11)))):
        (root / name / "img").mkdir(parents=True)
        boxes = []
        for number in numbers:
            x, y = 10 + 3 * number, 20 + number
            cv2.imwrite(str(root / name / "img" / f"{number:05d}.png"), bright_frame(x, y))
            boxes.append(f"{x},{y},12,10\n")
        (root / name / "groundtruth_rect.txt").write_text("".join(boxes))
    return root


def profiled(ball: Path, out: Path, *options: str) -> Trace:
    quick = ["--in-process", "--warmup", "0", "--out", str(out)]
    assert profile.main(["--root", str(ball), *quick, *options]) == 0
    return read_trace(out)


def test_dropped_frames_are_a_question(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        profile.main(["--root", str(ball), "--in-process", "--out", str(tmp_path / "t.parquet")])
        == 2
    )
    said = capsys.readouterr().err
    assert "sequence 'ball': no image number 6, 8, 10, ...: did" in said
    assert "--frame-times numbers" in said
    assert list(tmp_path.iterdir()) == []


def test_frames_are_placed_at_their_own_times_or_evenly(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--frame-times", "numbers", "--stride", "2", "--closed-loop", "constant:47ms"]
    trace = profiled(ball, tmp_path / "n.parquet", *options)
    assert "image numbers are missing in ball: each image comes at the" in capsys.readouterr().err
    assert trace.metadata.document["dataset"] == {"name": "dropped", "frame_times": "numbers"}
    ends = {"": AT, ".stride2": AT, ".closed-loop-47ms": AT}
    for name, expected in ends.items():
        found = read_trace(tmp_path / f"n{name}.parquet")["ball"].arrival_ns
        assert found is not None
        assert found.tolist() == expected
    run = next(iter(replay_trace(trace, latency="constant:47ms")))
    numbers = [NUMBERS[frame] for frame in run.schedule.frames]
    assert numbers == [1, 2, 3, 5, 7, 9, 11, 13, 15]  # after 5 there is time for each
    closed = read_trace(tmp_path / "n.closed-loop-47ms.parquet")["ball"]
    assert np.flatnonzero(closed.elapsed_ns >= 0).tolist() == run.schedule.frames.tolist()

    even = profiled(ball, tmp_path / "e.parquet", "--frame-times", "even")
    assert "the images come evenly" in capsys.readouterr().err
    assert not even.has_arrivals
    assert even.metadata.document["dataset"]["frame_times"] == "even"
    run = next(iter(replay_trace(even, latency="constant:47ms")))
    assert run.schedule.frames.tolist() == [0, 1, 2, 4, 5, 7, 8, 9]


def test_outputs_say_when_frames_came(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "n.parquet"
    profiled(ball, path, "--frame-times", "numbers")
    capsys.readouterr()
    options = [str(path), "--latency", "constant:47ms"]

    def reported(*more: str) -> Any:
        assert replay.main([*options, *more, "--json"]) == 0
        return json.loads(capsys.readouterr().out)["traces"][0]

    recorded, forgotten = reported(), reported("--forget-arrivals")
    assert (recorded["arrivals"], forgotten["arrivals"]) == ("recorded", "forgotten")
    assert any("frames arrive when the trace says" in note for note in recorded["notes"])
    assert any("arrival times are forgotten" in note for note in forgotten["notes"])
    assert recorded["processed"] > forgotten["processed"]
    assert recorded["results"][0]["age_ms"] != forgotten["results"][0]["age_ms"]
    assert replay.main([*options, "--fps", "15"]) == 2
    assert "for 15 frames/s forget the arrivals" in capsys.readouterr().err
    assert reported("--forget-arrivals", "--fps", "15")["processed"] == 20
    assert lae_sim.evaluate(path, fps=15, forget_arrivals=True).notes

    text = f'traces = "{path.as_posix()}"\nforecasters = "hold"\n'
    (tmp_path / "s.toml").write_text(text + "fps = [30, 60]\n")
    quick = ["--workers", "1", "--no-report", "--out", str(tmp_path / "results")]
    assert study.main([str(tmp_path / "s.toml"), *quick]) == 2
    assert "fps: " in (said := capsys.readouterr().err)
    assert "forget_arrivals = true" in said
    (tmp_path / "s.toml").write_text(text + "fps = [30, 60]\nforget_arrivals = true\n")
    assert study.main([str(tmp_path / "s.toml"), *quick, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["summary"]
    assert [row["fps"] for row in rows] == ["30", "60"]


def test_show_says_that_frames_came_at_times_of_their_own(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "n.parquet"
    profiled(ball, path, "--frame-times", "numbers")
    capsys.readouterr()
    assert show.main([str(path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "arriving at times of their own, up to 66.7 ms apart" in said


def test_a_study_counts_ages_by_arrivals(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "n.parquet"
    profiled(ball, path, "--frame-times", "numbers")
    text = f'traces = "{path.as_posix()}"\nforecasters = "hold"\nlatencies = "constant:47ms"\n'
    (tmp_path / "s.toml").write_text(text)
    capsys.readouterr()
    quick = ["--workers", "1", "--no-report", "--out", str(tmp_path / "results"), "--json"]
    assert study.main([str(tmp_path / "s.toml"), *quick]) == 0
    (row,) = json.loads(capsys.readouterr().out)["summary"]
    assert replay.main([str(path), "--latency", "constant:47ms", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["traces"][0]["results"][0]
    for key in ("age_ms", "longest_stale_ms"):
        assert row[key] == pytest.approx(result[key], rel=1e-12)
    assert row["engine"] == "simpy"


def test_conversions_ask_too_where_images_are_at_hand(
    ball: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "kcf"
    results.mkdir()
    for name in ("ball", "whole"):
        rows = (ball / name / "groundtruth_rect.txt").read_text()
        (results / f"{name}.txt").write_text(rows)
    out = tmp_path / "t.parquet"
    command = [str(results), "--truth", str(ball), "--time", "constant:47ms", "--out", str(out)]
    assert convert.main(command) == 2
    assert "no image number 6, 8, 10, ..." in capsys.readouterr().err
    assert not out.exists()
    assert convert.main([*command, "--frame-times", "numbers"]) == 0
    assert "Image numbers are missing in ball: each image comes" in capsys.readouterr().out
    trace = read_trace(out)
    assert trace["ball"].arrival_ns is not None
    assert trace["ball"].arrival_ns.tolist() == AT
    assert trace["whole"].arrival_ns is not None
    assert convert.main([*command, "--frame-times", "even", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["frame_times"], summary["numbers_missing"]) == ("even", ["ball"])
    assert not read_trace(out).has_arrivals
    assert convert.main([*command, "--sequence", "whole", "--frame-times", "numbers"]) == 0
    assert not read_trace(out).has_arrivals  # nothing is missing there
