"""Clocks and temperatures while a tracker runs, from system files and ``nvidia-smi``.

Every reader gives None, or nothing, for what it cannot find. Sources: the Linux kernel's
documentation of cpufreq, devfreq, thermal and hwmon; Jetson Linux Developer Guide,
"Platform Power and Performance"; NVML, ``nvmlClocksEventReasons``.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections import Counter
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

    Keys: ``time`` (UTC, ISO 8601); ``cpu_mhz`` and ``gpu_mhz``, objects with the ``highest`` clock
    now, what is ``allowed`` by power mode and cooling, and what the ``hardware`` can do;
    ``temperatures_c`` by zone; ``load`` over 1, 5, 15 minutes; ``throttle_events``, counters since
    boot by name; ``gpu_slowdowns``, a discrete GPU's own reasons.

    Args:
        root: the folder that system files are read under.
    """
    at = Path(root)
    found = gathered(
        time=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"),
        cpu_mhz=lambda: _cpu_mhz(at),
        gpu_mhz=lambda: _devfreq_mhz(at),
        temperatures_c=lambda: _temperatures(at),
        load=lambda: [float(word) for word in text(at / "proc/loadavg").split()[:3]],
        throttle_events=lambda: _throttle_events(at),
        discrete=lambda: _discrete_gpu(at),
    )
    for key, value in found.pop("discrete", {}).items():
        found[key] = {**found.get(key, {}), **value} if isinstance(value, dict) else value
    return found


def throttling(
    before: Mapping[str, Any], during: Sequence[Mapping[str, Any]], after: Mapping[str, Any]
) -> str | None:
    """What readings say of throttling during a profile, in one sentence; None if nothing.

    Clocks are compared between the first and the last third of the readings, the highest of each,
    since a clock that was read in a pause is low for another reason. 10 % is a fall.

    Args:
        before: what ``readings`` returned before the profile.
        during: what it returned in the course of it.
        after: what it returned at the end.
    """
    signs = []
    everything = [before, *during, after]
    counters = [r["throttle_events"] for r in everything if "throttle_events" in r]
    for name in counters[0] if counters else ():
        if (rise := counters[-1].get(name, 0) - counters[0][name]) > 0:
            signs.append(f"{name} rose by {rise}")
    for reason, count in Counter(s for r in during for s in r.get("gpu_slowdowns", ())).items():
        signs.append(f"the GPU reported {reason} in {count} of {len(during)} readings")
    for unit in ("CPU", "GPU"):
        for key, readings in (("allowed", everything), ("highest", during)):
            mhz = [r.get(f"{unit.lower()}_mhz", {}).get(key) for r in readings]
            known = [value for value in mhz if value] or [0]
            third = -(-len(known) // 3)
            first, last = max(known[:third]), max(known[-third:])
            if last < 0.9 * first:
                signs.append(f"the {unit}'s {key} clock fell from {first:,.0f} to {last:,.0f} MHz")
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
    """Contents of a system file; "" if it cannot be read."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError):
        return ""
    # a sensor may answer "try again", as those of Jetson units that are off: Python gives None
    return (data or b"").decode(errors="replace").strip("\0 \n\t")


def number(path: Path) -> int | None:
    """The whole number that a system file holds."""
    found = re.match(r"-?\d{1,18}\Z", text(path))
    return int(found[0]) if found else None


def matched(content: str | None, pattern: str) -> str | None:
    """The groups of the pattern, joined by dots, where it is found."""
    match = re.search(pattern, content or "", re.MULTILINE)
    return ".".join(match.groups()) if match else None


def tegra(at: Path) -> str | None:
    """A Jetson's chip, such as ``tegra234``."""
    return matched(text(at / "proc/device-tree/compatible"), r"nvidia,(tegra\d{3})")


def output(*command: str, seconds: float = 10) -> str | None:
    """What a program prints; None if it fails, hangs or is not there."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=True)
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return done.stdout


def nvidia_smi(at: Path, *fields: str) -> list[str]:
    """Fields of the first GPU that this process may use.

    Raises:
        ValueError: if there is none, or it does not know a field.
    """
    gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0]
    program = "nvidia-smi" if at == Path("/") else str(at / "usr/bin/nvidia-smi")
    query = f"--id={gpu}", f"--query-gpu={','.join(fields)}", "--format=csv,noheader,nounits"
    values = (output(program, *query) or "").strip().split(", ")
    if len(values) != len(fields):
        raise ValueError("not what was asked for")
    return values


def _cpu_mhz(at: Path) -> dict[str, float]:
    """Clocks over the groups of cores that change together; Jetsons have one per cluster."""
    policies = list(at.glob(CPU + "/cpufreq/policy*"))
    files = {
        "highest": "scaling_cur_freq",
        "allowed": "scaling_max_freq",
        "hardware": "cpuinfo_max_freq",
    }
    khz = {
        name: [number(policy / file) or 0 for policy in policies] for name, file in files.items()
    }
    return {name: max(values) / 1e3 for name, values in khz.items() if any(values)}


def _devfreq_mhz(at: Path) -> dict[str, float]:
    """Clocks of an integrated GPU: 17000000.ga10b, 17000000.gpu or gpu-gpc-0 on Jetsons."""
    for device in sorted(at.glob("sys/class/devfreq/*")):
        if re.search(r"gpu|\.g[a-z]\d\db", device.name):
            hz = {"highest": number(device / "cur_freq"), "allowed": number(device / "max_freq")}
            return {name: value / 1e6 for name, value in hz.items() if value}
    return {}


def _temperatures(at: Path) -> dict[str, float]:
    """Degrees Celsius by thermal zone, and of CPUs that are none, the highest of each name."""
    places = [(zone / "type", zone / "temp") for zone in at.glob("sys/class/thermal/thermal_zone*")]
    for chip in at.glob("sys/class/hwmon/hwmon*/name"):
        if text(chip) in ("coretemp", "k10temp"):
            places += [(chip, path) for path in chip.parent.glob("temp*_input")]
    hottest: dict[str, float] = {}
    for label, path in places:
        name, milli = re.sub("-therm(al)?", "", text(label)), number(path)
        # units that are off say -256 degrees, and the PMIC of a Jetson 100 whatever it has
        if milli is not None and -50_000 < milli < 150_000 and not name.startswith("PMIC"):
            hottest[name] = max(milli / 1000, hottest.get(name, -50))
    return dict(sorted(hottest.items()))


def _throttle_events(at: Path) -> Counter[str]:
    """Counters of x86 cores and packages, and of a Jetson's low voltage and overcurrent."""
    counters: Counter[str] = Counter()
    for path in (
        *at.glob(CPU + "/cpu*/thermal_throttle/*_throttle_count"),
        *at.glob("sys/class/hwmon/hwmon*/oc[0-9]_event_cnt"),
    ):
        counters[path.name] += number(path) or 0
    return counters


def _discrete_gpu(at: Path) -> Facts:
    if tegra(at):  # its nvidia-smi knows none of these
        return {}
    fields = ("clocks.sm", "clocks.max.sm", "temperature.gpu")
    try:
        values = nvidia_smi(at, *fields, "clocks_event_reasons.active")
    except ValueError:  # drivers before 535
        values = nvidia_smi(at, *fields, "clocks_throttle_reasons.active")
    clock, limit, celsius, mask = values
    return gathered(  # what it does not know is "[N/A]"
        gpu_mhz=lambda: {"highest": float(clock), "hardware": float(limit)},
        temperatures_c=lambda: {"GPU": float(celsius)},
        gpu_slowdowns=lambda: [name for bit, name in _SLOWDOWNS.items() if int(mask, 16) & bit],
    )
