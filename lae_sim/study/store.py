"""Where the cells of a study lie."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

from lae_sim.errors import LaeError
from lae_sim.files import locked, remove_leftovers, text_digest, written_whole
from lae_sim.study.cells import Cell, Result
from lae_sim.study.rows import RowsFile, read_rows

Key = TypeVar("Key")

_FILES = "[0-9a-f]" * 32 + ".parquet"
_BYTES, _PLACES = "rows_bytes", "places"  # what a file of details says of that of rows
_DIGEST = '{"sha256": "'  # how a file of details begins: with a digest of what follows
_AFTER = len(_DIGEST) + 32


@dataclass(frozen=True)
class Part:
    """A file of rows, and what is said of it.

    Attributes:
        name: of both files, without suffix.
        size: of the file of rows, bytes.
        places: by the keys of its cells the first row of each, and how many it has.
        documents: keys of others that were made together with these.
        cells, texts: what is known of the cells beside their rows (see :class:`Result`), and the
            documents, by their keys.
    """

    name: str
    size: int
    places: Mapping[str, tuple[int, int]]
    documents: Sequence[str]
    cells: Packed
    texts: Packed

    @classmethod
    def of(
        cls, results: Sequence[Result], documents: Mapping[str, Mapping[str, Any]], size: int
    ) -> Part:
        """That of some results which share a file of so many bytes."""
        keys = [*(result.key for result in results), *documents]
        return cls(
            name=keys[0] if len(keys) == 1 else text_digest(" ".join(keys)),
            size=size,
            places={result.key: (result.first, result.count) for result in results},
            documents=[*documents],
            cells=Packed.of(_text({result.key: result.about for result in results})),
            texts=Packed.of(_text(documents)),
        )

    def written(self) -> str:
        """What its file holds: a line that says what there is, and a line of either kind."""
        places = {key: list(place) for key, place in self.places.items()}
        head = {_PLACES: places, "documents": self.documents, _BYTES: self.size}
        return "\n".join([_text(head), self.cells.text, self.texts.text])

    @classmethod
    def read(cls, name: str, text: str) -> Part:
        """That of such a file."""
        head, cells, texts = text.split("\n")
        about = _object(head)
        places = {key: (first, count) for key, (first, count) in about[_PLACES].items()}
        packed = Packed.of(cells), Packed.of(texts)
        return cls(name, about[_BYTES], places, about["documents"], *packed)


@dataclass(frozen=True)
class Packed:
    """Text in as few bytes as may be: as objects it would take many times the memory.

    Attributes:
        size: bytes of the text.
        packed: the text, compressed.
    """

    size: int
    packed: bytes

    @classmethod
    def of(cls, text: str) -> Packed:
        """That of a text."""
        import pyarrow as pa

        plain = text.encode()
        return cls(len(plain), pa.compress(plain, codec="zstd", asbytes=True))

    @property
    def text(self) -> str:
        """The text."""
        import pyarrow as pa

        plain: bytes = pa.decompress(self.packed, self.size, codec="zstd", asbytes=True)
        return plain.decode()


class Store:
    """The folder of a study's finished cells.

    ``results`` holds exactly the cells of the plan, as one Parquet dataset of files of a cell, or
    of many small ones; ``about`` says more of each; ``unused`` keeps finished cells of other
    plans, in case they are wanted again. What is not as it was written, cut off or edited, counts
    as not there, and is computed again.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.results, self._about, self._unused = (
            self.folder / name for name in ("results", "about", "unused")
        )
        self._parts: dict[str, Part] = {}  # by the keys of their cells and documents
        self._read: tuple[str, tuple[str, ...] | None, Any] | None = None
        self._unpacked: tuple[Packed, dict[str, Any]] | None = None

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
            self._sort({cell.key for cell in cells})
        except OSError as error:
            raise LaeError(f"{self.folder}: {error.strerror or error}") from error

    def open(self) -> None:
        """Look at what a finished study left, without changing anything."""
        for part, rows in self._found():
            if rows.parent == self.results:
                self._remember(part, part.places)

    def _sort(self, wanted: set[str]) -> None:
        """Move the files to where they belong, and divide those that belong to both."""
        here: set[Path] = set()
        for part, place in [*self._found()]:
            kept = {key for key in part.places if key in wanted and key not in self._parts}
            if kept and len(kept) < len(part.places):
                self._divide(part, place, kept)
                continue
            if part.places:
                target = (self.results if kept else self._unused) / place.name
                if target != place:
                    place.replace(target)
                here |= {target} if kept else set()
            self._remember(part, kept)
        here |= {*self.files}
        for path in self.results.glob(_FILES):
            if path not in here:  # of what is not as it was written
                path.unlink()

    def _remember(self, part: Part, cells: Iterable[str]) -> None:
        for key in (*cells, *part.documents):
            self._parts[key] = part

    def _found(self) -> Iterator[tuple[Part, Path]]:
        """What is whole, with the file of its rows, in the order of the names."""
        for path in sorted(self._about.glob("*.json")):
            text = self._whole(path.stem)
            if text is None or not text.startswith(f'{{"{_PLACES}": '):
                continue
            part = Part.read(path.stem, text)
            for folder in (self.results, self._unused):
                rows = folder / f"{path.stem}.parquet"
                if not part.places or (rows.is_file() and rows.stat().st_size == part.size):
                    yield part, rows
                    break

    def _divide(self, part: Part, place: Path, kept: set[str]) -> None:
        """Divide a file into one of the cells that are kept, and one of the others."""
        table = read_rows(place)
        for folder, chosen in (
            (self.results, [key for key in part.places if key in kept]),
            (self._unused, [key for key in part.places if key not in kept]),
        ):
            file, results = RowsFile(), []
            for key in chosen:
                first, count = part.places[key]
                for batch in table.slice(first, count).to_batches():
                    file.write(batch, soon=False)
                first = file.rows - count
                results.append(Result(key, b"", first, count, self._opened(part.cells)[key]))
            documents = self._opened(part.texts) if folder == self.results else {}
            self._put(results, documents, file.finish(), folder)
        place.unlink()
        self._details(part.name).unlink()

    def has(self, cell: Cell) -> bool:
        """Whether a cell is finished, and its files are whole."""
        return cell.key in self._parts

    def put(
        self,
        results: Sequence[Result],
        documents: Mapping[str, Mapping[str, Any]] | None = None,
        rows: bytes = b"",
    ) -> None:
        """Keep results and documents; their rows come last, and say that they are finished.

        Args:
            results: of cells.
            documents: by their keys, kept together with the results.
            rows: the file of all of them; by default each has its own.
        """
        if not rows:
            for result in results:
                self._put([result], {}, result.rows, self.results)
            results = []
        if results or documents:
            self._put(results, documents or {}, rows, self.results)

    def _put(
        self,
        results: Sequence[Result],
        documents: Mapping[str, Mapping[str, Any]],
        rows: bytes,
        folder: Path,
    ) -> None:
        part = Part.of(results, documents, len(rows))
        self._write(part.name, part.written())
        if results:
            with written_whole(folder / f"{part.name}.parquet") as temporary:
                temporary.write_bytes(rows)
        self._remember(part, part.places if folder == self.results else ())

    def document(self, key: str) -> dict[str, Any] | None:
        """A document that was kept under a key, if it was, and is as it was written."""
        if (part := self._parts.get(key)) is not None:
            document: dict[str, Any] = self._opened(part.texts)[key]
            return document
        with suppress(ValueError, RecursionError):
            return None if (text := self._whole(key)) is None else _object(text)
        return None

    def holds(self, key: str) -> bool:
        """Whether such a document is there, and as it was written."""
        return key in self._parts or self._whole(key) is not None

    def keep(self, key: str, document: Mapping[str, Any]) -> None:
        """Keep a document under a key, with its digest."""
        self._write(key, _text(document))

    def _opened(self, packed: Packed) -> dict[str, Any]:
        """What is packed, by its keys; that of the last time is at hand."""
        if self._unpacked is None or self._unpacked[0] is not packed:
            self._unpacked = packed, _object(packed.text)
        return self._unpacked[1]

    def _whole(self, name: str) -> str | None:
        """What a file of details holds, if it is there, and as it was written."""
        with suppress(OSError, ValueError):
            whole = self._details(name).read_text("utf-8")
            if whole[:_AFTER] == _digest(whole[_AFTER:]):
                return "{" + whole[_AFTER + len('", ') :]
        return None

    def _write(self, name: str, text: str) -> None:
        """Write a JSON object, and perhaps more lines, with their digest."""
        rest = f'", {text[1:]}'
        with written_whole(self._details(name)) as temporary:
            temporary.write_text(_digest(rest) + rest, "utf-8")

    @property
    def files(self) -> list[Path]:
        """The files of rows, in the order of their names."""
        names = {part.name for part in self._parts.values() if part.places}
        return [self.results / f"{name}.parquet" for name in sorted(names)]

    def rows(self, cell: Cell, columns: Sequence[str] | None = None) -> Any:
        """The rows of a cell, or some columns of them, as an Arrow table of one chunk.

        Raises:
            LaeError: if the file is damaged; it says what to do.
        """
        _, first, count = self.place(cell)
        return self.file(cell, columns).slice(first, count)

    def file(self, cell: Cell, columns: Sequence[str] | None = None) -> Any:
        """The same of all cells whose rows are in its file (see :meth:`place`)."""
        part, wanted = self._parts[cell.key], None if columns is None else tuple(columns)
        if self._read is None or self._read[:2] != (part.name, wanted):
            self._read = None  # or two of them would be held
            rows = read_rows(self.results / f"{part.name}.parquet", columns)
            self._read = part.name, wanted, rows
        return self._read[2]

    def forget(self) -> None:
        """Let go of what was read last."""
        self._read = self._unpacked = None

    def place(self, cell: Cell) -> tuple[str, int, int]:
        """The file of a finished cell's rows, the first of them in it, and how many they are."""
        part = self._parts[cell.key]
        return part.name, *part.places[cell.key]

    def about(self, cell: Cell) -> Mapping[str, Any]:
        """What is known of a finished cell beside its rows (see :class:`Result`)."""
        about: Mapping[str, Any] = self._opened(self._parts[cell.key].cells)[cell.key]
        return about

    def _details(self, key: str) -> Path:
        return self._about / f"{key}.json"


class Documents(Sequence[Mapping[str, Any]], Generic[Key]):
    """Documents, each made when it is looked at: all at once they may be large.

    Args:
        look: gives that of a key.
        keys: of the documents.
    """

    __slots__ = ("_keys", "_look")

    def __init__(
        self, look: Callable[[Key], Mapping[str, Any] | None], keys: Sequence[Key]
    ) -> None:
        self._look, self._keys = look, keys

    def __len__(self) -> int:
        return len(self._keys)

    @overload
    def __getitem__(self, place: int) -> Mapping[str, Any]: ...
    @overload
    def __getitem__(self, place: slice) -> list[Mapping[str, Any]]: ...
    def __getitem__(self, place: int | slice) -> Mapping[str, Any] | list[Mapping[str, Any]]:
        if isinstance(place, slice):
            return [self[i] for i in range(len(self))[place]]
        document = self._look(self._keys[place])
        if document is None:
            raise LaeError("the study's folder has changed since it ended: run it again")
        return document


def _text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, allow_nan=False)


def _object(text: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(text)
    return document


def _digest(rest: str) -> str:
    """How a file of details begins whose rest this is."""
    return _DIGEST + text_digest(rest)
