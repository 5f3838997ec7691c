"""What a study asks for: keys, exact values, and one clear line for whatever is wrong."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.engine.pipeline import Camera, Pipeline, Stage
from lae_sim.errors import LaeError
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.study.spec import _KEYS, Study, read_study


def written(tmp_path: Path, text: str) -> str:
    path = tmp_path / "study.toml"
    path.write_text(text)
    return str(path)


def test_defaults_are_those_of_replay(tmp_path: Path) -> None:
    study = read_study(written(tmp_path, 'traces = "a.parquet"'))
    assert study == Study(("a.parquet",))
    assert (study.forecasters, study.sigmas, study.fps) == (("hold", "kalman"), (0,), (None,))


def test_numbers_are_exact_as_they_are_written(tmp_path: Path) -> None:
    study = read_study(
        written(
            tmp_path,
            """
            traces = ["a.parquet", "b.parquet", "a.parquet"]
            fps = ["trace", 29.97, "30000/1001", 60]
            scales = [0.1, "1/3", 2]
            sigma = [1, 0, 0.02]
            require_auc = 0.55
            """,
        )
    )
    assert study.traces == ("a.parquet", "b.parquet")
    assert study.fps == (None, Fraction(2997, 100), Fraction(30000, 1001), 60)
    assert study.scales == (Fraction(1, 10), Fraction(1, 3), 2)
    assert study.sigmas == (0, Fraction(1, 50), 1)
    assert study.require_auc == (Fraction(11, 20),)
    assert study.document()["require_auc"] == "11/20"
    several = dataclasses.replace(study, require_auc=["0.5", 0.6])
    assert several.require_auc == (Fraction(1, 2), Fraction(3, 5))
    assert several.document()["require_auc"] == ["1/2", "3/5"]


def test_pipelines_are_tables_or_files_beside_the_study(tmp_path: Path) -> None:
    (tmp_path / "drone.toml").write_text('[[stages]]\nname = "tracker"\nqueue = "unbounded"\n')
    text = """
        traces = "a.parquet"
        [pipelines]
        drone = "drone.toml"
        late = { camera = { delivery = "8ms" }, stages = [{ name = "tracker" }] }
        """
    study = read_study(written(tmp_path, text))
    late = Pipeline([Stage("tracker")], camera=Camera(delivery="8ms"), name="late")
    assert study.pipelines == (Pipeline([Stage("tracker", queue=None)], name="drone"), late)
    assert Study(("a.parquet",), pipelines=study.pipelines) == study
    plain = study.document()["pipelines"]
    assert [each["name"] for each in plain] == ["drone", "late"]
    assert Study.of({"traces": "a.parquet", "pipelines": plain}) == study


@pytest.mark.parametrize(
    ("pipelines", "words"),
    [
        ({"a": {"stages": []}}, "pipelines: a: stages: a pipeline has at least one"),
        ({"a": {"stages": [{"name": "tracker", "queue": 0}]}}, "a: stage 'tracker': queue: 0"),
        ("no.toml", "pipelines: no.toml"),
        (7, "pipelines: pipeline: it is read from a TOML file, not 7"),
        ([Pipeline([Stage("tracker")])] * 2, "two are called 'pipeline'"),
        (Pipeline([Stage("tracker", lambda recording: int)]), "time: a function: name it, as"),
    ],
)
def test_pipelines_that_are_none_are_refused(pipelines: Any, words: str) -> None:
    with pytest.raises(LaeError) as caught:
        Study(("a.parquet",), pipelines=pipelines)
    assert words in str(caught.value)


def test_the_tracker_s_time_is_the_latency_or_the_pipeline_s_own() -> None:
    own = {"own": {"stages": [{"name": "tracker", "time": "30ms"}]}}
    assert Study.of({"traces": "a", "pipelines": own, "latencies": "recorded"}).pipelines
    with pytest.raises(LaeError) as caught:
        Study.of({"traces": "a", "pipelines": own, "latencies": ["recorded", "bootstrap"]})
    assert str(caught.value) == (
        "pipelines: own: latency: bootstrap:0:30, and the pipeline says constant:30ms: leave out "
        "the time of its stage 'tracker'"
    )


def test_a_study_has_a_policy_or_a_pipeline() -> None:
    with pytest.raises(LaeError, match="policies: the list is empty, and there are no pipelines"):
        Study.of({"traces": "a.parquet", "policies": []})


def test_the_grid_of_sigmas_has_a_name() -> None:
    assert Study.of({"traces": "a", "sigma": "grid"}).sigmas == SIGMA_GRID


def test_every_latency_is_crossed_with_every_time_of_the_initialisation() -> None:
    study = Study.of(
        {"traces": "a", "latencies": ["bootstrap", "constant:47ms"], "init": ["300ms", "1s"],
         "seed": 5, "block": 7}
    )  # fmt: skip
    assert study.times == (
        "bootstrap,init=300ms", "bootstrap,init=1s",
        "constant:47ms,init=300ms", "constant:47ms,init=1s",
    )  # fmt: skip
    assert [study.seeded(each) for each in study.times[1:3]] == [
        "bootstrap:5:7,init=1s", "constant:47ms,init=300ms",
    ]  # fmt: skip
    assert Study(("a",), init="1s").times == ("recorded,init=1s",)  # type: ignore[arg-type]
    alone = Study(("a",), latencies=("resample,init=1s", "recorded"))
    assert alone.times == alone.latencies
    assert [alone.seeded(each) for each in alone.times] == ["resample:0,init=1s", "recorded"]


def test_a_study_survives_its_document() -> None:
    study = Study.of({"traces": "a", "scales": ["1/3"], "latencies": ["bootstrap"], "block": 5})
    document = study.document()
    document["sigma"] = document.pop("sigmas")
    kept = {key: value for key, value in document.items() if value not in (None, [], [None])}
    assert Study.of(kept) == study


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the key 'traces' is missing"),
        ("traces = []", "traces: the list is empty"),
        ('traces = "a"\nforcasters = ["hold"]', "unknown key 'forcasters': did you mean 'foreca"),
        ('traces = "a"\nxyz = 1', "unknown key 'xyz': there are traces, timing"),
        ('traces = "a"\nscales = [-1]', "scales: times cannot be scaled by less than 0"),
        ('traces = "a"\nscales = [true]', "scales: True is not an exact number"),
        ('traces = "a"\nscales = [1e3]', "scales: '1e3' is not an exact number"),
        ('traces = "a"\nfps = [0]', "fps: a frame rate must be above zero"),
        ('traces = "a"\nlatencies = ["47ms"]', "latencies: no latency '47ms'"),
        ('traces = "a"\nlatencies = ["bootstrap:3"]', "in a study the keys seed and block say so"),
        ('traces = "a"\ninit = ["800"]', "init: '800' is not a duration"),
        ('traces = "a"\ninit = [1]', "init: 1 is not a duration"),
        ('traces = "a"\ninit = []', "init: the list is empty"),
        ('traces = "a"\nlatencies = ["recorded,int=1s"]', "latencies: 'recorded,int=1s': no "),
        (
            'traces = "a"\nlatencies = ["recorded,init=1s"]\ninit = ["1s"]',
            "latencies: 'recorded,init=1s' names its init, and so does the key init",
        ),
        ('traces = "a"\nlatencies = ["bootstrap:3,init=1s"]', "in a study the keys seed and"),
        ('traces = "a"\npolicies = ["last"]', "no policy 'last'"),
        ('traces = "a"\nsearch = "c=x"', "search: no search 'c=x': there are off, trace"),
        (
            'traces = "a"\nsearch = ["off", "trace"]\npre_forecaster = "kalman"',
            "pre_forecaster: what it is worth is the search model's",
        ),
        ('traces = "a"\nkeep_size = true', "keep_size: it is a way to use a pre_forecaster"),
        ('traces = "a"\nkeep_size = 1', "keep_size: 1 is neither true nor false"),
        ('traces = "a"\npolicies = ["vot-realtime"]', "never scores latency"),
        ('traces = "a"\nconventions = ["pysott"]', "no convention 'pysott'"),
        ('traces = "a"\nforecasters = ["offline"]', "offline is the tracker's own score"),
        ('traces = "a"\nrepetitions = 0', "repetitions: 0 is not a whole number from 1"),
        ('traces = "a"\nrepetitions = 2.0', "repetitions: '2.0' is not a whole number"),
        ('traces = "a"\nseed = -1', "seed: -1 is not a whole number from 0"),
        ('traces = "a"\nattributes = "yes"', "attributes: 'yes' is neither true nor false"),
        ('traces = "a"\nrequire_auc = 1.5', "require_auc: an AUC is between 0 and 1, not 3/2"),
        ('traces = "a"\ncosts = ["measured"]', "costs: declare a time"),
        ('traces = "a"\nsequences = [3]', "sequences: 3 is not text"),
        ("traces = [", "study.toml: "),
        ('traces = "a"\n[world]\nfps = 3', "unknown key 'world'"),
    ],
)
def test_what_is_wrong_is_one_line_that_names_the_file_and_the_key(
    text: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(LaeError) as caught:
        read_study(written(tmp_path, text))
    message = str(caught.value)
    assert said in message
    assert message.startswith(str(tmp_path))
    assert "\n" not in message


def test_a_missing_file_and_bytes_that_are_no_text(tmp_path: Path) -> None:
    with pytest.raises(LaeError, match=r"none\.toml: no such file"):
        read_study(str(tmp_path / "none.toml"))
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(LaeError, match="cannot be read"):
        read_study(str(tmp_path / "b.toml"))


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@given(st.dictionaries(st.sampled_from(list(_KEYS)) | st.text(max_size=5), values, max_size=4))
def test_whatever_is_given_is_a_study_or_an_error(document: dict[str, Any]) -> None:
    try:
        study = Study.of({"traces": "a", **document})
    except LaeError:
        return
    assert isinstance(study, Study)


@pytest.mark.parametrize(
    "text",
    [
        f"traces = {'[' * 5000}{']' * 5000}",
        f"traces = {'{a=' * 5000}1{'}' * 5000}",
        f"{'a.' * 100_000}a = 1",
        f"[{'a . ' * 100_000}a]",
        f"[[{'a.' * 100_000}a]]",
        f"seed = {'9' * 5000}",  # Exceeds the limit, in all but the first of Python 3.10
    ],
    ids=lambda text: text[:9],
)
def test_hostile_files_are_refused_quickly(tmp_path: Path, text: str) -> None:
    with pytest.raises(
        LaeError, match=r"study\.toml: (is nested too deeply|Exceeds the limit|seed: )"
    ):
        read_study(written(tmp_path, text))


def test_a_mark_of_the_encoding_is_skipped(tmp_path: Path) -> None:
    assert read_study(written(tmp_path, '\ufefftraces = "a.parquet"')).traces == ("a.parquet",)
