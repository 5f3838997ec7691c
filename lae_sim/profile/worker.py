"""A tracker in a process of its own, which may hang, crash, and run on another interpreter."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

import numpy as np

from lae_sim.datasets.frames import Image
from lae_sim.errors import LaeError, described, one_line
from lae_sim.profile.timed import Answer, TrackerError
from lae_sim.progress import tell
from lae_sim.trackers.names import usual_timeout
from lae_sim.trackers.protocol import checked_frame
from lae_sim.trackers.runtimes import THREAD_VARIABLES
from lae_sim.trackers.stopwatch import Stopwatch

SERVE = Path(__file__).parents[1] / "trackers" / "serve.py"
"""The script of the process."""

GLANCE_S = 0.25  # how often a process at work is looked at
LAST_WORDS = 10_000  # bytes of what a process printed, kept to say why it crashed
CLOSE_S = 2.0  # how long a tracker may take to close, and its process to exit


class _Asked(contextlib.AbstractContextManager[Any]):
    """The methods of a `lae_sim.profile.timed.TimedTracker`, whose questions ``_ask`` answers."""

    sets_search = False

    def init(self, frame: Image, box: Sequence[float]) -> Answer:
        """Start on a new sequence."""
        return _answer(self._ask("init", frame=checked_frame(frame), box=_four(box)))

    def track(self, frame: Image, search: Sequence[float] | None = None) -> Answer:
        """Find the target, around ``cx, cy, w, h`` if ``search`` is given."""
        where = None if search is None else _four(search)
        return _answer(self._ask("track", frame=checked_frame(frame), search=where))

    def describe(self) -> Mapping[str, Any]:
        """What the tracker says of itself, and the interpreter and libraries it runs on."""
        description: Mapping[str, Any] = self._ask("describe")
        return description

    def close(self) -> None:
        """End the tracker."""
        with contextlib.suppress(TrackerError):
            self._ask("close")

    def _ask(self, do: str, **question: Any) -> Any:
        raise NotImplementedError

    def __exit__(self, *_: object) -> None:
        self.close()


class Worker(_Asked):
    """A tracker in a process of its own: a :class:`.timed.TimedTracker`, for ``with``.

    The process stays over sequences. One that crashes or takes too long is ended, and the next
    `init` starts another. It ends with this process, however that ends. With it ends all that it
    started, but for what has begun a session of its own. What the tracker prints is passed on to
    the standard error after each answer.

    Args:
        tracker: the tracker's name, see `lae_sim.trackers.names.make_tracker`.
        options: keyword arguments of its factory (JSON values).
        python: an interpreter, Python 3.8 or newer with NumPy; None is this one.
        threads: threads that the tracker's libraries may use; None leaves them as they are.
        timeout: seconds that a call may take; None is the tracker's usual
            (`lae_sim.trackers.names.usual_timeout`).
        setup_timeout: seconds that starting the process and making the tracker may take.

    Raises:
        LaeError: if the interpreter does not start or the tracker cannot be made.
    """

    def __init__(
        self,
        tracker: str,
        options: Mapping[str, Any],
        python: str | None = None,
        threads: int | None = None,
        timeout: float | None = None,
        setup_timeout: float = 300.0,
    ) -> None:
        if os.name != "posix":
            raise LaeError("worker processes need Linux or macOS: run the tracker in this process")
        self._tracker, self._threads = tracker, threads
        self._setup = {"tracker": tracker, "options": dict(options), "threads": threads}
        self._python = python or sys.executable
        self._timeout = usual_timeout(tracker, options) if timeout is None else timeout
        self._setup_timeout = setup_timeout
        self._process: subprocess.Popen[bytes] | None = None
        self._control: Connection
        self._lifeline = -1
        self._memory: mmap.mmap | bytes = b""
        self._output = b""
        self._files = contextlib.ExitStack()
        # files without a name: nothing of them can be left behind
        self._log = self._files.enter_context(tempfile.TemporaryFile(buffering=0))  # noqa: SIM115
        self._frames = self._files.enter_context(_memory())
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the tracker and its process."""
        try:
            if self._process is not None:
                with contextlib.suppress(TrackerError, subprocess.TimeoutExpired):
                    self._exchange("close", CLOSE_S, {})
                    self._control.close()  # on which it exits by itself
                    self._process.wait(CLOSE_S)
        finally:
            self._kill()
            self._memory = b""
            self._files.close()

    def _start(self) -> None:
        self._kill()
        self._control, workers_end = Pipe()
        lifeline, self._lifeline = os.pipe()
        limits = {name: str(self._threads) for name in THREAD_VARIABLES if self._threads}
        with workers_end, os.fdopen(lifeline, "rb"):
            inherited = workers_end.fileno(), self._frames.fileno(), lifeline
            try:
                self._process = subprocess.Popen(
                    [self._python, str(SERVE), *map(str, inherited)],
                    stdin=subprocess.DEVNULL,
                    stdout=self._log,
                    stderr=self._log,
                    env={**os.environ, **limits},
                    pass_fds=inherited,
                    start_new_session=True,  # Ctrl-C is for this process alone
                )
            except OSError as error:
                self._let_go()
                raise LaeError(f"{self._python} does not start: {error.strerror}") from error
        try:
            self.sets_search = self._exchange("setup", self._setup_timeout, self._setup)
        except TrackerError as error:
            silent = self._process is None and self._python != sys.executable
            hint = f" ({self._python} must be Python 3.8 or newer with NumPy)" if silent else ""
            self._kill()
            raise LaeError(f"{error}{hint}") from None

    def _ask(self, do: str, **question: Any) -> Any:
        if self._process is None and do == "track":
            raise TrackerError(f"{self._tracker}: the tracker must be initialised first")
        if self._process is None or (do == "init" and self._process.poll() is not None):
            self._start()
        if "frame" in question:
            question["shape"] = self._hand_over(question.pop("frame"))
        limit = self._setup_timeout if do == "describe" else self._timeout
        return self._exchange(do, limit, question)

    def _hand_over(self, frame: Image) -> tuple[int, ...]:
        if frame.nbytes > len(self._memory):
            try:
                os.truncate(self._frames.fileno(), frame.nbytes)
                self._memory = mmap.mmap(self._frames.fileno(), frame.nbytes)
            except OSError as error:
                raise LaeError(f"no shared memory for a frame: {error.strerror}") from error
        shared = np.frombuffer(self._memory, np.uint8, frame.size).reshape(frame.shape)
        np.copyto(shared, frame)
        return frame.shape

    def _exchange(self, do: str, limit: float, question: Mapping[str, Any]) -> Any:
        try:
            with contextlib.suppress(ConnectionError):  # the death is found where answers are read
                self._control.send_bytes(json.dumps({"do": do, **question}).encode())
            received = self._received(do, limit)
            try:
                answer = json.loads(received)
            except ValueError as error:
                raise TrackerError(f"{self._tracker}: {do}: sent no answer") from error
        except BaseException:  # with Ctrl-C too: the answer would be taken for that of the next
            self._kill()
            raise
        self._pass_on()
        if "error" in answer:
            raise TrackerError(f"{self._tracker}: {do}: {one_line(answer['error'])}")
        return answer["answer"]

    def _received(self, do: str, limit: float) -> bytes:
        """The process's answer; it says why if there is none."""
        assert self._process is not None
        self._output = b""
        deadline = time.monotonic() + limit
        while not self._control.poll(max(0, min(GLANCE_S, deadline - time.monotonic()))):
            self._pass_on()
            if self._process.poll() is not None:  # a child of the tracker holds the pipe open
                break
            if time.monotonic() >= deadline:
                raise TrackerError(f"{self._tracker}: {do} exceeded {limit:g} s")
        else:
            with contextlib.suppress(EOFError, OSError):
                return self._control.recv_bytes()
        raise TrackerError(f"{self._tracker}: {do}: {self._cause()}")

    def _cause(self) -> str:
        """How the process ended, and its last words."""
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):  # its channel is closed first
            self._process.wait(CLOSE_S)
        ended = self._process.poll() is not None
        code = self._kill()
        ends = {-s.value: s.name for s in signal.Signals}
        how = f"was ended by {ends.get(code, code)}" if code < 0 else f"exited with status {code}"
        if not ended:
            how = "closed its channel"
        elif code == -signal.SIGKILL:
            how += " (out of memory?)"
        words, _, crash = self._output.decode(errors="replace").partition("Fatal Python error")
        place = re.search(r"most recent call first\):\n\s*(File .*)", crash)
        lines = words.split("\n")[-2:-1] + ([place[1]] if place else [])
        return ": ".join([f"the process {how}", *filter(None, map(one_line, lines))])

    def _pass_on(self) -> None:
        """Show what the process printed, and keep the end of it."""
        log = self._log.fileno()
        size = os.fstat(log).st_size
        if size:
            text = os.pread(log, size, 0)
            os.truncate(log, 0)
            os.lseek(log, 0, os.SEEK_SET)  # the process's own offset too
            self._output = (self._output + text)[-LAST_WORDS:]
            # its own program, which may colour and count as it likes
            tell(text.decode(errors="replace"), end="", keep="\n\r\t\x1b")

    def _kill(self) -> int:
        """End the process and all of its group, if there is one; its exit status."""
        process, self._process = self._process, None
        if process is None:
            return 0
        with contextlib.suppress(ProcessLookupError, PermissionError):  # they have ended
            os.killpg(process.pid, signal.SIGKILL)
        self._let_go()
        code = process.wait()
        self._pass_on()
        return code

    def _let_go(self) -> None:
        """Close what leads to the process."""
        self._control.close()
        os.close(self._lifeline)


class InProcess(_Asked):
    """A tracker in this process: a :class:`.timed.TimedTracker`, for ``with``, to debug a tracker.

    Nothing stops it when it hangs or crashes. BLAS and OpenMP keep the threads that they were
    loaded with.

    Args:
        tracker: the tracker's name, see `lae_sim.trackers.names.make_tracker`.
        options: keyword arguments of its factory.
        threads: that libraries may use; None leaves them as they are.

    Raises:
        LaeError: if the tracker cannot be made.
    """

    def __init__(
        self, tracker: str, options: Mapping[str, Any], threads: int | None = None
    ) -> None:
        self._tracker = tracker
        try:
            self._stopwatch = Stopwatch(tracker, options, threads)
        except LaeError:
            raise
        except (Exception, SystemExit) as error:  # some scripts exit where they should raise
            raise LaeError(f"{tracker}: {described(error)}") from error
        self.sets_search = self._stopwatch.sets_search

    def _ask(self, do: str, **question: Any) -> Any:
        try:
            return getattr(self._stopwatch, do)(**question)
        except LaeError as error:
            raise TrackerError(f"{self._tracker}: {do}: {error}") from error
        except (Exception, SystemExit) as error:
            raise TrackerError(f"{self._tracker}: {do}: {described(error)}") from error


def _answer(fields: dict[str, Any]) -> Answer:
    box = fields.pop("box")
    return Answer(box=None if box is None else tuple(box), **fields)


def _four(box: Sequence[float]) -> list[float]:
    numbers = [float(v) for v in box]
    if len(numbers) != 4 or not np.isfinite(numbers).all():
        raise LaeError(f"a box is four finite numbers, not {numbers}")
    return numbers


def _memory() -> IO[bytes]:
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("frames"), "r+b", 0)
    return tempfile.TemporaryFile(buffering=0)
