"""The errors that a user meets; command lines print them without a traceback."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager


class LaeError(Exception):
    """An input or a setting that cannot be used; the message says where and what to do."""


class TraceError(LaeError):
    """A trace that is missing, damaged, or breaks the format (see ``traces/FORMAT.md``)."""


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn whatever a user's code raises into a LaeError that begins with ``what``."""
    try:
        yield
    except LaeError:
        raise
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        message = " ".join(str(error).split())[:300]
        raise LaeError(
            f"{what}: {type(error).__name__}: {message} ({last.filename}, line {last.lineno})"
        ) from error
