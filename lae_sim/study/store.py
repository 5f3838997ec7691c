"""Where the cells of a study lie."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError
from lae_sim.files import locked, remove_leftovers, text_digest, written_whole
from lae_sim.study.cells import Cell, Result

_CELLS = "[0-9a-f]" * 32 + ".parquet"
_BYTES, _DIGEST = "rows_bytes", "sha256"  # what the files say of themselves


class Store:
    """The folder of a study's finished cells.

    ``results`` holds exactly the cells of the plan, as one Parquet dataset; ``about`` says more of
    each; ``unused`` keeps finished cells of other plans, in case they are wanted again. What is
    not as it was written, cut off or edited, counts as not there, and is computed again.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.results, self._about, self._unused = (
            self.folder / name for name in ("results", "about", "unused")
        )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other studies out of the folder, where the system can.

        Raises:
            LaeError: if one is at work there.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise LaeError(f"{self.folder}: is there already and is no folder") from error
        except OSError as error:
            raise LaeError(f"{self.folder}: {error.strerror or error}") from error
        with locked(self.results, f"{self.folder}: another study"):
            yield

    def prepare(self, cells: Iterable[Cell]) -> None:
        """Make the folder, bring the cells of the plan back, and set those of others aside.

        Raises:
            LaeError: if it cannot be written, or is a folder of something else.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            folders = (self.results, self._about, self._unused)
            seen = [path for path in self.folder.iterdir() if not path.name.startswith(".")]
            if seen and not all(path.is_dir() for path in folders):
                raise LaeError(f"{self.folder}: is not empty and not of a study: name another")
            for path in folders:
                path.mkdir(exist_ok=True)
            for path in (self.folder, *folders):  # before anything is computed for it
                with tempfile.TemporaryFile(dir=path):
                    pass
                remove_leftovers(path)
            wanted = {f"{cell.key}.parquet" for cell in cells}
            for path in self.results.glob(_CELLS):
                if path.name not in wanted:
                    path.replace(self._unused / path.name)
            for path in self._unused.glob(_CELLS):
                if path.name in wanted:
                    path.replace(self.results / path.name)
        except OSError as error:
            raise LaeError(f"{self.folder}: {error.strerror or error}") from error

    def has(self, cell: Cell) -> bool:
        """Whether a cell is finished, and its files are whole."""
        about, rows = self.document(cell.key), self.rows(cell)
        return about is not None and rows.is_file() and rows.stat().st_size == about.get(_BYTES)

    def put(self, result: Result) -> None:
        """Keep a result; its rows come last, and say that it is finished."""
        self.keep(result.key, {**result.about, _BYTES: len(result.rows)})
        with written_whole(self.results / f"{result.key}.parquet") as temporary:
            temporary.write_bytes(result.rows)

    def document(self, key: str) -> dict[str, Any] | None:
        """A document that was kept under a key, if it was, and is as it was written."""
        with suppress(OSError, ValueError, RecursionError):
            document = json.loads(self._details(key).read_text("utf-8"))
            if isinstance(document, dict) and document.pop(_DIGEST, None) == _digest(document):
                return document
        return None

    def keep(self, key: str, document: Mapping[str, Any]) -> None:
        """Keep a document under a key, with its digest."""
        text = json.dumps({**document, _DIGEST: _digest(document)}, allow_nan=False)
        with written_whole(self._details(key)) as temporary:
            temporary.write_text(text, "utf-8")

    def rows(self, cell: Cell) -> Path:
        """The file of a cell's rows."""
        return self.results / f"{cell.key}.parquet"

    def about(self, cell: Cell) -> dict[str, Any]:
        """What is known of a finished cell beside its rows (see :class:`Result`).

        Raises:
            LaeError: if its file is damaged.
        """
        if (document := self.document(cell.key)) is None:
            raise LaeError(f"{self._details(cell.key)}: damaged: run the study again")
        return document

    def _details(self, key: str) -> Path:
        return self._about / f"{key}.json"


def _digest(document: Mapping[str, Any]) -> str:
    """Of all that a document holds, in its order."""
    return text_digest(json.dumps(document, allow_nan=False))
