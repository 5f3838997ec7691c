"""Other programs that run while a tracker is measured, as they will in use.

Each is a command of the shell in a session of its own. A second small process, its guard, waits for
the end of a pipe that only this process holds open: when this one closes it, or ends however it
ends, the command and all that it started are ended too, but for what has begun yet another session.
The command waits for its guard: no moment is left in which Ctrl-C could part them.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import IO, Any

from lae_sim.errors import LaeError, one_line, shown

AT_ONCE_S = 0.5
"""A load that ends so early has failed to start."""

GRACE_S = 2
"""How long a load may take to end when it is asked to; then it is ended."""

KEPT_BYTES = 1_000_000
"""What a load may print before all of it is thrown away."""

LAST_WORDS = 1_000
"""Bytes of what it printed in which to look for why it failed."""

_WAITS = 'read go || exit; exec /bin/sh -c "$1" </dev/null'
_GUARD = f"""\
cat >/dev/null
kill -TERM -"$1" || exit 0
for tenth in {" ".join("x" * (10 * GRACE_S))}; do kill -0 -"$1" || exit 0; sleep 0.1; done
kill -KILL -"$1"
"""


@dataclass
class _Load:
    """A command, and what ends it."""

    command: str
    process: subprocess.Popen[bytes]
    guard: subprocess.Popen[bytes]
    printed: IO[bytes]
    started: float
    lasted_s: float | None = None


class Loads:
    """Commands that run from ``with`` to its end, whatever ends it.

    What they print goes nowhere; the end of it is told of one that fails at once.

    Args:
        commands: of the shell.

    Raises:
        LaeError: on entering, if one ends at once.
    """

    def __init__(self, commands: Sequence[str]) -> None:
        if commands and os.name != "posix":
            raise LaeError("beside: running other programs needs Linux or macOS")
        self._commands = tuple(commands)
        self._loads: list[_Load] = []
        self._over = False

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._commands)

    def __enter__(self) -> Loads:
        try:
            for command in self._commands:
                load = _made(command)
                self._loads.append(load)
                _pipe(load.process).write(b"go\n")
                _pipe(load.process).close()
            if self._commands:
                self._check_started()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.watch()
        self._end()

    def watch(self) -> None:
        """Note which have ended by themselves."""
        if self._over:  # what ends now does not end by itself
            return
        for load in self._loads:
            if load.lasted_s is None and load.process.poll() is not None:
                load.lasted_s = time.monotonic() - load.started
            if load.lasted_s is None and os.fstat(load.printed.fileno()).st_size > KEPT_BYTES:
                os.truncate(load.printed.fileno(), 0)

    def entries(self) -> list[dict[str, Any]]:
        """What a trace says of each: its ``command``, and ``exit`` and ``seconds`` if it ended.

        ``exit`` is the status with which it ended by itself, negative that of a signal; ``seconds``
        are those that it ran.
        """
        self.watch()
        return [
            {
                "command": load.command,
                "exit": None if load.lasted_s is None else load.process.returncode,
                "seconds": None if load.lasted_s is None else round(load.lasted_s, 3),
            }
            for load in self._loads
        ]

    def ended(self) -> list[str]:
        """What to say of those that ended by themselves."""
        return [
            f"beside: {shown(each['command'])} ended by itself after {each['seconds']:.3g} s "
            f"({_how(each['exit'])}): what was measured later ran without it"
            for each in self.entries()
            if each["exit"] is not None
        ]

    def _check_started(self) -> None:
        deadline = time.monotonic() + AT_ONCE_S
        while time.monotonic() < deadline:
            for load in self._loads:
                code = load.process.poll()
                if code is not None:
                    words = _last_words(load.printed)
                    raise LaeError(
                        f"beside {shown(load.command)}: it ended at once ({_how(code)})"
                        + (f": {words}" if words else ": it must run as long as the profile")
                    )
            time.sleep(AT_ONCE_S / 10)

    def _end(self) -> None:
        """End all that runs; twice does no harm."""
        self._over = True
        for load in self._loads:  # all of them first: a second Ctrl-C cannot stop the guards
            _pipe(load.guard).close()
        for load in self._loads:
            while load.guard.poll() is None:
                load.process.poll()  # as long as nobody has, it counts as there
                time.sleep(0.005)
            load.process.wait()
            load.printed.close()


def in_all(parts: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """What a trace says of loads, from what was said at the end of each sequence.

    Returns:
        Of each load: ``command``; ``exit`` and ``seconds`` if it ever ended by itself; and
        ``sequences``, how many of ``of_sequences`` it was there for to their end.
    """
    found = []
    for same in zip(*parts):
        last = next((each for each in same if each["exit"] is not None), same[0])
        there = sum(each["exit"] is None for each in same)
        found.append({**last, "sequences": there, "of_sequences": len(parts)})
    return found


def _made(command: str) -> _Load:
    """A command of the shell, which waits for a line, and its guard."""
    apart: dict[str, Any] = {"stdin": subprocess.PIPE, "bufsize": 0, "start_new_session": True}
    printed = tempfile.TemporaryFile("a+b", buffering=0)  # noqa: SIM115
    try:
        words = ["/bin/sh", "-c", _WAITS, "load", command]
        process = subprocess.Popen(words, stdout=printed, stderr=printed, **apart)
        words = ["/bin/sh", "-c", _GUARD, "guard", str(process.pid)]
        nowhere = subprocess.DEVNULL
        guard = subprocess.Popen(words, stdout=nowhere, stderr=nowhere, **apart)
    except (OSError, ValueError) as error:
        raise LaeError(f"beside {shown(command)}: does not start: {error}") from error
    return _Load(command, process, guard, printed, time.monotonic())


def _pipe(process: subprocess.Popen[bytes]) -> IO[bytes]:
    """The pipe that a process reads."""
    assert process.stdin is not None
    return process.stdin


def _how(code: int) -> str:
    """How a process ended."""
    names = {-each.value: each.name for each in signal.Signals}
    return f"by {names.get(code, code)}" if code < 0 else f"status {code}"


def _last_words(printed: IO[bytes]) -> str:
    """The last line that a command printed."""
    size = os.fstat(printed.fileno()).st_size
    tail = os.pread(printed.fileno(), LAST_WORDS, max(0, size - LAST_WORDS))
    lines = tail.decode(errors="replace").strip().splitlines()
    return one_line(lines[-1]) if lines else ""
