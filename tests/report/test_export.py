"""Names of the result folders that toolkits read."""

from __future__ import annotations

from fractions import Fraction

from lae_sim.report.export import result_names


def test_any_forecaster_has_a_result_folder_of_its_own() -> None:
    forecasters = ["kalman", "learned:m/good.pt", "learned:m-good.pt", "learned:M-good.pt", "a:b?"]
    forecasters.append(f"learned:{'m' * 300}.pt")
    names = result_names("nano", forecasters, [Fraction(0), Fraction(1, 3)])
    assert names["kalman", Fraction(0)] == "nano-kalman"
    assert names["kalman", Fraction(1, 3)] == "nano-kalman-sigma1_3"
    assert names["learned:m/good.pt", Fraction(0)] == "nano-learned.m-good.pt"
    assert len({name.casefold() for name in names.values()}) == 2 * len(forecasters)
    assert all(len(name) <= 255 and not set(name) & set("/:?") for name in names.values())
