"""Where the cells of a study lie."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lae_sim.errors import LaeError
from lae_sim.files import locked, remove_leftovers, written_whole
from lae_sim.study.cells import Cell, Result

_CELLS = "[0-9a-f]" * 32 + ".parquet"


class Store:
    """The folder of a study's finished cells.

    ``results`` holds exactly the cells of the plan, as one Parquet dataset; ``about`` says more of
    each; ``unused`` keeps finished cells of other plans, in case they are wanted again.
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
        """Whether a cell is finished."""
        return self.rows(cell).is_file() and self._details(cell.key).is_file()

    def put(self, result: Result) -> None:
        """Keep a result; its rows come last, and say that it is finished."""
        self.keep(result.key, result.about)
        with written_whole(self.results / f"{result.key}.parquet") as temporary:
            temporary.write_bytes(result.rows)

    def document(self, key: str) -> dict[str, Any] | None:
        """A document that was kept under a key, if it was."""
        path = self._details(key)
        return self._read(path) if path.is_file() else None

    def keep(self, key: str, document: Any) -> None:
        """Keep a document under a key."""
        with written_whole(self._details(key)) as temporary:
            temporary.write_text(json.dumps(document, allow_nan=False))

    def rows(self, cell: Cell) -> Path:
        """The file of a cell's rows."""
        return self.results / f"{cell.key}.parquet"

    def about(self, cell: Cell) -> dict[str, Any]:
        """What is known of a finished cell beside its rows (see :class:`Result`).

        Raises:
            LaeError: if its file is damaged.
        """
        return self._read(self._details(cell.key))

    def _read(self, path: Path) -> dict[str, Any]:
        try:
            document: dict[str, Any] = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise LaeError(f"{path}: cannot be read: {error}; delete it") from error
        return document

    def _details(self, key: str) -> Path:
        return self._about / f"{key}.json"
