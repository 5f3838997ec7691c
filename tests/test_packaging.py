"""What the package says of itself: its extras, spelt in one way wherever they are named."""

import json
import re
import sys
from pathlib import Path

import pytest
from distributions import oldest
from places import REPOSITORY

from lae_sim.cli import main

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def test_extras_are_named_in_one_way_in_messages_and_notebooks():
    named = []
    for path in [*(REPOSITORY / "lae_sim").rglob("*.py"), *(REPOSITORY / "notebooks").iterdir()]:
        for command in re.findall(r"pip install [^`\n)]*", source_of(path)):
            if "[" in command and "{" not in command:  # errors.install makes those with a brace
                assert re.match(r"pip install 'lae-sim\[\w+\]'", command), (path, command)
            assert "'.[" not in command, path
        named += re.findall(r"""lae-sim\[(\w+)\]|\binstall\(["'](\w+)["']\)""", source_of(path))
    found = {one or other for one, other in named}
    assert {"torch", "trax", "mat73", "remote", "distributed", "notebook"} <= found <= {*EXTRAS}


def test_the_extras_that_the_version_names_are_those_that_users_may_want():
    assert {*main.EXTRAS} == {*EXTRAS} - {"dev", "docs", "test"}
    for extra, package in main.EXTRAS.items():
        assert any(re.match(rf"{package}\b", each) for each in EXTRAS[extra]), extra


def test_every_dependency_has_a_lower_bound_that_the_oldest_installation_takes():
    bounds = oldest()
    for each in (*PROJECT["dependencies"], *EXTRAS["remote"], *EXTRAS["mat73"], *EXTRAS["trax"]):
        name = re.split(r"[ ;]", each)[0]
        assert re.match(rf"{name} >= {re.escape(bounds[name])}(;|$)", each), each


def test_the_citation_names_the_package_and_the_paper():
    yaml = pytest.importorskip("yaml", reason="it comes with the extra distributed")
    cited = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text("utf-8"))
    assert (cited["cff-version"], cited["license"]) == ("1.2.0", PROJECT["license"])
    [author] = cited["authors"]
    assert author["name"] in (REPOSITORY / "LICENSE").read_text("utf-8")
    assert "arXiv:2103.04508" in str(cited["references"])


def source_of(path: Path) -> str:
    if path.suffix != ".ipynb":
        return path.read_text("utf-8")
    cells = json.loads(path.read_text("utf-8"))["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells)
