"""What pages list is complete: keys, conventions, forecasters; invariants name tests that exist."""

from __future__ import annotations

import ast
import re

import pytest
from places import REPOSITORY

from lae_sim.evaluation.metrics import CONVENTIONS
from lae_sim.importers.results import FORMATS
from lae_sim.learning.registry import BUILT_IN
from lae_sim.study.spec import _KEYS

INVARIANT = re.compile(r"^(\d+)\. \*\*", re.MULTILINE)
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")


def page(name: str) -> str:
    return (REPOSITORY / "docs" / name).read_text(encoding="utf-8")


def test_invariants_are_numbered_and_each_has_a_test() -> None:
    before, *parts = INVARIANT.split(page("concepts/invariants.md"))
    numbers, texts = parts[::2], parts[1::2]
    assert numbers == [str(n) for n in range(1, len(texts) + 1)]
    assert len(numbers) >= 12
    assert [n for n, text in zip(numbers, texts) if not TEST.search(text)] == []
    assert not TEST.search(before)


def test_the_tests_of_invariants_are_there() -> None:
    named = TEST.findall(page("concepts/invariants.md"))
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


@pytest.mark.parametrize(
    ("name", "listed"),
    [
        ("reference/study.md", _KEYS),
        ("concepts/conventions.md", CONVENTIONS),
        ("concepts/forecasters.md", BUILT_IN),
    ],
)
def test_a_table_has_a_row_for_each(name: str, listed: list[str]) -> None:
    rows = re.findall(r"^\| (`.+?) \|", page(name), re.MULTILINE)
    first = {text for row in rows for text in re.findall(r"`([^`]+)`", row)}
    assert set(listed) - first == set()


def test_every_room_is_described() -> None:
    text = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rooms = {path.parent.name for path in REPOSITORY.glob("lae_sim/*/__init__.py")}
    assert rooms
    assert [room for room in sorted(rooms) if f"`{room}/`" not in text] == []


def test_every_format_of_results_is_described() -> None:
    described = page("howto/results.md").lower()
    signs = {"ope": "plain text", "mat": "`.mat`", "json": "`.json`", "npz": "`.npz`"}
    signs |= {"got10k": "got-10k toolkit", "pytracking": "pytracking", "lae-pvt": "lae-pvt"}
    assert set(signs) == set(FORMATS)
    assert [sign for sign in signs.values() if sign not in described] == []
