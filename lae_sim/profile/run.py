"""A whole profile: a tracker run on a dataset in one or more passes, each left as a trace."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from fractions import Fraction
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lae_sim import __version__
from lae_sim.datasets.dropped import check_frame_times
from lae_sim.datasets.frames import Dataset, ImageSequence
from lae_sim.datasets.layouts import find_dataset
from lae_sim.engine.clock import (
    NS_PER_SECOND,
    Clock,
    parse_budget,
    parse_duration,
    parse_fps,
    parse_stride,
    whole,
)
from lae_sim.errors import LaeError, hint, shown
from lae_sim.files import (
    NAME_MAX,
    check_distinct,
    check_places,
    locked,
    sequence_names,
    text_digest,
)
from lae_sim.forecast.camera import Camera
from lae_sim.forecast.costs import parse_cost
from lae_sim.learning.registry import files_named, load_forecaster
from lae_sim.profile.beside import Loads
from lae_sim.profile.energy import at_rest
from lae_sim.profile.gaps import BUDGET_NS, Gaps
from lae_sim.profile.journal import Journal
from lae_sim.profile.live import LiveRun, run_every_frame, run_real_time
from lae_sim.profile.passes import (
    Failure,
    Pass,
    PassSummary,
    Progress,
    base_document,
    parse_timing,
    run_pass,
    scheduled,
    split_timing,
    summary,
    warm_up,
    write_pass,
)
from lae_sim.profile.sampler import Sampler
from lae_sim.profile.sensors import find_sensors
from lae_sim.profile.timed import TimedTracker
from lae_sim.profile.translation import Translated
from lae_sim.profile.worker import InProcess, Worker
from lae_sim.progress import ProgressBar, ShowProgress, tell
from lae_sim.replay.latency import time_label
from lae_sim.replay.names import flag, named, parse_policy, several, text
from lae_sim.replay.strides import phases
from lae_sim.trace.describe import Facts
from lae_sim.trace.file import check_replaces, read_trace
from lae_sim.trace.metadata import text_fault

if TYPE_CHECKING:
    from pandas import DataFrame

MODES = ("every-frame", "real-time")
_FAILURES = 20  # that are told one by one


@dataclass(frozen=True, kw_only=True)
class ProfilePlan:
    """All that decides what a profile measures.

    Attributes:
        tracker: its name (see :func:`lae_sim.trackers.names.make_tracker`).
        options: keyword arguments of its factory (JSON values).
        translate: set the search by shifting the frame, even where the tracker can be told.
        python: interpreter of the worker process, 3.8 or newer; this one if None.
        in_process: run the tracker in this process, without timeouts: for debugging.
        threads: that the tracker's libraries may use; None leaves them as they are.
        frame_timeout: what a call may take before its sequence is given up, ns; None is 30 s, or
            what the registry of a ``vot:`` tracker says.
        warmup: calls before anything is measured.
        dataset, root, sequences, box, fps, frame_times: the frames (see
            :func:`lae_sim.datasets.layouts.find_dataset`).
        mode: ``"every-frame"``, or ``"real-time"`` to skip frames while the tracker is busy; by
            default real-time with a ``policy`` or a ``timing``, otherwise every frame.
        policy: which frame a free tracker takes (see :func:`lae_sim.replay.names.parse_policy`);
            latest if None. Real-time only.
        pre_forecaster: name of the forecaster that sets the search region before each frame.
        pre_forecaster_cost: what it adds to a frame's time, ns; None to measure it.
        keep_size: predict the centre of the search region only.
        timing: times that the schedule follows instead of the measured ones (see
            :func:`lae_sim.profile.passes.parse_timing`). Real-time only.
        strides: further passes on every N-th frame, each above 1.
        closed_loops: further real-time passes under these times, as of ``timing``.
        gaps: what a further pass may take that measures the tracker's reach by restarts (see
            :mod:`lae_sim.profile.gaps`), ns; None for no such pass. :meth:`of` takes text, and True
            for half an hour.
        repeat: how often the first pass is run.
        include_decode: whether times include the decoding of frames.
        beside: commands of the shell that run while anything is measured, and are ended then.
        idle: how long the power of the device at rest is measured before the tracker is started,
            ns; where no sensor tells it, no time is spent.

    Raises:
        LaeError: if some do not go together.
    """

    tracker: str = "dcf"
    options: Mapping[str, Any] = field(default_factory=dict)
    translate: bool = False
    python: str | None = None
    in_process: bool = False
    threads: int | None = None
    frame_timeout: int | None = None
    warmup: int = 5
    dataset: str | None = None
    root: str | Path | None = None
    sequences: Sequence[str] | None = None
    box: Sequence[float] | None = None
    fps: Fraction | None = None
    frame_times: str | None = None
    mode: str | None = None
    policy: str | None = None
    pre_forecaster: str | None = None
    pre_forecaster_cost: int | None = 0
    keep_size: bool = False
    timing: str | None = None
    strides: Sequence[Fraction] = ()
    closed_loops: Sequence[str] = ()
    gaps: int | None = None
    repeat: int = 1
    include_decode: bool = False
    beside: Sequence[str] = ()
    idle: int = 2 * NS_PER_SECOND

    def __post_init__(self) -> None:
        if self.mode not in (None, *MODES):
            raise LaeError(f"mode: no {self.mode!r}: there are {' and '.join(MODES)}")
        if not self.real_time and (self.policy or self.timing):
            raise LaeError("policy and timing are for mode real-time")
        if self.real_time and (self.strides or self.closed_loops or self.gaps):
            raise LaeError("strides, gaps and closed loops go with mode every-frame")
        if (self.translate or self.keep_size) and self.pre_forecaster is None:
            raise LaeError("translate and keep_size are ways to use a pre_forecaster")

    @classmethod
    def of(cls, **settings: Any) -> ProfilePlan:
        """A plan from text and plain numbers, as command lines have them.

        Args:
            settings: the attributes by name. Rates and strides may be text (``"30000/1001"``,
                ``"3/2"``) or numbers; durations are text (``"2ms"``), and a cost may be
                ``"measured"``; one sequence, stride or closed loop needs no list.

        Raises:
            LaeError: if a value is impossible, or some do not go together; it names the setting.
            TypeError: if there is no such setting.
        """
        values = {}
        for each in fields(cls):
            if each.name in settings:
                value = settings.pop(each.name)
                keep = value is None and each.default is None
                values[each.name] = value if keep else named(each.name, _PARSERS[each.name], value)
        if settings:
            name = next(iter(settings))
            raise TypeError(f"there is no setting {name!r}{hint(name, _PARSERS)}")
        return cls(**values)

    @property
    def real_time(self) -> bool:
        """Whether the first pass skips frames while the tracker is busy."""
        if self.mode is None:
            return bool(self.policy or self.timing)
        return self.mode == "real-time"

    def settings(self) -> dict[str, str]:
        """The fields as text, for a resumed profile to compare."""
        gaps = "none" if self.gaps is None else f"{self.gaps / NS_PER_SECOND:g} s"
        return {each.name: str(getattr(self, each.name)) for each in fields(self)} | {"gaps": gaps}


@dataclass(frozen=True, repr=False)
class Profile:
    """What a profile left.

    Attributes:
        traces: of the passes; none if there was nothing to resume.
        failures: the sequences that failed, of all passes.
    """

    traces: tuple[PassSummary, ...]
    failures: tuple[Failure, ...]

    def to_frame(self) -> DataFrame:
        """A row per trace: the attributes of :class:`lae_sim.profile.passes.PassSummary`."""
        import pandas as pd

        return pd.DataFrame([{**asdict(each), **each.schedule} for each in self.traces])

    def __repr__(self) -> str:
        if not self.traces:
            return "<Profile: nothing was left to do>"
        parts = [
            f"{each.trace}: {each.sequences} sequence{'s' * (each.sequences != 1)}"
            + ("" if each.median_ms is None else f", median {each.median_ms:.3g} ms")
            for each in self.traces
        ]
        parts += [f"{len(self.failures)} failed"] * bool(self.failures)
        return f"<Profile of {'; '.join(parts)}>"

    def _repr_html_(self) -> str:
        columns = ["trace", "kind", "timing", "sequences", "world_frames", "processed", "lost"]
        times = ["init_ms", "median_ms", "p95_ms"]
        table = self.to_frame().reindex(columns=[*columns, *times])
        html: str = table.to_html(index=False, float_format="{:.2f}".format, na_rep="-")
        failures = (f"{each.sequence}: {each.reason}" for each in self.failures)
        return html + "".join(f"<p>failed: {escape(failure)}</p>" for failure in failures)


def profile_tracker(
    tracker: str = "dcf",
    *,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    force: bool = False,
    progress: ShowProgress = None,
    **settings: Any,
) -> Profile:
    """Run a tracker on this device and write a trace of each pass.

    What is finished is kept beside the trace until all is, so that an interrupted profile can be
    resumed. On Ctrl-C the traces of what is complete are written before it is raised again.

    Args:
        tracker: its name (see :func:`lae_sim.trackers.names.make_tracker`).
        out: the first trace, ``.parquet``; further passes are written beside it. By default
            ``TRACKER-DATASET.parquet`` in the current folder.
        resume: whether to go on with a profile that was interrupted.
        force: whether to replace what is there already, be it a trace of another tracker or
            dataset, or no trace.
        progress: whether to show a progress bar, and what a user should know besides; by default
            on a terminal and in a notebook; or a function, which is told:
            ``progress(done, total, what)``.
        settings: attributes of :class:`ProfilePlan`, as :meth:`ProfilePlan.of` takes them.

    Raises:
        LaeError: if something cannot be used, or no sequence could be profiled.

    Example:
        >>> import tempfile
        >>> import lae_sim
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     profile = lae_sim.profile_tracker(
        ...         "dcf", sequences="race", out=f"{folder}/dcf.parquet", in_process=True
        ...     )
        ...     trace = lae_sim.read_trace(profile.traces[0].trace)
        ...     len(trace["race"])
        ...     profile
        160
        <Profile of .../dcf.parquet: 1 sequence, median ... ms>
    """
    plan = ProfilePlan.of(tracker=tracker, **settings)
    if out is not None and not isinstance(out, (str, os.PathLike)):
        raise LaeError(f"out: a path, not {shown(out)}")
    with ProgressBar(tracker, "frames", progress) as bar:

        def notice(text: str) -> None:
            if bar.shown:
                bar.close()
                tell(text)

        return run_profile(plan, out, resume=resume, force=force, progress=bar, notice=notice)


def run_profile(
    plan: ProfilePlan,
    out: str | os.PathLike[str] | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    progress: Callable[[int, int], object] = lambda done, total: None,
    notice: Callable[[str], object] = lambda text: None,
) -> Profile:
    """The same for a plan.

    Args:
        plan: what to measure.
        out, resume, force: as of :func:`profile_tracker`.
        progress: ``progress(done, total)`` is called with world frames, before the first and after
            each.
        notice: called with each line that a user should read.

    Raises:
        LaeError: as :func:`profile_tracker`.
    """
    dataset = find_dataset(
        plan.dataset, plan.root, plan.sequences, plan.box, plan.fps, plan.frame_times
    )
    path = _trace_path(out, f"{plan.tracker}-{dataset.name}")
    check_places([path])
    _check_names(dataset)
    with locked(path, f"{path}: another profile"):
        return _run(plan, dataset, path, resume, force, progress, notice)


def _run(
    plan: ProfilePlan,
    dataset: Dataset,
    path: Path,
    resume: bool,
    force: bool,
    progress: Callable[[int, int], object],
    notice: Callable[[str], object],
) -> Profile:
    """The profile of a dataset, while no other writes the trace."""
    unfinished = _beside(path, ".unfinished")
    if resume and path.exists() and not unfinished.exists():
        metadata = read_trace(path).metadata
        notice(
            f"{path} is complete ({metadata.tracker} on {metadata.dataset}): nothing to resume; "
            "remove it to profile anew"
        )
        return Profile((), ())
    for said in dataset.notes:
        notice(said)
    failures: dict[str, list[Failure]] = {}
    interrupted: KeyboardInterrupt | None = None
    sampler = Sampler(find_sensors())
    with sampler, ExitStack() as around:
        resting = at_rest(sampler, plan.idle / NS_PER_SECOND)
        if not resting and plan.idle > ProfilePlan.idle:  # asked for, more than is usual
            notice("the power at rest is not measured: no sensor of it answers here")
        started = around.enter_context(closing(_start(plan, notice)))
        with suppress(LaeError):  # a tracker may import libraries, or reach the GPU, only now
            warm_up(started, dataset.sequences[0], min(plan.warmup, 1))
        passes = _passes(plan, dataset, started, path, resting, notice)
        check_places(each.path for each in passes)
        _check_files(plan, passes, force)
        if path.exists() and not resume:
            notice(f"{path} will be replaced")
        described = {f"tracker's {key}": value for key, value in started.describe().items()}
        settled = {"lae_sim": __version__, **plan.settings(), **described}
        loads = around.enter_context(Loads(plan.beside))  # which may fail, and leave nothing
        journal = Journal(unfinished, settled, resume)
        total = done = 0

        def advance(frames: int) -> None:
            nonlocal done
            done += frames
            loads.watch()
            progress(done, total)

        with _kept(unfinished):
            try:
                for task in passes:
                    task.prepare(journal)
                    total = sum(each.work(s) for each in passes for s in dataset.sequences)
                    advance(0)
                    failures[task.name] = run_pass(
                        task, dataset, started, journal, plan.warmup, advance, sampler, loads
                    )
            except KeyboardInterrupt as error:
                interrupted = error
    for each in loads.ended():
        notice(each)
    for name, count in sampler.failures.items():
        notice(f"{name}: {count} of {sampler.readings:,} readings failed: it says nothing of these")
    with _kept(unfinished):
        written = [t for t in passes if write_pass(t, journal, failures.get(t.name, []))]
    if not interrupted or not written:
        journal.remove()
    failed = tuple(failure for each in failures.values() for failure in each)
    reasons = list(dict.fromkeys(failure.reason for failure in failed))  # passes fail alike
    for reason in reasons[:_FAILURES]:
        notice(f"failed: {reason}")
    if len(reasons) > _FAILURES:
        notice(f"failed: and {len(reasons) - _FAILURES:,} more")
    if interrupted:
        kept = f"{path} holds what is complete; --resume goes on"
        notice(kept if written else "no sequence is complete yet: nothing is kept")
        raise interrupted
    if not written:
        raise LaeError("no sequence could be profiled")
    resized = read_trace(written[0].path).metadata.resized
    if resized:
        notice(
            f"note: the images of {len(resized)} sequences change size, such as those of "
            f"{resized[0]!r}: the trace says from which frame on"
        )
    return Profile(tuple(summary(task.path) for task in written), failed)


@contextmanager
def _kept(unfinished: Path) -> Iterator[None]:
    """Say of an error, such as a full disk, that nothing is lost."""
    try:
        yield
    except LaeError as error:
        raise LaeError(f"{error}; {unfinished} keeps what is complete: --resume goes on") from error


def _trace_path(out: str | os.PathLike[str] | None, name: str) -> Path:
    """The path of the first trace, by default of the name's letters and digits."""
    if out is None:
        return Path("".join(c if c.isalnum() or c in "-_" else "-" for c in name) + ".parquet")
    if not str(out).endswith(".parquet"):
        raise LaeError(f"out {out}: call the trace something.parquet")
    return Path(out)


def _beside(path: Path, suffix: str) -> Path:
    """The path with another suffix; under a short name if that were too long."""
    longer = path.with_suffix(suffix)
    short = len(os.fsencode(longer.name)) <= NAME_MAX
    return longer if short else path.with_name(text_digest(path.name) + suffix)


def _path(value: Any) -> str:
    """A path as text."""
    return text(os.fspath(value) if isinstance(value, os.PathLike) else value)


def _options(value: Any) -> Mapping[str, Any]:
    if not (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)):
        raise LaeError(f"{shown(value)} is no mapping from names to values")
    return value


def _box(value: Any) -> tuple[float, ...]:
    numbers = tuple(value.split(",") if isinstance(value, str) else several(value))
    try:
        x, y, w, h = map(float, numbers)
    except (TypeError, ValueError) as error:
        raise LaeError(f"{shown(value)} is no box x, y, w, h in pixels") from error
    return x, y, w, h


def _policy(value: Any) -> str:
    """A policy's name, looked up before the tracker is started."""
    parse_policy(text(value))
    return text(value)


def _timing(value: Any) -> str:
    """Times as of :func:`.passes.parse_timing`, looked at before the tracker is started."""
    name, _ = split_timing(_path(value))
    kind, _, elapsed = name.partition(":")
    if kind == "constant":
        parse_duration(elapsed)
    else:
        read_trace(name)
    return _path(value)


def _gaps(value: Any) -> int | None:
    """A budget; True is the usual one, False none."""
    if isinstance(value, bool):
        return BUDGET_NS if value else None
    return parse_budget(value)


def _each(parse: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    return lambda value: tuple(map(parse, several(value)))


# setting -> how its value is read
_PARSERS: Mapping[str, Callable[[Any], Any]] = {
    "tracker": text,
    "options": _options,
    "translate": flag,
    "python": _path,
    "in_process": flag,
    "threads": partial(whole, least=1),
    "frame_timeout": parse_duration,
    "warmup": whole,
    "dataset": text,
    "root": _path,
    "sequences": sequence_names,
    "box": _box,
    "fps": parse_fps,
    "frame_times": check_frame_times,
    "mode": text,
    "policy": _policy,
    "pre_forecaster": text,
    "pre_forecaster_cost": parse_cost,
    "keep_size": flag,
    "timing": _timing,
    "strides": _each(parse_stride),
    "closed_loops": _each(_timing),
    "gaps": _gaps,
    "repeat": partial(whole, least=1),
    "include_decode": flag,
    "beside": _each(text),
    "idle": parse_duration,
}


def _start(plan: ProfilePlan, notice: Callable[[str], object]) -> TimedTracker:
    """The tracker, in a worker process unless asked otherwise, under translation if needed."""
    tracker: TimedTracker
    if plan.in_process:
        tracker = InProcess(plan.tracker, plan.options, threads=plan.threads)
    else:
        tracker = Worker(
            plan.tracker,
            plan.options,
            python=plan.python,
            threads=plan.threads,
            timeout=plan.frame_timeout and plan.frame_timeout / NS_PER_SECOND,
        )
    needed = plan.pre_forecaster is not None and not tracker.sets_search
    if needed:
        notice("the tracker has no set_search, so frames are shifted")
    return Translated(tracker) if plan.translate or needed else tracker


def _passes(
    plan: ProfilePlan,
    dataset: Dataset,
    tracker: TimedTracker,
    out: Path,
    resting: Facts,
    notice: Callable[[str], object],
) -> list[Pass]:
    """The first pass and its repetitions, the strided ones, the gap pass and the closed loops."""
    clock = Clock.at(dataset.fps)
    policy_name = plan.policy or "latest"
    policy = parse_policy(policy_name)
    includes = "init and track calls" + (
        " and the decoding of frames" if plan.include_decode else "; frames decoded before"
    )
    document = base_document(
        plan.tracker, tracker, dataset.name, clock, plan.warmup, includes, resting
    )
    if dataset.frame_times:  # numbers are missing
        document["dataset"]["frame_times"] = dataset.frame_times
    live: dict[str, Any] = {"tracker": tracker, "include_decode": plan.include_decode}
    live["clock"] = clock
    if plan.pre_forecaster is not None:
        cost = plan.pre_forecaster_cost
        camera = Camera({}, dataset.fps)  # a live sequence brings its frames
        live["pre_forecaster"] = load_forecaster(plan.pre_forecaster, camera)
        live["forecaster_ns"], live["keep_size"] = cost, plan.keep_size
        document["schedule"] = {
            "pre_forecaster": plan.pre_forecaster,
            "pre_forecaster_cost": "measured" if cost is None else f"{cost} ns",
            "search": "translation" if isinstance(tracker, Translated) else "native",
            "keep_size": plan.keep_size,
        }

    def path_of(name: str) -> Path:
        return out.with_suffix(f".{name}.parquet") if name else out

    def new_pass(name: str, run: Callable[..., LiveRun], rounds: int = 1, **schedule: Any) -> Pass:
        return Pass(
            name or "first",
            path_of(name),
            scheduled(document, **schedule),
            lambda sequence, progress: [run(sequence, progress=progress)],
            work=lambda sequence: rounds * len(sequence),
            ahead=not plan.include_decode,
        )

    def real_time(name: str, timing: str | None) -> Pass:
        source, times = parse_timing(timing) if timing else ("measured", None)

        def run(sequence: ImageSequence, progress: Progress) -> LiveRun:
            service = times(sequence) if times else None
            return run_real_time(
                sequence, policy=policy, service=service, progress=progress, **live
            )

        return new_pass(name, run, kind="real-time", policy=policy_name, source=source)

    def every_frame(name: str) -> Pass:
        return new_pass(name, partial(run_every_frame, **live), kind="every-frame")

    def strided(stride: Fraction) -> Pass:
        return new_pass(
            f"stride{stride}".replace("/", "-"),
            partial(run_every_frame, stride=stride, **live),
            rounds=len(phases(stride, 4 * stride.numerator)),
            kind="every-frame",
            stride=str(stride),
        )

    def gap_pass(budget_ns: int) -> Pass:
        metadata = scheduled(document, kind="restarts")
        half_side = metadata.search.half_side if metadata.search else None
        gaps = Gaps(dataset, live, budget_ns, half_side, notice)
        return Pass(
            "gaps",
            path_of("gaps"),
            metadata,
            gaps.run,
            work=gaps.calls,
            ahead=False,
            prepare=gaps.prepare,
            schedule=gaps.schedule,
        )

    names = ["", *(f"repeat{n}" for n in range(2, plan.repeat + 1))]
    passes = [real_time(n, plan.timing) if plan.real_time else every_frame(n) for n in names]
    passes += [strided(stride) for stride in dict.fromkeys(plan.strides)]
    passes += [] if plan.gaps is None else [gap_pass(plan.gaps)]
    passes += [
        real_time(f"closed-loop-{_short(timing)}", timing)
        for timing in dict.fromkeys(plan.closed_loops)
    ]
    return passes


def _check_names(dataset: Dataset) -> None:
    """Check that a trace can hold the names of the sequences."""
    for sequence in dataset.sequences:
        if fault := text_fault(sequence.name):
            raise LaeError(f"sequence {shown(sequence.name)}: the name {fault}: rename it")


def _check_files(plan: ProfilePlan, passes: Sequence[Pass], force: bool) -> None:
    """Check that no trace replaces what is read, or without force what is of something else."""
    times = [split_timing(timing)[0] for timing in (plan.timing, *plan.closed_loops) if timing]
    inputs = [name for name in times if not name.startswith("constant:")]
    named = (plan.tracker, plan.pre_forecaster, *map(str, plan.options.values()))
    for name in filter(None, named):  # an option may be the path of weights
        inputs += [name, *files_named(name)]
    inputs += [str(plan.root)] * bool(plan.root)
    # a dataset's folder may hold the traces: nothing but traces is replaced
    files = [name for name in inputs if not os.path.isdir(name)]
    check_distinct([each.path for each in passes], files)
    for each in passes:
        if not force:
            check_replaces(each.path, each.metadata.tracker, each.metadata.dataset)


def _short(timing: str) -> str:
    """What tells a closed loop's trace from others."""
    name, init_ns = split_timing(timing)
    short = name.removeprefix("constant:") if name.startswith("constant:") else Path(name).stem
    return short if init_ns is None else f"{short}-init-{time_label(init_ns)}"
