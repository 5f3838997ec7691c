import math
import pickle
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.decoding import max_decoded
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.importers.lae_pvt import read_run
from lae_sim.replay.run import replay_sequence

CLOCK = Clock.at(Fraction(30))


def truth(length):
    return np.tile([10.0, 20, 30, 40], (length, 1))


def released_loop(length, fps, overheads, runtimes):
    """What the released loop writes if looking at the clock again takes ``overheads`` seconds."""
    now, last = 0.0, None
    run = {"results_raw": [], "timestamps": [], "input_fidx": [], "runtime": []}
    while True:
        now += overheads[len(run["runtime"]) % len(overheads)] if run["runtime"] else 0
        if now >= length / fps:
            return run
        frame = math.floor(now * fps)
        if frame == last:  # busy waiting: the next look that sees a newer frame
            now = math.nextafter((frame + 1) / fps, math.inf)
            if now >= length / fps:
                return run
            frame = math.floor(now * fps)
        last = frame
        elapsed = runtimes[len(run["runtime"]) % len(runtimes)]
        now += elapsed
        run["results_raw"].append((frame, 2.5, 3, 4))
        run["timestamps"].append(now)
        run["input_fidx"].append(frame)
        run["runtime"].append(elapsed)


@pytest.fixture
def read(tmp_path):
    def read(run, length, clock=CLOCK):
        path = tmp_path / "seq.pkl"
        path.write_bytes(pickle.dumps(run))
        return read_run(path, "seq", truth(length), clock)

    return read


@given(
    st.integers(1, 60),
    st.sampled_from([10, 30, 29.97]),
    st.lists(st.floats(1e-7, 0.02), min_size=1, max_size=5),
    st.lists(st.floats(1e-4, 0.3), min_size=1, max_size=7),
)
def test_a_replay_repeats_the_released_loop(tmp_path_factory, length, fps, overheads, runtimes):
    run = released_loop(length, fps, overheads, runtimes)
    path = tmp_path_factory.getbasetemp() / "loop.pkl"
    path.write_bytes(pickle.dumps(run))
    clock = Clock.at(Fraction(str(fps)))
    released = read_run(path, "seq", truth(length), clock)
    schedule = replay_sequence(released.recording, clock).schedule
    assert schedule.frames.tolist() == run["input_fidx"]
    ready = [Fraction(int(tick), clock.ticks_per_ns) for tick in schedule.ready]
    late = [a - Fraction(b) * 10**9 for a, b in zip(ready, run["timestamps"])]
    assert all(-3 <= difference <= 10**9 / Fraction(str(fps)) for difference in late)
    assert sum(difference > 3 for difference in late) == len(released.prolonged_ns)


def test_ready_times_are_the_timestamps(read):
    # 30 Hz: frame 3 arrives at 0.1 s; the output of frame 0 takes 0.11 s, that of 3 until 0.15 s.
    run = {
        "results_raw": np.array([[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]]),
        "timestamps": [0.11, 0.15, 0.17],
        "input_fidx": np.array([0, 3, 4]),
        "runtime": [0.11, 0.04, 0.02],
    }
    released = read(run, 5)
    recording = released.recording
    assert recording.elapsed_ns.tolist() == [110_000_000, -1, -1, 40_000_000, 20_000_000]
    assert np.isnan(recording.boxes[1:3]).all()
    assert recording.boxes[[0, 3, 4]].tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]]
    assert (released.prolonged_ns, released.init_known) == ((), True)


def test_a_time_is_prolonged_to_the_frame_that_the_loop_saw(read):
    # Ready 1 ms before frame 3 arrives; the loop looked 2 ms later and took frame 3.
    run = {
        "results_raw": [[1, 2, 3, 4]] * 2,
        "timestamps": [0.099, 0.132],
        "input_fidx": [0, 3],
    }
    released = read(run, 4)
    assert released.recording.elapsed_ns.tolist() == [100_000_000, -1, -1, 32_000_000]
    assert released.prolonged_ns == (1_000_000,)


@pytest.mark.parametrize("timestamps", [[0.0, 0.16], [0, 0.16]])
@pytest.mark.parametrize(
    ("more", "init_ns", "known"),
    [
        ({"runtime": [0.12, 0.03]}, 120_000_000, True),
        ({"runtime_all": [0.12, 0.03]}, 120_000_000, True),
        ({}, 100_000_000, False),
        ({"runtime": [0, 0.03]}, 100_000_000, False),
    ],
)
def test_the_first_timestamp_may_be_zeroed(read, timestamps, more, init_ns, known):
    run = {"results_raw": [[1, 2, 3, 4]] * 2, "timestamps": timestamps, "input_fidx": [0, 3]}
    released = read({**run, **more}, 4)
    assert released.recording.elapsed_ns[0] == init_ns
    assert (released.prolonged_ns, released.init_known) == ((), known)


def test_pvt_plus_plus_keys(read):
    run = {
        "results_raw_t": [(1, 2, 3, 4)],
        "results_raw_p": [{"fidx": 1}],
        "timestamps_t": [0.02],
        "input_fidx_t": [0],
        "runtime_all": [0.02],
        "eta": 0,
    }
    assert read(run, 1).recording.elapsed_ns.tolist() == [20_000_000]


GOOD = {
    "results_raw": [[1, 2, 3, 4]] * 3,
    "timestamps": [0.02, 0.05, 0.09],
    "input_fidx": [0, 1, 2],
    "runtime": [0.02] * 3,
}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"input_fidx": [0, 1]}, "3 results_raw, 3 timestamps and 2 input_fidx"),
        ({"timestamps": [0.02, 0.05]}, "2 timestamps"),
        ({"input_fidx": [0, 2, 1]}, r"input_fidx\[2\] is 1, after frame 2"),
        ({"input_fidx": [0, 1, 1]}, r"input_fidx\[2\] is 1, after frame 1"),
        ({"input_fidx": [1, 2, 3]}, "must start with frame 0"),
        ({"input_fidx": [0, 1, 3]}, r"input_fidx\[2\] is frame 3, and the ground truth has 3"),
        ({"input_fidx": [0, 1, 1.5]}, r"input_fidx\[2\] is not a frame number"),
        ({"input_fidx": [0, 1, "2"]}, r"input_fidx\[2\] is not a frame number"),
        ({"input_fidx": [0, 1, float("nan")]}, r"input_fidx\[2\] is not a frame number"),
        ({"timestamps": [0.02, 0.05, -1]}, "time 2 is not a number of seconds"),
        ({"timestamps": [0.02, 0.05, None]}, "time 2 is not a number of seconds"),
        ({"timestamps": [0.02, 0.03, 0.09]}, r"output 1 \(frame 1\) is ready before"),
        ({"timestamps": [20, 50, 90]}, r"output 0 \(frame 0\) is ready when frame 1.*in seconds"),
        ({"results_raw": [[1, 2, 3]] * 3}, r"results_raw\[0\] is not a box"),
        ({"results_raw": [[1, 2, 3, float("inf")]] * 3}, r"results_raw\[0\] is not a box"),
        ({"results_raw": "text"}, "no list 'results_raw'"),
        ({"results_raw": {}, "input_fidx": None}, "no list"),
        ({key: [] for key in GOOD}, "must start with frame 0"),
    ],
)
def test_faults(read, change, problem):
    with pytest.raises(LaeError, match=problem) as caught:
        read({**GOOD, **change}, 3)
    assert "seq.pkl" in str(caught.value)


def test_skipped_though_free(read):
    run = {**GOOD, "input_fidx": [0, 1, 4], "timestamps": [0.02, 0.05, 0.15]}
    with pytest.raises(
        LaeError, match=r"output 1 \(frame 1\) leaves the tracker free, yet frame 4"
    ):
        read(run, 5)


def test_a_run_that_stops_early(read):
    with pytest.raises(
        LaeError, match=r"output 2 \(frame 2\) leaves the tracker free, yet the run"
    ):
        read(GOOD, 9)


@pytest.mark.parametrize("content", [[1, 2], 3, None, {}, {"boxes": [1]}, {1: 2}])
def test_other_pickles(read, content):
    with pytest.raises(LaeError, match=r"not a dict|no list"):
        read(content, 3)


def test_timestamps_on_frame_boundaries(read):
    """Outputs that are ready exactly when a frame arrives, in floats and in rounded ns."""
    for period in (1 / 30, 2 / 30, 0.1):
        run = released_loop(50, 30, [0.0], [period])
        assert all(a < b for a, b in pairwise(run["input_fidx"]))
        schedule = replay_sequence(read(run, 50).recording, CLOCK).schedule
        assert schedule.frames.tolist() == run["input_fidx"]


def test_keys_and_values_that_python_does_not_write_out(read):
    huge = 10**5000
    with pytest.raises(LaeError, match=r"no list 'input_fidx' \(it has <int>\)"):
        read({huge: 1}, 3)
    for key in ("input_fidx", "timestamps", "results_raw", "runtime"):
        run = released_loop(3, 30, [0], [0.01])
        run[key] = [huge] * len(run[key])
        if key == "runtime":
            run["timestamps"][0] = 0
        with pytest.raises(LaeError, match=r"seq\.pkl"):
            read(run, 3)


def test_an_array_that_would_take_too_much_memory_as_numbers(read):
    run = {"input_fidx": np.zeros(20_000, np.int8), "timestamps": [0.1], "results_raw": [[0] * 4]}
    with max_decoded("1MiB"), pytest.raises(LaeError, match=r"seq\.pkl: would take more"):
        read(run, 3)
