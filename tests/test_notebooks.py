"""Every notebook runs from top to bottom, draws its pictures, and is stored with what it prints."""

import os

import nbformat
import pytest
from places import REPOSITORY
from stored_notebooks import NOTEBOOKS, code_cells, executed, is_measured, kinds, said

PICTURES = {
    "01_replay_a_trace": 4,
    "02_profile_your_device": 4,
    "03_compare_forecasters": 7,
    "04_full_study": 4,
    "06_how_far_to_trust_a_replay": 2,
    "05_the_papers_tables": 1,  # without boxes
}
IMAGES = {"image/png", "image/svg+xml"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore:Proactor event loop:RuntimeWarning")
def test_notebook_runs_and_is_stored_with_what_it_prints(path, monkeypatch):
    monkeypatch.delenv("LAE_SIM_DATA", raising=False)
    fresh = run(path, monkeypatch)
    assert len(pictures_of(fresh)) == PICTURES[path.stem]
    stored = nbformat.read(path, as_version=4)
    for old, new in zip(code_cells(stored), code_cells(fresh)):
        assert kinds(old) == kinds(new), f"run `make notebooks`: {new.source}"
        if not is_measured(path, new):
            assert [*map(said, old.outputs)] == [*map(said, new.outputs)], "run `make notebooks`"


@pytest.mark.filterwarnings("ignore:Proactor event loop:RuntimeWarning")
def test_the_papers_tables_with_boxes_of_one_dataset(shared_data, tmp_path, monkeypatch):
    (tmp_path / "results_boxes").mkdir()
    for part in ("DTB70", "results_boxes/DTB70"):
        (tmp_path / part).symlink_to(shared_data / part)
    monkeypatch.setenv("LAE_SIM_DATA", str(tmp_path))
    path = REPOSITORY / "notebooks" / "05_the_papers_tables.ipynb"
    assert len(pictures_of(run(path, monkeypatch))) == 2


def run(path, monkeypatch):
    """A notebook with what a run of it left; it must not complain."""
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    )
    monkeypatch.setenv("TQDM_DISABLE", "1")  # a progress bar is no complaint
    notebook = executed(path)
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    assert not [output for output in outputs if output.get("name") == "stderr"]
    return notebook


def pictures_of(notebook):
    """The pictures that it drew."""
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    return [output for output in outputs if IMAGES & {*output.get("data", {})}]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_without_what_differs_between_runs(path):
    assert path.stat().st_size < 300_000
    for cell in code_cells(nbformat.read(path, as_version=4)):
        assert cell.execution_count is None
        assert not {"execution", "ExecuteTime"} & {*cell.metadata}
        assert not [each for each in cell.outputs if each.get("execution_count") is not None]
        assert str(REPOSITORY) not in str(cell.outputs)
