"""SiamRPN++, SiamMask and their kin, from a checkout of pysot (https://github.com/STVIR/pysot).

Nothing of the toolkit is part of this package: the user's own checkout is imported. Forks work that
keep its layout: a configuration in ``core/``, in ``models/`` a ``ModelBuilder`` made without
arguments, in ``tracker/`` a ``tracker_builder.py`` or a tracker made of the model.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from lae_sim.errors import LaeError, listed
from lae_sim.trackers.checkout import (
    commit,
    existing,
    explained,
    import_from,
    replaced,
    stand_ins,
    torch_on,
)
from lae_sim.trackers.protocol import Box, Image, Output, weights_digest

# what forks import for training, drawing and logs
_UNUSED = ("colorama", "matplotlib", "pycocotools", "tensorboardX", "tqdm", "visdom")


class PySot:
    """A tracker of a pysot checkout; the toolkit's configuration is global: one to a process.

    SiamMask's box is the axis-aligned one that the toolkit reports as ``bbox``; its mask and
    polygon are computed, as the toolkit does, and dropped.

    Args:
        checkout: the folder that holds the package ``pysot``.
        config: the ``config.yaml`` of the model.
        snapshot: its weights, ``.pth``; read without running code from the file.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        model, tracker: names of classes, where a fork has several to choose from.

    Raises:
        LaeError: if one of them is missing, or they do not fit each other.
    """

    def __init__(
        self,
        checkout: str,
        config: str,
        snapshot: str,
        device: str = "cpu",
        model: str = "",
        tracker: str = "",
    ) -> None:
        self._torch = torch_on(device)
        self._device = device
        self._checkout = existing(checkout, "the checkout of pysot", folder=True)
        self._config = existing(config, "the configuration of the model")
        self._snapshot = existing(snapshot, "the weights of the model")
        configs = list(self._checkout.glob("*/core/config*.py"))
        if len(configs) != 1:
            raise LaeError(
                f"{self._checkout}: not a checkout of pysot or of a fork: "
                f"looked in it for pysot/core/config.py, found {len(configs)} like it"
            )
        package = configs[0].parent.parent
        # forks call .cuda() whatever cfg.CUDA says; without one that is to change nothing
        kinds = (self._torch.Tensor, self._torch.nn.Module) if device == "cpu" else ()
        self._no_cuda = [(kind, "cuda", _itself) for kind in kinds]
        vars(np).setdefault("float", float)  # gone in NumPy 1.24
        vars(np).setdefault("int", int)
        with explained(f"{self._checkout}"), stand_ins(_UNUSED), replaced(*self._no_cuda):
            self._cfg = self._import(configs[0]).cfg
            try:
                self._cfg.merge_from_file(str(self._config))
            except KeyError as error:
                raise LaeError(f"{self._config}: this checkout has {error.args[0]}") from error
            self._cfg.CUDA = device != "cpu"
            build = self._find("model", model, package, ("models/**/model_builder*.py",))
            network = build()
            network.load_state_dict(self._weights(network), strict=False)
            network.eval().to(device)
            patterns = ("tracker/tracker_builder.py", "tracker/*_tracker.py")
            self._tracker = self._find("tracker", tracker, package, patterns)(network)
        # SiamMask looks for a 4 at a place of the version where 3.x and 4.10 or later have none
        module: Any = sys.modules.get(f"{package.name}.tracker.siammask_tracker")
        if module is not None:
            module.cv2 = SimpleNamespace(**{**vars(module.cv2), "__version__": "4.0.0"})

    def init(self, frame: Image, box: Box) -> None:
        """Start on a new sequence."""
        with replaced(*self._no_cuda):  # of an int box the toolkit makes an int size for good
            self._tracker.init(frame, [float(value) for value in box])

    def track(self, frame: Image) -> Output:
        """Find the target in the next frame."""
        with replaced(*self._no_cuda):
            output = self._tracker.track(frame)
        box = [float(value) for value in output["bbox"]]
        return (box, float(output["best_score"])) if "best_score" in output else box

    def set_search(self, cx: float, cy: float, w: float, h: float) -> None:
        """Search around this centre, at this scale, next."""
        self._tracker.center_pos = np.array([cx, cy], dtype=float)
        self._tracker.size = np.array([w, h], dtype=float)

    def sync(self) -> None:
        """Wait for the GPU."""
        if self._device != "cpu":
            self._torch.cuda.synchronize()

    def describe(self) -> dict[str, Any]:
        """Name (the folder of the configuration), commit of the checkout, settings, weights."""
        kind = type(self._tracker).__name__
        folder = self._config.parent.name
        backbone = getattr(getattr(self._cfg, "BACKBONE", None), "TYPE", None)
        return {
            "name": kind if folder in ("experiments", self._checkout.name) else folder,
            "version": commit(self._checkout),
            "settings": {
                "toolkit": "pysot",
                "tracker": kind,
                "backbone": backbone,
                "device": self._device,
            },
            "weights_digest": weights_digest(self._snapshot),
            "libraries": {"cuda": self._torch.version.cuda},
            **self._search(),
        }

    def _search(self) -> dict[str, Any]:
        """Where it searches, if the configuration says it as the toolkit's own do."""
        track: Any = getattr(self._cfg, "TRACK", None)
        names = ("EXEMPLAR_SIZE", "INSTANCE_SIZE", "WINDOW_INFLUENCE")
        if not all(hasattr(track, name) for name in names):
            return {}
        if getattr(track, "CONTEXT_AMOUNT", 0.5) != 0.5:  # another unit than the exemplar's
            return {}
        exemplar, instance, influence = (getattr(track, name) for name in names)
        search = {
            "half_side": instance / exemplar / 2,
            "window": influence > 0,
            "source": f"crops of {exemplar} and {instance} pixels ({self._config.name})",
        }
        return {"search": search}

    def _import(self, file: Path) -> Any:
        parts = file.relative_to(self._checkout).with_suffix("").parts
        return import_from(self._checkout, ".".join(parts))

    def _find(self, option: str, name: str, package: Path, patterns: Sequence[str]) -> Any:
        """The class or function of that name, or the only one, by the first pattern with any."""
        wanted = r"^(?:class|def) (build_tracker|\w+Tracker|ModelBuilder\w*)\b"
        for pattern in patterns:
            files = (f for f in sorted(package.glob(pattern)) if f.name != "base_tracker.py")
            found = {n: f for f in files for n in re.findall(wanted, f.read_text("utf-8"), re.M)}
            if name in found or (len(found) == 1 and not name):
                name = name or next(iter(found))
                return getattr(self._import(found[name]), name)
            if found and (not name or pattern == patterns[-1]):
                raise LaeError(f"{package}: set the option {option} to one of {listed(found)}")
        raise LaeError(f"{package}: no {option} in {' or '.join(patterns)}; is it a fork of pysot?")

    def _weights(self, network: Any) -> dict[str, Any]:
        """The weights of the snapshot, if they are those of the network."""
        with explained(f"{self._snapshot}: not a snapshot"), _numpy_scalars_allowed(self._torch):
            loaded = self._torch.load(str(self._snapshot), map_location="cpu", weights_only=True)
            loaded = loaded.get("state_dict", loaded)
            # DataParallel puts "module." before each name
            weights = {re.sub("^module[.]", "", name): value for name, value in loaded.items()}
            shapes = {name: value.shape for name, value in weights.items()}
        needed = {name: value.shape for name, value in network.state_dict().items()}
        counters = {name for name in needed if name.endswith("num_batches_tracked")}
        faults = {
            "lacks": [name for name in needed if name not in shapes and name not in counters],
            "also has": [name for name in shapes if name not in needed],
            "has in another shape": [n for n in needed if shapes.get(n, needed[n]) != needed[n]],
        }
        described = [f"{fault} {len(n)} (such as {n[0]})" for fault, n in faults.items() if n]
        if described:
            raise LaeError(
                f"{self._snapshot}: not weights of the model of {self._config}: "
                f"of {len(needed)} tensors it {', '.join(described)}"
            )
        return weights


def _itself(value: Any, *args: Any, **kwargs: Any) -> Any:
    return value


def _numpy_scalars_allowed(torch: Any) -> Any:
    """Let snapshots of a training hold NumPy's numbers, such as the epoch, beside the weights."""
    if [int(part) for part in torch.__version__.split(".")[:2]] < [2, 6]:
        return nullcontext()
    scalar = np.float64(0).__reduce__()[0]
    names = [f"numpy.{core}.multiarray.scalar" for core in ("core", "_core")]  # NumPy 1 and 2
    kinds = [type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8")]
    return torch.serialization.safe_globals([(scalar, n) for n in names] + [np.dtype, *kinds])
