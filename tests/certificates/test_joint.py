"""Joint detectability of states and parameters: the Lyapunov function, its conditions along a run, and the weights."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from ctmhe import MHE, Measurement
from ctmhe.certificates.excitation import ExcitationMonitor
from ctmhe.certificates.excitation_design import design_excitation
from ctmhe.certificates.excited_set import ExcitedSet
from ctmhe.certificates.increments import Increments
from ctmhe.certificates.injection import Units
from ctmhe.certificates.joint import (
    JointBound,
    certify_jointly,
    joint_bound,
    lyapunov_matrix,
    search_jointly,
    uniform_excitation,
    young_weights,
)
from ctmhe.certificates.weights import (
    StateDetectability,
    detect_states,
    detectability_margin,
    joint_weights,
    unmet,
)
from ctmhe.errors import CertificateError, InputError
from ctmhe.models import DiscreteModel
from ctmhe.models.library import batch_reactor, chua, chua_discrete
from ctmhe.types import Bounds
from tests.certificates.trajectories import decay, mixer, quadratic, trajectory

settings.register_profile("certificates", deadline=None, max_examples=8)
settings.load_profile("certificates")

STEPS = 40


@cache
def design(name: str, mu: float = 0.8):
    model = {"chua_discrete": chua_discrete, "mixer": mixer, "decay": decay}[name]()
    return design_excitation(model, u=(-1, 1), mu=mu)


@cache
def states(name: str) -> StateDetectability:
    model, eta = {"chua_discrete": (chua_discrete(), 0.91), "mixer": (mixer(), 0.95), "chua": (chua(), 0.3)}[name]
    return detect_states(model, u=(-1, 1), eta=eta)


def differences(first, second):
    """|(dx, dp)| at the nodes, dw and dy."""
    joint = [np.hstack([t.x, np.tile(t.p, (len(t.x), 1))]) for t in (first, second)]
    return joint[0] - joint[1], first.w - second.w, first.y - second.y


@pytest.mark.parametrize("name", ["chua_discrete", "mixer"])
@given(seed=st.integers(0, 10**6))
def test_the_joint_function_falls_over_a_window(name, seed):
    """U at the end is at most eta^N U(0) + discounted disturbances and outputs; with M_lower below it (5a), (5b)."""
    made, rng = design(name), np.random.default_rng(seed)
    first = trajectory(made.model, STEPS, rng)
    second = trajectory(made.model, STEPS, rng, u=first.u0)
    level = ExcitationMonitor(made).along(first).level
    if level < 1e-12:
        return
    joint = certify_jointly(made, alpha=level)
    e, dw, dy = differences(first, second)
    found = ExcitationMonitor(made).along(first, start=(np.zeros((len(made.P), len(joint.S_0))), joint.S_0))
    M = lyapunov_matrix(made.P, found.Y, found.matrix)
    fade = joint.eta ** (STEPS - 1 - np.arange(STEPS))
    right = joint.eta**STEPS * quadratic(joint.M_0, e[0])[0] + fade @ (quadratic(joint.Q, dw) + quadratic(joint.R, dy))
    assert quadratic(M, e[-1])[0] <= right * (1 + 1e-9)
    assert quadratic(joint.M_lower, e[-1])[0] <= quadratic(M, e[-1])[0] * (1 + 1e-9)
    assert eigh(M, joint.M_lower, eigvals_only=True)[0] >= 1 - 1e-6


def test_the_horizon_is_the_shortest_that_contracts():
    """4 kappa eta^N < 1 at N, not at N - 1; in continuous time equality."""
    joint = certify_jointly(design("mixer"), alpha=1.0)
    assert joint.rho(joint.horizon) < 1 <= joint.rho(joint.horizon - 1)
    flow = certify_jointly(design("decay"), alpha=1.0)
    assert flow.rho(flow.horizon) == pytest.approx(1.0)


def test_the_searched_factor_is_no_worse_than_others():
    """tr Q / -ln eta / (1 - rho) / level, the long-run error by (9) of paper 000, against a few other factors."""
    model = decay()
    window = trajectory(model, 60, np.random.default_rng(0), h=0.1, x=[2.0], p=[0.8], size=0.0)
    w = Units.of(model).w

    def error(joint):
        level = ExcitationMonitor(joint.design).along(window).level
        return np.trace(w @ joint.Q @ w) / -np.log(joint.eta) / (1 - joint.check(window).rho) / level

    found = search_jointly(model, window, u=(-1, 1))
    assert found.check(window) and found.check(window).rho < 1
    others = [certify_jointly(design("decay", mu), alpha=found.alpha) for mu in (0.2, 0.5)]
    assert error(found) <= 1.05 * min(map(error, others))
    none = np.zeros_like(window.u0)
    still = replace(window, x=np.zeros_like(window.x), u0=none, u1=none)
    with pytest.raises(CertificateError, match="says nothing of"):
        search_jointly(model, still, u=(-1, 1))


@pytest.mark.parametrize("eta", [0.35, 0.4, 0.9])
def test_state_detectability_is_found_at_any_slow_enough_rate(eta):
    """Rates at which the solver once failed, or the check used Jacobians that belong to no pair."""
    assert detect_states(chua(), eta=eta).margin >= -1e-9
    rates = {"k1": (0.1, 0.25)}
    found = detect_states(batch_reactor(parameters=("k1",)), Bounds(x=(0.1, 5), w=(-0.1, 0.1), p=rates), eta=eta)
    assert found.margin >= -1e-9 and found.rigorous


def test_conditions_along_a_run_tell_excitation_from_rest():
    """(33)-(34) hold where the circuit swings, with a kappa far below that of all pairs; at rest (34) fails, not (33).

    kappa: 1 + what Y couples and how little S has grown, against a bound by |Y| <= Y_max.
    """
    made, rng = design("chua_discrete", 0.9), np.random.default_rng(0)
    swinging = trajectory(made.model, 100, rng, x=[1.0, 0.0, -1.0], p=[0.45], size=0.1)
    level = ExcitationMonitor(made).along(swinging).level
    joint = certify_jointly(made, alpha=level / 2)
    found = joint.check(swinging)
    assert found and found.kappa < joint.kappa / 100 and found.rho < 1e-2
    still = replace(swinging, x=np.zeros_like(swinging.x), w=np.zeros_like(swinging.w))
    resting = joint.check(still, kappa=10.0)
    assert not resting and not resting.excited and resting.alpha == 0
    with pytest.raises(CertificateError, match="only where one trajectory gives"):
        replace(joint, design=replace(made, scope="local")).check(swinging)


def test_the_estimator_with_the_joint_cost_obeys_the_bound():
    """One full window, y measured without noise: U(T) <= 4 eta^T U(0) for the estimate's error, and p is found."""
    made = design("chua_discrete", 0.9)
    truth = trajectory(made.model, 61, np.random.default_rng(0), x=[1.0, 0.0, -1.0], p=[0.45], w=np.zeros((61, 4)))
    joint = certify_jointly(made, alpha=ExcitationMonitor(made).along(truth).level)
    mhe = MHE(made.model, horizon=0.6, cost=joint.cost(), bounds=made.model.bounds)
    guess, p = np.array([0.7, 0.2, -0.5]), np.array([0.7])
    state = mhe.init(x=guess, p=p)
    for t, y in zip(truth.t[:60], truth.y[:60], strict=True):
        state = mhe.observe(state, Measurement(float(t), y))
    estimate = mhe.estimate(state, 0.6)[1]
    found = ExcitationMonitor(made).along(estimate.trajectory, start=(np.zeros((3, 1)), joint.S_0))
    M = lyapunov_matrix(made.P, found.Y, found.matrix)
    start = np.concatenate([guess - truth.x[0], p - truth.p])
    end = np.concatenate([estimate.x - truth.x[60], estimate.p - truth.p])
    assert quadratic(M, end)[0] <= 4 * joint.eta**60 * quadratic(joint.M_0, start)[0]
    assert abs(estimate.p[0] - 0.45) < 0.01 < abs(p[0] - 0.45)


@given(eps1=st.floats(0.01, 0.2), eps2=st.floats(0.2, 5.0), a=st.floats(1e-3, 0.05))
@settings(max_examples=10)
def test_the_proofs_own_constants_are_valid_and_never_better(eps1, eps2, a):
    """(31)-(32) of paper 000, (7.55)-(7.57): they satisfy the inequality; the program's Q, R per a are no larger."""
    made = design("chua_discrete")
    factor, Q, R = young_weights(made, eps1=eps1, eps2=eps2, a=a)
    if not factor < 0.999:
        return
    theirs = replace(made, P=made.P / a, Q=Q / a, R=R / a, mu=factor)
    points = made.increments.between(*made.increments.random_pairs(100, np.random.default_rng(1)))
    assert theirs.slack(points).min() >= -1e-9
    best, nominal = design_excitation(made.model, mu=factor), Units.of(made.model)
    size = lambda d: np.trace(nominal.w @ d.Q @ nominal.w) + np.trace(nominal.y @ d.R @ nominal.y)  # noqa: E731
    assert size(best) <= size(theirs)


@pytest.mark.parametrize("name", ["chua_discrete", "mixer", "chua"])
@given(seed=st.integers(0, 10**6))
def test_states_are_detectable_with_parameters_as_disturbances(name, seed):
    """(5.5) for random pairs of points: f and h themselves, not their Jacobians."""
    found = states(name)
    assert found.rigorous and found.margin >= -1e-9
    model = {"chua_discrete": chua_discrete, "mixer": mixer, "chua": chua}[name]()
    increments = Increments(model, u=(-1, 1))
    v = increments.random_pairs(30, np.random.default_rng(seed))
    rows = [[row[increments.place[key]] for key in "xuwp"] for part in v for row in part]
    f, h = (
        np.array([np.asarray(function(0.0, *row)).ravel() for row in rows]).reshape(2, 30, -1)
        for function in (model.dynamics, model.output)
    )
    dx, dw, dp = ((v[0] - v[1])[:, increments.place[key]] for key in "xwp")
    U, df = quadratic(found.P_lower, dx), f[0] - f[1]
    supply = quadratic(found.S, dp) + quadratic(found.Q, dw) + quadratic(found.R, h[0] - h[1])
    if model.step:
        after, limit = quadratic(found.P_lower, df), found.eta * U + supply
    else:
        after, limit = 2 * np.einsum("ki,ij,kj->k", dx, found.P_lower, df), np.log(found.eta) * U + supply
    assert (after <= limit + 1e-7 * (np.abs(limit) + supply)).all()


def test_a_margin_is_negative_where_it_fails():
    """Half of R is too little somewhere."""
    model, found = chua_discrete(), states("chua_discrete")
    points = Increments(model).cover().jacobians
    weights = (found.P_lower, found.S, found.Q, found.R / 2)
    assert detectability_margin(Units.of(model), found.eta, weights, points).min() < 0


def test_weights_meet_their_conditions_and_smaller_ones_do_not():
    """(5.10)-(5.16) with equality; each weight or discount taken below its floor is named."""
    found, excited = states("chua_discrete"), design("chua_discrete").excited_set(1e-3)
    weights = joint_weights(found, excited, caution=3)
    scaled = found.scaled(1 / float(eigh(found.S, excited.S, eigvals_only=True)[-1]))
    assert unmet(weights, scaled, excited) == ()
    np.testing.assert_allclose(weights.W, 2 * scaled.P_upper)
    np.testing.assert_allclose(weights.V, 6 * excited.S)
    assert weights.gamma(0) == pytest.approx(1 + eigh(excited.P, scaled.P_upper, eigvals_only=True)[-1])
    for change, word in (
        ({"W": weights.W / 2}, "(5.13)"),
        ({"V": weights.V / 4}, "(5.14)"),
        ({"Q": weights.Q * 0.9}, "(5.15)"),
        ({"R": weights.R * 0.9}, "(5.16)"),
        ({"ratio": 0.0}, "(5.10)"),
        ({"eta_1": 0.5}, "(5.11)"),
        ({"eta_2": 0.5}, "(5.12)"),
    ):
        said = unmet(replace(weights, **change), scaled, excited)
        assert len(said) == 1 and said[0].startswith(word)
    for bad, words in (({"eta_1": 0.5}, "5.11"), ({"eta_2": 1.0}, "5.12"), ({"caution": 0.5}, "5.14")):
        with pytest.raises(InputError, match=words):
            joint_weights(found, excited, **bad)


def test_weights_for_parameters_that_vary_are_not_discounted():
    """(5.77)-(5.79): eta_2 = 1 and Q_v = B_p' V_bar B_p on top."""
    B_p = np.array([[0.0, 0.0, 1e-3, 0.0]])
    made = design_excitation(chua_discrete(), mu=0.8, B_p=B_p)
    found, excited = states("chua_discrete"), made.excited_set(1e-3, horizon=100)
    weights, without = joint_weights(found, excited, B_p=B_p), joint_weights(found, excited)
    assert weights.eta_2 == 1.0
    np.testing.assert_allclose(weights.Q - without.Q, B_p.T @ weights.V @ B_p, atol=1e-12)


@given(seed=st.integers(0, 10**6))
def test_states_and_excitation_together_bound_both(seed):
    """(5.69) on random excited pairs of the mixer: Proposition 5.1, (a) to (b)."""
    made, rng = design("mixer"), np.random.default_rng(seed)
    first = trajectory(made.model, STEPS, rng)
    second = trajectory(made.model, STEPS, rng, u=first.u0)
    level = ExcitationMonitor(made).along(first).level
    if level < 1e-9:
        return
    bound = joint_bound(states("mixer"), made.excited_set(level), T=STEPS)
    e, dw, dy = differences(first, second)
    for t in (1, STEPS // 2, STEPS):
        fade = bound.eta ** (t - 1 - np.arange(t))
        supply = fade @ (quadratic(bound.Q, dw[:t]) + quadratic(bound.R, dy[:t]))
        assert bound.lower * e[t] @ e[t] <= (bound.upper * bound.eta**t * e[0] @ e[0] + supply) * (1 + 1e-9)


def test_a_joint_bound_makes_every_long_pair_excited():
    """Proposition 5.1, (b) to (a): from a joint Lyapunov function of an observable system, (7.46) for all K >= T.

    Only for systems excited by themselves: x+ = x + p with y = x. G from the Riccati equation of (x, p).
    """
    model = DiscreteModel(
        lambda t, x, u, w, p: x + p + w[0], lambda t, x, u, w, p: x + w[1], step=1.0, x="x", w=("w", "v"), p="p", y="y",
        bounds=Bounds(x=(-5, 5), w=(-0.1, 0.1), p=(-1, 1)),
    )  # fmt: skip
    both = DiscreteModel(
        lambda t, x, u, w, p: (x[0] + x[1] + w[0], x[1]), lambda t, x, u, w, p: x[0] + w[1],
        step=1.0, x=("x", "p"), w=("w", "v"), y="y", bounds=Bounds(x=(-5, 5), w=(-0.1, 0.1)),
    )  # fmt: skip
    G = detect_states(both, eta=0.7)
    values = np.linalg.eigvalsh(G.P_lower)
    T, excited = uniform_excitation(JointBound(values[0], values[-1], G.eta, G.Q, G.R), states=1, parameters=1)
    assert isinstance(excited, ExcitedSet) and (np.linalg.eigvalsh(excited.S) > 0).all()
    rng = np.random.default_rng(0)
    for K in (T, T + 1):
        for _ in range(4):
            first, second = trajectory(model, K, rng), trajectory(model, K, rng)
            _, dw, dy = differences(first, second)
            fade = excited.eta ** (K - 1 - np.arange(K))
            supply = fade @ (quadratic(excited.Q, dw) + quadratic(excited.R, dy))
            right = excited.eta**K * quadratic(excited.P, first.x[0] - second.x[0])[0] + supply
            assert quadratic(excited.S, first.p - second.p)[0] <= right


def test_bad_requests_are_explained():
    """An alpha or S_0 that is not positive; parameters that vary; a rate that no quadratic function has."""
    made = design("mixer")
    with pytest.raises(InputError, match="alpha must be a positive"):
        certify_jointly(made, alpha=0.0)
    with pytest.raises(InputError, match="S_0 must be a symmetric positive definite"):
        certify_jointly(made, alpha=1.0, S_0=np.diag([1.0, -1.0]))
    with pytest.raises(InputError, match="for constant parameters"):
        certify_jointly(design_excitation(chua_discrete(), mu=0.8, B_p=np.zeros((1, 4))), alpha=1.0)
    with pytest.raises(InputError, match=r"eta must lie in \(0, 1\)"):
        detect_states(mixer(), u=(-1, 1), eta=1.0)
    unstable = DiscreteModel(
        lambda t, x, u, w, p: (0.5 * x[0], 1.2 * x[1] + p[0]), lambda t, x, u, w, p: x[0],
        step=1.0, x=("a", "b"), p="p", y="y", bounds=Bounds(p=(0, 1)),
    )  # fmt: skip
    with pytest.raises(CertificateError, match=r"no quadratic function at eta = 0.9"):
        detect_states(unstable, eta=0.9)
