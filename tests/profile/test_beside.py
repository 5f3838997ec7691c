"""Other programs beside a profile: they run as long as it measures, and never longer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from command_line import command, run_here
from fakes import bright_frame
from places import REPOSITORY

from lae_sim.errors import LaeError
from lae_sim.profile import beside
from lae_sim.profile.beside import Loads, in_all
from lae_sim.trace.file import read_trace

pytestmark = pytest.mark.skipif(os.name != "posix", reason="commands of the shell")


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beside, "AT_ONCE_S", 0.2)


def eventually(true: Callable[[], bool], seconds: float = 20) -> bool:
    deadline = time.monotonic() + seconds
    while not true() and time.monotonic() < deadline:
        time.sleep(0.01)
    return true()


def alive(file: Path) -> bool:
    """Whether the process runs whose number a command wrote into a file."""
    return (
        Path(f"/proc/{file.read_text().strip()}").exists()
        if sys.platform == "linux"
        else (
            subprocess.run(["ps", "-p", file.read_text().strip()], capture_output=True).returncode
            == 0
        )
    )


def test_all_that_a_command_started_ends(tmp_path: Path) -> None:
    inner, outer = tmp_path / "inner", tmp_path / "outer"
    nested = f"sh -c 'echo $$ >{inner}; sleep 100' & echo $$ >{outer}; wait"
    with Loads([nested, "sleep 100"]) as loads:
        assert alive(inner)
        assert alive(outer)
        assert [each["exit"] for each in loads.entries()] == [None, None]
    assert not alive(inner)
    assert not alive(outer)
    assert [each["exit"] for each in loads.entries()] == [None, None]  # none ended by itself
    assert loads.ended() == []


def test_one_that_does_not_listen_is_killed(tmp_path: Path) -> None:
    file = tmp_path / "deaf"
    started = time.monotonic()
    with Loads([f"trap '' TERM; echo $$ >{file}; while true; do sleep 0.05; done"]):
        assert alive(file)
    assert not alive(file)
    assert time.monotonic() - started < 15


def test_one_that_tidies_up_has_time_to(tmp_path: Path) -> None:
    tidy = tmp_path / "tidy"
    with Loads(
        [f"trap 'sleep 0.2; echo done >{tidy}; exit' TERM; while true; do sleep 0.01; done"]
    ):
        pass
    assert tidy.read_text() == "done\n"


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("echo loading; echo no such model >&2; exit 3", r"\(status 3\): no such model"),
        ("true", r"\(status 0\): it must run as long as the profile"),
        ("kill -KILL $$", r"\(by SIGKILL\)"),
        ("nowhere-to-be-found", r"\(status 127\): .*not found"),
    ],
)
def test_one_that_fails_at_once_is_an_error_and_the_others_end(
    tmp_path: Path, bad: str, why: str
) -> None:
    file = tmp_path / "good"
    with pytest.raises(LaeError, match=why), Loads([f"echo $$ >{file}; sleep 100", bad]):
        pytest.fail("it began")
    assert not alive(file)


def test_one_that_ends_early_is_told(tmp_path: Path) -> None:
    flag = tmp_path / "end"
    with Loads([f"until [ -e {flag} ]; do sleep 0.01; done; exit 7", "sleep 100"]) as loads:
        assert loads.ended() == []
        flag.touch()
        assert eventually(lambda: loads.entries()[0]["exit"] == 7)
        assert loads.entries()[1]["exit"] is None
    (said,) = loads.ended()
    assert "ended by itself after" in said
    assert "(status 7)" in said


def test_what_a_load_prints_is_not_kept_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(beside, "KEPT_BYTES", 100)
    with Loads(["while true; do echo 0123456789; sleep 0.02; done"]) as loads:
        printed = loads._loads[0].printed.fileno()
        assert eventually(lambda: os.fstat(printed).st_size > 100)
        loads.watch()
        assert os.fstat(printed).st_size < 100
        assert eventually(lambda: os.fstat(printed).st_size > 0)  # it goes on at the beginning


def test_parts_of_a_profile_add_up() -> None:
    here = {"command": "x", "exit": None, "seconds": None}
    gone = {"command": "x", "exit": 1, "seconds": 2.5}
    assert in_all([[here], [gone], [gone]]) == [{**gone, "sequences": 1, "of_sequences": 3}]
    assert in_all([[here, here], [here, gone]])[0] == {**here, "sequences": 2, "of_sequences": 2}


@pytest.fixture
def quick(tmp_path: Path) -> tuple[str, ...]:
    """Options of a profile of few frames, whose calls wait for a file if there is to be one."""
    (tmp_path / "data/race/img").mkdir(parents=True)
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"data/race/img/{i + 1:04}.png"), bright_frame(5 + 2 * i, 20))
    boxes = [f"{5 + 2 * i},20,12,10\n" for i in range(4)]
    (tmp_path / "data/race/groundtruth_rect.txt").write_text("".join(boxes))
    (tmp_path / "patient.py").write_text(
        "import os, time\n"
        "class Patient:\n"
        "    def __init__(self, file): self.file = file\n"
        "    def init(self, frame, box): self.box = box\n"
        "    def track(self, frame):\n"
        "        while not os.path.exists(self.file): time.sleep(0.01)\n"
        "        time.sleep(0.1)\n"
        "        return self.box\n"
    )
    tracker = ("--tracker", "patient:Patient", "--option", f"file={tmp_path / 'flag'}")
    return (*tracker, "--root", "data", "--in-process", "--warmup", "0", "--out", "t.parquet")


def test_a_profile_beside_two_loads(tmp_path: Path, quick: tuple[str, ...]) -> None:
    file = tmp_path / "load"
    loud = f"echo noise; echo noise >&2; echo $$ >{file}; while :; do touch flag; sleep 0.1; done"
    loads = ("--beside", loud, "sleep 100")
    done = run_here("profile", *quick, "--json", *loads, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "noise" not in done.stdout + done.stderr
    assert json.loads(done.stdout)["failures"] == []
    assert not alive(file)
    told = read_trace(tmp_path / "t.parquet").metadata.document["device"]["beside"]
    known = {"exit": None, "seconds": None, "sequences": 1, "of_sequences": 1}
    assert told == [{"command": loud, **known}, {"command": "sleep 100", **known}]
    assert "  beside     sleep 100" in run_here("show", tmp_path / "t.parquet").stdout


def test_a_profile_says_that_its_load_left(tmp_path: Path, quick: tuple[str, ...]) -> None:
    done = run_here("profile", *quick, "--beside", "sleep 0.4; touch flag; exit 2", cwd=tmp_path)
    assert done.returncode == 0
    assert "'sleep 0.4; touch flag; exit 2' ended by itself after 0." in done.stderr
    (load,) = read_trace(tmp_path / "t.parquet").metadata.document["device"]["beside"]
    assert (load["exit"], load["sequences"], load["of_sequences"]) == (2, 0, 1)
    shown = " ".join(run_here("show", tmp_path / "t.parquet").stdout.split())
    assert "'sleep 0.4; touch flag; exit 2' ended by itself" in shown
    assert "it was there for 0 of 1 sequences" in shown


def test_a_profile_whose_load_fails_leaves_nothing(tmp_path: Path, quick: tuple[str, ...]) -> None:
    before = {*tmp_path.iterdir()}
    failed = run_here("profile", *quick, "--beside", "exit 5", cwd=tmp_path)
    assert failed.returncode == 2
    assert failed.stderr == (
        "lae-sim profile: error: beside 'exit 5': it ended at once (status 5): it must run as long "
        "as the profile\n"
    )
    left = {each for each in tmp_path.iterdir() if each.name != "__pycache__"}
    assert left == before


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_however_a_profile_ends_its_load_does(tmp_path: Path, end: signal.Signals) -> None:
    file = tmp_path / "load"
    arguments = command(
        "profile", "--out", tmp_path / "t.parquet", "--beside", f"echo $$ >{file}; sleep 100"
    )
    process = subprocess.Popen(
        arguments, env={**os.environ, "PYTHONPATH": str(REPOSITORY)}, stderr=subprocess.DEVNULL
    )
    try:
        assert eventually(lambda: file.exists() and bool(file.read_text()), 60)
        assert alive(file)
        process.send_signal(end)
        process.wait(60)
        assert eventually(lambda: not alive(file))
    finally:
        process.kill()
        process.wait()
