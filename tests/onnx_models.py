"""Small ONNX models, written without the package onnx (field numbers: its ``onnx.proto``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

Shape = Sequence[int | str]


def field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    payload = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(payload)) + payload


def varint(value: int) -> bytes:
    more = value >> 7
    return bytes([value & 127 | 128]) + varint(more) if more else bytes([value])


def value(name: str, shape: Shape) -> bytes:
    """A float tensor; a side that is text is open."""
    sides = [field(1, field(1 if isinstance(side, int) else 2, side)) for side in shape]
    tensor = field(1, 1) + field(2, b"".join(sides))
    return field(1, name) + field(2, field(1, tensor))


def node(kind: str, inputs: str, outputs: str, **attributes: int | Sequence[int]) -> bytes:
    made = b"".join(field(1, name) for name in inputs.split())
    made += b"".join(field(2, name) for name in outputs.split()) + field(4, kind)
    for name, given in attributes.items():
        if isinstance(given, int):
            content = field(3, given) + field(20, 2)
        else:
            content = b"".join(field(8, number) for number in given) + field(20, 7)
        made += field(5, field(1, name) + content)
    return made


def model(
    nodes: Sequence[bytes],
    inputs: Mapping[str, Shape],
    outputs: Mapping[str, Shape],
    between: Mapping[str, Shape] | None = None,
) -> bytes:
    graph = b"".join(field(1, each) for each in nodes) + field(2, "made")
    for number, values in ((11, inputs), (12, outputs), (13, between or {})):
        graph += b"".join(field(number, value(name, shape)) for name, shape in values.items())
    return field(1, 7) + field(7, graph) + field(8, field(1, "") + field(2, 9))


def pooled(inputs: str, outputs: str, size: int, step: int) -> bytes:
    return node("AveragePool", inputs, outputs, kernel_shape=[size, size], strides=[step, step])


def cut(inputs: str, outputs: str, start: int, end: int) -> bytes:
    """Some channels."""
    return node("Slice", inputs, outputs, axes=[1], starts=[start], ends=[end])


def average(sides: Shape = (255, 255), name: str = "input") -> bytes:
    """Means of 8 x 8 pixels, every 16: 255 pixels become 16, and 127 become 8."""
    side = 16 if sides == (255, 255) else "n"
    return model(
        [pooled(name, "means", 8, 16), node("Relu", "means", "output")],
        {name: (1, 3, *sides)},
        {"output": (1, 3, side, side)},
        {"means": (1, 3, side, side)},
    )


def write_nanotrack(folder: Path) -> Path:
    """Two files with the inputs and outputs of NanoTrack v3; brightness is the target."""
    head = [
        node("GlobalAveragePool", "input1", "target"),
        node("Mul", "input2 target", "product"),
        pooled("product", "smooth", 2, 1),
        node("Sqrt", "smooth", "root"),
        cut("root", "output1", 0, 2),
        node("Concat", "root root", "six", axis=1),
        cut("six", "output2", 0, 4),
    ]
    inputs = {"input1": (1, 3, 8, 8), "input2": (1, 3, 16, 16)}
    outputs = {"output1": (1, 2, 15, 15), "output2": (1, 4, 15, 15)}
    (folder / "backbone.onnx").write_bytes(average())
    (folder / "head.onnx").write_bytes(model(head, inputs, outputs))
    return folder


def write_fear_xs(folder: Path) -> Path:
    """Two files with the inputs and outputs of FEAR-XS: the target is where it is brightest."""
    init = [pooled("image", "features", 16, 16)]
    track = [
        node("GlobalAveragePool", "template_features", "target"),
        pooled("image", "means", 16, 16),
        node("Mul", "means target", "product"),
        cut("product", "cls", 0, 1),
        node("Div", "product product", "ones"),
        cut("ones", "one", 0, 1),
        node("Concat", "ones one", "bbox", axis=1),
    ]
    features = {"features": (1, 3, 8, 8)}
    inputs = {"image": (1, 3, 256, 256), "template_features": (1, 3, 8, 8)}
    outputs = {"bbox": (1, 4, 16, 16), "cls": (1, 1, 16, 16)}
    (folder / "fear_xs_init.onnx").write_bytes(model(init, {"image": (1, 3, 128, 128)}, features))
    (folder / "fear_xs_track.onnx").write_bytes(model(track, inputs, outputs))
    return folder
