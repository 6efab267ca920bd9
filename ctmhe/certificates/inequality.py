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
        return np.asarray(block_diag(self.units.x, *(getattr(self.units, group) for group in self.groups)))

    def stacked(self, jacobians: Jacobians) -> tuple[Array, Array]:
        """Return f (k, nx, nx + nd) and h (k, ny, nx + nd)."""
        A, B, E, C, D, F = jacobians
        f, h = {"w": B, "p": E}, {"w": D, "p": F}
        rows = ([A, *(f[group] for group in self.groups)], [C, *(h[group] for group in self.groups)])
        return np.concatenate(rows[0], axis=2), np.concatenate(rows[1], axis=2)

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

    def relative(self, form: Form, eta: float, jacobians: Jacobians) -> Array:
        """Return the smallest eigenvalue of the gap, each row over the size of the terms on its diagonal (k,).

        Free of units: what is below zero by more than rounding is below zero.
        """
        f, h = (np.abs(part) for part in self.stacked(jacobians))
        P, R, n = np.abs(form.P), np.abs(form.R), len(form.P)
        weights = np.asarray(block_diag((eta if self.units.discrete else np.log(eta)) * form.P, *form.W))
        terms = np.abs(np.diagonal(weights))
        seen = np.einsum("kyi,yz,kzi->ki", h, R, h)
        if form.N is not None:
            N = np.abs(form.N)
            seen = 2 * np.einsum("kyi,yi->ki", h, N) + np.einsum("yi,yz,zi->i", N, np.abs(np.linalg.inv(form.R)), N)
        moved = np.einsum("kni,nm,kmi->ki", f, P, f)
        if not self.units.discrete:
            moved = np.zeros_like(seen)
            moved[:, :n] = 2 * np.einsum("nm,kmn->kn", P, f[:, :, :n])
        scale = np.sqrt(np.maximum(terms + seen + moved, 1e-300)) * np.diagonal(self.scale)
        gaps = self.gaps(form, eta, jacobians) / (scale[:, :, None] * scale[:, None, :])
        return np.linalg.eigvalsh(gaps)[:, 0]

    def margins(self, form: Form, eta: float, jacobians: Jacobians) -> Array:
        """Return the smallest eigenvalue of the gap in nominal units at k points (k,); not negative: it holds."""
        return np.linalg.eigvalsh(self.gaps(form, eta, jacobians))[:, 0]


@dataclass(frozen=True, eq=False)
class Wanted:
    """What a program is asked for.

    Attributes
    ----------
    objective : str
        `gain`: least W and R for P at least one, all in nominal units; `P`: largest smallest eigenvalue of P in the
        model's units, W and R given; `conditioning`: least condition number of P in nominal units; `share`: P of the
        form at most the given one, and the largest share of it.
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
    """The semidefinite program for a model on a domain: units once, then many questions.

    Attributes
    ----------
    varies : bool
        Outputs are not affine.
    pace : float
        Its unit of time, per second: entries of A are of size one.
    """

    def __init__(self, sizes: Sizes, increments: Increments, points: Jacobians):
        self.sizes, self.points, self.centre = sizes, points, increments.at(increments.centre)
        self.varies = not constant(sizes.stacked(points)[1])
        self.pace = 1.0 if sizes.units.discrete else sizes.units.pace(points)

    def solve(self, points: Jacobians, eta: float, wanted: Wanted) -> Form:
        """Return a form that meets the inequality at the points, by the solver's word.

        Raises
        ------
        CertificateError
            If the program is infeasible or fails.
        """
        cp, sizes, units = require_cvxpy(), self.sizes, self.sizes.units
        basis = self._basis(eta)
        inside = replace(sizes, units=replace(units, x=basis))
        f, h = inside.stacked(inside.units.scaled(points))
        given = [*wanted.W, wanted.R]
        scales = [*(getattr(units, group) for group in sizes.groups), units.y]
        free = wanted.P is None and wanted.objective != "P" and any(w is not None and len(w) for w in given)
        factor: Any = cp.Variable(nonneg=True) if free else 1.0
        weights = [
            cp.Variable((len(unit), len(unit)), symmetric=True) if w is None else factor * (unit @ w @ unit / self.pace)
            for w, unit in zip(given, scales, strict=True)
        ]
        constraints: list[Any] = [weight >> 0 for weight, w in zip(weights, given, strict=True) if w is None]
        P: Any = cp.Variable((len(basis), len(basis)), symmetric=True)
        bound = None if wanted.P is None else _symmetric(basis.T @ wanted.P @ basis)
        if bound is not None and wanted.objective != "share":
            P = cp.Constant(bound)
        N = cp.Variable(h.shape[1:]) if self.varies else None
        matrices = self._matrices(f / self.pace, h, eta, P, weights, N)
        steady = [] if self.varies else self._steady(f)
        constraints += _all_positive(matrices, steady, wanted.slack)
        one = _symmetric((np.linalg.inv(units.x) @ basis).T @ np.linalg.inv(units.x) @ basis)  # P = 1 in nominal units
        gain = sum(cp.trace(weight) for weight in weights if weight.shape[0])
        size = cp.Variable()
        if wanted.objective == "P":
            goal, more = cp.Maximize(size), [P >> size * _symmetric(basis.T @ basis)]
        elif wanted.objective == "share":
            goal, more = cp.Maximize(size), [P << bound, P >> size * bound, size >= 1 / GAIN]
        elif wanted.objective == "conditioning":
            goal, more = cp.Minimize(size + 1e-9 * gain), [P >> one, P << size * one]
        else:
            goal, more = cp.Minimize(gain + 1e-6 * cp.trace(P)), [P >> one] if bound is None else []
        if wanted.limit is not None and (free or any(w is None for w in given)):
            least = 1.0 if wanted.P is None else float(np.linalg.eigvalsh(units.x @ wanted.P @ units.x)[0])
            more.append(gain <= wanted.limit * least / self.pace)
        solved(cp.Problem(goal, constraints + more))
        x, *back = (np.linalg.inv(unit) for unit in (basis, *scales))
        found = [
            self.pace * unit @ _lifted(weight.value) @ unit if w is None else (w if not free else w * factor.value)
            for w, weight, unit in zip(given, weights, back, strict=True)
        ]
        N_ = None if N is None else self.pace * back[-1] @ N.value @ block_diag(x, *back[:-1])
        form = Form(_symmetric(x.T @ P.value @ x), tuple(found[:-1]), found[-1], N_)
        if not free:
            return form
        form = form.scaled(1 / float(factor.value))
        W = tuple(own if w is None else w for own, w in zip(form.W, wanted.W, strict=True))
        return replace(form, W=W, R=form.R if wanted.R is None else wanted.R)

    def _basis(self, eta: float) -> Array:
        """Return coordinates of x in which those through which nothing varies stay apart from the others: the last."""
        basis = coordinates(self.sizes.units, self.points, self.centre, eta)
        order = np.argsort([constant(self.points.A[:, :, j]) for j in range(len(basis))], kind="stable")
        turned = np.empty_like(basis)
        turned[order] = np.linalg.qr(basis[order].T)[1].T  # triangular, up to a rotation the same
        return turned

    def _matrices(self, f: Array, h: Array, eta: float, P: Any, weights: list[Any], N: Any) -> list[Any]:
        """Return what has to be positive, one matrix a point: the gap, with Schur complements for f'P f and N."""
        cp, n, m, ny = require_cvxpy(), f.shape[1], f.shape[2], h.shape[1]
        discrete, (*W, R) = self.sizes.units.discrete, weights
        edges = np.cumsum([n, *(part.shape[0] for part in W)])
        in_x, *places = np.split(np.eye(m), edges[:-1], axis=1)
        fixed = (eta if discrete else np.log(eta) / self.pace) * (in_x @ P @ in_x.T)
        for part, place in zip(W, places, strict=True):
            fixed = fixed + place @ part @ place.T if part.shape[0] else fixed
        found = []
        for one, seen in zip(f, h, strict=True):
            gap = fixed + (seen.T @ R @ seen if N is None else seen.T @ N + N.T @ seen)
            rows = [[gap]]
            if discrete:
                rows = [[gap, one.T @ P], [P @ one, P]]
            else:
                half = in_x @ P @ one
                rows = [[gap - half - half.T]]
            if N is not None:
                rows = [[*row, tall] for row, tall in zip(rows, (N.T, np.zeros((n, ny))), strict=False)]
                rows.append([N, *([np.zeros((ny, n))] if discrete else []), R])
            matrix = cp.bmat(rows)
            found.append((matrix + matrix.T) / 2)
        return found

    def _steady(self, f: Array) -> list[int]:
        """Return the columns of (x, d) through which nothing varies, outputs being affine.

        In continuous time P f couples a state to the others' columns, so that disturbances alone stay apart.
        """
        first = 0 if self.sizes.units.discrete else f.shape[1]
        return [j for j in range(first, f.shape[2]) if len(f) > 1 and constant(f[:, :, j])]


def _all_positive(matrices: list[Any], steady: list[int], slack: float) -> list[Any]:
    """Return constraints by which all matrices are at least the slack, the rows of `steady` being the same in all.

    [[M_k, G], [G', W]] >= 0 for all k if and only if some Z has M_k >= Z and [[Z, G], [G', W]] >= 0. What there is a
    matrix of for each point becomes smaller by the noise.
    """
    cp, size = require_cvxpy(), matrices[0].shape[0]
    if not steady:
        return [matrix >> slack * np.eye(size) for matrix in matrices]
    rest = [j for j in range(size) if j not in steady]
    order, n = np.eye(size)[:, [*rest, *steady]], len(rest)
    Z, pick, lift = cp.Variable((n, n), symmetric=True), np.eye(size)[:, rest], np.eye(size, n)
    parts = [pick.T @ matrix @ pick for matrix in matrices]
    common = order.T @ matrices[0] @ order + lift @ (Z - parts[0]) @ lift.T
    return [(common + common.T) / 2 >> slack * np.eye(size), *(part - Z >> slack * np.eye(n) for part in parts)]


def _lifted(weight: Array) -> Array:
    """Return a weight, by the solver's inaccuracy larger where it is not positive definite."""
    value = _symmetric(weight)
    least = float(np.linalg.eigvalsh(value)[0])
    return value + max(0.0, 1e-12 * float(np.abs(value).max()) - least) * np.eye(len(value))


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.T) / 2
