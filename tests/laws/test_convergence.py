"""Orders of convergence, and what refinement must not change."""

from __future__ import annotations

import numpy as np
import pytest

from ctmhe.estimators import MHE
from ctmhe.models.library import batch_reactor
from ctmhe.transcription import CVODES, RK4
from tests.conftest import REACTOR_COST, feed


def solve(integrator, interval, hold="linear", end=1.2):
    """One window of the reactor with fixed smooth data."""
    model = batch_reactor()
    mhe = MHE(
        model, horizon=2.0, interval=interval, integrator=integrator, cost=REACTOR_COST, hold=hold, tolerance=1e-15
    )
    times = np.arange(0, 7) * 0.2
    rows = (4.0 - 0.9 * np.tanh(times))[:, None]
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[2.5, 1.4]), times, rows), end)
    assert estimate.status.success
    return estimate


@pytest.mark.parametrize("hold", ["zero", "linear", "point"])
def test_refining_the_integration_step_converges_at_order_4(hold):
    """Cells and data fixed: the minimiser's error falls by 16 when the step is halved."""
    exact = solve(RK4(0.2 / 64), 0.2, hold)
    errors = [np.abs(solve(RK4(0.2 / n), 0.2, hold).x - exact.x).max() for n in (1, 2, 4)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 3.5).all() and (orders < 5.0).all(), orders


def test_refining_the_cells_converges_at_order_2():
    """Piecewise constant w approaches the continuous disturbance at order 2 in the estimate."""
    step = RK4(0.0125)
    exact = solve(step, 0.0125)
    errors = [np.abs(solve(step, h).x - exact.x).max() for h in (0.4, 0.2, 0.1)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.5).all(), orders


def test_cvodes_and_rk4_agree_to_their_tolerances():
    """Two integrators with different quadratures (Gauss, augmented RK4) meet at the same minimiser."""
    np.testing.assert_allclose(solve(CVODES(1e-10, 1e-12), 0.1).x, solve(RK4(0.1 / 32), 0.1).x, atol=1e-7)


def test_splitting_a_slot_where_a_step_ends_changes_nothing():
    """An edge that coincides with a step's end (here a sample that repeats the held value) leaves the estimate."""
    model = batch_reactor()
    estimates = []
    for horizon in (1.0, 1.0):
        options = dict(interval=0.2, integrator=RK4(0.05), cost=REACTOR_COST, tolerance=1e-14)
        mhe = MHE(model, horizon=horizon, **options)
        state = feed(mhe, mhe.init(x=[2.5, 1.4]), [0.0, 0.4], [[4.0], [3.8]])
        if estimates:  # the same held value again, at a step's end inside a cell
            state = feed(mhe, state, [0.25], [[4.0]])
        estimates.append(mhe.estimate(state, 0.8)[1])
    assert len(estimates[0].trajectory.t) + 1 == len(estimates[1].trajectory.t)
    np.testing.assert_allclose(estimates[0].x, estimates[1].x, rtol=0, atol=1e-9)
    steps, split = (np.array(e.trajectory.t) for e in estimates)
    np.testing.assert_allclose(
        estimates[0].trajectory.x, estimates[1].trajectory.x[np.isin(split, steps)], rtol=0, atol=1e-9
    )


def test_splitting_a_slot_inside_a_step_only_refines_it():
    """An extra edge inside a step changes the result by less than the step's own error."""
    estimates = []
    for extra in ([], [0.333]):
        mhe = MHE(batch_reactor(), horizon=1.0, interval=0.2, integrator=RK4(0.05), cost=REACTOR_COST)
        state = feed(mhe, mhe.init(x=[2.5, 1.4]), [0.0, 0.4, *extra], [[4.0], [3.8], *[[4.0] for _ in extra]])
        estimates.append(mhe.estimate(state, 0.8)[1])
    assert len(estimates[1].trajectory.t) == len(estimates[0].trajectory.t) + 1
    np.testing.assert_allclose(estimates[0].x, estimates[1].x, atol=1e-6)
    w = estimates[1].trajectory.w
    t = estimates[1].trajectory.t
    k = int(np.searchsorted(t, 0.333))
    np.testing.assert_allclose(w[k - 1], w[k], rtol=1e-12)  # slots of one cell share w


def test_a_signal_that_expires_between_steps_does_so_at_its_time():
    """hold_limit ends inside a step: the instant is an edge, so refinement still converges at order 4."""
    from ctmhe.types import DiscountedCost
    from tests.conftest import linear_model

    model = linear_model([[0, 1], [-1, 0]], np.eye(2), [[1.0, 0.0]])
    cost = DiscountedCost(P=1.0, Q=1.0, R=10.0)

    def end(step):
        mhe = MHE(model, horizon=1, interval=0.1, integrator=RK4(step), cost=cost, hold_limit=0.2)
        return mhe.estimate(feed(mhe, mhe.init(x=[0, 0]), [0.033], [[1.0]]), 0.5)[1].x

    errors = [np.abs(end(0.1 / n) - end(0.1 / 32)).max() for n in (1, 2)]
    assert errors[0] < 1e-5 and errors[0] / errors[1] > 10
