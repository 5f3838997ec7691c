"""The worker process: a tracker and its stopwatch, asked through a pipe.

`lae_sim.profile.worker.Worker` runs this file as a script, on the tracker's interpreter, with two
inherited file descriptors: a pipe, and the memory that frames are handed over in. Questions and
answers are JSON. Whatever the tracker prints goes to the standard error.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib.util
import json
import mmap
import os
import signal
import sys
from multiprocessing.connection import Connection
from typing import Any

FOLDER = os.path.dirname(os.path.abspath(__file__))


def main() -> None:
    """Answer questions until the pipe is closed."""
    control, frames = (int(argument) for argument in sys.argv[1:])
    for inherited in (control, frames):
        os.set_inheritable(inherited, False)  # not for the tracker's own child processes
    _die_with_parent()
    _prepare_imports()
    faulthandler.enable()  # a crash says where
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # as on a terminal
    asked, server = Connection(control), Server(frames)
    with contextlib.suppress(EOFError):
        while True:
            answer = server.answer(json.loads(asked.recv_bytes()))
            asked.send_bytes(json.dumps(answer).encode())


class Server:
    """Answers questions about one tracker; ``frames`` is the descriptor of the memory."""

    def __init__(self, frames: int) -> None:
        self._file = frames
        self._memory: Any = b""
        self._stopwatch: Any = None

    def answer(self, question: dict[str, Any]) -> dict[str, Any]:
        """Call the stopwatch's method ``question["do"]``; what it raises becomes an answer."""
        from lae_sim.errors import LaeError

        do = question.pop("do")
        try:
            if do == "setup":
                import numpy  # noqa: F401  # here, where its absence can be told, and unmeasured

                from lae_sim.trackers.stopwatch import Stopwatch

                self._stopwatch = Stopwatch(**question)
                return {"answer": self._stopwatch.sets_search}
            if "shape" in question:
                question["frame"] = self._frame(question.pop("shape"))
            return {"answer": getattr(self._stopwatch, do)(**question)}
        except LaeError as error:
            return {"error": str(error)}
        except ImportError as error:  # of NumPy: the stopwatch explains the tracker's own
            return {"error": f"{sys.executable}: {error}; it must be Python 3.8+ with NumPy"}

    def _frame(self, shape: list[int]) -> Any:
        import numpy as np

        size = shape[0] * shape[1] * shape[2]
        if size > len(self._memory):  # the file has grown
            self._memory = mmap.mmap(self._file, 0)
        return np.frombuffer(self._memory, np.uint8, size).reshape(shape)


def _die_with_parent() -> None:
    """Have the kernel end this process with its parent, even while a tracker hangs (Linux).

    Elsewhere the end of the pipe does it, as soon as the tracker returns.
    """
    if sys.platform.startswith("linux"):
        with contextlib.suppress(ImportError):  # an interpreter built without ctypes
            import ctypes

            ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def _prepare_imports() -> None:
    """Import this copy of the package whether or not it is installed here, with no dependency."""
    sys.path[:] = [os.getcwd()] + [p for p in sys.path if os.path.abspath(p) != FOLDER]
    folder = os.path.dirname(FOLDER)
    spec = importlib.util.spec_from_file_location(
        "lae_sim", os.path.join(folder, "__init__.py"), submodule_search_locations=[folder]
    )
    assert spec
    assert spec.loader
    sys.modules["lae_sim"] = package = importlib.util.module_from_spec(spec)
    with contextlib.suppress(ImportError):  # of its dependencies: the bare package suffices
        spec.loader.exec_module(package)


if __name__ == "__main__":
    main()
