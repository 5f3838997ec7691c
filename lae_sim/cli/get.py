"""``lae-sim get``: traces of public results by name."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim.cli.options import add_force, exit_status, new_parser, print_json
from lae_sim.errors import LaeError, listed
from lae_sim.files import check_distinct, check_places
from lae_sim.progress import ProgressBar, print_text, tell

if TYPE_CHECKING:
    from lae_sim.recipes.catalogue import Recipe
    from lae_sim.recipes.make import Verdict

_EXAMPLES = """\
Files are downloaded from the public repositories that published them, checked by their SHA-256,
converted here, and kept in the user's cache (or in the folder LAE_SIM_CACHE): a second run needs no
network. Their licence, source and citation are shown, and kept in the trace.

examples:
  lae-sim get                                  list the recipes
  lae-sim get dtb70/nanotrackv3                make dtb70-nanotrackv3.parquet
  lae-sim get otb100/kcf --out kcf.parquet
  lae-sim get dtb70/nanotrackv3 --time constant:47ms,init=800ms
  lae-sim get dtb70/kcf --mirror ~/mirror      from a folder with OWNER/NAME/COMMIT/PATH
  lae-sim get --check                          put every recipe to the test
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``lae-sim get``; see ``--help``."""
    arguments = parser().parse_args(argv)
    return exit_status(
        lambda: _get(arguments),
        "lae-sim get",
        arguments.max_decoded,
        prints_result=arguments.check or not arguments.recipe,
    )


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = new_parser(
        "lae-sim get",
        "Make a trace of public results, by name; without a name, list those there are.",
        _EXAMPLES,
    )
    add = made.add_argument
    add("recipe", nargs="*", metavar="NAME", help="dataset/tracker, as the list has it")
    add("--out", type=Path, metavar="TRACE", help="of one NAME (default: DATASET-TRACKER.parquet)")
    add(
        "--time",
        help="constant:47ms or mean-fps:120, perhaps with ,init=800ms, instead of the published "
        "times (see lae-sim convert)",
    )
    add(
        "--mirror",
        metavar="PLACE",
        help="a folder or an URL that has the files as OWNER/NAME/COMMIT/PATH "
        "(default: https://raw.githubusercontent.com)",
    )
    add(
        "--check",
        action="store_true",
        help="write nothing, but make the traces and compare their scores with those stated; of "
        "all recipes if none is named",
    )
    add_force(add)
    add("--json", action="store_true", help="print JSON")
    return made


def _get(arguments: argparse.Namespace) -> None:
    from lae_sim.recipes.catalogue import find_recipe, list_recipes

    known = list_recipes()
    asked = [find_recipe(name, known) for name in dict.fromkeys(arguments.recipe)]
    if arguments.out and (arguments.check or len(asked) != 1):
        raise LaeError("--out is where the trace of one NAME goes")
    if arguments.time and (arguments.check or not asked):
        raise LaeError("--time goes with the NAME of what is to be made")
    if arguments.check:
        _check(asked or known, arguments)
    elif asked:
        _make(asked, arguments)
    elif arguments.json:
        _print_document([recipe.document() for recipe in known], "recipes")
    else:
        print_text(_listing(known))


def _make(recipes: Sequence[Recipe], arguments: argparse.Namespace) -> None:
    from lae_sim.cli.convert import lines_of
    from lae_sim.recipes.make import made
    from lae_sim.trace.file import check_replaces, write_trace

    written = {recipe.name: arguments.out or Path(recipe.file_name) for recipe in recipes}
    check_places(written.values())
    check_distinct(written.values(), [])
    documents = []
    for recipe in recipes:
        path = written[recipe.name]
        if not arguments.force:
            check_replaces(path, recipe.tracker, recipe.dataset)
        with closing(ProgressBar(f"get {recipe.name}", "kB")) as bar:
            trace, summary = made(
                recipe,
                time=arguments.time,
                mirror=arguments.mirror,
                progress=_in_kilobytes(bar),
            )
        write_trace(trace, path)
        conversion = summary.document(path)
        documents.append({"origin": recipe.origin(), "conversion": conversion})
        if not arguments.json:
            print_text("\n".join([*lines_of(summary, path), *_lines(recipe, path)]))
    if arguments.json:
        _print_document(documents, "traces")


def _in_kilobytes(bar: ProgressBar) -> Callable[[int, int], None]:
    return lambda done, total: bar(done // 1000, total // 1000)


def _lines(recipe: Recipe, path: Path) -> list[str]:
    """Where a trace is from, for people, and how to go on."""
    said = []
    if recipe.time != "measured":
        said.append(
            "No times were published: --time here, or --latency of lae-sim replay, sets them."
        )
    if recipe.boxes.repository.device:
        said.append(f"Device: {recipe.boxes.repository.device}.")
    for what, source in (("Boxes", recipe.boxes), ("Truth", recipe.truth)):
        where = source.repository
        said.append(f"{what}: {where.url} at {where.commit[:12]}; licence: {where.licence}.")
    said += [f"Cite: {text}." for text in recipe.citations]
    if recipe.note:
        said.append(f"Note: {recipe.note}.")
    return [*said, f"Next: lae-sim replay {path}"]


def _check(recipes: Sequence[Recipe], arguments: argparse.Namespace) -> None:
    from dataclasses import asdict

    from lae_sim.recipes.make import check_recipe

    documents: list[dict[str, Any]] = []
    failed = []
    for recipe in recipes:
        try:
            with closing(ProgressBar(f"get {recipe.name}", "kB")) as bar:
                verdict = check_recipe(
                    recipe,
                    mirror=arguments.mirror,
                    progress=_in_kilobytes(bar),
                )
        except LaeError as error:
            failed.append(recipe.name)
            documents.append({"recipe": recipe.name, "holds": False, "error": str(error)})
            tell(f"lae-sim get: {recipe.name}: {error}")
            continue
        if not verdict.holds:
            failed.append(recipe.name)
        documents.append({**asdict(verdict), "holds": verdict.holds})
        if not arguments.json:
            print_text(_verdict(verdict))
    if arguments.json:
        _print_document(documents, "checks")
    if failed:
        raise LaeError(f"{len(failed)} of {len(recipes)} recipes fail: {listed(failed)}")


def _verdict(verdict: Verdict) -> str:
    said = "as stated"
    if not verdict.holds:
        said = f"NOT AS STATED: AUC {verdict.expected_auc:.4f}, DP {verdict.expected_dp20:.4f}"
    return (
        f"{verdict.recipe:<26} {verdict.sequences:>4} sequences {verdict.frames:>8,} frames  "
        f"AUC {verdict.auc:.4f}  DP {verdict.dp20:.4f}  {said}"
    )


def _listing(recipes: Sequence[Recipe]) -> str:
    """A line a recipe, the name first."""
    from lae_sim.report.table import COUNT, SCORE, Column, text_of_records

    columns = (
        Column("name", "name", is_label=True),
        Column("tracker", "tracker", is_label=True),
        Column("times", "times", is_label=True),
        Column("sequences", "sequences", COUNT),
        Column("AUC", "auc", SCORE),
        Column("DP", "dp20", SCORE),
        Column("MB", lambda recipe: sum(file.size for file in recipe.files) / 1e6, "{:.1f}".format),
    )
    return (
        f"{text_of_records(columns, recipes)}\n"
        "AUC, DP: of the boxes on every frame, latency not counted (pysot). MB: to download.\n"
        "Next: lae-sim get NAME"
    )


def _print_document(documents: Sequence[Any], key: str) -> None:
    from lae_sim import __version__

    head = {"format": "lae-get", "version": "1.0", "lae_sim": __version__}
    print_json({**head, key: list(documents)})
