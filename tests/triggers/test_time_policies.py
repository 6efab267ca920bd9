"""Policies of time alone: the instants they name, from any moment on, and the lots they draw."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.triggers import GeometricGaps, Jittered, LinearGaps, Periodic, Poisson
from tests.triggers.walking import context, walk

seconds = st.floats(1e-3, 10.0)


def named(policy, count, t=0.0, seed=0):
    """Return the first `count` times that a policy names, each asked right after the one before."""
    times = []
    for samples in range(count):
        t = policy.next_time(context(t=t, samples=samples, seed=seed))
        times.append(t)
    return np.array(times)


def test_linear_gaps_reproduce_the_schedule_of_the_thesis():
    """Fig. 3.2: 50 gaps from 0.01 to 0.19 s end at 5 s exactly; then they stay 0.19 s."""
    policy = LinearGaps(0.01, 0.19, 50)
    times = named(policy, 53)
    np.testing.assert_allclose(times[:50], np.cumsum(np.linspace(0.01, 0.19, 50)), rtol=1e-13)
    assert times[49] == 5.0
    np.testing.assert_allclose(np.diff(times[49:]), 0.19, rtol=1e-12)
    assert policy.longest_wait == 0.19


@given(seconds, seconds, st.integers(2, 60), st.integers(1, 80))
def test_linear_gaps_sum_to_the_mean_gap_times_their_number(first, last, count, k):
    """Sum of an arithmetic series: k gaps make k times the mean of the first and the k-th."""
    gaps = np.append(np.linspace(first, last, count), np.full(80, last))
    assert LinearGaps(first, last, count).instant(k) == pytest.approx(gaps[:k].sum(), rel=1e-12)


@given(st.floats(1e-3, 1.0), st.floats(1.0, 3.0), st.one_of(st.just(np.inf), st.floats(1.0, 5.0)), st.integers(1, 60))
def test_geometric_gaps_grow_by_their_ratio_up_to_the_longest(first, ratio, longest, k):
    """The k-th gap is min(first ratio^(k-1), longest)."""
    gaps = np.minimum(first * ratio ** np.arange(k), longest)
    assert GeometricGaps(first, ratio, longest).instant(k) == pytest.approx(gaps.sum(), rel=1e-9)


SCHEDULES = {
    "linear": LinearGaps(0.3, 0.9, 7),
    "geometric": GeometricGaps(0.3, 1.5, 2.0),
    "jittered": Jittered(0.8, 0.8, seed=2),
}


@cache
def planned(kind, seed):
    """Return the first 200 instants of a schedule, more than 100 s of it."""
    return named(SCHEDULES[kind], 200, seed=seed)


@given(st.sampled_from(sorted(SCHEDULES)), st.floats(0, 100), st.integers(0, 3))
def test_absolute_schedules_are_the_same_from_any_moment_on(kind, t, seed):
    """What a policy names at t is the first of its instants after t, whoever sampled at t."""
    schedule = planned(kind, seed)
    expected = schedule[schedule > t + 3e-9][0]
    assert SCHEDULES[kind].next_time(context(t=t, seed=seed)) == expected


@given(seconds, st.floats(0, 1), st.integers(0, 2**31), st.integers(0, 2**31))
def test_jittered_samples_stay_within_the_jitter_of_their_period(period, share, seed, own):
    """Instant k lies within jitter / 2 of k period, gaps are at most period + jitter, and none comes before start."""
    policy = Jittered(period, share * period, seed=own)
    times = named(policy, 12, seed=seed)
    k = np.round(times / period)
    assert (np.abs(times - k * period) <= policy.jitter / 2 + 1e-12 * times[-1] + 2e-9).all()
    assert (np.diff(times) > 0).all()
    assert np.diff(times).max() <= policy.longest_wait + 2e-9
    assert times[0] >= 0


def test_jitter_of_zero_is_periodic_sampling():
    """The limit is the policy without jitter."""
    np.testing.assert_array_equal(named(Jittered(0.3, 0.0), 20), named(Periodic(0.3), 20))


def test_poisson_gaps_are_exponential():
    """Kolmogorov and Smirnov do not tell the gaps of 2000 samples from exponential ones."""
    from scipy.stats import kstest

    gaps = np.diff(named(Poisson(rate=4.0), 2000))
    assert kstest(gaps, "expon", args=(0, 0.25)).pvalue > 0.01
    assert abs(np.corrcoef(gaps[:-1], gaps[1:])[0, 1]) < 4 / np.sqrt(gaps.size)


@pytest.mark.parametrize("make", [lambda seed: Poisson(5.0, seed=seed), lambda seed: Jittered(0.2, 0.2, seed=seed)])
def test_lots_depend_on_the_seeds_only(make):
    """The same seeds give the same run; another seed of the run or of the policy gives another."""
    first = walk(make(0), 2.0)
    np.testing.assert_array_equal(first, walk(make(0), 2.0))
    assert not np.array_equal(first[:5], walk(make(1), 2.0)[:5])
    assert not np.array_equal(first[:5], walk(make(0), 2.0, seed=1)[:5])


def test_two_random_policies_in_one_run_draw_different_lots():
    """Joined by |, two Poisson processes of different seeds sample about as often as their rates' sum says."""
    times = walk(Poisson(20.0) | Poisson(30.0, seed=1), 40.0, step=1.0)
    assert times.size == pytest.approx(2000, abs=4 * np.sqrt(2000))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Jittered(1.0, 1.1), "must not exceed the period"),
        (lambda: Poisson(-1.0), "rate must be finite and positive"),
        (lambda: LinearGaps(0.1, 0.2, 1.5), "whole number"),
        (lambda: GeometricGaps(0.1, 0.9), "ratio must be >= 1"),
        (lambda: GeometricGaps(0.1, 1.1, 0.05), "longest must not be below"),
        (lambda: Poisson(1.0, seed=-1), "seed"),
    ],
)
def test_schedules_that_cannot_be_are_refused(make, message):
    """The error says what is wrong with the argument."""
    with pytest.raises(InputError, match=message):
        make()
