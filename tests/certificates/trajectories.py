"""Models small enough to judge by hand, and trajectories of models for the tests of certificates."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.integrate import solve_ivp

from ctmhe.certificates.increments import Increments
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.continuous import box_arrays
from ctmhe.types import Bounds, Trajectory


def quadratic(weight, v):
    """|v|^2 of rows."""
    return np.einsum("ki,ij,kj->k", np.atleast_2d(v), weight, np.atleast_2d(v))


def rate(model, x, u, w, p):
    return np.asarray(model.dynamics(0.0, x, u, w, p)).ravel()


@cache
def domain(model) -> Increments:
    return Increments(model, u=(-1, 1))


def inside(model, run: Trajectory) -> bool:
    """Whether states and parameters stay in the domain, where certificates claim something."""
    boxes = ((box_arrays(getattr(model, key), getattr(model.bounds, key), key), getattr(run, key)) for key in "xp")
    return all(((lower <= v) & (v <= upper)).all() for (lower, upper), v in boxes)


def trajectory(model, steps, rng, *, x=None, **given) -> Trajectory:
    """A trajectory from x, or from a random start of the domain that it does not leave; see `one_trajectory`."""
    for _ in range(100):
        made = one_trajectory(model, steps, rng, x=x, **given)
        if x is not None or inside(model, made):
            return made
    raise AssertionError("no trajectory stays in the domain")


def one_trajectory(model, steps, rng, *, h=None, size=1.0, x=None, p=None, u=None, w=None, B_p=None) -> Trajectory:
    """A trajectory from a random start of the domain, with w of `size` times the domain, held over slots of h."""
    increments, h = domain(model), model.step or h
    start = increments.random(1, rng)[0]
    x = start[increments.place["x"]] if x is None else np.asarray(x, float)
    p = start[increments.place["p"]] if p is None else np.asarray(p, float)
    draws = increments.random(steps, rng)
    w = size * draws[:, increments.place["w"]] if w is None else w
    u = draws[:, increments.place["u"]] if u is None else u
    states, parameters = [x], [p]
    for k in range(steps):
        x, p = states[-1], parameters[-1]
        if model.step:
            states.append(rate(model, x, u[k], w[k], p))
        else:
            flow = solve_ivp(lambda t, z: rate(model, z, u[k], w[k], p), (0, h), x, rtol=1e-9, atol=1e-12)  # noqa: B023
            states.append(flow.y[:, -1])
        parameters.append(p if B_p is None else p + B_p @ w[k] * (1 if model.step else h))
    p = parameters[0] if B_p is None else np.array(parameters[:-1])
    rows = np.tile(p, (steps, 1)) if B_p is None else p
    y = [np.asarray(model.output(0.0, *row)).ravel() for row in zip(states[:-1], u, w, rows, strict=True)]
    return Trajectory(h * np.arange(steps + 1), np.array(states), w, np.array(y), u, u, p)


def mixer(*, unseen=False, unit=1.0) -> DiscreteModel:
    """Two states, two parameters: one drives what is seen, the other scales the input; or, unseen, nothing at all."""
    return DiscreteModel(
        lambda t, x, u, w, p: (
            0.8 * x[0] + 0.2 * x[1] + p[0] / unit * u[0] + w[0],
            0.9 * x[1] + (0.0 if unseen else p[1] * x[0]) + 0.1 * u[0] + w[1],
        ),
        lambda t, x, u, w, p: x[0] + w[2],
        step=1.0,
        x=("a", "b"),
        u="drive",
        w=("w_a", "w_b", "v"),
        p=("gain", "feed"),
        y="y",
        bounds=Bounds(x=(-2, 2), w=(-0.1, 0.1), p={"gain": (0.5 * unit, 1.5 * unit), "feed": (-0.2, 0.1)}),
        name="mixer",
    )


def decay() -> ContinuousModel:
    """One state that decays at an unknown rate."""
    return ContinuousModel(
        lambda t, x, u, w, p: -p[0] * x[0] + u[0] + w[0],
        lambda t, x, u, w, p: x[0] + w[1],
        x="x",
        u="inflow",
        w=("w", "v"),
        p="k",
        y="y",
        bounds=Bounds(x=(0.0, 3.0), w=(-0.1, 0.1), p=(0.5, 1.5)),
        name="decay",
    )
