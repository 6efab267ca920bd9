"""Real-time limits: iterations, deadlines; and the check of every solve against IPOPT."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from ctmhe.errors import InputError, NotEstimated, SolverError
from ctmhe.estimators import MHE
from ctmhe.models.library import batch_reactor, hover_speed, quadrotor
from ctmhe.solvers import binding
from ctmhe.solvers.verification import verify
from ctmhe.transcription import CVODES, RK4
from ctmhe.types import Bounds, DiscountedCost, Input, Measurement, Outcome
from tests.conftest import REACTOR_COST
from tests.solvers.test_slots import pendulum

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


def same(a, b) -> None:
    """Two estimates with their windows, bit for bit."""
    assert a._solved.blocks == b._solved.blocks
    results = [(e.cost, e.status.outcome, e.status.optimality, e.status.iterations) for e in (a, b)]
    np.testing.assert_equal(*results)


def driven(**changes) -> MHE:
    """A pendulum with an input, a parameter and two sensors."""
    options = dict(horizon=1.0, interval=0.1, integrator=RK4(0.05), hold="point", max_iterations=1)
    cost = DiscountedCost(P=np.diag([4.0, 4.0, 20.0]), Q=50.0, R=[100.0, 50.0], eta=0.7)
    bounds = Bounds(x={"angle": (-2.0, 0.75)}, residual=(-0.5, 0.5))
    return MHE(pendulum(), cost=cost, **(options | dict(bounds=bounds) | changes))


def started(mhe: MHE, rng, until: float = 1.7):
    """A state in the middle of a run, and the next measurement."""
    state, t = mhe.control(mhe.init(x=[0.5, 0.2]), Input(0.0, [0.3])), 0.0
    while t < until:
        t += rng.uniform(0.03, 0.12)
        sample = Measurement(t, [np.sin(0.7 * np.cos(t)) + 0.02 * rng.normal(), 0.02 * rng.normal()])
        state, _ = mhe.estimate(mhe.observe(state, sample), t)
    return state, t + 0.07


@pytest.mark.parametrize("compile", ["off", "auto"])
@pytest.mark.parametrize("hold", ["point", "zero"])
@pytest.mark.parametrize("iterations", [1, None])
def test_a_prepared_estimate_is_the_estimate(compile, hold, iterations, rng):
    """Whatever arrives afterwards: what was expected, less, more, late, another input, another time, or nothing."""
    mhe = driven(compile=compile, hold=hold, max_iterations=iterations)
    state, t = started(mhe, rng)
    full = Measurement(t, [0.4, -0.1])
    arrivals = {
        "as expected": [full],
        "one sensor": [Measurement(t, {"two": -0.1})],
        "nothing": [],
        "late": [Measurement(t - 0.2, [0.5, 0.0]), full],
        "in between": [Measurement(t - 0.02, [0.42, -0.1]), full],
        "outlier": [Measurement(t, [5.0, 3.0])],
        "another input": [full, Input(t - 0.1, [0.1])],
    }
    if iterations is None:
        del arrivals["outlier"]  # which no bound on the residual allows: the ladder takes its time
    for what, values in arrivals.items():
        for time in (t, t + 0.01):
            plain, prepared = state, mhe.prepare(state, time)
            assert (prepared.prepared is None) == (mhe._updates is None), what
            for value in values:
                give = mhe.observe if isinstance(value, Measurement) else mhe.control
                plain, prepared = give(plain, value), give(prepared, value)
            result = mhe.estimate(prepared, t)  # uses up what was prepared
            expected = mhe.estimate(plain, t)
            same(result[1], expected[1])
            same(mhe.estimate(prepared, t)[1], expected[1])
            assert result[0].prepared is None
            following = [mhe.estimate(after, t + 0.1)[1] for after in (result[0], expected[0])]
            same(*following)


def test_a_prepared_quadrotor_is_the_quadrotor(rng):
    """12 states in the kernels for many variables; only some sensors are expected."""
    model = quadrotor(noise=False)
    cost = DiscountedCost(P=10.0, Q=10.0, R_point=2.5e3, eta=0.92)
    mhe = MHE(model, horizon=0.6, interval=0.05, integrator=RK4(0.05), cost=cost, hold="point", max_iterations=1)
    state = mhe.control(mhe.init(x=np.zeros(12)), Input(0.0, [hover_speed()] * 4))
    for k in range(1, 20):
        expected = model.y.names[: 3 if k % 2 else 6]
        ready = mhe.prepare(state, 0.05 * k, outputs=expected)
        sample = Measurement(0.05 * k, dict(zip(expected, 0.02 * rng.normal(size=len(expected)), strict=True)))
        plain, prepared = mhe.observe(state, sample), mhe.observe(ready, sample)
        state, estimate = mhe.estimate(prepared, 0.05 * k)
        same(estimate, mhe.estimate(plain, 0.05 * k)[1])


def test_after_preparation_only_the_newest_slot_is_linearised(monkeypatch):
    """Counted on a model that CasADi evaluates slot by slot: CVODES."""
    counts = {2: 0, 3: 0}
    original = binding._guarded

    def counting(trigger, buffer, failed):
        inner, results = original(trigger, buffer, failed), buffer_results.pop(0)

        def run(self):
            counts[results] += 1
            inner(self)

        return run

    buffer_results = [2, 3]  # value, then jacobian
    monkeypatch.setattr(binding, "_guarded", counting)
    mhe = reactor(integrator=CVODES(), hold="point", max_iterations=1, bounds=None)
    if mhe._updates is None:
        pytest.skip("no compiled core")
    state = mhe.init(x=[2.5, 1.5])
    for k in range(1, 8):
        state, _ = mhe.estimate(mhe.observe(state, Measurement(0.1 * k, [4.0 - 0.03 * k])), 0.1 * k)
    ready = mhe.prepare(state, 0.8)
    counts.update({2: 0, 3: 0})
    mhe.estimate(mhe.observe(ready, Measurement(0.8, [3.75])), 0.8)
    assert counts[3] == 1
    mhe.estimate(mhe.observe(state, Measurement(0.8, [3.75])), 0.8)
    assert counts[3] == 1 + 8


def test_preparing_for_the_past_or_an_unknown_sensor_is_refused():
    """Names, and a time before the last estimate."""
    mhe = reactor()
    state, _ = mhe.estimate(mhe.observe(mhe.init(x=[2.5, 1.5]), Measurement(0.1, [4.0])), 0.1)
    with pytest.raises(NotEstimated, match="before the last estimate"):
        mhe.prepare(state, 0.05)
    with pytest.raises(InputError, match="nonsense"):
        mhe.prepare(state, 0.2, outputs=["nonsense"])


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
