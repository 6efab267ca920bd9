"""The matrix inequality of detectability: checked at many Jacobians at once, and solved as a semidefinite program.

U = |dx|^2_P of two trajectories with the same known inputs falls by dU/dt <= ln(eta) U + |dd|^2_W + |dy|^2_R, or by
U+ <= eta U + ... in discrete time, where d are the disturbances: w, or w and p. With (dx/dt, dy) = (f, h) (dx, dd) this
is (7.33), or (7.26)::

    gap = ln(eta) P - P f - f'P + W + h'R h >= 0        gap = eta P - f'P f + W + h'R h >= 0

(P and W filled up with zeros). f and h are mean values of Jacobians on the line between both points, so they lie in the
hull of all Jacobians of a convex domain. The gap is affine in f, or concave: it holds on the hull if it holds at its
vertices. In h it is convex, and Theorem 7.2 asks for an affine output. Here any output is allowed: for every N::

    h'R h >= h'N + N'h - N'R^-1 N        from        (R h - N)' R^-1 (R h - N) >= 0

whose right side is affine in h. N joins the unknowns by a Schur complement, and is R h where h is constant: nothing is
lost there. N is what an observer's gain would be, the same all over the domain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ctmhe.certificates.increments import Increments, Jacobians, constant
from ctmhe.certificates.injection import Units, coordinates
from ctmhe.certificates.lmi import require_cvxpy, solved
from ctmhe.types import Array

GAIN = 1e6
"""How much more noise of nominal size may weigh than an error of nominal size. Fast rates ask for more and more."""

OBJECTIVES = ("gain", "P", "conditioning", "share")


@dataclass(frozen=True, eq=False)
class Form:
    """P (nx, nx), the weights of the disturbances' groups, R (ny, ny), and N (ny, nx + nd) where h varies."""

    P: Array
    W: tuple[Array, ...]
    R: Array
    N: Array | None = None

    def scaled(self, factor: float) -> Form:
        """Return the same for factor U."""
        N = None if self.N is None else factor * self.N
        return Form(factor * self.P, tuple(factor * part for part in self.W), factor * self.R, N)


@dataclass(frozen=True, eq=False)
class Sizes:
    """Nominal magnitudes of x, of each group of disturbances, and of y, as diagonal matrices."""

    units: Units
    groups: str = "w"

    @property
    def scale(self) -> Array:
        """Of (x, d)."""
        return block_diag(self.units.x, *(getattr(self.units, group) for group in self.groups))

    def stacked(self, jacobians: Jacobians) -> tuple[Array, Array]:
        """Return f (k, nx, nx + nd) and h (k, ny, nx + nd)."""
        A, B, E, C, D, F = jacobians
        f, h = {"w": B, "p": E}, {"w": D, "p": F}
        parts = ([A, *(f[group] for group in self.groups)], [C, *(h[group] for group in self.groups)])
        return np.concatenate(parts[0], axis=2), np.concatenate(parts[1], axis=2)

    def gaps(self, form: Form, eta: float, jacobians: Jacobians) -> Array:
        """Return the gap in nominal units at k points (k, nx + nd, nx + nd); with its bound, if the form has an N."""
        f, h = self.stacked(jacobians)
        P, R, n = form.P, form.R, len(form.P)
        if form.N is None:
            seen = h.transpose(0, 2, 1) @ R @ h
        else:
            seen = h.transpose(0, 2, 1) @ form.N
            seen = seen + seen.transpose(0, 2, 1) - form.N.T @ np.linalg.solve(R, form.N)
        gap = block_diag((eta if self.units.discrete else np.log(eta)) * P, *form.W) + seen
        if self.units.discrete:
            gap = gap - f.transpose(0, 2, 1) @ P @ f
        else:
            gap[:, :n] -= P @ f
            gap[:, :, :n] -= (P @ f).transpose(0, 2, 1)
        gap = self.scale @ gap @ self.scale
        return (gap + gap.transpose(0, 2, 1)) / 2

    def margins(self, form: Form, eta: float, jacobians: Jacobians) -> Array:
        """Return the smallest eigenvalue of the gap in nominal units at k points (k,); not negative: it holds."""
        return np.linalg.eigvalsh(self.gaps(form, eta, jacobians))[:, 0]


@dataclass(frozen=True, eq=False)
class Wanted:
    """What a program is asked for.

    Attributes
    ----------
    objective : str
        `gain`: least W and R for P at least one, all in nominal units; `P`: largest smallest eigenvalue of P in the model's
        units, W and R given; `conditioning`: least condition number of P in nominal units; `share`: P of the form at most
        the given one, and the largest share of it.
    P : array, optional
        Given, or with `share` its bound.
    W : tuple of array or None
        Given weights; up to a common factor, unless P is given or the objective is `P` or `share`.
    R : array, optional
    slack : float
        Smallest eigenvalue of the gap that is demanded of the program in its own units.
    limit : float, optional
        Of W and R together, as a multiple of the smallest eigenvalue of P, all in nominal units.
    """

    objective: str = "gain"
    P: Array | None = None
    W: tuple[Array | None, ...] = (None,)
    R: Array | None = None
    slack: float = 1e-7
    limit: float | None = None


class Program:
    """The semidefinite program for a model on a domain: coordinates and units once, then many questions."""

    def __init__(self, sizes: Sizes, increments: Increments, points: Jacobians):
        self.sizes, self.centre = sizes, increments.at(increments.centre)
        self.varies = not (constant(points.C) and constant(points.D) and constant(sizes.stacked(points)[1]))
        self.pace = 1.0 if sizes.units.discrete else sizes.units.pace(points)
        self.points = points

    def solve(self, points: Jacobians, eta: float, wanted: Wanted) -> Form:
        """Return a form that meets the inequality at the points, by the solver's word.

        Raises
        ------
        CertificateError
            If the program is infeasible or fails.
        """
        cp = require_cvxpy()
        sizes, units = self.sizes, self.sizes.units
        basis = coordinates(units, self.points, self.centre, eta)
        inside = replace(sizes, units=replace(units, x=basis))
        f, h = inside.stacked(inside.units.scaled(points))
        f = f / self.pace
        n, m, ny = len(units.x), f.shape[2], len(units.y)
        fixed = wanted.P is not None or wanted.objective == "P"
        factor = 1.0 if fixed else cp.Variable(nonneg=True)
        groups = [getattr(units, group) for group in sizes.groups]
        W = [self._weight(given, unit, factor) for given, unit in zip(wanted.W, groups, strict=True)]
        R = self._weight(wanted.R, units.y, factor)
        least = np.linalg.inv(units.x) @ basis  # P = 1 in nominal units
        constraints: list[Any] = [weight >> 0 for weight in (*W, R) if weight is not None and not _given(weight)]
        P = cp.Variable((n, n), symmetric=True)
        if wanted.P is not None and wanted.objective != "share":
            P = cp.Constant(_symmetric(basis.T @ wanted.P @ basis))
        N = cp.Variable((ny, m)) if self.varies else None
        edges = np.cumsum([n, *(len(unit) for unit in groups)])
        in_x, *places = np.split(np.eye(m), edges[:-1], axis=1)
        supply = sum((place @ part @ place.T for part, place in zip(W, places, strict=True) if part is not None), 0.0)
        rate = eta if units.discrete else np.log(eta) / self.pace
        supply = supply + rate * (in_x @ P @ in_x.T)
        for one, seen in zip(f, h, strict=True):
            gap = supply + seen.T @ R @ seen if N is None else supply + seen.T @ N + N.T @ seen
            if not units.discrete:
                half = in_x @ P @ one
                gap = gap - half - half.T
            rows = [[gap]]
            if units.discrete:
                rows = [[gap, one.T @ P], [P @ one, P]]
            if N is not None:
                corner = [np.zeros((ny, n))] if units.discrete else []
                rows = [[*row, tall] for row, tall in zip(rows, (N.T, np.zeros((n, ny))), strict=False)]
                rows.append([N, *corner, R])
            matrix = cp.bmat(rows)
            constraints.append((matrix + matrix.T) / 2 >> wanted.slack * np.eye(matrix.shape[0]))
        gain = sum((cp.trace(part) for part in W if part is not None), cp.trace(R))
        small = 1e-6 * cp.trace(P)
        if wanted.objective == "P":
            size = cp.Variable()
            goal, more = cp.Maximize(size), [P >> size * _symmetric(basis.T @ basis)]
        elif wanted.objective == "share":
            size, top = cp.Variable(), _symmetric(basis.T @ wanted.P @ basis)
            goal, more = cp.Maximize(size), [P << top, P >> size * top, size >= 1 / GAIN]
        elif wanted.objective == "conditioning" and wanted.P is None:
            size = cp.Variable()
            goal = cp.Minimize(size + 1e-9 * gain)
            more = [P >> least.T @ least, P << size * (least.T @ least)]
        else:
            goal = cp.Minimize(gain + small)
            more = [] if wanted.P is not None else [P >> least.T @ least]
        if wanted.limit is not None and not _given(gain):
            smallest = 1.0 if wanted.P is None else float(np.linalg.eigvalsh(units.x @ wanted.P @ units.x)[0])
            more.append(gain <= wanted.limit * smallest / self.pace)
        solved(cp.Problem(goal, constraints + more))
        x, y = np.linalg.inv(basis), np.linalg.inv(units.y)
        inputs = [np.linalg.inv(unit) for unit in groups]
        form = Form(
            _symmetric(x.T @ P.value @ x),
            tuple(
                np.zeros((0, 0)) if part is None else self.pace * _symmetric(unit @ _number(part) @ unit)
                for part, unit in zip(W, inputs, strict=True)
            ),
            self.pace * _symmetric(y @ _number(R) @ y),
            None if N is None else self.pace * y @ N.value @ block_diag(x, *inputs),
        )
        return (
            form
            if fixed or not isinstance(factor, cp.Variable) or factor.value is None
            else form.scaled(1 / max(float(factor.value), 1e-300))
        )

    def _weight(self, given: Array | None, unit: Array, factor: Any) -> Any:
        """Return a weight in the program's units: a variable, a given one up to the factor, None for no signals."""
        cp, n = require_cvxpy(), len(unit)
        if not n:
            return None
        if given is None:
            return cp.Variable((n, n), symmetric=True)
        return factor * (unit @ given @ unit / self.pace)


def _given(weight: Any) -> bool:
    return not hasattr(weight, "is_symmetric") or bool(weight.is_constant())


def _number(weight: Any) -> Array:
    return np.asarray(getattr(weight, "value", weight), dtype=float)


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2
