"""Runs of the OTB toolkits; the boxes that are right were computed by hand from its formulas."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lae_sim.decoding import max_decoded
from lae_sim.errors import LaeError
from lae_sim.importers.otb import load_json, read_run

SQUARE = np.array([[10, 50, 50, 10], [20, 20, 60, 60]], float)  # x and y of its corners


def boxes(kind: str, rows: Any, size: Any = None) -> list[list[float]]:
    return read_run({"res": rows, "type": kind, "tmplsize": size}, "f")[0].tolist()


def test_ivt_is_a_map_of_the_template_about_its_centre() -> None:
    # 32 x 32 px, stretched to 40 x 60 about (100.5, 200)
    rows = np.array([[100.5, 200, 1.25, 0, 0, 1.875]])
    for kind in ("ivtAff", "affine_ivt"):
        assert boxes(kind, rows, np.array([[32.0, 32.0]])) == [[80, 170, 40, 60]]
    # corners at -16, -16 and 16, 16: x = 50 -/+ (16 + .25 * 16), y = 60 -/+ (.5 * 16 + 2 * 16)
    sheared = np.array([[50, 60, 1, 0.25, 0.5, 2]])
    assert boxes("ivtAff", sheared, [32, 32]) == [[30, 20, 40, 80]]
    # width and height of the template are not the same
    assert boxes("ivtAff", [[50.0, 60.0, 1.0, 0.0, 0.0, 1.0]], [[20.0, 10.0]]) == [[40, 55, 20, 10]]


def test_l1_is_a_map_of_rows_and_columns() -> None:
    # rows and columns of a template of 10 x 15 (height, width), from 1; twice as high, shifted
    rows = np.array([[2, 0, 0, 1, 30, 40]])
    for kind in ("L1Aff", "affine_L1"):
        # row 2 * 1 + 30 to 2 * 10 + 30, column 1 + 40 to 15 + 40
        assert boxes(kind, rows, np.array([[10, 15]])) == [[41, 32, 15, 19]]


def test_a_warp_of_lucas_and_kanade_is_less_the_identity() -> None:
    rows = np.array([[0, 0, 30], [0, 1, 40]])  # y twice as high
    assert boxes("LK_Aff", rows, np.array([[10, 20]])) == [[31, 42, 20, 19]]


def test_a_similarity_is_scale_angle_and_shift() -> None:
    assert boxes("SIMILARITY", np.array([[2, 0, 30, 40]]), [[10, 20]]) == [[32, 42, 39, 19]]
    turned = np.array([[1, np.pi / 2, 100, 40]])  # x = 100 - y, y = 40 + x
    assert boxes("similarity", turned, [[10, 20]]) == [[90, 41, 10, 20]]


@pytest.mark.parametrize("kind", ["4corner", "affine"])
def test_corners(kind: str) -> None:
    # corners are pixels of the box; halves are rounded away from zero
    assert boxes(kind, np.vstack([SQUARE, SQUARE - 20.5])) == [[10, 20, 41, 41], [-11, -1, 41, 41]]
    assert boxes(kind, SQUARE.T.reshape(1, 8)) == [[10, 20, 41, 41]]


def test_a_row_of_nan_is_one_in_any_motion_model() -> None:
    rows = np.vstack([[50, 60, 1, 0, 0, 1], np.full(6, np.nan)])
    found = read_run({"res": rows, "type": "ivtAff", "tmplsize": [20, 10]}, "f")[0]
    assert found[0].tolist() == [40, 55, 20, 10]
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize(
    ("run", "problem"),
    [
        ({"res": np.ones((2, 6)), "type": "ivtAff"}, "needs the field 'tmplsize'"),
        ({"res": np.ones((2, 6)), "type": "ivtAff", "tmplsize": [32, 0]}, "'tmplsize'"),
        ({"res": np.ones((2, 6)), "type": "ivtAff", "tmplsize": [1, 2, 3]}, "'tmplsize'"),
        ({"res": np.ones((2, 4)), "type": "ivtAff", "tmplsize": [32, 32]}, "4 columns, not 6"),
        ({"res": np.ones((3, 4)), "type": "4corner"}, "odd number of rows"),
        ({"res": np.ones((2, 4)), "type": "AFFINE", "len": 2.0}, "'len' is 2, and 'res' has 1"),
        ({"res": np.ones((2, 6)), "type": "HOMOGRAPHY"}, "type 'HOMOGRAPHY'; known are rect, ivt"),
        ({"res": [[1, 2, 3], [4]], "fps": 3}, "must be a table of numbers"),
        ({"res": [["1", "x"]]}, "must be a table of numbers"),
        ({"res": {}}, "must be a table of numbers"),
        ({"boxes": [], "fps": 2}, "no field 'res' .*; there is boxes, fps"),
        ([], "holds 0 runs"),
        ("text", "no field 'res'"),
        ([{"res": [], "evalType": "SRE"}], r"holds 1 runs \(SRE\), and one pass"),
        ([{"res": []}, {"res": []}], r"holds 2 runs \(SRE or TRE\?\)"),
        ([{"res": [], "evalType": "OPE"}, {"res": [], "evalType": "TRE"}], "TRE"),
    ],
)
def test_what_is_no_pass(run: Any, problem: str) -> None:
    with pytest.raises(LaeError, match=f"^f: .*{problem}"):
        read_run(run, "f")


@pytest.mark.parametrize("name", ["results", "bbox", "boxes"])
def test_a_table_of_boxes_under_another_name(name: str) -> None:
    rows = np.array([[1.0, 2, 30, 40], [2, 2, 30, 40]])
    boxes, mean_fps = read_run({name: rows, "fps": 20.0, "anno": rows + 1}, "f")
    assert (boxes.tolist(), mean_fps) == (rows.tolist(), 20)
    with pytest.raises(LaeError, match="no field 'res'"):
        read_run({name: rows.T[:3], "anno": rows}, "f")
    with pytest.raises(LaeError, match="no field 'res'"):
        read_run({"results": rows, "bbox": rows}, "f")
    run = {"res": rows + 2, "fps": 20.0}
    boxes, _ = read_run({"results": run, "bbox": rows}, "f")
    assert boxes.tolist() == (rows + 2).tolist()


def test_json_of_the_python_toolkit(tmp_path: Path) -> None:
    path = tmp_path / "Boy.json"
    run = {"evalType": "OPE", "fps": 20, "resType": "rect", "res": [[1, 2, 3, 4], [None] * 4],
           "tmplsize": [0.0, 0.0], "shiftType": None}  # fmt: skip
    for content in (run, [run], [run, {**run, "res": [[5, 6, 7, 8]]}], {"results": [run]}):
        path.write_text(json.dumps(content))
        boxes, mean_fps = read_run(load_json(path), str(path))
        assert mean_fps == Fraction(20)
        np.testing.assert_array_equal(boxes, [[1, 2, 3, 4], [np.nan] * 4])


@pytest.mark.parametrize(
    "text", ["", "[", "[" * 100_000, "{'a': 1}", '{"a": "\\u00', "\xff\xfe", f"[{'1' * 5000}, nan]"]
)
def test_damaged_json(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(LaeError, match=r"a\.json: not readable JSON"):
        load_json(path)


def test_numbers_of_any_length_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{{"res": [[1, 2, 3, {"4" * 5000}]], "fps": {"1" * 5000}}}')
    boxes, mean_fps = read_run(load_json(path), "f")
    assert (boxes[0, 3], mean_fps) == (np.inf, None)


@pytest.mark.parametrize("text", ["[" + "[]," * 20_000 + "0]", '{"a": "%s"}' % ("x" * 600_000)])
def test_large_json_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    load_json(path)
    with max_decoded("1MiB"), pytest.raises(LaeError, match=r"a\.json: would take more than 1 MiB"):
        load_json(path)
