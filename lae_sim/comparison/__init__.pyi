from .fidelity import (
    ClosedLoopSpread,
    FidelityRow,
    FidelitySummary,
    closed_loop_spreads,
    compare_closed_loops,
    summarise_closed_loops,
    summarise_replays,
)
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
    "ClosedLoopSpread",
    "Difference",
    "FidelityRow",
    "FidelitySummary",
    "Interval",
    "by_attribute",
    "closed_loop_spreads",
    "compare_closed_loops",
    "fitted",
    "holm",
    "over_sigmas",
    "score_forecasters",
    "signed_rank_p",
    "summarise",
    "summarise_closed_loops",
    "summarise_replays",
]
