"""Runs what README.md and the pages of docs/ show, and holds what they print against the page.

    python tests/pages.py [PAGE ...]        # write what is printed now into the pages

The snippets of a page run in their order, in one folder that has the sample traces in ``traces``:

- ``console``: lines that begin with ``$ `` are commands of a shell; below each stands what it
  prints, on both streams, or nothing, and then it must succeed. ``...`` on a line of its own is any
  lines, within a line any text. A command goes on after a backslash at the end of a line.
- ``python`` and ``pycon``: run in one namespace, the latter as a doctest with ELLIPSIS.
- any block with a title, as ``toml title="study.toml"``: is written to that file.
- ``sh``: is not run, and says why in the line before, as ``<!-- not run: needs a Jetson -->``.
- what nobody runs: the languages of ``SHOWN``.
"""

from __future__ import annotations

import contextlib
import difflib
import doctest
import importlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from command_line import ENVIRONMENT, in_folder, run_here
from places import REPOSITORY, TRACES

PAGES = [
    path
    for pattern in ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "traces/FORMAT.md")
    for path in sorted(REPOSITORY.glob(pattern))
]
SHOWN = {"bibtex", "csv", "html", "json", "jsonl", "latex", "text", "toml", "yaml"}
FENCE = re.compile(r"^(?P<indent> *)(?P<fence>```+) *(?P<language>[\w-]*)(?P<rest>.*)$")
TITLE = re.compile(r"""title=["'](.+?)["']""")
NOT_RUN = re.compile(r"<!-- not run: \S.* -->")
FOR_A_SHELL = re.compile(r"[|&;<>()$`~*?\[\]{}]")
DOCTEST = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


class PageError(AssertionError):
    """A snippet that cannot be run, or is not written as it must be."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; ``line`` is the number of its first line, ``before`` that above."""

    language: str
    title: str | None
    indent: str
    line: int
    lines: list[str]
    before: str

    @property
    def text(self) -> str:
        return "\n".join(self.lines) + "\n"


@dataclass(frozen=True)
class Difference:
    """What a command prints now, in place of the page's lines from ``line`` (of them ``shown``)."""

    command: str
    line: int
    indent: str
    shown: list[str]
    printed: list[str]

    def describe(self, page: str) -> str:
        names = "the page", "printed"
        diff = difflib.unified_diff(self.shown, self.printed, *names, lineterm="", n=2)
        return "\n".join([f"{page}:{self.line}: $ {self.command}", *diff])


@dataclass
class Shell:
    """Runs the commands of a page, those of lae-sim in this process, which is faster."""

    folder: Path
    programs: Path
    environment: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        """Let ``lae-sim`` and ``python`` be those under test, whatever the path has."""
        for name, words in (("lae-sim", "-m lae_sim "), ("python", "")):
            program = self.programs / name
            program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -W error {words}"$@"\n')
            program.chmod(0o755)
        path = os.pathsep.join([str(self.programs), ENVIRONMENT.get("PATH", "")])
        self.environment = {**ENVIRONMENT, "PATH": path}

    def run(self, command: str) -> tuple[int, str]:
        """The exit status of a command, and what it prints."""
        words = [] if FOR_A_SHELL.search(command) else shlex.split(command, comments=True)
        for own in (["lae-sim"], ["python", "-m", "lae_sim"]):
            if words[: len(own)] == own:
                done = run_here(*words[len(own) :], cwd=self.folder, both=True)
                return done.returncode, done.stdout
        ran = subprocess.run(
            ["bash", "-o", "pipefail", "-c", command],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=120,
        )
        return ran.returncode, ran.stdout


def name_of(page: Path) -> str:
    """A page's path below the repository."""
    return os.path.relpath(page, REPOSITORY).replace(os.sep, "/")


def blocks_of(text: str) -> Iterator[Block]:
    """The fenced blocks of a page, in their order."""
    lines = text.splitlines()
    at = 0
    while at < len(lines):
        fence = FENCE.match(lines[at])
        at += 1
        if fence is None:
            continue
        indent, first = fence["indent"], at
        while at < len(lines) and lines[at].strip() != fence["fence"]:
            at += 1
        if at == len(lines):
            raise PageError(f"line {first}: the block never ends")
        title = TITLE.search(fence["rest"])
        before = [line for line in lines[: first - 1] if line.strip()][-1:]
        yield Block(
            language=fence["language"],
            title=title and title[1],
            indent=indent,
            line=first + 1,
            lines=[line.removeprefix(indent) for line in lines[first:at]],
            before="".join(before),
        )
        at += 1


def run_page(page: Path, folder: Path) -> list[Difference]:
    """Run a page's snippets in an empty folder; what its commands print and the page does not show.

    Raises:
        PageError: if a snippet fails, or nothing says that it is not to be run.
    """
    name = name_of(page)
    work, programs = folder / "work", folder / "bin"
    programs.mkdir()
    shutil.copytree(TRACES, work / "traces")
    shell = Shell(work, programs)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    differences: list[Difference] = []
    with in_folder(work), _environment(COLUMNS="100", MPLBACKEND="agg", TQDM_DISABLE="1"):
        sys.path.insert(0, str(work))
        for block in blocks_of(page.read_text(encoding="utf-8")):
            where = f"{name}:{block.line}"
            if block.title is not None:
                _write(work / block.title, block.text)
            elif block.language == "console":
                differences += _run_console(block, shell, where)
            elif block.language == "python":
                _run_python(block, namespace, page, name)
            elif block.language == "pycon":
                _run_doctest(block, namespace, name, where)
            elif block.language == "sh" and not NOT_RUN.search(block.before):
                raise PageError(
                    f"{where}: no <!-- not run: REASON --> in the line before the block"
                )
            elif block.language not in SHOWN | {"sh"}:
                raise PageError(f"{where}: {block.language or 'no language'}: name one that is run")
    return differences


def _write(path: Path, text: str) -> None:
    """Write a file that a page shows; it is imported anew if it is a module."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    sys.modules.pop(path.stem, None)
    importlib.invalidate_caches()


def _run_console(block: Block, shell: Shell, where: str) -> Iterator[Difference]:
    for at, command, shown in commands_of(block):
        status, text = shell.run(command)
        printed = [line.rstrip() for line in text.rstrip().splitlines()]
        if not shown and status:
            raise PageError(f"{where}: exit status {status}: $ {command}\n{text}")
        if shown and not agrees(shown, printed):
            yield Difference(command, at, block.indent, shown, printed)


def commands_of(block: Block) -> Iterator[tuple[int, str, list[str]]]:
    """The commands of a block, each with what the page shows below it and that one's first line."""
    lines, at = block.lines, 0
    if lines and not lines[0].startswith("$ "):
        raise PageError(f"line {block.line}: no command: one begins with '$ '")
    while at < len(lines):
        command = lines[at].removeprefix("$ ")
        at += 1
        while command.endswith("\\") and at < len(lines):
            command = command[:-1] + lines[at].strip().removeprefix("> ")
            at += 1
        first = at
        while at < len(lines) and not lines[at].startswith("$ "):
            at += 1
        shown = "\n".join(line.rstrip() for line in lines[first:at]).rstrip()
        yield block.line + first, command, shown.splitlines()


def agrees(shown: list[str], printed: list[str]) -> bool:
    """Whether a page shows what is printed, where ``...`` is anything."""

    def pattern(line: str) -> str:
        if line.strip() == "...":
            return r"(?:.*\n)*?"
        return ".*?".join(map(re.escape, line.split("..."))) + r"\n"

    text = "".join(f"{line}\n" for line in printed)
    return re.fullmatch("".join(map(pattern, shown)), text) is not None


def _run_python(block: Block, namespace: dict[str, Any], page: Path, name: str) -> None:
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile("\n" * (block.line - 1) + block.text, page, "exec"), namespace)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [each.lineno for each in frames if each.filename == str(page)]
        where = f"{name}:{lines[-1] if lines else block.line}"
        raise PageError(f"{where}: {type(error).__name__}: {error}") from error


def _run_doctest(block: Block, namespace: dict[str, Any], name: str, where: str) -> None:
    test = doctest.DocTestParser().get_doctest(block.text, namespace, name, name, block.line - 1)
    test.globs = namespace  # not a copy
    said: list[str] = []
    doctest.DocTestRunner(optionflags=DOCTEST).run(test, out=said.append, clear_globs=False)
    if said:
        raise PageError(f"{where}:\n{''.join(said)}")


@contextlib.contextmanager
def _environment(**variables: str) -> Iterator[None]:
    variables["PYTHONPATH"] = ENVIRONMENT["PYTHONPATH"]
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def rewritten(text: str, differences: list[Difference]) -> str:
    """A page with what its commands print now."""
    lines = text.splitlines()
    for each in reversed(differences):
        first = each.line - 1
        printed = [(each.indent + line).rstrip() for line in each.printed]
        lines[first : first + len(each.shown)] = printed
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> None:
    """Write what the commands of pages print into the pages."""
    warnings.simplefilter("error")
    for page in [Path(each).resolve() for each in arguments] or PAGES:
        with tempfile.TemporaryDirectory() as folder:
            differences = run_page(page, Path(folder))
        for each in differences:
            print(each.describe(name_of(page)))
        if differences:
            page.write_text(rewritten(page.read_text("utf-8"), differences), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
