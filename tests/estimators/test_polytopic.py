"""Polytopes: mixing weights, dual iterations, the adaptive arrival cost."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError
from ctmhe.estimators import MHE, AdaptiveArrival, dual_iterations, polytopic_horizon
from ctmhe.estimators.priors.polytopic import renewed
from ctmhe.models import ContinuousModel, DiscreteModel, mixture, polytope
from ctmhe.models.library import unknown_linear
from ctmhe.simulation import MapPlant, SingleSample, Uniform, simulate
from ctmhe.solvers.dual import DualIterations, simplex_least_squares
from ctmhe.transcription import RK4, Exact
from ctmhe.triggers import MaxInterval, SendOnDelta
from ctmhe.types import Bounds, DiscountedCost, Measurement, Outcome
from tests.conftest import feed, linear_model

SIMPLEX = Bounds(p=(0.0, 1.0))
VERTICES = [np.array(a) for a in ([[0.9, 0.3], [-0.3, 0.8]], [[0.5, -0.4], [0.4, 0.7]], [[0.2, 0.5], [-0.5, 0.3]])]
C = np.array([[1.0, 0.0]])
TRUE = np.array([0.2, 0.5, 0.3])
COST = DiscountedCost(P=np.diag([1.0, 1.0, 0.01, 0.01, 0.01]), Q=100.0, R=100.0)


def data(rng, steps, w=0.05, v=0.0, A=None):
    """States and outputs of the mixture, driven by noise."""
    A = mixture(VERTICES, TRUE) if A is None else A
    x, y, now = [], [], np.array([2.0, -1.0])
    for _ in range(steps):
        x.append(now)
        y.append(C @ now + v * rng.normal(size=1))
        now = A @ now + w * rng.normal(size=2)
    return np.array(x), np.array(y)


def polytopic(**changes):
    """The estimator of three vertices, in steps."""
    options = dict(horizon=6.0, cost=COST, bounds=SIMPLEX, solver=DualIterations(10), filtering=True)
    return MHE(polytope(VERTICES, C, step=1.0), **(options | changes))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_one_vertex_is_linear_mhe(seed, filtering):
    """The same estimates, costs and covariances as an MHE of that linear model, whatever the iterations."""
    rng = np.random.default_rng(seed)
    A, B = 0.7 * rng.normal(size=(2, 2)), rng.normal(size=(1, 2))
    plain = DiscreteModel(
        lambda t, x, u, w, p: ca.DM(A) @ x + w, lambda t, x, u, w, p: ca.DM(B) @ x,
        x=["x1", "x2"], w=["w1", "w2"], y=["y1"], step=1.0,
    )  # fmt: skip
    cost = DiscountedCost(P=[1.0, 2.0], Q=3.0, R=4.0, eta=0.9)
    rows = rng.normal(size=(12, 1))
    found = []
    for model, solver in ((plain, "gauss-newton"), (polytope([A], B, step=1.0), DualIterations(3))):
        mhe = MHE(model, horizon=5.0, cost=cost, solver=solver, filtering=filtering)
        state = mhe.init(x=[1.0, 0.0])
        for k, row in enumerate(rows):
            state, estimate = mhe.estimate(mhe.observe(state, Measurement(float(k), row)), float(k))
        found.append(estimate)
    np.testing.assert_allclose(found[1].x, found[0].x, atol=1e-8)
    np.testing.assert_allclose(found[1].covariance, found[0].covariance, atol=1e-8)
    assert found[1].cost == pytest.approx(found[0].cost, rel=1e-7) and found[1].status.outcome is Outcome.SOLVED


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6))
def test_every_dual_iteration_lowers_the_joint_cost(seed):
    """From one window and guess: never a larger cost with more iterations, always on the simplex, dynamics met."""
    rng = np.random.default_rng(seed)
    _, y = data(rng, 8, v=0.1)
    costs = []
    for count in (1, 2, 4, 8, 16):
        mhe = polytopic(solver=DualIterations(count), horizon=20.0)
        state = feed(mhe, mhe.init(x=[0.0, 0.0], p=[0.6, 0.2, 0.2]), np.arange(8.0), y)
        _, estimate = mhe.estimate(state, 7.0)
        costs.append(estimate.cost)
        assert estimate.p.min() >= 0 and estimate.p.sum() == pytest.approx(1.0)
        path, A = estimate.trajectory, mixture(VERTICES, estimate.p / estimate.p.sum())
        np.testing.assert_allclose(path.x[1:-1], path.x[:-2] @ A.T + path.w[:-1], atol=1e-9)
    assert all(late <= early * (1 + 1e-9) for early, late in pairwise(costs))
    assert costs[-1] < costs[0]


def test_dual_iterations_end_where_the_joint_problem_does(rng):
    """(6) written out in CasADi and started at what the iterations found: IPOPT gains next to nothing."""
    _, y = data(rng, 7, w=0.3)
    mhe = polytopic(solver=DualIterations(4000, tolerance=1e-13), horizon=20.0)
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0.0, 0.0]), np.arange(7.0), y), 6.0)
    opti = ca.Opti()
    x, alpha = opti.variable(2, 7), opti.variable(3)
    A = sum(alpha[i] * ca.DM(VERTICES[i]) for i in range(3))
    cost = ca.sumsqr(x[:, 0]) + 0.01 * ca.sumsqr(alpha - 1 / 3)
    for k in range(7):
        cost += 100 * (y[k, 0] - x[0, k]) ** 2 + (100 * ca.sumsqr(x[:, k + 1] - A @ x[:, k]) if k < 6 else 0)
    opti.minimize(cost)
    opti.subject_to(alpha >= 0)
    opti.subject_to(ca.sum1(alpha) == 1)
    opti.set_initial(x, estimate.trajectory.x[:7].T)
    opti.set_initial(alpha, estimate.p)
    opti.solver("ipopt", {"print_time": 0}, {"print_level": 0, "sb": "yes"})
    solution = opti.solve()
    assert estimate.cost == pytest.approx(float(solution.value(cost)), rel=1e-4)
    np.testing.assert_allclose(estimate.p, solution.value(alpha), atol=0.02)


def test_the_weights_are_found_without_noise():
    """Nothing but the wrong guess: the mixture is identified, and with it the state."""
    x, y = data(np.random.default_rng(0), 25, w=0.0)
    mhe = polytopic(solver=DualIterations(100), horizon=12.0, cost=DiscountedCost(P=[1e-3] * 5, Q=1e4, R=1e4))
    state = mhe.init(x=[0.0, 0.0])
    for k in range(12):
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(float(k), y[k])), float(k))
    np.testing.assert_allclose(estimate.p, TRUE, atol=0.05)
    np.testing.assert_allclose(estimate.x, x[11], atol=0.01)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 5))
def test_least_squares_on_the_simplex_meets_its_optimality_conditions(seed, q):
    """No admissible direction decreases the residual: every vertex lies uphill of the solution."""
    rng = np.random.default_rng(seed)
    J, b = rng.normal(size=(7, q)), rng.normal(size=7)
    a = simplex_least_squares(J, b)
    assert a.min() >= 0 and a.sum() == pytest.approx(1.0)
    slope = J.T @ (J @ a - b)
    assert (slope - slope @ a >= -1e-8).all()


def continuous(**changes):
    """A polytope of two oscillators in continuous time, sampled when it likes."""
    A = [[[0, 1.0], [-1.0, -0.1]], [[0, 1.0], [-9.0, -0.5]]]
    model = polytope(A, [[1.0, 0.0]])
    cost = DiscountedCost(P=np.diag([1e-2, 1e-2, 1e-3, 1e-3]), Q=1e3, R_point=1e4)
    options = dict(horizon=3.0, interval=0.25, integrator=Exact(0.1), cost=cost, bounds=SIMPLEX, hold="point")
    return model, MHE(model, solver=DualIterations(150), **(options | changes))


def test_continuous_time_polytopes_take_irregular_samples(rng):
    """Samples within cells, exact over every gap: the weights of an oscillator between two are found."""
    model, mhe = continuous()
    truth = ContinuousModel(
        lambda t, x, u, w, p: (x[1], -5.0 * x[0] - 0.3 * x[1]), lambda t, x, u, w, p: x[0], x=["a", "b"], y=["y"]
    )
    exact = MHE(truth, horizon=9.0, interval=0.1, integrator=Exact(0.05), cost=DiscountedCost(Q=[]), hold="point")
    start = exact.init(x=[1.0, 0.0])
    state, estimate = mhe.init(x=[0.5, 0.5], p=[0.9, 0.1]), None
    for t in np.sort(rng.uniform(0, 3.0, 30)):
        x, _ = exact.carry(start, 0.0, float(t), np.array([1.0, 0.0]), np.empty(0))
        state = mhe.observe(state, Measurement(float(t), x[:1]))
    state, estimate = mhe.estimate(state, 3.0)
    assert estimate.p[0] == pytest.approx(0.5, abs=0.03) and estimate.p.sum() == pytest.approx(1.0)
    x, _ = exact.carry(start, 0.0, 3.0, np.array([1.0, 0.0]), np.empty(0))
    np.testing.assert_allclose(estimate.x, x, atol=0.05)
    assert len(model.p) == 2


def test_polytopes_run_under_triggers_and_continue_from_files(tmp_path):
    """Simulated with send-on-delta; a state saved half-way, with the adaptive prior's memory, goes on alike."""
    mhe = polytopic(prior=AdaptiveArrival(1e-2, 5.0))
    A = mixture(VERTICES, TRUE)
    plant = DiscreteModel(
        lambda t, x, u, w, p: ca.DM(A) @ x + w, lambda t, x, u, w, p: ca.DM(C) @ x,
        x=["x1", "x2"], w=["w_x1", "w_x2"], y=["y1"], step=1.0,
    )  # fmt: skip
    run = simulate(
        MapPlant(plant), mhe, trigger=SendOnDelta(0.1) | MaxInterval(4.0), until=30.0, guess=[0.0, 0.0],
        truth=[2.0, -1.0], channel=SingleSample(), disturbance=Uniform(0.1, interval=1.0),
    )  # fmt: skip
    assert run.samples > 5 and run.online_rms(since=10.0) < 0.6
    _, y = data(np.random.default_rng(1), 16)
    state = mhe.init(x=[0.0, 0.0])
    for k in range(10):
        state, _ = mhe.estimate(mhe.observe(state, Measurement(float(k), y[k])), float(k))
    mhe.save(state, tmp_path / "state.npz")
    ends = []
    for start in (state, mhe.load(tmp_path / "state.npz"), state):
        branch = start
        for k in range(10, 16):
            branch, estimate = mhe.estimate(mhe.observe(branch, Measurement(float(k), y[k])), float(k))
        ends.append(np.concatenate([estimate.x, estimate.p, [estimate.cost]]))
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])


def test_a_solve_that_is_repeated_renews_the_arrival_cost_once():
    """Estimating again at one time has the prior of the first time, and renews what was there before both."""
    mhe, (_, y) = polytopic(prior=AdaptiveArrival(1e-2, 5.0), horizon=3.0), data(np.random.default_rng(2), 9)
    state = mhe.init(x=[0.0, 0.0])
    for k in range(8):
        state, first = mhe.estimate(mhe.observe(state, Measurement(float(k), y[k])), float(k))
    again, second = mhe.estimate(state, 7.0)
    np.testing.assert_array_equal(second.prior, first.prior)
    assert second.cost <= first.cost * (1 + 1e-9)  # the iterations go on, in the same problem
    before, after = (value.memory["adaptive"].arrays()[1][0] for value in (state, again))
    np.testing.assert_array_equal(before, after)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(1e-4, 10.0), st.floats(1e-3, 100.0))
def test_the_arrival_cost_is_recursive_least_squares(seed, size, sigma):
    """(8): the information P^-1 + v v', divided by the forgetting factor if the trace allows; positive definite."""
    rng = np.random.default_rng(seed)
    root, v = rng.normal(size=(3, 3)), rng.normal(size=3)
    P = root @ root.T + 0.1 * np.eye(3)
    found = renewed(P, v, size, sigma, 20.0)
    W = np.linalg.inv(np.linalg.inv(P) + np.outer(v, v))
    theta = 1 - size / ((1 + v @ P @ v) * sigma)
    forget = theta > 0 and np.trace(W) / theta <= 20.0
    np.testing.assert_allclose(found, W / theta if forget else W, rtol=1e-6, atol=1e-9)
    assert np.linalg.eigvalsh(found)[0] > 0


def test_bad_weights_and_polytopes_are_named_and_the_estimate_is_usable(rng):
    """Off the simplex: projected, with a note. Data that no mixture explains: a note, and an estimate."""
    _, y = data(rng, 8)
    mhe = polytopic()
    state = feed(mhe, mhe.init(x=[0.0, 0.0], p=[0.9, 0.9, 0.1]), np.arange(8.0), y)
    _, estimate = mhe.estimate(state, 5.0)
    assert "projected onto it" in str(estimate.status) and estimate.p.sum() == pytest.approx(1.0)
    far = polytopic(solver=DualIterations(20, misfit=20.0))
    _, wild = data(rng, 8, A=np.array([[0.0, -3.0], [1.5, -1.0]]))
    _, estimate = far.estimate(feed(far, far.init(x=[2.0, -1.0]), np.arange(8.0), wild), 5.0)
    assert "no mixture explains the window" in str(estimate.status)
    assert np.isfinite(estimate.x).all() and estimate.p.sum() == pytest.approx(1.0)
    _, fine = far.estimate(feed(far, far.init(x=[0.0, 0.0]), np.arange(8.0), y), 5.0)
    assert "no mixture" not in str(fine.status)


def test_bounds_hold_in_both_turns(rng):
    """Disturbances and residuals in boxes that bind: kept; in boxes that no mixture meets: a prediction, said so."""
    _, y = data(rng, 8, w=0.3)
    loose = polytopic(horizon=20.0)
    _, free = loose.estimate(feed(loose, loose.init(x=[1.0, 0.0]), np.arange(8.0), y), 7.0)
    box = 0.7 * float(np.abs(free.trajectory.w).max())
    tight = polytopic(horizon=20.0, bounds=Bounds(p=(0.0, 1.0), w=(-box, box)))
    _, estimate = tight.estimate(feed(tight, tight.init(x=[1.0, 0.0]), np.arange(8.0), y), 7.0)
    assert np.abs(estimate.trajectory.w).max() <= box * (1 + 1e-6) and estimate.cost >= free.cost * (1 - 1e-6)
    never = polytopic(horizon=20.0, bounds=Bounds(p=(0.0, 1.0), w=(-1e-4, 1e-4), residual=(-1e-4, 1e-4)))
    _, estimate = never.estimate(feed(never, never.init(x=[1.0, 0.0]), np.arange(8.0), y), 7.0)
    assert estimate.status.outcome is Outcome.PREDICTED and np.isfinite(estimate.x).all()


def test_wrong_vertices_starts_and_settings_are_named():
    """Every error says what was given and what is needed."""
    with pytest.raises(InputError, match="no vertices"):
        polytope([], C)
    with pytest.raises(InputError, match="vertex 2"):
        polytope([VERTICES[0], np.eye(3)], C)
    with pytest.raises(InputError, match="2 vertices A but 3 of C"):
        polytope(VERTICES[:2], [C, C, C])
    with pytest.raises(InputError, match=r"sum 1\.2"):
        polytope(VERTICES, C, start=[0.4, 0.4, 0.4])
    with pytest.raises(InputError, match=">= 0"):
        mixture(VERTICES, [1.5, -0.5, 0.0])
    with pytest.raises(InputError, match="disturbance on every state"):
        model = linear_model(np.eye(2), [[1.0], [0.0]], C)
        MHE(model, horizon=2, interval=1, integrator=RK4(1), cost=DiscountedCost(), solver=DualIterations())
    with pytest.raises(InputError, match="DualIterations"):
        polytopic(solver="dual")
    for wrong in ({"iterations": 0}, {"iterations": 1.5}, {"tolerance": 0.0}, {"misfit": -1.0}):
        with pytest.raises(InputError, match="DualIterations"):
            DualIterations(**wrong)
    with pytest.raises(InputError, match="sigma"):
        AdaptiveArrival(0.0, 1.0)
    with pytest.raises(InputError, match="positive definite"):
        polytopic(prior=AdaptiveArrival(1.0, 1.0), cost=DiscountedCost(P=np.zeros((5, 5)))).init(x=[0.0, 0.0])


def test_the_printed_numbers_of_iterations_and_steps():
    """(33): doubling the ratio asks for one iteration more. (66): linear in the constants when eta = 1."""
    assert dual_iterations(1.0, 0.0, 0.5, 0.5) == 2  # log2(1 + 1) + 1
    assert dual_iterations(3.0, 0.0, 0.5, 0.5) == 3
    assert dual_iterations(0.1, 1.0, 1.0, 0.5) == 1  # the prior alone is more than asked for
    with pytest.raises(InputError, match="epsilon"):
        dual_iterations(1.0, 0.0, 1.0, 2.0)
    constants = dict(c_beta=1.0, p=1.0, q=1.0, a=1.0, c_prior=(1.0, 1.0), c_1=0.0, c_2=0.0, b_1=1.0, b_2=1.0)
    # k1 = 2, k2 = 25 * 2: N >= 2 (1 + 1) 52 e / r
    assert polytopic_horizon(**constants, error=1.0, largest_error=4.0, epsilon=1.0) == 52
    assert polytopic_horizon(**constants, error=1.0, largest_error=4.0, epsilon=1.0, shrink=0.5) == 27
    with pytest.raises(InputError, match="q >= p / a"):
        polytopic_horizon(**(constants | {"q": 0.5}), error=1.0, largest_error=1.0)


def test_the_library_polytope_starts_at_the_nominal_model():
    """The weights when none are given are those of the model of the paper."""
    np.testing.assert_allclose(unknown_linear().p_start, [0.41, 0.22, 0.37])
