"""The discrete-time scheme (3.6) in all its forms, against the problem written out in CasADi for IPOPT."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ctmhe.estimators import MHE
from ctmhe.models import DiscreteModel
from ctmhe.types import Bounds, DiscountedCost, Measurement

STEP, N, ETA = 0.1, 6, 0.9
P, Q, R, S = np.array([[2.0, 0.3], [0.3, 1.0]]), np.diag([50.0, 80.0, 20.0]), 9.0, 5.0
LOW, HIGH = 0.1, 4.5


def step(x, w):
    """One Euler step of the reactor with process noise."""
    rate = 0.16 * x[0] ** 2 - 0.0064 * x[1]
    return ca.vertcat(x[0] - 2 * STEP * rate + w[0], x[1] + STEP * rate + w[1])


def written_out(y, prior, filtering, weight, terminal):
    """Minimise (3.6) over a window with outputs y (n + 1,): the states (n + 1, 2) and the cost."""
    n = len(y) - 1
    opti = ca.Opti()
    x, w = opti.variable(2, n + 1), opti.variable(3, n + 1)
    cost = ETA**n * ca.bilin(ca.DM(weight), x[:, 0] - prior)
    for j in range(n + (1 if filtering else 0)):
        fade = ETA ** (n - j if filtering else n - j - 1)
        cost += fade * (ca.bilin(ca.DM(Q), w[:, j]) + R * (ca.sum1(x[:, j]) + w[2, j] - y[j]) ** 2)
    if terminal:  # (6.7): the newest output, noise of its own in the filtering form
        cost += S * (ca.sum1(x[:, n]) + (w[2, n] if filtering else 0) - y[n]) ** 2
    for j in range(n):
        opti.subject_to(x[:, j + 1] == step(x[:, j], w[:, j]))
    opti.subject_to(opti.bounded(LOW, ca.vec(x), HIGH))
    if not filtering:
        opti.subject_to(w[:, n] == 0)
    opti.minimize(cost)
    opti.set_initial(x, np.tile([[2.0], [1.5]], n + 1))
    opti.solver("ipopt", {"print_time": 0}, {"print_level": 0, "sb": "yes", "tol": 1e-11})
    solution = opti.solve()
    return np.asarray(solution.value(x)).T, float(solution.value(cost))


@pytest.mark.parametrize("filtering", [False, True])
@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("terminal", [False, True])
def test_every_form_is_the_written_problem(filtering, weighted, terminal, rng):
    """Prediction and filtering form, with and without prior weighting (6.46), with and without (6.7), bounds active."""
    model = DiscreteModel(
        lambda t, x, u, w, p: step(x, w), lambda t, x, u, w, p: x[0] + x[1] + w[2],
        x=["pA", "pB"], w=["wA", "wB", "v"], y=["pressure"], step=STEP,
    )  # fmt: skip
    weight = P if weighted else np.zeros((2, 2))
    cost = DiscountedCost(P=weight, Q=Q, R=R, eta=ETA, S=S if terminal else None)
    mhe = MHE(model, horizon=N * STEP, cost=cost, bounds=Bounds(x=(LOW, HIGH)), filtering=filtering)
    state, prior = mhe.init(x=[0.1, 4.5]), {0: np.array([0.1, 4.5])}
    truth, y = np.array([3.0, 1.0]), []
    for k in range(11):
        y.append(float(truth.sum() + 0.3 * rng.uniform(-1, 1)))
        truth = np.asarray(step(truth, 0.02 * rng.uniform(-1, 1, 3))).reshape(-1)
        state = mhe.observe(state, Measurement(k * STEP, y[-1:]))
        state, estimate = mhe.estimate(state, k * STEP)
        prior[k] = estimate.x if k else prior[0]  # the filtering prior (3.18)
        if k in (4, 10):
            first = max(k - N, 0)
            start = estimate.prior
            if weighted and first:
                np.testing.assert_allclose(start, prior[first], atol=1e-9)
            x, value = written_out(y[first:], start, filtering, weight, terminal)
            assert estimate.cost == pytest.approx(value, rel=1e-6, abs=1e-9)
            if weighted:
                np.testing.assert_allclose(estimate.x, x[-1], atol=1e-4)
