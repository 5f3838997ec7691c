import gzip
import json
import pickle
import zipfile

import cv2
import numpy as np
import pytest

from lae_sim.datasets.foreign import foreign
from lae_sim.datasets.numbers import read_numbers
from lae_sim.errors import LaeError

COCO = {"info": {}, "images": [{"id": 1, "file_name": "1.jpg"}], "annotations": []}
PYSOT = {"car": {"video_dir": "car", "init_rect": [1, 2, 3, 4], "img_names": [], "gt_rect": []}}


@pytest.mark.parametrize(
    ("content", "what", "remedy"),
    [
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n",
            "a pointer of Git LFS",
            "git lfs pull",
        ),
        (b"/annex/objects/SHA256E-s10--0.txt\n", "a pointer of git-annex", "git annex get"),
        (b"\n<!DOCTYPE html><html>quota exceeded</html>", "a web page", "download it again"),
        (b'\xef\xbb\xbf<?xml version="1.0"?><annotation/>', "XML", "x,y,w,h in pixels"),
        (json.dumps(COCO).encode(), "COCO's JSON", "x,y,w,h in pixels"),
        (json.dumps(PYSOT).encode(), "pysot's JSON", "x,y,w,h in pixels"),
        (b"[[1, 2, 3, 4]]", "JSON", "x,y,w,h in pixels"),
        (gzip.compress(b"1,2,3,4", mtime=0), "a compressed file", "unpack it"),
        (b"7z\xbc\xaf\x27\x1c", "an archive", "unpack it"),
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "a MATLAB file", "x,y,w,h in pixels"),
        (pickle.dumps([1]), "a file of NumPy or Python", "x,y,w,h in pixels"),
        (cv2.imencode(".png", np.zeros((9, 9), np.uint8))[1].tobytes(), "an image", "mask"),
        (cv2.imencode(".jpg", np.zeros((9, 9), np.uint8))[1].tobytes(), "an image", "mask"),
        (cv2.imencode(".bmp", np.zeros((9, 9), np.uint8))[1].tobytes(), "an image", "mask"),
        (b"\0\0\0\x20ftypisom", "a video", "x,y,w,h in pixels"),
        (b"m12,40,10,20,0,4,6,4\nm13,40,10,20,0,4\n", "masks of VOT", "x,y,w,h of what each mask"),
    ],
)
def test_other_formats_are_named(tmp_path, content, what, remedy):
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    with pytest.raises(LaeError) as caught:
        read_numbers(path)
    assert str(caught.value).startswith(f"{path}: looks like {what}")
    assert remedy in str(caught.value)


def test_archives(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("a.txt", "1,2,3,4")
    assert str(foreign((tmp_path / "a.zip").read_bytes())).startswith("looks like an archive (zip)")
    for name, what in (("[Content_Types].xml", "a spreadsheet"), ("car.npy", "a file of NumPy")):
        with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
            archive.writestr(name, "content")
        assert str(foreign((tmp_path / "b.zip").read_bytes())).startswith(f"looks like {what}")
    assert str(foreign(b"a.txt".ljust(257, b"\0") + b"ustar\0")).endswith("give the folder")


@pytest.mark.parametrize("text", ["1,2,3,4", "", "  \n1\t2", "nan nan", "-1", "x,y,w,h\n1,2,3,4"])
def test_what_may_be_a_table(text):
    assert foreign(text.encode()) is None
