"""No command loses a file, or its work because nobody reads what it says, as a user runs them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import pytest
from command_line import ENVIRONMENT, run_here
from places import REPOSITORY

from lae_sim.cli.main import main
from lae_sim.importers.convert import convert_results
from lae_sim.trace.file import read_trace, write_trace

SLOW, FAST = (REPOSITORY / "traces" / f"synthetic-{name}.parquet" for name in ("slow", "fast"))
PROFILE = ("profile", "--in-process", "--root", "ds", "--out", "out.parquet")
CONVERT = ("convert", "kcf", "--truth", "ds", "--out", "out.parquet", "--time")


def run_into(
    stdout: IO[bytes], *arguments: str, cwd: Path, stderr: int = subprocess.PIPE
) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "lae_sim", *arguments]
    return subprocess.run(command, cwd=cwd, stdout=stdout, stderr=stderr, env=ENVIRONMENT)


@pytest.fixture
def world(tmp_path: Path) -> Path:
    """A dataset, results on it, traces, weights and a module, some under several names."""
    images, results = tmp_path / "ds" / "car" / "img", tmp_path / "kcf"
    images.mkdir(parents=True)
    results.mkdir()
    boxes = "1,2,30,40\n2,2,30,40\n3,2,30,40\n"
    for number in (1, 2, 3):
        cv2.imwrite(str(images / f"{number:04}.png"), np.zeros((60, 80, 3), np.uint8))
    (tmp_path / "ds" / "car" / "groundtruth_rect.txt").write_text(boxes)
    (results / "car.txt").write_text(boxes)
    (tmp_path / "own.txt").write_text(boxes)
    (tmp_path / "f.csv").write_text("sequence,fps\ncar,20\n")
    (tmp_path / "g.npz").write_bytes(b"weights")
    (tmp_path / "own.py").write_text("from lae_sim import Hold\n")
    (tmp_path / "study.toml").write_text('traces = ["slow.parquet"]\n')
    shutil.copy(SLOW, tmp_path / "slow.parquet")
    shutil.copy(FAST, tmp_path / "fast.parquet")
    (tmp_path / "link.png").symlink_to("fast.parquet")
    (tmp_path / "hard.png").hardlink_to(tmp_path / "slow.parquet")
    (tmp_path / "hard.csv").hardlink_to(tmp_path / "f.csv")
    for name in ("linked/summary.csv", "stopped/tables/own.toml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "linked" / "summary.csv").symlink_to(tmp_path / "study.toml")
    (tmp_path / "stopped" / "tables" / "own.toml").write_text('traces = ["slow.parquet"]\n')
    trace, _ = convert_results(results, tmp_path / "ds", time="constant:47ms")
    write_trace(trace, tmp_path / "kcf.parquet")
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


REPLACING = [
    "convert kcf --truth ds --time mean-fps:f.csv --out f.csv",
    "convert kcf --truth ds --time mean-fps:f.csv,init=1s --out ds/../f.csv --force",
    "convert kcf --truth ds --time mean-fps:f.csv --out hard.csv --force",
    "convert kcf --truth ds --time constant:47ms --out kcf/car.txt --force",
    "convert kcf --truth ds --time constant:47ms --out ds/car/groundtruth_rect.txt --force",
    "convert kcf --truth ds --time constant:47ms --out ds/car/img/0002.png --force",
    "convert kcf --truth ds --time constant:47ms --truth-file car=own.txt --force"
    " --out ds/car/groundtruth_rect.txt",
    "convert kcf --truth ds --time constant:47ms --out slow.parquet",
    "replay slow.parquet --forecaster learned:g.npz --events g.npz",
    "replay slow.parquet --forecaster camera+learned:g.npz --root ds --events ds/../g.npz",
    "replay slow.parquet --search c=1 --pre-forecaster learned:g.npz --timeline g.npz",
    "replay slow.parquet --forecaster own:Hold --events own.py",
    "replay slow.parquet --plot hard.png",
    "replay slow.parquet --timing fast.parquet --plot link.png",
    "replay slow.parquet --strided fast.parquet --outputs fast.parquet",
    "replay slow.parquet --schedule fast.parquet",
    "replay slow.parquet --root ds --events ds/car/groundtruth_rect.txt",
    "compare slow.parquet --forecaster learned:g.npz --out g.npz",
    "compare slow.parquet --plot hard.png",
    "compare slow.parquet --root ds --plot ds/car/img/0002.png",
    "compare slow.parquet --out fast.parquet",
    "show slow.parquet --plot hard.png",
    "train slow.parquet --out hard.png",
    "train slow.parquet --out fast.parquet",
    "fidelity slow.parquet --closed-loop fast.parquet --plot link.png",
    "render kcf.parquet --root ds --out ds/car/img/0002.png",
    "render kcf.parquet --root ds/car/../../ds --out ds/car/img/0002.png",
    "profile --in-process --timing fast.parquet --out fast.parquet --force",
    "profile --in-process --sequence race --out slow.parquet",
    "profile --in-process --sequence race --out kcf.parquet",
    "study study.toml --out linked",
    "study stopped/tables/own.toml --out stopped --no-report",
]


@pytest.mark.skipif(os.name == "nt", reason="Windows lets few users make links")
@pytest.mark.parametrize("command", REPLACING)
def test_no_input_and_no_other_trace_is_replaced(command: str, world: Path) -> None:
    before = contents(world)
    done = run_here(*command.split(), cwd=world)
    error = done.stderr
    assert done.returncode == 2, error
    assert any(words in error for words in ("would replace", "is a trace", "--force")), error
    assert "Traceback" not in error
    assert error.count("\n") <= 2, error
    assert contents(world) == before


def test_a_film_of_a_sequence_does_not_replace_the_video(world: Path) -> None:
    writer = cv2.VideoWriter(str(world / "car.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (80, 60))
    for _ in range(3):
        writer.write(np.zeros((60, 80, 3), np.uint8))
    writer.release()
    before = (world / "car.mp4").read_bytes()
    done = run_here("render", "kcf.parquet", "--root", "car.mp4", "--out", ".", cwd=world)
    assert done.returncode == 2
    assert "car.mp4 would replace a file that is read" in done.stderr
    assert (world / "car.mp4").read_bytes() == before


@pytest.mark.parametrize("command", [PROFILE, (*CONVERT, "constant:47ms")])
def test_a_trace_of_another_tracker_or_dataset_is_replaced_by_force_only(
    command: tuple[str, ...], world: Path
) -> None:
    out = world / "out.parquet"
    out.touch()  # an empty file holds nothing that could be lost
    assert run_here(*command, cwd=world).returncode == 0
    made = read_trace(out).metadata
    assert run_here(*command, cwd=world).returncode == 0  # its own may be made anew
    for other in (SLOW, world / "own.py"):
        shutil.copy(other, out)
        done = run_here(*command, cwd=world)
        assert done.returncode == 2
        assert "--force" in done.stderr
        assert out.read_bytes() == other.read_bytes()
        assert run_here(*command, "--force", cwd=world).returncode == 0
        assert read_trace(out).metadata.tracker == made.tracker


def test_what_replay_and_compare_write_is_replaced(world: Path) -> None:
    replay = "replay slow.parquet --schedule s.parquet --outputs o.parquet --events e --plot p.svg"
    compare = "compare slow.parquet --forecaster kalman --out c.csv --plot p.svg"
    show = "show . --plot p.svg"  # a folder of traces is not all read
    for _ in range(2):
        for command in (replay, compare):
            done = run_here(*command.split(), cwd=world)
            assert done.returncode == 0, done.stderr
    for name in ("s.parquet", "o.parquet"):
        (world / name).unlink()  # which are no traces
    assert run_here(*show.split(), cwd=world).returncode == 0


@pytest.fixture
def unread() -> IO[bytes]:
    """A pipe that nobody reads, as ``| head -1`` leaves it."""
    reading, writing = os.pipe()
    os.close(reading)
    return os.fdopen(writing, "wb")


def test_a_profile_that_nobody_watches_leaves_its_trace(world: Path, unread: IO[bytes]) -> None:
    shutil.copy(SLOW, world / "out.parquet")
    with unread:  # both streams, as 2>&1 | head; the first line would say what is replaced
        done = run_into(unread, *PROFILE, "--force", cwd=world, stderr=subprocess.STDOUT)
    assert done.returncode == 0
    assert read_trace(world / "out.parquet").names == ("car",)


def test_a_failure_that_nobody_reads_is_one(tmp_path: Path, unread: IO[bytes]) -> None:
    with unread:
        done = run_into(unread, "replay", "no.parquet", cwd=tmp_path, stderr=subprocess.STDOUT)
    assert done.returncode == 2


@pytest.mark.parametrize(
    "command",
    ["replay slow.parquet --plot p.svg", "show slow.parquet --plot p.svg",
     "compare slow.parquet --forecaster kalman --plot p.svg"],
)  # fmt: skip
def test_a_broken_standard_output_after_the_work_is_silent(
    command: str, tmp_path: Path, unread: IO[bytes]
) -> None:
    shutil.copy(SLOW, tmp_path / "slow.parquet")
    with unread:
        done = run_into(unread, *command.split(), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "p.svg").stat().st_size > 0


@pytest.mark.skipif(os.name == "nt", reason="Windows does not tell pipes apart")
def test_another_pipe_that_breaks_is_an_error(tmp_path: Path) -> None:
    program = """if True:
        import os
        from lae_sim.cli.options import exit_status

        def work():
            reading, writing = os.pipe()
            os.close(reading)
            os.write(writing, b"to a worker that has died")

        raise SystemExit(exit_status(work, "lae-sim"))
    """
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=ENVIRONMENT,
        capture_output=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 2
    assert b"lae-sim: error: " in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="Windows has no sh")
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_closed_streams_change_no_status(closed: str, world: Path) -> None:
    profile = "profile --root ds --out out.parquet"  # whose worker takes over descriptors
    for command, status in ((f"replay {SLOW} --json", 0), ("replay no.parquet", 2), (profile, 0)):
        shell = f"exec {sys.executable} -m lae_sim {command} {closed}"
        done = subprocess.run(
            ["sh", "-c", shell],
            env=ENVIRONMENT,
            capture_output=True,
            cwd=world,
            check=False,
        )
        assert done.returncode == status, done.stderr
        assert b"Traceback" not in done.stdout + done.stderr


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no such pipes")
@pytest.mark.parametrize(
    "command",
    [
        f"replay {SLOW} --events",
        f"replay {SLOW} --plot",
        f"compare {SLOW} --out",
        f"show {SLOW} --plot",
        f"fidelity {SLOW} --closed-loop {FAST} --plot",
        f"render {SLOW} --out",
        f"train {SLOW} --out",
        "profile --out",
        "convert kcf --truth ds --out",
    ],
)
def test_a_pipe_is_refused_before_the_work(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    pipe = "pipe.parquet" if command.startswith(("profile", "compare")) else "pipe.png"
    os.mkfifo(pipe)
    assert main([*command.split(), pipe]) == 2
    error = capsys.readouterr().err
    assert error.endswith(f"cannot write {pipe}: it is there already and is not a file\n")
    assert os.listdir() == [pipe]
