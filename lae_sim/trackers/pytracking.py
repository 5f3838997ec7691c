"""ATOM, DiMP and their kin, from a checkout of pytracking (https://github.com/visionml/pytracking).

Nothing of the toolkit, which is under the GPL 3, is part of this package: the user's own checkout
is imported at run time. What today's PyTorch lacks of that of its day is given back here.
"""

from __future__ import annotations

import collections.abc
import importlib
import inspect
import sys
import types
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from lae_sim.errors import LaeError
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

# what the toolkit imports for training, data sets, drawing and other trackers
_UNUSED = (
    "gdown", "jpeg4py", "lvis", "matplotlib", "pandas", "PIL", "pycocotools", "scipy", "skimage",
    "spatial_correlation_sampler", "tensorboardX", "tikzplotlib", "timm", "torchvision", "tqdm",
    "visdom", "yaml",
)  # fmt: skip
_POOLING = "ltr.external.PreciseRoIPooling.pytorch.prroi_pool"
_NETWORKS = {"atom": "ATOMnet", "dimp": "DiMPnet"}  # tracker -> class of its network


def precise_roi_pooling(features: Any, rois: Any, size: tuple[int, int], scale: float) -> Any:
    """Average the bilinear interpolation of features exactly over each bin of regions.

    The integral of Eq. (4) of Jiang et al., "Acquisition of Localization Confidence for Accurate
    Object Detection", ECCV 2018. The interpolation is a sum of hat functions, one per sample and
    axis, so that it is separable, and each axis has a closed form. It can be differentiated with
    respect to the features and to the regions.

    Args:
        features: tensor [images, channels, H, W]; zero outside.
        rois: tensor [N, 5]: index of the image, then x1, y1, x2, y2.
        size: bins in y and in x.
        scale: samples of the features per unit of the regions.

    Returns:
        Tensor [N, channels, bins in y, bins in x]; zero where a region has no area.
    """
    across, wide = _hat_integrals(rois[:, 1] * scale, rois[:, 3] * scale, size[1], features, 3)
    down, high = _hat_integrals(rois[:, 2] * scale, rois[:, 4] * scale, size[0], features, 2)
    images, channels, height, width = features.shape
    # one matrix product for all regions and channels where they are of one image
    planes = features.transpose(1, 2).reshape(images, height, channels * width)
    planes = planes[0] if images == 1 else planes[rois[:, 0].long()]
    rows = (down @ planes).reshape(len(rois), size[0], channels, width)
    sums = (rows @ across[:, None].transpose(-1, -2)).transpose(1, 2)
    area = (wide * high)[:, None, None, None]
    return sums / area.where(area > 0, area.new_ones(()))  # without area the sums are 0 as well


def _hat_integrals(start: Any, end: Any, bins: int, features: Any, axis: int) -> tuple[Any, Any]:
    """Integrals of the hat function of each sample over each bin, [N, bins, samples]; bin sizes."""
    width = (end - start).clamp(min=0) / bins
    edges = start[:, None] + width[:, None] * start.new_tensor(range(bins + 1))
    centres = start.new_tensor(range(features.shape[axis]))
    t = (edges[:, :, None] - centres).clamp(-1, 1)
    rising = 0.5 + t * (1 - t.abs() / 2)  # of max(0, 1 - |s|) from -1 to t
    return rising[:, 1:] - rising[:, :-1], width


class PyTracking:
    """A tracker of a pytracking checkout: ATOM, DiMP, PrDiMP, and others that use their layout.

    Frames are turned into RGB first, which is part of the time. The score is the maximum of the
    target classifier's. Where the toolkit itself says "not found" the box is the last one.

    Args:
        checkout: the folder that holds the packages ``pytracking`` and ``ltr``.
        tracker: a folder of ``pytracking/tracker``, such as ``atom`` or ``dimp``.
        parameter: a file of ``pytracking/parameter/<tracker>``, such as ``default`` or ``dimp18``.
        network: the network, ``.pth`` or ``.pth.tar``.
        trust_checkpoint: networks of this toolkit are pickles, which can run any code when they
            are read: true says that the file is from someone you trust.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        seed: of PyTorch's random numbers, set at each ``init``.
        pooling: ``torch`` for precise RoI pooling in PyTorch, ``extension`` for the CUDA extension
            that the checkout has as a submodule.

    Raises:
        LaeError: if one of them is missing, or they do not fit each other.
    """

    def __init__(
        self,
        checkout: str,
        tracker: str,
        parameter: str,
        network: str,
        trust_checkpoint: bool = False,
        device: str = "cpu",
        seed: int = 0,
        pooling: str = "torch",
    ) -> None:
        self._torch = torch_on(device)
        self._checkout = existing(checkout, "the checkout of pytracking", folder=True)
        self._network = existing(network, "the network of the tracker")
        if pooling not in ("torch", "extension"):
            raise LaeError(f"pooling {pooling!r}: it is torch or extension")
        self._settings = {
            "toolkit": "pytracking",
            "tracker": tracker,
            "parameter": parameter,
            "device": device,
            "seed": seed,
            "pooling": pooling,
        }
        for folder, name in (("tracker", tracker), ("parameter", f"{tracker}/{parameter}.py")):
            if not (self._checkout / "pytracking" / folder / name).exists():
                raise LaeError(
                    f"{self._checkout}: no such {folder}: looked in it for "
                    f"pytracking/{folder}/{name}"
                )
        if trust_checkpoint is not True:
            raise LaeError(
                f"{self._network}: a network of pytracking can run any code when it is read; "
                "if you trust where it is from, say so with --trust-checkpoint"
            )
        with stand_ins(_UNUSED) as absent:
            with explained(str(self._checkout)):
                self._cv2 = importlib.import_module("cv2")
                self._mend(absent)
                module = import_from(self._checkout, f"pytracking.tracker.{tracker}")
                self._class = module.get_tracker_class()
                self._params = self._parameters(tracker, parameter)
            with explained(f"{self._network}: not a network of {tracker}/{parameter}"):
                self._load(tracker)

    def init(self, frame: Image, box: Box) -> None:
        """Start on a new sequence."""
        self._torch.manual_seed(self._settings["seed"])
        self._tracker = self._class(self._params)
        self._tracker.features_initialized = True  # they are the parameters', and loaded
        self._tracker.initialize(self._rgb(frame), {"init_bbox": [float(v) for v in box]})

    def track(self, frame: Image) -> Output:
        """Find the target in the next frame."""
        output = self._tracker.track(self._rgb(frame))
        box = [float(value) for value in output["target_bbox"]]
        if box == [-1, -1, -1, -1]:
            return None
        score = output.get("object_presence_score", self._tracker.debug_info.get("max_score"))
        return box if score is None else (box, float(score))

    def set_search(self, cx: float, cy: float, w: float, h: float) -> None:
        """Search around this centre, at this scale, next."""
        tensor = self._torch.tensor
        inner = self._tracker
        inner.pos = tensor([cy - 0.5, cx - 0.5])  # of a box the toolkit takes x + (w - 1) / 2
        inner.target_sz = tensor([float(h), float(w)])
        inner.target_scale = (inner.target_sz.prod() / inner.base_target_sz.prod()).sqrt()
        inner.pos_iounet = inner.pos.clone()

    def sync(self) -> None:
        """Wait for the GPU."""
        if self._settings["device"] != "cpu":
            self._torch.cuda.synchronize()

    def describe(self) -> dict[str, Any]:
        """Name, commit of the checkout, settings, the network's digest and constructor."""
        settings = self._settings
        return {
            "name": f"{settings['tracker']}-{settings['parameter']}",
            "version": commit(self._checkout),
            "settings": dict(settings),
            "weights_digest": weights_digest(self._network),
            "libraries": {"cuda": self._torch.version.cuda},
            **self._search(),
        }

    def _search(self) -> dict[str, Any]:
        """Where it searches, if the parameters say it: a square of ``scale sqrt(w h)``."""
        scale = getattr(self._params, "search_area_scale", None)
        if not scale:
            return {}
        search = {
            # over sqrt((w + p)(h + p)), which is 2 sqrt(w h) of a square target
            "half_side": scale / 4,
            "window": bool(getattr(self._params, "window_output", False)),
            "source": f"search_area_scale {scale:g}; less for oblong targets",
        }
        return {"search": search}

    def _rgb(self, frame: Image) -> Any:
        return self._cv2.cvtColor(frame, self._cv2.COLOR_BGR2RGB)

    def _parameters(self, tracker: str, parameter: str) -> Any:
        """The toolkit's parameters, with this network on this device."""
        module = f"pytracking.parameter.{tracker}.{parameter}"
        params = import_from(self._checkout, module).parameters()
        params.debug, params.visualization = 0, False
        self._holders = [params.net] if params.has("net") else params.features.features
        for holder in [params, *self._holders]:
            holder.use_gpu = self._settings["device"] != "cpu"
        for holder in self._holders:
            holder.net_path = str(self._network)  # absolute, or it looks for its local.py
        return params

    def _load(self, tracker: str) -> None:
        load = self._torch.load
        if "weights_only" in inspect.signature(load).parameters:  # PyTorch 1.13 or newer
            load = partial(load, weights_only=False)
        with replaced((self._torch, "load", load)):
            self._tracker = self._class(self._params)
            self._tracker.initialize_features()
        network = self._holders[0].net
        kind = type(network).__name__
        if kind != _NETWORKS.get(tracker, kind):
            raise LaeError(
                f"{self._network}: {tracker} takes a {_NETWORKS[tracker]}, this is a {kind}"
            )
        self._settings["network"] = network.constructor.fun_name  # such as dimpnet18

    def _mend(self, absent: Sequence[str]) -> None:
        """Give the toolkit back what PyTorch, torchvision or a bare checkout lack."""
        torch = self._torch
        vars(torch).setdefault("rfft", partial(_rfft, torch))  # gone in PyTorch 1.8
        vars(torch).setdefault("irfft", partial(_irfft, torch))
        if not hasattr(torch, "_six"):  # gone in PyTorch 2.0
            classes = {"string_classes": (str, bytes), "int_classes": int}
            _module("torch._six", container_abcs=collections.abc, **classes)
        if self._settings["pooling"] == "torch":
            _module(_POOLING, PrRoIPool2D=_pooling_class(torch))
        if not (self._checkout / "ltr" / "admin" / "local.py").exists():
            _module("ltr.admin.local")  # paths for training; it is imported with each network
        resnet: Any = importlib.import_module("torchvision.models.resnet")
        if not hasattr(resnet, "model_urls"):  # gone in torchvision 0.13
            resnet.model_urls = {}
        if "torchvision" in absent:
            vars(resnet)["__getattr__"] = _block
        lists = import_from(self._checkout, "pytracking.libs.tensorlist").TensorList
        lists.__getattr__ = _without_dunders(lists.__getattr__)


def _module(name: str, **attributes: Any) -> None:
    sys.modules[name] = made = types.ModuleType(name)
    vars(made).update(attributes)


def _block(name: str) -> Any:
    """The toolkit's own blocks of ResNet are torchvision's under the same names."""
    if name not in ("BasicBlock", "Bottleneck"):
        raise AttributeError(name)
    return getattr(importlib.import_module("ltr.models.backbone.resnet"), name)


def _without_dunders(lookup: Callable[[Any, str], Any]) -> Callable[[Any, str], Any]:
    # a list that has every attribute of a tensor is taken for one by PyTorch's __torch_function__
    def guarded(self: Any, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lookup(self, name)

    return guarded


def _rfft(torch: Any, values: Any, signal_ndim: int) -> Any:
    """The one-sided FFT of the last axes as PyTorch had it: real and imaginary part, last."""
    axes = tuple(range(-signal_ndim, 0))
    return torch.view_as_real(torch.fft.rfftn(values, dim=axes))


def _irfft(torch: Any, values: Any, signal_ndim: int, signal_sizes: Any = None) -> Any:
    """The inverse of ``_rfft``, to the sizes given."""
    axes = tuple(range(-signal_ndim, 0))
    values = torch.view_as_complex(values.contiguous())
    return torch.fft.irfftn(values, s=signal_sizes, dim=axes)


def _pooling_class(torch: Any) -> Any:
    def make(self: Any, height: int, width: int, scale: float) -> None:
        torch.nn.Module.__init__(self)
        self.size, self.scale = (height, width), scale

    def forward(self: Any, features: Any, rois: Any) -> Any:
        return precise_roi_pooling(features, rois, self.size, self.scale)

    return type("PrRoIPool2D", (torch.nn.Module,), {"__init__": make, "forward": forward})
