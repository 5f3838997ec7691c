"""``lae-sim show`` as a user runs it, and on whatever metadata another program wrote."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import REPOSITORY
from witness import MINIMAL, columns_of, moving, write_plain

from lae_sim.cli import show
from lae_sim.profile.device import describe_device, readings, source_version
from lae_sim.report.trace import overview
from lae_sim.trace.describe import describe
from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
REAL_TIME = REPOSITORY / "traces" / "synthetic-slow-realtime.parquet"
MS = 10**6
MHZ = {"lowest": 400.0, "allowed": 1728.0}


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run the command; what it prints, or its error."""

    def command(*arguments: Any, status: int = 0) -> str:
        assert show.main([str(argument) for argument in arguments]) == status
        said = capsys.readouterr()
        assert said.err.count("\n") == bool(status)
        return said.err if status else said.out

    return command


def reading(mhz: float, celsius: float, **more: Any) -> dict[str, Any]:
    return {
        "time": "2026-11-22T04:00:00+00:00",
        "cpu_mhz": {"highest": mhz, **MHZ},
        "temperatures_c": {"cpu": celsius - 1, "tj": celsius},
        "load": [1.25, 0.5, 0.2],
        **more,
    }


def profiled() -> tuple[Metadata, list[Recording]]:
    """A trace as the profiler writes it: run in reverse order, heating up, slow first calls."""
    recordings, entries = [], {}
    for i in range(20):
        order = 19 - i
        ns = np.random.default_rng(i).gamma(50, 0.1, 100) * (1 + 0.02 * order) * MS
        ns[0], ns[1] = 300 * MS, 90 * MS
        if i == 4:
            ns[77] = 812 * MS
        boxes = np.tile([10.0, 20, 30, 40], (100, 1))
        truth = np.where(np.arange(100)[:, None] < 99, boxes, np.nan)
        recordings.append(Recording.new(f"s{i:02d}", truth, boxes, ns.astype(np.int64)))
        entries[f"s{i:02d}"] = {"image_size": [640, 360], "order": order, "lost": 2}
    during = [
        reading(1700 - 20 * k, 50 + k, sequence=f"s{19 - k:02d}", throttle_events={"oc3": k})
        for k in range(20)
    ]
    taken = {"before": reading(1728, 45), "during": during, "after": reading(1300, 66)}
    metadata = Metadata.new(
        "30",
        "every-frame",
        schedule={"policy": None, "pre_forecaster": None, "stride": "2"},
        tracker={
            "name": "nanotrack",
            "version": "2",
            "settings": {"instance_size": 255, "half": False},
            "weights_digest": "sha256:" + "0123456789abcdef" * 4,
            "libraries": {"opencv": "5.0.0"},
        },
        device={
            "model": "NVIDIA Jetson Orin Nano",
            "cpu": {"name": "Cortex-A78AE", "cores": 6},
            "memory_bytes": 8 * 2**30,
            "power_mode": "15W (nvpmodel 0)",
            "readings": taken,
        },
        timing={
            "source": "measured",
            "clock": "perf_counter_ns",
            "warmup_calls": 3,
            "synchronised": True,
            "threads": 2,
            "cpu_share": 1.87,
        },
        dataset={"name": "DTB70"},
        sequences=entries,
        failures=[{"sequence": "s20", "reason": "ValueError: no"}],
        lae_sim={"version": "0.2.0", "commit": "ab" * 20, "modified": True},
    )
    return metadata, recordings


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("show") / "full.parquet"
    write_trace(Trace(*profiled()), path)
    return path


def test_stages_are_a_table(run: Callable[..., str], tmp_path: Path) -> None:
    boxes = np.tile([10.0, 20, 30, 40], (3, 1))
    stages = {"warp": [-1, 1 * MS, 3 * MS], "inference": [-1, 20 * MS, 24 * MS]}
    made = Recording.new("a", boxes, boxes, np.array([90, 40, 40]) * MS, stages=stages)
    write_trace(Trace(Metadata.new("30", "every-frame"), [made]), tmp_path / "t.parquet")
    lines = [line.split() for line in run(tmp_path / "t.parquet").splitlines()]
    start = lines.index(["stages,", "ms", "n", "median", "p95", "share"])
    assert lines[start + 2 : start + 6] == [
        ["inference", "2", "22.0", "23.8", "55.0%"],
        ["warp", "2", "2.00", "2.90", "5.0%"],
        ["(the", "rest)", "2", "16.0", "18.7", "40.0%"],
        [],
    ]


def test_everything_that_a_profile_says_is_shown(
    run: Callable[..., str], full: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    lines = run(full).splitlines()
    text = " ".join(" ".join(lines).split())
    for words in (
        "tracker nanotrack, version 2, weights digest sha256:0123456789ab...",
        "settings not half, instance size 255",
        "libraries opencv 5.0.0",
        "device NVIDIA Jetson Orin Nano, memory 8.0 GiB, power mode 15W (nvpmodel 0)",
        "cpu Cortex-A78AE, cores 6",
        "timing measured, clock perf_counter_ns, used 1.9 cores, synchronised, threads 2, warmup",
        "schedule every-frame, stride 2",
        "dataset DTB70",
        "lae sim commit abababababab..., modified, version 0.2.0",
        "2,000 in 20 sequences at 30 fps; all processed; 1,980 truths; 640x360 px; target not "
        "found in 40",
        "failures 1: reason ValueError: no, sequence s20",
        "CPU clock, MHz 1,728 1,320 to 1,700 1,300",
        "hottest zone, C 45.0 50.0 to 69.0 66.0",
        "calls 1,980 ",
        "initialisations 20 300 300 300 300 300 300 3.33",
        "1.06% of the calls take longer than the interval between frames, 33.3 ms",
        "stalls: 21 calls took over 10 x the median of run and sequence 812 ms s04, "
        "frame 77 90.0 ms s",
        "and 11 more, 11 of them first calls",
        "warning the first call after an initialisation takes 90 ms, 15 x the median of the "
        "others: warm up",
        "longer than the first third: heat, throttling, or harder sequences",
        "throttling: oc3 rose by 19; the CPU's highest clock fell from 1,700 to 1,440 MHz",
    ):
        assert words in text, words
    assert "medians of tenths of the run, ms" in lines  # whose order is known
    assert max(map(len, lines)) <= 96
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, run(full).splitlines()[1:])) <= 80
    assert len(lines) < 75


def test_bars_are_as_long_as_their_counts(run: Callable[..., str], full: Path) -> None:
    lines = run(full).splitlines()
    start = next(i for i, line in enumerate(lines) if line.split() == ["ms", "calls"])
    rows = lines[start + 1 : lines.index("", start)]
    counts = [int(row[10:21].replace(",", "")) for row in rows]
    assert sum(counts) == 1980
    bars = [row.count("#") for row in rows]
    assert max(bars) == 50
    for count, bar in zip(counts, bars):
        assert bar == pytest.approx(50 * count / max(counts), abs=1)


def test_little_is_said_where_little_is_known(run: Callable[..., str], tmp_path: Path) -> None:
    path = tmp_path / "constant.parquet"
    box = np.tile([1.0, 2, 3, 4], (200, 1))
    recording = Recording.new("a", box, box, np.full(200, 47 * MS))
    write_trace(Trace(Metadata.new("30", "every-frame"), [recording]), path)
    text = run(path)
    assert not {"unknown", "None", "null", "readings", "device", "warning", "stalls"} & set(
        text.split()
    )
    assert len(text.splitlines()) <= 20
    assert "100% of the calls" in text


def test_one_frame_is_a_trace_too(run: Callable[..., str], tmp_path: Path) -> None:
    path = tmp_path / "one.parquet"
    recording = Recording.new("a", [[1, 2, 3, 4]], [[1, 2, 3, 4]], [5 * MS])
    write_trace(Trace(Metadata.new("30", "every-frame"), [recording]), path)
    assert "initialisations" in run(path)


def test_samples_are_shown_one_after_the_other(run: Callable[..., str]) -> None:
    text = run(SLOW, REAL_TIME)
    assert "warning      the first call after an initialisation takes 102 ms, 2.2 x" in text
    assert "timing       synthetic (made up, not measured)" in text
    assert "costs 282 ms: an assumption (the trace's times: synthetic (made up" in text
    assert "1,677 processed" in text
    assert text.count("times, ms") == 2
    assert "(sequences by name: their order is unknown)" in text


def test_json_has_the_same(run: Callable[..., str], full: Path) -> None:
    document = json.loads(run(full, SLOW, "--json"))
    assert (document["format"], document["version"]) == ("lae-show", "1.0")
    first, second = document["traces"]
    assert first["sequences"] == 20
    assert (first["world_frames"], first["processed"], first["with_truth"]) == (2000, 2000, 1980)
    assert (first["lost"], len(first["failures"])) == (40, 1)
    assert first["provenance"]["device"]["readings"]["before"]["load"] == [1.25, 0.5, 0.2]
    times = first["times"]
    assert times["calls"]["n"] == 1980
    assert times["initialisations"]["mean_ms"] == 300
    assert first["init"] == {
        "mean_ms": 300, "min_ms": 300, "max_ms": 300, "source": "measured",
    }  # fmt: skip
    assert second["init"]["source"] == "the trace's times: synthetic (made up, not measured)"
    assert times["drift"]["slower"] is True
    assert times["stalls"][0] == {"sequence": "s04", "frame": 77, "ms": 812.0, "first_call": False}
    assert len(first["warnings"]) == 3
    assert "\ninitialisation costs 300 ms, measured\n" in run(full)
    assert (second["lost"], second["times"]["order_known"]) == (None, False)


def test_what_the_profiler_writes_fits_the_schema() -> None:
    schema = json.loads((REPOSITORY / "traces" / "metadata.schema.json").read_text())
    document = dict(profiled()[0].document)
    jsonschema.validate(document, schema)
    here = {**describe_device(), "readings": {"before": readings(), "during": [], "after": {}}}
    jsonschema.validate({**document, "device": here, "lae_sim": source_version()}, schema)
    timing = {**document["timing"], "threads": {"opencv": 2}}
    jsonschema.validate({**document, "timing": timing}, schema)
    wrong = {**document, "failures": [{"sequence": "s20"}]}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, schema)


def test_threads_beyond_what_was_asked_are_warned_of(
    run: Callable[..., str], tmp_path: Path
) -> None:
    metadata, recordings = profiled()
    path = tmp_path / "threads.parquet"
    warning = "--threads 1 was not obeyed by all libraries: 1.9 cores were busy"
    for asked, warned in ((1, True), (2, False)):
        threads = {"asked": asked, "opencv": 1, "ncnn": "unknown"}
        timing = {**metadata.document["timing"], "threads": threads}
        write_trace(Trace(Metadata.of({**metadata.document, "timing": timing}), recordings), path)
        text = " ".join(run(path).split())
        assert (warning in text) is warned
        assert f"threads asked {asked}, ncnn unknown, opencv 1" in text


def test_pictures(run: Callable[..., str], full: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="pictures need it")
    run(full, SLOW, "--plot", tmp_path / "times.svg")
    picture = (tmp_path / "times.svg").read_text()
    assert picture.startswith("<?xml")
    assert "name a .png" in run(full, "--plot", tmp_path / "times.docx", status=2)
    assert "would replace" in run(full, "--plot", full, status=2)


def test_faults_are_one_line(run: Callable[..., str], tmp_path: Path) -> None:
    assert "no such file" in run(tmp_path / "none.parquet", status=2)
    (tmp_path / "text.parquet").write_text("no")
    assert "not a readable Parquet file" in run(tmp_path / "text.parquet", status=2)


def test_control_characters_do_not_reach_the_terminal(
    run: Callable[..., str], tmp_path: Path
) -> None:
    path = tmp_path / "odd.parquet"
    document = {**MINIMAL, "tracker": {"name": "\x1b[2Jred"}}
    text = run(write_plain(path, columns_of([moving(3)]), document), status=2)
    assert not any(ord(c) < 32 for c in text.replace("\n", ""))
    assert r"metadata key 'tracker.name' holds the control character '\x1b'" in text


TEXT = st.text(st.characters(exclude_categories=["Cc", "Cs"]))
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | TEXT | st.just(10**400),
    lambda inner: st.lists(inner) | st.dictionaries(TEXT, inner),
    max_leaves=8,
)  # fmt: skip
READING = st.dictionaries(
    st.sampled_from(
        ["cpu_mhz", "gpu_mhz", "temperatures_c", "load"] + ["throttle_events", "gpu_slowdowns"]
    ),
    ANYTHING | st.dictionaries(st.sampled_from(["highest", "allowed"]), ANYTHING),
)
READINGS = st.fixed_dictionaries(
    {"before": READING, "during": ANYTHING | st.lists(READING), "after": READING}
)
OBJECT = st.dictionaries(TEXT | st.sampled_from(["name", "x_bytes"]), ANYTHING)


def test_a_busy_machine_is_pointed_out() -> None:
    document = profiled()[0].document
    device = {"cpu": {"affinity": 2}, "readings": {"before": {"load": [4.5, 1, 1]}}}
    metadata = Metadata.parse(json.dumps({**document, "device": device}).encode())
    report, _ = describe(Trace(metadata, profiled()[1]), "trace")
    assert (
        "the load before the profile was 4.5 on 2 cores: other programs were busy"
        in (report["warnings"])
    )


def test_odd_figures_are_shown() -> None:
    taken = {"before": reading(1728, -5, gpu_mhz={"highest": 0})}
    device = {"memory_bytes": 10**400, "cpu": {"name": ["A", 2]}, "readings": taken}
    metadata = Metadata.new("30", "every-frame", device=device, failures="none")
    text = overview(describe(Trace(metadata, profiled()[1]), "trace")[0])
    assert "hottest zone, C     -5.00" in text
    assert "GPU clock, MHz       0.00" in text
    assert "cpu        A; 2" in text


def test_a_log_and_its_models_are_told_in_words() -> None:
    log = {"clock_offset_ns": -12_505_008_241, "camera_delay_ns": {"least": 5_017_473, "most": 8e6}}
    model = {"digest": "sha256:50be", "file": "backbone.onnx", "threads": 1}
    head = {**model, "file": "head.onnx"}
    document = {"log": log, "tracker": {"models": [model, head, model]}, "device": {}}
    metadata = Metadata.new("30", "every-frame", **document)
    text = overview(describe(Trace(metadata, profiled()[1]), "trace")[0])
    assert "\n\n" not in text.partition("\n\ntimes")[0].partition("\n\n")[2]
    assert "\nlog          clock offset -12505.008241 ms\n" in text
    assert "\n  camera delay least 5.017473 ms, most 8e+06\n" in text
    models = "2 x backbone.onnx, digest sha256:50be, threads 1; head.onnx, digest"
    assert models in " ".join(text.split())


_NUMBERS = st.dictionaries(TEXT, st.floats(allow_nan=False, allow_infinity=False))
_ENERGY = {
    "calls": st.integers(),
    "seconds": st.floats(-1e300, 1e300),
    "power_w": _NUMBERS,
    "idle_w": _NUMBERS,
    "total": st.lists(TEXT, max_size=2),
}
MEASURED = st.fixed_dictionaries(
    {},
    optional={
        "energy": st.fixed_dictionaries(_ENERGY) | OBJECT,
        "clocks": _NUMBERS | ANYTHING,
        "slowdowns": _NUMBERS | ANYTHING,
        "unread": _NUMBERS | ANYTHING,
        "beside": st.lists(OBJECT, max_size=2) | ANYTHING,
    },
)
"""What is measured of a device, or something else in its place."""


@settings(max_examples=30)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "tracker": OBJECT,
            "timing": OBJECT,
            "dataset": ANYTHING,
            "failures": ANYTHING,
            "lae_sim": ANYTHING,
            "other": ANYTHING,
            "device": OBJECT | st.fixed_dictionaries({"readings": ANYTHING | READINGS}) | MEASURED,
            "sequences": st.fixed_dictionaries(
                {"a": st.fixed_dictionaries({}, optional={"order": ANYTHING, "lost": ANYTHING})}
            ),
        },
    )
)
def test_any_metadata_is_shown(more: dict[str, Any]) -> None:
    metadata = Metadata.new("30", "every-frame", **more)
    box = np.tile([1.0, 2, 3, 4], (120, 1))
    recordings = [Recording.new("a", box, box, np.full(120, 47 * MS))]
    report, _ = describe(Trace(metadata, recordings), "trace")
    json.dumps(report, allow_nan=False)
    text = overview(report)
    assert "calls" in text
    assert not any(ord(c) < 32 for c in text.replace("\n", ""))


def test_real_stalls_are_found(run: Callable[..., str], shared_data: Path, tmp_path: Path) -> None:
    name = "VisDrone-SOT-test-dev"
    results = shared_data / "results_with_times" / name / "ORTrack-DeiT-tiny"
    command = [sys.executable, "-m", "lae_sim", "convert", results, "--truth", shared_data / name]
    command += ["--out", tmp_path / "ortrack.parquet"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    subprocess.run(command, check=True, capture_output=True, env=environment)
    text = run(tmp_path / "ortrack.parquet")
    assert "stalls: 2 calls took over 10 x" in text
    assert "14,087 ms  uav0000069_00576_s, frame 1: first call after initialisation" in text
    assert "warning" not in text
