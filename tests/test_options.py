import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

import lae_sim
from lae_sim.errors import LaeError
from lae_sim.forecast import ConstantVelocity, Hold
from lae_sim.kalman import Kalman, KalmanLaePvt
from lae_sim.options import parse_latency, parse_policy
from lae_sim.zoo import load_forecaster

BUILT_IN = {
    "hold": Hold,
    "constant-velocity": ConstantVelocity,
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
}
RECORDING = lae_sim.Recording.new(
    "sequence", [[0, 0, 1, 1]] * 4, [[0, 0, 1, 1]] * 4, [90_000_000, 40_000_000, 30_000_000, 2]
)


def times(source):
    service = source(RECORDING)
    return [service(frame) for frame in (0, 2, 3)]


def test_latencies_by_name():
    assert times(parse_latency("recorded")) == [90_000_000, 30_000_000, 2]
    assert times(parse_latency("by-call")) == [90_000_000, 40_000_000, 30_000_000]
    assert times(parse_latency("constant:4.7us")) == [4700, 4700, 4700]
    assert times(parse_latency("resample:3")) == times(lae_sim.resampled(3))
    assert times(parse_latency("lognormal:3")) == times(lae_sim.lognormal(3))


def test_policies_by_name():
    clock = lae_sim.Clock.at(Fraction(10))
    calls = [(0, 0, 3_500_000_000)]  # free half-way between frames 3 and 4
    expected = {
        "latest": (3, 3_500_000_000),
        "fifo": (1, 3_500_000_000),
        "every:2": (2, 3_500_000_000),
        "shrinking-tail:160ms": (4, 4_000_000_000),
        "shrinking-tail:110ms": (3, 3_500_000_000),
        "vot-realtime:0": (3, 3_000_000_000),
        "vot-realtime:1": (1, 1_000_000_000),
        "vot-realtime": (1, 1_000_000_000),
    }
    for text, following in expected.items():
        policy, at_arrival = parse_policy(text)
        assert policy(clock, calls) == following, text
        assert at_arrival == text.startswith("vot")


@pytest.mark.parametrize(
    "text", ["", "Latest", "latest:1", "every", "every:-1", "every:x", "shrinking-tail", "fifo:2",
             "vot-realtime:x", "every:99999999999999999999"]
)  # fmt: skip
def test_a_policy_that_is_none_is_an_error_that_quotes_it(text):
    with pytest.raises(lae_sim.LaeError, match=r"every|policy|vot"):
        parse_policy(text)


@pytest.mark.parametrize(
    "text", ["", "constant", "constant:47", "constant:0.1ns", "resample:", "resample:-1",
             "by-call:2", "lognormal:1.5", "normal:1"]
)  # fmt: skip
def test_a_latency_that_is_none_is_an_error(text):
    with pytest.raises(lae_sim.LaeError):
        parse_latency(text)


@pytest.mark.parametrize(("name", "factory"), BUILT_IN.items())
def test_built_in_names(name: str, factory: Any) -> None:
    assert load_forecaster(name) is factory


def test_a_forecaster_of_an_installed_module() -> None:
    assert load_forecaster("lae_sim.kalman:Kalman") is Kalman
    assert load_forecaster("lae_sim.kalman:Kalman.__init__") is Kalman.__init__


def test_a_forecaster_of_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_forecasters_of_a_test.py").write_text("def make(box, size): ...\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    factory = load_forecaster("my_forecasters_of_a_test:make")
    assert factory.__name__ == "make"
    monkeypatch.delitem(sys.modules, "my_forecasters_of_a_test")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("kalmann", "no forecaster 'kalmann': there are hold, constant-velocity, kalman"),
        ("", "no forecaster ''"),
        ("no_such_module_here:x", "ModuleNotFoundError"),
        ("lae_sim.kalman:NoSuch", "AttributeError"),
        ("lae_sim.kalman:", "AttributeError"),
        (":Kalman", "ValueError"),
        ("lae_sim.kalman:RESTART_IOU", "not callable"),
        ("lae_sim.kalman:Kalman:update", "AttributeError"),
    ],
)
def test_a_wrong_name_says_what_is_wrong(name: str, problem: str) -> None:
    with pytest.raises(LaeError, match=problem):
        load_forecaster(name)


def test_a_module_that_fails_while_it_is_imported_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "failing_of_a_test.py").write_text("1 / 0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    with pytest.raises(LaeError, match="ZeroDivisionError: division by zero"):
        load_forecaster("failing_of_a_test:make")
