"""Runs as the OTB toolkits store them: ``results`` of MATLAB, and the JSON of its Python version.

A run holds ``res``, the target in each frame, in the parameters of the tracker's own motion model,
which ``type`` (``resType`` in JSON) names. They become boxes by the rules of the toolkit,
tracker_benchmark_v1.0 of Wu, Lim and Yang (CVPR 2013): ``calcSeqErrRobust.m`` with
``calcRectCenter.m`` (ivtAff), ``calcCenter_L1.m`` and ``aff2image.m`` (L1Aff), ``getLKcorner.m``
(LK_Aff), ``parameters_to_projective_matrix.m`` (SIMILARITY) and ``corner2rect.m``. The names of
https://github.com/jwlim/tracker_benchmark (affine_ivt, affine_L1, affine_LK) mean the same.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.decoding import Budget, json_memory, read_bytes
from lae_sim.errors import LaeError, listed, shown

_OTHER_NAMES = ("results", "result", "bbox", "bboxes", "boxes", "rects")  # of a table of boxes


def load_json(path: Path) -> Any:
    """The values of a JSON file.

    Raises:
        LaeError: if it is damaged, or larger than any result (see
            :func:`lae_sim.decoding.max_decoded`).
    """
    data = read_bytes(path, Budget(path))
    Budget(path).take(json_memory(data))
    try:
        return json.loads(data, parse_int=float)
    except (ValueError, RecursionError) as error:
        raise LaeError(f"{path}: not readable JSON: {str(error)[:200]}") from error


def read_run(content: Any, where: str) -> tuple[Floats, Fraction | None]:
    """The run that a file holds: one pass over a sequence.

    Args:
        content: of the file: the run, or runs in a list or under ``results``; or, without ``res``,
            one table of boxes that is called ``results``, ``bbox`` or the like.
        where: the file, for messages.

    Returns:
        Boxes ``x, y, w, h`` in pixels, float64 [n, 4], NaN where the target is lost; and mean
        frames per second, if it says so.

    Raises:
        LaeError: if it is no run of one pass over the sequence, or a field is missing or damaged.
    """
    run = _one_pass(content, where)
    kind = run.get("type", run.get("resType", "rect"))
    to_boxes = _TO_BOXES.get(kind.casefold()) if isinstance(kind, str) else None
    if to_boxes is None:
        raise LaeError(
            f"{where}: boxes of type {shown(kind)}; known are {', '.join(_TO_BOXES)}: write x, y, "
            "w, h of each frame, and 'rect' as type"
        )
    try:
        with np.errstate(invalid="ignore"):
            boxes = to_boxes(_table(run["res"]), run.get("tmplsize"))
    except ValueError as error:
        raise LaeError(f"{where}: boxes of type {kind!r}: {error}") from error
    stated, fps = _scalar(run.get("len")), _scalar(run.get("fps"))
    if stated not in (None, len(boxes)):
        raise LaeError(f"{where}: field 'len' is {stated:g}, and 'res' has {len(boxes)} rows")
    if fps is None or not (math.isfinite(fps) and fps > 0):
        return boxes, None
    return boxes, Fraction(fps)


def _one_pass(content: Any, where: str) -> Mapping[str, Any]:
    """The run of one pass over the whole sequence (OPE)."""
    runs = content.get("results", content) if isinstance(content, Mapping) else content
    run_or_runs = isinstance(runs, list) or (isinstance(runs, Mapping) and "res" in runs)
    if isinstance(content, Mapping) and not run_or_runs:
        tables = [content[name] for name in _OTHER_NAMES if _is_boxes(content.get(name))]
        if len(tables) == 1:
            runs = {**content, "res": tables[0]}
    if not isinstance(runs, list):
        runs = [runs]
    for run in runs:
        if not isinstance(run, Mapping) or "res" not in run:
            fields = f"; there is {listed(run)}" if isinstance(run, dict) else ""
            raise LaeError(f"{where}: no field 'res' (boxes x, y, w, h){fields}")
    kinds = [run.get("evalType") for run in runs]
    others = sorted({str(kind)[:20] for kind in kinds if kind not in (None, "OPE")})
    if others or (len(runs) != 1 and kinds.count("OPE") < max(1, len(runs))):
        raise LaeError(
            f"{where}: holds {len(runs)} runs ({' and '.join(others) or 'SRE or TRE?'}), and one "
            "pass from the first frame's truth (OPE) is needed"
        )
    first: Mapping[str, Any] = runs[0]
    return first


def _is_boxes(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] == 4 < value.size


def _table(value: Any) -> Floats:
    """Rows of numbers, float64 [rows, columns]; NaN where JSON has null."""
    if isinstance(value, list):
        try:
            value = np.array(value, np.float64)
        except (TypeError, ValueError):
            value = None
    if not (isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.ndim == 2):
        raise ValueError("boxes must be a table of numbers")
    return value.astype(np.float64)


def _scalar(value: Any) -> float | None:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    return value if isinstance(value, float) else None


def _template(size: Any) -> tuple[float, float]:
    """The two sides of a template, as ``tmplsize`` lists them."""
    try:
        first, second = np.array(size, np.float64).ravel().tolist()
    except (TypeError, ValueError):
        first = second = math.nan
    if not (math.isfinite(first * second) and first > 0 < second):
        raise ValueError("needs the field 'tmplsize', two sides in pixels")
    return first, second


def _columns(table: Floats, count: int) -> None:
    if table.shape[1] != count:
        raise ValueError(f"{table.shape[1]} columns, not {count}")


def _pairs(table: Floats, count: int) -> Floats:
    """Two rows of each frame, float64 [n, 2, columns]."""
    _columns(table, count)
    if len(table) % 2:
        raise ValueError("an odd number of rows, not two of each frame")
    return table.reshape(-1, 2, count)


def _rounded(values: Floats) -> Floats:
    """Rounded as MATLAB does, halves away from zero."""
    rounded: Floats = np.copysign(np.floor(np.abs(values) + 0.5), values)
    return rounded


def _around(corners: Floats) -> Floats:
    """Boxes around corners, float64 [n, 2, 4] (x and y of each), which are pixels themselves."""
    least, most = corners.min(axis=2), corners.max(axis=2)
    return _rounded(np.hstack([least, most - least + 1]))


def _rect(table: Floats, size: Any) -> Floats:
    return table


def _ivt(table: Floats, size: Any) -> Floats:
    """Affine maps of a template about its centre: x, y, a11, a12, a21, a22."""
    _columns(table, 6)
    width, height = _template(size)
    x, y, a11, a12, a21, a22 = table.T
    across = (a11 * width + a12 * height) / 2
    down = (a21 * width + a22 * height) / 2
    least = np.floor(np.column_stack([x - across, y - down]))
    most = np.floor(np.column_stack([x + across, y + down]))
    return np.hstack([least, most - least])


def _l1(table: Floats, size: Any) -> Floats:
    """Affine maps of rows and columns of a template: a11, a12, a21, a22, row, column."""
    _columns(table, 6)
    rows, columns = _template(size)
    a11, a12, a21, a22, row, column = table.T
    first = _rounded(np.column_stack([a21 + a22 + column, a11 + a12 + row]))
    last = _rounded(
        np.column_stack([a21 * rows + a22 * columns + column, a11 * rows + a12 * columns + row])
    )
    return np.hstack([first, last - first + 1])


def _template_corners(size: Any) -> Floats:
    """Corners of a template of height and width, counted from 1, float64 [3, 4]."""
    height, width = _template(size)
    return np.array([[1, 1, width, width], [1, height, height, 1], [1, 1, 1, 1]])


def _lucas_kanade(table: Floats, size: Any) -> Floats:
    """Affine warps of a template, two rows of each frame, less the identity."""
    warps = _pairs(table, 3) + np.eye(2, 3)
    return _around(warps @ _template_corners(size))


def _similarity(table: Floats, size: Any) -> Floats:
    """Scale, angle and shift of a template."""
    _columns(table, 4)
    scale, angle, x, y = table.T
    across, along = scale * np.cos(angle), scale * np.sin(angle)
    warps = np.stack([np.stack([across, -along, x], 1), np.stack([along, across, y], 1)], 1)
    return _around(warps @ _template_corners(size))


def _corners(table: Floats, size: Any) -> Floats:
    """Corners: a row of x and one of y of each frame, or x, y of each corner in one row."""
    if table.shape[1] == 8:
        return _around(table.reshape(-1, 4, 2).transpose(0, 2, 1))
    return _around(_pairs(table, 4))


_TO_BOXES: dict[str, Callable[[Floats, Any], Floats]] = {
    "rect": _rect,
    "ivtaff": _ivt,
    "affine_ivt": _ivt,
    "l1aff": _l1,
    "affine_l1": _l1,
    "lk_aff": _lucas_kanade,
    "affine_lk": _lucas_kanade,
    "4corner": _corners,
    "affine": _corners,
    "similarity": _similarity,
}
