"""``python -m lae_sim.render``: draw a replay over its frames, as a film or a contact sheet."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lae_sim.cli import exit_status, new_parser
from lae_sim.errors import LaeError
from lae_sim.options import add_world, parse_latency, parse_policy
from lae_sim.zoo import load_forecaster

if TYPE_CHECKING:
    from lae_sim.evaluation import Answers
    from lae_sim.forecast import AnyFactory
    from lae_sim.frames import Image, ImageSequence
    from lae_sim.metadata import Metadata
    from lae_sim.run import Run

PROGRAM = "lae-sim render"

EXAMPLES = """\
examples:
  lae-sim render trace.parquet --sequence race --out race.mp4         a trace of synthetic sequences
  lae-sim render trace.parquet --root ~/data/DTB70 --sequence Gull2 --out gull.mp4
  lae-sim render trace.parquet --root ~/data/DTB70 --latency constant:100ms --out films/
  lae-sim render trace.parquet --root ~/data/DTB70 --sequence Gull2 --out gull.png
  lae-sim render trace.parquet --root clip.mp4 --out sheet.jpg --frames 0 30 60 --forecaster kalman

White is the ground truth. The other boxes are what is known when the frame is queried: hold is the
latest output that was ready, computed on the earlier frame that the caption names.
"""


@dataclass(frozen=True, eq=False)
class Scene:
    """A replayed sequence with its frames: ``scene.draw(frame)`` is a picture of one.

    Attributes:
        run: the replayed sequence.
        images: the same sequence's frames.
        answers: what each forecaster answers for every world frame, by name.
    """

    run: Run
    images: ImageSequence
    answers: Mapping[str, Answers]

    @classmethod
    def of(
        cls,
        run: Run,
        images: ImageSequence,
        metadata: Metadata,
        forecasters: Mapping[str, AnyFactory],
        at_arrival: bool = False,
    ) -> Scene:
        """The scene of a run and what forecasters make of it (see `lae_sim.evaluation.answers`).

        Raises:
            LaeError: if the frames are not as many as the run's.
        """
        from lae_sim.evaluation import answers

        if len(images) != len(run):
            raise LaeError(
                f"sequence {run.recording.name!r} has {len(run)} frames in the trace and "
                f"{len(images)} images: is this the dataset that it was recorded on?"
            )
        found = {
            name: answers(run, metadata, name, factory, at_arrival=at_arrival)
            for name, factory in forecasters.items()
        }
        return cls(run, images, found)

    def draw(self, frame: int, width: int | None = None) -> Image:
        """Draw the boxes for a world frame on it; see `lae_sim.drawing.draw_frame`.

        Raises:
            LaeError: if there is no such frame, or it cannot be read.
        """
        from lae_sim.drawing import draw_frame

        last = len(self.run) - 1
        if not 0 <= frame <= last:
            raise LaeError(f"sequence {self.run.recording.name!r} has frames 0 to {last}")
        source = next(iter(self.answers.values())).source_frame[frame]
        caption = (
            self.run.recording.name,
            f"frame {frame} of {last + 1}",
            f"{self.run.schedule.clock.milliseconds(frame) / 1000:.3f} s",
            f"output of frame {source}, {frame - source} before",
        )
        boxes = {name: found.boxes[frame] for name, found in self.answers.items()}
        truth = self.run.recording.truth[frame]
        return draw_frame(self.images.read(frame), boxes, truth, caption, width)

    def film(self, path: str | Path) -> None:
        """Write an MP4 of all frames, whole or not at all, with a progress bar on a terminal.

        Raises:
            LaeError: if it cannot be written, or a frame cannot be read.
        """
        import cv2
        import numpy as np
        from tqdm import trange

        from lae_sim.files import written_whole

        first = self.draw(0)
        fill = [(0, side % 2) for side in first.shape[:2]] + [(0, 0)]  # codecs need even sides
        height, width = np.pad(first, fill).shape[:2]
        fourcc, rate = cv2.VideoWriter.fourcc(*"mp4v"), float(self.run.schedule.clock.fps)
        with written_whole(path) as temporary:
            writer = cv2.VideoWriter(str(temporary), fourcc, rate, (width, height))
            try:
                for frame in trange(len(self.run), desc=Path(path).name, disable=None):
                    picture = self.draw(frame)
                    if picture.shape != first.shape:
                        raise LaeError(f"{self.images.name!r}, frame {frame}: another image size")
                    writer.write(np.pad(picture, fill, "edge"))
            finally:
                writer.release()
            written = cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT)
            if written != len(self.run):  # the writer is silent on a full disk, or without a codec
                raise LaeError(f"{path}: only {written:.0f} of {len(self.run)} frames were written")

    def strip(self, frames: Sequence[int], width: int = 640) -> Image:
        """Pictures of some frames side by side, each ``width`` pixels wide."""
        from lae_sim.drawing import film_strip

        return film_strip([self.draw(frame, width) for frame in frames])


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        PROGRAM, "Draw a trace's replay over its frames: a film, or a contact sheet.", EXAMPLES
    )
    add = made.add_argument
    add("trace", metavar="TRACE", help="a trace (Parquet; see traces/FORMAT.md)")
    add(
        "--out",
        required=True,
        metavar="FILE",
        help="a film (.mp4), a contact sheet (.png, .jpg), or a folder for a film of each sequence",
    )
    group = made.add_argument_group("the frames")
    add = group.add_argument
    add("--root", metavar="PATH", help="folder of the dataset, or the video; synthetic needs none")
    add("--dataset", metavar="NAME", help="the dataset's name (default: the trace's)")
    add("--sequence", nargs="+", metavar="NAME", help="draw these sequences only")
    add_world(made)
    group = made.add_argument_group("the picture")
    add = group.add_argument
    add(
        "--forecaster",
        nargs="+",
        default=["hold", "kalman"],
        metavar="NAME",
        help="forecasters to draw, named as for lae-sim replay (default: hold kalman)",
    )
    add(
        "--frames", nargs="+", type=int, metavar="N", help="of a contact sheet (default: 12 of all)"
    )
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(lambda: _render(arguments), PROGRAM)


def _render(arguments: argparse.Namespace) -> None:
    from lae_sim.camera import Camera
    from lae_sim.files import check_distinct

    inputs = [arguments.trace, *arguments.strided, arguments.timing, arguments.root]
    out = Path(arguments.out)
    kind = out.suffix.lower()
    folder = out.is_dir() or not kind
    if not folder and kind not in (".mp4", ".png", ".jpg", ".jpeg"):
        raise LaeError(f"--out {out}: name a .mp4, .png or .jpg file, or a folder")
    check_distinct([out], [path for path in inputs if path])
    metadata, runs, at_arrival = _replayed(arguments)
    if not folder and len(runs) > 1:
        raise LaeError(
            f"{arguments.trace} has {len(runs)} sequences: choose one with --sequence, or give a "
            "folder as --out"
        )
    found = {run.recording.name: _images(run, metadata, arguments) for run in runs}
    camera = Camera(found, runs[0].schedule.clock.fps)
    forecasters = {name: load_forecaster(name, camera) for name in arguments.forecaster}
    for run in runs:
        images = found[run.recording.name]
        scene = Scene.of(run, images, metadata, forecasters, at_arrival)
        if folder:
            out.mkdir(parents=True, exist_ok=True)
            name = run.recording.name.replace("/", "-")
            scene.film(out / f"{name}.mp4")
        elif kind == ".mp4":
            scene.film(out)
        else:
            last = len(run) - 1
            _sheet(scene, arguments.frames or sorted({last * k // 11 for k in range(12)}), out)


def _replayed(arguments: argparse.Namespace) -> tuple[Metadata, list[Run], bool]:
    """The trace's metadata, its replayed sequences, and whether outputs count at arrival."""
    from lae_sim.latency import scaled
    from lae_sim.run import replay_trace
    from lae_sim.trace import read_trace

    policy, at_arrival = parse_policy(arguments.policy)
    source = scaled(parse_latency(arguments.latency), arguments.latency_scale)
    trace = read_trace(arguments.trace, arguments.sequence)
    timing = read_trace(arguments.timing) if arguments.timing else None
    strided = [read_trace(path, arguments.sequence) for path in arguments.strided]
    runs = replay_trace(trace, arguments.fps, source, policy, timing, strided)
    return trace.metadata, list(runs), at_arrival


def _images(run: Run, metadata: Metadata, arguments: argparse.Namespace) -> ImageSequence:
    """The frames of a run's sequence."""
    from lae_sim.datasets import find_dataset

    name = arguments.dataset or (None if metadata.dataset == "unknown" else metadata.dataset)
    if arguments.root is None and name is None:
        raise LaeError("the trace does not say its dataset: give its folder with --root")
    root = None if arguments.root is None else Path(arguments.root).expanduser()
    box = run.recording.truth[0] if root is not None and root.is_file() else None
    sequences = None if box is not None else [run.recording.name]
    return find_dataset(name, root, sequences, box).sequences[0]


def _sheet(scene: Scene, frames: Sequence[int], path: Path) -> None:
    import cv2

    from lae_sim.files import written_whole

    _, encoded = cv2.imencode(path.suffix.lower(), scene.strip(frames))
    with written_whole(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


if __name__ == "__main__":
    sys.exit(main())
