"""``lae-sim train``: train the learned forecaster on traces."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import count
from typing import Any

from lae_sim.cli.options import (
    add_worlds,
    argument,
    check_outputs,
    exit_status,
    new_parser,
    print_json,
)
from lae_sim.engine.clock import whole
from lae_sim.errors import LaeError
from lae_sim.progress import ProgressBar, print_text

PROGRAM = "lae-sim train"

EXAMPLES = """\
examples:
  lae-sim train traces/synthetic-slow.parquet --out forecaster.npz
  lae-sim train DTB70-*.parquet --latency constant:20ms constant:47ms constant:100ms --out f.npz
  lae-sim replay other.parquet --forecaster kalman learned:f.npz
  lae-sim train --made-up 6000 --steps 10000 --seed 14 --out learned.npz     # the one that ships

Scores on the sequences that it was trained on promise nothing: lae-sim compare --forecaster trained
trains across folds, so that no sequence is scored by what has seen it.
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        PROGRAM,
        "Train a small network to forecast, from what replays of traces ask of it.",
        EXAMPLES,
    )
    add = made.add_argument
    add("traces", nargs="*", metavar="TRACE", help="traces, better of every frame")
    add(
        "--made-up",
        type=argument(partial(whole, least=2)),
        metavar="N",
        help="instead of traces, N sequences of made-up motion and a quarter as many with dropped "
        "frames",
    )
    add("--out", required=True, metavar="FILE", help="the trained forecaster, such as f.npz")
    add("--sequence", nargs="+", metavar="NAME", help="these sequences only")
    add("--exclude", nargs="+", default=[], metavar="NAME", help="all sequences but these")
    add(
        "--steps",
        type=argument(partial(whole, least=1)),
        default=1000,
        metavar="N",
        help="steps of gradient descent (default: 1000)",
    )
    add("--seed", type=argument(whole), default=0, help="of the training (default: 0)")
    add("--json", action="store_true", help="print what was done as JSON")
    add_worlds(made, [Fraction(1, 2), Fraction(1), Fraction(2)])
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit status is 2 for bad input."""
    arguments = parser().parse_args(argv)
    return exit_status(
        lambda: _train(arguments), PROGRAM, arguments.max_decoded, prints_result=False
    )


def _train(arguments: argparse.Namespace) -> None:
    from lae_sim import __version__
    from lae_sim.cli.options import policies_of, worlds_of
    from lae_sim.forecast.learned import Learned, write_learned
    from lae_sim.learning.folds import Examples
    from lae_sim.learning.motion import made_up_trace
    from lae_sim.learning.trainers import NetworkTrainer
    from lae_sim.replay.world import World
    from lae_sim.trace.file import read_trace
    from lae_sim.trace.locate import find_traces

    if bool(arguments.traces) == (arguments.made_up is not None):
        raise LaeError("give traces to train on, or --made-up N")
    for name in ("sequence", "exclude"):
        if arguments.made_up and getattr(arguments, name):
            raise LaeError(f"--{name} goes with traces, not with --made-up")
    paths = find_traces(arguments.traces) if arguments.traces else []
    check_outputs(arguments, [arguments.out], paths)
    origin: dict[str, Any] = {"lae_sim": __version__}
    if arguments.made_up:
        count_dropped = arguments.made_up // 4
        traces = [made_up_trace(arguments.made_up, arguments.seed)]
        if count_dropped:
            traces.append(made_up_trace(count_dropped, arguments.seed, dropped=True))
        examples = Examples.of_traces(traces, [World()])
        origin |= {"made_up": arguments.made_up, "sequences": []}  # no real ones
    else:
        traces = [read_trace(path, arguments.sequence) for path in paths]
        examples = Examples.of_traces(traces, worlds_of(arguments), arguments.exclude)
        origin |= {
            "traces": paths,
            "latencies": arguments.latency,
            "scales": [str(scale) for scale in arguments.latency_scale],
            "policy": policies_of(arguments, traces),
        }
    made = count(1)
    with ProgressBar("training", "steps") as bar:
        trainer = NetworkTrainer(
            steps=arguments.steps, progress=lambda _: bar(next(made), arguments.steps)
        )
        learned = trainer.fit(examples, arguments.seed)
    document = {**learned.document, **origin}
    learned = Learned(replace(learned.network, document=document))
    write_learned(learned, arguments.out)
    digest = learned.network.digest
    if arguments.json:
        print_json({"forecaster": arguments.out, "digest": digest, **document})
        return
    print_text(
        f"{arguments.out}: trained on {len(examples.item):,} queries of "
        f"{len(set(examples.sequences)):,} sequences, {arguments.steps:,} steps, seed "
        f"{arguments.seed}; weights {digest[:16]}\n\n"
        f"next:\n  lae-sim replay OTHER.parquet --forecaster kalman learned:{arguments.out}"
    )
