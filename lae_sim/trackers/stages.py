"""Stages of a tracker's calls, marked by the tracker and timed by whoever listens.

A tracker marks its stages with :class:`stage`; a stopwatch listens to one call at a time
(:func:`listening`). Between two marks the time belongs to the innermost stage that is open, so what
stages took never adds up to more than the call did, however they are nested and whatever a tracker
raises. Marks in other threads than the one that makes the call are not heard: what runs beside it
is no part of its time.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import get_ident
from time import perf_counter_ns

from lae_sim.errors import LaeError, shown

STAGE_NAME = re.compile("[a-z][a-z0-9_]{0,39}")
"""What a stage may be called."""

MOST_STAGES = 100
"""How many names a tracker may mark: each becomes a column of its trace."""


def checked_stage(name: str) -> str:
    """The name of a stage.

    Raises:
        LaeError: if a stage may not be called so.
    """
    if not isinstance(name, str) or not STAGE_NAME.fullmatch(name):
        raise LaeError(
            f"{shown(name)} is no name of a stage: small letters, digits and underscores, 40 at "
            "most, such as 'preprocess'"
        )
    return name


class stage:  # noqa: N801 - in a with statement it reads as contextlib's do
    """Marks a stage of a tracker's call, for ``with``.

    What one name marks in a call adds up. A stage within another is not part of the outer one's
    time. Where nobody listens it does nothing, which takes less than a microsecond. On a GPU that
    works beside the program, let a stage end with what waits for its result.

    Args:
        name: ``"preprocess"``, ``"inference"``, ``"postprocess"``, or your own: small letters,
            digits and underscores, 40 at most. ``"decode"`` is what profile calls the reading of
            frames.

    Raises:
        LaeError: if a stage may not be called so.

    Example:
        >>> from lae_sim.trackers import stage
        >>> with stage("preprocess"):
        ...     patch = [pixel / 255 for pixel in range(256)]
    """

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        self._name = checked_stage(name)

    def __enter__(self) -> None:
        call = _LISTENING.get()
        if call is not None:
            call.enter(self._name)

    def __exit__(self, *_: object) -> None:
        call = _LISTENING.get()
        if call is not None:
            call.leave(self._name)


class Stages:
    """What the stages of one call took.

    Attributes:
        ns: by name, ns; stages that have not ended count up to the last mark.
    """

    def __init__(self) -> None:
        self.ns: dict[str, int] = {}
        self._open: list[str] = []
        self._since = 0
        self._thread = get_ident()  # a copied context takes the listener along to another one

    def enter(self, name: str) -> None:
        """A stage begins."""
        if get_ident() == self._thread:
            self._credit()
            self._open.append(name)
            self.ns.setdefault(name, 0)

    def leave(self, name: str) -> None:
        """The innermost stage of that name ends, if there is one; those within it may go on."""
        if get_ident() == self._thread and name in self._open:
            self._credit()
            del self._open[len(self._open) - 1 - self._open[::-1].index(name)]

    def _credit(self) -> None:
        """Give the time since the last mark to the innermost stage."""
        now = perf_counter_ns()
        if self._open:
            self.ns[self._open[-1]] += now - self._since
        self._since = now


# a name for the interpreter's state of the running call, as decimal has one for its context
_LISTENING: ContextVar[Stages | None] = ContextVar("lae_sim.stages", default=None)


@contextmanager
def listening() -> Iterator[Stages]:
    """Listen to the marks of one call, which is made in this thread."""
    call = Stages()
    token = _LISTENING.set(call)
    try:
        yield call
    finally:
        _LISTENING.reset(token)
