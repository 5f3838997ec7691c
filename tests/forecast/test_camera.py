"""Camera motion: what is recovered from frames, and what forecasters make of it."""

from __future__ import annotations

from fractions import Fraction
from functools import partial

import cv2
import numpy as np
import pytest
from fakes import FakeTimed

from lae_sim.datasets.frames import ImageSequence
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ConstantVelocity, Hold, Lanes, forecast
from lae_sim.forecast.camera import Camera, CameraCompensated, CameraMotion, estimate_camera
from lae_sim.forecast.kalman import Kalman
from lae_sim.learning.trainers import WrappedTrainer
from lae_sim.profile.live import run_real_time

FPS = Fraction(30)
BOX = [30.0, 40.0, 20.0, 10.0]


def similarity(x=0.0, y=0.0, turn=0.0, scale=1.0):
    """A step of the camera about the image's corner, as a 3x3 matrix."""
    a, b = scale * np.cos(turn), scale * np.sin(turn)
    return np.array([[a, -b, x], [b, a, y], [0, 0, 1.0]])


def film(steps, size=(320, 240), name="film"):
    """A random texture seen by a camera that moves by these steps, each seen pixel interpolated."""
    noise = np.random.default_rng(3).integers(0, 256, (1400, 1600, 3), np.uint8)
    texture = cv2.GaussianBlur(noise, None, 3)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    places = [similarity(-500, -500)]
    for step in steps:
        places.append(step @ places[-1])
    frames = [cv2.warpAffine(texture, place[:2], size) for place in places]
    return ImageSequence(name, np.tile(BOX, (len(frames), 1)), frames.__getitem__)


def counted(sequence):
    """The same sequence, and a list of the frames that were read."""
    asked = []

    def read(frame):
        asked.append(frame)
        return sequence.read(frame)

    return ImageSequence(sequence.name, sequence.truth, read), asked


def known(steps, elapsed_ns=1_000_000, **options):
    """Motion as given, for forecasts without images."""
    transforms = np.stack([np.eye(2, 3), *(step[:2] for step in steps)])
    motion = CameraMotion(transforms, np.full(len(transforms), elapsed_ns))
    truth = np.tile(BOX, (len(transforms), 1))
    sequence = ImageSequence("known", truth, lambda frame: np.zeros((8, 8, 3), np.uint8))

    def make(base, **more):
        camera = Camera({}, FPS, options.get("lag", more.get("lag")), {"known": motion})
        always = options.get("always", more.get("always", False))
        return CameraCompensated(base, camera, always).for_sequence(sequence)

    return make


def shift(box, x, y=0.0):
    return [box[0] + x, box[1] + y, *box[2:]]


@pytest.mark.parametrize("size", [(320, 240), (640, 480)])
@pytest.mark.parametrize(
    "step",
    [
        similarity(),
        similarity(4.3, -2.7),
        similarity(25.0, 10.0),
        similarity(5, -3, turn=0.02),
        similarity(-6, -4, scale=1.03),
        similarity(3, 3, turn=-0.03, scale=0.97),
    ],
)
def test_known_motion_is_recovered(step, size):
    sequence = film([step, step], size)
    found = estimate_camera(sequence).transforms
    assert (found[0] == np.eye(2, 3)).all()
    corners = np.array([[0, 0, 1], [size[0], 0, 1], [0, size[1], 1], [*size, 1.0]]).T
    for transform in found[1:]:
        assert np.abs(transform @ corners - step[:2] @ corners).max() < 0.5
        assert transform[0, 0] == transform[1, 1]
        assert transform[0, 1] == -transform[1, 0]


def test_estimates_are_the_same_bits_and_leave_the_threads_alone():
    sequence = film([similarity(4, 1, turn=0.01)] * 4)
    threads = cv2.getNumThreads()
    done = []
    first, second = estimate_camera(sequence, done.append), estimate_camera(sequence)
    assert first.transforms.tobytes() == second.transforms.tobytes()
    assert (first.elapsed_ns > 0).all()
    assert cv2.getNumThreads() == threads
    assert done == [1] * 5


def test_what_cannot_be_told_is_the_identity():
    seen = film([similarity(4, 1)] * 2)
    blank = np.full((240, 320, 3), 90, np.uint8)
    noise = np.random.default_rng(0).integers(0, 256, blank.shape, np.uint8)
    for second in [blank, noise, seen.read(1)[:200], np.zeros((1, 1, 3), np.uint8)]:
        images = [seen.read(0), second, seen.read(2)]
        sequence = ImageSequence("s", seen.truth, images.__getitem__)
        assert (estimate_camera(sequence).transforms == np.eye(2, 3)).all()
    zoomed = film([similarity(scale=0.75)])
    assert (estimate_camera(zoomed).transforms == np.eye(2, 3)).all()


def test_lag_is_what_nearly_all_estimates_take():
    def lag(elapsed_ms, fps=FPS):
        ns = np.array(elapsed_ms) * 1_000_000
        return CameraMotion(np.tile(np.eye(2, 3), (len(ns), 1, 1)), ns).lag(fps)

    assert lag([0]) == 1
    assert lag([5] * 100) == 1
    assert lag([40] * 100) == 2
    assert lag([100] * 100) == 3  # exactly three frames
    assert lag([101] * 100) == 4
    assert lag([5] * 99 + [900]) == 1  # one stall
    assert lag([40] * 100, Fraction(10)) == 1


def test_a_still_target_under_a_panning_camera():
    sequence = film([similarity(6, 2)] * 12)
    camera = CameraCompensated(Hold, Camera({"film": sequence}, FPS), always=True)
    forecaster = camera.for_sequence(sequence)(BOX, (320, 240))
    for frame in range(1, 6):
        forecaster.update(frame, shift(BOX, 6 * frame, 2 * frame))
    expected = shift(BOX, 6 * 11, 2 * 11)
    assert np.abs(np.array(forecaster.predict(11)) - expected).max() < 0.5
    assert shift(BOX, 30, 10) != expected  # what hold would say


def test_the_last_steps_are_extrapolated_from_what_is_known():
    pan = [similarity(x) for x in (3, 6, 12, 100, 1000)]
    for lag, expected in {
        0: 3 + 6 + 12 + 100 + 1000,
        1: 3 + 6 + 12 + 100 + (6 + 12 + 100) / 3,
        2: 3 + 6 + 12 + 2 * (3 + 6 + 12) / 3,
        3: 3 + 6 + 3 * (3 + 6) / 2,
        4: 3 + 4 * 3,
        5: 0,
    }.items():
        forecaster = known(pan, lag=lag, always=True)(Hold)(BOX)
        assert forecaster.predict(0) == BOX
        assert forecaster.predict(5) == pytest.approx(shift(BOX, expected))
    late = known(pan, elapsed_ns=40_000_000, always=True)(Hold)(BOX)  # more than one frame
    assert late.predict(5) == pytest.approx(shift(BOX, 3 + 6 + 12 + 14))


def test_the_motion_up_to_an_output_is_known_with_it():
    pan = [similarity(x) for x in (3, 6, 12, 100)]
    forecaster = known(pan, lag=3, always=True)(Hold)(BOX)
    forecaster.update(3, BOX)
    assert forecaster.predict(3) == pytest.approx(BOX)
    assert forecaster.predict(4) == pytest.approx(shift(BOX, (3 + 6 + 12) / 3))
    forecaster.update(4, BOX)  # an output newer than the frame asked for
    assert forecaster.predict(3) == pytest.approx(shift(BOX, -100))


def test_sides_follow_the_scale_and_not_the_turn():
    turned = known([similarity(scale=1.1), similarity(turn=np.pi / 2)], lag=0, always=True)
    forecaster = turned(Hold)([10.0, 10, 20, 10])
    x, y, w, h = forecaster.predict(2)  # the centre (20, 15), by 1.1, then a quarter turn
    assert (x + w / 2, y + h / 2, w, h) == pytest.approx((-16.5, 22, 22, 11))


def test_motion_of_the_target_is_added_to_the_camera_s():
    forecaster = known([similarity(x) for x in (5, -9, 14, 2, -7, 3)], lag=0)(ConstantVelocity)
    here = forecaster(BOX, None)
    offset = np.cumsum([0, 5, -9, 14, 2, -7, 3])
    for frame in (1, 2, 3, 4):
        here.update(frame, shift(BOX, 2 * frame + offset[frame]))
    assert here.predict(6) == pytest.approx(shift(BOX, 12 + offset[6]))


def test_a_camera_that_follows_the_target_is_left_out():
    shaking = [similarity(x) for x in np.tile([20, -3], 15)]
    for always, moved in {False: 0, True: -3 + 20 - 3}.items():
        forecaster = known(shaking, lag=0, always=always)(Hold)(BOX)
        for frame in range(1, 28):
            forecaster.update(frame, BOX)
        assert forecaster.predict(30) == pytest.approx(shift(BOX, moved))


@pytest.mark.parametrize("always", [False, True])
@pytest.mark.parametrize("base", [Hold, ConstantVelocity, Kalman])
def test_lanes_and_boxes_one_by_one_agree(base, always):
    rng = np.random.default_rng(5)
    steps = [
        similarity(*rng.normal(8, 3, 2), rng.normal(0, 0.03), rng.uniform(0.95, 1.05))
        for _ in range(59)
    ]
    factory = known(steps, elapsed_ns=50_000_000, always=always)(base)
    lengths = [30, 1, 12]
    offsets = np.cumsum([0, *lengths])
    frames = np.concatenate(
        [[0, *np.sort(rng.choice(np.arange(1, 50), n - 1, replace=False))] for n in lengths]
    ).astype(np.int64)
    boxes = np.column_stack([rng.normal(100, 9, (43, 2)), rng.uniform(20, 40, (43, 2))])
    place = np.array([100, 100, 1.0])
    for k in range(frames[20]):  # moves with the camera for a while
        place = steps[k] @ place
        boxes[:20][frames[:20] == k + 1, :2] = place[:2]
    sizes = np.array([[320.0, 240], [np.inf, np.inf], [320, 240]])
    item = np.repeat(np.arange(43), 6)
    frame = np.minimum(frames[item] + np.tile([-1, 0, 1, 2, 3, 9], 43), 59).clip(0)
    lanes = Lanes(offsets, frames, boxes, sizes)
    at_once = factory.forecast_lanes(lanes, item, frame)
    one_by_one = forecast(lambda box, size: factory(box, size), lanes, item, frame)
    assert np.abs(at_once - one_by_one).max() < 1e-9
    raw = forecast(base, lanes, item, frame)
    as_is = (np.abs(at_once - raw).max(axis=1) < 1e-9).mean()
    assert as_is < 0.3 if always else 0.3 < as_is < 0.95


def test_frames_are_read_once_and_of_the_sequence_itself_where_it_is_live():
    sequence, asked = counted(film([similarity(4, 1)] * 3))
    camera = Camera({"film": sequence}, FPS)
    for base in (Hold, Kalman, Hold):
        CameraCompensated(base, camera).for_sequence(sequence)
    assert asked == [0, 1, 2, 3]
    live = Camera({}, FPS)
    factory = CameraCompensated(Kalman, live).for_sequence(sequence)
    assert list(live.known) == ["film"]
    tracker = FakeTimed([10_000_000])
    run = run_real_time(sequence, tracker, Clock.at(FPS), pre_forecaster=factory)
    assert run.frames.tolist() == [0, 1, 2, 3]
    assert len(tracker.searches) == 3


def test_trainers_share_what_is_known():
    class Trainer:
        def fit(self, examples, seed):
            return Hold

    sequence, asked = counted(film([similarity(4, 1)] * 2))
    camera = Camera({"film": sequence}, FPS)
    trainer = WrappedTrainer(Trainer(), partial(CameraCompensated, camera=camera))
    for seed in range(2):
        trained = trainer.fit(None, seed)
        assert trained.base is Hold
        trained.for_sequence(sequence)
    assert asked == [0, 1, 2]


def test_what_does_not_fit_is_told():
    class Recorded:
        name = "elsewhere"
        truth = np.zeros((4, 4))

    with pytest.raises(LaeError, match="'elsewhere': the camera's motion needs its frames"):
        CameraCompensated(Hold, Camera({}, FPS)).for_sequence(Recorded())
    short = film([similarity()] * 2)
    with pytest.raises(LaeError, match="'elsewhere' has 4 frames here, and 3 images"):
        CameraCompensated(Hold, Camera({"elsewhere": short}, FPS)).for_sequence(Recorded())
    with pytest.raises(LaeError, match="cannot be known 1 frames early"):
        Camera({}, FPS, lag=-1)
