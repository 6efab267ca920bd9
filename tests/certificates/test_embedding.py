"""Covers of Jacobians that are no polynomials: nothing of the domain lies outside."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from ctmhe.certificates.embedding import bernstein, combined, reduced
from ctmhe.certificates.increments import Increments
from ctmhe.certificates.interval import Intervals
from ctmhe.certificates.taylor import derivative_bounds
from ctmhe.errors import InputError
from ctmhe.models import ContinuousModel
from ctmhe.models.library import cstr, quadrotor
from ctmhe.types import Bounds

settings.register_profile("certificates", deadline=None, max_examples=40)
settings.load_profile("certificates")

TERMS = [
    *(lambda a, b: ca.sin(a) * b, lambda a, b: ca.exp(-a) * b, lambda a, b: ca.log(a + 4) * b),
    *(lambda a, b: b / (a + 3), lambda a, b: ca.sqrt(a**2 + 1) * b, lambda a, b: ca.tanh(2 * a) + b * ca.cos(a)),
    *(lambda a, b: ca.atan(a) * b**2, lambda a, b: a**3 * b, lambda a, b: ca.fabs(a) * b),
    *(lambda a, b: ca.sin(a * b), lambda a, b: ca.tan(a / 3) * ca.cosh(b), lambda a, b: (a + 4) ** 1.5 * b),
]


def model(first, second, name="sample"):
    return ContinuousModel(
        lambda t, x, u, w, p: (first(x[0], x[1]), second(x[1], x[0])), lambda t, x, u, w, p: x[0],
        x=("a", "b"), y="y", bounds=Bounds(x=(-1.3, 1.5)), name=name,
    )  # fmt: skip


def flat(jacobians, which="ABCD"):
    return np.concatenate([getattr(jacobians, letter).reshape(len(jacobians.A), -1) for letter in which], axis=1)


def farthest_outside(increments, cover, which="ABCD", seed=0, count=60) -> float:
    """How far the domain reaches beyond the hull, over its own width, in random directions."""
    rng = np.random.default_rng(seed)
    points = np.vstack([increments.random(2000, rng), increments.corners()])
    hull, inside = flat(cover.jacobians, which), flat(increments.at(points), which)
    worst = -np.inf
    scale = np.ptp(inside, axis=0)
    for direction in rng.normal(size=(count, hull.shape[1])) / np.where(scale > 1e-9, scale, 1.0):
        ours, theirs = inside @ direction, (hull @ direction).max()
        worst = max(worst, (ours.max() - theirs) / max(np.ptp(ours), 1e-9))
    return worst


@given(first=st.sampled_from(TERMS), second=st.sampled_from(TERMS), seed=st.integers(0, 10**6))
@settings(max_examples=10)
def test_no_jacobian_lies_outside(first, second, seed):
    """Of random models, kinks among them, in random directions."""
    increments = Increments(model(first, second))
    cover = increments.cover("ABCD")
    assert cover.rigorous
    assert farthest_outside(increments, cover, seed=seed) <= 1e-9


def test_a_jump_that_cannot_be_bounded_is_no_proof():
    """CasADi's slope of max(a, b) is a quotient of truth values; it is sampled, and not taken for a constant."""
    cover = Increments(model(ca.fmax, ca.fmax)).cover("ABCD")
    assert (cover.method, cover.rigorous) == ("grid", False)
    assert len(cover.jacobians.A) > 1


@pytest.mark.parametrize("first", TERMS[:3])
def test_jacobians_are_combinations_of_the_cover(first):
    """Not in some directions only: each is a convex combination, by a linear program."""
    increments = Increments(model(first, TERMS[5]))
    hull = flat(increments.cover("ABCD").jacobians)
    equal = np.vstack([hull.T, np.ones(len(hull))])
    for point in flat(increments.at(increments.random(25, np.random.default_rng(0)))):
        found = linprog(np.zeros(len(hull)), A_eq=equal, b_eq=[*point, 1.0], bounds=(0, None), method="highs")
        assert found.status == 0


def test_a_reactor_with_arrhenius_terms_is_covered_tightly():
    """CSTR: exp(-E/T) from 200 to 400 K spans nine decades; the hull is about a tenth wider than the domain."""
    increments = Increments(cstr())
    cover = increments.cover("ABCD")
    assert (cover.method, cover.rigorous) == ("interval", True)
    assert len(cover.jacobians.A) <= 400
    assert farthest_outside(increments, cover) <= 1e-9
    inside = increments.at(increments.random(4000, np.random.default_rng(0)))
    own, hull = (np.ptp(flat(part), axis=0) for part in (inside, cover.jacobians))
    assert (hull[own > 0] <= 1.3 * own[own > 0]).all()


def test_a_quadrotor_is_covered_on_the_domain_of_the_thesis():
    """3.4.2: 29 varying entries of A; four rotor speeds act by one number, and 2^29 vertices become 4096 points."""
    increments = Increments(quadrotor(), u=(0, 1500))
    cover = increments.cover("ABCD")
    assert (cover.method, cover.rigorous) == ("interval", True)
    assert len(cover.jacobians.A) <= 5000
    assert farthest_outside(increments, cover) <= 1e-9


def test_what_acts_through_one_number_is_one_variable():
    """exp(u1^2 + u2^2) and its square depend on one number; it is bounded without slack, the fourth does not matter."""
    v = ca.SX.sym("v", 4)
    lift = ca.exp(v[0] ** 2 + v[1] ** 2)
    found = reduced(ca.vertcat(lift * v[2], lift**2), v, np.array([0, 0, 1, 1.0]), np.array([1, 1, 2, 2.0]))
    assert found.variables.numel() == 2
    assert sorted(found.source) == [-1, 2]
    k = found.source.index(-1)
    assert 1 - 1e-6 <= found.lower[k] <= 1
    assert np.exp(2) <= found.upper[k] <= np.exp(2) * (1 + 1e-6)


def test_bernstein_coefficients_are_combinations_of_values():
    """Of 1 + x y^2 on [0, 1] x [0, 1]: 1 but for the last corner."""
    rules = [bernstein(0, 1, 1), bernstein(0, 1, 2)]
    found = combined(lambda points: 1 + points[:, :1] * points[:, 1:] ** 2, rules)
    np.testing.assert_allclose(found.ravel(), [1, 1, 1, 1, 1, 2], atol=1e-12)


SERIES = [
    *(ca.sin, ca.cos, ca.tan, ca.exp, ca.tanh, ca.sinh, ca.cosh, ca.atan, ca.asinh, ca.expm1),
    *(lambda a: ca.log(a + 3), lambda a: ca.sqrt(a + 3), lambda a: 1 / (a + 3), lambda a: (a + 3) ** -2.5),
    *(lambda a: ca.asin(a / 3), lambda a: ca.atanh(a / 3), lambda a: ca.log1p(a / 3), lambda a: a**5, lambda a: 3.0**a),
]


@pytest.mark.parametrize("function", SERIES)
def test_higher_derivatives_are_bounded(function):
    """Taylor coefficients in x of g(x) y up to order 5, against symbolic derivatives at points, and not by far."""
    v = ca.SX.sym("v", 2)
    tree, factor = function(v[0]) * v[1], 1.0
    lower, upper = np.array([[-0.2, 0.5]]), np.array([[-0.15, 1.0]])
    bounds = derivative_bounds(Intervals(tree, v), lower, upper, 0, 5)
    points = np.random.default_rng(0).uniform(lower, upper, (50, 2))
    for n in range(6):
        values = np.abs(np.asarray(ca.DM(ca.Function("f", [v], [ca.densify(tree)])(ca.DM(points.T))))) / factor
        assert values.max() <= bounds[n, 0]
        assert bounds[n, 0] <= 10 * values.max() + 1e-9
        tree, factor = ca.jacobian(tree, v[0]), factor * (n + 1)


def test_bounds_of_ones_own_make_a_cover():
    """What an FMU's user knows of its Jacobians; what is missing or refuted by a sample is said."""
    increments = Increments(model(TERMS[0], TERMS[1]))
    with pytest.raises(InputError, match=r"A varies over the domain: give its bounds too"):
        increments.cover("ABCD", given={})
    with pytest.raises(InputError, match=r"A\[0, 0\] is .* outside the given bounds, at a = .*, b = "):
        increments.cover("ABCD", given={"A": (0.0, 0.1)})
    with pytest.raises(InputError, match=r"bounds of A must be two of shape \(2, 2\) or scalar"):
        increments.cover("ABCD", given={"A": (np.zeros(3), 1.0)})
    cover = increments.cover("ABCD", given={"A": (-10.0, 10.0)})
    assert (cover.method, cover.rigorous, len(cover.jacobians.A)) == ("interval", True, 16)
    assert np.ptp(cover.jacobians.A, axis=0).min() == 20.0
