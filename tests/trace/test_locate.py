"""Where traces are: paths, folders, globs and URLs."""

from __future__ import annotations

import hashlib
import http.server
import os
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from witness import assert_same, moving

from lae_sim.errors import LaeError
from lae_sim.trace.file import Trace, read_trace, validate, write_trace
from lae_sim.trace.locate import digest, find_traces, opened
from lae_sim.trace.metadata import Metadata

NAMES = ("a.parquet", "b[1].parquet", "deep/c.parquet", "notes.txt", ".a.part.parquet")
REASON = "no fsspec here: pip install 'lae-sim[remote]'"
GROUP = [moving(40, name="one"), moving(9, name="two")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with three traces, a note, and what a writer left when it was killed."""
    (tmp_path / "deep").mkdir()
    for name in NAMES:
        (tmp_path / name).write_bytes(name.encode())
    return tmp_path


@pytest.fixture
def memory() -> Iterator[Any]:
    """The same in fsspec's memory, at memory://lae."""
    fsspec = pytest.importorskip("fsspec", reason=REASON)
    system = fsspec.filesystem("memory")
    for name in NAMES:
        system.pipe(f"/lae/{name}", name.encode())
    yield system
    system.rm("/lae", recursive=True)


MATCHES = [
    ("a.parquet", "a.parquet"),
    ("notes.txt", "notes.txt"),
    ("b[1].parquet", "b[1].parquet"),  # it is there, so it is no glob
    ("", "a.parquet b[1].parquet"),
    ("deep", "deep/c.parquet"),
    ("deep/", "deep/c.parquet"),
    ("[ab]*.parquet", "a.parquet b[1].parquet"),
    ("?.parquet", "a.parquet"),
    ("**/*.parquet", "a.parquet b[1].parquet deep/c.parquet"),
    ("*/c.parquet", "deep/c.parquet"),
]


@pytest.mark.parametrize(("pattern", "names"), MATCHES)
def test_what_a_path_matches(folder: Path, pattern: str, names: str) -> None:
    wanted = [os.path.join(folder, name) for name in names.split()]
    assert find_traces([os.path.join(folder, pattern)]) == wanted
    assert find_traces([pattern], folder) == wanted


@pytest.mark.parametrize(("pattern", "names"), MATCHES)
def test_what_a_url_matches(folder: Path, memory: Any, pattern: str, names: str) -> None:
    for root in ("memory://lae", f"file://{folder}"):
        assert find_traces([f"{root}/{pattern}"]) == [f"{root}/{name}" for name in names.split()]


def test_a_name_keeps_the_form_in_which_it_was_given(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("HOME", str(folder / "deep"))
    assert find_traces(["./a.parquet", "deep"]) == ["./a.parquet", "deep/c.parquet"]
    assert find_traces(["."]) == ["./a.parquet", "./b[1].parquet"]
    assert find_traces(["~"]) == [str(folder / "deep/c.parquet")]


def test_a_file_comes_once_and_where_it_was_first_named(folder: Path) -> None:
    pytest.importorskip("fsspec", reason=REASON)
    (folder / "link.parquet").symlink_to(folder / "a.parquet")
    found = find_traces(["b*.parquet", "link.parquet", ".", f"file://{folder}/a.parquet"], folder)
    assert [os.path.basename(name) for name in found] == ["b[1].parquet", "link.parquet"]


@pytest.mark.parametrize("pattern", ["none.parquet", "none*", "empty", "deep/*.txt"])
def test_a_pattern_that_matches_nothing_is_named(folder: Path, memory: Any, pattern: str) -> None:
    (folder / "empty").mkdir()
    for root in (".", "memory://lae"):
        with pytest.raises(LaeError, match=r"(no trace is there|no such file)") as raised:
            find_traces(["a.parquet", f"{root}/{pattern}"], folder)
        assert str(raised.value).startswith(f"{root}/{pattern}: ")
        assert "\n" not in str(raised.value)


def test_a_file_system_that_cannot_be_used_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    registry = pytest.importorskip("fsspec.registry", reason=REASON)
    with pytest.raises(LaeError, match=r"^nope://x: cannot be read \(ValueError: .*nope.*\)$"):
        find_traces(["nope://x"])
    far = {"class": "farfs.Far", "err": "Install farfs"}
    monkeypatch.setitem(registry.known_implementations, "far", far)
    with pytest.raises(LaeError, match=r"^far://x: Install farfs: pip install farfs$"):
        read_trace("far://x")


def test_a_file_without_permission_is_one_line(
    memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError("Forbidden\nby the bucket")

    with monkeypatch.context() as each:  # undone before the files are taken away
        each.setattr(type(memory), "open", refuse)
        each.setattr(type(memory), "info", refuse)
        each.setattr(os, "listdir", refuse)
        for function, path in (
            (find_traces, ["memory://lae"]),
            (find_traces, [os.curdir]),
            (digest, "memory://lae/a.parquet"),
            (read_trace, "memory://lae/a.parquet"),
        ):
            with pytest.raises(
                LaeError, match=r"read \(PermissionError: Forbidden by the bucket\)$"
            ):
                function(path)  # type: ignore[operator]


def test_a_url_without_fsspec_tells_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [name for name in sys.modules if name.partition(".")[0] == "fsspec"]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setattr(sys, "path", [])
    for function, path in ((find_traces, ["s3://a"]), (digest, "s3://a"), (validate, "s3://a")):
        with pytest.raises(LaeError, match=r"^s3://a: .*: pip install 'lae-sim\[remote\]'$"):
            function(path)  # type: ignore[operator]


def test_a_digest_is_of_the_content(folder: Path, memory: Any) -> None:
    content = os.urandom(9 << 20)
    (folder / "a.parquet").write_bytes(content)
    memory.pipe("/lae/a.parquet", content)
    wanted = hashlib.sha256(content).hexdigest()
    for root in (str(folder), f"file://{folder}", "memory://lae"):
        assert digest(f"{root}/a.parquet") == wanted
    memory.pipe("/lae/a.parquet", content[:-1])
    assert digest("memory://lae/a.parquet") != wanted
    for path in (f"{folder}/none", "memory://lae/none"):
        with pytest.raises(LaeError, match=f"^{path}: no such file$"):
            digest(path)


@pytest.mark.parametrize("name", ["any", "é", "\udcff"])
def test_a_file_has_any_name(folder: Path, name: str) -> None:
    path = os.fsencode(str(folder / name))
    try:
        with open(path, "wb") as file:
            file.write(b"content")
    except OSError:
        pytest.skip("this file system holds no such names")
    with opened(os.fsdecode(path)) as source:
        assert source.read() == b"content"
    with pytest.raises(FileNotFoundError), opened(str(folder / "none")):
        pass


def test_a_trace_is_read_from_a_url(folder: Path, memory: Any) -> None:
    write_trace(Trace(Metadata.new("30", "every-frame"), GROUP), folder / "a.parquet")
    memory.put(str(folder / "a.parquet"), "/lae/a.parquet")
    for url in (f"file://{folder}/a.parquet", "memory://lae/a.parquet"):
        trace = read_trace(url)
        for _ in range(2):
            assert_same(trace, GROUP)
    for url, message in {
        "memory://lae/none": "no such file",
        "memory://lae/notes.txt": "not a readable Parquet file: .*",
    }.items():
        with pytest.raises(LaeError, match=f"^{url}: {message}"):
            read_trace(url)


def test_an_error_of_the_file_system_while_reading_is_one_of_the_trace(
    memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A broken connection is, of some file systems, not even an OSError."""
    from fsspec.implementations.memory import MemoryFile

    class BrokenError(Exception):
        pass

    def read(*_: Any) -> bytes:
        raise BrokenError("connection lost")

    monkeypatch.setattr(MemoryFile, "read", read)
    with pytest.raises(LaeError, match=r"^memory://lae/a.parquet: BrokenError: connection lost$"):
        read_trace("memory://lae/a.parquet")


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


def test_a_trace_is_read_from_a_web_server_that_sends_whole_files_only(folder: Path) -> None:
    pytest.importorskip("fsspec", reason=REASON)
    pytest.importorskip("aiohttp", reason="fsspec needs it for http://")
    write_trace(Trace(Metadata.new("30", "every-frame"), GROUP), folder / "a.parquet")
    handler = partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        try:
            root = f"http://127.0.0.1:{server.server_port}"
            assert find_traces([f"{root}/deep/"]) == [f"{root}/deep/c.parquet"]
            (url,) = find_traces([f"{root}/a*.parquet"])
            assert_same(read_trace(url), GROUP)
            assert digest(url) == digest(str(folder / "a.parquet"))
            with pytest.raises(LaeError, match=r"no such file .*404"):
                read_trace(f"{root}/none.parquet")
        finally:
            server.shutdown()
