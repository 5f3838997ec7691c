"""Workers and clusters that end: what becomes of the work, and what is said of it."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from types import ModuleType
from typing import Any

import pytest

from lae_sim.errors import LaeError
from lae_sim.study.executors import at_work


def run_all(
    work: Callable[[Any], Any], items: Iterable[Any], workers: int, scheduler: str | None = None
) -> Generator[tuple[Any, Any], None, None]:
    with at_work(workers, scheduler) as run:
        yield from run(work, items)


def test_an_end_does_not_wait_for_what_workers_are_doing(
    capfd: pytest.CaptureFixture[str],
) -> None:
    began = time.monotonic()
    attempts = run_all(time.sleep, [0, *[600] * 20], 2)
    assert next(attempts) == (0, None)
    attempts.close()
    assert time.monotonic() - began < 100
    assert capfd.readouterr().err == ""
    assert not [thread for thread in threading.enumerate() if "Executor" in thread.name]


class CommClosedError(OSError):
    """As Dask's."""


def _never(*arguments: Any) -> Any:
    raise CommClosedError("in <TCP local>: Stream is closed")


def _cancelled(*arguments: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.cancel()
    future.set_running_or_notify_cancel()
    return future


def _killed(*arguments: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_exception(RuntimeError("attempted to run on 3 workers\n" + "x" * 100_000))
    return future


def _done(work: Callable[[Any], Any], item: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(work(item))
    return future


class Client:
    """A client of a cluster whose scheduler ends, told what comes of work and of closing it."""

    cancelled = False
    submit: Callable[..., Future[Any]]
    nthreads: Callable[[Client], dict[str, int]]

    def __init__(self, address: str, **options: Any) -> None:
        if "no-one" in address:
            raise OSError(f"Timed out trying to connect to {address}")

    def get_executor(self, **options: Any) -> Client:
        return self

    def shutdown(self, wait: bool) -> None:
        assert not wait
        self.__class__.cancelled = True
        raise CommClosedError("Stream is closed")

    def close(self) -> None:
        raise TimeoutError("timed out after 10 s.")


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> type[Client]:
    """The client that ``distributed`` is made to have."""

    class Own(Client):
        submit = staticmethod(_done)
        nthreads = staticmethod(lambda: {"worker": 1})

    def get_address_host_port(address: str) -> tuple[str, int]:
        host, _, port = address.removeprefix("tcp://").partition(":")
        return host, int(port)

    distributed, comm = ModuleType("distributed"), ModuleType("distributed.comm")
    vars(distributed)["Client"] = Own
    vars(comm)["get_address_host_port"] = get_address_host_port
    monkeypatch.setitem(sys.modules, "distributed", distributed)
    monkeypatch.setitem(sys.modules, "distributed.comm", comm)
    return Own


@pytest.mark.parametrize(
    ("name", "fails", "reason"),
    [
        ("submit", _never, "CommClosedError: in <TCP local>"),
        ("submit", _cancelled, "failed, CancelledError;"),
        ("submit", _killed, "RuntimeError: attempted to run on 3 workers x"),
        ("nthreads", _never, "CommClosedError"),
    ],
)
def test_a_scheduler_that_ends_says_that_the_same_command_goes_on(
    client: type[Client], name: str, fails: Callable[..., Any], reason: str
) -> None:
    setattr(client, name, staticmethod(fails))
    with pytest.raises(LaeError) as raised:
        list(run_all(abs, [-1, -2], 1, "tcp://head:8786"))
    message = str(raised.value)
    assert reason in message
    assert message.endswith("the same command goes on from there")
    assert len(message) < 600


def test_what_is_finished_before_counts_though_it_cannot_be_closed(client: type[Client]) -> None:
    finished = run_all(abs, [-1, -2], 1, "tcp://head:8786")
    assert sorted(finished) == [(-2, 2), (-1, 1)]
    assert client.cancelled


@pytest.mark.parametrize("address", ["tcp://no-one:1", "nonsense", "x" * 100_000])
def test_there_is_no_scheduler_at_the_address(client: type[Client], address: str) -> None:
    with pytest.raises(LaeError, match=r"^no Dask scheduler at '") as raised:
        list(run_all(abs, [-1], 1, address))
    assert len(str(raised.value)) < 1500
