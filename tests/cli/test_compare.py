"""The compare command line as a user runs it: what it prints and writes, exit statuses.

Much of it runs in this process, since importing pandas and scipy takes longer than the work.
"""

from __future__ import annotations

import json
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import ENVIRONMENT, command, run_here, run_process
from places import REPOSITORY
from restarted import gap_pass

import lae_sim

SLOW = REPOSITORY / "traces" / "synthetic-slow.parquet"
FAST = REPOSITORY / "traces" / "synthetic-fast.parquet"
REAL_TIME = REPOSITORY / "traces" / "synthetic-slow-realtime.parquet"
FEW = ["--sequence", "bike-pan", "car-chase", "person-crowd"]


def compare(*arguments: object, cwd: Path | None = None, status: int = 0) -> str:
    """Run the command and return what it printed; its error text if it fails as expected."""
    return checked(run_process("compare", *arguments, cwd=cwd), status)


def compare_here(*arguments: object, status: int = 0) -> str:
    """The same in this process."""
    return checked(run_here("compare", *arguments), status)


def checked(done: subprocess.CompletedProcess[str], status: int) -> str:
    assert done.returncode == status, done.stderr
    assert "" in (done.stdout, done.stderr)  # no progress bar where nobody looks
    return done.stderr if status else done.stdout


MUCH = [
    *(SLOW, REAL_TIME, *FEW, "--json", "--attributes", "--folds", 3, "--cost", "kalman=1ms"),
    *("--forecaster", "kalman", "constant-velocity", "tuned-kalman", "--sigma", 1, "1/2"),
]


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """One run with much at once: its JSON object, and the folder of what it wrote."""
    folder = tmp_path_factory.mktemp("everything")
    printed = compare_here(
        *(*MUCH, "--seed", 4, "--out", folder / "all.csv", "--plot", folder / "all.svg"),
    )
    return json.loads(printed), folder


def test_the_table_of_the_default(tmp_path: Path) -> None:
    path = tmp_path / "all.parquet"
    printed = compare(SLOW, *FEW, "--latency", "recorded", "constant:20ms", "--out", path)
    lines = printed.splitlines()
    assert lines[0] == "trace synthetic-slow.parquet, sigma 0"
    assert lines[2].split()[:6] == ["latency", "forecaster", "n", "AUC", "recovered", "vs"]
    names = ["hold", "learned", "kalman", "least-squares", "tuned-kalman", "offline"]
    rows = [line.split()[:3] for line in lines[4:16]]
    assert rows == [[latency, n, "3"] for latency in ("recorded", "constant:20ms") for n in names]
    assert "tuned-kalman: trained in 3 folds over 3 sequences" in printed
    assert "bootstrap over sequences" in printed
    assert "synthetic-slow.parquet, recorded: approximate" in printed
    assert "convention pysot, policy latest" in printed
    table = pd.read_parquet(path)
    for latency, line in (("recorded", lines[6]), ("constant:20ms", lines[12])):
        chosen = table[(table["latency"] == latency) & (table["metric"] == "auc")]
        mean = chosen.loc[chosen["forecaster"] == "kalman", "value"].mean()
        assert line.split()[3] == f"{mean:.3f}"


def test_the_json_object(everything: tuple[dict[str, Any], Path]) -> None:
    document, _ = everything
    assert document["format"] == "lae-compare"
    assert document["version"] == "1.0"
    assert document["lae_sim"] == lae_sim.__version__
    assert document["traces"] == [str(SLOW), str(REAL_TIME)]
    assert (document["convention"], document["policy"], document["seed"]) == ("pysot", "latest", 4)
    assert "seed 4" in document["method"]
    assert any("kalman 1000 us" in note for note in document["notes"])
    assert any("trained in 3 folds" in note for note in document["notes"])
    for rows in (document["summary"], document["attributes"]):
        assert len({frozenset(row) for row in rows}) == 1
        for row in rows:
            assert row["sequences"] > 0
            assert 0 <= row["low"] <= row["mean"] <= row["high"] <= 1
            assert row["vs_hold_better"] + row["vs_hold_worse"] <= row["sequences"]
            assert row["recovered"] is None or row["trace"] == SLOW.name
    first = document["summary"][0]
    assert {"trace", "latency", "scale", "sigma", "forecaster", "metric"} < set(first)
    traces = {row["trace"] for row in document["summary"]}
    assert traces == {SLOW.name, REAL_TIME.name, "all traces"}
    assert {row["sigma"] for row in document["summary"]} == {0.5, 1.0}
    named = {row["attribute"] for row in document["attributes"]}
    assert {"all sequences", "Fast camera motion", "Occlusion"} <= named


def test_what_initialisation_costs_is_said_of_each_replay() -> None:
    latencies = ("constant:20ms,init=1s", "constant:20ms")
    options = (SLOW, *FEW, "--forecaster", "kalman", "--latency", *latencies)
    document = json.loads(compare_here(*options, "--json"))
    said = [(each["latency"], each["mean_ms"], each["source"]) for each in document["init"]]
    assert said == [
        ("constant:20ms,init=1s", 1000, "assumed: 1000 ms"),
        ("constant:20ms", 20, "assumed: as a frame"),
    ]
    assert document["init"][0]["left_search"]
    assert document["init"][1]["left_search"] == []
    text = compare_here(*options)
    assert "constant:20ms,init=1s: initialisation costs 1,000 ms: an assumption" in text
    assert "constant:20ms: initialisation costs 20 ms, the same as a frame: an assumption" in text


def test_the_table_that_is_written(everything: tuple[dict[str, Any], Path]) -> None:
    document, folder = everything
    table = pd.read_csv(folder / "all.csv")
    assert list(table) == [
        *("trace", "dataset", "sequence", "latency", "scale", "forecaster", "sigma", "metric"),
        "value",
    ]
    assert set(table["sequence"]) == set(FEW[1:])
    for row in document["summary"]:
        if row["trace"] != "all traces":
            keys = ["trace", "latency", "scale", "sigma", "forecaster", "metric"]
            chosen = table
            for key in keys:
                chosen = chosen[chosen[key] == row[key]]
            assert row["mean"] == pytest.approx(chosen["value"].mean(), abs=1e-12)
    assert (folder / "all.svg").read_text().lstrip().startswith("<?xml")
    assert sorted(path.name for path in folder.iterdir()) == ["all.csv", "all.svg"]


def test_the_same_command_prints_and_writes_the_same(
    everything: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    document, folder = everything
    again = compare_here(*MUCH, "--seed", 4, "--out", tmp_path / "all.csv")
    assert json.loads(again) == document
    assert (tmp_path / "all.csv").read_bytes() == (folder / "all.csv").read_bytes()


def test_the_seed_is_of_the_bootstrap_too(tmp_path: Path) -> None:
    options = [SLOW, "--forecaster", "hold", "--json"]
    one, other = (
        json.loads(compare_here(*options, "--seed", seed, "--plot", tmp_path / f"{seed}.png"))
        for seed in (1, 2)
    )
    for row, its in zip(one["summary"], other["summary"]):
        assert row["mean"] == its["mean"]
    assert [row["low"] for row in one["summary"]] != [row["low"] for row in other["summary"]]
    assert (tmp_path / "1.png").read_bytes()[:4] == b"\x89PNG"


def test_scales_and_the_grid_of_sigmas(tmp_path: Path) -> None:
    path = tmp_path / "all.parquet"
    options = ["--forecaster", "constant-velocity", "--latency-scale", "1/2", "2", "--sigma-grid"]
    compare_here(FAST, "--sequence", "bike-pan", *options, "--out", path, "--json")
    table = pd.read_parquet(path)
    assert set(table["scale"]) == {0.5, 2.0}
    assert len(set(table["sigma"])) == 51
    assert len(table[~table["metric"].str.startswith("modelled_")]) == 2 * 51 * 4 * 3
    assert np.isfinite(table["value"]).all()


def test_the_search_model_beside_and_off(tmp_path: Path) -> None:
    options = (SLOW, *FEW, "--forecaster", "kalman", "--latency", "constant:1ms", "constant:90ms")
    document = json.loads(compare_here(*options, "--search", "c=0.3", "--json"))
    assert document["ranked_by"] == "modelled"
    assert [each["source"] for each in document["search"]] == ["c = 0.3, as given"]
    for row in document["summary"]:
        exact = row["latency"] == "constant:1ms"
        assert (row["modelled"] is None) == (exact or row["forecaster"] == "offline")
        if row["modelled"]:
            assert row["modelled"]["c_known"]
            low, auc, high = (row["modelled"][f"auc{end}"] for end in ("_low", "", "_high"))
            assert low < auc < high
            assert row["metric"] != "modelled_auc" or row["mean"] == pytest.approx(auc)
    gaps = gap_pass(lae_sim.read_trace(SLOW).metadata, tmp_path / "slow.gaps.parquet")
    measured = json.loads(compare_here(*options, "--strided", gaps, "--json"))
    assert "measured by 400 restarts" in measured["search"][0]["source"]
    assert measured["search"][0]["reach"]["centre"] == pytest.approx(0.3, abs=0.05)
    assert measured["ranked_by"] == "modelled"
    off = json.loads(compare_here(*options, "--search", "off", "--json"))
    assert (off["ranked_by"], off["search"]) == ("recorded", [])
    assert {row["modelled"] for row in off["summary"]} == {None}
    assert "ranked by" not in compare_here(*options, "--search", "off")
    text = compare_here(*options, "--search", "c=0.3", "--pre-forecaster", "kalman", "--keep-size")
    assert "ranked by the modelled scores: the reach is given or measured" in text
    assert "pre-forecaster kalman says where the tracker searches, the size is kept" in text


def test_it_stops_quietly_when_nobody_reads() -> None:
    arguments = command("compare", SLOW, *FEW, "--forecaster", "hold", "--json")
    with subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(60) == 0


def test_help_has_examples_and_names_the_forecasters() -> None:
    printed = compare("--help")
    assert "examples:\n  lae-sim compare traces/*.parquet" in printed
    for name in ("least-squares", "tuned-kalman", "learned", "camera+NAME", "package.module:"):
        assert name in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--forecaster", "nobody"], "no forecaster 'nobody': there are hold"),
        (["--forecaster", "nobody:Nothing"], "nobody"),
        (["--forecaster", "offline"], "offline is always in the table"),
        pytest.param(
            ["--forecaster", "learned:none.pt"],
            "none.pt: no such file",
            marks=pytest.mark.skipif(find_spec("torch") is None, reason="needs torch"),
        ),
        (["--forecaster", "camera+kalman"], "give the dataset's folder with --root"),
        (
            ["--out", "all.txt"],
            "--out all.txt: name a folder (NAME.WITH.POINTS/ ends in /), or a .csv or",
        ),
        (["--out", "none/all.csv"], "none/all.csv"),
        (["--plot", "all.doc"], "all.doc: name a .png, .svg or .pdf"),
        (["--out", "all.csv", "--plot", "none/all.svg"], "none/all.svg"),
        (["--policy", "vot-realtime"], "vot-realtime never scores latency"),
        (["--policy", "nothing"], "no policy 'nothing'"),
        (["--latency", "nothing"], "no latency 'nothing'"),
        (["--latency-scale", "-1"], "-1"),
        (["--convention", "nothing"], "no convention 'nothing'"),
        (["--search", "c=far"], "search: no search 'c=far': there are off, trace, c=0.7"),
        (["--search", "off", "--pre-forecaster", "kalman"], "do not turn it off"),
        (["--pre-forecaster", "nobody"], "no forecaster 'nobody'"),
        (["--pre-forecaster", "tuned-kalman"], "tuned-kalman must be trained"),
        (["--keep-size"], "keep_size is a way to use a pre_forecaster"),
        (["--strided", "missing.parquet"], "passes: missing.parquet: no such file"),
        (["--cost", "nobody=1ms"], "no forecaster 'nobody'"),
        (["--folds", "1", "--forecaster", "tuned-kalman"], "at least two folds"),
        (["--sequence", "nothing"], "no sequence 'nothing'"),
        (["--sequence", "bike-pan", "--forecaster", "tuned-kalman"], "only one video"),
        (["missing.parquet"], "missing.parquet: no such file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_errors_are_a_line_or_two_and_nothing_is_written(
    options: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if "--forecaster" not in options:
        options = [*options, "--forecaster", "hold"]
    error = compare_here(SLOW, *options, status=2)
    assert message in error
    assert error.startswith("lae-sim compare: error: ")
    assert len(error.splitlines()) <= 2
    assert not list(tmp_path.iterdir())


def test_an_error_of_the_command_has_no_traceback(tmp_path: Path) -> None:
    error = compare(SLOW, "--sequence", "nothing", "--out", "all.csv", cwd=tmp_path, status=2)
    assert error.startswith("lae-sim compare: error: ")
    assert "no sequence 'nothing'" in error
    assert len(error.splitlines()) <= 2
    assert not list(tmp_path.iterdir())
