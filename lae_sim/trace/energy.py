"""What a trace says of the power of its device while the tracker ran, and of the energy of a call.

The energy of a call is the mean power during calls times what a call takes, as the trace has it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Energy:
    """The power of a device during the calls of a tracker, but for initialisations.

    Attributes:
        calls: how many were measured.
        seconds: what they took together, s.
        power_w: mean power during the calls, by rail, W.
        idle_w: mean power before the tracker was started, by rail, W; empty if not measured.
        total: the rails that make up the power of the device, as far as it is measured.
    """

    calls: int
    seconds: float
    power_w: Mapping[str, float]
    idle_w: Mapping[str, float]
    total: Sequence[str]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Energy | None:
        """What the metadata of a trace says; None if nothing, or nothing that can be used.

        Args:
            document: the whole JSON object, or as much of it as there is.
        """
        try:
            said = document["device"]["energy"]
            energy = cls(
                calls=int(said["calls"]),
                seconds=float(said["seconds"]),
                power_w=_numbers(said["power_w"]),
                idle_w=_numbers(said.get("idle_w", {})),
                total=[str(name) for name in said["total"]],
            )
        except (
            KeyError,
            TypeError,
            ValueError,
            AttributeError,
            OverflowError,
        ):  # another program wrote it
            return None
        return energy if energy.calls > 0 and energy.power_w else None

    @property
    def watts(self) -> float | None:
        """Mean power of the device during calls, W."""
        return _sum(self.power_w, self.total)

    @property
    def idle_watts(self) -> float | None:
        """Mean power of the device before the tracker was started, W."""
        return _sum(self.idle_w, self.total)

    @property
    def joules_per_frame(self) -> float | None:
        """Energy of the device during a call, J."""
        return None if self.watts is None else self.watts * self.seconds / self.calls

    @property
    def joules_above_idle(self) -> float | None:
        """The part of it that the device would not have taken without the tracker, J."""
        if self.watts is None or self.idle_watts is None:
            return None
        return (self.watts - self.idle_watts) * self.seconds / self.calls

    def entry(self) -> dict[str, Any]:
        """What the metadata says of it."""
        joules = {
            "joules_per_frame": self.joules_per_frame,
            "joules_per_frame_above_idle": self.joules_above_idle,
        }
        return {
            "calls": self.calls,
            "seconds": self.seconds,
            "power_w": dict(self.power_w),
            **({"idle_w": dict(self.idle_w)} if self.idle_w else {}),
            "total": list(self.total),
            **{name: value for name, value in joules.items() if value is not None},
        }


def _numbers(by_name: Mapping[str, Any]) -> dict[str, float]:
    return {str(name): float(value) for name, value in by_name.items()}


def _sum(watts: Mapping[str, float], rails: Sequence[str]) -> float | None:
    """The power of some rails together; None if one is not known."""
    known = [watts[rail] for rail in rails if rail in watts]
    return sum(known) if known and len(known) == len(rails) else None
