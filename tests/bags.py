"""ROS bags for tests, written by the library that reads them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rosbags = pytest.importorskip("rosbags", reason="ROS bags need the extra ros")

from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin  # noqa: E402
from rosbags.typesys import get_types_from_msg  # noqa: E402

from lae_sim.importers.rosbag import ros_types  # noqa: E402

TYPES = ros_types()
TYPES.register(
    get_types_from_msg(
        "std_msgs/Header header\nfloat32[4] sides\nfloat64 certainty\n"
        "builtin_interfaces/Time began\nint64 done",
        "drone_msgs/msg/Track",
    )
)
START = 1_700_000_000 * 10**9
STORAGES = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}

Message = tuple[str, int, Any]
"""Topic, when it was received, and the message."""


def make(name: str, **fields: Any) -> Any:
    """A message of a type."""
    return TYPES.types[name](**fields)


def stamp(ns: int) -> Any:
    return make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns: int) -> Any:
    return make("std_msgs/msg/Header", stamp=stamp(ns), frame_id="camera")


def image(ns: int, width: int = 640, height: int = 480) -> Any:
    return make(
        "sensor_msgs/msg/Image", header=header(ns), height=height, width=width, encoding="mono8",
        is_bigendian=0, step=width, data=np.zeros(4, np.uint8),
    )  # fmt: skip


def compressed(ns: int) -> Any:
    data = np.zeros(4, np.uint8)
    return make("sensor_msgs/msg/CompressedImage", header=header(ns), format="jpeg", data=data)


def polygon(ns: int, box: Iterable[float]) -> Any:
    x, y, w, h = box
    corners = [(x, y), (x + w, y), (x + w, y + h), (x, y + h)] if w else []
    points = [make("geometry_msgs/msg/Point32", x=x, y=y, z=0.0) for x, y in corners]
    shape = make("geometry_msgs/msg/Polygon", points=points)
    return make("geometry_msgs/msg/PolygonStamped", header=header(ns), polygon=shape)


def detection(
    ns: int, box: Iterable[float], name: str = "", score: float | None = None, theta: float = 0.0
) -> Any:
    x, y, w, h = box
    position = make("vision_msgs/msg/Point2D", x=x + w / 2, y=y + h / 2)
    centre = make("vision_msgs/msg/Pose2D", position=position, theta=theta)
    found = make("vision_msgs/msg/BoundingBox2D", center=centre, size_x=float(w), size_y=float(h))
    results = [] if score is None else [_hypothesis(score)]
    return make(
        "vision_msgs/msg/Detection2D", header=header(ns), results=results, bbox=found, id=name
    )


def _hypothesis(score: float) -> Any:
    return make(
        "vision_msgs/msg/ObjectHypothesisWithPose",
        hypothesis=make("vision_msgs/msg/ObjectHypothesis", class_id="drone", score=score),
        pose=make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=make(
                "geometry_msgs/msg/Pose",
                position=make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
                orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            ),
            covariance=np.zeros(36),
        ),
    )


def detections(ns: int, targets: list[Any]) -> Any:
    return make("vision_msgs/msg/Detection2DArray", header=header(ns), detections=targets)


def track(ns: int, box: Iterable[float], score: float, began: int, done: int) -> Any:
    return make(
        "drone_msgs/msg/Track", header=header(ns), sides=np.array([*box], np.float32),
        certainty=score, began=stamp(began), done=done,
    )  # fmt: skip


def write_bag(
    path: Path, messages: Iterable[Message], storage: str = "mcap", compression: str = ""
) -> Path:
    """A bag of ROS 2 with these messages, in the order in which they were received."""
    with rosbag2.Writer(path, version=9, storage_plugin=STORAGES[storage]) as writer:
        _write(writer, messages, TYPES.serialize_cdr)
    return path


def write_compressed(path: Path, messages: Iterable[Message], mode: str) -> Path:
    """The same, compressed message by message, as a file, or in chunks."""
    storage = StoragePlugin.MCAP if mode == "STORAGE" else StoragePlugin.SQLITE3
    writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, TYPES.serialize_cdr)
    return path


def write_bag_of_ros1(path: Path, messages: Iterable[Message]) -> Path:
    with rosbag1.Writer(path) as writer:
        _write(writer, messages, TYPES.serialize_ros1)
    return path


def _write(writer: Any, messages: Iterable[Message], serialized: Any) -> None:
    topics: dict[str, Any] = {}
    for topic, received, message in sorted(messages, key=lambda each: each[1]):
        kind = message.__msgtype__
        if topic not in topics:
            topics[topic] = writer.add_connection(topic, kind, typestore=TYPES)
        writer.write(topics[topic], received, serialized(message, kind))
