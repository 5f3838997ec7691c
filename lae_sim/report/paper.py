"""What a paper needs of results: a folder of figures and tables, and the layouts of tables.

In ``figures/`` each figure is a PDF and an SVG. In ``tables/`` each table is LaTeX in two forms,
``NAME.tex`` for a column and ``NAME-long.tex`` for a page, and CSV and Parquet with numbers in
full. ``contents.json`` says what each file shows.
"""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice, product
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim import __version__
from lae_sim.errors import LaeError, visible
from lae_sim.files import csv_cell, staged_folder, text_digest, written_whole
from lae_sim.report.latex import latex_of
from lae_sim.report.table import (
    CHANGE,
    SCORE,
    UNKNOWN,
    Cell,
    Column,
    Table,
    relative_change,
    write_csv,
    write_parquet,
)
from lae_sim.trace.columns import from_values

if TYPE_CHECKING:
    from pandas import DataFrame

    from lae_sim.figures.column import DrawnFigure

CONTENTS = "contents.json"
_ROWS, _CHUNKS = 1 << 10, 64  # of records: rows at once, and how many times these a row group is
FIGURES, TABLES = "figures", "tables"
_OURS = re.compile(rf"({FIGURES}|{TABLES})/[\w-][\w.-]*\.(pdf|svg|tex|csv|parquet)")


@dataclass(frozen=True)
class PaperTable:
    """A table in its forms.

    Attributes:
        whole: for CSV and Parquet.
        long: for LaTeX, as wide as a page.
        short: for LaTeX, as wide as a column.
    """

    whole: Table
    long: Table
    short: Table


@dataclass(frozen=True)
class Records:
    """Rows that are made as they are written, since all at once they may be large.

    Attributes:
        names: of the columns.
        rows: makes all rows anew: plain values by name; what is unknown is None, NaN or not there.
    """

    names: Sequence[str]
    rows: Callable[[], Iterable[Mapping[str, Any]]]


@dataclass(frozen=True)
class Paper:
    """What is written for a paper.

    Attributes:
        figures: figures; of an iterator, drawn when they are asked for.
        tables: tables in all forms.
        frames: tables by name that are CSV and Parquet alone; what may be long as records.
        documents: JSON objects by the name of their file.
    """

    figures: Iterable[DrawnFigure] = ()
    tables: Sequence[PaperTable] = ()
    frames: Mapping[str, DataFrame | Records] = field(default_factory=dict)
    documents: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def write_paper(paper: Paper, folder: str | os.PathLike[str]) -> None:
    """Write figures and tables into a folder, all of them or, if one fails, none.

    They replace files of the same names, and what an earlier call wrote there goes, as far as its
    ``contents.json`` says so. Other files stay.

    Args:
        paper: what to write.
        folder: where to; made if it is not there.

    Raises:
        LaeError: if a file cannot be written.
    """
    root = Path(folder)
    made = not root.exists()
    try:
        root.mkdir(parents=True, exist_ok=True)
        for name in (FIGURES, TABLES):
            if (root / name).exists() and not (root / name).is_dir():
                raise LaeError(f"{root / name}: is there already and is not a folder: move it away")
    except OSError as error:
        raise LaeError(f"cannot write to {root}: {error.strerror}") from error
    try:
        with staged_folder(root) as staging:
            contents = _staged(paper, staging)
            files = [path.relative_to(staging) for path in staging.rglob("*") if path.is_file()]
            for file in files:
                if (root / file).is_dir():
                    raise LaeError(f"{root / file}: is there already and is a folder: move it away")
            old = written_before(root)
            for file in files:
                (root / file).parent.mkdir(exist_ok=True)
                os.replace(staging / file, root / file)
            for path in old - {root / file for file in files}:
                path.unlink(missing_ok=True)  # it would be of other results
        with written_whole(root / CONTENTS) as temporary:
            text = json.dumps(contents, indent=1, ensure_ascii=False)
            temporary.write_text(text + "\n", "utf-8", "backslashreplace")
    finally:
        if made:
            with suppress(OSError):  # it stays if it has come to hold something
                root.rmdir()


def written_before(folder: Path) -> set[Path]:
    """The figures and tables that an earlier call wrote into a folder, as far as it is known."""
    try:
        contents = json.loads((folder / CONTENTS).read_text("utf-8"))
        files = [name for entry in contents["contents"] for name in entry["files"]]
    except (OSError, ValueError, TypeError, KeyError):
        return set()
    ours = [name for name in files if isinstance(name, str) and _OURS.fullmatch(name)]
    return {folder / name for name in ours if (folder / name).is_file()}


def remove_paper(folder: Path) -> None:
    """Remove the figures and tables that an earlier call wrote into a folder."""
    for path in written_before(folder):
        path.unlink(missing_ok=True)
    (folder / CONTENTS).unlink(missing_ok=True)
    for name in (FIGURES, TABLES):
        with suppress(OSError):  # it stays if it holds something else
            (folder / name).rmdir()


def _staged(paper: Paper, staging: Path) -> dict[str, Any]:
    """Write everything into an empty folder; what ``contents.json`` says of it."""
    figures, tables = staging / FIGURES, staging / TABLES
    figures.mkdir()
    tables.mkdir()
    entries, taken = [], set[str]()

    def note(name: str, caption: str, paths: Iterable[Path]) -> None:
        files = sorted(path.relative_to(staging).as_posix() for path in paths)
        entries.append({"name": name, "caption": visible(caption), "files": files})

    for figure in paper.figures:
        name = _file_name(figure.name, taken)
        paths = [figures / f"{name}.{kind}" for kind in figure.files]
        for path, content in zip(paths, figure.files.values()):
            path.write_bytes(content)
        note(name, figure.caption, paths)
    for table in paper.tables:
        note(table.whole.name, table.whole.caption, write_table(table, tables))
    for name, frame in paper.frames.items():
        note(name, "", write_frame(frame, tables / name))
    for name, document in paper.documents.items():
        text = json.dumps(document, indent=1, allow_nan=False)
        (staging / name).write_text(text + "\n", "utf-8")
    return {
        "format": "lae-paper",
        "version": "1.0",
        "lae_sim": __version__,
        "contents": entries,
    }


def _file_name(name: str, taken: set[str]) -> str:
    """A name that LaTeX and every file system take, and that no other figure has."""
    plain = re.sub(r"\.parquet\b", "", visible(name))
    plain = re.sub(r"[^A-Za-z0-9]+", "-", plain).strip("-")[:80]
    if not plain or plain.lower() in taken:
        plain = f"{plain}-{text_digest(name)[:8]}".lstrip("-")
    taken.add(plain.lower())
    return plain


def write_table(table: PaperTable, folder: Path) -> list[Path]:
    """Write a table in all forms into a folder that is there, each file whole; their paths.

    Raises:
        LaeError: if a file cannot be written.
    """
    csv, parquet, short, long = paths = [
        folder / f"{table.whole.name}{end}" for end in (".csv", ".parquet", ".tex", "-long.tex")
    ]
    for path, write in ((csv, write_csv), (parquet, write_parquet)):
        with written_whole(path) as temporary:
            write(table.whole, temporary)
    for path, text in (
        (short, latex_of(_for_latex(table.short))),
        (long, latex_of(_for_latex(table.long), is_long=True)),
    ):
        with written_whole(path) as temporary:
            temporary.write_text(text, "utf-8", "backslashreplace")
    return paths


def write_frame(frame: DataFrame | Records, stem: Path) -> list[Path]:
    """Write a table as CSV and as Parquet, each file whole; their paths.

    Raises:
        LaeError: if a file cannot be written.
    """
    paths = [stem.with_name(f"{stem.name}.{kind}") for kind in ("csv", "parquet")]
    if isinstance(frame, Records):
        _write_records(frame, *paths)
    else:
        for path in paths:
            write_frame_file(frame, path)
    return paths


def _write_records(records: Records, csv_path: Path, parquet_path: Path) -> None:
    """Write rows as they come, with the types that pandas would give their columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema(_kinds(records))
    texts = [field.name for field in schema if field.type == pa.string()]
    floats = [field.name for field in schema if field.type == pa.float64()]
    with (
        written_whole(csv_path) as csv_temporary,
        open(csv_temporary, "w", newline="", encoding="utf-8") as csv_file,
        written_whole(parquet_path) as temporary,
        open(temporary, "wb") as sink,  # whose name need not be UTF-8
        pq.ParquetWriter(sink, schema) as writer,
    ):
        lines = csv.writer(csv_file, lineterminator="\n")
        lines.writerow(records.names)
        rows = iter(records.rows())
        waiting: list[Any] = []
        while some := [dict(row) for row in islice(rows, _ROWS)]:
            for row in some:
                row |= {name: None if _is_unknown(row.get(name)) else float(row[name])
                        for name in floats}  # fmt: skip
                quoted = row | {name: csv_cell(row.get(name)) for name in texts}
                lines.writerow([quoted.get(name) for name in records.names])
            columns = [[row.get(name) for row in some] for name in records.names]
            arrays = [*map(from_values, columns, schema.types)]
            waiting.append(pa.Table.from_arrays(arrays, schema=schema))
            if len(waiting) == _CHUNKS:
                writer.write_table(pa.concat_tables(waiting))
                waiting.clear()
        if waiting:
            writer.write_table(pa.concat_tables(waiting))


def _kinds(records: Records) -> Iterator[tuple[str, Any]]:
    """The columns' types: of whole numbers float64 if some are unknown, as pandas has it."""
    import pyarrow as pa

    found: dict[str, set[type]] = {name: set() for name in records.names}
    partly = set()
    for row in records.rows():
        for name, kinds in found.items():
            value = row.get(name)
            if value is not None:
                kinds.add(type(value))
            if _is_unknown(value):
                partly.add(name)
    for name, kinds in found.items():
        if str in kinds:
            yield name, pa.string()
        elif kinds <= {bool}:
            yield name, pa.bool_() if kinds else pa.null()
        else:
            yield name, pa.float64() if float in kinds or name in partly else pa.int64()


def _is_unknown(value: Any) -> bool:
    return value is None or value != value


def write_frame_file(frame: DataFrame, path: Path) -> None:
    """Write a table of pandas as CSV or Parquet, as its ending says, whole or not at all.

    Raises:
        LaeError: if it cannot be written.
    """
    with written_whole(path) as temporary:
        if path.suffix == ".csv":
            texts = [name for name in frame if frame[name].dtype.kind == "O"]
            quoted = {name: [*map(csv_cell, frame[name])] for name in texts}
            frame.assign(**quoted).to_csv(temporary, index=False, encoding="utf-8")
        else:
            with open(temporary, "wb") as file:  # whose name need not be UTF-8
                frame.to_parquet(file, index=False)


MOST_ROWS = 50
"""More rows of a table do not fit a page."""


def _for_latex(table: Table) -> Table:
    """A table whose labels that are the same in all rows are in its caption, and that fits."""
    if (count := len(table.rows)) > MOST_ROWS:
        caption = f"{table.caption}; {MOST_ROWS} of {count:,} rows, all in {table.name}.csv"
        table = replace(table, rows=table.rows[:MOST_ROWS], caption=caption)
    constant = {
        place: row[place].text
        for row in table.rows[:1]
        for place, column in enumerate(table.columns)
        if place and column.is_label and len({each[place].text for each in table.rows}) == 1
    }
    if table.groups or not constant:
        return table
    said = ", ".join(f"{table.columns[place].title} {text}" for place, text in constant.items())
    kept = table.only(lambda place, _: place not in constant)
    return replace(kept, caption=f"{table.caption}; {said}")


@dataclass(frozen=True)
class TrackerScores:
    """The mean scores of a tracker on a dataset, with one forecaster.

    Attributes:
        tracker, dataset, forecaster: names.
        scores: under latency, ``auc`` and ``dp20``; None if unknown.
        offline: without latency, likewise.
    """

    tracker: str
    dataset: str
    forecaster: str
    scores: Mapping[str, float | None]
    offline: Mapping[str, float | None]


def with_and_without(
    rows: Sequence[TrackerScores],
    forecasters: Iterable[str],
    titles: Mapping[str, str],
    setting: str,
) -> Table:
    """Trackers with and without forecasters in rows, datasets in columns.

    In the manner of Table II of Li et al., "Predictive Visual Tracking", 2021: AUC and DP of each
    dataset, and how they change: without a forecaster relative to offline, with one relative to
    without. (Rows and columns are ours; the print may order them otherwise.)

    Args:
        rows: what there is; of several of the same names the last.
        forecasters: in the order of the rows of a tracker.
        titles: what the metrics are called.
        setting: what all rows have in common, in words.
    """
    by_name = {(row.tracker, row.dataset, row.forecaster): row for row in rows}
    trackers = dict.fromkeys(row.tracker for row in rows)

    def columns(dataset: str, metric: str, title: str) -> list[Column]:
        """A score and its change; records are a tracker and a forecaster."""

        def score(record: tuple[str, str]) -> float | None:
            tracker, forecaster = record
            offline = forecaster == "offline"
            row = by_name.get((tracker, dataset, "hold" if offline else forecaster))
            return None if row is None else (row.offline if offline else row.scores)[metric]

        def change(record: tuple[str, str]) -> float | None:
            tracker, forecaster = record
            if forecaster == "offline":
                return None
            before = "offline" if forecaster == "hold" else "hold"
            return relative_change(score(record), score((tracker, before)))

        group, key = visible(dataset), title.replace("DP", "dp20").replace("AUC", "auc")
        return [
            Column(title, score, SCORE, group=group, name=key),
            Column("Δ", change, CHANGE, group=group, name=f"{key}_change"),
        ]

    scores = [
        column
        for dataset in dict.fromkeys(row.dataset for row in rows)
        for metric, title in titles.items()
        for column in columns(dataset, metric, title)
    ]
    table = Table.of(
        [
            Column("tracker", itemgetter(0), is_label=True),
            Column("forecaster", itemgetter(1), is_label=True),
            *scores,
        ],
        product(trackers, dict.fromkeys(("offline", *forecasters))),
        "table2",
        f"Trackers with and without forecasters{_CHANGES}; the best of each column under latency "
        f"is bold, the second underlined; {setting}",
    )
    places = [c for c, column in enumerate(table.columns) if column.form is SCORE]
    known = [row for row in table.rows if any(row[c] != UNKNOWN for c in places)]
    return replace(table, rows=_with_ranks(known, places))


_CHANGES = ": hold changes relative to offline, forecasters relative to hold"


def in_two_forms(table: Table) -> PaperTable:
    """The table of :func:`with_and_without`; of many datasets a column holds one score each."""
    datasets = len(table.groups)
    titles = ("AUC", "mAUC") if datasets > 2 else ("AUC", "mAUC", "DP", "mDP")
    short = table.only(lambda _, column: column.is_label or column.title in titles)
    return PaperTable(table, table, replace(short, caption=table.caption.replace(_CHANGES, "")))


def _with_ranks(
    rows: Iterable[tuple[Cell, ...]], columns: Sequence[int]
) -> tuple[tuple[Cell, ...], ...]:
    """Mark the best and the second best of some columns, but for offline."""
    lines = [list(row) for row in rows]
    for c in columns:
        online = [line for line in lines if line[1].value != "offline" and line[c].value]
        for rank, text in enumerate(sorted({line[c].text for line in online})[:-3:-1], 1):
            for line in online:  # what reads the same is as good
                if line[c].text == text:
                    line[c] = replace(line[c], rank=rank)
    return tuple(map(tuple, lines))
