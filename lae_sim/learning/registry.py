"""Forecasters by the names that command lines use."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.errors import LaeError
from lae_sim.plugins import bound, imported, key_and_value, parse_options

if TYPE_CHECKING:
    from lae_sim.forecast.base import AnyFactory
    from lae_sim.forecast.camera import Camera
    from lae_sim.learning.folds import Trainer

FORECASTERS = """\
forecasters:
  hold                    the latest box: the baseline
  constant-velocity       the last two boxes
  kalman                  the paper's filter
  kalman-lae-pvt          as its code was released: restarts, clipping
  kalman:q=3,decay=0.99   its family: q, r, p0, decay, state=corner|centre
  g-h[:g=0.95,h=0.8]      the g-h filter
  imm[:quiet=1,...]       two Kalman filters, quiet and agile: also agile, r, p0, stay
  least-squares[:n=8,...] a line through the last boxes: also forgetting, huber
  learned:FILE.pt         a network that lae-sim train trained (extra torch)
  oracle                  the truth: the ceiling
  camera+NAME             any of these over the camera's motion (needs the frames: --root)
  package.module:factory  your own
"""

# name -> (module, attribute, whether it takes options)
_BUILT_IN = {
    "hold": ("forecast.base", "Hold", False),
    "constant-velocity": ("forecast.base", "ConstantVelocity", False),
    "kalman": ("forecast.kalman", "Kalman", False),
    "kalman-lae-pvt": ("forecast.kalman", "KalmanLaePvt", False),
    "g-h": ("forecast.filters", "GH", True),
    "imm": ("forecast.filters", "IMM", True),
    "least-squares": ("forecast.window", "LeastSquares", True),
    "oracle": ("forecast.base", "Oracle", False),
}
_TRAINED = {"learned": "NetworkTrainer", "tuned-kalman": "KalmanTrainer"}


def load_forecaster(name: str, camera: Camera | None = None) -> AnyFactory:
    """A forecaster by its name, or a user's own as ``package.module:factory``.

    Modules are also looked for in the current folder.

    Args:
        name: as in ``FORECASTERS``.
        camera: the camera's motion, for ``camera+NAME``.

    Raises:
        LaeError: if there is none of that name, it must be trained first, its options do not fit,
            or it cannot be imported.
    """
    from lae_sim.learning.folds import Trainer

    found = load_any(name, camera)
    if isinstance(found, Trainer):
        raise LaeError(
            f"{name} must be trained: lae-sim compare does so on other sequences; lae-sim train "
            "makes a file for learned:FILE.pt; kalman:q=3,decay=0.99 takes numbers as they are"
        )
    return found


def load_any(name: str, camera: Camera | None = None) -> AnyFactory | Trainer:
    """The same, or a trainer: ``learned``, ``tuned-kalman``, or a user's own class with ``fit``.

    Raises:
        LaeError: as :func:`load_forecaster`.
    """
    if name.startswith("camera+"):
        if camera is None:
            raise LaeError(f"{name} needs the frames: give the dataset's folder with --root")
        from lae_sim.learning.folds import Trainer

        base = load_any(name.removeprefix("camera+"), camera)
        if isinstance(base, Trainer):
            return _attribute("learning.trainers", "CameraTrainer")(base, camera)  # type: ignore[no-any-return]
        return _attribute("forecast.camera", "CameraCompensated")(base, camera)  # type: ignore[no-any-return]
    if name in _TRAINED:
        return _attribute("learning.trainers", _TRAINED[name])()  # type: ignore[no-any-return]
    kind, colon, value = name.partition(":")
    if kind == "learned":
        from lae_sim.forecast.learned import read_learned

        return read_learned(Path(value))
    if kind in _BUILT_IN:
        return _built_in(name, kind, value)
    if not colon:
        names = ", ".join([*_BUILT_IN, "kalman:q=...", "learned:FILE.pt", "camera+NAME"])
        raise LaeError(f"no forecaster {name!r}: there are {names}, and package.module:factory")
    found = imported(f"forecaster {name!r}", name)
    if isinstance(found, type) and hasattr(found, "fit"):
        found = bound(f"forecaster {name!r}", found, [], {})
    return found  # type: ignore[no-any-return]


def find_camera(
    root: str | None,
    dataset: str | None,
    sequences: Sequence[str] | None,
    fps: Fraction,
    lag: int | None = None,
) -> Camera | None:
    """The camera's motion, for ``camera+NAME``; None without a folder of frames.

    Args:
        root: the dataset's folder, or ``synthetic``.
        dataset: what it is called, if its folder does not say.
        sequences: those wanted; all by default.
        fps: the world's frame rate.
        lag: by how many frames the motion is late; by what estimating it takes if None.

    Raises:
        LaeError: as :func:`lae_sim.datasets.layouts.find_dataset`.
    """
    if root is None:
        return None
    from lae_sim.datasets.layouts import find_dataset
    from lae_sim.forecast.camera import Camera

    found = find_dataset(dataset, None if root == "synthetic" else root, sequences)
    return Camera({sequence.name: sequence for sequence in found.sequences}, fps, lag)


def _built_in(name: str, kind: str, value: str) -> AnyFactory:
    module, attribute, takes_options = _BUILT_IN[kind]
    if kind == "kalman" and value:
        attribute, takes_options = "TunedKalman", True
    found = _attribute(module, attribute)
    if not takes_options:
        if value:
            raise LaeError(f"forecaster {name!r}: {kind} takes no options")
        return found  # type: ignore[no-any-return]
    options = parse_options(dict(map(key_and_value, value.split(",") if value else ())))
    what = f"forecaster {name!r}"
    try:
        made = bound(what, found, [], options)
    except TypeError as error:  # a text is no number
        raise LaeError(f"{what}: one of its options must be a number") from error
    if kind == "least-squares":
        made = _attribute("forecast.window", "Windowed")(made)
    return made  # type: ignore[no-any-return]


def _attribute(module: str, name: str) -> Any:
    return getattr(importlib.import_module(f"lae_sim.{module}"), name)
