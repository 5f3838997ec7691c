"""What figures and tables call metrics and settings, and say of pipelines."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

METRIC_LABELS = {
    "auc": "AUC",
    "dp20": "DP@20",
    "norm_dp20": "norm. P",
    "norm_auc": "norm. AUC",
    "mauc": "mAUC",
    "mdp20": "mDP@20",
    "modelled_auc": "modelled AUC",
    "modelled_dp20": "modelled DP@20",
    "modelled_mauc": "modelled mAUC",
    "modelled_mdp20": "modelled mDP@20",
}


def setting_label(latency: str, scale: float) -> str:
    """A latency and its scale, such as ``"recorded x 2"``."""
    return latency if scale == 1 else f"{latency} x {scale:g}"


def bottleneck_text(pipeline: dict[str, Any]) -> str:
    """The first stage of a pipeline that is too slow, in a sentence; or that none is."""
    if pipeline["bottleneck"] is not None:
        return str(pipeline["bottleneck"]["text"])
    loads = [(each["load"], each["stage"]) for each in pipeline["stages"]]
    loads += [(each["load"], each["resource"]) for each in pipeline["resources"]]
    load, busiest = max(loads, key=itemgetter(0))
    return f"every stage keeps up; {busiest}, the busiest, with {load:.0%} of what it can do"
