"""Where the checkout is, and what may lie beside it."""

from __future__ import annotations

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
TRACES = REPOSITORY / "traces"
SHARED = REPOSITORY.parent / "shared"
