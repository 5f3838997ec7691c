import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.boxes import search_side
from lae_sim.errors import LaeError
from lae_sim.replay.reach import (
    LAPSE,
    Reach,
    Restart,
    fit_reach,
    own_jumps,
    restarts_of,
)
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording
from lae_sim.trace.restarts import RestartName


def drawn(centre, spread, count, seed):
    """Restarts of a tracker whose reach is known."""
    random = np.random.default_rng(seed)
    distances = random.uniform(0, 1.5, count)
    reaches = random.logistic(centre, spread, count)
    lapsed = random.random(count) < LAPSE
    return restarts_at(distances, (distances < reaches) & ~lapsed)


def restarts_at(distances, found):
    return [Restart("a", 1, 1, float(d), bool(f)) for d, f in zip(distances, found)]


def restart(name, truth, boxes):
    """A recording; frames without a box were not processed."""
    elapsed = np.where(np.isnan(np.asarray(boxes, float)[:, 0]), -1, 1_000_000)
    return Recording.new(name, truth, boxes, elapsed)


def gap_pass(*recordings):
    return Trace(Metadata.new("30", "restarts"), recordings)


NONE = [np.nan] * 4


@settings(max_examples=25, deadline=None)
@given(centre=st.floats(0.3, 1.2), spread=st.floats(0.02, 0.2), seed=st.integers(0, 2**32 - 1))
def test_the_reach_that_restarts_were_drawn_from_is_found_again(centre, spread, seed):
    reach = fit_reach(drawn(centre, spread, 1000, seed))
    assert abs(reach.centre - centre) < 5 * reach.centre_error
    assert abs(reach.spread - spread) < 5 * reach.spread_error
    assert reach.centre_error < 0.05
    assert reach.restarts == 1000


def test_standard_errors_are_as_large_as_the_errors():
    fits = [fit_reach(drawn(0.66, 0.09, 400, seed)) for seed in range(200)]
    for name, true in (("centre", 0.66), ("spread", 0.09)):
        z = [(getattr(fit, name) - true) / getattr(fit, f"{name}_error") for fit in fits]
        assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.2, name


def test_sequences_that_differ_widen_the_standard_errors():
    """Each sequence has a reach of its own, as targets do: one curve is less sure than it seems."""
    alike, unlike = [], []
    for seed in range(100):
        random = np.random.default_rng([9, seed])
        reaches = random.logistic(0.7, 0.1, 12)
        distances = random.uniform(0, 1.5, (12, 50))
        unlike.append(
            fit_reach(
                Restart(f"s{k}", 1, 1, float(d), bool(d < reach))
                for k, reach in enumerate(reaches)
                for d in distances[k]
            )
        )
        alike.append(
            fit_reach(
                Restart("a", 1, 1, float(d), bool(d < r))
                for d, r in zip(distances.ravel(), random.logistic(0.7, 0.1, 600), strict=True)
            )
        )
    wide, narrow = (np.median([fit.centre_error for fit in fits]) for fits in (unlike, alike))
    assert wide > 2 * narrow
    z = [(fit.centre - 0.7) / fit.centre_error for fit in unlike]
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.3


@settings(max_examples=20, deadline=None)
@given(st.permutations(drawn(0.7, 0.1, 60, seed=1)))
def test_the_order_of_restarts_does_not_matter_to_the_last_bit(restarts):
    assert fit_reach(restarts) == fit_reach(drawn(0.7, 0.1, 60, seed=1))


def test_a_step_has_a_small_spread():
    distances = np.linspace(0, 1.5, 200)
    reach = fit_reach(restarts_at(distances, distances < 0.7))
    assert abs(reach.centre - 0.7) < 0.01
    assert 0 < reach.spread < 0.02


def test_lapses_at_the_start_do_not_widen_the_curve():
    distances = np.linspace(0, 1.5, 500)
    found = distances < 0.7
    found[[3, 40]] = False
    assert fit_reach(restarts_at(distances, found)).spread < 0.02


@pytest.mark.parametrize(
    "found",
    [
        lambda d: d < 9,
        lambda d: d > 9,
        lambda d: d > 0.7,
        lambda d: (d * 1000).astype(int) % 2 == 0,
    ],
    ids=["always", "never", "only far away", "at random"],
)
def test_strange_restarts_have_a_finite_reach_or_none(found):
    distances = np.linspace(0, 1.5, 100)
    reach = fit_reach(restarts_at(distances, found(distances)))
    if found(distances).all() or not found(distances).any():
        assert reach is None
    else:
        assert np.isfinite([reach.centre, reach.spread, reach.centre_error]).all()


def test_few_restarts_say_nothing():
    assert fit_reach([]) is None
    assert fit_reach(drawn(0.7, 0.1, 19, seed=0)) is None
    assert fit_reach(drawn(0.7, 0.1, 20, seed=0)) is not None


def test_quantiles_stand_for_the_distribution():
    reach = Reach(0.7, 0.1, 0, 0, 100)
    quantiles = reach.quantiles(1001)
    assert quantiles[500] == pytest.approx(0.7)
    assert (np.diff(quantiles) > 0).all()
    assert np.std(quantiles) == pytest.approx(0.1 * np.pi / np.sqrt(3), rel=0.01)
    assert (quantiles > 0.8).mean() == pytest.approx(reach.found(0.8) / (1 - LAPSE), abs=0.001)
    assert Reach(0.1, 0.2, 0, 0, 100).quantiles(40)[0] == 0


def test_the_share_found_falls_from_all_but_lapses_to_none():
    shares = Reach(0.7, 0.01, 0, 0, 100).found([0.0, 0.7, 50.0])
    assert shares == pytest.approx([1 - LAPSE, (1 - LAPSE) / 2, 0])


def test_restarts_are_read_from_a_gap_pass():
    start, near, far = [100, 50, 20, 20], [104, 50, 20, 20], [100, 90, 20, 20]
    trace = gap_pass(
        restart("a+b@c@0+1", [start, near], [start, near]),
        restart("a+b@c@7+2", [start, near, far], [start, NONE, near]),
        restart("lost truth@3+1", [start, NONE], [start, near]),
        restart("no size@3+1", [start, [100, 50, 0, 0]], [start, near]),
    )
    side = search_side(np.array(start, float))
    assert side == pytest.approx(40)
    assert restarts_of(trace) == [
        Restart("a+b@c", 0, 1, pytest.approx(0.1), True),
        Restart("a+b@c", 7, 2, pytest.approx(1.0), False),
    ]


def test_own_jumps_say_what_happened_on_each_followed_frame():
    start, there = [100, 50, 20, 20], [110, 50, 20, 20]
    truth = [start] + [there] * 5
    trace = gap_pass(
        restart("car@0+1", truth[:4], [start, there, NONE, NONE]),
        restart("car@0+3", [*truth[:5], NONE], [start, NONE, NONE, start, NONE, there]),
        restart("car@2+1", truth[:2], [start, start]),
    )
    first, second = own_jumps(trace)["car"]
    assert (first.gap, first.frames.tolist(), first.found.tolist()) == (1, [1], [True])
    assert (second.gap, second.frames.tolist()) == (3, [3, 5])
    assert second.found.tolist() == [True, False]  # a half overlaps; without truth, no
    assert second.distance == pytest.approx(0.25)
    assert second.answers.tolist() == [start, there]


@pytest.mark.parametrize(
    ("trace", "words"),
    [
        (Trace(Metadata.new("30", "every-frame"), []), "every-frame.*--gaps"),
        (gap_pass(restart("car", [NONE], [[1, 2, 3, 4]])), "'car'.*SEQUENCE@START"),
        (gap_pass(restart("car@0+1", [NONE], [[1, 2, 3, 4]])), "'car@0.1'.*frame 1"),
        (gap_pass(restart("car@0+1", [NONE] * 2, [[1, 2, 3, 4], NONE])), "'car@0.1'.*frame 1"),
        (gap_pass(restart("car@0+2", [NONE] * 3, [[1, 2, 3, 4]] * 3)), "'car@0.2'.*before 2"),
    ],
)
def test_what_is_no_gap_pass_is_said_to_be_none(trace, words):
    for read in (restarts_of, own_jumps):
        with pytest.raises(LaeError, match=words):
            read(trace)


@given(st.text(min_size=1), st.integers(0, 10**9 - 1), st.integers(1, 10**9 - 1))
def test_names_are_read_as_they_were_written(sequence, start, gap):
    assert RestartName.parse(str(RestartName(sequence, start, gap))) == (sequence, start, gap)


@pytest.mark.parametrize("name", ["car", "car@1", "@1+2", "car@1+0", "car@01+2", "car@-1+2"])
def test_other_names_are_no_restarts(name):
    with pytest.raises(LaeError, match="SEQUENCE@START"):
        RestartName.parse(name)
