from __future__ import annotations

import gc
import importlib
import importlib.util
import os
import sys
import types
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import onnx_models
import pytest

from lae_sim.profile.worker import Worker
from lae_sim.trackers.runtimes import Runtimes

FRAME = np.zeros((60, 80, 3), np.uint8)
BOX = (10.0, 10.0, 20.0, 20.0)
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")

OWN_SESSION = """
import os
import onnxruntime

class Own:
    def __init__(self, model, threads=0):
        settings = None
        if threads:
            settings = onnxruntime.SessionOptions()
            settings.intra_op_num_threads = threads
        before = len(os.listdir("/proc/self/task"))
        self.session = onnxruntime.InferenceSession(model, settings)
        self.started = len(os.listdir("/proc/self/task")) - before

    def init(self, frame, box):
        pass

    def track(self, frame):
        return None

    def describe(self):
        return {"started": self.started}
"""


@pytest.fixture
def watched() -> Iterator[Any]:
    """Makes `Runtimes`, and closes them."""
    made = []

    def runtimes(threads: int | None = None) -> Runtimes:
        made.append(Runtimes(threads))
        return made[-1]

    yield runtimes
    for each in reversed(made):
        each.close()


@LINUX
@pytest.mark.parametrize(
    ("asked", "own", "in_force"), [(1, 0, 1), (3, 0, 3), (1, 2, 2), (None, 2, 2), (None, 0, None)]
)
def test_threads_of_a_trackers_own_session_are_set_and_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    asked: int | None,
    own: int,
    in_force: int | None,
) -> None:
    pytest.importorskip("onnxruntime")
    (tmp_path / "own_session.py").write_text(OWN_SESSION)
    model = tmp_path / "model.onnx"
    model.write_bytes(onnx_models.average())
    monkeypatch.chdir(tmp_path)
    options = {"model": str(model), "threads": own}
    with Worker("own_session:Own", options, threads=asked) as worker:
        worker.init(FRAME, BOX)
        found = worker.describe()
    wanted = in_force or found["started"] + 1  # the thread that calls works too
    assert found["threads"]["onnxruntime"] == wanted == found["started"] + 1
    assert found["threads"].get("asked") == asked
    if asked:
        assert found["threads"].get("openblas", asked) == min(asked, os.cpu_count() or 1)
    (told,) = found["models"]
    assert told["threads"] == wanted
    assert told["provider"] == "CPUExecutionProvider"
    assert told["file"] == "model.onnx"
    assert told["digest"] == f"sha256:{sha256(model.read_bytes()).hexdigest()}"
    assert found["libraries"]["onnxruntime"] in told["runtime"]
    assert "synchronised" not in found


def test_a_session_of_ours_is_told_with_its_nodes_while_it_lives(
    tmp_path: Path, watched: Any
) -> None:
    pytest.importorskip("onnxruntime")
    from lae_sim.trackers import onnx_session

    path = tmp_path / "model.onnx"
    path.write_bytes(onnx_models.average())
    runtimes = watched(1)
    session = onnx_session(path, shapes={"input": (1, 3, 127, 127)})
    (told,) = runtimes.models()
    assert told["nodes"] == {"CPUExecutionProvider": 2}
    assert told["digest"] == f"sha256:{sha256(path.read_bytes()).hexdigest()}"
    assert runtimes.threads()["onnxruntime"] == 1
    del session
    gc.collect()
    assert runtimes.models() == []
    assert runtimes.threads()["onnxruntime"] == "unknown"


def test_classes_are_left_as_they_were(watched: Any) -> None:
    ort = pytest.importorskip("onnxruntime")
    before, finders = ort.InferenceSession.__init__, list(sys.meta_path)
    runtimes = Runtimes(1)
    assert ort.InferenceSession.__init__ is not before
    runtimes.close()
    runtimes.close()
    assert ort.InferenceSession.__init__ is before
    assert sys.meta_path == finders


def test_two_at_once_may_close_in_any_order(tmp_path: Path, watched: Any) -> None:
    ort = pytest.importorskip("onnxruntime")
    path = tmp_path / "model.onnx"
    path.write_bytes(onnx_models.average())
    first = Runtimes(1)
    second = watched(2)
    first.close()
    session = ort.InferenceSession(str(path))
    assert session.get_session_options().intra_op_num_threads == 2
    assert len(second.models()) == 1


INTERPRETER = """
class Interpreter:
    def __init__(self, model_path=None, model_content=None, delegates=None, num_threads=None):
        self.num_threads = num_threads
"""

OPENVINO = """
__version__ = "2026.1"

class Base:
    def __init__(self):
        self.properties = {"INFERENCE_NUM_THREADS": 0}
    def set_property(self, device, properties):
        assert device == "CPU"
        self.properties.update(properties)
    def get_property(self, name):
        return self.properties[name]

class Core(Base):
    def compile_model(self, config=None):
        return CompiledModel({**self.properties, **(config or {})})

class CompiledModel(Base):
    def __init__(self, properties):
        self.properties = properties
"""


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Writes a module that can be imported, in place of an installed one."""
    monkeypatch.syspath_prepend(str(tmp_path))
    written = []

    def write(name: str, text: str) -> None:
        path = tmp_path.joinpath(*name.split(".")).with_suffix(".py")
        if path.parent != tmp_path:
            path.parent.mkdir()
            (path.parent / "__init__.py").touch()
        path.write_text(text)
        importlib.invalidate_caches()
        for known in [k for k in sys.modules if k.partition(".")[0] == name.partition(".")[0]]:
            monkeypatch.delitem(sys.modules, known)
        written.append(name.partition(".")[0])

    yield write
    for name in [k for k in sys.modules if k.partition(".")[0] in written]:
        del sys.modules[name]


@pytest.mark.parametrize("package", ["ai_edge_litert", "tflite_runtime"])
def test_litert_gets_its_threads_as_the_default(library: Any, watched: Any, package: str) -> None:
    library(f"{package}.interpreter", INTERPRETER)
    runtimes = watched(3)
    made = importlib.import_module(f"{package}.interpreter").Interpreter
    plain = made("model")
    assert (plain.num_threads, runtimes.threads()["litert"]) == (3, 3)
    own = made("model", num_threads=2)
    also = made("model", None, None, 4)
    assert (own.num_threads, also.num_threads, runtimes.threads()["litert"]) == (2, 4, 4)
    assert [each["threads"] for each in runtimes.models()] == [3, 2, 4]


def test_litert_without_a_number_is_unknown(library: Any, watched: Any) -> None:
    library("tflite_runtime.interpreter", INTERPRETER)
    runtimes = watched()
    kept = importlib.import_module("tflite_runtime.interpreter").Interpreter("model")
    assert kept.num_threads is None
    assert runtimes.threads()["litert"] == "unknown"
    assert runtimes.models() == [{"runtime": "litert", "threads": "unknown"}]


def test_openvino_gets_its_threads_as_the_default(library: Any, watched: Any) -> None:
    library("openvino", OPENVINO)
    runtimes = watched(3)
    core = importlib.import_module("openvino").Core()
    kept = core.compile_model()
    assert runtimes.threads()["openvino"] == 3
    also = core.compile_model({"INFERENCE_NUM_THREADS": 2})
    assert [each["threads"] for each in runtimes.models()] == [3, 2]
    assert kept is not also
    assert runtimes.versions()["openvino"] == "2026.1"


def test_a_module_is_still_found_and_can_be_looked_for(library: Any, watched: Any) -> None:
    library("openvino", OPENVINO)
    watched(3)
    spec = importlib.util.find_spec("openvino")
    assert spec is not None
    assert "openvino" not in sys.modules
    library("openvino", "raise OSError('libopenvino.so is missing')")
    with pytest.raises(OSError, match="is missing"):
        importlib.import_module("openvino")


def test_two_at_once_see_what_is_imported_then(library: Any, watched: Any) -> None:
    library("tflite_runtime.interpreter", INTERPRETER)
    first, second = watched(), watched(3)
    made = importlib.import_module("tflite_runtime.interpreter").Interpreter("model")
    assert made.num_threads == 3
    assert len(first.models()) == len(second.models()) == 1


def test_a_folder_or_another_module_may_be_called_so(
    tmp_path: Path, library: Any, watched: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    library("openvino", "def nothing(): ...")
    library("tflite_runtime.other", "")
    (tmp_path / "tflite_runtime" / "interpreter").mkdir()
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    watched(3)
    for name in ("openvino", "tflite_runtime.interpreter"):
        importlib.import_module(name)
    assert watched(3).models() == []  # where they are imported already


@pytest.mark.parametrize(
    ("module", "name"),
    [("ncnn", "ncnn"), ("MNN", "mnn"), ("cupy", "cupy"), ("tensorrt", "tensorrt"), ("jax", "jax")],
)
def test_what_is_loaded_is_told(
    monkeypatch: pytest.MonkeyPatch, watched: Any, module: str, name: str
) -> None:
    runtimes = watched()
    assert name not in runtimes.versions()
    made = types.ModuleType(module)
    monkeypatch.setitem(sys.modules, module, made)
    assert runtimes.versions()[name] == "unknown"
    made.__version__ = "1.2"  # type: ignore[attr-defined]
    assert runtimes.versions()[name] == "1.2"
    assert runtimes.asynchronous() is (module in ("cupy", "tensorrt", "jax"))
    told = runtimes.threads().get(name.lower())
    assert told == ("unknown" if module in ("ncnn", "MNN", "jax") else None)


def test_a_version_that_only_the_package_tells(
    monkeypatch: pytest.MonkeyPatch, watched: Any
) -> None:
    monkeypatch.setitem(sys.modules, "ai_edge_litert", types.ModuleType("ai_edge_litert"))
    monkeypatch.setattr("importlib.metadata.version", lambda name: f"of {name}")
    assert watched().versions()["ai-edge-litert"] == "of ai-edge-litert"
