"""The paper's tables beside replays of public boxes: ``benchmarks/paper_tables.py --data D``.

Li et al. measured eight trackers under their own latency on a Jetson AGX Xavier. Their boxes are
not public, but those of trackers that are about as accurate offline are. Replayed at the paper's
frames/s they say what the paper would have found. Two things that it does not give are assumed, and
varied: what an initialisation takes, and c, how far a tracker finds its target
(:mod:`lae_sim.replay.search`). What a pre-forecaster is worth is the model's too: no frame is seen.

``D`` holds a folder of ground truth for each dataset, as ``lae-sim convert --truth`` takes it, and
the boxes as ``results_boxes/DATASET/TRACKER.npz``, an array [T, 4] for each sequence. What is not
there is left out.

Sources: Li et al., "Predictive Visual Tracking: A New Benchmark and Baseline Approach" (2021),
Tables II and III, and ``fig/overall.png`` of its repository (github.com/vision4robotics/
LAE-PVT-master): another run without forecasters, and the trackers' offline scores, told by colour.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lae_sim import LaeError, Trace, World, convert_results, evaluate_runs, load_forecaster
from lae_sim.replay.search import SearchModel
from lae_sim.report.table import aligned

ROWS = ("none", "pre", "post", "both")
"""Forecasters: none; one that says where to search; one that says where the target is; both."""

PUBLISHED = """
dataset tracker         fps  offline   figure    none      pre       post      both
DTB70   SiamRPN++_alex  -    .587/.793 .433/.611 -         -         -         -
DTB70   SiamRPN++_mob   21.2 .593/.785 .330/.419 .305/.387 .318/.430 .349/.482 .377/.518
DTB70   SiamRPN++_res   6.0  .614/.798 .150/.186 .136/.159 -         -         .201/.254
DTB70   SiamMask        14.8 .575/.775 .257/.337 .247/.313 -         -         .362/.504
DTB70   DiMP18          -    .621/.810 .187/.227 -         -         -         -
DTB70   PrDiMP18        -    .614/.792 .154/.173 -         -         -         -
DTB70   DiMP50          -    .638/.830 .103/.110 -         -         -         -
DTB70   ATOM            -    .581/.764 .095/.106 -         -         -         -
UAVDT   SiamRPN++_alex  -    .557/.774 .521/.747 -         -         -         -
UAVDT   SiamRPN++_mob   22.5 .556/.757 .499/.728 .494/.719 -         -         .533/.740
UAVDT   SiamRPN++_res   6.0  .594/.801 .356/.613 .351/.594 -         -         .467/.687
UAVDT   SiamMask        15.3 .580/.782 .462/.713 .455/.703 -         -         .539/.751
UAVDT   DiMP18          -    .546/.768 .408/.607 -         -         -         -
UAVDT   PrDiMP18        -    .550/.744 .345/.512 -         -         -         -
UAVDT   DiMP50          -    .582/.796 .319/.478 -         -         -         -
UAVDT   ATOM            -    .554/.761 .331/.501 -         -         -         -
UAV123  SiamRPN++_alex  -    .578/.767 .514/.726 -         -         -         -
UAV123  SiamRPN++_mob   22.0 .610/.811 .488/.709 .472/.678 -         -         .522/.722
UAV123  SiamRPN++_res   5.6  .611/.804 .366/.532 .349/.505 -         -         .434/.605
UAV123  SiamMask        14.6 .599/.790 .454/.664 .436/.639 -         -         .514/.701
UAV123  DiMP18          -    .635/.839 .479/.669 -         -         -         -
UAV123  PrDiMP18        -    .641/.832 .469/.663 -         -         -         -
UAV123  DiMP50          -    .647/.852 .409/.571 -         -         -         -
UAV123  ATOM            -    .619/.829 .438/.615 -         -         -         -
"""
"""What was published, as AUC/DP at 20 px: ``none`` to ``both`` are Tables II and III."""

FAMILY = ("SiamRPN++_alex", "SiamRPN++_mob", "SiamRPN++_res", "SiamMask")
"""Trackers of one kind: an initialisation is one pass of the network over a template."""

ONLINE = ("DiMP18", "PrDiMP18", "DiMP50", "ATOM")
"""Trackers that train at their initialisation, which takes 0.8 to 4 s on desktop CPUs."""

STAND_INS: Mapping[str, Mapping[str, str]] = {
    "DTB70": {
        **dict.fromkeys(("SiamRPN++_alex", "SiamRPN++_mob", "SiamMask", "ATOM"), "SiamAPN"),
        **dict.fromkeys(("SiamRPN++_res", "DiMP18", "PrDiMP18", "DiMP50"), "NanoTrackV3"),
    },
    "UAVDT": dict.fromkeys((*FAMILY, *ONLINE), "ECO_gpu"),
    "UAV123": dict.fromkeys((*FAMILY, *ONLINE), "ECO_gpu"),
}
"""Whose boxes stand in for whose, by dataset."""

ABSOLUTE = ("DTB70",)
"""Where stand-ins are about as accurate offline as the trackers are: .586 and .628, the paper's
.575 to .638. Elsewhere scores are compared as shares of the offline score."""

ASSUMED_FPS = {"SiamRPN++_alex": 30.0, **dict.fromkeys(ONLINE, 10.0)}
"""Frames/s that were not published."""

ASSUMED: Mapping[str, tuple[int, float]] = {
    **dict.fromkeys(FAMILY, (200, 0.45)),
    "DiMP18": (1000, 0.85),
    "PrDiMP18": (2000, 0.85),
    "ATOM": (2000, 0.85),
    "DiMP50": (3000, 0.85),
}
"""Time of an initialisation in ms, and c: for the family what comes nearest to Table III, for the
others about what comes nearest to the figure; the same on all datasets."""

INITS = (100, 150, 200, 300, 400, 500, 700, 1000)
REACHES = (0.3, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 1.0, 1.2)
"""Over which the answer is shown to move: initialisations in ms, and c."""

Pair = tuple[float, float]
"""AUC and DP at 20 px, in 0..1."""

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Published:
    """What was published of one tracker on one dataset.

    Attributes:
        dataset, tracker: names.
        fps: frames/s on the Xavier; None if not published.
        scores: of ``offline``, ``figure`` (no forecaster, another run than the tables') and those
            of :data:`ROWS` that the tables have.
    """

    dataset: str
    tracker: str
    fps: float | None
    scores: Mapping[str, Pair]

    @property
    def replayed_fps(self) -> float:
        """Frames/s as published, or else as assumed."""
        return self.fps or ASSUMED_FPS[self.tracker]

    @property
    def stand_in(self) -> str:
        """Whose boxes stand in."""
        return STAND_INS[self.dataset][self.tracker]

    def measured(self, row: str) -> Pair | None:
        """What the tables say, or else the figure; None if neither does."""
        return self.scores.get(row, self.scores["figure"] if row == "none" else None)


@dataclass(frozen=True)
class Line:
    """One figure of the paper beside a replay's: AUC and DP at 20 px of each.

    Attributes:
        dataset, tracker, stand_in: names; whose boxes are replayed.
        fps: frames/s of the replay; ``fps_published`` says whether they are the paper's.
        init_ms, reach: what is assumed.
        row: one of :data:`ROWS`.
        relative: whether scores are shares of the offline score.
        paper: of the tables, or else of the figure; None if not published.
        plain: of the recorded boxes where an initialisation costs what a frame does.
        recorded: of the recorded boxes where it costs what is assumed.
        modelled: the same under the search model.
    """

    dataset: str
    tracker: str
    stand_in: str
    fps: float
    fps_published: bool
    init_ms: int
    reach: float
    row: str
    relative: bool
    paper: Pair | None
    plain: Pair
    recorded: Pair
    modelled: Pair


def published() -> list[Published]:
    """What was published, a record for each tracker and dataset."""
    head, *lines = (line.split() for line in PUBLISHED.strip().splitlines())
    records = []
    for dataset, tracker, fps, *cells in lines:
        scores = {name: _pair(cell) for name, cell in zip(head[3:], cells) if cell != "-"}
        records.append(Published(dataset, tracker, None if fps == "-" else float(fps), scores))
    return records


def _pair(cell: str) -> Pair:
    auc, dp = cell.split("/")
    return float(auc), float(dp)


@cache
def read_boxes(data: Path, dataset: str, tracker: str) -> Trace:
    """Published boxes of every frame, as a trace; its times are none.

    Raises:
        LaeError: if the boxes or the ground truth are not there.
    """
    boxes = data / "results_boxes" / dataset / f"{tracker}.npz"
    return convert_results(boxes, data / dataset, time="constant:1ms")[0]


def with_boxes(data: Path) -> Iterator[tuple[Published, Trace]]:
    """What was published, with the boxes that stand in, where these are there."""
    for paper in published():
        try:
            yield paper, read_boxes(data, paper.dataset, paper.stand_in)
        except LaeError:
            continue


def offline(trace: Trace) -> Floats:
    """AUC and DP of the boxes at their own frames, float64 [2]."""
    runs = World.of(search="off").replay(trace)
    scores = evaluate_runs(runs, trace.metadata, {"hold": load_forecaster("hold")}).offline
    return np.array([scores["auc"].mean(), scores["dp20"].mean()])


def replayed(
    trace: Trace, fps: float, init_ms: float, reaches: Sequence[float], rows: Sequence[str] = ROWS
) -> dict[str, Floats]:
    """AUC and DP of a replay for several reaches of the tracker, which share their work.

    Args:
        trace: of every frame.
        fps: frames/s of the tracker; the time of a frame is rounded to ms.
        init_ms: time of an initialisation, at least that of a frame.
        reaches: C of them, ascending; infinity gives the scores of the recorded boxes.
        rows: which of :data:`ROWS`.

    Returns:
        By row, float64 [C, 2].
    """
    frame_ms = round(1000 / fps)
    world = World.of(latency=f"constant:{frame_ms}ms,init={max(init_ms, frame_ms)}ms", search="off")
    found: dict[str, Floats] = {}
    for pre, searched in (
        (None, {"none": "hold", "post": "kalman"}),
        ("kalman", {"pre": "hold", "both": "kalman"}),
    ):
        wanted = {row: load_forecaster(name) for row, name in searched.items() if row in rows}
        if not wanted:
            continue
        model = SearchModel(
            np.array(reaches, float),
            known=False,  # every reach has figures of its own
            source="assumed",
            pre_forecaster=None if pre is None else load_forecaster(pre),
            keep_size=pre is not None,
        )
        runs, weights = [], []
        for run in replace(world.replay(trace), search=model):
            if run.modelled is None:  # it processed every frame
                runs.append(run)
                weights.append(np.ones(len(reaches)))
                continue
            for boxes, weight in zip(run.modelled.boxes, run.modelled.weights.T):
                runs.append(replace(run, boxes=boxes, modelled=None))
                weights.append(weight)
        scores = evaluate_runs(runs, trace.metadata, wanted).scores
        both = np.stack([scores["auc"][:, :, 0], scores["dp20"][:, :, 0]], axis=2)
        means = np.einsum("fsm,sc->fcm", both, np.array(weights)) / len(trace)
        found.update(zip(wanted, means))
    return found


def plainly_replayed(trace: Trace, fps: float) -> dict[str, Floats]:
    """AUC and DP of the recorded boxes, an initialisation being a frame; by row, float64 [2].

    Where a tracker searches does not matter then.
    """
    found = replayed(trace, fps, 0, [np.inf], ("none", "post"))
    none, post = found["none"][0], found["post"][0]
    return {"none": none, "pre": none, "post": post, "both": post}


def compare(data: Path) -> list[Line]:
    """The paper's figures beside replays, of all trackers whose stand-in is there."""
    lines = []
    for paper, trace in with_boxes(data):
        fps, (init_ms, reach) = paper.replayed_fps, ASSUMED[paper.tracker]
        relative = paper.dataset not in ABSOLUTE
        unit = np.array(paper.scores["offline"]) if relative else np.ones(2)
        own_unit = offline(trace) if relative else np.ones(2)
        rows = ROWS if paper.tracker in FAMILY else ("none",)
        plain = plainly_replayed(trace, fps)
        found = replayed(trace, fps, init_ms, [reach, np.inf], rows)
        for row in rows:
            measured = paper.measured(row)
            lines.append(
                Line(
                    dataset=paper.dataset,
                    tracker=paper.tracker,
                    stand_in=paper.stand_in,
                    fps=fps,
                    fps_published=paper.fps is not None,
                    init_ms=init_ms,
                    reach=reach,
                    row=row,
                    relative=relative,
                    paper=None if measured is None else _floats(measured / unit),
                    plain=_floats(plain[row] / own_unit),
                    recorded=_floats(found[row][1] / own_unit),
                    modelled=_floats(found[row][0] / own_unit),
                )
            )
    return lines


def _floats(values: Floats) -> Pair:
    auc, dp = values.tolist()
    return auc, dp


@dataclass(frozen=True, eq=False)
class Fit:
    """How far replays of the family are from the paper under one initialisation and one c for all.

    Attributes:
        cells: dataset, tracker and row of each of N figures.
        inits, reaches: I and C of them.
        differences: replay less paper, as shares of the offline AUC, float64 [N, I, C].
        plain: likewise, of the recorded boxes where an initialisation costs a frame, float64 [N].
    """

    cells: Sequence[tuple[str, str, str]]
    inits: Sequence[int]
    reaches: Sequence[float]
    differences: Floats
    plain: Floats

    def error(self, which: Bools | slice = slice(None)) -> Floats:
        """Mean absolute difference of some figures, float64 [I, C]."""
        error: Floats = np.abs(self.differences[which]).mean(axis=0)
        return error

    def best(self, which: Bools | slice = slice(None)) -> tuple[int, int]:
        """Where that is least: the places of an initialisation and a c."""
        error = self.error(which)
        i, c = np.unravel_index(int(error.argmin()), error.shape)
        return int(i), int(c)

    def those(self, name: str) -> Bools:
        """Which figures are of a dataset, tracker or row, bool [N]."""
        return np.array([name in cell for cell in self.cells])


def fit_family(data: Path) -> Fit | None:
    """One initialisation and one c for the whole family on all datasets; None without boxes.

    Where two runs were published, tables and figure, their mean counts.
    """
    cells, differences, plain = [], [], []
    for paper, trace in with_boxes(data):
        if paper.tracker not in FAMILY:
            continue
        fps, own_unit = paper.replayed_fps, offline(trace)[0]
        rows = [row for row in ROWS if paper.measured(row)]
        plain_scores = plainly_replayed(trace, fps)
        by_init = [replayed(trace, fps, init, REACHES, rows) for init in INITS]
        for row in rows:
            names = {row, "figure"} if row == "none" else {row}
            runs = [paper.scores[name][0] for name in names & {*paper.scores}]
            measured = np.mean(runs) / paper.scores["offline"][0]
            cells.append((paper.dataset, paper.tracker, row))
            plain.append(plain_scores[row][0] / own_unit - measured)
            differences.append([scores[row][:, 0] / own_unit - measured for scores in by_init])
    if not cells:
        return None
    return Fit(cells, INITS, REACHES, np.array(differences), np.array(plain))


def comparison_text(lines: Sequence[Line]) -> str:
    """The comparison as a table."""
    head = ["dataset", "tracker", "boxes of", "frames/s", "init ms", "c", "forecasters"]
    head += ["", "paper", "plain", "+ init", "+ model", "difference"]
    body = []
    for line in lines:
        if line.paper is None:
            continue
        fps = f"{line.fps:g}" + ("" if line.fps_published else " *")
        pairs = (line.paper, line.plain, line.recorded, line.modelled)
        body.append(
            [line.dataset, line.tracker, line.stand_in, fps, f"{line.init_ms:,}", f"{line.reach:g}"]
            + [line.row, "share" if line.relative else "score"]
            + ["/".join(f"{value:.3f}" for value in pair) for pair in pairs]
            + ["/".join(f"{m - p:+.3f}" for m, p in zip(line.modelled, line.paper))]
        )
    return aligned(head, body)


def fit_text(fit: Fit) -> str:
    """How the family's error moves with the initialisation and c, and what the best leaves."""

    def named(i: int, c: int) -> str:
        return f"{fit.inits[i]} ms, c = {fit.reaches[c]:g}"

    def chosen(which: Bools | slice, what: str) -> str:
        error, (i, c) = fit.error(which), fit.best(which)
        plain = np.abs(fit.plain[which])
        return (
            f"{what}, {len(plain)} figures: best {named(i, c)}, {error[i, c]:.3f}; "
            f"of the plain replay {plain.mean():.3f}"
        )

    table = aligned(
        ["init ms", *(f"c {reach:g}" for reach in fit.reaches)],
        [[f"{init:,}", *(f"{e:.3f}" for e in row)] for init, row in zip(fit.inits, fit.error())],
    )
    told = [chosen(slice(None), "all")]
    for of in (0, 1):
        for name in dict.fromkeys(cell[of] for cell in fit.cells):
            own = fit.those(name)
            told.append(chosen(own, name))
            if not own.all():
                i, c = fit.best(~own)
                told[-1] += f"; {fit.error(own)[i, c]:.3f} at {named(i, c)}, best of the others"
    table_3 = fit.those("DTB70") & fit.those("SiamRPN++_mob")
    if table_3.any():
        told.append(chosen(table_3, "Table III"))
    return "\n".join([table, "", *told])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of boxes and ground truth")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    lines, fit = compare(arguments.data), fit_family(arguments.data)
    if not lines or fit is None:
        boxes = arguments.data / "results_boxes" / "DTB70" / "SiamAPN.npz"
        raise SystemExit(f"no boxes of a stand-in with its ground truth, such as {boxes}")
    if arguments.json:
        found = {
            "comparison": [asdict(line) for line in lines],
            "family": {
                "figures": [[*cell] for cell in fit.cells],
                "init_ms": [*fit.inits],
                "c": [*fit.reaches],
                "difference": fit.differences.tolist(),
                "plain_difference": fit.plain.tolist(),
            },
        }
        print(json.dumps(found, indent=2))
        return
    print("The paper's figures and replays of other trackers' boxes, AUC/DP at 20 px\n")
    print(comparison_text(lines))
    print(NOTES)
    print("One initialisation and one c for the family: mean |difference| of AUC / offline AUC\n")
    print(fit_text(fit))


NOTES = """
paper: Tables II and III, or else the repository's figure, whose run differs from theirs by .005 to
.025. share: of the offline score, since the stand-in is another kind of tracker. plain: recorded
boxes, an initialisation costs what a frame does. + init: it costs what is assumed. + model: under
the search model at c. *: frames/s are assumed. init and c are assumed everywhere: they were chosen
to be near the paper, so these lines show that such values exist, not that they are the Xavier's.
"""


if __name__ == "__main__":
    main()
