"""What a study says, in words: which tracker and forecaster is best, and how slow they may be.

Nothing is computed here: scores, intervals and p are those of the summary, and what a required AUC
asks for is that of its records. All sentences of a study's conclusion are made here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

from lae_sim.engine.clock import Clock
from lae_sim.errors import listed, visible
from lae_sim.study.records import MEAN, Requirement, SummaryRow

LEVEL = 0.05
"""A difference whose corrected p is below is called one."""

CLIFF = 0.008
"""An AUC that falls by more from one hundredth of the scale to the next falls off a cliff."""

MOST_SETTINGS, MOST_REQUIRED, MOST_NAMES, MOST_SHORTFALLS = 4, 2, 3, 6
"""How much is said, at most, whatever the number of trackers: the rest is counted."""

SETTINGS = ("policy", "fps", "latency", "search", "pre_forecaster", "convention")
"""What sentences say of a setting where it differs, beside dataset and scale."""

Names: TypeAlias = Mapping[str, str]
Row: TypeAlias = SummaryRow | Requirement


def names_of(rows: Sequence[SummaryRow]) -> dict[str, str]:
    """Names of the runs: their trackers, where these tell the runs of each dataset apart."""
    runs = {row.run: (row.dataset, row.tracker) for row in rows}
    alone = len({*runs.values()}) == len(runs)
    alone &= all(tracker != "unknown" for _, tracker in runs.values())
    return {run: visible(tracker if alone else run) for run, (_, tracker) in runs.items()}


def verdict(summary: Sequence[SummaryRow], required: Sequence[Requirement] = ()) -> list[str]:
    """The conclusion of a study: a sentence or two per setting, and per required AUC.

    At most :data:`MOST_SETTINGS` and :data:`MOST_REQUIRED` of them. Scores are those of the
    ranking: of the first sigma, or means over the grid of them.
    """
    rows = [row for row in summary if row.certainty("auc") and row.score("auc") is not None]
    if any(row.sigma == MEAN for row in rows):
        rows = [row for row in rows if row.sigma == MEAN]
    contests, names = _contests(rows), names_of(summary)
    contests = sorted(contests, key=lambda each: not _is_alike(each.best, contests[0].best))
    where = _in_words([_setting(contest.best) for contest in contests])
    alike = Counter(where)  # where some traces of a setting have other sequences
    where = [
        f"{text}{', ' * bool(text)}on {each.best.sequences} sequences" if alike[text] > 1 else text
        for each, text in zip(contests, where)
    ]
    shown = len(contests) if len(contests) <= MOST_SETTINGS else MOST_SETTINGS - 1
    lines = [_sentence(*each, names) for each in zip(contests[:shown], where)]
    if others := contests[shown:]:
        winners = Counter(_pair(contest.best, names) for contest in others)
        said = [f"{pair} ({count})" for pair, count in winners.most_common()]
        lines.append(f"In {len(others)} more settings the best is {listed(said, MOST_NAMES)}.")
    return lines + _required_in_words(summary, required, names)


@dataclass(frozen=True)
class _Contest:
    """The best of a setting, and those that are compared with it, nearest first."""

    best: SummaryRow
    others: tuple[SummaryRow, ...]


def _contests(rows: Sequence[SummaryRow]) -> list[_Contest]:
    """The rows of each setting that have the same sequences, in the order of the first of them."""
    together: dict[tuple[object, ...], list[SummaryRow]] = {}
    for row in rows:
        best = (row.run, row.forecaster) if row.behind is None else row.behind.best
        together.setdefault((*_setting(row).values(), best), []).append(row)
    return [
        _Contest(best, tuple(sorted(others, key=lambda row: -(row.score("auc") or 0))))
        for some in together.values()
        for best in some
        if best.behind is None
        for others in [[row for row in some if row.behind is not None]]
    ]


def _setting(row: Row, dataset: str = "") -> dict[str, object]:
    """What a row's score depends on, beside tracker and forecaster."""
    own = {"scale": row.scale, "dataset": row.dataset} if isinstance(row, SummaryRow) else {}
    return {"dataset": dataset, **own, **{name: getattr(row, name) for name in SETTINGS}}


def _is_alike(row: Row, first: Row) -> bool:
    """Whether settings, scales apart, are those that the study names first."""
    return all(getattr(row, name) == getattr(first, name) for name in SETTINGS)


def _sentence(contest: _Contest, where: str, names: Names) -> str:
    """Who is best, who may be as good, who is next."""
    best, others = contest.best, contest.others
    lead = f"{where[0].upper()}{where[1:]}, " if where else ""
    score, interval = f"{best.score('auc'):.3f}", ""
    certainty = best.certainty("auc")
    if certainty is not None and best.sequences > 1:
        interval = f" [{certainty.interval.low:.3f}, {certainty.interval.high:.3f}]"
    named = f"{lead}{_pair(best, names)}"
    scored = f"{_score_name(best)} {score}{interval}"
    if not others:
        return f"{named} has {scored}; there is nothing to compare it with."
    parts = [f"{named} is best: {scored}"]
    alike = [row for row in others if _p(row) >= LEVEL]
    behind = [row for row in others if _p(row) < LEVEL]
    if alike and _too_few(best, len(others)):
        few = "one sequence is" if best.sequences == 1 else f"{best.sequences} sequences are"
        parts.append(
            f"{few} too few to tell {len(others) + 1} pairs apart; the nearest, "
            f"{_pair(alike[0], names)}, {_gap(alike[0])}"
        )
        parts[-1] = parts[-1].partition(", p ")[0] if best.sequences == 1 else parts[-1]
    elif alike:
        said = listed([_pair(row, names) for row in alike], MOST_NAMES)
        parts.append(f"no difference shown: {said} ({_alike(alike)})")
    if behind:
        parts.append(f"{'next, ' * bool(alike)}{_pair(behind[0], names)} {_gap(behind[0])}")
        trackers = {*map(_tracker, (best, *alike, behind[0]))}
        if another := next((row for row in behind if _tracker(row) not in trackers), None):
            parts.append(f"the next tracker, {_pair(another, names)}, {_gap(another)}")
    if rival := _best_by_model(contest):
        assumed = (
            "" if rival.modelled is not None and rival.modelled.known else ", its reach assumed"
        )
        parts.append(
            f"by the search model{assumed}, {_pair(rival, names)} would be best: "
            f"{_by_model(rival):.3f}"
        )
    return "; ".join(parts) + "."


def _tracker(row: SummaryRow) -> str:
    return row.run if row.tracker == "unknown" else row.tracker


def _alike(alike: Sequence[SummaryRow]) -> str:
    """How far those are behind of whom no difference is shown."""
    least = min(map(_p, alike))
    return f"up to {max(_distance(row) for row in alike):.3f} behind, p at least {least:.3f}"


def _too_few(best: SummaryRow, others: int) -> bool:
    """Whether no differences of so few sequences could be told from none."""
    return best.sequences < 60 and others * 2.0 ** (1 - best.sequences) >= LEVEL


def _best_by_model(contest: _Contest) -> SummaryRow | None:
    """Whom the search model would name, if it is another than the recorded boxes name."""
    rows = (contest.best, *contest.others)
    if contest.best.ranked_by == "modelled" or all(row.modelled is None for row in rows):
        return None
    best = max(rows, key=_by_model)
    return best if _by_model(best) > _by_model(contest.best) else None


def _by_model(row: SummaryRow) -> float:
    scores = row.scores if row.modelled is None else row.modelled.scores
    return scores["auc"] or 0.0


def _p(row: SummaryRow) -> float:
    return 1.0 if row.behind is None else row.behind.p_holm


def _distance(row: SummaryRow) -> float:
    return 0.0 if row.behind is None else max(0.0, -row.behind.difference.value)


def _gap(row: SummaryRow) -> str:
    """How far a row is behind the best, and how sure that is."""
    p = _p(row)
    return f"is {_distance(row):.3f} behind, p {'< 0.001' if p < 0.001 else f'= {p:.3f}'}"


def _pair(row: Row, names: Names) -> str:
    return f"{names.get(row.run, visible(row.run))} with {visible(row.forecaster)}"


def _score_name(row: SummaryRow) -> str:
    name = "mAUC" if row.sigma == MEAN else "AUC"
    name = f"modelled {name}" if row.ranked_by == "modelled" else name
    return name if row.sigma in (0, MEAN) else f"{name} at sigma {row.sigma}"


def _in_words(settings: Sequence[Mapping[str, object]]) -> list[str]:
    """What tells some settings apart, in words; the scales too, unless all are 1."""
    differ = {
        key
        for setting in settings
        for key, value in setting.items()
        if value != settings[0][key] or (key == "scale" and value != 1)
    }
    return [
        _joined({key: value for key, value in setting.items() if key in differ})
        for setting in settings
    ]


def _joined(setting: Mapping[str, object]) -> str:
    """Scale, dataset and rate, then the names of what else there is."""
    named = dict(setting)
    scale, dataset, fps = (named.pop(key, None) for key in ("scale", "dataset", "fps"))
    parts = [_scale_in_words(scale)] if isinstance(scale, Fraction) else []
    parts += [f"on {visible(dataset)}"] if dataset is not None else []
    parts += [f"in a world of {fps} fps"] if fps is not None else []
    others = [f"{key.replace('_', '-')} {visible(value)}" for key, value in named.items()]
    return ", ".join([*parts, *(["with " + ", ".join(others)] if others else [])])


def _scale_in_words(scale: Fraction) -> str:
    named = {
        Fraction(0): "without latency",
        Fraction(1, 2): "at half the time",
        Fraction(1): "at the times as they are",
        Fraction(2): "at twice the time",
    }
    return named.get(scale, f"at {float(scale):g} times the time")


# ------------------------------------------------------------------------------ required AUCs


def device_in_words(row: Requirement) -> str:
    """What an AUC asks of a device, against the times that were replayed."""
    scale = row.safe_scale
    if scale is None:
        return "not even without latency"
    if scale == 0:
        return "only without latency"
    if scale < 1:
        return f"must be {float(1 / scale):.2f} times faster"
    more = " or more" if row.next_auc is None else ""
    return f"may be {float(scale):.2f} times slower{more}" if scale > 1 else "no slower than it is"


def time_in_words(row: Requirement) -> str:
    """The slowest time of a frame and its rate, such as ``"125 ms a frame (8 fps)"``."""
    ms, fps = row.safe_ms_per_frame, row.safe_frames_per_second
    if ms is None or fps is None:
        return ""
    return f"{significant(ms)} ms a frame ({significant(fps)} fps)"


def significant(value: float) -> str:
    """A number above 0 to three significant digits, without an exponent."""
    digits = 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3
    return f"{value:,.{digits}f}"


def _required_in_words(
    summary: Sequence[SummaryRow], required: Sequence[Requirement], names: Names
) -> list[str]:
    """Who may be slowest for each AUC that is asked."""
    datasets = {row.run: row.dataset for row in summary}
    rivals: dict[tuple[object, ...], list[Requirement]] = {}
    for row in required:
        setting = _setting(row, datasets.get(row.run, ""))
        rivals.setdefault((*setting.values(), row.required_auc), []).append(row)
    groups = sorted(
        rivals.values(), key=lambda rows: not _is_alike(rows[0], required[0])
    )  # the first setting first
    where = _in_words([_setting(rows[0], datasets.get(rows[0].run, "")) for rows in groups])
    lines = [_slack(*each, names) for each in zip(groups[:MOST_REQUIRED], where)]
    if len(groups) > MOST_REQUIRED:
        lines[-1] += f" ({len(groups) - MOST_REQUIRED} more in required.csv.)"
    return lines


def _slack(rows: Sequence[Requirement], where: str, names: Names) -> str:
    """Who may be slowest for an AUC."""
    auc = f"an AUC of {rows[0].required_auc:.3g}{f' {where}' if where else ''}"
    best = max(rows, key=lambda row: -1 if row.safe_scale is None else row.safe_scale)
    if best.safe_scale is None:
        most = max(row.auc_without_latency for row in rows)
        return f"Nothing has {auc}, not even without latency: at most {most:.3f}."
    if best.safe_scale == 0:
        return (
            f"Nothing has {auc} but without latency: {_pair(best, names)} would, with "
            f"{best.auc_without_latency:.3f}."
        )
    what = "comes nearest" if best.safe_scale < 1 else "has most to spare"
    said = f"{_pair(best, names)} {what}: it {device_in_words(best)}"
    time = time_in_words(best)
    said += f", {time}" if time else ""
    without = sum(not row.safe_scale for row in rows)
    none = f"; {without} of {len(rows)} pairs cannot have it with any latency" if without else ""
    return f"For {auc}, {said}{none}."


def shortfalls(required: Sequence[Requirement], names: Names) -> list[str]:
    """Where an AUC is no steady function of the times: cliffs, and stretches that come again.

    Of the most rows that can be said; the last line counts the others.
    """
    where = [f", {each}" if each else "" for each in _in_words([_setting(r) for r in required])]
    said = [
        f"{_pair(row, names)}{setting}, AUC {row.required_auc:.3g}: {'; '.join(parts)}"
        for row, setting in zip(required, where)
        if (parts := [*_stretches(row), *_cliff(row)])
    ]
    if len(said) > MOST_SHORTFALLS:
        rest = len(said) - MOST_SHORTFALLS + 1
        said[MOST_SHORTFALLS - 1 :] = [f"and {rest} more, in required.csv: stretches, next_auc"]
    return said


def _stretches(row: Requirement) -> list[str]:
    """Whether there are times at which the AUC is reached again."""
    if len(row.stretches) < 2:
        return []
    some = listed([_from_to(*stretch) for stretch in row.stretches], MOST_NAMES)
    return [f"reached at {some} times the time, and not between"]


def _from_to(low: Fraction, high: Fraction) -> str:
    return f"{float(low):g}" if low == high else f"{float(low):g} to {float(high):g}"


def _cliff(row: Requirement) -> list[str]:
    """Whether a little slower costs much at once."""
    if row.safe_auc is None or row.next_auc is None or not row.safe_scale:
        return []
    if row.safe_auc - row.next_auc <= CLIFF:
        return []
    said = f"a cliff: {row.safe_auc:.3f} there, {row.next_auc:.3f} one hundredth slower"
    return [f"{said}{_outlasts(row)}"]


def _outlasts(row: Requirement) -> str:
    """Whether that is where a call begins to outlast a frame of the camera, or several."""
    ms, scale = row.safe_ms_per_frame, row.safe_scale
    if ms is None or not scale:
        return ""
    frame_ms = Clock.at(row.fps).milliseconds(1)
    frames = int(ms / frame_ms * float((scale + Fraction(1, 100)) / scale))
    if not frames or ms > frames * frame_ms * (1 + 1e-9):
        return ""
    what = "a frame" if frames == 1 else f"{frames} frames"
    return f", where a call outlasts {what} of the camera ({significant(frames * frame_ms)} ms)"
