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

from lae_sim.errors import LaeError
from lae_sim.importers.hdf5 import load_hdf5

_MAX_BYTES = 1 << 27
_MAX_DEPTH = 16
_HEADER_BYTES = 128

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
        LaeError: if the file is of another version, damaged, or larger than any result, or it is
            of version 7.3 and h5py is not installed.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise LaeError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data.startswith(b"MATLAB 7.3") or data.startswith(b"\x89HDF"):
        return load_hdf5(path)
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if not data.startswith(b"MATLAB 5.0") or order is None:
        raise LaeError(f"{path}: not a MATLAB file of version 5 to 7.3")
    try:
        return _variables(data, order)
    except (ValueError, struct.error, zlib.error, UnicodeError) as error:
        raise LaeError(f"{path}: not a readable MATLAB file: {error}") from error


@dataclass
class _Elements:
    """Data elements one after the other; ``at`` is the next."""

    data: bytes
    order: str
    at: int = 0

    def more(self) -> bool:
        return self.at < len(self.data)

    def next(self) -> tuple[int, bytes]:
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


def _variables(data: bytes, order: str) -> dict[str, Any]:
    if len(data) > _MAX_BYTES:
        raise ValueError("it is too large")
    budget = _MAX_BYTES
    variables = {}
    elements = _Elements(data, order, _HEADER_BYTES)
    while elements.more():
        kind, content = elements.next()
        if kind == _COMPRESSED:
            content = zlib.decompressobj().decompress(content, budget + 1)
            budget -= len(content)
            if budget < 0:
                raise ValueError("it is too large when unpacked")
            kind, content = _Elements(content, order).next()
        if kind == _MATRIX:
            name, value = _matrix(content, order, 0)
            variables[name] = value
    return variables


def _matrix(content: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of a matrix."""
    if depth > _MAX_DEPTH:
        raise ValueError("it is nested too deeply")
    if not content:
        return "", np.empty((0, 0))
    parts = _Elements(content, order)
    flags = _sizes(parts)[0]
    shape = _sizes(parts)
    count = math.prod(shape)
    if len(shape) < 2 or min(shape) < 0 or count > len(content):
        raise ValueError("an array has a strange shape")
    name = _text(*parts.next(), order)
    kind = flags & 0xFF
    if kind in _NUMERIC and not flags & _COMPLEX_FLAG:
        return name, _numbers(*parts.next(), order).astype(np.float64).reshape(shape, order="F")
    if kind == _CHAR:
        return name, _text(*parts.next(), order)
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
    fields = [
        names[at : at + width].split(b"\0")[0].decode("latin-1")
        for at in range(0, len(names), width)
    ]
    structs = [{field: _child(parts, depth) for field in fields} for _ in range(count)]
    return structs[0] if count == 1 else structs


def _child(parts: _Elements, depth: int) -> Any:
    kind, content = parts.next()
    if kind != _MATRIX:
        raise ValueError("a cell or field is not an array")
    return _matrix(content, parts.order, depth + 1)[1]


def _numbers(kind: int, content: bytes, order: str) -> np.ndarray[Any, Any]:
    if kind not in _NUMBERS:
        raise ValueError(f"type {kind} is not one of numbers")
    numbers: np.ndarray[Any, Any] = np.frombuffer(content, np.dtype(order + _NUMBERS[kind]))
    return numbers


def _sizes(parts: _Elements) -> tuple[int, ...]:
    """The integers of the next element, at least one."""
    numbers = _numbers(*parts.next(), parts.order)
    if not len(numbers) or numbers.dtype.kind == "f":
        raise ValueError("a size is missing")
    return tuple(numbers.tolist())


def _text(kind: int, content: bytes, order: str) -> str:
    if kind not in _TEXTS:
        raise ValueError(f"type {kind} is not one of text")
    encoding = _TEXTS[kind]
    if encoding in ("utf-16", "utf-32"):
        encoding += "-le" if order == "<" else "-be"
    return content.decode(encoding)
