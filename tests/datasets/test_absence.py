"""Flags of absence in the layouts that have them, and what is done with damaged ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from lae_sim.datasets.absence import Flags, absence_files, read_flags

FRAMES = 6
BOXES = "1,2,3,4\n" * FRAMES


def written(folder: Path, files: dict[str, str]) -> Path:
    """A file of ground truth with others beside it."""
    for name, text in {"groundtruth.txt": BOXES, **files}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder / "groundtruth.txt"


def absent(truth: Path, frames: int = FRAMES) -> list[int]:
    flags = read_flags({"a": truth}, {"a": frames})
    assert flags.notes == ()
    visible = flags.visible["a"]
    assert visible.shape == (frames,)
    return [i for i, seen in enumerate(visible.tolist()) if not seen]


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"full_occlusion.txt": "0,0,1,0,0,0", "out_of_view.txt": "0,0,0,1,0,0"}, [2, 3]),
        ({"full_occlusion.txt": "0,1,1,0,0,0,\n"}, [1, 2]),
        ({"out_of_view.txt": "0\n0\n0\n0\n1\n1\n"}, [4, 5]),
        ({"out_of_view.txt": "0.0\n0.0\n1.000e+00\n0\n1.\n0\n"}, [2, 4]),  # as np.savetxt has it
        ({"out_of_view.txt": "\ufeff0 0 0 0 0 0"}, []),
        ({"absence.label": "0\n0\n0\n1\n0\n0\n"}, [3]),
        ({"cover.label": "8\n7\n1\n0\n8\n8\n"}, [3]),
        ({"cover.label": "8\n8\n8\n0\n8\n8", "absence.label": "1\n0\n0\n0\n0\n0"}, [0, 3]),
        (
            {"full-occlusion.tag": "0\n1\n0\n0\n0\n0", "out-of-frame.tag": "1\n0\n0\n0\n0\n0"},
            [0, 1],
        ),
        ({"full-occlusion.tag": "0\n1\n"}, [1]),  # the VOT toolkit takes 0 for the rest
        ({"full-occlusion.tag": "0\n" * 6, "occlusion.tag": "1\n" * 6}, []),
    ],
)
def test_flags_beside_the_truth(tmp_path: Path, files: dict[str, str], expected: list[int]) -> None:
    assert absent(written(tmp_path, files)) == expected


def test_flags_of_flat_files(tmp_path: Path) -> None:
    written(tmp_path, {"annos/absent/bird-2.txt": "0\n0\n1\n0\n0\n1\n", "annos/bird-2.txt": BOXES})
    assert absent(tmp_path / "annos" / "bird-2.txt") == [2, 5]
    written(
        tmp_path,
        {
            "full_occlusion/fog_full_occlusion.txt": "1\n0\n0\n0\n0\n0\n",
            "out_of_view/fog_out_of_view.txt": "0\n0\n0\n0\n0\n1\n",
            "anno/fog.txt": BOXES,
        },
    )
    assert absent(tmp_path / "anno" / "fog.txt") == [0, 5]


@pytest.mark.parametrize(("step", "frames"), [(1, 24), (8, 3)])
def test_nfs_says_in_its_truth_where_the_target_is_out_of_view(
    tmp_path: Path, step: int, frames: int
) -> None:
    """Of 30 frames/s every eighth row counts. An occluded target may be seen in part."""
    rows = [f'0 5 5 30 40 {i} {int(i in (8, 9))} {int(i == 3)} 0 "ball"\n' for i in range(24)]
    rate = {1: "240", 8: "30"}[step]
    written(tmp_path, {f"ball/{rate}/ball.txt": "".join(rows)})
    assert absent(tmp_path / "ball" / rate / "ball.txt", frames) == ([8, 9] if step == 1 else [1])


@pytest.mark.parametrize(
    "files", [{}, {"occlusion.tag": "1\n" * 6}, {"cut_by_image.label": "1\n" * 6}]
)
def test_without_such_files_nothing_is_said(tmp_path: Path, files: dict[str, str]) -> None:
    truth = written(tmp_path, files)
    assert absence_files(truth) == {}
    assert read_flags({"a": truth}, {"a": FRAMES}) == Flags({})


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("full_occlusion.txt", "0,0,0,0,0", "5 flags, and there are 6 frames"),
        ("full_occlusion.txt", "0,0,0,0,0,0,0", "7 flags, and there are 6 frames"),
        ("full-occlusion.tag", "0\n" * 7, "7 flags, and there are 6 frames"),
        ("full_occlusion.txt", "0,0,0,2,0,0", "whole numbers from 0 to 1"),
        ("full_occlusion.txt", "0,0,0,0.5,0,0", "whole numbers from 0 to 1"),
        ("cover.label", "8\n8\n9\n8\n8\n8", "whole numbers from 0 to 8"),
        ("absence.label", "-1\n" * 6, "whole numbers from 0 to 1"),
        ("absence.label", "0\n0\nno\n0\n0\n0", "from 0 to 1, not 'no'"),
        ("absence.label", "0\n0\nnan\n0\n0\n0", "from 0 to 1, not 'nan'"),
        ("out_of_view.txt", "", "is empty"),
        ("out_of_view.txt", "0,0,0\n0", "4 flags, and there are 6 frames"),
        ("out_of_view.txt", "\1", "from 0 to 1, not"),
    ],
)
def test_damaged_flags_are_left_out_and_told(
    tmp_path: Path, name: str, text: str, reason: str
) -> None:
    """Those of the other files too: half of what is known would be scored as all of it."""
    truth = written(tmp_path, {"full_occlusion.txt": "0,1,0,0,0,0", name: text})
    other = written(tmp_path / "b", {"full_occlusion.txt": "1,0,0,0,0,0"})
    flags = read_flags({"a": truth, "b": other}, {"a": FRAMES, "b": FRAMES})
    assert list(flags.visible) == ["b"]
    (note,) = flags.notes
    assert note.startswith(
        f"flags of absence of 1 of 2 sequences are left out, such as {tmp_path / name}"
    )
    assert reason in note
