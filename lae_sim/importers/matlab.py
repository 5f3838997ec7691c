"""MATLAB files: numbers, text, cells and structs.

Those of version 5 to 7 are read here, since ``scipy.io.loadmat`` crashes the process on damaged
files. See MathWorks, "MAT-File Format": a file is a header and data elements, each with a tag of
its type and size.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim.decoding import Budget, read_bytes
from lae_sim.errors import LaeError
from lae_sim.importers.hdf5 import load_hdf5

_MAX_DEPTH = 16
# What an array, a cell or a field takes as an object of Python, generously.
_OBJECT_BYTES = 256
_HEADER_BYTES = 128

_MOST_SIZES = 32

# Types of data elements.
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
# Classes of matrices.
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMERIC = range(6, 16)
_COMPLEX_FLAG = 0x800


def load_matlab(path: Path) -> dict[str, Any]:
    """The variables of a file by name.

    Numeric arrays are float64 arrays of their shape, text is a str, cells and struct arrays are
    lists in column order, a struct is a dict. Anything else is None.

    Raises:
        LaeError: if the file is of another version, damaged, or too large
            (:func:`lae_sim.decoding.max_decoded`), or of version 7.3 and h5py is not installed.
    """
    budget = Budget(path)
    data = memoryview(read_bytes(path, budget))
    head = bytes(data[:_HEADER_BYTES])
    if head.startswith((b"MATLAB 7.3", b"\x89HDF")):
        return load_hdf5(path)
    order = {b"IM": "<", b"MI": ">"}.get(head[126:])
    if not head.startswith(b"MATLAB 5.0") or order is None:
        raise LaeError(f"{path}: not a MATLAB file of version 5 to 7.3")
    try:
        return _variables(data, order, budget)
    except (ValueError, OverflowError, struct.error, zlib.error, UnicodeError) as error:
        raise LaeError(f"{path}: not a readable MATLAB file: {error}") from error


@dataclass
class _Elements:
    """Data elements one after the other; ``at`` is the next."""

    data: memoryview
    order: str
    budget: Budget
    at: int = 0

    def more(self) -> bool:
        return self.at < len(self.data)

    def next(self) -> tuple[int, memoryview]:
        """Type and content of the next element."""
        word, size = struct.unpack_from(f"{self.order}II", self.data, self.at)
        begin = self.at + 8
        if word >> 16:  # a small element: type, size and content within 8 bytes
            word, size, begin = word & 0xFFFF, word >> 16, self.at + 4
        content = self.data[begin : begin + size]
        if len(content) < size or (begin == self.at + 4 and size > 4):
            raise ValueError("it ends within an element")
        padding = 0 if word == _COMPRESSED else -(begin + size - self.at) % 8
        self.at = begin + size + padding
        return word, content


def _variables(data: memoryview, order: str, budget: Budget) -> dict[str, Any]:
    variables = {}
    elements = _Elements(data, order, budget, _HEADER_BYTES)
    while elements.more():
        kind, content = elements.next()
        if kind == _COMPRESSED:
            kind, content = _unpacked(content, order, budget)
        if kind == _MATRIX:
            name, value = _matrix(content, order, budget, 0)
            variables[name] = value
    return variables


def _unpacked(content: memoryview, order: str, budget: Budget) -> tuple[int, memoryview]:
    """Type and content of the one element that a compressed one holds."""
    unpack = zlib.decompressobj()
    tag = unpack.decompress(content, 8)
    size = struct.unpack(f"{order}II", tag)[1] if len(tag) == 8 else 0
    budget.take(size)
    rest = unpack.decompress(unpack.unconsumed_tail, size) if size else b""
    return _Elements(memoryview(tag + rest), order, budget).next()


def _matrix(content: memoryview, order: str, budget: Budget, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix."""
    budget.take(_OBJECT_BYTES)
    if depth > _MAX_DEPTH:
        raise ValueError("it is nested too deeply")
    if not content:
        return "", np.empty((0, 0))
    parts = _Elements(content, order, budget)
    flags = _sizes(parts)[0]
    shape = _sizes(parts)
    count = math.prod(shape)
    if len(shape) < 2 or min(shape) < 0 or count > len(content):
        raise ValueError("an array has a strange shape")
    name = _text(parts)
    kind = flags & 0xFF
    if kind in _NUMERIC and not flags & _COMPLEX_FLAG:
        numbers = _numbers(parts)
        budget.take(len(numbers) * np.dtype(np.float64).itemsize)
        return name, numbers.astype(np.float64).reshape(shape, order="F")
    if kind == _CHAR:
        return name, _text(parts)
    if kind == _CELL:
        return name, [_child(parts, depth) for _ in range(count)]
    if kind == _STRUCT:
        return name, _structs(parts, count, depth)
    return name, None


def _structs(parts: _Elements, count: int, depth: int) -> Any:
    width = _sizes(parts)[0]
    _, names = parts.next()
    if width < 1:
        raise ValueError("a struct has fields without names")
    parts.budget.take(_OBJECT_BYTES * (count + len(names) // width))
    fields = [
        bytes(names[at : at + width]).split(b"\0")[0].decode("latin-1")
        for at in range(0, len(names), width)
    ]
    structs = [{field: _child(parts, depth) for field in fields} for _ in range(count)]
    return structs[0] if count == 1 else structs


def _child(parts: _Elements, depth: int) -> Any:
    kind, content = parts.next()
    if kind != _MATRIX:
        raise ValueError("a cell or field is not an array")
    return _matrix(content, parts.order, parts.budget, depth + 1)[1]


def _numbers(parts: _Elements) -> np.ndarray[Any, Any]:
    """The numbers of the next element, of the type that they are stored in."""
    kind, content = parts.next()
    if kind not in _NUMBERS:
        raise ValueError(f"type {kind} is not one of numbers")
    numbers: np.ndarray[Any, Any] = np.frombuffer(content, np.dtype(parts.order + _NUMBERS[kind]))
    return numbers


def _sizes(parts: _Elements) -> tuple[int, ...]:
    """The integers of the next element, at least one."""
    numbers = _numbers(parts)
    if not 0 < len(numbers) <= _MOST_SIZES or numbers.dtype.kind == "f":
        raise ValueError("a size is missing")
    return tuple(numbers.tolist())


def _text(parts: _Elements) -> str:
    """The text of the next element."""
    kind, content = parts.next()
    if kind not in _TEXTS:
        raise ValueError(f"type {kind} is not one of text")
    encoding = _TEXTS[kind]
    if encoding in ("utf-16", "utf-32"):
        encoding += "-le" if parts.order == "<" else "-be"
    parts.budget.take(4 * len(content))  # a str has up to four bytes for each
    return bytes(content).decode(encoding)
