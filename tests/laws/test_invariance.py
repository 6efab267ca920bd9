"""What must not matter: the order of arrival, NaN against silence, having stopped and continued, looking twice."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.models.library import batch_reactor
from ctmhe.types import Input, Measurement
from tests.conftest import feed, oscillator_mhe

TIMES = np.array([0.0, 0.13, 0.2, 0.41, 0.77, 0.9, 1.2])


def rows(seed=3):
    """Two sensors, some silent."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(len(TIMES), 2))
    values[rng.uniform(size=values.shape) < 0.25] = np.nan
    return values


def same(a, b):
    """Two estimates are identical, bit for bit."""
    for name in ("x", "p", "w", "y", "prior"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(a.trajectory.x, b.trajectory.x)
    assert a.cost == b.cost and a.status == b.status


MHES = {hold: oscillator_mhe(hold=hold) for hold in ("zero", "linear", "point")}


@settings(max_examples=25, deadline=None)
@given(st.permutations(range(len(TIMES))), st.sampled_from(sorted(MHES)))
def test_the_order_of_arrival_does_not_matter(order, hold):
    """Any permutation of the measurements gives the identical estimate."""
    mhe, data = MHES[hold], rows()
    expected = mhe.estimate(feed(mhe, mhe.init(x=[1, 0]), TIMES, data), 1.3)[1]
    shuffled = mhe.estimate(feed(mhe, mhe.init(x=[1, 0]), TIMES[list(order)], data[list(order)]), 1.3)[1]
    same(expected, shuffled)


@pytest.mark.parametrize("hold", sorted(MHES))
def test_a_nan_sensor_equals_a_missing_one(hold):
    """NaN, a name left out, and per-sensor measurements at one time are the same."""
    mhe, data = MHES[hold], rows()
    whole = feed(mhe, mhe.init(x=[1, 0]), TIMES, data)
    whole = mhe.observe(whole, Measurement(0.55, [np.nan, np.nan]))
    parts = mhe.init(x=[1, 0])
    for t, row in zip(TIMES, data, strict=True):
        for name, value in zip(("y1", "y0"), row[::-1], strict=True):
            if np.isfinite(value):
                parts = mhe.observe(parts, Measurement(t, {name: value}))
    same(mhe.estimate(whole, 1.3)[1], mhe.estimate(parts, 1.3)[1])


def test_estimating_twice_from_one_state_gives_identical_results():
    """All that influences the result is in the state, and the old state stays valid."""
    mhe = MHES["zero"]
    state = feed(mhe, mhe.init(x=[1, 0]), TIMES, rows())
    after, first = mhe.estimate(state, 1.3)
    mhe.estimate(mhe.observe(after, Measurement(1.4, [0.3, 0.1])), 2.5)  # moves on; must leave `state` alone
    same(first, mhe.estimate(state, 1.3)[1])


@pytest.mark.parametrize("solver", ["gauss-newton", "ipopt"])
def test_threads_that_share_an_estimator_get_the_same_numbers(solver):
    """Scratch memory is per thread: concurrent estimates equal sequential ones."""
    from concurrent.futures import ThreadPoolExecutor

    mhe = oscillator_mhe(hold="point", solver=solver)
    states = [feed(mhe, mhe.init(x=[1, 0]), TIMES, rows(seed)) for seed in range(8)]
    expected = [mhe.estimate(state, 1.3)[1] for state in states]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda state: mhe.estimate(state, 1.3)[1], states * 5))
    for i, estimate in enumerate(found):
        if solver == "ipopt":  # rounds differently after another problem: not our memory
            np.testing.assert_allclose(estimate.x, expected[i % 8].x, rtol=0, atol=1e-11)
        else:
            same(expected[i % 8], estimate)


def test_branches_of_one_state_do_not_see_each_other():
    """Appending to one branch leaves the other without the measurement."""
    mhe = MHES["point"]
    trunk = feed(mhe, mhe.init(x=[1, 0]), TIMES[:3], rows()[:3])
    left = mhe.observe(trunk, Measurement(0.8, [9.0, 9.0]))
    right = mhe.observe(trunk, Measurement(0.8, [-9.0, -9.0]))
    assert mhe.estimate(left, 1.0)[1].x[0] > mhe.estimate(trunk, 1.0)[1].x[0] > mhe.estimate(right, 1.0)[1].x[0]


def test_save_load_continue_equals_never_stopping(tmp_path):
    """A state written and read in the middle of a run leads to the identical next estimates."""
    mhe = MHES["linear"]
    state = mhe.init(x=[1, 0])
    data = rows()
    for i, t in enumerate(TIMES):
        state = mhe.observe(state, Measurement(t, data[i]))
        if i % 2:
            state, _ = mhe.estimate(state, t + 0.05)
    mhe.save(state, tmp_path / "state.npz")
    loaded = mhe.load(tmp_path / "state.npz")
    for t in (1.5, 3.1, 3.2):
        state, expected = mhe.estimate(mhe.observe(state, Measurement(t - 0.1, [0.2, 0.1])), t)
        loaded, got = mhe.estimate(mhe.observe(loaded, Measurement(t - 0.1, [0.2, 0.1])), t)
        same(expected, got)


def test_the_estimator_pickles_as_its_configuration():
    """A copy in another process would give the same numbers."""
    mhe = oscillator_mhe(hold="point")
    copy = pickle.loads(pickle.dumps(mhe))
    state = feed(mhe, mhe.init(x=[1, 0]), TIMES, rows())
    again = feed(copy, copy.init(x=[1, 0]), TIMES, rows())
    same(mhe.estimate(state, 1.3)[1], copy.estimate(again, 1.3)[1])


def test_an_input_given_late_inside_the_window_counts_from_its_own_time():
    """control() in any order gives the identical estimate; a repeated time takes the last value."""
    from ctmhe.estimators import MHE
    from ctmhe.models import ContinuousModel
    from ctmhe.transcription import RK4
    from ctmhe.types import DiscountedCost

    model = ContinuousModel(lambda t, x, u, w, p: -x + u + w, lambda t, x, u, w, p: x, x="x", u="u", w="w", y="y")
    mhe = MHE(model, horizon=2, interval=0.1, integrator=RK4(0.05), cost=DiscountedCost(P=1, Q=1, R=9, eta=0.9))
    inputs = [Input(0.0, [1.0]), Input(0.33, [0.2]), Input(0.7, [2.0])]
    results = []
    for order in ([0, 1, 2], [2, 0, 1]):
        state = feed(mhe, mhe.init(x=[0.5]), TIMES, rows()[:, :1])
        for i in order:
            state = mhe.control(mhe.control(state, Input(inputs[i].t, [7.0])), inputs[i])
        results.append(mhe.estimate(state, 1.3)[1])
    same(*results)


def test_times_may_be_shifted():
    """Dynamics that do not depend on time: the same estimates wherever the clock stands, also if t - T is a solve."""
    found = []
    for t0 in (0.0, -3.1, 1e3, 1e6):
        mhe = oscillator_mhe(horizon=0.4, interval=0.02, hold="zero")
        state, estimates = mhe.init(t=t0, x=[1, 0]), []
        for k in range(1, 60):
            t = t0 + k * 0.02
            state = mhe.observe(state, Measurement(t, [np.cos(k), np.sin(0.3 * k)]))
            if k % 2 == 0:
                state, estimate = mhe.estimate(state, t)
                estimates.append(estimate.x)
        found.append(estimates)
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-7)


def test_one_cell_has_one_disturbance_also_when_an_estimate_fell_inside_it(rng):
    """Estimates off the cell grid: w is constant on every cell and the cost is the reference solver's."""
    mhe = oscillator_mhe(interval=0.5, horizon=1.0)
    state, t = mhe.init(x=[1, 0]), 0.0
    for _ in range(12):
        t += rng.uniform(0.05, 0.4)
        state = mhe.observe(state, Measurement(t, rng.normal(size=2)))
        before = state
        state, estimate = mhe.estimate(state, t + 0.03)
        assert estimate.status.success
        trajectory = estimate.trajectory
        cell = np.floor((trajectory.t[:-1] + trajectory.t[1:]) / 2 / 0.5)
        for j in np.unique(cell):
            np.testing.assert_allclose(np.ptp(trajectory.w[cell == j], axis=0), 0, atol=1e-9)
        assert estimate.cost == pytest.approx(mhe.reference(before, t + 0.03).cost, rel=1e-8)


def test_states_and_estimates_copy_and_pickle(tmp_path):
    """A state that went through pickle or a deep copy continues identically; nobody can write into it."""
    import copy

    mhe = MHES["zero"]
    state, estimate = mhe.estimate(feed(mhe, mhe.init(x=[1, 0]), TIMES, rows()), 1.3)
    for other in (copy.deepcopy(state), pickle.loads(pickle.dumps(state))):
        same(mhe.estimate(state, 1.5)[1], mhe.estimate(other, 1.5)[1])
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(estimate)).x, estimate.x)
    for array in (state.window.active, state.window.values, state.x, state.start, estimate.trajectory.x):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_a_linear_input_is_interpolated_to_the_next_known_one():
    """dx/dt = u with u from 0 to 1 over a second: x(0.5) = 0.125, for estimate and prediction."""
    from ctmhe.estimators import MHE
    from ctmhe.models import ContinuousModel
    from ctmhe.transcription import RK4
    from ctmhe.types import DiscountedCost

    model = ContinuousModel(lambda t, x, u, w, p: u + w, lambda t, x, u, w, p: x, x="x", u="u", w="w", y="y")
    mhe = MHE(model, horizon=2, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost(), input_hold="linear")
    state = mhe.control(mhe.control(mhe.init(x=[0.0]), Input(0.0, [0.0])), Input(1.0, [1.0]))
    state, estimate = mhe.estimate(state, 0.5)
    assert estimate.x[0] == pytest.approx(0.125, rel=1e-9)
    assert mhe.predict(state, 0.75).x[0] == pytest.approx(0.75**2 / 2, rel=1e-9)


def test_samples_of_one_instant_count_together(rng):
    """Two samples closer than round-off of the interval weigh like the same two a microsecond apart."""
    mhe, found = MHES["point"], []
    for gap in (2e-12, 1e-6):
        state = feed(mhe, mhe.init(x=[1, 0]), [0.5, 0.5 + gap], [[1.0, 0.3], [2.0, 0.1]])
        found.append(mhe.estimate(state, 0.8)[1])
    np.testing.assert_allclose(found[0].x, found[1].x, atol=1e-5)
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, atol=1e-5)


def test_discounting_weighs_the_past_less():
    """With eta = 1 an old outlier pulls the estimate more than with eta = 0.1."""
    pulls = []
    for eta in (1.0, 0.1):
        mhe = oscillator_mhe(cost=oscillator_cost(eta), hold="point")
        clean = feed(mhe, mhe.init(x=[0, 0]), [0.1, 1.9], [[0, 0], [0, 0]])
        dirty = feed(mhe, mhe.init(x=[0, 0]), [0.1, 1.9], [[5, 0], [0, 0]])
        pulls.append(np.abs(mhe.estimate(dirty, 1.9)[1].x - mhe.estimate(clean, 1.9)[1].x).max())
    assert pulls[1] < pulls[0]


def oscillator_cost(eta):
    """Cost of the oscillator with a given discount."""
    from ctmhe.types import DiscountedCost

    return DiscountedCost(P=1.0, Q=5.0, R=20.0, eta=eta)


def test_the_truth_never_costs_less_than_the_estimate(rng):
    """With cells anchored at absolute multiples the true w is feasible: J(optimal) <= J(truth) on any window."""
    from ctmhe.estimators import MHE
    from ctmhe.transcription import RK4
    from ctmhe.transcription.problem import Guess, cost_of, rollout
    from tests.conftest import REACTOR_COST

    model = batch_reactor()
    mhe = MHE(
        model, horizon=0.5, interval=0.1, integrator=RK4(0.02), cost=REACTOR_COST, bounds=model.bounds, hold="point"
    )
    w = rng.uniform(-0.1, 0.1, (20, 3))
    truth = {0.0: np.array([3.0, 1.0])}
    state, x, t = mhe.init(x=[0.1, 4.5]), truth[0.0], 0.0
    for k in range(100):  # steps of 0.01 on cells of 0.1
        x, _ = mhe.stage.step(t, 0.01, x, w[k // 10], np.empty(0), np.empty(0), np.empty(0))
        t = round((k + 1) * 0.01, 10)
        truth[t] = x
        state = mhe.observe(
            state, Measurement(t, [x.sum() + w[min((k + 1) // 10, 19) if (k + 1) % 10 else k // 10][2]])
        )
    checked = 0
    for t in (0.33, 0.57, 0.93):
        start = max(0.0, round(t - 0.5, 10))
        anchor = mhe._prior(state, max(0.0, t - 0.5), t <= 0.5)
        window = mhe.assembly.window(
            start, t, mhe.records(state, start, t), anchor.value, growing=t <= 0.5, prior_factor=anchor.factor
        )
        true_w = w[window.mesh.cell]
        point = rollout(mhe.stage, window, truth[start], np.empty(0), true_w)
        mesh = window.mesh
        _, y = mhe.stage.values(mesh.t[:-1], mesh.h, point.x[:-1], true_w, np.empty(0), window.u0, window.u1)
        state, estimate = mhe.estimate(state, t)
        assert estimate.cost <= cost_of(window, Guess.of(point.x, true_w, np.empty(0), 1), y) * (1 + 1e-9)
        assert mesh.t[0] == pytest.approx(start)
        checked += 1
    assert checked == 3
