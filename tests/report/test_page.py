"""The report of a study: valid, harmless, the same bytes for the same results."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
import subprocess
from fractions import Fraction
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from nasty import NASTY, nasty_traces

from lae_sim.evaluation.metrics import CONVENTIONS
from lae_sim.figures import study as study_figures
from lae_sim.report.page import convention_in_words, page, page_file, write_report
from lae_sim.study.records import Failure
from lae_sim.study.run import compute_study, flat_rows
from lae_sim.study.spec import Study
from lae_sim.study.view import View

VOID = {"meta", "img", "br"}


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
    assert {*ids} == {
        "failures", "ranking", "table2", "curves", "sweeps", "front", "gains", "attributes",
        "comparisons", "required", "times", "traces", "conventions", "notes", "study",
    }  # fmt: skip
    assert [a["href"] for a in checked.of("a")] == [f"#{name}" for name in ids]
    assert all(th.get("scope") for th in checked.of("th"))
    assert all(image["alt"] for image in checked.of("img"))
    assert len(checked.of("caption")) == len(checked.of("table")) == 6


def test_nothing_is_loaded_and_nothing_runs(html, checked):
    assert not checked.of("link")
    assert not checked.of("iframe")
    assert len(checked.of("script")) == 1
    assert "src" not in checked.of("script")[0]
    assert all(image["src"].startswith("data:image/svg+xml;base64,") for image in checked.of("img"))
    assert "url(" not in html
    assert not any(name.startswith("on") for _, attrs in checked.found for name in attrs)
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html
    [policy] = [m["content"] for m in checked.of("meta") if "http-equiv" in m]
    assert policy.startswith("default-src 'none'; img-src data:")


def test_pictures_are_svg_and_show_what_there_is_several_of(checked):
    for image in checked.of("img"):
        svg = base64.b64decode(image["src"].partition(",")[2])
        root = ElementTree.fromstring(svg)
        assert root.tag.endswith("}svg")
        assert not list(root.iter("{http://www.w3.org/2000/svg}script"))
        links = re.findall(rb'href="(.)', svg)
        assert set(links) <= {b"#"}
    alts = " ".join(image["alt"] for image in checked.of("img"))
    for what in ("permitted latency", "scale of all times", "world rate", "constant latency"):
        assert f"Over {what}" in alts


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
    ids = [attrs["id"] for _, attrs in Checker(text).found if "id" in attrs]
    assert ids == [
        "ranking", "table2", "curves", "front", "times", "traces", "conventions", "notes", "study"
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


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
@pytest.mark.parametrize(
    ("values", "descending", "order"),
    [
        ([10, 9, -1, 100], False, [2, 1, 0, 3]),
        ([10, None, 9, 9], True, [0, 2, 3, 1]),
        (["b", "a10", "a9", ""], False, [2, 1, 0, 3]),
    ],
)
def test_sorting(values, descending, order):
    call = f"order({json.dumps(values)}, {json.dumps(descending)})"
    code = f"{page_file('page.js')}\nconsole.log(JSON.stringify({call}))"
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == order
