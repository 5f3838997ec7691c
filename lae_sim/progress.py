"""What a command says while and after it works: lines, and the progress bar of what takes long.

All that is printed goes through here, where nothing that a file holds can move the cursor, change
what stands on the screen, or fail for want of a letter.
"""

from __future__ import annotations

import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeAlias

from lae_sim.errors import LaeError, abridged, shown, visible

SOON_S = 0.5
"""What is done sooner shows no bar, unless it is asked for."""


def tell(text: str, end: str = "\n", keep: str = "\n") -> None:
    """Write to the standard error stream; where nobody reads it any more, the work goes on.

    Args:
        text: what there is to say.
        end: what follows it.
        keep: control characters that are meant to do what they do.
    """
    if sys.stderr is not None:  # print would take the standard output
        with suppress(OSError, ValueError):  # ValueError: it is closed
            print(visible(text, keep), end=end, file=sys.stderr, flush=True)


class OutputError(LaeError):
    """What was to be printed could not be; nobody has seen it."""


def print_text(text: str, end: str = "\n") -> None:
    """Write to the standard output; what its encoding has not is replaced by question marks.

    Raises:
        BrokenPipeError: if nobody reads it any more.
        OutputError: if it takes no more for another reason, such as a full disk.
    """
    if sys.stdout is None:
        return
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    shown = visible(text, keep="\n").encode(encoding, "replace").decode(encoding)
    with printing():
        print(shown, end=end)


def screen_width() -> int | None:
    """How many letters a line of the terminal holds that shows the standard output; else None."""
    if sys.stdout is None or not sys.stdout.isatty():
        return None
    return shutil.get_terminal_size().columns


@contextmanager
def printing() -> Iterator[None]:
    """Say what is amiss where the standard output takes no more.

    Raises:
        BrokenPipeError, OutputError: see :func:`print_text`.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"the standard output: {error.strerror or error}") from error


ShowProgress: TypeAlias = bool | Callable[[int, int | None, str], object] | None
"""Whether to show a progress bar, by default where somebody looks, on a terminal or in a notebook;
or what is called instead, ``progress(done, total, what)``: how much is done of how much, None where
that is not known, and what is going on, perhaps empty."""


class ProgressBar:
    """A bar on the standard error stream; ``bar(done, total)`` moves it.

    It appears with the first call, and must be closed before anything else is printed.

    Args:
        title: what stands before it.
        unit: what is counted, in the plural.
        show: whether to show it, or what is called instead (see :data:`ShowProgress`).

    Attributes:
        shown: whether it is shown.

    Raises:
        LaeError: if ``show`` is neither.
    """

    def __init__(self, title: str, unit: str, show: ShowProgress = None) -> None:
        if not (show is None or isinstance(show, bool) or callable(show)):
            raise LaeError(f"progress: {shown(show)} is neither true, false nor a function")
        self._title, self._unit = abridged(visible(title), 60), unit
        self._report = show if callable(show) else None
        self.shown = _somebody_looks() if show is None else show is True
        self._delay = 0.0 if show else SOON_S
        self._bar: Any = None

    def __call__(self, done: int, total: int | None, what: str = "") -> None:
        """Show that ``done`` of ``total`` are done, and perhaps what is going on."""
        if self._report is not None:
            self._report(done, total, what)
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
            self._bar.set_description(abridged(visible(what), 60), refresh=False)
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
