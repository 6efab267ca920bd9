"""Bounds of suboptimal estimates hold against the truth, and something breaks them. Thesis (4.35), (4.41), (4.45)."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ctmhe import MHE, RK4, Bounds, DiscountedCost, DiscreteModel, Guarantee, Measurement
from ctmhe.certificates import certify_detectability
from ctmhe.certificates.observers import LuenbergerObserver, design_observer
from ctmhe.certificates.suboptimal_horizons import Lipschitz, observer_horizon
from ctmhe.estimators import Suboptimal
from ctmhe.models.library import three_species, three_species_discrete

STEP, N, ETA = 0.25, 3, 0.9383
TRUTH, GUESS = np.array([0.5, 0.05, 0.1]), np.array([0.8, 0.1, 0.15])
FIRST = (0.31, 0.06, 0.06)  # how wrong the guess may be
D, V = 1e-5, 1e-3
SIZES = {"w_cA": D, "w_cB": D, "w_cC": D, "v_total": V}
BOX = Bounds(x=(0.0, 3.0))
WIDE = Bounds(x={"cA": (-1, 4), "cB": (-0.04, 4.0), "cC": (-2.0, 4.0)})


@cache
def observer() -> LuenbergerObserver:
    """Return a certified observer."""
    model = three_species_discrete()
    return design_observer(model, Bounds(x=WIDE.x, w=model.bounds.w), eta=0.97)


@cache
def certificate(eta: float = ETA, *, domain: str = "X"):
    """Return U."""
    model = three_species_discrete()
    x = BOX.x if domain == "X" else WIDE.x
    return certify_detectability(model, Bounds(x=x, w=model.bounds.w), eta=eta, Q=[1e2] * 4, R=50.0)


@cache
def estimator(
    candidate: str,
    T: float,
    limit: int | None,
    *,
    filtering: bool = False,
    eta: float = ETA,
    gain_only: bool = False,
    box: bool = True,
) -> MHE:
    """Return suboptimal MHE with a guarantee."""
    U, watch = certificate(), observer().K if gain_only else observer()
    return MHE(
        three_species_discrete(),
        horizon=N * STEP,
        cost=DiscountedCost(P=2 * U.P_upper, Q=2 * U.Q, R=U.R, eta=eta, prior_eta=1.0),
        bounds=BOX if box else None,
        filtering=filtering,
        max_iterations=limit,
        prior=Suboptimal(watch, horizon=T, candidate=candidate),
        guarantee=Guarantee(U, disturbance=SIZES, error=FIRST),
    )


def runs(mhe: MHE, *, factor: float = 1.0, seed: int = 0, n: int = 120, worst: bool = False, guess=GUESS):
    """Return sizes of errors, of an open loop's errors, and the bounds; disturbances are `factor` times as stated."""
    model, rng = mhe.model, np.random.default_rng(seed)
    state, x, free = mhe.init(x=guess), TRUTH, guess
    sizes, loops, bounds = [], [], []
    for k in range(n):
        w = rng.uniform(-1, 1, 4)
        w = factor * np.array([D, D, D, V]) * (np.sign(w) if worst else w)
        y = np.asarray(model.output(0, x, [], w, [])).ravel()
        if mhe.assembly.filtering:
            state = mhe.observe(state, Measurement(k * STEP, y))
        state, estimate = mhe.estimate(state, k * STEP)
        if not mhe.assembly.filtering:
            state = mhe.observe(state, Measurement(k * STEP, y))
        size = mhe.guaranteed.bounds.certificate.size
        sizes.append(size(estimate.x - x))
        loops.append(size(free - x))
        bounds.append(estimate.bound)
        x, free = (np.asarray(model.dynamics(0, z, [], v, [])).ravel() for z, v in ((x, w), (free, 0 * w)))
    return np.array(sizes), np.array(loops), bounds


@pytest.mark.parametrize("limit", [0, 1, None])
@pytest.mark.parametrize("T", [np.inf, 350 * STEP, 5 * STEP])
@pytest.mark.parametrize("candidate", ["system", "observer"])
def test_bounds_hold_whatever_the_iterations(candidate, T, limit):
    """The error stays below the bound of the found cost, which is below the theorem's where (4.44) is met."""
    for seed, worst in ((0, False), (1, True)):
        sizes, _, bounds = runs(estimator(candidate, T, limit), seed=seed, worst=worst, n=60)
        levels = np.sqrt([bound.level for bound in bounds])
        assert (sizes <= levels).all()
        theorems = [bound.theorem for bound in bounds]
        if T > 10:
            assert np.isnan(np.array(theorems, dtype=float)).sum() == 0
            assert (levels <= np.sqrt(np.array(theorems)) * (1 + 1e-9)).all()
        else:
            assert theorems == [None] * len(bounds) and "(4.44)" in bounds[-1].reasons[0]


def test_an_open_loop_breaks_the_bound():
    """What the bound says is not nothing: the prediction from the wrong guess exceeds it, and so do larger noises."""
    mhe = estimator("observer", np.inf, 1)
    _, loops, bounds = runs(mhe)
    assert (loops[60:] > [bound.size for bound in bounds[60:]]).any()
    sizes, _, bounds = runs(mhe, factor=300.0, worst=True)
    assert (sizes > [np.sqrt(bound.theorem if bound.theorem < bound.level else bound.level) for bound in bounds]).any()


@pytest.mark.parametrize("options", [{"filtering": True}, {"eta": 1.0}, {"filtering": True, "eta": 1.0}])
def test_bounds_hold_in_other_forms(options):
    """In the filtering form, and with a cost that is not discounted, eta_bar = 1."""
    for limit in (0, 2):
        sizes, _, bounds = runs(estimator("system", np.inf, limit, **options), worst=True)
        assert (sizes <= [bound.size for bound in bounds]).all()


def test_projections_widen_the_bound_by_what_they_moved():
    """From a guess that drives the observer out of X the bound still holds, and knows the projection error."""
    for candidate in ("system", "observer"):
        U = certificate()
        mhe = MHE(
            three_species_discrete(),
            horizon=N * STEP,
            cost=DiscountedCost(P=2 * U.P_upper, Q=2 * U.Q, R=U.R, eta=ETA, prior_eta=1.0),
            bounds=BOX,
            max_iterations=0,
            prior=Suboptimal(observer(), candidate=candidate),
            guarantee=Guarantee(U, disturbance=SIZES, error=(2.0, 1.0, 0.2)),
        )
        sizes, _, bounds = runs(mhe, guess=np.array([2.4, 1.0, 0.05]))
        assert (sizes <= [bound.size for bound in bounds]).all()


def test_no_bound_without_a_certified_observer():
    """A bare gain, bounds that do not keep to the domain, lost data: none, or none by theorem, and the reason."""
    _, _, bounds = runs(estimator("system", np.inf, 1, gain_only=True), n=5)
    assert all(bound.size is None and "without certificate" in str(bound) for bound in bounds)
    _, _, bounds = runs(estimator("system", np.inf, 1, box=False), n=5)
    assert all(bound.size is None and "may leave" in str(bound) for bound in bounds)
    mhe = estimator("system", np.inf, 1)
    state = mhe.init(x=GUESS)
    for k in range(12):
        state, estimate = mhe.estimate(state, k * STEP)
        if k != 4:
            state = mhe.observe(state, Measurement(k * STEP, [0.65]))
    assert estimate.bound.theorem is None


def test_doubts_outlast_the_window():
    """An observer that is initialised once never forgets doubtful data: no theorem after them, and a wide bound."""
    mhe = estimator("system", np.inf, 1)
    state = mhe.init(x=GUESS)
    for k in range(20):
        if k == 6:
            state = mhe.doubt(state, 5 * STEP, "a message was altered")
        state, estimate = mhe.estimate(state, k * STEP)
        state = mhe.observe(state, Measurement(k * STEP, [0.65]))
        assert estimate.bound is not None and (estimate.bound.theorem is None) is (k >= 6)
    anew = estimator("system", 5 * STEP, 1)
    wide = anew.estimate(state, 20 * STEP)[1].bound.level  # another rule goes on, without what this one knew
    assert wide > 1e2 * estimator("system", np.inf, 1).estimate(mhe.init(x=GUESS), 0.0)[1].bound.level


def test_states_of_other_estimators_can_be_continued():
    """From a filtering prior, and from another observer: estimates go on, bounds begin at the domain's width."""
    plain = MHE(three_species_discrete(), horizon=N * STEP, cost=DiscountedCost(P=1.0, Q=200.0, R=50.0), bounds=BOX)
    state = plain.init(x=GUESS)
    for k in range(8):
        state, _ = plain.estimate(state, k * STEP)
        state = plain.observe(state, Measurement(k * STEP, [0.65]))
    mhe = estimator("observer", np.inf, 1)
    state, estimate = mhe.estimate(state, 8 * STEP)
    assert np.isfinite(estimate.x).all() and estimate.bound.theorem is None


def test_the_horizon_condition_is_that_of_the_certificates():
    """The theorem is given exactly from T_min of (4.44) on."""
    U, watch = certificate(), observer()
    mhe = estimator("observer", np.inf, 1)
    ratio = np.linalg.eigvals(np.linalg.solve(watch.function.P_lower, U.P_upper)).real.max()
    V = watch.function.scaled(ratio * (1 + 1e-12))
    lipschitz, Q_s = Lipschitz.of(mhe.model, watch.domain), U.Q[:3, :3]
    least = observer_horizon(V, U, horizon=N, L_h=lipschitz.h, kappa=watch.kappa, Q_s=Q_s)
    for T, expected in ((least - 1, True), (least, False)):
        _, _, bounds = runs(estimator("observer", T * STEP, 0), n=3)
        assert (bounds[-1].theorem is None) is expected


@pytest.mark.parametrize("candidate", ["system", "observer"])
def test_the_theorem_holds_over_many_restarts_of_the_observer(candidate):
    """A scalar system whose T_min is a few steps: errors stay below (4.35) chained from restart to restart."""
    model = DiscreteModel(
        lambda t, x, u, w, p: 0.6 * x + w[0],
        lambda t, x, u, w, p: x[0] + w[1],
        step=1.0,
        x="a",
        y="b",
        w=("d", "v"),
        bounds=Bounds(x=(-10.0, 10.0), w=(-1.0, 1.0)),
    )
    U = certify_detectability(model, eta=0.5)
    watch = design_observer(model, eta=0.5)
    cost = DiscountedCost(P=2 * U.P_upper, Q=2 * U.Q, R=U.R, eta=U.eta, prior_eta=1.0)
    small = Guarantee(U, disturbance=[1e-3, 1e-3], error=[2.0])
    options = {"horizon": 2.0, "cost": cost, "bounds": Bounds(x=(-10.0, 10.0)), "guarantee": small}
    mhe = MHE(model, prior=Suboptimal(watch, horizon=40.0, candidate=candidate), max_iterations=0, **options)
    state, x, rng = mhe.init(x=[2.0]), np.array([0.5]), np.random.default_rng(0)
    for k in range(130):
        state, estimate = mhe.estimate(state, float(k))
        assert mhe.guaranteed.bounds.certificate.size(estimate.x - x) ** 2 <= estimate.bound.theorem
        w = 1e-3 * np.sign(rng.uniform(-1, 1, 2))
        state = mhe.observe(state, Measurement(float(k), x + w[1]))
        x = 0.6 * x + w[0]
    assert len(state.memory["observer"]) == 41
    assert estimate.bound.theorem < 1e-2 * mhe.guaranteed.bounds.certificate.size(np.array([1.5])) ** 2


def test_in_continuous_time_the_found_cost_bounds_the_error():
    """With dz/dt = f + K (h - y) and its V_o, (4.41) holds along a run; no theorem is claimed."""
    model = three_species()
    narrow = Bounds(x={"cA": (0.0, 1.0), "cB": (0.0, 1.0), "cC": (0.0, 1.0)}, w=model.bounds.w)
    wide = Bounds(x={"cA": (-0.5, 1.5), "cB": (-0.04, 1.5), "cC": (-0.5, 1.5)}, w=model.bounds.w)
    watch = design_observer(model, wide, eta=0.9)
    U = certify_detectability(model, narrow, eta=0.8, Q=[1e2] * 4, R=50.0)
    d, v, dt = 1e-4, 2e-2, 0.1
    for candidate, limit in (("system", 0), ("observer", 0), ("observer", None)):
        mhe = MHE(
            model,
            horizon=0.6,
            interval=dt,
            integrator=RK4(dt),
            cost=DiscountedCost(P=2 * U.P_upper, Q=2 * U.Q, R=U.R, eta=0.8, prior_eta=1.0),
            bounds=Bounds(x=narrow.x),
            max_iterations=limit,
            prior=Suboptimal(watch, horizon=3.0, candidate=candidate),
            guarantee=Guarantee(U, disturbance=[d, d, d, v], error=FIRST),
        )
        state, x, rng = mhe.init(x=GUESS), TRUTH, np.random.default_rng(0)
        for k in range(80):
            w = rng.uniform(-1, 1, 4) * [d, d, d, 0.4 * v]  # the rest is for holding records
            y = x.sum() + w[3]
            state = mhe.observe(state, Measurement(k * dt, [y]))
            if k % 3 == 0:
                state, estimate = mhe.estimate(state, k * dt)
                assert mhe.guaranteed.bounds.certificate.size(estimate.x - x) <= estimate.bound.size
                assert estimate.bound.theorem is None and "discrete time" in estimate.bound.reasons[0]
            x, _ = mhe.stage.step(k * dt, dt, x, w, np.empty(0), np.empty(0), np.empty(0))
