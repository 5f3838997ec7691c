import contextlib
import os
import pickle
import pickletools
import struct
import subprocess
import sys
from collections import OrderedDict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError
from lae_sim.importers.pickles import load_plain


@pytest.fixture
def loaded(tmp_path):
    def load(data):
        path = tmp_path / "results.pkl"
        path.write_bytes(data)
        return load_plain(path)

    return load


def refused(loaded, data, problem):
    with pytest.raises(LaeError, match=problem) as caught:
        loaded(data)
    assert "results.pkl" in str(caught.value)
    assert len(str(caught.value)) < 600


VALUES = {
    "results_raw": [(1, 2.5, 3, 4), [5, 6, 7, 8], np.array([1.5, 2, 3, 4])],
    "timestamps": [0.1, np.float64(0.2), np.float32(0.5)],
    "input_fidx": np.arange(3),
    "scores": [None, True, "text", b"bytes", b"", -7, 2**70],
    "matrix": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
    "big endian": np.arange(3, dtype=">i4"),
    "empty": np.empty((0, 4)),
    3: {"inner": [[], (), {}]},
}


def same(a, b):
    if isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray)
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert type(a) is type(b)
        assert len(a) == len(b)
        for one, other in zip(a, b):
            same(one, other)
    else:
        assert a == b
        assert not isinstance(b, np.generic)


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("core", ["numpy.core", "numpy._core"])
def test_plain_values(loaded, protocol, core):
    data = pickle.dumps(VALUES, protocol)
    # the module's name in the pickles of NumPy 1 and 2, with its length before it where it has one
    for old in ("numpy.core", "numpy._core"):
        for module in ("multiarray", "numeric"):
            a, b = f"{old}.{module}".encode(), f"{core}.{module}".encode()
            data = data.replace(b"\x8c" + bytes([len(a)]) + a, b"\x8c" + bytes([len(b)]) + b)
            data = data.replace(b"c" + a + b"\n", b"c" + b + b"\n")
    if protocol >= 4:  # the length of the frame has changed, and a pickle needs no frame
        data = data[:2] + data[11:]
    same(VALUES, loaded(data))


@given(
    hnp.arrays(
        hnp.integer_dtypes() | hnp.unsigned_integer_dtypes() | hnp.floating_dtypes(),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
        elements={"allow_nan": False},
    ),
    st.integers(0, 5),
)
def test_any_numeric_array(tmp_path_factory, array, protocol):
    path = tmp_path_factory.getbasetemp() / "array.pkl"
    path.write_bytes(pickle.dumps([array], protocol))
    if array.dtype.itemsize > 8:  # extended precision is another number on another machine
        with pytest.raises(LaeError, match="dtype 'f16'"):
            load_plain(path)
    else:
        same([array], load_plain(path))


def test_python_2_pickle(loaded):
    # protocol 2 as Python 2 and NumPy 1.16 wrote it: data and dtype codes are byte strings
    data = (
        b"\x80\x02}q\x01(U\x05valueq\x02cnumpy.core.multiarray\n_reconstruct\nq\x03cnumpy\nndarray\n"
        b"q\x04K\x00\x85U\x01b\x87Rq\x05(K\x01K\x02\x85cnumpy\ndtype\nq\x06U\x02f8K\x00K\x01\x87Rq\x07"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10"
        + struct.pack("<dd", 1.5, -2)
        + b"tbu."
    )
    same({"value": np.array([1.5, -2])}, loaded(data))


class Reduced:
    def __init__(self, *how):
        self.how = how

    def __reduce__(self):
        return self.how


@pytest.mark.parametrize("protocol", range(6))
def test_nothing_runs(loaded, tmp_path, protocol):
    marker = tmp_path / "marker"
    refused(loaded, pickle.dumps(Reduced(os.system, (f"touch {marker}",)), protocol), "system")
    assert not marker.exists()


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize(
    ("call", "arguments", "name"),
    [
        (eval, ("1",), "eval"),
        (exec, ("pass",), "exec"),
        (getattr, (1, "real"), "getattr"),
        (subprocess.Popen, (["true"],), "Popen"),
        (np.load, ("file",), "load"),
        (OrderedDict, (), "collections.OrderedDict"),
        (set, ([1],), "set"),
        (complex, (1, 2), "complex"),
        (bytearray, (10,), "bytearray"),
    ],
)
def test_calls_are_refused_by_name(loaded, protocol, call, arguments, name):
    refused(loaded, pickle.dumps(Reduced(call, arguments), protocol), rf"refuses [\w.]*{name}")


def test_hand_written_programs(loaded):
    refused(loaded, b"cos\nsystem\n(S'true'\ntR.", "refuses os.system")
    refused(loaded, b"(S'true'\nios\nsystem\n.", "refuses os.system")
    refused(loaded, b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93\x8c\x011\x85R.", "builtins.eval")
    refused(loaded, b"\x80\x04\x8c\x05numpy\x8c\x0ecore.os.system\x93.", "numpy.core.os.system")
    refused(loaded, b"Pother file\n.", "PERSID")
    refused(loaded, b"\x80\x02\x82\x01.", "EXT1")
    refused(loaded, b"c\xc3\xa9\x1b[31m\nx\n.", r"not a readable|refuses")


@pytest.mark.parametrize(
    "value",
    [
        np.array([1, "a", None], dtype=object),
        np.array(["text"]),
        np.array([b"bytes"]),
        np.array([1j]),
        np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f8")]),
        np.array(["2020-01-01"], dtype="datetime64[D]"),
        np.datetime64("2020-01-01"),
        np.longdouble(1),
        {1.5: 2},
        {(1, 2): 3},
        {1, 2},
        frozenset([1]),
        1j,
        int,
        len,
        np.ndarray,
        np.dtype("f8"),
    ],
    ids=repr,
)
@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_other_types_are_refused(loaded, value, protocol):
    refused(loaded, pickle.dumps([value], protocol), "refuses|not a readable")


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n"
DTYPE = b"cnumpy\ndtype\n(S'f8'\ntR"


@pytest.mark.parametrize(
    "data",
    [
        ARRAY + b"(cnumpy\ndtype\n(I0\ntS'b'\ntR.",  # another type
        ARRAY + b"(cnumpy\nndarray\n(I0\ntS'b'\ntR.",  # no state
        ARRAY + b"(tR(I1\n(I9999999999\nt" + DTYPE + b"I00\nS''\ntb.",  # no type
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(I9999999999\nt" + DTYPE + b"I00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(I-1\nt" + DTYPE + b"I00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(S'a'\nt" + DTYPE + b"I00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\nN" + DTYPE + b"I00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(I0\ntcnumpy\ndtype\n(S'O'\ntRI00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(I0\ntcnumpy\ndtype\n(]tRI00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(I0\ntNI00\nS''\ntb.",
        ARRAY + b"(cnumpy\nndarray\ntR(I1\n(I1\nt" + DTYPE + b"I00\n]tb.",  # a list as data
        b"cnumpy.core.multiarray\nscalar\n(" + DTYPE + b"S'short'\ntR.",
        b"cnumpy.core.multiarray\nscalar\n(tR.",
        b"cnumpy.core.numeric\n_frombuffer\n(S'x'\ntR.",
        b"c_codecs\nencode\n(S'x'\nS'utf-8'\ntR.",
        b"cbuiltins\nbytes\n(I999999999999\ntR.",
        ARRAY + b"}S'__code__'\nNsb.",  # state for the class itself
        ARRAY + b"(cnumpy\nndarray\n(I0\ntS'b'\ntRI1\na.",  # append to it
    ],
)
def test_hostile_arrays(loaded, data):
    refused(loaded, data, "results.pkl")


@pytest.mark.parametrize("protocol", range(6))
def test_truncated(loaded, protocol):
    data = pickle.dumps(VALUES, protocol)
    for end in range(0, len(data), 7):
        refused(loaded, data[:end], "not a readable pickle")


def test_nesting(loaded):
    refused(loaded, b"]" * 100_000 + b"a" * 99_999 + b".", "nested too deeply")
    refused(loaded, b"(" * 100_000 + b"t" * 100_000 + b".", "nested too deeply")
    cycle = []
    cycle.append(cycle)
    refused(loaded, pickle.dumps(cycle), "nested too deeply")


def test_many_references_are_decoded_once(loaded):
    value = [1, 2]
    for _ in range(25):
        value = [value, value]  # 2**26 numbers if written out
    found = loaded(pickle.dumps(value))
    assert found[0] is found[1]


@pytest.mark.parametrize(
    "data",
    [
        b"\x80\x04Nr\xff\xff\xff\x7f.",  # 2**31 places in the memo
        b"Np2000000000\n.",
        b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"x.",  # a bytearray of 1 TB
        b"\x80\x04\x8e" + struct.pack("<Q", 2**62) + b"x.",
        b"\x80\x04\x95" + struct.pack("<Q", 2**62) + b"N.",
        b"\x80\x02\x8b" + struct.pack("<i", 2**31 - 1) + b"x.",
        b"\x80\xffN.",
        b"",
        b"not a pickle at all",
        bytes(range(256)),
    ],
)
def test_declared_sizes(loaded, data):
    refused(loaded, data, "results.pkl")


@settings(max_examples=300)
@given(st.data())
def test_changed_bytes_are_values_or_errors(tmp_path_factory, data):
    content = bytearray(pickle.dumps(VALUES, data.draw(st.integers(0, 5))))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "changed.pkl"
    path.write_bytes(content)
    with contextlib.suppress(LaeError):
        load_plain(path)


def test_size_is_limited(tmp_path):
    path = tmp_path / "huge.pkl"
    with path.open("wb") as file:
        file.truncate((256 << 20) + 1)
    with pytest.raises(LaeError, match=r"huge\.pkl: would take more than 256 MiB of memory"):
        load_plain(path)
    lists = b"\x80\x02(" + b"]" * 20_000 + b"l."
    path.write_bytes(lists)
    with max_decoded("4MiB"):
        assert len(load_plain(path)) == 20_000
        for data in (lists.replace(b"(", b"(" + b"]" * 20_000), pickle.dumps("t" * 1_500_000)):
            path.write_bytes(data)
            with pytest.raises(LaeError, match="more than 4 MiB"):
                load_plain(path)
    with pytest.raises(LaeError, match="no such file"):
        load_plain(tmp_path / "none.pkl")


def test_nothing_is_imported(tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(b"cantigravity\nfly\n.")
    code = (
        "import sys; from pathlib import Path; from lae_sim.importers.pickles import load_plain\n"
        "try: load_plain(Path(sys.argv[1]))\n"
        "except Exception as error: print(error)\n"
        "assert 'antigravity' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    assert "refuses antigravity.fly" in done.stdout


def test_hostile_samples_are_what_they_claim():
    """The samples above must be real programs, or their refusal proves nothing."""
    assert [code.name for code, _, _ in pickletools.genops(b"cos\nsystem\n(S'true'\ntR.")] == [
        "GLOBAL",
        "MARK",
        "STRING",
        "TUPLE",
        "REDUCE",
        "STOP",
    ]
