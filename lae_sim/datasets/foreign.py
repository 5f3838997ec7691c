"""Files of other formats, named as what they look like, with what to do about them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lae_sim._arrays import Floats
from lae_sim.decoding import TooLargeError
from lae_sim.errors import LaeError
from lae_sim.files import check_regular

HEAD_BYTES = 1 << 16
"""Of a file, as many are enough for :func:`foreign`."""

_BOXES = "write a text file for each sequence, a line x,y,w,h in pixels for each frame"
_UNPACK = "unpack it, and give the folder"
_AGAIN = "download it again"
_FETCH = "the file itself was never fetched: run git lfs pull, or git annex get, in its folder"
_MASKS = "boxes are needed: write x,y,w,h of what each mask covers"


@dataclass(frozen=True)
class Foreign:
    """What a file looks like.

    Attributes:
        what: its format, such as ``"COCO's JSON"``.
        remedy: what to do with it.
    """

    what: str
    remedy: str

    def __str__(self) -> str:
        return f"looks like {self.what}; {self.remedy}"


# How a file of a format begins, after a byte order mark and blanks. The first that fits counts.
_BEGINNINGS = (
    (rb"version https://git-lfs\.github\.com/", "a pointer of Git LFS", _FETCH),
    (rb"/annex/objects/", "a pointer of git-annex", _FETCH),
    (rb"(?i)<!doctype html|<html|<head", "a web page, as a failed download leaves it", _AGAIN),
    (rb"(?i)<\?xml|<annotation", "XML (as of Pascal VOC or CVAT)", _BOXES),
    (rb"PK\x03\x04.{26}(?:\[Content_Types\]|_rels/|xl/|docProps/)", "a spreadsheet", _BOXES),
    (rb"PK\x03\x04.{26}mimetypeapplication/vnd\.oasis", "a spreadsheet", _BOXES),
    (rb"PK\x03\x04.{26}[^/]{1,200}\.npy", "a file of NumPy or Python", _BOXES),
    (rb"PK\x03\x04|PK\x05\x06", "an archive (zip)", _UNPACK),
    (rb"\x1f\x8b|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd", "a compressed file", _UNPACK),
    (rb"7z\xbc\xaf|Rar!", "an archive", _UNPACK),
    (rb"MATLAB 5\.0|\x89HDF\r\n", "a MATLAB file", _BOXES),
    (rb"\x93NUMPY|\x80[\x02-\x05]", "a file of NumPy or Python", _BOXES),
    (rb"PAR1", "Parquet", _BOXES),
    (rb"%PDF", "a PDF document", _BOXES),
    (rb"\x89PNG|\xff\xd8\xff|BM.{4}\0\0\0\0|GIF8|II\*\0|MM\0\*", "an image", _MASKS),
    (rb"RIFF.{4}WEBP", "an image", _MASKS),
    (rb"RIFF|.{4}ftyp|\x1a\x45\xdf\xa3", "a video", _BOXES),
    (rb"m-?[0-9]+(?:,-?[0-9]+){4}", "masks of VOT", _MASKS),
    (rb"\{\\rtf", "a rich text document", "save it as plain text"),
)
_JSON = "JSON"
_KINDS_OF_JSON = (
    ({"image_id", "bbox", "score"}, "COCO's JSON"),
    ({"images", "file_name"}, "COCO's JSON"),
    ({"annotations", "bbox"}, "COCO's JSON"),
    ({"shapes", "points"}, "LabelMe's JSON"),
    ({"video_dir", "init_rect"}, "pysot's JSON"),
    ({"exist", "gt_rect"}, "the JSON of an Anti-UAV dataset"),
)


def foreign(head: bytes) -> Foreign | None:
    """What a file is that is no table of numbers, by how it begins; None if it may be one.

    Args:
        head: its first bytes, :data:`HEAD_BYTES` or more.
    """
    if head[257:262] == b"ustar":
        return Foreign("an archive (tar)", _UNPACK)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, what, remedy in _BEGINNINGS:
        if re.match(pattern, text, re.DOTALL):
            return Foreign(what, remedy)
    if text[:1] in (b"{", b"["):
        keys = set(re.findall(r'"(\w{1,40})"\s*:', text.decode("utf-8", "replace")))
        kinds = (what for named, what in _KINDS_OF_JSON if keys >= named)
        return Foreign(next(kinds, _JSON), _BOXES)
    return None


def foreign_file(path: Path, *own: bytes) -> Foreign | None:
    """The same of a file; None of one that cannot be opened, or begins as its own format does."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return None
    return None if own and head.startswith(own) else foreign(head)


@contextmanager
def recognised(path: Path, *own: bytes) -> Iterator[None]:
    """Say what a file looks like that cannot be read as what it should be.

    Args:
        path: the file.
        own: how files of its format begin; such a one is damaged, and not another.

    Raises:
        LaeError: what the block raised, or, if the file is of another format, what to do with it.
    """
    check_regular(path)
    try:
        yield
    except TooLargeError:
        raise
    except LaeError as error:
        other = foreign_file(path, *own)
        if other is None or other.what == _JSON:
            raise
        raise LaeError(f"{path}: {other}") from error


def foreign_columns(table: Floats) -> Foreign | None:
    """What a table of numbers is that is no boxes ``x, y, w, h`` in pixels, by its columns.

    Args:
        table: float64 [rows, columns]; NaN = none.

    Returns:
        None if it may be boxes, or corners of boxes.
    """
    rows = table[np.isfinite(table).all(axis=1)]
    if not len(rows):
        return None
    columns = rows.shape[1]
    whole = np.all(np.rint(rows) == rows, axis=0)
    within_1 = np.all((rows >= 0) & (rows <= 1), axis=0)
    if columns == 4 and within_1.all() and ((rows[:, 2:] > 0) & (rows[:, 2:] < 1)).any():
        return Foreign("boxes in parts of the image", "multiply by its width and height in pixels")
    if columns in (5, 6) and whole[0] and within_1[1:5].all():
        what = "YOLO's format (class, centre and size in parts of the image)"
        return Foreign(what, _BOXES)
    if columns == 8 and whole[4:].all() and rows[:, 4:].max() < 16 <= rows[:, :4].max():
        what = "VisDrone's detections (x, y, w, h, score, category, truncation, occlusion)"
        return Foreign(what, _BOXES)
    if columns == 8 and whole.all() and rows[:, 1::2].max() < 10 <= rows[:, 0::2].max():
        return Foreign("x, y, w, h with decimal commas", "write decimal points")
    if 7 <= columns <= 10 and columns != 8 and whole[:2].all() and (np.diff(rows[:, 0]) >= 0).all():
        what = "MOT's format (frame, id, x, y, w, h, ...)"
        return Foreign(what, "keep x,y,w,h of one target, a line for each frame")
    return None
