"""Real-time limits: iterations, deadlines; and the check of every solve against IPOPT."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ctmhe.errors import InputError, SolverError
from ctmhe.estimators import MHE
from ctmhe.models.library import batch_reactor
from ctmhe.solvers.verification import verify
from ctmhe.transcription import RK4
from ctmhe.types import Bounds, DiscountedCost, Measurement, Outcome
from tests.conftest import REACTOR_COST

SOLVERS = ["gauss-newton", "numpy"]


def reactor(**changes) -> MHE:
    """The batch reactor with its bounds."""
    model = batch_reactor()
    options = dict(interval=0.1, integrator=RK4(0.05), cost=REACTOR_COST, bounds=model.bounds)
    return MHE(model, horizon=1.0, **(options | changes))


def run(mhe: MHE, count: int = 40, guess=(2.5, 1.5), seed: int = 3):
    """Irregular samples of a decaying pressure with an estimate at each; all estimates."""
    rng, state, t, found = np.random.default_rng(seed), mhe.init(x=guess), 0.0, []
    for _ in range(count):
        t += rng.exponential(0.06) + 1e-3
        state = mhe.observe(state, Measurement(t, [4.0 - 0.35 * min(t, 3.0) + 0.02 * rng.normal()]))
        state, estimate = mhe.estimate(state, t + 0.01)
        found.append(estimate)
    return state, found


@pytest.mark.parametrize("solver", SOLVERS)
def test_one_iteration_an_update_tracks_the_optimum(solver):
    """The real-time iteration asks no other solver, and stays within the measurement noise of the optimum."""
    _, found = run(reactor(solver=solver, max_iterations=1))
    _, best = run(reactor(solver=solver))
    assert all(e.status.factorizations <= 3 and e.status.iterations == 1 and not e.status.rungs for e in found)
    assert {e.status.outcome for e in found} <= {Outcome.ITERATION_LIMIT, Outcome.SOLVED}
    assert all(e.status.success == (e.status.outcome is Outcome.SOLVED) for e in found)
    late = slice(20, None)
    np.testing.assert_allclose([e.x for e in found[late]], [e.x for e in best[late]], atol=0.02)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_deadline_ends_a_solve_between_two_iterations(solver):
    """By an injected clock: the best iterate so far, said so, finite and inside the bounds; the run goes on."""
    ticks = itertools.count()
    mhe = reactor(solver=solver, deadline=2.5, clock=lambda: float(next(ticks)))
    state, found = run(mhe, guess=(0.2, 4.0))
    outcomes = [e.status.outcome for e in found]
    assert Outcome.DEADLINE in outcomes
    assert set(outcomes) <= {Outcome.DEADLINE, Outcome.SOLVED}
    for estimate in found:
        assert estimate.status.iterations <= 3
        assert np.isfinite(estimate.trajectory.x).all() and (estimate.trajectory.x >= 0.1 - 1e-9).all()
    relaxed = reactor(solver=solver, deadline=1e9, clock=lambda: float(next(ticks)))
    _, estimate = relaxed.estimate(state, found[-1].t + 0.01)
    assert estimate.status.outcome is Outcome.SOLVED


def test_limits_that_make_no_sense_are_refused():
    """Not positive, and for IPOPT."""
    with pytest.raises(InputError, match="deadline must be a positive number"):
        reactor(deadline=0.0)
    with pytest.raises(InputError, match="IPOPT runs to convergence"):
        reactor(solver="ipopt", max_iterations=3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solve_of_a_run_stands_the_check(solver):
    """verify=True raises nowhere: free, at bounds of state, disturbance and residual, and with a parameter."""
    joint = DiscountedCost(eta=0.5, P=np.diag([8.0, 7.1, 50.0]), Q=2e3, R=1e2)
    run(reactor(solver=solver, verify=True), count=15)
    box = Bounds(x=(0.1, 2.3), w=(-0.05, 0.05), residual=(-0.2, 0.2))
    _, found = run(reactor(solver=solver, verify=True, bounds=box), count=15)
    assert any(estimate.active["x"].any() or estimate.active["w"].any() for estimate in found)
    model = batch_reactor(noise=False, parameters=("k1",))
    options = dict(interval=0.1, integrator=RK4(0.05), cost=joint, bounds=Bounds(x=(0.1, 5.0), p=(0.1, 0.2)))
    run(MHE(model, horizon=1.0, solver=solver, verify=True, **options), count=15)


def test_the_check_notices_a_wrong_solution():
    """A point off the optimum, a forgotten active bound, a flipped multiplier."""
    mhe = reactor(bounds=Bounds(x={"pB": (0.1, 1.3)}))
    state, _ = run(mhe, count=10, guess=(2.9, 1.1))
    t = state.t + 0.05
    window, _ = mhe._window(state, t)
    _, estimate = mhe.estimate(state, t)
    solved = estimate._solved
    verify(window, solved, estimate.cost, mhe._reference)
    held = solved.part("x_active")
    assert held.any()

    def changed(**parts):
        arrays = {
            name: solved.part(name).copy() for name in solved.layout.parts(solved.n) if "_" in name or name in "xwypt"
        }
        return type(solved).of(solved.layout, arrays | parts)

    with pytest.raises(SolverError, match="IPOPT continues to"):
        verify(window, solved, estimate.cost * (1 + 1e-6), mhe._reference)
    with pytest.raises(SolverError, match="multiplier has the wrong sign"):
        verify(window, changed(x_active=-held), estimate.cost, mhe._reference)
    with pytest.raises(SolverError, match="another active set"):
        verify(window, changed(x_multiplier=0 * solved.part("x_multiplier")), estimate.cost, mhe._reference)
