"""Computing the cells of a study: on this machine's cores, or on a Dask cluster; resumable."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from lae_sim.cells import Cell, Result
from lae_sim.errors import LaeError
from lae_sim.files import written_whole

AHEAD = 3
"""Tasks that are handed out for each worker, so that none waits and few results are held."""

Item = TypeVar("Item")
_CELLS = "[0-9a-f]" * 32 + ".parquet"
_GOES_ON = "what is finished is kept, and the same command goes on from there"


class Store:
    """The folder of a study's finished cells.

    ``results`` holds exactly the cells of the plan, as one Parquet dataset; ``about`` says more of
    each; ``unused`` keeps finished cells of other plans, in case they are wanted again.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.results, self._about, self._unused = (
            self.folder / name for name in ("results", "about", "unused")
        )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other studies out of the folder, where the system can.

        Raises:
            LaeError: if one is at work there.
        """
        try:
            import fcntl
        except ImportError:  # Windows
            yield
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.folder, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
        except BlockingIOError as error:
            raise LaeError(f"{self.folder}: another study is writing there") from error
        finally:
            os.close(descriptor)

    def prepare(self, cells: Iterable[Cell]) -> None:
        """Make the folder, bring the cells of the plan back, and set those of others aside.

        Raises:
            LaeError: if it cannot be written, or is a folder of something else.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            folders = (self.results, self._about, self._unused)
            if any(self.folder.iterdir()) and not all(path.is_dir() for path in folders):
                raise LaeError(f"{self.folder}: is not empty and not of a study: name another")
            for path in folders:
                path.mkdir(exist_ok=True)
            wanted = {f"{cell.key}.parquet" for cell in cells}
            for path in self.results.glob(_CELLS):
                if path.name not in wanted:
                    path.replace(self._unused / path.name)
            for path in self._unused.glob(_CELLS):
                if path.name in wanted:
                    path.replace(self.results / path.name)
        except OSError as error:
            raise LaeError(f"{self.folder}: {error.strerror or error}") from error

    def has(self, cell: Cell) -> bool:
        """Whether a cell is finished."""
        return self.rows(cell).is_file() and self._details(cell.key).is_file()

    def put(self, result: Result) -> None:
        """Keep a result; its rows come last, and say that it is finished."""
        self.keep(result.key, result.about)
        with written_whole(self.results / f"{result.key}.parquet") as temporary:
            temporary.write_bytes(result.rows)

    def found(self, key: str) -> dict[str, Any] | None:
        """A document that was kept under a key, if it was."""
        path = self._details(key)
        return self._read(path) if path.is_file() else None

    def keep(self, key: str, document: Any) -> None:
        """Keep a document under a key."""
        with written_whole(self._details(key)) as temporary:
            temporary.write_text(json.dumps(document, allow_nan=False))

    def rows(self, cell: Cell) -> Path:
        """The file of a cell's rows."""
        return self.results / f"{cell.key}.parquet"

    def about(self, cell: Cell) -> dict[str, Any]:
        """What is known of a finished cell beside its rows (see :class:`Result`).

        Raises:
            LaeError: if its file is damaged.
        """
        return self._read(self._details(cell.key))

    def _read(self, path: Path) -> dict[str, Any]:
        try:
            found: dict[str, Any] = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise LaeError(f"{path}: cannot be read: {error}; delete it") from error
        return found

    def _details(self, key: str) -> Path:
        return self._about / f"{key}.json"


def run_all(
    work: Callable[[Item], Any],
    items: Iterable[Item],
    executor: Executor | None = None,
    workers: Callable[[], int] = lambda: 1,
) -> Iterator[tuple[Item, Any]]:
    """Each item with what a function makes of it, as they are finished.

    Args:
        work: a function of a module, that workers can import.
        items: handed out as workers become free.
        executor: where it runs; in this process if None.
        workers: how many there are at the moment.

    Raises:
        LaeError: if a worker died, and nobody takes its place.
    """
    if executor is None:
        for item in items:
            yield item, work(item)
        return
    waiting = iter(items)
    running: dict[Future[Any], Item] = {}
    try:
        while True:
            for item in islice(waiting, max(AHEAD * workers() - len(running), 0)):
                running[executor.submit(work, item)] = item
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()
    except BrokenExecutor as error:
        raise LaeError(
            "a worker died, for want of memory or, in a script, of 'if __name__ == \"__main__\":': "
            + _GOES_ON
        ) from error
    except (LaeError, OSError):
        raise
    except Exception as error:  # whatever a cluster has to say: a worker lost too often, an import
        told = " ".join(str(error).split())[:300]
        raise LaeError(f"a worker failed, {type(error).__name__}: {told}; {_GOES_ON}") from error
    finally:
        for future in running:
            future.cancel()


@contextmanager
def local_executor(workers: int) -> Iterator[Executor]:
    """Worker processes on this machine."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # not a fork: libraries here have threads
    start = (get_context("spawn"), _begin, (os.getpid(),))
    with ProcessPoolExecutor(workers, *start) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for process in list((getattr(executor, "_processes", None) or {}).values()):
                process.terminate()  # or the end would wait for what they are doing
            raise


def _begin(parent: int) -> None:
    """Begin a worker: Ctrl-C is for its parent alone, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def cluster_executor(address: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """An existing Dask cluster, and how many threads it has at the moment.

    Raises:
        LaeError: if Dask is not installed, or there is no scheduler at the address.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise LaeError(
            "--scheduler needs Dask: pip install 'lae-sim[distributed]', here and on the workers"
        ) from error
    try:
        client = Client(address, timeout=5, set_as_default=False)
    except (OSError, ValueError) as error:
        raise LaeError(f"no Dask scheduler at {address}: {error}") from error
    with client:
        yield (
            client.get_executor(pure=False, retries=2),
            lambda: max(1, sum(client.nthreads().values())),
        )
