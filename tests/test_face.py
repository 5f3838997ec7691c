"""The face: what ``import lae_sim`` shows, each name with an example that runs."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import matplotlib
import pytest
from places import REPOSITORY

import lae_sim

PACKAGE = REPOSITORY / "lae_sim"
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.pyi"))
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def home_of(name: str) -> str:
    """The module that the stub of the package imports a name from."""
    for node in ast.parse((PACKAGE / "__init__.pyi").read_text()).body:
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            return f"lae_sim.{node.module}"
    raise AssertionError(f"{name} is imported from nowhere")


def documentation(name: str) -> str:
    """The docstring of a class or a function; of a constant the text that follows it."""
    found = getattr(lae_sim, name)
    if inspect.isclass(found) or inspect.isfunction(found):
        return found.__doc__ or ""
    module = importlib.import_module(home_of(name))
    body = ast.parse(inspect.getsource(module)).body
    for node, following in pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else []
        if any(isinstance(each, ast.Name) and each.id == name for each in targets):
            assert isinstance(following, ast.Expr)
            assert isinstance(following.value, ast.Constant)
            return str(following.value.value)
    raise AssertionError(f"{name} has no documentation in {module.__name__}")


def run_examples(text: str, name: str) -> int:
    """Run the examples of a docstring; how many there are."""
    test = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    said: list[str] = []
    doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append)
    assert not said, "".join(said)
    return len(test.examples)


@pytest.fixture
def at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples are run where the sample traces lie, and draw on no screen."""
    monkeypatch.chdir(REPOSITORY)
    matplotlib.use("agg")


@pytest.mark.parametrize("name", lae_sim.__all__)
@pytest.mark.usefixtures("at_the_root")
def test_every_name_has_an_example_that_runs(name: str) -> None:
    text = inspect.cleandoc(documentation(name))
    assert re.search(r"^Example:$", text, re.MULTILINE), f"{name} has no example"
    assert run_examples(text, name) > 1


@pytest.mark.usefixtures("at_the_root")
def test_the_tour_of_the_package_runs() -> None:
    assert run_examples(lae_sim.__doc__ or "", "lae_sim") > 3


@pytest.mark.parametrize("word", ["hold", "staleness", "departure", "stride", "pass"])
def test_the_words_that_are_ours_are_explained(word: str) -> None:
    assert re.search(rf"^{word}\n +\S", lae_sim.__doc__ or "", re.MULTILINE)


def test_names_are_few_and_sorted() -> None:
    names = list(lae_sim.__all__)
    assert 30 <= len(names) <= 45
    assert names == sorted(names)
    assert {*names} <= {*dir(lae_sim)}


@pytest.mark.parametrize("name", lae_sim.__all__)
def test_every_name_is_what_its_module_has(name: str) -> None:
    assert getattr(lae_sim, name) is getattr(importlib.import_module(home_of(name)), name)


def test_no_name_hides_a_room_or_is_hidden_by_one() -> None:
    modules = {path.stem for path in PACKAGE.iterdir()}
    assert not {*lae_sim.__all__} & modules


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_has_a_face(room: str) -> None:
    module = importlib.import_module(f"lae_sim.{room}")
    assert list(module.__all__) == sorted(module.__all__)
    submodules = {path.stem for path in Path(str(module.__file__)).parent.glob("*.py")}
    assert not {*module.__all__} & submodules
    for name in module.__all__:
        assert not isinstance(getattr(module, name), ModuleType)
        assert name in dir(module)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="evaluates"):
        lae_sim.evaluates  # noqa: B018


def test_functions_are_verbs_and_explain_their_arguments() -> None:
    for name in lae_sim.__all__:
        found = getattr(lae_sim, name)
        if not inspect.isfunction(found):
            continue
        text = inspect.getdoc(found) or ""
        for parameter in inspect.signature(found).parameters:
            assert re.search(rf"\b{parameter}\b", text), f"{name} does not explain {parameter}"
