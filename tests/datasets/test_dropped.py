"""Image numbers with gaps: frames that a camera dropped."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.datasets.dropped import arrivals, missing, numbers_in, step_of
from lae_sim.datasets.layouts import find_dataset, image_numbers
from lae_sim.errors import LaeError

DROPPED = [1, 2, 3, 4, 5, 7, 9, 11, 13, 15]


def sequence(
    root: Path, numbers: list[int], name: str = "ball", pattern: str = "%05d.png", rows: int = 0
) -> None:
    """Images that nobody decodes, and as many rows of truth."""
    folder = root / name / "img"
    folder.mkdir(parents=True)
    for number in numbers:
        (folder / (pattern % number)).touch()
    truth = "1,2,3,4\n" * (rows or len(numbers))
    (root / name / "groundtruth_rect.txt").write_text(truth)


def test_the_number_of_an_image_is_the_last_in_its_name() -> None:
    stems = ["img000012", "cam2_0007", "9", "frame", "0300"]
    assert numbers_in(stems) == [12, 7, 9, -1, 300]


def test_a_number_that_all_names_share_is_not_that_of_the_image() -> None:
    assert numbers_in(["cam2_0007_640x480", "cam2_0009_640x480"]) == [7, 9]
    assert numbers_in(["0001_v2"]) == [2]
    assert numbers_in([]) == []


@pytest.mark.parametrize(
    ("numbers", "gone"),
    [
        (DROPPED, [6, 8, 10, 12]),
        ([300, 301, 302], []),  # starts late
        ([1, 4, 7, 10], []),  # every third
        ([1, 4, 10, 13], [7]),  # every third, and one was dropped
        ([1, 3], []),  # nobody can tell
        ([7], []),
        ([], []),
        ([-1, -1, -1], []),  # no numbers
        ([1, 1, 2], []),  # one twice
        ([3, 2, 1], []),
        ([0, 33, 66, 100, 133, 166, 200], []),  # milliseconds
        ([1, 2, 3, 10**18], [4, 5, 6, 7]),
    ],
)
def test_what_is_missing(numbers: list[int], gone: list[int]) -> None:
    assert missing(numbers) == gone


@given(st.sets(st.integers(0, 60), min_size=2), st.sampled_from(["30", "25", "30000/1001"]))
def test_arrivals_are_the_nearest_ns(kept: set[int], rate: str) -> None:
    numbers, fps = sorted(kept), Fraction(rate)
    step = step_of(numbers) or 1
    found = arrivals(numbers, fps)
    assert found[0] == 0
    if step_of(numbers):
        for number, ns in zip(numbers, found.tolist()):
            exact = Fraction((number - numbers[0]) * 10**9, step) / fps
            assert abs(ns - exact) <= Fraction(1, 2)
    else:
        assert found.tolist() == arrivals(range(len(numbers)), fps).tolist()


def test_half_a_ns_is_rounded_to_even() -> None:
    assert arrivals([1, 2, 3, 5], Fraction(2 * 10**9, 5)).tolist() == [0, 2, 5, 10]


def test_times_beyond_64_bits() -> None:
    with pytest.raises(LaeError, match="image number 1000000000000000000 at 30 frames/s: too long"):
        arrivals([1, 2, 3, 10**18], Fraction(30))


def test_a_gap_is_a_question(tmp_path: Path) -> None:
    sequence(tmp_path, [1, 2, 3], "a")
    sequence(tmp_path, DROPPED)
    question = r"sequence 'ball': no image number 6, 8, 10, \.\.\.: did the camera drop"
    with pytest.raises(LaeError, match=question) as error:
        find_dataset(root=tmp_path)
    assert "--frame-times numbers" in str(error.value)
    assert "--frame-times even" in str(error.value)
    with pytest.raises(LaeError, match="at 10 frames/s"):
        find_dataset(root=tmp_path, fps=10)
    assert len(find_dataset(root=tmp_path, sequences="a").sequences) == 1
    with pytest.raises(LaeError, match="frame times: no 'both': there are numbers and even"):
        find_dataset(root=tmp_path, frame_times="both")


def test_frames_at_the_times_of_their_numbers_or_evenly(tmp_path: Path) -> None:
    sequence(tmp_path, [1, 2, 3], "a")
    sequence(tmp_path, DROPPED)
    placed = find_dataset(root=tmp_path, frame_times="numbers", fps=25)
    whole, ball = placed.sequences
    assert whole.arrival_ns is not None
    assert ball.arrival_ns is not None
    assert whole.arrival_ns.tolist() == [0, 40_000_000, 80_000_000]
    assert ball.arrival_ns.tolist() == [(n - 1) * 40_000_000 for n in DROPPED]
    assert placed.frame_times == "numbers"
    even = find_dataset(root=tmp_path, frame_times="even")
    assert [each.arrival_ns for each in even.sequences] == [None, None]
    assert list(even.notes) == [
        "image numbers are missing in ball: the images come evenly, as if none were missing "
        "(--frame-times even)",
    ]


@pytest.mark.parametrize(
    ("numbers", "pattern"),
    [
        (range(1, 10), "%d.jpg"),
        (range(1, 10), "%08d.jpg"),
        (range(300, 320), "%04d.jpg"),
        (range(0, 30, 3), "img%06d.jpg"),
        ([1], "%d.png"),
    ],
)
def test_datasets_without_gaps_are_as_they_were(
    tmp_path: Path, numbers: list[int], pattern: str
) -> None:
    sequence(tmp_path, list(numbers), pattern=pattern)
    for frame_times in (None, "numbers", "even"):
        dataset = find_dataset(root=tmp_path, frame_times=frame_times)
        assert (dataset.frame_times, list(dataset.notes)) == (None, [])
        assert dataset.sequences[0].arrival_ns is None


def test_images_with_a_first_box_alone(tmp_path: Path) -> None:
    sequence(tmp_path, DROPPED)
    folder = tmp_path / "ball" / "img"
    with pytest.raises(LaeError, match="sequence 'img': no image number 6, 8, 10"):
        find_dataset(root=folder, box=[1, 2, 3, 4])
    (found,) = find_dataset(root=folder, box=[1, 2, 3, 4], frame_times="numbers").sequences
    assert found.arrival_ns is not None
    assert found.arrival_ns[-1] == round(Fraction(14 * 10**9, 30))


def test_numbers_beside_the_ground_truth(tmp_path: Path) -> None:
    sequence(tmp_path, DROPPED)
    file = tmp_path / "ball" / "groundtruth_rect.txt"
    assert image_numbers(tmp_path, "ball", file, 10) == DROPPED
    assert image_numbers(tmp_path, "ball", file, 7) == DROPPED[:7]
    assert image_numbers(tmp_path, "ball", file, 15) == []
    assert image_numbers(tmp_path, "other", tmp_path / "other" / "groundtruth.txt", 10) == []
