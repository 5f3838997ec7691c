import threading
from fractions import Fraction

import numpy as np
import pytest

from lae_sim.datasets.frames import Buffered, Video, read_image
from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError

cv2 = pytest.importorskip("cv2", reason="frames are decoded with OpenCV")


@pytest.fixture
def picture():
    return np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
def test_colour_images_are_read_as_they_are(tmp_path, picture, suffix):
    path = tmp_path / f"1.{suffix}"
    cv2.imwrite(str(path), picture)
    assert np.array_equal(read_image(path), picture)


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_grey_and_16_bit_images_become_colour_of_8_bit(tmp_path, suffix):
    deep = np.linspace(0, 65535, 32 * 24).reshape(24, 32).astype(np.uint16)
    path = tmp_path / f"1.{suffix}"
    cv2.imwrite(str(path), deep)
    image = read_image(path)
    assert (image.dtype, image.shape) == (np.uint8, (24, 32, 3))
    assert np.abs(image - (deep / 257)[..., None]).max() < 1
    cv2.imwrite(str(path), (deep >> 8).astype(np.uint8))
    assert np.array_equal(read_image(path)[..., 1], deep >> 8)


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp"])
def test_an_image_that_would_take_too_much_memory(tmp_path, suffix):
    path = tmp_path / f"1.{suffix}"
    cv2.imwrite(str(path), np.zeros((600, 700, 3), np.uint8))
    with max_decoded(3 * 600 * 700 + 54):  # the head of a BMP
        assert read_image(path).shape == (600, 700, 3)
    with (
        max_decoded("1MiB"),
        pytest.raises(LaeError, match=rf"1\.{suffix}: would take more than 1"),
    ):
        read_image(path)


def test_frames_that_are_read_ahead_may_take_as_much(tmp_path):
    for frame in range(6):
        cv2.imwrite(str(tmp_path / f"{frame}.png"), np.full((40, 50, 3), frame, np.uint8))
    with max_decoded(3 * 40 * 50):
        buffered = Buffered(lambda frame: read_image(tmp_path / f"{frame}.png"), 6)
        assert [int(buffered(frame)[0, 0, 0]) for frame in range(6)] == list(range(6))
    with max_decoded(3 * 40 * 50 - 1), pytest.raises(LaeError, match="would take more"):
        buffered = Buffered(lambda frame: read_image(tmp_path / f"{frame}.png"), 6)(0)


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp"])
@pytest.mark.parametrize("share", [0, 0.3, 0.95])
def test_cut_off_images_are_refused(tmp_path, picture, suffix, share):
    path = tmp_path / f"1.{suffix}"
    cv2.imwrite(str(path), picture)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(LaeError, match=r"1\.\w+: cannot be decoded: the file is "):
        read_image(path)


def test_a_jpeg_with_something_after_its_end_is_read(tmp_path, picture):
    path = tmp_path / "1.jpg"
    cv2.imwrite(str(path), picture)
    whole = read_image(path)
    path.write_bytes(path.read_bytes() + bytes(1000))
    assert np.array_equal(read_image(path), whole)


def test_the_orientation_in_the_metadata_is_ignored(tmp_path, picture):
    path = tmp_path / "1.jpg"
    cv2.imwrite(str(path), picture)
    data = path.read_bytes()
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert cv2.imread(str(path)).shape == (32, 24, 3)  # turned by default
    assert read_image(path).shape == (24, 32, 3)


def test_missing_image(tmp_path):
    with pytest.raises(LaeError, match=r"1\.jpg: no such file"):
        read_image(tmp_path / "1.jpg")


def write_video(path, count, fps=30.0):
    """Frames whose grey level says their number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for number in range(count):
        writer.write(np.full((48, 64, 3), 5 * number, np.uint8))
    writer.release()
    return path


def number_of(image):
    return round(image.mean() / 5)


def test_video_frames_in_any_order(tmp_path):
    video = Video(write_video(tmp_path / "a.avi", 40))
    assert len(video) == 40
    order = [0, 1, 2, 7, 6, 5, 39, 0, 20, 19, 3, 39]
    assert [number_of(video(frame)) for frame in order] == order
    video(3)[:] = 0
    assert number_of(video(3)) == 3
    with pytest.raises(LaeError, match=r"a\.avi: frame 40 cannot be decoded"):
        video(40)


def test_video_frames_from_threads(tmp_path):
    video = Video(write_video(tmp_path / "a.avi", 40))
    read = Buffered(video, len(video), size=16)
    assert [number_of(read(frame)) for frame in range(0, 40, 3)] == list(range(0, 40, 3))


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        (30.0, Fraction(30)),
        (29.97, Fraction(30000, 1001)),
        (59.94, Fraction(60000, 1001)),
        (25.0, Fraction(25)),
        (12.5, Fraction(25, 2)),
        (10.0, Fraction(10)),
    ],
)
def test_video_rate_is_the_exact_one_that_was_meant(tmp_path, written, meant):
    assert Video(write_video(tmp_path / "a.avi", 2, written)).fps == meant


def test_not_a_video(tmp_path):
    path = tmp_path / "a.mp4"
    with pytest.raises(LaeError, match=r"a\.mp4: no such file"):
        Video(path)
    path.write_bytes(b"no video")
    with pytest.raises(LaeError, match=r"a\.mp4: not a video"):
        Video(path)


def test_a_real_video(shared_data):
    video = Video(shared_data / "frames" / "bag.avi")
    assert (len(video), video.fps) == (196, Fraction(25))
    forward = [video(frame) for frame in range(0, 60)]
    for frame in (59, 3, 41, 40):
        assert np.array_equal(video(frame), forward[frame])


def numbered(calls, bad=()):
    def read(frame):
        calls.append(frame)
        if frame in bad:
            raise LaeError(f"frame {frame}")
        return np.full((4, 4, 3), frame, np.uint8)

    return read


def test_buffered_decodes_each_frame_once_and_only_when_asked():
    calls = []
    read = Buffered(numbered(calls), 50, size=8)
    assert calls == []
    assert [int(read(frame)[0, 0, 0]) for frame in range(20)] == list(range(20))
    assert sorted(calls) == list(range(24))
    threads = [thread for thread in threading.enumerate() if "ThreadPool" in thread.name]
    assert threads == []  # nothing runs beside the tracker


def test_buffered_stops_at_the_end():
    calls = []
    read = Buffered(numbered(calls), 5, size=8)
    for frame in (0, 4, 4, 2):
        assert read(frame)[0, 0, 0] == frame
    assert max(calls) == 4


@pytest.mark.parametrize("skip", [2, 3, 7, 11])
def test_buffered_skipping_wastes_at_most_a_block(skip):
    calls = []
    read = Buffered(numbered(calls), 100, size=8)
    frames = range(0, 100, skip)
    assert [int(read(frame)[0, 0, 0]) for frame in frames] == list(frames)
    assert len(calls) == len(set(calls)) <= 100


def test_buffered_is_bounded_in_bytes():
    calls = []
    read = Buffered(numbered(calls), 100, size=50, max_bytes=4 * 48 + 5)
    read(0)
    assert sorted(calls) == [0, 1, 2, 3]
    calls.clear()
    Buffered(numbered(calls), 100, max_bytes=1)(7)
    assert calls == [7]


def test_buffered_raises_only_for_the_frame_asked_for():
    read = Buffered(numbered([], bad=[2]), 10, size=8)
    assert read(1)[0, 0, 0] == 1
    assert read(3)[0, 0, 0] == 3
    for _ in range(2):
        with pytest.raises(LaeError, match="frame 2"):
            read(2)


def test_buffered_frames_can_be_drawn_into():
    read = Buffered(numbered([]), 10)
    read(1)[:] = 99
    assert read(1)[0, 0, 0] == 1
    read(2)[:] = 99
    assert read(2)[0, 0, 0] == 2


def test_frames_at_equal_steps_are_decoded_once_and_alone() -> None:
    decoded: list[int] = []

    def read(frame: int) -> np.ndarray:
        decoded.append(frame)
        return np.full((2, 2, 3), frame, np.uint8)

    buffered = Buffered(read, 90, size=4)
    for frame in range(0, 90, 3):
        assert buffered(frame)[0, 0, 0] == frame
    assert len(decoded) <= 30 + 2 * 4  # what was decoded before the steps were known
    decoded.clear()
    buffered = Buffered(read, 90, size=4)
    for frame in range(90):
        assert buffered(frame)[0, 0, 0] == frame
    assert sorted(decoded) == list(range(90))
