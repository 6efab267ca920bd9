"""An updated arrival cost says about the past what the whole past says."""

from __future__ import annotations

import numpy as np
import pytest

from ctmhe import MHE, RK4, Bounds, ContinuousModel, DiscountedCost, DiscreteModel, InputError, Measurement
from ctmhe.estimators import ArrivalUpdate
from ctmhe.models.library import three_species_discrete

A = np.array([[1.0, 0.1], [-0.2, 0.9]])
Q, R, P0 = np.diag([50.0, 20.0, 1.0]), 4.0, np.array([[2.0, 0.3], [0.3, 1.0]])


def linear() -> DiscreteModel:
    """Two states, noisy; the third entry of w is not used by the dynamics but has a weight."""
    return DiscreteModel(
        lambda t, x, u, w, p: (A[0, 0] * x[0] + A[0, 1] * x[1] + w[0], A[1, 0] * x[0] + A[1, 1] * x[1] + w[1]),
        lambda t, x, u, w, p: [x[0] + w[2]],
        step=1.0,
        x=("a", "b"),
        w=("da", "db", "v"),
        y="a_measured",
    )


def estimates(mhe: MHE, times, values) -> list:
    """Return the estimates when each sample is followed by one."""
    state, found = mhe.init(x=[1.0, -1.0]), []
    for t, value in zip(times, values, strict=True):
        if np.isfinite(value):
            state = mhe.observe(state, Measurement(float(t), [value]))
        state, estimate = mhe.estimate(state, float(t))
        found.append(estimate)
    return found


@pytest.mark.parametrize("eta", [1.0, 0.9])
@pytest.mark.parametrize("filtering", [False, True])
def test_for_linear_models_a_short_window_is_full_information(filtering, eta):
    """With the arrival cost updated, N = 2 gives the estimates and covariances of a window without end."""
    values = np.random.default_rng(0).normal(size=15)
    values[[4, 5, 9]] = np.nan
    cost = DiscountedCost(P=P0, Q=Q, R=R, eta=eta)
    short, long = (
        estimates(MHE(linear(), horizon=T, cost=cost, filtering=filtering, prior=prior), range(15), values)
        for T, prior in ((2.0, ArrivalUpdate()), (np.inf, "filtering"))
    )
    for one, other in zip(short, long, strict=True):
        np.testing.assert_allclose(one.x, other.x, atol=1e-7)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-9)


def test_the_weight_is_the_inverse_of_the_kalman_filters_covariance():
    """At the window's start the weight is that of the filter which has seen everything before."""
    mhe = MHE(linear(), horizon=2.0, cost=DiscountedCost(P=P0, Q=Q, R=R), prior=ArrivalUpdate())
    state, covariance = mhe.init(x=[1.0, -1.0]), np.linalg.inv(P0)
    C, D, noise = np.array([[1.0, 0.0]]), np.array([[0, 0, 1.0]]), np.linalg.inv(Q)
    for k in range(8):
        state = mhe.observe(state, Measurement(float(k), [0.3 * k]))
        state, _ = mhe.estimate(state, float(k))
    for _ in range(5):  # the window of k = 7 starts at 5
        S = C @ covariance @ C.T + D @ noise @ D.T + 1 / R
        covariance = A @ (covariance - covariance @ C.T @ np.linalg.solve(S, C @ covariance)) @ A.T + noise[:2, :2]
    weight = state.memory["arrival"].arrays()[1][0, 2:].reshape(2, 2)
    np.testing.assert_allclose(np.linalg.inv(weight), covariance, rtol=1e-8)


def test_in_continuous_time_too():
    """With single samples and a linear model, estimates at cell edges are those of full information."""
    model = ContinuousModel(
        lambda t, x, u, w, p: (x[1] + w[0], -x[0] + w[1]),
        lambda t, x, u, w, p: [x[0]],
        x=("s", "v"),
        w=("d1", "d2"),
        y="y",
    )
    cost = DiscountedCost(P=P0, Q=[3.0, 5.0], R=R, rate=0.1)
    times, values = np.arange(1, 25) * 0.25, np.random.default_rng(1).normal(size=24)
    options = {"interval": 0.25, "integrator": RK4(0.125), "cost": cost, "hold": "point"}
    short, long = (
        estimates(MHE(model, horizon=T, prior=prior, **options), times, values)
        for T, prior in ((1.0, ArrivalUpdate()), (np.inf, "filtering"))
    )
    for one, other in zip(short, long, strict=True):
        np.testing.assert_allclose(one.x, other.x, atol=1e-7)


def test_states_are_saved_and_go_on(tmp_path):
    """Save, load and continue equals never stopping, for a nonlinear model with one iteration a step."""
    model, y = three_species_discrete(), 0.65 + 0.05 * np.random.default_rng(2).uniform(-1, 1, 20)
    options = {"horizon": 0.75, "cost": DiscountedCost(P=1.0, Q=100.0, R=10.0), "bounds": Bounds(x=(0, 3))}
    mhe = MHE(model, prior=ArrivalUpdate(), filtering=True, max_iterations=1, **options)
    ends = []
    for stop in (None, 9):
        state = mhe.init(x=[2.0, 0.5, 0.0])
        for k, value in enumerate(y):
            state = mhe.observe(state, Measurement(0.25 * k, [value]))
            state, estimate = mhe.estimate(state, 0.25 * k)
            if k == stop:
                mhe.save(state, tmp_path / "state.npz")
                state = mhe.load(tmp_path / "state.npz")
        ends.append(estimate.x)
    np.testing.assert_array_equal(*ends)


def test_a_prior_that_weighs_nothing_cannot_be_updated():
    """P must be positive definite, and only of the states."""
    with pytest.raises(InputError, match="positive definite"):
        MHE(linear(), horizon=2.0, cost=DiscountedCost(P=0.0), prior=ArrivalUpdate()).init(x=[0.0, 0.0])
