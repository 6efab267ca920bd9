"""Where theory says that filters agree, with each other and with full information estimation, they do."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.linalg import expm

from ctmhe.estimators import MHE, Extended, Filter, Kalman, Luenberger, RobustKalman, Unscented, norm_bounded
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.transcription import RK4, Exact
from ctmhe.types import DiscountedCost, Input, Measurement
from tests.conftest import feed, linear_model

RULES = (Kalman(), Extended(), Unscented())


def positive(rng, n):
    """A random positive definite matrix."""
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.5 * np.eye(n)


def driven(rng, n, ny, **keywords):
    """A random linear model with an input, an offset and a disturbance on every state."""
    A, B, C = 0.5 * rng.normal(size=(n, n)), rng.normal(size=(n, 1)), rng.normal(size=(ny, n))
    kind = DiscreteModel if "step" in keywords else ContinuousModel
    return kind(
        lambda t, x, u, w, p: ca.DM(A) @ x + ca.DM(B) @ u + w + 0.3,
        lambda t, x, u, w, p: ca.DM(C) @ x,
        x=[f"x{i}" for i in range(n)],
        u=["u"],
        w=[f"w{i}" for i in range(n)],
        y=[f"y{i}" for i in range(ny)],
        **keywords,
    )


def irregular(rng, until, count, ny, step=None):
    """Times, also within cells, and rows with silent sensors."""
    times = np.sort(rng.uniform(0, until, count))
    times[:2] = 0.0, 0.25
    if step:
        times = np.round(times / step) * step
    times = np.unique(times)
    rows = rng.normal(size=(len(times), ny))
    rows[rng.uniform(size=rows.shape) < 0.3] = np.nan
    return times, rows


def told(estimator, state, rng, until):
    """Inputs that switch at times of their own."""
    for t in (0.0, 0.5, 0.5 * until):
        state = estimator.control(state, Input(float(t), rng.normal(size=1)))
    return state


def agree(one, other, tolerance=1e-6):
    """Two estimates are the same."""
    np.testing.assert_allclose(one.x, other.x, atol=tolerance * max(1, np.abs(other.x).max()))
    np.testing.assert_allclose(one.covariance, other.covariance, atol=tolerance * np.abs(other.covariance).max())
    assert one.cost == pytest.approx(other.cost, rel=1e-6, abs=1e-9)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 3), st.integers(1, 2), st.sampled_from([1.0, 0.6]))
def test_the_kalman_filter_is_full_information_estimation(seed, n, ny, eta):
    """Irregular samples within cells, silent sensors, inputs, discount: estimate, covariance and cost are the same."""
    rng = np.random.default_rng(seed)
    model = driven(rng, n, ny)
    cost = DiscountedCost(P=positive(rng, n), Q=positive(rng, n), R_point=positive(rng, ny), eta=eta)
    times, rows = irregular(rng, 2.0, 12, ny)
    guess, drive = rng.normal(size=n), rng.integers(10**6)
    found = []
    mhe = MHE(model, horizon=9.0, interval=0.25, integrator=Exact(0.05), cost=cost, hold="point")
    for estimator in (mhe, Filter(model, Kalman(), cost=cost, integrator=Exact(0.05), interval=0.25)):
        state = told(estimator, estimator.init(x=guess), np.random.default_rng(drive), 2.0)
        found.append(estimator.estimate(feed(estimator, state, times, rows), 2.25)[1])
    agree(*found)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1.0, 0.8]))
def test_in_steps_it_is_too(seed, eta):
    """The filtering form (3.6) of a discrete-time model, with noise that drives states and outputs at once."""
    rng = np.random.default_rng(seed)
    A, C, G, D = (
        0.6 * rng.normal(size=(2, 2)),
        rng.normal(size=(1, 2)),
        rng.normal(size=(2, 2)),
        rng.normal(size=(1, 2)),
    )
    model = DiscreteModel(
        lambda t, x, u, w, p: ca.DM(A) @ x + ca.DM(G) @ w,
        lambda t, x, u, w, p: ca.DM(C) @ x + ca.DM(D) @ w,
        x=["a", "b"], w=["v", "w"], y=["y"], step=0.5,
    )  # fmt: skip
    cost = DiscountedCost(P=positive(rng, 2), Q=positive(rng, 2), R=3.0, eta=eta)
    times, rows = irregular(rng, 5.0, 8, 1, step=0.5)
    found = []
    for estimator in (MHE(model, horizon=50.0, cost=cost, filtering=True), Filter(model, Kalman(), cost=cost)):
        state = feed(estimator, estimator.init(x=[1.0, -1.0]), times, rows)
        found.append(estimator.estimate(state, 5.0)[1])
    agree(*found)


@pytest.mark.parametrize("kind", ["white", "held", "steps"])
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_extended_and_unscented_are_kalman_on_linear_models(kind, seed):
    """White noise, noise held over cells, and steps."""
    rng = np.random.default_rng(seed)
    options = {"white": {"integrator": RK4(0.05)}, "held": {"integrator": Exact(0.1), "interval": 0.25}, "steps": {}}
    model = driven(rng, 2, 2, **({"step": 0.25} if kind == "steps" else {}))
    cost = DiscountedCost(P=positive(rng, 2), Q=positive(rng, 2), R=positive(rng, 2), eta=0.9)
    times, rows = irregular(rng, 2.0, 8, 2, step=0.25 if kind == "steps" else None)
    drive, found = rng.integers(10**6), []
    for rule in RULES:
        one = Filter(model, rule, cost=cost, **options[kind])
        state = told(one, one.init(x=[1.0, 0.0]), np.random.default_rng(drive), 2.0)
        state, estimate = one.estimate(feed(one, state, times, rows), 2.0)
        ahead = one.propagate_covariance(state, 2.0, 2.5, estimate.x, estimate.p, estimate.covariance)
        found.append((estimate, ahead))
    for estimate, ahead in found[1:]:
        agree(estimate, found[0][0], 1e-8)
        np.testing.assert_allclose(ahead, found[0][1], rtol=1e-7)


def test_white_noise_gives_the_continuous_discrete_kalman_filter(rng):
    """Between samples P becomes exp(A h) P exp(A h)' plus the integral of exp(A s) W exp(A s)', by quadrature."""
    A, C = np.array([[0, 1.0], [-2, -0.3]]), np.array([[1.0, 0]])
    P, Q, R = np.diag([2.0, 3.0]), np.array([[5.0, 1.0], [1.0, 8.0]]), 6.0
    times, rows = irregular(rng, 2.0, 9, 1)
    one = Filter(linear_model(A, np.eye(2), C), Kalman(), cost=DiscountedCost(P=P, Q=Q, R=R), integrator=Exact(0.01))
    _, estimate = one.estimate(feed(one, one.init(x=[1, 0]), times, rows), times[-1])
    x, S, last = np.array([1.0, 0]), np.linalg.inv(P), 0.0
    for t, y in zip(times, rows, strict=True):
        F = expm(A * (t - last))
        noise, _ = quad_vec(lambda s: expm(A * s) @ np.linalg.inv(Q) @ expm(A * s).T, 0.0, t - last)
        x, S, last = F @ x, F @ S @ F.T + noise, t
        if np.isfinite(y[0]):
            K = S @ C.T / (C @ S @ C.T + 1 / R)
            x, S = x + K[:, 0] * (y - C @ x), S - K @ C @ S
    np.testing.assert_allclose(estimate.x, x, atol=1e-7)
    np.testing.assert_allclose(estimate.covariance, S, atol=1e-7)


def test_parameters_are_estimated_as_states_that_stay():
    """With P over states and parameters the extended filter finds a decay rate, with white noise, held, and points."""
    model = ContinuousModel(
        lambda t, x, u, w, p: -p[0] * x + u + w, lambda t, x, u, w, p: x,
        x=["x"], u=["u"], w=["w"], p=["k"], y=["y"],
    )  # fmt: skip
    cost = DiscountedCost(P=[1.0, 1.0], Q=1e4, R=1e4)
    for rule in (Extended(), Unscented()):
        for interval in (None, 0.1):
            one = Filter(model, rule, cost=cost, integrator=RK4(0.05), interval=interval)
            state = one.control(one.init(x=[2.0], p=[1.0]), Input(0.0, [1.0]))
            for t in np.arange(1, 40) * 0.13:
                state = one.observe(state, Measurement(t, [2.0 + (2.0 - 2.0) * t + 0.0]))
            state, estimate = one.estimate(state, 6.0)
            assert estimate.p[0] == pytest.approx(0.5, abs=0.02) and estimate.covariance.shape == (2, 2)


A, C = np.array([[0.7, 0.2], [-0.1, 0.6]]), np.array([[1.0, 0.5]])
SHIFTS = np.array([[[0.1, 0], [0, 0]], [[0, 0.1], [0.05, 0]], [[-0.05, -0.1], [0, -0.05]]])
VERTICES = [(A + SHIFTS[0], C), (A + SHIFTS[1], C + 0.1), (A + SHIFTS[2], C)]


def robust(cost):
    """A robust filter of the model x(k+1) = A x + u + w, and its uncertainty."""
    M, N, E = norm_bounded(VERTICES, (A, C))
    model = DiscreteModel(
        lambda t, x, u, w, p: ca.DM(A) @ x + ca.vertcat(u, 0) + w, lambda t, x, u, w, p: ca.DM(C) @ x,
        x=["a", "b"], u=["u"], w=["wa", "wb"], y=["y"], step=1.0,
    )  # fmt: skip
    return Filter(model, RobustKalman(M, N, E), cost=cost), (M, N, E)


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from(["random", "constant", "extreme", "vertices"]))
def test_the_robust_filter_bounds_its_error_covariance(seed, kind):
    """For admissible uncertainties, whatever they do in time: the exact covariance of the error never exceeds it.

    The filter is affine in the data, so its gains are found by finite differences, and with them the second moments of
    (x, x_hat) exactly: no sampling, no formula of the filter's own.
    """
    rng = np.random.default_rng(seed)
    one, (M, N, E) = robust(DiscountedCost(P=2.0, Q=10.0, R=4.0))
    r = (M.shape[1], len(E))
    guess, steps = np.array([1.0, -1.0]), 12
    silent = rng.uniform(size=steps) < 0.3
    u = rng.normal(size=steps) * 0.3
    fixed = rng.normal(size=r)
    deviations = [
        np.linalg.pinv(np.vstack([M, N])) @ np.vstack([a - A, c - C]) @ np.linalg.pinv(E) for a, c in VERTICES
    ]

    def uncertain():
        F = fixed if kind == "constant" else rng.normal(size=r)
        if kind == "vertices":
            return deviations[rng.integers(len(deviations))]
        if kind == "extreme":
            left, _, right = np.linalg.svd(F, full_matrices=False)
            return left @ right
        return F / np.linalg.norm(F, 2)

    def run(y):
        """Estimates and covariances for outputs (steps,)."""
        state, found = one.init(x=guess), []
        for k in range(steps):
            state = one.control(state, Input(float(k), [u[k]]))
            if not silent[k]:
                state = one.observe(state, Measurement(float(k), [y[k]]))
            state, estimate = one.estimate(state, float(k))
            found.append((estimate.x, estimate.covariance))
        return [np.array(part) for part in zip(*found, strict=True)]

    base, bounds = run(np.zeros(steps))
    gains = np.array([run(np.eye(steps)[j])[0] - base for j in range(steps)])  # (j, k, 2): x_hat_k per y_j
    # x_k and y_k as affine functions of z = (1, x0 - guess, w_0.., v_0..)
    size = 3 + 2 * steps + steps
    x = np.zeros((2, size))
    x[:, 0], x[:, 1:3] = guess, np.eye(2)
    moments = np.diag(np.concatenate([[1.0, 0.5, 0.5], np.full(2 * steps, 0.1), np.full(steps, 0.25)]))
    rows = []
    for k in range(steps):
        F = uncertain()
        assert np.linalg.norm(F, 2) <= 1 + 1e-9
        y = (C + N @ F @ E) @ x
        y[:, 3 + 2 * steps + k] += 1.0
        rows.append(y[0])
        x_hat = np.einsum("jk,jm->km", gains[: k + 1, k], np.array(rows))
        x_hat[:, 0] += base[k]
        error = x - x_hat
        gap = bounds[k] - error @ moments @ error.T
        assert np.linalg.eigvalsh(gap)[0] >= -1e-9 * np.trace(bounds[k])
        x = (A + M @ F @ E) @ x
        x[0, 0] += u[k]
        x[:, 3 + 2 * k : 5 + 2 * k] += np.eye(2)


def test_a_nominal_filter_breaks_the_bound_that_it_states():
    """Negative control: the Kalman filter of the nominal model claims less than its error under a constant vertex."""
    cost = DiscountedCost(P=2.0, Q=10.0, R=4.0)
    one, _ = robust(cost)
    plain = Filter(one.model, Kalman(), cost=cost)
    a, c = VERTICES[1]
    rng, errors = np.random.default_rng(0), {"plain": [], "robust": []}
    for _ in range(40):
        x = rng.normal(size=2) * np.sqrt(0.5) + [3.0, 3.0]
        states = {"plain": plain.init(x=[3.0, 3.0]), "robust": one.init(x=[3.0, 3.0])}
        for k in range(12):
            y = c @ x + 0.5 * rng.normal(size=1)
            for name, filter_ in (("plain", plain), ("robust", one)):
                state = filter_.control(states[name], Input(float(k), [2.0]))
                states[name], estimate = filter_.estimate(filter_.observe(state, Measurement(float(k), y)), float(k))
                if k == 11:
                    errors[name].append(
                        np.trace(np.outer(estimate.x - x, estimate.x - x)) / np.trace(estimate.covariance)
                    )
            x = a @ x + [2.0, 0.0] + np.sqrt(0.1) * rng.normal(size=2)
    assert np.mean(errors["plain"]) > 1.5 and np.mean(errors["robust"]) < 1


def test_without_uncertainty_the_robust_filter_is_kalman(rng):
    """M = N = 0: the same estimates, covariances and cost."""
    cost = DiscountedCost(P=2.0, Q=10.0, R=4.0)
    model = driven(rng, 2, 1, step=1.0)
    found = []
    for rule in (Kalman(), RobustKalman(np.zeros((2, 1)), np.zeros((1, 1)), np.zeros((1, 2)))):
        one = Filter(model, rule, cost=cost)
        state = one.control(one.init(x=[1.0, 0.0]), Input(0.0, [1.0]))
        found.append(one.estimate(feed(one, state, [0.0, 1.0, 3.0], [[1.0], [0.5], [2.0]]), 4.0)[1])
    agree(*found, 1e-10)


def test_every_mixture_of_vertices_is_covered(rng):
    """What norm_bounded returns contains random convex combinations: the inner factor has norm at most one."""
    M, N, E = norm_bounded(VERTICES, (A, C))
    stack = np.vstack([M, N])
    for _ in range(50):
        weights = rng.dirichlet(np.ones(len(VERTICES)))
        deviation = sum(s * np.vstack([a - A, c - C]) for s, (a, c) in zip(weights, VERTICES, strict=True))
        F = np.linalg.pinv(stack) @ deviation @ np.linalg.pinv(E)
        np.testing.assert_allclose(stack @ F @ E, deviation, atol=1e-9)
        assert np.linalg.norm(F, 2) <= 1 + 1e-9


def test_a_luenberger_observer_in_steps_is_its_recursion(rng):
    """x(k+1) = A x + u + L (y - C x), without injection where the sensor is silent."""
    L = np.array([[0.3], [0.1]])
    model = robust(DiscountedCost(P=1.0, Q=1.0))[0].model
    one = Filter(model, Luenberger(L))
    state, x = one.control(one.init(x=[1.0, 2.0]), Input(0.0, [0.5])), np.array([1.0, 2.0])
    for k in range(12):
        y = rng.normal(size=1)
        if k % 3:
            state = one.observe(state, Measurement(float(k), y))
        state, estimate = one.estimate(state, float(k))
        np.testing.assert_allclose(estimate.x, x, atol=1e-12)
        x = A @ x + [0.5, 0.0] + (L @ (y - C @ x) if k % 3 else 0.0)


def test_a_luenberger_observer_in_continuous_time_holds_samples(rng):
    """Between samples dx/dt = (A - L C) x + L y with y held: the matrix exponential, over irregular gaps."""
    A, C, L = np.array([[0, 1.0], [-2, -0.3]]), np.array([[1.0, 0]]), np.array([[2.0], [1.0]])
    one = Filter(linear_model(A, np.eye(2), C), Luenberger(L), integrator=RK4(0.005))
    times = np.array([0.0, 0.13, 0.4, 0.45, 1.0])
    y, x = rng.normal(size=5), np.array([1.0, -1.0])
    state = feed(one, one.init(x=x), times, y[:, None])
    F = A - L @ C
    for k in range(4):
        h = times[k + 1] - times[k]
        x = expm(F * h) @ x + np.linalg.solve(F, (expm(F * h) - np.eye(2)) @ L[:, 0]) * y[k]
    np.testing.assert_allclose(one.estimate(state, 1.0)[1].x, x, atol=1e-9)
