"""Search control by moving the frame."""

from __future__ import annotations

import numpy as np
import pytest
from fakes import FakeTimed, bright_frame
from hypothesis import given
from hypothesis import strategies as st

from lae_sim.profile.translation import Translated, shifted


@given(dx=st.integers(-70, 70), dy=st.integers(-70, 70))
def test_a_shifted_frame_is_the_frame_seen_through_a_moved_window(dx: int, dy: int) -> None:
    frame = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    rows = np.clip(np.arange(24) + dy, 0, 23)
    columns = np.clip(np.arange(32) + dx, 0, 31)
    np.testing.assert_array_equal(shifted(frame, dx, dy), frame[rows][:, columns])


def test_the_predicted_box_falls_where_the_tracker_last_saw_the_target() -> None:
    inner = FakeTimed(reach=2.0, sets_search=False)
    tracker = Translated(inner)
    tracker.init(bright_frame(10, 20), [10, 20, 12, 10])
    assert tracker.track(bright_frame(40, 28)).box is None  # out of reach
    found = tracker.track(bright_frame(40, 28), [45.6, 33.2, 12, 10])
    assert found.box == (40, 28, 12, 10)
    assert inner.searches == [None, None]
    # the tracker itself saw it beside its old place
    assert np.argwhere(inner.frames[-1][:, :, 0])[0].tolist() == [20, 10]
    # without a search the last shift stands
    assert tracker.track(bright_frame(41, 28)).box == (41, 28, 12, 10)
    # and a new sequence starts unshifted
    tracker.init(bright_frame(60, 30), [60, 30, 12, 10])
    assert tracker.track(bright_frame(61, 30)).box == (61, 30, 12, 10)


def test_the_rest_is_the_trackers_own() -> None:
    inner = FakeTimed([77])
    tracker = Translated(inner)
    assert tracker.sets_search
    assert tracker.init(bright_frame(1, 1), [1, 1, 12, 10]).elapsed_ns == 77
    assert tracker.describe() == {"name": "fake"}
    tracker.close()
    assert inner.closed


def test_it_keeps_a_fast_target_in_reach() -> None:
    """A target of 6 pixels a frame, seen every 5th frame, by a tracker that reaches 8 pixels."""
    tracker = Translated(FakeTimed(reach=8.0))
    wide = (400, 64)
    tracker.init(bright_frame(5, 20, size=wide), [5, 20, 12, 10])
    for frame in (1, *range(5, 60, 5)):
        x = 5 + 6 * frame
        found = tracker.track(bright_frame(x, 20, size=wide), [x + 6, 25, 12, 10])
        assert found.box == pytest.approx((x, 20, 12, 10))
