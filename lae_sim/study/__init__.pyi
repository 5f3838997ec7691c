from .records import Comparison, Failure, Requirement, SummaryRow
from .run import StudyResults, compute_study
from .spec import Study, read_study

__all__ = [
    "Comparison",
    "Failure",
    "Requirement",
    "Study",
    "StudyResults",
    "SummaryRow",
    "compute_study",
    "read_study",
]
