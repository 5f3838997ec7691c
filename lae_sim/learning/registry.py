"""Forecasters by the names that command lines use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import is_dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard, cast

from lae_sim.errors import LaeError, hint, shown
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
  learned                 a network trained on made-up motion, guarded (see guarded+NAME)
  learned:FILE            a network that lae-sim train trained
  oracle                  the truth: the ceiling
  camera+NAME             any of these over the camera's motion (needs the frames: --root)
  guarded+NAME            any of these, but held where it has lately done worse than hold
  package.module:factory  your own, perhaps with parameters: mine:Damped:a=0.3,steps=2
"""

BUILT_IN = (
    "hold",
    "constant-velocity",
    "kalman",
    "kalman-lae-pvt",
    "g-h",
    "imm",
    "least-squares",
    "learned",
    "oracle",
)
COMPARED = ("learned", "kalman", "least-squares", "tuned-kalman")  # unless others are named


def load_forecaster(name: str, camera: Camera | None = None) -> AnyFactory:
    """A forecaster by its name, or a user's own as ``package.module:factory``.

    Modules are also looked for in the current folder, and parameters of one's own follow its name:
    ``mine:Damped:a=0.3,steps=2``.

    Args:
        name: as in ``FORECASTERS``.
        camera: the camera's motion, for ``camera+NAME``.

    Raises:
        LaeError: if there is none of that name, it must be trained first, its options do not fit,
            or it cannot be imported.

    Example:
        >>> import lae_sim
        >>> lae_sim.load_forecaster("kalman") is lae_sim.Kalman
        True
        >>> lae_sim.load_forecaster("kalman:q=3,decay=0.99")
        TunedKalman(q=3, r=10.0, p0=100.0, decay=0.99, state='corner')
    """
    found = load_any(name, camera)
    if needs_training(found):
        raise LaeError(
            f"{name} must be trained: lae-sim compare does so on other sequences; lae-sim train "
            "makes a file for learned:FILE; kalman:q=3,decay=0.99 takes numbers as they are"
        )
    return cast("AnyFactory", found)


def files_named(name: str) -> list[str]:
    """The files that a name of a forecaster, a policy, ... leads to: weights, a user's module."""
    kind, colon, value = base_name(name).partition(":")
    if kind == "learned":
        from lae_sim.forecast.learned import SHIPPED

        return [value if colon else str(SHIPPED)]
    return [f"{kind.replace('.', '/')}.py"] if colon else []


def base_name(name: str) -> str:
    """The name of a forecaster without ``camera+`` and ``guarded+``."""
    while name.startswith(("camera+", "guarded+")):
        name = name.partition("+")[2]
    return name


def needs_training(forecaster: AnyFactory | Trainer) -> TypeGuard[Trainer]:
    """Whether it is a :class:`lae_sim.learning.folds.Trainer`, without importing that module."""
    return hasattr(forecaster, "fit")


def load_any(name: str, camera: Camera | None = None) -> AnyFactory | Trainer:
    """The same, or a trainer: ``trained``, ``tuned-kalman``, or a user's own class with ``fit``.

    Raises:
        LaeError: as :func:`load_forecaster`.
    """
    if not isinstance(name, str):
        raise LaeError(f"a forecaster is named by text, such as 'kalman', not {shown(name)}")
    what = f"forecaster {name!r}"
    if name.startswith("camera+"):
        return _over_camera(name, camera)
    if name.startswith("guarded+"):
        return _guarded(name, camera)
    if name in ("trained", "tuned-kalman"):
        from lae_sim.learning.trainers import KalmanTrainer, NetworkTrainer

        return NetworkTrainer() if name == "trained" else KalmanTrainer()
    kind, colon, value = name.partition(":")
    if kind == "learned":
        from lae_sim.forecast.learned import read_learned, shipped

        return read_learned(Path(value)) if colon else shipped()
    if kind in BUILT_IN:
        return _built_in(what, kind, value)
    if not colon:
        names = ", ".join(
            [*BUILT_IN, "kalman:q=...", "learned:FILE", "camera+NAME", "guarded+NAME"]
        )
        known = hint(name, (*BUILT_IN, "tuned-kalman", "trained"))
        raise LaeError(f"no {what}: there are {names}, and package.module:factory{known}")
    made, options = imported(what, name)
    if hasattr(made, "fit"):
        trainer: Trainer = bound(what, made, [], options) if isinstance(made, type) else made
        return trainer
    from lae_sim.forecast.base import own_factory

    return own_factory(what, made, options)


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

    found = find_dataset(
        dataset, None if root == "synthetic" else root, sequences, frame_times="even"
    )  # the trace knows when they came
    return Camera({sequence.name: sequence for sequence in found.sequences}, fps, lag)


def _over_camera(name: str, camera: Camera | None) -> AnyFactory | Trainer:
    if camera is None:
        raise LaeError(f"{name} needs the frames: give the dataset's folder with --root")
    from lae_sim.forecast.camera import CameraCompensated
    from lae_sim.learning.folds import Trainer

    base = load_any(name.removeprefix("camera+"), camera)
    if isinstance(base, Trainer):
        from lae_sim.learning.trainers import WrappedTrainer

        return WrappedTrainer(base, partial(CameraCompensated, camera=camera))
    return CameraCompensated(base, camera)


def _guarded(name: str, camera: Camera | None) -> AnyFactory | Trainer:
    from lae_sim.forecast.guard import guarded
    from lae_sim.learning.folds import Trainer

    base = load_any(name.removeprefix("guarded+"), camera)
    if isinstance(base, Trainer):
        from lae_sim.learning.trainers import WrappedTrainer

        return WrappedTrainer(base, guarded)
    return guarded(base)


def _built_in(what: str, kind: str, value: str) -> AnyFactory:
    """A built-in forecaster with the options of a text, such as ``q=3,decay=0.99``."""
    made = _class_of(kind, tuned=bool(value))
    if is_dataclass(made):
        options = parse_options(dict(map(key_and_value, value.split(",") if value else ())))
        try:
            made = bound(what, made, [], options)
        except TypeError as error:  # a text is no number
            raise LaeError(f"{what}: one of its options must be a number") from error
        if kind == "least-squares":
            from lae_sim.forecast.window import Windowed

            made = Windowed(made)
    elif value:
        raise LaeError(f"{what}: {kind} takes no options")
    factory: AnyFactory = made
    return factory


def _class_of(kind: str, tuned: bool) -> Any:
    """The class of a built-in forecaster; a dataclass is of its options, and makes a factory.

    What a command does not ask for is not imported.
    """
    if kind in ("g-h", "imm"):
        from lae_sim.forecast.filters import GH, IMM

        return GH if kind == "g-h" else IMM
    if kind == "least-squares":
        from lae_sim.forecast.window import LeastSquares

        return LeastSquares
    if kind in ("kalman", "kalman-lae-pvt"):
        from lae_sim.forecast.kalman import Kalman, KalmanLaePvt, TunedKalman

        if kind == "kalman-lae-pvt":
            return KalmanLaePvt
        return TunedKalman if tuned else Kalman
    from lae_sim.forecast.base import ConstantVelocity, Hold, Oracle

    return {"hold": Hold, "constant-velocity": ConstantVelocity, "oracle": Oracle}[kind]
