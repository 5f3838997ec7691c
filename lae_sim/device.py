"""What a profile was taken on: the device and the source, from system files.

Formats: device tree, DMI, control groups 1 and 2, cpufreq of the Linux kernel; ``nv_tegra_release``
and ``nvpmodel`` of Jetson Linux (Developer Guide, "Platform Power and Performance").
"""

from __future__ import annotations

import json
import os
import platform
import re
from pathlib import Path, PurePosixPath

from lae_sim.sensors import (
    CPU,
    Facts,
    gathered,
    matched,
    memory_bytes,
    nvidia_smi,
    output,
    tegra,
    text,
)
from lae_sim.sensors import readings as readings
from lae_sim.sensors import throttling as throttling

# implementer and part of MIDR_EL1: arch/arm64/include/asm/cputype.h of Linux
_ARM_PARTS = {
    "0x41-0xd08": "Cortex-A72",
    "0x41-0xd0b": "Cortex-A76",
    "0x41-0xd42": "Cortex-A78AE",
    "0x41-0xd83": "Neoverse-V3AE",
    "0x4e-0x004": "Carmel",
}
_TEGRA_GPUS = {
    "tegra194": "GV11B (Volta)",
    "tegra234": "GA10B (Ampere)",
    "tegra264": "GB10B (Blackwell)",
}


def describe_device(root: str | os.PathLike[str] = "/") -> Facts:
    """What stays the same during a profile, as JSON values; what is unknown is left out.

    Args:
        root: the folder that system files are read under. What no file says (the affinity of this
            process, the interpreter) is always that of the running system.
    """
    at = Path(root)
    release = r"^# R(\d+) \(release\), REVISION: ([\d.]+)"
    return gathered(
        model=lambda: _model(at),
        cpu=lambda: _cpu(at),
        memory_bytes=lambda: memory_bytes(at, "MemTotal"),
        gpu=lambda: _gpu(at),
        power_mode=lambda: _power_mode(at),
        os=lambda: _os(at),
        jetpack=lambda: _jetpack(at),
        l4t=lambda: matched(text(at / "etc/nv_tegra_release"), release),
        cuda=lambda: json.loads(text(at / "usr/local/cuda/version.json"))["cuda"]["version"],
        cudnn=lambda: _cudnn(at),
        python=lambda: f"{platform.python_implementation()} {platform.python_version()}",
        virtual=lambda: _virtual(at),
    )


def source_version() -> Facts:
    """``version`` of lae_sim and, in a git checkout, its ``commit`` and whether ``modified``."""
    from lae_sim import __version__

    found: Facts = {"version": __version__}
    checkout = Path(__file__).resolve().parents[1]
    if (checkout / ".git").exists():  # a wheel may lie inside a checkout of something else
        git = ["git", "--no-optional-locks", "-C", str(checkout)]
        commit = output([*git, "rev-parse", "HEAD"])
        changes = output([*git, "status", "--porcelain", "--", "lae_sim"])
        if commit and changes is not None:
            found.update(commit=commit.strip(), modified=bool(changes))
    return found


def _model(at: Path) -> str:
    dmi = at / "sys/class/dmi/id"
    vendor, name = text(dmi / "sys_vendor"), text(dmi / "product_name")
    if vendor == "LENOVO":  # whose product names are order codes
        name = text(dmi / "product_version")
    if re.match(r"(.*O\.E\.M\.|default string|system |none|\Z)", name, re.IGNORECASE):  # a filler
        vendor, name = text(dmi / "board_vendor"), text(dmi / "board_name")
    dmi_name = name if name.startswith(vendor) else f"{vendor} {name}"
    system = f"{platform.system()} {platform.machine()}"
    return text(at / "proc/device-tree/model") or dmi_name.strip() or system


def _cpu(at: Path) -> Facts:
    info = text(at / "proc/cpuinfo")
    pairs = re.findall(r"^CPU implementer\s*: (\w+)(?:\n.+)*?\nCPU part\s*: (\w+)", info, re.M)
    arm = sorted({_ARM_PARTS.get("-".join(pair), "ARM " + "-".join(pair)) for pair in pairs})
    return gathered(
        name=lambda: " + ".join(arm) or matched(info, r"^model name\s*: (.+)"),
        architecture=platform.machine,
        cores=lambda: len(list(at.glob(CPU + "/cpu[0-9]*"))) or os.cpu_count(),
        affinity=lambda: len(os.sched_getaffinity(0)),
        quota=lambda: _quota(at),
    )


def _quota(at: Path) -> float | None:
    """Cores' worth of CPU time that control groups (2 and 1) allow; None if there is no limit."""
    lines = text(at / "proc/self/cgroup").splitlines()
    own = [PurePosixPath(line.split(":", 2)[-1].strip("/")) for line in lines]
    quotas = []
    for group in {PurePosixPath("."), *own, *(above for path in own for above in path.parents)}:
        old = at / "sys/fs/cgroup/cpu" / group
        for limit in (
            text(at / "sys/fs/cgroup" / group / "cpu.max"),
            f"{text(old / 'cpu.cfs_quota_us')} {text(old / 'cpu.cfs_period_us')}",
        ):
            if match := re.match(r"(\d+) ([1-9]\d*)\Z", limit):
                quotas.append(int(match[1]) / int(match[2]))
    return min(quotas, default=None)


def _gpu(at: Path) -> Facts:
    if chip := tegra(at):
        return {"name": _TEGRA_GPUS.get(chip, "integrated"), "chip": chip, "memory": "shared"}
    name, driver, memory = nvidia_smi(at, "name", "driver_version", "memory.total")
    return gathered(
        name=lambda: name, driver=lambda: driver, memory_bytes=lambda: int(memory) * 2**20
    )


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
    if any(governors):
        modes.append("governor " + " + ".join(sorted(governors - {""})))
    return ", ".join(modes)


def _os(at: Path) -> str:
    pretty = matched(text(at / "etc/os-release"), r"^PRETTY_NAME=\"?([^\"\n]+)")
    kernel = f"{platform.system()} {platform.release()}"
    return f"{pretty}, {kernel}" if pretty else platform.platform()


def _jetpack(at: Path) -> str | None:
    if not tegra(at):
        return None
    installed = r"^Package: nvidia-jetpack\n(?:.+\n)*?Version: (\S+)"
    return matched(text(at / "var/lib/dpkg/status"), installed)


def _cudnn(at: Path) -> str | None:
    for folder in ("usr/include", "usr/include/*-linux-gnu", "usr/local/cuda/include"):
        for header in at.glob(folder + "/cudnn_version*.h"):
            names = ("MAJOR", "MINOR", "PATCHLEVEL")
            found = [matched(text(header), rf"^#define CUDNN_{n}\s+(\d+)") for n in names]
            if all(found):
                return ".".join(map(str, found))
    return None


def _virtual(at: Path) -> str:
    container = (at / ".dockerenv").exists() or (at / "run/.containerenv").exists()
    machine = matched(text(at / "proc/cpuinfo"), r"^flags\s*:.*\b(hypervisor)\b")
    return " in ".join(["container"] * container + ["virtual machine"] * bool(machine))
