"""Files of public repositories, downloaded once and checked by their digests.

What is there and right is not fetched again: an interrupted download goes on where it was, and a
second one needs no network. A file appears in the cache when it is whole and its digest is right.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError, described, one_line
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
    mirror: str | os.PathLike[str] | None = None,
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
    import requests

    pooch.get_logger().setLevel("ERROR")  # or it would say each file on the standard error stream
    files = list({file.path: file for file in files}.values())
    base = HOME if mirror is None else os.fspath(mirror)
    is_folder = "://" not in base
    if is_folder and not os.path.isdir(base):
        raise LaeError(f"--mirror {base}: no such folder")
    shelf = pooch.Pooch(
        path=cache_folder(),
        base_url=base if base.endswith("/") else f"{base}/",
        registry={file.path: f"sha256:{file.sha256}" for file in files},
    )
    count = _Count(sum(file.size for file in files), progress)
    pool = ThreadPoolExecutor(_AT_ONCE)
    with requests.Session() as session:
        fetch = _copied if is_folder else partial(_over_http, session)
        try:
            pending = [pool.submit(_shelve, shelf, _Transfer(file, fetch, count)) for file in files]
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
            self._progress(self._done, self._total)


class _Transfer:
    """What brings one file, as pooch calls it; it is also the stream that counts what comes.

    Args:
        file: what is to come.
        fetch: writes what lies at an URL to a stream.
        count: of all files.

    Attributes:
        file: the same.
        written: bytes of it that have come.
    """

    def __init__(
        self, file: RemoteFile, fetch: Callable[[str, _Transfer], object], count: _Count
    ) -> None:
        self.file, self.written = file, 0
        self._fetch, self._count = fetch, count
        self._output: Any = None

    def __call__(self, url: str, output_file: str, pooch: object) -> None:
        self.restart()
        with open(output_file, "wb") as self._output:
            self._fetch(url, self)
        if self.written < self.file.size:
            raise _HalfAFileError

    def write(self, data: bytes) -> None:
        self._output.write(data)
        self._add(len(data))

    def restart(self) -> None:
        """Forget what has come."""
        self._add(-self.written)

    def found(self) -> None:
        """Count the file as a whole, if none of it had to come."""
        self._add(self.file.size - self.written)

    def _add(self, size: int) -> None:
        self.written += size
        self._count.add(size)


def _over_http(session: Any, url: str, output: _Transfer) -> None:
    # not by pooch's own, which leaves what it breaks off open, and connects anew for each file
    with session.get(url, stream=True, timeout=_TIMEOUT_S) as response:
        response.raise_for_status()
        for chunk in response.iter_content(_CHUNK):
            output.write(chunk)


def _copied(url: str, output: _Transfer) -> None:
    with open(url, "rb") as file:
        shutil.copyfileobj(file, output, _CHUNK)


def _shelve(shelf: Any, transfer: _Transfer) -> None:
    """Bring one file into the cache unless it is there."""
    path = transfer.file.path
    for patience in (*_PATIENCE_S, None):
        try:
            # pooch looks and then makes it, and meanwhile another thread may have made it
            Path(shelf.abspath, path).parent.mkdir(parents=True, exist_ok=True)
            shelf.fetch(path, downloader=transfer)
            break
        except Exception as error:  # of the network, the disk, or pooch's own
            if patience is None or not _may_pass(error):
                raise LaeError(_reason(error, shelf, transfer)) from error
            time.sleep(patience)
    transfer.found()


def _may_pass(error: Exception) -> bool:
    """Whether another try may help."""
    import requests

    broken = (_HalfAFileError, requests.Timeout, requests.exceptions.ChunkedEncodingError)
    return isinstance(error, broken) or _status(error) in _BUSY


def _status(error: Exception) -> int | None:
    """What an HTTP server said, if it did."""
    return getattr(getattr(error, "response", None), "status_code", None)


def _reason(error: Exception, shelf: Any, transfer: _Transfer) -> str:
    """What went wrong, and what to do."""
    import requests

    file, url = transfer.file, shelf.get_url(transfer.file.path)
    again = "what came whole is kept, and the next run goes on from there"
    if isinstance(error, (_HalfAFileError, requests.exceptions.ChunkedEncodingError)):
        return f"{url}: ended after {transfer.written:,} of {file.size:,} bytes; {again}"
    if (status := _status(error)) in _BUSY:
        return f"{url}: the server is busy ({status}); {again}"
    if status:
        return f"{url}: the server says {status}; --mirror PLACE takes the files from elsewhere"
    if isinstance(error, requests.RequestException):
        return (
            f"{url}: cannot be reached ({type(error).__name__}): is there a network? "
            "--mirror FOLDER takes the files from a folder"
        )
    if isinstance(error, FileNotFoundError) and error.filename == url:
        return f"{url}: the mirror has no such file"
    if isinstance(error, OSError):
        reason = os.strerror(error.errno) if error.errno else one_line(str(error))
        return (
            f"cannot write {shelf.abspath}: {reason}; {CACHE_VARIABLE}=FOLDER names another place"
        )
    if isinstance(error, ValueError):  # pooch says of digests that they differ, and of nothing else
        return (
            f"{url}: not the file that the recipe is for: its SHA-256 is not "
            f"{file.sha256[:12]}...; it is not kept"
        )
    return f"{url}: {described(error)}"
