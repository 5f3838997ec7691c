"""Damaged and hostile results, times and truth: an error of ours or a trace, and little memory.

The suite tries a few files of each kind. To try many (``FUZZ_EXAMPLES`` of each, 20,000 by
default)::

    pytest tests/importers/test_hostile.py --hypothesis-profile fuzz
"""

from __future__ import annotations

import io
import json
import pickle
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError
from lae_sim.importers.convert import convert_results
from lae_sim.importers.times import UNITS
from lae_sim.study.spec import read_study

resource = pytest.importorskip("resource", reason="Windows does not tell how much memory is taken")

MOST_DECODED = 4 << 20
MOST_TAKEN = 64 << 20

BOXES = np.array([[10 + 3 * i, 20, 30 + i % 3, 40] for i in range(8)], float)
SECONDS = np.array([0.1, *np.full(7, 0.02)])


def text_of(table: np.ndarray[Any, Any], separator: str = ",") -> bytes:
    rows = (separator.join(f"{value:g}" for value in np.atleast_1d(row)) for row in table)
    return "\n".join(rows).encode() + b"\n"


def mat_of(content: dict[str, Any]) -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, content)
    return file.getvalue()


def npy_of(array: np.ndarray[Any, Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


MATS = [
    mat_of({"results": np.array([{"res": BOXES, "fps": 20.5, "type": "rect"}], dtype=object)}),
    mat_of({"res": BOXES, "fps": 20.5, "len": 8, "list": np.array([1, "a", BOXES], dtype=object)}),
    mat_of({"results": {"res": BOXES.astype(np.uint8), "fps": np.int16(20), "name": "\u00e9"}}),
]
RUN = {
    "results_raw": BOXES.tolist(),
    "timestamps": np.arange(1, 9) / 30 + 0.01,
    "input_fidx": list(range(8)),
    "runtime": [np.float64(0.02)] * 8,
}
PICKLES = [pickle.dumps(RUN, protocol) for protocol in range(6)]
TIMES = [text_of(SECONDS), b"time_ms\n" + text_of(1000 * SECONDS)]
JSONS = [
    json.dumps([{"res": BOXES.tolist(), "fps": 20.5, "type": "rect", "len": 8}]).encode(),
    json.dumps({"results": {"res": BOXES.tolist(), "resType": "rect", "fps": 20}}).encode(),
]
NPYS = [npy_of(BOXES), npy_of(BOXES.astype(np.int8)), npy_of(np.asfortranarray(BOXES))]
STUDY = b'traces = ["a.parquet"]\nfps = [29.97, "trace"]\nlatencies = "recorded"\nseed = 3\n'
CSV = b"tracker,sequence,frames,fps\nMY,car,8,25.5\nother,car,,30\n"

# Numbers that fields of sizes and counts are replaced by.
EXTREMES = [
    struct.pack(code, value)
    for code, values in {
        "<i": (-1, 0, 1, 7, 2**16, 2**31 - 1, -(2**31)),
        "<q": (-1, 2**40, 2**63 - 1),
        "<d": (np.nan, np.inf, -1.0, 1e308, 5e-324),
    }.items()
    for value in values
]
# Opcodes, among them those that call, nest, refer and take long arguments.
OPCODES = [b"(", b"]", b"}", b")", b"l", b"d", b"t", b"0", b"2", b"R", b"b", b"s", b"u", b"a", b"e"]
OPCODES += [b"h\x00", b"q\x01", b"K\xff", b"N", b"\x88", b"I99999999999999999999\n", b"F1e999\n"]
OPCODES += [b"L" + b"9" * 5000 + b"L\n", b"\x8a\x09" + b"\xff" * 9, b"G\x7f\xf0" + bytes(6)]
OPCODES += [
    b"\x8b" + struct.pack("<i", 2500) + b"\x7f" * 2500,
    b"X\xff\xff\xff\xff",
    b"cos\nsystem\n",
]
WORDS = [
    b"nan",
    b"NaN",
    b"inf",
    b"-1",
    b"0",
    b"1e308",
    b"1e-308",
    b"1e999",
    b"1_0",
    b"0x10",
    b"1,5",
]
WORDS += [
    b"",
    b",",
    b";",
    b"\t",
    b"\n",
    b"\r",
    b"\0",
    b"9" * 5000,
    b"1e9999999",
    b"time_ms",
    b"fps",
]
WORDS += [
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    "\u0663".encode(),
    b"\xff",
    b'"',
    b"'",
    b"[" * 2000,
    b"{a=" * 2000,
]
WORDS += [b"a." * 2000, b"=", b"#", b"\x1b[2J", "\u2028".encode(), b"cumulative", b"1\n" * 3000]


@st.composite
def mutated(draw: st.DrawFn, originals: list[bytes], pieces: list[bytes]) -> bytes:
    """One of some files, with pieces of it changed, cut out, repeated or replaced."""
    data = draw(st.sampled_from(originals))
    for _ in range(draw(st.integers(1, 4))):
        a = draw(st.integers(0, max(len(data) - 1, 0)))
        b = min(a + draw(st.integers(0, 24)), len(data))
        kind = draw(st.sampled_from(["bytes", "piece", "over", "cut", "repeat", "end"]))
        if kind == "bytes":
            middle = draw(st.binary(min_size=1, max_size=4))
            data = data[:a] + middle + data[a + len(middle) :]
        elif kind == "piece":
            data = data[:a] + draw(st.sampled_from(pieces)) + data[b:]
        elif kind == "over":  # sizes are at multiples of 4 in most formats
            a, piece = a // 4 * 4, draw(st.sampled_from(pieces))
            data = data[:a] + piece + data[a + len(piece) :]
        elif kind == "cut":
            data = data[:a] + data[b:]
        elif kind == "repeat":
            data = data[:a] + data[a:b] * draw(st.sampled_from([2, 3, 500])) + data[b:]
        else:
            data = data[:a]
    return data


def packed_mat(data: bytes) -> bytes:
    """A file whose elements behind the header are compressed as one."""
    body = zlib.compress(data[128:])
    return data[:128] + struct.pack("<II", 15, len(body)) + body


def zipped(data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("car.npy", data)
    return file.getvalue()


@dataclass(frozen=True)
class Kind:
    """Files of one kind: valid ones, what is put in their place, and how they are converted."""

    place: str
    originals: list[bytes]
    pieces: list[bytes] = field(default_factory=lambda: WORDS)
    made: Callable[[bytes], bytes] = bytes
    results: str = "results"
    time: str = "constant:20ms"


NUMPY = [*EXTREMES, b"<i8", b"|O", b"True", b"(" * 300, b"9" * 30]
KINDS = {
    "mat": Kind("results/car.mat", MATS, EXTREMES, time="measured"),
    "packed": Kind("results/car.mat", [MATS[0], MATS[2]], EXTREMES, packed_mat, time="measured"),
    "npz": Kind("MY.npz", NPYS, NUMPY, zipped, results="MY.npz"),
    "zip": Kind("MY.npz", [zipped(data) for data in NPYS], EXTREMES, results="MY.npz"),
    "json": Kind("results/car.json", JSONS, [*WORDS, b"{", b"}", b"]", b"null"], time="measured"),
    "pickle": Kind("results/car.pkl", PICKLES, OPCODES, time="measured"),
    "boxes": Kind("results/car.txt", [text_of(BOXES, separator) for separator in ",\t "]),
    "times": Kind("results/car_time.txt", TIMES, time="measured"),
    "truth": Kind("D/car.txt", [text_of(BOXES), text_of(BOXES, " ")]),
    "rates": Kind("fps.csv", [CSV], time="mean-fps:fps.csv"),
    "attributes": Kind("D/attributes.csv", [b"sequence,Occlusion,Fast motion\ncar,1,0\n"]),
}


@contextmanager
def little_memory() -> Iterator[None]:
    """Whatever is decoded takes little memory, refused or not."""
    unit = 1 if sys.platform == "darwin" else 1024

    def peak() -> int:
        return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit

    before = peak()
    with max_decoded(MOST_DECODED):
        yield
    assert peak() - before < MOST_TAKEN


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For each kind a dataset ``D`` of one sequence and, where they are text, results."""
    root = tmp_path_factory.mktemp("hostile")
    for name, kind in KINDS.items():
        for folder in ("D", "results"):
            (root / name / folder).mkdir(parents=True)
        (root / name / "D" / "car.txt").write_bytes(text_of(BOXES))
        if kind.place.endswith(("txt", "csv")):
            (root / name / "results" / "car.txt").write_bytes(text_of(BOXES))
    convert(root / "boxes", KINDS["boxes"], text_of(BOXES), None)  # imports what it needs
    return root


def convert(folder: Path, kind: Kind, content: bytes, unit: str | None) -> None:
    """Convert results where one file has this content."""
    (folder / kind.place).write_bytes(content)
    convert_results(
        folder / kind.results,
        folder / "D",
        time=kind.time.replace("fps.csv", str(folder / "fps.csv")),
        time_unit=unit,
        tracker="MY",
    )


@pytest.mark.parametrize("name", KINDS)
@given(data=st.data(), unit=st.sampled_from([None, *UNITS]))
def test_damaged_files_are_traces_or_errors(
    world: Path, name: str, data: st.DataObject, unit: str | None
) -> None:
    kind = KINDS[name]
    content = kind.made(data.draw(mutated(kind.originals, kind.pieces)))
    message = ""
    with little_memory():
        try:
            convert(world / name, kind, content, unit if name == "times" else None)
        except LaeError as error:
            message = str(error)
    assert not message or str(world / name) in message or "car" in message  # the file or sequence
    assert len(message) < 1000


@pytest.mark.parametrize("name", KINDS)
def test_the_files_that_are_damaged_are_valid(world: Path, name: str) -> None:
    for original in KINDS[name].originals:
        convert(world / name, KINDS[name], KINDS[name].made(original), None)


@given(mutated([STUDY], WORDS))
def test_damaged_studies_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "study.toml"
    path.write_bytes(content)
    with suppress(LaeError), little_memory():
        read_study(path)
