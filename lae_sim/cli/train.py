"""``lae-sim train``: train the learned forecaster on traces."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from itertools import count

from lae_sim.cli.options import (
    add_worlds,
    argument,
    check_outputs,
    exit_status,
    new_parser,
    print_json,
)
from lae_sim.engine.clock import whole
from lae_sim.progress import ProgressBar, print_text

PROGRAM = "lae-sim train"

EXAMPLES = """\
examples:
  lae-sim train traces/synthetic-slow.parquet --out forecaster.pt
  lae-sim train DTB70-*.parquet --latency constant:20ms constant:47ms constant:100ms --out f.pt
  lae-sim replay other.parquet --forecaster kalman learned:f.pt

Scores on the sequences that it was trained on promise nothing: lae-sim compare --forecaster learned
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
    add("traces", nargs="+", metavar="TRACE", help="traces, better of every frame")
    add("--out", required=True, metavar="FILE", help="the trained forecaster, such as f.pt")
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
    from lae_sim.cli.options import worlds_of
    from lae_sim.forecast.learned import Learned, write_learned
    from lae_sim.learning.folds import Examples
    from lae_sim.learning.trainers import NetworkTrainer
    from lae_sim.trace.file import read_trace
    from lae_sim.trace.locate import find_traces

    paths = find_traces(arguments.traces)
    check_outputs(arguments, [arguments.out], paths)
    worlds = worlds_of(arguments)
    traces = [read_trace(path, arguments.sequence) for path in paths]
    examples = Examples.of_traces(traces, worlds, arguments.exclude)
    made = count(1)
    with ProgressBar("training", "steps") as bar:
        trainer = NetworkTrainer(
            steps=arguments.steps, progress=lambda _: bar(next(made), arguments.steps)
        )
        rule = trainer.fit(examples, arguments.seed).rule
    origin = {
        "lae_sim": __version__,
        "traces": paths,
        "latencies": arguments.latency,
        "scales": [str(scale) for scale in arguments.latency_scale],
        "policy": arguments.policy,
    }
    learned = Learned(rule.network, {**rule.document, **origin})
    write_learned(learned, arguments.out)
    if arguments.json:
        print_json({"forecaster": arguments.out, **learned.document})
        return
    print_text(
        f"{arguments.out}: trained on {len(examples.item):,} queries of "
        f"{len(learned.trained_on)} sequences, {arguments.steps:,} steps, seed {arguments.seed}\n\n"
        f"next:\n  lae-sim replay OTHER.parquet --forecaster kalman learned:{arguments.out}"
    )
