"""The trackers of OpenCV: those of the main package, and of contrib where that is installed."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2

from lae_sim.errors import LaeError, listed
from lae_sim.trackers.protocol import Image, checked_box, checked_frame, weights_digest

_MAIN = {"mil": "MIL", "nano": "Nano", "vit": "Vit", "dasiamrpn": "DaSiamRPN", "goturn": "GOTURN"}
_CONTRIB = {"csrt": "CSRT", "kcf": "KCF"}
_LEGACY = {"mosse": "MOSSE", "medianflow": "MedianFlow", "tld": "TLD", "boosting": "Boosting"}

# The options that name a tracker's files: the attribute of its Params that takes the file.
_FILES = {
    "nano": {"backbone": "backbone", "head": "neckhead"},
    "vit": {"model": "net"},
    "dasiamrpn": {"model": "model", "kernel_cls1": "kernel_cls1", "kernel_r1": "kernel_r1"},
    "goturn": {"model": "modelBin", "prototxt": "modelTxt"},
}

# Half the side of the search region of a square target over sqrt((w + p)(h + p)), p = (w + h) / 2;
# whether a cosine window weighs it; and what OpenCV's sources have. The others search a number of
# pixels, follow points, or look everywhere.
_SEARCH = {
    "nano": (1.0, True, "crops of 127 and 255 pixels"),
    "dasiamrpn": (271 / 127 / 2, True, "crops of 127 and 271 pixels"),
    "vit": (1.0, True, "a crop of 4 sqrt(w h)"),
    "goturn": (0.5, False, "a crop of 2 w, 2 h"),
    "csrt": (1.0, True, "a window of w + 3 sqrt(w h), tapered"),
    "kcf": (0.5, True, "a window of 2 w, 2 h, tapered"),
}

# Pixels of a side, and of the area: with less these never return from init, for they draw random
# features until enough of them fit into the box.
_SMALLEST = {"mil": (2, 25), "boosting": (2, 25), "tld": (2, 4)}


class OpenCv:
    """A tracker of OpenCV.

    Boxes are rounded to whole pixels and cut off at the image's edge, since OpenCV accepts no
    others. A new OpenCV tracker is made for each sequence.

    Args:
        name: such as ``"mil"``, ``"nano"`` or ``"csrt"``.
        model, backbone, head, kernel_cls1, kernel_r1, prototxt: files of the networks of ``vit``
            (model), ``nano`` (backbone, head), ``dasiamrpn`` (model, kernel_cls1, kernel_r1),
            ``goturn`` (model, prototxt).
        seed: of the random numbers that MIL, TLD and Boosting draw, set in ``init``.

    Raises:
        LaeError: if this build of OpenCV lacks the tracker, or a file is missing or unreadable.
    """

    def __init__(
        self,
        name: str,
        model: str = "",
        backbone: str = "",
        head: str = "",
        kernel_cls1: str = "",
        kernel_r1: str = "",
        prototxt: str = "",
        seed: int = 0,
    ) -> None:
        self._name, self._seed = name, seed
        self._create = _factory(name)
        given = {
            "model": model,
            "backbone": backbone,
            "head": head,
            "kernel_cls1": kernel_cls1,
            "kernel_r1": kernel_r1,
            "prototxt": prototxt,
        }
        self._files = _checked_files(name, {k: str(v) for k, v in given.items() if v})
        self._digest = weights_digest(*self._files.values())
        self._networks: list[Any] | None = []
        try:
            self._networks = self._loaded()
            self._new()
        except cv2.error as error:
            files = ", ".join(self._files.values())
            raise LaeError(f"opencv:{name} cannot be made of {files}: {error.err}") from error
        self._tracker: Any = None

    def init(self, frame: Image, box: Sequence[float]) -> None:
        """Start a new OpenCV tracker on a sequence.

        Raises:
            LaeError: if the frame is no image, or the box is too small for this tracker, outside
                of the image, or refused.
        """
        self._tracker = None
        frame = checked_frame(frame)
        whole = _whole(checked_box(box), frame.shape[1], frame.shape[0])
        side, area = _SMALLEST.get(self._name, (1, 1))
        if min(whole[2:]) < side or whole[2] * whole[3] < area:
            raise LaeError(
                f"opencv:{self._name} needs a box with sides of {side} or more pixels and an area "
                f"of {area} or more within the image, not {list(box)} in {frame.shape[1]} x "
                f"{frame.shape[0]} pixels"
            )
        _seed(self._seed)
        tracker = self._new()
        refusal = f"opencv:{self._name} refused to start on the box {list(box)}"
        try:
            if tracker.init(frame, whole) is False:  # trackers of cv2.legacy; others raise
                raise LaeError(refusal)
        except cv2.error as error:
            raise LaeError(f"{refusal}: {error.err}") from error
        self._tracker, self._shape = tracker, frame.shape

    def track(self, frame: Image) -> Any:
        """The target's box in the next frame, with a score if the tracker has one, or None.

        Raises:
            LaeError: if ``init`` was not called, or the tracker cannot go on where frames change
                size (MedianFlow and TLD).
        """
        if self._tracker is None:  # OpenCV would end the process
            raise LaeError(f"opencv:{self._name}: init must come before track")
        frame = checked_frame(frame)
        try:
            found, box = self._tracker.update(frame)
        except cv2.error as error:
            if frame.shape == self._shape:
                raise
            sizes = " to ".join(f"{s[1]} x {s[0]}" for s in (self._shape, frame.shape))
            raise LaeError(
                f"opencv:{self._name} cannot go on where frames change from {sizes} pixels"
            ) from error
        if not found:
            return None
        score = getattr(self._tracker, "getTrackingScore", float)()
        return (tuple(box), score) if score > 0 else tuple(box)

    def describe(self) -> dict[str, Any]:
        """Name, version, settings, search, and digest of the weights, SHA-256 of the files."""
        settings = {"seed": self._seed}
        description = {
            "name": f"opencv:{self._name}",
            "version": cv2.__version__,
            "settings": settings,
        }
        if self._files:
            settings["network_loaded_in_init"] = self._networks is None
            description["weights_digest"] = self._digest
        if self._name in _SEARCH:
            half_side, window, source = _SEARCH[self._name]
            description["search"] = {"half_side": half_side, "window": window, "source": source}
        return description

    def _loaded(self) -> list[Any] | None:
        """The networks, or None where this version of OpenCV only takes the names of files."""
        if not self._files or self._name == "goturn":
            return None if self._files else []
        networks = [cv2.dnn.readNet(path) for path in self._files.values()]
        try:
            self._create(*networks)
        except (TypeError, cv2.error):
            return None
        return networks

    def _new(self) -> Any:
        if self._networks is not None:
            return self._create(*self._networks)
        params = getattr(cv2, f"Tracker{_MAIN[self._name]}_Params")()
        for option, attribute in _FILES[self._name].items():
            setattr(params, attribute, self._files[option])
        return self._create(params)


def _factory(name: str) -> Any:
    """What makes an OpenCV tracker of that name."""
    available = {}
    for known, module in ((_MAIN, cv2), (_CONTRIB, cv2), (_LEGACY, getattr(cv2, "legacy", None))):
        for key, title in known.items():
            create = getattr(module, f"Tracker{title}_create", None)
            if create:
                available[key] = create
    if name in available:
        return available[name]
    where = ""
    if name in _CONTRIB or name in _LEGACY:
        where = "; it is in the package opencv-contrib-python-headless, to be installed instead"
    names = ", ".join(available)
    raise LaeError(f"OpenCV {cv2.__version__} here has no tracker {name!r}, only {names}{where}")


def _checked_files(name: str, given: dict[str, str]) -> dict[str, str]:
    """The files of a tracker, in the order in which OpenCV takes its networks."""
    wanted = list(_FILES.get(name, {}))
    extra = [option for option in given if option not in wanted]
    if extra:
        raise LaeError(f"opencv:{name} takes no {listed(extra)}")
    lacking = [option for option in wanted if not Path(given.get(option, "")).is_file()]
    if lacking:
        missing = ", ".join(f"{o}={given.get(o, 'FILE')}" for o in lacking)
        raise LaeError(
            f"opencv:{name} needs the files of its network; there is no {missing} "
            f"(OpenCV's documentation of Tracker{_MAIN[name]} says where to get them)"
        )
    return {option: given[option] for option in wanted}


def _whole(box: Sequence[float], width: int, height: int) -> tuple[int, int, int, int]:
    """The part of a box within the image, in whole pixels; its sides are 0 where it is outside."""
    left, right = (min(max(round(v), 0), width) for v in (box[0], box[0] + box[2]))
    top, bottom = (min(max(round(v), 0), height) for v in (box[1], box[1] + box[3]))
    return left, top, right - left, bottom - top


def _seed(seed: int) -> None:
    """Set the seeds of the C library (MIL and TLD draw from it) and of OpenCV."""
    ctypes.CDLL("msvcrt" if os.name == "nt" else None).srand(seed)
    cv2.setRNGSeed(seed)
