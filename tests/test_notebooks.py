"""Every notebook runs from top to bottom, and draws its pictures."""

import os

import nbformat
import pytest
from nbclient import NotebookClient
from places import REPOSITORY

NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("*.ipynb"))
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
def test_notebook_runs(path, monkeypatch):
    monkeypatch.delenv("LAE_SIM_DATA", raising=False)
    assert len(pictures_of(path, monkeypatch)) == PICTURES[path.stem]


@pytest.mark.filterwarnings("ignore:Proactor event loop:RuntimeWarning")
def test_the_papers_tables_with_boxes_of_one_dataset(shared_data, tmp_path, monkeypatch):
    (tmp_path / "results_boxes").mkdir()
    for part in ("DTB70", "results_boxes/DTB70"):
        (tmp_path / part).symlink_to(shared_data / part)
    monkeypatch.setenv("LAE_SIM_DATA", str(tmp_path))
    path = REPOSITORY / "notebooks" / "05_the_papers_tables.ipynb"
    assert len(pictures_of(path, monkeypatch)) == 2


def pictures_of(path, monkeypatch):
    """The pictures that a notebook draws; it must not complain."""
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    )
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    monkeypatch.setenv("TQDM_DISABLE", "1")  # a progress bar is no complaint
    NotebookClient(notebook, timeout=120, resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if IMAGES & {*output.get("data", {})}]
    assert not [output for output in outputs if output.get("name") == "stderr"]
    return pictures


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
