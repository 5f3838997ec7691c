"""Models on ONNX Runtime, on the provider that was asked for and on no other.

ONNX Runtime itself goes on with its CPU provider, and a warning, where a provider is not there,
where its libraries do not load, where it cannot run a node, and where it fails in the middle of a
run (https://github.com/microsoft/onnxruntime/issues/6124). Times would be those of another device.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, install, one_line, shown
from lae_sim.trackers.checkout import existing
from lae_sim.trackers.onnx_file import reshaped

_SUFFIX = "ExecutionProvider"
_CPU, _CUDA, _TENSORRT = "CPU" + _SUFFIX, "CUDA" + _SUFFIX, "Tensorrt" + _SUFFIX
_NO_FALLBACK = "session.disable_cpu_ep_fallback"
_FOLDER = "session.model_external_initializers_file_folder_path"
_MOST_THREADS = 1024  # ONNX Runtime starts as many as it is told to, whatever there is to run them
_TYPES = {"float": "float32", "double": "float64"}  # where NumPy has another word


def onnx_session(
    path: str | os.PathLike[str],
    provider: str = "CPU",
    threads: int | None = None,
    shapes: Mapping[str, Sequence[int]] | None = None,
    device: int = 0,
    cpu_nodes: bool = False,
    cache: str | os.PathLike[str] = "",
    options: Mapping[str, Any] | None = None,
) -> Any:
    """A model's session, warmed up, all of whose nodes run on the provider that is asked for.

    A profile's trace is told of it: version, provider, threads in force, the file's digest, and how
    many nodes run on which provider.

    Args:
        path: an ONNX file.
        provider: ``"CPU"``, ``"CUDA"``, ``"TensorRT"`` (which leaves nodes that it cannot run to
            CUDA), or another that this build of ONNX Runtime has.
        threads: of the nodes on the CPU; None is what ``--threads`` says, otherwise all cores.
        shapes: of inputs, by name: where the file leaves them open, or has others than are wanted
            and the model allows it, as convolutions do.
        device: number of the GPU, for CUDA and TensorRT.
        cpu_nodes: whether nodes that the provider cannot run may run on the CPU.
        cache: folder where TensorRT keeps what it builds, which takes minutes; by default
            ``lae_sim/tensorrt`` in the user's cache.
        options: more options of the provider, such as ``{"trt_fp16_enable": True}``.

    Returns:
        An ``onnxruntime.InferenceSession``, whose attribute ``nodes`` says how many nodes of the
        warm-up ran on which provider. (There is none on a CPU for a model with inputs of an open
        shape.)

    Raises:
        LaeError: if ONNX Runtime or the provider is not there, the file is none that it can run,
            nodes would run elsewhere, or an argument is none.
    """
    if threads is not None and not (_is_whole(threads) and 1 <= threads <= _MOST_THREADS):
        raise LaeError(f"threads: {shown(threads)} is not a whole number from 1 to {_MOST_THREADS}")
    for name, sides in dict(shapes or {}).items():
        if not (
            isinstance(sides, Sequence) and all(_is_whole(side) and side > 0 for side in sides)
        ):
            raise LaeError(f"shapes: {shown(name)}: {shown(sides)} are not whole numbers from 1")
    ort = _onnxruntime()
    file = existing(path, "an ONNX model")
    wanted = _provider(ort, provider)
    providers = _providers(wanted, device, cache, dict(options or {}))
    settings = ort.SessionOptions()
    if threads:
        settings.intra_op_num_threads = threads
    if wanted != _CPU and not cpu_nodes:
        settings.add_session_config_entry(_NO_FALLBACK, "1")
    with tempfile.TemporaryDirectory(prefix="lae-sim-") as folder:
        settings.enable_profiling = True  # until the warm-up is over
        settings.profile_file_prefix = os.path.join(folder, "warm-up")
        with _explained(file, ort, provider):
            model: Any = str(file)
            if shapes:
                model = reshaped(file.read_bytes(), shapes)
                settings.add_session_config_entry(_FOLDER, str(file.parent))
            session = ort.InferenceSession(
                model, settings, providers=providers, enable_fallback=False
            )
            inputs = _inputs(session, needed=wanted != _CPU)
            if inputs is not None:
                session.run(None, inputs)
            events = json.loads(Path(session.end_profiling()).read_text("utf-8"))
    ran = (e.get("args", {}).get("provider") for e in events if e.get("cat") == "Node")
    session.file, session.nodes = file, Counter(filter(None, ran))
    allowed = {name for name, _ in providers} | ({_CPU} if cpu_nodes else set())
    strays = {name: n for name, n in session.nodes.items() if name not in allowed}
    if session.get_providers()[0] != wanted or strays or (inputs and not session.nodes[wanted]):
        raise LaeError(f"{file}: ran on {dict(session.nodes)}, not on {provider}")
    return session


def _is_whole(number: Any) -> bool:
    return isinstance(number, Integral) and not isinstance(number, bool)


def _onnxruntime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise LaeError(
            f"{sys.executable} has no ONNX Runtime ({one_line(str(error))}): {install('onnx')}, or "
            "onnxruntime-gpu for CUDA and TensorRT"
        ) from error
    return onnxruntime


def _provider(ort: Any, asked: str) -> str:
    """The full name of a provider that this build has."""
    there: list[str] = ort.get_available_providers()
    wanted = str(asked).lower()
    for name in there:
        if wanted in (name.lower(), _short(name).lower()):
            return name
    hint = ""
    if wanted in ("cuda", "tensorrt"):
        hint = "; it is in onnxruntime-gpu, to be installed instead of onnxruntime"
    raise LaeError(
        f"ONNX Runtime {ort.__version__} here has no provider {shown(asked)}, only "
        f"{', '.join(map(_short, there))}{hint}"
    )


def _short(provider: str) -> str:
    return provider[: -len(_SUFFIX)] if provider.endswith(_SUFFIX) else provider


def _providers(
    wanted: str, device: int, cache: str | os.PathLike[str], options: dict[str, Any]
) -> list[tuple[str, dict[str, Any]]]:
    """The provider, and those that it may leave nodes to, with their options."""
    number = {"device_id": device}
    if wanted == _CUDA:
        return [(_CUDA, {**number, **options})]
    if wanted == _TENSORRT:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        folder = os.fspath(cache) or os.path.join(home, "lae_sim", "tensorrt")
        try:
            os.makedirs(folder, exist_ok=True)
        except OSError as error:
            raise LaeError(f"cache={folder}: {error.strerror}") from error
        kept = {
            "trt_engine_cache_enable": True,
            "trt_engine_cache_path": folder,
            "trt_timing_cache_enable": True,
            "trt_timing_cache_path": folder,
        }
        return [(_TENSORRT, {**number, **kept, **options}), (_CUDA, number)]
    return [(wanted, options)]


def _inputs(session: Any, needed: bool) -> dict[str, Any] | None:
    """Zeros of the shapes that the inputs have; None if one is open.

    Raises:
        LaeError: if they are needed.
    """
    import numpy as np

    inputs = {}
    for each in session.get_inputs():
        # what is left open in front is the number of images
        shape = [1 if i == 0 and not isinstance(n, int) else n for i, n in enumerate(each.shape)]
        kind = each.type.partition("(")[2].rstrip(")")
        if not all(isinstance(side, int) for side in shape):
            if needed:
                raise LaeError(f"give the shape of input {each.name!r}, which is open: {shape}")
            return None
        inputs[each.name] = np.zeros(shape, _TYPES.get(kind, kind))
    return inputs


@contextmanager
def _explained(file: Path, ort: Any, provider: str) -> Iterator[None]:
    """Errors of ONNX Runtime, and ours, with the file that they are about."""
    try:
        yield
    except Exception as error:
        said = one_line(str(error))
        if isinstance(error, LaeError):
            pass
        elif "fallback to CPU EP has been explicitly disabled" in said:
            said = (
                f"nodes of it would run on the CPU, not on {provider}. If all would, what ONNX "
                "Runtime printed says why; if only some, cpu_nodes=true allows it"
            )
        else:
            said = f"ONNX Runtime {ort.__version__} cannot run it: {said}"
        raise LaeError(f"{file}: {said}") from error
