"""What forecasting costs: declared, or measured on this machine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from time import perf_counter_ns

from lae_sim.engine.clock import parse_duration
from lae_sim.errors import LaeError, explained
from lae_sim.forecast.base import AnyFactory, factory_for
from lae_sim.trace.recording import Recording

_ANSWERS = 500


def measure_cost(factory: AnyFactory, recording: Recording, name: str = "forecaster") -> int:
    """Median time of an update and a prediction, one box after another, ns.

    Args:
        factory: makes the forecaster.
        recording: its boxes are what the forecaster is fed.
        name: the forecaster's name, for messages.
    """
    outputs = [
        (frame, box) for frame, box in enumerate(recording.boxes.tolist()) if box[0] == box[0]
    ]
    taken = []
    with explained(name):
        forecaster = factory_for(factory, recording)(outputs[0][1], None)
        for frame, box in outputs[1 : _ANSWERS + 1]:
            before = perf_counter_ns()
            forecaster.update(frame, box)
            forecaster.predict(frame + 1)
            taken.append(perf_counter_ns() - before)
    return int(median(taken)) if taken else 0


def cost_notes(costs: Mapping[str, int]) -> list[str]:
    """What to say of the costs that were counted, if there were any."""
    listed = ", ".join(f"{name} {ns / 1000:g} us" for name, ns in costs.items())
    return [f"answers come later by what forecasting costs: {listed}"] if costs else []


def resolve_costs(
    texts: Sequence[str], forecasters: Mapping[str, AnyFactory], trace: Iterable[Recording]
) -> dict[str, int]:
    """The cost of each forecaster's answers, ns; those not named cost nothing.

    Args:
        texts: ``COST`` for every forecaster but hold, or ``NAME=COST`` for one; the last counts. A
            cost is a time such as ``2ms``, or ``measured``.
        forecasters: factories by name.
        trace: they are measured on its first recording.

    Raises:
        LaeError: if a text is none of these, or names another forecaster.
    """
    costs: dict[str, int | None] = {}
    for text in texts:
        name, _, cost = text.rpartition("=")
        if name and name not in forecasters:
            raise LaeError(f"the cost {text!r}: there is no forecaster {name!r} here")
        names = [name] if name else [each for each in forecasters if each != "hold"]
        costs.update(dict.fromkeys(names, parse_cost(cost)))
    return {
        name: measure_cost(forecasters[name], next(iter(trace)), name) if cost is None else cost
        for name, cost in costs.items()
    }


def parse_cost(text: str) -> int | None:
    """A cost such as ``2ms`` in ns, or None for ``measured``.

    Raises:
        LaeError: if the text is neither.
    """
    return None if text == "measured" else parse_duration(text)
