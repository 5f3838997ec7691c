from .fidelity import FidelityRow, FidelitySummary, compare_closed_loops, summarise_closed_loops
from .forecasters import fitted, score_forecasters
from .statistics import (
    Bootstrap,
    Difference,
    Interval,
    by_attribute,
    holm,
    over_sigmas,
    signed_rank_p,
    summarise,
)

__all__ = [
    "Bootstrap",
    "Difference",
    "FidelityRow",
    "FidelitySummary",
    "Interval",
    "by_attribute",
    "compare_closed_loops",
    "fitted",
    "holm",
    "over_sigmas",
    "score_forecasters",
    "signed_rank_p",
    "summarise",
    "summarise_closed_loops",
]
