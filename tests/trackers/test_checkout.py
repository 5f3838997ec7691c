"""What the adapters of source checkouts share."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from lae_sim.errors import LaeError
from lae_sim.trackers.checkout import commit, explained, replaced, stand_ins
from lae_sim.trackers.protocol import weights_digest

HASH = "0123456789" * 4


def test_commit(tmp_path: Path) -> None:
    assert commit(tmp_path) is None
    git = tmp_path / ".git"
    git.mkdir()
    (git / "HEAD").write_text(HASH + "\n")
    assert commit(tmp_path) == HASH  # detached
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    assert commit(tmp_path) is None  # without a commit yet
    (git / "packed-refs").write_text(f"# pack-refs with: peeled\n{HASH} refs/heads/main\n")
    assert commit(tmp_path) == HASH
    (git / "refs" / "heads").mkdir(parents=True)
    (git / "refs" / "heads" / "main").write_text("f" * 40 + "\n")
    assert commit(tmp_path) == "f" * 40  # a loose ref is newer than a packed one


def test_commit_of_a_further_work_tree(tmp_path: Path) -> None:
    own = tmp_path / "main" / ".git" / "worktrees" / "other"
    own.mkdir(parents=True)
    (own / "HEAD").write_text("ref: refs/heads/other\n")
    (own / "commondir").write_text("../..\n")
    (tmp_path / "main" / ".git" / "packed-refs").write_text(f"{HASH} refs/heads/other\n")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".git").write_text(f"gitdir: {own}\n")
    assert commit(tmp_path / "other") == HASH


def test_stand_ins_are_for_what_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    with stand_ins(["json", "absent_drawing"]) as absent:
        module = importlib.import_module("absent_drawing.pyplot")
        assert absent == ["absent_drawing"]

    class Derived(module.Figure):  # type: ignore[misc, name-defined]
        pass

    Derived(1, size=2)
    assert module.cm.Jet(3) is not None
    with pytest.raises(AttributeError):
        module.Figure().draw()  # a thing of it does nothing, and says so
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("absent_painting")


def test_replaced_gives_back() -> None:
    class Owner:
        value = 1

    with replaced((Owner, "value", 2)):
        assert Owner.value == 2
    assert Owner.value == 1
    with pytest.raises(KeyError), replaced((Owner, "value", 2)):
        raise KeyError
    assert Owner.value == 1


def test_explained() -> None:
    needs = r"^folder: it needs cv2: pip install opencv-python$"
    with pytest.raises(LaeError, match=needs), explained("folder"):
        raise ModuleNotFoundError("no", name="cv2.gapi")
    with pytest.raises(LaeError, match=r"^folder: ValueError: two lines \("), explained("folder"):
        raise ValueError("two\n   lines")
    with pytest.raises(LaeError, match=r"^as it is$"), explained("folder"):
        raise LaeError("as it is")


def test_weights_digest(tmp_path: Path) -> None:
    (tmp_path / "abc").write_bytes(b"abc")
    assert weights_digest(tmp_path / "abc").startswith(
        "ba7816bf8f01cfea414140de5dae2223b00361a39617"
    )
