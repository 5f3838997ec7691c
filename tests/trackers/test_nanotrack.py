from __future__ import annotations

import hashlib
from time import perf_counter_ns

import numpy as np
import onnx_models
import pytest
from moving import centre_error, cv2, moving, straight

from lae_sim.boxes import iou
from lae_sim.datasets.frames import read_image
from lae_sim.errors import LaeError
from lae_sim.trackers.names import make_tracker
from lae_sim.trackers.stages import listening


@pytest.fixture(params=["nanotrackv2", "nanotrackv3"])
def weights(request, shared_data):
    return shared_data / "weights" / request.param


def real(shared_data, sequence, count):
    folder = shared_data / "frames" / sequence
    truth = np.loadtxt(folder / "groundtruth_rect.txt", delimiter=",")[:count]
    return [read_image(folder / "img" / f"{i + 1:05d}.jpg") for i in range(count)], truth


def boxes_of(tracker, frames, box):
    tracker.init(frames[0], box)
    return np.array([tracker.track(frame)[0] for frame in frames[1:]])


def test_follows_a_real_target(shared_data, weights):
    frames, truth = real(shared_data, "DTB70/MountainBike6", 40)
    tracker = make_tracker("nanotrack", {"weights": str(weights)})
    overlap = iou(boxes_of(tracker, frames, truth[0]), truth[1:])
    assert overlap.mean() > 0.7
    assert overlap.min() > 0.4


def test_version_3_answers_as_its_authors_published(shared_data):
    frames, truth = real(shared_data, "DTB70/MountainBike6", 40)
    with np.load(shared_data / "results_boxes" / "DTB70" / "NanoTrackV3.npz") as file:
        published = file["MountainBike6"][:40].astype(float)
    tracker = make_tracker("nanotrack", {"weights": str(shared_data / "weights" / "nanotrackv3")})
    found = boxes_of(tracker, frames, truth[0])
    assert iou(found, published[1:]).mean() > 0.9
    assert abs(iou(found, truth[1:]).mean() - iou(published[1:], truth[1:]).mean()) < 0.02


def test_version_2_answers_as_the_tracker_of_opencv(shared_data):
    frames, truth = real(shared_data, "OTB100/Couple", 30)
    folder = shared_data / "weights" / "nanotrackv2"
    files = {part: str(next(folder.glob(f"*{part}*"))) for part in ("backbone", "head")}
    found = boxes_of(make_tracker("nanotrack", files), frames, truth[0])
    theirs = boxes_of(make_tracker("opencv:nano", files), frames, truth[0])
    # OpenCV has other constants, channels in another order, and whole pixels
    assert iou(found, theirs).mean() > 0.75
    assert np.mean([centre_error(a, b) for a, b in zip(found, theirs)]) < 3


def test_its_stages_are_most_of_a_call(shared_data, weights):
    frames, truth = real(shared_data, "DTB70/MountainBike6", 2)
    tracker = make_tracker("nanotrack", {"weights": str(weights)})
    with listening() as call:
        tracker.init(frames[0], truth[0])
    assert set(call.ns) == {"preprocess", "inference"}
    before = perf_counter_ns()
    with listening() as call:
        tracker.track(frames[1])
    elapsed = perf_counter_ns() - before
    assert set(call.ns) == {"preprocess", "inference", "postprocess"}
    assert 0.5 * elapsed < call.ns["inference"] < sum(call.ns.values()) <= elapsed


def test_is_searched_where_it_is_told(weights):
    here, there = (40, 60, 40, 40), (230, 150, 50, 50)
    frames = list(moving([here, here, there, there]))
    tracker = make_tracker("nanotrack", {"weights": str(weights)})
    boxes_of(tracker, frames[:2], here)
    assert centre_error(tracker.track(frames[2])[0], there) > 100
    tracker.set_search(250, 170, 50, 50)
    box, score = tracker.track(frames[3])
    assert centre_error(box, there) < 8
    assert 0.5 < score <= 1


def test_is_deterministic(weights):
    truth = straight(8)
    frames = list(moving(truth))
    tracker = make_tracker("nanotrack", {"weights": str(weights)})
    first = boxes_of(tracker, frames, truth[0])
    np.testing.assert_array_equal(boxes_of(tracker, frames, truth[0]), first)


@pytest.mark.parametrize("box", [(9, 9, 0, 0), (-90, 500, 40, 1), (-3000, -3000, 6000, 6000)])
def test_any_box_can_be_tracked(weights, box):
    frames = list(moving(straight(3)))
    tracker = make_tracker("nanotrack", {"weights": str(weights)})
    tracker.init(frames[0], box)
    for frame in [*frames, frames[0][:50, :20], np.zeros((1, 1, 3), np.uint8)]:
        found, score = tracker.track(frame)
        assert np.isfinite([*found, score]).all()
    tracker.set_search(-1e9, 5, 1e9, 1e-9)
    assert np.isfinite(tracker.track(frames[1])[0]).all()


def test_describes_itself(weights):
    told = make_tracker("nanotrack", {"weights": str(weights)}).describe()
    files = sorted(weights.glob("*.onnx"))
    assert told["version"] == weights.name[-2:]
    assert (
        told["weights_digest"]
        == hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    )
    assert 0 < told["settings"]["lr"] < 1
    assert told["search"]["half_side"] == 1
    assert told["search"]["window"] is True


def test_refuses_before_init_and_places_that_are_none(weights):
    tracker = make_tracker("nanotrack", {"weights": str(weights)})
    frame = next(moving(straight(1)))
    with pytest.raises(LaeError, match="init must come before"):
        tracker.track(frame)
    with pytest.raises(LaeError, match="cannot search"):
        tracker.set_search(np.inf, 0, 1, 1)
    with pytest.raises(LaeError, match="uint8"):
        tracker.init(frame.astype(float), (1, 1, 9, 9))


def test_weights_that_are_missing_are_named(tmp_path):
    for options, named in (
        ({}, "backbone=FILE"),
        ({"weights": str(tmp_path)}, f"no file {tmp_path}.*backbone"),
        ({"backbone": "nowhere.onnx", "head": "x"}, "no file nowhere.onnx"),
    ):
        with pytest.raises(LaeError, match=f"{named}.*HonglinChu/SiamTrackers"):
            make_tracker("nanotrack", options)
    for name in ("a_backbone.onnx", "b_backbone.onnx"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(LaeError, match="more than one file"):
        make_tracker("nanotrack", {"weights": str(tmp_path)})


def test_weights_that_are_no_networks_are_named(tmp_path, shared_data):
    (tmp_path / "backbone.onnx").write_bytes(b"nonsense")
    (tmp_path / "head.onnx").write_bytes(b"nonsense")
    with pytest.raises(LaeError, match=r"backbone.onnx: not a network"):
        make_tracker("nanotrack", {"weights": str(tmp_path)})
    folder = shared_data / "weights" / "nanotrackv3"
    files = {part: str(next(folder.glob(f"*{part}*"))) for part in ("backbone", "head")}
    swapped = {"backbone": files["head"], "head": files["backbone"]}
    with pytest.raises(LaeError, match="are not a backbone and a head"):
        make_tracker("nanotrack", swapped)


@pytest.fixture
def made(tmp_path):
    """Weights that are none of NanoTrack's, with its inputs and outputs."""
    return str(onnx_models.write_nanotrack(tmp_path))


@pytest.fixture
def ort():
    return pytest.importorskip("onnxruntime")


def test_onnx_runtime_answers_as_opencv(ort, made):
    truth = straight(6)
    frames = list(moving(truth))
    trackers = [
        make_tracker("nanotrack", {"weights": made, "runtime": runtime})
        for runtime in ("opencv", "onnxruntime")
    ]
    opencv, onnx = (boxes_of(tracker, frames, truth[0]) for tracker in trackers)
    np.testing.assert_allclose(onnx, opencv, atol=0.01)
    first, second = (tracker.describe() for tracker in trackers)
    assert first["weights_digest"] == second["weights_digest"]
    assert second["settings"]["runtime"] == "onnxruntime"
    assert second["settings"]["provider"] == "CPU"


def test_onnx_runtime_answers_as_opencv_with_real_weights(ort, shared_data, weights):
    frames, truth = real(shared_data, "DTB70/MountainBike6", 20)
    opencv, onnx = (
        boxes_of(
            make_tracker("nanotrack", {"weights": str(weights), "runtime": runtime}),
            frames,
            truth[0],
        )
        for runtime in ("opencv", "onnxruntime")
    )
    np.testing.assert_allclose(onnx, opencv, atol=0.5)


def test_runtimes_and_providers_that_are_none(ort, made):
    def refused(message, **options):
        with pytest.raises(LaeError, match=message):
            make_tracker("nanotrack", {"weights": made, **options})

    refused("no runtime 'tflite': there are opencv, onnxruntime", runtime="tflite")
    refused("add runtime=onnxruntime", provider="CUDA")
    refused("no provider 'Abacus'", runtime="onnxruntime", provider="Abacus")
    refused("'tpu' is neither", runtime="onnxruntime", device="tpu")
    if "CUDAExecutionProvider" not in ort.get_available_providers():
        refused("no provider 'CUDA'", runtime="onnxruntime", device="cuda:1")
    swapped = {"backbone": f"{made}/head.onnx", "head": f"{made}/backbone.onnx"}
    with pytest.raises(LaeError, match=r"head\.onnx: ONNX Runtime .* it has no input 'input'"):
        make_tracker("nanotrack", {**swapped, "runtime": "onnxruntime"})
    twice = {**swapped, "backbone": f"{made}/backbone.onnx"}
    with pytest.raises(LaeError, match="are not a backbone and a head of NanoTrack"):
        make_tracker("nanotrack", {**twice, "runtime": "onnxruntime"})


def test_devices(weights):
    with pytest.raises(LaeError, match="'tpu' is neither"):
        make_tracker("nanotrack", {"weights": str(weights), "device": "tpu"})
    if cv2.dnn.getAvailableTargets(cv2.dnn.DNN_BACKEND_CUDA):
        pytest.skip("this build of OpenCV has CUDA")
    with pytest.raises(LaeError, match="has no CUDA"):
        make_tracker("nanotrack", {"weights": str(weights), "device": "cuda:0"})
