"""When kernels are used, that they stay away without numba, and what they are compiled to."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from compiling import needs_numba
from places import REPOSITORY

from lae_sim import _compiled
from lae_sim._compiled import SWITCH, amount, compiled, expect

FEW, MANY = amount(300, 51), amount(10**7, 51)


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names under which numba was asked for, in a process that has not loaded it."""
    asked: list[str] = []

    def works() -> bool:
        asked.append("numba")
        monkeypatch.setitem(sys.modules, "numba", np)  # some module
        return True

    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.setattr(_compiled, "_numba_works", works)
    monkeypatch.delenv(SWITCH, raising=False)
    return asked


def test_little_work_loads_nothing(loaded: list[str]) -> None:
    expect(FEW)
    assert not compiled()
    assert not loaded


def test_much_work_loads_numba_for_all_that_follows(loaded: list[str]) -> None:
    expect(MANY)
    assert loaded
    assert compiled()


def test_it_can_be_switched_off(loaded: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "0")
    expect(MANY)
    assert not compiled()
    assert not loaded


def test_it_can_be_switched_on(loaded: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "1")
    assert compiled()


def test_without_numba_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)  # importing it fails
    monkeypatch.setenv(SWITCH, "1")
    _compiled._numba_works.cache_clear()
    try:
        expect(MANY)
        assert not compiled()
    finally:
        _compiled._numba_works.cache_clear()


RUN = """
import numpy as np
from lae_sim.engine import Clock, Times, latest, simulate_lanes
lanes = [Times(str(k), np.full(90, 47_000_000)) for k in range(9)]
schedules = list(simulate_lanes([90] * 9, Clock.at(30), lanes, latest))
print(schedules[8].frames.tolist())
"""


def in_process(package: Path, **environment: str) -> str:
    command = [sys.executable, "-W", "error", "-c", RUN]
    env = {**os.environ, SWITCH: "1", "PYTHONPATH": str(package), **environment}
    done = subprocess.run(command, env=env, capture_output=True, text=True, cwd=package)
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_numba
def test_processes_may_compile_at_once(tmp_path: Path) -> None:
    cache = str(tmp_path / "cache")
    expected = in_process(REPOSITORY, **{SWITCH: "0"})
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda _: in_process(REPOSITORY, NUMBA_CACHE_DIR=cache), range(3)))
    assert found == [expected] * 3
    assert list(Path(cache).rglob("*.nbi"))
    assert in_process(REPOSITORY, NUMBA_CACHE_DIR=cache) == expected  # of what was kept


def product_and_sum(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    sums = np.empty(len(a))
    for i in range(len(a)):
        sums[i] = a[i] * b[i] + c[i]
    return sums


@needs_numba
def test_no_multiplication_is_fused_with_an_addition() -> None:
    """Which would round once where NumPy rounds twice; and division by 0 is as NumPy's."""
    from lae_sim._compiled import kernel

    a = np.full(64, 1 + 2.0**-30)
    c = -(a * a)
    assert product_and_sum(a, a, c).tolist() == [0.0] * 64  # fused, 2**-60
    assert kernel(product_and_sum)(a, a, c).tolist() == [0.0] * 64


@needs_numba
def test_what_is_compiled_need_not_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in an installation that cannot be written, for a user without a home."""
    import numba

    from lae_sim._compiled import kernel

    tried = []

    def njit(function: object, cache: bool = False, **options: object) -> object:
        tried.append(cache)
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return function

    monkeypatch.setattr(numba, "njit", njit)
    assert kernel(product_and_sum) is product_and_sum
    assert tried == [True, False]
