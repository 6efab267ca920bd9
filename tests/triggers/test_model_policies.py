"""Policies that look at predictions: innovation, its energy, covariance, excitation."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.errors import InputError, TriggerError
from ctmhe.triggers import (
    CovarianceBound,
    CovarianceSelfTriggered,
    Excitation,
    InnovationEnergy,
    MaxInterval,
    Stochastic,
    Watch,
)
from tests.triggers.walking import Foreseen, Solved, at, context, level, walk


def after(policy, t0=0.0, cost=2.0, error=0.0):
    """Return a watch, its state right after a sample at `t0`, and the context there; the prediction is zero."""
    watch = Watch(policy)
    ctx = context(t=t0, y=[error], y_hat=[0.0], samples=1, estimate=Solved(t0, cost))
    return watch, watch.sampled(watch.start(at(ctx, samples=0)), ctx, ctx), ctx


@given(st.floats(0.1, 3.0), st.floats(0.05, 1.0), st.floats(0.1, 10.0), st.floats(0.0, 1.0), st.floats(0.0, 5.0))
def test_innovation_energy_of_a_constant_error_is_its_discounted_integral(error, eta, R, alpha, cost):
    """E(t) = R e^2 (1 - eta^s) / -ln eta, s seconds after the sample; the threshold is alpha J + floor."""
    watch, state, ctx = after(InnovationEnergy(alpha, eta, R, floor=0.3), cost=cost, error=error)
    for t in 0.01 * np.arange(1, 101):
        state = watch.monitored(watch.ask(state, at(ctx, t=t)), at(ctx, t=t))
    rate = -np.log(eta)
    energy = R * error**2 * (-np.expm1(-rate * 1.005) / rate if rate else 1.005)
    found = watch.level(state, at(ctx, t=1.005))  # between two monitoring times
    assert found + alpha * cost + 0.3 == pytest.approx(energy, rel=2e-4)  # h^2 / 12 (ln eta)^2, at most 7.5e-5


def test_innovation_energy_begins_anew_with_every_sample():
    """The first sample comes at once; a new estimate takes away what was counted, and sets the threshold."""
    policy = InnovationEnergy(0.5, 1.0)
    assert level(policy, context(t=0.0, samples=0, y_hat=[0.0])) == np.inf
    watch, state, ctx = after(policy, cost=2.0, error=3.0)
    late = at(ctx, t=1.0)
    assert watch.level(state, late) == pytest.approx(9.0 - 1.0)
    again = at(late, estimate=Solved(1.0, 4.0), y=[0.0], samples=2)
    state = watch.sampled(state, late, again)
    assert watch.level(state, at(again, t=2.0)) == -2.0
    assert watch.level(state, at(again, t=2.0, estimate=Solved(1.0, np.nan))) == 0.0  # no cost: the floor counts


def test_stochastic_sampling_has_the_probability_of_its_formula():
    """Of 2000 questions, a share of 1 - exp(-Y e^2 / 2) is answered by yes, within four standard deviations."""
    policy, n = Stochastic(Y=2.0), 2000
    for error in (0.0, 0.3, 1.0):
        ctx = context(y=[error], y_hat=[0.0], seed=3)
        share = sum(policy.fires(at(ctx, state=k)) for k in range(n)) / n
        p = 1 - np.exp(-(error**2))
        assert abs(share - p) <= 4 * np.sqrt(p * (1 - p) / n)


def test_stochastic_lots_are_counted_so_that_runs_repeat():
    """The same seed gives the same samples; the seeds of run and policy give others."""
    signal = np.sin
    first = walk(Stochastic(50.0), 3.0, signal)
    np.testing.assert_array_equal(first, walk(Stochastic(50.0), 3.0, signal))
    assert not np.array_equal(first, walk(Stochastic(50.0, seed=1), 3.0, signal))
    assert not np.array_equal(first, walk(Stochastic(50.0), 3.0, signal, seed=1))


@given(st.floats(-2, 2), st.floats(-2, 2), st.lists(st.floats(-2, 2), min_size=9, max_size=9), st.floats(0.1, 5))
def test_covariance_bound_measures_the_deviation_of_the_combination(a, b, entries, bound):
    """The guard is sqrt(c' P c) - bound over states and estimated parameters, whatever the order of the names."""
    root = np.array(entries).reshape(3, 3)
    P = root @ root.T
    outlook = Foreseen(np.zeros(1), lambda t: P)
    ctx = context(forecast=outlook, states=("x1", "x2"), parameters=("k",), state=0)
    c = np.array([0.0, b, a])
    if a or b:
        expected = np.sqrt(max(c @ P @ c, 0.0)) - bound
        assert CovarianceBound(bound, {"k": a, "x2": b}).guard(ctx) == pytest.approx(expected, abs=1e-7)
    assert CovarianceBound(bound, "x2").guard(ctx) == pytest.approx(np.sqrt(P[1, 1]) - bound, abs=1e-7)
    assert CovarianceBound(bound).guard(ctx) == pytest.approx(np.sqrt(P.diagonal().max()) - bound, abs=1e-7)


def growing(t, last):
    """Return a variance that starts at 0.01 after a sample and grows linearly; 1 before the first."""
    return 0.01 + 0.5 * (t - last)


def test_self_triggered_covariance_names_the_time_at_which_the_bound_is_met():
    """Times solve P(t) = bound^2, to 1e-9 s; `longest` comes first where it is shorter."""
    times = walk(CovarianceSelfTriggered(0.5, "x", longest=10.0), 3.0, spread=growing)
    np.testing.assert_allclose(np.diff(times, prepend=0.0), (0.25 - 0.01) / 0.5, atol=1e-9)
    times = walk(CovarianceSelfTriggered(0.5, "x", longest=0.25), 3.0, spread=growing)
    np.testing.assert_allclose(np.diff(times), 0.25, atol=1e-9)


def test_self_triggered_covariance_does_what_the_bound_does():
    """The guard asked on a grid samples within one step after the times that were computed ahead."""
    bound = walk(CovarianceBound(0.5, "x") | MaxInterval(2.0), 0.485, spread=growing, step=1e-4)
    ahead = walk(CovarianceSelfTriggered(0.5, "x", longest=2.0), 0.485, spread=growing)
    assert 0 <= bound[0] - ahead[0] <= 1e-4


@given(st.floats(1e-3, 10), st.floats(1.5, 1e6), st.floats(0, 1e3))
def test_the_search_ahead_is_bounded(shortest, share, rate):
    """Whatever the growth, at most log2(longest / shortest) and some 60 propagations are computed."""
    asked = []
    outlook = Foreseen(np.zeros(1), lambda t: asked.append(t) or [[rate * (t - 1.0)]])
    ctx = context(t=1.0, forecast=outlook, states=("x",), state=0)
    due = CovarianceSelfTriggered(1.0, longest=share * shortest, shortest=shortest).next_time(ctx)
    assert shortest - 1e-9 <= due - 1.0 <= share * shortest * (1 + 1e-9)
    assert len(asked) <= 2 * np.log2(share) + 70


def unknown_at_first(samples):
    """Return a covariance that is infinite until so many samples were taken."""
    seen = []

    def spread(t, last):
        if last not in seen:
            seen.append(last)
        return np.inf if len(seen) <= samples else growing(t, last)

    return spread


@pytest.mark.parametrize("policy", [CovarianceBound(0.5), CovarianceSelfTriggered(0.5, longest=1.0, shortest=0.01)])
def test_an_infinite_variance_asks_for_samples_until_it_is_finite(policy):
    """One sample a monitoring step (or shortest wait) at first, then as the growth says."""
    times = walk(policy, 1.0, spread=unknown_at_first(5))
    np.testing.assert_allclose(np.diff(times[:5]), 0.01, atol=1e-6)
    np.testing.assert_allclose(np.diff(times[6:]), 0.48, atol=0.011)


@pytest.mark.parametrize("policy", [CovarianceBound(0.5), CovarianceSelfTriggered(0.5, longest=1.0)])
def test_a_variance_that_no_sample_makes_finite_is_an_error_not_a_run_away(policy):
    """The policy stops after 50 samples in a row and says what to change."""
    with pytest.raises(TriggerError, match=r"Covariance.*still infinite after 50 samples.*another combination"):
        walk(policy, 2.0, spread=lambda t, last: np.inf)


def test_unknown_states_of_a_combination_are_named():
    """The error names the policy, the state and what there is."""
    ctx = context(forecast=Foreseen(np.zeros(1)), states=("pA",), state=0)
    with pytest.raises(TriggerError, match=r"CovarianceBound.*'pB'.*Known: pA"):
        level(CovarianceBound(1.0, "pB"), ctx)


@dataclass(frozen=True)
class Slope:
    """A measure: how much the output has moved a second, where a rate constant shows."""

    def __call__(self, ctx):
        return float(abs(ctx.y[0] - ctx.y_last[0]) / ctx.elapsed) if ctx.samples and ctx.elapsed else 0.0


def test_excitation_samples_while_the_measure_is_above_its_level():
    """The guard is measure - level, for any function of the context."""
    ctx = context(y=[3.0], y_last=[1.0], elapsed=0.5)
    assert Excitation(Slope(), 1.5).guard(ctx) == 2.5
    bend = lambda t: np.minimum(t, 1.0)  # noqa: E731
    times = walk(Excitation(Slope(), 0.5) | MaxInterval(0.1), 3.0, bend)
    np.testing.assert_allclose(np.diff(times[times < 1.0]), 0.01)  # at every monitoring time while it moves
    np.testing.assert_allclose(np.diff(times[times > 1.05]), 0.1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: InnovationEnergy(-0.1, 0.5),
        lambda: InnovationEnergy(0.1, 1.5),
        lambda: InnovationEnergy(0.1, 0.5, R=[[1.0, 2.0], [2.0, 1.0]]),
        lambda: Stochastic(Y=-1.0),
        lambda: Stochastic(Y="much"),
        lambda: CovarianceBound(0.0),
        lambda: CovarianceBound(1.0, {"x": 0.0}),
        lambda: CovarianceBound(1.0, ["x"]),
        lambda: CovarianceSelfTriggered(1.0, longest=0.1, shortest=0.2),
        lambda: Excitation("measure", 1.0),
        lambda: Excitation(Slope(), np.nan),
    ],
)
def test_wrong_settings_are_refused(make):
    """Before any run."""
    with pytest.raises(InputError):
        make()
