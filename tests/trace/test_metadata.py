"""The metadata document: what is required, kept, refused and read."""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

import pytest
from witness import MINIMAL

from lae_sim.errors import TraceError
from lae_sim.trace.metadata import KINDS, ImageSizes, Metadata, Search


def parse(**changes: Any) -> Metadata:
    return Metadata.parse(json.dumps({**MINIMAL, **changes}).encode())


def test_only_four_keys_are_required() -> None:
    metadata = parse()
    assert (metadata.fps, metadata.kind) == (Fraction(30), "every-frame")
    assert (metadata.tracker, metadata.device, metadata.timing_note) == ("unknown", "unknown", None)
    assert metadata.image_size("a") is None
    assert metadata.attributes("a") == ()


@pytest.mark.parametrize("key", ["format", "version", "fps", "schedule"])
def test_a_required_key_that_is_missing_is_named(key: str) -> None:
    document = {k: v for k, v in MINIMAL.items() if k != key}
    with pytest.raises(TraceError, match=f"metadata key '{key}"):
        Metadata.parse(json.dumps(document).encode())


ODD = [None, True, 0, 1.5, "", "odd", [], [1], {}, {"kind": 1}]


@pytest.mark.parametrize("value", ODD)
@pytest.mark.parametrize("key", ["format", "version", "fps", "schedule"])
def test_a_required_key_of_another_kind_is_named(key: str, value: Any) -> None:
    with pytest.raises(TraceError, match=f"metadata key '{key}"):
        parse(**{key: value})


@pytest.mark.parametrize("fps", ["0", "-30", "1/0", "1e9", "nan", "9" * 400, "1/" + "9" * 400, 30])
def test_a_frame_rate_that_is_not_exact_is_refused(fps: Any) -> None:
    with pytest.raises(TraceError, match="metadata key 'fps'"):
        parse(fps=fps)


@pytest.mark.parametrize(
    ("version", "problem"),
    [
        ("2.0", "format version 2.0.*reads version 1.*install"),
        ("999.0", "format version 999.0"),
        ("0.9", "format version 0.9"),
        ("1", "must be text such as '1.0'"),
        ("1.0.0", "must be text"),
        ("1.x", "must be text"),
        ("1.0\n", "must be text"),
        (" 1.0", "must be text"),
        ("1." + "0" * 5000, "must be text"),
        (1.0, "must be text"),
    ],
)
def test_other_versions_are_refused(version: Any, problem: str) -> None:
    with pytest.raises(TraceError, match=problem):
        parse(version=version)


def test_newer_minor_versions_are_read() -> None:
    assert parse(version="1.12").fps == 30


@pytest.mark.parametrize("value", [None, 1, "text", [], True])
@pytest.mark.parametrize("key", ["tracker", "device", "timing", "sequences"])
def test_an_optional_key_that_is_read_must_be_an_object(key: str, value: Any) -> None:
    with pytest.raises(TraceError, match=f"metadata key '{key}' must be a JSON object"):
        parse(**{key: value})


@pytest.mark.parametrize(
    "entry",
    [
        None,
        [],
        {"image_size": 640},
        {"image_size": [640]},
        {"image_size": [640, 360, 3]},
        {"image_size": [640.0, 360]},
        {"image_size": [0, 360]},
        {"image_size": [-640, 360]},
        {"image_size": [True, 360]},
        {"image_size": [2**31, 360]},
        {"image_size": ["640", "360"]},
        {"image_size": [640, 360], "image_sizes": []},
        {"image_size": [640, 360], "image_sizes": {"0": [640, 360]}},
        {"image_size": [640, 360], "image_sizes": [[0, 320, 360]]},
        {"image_size": [640, 360], "image_sizes": [[1, 640, 360]]},
        {"image_size": [640, 360], "image_sizes": [[0, 640, 360], [0, 320, 180]]},
        {"image_size": [640, 360], "image_sizes": [[0, 640, 360], [4, 320]]},
        {"image_size": [640, 360], "image_sizes": [[0, 640, 360], [4.0, 320, 180]]},
        {"image_size": [640, 360], "image_sizes": [[0, 640, 360], [4, 320, 0]]},
        {"image_size": [640, 360], "image_sizes": [[0, 640, 360], []]},
        {"image_sizes": [[0, 640, 360], [4, 320, 180]]},
        {"attributes": "Occlusion"},
        {"attributes": [1]},
        {"attributes": {"Occlusion": True}},
    ],
)
def test_a_faulty_entry_names_its_sequence(entry: Any) -> None:
    with pytest.raises(TraceError, match="sequence 'Gull2'"):
        parse(sequences={"Car1": {}, "Gull2": entry})


def test_what_is_known_is_read() -> None:
    metadata = parse(
        tracker={"name": "NanoTrack", "version": "3"},
        device={"model": "Jetson"},
        timing={"source": "mean of published fps"},
        sequences={"Gull2": {"image_size": [640, 360], "attributes": ["Occlusion", "Blur"]}},
    )
    assert (metadata.tracker, metadata.device) == ("NanoTrack", "Jetson")
    assert metadata.timing_note == "mean of published fps"
    assert metadata.image_size("Gull2") == (640, 360)
    assert metadata.attributes("Gull2") == ("Occlusion", "Blur")
    assert metadata.image_size("Car1") is None


def test_images_that_change_size() -> None:
    seen = ImageSizes.of([0, 3, 4, 8, 9], [(64, 36), (64, 36), (32, 18), (32, 18), (64, 36)])
    assert seen == ImageSizes((0, 4, 9), ((64, 36), (32, 18), (64, 36)))
    assert [seen.at(frame)[0] for frame in (0, 3, 4, 8, 9, 99)] == [64, 64, 32, 32, 64, 64]
    same = ImageSizes.of([0, 1], [[64, 36], [64, 36]])
    assert same == ImageSizes.constant((64, 36))
    assert same.entry() == {"image_size": [64, 36]}
    metadata = parse(sequences={"a": seen.entry(), "b": same.entry(), "c": {}})
    assert metadata.image_size("a") == (64, 36)
    assert [metadata.image_sizes(name) for name in "abc"] == [seen, same, None]
    assert metadata.resized == ["a"]


def test_measured_times_need_no_note() -> None:
    assert parse(timing={"source": "measured"}).timing_note is None


def test_new_makes_what_parse_reads() -> None:
    metadata = Metadata.new(
        "30000/1001", "real-time", schedule={"policy": "latest"}, tracker={"name": "t"}, mine=[1]
    )
    assert metadata.document == {
        "format": "lae-trace",
        "version": "1.0",
        "fps": "30000/1001",
        "schedule": {"kind": "real-time", "policy": "latest"},
        "tracker": {"name": "t"},
        "mine": [1],
    }
    assert Metadata.parse(metadata.dumps()) == metadata


@pytest.mark.parametrize(
    ("fps", "kind", "more"),
    [
        ("0", "every-frame", {}),
        ("30", "sometimes", {}),
        ("30", "every-frame", {"tracker": "NanoTrack"}),
        ("30", "every-frame", {"mine": float("nan")}),
    ],
)
def test_new_refuses_what_parse_refuses(fps: str, kind: str, more: dict[str, Any]) -> None:
    with pytest.raises(TraceError):
        Metadata.new(fps, kind, **more)


def test_equal_documents_make_equal_text_in_any_order_of_keys() -> None:
    one = Metadata.parse(json.dumps({"b": 1, **MINIMAL, "a": {"y": 2, "x": 1}}).encode())
    two = Metadata.parse(json.dumps({"a": {"x": 1, "y": 2}, **MINIMAL, "b": 1}).encode())
    assert one.dumps() == two.dumps()


def test_whatever_is_read_can_be_written() -> None:
    for more in (
        '"x": 1e999',
        '"x": -1e999',
        '"x": [{"y": 1e400}]',
        '"x": 1e308',
        '"x": "\\ud800"',
    ):
        text = json.dumps(MINIMAL)[:-1] + ", " + more + "}"
        try:
            metadata = Metadata.parse(text.encode())
        except TraceError:
            continue
        assert Metadata.parse(metadata.dumps()) == metadata


def test_a_search_region_is_read() -> None:
    assert parse().search is None
    assert parse(tracker={"search": None}).search is None
    assert parse(tracker={"search": {"half_side": 2}}).search == Search(2.0, None, None)
    declared = {"half_side": 1.25, "window": True, "source": "its paper"}
    assert parse(tracker={"search": declared}).search == Search(1.25, True, "its paper")


@pytest.mark.parametrize(
    ("search", "key"),
    [
        ("near", "search'"),
        ([1.0], "search'"),
        ({}, "half_side"),
        ({"half_side": 0}, "half_side"),
        ({"half_side": -1.0}, "half_side"),
        ({"half_side": "1.0"}, "half_side"),
        ({"half_side": True}, "half_side"),
        ({"half_side": 10**400}, "half_side"),
        ({"half_side": 1.0, "window": "yes"}, "window"),
        ({"half_side": 1.0, "source": 127}, "source"),
    ],
)
def test_a_search_region_that_is_none_is_refused(search: Any, key: str) -> None:
    with pytest.raises(TraceError, match=f"tracker.search.*{key}|tracker.{key}"):
        parse(tracker={"search": search})


def test_only_restarts_need_a_newer_reader() -> None:
    versions = [Metadata.new(30, kind).document["version"] for kind in KINDS]
    assert dict(zip(KINDS, versions, strict=True)) == {
        "every-frame": "1.0",
        "real-time": "1.0",
        "restarts": "1.1",
    }
