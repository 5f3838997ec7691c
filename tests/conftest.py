"""Shared fixtures and the hypothesis profile."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from places import REPOSITORY, SHARED

from lae_sim.trace.metadata import Metadata

settings.register_profile(
    "lae_sim",
    deadline=None,  # the machines that run this are shared, so times are noisy
    max_examples=60,
    derandomize=bool(os.environ.get("CI")),
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(  # pytest tests/importers/test_hostile.py --hypothesis-profile fuzz
    "fuzz",
    parent=settings.get_profile("lae_sim"),
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "20000")),
    derandomize=False,
)
settings.load_profile("lae_sim")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real data beside the checkout; the test skips where it is absent."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip("no ../shared/data beside this checkout")
    return folder


@pytest.fixture(scope="session")
def conformance() -> Path:
    """The cases of an independent oracle; the test skips where they are absent."""
    folder = SHARED / "conformance"
    if not folder.is_dir():
        pytest.skip("no ../shared/conformance beside this checkout")
    return folder


@pytest.fixture
def every_frame() -> Metadata:
    """The smallest metadata of a trace of every frame at 30 frames/s."""
    return Metadata.new("30", "every-frame")


@pytest.fixture(autouse=True)
def no_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    """No profile measures the power of the machine that the tests run on, which takes time."""
    monkeypatch.setattr("lae_sim.profile.run.find_sensors", tuple)


@pytest.fixture(scope="session")
def torch() -> Any:
    """The torch module on one thread, since several wait for each other on a busy machine."""
    found = pytest.importorskip("torch", reason="training needs torch")
    found.set_num_threads(1)
    return found
