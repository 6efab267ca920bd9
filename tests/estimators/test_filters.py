"""Filters as estimators: the verbs of MHE, runs, states that are kept, and what is refused."""

from __future__ import annotations

import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.data import MeasurementLog
from ctmhe.errors import InputError, NotEstimated, TooLate
from ctmhe.estimators import Extended, Filter, Kalman, Luenberger, RobustKalman, Unscented, norm_bounded
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import batch_reactor
from ctmhe.simulation import Network, SingleSample, Uniform, replay, simulate
from ctmhe.transcription import CVODES, RK4, Exact
from ctmhe.triggers import CovarianceBound, MaxInterval, Periodic, SendOnDelta
from ctmhe.types import DiscountedCost, Input, Measurement
from tests.conftest import feed, linear_model

A, C = np.array([[0, 1.0], [-2, -0.3]]), np.eye(2)
COST = DiscountedCost(P=1.0, Q=50.0, R=100.0)


def continuous(rule=None, **changes):
    """A filter of a damped oscillator with two sensors."""
    options = dict(cost=COST, integrator=Exact(0.1)) | changes
    return Filter(linear_model(A, np.eye(2), C), rule or Kalman(), **options)


def stepwise(rule):
    """A filter in steps of 0.1 s, with an input."""
    model = DiscreteModel(
        lambda t, x, u, w, p: 0.9 * x + ca.vertcat(u, 0) + w, lambda t, x, u, w, p: x[0],
        x=["a", "b"], u=["u"], w=["v", "w"], y=["y"], step=0.1,
    )  # fmt: skip
    return Filter(model, rule, cost=DiscountedCost(P=1.0, Q=50.0, R=100.0))


M, N, E = norm_bounded([(0.9 * np.eye(2) + [[0, 0.05], [0, 0]], [[1.0, 0]])], (0.9 * np.eye(2), [[1.0, 0]]))
FILTERS = {
    "white": continuous,
    "held": lambda: continuous(Extended(), interval=0.25),
    "points": lambda: continuous(Unscented(), interval=0.25),
    "observer": lambda: continuous(Luenberger(np.ones((2, 2)))),
    "steps": lambda: stepwise(Extended()),
    "robust": lambda: stepwise(RobustKalman(M, N, E)),
    "observer in steps": lambda: stepwise(Luenberger([0.3, 0.1])),
}


def told(one):
    """A state that knows an input, where there is one."""
    state = one.init(x=[1.0, -1.0])
    return one.control(state, Input(0.0, [0.2])) if len(one.model.u) else state


def rows(one, count, seed=0):
    """Samples at steps that every filter takes, one sensor silent now and then."""
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(count, len(one.model.y)))
    y[1::3, 0] = np.nan if y.shape[1] > 1 else y[1::3, 0]
    return [Measurement(round(0.1 * k, 10), y[k]) for k in range(count)]


@pytest.mark.parametrize("kind", FILTERS)
def test_a_state_saved_branched_and_continued_gives_the_same(kind, tmp_path):
    """Going on from a file, from the kept state, and from a pickled filter: to the last bit; the old state stays."""
    one = FILTERS[kind]()
    state = told(one)
    samples = rows(one, 12)
    for sample in samples[:6]:
        state, _ = one.estimate(one.observe(state, sample), sample.t)
    state = one.observe(state, samples[6])
    one.save(state, tmp_path / "state.npz")
    ends = []
    for who, start in ((one, state), (one, one.load(tmp_path / "state.npz")), (pickle.loads(pickle.dumps(one)), state)):
        branch = start
        for sample in samples[7:]:
            branch, estimate = who.estimate(who.observe(branch, sample), sample.t)
        ends.append(np.concatenate([estimate.x, estimate.covariance.reshape(-1), [estimate.cost]]))
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])
    assert state.t == pytest.approx(0.5)


@pytest.mark.parametrize("kind", FILTERS)
def test_estimating_in_between_changes_nothing(kind):
    """All samples at once, or an estimate after each and at every step: the same estimate at the end."""
    one, ends = FILTERS[kind](), []
    samples = rows(one, 10)
    for often in (False, True):
        state = told(one)
        for sample in samples:
            state = one.observe(state, sample)
            if often:
                state, _ = one.estimate(state, sample.t)
        ends.append(one.estimate(state, 1.0)[1])
    np.testing.assert_allclose(ends[1].x, ends[0].x, atol=1e-6)
    np.testing.assert_allclose(ends[1].covariance, ends[0].covariance, atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(st.permutations(range(6)), st.integers(0, 10**6))
def test_samples_may_arrive_in_any_order_and_piecewise(order, seed):
    """Rows in any order, each sensor by itself, told twice: nothing counts twice."""
    one = continuous()
    samples = rows(one, 6, seed)
    ordered = one.estimate(feed(one, told(one), [s.t for s in samples], [s.y for s in samples]), 0.6)[1]
    state = told(one)
    for i in order:
        for name, value in zip(one.model.y.names, samples[i].y, strict=True):
            state = one.observe(state, Measurement(samples[i].t, {name: value}))
        state = one.observe(state, samples[i])
    np.testing.assert_array_equal(one.estimate(state, 0.6)[1].x, ordered.x)


def test_a_sample_of_now_counts_once_however_often_it_is_told():
    """After an estimate at t the same sample at t is ignored, another sensor's counts, a contradiction is refused."""
    one = continuous()
    state, first = one.estimate(one.observe(told(one), Measurement(0.3, [0.5, np.nan])), 0.3)
    state, again = one.estimate(one.observe(state, Measurement(0.3, [0.5, np.nan])), 0.3)
    np.testing.assert_array_equal(again.x, first.x)
    both = one.estimate(one.observe(state, Measurement(0.3, [np.nan, 1.0])), 0.3)[1]
    whole = one.estimate(one.observe(told(one), Measurement(0.3, [0.5, 1.0])), 0.3)[1]
    np.testing.assert_allclose(both.x, whole.x, atol=1e-12)
    with pytest.raises(InputError, match=r"'y0' is 0\.7 but was 0\.5"):
        one.observe(state, Measurement(0.3, [0.7, np.nan]))


def test_late_data_are_refused_and_the_state_stays():
    """A filter cannot go back: samples and inputs from before the last estimate, estimates of the past."""
    one = stepwise(Extended())
    state, _ = one.estimate(told(one), 0.5)
    with pytest.raises(TooLate, match="an MHE, whose window takes late ones"):
        one.observe(state, Measurement(0.4, [1.0]))
    with pytest.raises(TooLate, match="input"):
        one.control(state, Input(0.4, [1.0]))
    for verb in (one.estimate, one.predict, one.trajectory):
        with pytest.raises(NotEstimated):
            verb(state, 0.3)
    with pytest.raises(InputError, match="multiple of the discrete model's step"):
        one.observe(state, Measurement(0.55, [1.0]))


def test_what_does_not_fit_is_named():
    """Models, rules, weights, gains, uncertainties and states that do not belong together."""
    model, reactor = linear_model(A, np.eye(2), C), batch_reactor(noise=False)
    cases = {
        "ContinuousModel": lambda: Filter(None, Kalman()),
        "rule must be a value": lambda: Filter(model, Kalman, integrator=RK4(0.1)),
        "needs integrator": lambda: Filter(model, Kalman()),
        "not linear": lambda: Filter(reactor, Kalman(), integrator=RK4(0.1)),
        "Exact|RK4": lambda: Filter(reactor, Extended(), integrator=Exact(0.1)),
        "equal steps": lambda: Filter(model, Extended(), integrator=CVODES()),
        "variance": lambda: Filter(batch_reactor(), Extended(), integrator=RK4(0.1)),
        "positive definite": lambda: continuous(cost=DiscountedCost(P=0.0)),
        "no recursive form": lambda: continuous(cost=DiscountedCost(S=1.0)),
        "own step": lambda: Filter(stepwise(Kalman()).model, Kalman(), interval=0.2),
        r"shape \(2, 2\)": lambda: continuous(Luenberger(np.ones((2, 3)))),
        "array of numbers": lambda: continuous(Luenberger("L")),
        "must be a DiscreteModel": lambda: continuous(RobustKalman(M, N, E)),
        "expected M": lambda: stepwise(RobustKalman(M[:1], N, E)),
        "alpha": lambda: continuous(Unscented(alpha=0.0)),
        "no vertices": lambda: norm_bounded([], (A, C)),
        "one shape": lambda: norm_bounded([(np.eye(3), C)], (A, C)),
    }
    for text, wrong in cases.items():
        with pytest.raises(InputError, match=text):
            assert wrong() is text
    one = continuous()
    with pytest.raises(InputError, match="unpack it"):
        one.observe(one.estimate(told(one), 0.1), Measurement(0.2, [1.0, 1.0]))
    with pytest.raises(InputError, match="no input is known"):
        other = stepwise(Kalman())
        other.estimate(other.init(x=[0.0, 0.0]), 0.1)


def test_a_file_of_another_filter_is_refused(tmp_path):
    """Other signals or another rule: named; not a state: damaged."""
    one = continuous()
    one.save(told(one), tmp_path / "state.npz")
    with pytest.raises(InputError, match="rule"):
        continuous(Luenberger(np.ones((2, 2)))).load(tmp_path / "state.npz")
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match="damaged"):
        one.load(tmp_path / "bad.npz")
    with pytest.raises(InputError, match="no file"):
        one.load(tmp_path / "none.npz")


def run(one, trigger, channel=None, **more):
    """A run of the oscillator."""
    return simulate(
        linear_model(A, np.eye(2), C), one, trigger=trigger, until=3.0, guess=[0.0, 0.0], truth=[1.0, 0.5],
        channel=channel or SingleSample(), disturbance=Uniform(0.3, interval=0.1), monitor=0.1, **more,
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["white", "held", "points", "observer"])
def test_filters_run_under_triggers(kind):
    """Event-triggered, with located guards: fewer samples than monitoring times, and the guess is forgotten."""
    found = run(FILTERS[kind](), SendOnDelta(0.3) | MaxInterval(0.5), seed=1)
    assert 5 < found.samples < 30 and found.online_rms(since=1.5) < 0.9
    assert np.isfinite(found.dataset["x_retro"].values).all()


def test_a_covariance_trigger_asks_the_filter():
    """It samples just when the predicted deviation reaches the bound: a wider bound, fewer samples."""
    policies = (CovarianceBound(bound, "x0") | MaxInterval(2.0) for bound in (0.12, 0.08))
    wide, narrow = (run(continuous(), policy).samples for policy in policies)
    assert 0 < wide < narrow


def test_late_messages_are_counted_and_left_out():
    """Over a network that delays, some samples come behind an estimate: too late for a filter, told so in the run."""
    channel = Network(SingleSample(), delay=(0.0, 0.4))
    found = run(continuous(), Periodic(0.1), channel=channel, seed=3)
    assert found.dataset.attrs["too_late"] > 0 and np.isfinite(found.dataset["x_hat"].values).all()


def test_a_filter_replays_a_log():
    """A recorded log through an extended filter, as through an MHE."""
    t = np.arange(40) * 0.1
    log = MeasurementLog(t, 4.0 - 0.5 * (1 - np.exp(-t))[:, None], ("pressure",), np.empty((40, 0)))
    cost = DiscountedCost(P=1.0, Q=1e3, R=1e4)
    one = Filter(batch_reactor(noise=False), Extended(), cost=cost, integrator=RK4(0.05))
    found = replay(log, one, trigger=Periodic(0.2), guess=[2.5, 1.5])
    assert found.solves > 15 and np.isfinite(found.dataset["x_hat"].values).all()


def test_where_the_model_fails_the_estimate_is_held_and_says_so():
    """A state that runs out of the square root's domain: the status tells, the numbers stay finite."""
    model = ContinuousModel(
        lambda t, x, u, w, p: -10 - ca.sqrt(x) + w, lambda t, x, u, w, p: x, x=["x"], w=["w"], y=["y"]
    )
    one = Filter(model, Extended(), cost=COST, integrator=RK4(0.1))
    _, estimate = one.estimate(one.init(x=[1.0]), 1.0)
    assert np.isfinite(estimate.x).all() and not estimate.status.success and "held from" in str(estimate.status)
