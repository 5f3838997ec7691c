"""The errors that a user meets; command lines print them without a traceback."""

from __future__ import annotations

import difflib
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

_SCREEN = 1200
"""Characters of an error that are read at a glance: some 15 lines of a terminal."""


class LaeError(Exception):
    """An input or a setting that cannot be used; the message says where and what to do.

    As text it is one line that a terminal can show: with control characters as :func:`visible`
    writes them, and of a very long message its beginning and its end.

    Example:
        >>> import lae_sim
        >>> try:
        ...     lae_sim.evaluate("traces/synthetic-slow.parquet", latency="constant:47")
        ... except lae_sim.LaeError as error:
        ...     print(error)
        latency: '47' is not a duration: write it with its unit, such as 47ms
    """

    def __str__(self) -> str:
        return abridged(visible(super().__str__()))


class TraceError(LaeError):
    """A trace that is missing, damaged, or breaks the format (see ``traces/FORMAT.md``).

    Example:
        >>> import lae_sim
        >>> try:
        ...     lae_sim.read_trace("nowhere.parquet")
        ... except lae_sim.TraceError as error:
        ...     print(error)
        nowhere.parquet: no such file
    """


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn whatever a user's code raises into a LaeError that begins with ``what``."""
    try:
        yield
    except LaeError:
        raise
    except Exception as error:
        raise LaeError(f"{what}: {described(error)}") from error


def described(error: BaseException) -> str:
    """An error that was caught, in one line: its type, its message and where it was raised."""
    try:
        message = one_line(str(error)[:1000])[:300]
    except Exception:  # a user's own error may fail in saying what it is
        message = ""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    kind = "out of memory: " if isinstance(error, MemoryError) else ""
    return f"{kind}{type(error).__name__}{message and ': '}{message}{place}"


def shown(value: object) -> str:
    """A value in one line of at most 60 characters."""
    try:
        text = one_line(repr(value)[:1000])
    except Exception:  # a user's object, or an integer of thousands of digits
        text = f"<{type(value).__name__}>"
    return text if len(text) <= 60 else f"{text[:57]}..."


def one_line(text: str) -> str:
    """Text without line breaks, with whatever else does not print as :func:`visible` writes it."""
    return visible(" ".join(text.split()))


def visible(text: object, keep: str = "") -> str:
    r"""Text whose control characters, which a terminal would obey, are seen as escapes.

    So are marks that turn the direction of writing, and halves of characters, which no file can
    hold.

    Args:
        text: what a file, a name or another program's error holds.
        keep: characters that stay, such as line breaks.

    Example:
        >>> print(visible("car\x1b[2J\u202e"))
        car\x1b[2J\u202e
    """
    text = str(text)
    if text.translate(dict.fromkeys(map(ord, keep))).isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text
    )


def abridged(text: str, most: int = _SCREEN) -> str:
    """A text of at most so many characters: of a longer one, its beginning and its end."""
    if len(text) <= most:
        return text
    end = most // 4
    return f"{text[: most - end - 5]} ... {text[-end:]}"


def install(extra: str) -> str:
    """The command that installs what an extra of this package needs, to end a message with."""
    return f"pip install 'lae-sim[{extra}]'"


def listed(names: Iterable[object], most: int = 5) -> str:
    """Names, each of at most 60 characters: some of them, and how many more there are."""
    texts = [abridged(str(name), 60) for name in names]
    more = f" and {len(texts) - most:,} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def hint(name: object, known: Iterable[str]) -> str:
    """What was perhaps meant by a name that is not known, to end a message with."""
    others = [each for each in known if each != name]
    close = difflib.get_close_matches(name, others, 1) if isinstance(name, str) else []
    return f"; did you mean {close[0]!r}?" if close else ""
