"""``lae-sim get``: lists, makes and checks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from command_line import run_here
from places import REPOSITORY
from published import ROOT, made_up, served

import lae_sim
from lae_sim.recipes import catalogue

SCHEMA = REPOSITORY / "docs" / "reference" / "schemas" / "get.schema.json"


@pytest.fixture
def mirror(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A mirror of a made-up repository, whose recipes are all there are."""
    mirror, recipes = made_up(tmp_path)
    monkeypatch.setenv("LAE_SIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(catalogue, "list_recipes", lambda: recipes)
    return mirror


def get(folder: Path, *arguments: object) -> str:
    """What the command prints where all goes well."""
    done = run_here("get", *arguments, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout


def refused(folder: Path, *arguments: object) -> str:
    """What the command complains of."""
    done = run_here("get", *arguments, cwd=folder)
    assert done.returncode == 2, done.stdout
    assert "Traceback" not in done.stderr
    return done.stderr


def document(text: str) -> Any:
    found = json.loads(text)
    if "traces" not in found:  # whose schema is of two files
        jsonschema.validate(found, json.loads(SCHEMA.read_text("utf-8")))
    return found


def test_the_list_has_a_line_a_recipe(tmp_path: Path) -> None:
    lines = get(tmp_path).splitlines()
    names = [recipe.name for recipe in lae_sim.list_recipes()]
    assert [line.split()[0] for line in lines[2:-2]] == names
    assert max(map(len, lines)) <= 100
    (line,) = (line for line in lines if line.startswith("dtb70/nanotrackv3 "))
    assert line.split() == [
        *("dtb70/nanotrackv3", "NanoTrackV3", "not", "published"),
        *("70", "0.629", "0.813", "2.6"),
    ]


def test_the_list_as_json(tmp_path: Path) -> None:
    found = document(get(tmp_path, "--json"))
    assert (found["format"], found["version"]) == ("lae-get", "1.0")
    recipes = {recipe["name"]: recipe for recipe in found["recipes"]}
    kcf = recipes["otb100/kcf"]
    assert (kcf["times"], kcf["sequences"], kcf["files"]) == ("measured per frame", 100, 300)
    assert kcf["origin"]["boxes"]["licence"] == "none stated"


def test_a_trace_is_made_from_a_server_and_again_without_it(mirror: Path, tmp_path: Path) -> None:
    with served(mirror) as server:
        text = get(tmp_path, "made-up/kcf", "--mirror", server.url)
    assert text.splitlines() == [
        "made-up-kcf.parquet: KCF on MadeUp, 3 sequences, 60 frames at 30 fps, every frame; "
        "median 20 ms a frame. Read as got10k; times: measured.",
        "Times read as seconds per frame, as no unit was given.",
        "Device: a desk.",
        "Boxes: https://github.com/someone/results at 0123456789ab; licence: CC BY 4.0.",
        "Truth: https://github.com/someone/results at 0123456789ab; licence: CC BY 4.0.",
        "Cite: Someone, Results, 2020.",
        "Cite: Another, A Dataset, 2019.",
        "Next: lae-sim replay made-up-kcf.parquet",
    ]
    first = (tmp_path / "made-up-kcf.parquet").read_bytes()
    assert get(tmp_path, "made-up/kcf", "--out", "k.parquet").startswith("k.parquet: KCF on MadeUp")
    assert (tmp_path / "k.parquet").read_bytes() == first
    shown = "".join(run_here("show", "k.parquet", cwd=tmp_path).stdout.split())  # unwrapped
    assert "recipemade-up/kcf" in shown
    assert "licenceCCBY4.0" in shown


def test_times_that_nobody_published_are_named_so(mirror: Path, tmp_path: Path) -> None:
    text = get(tmp_path, "made-up/nano", "--mirror", mirror)
    assert "times: constant 47 ms, not measured." in text
    assert "No times were published: --time here, or --latency of lae-sim replay, sets" in text
    text = get(tmp_path, "made-up/nano", "--time", "mean-fps:50")
    assert "median 20 ms a frame. Read as ope; times: mean fps 50 given, not measured per" in text


def test_several_at_once_as_json(mirror: Path, tmp_path: Path) -> None:
    found = document(get(tmp_path, "made-up/kcf", "made-up/nano", "--mirror", mirror, "--json"))
    assert [each["conversion"]["trace"] for each in found["traces"]] == [
        "made-up-kcf.parquet",
        "made-up-nano.parquet",
    ]
    assert found["traces"][1]["origin"]["boxes"]["inside"] == "All/DTB/nano/"
    assert len(lae_sim.read_trace(tmp_path / "made-up-nano.parquet")) == 3


def test_a_failed_download_leaves_no_trace(mirror: Path, tmp_path: Path) -> None:
    (mirror / ROOT / "kcf" / "car.txt").write_text("1,2,3,4\n" * 90, "utf-8")
    said = refused(tmp_path, "made-up/kcf", "--mirror", mirror)
    assert "kcf/car.txt: not the file that the recipe is for" in said
    assert said.count("\n") == 1
    assert not list(tmp_path.glob("*.parquet"))
    with served(mirror) as server:
        pass
    said = refused(tmp_path, "made-up/kcf", "--mirror", server.url)
    assert "cannot be reached (ConnectionError): is there a network? --mirror FOLDER" in said


def test_another_trace_is_not_replaced(mirror: Path, tmp_path: Path) -> None:
    get(tmp_path, "made-up/kcf", "--mirror", mirror, "--out", "t.parquet")
    get(tmp_path, "made-up/kcf", "--out", "t.parquet")
    said = refused(tmp_path, "made-up/nano", "--mirror", mirror, "--out", "t.parquet")
    assert "t.parquet is there already, a trace of 'KCF' on 'MadeUp'; --force replaces it" in said
    get(tmp_path, "made-up/nano", "--mirror", mirror, "--out", "t.parquet", "--force")
    assert lae_sim.read_trace(tmp_path / "t.parquet").metadata.tracker == "Nano"


def test_recipes_are_checked(mirror: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = get(tmp_path, "--check", "--mirror", mirror)
    assert [line.split()[0] for line in text.splitlines()] == ["made-up/kcf", "made-up/nano"]
    assert text.count("AUC 0.8571  DP 1.0000  as stated") == 2
    assert not list(tmp_path.glob("*.parquet"))
    (mirror / ROOT / "nano.zip").write_bytes(b"PK" * 400)
    (tmp_path / "cache" / ROOT / "nano.zip").unlink()
    done = run_here("get", "--check", "--json", "--mirror", mirror, cwd=tmp_path)
    assert done.returncode == 2
    kcf, nano = document(done.stdout)["checks"]
    assert (kcf["holds"], nano["holds"]) == (True, False)
    assert "nano.zip" in nano["error"]
    assert "1 of 2 recipes fail: made-up/nano" in done.stderr
    done = run_here("get", "--check", "made-up/kcf", cwd=tmp_path)
    assert done.returncode == 0


def test_a_score_that_is_not_as_stated_fails(
    mirror: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataclasses import replace

    recipes = [replace(recipe, auc=0.5) for recipe in catalogue.list_recipes()]
    monkeypatch.setattr(catalogue, "list_recipes", lambda: recipes)
    done = run_here("get", "--check", "made-up/kcf", "--mirror", mirror, cwd=tmp_path)
    assert done.returncode == 2
    assert "AUC 0.8571  DP 1.0000  NOT AS STATED: AUC 0.5000, DP 1.0000" in done.stdout
    assert "1 of 1 recipes fail: made-up/kcf" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["made-up/kfc"], "no recipe 'made-up/kfc'; did you mean 'made-up/kcf'?"),
        (["--out", "t.parquet"], "--out is where the trace of one NAME goes"),
        (["made-up/kcf", "made-up/nano", "--out", "t.parquet"], "--out is where the trace of one"),
        (["made-up/kcf", "--check", "--out", "t.parquet"], "--out is where the trace of one NAME"),
        (["--time", "constant:1ms"], "--time goes with the NAME of what is to be made"),
        (["made-up/kcf", "--mirror", "nowhere"], "--mirror nowhere: no such folder"),
        (["made-up/kcf", "--out", "no/t.parquet"], "no/t.parquet"),
        (["made-up/kcf", "--time", "47"], "time: no '47'"),
    ],
)
def test_what_is_refused(
    mirror: Path, tmp_path: Path, arguments: list[str], complaint: str
) -> None:
    place = [] if "--mirror" in arguments else ["--mirror", str(mirror)]
    assert complaint in refused(tmp_path, *arguments, *place)
