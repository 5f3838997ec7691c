"""Where traces are: files, folders, globs, and URLs of any file system that fsspec knows."""

from __future__ import annotations

import glob
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, TraceError, install, one_line
from lae_sim.files import check_regular

BLOCK = 8 << 20  # bytes read at once; s3fs would take 50 MiB, several times over


def find_traces(patterns: Sequence[str], base: Path | None = None) -> list[str]:
    """The traces that patterns name: sorted within a pattern, and each file once.

    Args:
        patterns: each a file, a folder (its ``*.parquet``, not those deeper; end a web folder in
            ``/``), a glob (``*``, ``**``, ``?``, ``[...]``), or a URL of one of these.
        base: the folder of relative paths; by default the current one.

    Raises:
        LaeError: if a pattern matches nothing or cannot be reached.
    """
    traces: dict[str, str] = {}
    for pattern in patterns:
        with _explained(pattern):
            names = _remote(pattern) if is_url(pattern) else _local(pattern, base)
        if not names:
            raise LaeError(
                f"{pattern}: no trace is there (of a folder, *.parquet are taken; lae-sim convert "
                "makes traces of a toolkit's results)"
            )
        for name in sorted(names):
            same = name.removeprefix("file://")
            traces.setdefault(same if is_url(same) else os.path.realpath(same), name)
    return list(traces.values())


@contextmanager
def opened(path: str) -> Iterator[Any]:
    """What pyarrow reads a trace from: a file, or of a URL one that can seek.

    Raises:
        TraceError: if a path is that of no file.
        LaeError: if a URL cannot be opened.
        OSError, ValueError: if a file cannot be.
    """
    if not is_url(path):
        import pyarrow as pa

        try:
            check_regular(path)
        except LaeError as error:
            raise TraceError(str(error)) from error
        with pa.OSFile(os.fsencode(path)) as file:  # whose name need not be UTF-8
            yield file
        return
    with _explained(path):
        file = _binary(path)
    with file:
        yield file


def digest(path: str) -> str:
    """The SHA-256 of a file's content, path or URL, in hexadecimal.

    Raises:
        LaeError: if it cannot be read.
    """
    whole = hashlib.sha256()
    check_regular(path)
    with _explained(path), _binary(path) if is_url(path) else open(path, "rb") as file:
        while block := file.read(BLOCK):
            whole.update(block)
    return whole.hexdigest()


def stamp(path: str) -> str:
    """Size and time of a local file, which change with it; empty of a URL or where it is not."""
    if is_url(path) or not os.path.exists(path):
        return ""
    status = os.stat(path)
    return f"{status.st_size} {status.st_mtime_ns}"


def is_url(path: str) -> bool:
    """Whether fsspec is to find it."""
    return "://" in path


def _local(pattern: str, base: Path | None) -> list[str]:
    path = os.path.join(base or "", os.path.expanduser(pattern))
    if os.path.isdir(path):
        os.listdir(path)  # glob would find nothing, silently, where it has no permission
        path = os.path.join(glob.escape(path), "*.parquet")
    elif os.path.exists(path):
        return [path]
    elif not set("*?[") & set(path):
        raise FileNotFoundError
    return [name for name in glob.glob(path, recursive=True) if os.path.isfile(name)]


def _remote(pattern: str) -> list[str]:
    system, path = _file_system(pattern)
    try:
        kind = system.info(path)["type"]
    except FileNotFoundError:
        if not set("*?[") & set(path):
            raise
        entries = system.glob(path, detail=True).values()
    else:
        if kind == "file" and not pattern.endswith("/"):
            return [pattern]
        entries = [e for e in system.ls(path, detail=True) if e["name"].endswith(".parquet")]
    names = [entry["name"] for entry in entries if entry["type"] == "file"]
    names = [name for name in names if not name.rpartition("/")[2].startswith(".")]  # as in glob
    # user, host and the like are in the URL, but not in the names
    stem = pattern.rstrip("/")
    before = stem.removesuffix(path.rstrip("/"))
    return [before + name if before != stem else system.unstrip_protocol(name) for name in names]


def _binary(url: str) -> Any:
    system, path = _file_system(url)
    file = system.open(path, "rb", block_size=BLOCK)
    if path.startswith("http"):
        try:
            file.seek(-1, os.SEEK_END)
            file.read(1)
            file.seek(0)
        except ValueError:  # the server sends whole files only: have it on the disk
            file.close()
            file = tempfile.TemporaryFile()  # noqa: SIM115 - the caller's
            with system.open(path, "rb", block_size=0) as stream:
                shutil.copyfileobj(stream, file, BLOCK)
            file.seek(0)
    return file


def _file_system(url: str) -> tuple[Any, str]:
    from fsspec.core import url_to_fs

    system, path = url_to_fs(url)
    system.invalidate_cache()  # a listing from before would hide that a file has changed
    return system, path


@contextmanager
def _explained(path: str) -> Iterator[None]:
    """Say whatever goes wrong in one line: every file system has errors of its own."""
    try:
        yield
    except FileNotFoundError as error:
        cause = error.__cause__  # refused or out of reach, of a web server
        why = "" if cause is None else f" ({_line(cause)})"
        raise TraceError(f"{path}: no such file{why}") from error
    except ImportError as error:
        missing = getattr(error.__cause__ or error, "name", None)
        command = install("remote") if missing == "fsspec" else f"pip install {missing}"
        raise LaeError(f"{path}: {error}: {command}") from error
    except Exception as error:
        raise LaeError(f"{path}: cannot be read ({_line(error)})") from error


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {one_line(str(error))[:300]}"
