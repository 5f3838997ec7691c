"""Files of public repositories, downloaded once and checked by their digests.

What is there and right is not fetched again: an interrupted download goes on where it was, and a
second one needs no network. A file appears in the cache when it is whole and its digest is right.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, BinaryIO

from lae_sim.errors import LaeError, one_line
from lae_sim.recipes.catalogue import RemoteFile

HOME = "https://raw.githubusercontent.com/"
"""Where public repositories serve their files, as ``OWNER/NAME/COMMIT/PATH``."""

CACHE_VARIABLE = "LAE_SIM_CACHE"
"""The environment variable that names another folder for what is downloaded."""

Progress = Callable[[int, int], object]
"""``progress(done, total)`` is called as bytes arrive."""

_AT_ONCE = 8
_PATIENCE_S = (1.0, 4.0)  # before another try
_BUSY = (429, 500, 502, 503, 504)
_TIMEOUT_S = 30
_CHUNK = 1 << 16


def cache_folder() -> Path:
    """Where downloaded files are kept: the user's cache, unless the environment names a folder."""
    import pooch

    return Path(os.environ.get(CACHE_VARIABLE) or pooch.os_cache("lae_sim"))


def download(
    files: Iterable[RemoteFile],
    mirror: str | None = None,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Bring files into the cache.

    Args:
        files: what is needed.
        mirror: a folder or an URL that has the same files below it, under the same paths, to take
            them from instead of :data:`HOME`.
        progress: called as bytes arrive.

    Returns:
        The folder in which each of them lies at its path.

    Raises:
        LaeError: if one cannot be had, is not the file that the recipe is for, or cannot be
            written. What has arrived whole stays, and is not fetched again.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")  # or it would say each file on the standard error stream
    files = list({file.path: file for file in files}.values())
    base = HOME if mirror is None else mirror
    is_folder = "://" not in base
    if is_folder and not Path(base).is_dir():
        raise LaeError(f"--mirror {base}: no such folder")
    shelf = pooch.create(
        cache_folder(),
        base if base.endswith("/") else f"{base}/",
        registry={file.path: f"sha256:{file.sha256}" for file in files},
    )
    count = _Count(sum(file.size for file in files), progress)
    pool = ThreadPoolExecutor(_AT_ONCE)
    fetch = _copied if is_folder else _over_http
    try:
        pending = [pool.submit(_fetch, shelf, file, fetch, count) for file in files]
        for each in as_completed(pending):
            each.result()
    finally:
        pool.shutdown(cancel_futures=True)
    return Path(shelf.abspath)


class _HalfAFileError(Exception):
    """A transfer that ended early."""


class _Count:
    """Bytes that have arrived, told as they do."""

    def __init__(self, total: int, progress: Progress) -> None:
        self._done, self._total, self._progress = 0, total, progress
        self._lock = threading.Lock()

    def add(self, size: int) -> None:
        with self._lock:
            self._done += size
            self._progress(min(self._done, self._total), self._total)


class _Counted:
    """A file that counts what is written to it."""

    def __init__(self, file: BinaryIO, count: _Count) -> None:
        self._file, self._count, self.size = file, count, 0

    def write(self, data: bytes) -> None:
        self._file.write(data)
        self.size += len(data)
        self._count.add(len(data))

    def flush(self) -> None:
        """Leave it to the file, which knows when it is full."""


def _over_http(url: str, output: _Counted) -> None:
    import pooch

    pooch.HTTPDownloader(chunk_size=_CHUNK, timeout=_TIMEOUT_S)(url, output, None)


def _copied(url: str, output: _Counted) -> None:
    with open(url, "rb") as file:
        shutil.copyfileobj(file, output, _CHUNK)  # type: ignore[arg-type]


def _fetch(
    shelf: Any, file: RemoteFile, fetch: Callable[[str, _Counted], None], count: _Count
) -> None:
    """Bring one file into the cache unless it is there."""

    def downloader(url: str, output_file: str, pooch: object) -> None:
        nonlocal written
        with open(output_file, "wb") as opened:
            counted = _Counted(opened, count)
            try:
                fetch(url, counted)
            finally:
                written = counted.size
        if written < file.size:
            raise _HalfAFileError

    written = 0
    url = shelf.get_url(file.path)
    for patience in (*_PATIENCE_S, None):
        try:
            shelf.fetch(file.path, downloader=downloader)
            break
        except Exception as error:  # of the network, the disk, or pooch's own
            if patience is None or not _may_pass(error):
                raise LaeError(_reason(error, url, file, written, shelf.abspath)) from error
            count.add(-written)
            time.sleep(patience)
    if not written:
        count.add(file.size)


def _may_pass(error: Exception) -> bool:
    """Whether another try may help."""
    import requests

    if isinstance(error, requests.HTTPError):
        return error.response is not None and error.response.status_code in _BUSY
    broken = (_HalfAFileError, requests.Timeout, requests.exceptions.ChunkedEncodingError)
    return isinstance(error, broken)


def _reason(error: Exception, url: str, file: RemoteFile, written: int, cache: Path) -> str:
    """What went wrong, and what to do."""
    import requests

    again = "what has arrived is kept: run it again to go on"
    if isinstance(error, (_HalfAFileError, requests.exceptions.ChunkedEncodingError)):
        return f"{url}: ended after {written:,} of {file.size:,} bytes; {again}"
    if isinstance(error, requests.HTTPError):
        status = error.response.status_code if error.response is not None else "an error"
        if status in _BUSY:
            return f"{url}: the server says {status}; {again} later"
        return f"{url}: the server says {status}; is it gone? --mirror takes it from elsewhere"
    if isinstance(error, requests.RequestException):
        return (
            f"{url}: cannot be reached ({type(error).__name__}); {again} with a network, or give "
            "a folder that has the files with --mirror"
        )
    if isinstance(error, FileNotFoundError) and "://" not in url:
        return f"the mirror has no {url}"
    if isinstance(error, OSError):
        space = f"; {again} elsewhere with {CACHE_VARIABLE}=FOLDER"
        reason = os.strerror(error.errno) if error.errno else one_line(str(error))
        return f"cannot write {cache}: {reason}{space if error.errno == errno.ENOSPC else ''}"
    if isinstance(error, ValueError):  # pooch says of digests that they differ, and of nothing else
        return (
            f"{url}: its SHA-256 is not {file.sha256[:12]}..., so it is not the file that the "
            "recipe was made for; it is not kept"
        )
    return f"{url}: {one_line(str(error))}"
