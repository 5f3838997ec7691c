"""``lae-sim profile``: run a tracker once on this device and leave a trace."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim import __version__
from lae_sim.cli.options import argument, exit_status, new_parser, parse_box, parse_stride
from lae_sim.engine.clock import NS_PER_SECOND, parse_duration, parse_fps, whole
from lae_sim.errors import LaeError
from lae_sim.forecast.costs import parse_cost
from lae_sim.learning.registry import load_forecaster
from lae_sim.plugins import key_and_value

if TYPE_CHECKING:
    from lae_sim.datasets.frames import Dataset, ImageSequence
    from lae_sim.profile.live import LiveRun
    from lae_sim.profile.passes import Pass, Progress
    from lae_sim.profile.timed import TimedTracker

PROGRAM = "lae-sim profile"

EXAMPLES = """\
examples:
  lae-sim profile                                      dcf on the synthetic sequences: try it out
  lae-sim profile --dataset DTB70 --root ~/data/DTB70 --stride 3/2 2 3
  lae-sim profile --tracker nanotrack --option weights=nanotrackv3 --root ~/data/DTB70
  lae-sim profile --tracker my_package.my_module:MyTracker --option size=small --device cuda:0
  lae-sim profile --mode real-time --pre-forecaster kalman --timing jetson.parquet
  lae-sim profile --closed-loop constant:47ms constant:100ms --stride 3/2 2 3  then lae-sim fidelity

trackers:
  dcf                     a correlation filter, no weights needed
  nanotrack               NanoTrack v2 or v3 (--option weights=FOLDER with the two ONNX files)
  opencv:NAME             mil, nano, vit, dasiamrpn; csrt and kcf with the contrib build
  pysot                   SiamRPN++, SiamMask: --option checkout= config= snapshot=
  pytracking              ATOM, DiMP, PrDiMP: --option checkout= tracker= parameter= network=
  trax:COMMAND            any program that speaks TraX
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
    add("--trust-checkpoint", action="store_true", help="let pytracking unpickle its checkpoint")
    add("--translate", action="store_true", help="set the search by shifting the frame")
    add("--python", metavar="PATH", help="interpreter of the worker process (3.8 or newer)")
    add("--in-process", action="store_true", help="no worker process, no timeouts: for debugging")
    add(
        "--threads",
        type=argument(partial(whole, least=1)),
        metavar="N",
        help="threads that the tracker may use",
    )
    add(
        "--frame-timeout",
        type=argument(parse_duration),
        default=30_000_000_000,
        metavar="TIME",
        help="give a sequence up when a call takes longer (default: 30s)",
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
        help="real-time: the schedule follows these times instead of the measured ones",
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
        "--repeat",
        type=argument(partial(whole, least=1)),
        default=1,
        metavar="N",
        help="repeat the first pass (default: 1)",
    )
    add("--include-decode", action="store_true", help="count the decoding of frames")
    group = made.add_argument_group("output")
    add = group.add_argument
    add("--out", metavar="TRACE", help="the trace (default: TRACKER-DATASET.parquet)")
    add("--resume", action="store_true", help="go on with a profile that was interrupted")
    add("--json", action="store_true", help="print what was written as JSON")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 1 if sequences failed, 2 for bad input."""
    arguments = parser().parse_args(argv)
    failed: list[int] = []
    status = exit_status(lambda: failed.append(_profile(arguments)), PROGRAM)
    return status or int(any(failed))


def _profile(arguments: argparse.Namespace) -> int:
    """Profile, write the traces and say what was done; how many sequences failed."""
    import json

    from tqdm import tqdm

    from lae_sim.datasets.layouts import find_dataset
    from lae_sim.profile.journal import Journal
    from lae_sim.profile.passes import run_pass, summary, warm_up, write_pass
    from lae_sim.trace.file import read_trace

    dataset = find_dataset(
        arguments.dataset, arguments.root, arguments.sequence, arguments.box, arguments.fps
    )
    out = _out(arguments, dataset.name)
    unfinished = out.with_suffix(".unfinished")
    if arguments.resume and out.exists() and not unfinished.exists():
        held = read_trace(out).metadata
        print(
            f"{PROGRAM}: {out} is complete ({held.tracker} on {held.dataset}): nothing to resume; "
            "remove it to profile anew",
            file=sys.stderr,
        )
        return 0
    if out.exists() and not arguments.resume:
        print(f"{PROGRAM}: {out} will be replaced", file=sys.stderr)
    failures: dict[str, list[dict[str, Any]]] = {}
    interrupted = False
    with closing(_tracker(arguments)) as tracker:
        with suppress(LaeError):  # a tracker may import libraries, or reach the GPU, only now
            warm_up(tracker, dataset.sequences[0], min(arguments.warmup, 1))
        passes = _passes(arguments, dataset, tracker, out)
        journal = Journal(unfinished, _settings(arguments, tracker), arguments.resume)
        total = sum(map(len, dataset.sequences)) * sum(task.rounds for task in passes)
        with tqdm(total=total, desc=arguments.tracker, unit=" frames", disable=None) as bar:
            try:
                for task in passes:
                    failures[task.name] = run_pass(
                        task,
                        dataset,
                        tracker,
                        journal,
                        arguments.warmup,
                        bar.update,
                        buffered=not arguments.include_decode,
                    )
            except KeyboardInterrupt:
                interrupted = True
    written = [task for task in passes if write_pass(task, journal, failures.get(task.name, []))]
    if not interrupted:
        journal.remove()
    failed = [failure for found in failures.values() for failure in found]
    for failure in failed:
        print(f"{PROGRAM}: failed: {failure['reason']}", file=sys.stderr)
    if interrupted:
        kept = f"{out} holds what is complete; " if written else ""
        print(f"{PROGRAM}: {kept}--resume goes on", file=sys.stderr)
        raise KeyboardInterrupt
    if not written:
        raise LaeError("no sequence could be profiled")
    reports = [summary(task.path) for task in written]
    if arguments.json:
        print(json.dumps({"traces": reports, "failures": failed}, indent=2))
    else:
        _print_summary(reports)
    return len(failed)


def _out(arguments: argparse.Namespace, dataset: str) -> Path:
    """The path of the first trace."""
    if arguments.out is None:
        name = f"{arguments.tracker}-{dataset}"
        return Path("".join(c if c.isalnum() or c in "-_" else "-" for c in name) + ".parquet")
    if not arguments.out.endswith(".parquet"):
        raise LaeError(f"--out {arguments.out}: call the trace something.parquet")
    return Path(arguments.out)


def _tracker(arguments: argparse.Namespace) -> TimedTracker:
    """The tracker, in a worker process unless asked otherwise, under translation if needed."""
    from lae_sim.plugins import parse_options
    from lae_sim.profile.translation import Translated
    from lae_sim.profile.worker import InProcess, Worker

    if (arguments.translate or arguments.keep_size) and arguments.pre_forecaster is None:
        raise LaeError("--translate and --keep-size are ways to use a --pre-forecaster")
    options = parse_options(dict(arguments.option))
    if arguments.device is not None:
        options["device"] = arguments.device
    if arguments.trust_checkpoint:
        options["trust_checkpoint"] = True
    tracker: TimedTracker
    if arguments.in_process:
        tracker = InProcess(arguments.tracker, options, threads=arguments.threads)
    else:
        tracker = Worker(
            arguments.tracker,
            options,
            python=arguments.python,
            threads=arguments.threads,
            timeout=arguments.frame_timeout / NS_PER_SECOND,
        )
    needed = arguments.pre_forecaster is not None and not tracker.sets_search
    if needed:
        print(f"{PROGRAM}: the tracker has no set_search, so frames are shifted", file=sys.stderr)
    return Translated(tracker) if arguments.translate or needed else tracker


def _passes(
    arguments: argparse.Namespace, dataset: Dataset, tracker: TimedTracker, out: Path
) -> list[Pass]:
    """The first pass and its repetitions, the strided ones and the closed loops."""
    from lae_sim.engine.clock import Clock
    from lae_sim.files import check_distinct
    from lae_sim.forecast.camera import Camera
    from lae_sim.profile.live import run_every_frame, run_real_time
    from lae_sim.profile.passes import Pass, base_document, parse_timing, scheduled
    from lae_sim.profile.translation import Translated
    from lae_sim.replay.strides import phases

    clock = Clock.at(dataset.fps)
    from lae_sim.replay.world import parse_policy

    policy = parse_policy(arguments.policy or "latest")
    mode = arguments.mode or (
        "real-time" if arguments.policy or arguments.timing else "every-frame"
    )
    if mode == "every-frame" and (arguments.policy or arguments.timing):
        raise LaeError("--policy and --timing are for --mode real-time")
    if mode == "real-time" and (arguments.stride or arguments.closed_loop):
        raise LaeError("--stride and --closed-loop go with --mode every-frame")
    includes = "init and track calls" + (
        " and the decoding of frames" if arguments.include_decode else "; frames decoded before"
    )
    document = base_document(
        arguments.tracker, tracker, dataset.name, clock, arguments.warmup, includes
    )
    common: dict[str, Any] = {"tracker": tracker, "include_decode": arguments.include_decode}
    if arguments.pre_forecaster is not None:
        named, cost = arguments.pre_forecaster, arguments.pre_forecaster_cost
        camera = Camera({}, dataset.fps)  # a live sequence brings its frames
        common["pre_forecaster"] = load_forecaster(named, camera)
        common["forecaster_ns"], common["keep_size"] = cost, arguments.keep_size
        document["schedule"] = {
            "pre_forecaster": named,
            "pre_forecaster_cost": "measured" if cost is None else f"{cost} ns",
            "search": "translation" if isinstance(tracker, Translated) else "native",
            "keep_size": arguments.keep_size,
        }

    def task(name: str, run: Callable[..., LiveRun], rounds: int = 1, **schedule: Any) -> Pass:
        path = out.with_suffix(f".{name}.parquet") if name else out
        return Pass(name or "first", path, scheduled(document, **schedule), run, rounds)

    def real_time(name: str, timing: str | None) -> Pass:
        source, times = parse_timing(timing) if timing else ("measured", None)

        def run(sequence: ImageSequence, progress: Progress) -> LiveRun:
            service = times(sequence) if times else None
            return run_real_time(
                sequence, clock=clock, policy=policy, service=service, progress=progress, **common
            )

        named = arguments.policy or "latest"
        return task(name, run, kind="real-time", policy=named, source=source)

    def whole(name: str) -> Pass:
        if mode == "real-time":
            return real_time(name, arguments.timing)
        return task(name, partial(run_every_frame, **common), kind="every-frame")

    passes = [whole("")]
    passes += [whole(f"repeat{n}") for n in range(2, arguments.repeat + 1)]
    passes += [
        task(
            f"stride{stride}".replace("/", "-"),
            partial(run_every_frame, stride=stride, **common),
            rounds=len(phases(stride, 4 * stride.numerator)),
            kind="every-frame",
            stride=str(stride),
        )
        for stride in dict.fromkeys(arguments.stride)
    ]
    passes += [
        real_time(f"closed-loop-{_short(timing)}", timing)
        for timing in dict.fromkeys(arguments.closed_loop)
    ]
    traces = [arguments.timing, *arguments.closed_loop]
    inputs = [timing for timing in traces if timing and not timing.startswith("constant:")]
    check_distinct([each.path for each in passes], inputs)
    return passes


def _settings(arguments: argparse.Namespace, tracker: TimedTracker) -> dict[str, Any]:
    """What decides the results, for a resumed run to compare."""
    given = {k: str(v) for k, v in vars(arguments).items() if k not in ("out", "resume", "json")}
    told = {f"tracker's {key}": value for key, value in tracker.describe().items()}
    return {"lae_sim": __version__, **given, **told}


def _print_summary(reports: Sequence[Mapping[str, Any]]) -> None:
    import shlex

    from lae_sim.report.trace import profile_table

    print(profile_table(reports))
    first, *others = (shlex.quote(r["trace"]) for r in reports)
    kinds = [r["schedule"]["kind"] for r in reports]
    strided = [t for t, r in zip(others, reports[1:]) if "stride" in r["schedule"]]
    closed = [t for t, kind in zip(others, kinds[1:]) if kind == "real-time" != kinds[0]]
    passes = f" --strided {' '.join(strided)}" if strided else ""
    print("\nnext:")
    print(f"  lae-sim replay {first}{passes}")
    if closed:
        print(f"  lae-sim fidelity {first}{passes} --closed-loop {' '.join(closed)}")
    print(f"  lae-sim show {first}")


def _short(timing: str) -> str:
    """What tells a closed loop's trace from others."""
    constant = timing.startswith("constant:")
    return timing.removeprefix("constant:") if constant else Path(timing).stem
