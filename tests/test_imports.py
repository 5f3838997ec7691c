"""The shape of the package: imports go one way, and stay light."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
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

LAYERS = [
    # each imports from those before it, and from its own layer where that makes no cycle
    {"errors"},
    {"clock", "boxes"},
    {"engine"},
    {"policies", "recording", "strides"},
    {"latency", "pairing", "kalman", "forecast", "metrics", "arrow", "metadata", "files", "locate"},
    {"batch", "rows", "checks"},
    {"trace"},
    {"run"},
    {"scoring"},
    {"evaluation"},
    # command lines, importers, reports and plots come after
]


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


def test_the_core_imports_upwards_only() -> None:
    layer = {module: i for i, modules in enumerate(LAYERS) for module in modules}
    assert set(layer) <= set(MODULES)
    for module, i in layer.items():
        for other in GRAPH[module]:
            assert other in layer, f"{module} is of the core and imports {other}, which is not"
            assert layer[other] <= i, f"{module} imports {other}"


def test_the_engine_is_the_only_scheduler() -> None:
    importers = {
        m
        for m in MODULES
        for node in ast.walk(tree(m))
        if (isinstance(node, ast.Import) and any(a.name == "simpy" for a in node.names))
        or (isinstance(node, ast.ImportFrom) and node.module == "simpy")
    }
    assert importers == {"engine"}


@pytest.mark.parametrize("module", ["__init__", *MODULES])
def test_a_module_has_at_most_400_lines(module: str) -> None:
    assert len(path_of(module).read_text().splitlines()) <= 400


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
import lae_sim.trace
from lae_sim.trace import read_trace
assert len(list(read_trace(sys.argv[1]))[0]) == 9
"""

EVALUATE = """
from lae_sim.clock import Clock
from lae_sim.evaluation import evaluate
from lae_sim.zoo import load_forecaster
from lae_sim.run import replay_sequence
trace = read_trace(sys.argv[1])
runs = [replay_sequence(r, Clock.at(trace.metadata.fps)) for r in trace]
evaluate(runs, trace.metadata, {"kalman": load_forecaster("kalman")})
"""

HEAVY = {"pandas", "torch", "cv2", "matplotlib", "scipy", "filterpy", "IPython"}


@pytest.mark.parametrize("program", ["import lae_sim", READ, READ + EVALUATE], ids=range(3))
def test_nothing_heavy_is_imported(program: str, tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    write_trace(Trace(Metadata.new("30", "every-frame"), [moving(9)]), path)
    program += "\nimport sys; print(*{name.partition('.')[0] for name in sys.modules})"
    found = subprocess.run(
        [sys.executable, "-W", "error", "-c", program, str(path)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(found.stdout.split())
    assert "lae_sim" in loaded
    assert not loaded & HEAVY


def test_importing_the_package_alone_does_not_import_numpy_or_arrow() -> None:
    program = "import lae_sim, sys; print(*sys.modules)"
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert not {"numpy", "pyarrow", "simpy"} & set(found.stdout.split())


def test_trackers_import_nothing_of_the_package_but_errors() -> None:
    """They run on the tracker's own interpreter, which has little else."""
    for module, others in GRAPH.items():
        if module.startswith("trackers."):
            assert {o for o in others if not o.startswith("trackers.")} <= {"errors"}, module


def test_nothing_is_executed_from_a_trace() -> None:
    readers = ("trace", "rows", "checks", "metadata", "arrow", "recording")
    for module in readers:
        names = {node.id for node in ast.walk(tree(module)) if isinstance(node, ast.Name)}
        assert not names & {"eval", "exec", "compile", "__import__", "pickle", "importlib"}


def test_every_public_name_can_be_imported() -> None:
    assert len(set(lae_sim.__all__)) == len(lae_sim.__all__) > 0
    for name in lae_sim.__all__:
        assert getattr(lae_sim, name) is not None
