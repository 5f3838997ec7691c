"""``benchmarks/publish.py`` writes what benchmarks printed onto the page about speed."""

from __future__ import annotations

from pathlib import Path

import pytest
from places import benchmark

publish = benchmark("publish")


def test_the_page_has_a_place_for_each(tmp_path: Path) -> None:
    for name in publish.NAMES:
        (tmp_path / f"{name}.txt").write_text(f"what {name} \\1 printed\n")
    page = publish.published(publish.PAGE.read_text(encoding="utf-8"), tmp_path)
    for name in publish.NAMES:
        mark = f"<!-- made by benchmarks/{name}.py -->"
        assert f"{mark}\n```text\nwhat {name} \\1 printed\n```\n" in page
    assert f"lae_sim {publish.__version__}, Python 3." in page
    assert page.count("## ") == 3


def test_a_page_without_a_place_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="0 places"):
        publish.replaced("# Speed\n", "(a).*(b)", "text")
