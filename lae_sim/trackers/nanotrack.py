"""NanoTrack, driven from its two ONNX files by OpenCV's network module or ONNX Runtime.

NanoTrack (H. Chu, the NanoTrack folder of https://github.com/HonglinChu/SiamTrackers) is a Siamese
tracker: a small backbone, a depth-wise correlation, and a head that for each point of a grid says
how likely the target is there and how far its four sides are. A frame is searched as described in
Li et al., High Performance Visual Tracking with Siamese Region Proposal Network, CVPR 2018, and
Li et al., SiamRPN++, CVPR 2019.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from lae_sim.errors import LaeError, listed
from lae_sim.trackers.onnx import onnx_session
from lae_sim.trackers.protocol import (
    Array,
    Image,
    checked_box,
    checked_frame,
    checked_search,
    weights_digest,
)
from lae_sim.trackers.stages import stage

TEMPLATE, SEARCH, STRIDE = 127, 255, 16  # pixels of the two inputs, and of a step of the output
CONTEXT = 0.5
SMALLEST = 10.0  # pixels, of a side of an answer

# Side of the output: version, and what its authors set: penalty of a change of size or shape,
# influence of the cosine window, rate at which the size follows. (Version 1 looks like 2.)
_VERSIONS = {16: ("v2", 0.150, 0.490, 0.385), 15: ("v3", 0.138, 0.455, 0.348)}

_RUNTIMES = ("opencv", "onnxruntime")
_NO_DEVICE = "nanotrack: the device {!r} is neither 'cpu' nor 'cuda:NUMBER'"
_PROVIDERS = {"": "CPU", "cpu": "CPU", "cuda": "CUDA"}  # of ONNX Runtime, for a kind of device

if TYPE_CHECKING:
    # features of a patch [1, 3, side, side]; and of those of template and patch, classes
    # [1, 2, n, n] and sides [1, 4, n, n]
    Networks = tuple[Callable[[Array], Array], Callable[[Array, Array], Sequence[Array]]]

_UPSTREAM = "they are in NanoTrack/models of https://github.com/HonglinChu/SiamTrackers"


class NanoTrack:
    """NanoTrack version 2 or 3.

    Args:
        weights: folder of the two files ``*backbone*.onnx`` and ``*head*.onnx``.
        backbone, head: the two files themselves, instead.
        device: ``"cpu"``, or ``"cuda:0"`` where OpenCV was built with CUDA, or with a provider of
            a GPU.
        runtime: ``"opencv"`` or ``"onnxruntime"``.
        provider, cpu_nodes, cache: of ONNX Runtime, see `lae_sim.trackers.onnx.onnx_session`.

    Raises:
        LaeError: if a file is missing or not of NanoTrack, or the device cannot be used.
    """

    def __init__(
        self,
        weights: str = "",
        backbone: str = "",
        head: str = "",
        device: str = "",
        runtime: str = "opencv",
        provider: str = "",
        cpu_nodes: bool = False,
        cache: str = "",
    ) -> None:
        if runtime not in _RUNTIMES:
            raise LaeError(f"nanotrack: no runtime {runtime!r}: there are {listed(_RUNTIMES)}")
        if provider and runtime == "opencv":
            raise LaeError("nanotrack: provider is of ONNX Runtime: add runtime=onnxruntime")
        paths = [_find(weights, "backbone", backbone), _find(weights, "head", head)]
        self._settings: dict[str, Any] = {"runtime": runtime}
        wrong = (
            " and ".join(map(str, paths)) + " are not a backbone and a head of NanoTrack v2 or v3"
        )
        try:
            if runtime == "opencv":
                self._settings["device"] = device or "cpu"
                self._backbone, self._head = _opencv(paths, device or "cpu")
            else:
                usual, number = _gpu(device)
                self._settings["provider"] = provider = provider or usual
                self._backbone, self._head = _onnx(
                    paths, provider=provider, device=number, cpu_nodes=cpu_nodes, cache=cache
                )
            self._template = self._features(np.zeros((TEMPLATE, TEMPLATE, 3), np.uint8))
            scores, _ = self._correlate(np.zeros((SEARCH, SEARCH, 3), np.uint8))
            count = scores.shape[-1]
            self._version, self._penalty, self._influence, self._rate = _VERSIONS[count]
        except LaeError:
            raise
        except Exception as error:  # of OpenCV or ONNX Runtime, which has types of its own
            raise LaeError(wrong) from error
        self._digest = weights_digest(*paths)
        window = np.hanning(count)
        self._window = np.outer(window, window)
        self._points = STRIDE * (np.arange(count) - count // 2.0)
        self._started = False

    def init(self, frame: Image, box: Sequence[float]) -> None:
        """Take the target's features from its first frame.

        Raises:
            LaeError: if the frame is no image, or the box no box.
        """
        frame = checked_frame(frame)
        x, y, w, h = checked_box(box)
        self._centre, self._size = np.array([x + w / 2, y + h / 2]), np.array([w, h])
        self._mean = cv2.mean(frame)
        with stage("preprocess"):
            patch = self._crop(frame, round(self._context_side()), TEMPLATE)
        self._template = self._features(patch)
        self._started = True

    def set_search(self, cx: float, cy: float, w: float, h: float) -> None:
        """Search the next frame around this centre for a target of this size.

        Raises:
            LaeError: if a number is not finite.
        """
        self._centre, self._size = checked_search(cx, cy, w, h)

    def track(self, frame: Image) -> tuple[tuple[float, float, float, float], float]:
        """The target's box in the next frame, and its probability as the network sees it.

        Raises:
            LaeError: if the frame is no image, or ``init`` was not called.
        """
        frame = checked_frame(frame)
        if not self._started:
            raise LaeError("nanotrack: init must come before track")
        edge = np.array(frame.shape[1::-1], float)
        with stage("preprocess"):
            self._centre, self._size = np.clip(self._centre, 0, edge), np.minimum(self._size, edge)
            zoom = TEMPLATE / self._context_side()
            patch = self._crop(frame, round(SEARCH / zoom), SEARCH)
        scores, sides = self._correlate(patch)
        with stage("postprocess"):
            left, top, right, bottom = sides.astype(np.float64)
            width, height = np.maximum(left + right, 1e-3), np.maximum(top + bottom, 1e-3)
            # the penalty of SiamRPN on changes of shape and of size
            w, h = self._size * zoom
            shape, size = (width / height) / (w / h), _overall(width, height) / _overall(w, h)
            change = np.maximum(shape, 1 / shape) * np.maximum(size, 1 / size)
            penalty = np.exp(self._penalty * (1 - change))
            wanted = penalty * scores * (1 - self._influence) + self._window * self._influence
            best = np.unravel_index(int(wanted.argmax()), wanted.shape)
            row, column = best
            offset = np.array(
                [
                    self._points[column] + (right[best] - left[best]) / 2,
                    self._points[row] + (bottom[best] - top[best]) / 2,
                ]
            )
            rate = penalty[best] * scores[best] * self._rate
            target_size = np.array([width[best], height[best]]) / zoom
            self._centre = np.clip(self._centre + offset / zoom, 0, edge)
            size = (1 - rate) * self._size + rate * target_size
            self._size = np.clip(size, SMALLEST, np.maximum(edge, SMALLEST))
            (cx, cy), (w, h) = self._centre.tolist(), self._size.tolist()
        return (cx - w / 2, cy - h / 2, w, h), float(scores[best])

    def describe(self) -> dict[str, Any]:
        """Name, version, settings, and the digest of the weights: SHA-256 of the two files."""
        return {
            "name": "nanotrack",
            "version": self._version,
            "settings": {
                **self._settings,
                "penalty_k": self._penalty,
                "window_influence": self._influence,
                "lr": self._rate,
            },
            "weights_digest": self._digest,
            "search": {
                "half_side": SEARCH // TEMPLATE / 2,
                "window": self._influence > 0,
                "source": f"crops of {TEMPLATE} and {SEARCH} pixels",
            },
        }

    def _context_side(self) -> float:
        """Side of the square around the target with its context, pixels."""
        return float(_overall(*self._size.tolist()))

    def _crop(self, frame: Image, side: int, pixels: int) -> Image:
        """A square around the centre as uint8 [pixels, pixels, 3], filled with the mean colour.

        The square begins at a whole pixel, as where the network was trained.
        """
        left, top = np.floor(self._centre - side / 2 - 0.5)
        zoom = pixels / max(side, 1)
        start = [0.5 * zoom - 0.5 - zoom * left, 0.5 * zoom - 0.5 - zoom * top]
        matrix = np.array([[zoom, 0, start[0]], [0, zoom, start[1]]])
        patch = cv2.warpAffine(frame, matrix, (pixels, pixels), borderValue=self._mean)
        return np.asarray(patch, np.uint8)

    def _features(self, patch: Image) -> Array:
        with stage("preprocess"):
            blob = cv2.dnn.blobFromImage(patch)
        with stage("inference"):
            return self._backbone(blob)

    def _correlate(self, patch: Image) -> tuple[Array, Array]:
        """Probability [n, n], and distances left, top, right, bottom [4, n, n], pixels of patch."""
        features = self._features(patch)
        with stage("inference"):
            (classes,), (sides,) = self._head(self._template, features)
        with stage("postprocess"):
            background, target = classes.astype(np.float64)
            return 1 / (1 + np.exp(np.clip(background - target, -500, 500))), sides


def _overall(w: Any, h: Any) -> Any:
    """Side of the square of a target's size and its context (SiamRPN)."""
    pad = (w + h) * CONTEXT
    return np.sqrt((w + pad) * (h + pad))


def _find(folder: str, part: str, given: str) -> Path:
    """The file of one of the two networks."""
    if given:
        files = [Path(given)] if Path(given).is_file() else []
        sought = given
    else:
        sought = f"{Path(folder) / f'*{part}*.onnx'}" if folder else f"{part}=FILE"
        files = sorted(Path(folder).glob(f"*{part}*.onnx")) if folder else []
    if len(files) != 1:
        problem = "more than one" if files else "no"
        raise LaeError(
            f"nanotrack: {problem} file {sought}; give weights=FOLDER, or backbone=FILE and "
            f"head=FILE (two ONNX files; {_UPSTREAM})"
        )
    return files[0]


def _opencv(paths: Sequence[Path], device: str) -> Networks:
    backbone, head = (_network(path, device) for path in paths)

    def features(patch: Array) -> Array:
        backbone.setInput(patch)
        return np.array(backbone.forward(), np.float32)  # its own memory, which it uses again

    def correlated(template: Array, search: Array) -> Sequence[Array]:
        head.setInput(template, "input1")
        head.setInput(search, "input2")
        found: Sequence[Array] = head.forward(["output1", "output2"])
        return found

    return features, correlated


def _onnx(paths: Sequence[Path], **options: Any) -> Networks:
    """The backbone, exported for the search's pixels alone, is loaded for the template's too."""
    sides = TEMPLATE, SEARCH
    shapes = {side: {"input": (1, 3, side, side)} for side in sides}
    backbones = {side: onnx_session(paths[0], shapes=shapes[side], **options) for side in sides}
    head = onnx_session(paths[1], **options)

    def features(patch: Array) -> Array:
        found: Sequence[Array] = backbones[patch.shape[-1]].run(None, {"input": patch})
        return found[0]

    def correlated(template: Array, search: Array) -> Sequence[Array]:
        inputs = {"input1": template, "input2": search}
        found: Sequence[Array] = head.run(["output1", "output2"], inputs)
        return found

    return features, correlated


def _gpu(device: str) -> tuple[str, int]:
    """ONNX Runtime's provider for a device, and the number of the GPU."""
    name, _, number = device.partition(":")
    if name not in _PROVIDERS or not (number or "0").isdigit():
        raise LaeError(_NO_DEVICE.format(device))
    return _PROVIDERS[name], int(number or 0)


def _network(path: Path, device: str) -> Any:
    try:
        network = cv2.dnn.readNet(str(path))
    except cv2.error as error:
        raise LaeError(f"{path}: not a network that OpenCV {cv2.__version__} can read") from error
    name, _, number = device.partition(":")
    if name == "cuda":
        backend, target = cv2.dnn.DNN_BACKEND_CUDA, cv2.dnn.DNN_TARGET_CUDA
        if target not in cv2.dnn.getAvailableTargets(backend):
            raise LaeError(f"nanotrack: this build of OpenCV ({cv2.__version__}) has no CUDA")
        cv2.cuda.setDevice(int(number or 0))
        network.setPreferableBackend(backend)
        network.setPreferableTarget(target)
    elif device != "cpu":
        raise LaeError(_NO_DEVICE.format(device))
    return network
