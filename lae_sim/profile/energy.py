"""From what the sensors say of sequences to what a trace says of a device: energy and clocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lae_sim.profile.live import LiveRun
from lae_sim.profile.sampler import Sampler
from lae_sim.trace.describe import Facts
from lae_sim.trace.energy import Energy

KINDS = {"power": "power_w", "clock": "clocks", "slowdown": "slowdowns"}
"""The key of each kind of sensor in the metadata of a sequence."""


def at_rest(sampler: Sampler, seconds: float) -> Facts:
    """What is known of a device before a tracker is started: its power at rest.

    Returns:
        ``energy`` of the metadata's ``device``, for :func:`of_device` to complete; empty without
        sensors of power.
    """
    total = [sensor.name for sensor in sampler.sensors if sensor.in_total]
    if not total:
        return {}
    idle_w = _by_kind(sampler, sampler.rest(seconds)).get("power_w", {})
    return {"energy": {"total": total, **({"idle_w": idle_w} if idle_w else {})}}


def of_sequence(sampler: Sampler, run: LiveRun) -> Facts:
    """What the sensors say of the calls of a run after its initialisation.

    Returns:
        ``sampled`` of the metadata's ``sequences``: ``calls`` and ``seconds``, ``power_w``,
        ``clocks`` and ``slowdowns`` by name, and of sensors that failed the share of ``unread``
        readings. Empty if none answers.
    """
    means = sampler.means(run.spans_ns)
    if not means:
        return {}
    unread = sampler.unread()
    return {
        "sampled": {
            "calls": len(run.measured_ns) - 1,
            "seconds": float(run.measured_ns[1:].sum()) / 1e9,
            **_by_kind(sampler, means),
            **({"unread": unread} if unread else {}),
        }
    }


def of_device(documents: Sequence[Mapping[str, Any]]) -> Facts:
    """``energy``, ``clocks`` and what else the sensors say of the metadata's ``device``.

    Args:
        documents: the metadata of finished sequences, each with what was known at rest.

    Returns:
        Means over the calls, by the time that they took: ``energy`` (see
        :class:`lae_sim.trace.energy.Energy`), ``clocks``, ``slowdowns``, ``unread``.
    """
    parts = [
        (document["device"].get("energy", {}), entry["sampled"])
        for document in documents
        for entry in document["sequences"].values()
        if "sampled" in entry
    ]
    seconds = [part["seconds"] for _, part in parts]
    names = {name for _, part in parts for name in part.get("unread", {})}

    def mean(values: Iterable[Mapping[str, float]]) -> dict[str, float]:
        return _weighted(zip(values, seconds))

    facts: Facts = {
        "clocks": mean(part.get("clocks", {}) for _, part in parts),
        "slowdowns": mean(part.get("slowdowns", {}) for _, part in parts),
        "unread": mean({n: part.get("unread", {}).get(n, 0.0) for n in names} for _, part in parts),
    }
    facts["slowdowns"] = {name: share for name, share in facts["slowdowns"].items() if share}
    if power_w := mean(part.get("power_w", {}) for _, part in parts):
        facts["energy"] = Energy(
            calls=sum(part["calls"] for _, part in parts),
            seconds=sum(seconds),
            power_w=power_w,
            idle_w=mean(rest.get("idle_w", {}) for rest, _ in parts),
            total=parts[0][0].get("total", []),
        ).entry()
    return {name: section for name, section in facts.items() if section}


def _by_kind(sampler: Sampler, means: Mapping[str, float]) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = {}
    for sensor in sampler.sensors:
        if sensor.name in means:
            found.setdefault(KINDS[sensor.kind], {})[sensor.name] = means[sensor.name]
    return found


def _weighted(parts: Iterable[tuple[Mapping[str, float], float]]) -> dict[str, float]:
    """Means by name, each over the parts that have it."""
    sums: dict[str, tuple[float, float]] = {}
    for values, weight in parts:
        for name, value in values.items():
            total, weights = sums.get(name, (0.0, 0.0))
            sums[name] = total + value * weight, weights + weight
    return {name: round(total / weights, 6) for name, (total, weights) in sums.items() if weights}
