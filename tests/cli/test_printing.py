"""What commands print: safe, in any encoding, strict where it is JSON, and short where it fails."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import command_line
import pytest
from command_line import ENVIRONMENT, run_here
from places import REPOSITORY
from witness import moving

from lae_sim.cli.main import COMMANDS
from lae_sim.cli.options import print_json
from lae_sim.progress import OutputError, ProgressBar, print_text, tell
from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
HOSTILE = "=a\x1b[2J\r\u202e[red]x[bold] 追é.parquet"
SEEN = r"=a\x1b[2J\r\u202e[red]x[bold] 追é"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a trace of a hostile name, a study of it, and results with their truth."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    recordings = [moving(20, seed, f"s{seed}") for seed in range(2)]
    metadata = Metadata.new("30", "every-frame", tracker={"name": "[red]x[/red] 追"})
    for name in (HOSTILE, "plain.parquet"):
        write_trace(Trace(metadata, recordings), name)
    Path("study.toml").write_text('traces = ["*.parquet"]', "utf-8")
    for name in ("results", "truth"):
        Path(name).mkdir()
        Path(name, "car.txt").write_text("1,2,30,40\n2,2,30,40\n3,2,30,40\n", "utf-8")
    return tmp_path


def command(name: str, *arguments: str) -> int:
    """The exit status of a command, run in this process."""
    try:
        status: int = importlib.import_module(f"lae_sim.cli.{name}").main(arguments)
    except SystemExit as end:  # argparse
        status = int(end.code or 0)
    return status


CONVERT = ("results", "--truth", "truth", "--time", "constant:47ms", "--out", "o.parquet")
PRINTING = {
    "replay": (HOSTILE, "--per-sequence", "--forecaster", "hold"),
    "compare": (HOSTILE, "--forecaster", "kalman"),
    "show": (HOSTILE,),
    "study": ("study.toml", "--workers", "1", "--no-report"),
    "fidelity": (HOSTILE, "--closed-loop", HOSTILE),
    "convert": (*CONVERT[:-1], "a\x1b[2Jé追.parquet"),
}


@pytest.mark.parametrize("name", PRINTING)
def test_nothing_that_is_printed_moves_the_cursor(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(name, *PRINTING[name])
    printed, told = capsys.readouterr()
    assert all(c.isprintable() or c == "\n" for c in printed + told)
    assert r"a\x1b[2J" in printed + told
    if name != "convert":
        assert SEEN in printed + told


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
@pytest.mark.parametrize("name", [*PRINTING, "json"])
def test_tables_print_in_any_encoding(
    name: str, encoding: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", output)
    monkeypatch.setattr(sys, "stderr", errors := io.StringIO())
    if name == "fidelity":  # of a trace that is no closed loop
        print_text(SEEN)
    elif name == "json":
        assert command("replay", HOSTILE, "--json") == 0
    else:
        assert command(name, *PRINTING[name]) == 0, errors.getvalue()
    output.flush()
    text = output.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
    if name == "json":
        assert json.loads(text)["traces"][0]["trace"] == HOSTILE
    elif name != "show":
        assert "?" in text
        assert ("é" in text) == (encoding == "cp1252")


def test_what_the_error_stream_and_a_bar_say_is_safe(capsys: pytest.CaptureFixture[str]) -> None:
    tell("a\x1b[2J\nb\udcff")
    with ProgressBar("x\x1b" * 1000, "frames", show=True) as bar:
        bar(1, 2, "y\x1b" * 1000)
    told = capsys.readouterr().err
    assert told.startswith("a\\x1b[2J\nb\\udcff\n")
    assert "\\x1b" in told
    assert "y\x1b" not in told
    assert len(told) < 600


def test_all_files_of_a_study_are_utf8_and_safe(folder: Path) -> None:
    assert command("study", *PRINTING["study"][:-1]) == 0
    written = [
        *Path("study-results").glob("*.*"),
        *Path("study-results", "tables").iterdir(),
    ]
    suffixes = {".csv", ".json", ".html", ".tex", ".parquet"}
    assert {path.suffix for path in written} == suffixes
    written += Path("study-results", "figures").glob("*.svg")
    read = [path for path in written if path.suffix != ".parquet"]
    texts = {path.name: path.read_text("utf-8") for path in read}
    assert all(c.isprintable() or c == "\n" for text in texts.values() for c in text)
    assert f"\n'{SEEN}," in texts["summary.csv"]
    assert SEEN in texts["report.html"]
    assert "[red]x[/red] 追" in texts["report.html"]
    assert r"{[}red]x{[}bold] 追é" in texts["ranking.tex"]


# ------------------------------------------------------------------------------ JSON


def strict(text: str) -> Any:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.parametrize("name", PRINTING)
def test_json_is_strict(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = command(name, *PRINTING[name], "--json")
    printed, told = capsys.readouterr()
    if name == "fidelity":  # of a trace that is no closed loop
        assert status == 2, told
        return
    assert status == 0, told
    assert strict(printed)
    assert printed.isascii()
    assert all(c.isprintable() or c == "\n" for c in printed)


def test_json_keeps_every_character_of_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    document = {"name": "".join(map(chr, range(0x2100))) + "\u2028\u202e\udcff"}
    print_json(document)
    printed = capsys.readouterr().out
    assert json.loads(printed) == document
    assert all(c.isprintable() or c == "\n" for c in printed)
    with pytest.raises(ValueError, match="not JSON compliant"):
        print_json({"score": float("nan")})


# ------------------------------------------------------------------------------ full disks


class Full(io.StringIO):
    """A standard output that takes nothing; what it was told to forget is in a file."""

    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("name", "status", "said"),
    [
        ("replay", 2, "lae-sim replay: error: the standard output: No space left on device: the "
                      "result is lost\n"),
        ("show", 2, "lae-sim show: error: the standard output: No space left on device: the "
                    "result is lost\n"),
        ("convert", 0, "lae-sim convert: the standard output: No space left on device: the files "
                       "are written\n"),
        ("study", 0, "lae-sim study: the standard output: No space left on device: the files are "
                     "written\n"),
    ],
)  # fmt: skip
def test_a_full_disk_is_an_error_where_the_result_is_lost(
    name: str,
    status: int,
    said: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "stdout", Full())
    assert command(name, *PRINTING[name]) == status
    assert capsys.readouterr().err == said
    assert name != "convert" or Path(PRINTING[name][-1]).is_file()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_what_is_left_of_a_full_disk_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)
        from lae_sim.cli.options import exit_status

        assert exit_status(lambda: print_text("lost"), "lae-sim") == 2
        full.flush()  # as Python does at its end


def test_the_failure_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", Full())
    with pytest.raises(OutputError, match="No space left"):
        print_text("lost")


# ------------------------------------------------------------------------------ long options


BASE = {
    "compare": ("plain.parquet", "--forecaster", "hold"),
    "convert": CONVERT,
    "fidelity": ("plain.parquet", "--closed-loop", "plain.parquet"),
    "get": ("dtb70/kcf", "--mirror", "none-such"),
    # what is no error would run the tracker
    "profile": ("--in-process", "--out", "none/o.parquet", "--sequence", "none-such"),
    "render": ("plain.parquet", "--out", "o.png"),
    "replay": ("plain.parquet", "--forecaster", "hold"),
    "show": ("plain.parquet",),
    "study": ("study.toml", "--workers", "1", "--out", "file"),
    "train": ("plain.parquet", "--out", "o.pt", "--steps", "0"),
}
"""Arguments of each command that are quickly done, or refused."""

LONG = ("x" * 100_000, "9" * 100_000, "a.b:" + "c" * 100_000, "a=" + "\x1b" * 50_000)


def options_of(name: str, monkeypatch: pytest.MonkeyPatch) -> list[argparse.Action]:
    """The options and positional arguments of a command that take a value."""
    found: list[argparse.Action] = []

    def parse_args(parser: argparse.ArgumentParser, *arguments: object) -> None:
        found.extend(action for action in parser._actions if action.nargs != 0)
        raise SystemExit(0)

    with monkeypatch.context() as patched:
        patched.setattr(argparse.ArgumentParser, "parse_args", parse_args)
        command(name)
    return found


def with_long_value(name: str, action: argparse.Action, value: str) -> Iterator[str]:
    if action.option_strings:
        yield from (*BASE[name], action.option_strings[0], value)
    else:
        yield from (value, *BASE[name][1:])


@pytest.mark.parametrize("name", COMMANDS)
def test_no_option_makes_an_error_longer_than_a_screen(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("file").write_text("no folder", "utf-8")
    actions = options_of(name, monkeypatch)
    assert len(actions) > 1
    refused = 0
    for action in actions:
        if "--scheduler" in action.option_strings:  # see tests/study/test_executors.py
            continue
        for value in LONG:
            status = command(name, *with_long_value(name, action, value))
            told = capsys.readouterr().err
            refused += status == 2
            assert status in (0, 2), (action.dest, told)
            assert len(told) < 2000, (action.dest, value[:9], told[:300])
            assert told.count("\n") <= 3, (action.dest, value[:9], told[:300])
            assert "Traceback" not in told
            assert all(c.isprintable() or c == "\n" for c in told)
    assert refused > len(actions)


def test_a_long_command_is_refused_shortly(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        importlib.import_module("lae_sim.cli.main").main(["x" * 100_000])
    assert 0 < len(capsys.readouterr().err) < 2000


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="Windows has no such terminals")
def test_tables_fit_the_terminal_and_are_whole_through_a_pipe() -> None:
    import fcntl
    import struct
    import termios

    terminal, screen = os.openpty()
    fcntl.ioctl(screen, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    words = command_line.command("replay", SLOW, "--sequence", "boat-calm")
    environment = {name: ENVIRONMENT[name] for name in ENVIRONMENT if name != "COLUMNS"}
    with subprocess.Popen(words, stdout=screen, stderr=screen, env=environment) as process:
        os.close(screen)
        printed = b""
        with contextlib.suppress(OSError):  # Linux says so that the other end is closed
            while more := os.read(terminal, 65536):
                printed += more
    os.close(terminal)
    assert process.returncode == 0, printed
    table, said = printed.decode().replace("\r", "").split("left out for want of room: ")
    assert all(len(line) <= 80 for line in table.splitlines())
    assert "DP@20 offline" in said.partition("; --json has all of it")[0]
    whole = run_here("replay", SLOW, "--sequence", "boat-calm").stdout
    assert "mismatch" in whole.splitlines()[0]
    assert "want of room" not in whole
