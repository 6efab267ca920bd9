"""Policies in closed loops: what they promise alone holds with a plant, an estimator and located events."""

import casadi as ca
import numpy as np
import pytest

from ctmhe.errors import TriggerError
from ctmhe.estimators import MHE
from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.library.batch_reactor import batch_reactor
from ctmhe.models.library.quadrotor import hover_speed, quadrotor
from ctmhe.simulation import SingleSample, Uniform, WholeSignal, simulate
from ctmhe.transcription.integrators import RK4
from ctmhe.triggers import (
    Budget,
    CovarianceBound,
    CovarianceSelfTriggered,
    InnovationEnergy,
    LevelCrossing,
    LinearGaps,
    MaxInterval,
    MinInterval,
    Periodic,
    Phases,
    SendOnArea,
    SendOnDelta,
    Stochastic,
    TokenBucket,
    Trigger,
)
from ctmhe.types import DiscountedCost

DECAY = ContinuousModel(
    lambda t, x, u, w, p: -x + w[0],
    lambda t, x, u, w, p: x + w[1],
    x="level",
    y="gauge",
    w=("d", "v"),
    units={"level": "m", "gauge": "m", "v": "m"},
    name="decay",
)
DECAYING = {"until": 2.0, "guess": [1.0], "truth": [1.0], "monitor": 0.01}
NOISE = {"v_pressure": Uniform(0.01, interval=0.01)}
DISTURBED = NOISE | {"w_pA": Uniform(0.05, interval=0.1), "w_pB": Uniform(0.05, interval=0.1)}


@pytest.fixture(scope="module")
def decay():
    cost = DiscountedCost(eta=0.5, P=1.0, Q=[10.0, 10.0], R=100.0)
    return MHE(DECAY, horizon=1.0, interval=0.1, integrator=RK4(step=0.05), cost=cost)


def reactor_mhe(hold="zero", **weights):
    model = batch_reactor(noise=False)
    cost = DiscountedCost(**({"eta": 0.9, "P": 10.0, "Q": 1e2} | weights))
    return MHE(model, horizon=2.0, interval=0.1, integrator=RK4(step=0.1), cost=cost, bounds=model.bounds, hold=hold)


def reactor(policy, mhe, *, until=2.0, seed=0, monitor=0.05):
    channel = SingleSample() if "point" in mhe.hold.values() else WholeSignal(every=0.05)
    return simulate(
        batch_reactor(),
        mhe,
        trigger=policy,
        until=until,
        guess=[2.5, 1.5],
        truth=[3.0, 1.0],
        channel=channel,
        disturbance=DISTURBED,
        monitor=monitor,
        seed=seed,
    )


@pytest.fixture(scope="module")
def sampled_reactor():
    return reactor_mhe("point", R_point=1e3)


@pytest.fixture(scope="module")
def whole_reactor():
    return reactor_mhe(R=1e2)


def test_a_level_is_crossed_when_the_solution_says(decay):
    """exp(-t) falls through 1/2 at t = ln 2 and through 1/4 at 2 ln 2, to 1e-8 s, once each."""
    run = simulate(DECAY, decay, trigger=LevelCrossing([0.5, 0.25]), **DECAYING)
    np.testing.assert_allclose(run.sample_times, [np.log(2), 2 * np.log(2)], atol=1e-7)


def test_an_area_is_reached_when_the_solution_says(decay):
    """The integral of 1 - exp(-s) up to t is t - 1 + exp(-t): 0.1 of it, to the error of the trapezoidal rule."""
    from scipy.optimize import brentq

    run = simulate(DECAY, decay, trigger=SendOnArea(0.1), **(DECAYING | {"until": 0.6}))
    expected = brentq(lambda t: t - 1 + np.exp(-t) - 0.1, 0.1, 1.0)
    assert run.sample_times[0] == 0.0
    slack = 0.01**2 / 12 * expected / (1 - np.exp(-expected))  # h^2 / 12 |y''| t over the slope of the area
    assert abs(run.sample_times[1] - expected) <= 1.1 * slack


def test_a_token_ends_the_wait_at_its_own_moment(decay):
    """The deviation waits for a token: the sample comes when the token does, between monitoring times."""
    run = simulate(DECAY, decay, trigger=SendOnDelta(1e-6) & TokenBucket(1 / 0.333, 1.0), **DECAYING)
    np.testing.assert_allclose(run.sample_times, 0.333 * np.arange(run.samples), atol=1e-8)
    assert run.samples == 7


@pytest.mark.parametrize("seed", [0, 1])
def test_a_budget_is_used_up_to_the_last_sample(sampled_reactor, seed):
    """Twelve samples in two seconds, whatever the policy makes of them."""
    run = reactor(Budget(SendOnDelta(0.05), 12, 2.0), sampled_reactor, seed=seed)
    assert run.samples == 12 and run.sample_times[-1] <= 2.0 + 1e-9


def test_linear_gaps_sample_as_planned(sampled_reactor):
    """Times of the plan, to rounding."""
    policy = LinearGaps(0.01, 0.19, 20)
    run = reactor(policy, sampled_reactor)
    np.testing.assert_allclose(run.sample_times, [policy.instant(k) for k in range(1, 21)], atol=1e-9)


def test_covariance_planned_ahead_equals_covariance_watched(sampled_reactor):
    """Without inputs nothing new is learnt between samples: both policies sample at the same times."""
    bound, total = 0.08, {"pA": 1.0, "pB": 1.0}
    watched = reactor(CovarianceBound(bound, total), sampled_reactor)
    planned = reactor(CovarianceSelfTriggered(bound, total, longest=1.5), sampled_reactor)
    assert 3 <= planned.samples < 40
    np.testing.assert_allclose(planned.sample_times, watched.sample_times, atol=1e-6)


def test_an_unobservable_combination_ends_the_run_with_its_name():
    """Without prior weight, a constant that no sensor sees stays unknown: an error, not a sample at every step."""
    model = ContinuousModel(
        lambda t, x, u, w, p: ca.vertcat(-x[0] + w[0], 0.0),
        lambda t, x, u, w, p: x[0],
        x=("seen", "hidden"),
        y="gauge",
        w="d",
    )
    cost = DiscountedCost(P=0.0, Q=1.0, R_point=10.0)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(step=0.1), cost=cost, hold="point")
    with pytest.raises(TriggerError, match=r"CovarianceBound\(bound=0.1, combination='hidden'\).*still infinite"):
        simulate(
            model,
            mhe,
            trigger=CovarianceBound(0.1, "hidden"),
            until=2.0,
            guess=[0, 0],
            truth=[1, 1],
            channel=SingleSample(),
            monitor=0.02,
        )


def test_innovation_energy_saves_solves_where_the_fit_is_good(whole_reactor):
    """A larger share of the cost means fewer solves; a share of zero means one whenever the dead time is over."""
    runs = [reactor(InnovationEnergy(a, 0.9, 1e2) & MinInterval(0.05), whole_reactor) for a in (0.0, 0.02, 0.2)]
    count = [run.samples for run in runs]
    assert count[0] == 41
    assert count[0] > count[1] > count[2] >= 1


def test_stochastic_sampling_meets_the_same_noise_and_lots_again(sampled_reactor):
    """The same seed gives the same run bit for bit; another gives another."""
    policy = Stochastic(100.0)
    first, second, other = (reactor(policy, sampled_reactor, seed=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.sample_times, second.sample_times)
    assert not np.array_equal(first.sample_times, other.sample_times)


def test_a_quadrotor_switches_from_periodic_to_event_triggered_sampling():
    """Even gaps until 0.5 s, then when the output leaves the line that the estimator predicts, 0.1 s at the latest."""
    model = quadrotor(noise=False)
    cost = DiscountedCost(P=1.0, Q=1e2, R_point=1e3)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(step=0.1), cost=cost, bounds=model.bounds, hold="point")
    policy = Phases((0.5, Periodic(0.05)), (SendOnDelta({"z3": 0.01}) & MinInterval(0.03)) | MaxInterval(0.1))
    run = simulate(
        model,
        mhe,
        trigger=policy,
        until=1.0,
        guess=np.full(12, 0.01),
        truth=np.zeros(12),
        inputs=np.full(4, hover_speed()),
        channel=SingleSample(),
        monitor=0.05,
    )
    times = run.sample_times
    np.testing.assert_allclose(times[times < 0.5 - 1e-9], 0.05 * np.arange(10), atol=1e-9)
    gaps = np.diff(times[times >= 0.5 - 1e-9])
    assert gaps.min() >= 0.03 - 1e-9 and gaps.max() <= policy.longest_wait + 1e-9


class Forgetful(Trigger):
    """Raises at its 100th question."""

    def init_state(self):
        return 0

    def fires(self, ctx):
        if ctx.state == 99:
            raise RuntimeError("the 100th call")
        return False

    def update(self, ctx, fired):
        return ctx.state + 1


def test_a_failure_late_in_a_run_is_named_with_its_time(decay):
    """The 100th monitoring time of 0.01 s is 0.99 s."""
    with pytest.raises(TriggerError, match=r"Forgetful\(\): fires failed at t = 0.99: RuntimeError: the 100th call"):
        simulate(DECAY, decay, trigger=Forgetful(), **DECAYING)
