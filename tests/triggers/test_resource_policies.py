"""Policies of resources and of composition: never more than allowed, nothing left over, one phase after the other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.triggers import (
    Budget,
    During,
    DutyCycle,
    Hysteresis,
    MaxInterval,
    MinInterval,
    Periodic,
    Phases,
    Poisson,
    Scheduled,
    SendOnDelta,
    TokenBucket,
    Trigger,
    trigger,
)
from tests.triggers.walking import walk

few = settings(max_examples=20)
NEVER = Scheduled([1e9])


@trigger
def greedy(ctx):
    """Sample whenever asked."""
    return True


@few
@given(st.floats(0.5, 20), st.floats(1, 6), st.sampled_from([greedy, Poisson(40.0), SendOnDelta(0.05)]))
def test_a_token_bucket_admits_no_more_than_burst_and_rate(rate, burst, policy):
    """Any stretch of s seconds holds at most burst + rate s samples."""
    times = walk(policy & TokenBucket(rate, burst), 3.0, np.sin)
    for i in range(times.size):
        counts = np.arange(1, times.size - i + 1)
        assert (counts <= burst + rate * (times[i:] - times[i]) + 1e-6).all()


def test_a_token_bucket_that_starts_full_admits_its_burst_first():
    """Three samples in a row, then one whenever a token has grown."""
    times = walk(greedy & TokenBucket(2.0, 3.0), 2.0)
    np.testing.assert_allclose(times[:3], [0.0, 0.01, 0.02])
    np.testing.assert_allclose(times[3:], [0.5, 1.0, 1.5, 2.0], atol=0.011)


@few
@given(st.floats(0.2, 2.0), st.floats(0.1, 1.0), st.floats(0.0, 1.0))
def test_a_duty_cycle_admits_samples_in_its_open_time_only(period, share, start):
    """(t - start) mod period < on for every sample, and every monitoring time that is open has one."""
    on = share * period
    grid = 0.01 * np.arange(301)
    phase = (grid - start + 1e-9) % period
    opened = (grid >= start - 1e-9) & ((phase < on) | (share == 1.0))
    np.testing.assert_allclose(walk(greedy & DutyCycle(period, on, start), 3.0), grid[opened])


def test_a_duty_cycle_opens_on_time_after_many_periods():
    """Rounding in t mod period does not close the gate at its own beginning."""
    for k in range(200):
        assert walk(greedy & DutyCycle(0.1, 0.05), 0.1 * k, start=0.1 * k).size == 1


@few
@given(
    st.integers(1, 40),
    st.floats(1.0, 4.0),
    st.sampled_from([NEVER, greedy, SendOnDelta(0.1), Poisson(30.0), Periodic(0.07)]),
    st.floats(0.0, 1.0),
)
def test_a_budget_is_used_up_and_never_exceeded(samples, freedom, policy, start):
    """Exactly `samples` samples by `until`, whether the policy always asks or never."""
    times = walk(Budget(policy, samples, 4.0, start=start, freedom=freedom), 6.0, np.sin)
    assert times.size == samples
    assert start - 1e-9 <= times[0] and times[-1] <= 4.0 + 1e-9


@few
@given(st.integers(2, 40), st.floats(1.0, 4.0), st.sampled_from([NEVER, greedy, Poisson(30.0)]))
def test_gaps_of_a_budget_stay_within_its_freedom(samples, freedom, policy):
    """Every gap is between g / freedom and g freedom, with g the even gap of what is left, and within longest_wait."""
    budget = Budget(policy, samples, 4.0, freedom=freedom)
    times = walk(budget, 4.0)
    for k in range(1, samples):
        even = (4.0 - times[k - 1]) / (samples - k)
        assert even / freedom - 2e-8 <= times[k] - times[k - 1] <= even * freedom + 2e-8
    assert np.diff(times, prepend=0.0).max() <= budget.longest_wait + 1e-6


def test_a_budget_without_freedom_is_even_and_with_all_freedom_a_cap():
    """freedom = 1 spaces the samples evenly; with inf they go as fast as the policy asks."""
    np.testing.assert_allclose(walk(Budget(NEVER, 4, 4.0, freedom=1.0), 4.0), [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(walk(Budget(greedy, 5, 4.0, freedom=np.inf), 4.0), 0.01 * np.arange(5), atol=1e-6)
    assert walk(Budget(NEVER, 5, 4.0, freedom=np.inf), 4.0).size == 0
    assert Budget(greedy, 5, 4.0, freedom=np.inf).longest_wait == np.inf


def test_a_gate_admits_its_span_only():
    """From start, included, to stop, excluded."""
    np.testing.assert_allclose(walk(greedy & During(0.5, 0.6), 2.0, step=0.05), [0.5, 0.55])
    with pytest.raises(InputError, match="start must lie before stop"):
        During(1.0, 1.0)


def test_phases_hand_over_from_policy_to_policy():
    """Each policy has its say in its own phase; the next begins with what is due then."""
    policy = Phases((1.0, Periodic(0.25)), (2.0, NEVER), Periodic(0.4))
    np.testing.assert_allclose(walk(policy, 3.5), [0.0, 0.25, 0.5, 0.75, 2.0, 2.4, 2.8, 3.2])


@few
@given(st.lists(st.tuples(st.floats(0.1, 1.0), st.floats(0.05, 1.5)), min_size=1, max_size=4), st.floats(0.05, 1.5))
def test_phases_wait_no_longer_than_the_longest_of_their_policies(phases, last):
    """The longest wait of the phases holds across their borders, and is the largest of the policies'."""
    ends = np.cumsum([length for length, _ in phases])
    pairs = [(end, MaxInterval(wait)) for end, (_, wait) in zip(ends, phases, strict=True)]
    policy = Phases(*pairs, MaxInterval(last))
    assert policy.longest_wait == max(last, *(wait for _, wait in phases))
    times = walk(policy, 6.0)
    assert np.diff(times, prepend=0.0).max() <= policy.longest_wait + 0.01 + 1e-6


def test_phases_that_cannot_be_are_refused():
    """Times increase, pairs are pairs, and the last policy stands alone."""
    backward = ((2.0, greedy), (1.0, greedy), greedy)
    for phases in ((), ((1.0, greedy),), (greedy, greedy), backward, ((1.0, 2.0), greedy)):
        with pytest.raises(InputError, match="Phases"):
            Phases(*phases)


def test_hysteresis_samples_once_while_its_level_hovers():
    """A level that stays about zero makes one sample; one that falls low enough in between makes another."""

    class Above(Trigger):
        def guard(self, ctx):
            return ctx.y[0] - 1.0

    hovering = lambda t: 1.0 + 0.05 * np.sin(40 * t)  # noqa: E731
    assert walk(Above(), 2.0, hovering).size > 20
    assert walk(Hysteresis(Above(), 0.1), 2.0, hovering).size == 1
    deep = lambda t: 1.0 + 0.5 * np.sin(2 * np.pi * t)  # noqa: E731
    times = walk(Hysteresis(Above(), 0.1), 3.0, deep)
    np.testing.assert_allclose(np.round(times), [0.0, 1.0, 2.0])


def test_hysteresis_does_not_hold_back_a_level_that_its_own_sample_lowers():
    """Send-on-delta falls to -delta with every sample: with a release of less, nothing changes."""
    fast = lambda t: 20.0 * t  # noqa: E731
    np.testing.assert_array_equal(
        walk(Hysteresis(SendOnDelta(0.15), 0.1), 1.0, fast), walk(SendOnDelta(0.15), 1.0, fast)
    )


def test_hysteresis_takes_one_guard():
    """Times and joined policies have no level of their own to fall."""
    for policy in (Periodic(1.0), SendOnDelta(1.0) | MinInterval(0.1), greedy):
        with pytest.raises(InputError, match="one policy with a guard"):
            Hysteresis(policy, 0.1)


@given(st.one_of(st.floats(max_value=0.0), st.just(np.nan), st.text(max_size=3)))
def test_nonsense_numbers_are_refused(value):
    """Zero, negative, NaN and text."""
    for make in (
        lambda v: TokenBucket(v, 2.0),
        lambda v: TokenBucket(1.0, v),
        lambda v: DutyCycle(v, 0.1),
        lambda v: DutyCycle(1.0, v),
        lambda v: Budget(greedy, v, 1.0),
        lambda v: Budget(greedy, 5, 1.0, freedom=v),
    ):
        with pytest.raises(InputError):
            make(value)
