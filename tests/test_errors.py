"""What errors quote: visible, and never longer than a screen."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.errors import LaeError, abridged, listed, shown, visible


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("car\x1b[2J", r"car\x1b[2J"),
        ("a\rb\0\n\t", r"a\rb\x00\n\t"),
        ("\u202eabc\u2066", r"\u202eabc\u2066"),
        ("\udcff", r"\udcff"),
        ("\x9b31m", r"\x9b31m"),  # what ESC [ is in one character
        ("[red]x[/red] [/] 追踪 é", "[red]x[/red] [/] 追踪 é"),
    ],
)
def test_control_characters_are_seen(text: str, seen: str) -> None:
    assert visible(text) == seen
    assert str(LaeError(text)) == seen


@given(st.text() | st.text(st.characters(categories=["Cc", "Cf", "Cs", "Zl", "Zp"])))
def test_all_text_can_be_printed_and_written(text: str) -> None:
    seen = visible(text)
    assert seen.isprintable()
    seen.encode()
    assert visible(seen) == seen
    assert visible(text, keep="\n").count("\n") == text.count("\n")


@pytest.mark.parametrize("length", [0, 1199, 1200, 1201, 100_000])
def test_an_error_fits_a_screen_and_keeps_its_end(length: int) -> None:
    text = str(LaeError(f"begin {'x' * length}: what to do"))
    assert len(text) <= 1200
    assert text.startswith("begin")
    assert text.endswith(": what to do")
    assert len(abridged("\x1b" * length, 60)) <= 60


def test_lists_are_cut() -> None:
    names = [f"car{i}" for i in range(4215)]
    assert listed(names) == "car0, car1, car2, car3, car4 and 4,210 more"
    assert listed(names[:2]) == "car0, car1"
    assert len(listed(["x" * 100_000] * 9)) < 400
    assert len(shown("x" * 100_000)) == 60
