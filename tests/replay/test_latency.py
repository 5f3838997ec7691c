"""Latency sources: exact values, independent streams, and what is refused."""

from __future__ import annotations

import hashlib
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from functools import partial
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import shrinking_tail
from lae_sim.engine.times import Times
from lae_sim.errors import LaeError
from lae_sim.replay.latency import (
    LatencySource,
    RandomSource,
    StageTimes,
    bootstrap,
    by_call,
    by_frame,
    constant,
    initialised,
    lognormal,
    resampled,
    scaled,
)
from lae_sim.replay.names import label_of, parse_latency
from lae_sim.replay.run import replay_sequence
from lae_sim.replay.world import World, replay_trace
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

TIMES = [90, -1, 20, 30, -1, 50]
RECORDED = [90, 20, 30, 50]


def recording(times: list[int], name: str = "a", length: int = 0) -> Recording:
    """A sequence with these times, and more frames without any up to a length."""
    times = times + [-1] * (length - len(times))
    boxes = np.where(np.array(times)[:, None] < 0, np.nan, np.ones((1, 4)))
    return Recording.new(name, np.ones((len(times), 4)), boxes, times)


def draws(source: LatencySource, count: int, of: Recording | None = None) -> list[int]:
    service = source(recording(TIMES, length=count) if of is None else of)
    return [service(frame) for frame in range(count)]


def test_by_frame_looks_the_frame_up() -> None:
    service = by_frame(recording(TIMES))
    assert [service(frame) for frame in (0, 2, 5, 3, 2)] == [90, 20, 50, 30, 20]


def test_by_frame_names_what_is_missing() -> None:
    with pytest.raises(LaeError, match=r"sequence 'Car2', frame 4: .*skipped"):
        by_frame(recording(TIMES, "Car2"))(4)


# ---------------------------------------------------------------------------------------- stages


def staged(name: str = "a") -> Recording:
    """90 ns of which nothing is said, a skipped frame, and two stages of the others."""
    stages = {"inference": [-1, -1, 12, 0, -1, 9], "preprocess": [-1, -1, 5, 7, -1, -1]}
    known = {stage: np.array(ns) for stage, ns in stages.items()}
    return replace(recording(TIMES, name), stages=known)


def test_the_times_of_stages_alone_add_up() -> None:
    one = StageTimes(("inference",))(staged())
    assert [one(frame) for frame in (2, 3, 5)] == [12, 0, 9]
    both = StageTimes(("preprocess", "inference"))(staged())
    assert [both(frame) for frame in (2, 3)] == [17, 7]
    half = scaled(StageTimes(("preprocess", "inference")), Fraction(1, 2))(staged())
    assert [half(frame) for frame in (2, 3)] == [8, 4]


@pytest.mark.parametrize("frame", [0, 1, 5])
def test_a_frame_without_the_time_of_a_stage_is_named(frame: int) -> None:
    service = StageTimes(("inference", "preprocess"))(staged("Car2"))
    message = rf"sequence 'Car2', frame {frame}: .*no time of inference and preprocess for it"
    with pytest.raises(LaeError, match=message + r".*,init=TIME"):
        service(frame)


def test_the_initialisation_may_be_given_where_it_has_no_stages() -> None:
    service = initialised(StageTimes(("inference",)), 300)(staged())
    assert [service(frame) for frame in (0, 2)] == [300, 12]


def test_stages_that_a_recording_lacks_are_named_with_those_it_has() -> None:
    message = (
        r"sequence 'Car2': .*stage 'warp' .column stage_warp_ns.*has those of preprocess, inference"
    )
    with pytest.raises(LaeError, match=message):
        StageTimes(("inference", "warp"))(staged("Car2"))
    with pytest.raises(LaeError, match=r"'inference'.*it has those of whole calls only"):
        StageTimes(("inference",))(recording(TIMES))


@pytest.mark.parametrize("stages", [(), ("a", "a"), ("",), ("Decode",)])
def test_stages_are_named_once_each(stages: tuple[str, ...]) -> None:
    with pytest.raises(LaeError, match=r"name one stage or several|is no name of a stage"):
        StageTimes(stages)


def test_stages_by_name() -> None:
    assert parse_latency("stage:inference") == StageTimes(("inference",))
    world = World.of(latency="stage:preprocess+inference,init=1s", scale=2)
    assert world.label() == "stage:preprocess+inference,init=1s x 2"
    assert label_of(StageTimes(("a", "b"))) == "stage:a+b"
    with pytest.raises(LaeError, match=r"latency 'stage:': '' is no name of a stage"):
        parse_latency("stage:")
    with pytest.raises(LaeError, match=r"no latency 'stages'.*did you mean 'stage'"):
        parse_latency("stages")


@pytest.mark.parametrize("count", [1, 20])  # one by one, and in lanes
def test_a_replay_by_a_stage_is_one_of_its_times(count: int) -> None:
    boxes = np.ones((40, 4))
    random = np.random.default_rng(count)
    group, expected = [], []
    for i in range(count):
        elapsed = random.integers(10_000_000, 90_000_000, 40)
        parts = {name: random.integers(0, elapsed // 2) for name in ("decode", "inference")}
        made = Recording.new(f"s{i:02}", boxes, boxes, elapsed, stages=parts)
        group.append(made)
        expected.append(replace(made, elapsed_ns=parts["decode"] + parts["inference"], stages={}))
    every = Metadata.new("30", "every-frame")
    found = replay_trace(Trace(every, group), latency="stage:inference+decode")
    for run, other in zip(found, replay_trace(Trace(every, expected)), strict=True):
        assert run.schedule.frames.tolist() == other.schedule.frames.tolist()
        assert run.schedule.ready.tolist() == other.schedule.ready.tolist()


def test_by_call_takes_the_recorded_times_in_order_whatever_the_frame() -> None:
    service = by_call(recording(TIMES))
    assert [service(frame) for frame in (0, 1, 4, 5)] == RECORDED


def test_by_call_names_the_call_that_is_missing() -> None:
    service = by_call(recording(TIMES, "Car2"))
    for frame in range(4):
        service(frame)
    with pytest.raises(LaeError, match=r"sequence 'Car2', frame 7: call 5 .* 4 calls"):
        service(7)


def test_by_call_starts_anew_for_each_service() -> None:
    source = recording(TIMES)
    assert by_call(source)(0) == by_call(source)(0) == 90


def test_constant_times_every_call_alike() -> None:
    assert draws(constant(ns=47), 3) == [47, 47, 47]


@pytest.mark.parametrize(
    ("factor", "expected"),
    [
        (Fraction(2), [180, 40, 60, 100]),
        (Fraction(0), [0, 0, 0, 0]),
        (Fraction(1, 4), [22, 5, 8, 12]),  # 22.5, 7.5 and 12.5 go to the even neighbour
        (Fraction(1001, 1000), [90, 20, 30, 50]),
    ],
)
def test_scaled_is_exact_and_rounds_half_to_even(factor: Fraction, expected: list[int]) -> None:
    assert draws(scaled(by_call, factor), 4) == expected


@given(
    st.lists(st.integers(0, 2**63 - 1), min_size=1), st.integers(0, 10**13), st.integers(1, 10**13)
)
def test_scaled_is_the_rounded_fraction(times: list[int], p: int, q: int) -> None:
    factor = Fraction(p, q)
    service = scaled(by_call, factor)(recording(times))
    assert isinstance(service, Times)
    assert service.ns.tolist() == [min(round(ns * factor), 2**63 - 1) for ns in times]


def test_a_service_of_ones_own_is_scaled_call_by_call() -> None:
    found = draws(scaled(lambda recording: lambda frame: 2 * frame + 1, Fraction(1, 2)), 4)
    assert found == [0, 2, 2, 4]


def test_a_constant_below_zero_is_refused() -> None:
    with pytest.raises(LaeError, match="negative"):
        constant(ns=-1)


def test_a_constant_in_float_seconds_is_refused() -> None:
    with pytest.raises(TypeError):
        constant(ns=0.047)  # type: ignore[arg-type]


def test_a_bare_number_is_no_duration() -> None:
    for wrong in (47, 0.047, "47"):
        with pytest.raises(LaeError, match=f"^{wrong!r} is not a duration: write it with its unit"):
            constant(wrong)  # type: ignore[arg-type]
        with pytest.raises(LaeError, match="is not a duration"):
            shrinking_tail(wrong)  # type: ignore[arg-type]
    with pytest.raises(LaeError, match="give a duration as text with its unit"):
        constant()
    assert draws(constant("47ms"), 2) == [47_000_000] * 2


def test_scaling_does_not_pass_through_floats() -> None:
    big = 2**60 + 1
    assert draws(scaled(constant(ns=big), Fraction(3)), 1) == [3 * big]
    assert draws(scaled(constant(ns=3 * big), Fraction(1, 3)), 1) == [big]


def test_a_factor_below_zero_is_refused() -> None:
    with pytest.raises(LaeError, match="below zero"):
        scaled(by_frame, Fraction(-1))


def test_scaling_keeps_the_message_of_its_source() -> None:
    with pytest.raises(LaeError, match="frame 1"):
        scaled(by_frame, Fraction(2))(recording(TIMES))(1)


# ----------------------------------------------------------------------------- initialisation

ANY = pytest.mark.parametrize("source", [by_call, constant(ns=7), resampled(1), lognormal(1)])


@ANY
def test_the_initialisation_alone_has_a_time_of_its_own(source: LatencySource) -> None:
    plain = draws(source, 4)
    assert draws(initialised(source, 800), 4) == [800, *plain[1:]]
    assert draws(source, 4) == plain  # what the source gives is not changed


def test_the_initialisation_by_frame_is_that_of_frame_0() -> None:
    service = initialised(by_frame, 800)(recording(TIMES))
    assert [service(frame) for frame in (0, 2, 5)] == [800, 20, 50]
    with pytest.raises(LaeError, match="frame 4"):
        service(4)


def test_a_source_that_counts_its_calls_is_asked_for_the_initialisation_too() -> None:
    def counting(recording: Recording) -> Callable[[int], int]:
        times = iter(range(10))
        return lambda frame: next(times)

    assert draws(initialised(counting, 800), 4) == [800, 1, 2, 3]


@ANY
def test_a_scale_outside_multiplies_the_initialisation_and_one_inside_does_not(
    source: LatencySource,
) -> None:
    half = scaled(source, Fraction(1, 2))
    assert draws(scaled(initialised(source, 801), Fraction(1, 2)), 4) == [400, *draws(half, 4)[1:]]
    assert draws(initialised(half, 801), 4) == [801, *draws(half, 4)[1:]]


def test_a_constant_may_tell_the_initialisation_apart() -> None:
    for source in (constant("47ns", init="800ns"), constant(ns=47, init_ns=800)):
        assert draws(source, 3) == [800, 47, 47]
        assert label_of(source) == "constant:47ns,init=800ns"
    assert label_of(constant("47ms", init="1s")) == "constant:47ms,init=1000ms"
    assert constant("1s", init="2s") == constant("1000ms", init="2s") != constant("1s", init="3s")


def test_a_wrong_time_of_the_initialisation() -> None:
    with pytest.raises(LaeError, match="negative"):
        initialised(by_frame, -1)
    with pytest.raises(LaeError, match="give a duration as text with its unit"):
        constant("47ms", init="1s", init_ns=1)
    with pytest.raises(LaeError, match="'800' is not a duration"):
        constant("47ms", init="800")


def test_random_times_with_an_initialisation_can_be_repeated() -> None:
    source = scaled(initialised(lognormal(3), 800), Fraction(2))
    assert isinstance(source, RandomSource)
    once = recording(TIMES, length=20)
    repeated, plain = source.repeated(once, 0, 5), scaled(lognormal(3), Fraction(2))
    assert set(repeated[:, 0].tolist()) == {1600}
    assert isinstance(plain, RandomSource)
    np.testing.assert_array_equal(repeated[:, 1:], plain.repeated(once, 0, 5)[:, 1:])


# ------------------------------------------------------------------------------ random sources

Make = Callable[..., RandomSource]
SHORT_BLOCKS: Make = partial(bootstrap, block=2)
RANDOM = pytest.mark.parametrize("make", [resampled, lognormal, bootstrap, SHORT_BLOCKS])


@RANDOM
def test_initialisation_keeps_its_recorded_time(make: Make) -> None:
    assert [draws(make(seed), 1) for seed in range(20)] == [[90]] * 20


def test_resampled_draws_every_recorded_time_but_that_of_the_initialisation() -> None:
    found = draws(resampled(0), 3001)[1:]
    assert set(found) == {20, 30, 50}
    assert all(abs(found.count(ns) / 3000 - 1 / 3) < 0.03 for ns in (20, 30, 50))


def test_lognormal_has_the_moments_of_the_recorded_logarithms() -> None:
    times = [10**9] + np.random.default_rng(0).lognormal(17, 0.3, 400).astype(int).tolist()
    logs = np.log(draws(lognormal(5), 4001, recording(times, length=4001))[1:])
    recorded = np.log(times[1:])
    assert statistics.fmean(logs) == pytest.approx(recorded.mean(), abs=0.02)
    assert statistics.pstdev(logs) == pytest.approx(recorded.std(), abs=0.02)


def test_lognormal_of_equal_times_is_that_time() -> None:
    assert set(draws(lognormal(1), 50, recording([47_000_000] * 50))) == {47_000_000}


@RANDOM
def test_a_sequence_of_one_frame_can_be_drawn_from(make: Make) -> None:
    assert draws(make(1), 4, recording([47], length=4)) == [47] * 4
    assert draws(make(1), 1, recording([47])) == [47]


@RANDOM
def test_times_of_zero_can_be_drawn_from(make: Make) -> None:
    assert set(draws(make(1), 20, recording([0] * 20))) <= {0, 1}


@RANDOM
def test_the_same_seed_draws_the_same(make: Make) -> None:
    assert draws(make(7), 200) == draws(make(7), 200)


@RANDOM
def test_another_seed_or_name_draws_something_else(make: Make) -> None:
    first = draws(make(7), 200)
    assert draws(make(8), 200) != first
    assert draws(make(-7), 200) != first
    assert draws(make(7), 200, recording(TIMES, "b", 200)) != first


@RANDOM
def test_names_and_seeds_do_not_run_together(make: Make) -> None:
    one, other = recording(TIMES, "1a", 200), recording(TIMES, "a", 200)
    assert draws(make(1), 200, other) != draws(make(11), 200, other)
    assert draws(make(1), 200, one) != draws(make(11), 200, other)


@RANDOM
@given(st.permutations(["a", "b", "c"]), st.integers(0, 3))
def test_other_sequences_change_nothing(make: Make, names: list[str], used: int) -> None:
    source = make(3)
    alone = {name: draws(make(3), 40, recording(TIMES, name, 40)) for name in "abc"}
    services = {name: source(recording(TIMES, name, 40)) for name in names[:used]}
    found: dict[str, list[int]] = {name: [] for name in services}
    for frame in range(40):  # interleaved, in any order
        for name, service in services.items():
            found[name].append(service(frame))
    assert found == {name: alone[name] for name in services}


GOLDEN_TIMES = [90_000_000, 41_000_000, 52_000_000, 47_000_000, 39_500_000]


def test_the_streams_of_a_seed_never_change() -> None:
    # If this fails, every published result with a seed has changed: do not update the numbers.
    golden = recording(GOLDEN_TIMES, "Gull2", 9)
    assert draws(resampled(1), 9, golden) == RESAMPLED
    assert draws(lognormal(1), 9, golden) == pytest.approx(LOGNORMAL, abs=1)


RESAMPLED = [
    90000000,
    41000000,
    41000000,
    52000000,
    39500000,
    52000000,
    39500000,
    47000000,
    52000000,
]
LOGNORMAL = [
    90000000,
    35403492,
    39053170,
    42320455,
    50084221,
    43447222,
    58410959,
    45572673,
    42648533,
]


# --------------------------------------------------------------- as they were, one by one


def words(seed: int, name: str) -> Iterator[int]:
    digest = hashlib.sha256(f"{seed}\0{name}".encode()).digest()
    stream = np.random.PCG64(int.from_bytes(digest, "big"))
    while True:
        yield int(stream.random_raw())


def resampled_one_by_one(of: Recording, words: Iterator[int]) -> list[int]:
    init, *times = [ns for ns in of.elapsed_ns.tolist() if ns >= 0]
    return [init] + [times[next(words) * len(times) >> 64] for _ in range(1, len(of))]


def lognormal_one_by_one(of: Recording, words: Iterator[int]) -> list[int]:
    init, *times = [ns for ns in of.elapsed_ns.tolist() if ns >= 0]
    logs = [math.log(max(ns, 1)) for ns in times]
    mean = math.fsum(logs) / len(logs)
    deviation = math.sqrt(math.fsum((log - mean) ** 2 for log in logs) / len(logs))
    uniform = [((next(words) >> 11) + 0.5) / 2**53 for _ in range(1, len(of))]
    inverse = NormalDist().inv_cdf
    return [init] + [round(math.exp(mean + deviation * inverse(u))) for u in uniform]


def bootstrap_one_by_one(of: Recording, words: Iterator[int]) -> list[int]:
    init, *times = [ns for ns in of.elapsed_ns.tolist() if ns >= 0]
    drawn: list[int] = []
    while len(drawn) < len(of) - 1:
        first = next(words) * len(times) >> 64
        drawn += [times[(first + i) % len(times)] for i in range(7)]
    return [init, *drawn[: len(of) - 1]]


@pytest.mark.parametrize(
    ("make", "one_by_one"),
    [
        (resampled, resampled_one_by_one),
        (lognormal, lognormal_one_by_one),
        (partial(bootstrap, block=7), bootstrap_one_by_one),
    ],
)
@pytest.mark.parametrize("times", [TIMES, [90] + list(range(100, 300, 7)), [5, 2**62, 1]])
@pytest.mark.parametrize("length", [6, 200])
def test_draws_are_those_of_plain_python(
    make: Make, one_by_one: Callable[..., list[int]], times: list[int], length: int
) -> None:
    of = recording(times, "Gull2", length)
    expected = []
    for repetition in range(4):
        stream = words(3, "Gull2")
        for _ in range(repetition * len(of)):
            next(stream)
        expected.append([min(ns, 2**63 - 1) for ns in one_by_one(of, stream)])
        assert draws(make(3, repetition=repetition), len(of), of) == expected[-1]
    assert make(3).repeated(of, 0, 4).tolist() == expected
    assert make(3).repeated(of, 2, 2).tolist() == expected[2:]
    assert make(3, repetition=1).repeated(of, 1, 1).tolist() == expected[1:2]


def test_the_long_streams_of_a_seed_never_change() -> None:
    # computed before the draws were made all at once
    ns = [30_000_000 + i * 7919**2 % 20_000_003 for i in range(194)]
    of = recording([90_000_000, 41_000_000, -1, 52_000_000, 47_000_000, 39_500_000, *ns], "Gull2")
    found = draws(resampled(1), 200, of)
    assert hashlib.sha256(repr(found).encode()).hexdigest().startswith("90fd7ff4e28ea05d0541a535")
    assert draws(lognormal(1), 200, of)[60:64] == pytest.approx(
        [51254930, 38044330, 53768981, 40990469], abs=1
    )


def test_scaled_draws_can_be_repeated() -> None:
    of = recording(TIMES, length=50)
    source = scaled(scaled(resampled(3), Fraction(1, 4)), Fraction(3))
    assert isinstance(source, RandomSource)
    expected = 3 * np.round(resampled(3).repeated(of, 5, 2) / 4)  # half to even, twice
    assert source.repeated(of, 5, 2).tolist() == expected.tolist()


# ------------------------------------------------------------------------- the block bootstrap


def test_blocks_hold_consecutive_recorded_times_around_the_circle() -> None:
    times = list(range(1000, 1100))
    drawn = np.array(draws(bootstrap(4, block=30), 4000, recording([5, *times], length=4000)))
    assert drawn[0] == 5
    step = np.diff(drawn[1:] - 1000) % 100
    ends = np.arange(1, len(step) + 1) % 30 == 0
    assert (step[~ends] == 1).all()
    assert (step[ends] != 1).mean() > 0.9
    starts = drawn[1::30] - 1000
    assert starts.min() < 10
    assert starts.max() > 90


def test_blocks_keep_autocorrelation_and_single_draws_do_not() -> None:
    random = np.random.default_rng(0)
    slow = np.convolve(random.normal(0, 1, 700), np.ones(20) / 20, "valid")
    of = recording([1, *(5e7 + 1e7 * slow).astype(int).tolist()], length=6000)

    def correlation(ns: np.ndarray) -> float:
        return float(np.corrcoef(ns[:-1], ns[1:])[0, 1])

    recorded = correlation(of.elapsed_ns[1:600])
    assert recorded > 0.9
    assert correlation(np.array(draws(bootstrap(1), 6000, of))[1:]) == pytest.approx(
        recorded, abs=0.05
    )
    assert abs(correlation(np.array(draws(resampled(1), 6000, of))[1:])) < 0.1


def test_a_block_of_one_call_is_resampling() -> None:
    of = recording(TIMES, length=300)
    assert draws(bootstrap(8, block=1), 300, of) == draws(resampled(8), 300, of)


def test_a_block_may_be_longer_than_the_sequence() -> None:
    found = draws(bootstrap(2, block=10**12), 12, recording([9, 1, 2, 3], length=12))
    at = [1, 2, 3].index(found[1])
    assert found == [9, *([1, 2, 3] * 5)[at : at + 11]]


def test_a_block_without_calls_is_refused() -> None:
    with pytest.raises(LaeError, match="at least one call"):
        bootstrap(1, block=0)


@pytest.mark.parametrize(
    "make", [by_frame, by_call, resampled(1), lognormal(1), bootstrap(1), constant(ns=10)]
)
def test_a_source_can_drive_a_replay(make: LatencySource) -> None:
    run = replay_sequence(recording([40_000_000] * 5), Clock.at(Fraction(25)), make)
    assert run.schedule.frames.tolist() == [0, 1, 2, 3, 4]
