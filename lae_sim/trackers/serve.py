"""The worker process: a tracker and its stopwatch, asked through a pipe.

`lae_sim.profile.worker.Worker` runs this file as a script, on the tracker's interpreter and as the
leader of a process group, with three inherited file descriptors: a pipe, the memory that frames are
handed over in, and a second pipe, whose other end is closed when the parent ends. Questions and
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
    control, frames, lifeline = inherited = [int(argument) for argument in sys.argv[1:]]
    for descriptor in inherited:
        os.set_inheritable(descriptor, False)  # not for the tracker's own child processes
    _end_with_parent(lifeline, control)
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
        from lae_sim.errors import LaeError, described

        do = question.pop("do")
        try:
            if do == "setup":
                return {"answer": self._set_up(**question)}
            if "shape" in question:
                question["frame"] = self._frame(question.pop("shape"))
            return {"answer": getattr(self._stopwatch, do)(**question)}
        except LaeError as error:
            return {"error": str(error)}
        except BaseException as error:  # Ctrl-C is the parent's: here it is the tracker's own
            return {"error": described(error)}

    def _set_up(self, **settings: Any) -> bool:
        """Make the tracker; whether it can be told where to search."""
        from lae_sim.errors import LaeError

        try:
            import numpy  # noqa: F401  # here, where its absence can be told, and unmeasured
        except ImportError as error:
            raise LaeError(
                f"{sys.executable}: {error}; it must be Python 3.8+ with NumPy"
            ) from error
        from lae_sim.trackers.stopwatch import Stopwatch

        self._stopwatch = Stopwatch(**settings)
        return bool(self._stopwatch.sets_search)

    def _frame(self, shape: list[int]) -> Any:
        import numpy as np

        size = shape[0] * shape[1] * shape[2]
        if size > len(self._memory):  # the file has grown
            self._memory = mmap.mmap(self._file, 0)
        return np.frombuffer(self._memory, np.uint8, size).reshape(shape)


def _end_with_parent(lifeline: int, control: int) -> None:
    """Leave a process that ends this one, and all that it started, when the parent has ended.

    It waits in the kernel for the parent's end of the lifeline to be closed, and disturbs nothing.
    A thread could not act while a tracker hangs in C code. It is in this process's group but no
    child of its, since a tracker may wait for all of its children.
    """
    if os.fork():
        os.close(lifeline)
        os.wait()
        return
    if os.fork():
        os._exit(0)
    os.close(control)  # or the parent would not see this process's end
    for sent in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(sent, signal.SIG_IGN)
    os.read(lifeline, 1)
    os.killpg(os.getpgrp(), signal.SIGKILL)


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
