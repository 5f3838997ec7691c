"""Traces whose names hold what a page, a table and LaTeX must escape."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

NASTY = '<script>alert(1)</script> a_b & 50% #1 $x$ {~^\\} "q"\'\u2028'


def nasty_traces(folder: Path) -> list[str]:
    """Two traces of one dataset whose names and notes would like to be code."""
    found = []
    for name, error, ms in (("one", 2.0, 47), ("two", 5.0, 20)):
        recordings = []
        for s in range(3):
            random = np.random.default_rng(s)
            truth = np.cumsum(random.normal(0, 4, (40, 4)), axis=0) + [300, 200, 60, 50]
            truth[:, 2:] = 60 + 10 * s
            boxes = truth + random.normal(0, error, truth.shape)
            elapsed = np.full(40, ms * 1_000_000)
            recordings.append(Recording.new(f"s{s} {NASTY}", truth, boxes, elapsed))
        metadata = Metadata.new(
            "30",
            "every-frame",
            tracker={"name": NASTY + name, "url": "https://example.com/</script>"},
            dataset={"name": f"data {NASTY}"},
            device={"model": NASTY},
            sequences={r.name: {"attributes": [f"fast {NASTY}"]} for r in recordings[:2]},
        )
        path = folder / f"{name}.parquet"
        write_trace(Trace(metadata, recordings), path)
        found.append(str(path))
    return found
