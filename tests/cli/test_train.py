"""The training command as a user runs it, and what replay says of what it made."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from networks import random_learned
from places import REPOSITORY
from schemas import check
from witness import moving

import lae_sim
from lae_sim.cli.replay import main as replay
from lae_sim.cli.train import main
from lae_sim.engine.clock import Clock
from lae_sim.evaluation.caveats import notes_on
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.evaluation.metrics import PYSOT
from lae_sim.forecast.base import Hold
from lae_sim.forecast.camera import Camera, CameraCompensated
from lae_sim.forecast.guard import guarded
from lae_sim.forecast.learned import Learned, read_learned
from lae_sim.learning.trainers import NetworkTrainer
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.metadata import Metadata

SLOW = str(REPOSITORY / "traces" / "synthetic-slow.parquet")
REAL_TIME = str(REPOSITORY / "traces" / "synthetic-slow-realtime.parquet")
NAMES = ["bike-pan", "boat-calm", "car-chase", "car-occluded", "drone-fast", "person-crowd",
         "runner-zoom", "truck-far"]  # fmt: skip


@pytest.fixture(scope="module")
def folder(torch: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a forecaster that was trained on five of the eight sequences."""
    made = tmp_path_factory.mktemp("train")
    excluded = ["--exclude", "car-chase", "boat-calm", "truck-far"]
    command = [SLOW, "--out", "f.npz", "--steps", "3", "--seed", "4", *excluded, "--json"]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "lae_sim", "train", *command],
        capture_output=True,
        text=True,
        cwd=made,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")  # no progress bar where nobody looks
    (made / "told.json").write_text(done.stdout)
    return made


def test_the_file_names_what_it_was_trained_on_and_how(folder: Path) -> None:
    told = json.loads((folder / "told.json").read_text())
    check(told, "train")
    seen = [name for name in NAMES if name not in ("car-chase", "boat-calm", "truck-far")]
    assert told.pop("forecaster") == "f.npz"
    found = read_learned(folder / "f.npz")
    assert told.pop("digest") == found.network.digest
    assert found.document == told
    assert told["sequences"] == seen
    expected = {
        "traces": [SLOW], "latencies": ["recorded"], "scales": ["1/2", "1", "2"],
        "policy": "latest", "seed": 4, "steps": 3,
    }  # fmt: skip
    assert {key: told[key] for key in expected} == expected
    assert sorted(path.name for path in folder.iterdir()) == ["f.npz", "told.json"]


def test_a_replay_says_what_its_forecaster_has_seen(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    command = [SLOW, "--forecaster", "hold", "learned:f.npz"]
    assert replay([*command, "--json"]) == 0
    [trace] = json.loads(capsys.readouterr().out)["traces"]
    [note] = [note for note in trace["notes"] if "trained" in note]
    assert "learned:f.npz" in note
    assert "trained on 5 of these 8 sequences" in note
    auc = {result["forecaster"]: result["auc"] for result in trace["results"]}
    assert auc["learned:f.npz"] > auc["hold"]
    assert replay([*command, "--sequence", "boat-calm", "truck-far"]) == 0
    assert "trained" not in capsys.readouterr().out


def test_a_part_of_the_same_video_counts_as_seen() -> None:
    """Behind the camera's motion too."""
    recordings = [moving(9, 0, name) for name in ("car1_2", "car2_1")]
    runs = [replay_sequence(recording, Clock.at(Fraction(30))) for recording in recordings]
    metadata = Metadata.new("30", "every-frame")
    found = evaluate_runs(runs, metadata, {"hold": Hold})
    network = replace(random_learned().network, document={"sequences": ["car1_1", "bus"]})
    learned = Learned(network)
    camera = CameraCompensated(learned, Camera({}, Fraction(30)))
    forecasters = {"hold": Hold, "one": learned, "two": camera, "three": guarded(learned)}
    notes = notes_on(found.replay, metadata, PYSOT, forecasters)
    told = [note for note in notes if "trained on 1 of these 2 sequences" in note]
    assert [note.split(":")[0].split()[0] for note in told] == ["one", "two", "three"]
    digests = [note for note in notes if network.digest[:16] in note]
    assert [note.split(":")[0].split()[0] for note in digests] == ["one", "two", "three"]


def test_what_is_told_of_a_training(
    torch: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "f.npz"
    options = ["--sequence", "boat-calm", "car-chase", "--latency-scale", "1", "--steps", "2"]
    assert main([SLOW, REAL_TIME, "--out", str(out), *options]) == 0
    told = capsys.readouterr().out
    assert f"{out}: trained on 1,200 queries of 2 sequences, 2 steps, seed 0" in told
    assert f"--forecaster kalman learned:{out}" in told


def test_made_up_motion_trains_the_same_network_again(
    torch: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As the shipped weights were made: no trace, the seed decides, and no sequence is named."""
    out, digests = tmp_path / "f.npz", []
    for seed in ("5", "5", "6"):
        command = ["--made-up", "8", "--steps", "2", "--seed", seed, "--out", str(out), "--json"]
        assert main(command) == 0
        told = json.loads(capsys.readouterr().out)
        check(told, "train")
        digests.append((told["digest"], out.read_bytes()))
    assert digests[0] == digests[1]
    assert digests[0][0] != digests[2][0]
    found = read_learned(out)
    assert found.network.digest == told["digest"]
    expected = {
        "made_up": 8,
        "seed": 6,
        "steps": 2,
        "sequences": [],
        "lae_sim": lae_sim.__version__,
    }
    assert found.document == expected
    assert main(["--made-up", "2", "--steps", "1", "--out", str(out)]) == 0
    assert "of 2 sequences, 1 steps, seed 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "give traces to train on, or --made-up N"),
        ([SLOW, "--made-up", "8"], "give traces to train on, or --made-up N"),
        (["--made-up", "8", "--sequence", "a"], "--sequence goes with traces, not with --made-up"),
        (["--made-up", "8", "--exclude", "a"], "--exclude goes with traces, not with --made-up"),
        (["--made-up", "8", "--out", "no-folder/f.npz"], "cannot write no-folder/f.npz"),
        ([SLOW, "--exclude", "nobody"], "--exclude nobody: there is no such sequence"),
        ([SLOW, "--sequence", "nobody"], "no sequence 'nobody'"),
        ([SLOW, "--sequence", "car-chase", "--exclude", "car-chase"], "nothing to learn from"),
        ([SLOW, "--latency", "constant:0ns"], "nothing to learn from"),
        ([SLOW, "--latency", "slow"], "no latency 'slow'"),
        ([SLOW, "--policy", "slow"], "slow"),
        ([REAL_TIME], "frame 4: the trace has no time for it"),
        (["nobody.parquet"], "nobody.parquet: no such file"),
        ([SLOW, "--out", "no-folder/f.npz"], "cannot write no-folder/f.npz: its folder is not th"),
        ([SLOW, "--out", SLOW], "would replace a file that is read"),
    ],
)
def test_what_cannot_be_trained(
    arguments: list[str],
    problem: str,
    torch: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if "nothing" not in problem:  # then it is found before anything is trained
        monkeypatch.delattr(NetworkTrainer, "fit")
    if "--out" not in arguments:
        arguments = [*arguments, "--out", "f.npz"]
    assert main(arguments) == 2
    told = capsys.readouterr().err.strip()
    assert told.startswith("lae-sim train: error: ")
    assert problem in told
    assert "\n" not in told
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "wrong",
    [["--steps", "0"], ["--seed", "-1"], ["--fps", "0"], ["--made-up", "1"], ["--made-up", "x"]],
)
def test_numbers_that_cannot_be(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([SLOW, "--out", "f.npz", *wrong])
    assert caught.value.code == 2
    assert f"argument {wrong[0]}: " in capsys.readouterr().err
