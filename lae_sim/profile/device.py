"""What a profile was taken on: the device and the source, from system files.

Formats: device tree, DMI and cpufreq of the Linux kernel; ``nv_tegra_release`` and ``nvpmodel`` of
Jetson Linux (Developer Guide, "Platform Power and Performance").
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
from collections import Counter
from datetime import datetime, timezone
from pathlib import Path

from lae_sim import __version__
from lae_sim.trace.describe import Facts, gathered


def describe_device(root: str | os.PathLike[str] = "/") -> Facts:
    """What stays the same during a profile, as JSON values; what is unknown is left out.

    Args:
        root: the folder that system files are read under. What no file says (the name of an ARM
            core, the affinity of this process, the interpreter) is that of the running system.
    """
    at = Path(root)
    memory = r"^MemTotal:\s+(\d+) kB"
    release = r"^# R(\d+) \(release\), REVISION: ([\d.]+)"
    return gathered(
        model=lambda: _model(at),
        cpu=lambda: _cpu(at),
        memory_bytes=lambda: 1024 * int(matched(text(at / "proc/meminfo"), memory) or 0) or None,
        gpu=lambda: _gpu(at),
        power_mode=lambda: _power_mode(at),
        os=lambda: _os(at),
        jetpack=lambda: _package(at, "nvidia-jetpack"),
        l4t=lambda: matched(text(at / "etc/nv_tegra_release"), release),
        cuda=lambda: json.loads(text(at / "usr/local/cuda/version.json"))["cuda"]["version"],
        cudnn=lambda: _package(at, r"libcudnn\d+(?:-cuda-\d+)?"),
        python=lambda: f"{platform.python_implementation()} {platform.python_version()}",
    )


def source_version() -> Facts:
    """``version`` of lae_sim and, in a git checkout, its ``commit`` and whether ``modified``."""
    version: Facts = {"version": __version__}
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / ".git").exists():  # a wheel may lie inside a checkout of something else
        git = "git", "--no-optional-locks", "-C", str(checkout)
        commit = output(*git, "rev-parse", "HEAD")
        changes = output(*git, "status", "--porcelain", "--", "lae_sim")
        if commit and changes is not None:
            version.update(commit=commit.strip(), modified=bool(changes))
    return version


def _model(at: Path) -> str:
    dmi = at / "sys/class/dmi/id"
    made = f"{text(dmi / 'sys_vendor')} {text(dmi / 'product_name')}".strip()
    system = f"{platform.system()} {platform.machine()}"
    return text(at / "proc/device-tree/model") or made or system


def _cpu(at: Path) -> Facts:
    info = text(at / "proc/cpuinfo")
    return gathered(
        name=lambda: (
            matched(info, r"^model name\s*: (?!ARM)(.+)")
            or matched(output("lscpu"), r"^Model name: +(.+)")  # which knows the cores of ARM
        ),
        architecture=platform.machine,
        cores=lambda: len(list(at.glob(CPU + "/cpu[0-9]*"))) or os.cpu_count(),
        affinity=lambda: len(os.sched_getaffinity(0)),
    )


def _gpu(at: Path) -> Facts:
    if chip := tegra(at):
        return {"name": f"{chip}, integrated"}
    name, driver, mebibytes = nvidia_smi(at, "name", "driver_version", "memory.total")
    memory = gathered(memory_bytes=lambda: int(mebibytes) * 2**20)
    return {"name": name, "driver": driver, **memory}


def _power_mode(at: Path) -> str:
    """The Jetson's power mode or the platform profile of a PC, and the governors of the CPU."""
    modes = []
    if mode := matched(text(at / "var/lib/nvpmodel/status"), r"pmode:0*(\d+)"):
        named = rf"^< *POWER_MODEL .*\bID=0*{mode} .*\bNAME=[\"']?([^\s\"'>]+)"
        name = matched(text(at / "etc/nvpmodel.conf"), named)
        modes.append(f"{name} (nvpmodel {mode})" if name else f"nvpmodel {mode}")
    if profile := text(at / "sys/firmware/acpi/platform_profile"):
        modes.append(f"profile {profile}")
    governors = {text(path) for path in at.glob(CPU + "/cpufreq/policy*/scaling_governor")}
    modes += [f"governor {governor}" for governor in sorted(governors) if governor]
    return ", ".join(modes)


def _os(at: Path) -> str:
    pretty = matched(text(at / "etc/os-release"), r"^PRETTY_NAME=\"?([^\"\n]+)")
    kernel = f"{platform.system()} {platform.release()}"
    return f"{pretty}, {kernel}" if pretty else platform.platform()


def _package(at: Path, name: str) -> str | None:
    """The version of an installed Debian package."""
    installed = rf"^Package: {name}\n(?:.+\n)*?Version: (\S+)"
    return matched(text(at / "var/lib/dpkg/status"), installed)


_CONTROL = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f]")  # no trace may hold these
CPU = "sys/devices/system/cpu"
GPU_SLOWDOWNS = {
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
    reading = gathered(
        time=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"),
        cpu_mhz=lambda: _cpu_mhz(at),
        gpu_mhz=lambda: devfreq_mhz(at),
        temperatures_c=lambda: _temperatures(at),
        load=lambda: [float(word) for word in text(at / "proc/loadavg").split()[:3]],
        throttle_events=lambda: _throttle_events(at),
        discrete=lambda: _discrete_gpu(at),
    )
    for key, value in reading.pop("discrete", {}).items():
        reading[key] = {**reading.get(key, {}), **value} if isinstance(value, dict) else value
    return reading


def text(path: Path) -> str:
    """Contents of a system file; "" if it cannot be read."""
    try:
        data = path.read_bytes()
    except (OSError, ValueError):
        return ""
    # a sensor may answer "try again", as those of Jetson units that are off: Python gives None
    plain = _CONTROL.sub(" ", (data or b"").decode(errors="replace"))
    return plain.strip()


def number(path: Path) -> int | None:
    """The whole number that a system file holds."""
    digits = re.match(r"-?\d{1,18}\Z", text(path))
    return int(digits[0]) if digits else None


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
        done = subprocess.run(
            command,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=seconds,
            check=True,
        )
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


def devfreq_mhz(at: Path) -> dict[str, float]:
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
        gpu_slowdowns=lambda: [name for bit, name in GPU_SLOWDOWNS.items() if int(mask, 16) & bit],
    )
