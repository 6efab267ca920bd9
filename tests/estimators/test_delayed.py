"""Estimates with a delay: what they are, where they come from, and what they are worth."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from ctmhe import (
    MHE,
    RK4,
    DiscountedCost,
    InputError,
    KalmanWeight,
    LinearGaps,
    Measurement,
    MeasurementLog,
    Periodic,
    Scheduled,
    SingleSample,
    Uniform,
    simulate,
)
from ctmhe.estimators.offline.benchmark import infinite_horizon, regret
from ctmhe.estimators.offline.linear import rauch_tung_striebel
from ctmhe.models.library import batch_reactor
from ctmhe.studies.reproduce._offline import stepped
from tests.estimators.test_offline import A, C, linear_mhe, linear_record


def reactor(delay: float | None = None, horizon: float = 2.0, **options) -> MHE:
    """Return an event-triggered estimator of the batch reactor."""
    model = batch_reactor(noise=False)
    return MHE(
        model, horizon=horizon, interval=0.1, integrator=RK4(0.05), cost=DiscountedCost(P=1.0, Q=3e3, R_point=1.2e3),
        bounds=model.bounds, hold="point", delay=delay, **options,
    )  # fmt: skip


def run(delay: float | None, trigger, seed: int = 0, until: float = 4.0, **options):
    """Simulate the reactor under a trigger."""
    return simulate(
        batch_reactor(), reactor(delay, **options), trigger=trigger, until=until, truth=[3.0, 1.0], guess=[0.1, 4.5],
        monitor=0.02, channel=SingleSample(), seed=seed,
        disturbance={"v_pressure": Uniform(0.05), "w_pA": Uniform(0.1)},
    )  # fmt: skip


def test_no_delay_is_standard_mhe():
    """With a delay of zero the delayed estimate is the estimate, and nothing else changes."""
    log, _ = linear_record(30)
    plain, zero = linear_mhe(), linear_mhe().changed(delay=0.0)
    for one, other in zip(stepped(plain, log, guess=np.ones(3)), stepped(zero, log, guess=np.ones(3)), strict=True):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(other.x, other.delayed.x)
        assert one.delayed is None and other.delayed.t == other.t


@pytest.mark.parametrize("steps", [1, 3, 7])
def test_a_growing_window_with_delay_is_the_fixed_lag_smoother(steps):
    """Full information with delay: at t the state of t - delay given all data up to t, of Rauch, Tung and Striebel."""
    log, problem = linear_record(25)
    mhe = linear_mhe().changed(horizon=np.inf, delay=steps * 0.5)
    for k, estimate in enumerate(stepped(mhe, log, guess=np.ones(3))):
        if k < steps:
            assert estimate.delayed is None
            continue
        assert estimate.delayed.t == pytest.approx((k - steps) * 0.5, abs=1e-12)
        smoothed = rauch_tung_striebel(problem.part(0, k, prior=True)).x
        np.testing.assert_allclose(estimate.delayed.x, smoothed[k - steps], atol=1e-6)


@pytest.mark.parametrize(
    "trigger", [Periodic(0.1), LinearGaps(0.02, 0.3, 25), Scheduled([0.31, 0.9, 1.0, 2.2, 2.21, 4.0])]
)
def test_a_run_assembles_the_delayed_trajectory_piece_by_piece(trigger):
    """At every monitoring time the value comes from the first solve a delay later, also between irregular samples."""
    delay = 0.75
    found = run(delay, trigger)
    data, mhe = found.dataset, reactor(delay)
    state, expected = mhe.init(x=[0.1, 4.5]), np.full((len(found.t), 2), np.nan)
    known = 0
    for k, t in enumerate(data["solve_time"].to_numpy().tolist()):
        y = data["y_sampled"].to_numpy()[k]
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(t, y)), t)
        while known < len(found.t) and found.t[known] <= t - delay + 1e-9:
            if found.t[known] >= estimate.trajectory.t[0]:
                expected[known] = mhe.smooth(state, found.t[known])
            known += 1
    np.testing.assert_allclose(data["x_delayed"].to_numpy(), expected, atol=1e-9)
    last = data["solve_time"].to_numpy()[-1]
    assert np.isnan(expected[found.t > last - delay + 1e-9]).all()


def test_a_delay_pays():
    """With matching weights the delayed estimates are closer to the truth, the more so the longer the delay."""
    rng, x = np.random.default_rng(0), np.zeros((301, 3))
    for k in range(300):
        x[k + 1] = A @ x[k] + rng.normal(size=3) / np.sqrt(3.0)
    y = x @ C.T + rng.normal(size=(301, 1)) / np.sqrt(2.0)
    log = MeasurementLog(np.arange(301) * 0.5, y, ("y",), np.zeros((301, 1)), ("u",))
    errors = []
    for steps in (0, 1, 3):
        found = stepped(linear_mhe().changed(delay=steps * 0.5), log, guess=np.zeros(3))
        delayed = np.array([estimate.delayed.x for estimate in found[steps:]])
        errors.append(np.sum((delayed - x[: 301 - steps])[50:290] ** 2))
    assert errors[2] < errors[1] < 0.95 * errors[0]


def test_a_run_tells_the_delayed_error():
    """The error of the delayed estimate stands beside the online error, by state, and in the table."""
    found = run(0.5, Periodic(0.1), until=2.0)
    assert found.delayed_rms("pA", since=1.0) < found.delayed_rms(since=1.0) < 1.0
    assert "x_delayed.pA" in found.to_pandas()
    assert np.isnan(found.delayed_error().to_numpy()[-1]).all()


def test_a_run_has_its_regret():
    """A run's record gives benchmark and regret of its delayed trajectory: below that of what was known online."""
    found = run(0.8, Periodic(0.1), until=5.0, prior=KalmanWeight("turnpike"))
    cost = DiscountedCost(P=np.zeros((2, 2)), Q=3e3, R_point=1.2e3)
    mhe, log = reactor(horizon=5.0).changed(cost=cost), found.to_log()
    best = infinite_horizon(mhe, log, margin=1.0, guess=[2.8, 1.1])
    assert len(best.t) == 31  # cell edges, at which the samples are
    rows = np.searchsorted(found.t, best.t - 1e-9)
    known = [found.dataset[name].to_numpy()[rows] for name in ("x_online", "x_delayed")]
    online, delayed = (regret(mhe, log, best.t, x, best) for x in known)
    assert 0.0 < delayed.total < online.total


def test_a_delay_that_no_window_reaches_is_refused():
    """Longer than the horizon, negative, or between steps: named."""
    with pytest.raises(InputError, match="longer than the horizon"):
        reactor(2.5)
    with pytest.raises(InputError, match="delay must be"):
        reactor(-0.1)
    with pytest.raises(InputError, match="not a multiple"):
        linear_mhe().changed(delay=0.3)
    with pytest.raises(InputError, match="no argument 'delayed'"):
        linear_mhe().changed(delayed=0.5)
    with pytest.raises(InputError, match="had no delay"):
        run(None, Periodic(0.5), until=1.0).delayed_rms()


def test_the_whole_horizon_is_the_longest_delay():
    """A delay of the horizon gives the window's first state; pickling keeps it."""
    mhe = pickle.loads(pickle.dumps(reactor(2.0)))
    state = mhe.init(x=[3.0, 1.0])
    for t in np.arange(1, 41) * 0.1:
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(float(t), [4.0 - 0.2 * t])), float(t))
        if estimate.delayed is not None:
            np.testing.assert_allclose(estimate.delayed.x, estimate.trajectory.x[0], atol=1e-9)
    assert estimate.delayed.t == pytest.approx(2.0)


def test_half_of_an_odd_horizon_is_whole_steps():
    """The turnpike prior of a discrete model with 7 steps is a node of the solution made three steps later."""
    log, _ = linear_record(25)
    found = stepped(linear_mhe().changed(prior="turnpike", horizon=3.5), log, guess=np.ones(3))
    for k in range(12, 26):
        start, earlier = found[k].trajectory.t[0], found[k - 7 + 3].trajectory
        node = int(np.argmin(np.abs(earlier.t - start)))
        np.testing.assert_allclose(found[k].prior, earlier.x[node], atol=1e-9)
