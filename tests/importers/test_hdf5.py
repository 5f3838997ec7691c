"""MATLAB files of version 7.3, written here as MATLAB writes them, and worse."""

from __future__ import annotations

import contextlib
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError
from lae_sim.importers.matlab import load_matlab
from lae_sim.importers.results import Source, read_results

h5py = pytest.importorskip("h5py")

BOXES = np.array([[1, 2, 3, 4], [5, 6, 7.5, 8], [9, 10, 11, 12]])


def put(group: Any, name: str, value: Any) -> Any:
    """Write a value as MATLAB does: transposed, with the name of its class."""
    if isinstance(value, dict):
        item = group.create_group(name)
        for field, inner in value.items():
            put(item, field, inner)
        kind = "struct"
    elif isinstance(value, list):
        refs = [put(group.file["#refs#"], f"{name}{i}", each).ref for i, each in enumerate(value)]
        item = group.create_dataset(name, (len(refs), 1), h5py.ref_dtype)
        for i, ref in enumerate(refs):
            item[i, 0] = ref
        kind = "cell"
    elif isinstance(value, str):
        characters = np.frombuffer(value.encode("utf-16-le"), "<u2").reshape(-1, 1)
        item, kind = group.create_dataset(name, data=characters), "char"
    else:
        numbers = np.atleast_2d(value)
        packing = {"chunks": numbers.T.shape, "compression": "gzip"} if numbers.size > 1 else {}
        item, kind = group.create_dataset(name, data=numbers.T, **packing), "double"
    item.attrs["MATLAB_class"] = np.bytes_(kind)
    return item


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes variables into a file with MATLAB's header."""

    def file(damage: Callable[[Any], object] = lambda opened: None, **variables: Any) -> Path:
        path = tmp_path / "a.mat"
        with h5py.File(path, "w", userblock_size=512) as opened:
            opened.create_group("#refs#")
            for name, value in variables.items():
                put(opened, name, value)
            damage(opened)
        with path.open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")
        return path

    return file


RUN = {"res": BOXES, "fps": 20.5, "type": "rect", "len": 3}


@pytest.mark.parametrize("variables", [RUN, {"results": RUN}, {"results": [RUN]}])
def test_results(write: Callable[..., Path], variables: dict[str, Any]) -> None:
    found = read_results("mat", Source("a", write(**variables)), 1, None, measured=True)
    np.testing.assert_array_equal(found.boxes, BOXES)
    assert found.mean_fps == 20.5


def test_values(write: Callable[..., Path]) -> None:
    def more(file: Any) -> None:
        empty = file.create_dataset("nothing", data=np.array([0, 0], "u8"))
        empty.attrs["MATLAB_class"] = np.bytes_("char")
        empty.attrs["MATLAB_empty"] = np.uint8(1)
        several = file.create_group("several")
        several.attrs["MATLAB_class"] = np.bytes_("struct")
        item = several.create_dataset("n", (2, 1), h5py.ref_dtype)
        for i in range(2):
            item[i, 0] = put(file["#refs#"], f"n{i}", i).ref
        file.create_dataset("complex", data=np.array([[1 + 2j]]))
        file.create_dataset("hole", (2, 1), h5py.ref_dtype)

    found = load_matlab(write(more, t="Grüße", c=["a", [1.0]], s={"x": {"y": 2}}, flag=np.uint8(1)))
    assert list(found) == ["c", "complex", "flag", "hole", "nothing", "s", "several", "t"]
    assert (found["t"], found["nothing"], found["complex"]) == ("Grüße", "", None)
    assert found["hole"] == [None, None]
    assert found["c"][0] == "a"
    assert found["c"][1][0].tolist() == [[1]]
    assert found["s"]["x"]["y"].tolist() == [[2]]
    assert [each["n"].tolist() for each in found["several"]] == [[[0]], [[1]]]
    assert found["flag"].dtype == np.float64


def external(file: Any) -> None:
    Path(file.filename).with_name("secret").write_bytes(bytes(64))
    file.create_dataset("x", (2, 4), "f8", external=[("secret", 0, 64)])


def virtual(file: Any) -> None:
    layout = h5py.VirtualLayout((2, 4), "f8")
    layout[:] = h5py.VirtualSource("secret", "x", (2, 4))
    file.create_virtual_dataset("x", layout)


def link(file: Any) -> None:
    file["x"] = h5py.ExternalLink("secret.h5", "/x")


def soft_link(file: Any) -> None:
    file["x"] = h5py.SoftLink("/elsewhere")


def huge(file: Any) -> None:
    file.create_dataset("x", (1 << 20, 1 << 20), "f8", chunks=(1, 4))


def huge_when_converted(file: Any) -> None:
    file.create_dataset("x", (1 << 26,), "u1")


def huge_chunk(file: Any) -> None:
    file.create_dataset("x", (2,), "f8", maxshape=(None,), chunks=(1 << 27,), compression="gzip")


def bomb(file: Any) -> None:
    item = file.create_dataset("x", (4,), "f8", chunks=(4,), compression="gzip")
    item.id.write_direct_chunk((0,), zlib.compress(bytes(1 << 24), 9))


def twice_packed(file: Any) -> None:
    file.create_dataset("x", (64,), "f8", chunks=(64,), compression="gzip", shuffle=True)


def cycle(file: Any) -> None:
    file["s"] = file.create_group("g")
    file["g"]["again"] = file["g"]


def many(file: Any) -> None:
    shared = put(file["#refs#"], "shared", np.zeros((1000, 1000)))
    item = file.create_dataset("x", (100, 1), h5py.ref_dtype)
    item[:, 0] = shared.ref


def long_name(file: Any) -> None:
    file.create_dataset("x", (2,), "f8").attrs["MATLAB_class"] = "text of any length"


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (external, "data in another file"),
        (virtual, "data in another file"),
        (link, "a link to data elsewhere"),
        (soft_link, "a link to data elsewhere"),
        (huge, "too much for such a file"),
        (huge_when_converted, "too much for such a file"),
        (huge_chunk, "too much for such a file"),
        (bomb, "unpacks to more than it says"),
        (twice_packed, "packed as MATLAB packs none"),
        (cycle, "nested too deeply"),
        (many, "more than 32 MiB"),
        (long_name, "class of a value is no text"),
    ],
)
def test_what_matlab_does_not_write(
    write: Callable[..., Path], damage: Callable[[Any], object], problem: str
) -> None:
    path = write(damage, res=BOXES)
    with max_decoded("32MiB"), pytest.raises(LaeError, match=rf"a\.mat: .*{problem}"):
        load_matlab(path)


@settings(max_examples=60)
@given(st.data())
def test_changed_bytes_are_values_or_errors(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.getbasetemp()
    source, path = folder / "whole.mat", folder / "changed.mat"
    if not source.exists():
        with h5py.File(source, "w") as file:
            file.create_group("#refs#")
            put(file, "results", [RUN])
    content = bytearray(source.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    with contextlib.suppress(LaeError):
        load_matlab(path)


def test_without_h5py_the_extra_is_named(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(**RUN)
    monkeypatch.setitem(sys.modules, "h5py", None)
    needs = r"version 7\.3: to read it pip install 'lae-sim\[mat73\]'.*'-v7'\)"
    with pytest.raises(LaeError, match=needs):
        load_matlab(path)
