"""What users name as ``package.module:object``: parameters, where it is found, what is wrong."""

import pickle
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import run_here
from places import REPOSITORY

import lae_sim
from lae_sim.engine.clock import Clock
from lae_sim.errors import LaeError
from lae_sim.learning.registry import load_any, load_forecaster
from lae_sim.plugins import imported, looking_in
from lae_sim.profile.worker import InProcess
from lae_sim.replay.names import parse_latency, parse_policy

SLOW = str(REPOSITORY / "traces" / "synthetic-slow.parquet")

MINE = """\
class Damped:
    def __init__(self, box, image_size=None, a=1.0, steps=2, loud=False, name="x"):
        self.frame, self.box, self.before, self.given = 0, box, box, (a, steps, loud, name)

    def update(self, frame, box):
        self.frame, self.before, self.box = frame, self.box, box

    def predict(self, frame):
        return [new + self.given[0] * (new - old) for new, old in zip(self.box, self.before)]

def damped(box, image_size, a):
    return Damped(box, image_size, a)

class Maker:
    def __init__(self, a=1.0):
        self.a = a
    def __call__(self, box, image_size=None):
        return Damped(box, image_size, self.a)

class Trainer:
    def __init__(self, rounds=1):
        self.rounds = rounds
    def fit(self, examples, seed):
        return Damped

class Forgetful(Damped):
    def predict(self):
        return self.box

class Mute(Damped):
    predict = None

class Sizeless:
    def __init__(self, box):
        pass
    def update(self, frame, box):
        pass
    def predict(self, frame):
        pass

def late(box, image_size=None):
    return Forgetful(box)

def patient(clock, calls, frames=1):
    last, _, now = calls[-1]
    frame = last + frames
    return frame, max(now, clock.arrival(frame))
patient.scores_latency = False

class Patient:
    def __init__(self, frames=1):
        self.frames = frames
    def __call__(self, clock, calls):
        return patient(clock, calls, self.frames)

def times(recording, ms=1, more=0):
    return lambda frame: (ms + more) * 1_000_000

def timeless():
    pass

class Tracker:
    def __init__(self, reach=1):
        self.reach = reach
    def init(self, frame, box):
        pass
    def track(self, frame):
        return self.reach, 0, 1, 1

class Blind(Tracker):
    def track(self):
        pass
"""


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    yield
    sys.modules.pop("mine", None)


def test_parameters_of_a_forecaster_are_numbers_flags_and_text():
    load = load_forecaster("mine:Damped:a=0.3,steps=3,loud=true,name=low")
    assert load([0, 0, 1, 1], None).given == (0.3, 3, True, "low")
    assert pickle.loads(pickle.dumps(load))([0, 0, 1, 1], None).given[0] == 0.3
    assert load_forecaster("mine:Damped") is sys.modules["mine"].Damped


@pytest.mark.parametrize("name", ["Damped:a=0.5", "damped:a=0.5", "Maker:a=0.5"])
def test_a_class_a_function_and_a_maker_take_parameters(name):
    done = run_here("replay", SLOW, "--forecaster", f"mine:{name}", "mine:Damped", "--json")
    assert done.returncode == 0, done.stderr
    own, _ = imported("it", "mine:Damped")
    made = {"mine": lambda box, size: own(box, size, 0.5), "plain": own}
    scores = lae_sim.evaluate(SLOW, forecasters=made).summary
    mine, plain = (scores[scores.forecaster == each].auc.iloc[0] for each in ("mine", "plain"))
    assert mine != plain
    assert f'"auc": {mine}' in done.stdout
    assert f'"auc": {plain}' in done.stdout


def test_what_wraps_and_what_trains_takes_parameters_too():
    assert load_any("mine:Trainer:rounds=3").rounds == 3
    guarded = load_forecaster("guarded+mine:Damped:a=0.3")([0, 0, 1, 1], None)
    guarded.update(1, [2, 0, 1, 1])
    costs = run_here(
        *("replay", SLOW, "--forecaster", "mine:Damped:a=0.3", "--cost", "mine:Damped:a=0.3=2ms"),
        *("--sequence", "boat-calm", "--json"),
    )
    assert '"mine:Damped:a=0.3": 2000000' in costs.stdout


def test_policies_latencies_and_trackers_take_parameters():
    clock = Clock.at(1)
    for name in ("patient", "Patient"):
        assert parse_policy(f"mine:{name}:frames=3")(clock, [(0, 0, 7)])[0] == 3
    assert parse_policy("mine:patient:frames=3").scores_latency is False
    recording = next(iter(lae_sim.read_trace(SLOW)))
    assert parse_latency("mine:times:ms=47,init=9ns")(recording)(1) == 47_000_000
    assert parse_latency("mine:times:ms=47,more=1,init=9ns")(recording)(1) == 48_000_000
    with InProcess("mine:Tracker:reach=4", {}) as tracker:
        frame = np.zeros((8, 8, 3), np.uint8)
        tracker.init(frame, (0, 0, 1, 1))
        assert tracker.track(frame).box == (4, 0, 1, 1)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "Damped:b=1",
            r"Damped\(box, image_size=None, a=1.0, .*\) \(.*mine.py, line 2\) is called as "
            r"Damped\(box, image_size, b=1\): got an unexpected keyword argument 'b'",
        ),
        ("Damped:0.3", "'0.3' is not key=value"),
        ("Damped:", "'' is not key=value"),
        ("Forgetful", r"Forgetful.predict\(self\) \(.*line 27\) is called as .*predict\(frame\): "),
        ("Mute", r"Mute \(.*mine.py, line 2\) has no method predict\(frame\)"),
        ("Sizeless", r"Sizeless\(box\) \(.*line 34\) is called as Sizeless\(box, image_size\)"),
        ("Maker:b=1", "got an unexpected keyword argument 'b'; it takes a"),
        ("Trainer:b=1", "got an unexpected keyword argument 'b'; it takes rounds"),
        ("timeless", r"timeless\(\) \(.*\) is called as timeless\(box, image_size\)"),
    ],
)
def test_a_wrong_signature_is_said_of_the_users_class(name, message):
    with pytest.raises(LaeError, match=f"forecaster 'mine:{name}': {message}"):
        load_forecaster(f"mine:{name}")


def test_what_a_function_makes_is_looked_at_when_it_is_made():
    done = run_here("replay", SLOW, "--forecaster", "mine:late")
    assert done.returncode == 2
    assert re.search(
        r"error: mine:late: Forgetful.predict\(\) \(.*mine.py, line 27\) is called as "
        r"Forgetful.predict\(frame\): too many positional arguments$",
        done.stderr,
    ), done.stderr
    with pytest.raises(LaeError, match=r"forecasters: Forgetful.predict\(self\)"):
        lae_sim.evaluate(SLOW, forecasters=imported("it", "mine:Forgetful")[0])


def test_a_module_that_is_not_there_is_told_from_what_it_imports(tmp_path):
    (tmp_path / "needy_module.py").write_text("import nowhere_module\n")
    with pytest.raises(LaeError, match="No module named 'neady'; searched /"):
        imported("it", "neady:Thing")
    with pytest.raises(LaeError, match=r"No module named 'mine\.py'.*; leave out \.py"):
        imported("it", "mine.py:Damped")
    with pytest.raises(LaeError, match="No module named 'nowhere_module'") as error:
        imported("it", "needy_module:Thing")
    folders = str(error.value).rpartition("; searched ")[2].split(", ")
    assert {str(Path.cwd()), str(Path(pytest.__file__).parents[1])} <= set(folders)
    assert str(Path(re.__file__).parents[1]) not in folders  # of the standard library


def test_wrong_policies_latencies_and_trackers_are_named():
    with pytest.raises(LaeError, match=r"timeless\(\) .* called as timeless\(clock, calls\)"):
        parse_policy("mine:timeless")
    with pytest.raises(LaeError, match=r"Patient\(frames\)|takes frames"):
        parse_policy("mine:Patient:frame=2")
    with pytest.raises(LaeError, match=r"timeless\(\) .* called as timeless\(recording\)"):
        parse_latency("mine:timeless")
    with pytest.raises(LaeError, match=r"Blind.track\(\) \(.*\) is called as Blind.track\(frame\)"):
        InProcess("mine:Blind", {})


STUDY = 'traces = ["{trace}"]\nforecasters = ["mine:Damped:a={a}"]\nsequences = ["boat-calm"]\n'


def test_modules_are_found_beside_the_study_file(tmp_path, monkeypatch):
    beside, elsewhere = tmp_path / "beside", tmp_path / "elsewhere"
    for folder in (beside, elsewhere):
        folder.mkdir()
    (tmp_path / "mine.py").rename(beside / "mine.py")
    (beside / "study.toml").write_text(STUDY.format(trace=SLOW, a=0.3))
    monkeypatch.chdir(elsewhere)
    path = [*sys.path]
    results = lae_sim.run_study(beside / "study.toml", workers=2, report=False)
    scores = {row.forecaster: row.scores["auc"] for row in results.summary}
    assert {*scores} == {"hold", "mine:Damped:a=0.3"}
    assert not results.failures
    assert str(beside) not in sys.path
    assert [each for each in sys.path if each != str(elsewhere)] == path


def test_another_folders_module_is_not_taken_for_the_one_beside_the_study(tmp_path):
    imported("forecaster", "mine:Damped")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.py").write_text(MINE)
    with (
        looking_in(tmp_path / "other"),
        pytest.raises(LaeError, match="this process has imported another mine, "),
    ):
        imported("forecaster", "mine:Damped")
    imported("forecaster", "mine:Damped")
