import os
import re
import signal
import sys
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import lae_sim
from lae_sim.cli.main import COMMANDS, main
from lae_sim.cli.options import exit_status
from lae_sim.engine.clock import Clock
from lae_sim.engine.scheduler import scores_latency
from lae_sim.files import written_whole
from lae_sim.replay.latency import bootstrap, lognormal, resampled
from lae_sim.replay.names import LATENCIES, POLICIES, parse_latency, parse_policy

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
    assert times(parse_latency("resample:3")) == times(resampled(3))
    assert times(parse_latency("lognormal:3")) == times(lognormal(3))
    assert times(parse_latency("bootstrap:3")) == times(bootstrap(3))
    assert times(parse_latency("bootstrap:3:1")) == times(bootstrap(3, 1))


def test_every_name_may_tell_the_initialisation_apart():
    for name in ("recorded", "by-call", "constant:4.7us", "resample:3", "lognormal:3",
                 "bootstrap:3", "bootstrap:3:1"):  # fmt: skip
        first, *others = times(parse_latency(f"{name},init=1us"))
        assert first == 1000
        assert others == times(parse_latency(name))[1:]


OWN = """
class Slowly:
    def __call__(self, clock, calls):
        return calls[-1][0] + 9, calls[-1][2] + 9 * clock.frame_ticks

at_once = Slowly()

def double(recording):
    return lambda frame: 2 * int(recording.elapsed_ns[frame])
"""


@pytest.mark.parametrize("name", ["Slowly", "at_once"])
def test_a_policy_of_ones_own(name, tmp_path, monkeypatch):
    (tmp_path / "own_rules.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "own_rules", raising=False)
    policy = parse_policy(f"own_rules:{name}")
    assert policy(Clock.at(Fraction(1)), [(0, 0, 7)]) == (9, 9_000_000_007)
    assert scores_latency(policy)


def test_a_latency_of_ones_own(tmp_path, monkeypatch):
    (tmp_path / "own_rules.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "own_rules", raising=False)
    assert times(parse_latency("own_rules:double")) == [180_000_000, 60_000_000, 4]
    assert times(parse_latency("own_rules:double,init=9ns")) == [9, 60_000_000, 4]
    [world] = lae_sim.World.sweep(latency="own_rules:double,init=9ns")
    assert world.label() == "own_rules:double,init=9ns"
    with pytest.raises(lae_sim.LaeError, match=r"latency 'own_rules:triple': .*triple"):
        parse_latency("own_rules:triple")


def test_policies_by_name():
    clock = Clock.at(Fraction(10))
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
        policy = parse_policy(text)
        assert policy(clock, calls) == following, text
        assert scores_latency(policy) != text.startswith("vot")


@pytest.mark.parametrize(
    "text", ["", "Latest", "latest:1", "every", "every:-1", "every:x", "shrinking-tail", "fifo:2",
             "vot-realtime:x", "every:99999999999999999999", "no_such_module:policy"]
)  # fmt: skip
def test_a_policy_that_is_none_is_an_error_that_quotes_it(text):
    with pytest.raises(lae_sim.LaeError, match=r"every|policy|vot"):
        parse_policy(text)


@pytest.mark.parametrize(
    "text", ["", "constant", "constant:47", "constant:0.1ns", "resample:", "resample:-1",
             "by-call:2", "lognormal:1.5", "normal:1", "bootstrap", "bootstrap:1:0",
             "bootstrap:1:2:3", "bootstrap::3", "recorded:json", "no_such_module:source",
             "constant:47ms,init=", "recorded,init=-1s", "recorded,int=1s", ",init=1s",
             "constant:47,init=1s", "recorded,init=1s,init=1s", "no_such_module:source,init=1s"]
)  # fmt: skip
def test_a_latency_that_is_none_is_an_error(text):
    with pytest.raises(lae_sim.LaeError):
        parse_latency(text)


def test_an_option_that_is_none_is_told_what_was_perhaps_meant(capsys):
    for words, meant in (
        (["--forecasters", "kalman"], "--forecaster"),
        (["--latncy=47ms"], "--latency"),
    ):
        with pytest.raises(SystemExit):
            main(["replay", "a.parquet", *words])
        assert f"; did you mean '{meant}'? (lae-sim replay --help" in capsys.readouterr().err


def test_running_out_of_memory_is_one_line(capsys):
    def python():
        raise MemoryError

    def numpy():
        np.empty(1 << 52)

    for work in (python, numpy):
        assert exit_status(work, "lae-sim show") == 1
        assert capsys.readouterr().err.startswith("lae-sim show: error: out of memory: give it")


def test_every_command_takes_what_a_file_may_take(tmp_path, capsys):
    path = str(tmp_path / "trace.parquet")
    lae_sim.write_trace(lae_sim.Trace(lae_sim.Metadata.new("30", "every-frame"), [RECORDING]), path)
    for command in (["show", path], ["replay", path], ["compare", path, "--forecaster", "kalman"]):
        assert main([*command, "--max-decoded", "300"]) == 2
        assert "would take more than 0.0002861 MiB" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            main([*command, "--max-decoded", "much"])
        assert "--max-decoded: 'much' is no size in memory" in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_every_command_has_what_all_have_and_examples(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    printed = capsys.readouterr().out
    assert "--max-decoded SIZE" in printed
    assert f"\nexamples:\n  lae-sim {'profile' if command == 'fidelity' else command} " in printed
    assert max(map(len, printed.splitlines())) <= 100


def test_the_help_of_replay_explains_every_policy_latency_and_convention(capsys):
    with pytest.raises(SystemExit):
        main(["replay", "--help"])
    printed = capsys.readouterr().out
    for name in (*POLICIES, *LATENCIES, *lae_sim.CONVENTIONS):
        assert re.search(rf"^  {name}\b.* {{2}}\w.+|; {name}: \w+", printed, re.M), name


POSIX = pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no SIGHUP")


@POSIX
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_to_end_lets_the_work_clean_up(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_DFL)  # be it ignored where the tests run

    def work() -> None:
        with written_whole(tmp_path / "out") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), number)
            time.sleep(60)  # which it does not reach

    try:
        assert exit_status(work, "lae-sim") == 128 + number
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert f"lae-sim: ended by {name}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@POSIX
def test_a_signal_that_is_ignored_ends_nothing() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as by nohup
    try:
        assert exit_status(lambda: os.kill(os.getpid(), signal.SIGHUP), "lae-sim") == 0
    finally:
        signal.signal(signal.SIGHUP, before)
