"""What a profile was taken on: the device and the source, from system files.

Formats: device tree, DMI and cpufreq of the Linux kernel; ``nv_tegra_release`` and ``nvpmodel`` of
Jetson Linux (Developer Guide, "Platform Power and Performance").
"""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path

from lae_sim import __version__
from lae_sim.sensors import (
    CPU,
    Facts,
    gathered,
    matched,
    nvidia_smi,
    output,
    tegra,
    text,
)
from lae_sim.sensors import readings as readings


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
    found: Facts = {"version": __version__}
    checkout = Path(__file__).resolve().parents[1]
    if (checkout / ".git").exists():  # a wheel may lie inside a checkout of something else
        git = "git", "--no-optional-locks", "-C", str(checkout)
        commit = output(*git, "rev-parse", "HEAD")
        changes = output(*git, "status", "--porcelain", "--", "lae_sim")
        if commit and changes is not None:
            found.update(commit=commit.strip(), modified=bool(changes))
    return found


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
    found = gathered(memory_bytes=lambda: int(mebibytes) * 2**20)
    return {"name": name, "driver": driver, **found}


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
