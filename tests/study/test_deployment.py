"""How slow a tracker may be: what is tried, and what is said where the AUC knows no order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import REPOSITORY

from lae_sim.study.deployment import MOST, STEP, Curve, _nearest, requirement, scan, searches
from lae_sim.study.plan import make_plan
from lae_sim.study.records import Requirement
from lae_sim.study.run import compute_study
from lae_sim.study.spec import Study

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
ASKED = Fraction(1, 2)


def stepped(*levels: tuple[int, float]) -> Callable[[int], float]:
    """An AUC that has each level from a step on, in hundredths of the scale."""

    def auc(step: int) -> float:
        return next(level for start, level in reversed(levels) if step >= start)

    return auc


def asked(auc: Callable[[int], float], required: Fraction = ASKED, **study: Any) -> Requirement:
    """What is said of a tracker whose AUC at each scale is known, at 20 ms a frame."""
    tried = scan(auc, [required])
    elapsed = [0.2 * step for step in tried]
    [search] = searches(
        make_plan(Study((str(SLOW),), forecasters=("hold",), **study)).cells, [required]
    )
    return requirement(search, Curve([*tried], [*tried.values()], elapsed), required)


def test_a_steady_fall_has_one_end() -> None:
    found = asked(lambda step: 0.75 - step / 800)
    assert (found.scale, found.safe_scale, found.beyond) == (2, 2, Fraction(201, 100))
    assert found.stretches == ((0, 2),)
    assert found.safe_ms_per_frame == pytest.approx(40)
    assert found.safe_frames_per_second == pytest.approx(25)
    assert found.flat()["stretches"] == "0 to 2"


def test_no_order_is_assumed() -> None:
    """A stall that only faster times run into, as one of ORTrack's."""
    found = asked(stepped((0, 0.6), (13, 0.4), (44, 0.55), (308, 0.3)))
    assert found.stretches == (
        (0, Fraction(12, 100)), (Fraction(44, 100), Fraction(307, 100)),
    )  # fmt: skip
    assert found.safe_scale == Fraction(307, 100)
    assert found.scale == Fraction(12, 100)  # by bisection, which does assume it
    assert (found.safe_auc, found.next_auc) == (0.55, 0.3)


def test_a_stretch_that_comes_again_is_not_safe() -> None:
    """Calls of three frames of the camera are in step with it; a little faster ones are not."""
    found = asked(stepped((0, 0.6), (190, 0.4), (207, 0.52), (240, 0.4)))
    assert found.safe_scale == Fraction(189, 100)
    assert found.stretches[1:] == ((Fraction(207, 100), Fraction(239, 100)),)
    assert found.next_auc == 0.4


def test_a_tracker_that_must_be_faster() -> None:
    assert asked(stepped((0, 0.6), (37, 0.4))).safe_scale == Fraction(36, 100)
    # and where only slower times are enough, those that are nearest
    assert asked(stepped((0, 0.4), (130, 0.6), (170, 0.4))).safe_scale == Fraction(169, 100)


def test_where_only_no_latency_at_all_is_enough() -> None:
    found = asked(stepped((0, 0.6), (1, 0.4)))
    assert (found.safe_scale, found.scale, found.beyond) == (0, 0, STEP)
    assert (found.safe_ms_per_frame, found.safe_frames_per_second, found.speed_up) == (None,) * 3


def test_where_nothing_is_enough_and_where_everything_is() -> None:
    found = asked(lambda step: 0.4)
    assert (found.scale, found.safe_scale, found.safe_auc, found.next_auc) == (None,) * 4
    assert (found.beyond, found.beyond_auc, found.stretches) == (0, 0.4, ())
    found = asked(lambda step: 0.6)
    assert found.scale == found.safe_scale == MOST * STEP
    assert (found.beyond, found.next_auc) == (None, None)


@given(
    st.lists(st.tuples(st.integers(0, 900), st.sampled_from([0.3, 0.45, 0.55, 0.7])), min_size=1),
    st.lists(st.sampled_from([Fraction(2, 5), ASKED, Fraction(3, 5)]), min_size=1, unique=True),
)
def test_what_is_said_is_true_of_any_curve(
    levels: Sequence[tuple[int, float]], required: list[Fraction]
) -> None:
    auc, calls = stepped((0, 0.9), *sorted(levels)), []

    def counted(step: int) -> float:
        calls.append(step)
        return auc(step)

    tried = scan(counted, sorted(required))
    assert len(calls) == len({*calls})  # each replay once
    assert [*tried] == sorted(calls)
    assert {0, 1, 100} <= tried.keys()
    curve = Curve([*tried], [*tried.values()], [0.2 * step for step in tried])
    scales = [step * STEP for step in curve.steps]
    for least in required:
        stretches = curve.stretches(least)
        for first, last in stretches:
            assert all(auc(curve.steps[i]) >= least for i in range(first, last + 1))
            for i, j in ((first - 1, first), (last, last + 1)):  # a change is known to the step
                if i >= 0 and j < len(scales):
                    assert curve.steps[j] - curve.steps[i] == 1
                    assert (auc(curve.steps[i]) >= least) != (auc(curve.steps[j]) >= least)
        safe = _nearest(stretches, scales)
        assert (safe is None) == (not stretches)
        if safe is not None and auc(100) >= least:
            between = [step for step in tried if 100 <= step <= curve.steps[safe]]
            assert between
            assert all(auc(step) >= least for step in between)


def test_the_number_of_replays_is_bounded() -> None:
    """A comb crosses what is asked everywhere, and is not followed everywhere."""
    assert len(scan(lambda step: 0.6 if step % 2 else 0.4, [ASKED])) < 1000
    assert len(scan(lambda step: 0.7 - step / 1000, [ASKED])) < 60


def test_several_aucs_cost_no_more_than_their_crossings(tmp_path: Path) -> None:
    study = Study(
        (str(SLOW),),
        sequences=("bike-pan", "car-chase", "person-crowd"),
        forecasters=("hold",),
        require_auc=[0.6, "0.5"],
    )
    both = compute_study(study, tmp_path / "both", workers=1).required
    assert [row.required_auc for row in both] == [0.5, 0.6]
    for row in both:
        alone = Study(
            study.traces,
            sequences=study.sequences,
            forecasters=("hold",),
            require_auc=Fraction(str(row.required_auc)),
        )
        [found] = compute_study(alone, tmp_path / str(row.required_auc), workers=1).required
        assert (found.safe_scale, found.auc) == (row.safe_scale, row.auc)
