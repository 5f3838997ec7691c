"""Computing the cells of a study: on this machine's cores, or on a Dask cluster; resumable."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from typing import Any, Protocol, TypeVar

from lae_sim.decoding import allowing
from lae_sim.errors import LaeError, install, one_line, shown

AHEAD = 3
"""Tasks that are handed out for each worker, so that none waits and few results are held."""

Item = TypeVar("Item")
_GOES_ON = "what is finished is kept, and the same command goes on from there"


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class RunAll(Protocol):
    """Hands items out to workers: each comes back with what a function made of it."""

    def __call__(
        self, work: Callable[[Item], Any], items: Iterable[Item]
    ) -> Generator[tuple[Item, Any], None, None]:
        """Each item with what the function makes of it, as they are finished; to be closed."""


@contextmanager
def at_work(workers: int, scheduler: str | None = None) -> Iterator[RunAll]:
    """Workers for several rounds of work; processes start when there is some.

    Args:
        workers: processes on this machine; with one it runs in this process.
        scheduler: address of a Dask cluster to run on instead.

    Raises:
        LaeError: if there is no such cluster, or Dask is not installed; where the work is handed
            out, if a worker died and nobody takes its place.
    """
    if scheduler is not None:
        with _cluster(scheduler) as (executor, threads):
            yield partial(_handed_out, executor=executor, workers=threads)
    elif workers > 1:
        with _processes(workers) as executor:
            yield partial(_handed_out, executor=executor, workers=lambda: workers)
    else:
        yield run_here


def run_here(
    work: Callable[[Item], Any], items: Iterable[Item]
) -> Generator[tuple[Item, Any], None, None]:
    """Each item with what a function makes of it, in this process."""
    for item in items:
        yield item, work(item)


def _handed_out(
    work: Callable[[Item], Any],
    items: Iterable[Item],
    executor: Executor,
    workers: Callable[[], int],
) -> Generator[tuple[Item, Any], None, None]:
    """Each item with what a function makes of it, by as many workers as there are at the moment."""
    waiting = iter(items)
    work = allowing(work)
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
    except LaeError:
        raise
    except Exception as error:  # a worker lost too often, an import, a scheduler that has ended
        what = f"{type(error).__name__}: {one_line(str(error))[:300]}".removesuffix(": ")
        raise LaeError(f"a worker or its scheduler failed, {what}; {_GOES_ON}") from error


@contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    """Worker processes on this machine."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # not a fork: libraries here have threads
    start = (get_context("spawn"), _begin, (os.getpid(),))
    with ProcessPoolExecutor(workers, *start) as executor:
        try:
            yield executor
        except BaseException:
            for process in [*executor._processes.values()]:
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
def _cluster(address: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """An existing Dask cluster, and how many threads it has at the moment."""
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError as error:
        raise LaeError(
            f"--scheduler needs Dask: {install('distributed')}, here and on the workers"
        ) from error
    log = logging.getLogger("distributed.client")
    level = log.level
    log.setLevel(logging.CRITICAL)  # it would print the tracebacks of what is said in a line here
    try:
        try:
            get_address_host_port(address)  # or a client is left behind that cannot be closed
            client = Client(address, timeout=5, set_as_default=False)
        except (OSError, ValueError) as error:
            raise LaeError(f"no Dask scheduler at {shown(address)}: {error}") from error
        executor = client.get_executor(pure=False, retries=2)
        try:
            yield executor, lambda: max(1, sum(client.nthreads().values()))
        finally:
            with suppress(Exception):  # its scheduler has ended before
                executor.shutdown(wait=False)  # which cancels what is still to be done
            with suppress(Exception):
                client.close()
    finally:
        log.setLevel(level)
