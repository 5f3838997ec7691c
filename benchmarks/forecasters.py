r"""What forecasters win back, and where: ``benchmarks/forecasters.py TRACE ... --section NAME``.

Each section of :data:`SECTIONS` is a table of ``docs/results/forecasters.md``; the README quotes
the first, shares. Traces are of every frame; the sections camera and closed-loop need frames
too, of the sequences that they are about::

    python benchmarks/forecasters.py TRACE ... --section camera --frames FOLDER
    python benchmarks/forecasters.py --section closed-loop --frames FOLDER \
        --tracker nanotrack weights=nanotrackv3

``FOLDER`` holds a folder of frames and truth per dataset. ``--json`` gives the figures of each
trace instead of a table.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

import lae_sim
from lae_sim import Metadata, Recording, Trace, evaluate, load_forecaster, read_trace
from lae_sim.datasets.layouts import find_dataset
from lae_sim.engine.times import Times
from lae_sim.forecast.base import notes_of
from lae_sim.plugins import key_and_value, parse_options
from lae_sim.profile import profile_tracker
from lae_sim.report.table import aligned

Row = dict[str, Any]
"""The scores of one forecaster on one trace in one setting."""

LATENCIES = ("20ms", "47ms", "68ms", "167ms")
FORECASTERS = ("kalman", "learned")
MEAN_NS = 47_000_000
SEED = 14


@dataclass(frozen=True)
class Setting:
    """Under what a trace is replayed.

    Attributes:
        name: in tables.
        world: arguments of :func:`lae_sim.evaluate`.
        changed: what becomes of the trace before.
    """

    name: str
    world: Mapping[str, Any] = field(default_factory=dict)
    changed: Callable[[Trace], Trace] = lambda trace: trace

    def after(self, changed: Callable[[Trace], Trace]) -> Setting:
        """The same for what becomes of the trace."""
        return replace(self, changed=changed)


def constant(time: str, name: str = "", **more: Any) -> Setting:
    """Every call takes the same time."""
    return Setting(name or time, {"latency": f"constant:{time}", **more})


@dataclass(frozen=True)
class Jittered:
    """A source of lognormal times, independent of each other; the initialisation takes the mean.

    Attributes:
        share: standard deviation over mean.
        mean_ns: their mean.
    """

    share: float
    mean_ns: int = MEAN_NS

    @property
    def label(self) -> str:
        """The name of the source in tables."""
        return f"lognormal, {self.share:.0%} of {self.mean_ns / 1e6:g} ms"

    def __call__(self, recording: Recording) -> Times:
        """The times of a recording."""
        variance = math.log1p(self.share**2)
        logs = random(recording).normal(-variance / 2, math.sqrt(variance), len(recording))
        logs[0] = 0.0
        times = np.rint(self.mean_ns * np.exp(logs)).astype(np.int64)
        return Times(recording.name, times, by_call=True)


def random(recording: Recording) -> np.random.Generator:
    """The random numbers of a sequence, whichever others there are."""
    return np.random.default_rng([SEED, *recording.name.encode()])


def dropped(trace: Trace, share: float) -> Trace:
    """The camera has lost a share of the frames, at random: they have no row."""
    fps = trace.metadata.fps

    def changed(recording: Recording) -> Recording:
        kept = random(recording).random(len(recording)) >= share
        kept[0] = True
        frames = np.flatnonzero(kept)
        arrival_ns = frames * (10**9 * fps.denominator) // fps.numerator
        return chosen(recording, frames, arrival_ns=arrival_ns)

    return Trace(trace.metadata, [changed(recording) for recording in trace])


def thinned(trace: Trace, step: int) -> Trace:
    """Every ``step``-th frame alone, as a camera of so much lower a rate would have it."""
    rate = str(trace.metadata.fps / step)
    metadata = Metadata.of({**trace.metadata.document, "fps": rate})
    thin = [chosen(each, np.arange(0, len(each), step)) for each in trace]
    return Trace(metadata, thin)


def chosen(recording: Recording, frames: Any, **more: Any) -> Recording:
    """Some frames of a recording."""
    columns = (recording.truth, recording.boxes, recording.elapsed_ns)
    return Recording.new(recording.name, *(column[frames] for column in columns), **more)


def shifted(trace: Trace, frames: int) -> Trace:
    """Boxes that are so many frames early, but for the first one."""

    def changed(recording: Recording) -> Recording:
        source = np.clip(np.arange(len(recording)) + frames, 0, len(recording) - 1)
        source[0] = 0
        boxes = recording.boxes[source]
        return Recording.new(recording.name, recording.truth, boxes, recording.elapsed_ns)

    return Trace(trace.metadata, [changed(recording) for recording in trace])


@dataclass(frozen=True)
class Arguments:
    """What a section is measured on.

    Attributes:
        traces: of every frame, by name.
        forecasters: to be compared with hold.
        frames: folder with a folder of frames per dataset.
        tracker: name of the tracker for closed loops, and ``KEY=VALUE`` options.
    """

    traces: Mapping[str, Trace]
    forecasters: Sequence[str]
    frames: Path | None = None
    tracker: Sequence[str] = ()

    def datasets(self) -> dict[str, Path]:
        """The datasets of which there are frames: their folders by name.

        Raises:
            SystemExit: if no frames were given.
        """
        if self.frames is None:
            raise SystemExit("name the folder of the datasets' frames: --frames FOLDER")
        folders = sorted(path for path in self.frames.iterdir() if path.is_dir())
        return {find_dataset(root=path).name: path for path in folders}


def scores(label: str, trace: Trace, setting: Setting, forecasters: Iterable[str]) -> list[Row]:
    """The scores of hold and of each forecaster, a row for each permitted latency."""
    world = {"search": "off", **setting.world}
    made = evaluate(trace, forecasters=["hold", *forecasters], progress=False, **world)
    found: list[Row] = made.summary.to_dict("records")
    first: dict[float, Row] = {}
    for row in found:
        hold = first.setdefault(row["sigma"], row)
        row |= {"trace": label, "setting": setting.name, "dataset": trace.metadata.dataset}
        row |= {f"{name}_over_hold": row[name] - hold[name] for name in ("auc", "dp20")}
        lost = row["offline_auc"] - hold["modelled_auc"]
        row["recovered_modelled_auc"] = (row["modelled_auc"] - hold["modelled_auc"]) / lost
    return found


def measured(arguments: Arguments, settings: Sequence[Setting]) -> list[Row]:
    """The scores on all traces in all settings."""
    rows = []
    for label, trace in arguments.traces.items():
        for setting in settings:
            rows += scores(label, setting.changed(trace), setting, arguments.forecasters)
    return rows


def of(rows: Iterable[Row], **values: Any) -> list[Row]:
    """Those rows that have these values."""
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def distinct(rows: Iterable[Row], name: str) -> list[Any]:
    """The values of one column, each once."""
    return list(dict.fromkeys(row[name] for row in rows))


def percent(shares: Iterable[float]) -> str:
    """Shares in %, such as ``"50 / 62"``."""
    return " / ".join(f"{100 * share:.0f}" for share in shares)


def least_over_hold(rows: Sequence[Row], forecasters: Iterable[str]) -> str:
    """A line: the least that each forecaster wins over hold anywhere, below zero where it loses."""

    def least(name: str) -> str:
        own = of(rows, forecaster=name)
        values = (min(row[f"{metric}_over_hold"] for row in own) for metric in ("auc", "dp20"))
        return " ".join([name, *(f"{value:+.4f}" for value in values)])

    return f"least over hold, AUC and DP: {', '.join(map(least, forecasters))}"


def by_trace(rows: Sequence[Row], arguments: Arguments) -> str:
    """A line per trace: each forecaster's shares in all settings; and their means."""
    settings = distinct(rows, "setting")

    def line(name: str, some: Sequence[Row]) -> list[str]:
        own = ([of(some, forecaster=each, setting=at) for at in settings] for each in forecasters)
        return [name, *(percent(mean_share(each) for each in cells) for cells in own)]

    forecasters, traces = arguments.forecasters, distinct(rows, "trace")
    table = [line(trace, of(rows, trace=trace)) for trace in traces]
    if len(traces) > 1:
        table.append(line(f"mean of the {len(traces)}", rows))
    lines = aligned(["trace", *forecasters], table, labels=1)
    return f"{lines}\n{least_over_hold(rows, forecasters)}"


def mean_share(rows: Iterable[Row]) -> float:
    """The mean share of what latency costs that is won back."""
    return fmean(row["recovered_auc"] for row in rows)


def by_dataset(
    rows: Sequence[Row], names: Sequence[str], shown: Callable[[Sequence[Sequence[Row]]], str]
) -> tuple[list[str], list[list[str]]]:
    """Header and a line per setting: of each dataset what is shown of the rows of forecasters."""
    datasets = distinct(rows, "dataset")
    number = {name: len(distinct(of(rows, dataset=name), "trace")) for name in datasets}
    table = []
    for setting in distinct(rows, "setting"):
        some = of(rows, setting=setting)
        own = ([of(some, dataset=each, forecaster=name) for name in names] for each in datasets)
        table.append([setting, *map(shown, own)])
    return ["setting", *(f"{name} ({number[name]})" for name in datasets)], table


def shares_by_dataset(rows: Sequence[Row], arguments: Arguments) -> str:
    """A line per setting: the mean shares on each dataset, in %."""

    def shown(forecasters: Sequence[Sequence[Row]]) -> str:
        return percent(map(mean_share, forecasters))

    lines = aligned(*by_dataset(rows, arguments.forecasters, shown), labels=1)
    return f"{lines}\n{least_over_hold(rows, arguments.forecasters)}"


def modelled_by_dataset(rows: Sequence[Row], arguments: Arguments) -> str:
    """A line per setting: the mean modelled AUC of hold and the forecasters on each dataset."""

    def shown(forecasters: Sequence[Sequence[Row]]) -> str:
        return score_text(fmean(row["modelled_auc"] for row in each) for each in forecasters)

    return aligned(*by_dataset(rows, ["hold", *arguments.forecasters], shown), labels=1)


def score_text(values: Iterable[float]) -> str:
    """Scores such as ``".501 / .693"``."""
    return " / ".join(f"{value:.3f}".removeprefix("0") for value in values)


def scores_by_trace(rows: Sequence[Row], arguments: Arguments) -> str:
    """A line per trace and setting: AUC / DP of hold, of the forecasters and offline."""
    names = ["hold", *arguments.forecasters]
    table = []
    for trace in distinct(rows, "trace"):
        for setting in distinct(of(rows, trace=trace), "setting"):
            own = [of(rows, trace=trace, setting=setting, forecaster=name)[0] for name in names]
            cells = [score_text((row["auc"], row["dp20"])) for row in own]
            offline = score_text((own[0]["offline_auc"], own[0]["offline_dp20"]))
            table.append([trace, setting, *cells, offline])
    return aligned(["trace", "setting", *names, "offline"], table)


@dataclass(frozen=True)
class Published:
    """AUC of RPN_mob on a Jetson AGX Xavier, and what PVT++'s predictors make of it.

    The scores are from ``MODEL_ZOO.md`` of its repository (github.com/Jaraxxus-Me/PVT_pp), which
    calls them mAUC. Frames/s and offline AUC of the tracker are from "Predictive Visual Tracking"
    (2021), Table II and ``fig/overall.png`` of its repository.

    Attributes:
        dataset: its name.
        none, motion, both: without a predictor, with that of motion, with that of motion and sight.
        fps, offline: None if not published.
    """

    dataset: str
    none: float
    motion: float
    both: float
    fps: float | None = None
    offline: float | None = None

    def line(self) -> list[str]:
        """What the table says of it."""
        gains = [each - self.none for each in (self.motion, self.both)]
        lost = self.offline and self.offline - self.none
        return [
            self.dataset,
            f"{1000 / self.fps:.1f}" if self.fps else "?",
            *(score_text([each]) for each in (self.none, self.motion, self.both)),
            score_text([self.offline]) if self.offline else "?",
            *(percent([gain / lost]) if lost else "?" for gain in gains),
        ]


PUBLISHED = (
    Published("DTB70", 0.298, 0.385, 0.399, 21.2, 0.593),
    Published("UAVDT", 0.494, 0.529, 0.576, 22.5, 0.556),
    Published("UAV20L", 0.448, 0.481, 0.508),
    Published("UAV123", 0.472, 0.537, 0.537, 22.0, 0.610),
)

INIT, REACH = "200ms", "c=0.45"
"""An initialisation and a reach with which replays come near to what PVT measured of RPN_mob
(``benchmarks/paper_tables.py``)."""


def beside_pvt_plus(arguments: Arguments) -> list[Row]:
    """Stand-ins under the protocol, at three constant times each."""
    of_dataset = {each.dataset: each for each in PUBLISHED}
    rows = []
    for label, trace in arguments.traces.items():
        published = of_dataset.get(trace.metadata.dataset)
        if published is None or not (published.fps and published.offline):
            continue
        its = round(1e9 / published.fps)
        slow = slowest(label, trace, published.none / published.offline) * 10**6
        for ns, setting in (
            (its, constant(f"{its}ns", "its frames/s", sigma="grid")),
            (slow, constant(f"{slow}ns", "as much lost", sigma="grid")),
            (its, constant(f"{its}ns,init={INIT}", "search model", search=REACH, sigma="grid")),
        ):
            found = scores(label, trace, setting, arguments.forecasters)
            rows += [{**row, "call_ms": ns / 10**6} for row in found]
    return rows


def slowest(label: str, trace: Trace, share: float) -> int:
    """The most ms that a call may take for hold to keep a share of the offline AUC."""
    low, high = 1, 1000
    while high - low > 1:
        middle = (low + high) // 2
        (row,) = scores(label, trace, constant(f"{middle}ms"), ())
        low, high = (middle, high) if row["auc"] >= share * row["offline_auc"] else (low, middle)
    return low


def published_and_stand_ins(rows: Sequence[Row], arguments: Arguments) -> str:
    """What was published, and below it the mean over the stand-ins of each dataset."""
    header = ["RPN_mob", "ms", "none", "motion", "both", "offline", "% motion", "% both"]
    published = aligned(header, [each.line() for each in PUBLISHED], labels=1)
    names, table = ["hold", *arguments.forecasters], []
    for dataset in distinct(rows, "dataset"):
        for setting in distinct(rows, "setting"):
            some = of(rows, dataset=dataset, setting=setting)
            kind = "modelled_auc" if setting == "search model" else "auc"
            own = [of(some, forecaster=name) for name in names]
            zero = [fmean(row[kind] for row in of(each, sigma=0)) for each in own]
            grid = [fmean(row[kind] for row in each) for each in own]
            offline = fmean(row["offline_auc"] for row in some)
            ms = sorted(row["call_ms"] for row in some)
            shares = (
                percent((value - hold) / (offline - hold) for value in others)
                for hold, *others in (zero, grid)
            )
            times = " to ".join(dict.fromkeys(f"{each:.1f}" for each in (ms[0], ms[-1])))
            table.append(
                [dataset, setting, times, score_text(zero), score_text([offline]), *shares]
            )
    shown = " / ".join(names), " / ".join(arguments.forecasters)
    header = ["stand-ins", "times", "ms", shown[0], "offline", f"% {shown[1]}", "% of mAUC"]
    return f"{published}\n\n{aligned(header, table)}"


def camera_motion(arguments: Arguments) -> list[Row]:
    """The scores on the sequences of which there are frames."""
    forecasters = [f"{way}{name}" for name in arguments.forecasters for way in ("", "camera+")]
    folders, rows = arguments.datasets(), []
    for label, trace in arguments.traces.items():
        root = folders.get(trace.metadata.dataset)
        if root is None:
            continue
        framed = {sequence.name for sequence in find_dataset(root=root).sequences}
        for name in sorted(framed.intersection(trace.names)):
            one = Trace(trace.metadata, [trace[name]])
            for time in LATENCIES:
                world: Row = {"root": root, "camera_lag": 1, "sequences": name}
                found = scores(label, one, constant(time, **world), forecasters)
                rows += [{**row, "sequence": name} for row in found]
    return rows


def mean_of_sequences(rows: Sequence[Row], arguments: Arguments) -> str:
    """A line per setting: of each sequence the mean AUC of its traces, of which the mean, in %."""

    def mean(some: Sequence[Row], metric: str) -> str:
        own = (of(some, sequence=name) for name in distinct(some, "sequence"))
        return f"{100 * fmean(fmean(row[metric] for row in each) for each in own):.1f}"

    names = distinct(rows, "forecaster")
    table = []
    for setting in distinct(rows, "setting"):
        own = [of(rows, setting=setting, forecaster=name) for name in names]
        offline = mean(own[0], "offline_auc")
        table.append([setting, *(mean(each, "auc") for each in own), offline])
    return aligned(["time", *names, "offline"], table, labels=1)


def closed_loops(arguments: Arguments) -> list[Row]:
    """The tracker run live, where it searches as a pre-forecaster says, under constant times."""
    name, *options = arguments.tracker or ("dcf",)
    given = parse_options(dict(map(key_and_value, options)))
    rows = []
    for root in arguments.datasets().values():
        for time in ("47ms", "100ms"):
            for pre, keep_size in searches(arguments.forecasters):
                with tempfile.TemporaryDirectory() as folder:
                    profile = profile_tracker(
                        name,
                        options=given,
                        root=root,
                        timing=f"constant:{time}",
                        pre_forecaster=pre,
                        keep_size=keep_size,
                        out=f"{folder}/loop.parquet",
                        progress=False,
                    )
                    trace = read_trace(profile.traces[0].trace)
                    trace = Trace(trace.metadata, list(trace))
                setting = Setting(f"{time}, {search_text(pre, keep_size)}")
                for recording in trace:
                    one = Trace(trace.metadata, [recording])
                    found = scores(name, one, setting, arguments.forecasters)
                    rows += [{**row, "sequence": recording.name} for row in found]
    return rows


def searches(forecasters: Sequence[str]) -> list[tuple[str | None, bool]]:
    """Pre-forecasters, and whether they say the centre only."""
    return [(None, False), *((name, kept) for kept in (False, True) for name in forecasters)]


def search_text(pre: str | None, keep_size: bool) -> str:
    """What forecasts before the tracker where it searches."""
    return (pre or "none") + ", size kept" * keep_size


def mean_scores(rows: Sequence[Row], arguments: Arguments) -> str:
    """A line per setting: the mean AUC / DP of hold and the forecasters over sequences."""
    names = ["hold", *arguments.forecasters]
    table = []
    for setting in distinct(rows, "setting"):
        own = [of(rows, setting=setting, forecaster=name) for name in names]
        means = ([fmean(row[m] for row in each) for m in ("auc", "dp20")] for each in own)
        table.append([setting, *map(score_text, means)])
    return aligned(["setting", *names], table, labels=1)


@dataclass(frozen=True)
class Section:
    """One table.

    Attributes:
        title: what it shows.
        measured: its rows.
        printed: the rows as text.
        forecasters: to be compared with hold, unless others are named.
        caveats: what must be known to read it.
    """

    title: str
    measured: Callable[[Arguments], list[Row]]
    printed: Callable[[Sequence[Row], Arguments], str]
    forecasters: Sequence[str] = FORECASTERS
    caveats: str = ""


def section(
    title: str,
    printed: Callable[[Sequence[Row], Arguments], str],
    settings: Sequence[Setting],
    **more: Any,
) -> Section:
    """One whose rows are the traces in some settings."""
    return Section(title, partial(measured, settings=settings), printed, **more)


SHARES = "share of the AUC lost to latency that is won back, in %"

SECTIONS: Mapping[str, Section] = {
    "shares": section(
        f"{SHARES}, at constant {', '.join(LATENCIES)}",
        by_trace,
        [constant(time) for time in LATENCIES],
        forecasters=("learned", "kalman", "least-squares"),
    ),
    "recorded": section(
        "AUC / DP at 20 px with the trace's own times",
        scores_by_trace,
        [Setting("as recorded"), Setting("times x 4", {"scale": 4})],
    ),
    "conditions": section(
        f"{SHARES}: means over the traces of a dataset; constant 47 ms, jitter (lognormal, its "
        "standard deviation), frames that the camera loses at random, other rates",
        shares_by_dataset,
        [
            constant("47ms", "47 ms, 30 fps"),
            Setting("jitter 10%", {"latency": Jittered(0.1)}),
            Setting("jitter 30%", {"latency": Jittered(0.3)}),
            Setting("jitter 60%", {"latency": Jittered(0.6)}),
            constant("47ms", "10% of frames lost").after(partial(dropped, share=0.1)),
            constant("47ms", "30% of frames lost").after(partial(dropped, share=0.3)),
            constant("47ms", "10 fps, 1 frame in 3").after(partial(thinned, step=3)),
            constant("47ms", "15 fps, 1 frame in 2").after(partial(thinned, step=2)),
            constant("47ms", "60 fps, every frame", fps=60),
        ],
    ),
    "search": section(
        "modelled AUC of hold / the forecasters by what forecasts before the tracker, c = 0.7, "
        "initialisation 400 ms: means over the traces of a dataset",
        modelled_by_dataset,
        [
            constant(
                f"{time},init=400ms",
                f"{time}, {search_text(pre, keep_size)}",
                search="c=0.7",
                pre_forecaster=pre,
                keep_size=keep_size,
            )
            for time in ("47ms", "68ms")
            for pre, keep_size in searches(FORECASTERS)
        ],
    ),
    "early": section(
        "AUC / DP at 20 px where the tracker's boxes are a frame early",
        scores_by_trace,
        [constant(time).after(partial(shifted, frames=1)) for time in LATENCIES],
    ),
    "pvt++": Section(
        "RPN_mob with PVT++ on its Xavier, and forecasters on stand-ins' boxes: AUC at sigma = 0, "
        "and the share of what latency costs that is won back, in %",
        beside_pvt_plus,
        published_and_stand_ins,
        caveats="""\
published: the model zoo calls it mAUC, but its command converts at sigma = 0, and the figures
  without a predictor on UAVDT and UAV123 are those of PVT's Table II at sigma = 0; offline: from
  PVT's figure, of the tracker without PVT++'s training (so more than 100 % can be won); ?: unknown
stand-ins: other trackers, boxes of every frame, forecast from boxes alone; none on UAV20L: 4 of its
  20 sequences are whole in UAV123, the others in parts, on each of which a tracker starts anew
  its frames/s: as PVT publishes them, recorded boxes, which lose no target: too good
  as much lost: the constant times at which hold keeps the same share of its offline AUC as RPN_mob
  search model: modelled AUC at its frames/s; initialisation 200 ms, c = 0.45: fit PVT's tables""",
    ),
    "camera": Section(
        "mean AUC in % over sequences of which there are frames, of each the mean over traces; "
        "camera_lag=1",
        camera_motion,
        mean_of_sequences,
    ),
    "closed-loop": Section(
        "AUC / DP at 20 px of the tracker run live under constant times (assumed, not measured), "
        "by what forecasts before it",
        closed_loops,
        mean_scores,
    ),
}
"""The tables by name."""


def read(path: str) -> Trace:
    """A trace that is kept in memory."""
    trace = read_trace(path)
    return Trace(trace.metadata, list(trace))


def weights() -> str:
    """The digest of the weights of learned, shortened."""
    (note,) = notes_of(load_forecaster("learned"), [])
    return note.removeprefix("weights ")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("traces", nargs="*", metavar="TRACE")
    add("--section", choices=SECTIONS, default="shares")
    add("--forecaster", nargs="+", metavar="NAME")
    add("--frames", type=Path, metavar="FOLDER")
    add("--tracker", nargs="+", default=(), metavar=("NAME", "KEY=VALUE"))
    add("--json", action="store_true")
    given = parser.parse_args()
    asked = SECTIONS[given.section]
    traces = {Path(path).stem: read(path) for path in given.traces}
    forecasters = given.forecaster or asked.forecasters
    arguments = Arguments(traces, forecasters, given.frames, given.tracker)
    rows = asked.measured(arguments)
    if given.json:
        print(json.dumps(rows, indent=2, default=str))
        return
    print(asked.title, "", asked.printed(rows, arguments), "", sep="\n")
    if asked.caveats:
        print(asked.caveats)
    print(f"lae_sim {lae_sim.__version__}, weights of learned {weights()}")


if __name__ == "__main__":
    main()
