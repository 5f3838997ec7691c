"""Where the checkout is, and what may lie beside it."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

REPOSITORY = Path(__file__).resolve().parents[1]
TRACES = REPOSITORY / "traces"
SHARED = REPOSITORY.parent / "shared"


def benchmark(name: str) -> ModuleType:
    """A module of ``benchmarks``, which is no package: its modules find each other beside them."""
    folder = str(REPOSITORY / "benchmarks")
    sys.path.insert(0, folder)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(folder)
