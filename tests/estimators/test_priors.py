"""Priors: what they are at equal steps, what they remember, and the window without end."""

from itertools import pairwise

import numpy as np
import pytest

from ctmhe import MHE, RK4, DiscountedCost, DiscreteModel, Input, InputError, Measurement
from ctmhe.estimators.priors.base import Anchor
from ctmhe.models.library import batch_reactor
from ctmhe.transcription.grid import same_time

COST = DiscountedCost(P=[[8.0, 7.5], [7.5, 7.1]], Q=2e3, R=1e2, eta=0.5)
STEPS = 12


def reactor(prior, horizon=1.0, **more) -> MHE:
    options = {"interval": 0.1, "integrator": RK4(0.05), "compile": "off", "cost": COST, "hold": "point"}
    return MHE(batch_reactor(noise=False), horizon=horizon, prior=prior, **options | more)


def linear(prior, horizon, **more) -> MHE:
    """A slow oscillator in discrete time, solved at every step."""
    model = DiscreteModel(
        lambda t, x, u, w, p: [0.99 * x[0] + 0.1 * x[1] + w[0], -0.1 * x[0] + 0.97 * x[1] + u[0] + w[1]],
        lambda t, x, u, w, p: [x[0]],
        step=1.0, x=("a", "b"), u=("f",), w=("v", "w"), y=("one",),
    )  # fmt: skip
    return MHE(model, horizon=horizon, prior=prior, cost=DiscountedCost(P=1.0, Q=4.0, R=9.0, eta=0.95), **more)


def run(mhe: MHE, rng, steps: int = STEPS):
    """Every step an input, a measurement and a solve: the states and estimates."""
    state, kept = mhe.init(x=[1.0, 0.0]), []
    for k in range(steps + 1):
        state = mhe.control(state, Input(float(k), [0.1 * rng.normal()]))
        state = mhe.observe(state, Measurement(float(k), [np.cos(0.1 * k) + 0.1 * rng.normal()]))
        state, estimate = mhe.estimate(state, float(k))
        kept.append((state, estimate))
    return kept


def test_the_smoothing_prior_is_the_second_node_of_the_last_solution(rng):
    """With a solve at every step, (6.65): the solution of one step ago at its second node."""
    kept = run(linear("smoothing", 4.0), rng)
    for (_, last), (_, now) in pairwise(kept[4:]):
        np.testing.assert_array_equal(now._solved.part("prior"), last.trajectory.x[1])


def test_the_turnpike_prior_is_the_middle_of_an_earlier_solution(rng):
    """With a solve at every step, (6.66): the solution of N / 2 steps ago at its middle, once its window is full."""
    kept = run(linear("turnpike", 4.0), rng)
    for (_, earlier), (_, now) in zip(kept[4:], kept[6:], strict=False):
        np.testing.assert_array_equal(now._solved.part("prior"), earlier.trajectory.x[2])


@pytest.mark.parametrize("prior", ["smoothing", "turnpike"])
def test_irregular_solves_take_the_solution_that_the_rule_names(prior, rng):
    """Smoothing: the last solution at the window's start; turnpike: the first one half a horizon later, or more."""
    mhe, t, solutions = reactor(prior), 0.0, []
    state = mhe.init(x=[2.5, 1.4])
    for _ in range(40):
        t += rng.exponential(0.06) + 1e-3
        state = mhe.observe(state, Measurement(t, [4.0 - 0.35 * min(t, 3.0) + 0.03 * rng.normal()]))
        state, estimate = mhe.estimate(state, t)
        start = t - 1.0
        if start > 0:
            used = solutions[-1] if prior == "smoothing" else next(s for s in solutions if s.t[-1] >= start + 0.5)
            node = np.searchsorted(used.t, start, side="right") - 1
            u = np.empty(0)
            x = used.x[node]
            if start > used.t[node]:
                x, _ = mhe.stage.step(used.t[node], start - used.t[node], x, used.w[node], used.p, u, u)
            np.testing.assert_allclose(estimate._solved.part("prior"), x, rtol=1e-9)
        solutions.append(estimate.trajectory)


@pytest.mark.parametrize("prior", ["filtering", "smoothing", "turnpike"])
def test_a_repeated_solve_replaces_its_own_piece(prior, rng):
    """Solving twice at every instant leaves the memory as solving once."""
    once, twice = linear(prior, 4.0), linear(prior, 4.0)
    a, b = once.init(x=[1.0, 0.0]), twice.init(x=[1.0, 0.0])
    for k in range(STEPS):
        sample, value = Measurement(float(k), [rng.normal()]), Input(float(k), [0.0])
        a, b = (mhe.observe(mhe.control(state, value), sample) for mhe, state in ((once, a), (twice, b)))
        a, one = once.estimate(a, float(k))
        b, _ = twice.estimate(b, float(k))
        b, two = twice.estimate(b, float(k))
        np.testing.assert_allclose(one.x, two.x, atol=1e-8)
        for name, log in a.memory.items():
            for mine, other in zip(log.arrays(), b.memory[name].arrays(), strict=True):
                np.testing.assert_allclose(mine, other, atol=1e-8)


def test_what_a_prior_remembers_is_bounded_and_saved(rng, tmp_path):
    """The turnpike's memory holds no more than half a horizon of slots; save, load, continue equals never stopping."""
    mhe = linear("turnpike", 6.0)
    kept = run(mhe, rng, 30)
    state = kept[-1][0]
    assert len(state.memory["turnpike"]) <= 4
    mhe.save(state, tmp_path / "state.npz")
    again = mhe.load(tmp_path / "state.npz")
    for _ in range(2):
        t = state.t + 1.0
        sample = Measurement(t, [rng.normal()])
        (state, one), (again, two) = (mhe.estimate(mhe.observe(s, sample), t) for s in (state, again))
        np.testing.assert_array_equal(one.x, two.x)


def test_a_gap_longer_than_the_horizon_predicts_whatever_the_prior():
    """No solution reaches back to the window's start: the prior is the prediction, and the status says so."""
    for prior in ("filtering", "smoothing", "turnpike"):
        mhe = reactor(prior)
        before, _ = mhe.estimate(mhe.observe(mhe.init(x=[2.5, 1.4]), Measurement(0.1, [3.9])), 0.1)
        _, estimate = mhe.estimate(mhe.observe(before, Measurement(1.5, [3.5])), 1.5)
        assert "prior predicted, uncertified" in estimate.status.notes
        expected = mhe.propagate(before, 0.1, 0.5, before.x, before.p)
        np.testing.assert_allclose(estimate._solved.part("prior"), expected, rtol=1e-12)


def test_full_information_is_a_window_without_end(rng):
    """An infinite horizon gives what a horizon longer than the run gives, and keeps all data."""
    endless, long = (
        run(linear("filtering", np.inf), np.random.default_rng(5)),
        run(linear("filtering", 100.0), np.random.default_rng(5)),
    )
    for (_, one), (_, two) in zip(endless, long, strict=True):
        np.testing.assert_allclose(one.x, two.x, atol=1e-9)
        assert len(two.trajectory.t) == len(one.trajectory.t)
    assert len(endless[-1][0].measurements) == STEPS + 1


class Known:
    """A prior that knows better: value and weight given."""

    reach = 0.5

    def begin(self, mhe, state):
        return {}

    def at(self, mhe, state, start, growing):
        return Anchor(np.array([2.0, 1.0]), ("as told",), weight=np.diag([1e8, 1e8]))

    def after(self, mhe, state, solved):
        return state.memory


def test_a_prior_of_ones_own_sets_value_weight_and_reach(rng):
    """A strong prior fixes the window's start; its note is in the status; data are kept for its reach longer."""
    mhe = reactor(Known(), horizon=0.5)
    state = mhe.init(x=[2.5, 1.4])
    for k in range(1, 21):
        state = mhe.observe(state, Measurement(0.1 * k, [3.0]))
        state, estimate = mhe.estimate(state, 0.1 * k)
    np.testing.assert_allclose(estimate.trajectory.x[0], [2.0, 1.0], atol=1e-4)
    assert estimate.status.notes == ("as told",)
    first = state.measurements.arrays()[0][0]
    assert first == pytest.approx(1.0, abs=same_time(0.1, 1.0))


@pytest.mark.parametrize("given", ["newest", 3, Known])
def test_what_is_no_prior_is_refused(given):
    """The message names the three rules and the protocol."""
    with pytest.raises(InputError, match=r"'filtering', 'smoothing', 'turnpike'.*begin, at and after"):
        reactor(given)
