"""Names of the sequences of a gap pass: ``<sequence>@<start>+<gap>``."""

from __future__ import annotations

import re
from typing import NamedTuple

from lae_sim.errors import TraceError

_NAME = re.compile(r"(.+)@(0|[1-9][0-9]{0,8})\+([1-9][0-9]{0,8})", re.DOTALL)


def is_restart(name: str) -> bool:
    """Whether a sequence's name is a restart's."""
    return _NAME.fullmatch(name) is not None


class RestartName(NamedTuple):
    """Where a tracker was started anew, and where it went on.

    Attributes:
        sequence: the sequence's name; it may hold ``@`` and ``+``.
        start: the frame on whose truth the tracker was initialised.
        gap: frames from there to the frame that it was given next, at least 1.
    """

    sequence: str
    start: int
    gap: int

    def __str__(self) -> str:
        return f"{self.sequence}@{self.start}+{self.gap}"

    @classmethod
    def parse(cls, name: str) -> RestartName:
        """Read a name from its end.

        Raises:
            TraceError: if it is no restart's.
        """
        match = _NAME.fullmatch(name)
        if match is None:
            raise TraceError(
                f"sequence {name!r:.80}: a restart is called SEQUENCE@START+GAP, such as 'car@12+6'"
            )
        return cls(match[1], int(match[2]), int(match[3]))
