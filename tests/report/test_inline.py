"""SVG files within the page: its colours, identifiers of their own, nothing that runs."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest
from nasty import NASTY

from lae_sim.errors import visible
from lae_sim.figures.style import forecaster_colours, new_figure, svg_of, tracker_styles
from lae_sim.report.inline import contrast, dark_colours, in_the_dark, inlined

SVG = b"""<?xml version="1.0"?>
<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"
 width="30pt" height="15pt" viewBox="0 0 30 15" onload="alert(1)">
<style>* { fill: red }</style><script>alert(1)</script><image href="http://example.com/a.png"/>
<defs><clipPath id="p1"><rect x="0.12345" y="1" width="30" height="15"/></clipPath>
<path id="m1" d="M 0.5678
L 3 3"/></defs>
<g id="axes_1" clip-path="url(#p1)" onclick="alert(1)"><use xlink:href="#m1" x="1.999" y="2"
 style="fill: #0072b2; stroke: #FFFFFF"/><text id="t">&lt;b&gt; url(#p1)</text></g></svg>"""


@pytest.fixture
def root():
    return ElementTree.fromstring(inlined(SVG, NASTY, "front-1"))


def test_only_what_draws_is_kept(root):
    tags = {each.tag.rpartition("}")[2] for each in root.iter()}
    assert tags == {"svg", "defs", "clipPath", "rect", "path", "g", "use", "text"}
    names = {name for each in root.iter() for name in each.attrib}
    assert not any(name.startswith("on") for name in names)
    assert root.attrib["aria-label"] == NASTY
    [text] = [each for each in root.iter() if each.tag.endswith("}text")]
    assert text.text == "<b> url(#p1)"


def test_identifiers_are_the_figures_own_and_those_that_are_needed(root):
    ids = [each.attrib["id"] for each in root.iter() if "id" in each.attrib]
    assert ids == ["front-1-p1", "front-1-m1"]
    [use] = [each for each in root.iter() if each.tag.endswith("}use")]
    assert use.attrib["href"] == "#front-1-m1"
    assert {each.attrib.get("clip-path") for each in root.iter()} == {None, "url(#front-1-p1)"}


def test_colours_are_variables_that_fall_back_on_themselves(root):
    [use] = [each for each in root.iter() if each.tag.endswith("}use")]
    assert use.attrib["style"] == ("fill: var(--c0072b2, #0072b2); stroke: var(--cffffff, #ffffff)")
    assert dark_colours([SVG.decode()]).keys() == {"--c0072b2", "--cffffff"}


def test_points_become_pixels_and_numbers_are_short(root):
    assert (root.attrib["width"], root.attrib["height"]) == ("40", "20")
    paths = [each.attrib["d"] for each in root.iter() if "d" in each.attrib]
    assert paths == ["M 0.56 L 3 3"]


def test_every_colour_of_figures_can_be_seen_in_the_dark():
    names = [f"mine:Forecaster{i}" for i in range(40)]
    palette = {
        *forecaster_colours(["hold", "kalman", "imm", "trained", "tuned-kalman", *names]).values(),
        *(style["color"] for style in tracker_styles(map(str, range(8))).values()),
        "#000000", "#666666", "#b0b0b0",
    }  # fmt: skip
    page = in_the_dark("#ffffff")
    for colour in map(str.lower, palette):
        assert contrast(in_the_dark(colour), page) >= 4.5
    assert in_the_dark("#e69f00") == "#e69f00"  # bright enough as it is
    assert contrast("#000000", "#ffffff") == pytest.approx(21)


def test_a_figure_of_matplotlib_keeps_its_text_and_takes_all_its_colours():
    figure = new_figure(4, 3)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="#0072B2", marker="o", label=NASTY.replace("$", ""))
    axes.legend()
    text = inlined(svg_of(figure), "a figure", "a-1")
    root = ElementTree.fromstring(text)
    assert visible(NASTY.replace("$", "")) in [
        each.text for each in root.iter() if each.tag.endswith("}text")
    ]
    assert not re.search(r"(?<!, )#[0-9a-f]{6}\b", text)  # none but as a fallback
    assert "<script" not in text
