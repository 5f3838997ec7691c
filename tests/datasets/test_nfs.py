from fractions import Fraction

import numpy as np
import pytest
from annotated import make

from lae_sim.datasets.annotations import find_truth, read_truth
from lae_sim.datasets.nfs import read_lost, read_vatic
from lae_sim.errors import LaeError


def vatic(boxes, first=0, **more):
    """Rows of VATIC of boxes x, y, w, h."""
    lost = more.get("lost", ())
    rows = [
        f'0 {x} {y} {x + w} {y + h} {first + k} {int(k in lost)} 0 1 "soccer ball"'
        for k, (x, y, w, h) in enumerate(boxes)
    ]
    return "\n".join(rows) + "\n"


WAY = [[10 + 3 * k, 20, 30, 40 + k] for k in range(17)]


def test_nfs_as_it_is_downloaded(tmp_path):
    files = [f"NfS/{name}/{rate}/{name}.txt" for name in ("ball", "bee_1") for rate in (30, 240)]
    root = make(tmp_path, *files, text=vatic(WAY)) / "NfS"
    with pytest.raises(LaeError, match=r"NfS at 30 and 240 frames per second: .*--fps 30 or"):
        find_truth(root)
    with pytest.raises(LaeError, match="NfS at 30 and 240 frames per second, not at 25"):
        find_truth(root, Fraction(25))
    for fps in (30, 240):
        truth = find_truth(root, Fraction(fps))
        assert (truth.dataset, list(truth.files), truth.fps) == ("NfS", ["ball", "bee_1"], fps)
        assert truth.files["ball"] == root / "ball" / str(fps) / "ball.txt"
    assert find_truth(root / "ball", Fraction(30)).dataset == "NfS"
    assert find_truth(root / "ball" / "240" / "ball.txt").fps == 240


def test_nfs_of_30_frames_per_second_is_every_eighth_row(tmp_path):
    root = make(tmp_path, "b/30/b.txt", "b/240/b.txt", text=vatic(WAY, first=1))
    slow, fast = root / "b" / "30" / "b.txt", root / "b" / "240" / "b.txt"
    assert read_truth(fast).tolist() == read_truth(fast, 17).tolist() == WAY
    assert read_truth(slow, 3).tolist() == [WAY[0], WAY[8], WAY[16]]
    assert read_truth(slow, 2).tolist() == [WAY[0], WAY[8]]  # the last image is missing
    one_more = read_truth(slow, 4)
    assert one_more[:3].tolist() == [WAY[0], WAY[8], WAY[16]]
    assert np.isnan(one_more[3]).all()
    make(tmp_path, "c/30/c.txt", text=vatic(WAY, lost=(8, 9)))
    assert read_lost(tmp_path / "c/30/c.txt", 4).tolist() == [False, True, False, False]
    assert read_lost(make(tmp_path, "d.txt") / "d.txt", 2) is None
    with pytest.raises(LaeError, match="is of 240 too: --fps 240"):
        read_truth(slow, 17)
    make(tmp_path, "b/30/b.txt", text=vatic(WAY[::8]))  # as somebody thinned it out
    assert read_truth(slow, 3).tolist() == [WAY[0], WAY[8], WAY[16]]


def test_vatic(tmp_path):
    text = vatic(WAY[:5], lost=(1, 2))
    boxes, lost = read_vatic(tmp_path / "a.txt", text.splitlines())
    assert boxes.tolist() == WAY[:5]
    assert lost.tolist() == [False, True, True, False, False]
    gap = text.splitlines()[:2] + text.splitlines()[3:]
    boxes, lost = read_vatic(tmp_path / "a.txt", gap)
    assert np.isnan(boxes[2]).all()
    assert boxes[3:].tolist() == WAY[3:5]
    assert lost.tolist() == [False, True, False, False, False]


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("1,2,3,4", "line 3: not a row of VATIC as line 1 is"),
        ('1 1 2 3 4 2 0 0 0 "x"', r"line 3: another target \(id 1\)"),
        ('0 1 2 3 4 1 0 0 0 "x"', "line 3: frame 1 is there twice"),
        ('0 1 2 3 4 999999999 0 0 0 "x"', "frames up to 999999999, of which it has 3"),
    ],
)
def test_bad_vatic(tmp_path, row, problem):
    make(tmp_path, "a.txt", text=vatic(WAY[:2]) + row)
    with pytest.raises(LaeError, match=problem):
        read_truth(tmp_path / "a.txt")
