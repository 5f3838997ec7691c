from .comparison import ComparisonResult, compare_forecasters
from .evaluation import EvaluationResult, evaluate
from .study import run_study

__all__ = [
    "ComparisonResult",
    "EvaluationResult",
    "compare_forecasters",
    "evaluate",
    "run_study",
]
