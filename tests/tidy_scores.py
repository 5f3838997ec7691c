"""Tables of scores as comparisons make them."""

from __future__ import annotations

import numpy as np
import pandas as pd


def random_scores(seed=0, count=12, names=("hold", "kalman", "mine")):
    """Scores between those of hold and offline, about."""
    random = np.random.default_rng(seed)
    offline = random.uniform(0.4, 0.8, count)
    scores = {name: offline - random.uniform(0.02, 0.2, count) for name in names}
    scores["hold"] = offline - random.uniform(0.1, 0.3, count)
    return {**scores, "offline": offline}


def tidy(scores, trace="a", latency="recorded", dataset="D", metric="auc", scale=1.0, sigma=0.0):
    """A tidy table of scores by forecaster, a list over sequences each."""
    rows = [
        (trace, dataset, f"s{i:02}", latency, scale, forecaster, sigma, metric, value)
        for forecaster, values in scores.items()
        for i, value in enumerate(values)
    ]
    columns = ["trace", "dataset", "sequence", "latency", "scale", "forecaster", "sigma", "metric"]
    return pd.DataFrame(rows, columns=[*columns, "value"])
