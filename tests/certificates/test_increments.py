"""Mean values of Jacobians, and what is said of their range."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.increments import Increments
from ctmhe.errors import InputError
from ctmhe.models import ContinuousModel
from ctmhe.models.library import chua, chua_discrete, quadrotor, van_der_pol
from ctmhe.types import Bounds
from tests.certificates.trajectories import decay, mixer

settings.register_profile("certificates", deadline=None, max_examples=15)
settings.load_profile("certificates")


def made(name: str) -> Increments:
    return {
        "chua": lambda: Increments(chua()),
        "chua_discrete": lambda: Increments(chua_discrete()),
        "mixer": lambda: Increments(mixer(), u=(-1, 1)),
        "decay": lambda: Increments(decay(), u=(-1, 1)),
        "van_der_pol": lambda: Increments(van_der_pol(parameters=("mu",)), Bounds(x=(-3, 3), w=(-1, 1), p=(0.5, 2))),
    }[name]()


def one(name, function, h=lambda t, x, u, w, p: x[0], **bounds):
    return ContinuousModel(function, h, x=("a", "b"), p="p", y="y", bounds=Bounds(**bounds), name=name)


@pytest.mark.parametrize("name", ["chua", "chua_discrete", "mixer", "decay", "van_der_pol"])
def test_mean_values_give_the_differences_of_both_functions(name):
    """f(z1) - f(z2) = A dx + B dw + E dp and the same for h, for pairs with equal inputs (7.47)."""
    increments = made(name)
    v1, v2 = increments.random_pairs(50, np.random.default_rng(0))
    A, B, E, C, D, F = increments.between(v1, v2)
    parts = [increments.place[key] for key in "xwp"]
    for function, jacobians in ((increments.model.dynamics, (A, B, E)), (increments.model.output, (C, D, F))):
        values = [
            np.array([np.asarray(function(0.0, *(row[increments.place[key]] for key in "xuwp"))).ravel() for row in v])
            for v in (v1, v2)
        ]
        ours = sum(
            np.einsum("kij,kj->ki", part, (v1 - v2)[:, place]) for part, place in zip(jacobians, parts, strict=True)
        )
        np.testing.assert_allclose(ours, values[0] - values[1], rtol=1e-9, atol=1e-9 * np.abs(values).max())


@pytest.mark.parametrize("name", ["chua", "mixer", "van_der_pol"])
@pytest.mark.parametrize("which", ["ABCD", "EF", "ABECDF"])
@given(seed=st.integers(0, 10**6))
def test_no_point_lies_outside_a_rigorous_hull(name, which, seed):
    """In every direction the cover reaches at least as far as the domain's own Jacobians."""
    increments, rng = made(name), np.random.default_rng(seed)
    cover = increments.cover(which)
    assert cover.rigorous
    points = increments.at(increments.random(200, rng))
    hull, inside = (
        np.concatenate([getattr(j, letter).reshape(len(j.A), -1) for letter in which], axis=1)
        for j in (cover.jacobians, points)
    )
    direction = rng.normal(size=hull.shape[1]) / np.maximum(np.abs(hull).max(axis=0), 1e-9)
    assert (inside @ direction).max() <= (hull @ direction).max() + 1e-9


def test_the_method_is_named_and_every_one_is_a_proof():
    """Constant, multi-affine, polynomial; anything else is bounded, kinks too."""
    linear = one("linear", lambda t, x, u, w, p: (x[1], -x[0] + p[0]))
    bilinear = one("bilinear", lambda t, x, u, w, p: (x[1], -p[0] * x[0]), x=(-1, 1), p=(1, 2))
    cubic = one("cubic", lambda t, x, u, w, p: (x[1], -p[0] * x[0] ** 3), x=(-1, 1), p=(1, 2))
    sine = one("sine", lambda t, x, u, w, p: (x[1], -p[0] * ca.sin(x[0])), x=(-1, 1), p=(1, 2))
    kink = one("kink", lambda t, x, u, w, p: (x[1], -p[0] * ca.fabs(x[0]) * x[0]), x=(-1, 1), p=(1, 2))
    said = {m.name: (Increments(m).cover().method, Increments(m).cover().rigorous) for m in (linear, bilinear, cubic)}
    assert said == {"linear": ("constant", True), "bilinear": ("vertices", True), "cubic": ("bernstein", True)}
    for model in (sine, kink):
        assert (Increments(model).cover().method, Increments(model).cover().rigorous) == ("interval", True)


def test_only_signals_that_matter_need_bounds():
    """The pressure of a reactor may be free; a concentration on which the Jacobian depends may not."""
    free = one("free", lambda t, x, u, w, p: (x[1] - p[0] * x[0] ** 2, -x[1]), x={"a": (0, 1)}, p=(0, 1))
    assert set(Increments(free).varying) == {0, 2}
    with pytest.raises(InputError, match=r"depend on state 'a', without finite bounds there; .*domain=Bounds"):
        Increments(free, Bounds(p=(0, 1)))
    with pytest.raises(InputError, match=r"depend on input 'drive'.*u="):
        Increments(
            ContinuousModel(
                lambda t, x, u, w, p: -u[0] * x[0], lambda t, x, u, w, p: x[0], x="a", u="drive", y="y",
                bounds=Bounds(x=(0, 1)),
            )
        )  # fmt: skip


def test_time_is_refused_with_a_remedy():
    """A Jacobian that moves with time has no range."""
    with pytest.raises(InputError, match="depends on time: make what changes with time a known input"):
        Increments(one("clock", lambda t, x, u, w, p: (ca.sin(t) * x[1], -x[0]), x=(-1, 1)))


def test_a_grid_has_points_all_over():
    """Entries that are constant but for rounding do not hide those that vary: the quadrotor's angles turn A."""
    angles, rates = dict.fromkeys(("phi", "theta", "psi"), (-0.5, 0.5)), dict.fromkeys(("O1", "O2", "O3"), (-1, 1))
    increments = Increments(quadrotor(), Bounds(x=angles | rates), u=(500, 900))
    cover = increments._grid("ABCD")
    assert not cover.rigorous and len(cover.jacobians.A) > 20
    there = increments.at(increments.random(50, np.random.default_rng(0))).A
    assert np.ptp(cover.jacobians.A, axis=0).max() > 0.8 * np.ptp(there, axis=0).max()
