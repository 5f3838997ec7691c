"""Downloads from a mirror: checked, kept, resumed; and what is said where they fail."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from published import ROOT, Server, made_up, served

from lae_sim.errors import LaeError
from lae_sim.recipes import download as module
from lae_sim.recipes.catalogue import Recipe
from lae_sim.recipes.download import download


@pytest.fixture
def mirror(tmp_path: Path) -> Path:
    return made_up(tmp_path)[0]


@pytest.fixture
def kcf(mirror: Path) -> Recipe:
    return made_up(mirror.parent / "again")[1][0]


@pytest.fixture
def server(mirror: Path) -> Iterator[Server]:
    with served(mirror) as server:
        yield server


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own, and no patience."""
    monkeypatch.setenv("LAE_SIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_PATIENCE_S", (0.0,))
    return tmp_path / "cache"


def kept(cache: Path) -> set[str]:
    """What is in the cache, half files and all."""
    return {path.relative_to(cache).as_posix() for path in cache.rglob("*") if path.is_file()}


def test_files_come_once(kcf: Recipe, server: Server, cache: Path, mirror: Path) -> None:
    said: list[tuple[int, int]] = []
    folder = download(kcf.files, server.url, lambda done, total: said.append((done, total)))
    assert folder == cache
    assert kept(cache) == {file.path for file in kcf.files}
    assert (cache / kcf.files[0].path).read_bytes() == (mirror / kcf.files[0].path).read_bytes()
    assert len(server.asked) == len(kcf.files) == 9
    total = sum(file.size for file in kcf.files)
    assert said[-1] == (total, total)
    assert [done for done, _ in said] == sorted(done for done, _ in said)
    server.asked.clear()
    said.clear()
    download(kcf.files, server.url, lambda done, total: said.append((done, total)))
    assert not server.asked
    assert said[-1] == (total, total)


def test_a_second_run_needs_no_server(kcf: Recipe, mirror: Path, cache: Path) -> None:
    with served(mirror) as server:
        download(kcf.files, server.url)
    assert download(kcf.files, server.url) == cache
    assert download(kcf.files) == cache  # from nowhere else, either


def test_a_folder_is_a_mirror_too(kcf: Recipe, mirror: Path, cache: Path) -> None:
    download(kcf.files, mirror)
    assert kept(cache) == {file.path for file in kcf.files}


@pytest.mark.parametrize("from_folder", [True, False])
def test_a_file_of_another_digest_is_not_kept(
    kcf: Recipe, server: Server, mirror: Path, cache: Path, from_folder: bool
) -> None:
    bad = mirror / ROOT / "kcf" / "car.txt"
    bad.write_bytes(bad.read_bytes().replace(b"12", b"13"))
    place = str(mirror) if from_folder else server.url
    with pytest.raises(
        LaeError, match=r"kcf/car\.txt: not the file that .* SHA-256 is not"
    ) as said:
        download(kcf.files, place)
    assert str(said.value).startswith(f"{place}/{ROOT}")
    assert kept(cache) <= {file.path for file in kcf.files} - {f"{ROOT}/kcf/car.txt"}


def test_a_file_that_was_changed_in_the_cache_is_fetched_again(
    kcf: Recipe, server: Server, cache: Path
) -> None:
    download(kcf.files, server.url)
    server.asked.clear()
    path = kcf.files[0].path
    (cache / path).write_bytes(b"1,2,3,4\n")
    download(kcf.files, server.url)
    assert server.asked == [f"/{path}"]
    assert len((cache / path).read_bytes()) == kcf.files[0].size


def test_half_a_file_is_not_kept_and_the_next_run_goes_on(
    kcf: Recipe, server: Server, cache: Path
) -> None:
    half = next(file for file in kcf.boxes.files if file.name == "car.txt")
    server.broken = {"car.txt"}
    said = rf"ended after [0-9]+ of {half.size} bytes; what came whole is kept, and the next run"
    with pytest.raises(LaeError, match=said):
        download([half], server.url)
    assert len(server.asked) == 2  # it was tried again
    assert kept(cache) == set()
    others = [file for file in kcf.files if file is not half]
    download(others, server.url)
    with pytest.raises(LaeError, match="ended after"):
        download(kcf.files, server.url)
    assert kept(cache) == {file.path for file in others}
    server.broken = set()
    server.asked.clear()
    download(kcf.files, server.url)
    assert server.asked == [f"/{half.path}"]
    assert kept(cache) == {file.path for file in kcf.files}


def test_what_a_mirror_cuts_short_is_half_a_file(kcf: Recipe, mirror: Path, cache: Path) -> None:
    path = mirror / kcf.files[0].path
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(LaeError, match=f"ended after 100 of {kcf.files[0].size} bytes"):
        download(kcf.files[:1], mirror)
    assert kept(cache) == set()


def test_no_network(kcf: Recipe, mirror: Path, cache: Path) -> None:
    with served(mirror) as server:
        pass
    with pytest.raises(LaeError, match=r"cannot be reached \(ConnectionError\): is there a netw"):
        download(kcf.files, server.url)
    assert kept(cache) == set()


def test_a_busy_server_is_asked_again(kcf: Recipe, server: Server) -> None:
    server.busy = {"car_time.txt"}
    with pytest.raises(LaeError, match=r"car_time\.txt: the server is busy \(503\); what came"):
        download(kcf.files, server.url)
    assert sum(path.endswith("car_time.txt") for path in server.asked) == 2


def test_what_a_server_does_not_have(kcf: Recipe, server: Server) -> None:
    gone = replace(kcf.files[0], path=f"{ROOT}/anno/gone.txt")
    with pytest.raises(LaeError, match=r"gone\.txt: the server says 404; --mirror PLACE takes"):
        download([gone], server.url)
    assert len(server.asked) == 1


def test_what_a_folder_does_not_have(kcf: Recipe, mirror: Path) -> None:
    (mirror / kcf.files[0].path).unlink()
    with pytest.raises(LaeError, match="the mirror has no such file"):
        download(kcf.files, mirror)
    with pytest.raises(LaeError, match=r"--mirror .*nowhere: no such folder"):
        download(kcf.files, mirror / "nowhere")


def test_a_full_disk(
    kcf: Recipe, mirror: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(url: str, output: module._Transfer) -> None:
        output.write(b"some")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module, "_copied", full)
    with pytest.raises(LaeError, match=r"cannot write .*cache: No space left .* LAE_SIM_CACHE="):
        download(kcf.files, mirror)
    assert kept(cache) == set()


def test_a_cache_that_is_no_folder(kcf: Recipe, mirror: Path, cache: Path) -> None:
    cache.write_text("a file")
    with pytest.raises(LaeError, match=r"cannot write .*cache: "):
        download(kcf.files, mirror)
