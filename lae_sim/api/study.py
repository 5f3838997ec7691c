"""Running a study in one call."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from lae_sim import __version__
from lae_sim.engine.clock import whole
from lae_sim.errors import LaeError, shown
from lae_sim.files import text_digest, written_whole
from lae_sim.plugins import looking_in
from lae_sim.progress import ProgressBar, ShowProgress
from lae_sim.replay.names import named
from lae_sim.report.paper import Paper, Records, remove_paper, write_paper, written_before
from lae_sim.study.executors import RunAll, run_here
from lae_sim.study.run import StudyResults, check_inputs, compute_study
from lae_sim.study.spec import Study, read_study
from lae_sim.study.store import Store
from lae_sim.trace.locate import digest

VIEWS = "views"
"""The document that says what the views of a study were made of."""


def run_study(
    study: Study | str | os.PathLike[str] | Mapping[str, Any] | None = None,
    folder: str | os.PathLike[str] | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    report: bool = True,
    root: str | os.PathLike[str] | None = None,
    progress: ShowProgress = None,
    **keys: Any,
) -> StudyResults:
    """Replay and score many traces in many worlds, or go on where an earlier run stopped.

    Args:
        study: a study, the path of a TOML file, or a mapping of its keys; or give the keys
            themselves, such as ``traces="*.parquet", latencies=["recorded", "bootstrap"]``.
        folder: where results are kept; of a file ``STUDY-results``, else ``study-results``.
            Finished parts found there are not computed again.
        workers: processes on this machine; by default one for each core, or this one
            alone where there is little to do. No result depends on it.
        scheduler: address of a Dask cluster to compute on instead.
        report: whether to write ``report.html``, ``figures/`` and ``tables/`` too.
        root: folder of the dataset, for the report to show a few sequences with their images;
            synthetic ones need none.
        progress: whether to show a progress bar, by default on a terminal and in a notebook; or a
            function, which is told: ``progress(done, total, what)``.
        keys: keys of the study file (see :class:`Study`).

    In a script, call it under ``if __name__ == "__main__":``, since workers import the script.

    Raises:
        LaeError: if a key is unknown or a value impossible, a trace is missing, or nothing could be
            computed; it says which.

    Example:
        >>> import tempfile
        >>> import lae_sim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     results = lae_sim.run_study(
        ...         traces="traces/synthetic-slow.parquet", folder=folder, workers=1, report=False
        ...     )
        >>> [(row.forecaster, round(row.scores["auc"], 4)) for row in results.summary]
        [('hold', 0.5722), ('kalman', 0.6291)]
    """
    if folder is not None and not isinstance(folder, (str, os.PathLike)):
        raise LaeError(f"folder: a path, not {shown(folder)}")
    if workers is not None:
        workers = named("workers", partial(whole, least=1), workers)
        if scheduler is not None:
            raise LaeError("workers: for this machine: a scheduler says where to compute instead")
    if root is not None and not isinstance(root, (str, os.PathLike)):
        raise LaeError(f"root: a path, not {shown(root)}")
    if root is not None and not Path(root).expanduser().exists():
        raise LaeError(f"root: there is no {root}")
    made, base, kept = _asked_for(study, keys, folder)
    with looking_in(base or "."), ProgressBar("study", "tasks", progress) as bar:

        def advance(what: str, done: int, total: int) -> None:
            bar(done, total, what)

        def views(results: StudyResults, run: RunAll) -> None:
            write_views(results, report, root, run)

        return compute_study(made, kept, base, workers, scheduler, advance, views)


def _asked_for(
    study: object, keys: Mapping[str, Any], folder: str | os.PathLike[str] | None
) -> tuple[Study, Path | None, str | os.PathLike[str]]:
    """The study, the folder that its paths are relative to, and where its results go."""
    kept = folder or "study-results"
    if study is not None and keys:
        raise LaeError(f"{next(iter(keys))}: give a study, or its keys, not both")
    if isinstance(study, Study):
        return study, None, kept
    if study is None or isinstance(study, Mapping):
        return Study.of(keys if study is None else study), None, kept
    if not isinstance(study, (str, os.PathLike)) or str(study).endswith(".parquet"):
        raise LaeError(
            f"study: {shown(study)} is no TOML file and no Study; name traces by traces=... (in a "
            'TOML file: traces = ["a.parquet", "b.parquet"])'
        )
    path = Path(study)
    kept = folder or f"{path.stem}-results"
    check_inputs(kept, [path])
    return read_study(path), path.parent, kept


def write_views(
    results: StudyResults,
    report: bool = True,
    root: str | os.PathLike[str] | None = None,
    run: RunAll = run_here,
) -> None:
    """Write the report and what a paper needs beside a study's results, or take old ones away.

    What was written of the same results, and is as it was written, is not written again; but with
    frames, which may have changed. Workers draw, while the tables are written here.
    """
    page = results.folder / "report.html"
    if not report:
        remove_paper(results.folder)  # it would be of other results
        page.unlink(missing_ok=True)
        return
    if root is None and _are_there(results):
        return
    # imported where something is drawn: a study that goes on often has all of it already
    from lae_sim.figures.column import drawn
    from lae_sim.figures.study import study_in_columns
    from lae_sim.report.page import page_drawings, page_of, page_sections
    from lae_sim.report.study_tables import paper_tables
    from lae_sim.study.view import View

    view = View(results)
    sections, figures = page_sections(view, root), [*study_in_columns(view)]
    pictures = page_drawings(sections)
    jobs: list[Callable[[], Any]] = [partial(drawn, figure) for figure in figures]
    jobs += pictures.values()
    with _being_done(jobs, run) as done:
        tables = paper_tables(view)
        made = done()
    count = len(figures)
    frames = {"scores": Records(results.score_names(), results.score_rows)}
    write_paper(Paper(made[:count], tables, frames), results.folder)
    with written_whole(page) as temporary:
        text = page_of(view, sections, dict(zip(pictures, made[count:])))
        temporary.write_text(text, "utf-8", "backslashreplace")
    if root is None:
        Store(results.folder).keep(VIEWS, _views(results))


@contextmanager
def _being_done(
    jobs: Sequence[Callable[[], Any]], run: RunAll
) -> Iterator[Callable[[], list[Any]]]:
    """What waits for the results of jobs, which workers, if there are any, do meanwhile."""

    def all_done() -> list[Any]:
        with closing(run(_done, [*enumerate(jobs)])) as results:
            found = {number: result for (number, _), result in results}
        return [found[number] for number in range(len(jobs))]

    if run is run_here:
        yield all_done
    else:
        with ThreadPoolExecutor(1) as beside:  # which waits for the workers
            yield beside.submit(all_done).result


def _done(numbered: tuple[int, Callable[[], Any]]) -> Any:
    """What a job gives, on a worker."""
    return numbered[1]()


def _are_there(results: StudyResults) -> bool:
    """Whether the views of these results are there, as they were written."""
    kept = Store(results.folder).document(VIEWS)
    try:
        return kept is not None and kept == _views(results)
    except LaeError:  # a file is not there
        return False


def _views(results: StudyResults) -> dict[str, Any]:
    """What the views are made of, and digests of their files."""
    made_of = [__version__, digest(str(results.folder / "study.json"))]
    made_of += [cell.key for cell in results.plan.cells]
    files = [results.folder / "report.html", *sorted(written_before(results.folder))]
    return {
        "of": text_digest(" ".join(made_of)),
        "files": {path.relative_to(results.folder).as_posix(): digest(str(path)) for path in files},
    }
