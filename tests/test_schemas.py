"""What commands print as JSON is what the schemas of docs/reference/schemas describe."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import run_here
from fakes import bright_frame
from jsonschema import Draft202012Validator, ValidationError
from places import TRACES
from restarted import gap_pass
from schemas import check, closed, schemas

from lae_sim.trace.file import read_trace

SLOW, FAST = TRACES / "synthetic-slow.parquet", TRACES / "synthetic-fast.parquet"
REAL_TIME = TRACES / "synthetic-slow-realtime.parquet"
METADATA = json.loads((TRACES / "metadata.schema.json").read_text())
ALL = {**schemas(), "metadata.schema.json": METADATA}
TWO = ("--sequence", "car-chase", "boat-calm")

TRACKER = """
class Still:
    def init(self, frame, box):
        self.box, self.calls = box, 0

    def track(self, frame):
        self.calls += 1
        if self.calls == 3 and frame[0, 0, 0]:
            raise ValueError("lost my mind")
        return self.box
"""


def printed(command: str, *arguments: object, status: int = 0, cwd: Path | None = None) -> Any:
    """What a command prints as JSON, and its schema allows."""
    ran = run_here(command, *arguments, "--json", cwd=cwd)
    assert ran.returncode == status, ran.stderr
    document = json.loads(ran.stdout)
    check(document, command)
    return document


@pytest.fixture
def gaps(tmp_path: Path) -> Path:
    return gap_pass(read_trace(SLOW).metadata, tmp_path / "slow.gaps.parquet")


def test_replay(gaps: Path) -> None:
    each = ("--per-sequence", "--attributes", "--sigma-grid")
    (assumed,) = printed("replay", SLOW, *TWO, *each)["traces"]
    assert not assumed["search"]["c_known"]
    assert "mauc" in assumed["results"][0]
    (piped,) = printed("replay", SLOW, *TWO, "--pipeline", TRACES / "pipeline.toml")["traces"]
    assert [each["stage"] for each in piped["pipeline"]["stages"]] == [
        "decode",
        "tracker",
        "publish",
    ]
    (measured,) = printed("replay", SLOW, *TWO, "--strided", gaps, "--per-sequence")["traces"]
    assert measured["search"]["reach"]
    (exact,) = printed("replay", REAL_TIME)["traces"]
    assert exact["search"] is exact["offline"] is None


def test_compare() -> None:
    more = ("--forecaster", "kalman", "--search", "c=0.7")
    assert "attributes" in printed("compare", SLOW, *TWO, *more, "--attributes")
    printed("compare", SLOW, REAL_TIME, *TWO, *more, "--sigma-grid")


def test_show(gaps: Path) -> None:
    staged, full = (
        TRACES / "cases" / "valid" / f"{n}.parquet" for n in ("stages", "full-metadata")
    )
    measured, *_, of_stages, last = printed("show", full, SLOW, REAL_TIME, staged, gaps)["traces"]
    assert measured["provenance"]["device"]["energy"]["joules_per_frame"] == 0.19
    assert [row["stage"] for row in of_stages["times"]["stages"]] == ["decode", "inference", None]
    assert last["reach"]["bins"]


def test_study(tmp_path: Path) -> None:
    study = {
        "traces": [str(SLOW), str(FAST)],
        "latencies": ["bootstrap"],
        "repetitions": 2,
        "sigma": [0, 0.5],
        "search": ["c=0.7"],
        "sequences": ["car-chase", "boat-calm"],
        "require_auc": 0.5,
    }
    text = "\n".join(f"{key} = {json.dumps(value)}" for key, value in study.items())
    (tmp_path / "study.toml").write_text(text)
    options = ("--out", tmp_path / "out", "--workers", 1, "--no-report")
    document = printed("study", tmp_path / "study.toml", *options)
    assert document["comparisons"]
    assert document["required"]
    assert json.loads((tmp_path / "out" / "study.json").read_text()) == document


def test_fidelity(gaps: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.parquet"
    again.write_bytes(REAL_TIME.read_bytes())
    loops = ("--closed-loop", REAL_TIME, again)
    assert printed("fidelity", SLOW, *loops, "--strided", gaps)["repeats"]


def test_a_log(tmp_path: Path) -> None:
    text = "frame,captured_ms,arrived_ms,started_ms,ready_ms,x,y,w,h\n"
    text += "0,0,5,6,40,1,2,3,4\n1,33,39,,,,,,\n2,66,72,74,99,,,,\n"
    (tmp_path / "flight.csv").write_text(text)
    trace = tmp_path / "t.parquet"
    assert printed("convert", tmp_path / "flight.csv", "--out", trace)["held"] == {"flight": 1}
    Draft202012Validator(closed(METADATA)).validate(read_trace(trace).metadata.document)
    (replayed,) = printed("replay", trace, "--policy", "recorded")["traces"]
    assert replayed["exact"]
    (shown,) = printed("show", trace)["traces"]
    assert [row["stage"] for row in shown["times"]["stages"]] == ["queue", "tracker", None]


@pytest.mark.parametrize("command", ["convert", "profile"])
def test_what_makes_traces(command: str, tmp_path: Path) -> None:
    rows = "".join(f"{5 + 2 * i},20,12,10\n" for i in range(8))
    for name in ("bad", "good"):
        for folder in ("img", "results"):
            (tmp_path / "data" / name / folder).mkdir(parents=True)
        for i in range(8):
            frame = bright_frame(5 + 2 * i, 20)
            frame[0, 0] = 99 * (name == "bad")
            cv2.imwrite(str(tmp_path / "data" / name / "img" / f"{i + 1:04}.png"), frame)
        (tmp_path / "data" / name / "groundtruth_rect.txt").write_text(rows)
        (tmp_path / f"{name}.txt").write_text(rows)
    out = ("--out", tmp_path / "t.parquet")
    if command == "convert":
        time = ("--time", "constant:47ms", "--tracker", "still", "--dataset", "made")
        np.savez(
            tmp_path / "r.npz",
            **{n: np.loadtxt(tmp_path / f"{n}.txt", delimiter=",") for n in ("bad", "good")},
        )
        assert printed("convert", tmp_path / "r.npz", "--truth", tmp_path / "data", *time, *out)
    else:
        (tmp_path / "still.py").write_text(TRACKER)
        tracker = ("--tracker", "still:Still", "--root", tmp_path / "data", "--in-process")
        document = printed("profile", *tracker, *out, status=1, cwd=tmp_path)
        assert document["failures"]
        metadata = read_trace(tmp_path / "t.parquet").metadata.document
        Draft202012Validator(METADATA).validate(json.loads(json.dumps(dict(metadata))))


def test_a_key_that_is_not_described_is_an_error_here_but_not_to_users() -> None:
    document = {"traces": [], "failures": [], "new": 1}
    with pytest.raises(AssertionError, match="'new' was unexpected"):
        check(document, "profile")
    Draft202012Validator(ALL["profile.schema.json"]).validate(document)
    with pytest.raises(ValidationError, match="'failures' is a required property"):
        Draft202012Validator(ALL["profile.schema.json"]).validate({"traces": []})


@pytest.mark.parametrize("name", sorted(ALL))
def test_every_key_is_described(name: str) -> None:
    Draft202012Validator.check_schema(ALL[name])
    assert not list(undescribed(ALL[name], name))


def undescribed(schema: Any, where: str) -> Iterator[str]:
    if isinstance(schema, dict):
        for key, value in schema.get("properties", {}).items():
            if "description" not in value:
                yield f"{where}.{key}"
        for key, value in schema.items():
            yield from undescribed(value, f"{where}.{key}")
    for each in schema if isinstance(schema, list) else ():
        yield from undescribed(each, where)
