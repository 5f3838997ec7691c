"""The replay command line as a user runs it: what it prints and writes, exit statuses.

Much of it runs in this process, since starting another takes longer than the work.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from fractions import Fraction

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import run_here, run_process
from places import REPOSITORY

import lae_sim
from lae_sim.cli import replay as replay_command
from lae_sim.engine import lanes
from lae_sim.engine.policies import every, fifo, shrinking_tail, vot_realtime
from lae_sim.evaluation import pairing
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.evaluation.events import KINDS
from lae_sim.evaluation.metrics import CONVENTIONS, METRICS, success_curve
from lae_sim.evaluation.modelled import FIGURES
from lae_sim.figures.replay import sweep_figure
from lae_sim.forecast import base
from lae_sim.replay.latency import constant

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
FAST = REPOSITORY / "traces" / "synthetic-fast.parquet"
REAL_TIME = REPOSITORY / "traces" / "synthetic-slow-realtime.parquet"
CONFORMANCE = sorted((REPOSITORY.parent / "shared" / "conformance").glob("*.json"))


def replay(*arguments, cwd=None, status=0, run=run_here):
    """Run the command and return what it printed; its error text if it fails as expected."""
    done = run("replay", *arguments, cwd=cwd)
    assert done.returncode == status, done.stderr
    if status:
        assert "Traceback" not in done.stderr
        assert len(done.stderr.strip().splitlines()[-2:]) <= 2
        return done.stderr
    assert done.stderr == ""  # no progress bar where nobody looks
    return done.stdout


def replay_json(*arguments, **how):
    return json.loads(replay(*arguments, "--json", **how))


@pytest.mark.skipif(not CONFORMANCE, reason="the shared conformance cases are not here")
@pytest.mark.parametrize("path", CONFORMANCE, ids=lambda path: path.stem)
def test_conformance_cases_through_the_command_line(path, tmp_path):
    case = json.loads(path.read_text())
    expected = case["expected"]
    none = [np.nan] * 4
    truth = [none if box is None else box for box in case["truth"]]
    recording = lae_sim.Recording.new("case", truth, case["boxes"], case["elapsed_ns"])
    metadata = lae_sim.Metadata.new(case["fps"], "every-frame")
    trace = tmp_path / "case.parquet"
    lae_sim.write_trace(lae_sim.Trace(metadata, [recording]), trace)
    outputs, schedule = tmp_path / "outputs.parquet", tmp_path / "schedule.parquet"
    sigmas = list(expected["paired"])
    options = ["--forecaster", "hold", "kalman", "--sigma", *sigmas]
    options += ["--outputs", outputs, "--schedule", schedule]
    reports = {
        name: replay_json(trace, *options, "--convention", name)["traces"][0]
        for name in ("pysot", "exclude")
    }

    stored = pq.read_table(schedule)
    assert stored.schema.metadata[b"ticks_per_ns"] == str(expected["ticks_per_ns"]).encode()
    columns = [stored[name].to_pylist() for name in ("frame", "start_ticks", "ready_ticks")]
    assert [list(row) for row in zip(*columns)] == expected["processed"]
    answered = pq.read_table(outputs).to_pandas()
    for sigma in sigmas:
        at_sigma = answered[answered.sigma == float(Fraction(sigma))]
        held = at_sigma[at_sigma.forecaster == "hold"]
        assert held.source_frame.tolist() == expected["paired"][sigma]
        forecast = at_sigma[at_sigma.forecaster == "kalman"][["x", "y", "w", "h"]].to_numpy()
        np.testing.assert_allclose(forecast, expected["kalman"][sigma], rtol=0, atol=1e-6)
        for convention, report in reports.items():
            for result in report["results"]:
                if result["sigma"] == float(Fraction(sigma)):
                    figures = expected["metrics"][sigma][result["forecaster"]][convention]
                    for metric, value in figures.items():
                        assert result[metric] == pytest.approx(value, rel=0, abs=1e-9)
    pairs = expected["paired"]["0"]
    assert reports["pysot"]["mismatch_sum"] == sum(i - j for i, j in enumerate(pairs))
    assert reports["pysot"]["processed"] == len(expected["processed"])


def test_the_table_has_a_line_for_each_trace_and_forecaster():
    text = replay(SLOW, FAST, "--forecaster", "hold", "constant-velocity", "kalman")
    lines = [line.split() for line in text.splitlines() if line.startswith("synthetic-")]
    assert [line[:2] for line in lines] == [
        [f"synthetic-{speed}.parquet", forecaster]
        for speed in ("slow", "fast")
        for forecaster in ("hold", "constant-velocity", "kalman")
    ]
    assert "convention pysot, policy latest, latency recorded" in text
    assert "approximate: 637 outputs (38.2%)" in text
    assert "times: synthetic" in text


def test_json_agrees_with_the_api():
    report = replay_json(SLOW, "--latency", "constant:47ms", "--sigma", "0", "1/2")["traces"][0]
    trace = lae_sim.read_trace(SLOW)
    runs = lae_sim.replay_trace(trace, latency=constant(ns=47_000_000))
    forecasters = {"hold": lae_sim.Hold, "kalman": lae_sim.Kalman}
    sigmas = [Fraction(0), Fraction(1, 2)]
    found = evaluate_runs(runs, trace.metadata, forecasters, sigmas)
    assert report["world_frames"] == found.replay.frames.sum() == trace.frames
    assert report["processed"] == found.replay.processed.sum()
    assert report["mismatch_sum"] == found.staleness.mismatch_sum[:, 0].sum()
    assert [(r["forecaster"], r["sigma"]) for r in report["results"]] == [
        ("hold", 0.0), ("hold", 0.5), ("kalman", 0.0), ("kalman", 0.5),
    ]  # fmt: skip
    auc = [result["auc"] for result in report["results"]]
    np.testing.assert_allclose(auc, found.scores["auc"].mean(axis=1).ravel(), rtol=0, atol=1e-12)
    hold, kalman = report["results"][0], report["results"][2]
    loss = report["offline"]["auc"] - hold["auc"]
    assert kalman["recovered_auc"] == pytest.approx((kalman["auc"] - hold["auc"]) / loss)
    assert hold["recovered_auc"] is None
    assert hold["age_ms"] == pytest.approx(hold["mismatch_mean"] * 1000 / 30)


def test_the_sigma_grid_adds_plain_means():
    report = replay_json(SLOW, "--sigma-grid")["traces"][0]
    for name in ("hold", "kalman"):
        results = [result for result in report["results"] if result["forecaster"] == name]
        assert [round(result["sigma"] * 50) for result in results] == list(range(51))
        assert results[0]["mauc"] == pytest.approx(np.mean([r["auc"] for r in results]))
        assert results[0]["mdp"] == pytest.approx(np.mean([r["dp20"] for r in results]))
    assert "mAUC" in replay(SLOW, "--sigma-grid")
    assert "mauc" not in replay_json(SLOW)["traces"][0]["results"][0]


def test_eta_is_sigma_with_the_other_sign():
    with_eta = replay_json(SLOW, "--eta", "1/2")["traces"][0]["results"]
    assert with_eta == replay_json(SLOW, "--sigma=-1/2")["traces"][0]["results"]
    assert with_eta[0]["sigma"] == -0.5


def test_times_of_another_device():
    report = replay_json(SLOW, "--timing", FAST)["traces"][0]
    assert report["times_from"] == str(FAST)
    assert report["processed"] == replay_json(FAST)["traces"][0]["processed"]
    assert report["offline"] == replay_json(SLOW)["traces"][0]["offline"]


def test_a_real_time_trace_is_exact_as_it_was_recorded_and_refuses_other_frames():
    report = replay_json(REAL_TIME)["traces"][0]
    offline_known = replay_json(SLOW)["traces"][0]
    assert report["exact"]
    assert report["offline"] is None
    assert report["results"][0]["auc"] == offline_known["results"][0]["auc"]
    error = replay(REAL_TIME, "--latency", "constant:10ms", status=2)
    assert "'bike-pan', frame 1" in error
    assert "the trace has no box for it" in error


@pytest.mark.parametrize("policy", ["fifo", "every:2", "shrinking-tail:47ms", "vot-realtime"])
def test_policies_by_name(policy):
    report = replay_json(SLOW, "--policy", policy)["traces"][0]
    name = policy.split(":")[0]
    by_name = {
        "fifo": fifo,
        "every": every(2),
        "shrinking-tail": shrinking_tail(ns=47_000_000),
        "vot-realtime": vot_realtime(),
    }
    runs = list(lae_sim.replay_trace(lae_sim.read_trace(SLOW), policy=by_name[name]))
    assert report["policy"] == policy
    assert report["processed"] == sum(len(run.schedule.frames) for run in runs)


def test_a_stage_alone_is_faster_and_has_an_initialisation_of_its_own():
    staged = REPOSITORY / "traces" / "cases" / "valid" / "stages.parquet"
    error = replay(staged, "--latency", "stage:decode", status=2)
    assert "sequence 'a', frame 0: the trace has no time of decode for it" in error
    assert ",init=TIME" in error
    (found,) = replay_json(staged, "--latency", "stage:decode,init=2ms")["traces"]
    assert found["latency"] == "stage:decode,init=2ms"
    assert found["init"]["mean_ms"] == 2
    assert 950 < found["tracker_fps"] < 1050
    error = replay(staged, "--latency", "stage:warp,init=2ms", status=2)
    assert "no times of stage 'warp'" in error
    assert "it has those of decode, inference" in error


def test_vot_realtime_says_that_it_never_scores_latency():
    assert "never scores latency" in replay(SLOW, "--policy", "vot-realtime")
    vot, plain = (
        replay_json(SLOW, "--policy", name)["traces"][0] for name in ("vot-realtime", "latest")
    )
    assert vot["results"][0]["auc"] > plain["results"][0]["auc"] + 0.1


@pytest.mark.parametrize("latency", ["resample:7", "lognormal:7", "by-call", "constant:47ms"])
def test_latencies_by_name_are_deterministic_whatever_the_sequences(latency):
    everything = replay_json(SLOW, "--latency", latency, "--per-sequence")["traces"][0]
    again = replay_json(SLOW, "--latency", latency, "--per-sequence")["traces"][0]
    assert everything == again
    chosen = ("--sequence", "truck-far", "car-chase")
    some = replay_json(SLOW, "--latency", latency, "--per-sequence", *chosen)["traces"][0]
    for result, whole in zip(some["results"], everything["results"]):
        by_name = {one["sequence"]: one for one in whole["per_sequence"]}
        assert [one["sequence"] for one in result["per_sequence"]] == ["car-chase", "truck-far"]
        assert all(one == by_name[one["sequence"]] for one in result["per_sequence"])


def test_another_frame_rate_and_an_exact_scale():
    slower = replay_json(SLOW, "--fps", "30000/1001", "--latency-scale", "1/3")["traces"][0]
    assert (slower["fps"], slower["latency_scale"]) == ("30000/1001", "1/3")
    assert slower["processed"] > 2300


def test_attributes_and_sequences_have_their_tables():
    text = replay(SLOW, "--attributes", "--per-sequence")
    assert "Fast camera motion  hold" in text
    assert "car-chase     kalman" in text
    report = replay_json(SLOW, "--attributes")["traces"][0]
    scores = report["results"][1]["attributes"]["Occlusion"]
    assert scores["sequences"] == 3
    per_sequence = replay_json(SLOW, "--per-sequence")["traces"][0]["results"][1]["per_sequence"]
    names = ("car-occluded", "person-crowd", "runner-zoom")
    mean = np.mean([one["auc"] for one in per_sequence if one["sequence"] in names])
    assert scores["auc"] == pytest.approx(mean)


def test_result_text_files_score_as_the_table_says(tmp_path):
    replay(SLOW, "--export-txt", tmp_path / "results", "--sigma", "0", "1")
    folders = sorted(path.name for path in (tmp_path / "results").iterdir())
    assert folders == [
        "synthetic-slow-hold", "synthetic-slow-hold-sigma1",
        "synthetic-slow-kalman", "synthetic-slow-kalman-sigma1",
    ]  # fmt: skip
    results = replay_json(SLOW)["traces"][0]["results"]
    for name, result in zip(("hold", "kalman"), results):
        scores = []
        for recording in lae_sim.read_trace(SLOW):
            path = tmp_path / "results" / f"synthetic-slow-{name}" / f"{recording.name}.txt"
            boxes = np.loadtxt(path, delimiter=",")
            assert boxes.shape == (len(recording), 4)
            pysot = lae_sim.CONVENTIONS["pysot"]
            scores.append(success_curve(recording.truth, boxes, pysot).mean())
        assert np.mean(scores) == pytest.approx(result["auc"], abs=1e-12)
    error = replay(SLOW, "--export-txt", tmp_path / "results", status=2)
    assert "is there already" in error


def test_the_event_log_tells_the_same_story_as_the_schedule(tmp_path):
    path, schedule = tmp_path / "events.jsonl", tmp_path / "schedule.parquet"
    replay(SLOW, "--events", path, "--schedule", schedule, "--sequence", "boat-calm")
    events = [json.loads(line) for line in path.read_text().splitlines()]
    ticks = [event["tick"] for event in events]
    assert ticks == sorted(ticks)
    rows = pq.read_table(schedule).to_pylist()
    for kind, column in (("processing started", "start_ticks"), ("output ready", "ready_ticks")):
        logged = [(e["frame"], e["tick"]) for e in events if e["event"] == kind]
        assert logged == [(row["frame"], row[column]) for row in rows]
    count = {kind: sum(e["event"] == kind for e in events) for kind in KINDS}
    assert count["frame arrived"] == count["query answered"] == 300
    assert count["frame skipped"] == 300 - len(rows)
    queries = [event for event in events if event["event"] == "query answered"]
    sources = [event["source_frame"] for event in queries]
    assert count["forecaster updated"] == len(set(sources) - {0})


def test_a_picture(tmp_path):
    replay(SLOW, FAST, "--plot", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert "name a .png" in replay(SLOW, "--plot", tmp_path / "curves.txt", status=2)
    assert [path.name for path in tmp_path.iterdir()] == ["curves.png"]


def test_a_sweep_is_the_single_replays_one_after_another(tmp_path):
    options = ("--per-sequence", "--cost", "kalman=2ms", "--sigma", "0", "1/2")
    swept = replay_json(SLOW, FAST, "--fps", "60", "30", "--latency-scale", "1", "2", *options)
    settings = [(each["fps"], each["latency_scale"]) for each in swept["traces"][:4]]
    assert settings == [("60", "1"), ("60", "2"), ("30", "1"), ("30", "2")]
    for k, (trace, fps, scale) in {1: (SLOW, "60", "2"), 6: (FAST, "30", "1")}.items():
        alone = replay_json(trace, "--fps", fps, "--latency-scale", scale, *options)
        assert swept["traces"][k] == alone["traces"][0]
    # twice the rate is twice the time that everything takes
    scores = [[r["auc"] for r in each["results"] if r["forecaster"] == "hold"]
              for each in swept["traces"]]  # fmt: skip
    assert scores[0] == scores[3]


def test_a_sweep_has_columns_and_says_what_it_is_of():
    text = replay(SLOW, "--fps", "15", "30000/1001", "--attributes", "--per-sequence")
    tables = [line for line in text.splitlines() if "forecaster" in line]
    assert len(tables) == 5
    assert all(line.split()[2] == "fps" for line in tables)
    assert any(line.split()[1:3] == ["hold", "30000/1001"] for line in text.splitlines())
    assert "a sweep of the rate is one of how fast the world moves" in text
    text = replay(SLOW, "--latency-scale", "1/2", "2")
    assert text.split()[2] == "scale"
    assert "how fast the world moves" not in text
    assert "how fast the world moves" in " ".join(replay("--help").split())


def test_what_forecasting_costs_is_measured_once_in_a_sweep():
    found = replay_json(SLOW, "--latency-scale", "1", "2", "--cost", "measured")["traces"]
    assert found[0]["forecaster_cost_ns"] == found[1]["forecaster_cost_ns"]


def test_the_picture_of_a_sweep(tmp_path):
    both = ("--fps", "60", "15", "30", "--latency-scale", "1", "2")
    replay(SLOW, *both, "--plot", tmp_path / "both.svg")
    text = (tmp_path / "both.svg").read_text()
    for written in ("world frame rate (fps)", "times x 2", "offline", "kalman", "AUC"):
        assert f"<!-- {written} -->" in text
    reports = replay_json(SLOW, REAL_TIME, *both[:4], "--sigma", "0", "1", "--policy", "latest",
        "--sequence", "boat-calm", "--latency", "constant:40s")["traces"]  # fmt: skip
    labels = ["a", "a", "a", "b", "b", "b"]
    figure = sweep_figure(reports, labels, 1.0, ["fps"])
    assert [axes.get_title() for axes in figure.axes] == ["a", "a", "b", "b"]
    assert [len(axes.lines) for axes in figure.axes] == [3, 3, 2, 2]  # b lacks frames
    line = figure.axes[0].lines[1]
    assert (line.get_label(), line.get_xdata().tolist()) == ("kalman", [15, 30, 60])
    expected = [r["auc"] for k in (1, 2, 0) for r in reports[k]["results"][3:]]
    assert line.get_ydata().tolist() == expected


FORECASTER = """
class Still:
    def __init__(self, box, image_size=None):
        self.box = box
        self.size = image_size
    def update(self, frame, box):
        self.box = box
    def predict(self, frame):
        assert self.size == (1280, 720)
        return self.box
def one_argument(box):
    pass
def broken(box, image_size=None):
    class Broken(Still):
        def predict(self, frame):
            return [1.0, 2.0, float("nan"), 4.0]
    return Broken(box, image_size)
"""


def test_a_forecaster_of_ones_own(tmp_path):
    (tmp_path / "mine.py").write_text(FORECASTER)
    results = replay_json(
        SLOW, "--forecaster", "mine:Still", "--sigma-grid", cwd=tmp_path
    )["traces"][0]["results"]  # fmt: skip
    own = [result for result in results if result["forecaster"] == "mine:Still"]
    hold = [result for result in results if result["forecaster"] == "hold"]
    assert [result["auc"] for result in own] == [result["auc"] for result in hold]
    error = replay(SLOW, "--forecaster", "mine:broken", cwd=tmp_path, status=2)
    assert "mine:broken: predicted" in error
    error = replay(SLOW, "--forecaster", "mine:one_argument", cwd=tmp_path, status=2)
    assert "one_argument(box) (" in error
    assert "mine.py, line 11) is called as one_argument(box, image_size): too many" in error
    assert "no-such" in replay(SLOW, "--forecaster", "no-such", status=2)
    assert "ModuleNotFoundError" in replay(
        SLOW, "--forecaster", "no_such:thing", status=2, run=run_process
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["missing.parquet"], "missing.parquet: no such file"),
        ([__file__], "not a readable Parquet file"),
        ([SLOW, "--fps", "0"], "above zero"),
        ([SLOW, "--fps", "thirty"], "exact number"),
        ([SLOW, "--sigma", "1e-3"], "exact number"),
        ([SLOW, "--sigma", "0.123456789012"], "too fine"),
        ([SLOW, "--sigma", "0", "--eta", "0"], "not allowed with"),
        ([SLOW, "--policy", "newest"], "no policy 'newest'"),
        ([SLOW, "--policy", "every:0"], "whole number from 1"),
        ([SLOW, "--latency", "constant:47"], "with its unit"),
        ([SLOW, "--latency", "constant:47ms,init=800"], "init=800: write a time of 0 or more"),
        ([SLOW, "--latency", "constant:47ms,int=1s"], "after a comma comes init=TIME"),
        ([SLOW, "--latency", "resample"], "whole number"),
        ([SLOW, "--latency-scale", "-2"], "below zero"),
        ([SLOW, "--convention", "mine"], "no convention 'mine'"),
        ([SLOW, "--sequence", "no-such"], "no sequence 'no-such'"),
        ([SLOW, "--timing", "missing.parquet"], "no such file"),
        ([SLOW, FAST, "--outputs", "out.parquet"], "one trace at a time"),
        ([SLOW, "--outputs", "out", "--events", "./out"], "or another output"),
        ([SLOW, "--fps", "15", "30", "--schedule", "s.parquet"], "--schedule takes one frame rate"),
        ([SLOW, "--latency-scale", "1", "2", "--export-txt", "d"], "--export-txt takes one frame"),
        ([SLOW, "--schedule", SLOW], "would replace a file that is read"),
        ([SLOW, "--timing", FAST, "--plot", FAST], "would replace a file that is read"),
        ([SLOW, "--outputs", os.devnull], "is not a file"),
        ([SLOW, "--policy", "vot-realtime", "--sigma-grid"], "no permitted latency"),
        ([SLOW, "--outputs", "no/such/folder/out.parquet"], "cannot write"),
        ([REAL_TIME, "--latency-scale", "1/2", "--outputs", "o.parquet",
          "--schedule", "s.parquet", "--events", "e.jsonl", "--export-txt", "d"], "no time for it"),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line_and_leaves_nothing(arguments, words, tmp_path):
    error = replay(*arguments, cwd=tmp_path, status=2)
    assert words in error
    leftovers = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert leftovers == []


def written(path, recordings, kind="every-frame", **more):
    lae_sim.write_trace(lae_sim.Trace(lae_sim.Metadata.new("30", kind, **more), recordings), path)
    return path


def test_no_offline_score_unless_every_sequence_has_every_frame(tmp_path):
    [one] = lae_sim.read_trace(SLOW, ["boat-calm"])
    [other] = lae_sim.read_trace(REAL_TIME, ["car-chase"])
    path = written(tmp_path / "mixed.parquet", [one, other], kind="real-time")
    report = replay_json(path, "--per-sequence", "--policy", "latest")["traces"][0]
    assert report["offline"] is None
    assert "some sequences lack the boxes" in report["notes"][0]
    kalman = report["results"][1]
    assert kalman["recovered_auc"] is None
    assert [s["offline_auc"] is None for s in kalman["per_sequence"]] == [False, True]
    assert kalman["per_sequence"][0]["recovered_auc"] is not None


def test_frames_without_truth_are_counted_and_said(tmp_path):
    [one, other] = lae_sim.read_trace(SLOW, ["boat-calm", "car-chase"])
    bare = lae_sim.Recording.new("bare", other.truth * np.nan, other.boxes, other.elapsed_ns)
    one.truth[3] = np.nan
    path = written(tmp_path / "bare.parquet", [bare, one])
    report = replay_json(path, "--per-sequence")["traces"][0]
    assert report["frames_without_truth"] == 301
    assert report["notes"][0] == (
        "1 of 2 sequences have no ground truth after the first frame and are not scored, such as "
        "'bare'"
    )
    assert report["notes"][1] == (
        "1 frames have no ground truth; pysot counts them as missed by AUC and hit by DP"
    )
    for result in report["results"]:
        unscored, scored = result["per_sequence"]
        assert {unscored[m] for m in (*METRICS, "offline_auc", "offline_dp20")} == {None}
        assert {m: result[m] for m in METRICS} == {m: scored[m] for m in METRICS}
    assert report["offline"]["auc"] == report["results"][0]["per_sequence"][1]["offline_auc"]
    assert "leaves them out" in replay(path, "--convention", "exclude")


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("options", [[], ["--sigma-grid"], ["--latency", "constant:60ms"]])
def test_a_video_without_truth_has_no_score(tmp_path, convention, options):
    """Its trace has the box that the tracker was given, and no other truth."""
    [one] = lae_sim.read_trace(SLOW, ["boat-calm"])
    one.truth[1:] = np.nan
    path = written(tmp_path / "video.parquet", [one])
    report = replay_json(path, "--convention", convention, *options)["traces"][0]
    assert report["offline"] is None
    for result in report["results"]:
        figures = {name: result[name] for name in (*METRICS, "recovered_auc")}
        figures |= {name: result[name] for name in ("mauc", "mdp") if name in result}
        if result["modelled"]:
            figures |= {name: result["modelled"][name] for name in FIGURES}
        assert set(figures.values()) == {None}
    out = replay(path, "--convention", convention, *options)
    lines = [line.split() for line in out.splitlines() if line.startswith("video")]
    assert lines
    assert all(line.count("-") >= 8 and "nan" not in line for line in lines)
    assert "1 of 1 sequences have no ground truth after the first frame" in " ".join(out.split())
    assert report["search"] is None  # of scores that there are not, the model says nothing
    assert "--gaps" not in out


def test_attributes_that_there_are_not_make_an_empty_table():
    assert "AUC" in replay(SLOW, "--sequence", "boat-calm", "--attributes")


def test_stalls_of_skipped_frames_are_said(tmp_path):
    [one] = lae_sim.read_trace(FAST, ["boat-calm"])
    one.elapsed_ns[1] = 14_000_000_000  # the initialisation takes longer than a frame
    path = written(tmp_path / "stall.parquet", [one])
    [note] = replay_json(path)["traces"][0]["notes"]
    assert note.startswith("1 recorded times above 10 times the median (the longest 14 s)")
    assert replay_json(path, "--latency", "by-call")["traces"][0]["notes"] == []


def test_equal_file_names_and_equal_traces_do_not_collide(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x.parquet").write_bytes(FAST.read_bytes())
    both = ("a/x.parquet", "b/x.parquet")
    options = ("--export-txt", "out", "--sigma", "1/3", "0.333333", "--plot", "p.svg")
    text = replay(*both, *both, *options, cwd=tmp_path)
    assert [line.split()[0] for line in text.splitlines()[2:10:4]] == list(both)
    assert len(list((tmp_path / "out").iterdir())) == 8
    assert (tmp_path / "out" / "a-x-hold-sigma1_3" / "boat-calm.txt").exists()
    assert "b/x: kalman" in (tmp_path / "p.svg").read_text()


def test_what_a_figure_is_not_is_said(tmp_path):
    trace = lae_sim.read_trace(SLOW)
    plain = tmp_path / "plain.parquet"
    lae_sim.write_trace(
        lae_sim.Trace(lae_sim.Metadata.new("30", "every-frame"), list(trace)), plain
    )
    options = ("--forecaster", "kalman-lae-pvt")
    quick = (*options, "--latency", "recorded,init=20ms")  # so that no target gets away meanwhile
    assert replay_json(SLOW, *quick)["traces"][0]["notes"] == []
    [note] = replay_json(plain, *quick)["traces"][0]["notes"]
    assert "does not clip forecasts where the image size is unknown" in note
    assert note in replay(plain, *options)


NOT_MEASURED = "the trace's times: synthetic (made up, not measured)"


@pytest.mark.parametrize(
    ("options", "source", "words"),
    [
        ("--latency constant:47ms", "assumed: as a frame",
         "initialisation costs 47 ms, the same as a frame: an assumption; name it with ,init=TIME"),
        ("--latency constant:47ms,init=800ms", "assumed: 800 ms",
         "initialisation costs 800 ms: an assumption"),
        ("--latency lognormal:3,init=1s --latency-scale 2", "assumed: 1000 ms x 2",
         "initialisation costs 2,000 ms: an assumption"),
        ("--latency by-call,init=0s", "assumed: 0 ms", "initialisation costs 0 ms: an assumption"),
        ("", NOT_MEASURED, f": an assumption ({NOT_MEASURED})"),
        ("--latency bootstrap:1", NOT_MEASURED, f": an assumption ({NOT_MEASURED})"),
    ],
)  # fmt: skip
def test_what_initialisation_costs_is_said(options, source, words):
    [report] = replay_json(SLOW, *options.split(), "--per-sequence")["traces"]
    init, rows = report["init"], report["results"][0]["per_sequence"]
    assert init["source"] == source
    costs = [row["init_ms"] for row in rows]
    assert report["init_ms"] == init["mean_ms"] == pytest.approx(sum(costs) / len(costs))
    assert (init["min_ms"], init["max_ms"]) == (min(costs), max(costs))
    assert words in replay(SLOW, *options.split())


def test_measured_initialisations_are_called_so(tmp_path):
    trace = lae_sim.read_trace(SLOW)
    timing = {"timing": {"source": "measured"}}
    written(tmp_path / "m.parquet", list(trace), **timing)
    assert replay_json(tmp_path / "m.parquet")["traces"][0]["init"]["source"] == "measured"
    timed = replay_json(SLOW, "--timing", tmp_path / "m.parquet")["traces"][0]
    assert timed["init"]["source"] == "measured"
    assert "initialisation costs 282 ms, measured\n" in replay(tmp_path / "m.parquet")
    noted = {"timing": {"source": "measured", "note": "initialisations are unknown"}}
    written(tmp_path / "n.parquet", list(trace), **noted)
    assert "the trace's times: measured; initialisations" in replay(tmp_path / "n.parquet")


def test_a_slow_initialisation_costs_accuracy_and_names_who_gets_away():
    fast, slow = (
        replay_json(SLOW, "--latency", f"constant:20ms{init}")["traces"][0]
        for init in ("", ",init=2s")
    )
    assert fast["init"]["left_search"] == []
    names = slow["init"]["left_search"]
    assert "car-occluded" in names
    assert slow["results"][0]["auc"] < fast["results"][0]["auc"] - 0.02
    text = " ".join(replay(SLOW, "--latency", "constant:20ms,init=2s").split())
    assert f"around the initial box: {', '.join(names)} modelled: " in text


def test_attributes_that_the_trace_does_not_name(tmp_path):
    trace = lae_sim.read_trace(SLOW)
    plain = tmp_path / "plain.parquet"
    lae_sim.write_trace(
        lae_sim.Trace(lae_sim.Metadata.new("30", "every-frame"), list(trace)), plain
    )
    assert "names no attributes" in replay(plain, "--attributes", status=2)


def test_both_doors_lead_to_the_same_room():
    assert replay(FAST, run=run_process) == replay(FAST)
    listing = subprocess.run(
        [sys.executable, "-m", "lae_sim", "--help"], capture_output=True, text=True, cwd=REPOSITORY
    ).stdout
    assert "convert" in listing
    assert "replay" in listing
    assert "examples:" in replay("--help")


def test_a_reader_that_goes_away_is_no_error():
    script = f"{sys.executable} -m lae_sim.replay {SLOW} --per-sequence | head -1"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", script], capture_output=True, text=True, cwd=REPOSITORY
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_whatever_files_are_asked_for_nothing_is_replayed_paired_or_forecast_twice(
    tmp_path, monkeypatch, capsys
):
    calls = Counter()
    for function in (lanes.simulate_many, pairing.pair, base.forecast):
        name = function.__name__

        def counted(*arguments, _function=function, _name=name, **named):
            calls[_name] += 1
            return _function(*arguments, **named)

        for module in [m for key, m in sys.modules.items() if key.startswith("lae_sim.")]:
            if getattr(module, name, None) is function:
                monkeypatch.setattr(module, name, counted)
    asked = [str(SLOW), "--cost", "kalman=2ms", "--sigma", "1/2", "0", "--json"]
    asked += ["--search", "off"]
    assert replay_command.main(asked) == 0
    plain, alone = capsys.readouterr().out, calls.copy()
    # one group of sequences: one schedule, a pairing for each cost, and each forecaster once
    assert alone == {"simulate_many": 1, "pair": 2, "forecast": 2}
    calls.clear()
    files = {
        "--plot": "plot.svg",
        "--outputs": "outputs.parquet",
        "--schedule": "schedule.parquet",
        "--events": "events.jsonl",
        "--timeline": "timeline.json",
        "--export-txt": "results",
    }
    for option, name in files.items():
        asked += [option, str(tmp_path / name)]
    assert replay_command.main(asked) == 0
    assert capsys.readouterr().out == plain
    assert calls == alone
    assert {path.name for path in tmp_path.iterdir()} == set(files.values())
    calls.clear()
    timeline = ["--timeline", str(tmp_path / "timeline.svg"), "--search", "off"]
    assert replay_command.main([str(SLOW), *timeline]) == 0
    assert calls == {"simulate_many": 1, "pair": 1, "forecast": 2}


def test_a_fast_tracker_is_told_of_the_floor_of_one_frame():
    floor = "a floor of one frame for synthetic-fast.parquet, though almost no frame is skipped"
    both = replay(SLOW, FAST)
    assert " ".join(both.split()).count(floor) == 1
    assert "floor" not in replay(SLOW)
    assert "floor" not in replay(FAST, "--sigma", "1")
    assert "floor" not in replay(FAST, "--latency-scale", "9", "--policy", "fifo")
    assert "floor" not in replay(FAST, "--policy", "vot-realtime")
    for result in replay_json(FAST, "--latency", "constant:1ns")["traces"][0]["results"]:
        assert 0.99 < result["mismatch_mean"] < 1  # all but frame 0's answer, on time


DRONE = """
[camera]
delivery = "5ms"
drops = "every:10"
[resources]
gpu = 1
[[stages]]
name = "decode"
time = "6ms"
resource = "gpu"
[[stages]]
name = "tracker"
time = "20ms"
resource = "gpu"
"""


def test_a_pipeline_is_replayed_and_told_of(tmp_path):
    drone = tmp_path / "drone.toml"
    drone.write_text(DRONE)
    printed = replay(FAST, "--pipeline", str(drone), "--sequence", "boat-calm")
    assert "policy pipeline:drone, latency constant:20ms" in printed
    assert (
        "drone: the camera lost 30 of 300 frames and delivered the others after 5.0 ms" in printed
    )
    assert "decode   " in printed
    assert "resource gpu: in use 7" in printed
    (report,) = json.loads(
        replay(FAST, "--pipeline", str(drone), "--sequence", "boat-calm", "--json")
    )["traces"]
    assert report["pipeline"]["camera"]["lost"] == 30
    assert report["results"][0]["capture_age_ms"] > report["results"][0]["age_ms"]


def test_several_pipelines_stand_side_by_side(tmp_path):
    for name, queue in (("one", 1), ("ten", 10)):
        stage = f'[[stages]]\nname = "tracker"\ntime = "47ms"\nqueue = {queue}\n'
        (tmp_path / f"{name}.toml").write_text(stage)
    files = [str(tmp_path / f"{name}.toml") for name in ("one", "ten")]
    printed = replay(FAST, "--pipeline", *files, "--sequence", "boat-calm")
    assert printed.splitlines()[0].split()[:3] == ["trace", "forecaster", "pipeline"]
    assert "pipeline:ten" in printed.split("\n\n")[0]


def test_where_the_time_goes_is_drawn(tmp_path):
    drone = tmp_path / "drone.toml"
    drone.write_text(DRONE.replace('"6ms"', '"36ms"'))
    asked = ["--pipeline", drone, "--sequence", "boat-calm"]
    printed = replay(FAST, *asked, "--waterfall", tmp_path / "why.svg", "--out", tmp_path / "out")
    assert (
        "gpu is too slow: each frame needs it, decode for 36.0 ms and tracker for 20.0 ms:"
        in printed
    )
    assert "gpu is too slow" in (tmp_path / "why.svg").read_text()
    assert (tmp_path / "out" / "figures" / "waterfall.pdf").exists()
    done = run_here("replay", FAST, "--waterfall", tmp_path / "no.svg")
    assert (done.returncode, "--waterfall is of the stages of a --pipeline" in done.stderr) == (
        2,
        True,
    )


def test_a_pipeline_s_mistakes_name_file_stage_and_key(tmp_path):
    drone = tmp_path / "drone.toml"
    drone.write_text(DRONE.replace('"6ms"', '"6"'))
    done = run_here("replay", FAST, "--pipeline", drone)
    assert done.returncode == 2
    assert f"{drone}: stage 'decode': time: no latency '6'" in done.stderr
    drone.write_text(DRONE)
    done = run_here("replay", FAST, "--pipeline", drone, "--policy", "fifo")
    assert "fifo does not go with a pipeline" in done.stderr
    done = run_here("replay", FAST, "--pipeline", drone, "--plot", drone)
    assert done.returncode == 2
    assert drone.read_text() == DRONE
