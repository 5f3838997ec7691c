"""A small network in whole numbers, so that its answers are the same bits everywhere.

Activations and weights are whole numbers held in float64, of which every product and every partial
sum is below 2**53, hence exact. In what order a matrix product adds them up does not matter then:
one column or a thousand, whatever BLAS and processor, the answers are equal. (In float32, twice as
fast, they would not be: sums of the shipped weights times inputs of 1 already reach 2**27, of which
it holds 2**24 exactly.) Quantised inference with
whole numbers is usual (Jacob et al., "Quantization and Training of Neural Networks for Efficient
Integer-Arithmetic-Only Inference", CVPR 2018); exact sums are what it is used for here.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.decoding import Budget, json_memory
from lae_sim.errors import LaeError, shown
from lae_sim.files import check_regular, written_whole

FORMAT = "lae-network"
VERSION = 1
ONE = 2.0**12
"""What stands for 1, in inputs, weights, activations and outputs."""

_MOST_WEIGHT = 2.0**15  # 8
_MOST_ACTIVATION = 2.0**20  # 256
_MOST_INPUTS = 256  # 2**(15 + 20 + 8) is exact, and so are sums of outputs times 23 bits

# Columns at once: they stay in the cache, and BLAS does not spread so few over threads, for which
# it would wait longer than it computes wherever other processes keep the cores busy.
_BLOCK = 192


@dataclass(frozen=True, eq=False)
class Network:
    """Linear layers with rectified linear units between them, in whole numbers.

    Attributes:
        weights: of each layer, whole numbers in float64, [inputs, outputs]; ``ONE`` is 1.
        biases: of each layer, whole numbers in float64, [outputs]; ``ONE**2`` is 1.
        document: how it came about, as JSON.
    """

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]
    document: Mapping[str, Any]

    @classmethod
    def rounded(
        cls, weights: list[Floats], biases: list[Floats], document: Mapping[str, Any]
    ) -> Network:
        """The nearest network to real weights [inputs, outputs] and biases [outputs]."""
        return cls(
            tuple(np.clip(np.rint(w * ONE), -_MOST_WEIGHT, _MOST_WEIGHT) for w in weights),
            tuple(np.rint(np.clip(b, -8, 8) * ONE) * ONE for b in biases),
            document,
        )

    @property
    def inputs(self) -> int:
        """Numbers that it takes."""
        return len(self.weights[0])

    @property
    def outputs(self) -> int:
        """Numbers that it answers."""
        return len(self.biases[-1])

    @property
    def digest(self) -> str:
        """SHA-256 of the weights and biases, hexadecimal."""
        found = sha256()
        for weight, bias in zip(self.weights, self.biases):
            for part in (weight, bias / ONE):
                found.update(repr(part.shape).encode() + part.astype("<i4").tobytes())
        return found.hexdigest()

    @cached_property
    def _layers(self) -> list[tuple[Floats, Floats, float]]:
        """Of each layer its weights [outputs, inputs], its biases, and the least it answers.

        Both are divided by ``ONE`` beforehand, a power of two: every sum is, and none is rounded.
        """
        least = [0.0] * (len(self.weights) - 1) + [-_MOST_ACTIVATION]
        return [
            (np.ascontiguousarray(weight.T) / ONE, bias / ONE, bound)
            for weight, bias, bound in zip(self.weights, self.biases, least)
        ]

    def __call__(self, inputs: Floats) -> Floats:
        """The answers to some inputs.

        Args:
            inputs: whole numbers in float64, [inputs] or [inputs, P]; ``ONE`` is 1.

        Returns:
            Whole numbers in float64, [outputs] or [outputs, P]; ``ONE`` is 1.
        """
        if inputs.ndim == 1:
            return self._answers(inputs)
        answers = np.empty((self.outputs, inputs.shape[1]))
        for begin in range(0, inputs.shape[1], _BLOCK):
            block = slice(begin, begin + _BLOCK)
            answers[:, block] = self._answers(inputs[:, block])
        return answers

    def _answers(self, found: Floats) -> Floats:
        """The answers to a few inputs; for one of them each call here counts."""
        for weight, bias, least in self._layers:
            found = weight.dot(found)
            transposed = found.T  # a view, to whose rows or only row the biases are added
            transposed += bias
            np.rint(found, out=found)
            found.clip(least, _MOST_ACTIVATION, out=found)
        return found


def write_network(network: Network, path: str | os.PathLike[str]) -> None:
    """Write a network as plain arrays in NumPy's ``.npz``, whole or not at all.

    Equal networks give equal bytes.

    Raises:
        LaeError: if the file cannot be written.
    """
    document = {"format": FORMAT, "version": VERSION, **network.document}
    text = json.dumps(document, sort_keys=True, ensure_ascii=False)
    parts: dict[str, Any] = {"document": np.frombuffer(text.encode(), np.uint8)}
    for i, (weight, bias) in enumerate(zip(network.weights, network.biases)):
        parts[f"weight{i}"], parts[f"bias{i}"] = weight.astype("<i4"), (bias / ONE).astype("<i4")
    memory = io.BytesIO()
    np.savez(memory, **parts)
    with written_whole(path) as temporary, open(temporary, "wb") as file:
        file.write(memory.getbuffer())


def read_network(path: str | os.PathLike[str], inputs: int, outputs: int) -> Network:
    """Read a network; nothing in the file is executed.

    Args:
        path: the file.
        inputs: numbers that it must take.
        outputs: numbers that it must answer.

    Raises:
        LaeError: if the file is missing, damaged, or a network of another shape.
    """
    check_regular(path)
    try:
        parts = _arrays_of(path)
        text = parts["document"].tobytes()
        Budget(path).take(json_memory(text))
        document = json.loads(text)
        if document.pop("format") != FORMAT or document.pop("version") != VERSION:
            raise ValueError(f"not {FORMAT} version {VERSION}")
        count = sum(name.startswith("weight") for name in parts)
        weights = [parts[f"weight{i}"] for i in range(count)]
        biases = [parts[f"bias{i}"] for i in range(count)]
        _check(weights, biases, inputs, outputs)
    except FileNotFoundError as error:
        raise LaeError(f"{path}: no such file") from error
    except LaeError:
        raise
    except Exception as error:  # zipfile, NumPy and json raise all kinds on damaged files
        reason = shown(str(error))
        raise LaeError(f"{path}: not a forecaster that lae-sim train wrote: {reason}") from error
    return Network(
        tuple(weight.astype(np.float64) for weight in weights),
        tuple(bias.astype(np.float64) * ONE for bias in biases),
        document,
    )


def _arrays_of(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The arrays of an ``.npz`` file, no larger than is allowed and without any pickle.

    NumPy's own reader believes a header that declares more than there is.
    """
    with zipfile.ZipFile(path) as archive:
        Budget(path).take(sum(part.file_size for part in archive.infolist()))
        names = archive.namelist()
        if "document.npy" not in names:  # such as a file of torch, which lae_sim 0.1.0 wrote
            raise ValueError("no such network in it; train it anew")
        return {name.removesuffix(".npy"): _array(archive.read(name)) for name in names}


def _array(content: bytes) -> Any:
    file = io.BytesIO(content)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[np.lib.format.read_magic(file)]
    shape, is_fortran, kind = read_header(file)
    if kind.kind not in "iu":
        raise ValueError(f"an array of {kind}")
    values = np.frombuffer(content, kind, offset=file.tell())
    return values.reshape(shape, order="F" if is_fortran else "C")


def _check(weights: Sequence[Any], biases: Sequence[Any], inputs: int, outputs: int) -> None:
    """Check that layers fit one another, and that their sums are exact."""
    width = inputs
    for weight, bias in zip(weights, biases):
        if weight.dtype.kind != "i" or bias.dtype.kind != "i":
            raise ValueError("its weights are no whole numbers")
        if bias.ndim != 1 or weight.shape != (width, len(bias)) or width > _MOST_INPUTS:
            raise ValueError(f"a layer of shape {weight.shape} after {width} numbers")
        if any(part.max() > _MOST_WEIGHT or part.min() < -_MOST_WEIGHT for part in (weight, bias)):
            raise ValueError("its weights are too large")
        width = weight.shape[1]
    if width != outputs:
        raise ValueError(f"answers {width} numbers, not {outputs}")
