"""The pairs of a study's traces: what is compared, and the file in which all pairs are kept.

``comparisons.parquet`` has a row for each pair, with the columns of ``comparisons.csv``. Nothing of
it but what is shown is held in memory: its rows grow with the square of the number of traces.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lae_sim.comparison.pairs import Member, Pairs, pairs_of
from lae_sim.comparison.statistics import RESAMPLES, Difference, Interval
from lae_sim.evaluation.modelled import Ranking
from lae_sim.files import text_digest, written_whole
from lae_sim.replay.world import SIGMA_GRID
from lae_sim.study.records import MEAN, Comparison
from lae_sim.study.summary import Scores, ranked
from lae_sim.trace.columns import from_numpy, from_texts, to_numpy

VERSION = 1
"""Of the pairs; those of another version are computed again."""

MOST = 10_000
"""Pairs that are held as records; of more, those with the best trace of their setting."""

_ROWS = 1 << 16  # of a row group, at least, if there are so many
_TEXTS = ("dataset", "policy", "fps", "latency", "scale", "search", "pre_forecaster", "convention",
          "forecaster", "sigma", "a", "b")  # fmt: skip
_NUMBERS = {  # columns, and the attributes of pairs
    "sequences": "sequences",
    "difference": "difference",
    "difference_low": "low",
    "difference_high": "high",
    "p": "p",
    "better_here": "better_here",
    "better": "better",
    "p_holm": "p_holm",
    "sequences_better": "above",
    "sequences_worse": "below",
}


@dataclass(frozen=True, eq=False)
class Rivals:
    """Traces of one dataset, in one setting, with one forecaster.

    Attributes:
        setting: what they share: the texts of a comparison but `a` and `b`.
        ranked_by: whose AUC is compared, ``"modelled"`` or ``"recorded"``.
        names: of the traces, with that of their times, if from another.
        members: their scores.
        seed: of the resamples.
        cells: keys of the cells that the scores are from.
    """

    setting: Mapping[str, str]
    ranked_by: str
    names: tuple[str, ...]
    members: tuple[Member, ...]
    seed: int
    cells: tuple[str, ...]

    @property
    def key(self) -> str:
        """Digest of all that the pairs depend on."""
        return text_digest(repr((VERSION, RESAMPLES, self.seed, self.ranked_by, self.cells)))

    @property
    def best(self) -> str:
        """Who has the highest mean AUC."""
        means = [
            member.scores.mean(axis=0)[member.counts].mean() if member.counts.any() else -1.0
            for member in self.members
        ]
        return self.names[int(np.argmax(means))]

    def pairs(self) -> Pairs:
        """Each of them against each after it."""
        return pairs_of(self.members, self.seed)


def rivals_of(
    scores: Sequence[Scores], rankings: Mapping[tuple[str, ...], Ranking], seed: int
) -> list[Rivals]:
    """What is to be compared: at the first sigma, or the means over the grid of sigmas."""
    together: dict[tuple[str, ...], list[Scores]] = {}
    for each in scores:
        together.setdefault((*each.group, each.forecaster), []).append(each)
    return [
        _rivals(group, rankings[group[0].group], seed)
        for group in together.values()
        if len(group) > 1
    ]


def _rivals(group: Sequence[Scores], ranking: Ranking, seed: int) -> Rivals:
    first = group[0]
    setting, sigmas = first.setting, first.setting.world.sigmas
    whole = set(SIGMA_GRID) == set(sigmas)
    return Rivals(
        setting={
            "dataset": first.source.metadata.dataset,
            "policy": setting.policy,
            "fps": str(setting.fps),
            "latency": setting.latency,
            "scale": str(setting.world.scale),
            "search": setting.world.search,
            "pre_forecaster": setting.pre_forecaster,
            "convention": first.convention,
            "forecaster": first.forecaster,
            "sigma": MEAN if whole else str(sigmas[0]),
        },
        ranked_by=ranking.by,
        names=tuple(each.setting.run for each in group),
        members=tuple(
            Member(each.sequences, ranked(each.by_repetition(whole), ranking)) for each in group
        ),
        seed=seed,
        cells=tuple(key for each in group for key in each.keys),
    )


@dataclass(frozen=True)
class Place:
    """Where the pairs of some rivals are in the file: row group, first row in it, and how many."""

    group: int
    first: int
    count: int


class PairsFile:
    """The file of all pairs of a study.

    Args:
        path: of the file.
        document: what was kept of it (see :meth:`document`); None if nothing was.
    """

    def __init__(self, path: Path, document: Mapping[str, Any] | None) -> None:
        self.path = path
        self.places: dict[str, Place] = {}
        self._read: tuple[int, Any] | None = None
        with suppress(OSError):
            if document and path.stat().st_size == document["bytes"]:
                self.places = {key: Place(*place) for key, place in document["places"].items()}

    def document(self) -> dict[str, Any]:
        """What is kept of the file, so that its pairs are found again."""
        places = {key: [p.group, p.first, p.count] for key, p in self.places.items()}
        return {"bytes": self.path.stat().st_size, "places": places}

    @property
    def total(self) -> int:
        """How many pairs there are."""
        return sum(place.count for place in self.places.values())

    def write(self, rivals: Iterable[Rivals], found: Callable[[Rivals], Pairs | None]) -> None:
        """Write the pairs of all rivals, in their order; those of None are left out.

        Args:
            rivals: all of the study. What the file has of them is kept, and not looked for.
            found: of others, what was found.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        texts = [*_TEXTS, "ranked_by"]
        places: dict[str, Place] = {}
        waiting: list[Any] = []
        rows = group = 0
        with (
            written_whole(self.path) as temporary,
            pq.ParquetWriter(
                os.fspath(temporary), _schema(), compression="zstd", use_dictionary=texts
            ) as writer,
        ):

            def flush() -> None:
                nonlocal rows, group
                table = pa.concat_tables(waiting)
                writer.write_table(table, row_group_size=max(rows, 1))
                waiting.clear()
                rows, group = 0, group + 1

            for each in rivals:
                if each.key in self.places:
                    table = self.rows(each.key).cast(_schema())
                elif (pairs := found(each)) is not None:
                    table = _table(each, pairs)
                else:
                    continue
                places[each.key] = Place(group, rows, table.num_rows)
                waiting.append(table)
                rows += table.num_rows
                if rows >= _ROWS:
                    flush()
            if waiting:
                flush()
        self.places, self._read = places, None

    def rows(self, key: str) -> Any:
        """The pairs of some rivals, as an Arrow table whose texts are in dictionaries."""
        import pyarrow.parquet as pq

        place = self.places[key]
        if self._read is None or self._read[0] != place.group:
            self._read = None  # or two of them would be held
            texts = [*_TEXTS, "ranked_by"]
            with pq.ParquetFile(os.fspath(self.path), read_dictionary=texts) as file:
                self._read = place.group, file.read_row_group(place.group)
        return self._read[1].slice(place.first, place.count)

    def records(self, rivals: Iterable[Rivals]) -> Iterator[Comparison]:
        """The pairs as records, in the order of the rivals.

        If there are more than :data:`MOST`, of each setting those with its best trace.
        """
        for each in rivals:
            if each.key not in self.places:
                continue
            table = self.rows(each.key)
            if self.total <= MOST:
                yield from map(_record, table.to_pylist())
                continue
            table, of_best = table.combine_chunks(), np.zeros(table.num_rows, bool)
            for side in "ab":
                column = table.column(side).chunk(0)
                names = np.array(column.dictionary.to_pylist())
                of_best |= names[to_numpy(column.indices, "int32")] == each.best
            some = np.flatnonzero(of_best).tolist()
            chosen = [  # take would import pandas
                [column.chunk(0)[row].as_py() for row in some] for column in table.columns
            ]
            for values in zip(*chosen):
                yield _record(dict(zip(table.column_names, values)))


def _schema() -> Any:
    import pyarrow as pa

    def kind(name: str) -> Any:
        return pa.int32() if name.startswith("sequences") else pa.float64()

    return pa.schema([
        *((name, pa.string()) for name in _TEXTS),
        *((name, kind(name)) for name in _NUMBERS),
        ("ranked_by", pa.string()),
    ])  # fmt: skip


def _table(rivals: Rivals, pairs: Pairs) -> Any:
    """The rows of some pairs."""
    import pyarrow as pa

    names, count, schema = from_texts(rivals.names), len(pairs), _schema()
    columns = [from_texts([text], count) for text in rivals.setting.values()]
    for places in (pairs.a, pairs.b):
        chosen = pa.DictionaryArray.from_arrays(from_numpy(places.astype(np.int32)), names)
        columns.append(chosen.cast(pa.string()))
    for name, attribute in _NUMBERS.items():
        values = getattr(pairs, attribute)
        if name.startswith("sequences"):
            columns.append(from_numpy(values.astype(np.int32)))
        else:
            columns.append(from_numpy(values, ~np.isnan(values)))
    columns.append(from_texts([rivals.ranked_by], count))
    return pa.Table.from_arrays(columns, schema=schema)


def _record(row: Mapping[str, Any]) -> Comparison:
    sigma = row["sigma"]
    named = {name: row[name] for name in (*_TEXTS, "sequences", "better_here", "better", "p_holm",
                                          "ranked_by")}  # fmt: skip
    named |= {name: Fraction(row[name]) for name in ("fps", "scale")}
    return Comparison(
        **{**named, "sigma": sigma if sigma == MEAN else Fraction(sigma)},
        difference=Difference(
            row["difference"],
            Interval(row["difference_low"], row["difference_high"]),
            row["p"],
            row["sequences_better"],
            row["sequences_worse"],
        ),
    )
