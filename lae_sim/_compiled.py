"""Compiled forms of the hot loops, where numba is installed: the extra ``fast``.

A room that has some keeps them as plain functions in a module called ``kernels``, which is imported
only where they are used: importing numba and loading them takes half a second. What a kernel makes
is what NumPy's lines beside its call make, to the last bit. So it does the same operations in the
same order, on the same 64 bits; it takes no sum of many floats, which NumPy adds in an order of its
own, and no power, logarithm or exponential, which NumPy rounds in its own way. And nothing is
contracted to a fused multiplication and addition: LLVM may do that only under ``fastmath``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

SWITCH = "LAE_SIM_COMPILED"
"""The environment variable that has kernels used never, if it is 0, or always, if it is 1."""

_LEAST = 40_000_000  # see amount; what kernels win is then more than it takes to load them

Function = TypeVar("Function", bound=Callable[..., Any])


def amount(frames: int, sigmas: int) -> int:
    """How much it is to replay so many world frames, and to score one forecaster's answers.

    Replaying them takes about as long as scoring ten permitted latencies does.
    """
    return frames * (sigmas + 10)


def expect(work: int) -> None:
    """Load numba if this process is going to do so much work that it pays.

    By how much there is, and not by the clock: the same command goes the same way each time.
    """
    if work >= _LEAST and _switch() != "0":
        _numba_works()


def compiled() -> bool:
    """Whether kernels are to be used: if they are not switched off, and numba is loaded."""
    switch = _switch()
    return switch != "0" and (switch == "1" or "numba" in sys.modules) and _numba_works()


def _switch() -> str | None:
    return os.environ.get(SWITCH)


@cache
def _numba_works() -> bool:
    """Whether numba is here, and runs with this NumPy: an older one refuses a newer NumPy."""
    try:
        import numba  # noqa: F401
    except Exception:  # an ImportError, or whatever a broken installation raises
        return False
    return True


def kernel(function: Function) -> Function:
    """Compile a function when it is first called, and keep that for other processes.

    It is kept beside the module or, where that cannot be written, in the user's cache, by numba's
    rules (``NUMBA_CACHE_DIR`` names another folder); where nothing can be written, nowhere. What is
    kept is compiled anew when the module has changed, but not when another one has from which it
    imports a kernel.
    """
    from numba import njit

    options = {"nogil": True, "error_model": "numpy"}
    try:
        made: Function = njit(function, cache=True, **options)
    except RuntimeError:  # there is no folder to keep it in
        made = njit(function, **options)
    return made
