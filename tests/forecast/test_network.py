"""The network in whole numbers: exact sums, and a file of plain arrays that can be trusted."""

from __future__ import annotations

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from contextlib import suppress
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import random_network
from places import TRACES

from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError
from lae_sim.forecast.learned import SHIPPED, read_learned
from lae_sim.forecast.network import ONE, Network, read_network, write_network

WIDTHS = [9, 7, 5]


def integers(network: Network, inputs: list[int]) -> list[int]:
    """The network's answers in Python's whole numbers, which never round by themselves."""
    one, found = 4096, inputs
    for k, (weight, bias) in enumerate(zip(network.weights, network.biases)):
        if k:
            found = [min(max(value, 0), 1 << 20) for value in found]
        columns = [[int(each) for each in column] for column in weight.T.tolist()]
        found = [
            round(Fraction(int(start) + sum(a * b for a, b in zip(found, column)), one))
            for start, column in zip(bias.tolist(), columns)
        ]
    return [min(max(value, -(1 << 20)), 1 << 20) for value in found]


@given(seed=st.integers(0, 2**32), rows=st.integers(1, 9), most=st.sampled_from([3, 4096, 32768]))
@settings(max_examples=30)
def test_answers_are_those_of_whole_numbers(seed: int, rows: int, most: int) -> None:
    network = random_network([9, 20, 6, 4], seed)
    inputs = np.random.default_rng(seed).integers(-most, most + 1, (rows, 9))
    expected = [integers(network, row) for row in inputs.tolist()]
    given = inputs.T.astype(np.float64)
    assert network(given).T.tolist() == expected
    assert given.T.tolist() == inputs.tolist()  # which are not written over
    assert [network(column).tolist() for column in given.T] == expected  # one alone


def test_the_largest_numbers_are_exact_too() -> None:
    """The bounds on weights, activations and widths are such that no sum is rounded."""
    most = 32767
    weights = [np.full(shape, most / ONE) for shape in ((256, 256), (256, 256), (256, 1))]
    biases = [np.full(256, 8 - 1 / ONE), np.full(256, -8 + 1 / ONE), np.full(1, 1 / ONE)]
    weights[2][1::2] *= -1
    weights[2][0] += 1 / ONE
    network = Network.rounded(weights, biases, {})
    row = [4095, *[4096] * 255]
    assert network(np.array(row, float)).tolist() == integers(network, row) == [257]


@given(seed=st.integers(0, 2**32), count=st.integers(1, 500), cut=st.integers(0, 500))
@settings(max_examples=30)
def test_columns_are_answered_alike_in_any_company(seed: int, count: int, cut: int) -> None:
    network = random_network([69, 64, 64, 64], seed % 5)
    columns = np.random.default_rng(seed).integers(-4096, 4097, (69, count)).astype(np.float64)
    whole = network(columns)
    parts = [network(part) for part in (columns[:, :cut], columns[:, cut:])]
    assert np.concatenate(parts, axis=1).tobytes() == whole.tobytes()
    assert network(columns[:, ::-1])[:, ::-1].tobytes() == whole.tobytes()
    assert network(np.asfortranarray(columns)).tobytes() == whole.tobytes()
    assert network(columns[:, 0]).tobytes() == whole[:, 0].tobytes()


@given(seed=st.integers(0, 2**32))
@settings(max_examples=30)
def test_sums_are_the_same_bits_in_any_order(seed: int) -> None:
    """Inputs and hidden units are added up in another order: floats in general differ then."""
    rng = np.random.default_rng(seed)
    network = read_learned(SHIPPED).network
    inputs = rng.integers(-50_000, 50_001, (network.inputs, 40)).astype(np.float64)
    orders = [rng.permutation(len(weight)) for weight in network.weights]
    last = np.arange(network.outputs)
    shuffled = Network(
        tuple(
            w[order][:, to] for w, order, to in zip(network.weights, orders, [*orders[1:], last])
        ),
        tuple(bias[to] for bias, to in zip(network.biases, [*orders[1:], last])),
        {},
    )
    assert shuffled(inputs[orders[0]]).tobytes() == network(inputs).tobytes()
    real = inputs / 3
    sums = [np.add.accumulate(each, axis=0)[-1] for each in (real, real[orders[0]])]
    assert sums[0].tobytes() != sums[1].tobytes()


def test_real_weights_are_rounded_to_the_nearest_and_bounded() -> None:
    found = Network.rounded([np.array([[0.3, -99.0, 99.0]])], [np.array([0.1, 9, -9])], {"a": 1})
    assert found.weights[0].tolist() == [[1229, -32768, 32768]]
    assert (found.biases[0] / ONE).tolist() == [410, 32768, -32768]
    assert (found.inputs, found.outputs, found.document) == (1, 3, {"a": 1})


def test_the_digest_is_of_every_weight_and_of_the_shape() -> None:
    network = random_network(WIDTHS)
    changed = [random_network(WIDTHS) for _ in range(4)]
    for k, each in enumerate(changed):
        part = each.weights[k // 2] if k % 2 else each.biases[k // 2]
        part.flat[-1] += 1 if k % 2 else ONE
    assert len({each.digest for each in (network, *changed)}) == 5
    same = Network(network.weights, network.biases, {"other": "document"})
    assert same.digest == network.digest
    flat = [Network((np.ones(s),), (np.ones(s[1]) * ONE,), {}).digest for s in ((4, 2), (2, 2))]
    assert flat[0] != flat[1]


# --------------------------------------------------------------------------------------- its file


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "stored.npz"
    write_network(random_network(WIDTHS, 1, {"sequences": [], "seed": 1}), path)
    return path


def test_what_is_written_is_read(stored: Path, tmp_path: Path) -> None:
    network = random_network(WIDTHS, 1, {"sequences": [], "seed": 1})
    found = read_network(stored, 9, 5)
    assert found.digest == network.digest
    assert found.document == network.document
    for mine, its in zip((*network.weights, *network.biases), (*found.weights, *found.biases)):
        assert mine.tobytes() == its.tobytes()
    write_network(network, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == stored.read_bytes()
    with np.load(stored, allow_pickle=False) as parts:  # anyone can read it
        assert json.loads(parts["document"].tobytes())["format"] == "lae-network"
        assert (parts["weight0"] == network.weights[0]).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.npz", "stored.npz"]


def refused(path: Path, content: bytes, reason: str = "") -> None:
    path.write_bytes(content)
    match = f"not a forecaster that lae-sim train wrote: .*{reason}"
    with pytest.raises(LaeError, match=match) as caught:
        read_network(path, 9, 5)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    assert "pickle" not in message  # NumPy advises to execute what is in the file


def rewritten(stored: Path, **changes: Any) -> bytes:
    """The file with other arrays; None takes one away."""
    with np.load(stored) as parts:
        arrays = {**parts, **changes}
    memory = io.BytesIO()
    np.savez(memory, **{name: value for name, value in arrays.items() if value is not None})
    return memory.getvalue()


def document(**changes: Any) -> np.ndarray:
    told = {"format": "lae-network", "version": 1, "sequences": [], **changes}
    told = {key: value for key, value in told.items() if value is not None}
    return np.frombuffer(json.dumps(told).encode(), np.uint8)


def test_a_truncated_file_is_refused(stored: Path, tmp_path: Path) -> None:
    whole = stored.read_bytes()
    for length in [*range(0, len(whole), 37), len(whole) - 1, len(whole) - 22]:
        refused(tmp_path / "f.npz", whole[:length])


def test_a_damaged_file_is_refused_or_means_the_same(stored: Path, tmp_path: Path) -> None:
    """A changed bit is noticed, or is none of the content's."""
    whole, random = stored.read_bytes(), np.random.default_rng(0)
    path, expected, errors = tmp_path / "f.npz", read_network(stored, 9, 5), 0
    for place in random.integers(0, len(whole), 250):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << random.integers(8)
        path.write_bytes(damaged)
        try:
            found = read_network(path, 9, 5)
        except LaeError:
            errors += 1
            continue
        assert found.digest == expected.digest
        assert found.document == expected.document
    assert errors > 100


class Runs:
    """A pickle of this touches a file where it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def test_nothing_in_a_file_is_executed(stored: Path, tmp_path: Path) -> None:
    trap = tmp_path / "executed"
    thing = np.array([Runs(trap)], dtype=object)
    refused(tmp_path / "f.npz", pickle.dumps(Runs(trap)))
    for name in ("weight0", "bias1", "document", "more"):
        refused(tmp_path / "f.npz", rewritten(stored, **{name: thing}))
    alone = io.BytesIO()
    np.save(alone, thing)
    refused(tmp_path / "f.npz", alone.getvalue())
    assert not trap.exists()
    pickle.loads(pickle.dumps(Runs(trap)))
    assert trap.exists()  # the trap works


def test_a_file_of_something_else_is_refused(stored: Path, tmp_path: Path) -> None:
    path = tmp_path / "f.npz"
    with np.load(stored) as parts:
        first, bias, last = parts["weight0"], parts["bias0"], parts["weight1"]
    large = first.copy()
    large[0, 0] = np.iinfo(np.int32).min  # of which the absolute value is negative
    arrays: list[dict[str, Any]] = [
        {"weight0": first[:, :-1]}, {"weight0": first[:-1]}, {"weight0": first.T},
        {"weight0": first[0]}, {"weight0": first[..., None]}, {"weight0": np.int32(3)},
        {"weight0": first[:, :0], "bias0": bias[:0], "weight1": last[:0]},
        {"weight0": first * 1.0}, {"weight0": first + np.nan}, {"bias0": bias * 1.0},
        {"weight0": first * 0 + 2**15 + 1}, {"bias0": bias * 0 - 2**15 - 1}, {"weight0": large},
        {"weight0": None}, {"weight1": None}, {"bias0": None}, {"document": None},
        {"weight1": None, "bias1": None}, {"weight2": first}, {"weight2": last.T},
        {"bias0": bias[None], "weight0": first[:, None]}, {"weight0": np.array(["a"])},
    ]  # fmt: skip
    for changes in arrays:
        refused(path, rewritten(stored, **changes))
    for told in (
        {"format": "lae-trace"}, {"format": None}, {"version": 2}, {"version": "1"},
        {"version": None},
    ):  # fmt: skip
        refused(path, rewritten(stored, document=document(**told)))
    for text in (b"[]", b"3", b"null", b"{", b"\xff", b"[" * 100_000):
        refused(path, rewritten(stored, document=np.frombuffer(text, np.uint8)))
    for junk in (b"", b"PK", b"\x93NUMPY", b"\x80\x02.", b"junk\n" * 99, stored.read_bytes()[::-1]):
        refused(path, junk)
    refused(path, (TRACES / "synthetic-fast.parquet").read_bytes())
    with zipfile.ZipFile(path, "w") as archive:  # as torch writes
        archive.writestr("archive/data.pkl", b"\x80\x02}.")
    refused(path, path.read_bytes(), "train it anew")


def test_a_layer_too_wide_for_exact_sums_is_refused(tmp_path: Path) -> None:
    write_network(random_network([9, 257, 5]), tmp_path / "wide.npz")
    with pytest.raises(LaeError, match="not a forecaster"):
        read_network(tmp_path / "wide.npz", 9, 5)
    write_network(random_network([9, 256, 5]), tmp_path / "wide.npz")
    assert len(read_network(tmp_path / "wide.npz", 9, 5).weights[1]) == 256


@pytest.mark.parametrize(("inputs", "outputs"), [(8, 5), (9, 4)])
def test_a_network_of_another_shape_is_refused(stored: Path, inputs: int, outputs: int) -> None:
    with pytest.raises(LaeError, match=r"not a forecaster that lae-sim train wrote"):
        read_network(stored, inputs, outputs)


def header(shape: tuple[int, ...], kind: str = "<i4") -> bytes:
    memory = io.BytesIO()
    declared = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(memory, declared)
    return memory.getvalue()


@pytest.mark.parametrize(
    "shape", [(10**12,), (10**6, 10**6), (2**62, 4), (2**64,), (-1,), (9, 8), (9, 6), (0, 7)]
)
def test_an_array_that_declares_other_than_it_holds_is_refused(
    shape: tuple[int, ...], stored: Path, tmp_path: Path
) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(stored) as its, zipfile.ZipFile(memory, "w") as archive:
        for name in its.namelist():
            content = its.read(name)
            if name == "weight0.npy":
                content = header(shape) + content[-9 * 7 * 4 :]
            archive.writestr(name, content)
    refused(tmp_path / "f.npz", memory.getvalue())


def test_a_small_file_that_unpacks_to_a_large_one_is_refused(stored: Path, tmp_path: Path) -> None:
    with np.load(stored) as parts:
        arrays = dict(parts)
    path = tmp_path / "f.npz"
    np.savez_compressed(path, **arrays, more=np.zeros(1 << 20, np.uint8))
    assert os.path.getsize(path) < 10_000
    assert read_network(path, 9, 5).outputs == 5
    with max_decoded("1MiB"), pytest.raises(LaeError, match="more than 1 MiB of memory"):
        read_network(path, 9, 5)
    deep = np.frombuffer(b'{"a": [' + b"0," * 40_000 + b"0]}", np.uint8)
    path.write_bytes(rewritten(stored, document=deep))
    with max_decoded("1MiB"), pytest.raises(LaeError, match="more than 1 MiB of memory"):
        read_network(path, 9, 5)


def test_a_path_that_is_no_file(stored: Path, tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"none\.npz: no such file"):
        read_network(tmp_path / "none.npz", 9, 5)
    with pytest.raises(LaeError, match="a folder, not a file"):
        read_network(tmp_path, 9, 5)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(LaeError, match="a pipe, not a file"):
        read_network(tmp_path / "pipe", 9, 5)
    with pytest.raises(LaeError, match="cannot write"):
        write_network(read_network(stored, 9, 5), tmp_path / "none" / "f.npz")


@given(data=st.binary(max_size=300), place=st.integers(0, 3000))
@settings(max_examples=40)
def test_any_bytes_are_refused_or_read(
    data: bytes, place: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    memory = io.BytesIO()
    told = {name: np.zeros(shape, "<i4") for name, shape in shapes().items()}
    np.savez(memory, document=document(), **told)
    whole = bytearray(memory.getvalue())
    whole[place : place + len(data)] = data
    path = tmp_path_factory.getbasetemp() / "any-network.npz"
    path.write_bytes(whole)
    with suppress(LaeError):
        read_network(path, 9, 5)


def shapes() -> dict[str, tuple[int, ...]]:
    found: dict[str, tuple[int, ...]] = {}
    for k, (wide, high) in enumerate(pairwise(WIDTHS)):
        found |= {f"weight{k}": (wide, high), f"bias{k}": (high,)}
    return found
