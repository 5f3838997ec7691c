"""What metadata says of the energy of a call, whoever wrote it."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.trace.energy import Energy

ENTRY = {
    "calls": 200,
    "seconds": 4.0,
    "power_w": {"VDD_IN": 9.0, "VDD_SOC": 2.0},
    "idle_w": {"VDD_IN": 5.0, "VDD_SOC": 1.5},
    "total": ["VDD_IN"],
}


def of(**more: Any) -> Energy | None:
    return Energy.of({"device": {"energy": {**ENTRY, **more}}})


def test_the_energy_of_a_call() -> None:
    energy = of()
    assert energy is not None
    assert (energy.watts, energy.idle_watts) == (9.0, 5.0)
    assert energy.joules_per_frame == pytest.approx(9 * 4 / 200)
    assert energy.joules_above_idle == pytest.approx((9 - 5) * 4 / 200)
    assert Energy.of({"device": {"energy": energy.entry()}}) == energy


def test_parts_make_the_device_only_together() -> None:
    both = of(total=["VDD_IN", "VDD_SOC"])
    assert both is not None
    assert (both.watts, both.idle_watts) == (11.0, 6.5)
    one_failed = of(total=["VDD_IN", "GPU"])
    assert one_failed is not None
    assert one_failed.joules_per_frame is None
    no_rest = of(idle_w={})
    assert no_rest is not None
    assert no_rest.joules_above_idle is None
    assert "idle_w" not in no_rest.entry()
    assert "joules_per_frame_above_idle" not in no_rest.entry()
    nothing = of(total=[])
    assert nothing is not None
    assert nothing.watts is None


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=2), inner),
    max_leaves=3,
)


@given(st.fixed_dictionaries({}, optional=dict.fromkeys(ENTRY, JSON)), st.sampled_from([*ENTRY]))
def test_whatever_another_program_wrote(entry: dict[str, Any], key: str) -> None:
    for said in (entry, {**ENTRY, key: entry.get(key)}):
        found = Energy.of({"device": {"energy": said}})
        if found is not None:
            found.entry()
    assert Energy.of({}) is None
    assert Energy.of({"device": []}) is None
