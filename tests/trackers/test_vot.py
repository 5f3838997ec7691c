"""Trackers of a VOT registry: what a trackers.ini says, and real servers started by it."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys

import cv2
import numpy as np
import pytest
from command_line import run_here

from lae_sim.errors import LaeError
from lae_sim.profile.worker import Worker
from lae_sim.trace.file import read_trace
from lae_sim.trackers.names import TIMEOUT_S, make_tracker, usual_timeout

pytest.importorskip("trax", reason="TraX is not installed: pip install 'lae-sim[trax]'")

from lae_sim.trackers.trax import find_entry

BOX = (10.5, 20.0, 30.0, 8.0)
FRAME = np.zeros((60, 81, 3), np.uint8)

SERVER = """
import json, os, sys, time
import numpy as np
from trax import Image, Mask, Region, Server, TraxStatus

def run(pause=0, kind=Region.RECTANGLE):
    server = Server([kind], [Image.PATH], tracker_name="inner")
    while True:
        request = server.wait()
        if request.type == TraxStatus.QUIT:
            break
        if request.type == TraxStatus.INITIALIZE:
            region = request.objects[0][0]
            told = {"pid": os.getpid(), "folder": os.getcwd(), "argv": sys.argv,
                    "path": sys.path, "environment": dict(os.environ),
                    "given": request.properties.dict(), "kind": region.type}
            with open(os.path.join(os.path.dirname(__file__), "told.json"), "w") as file:
                json.dump(told, file)
        else:
            time.sleep(pause)
            mask = np.zeros((4, 6), np.uint8)
            mask[1:4, 2:4] = 1
            region = Mask.create(mask, x=20, y=10)
        server.status([(region, {"confidence": 0.75})])

if __name__ == "__main__":
    run()
"""


@pytest.fixture
def registry(tmp_path):
    """Writes a trackers.ini beside a server ``a server/serve.py``; its path."""
    (tmp_path / "a server").mkdir()
    (tmp_path / "a server" / "serve.py").write_text(SERVER)

    def write(text):
        path = tmp_path / "trackers.ini"
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write


def told(ini):
    with open(os.path.join(os.path.dirname(ini), "a server", "told.json")) as file:
        return json.load(file)


def ran(name, ini, **parameters):
    """What the tracker answers on two sequences, and what it says of itself."""
    tracker = make_tracker(f"vot:{name}", {"ini": ini, **parameters})
    try:
        answers, processes = [], []
        for _ in range(2):
            tracker.init(FRAME, BOX)
            processes.append(told(ini)["pid"])
            answers.append(tracker.track(FRAME))
        return answers, len(set(processes)), tracker.describe()
    finally:
        tracker.close()


def test_trax(registry, monkeypatch):
    monkeypatch.setenv("WEIGHTS", "/w")
    monkeypatch.setenv("LD_LIBRARY_PATH", "/there")
    python = shlex.quote(sys.executable)
    ini = registry(
        f"""; a comment
        [other]
        [NCC]
        label = PyNCC
        version = 1.2
        protocol = trax
        command = {python} 'a server/serve.py' --fast
        env_ncc_weights = ${{WEIGHTS}}/ncc:${{NOT_SET_42}}
        arg_size = 3
        arg_gain = 2
        linkpaths = lib:/opt/lib
        tags = fast, old
        socket = false
        """.replace("\n        ", "\n")
    )
    answers, processes, described = ran("NCC", ini, gain=0.5)
    assert answers == [((22, 11, 2, 3), 0.75)] * 2  # a mask became a box
    assert processes == 1
    said, folder = told(ini), os.path.dirname(ini)
    assert said["folder"] == os.path.realpath(folder)
    assert said["argv"][1:] == ["--fast"]
    assert said["environment"]["NCC_WEIGHTS"] == "/w/ncc:${NOT_SET_42}"
    assert said["environment"]["LD_LIBRARY_PATH"] == f"/there:{folder}/lib:/opt/lib"
    assert said["given"] == {"size": "3", "gain": "0.5"}
    assert described["name"] == "PyNCC"
    assert described["version"] == "1.2"
    settings = described["settings"]
    assert settings["ini"] == ini
    assert settings["section"] == "NCC"
    assert settings["entry"]["env_ncc_weights"] == "${WEIGHTS}/ncc:${NOT_SET_42}"
    assert settings["entry"]["tags"] == "fast, old"
    assert settings["command"] == f"{python} 'a server/serve.py' --fast"
    assert settings["gain"] == "0.5"


@pytest.mark.parametrize("command", ["serve", 'import serve as s; s.run() # it\'s "mine"'])
def test_traxpython_runs_a_module_or_code(registry, monkeypatch, command):
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    ini = registry(
        f"[ncc]\nprotocol = traxpython\ncommand = {command}\npaths = a server:/elsewhere\n"
        "restart = Yes\n"
    )
    answers, processes, described = ran("ncc", ini)
    assert answers == [((22, 11, 2, 3), 0.75)] * 2
    assert processes == 2  # restart
    said, folder = told(ini), os.path.dirname(ini)
    assert said["environment"]["PYTHONPATH"] == f"{folder}/a server:/elsewhere:/nowhere"
    assert said["environment"]["PYTHONUNBUFFERED"] == "1"
    if command != "serve":
        assert said["path"][:2] == [f"{folder}/a server", "/elsewhere"]
    assert described["name"] == "ncc"
    assert "version" not in described


@pytest.mark.parametrize("kind", ["mask", "polygon"])
def test_one_that_takes_no_boxes_is_given_what_it_takes(registry, kind):
    code = f"import serve; serve.run(0, serve.Region.{kind.upper()})"
    ini = registry(f"[ncc]\nprotocol = traxpython\ncommand = {code}\npaths = a server\n")
    answers, _, _ = ran("ncc", ini)
    assert told(ini)["kind"] == kind
    assert answers[0][0][:2] == (22, 11)


def test_traxpython_on_another_interpreter(registry, tmp_path):
    mine = tmp_path / "my python"
    mine.write_text(f'#!/bin/sh\nIT=mine exec {shlex.quote(sys.executable)} "$@"\n')
    mine.chmod(0o755)
    ini = registry(
        f"[ncc]\nprotocol = traxpython\ncommand = serve\npaths = a server\npython = '{mine}' -u\n"
    )
    ran("ncc", ini)
    assert told(ini)["environment"]["IT"] == "mine"


def test_what_a_registry_leaves_out(registry):
    ini = registry("[DEFAULT]\nprotocol = traxpython\n[a]\ncommand = a.b\n")
    program = find_entry("a", os.path.dirname(ini)).program()  # its folder is enough
    assert program.command == f"{shlex.quote(sys.executable)} -m a.b"
    assert program.environment["PYTHONPATH"].split(os.pathsep)[0] == os.path.dirname(ini)
    assert "LD_LIBRARY_PATH" not in program.environment
    assert program.lasting
    assert program.facts["name"] == "a"


def test_an_entry_is_told_in_lines_that_a_trace_can_hold(registry):
    ini = registry("[a]\nlabel = Two\n  lines\nprotocol = trax\ncommand = run\n  --fast\tx\n")
    program = find_entry("a", ini).program()
    assert program.facts["name"] == "Two lines"
    assert program.facts["settings"]["entry"]["command"] == "run --fast x"
    assert shlex.split(program.command) == ["run", "--fast", "x"]


def test_a_reference_may_name_a_version(registry):
    ini = registry("[a]\nversion = 1\nprotocol = trax\ncommand = run\n[b@2]\ncommand = b\n")
    assert find_entry("a@7-x", ini).program().facts["version"] == "7-x"
    assert find_entry("a", ini).program().facts["version"] == "1"
    assert find_entry("b@2", ini).name == "b@2"


def test_how_long_a_call_may_take(registry):
    ini = registry("[slow]\ntimeout = 600\n[fast]\n[half]\ntimeout = 0.5\n[none]\ntimeout = 0\n")
    assert usual_timeout("vot:slow", {"ini": ini}) == 600
    assert usual_timeout("vot:fast", {"ini": ini}) == usual_timeout("dcf", {}) == TIMEOUT_S
    for name in "half", "none":
        with pytest.raises(LaeError, match=rf"trackers\.ini: \[{name}\]: timeout: .* from 1$"):
            usual_timeout(f"vot:{name}", {"ini": ini})


def test_one_that_hangs_is_ended_when_the_registry_says(registry):
    ini = registry(
        "[ncc]\nprotocol = traxpython\ncommand = import serve; serve.run(100)\n"
        "paths = a server\ntimeout = 1\n"
    )
    with Worker("vot:ncc", {"ini": ini}) as worker:
        worker.init(FRAME, BOX)
        with pytest.raises(LaeError, match=r"^vot:ncc: track exceeded 1 s"):
            worker.track(FRAME)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a]\n[ncc]\n[b]\n", r"no tracker 'nc': there are a, ncc, b; did you mean 'ncc'\?"),
        ("", "no tracker 'nc': it names none"),
        ("[nc]\ncommand = x\n", r"\[nc\]: no protocol: there are trax and traxpython"),
        ("[nc]\nprotocol = folder\ncommand = x\n", r"\[nc\]: protocol 'folder' is not supported"),
        ("[nc]\nprotocol = trax\n", r"\[nc\]: no command"),
        ("[nc]\nprotocol = trax\ncommand =\n", r"\[nc\]: no command"),
        ("[nc]\nprotocol = trax\ncommand = no-such-42\n", r"\[nc\] does not start: .*no-such-42"),
        ("[nc]\nprotocol = trax\ncommand = 'half\n", r"\[nc\] does not start: No closing quot"),
        ("[nc]\nprotocol = trax\ncommand = a\0b\n", r"\[nc\] does not start: .*null byte"),
        ("[nc]\nprotocol = trax\ncommand = true\n", r"\[nc\]: it ended with status 0 .*TraX"),
        ("[nc]\nprotocol = trax\ncommand = run %d\n", r"\[nc\]: .*'%' must be followed"),
        ("[nc]\nprotocol = trax\ncommand = %(x)s\n", r"\[nc\]: .*option 'command'"),
        ("[nc]\nprotocol = trax\nprotocol = trax\n", r"not a trackers\.ini .*line +3.*'protocol'"),
        ("[nc]\n[nc]\n", r"not a trackers\.ini .*section 'nc' already exists"),
        ("protocol = trax\n", r"not a trackers\.ini .*line: 1"),
        ("[nc]\njust words\n", r"not a trackers\.ini .*line +2.*just words"),
        ("nc:\n  protocol: trax\n", r"not a trackers\.ini .*no section headers"),  # trackers.yaml
    ],
)
def test_what_is_wrong_is_said_with_its_place(registry, text, message):
    ini = registry(text)
    with pytest.raises(LaeError, match=message) as caught:
        make_tracker("vot:nc", {"ini": ini})
    assert str(caught.value).startswith(ini)
    assert "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LaeError, match=r"^trackers\.ini: no such file"):
        make_tracker("vot:nc", {})
    with pytest.raises(LaeError, match=r"^nowhere/t\.ini: no such file"):
        make_tracker("vot:nc", {"ini": "nowhere/t.ini"})
    (tmp_path / "trackers.ini").write_bytes(bytes(range(256)))
    with pytest.raises(LaeError, match=r"^\./trackers\.ini: not a trackers\.ini .*utf-8"):
        make_tracker("vot:nc", {"ini": "."})
    with pytest.raises(LaeError, match=r"no tracker 'vot'.*vot:NAME"):
        make_tracker("vot", {})


def test_reading_a_registry_runs_nothing(registry, monkeypatch):
    ini = registry("[a]\nprotocol = trax\ncommand = touch ran\n[b]\ncommand = touch ran\n")
    monkeypatch.setattr(subprocess, "Popen", None)
    assert find_entry("a", ini).program().command == "touch ran"
    assert usual_timeout("vot:a", {"ini": ini}) == TIMEOUT_S


def test_profile_records_what_the_registry_says(registry, tmp_path):
    ini = registry(
        "[ncc]\nlabel = Cross-correlation\nversion = 2\nprotocol = traxpython\n"
        "command = serve\npaths = a server\n"
    )
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(1, 5):
        cv2.imwrite(str(frames / f"{number:04d}.png"), FRAME)
    (frames / "groundtruth.txt").write_text("10,20,30,8\n" * 4)
    command = ("profile", "--tracker", "vot:ncc", "--root", "frames", "--out", "t.parquet")
    done = run_here(*command, "--in-process", "--ini", os.path.basename(ini), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    trace = read_trace(tmp_path / "t.parquet")
    tracker = trace.metadata.document["tracker"]
    assert trace.metadata.tracker == tracker["name"] == "Cross-correlation"
    assert tracker["version"] == "2"
    assert tracker["settings"]["ini"] == "trackers.ini"
    assert tracker["settings"]["entry"]["command"] == "serve"
    assert trace["frames"].boxes[1].tolist() == [22, 11, 2, 3]
    shown = run_here("show", "t.parquet", cwd=tmp_path).stdout
    assert re.search(r"^tracker +Cross-correlation", shown, re.M)
    assert "entry command serve" in " ".join(shown.split())  # however it is broken into lines

    done = run_here(*command[:2], "vot:nc", *command[3:], "--ini", ".", cwd=tmp_path)
    assert done.returncode == 2
    said = "./trackers.ini: no tracker 'nc': there are ncc; did you mean 'ncc'?"
    assert done.stderr == f"lae-sim profile: error: {said}\n"
