from .comparison import comparison_table, fidelity_verdicts
from .fidelity_figure import fidelity_figure
from .figures import draw_curves, success_and_precision, sweep_figure, timeline_figure
from .film import Scene, draw_frame, film_strip
from .page import write_report
from .reach import ReachReport, reach_figure
from .study_tables import write_tables
from .table import Column, Table

__all__ = [
    "Column",
    "ReachReport",
    "Scene",
    "Table",
    "comparison_table",
    "draw_curves",
    "draw_frame",
    "fidelity_figure",
    "fidelity_verdicts",
    "film_strip",
    "reach_figure",
    "success_and_precision",
    "sweep_figure",
    "timeline_figure",
    "write_report",
    "write_tables",
]
