"""The shape of the package: imports go one way, and stay light."""

from __future__ import annotations

import ast
import graphlib
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from places import REPOSITORY
from witness import moving

import lae_sim
from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata

PACKAGE = REPOSITORY / "lae_sim"
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
    if path.stem != "__init__"
)
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


def tree(module: str) -> ast.Module:
    return ast.parse(path_of(module).read_text())


def path_of(module: str) -> Path:
    return PACKAGE / f"{module.replace('.', '/')}.py"


def imported(module: str) -> set[str]:
    """Modules of the package that a module imports anywhere, functions included."""
    found: set[str] = set()
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: write absolute imports"
            if node.module == "lae_sim":
                found |= {alias.name for alias in node.names}
            elif (node.module or "").startswith("lae_sim."):
                found.add(str(node.module).removeprefix("lae_sim."))
        elif isinstance(node, ast.Import):
            found |= {
                alias.name.removeprefix("lae_sim.")
                for alias in node.names
                if alias.name.startswith("lae_sim.")
            }
    return found & set(MODULES)


GRAPH = {module: imported(module) for module in MODULES}


def test_no_module_imports_itself_through_others() -> None:
    try:
        graphlib.TopologicalSorter(GRAPH).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"imports go round: {' <- '.join(error.args[1])}")


def test_rooms_import_those_below_them() -> None:
    """The contract that ``make lint`` checks too, in ``pyproject.toml``."""
    lint = shutil.which("lint-imports", path=Path(sys.executable).parent)
    if lint is None:
        pytest.skip("import-linter comes with the extra dev")
    done = subprocess.run([lint], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_every_module_lives_in_a_room_of_a_size_to_look_over() -> None:
    sizes = Counter(module.rpartition(".")[0] for module in MODULES)
    assert max(sizes.values()) <= 15, sizes


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_says_what_it_is_for(room: str) -> None:
    text = ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text()))
    assert text
    assert len(text) > 40


@pytest.mark.parametrize("module", ["__init__", *MODULES])
def test_what_is_public_has_a_docstring(module: str) -> None:
    code = tree(module)
    assert ast.get_docstring(code), f"{module} has none"
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for node in code.body:
        if not isinstance(node, kinds) or node.name.startswith("_"):
            continue
        assert ast.get_docstring(node), f"{module}.{node.name} has none"
        for inner in node.body if isinstance(node, ast.ClassDef) else []:
            if isinstance(inner, kinds) and not inner.name.startswith("_"):
                assert ast.get_docstring(inner), f"{module}.{node.name}.{inner.name} has none"


READ = """
import sys
import lae_sim
from lae_sim.trace.file import read_trace
assert len(list(read_trace(sys.argv[1]))[0]) == 9
"""

EVALUATE = """
from lae_sim.engine.clock import Clock
from lae_sim.evaluation.evaluate import evaluate_runs
from lae_sim.learning.registry import load_forecaster
from lae_sim.replay.run import replay_sequence
trace = read_trace(sys.argv[1])
runs = [replay_sequence(r, Clock.at(trace.metadata.fps)) for r in trace]
evaluate_runs(runs, trace.metadata, {"kalman": load_forecaster("kalman")})
"""

HEAVY = {"pandas", "torch", "cv2", "matplotlib", "jinja2", "scipy", "filterpy", "IPython"}


LEARNED = {"lae_sim.forecast.learned", "lae_sim.forecast.guard", "lae_sim.forecast.network"}


@pytest.mark.parametrize(
    "program",
    ["import lae_sim", READ, READ + EVALUATE, READ + EVALUATE.replace("kalman", "learned")],
    ids=range(4),
)
def test_nothing_heavy_is_imported(program: str, tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    write_trace(Trace(Metadata.new("30", "every-frame"), [moving(9)]), path)
    program += "\nimport sys; print(*sys.modules)"
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, str(path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    modules = set(found.stdout.split())
    loaded = {name.partition(".")[0] for name in modules}
    assert "lae_sim" in loaded
    assert not loaded & HEAVY
    assert modules & LEARNED == (LEARNED if "learned" in program else set())


def test_importing_the_package_alone_does_not_import_numpy_or_arrow() -> None:
    program = "import lae_sim, sys; print(*sys.modules)"
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert not {"numpy", "pyarrow", "simpy"} & set(found.stdout.split())


STANDS_ALONE = {"errors", "plugins"}


def test_trackers_import_nothing_of_the_package_but_errors_and_plugins() -> None:
    """They run on the tracker's own interpreter, which has little else."""
    for module, others in GRAPH.items():
        if module.startswith("trackers."):
            assert {o for o in others if o.partition(".")[0] != "trackers"} <= STANDS_ALONE, module
    for module in STANDS_ALONE:
        assert GRAPH[module] <= STANDS_ALONE


def test_nothing_is_executed_from_a_trace() -> None:
    readers = [module for module in MODULES if module.startswith("trace.")]
    for module in readers:
        names = {node.id for node in ast.walk(tree(module)) if isinstance(node, ast.Name)}
        assert not names & {"eval", "exec", "compile", "__import__", "pickle", "importlib"}


def test_every_public_name_can_be_imported() -> None:
    assert len(set(lae_sim.__all__)) == len(lae_sim.__all__) > 0
    for name in lae_sim.__all__:
        assert getattr(lae_sim, name) is not None
