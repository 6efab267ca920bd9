"""Sums of squares, and metrics that depend on the state."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.lmi import require_cvxpy, solved
from ctmhe.certificates.metric import certify_metric
from ctmhe.certificates.sums_of_squares import squares
from ctmhe.errors import CertificateError, InputError
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import chua, cstr
from ctmhe.types import Bounds

settings.register_profile("certificates", deadline=None, max_examples=40)
settings.load_profile("certificates")


def logistic(coupling: float = 0.1, top: float = 0.6) -> ContinuousModel:
    """b decays by b^2 - b, hidden from the output: trajectories part where b > 1/2, before they come together."""
    return ContinuousModel(
        lambda t, x, u, w, p: (-x[0] + w[0], -x[1] + x[1] ** 2 + coupling * x[0]),
        lambda t, x, u, w, p: x[0],
        x=("a", "b"), w="w", y="y", bounds=Bounds(x={"a": (0, 1), "b": (0, top)}, w=(0, 1)), name="logistic",
    )  # fmt: skip


def minimum(polynomial, degrees, extra=0) -> tuple[float, float]:
    """The largest t for which polynomial - t is a sum of squares on the box, and what the Gram matrices prove of it."""
    cp, gram = require_cvxpy(), squares(1, degrees, extra=extra)
    values, t = polynomial(gram.nodes), cp.Variable()
    solved(cp.Problem(cp.Maximize(t), gram.constraints([cp.reshape(v - t, (1, 1), order="C") for v in values], 0.0)))
    return float(t.value), float(t.value) + gram.worth((values - t.value)[:, None, None], 0.0)


@given(coefficients=st.lists(st.floats(-1, 1), min_size=5, max_size=5))
@settings(max_examples=20)
def test_in_one_variable_squares_find_the_minimum(coefficients):
    """A polynomial that is positive on an interval is s_0 + (1 - s^2) s_1: nothing is lost."""
    grid = np.polynomial.chebyshev.chebval(np.linspace(-1, 1, 4001), coefficients).min()
    found, proved = minimum(lambda s: np.polynomial.chebyshev.chebval(s[:, 0], coefficients), [4])
    assert proved <= grid + 1e-9
    assert found == pytest.approx(grid, abs=1e-4)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=10)
def test_in_two_variables_squares_stay_below(seed):
    """What is proved is never more than what a search finds."""
    c = np.random.default_rng(seed).normal(size=(3, 3))
    value = np.polynomial.polynomial.polyval2d
    axis = np.linspace(-1, 1, 201)
    lowest = value(*np.meshgrid(axis, axis), c).min()
    found, proved = minimum(lambda s: value(s[:, 0], s[:, 1], c), [2, 2], extra=1)
    assert proved <= lowest + 1e-9
    assert found >= lowest - 0.2 * np.abs(c).sum()


@pytest.mark.parametrize("cover", ["bernstein", "squares"])
def test_a_metric_does_what_no_constant_can(cover):
    """At b = 0.6 trajectories part at 0.2 per second, so no constant P has a rate; one of degree 3 has."""
    model = logistic()
    for degree in (0, 2):
        with pytest.raises(CertificateError):
            certify_metric(model, eta=0.9, degree=degree, cover=cover)
    metric = certify_metric(model, eta=0.9, degree=3, cover=cover)
    found = metric.certificate
    assert found.rigorous
    assert found.margin >= 0
    for x in model_points(model, 200):
        P = metric(x)
        assert np.linalg.eigvalsh(P - found.P_lower)[0] >= -1e-9
        assert np.linalg.eigvalsh(found.P_upper - P)[0] >= -1e-9
        assert abs(P[0, 1]) <= 1e-12


def model_points(model, count):
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(0, 1, count), rng.uniform(0, 0.6, count)])


def test_degrees_that_must_fail_fail():
    """p' f / p has to exceed 2 f' + ln(1/eta) at b = 0.6 with f = -0.14: 0.505 / 0.14 = 3.6, and n / b for degree n."""
    model = logistic()
    assert 2 / 0.6 < (0.4 - np.log(0.9)) / 0.14 < 3 / 0.6
    with pytest.raises(CertificateError):
        certify_metric(model, eta=0.9, degree=2)
    assert certify_metric(model, eta=0.9, degree=3).certificate.rigorous


def test_energies_of_pairs_fall_as_promised():
    """U is |dy|^2 and the squared length of [b1, b2] here; (3.9b) along the dynamics, and (3.9a)."""
    model = logistic()
    metric = certify_metric(model, eta=0.9, degree=3)
    found, rng, steps = metric.certificate, np.random.default_rng(0), np.linspace(0, 1, 201)

    def energy(first, second):
        b = first[1] + steps * (second[1] - first[1])
        root = np.sqrt(metric(np.column_stack([np.zeros_like(b), b]))[:, 1, 1])
        return metric(first)[0, 0] * (first[0] - second[0]) ** 2 + (np.trapezoid(root, b)) ** 2

    for _ in range(100):
        first, second, w = rng.uniform([0, 0], [1, 0.6]), rng.uniform([0, 0], [1, 0.6]), rng.uniform(0, 1, 2)
        U, dx, h = energy(first, second), first - second, 1e-5
        ahead = [
            x + h * np.asarray(model.dynamics(0, x, [], v, [])).ravel() for x, v in ((first, w[0]), (second, w[1]))
        ]
        supply = found.Q[0, 0] * (w[0] - w[1]) ** 2 + found.R[0, 0] * dx[0] ** 2
        assert (energy(*ahead) - U) / h <= np.log(0.9) * U + supply + 1e-3
        assert dx @ found.P_lower @ dx <= U * (1 + 1e-6) + 1e-12
        assert dx @ found.P_upper @ dx >= U * (1 - 1e-6) - 1e-12


def test_discrete_time_too():
    """b+ = b + (b^2 - b)/2 parts by 1.1 a step at b = 0.6: Theorem 7.1 with P+ at the successor."""
    model = DiscreteModel(
        lambda t, x, u, w, p: (x[0] / 2 + w[0] / 2, x[1] + (x[1] ** 2 - x[1]) / 2),
        lambda t, x, u, w, p: x[0],
        x=("a", "b"), w="w", y="y", step=1.0, bounds=Bounds(x={"a": (0, 1), "b": (-0.1, 0.6)}, w=(0, 1)), name="steps",
    )  # fmt: skip
    with pytest.raises(CertificateError):
        certify_metric(model, eta=0.97, degree=0)
    found = certify_metric(model, eta=0.97, degree=2).certificate
    assert found.rigorous
    assert found.step == 1.0


def test_squares_lose_less_than_bernstein_coefficients():
    """b' = -b - 0.8 b (a - b)^2, b hidden: eta is at least 0.2307, from the largest slope; quadratic in two signals."""
    model = ContinuousModel(
        lambda t, x, u, w, p: (-x[0] + w[0], -x[1] * (1 + 0.8 * (x[0] - x[1]) ** 2)), lambda t, x, u, w, p: x[0],
        x=("a", "b"), w="w", y="y", bounds=Bounds(x=(-1, 1)), name="two",
    )  # fmt: skip
    a, b = np.meshgrid(*2 * [np.linspace(-1, 1, 401)])
    limit = np.exp(2 * (-1 - 0.8 * (a - b) * (a - 3 * b)).max())
    assert certify_metric(model, eta=1.05 * limit, degree=0, cover="squares").certificate.rigorous
    for cover, eta in (("bernstein", 1.25 * limit), ("squares", 0.99 * limit)):
        with pytest.raises(CertificateError):
            certify_metric(model, eta=eta, degree=0, cover=cover, pieces=4)


def test_a_domain_that_is_left_is_no_proof():
    """With a stronger coupling b leaves its box: the certificate says so."""
    found = certify_metric(logistic(coupling=-0.05), eta=0.9, degree=3).certificate
    assert not found.rigorous
    assert any("not invariant: b may leave" in note for note in found.notes)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=6)
def test_what_is_accepted_withstands_a_search(seed):
    """Random quadratic systems, detectable or not: a proof is never refuted by (7.33) at random points."""
    rng = np.random.default_rng(seed)
    M, N = rng.normal(size=(2, 2)) - 1.5 * np.eye(2), 0.4 * rng.normal(size=(2, 3))
    model = ContinuousModel(
        lambda t, x, u, w, p: [
            M[i, 0] * x[0] + M[i, 1] * x[1] + N[i, 0] * x[0] ** 2 + N[i, 1] * x[0] * x[1] + N[i, 2] * x[1] ** 2 + w[i]
            for i in range(2)
        ],
        lambda t, x, u, w, p: x[0],
        x=("a", "b"), w=("v", "w"), y="y", bounds=Bounds(x=(-1, 1)), name="random",
    )  # fmt: skip
    for cover in ("bernstein", "squares"):
        try:
            found = certify_metric(model, eta=0.8, degree=0, cover=cover).certificate
        except CertificateError:
            continue
        x = rng.uniform(-1, 1, (10**4, 2))
        A = np.stack([
            M[:, 0] + 2 * N[:, 0] * x[:, :1] + N[:, 1] * x[:, 1:], M[:, 1] + N[:, 1] * x[:, :1] + 2 * N[:, 2] * x[:, 1:]
        ], axis=2)  # fmt: skip
        C, P = np.array([[1.0, 0.0]]), found.P_lower
        gap = np.zeros((len(x), 4, 4))
        gap[:, :2, :2] = np.log(0.8) * P - P @ A - (P @ A).transpose(0, 2, 1) + C.T @ found.R @ C
        gap[:, :2, 2:], gap[:, 2:, :2], gap[:, 2:, 2:] = -P, -P, found.Q
        assert np.linalg.eigvalsh(gap)[:, 0].min() >= 0


def test_what_is_missing_is_said():
    """No polynomial, mixed outputs, measured states, bounds, covers."""
    with pytest.raises(InputError, match="no polynomial"):
        certify_metric(cstr(), eta=0.9999, degree=0)
    with pytest.raises(InputError, match="not measured"):
        certify_metric(logistic(), eta=0.9, states=["a"])
    with pytest.raises(InputError, match="cover must be"):
        certify_metric(logistic(), eta=0.9, cover="hope")
    mixed = ContinuousModel(
        lambda t, x, u, w, p: (-x[0], -x[1]), lambda t, x, u, w, p: x[0] + x[1],
        x=("a", "b"), y="y", bounds=Bounds(x=(0, 1)), name="mixed",
    )  # fmt: skip
    with pytest.raises(InputError, match="take outputs as states"):
        certify_metric(mixed, eta=0.9)
    free = ContinuousModel(
        lambda t, x, u, w, p: (-x[0], -x[1]), lambda t, x, u, w, p: x[0],
        x=("a", "b"), y="y", bounds=Bounds(x={"a": (0, 1)}), name="free",
    )  # fmt: skip
    with pytest.raises(InputError, match="depend on 'b', without finite bounds"):
        certify_metric(free, eta=0.9)
    grid = certify_metric(chua(), Bounds(x=(-3, 3)), eta=0.9, degree=0, cover="grid") if not chua().p else None
    assert grid is None or not grid.certificate.rigorous
