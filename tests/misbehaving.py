"""Trackers that do what trackers must not; they run on Python 3.8 too."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np

from lae_sim.trackers import stage

BOX = (10.0, 20.0, 30.0, 40.0)


class Text(str):
    def __repr__(self) -> str:
        raise RuntimeError("no text")


class NoNumber:
    def __float__(self) -> float:
        raise RuntimeError("no number")

    def __repr__(self) -> str:
        return "NoNumber"


class NoFloat(float):
    def __abs__(self) -> float:
        raise RuntimeError("no number")


ANSWERS: dict[str, Any] = {
    "box": BOX,
    "tuple": (BOX, 0.5),
    "list": [list(BOX), 0.5],
    "integers": (10, 20, 30, 40),
    "array": np.array(BOX, np.float32),
    "scalars": ([np.float32(v) for v in BOX], np.float32(0.5)),
    "integer array": (np.array(BOX, np.int16), np.array(0.5)),
    "none": None,
    "none with a score": (None, 0.5),
    "score nan": (BOX, float("nan")),
    "score infinite": (BOX, np.float32("inf")),
    "score none": (BOX, None),
    "score text": (BOX, "high"),
    "score array": (BOX, np.zeros(2)),
    "score that is no number": (BOX, NoNumber()),
    "score of 400 digits": (BOX, 10**400),
    "score of 5000 digits": (BOX, 10**5000),
    "score beyond float32": (BOX, 1e39),
    "nan": (10, 20, float("nan"), 40),
    "infinity": np.array([10, 20, np.inf, 40]),
    "huge": (10, 20, 30, -1.1e9),
    "huge integer": (10, 20, 30, 10**400),
    "integer without a text": (10, 20, 30, 10**5000),
    "no number": (10, 20, 30, NoNumber()),
    "own text": Text("1234"),
    "own float": (10, 20, 30, NoFloat(40)),
    "found": (True, BOX),
    "three": (10, 20, 30),
    "five": (10, 20, 30, 40, 50),
    "matrix": np.array([BOX]),
    "two boxes": np.array([BOX, BOX]),
    "text": "1234",
    "texts": ["1", "2", "3", "4"],
    "nothing": (),
    "true": True,
    "number": 7,
    "none inside": (10, 20, None, 40),
    "mapping": dict.fromkeys(BOX),
    "complex": [1j, 2, 3, 4],
    "frame": np.zeros((480, 640, 3), np.uint8),
}


def hang_in_c() -> None:
    """Sleep for 1000 s with the global interpreter lock held."""
    ctypes.PyDLL(None).sleep(1000)


def hang() -> None:
    while True:
        time.sleep(1)


def hang_with_a_child() -> None:
    """Hang while a child process has the tracker's output open."""
    subprocess.Popen(["sleep", "1001"])
    hang()


def hang_in_c_with_a_child() -> None:
    """Hang in C code while a child process is at work, whose number is printed."""
    print(subprocess.Popen(["sleep", "1003"]).pid)
    hang_in_c()


def crash() -> None:
    ctypes.string_at(0)


def crash_with_a_fork() -> None:
    """Die while a fork, which has all of the file descriptors, lives on."""
    if not os.fork():
        time.sleep(1001)
    crash()


def leave() -> None:
    print("a last word", file=sys.stderr)
    os._exit(3)


def leave_politely() -> None:
    sys.exit("usage: tracker")


def interrupt() -> None:
    raise KeyboardInterrupt("my own")


def run_out_of_memory() -> None:
    np.zeros(10**15)


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


def fail_mutely() -> None:
    raise MuteError


def fail() -> None:
    raise ValueError("no target\nhere")


def print_much() -> None:
    """Print more than any pipe holds, from Python and from C, and feign an answer."""
    print('{"answer": {"box": null}}')
    os.write(1, b"written to 1\n")
    ctypes.CDLL(None).puts(b"put by C")
    ctypes.CDLL(None).fflush(None)
    sys.stderr.write("x" * 1_000_000 + "\n")


def keep_a_thread() -> None:
    """Start a thread that never ends, so that the interpreter does not exit."""
    threading.Thread(target=hang).start()


class Tracker:
    """Answers as told, after doing what it is told in the constructor, in init or in track."""

    def __init__(
        self, making: str = "", init: str = "", track: str = "", answer: str = "box"
    ) -> None:
        self.does = {"init": init, "track": track}
        self.answer = ANSWERS[answer]
        self.do(making)

    def do(self, what: str) -> None:
        if what:
            globals()[what]()

    def init(self, frame: Any, box: Any) -> None:
        assert len(box) == 4
        self.do(self.does["init"])

    def track(self, frame: Any) -> Any:
        self.do(self.does["track"])
        return self.answer

    def close(self) -> None:
        print("closed")


class Frames:
    """Answers with what it sees, writes to each frame, and checks that the last one stays."""

    def init(self, frame: Any, box: Any) -> None:
        self.last, self.digest = frame, int(frame.sum())

    def track(self, frame: Any) -> Any:
        assert int(self.last.sum()) == self.digest
        found = frame.shape[0], frame.shape[1], int(frame[0, 0, 0]), int(frame[-1, -1, -1])
        frame[:] = 7
        self.last, self.digest = frame, int(frame.sum())
        return found


class Staged:
    """Marks its stages, also in another thread, and raises within one in its third call."""

    def init(self, frame: Any, box: Any) -> None:
        self.calls = 0

    def track(self, frame: Any) -> Any:
        self.calls += 1
        with stage("preprocess"):
            time.sleep(0.01)
        beside = threading.Thread(target=self.beside)
        beside.start()
        with stage("inference"):
            if self.calls == 3:
                raise ValueError("lost my mind")
            time.sleep(0.02)
        beside.join()
        with stage("preprocess"):
            pass
        return BOX

    def beside(self) -> None:
        with stage("beside"):
            time.sleep(0.02)


class Numbered:
    """Marks a stage of another name again and again."""

    def init(self, frame: Any, box: Any) -> None:
        pass

    def track(self, frame: Any) -> Any:
        for number in range(101):
            with stage(f"frame_{number}"):
                pass
        return BOX


class Misnamed:
    """Marks a stage that no trace can name."""

    def init(self, frame: Any, box: Any) -> None:
        pass

    def track(self, frame: Any) -> Any:
        with stage("Pre-process"):
            return BOX


class Clockwork:
    """Waits for known times, notes the order of calls, and says much of itself."""

    def __init__(self, wait_s: float = 0.0, work_s: float = 0.0) -> None:
        self.wait_s, self.work_s = wait_s, work_s
        self.calls: list[Any] = []

    def init(self, frame: Any, box: Any) -> None:
        self.calls.append(["init", list(box)])

    def track(self, frame: Any) -> Any:
        self.calls.append("track")
        time.sleep(self.wait_s)
        end = time.process_time() + self.work_s
        while time.process_time() < end:
            pass
        return BOX

    def set_search(self, cx: float, cy: float, w: float, h: float) -> None:
        time.sleep(0.05)
        self.calls.append([cx, cy, w, h])

    def sync(self) -> None:
        time.sleep(0.01)
        self.calls.append("sync")

    def describe(self) -> Any:
        return {
            "name": "clockwork",
            "calls": self.calls,
            "libraries": {"clock": "1"},
            "size": np.int64(3),
            "lr": float("nan"),
            "environment": {n: v for n, v in os.environ.items() if n.endswith("_NUM_THREADS")},
            "modules": sorted({name.split(".")[0] for name in sys.modules}),
            "descriptors": len(os.listdir("/proc/self/fd")) if os.path.exists("/proc") else 0,
            "path": sys.path[:2],
        }
