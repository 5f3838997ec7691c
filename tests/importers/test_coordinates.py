"""Boxes that are not what a result must hold are named; published results are let through."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim._arrays import Floats
from lae_sim.datasets.annotations import find_truth, read_truth
from lae_sim.datasets.names import SequenceNames
from lae_sim.errors import LaeError
from lae_sim.importers.convert import convert_results
from lae_sim.importers.coordinates import other_reading, row_0_is_off
from lae_sim.importers.results import find_results, read_results

SIZE = np.array([1280, 720, 1280, 720])
TRUTH = np.array([[300 + 5 * i, 200 + 3 * i, 60 + i % 3, 40] for i in range(40)], float)
# A tracker of its own mind: up to 3 px off, and elsewhere in the end.
BOXES = TRUTH + np.random.default_rng(1).uniform(-3, 3, TRUTH.shape)
BOXES[0] = TRUTH[0]
BOXES[30:, :2] += 200


def by_centre(boxes: Floats) -> Floats:
    return np.hstack([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]])


def corners(boxes: Floats) -> Floats:
    return np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])


def with_initial_box(change: Callable[[Floats], Floats]) -> Callable[[Floats], Floats]:
    """The same change, but row 0 is a copy of the initial box, as some toolkits write it."""
    return lambda boxes: np.vstack([boxes[:1], change(boxes)[1:]])


CHANGES = {
    "boxes by centre (cx, cy, w, h)": by_centre,
    "corner boxes (x1, y1, x2, y2)": corners,
    "boxes on images of another size (0.5 of the width, 0.5 of the height)": lambda b: b / 2,
    "boxes on images of another size (2 of the width, 2 of the height)": lambda b: b * 2,
    "boxes normalised by the images' size": lambda b: b / SIZE,
    "boxes normalised by the images' size, boxes by centre": lambda b: by_centre(b) / SIZE,
    "boxes normalised by the images' size, corner boxes": lambda b: corners(b) / SIZE,
}


@pytest.mark.parametrize("looks_like", CHANGES)
@pytest.mark.parametrize("copied", [False, True])
def test_other_coordinates_are_named(looks_like: str, copied: bool) -> None:
    change = CHANGES[looks_like]
    changed = (with_initial_box(change) if copied else change)(BOXES)
    found = other_reading(TRUTH, changed)
    assert found is not None
    assert found.looks_like.startswith(looks_like)
    assert found.iou is not None
    assert found.iou > 0.6 > 0.3 > found.iou_as_is


def test_the_images_scale_is_found_in_each_direction() -> None:
    found = other_reading(TRUTH, BOXES / SIZE * 1000)
    assert found is not None
    assert "(0.78 of the width, 1.4 of the height)" in found.looks_like
    assert found.remedy.startswith("multiply x and w by 1.28, y and h by 0.7")


def test_normalised_boxes_of_a_tracker_that_lost_its_target_at_once() -> None:
    found = other_reading(TRUTH, np.vstack([BOXES[:1], BOXES[1:] * [0.1, 0.1, 1, 1]]) / SIZE)
    assert found is not None
    assert found.looks_like == "boxes normalised by the images' size"
    assert found.iou is None


@pytest.mark.parametrize(
    ("word", "shifted"),
    [
        ("early", np.vstack([BOXES[1:30], BOXES[29:30]])),
        ("late", np.vstack([BOXES[:1], BOXES[:29]])),
        ("late", np.vstack([BOXES[:1] * 0, BOXES[:29]])),
    ],
)
def test_a_shift_by_a_frame_is_named(word: str, shifted: Floats) -> None:
    found = other_reading(TRUTH[:30], shifted)
    assert found is not None
    assert found.looks_like.startswith(f"boxes that are a frame {word}")


@pytest.mark.parametrize("pixels", [1, 2])
def test_a_slow_shift_is_named_where_it_explains_the_rest(pixels: int) -> None:
    truth = np.array([[50 + pixels * i, 40, 20, 10] for i in range(20)], float)
    late, early = np.vstack([truth[:1], truth[:-1]]), np.vstack([truth[1:], truth[-1:]])
    assert "late" in getattr(other_reading(truth, late), "looks_like", "")
    assert "early" in getattr(other_reading(truth, early), "looks_like", "")


@pytest.mark.parametrize(
    "row_0", [BOXES[0], BOXES[0] * 1.9, BOXES[0] / 2, BOXES[0] * 0, BOXES[0] + 20]
)
def test_row_0_alone_says_nothing_of_the_others(row_0: Floats) -> None:
    boxes = np.vstack([row_0, BOXES[1:]])
    assert other_reading(TRUTH, boxes) is None
    assert row_0_is_off(TRUTH, boxes) == (not np.array_equal(row_0, TRUTH[0]))


def test_a_lost_target_is_no_other_coordinate() -> None:
    for lost in (BOXES * 0, BOXES + [150, 0, 0, 0], np.repeat(BOXES[:1], len(BOXES), 0)):
        assert other_reading(TRUTH, np.vstack([BOXES[:1], lost[1:]])) is None


def test_frames_that_are_not_known_say_nothing() -> None:
    nothing = np.full_like(BOXES, np.nan)
    processed = nothing.copy()
    processed[[0, *range(9, 40, 3)]] = by_centre(BOXES)[[0, *range(9, 40, 3)]]
    assert other_reading(nothing, BOXES) is None
    assert other_reading(TRUTH, np.vstack([BOXES[:1], nothing[1:]])) is None
    assert not row_0_is_off(nothing, BOXES)
    found = other_reading(TRUTH, processed)  # as in real time
    assert found is not None
    assert found.looks_like.startswith("boxes by centre")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "D").mkdir()
    for name in "ab":
        np.savetxt(tmp_path / "D" / f"{name}.txt", TRUTH, "%g", ",")
    return tmp_path


def test_row_0_is_the_truth_only_where_it_was_far_off(folder: Path) -> None:
    near = np.vstack([BOXES[:1] + 3, BOXES[1:]])
    np.savez(folder / "t.npz", a=np.vstack([BOXES[:1] * 1.9, BOXES[1:]]), b=near)
    trace, summary = convert_results(folder / "t.npz", folder / "D", time="constant:47ms")
    np.testing.assert_array_equal(trace["a"].boxes, np.vstack([TRUTH[:1], BOXES[1:]]))
    np.testing.assert_array_equal(trace["b"].boxes, near)
    assert summary.row_0_from_truth == ["a"]
    entries = trace.metadata.document["sequences"]
    assert [name for name, entry in entries.items() if "row_0_from_truth" in entry] == ["a"]


def test_other_coordinates_are_refused(folder: Path) -> None:
    np.savez(folder / "t.npz", a=BOXES, b=by_centre(BOXES))
    with pytest.raises(LaeError, match=r"'b'.*boxes by centre.*0\.\d\d so read; subtract w/2"):
        convert_results(folder / "t.npz", folder / "D", time="constant:47ms")
    convert_results(folder / "t.npz", folder / "D", time="constant:47ms", exclude=["b"])


@given(st.integers(0, 12), st.integers(0, 2**32))
def test_any_numbers_that_a_trace_may_hold(length: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    values = [0, 1, -1, 5e-324, 1e-9, 0.5, 5, 50, 1e9, -1e9, *TRUTH[0], *by_centre(TRUTH)[0]]
    truth, boxes = random.choice(values, (2, length, 4))
    truth[random.random(length) < 0.2] = np.nan
    boxes[random.random(length) < 0.2] = np.nan
    found = other_reading(truth, boxes)  # a warning would be an error
    assert found is None or found.iou is None or found.iou > found.iou_as_is
    assert not (row_0_is_off(truth, boxes) and np.isnan(boxes[0]).any())


Published = list[tuple[str, Floats, Floats]]


@pytest.fixture(scope="module")
def published(shared_data: Path) -> Published:
    """Every published result with truth of as many frames: its name, truth and boxes."""
    return list(_published(shared_data))


def _published(shared_data: Path) -> Iterator[tuple[str, Floats, Floats]]:
    results = (shared_data / "results_boxes").glob("*/*.npz")
    for path in [*results, *(shared_data / "results_with_times").glob("*/*")]:
        truth = find_truth(shared_data / path.parent.name)
        names = SequenceNames(truth.files)
        kind, sources = find_results(path, "auto", 1)
        for source in sources:
            reading = names.read(source.name)
            if reading is None:
                continue
            name = reading.sequence
            boxes = read_results(kind, source, 1, None, measured=False).boxes
            answers = read_truth(truth.files[name])
            if len(answers) == len(boxes):
                yield f"{path.stem} {name}", answers, boxes


def test_published_results_are_let_through(published: Published) -> None:
    assert len(published) > 1000
    assert not [name for name, *rows in published if other_reading(*rows) or row_0_is_off(*rows)]
    for scale in (0.5, 1.9):  # as in TADT's on DTB70
        for name, truth, boxes in published:
            assert other_reading(truth, np.vstack([boxes[:1] * scale, boxes[1:]])) is None, name


@pytest.mark.parametrize("change", [by_centre, corners, lambda b: b / 2, lambda b: b / SIZE])
def test_published_results_in_other_coordinates_are_not(
    published: Published, change: Callable[[Floats], Floats]
) -> None:
    found = [other_reading(truth, change(boxes)) for _, truth, boxes in published]
    assert sum(other is not None for other in found) > 0.85 * len(found)
