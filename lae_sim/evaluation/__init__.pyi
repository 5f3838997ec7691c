from .caveats import notes_on
from .evaluate import (
    Answers,
    Evaluation,
    Observer,
    ScoredRun,
    answers,
    evaluate_groups,
    evaluate_runs,
)
from .events import Event, event_log
from .metrics import CONVENTIONS, Convention, find_convention, precision_curve, success_curve
from .pairing import Pairing, pair
from .totals import Totals

__all__ = [
    "CONVENTIONS",
    "Answers",
    "Convention",
    "Evaluation",
    "Event",
    "Observer",
    "Pairing",
    "ScoredRun",
    "Totals",
    "answers",
    "evaluate_groups",
    "evaluate_runs",
    "event_log",
    "find_convention",
    "notes_on",
    "pair",
    "precision_curve",
    "success_curve",
]
