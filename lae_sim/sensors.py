"""Clocks, temperatures and power while a tracker runs, from system files and ``nvidia-smi``.

Every reader gives None, or nothing, for what it cannot find. Sources: the Linux kernel's
documentation of cpufreq, devfreq, thermal and hwmon (ina3221); Jetson Linux Developer Guide,
"Platform Power and Performance"; NVML, ``nvmlClocksEventReasons``.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

Facts = dict[str, Any]

CPU = "sys/devices/system/cpu"
_SLOWDOWNS = {
    0x04: "software power cap",
    0x08: "hardware slowdown",
    0x20: "software thermal slowdown",
    0x40: "hardware thermal slowdown",
    0x80: "hardware power brake",
}


def readings(root: str | os.PathLike[str] = "/") -> Facts:
    """What changes during a profile, now, as JSON values; what is unknown is left out.

    Keys: ``time`` (UTC, ISO 8601); ``cpu_mhz`` and ``gpu_mhz``, objects with the ``lowest`` and
    ``highest`` clock now, what is ``allowed`` by power mode and cooling, and what the ``hardware``
    can do; ``temperatures_c`` by zone; ``power_w`` by rail; ``load`` over 1, 5, 15 minutes;
    ``memory_available_bytes``; ``throttle_events``, counters since boot by name;
    ``gpu_slowdowns``, a discrete GPU's own reasons.

    Args:
        root: the folder that system files are read under.
    """
    at = Path(root)
    found = gathered(
        time=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"),
        cpu_mhz=lambda: _cpu_mhz(at),
        gpu_mhz=lambda: _devfreq_mhz(at),
        temperatures_c=lambda: _temperatures(at),
        power_w=lambda: _rails(at),
        load=lambda: [float(word) for word in text(at / "proc/loadavg").split()[:3]],
        memory_available_bytes=lambda: memory_bytes(at, "MemAvailable"),
        throttle_events=lambda: _throttle_events(at),
    )
    for key, value in gathered(smi=lambda: _discrete_gpu(at)).get("smi", {}).items():
        found[key] = {**found.get(key, {}), **value} if isinstance(value, dict) else value
    return found


def throttling(
    before: Mapping[str, Any],
    during: Sequence[Mapping[str, Any]],
    after: Mapping[str, Any],
    share: float = 0.1,
) -> str | None:
    """What readings say of throttling during a profile, in one sentence; None if nothing.

    Clocks are compared between the first and the last third of the readings taken while the tracker
    ran, the highest of each, since a clock that was read in a pause is low for another reason.

    Args:
        before: what ``readings`` returned before the profile.
        during: what it returned in the course of it.
        after: what it returned at the end.
        share: a clock that fell by more than this share is reported.
    """
    signs = []
    everything = [before, *during, after]
    counters = [r["throttle_events"] for r in everything if "throttle_events" in r]
    for name in counters[0] if counters else ():
        if (rise := counters[-1].get(name, 0) - counters[0][name]) > 0:
            signs.append(f"{name} rose by {rise}")
    reasons = [reason for r in during for reason in r.get("gpu_slowdowns", ())]
    for reason in dict.fromkeys(reasons):
        count = f"{reasons.count(reason)} of {len(during)}"
        signs.append(f"the GPU reported {reason} in {count} readings")
    for key, clock, series in (
        ("allowed", "highest allowed clock", everything),
        ("highest", "clock", during),
    ):
        for unit in ("CPU", "GPU"):
            mhz = [r.get(f"{unit.lower()}_mhz", {}).get(key) for r in series]
            known = [value for value in mhz if value]
            third = max(1, len(known) // 3)
            if known and max(known[-third:]) < (1 - share) * max(known[:third]):
                fell = f"{max(known[:third]):,.0f} to {max(known[-third:]):,.0f} MHz"
                signs.append(f"the {unit}'s {clock} fell from {fell}")
    return "throttling: " + "; ".join(signs) if signs else None


def gathered(**parts: Callable[[], Any]) -> Facts:
    """What the functions return, without what is empty or fails."""
    found = {}
    for name, part in parts.items():
        try:
            value = part()
            json.dumps(value, allow_nan=False)  # an infinity is such an oddity too
        except Exception:  # no oddity of a system file may end a profile of an hour
            continue
        if value not in (None, "", {}, []):
            found[name] = value
    return found


def text(path: Path) -> str:
    """Contents of a system file; "" if it cannot be read.

    Python's own files fail oddly where a sensor answers "try again" (EAGAIN), as the thermal zones
    of units that are off do on Jetsons.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError):
        return ""
    parts = []
    try:
        while part := os.read(descriptor, 1 << 20):
            parts.append(part)
    except OSError:
        return ""
    finally:
        os.close(descriptor)
    return b"".join(parts).decode(errors="replace").strip("\0 \n\t")


def number(path: Path) -> int | None:
    """The whole number that a system file holds."""
    found = re.match(r"-?\d{1,18}\Z", text(path))
    return int(found[0]) if found else None


def matched(content: str, pattern: str) -> str | None:
    """The groups of the pattern, joined by dots, where it is found."""
    match = re.search(pattern, content, re.MULTILINE)
    return ".".join(match.groups()) if match else None


def memory_bytes(at: Path, name: str) -> int | None:
    """A figure of ``/proc/meminfo``."""
    kib = matched(text(at / "proc/meminfo"), rf"^{name}:\s+(\d+) kB")
    return int(kib) * 1024 if kib else None


def tegra(at: Path) -> str | None:
    """A Jetson's chip, such as ``tegra234``."""
    return matched(text(at / "proc/device-tree/compatible"), r"nvidia,(tegra\d{3})")


def output(command: Sequence[str], seconds: float = 10) -> str | None:
    """What a program prints; None if it fails, hangs or is not there."""
    # git would take the repository of a hook that runs this
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=seconds, check=True, env=environment
        )
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return done.stdout


def nvidia_smi(at: Path, *fields: str) -> list[str]:
    """Fields of the first GPU that this process may use; "" where it does not say.

    Raises:
        ValueError: if there is none, or it does not know a field.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0].strip()
    folder = None if at == Path("/") else str(at / "usr/bin")
    program = shutil.which("nvidia-smi", path=folder)
    if program is None or visible in ("", "-1"):
        raise ValueError("no GPU")
    command = [program, f"--id={visible}", f"--query-gpu={','.join(fields)}"]
    out = output([*command, "--format=csv,noheader,nounits"])
    values = [value.strip() for value in (out or "").partition("\n")[0].split(",")]
    if len(values) != len(fields):
        raise ValueError("not what was asked for")
    return ["" if re.match(r"\[|N/A", value) else value for value in values]


def _cpu_mhz(at: Path) -> dict[str, float]:
    """Clocks over the groups of cores that change together; Jetsons have one per cluster."""
    until = time.perf_counter() + 0.01  # older x86 kernels take 10 ms for each idle core
    policies = sorted(at.glob(CPU + "/cpufreq/policy*"))
    now = []
    for policy in policies:
        now.append(number(policy / "scaling_cur_freq"))
        if time.perf_counter() > until:
            break
    allowed = [number(policy / "scaling_max_freq") for policy in policies]
    hardware = [number(policy / "cpuinfo_max_freq") for policy in policies]
    clocks = {
        "lowest": min(filter(None, now), default=None),
        "highest": max(filter(None, now), default=None),
        "allowed": max(filter(None, allowed), default=None),
        "hardware": max(filter(None, hardware), default=None),
    }
    return {name: khz / 1e3 for name, khz in clocks.items() if khz}


def _devfreq_mhz(at: Path) -> dict[str, float]:
    """Clocks of an integrated GPU: 17000000.ga10b, 17000000.gpu or gpu-gpc-0 on Jetsons."""
    for device in sorted(at.glob("sys/class/devfreq/*")):
        if re.search(r"gpu|\.g[a-z]\d\db", device.name):
            hz = {"highest": number(device / "cur_freq"), "allowed": number(device / "max_freq")}
            return {name: value / 1e6 for name, value in hz.items() if value}
    return {}


def _temperatures(at: Path) -> dict[str, float]:
    """Degrees Celsius, the highest of each name; hwmon where there are no zones, and for AMD."""
    found = [
        (text(zone / "type"), number(zone / "temp"))
        for zone in at.glob("sys/class/thermal/thermal_zone*")
    ]
    no_zones = not found
    for chip in at.glob("sys/class/hwmon/hwmon*"):
        driver = text(chip / "name")
        if driver == "k10temp" or no_zones:
            for path in chip.glob("temp*_input"):
                label = text(path.with_name(path.name.replace("input", "label")))
                found.append((f"{driver} {label}".strip(), number(path)))
    hottest: dict[str, float] = {}
    for name, value in found:
        # units that are off say -256 degrees, and the PMIC of a Jetson 100 whatever it has
        if value is not None and -50_000 < value < 150_000 and not name.startswith("PMIC"):
            short = name.replace("-thermal", "").replace("-therm", "")
            hottest[short] = max(value / 1000, hottest.get(short, -50))
    return dict(sorted(hottest.items()))


def _rails(at: Path) -> dict[str, float]:
    """Power in W by rail, from the voltages and currents of a Jetson's monitor chips."""
    rails = {}
    for label in sorted(at.glob("sys/class/hwmon/hwmon*/in[123]_label")):
        name = text(label)
        if text(label.with_name("name")) == "ina3221" and name not in ("", "NC"):
            milli_volt = number(label.with_name(f"in{label.name[2]}_input"))
            milli_ampere = number(label.with_name(f"curr{label.name[2]}_input"))
            if None not in (milli_volt, milli_ampere):
                rails[name] = round((milli_volt or 0) * (milli_ampere or 0) / 1e6, 3)
    return rails


def _throttle_events(at: Path) -> dict[str, int]:
    """Counters of x86 cores and packages, and of a Jetson's low voltage and overcurrent."""
    counters: dict[str, int] = {}
    for pattern in (
        CPU + "/cpu*/thermal_throttle/*_throttle_count",
        "sys/class/hwmon/hwmon*/oc[0-9]_event_cnt",
    ):
        for path in sorted(at.glob(pattern)):
            counters[path.name] = counters.get(path.name, 0) + (number(path) or 0)
    return counters


def _discrete_gpu(at: Path) -> Facts:
    if tegra(at):  # its nvidia-smi knows none of these
        return {}
    fields = ("clocks.sm", "clocks.max.sm", "temperature.gpu", "power.draw")
    try:
        values = nvidia_smi(at, *fields, "clocks_event_reasons.active")
    except ValueError:  # drivers before 535
        values = nvidia_smi(at, *fields, "clocks_throttle_reasons.active")
    clock, limit, celsius, watts, mask = values
    return gathered(
        gpu_mhz=lambda: {"highest": float(clock), "hardware": float(limit)},
        temperatures_c=lambda: {"GPU": float(celsius)},
        power_w=lambda: {"GPU": float(watts)},
        gpu_slowdowns=lambda: [name for bit, name in _SLOWDOWNS.items() if int(mask, 16) & bit],
    )
