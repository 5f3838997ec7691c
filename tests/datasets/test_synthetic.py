from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import lae_sim.datasets.synthetic
from lae_sim.datasets.synthetic import synthetic_dataset
from lae_sim.errors import LaeError

cv2 = pytest.importorskip("cv2", reason="frames are drawn with OpenCV")

DTB70 = {
    "Scale variation",
    "Aspect ratio variation",
    "Occlusion",
    "Deformation",
    "Fast camera motion",
    "In-plane rotation",
    "Out-of-view",
    "Background clutter",
    "Similar objects around",
    "Motion blur",
}
SCENES = {scene.name: scene for scene in lae_sim.datasets.synthetic._SCENES}
SEQUENCES = {sequence.name: sequence for sequence in synthetic_dataset().sequences}


def test_the_dataset():
    dataset = synthetic_dataset()
    assert (dataset.name, dataset.fps) == ("synthetic", 30)
    names = [sequence.name for sequence in dataset.sequences]
    assert names == sorted(set(names))
    assert len(names) == 12
    assert {attribute for each in dataset.sequences for attribute in each.attributes} == DTB70


def test_attributes_are_dtb70s(shared_data):
    header = (shared_data / "DTB70" / "attributes.csv").read_text().splitlines()[0]
    assert set(header.split(",")[1:]) > DTB70


@pytest.mark.parametrize("seed", range(4))
def test_truth_of_any_seed(seed):
    for sequence in synthetic_dataset(seed).sequences:
        truth = sequence.truth
        assert truth.shape == (160, 4)
        assert np.isfinite(truth[0]).all()
        known = truth[np.isfinite(truth).all(axis=1)]
        assert len(known) == np.isfinite(truth[:, 0]).sum() > 80
        assert (known[:, 2:] > 9).all()
        assert (known[:, :2] < (640, 360)).all()
        assert (known[:, :2] + known[:, 2:] > 0).all()
        x, y, w, h = truth[0]
        assert min(x, y, 640 - x - w, 360 - y - h) > -5


def test_frames_are_the_same_in_any_order_and_from_threads():
    frames = [0, 80, 159, 3]
    for name in ("herd", "van"):
        forward = [SEQUENCES[name].read(frame) for frame in frames]
        SEQUENCES["car"].read(0)  # another sequence between them
        SEQUENCES[name].read(1)
        with ThreadPoolExecutor(3) as pool:
            again = list(pool.map(SEQUENCES[name].read, reversed(frames)))
        for image, other in zip(forward, reversed(again)):
            assert (image.shape, image.dtype) == ((360, 640, 3), np.uint8)
            assert np.array_equal(image, other)


def test_a_frame_can_be_drawn_into():
    image = SEQUENCES["car"].read(5)
    kept = image.copy()
    image[:] = 0
    assert np.array_equal(SEQUENCES["car"].read(5), kept)


def test_another_seed_is_another_dataset():
    other = synthetic_dataset(1).sequences[2]
    assert other.name == "car"
    assert not np.allclose(other.truth, SEQUENCES["car"].truth, equal_nan=True)
    assert not np.array_equal(other.read(0), SEQUENCES["car"].read(0))


@pytest.mark.parametrize("name", ["boat", "chase", "cyclist", "van"])
def test_the_truth_is_the_box_of_what_is_drawn(name):
    """The target drawn white on black, alone."""
    film = lae_sim.datasets.synthetic._Film(SCENES[name])
    body = film._layers[-1 - SCENES[name].covers]
    white = np.repeat(body.picture[..., 3:], 4, axis=2)
    film._layers = [body._replace(picture=white)]
    film._ground[:], film._noise[:] = 0, 32
    compared = 0
    for frame in range(0, 160, 8):
        x, y, w, h = SEQUENCES[name].truth[frame]
        if np.isnan(x) or min(x, y, 640 - x - w, 360 - y - h) < 0:
            continue
        mask = film.draw(frame)[..., 0] > 127
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        drawn = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
        tolerance = 2.5 if SCENES[name].exposure else 1
        assert np.abs(np.array(drawn) - (x, y, x + w, y + h)).max() < tolerance
        compared += 1
    assert compared > 10


def test_motion_is_worth_predicting():
    """Three frames of latency move the target by much of its size, mostly as its speed says."""
    shift, error, size = [], [], []
    for sequence in SEQUENCES.values():
        centre = sequence.truth[:, :2] + sequence.truth[:, 2:] / 2
        shift.append(np.nanmean(np.hypot(*(centre[3:] - centre[:-3]).T)))
        turned = centre[6:] - 2 * centre[3:-3] + centre[:-6]
        error.append(np.nanmean(np.hypot(*turned.T)))
        size.append(np.nanmean(np.sqrt(sequence.truth[:, 2:].prod(axis=1))))
    assert np.mean(np.array(shift) / size) > 0.25
    assert np.mean(error) < 0.5 * np.mean(shift)


def test_covers_hide_the_target_for_a_while():
    path = lae_sim.datasets.synthetic._Path(SCENES["car"])
    turn, there, here = path.camera(np.arange(160.0))
    x, y = (SEQUENCES["car"].truth[:, :2] + SEQUENCES["car"].truth[:, 2:] / 2).T
    near = np.zeros(160, int)
    for cover, width in zip(path.covers, path.crowns):
        near += np.abs(here + turn * (cover - there) - x - 1j * y) < width / 2
    assert not near[:15].any()
    assert 9 < near.sum() < 70


def test_where_the_target_is_out_of_view_there_is_no_truth():
    gone = np.isnan(SEQUENCES["truck"].truth[:, 0])
    assert 5 < gone.sum() < 80
    assert not any(np.isnan(SEQUENCES[name].truth).any() for name in SEQUENCES if name != "truck")


def test_no_such_frame():
    for frame in (-1, 160):
        with pytest.raises(LaeError, match=f"sequence 'car' has no frame {frame}"):
            SEQUENCES["car"].read(frame)
