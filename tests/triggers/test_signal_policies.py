"""Policies that look at the outputs sent: deltas, areas, deadbands, slopes and levels."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.triggers import Deadband, LevelCrossing, MinInterval, SendOnArea, SendOnDelta, SendOnSlope, Watch
from tests.triggers.walking import at, context, walk

STEP = 0.01
few = settings(max_examples=20)
coefficients = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 6))


def wave(amplitudes):
    """Return a smooth signal with a slope of at most 7."""
    a, b, omega = amplitudes
    return lambda t: a * np.sin(omega * t) + b * t


def sent_before(times, t):
    """Return the last sampling time not after each of `t`."""
    return times[np.searchsorted(times, t + 1e-12, side="right") - 1]


@few
@given(coefficients, st.floats(0.05, 1.0))
def test_after_send_on_delta_the_held_value_is_never_further_off_than_delta(amplitudes, delta):
    """|y - y_last| <= delta between samples, up to what one monitoring step adds."""
    signal = wave(amplitudes)
    times = walk(SendOnDelta(delta), 3.0, signal, step=STEP)
    t = np.arange(0, 3.0, STEP)
    assert np.abs(signal(t) - signal(sent_before(times, t))).max() < delta + 1e-12


@few
@given(coefficients, st.floats(0.01, 0.5))
def test_between_samples_of_send_on_area_the_deviation_integrates_to_the_area(amplitudes, area):
    """The integral of |y - y_last| reaches `area` at each sample, within one monitoring step's growth."""
    signal = wave(amplitudes)
    times = walk(SendOnArea(area), 3.0, signal, step=STEP)
    for a, b in pairwise(times):
        t = np.linspace(a, b, 2001)
        reached = np.trapezoid(np.abs(signal(t) - signal(a)), t)
        growth = (np.abs(signal(b) - signal(a)) + 7 * STEP) * STEP  # the slope is at most 7
        assert area - 1e-3 * area - 1e-5 <= reached <= area + growth + 1e-3 * area + 1e-5


def test_send_on_area_knows_the_moment_between_monitoring_times():
    """A deviation of 2 reaches the area of 0.1 after 0.05 s: the guard is zero there, asked from the memory before."""
    policy = SendOnArea(0.1)
    watch = Watch(policy)
    state = watch.sampled(watch.start(context(t=0.0)), context(t=0.0), context(t=0.0))
    state = watch.monitored(state, at(context(y=[2.0]), t=0.0))  # a jump right after the sample
    for t in (0.049, 0.05, 0.051):
        assert watch.level(state, at(context(y=[2.0]), t=t)) == pytest.approx(2 * t - 0.1, abs=1e-12)


def test_send_on_area_sends_an_offset_that_send_on_delta_never_does():
    """A small deviation that stays is a large area in the end."""
    signal = lambda t: 0.05 * (t > 0.005)  # noqa: E731
    assert walk(SendOnDelta(0.1), 10.0, signal).size == 1
    assert walk(SendOnArea(0.1), 10.0, signal).size == 2


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(0, 1), st.floats(1e-3, 1))
def test_deadband_is_a_share_of_the_value_sent_but_not_below_its_floor(y, y_last, relative, floor):
    """The guard is |y - y_last| - max(floor, relative |y_last|)."""
    expected = abs(y - y_last) - max(floor, relative * abs(y_last))
    assert Deadband(relative, floor).guard(context(y=[y], y_last=[y_last])) == pytest.approx(expected, abs=1e-12)


def test_deadband_without_share_is_send_on_delta():
    """relative = 0 leaves the floor."""
    np.testing.assert_array_equal(
        walk(Deadband(0.0, 0.1), 3.0, np.sin, step=STEP), walk(SendOnDelta(0.1), 3.0, np.sin, step=STEP)
    )


@few
@given(coefficients, st.floats(0.05, 0.5))
def test_after_send_on_slope_the_line_is_never_further_off_than_delta(amplitudes, delta):
    """|y - line through the last two values sent| < delta at monitoring times without a sample."""
    signal = wave(amplitudes)
    times = walk(SendOnSlope(delta), 3.0, signal, step=STEP)
    for t in np.arange(0, 3.0, STEP):
        sent = times[times <= t + 1e-12]
        slope = (signal(sent[-1]) - signal(sent[-2])) / (sent[-1] - sent[-2]) if sent.size > 1 else 0.0
        assert abs(signal(t) - signal(sent[-1]) - slope * (t - sent[-1])) < delta + 1e-9


def test_send_on_slope_needs_two_samples_for_a_straight_line():
    """After two values the receiver knows a ramp for good, where send-on-delta sends on."""
    ramp = lambda t: 2.0 * t  # noqa: E731
    assert walk(SendOnSlope(0.1), 10.0, ramp).size == 2
    assert walk(SendOnDelta(0.1), 10.0, ramp).size > 100


@few
@given(coefficients, st.lists(st.floats(-1, 1), min_size=1, max_size=4, unique=True))
def test_every_level_crossed_between_monitoring_times_is_sampled_once(amplitudes, levels):
    """A sample is taken exactly at those monitoring times at which an output is on another side than at the last."""
    signal = wave(amplitudes)
    grid = STEP * np.arange(301)
    above = np.array([[signal(t) >= level for level in levels] for t in grid])
    expected = grid[1:][(above[1:] != above[:-1]).any(axis=1)]
    times = walk(LevelCrossing(levels), 3.0, signal, step=STEP)
    # where the signal touches a level to rounding, the side is a matter of taste
    if np.abs(np.subtract.outer(signal(grid[1:]), levels)).min() > 1e-8:
        np.testing.assert_allclose(times, expected)


def test_hysteresis_keeps_noise_from_crossing_for_the_signal():
    """A ripple smaller than half the hysteresis never crosses a level it sits on; a larger swing does both ways."""
    ripple = lambda t: 1.0 + 0.09 * np.sin(200 * t)  # noqa: E731
    assert walk(LevelCrossing(1.0), 2.0, ripple).size > 50
    assert walk(LevelCrossing(1.0, hysteresis=0.2), 2.0, ripple).size == 0
    swing = lambda t: 1.0 - np.cos(2 * np.pi * t)  # noqa: E731
    assert walk(LevelCrossing(1.0, hysteresis=0.2), 3.0, swing).size == 6


def test_a_level_crossed_by_the_width_of_a_rounding_error_is_crossed_once():
    """The located moment may lie a hair before the level: the side flips anyway, so that no second sample follows."""
    watch, before = Watch(LevelCrossing(1.0)), context(t=0.0, y=[0.5])
    state = watch.monitored(watch.start(before), before)
    hit = context(t=0.5, y=[1.0 - 1e-13])
    state = watch.ask(watch.sampled(state, hit, hit), context(t=0.6, y=[1.2]))
    assert watch.level(state, context(t=0.6, y=[1.2])) < 0
    assert watch.level(state, context(t=0.7, y=[0.8])) > 0


def test_a_crossing_held_back_by_a_dead_time_is_sent_when_it_may():
    """The side flips with the sample, not with the crossing."""
    step = lambda t: 1.0 * (t > 0.105) + 1.0 * (t > 0.145)  # noqa: E731
    times = walk(LevelCrossing([0.5, 1.5]) & MinInterval(0.1), 1.0, step)
    np.testing.assert_allclose(times, [0.11, 0.21])


@pytest.mark.parametrize(
    "policy",
    [SendOnArea(0.5), SendOnSlope(0.5), Deadband(0.1, 0.5), LevelCrossing(0.5), SendOnDelta(0.5)],
    ids=lambda policy: type(policy).__name__,
)
def test_silent_sensors_are_passed_over_and_do_not_spoil_the_memory(policy):
    """An output without a value never asks for a sample, and is judged again when it speaks."""
    watch, ctx = Watch(policy), context(t=0.0, y=[0.0, 0.0])
    state = watch.sampled(watch.monitored(watch.start(ctx), ctx), ctx, at(ctx, samples=2))
    for t in (0.1, 0.2):
        mute = at(ctx, t=t, y=[np.nan, 0.0], samples=2)
        state = watch.monitored(watch.ask(state, mute), mute)
        assert watch.level(state, mute) < 0
    state = watch.sampled(state, mute, mute)
    loud = at(ctx, t=5.0, y=[5.0, 0.0], samples=3)
    state = watch.monitored(watch.ask(state, at(loud, t=0.3)), at(loud, t=0.3))
    assert watch.level(state, loud) > 0
    assert watch.level(state, at(loud, y=[np.nan, np.nan])) == -np.inf


@pytest.mark.parametrize("make", [SendOnArea, SendOnSlope, SendOnDelta])
def test_thresholds_name_their_outputs(make):
    """A mapping watches the outputs it names, others may do as they like."""
    watch, ctx = Watch(make({"b": 1.0})), context(t=0.0, y=[0.0, 0.0], y_last=[0.0, 0.0])
    state = watch.sampled(watch.start(ctx), ctx, ctx)
    for t, y in ((1.0, [99.0, 0.0]), (2.0, [99.0, 0.0])):
        state = watch.monitored(watch.ask(state, at(ctx, t=t, y=y)), at(ctx, t=t, y=y))
    assert watch.level(state, at(ctx, t=3.0, y=[99.0, 0.0])) < 0
    assert watch.level(state, at(ctx, t=3.0, y=[0.0, 9.0])) > 0


@given(st.floats(max_value=-1e-300))
def test_negative_thresholds_are_refused(value):
    """Whatever the size."""
    for make in (SendOnArea, SendOnSlope, SendOnDelta, lambda v: Deadband(v, 1.0), lambda v: Deadband(0.1, v)):
        with pytest.raises(InputError):
            make(value)
