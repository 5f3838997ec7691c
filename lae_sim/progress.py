"""The progress bar of what takes long."""

from __future__ import annotations

import sys
import warnings
from contextlib import suppress
from typing import Any

SOON_S = 0.5
"""What is done sooner shows no bar, unless it is asked for."""


def tell(text: str, end: str = "\n") -> None:
    """Write to the standard error stream; where nobody reads it any more, the work goes on."""
    if sys.stderr is not None:  # print would take the standard output
        with suppress(OSError, ValueError):  # ValueError: it is closed
            print(text, end=end, file=sys.stderr, flush=True)


class ProgressBar:
    """A bar on the standard error stream; ``bar(done, total)`` moves it.

    It appears with the first call, and must be closed before anything else is printed.

    Args:
        title: what stands before it.
        unit: what is counted, in the plural.
        show: whether to show it; by default where somebody looks, on a terminal or in a notebook.

    Attributes:
        shown: whether it is shown.
    """

    def __init__(self, title: str, unit: str, show: bool | None = None) -> None:
        self._title, self._unit = str(title), unit
        self.shown = _somebody_looks() if show is None else show
        self._delay = 0.0 if show else SOON_S
        self._bar: Any = None

    def __call__(self, done: int, total: int | None, what: str = "") -> None:
        """Show that ``done`` of ``total`` are done, and perhaps what is going on."""
        if not self.shown:
            return
        if self._bar is None:
            self._bar = _tqdm()(
                desc=self._title,
                total=total,
                unit=f" {self._unit}",
                unit_scale=self._unit == "frames",
                delay=self._delay,
            )
        if what:
            self._bar.set_description(what, refresh=False)
        self._bar.total = total
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _somebody_looks() -> bool:
    stream = sys.stderr
    return (stream is not None and stream.isatty()) or _in_notebook()


def _in_notebook() -> bool:
    shell: Any = sys.modules.get("IPython")
    running = shell.get_ipython() if shell is not None else None
    return running is not None and hasattr(running, "kernel")


def _tqdm() -> Any:
    """A bar of text, or in a notebook that has widgets one of these."""
    if not _in_notebook():
        from tqdm import tqdm

        return tqdm
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tqdm says that there are no widgets
        from tqdm.auto import tqdm as automatic
    return automatic
