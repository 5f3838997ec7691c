"""The page of invariants names, for each of them, tests that are there."""

from __future__ import annotations

import ast
import re

from places import REPOSITORY

PAGE = REPOSITORY / "docs/concepts/invariants.md"
INVARIANT = re.compile(r"^(\d+)\. \*\*", re.MULTILINE)
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def test_invariants_are_numbered_and_each_has_a_test() -> None:
    before, *parts = INVARIANT.split(PAGE.read_text(encoding="utf-8"))
    numbers, texts = parts[::2], parts[1::2]
    assert numbers == [str(n) for n in range(1, len(texts) + 1)]
    assert len(numbers) >= 12
    assert [n for n, text in zip(numbers, texts) if not TEST.search(text)] == []
    assert not TEST.search(before)


def test_the_tests_of_invariants_are_there() -> None:
    named = TEST.findall(PAGE.read_text(encoding="utf-8"))
    missing = [
        f"{file}::{name}"
        for file, name in named
        if not (REPOSITORY / file).is_file() or name not in functions_of(file)
    ]
    assert named
    assert missing == []


def functions_of(file: str) -> set[str]:
    """The names of the functions of a module."""
    tree = ast.parse((REPOSITORY / file).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
