"""What mkdocs makes while it builds the site: pages from the repository's files and the parsers."""

from __future__ import annotations

import argparse
import importlib
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, InclusionLevel

from lae_sim.cli import main

REPOSITORY = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(?!\w+:|#|/)([^)#\s]+)(?=[)#\s])")
INCLUDE = re.compile(r'^--8<-- "(.+)"$', re.MULTILINE)


def on_files(files: Any, config: Any) -> Any:
    """Add the repository's files that pages link to, such as notebooks, to the site."""
    for page in list(files.documentation_pages()):
        folder = posixpath.dirname(page.src_uri)
        for target in LINK.findall(included(page.content_string, page.src_uri)):
            uri = posixpath.normpath(posixpath.join(folder, target))
            path = REPOSITORY / "docs" / uri
            if uri.startswith("../") and path.is_file() and files.get_file_from_path(uri) is None:
                files.append(copied(config, uri, path))
    return files


def copied(config: Any, uri: str, path: Path) -> File:
    """A file outside ``docs``, which links find by ``../PATH``, at ``PATH`` of the site."""
    file = File.generated(config, uri, abs_src_path=str(path), inclusion=InclusionLevel.NOT_IN_NAV)
    file.dest_uri = file.dest_uri.removeprefix("../")
    return file


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put in what a page includes: other files, and the help of the commands."""
    markdown = included(markdown, page.file.src_uri)
    for mark, made in MADE.items():
        if mark in markdown:
            markdown = markdown.replace(mark, made())
    return markdown


def included(markdown: str, uri: str) -> str:
    """The page with the files that it includes by ``--8<-- "FILE"``, whose links still lead there.

    Args:
        markdown: the page.
        uri: where it is below ``docs``.
    """
    folder = posixpath.dirname(posixpath.join("docs", uri))

    def text_of(include: re.Match[str]) -> str:
        here = posixpath.dirname(include[1])

        def link(found: re.Match[str]) -> str:
            return posixpath.relpath(posixpath.normpath(posixpath.join(here, found[1])), folder)

        return LINK.sub(link, (REPOSITORY / include[1]).read_text(encoding="utf-8"))

    return INCLUDE.sub(text_of, markdown)


def commands() -> str:
    """The help of each command, as its parser has it: usage, options in tables, examples."""
    modules = [importlib.import_module(f"lae_sim.cli.{name}") for name in main.COMMANDS]
    return "\n\n".join(command(module.parser()) for module in modules)


def command(parser: argparse.ArgumentParser) -> str:
    """The help of one command."""
    formatter = argparse.HelpFormatter(parser.prog, width=80)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups)
    usage = formatter.format_help().strip()
    parts = [f"## {parser.prog}", plain(parser.description or ""), f"```text\n{usage}\n```"]
    for group in parser._action_groups:
        rows = [
            f"| `{formatter._format_action_invocation(each)}` "
            f"| {plain(formatter._expand_help(each))} |"
            for each in group._group_actions
            if each.help not in (None, argparse.SUPPRESS)
        ]
        if rows:
            parts.append("\n".join([f"| {group.title} | |", "|---|---|", *rows]))
    if parser.epilog:
        parts.append(f"```text\n{parser.epilog.strip()}\n```")
    return "\n\n".join(parts)


def plain(text: str) -> str:
    """Text in Markdown, none of whose signs mean anything."""
    return re.sub(r"([\\`*_\[\]<>|#])", r"\\\1", text)


def rooms() -> str:
    """The packages that hold the rest, each with what it is for and its names."""
    found = []
    for stub in sorted((REPOSITORY / "lae_sim").glob("*/__init__.pyi")):
        module = importlib.import_module(f"lae_sim.{stub.parent.name}")
        names = ", ".join(f"`{name}`" for name in module.__all__)
        about = (module.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
        found.append(f"`{module.__name__}`\n\n:   {about}\n\n    {names}")
    return "\n\n".join(found)


MADE = {"<!-- commands -->": commands, "<!-- rooms -->": rooms}
"""What stands in place of marks in pages."""
