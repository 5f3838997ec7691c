import contextlib
import io
import json
import os
import struct
import subprocess
import sys
import zipfile
import zlib
from fractions import Fraction

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError
from lae_sim.importers.pickles import load_plain
from lae_sim.importers.results import Source, find_results, read_results

BOXES = np.array([[1, 2, 3, 4], [5, 6, 7.5, 8]])
TEXT = {"got10k": "1,2,3,4\n5,6,7.5,8\n", "pytracking": "1\t2\t3\t4\n5\t6\t7.5\t8\n"}
TIMES = "0.1\n0.026255\n"


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def read_mat(path):
    return read_results("mat", Source("a", path), 1, None, measured=True)


def read(root, **settings):
    settings = {"wanted": "auto", "repetition": 1, "unit": None, "measured": True, **settings}
    kind, sources = find_results(root, settings["wanted"], settings["repetition"])
    arguments = (settings["repetition"], settings["unit"], settings["measured"])
    return kind, {s.name: read_results(kind, s, *arguments) for s in sources}


@pytest.mark.parametrize("kind", TEXT)
@pytest.mark.parametrize("times", ["{}_time.txt", "times/{}_time.txt"])
def test_text_with_times(tmp_path, kind, times):
    for name in ("b", "a"):
        write(tmp_path / f"{name}.txt", TEXT[kind])
        write(tmp_path / times.format(name), TIMES)
    write(tmp_path / "a_all_boxes.txt", "1 2 3\n")
    write(tmp_path / "._a.txt", "\0\5\x16")  # as macOS leaves them on other disks
    found, results = read(tmp_path)
    assert found == kind
    assert list(results) == ["a", "b"]
    np.testing.assert_array_equal(results["a"].boxes, BOXES)
    assert results["a"].elapsed_ns.tolist() == [100_000_000, 26_255_000]
    assert read(tmp_path, measured=False)[1]["a"].elapsed_ns is None
    assert read(tmp_path, wanted="ope")[1]["a"].elapsed_ns is None


def test_got10k_folders_and_repetitions(tmp_path):
    for run in (1, 2):
        write(tmp_path / "seq" / f"seq_00{run}.txt", f"{run},2,3,4\n5,6,7,8\n")
    write(tmp_path / "seq" / "seq_time.txt", "0.1,0.3\n0.2,0.4\n")
    for run, times in ((1, [0.1, 0.2]), (2, [0.3, 0.4])):
        kind, results = read(tmp_path, repetition=run)
        assert kind == "got10k"
        assert results["seq"].boxes[0, 0] == run
        assert results["seq"].elapsed_ns.tolist() == [round(time * 1e9) for time in times]
    with pytest.raises(LaeError, match="no results found"):
        read(tmp_path, repetition=3)


def test_one_file(tmp_path):
    write(tmp_path / "a.txt", TEXT["got10k"])
    write(tmp_path / "b.txt", TEXT["got10k"])
    write(tmp_path / "times" / "a_time.txt", TIMES)
    kind, results = read(tmp_path / "a.txt")
    assert (kind, list(results)) == ("got10k", ["a"])
    assert len(results["a"].elapsed_ns) == 2


@pytest.mark.parametrize("separator", [",", "\t", " "])
def test_ope(tmp_path, separator):
    write(tmp_path / "a.txt", TEXT["got10k"].replace(",", separator))
    kind, results = read(tmp_path)
    assert (kind, results["a"].elapsed_ns) == ("ope", None)
    np.testing.assert_array_equal(results["a"].boxes, BOXES)


def test_npz(tmp_path):
    np.savez(tmp_path / "KCF.npz", b=BOXES.astype(np.float32), a=BOXES)
    kind, results = read(tmp_path / "KCF.npz")
    assert (kind, list(results)) == ("npz", ["a", "b"])
    assert results["b"].boxes.dtype == np.float64
    np.testing.assert_array_equal(results["b"].boxes, BOXES)


@pytest.mark.parametrize(
    ("array", "problem"),
    [
        (np.zeros(4), "must be a table of numbers"),
        (np.zeros((2, 5)), "5 columns; boxes have 4"),
        (np.array([["1", "2", "3", "4"]]), "must be a table of numbers"),
        (np.array([[1, 2, 3, 4], [1, 2, np.nan, 4]]), "row 2 is not finite"),
        (np.array([[None] * 4]), "cannot be read"),
    ],
)
def test_npz_faults(tmp_path, array, problem):
    np.savez(tmp_path / "KCF.npz", a=array)
    with pytest.raises(LaeError, match=problem):
        read(tmp_path / "KCF.npz")


def write_npz(path, kind, shape, data=b""):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", header.getvalue() + data)


def test_npz_bombs_and_damage(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"PK no zip")
    with pytest.raises(LaeError, match=r"not a readable \.npz"):
        read(path)
    write_npz(path, "<f8", (1 << 34, 4))
    with pytest.raises(LaeError, match=r"a\.npz: would take more than 256 MiB"):
        read(path)
    for kind, shape in (("|i1", (250_000, 4)), ("<f8", (250_000, 4)), ("<f8", (2**62, 2**62))):
        write_npz(path, kind, shape, bytes(1_000_000))
        with max_decoded("4MiB"), pytest.raises(LaeError, match=r"a\.npz: would take more than 4"):
            read(path)
    write_npz(path, "<f8", (-1, 4), bytes(32))
    with pytest.raises(LaeError, match=r"a\.npz: array 'a' cannot be read"):
        read(path)


@pytest.mark.parametrize(
    "content",
    [
        {"res": BOXES, "fps": 20.5},
        {"results": {"res": BOXES, "fps": 20.5, "type": "rect", "len": 2, "annoBegin": 1}},
        {"results": np.array([{"res": BOXES, "fps": 20.5, "type": "rect"}], dtype=object)},
    ],
)
@pytest.mark.parametrize("compressed", [False, True])
def test_mat(tmp_path, content, compressed):
    path = tmp_path / "Basketball_KCF.mat"
    scipy.io.savemat(path, content, do_compression=compressed)
    results = read_mat(path)
    np.testing.assert_array_equal(results.boxes, BOXES)
    assert results.mean_fps == Fraction(41, 2)
    kind, found = read(tmp_path)
    assert (kind, list(found)) == ("mat", ["Basketball_KCF"])


@pytest.mark.parametrize("fps", [np.nan, 0, -1, "fast", np.array([1.0, 2])])
def test_mat_without_a_rate(tmp_path, fps):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"res": BOXES, "fps": fps})
    assert read_mat(path).mean_fps is None
    scipy.io.savemat(path, {"res": BOXES[:1]})
    assert read_mat(path).boxes.tolist() == [[1, 2, 3, 4]]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"mine": BOXES}, "no field 'res'"),
        ({"results": 3.0}, "no field 'res'"),
        ({"res": BOXES[:, :3]}, "3 columns"),
        ({"res": BOXES * 1j}, "table of numbers"),
        ({"res": "text"}, "table of numbers"),
        ({"res": np.array([[1, 2, 3, np.nan]])}, "row 1 is not finite"),
        ({"results": {"res": BOXES, "len": 3}}, "field 'len' is 3, and 'res' has 2 rows"),
        ({"results": {"res": BOXES, "type": "polar"}}, "type 'polar'; known are rect, ivtaff"),
        ({"results": {"res": BOXES, "type": 4}}, r"boxes of type array\("),
        ({"mine": BOXES, "fps": 3}, "no field 'res' .*; there is mine, fps"),
        ({"res": BOXES * np.nan}, "no box at all"),
        ({"results": np.array([{"res": BOXES}] * 3, dtype=object)}, "holds 3 runs"),
        ({"results": np.empty((0, 0))}, "no field 'res'"),
    ],
)
def test_mat_faults(tmp_path, content, problem):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, content)
    with pytest.raises(LaeError, match=problem):
        read_mat(path)


def test_damaged_mat(tmp_path):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"results": {"res": BOXES, "fps": 20.5, "type": "rect"}})
    data = path.read_bytes()
    for end in range(0, len(data), 16):
        path.write_bytes(data[:end])
        with pytest.raises(LaeError):
            read_mat(path)


HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM"


def element(kind, data):
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def packed(data):
    return struct.pack("<II", 15, len(data)) + data


def nested(levels):
    """Cells in cells; loadmat of SciPy overflows the C stack at some 10,000."""
    head = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<ii", 1, 1))
    head += element(1, b"")
    data = struct.pack("<II", 14, 0)
    for _ in range(levels):
        data = struct.pack("<II", 14, len(head) + len(data)) + head + data
    return data


@pytest.mark.parametrize("pack", [bytes, lambda data: packed(zlib.compress(data))])
def test_nested_mat(tmp_path, pack):
    path = tmp_path / "a.mat"
    path.write_bytes(HEADER + pack(nested(3)))
    with pytest.raises(LaeError, match="no field 'res'"):
        read_mat(path)
    path.write_bytes(HEADER + pack(nested(2000)))
    with pytest.raises(LaeError, match="nested too deeply"):
        read_mat(path)


def array(kind, shape, *parts):
    """A data element: an array of the class ``kind``, called ``res``."""
    head = element(6, struct.pack("<II", kind, 0))
    head += element(5, struct.pack(f"<{len(shape)}i", *shape)) + element(1, b"res")
    return element(14, head + b"".join(parts))


COUNT = 100_000
EMPTY = element(14, b"") * COUNT
BOMBS = {
    "zeros": array(6, (COUNT, 80), element(9, bytes(COUNT * 80 * 8))),
    "bytes that become floats": array(6, (COUNT, 8), element(2, bytes(COUNT * 8))),
    "a text": array(4, (1, 9 * COUNT), element(16, bytes(9 * COUNT))),
    "cells": array(1, (1, COUNT), EMPTY),
    "structs": array(2, (1, COUNT), element(5, struct.pack("<i", 2)), element(1, b"a\0"), EMPTY),
    "fields": array(2, (1, 1), element(5, struct.pack("<i", 2)), element(1, b"a\0" * COUNT), EMPTY),
    "variables": [array(6, (COUNT, 1), element(2, bytes(COUNT)))] * 6,
}


@pytest.mark.parametrize("name", BOMBS)
def test_mat_bombs(tmp_path, name):
    path = tmp_path / "a.mat"
    variables = BOMBS[name] if isinstance(BOMBS[name], list) else [BOMBS[name]]
    path.write_bytes(HEADER + b"".join(packed(zlib.compress(each, 9)) for each in variables))
    assert path.stat().st_size < 70_000
    with max_decoded("4MiB"), pytest.raises(LaeError, match=r"a\.mat: would take more than 4 MiB"):
        read_mat(path)


def test_a_mat_file_of_a_usual_size_is_within_the_least_budget(tmp_path):
    path = tmp_path / "a.mat"
    run = {"res": np.tile(BOXES, (5000, 1)), "fps": 20.5, "type": "rect", "len": 10_000}
    scipy.io.savemat(path, {"results": np.array([run], dtype=object)}, do_compression=True)
    with max_decoded("1MiB"):
        assert len(read_mat(path).boxes) == 10_000


def test_a_mat_bomb_takes_no_memory(tmp_path):
    path = tmp_path / "a.mat"
    count = 2_000_000
    cells = array(1, (1, count), element(14, b"") * count)
    path.write_bytes(HEADER + packed(zlib.compress(cells, 9)))
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from lae_sim.importers.matlab import load_matlab\n"
        "from lae_sim.errors import LaeError\n"
        "from lae_sim.decoding import max_decoded\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10\n"
        "before = peak()\n"
        "try:\n"
        "    with max_decoded('32MiB'): load_matlab(Path(sys.argv[1]))\n"
        "except LaeError: print(peak() - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, check=True)
    assert int(done.stdout) < 48  # 400 MiB when read in full


@given(st.data())
def test_changed_mat_bytes_are_values_or_errors(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "changed.mat"
    run = {"res": BOXES, "fps": 20.5, "type": "rect", "tracker": ["a", 1]}
    scipy.io.savemat(path, {"results": np.array([run], dtype=object)})
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    with contextlib.suppress(LaeError):
        read_mat(path)


def big_endian_mat():
    """A struct as a big-endian machine writes it, with small elements and packed numbers."""

    def tagged(kind, data):
        if len(data) <= 4:
            return struct.pack(">I", len(data) << 16 | kind) + data.ljust(4, b"\0")
        return struct.pack(">II", kind, len(data)) + data + bytes(-len(data) % 8)

    def matrix(kind, shape, name, *parts):
        flags, sizes = struct.pack(">II", kind, 0), struct.pack(">ii", *shape)
        return tagged(14, tagged(6, flags) + tagged(5, sizes) + tagged(1, name) + b"".join(parts))

    res = matrix(6, (1, 4), b"", tagged(2, bytes([1, 2, 3, 4])))
    fps = matrix(6, (1, 1), b"", tagged(3, struct.pack(">h", 300)))
    names = tagged(5, struct.pack(">i", 4)) + tagged(1, b"res\0fps\0")
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x100) + b"MI"
    return header + matrix(2, (1, 1), b"results", names, res, fps)


def test_big_endian_mat(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(big_endian_mat())
    expected = scipy.io.loadmat(path, simplify_cells=True)["results"]
    results = read_mat(path)
    assert results.boxes.tolist() == [expected["res"].tolist()] == [[1, 2, 3, 4]]
    assert results.mean_fps == expected["fps"] == 300


def text(root, *lines):
    write(root / "a.txt", "\n".join(lines) + "\n")
    return read(root)[1]["a"].boxes.tolist()


@pytest.mark.parametrize("none", ["NaN,NaN,NaN,NaN", "nan,-nan,+NAN,-nan(ind)", "0", "nan"])
def test_rows_without_a_box(tmp_path, none):
    boxes = text(tmp_path, "1,2,3,4", none, "5,6,7.5,8", none)
    assert [boxes[0], boxes[2]] == BOXES.tolist()
    assert np.isnan([boxes[1], boxes[3]]).all()


def test_a_first_row_of_1_is_where_vots_unsupervised_runs_start(tmp_path):
    boxes = text(tmp_path, "1", "1,2,3,4", "0", "5,6,7.5,8")
    assert [boxes[1], boxes[3]] == BOXES.tolist()
    assert np.isnan([boxes[0], boxes[2]]).all()


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        (["1,2,3,4", "1,nan,3,4"], "the box in row 2 is not finite; where the tracker has none"),
        (["1,2,3,4", "1,2,inf,4"], "line 2: 'inf' is not a number"),
        (["1,2,3,4", "inf,inf,inf,inf"], "line 2: 'inf' is not a number"),
        (["1,2,3,4", "", "1,2,3,4"], "line 2: empty line; every frame needs its row"),
        (["nan,nan,nan,nan"] * 3, "holds no box at all"),
        (["0"] * 3, "columns; boxes have 4|holds no box at all"),
        (["1", "1,2,3,4", "2", "0", "0", "1", "5,6,7,8"], "VOT's supervised results .*unsupervi"),
        (["1,2,3,4", "1", "5,6,7,8", "1"], "VOT's supervised results"),
        (["1", "m0,0,10,10,3,4,5", "m0,0,10,10,3,4,5"], "masks of VOT; boxes are needed"),
        (["1", "1,2,3,4,5,6,7,8", "1,2,3,4,5,6,7,9"], "polygons of four corners; write x,y,w,h"),
        (["1,2,3,4,5,6,7,8"] * 2, "polygons of four corners"),
        (["1,1,10,20,30,40,0.9,-1,-1,-1"] * 2, "MOT's format"),
        (["0 0.5 0.5 0.1 0.2"] * 2, "YOLO's format"),
        (["x,y,w,h", "1,2,3,4"], "line 1: 'x' is not a number; the line looks like a header"),
        (["<!DOCTYPE html>", "<title>Sign in</title>"], "a web page, as a failed download"),
        (["version https://git-lfs.github.com/spec/v1", "oid sha256:0", "size 9"], "git lfs pull"),
        (['{"images": [], "file_name": 1}'], "COCO's JSON"),
    ],
)  # fmt: skip
def test_text_that_is_no_boxes_is_named(tmp_path, lines, problem):
    with pytest.raises(LaeError, match=rf"a\.txt.*({problem})"):
        text(tmp_path, *lines)


def read_first(root):
    kind, sources = find_results(root)
    if kind == "lae-pvt":
        return load_plain(sources[0].path)
    return read_results(kind, sources[0], 1, None, measured=True)


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.mat", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        ("a.mat", b"<html><body>Sign in</body></html>", "web page"),
        ("a.mat", b"MATLAB 5.0 MAT-file and no more", "not a MATLAB file of version 5 to 7.3"),
        ("a.npz", b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ("a.pkl", b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ("a.json", b'[{"image_id": 1, "bbox": [1, 2, 3, 4], "score": 1}]', "COCO's JSON"),
        ("a.json", b'{"AUC": 0.5}', "no field 'res' .*; there is AUC"),
        ("a.zip", b"PK\x03\x04", r"a\.zip looks like an archive \(zip\); unpack it"),
        ("a.tar.gz", b"\x1f\x8b\x08", r"a\.tar\.gz looks like a compressed file; unpack it"),
        ("a.npy", b"\x93NUMPY\1\0", "a file of NumPy"),
        ("a.xml", b"<?xml version='1.0'?>", "looks like XML"),
        ("a.csv", b"x,y,w,h\n1,2,3,4\n", r"is a\.csv a table\? Name it <seq>\.txt"),
        ("a.md", b"# Results\n", "give the folder of one tracker$"),
    ],
)
@pytest.mark.parametrize("directly", [False, True])
def test_files_of_other_formats_are_named(tmp_path, name, content, problem, directly):
    path = tmp_path / "results" / name
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(LaeError, match=problem):
        read_first(path if directly else path.parent)


def test_json_results_and_json_beside_others(tmp_path):
    run = [{"evalType": "OPE", "resType": "rect", "fps": 20, "res": BOXES.tolist()}]
    write(tmp_path / "a.json", json.dumps(run))
    kind, results = read(tmp_path)
    assert (kind, results["a"].mean_fps) == ("json", 20)
    np.testing.assert_array_equal(results["a"].boxes, BOXES)
    write(tmp_path / "b.txt", TEXT["got10k"])
    assert read(tmp_path)[0] == "ope"
    assert list(read(tmp_path, wanted="json")[1]) == ["a"]


def test_a_folder_of_trackers_folders(tmp_path):
    write(tmp_path / "KCF" / "a.txt", TEXT["got10k"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(LaeError, match=r"give the folder of one tracker, such as .*KCF"):
        find_results(tmp_path)


def test_nothing_and_too_much(tmp_path):
    with pytest.raises(LaeError, match="no such file or folder"):
        find_results(tmp_path / "none")
    with pytest.raises(LaeError, match="no results found; looked for"):
        find_results(tmp_path)
    write(tmp_path / "a.txt", TEXT["got10k"])
    scipy.io.savemat(tmp_path / "a.mat", {"res": BOXES})
    with pytest.raises(LaeError, match="holds mat and text results"):
        find_results(tmp_path)
    assert find_results(tmp_path, "mat")[0] == "mat"
    with pytest.raises(LaeError, match="of format lae-pvt"):
        find_results(tmp_path, "lae-pvt")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no such pipes")
@pytest.mark.parametrize("suffix", [".txt", ".mat", ".npz", ".json", ".pkl", ""])
def test_pipes_are_refused_at_once(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    os.mkfifo(path)
    with pytest.raises(LaeError, match="a pipe, not a file"):
        find_results(path)
