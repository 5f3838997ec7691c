"""Forecasters by name: every one of the zoo, its options, and a user's own."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import random_learned
from walks import lanes_and_queries, streaming
from witness import moving

from lae_sim.datasets.frames import ImageSequence
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.forecast.base import ConstantVelocity, Hold, Lanes, Oracle, factory_for, forecast
from lae_sim.forecast.camera import Camera
from lae_sim.forecast.filters import GH, IMM
from lae_sim.forecast.guard import Guarded, guarded
from lae_sim.forecast.kalman import Kalman, KalmanLaePvt, TunedKalman
from lae_sim.forecast.learned import SHIPPED, Learned, read_learned, write_learned
from lae_sim.forecast.window import LeastSquares, Windowed
from lae_sim.learning.folds import Examples, Trainer
from lae_sim.learning.registry import (
    FORECASTERS,
    base_name,
    files_named,
    load_any,
    load_forecaster,
)
from lae_sim.learning.trainers import KalmanTrainer
from lae_sim.replay.run import replay_sequence

BUILT_IN = {
    "hold": Hold,
    "constant-velocity": ConstantVelocity,
    "kalman": Kalman,
    "kalman-lae-pvt": KalmanLaePvt,
    "oracle": Oracle,
}
MADE = {
    "kalman:q=3,decay=0.99": TunedKalman(q=3, decay=0.99),
    "kalman:r=1e1,p0=5,state=centre": TunedKalman(r=10.0, p0=5, state="centre"),
    "g-h": GH(),
    "g-h:g=1,h=0.25": GH(1, 0.25),
    "imm": IMM(),
    "imm:stay=0.5,agile=9": IMM(agile=9, stay=0.5),
    "least-squares": Windowed(LeastSquares()),
    "least-squares:n=3,forgetting=1,huber=0.5": Windowed(LeastSquares(3, 1, 0.5)),
    "guarded+kalman": Guarded(Kalman),
    "guarded+kalman:q=3": Guarded(TunedKalman(q=3)),
}


@pytest.mark.parametrize(("name", "factory"), BUILT_IN.items())
def test_built_in_names(name: str, factory: Any) -> None:
    assert load_forecaster(name) is factory


@pytest.mark.parametrize(("name", "factory"), MADE.items())
def test_names_with_options(name: str, factory: Any) -> None:
    assert load_forecaster(name) == factory


def test_what_is_learned_is_shipped_or_read_and_guarded_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a+b.npz"
    write_learned(random_learned(), path)
    found: Any = load_forecaster("learned")
    assert isinstance(found, Guarded)
    assert found.base.network.digest == read_learned(SHIPPED).network.digest  # type: ignore[attr-defined]
    alone: Any = load_forecaster(f"learned:{path}")
    assert isinstance(alone, Learned)
    assert alone.network.digest == random_learned().network.digest
    over: Any = load_forecaster(f"guarded+learned:{path}")
    assert over.base.network.digest == alone.network.digest
    sequenced: Any = load_forecaster("guarded+oracle")
    assert isinstance(sequenced.for_sequence(moving(9)), Guarded)


def test_a_name_leads_to_its_files() -> None:
    for name, files in {
        "kalman": [], "hold": [], "guarded+kalman": [], "tuned-kalman": [], "trained": [],
        "learned": [str(SHIPPED)], "camera+guarded+learned": [str(SHIPPED)],
        "learned:f.npz": ["f.npz"], "guarded+camera+learned:a+b.npz": ["a+b.npz"],
        "guarded+my.own:Mine": ["my/own.py"],
    }.items():  # fmt: skip
        assert files_named(name) == files, name
    assert base_name("guarded+camera+learned:camera+f.npz") == "learned:camera+f.npz"


def test_every_name_that_the_help_lists_is_there(tmp_path: Path) -> None:
    write_learned(random_learned(), tmp_path / "FILE")
    names = [line.split()[0] for line in FORECASTERS.splitlines()[1:]]
    assert len(names) >= 11
    box = [10.0, 20, 30, 40]
    for listed in names:
        name = re.sub(r"\[:(.*?)(,\.\.\.)?\]", r":\1", listed)
        name = name.replace("FILE", str(tmp_path / "FILE")).replace("NAME", "kalman")
        if name == "package.module:factory":
            continue
        frames = {"s": ImageSequence("s", np.array([box]), lambda i: np.zeros((9, 9, 3), np.uint8))}
        camera = Camera(frames, Fraction(30))
        factory = factory_for(load_forecaster(name, camera), frames["s"])
        assert list(factory(box, None).predict(0)) == pytest.approx(box), name


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("kalman:Q=3", "unexpected keyword argument 'Q'; it takes q, r, p0, decay, state"),
        ("g-h:k=3", "unexpected keyword argument 'k'; it takes g, h"),
        ("imm:q=3", "it takes quiet, agile, r, p0, stay"),
        ("least-squares:size=3", "it takes n, forgetting, huber"),
        ("kalman:q=-1", "a Kalman filter needs q >= 0"),
        ("kalman:state=middle", "state is corner or centre, not 'middle'"),
        ("kalman:q=many", "'kalman:q=many': one of its options must be a number"),
        ("kalman:q=", "must be a number"),
        ("g-h:g=nan", "must be a number"),
        ("imm:agile=1e999", "must be a number"),
        ("least-squares:n=2.5", "a whole n"),
        ("kalman:3", "'3' is not key=value"),
        ("kalman:q=3,", "'' is not key=value"),
        ("hold:n=3", "'hold:n=3': hold takes no options"),
        ("oracle:x", "oracle takes no options"),
        (
            "trained",
            "trained must be trained: lae-sim compare does so .* lae-sim train makes a file",
        ),
        ("tuned-kalman", "tuned-kalman must be trained"),
        ("guarded+trained", r"guarded\+trained must be trained"),
        ("guarded+nothing", "no forecaster 'nothing'"),
        ("guarded+camera+kalman", r"camera\+kalman needs the frames"),
        ("train", "no forecaster 'train': .* did you mean 'trained'"),
        ("learned:no-such-file.npz", "no-such-file.npz: no such file"),
        ("learned:", "a folder, not a file"),
        ("camera+kalman", "needs the frames: give the dataset's folder with --root"),
        ("camera+nothing", "needs the frames"),
        ("kalmann", "no forecaster 'kalmann': there are hold, constant-velocity, kalman"),
        ("", "no forecaster ''"),
        ("no_such_module_here:x", "ModuleNotFoundError"),
        ("lae_sim.forecast.kalman:NoSuch", "AttributeError"),
        ("lae_sim.forecast.kalman:", "AttributeError"),
        (":Kalman", "ValueError"),
        ("lae_sim.forecast.kalman:RESTART_IOU", "not callable"),
        ("lae_sim.forecast.kalman:Kalman.updat", "AttributeError"),
    ],
)
def test_a_wrong_name_says_what_is_wrong(name: str, problem: str) -> None:
    with pytest.raises(LaeError, match=problem) as caught:
        load_forecaster(name)
    assert "\n" not in str(caught.value)


def test_trainers_are_loaded_where_they_can_be_trained() -> None:
    for name in ("trained", "tuned-kalman", "guarded+trained", "guarded+tuned-kalman"):
        assert isinstance(load_any(name), Trainer)
    for name in ("kalman", "learned", "guarded+kalman"):
        assert not isinstance(load_any(name), Trainer)
    recordings = [moving(40, seed, f"s{seed}") for seed in range(2)]
    runs = [replay_sequence(recording, Clock.at(Fraction(30))) for recording in recordings]
    made: Any = load_any("guarded+tuned-kalman")
    trained = made.fit(Examples.of(runs), 0)
    assert isinstance(trained, Guarded)
    assert trained == guarded(KalmanTrainer().fit(Examples.of(runs)))


# ------------------------------------------------------------------------------------- a user's own


def test_a_forecaster_of_an_installed_module() -> None:
    assert load_forecaster("lae_sim.forecast.kalman:Kalman") is Kalman
    assert load_forecaster("lae_sim.forecast.kalman:Kalman.__init__") is Kalman.__init__


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, whose modules can be imported and are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    monkeypatch.setattr(sys, "modules", sys.modules.copy())
    return tmp_path


def test_a_forecaster_of_the_current_folder(here: Path) -> None:
    (here / "my_forecasters_of_a_test.py").write_text("def make(box, size): ...\n")
    factory = load_forecaster("my_forecasters_of_a_test:make")
    assert factory.__name__ == "make"  # type: ignore[union-attr]


def test_a_trainer_of_the_current_folder_is_made(here: Path) -> None:
    (here / "my_trainers_of_a_test.py").write_text(
        "class Mine:\n    def fit(self, examples, seed): return seed\n"
        "class Greedy:\n    def __init__(self, more): ...\n    fit = Mine.fit\n"
    )
    made = load_any("my_trainers_of_a_test:Mine")
    assert isinstance(made, Trainer)
    assert made.fit(None, 3) == 3  # type: ignore[arg-type]
    with pytest.raises(LaeError, match="Mine must be trained"):
        load_forecaster("my_trainers_of_a_test:Mine")
    with pytest.raises(LaeError, match=r"Greedy'.* missing .*'more'"):
        load_any("my_trainers_of_a_test:Greedy")


def test_a_module_that_fails_while_it_is_imported_is_reported(here: Path) -> None:
    (here / "failing_of_a_test.py").write_text("1 / 0\n")
    with pytest.raises(LaeError, match="ZeroDivisionError: division by zero"):
        load_forecaster("failing_of_a_test:make")


# -------------------------------------------------------------- no sequence knows of another

Told = list[list[float]]
SEQUENCES = [moving(30, seed, f"s{seed}") for seed in range(3)]


def told(forecasters: Sequence[Any], lanes: Lanes) -> list[Told]:
    """What a forecaster per lane answers, each fed and asked in turns with the others."""
    answers: list[Told] = [[] for _ in forecasters]
    for step in range(int(np.diff(lanes.offsets).max())):
        for k, forecaster in enumerate(forecasters):
            at = int(lanes.offsets[k]) + step
            if at < lanes.offsets[k + 1]:
                if step:
                    forecaster.update(int(lanes.frames[at]), lanes.boxes[at].tolist())
                asked = [int(lanes.frames[at]) + ahead for ahead in (3, 0, 1)]
                answers[k] += [list(forecaster.predict(frame)) for frame in asked]
    return answers


@pytest.mark.parametrize("name", [*BUILT_IN, *MADE, "learned"])
@given(case=lanes_and_queries(), data=st.data())
@settings(max_examples=6)
def test_no_state_leaks_from_one_sequence_to_another(
    name: str, case: Any, data: st.DataObject
) -> None:
    lanes, item, frame = case
    found = load_forecaster(name)
    count = len(lanes.offsets) - 1
    sequences = [SEQUENCES[k % 3] for k in range(count)]

    def alone(k: int) -> Told:
        factory = factory_for(load_forecaster(name), sequences[k])
        part = lanes.chosen(np.arange(count) == k, item)[0]
        return told([factory(part.boxes[0].tolist(), (640, 360))], part)[0]

    factories = [factory_for(found, sequence) for sequence in sequences]
    firsts = lanes.boxes[lanes.offsets[:-1]].tolist()
    made = [factory(box, (640, 360)) for factory, box in zip(factories, firsts)]
    expected = [alone(k) for k in range(count)]
    assert told(made, lanes) == expected  # by turns
    k = data.draw(st.integers(0, count - 1))
    again = factories[k](firsts[k], (640, 360))
    assert told([again], lanes.chosen(np.arange(count) == k, item)[0]) == [
        expected[k]
    ]  # after the others
    if name != "oracle":
        both = [forecast(found, lanes, item, frame), streaming(found, lanes, item, frame)]
        order = np.flatnonzero(lanes.lane(item) == k)
        part, asked, places = lanes.chosen(np.arange(count) == k, item)
        assert np.flatnonzero(asked).tolist() == order.tolist()
        one = forecast(found, part, places, frame[order])
        for answers in both:
            np.testing.assert_allclose(answers[order], one, rtol=1e-9, atol=1e-9)
