"""``lae-sim profile``: run a tracker once on this device and leave a trace."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.cli.options import (
    add_force,
    add_frame_times,
    argument,
    exit_status,
    new_parser,
    parse_box,
    print_json,
)
from lae_sim.engine.clock import parse_budget, parse_duration, parse_fps, parse_stride, whole
from lae_sim.forecast.costs import parse_cost
from lae_sim.plugins import key_and_value
from lae_sim.progress import ProgressBar, print_text, screen_width, tell

if TYPE_CHECKING:
    from lae_sim.profile.passes import PassSummary

PROGRAM = "lae-sim profile"

EXAMPLES = """\
examples:
  lae-sim profile                                      dcf on the synthetic sequences: try it out
  lae-sim profile --dataset DTB70 --root ~/data/DTB70 --stride 3/2 2 3
  lae-sim profile --tracker nanotrack --option weights=nanotrackv3 --root ~/data/DTB70
  lae-sim profile --tracker my_package.my_module:MyTracker --option size=small --device cuda:0
  lae-sim profile --tracker vot:NCC --ini workspace/trackers.ini --root ~/data/DTB70
  lae-sim profile --mode real-time --pre-forecaster kalman --timing jetson.parquet
  lae-sim profile --closed-loop constant:47ms constant:100ms --stride 3/2 2 3  then lae-sim fidelity
  lae-sim profile --gaps 10m --stride 2                how far it finds a target from where it was
  lae-sim profile --root ~/data/DTB70 --beside './encode.sh'    beside the load that it will have
  lae-sim profile --closed-loop constant:47ms,init=1s --stride 3/2 2 3         then lae-sim fidelity

trackers:
  dcf                     a correlation filter, no weights needed
  nanotrack               NanoTrack v2 or v3 (--option weights=FOLDER with the two ONNX files), by
                          OpenCV or with runtime=onnxruntime provider=CPU, CUDA or TensorRT
  opencv:NAME             mil, nano, vit, dasiamrpn; csrt and kcf with the contrib build
  pysot                   SiamRPN++, SiamMask: --option checkout= config= snapshot=
  pytracking              ATOM, DiMP, PrDiMP: --option checkout= tracker= parameter= network=
  trax:COMMAND            any program that speaks TraX
  vot:NAME                what the VOT toolkit's trackers.ini names (--ini PATH)
  package.module:factory  your own: an object with init(frame, box) and track(frame)
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        PROGRAM,
        "Run a tracker on this device and write a trace: per frame, box and time.",
        EXAMPLES,
    )
    group = made.add_argument_group("the tracker")
    add = group.add_argument
    add("--tracker", default="dcf", metavar="NAME", help="see below (default: dcf)")
    add(
        "--option",
        nargs="+",
        default=[],
        action="extend",
        type=argument(key_and_value),
        metavar="KEY=VALUE",
        help="options of the tracker",
    )
    add("--device", help="the option device: cpu, cuda:0")
    add("--ini", metavar="PATH", help="registry of vot:NAME (default: trackers.ini)")
    add("--trust-checkpoint", action="store_true", help="let pytracking unpickle its checkpoint")
    add("--translate", action="store_true", help="set the search by shifting the frame")
    add("--python", metavar="PATH", help="interpreter of the worker process (3.8 or newer)")
    add("--in-process", action="store_true", help="no worker process, no timeouts: for debugging")
    add(
        "--threads",
        type=argument(partial(whole, least=1)),
        metavar="N",
        help="threads that each library of the tracker may use",
    )
    add(
        "--frame-timeout",
        type=argument(parse_duration),
        metavar="TIME",
        help="give a sequence up when a call takes longer (default: 30s or the registry's)",
    )
    add(
        "--warmup",
        type=argument(whole),
        default=5,
        metavar="N",
        help="calls not measured (default: 5)",
    )
    group = made.add_argument_group("the frames")
    add = group.add_argument
    add("--dataset", metavar="NAME", help="such as DTB70; found out from --root if it can be")
    add(
        "--root",
        type=Path,
        metavar="PATH",
        help="folder of the dataset, or a video (default: synthetic)",
    )
    add("--sequence", nargs="+", action="extend", metavar="NAME", help="these sequences only")
    add("--box", type=argument(parse_box), metavar="X,Y,W,H", help="first box, for a video")
    add("--fps", type=argument(parse_fps), help="world frame rate, exact (default: the dataset's)")
    add_frame_times(add)
    group = made.add_argument_group("the run")
    add = group.add_argument
    add(
        "--mode",
        choices=("every-frame", "real-time"),
        help="run every frame, or skip frames while busy (default: every-frame; real-time with "
        "--policy or --timing)",
    )
    add("--policy", metavar="NAME", help="real-time: which frame a free tracker takes (latest)")
    add("--pre-forecaster", metavar="NAME", help="predict the search region, such as kalman")
    add(
        "--pre-forecaster-cost",
        type=argument(parse_cost),
        default=0,
        metavar="TIME",
        help="what it adds to each frame, such as 2ms, or measured (default: 0)",
    )
    add("--keep-size", action="store_true", help="predict the centre of the search region only")
    add(
        "--timing",
        metavar="TRACE|constant:47ms",
        help="real-time: the schedule follows these times instead of the measured ones; "
        ",init=800ms at their end says what the initialisation takes",
    )
    add(
        "--stride",
        nargs="+",
        action="extend",
        type=argument(parse_stride),
        default=[],
        metavar="N",
        help="further passes on every N-th frame (3/2: two of three), which make replays closer",
    )
    add(
        "--closed-loop",
        nargs="+",
        action="extend",
        default=[],
        metavar="TIMING",
        help="further real-time passes under these times, for lae-sim fidelity",
    )
    add(
        "--gaps",
        nargs="?",
        const=True,
        metavar="BUDGET",
        type=argument(parse_budget),
        help="a further pass that measures the tracker's reach by restarts: some 1,000 over the "
        "dataset and 63 calls a sequence, or as many as the budget, such as 10m, allows "
        "(default: 30m)",
    )
    add(
        "--repeat",
        type=argument(partial(whole, least=1)),
        default=1,
        metavar="N",
        help="repeat the first pass (default: 1)",
    )
    add("--include-decode", action="store_true", help="count the decoding of frames")
    add(
        "--beside",
        nargs="+",
        action="extend",
        default=[],
        metavar="COMMAND",
        help="run these shell commands as long as anything is measured, such as the video encoder "
        "that shares the device; they are ended then",
    )
    add(
        "--idle",
        type=argument(parse_duration),
        default=2_000_000_000,
        metavar="TIME",
        help="measure the power at rest so long before the tracker starts, where there are sensors "
        "(default: 2s)",
    )
    group = made.add_argument_group("output")
    add = group.add_argument
    add("--out", metavar="TRACE", help="the trace (default: TRACKER-DATASET.parquet)")
    add("--resume", action="store_true", help="go on with a profile that was interrupted")
    add_force(add)
    add("--json", action="store_true", help="print what was written as JSON")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 1 if sequences failed, 2 for bad input."""
    arguments = parser().parse_args(argv)
    failed: list[Any] = []
    status = exit_status(
        lambda: _profile(arguments, failed), PROGRAM, arguments.max_decoded, prints_result=False
    )
    return status or int(bool(failed))


def _profile(arguments: argparse.Namespace, failed: list[Any]) -> None:
    """Profile, write the traces and say what was done; add the sequences that failed."""
    from lae_sim.plugins import parse_options
    from lae_sim.profile.gaps import BUDGET_NS
    from lae_sim.profile.run import ProfilePlan, run_profile

    options = parse_options(dict(arguments.option))
    if arguments.device is not None:
        options["device"] = arguments.device
    if arguments.ini is not None:
        options["ini"] = arguments.ini
    if arguments.trust_checkpoint:
        options["trust_checkpoint"] = True
    plan = ProfilePlan(
        tracker=arguments.tracker,
        options=options,
        translate=arguments.translate,
        python=arguments.python,
        in_process=arguments.in_process,
        threads=arguments.threads,
        frame_timeout=arguments.frame_timeout,
        warmup=arguments.warmup,
        dataset=arguments.dataset,
        root=arguments.root,
        sequences=arguments.sequence,
        box=arguments.box,
        fps=arguments.fps,
        frame_times=arguments.frame_times,
        mode=arguments.mode,
        policy=arguments.policy,
        pre_forecaster=arguments.pre_forecaster,
        pre_forecaster_cost=arguments.pre_forecaster_cost,
        keep_size=arguments.keep_size,
        timing=arguments.timing,
        strides=tuple(arguments.stride),
        closed_loops=tuple(arguments.closed_loop),
        gaps=BUDGET_NS if arguments.gaps is True else arguments.gaps,
        repeat=arguments.repeat,
        include_decode=arguments.include_decode,
        beside=tuple(arguments.beside),
        idle=arguments.idle,
    )
    with closing(ProgressBar(arguments.tracker, "frames")) as bar:

        def notice(text: str) -> None:
            bar.close()
            tell(f"{PROGRAM}: {text}")

        profile = run_profile(
            plan,
            arguments.out,
            resume=arguments.resume,
            force=arguments.force,
            progress=bar,
            notice=notice,
        )
    if not profile.traces:  # it was complete already
        return
    failed += profile.failures
    if arguments.json:
        print_json(asdict(profile))
    else:
        _print_summary(profile.traces)


def _print_summary(traces: Sequence[PassSummary]) -> None:
    import shlex

    from lae_sim.report.trace import profile_table

    print_text(profile_table(traces, screen_width()))
    first, *others = traces
    kind = first.schedule["kind"]
    strided = [each for each in others if "stride" in each.schedule]
    gaps = [each for each in traces if each.schedule["kind"] == "restarts"]
    closed = [each for each in others if each.schedule["kind"] == "real-time" != kind]

    def named(option: str, passes: Sequence[PassSummary]) -> str:
        paths = " ".join(shlex.quote(each.trace) for each in passes)
        return f" {option} {paths}" if passes else ""

    path, strides = shlex.quote(first.trace), named("--strided", strided + gaps)
    print_text("\nnext:")
    if first not in gaps:  # which are all that is left where every sequence of the others failed
        print_text(f"  lae-sim replay {path}{strides}")
        if closed:
            print_text(f"  lae-sim fidelity {path}{strides}{named('--closed-loop', closed)}")
        print_text(f"  lae-sim show {path}")
    for each in gaps:
        print_text(f"  lae-sim show {shlex.quote(each.trace)} --plot reach.png")
