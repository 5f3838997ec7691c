"""``lae-sim profile`` and ``lae-sim fidelity`` as a user runs them."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import bright_frame
from places import REPOSITORY

from lae_sim.cli.main import main
from lae_sim.replay.world import replay_trace
from lae_sim.trace.file import read_trace, validate

TRACKERS = """
import os, subprocess, sys, time
import numpy as np
from lae_sim.trackers import stage


class Bright:
    \"\"\"Finds the bright target, where told to be slow slowly, and fails where told to.\"\"\"

    def __init__(self, ms=0.0, fail_at=-1, how="raise", reach=1000.0):
        self.ms, self.fail_at, self.how, self.reach = ms, fail_at, how, reach

    def describe(self):
        return {"name": "bright", "version": "1", "settings": {"reach": self.reach}}

    def init(self, frame, box):
        self.calls, self.box = 0, list(box)

    def track(self, frame):
        self.calls += 1
        if frame[0, 0, 0] == 99 and self.calls == self.fail_at:
            if self.how == "raise":
                raise ValueError("lost my mind")
            if self.how == "hang":
                time.sleep(60)
            if self.how == "exit":
                os._exit(3)
            if self.how == "wait":  # with a process of its own
                with open("child.new", "w") as file:
                    file.write(str(subprocess.Popen(["sleep", "1004"]).pid))
                os.rename("child.new", "child")
            while self.how == "wait" and not os.path.exists("go"):
                time.sleep(0.02)
            if self.how == "wait":
                return self.box, 0.5
            return {"nan": [float("nan")] * 4, "none": None}[self.how]
        time.sleep(self.ms / 1000)
        with stage("look"):
            rows, columns = np.nonzero(frame[:, :, 0] == 200)
        x, y = columns.min(), rows.min()
        if abs(x - self.box[0]) > self.reach:
            return None
        self.box = [x, y, 12, 10]
        return self.box, 0.5


class Searching(Bright):
    def set_search(self, cx, cy, w, h):
        self.box = [cx - 6, cy - 5, 12, 10]
"""


def make_dataset(root: Path, lengths: dict[str, int], step: float = 2.0) -> Path:
    """Folders of PNG images; those of ``bad`` carry a mark that the trackers look for."""
    for name, length in lengths.items():
        folder = root / name / "img"
        folder.mkdir(parents=True)
        boxes = []
        for i in range(length):
            x = 5 + step * i
            frame = bright_frame(x, 20, size=(160, 64))
            frame[0, 0] = 99 if name == "bad" else 0
            cv2.imwrite(str(folder / f"{i + 1:04}.png"), frame)
            boxes.append(f"{x:g},20,12,10")
        (root / name / "groundtruth_rect.txt").write_text("\n".join(boxes) + "\n")
    return root


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a dataset of three sequences and a module of trackers."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("mine", "truth"):  # of another test
        monkeypatch.delitem(sys.modules, module, raising=False)
    make_dataset(tmp_path / "data", {"a": 20, "bad": 24, "c": 16})
    (tmp_path / "mine.py").write_text(TRACKERS)
    return tmp_path


def start(here: Path, *arguments: str, **more: Any) -> subprocess.Popen:
    """``lae-sim profile`` as a process."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-m", "lae_sim", "profile", *arguments],
        cwd=here,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **more,
    )


def heed_signals() -> None:
    """In a child: not to ignore Ctrl-C or SIGHUP where the tests run in a shell's background."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def ran(command: str, *arguments: str, status: int = 0) -> tuple[str, str]:
    """What a command prints in this process; trackers have their own all the same."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        try:
            ended = main([command, *arguments])
        except SystemExit as end:  # of argparse
            ended = int(end.code or 0)
    said = out.getvalue(), err.getvalue()
    assert ended == status, said
    return said


def profile(*arguments: str, status: int = 0) -> tuple[str, str]:
    """What ``lae-sim profile`` prints."""
    return ran("profile", *arguments, status=status)


def waited_for(path: Path) -> Path:
    """A file, once it is there."""
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    return path


def has_ended(number: int) -> bool:
    """Whether a process ends within a minute."""
    deadline = time.monotonic() + 60
    while process_is_there(number) and time.monotonic() < deadline:
        time.sleep(0.01)
    return not process_is_there(number)


def process_is_there(number: int) -> bool:
    """Whether a process has not ended."""
    try:
        os.kill(number, 0)
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except ProcessLookupError:
        return False
    except FileNotFoundError:  # it has ended since, or there is no /proc
        return not Path("/proc/self").exists()
    return state != "Z"  # whose parent has not asked for it yet


MINE = ("--tracker", "mine:Bright", "--root", "data")


def test_a_profile_becomes_a_trace_with_its_provenance(here: Path) -> None:
    process = start(here, *MINE, "--option", "ms=1.5", "--out", "t.parquet", "--threads", "1")
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "lae-sim replay t.parquet" in out
    validate(here / "t.parquet")
    trace = read_trace(here / "t.parquet")
    recordings = {recording.name: recording for recording in trace}
    assert list(recordings) == ["a", "bad", "c"]
    for recording in recordings.values():
        np.testing.assert_array_equal(recording.boxes, recording.truth)
        assert (recording.elapsed_ns[1:] >= 1_500_000).all()
        assert np.isnan(recording.score[0])
        assert (recording.score[1:] == 0.5).all()
    document = trace.metadata.document
    assert document["schedule"] == {"kind": "every-frame"}
    assert document["tracker"]["settings"] == {"reach": 1000.0}
    assert document["timing"]["source"] == "measured"
    assert document["timing"]["warmup_calls"] == 5
    assert document["timing"]["threads"]
    assert document["sequences"]["c"]["order"] == 2
    assert document["sequences"]["c"]["image_size"] == [160, 64]
    assert {"before", "during", "after"} == set(document["device"]["readings"])
    assert document["lae_sim"]["version"]
    assert not list(here.glob("*unfinished*"))


def test_json_says_the_same(here: Path) -> None:
    passes = ("--stride", "2", "--stride", "3", "--closed-loop", "constant:0.5ms")
    passes += ("--closed-loop", "constant:0.5ms,init=1s")
    out, _ = profile(*MINE, "--sequence", "a", "--json", "--in-process", *passes)
    report = json.loads(out)
    assert [trace["trace"] for trace in report["traces"]] == [
        "mine-Bright-data.parquet",
        "mine-Bright-data.stride2.parquet",
        "mine-Bright-data.stride3.parquet",
        "mine-Bright-data.closed-loop-0.5ms.parquet",
        "mine-Bright-data.closed-loop-0.5ms-init-1000ms.parquet",
    ]
    stages = [set(read_trace(here / trace["trace"])["a"].stages) for trace in report["traces"]]
    assert stages == [{"look"}, {"look"}, {"look"}, set(), set()]  # of our own times
    slow = read_trace(here / report["traces"][-1]["trace"])["a"]
    assert slow.elapsed_ns[0] == 1_000_000_000
    assert report["traces"][-1]["timing"].startswith("constant 0.5ms, initialisation 1000 ms")
    assert report["traces"][0]["world_frames"] == report["traces"][0]["processed"] == 20
    assert report["failures"] == []


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("raise", "ValueError: lost my mind"),
        ("hang", "exceeded|longer|took"),
        ("exit", "exit|3"),
        ("nan", "nan"),
    ],
)
def test_a_failing_tracker_costs_its_sequence(here: Path, how: str, reason: str) -> None:
    options = ("--option", "fail_at=9", f"how={how}", "--frame-timeout", "600ms")
    out, err = profile(*MINE, *options, "--out", "t.parquet", "--json", status=1)
    (failure,) = json.loads(out)["failures"]
    assert failure["sequence"] == "bad"
    import re

    assert re.search(reason, failure["reason"])
    assert "bad" in err
    trace = read_trace(here / "t.parquet")
    assert [recording.name for recording in trace] == ["a", "c"]
    assert trace.metadata.document["failures"] == [failure]


def test_a_frame_without_an_answer_costs_that_frame(here: Path) -> None:
    out, _ = profile(*MINE, "--option", "fail_at=9", "how=none", "--out", "t.parquet", "--json")
    assert json.loads(out)["traces"][0]["lost"] == 1
    trace = read_trace(here / "t.parquet")
    bad = {recording.name: recording for recording in trace}["bad"]
    np.testing.assert_array_equal(bad.boxes[9], bad.boxes[8])
    assert trace.metadata.document["sequences"]["bad"]["lost"] == 1


def test_real_time_skips_frames_and_replays_to_the_bit(here: Path) -> None:
    options = ("--mode", "real-time", "--option", "ms=50", "--out", "t.parquet", "--warmup", "0")
    profile(*MINE, *options, "--sequence", "a")
    trace = read_trace(here / "t.parquet")
    assert trace.metadata.kind == "real-time"
    (run,) = replay_trace(trace)
    assert run.departures == 0
    assert len(run.schedule.frames) < 16
    np.testing.assert_array_equal(
        run.schedule.frames, np.flatnonzero(run.recording.elapsed_ns >= 0)
    )


def test_the_closed_loop_by_search_and_by_translation(here: Path) -> None:
    make_dataset(here / "fast", {"f": 28}, step=5)
    shared = ("--root", "fast", "--timing", "constant:100ms", "--option", "reach=9")
    lost = {}
    for name, options in {
        "plain": ("--tracker", "mine:Searching"),
        "native": ("--tracker", "mine:Searching", "--pre-forecaster", "truth:Path"),
        "translation": ("--tracker", "mine:Bright", "--pre-forecaster", "truth:Path"),
    }.items():
        (here / "truth.py").write_text(
            "class Path:\n"
            "    def __init__(self, box, image_size=None): pass\n"
            "    def update(self, frame, box): pass\n"
            "    def predict(self, frame): return [5 + 5 * frame, 20, 12, 10]\n"
        )
        out, _ = profile(*options, *shared, "--out", f"{name}.parquet", "--json")
        report = json.loads(out)["traces"][0]
        lost[name] = report["lost"]
        schedule = read_trace(here / f"{name}.parquet").metadata.document["schedule"]
        assert schedule.get("search") == (None if name == "plain" else name)
        assert report["timing"] == "constant 100ms, not measured"
    assert lost == {"plain": 9, "native": 0, "translation": 0}


def test_another_devices_trace_drives_the_schedule(here: Path) -> None:
    cold = ("--warmup", "0")
    profile(*MINE, "--option", "ms=70", "--sequence", "a", "--out", "slow.parquet", *cold)
    profile(*MINE, "--timing", "slow.parquet", "--sequence", "a", "--out", "t.parquet", *cold)
    (slow,), (run,) = (
        read_trace(here / "slow.parquet"),
        replay_trace(read_trace(here / "t.parquet")),
    )
    frames = run.schedule.frames
    assert len(frames) < 12
    np.testing.assert_array_equal(run.recording.elapsed_ns[frames], slow.elapsed_ns[frames])
    _, err = profile(*MINE, "--timing", "slow.parquet", status=1)
    assert "no times of sequence 'bad'" in err


WAITS = ("--option", "fail_at=1", "how=wait")  # in the second sequence, until told to go on
WAITING = (*MINE, *WAITS, "--out", "t.parquet", "--frame-timeout", "600s", "--warmup", "0")


def test_kill_and_resume(here: Path) -> None:
    options = WAITING
    process = start(here, *options)
    child = int(waited_for(here / "child").read_text())
    process.kill()
    process.communicate()
    assert has_ended(child)
    kept = here / "t.unfinished" / "first"
    assert [read_trace(path).names for path in kept.iterdir()] == [("a",)]
    assert not (here / "t.parquet").exists()
    (here / "go").touch()
    _, err = profile(*options, status=2)
    assert "--resume" in err
    _, err = profile(*options[:-1], "1", "--resume", status=2)
    assert "warmup" in err
    _, err = profile(*options, "--tracker", "mine:Searching", "--resume", status=2)
    assert "tracker 'mine:Bright', not 'mine:Searching'" in err
    profile(*options, "--resume")
    assert [recording.name for recording in read_trace(here / "t.parquet")] == ["a", "bad", "c"]
    for recording in read_trace(here / "t.parquet"):
        assert (recording.stages["look"][2:] > 0).all()
        assert (recording.stages["look"] < recording.elapsed_ns).all()
    assert not kept.parent.exists()
    assert not list(here.glob(".*"))  # what the killed one had locked
    _, err = profile(*options, "--resume")
    assert "complete" in err


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_ends_a_profile_keeps_what_is_complete(here: Path, end: signal.Signals) -> None:
    options = WAITING
    process = start(here, *options, start_new_session=True, preexec_fn=heed_signals)
    child = int(waited_for(here / "child").read_text())
    assert process_is_there(child)
    for more in ((), ("--resume",)):
        _, err = profile(*options, *more, status=2)
        assert f"another profile is at work there (process {process.pid} on " in err
    os.killpg(process.pid, end)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + end, err
    assert "Traceback" not in err
    assert "--resume" in err
    assert [recording.name for recording in read_trace(here / "t.parquet")] == ["a"]
    assert has_ended(child)
    if end == signal.SIGINT:
        (here / "go").touch()
        profile(*options, "--resume")
        assert [recording.name for recording in read_trace(here / "t.parquet")] == ["a", "bad", "c"]
        assert not list(here.glob(".*"))


def test_a_full_disk_is_an_error_and_leaves_no_trace(here: Path) -> None:
    def little_space() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    options = (*MINE, "--out", "t.parquet", "--in-process")
    process = start(here, *options, preexec_fn=little_space)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2, err
    assert "Traceback" not in err
    assert "cannot write" in err
    assert "File too large" in err
    assert "t.unfinished keeps what is complete: --resume goes on" in err
    assert not (here / "t.parquet").exists()
    assert not list(here.rglob("*.part*"))
    process = start(here, *options, "--resume")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert read_trace(here / "t.parquet").names == ("a", "bad", "c")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--tracker", "nothing"), "no tracker 'nothing'"),
        (("--tracker", "mine:Nothing"), "Nothing"),
        (("--tracker", "mine:Bright", "--option", "colour=red"), "colour.*takes ms, fail_at"),
        (("--tracker", "mine:Bright", "--option", "colour"), "not key=value"),
        (("--root", "nowhere"), "nowhere"),
        (("--root", "data", "--sequence", "d"), "'d'"),
        (("--dataset", "DTB70"), "--root"),
        ((*MINE, "--box", "1,2,3"), "not a box"),
        ((*MINE, "--mode", "every-frame", "--policy", "fifo"), "real-time"),
        ((*MINE, "--timing", "nothing.parquet"), "nothing.parquet"),
        ((*MINE, "--timing", "constant:47"), "unit"),
        ((*MINE, "--stride", "1"), "above 1"),
        ((*MINE, "--stride", "two"), "exact number"),
        ((*MINE, "--translate"), "pre_forecaster"),
        ((*MINE, "--pre-forecaster", "crystal-ball"), "crystal-ball"),
        ((*MINE, "--out", "trace.txt"), "parquet"),
        ((*MINE, "--out", "no/folder/t.parquet"), "no/folder"),
        ((*MINE, "--python", "/nowhere/python"), "/nowhere/python"),
    ],
)
def test_bad_input_is_one_clear_error(here: Path, arguments: tuple[str, ...], message: str) -> None:
    import re

    _, err = profile(*arguments, status=2)
    assert re.search(message, err.replace("\n", " ")), err
    assert not list(here.glob("*.parquet"))
    assert not list(here.glob("*.unfinished"))


def test_an_unreadable_image_costs_its_sequence(here: Path) -> None:
    (here / "data" / "bad" / "img" / "0012.png").write_bytes(b"not an image")
    out, err = profile(*MINE, "--json", status=1)
    (failure,) = json.loads(out)["failures"]
    assert "0012.png" in failure["reason"]
    assert "'bad', frame 11" in err


def test_fidelity_measures_replays_against_the_closed_loop(here: Path) -> None:
    make_dataset(here / "fast", {"f": 40, "g": 30}, step=3)
    options = (
        "--tracker",
        "mine:Bright",
        "--root",
        "fast",
        "--option",
        "reach=8",
        "--out",
        "t.parquet",
    )
    loops = (
        "--stride",
        "2",
        "3",
        "--closed-loop",
        "constant:20ms",
        "constant:47ms",
        "constant:100ms",
    )
    out, _ = profile(*options, *loops)
    command = next(line for line in out.splitlines() if "lae-sim fidelity" in line)
    arguments = command.split()[2:]
    out, _ = ran("fidelity", *arguments, "--json", "--forecaster", "hold", "kalman")
    rows = {
        (row["closed_loop"], row["replay"]): row
        for row in json.loads(out)["summary"]
        if row["forecaster"] == "hold"
    }
    assert len(rows) == 9
    # at 20 ms nothing is skipped, and every third frame is a pass of its own
    for replay in ("every-frame", "strided", "modelled"):
        assert rows["t.closed-loop-20ms.parquet", replay]["max_abs_d_auc"] == 0
    assert rows["t.closed-loop-100ms.parquet", "strided"]["max_abs_d_auc"] == 0
    # a target that goes 9 pixels in three frames is lost by a tracker that reaches 8
    assert rows["t.closed-loop-100ms.parquet", "every-frame"]["mean_abs_d_dp20"] > 0.2
    out, _ = ran("fidelity", *arguments, "--per-sequence")
    assert "strided" in out
    assert out.splitlines()[-1].startswith("Modelled replays of bright are within 0.")
    passes = ("--strided", "t.stride2.parquet", "t.stride3.parquet")
    slow = ("--latency", "constant:47ms", "--json", "--per-sequence")
    out, _ = ran("replay", "t.parquet", *passes, *slow)
    (report,) = json.loads(out)["traces"]
    assert report["strided"] == list(passes[1:])
    # steps of 1 and 2 by turns are nearest to every frame, and the tracker answers alike
    for row in report["results"][0]["per_sequence"]:
        assert row["disagreement"] == 0 < row["approximate_outputs"]
    assert not report["exact"]
    profile(*options[:-1], "u.parquet", "--option", "reach=9")
    _, err = ran("fidelity", "u.parquet", *arguments[1:], status=2)
    assert "same tracker" in err
    _, err = ran("fidelity", "t.parquet", "--closed-loop", "t.parquet", status=2)
    assert "no closed loop" in err


def test_a_gap_pass_goes_beside_the_other_passes(here: Path) -> None:
    make_dataset(here / "fast", {"a": 40, "c": 40}, step=3)
    mine = ("--tracker", "mine:Bright", "--root", "fast", "--option", "reach=8")
    passes = ("--stride", "2", "--gaps", "--closed-loop", "constant:47ms")
    out, _ = profile(*mine, *passes, "--out", "t.parquet")
    strided = "--strided t.stride2.parquet t.gaps.parquet"
    replay = f"lae-sim replay t.parquet {strided}"
    fidelity = f"lae-sim fidelity t.parquet {strided} --closed-loop t.closed-loop-47ms.parquet"
    assert f"{replay}\n" in out
    assert f"{fidelity}\n" in out
    assert "lae-sim show t.gaps.parquet --plot reach.png" in out
    validate(here / "t.gaps.parquet")
    restart = read_trace(here / "t.gaps.parquet")["a@0+3"]
    assert restart.elapsed_ns[3] >= restart.stages["look"][3] > 0
    assert ((restart.stages["look"] >= 0) == (restart.elapsed_ns >= 0))[1:].all()

    slow = ("--latency", "constant:47ms", "--json")
    with_gaps, _ = ran(*replay.split()[1:], *slow)
    without, _ = ran(*replay.split()[1:-1], *slow)
    both = [json.loads(text)["traces"][0]["results"] for text in (with_gaps, without)]
    assert [row["auc"] for row in both[0]] == [row["auc"] for row in both[1]]
    ran(*replay.split()[1:], "--sequence", "a")
    ran("replay", "t.parquet", "--strided", "t.gaps.parquet", *slow)
    rows, _ = ran(*fidelity.split()[1:], "--json")
    assert {row["replay"] for row in json.loads(rows)["summary"]} >= {"every-frame", "strided"}

    for command in ("replay", "compare"):
        _, err = ran(command, "t.gaps.parquet", status=2)
        assert err.count("\n") == 1
        assert "a gap pass" in err
        assert "--strided" in err
    for option, pass_, message in (
        ("--timing", "t.gaps.parquet", "a gap pass has no times"),
        ("--strided", "t.closed-loop-47ms.parquet", "a real-time trace is no pass"),
    ):
        _, err = ran("replay", "t.parquet", option, pass_, status=2)
        assert message in err

    said, _ = ran("show", "t.gaps.parquet")
    assert "reach        centre" in said
    # it looks 8 pixels around, and 3 a frame are 9 at the third
    assert "found up to gap" not in said
    assert "lost from gap 3 on" in said
    shown, _ = ran("show", "t.gaps.parquet", "t.parquet", "--json")
    gaps, every = json.loads(shown)["traces"]
    side = 22.0  # of 12 x 10 pixels
    assert gaps["reach"]["centre"] == pytest.approx(8 / side, abs=0.1)
    assert "reach" not in every
    ran("show", "t.gaps.parquet", "--plot", "reach.png")
    assert (here / "reach.png").stat().st_size > 10_000
    _, err = ran("show", "t.gaps.parquet", "t.parquet", "--plot", "x.png", status=2)
    assert "one by one" in err


def test_where_only_restarts_are_left_they_are_what_comes_next(here: Path) -> None:
    bad = ("--option", "fail_at=20", "--sequence", "bad", "--out", "t.parquet")  # of 23 calls
    out, _ = profile(*MINE, *bad, "--gaps", status=1)
    assert not (here / "t.parquet").exists()
    assert out.partition("next:\n")[2] == "  lae-sim show t.gaps.parquet --plot reach.png\n"


def test_a_tracker_that_declares_no_search_region(here: Path) -> None:
    text = TRACKERS.replace('"version": "1",', '"version": "1", "search": {"half_side": "big"},')
    (here / "mine.py").write_text(text)
    _, err = profile(*MINE, status=2)
    assert "mine:Bright: what describe() says does not fit a trace" in err
    assert "tracker.search.half_side" in err
    assert "such as 1.0" in err
