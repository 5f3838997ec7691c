from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from lae_sim.comparison.fidelity import ClosedLoopSpread, FidelityRow
from lae_sim.report.comparison import fidelity_table, fidelity_verdicts, spread_table

ROW = FidelityRow(
    closed_loop="c.parquet",
    forecaster="hold",
    replay="every-frame",
    sequence="car",
    closed_auc=0.5,
    auc=0.6,
    d_auc=0.1,
    closed_dp20=0.5,
    dp20=0.6,
    d_dp20=0.1,
    parted=None,
    approximate_outputs=3,
    disagreement=None,
    auc_low=None,
    auc_high=None,
    covered=None,
    dp20_low=None,
    dp20_high=None,
    covered_dp20=None,
    c_known=None,
    trace="t.parquet",
    tracker="dcf",
    setting="47 ms",
)


def modelled(sequence: str = "car", d: float = 0.01, **more: Any) -> FidelityRow:
    ends = {"auc_low": 0.48, "auc_high": 0.54, "covered": True, "c_known": True}
    values = {"replay": "modelled", "sequence": sequence, "d_auc": d, "auc": 0.5 + d}
    return replace(ROW, **{**values, **ends, **more})


def test_a_verdict_says_how_far_and_where_not() -> None:
    rows = [ROW, replace(ROW, replay="strided", d_auc=-0.03)]
    rows += [modelled(), modelled("bike", -0.07, covered=False), modelled("boat", 0.02)]
    rows += [replace(row, forecaster="kalman", d_auc=0.9) for row in rows]
    spreads = [
        ClosedLoopSpread("t.parquet", "47 ms", "hold", "boat", 3, 0.4, 0.6, 0.4, 0.6, 0.2),
        ClosedLoopSpread("t.parquet", "47 ms", "hold", "car", 3, 0.4, 0.41, 0.4, 0.4, 0.01),
        ClosedLoopSpread("t.parquet", "47 ms", "kalman", "car", 3, 0.4, 0.6, 0.4, 0.4, 0.2),
        ClosedLoopSpread("u.parquet", "47 ms", "hold", "car", 3, 0.4, 0.6, 0.4, 0.4, 0.2),
    ]
    (verdict,) = fidelity_verdicts(rows, spreads)
    assert verdict == (
        "Modelled replays of dcf are within 0.033 AUC of its closed loops on average (strided "
        "passes 0.030, recorded boxes alone 0.100); 95 % intervals cover 67% of 3 closed-loop "
        "runs, 0.060 wide; do not trust them on bike (off by more than 0.05 on average) and boat "
        "(closed loops of one setting differ by more than 0.02 among themselves: a single figure "
        "is luck)."
    )


@pytest.mark.parametrize(
    ("rows", "parts"),
    [
        ([ROW], ["Replays of recorded boxes alone of dcf are within 0.100", "do not trust"]),
        (
            [ROW, modelled(c_known=False)],
            ["the range assumed of its reach covers 100% of 1", "on no sequence"],
        ),
        ([replace(ROW, d_auc=float("nan"))], ["No sequence of dcf has a score."]),
    ],
)
def test_verdicts_of_what_is_not_known(rows: list[FidelityRow], parts: list[str]) -> None:
    (verdict,) = fidelity_verdicts(rows, ())
    for part in parts:
        assert part in verdict


def test_each_tracker_has_its_verdict() -> None:
    verdicts = fidelity_verdicts([ROW, replace(ROW, tracker="nano", d_auc=0.0)], ())
    assert [" of dcf " in each for each in verdicts] == [True, False]


def test_tables_show_intervals_where_there_are_some() -> None:
    text = fidelity_table([ROW, modelled(), modelled(covered=False)])
    assert [line.split()[-8] for line in text.splitlines()[2:]] != []
    assert "0.510 [0.480, 0.540]" in text
    assert [" yes " in line for line in text.splitlines()[2:]] == [False, True, False]
    assert [" no " in line for line in text.splitlines()[2:]] == [False, False, True]
    assert "covered" not in fidelity_table([ROW])
    one = ClosedLoopSpread("t.parquet", "47 ms", "hold", "boat", 3, 0.4, 0.6, 0.4, 0.6, 0.2)
    assert "t.parquet" not in spread_table([one])
    assert "u.parquet" in spread_table([one, replace(one, trace="u.parquet")])
