import numpy as np
import pytest

from lae_sim.datasets.annotations import find_truth, read_attributes, read_truth
from lae_sim.errors import LaeError

BOXES = "10,20,30,40\n11,21,30,40\n"


def make(root, *files, text=BOXES):
    for file in files:
        path = root / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


LAYOUTS = {
    "DTB70": ["DTB70/Animal1/groundtruth_rect.txt", "DTB70/BMX2/groundtruth_rect.txt"],
    "UAVDT": ["UAVDT/anno/S0101_gt.txt", "UAVDT/anno/S0102_gt.txt"],
    "UAV123": ["UAV123/anno/UAV123/bike1.txt", "UAV123/anno/UAV20L/bird1.txt"],
    "UAV20L": ["UAV20L/anno/UAV20L/bike1.txt"],
    "UAV123_10fps": ["UAV123_10fps/anno/UAV123_10fps/bike1.txt"],
    "VisDrone": ["VisDrone/annotations/uav0000011_00000_s.txt"],
    "OTB100": [
        "OTB100/Jogging/groundtruth_rect.1.txt",
        "OTB100/Jogging/groundtruth_rect.2.txt",
        "OTB100/Human4/groundtruth_rect.2.txt",
        "OTB100/Tiger1/groundtruth_rect.txt",
    ],
    "GOT-10k": [
        "GOT-10k/test/GOT-10k_Test_000001/groundtruth.txt",
        "GOT-10k/val/GOT-10k_Val_000001/groundtruth.txt",
    ],
    "LaSOT": ["LaSOT/boat/boat-1/groundtruth.txt", "LaSOT/cat/cat-20/groundtruth.txt"],
    "LaSOT_flat": ["LaSOT_flat/boat-1/groundtruth.txt"],
    "VOT": ["VOT/sequences/ants1/groundtruth.txt", "VOT/sequences/list.txt"],
    "flat": ["flat/anno/a.txt", "flat/anno/b.txt"],
    "bare": ["bare/a.txt", "bare/b.txt", "bare/README.txt", "bare/list.txt"],
}
NAMES = {
    "DTB70": ["Animal1", "BMX2"],
    "UAVDT": ["S0101", "S0102"],
    "UAV123": ["bike1"],
    "UAV20L": ["bike1"],
    "UAV123_10fps": ["bike1"],
    "VisDrone": ["uav0000011_00000_s"],
    "OTB100": ["Human4-2", "Jogging-1", "Jogging-2", "Tiger1"],
    "GOT-10k": ["GOT-10k_Test_000001", "GOT-10k_Val_000001"],
    "LaSOT": ["boat-1", "cat-20"],
    "LaSOT_flat": ["boat-1"],
    "VOT": ["ants1"],
    "flat": ["a", "b"],
    "bare": ["a", "b"],
}


@pytest.mark.parametrize("dataset", LAYOUTS)
def test_layouts(tmp_path, dataset):
    truth = find_truth(make(tmp_path, *LAYOUTS[dataset]) / dataset)
    assert list(truth.files) == NAMES[dataset]
    assert truth.dataset == dataset
    for path in truth.files.values():
        assert read_truth(path).tolist() == [[10, 20, 30, 40], [11, 21, 30, 40]]


def test_annotation_folder_itself(tmp_path):
    make(tmp_path, *LAYOUTS["UAV123"])
    truth = find_truth(tmp_path / "UAV123" / "anno" / "UAV20L")
    assert (truth.dataset, list(truth.files)) == ("UAV20L", ["bird1"])


def test_one_sequence_folder_and_one_file(tmp_path):
    make(tmp_path, "DTB70/Gull2/groundtruth_rect.txt", "DTB70/Gull2/img/00001.jpg", "x.txt")
    assert list(find_truth(tmp_path / "DTB70" / "Gull2").files) == ["Gull2"]
    assert list(find_truth(tmp_path / "DTB70" / "Gull2" / "groundtruth_rect.txt").files) == [
        "Gull2"
    ]
    assert list(find_truth(tmp_path / "x.txt").files) == ["x"]


def test_several_sets_of_annotations(tmp_path):
    make(tmp_path, "all/anno/UAV123/bike1.txt", "all/anno/UAV20L/bike1.txt")
    with pytest.raises(LaeError, match=r"UAV123, UAV20L; give one of them, such as .*UAV"):
        find_truth(tmp_path / "all")


def test_nothing_found(tmp_path):
    with pytest.raises(LaeError, match="no ground truth found"):
        find_truth(tmp_path)
    with pytest.raises(LaeError, match="no such folder"):
        find_truth(tmp_path / "none")


def test_missing_truth_is_nan_and_zeros_stay(tmp_path):
    make(tmp_path, "a.txt", text="1,2,3,4\nNaN,NaN,NaN,NaN\n0,0,0,0\n")
    boxes = read_truth(tmp_path / "a.txt")
    assert np.isnan(boxes[1]).all()
    assert boxes[[0, 2]].tolist() == [[1, 2, 3, 4], [0, 0, 0, 0]]


def test_polygons_become_boxes_around_them(tmp_path):
    text = "1,2,5,1,6,7,0,8\nNaN,NaN,NaN,NaN,NaN,NaN,NaN,NaN\n"
    make(tmp_path, "a.txt", text=text)
    boxes = read_truth(tmp_path / "a.txt")
    assert boxes[0].tolist() == [0, 1, 6, 7]
    assert np.isnan(boxes[1]).all()


@pytest.mark.parametrize(
    ("text", "problem"),
    [("1,2,3\n", "3 columns; ground truth has 4"), ("1,2,3,4\n1,2,NaN,4\n", "line 2: NaN in some")],
)
def test_bad_truth(tmp_path, text, problem):
    make(tmp_path, "a.txt", text=text)
    with pytest.raises(LaeError, match=problem):
        read_truth(tmp_path / "a.txt")


def test_attributes_csv(tmp_path):
    make(tmp_path, "D/anno/a.txt", "D/anno/b.txt")
    make(tmp_path, "D/attributes.csv", text="sequence,Occlusion,Fast motion\na,1,0\nb,1,1\nc,0,0\n")
    expected = {"a": ("Occlusion",), "b": ("Occlusion", "Fast motion")}
    assert read_attributes(find_truth(tmp_path / "D")) == expected
    assert read_attributes(find_truth(tmp_path / "D" / "anno")) == expected


@pytest.mark.parametrize(
    ("truth", "flags", "count", "first"),
    [
        ("UAV123/anno/UAV123/bike1.txt", "UAV123/anno/UAV123/att/bike1.txt", 12, "Scale variation"),
        ("UAVDT/anno/bike1_gt.txt", "UAVDT/att/bike1_att.txt", 9, "Background clutter"),
        ("V/annotations/bike1.txt", "V/attributes/bike1_attr.txt", 12, "Aspect Ratio Change"),
    ],
)
def test_official_attribute_folders(tmp_path, truth, flags, count, first):
    make(tmp_path, truth)
    make(tmp_path, flags, text=",".join(["1"] + ["0"] * (count - 1)) + "\n")
    found = find_truth(tmp_path / truth.split("/")[0])
    assert list(found.files) == ["bike1"]
    assert read_attributes(found) == {"bike1": (first,)}
    make(tmp_path, flags, text="1,0,1\n")
    with pytest.raises(LaeError, match=f"needs {count} flags"):
        read_attributes(found)


@pytest.mark.parametrize(
    "text", ["sequence,A\na,2\n", "sequence,A\na\n", "sequence,A\na,yes\n", ""]
)
def test_damaged_attributes(tmp_path, text):
    make(tmp_path, "a.txt")
    make(tmp_path, "attributes.csv", text=text)
    with pytest.raises(LaeError, match=r"attributes\.csv"):
        read_attributes(find_truth(tmp_path))


@pytest.mark.parametrize(
    ("dataset", "sequences", "frames", "attributes"),
    [
        ("DTB70", 70, 15_777, 11),
        ("UAVDT", 50, 37_084, 9),
        ("UAV20L", 20, 58_670, 12),
        ("VisDrone-SOT-test-dev", 35, 32_922, 12),
        ("OTB100", 100, 59_035, 0),
    ],
)
def test_real_datasets(shared_data, dataset, sequences, frames, attributes):
    truth = find_truth(shared_data / dataset)
    assert (truth.dataset, len(truth.files)) == (dataset, sequences)
    assert sum(len(read_truth(path)) for path in truth.files.values()) == frames
    found = read_attributes(truth)
    assert len(found) == (sequences if attributes else 0)
    assert len({name for names in found.values() for name in names}) == attributes
