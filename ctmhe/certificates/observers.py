"""Observers of constant gain with a quadratic function that shows how their error fades: thesis 4.2.6, Assumption 4.2.

The observer z+ = f(z, u, 0) + K (h(z, u, 0) - y) (4.71) of x+ = f(x, u, w), y = h(x, u, w) has the error e = z - x with
e+ = (A + K C) e - (B + K D) w, where A, B, C, D are mean values of the Jacobians between z and x, 0 and w. So
V_o = |e|^2_P falls by eta, up to |d|^2_Q + |v|^2_R (4.6b), if for all A, B, C, D of the domain, with Y = P K::

    [ eta P      0        (P A + Y C)' ]
    [   0     Q (+) R    -(P B + Y D)' ]  >= 0
    [   .        .             P       ]

In continuous time, dz/dt = f + K (h - y)::

    [ ln(eta) P - (P A + Y C) - (P A + Y C)'    P B + Y D ]
    [                   .                        Q (+) R  ]  >= 0

Both are affine in A, B, C, D: they hold on the domain if they do at the Jacobians that cover it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ctmhe.certificates.increments import AT_ONCE, Increments, Jacobians
from ctmhe.certificates.injection import Units, coordinates
from ctmhe.certificates.lmi import require_cvxpy, solved
from ctmhe.certificates.observer_function import LuenbergerObserver, ObserverFunction
from ctmhe.errors import CertificateError, InputError
from ctmhe.models.continuous import Model, box_arrays
from ctmhe.types import Array, Bounds, frozen

FRESH, ROUNDS = 400, 8
"""Random pairs at which a design is verified; how often it is improved."""

FIRST, ADDED = 8, 4
"""Of a grid: points that the program begins with, and how many it gets in each round, of those where it fails most."""


def observer_margin(
    units: Units, function: ObserverFunction, K: Array, jacobians: Jacobians, *, process: Any, noise: Any
) -> Array:
    """Return the smallest eigenvalue of (4.6b) at k points (k,), in nominal units, for V_o = |z - x|^2 of P_upper.

    `process` and `noise` are the places in w of d and v.
    """
    A, B, _, C, D, _ = jacobians
    P, n, nw = function.P_upper, len(function.P_upper), B.shape[2]
    gain = np.concatenate([A + K @ C, -B - K @ D], axis=2)
    weight = np.zeros((nw, nw))
    for place, part in ((process, function.Q), (noise, function.R)):
        weight[np.ix_(place, place)] = part
    if units.discrete:
        right = block_diag(function.eta * P, weight) - gain.transpose(0, 2, 1) @ P @ gain
    else:
        block: Any = block_diag(np.log(function.eta) * P, weight)
        right = np.tile(block, (len(A), 1, 1))
        right[:, :n] -= P @ gain
        right[:, :, :n] -= (P @ gain).transpose(0, 2, 1)
    scale = block_diag(units.x, units.w)
    return np.linalg.eigvalsh(scale @ right @ scale)[:, 0]


def split_disturbances(jacobians: Jacobians) -> tuple[Array, Array]:
    """Return the places in w of the disturbances that enter the dynamics, and of the rest."""
    enters = np.abs(jacobians.B).max(axis=(0, 1), initial=0.0) > 0
    return np.flatnonzero(enters), np.flatnonzero(~enters)


def design_observer(model: Model, domain: Bounds | None = None, *, eta: float, u: Any = None) -> LuenbergerObserver:
    """Find a gain K and V_o at a wanted rate: of all with P at least one, that with the least Q and R in nominal units.

    So the error that disturbances leave in the end, V_o <= (|d|^2_Q + |v|^2_R) / (1 - eta) or, in continuous time,
    / -ln(eta), is small for those of nominal size.

    Parameters
    ----------
    model : Model
        With measurement noise in w, which is what keeps the gain finite.
    domain : Bounds, optional
        O, of z and x (and w, p); larger than X where the observer may leave X. The model's bounds when left out.
    eta : float in (0, 1)
        Factor by which V_o falls per step, or per second.
    u : box, optional
        Range of the inputs, if a Jacobian depends on them.

    Raises
    ------
    InputError
        For an eta out of range, or a domain without bounds where a Jacobian depends on a signal.
    CertificateError
        If there is none at this rate, or a fresh point contradicts it.
    """
    if not 0 < eta < 1:
        raise InputError(f"design_observer: eta must lie in (0, 1), a factor per step or second, got {eta!r}")
    require_cvxpy()
    domain = domain or model.bounds
    low, high = box_arrays(model.w, domain.w, "domain of w")
    hull = replace(domain, w=(np.minimum(low, 0.0), np.maximum(high, 0.0)))  # the observer takes w = 0
    increments, units = Increments(model, hull, u=u), Units.of(model)
    cover = increments.cover("ABCD", most=AT_ONCE)
    process, noise = split_disturbances(cover.jacobians)
    places = {"process": process, "noise": noise}
    basis = coordinates(units, cover.jacobians, increments.at(increments.centre), eta)
    first, second = increments.random_pairs(FRESH, np.random.default_rng(5))
    fresh, points, slack = increments.between(first, second), cover.jacobians, 1e-6
    checked = _joined(_joined(fresh, increments.at(np.vstack([first, increments.corners()]))), points)
    if not cover.rigorous:
        points = points.take(slice(FIRST))
    margin, worst = -np.inf, {}
    for _ in range(ROUNDS):
        try:
            K, function = _program(units, basis, points, eta, process, noise, slack)
        except CertificateError as error:
            problem = f"no constant gain at eta = {eta:g} on this domain: {error}"
            raise CertificateError(f"design_observer: {problem}") from None
        margins = observer_margin(units, function, K, checked, **places)
        margin, at = float(margins.min()), first[margins[:FRESH].argmin()]
        worst = {name: float(value) for name, value in zip(increments.names, at, strict=True)}
        if margin >= 0:
            names = [tuple(model.w.names[i] for i in place) for place in (process, noise)]
            return LuenbergerObserver(model, K, function, domain, cover.method, cover.rigorous, margin, worst, *names)
        if observer_margin(units, function, K, points, **places).min() < 0:
            slack *= 10  # the solver was not exact
        points = _joined(points, checked.take(margins.argsort()[:ADDED]))  # a grid is refined where it fails
    raise CertificateError(
        f"design_observer: no constant gain at eta = {eta:g} stands the check: (4.6b) fails by {-margin:.2g} in "
        f"nominal units, at worst near {worst}; try a slower rate or a smaller domain"
    )


def _joined(first: Jacobians, second: Jacobians) -> Jacobians:
    return Jacobians(*(np.concatenate(both) for both in zip(first, second, strict=True)))


def _program(
    units: Units, basis: Array, points: Jacobians, eta: float, process: Array, noise: Array, slack: float
) -> tuple[Array, ObserverFunction]:
    """Return K and V_o that meet the inequality at the points with some slack, in the program's own units."""
    cp = require_cvxpy()
    pace = 1.0 if units.discrete else units.pace(points)  # the program's unit of time
    n, nw, ny = points.A.shape[1], points.B.shape[2], points.C.shape[1]
    P, Y = cp.Variable((n, n), symmetric=True), cp.Variable((n, ny))
    in_x, in_w = np.split(np.eye(n + nw), [n], axis=1)
    parts = [(place, cp.Variable((len(place),) * 2, symmetric=True)) for place in (process, noise) if len(place)]
    supply = sum((in_w[:, place] @ part @ in_w[:, place].T for place, part in parts), np.zeros((n + nw, n + nw)))
    least = np.linalg.inv(units.x) @ basis
    constraints: list[Any] = [P >> least.T @ least]
    for A, B, _, C, D, _ in zip(*replace(units, x=basis).scaled(points), strict=True):
        gain = (P @ A / pace + Y @ C) @ in_x.T - (P @ B / pace + Y @ D) @ in_w.T
        if units.discrete:
            matrix = cp.bmat([[supply + eta * in_x @ P @ in_x.T, gain.T], [gain, P]])
        else:
            matrix = supply + np.log(eta) / pace * in_x @ P @ in_x.T - in_x @ gain - (in_x @ gain).T
        constraints.append((matrix + matrix.T) / 2 >> slack * np.eye(matrix.shape[0]))
    total = sum(cp.trace(part) for _, part in parts)
    solved(cp.Problem(cp.Minimize(total + 1e-6 * cp.trace(P)), constraints))
    x, y, weight = np.linalg.inv(basis), np.linalg.inv(units.y), np.zeros((nw, nw))
    for place, part in parts:
        weight[np.ix_(place, place)] = pace * (part.value + part.value.T) / 2
    weight = np.linalg.inv(units.w) @ weight @ np.linalg.inv(units.w)
    lyapunov = x.T @ (P.value + P.value.T) @ x / 2
    Q, R = (weight[np.ix_(place, place)] for place in (process, noise))
    K = frozen(pace * basis @ np.linalg.solve(P.value, Y.value) @ y)
    return K, ObserverFunction(lyapunov, lyapunov, Q, R, eta)
