"""Passes and the traces that they go with."""

from __future__ import annotations

import pytest

from lae_sim.errors import LaeError
from lae_sim.replay.passes import passes_for, split_passes
from lae_sim.trace.file import Trace
from lae_sim.trace.metadata import Metadata


def of(tracker, dataset, kind="every-frame"):
    return Trace(Metadata.new("30", kind, tracker={"name": tracker}, dataset=dataset), [])


def test_passes_go_with_the_traces_of_their_tracker_and_dataset():
    traces = [of("a", "D"), of("b", "D"), of("a", "E"), of("a", "D")]
    passes = [of("a", "D", "restarts"), of("a", "E"), of("a", "D")]
    first, second, third = passes
    assert passes_for(traces, passes) == [(first, third), (), (second,), (first, third)]
    assert passes_for(traces[1:2], passes) == [(first, second, third)]  # whatever they say
    assert passes_for(traces, []) == [()] * 4
    with pytest.raises(LaeError, match="a pass is of c on D: none of the traces is of the same"):
        passes_for(traces, [*passes, of("c", "D")])


def test_passes_are_told_apart_by_their_kind():
    strided, gaps, more = of("a", "D"), of("a", "D", "restarts"), of("a", "D")
    assert split_passes(iter([strided, gaps, more])) == ((strided, more), (gaps,))
