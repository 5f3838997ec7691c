"""Traces made by recipes, and recipes put to the test."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from places import TRACES
from published import FRAMES, SEQUENCES, made_up

import lae_sim
from lae_sim.errors import LaeError
from lae_sim.recipes.catalogue import Recipe
from lae_sim.recipes.make import check_recipe, get_trace


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LAE_SIM_CACHE", str(tmp_path / "cache"))
    return tmp_path


@pytest.fixture
def recipes(place: Path) -> tuple[Recipe, ...]:
    return made_up(place)[1]


def test_boxes_and_measured_times(place: Path, recipes: tuple[Recipe, ...]) -> None:
    trace = get_trace(recipes[0], mirror=place / "mirror")
    assert trace.names == SEQUENCES
    assert trace["car"].elapsed_ns.tolist() == [500_000_000] + [20_000_000] * (FRAMES - 1)
    np.testing.assert_array_equal(trace["car"].boxes[1], [15, 22, 30, 40])
    metadata = trace.metadata
    assert (metadata.tracker, metadata.dataset, metadata.device) == ("KCF", "MadeUp", "a desk")
    assert metadata.timing_note is None
    assert metadata.document["origin"] == recipes[0].origin()
    lae_sim.write_trace(trace, place / "kcf.parquet")
    document = lae_sim.read_trace(place / "kcf.parquet").metadata.document
    assert document["origin"]["boxes"]["licence"] == "CC BY 4.0"
    jsonschema.validate(document, json.loads((TRACES / "metadata.schema.json").read_text()))


def test_boxes_of_an_archive_without_times(place: Path, recipes: tuple[Recipe, ...]) -> None:
    trace = get_trace(recipes[1], mirror=place / "mirror")
    assert trace.names == SEQUENCES
    assert set(trace["car"].elapsed_ns.tolist()) == {47_000_000}
    assert trace.metadata.timing_note == "constant 47 ms, not measured"
    trace = get_trace(recipes[1], time="constant:10ms,init=1s")
    assert trace["car"].elapsed_ns[:2].tolist() == [10**9, 10**7]


def test_a_recipe_is_put_to_the_test(place: Path, recipes: tuple[Recipe, ...]) -> None:
    verdict = check_recipe(recipes[0], mirror=place / "mirror")
    # the boxes are 2 px to the right of the truth: IoU 28/32 passes 18 of 21 thresholds
    assert verdict.auc == pytest.approx(18 / 21)
    assert (verdict.dp20, verdict.sequences, verdict.frames) == (1, 3, 3 * FRAMES)
    assert verdict.holds
    assert not check_recipe(replace(recipes[0], auc=0.8572)).holds
    assert not check_recipe(replace(recipes[0], dp20=0.9999)).holds
    with pytest.raises(LaeError, match="made-up/kcf: 3 sequences, and the recipe says 4"):
        check_recipe(replace(recipes[0], sequences=4))


def test_no_such_recipe() -> None:
    with pytest.raises(LaeError, match="no recipe 'dtb70/none'"):
        get_trace("dtb70/none")
