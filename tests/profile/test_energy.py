"""Power and clocks of whole profiles, on devices whose sensors are made up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import bright_frame
from jsonschema import Draft202012Validator
from places import TRACES
from schemas import closed

from lae_sim.profile import run as module
from lae_sim.profile.energy import of_device
from lae_sim.profile.run import ProfilePlan, run_profile
from lae_sim.profile.sensors import Sensor
from lae_sim.report.trace import overview
from lae_sim.trace.describe import describe
from lae_sim.trace.energy import Energy
from lae_sim.trace.file import Trace, read_trace

LENGTH = 12


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short sequences of small images."""
    root = tmp_path_factory.mktemp("data")
    for name in ("a", "b"):
        (root / name / "img").mkdir(parents=True)
        for i in range(LENGTH):
            frame = bright_frame(5 + 2 * i, 20, size=(80, 64))
            cv2.imwrite(str(root / name / "img" / f"{i + 1:04}.png"), frame)
        boxes = [f"{5 + 2 * i},20,12,10\n" for i in range(LENGTH)]
        (root / name / "groundtruth_rect.txt").write_text("".join(boxes))
    return root


class Device:
    """Sensors that say what they are told to: 3 W before a tracker is started."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.watts: float | None = 3.0
        self.busy = 8.0
        self.slow = 0.0
        monkeypatch.setattr(module, "find_sensors", self.sensors)
        start = module._start

        def started(*arguments: Any) -> Any:
            self.watts = self.busy
            return start(*arguments)

        monkeypatch.setattr(module, "_start", started)

    def sensors(self) -> tuple[Sensor, ...]:
        return (
            Sensor("VDD_IN", "power", lambda: self.watts, in_total=True),
            Sensor("VDD_SOC", "power", lambda: 1.0),
            Sensor("gpu_mhz", "clock", lambda: 918.0),
            Sensor("software power cap", "slowdown", lambda: self.slow),
            Sensor("hardware slowdown", "slowdown", lambda: 0.0),
        )


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    return Device(monkeypatch)


def profiled(root: Path, out: Path, more: dict[str, Any], **how: Any) -> tuple[list[Trace], str]:
    """The traces of a profile, and what it said."""
    notices: list[str] = []
    quick = {"root": root, "in_process": True, "warmup": 0, "idle": "50ms"}
    plan = ProfilePlan.of(**{**quick, **more})
    profile = run_profile(plan, out, notice=notices.append, **how)
    return [read_trace(each.trace) for each in profile.traces], "\n".join(notices)


def seconds(trace: Trace) -> float:
    return sum(float(each.elapsed_ns[1:].clip(0).sum()) for each in trace) / 1e9


def test_joules_are_watts_times_the_times_of_the_trace(
    tmp_path: Path, root: Path, device: Device
) -> None:
    device.slow = 1.0
    (trace,), said = profiled(root, tmp_path / "t.parquet", {})
    energy = Energy.of(trace.metadata.document)
    assert energy is not None
    assert said == ""
    assert (energy.power_w, energy.idle_w) == (
        {"VDD_IN": 8.0, "VDD_SOC": 1.0},
        {"VDD_IN": 3.0, "VDD_SOC": 1.0},
    )
    assert energy.calls == 2 * (LENGTH - 1)
    assert energy.seconds == pytest.approx(seconds(trace))
    assert energy.joules_per_frame == pytest.approx(8 * seconds(trace) / energy.calls)
    assert energy.joules_above_idle == pytest.approx(5 * seconds(trace) / energy.calls)
    told = trace.metadata.document["device"]
    schema = closed(json.loads((TRACES / "metadata.schema.json").read_text()))
    Draft202012Validator(schema["properties"]["sequences"] | {"$defs": schema["$defs"]}).validate(
        trace.metadata.document["sequences"]
    )
    Draft202012Validator(schema["properties"]["device"] | {"$defs": schema["$defs"]}).validate(told)
    assert told["clocks"] == {"gpu_mhz": 918.0}
    assert told["slowdowns"] == {"software power cap": 1.0}
    assert "unread" not in told
    report, _ = describe(trace, "t.parquet")
    text = " ".join(overview(report).split())
    assert "power, W during calls at rest" in text
    assert "VDD_IN 8.00 3.00 VDD_SOC 1.00 1.00 a call takes" in text
    assert f"a call takes {energy.joules_per_frame:.3g} J (VDD_IN), " in text
    assert "GPU at 918 MHz during the calls" in text
    assert "throttling: the GPU reported software power cap during 100% of the calls' time" in text


def test_each_pass_has_its_own_but_restarts_have_none(
    tmp_path: Path, root: Path, device: Device
) -> None:
    more = {"strides": 2, "closed_loops": "constant:47ms", "gaps": "1m"}
    traces, _ = profiled(root, tmp_path / "t.parquet", more)
    found = {
        (each.metadata.kind, str(each.metadata.stride)): Energy.of(each.metadata.document)
        for each in traces
    }
    assert found.pop(("restarts", "1")) is None
    every = found["every-frame", "1"], found["every-frame", "2"]
    assert [each.calls for each in every if each] == [2 * (LENGTH - 1)] * 2
    closed = found["real-time", "1"]
    # the times are those of another device, the energy is that of this one
    assert closed is not None
    assert closed.watts == 8
    assert closed.seconds < 0.047 * closed.calls


def test_a_resumed_profile_has_the_energy_of_both_runs(
    tmp_path: Path, root: Path, device: Device
) -> None:
    def stop(done: int, total: int) -> None:
        if done > 1.5 * LENGTH:
            raise KeyboardInterrupt

    out = tmp_path / "t.parquet"
    with pytest.raises(KeyboardInterrupt):
        profiled(root, out, {}, progress=stop)
    device.watts, device.busy = 2.0, 6.0
    (trace,), _ = profiled(root, out, {}, resume=True)
    energy = Energy.of(trace.metadata.document)
    first, second = (
        trace.metadata.document["sequences"][name]["sampled"]["seconds"] for name in "ab"
    )
    assert energy is not None
    assert energy.seconds == pytest.approx(first + second)
    weights = np.array([first, second]) / (first + second)
    assert energy.watts == pytest.approx(weights @ [8, 6], abs=1e-5)
    assert energy.idle_watts == pytest.approx(weights @ [3, 2], abs=1e-5)


def test_a_sensor_that_fails_midway_says_so_and_ends_nothing(
    tmp_path: Path, root: Path, device: Device
) -> None:
    def fail(done: int, total: int) -> None:
        if done > LENGTH:  # the first sequence is over, and read to its end
            device.watts = None

    (trace,), said = profiled(root, tmp_path / "t.parquet", {}, progress=fail)
    assert "VDD_IN: " in said
    assert "readings failed: it says nothing of these" in said
    document = trace.metadata.document
    assert document["device"]["unread"]["VDD_IN"] > 0
    assert document["device"]["energy"]["power_w"]["VDD_IN"] == 8
    assert "VDD_IN" not in document["sequences"]["b"]["sampled"]["power_w"]
    report, _ = describe(trace, "t.parquet")
    assert any("sensors failed: VDD_IN in" in text for text in report["warnings"])


def test_without_sensors_there_is_nothing(
    tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "find_sensors", tuple)
    (trace,), said = profiled(root, tmp_path / "t.parquet", {"idle": "600s"})
    assert said == "the power at rest is not measured: no sensor of it answers here"
    assert not {"energy", "clocks", "slowdowns", "unread"} & set(trace.metadata.document["device"])
    assert "sampled" not in trace.metadata.document["sequences"]["a"]
    assert "power" not in overview(describe(trace, "t.parquet")[0])
    assert profiled(root, tmp_path / "usual.parquet", {"idle": "2s"})[1] == ""


def test_means_over_sequences_count_by_their_time() -> None:
    def document(name: str, watts: dict[str, float], seconds: float) -> dict[str, Any]:
        sampled = {"calls": 10, "seconds": seconds, "power_w": watts}
        rest = {"total": ["CPU", "GPU"], "idle_w": {"CPU": 1.0}}
        return {"device": {"energy": rest}, "sequences": {name: {"sampled": sampled}}}

    parts = [document("a", {"CPU": 10.0, "GPU": 5.0}, 1.0), document("b", {"CPU": 4.0}, 3.0)]
    energy = of_device(parts)["energy"]
    assert energy["power_w"] == {"CPU": 5.5, "GPU": 5.0}
    assert (energy["calls"], energy["seconds"]) == (20, 4.0)
    assert energy["joules_per_frame"] == pytest.approx(10.5 * 4 / 20)
    assert "joules_per_frame_above_idle" not in energy
    assert of_device([{"device": {}, "sequences": {"a": {}}}]) == {}
