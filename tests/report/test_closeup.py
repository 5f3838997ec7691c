"""Sequences frame by frame: which, what is shown of them, and how much at most."""

from __future__ import annotations

import base64
import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lae_sim.boxes import iou
from lae_sim.datasets.layouts import find_dataset
from lae_sim.evaluation.evaluate import answers
from lae_sim.report import closeup
from lae_sim.report.closeup import close_ups
from lae_sim.report.page import page
from lae_sim.study.run import compute_study
from lae_sim.study.spec import Study
from lae_sim.study.view import View
from lae_sim.trace.file import Trace, write_trace
from lae_sim.trace.metadata import Metadata
from lae_sim.trace.recording import Recording

NAMES = ["car", "boat", "race", "drone"]


def trace_of(path, images, dataset="synthetic", error=0.0):
    """A trace whose boxes are the truth, and an error, after 70 ms each."""
    recordings = []
    for s, each in enumerate(images):
        wrong = np.random.default_rng(s).normal(0, error, each.truth.shape)
        times = np.full(len(each), 70_000_000)
        recordings.append(Recording.new(each.name, each.truth, each.truth + wrong, times))
    metadata = Metadata.new(
        30, "every-frame", tracker={"name": path.stem}, dataset={"name": dataset}
    )
    write_trace(Trace(metadata, recordings), path)
    return str(path)


@pytest.fixture(scope="module")
def images():
    return find_dataset("synthetic", sequences=NAMES).sequences


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("closeup")


@pytest.fixture(scope="module")
def view(folder, images):
    paths = [trace_of(folder / "good.parquet", images),
             trace_of(folder / "poor.parquet", images, error=9)]  # fmt: skip
    study = Study(tuple(paths), attributes=False, search="off")
    return View(compute_study(study, folder / "results", workers=1))


@pytest.fixture(scope="module")
def found(view):
    return close_ups(view)


def test_the_best_tracker_is_shown_where_forecasting_wins_most_and_least(view, found):
    sequences, [said] = found
    assert said == "3 of 4 sequences of good, the best of the ranking, at the first sigma"
    rows = view.results.to_frame()
    aucs = rows[rows.trace == "good"].pivot_table("auc", "sequence", "forecaster")
    gains = (aucs["kalman"] - aucs["hold"]).sort_values()
    assert [each.name for each in sequences] == [*gains.index[[-1, 0]], gains.index[1]]
    assert sequences[0].why == f"AUC {gains.iloc[-1]:+.3f} from hold to kalman: the most"


def test_what_is_shown_is_what_was_answered(view, found, images):
    first = found[0][0]
    data = json.loads(first.document())
    truth = {each.name: each.truth for each in images}[first.name]
    metadata = view.results.plan.sources[0].metadata
    for f, (name, factory) in enumerate(view.results.plan.forecasters.items(), 1):
        made = answers(first.run, metadata, name, factory)
        np.testing.assert_allclose(data["boxes"][f], made.boxes, atol=0.051)
        np.testing.assert_allclose(data["overlaps"][f - 1], iou(truth, made.boxes), atol=6e-4)
        assert data["ages"] == (np.arange(len(truth)) - made.source_frame).tolist()
    assert data["arrivals"] == [*range(len(truth))]
    assert len(first.calls().split("M")) - 1 == len(first.run.schedule.frames)
    taken, skipped = (first.frames(which).count("M") for which in (True, False))
    assert taken == len(first.run.schedule.frames)
    assert taken + skipped == len(truth)


def test_pictures_are_of_the_frames_that_they_are_said_to_be(found, images):
    by_name = {each.name: each for each in images}
    for each in found[0]:
        assert 10 < len(each.pictures) <= closeup.MOST_PICTURES
        total = sum(len(still.whole) + len(still.target) for still in each.pictures)
        assert total <= closeup.MOST_BYTES
        still, image = each.pictures[3], by_name[each.name].read(each.first + 3)
        whole = cv2.imdecode(np.frombuffer(still.whole, np.uint8), cv2.IMREAD_COLOR)
        expected = cv2.resize(image, whole.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(whole.astype(int) - expected).mean() < 8
        x, y, w, h = still.place
        left, top, width, height = by_name[each.name].truth[each.first + 3]
        assert x <= left + width / 2 <= x + w
        assert y <= top + height / 2 <= y + h
        data = json.loads(each.document())["pictures"][3]
        assert [base64.b64decode(data[0]), data[2:]] == [still.whole, [x, y, w, h]]


def test_what_is_too_much_is_left_out(view, monkeypatch):
    monkeypatch.setattr(closeup, "MOST_FRAMES", 30)
    monkeypatch.setattr(closeup, "MOST_BYTES", 20_000)
    first = close_ups(view)[0][0]
    data = json.loads(first.document())
    assert {len(data[key]) for key in ("arrivals", "ages")} == {30}
    assert len(data["boxes"][0]) == 30
    assert 0 < len(data["pictures"]) < 10
    assert first.start < 30
    assert "30 of" in page(view)


def test_frames_that_are_not_there_are_told(view, folder, images):
    path = trace_of(folder / "other.parquet", images[:2], "DTB70")
    study = Study((path,), attributes=False, search="off", forecasters=("hold",))
    other = View(compute_study(study, folder / "other", workers=1))
    sequences, said = close_ups(other)
    assert said[1:] == ["without frames: lae-sim study --root says where the dataset's images are"]
    assert [each.pictures for each in sequences] == [(), ()]
    assert sequences[0].size == tuple(
        np.ceil(np.max([b[:, :2] + b[:, 2:] for b in (sequences[0].run.recording.truth,
        *(a.boxes for a in sequences[0].answers.values()))], axis=(0, 1)))
    )  # fmt: skip
    assert sequences[0].why.startswith("AUC 0.")
    _, said = close_ups(other, folder)
    assert [line.split(":")[1].strip() for line in said[1:]] == ["no frames"] * 2


def test_images_of_another_length_are_not_shown(folder, images):
    short = [dataclasses.replace(images[0], truth=images[0].truth[:-5])]
    path = trace_of(folder / "short.parquet", short)
    study = Study((path,), attributes=False, search="off")
    view = View(compute_study(study, folder / "short", workers=1))
    [sequence], said = close_ups(view)
    assert not sequence.pictures
    assert len(said) == 2


def test_a_trace_that_has_gone_costs_the_page_its_sequences_alone(folder, images):
    path = trace_of(folder / "gone.parquet", images[:1])
    view = View(compute_study(Study((path,), search="off"), folder / "gone", workers=1))
    Path(path).unlink()
    sequences, [said] = close_ups(view)
    assert sequences == []
    assert said.startswith("no sequence can be looked at: ")
    assert said in page(view)


def test_the_page_holds_them_and_stays_small(view):
    text = page(view)
    assert text.count('<figure class="closeup"') == 3
    assert text.count('href="data:image/jpeg;base64,') == 3
    assert len(text) < 5_000_000
    assert text == page(view)
