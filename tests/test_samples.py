"""What ships in ``traces/``: samples, cases, schema, and the example in the format's text."""

import json
import os
import re
import subprocess
import sys

import jsonschema
import numpy as np
import pyarrow.parquet as pq
import pytest
from places import TRACES

import lae_sim

SAMPLES = sorted(TRACES.glob("*.parquet"))
VALID = sorted((TRACES / "cases" / "valid").glob("*.parquet"))
INVALID = sorted((TRACES / "cases" / "invalid").glob("*.parquet"))
EXPECTED = json.loads((TRACES / "cases" / "invalid" / "expected.json").read_text())
SCHEMA = json.loads((TRACES / "metadata.schema.json").read_text())


def metadata_text(path):
    return pq.ParquetFile(path).schema_arrow.metadata[b"lae_sim"]


def fits_schema(path):
    try:
        jsonschema.validate(json.loads(metadata_text(path)), SCHEMA)
    except jsonschema.ValidationError:
        return False
    return True


def assert_same_recordings(one, other, tolerance):
    """Equal up to the last written digit, where another platform's rounding may differ."""
    for a, b in zip(lae_sim.read_trace(one), lae_sim.read_trace(other), strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.truth, b.truth, rtol=0, atol=tolerance)
        np.testing.assert_allclose(a.boxes, b.boxes, rtol=0, atol=tolerance)
        np.testing.assert_allclose(a.elapsed_ns, b.elapsed_ns, rtol=0, atol=1000)


def test_samples_are_small_and_say_that_they_are_synthetic():
    assert len(SAMPLES) == 3
    assert sum(path.stat().st_size for path in SAMPLES) < 1_000_000
    for path in SAMPLES:
        assert "synthetic" in lae_sim.read_trace(path).metadata.timing_note


def test_the_generator_makes_the_samples(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(TRACES.parent)}
    command = [sys.executable, TRACES / "make_samples.py", tmp_path]
    subprocess.run(command, check=True, env=environment)
    assert sorted(path.name for path in tmp_path.iterdir()) == [path.name for path in SAMPLES]
    for path in SAMPLES:
        assert_same_recordings(tmp_path / path.name, path, tolerance=0.011)
        assert metadata_text(tmp_path / path.name) == metadata_text(path)


def test_the_generator_makes_the_cases(tmp_path):
    subprocess.run([sys.executable, TRACES / "make_cases.py", tmp_path], check=True)
    made = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.*"))
    shipped = TRACES / "cases"
    assert made == sorted(path.relative_to(shipped) for path in shipped.rglob("*.*"))
    assert json.loads((tmp_path / "invalid" / "expected.json").read_text()) == EXPECTED


@pytest.mark.parametrize("path", [*SAMPLES, *VALID], ids=lambda path: path.stem)
def test_valid_traces_are_read_and_fit_the_schema(path):
    lae_sim.validate(path)
    assert fits_schema(path)


@pytest.mark.parametrize("path", INVALID, ids=lambda path: path.stem)
def test_invalid_traces_are_refused_with_the_expected_words(path):
    with pytest.raises(lae_sim.TraceError) as caught:
        lae_sim.validate(path)
    message = str(caught.value)
    assert str(path) in message
    assert all(words in message for words in EXPECTED[path.name])
    assert len(message) < 400
    assert "\n" not in message


@pytest.mark.parametrize(
    "name",
    ["format-other", "version-2", "version-number", "fps-number", "fps-division-by-zero",
     "fps-exponent", "kind-unknown", "schedule-missing", "image-size-text", "attributes-text",
     "tracker-text", "search-text", "search-without-side", "search-side-zero", "search-side-true",
     "search-window-number", "search-source-number"],
)  # fmt: skip
def test_the_schema_refuses_the_same_metadata(name):
    assert not fits_schema(TRACES / "cases" / "invalid" / f"{name}.parquet")


def test_the_example_of_the_format_is_a_valid_trace(tmp_path, monkeypatch):
    [example] = re.findall(r"```python\n(.*?)```", (TRACES / "FORMAT.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "FORMAT.md", "exec"), {})
    boat, car = lae_sim.read_trace("example.parquet")
    assert (boat.name, len(boat), car.name, len(car)) == ("boat", 3, "car", 2)
    assert boat.elapsed_ns.tolist() == [72_000_000, -1, 41_000_000]
    assert np.isnan(car.truth[1]).all()
    runs = list(lae_sim.replay_trace(lae_sim.read_trace("example.parquet")))
    assert [run.schedule.frames.tolist() for run in runs] == [[0, 2], [0, 1]]
