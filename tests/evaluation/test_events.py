from fractions import Fraction

import numpy as np

import lae_sim
from lae_sim.engine.clock import Clock
from lae_sim.engine.policies import fifo

# 10 frames/s: one tick is 0.1 ns, a frame is 100 ms = 10**9 ticks.
CLOCK = Clock.at(Fraction(10))
MS = 10**7


def run(times_ms):
    boxes = np.zeros((len(times_ms), 4))
    elapsed = np.array(times_ms) * 1_000_000
    recording = lae_sim.Recording.new("sequence", boxes, boxes, elapsed)
    return lae_sim.replay_sequence(recording, CLOCK)


def test_the_whole_story_of_four_frames():
    log = lae_sim.event_log(run([150, 100, 40, 40]))
    assert [(event.tick / MS, *event[1:]) for event in log] == [
        (0, "frame arrived", 0, None),
        (0, "processing started", 0, None),
        (0, "query answered", 0, 0),
        (100, "frame arrived", 1, None),
        (100, "query answered", 1, 0),
        (150, "output ready", 0, None),
        (150, "processing started", 1, None),
        (200, "frame arrived", 2, None),
        (200, "query answered", 2, 0),
        (250, "output ready", 1, None),
        (250, "processing started", 2, None),
        (290, "output ready", 2, None),
        (300, "frame arrived", 3, None),
        (300, "processing started", 3, None),
        (300, "forecaster updated", 2, None),
        (300, "query answered", 3, 2),
        (340, "output ready", 3, None),
    ]


def test_a_skipped_frame_is_skipped_when_a_newer_one_starts_or_at_the_end():
    log = lae_sim.event_log(run([250, 40, 40, 500, 40]))
    skipped = [(event.tick / MS, event.frame) for event in log if event.kind == "frame skipped"]
    assert skipped == [(250, 1), (500, 4)]


def test_an_output_that_is_ready_at_the_query_answers_it():
    log = lae_sim.event_log(run([100, 100, 100]))
    at_200 = [event[1:] for event in log if event.tick == 200 * MS]
    assert at_200 == [
        ("frame arrived", 2, None),
        ("output ready", 1, None),
        ("processing started", 2, None),
        ("forecaster updated", 1, None),
        ("query answered", 2, 1),
    ]


def test_queries_come_sigma_later_and_between_ticks_count_down():
    log = lae_sim.event_log(run([50, 50]), sigma=Fraction(1, 3))
    queries = [event for event in log if event.kind == "query answered"]
    assert [event.tick for event in queries] == [333_333_333, 1_333_333_333]


def test_outputs_of_one_tick_stand_in_the_order_of_their_making():
    boxes = np.zeros((3, 4))
    recording = lae_sim.Recording.new("sequence", boxes, boxes, np.array([250_000_000, 0, 0]))
    queued = lae_sim.replay_sequence(recording, CLOCK, policy=fifo)
    log = lae_sim.event_log(queued)
    assert [event[1:3] for event in log if event.tick == 250 * MS] == [
        ("output ready", 0),
        ("processing started", 1),
        ("output ready", 1),
        ("processing started", 2),
        ("output ready", 2),
    ]
