"""How traces and forecasters may be given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import TRACES

import lae_sim
from lae_sim.api.inputs import cost_texts, labelled_traces, named_forecasters
from lae_sim.forecast import ConstantVelocity

SLOW, FAST = TRACES / "synthetic-slow.parquet", TRACES / "synthetic-fast.parquet"


def names(traces: object, **more: object) -> list[str]:
    return list(labelled_traces(traces, **more))  # type: ignore[arg-type]


def test_paths_folders_globs_and_open_traces(tmp_path: Path) -> None:
    trace = lae_sim.read_trace(SLOW)
    assert names(str(SLOW)) == names(SLOW) == names(trace) == ["synthetic-slow.parquet"]
    assert names([SLOW, trace.chosen("boat-calm")][:1]) == ["synthetic-slow.parquet"]
    assert names((FAST, str(SLOW))) == ["synthetic-fast.parquet", "synthetic-slow.parquet"]
    everything = sorted(path.name for path in TRACES.glob("*.parquet"))
    assert names(TRACES) == names(str(TRACES / "*.parquet")) == everything
    assert names({"a": SLOW, "b": trace}) == ["a", "b"]
    assert names(path for path in (SLOW, FAST)) == ["synthetic-slow.parquet", FAST.name]


def test_a_trace_in_memory_has_its_trackers_name() -> None:
    trace = lae_sim.read_trace(SLOW)
    in_memory = lae_sim.Trace(trace.metadata, list(trace))
    assert names(in_memory) == ["slow-and-accurate"]
    assert names([in_memory, FAST]) == ["slow-and-accurate", "synthetic-fast.parquet"]
    with pytest.raises(lae_sim.LaeError, match="several have the same name: give a mapping"):
        names([in_memory, in_memory])
    document = lae_sim.Metadata.new(30, "every-frame", tracker={"name": "trax:./bin/a"})
    assert names(lae_sim.Trace(document, list(trace))) == ["trax:./bin/a"]


def test_files_of_one_name_are_told_apart_by_their_paths(tmp_path: Path) -> None:
    other = tmp_path / SLOW.name
    other.write_bytes(SLOW.read_bytes())
    assert names([SLOW, other]) == [str(SLOW), str(other)]
    assert names([lae_sim.read_trace(SLOW), lae_sim.read_trace(other)]) == [str(SLOW), str(other)]


@pytest.mark.parametrize("opened", [False, True])
@pytest.mark.parametrize("asked", ["boat-calm", ["boat-calm", "bike-pan"], {"bike-pan"}])
def test_some_sequences_only(opened: bool, asked: object) -> None:
    given = lae_sim.read_trace(SLOW) if opened else SLOW
    expected = sorted([asked] if isinstance(asked, str) else asked)  # type: ignore[call-overload]
    (trace,) = labelled_traces(given, asked).values()  # type: ignore[arg-type]
    assert list(trace.names) == expected
    assert [recording.name for recording in trace] == expected
    assert trace.frames == 300 * len(expected)
    assert f"{len(expected)} sequence" in repr(trace)


def test_a_trace_in_memory_can_be_cut_too() -> None:
    trace = lae_sim.read_trace(SLOW)
    chosen = lae_sim.Trace(trace.metadata, list(trace)).chosen(["bike-pan"])
    assert (chosen.names, chosen.frames, len(chosen)) == (("bike-pan",), 300, 1)
    np.testing.assert_array_equal(chosen["bike-pan"].boxes, trace["bike-pan"].boxes)
    with pytest.raises(lae_sim.LaeError, match="the trace has no sequence 'boat-calm'"):
        chosen.chosen("boat-calm")
    with pytest.raises(lae_sim.LaeError, match="of those chosen, no sequence 'bike-pan'"):
        trace.chosen("boat-calm").chosen(["bike-pan", "boat-calm"])


def test_forecasters_by_name() -> None:
    assert named_forecasters("kalman") == {"kalman": "kalman"}
    assert named_forecasters(["hold", "kalman", "kalman"]) == {"hold": "hold", "kalman": "kalman"}
    assert named_forecasters(ConstantVelocity) == {"ConstantVelocity": ConstantVelocity}
    given = {"hold": lae_sim.Hold, "mine": "kalman:q=3"}
    assert named_forecasters(given) == given
    factory = lae_sim.load_forecaster("kalman:q=3")
    assert named_forecasters([factory]) == {"TunedKalman": factory}


def test_costs_as_text_or_by_forecaster() -> None:
    assert cost_texts("2ms") == ("2ms",)
    assert cost_texts(()) == ()
    assert cost_texts(["2ms", "kalman=measured"]) == ("2ms", "kalman=measured")
    assert cost_texts({"kalman": "2ms", "imm": "3us"}) == ("kalman=2ms", "imm=3us")


def test_runs_may_be_gone_through_twice_and_are_of_the_sequences_chosen() -> None:
    trace = lae_sim.read_trace(SLOW).chosen(["bike-pan", "boat-calm"])
    runs = lae_sim.replay_trace(trace, latency="constant:47ms", scale=1.5)
    first, second = list(runs), list(runs)
    assert [run.recording.name for run in first] == ["bike-pan", "boat-calm"]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.schedule.frames, other.schedule.frames)
    assert first[0].schedule.elapsed_ns.tolist()[0] == 70_500_000
