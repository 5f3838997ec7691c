"""The notebooks as they are stored, with what they print and draw: ``make notebooks``.

Execution counts and times of the run are left out, and pictures are small, so that a run that
finds the same leaves the file as it is. Notebooks that measure the machine at hand, ``MEASURED``,
and cells that do so, by their tag ``measured``, keep what is stored as long as a run prints and
draws as much.
"""

from __future__ import annotations

import base64
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image
from places import REPOSITORY

NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("*.ipynb"))
MEASURED = ("02_profile_your_device", "06_how_far_to_trust_a_replay")
PNG = "image/png"
WIDTH, COLOURS = 640, 32  # of pictures
_KEPT = ("text/plain", "text/html", "image/svg+xml", PNG)


def executed(path: Path) -> Any:
    """The notebook with the outputs of a fresh run, as they would be stored."""
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=300, resources=resources).execute()
    for cell in code_cells(notebook):
        cell.execution_count = None
        cell.metadata.pop("execution", None)
        cell.outputs = [*_stored(cell.outputs)]
    notebook.metadata.pop("language_info", None)
    return notebook


def code_cells(notebook: Any) -> Iterator[Any]:
    """The cells that are run."""
    return (cell for cell in notebook.cells if cell.cell_type == "code")


def _stored(outputs: Iterable[Any]) -> Iterator[Any]:
    """Outputs without what differs from run to run, those of one stream together."""
    before: Any = None
    for output in outputs:
        if output.output_type == "stream":
            output.text = _steady(output.text)
            if before is not None and before.get("name") == output.name:
                before.text += output.text
                continue
        elif "data" in output:
            output.data = {kind: value for kind, value in output.data.items() if kind in _KEPT}
            if "text/plain" in output.data:
                output.data["text/plain"] = _steady(output.data["text/plain"])
            if PNG in output.data:
                output.data[PNG] = _smaller(output.data[PNG])
            output.metadata = {}
            if output.output_type == "execute_result":
                output.execution_count = None
        before = output
        yield output


def _steady(text: str) -> str:
    """Text without the addresses of objects and the names of temporary folders."""
    text = re.sub(r"0x[0-9a-f]{6,}", "0x...", text)
    return re.sub(rf"{re.escape(gettempdir())}/tmp\w+", "/tmp/...", text)


def _smaller(png: str) -> str:
    """A picture of fewer pixels and colours, as notebooks hold it."""
    picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    if picture.width > WIDTH:
        picture = picture.resize((WIDTH, round(picture.height * WIDTH / picture.width)))
    file = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(file, "png", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def merged(path: Path, fresh: Any) -> Any:
    """The fresh notebook, with those outputs that are stored and no news.

    Pictures are none, whose pixels depend on the version of Matplotlib.
    """
    stored = nbformat.read(path, as_version=4)
    for old, new in zip(code_cells(stored), code_cells(fresh)):
        if kinds(old) == kinds(new):
            for before, after in zip(old.outputs, new.outputs):
                if is_measured(path, new) or said(before) == said(after):
                    after.update(before)
    return fresh


def is_measured(path: Path, cell: Any) -> bool:
    """Whether what a cell says is of the machine at hand."""
    return path.stem in MEASURED or "measured" in cell.metadata.get("tags", ())


def said(output: Any) -> str:
    """What an output says, pictures apart, however it is laid out."""
    return " ".join(output.get("text", output.get("data", {}).get("text/plain", "")).split())


def kinds(cell: Any) -> list[Any]:
    """What kinds of outputs a cell has."""
    return [sorted(each.get("data", [each.get("name")])) for each in cell.outputs]


def main(*names: str) -> None:
    """Run all notebooks, or those named, and store what they print."""
    os.environ |= {"TQDM_DISABLE": "1", "PYTHONPATH": str(REPOSITORY)}
    os.environ.pop("LAE_SIM_DATA", None)
    for path in NOTEBOOKS:
        if not names or path.stem in names:
            nbformat.write(merged(path, executed(path)), path)
            print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
