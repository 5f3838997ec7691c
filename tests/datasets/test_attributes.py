import re

import pytest
from annotated import make

from lae_sim.datasets.annotations import find_truth
from lae_sim.datasets.attributes import Attributes, read_attributes


def test_attributes_csv(tmp_path):
    make(tmp_path, "D/anno/a.txt", "D/anno/b.txt")
    make(tmp_path, "D/attributes.csv", text="sequence,Occlusion,Fast motion\na,1,0\nb,1,1\nc,0,0\n")
    expected = {"a": ("Occlusion",), "b": ("Occlusion", "Fast motion")}
    assert read_attributes(find_truth(tmp_path / "D")) == Attributes(expected)
    assert read_attributes(find_truth(tmp_path / "D" / "anno")) == Attributes(expected)


@pytest.mark.parametrize(
    ("truth", "flags", "count", "first"),
    [
        ("UAV123/anno/UAV123/bike1.txt", "UAV123/anno/UAV123/att/bike1.txt", 12, "Scale variation"),
        ("DTB70/anno/bike1.txt", "DTB70/anno/att/bike1.txt", 11, "Scale variation"),
        ("DTB70/anno/bike1.txt", "DTB70/anno/att/bike1.txt", 10, "Scale variation"),
        ("UAVDT/anno/bike1_gt.txt", "UAVDT/att/bike1_att.txt", 9, "Background clutter"),
        ("V/annotations/bike1.txt", "V/attributes/bike1_attr.txt", 12, "Aspect Ratio Change"),
    ],
)
def test_official_attribute_folders(tmp_path, truth, flags, count, first):
    make(tmp_path, truth)
    make(tmp_path, flags, text=",".join(["1"] + ["0"] * (count - 1)) + "\n")
    found = find_truth(tmp_path / truth.split("/")[0])
    assert list(found.files) == ["bike1"]
    assert read_attributes(found) == Attributes({"bike1": (first,)})
    make(tmp_path, flags, text="1,0,1\n")
    left_out = read_attributes(found)
    assert left_out.of == {}
    (note,) = left_out.notes
    assert note.startswith(f"attributes of 1 of 1 sequences are left out, such as {tmp_path}")
    assert re.search(rf"needs .*\b{count}\b.* flags 0 or 1\Z", note)


@pytest.mark.parametrize(
    "text", ["sequence,A\na,2\n", "sequence,A\na\n", "sequence,A\na,yes\n", ""]
)
def test_damaged_attributes(tmp_path, text):
    make(tmp_path, "a.txt")
    make(tmp_path, "attributes.csv", text=text)
    attributes = read_attributes(find_truth(tmp_path))
    assert attributes.of == {}
    assert attributes.notes[0].startswith(f"attributes are left out: {tmp_path / 'attributes.csv'}")


def test_one_damaged_file_of_flags_costs_its_own_sequence_only(tmp_path):
    make(tmp_path, "anno/a.txt", "anno/b.txt")
    make(tmp_path, "anno/att/a.txt", text="0,1,0,1,0,1,0,0,1,0,1\n")
    make(tmp_path, "anno/att/b.txt", text="<html>")
    attributes = read_attributes(find_truth(tmp_path))
    # the official order: perfPlot.m of https://github.com/flyers/drone-tracking, then motion blur
    assert attributes.of == {
        "a": (
            "Aspect ratio variation",
            "Deformation",
            "In-plane rotation",
            "Background clutter",
            "Motion blur",
        )
    }
    assert "b.txt: looks like a web page" in attributes.notes[0]


def test_attributes_without_a_header_are_left_out(tmp_path):
    make(tmp_path, "a.txt", text="1,2,3,4\n")
    make(tmp_path, "attributes.csv", text="\n\n")
    (note,) = read_attributes(find_truth(tmp_path)).notes
    assert note.endswith(
        "attributes.csv, line 1: needs a header: sequence, and the attributes' names"
    )
