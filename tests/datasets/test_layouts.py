import csv
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

import lae_sim.datasets.layouts
from lae_sim.datasets.layouts import find_dataset
from lae_sim.errors import LaeError

cv2 = pytest.importorskip("cv2", reason="frames are decoded with OpenCV")


def images(folder, pattern, numbers):
    """Tiny images whose level is their number modulo 256."""
    folder.mkdir(parents=True, exist_ok=True)
    suffix = pattern.rpartition(".")[2]
    encoded = {}
    for number in numbers:
        level = number % 256
        if level not in encoded:
            encoded[level] = cv2.imencode(f".{suffix}", np.full((4, 6), level, np.uint8))[1]
        (folder / (pattern % number)).write_bytes(encoded[level].tobytes())


def truth(path, rows, text="1,2,3,4"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{text}\n" * rows)


def levels(sequence):
    return [int(sequence.read(frame).mean().round()) for frame in (0, len(sequence) - 1)]


def test_dtb70(tmp_path):
    root = tmp_path / "DTB70"
    images(root / "Gull2" / "img", "%05d.jpg", range(1, 6))
    truth(root / "Gull2" / "groundtruth_rect.txt", 5)
    (root / "attributes.csv").write_text("sequence,Scale variation,Occlusion\nGull2,0,1\n")
    dataset = find_dataset(root=root)
    assert (dataset.name, dataset.fps) == ("DTB70", 30)
    (sequence,) = dataset.sequences
    assert (sequence.name, len(sequence), sequence.attributes) == ("Gull2", 5, ("Occlusion",))
    assert sequence.truth.tolist() == [[1, 2, 3, 4]] * 5
    assert levels(sequence) == [1, 5]
    assert sequence.read(0).shape == (4, 6, 3)


@pytest.mark.parametrize(
    ("folder", "pattern", "file", "name"),
    [
        ("UAV-benchmark-S/S0101", "img%06d.jpg", "anno/S0101_gt.txt", "S0101"),
        ("sequences/uav1_s", "img%07d.jpg", "annotations/uav1_s.txt", "uav1_s"),
        ("val/GOT-10k_Val_000001", "%08d.jpg", "val/GOT-10k_Val_000001/groundtruth.txt", ""),
        ("boat/boat-1/img", "%08d.jpg", "boat/boat-1/groundtruth.txt", "boat-1"),
        ("boat-1/img", "%08d.jpg", "boat-1/groundtruth.txt", "boat-1"),
        ("sequences/ants1/color", "%08d.jpg", "sequences/ants1/groundtruth.txt", "ants1"),
        ("ants1", "%08d.jpg", "ants1/groundtruth.txt", "ants1"),
        ("ants1/img", "%d.png", "ants1/groundtruth.txt", "ants1"),
        ("", "frame%d.png", "groundtruth.txt", "data"),
        ("walk", "%d.png", "walk.txt", "walk"),
        ("frames/0-6LB4FqxoE_0", "%d.jpg", "anno/0-6LB4FqxoE_0.txt", "0-6LB4FqxoE_0"),
    ],
)
def test_layouts_are_recognised(tmp_path, folder, pattern, file, name):
    root = tmp_path / "data"
    images(root / folder, pattern, range(1, 13))
    truth(root / file, 12, "0,0,4,0,4,5,0,5" if "ants" in file else "1 2 3 4")
    dataset = find_dataset(root=root)
    (sequence,) = dataset.sequences
    assert sequence.name == (name or "GOT-10k_Val_000001")
    assert dataset.fps == (30 if name else 10)
    assert levels(sequence) == [1, 12]
    assert [int(sequence.read(frame).mean().round()) for frame in range(12)] == list(range(1, 13))


def test_nfs_as_it_is_downloaded(tmp_path):
    row = '0 1 2 4 6 {} {} 0 1 "ball"\n'
    for rate, count in ((30, 2), (240, 16)):
        images(tmp_path / "NfS" / "ball" / str(rate) / "ball", "%05d.jpg", range(1, count + 1))
        path = tmp_path / "NfS" / "ball" / str(rate) / "ball.txt"
        path.write_text("".join(row.format(k, int(k > 8)) for k in range(1, 17)))
        dataset = find_dataset(root=tmp_path / "NfS", fps=rate)
        (ball,) = dataset.sequences
        assert (dataset.name, dataset.fps, ball.name) == ("NfS", rate, "ball")
        assert ball.truth.tolist() == [[1, 2, 3, 4]] * count
        assert levels(ball) == [1, count]
        assert ball.visible.tolist() == [True] * (count // 2) + [False] * (count // 2)
    with pytest.raises(LaeError, match="--fps 30 or --fps 240"):
        find_dataset(root=tmp_path / "NfS")


def test_attributes_that_cannot_be_read_leave_a_note(tmp_path):
    images(tmp_path / "a", "%d.png", range(1, 3))
    truth(tmp_path / "anno" / "a.txt", 2)
    truth(tmp_path / "anno" / "att" / "a.txt", 1, "1,0,1")
    dataset = find_dataset(root=tmp_path)
    assert dataset.sequences[0].attributes == ()
    assert len(dataset.notes) == 1
    assert "a.txt: needs 12 or 11 or 10 flags" in dataset.notes[0]


@pytest.mark.parametrize("split", ["", "test"])
def test_got10k_of_which_only_the_first_box_is_known(tmp_path, split):
    images(tmp_path / "test" / "GOT-10k_Test_000001", "%08d.jpg", range(1, 8))
    truth(tmp_path / "test" / "GOT-10k_Test_000001" / "groundtruth.txt", 1)
    dataset = find_dataset("got10k", tmp_path / split)
    (sequence,) = dataset.sequences
    assert (dataset.name, dataset.fps, len(sequence)) == ("GOT-10k", 10, 7)
    assert sequence.truth[0].tolist() == [1, 2, 3, 4]
    assert np.isnan(sequence.truth[1:]).all()


@pytest.mark.parametrize(
    ("name", "there", "rows", "first"),
    [
        ("David", range(1, 771), 471, 300),
        ("David", range(300, 771), 471, 300),
        ("BlurCar1", range(247, 989), 742, 247),
        ("BlurCar3", range(1, 360), 357, 3),
        ("BlurCar4", range(1, 398), 380, 18),
        ("Tiger1", range(1, 355), 354, 1),
        ("Tiger1", range(1, 355), 349, 6),
        ("Football1", range(1, 80), 74, 1),
        ("Freeman3", range(1, 468), 460, 1),
    ],
)
def test_otb100_starts_late_where_the_benchmark_does(tmp_path, name, there, rows, first):
    images(tmp_path / name / "img", "%04d.jpg", there)
    truth(tmp_path / name / "groundtruth_rect.txt", rows)
    (sequence,) = find_dataset("OTB100", tmp_path).sequences
    assert len(sequence) == rows
    assert levels(sequence) == [first % 256, (first + rows - 1) % 256]


def test_otb100_with_two_targets_in_one_video(tmp_path):
    images(tmp_path / "Jogging" / "img", "%04d.jpg", range(1, 4))
    truth(tmp_path / "Jogging" / "groundtruth_rect.1.txt", 3)
    truth(tmp_path / "Jogging" / "groundtruth_rect.2.txt", 3, "5,5,5,5")
    first, second = find_dataset(root=tmp_path).sequences
    assert (first.name, second.name) == ("Jogging-1", "Jogging-2")
    assert (first.truth[0, 0], second.truth[0, 0]) == (1, 5)
    (chosen,) = find_dataset(root=tmp_path, sequences=["Jogging.2"]).sequences
    assert chosen.name == "Jogging-2"


def test_uav123_and_uav20l_share_a_folder(tmp_path):
    root = tmp_path / "UAV123"
    images(root / "data_seq" / "UAV123" / "car1", "%06d.jpg", range(1, 21))
    images(root / "data_seq" / "UAV123" / "car1_s", "%06d.jpg", range(101, 104))
    for clip, rows in (("car1_1", 6), ("car1_2", 4), ("car1_3", 9), ("car1_s", 3)):
        truth(root / "anno" / "UAV123" / f"{clip}.txt", rows)
    truth(root / "anno" / "UAV20L" / "car1.txt", 18)
    dataset = find_dataset(root=root)
    assert {sequence.name: levels(sequence) for sequence in dataset.sequences} == {
        "car1_1": [1, 6],
        "car1_2": [6, 9],
        "car1_3": [9, 17],
        "car1_s": [101, 103],
    }
    dataset = find_dataset("UAV20L", root)
    assert (dataset.name, [levels(sequence) for sequence in dataset.sequences]) == (
        "UAV20L",
        [[1, 18]],
    )


@pytest.mark.parametrize("name", ["UAV123", "UAV123@10fps", "UAV20L"])
def test_uav123_ranges_are_the_official_ones(tmp_path, shared_data, monkeypatch, name):
    folder = name.replace("@", "_")
    monkeypatch.setattr(
        lae_sim.datasets.layouts,
        "read_image",
        lambda path: SimpleNamespace(number=int(path.stem), folder=path.parent.name),
    )
    with (shared_data / folder / "sequences.csv").open() as file:
        official = {
            row["sequence"]: (row["image_folder"], int(row["start_frame"]), int(row["end_frame"]))
            for row in csv.DictReader(file)
        }
    lengths = {}
    for video, _, last in official.values():
        lengths[video] = max(last, lengths.get(video, 0))
    (tmp_path / "anno").mkdir()
    (tmp_path / "anno" / folder).symlink_to(shared_data / folder / "anno")
    listed = {
        tmp_path / "data_seq" / ("UAV123" if name == "UAV20L" else folder) / video: length
        for video, length in lengths.items()
    }
    monkeypatch.setattr(
        lae_sim.datasets.layouts,
        "_list_images",
        lambda place: [place / f"{k:06}.jpg" for k in range(1, listed.get(place, 0) + 1)],
    )
    dataset = find_dataset(name, tmp_path)
    assert dataset.fps == (10 if "10" in name else 30)
    found = {}
    for sequence in dataset.sequences:
        first, last = sequence.read(0), sequence.read(len(sequence) - 1)
        found[sequence.name] = (first.folder, first.number, last.number)
    assert found == official


def test_real_sequences(shared_data):
    found = {}
    for name in ("DTB70", "OTB100", "UAV123_10fps"):
        dataset = find_dataset(root=shared_data / "frames" / name)
        assert (dataset.name, dataset.fps) == (name, 10 if "10fps" in name else 30)
        for sequence in dataset.sequences:
            found[sequence.name] = len(sequence)
            assert sequence.read(len(sequence) - 1).shape in ((720, 1280, 3), (240, 320, 3))
    assert found == {
        "Gull2": 237,
        "MountainBike6": 81,
        "Couple": 140,
        "Dog1": 1350,
        "boat1": 301,
        "building5": 161,
        "wakeboard7": 67,
    }


def test_images_with_a_first_box(tmp_path):
    images(tmp_path / "walk", "%d.png", range(8, 12))
    dataset = find_dataset(root=tmp_path / "walk", box=(1, 2, 3, 4), fps=Fraction(25))
    (sequence,) = dataset.sequences
    assert (dataset.name, dataset.fps, sequence.name) == ("walk", 25, "walk")
    assert levels(sequence) == [8, 11]
    assert sequence.truth[0].tolist() == [1, 2, 3, 4]
    assert np.isnan(sequence.truth[1:]).all()


def test_video_with_a_first_box(shared_data):
    video = shared_data / "frames" / "bag.avi"
    dataset = find_dataset(root=video, box=(100, 100, 50, 40))
    (sequence,) = dataset.sequences
    assert (dataset.name, dataset.fps, len(sequence)) == ("bag", 25, 196)
    assert sequence.read(195).shape == (360, 480, 3)
    assert find_dataset(root=video, box=(1, 1, 5, 5), fps=Fraction(30)).fps == 30
    with pytest.raises(LaeError, match=r"bag\.avi: a video needs the target's first box: --box"):
        find_dataset(root=video)


def test_synthetic_needs_no_root():
    assert find_dataset().name == find_dataset("synthetic").name == "synthetic"
    (sequence,) = find_dataset("synthetic", sequences=["car"]).sequences
    assert sequence.name == "car"
    with pytest.raises(LaeError, match=r"the synthetic dataset: no sequence 'cat'.*; there is car"):
        find_dataset(sequences=["cat"])
    with pytest.raises(LaeError, match="give the folder of DTB70 with --root"):
        find_dataset("DTB70")


@pytest.fixture
def walk(tmp_path):
    images(tmp_path / "walk" / "img", "%04d.jpg", range(1, 7))
    truth(tmp_path / "walk" / "groundtruth_rect.txt", 6)
    return tmp_path / "walk"


def test_fewer_images_than_annotations(walk):
    (walk / "img" / "0006.jpg").unlink()
    with pytest.raises(LaeError, match=r"'walk': 5 images in .*img, but 6 annotations in .*rect"):
        find_dataset(root=walk)


def test_a_missing_image_in_the_middle(walk):
    images(walk / "img", "%04d.jpg", range(7, 9))
    (walk / "img" / "0003.jpg").unlink()
    with pytest.raises(LaeError, match="'walk': image number 3 is missing"):
        find_dataset(root=walk)


def test_images_named_by_time_may_be_more_than_the_annotations(walk):
    for path in (walk / "img").iterdir():
        path.unlink()
    images(walk / "img", "%d.jpg", range(7, 400, 33))
    (sequence,) = find_dataset(root=walk).sequences
    assert levels(sequence) == [7, 7 + 5 * 33]


def test_a_damaged_image(walk):
    path = walk / "img" / "0003.jpg"
    path.write_bytes(path.read_bytes()[:-40])
    (sequence,) = find_dataset(root=walk).sequences
    assert levels(sequence) == [1, 6]
    with pytest.raises(LaeError, match=r"'walk', frame 2: .*0003\.jpg: cannot be decoded"):
        sequence.read(2)


def test_a_first_box_that_is_none_is_for_the_live_loop_to_refuse(walk):
    (walk / "groundtruth_rect.txt").write_text("0,0,0,0\n" + "1,2,3,4\n" * 5)
    (sequence,) = find_dataset(root=walk).sequences
    assert sequence.truth[0].tolist() == [0, 0, 0, 0]


def test_what_is_missing_is_named(tmp_path, walk):
    with pytest.raises(LaeError, match="nowhere: no such folder"):
        find_dataset(root=tmp_path / "nowhere")
    with pytest.raises(LaeError, match="no sequence 'wakl' among 1; there is walk"):
        find_dataset(root=tmp_path, sequences=["walk", "wakl"])
    with pytest.raises(LaeError, match="has ground truth; --box is for images without"):
        find_dataset(root=walk, box=(1, 2, 3, 4))
    with pytest.raises(LaeError, match=r"clip\.mp4: no such file or folder"):
        find_dataset(root=tmp_path / "clip.mp4", box=(1, 2, 3, 4))
    with pytest.raises(LaeError, match="--box is of a video or images of yours: name them"):
        find_dataset(box=(1, 2, 3, 4))
    truth(tmp_path / "only" / "annotations" / "a.txt", 3)
    with pytest.raises(LaeError, match=r"'a': no images found in .*only.* sequences/a, "):
        find_dataset(root=tmp_path / "only")
    with pytest.raises(LaeError, match="no images there; --box needs a folder of images"):
        find_dataset(root=tmp_path / "only", box=(1, 2, 3, 4))


def test_flags_of_absence_and_what_is_wrong_with_them(tmp_path):
    for name in ("boat-1", "boat-2", "car-1"):
        folder = tmp_path / name.partition("-")[0] / name
        images(folder / "img", "%08d.jpg", range(1, 5))
        truth(folder / "groundtruth.txt", 4)
    (tmp_path / "boat" / "boat-1" / "out_of_view.txt").write_text("0,0,1,0")
    (tmp_path / "boat" / "boat-2" / "out_of_view.txt").write_text("0,0,1")
    dataset = find_dataset(root=tmp_path)
    flags = [sequence.visible for sequence in dataset.sequences]
    assert flags[0].tolist() == [True, True, False, True]
    assert flags[1:] == [None, None]
    [note] = dataset.notes
    assert note.startswith("flags of absence of 1 of 3 sequences are left out, such as ")
    assert note.endswith("out_of_view.txt: 3 flags, and there are 4 frames")
