"""``lae-sim render``: draw a replay over its frames, as a film or a contact sheet."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lae_sim.cli.options import add_world, check_outputs, exit_status, new_parser, worlds_of
from lae_sim.errors import LaeError, install
from lae_sim.figures.film import Scene, writes_h264
from lae_sim.files import file_names
from lae_sim.learning.registry import load_forecaster
from lae_sim.progress import tell

if TYPE_CHECKING:
    from lae_sim.datasets.frames import ImageSequence
    from lae_sim.replay.run import Run
    from lae_sim.trace.metadata import Metadata

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
    return exit_status(
        lambda: _render(arguments), PROGRAM, arguments.max_decoded, prints_result=False
    )


def _render(arguments: argparse.Namespace) -> None:
    from lae_sim.forecast.camera import Camera

    out = Path(arguments.out)
    kind = out.suffix.lower()
    folder = out.is_dir() or not kind
    if not folder and kind not in (".mp4", ".png", ".jpg", ".jpeg"):
        raise LaeError(f"--out {out}: name a .mp4, .png or .jpg file, or a folder")
    check_outputs(arguments, [out])
    metadata, runs = _replayed(arguments)
    if not folder and len(runs) > 1:
        raise LaeError(
            f"{arguments.trace} has {len(runs)} sequences: choose one with --sequence, or give a "
            "folder as --out"
        )
    films = [out / name for name in file_names((run.recording.name for run in runs), ".mp4")]
    if out.is_dir():
        check_outputs(arguments, films)
    sequences = {run.recording.name: _images(run, metadata, arguments) for run in runs}
    camera = Camera(sequences, runs[0].schedule.clock.fps)
    forecasters = {name: load_forecaster(name, camera) for name in arguments.forecaster}
    if (folder or kind == ".mp4") and not writes_h264():
        tell(
            f"{PROGRAM}: films are MPEG-4 Part 2 here, which browsers do not play: "
            f"{install('film')} makes them H.264"
        )
    for run, film in zip(runs, films):
        scene = Scene.of(run, sequences[run.recording.name], metadata, forecasters)
        if folder:
            out.mkdir(parents=True, exist_ok=True)
            scene.film(film)
        elif kind == ".mp4":
            scene.film(out)
        else:
            last = len(run) - 1
            _sheet(scene, arguments.frames or sorted({last * k // 11 for k in range(12)}), out)


def _replayed(arguments: argparse.Namespace) -> tuple[Metadata, list[Run]]:
    """The metadata of the trace, and its sequences replayed."""
    (world,) = worlds_of(arguments)
    runs = world.replay(arguments.trace, arguments.sequence)
    return runs.trace.metadata, list(runs)


def _images(run: Run, metadata: Metadata, arguments: argparse.Namespace) -> ImageSequence:
    """The frames of a run's sequence."""
    from lae_sim.datasets.layouts import find_dataset

    name = arguments.dataset or (None if metadata.dataset == "unknown" else metadata.dataset)
    if arguments.root is None and name is None:
        raise LaeError("the trace does not say its dataset: give its folder with --root")
    root = None if arguments.root is None else Path(arguments.root).expanduser()
    box = run.recording.truth[0] if root is not None and root.is_file() else None
    sequences = None if box is not None else [run.recording.name]
    # the trace knows when its frames came
    return find_dataset(name, root, sequences, box, frame_times="even").sequences[0]


def _sheet(scene: Scene, frames: Sequence[int], path: Path) -> None:
    import cv2

    from lae_sim.files import written_whole

    _, encoded = cv2.imencode(path.suffix.lower(), scene.strip(frames))
    with written_whole(path) as temporary:
        temporary.write_bytes(encoded.tobytes())
