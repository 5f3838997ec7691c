"""The passes of a profile: what is run, warmed up, kept and merged."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import FakeTimed, bright_sequence

from lae_sim.datasets.frames import Dataset, ImageSequence
from lae_sim.errors import LaeError
from lae_sim.profile.journal import Journal
from lae_sim.profile.live import LiveRun, run_every_frame
from lae_sim.profile.passes import Pass, parse_timing, run_pass, write_pass
from lae_sim.trace.file import Trace, read_trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

PATH = [(5.0 + 2 * i, 8.0) for i in range(6)]


def metadata(time: str) -> Metadata:
    device = {"readings": {"before": {"time": time}}}
    timing = {"clock": "made up", "source": "measured"}
    return Metadata.new("30", "every-frame", device=device, timing=timing)


def a_pass(tmp_path: Path, tracker: FakeTimed, time: str = "1") -> Pass:
    def run(sequence: ImageSequence, **more: Any) -> list[LiveRun]:
        return [run_every_frame(sequence, tracker, **more)]

    return Pass("first", tmp_path / "t.parquet", metadata(time), run)


def ran(task: Pass, tracker: FakeTimed, journal: Journal, names: str, warmup: int = 0) -> list[Any]:
    dataset = Dataset("d", Fraction(30), [sequence(name) for name in names])
    return run_pass(task, dataset, tracker, journal, warmup, lambda frames: None)


def sequence(name: str) -> ImageSequence:
    """A good sequence, but for "x", whose first frame cannot be read."""

    def unreadable(frame: int) -> Any:
        raise LaeError("cannot be read")

    good = bright_sequence(PATH, name)
    return ImageSequence(name, good.truth, unreadable) if name == "x" else good


def test_the_warm_up_is_made_up_for_after_a_bad_first_sequence(tmp_path: Path) -> None:
    tracker = FakeTimed()
    journal = Journal(tmp_path / "t.unfinished", {}, resume=False)
    failures = ran(a_pass(tmp_path, tracker), tracker, journal, "xyz", warmup=3)
    assert [failure.sequence for failure in failures] == ["x"]
    assert len(tracker.frames) == 3 + 2 * 5


def test_a_failing_warm_up_names_the_sequence(tmp_path: Path) -> None:
    tracker = FakeTimed()
    odd = ImageSequence("odd", bright_sequence(PATH).truth, lambda frame: np.zeros((9, 9)))
    journal = Journal(tmp_path / "t.unfinished", {}, resume=False)
    dataset = Dataset("d", Fraction(30), [odd])
    (failure,) = run_pass(a_pass(tmp_path, tracker), dataset, tracker, journal, 2, print)
    assert "sequence 'odd', frame 0: a frame must be uint8" in failure.reason


def test_a_resumed_pass_is_one_trace_of_both_runs(tmp_path: Path) -> None:
    folder, tracker = tmp_path / "t.unfinished", FakeTimed()
    ran(a_pass(tmp_path, tracker, "1"), tracker, Journal(folder, {}, resume=False), "ac")
    task, journal = a_pass(tmp_path, tracker, "2"), Journal(folder, {}, resume=True)
    ran(task, tracker, journal, "abc")
    write_pass(task, journal, [])
    trace = read_trace(task.path)
    assert [recording.name for recording in trace] == ["a", "b", "c"]
    document = trace.metadata.document
    assert document["sequences"]["b"]["order"] == 1
    assert document["device"]["readings"]["before"] == {"time": "1"}


def test_a_call_that_enters_some_stages_spent_no_time_in_the_others(tmp_path: Path) -> None:
    third = Fraction(1, 3)
    both = [{}, {"inference": third, "learn": third}, {"inference": third}, {}]
    of_runs = {"a": both, "b": [{}, {"inference": third}], "c": [{}], "d": [{"learn": third}, {}]}
    folder = tmp_path / "t.unfinished"
    for name, stages in of_runs.items():  # each by a process of its own
        tracker = FakeTimed([9], stages=stages)
        task, journal = a_pass(tmp_path, tracker), Journal(folder, {}, resume=name != "a")
        ran(task, tracker, journal, name)
    write_pass(task, journal, [])
    found = {r.name: {k: ns.tolist() for k, ns in r.stages.items()} for r in read_trace(task.path)}
    assert found == {
        "a": {"inference": [-1, 3, 3, -1, -1, 3], "learn": [-1, 3, 0, -1, -1, 3]},
        "b": {"inference": [-1, 3, -1, 3, -1, 3], "learn": [-1, 0, -1, 0, -1, 0]},
        "c": {},
        "d": {"inference": [0, -1, 0, -1, 0, -1], "learn": [3, -1, 3, -1, 3, -1]},
    }
    assert read_trace(task.path).metadata.document["version"] == "1.1"


def test_the_decoding_is_not_one_that_a_tracker_enters(tmp_path: Path) -> None:
    tracker = FakeTimed([9], stages=[{}, {"learn": Fraction(1, 3)}, {}])

    def run(sequence: ImageSequence, **more: Any) -> list[LiveRun]:
        return [run_every_frame(sequence, tracker, include_decode=True, **more)]

    task = replace(a_pass(tmp_path, tracker), run=run)
    journal = Journal(tmp_path / "t.unfinished", {}, resume=False)
    ran(task, tracker, journal, "a")
    write_pass(task, journal, [])
    (recording,) = read_trace(task.path)
    assert recording.stages["learn"].tolist() == [-1, 3, -1, -1, 3, -1]
    assert (recording.stages["decode"] == recording.elapsed_ns - 9).all()


def test_a_damaged_part_is_run_again(tmp_path: Path) -> None:
    folder, tracker = tmp_path / "t.unfinished", FakeTimed()
    task = a_pass(tmp_path, tracker)
    ran(task, tracker, Journal(folder, {}, resume=False), "ab")
    (part,) = (path for path in folder.glob("first/*") if read_trace(path).names == ("b",))
    part.write_bytes(part.read_bytes()[:300])
    journal = Journal(folder, {}, resume=True)
    assert [journal.holds("first", name) for name in "ab"] == [True, False]
    ran(task, tracker, journal, "ab")
    write_pass(task, journal, [])
    assert [recording.name for recording in read_trace(task.path)] == ["a", "b"]


@pytest.mark.parametrize("text", ["[1]", "{", None])
def test_a_journal_without_its_settings(tmp_path: Path, text: str | None) -> None:
    folder = tmp_path / "t.unfinished"
    Journal(folder, {"a": 1}, resume=False)
    if text is None:
        (folder / "settings.json").unlink()
    else:
        (folder / "settings.json").write_text(text)
    with pytest.raises(LaeError, match="remove it to start anew"):
        Journal(folder, {"a": 1}, resume=True)


def test_a_journal_keeps_any_name(tmp_path: Path) -> None:
    names = ["a.b", ".c", "..", "d/e", "100%", "-f", "ü ñ", "g\u202eh", "Car", "car", "CON", "a:b?"]
    names = sorted([*names, "x" * 300, "名" * 26, "名" * 200])
    journal = Journal(tmp_path / "t.unfinished", {}, resume=False)
    for name in names:
        recording = Recording.new(name, [[1, 1, 1, 1]], [[1, 1, 1, 1]], [1])
        journal.add("first", name, [recording], metadata(json.dumps(name)))
    traces = journal.traces("first")
    assert [recording.name for trace in traces for recording in trace] == names
    files = [path.stem.casefold() for path in tmp_path.glob("t.unfinished/first/*")]
    assert len(set(files)) == len(names)  # on any disk
    assert all(stem.isalnum() and len(stem) <= 32 for stem in files)


def test_times_of_another_device(tmp_path: Path) -> None:
    box = [[1.0, 1, 9, 9]] * 6
    path = tmp_path / "times.parquet"
    described = {"device": {"model": "D"}, "timing": {"clock": "made up"}}
    recordings = [Recording.new("a", box, box, [7, 8, 9, 10, 11, 12])]
    write_trace(Trace(Metadata.new("30", "every-frame", **described), recordings), path)
    source, timing = parse_timing(str(path))
    assert source == "times.parquet (D), not measured here"
    assert [timing(sequence("a"))(frame) for frame in range(6)] == [7, 8, 9, 10, 11, 12]
    with pytest.raises(LaeError, match="no times of sequence 'b'"):
        timing(sequence("b"))
    with pytest.raises(LaeError, match="has 6 frames of sequence 'a', which has 4 here"):
        timing(bright_sequence(PATH[:4], "a"))
    source, timing = parse_timing("constant:47ms")
    assert source == "constant 47ms, not measured"
    assert timing(sequence("b"))(3) == 47_000_000


def test_times_of_another_device_may_tell_the_initialisation_apart(tmp_path: Path) -> None:
    box = [[1.0, 1, 9, 9]] * 6
    path = tmp_path / "a,b.parquet"
    recordings = [Recording.new("a", box, box, np.arange(7, 13) * 10**6)]
    write_trace(Trace(Metadata.new("30", "every-frame"), recordings), path)
    source, timing = parse_timing(f"{path},init=1s")
    assert source == "a,b.parquet (unknown), initialisation 1000 ms, not measured here"
    assert [timing(sequence("a"))(frame) for frame in range(3)] == [10**9, 8_000_000, 9_000_000]
    source, timing = parse_timing("constant:47ms,init=800ms")
    assert source == "constant 47ms, initialisation 800 ms, not measured"
    assert [timing(sequence("b"))(frame) for frame in range(2)] == [800_000_000, 47_000_000]
    for wrong in ("constant:47ms,int=1s", "constant:47ms,init=", f"{path},init=1"):
        with pytest.raises(LaeError, match="init"):
            parse_timing(wrong)
