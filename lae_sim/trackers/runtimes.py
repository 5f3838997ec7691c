"""The libraries that a tracker runs on: their versions, their threads, and the models they hold.

Threads are set where a library has a number to set, and read back from it: what a trace tells is
what was in force. Some libraries have one number for all that they do (OpenCV, torch), some take
one from the environment when they are loaded (BLAS, OpenMP, TensorFlow), some have one for each
model, with all cores as the default (ONNX Runtime, OpenVINO). The latter get the number as the
default of each model that is made, whoever makes it; a number that the tracker itself gives stands.
"""

from __future__ import annotations

import ctypes
import functools
import os
import re
import sys
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import metadata
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from lae_sim.trackers.protocol import weights_digest

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "TF_NUM_INTRAOP_THREADS",
)
"""The environment variables that libraries read when they are loaded."""

_LIBRARIES = {  # module: name in a trace; that of pip, where the module does not tell its version
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv",
    "torch": "torch",
    "torchvision": "torchvision",
    "onnxruntime": "onnxruntime",
    "tensorrt": "tensorrt",
    "cupy": "cupy",
    "openvino": "openvino",
    "ai_edge_litert": "ai-edge-litert",
    "tflite_runtime": "tflite-runtime",
    "tensorflow": "tensorflow",
    "jax": "jax",
    "ncnn": "ncnn",
    "MNN": "mnn",
}

_ASYNCHRONOUS = ("cupy", "jax", "tensorrt")  # by default; other runtimes return arrays of the host

_UNTOLD = {  # module: name, of those that have threads and may not tell how many
    "ai_edge_litert": "litert",
    "jax": "jax",
    "MNN": "mnn",
    "ncnn": "ncnn",
    "onnxruntime": "onnxruntime",
    "openvino": "openvino",
    "tensorflow": "tensorflow",
    "tflite_runtime": "litert",
}

_POOLS = {  # pattern of a shared library's file: name, and the functions that tell its threads
    r"openblas": (
        "openblas",
        (
            "scipy_openblas_get_num_threads64_",
            "scipy_openblas_get_num_threads",
            "openblas_get_num_threads64_",
            "openblas_get_num_threads",
        ),
    ),
    r"libmkl_rt": ("mkl", ("MKL_Get_Max_Threads",)),
    r"lib[gi]?omp": ("openmp", ("omp_get_max_threads",)),
}


class Runtimes:
    """The libraries of this process, until `close`.

    Args:
        threads: that each may use; None leaves them as they are.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._threads = threads
        self._models: list[tuple[str, Any, int | None]] = []  # runtime, reference, its threads
        self._wrapped: list[tuple[Any, Any, Any]] = []  # class, its __init__ before and since
        self._finder = _AfterImport(
            {
                "onnxruntime": self._watch_onnxruntime,
                "openvino": self._watch_openvino,
                "ai_edge_litert.interpreter": self._watch_litert,
                "tflite_runtime.interpreter": self._watch_litert,
                "tensorflow.lite.python.interpreter": self._watch_litert,
            }
        )

    def close(self) -> None:
        """Leave the libraries' classes as they were, as far as nobody has wrapped them since."""
        self._finder.close()
        self._threads = None
        for kind, before, since in self._wrapped:
            if kind.__init__ is since:
                kind.__init__ = before

    def limit(self) -> None:
        """Set the threads of the libraries that have one number, as far as they are imported."""
        cv2, torch = sys.modules.get("cv2"), sys.modules.get("torch")
        if self._threads and cv2 and cv2.getNumThreads() != self._threads:
            cv2.setNumThreads(self._threads)
        if self._threads and torch and torch.get_num_threads() != self._threads:
            torch.set_num_threads(self._threads)

    def versions(self) -> dict[str, str]:
        """Versions of the libraries that are imported."""
        loaded = {name: _version(module, name) for module, name in _LIBRARIES.items()}
        return {name: version for name, version in loaded.items() if version is not None}

    def threads(self) -> dict[str, Any]:
        """Threads in force by library, ``"unknown"`` of those that do not tell.

        ``"asked"`` is what was asked for. Of a library with several models, the most that one has.
        """
        found: dict[str, Any] = {"asked": self._threads} if self._threads else {}
        cv2, torch = sys.modules.get("cv2"), sys.modules.get("torch")
        if cv2:
            found["opencv"] = cv2.getNumThreads()
        if torch:
            found["torch"] = torch.get_num_threads()
        found.update(_pools())
        for runtime, _, threads in self._held():
            if found.get(runtime) != "unknown":
                found[runtime] = max(threads, found.get(runtime, 0)) if threads else "unknown"
        for module, name in _UNTOLD.items():
            if module in sys.modules:
                found.setdefault(name, "unknown")
        return found

    def models(self) -> list[dict[str, Any]]:
        """Each model that is held: its runtime, threads and, of ONNX Runtime, provider and file.

        ``nodes`` is how many of its nodes run on which provider, where
        `lae_sim.trackers.onnx_session` made it.
        """
        return [_facts(*held) for held in self._held()]

    def asynchronous(self) -> bool:
        """Whether a library is imported whose calls come back before its device has finished."""
        return any(name in sys.modules for name in _ASYNCHRONOUS)

    def _held(self) -> Iterator[tuple[str, Any, int | None]]:
        for runtime, reference, threads in self._models:
            model = reference()
            if model is not None:
                yield runtime, model, threads

    def _keep(self, runtime: str, model: Any, threads: int | None) -> None:
        held = [each for each in self._models if each[1]() is not None]
        self._models = [*held, (runtime, weakref.ref(model), threads)]

    def _wrap(self, module: Any, name: str, init: Callable[..., None]) -> None:
        """Have objects of a module's class made by ``init(original, self, ...)``."""
        kind = getattr(module, name, None)
        if kind is None:  # another module, or a folder, that happens to be called so
            return
        original = kind.__init__

        @functools.wraps(original)
        def __init__(self: Any, *arguments: Any, **options: Any) -> None:  # noqa: N807
            init(original, self, *arguments, **options)

        self._wrapped.append((kind, original, __init__))
        kind.__init__ = __init__

    def _watch_onnxruntime(self, module: Any) -> None:
        def session(
            original: Any,
            made: Any,
            model: Any,
            sess_options: Any = None,
            *more: Any,
            **options: Any,
        ) -> None:
            if self._threads:
                sess_options = sess_options or module.SessionOptions()
                if not sess_options.intra_op_num_threads:
                    sess_options.intra_op_num_threads = self._threads
            before = _system_threads()
            original(made, model, sess_options, *more, **options)
            threads = made.get_session_options().intra_op_num_threads
            if not threads and before and made.get_providers()[0] == "CPUExecutionProvider":
                threads = 1 + (_system_threads() or before) - before  # and the one that calls
            self._keep("onnxruntime", made, threads or None)

        self._wrap(module, "InferenceSession", session)

    def _watch_openvino(self, module: Any) -> None:
        def core(original: Any, made: Any, *arguments: Any, **options: Any) -> None:
            original(made, *arguments, **options)
            if self._threads:
                with suppress(Exception):  # where it has no CPU plug-in
                    made.set_property("CPU", {"INFERENCE_NUM_THREADS": self._threads})

        def compiled(original: Any, made: Any, *arguments: Any, **options: Any) -> None:
            original(made, *arguments, **options)
            threads = 0
            with suppress(Exception):  # of a device without threads
                threads = made.get_property("INFERENCE_NUM_THREADS")
            self._keep("openvino", made, threads or None)

        self._wrap(module, "Core", core)
        self._wrap(module, "CompiledModel", compiled)

    def _watch_litert(self, module: Any) -> None:
        def interpreter(original: Any, made: Any, *arguments: Any, **options: Any) -> None:
            threads = arguments[3] if len(arguments) > 3 else options.get("num_threads")
            if threads is None and len(arguments) < 4 and self._threads:
                threads = options["num_threads"] = self._threads
            original(made, *arguments, **options)
            self._keep("litert", made, threads)

        self._wrap(module, "Interpreter", interpreter)


class _AfterImport(MetaPathFinder):
    """Calls a function with each module of some names, once it has been imported."""

    def __init__(self, calls: dict[str, Callable[[Any], None]]) -> None:
        self._calls = calls
        for name, call in calls.items():
            if sys.modules.get(name) is not None:
                call(sys.modules[name])
        sys.meta_path.insert(0, self)

    def close(self) -> None:
        self._calls = {}
        sys.meta_path[:] = [finder for finder in sys.meta_path if finder is not self]

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        call = self._calls.get(fullname)
        if call is None or self not in sys.meta_path:
            return None
        # those behind it, one of which may do the same: each asks only those behind itself
        for finder in sys.meta_path[sys.meta_path.index(self) + 1 :]:
            spec = finder.find_spec(fullname, path, target)
            if spec is not None:
                loader: Any = spec.loader
                if loader is not None:  # as of a folder that happens to be called so
                    loader.exec_module = functools.partial(_executed, loader.exec_module, call)
                return spec
        return None


def _executed(execute: Callable[[Any], object], call: Callable[[Any], object], module: Any) -> None:
    execute(module)
    call(module)


def _facts(runtime: str, model: Any, threads: int | None) -> dict[str, Any]:
    facts: dict[str, Any] = {"runtime": runtime, "threads": threads or "unknown"}
    if runtime == "onnxruntime":
        facts["runtime"] += f" {sys.modules[runtime].__version__}"
        facts["provider"] = model.get_providers()[0]
        file = getattr(model, "file", None) or getattr(model, "_model_path", None)
        if file and os.path.isfile(file):
            facts["file"] = Path(file).name
            facts["digest"] = f"sha256:{weights_digest(file)}"
        if getattr(model, "nodes", None):
            facts["nodes"] = dict(model.nodes)
    return facts


def _version(module: str, name: str) -> str | None:
    imported = sys.modules.get(module)
    if imported is None:
        return None
    version = getattr(imported, "__version__", None)
    if version is None:
        with suppress(metadata.PackageNotFoundError):
            version = metadata.version(name)
    return str(version or "unknown")


def _system_threads() -> int | None:
    """Threads of this process; None where the system does not tell."""
    try:
        return len(os.listdir("/proc/self/task"))
    except OSError:
        return None


def _pools() -> dict[str, int]:
    """Threads of BLAS and OpenMP, as the shared libraries of this process tell."""
    try:
        with open("/proc/self/maps", encoding="utf-8", errors="replace") as file:
            paths = {line.split(None, 5)[5].rstrip("\n") for line in file if ".so" in line}
    except OSError:
        return {}
    found: dict[str, int] = {}
    for path in sorted(paths):
        for pattern, (name, functions) in _POOLS.items():
            if re.search(pattern, os.path.basename(path)):
                with suppress(OSError):
                    library = ctypes.CDLL(path)
                    known = [f for f in functions if hasattr(library, f)]
                    if known:
                        found[name] = max(getattr(library, known[0])(), found.get(name, 0))
    return found
