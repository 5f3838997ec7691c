"""The conclusion in words: who is best, who may be as good, how slow it may be; never much."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lae_sim.comparison.statistics import Bootstrap
from lae_sim.evaluation.modelled import Ranking
from lae_sim.report.table import p_label
from lae_sim.study.records import (
    MEAN,
    Modelled,
    Requirement,
    SummaryRow,
    Uncertainty,
)
from lae_sim.study.summary import Scores, _behind
from lae_sim.study.uncertainty import Answers, Resamples
from lae_sim.study.verdict import (
    LEVEL,
    MOST_REQUIRED,
    MOST_SETTINGS,
    MOST_SHORTFALLS,
    device_in_words,
    names_of,
    shortfalls,
    significant,
    time_in_words,
    verdict,
)

RECORDED = Ranking(False, "")
BOOTSTRAP = Bootstrap(200)


def setting(pairs: Mapping[tuple[str, str], Sequence[float]], **values: Any) -> list[SummaryRow]:
    """The rows of a setting: scores by sequence of each tracker and forecaster."""
    rows, scores = [], []
    for (tracker, forecaster), by_sequence in pairs.items():
        auc = np.array(by_sequence, float)
        [means] = BOOTSTRAP.means(auc[None])
        row = SummaryRow(
            trace=f"{tracker}.trace", tracker=tracker, dataset="D", device="unknown",
            times_from=f"{tracker}.trace", policy="latest", fps=Fraction(30), latency="recorded",
            scale=Fraction(1), search="trace", pre_forecaster="none", convention="pysot",
            forecaster=forecaster, sequences=len(auc), repetitions=1, engine="batch", exact=True,
            approximate_share=0.0, elapsed_ms=20.0, init_ms=20.0, init_source="measured",
            skip_rate=0.0, sigma=Fraction(0), scores={"auc": float(auc.mean())}, offline={},
            uncertainty={"auc": Uncertainty(BOOTSTRAP.interval(means))},
        )  # fmt: skip
        rows.append(dataclasses.replace(row, **values))
        one = SimpleNamespace(
            keys=(tracker, forecaster, *by_sequence),
            sequences=tuple(map(str, range(len(auc)))),
            by_repetition=lambda over_sigmas, auc=auc: {"auc": auc[None]},
        )
        scores.append(cast(Scores, one))
    behind = _behind(list(zip(rows, scores)), RECORDED, Resamples(0, 200), Answers())
    return [dataclasses.replace(row, behind=each) for row, each in zip(rows, behind)]


def around(mean: float, count: int = 20) -> list[float]:
    return [mean + 0.001 * (i % 7) for i in range(count)]


CLEAR = {
    ("SiamFC", "hold"): around(0.55),
    ("SiamFC", "kalman"): around(0.54),
    ("kcf", "hold"): around(0.43),
    ("kcf", "kalman"): around(0.45),
}


def test_the_best_the_next_and_the_next_tracker() -> None:
    [line] = verdict(setting(CLEAR))
    assert line == (
        "SiamFC with hold is best: AUC 0.553 [0.552, 0.554]; SiamFC with kalman is 0.010 behind, "
        "p < 0.001; the next tracker, kcf with kalman, is 0.100 behind, p < 0.001."
    )


def test_those_as_good_are_named_with_the_least_p() -> None:
    rng = np.random.default_rng(1)
    noisy = {(f"T{i}", "hold"): (0.5 + rng.normal(0, 0.05, 20)).tolist() for i in range(6)}
    [line] = verdict(setting({**noisy, ("bad", "hold"): around(0.2)}))
    assert re.search(
        r"; no difference shown: (T\d with hold, ){2}T\d with hold and 2 more \(", line
    )
    assert "; next, bad with hold is 0." in line


def test_scales_and_settings_are_said_where_they_tell_apart() -> None:
    lines = verdict(
        [*setting(CLEAR), *setting(CLEAR, scale=Fraction(2)), *setting(CLEAR, scale=Fraction(3, 2))]
    )
    assert [line.partition(", SiamFC")[0] for line in lines] == [
        "At the times as they are", "At twice the time", "At 1.5 times the time",
    ]  # fmt: skip
    lines = verdict([*setting(CLEAR), *setting(CLEAR, policy="fifo", fps=Fraction(60))])
    assert lines[0].startswith("In a world of 30 fps, with policy latest, SiamFC with hold is best")
    assert lines[1].startswith("In a world of 60 fps, with policy fifo, ")
    [one] = verdict(setting(CLEAR, scale=Fraction(1, 2)))
    assert one.startswith("At half the time, ")
    lines = verdict([*setting(CLEAR), *setting(CLEAR, dataset="E")])
    assert [line[:5] for line in lines] == ["On D,", "On E,"]


def test_means_over_sigma_and_modelled_scores_have_their_names() -> None:
    mean = [dataclasses.replace(row, sigma=MEAN) for row in setting(CLEAR)]
    [line] = verdict([*setting(CLEAR), *mean])
    assert "best: mAUC 0.553" in line
    modelled = Modelled(True, 0.0, {"auc": 0.4, "dp20": 0.4})
    rows = [dataclasses.replace(r, ranked_by="modelled", modelled=modelled) for r in mean]
    assert "best: modelled mAUC 0.400" in verdict(rows)[0]


def test_whom_the_search_model_would_name_is_said_if_it_is_another() -> None:
    def by_model(auc: float, row: SummaryRow) -> SummaryRow:
        return dataclasses.replace(row, modelled=Modelled(False, 0.3, {"auc": auc, "dp20": auc}))

    best, *others = setting(CLEAR)
    [line] = verdict([by_model(0.5, best), *others])
    assert line.endswith(
        "; by the search model, its reach assumed, SiamFC with kalman would be best: 0.543."
    )
    [line] = verdict([by_model(0.553, best), *others])
    assert "search model" not in line


def test_few_sequences() -> None:
    [line] = verdict(setting({pair: scores[:1] for pair, scores in CLEAR.items()}))
    assert line == (
        "SiamFC with hold is best: AUC 0.550; one sequence is too few to tell 4 pairs apart; the "
        "nearest, SiamFC with kalman, is 0.010 behind."
    )
    [line] = verdict(setting({pair: scores[:4] for pair, scores in CLEAR.items()}))
    assert "; 4 sequences are too few to tell 4 pairs apart; the nearest" in line
    assert "[0.55" in line


def test_one_pair_alone() -> None:
    [line] = verdict(setting({("kcf", "hold"): around(0.4)}))
    assert (
        line == "kcf with hold has AUC 0.403 [0.402, 0.404]; there is nothing to compare it with."
    )


def test_traces_of_other_sequences_are_told_apart() -> None:
    other = {("CSRDCF", "hold"): around(0.6, 30), ("CSRDCF", "kalman"): around(0.5, 30)}
    lines = verdict([*setting(CLEAR), *setting(other)])
    assert lines[0].startswith("On 20 sequences, SiamFC with hold is best")
    assert lines[1].startswith("On 30 sequences, CSRDCF with hold is best")


def test_the_next_tracker_is_another_tracker_and_not_another_device() -> None:
    rows = setting(
        {("A", "hold"): around(0.6), ("B", "hold"): around(0.5), ("C", "hold"): around(0.4)}
    )
    same = [dataclasses.replace(row, tracker="A") if row.tracker == "B" else row for row in rows]
    assert "B.trace with hold is 0.100 behind" in verdict(same)[0]
    assert "the next tracker, C.trace with hold, is 0.200 behind" in verdict(same)[0]


def test_nothing_scored_says_nothing() -> None:
    unscored = [dataclasses.replace(r, scores={"auc": None}) for r in setting(CLEAR)]
    assert verdict(unscored) == []
    assert verdict([]) == []
    assert verdict([dataclasses.replace(r, uncertainty={}) for r in setting(CLEAR)]) == []


scores = st.lists(st.floats(0, 1), min_size=8, max_size=8)


@settings(deadline=None, max_examples=40)
@given(st.lists(scores, min_size=1, max_size=6))
def test_the_words_are_those_of_the_numbers(by_pair: list[list[float]]) -> None:
    pairs = {(f"T{i // 2}", ("hold", "kalman")[i % 2]): some for i, some in enumerate(by_pair)}
    rows = setting(pairs)
    [line] = verdict(rows)
    by_name = {f"{row.tracker} with {row.forecaster}": row for row in rows}
    best = by_name[line[: line.index(" is best" if len(rows) > 1 else " has AUC")]]
    assert best.scores["auc"] == max(row.scores["auc"] or 0 for row in rows)
    interval = best.uncertainty["auc"].interval
    assert f"AUC {best.scores['auc']:.3f} [{interval.low:.3f}, {interval.high:.3f}]" in line
    for name, gap, p in re.findall(r"(T\d with \w+),? is ([\d.]+) behind, p ([<=] \d.\d+)", line):
        behind = by_name[name].behind
        assert behind is not None
        assert gap == f"{-behind.difference.value:.3f}"
        assert p == ("< 0.001" if behind.p_holm < 0.001 else f"= {p_label(behind.p_holm)}")
    alike = re.search(r"no difference shown: (.*?) \(", line)
    for name in re.findall(r"T\d with \w+", alike[1] if alike else ""):
        assert by_name[name].behind is not None
        assert by_name[name].behind.p_holm >= LEVEL  # type: ignore[union-attr]


def required(**values: Any) -> Requirement:
    row = Requirement(
        trace="kcf.trace", times_from="kcf.trace", policy="latest", fps=Fraction(30),
        latency="recorded", search="trace", pre_forecaster="none", convention="pysot",
        forecaster="hold", sigma=Fraction(0), required_auc=0.4, scale=Fraction(27, 10), auc=0.41,
        beyond=Fraction(271, 100), beyond_auc=0.399, auc_without_latency=0.6, speed_up=1 / 2.7,
        fps_at_most=81.0, safe_scale=Fraction(27, 10), safe_auc=0.401, next_auc=0.399,
        safe_ms_per_frame=125.0, stretches=((Fraction(0), Fraction(27, 10)),),
    )  # fmt: skip
    return dataclasses.replace(row, **values)


NEVER = {"safe_scale": None, "safe_ms_per_frame": None, "stretches": ()}
OFFLINE = {**NEVER, "safe_scale": Fraction(0), "stretches": ((Fraction(0), Fraction(0)),)}


@pytest.mark.parametrize(
    ("values", "device", "time"),
    [
        ({}, "may be 2.70 times slower", "125 ms a frame (8.00 fps)"),
        ({"safe_scale": Fraction(4, 5), "safe_ms_per_frame": 0.4},
         "must be 1.25 times faster", "0.400 ms a frame (2,500 fps)"),
        ({"safe_scale": Fraction(1)}, "no slower than it is", "125 ms a frame (8.00 fps)"),
        ({"next_auc": None}, "may be 2.70 times slower or more", "125 ms a frame (8.00 fps)"),
        (OFFLINE, "only without latency", ""),
        (NEVER, "not even without latency", ""),
    ],
)  # fmt: skip
def test_what_is_asked_of_a_device(values: dict[str, Any], device: str, time: str) -> None:
    row = required(**values)
    assert (device_in_words(row), time_in_words(row)) == (device, time)


def test_who_may_be_slowest() -> None:
    rows = setting(CLEAR)
    kcf, siam = required(), required(trace="SiamFC.trace", times_from="SiamFC.trace",
                                     safe_scale=Fraction(4), safe_ms_per_frame=52.5)  # fmt: skip
    assert verdict(rows, [kcf, siam, required(forecaster="kalman", **OFFLINE)])[1:] == [
        "For an AUC of 0.4, SiamFC with hold has most to spare: it may be 4.00 times slower, "
        "52.5 ms a frame (19.0 fps); 1 of 3 pairs cannot have it with any latency."
    ]
    faster = {"safe_scale": Fraction(1, 2), "safe_ms_per_frame": 20.0}
    assert verdict(rows, [required(**faster)])[1] == (
        "For an AUC of 0.4, kcf with hold comes nearest: it must be 2.00 times faster, 20.0 ms a "
        "frame (50.0 fps)."
    )
    assert verdict(rows, [required(**OFFLINE)])[1] == (
        "Nothing has an AUC of 0.4 but without latency: kcf with hold would, with 0.600."
    )
    assert verdict(rows, [required(**NEVER, auc_without_latency=0.3)])[1] == (
        "Nothing has an AUC of 0.4, not even without latency: at most 0.300."
    )


def test_cliffs_and_what_comes_again() -> None:
    names = names_of(setting(CLEAR))
    assert shortfalls([required(), required(**OFFLINE), required(**NEVER)], names) == []
    cliff = required(safe_auc=0.447, next_auc=0.389, safe_scale=Fraction(7, 10),
                     safe_ms_per_frame=32.9)  # fmt: skip
    again = required(stretches=((Fraction(0), Fraction(1, 8)), (Fraction(1, 2), Fraction(1, 2))))
    assert shortfalls([cliff, again], names) == [
        "kcf with hold, AUC 0.4: a cliff: 0.447 there, 0.389 one hundredth slower, where a call "
        "outlasts a frame of the camera (33.3 ms)",
        "kcf with hold, AUC 0.4: reached at 0 to 0.125, 0.5 times the time, and not between",
    ]
    step = required(safe_auc=0.4084, next_auc=0.3997, safe_ms_per_frame=125.0)
    [line] = shortfalls([step], names)
    assert line.endswith("a cliff: 0.408 there, 0.400 one hundredth slower")
    queued = dataclasses.replace(cliff, policy="fifo")
    assert [line.partition(", AUC")[0] for line in shortfalls([cliff, queued], names)] == [
        "kcf with hold, with policy latest", "kcf with hold, with policy fifo"
    ]  # fmt: skip


def test_however_much_there_is_little_is_said() -> None:
    rows = [
        row
        for n in range(30)
        for row in setting({(f"T{i}", "hold"): around(0.5 - i / 99) for i in range(20)},
                           latency=f"constant:{n}ms")
    ]  # fmt: skip
    asked = [required(trace="T0.trace", times_from="T0.trace", required_auc=n / 100, next_auc=0.1)
             for n in range(1, 30)]  # fmt: skip
    lines = verdict(rows, asked)
    assert len(lines) == MOST_SETTINGS + MOST_REQUIRED
    assert lines[MOST_SETTINGS - 1] == "In 27 more settings the best is T0 with hold (27)."
    assert lines[-1].endswith("(27 more in required.csv.)")
    assert max(map(len, lines)) < 400
    assert len(shortfalls(asked, names_of(rows))) == MOST_SHORTFALLS
    assert shortfalls(asked, {})[-1].startswith("and 24 more, in required.csv")


def test_numbers_have_three_digits_and_no_exponent() -> None:
    found = [significant(value) for value in (0.4, 1.234, 12.34, 123.4, 12345.6)]
    assert found == ["0.400", "1.23", "12.3", "123", "12,346"]
