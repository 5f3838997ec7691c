import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
import scipy.io

from lae_sim.cli.convert import main
from lae_sim.cli.replay import main as replay_main
from lae_sim.engine.clock import Clock
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.file import read_trace

TRUTH = np.array([[10 + 3 * i, 20, 30 + i % 3, 40] for i in range(6)], float)
TIMES = [100_000_000, 20_000_000, 20_000_001, 26_255_000, 20_000_000, 20_000_000]


def write(path, rows, separator=","):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = (separator.join(str(cell) for cell in np.atleast_1d(row)) for row in rows)
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def world(tmp_path):
    """A dataset ``D`` of two sequences, and a tracker ``KCF`` of the GOT-10k toolkit."""
    for name in ("a", "b"):
        write(tmp_path / "D" / "anno" / f"{name}.txt", TRUTH)
        write(tmp_path / "KCF" / f"{name}.txt", TRUTH + 1)
        write(tmp_path / "KCF" / f"{name}_time.txt", [f"{ns / 1e9:.9f}" for ns in TIMES])
    (tmp_path / "D" / "attributes.csv").write_text("sequence,Occlusion\na,1\nb,0\n")
    return tmp_path


@pytest.fixture
def convert(world, capsys):
    """Runs the command on paths in the world; gives its status, output and errors."""

    def run(results, *options, out="t.parquet", truth="D"):
        paths = [str(world / results), "--truth", str(world / truth), "--out", str(world / out)]
        status = main([*paths, *options])
        printed = capsys.readouterr()
        if status:
            assert printed.err.startswith("lae-sim convert: error: ")
            assert printed.err.count("\n") <= 2
            assert not (world / out).exists()
        return status, printed.out, printed.err

    return run


def test_a_trace_from_text(world, convert):
    status, out, _ = convert("KCF", "--device", "Jetson AGX", "--image-size", "640x480")
    assert status == 0
    assert "KCF on D, 2 sequences, 12 frames at 30 fps, every frame; median 20 ms" in out
    assert "Read as got10k; times: measured." in out
    assert out.endswith(f"Next: lae-sim replay {world / 't.parquet'}\n")
    trace = read_trace(world / "t.parquet")
    assert (trace.metadata.tracker, trace.metadata.device) == ("KCF", "Jetson AGX")
    assert (trace.metadata.kind, trace.metadata.timing_note) == ("every-frame", None)
    assert trace.metadata.document["dataset"] == {"name": "D"}
    assert trace.metadata.attributes("a") == ("Occlusion",)
    assert trace.metadata.image_size("b") == (640, 480)
    for recording, name in zip(trace, "ab", strict=True):
        assert recording.name == name
        np.testing.assert_array_equal(recording.truth, TRUTH)
        np.testing.assert_array_equal(recording.boxes, TRUTH + 1)
        assert recording.elapsed_ns.tolist() == TIMES


def test_json(world, convert):
    _, out, _ = convert("KCF", "--json", "--exclude", "a", "--fps", "30000/1001")
    summary = json.loads(out)
    assert summary == {
        "trace": str(world / "t.parquet"),
        "format": "got10k",
        "schedule": "every-frame",
        "fps": "30000/1001",
        "tracker": "KCF",
        "dataset": "D",
        "timing": {"source": "measured"},
        "sequences": 1,
        "frames": 6,
        "processed": 6,
        "median_ms": 20.0000005,
        "times_read_as": "seconds per frame, as no unit was given",
        "held": {},
        "frame_times": None,
        "numbers_missing": [],
        "row_0_from_truth": [],
        "other_trackers": [],
        "without_truth": [],
        "without_results": [],
        "notes": [],
    }


def test_given_times_are_said_to_be_given(world, convert):
    for option, note, ns in (
        ("constant:47ms", "constant 47 ms, not measured", 47_000_000),
        ("mean-fps:120", "mean fps 120 given, not measured per frame", 8_333_333),
    ):
        status, out, _ = convert("KCF", "--time", option)
        assert status == 0
        assert f"times: {note}." in out
        trace = read_trace(world / "t.parquet")
        assert trace.metadata.timing_note == note
        assert {ns} == {time for recording in trace for time in recording.elapsed_ns.tolist()}


def test_the_first_frame_of_each_sequence_takes_what_the_initialisation_does(world, convert):
    for option, frame_ns in (("constant:47ms", 47_000_000), ("mean-fps:120", 8_333_333)):
        status, out, _ = convert("KCF", "--time", f"{option},init=800ms")
        assert status == 0
        assert ", initialisation 800 ms, not measured" in out
        trace = read_trace(world / "t.parquet")
        for recording in trace:
            first, *others = recording.elapsed_ns.tolist()
            assert first == 800_000_000
            assert set(others) == {frame_ns}


def test_times_beyond_64_bits_are_refused(world, convert):
    (world / "f.csv").write_text("sequence,fps\na,0.000000000001\nb,20\n")
    for option in ("constant:999999999999s", "constant:47ms,init=999999999999s",
                   "mean-fps:0.000000000001", f"mean-fps:{world / 'f.csv'}"):  # fmt: skip
        status, _, error = convert("KCF", "--time", option)
        assert status == 2
        assert "too long a time" in error
    for name in "ab":
        path = world / "ECO" / f"{name}.mat"
        path.parent.mkdir(exist_ok=True)
        scipy.io.savemat(path, {"res": TRUTH, "fps": 1e-300})
    status, _, error = convert("ECO")
    assert status == 2
    assert "a.mat: a mean of 1e-300 fps: too long a time" in error


def test_mat_results(world, convert):
    for name, fps in (("a", 25.0), ("b", 50.0)):
        path = world / "mat" / f"{name}_ECO.mat"
        path.parent.mkdir(exist_ok=True)
        scipy.io.savemat(path, {"results": {"res": TRUTH, "fps": fps, "type": "rect"}})
    status, out, _ = convert("mat")
    assert status == 0
    assert "ECO on D" in out
    trace = read_trace(world / "t.parquet")
    assert [int(recording.elapsed_ns[3]) for recording in trace] == [40_000_000, 20_000_000]
    assert "not measured per frame" in trace.metadata.timing_note


def test_npz_results(world, convert):
    np.savez(world / "Nano.npz", a=TRUTH, b=TRUTH)
    assert "no times; give --time" in convert("Nano.npz")[2]
    (world / "fps.csv").write_text("tracker,sequence,fps\nNano,a,10\nNano,b,20\n")
    status, out, _ = convert("Nano.npz", "--time", f"mean-fps:{world / 'fps.csv'}")
    assert status == 0
    assert "Nano on D" in out
    elapsed = [int(recording.elapsed_ns[0]) for recording in read_trace(world / "t.parquet")]
    assert elapsed == [100_000_000, 50_000_000]


def test_real_time_pickles(world, convert):
    # Frames arrive every 33.3 ms until 200 ms. The first output of a is ready 1 ms before frame 3
    # arrives, and the loop took frame 3 all the same.
    runs = {
        "a": ([0, 3, 4, 5], [0.099, 0.132, 0.17, 0.21]),
        "uav_b": ([0, 2, 3, 5], [0.07, 0.12, 0.17, 0.21]),
    }
    (world / "rt").mkdir()
    for name, (frames, timestamps) in runs.items():
        run = {
            "results_raw": TRUTH[frames].tolist(),
            "timestamps": timestamps,
            "input_fidx": frames,
            "runtime": [0.04] * 4,
        }
        (world / "rt" / f"{name}.pkl").write_bytes(pickle.dumps(run))
    status, out, _ = convert("rt")
    assert status == 0
    trace = read_trace(world / "t.parquet")
    assert trace.metadata.kind == "real-time"
    assert "1 of 8 times prolonged, by at most 1 ms" in trace.metadata.document["timing"]["note"]
    assert "1 of 8 times prolonged, by at most 1 ms" in out
    assert "in real time, 8 processed" in out
    for recording, frames in zip(trace, ([0, 3, 4, 5], [0, 2, 3, 5]), strict=True):
        schedule = replay_sequence(recording, Clock.at(trace.metadata.fps)).schedule
        assert schedule.frames.tolist() == frames
    assert (
        "--time and --time-unit do not go with lae-pvt"
        in convert("rt", "--time", "constant:1ms", out="u")[2]
    )


def test_a_hostile_pickle(world, convert):
    (world / "rt").mkdir()
    (world / "rt" / "a.pkl").write_bytes(b"cos\nsystem\n(S'touch " + b"x'\ntR.")
    status, _, err = convert("rt")
    assert status == 2
    assert "a.pkl: refuses os.system" in err


def test_missing_truth(world, convert):
    write(world / "KCF" / "c.txt", TRUTH)
    write(world / "KCF" / "c_time.txt", [0.02] * 6)
    status, _, err = convert("KCF")
    assert status == 2
    assert "no ground truth for c, of 3 results; --skip-missing" in err
    status, out, _ = convert("KCF", "--skip-missing")
    assert status == 0
    assert "Left out, without ground truth: c." in out


def test_truth_without_results(world, convert):
    write(world / "D" / "anno" / "z.txt", TRUTH)
    assert "Without results: z." in convert("KCF")[1]


def test_a_row_0_in_another_scale_is_said(world, convert):
    write(world / "KCF" / "a.txt", [TRUTH[0] * 1.9, *TRUTH[1:]])
    status, out, _ = convert("KCF")
    assert status == 0
    assert (
        "Row 0 is not the initial box in 1 of 2 sequences (a); there the trace starts from" in out
    )
    assert read_trace(world / "t.parquet")["a"].boxes.tolist() == TRUTH.tolist()


def test_boxes_by_centre_are_refused(world, convert):
    write(world / "KCF" / "b.txt", TRUTH + [[w / 2, h / 2, 0, 0] for *_, w, h in TRUTH])
    status, _, err = convert("KCF")
    assert status
    assert "sequence 'b'" in err
    assert "looks like boxes by centre (cx, cy, w, h): mean IoU 0.1" in err
    assert "--exclude b" in err


def test_lengths_are_checked(world, convert):
    write(world / "KCF" / "a.txt", TRUTH[:5])
    _, _, err = convert("KCF")
    assert "a.txt has 5 boxes and" in err
    assert "a_time.txt has 6 times" in err
    write(world / "KCF" / "a_time.txt", [0.02] * 5)
    _, _, err = convert("KCF")
    assert "a.txt has 5 boxes and" in err
    assert "has 6 rows of ground truth; if the first frame's box is missing, write" in err
    assert "--truth-file a=FILE" in err
    write(world / "a5.txt", TRUTH[:5])
    assert convert("KCF", "--truth-file", f"a={world / 'a5.txt'}")[0] == 0


def test_units_are_checked(world, convert):
    write(world / "KCF" / "b_time.txt", ["35.2"] * 6)
    _, _, err = convert("KCF")
    assert "b_time.txt: the unit of its times is not known (median 35.2): add --time-unit" in err
    assert "--time-unit ms (35.2 ms a frame)" in err
    status, out, _ = convert("KCF", "--time-unit", "ms", "--sequence", "b")
    assert status == 0
    assert "Times read as milliseconds per frame." in out
    [recording] = read_trace(world / "t.parquet")
    assert set(recording.elapsed_ns.tolist()) == {35_200_000}


def test_times_since_the_start(world, convert):
    write(world / "KCF" / "b_time.txt", np.arange(1, 7) / 2)
    _, _, err = convert("KCF")
    assert "b_time.txt: its times ascend from row to row, 0.5 to 3" in err
    assert convert("KCF", "--time-unit", "cumulative-s", "--sequence", "b")[0] == 0
    [recording] = read_trace(world / "t.parquet")
    assert set(recording.elapsed_ns.tolist()) == {500_000_000}
    _, out, _ = convert("KCF", "--time-unit", "ms", "--sequence", "b")
    assert "Note: times ascend from row to row in 1 of 1 sequences (b)" in out


def test_a_unit_without_measured_times(world, convert):
    for options in (["--time", "constant:47ms"], ["--format", "ope", "--time", "mean-fps:9"]):
        _, _, err = convert("KCF", *options, "--time-unit", "ms")
        assert "--time-unit is that of measured times" in err
    assert "no 'minutes': there are s, ms" in convert("KCF", "--time-unit", "minutes")[2]


def test_corners_name_the_file(world, convert):
    corners = np.concatenate([TRUTH[:, :2], TRUTH[:, :2] + TRUTH[:, 2:]], axis=1)
    write(world / "KCF" / "b.txt", corners)
    _, _, err = convert("KCF")
    assert "b.txt" in err
    assert "boxes look like x1, y1, x2, y2" in err


def test_lost_frames(world, convert):
    write(world / "KCF" / "a.txt", [*TRUTH[:5], ["nan"] * 4])
    status, out, _ = convert("KCF")
    assert status == 0
    assert "had no box in 1 frames of 1 sequences (a); there its last one stands." in out


def test_one_file_against_one_truth_file(world, convert):
    write(world / "KCF" / "mine.txt", TRUTH)
    status, *_ = convert("KCF/mine.txt", "--time", "constant:20ms", truth="D/anno/a.txt")
    assert status == 0
    [recording] = read_trace(world / "t.parquet")
    assert recording.name == "a"


def test_other_errors(world, convert):
    for results, options, problem in (
        ("none", [], "no such file or folder"),
        ("KCF", ["--format", "mat"], "no results found of format mat"),
        ("KCF", ["--sequence", "x"], "no results of sequence x"),
        ("KCF", ["--fps", "fast"], "is not an exact number"),
        ("KCF", ["--time", "constant:47"], "with its unit"),
        ("KCF", ["--repetition", "0"], "counts from 1"),
        ("KCF", ["--repetition", "2"], "1 columns of times, not 2"),
        ("KCF", ["--exclude", "a", "b"], "leaves no sequence"),
    ):
        status, _, err = convert(results, *options)
        assert status == 2
        assert problem in err


def test_another_dataset(world, convert):
    write(world / "E" / "x.txt", TRUTH)
    assert (
        "no ground truth for a, b, of 2 results; is it the right dataset? It has "
        in convert("KCF", truth="E")[2]
    )


def test_two_files_for_one_sequence(world, convert):
    write(world / "KCF" / "uav_a.txt", TRUTH)
    assert "are both results of sequence 'a'" in convert("KCF")[2]


def test_an_unwritable_output(convert):
    assert "cannot write" in convert("KCF", out="none/t.parquet")[2]


def test_ten_frames_a_second_by_name(world, convert):
    (world / "D").rename(world / "UAV123_10fps")
    assert "at 10 fps" in convert("KCF", truth="UAV123_10fps")[1]


def test_as_a_process(world):
    command = [sys.executable, "-m", "lae_sim", "convert"]
    listing = subprocess.run([*command, "--help"], capture_output=True, text=True, check=True)
    assert "examples:" in listing.stdout
    arguments = [str(world / "KCF"), "--truth", str(world / "D"), "--out", str(world / "t.parquet")]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    failed = subprocess.run([*command, *arguments, "--fps", "0"], capture_output=True, text=True)
    assert failed.returncode == 2
    assert failed.stderr.startswith("lae-sim convert: error: ")
    wrong = subprocess.run([*command, "--bad"], capture_output=True, text=True)
    assert wrong.returncode == 2


def test_help_is_light():
    code = (
        "import sys\nfrom lae_sim.cli.convert import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "assert not {'numpy', 'pyarrow', 'scipy', 'pandas', 'simpy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def scores(path):
    trace = read_trace(path)
    runs = [replay_sequence(recording, Clock.at(trace.metadata.fps)) for recording in trace]
    found = evaluate_runs(runs, trace.metadata, {"hold": load_forecaster("hold")})
    return (
        int(found.replay.frames.sum()),
        int(found.replay.processed.sum()),
        int(found.staleness.mismatch_sum.sum()),
        round(float(found.scores["auc"].mean()), 4),
        round(float(found.scores["dp20"].mean()), 4),
    )


def test_ortrack_gives_the_known_figures(shared_data, tmp_path):
    name = "VisDrone-SOT-test-dev"
    results = shared_data / "results_with_times" / name / "ORTrack-DeiT-tiny"
    out = tmp_path / "t.parquet"
    assert main([str(results), "--truth", str(shared_data / name), "--out", str(out)]) == 0
    assert scores(out) == (19_433, 19_427, 20_351, 0.5013, 0.6930)


def test_nanotrack_gives_the_known_figures(shared_data, tmp_path):
    results = shared_data / "results_boxes" / "DTB70" / "NanoTrackV3.npz"
    out = tmp_path / "t.parquet"
    arguments = ["--truth", str(shared_data / "DTB70"), "--time", "constant:47ms"]
    assert main([str(results), *arguments, "--out", str(out)]) == 0
    assert scores(out) == (15_777, 11_226, 40_315, 0.4233, 0.5566)


def test_otb_tiger1_needs_its_own_truth(shared_data, tmp_path, capsys):
    results = shared_data / "results_with_times" / "OTB100" / "kcf" / "Tiger1.txt"
    otb = shared_data / "OTB100"
    arguments = [str(results), "--truth", str(otb), "--out", str(tmp_path / "t.parquet")]
    assert main(arguments) == 2
    assert "354 boxes" in capsys.readouterr().err
    other = ["--truth-file", f"Tiger1={otb / 'anno_alt' / 'Tiger1_354.txt'}"]
    assert main([*arguments, *other]) == 0
    assert "kcf on OTB100, 1 sequences, 354 frames" in capsys.readouterr().out


# ------------------------------------------------------------------------------ flags of absence


def lasot(world, **files):
    """A LaSOT folder of one sequence, which is left where it was last seen while it is absent."""
    box, path = [50, 40, 40, 30], world / "LaSOT" / "ball" / "ball-1"
    still = [box[0] + 4 * 4, box[1] + 2 * 4, *box[2:]]
    rows = [[box[0] + 4 * i, box[1] + 2 * i, *box[2:]] for i in range(10)]
    write(path / "groundtruth.txt", [*rows[:5], *[still] * 4, rows[9]], ",")
    write(world / "boxes" / "ball-1.txt", [*rows[:5], *[still] * 4, rows[9]], ",")
    for name, text in files.items():
        (path / f"{name}.txt").write_text(text)
    return path


FLAGS = {"full_occlusion": "0,0,0,0,0,1,1,0,0,0", "out_of_view": "0,0,0,0,0,0,0,1,1,0"}


def test_flags_of_absence_reach_the_trace_and_the_convention_that_needs_them(
    world, convert, capsys
):
    lasot(world, **FLAGS)
    status, out, _ = convert("boxes", "--time", "constant:1ms", truth="LaSOT")
    assert status == 0
    assert "absent in 4 frames, in 1 of 1 sequences; --convention lasot leaves them out" in out
    [recording] = read_trace(world / "t.parquet")
    assert recording.visible.tolist() == [True] * 5 + [False] * 4 + [True]
    for convention, auc, dp20 in (("lasot", 0.5714, 0.6), ("pysot", 0.9524, 1.0)):
        options = [str(world / "t.parquet"), "--convention", convention, "--json"]
        assert replay_main(options) == 0
        [report] = json.loads(capsys.readouterr().out)["traces"]
        assert round(report["offline"]["auc"], 4) == auc
        assert report["offline"]["dp20"] == dp20
        notes = [note for note in report["notes"] if "absent" in note]
        assert notes == [] if convention == "lasot" else "4 frames in 1 of 1 sequences" in notes[0]


@pytest.mark.parametrize("text", ["0,0,0", "0,0,0,0,0,1,1,0,0,x", ""])
def test_damaged_flags_do_not_stop_a_conversion(world, convert, text):
    path = lasot(world, **{**FLAGS, "out_of_view": text})
    status, out, _ = convert("boxes", "--time", "constant:1ms", truth="LaSOT")
    assert status == 0
    note = "Note: flags of absence of 1 of 1 sequences are left out, such as "
    assert f"{note}{path / 'out_of_view'}" in out
    [recording] = read_trace(world / "t.parquet")
    assert recording.visible is None
    assert read_trace(world / "t.parquet").metadata.document["version"] == "1.0"


def test_a_file_of_flags_is_not_replaced(world, convert):
    path = lasot(world, **FLAGS) / "full_occlusion.txt"
    paths = [str(world / "boxes"), "--truth", str(world / "LaSOT"), "--out", str(path)]
    assert main([*paths, "--time", "constant:1ms", "--force"]) == 2
    assert path.read_text() == FLAGS["full_occlusion"]


LOG = """frame,arrived_ms,ready_ms,x,y,w,h
0,0,40,10,20,30,40
1,33,,,,,
2,67,95.5,12,20,30,40
"""


def test_a_log_replays_as_it_ran(tmp_path, capsys):
    (tmp_path / "flight.csv").write_text(LOG)
    trace = tmp_path / "t.parquet"
    assert main([str(tmp_path / "flight.csv"), "--fps", "30", "--out", str(trace)]) == 0
    printed = capsys.readouterr().out
    assert printed == (
        f"{trace}: flight on flight, 1 sequences, 3 frames at 30 fps, in real time, 2 processed; "
        "median 34.2 ms a frame. Read as csv; times: measured.\n"
        "Note: the first output's time stands for that of the initialisation.\n"
        "Note: no ground truth: a replay tells of ages and skipped frames, not of scores.\n"
        f"Next: lae-sim replay {trace}\n"
    )
    assert replay_main([str(trace), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["traces"][0]["policy"] == "recorded"
    assert found["traces"][0]["exact"]
    assert replay_main([str(trace), "--policy", "latest"]) == 2
    assert "or the policy that it was recorded under" in capsys.readouterr().err
    assert main([str(tmp_path / "flight.csv"), "--json", "--out", str(trace)]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["format"], summary["fps"]) == ("csv", "30.3")
    assert len(summary["notes"]) == 2  # the rate's, and that there is no truth


def test_a_log_is_not_overwritten(tmp_path, capsys):
    path = tmp_path / "flight.csv"
    path.write_text(LOG)
    assert main([str(path), "--out", str(path), "--force"]) == 2
    assert path.read_text() == LOG


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--time", "constant:47ms"], "--time is of results, and this is a log"),
        (["--frame-times", "even"], "--frame-times is of results, and this is a log"),
        (["--box-topic", "/box"], "boxes: of bags, and"),
        (["--init-box", "1,2,3"], "'1,2,3' is not a box: write X,Y,W,H"),
        (["--field", "x"], "'x' is not NAME=PATH, such as x=bbox.center.position.x"),
        (["--clock-offset=soon", "--arrivals", "captured"], "line 2: no time when the frame was"),
    ],
)
def test_options_that_are_not_of_this_log(tmp_path, capsys, options, message):
    (tmp_path / "flight.csv").write_text(LOG)
    trace = tmp_path / "t.parquet"
    status = 0
    try:
        status = main([str(tmp_path / "flight.csv"), "--fps", "30", "--out", str(trace), *options])
    except SystemExit as end:
        status = end.code
    assert status == 2
    assert message in capsys.readouterr().err
    assert not trace.exists()


def test_options_of_logs_are_not_of_results(convert):
    assert "--gaps is of logs, and these are results" in convert("KCF", "--gaps", "dropped")[2]


def test_results_need_truth(world, capsys):
    assert main([str(world / "KCF"), "--out", str(world / "t.parquet")]) == 2
    assert "--truth: results need the dataset's folder" in capsys.readouterr().err
    (world / "KCF" / "metadata.yaml").write_text("tracker: KCF")  # is no bag
    assert main([str(world / "KCF"), "--out", str(world / "t.parquet")]) == 2
    assert "--truth: results need" in capsys.readouterr().err
