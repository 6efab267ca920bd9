"""The estimator's contracts: windows, trajectory, gaps, late data, bad input."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError, NotEstimated, TooLate
from ctmhe.estimators import MHE
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import batch_reactor
from ctmhe.transcription import CVODES, RK4
from ctmhe.types import Bounds, DiscountedCost, Input, Measurement, Outcome
from tests.conftest import REACTOR_COST, feed, linear_model, oscillator_mhe

DRIVEN = {
    hold: MHE(
        ContinuousModel(
            lambda t, x, u, w, p: (x[1], ca.sin(x[0]) + u[0] + w[0]),
            lambda t, x, u, w, p: (x[0] * x[1] + u[0], x[1]),
            x=("a", "b"), u="force", w="push", y=("mixed", "speed"),
        ),
        horizon=3.0, interval=0.2, integrator=RK4(0.05), cost=DiscountedCost(P=1.0, Q=1.0, R_point=1.0), hold="point",
        input_hold=hold,
    )
    for hold in ("zero", "linear")
}  # fmt: skip


def reactor_mhe(**changes):
    """The reactor of thesis 3.4.1 on a coarse grid."""
    model = batch_reactor()
    options = dict(horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=REACTOR_COST, bounds=model.bounds)
    return MHE(model, **(options | changes))


def test_the_window_grows_and_then_moves():
    """T_i = min(t - t0, T)."""
    mhe = reactor_mhe()
    state = mhe.init(t=2.0, x=[2, 1])
    for t in (2.25, 2.9, 3.0, 3.35):
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(t - 0.05, [4.0])), t)
        assert estimate.trajectory.t[0] == pytest.approx(max(2.0, t - 1.0), abs=1e-12)
        assert estimate.trajectory.t[-1] == t


def test_the_prior_is_the_estimated_trajectory_at_the_windows_edge():
    """(3.18): the first solve at or after t - T, evaluated there by integration, never rewritten (3.16)."""
    mhe = reactor_mhe()
    state = mhe.init(x=[0.1, 4.5])
    estimates = []
    for t in (0.31, 0.77, 1.0, 1.52):
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(t, [3.9 - 0.3 * t])), t)
        estimates.append(estimate)
        if t < 1.0:
            recorded = mhe.trajectory(state, 0.52 if t > 0.6 else 0.3)
    edge = 1.52 - 1.0
    source = estimates[1].trajectory  # k(0.52) = 0.77
    k = int(np.searchsorted(source.t, edge)) - 1
    nothing = np.empty(0)
    x, _ = mhe.stage.step(source.t[k], edge - source.t[k], source.x[k], source.w[k], nothing, nothing, nothing)
    np.testing.assert_allclose(estimates[-1].prior, x, rtol=1e-12)
    np.testing.assert_allclose(recorded, x, rtol=1e-9)


def test_the_trajectory_is_left_continuous_and_starts_at_the_guess():
    """At a solve instant the older piece counts; at t0 the initial guess."""
    mhe = reactor_mhe()
    state = mhe.init(x=[0.1, 4.5])
    np.testing.assert_array_equal(mhe.trajectory(state, 0.0), [0.1, 4.5])
    state, first = mhe.estimate(mhe.observe(state, Measurement(0.1, [4.0])), 0.3)
    state, second = mhe.estimate(mhe.observe(state, Measurement(0.4, [3.7])), 0.5)
    np.testing.assert_array_equal(mhe.trajectory(state, 0.3), first.x)
    np.testing.assert_array_equal(mhe.trajectory(state, 0.5), second.x)
    assert np.abs(mhe.trajectory(state, 0.3 + 1e-9) - first.x).max() > 1e-6  # the jump between pieces
    with pytest.raises(NotEstimated, match="trajectory"):
        mhe.trajectory(state, 0.6)


def test_a_gap_longer_than_the_horizon_is_bridged_and_marked():
    """The prior is the prediction, its weight relaxed, the status says so."""
    mhe = reactor_mhe()
    state, before = mhe.estimate(mhe.observe(mhe.init(x=[2, 1]), Measurement(0.1, [3.0])), 0.2)
    predicted = mhe.predict(state, 2.5).x
    state, after = mhe.estimate(mhe.observe(state, Measurement(3.4, [2.9])), 3.5)
    assert "prior predicted, uncertified" in after.status.notes
    np.testing.assert_allclose(after.prior, predicted, rtol=1e-9)
    assert after.status.success and before.status.notes == ()


def test_without_a_measurement_the_prior_is_carried_forward():
    """Nothing measured: w = 0, the prior integrated over the window, and the status says it."""
    mhe = reactor_mhe()
    state, estimate = mhe.estimate(mhe.init(x=[2.0, 1.0]), 0.6)
    np.testing.assert_allclose(estimate.x, mhe.propagate(state, 0.0, 0.6, np.array([2.0, 1.0]), np.empty(0)), rtol=1e-9)
    assert "no measurement in window" in estimate.status.notes
    assert estimate.cost == pytest.approx(0, abs=1e-12)


def test_estimating_at_the_start_itself_uses_a_point_sample_there():
    """t = t0: only the prior and a sample at t0, with the static least squares solution."""
    mhe = MHE(
        linear_model([[-1.0]], [[1.0]], [[1.0]]),
        horizon=1,
        interval=0.1,
        integrator=RK4(0.1),
        cost=DiscountedCost(P=2.0, Q=1.0, R=6.0),
        hold="point",
    )
    _, estimate = mhe.estimate(mhe.observe(mhe.init(x=[1.0]), Measurement(0.0, [2.0])), 0.0)
    assert estimate.x[0] == pytest.approx((2 * 1 + 6 * 2) / 8)
    assert estimate.covariance[0, 0] == pytest.approx(1 / 8)


def test_a_late_measurement_inside_the_window_improves_the_next_estimate():
    """It arrives after an estimate, is accepted, and gives what timely arrival gives but for the prior's path."""
    mhe = oscillator_mhe(hold="point")
    state = feed(mhe, mhe.init(x=[1, 0]), [0.1, 0.9], [[0.5, 0.1], [0.4, -0.2]])
    state, _ = mhe.estimate(state, 1.0)
    late = mhe.observe(state, Measurement(0.5, [3.0, 1.0]))
    timely = feed(mhe, mhe.init(x=[1, 0]), [0.1, 0.5, 0.9], [[0.5, 0.1], [3.0, 1.0], [0.4, -0.2]])
    np.testing.assert_allclose(mhe.estimate(late, 1.1)[1].x, mhe.estimate(timely, 1.1)[1].x, rtol=1e-7)


def test_memory_stays_constant_over_many_measurements():
    """What the state keeps does not grow with the number of measurements (10^5 in the slow test)."""
    sizes = run_long(3000)
    assert max(sizes[len(sizes) // 2 :]) <= max(sizes[: len(sizes) // 2])


@pytest.mark.slow
def test_memory_stays_constant_over_1e5_measurements():
    """10^5 measurements, an estimate every 50: retained rows and pieces stay bounded."""
    sizes = run_long(100_000)
    assert max(sizes[len(sizes) // 2 :]) <= max(sizes[: len(sizes) // 2])


def run_long(count):
    """Return, at each estimate, how many rows the shared storage and the state hold."""
    mhe = MHE(
        linear_model([[-1.0]], [[1.0]], [[1.0]]),
        horizon=0.5,
        interval=0.1,
        integrator=RK4(0.1),
        cost=DiscountedCost(P=1.0, Q=1.0, R=6.0, eta=0.5),
    )
    state, sizes = mhe.init(x=[1.0]), []
    for k in range(count):
        state = mhe.observe(state, Measurement(k * 0.01, [np.sin(k * 0.01)]))
        if k % 50 == 49:
            state, _ = mhe.estimate(state, k * 0.01)
            sizes.append(state.measurements.capacity + state.path.capacity + len(state.inputs))
    return sizes


def test_nothing_is_built_in_the_loop(monkeypatch):
    """300 irregular samples: CasADi creates no function, map or solver after construction."""
    mhe = reactor_mhe()
    built = []
    for name in ("nlpsol", "integrator", "qpsol", "conic", "jacobian"):
        original = getattr(ca, name)
        monkeypatch.setattr(ca, name, lambda *a, _f=original, _n=name, **k: (built.append(_n), _f(*a, **k))[1])
    for name in ("map", "expand", "jacobian", "buffer"):
        original = getattr(ca.Function, name)
        monkeypatch.setattr(ca.Function, name, lambda *a, _f=original, _n=name, **k: (built.append(_n), _f(*a, **k))[1])
    rng = np.random.default_rng(5)
    state = mhe.init(x=[2.0, 1.0])
    state, _ = mhe.estimate(mhe.observe(state, Measurement(0.0, [3.0])), 0.01)  # binds this thread's buffers
    built.clear()
    t = 0.01
    for _ in range(300):
        t += rng.exponential(0.05) + 1e-3
        state = mhe.observe(state, Measurement(t, [3.0 + 0.1 * rng.normal()]))
        state, estimate = mhe.estimate(state, t)
        assert estimate.status.success
    assert built == []


def test_a_dead_sensor_stops_counting_after_the_hold_limit():
    """Its last value is held no longer than hold_limit; afterwards the window is as if it had never spoken."""
    estimates = []
    for dead in ([0.0], []):
        mhe = oscillator_mhe(hold="zero", hold_limit=0.3)
        state = feed(mhe, mhe.init(x=[1, 0]), dead, [[5.0, np.nan] for _ in dead])
        for t in np.arange(0.5, 3.5, 0.5):
            state, estimate = mhe.estimate(mhe.observe(state, Measurement(t, [np.nan, 0.1])), t + 0.25)
        estimates.append(estimate)
    window = estimates[0].trajectory
    assert window.t[0] == pytest.approx(1.25)
    assert estimates[0].status.success
    np.testing.assert_allclose(estimates[0].x, estimates[1].x, atol=0.2)


def test_parameters_are_estimated_when_the_prior_weighs_them():
    """P of size nx holds p; of size nx + np it estimates p, with cross terms."""
    model = batch_reactor(parameters=("k1",))
    times = np.arange(0, 21) * 0.1
    true = reactor_truth(times, 0.25)
    results = {}
    for name, P in (("held", np.eye(2)), ("estimated", [[1, 0, 0.1], [0, 1, 0], [0.1, 0, 0.5]])):
        cost = DiscountedCost(P=P, Q=[1e4, 1e4, 1e2], R=1e3, eta=1.0)
        mhe = MHE(model, horizon=5, interval=0.1, integrator=RK4(0.05), cost=cost, hold="point")
        state = feed(mhe, mhe.init(x=[3.0, 1.0], p=[0.16]), times, true.sum(axis=1, keepdims=True))
        results[name] = mhe.estimate(state, 2.0)[1]
    assert results["held"].p[0] == 0.16
    assert results["estimated"].p[0] == pytest.approx(0.25, abs=0.02)
    assert results["estimated"].covariance.shape == (3, 3)


def reactor_truth(times, k1, k2=0.0064):
    """Reactor states at `times` by scipy."""
    from scipy.integrate import solve_ivp

    rhs = lambda t, x: [-2 * k1 * x[0] ** 2 + 2 * k2 * x[1], k1 * x[0] ** 2 - k2 * x[1]]  # noqa: E731
    return solve_ivp(rhs, (0, times[-1]), [3.0, 1.0], t_eval=times, rtol=1e-10, atol=1e-12).y.T


def test_unobservable_directions_have_infinite_variance_and_lower_rank():
    """A state that nothing measures and no prior weighs: rank 1, infinite variance; the other's is finite."""
    mhe = MHE(
        linear_model(np.zeros((2, 2)), np.eye(2), [[1.0, 0.0]]),
        horizon=2,
        interval=0.1,
        integrator=RK4(0.1),
        cost=DiscountedCost(P=0.0, Q=1.0, R=4.0),
        hold="point",
    )
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0, 0]), [0.5, 1.0], [[1.0], [1.1]]), 1.0)
    assert estimate.rank == 1
    assert np.isinf(estimate.covariance[1, 1]) and np.isfinite(estimate.covariance[0, 0])


@pytest.mark.parametrize("small", [1e-5, 1.0])
def test_the_covariance_does_not_depend_on_units(small):
    """Two measured states, one of size 1e5 and one of `small`, without nominals: full rank, the scaled covariance."""
    sizes = np.array([1e5, small])
    cost = DiscountedCost(P=1 / sizes**2, Q=1 / sizes**2, R=4 / sizes**2)
    mhe = MHE(linear_model(-np.eye(2), np.eye(2), np.eye(2)), horizon=2, interval=0.1, integrator=RK4(0.1), cost=cost,
              hold="point")  # fmt: skip
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0, 0]), [0.5, 1.0], [0.3 * sizes, 0.2 * sizes]), 1.0)
    assert estimate.rank == 2
    normal = estimate.covariance / sizes[:, None] / sizes
    assert normal[0, 0] == pytest.approx(normal[1, 1], rel=1e-6) and 0.05 < normal[0, 0] < 0.5


def test_where_the_model_cannot_be_linearised_the_covariance_is_infinite():
    """The square root's slope at zero: rank 0 instead of an exception."""
    model = ContinuousModel(lambda t, x, u, w, p: -ca.sqrt(x) + w, lambda t, x, u, w, p: x, x="x", w="w", y="y")
    mhe = MHE(model, horizon=1, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost(), bounds=Bounds(x=(0, 5)),
              hold="point")  # fmt: skip
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0.0]), [0.1, 0.2], [[-0.5], [-0.5]]), 0.3)
    assert estimate.rank == 0 and np.isinf(estimate.covariance[0, 0]) and np.isfinite(estimate.x).all()


def test_an_exact_fit_converges_at_once():
    """Data without residuals: the cost is round-off, and a linear problem still ends in a few iterations."""
    mhe = oscillator_mhe(cost=DiscountedCost(P=0.0, Q=1.0, R=1.0), hold="point")
    t = np.arange(6) * 0.1
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[0, 0]), t, np.column_stack([0 * t, 0 * t]) + 1e-9), 0.5)
    assert estimate.status.outcome is Outcome.SOLVED and estimate.status.iterations <= 6


def test_a_repeated_estimate_replaces_the_one_at_its_time():
    """State, trajectory and later priors see the solution with all that has arrived."""
    mhe = oscillator_mhe(hold="point")
    state, first = mhe.estimate(feed(mhe, mhe.init(x=[1, 0]), [0.1, 0.4], [[0.5, 0.1], [0.4, 0]]), 0.5)
    state, second = mhe.estimate(mhe.observe(state, Measurement(0.3, [2.0, 1.0])), 0.5)
    assert np.abs(first.x - second.x).max() > 1e-3
    np.testing.assert_array_equal(mhe.trajectory(state, 0.5), second.x)


@pytest.mark.parametrize("filtering", [False, True])
def test_a_zero_terminal_weight_changes_nothing(filtering):
    """S = 0 is the cost without S, in both forms."""
    model = DiscreteModel(lambda t, x, u, w, p: 0.9 * x + w, lambda t, x, u, w, p: x, step=1.0, x="x", w="w", y="y")
    found = []
    for S in (None, 0.0):
        mhe = MHE(model, horizon=9, cost=DiscountedCost(eta=0.5, P=2.0, R=3.0, S=S), filtering=filtering)
        found.append(mhe.estimate(feed(mhe, mhe.init(x=[2.0]), range(4), [[1.0], [0.5], [0.7], [0.2]]), 3.0)[1])
    np.testing.assert_allclose(found[0].x, found[1].x, rtol=1e-9)
    assert found[0].cost == pytest.approx(found[1].cost, rel=1e-9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, s: m.estimate((s, None), 1.0), "unpack it"),
        (lambda m, s: m.observe(s, (0.1, [1.0])), "observe expects a Measurement"),
        (lambda m, s: m.control(s, Measurement(0.1, [1.0])), "control expects an Input"),
        (lambda m, s: m.observe(s, Measurement(0.1, "abc")), "values must be numbers"),
        (lambda m, s: m.estimate(oscillator_mhe().init(x=[1, 0]), 1.0), "belongs to another model"),
        (lambda m, s: reactor_mhe(hold=5), "hold must be one of"),
        (lambda m, s: reactor_mhe(horizon="a"), "horizon must be a positive number"),
        (lambda m, s: reactor_mhe(integrator=RK4), "integrator must be RK4"),
        (lambda m, s: reactor_mhe(bounds=(0, 1)), "bounds must be a Bounds"),
        (lambda m, s: reactor_mhe(max_iterations=0), "max_iterations must be a positive integer"),
        (lambda m, s: reactor_mhe(longest_wait=-1), "longest_wait must be a positive"),
        (lambda m, s: RK4("a"), "step must be a positive number of seconds"),
        (lambda m, s: DiscountedCost(eta="a"), "eta must be a number"),
        (lambda m, s: m.save(s, "/nonexistent/folder/state.npz"), "cannot write"),
    ],
)
def test_plausible_mistakes_are_explained(call, message):
    """Whatever a newcomer is likely to type gets an InputError, not a traceback from below."""
    mhe = MHE(linear_model([[-1.0, 0], [0, -1]], np.eye(2), [[1.0, 0]]), horizon=1, interval=0.1, integrator=RK4(0.1),
              cost=DiscountedCost())  # fmt: skip
    with pytest.raises(InputError, match=message):
        call(mhe, mhe.init(x=[1.0, 1.0]))


def test_zero_prior_weight_is_the_least_squares_fit():
    """P = 0 with enough data: the estimate does not depend on the guess."""
    estimates = []
    for guess in ([0, 0], [30, -20]):
        mhe = oscillator_mhe(cost=DiscountedCost(P=0.0, Q=5.0, R=20.0), hold="point")
        state = feed(mhe, mhe.init(x=guess), [0.1, 0.5, 1.0], [[0.5, 0.1], [0.3, 0.2], [0.4, -0.2]])
        estimates.append(mhe.estimate(state, 1.0)[1])
    np.testing.assert_allclose(estimates[0].x, estimates[1].x, atol=1e-7)


def test_output_and_residual_bounds_hold():
    """y_hat stays in its box, and within the residual's box of the measurement."""
    for bounds in (Bounds(y={"y0": (-np.inf, 0.35)}), Bounds(residual={"y0": (-0.05, 0.05)})):
        mhe = oscillator_mhe(hold="point", bounds=bounds)
        state = feed(mhe, mhe.init(x=[0.3, 0]), [0.2, 0.6, 1.0], [[0.5, 0.0], [0.2, 0.0], [0.4, 0.0]])
        _, estimate = mhe.estimate(state, 1.0)
        free = oscillator_mhe(hold="point")
        _, unbounded = free.estimate(
            feed(free, free.init(x=[0.3, 0]), [0.2, 0.6, 1.0], [[0.5, 0], [0.2, 0], [0.4, 0]]), 1.0
        )
        assert estimate.status.success and estimate.cost > unbounded.cost
        if bounds.y is not None:
            assert estimate.trajectory.y[:, 0].max() <= 0.35 + 1e-8
        else:
            at = [int(np.argmin(np.abs(estimate.trajectory.t[1:] - t))) for t in (0.2, 0.6, 1.0)]
            assert np.abs(estimate.trajectory.y[at, 0] - [0.5, 0.2, 0.4]).max() <= 0.05 + 1e-8


def test_contradictory_data_relaxes_the_bounds_and_says_by_how_much():
    """Residual bounds that no trajectory meets: an estimate still comes, marked, with the violation."""
    bounds = Bounds(residual=(-0.01, 0.01), w=(-1e-3, 1e-3))
    mhe = oscillator_mhe(hold="point", bounds=bounds)
    state = feed(mhe, mhe.init(x=[0.3, 0]), [0.2, 0.3], [[5.0, 0.0], [-5.0, 0.0]])
    after, estimate = mhe.estimate(state, 0.4)
    assert estimate.status.outcome is Outcome.RELAXED and not estimate.status.success
    assert estimate.status.violation > 1
    assert mhe.estimate(after, 2.9)[1].status.success


def test_a_model_that_breaks_down_leaves_a_prediction_and_a_usable_state():
    """Outside its domain the model is NaN: the estimate is the open-loop prediction, the next one is normal."""
    model = ContinuousModel(
        lambda t, x, u, w, p: -x + w, lambda t, x, u, w, p: x + 1e-12 * ca.log(1.5 - u), x="x", u="u", w="w", y="y"
    )
    mhe = MHE(model, horizon=1, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost(P=1, Q=1, R=9))
    state = mhe.control(mhe.init(x=[1.0]), Input(0.0, [0.0]))
    state, _ = mhe.estimate(mhe.observe(state, Measurement(0.1, [0.9])), 0.3)
    state = mhe.control(state, Input(0.35, [2.0]))
    expected = state.x[0] * np.exp(-0.2)
    state, bad = mhe.estimate(mhe.observe(state, Measurement(0.4, [0.8])), 0.5)
    assert bad.status.outcome is Outcome.PREDICTED and bad.status.rungs
    assert bad.x[0] == pytest.approx(expected, rel=1e-4)
    state = mhe.control(state, Input(0.5, [0.0]))
    _, good = mhe.estimate(mhe.observe(state, Measurement(1.6, [0.4])), 1.7)
    assert good.status.success


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(horizon=-1.0), "horizon must be a positive"),
        (dict(interval=3.0), "longer than the horizon"),
        (dict(longest_wait=1.0), "not shorter than the horizon"),
        (dict(cost=DiscountedCost(P=[[1, 2], [2, 1]])), "indefinite.*'p[AB]'"),
        (dict(cost=DiscountedCost(P=np.eye(3))), "weight P: expected a scalar, 2 diagonal"),
        (dict(cost=DiscountedCost(R=np.nan)), "'pressure' is not finite"),
        (dict(cost=DiscountedCost(Q={"w_pA": 1.0})), "no weight for w_pB"),
        (dict(bounds=Bounds(x={"pC": (0, 1)})), "unknown state 'pC'. Known: pA, pB"),
        (dict(bounds=Bounds(x=(2.0, 1.0))), "'pA' has lower 2.0 above upper 1.0"),
        (dict(hold="cubic"), "hold must be one of zero, linear, point"),
        (dict(integrator=None), "needs interval="),
        (dict(solver="magic"), "solver must be one of"),
        (dict(input_hold="spline"), "input_hold"),
    ],
)
def test_bad_configuration_is_refused_with_the_signals_name(change, message):
    """Each mistake in the configuration raises InputError before anything is solved."""
    with pytest.raises(InputError, match=message):
        reactor_mhe(**change)


@pytest.mark.parametrize("eta", [0.0, -0.1, 1.1, np.nan, np.inf])
def test_eta_outside_its_interval_is_refused(eta):
    """eta lies in (0, 1]."""
    with pytest.raises(InputError, match="eta must lie in"):
        DiscountedCost(eta=eta)


def test_bad_measurements_raise_and_leave_the_state_unchanged():
    """Wrong shapes, unknown names, infinities, contradictions and old data name the signal; the state still works."""
    mhe = reactor_mhe()
    state = mhe.init(x=[2, 1])
    state, _ = mhe.estimate(mhe.observe(state, Measurement(1.9, [3.0])), 2.0)
    before = mhe.estimate(state, 2.1)[1]
    for measurement, error, message in (
        (Measurement(2.05, [1.0, 2.0]), InputError, "expected 1 output value"),
        (Measurement(2.05, {"presure": 1.0}), InputError, "did you mean 'pressure'"),
        (Measurement(2.05, [np.inf]), InputError, "'pressure' is inf"),
        (Measurement(1.9, [3.5]), InputError, "'pressure' is 3.5 but was 3"),
        (Measurement(0.4, [3.0]), TooLate, "starts at 1 s; a longer horizon"),
    ):
        with pytest.raises(error, match=message):
            mhe.observe(state, measurement)
    for bad in (np.nan, np.inf, "soon"):
        with pytest.raises(InputError, match="time must be"):
            Measurement(bad, [1.0])
        with pytest.raises(InputError, match="time must be"):
            mhe.estimate(state, bad)
    with pytest.raises(NotEstimated, match="smooth"):
        mhe.estimate(state, 1.5)
    np.testing.assert_array_equal(mhe.estimate(state, 2.1)[1].x, before.x)


@pytest.mark.parametrize(
    ("x", "message"),
    [([1.0], "expected 2 state values"), ([np.nan, 1], "'pA' is nan"), ({"pA": 1.0}, "no value for state pB")],
)
def test_bad_guesses_are_refused(x, message):
    """The initial estimate needs every state, finite."""
    with pytest.raises(InputError, match=message):
        reactor_mhe().init(x=x)


def test_a_model_with_inputs_needs_one_before_the_window():
    """Without a known input the estimate raises and names it."""
    model = ContinuousModel(lambda t, x, u, w, p: -x + u, lambda t, x, u, w, p: x, x="x", u="valve", y="y")
    mhe = MHE(model, horizon=1, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost())
    state = mhe.init(x=[1.0])
    with pytest.raises(InputError, match=r"no input is known.*valve"):
        mhe.estimate(state, 0.5)
    with pytest.raises(InputError, match="input 'valve' is nan"):
        mhe.control(state, Input(0.0, [np.nan]))


def test_a_discrete_model_refuses_times_between_its_steps():
    """Measurements and estimates belong to whole steps."""
    model = DiscreteModel(lambda t, x, u, w, p: 0.9 * x + w, lambda t, x, u, w, p: x, step=0.5, x="x", w="w", y="y")
    mhe = MHE(model, horizon=5, cost=DiscountedCost(eta=0.9))
    state = mhe.init(x=[1.0])
    with pytest.raises(InputError, match="multiple of the discrete model's step"):
        mhe.observe(state, Measurement(0.3, [1.0]))
    with pytest.raises(InputError, match="multiple of the discrete model's step"):
        mhe.estimate(state, 0.7)
    with pytest.raises(InputError, match="no meaning for a DiscreteModel"):
        MHE(model, horizon=5, cost=DiscountedCost(), hold="zero")


@pytest.mark.parametrize("filtering", [False, True])
def test_the_discrete_cost_is_that_of_the_thesis(filtering):
    """(3.6): eta^N prior + sum eta^(N-j-1) stage; the filtering form counts the newest measurement too."""
    step, eta, P, Q, R, n = 0.5, 0.8, 2.0, 3.0, 5.0, 6
    model = DiscreteModel(lambda t, x, u, w, p: 0.9 * x + w, lambda t, x, u, w, p: x, step=step, x="x", w="w", y="y")
    mhe = MHE(model, horizon=50, cost=DiscountedCost(eta=eta, P=P, Q=Q, R=R), filtering=filtering)
    y = np.array([1.0, 0.5, 0.7, 0.1, 0.3, 0.9, -0.4])
    state = feed(mhe, mhe.init(x=[1.4]), np.arange(n + 1) * step, y[:, None])
    _, estimate = mhe.estimate(state, n * step)
    last = n + 1 if filtering else n
    rows, rhs = [np.sqrt(eta**n * P) * np.eye(1, n + 1)[0]], [np.sqrt(eta**n * P) * 1.4]
    for j in range(last):  # unknowns: x(0), w(0..n-1)
        weight = eta ** (n - j) if filtering else eta ** (n - j - 1)
        row = np.zeros(n + 1)
        row[0] = 0.9**j
        row[1 : j + 1] = 0.9 ** np.arange(j - 1, -1, -1)
        rows.append(np.sqrt(weight * R) * row)
        rhs.append(np.sqrt(weight * R) * y[j])
        if j < n:
            rows.append(np.sqrt(weight * Q) * np.eye(1, n + 1, j + 1)[0])
            rhs.append(0.0)
    solution, residual, *_ = np.linalg.lstsq(np.array(rows), np.array(rhs), rcond=None)
    end = 0.9**n * solution[0] + 0.9 ** np.arange(n - 1, -1, -1) @ solution[1:]
    assert estimate.x[0] == pytest.approx(end, rel=1e-9)
    assert estimate.cost == pytest.approx(residual[0], rel=1e-9)


def test_a_prior_of_its_own_discount_and_a_terminal_weight_enter_the_cost():
    """(4.12), (6.62): an undiscounted prior beside a discounted stage; (6.7): a weight on the newest output."""
    y = np.array([1.0, 0.5, 0.7])
    model = DiscreteModel(lambda t, x, u, w, p: 0.9 * x, lambda t, x, u, w, p: x, step=1.0, x="x", y="y")
    cost = DiscountedCost(eta=0.5, prior_eta=1.0, P=2.0, R=3.0, S=7.0)
    mhe = MHE(model, horizon=9, cost=cost)
    _, estimate = mhe.estimate(feed(mhe, mhe.init(x=[2.0]), [0.0, 1.0, 2.0], y[:, None]), 2.0)
    weights = np.array([2.0, 3 * 0.5, 3 * 1.0, 7.0])
    slope, target = np.array([1, 1, 0.9, 0.81]), np.array([2.0, *y])
    x0 = (weights * slope * target).sum() / (weights * slope**2).sum()
    assert estimate.x[0] == pytest.approx(0.81 * x0, rel=1e-9)
    assert estimate.cost == pytest.approx((weights * (slope * x0 - target) ** 2).sum(), rel=1e-9)


def test_weights_may_vary_in_time():
    """A callable R(t) that vanishes before t = 1 equals measuring only from then on."""
    cost = dict(P=1.0, Q=5.0, eta=0.8)
    late = oscillator_mhe(cost=DiscountedCost(R=lambda t: 20.0 * np.eye(2) * (t >= 1.0), **cost), hold="point")
    plain = oscillator_mhe(cost=DiscountedCost(R=20.0, **cost), hold="point")
    data = np.array([[0.5, 0.1], [0.2, 0.2], [0.4, -0.2]])
    all_of_them = late.estimate(feed(late, late.init(x=[1, 0]), [0.3, 1.0, 1.5], data), 1.6)[1]
    only_late = plain.estimate(feed(plain, plain.init(x=[1, 0]), [1.0, 1.5], data[1:]), 1.6)[1]
    np.testing.assert_allclose(all_of_them.x, only_late.x, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(0.0, 3.0, allow_nan=False), min_size=1, max_size=12), st.floats(0.01, 3.0))
def test_any_sampling_instants_give_a_successful_estimate(times, end):
    """Repeated, nearly equal and edge-hitting times never break the mesh."""
    mhe = INSTANTS
    state = mhe.init(x=[1, 0])
    for t in np.round(times, 9):  # times closer than round-off would be one instant with two values
        state = mhe.observe(state, Measurement(t, [np.cos(t), -np.sin(t)]))
    state, estimate = mhe.estimate(state, end)
    assert estimate.status.success
    assert np.isfinite(estimate.x).all()
    assert (np.diff(estimate.trajectory.t) >= 0).all()


INSTANTS = oscillator_mhe(hold="point")


@pytest.mark.parametrize("source", ["Python", "FMU"])
def test_cvodes_estimates_a_stiff_plant_where_rk4_of_equal_cost_cannot_even_predict(source):
    """Van der Pol, mu = 100, sampled every 20 s: CVODES finds the state, RK4 with 400 steps a cell diverges.

    Costs side by side: `python -m benchmarks.stiff`.
    """
    from ctmhe.models.fmu import FmuModel
    from ctmhe.models.library import van_der_pol
    from ctmhe.simulation import OdePlant
    from fmus.build import build

    python = van_der_pol(mu=100.0, noise=False)
    model = python if source == "Python" else FmuModel(build("van_der_pol"), inputs=[], start={"mu": 100.0})
    plant = OdePlant(python)
    nothing, w = np.empty(0), np.zeros(2)
    plant.start(0.0, np.array([2.0, 0.0]))
    times, rows = np.arange(4) * 20.0, []
    for t in times:
        if t:
            plant.advance(t, nothing, nothing, w)
        rows.append(plant.output(nothing, w))
    truth = plant.state()
    options = dict(horizon=60.0, interval=20.0, cost=DiscountedCost(P=1.0, Q=1e4, R=1e6, eta=0.95), hold="point")
    mhe = MHE(model, integrator=CVODES(1e-8, 1e-10), **options)
    state, estimate = mhe.estimate(feed(mhe, mhe.init(x=[1.9, 0.1]), times, rows), times[-1])
    assert estimate.status.success and not estimate.status.rungs
    np.testing.assert_allclose(estimate.x, truth, atol=1e-5)
    plant.advance(70.0, nothing, nothing, w)
    np.testing.assert_allclose(mhe.predict(state, 70.0).x, plant.state(), atol=1e-4)
    explicit = MHE(model, integrator=RK4(0.05), **options)
    ahead = explicit.propagate(explicit.init(x=truth), 60.0, 70.0, truth, model.p_start)  # of the FMU: held, it fails
    assert not np.allclose(ahead, plant.state(), atol=0.01)


@settings(max_examples=40, deadline=None)
@given(
    hold=st.sampled_from(["zero", "linear"]),
    switches=st.lists(st.floats(0.01, 1.9), max_size=4),
    t0=st.floats(0.0, 1.0),
    ahead=st.floats(0.0, 0.9),
)
def test_carrying_on_gives_the_propagated_state_and_its_output(hold, switches, t0, ahead):
    """Within a cell, over many, across inputs that switch: the state of `propagate`, the output of `output` there."""
    mhe = DRIVEN[hold]
    state = mhe.control(mhe.init(x=[0.5, -0.2]), Input(0.0, [0.3]))
    for t in sorted(switches):
        state = mhe.control(state, Input(t, [np.sin(9 * t)]))
    start, p = np.array([0.5, -0.2]), np.empty(0)
    x, y = mhe.carry(state, t0, t0 + ahead, start, p)
    np.testing.assert_array_equal(x, mhe.propagate(state, t0, t0 + ahead, start, p))
    np.testing.assert_allclose(y, mhe.output(state, t0 + ahead, x, p), rtol=1e-12, atol=1e-14)
