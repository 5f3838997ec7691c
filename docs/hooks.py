"""What mkdocs makes while it builds the site: pages from the repository's files and the parsers."""

from __future__ import annotations

import argparse
import importlib
import json
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, InclusionLevel

from lae_sim.cli import main

REPOSITORY = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(?!\w+:|#|/)([^)#\s]+)(?=[)#\s])")
MARK = re.compile(r"<!-- (commands|rooms|schemas) -->")
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
    """Put in what a page includes: other files, and what is made here in place of its marks."""
    return MARK.sub(lambda mark: MADE[mark[1]](), included(markdown, page.file.src_uri))


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


def schemas() -> str:
    """The keys of what each command prints as JSON, in a table of each kind of object."""
    folder = REPOSITORY / "docs" / "reference" / "schemas"
    parts = []
    for path in sorted(folder.glob("*.schema.json")):
        name = path.name.partition(".")[0]
        document = json.loads(path.read_text(encoding="utf-8"))
        link = f"[{path.name}](schemas/{path.name})"
        parts += [f"## {name}", f"{plain(document['title'])}: {link}", keys_of(document, name)]
        for kind, each in document.get("$defs", {}).items():
            title = f"#### {kind} {{ #{name}-{kind} }}"
            parts += [title, plain(each.get("description", "")), keys_of(each, name)]
    return "\n\n".join(parts)


def keys_of(schema: dict[str, Any], name: str) -> str:
    """The table of an object's keys, those of objects within them after a dot."""

    def rows(properties: dict[str, Any], before: str) -> Iterator[str]:
        for key, value in properties.items():
            yield f"| `{before}{key}` | {type_of(value, name)} | {plain(value['description'])} |"
            for each in inside(value):
                if "properties" in each:
                    yield from rows(each["properties"], f"{before}{key}{step(value)}")

    def step(value: dict[str, Any]) -> str:
        named = "additionalProperties" in value
        return "[]." if value.get("type") == "array" else ".NAME." if named else "."

    patterns = {f"/{key}/": value for key, value in schema.get("patternProperties", {}).items()}
    properties = {**schema["properties"], **patterns}
    return "\n".join(["| key | type | meaning |", "|---|---|---|", *rows(properties, "")])


def inside(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A schema, its alternatives, and those of a list's items or an object's values."""
    yield schema
    more = schema.get("additionalProperties")
    for each in [*schema.get("anyOf", []), schema.get("items"), more if more is not True else None]:
        if each:
            yield from inside(each)


def type_of(schema: dict[str, Any], name: str) -> str:
    """The type of a value in words; kinds of objects are linked."""
    if "$ref" in schema:
        file, _, kind = schema["$ref"].partition("#/$defs/")
        about = file.partition(".")[0] or name
        return f"[{kind}](#{about}-{kind})" if kind else f"[{about}](#{about})"
    if "const" in schema or "enum" in schema:
        return " or ".join(
            f"`{json.dumps(each)}`" for each in schema.get("enum", [schema.get("const")])
        )
    if "anyOf" in schema:
        return " or ".join(type_of(each, name) for each in schema["anyOf"])
    if schema.get("type") == "array":
        return f"list of {type_of(schema['items'], name)}" if "items" in schema else "list"
    if isinstance(schema.get("additionalProperties"), dict):
        return f"object of {type_of(schema['additionalProperties'], name)} by name"
    types = schema.get("type", "any")
    return " or ".join([types] if isinstance(types, str) else types)


MADE = {"commands": commands, "rooms": rooms, "schemas": schemas}
"""What stands in place of a mark, by its name."""
