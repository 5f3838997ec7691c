"""Pickles read without running anything: plain values and numeric arrays only.

A pickle is a program. Here it can only take notes: every name that NumPy arrays need is replaced by
a class that keeps its arguments, every other name is refused, and what was noted is decoded
afterwards with all of it checked. Neither NumPy nor anything else is called by the file.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim.datasets.foreign import recognised
from lae_sim.decoding import Budget, TooLargeError, read_bytes
from lae_sim.errors import LaeError

_MAX_DEPTH = 32
# What an operation may leave in memory: an empty dict, the same decoded, and places in lists.
_OPERATION_BYTES = 160
_NUMERIC = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])\Z")


class _Note:
    """What a pickle asked for: a name's arguments and state, kept and not acted upon."""

    args: tuple[Any, ...] = ()
    state: Any = None

    def __init__(self, *args: Any) -> None:
        self.args = args

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Note):
    """``_reconstruct(ndarray, (0,), b'b')`` with the state (version, shape, dtype, order, data)."""


class _Buffer(_Note):
    """``_frombuffer(data, dtype, shape, order)``, arrays of pickle protocol 5."""


class _Scalar(_Note):
    """``scalar(dtype, data)``."""


class _DType(_Note):
    """``dtype(code, align, copy)`` with the state (version, byte order, ...)."""


class _NDArray(_Note):
    """The class ``ndarray``, as an argument of ``_reconstruct``."""


class _Bytes(_Note):
    """``_codecs.encode(text, 'latin1')`` or ``bytes()``: bytes before pickle protocol 3."""


_NAMES: dict[tuple[str, str], type[_Note]] = {
    ("numpy", "ndarray"): _NDArray,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _Bytes,
    ("builtins", "bytes"): _Bytes,
    ("__builtin__", "bytes"): _Bytes,
}
for _core in ("numpy.core", "numpy._core"):
    _NAMES[f"{_core}.multiarray", "_reconstruct"] = _Array
    _NAMES[f"{_core}.multiarray", "scalar"] = _Scalar
    _NAMES[f"{_core}.numeric", "_frombuffer"] = _Buffer


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_Note]:
        note = _NAMES.get((module, name))
        if note is None:
            raise LaeError(f"refuses {ascii(f'{module}.{name}')[1:-1][:120]}")
        return note


def load_plain(path: Path) -> Any:
    """Read a pickle of numbers, text, lists, tuples, dicts and numeric NumPy arrays.

    Pickles of Python 2 and 3 and of NumPy 1 and 2 are read.

    Raises:
        LaeError: if the file asks for anything else, which it names, or is damaged.
    """
    budget = Budget(path)
    with recognised(path, b"\x80"):
        data = read_bytes(path, budget)
        try:
            _check_operations(data, budget)
            # Python 2 keeps bytes and text alike; latin1 keeps every byte.
            return _Decoder().decode(_Unpickler(io.BytesIO(data), encoding="latin1").load())
        except (TooLargeError, MemoryError):
            raise
        except LaeError as error:
            raise LaeError(
                f"{path}: {error}: a pickle of results may hold numbers, text, lists, dicts and "
                "numeric NumPy arrays only"
            ) from error
        except Exception as error:  # a hostile pickle can raise anything
            raise LaeError(
                f"{path}: not a readable pickle: {ascii(str(error))[1:-1][:200]}"
            ) from error


def _check_operations(data: bytes, budget: Budget) -> None:
    """Refuse what could exhaust memory before a single object is made.

    ``genops`` only reads; it stops where the file ends before a declared length.
    """
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data), 1):
        size = len(argument) if isinstance(argument, (bytes, str)) else 0
        budget.take(_OPERATION_BYTES + 4 * size)  # text has up to four bytes for each
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and int(argument or 0) > count:
            raise LaeError(f"asks for {argument} places in memory")
        if "PERSID" in opcode.name or opcode.name.startswith("EXT"):
            raise LaeError(f"refuses {opcode.name}, an object outside of the file")


class _Decoder:
    """Turns notes into values; a value that is referred to many times is decoded once."""

    def __init__(self) -> None:
        self._done: dict[int, Any] = {}
        self._busy: set[int] = set()

    def decode(self, value: Any, depth: int = 0) -> Any:
        if type(value) in (int, float, bool, str, bytes, type(None)):
            return value
        key = id(value)
        if key in self._done:
            return self._done[key]
        if depth > _MAX_DEPTH or key in self._busy:
            raise LaeError("is nested too deeply")
        self._busy.add(key)
        self._done[key] = self._made(value, depth + 1)
        self._busy.discard(key)
        return self._done[key]

    def _made(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if kind in (list, tuple):
            return kind(self.decode(item, depth) for item in value)
        if kind is dict:
            return {self._key(key): self.decode(item, depth) for key, item in value.items()}
        if kind is _Array and value.args[:1] == (_NDArray,):
            _, shape, dtype, fortran, raw = value.state
            return _array(raw, dtype, shape, "F" if fortran is True else "C")
        if kind is _Buffer:
            raw, dtype, shape, order = value.args
            return _array(raw, dtype, shape, "F" if order == "F" else "C")
        if kind is _Scalar:
            dtype, raw = value.args
            return _array(raw, dtype, (), "C").item()
        if kind is _Bytes:
            return _bytes(value)
        raise LaeError(f"refuses {kind.__name__.lstrip('_').lower()}")

    def _key(self, key: Any) -> Any:
        if type(key) not in (int, str):
            raise LaeError(f"refuses a {type(key).__name__} as key of a dict")
        return key


def _array(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray[Any, Any]:
    kind = _dtype(dtype)
    data = _bytes(raw)
    if not (isinstance(shape, tuple) and all(type(side) is int and side >= 0 for side in shape)):
        raise LaeError("holds an array of a strange shape")
    if len(shape) > 4 or math.prod(shape) * kind.itemsize != len(data):
        raise LaeError("holds an array whose data do not fit its shape")
    return np.frombuffer(data, kind).reshape(shape, order=order)


def _dtype(note: Any) -> np.dtype[Any]:
    code = note.args[0] if type(note) is _DType and note.args else None
    state = note.state if type(note) is _DType else None
    if isinstance(code, bytes):
        code = code.decode("latin1")
    if not (isinstance(code, str) and _NUMERIC.match(code)):
        raise LaeError(f"refuses an array of dtype {ascii(code)[:40]}")
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "="
    order = order.decode("latin1") if isinstance(order, bytes) else order
    kind: np.dtype[Any] = np.dtype((order if order in ("<", ">") else "=") + code.lstrip("<>|="))
    return kind


def _bytes(value: Any) -> bytes:
    if isinstance(value, (bytes, bytearray)):
        return bytes(value)
    if isinstance(value, str):  # Python 2
        return value.encode("latin1")
    if type(value) is _Bytes:
        if not value.args:
            return b""
        text, encoding = value.args
        if isinstance(text, str) and encoding in ("latin1", "latin-1"):
            return text.encode("latin1")
    raise LaeError("holds an array without data")
