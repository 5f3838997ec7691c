"""The report of a study: valid, harmless, the same bytes for the same results."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
from fractions import Fraction
from html.parser import HTMLParser
from itertools import pairwise

import pytest
from nasty import NASTY, nasty_traces

from lae_sim.errors import visible
from lae_sim.evaluation.metrics import CONVENTIONS
from lae_sim.figures import study as study_figures
from lae_sim.report.inline import contrast
from lae_sim.report.page import convention_in_words, page, page_file, write_report
from lae_sim.study.records import Failure
from lae_sim.study.run import compute_study, flat_rows
from lae_sim.study.spec import Study
from lae_sim.study.view import View

VOID = {"meta", "input"}


class Checker(HTMLParser):
    """Refuses tags that do not match; keeps ids, attributes and the text of each tag."""

    def __init__(self, text):
        super().__init__()
        self.open, self.found, self.text = [], [], {}
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open:
            self.text.setdefault(self.open[-1], []).append(data)

    def of(self, tag):
        return [attrs for name, attrs in self.found if name == tag]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nasty")
    study = Study(
        tuple(nasty_traces(folder)),
        fps=(None, Fraction(15)),
        scales=(Fraction(1), Fraction(2)),
        latencies=("constant:20ms", "constant:47ms"),
        sigmas=(Fraction(0), Fraction(1, 2)),
        require_auc=Fraction(1, 2),
    )
    found = compute_study(study, folder / "results", workers=1)
    failure = Failure(f"three {NASTY}", NASTY)
    return dataclasses.replace(found, failures=(failure,))


@pytest.fixture(scope="module")
def html(results):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_figures, "MOST_PAIRS", 2)
        return page(View(results))


@pytest.fixture(scope="module")
def checked(html):
    return Checker(html)


def test_the_page_is_whole_and_has_every_section(checked):
    ids = [attrs["id"] for _, attrs in checked.found if "id" in attrs]
    assert len(ids) == len(set(ids))
    sections = [section["id"] for section in checked.of("section")]
    assert {*sections} == {
        "failures", "ranking", "table2", "curves", "sweeps", "front", "gains", "sequences",
        "attributes", "comparisons", "required", "times", "traces", "conventions", "notes", "study",
    }  # fmt: skip
    assert [a["href"] for a in checked.of("a")] == [f"#{name}" for name in sections]
    assert all(th.get("scope") for th in checked.of("th"))
    assert all(svg.get("aria-label") for svg in checked.of("svg") if svg.get("role") == "img")
    assert all(svg.get("role") == "img" or svg["aria-hidden"] for svg in checked.of("svg"))
    assert len(checked.of("caption")) == len(checked.of("table")) == 6


def test_headings_come_in_order_and_the_conclusion_first(results, checked, html):
    levels = [int(tag[1]) for tag, _ in checked.found if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    first = visible(results.verdict()[0])
    assert checked.text["p"][0] == first
    assert html.index('class="conclusion"') < html.index("<nav") < html.index("<section")


def test_nothing_is_loaded_and_nothing_runs(html, checked):
    assert not checked.of("link")
    assert not checked.of("iframe")
    assert not checked.of("img")
    assert len(checked.of("script")) == 1
    assert "src" not in checked.of("script")[0]
    assert all(found == "#" for found in re.findall(r"url\((.)", html))
    links = [attrs["href"] for _, attrs in checked.found if "href" in attrs]
    assert all(link.startswith("#") for link in links)
    assert not any(name.startswith("on") for _, attrs in checked.found for name in attrs)
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html
    [policy] = [m["content"] for m in checked.of("meta") if "http-equiv" in m]
    assert policy.startswith("default-src 'none'; img-src data:")


def test_what_the_script_alone_can_do_is_hidden_without_it(checked):
    controls = [attrs for _, attrs in checked.found if "controls" in (attrs.get("class") or "")]
    [theme] = [attrs for _, attrs in checked.found if attrs.get("class") == "theme"]
    assert len(controls) == 3
    assert all("hidden" in attrs for attrs in (*controls, theme))
    assert all(button["aria-pressed"] in ("true", "false") for button in checked.of("button"))


def test_pictures_show_what_there_is_several_of(checked):
    said = " ".join(svg.get("aria-label", "") for svg in checked.of("svg"))
    for what in ("permitted latency", "scale of all times", "world rate", "constant latency"):
        assert f"Over {what}" in said


def test_every_colour_of_a_figure_has_another_in_the_dark(html):
    used = {*re.findall(r"var\((--c[0-9a-f]{6}),", html)}
    [dark] = re.findall(r'<style id="dark" media="screen and \(prefers-color-scheme: dark\)">'
                        r"(.*?)</style>", html, re.DOTALL)  # fmt: skip
    assert used
    assert all(f"{name}: #" in dark for name in used)
    names = {*re.findall(r"--[a-z]+(?=:)", page_file("page.css"))}
    assert names - {"--truth", "--glow"} == {*re.findall(r"--[a-z]+(?=:)", page_file("dark.css"))}


def test_colours_of_text_can_be_read_on_both_pages():
    for name in ("page.css", "dark.css"):
        colours = dict(re.findall(r"--(\w+): (#\w+)", page_file(name)))
        for text in ("ink", "soft", "link"):
            for ground in ("page", "head"):
                colour = colours[ground]
                full = colour if len(colour) == 7 else "#" + "".join(2 * c for c in colour[1:])
                assert contrast(colours[text], full) >= 4.5


def test_columns_that_matter_less_are_marked(checked):
    heads = [th for th in checked.of("th") if th["scope"] == "col"]
    assert 10 < sum("data-minor" in th for th in heads) < len(heads) / 2


def test_cells_say_what_the_summary_says(results, checked):
    values = [td["data-v"] for td in checked.of("td") if "data-v" in td]
    first = [row for row in flat_rows(results.summary) if row["sigma"] == "0"]
    assert {str(row["auc"]) for row in first} <= set(values)
    assert "nan" not in values


def test_what_is_left_out_is_said(html):
    assert "6 more settings are in the ranking, and not drawn here." in html


def test_a_study_of_one_trace_and_hold_alone_is_the_same_bytes_twice(tmp_path):
    [path, _] = nasty_traces(tmp_path)
    study = Study((path,), forecasters=("hold",), attributes=False, search="off")
    results = compute_study(study, tmp_path / "results", workers=1)
    text = page(View(results))
    ids = [section["id"] for section in Checker(text).of("section")]
    assert ids == [
        "ranking", "table2", "curves", "front", "sequences", "times", "traces", "conventions",
        "notes", "study",
    ]  # fmt: skip
    assert results.notes() == [
        "initialisation at recorded: the trace's times: whether measured, it does not say"
    ]
    assert "every replay is exact" not in text
    write_report(results, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text("utf-8") == text


def test_conventions_are_told_apart():
    told = {convention_in_words(convention) for convention in CONVENTIONS.values()}
    assert len(told) == len(CONVENTIONS)
    assert "0.952" in convention_in_words(CONVENTIONS["pysot"])


def evaluated(call):
    """What a call of the page's script gives."""
    code = f"{page_file('page.js')}\nconsole.log(JSON.stringify({call}))"
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")


@needs_node
@pytest.mark.parametrize(
    ("values", "descending", "order"),
    [
        ([10, 9, -1, 100], False, [2, 1, 0, 3]),
        ([10, None, 9, 9], True, [0, 2, 3, 1]),
        (["b", "a10", "a9", ""], False, [2, 1, 0, 3]),
    ],
)
def test_sorting(values, descending, order):
    assert evaluated(f"order({json.dumps(values)}, {json.dumps(descending)})") == order


@needs_node
def test_a_saved_figure_is_black_on_white():
    figure = '<path style="fill: var(--cffffff, #ffffff); stroke: var(--c000000, #000000)"/>'
    saved = evaluated(f"light({json.dumps(figure)})")
    assert saved == '<path style="fill: #ffffff; stroke: #000000"/>'


@needs_node
def test_headings_of_groups_are_as_wide_as_what_is_shown_of_them():
    shown = [True, False, True, False, False, True]
    assert evaluated(f"spans([2, 1, 2, 1], {json.dumps(shown)})") == [1, 1, 0, 1]


@needs_node
@pytest.mark.parametrize(("time", "frame"), [(-1, 0), (0.9, 0), (1, 1), (3.9, 2), (4, 3), (9, 3)])
def test_a_place_of_the_timeline_is_the_frame_that_came_last(time, frame):
    assert evaluated(f"frameAt([0, 1, 2, 4], {time})") == frame
