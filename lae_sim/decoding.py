"""How much memory what is in a file may take, counted before it is decoded."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from lae_sim.errors import LaeError, shown
from lae_sim.files import check_regular

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_DECODED = "256MiB"
"""What a file may take in memory, once it is decoded, unless :func:`max_decoded` says otherwise."""

_JSON_VALUE_BYTES = 80  # an empty list or dict, and its place in another
_UNITS = {"": 0, "K": 10, "M": 20, "G": 30, "T": 40}
_NESTED_KEY = re.compile(r"(?:[\w\"'-]+[ \t]*\.[ \t]*){32}")
_SIZE = re.compile(r"([0-9]{1,15}) ?([KMGT]?)(?:i?B)?\Z")
# As numpy.errstate: a setting of whoever calls, not of the process.
_MAX_DECODED: ContextVar[int] = ContextVar("max_decoded", default=256 << 20)  # MAX_DECODED


@contextmanager
def max_decoded(size: str | int) -> Iterator[None]:
    """Let files take more memory, or less, once they are decoded, while the block runs.

    A small file can unpack to one that no memory holds. So what the content of a file would take is
    counted before it is decoded: of one sequence of a trace, and of other files in whole. 256 MiB
    are allowed by default.

    Args:
        size: bytes, or text such as ``"1GiB"``.

    Raises:
        LaeError: if it is no size.

    Example:
        >>> import lae_sim
        >>> with lae_sim.max_decoded("1GiB"):
        ...     trace = lae_sim.read_trace("traces/synthetic-slow.parquet")
        >>> len(trace)
        8
    """
    token = _MAX_DECODED.set(parse_size(size))
    try:
        yield
    finally:
        _MAX_DECODED.reset(token)


def parse_size(size: str | int) -> int:
    """Bytes, or text such as ``"1GiB"`` (units are powers of 1024), in bytes.

    Raises:
        LaeError: if it is no size.
    """
    match = _SIZE.match(str(size)) if type(size) in (str, int) else None
    if match is None or not int(match[1]):
        raise LaeError(f"{shown(size)} is no size in memory: write it as 256MiB or 1GiB")
    return int(match[1]) << _UNITS[match[2]]


class TooLargeError(LaeError):
    """A file whose content would take more memory than is allowed (see :func:`max_decoded`)."""


class Budget:
    """How much is still to be decoded of a file.

    Args:
        path: the file, for messages.
        error: what is raised.

    Attributes:
        left: bytes.
    """

    def __init__(self, path: str | os.PathLike[str], error: type[LaeError] = TooLargeError) -> None:
        self._path, self._error = path, error
        self.left = _MAX_DECODED.get()

    def take(self, size: int) -> None:
        """Count what is about to be decoded, bytes.

        Raises:
            TooLargeError: if it is more than is left.
        """
        self.left -= size
        if self.left < 0:
            most = _MAX_DECODED.get() / 2**20
            raise self._error(
                f"{self._path}: would take more than {most:,.4g} MiB of memory, too much for such "
                f"a file; if it is right, --max-decoded {math.ceil(4 * most)}MiB allows more"
            )


def read_bytes(path: Path, budget: Budget) -> bytes:
    """The content of a file, taken from its budget before it is read.

    Raises:
        LaeError: if it is not there, no file, or cannot be read.
        TooLargeError: if it is too much.
    """
    check_regular(path)
    try:
        budget.take(path.stat().st_size)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise LaeError(f"{path}: no such file") from error
    except OSError as error:
        raise LaeError(f"{path}: cannot be read: {error.strerror or error}") from error


def read_toml(path: str | os.PathLike[str], what: str) -> dict[str, Any]:
    """What a TOML file holds; numbers with a point stay text, as they are written.

    Args:
        path: of the file.
        what: what it is, for messages, such as ``"a study"``.

    Raises:
        LaeError: if it cannot be read, or is not TOML; it names the file.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    try:
        content = read_bytes(Path(path), Budget(path)).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LaeError(f"{path}: cannot be read: {error}") from error
    try:
        if _NESTED_KEY.search(content):  # for which tomllib takes the square of its length
            raise RecursionError
        return tomllib.loads(content, parse_float=str)  # so that no float comes between
    except RecursionError as error:
        raise LaeError(f"{path}: is nested too deeply for {what}") from error
    except ValueError as error:  # also of a number of thousands of digits
        raise LaeError(f"{path}: {error}") from error


def json_memory(text: bytes) -> int:
    """What the values of a JSON document take at most in memory, bytes, before they are decoded."""
    return 2 * len(text) + _JSON_VALUE_BYTES * sum(map(text.count, (b",", b":", b"[", b"{")))


def allowing(work: Callable[[Item], Result]) -> Callable[[Item], Result]:
    """A function that does the work in another process or thread with the budget of this one."""
    return partial(_allowed, _MAX_DECODED.get(), work)


def _allowed(size: int, work: Callable[[Item], Result], item: Item) -> Result:
    with max_decoded(size):
        return work(item)
