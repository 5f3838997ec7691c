import json
from collections import Counter, defaultdict
from fractions import Fraction
from itertools import pairwise

import jsonschema
import numpy as np
import pytest
from command_line import run_here
from hypothesis import given
from hypothesis import strategies as st
from places import REPOSITORY
from trace_processor import queried

import lae_sim
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import every, fifo, latest
from lae_sim.evaluation.evaluate import evaluate_groups
from lae_sim.report.timeline import timeline_file, trace_events
from lae_sim.trace.file import Trace

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
COSTS = {"hold": 0, "kalman": 0, "slow": 25_000_000}

# From "Trace Event Format" (Google, 2016): the object format, metadata, complete and flow events.
_PLACE = {
    "pid": {"type": "integer"},
    "tid": {"type": "integer"},
    "name": {"type": "string"},
    "args": {"type": "object"},
}
_TIME = {"ts": {"type": "number", "minimum": 0}}
_KINDS = ["process_name", "process_sort_index", "thread_name", "thread_sort_index"]
_FLOW = {**_PLACE, **_TIME, "cat": {"type": "string"}, "id": {"type": "integer"}}


def _event(phase, properties, optional=("args",)):
    return {
        "type": "object",
        "properties": {"ph": {"const": phase}, **properties},
        "required": ["ph", *(name for name in properties if name not in optional)],
        "additionalProperties": False,
    }


SCHEMA = {
    "type": "object",
    "properties": {
        "displayTimeUnit": {"enum": ["ms", "ns"]},
        "otherData": {"type": "object"},
        "traceEvents": {
            "type": "array",
            "items": {
                "oneOf": [
                    _event("M", {**_PLACE, "name": {"enum": _KINDS}}, optional=()),
                    _event("X", {**_PLACE, **_TIME, "dur": {"type": "number", "minimum": 0}}),
                    _event("s", _FLOW),
                    _event("f", {**_FLOW, "bp": {"const": "e"}}),
                    _event("i", {**_PLACE, **_TIME, "s": {"const": "t"}}, optional=()),
                    _event("C", {**_PLACE, **_TIME}, optional=()),
                ]
            },
        },
    },
    "required": ["traceEvents"],
    "additionalProperties": False,
}


def run(times_ms=(150, 100, 40, 40), fps=10, policy=latest):
    boxes = np.zeros((len(times_ms), 4))
    elapsed = np.array(times_ms) * 1_000_000
    recording = lae_sim.Recording.new("sequence", boxes, boxes, elapsed)
    return lae_sim.replay_sequence(recording, Clock.at(Fraction(fps)), policy=policy)


def tracks(events):
    """The slices of each named track, per process."""
    names, found = {}, defaultdict(list)
    for event in events:
        if event["name"] == "thread_name":
            names[event["pid"], event["tid"]] = event["args"]["name"]
        elif event["ph"] == "X":
            found[names[event["pid"], event["tid"]]].append(event)
    return found


def test_the_whole_story_of_four_frames():
    found = tracks(trace_events(run(), Fraction(0), {"hold": 0}))
    story = {
        name: [(s["name"], s["ts"] / 1000, (s["ts"] + s["dur"]) / 1000) for s in slices]
        for name, slices in found.items()
    }
    assert story == {
        "camera": [(f"frame {i}", 100 * i, 100 * i + 100) for i in range(4)],
        "tracker": [
            ("frame 0", 0, 150), ("frame 1", 150, 250), ("frame 2", 250, 290),
            ("frame 3", 300, 340),
        ],
        "forecaster hold": [("initial box", 0, 300), ("update 2", 300, 400)],
        "queries": [
            ("0 answers 0", 0, 100), ("0 answers 1", 100, 200), ("0 answers 2", 200, 300),
            ("2 answers 3", 300, 400),
        ],
    }  # fmt: skip


def test_a_declared_cost_delays_the_answers_of_its_forecaster_alone():
    found = tracks(
        trace_events(run((150, 40, 40, 40)), Fraction(0), {"hold": 0, "slow": 120_000_000})
    )
    assert list(found) == [
        "camera", "tracker", "forecaster hold", "queries hold", "forecaster slow", "queries slow",
    ]  # fmt: skip
    free, slow = (found[f"queries {name}"] for name in ("hold", "slow"))
    assert [s["args"]["source_frame"] for s in free] == [0, 0, 1, 2]
    assert [s["args"]["source_frame"] for s in slow] == [0, 0, 0, 0]
    found = tracks(trace_events(run((150, 40, 40, 40)), Fraction(0), {"slow": 20_000_000}))
    update = found["forecaster slow"][-1]["args"]
    assert (update["cost_ns"], update["delayed_queries"]) == (20_000_000, 0)
    found = tracks(trace_events(run((150, 40, 40, 40)), Fraction(0), {"slow": 70_000_000}))
    update = found["forecaster slow"][-1]["args"]
    assert (update["source_frame"], update["delayed_queries"]) == (1, 1)


def piped(stages, length=5, fps=25, **others):
    """A run through a pipeline, 40 ms a frame."""
    boxes = np.zeros((length, 4))
    recording = lae_sim.Recording.new("sequence", boxes, boxes, np.zeros(length, np.int64))
    trace = Trace(lae_sim.Metadata.new(str(fps), "every-frame"), [recording])
    (replayed,) = lae_sim.replay_trace(trace, pipeline=lae_sim.Pipeline(stages, **others))
    return replayed


def instants(events, kind):
    """Instants or counts of each named track: what, and when in ms."""
    names, found = {}, defaultdict(list)
    for event in events:
        if event["name"] == "thread_name":
            names[event["tid"]] = event["args"]["name"]
        elif event["ph"] == kind:
            name = names.get(event["tid"], event["name"])
            what = event["name"] if kind == "i" else event["args"]["frames"]
            found[name].append((what, event["ts"] / 1000))
    return found


def test_a_pipeline_s_tracks_are_its_workers_resources_and_queues():
    # decoder and tracker need the core for 10 and 45 ms of each frame; two workers publish it in
    # 50 ms, of which one is enough; frame 3 is lost on its way
    stages = [
        lae_sim.Stage("decode", "10ms", resource="core"),
        lae_sim.Stage("tracker", "45ms", resource="core", priority=-1),
        lae_sim.Stage("publish", "50ms", workers=2),
    ]
    camera = lae_sim.Camera(delivery="5ms", drops=[3])
    events = list(trace_events(piped(stages, camera=camera, resources={"core": 1}), 0, {"hold": 0}))
    document = {"displayTimeUnit": "ms", "otherData": {}, "traceEvents": events}
    jsonschema.validate(document, SCHEMA)
    story = {
        name: [(s["name"], s["ts"] / 1000, (s["ts"] + s["dur"]) / 1000) for s in slices]
        for name, slices in tracks(events).items()
    }
    del story["camera"], story["forecaster hold"]
    assert story == {
        "decode": [
            ("frame 0", 5, 15), ("1 waits for core", 45, 60), ("frame 1", 60, 70),
            ("2 waits for core", 85, 115), ("frame 2", 115, 125), ("4 waits for core", 165, 170),
            ("frame 4", 170, 180),
        ],
        "tracker": [
            ("frame 0", 15, 60), ("frame 1", 70, 115), ("frame 2", 125, 170), ("frame 4", 180, 225),
        ],
        "publish 1": [("frame 1", 115, 165), ("frame 2", 170, 220), ("frame 4", 225, 275)],
        "core": [
            ("decode 0", 5, 15), ("tracker 0", 15, 60), ("decode 1", 60, 70),
            ("tracker 1", 70, 115), ("decode 2", 115, 125), ("tracker 2", 125, 170),
            ("decode 4", 170, 180), ("tracker 4", 180, 225),
        ],
        "queries": [
            ("0 answers 0", 0, 40), ("0 answers 1", 40, 80), ("0 answers 2", 80, 120),
            ("0 answers 3", 120, 160), ("0 answers 4", 160, 200),
        ],
    }  # fmt: skip
    assert instants(events, "i") == {
        "delivery": [
            ("delivered 0", 5), ("delivered 1", 45), ("delivered 2", 85), ("lost 3", 120),
            ("delivered 4", 165),
        ]
    }  # fmt: skip


def test_drops_are_instants_and_queues_are_counted():
    # the tracker takes 0 at 0 ms, 2 at 90 ms and 4 at 180 ms; 2 pushes 1 out, and 4 pushes 3 out
    stages = [lae_sim.Stage("tracker", "90ms")]
    events = list(trace_events(piped(stages), 0, {}))
    assert instants(events, "i")["tracker: dropped"] == [
        ("1: queue full", 80), ("3: queue full", 160),
    ]  # fmt: skip
    counts = instants(events, "C")["tracker: queue"]
    assert counts == [(0, 0), (1, 40), (1, 80), (0, 90), (1, 120), (1, 160), (0, 180)]


def test_workers_and_blocked_frames_have_tracks_of_their_own():
    stages = [
        lae_sim.Stage("tracker", "30ms", workers=2),
        lae_sim.Stage("publish", "100ms", when_full="block"),
    ]
    events = list(trace_events(piped(stages, 9), 0, {}))
    found = tracks(events)
    names = [s["name"] for s in found["tracker 1"]]
    assert names[:2] == ["frame 0", "frame 1"]
    blocked = [s for s in found["tracker 1"] if s["name"].endswith("is blocked")]
    assert [(s["name"], s["ts"] / 1000) for s in blocked][:1] == [("3 is blocked", 150)]
    for slices in found.values():  # of one worker, none overlaps
        for before, after in pairwise(slices):
            assert before["ts"] + before["dur"] <= after["ts"]


@given(
    times=st.lists(st.integers(0, 400), min_size=1, max_size=12),
    fps=st.sampled_from(["10", "29.97", "30000/1001", "240"]),
    sigma=st.fractions(-3, 3, max_denominator=50),
    policy=st.sampled_from([latest, fifo, every(2)]),
)
def test_the_tracks_are_the_schedule_and_the_event_log(times, fps, sigma, policy):
    replayed = run(times, fps, policy)
    schedule, clock = replayed.schedule, replayed.schedule.clock
    events = list(trace_events(replayed, sigma, COSTS))
    found = tracks(events)
    log = lae_sim.event_log(replayed, sigma)
    camera, tracker, queries = (found[n] for n in ("camera", "tracker", "queries hold, kalman"))
    assert [s["args"]["tick"] for s in camera] == [e.tick for e in log if e.kind == "frame arrived"]
    assert [s["args"]["frame"] for s in camera if s["args"]["skipped"]] == [
        e.frame for e in log if e.kind == "frame skipped"
    ]
    for name in ("frame", "start_ticks", "ready_ticks"):
        expected = {"frame": "frames", "start_ticks": "start", "ready_ticks": "ready"}[name]
        assert [s["args"][name] for s in tracker] == getattr(schedule, expected).tolist()
    answered = [e for e in log if e.kind == "query answered"]
    assert [
        (s["args"]["tick"], s["args"]["frame"], s["args"]["source_frame"]) for s in queries
    ] == [(e.tick, e.frame, e.source_frame) for e in answered]
    assert all(
        s["args"]["age_frames"] == s["args"]["frame"] - s["args"]["source_frame"] for s in queries
    )
    updated = [(e.tick, e.frame) for e in log if e.kind == "forecaster updated"]
    for name in ("hold", "kalman"):
        seen = [(s["args"]["tick"], s["args"]["source_frame"]) for s in found[f"forecaster {name}"]]
        assert [each for each in seen if each[1]] == updated
    # instants are whole nanoseconds, rounded down, exactly; slices never overlap
    later = max(-int(sigma // 1), 0) * clock.frame_ticks
    for name, slices in found.items():
        spans = [(Fraction(str(s["ts"])), Fraction(str(s["dur"]))) for s in slices]
        for (ts, _), s in zip(spans, slices):
            tick = s["args"]["start_ticks" if name == "tracker" else "tick"]
            assert ts * 1000 == (tick + later) // clock.ticks_per_ns
        for (ts, dur), (following, _) in pairwise(spans):
            assert dur >= 0
            assert ts + dur <= following
            assert name == "tracker" or ts + dur == following
    # arrows lead from an output to the first query that it answers
    flows = [e for e in events if e["ph"] in "sf"]
    assert [e["ph"] for e in flows] == ["s", "f"] * (len(flows) // 2)
    assert [a["id"] == b["id"] for a, b in zip(flows[::2], flows[1::2])] == [True] * (
        len(flows) // 2
    )
    assert len({e["id"] for e in flows}) == len(flows) // 2
    first = {s["args"]["source_frame"]: s["ts"] for s in reversed(queries)}
    tid = queries[0]["tid"] if queries else None
    assert [f["ts"] for f in flows if f["tid"] == tid] == [first[j] for j in sorted(first) if j]


def replay(*arguments, status=0, cwd=None):
    done = run_here("replay", *arguments, cwd=cwd)
    assert done.returncode == status, done.stderr
    return done.stderr if status else done.stdout


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Two sequences, where kalman's answers come later; the table says the same as without."""
    path = tmp_path_factory.mktemp("timeline") / "out.json"
    options = ("--sequence", "boat-calm", "car-chase", "--sigma", "1/2", "0")
    text = replay(SLOW, *options, "--cost", "kalman=2ms", "--timeline", path)
    assert text == replay(SLOW, *options, "--cost", "kalman=2ms")
    return path


def test_the_file_is_of_the_trace_event_format(written):
    document = json.loads(written.read_text())
    jsonschema.validate(document, SCHEMA)
    assert document["otherData"] == {"sigma": "0.5"}
    events = document["traceEvents"]
    named = [e["args"]["name"] for e in events if e["name"] == "process_name"]
    assert named == ["boat-calm", "car-chase"]
    runs = lae_sim.replay_trace(lae_sim.read_trace(SLOW, named))
    expected = [
        event
        for process, each in enumerate(runs, 1)
        for event in trace_events(each, Fraction(1, 2), {"hold": 0, "kalman": 2_000_000}, process)
    ]
    assert events == expected


def test_perfetto_loads_every_slice_and_flow(written):
    events = json.loads(written.read_text())["traceEvents"]
    slices, depth, flows, errors, threads = queried(
        written,
        "SELECT s.ts, s.dur, s.name, t.tid, p.name AS process, t.name AS thread FROM slice s "
        "JOIN thread_track k ON s.track_id = k.id JOIN thread t USING (utid) "
        "JOIN process p USING (upid) ORDER BY p.pid, t.tid, s.ts, s.id",
        "SELECT max(depth) AS depth FROM slice",
        "SELECT a.name AS output, b.name AS answer FROM flow "
        "JOIN slice a ON slice_out = a.id JOIN slice b ON slice_in = b.id",
        "SELECT name FROM stats WHERE value > 0 AND severity <> 'info'",
        "SELECT name FROM thread WHERE is_main_thread AND name IS NOT NULL",
    )
    assert (errors, threads, depth) == ([], [], [{"depth": 0}])
    processes = {e["pid"]: e["args"]["name"] for e in events if e["name"] == "process_name"}
    expected = [
        (round(e["ts"] * 1000), round(e["dur"] * 1000), e["name"], e["tid"], processes[e["pid"]])
        for e in events
        if e["ph"] == "X"
    ]
    columns = ("ts", "dur", "name", "tid", "process")
    assert [tuple(row[name] for name in columns) for row in slices] == expected
    assert len(flows) == sum(e["ph"] == "f" for e in events) > 800
    for row in flows:
        assert row["output"].removeprefix("frame ") == row["answer"].split()[0]


def test_perfetto_loads_the_tracks_of_a_pipeline(tmp_path):
    path = tmp_path / "out.json"
    options = ("--sequence", "boat-calm", "--latency", "constant:47ms")
    replay(SLOW, *options, "--pipeline", SLOW.with_name("pipeline.toml"), "--timeline", path)
    events = json.loads(path.read_text())["traceEvents"]
    slices, counts, errors = queried(
        path,
        "SELECT t.name AS thread, count(*) AS n FROM slice s JOIN thread_track k "
        "ON s.track_id = k.id JOIN thread t USING (utid) GROUP BY t.name",
        "SELECT k.name AS name, count(*) AS n FROM counter c JOIN process_counter_track k "
        "ON c.track_id = k.id GROUP BY k.name",
        "SELECT name FROM stats WHERE value > 0 AND severity <> 'info'",
    )
    assert errors == []
    expected = Counter(e["name"] for e in events if e["ph"] == "C")
    assert {row["name"].removesuffix(" frames"): row["n"] for row in counts} == expected
    names = {e["tid"]: e["args"]["name"] for e in events if e["name"] == "thread_name"}
    shown = Counter(names[e["tid"]] for e in events if e["ph"] in "Xi")
    assert {row["thread"]: row["n"] for row in slices} == shown
    assert {"decode", "tracker", "tracker: dropped", "publish", "delivery"} < shown.keys()


def test_a_picture_of_the_first_sequence(tmp_path):
    replay(SLOW, "--timeline", tmp_path / "out.svg", "--sequence", "car-chase", "boat-calm")
    assert "boat-calm: who answers what" in (tmp_path / "out.svg").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([SLOW, "--timeline", "out.txt"], "name a .json file, for Perfetto, or a .png"),
        ([SLOW, "--timeline", "out.png", "--cost", "2ms"], "cannot show what forecasters cost"),
        ([SLOW, "--timeline", "out.json", "--policy", "vot-realtime"], "no --timeline"),
        ([SLOW, "--timeline", "out.json", "--events", "out.json"], "or another output"),
        ([SLOW, SLOW.with_name("synthetic-fast.parquet"), "--timeline", "o.json"], "one trace"),
    ],
)
def test_what_cannot_be_drawn_is_said_and_leaves_nothing(arguments, words, tmp_path):
    assert words in replay(*arguments, status=2, cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_no_timeline(tmp_path):
    def fails():
        metadata, forecasters = lae_sim.Metadata.new("30", "every-frame"), {"hold": lae_sim.Hold}
        with timeline_file(str(tmp_path / "o.json"), Fraction(0), {}) as observer:
            list(evaluate_groups([run()], metadata, forecasters, observers=[observer]))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fails()
    assert list(tmp_path.iterdir()) == []
