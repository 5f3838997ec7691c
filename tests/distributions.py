"""The package as an index has it: what its files hold, and that the wheel works by itself.

    python tests/distributions.py [DIST]        after `make dist`, on every Python from 3.10 at hand

On the oldest Python a part of the tests runs too, with the oldest dependencies that the wheel
allows.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from places import REPOSITORY

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
TESTED = ("test_conformance.py", "engine", "replay", "trace", "report/test_table.py",
          "report/test_page.py", "cli/test_main.py", "comparison/test_statistics.py")  # fmt: skip
EXTRAS = ("mat73", "remote")
TOOLS = ("hypothesis", "jsonschema", "pytest", "pytest-xdist")


def oldest() -> dict[str, str]:
    """The lower bound of each dependency, extras and the tests' own included."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *(each for some in extras.values() for each in some)]
    found = (re.match(r"([\w.-]+) >= ([\w.]+)", each) for each in needed)
    return {match[1]: match[2] for match in found if match}


def main(folder: str = "dist") -> None:
    """Check all of it; the first thing that is amiss is raised."""
    [wheel], [source] = (sorted(Path(folder).glob(each)) for each in ("*.whl", "*.tar.gz"))
    check_contents(wheel, source)
    for version, python in pythons():
        with TemporaryDirectory() as place:
            begun = time.monotonic()
            check_alone(wheel, python, Path(place))
            print(f"{wheel.name} by itself on Python {version}: {time.monotonic() - begun:.0f} s")
            if version == PYTHONS[0]:
                begun = time.monotonic()
                check_oldest(wheel, python, Path(place))
                print(f"with its oldest dependencies: {time.monotonic() - begun:.0f} s")


def pythons() -> Iterator[tuple[str, str]]:
    """Those at hand, with their versions."""
    for version in PYTHONS:
        managed = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions")
        places = [shutil.which(f"python{version}"), *managed.glob(f"{version}.*/bin/python")]
        for python in map(str, filter(None, places)):
            code = "import sys; print('%d.%d' % sys.version_info[:2])"
            done = subprocess.run([python, "-c", code], capture_output=True, text=True)
            if done.stdout.strip() == version:
                yield version, python
                break
        else:
            print(f"Python {version} is not on this machine")


def check_contents(wheel: Path, source: Path) -> None:
    """Check that both hold what the repository tracks of them, and nothing else."""
    words = ["git", "ls-files", "-z"]
    listed = subprocess.run(words, capture_output=True, text=True, check=True, cwd=REPOSITORY)
    tracked = {*listed.stdout.rstrip("\0").split("\0")}
    with zipfile.ZipFile(wheel) as file:
        held = {name for name in file.namelist() if ".dist-info/" not in name}
    assert held == {name for name in tracked if name.startswith("lae_sim/")}, held ^ tracked
    for name in ("py.typed", "forecast/learned.npz", "report/templates/page.html", "__init__.pyi"):
        assert f"lae_sim/{name}" in held, name
    with tarfile.open(source) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()} - {"PKG-INFO"}
    assert held == tracked, held ^ tracked


def check_alone(wheel: Path, python: str, place: Path) -> None:
    """Check that the wheel replays a sample where there is nothing else of ours."""
    run(python, "-m", "venv", place / "alone")
    install(place / "alone", wheel)
    shutil.copy(REPOSITORY / "traces" / "synthetic-slow.parquet", place / "slow.parquet")
    command = scripts(place / "alone") / "lae-sim"
    printed = run(command, "replay", "slow.parquet", "--json", cwd=place)
    hold, kalman = json.loads(printed)["traces"][0]["results"]
    assert (round(hold["auc"], 4), round(kalman["auc"], 4)) == (0.5722, 0.6291), printed
    assert "lae-sim " in run(command, "--version", cwd=place)


def check_oldest(wheel: Path, python: str, place: Path) -> None:
    """Run a part of the tests with the oldest dependencies, away from the sources."""
    constraints = place / "oldest.txt"
    pinned = [f"{name} == {bound}" for name, bound in oldest().items()]
    # newer ones warn of what such a Matplotlib calls, and in the tests warnings are errors
    constraints.write_text("\n".join([*pinned, "pyparsing < 3.1"]))
    run(python, "-m", "venv", place / "oldest")
    install(place / "oldest", f"{wheel}[{','.join(EXTRAS)}]", *TOOLS, "--constraint", constraints)
    for name in ("tests", "traces"):
        shutil.copytree(REPOSITORY / name, place / name)
    shutil.copy(REPOSITORY / "pyproject.toml", place)
    tests = [f"tests/{name}" for name in TESTED]
    run(scripts(place / "oldest") / "pytest", "-q", "-n", "auto", *tests, cwd=place)


def install(environment: Path, *packages: object) -> None:
    """Install packages there."""
    quiet = ("--quiet", "--disable-pip-version-check")
    run(scripts(environment) / "python", "-m", "pip", "install", *quiet, *packages)


def scripts(environment: Path) -> Path:
    """The folder of an environment's commands."""
    return environment / ("Scripts" if os.name == "nt" else "bin")


def run(*words: Any, cwd: Path | None = None) -> str:
    """What a command prints, without our sources on its path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [*map(str, words)], capture_output=True, text=True, cwd=cwd, env=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


if __name__ == "__main__":
    main(*sys.argv[1:])
