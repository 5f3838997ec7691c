"""Files that appear whole or not at all, and how much may be decoded of one."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from places import REPOSITORY

from lae_sim.errors import LaeError
from lae_sim.files import (
    NAME_MAX,
    check_places,
    file_names,
    locked,
    remove_leftovers,
    staged_folder,
    written_whole,
)


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    with written_whole(target) as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path  # so that the rename stays on one file system
        assert not target.exists()
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.skipif(os.name == "nt", reason="Windows cannot replace an open file")
def test_an_old_file_stands_until_then(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    with target.open() as reader:
        with written_whole(target) as temporary:
            temporary.write_text("new")
            assert target.read_text() == "old"
        assert target.read_text() == "new"
        assert reader.read() == "old"  # whoever has it open keeps the whole old file


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, GeneratorExit])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: type[BaseException]
) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")

    def fail_halfway() -> None:
        with written_whole(target) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail_halfway()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_relative_path_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with written_whole("out.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "out.txt").read_text() == "new"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_the_file_has_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "usual").write_text("")
    with written_whole(tmp_path / "ours") as temporary:
        temporary.write_text("")
    modes = {stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert len(modes) == 1


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    def fill() -> None:
        with written_whole(tmp_path / "out.txt") as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, "Arrow says it with many words")

    with pytest.raises(LaeError, match=r"cannot write .*out.txt: No space left on device$"):
        fill()
    assert not list(tmp_path.iterdir())


def killed(block: str, *arguments: object) -> None:
    """Run a program that dies inside a block."""
    program = (
        "import os, sys\nfrom pathlib import Path\nfrom lae_sim.files import *\n"
        f"with {block} as given:\n    given and Path(given, '').exists()\n    os._exit(9)\n"
    )
    command = [sys.executable, "-c", program, *map(str, arguments)]
    assert subprocess.run(command, cwd=REPOSITORY, check=False).returncode == 9


POSIX = pytest.mark.skipif(os.name == "nt", reason="Windows has no locks of files like these")


@POSIX
def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    for _ in range(2):
        killed("written_whole(sys.argv[1])", target)
        assert target.read_text() == "old"
        assert len(list(tmp_path.iterdir())) == 2
    killed("staged_folder(Path(sys.argv[1]))", tmp_path)
    assert len(list(tmp_path.iterdir())) == 3
    with written_whole(target) as temporary:
        temporary.write_text("new")
    with staged_folder(tmp_path) as staged:
        assert not list(staged.iterdir())
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]
    killed("written_whole(sys.argv[1])", target)
    (tmp_path / ".mine.part").touch()
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"out.txt", ".mine.part"}


def test_writers_of_one_file_do_not_disturb_each_other(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    with written_whole(target) as first, written_whole(target) as second:
        remove_leftovers(tmp_path)
        first.write_text("first")
        second.write_text("second")
    assert target.read_text() == "first"  # whose block ends last
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("name", ["n" * 247 + ".parquet", "n" * 255, "a." + "n" * 253, "名" * 85])
def test_a_name_may_be_as_long_as_the_system_allows(tmp_path: Path, name: str) -> None:
    with written_whole(tmp_path / name) as temporary:
        temporary.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == [name]


@POSIX
def test_a_lock_names_who_holds_it_and_outlives_nobody(tmp_path: Path) -> None:
    target = tmp_path / "t.parquet"
    for _ in range(2):
        killed("locked(Path(sys.argv[1]), '')", target)
    message = f"t: another is at work there .process {os.getpid()} on .*: wait until it has ended"
    with locked(target, "t: another"):
        with pytest.raises(LaeError, match=message), locked(target, "t: another"):
            pytest.fail("two hold it")
        with locked(tmp_path / "u.parquet", "u"):
            pass
    with locked(target, "t"):
        pass
    assert not list(tmp_path.iterdir())


def test_places_are_checked_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for path, message in {
        "no/file": "its folder is not there",
        "folder": "is there already and is not a file",
        "pipe": "is there already and is not a file",
        "n" * 256: "its name has 256 bytes, and 255 are possible",
    }.items():
        with pytest.raises(LaeError, match=f"cannot write .*{message}"):
            check_places([tmp_path / "fine", tmp_path / path])


def test_what_is_printed_is_not_replaced(tmp_path: Path) -> None:
    """As by ``lae-sim replay ... --events log > log``."""
    program = "from lae_sim.files import check_places\ncheck_places(['log'])"
    with (tmp_path / "log").open("w") as log:
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        run = [sys.executable, "-c", program]
        ended = subprocess.run(
            run, cwd=tmp_path, env=environment, stdout=log, stderr=subprocess.PIPE, text=True
        )
    assert "cannot write log: what is printed goes there" in ended.stderr


def test_file_names_are_distinct_and_fit_everywhere() -> None:
    names = ["car", "Car", "a/b", "a:b", "a-b", "CON", "nul.x", "..", "", " ", "e\u0301", "\u00e9"]
    names += ["x" * 300, "x" * 301, "名" * 200, "tab\t", "half \ud800"]
    files = file_names(names, ".mp4")
    assert files[:2] == ["car.mp4", "Car-" + files[1][4:12] + ".mp4"]
    assert files[2] == "a-b.mp4"
    assert len({file.casefold() for file in files}) == len(names)
    for file in files:
        assert len(file.encode()) <= NAME_MAX
        assert not set(file) & set('<>:"/\\|?*\t')


@pytest.mark.parametrize("name", ["no/such/folder/out.txt", "x" * 300])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    with (
        pytest.raises(LaeError, match=r"cannot write .*(out.txt|xxx)"),
        written_whole(tmp_path / name),
    ):
        pytest.fail("there is nothing to write to")


def test_a_folder_in_the_place_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with (
        pytest.raises(LaeError, match="cannot write"),
        written_whole(tmp_path / "out") as temporary,
    ):
        temporary.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
