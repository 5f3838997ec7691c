"""Logs as ROS bags: a topic of images, which give the frames, and one of boxes.

Bags are read by the ``rosbags`` library. A message is data, whose definition is text in the bag, or
one of the library's; nothing in a bag is executed.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.engine.clock import NS_PER_SECOND, parse_duration
from lae_sim.errors import LaeError, hint, install, listed, one_line, shown
from lae_sim.importers.logs import (
    Box,
    Log,
    LoggedFrame,
    LoggedOutput,
    clock_offset,
    in_seconds,
    nearest_earlier,
    of_one_clock,
    seconds,
)
from lae_sim.trace.metadata import ImageSizes

if TYPE_CHECKING:
    from rosbags import rosbag1, rosbag2

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
DETECTION = "vision_msgs/msg/Detection2D"
DETECTIONS = "vision_msgs/msg/Detection2DArray"
POLYGON = "geometry_msgs/msg/PolygonStamped"
BOXES = (DETECTION, DETECTIONS, POLYGON)

SIDES = (("x", "y", "w", "h"), ("cx", "cy", "w", "h"), ("x", "y", "x2", "y2"))
"""The names under which the fields of a message may be a box: from its corner, its centre, or from
corner to corner."""

FIELDS = ("x", "y", "w", "h", "cx", "cy", "x2", "y2", "score", "stamp", "started", "ready")
SUFFIXES = (".db3", ".mcap", ".bag")

_STEP = re.compile(r"(?:\.|\A)([A-Za-z][A-Za-z0-9_]*)|\[([0-9]{1,6})\]")
# What bags before ROS 2 Iron do not hold: the definitions of vision_msgs 4.
_VISION_MSGS = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id"
    ),
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
}


@dataclass(frozen=True)
class BagOptions:
    """What a bag does not tell.

    Attributes:
        images, boxes, truth: topics; found where None, and none of truth.
        fields: where a message of boxes has each of :data:`FIELDS`, such as ``"roi.x_offset"``.
        target: which of several targets, by its id; by default the one of the best score.
        match: how much later than its frame's a box's stamp may be, such as ``"20ms"``; by default
            they are equal.
        clock_offset: see :func:`lae_sim.importers.logs.clock_offset`; for boxes that are matched by
            time.
        skip_missing: whether boxes that belong to no frame are left out.
    """

    images: str | None = None
    boxes: str | None = None
    truth: str | None = None
    fields: Mapping[str, str] | None = None
    target: str | None = None
    match: str | None = None
    clock_offset: str | None = None
    skip_missing: bool = False


def read_bag(path: Path, options: BagOptions) -> Log:
    """The log that a bag holds.

    Frames are the messages of the topic of images: captured at the header's stamp, arrived when
    they were received. Outputs are those of the topic of boxes, ready when they were received. They
    belong to the frame of the same stamp.

    Args:
        path: a bag's folder, or a file of one.
        options: what the bag does not tell.

    Raises:
        LaeError: if rosbags is not installed, the bag is damaged or empty, a topic is missing or
            not the only one of its kind, or a box belongs to no frame; it names the topic and the
            number of the message, from 1.
    """
    try:
        from rosbags import rosbag1, rosbag2
    except ImportError as error:
        raise LaeError(f"{path}: a ROS bag: to read it {install('ros')}") from error
    try:
        with (rosbag1 if path.suffix == ".bag" else rosbag2).Reader(path) as reader:
            return _Bag(path, reader, options).log()
    except LaeError:
        raise
    except Exception as error:  # a damaged bag can raise anything
        raise LaeError(f"{path}: not a readable bag: {_reason(error)}") from error


def ros_types() -> Any:
    """The definitions that bags without any are read by: those of ROS 2, and of vision_msgs 4."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    found: dict[str, Any] = {}
    for name, text in _VISION_MSGS.items():
        found |= get_types_from_msg(text, f"vision_msgs/msg/{name}")
    store.register(found)
    return store


def _types_of(connection: Any) -> Any:
    """The definitions that messages of a topic are read by: the bag's own, where it has any.

    Those of other topics are left alone, since a bag may hold some that cannot be read.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.NONE:
        return ros_types()
    store = get_typestore(Stores.EMPTY)
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        store.register(get_types_from_msg(text, _type(connection.msgtype)))
        return store
    found: dict[str, Any] = {}
    for part in re.split(r"^={80}\n(?:IDL: .*\n)?", text, flags=re.MULTILINE):
        found |= get_types_from_idl(part) if part.strip() else {}
    store.register(found)
    return store


def _type(name: str) -> str:
    """The name of a type: ``sensor_msgs/msg/Image``, also where it is written without ``msg``."""
    package, _, rest = name.partition("/")
    return name if "/" in rest else f"{package}/msg/{rest}"


def _reason(error: Exception) -> str:
    """What a library's error says, in one line."""
    if isinstance(error, MemoryError):
        return "it asks for more memory than there is"
    return one_line(str(error))[:200] or type(error).__name__


@dataclass(frozen=True)
class _Message:
    """One, with its number, where it stands, when it was received, and its header's stamp."""

    number: int
    where: str
    received_ns: int
    stamp_ns: int
    content: Any


@dataclass(frozen=True)
class _Answer:
    """A box that a message holds; None where it tells of no target."""

    message: _Message
    box: Box | None
    score: float | None = None


class _Bag:
    """Reads the topics of a bag that is open."""

    def __init__(
        self, path: Path, reader: rosbag1.Reader | rosbag2.Reader, options: BagOptions
    ) -> None:
        self.path, self.reader, self.options = path, reader, options
        self.types = {
            topic: _type(str(each.msgtype))
            for topic, each in reader.topics.items()
            if each.msgcount
        }
        self.notes: list[str] = []

    def log(self) -> Log:
        """All that it tells."""
        if not self.types:
            raise LaeError(f"{self.path}: the bag is empty")
        options = self.options
        fields = _checked_fields(options.fields or {})
        images = self._images(options.images)
        boxes = self._boxes(options.boxes, bool(fields))
        frames, sizes = self._frames(images)
        answers = list(self._answers(boxes, fields, options.target))
        stamps = [frame.captured_ns or 0 for frame in frames]
        facts = {"format": "ros", "images": images, "boxes": boxes}
        places, how = self._matched(boxes, frames, answers)
        outputs = [
            LoggedOutput(
                answer.message.where,
                place,
                answer.box,
                self._time(answer.message, fields, "ready", answer.message.received_ns),
                self._time(answer.message, fields, "started", None),
                answer.score,
            )
            for answer, place in zip(answers, places)
            if place is not None
        ]
        truth: dict[int, Box] = {}
        if options.truth is not None:
            self._check_topic(options.truth)
            facts["truth"] = options.truth
            places_of = {stamp: place for place, stamp in enumerate(stamps)}
            for answer in self._answers(options.truth, {}, options.target):
                place = places_of.get(answer.message.stamp_ns)
                if place is not None and answer.box is not None:
                    truth[place] = answer.box
            if not truth:
                raise LaeError(
                    f"{self.path}: no message of {options.truth} has a box and the stamp of one of "
                    f"{images}"
                )
        return Log(
            frames,
            outputs,
            boxes.strip("/"),
            {**facts, **how},
            truth,
            sizes,
            notes=tuple(self.notes),
        )

    def _topics(self, types: Collection[str]) -> list[str]:
        return sorted(topic for topic, kind in self.types.items() if kind in types)

    def _check_topic(self, topic: str) -> None:
        if topic not in self.types:
            raise LaeError(
                f"{self.path}: no messages of topic {topic!r}{hint(topic, self.types)}; "
                f"{self._listing()}"
            )

    def _listing(self, topics: Iterable[str] = ()) -> str:
        """Topics with their types: those named, or all that are there."""
        there = [f"{topic} ({self.types[topic]})" for topic in sorted(topics or self.types)]
        return f"there are {listed(there, 12)}"

    def _images(self, asked: str | None) -> str:
        """The topic of images; that of the camera's calibration where there are none."""
        if asked is not None:
            self._check_topic(asked)
            return asked
        found = self._topics(IMAGES) or self._topics([CAMERA_INFO])
        if len(found) == 1:
            return found[0]
        few = "no topic of images" if not found else f"{len(found)} topics of images"
        raise LaeError(f"{self.path}: {few}: name one with --image-topic; {self._listing(found)}")

    def _boxes(self, asked: str | None, by_fields: bool) -> str:
        if asked is not None:
            self._check_topic(asked)
            if by_fields or self.types[asked] in BOXES:
                return asked
            raise LaeError(
                f"{self.path}: {asked} is of type {self.types[asked]}: say where its box is, as "
                "--field x=roi.x_offset --field y=roi.y_offset --field w=roi.width "
                "--field h=roi.height"
            )
        if by_fields:
            raise LaeError(f"{self.path}: --field is of a --box-topic; {self._listing()}")
        found = [each for each in self._topics(BOXES) if each != self.options.truth]
        if len(found) == 1:
            return found[0]
        few = "no topic of boxes" if not found else f"{len(found)} topics of boxes"
        more = "" if found else " (and their fields with --field, if they are of another type)"
        raise LaeError(
            f"{self.path}: {few}: name one with --box-topic{more}; {self._listing(found)}"
        )

    def _messages(self, topic: str, stamp: str = "header.stamp") -> Iterator[_Message]:
        """The messages of a topic, in the order in which they were received."""
        connections = [each for each in self.reader.connections if each.topic == topic]
        kind = self.types[topic]
        try:
            types = _types_of(connections[0])
        except Exception as error:
            raise LaeError(
                f"{self.path}: the definition of {kind}, the type of {topic}, cannot be read: "
                f"{_reason(error)}"
            ) from error
        if kind not in types.fielddefs:
            raise LaeError(f"{self.path}: the bag does not define {kind}, the type of {topic}")
        decode = types.deserialize_ros1 if self.path.suffix == ".bag" else types.deserialize_cdr
        number = 0
        messages = self.reader.messages(connections)
        while True:
            number += 1
            where = f"{self.path}, message {number} of {topic}"
            try:
                _, received_ns, data = next(messages)
                content = decode(data, kind)
            except StopIteration:
                return
            except Exception as error:  # what is damaged can raise anything
                raise LaeError(f"{where}: damaged: {_reason(error)}") from error
            at = _nanoseconds(_value(content, stamp, where), f"{where}: {stamp}")
            yield _Message(number, where, int(received_ns), at, content)

    def _frames(self, topic: str) -> tuple[list[LoggedFrame], ImageSizes | None]:
        frames: list[LoggedFrame] = []
        sizes = []
        last = -1
        for message in self._messages(topic):
            if message.stamp_ns <= last:
                zero = "; is the header filled?" if not message.stamp_ns else ""
                raise LaeError(
                    f"{message.where}: its stamp is {in_seconds(message.stamp_ns)}, not after that "
                    f"of the message before, {in_seconds(last)}{zero}"
                )
            last = message.stamp_ns
            frames.append(LoggedFrame(message.where, message.stamp_ns, message.received_ns))
            size = getattr(message.content, "width", 0), getattr(message.content, "height", 0)
            sizes.append(size if min(size) > 0 else (0, 0))
        known = all(min(size) for size in sizes)
        return frames, ImageSizes.of(range(len(sizes)), sizes) if known else None

    def _answers(
        self, topic: str, fields: Mapping[str, str], target: str | None
    ) -> Iterator[_Answer]:
        """The boxes of a topic, one for each message."""
        kind = self.types[topic]
        if target is not None and kind not in (DETECTION, DETECTIONS):
            raise LaeError(f"{self.path}: {topic} is of type {kind}: its targets have no id")
        names: set[str] = set()
        several = found = 0
        for message in self._messages(topic, fields.get("stamp", "header.stamp")):
            if fields:
                yield _of_fields(message, fields)
                continue
            if kind == POLYGON:
                yield _Answer(message, _around(message))
                continue
            content = message.content
            targets = list(content.detections) if kind == DETECTIONS else [content]
            names |= {_name(each) for each in targets}
            if target is not None:
                targets = [each for each in targets if _name(each) == target]
                found += bool(targets)
            several += len(targets) > 1
            yield _best(message, targets)
        if target is not None and not found:
            raise LaeError(
                f"{self.path}: no message of {topic} has a target {target!r}; there are "
                f"{listed(sorted(names))}"
            )
        if several:
            ids = sorted(names - {""})
            self.notes.append(
                f"{several:,} messages of {topic} hold several targets; of each the one of the "
                f"best score is taken (--target ID chooses one{': ' if ids else ''}{listed(ids)})"
            )

    def _matched(
        self, topic: str, frames: Sequence[LoggedFrame], answers: Sequence[_Answer]
    ) -> tuple[list[int | None], dict[str, Any]]:
        """The place of each box's frame, and how it was found."""
        options = self.options
        if not answers:
            return [], {}
        stamps = [frame.captured_ns or 0 for frame in frames]
        offset_ns = 0
        how: dict[str, Any] = {"matched_by": "equal stamps"}
        if options.match is None:
            place_of = {stamp: place for place, stamp in enumerate(stamps)}
            places = [place_of.get(answer.message.stamp_ns) for answer in answers]
        else:
            tolerance = parse_duration(options.match)
            how = {"matched_by": f"nearest earlier stamp, within {options.match}"}
            offset_ns = self._between_clocks(frames, answers)
            shifted = [stamp + offset_ns for stamp in stamps]
            at = [answer.message.stamp_ns for answer in answers]
            places = [nearest_earlier(shifted, each, tolerance) for each in at]
        early = [
            place is None and answer.message.stamp_ns < stamps[0] + offset_ns
            for answer, place in zip(answers, places)
        ]
        lost = [a for a, place, e in zip(answers, places, early) if place is None and not e]
        if all(place is None for place in places) or (lost and not options.skip_missing):
            first = (lost or answers)[0].message
            near = bisect_left(stamps, first.stamp_ns - offset_ns) - 1
            away = first.stamp_ns - offset_ns - stamps[max(near, 0)]
            raise LaeError(
                f"{self.path}: {len(lost) or len(answers):,} of {len(answers):,} messages of "
                f"{topic} belong to no frame: the stamp of number {first.number} is "
                f"{seconds(abs(away))} {'after' if away >= 0 else 'before'} that of the nearest one"
                "; --match 20ms takes the nearest earlier frame within that, --clock-offset=TIME "
                "sets another clock right, --skip-missing leaves such boxes out"
            )
        if any(early):
            self.notes.append(
                f"{sum(early):,} messages of {topic} are of frames before the first, and left out"
            )
        if lost:
            self.notes.append(
                f"{len(lost):,} messages of {topic} belong to no frame and are left out"
            )
        return places, how

    def _between_clocks(self, frames: Sequence[LoggedFrame], answers: Sequence[_Answer]) -> int:
        """What to add to the frames' stamps to have the boxes' clock, ns.

        Stamps are of one clock, such as that of a simulation, unless those of the boxes alone are
        of the log's.
        """
        of_frames = [(frame.arrived_ns or 0) - (frame.captured_ns or 0) for frame in frames]
        of_boxes = [each.message.received_ns - each.message.stamp_ns for each in answers]
        asked = self.options.clock_offset
        if not of_one_clock(of_boxes) or (asked is None and of_one_clock(of_frames)):
            return 0
        return clock_offset(self.path, of_frames, asked).ns

    def _time(self, message: _Message, fields: Mapping[str, str], name: str, otherwise: Any) -> Any:
        if name not in fields:
            return otherwise
        where = f"{message.where}: {fields[name]}"
        return _nanoseconds(_value(message.content, fields[name], message.where), where)


def _checked_fields(fields: Mapping[str, str]) -> Mapping[str, str]:
    """Fields that make a box.

    Raises:
        LaeError: if they do not.
    """
    for name, path in fields.items():
        if name not in FIELDS:
            raise LaeError(f"--field: no {shown(name)}: there are {', '.join(FIELDS)}")
        if "".join(match[0] for match in _STEP.finditer(path)) != path or not path:
            raise LaeError(
                f"--field {name}: {shown(path)} is no path such as bbox.center.x or a[0]"
            )
    sides = {*fields} & {side for sides in SIDES for side in sides}
    if fields and not any(sides == {*each} for each in SIDES):
        raise LaeError(
            "--field: a box is x, y, w, h, or cx, cy, w, h of its centre, or x, y, x2, y2 of its "
            f"corners; not {', '.join(sorted(sides)) or 'none of these'}"
        )
    return fields


def _value(content: Any, path: str, where: str) -> Any:
    """What stands in a message under a path such as ``results[0].score``."""
    value = content
    for match in _STEP.finditer(path):
        name, index = match.groups()
        if name is not None:
            known = getattr(value, "__dataclass_fields__", {})
            if name not in known:
                raise LaeError(
                    f"{where}: no field {path!r}: {name!r} is not among "
                    f"{listed(known, 12) or 'any'}"
                )
            value = getattr(value, name)
        else:
            try:
                value = value[int(index)]
            except (TypeError, IndexError, KeyError) as error:
                raise LaeError(f"{where}: no field {path!r}: there is no [{index}]") from error
    return value


def _nanoseconds(value: Any, where: str) -> int:
    """A time of ROS, or a whole number of nanoseconds."""
    known = getattr(value, "__dataclass_fields__", {})
    if "sec" in known and "nanosec" in known:
        return int(value.sec) * NS_PER_SECOND + int(value.nanosec)
    if isinstance(value, Integral) and not isinstance(value, bool):
        return int(value)
    raise LaeError(f"{where} is no time of ROS and no whole number of nanoseconds")


def _number(value: Any, where: str) -> float:
    if not isinstance(value, Real):
        raise LaeError(f"{where} is no number")
    return float(value)


def _of_fields(message: _Message, fields: Mapping[str, str]) -> _Answer:
    """The box that the fields of a message are."""
    found = {
        name: _number(_value(message.content, path, message.where), f"{message.where}: {path}")
        for name, path in fields.items()
        if name not in ("stamp", "started", "ready")
    }
    score = found.get("score")
    score = None if score is None or math.isnan(score) else score
    if "cx" in found:
        found["x"], found["y"] = found["cx"] - found["w"] / 2, found["cy"] - found["h"] / 2
    if "x2" in found:
        found["w"], found["h"] = found["x2"] - found["x"], found["y2"] - found["y"]
    return _Answer(message, _sized(found["x"], found["y"], found["w"], found["h"]), score)


def _sized(x: float, y: float, w: float, h: float) -> Box | None:
    """A box; None if it has no size, or is no number, as where a tracker has lost its target."""
    return (x, y, w, h) if w > 0 and h > 0 and math.isfinite(x + y + w + h) else None


def _around(message: _Message) -> Box | None:
    """The box around a polygon."""
    points = message.content.polygon.points
    if not points:
        return None
    x, y = [float(point.x) for point in points], [float(point.y) for point in points]
    return _sized(min(x), min(y), max(x) - min(x), max(y) - min(y))


def _name(detection: Any) -> str:
    """The id of a target: of vision_msgs 4, or of those before."""
    return str(getattr(detection, "id", "") or getattr(detection, "tracking_id", ""))


def _score(detection: Any) -> float:
    scores = [float(getattr(each, "hypothesis", each).score) for each in detection.results]
    return max(scores, default=math.nan)


def _best(message: _Message, targets: Sequence[Any]) -> _Answer:
    """The target of the best score."""
    if not targets:
        return _Answer(message, None)
    best = targets[0]
    if len(targets) > 1:
        known = [each for each in targets if not math.isnan(_score(each))]
        if not known:
            raise LaeError(
                f"{message.where}: {len(targets)} targets without scores: choose one with --target "
                f"ID; there are {listed(sorted({_name(each) for each in targets}))}"
            )
        best = max(known, key=_score)
    box = best.bbox
    centre = getattr(box.center, "position", box.center)
    if box.center.theta % math.pi:
        raise LaeError(
            f"{message.where}: its box is turned by {float(box.center.theta):.3g} rad: give the "
            "box around it in a message of its own, by --field"
        )
    w, h = float(box.size_x), float(box.size_y)
    score = _score(best)
    return _Answer(
        message,
        _sized(float(centre.x) - w / 2, float(centre.y) - h / 2, w, h),
        None if math.isnan(score) else score,
    )
