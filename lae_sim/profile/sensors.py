"""What a device can be asked about its power and clocks, many times a second.

Formats: ``ina3221`` of the Linux kernel's hwmon documentation (millivolts, milliamperes), with the
rails of Jetson Linux (Developer Guide, "Platform Power and Performance"); the power capping
framework (RAPL, microjoules that start at zero again); NVML, the library behind ``nvidia-smi``.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from lae_sim.profile.device import CPU, GPU_SLOWDOWNS, devfreq_mhz, number, text

Read = Callable[[], "float | None"]
"""Reads a sensor; None where it does not answer."""

WHOLE_BOARD = ("VDD_IN", "POM_5V_IN", "5V_IN", "VIN")
"""Rails that feed all of a Jetson module, the other rails too."""

FED_BY_ANOTHER = ("VDDQ_VDD2_1V8AO",)
"""Rails behind another measured one: of an AGX Orin, behind VIN_SYS_5V0."""


@dataclass(frozen=True)
class Sensor:
    """One quantity of the device.

    Attributes:
        name: of the rail (``"VDD_IN"``, ``"package-0"``, ``"GPU"``), clock or reason to slow down.
        kind: ``"power"`` in W, also that of counters of energy; ``"clock"`` in MHz; ``"slowdown"``,
            1 while the GPU gives this reason and else 0.
        read: reads it now.
        counts: whether what is read is the energy so far, J.
        wraps_at: the energy at which such a counter starts at zero again, J.
        in_total: whether the power is a part of the device's, and in no other such part.
    """

    name: str
    kind: str
    read: Read
    counts: bool = False
    wraps_at: float = float("inf")
    in_total: bool = False


def find_sensors(root: str | os.PathLike[str] = "/", nvml: Any = None) -> tuple[Sensor, ...]:
    """The sensors that answer now, with names of their own.

    Args:
        root: the folder that system files are read under.
        nvml: the library ``libnvidia-ml``; None to load it, if the root is that of this system.
    """
    at = Path(root)
    if nvml is None and at == Path("/"):
        nvml = _library()
    policies = tuple(at.glob(CPU + "/cpufreq/policy*/scaling_cur_freq"))
    candidates = [
        *_with_total(_hwmon(at)),
        *_rapl(at),
        *([] if nvml is None else _nvml(nvml)),
        Sensor("cpu_mhz", "clock", partial(_cpu_mhz, policies)),
        Sensor("gpu_mhz", "clock", lambda: devfreq_mhz(at).get("highest")),
    ]
    found: dict[str, Sensor] = {}
    for sensor in candidates:
        if sensor.name not in found and attempt(sensor.read) is not None:
            found[sensor.name] = sensor
    return tuple(found.values())


def attempt(read: Read) -> float | None:
    """What a sensor says; None if it fails in whatever way."""
    try:
        return read()
    except Exception:  # no oddity of a sensor may end a profile of an hour
        return None


def _hwmon(at: Path) -> list[Sensor]:
    """The rails of power monitors by Texas Instruments, which Jetsons have on their modules."""
    rails = []
    for chip in sorted(at.glob("sys/class/hwmon/hwmon*/name")):
        kind, folder = text(chip), chip.parent
        if not kind.startswith("ina"):
            continue
        for volts in sorted(folder.glob("in[0-9]*_input")):
            amperes = folder / volts.name.replace("in", "curr", 1)
            label = text(folder / volts.name.replace("_input", "_label"))
            if label and label != "NC" and amperes.exists():
                rails.append(Sensor(label, "power", partial(_product, volts, amperes)))
        for watts in sorted(folder.glob("power[0-9]*_input")):
            label = text(folder / watts.name.replace("_input", "_label"))
            # that of a Jetson Thor has no label, and feeds the whole module
            name = label or ("VIN" if kind == "ina238" else kind)
            rails.append(Sensor(name, "power", partial(_scaled, watts, 1e6)))
    return rails


def _with_total(rails: Sequence[Sensor]) -> list[Sensor]:
    """The rails, and which of them make up the power of the module."""
    whole = [each.name for each in rails if each.name in WHOLE_BOARD][:1]
    parts = whole or [each.name for each in rails if each.name not in FED_BY_ANOTHER]
    return [replace(each, in_total=each.name in parts) for each in rails]


def _rapl(at: Path) -> list[Sensor]:
    """CPU packages and memory, and the whole platform where it is measured (``psys``)."""
    counters = []
    for zone in sorted(at.glob("sys/class/powercap/intel-rapl:*")):
        name, depth = text(zone / "name"), zone.name.count(":")
        if depth == 2 and name == "dram":  # which no package includes, unlike cores and graphics
            package = zone.parent / zone.name.rpartition(":")[0]
            name = f"{text(package / 'name')} dram"
        elif depth > 1 or not name:
            continue
        wraps_at = (number(zone / "max_energy_range_uj") or 0) / 1e6 or float("inf")
        read = partial(_scaled, zone / "energy_uj", 1e6)
        counters.append(
            Sensor(name, "power", read, counts=True, wraps_at=wraps_at, in_total=name != "psys")
        )
    return counters


def _product(millivolts: Path, milliamperes: Path) -> float | None:
    """Watts."""
    volts, amperes = number(millivolts), number(milliamperes)
    return None if volts is None or amperes is None else volts * amperes / 1e6


def _cpu_mhz(policies: Sequence[Path]) -> float | None:
    """The highest clock of the groups of cores that change together."""
    khz = [value for value in map(number, policies) if value]
    return max(khz) / 1e3 if khz else None


def _scaled(path: Path, unit: float) -> float | None:
    value = number(path)
    return None if value is None else value / unit


_SM = 1  # NVML_CLOCK_SM


def _library() -> Any:
    """The library of the driver, ready to be asked; None if there is none."""
    try:
        library = ctypes.CDLL("libnvidia-ml.so.1")
        return library if library.nvmlInit_v2() == 0 else None
    except (OSError, AttributeError):
        return None


def _nvml(library: Any) -> list[Sensor]:
    """The GPU that this process may use: its energy or power, its clock, why it slows down."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0]
    device = ctypes.c_void_p()
    try:
        if visible.isdigit():
            status = library.nvmlDeviceGetHandleByIndex_v2(int(visible), ctypes.byref(device))
        else:
            status = library.nvmlDeviceGetHandleByUUID(visible.encode(), ctypes.byref(device))
    except AttributeError:
        return []
    if status != 0:
        return []

    def asked(name: str, kind: Any, *arguments: Any) -> float | None:
        answer = kind()
        status = getattr(library, name)(device, *arguments, ctypes.byref(answer))
        return None if status != 0 else float(answer.value)

    def scaled(unit: float, *question: Any) -> float | None:
        value = asked(*question)
        return None if value is None else value / unit

    def slowed(bit: int) -> float | None:
        mask = asked("nvmlDeviceGetCurrentClocksThrottleReasons", ctypes.c_ulonglong)
        return None if mask is None else float(bool(int(mask) & bit))

    joules = partial(scaled, 1e3, "nvmlDeviceGetTotalEnergyConsumption", ctypes.c_ulonglong)
    watts = partial(scaled, 1e3, "nvmlDeviceGetPowerUsage", ctypes.c_uint)
    clock = partial(asked, "nvmlDeviceGetClockInfo", ctypes.c_uint, ctypes.c_int(_SM))
    return [
        Sensor("GPU", "power", joules, counts=True, in_total=True),  # from Volta on
        Sensor("GPU", "power", watts, in_total=True),
        Sensor("gpu_mhz", "clock", clock),
        *(
            Sensor(reason, "slowdown", partial(slowed, bit))
            for bit, reason in GPU_SLOWDOWNS.items()
        ),
    ]
