"""Tests of what can be computed by NumPy and by compiled kernels, and gives the same bits."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from lae_sim._compiled import SWITCH

try:
    import numba  # noqa: F401

    HAS_NUMBA = True
except ImportError:
    HAS_NUMBA = False

needs_numba = pytest.mark.skipif(not HAS_NUMBA, reason="numba comes with the extra fast")

BOTH_WAYS = [pytest.param("0", id="numpy"), pytest.param("1", id="compiled", marks=needs_numba)]
"""Values of :data:`lae_sim._compiled.SWITCH`."""


@contextmanager
def switched(value: str) -> Iterator[None]:
    """With the switch at a value, inside a test that draws examples."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[SWITCH]
        else:
            os.environ[SWITCH] = before
