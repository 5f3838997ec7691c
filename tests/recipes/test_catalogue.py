"""The recipes that come with the package, and how recipes are read."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path, PurePosixPath

import pytest
from published import COMMIT, ROOT, made_up, publish, write_recipes

from lae_sim.errors import LaeError
from lae_sim.recipes.catalogue import PACKAGED, STAND_IN, Recipe, find_recipe, list_recipes

RECIPES = list_recipes()


def test_there_are_recipes_of_each_dataset_some_with_measured_times() -> None:
    names = [recipe.name for recipe in RECIPES]
    assert len(names) == len(set(names)) >= 25
    datasets = Counter(recipe.name.split("/")[0] for recipe in RECIPES)
    assert datasets.keys() >= {"dtb70", "uavdt", "uav123", "otb100", "visdrone"}
    assert sum(recipe.times == "measured per frame" for recipe in RECIPES) >= 3
    assert all(recipe.time == STAND_IN for recipe in RECIPES if recipe.times == "not published")


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.name)
def test_a_recipe_says_what_is_to_be_known(recipe: Recipe) -> None:
    assert re.fullmatch(r"[a-z0-9_]+/[a-z0-9+-]+", recipe.name)
    assert 0 < recipe.auc < recipe.dp20 < 1
    assert recipe.citations
    assert all(recipe.citations)
    for source in (recipe.boxes, recipe.truth):
        repository = source.repository
        assert re.fullmatch(r"https://github\.com/[\w.-]+/[\w.-]+", repository.url)
        assert re.fullmatch(r"[0-9a-f]{40}", repository.commit)
        assert repository.licence
        assert source.path.endswith((".zip", "/"))
        assert bool(source.inside) == source.path.endswith(".zip")
        for file in source.files:
            assert re.fullmatch(r"[0-9a-f]{64}", file.sha256)
            assert file.size > 0
            for path in (file.path, file.name):
                assert ".." not in PurePosixPath(path).parts
                assert not PurePosixPath(path).is_absolute()
            assert file.path.startswith(f"{repository.root}/")
        assert len({file.name for file in source.files}) == len(source.files)
    boxes = [f for f in recipe.boxes.files if not f.name.startswith("times/")]
    assert len(boxes) == (1 if recipe.boxes.inside else recipe.sequences)
    truths = [file for file in recipe.truth.files if not file.name.startswith("att/")]
    assert len(truths) == recipe.sequences


def test_the_digests_are_small_and_each_is_of_a_recipe() -> None:
    lists = sorted((PACKAGED / "digests").glob("*.txt"))
    assert sum(path.stat().st_size for path in lists) < 400_000
    listed = [
        line
        for path in lists
        for line in path.read_text("utf-8").splitlines()
        if not line.startswith("#") and not line.endswith("/")
    ]
    needed = {file.path: file.sha256 for recipe in RECIPES for file in recipe.files}
    assert Counter(line.split(" ")[0] for line in listed) == Counter(needed.values())


def test_recipes_are_read_from_a_folder(tmp_path: Path) -> None:
    _, recipes = made_up(tmp_path)
    kcf, nano = recipes
    assert (kcf.name, kcf.times, kcf.time) == ("made-up/kcf", "measured per frame", "measured")
    assert (nano.name, nano.times, nano.time) == ("made-up/nano", "not published", STAND_IN)
    assert [file.name for file in kcf.truth.files] == ["bike.txt", "boat.txt", "car.txt"]
    assert kcf.truth.files[0].path == f"{ROOT}/anno/Bike.txt"
    assert {file.name for file in kcf.boxes.files} > {"car.txt", "times/car_time.txt"}
    assert [file.name for file in nano.boxes.files] == ["nano.zip"]
    assert kcf.file_name == "made-up-kcf.parquet"
    assert kcf.origin() == {
        "recipe": "made-up/kcf",
        "cite": ["Someone, Results, 2020", "Another, A Dataset, 2019"],
        "boxes": {
            "repository": "https://github.com/someone/results",
            "commit": COMMIT,
            "path": "kcf/",
            "licence": "CC BY 4.0",
        },
        "truth": {
            "repository": "https://github.com/someone/results",
            "commit": COMMIT,
            "path": "anno/",
            "licence": "CC BY 4.0",
        },
    }
    assert nano.origin()["boxes"]["inside"] == "All/DTB/nano/"


def test_a_recipe_without_digests_is_refused(tmp_path: Path) -> None:
    recipes = write_recipes(tmp_path, publish(tmp_path))
    text = (recipes / "made-up.toml").read_text("utf-8")
    (recipes / "made-up.toml").write_text(text.replace('"kcf/"', '"csk/"'), "utf-8")
    with pytest.raises(LaeError, match=r"github\.com/someone/results: no digests of csk/"):
        list_recipes(recipes)


def test_a_recipe_is_found_by_its_name(tmp_path: Path) -> None:
    _, recipes = made_up(tmp_path)
    assert find_recipe("Made-Up/KCF", recipes) is recipes[0]
    with pytest.raises(LaeError, match="no recipe 'made-up/kfc'; did you mean 'made-up/kcf'"):
        find_recipe("made-up/kfc", recipes)
    with pytest.raises(LaeError, match="no recipe 47; lae-sim get lists those there are"):
        find_recipe(47, recipes)  # type: ignore[arg-type]
    for dataset in ("made-up", "Made-Up/", "made-up/*"):
        with pytest.raises(LaeError, match="is a dataset; name its trackers: made-up/kcf"):
            find_recipe(dataset, recipes)
    assert find_recipe("dtb70/nanotrackv3").sequences == 70
