"""Stream time never falls, whatever a sender's clock does."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.sources.live_frames import StreamClock, Unwrapper

TICK = 1 / 90_000


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(-3000, 2**30), max_size=50))
def test_a_counter_goes_on_past_its_end(first, steps):
    unwrap = Unwrapper(32)
    true = first
    assert unwrap(first) == first
    for step in steps:
        true += step
        assert unwrap(true % 2**32) == true


def test_time_is_that_of_the_stream_not_of_arrival():
    clock = StreamClock(TICK)
    arrivals = [0.0, 0.31, 0.32, 0.33, 0.9]
    times = [clock.time_of(5000 + 3600 * i, 100 + at) for i, at in enumerate(arrivals)]
    assert times == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])


def test_after_a_new_start_time_goes_on_by_the_clock_on_the_wall():
    clock = StreamClock(TICK)
    clock.time_of(2**31, 10.0)
    assert clock.time_of(2**31 + 3600, 10.04) == pytest.approx(0.04)
    assert clock.time_of(17, 13.04) == pytest.approx(3.04)
    assert clock.time_of(17 + 3600, 13.5) == pytest.approx(3.08)


def test_a_pause_in_which_the_sender_counts_on_is_kept():
    clock = StreamClock(TICK)
    clock.time_of(0, 0.0)
    assert clock.time_of(90_000 * 60, 60.02) == pytest.approx(60.0)


def test_a_sender_without_a_clock_has_times_of_arrival():
    clock = StreamClock(TICK)
    assert [clock.time_of(None, at) for at in (5.0, 5.5, 7.0)] == pytest.approx([0.0, 0.5, 2.0])


def test_another_tick_after_a_new_connection():
    clock = StreamClock(TICK)
    clock.time_of(900_000, 0.0)
    clock.time_of(903_600, 0.04)
    clock.set_tick(1e-6)
    assert clock.time_of(7, 1.04) == pytest.approx(1.04)
    assert clock.time_of(40_007, 1.08) == pytest.approx(1.08)


@given(st.lists(st.tuples(st.integers(-(2**33), 2**33), st.floats(0, 10)), max_size=60))
def test_time_never_falls(steps):
    clock = StreamClock(TICK)
    ticks, arrival, last = 0, 0.0, 0.0
    for step, passed in steps:
        ticks, arrival = ticks + step, arrival + passed
        now = clock.time_of(ticks, arrival)
        assert now >= last
        # And it stays within what the buffers of a stream can hold of the time that passed.
        assert now - last <= passed + 5.0 + 1e-6
        last = now
