"""The command that draws replays over frames."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="rendering needs OpenCV")

import cv2

from lae_sim.cli import main as cli
from lae_sim.cli import render
from lae_sim.datasets.frames import ImageSequence
from lae_sim.datasets.synthetic import synthetic_dataset
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.figures.film import Scene, colours_of
from lae_sim.forecast.base import Hold
from lae_sim.replay.run import replay_sequence
from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

T = 20
MS = 10**6
TRUTH = np.stack([40.0 + 20 * np.arange(T), np.full(T, 100.0), np.full(T, 50), np.full(T, 40)], 1)


def recording(name: str) -> Recording:
    """A perfect tracker that takes 47 ms a frame."""
    return Recording.new(name, TRUTH, TRUTH, np.full(T, 47 * MS))


def read(frame: int) -> np.ndarray:
    return np.full((301, 641, 3), 40, np.uint8)


@pytest.fixture
def scene(every_frame: Metadata) -> Scene:
    run = replay_sequence(recording("ball"), Clock.at(Fraction(30)))
    return Scene.of(run, ImageSequence("ball", TRUTH, read), every_frame, {"hold": Hold})


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two sequences in DTB70's layout, and ``trace.parquet`` beside them."""
    for name in ("ball", "car"):
        folder = tmp_path / "DTB70" / name
        (folder / "img").mkdir(parents=True)
        np.savetxt(folder / "groundtruth_rect.txt", TRUTH, "%.1f", ",")
        for frame in range(T):
            cv2.imwrite(str(folder / "img" / f"{frame + 1:05}.jpg"), read(frame))
    metadata = Metadata.new("30", "every-frame", dataset={"name": "DTB70"})
    trace = Trace(metadata, [recording("ball"), recording("car")])
    write_trace(trace, tmp_path / "trace.parquet")
    return tmp_path


@pytest.fixture
def run(dataset: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run the command; the error, or nothing."""

    def command(out: str, *options: str) -> str:
        arguments = [str(dataset / "trace.parquet"), "--root", str(dataset / "DTB70")]
        status = render.main([*arguments, "--out", str(dataset / out), *options])
        error = capsys.readouterr().err
        assert status == (2 if error else 0)
        assert error.count("\n") == bool(error)
        return error

    return command


def frames_of(path: Path) -> list[np.ndarray]:
    film, frames = cv2.VideoCapture(str(path)), []
    while (found := film.read())[0]:
        frames.append(found[1])
    return frames


def has(picture: np.ndarray, x: float, colour: tuple[int, ...]) -> bool:
    """Whether there is an upright line of a colour at x, through the middle of the boxes."""
    near = picture[115:125, round(x) - 1 : round(x) + 2].astype(int)
    return bool((np.abs(near - colour).max(axis=2) < 60).any(axis=1).all())


COLOURS = (*colours_of(["hold", "kalman"]).values(),)
ORANGE, WHITE = COLOURS[0], (255, 255, 255)


def test_hold_is_drawn_where_the_target_was(scene: Scene) -> None:
    # 47 ms at 30 fps: frame 1 is ready at 94 ms, after frame 2 was queried and before frame 3
    for frame, source in [(0, 0), (1, 0), (2, 0), (3, 1), (4, 1), (5, 2)]:
        picture = scene.draw(frame)
        assert has(picture, 90 + 20 * source, ORANGE)
        if source != frame:
            assert has(picture, 90 + 20 * frame, WHITE)
            assert not has(picture, 90 + 20 * frame, ORANGE)


def test_frames_that_do_not_exist(scene: Scene) -> None:
    for frame in (-1, T):
        with pytest.raises(LaeError, match=r"'ball' has frames 0 to 19"):
            scene.draw(frame)


@pytest.fixture(params=["PyAV", "OpenCV"])
def writer(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """What writes films: PyAV, and OpenCV as if PyAV were not there."""
    if request.param == "OpenCV":
        monkeypatch.setitem(sys.modules, "av", None)
        monkeypatch.setitem(sys.modules, "av.codec", None)
    else:
        pytest.importorskip("av", reason="H.264 needs the extra film")
    return str(request.param)


def test_films_are_h264_that_browsers_play(scene: Scene, tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="H.264 needs the extra film")
    scene.film(tmp_path / "film.mp4")
    with av.open(str(tmp_path / "film.mp4")) as film:
        [stream] = film.streams
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 30
        pictures = [frame.to_ndarray(format="bgr24") for frame in film.decode(stream)]
    assert len(pictures) == T
    for frame in (5, 19):
        drawn = scene.draw(frame)
        decoded = pictures[frame][: drawn.shape[0], : drawn.shape[1]]
        assert np.abs(decoded.astype(int) - drawn).mean() < 6
    head = (tmp_path / "film.mp4").read_bytes()
    assert head.index(b"moov") < head.index(b"mdat")  # it can be played before it is all there


def test_a_film_without_pyav_says_what_h264_needs(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setitem(sys.modules, "av.codec", None)
    arguments = [str(dataset / "trace.parquet"), "--root", str(dataset / "DTB70")]
    film = dataset / "a.mp4"
    assert render.main([*arguments, "--sequence", "car", "--out", str(film)]) == 0
    said = capsys.readouterr().err
    assert "pip install 'lae-sim[film]' makes them H.264" in said
    assert said.count("\n") == 1
    assert len(frames_of(film)) == T
    assert render.main([*arguments, "--sequence", "car", "--out", str(dataset / "a.png")]) == 0
    assert not capsys.readouterr().err


@pytest.mark.usefixtures("writer")
def test_a_film_has_every_frame(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    scene.film(path)
    assert list(tmp_path.iterdir()) == [path]
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FPS) == pytest.approx(30)
    frames = frames_of(path)
    assert len(frames) == T
    assert all(side % 2 == 0 for side in frames[0].shape[:2])
    assert frames[0].shape[1] == 642
    assert [has(frames[5], 90 + 20 * source, ORANGE) for source in (2, 5)] == [True, False]


@pytest.mark.usefixtures("writer")
def test_a_film_appears_whole_or_not_at_all(scene: Scene, tmp_path: Path) -> None:
    def breaks(frame: int) -> np.ndarray:
        if frame == 7:
            raise LaeError("frame 7 is damaged")
        return read(frame)

    broken = Scene(scene.run, ImageSequence("ball", TRUTH, breaks), scene.answers)
    with pytest.raises(LaeError, match="damaged"):
        broken.film(tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("writer")
def test_images_that_change_size_are_fitted_into_the_first(scene: Scene, tmp_path: Path) -> None:
    def shrinks(frame: int) -> np.ndarray:
        return np.full((301, 641, 3), 90, np.uint8)[: 100 if frame >= 7 else None]

    smaller = Scene(scene.run, ImageSequence("ball", TRUTH, shrinks), scene.answers)
    smaller.film(tmp_path / "film.mp4")
    frames = frames_of(tmp_path / "film.mp4")
    assert len(frames) == T
    assert len({frame.shape for frame in frames}) == 1
    strip = smaller.strip([0, 9], width=320)
    assert strip.shape[1] >= 2 * 320 or strip.shape[0] >= 2 * scene.draw(0, 320).shape[0]


def test_a_full_disk(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        """A disk that is full after some frames."""

        def __init__(self, *arguments: object) -> None:
            self.real, self.left = real(*arguments), 5
            self.isOpened, self.release = self.real.isOpened, self.real.release

        def write(self, picture: np.ndarray) -> None:
            self.left -= 1
            if self.left >= 0:
                self.real.write(picture)

    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setitem(sys.modules, "av.codec", None)
    real = cv2.VideoWriter
    Full.fourcc = real.fourcc  # type: ignore[attr-defined]
    monkeypatch.setattr(cv2, "VideoWriter", Full)
    with pytest.raises(LaeError, match="only 5 of 20 frames"):
        scene.film(tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())


def test_a_contact_sheet(run: Callable[..., str], dataset: Path) -> None:
    assert not run("sheet.png", "--sequence", "ball", "--frames", "3", "5", "--forecaster", "hold")
    sheet = cv2.imread(str(dataset / "sheet.png"))
    assert sheet.shape[1] == 2 * 640 + 4
    assert has(sheet, 110 * 640 / 641, ORANGE)
    assert has(sheet[:, 644:], 130 * 640 / 641, ORANGE)
    assert not run("sheet.jpg", "--sequence", "ball")
    assert cv2.imread(str(dataset / "sheet.jpg")).shape[1] == 4 * 640 + 12


def test_options_of_the_world_count(run: Callable[..., str], dataset: Path) -> None:
    ball = ["--sequence", "ball", "--forecaster", "hold", "--frames", "5"]
    for options, source in [
        ([], 2),
        (["--latency-scale", "1/47"], 4),
        (["--latency", "constant:100ms"], 0),
        (["--policy", "vot-realtime"], 5),
        (["--fps", "10"], 4),
    ]:
        assert not run("sheet.png", *ball, *options)
        sheet = cv2.imread(str(dataset / "sheet.png"))
        found = [s for s in range(6) if has(sheet, (90 + 20 * s) * 640 / 641, ORANGE)]
        assert found == [source], options


def test_a_folder_gets_a_film_of_each_sequence(run: Callable[..., str], dataset: Path) -> None:
    pytest.importorskip("av", reason="without it the command says so")
    assert not run("films")
    films = sorted((dataset / "films").iterdir())
    assert [film.name for film in films] == ["ball.mp4", "car.mp4"]
    assert cv2.VideoCapture(str(films[0])).get(cv2.CAP_PROP_FPS) == 30
    assert len(frames_of(films[1])) == T


@pytest.mark.parametrize(
    ("out", "options", "message"),
    [
        ("film.mp4", [], "has 2 sequences: choose one with --sequence, or give a folder"),
        ("film.mkv", [], "name a .mp4, .png or .jpg file, or a folder"),
        ("film.mp4", ["--sequence", "bird"], "no sequence 'bird'"),
        ("a.png", ["--sequence", "car", "--frames", "20"], "'car' has frames 0 to 19"),
        ("a.png", ["--forecaster", "nonsense", "--sequence", "car"], "no forecaster 'nonsense'"),
        ("no/such/folder/a.png", ["--sequence", "car"], "cannot write"),
        ("no/such/folder/a.mp4", ["--sequence", "car"], "cannot write"),
    ],
)
def test_errors_are_one_line(
    run: Callable[..., str], dataset: Path, out: str, options: list[str], message: str
) -> None:
    before = sorted(dataset.iterdir())
    assert message in run(out, *options)
    assert sorted(dataset.iterdir()) == before


def test_frames_that_are_not_the_traces(run: Callable[..., str], dataset: Path) -> None:
    truth = dataset / "DTB70" / "ball" / "groundtruth_rect.txt"
    np.savetxt(truth, TRUTH[:-1], "%.1f", ",")
    (dataset / "DTB70" / "ball" / "img" / "00020.jpg").unlink()
    assert "20 frames in the trace and 19 images" in run("a.mp4", "--sequence", "ball")


def test_a_trace_of_an_unknown_dataset(
    tmp_path: Path, every_frame: Metadata, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "trace.parquet"
    write_trace(Trace(every_frame, [recording("ball")]), path)
    assert render.main([str(path), "--out", str(tmp_path / "a.png")]) == 2
    assert "give its folder with --root" in capsys.readouterr().err


def test_a_video_without_ground_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = tmp_path / "ball.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 30, (640, 300))
    for frame in range(T):
        writer.write(np.ascontiguousarray(read(frame)[:300, :640]))
    writer.release()
    truth = TRUTH.copy()
    truth[1:] = np.nan
    metadata = Metadata.new("30", "every-frame", dataset={"name": "ball"})
    made = Recording.new("ball", truth, TRUTH, np.full(T, 47 * MS))
    write_trace(Trace(metadata, [made]), tmp_path / "trace.parquet")
    arguments = [str(tmp_path / "trace.parquet"), "--root", str(video), "--out"]
    assert (
        render.main([*arguments, str(tmp_path / "a.png"), "--frames", "5", "--forecaster", "hold"])
        == 0
    )
    assert has(cv2.imread(str(tmp_path / "a.png")), 130, ORANGE)
    assert (
        render.main(
            [*arguments[:2], str(tmp_path / "b.png"), *arguments[3:], str(tmp_path / "b.png")]
        )
        == 2
    )
    assert "would replace a file that is read" in capsys.readouterr().err


def test_a_synthetic_trace_needs_no_folder(tmp_path: Path) -> None:
    sequence = synthetic_dataset().sequences[0]
    metadata = Metadata.new("30", "every-frame", dataset={"name": "synthetic"})
    times = np.full(len(sequence), 47 * MS)
    boxes = np.where(np.isnan(sequence.truth), 9.0, sequence.truth)
    made = Recording.new(sequence.name, sequence.truth, boxes, times)
    write_trace(Trace(metadata, [made]), tmp_path / "trace.parquet")
    out = tmp_path / "a.png"
    assert (
        cli.main(
            ["render", str(tmp_path / "trace.parquet"), "--out", str(out), "--frames", "0", "9"]
        )
        == 0
    )
    assert cv2.imread(str(out)).shape[1] == 2 * 640 + 4


def test_help_has_working_examples(
    run: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        render.main(["--help"])
    examples = re.findall(r"^  lae-sim render (.*?)(?:   .*)?$", capsys.readouterr().out, re.M)
    assert len(examples) > 4
    for example in examples:
        render.parser().parse_args(example.split())


def test_real_frames(shared_data: Path, tmp_path: Path) -> None:
    boxes = np.load(shared_data / "results_boxes" / "DTB70" / "NanoTrackV3.npz")["Gull2"]
    truth = np.loadtxt(shared_data / "DTB70" / "anno" / "Gull2.txt", delimiter=",")
    metadata = Metadata.new("30", "every-frame", dataset={"name": "DTB70"})
    made = Recording.new("Gull2", truth, boxes, np.full(len(truth), 47 * MS))
    write_trace(Trace(metadata, [made]), tmp_path / "trace.parquet")
    root = str(shared_data / "frames" / "DTB70")
    out = tmp_path / "a.png"
    arguments = [str(tmp_path / "trace.parquet"), "--root", root, "--out", str(out)]
    assert render.main([*arguments, "--frames", "21", "30"]) == 0
    sheet = cv2.imread(str(out))
    for colour in (*COLOURS[:2], WHITE):
        assert (sheet == colour).all(axis=2).sum() > 100
