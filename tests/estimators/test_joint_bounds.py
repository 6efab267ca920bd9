"""Bounds of joint estimates against the truth: thesis (5.42) with Lemmas 5.1 and 5.2, and (9) of paper 000."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe import MHE, RK4, Bounds, DiscountedCost, Measurement
from ctmhe.certificates import (
    ExcitationMonitor,
    JointGuarantee,
    certify_jointly,
    design_excitation,
    detect_states,
    joint_conditions,
    joint_weights,
)
from ctmhe.certificates.joint_bounds import Errors, Evidence, JointBounds
from ctmhe.estimators.priors.checked import CheckedPrior
from ctmhe.estimators.priors.joint import ExcitedPrior
from ctmhe.models.library import chua, chua_discrete

ALPHA, N, TRUE = 2e-4, 150, 0.45
SIZES = 1e-4 * np.array([1e-3, 1e-3, 1e-3, 0.1])


@cache
def parts():
    """Design, states, excited set and weights of thesis 5.2.4, as designed here."""
    model = chua_discrete()
    states, design = detect_states(model, eta=0.91), design_excitation(model, mu=0.747)
    excited = design.excited_set(ALPHA)
    return model, design, states, excited, joint_weights(states, excited, eta_1=0.934, eta_2=0.9997, caution=50)


def guarantee(**changes) -> JointGuarantee:
    _, _, states, excited, weights = parts()
    return JointGuarantee(**{"states": states, "excited": excited, "weights": weights, "disturbance": SIZES} | changes)


def estimator(*, horizon=N, given=None, **options) -> MHE:
    """The estimator of 5.2.4 with its bound."""
    model, design, _, _, weights = parts()
    prior = ExcitedPrior(ExcitationMonitor(design), ALPHA, guarantee=given or guarantee(), **options.pop("prior", {}))
    settings_ = {"cost": weights.cost(model), "bounds": model.bounds, "prior": prior} | options
    return MHE(model, horizon=horizon * 0.01, **settings_)


def run(mhe: MHE, steps: int, *, seed=0, x=(1.0, 0.0, -1.0), sizes=SIZES, extreme=False, lost=(), guess=None):
    """Errors of states and parameters and the bounds, one estimate a step, in the prediction form."""
    model, rng, errors, bounds = chua_discrete(), np.random.default_rng(seed), [], []
    state = mhe.init(x=[-1, 0.1, 2] if guess is None else guess[:3], p=[0.2] if guess is None else guess[3:])
    for k in range(steps):
        w = rng.uniform(-1, 1, 4) * sizes
        w = np.sign(w) * sizes if extreme else w
        y = x[0] + w[3]
        x = np.asarray(model.dynamics(0.0, x, [], w, [TRUE])).ravel()
        if k not in lost:
            state = mhe.observe(state, Measurement(k * 0.01, [y]))
        state, estimate = mhe.estimate(state, (k + 1) * 0.01)
        errors.append(np.concatenate([estimate.x - x, estimate.p - TRUE]))
        bounds.append(estimate.bound)
    return np.array(errors), bounds


def ratios(errors, bounds):
    """The largest error over its bound: of the two norms, and of single entries."""
    found = []
    for e, bound in zip(errors, bounds, strict=True):
        norm = float(e @ bound.P_lower @ e)
        found += [norm / value for value in (bound.level, bound.theorem) if value is not None]
        if bound.radii is not None:
            found.append(float((np.abs(e) / bound.radii).max()))
    return max(found)


@settings(max_examples=2)
@given(seed=st.integers(0, 10**6), extreme=st.booleans(), x3=st.floats(-1.2, -0.5))
def test_the_bounds_of_5_42_hold_along_runs(seed, extreme, x3):
    """Whatever the disturbances within their sizes, at the corners of their set too."""
    errors, bounds = run(estimator(), 230, seed=seed, x=(1.0, 0.0, x3), extreme=extreme)
    assert ratios(errors, bounds) <= 1
    assert all(bound.level is not None and bound.theorem is not None for bound in bounds)


def test_they_say_something_where_the_noise_is_small_and_an_open_guess_breaks_them():
    """Negative control: the initial guess of p, kept, exceeds what is guaranteed of the estimate."""
    errors, bounds = run(estimator(), 230)
    k = int(np.argmin([bound.level for bound in bounds]))  # windows that start with p unknown say less
    best = bounds[k]
    assert best.level < 1e-2 * best.cap and min(bound.theorem for bound in bounds) < 0.7 * best.cap
    assert best.radii[3] < 0.02 < abs(0.2 - TRUE) and bounds[-1].radii[3] < 0.02
    kept = np.append(errors[k][:3], 0.2 - TRUE)
    assert kept @ best.P_lower @ kept > best.level


def test_a_disturbance_larger_than_stated_is_noticed_or_has_no_bound():
    """A negative control of the premise: noise a thousand times the stated one; (5.42) is then not claimed."""
    _, bounds = run(estimator(), 60, sizes=1e3 * SIZES)
    assert any(bound.theorem is None and "larger than stated" in bound.reasons[0] for bound in bounds)


def random_evidence(rng, n, level, growing) -> Evidence:
    model = parts()[0]
    size = [model.x.nominal, model.p.nominal]
    x, p = (0.1 * rng.normal(size=len(part)) * part for part in size)
    return Evidence(x, p, SIZES * rng.uniform(-1, 1, (n, 4)), 1e-5 * rng.normal(size=(n, 1)), growing, level)


@given(seed=st.integers(0, 10**6), k=st.integers(0, 4))
def test_the_recursion_is_not_above_the_theorem(seed, k):
    """Lemmas 5.1 and 5.2 from window to window give at most the right side of (5.42), with |w| constant."""
    _, _, states, excited, weights = parts()
    rng = np.random.default_rng(seed)
    bounds = JointBounds(guarantee(), N, ALPHA, SIZES, 1e300, 1e300)
    scaled, met = states.scaled(weights.scale), joint_conditions(weights, bounds.states, excited, horizon=N)
    first, told = Errors(1e-4, 1e-4, 1e-4), 1e-4
    excitement = rng.random(k) < 0.5
    l = int(rng.integers(1, N))  # noqa: E741
    errors = bounds.theorem(first, told, random_evidence(rng, l, 0.0, True))
    for excited_now in excitement:
        found = random_evidence(rng, N, 2 * ALPHA if excited_now else 0.0, False)
        errors = bounds.theorem(errors, errors.told, found)
    ratio = lambda A, B: float(np.linalg.eigvals(np.linalg.solve(B, A)).real.max())  # noqa: E731
    c_1 = ratio(scaled.S, weights.V / 2) * (1 - states.eta**N) / (1 - states.eta) + 2
    c_2 = met.c * ratio(weights.V, excited.S) + ratio(scaled.S, excited.S) * (1 - states.eta**N) / (1 - states.eta)
    mu, rho = max(met.excited, met.prior), max(met.bounded, weights.eta_2**N)
    C_0, C_1 = 2 * met.c, weights.eta_1**-N * c_1 * (2 + weights.ratio)
    C_2 = (2 * c_1 + 0.5) * weights.eta_1**-N
    signs = np.array(np.meshgrid(*[(-1, 1)] * 4)).reshape(4, -1).T * SIZES
    energy = 2 * max(weights.eta_1**-N * c_1, c_2) * np.einsum("ki,ij,kj->k", signs, weights.Q, signs).max()
    count, fade = int(excitement.sum()), max(states.eta, excited.eta)
    geometric = lambda rate, n: n if rate == 1 else (1 - rate**n) / (1 - rate)  # noqa: E731
    V = ratio(weights.V, excited.S) * first.prior
    right = mu**count * (C_1 * fade**l * ratio(weights.W, scaled.P_upper) * first.state + C_2 * weights.eta_1**l * V)
    right += mu**count * energy * geometric(weights.eta_2, l)
    last = np.flatnonzero(excitement)
    j = k - 1 - last[-1] if len(last) else k
    right += energy * geometric(rho ** (1 / N), j * N)
    both = max(mu ** (1 / N), rho ** (1 / N))
    starts = [-1, *last][: len(last)]
    for m, (end, start) in enumerate(zip(last[::-1], starts[::-1], strict=True)):
        right += mu**m * energy * geometric(both, (end - start) * N)
    assert errors.state <= C_0 * right * (1 + 1e-9)


@pytest.mark.parametrize(
    ("make", "text", "level"),
    [
        (lambda: estimator(prior={"directions": True}), "directions have no bound", False),
        (lambda: estimator(bounds=None), "may leave the domain of the design", False),
        (lambda: estimator(filtering=True), "filtering form", False),
        (lambda: estimator(given=guarantee(disturbance=1.0)), "leave the domain: w_x1, w_x2", False),
        (lambda: estimator(given=guarantee(excited=parts()[1].excited_set(1e-3))), "another alpha", False),
        (lambda: estimator(horizon=20), "too short", True),
        (lambda: estimator(cost=DiscountedCost(P=np.eye(4), Q=1.0, R=1.0)), "not that of the guarantee's", True),
    ],
)
def test_without_its_premises_there_is_no_bound_and_the_reason_is_told(make, text, level):
    """None with the reason; what was found in the window bounds the error whatever the weights and the horizon."""
    errors, bounds = run(make(), 25)
    assert all(bound.theorem is None and any(text in reason for reason in bound.reasons) for bound in bounds)
    assert all((bound.level is not None) == level for bound in bounds)
    if level:
        assert ratios(errors, bounds) <= 1


def test_a_window_that_lacks_a_measurement_has_no_bound_and_later_ones_are_right():
    """The lost step is named while it is in the window; then bounds start anew from the domain, and hold."""
    errors, bounds = run(estimator(horizon=30), 100, lost=(20,))
    assert all("no complete measurement" in bound.reasons[0] and bound.size is None for bound in bounds[20:50])
    assert all(bound.level is not None for bound in (*bounds[:20], *bounds[51:]))
    assert ratios(errors[51:], bounds[51:]) <= 1


def test_local_designs_and_continuous_time_have_no_bound():
    """(5.42) counts steps; and a local design says nothing of the pair with the truth."""
    model, design, *_ = parts()
    local = ExcitedPrior(ExcitationMonitor(replace(design, scope="local")), ALPHA, guarantee=guarantee())
    mhe = MHE(model, horizon=1.5, cost=parts()[4].cost(model), bounds=model.bounds, prior=local)
    bound = run(mhe, 3)[1][-1]
    assert bound.size is None and "the design is local" in bound.reasons[0]
    flow = chua()
    prior = ExcitedPrior(ExcitationMonitor(design_excitation(flow, mu=0.1)), ALPHA, guarantee=guarantee())
    mhe = MHE(
        flow, horizon=0.5, interval=0.05, integrator=RK4(0.01), cost=DiscountedCost(P=np.eye(4)), bounds=flow.bounds,
        prior=prior,
    )  # fmt: skip
    state = mhe.observe(mhe.init(x=[1, 0, -1]), Measurement(0.1, [1.0]))
    bound = mhe.estimate(state, 0.1)[1].bound
    assert bound.size is None and "discrete time" in bound.reasons[0]


@cache
def checked() -> MHE:
    """The estimator of paper 000, section 5, for small noise."""
    model = chua_discrete()
    domain = Bounds(x=model.bounds.x | {"x1": (-5.0, 5.0)}, w=model.bounds.w, p=model.bounds.p)
    joint = certify_jointly(design_excitation(model, domain, mu=0.911), alpha=1e-6, S_0=[[1e-3]])
    prior = CheckedPrior(joint, kappa=1e7, disturbance=SIZES)
    return MHE(model, horizon=2.0, cost=joint.cost(), bounds=domain, prior=prior)


@settings(max_examples=2)
@given(seed=st.integers(0, 10**6), extreme=st.booleans())
def test_the_bound_of_paper_000_holds_along_runs(seed, extreme):
    """(9), and what the windows found, in the norm of each window's own M; they contract while (33) holds."""
    errors, bounds = run(checked(), 230, seed=seed, x=(2.0, 0.1, -2.0), extreme=extreme, guess=[0, 0, 0, 0.2])
    assert ratios(errors, bounds) <= 1
    assert all(bound.theorem is not None for bound in bounds)
    assert bounds[-1].level < 1e-6 * bounds[-1].cap and bounds[-1].theorem < 1e-6 * bounds[-1].cap
    start = np.array([0.0, 0.0, 0.0, 0.2 - TRUE]) + np.append(errors[-1][:3], 0.0)
    assert start @ bounds[-1].P_lower @ start > bounds[-1].level  # the first guess of p breaks it


def test_conditions_that_are_not_met_are_told():
    """At rest (34) fails, and a small kappa fails (33); the estimate stays usable."""
    mhe = checked()
    strict = CheckedPrior(mhe.prior.joint, kappa=1.0 + 1e-9)
    other = MHE(chua_discrete(), horizon=2.0, cost=mhe.cost, bounds=mhe.bounds, prior=strict)
    for one, text in ((mhe, "(34) is not met"), (other, "(33) is not met")):
        state = one.init(x=[0, 0, 0], p=[0.2])
        for k in range(201):
            state, estimate = one.estimate(one.observe(state, Measurement(k * 0.01, [0.0])), (k + 1) * 0.01)
        assert any(note.startswith(text) for note in estimate.status.notes) and estimate.status.success
    assert estimate.bound is None  # no disturbance= was given


def test_the_checked_prior_is_the_filtering_prior():
    """It watches; estimates are those without it, bit for bit, and a saved state goes on."""
    mhe = checked()
    plain = MHE(chua_discrete(), horizon=2.0, cost=mhe.cost, bounds=mhe.bounds)
    a, b = (run(one, 40, x=(2.0, 0.1, -2.0), guess=[0, 0, 0, 0.2])[0] for one in (mhe, plain))
    np.testing.assert_allclose(a, b, atol=1e-9)
