"""Which sequence of a dataset a name means, and which tracker's results a file holds by its name.

Toolkits name files ``<seq>``, ``<dataset>_<seq>`` (pytracking: ``nfs_basketball_1``),
``<seq>_<tracker>`` (OTB) or ``<tracker>_<seq>``. They write ``Jogging.1`` or ``Jogging_1`` for
``Jogging-1`` and ``Human4`` for ``Human4-2``, and change capitals.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from lae_sim.errors import LaeError

_DATASET = re.compile(
    r"(?:otb|nfs|uav|dtb|lasot|got|trackingnet|tnl2k|tc|tpl|vot|vis|oxuva|itb|avist|nat|webuav)"
    r"[a-z0-9]*_",
    re.IGNORECASE,
)
_PART = re.compile(r"(?:\d+|s)\Z")  # of a video, as in car1_s; no tracker is called so
_PART_OF_VIDEO = re.compile(r"[-_.](\d{1,2}|s)\Z")


@dataclass(frozen=True)
class ResultsName:
    """What the name of a results file says.

    Attributes:
        sequence: as the ground truth calls it.
        tracker: whose results they are, where the name says it.
    """

    sequence: str
    tracker: str | None = None


class SequenceNames:
    """The sequences that names may mean.

    Args:
        names: the sequences as the ground truth calls them.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = set(names)
        self._alike: dict[str, list[str]] = {}
        for name in sorted(self._names):
            self._alike.setdefault(_folded(name), []).append(name)

    def read(self, written: str, tracker: str | None = None) -> ResultsName | None:
        """What a name means, or None if it fits no sequence.

        A sequence that fits as it stands comes before one that fits with other capitals or
        separators, and a longer one before a shorter one.

        Args:
            written: name of the file, without its suffix.
            tracker: the one that is looked for, if it is known.

        Raises:
            LaeError: if two sequences fit as well.
        """
        splits = [(written, None), *_splits(written)]
        if tracker:
            splits.sort(key=lambda split: split[1] not in (None, tracker))
        for part, rest in splits:
            sequences = self.meant(part)
            if len(sequences) > 1:
                raise LaeError(
                    f"is it of sequence {' or '.join(sequences)}? Rename it, or say which ground "
                    f"truth is its own with --truth-file {part}=FILE"
                )
            if sequences:
                return ResultsName(sequences[0], rest)
        return None

    def meant(self, written: str) -> list[str]:
        """The sequences that a name without a tracker may mean: none, one, or more as well."""
        bare = _DATASET.sub("", written, count=1) if _DATASET.match(written) else written
        for guess in (written, bare):
            if guess in self._names:
                return [guess]
        for guess in (written, bare):
            if _folded(guess) in self._alike:
                return self._alike[_folded(guess)]
        first, second = (  # OTB: two targets in one video
            self._alike.get(_folded(f"{bare}-{number}"), []) for number in (1, 2)
        )
        return [*first, *second] if second else []


def _splits(written: str) -> list[tuple[str, str]]:
    """``<seq>_<tracker>``, then ``<tracker>_<seq>``, the longest sequence first."""
    at = [match.start() for match in re.finditer("_", written)]
    behind = [(written[:i], written[i + 1 :]) for i in reversed(at)]
    before = [(written[i + 1 :], written[:i]) for i in at]
    splits = (*behind, *before)
    return [(part, rest) for part, rest in splits if part and rest and not _PART.match(rest)]


def _folded(name: str) -> str:
    return re.sub(r"[-._ ]+", "_", name).casefold()


def video_of(sequence: str) -> str:
    """The video that a sequence is part of, by its name.

    A number or an ``s`` at the end tells parts apart: ``car1_1``, ``car1_2`` and ``car1_s`` are one
    video, and so are ``Jogging-1`` and ``Jogging-2``.
    """
    return _PART_OF_VIDEO.sub("", sequence)
