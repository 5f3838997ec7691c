"""Names of results files."""

from __future__ import annotations

import pytest

from lae_sim.datasets.names import ResultsName, SequenceNames
from lae_sim.errors import LaeError

OTB = ["Tiger1", "bike1", "Jogging-1", "Jogging-2", "Human4-2", "person1", "person1_s"]


@pytest.mark.parametrize(
    ("written", "sequence", "tracker"),
    [
        ("Tiger1", "Tiger1", None),
        ("tiger1", "Tiger1", None),
        ("uav_bike1", "bike1", None),
        ("nfs_bike1", "bike1", None),
        ("otb_jogging_1", "Jogging-1", None),
        ("lasot_Tiger1", "Tiger1", None),
        ("Jogging.1", "Jogging-1", None),
        ("Jogging_2", "Jogging-2", None),
        ("Human4", "Human4-2", None),
        ("HUMAN4", "Human4-2", None),
        ("otb_human4_X", "Human4-2", "X"),
        ("bike1_KCF", "bike1", "KCF"),
        ("bike1_KCF_GaussHog", "bike1", "KCF_GaussHog"),
        ("KCF_GaussHog_bike1", "bike1", "KCF_GaussHog"),
        ("nfs_bike1_KCF", "bike1", "KCF"),
        ("Human4_2_C-COT", "Human4-2", "C-COT"),
        ("Human4_C-COT", "Human4-2", "C-COT"),
        ("Jogging_1_X", "Jogging-1", "X"),
        ("jogging.1_X", "Jogging-1", "X"),
        ("person1_s_ECO", "person1_s", "ECO"),
        ("person1_ECO", "person1", "ECO"),
        ("ECO_person1_s", "person1_s", "ECO"),
    ],
)
def test_a_name_means_a_sequence_and_perhaps_a_tracker(
    written: str, sequence: str, tracker: str | None
) -> None:
    assert SequenceNames(OTB).read(written) == ResultsName(sequence, tracker)


@pytest.mark.parametrize(
    "written", ["nothing", "person12_ECO", "bike1KCF", "", "_", "_bike", "2", "bike1_2", "bike1_s"]
)
def test_a_name_that_fits_nothing(written: str) -> None:
    assert SequenceNames(OTB).read(written) is None


def test_what_fits_as_it_stands_comes_first() -> None:
    names = SequenceNames(["car", "Car", "car_1", "car-1", "uav_car"])
    for name in ("car", "Car", "car_1", "car-1", "uav_car"):
        assert names.read(name) == ResultsName(name)


@pytest.mark.parametrize(
    ("written", "known"),
    [
        ("Jogging", ["Jogging-1", "Jogging-2"]),
        ("Jogging_X", ["Jogging-1", "Jogging-2"]),
        ("CAR", ["Car", "car"]),
        ("car.1_X", ["car-1", "car_1"]),
    ],
)
def test_two_sequences_that_fit_as_well_are_a_question(written: str, known: list[str]) -> None:
    with pytest.raises(LaeError, match=f"is it of sequence {known[0]} or {known[1]}\\?"):
        SequenceNames(known).read(written)


def test_the_tracker_that_is_asked_for_tells_splits_apart() -> None:
    names = SequenceNames(["person1", "person1_s"])
    assert names.read("person1_s_KCF", "s_KCF") == ResultsName("person1", "s_KCF")
    assert names.read("person1_s_KCF", "KCF") == ResultsName("person1_s", "KCF")
    assert names.read("person1_s", "s") == ResultsName("person1_s")
