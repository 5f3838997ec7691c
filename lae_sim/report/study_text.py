"""The summary of a study as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from lae_sim.report.study_view import SETTINGS, eval_scale, primary, several
from lae_sim.report.table import p_label, table
from lae_sim.study.summary import MEAN, Row

if TYPE_CHECKING:
    from lae_sim.study.run import StudyResults


def study_text(results: StudyResults) -> str:
    """The summary's tables, then what they rest on."""
    rows = primary(results.summary)
    parts = [ranking(rows)]
    if any(row["repetitions"] > 1 for row in rows) or len(results.comparisons) <= 30:
        parts.append(comparisons(results.comparisons))
    parts += [requirements(results.required)] if results.required else []
    told = [f"{len(results.plan.cells)} cells, {results.computed} of them computed now"]
    approximate = [row["approximate_share"] for row in rows if not row["exact"]]
    if approximate:
        told.append(
            f"approximate: up to {100 * max(approximate):.3g}% of the outputs of a replay follow "
            "another frame than when recorded"
        )
    told += [f"not computed: {each['of']}: {each['reason']}" for each in results.failures]
    return "\n\n".join([part for part in parts if part] + ["\n".join([*told, *results.notes()])])


def ranking(rows: Sequence[Row]) -> str:
    """A line per trace, setting and forecaster, the best AUC of a setting first."""
    differ = ["dataset"] * (len({row["dataset"] for row in rows}) > 1) + several(rows)
    header = [
        *differ,
        "trace",
        "forecaster",
        "n",
        "AUC",
        "offline",
        "recovered",
        "vs hold",
        "p",
        "DP@20",
    ]
    header += ["jitter of AUC"] if any("auc_jitter_low" in row for row in rows) else []
    header += ["ms/call", "skipped", "age ms", "front"]
    lines = []
    order = {tuple(row[name] for name in differ): i for i, row in reversed([*enumerate(rows)])}
    for row in sorted(
        rows, key=lambda row: (order[tuple(row[name] for name in differ)], -(row["auc"] or 0))
    ):
        line = [*(row[name] for name in differ), row["trace"], row["forecaster"]]
        line += [str(row["sequences"]), interval(row, "auc"), number(row["offline_auc"])]
        line += [percent(row.get("recovered_auc")), signed(row.get("vs_hold_auc"))]
        p = row.get("vs_hold_auc_p")
        line += ["-" if p is None else p_label(p), number(row["dp20"])]
        if "jitter of AUC" in header:
            line.append(ends(row, "auc_jitter"))
        line += [
            number(row["elapsed_ms"], ".1f"),
            percent(row["skip_rate"]),
            age(row.get("age_ms")),
        ]
        lines.append([*line, "*" if row["pareto"] else ""])
    told = ", ".join(f"{name} {rows[0][name]}" for name in SETTINGS[1:] if name not in differ)
    sigma = rows[0]["sigma"]
    told += ", mean over sigma = 0, 0.02, ..., 1" if sigma == MEAN else f", sigma {sigma}"
    return "\n".join(
        [
            told,
            table(header, lines, len(differ) + 2),
            "[ ]: 95 % bootstrap over sequences; jitter: 95 % of the repetitions; p: Wilcoxon's "
            "signed-rank test;\nn: sequences; front: with this forecaster no other trace is both "
            "faster and better" + "; age at the first sigma" * (sigma == MEAN),
        ]
    )


def comparisons(rows: Sequence[Row]) -> str:
    """A line per pair of traces."""
    if not rows:
        return ""
    differ = [name for name in ("dataset", *SETTINGS[1:]) if len({row[name] for row in rows}) > 1]
    header = [
        *differ,
        "forecaster",
        "a",
        "b",
        "n",
        "AUC of a - b",
        "p",
        "p (Holm)",
        "a better here",
        "a better",
    ]
    lines = [
        [*(row[name] for name in differ), row["forecaster"], row["a"], row["b"]]
        + [
            str(row["sequences"]),
            interval(row, "difference", "+.3f"),
            p_label(row["p"]),
            p_label(row["p_holm"]),
        ]
        + [number(row["better_here"], ".2f"), number(row["better"], ".2f")]
        for row in rows
    ]
    return table(header, lines, len(differ) + 3) + (
        "\na better here: probability that one run of a beats one of b on these sequences; "
        "a better: on others like them"
    )


def requirements(rows: Sequence[Row]) -> str:
    """A line per trace, setting and forecaster: how slow it may be."""
    differ = [name for name in ("policy", "fps", "convention") if len({r[name] for r in rows}) > 1]
    header = ["trace", "times from", "latency", *differ, "forecaster", "AUC asked"]
    header += ["without latency"]
    header += ["times at most", "AUC there", "speed-up needed", "world fps at most"]
    lines = [
        [row["trace"], row["times_from"], row["latency"], *(row[name] for name in differ)]
        + [row["forecaster"]]
        + [number(row["required_auc"]), number(row["auc_without_latency"])]
        + ["-" if row["scale"] is None else _most(row)]
        + [number(row["auc"]), number(row["speed_up"], ".2f"), number(row["fps_at_most"], ".1f")]
        for row in rows
    ]
    return table(header, lines, 4 + len(differ)) + (
        f"\ntimes at most: by bisection, in steps of 0.01; all at sigma {rows[0]['sigma']}; world "
        "fps at most: how fast the\nworld may move, with the recorded motion from frame to frame "
        "(unknown where a cost or a policy has a time of its own)"
    )


def _most(row: Row) -> str:
    """The scale of a requirement, and whether the search ended there."""
    return f"{'x' if row['beyond'] else 'x >='} {eval_scale(row['scale']):g}"


def interval(row: Row, name: str, form: str = ".3f") -> str:
    """A value with its interval, where it has one."""
    value = row[name]
    text = number(value, form)
    return text if f"{name}_low" not in row else f"{text} {ends(row, name, form)}"


def ends(row: Row, name: str, form: str = ".3f") -> str:
    """The ends of an interval."""
    if f"{name}_low" not in row:
        return "-"
    return f"[{row[f'{name}_low']:{form}}, {row[f'{name}_high']:{form}}]"


def number(value: float | None, form: str = ".3f") -> str:
    """A number, or a dash for what is unknown."""
    return "-" if value is None else f"{value:{form}}"


def signed(value: float | None) -> str:
    """A difference."""
    return number(value, "+.3f")


def percent(value: float | None) -> str:
    """A share in percent."""
    return "-" if value is None else f"{100 * value:.1f}%"


def age(value: float | None) -> str:
    """Milliseconds."""
    return number(value, ".0f")
