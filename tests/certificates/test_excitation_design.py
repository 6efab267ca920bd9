"""The design behind excitation monitoring claims an inequality; nothing found at random breaks it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from ctmhe import FmuModel
from ctmhe.certificates.excitation import ExcitationMonitor
from ctmhe.certificates.excitation_design import design_excitation, filter_bounds
from ctmhe.certificates.injection import least_upper_bound, phi_factor
from ctmhe.errors import CertificateError, InputError
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import batch_reactor, chua, chua_discrete, cstr
from ctmhe.types import Bounds
from tests.certificates.trajectories import decay, inside, mixer, quadratic, rate, trajectory

settings.register_profile("certificates", deadline=None, max_examples=10)
settings.load_profile("certificates")

B_P = {"chua_discrete": np.array([[0.0, 0.0, 1.0, 0.0]]), "decay": np.array([[0.3, 0.0]])}


@cache
def design(name: str, mu: float = 0.8, drift: bool = False):
    """One design a model."""
    made = {"chua": chua, "chua_discrete": chua_discrete, "mixer": mixer, "decay": decay, "scaled": scaled}
    if name == "reactor":  # the sum of two states is seen: what is unseen is no coordinate, and varies
        rates = {"k1": (0.1, 0.25), "k2": (0.3, 1.0)}
        return design_excitation(batch_reactor(parameters=rates), Bounds(x=(0.1, 5), w=(-0.1, 0.1), p=rates), mu=0.4)
    model = made[name]()
    return design_excitation(model, u=(-1, 1), mu=mu, B_p=B_P[name] if drift else None)


def scaled() -> DiscreteModel:
    """Nonlinear outputs and a parameter in them: neither constant Phi nor a global result."""
    return DiscreteModel(
        lambda t, x, u, w, p: 0.7 * x[0] + 0.2 * u[0] + w[0],
        lambda t, x, u, w, p: p[0] * x[0] + 0.2 * x[0] ** 2 + w[1],
        step=1.0, x="x", u="u", w=("w", "v"), p="p", y="y",
        bounds=Bounds(x=(-1, 1), w=(-0.1, 0.1), p=(1, 2)), name="scaled",
    )  # fmt: skip


NAMES = ["chua", "chua_discrete", "mixer", "decay", "scaled", "reactor"]


@pytest.mark.parametrize("name", NAMES)
@given(seed=st.integers(0, 10**6))
def test_w_falls_along_every_pair(name, seed):
    """W+ <= mu W + |dw|^2_Q + |dy|^2_R for random points of the domain and any filter state Y, S: (7.58)."""
    made, rng = design(name), np.random.default_rng(seed)
    increments, model = made.increments, made.model
    v1, v2 = increments.random_pairs(50, rng)
    if seed % 2:  # nearby pairs too
        v2 = v1 + 1e-3 * (v2 - v1)
    Phi, G, C, F = made.recursion(increments.between(v1, v2))
    o, n = len(model.p), len(model.x)
    Y = rng.normal(size=(50, n, o)) * increments.nominal[increments.place["x"]][:, None] * rng.choice([0, 0.1, 1, 10])
    S = np.array([root @ root.T for root in rng.normal(size=(50, o, o))])
    seen = C @ Y + F
    change = (v1 - v2)[:, increments.place["p"]]
    parts = [[row[increments.place[key]] for key in "xuwp"] for v in (v1, v2) for row in v]
    f = np.array([rate(model, *part) for part in parts]).reshape(2, 50, n)
    h = np.array([np.asarray(model.output(0.0, *part)).ravel() for part in parts]).reshape(2, 50, -1)
    dx, dw = ((v1 - v2)[:, increments.place[key]] for key in "xw")
    z = dx - np.einsum("kij,kj->ki", Y, change)
    stored = np.einsum("ki,kij,kj->k", change, S, change)
    news = np.einsum("kij,kj->ki", seen, change)
    supply = quadratic(made.Q, dw) + quadratic(made.R, h[0] - h[1])
    moved = f[0] - f[1] - np.einsum("kij,kj->ki", Phi @ Y + G, change)
    W = quadratic(made.P, z) + stored
    if made.discrete:
        after, limit = quadratic(made.P, moved) + made.mu * stored + np.sum(news**2, axis=1), made.mu * W + supply
    else:
        slope = 2 * np.einsum("ki,ij,kj->k", z, made.P, moved)
        after, limit = slope + np.log(made.mu) * stored + np.sum(news**2, axis=1), np.log(made.mu) * W + supply
    assert (after <= limit + 1e-9 * (np.abs(limit) + W + supply)).all()


@pytest.mark.parametrize("name", ["chua_discrete", "mixer", "decay", "scaled"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=8)
def test_parameters_differ_no_more_than_the_set_allows(name, seed):
    """(7.46) for random pairs at their own level, near and far, with disturbances that differ or not."""
    made, rng = design(name), np.random.default_rng(seed)
    steps, h = 25, 0.05
    first = trajectory(made.model, steps, rng, h=h)
    near, quiet = rng.choice([0.0, 0.05, 1.0]), rng.choice([0.0, 1.0])
    start = first.x[0] + near * (trajectory(made.model, 1, rng, h=h).x[0] - first.x[0])
    w = first.w + quiet * rng.normal(size=first.w.shape) * 1e-3
    second = trajectory(made.model, steps, rng, h=h, x=start, u=first.u0, w=w)
    if not inside(made.model, second):
        return
    alpha = ExcitationMonitor(made).between(first, second).level
    if alpha <= 1e-12:
        return
    E, dp = made.excited_set(alpha), first.p - second.p
    if made.discrete:
        fade = E.eta ** (steps - 1 - np.arange(steps))
        supply = fade @ (quadratic(E.Q, first.w - second.w) + quadratic(E.R, first.y - second.y))
        right, slack = E.eta**steps * quadratic(E.P, first.x[0] - second.x[0])[0] + supply, 1e-9
    else:  # outputs at both ends of a slot under its own w: the trapezoidal rule
        ends = []
        for t in (first, second):
            rows = zip(t.x[1:], t.u0, t.w, strict=True)
            ends.append([np.asarray(made.model.output(0.0, x, u, w, t.p)).ravel() for x, u, w in rows])
        left_power, right_power = (
            quadratic(E.R, first.y - second.y),
            quadratic(E.R, np.array(ends[0]) - np.array(ends[1])),
        )
        fade = E.eta ** (h * (steps - np.arange(steps + 1)))
        supply = h / 2 * (fade[:-1] @ left_power + fade[1:] @ right_power)
        supply += h * fade[1:] @ quadratic(E.Q, first.w - second.w)
        right, slack = E.eta ** (h * steps) * quadratic(E.P, first.x[0] - second.x[0])[0] + supply, 0.02
    assert quadratic(E.S, dp)[0] <= right * (1 + slack)


def test_an_optimiser_does_not_break_it_either():
    """The start and disturbances of a second trajectory are chosen to hide its parameters; the bound is neared."""
    made = design("mixer")
    rng = np.random.default_rng(3)
    first = trajectory(made.model, 12, rng, size=0.0)
    p = np.array([0.5, 0.1])

    def ratio(z):
        second = trajectory(made.model, 12, rng, x=z[:2], p=p, u=first.u0, w=z[2:].reshape(12, 3))
        E = made.excited_set(ExcitationMonitor(made).between(first, second).level)
        fade = E.eta ** (11 - np.arange(12))
        supply = fade @ (quadratic(E.Q, first.w - second.w) + quadratic(E.R, first.y - second.y))
        return quadratic(E.S, first.p - p)[0] / (E.eta**12 * quadratic(E.P, first.x[0] - z[:2])[0] + supply)

    start = np.concatenate([first.x[0], np.zeros(36)])
    found = minimize(lambda z: -np.log(ratio(z)), start, method="L-BFGS-B", options={"maxiter": 4})
    assert ratio(start) < ratio(found.x) <= 1.0


@pytest.mark.parametrize("name", NAMES)
def test_the_injection_contracts(name):
    """(7.41) holds with P and eta <= mu at fresh pairs, for the Phi of the design."""
    made = design(name)
    Phi = made.recursion(made.increments.between(*made.increments.random_pairs(100, np.random.default_rng(9))))[0]
    assert max(phi_factor(made.P, phi, discrete=made.discrete) for phi in Phi) <= made.eta + 1e-3 * (1 - made.eta)
    assert made.eta <= made.mu + 1e-9
    assert made.margin >= 0


def test_scope_method_and_phi_are_told():
    """Linear outputs and affine parameters: constant Phi, global, proved. A parameter in h: local, sampled."""
    for name in ("chua", "chua_discrete", "mixer", "decay"):
        made = design(name)
        assert (made.scope, made.rigorous, made.Phi is None) == ("global", True, False), name
    assert (design("reactor").scope, design("reactor").rigorous, design("reactor").Phi) == ("local", True, None)
    made = design("scaled")
    assert (made.scope, made.rigorous, made.method, made.Phi) == ("local", False, "grid", None)
    assert "evidence" in str(made) and "outputs are not linear" in str(made)


@pytest.mark.parametrize("name", ["chua", "chua_discrete", "decay"])
@given(seed=st.integers(0, 10**6))
def test_the_regressor_is_bounded_by_what_is_seen(name, seed):
    """(7.68): G'P G <= C'H C for changes of the regressor, at random points."""
    made, rng = design(name), np.random.default_rng(seed)
    v = made.increments.random(20, rng)
    zero = v.copy()
    zero[:, made.increments.place["p"]] = 0.0
    change = made.increments.at(v).A - made.increments.at(zero).A
    assert made.H is not None
    gap = made.C.T @ made.H @ made.C - change.transpose(0, 2, 1) @ made.P @ change
    assert np.linalg.eigvalsh(gap).min() >= -2e-2 * np.abs(made.C.T @ made.H @ made.C).max()


@pytest.mark.parametrize("name", ["chua_discrete", "decay"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=8)
def test_parameters_that_vary_start_no_farther_apart_than_allowed(name, seed):
    """(7.77) with matrices for the horizon, for random pairs whose parameters drift."""
    made, rng = design(name, drift=True), np.random.default_rng(seed)
    steps, h = 25, made.model.step or 0.05
    first = trajectory(made.model, steps, rng, h=h, B_p=B_P[name], size=0.2)
    second = trajectory(made.model, steps, rng, h=h, B_p=B_P[name], size=0.2, u=first.u0)
    found = ExcitationMonitor(made).between(first, second)
    Y, S = filter_bounds(made)
    nominal = np.diag(found.nominal)
    assert np.linalg.eigvalsh(nominal @ found.Y.T @ made.P @ found.Y @ nominal)[-1] <= Y**2 * (1 + 1e-9)
    assert np.linalg.eigvalsh(nominal @ found.matrix @ nominal)[-1] <= S * (1 + 1e-9)
    if found.level <= 1e-12:
        return
    T = steps if made.discrete else steps * h
    E = made.excited_set(found.level, horizon=T)
    weight = 1.0 if made.discrete else h
    supply = weight * np.sum(quadratic(E.Q, first.w - second.w) + quadratic(E.R, first.y - second.y))
    right = E.eta**T * quadratic(E.P, first.x[0] - second.x[0])[0] + supply
    assert quadratic(E.S, first.p[0] - second.p[0])[0] <= right * (1 + 1e-9)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=8)
def test_random_systems_are_refused_or_hold(seed):
    """Random linear systems with a parametrised input: a design is refuted by no pair; one mode hidden is named."""
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(2, 2)) * rng.uniform(0.2, 0.8), rng.normal(size=2)
    hidden = bool(seed % 2)
    if hidden:
        A = np.array([[rng.uniform(-0.9, 0.9), 0.0], [rng.normal(), rng.choice([-1, 1]) * rng.uniform(0.95, 1.5)]])
    model = DiscreteModel(
        lambda t, x, u, w, p: A @ x + b * p[0] * u[0] + w[:2], lambda t, x, u, w, p: x[0] + w[2],
        step=1.0, x=("a", "b"), u="u", w=("v1", "v2", "v3"), p="p", y="y",
        bounds=Bounds(x=(-1, 1), w=(-0.1, 0.1), p=(-1, 1)),
    )  # fmt: skip
    if hidden:
        with pytest.raises(CertificateError, match=r"outputs do not see the mode \(a .*, b .*\) with eigenvalue"):
            design_excitation(model, u=(-1, 1), mu=0.8)
        return
    try:
        made = design_excitation(model, u=(-1, 1), mu=0.9)
    except CertificateError:
        return
    v1, v2 = made.increments.random_pairs(200, rng)
    assert made.rigorous and made.slack(made.increments.between(v1, v2)).min() >= -1e-9


def test_the_longer_the_window_the_slower_the_factor():
    """Left out, mu lets a window contract, 4 mu^T < 1, and averages more noise where there is time for it."""
    made = design_excitation(mixer(), u=(-1, 1), horizon=40)
    assert 4 * made.mu**40 < 1 and made.margin >= 0
    slow = design_excitation(mixer(), u=(-1, 1), horizon=400)
    assert made.mu < slow.mu and 4 * slow.mu**400 < 1


@given(seed=st.integers(0, 10**6), n=st.integers(1, 3))
def test_the_least_upper_bound_is_above_all(seed, n):
    """H - M >= 0 for every matrix."""
    roots = np.random.default_rng(seed).normal(size=(5, n, n))
    matrices = roots @ roots.transpose(0, 2, 1)
    H = least_upper_bound(matrices, np.eye(n))
    assert np.linalg.eigvalsh(H - matrices).min() >= -1e-9 * np.abs(H).max()


def test_an_fmu_gives_the_design_of_its_equations_as_evidence():
    """Jacobians of the reactor as an FMU: the same domain and rate give the same P, from samples."""
    build = pytest.importorskip("fmus.build").build
    rates = {"k1": (0.1, 0.25)}
    domain = Bounds(x=(0.1, 5), w=(-0.1, 0.1), p=rates)
    fmu = FmuModel(build("batch_reactor", fmi=2), inputs=[], parameters=["k1"])
    own = design_excitation(batch_reactor(parameters=("k1",), noise=False), domain, mu=0.4)
    found = design_excitation(fmu, domain, mu=0.4)
    assert own.rigorous and not found.rigorous and found.method == "grid"
    assert found.margin >= 0 and found.R.shape == own.R.shape


def test_bad_requests_are_explained():
    """No parameters, a factor out of range, a B_p that does not fit, alpha and horizon where they have no place."""
    plain = ContinuousModel(lambda t, x, u, w, p: -x, lambda t, x, u, w, p: x, x="a", y="y")
    for call, words in (
        (lambda: design_excitation(plain), "has no parameters"),
        (lambda: design_excitation(chua(), mu=1.0), r"mu must lie in \(0, 1\)"),
        (lambda: design_excitation(chua(), B_p=[[1.0]]), r"B_p must have shape \(1, 4\)"),
        (lambda: design("chua").excited_set(-1.0), "alpha must be a positive number"),
        (lambda: design("chua").excited_set(1.0, horizon=3.0), "do not depend on T"),
        (lambda: design("decay", drift=True).excited_set(1.0), "horizon must be a positive number of seconds"),
        (lambda: design_excitation(mixer(unseen=True), Bounds(x=(-2, 2), w=(-0.1, 0.1))), "depend on"),
    ):
        with pytest.raises(InputError, match=words):
            call()


def reactor_in(units: np.ndarray) -> tuple[ContinuousModel, Bounds]:
    """The batch reactor with pressures, output, rates and time counted in other units: factors (5,)."""
    a, b, y, k, s = units
    nominal = {"a": a, "b": b, "y": y, "k1": 0.16 * k, "k2": 0.03 * k, "w_a": 0.1, "w_b": 0.1, "v": 0.1}

    def f(t, x, u, w, p):
        rate = (p[0] * (x[0] / a) ** 2 - p[1] * x[1] / b) / k
        return a * (w[0] - 2 * rate) / s, b * (rate + w[1]) / s

    model = ContinuousModel(
        f, lambda t, x, u, w, p: [y * (x[0] / a + x[1] / b + w[2])],
        x=("a", "b"), w=("w_a", "w_b", "v"), p=("k1", "k2"), y="y", nominal=nominal, name="reactor",
    )  # fmt: skip
    box = {"k1": (0.1 * k, 0.25 * k), "k2": (0.02 * k, 0.05 * k)}
    return model, Bounds(x={"a": (0.1 * a, 3 * a), "b": (0.1 * b, 3 * b)}, w=(-0.1, 0.1), p=box)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=5)
def test_units_do_not_decide_whether_there_is_a_design(seed):
    """Pressures, outputs, rates and seconds in any unit: the same weight R, in nominal units, to the solver."""
    rng = np.random.default_rng(seed)
    units = 10.0 ** rng.uniform(-3, 3, 5)
    units[4] = 10 ** rng.uniform(-1, 3)
    (plain, box), (other, domain) = reactor_in(np.ones(5)), reactor_in(units)
    first, second = design_excitation(plain, box, mu=0.95), design_excitation(other, domain, mu=0.95 ** (1 / units[4]))
    assert first.rigorous and second.rigorous and second.margin >= -1e-10
    assert second.R[0, 0] == pytest.approx(first.R[0, 0], rel=1e-3)


def test_why_there_is_no_design_is_told_in_names():
    """The level of the stirred tank is no more seen in the temperature somewhere in its box, and does not fade."""
    tank = cstr(parameters=("U",))
    with pytest.raises(CertificateError, match=r"outputs hardly see the mode \(c .*, T .*, h 1\) with eigenvalue 0,"):
        design_excitation(
            tank, Bounds(x=tank.bounds.x, p={"U": (40, 70)}), u={"T_c": (290, 310), "F": (0.09, 0.11)}, mu=0.999
        )


def test_a_stiff_reactor_near_its_steady_state_has_a_design():
    """Exponentials, covered by intervals: a proof. One parameter, times of minutes, states of 1 and of 300."""
    near = Bounds(x={"c": (0.8, 0.95), "T": (320, 330), "h": (0.63, 0.69)}, p={"U": (45, 65)})
    made = design_excitation(cstr(parameters=("U",)), near, u={"T_c": (295, 305), "F": (0.095, 0.105)}, mu=0.999)
    assert made.margin >= 0 and made.method == "interval" and made.rigorous and made.scope == "local"
