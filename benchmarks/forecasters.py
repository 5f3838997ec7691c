"""How much of what latency costs forecasters win back: ``benchmarks/forecasters.py TRACE ...``.

For each trace of every frame a row: the share of the AUC lost to latency that each forecaster wins
back, in %, at constant 20, 47, 68 and 167 ms, and the least that it wins over hold at any of them,
in AUC and DP. It makes the table of the README; ``--json`` gives all figures.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from lae_sim import evaluate, read_trace
from lae_sim.report.table import aligned

LATENCIES = ("20ms", "47ms", "68ms", "167ms")


def measured(path: str, forecasters: list[str]) -> list[dict[str, Any]]:
    """The scores of each forecaster at each latency."""
    trace = read_trace(path)
    found = []
    for latency in LATENCIES:
        result = evaluate(
            trace,
            forecasters=["hold", *forecasters],
            latency=f"constant:{latency}",
            search="off",
        )
        hold, *others = result.summary.to_dict("records")
        for row in others:
            figures = {name: row[name] for name in ("auc", "dp20", "offline_auc", "recovered_auc")}
            over = {f"{name}_over_hold": row[name] - hold[name] for name in ("auc", "dp20")}
            place = {"trace": Path(path).stem, "latency": latency, "forecaster": row["forecaster"]}
            found.append({**place, **figures, **over})
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("traces", nargs="+", metavar="TRACE")
    parser.add_argument("--forecaster", nargs="+", default=["learned", "kalman", "least-squares"])
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for path in arguments.traces:
        rows += measured(path, arguments.forecaster)
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return
    header = ["trace", *arguments.forecaster, "least over hold, AUC and DP"]
    table = []
    for trace in dict.fromkeys(row["trace"] for row in rows):
        cells = [trace]
        least = []
        for forecaster in arguments.forecaster:
            own = [r for r in rows if (r["trace"], r["forecaster"]) == (trace, forecaster)]
            cells.append(" / ".join(f"{100 * row['recovered_auc']:.0f}" for row in own))
            lows = (min(row[f"{name}_over_hold"] for row in own) for name in ("auc", "dp20"))
            least.append(" ".join(f"{low:+.4f}" for low in lows))
        table.append([*cells, "; ".join(least)])
    print(aligned(header, table, labels=1))


if __name__ == "__main__":
    main()
