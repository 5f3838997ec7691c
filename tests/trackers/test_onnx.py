from __future__ import annotations

import os
import sys
import types
from collections import Counter
from pathlib import Path

import numpy as np
import onnx_models
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.errors import LaeError
from lae_sim.trackers import onnx_session
from lae_sim.trackers.onnx_file import reshaped

CPU = "CPUExecutionProvider"


@pytest.fixture
def ort():
    return pytest.importorskip("onnxruntime")


@pytest.fixture
def average(tmp_path):
    path = tmp_path / "average.onnx"
    path.write_bytes(onnx_models.average())
    return path


def means(image):
    """What the model answers, by NumPy."""
    count = (image.shape[-1] - 8) // 16 + 1
    rows = [
        [image[..., 16 * i : 16 * i + 8, 16 * j : 16 * j + 8].mean((2, 3)) for j in range(count)]
        for i in range(count)
    ]
    return np.moveaxis(np.array(rows), (0, 1), (2, 3))


def image(side):
    return np.random.default_rng(side).random((1, 3, side, side)).astype(np.float32)


@pytest.mark.parametrize("side", [255, 127, 300])
def test_runs_at_the_files_shape_and_at_others(ort, average, side):
    shapes = None if side == 255 else {"input": (1, 3, side, side)}
    session = onnx_session(average, shapes=shapes)
    (answer,) = session.run(None, {"input": image(side)})
    np.testing.assert_allclose(answer, means(image(side)), rtol=1e-5)
    assert session.nodes == Counter({CPU: 2})
    assert session.get_providers() == [CPU]


def test_sides_that_are_open_are_closed_or_left_open(ort, tmp_path):
    path = tmp_path / "open.onnx"
    path.write_bytes(onnx_models.average(sides=("h", "w")))
    session = onnx_session(path)
    assert session.nodes == {}  # nothing is known to warm it up with
    np.testing.assert_allclose(
        session.run(None, {"input": image(90)})[0], means(image(90)), rtol=1e-5
    )
    closed = onnx_session(path, shapes={"input": (1, 3, 90, 90)})
    assert closed.get_inputs()[0].shape == [1, 3, 90, 90]
    assert closed.nodes[CPU] == 2


def test_threads_are_set(ort, average):
    session = onnx_session(average, threads=3)
    assert session.get_session_options().intra_op_num_threads == 3


@pytest.mark.parametrize("threads", [0, -1, 10**6, 2.5, "2", True])
def test_threads_are_a_number_that_a_machine_can_start(average, threads):
    with pytest.raises(LaeError, match=r"threads: .* is not a whole number from 1 to"):
        onnx_session(average, threads=threads)


@pytest.mark.parametrize("sides", [5, "ab", (1, 3, -1, 9), (1, 3, 2.5, 9), (1, 3, None, 9)])
def test_shapes_are_whole_numbers(average, sides):
    with pytest.raises(LaeError, match=r"shapes: 'input': .* are not whole numbers from 1"):
        onnx_session(average, shapes={"input": sides})


@pytest.mark.parametrize("path", [None, 5, b"average.onnx", "average\0.onnx"])
def test_what_is_no_path_is_said_to_be_none(ort, path):
    with pytest.raises(LaeError, match=r"no path .an ONNX model"):
        onnx_session(path)


def test_a_link_to_itself_is_no_file(ort, tmp_path):
    link = tmp_path / "loop.onnx"
    link.symlink_to(link)
    with pytest.raises(LaeError, match=r"loop\.onnx: no "):
        onnx_session(link)


def test_leaves_no_file_behind(ort, average, monkeypatch, tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr("tempfile.tempdir", str(here))
    session = onnx_session(average)
    session.run(None, {"input": image(255)})
    del session
    assert os.listdir(here) == []


def test_a_file_that_is_missing_or_no_model_is_named(ort, average, tmp_path):
    with pytest.raises(LaeError, match=r"nowhere\.onnx: no such file"):
        onnx_session(tmp_path / "nowhere.onnx")
    for content in (b"", b"nonsense", average.read_bytes()[:-30]):
        path = tmp_path / "wrong.onnx"
        path.write_bytes(content)
        for shapes in (None, {"input": (1, 3, 127, 127)}):
            with pytest.raises(LaeError, match=r"^/.*wrong\.onnx: ONNX Runtime .* cannot run it"):
                onnx_session(path, shapes=shapes)
    with pytest.raises(LaeError, match=r"average\.onnx.*it has no input 'image'"):
        onnx_session(average, shapes={"image": (1, 3, 9, 9)})
    with pytest.raises(LaeError, match=r"average\.onnx: ONNX Runtime"):
        onnx_session(average, shapes={"input": (1, 3)})  # no image


def test_without_onnx_runtime_the_extra_is_named(average, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(LaeError, match=r"no ONNX Runtime.*pip install 'lae-sim\[onnx\]'.*-gpu"):
        onnx_session(average)


def test_a_provider_that_is_not_there_is_refused(ort, average):
    with pytest.raises(LaeError, match=r"no provider 'Abacus', only .*CPU"):
        onnx_session(average, "Abacus")
    with pytest.raises(LaeError, match=r"no provider None, only .*CPU"):
        onnx_session(average, None)
    for provider in ("CUDA", "TensorRT"):
        if f"{provider.capitalize()}ExecutionProvider" in ort.get_available_providers():
            pytest.skip("this build has it")
        with pytest.raises(LaeError, match=f"no provider '{provider}'.*in onnxruntime-gpu"):
            onnx_session(average, provider)


def test_a_provider_that_runs_nothing_is_refused(ort, average):
    """Azure's is in the package of PyPI, and runs no node but its own."""
    if "AzureExecutionProvider" not in ort.get_available_providers():
        pytest.skip("this build has no provider that runs nothing")
    plain = ort.InferenceSession(str(average), providers=["AzureExecutionProvider"])
    assert plain.get_providers()[0] == "AzureExecutionProvider"  # so it says, and runs on the CPU
    with pytest.raises(LaeError, match=r"average\.onnx: .*run on the CPU, not on azure.*cpu_nodes"):
        onnx_session(average, "azure")
    with pytest.raises(LaeError, match=r"average\.onnx: ran on .*CPU.*, not on azure"):
        onnx_session(average, "azure", cpu_nodes=True)
    open_sides = average.with_name("open.onnx")
    open_sides.write_bytes(onnx_models.average(sides=("h", "w")))
    with pytest.raises(LaeError, match="give the shape of input 'input', which is open"):
        onnx_session(open_sides, "azure", cpu_nodes=True)


@pytest.fixture
def gpu(ort, monkeypatch):
    """A stand-in for a build with CUDA and TensorRT, whose nodes run where a test says."""
    nvidia = ["TensorrtExecutionProvider", "CUDAExecutionProvider"]
    fake = types.ModuleType("onnxruntime")
    fake.__version__ = "1.0"
    fake.SessionOptions = ort.SessionOptions
    fake.get_available_providers = lambda: [*nvidia, CPU]
    fake.ran_on = []
    fake.loaded = None  # None is what was asked for

    class Session(ort.InferenceSession):
        def __init__(self, model, settings, providers, enable_fallback):
            fake.asked = providers
            fake.settings, fake.fallback = settings, enable_fallback
            plain = ort.SessionOptions()
            plain.enable_profiling = True
            plain.profile_file_prefix = settings.profile_file_prefix
            super().__init__(model, plain, providers=[CPU])

        def get_providers(self):
            return fake.loaded or [name for name, _ in fake.asked] + [CPU]

        def end_profiling(self):
            path = Path(super().end_profiling())
            text = path.read_text()
            for provider in fake.ran_on:
                text = text.replace(CPU, provider, 1)
            path.write_text(text)
            return str(path)

    fake.InferenceSession = Session
    monkeypatch.setitem(sys.modules, "onnxruntime", fake)
    return fake


def test_cuda_is_asked_for_alone(gpu, average):
    gpu.ran_on = ["CUDAExecutionProvider"] * 2
    session = onnx_session(average, "cuda", device=1, options={"cudnn_conv_algo_search": "DEFAULT"})
    assert session.nodes == {"CUDAExecutionProvider": 2}
    options = {"device_id": 1, "cudnn_conv_algo_search": "DEFAULT"}
    assert gpu.asked == [("CUDAExecutionProvider", options)]
    assert gpu.fallback is False
    assert gpu.settings.get_session_config_entry("session.disable_cpu_ep_fallback") == "1"


def test_nodes_beside_the_gpu_are_refused_unless_allowed(gpu, average):
    gpu.ran_on = ["CUDAExecutionProvider"]
    with pytest.raises(LaeError, match=r"ran on .*CPUExecutionProvider': 1.*, not on CUDA"):
        onnx_session(average, "CUDA")
    session = onnx_session(average, "CUDA", cpu_nodes=True)
    assert session.nodes == {"CUDAExecutionProvider": 1, CPU: 1}
    gpu.loaded = [CPU]  # as where cuDNN is missing
    with pytest.raises(LaeError, match="not on CUDA"):
        onnx_session(average, "CUDA", cpu_nodes=True)


def test_tensorrt_keeps_what_it_builds_and_leaves_the_rest_to_cuda(gpu, average, tmp_path):
    gpu.ran_on = ["TensorrtExecutionProvider", "CUDAExecutionProvider"]
    cache = tmp_path / "engines"
    session = onnx_session(average, "TensorRT", cache=cache, options={"trt_fp16_enable": True})
    assert session.nodes["TensorrtExecutionProvider"] == 1
    (first, options), (second, _) = gpu.asked
    assert (first, second) == ("TensorrtExecutionProvider", "CUDAExecutionProvider")
    assert options["trt_engine_cache_enable"] is options["trt_fp16_enable"] is True
    assert options["trt_engine_cache_path"] == str(cache)
    assert cache.is_dir()
    with pytest.raises(LaeError, match=r"cache=.*average\.onnx/engines: Not a directory"):
        onnx_session(average, "TensorRT", cache=average / "engines")
    gpu.ran_on = ["CUDAExecutionProvider"] * 2  # TensorRT could do nothing
    with pytest.raises(LaeError, match="not on TensorRT"):
        onnx_session(average, "TensorRT", cache=cache)


@given(st.binary(max_size=200), st.integers(0, 300))
def test_other_bytes_have_no_shapes(noise: bytes, end: int) -> None:
    whole = onnx_models.average()
    for content in (noise, whole[:end], whole[:end] + noise):
        try:
            made = reshaped(content, {"input": (1, 3, 9, 9)})
        except ValueError:  # of UTF-8 too
            continue
        assert made
