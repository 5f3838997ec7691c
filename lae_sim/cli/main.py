"""``lae-sim``, which holds all commands."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import Any

from lae_sim import __version__
from lae_sim.cli.options import bare_parser, exit_status
from lae_sim.errors import install
from lae_sim.progress import print_text

COMMANDS = {
    "compare": "compare forecasters, with intervals and paired tests",
    "convert": "make a trace from results that a tracker left (boxes and times)",
    "fidelity": "measure how far replays of a tracker are from its closed loop",
    "get": "make a trace of public results by name, or list those there are",
    "profile": "run a tracker on this device and leave a trace",
    "render": "draw a replay over its frames, as a film or a contact sheet",
    "replay": "replay traces and score them, latency counted",
    "show": "say what a trace holds: provenance, times, stalls, drift",
    "study": "replay and score traces in every way, on all cores or a cluster: tables and report",
    "train": "train the learned forecaster on traces",
}

EXTRAS = {
    "torch": "torch",
    "onnx": "onnxruntime",
    "fast": "numba",
    "film": "av",
    "trax": "vot-trax",
    "mat73": "h5py",
    "ros": "rosbags",
    "remote": "fsspec",
    "distributed": "distributed",
    "notebook": "nbclient",
}
"""Extras of this package that users may want, each with the package that it is for."""

_PATHS = ("DIR", "FILE", "FOLDER", "PATH", "RESULTS", "ROOT", "STUDY.toml", "TRACE")
"""What options and arguments call their values where these are files or folders."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim COMMAND ...``."""
    parser = _parser()
    parser.usage = "lae-sim COMMAND ..."
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help=argparse.SUPPRESS)
    arguments = list(sys.argv[1:] if argv is None else argv)
    own = 2 if arguments[:1] == ["--print-completion"] else 1
    command = parser.parse_args(arguments[:own]).command
    status: int = importlib.import_module(f"lae_sim.cli.{command}").main(arguments[1:])
    return status


def _parser() -> argparse.ArgumentParser:
    """What comes before a command."""
    listing = "\n".join(f"  {name:9}{text}" for name, text in COMMANDS.items())
    made = bare_parser(
        "lae-sim",
        "Latency-aware evaluation of visual trackers.",
        f"commands:\n{listing}\n\nlae-sim COMMAND --help says more.",
    )
    made.add_argument(
        "--version",
        nargs=0,
        action=_Print,
        const=version_text,
        help="say which version this is, and which extras it finds",
    )
    made.add_argument(
        "--print-completion",
        choices=("bash", "zsh"),
        action=_Print,
        const=completion_script,
        help="print what completes this command in a shell, for its start-up file: "
        'eval "$(lae-sim --print-completion bash)"',
    )
    return made


class _Print(argparse.Action):
    """An option that prints a text, ``const`` called with its values, and ends the command."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: object, values: Any, option: object = None
    ) -> None:
        values = [values] if isinstance(values, str) else values
        parser.exit(exit_status(lambda: print_text(self.const(*values)), parser.prog))


def version_text() -> str:
    """The versions of this package and of what its results rest on, and the extras that it finds.

    Nothing is imported for it but what it asks for versions.
    """
    import platform
    from importlib import metadata

    lines = [f"lae-sim {__version__}", f"Python {platform.python_version()}"]
    lines += [f"{name} {metadata.version(name)}" for name in ("numpy", "pyarrow", "simpy")]
    for extra, package in EXTRAS.items():
        try:
            found = f"{package} {metadata.version(package)}"
        except metadata.PackageNotFoundError:
            found = f"no {package} ({install(extra)})"
        lines.append(f"extra {extra}: {found}")
    return "\n".join(lines)


def completion_script(shell: str) -> str:
    """A script by which a shell completes commands, options, their choices, and files.

    Args:
        shell: ``"bash"`` or ``"zsh"``.
    """
    import shtab

    whole = _parser()
    commands = whole.add_subparsers()
    for name, text in COMMANDS.items():
        parser = importlib.import_module(f"lae_sim.cli.{name}").parser()
        commands.add_parser(name, parents=[parser], add_help=False, help=text)
        for action in parser._actions:
            if action.metavar in _PATHS:
                action.complete = shtab.FILE
    script: str = shtab.complete(whole, shell)
    return script
