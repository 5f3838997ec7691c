from .comparison import comparison_table, fidelity_verdicts
from .page import write_report
from .reach import ReachReport, reach_figure
from .study_tables import write_tables
from .table import Column, Table

__all__ = [
    "Column",
    "ReachReport",
    "Table",
    "comparison_table",
    "fidelity_verdicts",
    "reach_figure",
    "write_report",
    "write_tables",
]
