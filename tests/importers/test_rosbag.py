"""Logs in ROS bags: topics, boxes, stamps and clocks."""

from __future__ import annotations

import os
import re
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import (
    START,
    Message,
    compressed,
    detection,
    detections,
    image,
    make,
    polygon,
    stamp,
    track,
    write_bag,
    write_bag_of_ros1,
    write_compressed,
)

from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.importers.measured import convert_log
from lae_sim.replay.recorded import AsRecorded
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.recording import Recording

MS = 10**6
FRAME = 33_333_333
HOUR = 3600 * 10**9
# frame, when its output was received (ms after the first frame's capture), box
OUTPUTS = [
    (1, 90.0, (10.5, 20, 30, 40)),
    (3, 165.25, (12, 20, 30, 40)),
    (4, 190.125, (14, 20.25, 30, 41)),
    (8, 333.0, (18, 21, 31, 40)),
]


def frames(count: int = 10, made: Any = image, offset: int = 0) -> list[Message]:
    """Images that arrive 7 to 9 ms after their capture; ``offset`` is what their clock lacks."""
    taken = [START + i * FRAME for i in range(count)]
    return [
        ("/camera/image", at + 7 * MS + i % 3 * MS, made(at - offset)) for i, at in enumerate(taken)
    ]


def boxes(made: Any = polygon, late: int = 0) -> list[Message]:
    return [
        ("/tracker/box", START + round(ms * MS), made(START + frame * FRAME + late, box))
        for frame, ms, box in OUTPUTS
    ]


def ready_ms(recording: Recording, fps: str) -> list[float]:
    """When outputs are ready in a replay, ms after the capture of frame 0."""
    from lae_sim.engine.clock import parse_fps

    schedule = replay_sequence(recording, Clock.at(parse_fps(fps)), policy=AsRecorded()).schedule
    first = FRAME + 8 * MS  # when frame 1 arrived, with whose output the sequence begins
    return [(int(at) // schedule.clock.ticks_per_ns + first) / MS for at in schedule.ready]


def converted(path: Path, **options: Any) -> tuple[Recording, Any, Any]:
    trace, summary = convert_log(path, **options)
    [recording] = trace
    return recording, trace.metadata.document, summary


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_bag_replays_as_it_was_recorded(tmp_path: Path, storage: str) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes()], storage)
    recording, document, summary = converted(bag)
    assert (recording.name, len(recording)) == ("flight", 9)  # from the first output's frame on
    assert np.flatnonzero(recording.elapsed_ns >= 0).tolist() == [0, 2, 3, 7]
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]
    found = recording.boxes[recording.elapsed_ns >= 0].tolist()
    assert found == [list(map(float, box)) for _, _, box in OUTPUTS]
    assert recording.arrival_ns is not None
    arrived = [i * FRAME + i % 3 * MS for i in range(1, 10)]
    assert recording.arrival_ns.tolist() == [at - arrived[0] for at in arrived]
    assert document["schedule"] == {"kind": "real-time", "policy": "recorded"}
    assert document["log"] == {
        "format": "ros",
        "images": "/camera/image",
        "boxes": "/tracker/box",
        "matched_by": "equal stamps",
        "arrivals": "received",
        "clock_offset_ns": 0,
        "clock_offset_source": "assumed",
        "camera_delay_ns": {"least": 7 * MS, "median": 8 * MS, "most": 9 * MS},
        "initial_box": "first output",
    }
    assert document["sequences"]["flight"] == {"image_size": [640, 480]}
    assert (document["fps"], document["tracker"]["name"]) == ("30", "tracker/box")
    assert "1 frames before the first output are left out" in summary.notes
    assert {path.name for path in summary.files} >= {"metadata.yaml"}


def test_one_file_of_a_bag(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes()])
    recording, _, _ = converted(bag / "flight.mcap")
    assert len(recording) == 9


def test_a_bag_of_ros_1(tmp_path: Path) -> None:
    bag = write_bag_of_ros1(tmp_path / "flight.bag", [*frames(), *boxes()])
    recording, document, _ = converted(bag)
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]


@pytest.mark.parametrize("mode", ["MESSAGE", "FILE", "STORAGE"])
def test_a_bag_that_is_compressed(tmp_path: Path, mode: str) -> None:
    bag = write_compressed(tmp_path / "flight", [*frames(), *boxes()], mode)
    recording, document, _ = converted(bag)
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]


def test_a_bag_without_definitions_as_ros_wrote_them_before_iron(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(detection)], "sqlite3")
    with sqlite3.connect(bag / "flight.db3") as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    assert "type_description_hash" in text
    metadata.write_text(re.sub(r"\s*type_description_hash:\s*\S+", "", text))
    recording, document, _ = converted(bag)
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]


def test_detections(tmp_path: Path) -> None:
    def scored(ns: int, box: Any) -> Any:
        return detection(ns, box, score=0.75)

    recording, _, _ = converted(write_bag(tmp_path / "a", [*frames(), *boxes(scored)]))
    assert recording.boxes[0].tolist() == [10.5, 20, 30, 40]
    assert recording.score[[0, 2]].tolist() == [0.75, 0.75]
    assert np.isnan(recording.score[1])


def test_of_several_targets_the_best_or_the_one_of_an_id(tmp_path: Path) -> None:
    def several(ns: int, box: Any) -> Any:
        other = (300, 300, 9, 9)
        return detections(ns, [detection(ns, other, "7", 0.5), detection(ns, box, "8", 0.9)])

    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(several)])
    recording, _, summary = converted(bag)
    assert recording.boxes[0].tolist() == [10.5, 20, 30, 40]
    assert (
        "4 messages of /tracker/box hold several targets; of each the one of the best score is "
        "taken (--target ID chooses one: 7, 8)" in summary.notes
    )
    recording, _, summary = converted(bag, target="7")
    assert recording.boxes[0].tolist() == [300, 300, 9, 9]
    assert not [note for note in summary.notes if "several" in note]
    with pytest.raises(
        LaeError, match=r"no message of /tracker/box has a target '9'; there are 7, 8"
    ):
        convert_log(bag, target="9")


def test_several_targets_without_scores_are_asked_about(tmp_path: Path) -> None:
    def several(ns: int, box: Any) -> Any:
        return detections(ns, [detection(ns, box, "7"), detection(ns, box, "8")])

    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(several)])
    with pytest.raises(
        LaeError, match=r"message 1 of /tracker/box: 2 targets without scores.*7, 8"
    ):
        convert_log(bag)


@pytest.mark.parametrize("nothing", ["an empty array", "another target", "an empty polygon"])
def test_where_no_target_is_found_the_last_box_stands(tmp_path: Path, nothing: str) -> None:
    def found(ns: int, box: Any) -> Any:
        gone = box == OUTPUTS[2][2]
        if nothing == "an empty polygon":
            return polygon(ns, (0, 0, 0, 0) if gone else box)
        targets = [detection(ns, box, "8" if gone else "7")]
        return detections(ns, [] if gone and nothing == "an empty array" else targets)

    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(found)])
    recording, document, summary = converted(bag, target="7" if "another" in nothing else None)
    processed = recording.elapsed_ns >= 0
    assert recording.boxes[processed][1].tolist() == recording.boxes[processed][2].tolist()
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]
    assert document["sequences"]["flight"]["lost"] == 1
    assert summary.held == {"flight": 1}


def test_named_fields_of_any_message(tmp_path: Path) -> None:
    messages = [
        ("/drone/track", at, track(START + frame * FRAME, box, 0.5, at - 30 * MS, at - MS))
        for frame, ms, box in OUTPUTS
        for at in [START + round(ms * MS)]
    ]
    bag = write_bag(tmp_path / "flight", [*frames(), *messages])
    sides = {name: f"sides[{i}]" for i, name in enumerate(("cx", "cy", "w", "h"))}
    fields = {**sides, "score": "certainty", "started": "began", "ready": "done"}
    recording, document, _ = converted(bag, box_topic="/drone/track", fields=fields)
    assert recording.boxes[0].tolist() == [10.5 - 15, 0, 30, 40]
    assert recording.score[0] == 0.5
    assert ready_ms(recording, document["fps"]) == [ms - 1 for _, ms, _ in OUTPUTS]
    processed = recording.elapsed_ns >= 0
    # frame 3's call began 135.25 - (3 * 33.3 + 7) ms after it had arrived; frame 4's before frame
    # 3's output was ready
    assert recording.stages["tracker"][processed].tolist() == [29 * MS, 29 * MS, -1, 29 * MS]
    assert recording.stages["queue"][2] == 135_250_000 - (3 * FRAME + 7 * MS)
    corners = {"x": "sides[0]", "y": "sides[1]", "x2": "sides[2]", "y2": "sides[3]"}
    recording, _, _ = converted(bag, box_topic="/drone/track", fields=corners)
    assert recording.boxes[0].tolist() == [10.5, 20, 19.5, 20]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"x": "sides[0]"}, r"a box is x, y, w, h, or cx, cy, .*; not x"),
        ({"left": "sides[0]"}, r"no 'left': there are x, y, w, h"),
        ({"x": "__class__.__name__"}, r"no path such as"),
        ({"x": "a b"}, r"no path such as"),
        (
            dict.fromkeys("xywh", "sides[4]"),
            r"message 1 of /t: no field 'sides\[4\]': there is no \[4\]",
        ),
        (dict.fromkeys("xywh", "side"), r"'side' is not among header, sides, certainty"),
        (dict.fromkeys("xywh", "header.frame_id"), r"header.frame_id is no number"),
        (dict.fromkeys("xywh", "sides.tobytes"), r"'tobytes' is not among any"),
        (
            {**dict.fromkeys("xywh", "sides[0]"), "ready": "certainty"},
            r"certainty is no time of ROS",
        ),
    ],
)
def test_fields_that_are_not_there(tmp_path: Path, fields: dict[str, str], message: str) -> None:
    messages = [("/t", START + 50 * MS, track(START, (1, 2, 3, 4), 0.5, START, START))]
    bag = write_bag(tmp_path / "flight", [*frames(2), *messages])
    with pytest.raises(LaeError, match=message):
        convert_log(bag, box_topic="/t", fields=fields)


def test_topics_are_found_or_listed(tmp_path: Path) -> None:
    info = make(
        "sensor_msgs/msg/CameraInfo", header=image(START).header, height=480, width=640,
        distortion_model="", d=np.zeros(0), k=np.zeros(9), r=np.zeros(9), p=np.zeros(12),
        binning_x=0, binning_y=0,
        roi=make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0,
            do_rectify=False,
        ),
    )  # fmt: skip
    there = [("/camera/camera_info", START + MS, info), ("/other", START, stamp(START))]
    recording, document, _ = converted(write_bag(tmp_path / "a", [*frames(), *boxes(), *there]))
    assert document["log"]["images"] == "/camera/image"  # rather than the camera's calibration
    only = write_bag(
        tmp_path / "b", [there[0], ("/box", START + 5 * MS, polygon(START, (1, 2, 3, 4)))]
    )
    recording, document, _ = converted(only, fps=30)
    assert (document["log"]["images"], len(recording)) == ("/camera/camera_info", 1)
    assert document["sequences"]["b"]["image_size"] == [640, 480]
    two = [*frames(), ("/other/image", START + MS, compressed(START)), *boxes()]
    bag = write_bag(tmp_path / "c", two)
    with pytest.raises(LaeError) as raised:
        convert_log(bag)
    assert str(raised.value) == (
        f"{bag}: 2 topics of images: name one with --image-topic; there are /camera/image "
        "(sensor_msgs/msg/Image), /other/image (sensor_msgs/msg/CompressedImage)"
    )
    recording, document, _ = converted(bag, image_topic="/camera/image")
    assert len(recording) == 9
    with pytest.raises(
        LaeError, match=r"no messages of topic '/camera/imag'; did you mean '/camera/"
    ):
        convert_log(bag, image_topic="/camera/imag")
    with pytest.raises(LaeError, match=r"no topic of boxes: name one with --box-topic \(and their"):
        convert_log(write_bag(tmp_path / "d", frames()))
    with pytest.raises(LaeError, match=r"/other is of type builtin_interfaces/msg/Time: say where"):
        convert_log(tmp_path / "a", box_topic="/other")
    with pytest.raises(
        LaeError, match=r"/other: no field 'header.stamp': 'header' is not among sec"
    ):
        convert_log(tmp_path / "a", image_topic="/other")
    with pytest.raises(LaeError, match=r"--field is of a --box-topic"):
        convert_log(tmp_path / "a", fields=dict.fromkeys("xywh", "a"))
    with pytest.raises(LaeError, match="its targets have no id"):
        convert_log(tmp_path / "a", target="7")


def test_truth_of_another_topic(tmp_path: Path) -> None:
    times = [START + i * FRAME for i in range(10)]
    truth = [("/truth", at, polygon(at, (i, 1, 2, 3))) for i, at in enumerate(times)]
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(), *truth])
    named = "there are /tracker/box .geometry_msgs/msg/PolygonStamped., /truth [^,]*$"
    with pytest.raises(LaeError, match=f"2 topics of boxes.*{named}"):
        convert_log(bag)
    recording, document, summary = converted(bag, truth_topic="/truth")
    assert recording.truth[:, 0].tolist() == list(range(1, 10))
    assert document["log"]["truth"] == "/truth"
    assert not [note for note in summary.notes if "ground truth" in note]
    aside = [("/t", START + MS, polygon(START + 5, (1, 1, 2, 3)))]
    bag = write_bag(tmp_path / "b", [*frames(), *boxes(), *aside])
    with pytest.raises(
        LaeError, match="no message of /t has a box and the stamp of one of /camera"
    ):
        convert_log(bag, box_topic="/tracker/box", truth_topic="/t")


def test_boxes_that_are_stamped_later_than_their_frames(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(late=12 * MS)])
    with pytest.raises(LaeError) as raised:
        convert_log(bag)
    assert str(raised.value) == (
        f"{bag}: 4 of 4 messages of /tracker/box belong to no frame: the stamp of number 1 is 12 "
        "ms after that of the nearest one; --match 20ms takes the nearest earlier frame within "
        "that, --clock-offset=TIME sets another clock right, --skip-missing leaves such boxes out"
    )
    recording, document, _ = converted(bag, match="20ms")
    assert np.flatnonzero(recording.elapsed_ns >= 0).tolist() == [0, 2, 3, 7]
    assert document["log"]["matched_by"] == "nearest earlier stamp, within 20ms"
    assert len(converted(bag, match="12ms")[0]) == 9
    with pytest.raises(LaeError, match="4 of 4 messages"):
        convert_log(bag, match="11.999ms")


def test_boxes_that_belong_to_no_frame_may_be_left_out(tmp_path: Path) -> None:
    stray = [("/tracker/box", START + 250 * MS, polygon(START + 6 * FRAME + 1, (1, 2, 3, 4)))]
    early = [("/tracker/box", START, polygon(START - FRAME, (1, 2, 3, 4)))]
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(), *stray, *early])
    with pytest.raises(
        LaeError, match=r"1 of 6 messages .* the stamp of number 5 is 1e-06 ms after"
    ):
        convert_log(bag)
    recording, _, summary = converted(bag, skip_missing=True)
    assert np.flatnonzero(recording.elapsed_ns >= 0).tolist() == [0, 2, 3, 7]
    assert summary.notes[:2] == [
        "1 messages of /tracker/box are of frames before the first, and left out",
        "1 messages of /tracker/box belong to no frame and are left out",
    ]


def test_another_clock_of_the_camera_is_asked_about_only_where_it_matters(tmp_path: Path) -> None:
    hour = write_bag(tmp_path / "a", [*frames(offset=HOUR), *boxes(late=-HOUR)])
    recording, document, summary = converted(hour)
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]
    assert document["log"]["clock_offset_source"] == "unknown"
    assert any("so its delay is unknown" in note for note in summary.notes)
    with pytest.raises(LaeError, match="the quickest frame arrives 3,600 s after it was captured"):
        convert_log(hour, arrivals="captured")
    recording, document, _ = converted(hour, arrivals="captured", clock_offset="3600s")
    assert recording.arrival_ns is not None
    assert recording.arrival_ns.tolist() == [i * FRAME for i in range(9)]
    assert document["log"]["camera_delay_ns"]["least"] == 7 * MS
    with pytest.raises(
        LaeError, match=r"the offset -3600s the quickest frame arrives 7,200 s after"
    ):
        convert_log(hour, clock_offset="-3600s")
    with pytest.raises(
        LaeError, match=r"--clock-offset: a time, such as -12ms, or estimate: 'an hour'"
    ):
        convert_log(hour, clock_offset="an hour")


def test_boxes_stamped_by_the_log_s_clock_and_frames_by_another(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(offset=HOUR), *boxes(late=12 * MS)])
    with pytest.raises(LaeError, match=r"4 of 4 .* 3,6\d\d s after .*--clock-offset"):
        convert_log(bag)
    with pytest.raises(LaeError, match="3,600 s after it was captured; say what to add"):
        convert_log(bag, match="20ms")
    recording, document, summary = converted(bag, match="20ms", clock_offset="estimate")
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]
    assert document["log"]["clock_offset_ns"] == HOUR + 7 * MS  # the quickest frame took 7 ms
    assert document["log"]["clock_offset_source"] == "estimated"
    assert any("3600.007000000 s are added" in n and "an estimate" in n for n in summary.notes)


def test_one_clock_for_all_stamps_that_is_not_the_log_s(tmp_path: Path) -> None:
    """As in a simulation."""
    bag = write_bag(tmp_path / "flight", [*frames(offset=HOUR), *boxes(late=12 * MS - HOUR)])
    recording, document, _ = converted(bag, match="20ms")
    assert ready_ms(recording, document["fps"]) == [ms for _, ms, _ in OUTPUTS]


def test_an_image_that_the_log_received_after_its_output(tmp_path: Path) -> None:
    late = [(topic, at + 100 * MS, each) for topic, at, each in frames()]
    bag = write_bag(tmp_path / "flight", [*late, *boxes()])
    with pytest.raises(
        LaeError, match=r"message 1 of /tracker/box: ready 51.3 ms before its frame ar"
    ):
        convert_log(bag)
    recording, _, summary = converted(bag, arrivals="captured")
    assert np.flatnonzero(recording.elapsed_ns >= 0).tolist() == [0, 2, 3, 7]
    assert any("ages hold the camera's delay" in note for note in summary.notes)


def test_stamps_that_go_back_or_stand_still(tmp_path: Path) -> None:
    back = frames(4)
    back[2] = (*back[2][:2], image(START))
    bag = write_bag(tmp_path / "a", [*back, *boxes()])
    with pytest.raises(LaeError) as raised:
        convert_log(bag)
    assert str(raised.value) == (
        f"{bag}, message 3 of /camera/image: its stamp is 1700000000.000000000, not after that of "
        "the message before, 1700000000.033333333"
    )
    empty = [(topic, at, image(0)) for topic, at, _ in frames(3)]
    with pytest.raises(LaeError, match=r"message 2 .*0\.000000000; is the header filled\?"):
        convert_log(write_bag(tmp_path / "b", [*empty, *boxes()]))
    together = frames()
    together[5] = (together[5][0], together[4][1], together[5][2])
    recording, _, summary = converted(write_bag(tmp_path / "c", [*together, *boxes()]))
    assert recording.arrival_ns is not None
    assert recording.arrival_ns[4] == recording.arrival_ns[3] + 1
    assert "1 frames received at the instant of another arrive 1 ns after it" in summary.notes


def test_two_outputs_of_a_frame(tmp_path: Path) -> None:
    again = [("/tracker/box", START + 100 * MS, polygon(START + FRAME, (1, 2, 3, 4)))]
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(), *again])
    with pytest.raises(
        LaeError, match=r"message 2 of /tracker/box: a second output of the frame of"
    ):
        convert_log(bag)


def test_a_turned_box(tmp_path: Path) -> None:
    def turned(ns: int, box: Any) -> Any:
        return detection(ns, box, theta=0.5)

    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(turned)])
    with pytest.raises(LaeError, match=r"message 1 of /tracker/box: its box is turned by 0.5 rad"):
        convert_log(bag)


@pytest.mark.parametrize("score", [1e39, np.inf])
def test_a_score_that_no_trace_can_hold(tmp_path: Path, score: float) -> None:
    def scored(ns: int, box: Any) -> Any:
        return detection(ns, box, score=score)

    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(scored)])
    with pytest.raises(
        LaeError, match=r"message 1 of /tracker/box: the score .* is no possible one"
    ):
        convert_log(bag)


def test_images_that_change_size(tmp_path: Path) -> None:
    some = frames()
    some[5] = (*some[5][:2], image(START + 5 * FRAME, 320, 240))
    _, document, _ = converted(write_bag(tmp_path / "flight", [*some, *boxes()]))
    assert document["sequences"]["flight"]["image_sizes"] == [
        [0, 640, 480], [4, 320, 240], [5, 640, 480]
    ]  # fmt: skip


def test_no_target_at_all(tmp_path: Path) -> None:
    def nothing(ns: int, box: Any) -> Any:
        return detections(ns, [])

    with pytest.raises(LaeError, match="no output has a box: the tracker found no target"):
        convert_log(write_bag(tmp_path / "flight", [*frames(), *boxes(nothing)]))


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_empty_bags(tmp_path: Path, storage: str) -> None:
    bag = write_bag(tmp_path / "flight", [], storage)
    with pytest.raises(LaeError, match="flight: the bag is empty"):
        convert_log(bag)


def test_damaged_bags(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes()])
    data = (bag / "flight.mcap").read_bytes()
    rng = np.random.default_rng(0)
    said = []
    for case in range(60):
        cut = bytearray(data)
        if case % 3 == 0:
            cut = cut[: int(rng.integers(len(data)))]
        else:
            for at in rng.integers(len(data), size=3):
                cut[at] ^= int(rng.integers(1, 256))
        (bag / "flight.mcap").write_bytes(cut)
        try:
            convert_log(bag)
        except LaeError as error:
            said.append(str(error))
    assert len(said) > 20
    assert all(text.startswith(str(bag)) and len(text) < 700 for text in said)
    (bag / "metadata.yaml").write_text("a: [")
    with pytest.raises(LaeError, match="flight: not a readable bag: Could not load YAML"):
        convert_log(bag)
    os.remove(bag / "metadata.yaml")
    with pytest.raises(
        LaeError, match=r"not a readable bag: Expected metadata file .* does not exist"
    ):
        convert_log(bag)


def test_a_message_that_is_cut_short(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes()], "sqlite3")
    with sqlite3.connect(bag / "flight.db3") as database:
        database.execute("UPDATE messages SET data = substr(data, 1, 9) WHERE rowid = 4")
    with pytest.raises(LaeError, match=r"flight, message \d of /(camera|tracker)/\w+: damaged: "):
        convert_log(bag)


@pytest.mark.parametrize(
    "definition",
    [
        'string WHO="""\n__import__("os").mkdir("ran")\n"""\nint32 a',
        'string WHO=\'"""+__import__("os").mkdir("ran")+"""\'\nint32 a',
        'int32 a=__import__("os").mkdir("ran")',
        '__import__("os").mkdir("ran") a',
        'int32 a);__import__("os").mkdir("ran")',
        "int32[__import__('os').mkdir('ran')] a",
        '# """\nimport os; os.mkdir("ran")\n"""\nint32 a',
    ],
)
def test_nothing_in_a_definition_is_executed(
    tmp_path: Path, definition: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes()], "sqlite3")
    with sqlite3.connect(bag / "flight.db3") as database:
        text = "SELECT encoded_message_definition FROM message_definitions WHERE topic_type LIKE ?"
        [(whole,)] = database.execute(text, ["%PolygonStamped"]).fetchall()
        database.execute(
            "UPDATE message_definitions SET encoded_message_definition = ? WHERE topic_type LIKE ?",
            [f"{definition}\n{whole}", "%PolygonStamped"],
        )
    with pytest.raises(LaeError, match="flight"):
        convert_log(bag)
    assert not (tmp_path / "ran").exists()


def test_definitions_of_other_topics_do_not_matter(tmp_path: Path) -> None:
    other = [("/other", START, stamp(START))]
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes(), *other], "sqlite3")
    with sqlite3.connect(bag / "flight.db3") as database:
        database.execute(
            "UPDATE message_definitions SET encoded_message_definition = '(!)' "
            "WHERE topic_type LIKE '%Time'"
        )
    assert len(converted(bag)[0]) == 9


def test_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write_bag(tmp_path / "flight", [*frames(), *boxes()])
    monkeypatch.setitem(__import__("sys").modules, "rosbags", None)
    with pytest.raises(LaeError, match=r"a ROS bag: to read it pip install 'lae-sim\[ros\]'"):
        convert_log(bag)
