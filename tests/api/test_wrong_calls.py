"""Wrong calls of the face: each fails at the call, in a line or two that name the argument."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from places import TRACES

import lae_sim
from lae_sim.engine import Clock

SLOW = str(TRACES / "synthetic-slow.parquet")


@pytest.fixture(scope="module")
def trace() -> lae_sim.Trace:
    return lae_sim.read_trace(SLOW)


def fails(call: Callable[[], Any]) -> str:
    """The message of a call that must fail, in at most two lines."""
    with pytest.raises(lae_sim.LaeError) as caught:
        call()
    message = str(caught.value)
    assert message.count("\n") <= 1
    assert len(message) < 320
    return message


NO_TRACE = "traces: a trace is a path, a URL or what read_trace gives, not"
NOT_EXACT = "is not an exact number"
NO_UNIT = "is not a duration: write it with its unit, such as 47ms"

TRACES_AS_GIVEN = [
    ("x.parquet", "traces: x.parquet: no such file"),
    ("", "no such file"),
    (
        str(TRACES / "cases"),
        "cases: no trace is there (of a folder, *.parquet are taken; lae-sim convert makes",
    ),
    (str(TRACES / "FORMAT.md"), "FORMAT.md: not a readable Parquet file"),
    (None, "traces: name at least one"),
    ([], "traces: name at least one"),
    ({}, "traces: name at least one"),
    (3, f"{NO_TRACE} 3"),
    ([None], f"{NO_TRACE} None"),
    ({"a": None}, f"{NO_TRACE} None"),
    (b"a.parquet", f"{NO_TRACE} b'a.parquet'"),
    ({3: SLOW}, "traces: the name of a trace is text, not 3"),
    ({"a": "x.parquet"}, "traces: x.parquet: no such file"),
]

SETTINGS: list[tuple[dict[str, Any], str]] = [
    ({"forecasters": "kalmn"}, "no forecaster 'kalmn': .*; did you mean 'kalman'?"),
    ({"forecasters": []}, "forecasters: name at least one"),
    ({"forecasters": None}, "forecasters: name at least one"),
    ({"forecasters": 3}, "forecasters: 3 is neither a name nor makes forecasters"),
    ({"forecasters": {"mine": 3}}, "forecasters: 3 is neither"),
    ({"forecasters": {3: lae_sim.Hold}}, "forecasters: the name of a forecaster is text, not 3"),
    ({"forecasters": int}, r"forecasters: int has no method update\(frame, box\)"),
    ({"forecasters": {"hold": lae_sim.Kalman}}, "forecasters: 'hold' is the baseline"),
    (
        {"forecasters": [lambda box, size: lae_sim.Hold(box), lambda box, size: None]},
        "forecasters: two are called '<lambda>': give a mapping from names",
    ),
    ({"forecasters": "camera+kalman"}, "root: camera.kalman needs the frames"),
    ({"forecasters": "nowhere:Thing"}, "forecaster 'nowhere:Thing': ModuleNotFoundError"),
    ({"forecasters": "kalman:q=big"}, "forecaster 'kalman:q=big': one of its options"),
    ({"sigma": "x"}, f"sigma: 'x' {NOT_EXACT}"),
    ({"sigma": float("nan")}, f"sigma: 'nan' {NOT_EXACT}"),
    ({"sigma": True}, f"sigma: True {NOT_EXACT}"),
    ({"sigma": [0, None]}, f"sigma: None {NOT_EXACT}"),
    ({"sigma": []}, "sigma: name at least one permitted latency"),
    ({"latency": 47}, "latency: 47 is not a name, such as 'recorded' or 'constant:47ms'"),
    ({"latency": 0.047}, "latency: 0.047 is not a name"),
    ({"latency": "47ms"}, "latency: no latency '47ms': there are .*; did you mean constant:47ms?"),
    ({"latency": "47"}, "latency: no latency '47': there are .*; did you mean constant:47ms?"),
    ({"latency": "constant:47"}, f"latency: '47' {NO_UNIT}"),
    ({"latency": "recrded"}, "latency: .*; did you mean 'recorded'?"),
    ({"latency": "bootstrap"}, "latency: 'bootstrap' needs a whole number from 0"),
    ({"latency": []}, "latency: name at least one"),
    ({"latency": None}, "latency: name at least one"),
    ({"latency": lambda: 3}, "latency: TypeError"),
    ({"latency": lambda recording: lambda frame: 0.047}, "policy or latency: TypeError"),
    ({"scale": -1}, "scale: times cannot be scaled by -1"),
    ({"scale": "fast"}, f"scale: 'fast' {NOT_EXACT}"),
    ({"scale": 1e-9}, f"scale: '1e-09' {NOT_EXACT}"),
    ({"scale": []}, "scale: name at least one"),
    ({"fps": 0}, "fps: a frame rate must be above zero"),
    ({"fps": "thirty"}, f"fps: 'thirty' {NOT_EXACT}"),
    ({"policy": "lastest"}, "policy: no policy 'lastest': .*; did you mean 'latest'?"),
    ({"policy": 3}, "policy: 3 is not a name"),
    ({"policy": []}, "policy: name at least one"),
    ({"policy": "every:0"}, "policy: 'every:0' needs a whole number from 1"),
    ({"policy": lambda: 1}, "policy or latency: TypeError"),
    ({"timing": "missing.parquet"}, "timing: missing.parquet: no such file"),
    ({"timing": "constant:47ms"}, "timing: constant:47ms: no such file"),
    ({"timing": 3}, "timing: a trace is a path"),
    ({"passes": "missing.parquet"}, "passes: missing.parquet: no such file"),
    ({"passes": SLOW}, "two of the passes have the same stride: give each stride once"),
    ({"search": None}, "search: None is not text"),
    ({"search": "c=big"}, "search: no search 'c=big': there are off, trace, c=0.7"),
    ({"pre_forecaster": 3}, "pre_forecaster: 3 is not text"),
    ({"pre_forecaster": "kalman", "keep_size": "yes"}, "keep_size: 'yes' is neither true nor"),
    ({"convention": "psot"}, "no convention 'psot': .*; did you mean 'pysot'?"),
    ({"convention": ["pysot", "otb"]}, r"convention: \['pysot', 'otb'\] is not a name"),
    ({"costs": 2}, "costs: 2 is not text"),
    ({"costs": "kalman=2"}, f"costs: '2' {NO_UNIT}"),
    ({"costs": "kalmn=2ms"}, "the cost 'kalmn=2ms': there is no forecaster 'kalmn' here"),
    ({"sequences": "nowhere"}, "no sequence 'nowhere'"),
    ({"sequences": "boat-clam"}, "no sequence 'boat-clam'; did you mean 'boat-calm'?"),
    ({"sequences": 3}, "sequences: a sequence is named by text, not 3"),
    ({"sequences": []}, "sequences: name at least one"),
    ({"root": 3}, "root: the dataset's folder is a path, not 3"),
    (
        {"root": "synthetic", "camera_lag": "x", "forecasters": "camera+kalman"},
        "camera_lag: 'x' is not a whole number from 0",
    ),
]

FOR_COMPARISONS: list[tuple[dict[str, Any], str]] = [
    ({"forecasters": "offline"}, "forecasters: offline is always in the table"),
    ({"policy": "vot-realtime"}, "policy: vot-realtime never scores latency"),
    ({"policy": ["latest", "fifo"]}, "fps and policy: one of each"),
    ({"fps": [30, 60]}, "fps and policy: one of each"),
    ({"folds": 1}, "folds: training .* needs at least two folds"),
    ({"folds": 2.5}, "folds: 2.5 is not a whole number"),
    ({"seed": -1}, "seed: -1 is not a whole number from 0"),
    ({"seed": "x"}, "seed: 'x' is not a whole number"),
]


@pytest.mark.parametrize(("given", "message"), TRACES_AS_GIVEN)
@pytest.mark.parametrize("face", [lae_sim.evaluate, lae_sim.compare_forecasters])
def test_traces(face: Callable[..., Any], given: Any, message: str) -> None:
    assert message in fails(lambda: face(given))


@pytest.mark.parametrize(("settings", "message"), SETTINGS, ids=range(len(SETTINGS)))
@pytest.mark.parametrize("opened", [False, True], ids=["path", "open"])
def test_settings(
    trace: lae_sim.Trace, settings: dict[str, Any], message: str, opened: bool
) -> None:
    with pytest.raises(lae_sim.LaeError, match=message):
        lae_sim.evaluate(trace if opened else SLOW, **settings)
    fails(lambda: lae_sim.evaluate(SLOW, **settings))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *FOR_COMPARISONS,
        *(
            (settings, message)
            for settings, message in SETTINGS
            if {*settings}.isdisjoint({"timing", "passes"}) and "root" not in settings
        ),
    ],
)
def test_settings_of_comparisons(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(lae_sim.LaeError, match=message):
        lae_sim.compare_forecasters(SLOW, **settings)


@pytest.mark.parametrize(
    "call",
    [
        lambda: lae_sim.evaluate(SLOW, forecaster="hold"),
        lambda: lae_sim.evaluate(SLOW, sigmas=[0]),
        lambda: lae_sim.compare_forecasters(SLOW, timing=SLOW),
        lambda: lae_sim.replay_trace(SLOW, source="constant:47ms"),
        lambda: lae_sim.World(sigma=0),
        lambda: lae_sim.profile_tracker("dcf", stride=2),
    ],
)
def test_arguments_that_there_are_not(call: Callable[[], Any]) -> None:
    with pytest.raises(TypeError, match=r"unexpected keyword argument|did you mean 'strides'\?"):
        call()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sequence": "Gull2", "forecaster": "kalman"}, "sequence: no 'Gull2' in synthetic-slow"),
        ({"sequence": "boat-clam", "forecaster": "hold"}, "did you mean 'boat-calm'?"),
        ({"sequence": "boat-calm", "forecaster": "imm"}, "forecaster: no 'imm' here: there are"),
        ({"sequence": None, "forecaster": None}, "forecaster: no None here"),
        ({"sequence": "boat-calm", "forecaster": "hold", "sigma": 1}, "sigma: 1 is not evaluated"),
        ({"sequence": "boat-calm", "forecaster": "hold", "sigma": "x"}, "sigma: 'x' is not an ex"),
        ({"sequence": "boat-calm", "forecaster": "hold", "trace": "x"}, "trace: name one of"),
    ],
)
def test_answers(trace: lae_sim.Trace, arguments: dict[str, Any], message: str) -> None:
    result = lae_sim.evaluate(SLOW, sequences="boat-calm")
    assert message in fails(lambda: result.answers(**arguments))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"traces": None}, "traces: None is not text"),
        ({"traces": 3}, "traces: 3 is not text"),
        ({"traces": ()}, "traces: the list is empty"),
        ({"traces": []}, "traces: the list is empty"),
        ({"traces": (3,)}, "traces: 3 is not text"),
        ({"traces": "a", "latencies": "constant:47"}, f"latencies: '47' {NO_UNIT}"),
        ({"traces": "a", "latencies": ("47ms",)}, "latencies: no latency '47ms'"),
        ({"traces": "a", "scales": ("x",)}, f"scales: 'x' {NOT_EXACT}"),
        ({"traces": "a", "scales": (-1,)}, "scales: times cannot be scaled by less than 0"),
        ({"traces": "a", "fps": (0,)}, "fps: a frame rate must be above zero"),
        ({"traces": "a", "sigmas": ()}, "sigma: the list is empty"),
        ({"traces": "a", "policies": ()}, "policies: the list is empty"),
        ({"traces": "a", "forecasters": [lae_sim.Hold]}, "forecasters: .* is not text"),
        ({"traces": "a", "timing": None}, "timing: None is not text"),
        ({"traces": "a", "repetitions": 0}, "repetitions: 0 is not a whole number from 1"),
        ({"traces": "a", "seed": 1.5}, "seed: 1.5 is not a whole number"),
        ({"traces": "a", "attributes": "no"}, "attributes: 'no' is neither true nor false"),
        ({"traces": "a", "conventions": "psot"}, "no convention 'psot'"),
    ],
)
def test_studies(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(lae_sim.LaeError, match=message):
        lae_sim.Study(**keys)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "the key 'traces' is missing"),
        ({"study": "missing.toml"}, "missing.toml: no such file"),
        ({"study": SLOW}, r'name traces by traces=... .in a TOML file: traces = \["a.parquet"'),
        ({"study": [SLOW]}, "study: .* name traces by traces=..."),
        ({"study": 3}, "study: 3 is no TOML file"),
        ({"study": "a.toml", "traces": SLOW}, "traces: give a study, or its keys, not both"),
        ({"trace": SLOW}, "unknown key 'trace': did you mean 'traces'"),
        ({"traces": []}, "traces: the list is empty"),
        ({"traces": "x.parquet"}, "x.parquet: no such file"),
        ({"traces": SLOW, "forecasters": "kalmn"}, "did you mean 'kalman'"),
        ({"traces": SLOW, "sequences": "nowhere", "workers": 1}, "no sequence 'nowhere'"),
        ({"traces": SLOW, "costs": "imm=2ms"}, "there is no forecaster 'imm' here"),
        ({"traces": SLOW, "workers": 0}, "workers: 0 is not a whole number from 1"),
        ({"traces": SLOW, "workers": "x"}, "workers: 'x' is not a whole number"),
        ({"traces": SLOW, "workers": 1, "scheduler": "tcp://x"}, "workers: for this machine"),
        ({"traces": SLOW, "folder": 3}, "folder: a path, not 3"),
        (
            {"traces": SLOW, "folder": SLOW},
            "slow.parquet: is there already and is no folder",
        ),
        ({"traces": SLOW, "folder": str(TRACES)}, "is not empty and not of a study"),
    ],
)
def test_running_studies(
    arguments: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(lae_sim.LaeError, match=message):
        lae_sim.run_study(**arguments)


def test_a_study_reads_files_only(trace: lae_sim.Trace, tmp_path: Path) -> None:
    assert lae_sim.Study(traces=trace).traces == (SLOW,)
    assert lae_sim.Study(traces=[Path("a.parquet")], timing=Path("b")).timing == ("b",)
    in_memory = lae_sim.Trace(trace.metadata, list(trace))
    assert "write it first, with write_trace" in fails(lambda: lae_sim.Study(traces=in_memory))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tracker": "nothing"}, "no tracker 'nothing': there are dcf"),
        ({"tracker": 3}, "tracker: 3 is not text"),
        ({"dataset": "DTB70"}, "give the folder of DTB70 with --root .root=...."),
        ({"root": "nowhere"}, "nowhere: no such folder"),
        ({"sequences": "rice"}, "no sequence 'rice' among 12; there is race"),
        ({"sequences": 3}, "sequences: a sequence is named by text"),
        ({"fps": 0}, "fps: a frame rate must be above zero"),
        ({"strides": 1}, "strides: a stride is above 1"),
        ({"frame_timeout": 30}, f"frame_timeout: 30 {NO_UNIT}"),
        (
            {"pre_forecaster": "kalman", "pre_forecaster_cost": 3},
            f"pre_forecaster_cost: 3 {NO_UNIT}",
        ),
        ({"mode": "fast"}, "mode: no 'fast': there are every-frame and real-time"),
        ({"policy": "lastest"}, "policy: no policy 'lastest'"),
        ({"timing": "missing.parquet"}, "timing: missing.parquet: no such file"),
        ({"timing": 47}, "timing: 47 is not text"),
        ({"closed_loops": "constant:47"}, f"closed_loops: '47' {NO_UNIT}"),
        ({"warmup": -1}, "warmup: -1 is not a whole number from 0"),
        ({"repeat": 0}, "repeat: 0 is not a whole number from 1"),
        ({"threads": 0}, "threads: 0 is not a whole number from 1"),
        ({"options": {"nothing": 3}}, "unexpected keyword argument 'nothing'; it takes device"),
        ({"options": "size=3"}, "options: 'size=3' is no mapping"),
        ({"box": "1,2,3"}, "box: '1,2,3' is no box"),
        ({"in_process": "yes"}, "in_process: 'yes' is neither true nor false"),
        ({"translate": True}, "translate and keep_size are ways to use a pre_forecaster"),
        ({"out": "trace.txt"}, "out trace.txt: call the trace something.parquet"),
        ({"out": 3}, "out: a path, not 3"),
        ({"out": "no/folder/t.parquet"}, "cannot write no/folder/t.parquet: its folder is not"),
    ],
)
def test_profiles(
    settings: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(lae_sim.LaeError, match=message):
        lae_sim.profile_tracker(**settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policy": 3}, "policy: 3 is not a name"),
        ({"policy": ["latest"]}, "policy: ['latest'] is not a name"),
        ({"latency": 47}, "latency: 47 is not a name"),
        ({"scale": 1.5}, "exact; World.of takes text too"),
        ({"scale": True}, "exact; World.of takes text too"),
        ({"sigmas": [0]}, "sigmas of a World is a tuple"),
        ({"sigmas": (0.5,)}, "exact; World.of takes text too"),
        ({"sigmas": ()}, "sigma: name at least one"),
        ({"fps": 30.0}, "a frame rate must be exact"),
        ({"fps": Fraction(0)}, "fps: a frame rate must be above zero"),
        ({"convention": 3}, "convention: 3 is not a name"),
        ({"forecasters": "hold"}, "forecasters of a World is a tuple"),
        ({"forecasters": (3,)}, "forecasters: 3 is not a name"),
        ({"costs": (3,)}, "costs: 3 is not text"),
        ({"timing": 3}, "timing and passes: 3 is not a path"),
        ({"passes": (3,)}, "timing and passes: 3 is not a path"),
    ],
)
def test_worlds(fields: dict[str, Any], message: str) -> None:
    assert message in fails(lambda: lae_sim.World(**fields))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: lae_sim.World.of(sigma="x"), "sigma: 'x' is not"),
        (lambda t: lae_sim.World().replay("x.parquet"), "x.parquet: no such file"),
        (lambda t: lae_sim.World().replay(None), "a trace is a path"),
        (lambda t: lae_sim.replay_trace("x.parquet"), "trace: x.parquet: no such file"),
        (lambda t: lae_sim.replay_trace([SLOW]), "trace: a trace is a path"),
        (lambda t: lae_sim.replay_trace(SLOW, latency=47), "latency: 47 is not a name"),
        (lambda t: lae_sim.replay_trace(SLOW, timing="x"), "timing: x: no such file"),
        (lambda t: lae_sim.read_trace("x.parquet"), "x.parquet: no such file"),
        (lambda t: lae_sim.read_trace(3), "path: a trace is read from a path or a URL, not 3"),
        (lambda t: lae_sim.read_trace([SLOW]), "path: a trace is read from a path"),
        (lambda t: lae_sim.read_trace(str(TRACES)), "a folder, not a file"),
        (lambda t: lae_sim.read_trace(SLOW, "nowhere"), "no sequence 'nowhere'"),
        (lambda t: lae_sim.read_trace(SLOW, [3]), "sequences: a sequence is named by text"),
        (lambda t: t["nowhere"], "no sequence 'nowhere'"),
        (lambda t: t[0], "a sequence is named by text, not 0"),
        (lambda t: t.chosen("boat-calm")["car"], "of those chosen, no sequence 'car'"),
        (lambda t: lae_sim.validate(t), "path: a trace is read from a path"),
        (lambda t: lae_sim.write_trace("x.parquet", t), "write_trace takes a trace and a path"),
        (lambda t: lae_sim.write_trace(t, "/nowhere/x.parquet"), "cannot write /nowhere"),
        (lambda t: lae_sim.evaluate_runs(SLOW, t.metadata, {}), "runs: what replay_trace gives"),
        (
            lambda t: lae_sim.evaluate_runs(lae_sim.replay_trace(t), t.metadata, ["hold"]),
            "forecasters: factories by name",
        ),
        (lambda t: lae_sim.load_forecaster(lae_sim.Hold), "a forecaster is named by text"),
        (lambda t: lae_sim.read_study(None), "path: a study is read from a TOML file, not None"),
        (lambda t: lae_sim.find_dataset(root=3), "root: the dataset's folder is a path"),
        (lambda t: lae_sim.find_dataset(box=[1, 2]), "box: x, y, w, h in pixels"),
        (lambda t: lae_sim.synthetic_dataset(-1), "seed: a whole number from 0, not -1"),
        (lambda t: lae_sim.convert_results(3, "."), "results: a path, not 3"),
        (lambda t: lae_sim.write_report("x", "r.html"), "results: what run_study gives"),
        (lambda t: lae_sim.write_tables("x", "t"), "results: what run_study gives"),
        (lambda t: lae_sim.Metadata.new(True, "every-frame"), "True is not an exact number"),
        (lambda t: lae_sim.Metadata.new(30, "always"), "must be one of every-frame, real-time"),
        (
            lambda t: lae_sim.Recording.new("a", [[1, 2, 3]], [[1, 2, 3, 4]], [1]),
            "not boxes [T, 4]",
        ),
        (
            lambda t: lae_sim.Recording.new("a", [[1, 2, 3, 4]], [[1, 2, 3, 4]], [0.047]),
            "elapsed_ns: times are whole nanoseconds",
        ),
        (
            lambda t: lae_sim.Recording.new("a", [[1, 2, 3, 4]], [[1, 2, 3, 4]], [1, 2]),
            "differ in length",
        ),
        (lambda t: lae_sim.replay_sequence(t, Clock.at(Fraction(30))), "recording: one sequence"),
        (lambda t: lae_sim.replay_sequence(t["boat-calm"], 30), "clock: such as Clock.at"),
        (lambda t: lae_sim.simulate(9, 30, lambda frame: 1, lambda *_: (1, 1)), "clock: such as"),
        (lambda t: lae_sim.event_log(next(iter(lae_sim.replay_trace(t))), "x"), "'x' is not an ex"),
    ],
    ids=lambda value: "" if callable(value) else None,
)
def test_the_other_names(
    trace: lae_sim.Trace, call: Callable[[lae_sim.Trace], Any], message: str
) -> None:
    assert message in fails(lambda: call(trace))
