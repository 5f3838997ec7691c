"""``lae-sim``, which holds all commands."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from lae_sim import __version__
from lae_sim.cli.options import bare_parser

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


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim COMMAND ...``."""
    listing = "\n".join(f"  {name:9}{text}" for name, text in COMMANDS.items())
    parser = bare_parser(
        "lae-sim",
        "Latency-aware evaluation of visual trackers.",
        f"commands:\n{listing}\n\nlae-sim COMMAND --help says more.",
    )
    parser.usage = "lae-sim COMMAND ..."
    parser.add_argument("--version", action="version", version=f"lae-sim {__version__}")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help=argparse.SUPPRESS)
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = parser.parse_args(arguments[:1]).command
    status: int = importlib.import_module(f"lae_sim.cli.{command}").main(arguments[1:])
    return status
