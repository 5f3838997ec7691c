"""One colour for each forecaster, whoever else is in the picture."""

from __future__ import annotations

import pytest

from lae_sim.figures.film import colours_of
from lae_sim.figures.style import (
    forecaster_colours,
    forecaster_lines,
    forecaster_styles,
    tracker_styles,
)
from lae_sim.learning.registry import BUILT_IN

NAMES = [*BUILT_IN, "trained", "tuned-kalman"]


@pytest.mark.parametrize("name", NAMES)
def test_built_in_forecasters_keep_their_colour_in_any_company(name: str) -> None:
    alone = forecaster_colours([name])[name]
    assert forecaster_colours(["mine:Own", *reversed(NAMES)])[name] == alone
    assert forecaster_styles([name])[name]["color"] == alone


def test_colours_differ_while_there_are_any() -> None:
    names = [*NAMES, *(f"kalman:q={q}" for q in range(7))]
    assert len(set(forecaster_colours([*names, "offline"]).values())) == len(names) + 1
    many = forecaster_colours(map(str, range(100)))
    assert len(many) == 100


def test_a_forecaster_of_ones_own_has_a_colour_that_its_name_decides() -> None:
    colour = forecaster_colours(["mine:Own"])["mine:Own"]
    assert forecaster_colours(["hold", "kalman", "mine:Own", "offline"])["mine:Own"] == colour


def test_offline_is_black_and_dashed() -> None:
    style = forecaster_styles(["hold", "offline"])["offline"]
    assert style == {"color": "#000000", "linestyle": "--"}
    lines = forecaster_lines(["hold", "kalman", "offline"])
    assert lines == {"hold": ":", "offline": "--", "kalman": "-"}


def test_films_have_the_same_colours_with_blue_first() -> None:
    assert forecaster_colours(["hold"])["hold"] == "#E69F00"
    assert colours_of(["hold"])["hold"] == (0x00, 0x9F, 0xE6)


def test_trackers_differ_in_colour_or_mark() -> None:
    styles = tracker_styles(f"tracker {i}" for i in range(64))
    assert len({(style["color"], style["marker"]) for style in styles.values()}) == 64
