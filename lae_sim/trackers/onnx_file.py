"""The shapes that an ONNX file declares, rewritten in its bytes.

An ONNX file is a message of protocol buffers: fields of a number and a payload, which may be a
message itself (https://protobuf.dev/programming-guides/encoding). The few numbers below are those
of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

_GRAPH = 7  # of ModelProto
_INPUT, _OUTPUT, _VALUE_INFO = 11, 12, 13  # of GraphProto, each a ValueInfoProto
_NAME, _TYPE = 1, 2  # of ValueInfoProto
_TENSOR = 1  # of TypeProto
_SHAPE = (
    2  # of TypeProto.Tensor; a TensorShapeProto: field 1, a dimension, whose field 1 is its size
)

if TYPE_CHECKING:
    Edit = Callable[[bytes], bytes | None]  # of a payload; None leaves the field out


def reshaped(model: bytes, shapes: Mapping[str, Sequence[int]]) -> bytes:
    """The model with inputs of other shapes, and none declared for what is computed from them.

    Args:
        model: contents of an ONNX file.
        shapes: of inputs, by name.

    Raises:
        ValueError: if the bytes are no such model, or it has no such input.
    """
    missing = set(shapes)

    def as_asked(value: bytes) -> bytes:
        name = next((p.decode("utf-8") for n, p, _ in _fields(value) if n == _NAME), "")
        if name not in shapes:
            return value
        missing.discard(name)
        return _with_shape(value, shapes[name])

    def graph(message: bytes) -> bytes:
        edits = {_INPUT: as_asked, _OUTPUT: _with_shape, _VALUE_INFO: lambda _: None}
        return _edited(message, edits)

    made = _edited(model, {_GRAPH: graph})
    if missing:
        raise ValueError(f"it has no input {sorted(missing)[0]!r}")
    return made


def _with_shape(value: bytes, shape: Sequence[int] | None = None) -> bytes:
    """A ValueInfoProto with that shape, or with none."""

    def tensor(message: bytes) -> bytes:
        bare = _edited(message, {_SHAPE: lambda _: None})
        if shape is None:
            return bare
        sides = (_field(1, _varint(1 << 3) + _varint(side)) for side in shape)
        return bare + _field(_SHAPE, b"".join(sides))

    return _edited(value, {_TYPE: lambda kind: _edited(kind, {_TENSOR: tensor})})


def _edited(message: bytes, edits: Mapping[int, Edit]) -> bytes:
    """A message with other payloads in the fields of some numbers, or without these fields."""
    parts = []
    for number, payload, whole in _fields(message):
        if number in edits:
            edited = edits[number](payload)
            whole = b"" if edited is None else _field(number, edited)
        parts.append(whole)
    return b"".join(parts)


def _fields(message: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Each field's number, its payload if it has a length, and all of its bytes."""
    at = 0
    while at < len(message):
        start = at
        key, at = _read_varint(message, at)
        begin = at
        kind = key & 7
        if kind == 0:
            _, at = _read_varint(message, at)
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        elif kind == 2:
            size, begin = _read_varint(message, at)
            at = begin + size
        else:
            raise ValueError("not a message of protocol buffers")
        if at > len(message):
            raise ValueError("it ends in the middle of a field")
        yield key >> 3, message[begin:at], message[start:at]


def _field(number: int, payload: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(payload)) + payload


def _varint(value: int) -> bytes:
    """A number in groups of seven bits, the least first; all but the last have the eighth bit."""
    groups = bytearray()
    while value > 127:
        groups.append(value & 127 | 128)
        value >>= 7
    groups.append(value)
    return bytes(groups)


def _read_varint(message: bytes, at: int) -> tuple[int, int]:
    """The number there, and where it ends."""
    value = shift = 0
    while at < len(message) and shift < 64:
        byte = message[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
    raise ValueError("it ends in the middle of a number")
