"""Sensors of power as system files show them: fake trees of Jetsons and PCs, and a fake NVML."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import pytest

from lae_sim.profile.sensors import Sensor, find_sensors

POWERCAP = "sys/class/powercap/"


def tree(root: Path, files: dict[str, str]) -> Path:
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return root


def ina3221(number: int, *channels: tuple[str, int, int]) -> dict[str, str]:
    """A monitor with up to three rails: label, millivolts, milliamperes."""
    folder = f"sys/class/hwmon/hwmon{number}/"
    files = {f"{folder}name": "ina3221\n", f"{folder}in7_label": "sum of shunt voltages\n"}
    files[f"{folder}in7_input"] = "9000\n"
    for place, (label, millivolts, milliamperes) in enumerate(channels, 1):
        files[f"{folder}in{place}_label"] = f"{label}\n"
        files[f"{folder}in{place}_input"] = f"{millivolts}\n"
        files[f"{folder}curr{place}_input"] = f"{milliamperes}\n"
        files[f"{folder}in{place + 3}_input"] = "40\n"  # across the shunt
    return files


def rapl(zone: str, name: str, microjoules: int, most: int = 262_143_328_850) -> dict[str, str]:
    folder = f"{POWERCAP}intel-rapl:{zone}/"
    return {
        f"{folder}name": f"{name}\n",
        f"{folder}energy_uj": f"{microjoules}\n",
        f"{folder}max_energy_range_uj": f"{most}\n",
    }


def watts(sensors: tuple[Sensor, ...]) -> dict[str, float | None]:
    return {each.name: each.read() for each in sensors if each.kind == "power"}


def total(sensors: tuple[Sensor, ...]) -> list[str]:
    return [each.name for each in sensors if each.in_total]


def test_the_rail_that_feeds_a_module_is_its_power(tmp_path: Path) -> None:
    rails = ("VDD_IN", 5064, 1200), ("VDD_CPU_GPU_CV", 5056, 300), ("VDD_SOC", 5048, 250)
    clock = {"sys/class/devfreq/17000000.gpu/cur_freq": "918000000\n"}
    found = find_sensors(tree(tmp_path, ina3221(1, *rails) | clock))
    expected = {"VDD_IN": 6.0768, "VDD_CPU_GPU_CV": 1.5168, "VDD_SOC": 1.262}
    assert watts(found) == pytest.approx(expected)
    assert total(found) == ["VDD_IN"]
    assert [(each.name, each.read()) for each in found if each.kind == "clock"] == [
        ("gpu_mhz", 918.0)
    ]


def test_a_module_without_such_a_rail_is_the_sum_of_its_parts(tmp_path: Path) -> None:
    """An AGX Orin, of whose rails one is behind another."""
    first = ("VDD_GPU_SOC", 19000, 150), ("VDD_CPU_CV", 19000, 50), ("VIN_SYS_5V0", 4968, 900)
    second = ("NC", 0, 0), ("VDDQ_VDD2_1V8AO", 4968, 80)
    found = find_sensors(tree(tmp_path, ina3221(3, *first) | ina3221(4, *second)))
    assert list(watts(found)) == ["VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0", "VDDQ_VDD2_1V8AO"]
    assert total(found) == ["VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0"]


def test_a_monitor_that_tells_watts(tmp_path: Path) -> None:
    folder = "sys/class/hwmon/hwmon0/"
    files = {f"{folder}name": "ina238\n", f"{folder}power1_input": "31250000\n"}
    found = find_sensors(tree(tmp_path, files))
    assert watts(found) == {"VIN": 31.25}
    assert total(found) == ["VIN"]


def test_packages_and_memory_count_but_not_what_a_package_includes(tmp_path: Path) -> None:
    files = {
        **rapl("0", "package-0", 5_000_000),
        **rapl("0:0", "core", 3_000_000),
        **rapl("0:1", "dram", 1_500_000, most=65_712_999_613),
        **rapl("1", "psys", 9_000_000),
    }
    found = find_sensors(tree(tmp_path, files))
    assert watts(found) == {"package-0": 5.0, "package-0 dram": 1.5, "psys": 9.0}
    assert total(found) == ["package-0", "package-0 dram"]
    assert all(each.counts for each in found)
    assert found[1].wraps_at == pytest.approx(65712.999613)


def test_nothing_at_all_and_what_cannot_be_read(tmp_path: Path) -> None:
    assert find_sensors(tmp_path) == ()
    closed = tree(tmp_path, rapl("0", "package-0", 1) | ina3221(0, ("VDD_IN", 5000, 100)))
    energy = tmp_path / POWERCAP / "intel-rapl:0/energy_uj"
    energy.unlink()
    energy.mkdir()  # as unreadable as one that is root's
    (tmp_path / "sys/class/hwmon/hwmon0/curr1_input").write_text("")
    assert find_sensors(closed) == ()


class FakeNvml:
    """An NVML of one GPU; what is None is not supported."""

    def __init__(self, millijoules: int | None, milliwatts: int = 75_500) -> None:
        self.asked: list[Any] = []
        self._answers = {
            "TotalEnergyConsumption": (ctypes.c_ulonglong, millijoules),
            "PowerUsage": (ctypes.c_uint, milliwatts),
            "ClockInfo": (ctypes.c_uint, 1410),
            "CurrentClocksThrottleReasons": (ctypes.c_ulonglong, 0x24),
        }

    def __getattr__(self, name: str) -> Any:
        question = name.removeprefix("nvmlDeviceGet")
        if question in ("HandleByIndex_v2", "HandleByUUID"):
            return self._handle
        kind, value = self._answers[question]
        is_clock = question == "ClockInfo"

        def answer(device: Any, *arguments: Any) -> int:
            *which, pointer = arguments
            assert isinstance(pointer._obj, kind)
            assert [each.value for each in which] == [1] * is_clock  # of the streaming cores
            if value is None:
                return 3
            pointer._obj.value = value
            return 0

        return answer

    def _handle(self, which: Any, device: Any) -> int:
        self.asked.append(which)
        return 0 if which in (0, 1, b"GPU-1") else 6


def test_a_gpu_tells_its_energy_its_clock_and_why_it_slows_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    found = {each.name: each for each in find_sensors(tmp_path, FakeNvml(12_345_678))}
    assert (found["GPU"].read(), found["GPU"].counts, found["GPU"].in_total) == (
        pytest.approx(12345.678),
        True,
        True,
    )
    assert found["gpu_mhz"].read() == 1410
    slow = {each.name for each in found.values() if each.kind == "slowdown" and each.read()}
    assert slow == {"software power cap", "software thermal slowdown"}
    assert len([each for each in found.values() if each.kind == "slowdown"]) == 5


def test_a_gpu_older_than_its_energy_counter_tells_its_power(tmp_path: Path) -> None:
    (gpu,) = (each for each in find_sensors(tmp_path, FakeNvml(None)) if each.name == "GPU")
    assert (gpu.read(), gpu.counts) == (75.5, False)


@pytest.mark.parametrize(
    ("visible", "asked", "there"),
    [("1,0", 1, True), ("7", 7, False), ("GPU-1", b"GPU-1", True), ("", b"", False)],
)
def test_the_gpu_is_the_one_that_this_process_may_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, visible: str, asked: Any, there: bool
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    nvml = FakeNvml(1)
    assert bool(find_sensors(tmp_path, nvml)) == there
    assert nvml.asked == [asked]


def test_this_machine_is_asked_without_harm() -> None:
    for sensor in find_sensors():
        assert sensor.read() is None or isinstance(sensor.read(), float)
