"""A command line as a user runs it: in a process of its own, or in this one, which is faster."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from places import REPOSITORY

from lae_sim.cli.main import main

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(REPOSITORY)}


def command(*arguments: object) -> list[str]:
    """The words of ``lae-sim ARGUMENTS`` as a process, whose warnings are errors."""
    return [sys.executable, "-W", "error", "-m", "lae_sim", *map(str, arguments)]


def run_process(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``lae-sim ARGUMENTS`` as a process."""
    words = command(*arguments)
    return subprocess.run(
        words, capture_output=True, text=True, cwd=cwd, env=ENVIRONMENT, timeout=300
    )


def run_here(
    *arguments: object, cwd: Path | None = None, both: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run the same in this process, which has imported everything already.

    Modules of ``cwd`` are imported anew, and forgotten, so that another folder may have their like.

    Args:
        arguments: what follows ``lae-sim``.
        cwd: where it runs.
        both: whether both streams are printed to the one, as to a terminal.
    """
    words = [str(argument) for argument in arguments]
    printed = io.StringIO()
    complaint = printed if both else io.StringIO()
    streams = contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complaint)
    with in_folder(cwd or Path.cwd()), streams[0], streams[1]:
        try:
            status = main(words)
        except SystemExit as end:  # by argparse
            status = int(end.code or 0)
    return subprocess.CompletedProcess(words, status, printed.getvalue(), complaint.getvalue())


@contextlib.contextmanager
def in_folder(folder: Path) -> Iterator[None]:
    """Work in a folder, whose modules may be imported meanwhile."""
    before, path = Path.cwd(), list(sys.path)
    _forget(folder)  # what another test's folder had under the same name
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
        sys.path[:] = path
        _forget(folder)


def _forget(folder: Path) -> None:
    """Forget modules of the names that a folder's have."""
    for file in folder.glob("*.py"):
        sys.modules.pop(file.stem, None)
