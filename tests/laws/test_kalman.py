"""Where theory says that the estimate is the Kalman filter's, it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from ctmhe.estimators import MHE
from ctmhe.transcription import CVODES, RK4
from ctmhe.types import DiscountedCost
from tests.conftest import feed, linear_model


def held_disturbance_map(A, B, length):
    """Return exp(A h) and the integral of exp(A s) B over the slot: exact for w held."""
    integral, _ = quad_vec(lambda s: expm(A * s) @ B, 0.0, length)
    return expm(A * length), integral


def update(x, P, C, y, R):
    """One Kalman measurement update with missing sensors dropped from C and the covariance."""
    seen = np.isfinite(y)
    if not seen.any():
        return x, P
    C, noise, y = C[seen], np.linalg.inv(R)[np.ix_(seen, seen)], y[seen]
    K = P @ C.T @ np.linalg.inv(C @ P @ C.T + noise)
    return x + K @ (y - C @ x), (np.eye(len(x)) - K @ C) @ P


def kalman(A, B, C, P, Q, R, x, rows, h):
    """Discrete Kalman filter with w held over cells of h, covariance (Q h)^-1; samples at k h."""
    F, G = held_disturbance_map(A, B, h)
    W = np.linalg.inv(Q * h)
    P = np.linalg.inv(P)
    for k, y in enumerate(rows):
        if k:
            x, P = F @ x, F @ P @ F.T + G @ W @ G.T
        x, P = update(x, P, C, y, R)
    return x, P


def positive(rng, n):
    """A random positive definite matrix."""
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.5 * np.eye(n)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(1, 2))
def test_linear_point_samples_full_horizon_equal_the_kalman_filter(seed, n, ny):
    """Estimate and covariance agree to 1e-6 for random systems, correlated weights and missing sensors."""
    rng = np.random.default_rng(seed)
    A, B, C = rng.normal(size=(n, n)), np.eye(n), rng.normal(size=(ny, n))
    P, Q, R = positive(rng, n), positive(rng, n), positive(rng, ny)
    h, steps = 0.1, 15
    rows = rng.normal(size=(steps + 1, ny))
    rows[rng.uniform(size=rows.shape) < 0.3] = np.nan
    guess = rng.normal(size=n)
    cost = DiscountedCost(P=P, Q=Q, R=R, eta=1.0)
    mhe = MHE(linear_model(A, B, C), horizon=10.0, interval=h, integrator=RK4(0.005), cost=cost, hold="point")
    state = feed(mhe, mhe.init(x=guess), np.arange(steps + 1) * h, rows)
    _, estimate = mhe.estimate(state, steps * h)
    x, covariance = kalman(A, B, C, P, Q, R, guess, rows, h)
    np.testing.assert_allclose(estimate.x, x, atol=1e-6 * max(1, np.abs(x).max()))
    np.testing.assert_allclose(estimate.covariance, covariance, atol=1e-6 * np.abs(covariance).max())
    assert estimate.rank == n


def test_cvodes_gives_the_kalman_filter_too(rng):
    """The law does not depend on the integrator."""
    A, B, C = np.array([[0, 1.0], [-2, -0.3]]), np.eye(2), np.array([[1.0, 0]])
    P, Q, R = np.diag([2.0, 3.0]), np.array([[50.0, 3], [3, 20]]), np.array([[25.0]])
    rows = rng.normal(size=(13, 1))
    cost = DiscountedCost(P=P, Q=Q, R=R)
    mhe = MHE(linear_model(A, B, C), horizon=9, interval=0.1, integrator=CVODES(1e-10, 1e-12), cost=cost, hold="point")
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[1, 0]), np.arange(13) * 0.1, rows), 1.2)
    x, covariance = kalman(A, B, C, P, Q, R, np.array([1.0, 0]), rows, 0.1)
    np.testing.assert_allclose(estimate.x, x, atol=1e-6)
    np.testing.assert_allclose(estimate.covariance, covariance, atol=1e-6)


def test_samples_between_cell_edges_are_counted_at_their_own_time(rng):
    """One sample inside a cell: the exact covariance of the split cell, not that of the nearest edge."""
    a, q, r, p0, h, s = -0.7, 4.0, 9.0, 2.0, 0.5, 0.37
    mhe = MHE(
        linear_model([[a]], [[1.0]], [[1.0]]),
        horizon=5.0,
        interval=h,
        integrator=RK4(0.002),
        cost=DiscountedCost(P=p0, Q=q, R=r),
        hold="point",
    )
    y = 0.8
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0.3]), [s], [[y]]), h)
    # unknowns (x0, w): x(t) = e^{a t} x0 + g(t) w with one w for the whole cell
    g = lambda t: (np.exp(a * t) - 1) / a  # noqa: E731
    prior = np.diag([1 / p0, 1 / (q * h)])
    c = np.array([np.exp(a * s), g(s)])
    K = prior @ c / (c @ prior @ c + 1 / r)
    mean = np.array([0.3, 0.0]) + K * (y - c @ [0.3, 0.0])
    posterior = prior - np.outer(K, c) @ prior
    end = np.array([np.exp(a * h), g(h)])
    np.testing.assert_allclose(estimate.x, end @ mean, rtol=1e-8)
    np.testing.assert_allclose(estimate.covariance, [[end @ posterior @ end]], rtol=1e-8)


def test_covariance_converges_to_kalman_bucy_with_the_cells():
    """With the whole signal, halving the cells divides the distance to the Riccati solution by at least 3."""
    A, B, C = np.array([[0, 1.0], [-2, -0.3]]), np.eye(2), np.array([[1.0, 0]])
    P, Q, R = np.diag([2.0, 3.0]), np.diag([5.0, 8.0]), 6.0

    def riccati(t, flat):
        S = flat.reshape(2, 2)
        return (A @ S + S @ A.T + np.linalg.inv(Q) - S @ C.T @ C @ S * R).ravel()

    end = 1.6
    exact = solve_ivp(riccati, (0, end), np.linalg.inv(P).ravel(), rtol=1e-11, atol=1e-13).y[:, -1].reshape(2, 2)
    errors = []
    for h in (0.4, 0.2, 0.1):
        mhe = MHE(
            linear_model(A, B, C),
            horizon=5,
            interval=h,
            integrator=RK4(0.02),
            cost=DiscountedCost(P=P, Q=Q, R=R),
            hold="zero",
        )
        _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0, 0]), [0.0], [[0.0]]), end)
        errors.append(np.abs(estimate.covariance - exact).max())
    assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3


def test_silent_sensor_with_correlated_noise_drops_from_the_covariance():
    """R of the remaining sensor is the inverse of its block of R^-1, not the block of R."""
    R = np.array([[4.0, 3.0], [3.0, 4.0]])
    cost = DiscountedCost(P=1.0, Q=1e8, R=R)
    mhe = MHE(
        linear_model([[0.0]], [[1.0]], [[1.0], [1.0]]),
        horizon=5,
        interval=1,
        integrator=RK4(1),
        cost=cost,
        hold="point",
    )
    state = feed(mhe, mhe.init(x=[0.0]), [0.0], [[1.0, np.nan]])
    _, estimate = mhe.estimate(state, 0.0)
    r = 1 / np.linalg.inv(R)[0, 0]
    assert estimate.x[0] == pytest.approx(r / (1 + r), rel=1e-9)
