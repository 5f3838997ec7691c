"""Trackers by the names that command lines use."""

from __future__ import annotations

import importlib
from typing import Any, Mapping

from lae_sim.errors import LaeError
from lae_sim.plugins import bound, check_methods, imported
from lae_sim.trackers.protocol import Tracker

NAMES = (
    "dcf, nanotrack, opencv:NAME, pysot, pytracking, trax:COMMAND, vot:NAME, package.module:factory"
)

TIMEOUT_S = 30
"""Seconds that a call of a tracker may take where nothing else is said."""

# name -> (module, what makes one); what follows a colon is the first argument
_BUILT_IN = {
    "dcf": ("dcf", "Dcf"),
    "nanotrack": ("nanotrack", "NanoTrack"),
    "opencv": ("opencv", "OpenCv"),
    "pysot": ("pysot", "PySot"),
    "pytracking": ("pytracking", "PyTracking"),
    "trax": ("trax", "trax_program"),
    "vot": ("trax", "vot_tracker"),
}
_TAKE_ARGUMENT = ("opencv", "trax", "vot")


def make_tracker(name: str, options: Mapping[str, Any]) -> Tracker:
    """Make a tracker by its name, or a user's own as ``package.module:factory``.

    Args:
        name: such as ``"dcf"`` or ``"opencv:mil"``. Modules are also looked for in the current
            folder, and options may follow: ``"mine:Bright:reach=40"``.
        options: keyword arguments of the factory.

    Raises:
        LaeError: if there is none of that name, it cannot be imported, it does not take the
            options, or its methods do not take what they are given.
    """
    kind, colon, value = name.partition(":")
    if kind in _BUILT_IN and bool(value) == (kind in _TAKE_ARGUMENT):
        module, attribute = _BUILT_IN[kind]
        factory = getattr(importlib.import_module("lae_sim.trackers." + module), attribute)
        positional = [value] if value else []
    elif colon and kind not in _BUILT_IN:
        factory, own = imported(f"tracker {name!r}", name)
        positional, options = [], {**own, **options}
    else:
        raise LaeError(f"no tracker {name!r}: there are {NAMES}")
    tracker: Tracker = bound(f"tracker {name!r}", factory, positional, options)
    check_methods(f"tracker {name!r}", tracker, {"init": ("frame", "box"), "track": ("frame",)})
    return tracker


def usual_timeout(name: str, options: Mapping[str, Any]) -> float:
    """Seconds that a call may take: of a tracker of a VOT registry, what that says.

    Args:
        name, options: as of `make_tracker`.

    Raises:
        LaeError: if there is no such registry, or no such tracker in it.
    """
    kind, _, value = name.partition(":")
    if kind != "vot" or not value:
        return TIMEOUT_S
    from lae_sim.trackers.trax import INI, find_entry

    return find_entry(value, options.get("ini", INI)).timeout or TIMEOUT_S
