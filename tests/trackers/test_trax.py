"""The TraX adapter, against real servers of the ``trax`` package in processes of their own."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from places import REPOSITORY

from lae_sim.errors import LaeError
from lae_sim.profile.timed import TrackerError
from lae_sim.profile.worker import Worker
from lae_sim.trackers.names import make_tracker

pytest.importorskip("trax", reason="TraX is not installed: pip install 'lae-sim[trax]'")

from lae_sim.trackers.trax import FOLDER, Trax, trax_program

BOX = (10.5, 20.0, 30.0, 8.0)
FRAME = np.zeros((60, 81, 3), np.uint8)

SERVER = """
import os, sys, time
import numpy as np
from trax import Image, Mask, Polygon, Rectangle, Region, Server, Special, TraxStatus

mode = sys.argv[1]
metadata = {"vot": "python"} if mode == "wrapped" else {}
images = Image.MEMORY if mode == "memory" else Image.PATH
name = os.environ.get("NAME", "")
server = Server([Region.RECTANGLE], [images], tracker_name=name, metadata=metadata)
starts = 0
while True:
    request = server.wait()
    if request.type == TraxStatus.QUIT:
        server.quit()
        break
    if request.type == TraxStatus.INITIALIZE:
        if starts and mode in ("once", "wrapped"):
            break
        region, frame, given = request.objects[0][0], 0, request.properties.dict()
        starts += 1
    else:
        frame += 1
    answer, told = region, {"confidence": os.getpid()}
    if mode == "junk":
        print("progress: 50 % \\u2588\\u2588 \\u00e9", flush=True)
        os.write(1, bytes(range(256)))
        told = {"confidence": "high"}
    elif mode == "crash" and frame == 3:
        print("loading weights")
        raise RuntimeError("no kernel image")
    elif mode == "hang" and frame == 2:
        time.sleep(1000)
    elif mode == "wrapped" and frame == 1:
        time.sleep(0.3)  # its real initialisation
    elif mode == "parameters":
        told = {"confidence": given.get("gain", "-1")}
    elif mode == "memory":
        told = {"confidence": int(request.image["color"].array()[1, 2] @ [1, 1000, 1000000])}
    elif mode == "regions" and frame == 1:
        answer = Polygon.create([(4.0, 9.0), (11.5, 2.0), (15.0, 7.5), (8.0, 13.0)])
    elif mode == "regions" and frame == 2:
        mask = np.zeros((6, 7), np.uint8)
        mask[2:5, 1] = mask[3, 1:6] = 1
        answer = Mask.create(mask, x=40, y=20)
    elif mode == "regions" and frame == 3:
        answer = Mask.create(np.zeros((6, 7), np.uint8))
    elif mode == "regions" and frame == 4:
        answer = Special.create(0)
    elif mode == "regions" and frame == 5:
        answer = Rectangle.create(0, 0, 0, 0)
    elif mode == "find":  # the reddest box-sized place near the last one
        import cv2
        pixels = cv2.imread(request.image["color"].path())
        x, y, w, h = map(int, region.bounds())
        if frame == 0:
            template = pixels[y : y + h, x : x + w]
        found = cv2.matchTemplate(pixels, template, cv2.TM_SQDIFF)
        _, _, (x, y), _ = cv2.minMaxLoc(found)
        region = answer = Rectangle.create(x, y, w, h)
        told = {"confidence": starts}
    server.status([(answer, told)])
"""


@pytest.fixture
def command(tmp_path: Path) -> Callable[[str], str]:
    """The command of a server that behaves in some way."""
    script = tmp_path / "a server.py"
    script.write_text(SERVER)
    return lambda mode: shlex.join([sys.executable, str(script), mode])


@pytest.fixture
def started(command: Callable[[str], str]) -> Iterator[Callable[..., Trax]]:
    trackers: list[Trax] = []

    def start(mode: str, **parameters: object) -> Trax:
        tracker = make_tracker("trax:" + command(mode), parameters)
        assert isinstance(tracker, Trax)
        trackers.append(tracker)
        return tracker

    yield start
    for tracker in trackers:
        tracker.close()


def pid(tracker: Trax) -> int:
    output = tracker.track(FRAME)
    assert isinstance(output, tuple)
    return int(output[1])


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{process}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def dies(process: int) -> bool:
    deadline = time.monotonic() + 10
    while alive(process) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not alive(process)


def test_a_box_and_a_confidence_come_back(started: Callable[..., Trax]) -> None:
    tracker = started("static")
    tracker.init(FRAME, BOX)
    for _ in range(3):
        box, score = tracker.track(FRAME)
        assert box == BOX
        assert score > 0
    assert not hasattr(tracker, "set_search")


def test_frames_arrive_whole_in_one_process_over_sequences(started: Callable[..., Trax]) -> None:
    pytest.importorskip("cv2", reason="the tracker of this test reads images with OpenCV")
    tracker = started("find")
    rng = np.random.default_rng(5)
    for start, (height, width) in enumerate([(90, 121), (90, 121), (64, 82), (50, 103)], 1):
        scene = rng.integers(0, 200, (height, width, 3), np.uint8)
        target = rng.integers(0, 255, (9, 14, 3), np.uint8)
        for frame in range(6):
            image = scene.copy()
            x, y = 5 + 11 * frame, 3 + 6 * frame
            image[y : y + 9, x : x + 14] = target
            if frame == 0:
                tracker.init(image, (x, y, 14, 9))
            else:
                assert tracker.track(image) == ((x, y, 14, 9), start)


def test_memory_images_are_red_green_blue(started: Callable[..., Trax]) -> None:
    tracker = started("memory")
    image = FRAME.copy()
    image[1, 2] = 7, 8, 9
    tracker.init(image, BOX)
    assert tracker.track(image) == (BOX, 7_008_009)


def test_other_regions(started: Callable[..., Trax]) -> None:
    tracker = started("regions")
    tracker.init(FRAME, BOX)
    boxes = [output and output[0] for output in (tracker.track(FRAME) for _ in range(6))]
    assert boxes == [(4, 2, 11, 11), (41, 22, 5, 3), None, None, None, BOX]


def test_what_it_prints_disturbs_nothing(started: Callable[..., Trax]) -> None:
    tracker = started("junk")
    tracker.init(FRAME, BOX)
    assert [tracker.track(FRAME) for _ in range(3)] == [BOX] * 3


def test_parameters_and_environment(command: Callable[[str], str]) -> None:
    name = f"trax:env NAME=mine {command('parameters')}"
    tracker = make_tracker(name, {"gain": 0.25, "fast": True})
    tracker.init(FRAME, BOX)
    assert tracker.track(FRAME) == (BOX, 0.25)
    described = tracker.describe()  # type: ignore[attr-defined]
    assert described["name"] == "mine"
    assert described["settings"] == {"command": name[5:], "gain": "0.25", "fast": "True"}
    assert described["libraries"]["trax"]
    tracker.close()  # type: ignore[attr-defined]


def test_after_a_crash_it_starts_again(started: Callable[..., Trax]) -> None:
    tracker = started("crash")
    for _ in range(2):
        tracker.init(FRAME, BOX)
        first = pid(tracker)
        tracker.track(FRAME)
        with pytest.raises(LaeError, match=r"trax:.* ended with status 1 .*no kernel image$"):
            tracker.track(FRAME)
        assert not alive(first)
        with pytest.raises(LaeError, match="must be initialised"):
            tracker.track(FRAME)


@pytest.mark.parametrize("mode", ["once", "wrapped"])
def test_one_that_ends_with_its_sequence_is_started_again(
    started: Callable[..., Trax], mode: str
) -> None:
    tracker = started(mode)
    seen = []
    for _ in range(3):
        tracker.init(FRAME, BOX)
        seen.append(pid(tracker))
        assert pid(tracker) == seen[-1]
    assert len(set(seen)) == 3
    assert [alive(process) for process in seen] == [False, False, True]
    tracker.prepare()
    ready = tracker._process.pid
    tracker.prepare()
    tracker.init(FRAME, BOX)
    assert pid(tracker) == ready not in seen


def test_a_wrapped_tracker_is_initialised_inside_init(started: Callable[..., Trax]) -> None:
    tracker = started("wrapped")
    before = time.perf_counter()
    tracker.init(FRAME, BOX)
    assert time.perf_counter() - before >= 0.3
    before = time.perf_counter()
    tracker.track(FRAME)
    assert time.perf_counter() - before < 0.3


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("no-such-program --x", "does not start: .*no-such-program"),
        ("echo 'out of memory'", "status 0 .*did not speak TraX.*: out of memory$"),
        (f"{sys.executable} -c 'import nonsense_42'", "No module named 'nonsense_42'$"),
        ("python 'half a quotation", "does not start: No closing quotation"),
        ("   ", "does not start"),
    ],
)
def test_what_is_not_a_trax_tracker(command: str, message: str) -> None:
    with pytest.raises(LaeError, match=message) as caught:
        trax_program(command)
    assert "\n" not in str(caught.value)


def test_one_that_connects_and_says_nonsense(tmp_path: Path) -> None:
    program = "import os, socket; s = socket.create_connection(('127.0.0.1', "
    program += "int(os.environ['TRAX_SOCKET']))); s.send(b'hello\\n'); print('bye')"
    with pytest.raises(LaeError, match=r"ended with status 0 \(Unable to connect.*: bye$"):
        trax_program(shlex.join([sys.executable, "-c", program]))


def test_close_leaves_nothing(started: Callable[..., Trax]) -> None:
    open_before = len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else 0
    tracker = started("static")
    tracker.init(FRAME, BOX)
    process, folder = pid(tracker), Path(tracker._folder.name)
    assert folder.is_dir()
    tracker.close()
    assert not folder.exists()
    assert not alive(process)
    tracker.close()
    if open_before:
        assert len(os.listdir("/proc/self/fd")) == open_before


def test_what_a_killed_process_left_is_removed(
    command: Callable[[str], str], started: Callable[..., Trax]
) -> None:
    program = (
        "import os, signal, sys; from lae_sim.trackers.trax import trax_program\n"
        "tracker = trax_program(sys.argv[1]); print(tracker._folder.name, flush=True)\n"
        "print(tracker._process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run(
        [sys.executable, "-c", program, command("static")],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    folder, process = killed.stdout.split()
    assert FOLDER in folder
    assert Path(folder).exists()
    other = started("static")
    assert not Path(folder).exists()
    assert Path(other._folder.name).exists()
    started("static")
    assert Path(other._folder.name).exists()  # it is in use
    assert dies(int(process))  # its connection ended with the process


def test_the_watchdog_ends_a_hanging_one_with_its_program(command: Callable[[str], str]) -> None:
    with Worker("trax:" + command("hang"), {}, timeout=1.5) as worker:
        worker.init(FRAME, BOX)
        program = int(worker.track(FRAME).score or 0)
        assert alive(program)
        with pytest.raises(TrackerError, match=r"1\.5 s"):
            worker.track(FRAME)
        assert dies(program)
        assert worker.init(FRAME, BOX).box == BOX


def test_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trax", None)
    with pytest.raises(LaeError, match=r"pip install 'lae-sim\[trax\]'"):
        trax_program("true")
