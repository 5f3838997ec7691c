"""What the command lines share, and ``lae-sim``, which holds them all."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from lae_sim import __version__
from lae_sim.errors import LaeError

COMMANDS = {
    "compare": "compare forecasters, with intervals and paired tests",
    "convert": "make a trace from results that a tracker left (boxes and times)",
    "fidelity": "measure how far replays of a tracker are from its closed loop",
    "profile": "run a tracker on this device and leave a trace",
    "render": "draw a replay over its frames, as a film or a contact sheet",
    "replay": "replay traces and score them, latency counted",
    "show": "say what a trace holds: provenance, times, stalls, drift",
    "study": "replay and score traces in every way, on all cores or a cluster: tables and report",
    "train": "train the learned forecaster on traces",
}

Parsed = TypeVar("Parsed")


def argument(parse: Callable[[str], Parsed]) -> Callable[[str], Parsed]:
    """A parser of text as an argparse ``type``, so that its error names the option."""

    def parsed(text: str) -> Parsed:
        try:
            return parse(text)
        except LaeError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parsed


def new_parser(program: str, description: str, examples: str) -> argparse.ArgumentParser:
    """A command line's parser, whose help ends with examples."""
    return argparse.ArgumentParser(
        prog=program,
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def exit_status(work: Callable[[], None], program: str) -> int:
    """Do the work of a command; its exit status is 0, 2 for an error, 130 for Ctrl-C.

    An error is one or two lines on the standard error stream, without a traceback.
    """
    try:
        work()
        sys.stdout.flush()
    except LaeError as error:
        print(f"{program}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader, such as head, has gone: stay silent from here on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        print(f"{program}: error: {error}", file=sys.stderr)
        return 2
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim COMMAND ...``; each command is also ``python -m lae_sim.COMMAND``."""
    listing = "\n".join(f"  {name:9}{text}" for name, text in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="lae-sim",
        usage="lae-sim COMMAND ...",
        description="Latency-aware evaluation of visual trackers.",
        epilog=f"commands:\n{listing}\n\nlae-sim COMMAND --help says more.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"lae-sim {__version__}")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help=argparse.SUPPRESS)
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = parser.parse_args(arguments[:1]).command
    status: int = importlib.import_module(f"lae_sim.{command}").main(arguments[1:])
    return status
