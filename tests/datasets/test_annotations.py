import tempfile
from pathlib import Path

import numpy as np
import pytest
from annotated import make
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.datasets.annotations import find_truth, read_truth
from lae_sim.datasets.attributes import read_attributes
from lae_sim.datasets.nfs import read_lost
from lae_sim.errors import LaeError

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
    make(tmp_path, "sets/DTB70/Gull2/groundtruth_rect.txt")
    with pytest.raises(LaeError, match=r"DTB70 has some: give the folder of one dataset"):
        find_truth(tmp_path / "sets")
    with pytest.raises(LaeError, match="no such folder"):
        find_truth(tmp_path / "none")


def test_missing_truth_is_nan_and_zeros_stay(tmp_path):
    make(tmp_path, "a.txt", text="1,2,3,4\nNaN,NaN,NaN,NaN\n0,0,0,0\n")
    boxes = read_truth(tmp_path / "a.txt")
    assert np.isnan(boxes[1]).all()
    assert boxes[[0, 2]].tolist() == [[1, 2, 3, 4], [0, 0, 0, 0]]


def test_rows_of_vot_without_a_target(tmp_path):
    text = "1,2,5,1,6,7,0,8\n0\nnan,nan,nan,nan\nNaN,NaN,NaN,NaN,NaN,NaN,NaN,NaN\n1,2,5,1,6,7,0,8\n"
    make(tmp_path, "a.txt", text=text)
    boxes = read_truth(tmp_path / "a.txt")
    assert np.isnan(boxes[1:4]).all()
    assert boxes[[0, 4]].tolist() == [[0, 1, 6, 7], [0, 1, 6, 7]]


ROWS = [
    "1,2,3,4",
    "1\t2\t3\t4",
    "1.5, 2, 3, 4",
    "1,2,5,1,6,7,0,8",
    "0",
    "nan",
    "NaN,NaN,NaN,NaN",
    "1,2,NaN,4",
    '0 1 2 3 4 {} 0 0 0 "x"',
    '0 1 2 3 4 {} 1 1 1 "a b" more',
    '1 1 2 3 4 {} 0 0 0 "x"',
    "0 1 2 3 4 {} 0 0 0",
    "x,y,w,h",
    "1,5;2,5",
    "m1,2,3,4,5,6",
    "[1, 2, 3, 4]",
    "<xml>",
    "",
    "1e999,1,1,1",
    "\0\ud83d",
]


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(ROWS), st.integers(0, 12)), max_size=9),
    st.one_of(st.none(), st.integers(1, 12)),
)
def test_any_rows_are_boxes_or_a_clear_refusal(rows, frames):
    text = "\n".join(row.replace("{}", str(frame)) for row, frame in rows)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.txt")
        path.write_bytes(text.encode("utf-8", "replace"))
        refusal = None
        try:
            boxes, lost = read_truth(path, frames), read_lost(path, frames)
        except LaeError as error:
            refusal = str(error)
        if refusal is not None:
            assert refusal.startswith(str(path))
            return
        assert boxes.dtype == np.float64
        assert boxes.shape == (len(boxes), 4)
        known = np.isfinite(boxes)
        assert (known.all(axis=1) == known.any(axis=1)).all()
        if lost is not None:
            assert lost.shape == (len(boxes),)


@pytest.mark.parametrize(
    ("file", "text", "what"),
    [
        ("annotations/instances.json", '{"images": [{"file_name": "1.jpg"}]}', "COCO's JSON"),
        ("MOT17-02/gt/gt.txt", "1,1,10,20,30,40,1,1,0.8\n", "MOT's format"),
        ("Annotations/1.xml", "<annotation><object/></annotation>", "XML"),
        ("OTB.zip", "PK\3\4", r"an archive \(zip\); unpack it"),
    ],
)
def test_what_is_there_instead_of_truth(tmp_path, file, text, what):
    make(tmp_path, file, text=text)
    with pytest.raises(LaeError, match=f"no ground truth found; .*{file} looks like {what}"):
        find_truth(tmp_path)


def test_polygons_become_boxes_around_them(tmp_path):
    text = "1,2,5,1,6,7,0,8\nNaN,NaN,NaN,NaN,NaN,NaN,NaN,NaN\n"
    make(tmp_path, "a.txt", text=text)
    boxes = read_truth(tmp_path / "a.txt")
    assert boxes[0].tolist() == [0, 1, 6, 7]
    assert np.isnan(boxes[1]).all()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("1,2,3\n", "3 columns; ground truth has 4"),
        ("1,2,3,4\n1,2,NaN,4\n", "line 2: NaN in some"),
        ("1,2,3,4\n1,2,3,4,5,6,7,8\n", "line 2: 8 columns"),
        ("0\n0\n", "1 columns; ground truth has 4"),
        ("x,y,w,h\n1,2,3,4\n", "line 1: 'x' is not a number; the line looks like a header"),
        ("10,5;20,5;30,0;40,0\n", "line 1: .* decimal points, and one separator"),
        ("0.1,0.2,0.05,0.1\n0.1,0.2,0.05,0.1\n", "looks like boxes in parts of the image"),
        ("0 0.5 0.5 0.1 0.2\n2 0.4 0.1 0.2 0.2\n", "looks like YOLO's format"),
        ("1,1,10,20,30,40,1,1,0.8\n2,1,10,20,30,40,1,1,0.9\n", "MOT's format .*keep x,y,w,h of"),
        ("1,-1,10,20,30,40,0.9\n1,-1,10,20,30,40,0.9\n", "MOT's format"),
        ("100,90,30,40,1,4,0,1\n", "VisDrone's detections"),
        ("100,5,90,2,30,0,40,0\n100,5,90,5,30,0,40,1\n", "x, y, w, h with decimal commas"),
        ("m12,40,10,20,0,4\nm12,40,10,20,0,4\n", "masks of VOT"),
    ],
)
def test_bad_truth(tmp_path, text, problem):
    make(tmp_path, "a.txt", text=text)
    with pytest.raises(LaeError, match=problem):
        read_truth(tmp_path / "a.txt")


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
    found = read_attributes(truth).of
    assert len(found) == (sequences if attributes else 0)
    assert len({name for names in found.values() for name in names}) == attributes
