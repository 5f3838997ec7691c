"""Trackers in worker processes: what they may do without harm, and that the stopwatch is right."""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from misbehaving import ANSWERS, BOX
from places import REPOSITORY

import lae_sim.profile.worker
from lae_sim.errors import LaeError
from lae_sim.profile.timed import TimedTracker, TrackerError
from lae_sim.profile.worker import InProcess, Worker

TRACKERS = sorted((REPOSITORY / "lae_sim" / "trackers").glob("*.py"))
FRAME = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
GOOD = {
    **dict.fromkeys(["box", "integers", "array", "score none"], (BOX, None)),
    **dict.fromkeys(["tuple", "list", "scalars", "integer array"], (BOX, 0.5)),
    **dict.fromkeys(["score nan", "score infinite", "score text", "score array"], (BOX, None)),
    "score that is no number": (BOX, None),
    "none": (None, None),
    "none with a score": (None, 0.5),
}


@pytest.fixture(autouse=True)
def in_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """The worker finds ``misbehaving`` in its current folder."""
    monkeypatch.chdir(REPOSITORY / "tests")


@pytest.fixture
def start() -> Iterator[Callable[..., Worker]]:
    """Start workers that end with the test."""
    workers = []

    def start(tracker: str = "misbehaving:Tracker", timeout: float = 5, **options: Any) -> Worker:
        workers.append(Worker(tracker, options, timeout=timeout, setup_timeout=30))
        return workers[-1]

    yield start
    for worker in workers:
        worker.close()


def in_process(tracker: str = "misbehaving:Tracker", **options: Any) -> InProcess:
    return InProcess(tracker, options)


@pytest.fixture(params=["worker", "in process"])
def make(request: pytest.FixtureRequest, start: Any) -> Callable[..., TimedTracker]:
    """Make a tracker either way."""
    return start if request.param == "worker" else in_process


def pid(worker: Worker) -> int:
    assert worker._process
    return worker._process.pid


def alive(process: int) -> bool:
    """Whether a process is there, zombies too."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def gone(process: int, within: float = 60) -> bool:
    """Whether a process ends (for those that are not ours to wait for, a zombie has ended)."""
    end = time.monotonic() + within
    while time.monotonic() < end:
        try:
            if Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.02)
    return False


def children_that_sleep(seconds: str) -> list[int]:
    """Processes of the command ``sleep`` with this argument."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes() == f"sleep\0{seconds}\0".encode():
                found.append(int(path.parent.name))
        except OSError:
            pass
    return [process for process in found if not gone(process, 0.2)]


# answers ------------------------------------------------------------------------------------------


def test_init_answers_with_the_given_box(make: Callable[..., TimedTracker]) -> None:
    tracker = make()
    answer = tracker.init(FRAME, np.array([0.1, 2, 3, 4], np.float64))
    assert answer.box == (0.1, 2, 3, 4)
    assert answer.score is None
    assert answer.elapsed_ns > 0
    assert not tracker.sets_search
    tracker.close()


@pytest.mark.parametrize("answer", sorted(ANSWERS))
def test_an_answer_is_a_box_or_a_failure_that_names_it(answer: str) -> None:
    with in_process(answer=answer) as tracker:
        tracker.init(FRAME, BOX)
        if answer in GOOD:
            found = tracker.track(FRAME)
            assert (found.box, found.score) == GOOD[answer]
            assert all(type(v) is float for v in found.box or ())
        else:
            wrong = "track: (answered .*, (not a box of four|which no float32 holds)|.*no number)"
            with pytest.raises(TrackerError, match=wrong) as e:
                tracker.track(FRAME)
            assert len(str(e.value)) < 200


@pytest.mark.parametrize(
    "answer", ["scalars", "none with a score", "frame", "score of 400 digits", "own float"]
)
def test_answers_are_the_same_from_a_process(start: Any, answer: str) -> None:
    worker = start(answer=answer)
    worker.init(FRAME, BOX)
    if answer in GOOD:
        found = worker.track(FRAME)
        assert (found.box, found.score) == GOOD[answer]
    else:
        before = pid(worker)
        wrong = "not a box of four finite numbers|100000.*no float32|RuntimeError: no number"
        with pytest.raises(TrackerError, match=wrong) as raised:
            worker.track(FRAME)
        assert ("box_of makes one of a mask" in str(raised.value)) == (answer == "frame")
        assert pid(worker) == before


# frames -------------------------------------------------------------------------------------------


def test_frames_of_any_size_arrive_whole_and_are_the_trackers_own(
    make: Callable[..., TimedTracker],
) -> None:
    tracker = make("misbehaving:Frames")
    tracker.init(FRAME, BOX)
    rng = np.random.default_rng(0)
    for h, w in [(48, 64), (480, 640), (1, 1), (1080, 1920), (480, 640)]:
        frame = rng.integers(0, 256, (h, w, 3), dtype=np.uint8)
        kept = frame.copy()
        assert tracker.track(frame).box == (h, w, frame[0, 0, 0], frame[-1, -1, -1])
        assert np.array_equal(frame, kept)
        assert tracker.track(frame[:, ::-1]).box == (h, w, frame[0, -1, 0], frame[-1, 0, -1])
    frame.setflags(write=False)
    assert tracker.track(frame).box
    tracker.close()


@pytest.mark.parametrize(
    "frame", [FRAME[..., 0], FRAME[..., :2], FRAME.astype(np.int16), FRAME[:0]], ids=range(4)
)
def test_what_is_no_frame_is_refused(make: Callable[..., TimedTracker], frame: Any) -> None:
    tracker = make()
    with pytest.raises(LaeError, match="a frame must be uint8"):
        tracker.init(frame, BOX)
    with pytest.raises(LaeError, match="four finite numbers"):
        tracker.init(FRAME, (1, 2, float("nan"), 4))
    assert tracker.init(FRAME, BOX).box == BOX
    tracker.close()


# the stopwatch ------------------------------------------------------------------------------------


def test_the_stopwatch_measures_the_call_and_the_device(
    make: Callable[..., TimedTracker],
) -> None:
    tracker = make("misbehaving:Clockwork", wait_s=0.08, work_s=0.04)
    assert tracker.sets_search
    tracker.init(FRAME, BOX)
    answer = tracker.track(FRAME, search=(1, 2, 3.5, 4))
    # 80 ms asleep, 40 ms at work, 10 ms in the second sync; not set_search's 50 ms
    assert answer.elapsed_ns >= 0.13e9
    assert 0.04e9 <= answer.cpu_ns <= answer.elapsed_ns - 0.08e9
    calls = ["sync", ["init", list(BOX)], "sync", [1, 2, 3.5, 4], "sync", "track", "sync"]
    found = tracker.describe()
    assert found["calls"] == calls
    assert found["synchronised"] is True
    tracker.close()


def test_set_search_and_the_first_sync_are_not_measured(start: Any) -> None:
    worker = start("misbehaving:Clockwork")
    worker.init(FRAME, BOX)
    times = [worker.track(FRAME, search=BOX).elapsed_ns for _ in range(5)]
    assert 10e6 <= min(times) < 20e6  # sync takes 10 ms, set_search 50 ms


def test_stages_that_a_tracker_marks_are_parts_of_its_time(
    make: Callable[..., TimedTracker],
) -> None:
    tracker = make("misbehaving:Staged")
    assert tracker.init(FRAME, BOX).stages == {}
    for _ in range(2):  # in which nothing is left of the call before
        answer = tracker.track(FRAME)
        assert answer.stages.keys() == {"preprocess", "inference"}
        assert 0.01e9 <= answer.stages["preprocess"] < answer.elapsed_ns - 0.02e9
        assert answer.stages["inference"] >= 0.02e9
        assert sum(answer.stages.values()) <= answer.elapsed_ns
    with pytest.raises(TrackerError, match="lost my mind"):
        tracker.track(FRAME)
    assert tracker.init(FRAME, BOX).stages == {}
    assert tracker.track(FRAME).stages["inference"] >= 0.02e9
    tracker.close()


def test_a_stage_that_no_trace_can_name_is_an_error(make: Callable[..., TimedTracker]) -> None:
    tracker = make("misbehaving:Misnamed")
    tracker.init(FRAME, BOX)
    with pytest.raises(TrackerError, match="'Pre-process' is no name of a stage: small letters"):
        tracker.track(FRAME)
    tracker.close()


def test_stages_without_number_are_an_error(make: Callable[..., TimedTracker]) -> None:
    tracker = make("misbehaving:Numbered")
    tracker.init(FRAME, BOX)
    with pytest.raises(TrackerError, match="more than 100 stages, such as 'frame_0'"):
        tracker.track(FRAME)
    tracker.close()


def test_a_tracker_without_set_search_cannot_be_told(make: Callable[..., TimedTracker]) -> None:
    tracker = make()
    tracker.init(FRAME, BOX)
    with pytest.raises(TrackerError, match="no set_search"):
        tracker.track(FRAME, search=BOX)
    tracker.close()


# failures -----------------------------------------------------------------------------------------

ENDS = {
    "crash": r"was ended by SIGSEGV: File .*ctypes",
    "crash_with_a_fork": "was ended by SIGSEGV",
    "leave": "exited with status 3: a last word$",
    "hang_in_c": r"exceeded 0\.4 s$",
    "hang_with_a_child": r"exceeded 0\.4 s$",
}


@LINUX
@pytest.mark.parametrize("end", ENDS)
def test_a_process_that_ends_or_hangs_is_replaced(start: Any, end: str) -> None:
    worker = start(track=end, timeout=0.4)
    worker.init(FRAME, BOX)
    first, began = pid(worker), time.monotonic()
    with pytest.raises(TrackerError, match=f"misbehaving:Tracker: track:? .*{ENDS[end]}"):
        worker.track(FRAME)
    assert time.monotonic() - began < 3
    assert not alive(first)
    assert not children_that_sleep("1001")
    with pytest.raises(TrackerError, match="initialised first"):
        worker.track(FRAME)
    assert worker.init(FRAME, BOX).box == BOX
    assert pid(worker) != first


@pytest.mark.parametrize("end", ["crash", "hang_in_c"])
def test_init_may_crash_or_hang(start: Any, end: str) -> None:
    worker = start(init=end, timeout=0.4)
    for _ in range(2):
        with pytest.raises(TrackerError, match=f"init:? .*{ENDS[end]}"):
            worker.init(FRAME, BOX)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("fail", r"track: ValueError: no target here \(.*misbehaving\.py, line \d+\)$"),
        ("leave_politely", r"track: SystemExit: usage: tracker \(.*misbehaving\.py, line \d+\)$"),
        ("fail_mutely", r"track: MuteError \(.*misbehaving\.py, line \d+\)$"),
        ("run_out_of_memory", r"track: out of memory: \w*MemoryError: Unable to allocate .* \("),
    ],
)
def test_an_exception_says_where_and_the_next_init_works(
    make: Callable[..., TimedTracker], what: str, message: str
) -> None:
    tracker = make(track=what)
    process = pid(tracker) if isinstance(tracker, Worker) else 0
    with pytest.raises(TrackerError, match="initialised first"):
        tracker.track(FRAME)
    tracker.init(FRAME, BOX)
    with pytest.raises(TrackerError, match=message):
        tracker.track(FRAME)
    with pytest.raises(TrackerError, match="initialised first"):
        tracker.track(FRAME)
    assert tracker.init(FRAME, BOX).box == BOX
    if isinstance(tracker, Worker):
        assert pid(tracker) == process
    tracker.close()


def test_a_tracker_may_raise_what_ends_programs(start: Any) -> None:
    worker = start(track="interrupt")
    worker.init(FRAME, BOX)
    process = pid(worker)
    with pytest.raises(TrackerError, match=r"track: KeyboardInterrupt: my own \(.*misbehaving"):
        worker.track(FRAME)
    assert pid(worker) == process


def test_a_process_that_died_between_sequences_is_replaced(start: Any) -> None:
    worker = start()
    worker.init(FRAME, BOX)
    os.kill(pid(worker), signal.SIGKILL)
    time.sleep(0.1)
    assert worker.init(FRAME, BOX).box == BOX
    os.kill(pid(worker), signal.SIGKILL)
    with pytest.raises(TrackerError, match=r"ended by SIGKILL \(out of memory\?\)"):
        worker.track(FRAME)
    assert worker.describe()["python"]


# what cannot be started ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tracker", "options", "message"),
    [
        ("nonsense", {}, "no tracker 'nonsense': there are dcf"),
        ("misbehaving:Nothing", {}, "no attribute 'Nothing'"),
        ("no_such_module:Tracker", {}, "No module named 'no_such_module'"),
        ("misbehaving:Tracker", {"size": 3}, "it takes making, init, track, answer"),
        ("misbehaving:Tracker", {"making": "leave_politely"}, "SystemExit: usage"),
    ],
)
def test_a_tracker_that_cannot_be_made_says_why(
    tracker: str, options: dict[str, Any], message: str
) -> None:
    for kind in (Worker, InProcess) if options else (InProcess,):
        with pytest.raises(LaeError, match=message) as found:
            kind(tracker, options)
        assert not isinstance(found.value, TrackerError)


@pytest.mark.parametrize("making", ["crash", "hang_in_c"])
def test_making_a_tracker_may_crash_or_hang(making: str) -> None:
    began = time.monotonic()
    message = ENDS[making].replace(r"0\.4", "1")
    with pytest.raises(LaeError, match=f"setup:? .*{message}") as found:
        Worker("misbehaving:Tracker", {"making": making}, setup_timeout=1)
    assert not isinstance(found.value, TrackerError)
    assert time.monotonic() - began < 5


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (None, "does not start: No such file"),
        ("", "does not start: Exec format error"),
        ("#!/bin/sh\nexit 0", "exited with status 0"),
        ("#!/bin/sh\necho not a Python >&2; exit 2", "exited with status 2: not a Python"),
        ("#!/bin/sh\nexec sleep 1002", r"setup exceeded 0\.5 s .* must be Python 3\.8 or newer"),
    ],
)
def test_what_is_not_a_python_is_refused(tmp_path: Path, script: str | None, message: str) -> None:
    python = tmp_path / "python"
    if script is not None:
        python.write_text(script)
        python.chmod(0o755)
    with pytest.raises(LaeError, match=message):
        Worker("misbehaving:Tracker", {}, python=str(python), setup_timeout=0.5)


def wrapped(folder: Path, options: str) -> str:
    """This interpreter, always run with some options."""
    python = folder / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" {options} "$@"\n')
    python.chmod(0o755)
    return str(python)


def test_an_interpreter_without_numpy_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"No module named 'numpy'; it must be Python 3\.8"):
        Worker("misbehaving:Tracker", {}, python=wrapped(tmp_path, "-I -S"))


def test_the_process_needs_numpy_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "packages"
    folder.mkdir()
    for package in Path(np.__file__).parent.parent.glob("numpy*"):
        (folder / package.name).symlink_to(package)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    with Worker("misbehaving:Clockwork", {}, python=wrapped(tmp_path, "-S")) as worker:
        worker.init(FRAME, BOX)
        assert worker.track(FRAME).box == BOX
        found = worker.describe()
    assert not {"lazy_loader", "pyarrow", "simpy"} & set(found["modules"])
    assert found["path"] == [str(REPOSITORY / "tests"), str(folder)]


@pytest.mark.parametrize("path", TRACKERS, ids=lambda path: path.stem)
def test_the_trackers_side_is_python_3_8_and_stands_alone(path: Path) -> None:
    code = ast.parse(path.read_text(), feature_version=(3, 8))
    assert ast.get_docstring(code)
    for node in ast.walk(code):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            if name.startswith("numpy.typing"):
                assert node.col_offset, "NumPy before 1.20 has none: import it for type checks only"
            if name.split(".")[0] == "lae_sim":
                assert name.startswith(
                    ("lae_sim.errors.", "lae_sim.plugins.", "lae_sim.trackers.")
                ), name


# output, processes, files -------------------------------------------------------------------------


def test_what_a_tracker_prints_is_shown_and_breaks_nothing(
    start: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    worker = start(track="print_much")
    worker.init(FRAME, BOX)
    for _ in range(2):
        assert worker.track(FRAME).box == BOX
        out, err = capfd.readouterr()
        assert not out
        for said in ('{"answer": {"box": null}}', "written to 1", "put by C", "x" * 1_000_000):
            assert f"{said}\n" in err
    worker.close()
    assert "closed\n" in capfd.readouterr().err


@LINUX
def test_nothing_is_left_behind(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(lae_sim.profile.worker, "CLOSE_S", 0.5)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    frame = np.zeros((47, 61, 3), np.uint8)  # of a size by which shared memory is known for ours

    def ours(path: Path) -> bool:
        with contextlib.suppress(FileNotFoundError):  # others come and go beside this test
            return path.stat().st_size == frame.nbytes
        return False

    def found() -> set[str]:
        descriptors = Path("/proc/self/fd")
        return {
            *(f"{fd.name} {os.readlink(fd)}" for fd in descriptors.iterdir() if fd.exists()),
            *(str(path) for path in Path("/dev/shm").iterdir() if ours(path)),
            *map(str, tmp_path.iterdir()),
        }

    before = found()
    processes = []
    for options in ({"track": "crash"}, {"track": "keep_a_thread"}):
        with Worker("misbehaving:Tracker", options) as worker:
            processes.append(pid(worker))
            worker.init(frame, BOX)
            try:
                worker.track(frame)
            except TrackerError:
                worker.init(frame, BOX)
                processes.append(pid(worker))
        worker.close()
    with pytest.raises(LaeError):
        Worker("nonsense", {})
    assert len(processes) == 3
    assert not [process for process in processes if alive(process)]
    assert not found() - before


PARENT = """
import sys
import numpy as np
from lae_sim.profile.worker import Worker
frame = np.zeros((48, 64, 3), np.uint8)
with Worker("misbehaving:Tracker", {"track": sys.argv[1]}) as worker:
    worker.init(frame, (1, 2, 3, 4))
    print(worker._process.pid, flush=True)
    worker.track(frame)
"""


@LINUX
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_hanging_process_and_its_children_end_with_its_parent(end: signal.Signals) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, "hang_in_c_with_a_child"],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        # not to ignore Ctrl-C where the tests run in the background of a shell
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    with parent:
        assert parent.stdout
        assert parent.stderr
        process = int(parent.stdout.readline())
        child = int(parent.stderr.readline())  # printed by the tracker
        assert alive(process)
        assert alive(child)
        os.killpg(parent.pid, end)  # what a terminal does at Ctrl-C
        assert gone(process)
        assert gone(child)
        assert parent.wait(60) == -end
        said = parent.stderr.read().decode()
    assert said.count("KeyboardInterrupt") == (1 if end == signal.SIGINT else 0)


@LINUX
def test_children_of_the_tracker_do_not_hold_its_channel(start: Any) -> None:
    worker = start("misbehaving:Clockwork")
    assert worker.describe()["descriptors"] <= 7  # 0, 1, 2, the socket, the frames, the listing


# settings -----------------------------------------------------------------------------------------


def test_describe_says_what_runs(start: Any, make: Callable[..., TimedTracker]) -> None:
    found = make("misbehaving:Clockwork").describe()
    assert found["name"] == "clockwork"
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))
    assert found["libraries"]["clock"] == "1"
    assert found["libraries"]["numpy"] == np.__version__
    assert found["size"] == 3
    assert json.dumps(found)
    with in_process() as tracker:
        assert "synchronised" not in tracker.describe()  # nothing had to be waited for


USES = """
import importlib

class Uses:
    def __init__(self, module):
        self.module = module
    def init(self, frame, box):
        importlib.import_module(self.module)
    def track(self, frame):
        return None
"""


@pytest.mark.parametrize(
    ("module", "name", "threads"),
    [("cv2", "opencv", 3), ("torch", "torch", 3)],
)
def test_threads_are_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, name: str, threads: int
) -> None:
    if not importlib.util.find_spec(module):
        pytest.skip(f"{module} is not installed")
    (tmp_path / "uses.py").write_text(USES)
    monkeypatch.chdir(tmp_path)
    with Worker("uses:Uses", {"module": module}, threads=threads) as worker:
        assert name not in worker.describe()["threads"]
        worker.init(FRAME, BOX)
        found = worker.describe()
    assert found["threads"][name] == threads
    assert found["threads"]["asked"] == threads
    assert found["libraries"][name]


def test_threads_are_left_alone_without_a_number(start: Any) -> None:
    assert start("misbehaving:Clockwork").describe()["environment"] == {
        name: value for name, value in os.environ.items() if name.endswith("_NUM_THREADS")
    }


def test_torch_on_cuda_is_waited_for_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    torch = MagicMock(__version__="2.0")
    torch.version.cuda = "12.6"
    torch.backends.cudnn.version.return_value = 90100
    torch.cuda.get_device_name.return_value = "Orin"
    torch.cuda.synchronize.side_effect = lambda: time.sleep(0.02)
    torch.get_num_threads.return_value = 6
    monkeypatch.setitem(sys.modules, "torch", torch)
    with in_process() as tracker:
        tracker.init(FRAME, BOX)
        assert 20e6 <= tracker.track(FRAME).elapsed_ns < 40e6
        found = tracker.describe()
        assert (found["cuda"], found["cudnn"], found["gpu"]) == ("12.6", 90100, "Orin")
        assert found["threads"]["torch"] == 6
        assert found["synchronised"] is True
        torch.cuda.is_initialized.return_value = False  # CUDA is there, and not in use
        found = tracker.describe()
        assert "gpu" not in found
        assert found["cuda"]
        assert "synchronised" not in found
        assert tracker.track(FRAME).elapsed_ns < 20e6
