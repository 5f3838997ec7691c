"""Traces made by recipes, and recipes put to the test."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from zipfile import ZipFile

from lae_sim.errors import LaeError
from lae_sim.evaluation.metrics import PYSOT
from lae_sim.evaluation.scoring import Scorer
from lae_sim.importers.convert import ConversionSummary, convert_results
from lae_sim.recipes.catalogue import Recipe, Source, find_recipe
from lae_sim.recipes.download import Progress, download
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata

TOLERANCE = 5.1e-5
"""By how much a score may differ from that of a recipe, which has four digits."""


def get_trace(
    recipe: str | Recipe,
    *,
    time: str | None = None,
    mirror: str | os.PathLike[str] | None = None,
    progress: Progress = lambda done, total: None,
) -> Trace:
    """Make a trace of public results: download what is not there yet, check it, convert it.

    Args:
        recipe: or its name, such as ``"dtb70/nanotrackv3"``; see :func:`list_recipes`.
        time: what stands for the processing times, such as ``"constant:47ms,init=800ms"`` (see
            :func:`lae_sim.convert_results`); by default those of the results, or where none were
            published, 47 ms a frame.
        mirror: a folder or an URL that has the same files as ``https://raw.githubusercontent.com``.
        progress: called as bytes arrive.

    Returns:
        The trace, in memory. Its metadata say under ``origin`` where it is from, under which
        licence, and what to cite.

    Raises:
        LaeError: if there is no such recipe, or a file cannot be had or is another one.

    Example:
        >>> import lae_sim
        >>> try:
        ...     lae_sim.get_trace("dtb70/nanotrack3")
        ... except lae_sim.LaeError as error:
        ...     print(error)
        no recipe 'dtb70/nanotrack3'; did you mean 'dtb70/nanotrackv3'?
    """
    return made(recipe, time=time, mirror=mirror, progress=progress)[0]


def made(
    recipe: str | Recipe,
    *,
    time: str | None = None,
    mirror: str | os.PathLike[str] | None = None,
    progress: Progress = lambda done, total: None,
) -> tuple[Trace, ConversionSummary]:
    """The trace that :func:`get_trace` makes, and what its conversion says."""
    if not isinstance(recipe, Recipe):
        recipe = find_recipe(recipe)
    cache = download(recipe.files, mirror, progress)
    with tempfile.TemporaryDirectory(prefix="lae_sim-") as folder:
        boxes, truth = Path(folder, "boxes"), Path(folder, recipe.dataset, "anno")
        _lay_out(recipe.boxes, cache, boxes)
        _lay_out(recipe.truth, cache, truth)
        trace, summary = convert_results(
            boxes,
            truth.parent,
            fps=recipe.fps,
            time=time or recipe.time,
            tracker=recipe.tracker,
            device=recipe.boxes.repository.device,
            dataset=recipe.dataset,
        )
    document = {**trace.metadata.document, "origin": recipe.origin()}
    return replace(trace, metadata=Metadata.of(document)), summary


@dataclass(frozen=True)
class Verdict:
    """What became of a recipe that was put to the test.

    Attributes:
        recipe: its name.
        sequences, frames: of the trace it makes.
        auc, dp20: of its boxes on every frame, latency not counted, in the convention ``pysot``.
        expected_auc, expected_dp20: those that the recipe states.
    """

    recipe: str
    sequences: int
    frames: int
    auc: float
    dp20: float
    expected_auc: float
    expected_dp20: float

    @property
    def holds(self) -> bool:
        """Whether the scores are those of the recipe."""
        pairs = ((self.auc, self.expected_auc), (self.dp20, self.expected_dp20))
        return all(abs(found - stated) < TOLERANCE for found, stated in pairs)


def check_recipe(
    recipe: str | Recipe,
    *,
    mirror: str | os.PathLike[str] | None = None,
    progress: Progress = lambda done, total: None,
) -> Verdict:
    """Make a recipe's trace and score its boxes, latency not counted.

    Args:
        recipe: or its name.
        mirror: see :func:`get_trace`.
        progress: called as bytes arrive.

    Raises:
        LaeError: as :func:`get_trace`, or if the trace has another number of sequences than the
            recipe says.
    """
    if not isinstance(recipe, Recipe):
        recipe = find_recipe(recipe)
    trace, summary = made(recipe, mirror=mirror, progress=progress)
    if summary.sequences != recipe.sequences:
        raise LaeError(
            f"{recipe.name}: {summary.sequences} sequences, and the recipe says {recipe.sequences}"
        )
    scores = Scorer(list(trace), PYSOT).offline().scores
    return Verdict(
        recipe=recipe.name,
        sequences=summary.sequences,
        frames=summary.frames,
        auc=float(scores["auc"].mean()),
        dp20=float(scores["dp20"].mean()),
        expected_auc=recipe.auc,
        expected_dp20=recipe.dp20,
    )


def _lay_out(source: Source, cache: Path, folder: Path) -> None:
    """Put a source's files into a folder as importers expect them there."""
    if source.path.endswith(".zip"):
        (archive,) = source.files
        _unpack(cache / archive.path, source.inside, folder)
        return
    for file in source.files:
        path = folder / file.name
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(cache / file.path, path)


def _unpack(path: Path, inside: str, folder: Path) -> None:
    """Unpack the files that lie in a folder of an archive, those of its folders not."""
    folder.mkdir(parents=True)
    with ZipFile(path) as archive:
        for entry in archive.infolist():
            name = PurePosixPath(entry.filename)
            if not entry.is_dir() and f"{name.parent}/" == inside:
                (folder / name.name).write_bytes(archive.read(entry))
