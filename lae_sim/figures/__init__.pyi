from .film import Scene, draw_frame, film_strip
from .lines import draw_curves
from .pipeline import waterfall_figure
from .replay import (
    fidelity_figure,
    success_and_precision,
    sweep_figure,
    timeline_figure,
)
from .style import save

__all__ = [
    "Scene",
    "draw_curves",
    "draw_frame",
    "fidelity_figure",
    "film_strip",
    "save",
    "success_and_precision",
    "sweep_figure",
    "timeline_figure",
    "waterfall_figure",
]
