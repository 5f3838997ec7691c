"""The metadata of a trace: a JSON document under the Parquet key ``lae_sim``.

The document is kept as it was read; unknown keys travel along and are ignored.
"""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from lae_sim.engine.clock import Number, exact, parse_fps, parse_rational
from lae_sim.errors import LaeError, TraceError

FORMAT = "lae-trace"
VERSION = "1.0"
NEWER_VERSION = "1.1"
"""Of traces with optional columns, and of restarts, whose kind readers of 1.0 do not know."""
_UNFIT = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
KINDS = ("every-frame", "real-time", "restarts")
TRACES_TIMES = "the trace's times: "


@dataclass(frozen=True)
class Search:
    """Where a tracker says that it looks for its target: a square around its last answer.

    Attributes:
        half_side: half the square's side, in units of :func:`lae_sim.boxes.search_side`.
        window: whether a cosine window weighs what is searched, so that a target near the edge is
            harder to find; None if that is not said.
        source: where the number is from, in words; None if that is not said.
    """

    half_side: float
    window: bool | None = None
    source: str | None = None


@dataclass(frozen=True)
class ImageSizes:
    """The sizes of a sequence's images, of which most have one.

    Attributes:
        starts: the frames from which on images have another size, ascending; the first is 0. (In
            the lanes of forecasters they are times where frames are.)
        sizes: width and height from then on, pixels.

    Example:
        >>> from lae_sim.trace import ImageSizes
        >>> sizes = ImageSizes.of([0, 2, 5, 6], [(640, 360), (640, 360), (320, 180), (320, 180)])
        >>> sizes.at(4), sizes.at(5), sizes.change
        ((640, 360), (320, 180), True)
    """

    starts: tuple[float, ...]
    sizes: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, frames: Iterable[int], sizes: Iterable[Sequence[int]]) -> ImageSizes:
        """Those of some frames, ascending from 0, as they were seen there."""
        starts: list[int] = []
        of_starts: list[tuple[int, int]] = []
        for frame, (width, height) in zip(frames, sizes):
            if of_starts[-1:] != [(width, height)]:
                starts.append(int(frame))
                of_starts.append((int(width), int(height)))
        return cls(tuple(starts), tuple(of_starts))

    @classmethod
    def constant(cls, size: tuple[int, int]) -> ImageSizes:
        """The same in all frames."""
        return cls((0,), (size,))

    @property
    def change(self) -> bool:
        """Whether there are several."""
        return len(self.sizes) > 1

    def at(self, frame: float) -> tuple[int, int]:
        """Width and height of a frame's image, pixels."""
        return self.sizes[bisect_right(self.starts, frame) - 1]

    def entry(self) -> dict[str, list[Any]]:
        """What the metadata of a sequence says of them."""
        entry: dict[str, list[Any]] = {"image_size": list(self.sizes[0])}
        if self.change:
            entry["image_sizes"] = [[at, *size] for at, size in zip(self.starts, self.sizes)]
        return entry


@dataclass(frozen=True, repr=False)
class Metadata:
    """What a trace says of itself.

    Attributes:
        fps: world frame rate, frames per second, exact.
        kind: ``"every-frame"``, ``"real-time"`` or ``"restarts"``.
        document: the whole JSON object (see ``traces/FORMAT.md``).

    Example:
        >>> import lae_sim
        >>> metadata = lae_sim.Metadata.new("30000/1001", "every-frame", tracker={"name": "mine"})
        >>> metadata.fps, metadata.tracker, metadata.device
        (Fraction(30000, 1001), 'mine', 'unknown')
        >>> lae_sim.read_trace("traces/synthetic-slow.parquet").metadata.attributes("boat-calm")
        ()
    """

    fps: Fraction
    kind: str
    document: Mapping[str, Any]

    def __repr__(self) -> str:
        of = f"{self.tracker!r} on {self.dataset!r}, taken on {self.device!r}"
        return f"<Metadata of {of}: {self.kind} at {self.fps} fps>"

    @classmethod
    def new(cls, fps: Number, kind: str, **more: Any) -> Metadata:
        """Metadata with the required keys, and any of the optional ones by name.

        Args:
            fps: the frame rate, such as ``30`` or ``"30000/1001"``; text is kept as it is.
            kind: ``"every-frame"``, ``"real-time"`` or ``"restarts"``.
            more: optional keys: ``tracker``, ``device``, ``timing``, ``dataset``, ``sequences``;
                ``schedule`` adds to the schedule object.

        Raises:
            TraceError: if a value does not fit the format.
        """
        fps = fps if isinstance(fps, str) else str(exact(fps))
        schedule = {"kind": kind, **more.pop("schedule", {})}
        head = {"format": FORMAT, "version": version_of(kind), "fps": fps, "schedule": schedule}
        return cls.of({**head, **more})

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Metadata:
        """Metadata from a whole document.

        Raises:
            TraceError: if a value does not fit the format.
        """
        return cls.parse(json.dumps(document).encode())

    @classmethod
    def parse(cls, text: bytes) -> Metadata:
        """Read and check the JSON document.

        Raises:
            TraceError: if it is not JSON, not of this format, or of a newer major version.
        """
        try:
            document = json.loads(
                text.decode(), parse_constant=_refuse_constant, parse_float=_finite
            )
        except (ValueError, RecursionError) as error:
            raise TraceError(f"metadata 'lae_sim' is not valid JSON: {error}") from error
        if not isinstance(document, dict):
            raise TraceError("metadata 'lae_sim' must be a JSON object")
        if document.get("format") != FORMAT:
            raise TraceError(f"metadata key 'format' must be {FORMAT!r}")
        version = document.get("version")
        if not isinstance(version, str) or not re.match(r"[0-9]{1,6}\.[0-9]{1,6}\Z", version):
            raise TraceError("metadata key 'version' must be text such as '1.0'")
        if int(version.split(".")[0]) != 1:
            raise TraceError(
                f"the trace has format version {version}, and this lae_sim reads version 1: "
                "install a lae_sim that knows it"
            )
        return cls(_fps(document), _kind(document), _checked(document))

    def with_columns(self) -> Metadata:
        """That of a trace which has optional columns: of a version that has them."""
        if int(self.document["version"].split(".")[1]) >= 1:
            return self
        return replace(self, document={**self.document, "version": NEWER_VERSION})

    def dumps(self) -> bytes:
        """The document as JSON text in UTF-8, keys in order."""
        return json.dumps(self.document, sort_keys=True, allow_nan=False).encode()

    @property
    def tracker(self) -> str:
        """The tracker's name, or ``"unknown"``."""
        return str(self.document.get("tracker", {}).get("name", "unknown"))

    @property
    def device(self) -> str:
        """The device's model, or ``"unknown"``."""
        return str(self.document.get("device", {}).get("model", "unknown"))

    @property
    def dataset(self) -> str:
        """The dataset's name, or ``"unknown"``."""
        dataset = self.document.get("dataset", {})
        return str(dataset.get("name", "unknown") if isinstance(dataset, dict) else dataset)

    @property
    def pre_forecaster(self) -> str | None:
        """What said where the tracker searched; None where that was its last answer."""
        name = self.document["schedule"].get("pre_forecaster")
        return None if name is None else str(name)

    @property
    def stride(self) -> Fraction:
        """Mean frames from one processed frame to the next (see :mod:`lae_sim.replay.strides`)."""
        return parse_rational(self.document["schedule"].get("stride", "1"))

    @property
    def search(self) -> Search | None:
        """Where the tracker says that it looks for its target; None if it does not say."""
        declared = self.document.get("tracker", {}).get("search")
        if declared is None:
            return None
        half_side, window, source = (declared.get(k) for k in ("half_side", "window", "source"))
        return Search(float(half_side), window, source)

    def goes_with(self, other: Metadata) -> bool:
        """Whether another trace is of the same tracker on the same dataset."""
        return (self.tracker, self.dataset) == (other.tracker, other.dataset)

    @property
    def profiled(self) -> bool:
        """Whether the trace names the clock of its times, as those of the profiler do."""
        return "clock" in self.document.get("timing", {})

    @property
    def timing_note(self) -> str | None:
        """What the trace says of times that were not measured, if it does."""
        note = self.document.get("timing", {}).get("source")
        return None if note in (None, "measured") else str(note)

    @property
    def init_source(self) -> str:
        """``"measured"``, if the times of initialisations are, or what the trace says of them."""
        timing = self.document.get("timing", {})
        source, note = timing.get("source"), timing.get("note")
        if source is None:
            source = "measured" if self.profiled else "whether measured, it does not say"
        if source == "measured" and note is None:
            return "measured"
        return f"{TRACES_TIMES}{source}" + ("" if note is None else f"; {note}")

    @property
    def names_attributes(self) -> bool:
        """Whether any sequence has attributes."""
        return any(entry.get("attributes") for entry in self.document.get("sequences", {}).values())

    def image_size(self, sequence: str) -> tuple[int, int] | None:
        """Width and height of the sequence's images in pixels, if known; of the first one."""
        size = self._sequence(sequence).get("image_size")
        return None if size is None else (size[0], size[1])

    def image_sizes(self, sequence: str) -> ImageSizes | None:
        """The sizes of the sequence's images, if known."""
        several = self._sequence(sequence).get("image_sizes")
        if several:
            return ImageSizes.of((each[0] for each in several), (each[1:] for each in several))
        size = self.image_size(sequence)
        return None if size is None else ImageSizes.constant(size)

    @property
    def resized(self) -> list[str]:
        """The sequences whose images change size."""
        entries = self.document.get("sequences", {}).items()
        return [name for name, entry in entries if len(entry.get("image_sizes", ())) > 1]

    def attributes(self, sequence: str) -> tuple[str, ...]:
        """The dataset's attributes of the sequence, such as ``"Occlusion"``."""
        return tuple(self._sequence(sequence).get("attributes", ()))

    def _sequence(self, sequence: str) -> Mapping[str, Any]:
        entry: Mapping[str, Any] = self.document.get("sequences", {}).get(sequence, {})
        return entry


def version_of(kind: str) -> str:
    """The oldest version of the format whose readers know a trace of this kind."""
    return NEWER_VERSION if kind == "restarts" else VERSION


def text_fault(text: str) -> str | None:
    """Why a text may not be in a trace; None if it may."""
    found = _UNFIT.search(text)
    if found is None:
        return None
    if found[0] >= "\ud800":
        return f"is not Unicode text: it holds {found[0]!r}, half of a character"
    return f"holds the control character {found[0]!r}"


def _check_texts(document: Mapping[str, Any]) -> None:
    """Check every key and text, however deep."""
    left: list[tuple[str, Any]] = [(key, (key, value)) for key, value in document.items()]
    while left:
        where, value = left.pop()
        if isinstance(value, str):
            if fault := text_fault(value):
                raise TraceError(f"metadata key {where[:200]!r} {fault}")
        elif isinstance(value, dict):
            left += [(f"{where}.{key}", (key, inner)) for key, inner in value.items()]
        elif isinstance(value, (list, tuple)):  # a tuple is a key and its value
            left += [(where, inner) for inner in value]


def _finite(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"{text[:40]} is too large")
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _fps(document: Mapping[str, Any]) -> Fraction:
    fps = document.get("fps")
    if not isinstance(fps, str):
        raise TraceError("metadata key 'fps' must be an exact rational as text, such as '30'")
    try:
        return parse_fps(fps)
    except LaeError as error:
        raise TraceError(f"metadata key 'fps': {error}") from error


def _kind(document: Mapping[str, Any]) -> str:
    schedule = document.get("schedule")
    kind = schedule.get("kind") if isinstance(schedule, dict) else None
    if kind not in KINDS:
        raise TraceError(f"metadata key 'schedule.kind' must be one of {', '.join(KINDS)}")
    stride = schedule.get("stride", "1") if isinstance(schedule, dict) else "1"
    try:
        fits = isinstance(stride, str) and parse_rational(stride) >= 1
    except LaeError:
        fits = False
    if not fits:
        raise TraceError("metadata key 'schedule.stride' must be text such as '2' or '3/2'")
    return str(kind)


def _checked(document: dict[str, Any]) -> dict[str, Any]:
    """Check all texts, and the types of the optional keys that lae_sim reads."""
    _check_texts(document)
    for key in ("tracker", "device", "timing", "sequences"):
        if not isinstance(document.get(key, {}), dict):
            raise TraceError(f"metadata key {key!r} must be a JSON object")
    _check_search(document.get("tracker", {}).get("search"))
    for name, entry in document.get("sequences", {}).items():
        where = f"metadata of sequence {name[:80]!r}"
        if not isinstance(entry, dict):
            raise TraceError(f"{where} must be a JSON object")
        size = entry.get("image_size")
        if size is not None and not _is_size(size):
            raise TraceError(f"{where}: 'image_size' must be [width, height] in pixels")
        if "image_sizes" in entry and not _are_sizes(entry["image_sizes"], size):
            raise TraceError(
                f"{where}: 'image_sizes' must be a list of [frame, width, height], frames "
                "ascending from 0, where it is 'image_size'"
            )
        attributes = entry.get("attributes", [])
        if not (isinstance(attributes, list) and all(isinstance(a, str) for a in attributes)):
            raise TraceError(f"{where}: 'attributes' must be a list of names")
    return document


def _is_size(size: Any) -> bool:
    whole = isinstance(size, list) and all(type(side) is int for side in size)
    return whole and len(size) == 2 and all(0 < side < 2**31 for side in size)


def _are_sizes(sizes: Any, first: Any) -> bool:
    if not (isinstance(sizes, list) and all(isinstance(each, list) and each for each in sizes)):
        return False
    frames = [each[0] for each in sizes]
    if not all(type(frame) is int and frame < 2**31 for frame in frames):
        return False
    ascending = frames[:1] == [0] and sorted(set(frames)) == frames
    return ascending and all(_is_size(each[1:]) for each in sizes) and sizes[0][1:] == first


def _check_search(search: Any) -> None:
    """Check what a tracker declares of its search region."""
    where = "metadata key 'tracker.search"
    if search is None:
        return
    if not isinstance(search, dict):
        raise TraceError(f"{where}' must be a JSON object")
    side: Any = search.get("half_side")
    if type(side) not in (int, float) or not 0 < side < 1e9:
        raise TraceError(
            f"{where}.half_side' must be a number above 0, in units of sqrt((w + p)(h + p)), "
            "p = (w + h) / 2, such as 1.0"
        )
    if not isinstance(search.get("window"), (bool, type(None))):
        raise TraceError(f"{where}.window' must be true or false")
    if not isinstance(search.get("source"), (str, type(None))):
        raise TraceError(f"{where}.source' must be text: where the number is from")
