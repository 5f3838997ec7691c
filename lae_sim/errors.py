"""The two errors that a user meets; command lines print them without a traceback."""

from __future__ import annotations


class LaeError(Exception):
    """An input or a setting that cannot be used; the message says where and what to do."""


class TraceError(LaeError):
    """A trace that is missing, damaged, or breaks the format (see ``traces/FORMAT.md``)."""
