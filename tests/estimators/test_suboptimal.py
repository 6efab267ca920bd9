"""Suboptimal MHE: candidates, the decrease condition, and what an observer does that fails. Thesis 4.2, 4.3."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe import MHE, RK4, Bounds, DiscountedCost, DiscreteModel, Input, InputError, Measurement, Outcome, simulate
from ctmhe.estimators import Suboptimal
from ctmhe.models import observer_model
from ctmhe.models.library import three_species, three_species_discrete
from ctmhe.transcription.problem import Guess
from ctmhe.triggers import Periodic

STEP, N = 0.25, 3
K = np.array([[-0.1], [-0.1], [-0.5]])  # thesis 4.2.6
P = np.array([[3.100, 2.170, 1.674], [2.170, 4.210, 2.154], [1.674, 2.154, 3.077]])
COST = DiscountedCost(P=2 * P, Q=200.0, R=50.0, eta=0.9383, prior_eta=1.0)
BOX = Bounds(x=(0.0, 3.0))
GUESS, TRUTH = np.array([2.0, 0.5, 0.0]), np.array([0.5, 0.05, 0.1])
RATES = (0.2, 0.05, 0.2, 0.1)


def step(x: np.ndarray) -> np.ndarray:
    """One Euler step of (4.70), written anew."""
    p1, p2, p3, p4 = RATES
    r1, r2 = p1 * x[0] - p2 * x[1] * x[2], p3 * x[1] ** 2 - p4 * x[2]
    return x + STEP * np.array([-r1, r1 - 2 * r2, r1 + r2])


def outputs(n: int, seed: int = 0) -> np.ndarray:
    """Return n noisy measurements of the plant."""
    rng, x, found = np.random.default_rng(seed), TRUTH, []
    for _ in range(n):
        found.append(x.sum() + rng.uniform(-0.05, 0.05))
        x = step(x) + rng.uniform(-1e-3, 1e-3, 3)
    return np.array(found)


@cache
def estimator(
    candidate: str = "system",
    T: float = 5 * STEP,
    limit: int | None = 1,
    solver: str = "gauss-newton",
    filtering: bool = False,
    start: str = "candidate",
) -> MHE:
    """Return suboptimal MHE of the three species."""
    prior = Suboptimal(K, horizon=T, candidate=candidate, start=start)
    return MHE(
        three_species_discrete(),
        horizon=N * STEP,
        cost=COST,
        bounds=BOX,
        filtering=filtering,
        solver=solver,
        max_iterations=limit,
        prior=prior,
    )


def run(mhe: MHE, y: np.ndarray) -> list:
    """Return the estimates at all steps; y(t) is known after the estimate at t, or before in the filtering form."""
    state, found = mhe.init(x=GUESS), []
    for k, value in enumerate(y):
        if mhe.assembly.filtering:
            state = mhe.observe(state, Measurement(k * STEP, [value]))
        state, estimate = mhe.estimate(state, k * STEP)
        found.append(estimate)
        if not mhe.assembly.filtering:
            state = mhe.observe(state, Measurement(k * STEP, [value]))
    return found


def by_hand(y: np.ndarray, candidate: str, T: int | None) -> tuple[np.ndarray, list[float]]:
    """Return the estimates after zero iterations, and their costs, from (4.12), (4.16)-(4.18), (4.56) and (4.64)."""
    estimates, costs = [], []
    for t in range(len(y)):
        run = t if T is None else min(t, T)
        z = [GUESS if run == t else estimates[t - run]]
        for j in range(run):
            z.append(step(z[-1]) + K[:, 0] * (z[-1].sum() - y[t - run + j]))
        n = min(t, N)
        if candidate == "system":
            x = [np.clip(z[run - n], 0, 3)]
            for _ in range(n):
                x.append(step(x[-1]))
        else:
            x = [np.clip(one, 0, 3) for one in z[run - n :]]
        cost = 0.0
        for j in range(n):
            d = x[j + 1] - step(x[j])
            cost += 0.9383 ** (n - j - 1) * (200 * d @ d + 50 * (x[j].sum() - y[t - n + j]) ** 2)
        estimates.append(x[-1])
        costs.append(cost)
    return np.array(estimates), costs


@pytest.mark.parametrize("T", [5, 3, None])
@pytest.mark.parametrize("candidate", ["system", "observer"])
def test_without_iterations_the_estimate_is_the_candidate(candidate, T):
    """(4.16)-(4.18) with (4.56) and (4.64), re-initialised and not, written anew: states and costs agree."""
    y = outputs(25)
    found = run(estimator(candidate, np.inf if T is None else T * STEP, 0), y)
    x, costs = by_hand(y, candidate, T)
    np.testing.assert_allclose([e.x for e in found], x, atol=1e-12)
    np.testing.assert_allclose([e.cost for e in found], costs, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("filtering", [False, True])
@pytest.mark.parametrize("candidate", ["system", "observer"])
def test_unlimited_iterations_are_optimal(candidate, filtering):
    """With no limit the cost is that of the reference solver on the same problem, in both forms."""
    mhe = estimator(candidate, limit=None, filtering=filtering)
    state, y = mhe.init(x=GUESS), outputs(12)
    for k, value in enumerate(y):
        if filtering:
            state = mhe.observe(state, Measurement(k * STEP, [value]))
        best = mhe.reference(state, k * STEP)
        state, estimate = mhe.estimate(state, k * STEP)
        assert estimate.status.outcome is Outcome.SOLVED
        assert estimate.cost == pytest.approx(best.cost, rel=1e-6, abs=1e-9)
        if not filtering:
            state = mhe.observe(state, Measurement(k * STEP, [value]))


@pytest.mark.parametrize("solver", ["gauss-newton", "numpy", "ipopt"])
@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_no_estimate_costs_more_than_the_candidate(solver, data):
    """Whatever the limit, the start and the data: feasible, and (4.15)."""
    limit = data.draw(st.sampled_from([0, 1, 2, None]))
    candidate = data.draw(st.sampled_from(["system", "observer"]))
    wild = data.draw(st.lists(st.floats(-5, 5), min_size=3, max_size=3))
    y = np.array(data.draw(st.lists(st.floats(-2, 6), min_size=5, max_size=5)))

    def anywhere(mhe, state, window):
        n = len(window.mesh)
        return Guess.of(np.tile(wild, (n + 1, 1)), np.full((n, 4), wild[0]), np.empty(0), 1)

    mhe = estimator(candidate, 4 * STEP, limit, solver)
    rule = Suboptimal(K, horizon=4 * STEP, candidate=candidate, start=anywhere)
    options = {"horizon": N * STEP, "cost": COST, "bounds": BOX, "solver": solver, "max_iterations": limit}
    other = mhe if solver == "ipopt" else MHE(three_species_discrete(), prior=rule, **options)
    zero = estimator(candidate, 4 * STEP, 0)
    state = other.init(x=GUESS)
    for k, value in enumerate(y):
        most = zero.estimate(state, k * STEP)[1].cost
        state, estimate = other.estimate(state, k * STEP)
        assert estimate.cost <= most * (1 + 1e-12) + 1e-12
        path = estimate.trajectory
        live = np.diff(path.t) > 0
        ahead = np.array([step(x) for x in path.x[:-1]])[live] + path.w[live][:, :3]
        np.testing.assert_allclose(ahead, path.x[1:][live], atol=1e-7)
        assert path.x.min() >= -1e-7 and path.x.max() <= 3 + 1e-7
        state = other.observe(state, Measurement(k * STEP, [value]))


def test_an_observer_that_leaves_the_bounds_is_named():
    """The projection error (4.54) is in the notes, with signal and time; the estimate keeps to the bounds."""
    found = run(estimator("observer", limit=0), outputs(8))
    notes = [note for e in found for note in e.status.notes if "leaves the bounds" in note]
    assert notes and "cC" in notes[0] and "|eps|" in notes[0]
    assert all((e.x >= 0).all() for e in found)


@pytest.mark.filterwarnings("ignore:overflow")
def test_an_observer_that_diverges_leaves_an_estimate():
    """With a gain that makes it explode, the failure is noted and estimates stay finite and close."""
    wild = Suboptimal(1e60 * np.ones((3, 1)), candidate="observer")
    mhe = MHE(three_species_discrete(), horizon=N * STEP, cost=COST, bounds=BOX, prior=wild)
    found = run(mhe, outputs(40))
    assert any("the observer fails" in note for e in found for note in e.status.notes)
    assert np.isfinite([e.x for e in found]).all() and (np.array([e.x for e in found]) <= 3).all()
    assert all(e.status.outcome is Outcome.SOLVED for e in found)


def test_memory_stays_as_long_as_the_horizons():
    """Nothing grows in the loop: estimates of T, and logs of T and N."""
    sizes = []
    for T in (5 * STEP, np.inf):
        mhe, y = estimator(T=T), outputs(60)
        state = mhe.init(x=GUESS)
        for k, value in enumerate(y):
            state, _ = mhe.estimate(state, k * STEP)
            state = mhe.observe(state, Measurement(k * STEP, [value]))
            if k in (30, 59):
                sizes.append((len(state.memory["observer"]), len(state.measurements)))
    assert sizes[0] == sizes[1] and sizes[2] == sizes[3] == (1, 4)


def test_saved_states_go_on_as_if_never_stopped(tmp_path):
    """Save, load and continue equals never stopping, and solving twice at one time changes nothing."""
    mhe, y = estimator("observer"), outputs(20)
    whole = run(mhe, y)
    state = mhe.init(x=GUESS)
    for k, value in enumerate(y):
        if k == 11:
            mhe.save(state, tmp_path / "state.npz")
            state = mhe.load(tmp_path / "state.npz")
        state, _ = mhe.estimate(state, k * STEP)
        state, estimate = mhe.estimate(state, k * STEP)
        state = mhe.observe(state, Measurement(k * STEP, [value]))
        np.testing.assert_allclose(estimate.x, whole[k].x, atol=1e-9)


def test_irregular_solves_start_the_observer_from_an_estimate_at_least_T_ago():
    """Solved at some steps only, zero iterations give the observer run from the last estimate made by then."""
    mhe, y = estimator("observer", limit=0), outputs(40)
    solved, state, known = (0, 1, 4, 6, 9, 14, 15, 20, 33), mhe.init(x=GUESS), {0: GUESS}
    for k in range(34):
        if k in solved:
            state, estimate = mhe.estimate(state, k * STEP)
            since = max(t for t in known if t <= max(k - 5, 0))
            z = known[since]
            for j in range(since, k):
                z = step(z) + K[:, 0] * (z.sum() - y[j])
            np.testing.assert_allclose(estimate.x, np.clip(z, 0, 3), atol=1e-10)
            known.setdefault(k, estimate.x)
        state = mhe.observe(state, Measurement(k * STEP, [y[k]]))


def test_in_continuous_time_the_candidate_follows_the_observer():
    """Without iterations and with a cell a record, the candidate through the observer's states ends where it does."""
    model = three_species()
    mhe = MHE(
        model,
        horizon=0.75,
        interval=0.25,
        integrator=RK4(0.25),
        cost=DiscountedCost(P=2 * P, Q=200.0, R=50.0, eta=0.8, prior_eta=1.0),
        prior=Suboptimal(4 * K, candidate="observer"),
        max_iterations=0,
    )
    bound = mhe.suboptimal.bound(mhe)
    state, y, z = mhe.init(x=GUESS), outputs(12), GUESS
    for k, value in enumerate(y):
        state = mhe.observe(state, Measurement(k * STEP, [value]))
        state, estimate = mhe.estimate(state, k * STEP)
        np.testing.assert_allclose(estimate.x, z, atol=1e-8)
        u = np.array([value, 1.0])
        z, _ = bound.stage.step(k * STEP, STEP, z, np.empty(0), np.empty(0), u, u)


def test_trajectories_of_the_observer_have_nothing_but_their_start_to_decide():
    """(4.72): the optimum runs by z+ = f(z) + K (h(z) - y), without disturbances, and beats the candidate (4.75)."""
    y, model = outputs(20), observer_model(three_species_discrete(), K)
    cost = DiscountedCost(P=0.02 * P, Q=[], R=0.3, eta=0.97, prior_eta=1.0)
    options = {"horizon": N * STEP, "cost": cost, "filtering": True, "prior": Suboptimal(horizon=N * STEP)}
    best, candidate = (run(MHE(model, max_iterations=limit, **options), y) for limit in (None, 0))
    z = GUESS
    for k, (first, zero) in enumerate(zip(best, candidate, strict=True)):
        np.testing.assert_allclose(zero.x, z, atol=1e-10)
        z = step(z) + K[:, 0] * (z.sum() - y[k])
        path = first.trajectory
        assert path.w.shape[1] == 0
        for j in range(len(path.t) - 2):
            i = round(path.t[j] / STEP)
            ahead = step(path.x[j]) + K[:, 0] * (path.x[j].sum() - y[i])
            np.testing.assert_allclose(path.x[j + 1], ahead, atol=1e-9)
    assert sum(e.cost for e in best) < sum(e.cost for e in candidate)


def double_integrator() -> DiscreteModel:
    """Two states, an input, an output."""
    return DiscreteModel(
        lambda t, x, u, w, p: (x[0] + 0.1 * x[1] + w[0], x[1] + 0.1 * u[0] + w[1]),
        lambda t, x, u, w, p: [x[0] + w[2]],
        step=0.1,
        x=("s", "v"),
        u="a",
        w=("d1", "d2", "noise"),
        y="s_measured",
    )


def test_an_observer_as_a_model_runs_in_simulations_with_inputs():
    """`simulate` gives it the plant's inputs; measurements feed it; what is not measured is not injected."""
    plant = double_integrator()
    model = observer_model(plant, [[-0.8], [-1.2]])
    cost = DiscountedCost(P=1.0, Q=[], R=1.0, eta=0.9, prior_eta=1.0)
    mhe = MHE(model, horizon=1.0, cost=cost, filtering=True, prior=Suboptimal(horizon=1.0), max_iterations=1)
    options = {"trigger": Periodic(0.1), "until": 5.0, "truth": [1.0, 0.5], "inputs": lambda t: [np.sin(t)]}
    result = simulate(plant, mhe, guess=[0.0, 0.0], **options)
    assert np.abs(result.dataset["x_hat"].values[-1] - result.dataset["x_true"].values[-1]).max() < 1e-2
    state = mhe.control(mhe.init(x=[1.0, 2.0]), Input(0.0, [0.0]))
    np.testing.assert_allclose(mhe.predict(state, 0.3).x, [1.6, 2.0])
    state = mhe.observe(state, Measurement(0.0, [0.0]))
    state, first = mhe.estimate(state, 0.0)
    injected = first.x + [0.1 * first.x[1], 0.0] + np.array([-0.8, -1.2]) * first.x[0]
    np.testing.assert_allclose(mhe.predict(state, 0.1).x, injected)
    np.testing.assert_allclose(mhe.predict(state, 0.2).x, injected + np.array([0.1 * injected[1], 0.0]))


def test_bad_requests_are_named():
    """Horizons, gains, candidates and limits that cannot be say what was given and what is needed."""
    options = {"horizon": 1.0, "cost": COST}
    model = three_species_discrete()
    with pytest.raises(InputError, match="shorter than the MHE's"):
        MHE(model, prior=Suboptimal(K, horizon=0.5), **options)
    with pytest.raises(InputError, match="finite gain"):
        MHE(model, prior=Suboptimal([[1.0]]), **options)
    with pytest.raises(InputError, match="give the auxiliary observer"):
        MHE(model, prior=Suboptimal(), **options)
    with pytest.raises(InputError, match="candidate must be one of"):
        Suboptimal(K, candidate="best")
    with pytest.raises(InputError, match="needs a candidate"):
        MHE(model, max_iterations=0, **options)
    with pytest.raises(InputError, match="guards the iterate"):
        MHE(model, max_iterations=3, solver="ipopt", **options)
    still = DiscreteModel(lambda t, x, u, w, p: x, lambda t, x, u, w, p: x[0] + w[0], step=1.0, x="a", y="b", w="v")
    with pytest.raises(InputError, match="needs disturbances"):
        MHE(still, horizon=3.0, cost=DiscountedCost(), prior=Suboptimal([[0.5]], candidate="observer"))
    with pytest.raises(InputError, match="hold='zero'"):
        MHE(
            three_species(),
            horizon=1.0,
            interval=0.5,
            integrator=RK4(0.5),
            hold="point",
            cost=DiscountedCost(),
            prior=Suboptimal(K),
        )
