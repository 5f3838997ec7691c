"""The progress bar of commands that take long."""

from __future__ import annotations

from typing import Any


class ProgressBar:
    """A bar on the standard error stream, if that is a terminal; ``bar(done, total)`` moves it.

    It appears with the first call, and must be closed before anything else is printed.

    Args:
        title: what stands before it.
        unit: what is counted, in the plural.
    """

    def __init__(self, title: str, unit: str) -> None:
        self._title, self._unit = title, unit
        self._bar: Any = None

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` are done."""
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc=self._title, unit=f" {self._unit}", disable=None)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
