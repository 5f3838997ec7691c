"""A stopwatch around a tracker, in the process where the tracker runs."""

from __future__ import annotations

import json
import math
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter_ns, process_time_ns
from typing import Any

from lae_sim.errors import LaeError, shown
from lae_sim.trackers.names import make_tracker
from lae_sim.trackers.protocol import Image
from lae_sim.trackers.runtimes import Runtimes
from lae_sim.trackers.stages import MOST_STAGES, listening

LARGEST = 1e9
"""The largest number in a box, pixels: what lies beyond is no place in an image."""

LARGEST_SCORE = 3.4e38
"""Of a float32, in which traces hold scores."""


class Stopwatch:
    """A tracker whose calls are timed and whose answers are checked.

    The time is that of ``init`` or ``track`` alone, from a device at rest to a device at rest: by
    the tracker's ``sync``, or torch's for CUDA if there is none. A frame is the tracker's own copy:
    it may keep it or write to it. The garbage collector is left on: a tracker in use has it too, so
    its pauses are latency.

    Args:
        tracker: the name, see `make_tracker`.
        options: keyword arguments of its factory.
        threads: that libraries may use, see `.runtimes.Runtimes`; None leaves them as they are.

    Attributes:
        sets_search: whether the tracker can be told where to search.

    Raises:
        LaeError: if the tracker cannot be made, or answers anything but a box.
        BaseException: whatever the tracker raises, in each method; after that it must be
            initialised again.
    """

    def __init__(
        self, tracker: str, options: Mapping[str, Any], threads: int | None = None
    ) -> None:
        self._runtimes = Runtimes(threads)
        try:
            self._set_up(tracker, options)
        except BaseException:
            self._runtimes.close()
            raise

    def _set_up(self, tracker: str, options: Mapping[str, Any]) -> None:
        self._tracker: Any = make_tracker(tracker, options)
        for name in ("init", "track"):
            if not callable(getattr(self._tracker, name, None)):
                raise LaeError(
                    f"tracker {tracker!r} has no method {name}(): it needs init and track"
                )
        self._sync: Callable[[], object] = getattr(self._tracker, "sync", _cuda_at_rest)
        self._started = False
        self._stages: set[str] = set()
        self.sets_search = hasattr(self._tracker, "set_search")
        self._runtimes.limit()

    def init(self, frame: Image, box: Sequence[float]) -> dict[str, Any]:
        """Start on a new sequence; what is answered has the fields of `.timed.Answer`."""
        self._started = False
        getattr(self._tracker, "prepare", int)()
        _, times = self._timed(self._tracker.init, frame.copy(), box)
        self._runtimes.limit()  # for libraries that the tracker imports only now
        self._started = True
        return {"box": list(box), "score": None, **times}

    def track(self, frame: Image, search: Sequence[float] | None = None) -> dict[str, Any]:
        """Find the target, around ``cx, cy, w, h`` if ``search`` is given."""
        if not self._started:
            raise LaeError("the tracker must be initialised first")
        self._started = False
        if search is not None:
            if not self.sets_search:
                raise LaeError("the tracker cannot be told where to search: it has no set_search")
            self._tracker.set_search(*search)
        output, times = self._timed(self._tracker.track, frame.copy())
        box, score = _checked(_plain(output))
        self._started = True
        return {"box": box, "score": score, **times}

    def describe(self) -> dict[str, Any]:
        """What the tracker says of itself, and its interpreter and libraries, as JSON values."""
        own: Mapping[str, Any] = getattr(self._tracker, "describe", dict)()
        description = {
            **own,
            "python": platform.python_version(),
            "libraries": {**self._runtimes.versions(), **own.get("libraries", {})},
            "threads": self._runtimes.threads(),
            "synchronised": self._synchronised(),
            "models": self._runtimes.models() or None,
            **_cuda(),
        }
        description = {key: value for key, value in description.items() if value is not None}
        plain: dict[str, Any] = json.loads(json.dumps(description, default=_text))
        return plain

    def close(self) -> None:
        """Have the tracker give its resources back."""
        try:
            getattr(self._tracker, "close", int)()
        finally:
            self._runtimes.close()

    def _synchronised(self) -> bool | None:
        """Whether a device was waited for; None where answers come when it has finished."""
        if self._sync is not _cuda_at_rest or _torch_on_cuda() is not None:
            return True
        return False if self._runtimes.asynchronous() else None

    def _timed(self, call: Callable[..., Any], *arguments: Any) -> tuple[Any, dict[str, Any]]:
        """What a call returns, and the times of the answer."""
        self._sync()
        with listening() as marked:
            cpu, start = process_time_ns(), perf_counter_ns()
            output = call(*arguments)
            self._sync()
            elapsed_ns, cpu_ns = perf_counter_ns() - start, process_time_ns() - cpu
        self._stages.update(marked.ns)
        if len(self._stages) > MOST_STAGES:
            raise LaeError(
                f"marks more than {MOST_STAGES} stages, such as {min(marked.ns)!r} and "
                f"{max(marked.ns)!r}: what every call does again has one name"
            )
        return output, {"elapsed_ns": elapsed_ns, "cpu_ns": cpu_ns, "stages": marked.ns}


def _torch_on_cuda() -> Any:
    torch = sys.modules.get("torch")
    return torch if torch and torch.cuda.is_initialized() else None


def _cuda_at_rest() -> None:
    torch = _torch_on_cuda()
    if torch:
        torch.cuda.synchronize()


def _plain(output: Any) -> Any:
    """Arrays and tensors as lists, lists as tuples, NumPy's numbers as Python's."""
    if isinstance(output, (list, tuple)):
        return tuple(_plain(item) for item in output)
    return output.tolist() if hasattr(output, "tolist") else output


def _checked(output: Any) -> tuple[list[float] | None, float | None]:
    scored = isinstance(output, tuple) and len(output) == 2
    box: Any
    score: Any
    box, score = output if scored else (output, None)
    if box is not None:
        numbers = box if isinstance(box, (list, tuple)) else ()
        if len(numbers) != 4 or not all(_is_number(v) and abs(v) <= LARGEST for v in numbers):
            wrong = f"answered {shown(output)}, not a box of four finite numbers"
            if len(numbers) > 1 and all(isinstance(row, (list, tuple)) for row in numbers):
                wrong += "; lae_sim.trackers.box_of makes one of a mask"
            if isinstance(box, bool):
                wrong += "; of OpenCV's (found, box) answer the box, or None if it is not found"
            raise LaeError(wrong)
        box = [float(v) for v in numbers]
    return box, _score(score)


def _score(score: Any) -> float | None:
    """A score as a trace holds it; None if it is no number, or not a finite one."""
    if not _is_number(score) or (isinstance(score, float) and not math.isfinite(score)):
        return None
    if abs(score) > LARGEST_SCORE:
        raise LaeError(f"answered the score {shown(score)}, which no float32 holds")
    return float(score)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cuda() -> dict[str, Any]:
    """What torch says of CUDA, and of the GPU if it is in use: asking would take it into use."""
    torch = sys.modules.get("torch")
    if not torch or not torch.version.cuda:
        return {}
    cuda = {"cuda": torch.version.cuda, "cudnn": torch.backends.cudnn.version()}
    if _torch_on_cuda():
        cuda["gpu"] = torch.cuda.get_device_name()
    return cuda


def _text(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
