from .comparison import comparison_table
from .figures import draw_curves, success_and_precision, sweep_figure, timeline_figure
from .film import Scene, draw_frame, film_strip
from .page import write_report
from .study_tables import write_tables
from .table import Column, Table

__all__ = [
    "Column",
    "Scene",
    "Table",
    "comparison_table",
    "draw_curves",
    "draw_frame",
    "film_strip",
    "success_and_precision",
    "sweep_figure",
    "timeline_figure",
    "write_report",
    "write_tables",
]
