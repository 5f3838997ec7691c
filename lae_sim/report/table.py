"""Tables: columns that say how records are shown, as aligned text, CSV and Parquet.

LaTeX is made by :mod:`lae_sim.report.latex`, and HTML by the template of the page (see
:mod:`lae_sim.report.page`).
"""

from __future__ import annotations

import csv
import os
import re
import textwrap
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from lae_sim.errors import visible
from lae_sim.files import csv_cell
from lae_sim.trace.columns import from_values

Interval = tuple[float, float]


@dataclass(frozen=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: as people read it.
        value: what it is sorted by, and what CSV holds; None if unknown.
        interval: around the value, if it has one.
        rank: 1 or 2 if it is the best or second best of its column.
    """

    text: str
    value: float | str | None
    interval: Interval | None = None
    rank: int = 0


UNKNOWN = Cell("-", None)


@dataclass(frozen=True)
class Number:
    """How numbers are written: called with one, it gives the text; a dash for None and NaN.

    Attributes:
        form: a format specification.
        factor: what the number is multiplied by.
        unit: what follows it.
        ends: the format specification of an interval's ends, if it is another.
    """

    form: str = ".3f"
    factor: float = 1
    unit: str = ""
    ends: str = ""

    def __call__(self, value: float | None, interval: Interval | None = None) -> str:
        """A number as text, with its interval in brackets."""
        if is_unknown(value):
            return UNKNOWN.text
        text = f"{self.factor * value:{self.form}}{self.unit}"  # type: ignore[operator]
        if interval is None:
            return text
        low, high = (f"{self.factor * end:{self.ends or self.form}}" for end in interval)
        return f"{text} [{low}, {high}]"


SCORE, SIGNED, COUNT = Number(), Number("+.3f"), Number(",")
FINE_SCORE = Number(".4f")
PERCENT, CHANGE = Number(".1f", 100, "%"), Number("+.1f", 100, "%")


def is_unknown(value: Any) -> bool:
    """Whether a value is None or NaN."""
    return value is None or value != value


def ends_text(low: float | None, high: float | None) -> str | None:
    """The ends of a score's interval, such as ``"[0.386, 0.423]"``; None where they are unknown."""
    return None if is_unknown(low) else f"[{SCORE(low)}, {SCORE(high)}]"


def p_label(p: float | None) -> str:
    """A p value as text: ``"0.013"``, ``"<0.001"``, or ``"-"`` if it is not known."""
    return "<0.001" if not is_unknown(p) and p < 0.001 else SCORE(p)  # type: ignore[operator]


def relative_change(value: float | None, before: float | None) -> float | None:
    """How much larger a value is, relative to what it was; None if that is unknown or 0."""
    return None if value is None or not before else value / before - 1


@dataclass(frozen=True)
class Column:
    """A column: what of a record it shows, and how.

    Attributes:
        title: its heading.
        value: the name of a value of the record (or mapping), which has an interval if there are
            ``NAME_low`` and ``NAME_high`` beside it; or a function of the record, which gives a
            value or a whole `Cell`.
        form: makes text of a value, and of a value and its interval.
        meaning: what the column holds, where the heading does not say it.
        is_label: whether it names the rows; such columns come first, and are left-aligned.
        group: a heading above this and the neighbouring columns of the same group.
        name: its heading in CSV and Parquet, if it is not the name of the value.
        importance: where there is no room for all columns, those of the least are left out; 5 is
            that of most.
    """

    title: str
    value: str | Callable[[Any], Any]
    form: Callable[..., str] = visible
    meaning: str = ""
    is_label: bool = False
    group: str = ""
    name: str = ""
    importance: int = 5

    @property
    def key(self) -> str:
        """Its heading in CSV and Parquet, with the unit."""
        plain = re.sub(r"\W+", "_", self.title).strip("_").lower()
        return self.name or (self.value if isinstance(self.value, str) else plain)

    def cell(self, record: Any) -> Cell:
        """What the column shows of a record."""
        value = _get(record, self.value) if isinstance(self.value, str) else self.value(record)
        if isinstance(value, Cell):
            return value
        if is_unknown(value):
            return UNKNOWN
        low, high = _get(record, f"{self.value}_low"), _get(record, f"{self.value}_high")
        if is_unknown(low):
            return Cell(self.form(value), value)
        return Cell(self.form(value, (low, high)), value, (low, high))


def _get(record: Any, name: str) -> Any:
    """A value of a record or a mapping; None if there is none."""
    return record.get(name) if isinstance(record, Mapping) else getattr(record, name, None)


@dataclass(frozen=True)
class Table:
    """A table, to be shown as text, CSV, LaTeX or HTML.

    Attributes:
        name: of its files.
        caption: what it shows.
        columns: its columns.
        rows: a cell per column.
        note: what else there is to say.
    """

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    @classmethod
    def of(
        cls, columns: Iterable[Column], records: Iterable[Any], name: str = "", caption: str = ""
    ) -> Table:
        """The table with a row per record."""
        columns = tuple(columns)
        rows = tuple(tuple(column.cell(record) for column in columns) for record in records)
        return cls(name, caption, columns, rows)

    @property
    def header(self) -> tuple[str, ...]:
        """The titles of the columns."""
        return tuple(column.title for column in self.columns)

    @property
    def labels(self) -> int:
        """The number of columns that name the rows."""
        return sum(column.is_label for column in self.columns)

    def only(self, keep: Callable[[int, Column], bool]) -> Table:
        """The table of the columns that are to be kept, told by their place and themselves."""
        kept = [place for place, column in enumerate(self.columns) if keep(place, column)]
        rows = tuple(tuple(row[place] for place in kept) for row in self.rows)
        return replace(self, columns=tuple(self.columns[place] for place in kept), rows=rows)

    def first(self, most: int, rest: str) -> Table:
        """The table of the first rows; where there are more, its note says how many, and where.

        Args:
            most: rows that are kept.
            rest: where all of them are.
        """
        if len(self.rows) <= most:
            return self
        said = f"The first {most:,} of {len(self.rows):,} rows; all are in {rest}."
        return replace(self, rows=self.rows[:most], note=f"{self.note} {said}".lstrip())

    @property
    def minor(self) -> set[int]:
        """The places of columns that need not be seen: unimportant, or of one label alone."""
        return {
            place
            for place, column in enumerate(self.columns)
            if column.importance < 4
            or (place and column.is_label and len(self.rows) > 1 and self._is_constant(place))
        }

    def _is_constant(self, place: int) -> bool:
        return len({row[place].text for row in self.rows}) == 1

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the other columns, each with the number of its columns."""
        titles = [column.group for column in self.columns if column.group]
        return [(title, len(list(members))) for title, members in groupby(titles)]


def text_of(table: Table, intervals: Container[str] | None = None, width: int | None = None) -> str:
    """A table as aligned text, for a terminal.

    Args:
        table: the table.
        intervals: titles of the columns that show their intervals; by default all.
        width: columns of letters that it may take; as many as it needs if None. Where they do not
            suffice, names are shortened and columns left out, of which a line below says.
    """

    def text(column: Column, cell: Cell) -> str:
        left_out = cell.interval and intervals is not None and column.title not in intervals
        return column.form(cell.value) if left_out else cell.text

    lines = [[*map(text, table.columns, row)] for row in table.rows]
    return _fitted(table.columns, lines, width)


def text_of_records(
    columns: Sequence[Column], records: Iterable[Any], width: int | None = None
) -> str:
    """The text of the table of these records, of which no more is kept than their texts.

    Args:
        columns: of the table.
        records: a row each.
        width: as of :func:`text_of`.
    """
    lines = [[column.cell(record).text for column in columns] for record in records]
    return _fitted(columns, lines, width)


_LONG, _SHORT = 24, 12
"""Letters to which names are shortened for the sake of any column, and of the most important."""
_MOST_IMPORTANT = 8


def _fitted(columns: Sequence[Column], lines: Iterable[Sequence[str]], width: int | None) -> str:
    """Columns of text that fit a width, and which were left out for that.

    Args:
        columns: what they are; those that name the rows come first.
        lines: a text for each column.
        width: in letters; None if there is room for all.
    """
    labels = sum(column.is_label for column in columns)
    texts = [[*map(visible, each)] for each in zip((column.title for column in columns), *lines)]
    if width is None:
        return aligned(*_lines_of(texts), labels)

    def size(c: int) -> int:
        return max(map(len, texts[c]))

    def excess(shown: Container[int]) -> int:
        """By how many letters these columns are too wide."""
        widths = [size(c) + 2 for c in range(len(columns)) if c in shown]
        return sum(widths) - 2 - width

    def shorten(shown: Container[int], least: int) -> None:
        """Shorten the longest names as far as is needed, to no less than so many letters."""
        for c in sorted(range(labels), key=size, reverse=True):
            over = excess(shown)
            if over > 0:
                texts[c] = _shortened(texts[c], max(size(c) - over, least, len(columns[c].title)))

    shorten(range(len(columns)), _LONG)
    shown = {*range(labels)}
    for c in sorted(range(labels, len(columns)), key=lambda c: (-columns[c].importance, c)):
        before = [*texts]
        if columns[c].importance >= _MOST_IMPORTANT:
            shorten({*shown, c}, _SHORT)
        if excess({*shown, c}) <= 0 or len(shown) == labels:
            shown.add(c)
        else:
            texts = before
    text = aligned(*_lines_of([texts[c] for c in sorted(shown)]), labels)
    titles = [column.title for column in columns]
    missing = [
        (each.name if titles.count(each.title) > 1 else "") or each.title
        for c, each in enumerate(columns)
        if c not in shown
    ]
    if not missing:
        return text
    said = f"left out for want of room: {', '.join(missing)}; --json has all of it"
    return f"{text}\n{textwrap.fill(said, max(width, 40), break_on_hyphens=False)}"


def _lines_of(texts: Sequence[Sequence[str]]) -> tuple[Sequence[str], list[Sequence[str]]]:
    """The header and the lines of columns."""
    header, *lines = map(list, zip(*texts))
    return header, [*lines]


def _shortened(names: list[str], most: int) -> list[str]:
    """Names of at most so many letters, or of some more where they would be the same."""
    for size in range(most, max(map(len, names))):
        end = (size - 3) // 2
        cut = [n if len(n) <= size else f"{n[: size - 3 - end]}...{n[-end:]}" for n in names]
        if len({*cut}) == len({*names}):
            return cut
    return names


def legend_of(table: Table) -> str:
    """What the columns mean, in lines that fit a terminal."""
    parts = [f"{column.title}: {column.meaning}" for column in table.columns if column.meaning]
    return filled("; ".join(parts + [table.note] * bool(table.note)))


def filled(text: str) -> str:
    """A text in lines that fit a terminal."""
    return textwrap.fill(text, 100, break_on_hyphens=False, break_long_words=False)


def aligned(header: Sequence[str], lines: Sequence[Sequence[str]], labels: int = 2) -> str:
    """Columns of text: the first ``labels`` to the left, the others to the right."""
    header, lines = [*map(visible, header)], [[*map(visible, line)] for line in lines]
    widths = [max(map(len, column)) for column in zip(header, *lines)]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.ljust(width) if i < labels else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths))
        ]
        return "  ".join(padded).rstrip()

    return "\n".join(map(line, [header, ["-" * width for width in widths], *lines]))


def columns_of(table: Table) -> list[tuple[str, list[Any]]]:
    """What CSV and Parquet hold: a name and the values of each column, numbers in full.

    An interval has two columns after its value's, of its name and ``_low`` and ``_high``.
    """
    columns: list[tuple[str, list[Any]]] = []
    for place, column in enumerate(table.columns):
        cells = [row[place] for row in table.rows]
        name = f"{column.group} {column.key}".lstrip()
        columns.append((name, [cell.value for cell in cells]))
        if any(cell.interval for cell in cells):
            for end, which in enumerate(("low", "high")):
                ends = [cell.interval and cell.interval[end] for cell in cells]
                columns.append((f"{name}_{which}", ends))
    return columns


def write_csv(table: Table, path: Path) -> None:
    """Write a table as CSV, with numbers in full; what is unknown is empty."""
    names, columns = zip(*columns_of(table))
    with open(path, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(map(csv_cell, names))
        writer.writerows(map(csv_cell, line) for line in zip(*columns))


def write_parquet(table: Table, path: Path) -> None:
    """Write a table as Parquet, with numbers in full; what is unknown is null."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {}
    for name, values in columns_of(table):
        known = [value for value in values if value is not None]
        kind = pa.int64() if known else pa.null()
        if any(isinstance(value, str) for value in known):
            kind, values = pa.string(), [value and visible(value) for value in values]
        elif any(isinstance(value, float) for value in known):
            kind = pa.float64()
        elif any(isinstance(value, bool) for value in known):
            kind = pa.bool_()
        arrays[visible(name)] = from_values(values, kind)  # pa.array would import pandas
    with pa.OSFile(os.fsencode(path), "wb") as sink:
        pq.write_table(pa.table(arrays), sink)
