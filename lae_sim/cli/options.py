"""What commands share: options, checks of the files they write, and how they end."""

from __future__ import annotations

import argparse
import os
import re
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import product
from typing import TYPE_CHECKING, Any, NoReturn, TextIO, TypeVar

from lae_sim.decoding import MAX_DECODED, max_decoded, parse_size
from lae_sim.engine.clock import parse_fps, parse_rational, whole
from lae_sim.errors import LaeError, abridged, hint, visible
from lae_sim.progress import OutputError, print_text, printing, tell

if TYPE_CHECKING:
    from lae_sim.replay.world import World
    from lae_sim.trace.file import Trace


def add_world(parser: argparse.ArgumentParser, sweeps: bool = False) -> None:
    """Add what decides a replay: the frame rate, the policy and the processing times.

    Args:
        parser: the command line.
        sweeps: whether the rate and the scale of the times may be several: they are lists then,
            that of the rates empty unless they are given.
    """
    add = _world_group(parser, sweeps)
    add(
        "--latency",
        default="recorded",
        help="where processing times come from (default: recorded); constant:47ms,init=800ms "
        "tells the initialisation apart",
    )
    add(
        "--latency-scale",
        type=argument(parse_rational),
        metavar="FACTOR",
        **({"nargs": "+", "default": [Fraction(1)]} if sweeps else {"default": Fraction(1)}),
        help="multiply all times by an exact factor, such as 2 or 1/3"
        + (", or by several, one after another" if sweeps else ""),
    )
    add("--timing", metavar="TRACE", help="take the times from another device's trace")

    add_passes(add)


def add_frame_times(add: Callable[..., argparse.Action]) -> None:
    """Add when frames come among whose images numbers are missing, by what adds to a group."""
    add(
        "--frame-times",
        choices=("numbers", "even"),
        help="where image numbers are missing, as if a camera had dropped frames: let each image "
        "come at the time of its number, or one after another (default: such images are refused)",
    )


def add_force(add: Callable[..., argparse.Action]) -> None:
    """Add that a trace may replace what is there, by what adds to a parser or a group."""
    add(
        "--force",
        action="store_true",
        help="replace a trace of another tracker or dataset, or what is no trace",
    )


def add_passes(add: Callable[..., argparse.Action]) -> None:
    """Add further passes of the tracker, by what adds to a parser or a group."""
    add(
        "--strided",
        nargs="+",
        default=[],
        metavar="TRACE",
        help="further passes of the tracker: on every N-th frame (lae-sim profile --stride; each "
        "sequence's boxes come from the one nearest to the frames skipped), and gap passes "
        "(--gaps), which say how far it reaches; of several traces, each goes with those of its "
        "tracker and dataset",
    )


def add_search(parser: argparse.ArgumentParser, pre_forecaster: bool = True) -> None:
    """Add what the search model takes: how far the tracker reaches, and from where.

    Args:
        parser: the command line.
        pre_forecaster: whether it may say where the tracker searches.
    """
    add = parser.add_argument_group("the search model").add_argument
    add(
        "--search",
        default="trace",
        metavar="C",
        help="how far the tracker finds its target: c=0.7 search sides, a range c=0.6-1.0, what "
        "the traces know (trace, the default), or no search model (off)",
    )
    if not pre_forecaster:
        return
    add(
        "--pre-forecaster",
        metavar="NAME",
        help="a forecaster that says where the tracker searches, such as kalman: what it is worth "
        "is the search model's",
    )
    add("--keep-size", action="store_true", help="the pre-forecaster says the centre only")


def add_worlds(parser: argparse.ArgumentParser, scales: Sequence[Fraction]) -> None:
    """Add what decides several replays, one after another.

    Args:
        parser: the command line.
        scales: exact factors on all times, by default.
    """
    add = _world_group(parser)
    add(
        "--latency",
        nargs="+",
        default=["recorded"],
        metavar="SOURCE",
        help="processing times, one after another: recorded, constant:47ms,init=800ms, ... as in "
        "replay",
    )
    add(
        "--latency-scale",
        nargs="+",
        type=argument(parse_rational),
        default=list(scales),
        metavar="FACTOR",
        help="exact factors on all times, one after another "
        f"(default: {' '.join(map(str, scales))})",
    )


def _world_group(
    parser: argparse.ArgumentParser, sweeps: bool = False
) -> Callable[..., argparse.Action]:
    """A group of options that begins with the world's rate and the policy; what adds to it."""
    group = parser.add_argument_group("the world and the tracker")
    add: Callable[..., argparse.Action] = group.add_argument
    several = (
        "; several are a sweep of how fast the world moves, since the motion from one recorded "
        "frame to the next stays what it is"
    )
    add(
        "--fps",
        type=argument(parse_fps),
        **({"nargs": "+", "default": []} if sweeps else {}),
        help="world frame rate, exact (default: the trace's)" + (several if sweeps else ""),
    )
    add(
        "--forget-arrivals",
        action="store_true",
        help="let frames arrive evenly also where the trace says when each of them did",
    )
    add(
        "--policy",
        help="which frame a free tracker takes (default: latest; recorded, of a measured log)",
    )
    return add


def add_forecasting(parser: argparse.ArgumentParser) -> None:
    """Add what forecasters need: the frames of the camera's motion, and what they cost."""
    group = parser.add_argument_group("the forecasters")
    add = group.add_argument
    add("--root", metavar="PATH", help="folder of the dataset's frames, for camera+NAME")
    add("--dataset", metavar="NAME", help="the dataset in --root, if its folder does not say")
    add(
        "--camera-lag",
        type=argument(whole),
        metavar="FRAMES",
        help="by which the camera's motion is late (default: by what estimating it takes here)",
    )
    add(
        "--cost",
        nargs="+",
        default=[],
        metavar="[NAME=]TIME",
        help="what forecasting costs, such as 2ms, or measured; it delays the answers (default: 0)",
    )


def parse_box(text: str) -> tuple[float, ...]:
    """A box ``x,y,w,h`` in pixels.

    Raises:
        LaeError: if the text is none.
    """
    try:
        x, y, w, h = (float(value) for value in text.split(","))
    except ValueError as error:
        raise LaeError(f"{text!r} is not a box x,y,w,h in pixels") from error
    return x, y, w, h


Parsed = TypeVar("Parsed")


def argument(parse: Callable[[str], Parsed]) -> Callable[[str], Parsed]:
    """A parser of text as an argparse ``type``, so that its error names the option."""

    def parsed(text: str) -> Parsed:
        try:
            return parse(text)
        except LaeError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parsed


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are as short as those of the work."""

    def error(self, message: str) -> NoReturn:
        if unknown := re.match(r"unrecognized arguments: (--[^\s=]+)", message):
            message += hint(unknown[1], self._option_string_actions)
        tell(f"{self.prog}: error: {abridged(visible(message))} ({self.prog} --help says more)")
        self.exit(2)


def bare_parser(program: str, description: str, epilog: str) -> argparse.ArgumentParser:
    """A parser without options, whose help ends with the epilog as it is."""
    return _Parser(
        prog=program,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def new_parser(program: str, description: str, examples: str) -> argparse.ArgumentParser:
    """A command's parser, with the option that all have; its help ends with examples."""
    made = bare_parser(program, description, examples)
    made.add_argument(
        "--max-decoded",
        type=argument(parse_size),
        default=MAX_DECODED,
        metavar="SIZE",
        help=f"how much memory a file that is read may take, decoded (default: {MAX_DECODED})",
    )
    return made


class Ended(KeyboardInterrupt):
    """A signal to end, which is heeded as Ctrl-C is."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = signal.Signals(number)


def exit_status(
    work: Callable[[], None],
    program: str,
    decoded: int | str = MAX_DECODED,
    prints_result: bool = True,
) -> int:
    """Do the work of a command; its exit status is 0, 2 for an error, 1 where memory ran out.

    After Ctrl-C it is 130, after SIGTERM 143 and after SIGHUP 129, each 128 and its number: what
    ends the work takes its half-written files with it. An error is one or two lines on the standard
    error stream, without a traceback. Work prints when it has written its files: that nobody reads
    what it prints is no error.

    Args:
        work: reads, computes, writes and prints.
        program: what its messages begin with.
        decoded: what a file may take in memory (see :func:`lae_sim.decoding.max_decoded`).
        prints_result: whether what it prints is the result, and lost if it cannot be printed; and
            not only words about files.
    """
    _occupy_closed_streams()
    try:
        with _signals_raised(), max_decoded(decoded):
            work()
            if sys.stdout is not None:
                with printing():
                    sys.stdout.flush()
    except Ended as end:
        tell(f"{program}: ended by {end.number.name}")
        return 128 + end.number
    except KeyboardInterrupt:
        tell(f"{program}: interrupted")
        return 128 + signal.SIGINT
    except MemoryError:
        tell(f"{program}: error: out of memory: give it more, or fewer sequences or traces at once")
        return 1
    except (LaeError, OSError) as error:
        if isinstance(error, BrokenPipeError) and _reader_gone(sys.stdout):  # such as head
            _forget_output()
            return 0
        if isinstance(error, OutputError):
            _forget_output()
            lost = "the result is lost" if prints_result else "the files are written"
            tell(f"{program}: {'error: ' * prints_result}{error}: {lost}")
            return 2 * prints_result
        tell(f"{program}: error: {abridged(visible(error))}")
        return 2
    return 0


def _forget_output() -> None:
    """Let what is still to be printed go nowhere, or Python would try it again at its end."""
    with suppress(OSError):  # a standard output that is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document as strict JSON, in letters that every terminal has."""
    import json

    text = json.dumps(document, indent=2, allow_nan=False)
    print_text(text.replace("\x7f", "\\u007f"))  # which JSON, but no terminal, takes for a letter


@contextmanager
def _signals_raised() -> Iterator[None]:
    """Raise signals that would end this process at once, unless they are ignored, as by nohup."""

    def end(number: int, frame: object) -> None:
        raise Ended(number)

    ours = threading.current_thread() is threading.main_thread()  # no other may ask for signals
    numbers = [signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)] if ours else []
    raised = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in raised:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in raised:
            signal.signal(number, signal.SIG_DFL)


def _occupy_closed_streams() -> None:
    """Let no file be opened under the number of a closed stream: what others print would go there.

    ``print`` itself writes nothing where a stream was closed when Python started.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def _reader_gone(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads any more; not some other pipe that broke."""
    if not hasattr(select, "poll"):  # Windows
        return True
    ends = select.poll()
    ends.register(stream.fileno(), 0)
    return bool(ends.poll(0))


def check_outputs(
    arguments: argparse.Namespace,
    outputs: Iterable[str | os.PathLike[str] | None],
    traces: Iterable[str] = (),
) -> None:
    """Refuse, before the work, files that cannot be written, or would replace what is read.

    Args:
        arguments: of which the options that all commands call alike are looked at.
        outputs: what the command writes; none of them is a trace.
        traces: those it reads, as they were found.

    Raises:
        LaeError: if one is an input, another output or a trace, or cannot be written.
    """
    from lae_sim.files import check_distinct, check_places
    from lae_sim.learning.registry import files_named
    from lae_sim.trace.file import trace_at

    def given(*names: str) -> Iterator[str]:
        for value in (getattr(arguments, name, None) for name in names):
            yield from [value] if isinstance(value, str) else value or ()

    written = [path for path in outputs if path]
    read = [*traces, *given("trace", "closed_loop", "strided", "timing", "root", "pipeline")]
    for name in given("forecaster", "pre_forecaster", "latency", "policy"):
        read += files_named(name)
    check_distinct(written, read)
    for path in written:
        if trace_at(path) is not None:
            raise LaeError(f"{path} is a trace: name another file")
    check_places(path for path in written if not os.path.isdir(path))


def check_folder(folder: str, or_else: str = "") -> None:
    """Refuse, before the work, a folder that figures and tables cannot be written to.

    Args:
        folder: the folder, one of those that :func:`check_outputs` looked at.
        or_else: what else could be named.

    Raises:
        LaeError: if it is a file, or called like one, or cannot be written to.
    """
    if os.path.isdir(folder):
        if not os.access(folder, os.W_OK):
            raise LaeError(f"--out {folder}: it cannot be written to: name another folder")
    elif os.path.exists(folder) or os.path.splitext(folder)[1]:
        raise LaeError(f"--out {folder}: name a folder (NAME.WITH.POINTS/ ends in /){or_else}")


def worlds_of(arguments: argparse.Namespace, **scores: Any) -> tuple[World, ...]:
    """The worlds that the options of :func:`add_world` or :func:`add_worlds` name, in their order.

    Args:
        arguments: what argparse made of the command line.
        scores: what else a world has (see :meth:`lae_sim.replay.world.World.of`).

    Raises:
        LaeError: if there is no such policy or latency, or some do not go together.
    """
    from lae_sim.replay.latency import scaled
    from lae_sim.replay.names import parse_latency, parse_policy, several
    from lae_sim.replay.world import World

    for policy in several(arguments.policy):
        parse_policy(policy)  # what is wrong with an option is said without its Python name
    for latency, scale in product(several(arguments.latency), several(arguments.latency_scale)):
        scaled(parse_latency(latency), scale)
    return World.sweep(
        fps=arguments.fps or None,
        policy=arguments.policy,
        latency=arguments.latency,
        scale=arguments.latency_scale,
        timing=getattr(arguments, "timing", None),
        passes=getattr(arguments, "strided", ()),
        search=getattr(arguments, "search", "off"),
        pre_forecaster=getattr(arguments, "pre_forecaster", None),
        keep_size=getattr(arguments, "keep_size", False),
        pipeline=getattr(arguments, "pipeline", None) or None,
        forget_arrivals=arguments.forget_arrivals,
        **scores,
    )


def policies_of(arguments: argparse.Namespace, traces: Iterable[Trace]) -> str:
    """The policy by which traces are replayed, or those of the traces, each once."""
    from lae_sim.replay.world import World

    world = World.of(policy=arguments.policy)
    return ", ".join(dict.fromkeys(world.settled(trace).policy_label for trace in traces))
