"""Devices as their system files show them: fake trees of Jetsons, a laptop and nothing at all.

Contents follow public documentation and reports: the Jetson Linux Developer Guide, kernel
documentation of cpufreq, devfreq, thermal and ina3221.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from lae_sim import __version__
from lae_sim.profile import device
from lae_sim.profile.device import describe_device, readings, source_version
from lae_sim.trace.describe import throttling

POLICY = "sys/devices/system/cpu/cpufreq/policy"
THERMAL = "sys/class/thermal/thermal_zone"
HWMON = "sys/class/hwmon/hwmon"


def tree(root: Path, files: dict[str, str]) -> Path:
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return root


def cpufreq(number: int, now: int, allowed: int, hardware: int, governor: str) -> dict[str, str]:
    return {
        f"{POLICY}{number}/scaling_cur_freq": f"{now}\n",
        f"{POLICY}{number}/scaling_max_freq": f"{allowed}\n",
        f"{POLICY}{number}/cpuinfo_max_freq": f"{hardware}\n",
        f"{POLICY}{number}/scaling_governor": f"{governor}\n",
    }


def zone(number: int, kind: str, milli: str) -> dict[str, str]:
    return {f"{THERMAL}{number}/type": kind + "\n", f"{THERMAL}{number}/temp": milli + "\n"}


def cores(count: int) -> dict[str, str]:
    present = {f"sys/devices/system/cpu/cpu{i}/online": "1\n" for i in range(count)}
    info = "processor\t: 0\nmodel name\t: ARMv8 Processor rev 1 (v8l)\nCPU part\t: 0xd42\n"
    return {"proc/cpuinfo": info, "sys/devices/system/cpu/cpuidle/current_driver": "x", **present}


NVPMODEL = """\
# Copyright (c) NVIDIA CORPORATION
< PARAM TYPE=CLOCK NAME=GPU >
MAX_FREQ /sys/devices/platform/17000000.gpu/devfreq_dev/max_freq
###########################
< POWER_MODEL ID=0 NAME=15W >
CPU_ONLINE CORE_0 1
< POWER_MODEL ID=1 NAME=25W >
CPU_ONLINE CORE_0 1
< POWER_MODEL ID=2 NAME=MAXN_SUPER >
CPU_ONLINE CORE_0 1
< PM_CONFIG DEFAULT=1 >
"""
PACKAGES = """\
Package: nvidia-jetpack-dev
Status: install ok installed
Version: 9.9

Package: nvidia-jetpack
Status: install ok installed
Source: nvidia-jetpack (6.2.1)
Version: 6.2.1+b38
Architecture: arm64

Package: libcudnn9-dev-cuda-12
Version: 9.9

Package: libcudnn9-cuda-12
Version: 9.3.0.75-1
"""


@pytest.fixture
def orin_nano(tmp_path: Path) -> Path:
    """JetPack 6 on an Orin Nano: six cores, zones of absent units that cannot be read."""
    return tree(
        tmp_path / "orin",
        {
            "proc/device-tree/model": "NVIDIA Jetson Orin Nano Engineering Reference Kit\0",
            "proc/device-tree/compatible": "nvidia,p3768-0000+p3767-0005\0nvidia,tegra234\0",
            "proc/meminfo": "MemTotal:  7802552 kB\nMemFree: 1 kB\nMemAvailable:  6000000 kB\n",
            "proc/loadavg": "0.52 0.58 0.59 1/389 12345\n",
            **cores(6),
            "etc/nv_tegra_release": "# R36 (release), REVISION: 4.7, GCID: 42132812, BOARD: "
            "generic, EABI: aarch64, DATE: Thu Sep 18 22:54:44 UTC 2025\n# KERNEL_VARIANT: oot\n",
            "etc/os-release": 'PRETTY_NAME="Ubuntu 22.04.5 LTS"\nNAME="Ubuntu"\n',
            "etc/nvpmodel.conf": NVPMODEL,
            "var/lib/nvpmodel/status": "pmode:0002 fmode:fan_mode_quiet",
            "var/lib/dpkg/status": PACKAGES,
            "usr/local/cuda/version.json": '{"cuda": {"name": "CUDA SDK", "version": "12.6.68"}}',
            **cpufreq(0, 1728000, 1728000, 1728000, "schedutil"),
            **cpufreq(4, 729600, 1728000, 1728000, "schedutil"),
            "sys/class/devfreq/17000000.gpu/cur_freq": "1020000000\n",
            "sys/class/devfreq/17000000.gpu/max_freq": "1020000000\n",
            "sys/class/devfreq/15340000.vic/cur_freq": "115200000\n",
            **zone(0, "cpu-thermal", "48593"),
            **zone(1, "gpu-thermal", "-256000"),
            **zone(5, "soc0-thermal", "49031"),
            **zone(8, "tj-thermal", "49500"),
            **zone(9, "PMIC-Die", "100000"),
            f"{HWMON}3/name": "soctherm_oc\n",
            f"{HWMON}3/oc1_event_cnt": "0\n",
            f"{HWMON}3/oc3_event_cnt": "37\n",
        },
    )


def test_an_orin_nano_with_jetpack_6(orin_nano: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lscpu = "Architecture:  aarch64\nModel name:    Cortex-A78AE\n"
    monkeypatch.setattr(device, "output", lambda *command: lscpu)
    found = describe_device(orin_nano)
    assert found["model"] == "NVIDIA Jetson Orin Nano Engineering Reference Kit"
    assert (found["cpu"]["name"], found["cpu"]["cores"]) == ("Cortex-A78AE", 6)
    assert found["gpu"] == {"name": "tegra234, integrated"}
    assert found["memory_bytes"] == 7802552 * 1024
    assert found["power_mode"] == "MAXN_SUPER (nvpmodel 2), governor schedutil"
    assert found["os"].startswith("Ubuntu 22.04.5 LTS, ")
    assert (found["jetpack"], found["l4t"]) == ("6.2.1+b38", "36.4.7")
    assert (found["cuda"], found["cudnn"]) == ("12.6.68", "9.3.0.75-1")


def test_readings_of_an_orin_nano(orin_nano: Path) -> None:
    found = readings(orin_nano)
    assert found["cpu_mhz"] == {"highest": 1728.0, "allowed": 1728.0, "hardware": 1728.0}
    assert found["gpu_mhz"] == {"highest": 1020.0, "allowed": 1020.0}
    assert found["temperatures_c"] == {"cpu": 48.593, "soc0": 49.031, "tj": 49.5}
    assert found["load"] == [0.52, 0.58, 0.59]
    assert found["throttle_events"] == {"oc1_event_cnt": 0, "oc3_event_cnt": 37}
    assert re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00\Z", found["time"])


def test_an_agx_xavier_with_jetpack_5(tmp_path: Path) -> None:
    root = tree(
        tmp_path,
        {
            "proc/device-tree/model": "Jetson-AGX\0",
            "proc/device-tree/compatible": "nvidia,p2972-0000\0nvidia,tegra194\0",
            **cores(8),
            "etc/nv_tegra_release": "# R35 (release), REVISION: 4.1, GCID: 33958178, BOARD: "
            "t186ref, EABI: aarch64, DATE: Tue Aug  1 19:57:35 UTC 2023\n",
            "etc/nvpmodel.conf": "< POWER_MODEL ID=0 NAME=MAXN >\n"
            "< POWER_MODEL ID=3 NAME=30W_ALL >\n",
            "var/lib/nvpmodel/status": "pmode:0003 fmode:fanNull\n",
            "var/lib/dpkg/status": "Package: nvidia-jetpack\nStatus: deinstall ok config-files\n\n"
            "Package: zlib1g\nVersion: 1.2\n",
            "sys/class/devfreq/17000000.gv11b/cur_freq": "318750000\n",
            "sys/class/devfreq/17000000.gv11b/max_freq": "905250000\n",
            **zone(0, "CPU-therm", "33500"),
        },
    )
    found, now = describe_device(root), readings(root)
    assert (found["model"], found["cpu"]["cores"]) == ("Jetson-AGX", 8)
    assert (found["gpu"]["name"], found["l4t"]) == ("tegra194, integrated", "35.4.1")
    assert found["power_mode"] == "30W_ALL (nvpmodel 3)"
    assert not {"jetpack", "cuda", "cudnn"} & set(found)
    assert now["gpu_mhz"] == {"highest": 318.75, "allowed": 905.25}
    assert now["temperatures_c"] == {"CPU": 33.5}


def test_a_laptop(tmp_path: Path) -> None:
    root = tree(
        tmp_path,
        {
            "sys/class/dmi/id/sys_vendor": "LENOVO\n",
            "sys/class/dmi/id/product_name": "20XWCTO1WW\n",
            "proc/cpuinfo": "processor : 0\nmodel name\t: 11th Gen Intel(R) Core(TM) i7-1165G7\n",
            "sys/firmware/acpi/platform_profile": "balanced\n",
            **cpufreq(0, 2800000, 4700000, 4700000, "powersave"),
            **cpufreq(1, 400000, 4700000, 4700000, "powersave"),
            "sys/devices/system/cpu/cpu0/thermal_throttle/core_throttle_count": "3\n",
            "sys/devices/system/cpu/cpu1/thermal_throttle/core_throttle_count": "4\n",
            "sys/devices/system/cpu/cpu0/thermal_throttle/package_throttle_count": "9\n",
            **zone(0, "acpitz", "41000"),
            **zone(1, "acpitz", "45000"),
            **zone(2, "x86_pkg_temp", "47000"),
            **zone(3, "iwlwifi_1", "unreadable"),
            f"{HWMON}0/name": "coretemp\n",
            f"{HWMON}0/temp1_input": "98000\n",
            f"{HWMON}0/temp2_input": "99000\n",
            f"{HWMON}1/name": "nvme\n",
            f"{HWMON}1/temp1_input": "36850\n",
        },
    )
    found, now = describe_device(root), readings(root)
    assert found["model"] == "LENOVO 20XWCTO1WW"
    assert found["cpu"]["name"] == "11th Gen Intel(R) Core(TM) i7-1165G7"
    assert found["power_mode"] == "profile balanced, governor powersave"
    assert now["cpu_mhz"]["highest"] == 2800
    assert now["temperatures_c"] == {"acpitz": 45.0, "coretemp": 99.0, "x86_pkg_temp": 47.0}
    assert now["throttle_events"] == {"core_throttle_count": 7, "package_throttle_count": 9}


def test_nothing_at_all(tmp_path: Path) -> None:
    found = describe_device(tmp_path)
    assert set(found) <= {"model", "cpu", "os", "python"}
    assert str(sys.version_info.minor) in found["python"]
    assert set(readings(tmp_path)) == {"time"}
    assert json.loads(json.dumps(found)) == found


def test_this_machine() -> None:
    found, started = describe_device(), time.perf_counter()
    now = readings()
    if "gpu" not in found:
        assert time.perf_counter() - started < 1
    for facts in (found, now):
        assert json.loads(json.dumps(facts, allow_nan=False)) == facts
    if hasattr(os, "sched_getaffinity"):
        assert found["cpu"]["affinity"] == len(os.sched_getaffinity(0))


def test_garbage_everywhere_does_no_harm(orin_nano: Path) -> None:
    for garbage in (
        b"",
        b"\xff\xfe\0",
        b"-",
        b"9" * 400,
        b"[N/A]\n",
        b"1:2\n::\nID=( NAME=",
        b"{}",
    ):
        for path in orin_nano.rglob("*"):
            if path.is_file():
                path.write_bytes(garbage)
        json.dumps([describe_device(orin_nano), readings(orin_nano)], allow_nan=False)


def test_a_sensor_that_answers_try_again(orin_nano: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What Python makes of EAGAIN: None, as from a pipe that has nothing yet."""
    readable, writable = os.pipe()
    os.set_blocking(readable, False)
    with os.fdopen(readable, "rb") as pipe, os.fdopen(writable, "wb"):
        real = Path.read_bytes

        def read(path: Path) -> bytes:
            return pipe.read() if path.name == "temp" and "zone0" in str(path) else real(path)

        monkeypatch.setattr(Path, "read_bytes", read)
        assert readings(orin_nano)["temperatures_c"] == {"soc0": 49.031, "tj": 49.5}


def smi(root: Path, script: str) -> Path:
    program = root / "usr/bin/nvidia-smi"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n" + script)
    program.chmod(0o755)
    return root


needs_sh = pytest.mark.skipif(os.name == "nt", reason="the fake nvidia-smi is a shell script")


@needs_sh
def test_a_discrete_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    answer = """case "$*" in
    '--id= '*) echo 'No devices were found'; exit 6;;
    *clocks_event_reasons*) echo 'Field "x" is not a valid field to query.'; exit 2;;
    *clocks_throttle_reasons*) echo '1410, 1980, 83, 0x0000000000000024';;
    *) echo 'NVIDIA GeForce RTX 3080, 535.183.01, 10240';; esac"""
    root = smi(tmp_path, answer)
    assert describe_device(root)["gpu"] == {
        "name": "NVIDIA GeForce RTX 3080",
        "driver": "535.183.01",
        "memory_bytes": 10240 * 2**20,
    }
    now = readings(root)
    assert now["gpu_mhz"] == {"highest": 1410.0, "hardware": 1980.0}
    assert now["temperatures_c"] == {"GPU": 83.0}
    assert now["gpu_slowdowns"] == ["software power cap", "software thermal slowdown"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert "gpu" not in describe_device(root)


@needs_sh
@pytest.mark.parametrize(
    "script",
    ["exit 9", "echo 'No devices were found'", "echo '[N/A], [N/A], [N/A], [N/A]'"],
)
def test_a_gpu_that_says_nothing(tmp_path: Path, script: str) -> None:
    root = smi(tmp_path, script)
    assert "gpu" not in describe_device(root)
    assert set(readings(root)) == {"time"}


@needs_sh
def test_a_program_that_hangs_is_given_up() -> None:
    started = time.perf_counter()
    assert device.output("sleep", "30", seconds=0.1) is None
    assert time.perf_counter() - started < 5


def clocks(mhz: float, **more: Any) -> dict[str, Any]:
    return {"cpu_mhz": {"highest": mhz, "allowed": 2000.0}, **more}


def test_steady_clocks_are_no_throttling() -> None:
    idle = clocks(400)
    assert throttling(idle, [clocks(c) for c in (1990, 2000, 1950, 700, 1980, 1930)], idle) is None
    assert throttling({}, [], {}) is None
    assert throttling({}, [{}], {"throttle_events": {"oc1_event_cnt": 5}}) is None


def test_what_throttling_shows() -> None:
    fell = throttling({}, [clocks(c) for c in (2000, 1990, 1800, 1700, 1500, 1400)], {})
    assert fell == "throttling: the CPU's highest clock fell from 2,000 to 1,500 MHz"
    lower = {"cpu_mhz": {"allowed": 1500.0}}
    assert "the CPU's allowed clock fell from 2,000 to 1,500 MHz" in str(
        throttling(clocks(400), [clocks(2000), lower], lower)
    )
    counted = throttling(
        {"throttle_events": {"core_throttle_count": 7}},
        [{"gpu_slowdowns": ["software power cap"]}, {}],
        {"throttle_events": {"core_throttle_count": 19}},
    )
    assert counted == (
        "throttling: core_throttle_count rose by 12; "
        "the GPU reported software power cap in 1 of 2 readings"
    )


def test_the_source_of_a_checkout(repository: Path) -> None:
    found = source_version()
    assert found["version"] == __version__
    if (repository / ".git").exists():
        head = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=repository, capture_output=True, text=True, check=True
        )
        assert found["commit"] == head.stdout.strip()
        assert found["modified"] in (True, False)


def test_a_wheel_has_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "__file__", str(tmp_path / "site-packages/lae_sim/device.py"))
    assert source_version() == {"version": __version__}
