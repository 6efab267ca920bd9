"""Detectability with a metric that depends on the state: thesis Theorem 7.1, and Remark 7.7 in continuous time.

V(x, dx) = dx' P(x) dx falls along the differential dynamics (7.11) if for all (x, u, w) of the domain ::

    continuous   ln(eta) P - P A - A'P - dP/dt + C'R C ...  >= 0,    dP/dt = sum_j dP/dx_j f_j(x, u, w)
    discrete     [[eta P + C'R C, C'R D, A'P+], [., Q + D'R D, B'P+], [., ., P+]] >= 0,    P+ = P(f(x, u, w))

(the second is (7.7) by a Schur complement). P = P_0 + sum P_k b_k(x) with monomials b_k, so both are affine in P_k, Q
and R, and polynomials in (x, u, w) if the model is one. They are then proved on a box by Bernstein coefficients or sums
of squares; otherwise they are demanded and tested at points, which is evidence.

From V to two trajectories. U(x1, x2) is the least energy int V(c, c') ds of the curves c in the domain from x1 to x2.
P has the form (7.6): diag(P_x(x_x), P_y) with x_y the measured states. On a box the energy is then a sum of two, over
curves of x_x in one box and of x_y in another. The second is least on a straight line, with c_y' constant; so is w
moved along a straight line, hence dy/ds is constant and int |dy/ds|_R^2 ds = |y1 - y2|_R^2 (7.21). Let the curve be one
of least energy and move all its points with the dynamics: if the domain is invariant they stay in it, so that U+ is at
most the energy of the moved curve, which is at most eta times the old one plus supply: (3.9b).

Bounds (3.9a), with constant P_lower <= P(x) <= P_upper on the domain. Above: the straight line stays in the box and
has at most the energy |x1 - x2|_P_upper^2. Below: for any curve int |c'|_P^2 ds >= int |c'|_P_lower^2 ds >=
|int c' ds|_P_lower^2 by Jensen's inequality. So one needs no geodesics, and no convexity in the metric.

Invariance is asked of the box of x_x only where P varies: there f has to point inwards (checked by interval
arithmetic on every face); otherwise the certificate is no proof and says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.embedding import DEGREE, bernstein, combined, degrees_of, is_rough
from ctmhe.certificates.increments import Increments, constant
from ctmhe.certificates.injection import Units, least_upper_bound
from ctmhe.certificates.interval import Enclosure
from ctmhe.certificates.lmi import require_cvxpy, solved
from ctmhe.certificates.sums_of_squares import squares
from ctmhe.errors import CertificateError, InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds

SLACK, LARGEST, SAMPLES = 1e-6, 1e6, 300


@dataclass(frozen=True, eq=False)
class Metric:
    """P(x) = sum_k P_k b_k(x), monomials b_k in states divided by their nominals, and what was proved with it.

    Attributes
    ----------
    certificate : DetectabilityCertificate
    coefficients : array (nb, nx, nx)
    powers : array (nb, nx)
    nominal : array (nx,)
    """

    certificate: DetectabilityCertificate
    coefficients: Array
    powers: Array
    nominal: Array

    def __call__(self, x: Any) -> Array:
        """Return P at states (..., nx)."""
        values = np.prod((np.asarray(x, dtype=float)[..., None, :] / self.nominal) ** self.powers, axis=-1)
        return np.tensordot(values, self.coefficients, 1)


def certify_metric(
    model: Model,
    domain: Bounds | None = None,
    *,
    eta: float,
    u: Any = None,
    degree: int = 2,
    states: Sequence[str] | None = None,
    cover: str = "bernstein",
    extra: int = 0,
    pieces: int = 2,
) -> Metric:
    """Return a metric P(x) with which the model is detectable at a rate, and its certificate.

    Parameters
    ----------
    model, domain, u
        As of `Increments`; outputs are single states plus disturbances.
    eta : float
        Per second, or per step.
    degree : int
        Of P in each state that it depends on; with 0 it is constant, and may mix measured and other states.
    states : sequence of str, optional
        Those on which P depends, not measured; all that are not when left out.
    cover : str
        `bernstein`, `squares`, or `grid` (evidence); for a model that is no polynomial only the last.
    extra : int
        See `sums_of_squares.squares`.
    pieces : int
        Into which Bernstein cuts the box, for signals of degree 2 and more.

    Raises
    ------
    InputError
        If the outputs mix states, P is to depend on measured ones or on what has no bounds, or the cover is none.
    CertificateError
        If there is no such metric, or the solver fails.
    """
    if cover not in ("bernstein", "squares", "grid"):
        raise InputError(f"certify_metric: cover must be 'bernstein', 'squares' or 'grid', got {cover!r}")
    return _Search(model, domain, u, degree, states, eta).found(cover, extra, pieces)


class _Search:
    def __init__(self, model: Model, domain: Any, u: Any, degree: int, states: Any, eta: float):
        self.increments = increments = Increments(model, domain, u=u)
        self.model, self.eta, self.units, self.domain = model, eta, Units.of(model), domain or model.bounds
        if not increments.symbolic:
            raise InputError(f"certify_metric: model {model.name!r} is an FMU: dP/dt needs its equations")
        if not 0 < eta < 1:
            raise InputError(f"certify_metric: eta must lie in (0, 1), got {eta}")
        if model.p:
            raise InputError(
                f"certify_metric: model {model.name!r} has parameters: fix {', '.join(model.p.names)} first"
            )
        samples = increments.at(increments.random(20, np.random.default_rng(5)))
        if not (constant(samples.C) and constant(samples.D)):
            raise InputError(f"certify_metric: outputs of model {model.name!r} are not affine in x and w (Remark 7.1)")
        C = increments.at(increments.centre).C[0]
        seen = np.flatnonzero(np.abs(C).any(axis=0))
        rows = np.count_nonzero(C, axis=1)
        if degree and ((rows != 1).any() or len(seen) != len(C)):
            raise InputError("certify_metric: each output must be one state; take outputs as states first (Remark 7.1)")
        hidden = [name for i, name in enumerate(model.x.names) if i not in seen]
        states = list(hidden if states is None else states) if degree else []
        if bad := [name for name in states if name not in hidden]:
            raise InputError(
                f"certify_metric: P may depend on {hidden} only, which are not measured (7.6), not on {bad}"
            )
        self.within = [model.x.names.index(name) for name in states]
        self.nominal = np.asarray(model.x.nominal, dtype=float)
        self.powers = np.zeros(((degree + 1) ** len(states), len(model.x)), dtype=int)
        self.powers[:, self.within] = list(product(range(degree + 1), repeat=len(states)))
        self.free = self._unknowns(seen if degree else np.array([], dtype=int))
        self._functions()

    def _unknowns(self, seen: np.ndarray) -> list[tuple[str, int, int, int]]:
        """Return what is sought: (P, number, row, column) and so on, in the form (7.6)."""
        n, found = len(self.model.x), []
        for k, power in enumerate(self.powers):
            for i in range(n):
                for j in range(i + 1):
                    if len(seen) and (i in seen) != (j in seen):
                        continue
                    if len(seen) and i in seen and power.any():
                        continue
                    found.append(("P", k, i, j))
        for letter, size in (("Q", len(self.model.w)), ("R", len(self.model.y))):
            found += [(letter, 0, i, j) for i in range(size) for j in range(i + 1)]
        return found

    def _functions(self) -> None:
        """Make f and the monomials, all as functions of v, and find the polynomials' degrees."""
        increments, names = self.increments, self.increments.names
        v = ca.SX.sym("v", len(names))
        signals = [v[place] for place in increments.place.values()]
        f, x = self.model.dynamics(ca.SX(0.0), *signals), v[increments.place["x"]]

        def monomials(at: Any) -> Any:
            scaled = [[(at[i] / self.nominal[i]) ** int(n) for i, n in enumerate(row) if n] for row in self.powers]
            return ca.vertcat(*(ca.SX(1.0) if not one else _product(one) for one in scaled))

        b = monomials(x)
        after = monomials(f) if self.units.discrete else ca.jtimes(b, x, f)
        blocks = [block for block, letter in zip(increments._expression[0], "ABECDF", strict=True) if letter in "ABCD"]
        blocks = [ca.substitute(ca.densify(ca.vec(block)), increments._expression[1], v) for block in blocks]
        # what the inequality is made of: products of at most these
        A = ca.densify(ca.vertcat(*blocks))
        made = ca.vertcat(after, *(b[k] * A for k in range(b.numel()) if not self.units.discrete))
        if self.units.discrete:
            made = ca.vertcat(b, *(after[k] * ca.vertcat(1, A) for k in range(after.numel())))
        self.values = ca.Function("values", [v], [b, after])
        self.expression, self.v, self.f = ca.densify(made), v, f
        self.degrees = degrees_of(self.expression, v)
        self.varying = np.flatnonzero(self.degrees)
        self.polynomial = not is_rough(ca.Function("m", [v], [self.expression])) and (self.degrees <= DEGREE).all()
        ends = np.array([increments.lower[self.varying], increments.upper[self.varying]])
        if not np.isfinite(ends).all():
            listed = ", ".join(repr(names[i]) for i in self.varying[~np.isfinite(ends).all(axis=0)])
            raise InputError(
                f"certify_metric: P(x) makes the inequality depend on {listed}, without finite bounds there"
            )

    def terms(self, v: Array) -> Array:
        """Return the inequality's matrix for each unknown, in nominal units, at points (k, nv): (k, unknowns, m, m)."""
        jacobians = self.units.scaled(self.increments.at(v))
        A, B, C, D = jacobians.A, jacobians.B, jacobians.C, jacobians.D
        b, after = (np.asarray(ca.DM(part)).T for part in self.values(ca.DM(v.T)))
        count, n, nw, ny = len(v), A.shape[1], B.shape[2], C.shape[1]
        sizes = {"P": n, "Q": nw, "R": ny}
        m = n + nw + (n if self.units.discrete else 0)
        found = np.zeros((count, len(self.free), m, m))
        f, h = np.concatenate([A, B], axis=2), np.concatenate([C, D], axis=2)
        for place, (letter, k, i, j) in enumerate(self.free):
            unit = np.zeros((sizes[letter],) * 2)
            unit[i, j] = unit[j, i] = 1.0
            one = found[:, place]
            if letter == "Q":
                one[:, n : n + nw, n : n + nw] += unit
            elif letter == "R":
                one[:, : n + nw, : n + nw] += h.transpose(0, 2, 1) @ unit @ h
            elif self.units.discrete:
                one[:, :n, :n] += self.eta * b[:, k, None, None] * unit
                one[:, n + nw :, : n + nw] += after[:, k, None, None] * (unit @ f)
                one[:, : n + nw, n + nw :] += after[:, k, None, None] * (unit @ f).transpose(0, 2, 1)
                one[:, n + nw :, n + nw :] += after[:, k, None, None] * unit
            else:
                one[:, :n, :n] += (np.log(self.eta) * b[:, k] - after[:, k])[:, None, None] * unit
                half = b[:, k, None, None] * (unit @ f)
                one[:, :n] -= half
                one[:, :, :n] -= half.transpose(0, 2, 1)
        return found

    def found(self, cover: str, extra: int, pieces: int) -> Metric:
        """Solve, and say what was proved."""
        cp = require_cvxpy()
        if cover != "grid" and not self.polynomial:
            raise InputError(
                f"certify_metric: model {self.model.name!r} is no polynomial of degree {DEGREE} and less; "
                "take cover='grid' (evidence), or a constant P"
            )
        theta = cp.Variable(len(self.free))
        weights = [self._matrix(theta, letter, 0) for letter in ("QR" if self.model.w else "R")]
        constraints: list[Any] = [weight >> SLACK * np.eye(weight.shape[0]) for weight in weights]
        shape = self._shape()
        upper, one = cp.Variable(), np.eye(len(self.nominal))
        for row in shape:
            P: Any = sum(row[k] * self._matrix(theta, "P", k) for k in range(len(self.powers)))
            constraints += [P >> one, P << upper * one]
        gram, values = None, None
        if cover == "squares":
            gram = squares(self._size(), self.degrees[self.varying].tolist(), extra=extra)
            values = self.terms(self._inside(gram.nodes))
            constraints += gram.constraints([self._joined(theta, value) for value in values], SLACK)
        else:
            values = self._grid() if cover == "grid" else self._coefficients(pieces)
            constraints += [self._joined(theta, value) >> SLACK * np.eye(self._size()) for value in values]
        gain: Any = sum(cp.trace(weight) for weight in weights)
        constraints.append(gain <= LARGEST)
        solved(cp.Problem(cp.Minimize(gain + upper), constraints))
        if gram is not None:
            worth = gram.worth(np.tensordot(values, theta.value, (1, 0)), SLACK)
        else:
            worth = float(np.linalg.eigvalsh(np.tensordot(values, theta.value, (1, 0)))[:, 0].min())
        if worth < 0:
            raise CertificateError(
                f"the metric of degree {self.powers.max()} misses the inequality by {-worth:.3g}: the solver was not "
                "exact enough; try a slower rate"
            )
        return self._certified(theta.value, cover, shape)

    def _size(self) -> int:
        n, nw = len(self.model.x), len(self.model.w)
        return 2 * n + nw if self.units.discrete else n + nw

    def _joined(self, theta: Any, value: Array) -> Any:
        m = value.shape[1]
        matrix = require_cvxpy().reshape(value.reshape(len(value), -1).T @ theta, (m, m), order="C")
        return (matrix + matrix.T) / 2

    def _matrix(self, theta: Any, letter: str, number: int) -> Any:
        """Return one of the unknown matrices, as an expression or as numbers."""
        size = {"P": len(self.model.x), "Q": len(self.model.w), "R": len(self.model.y)}[letter]
        total: Any = np.zeros((size, size))
        for place, (own, k, i, j) in enumerate(self.free):
            if own == letter and k == number:
                unit = np.zeros((size, size))
                unit[i, j] = unit[j, i] = 1.0
                total = total + theta[place] * unit
        return total

    def _inside(self, s: Array) -> Array:
        """Return points v of the domain for s in [-1, 1]^n."""
        v = np.tile(self.increments.centre, (len(s), 1))
        lower, upper = self.increments.lower[self.varying], self.increments.upper[self.varying]
        v[:, self.varying] = (lower + upper) / 2 + s * (upper - lower) / 2
        return v

    def _coefficients(self, pieces: int) -> Array:
        rules = [bernstein(-1.0, 1.0, int(d), pieces if d > 1 else 1) for d in self.degrees[self.varying]]
        if not rules:
            return self.terms(self.increments.centre[None])
        shape = (len(self.free), self._size(), self._size())
        return combined(lambda s: self.terms(self._inside(s)).reshape(len(s), -1), rules).reshape(-1, *shape)

    def _grid(self) -> Array:
        rng = np.random.default_rng(0)
        corners = self._inside(rng.choice([-1.0, 1.0], (64, len(self.varying))))
        return self.terms(np.vstack([self.increments.random(SAMPLES, rng), corners]))

    def _shape(self) -> Array:
        """Return Bernstein coefficients of the monomials: P lies between what they make of the P_k."""
        degree, place = self.powers.max(initial=0), self.increments.place["x"]
        lower, upper = (side[place] / self.nominal for side in (self.increments.lower, self.increments.upper))
        rules = [bernstein(lower[i], upper[i], int(degree)) for i in self.within]
        if not rules:
            return np.ones((1, 1))
        powers = self.powers[:, self.within]
        return combined(lambda x: np.prod(x[:, None, :] ** powers, axis=2), rules)

    def _certified(self, theta: Array, cover: str, shape: Array) -> Metric:
        x, w, y = (np.linalg.inv(unit) for unit in (self.units.x, self.units.w, self.units.y))
        inner = np.array([self._matrix(theta, "P", k) for k in range(len(self.powers))])
        corners = np.tensordot(shape, inner, 1)
        one = np.eye(len(x))
        upper = least_upper_bound(corners, one) * (1 + 1e-9)
        lower = np.linalg.inv(least_upper_bound(np.linalg.inv(corners), one)) * (1 - 1e-9)
        rng = np.random.default_rng(2)
        v = np.vstack([self.increments.random(20 * SAMPLES, rng), self.increments.corners()])
        margins = np.linalg.eigvalsh(np.tensordot(self.terms(v), theta, (1, 0)))[:, 0]
        worst = dict(zip(self.increments.names, v[margins.argmin()].tolist(), strict=True))
        if margins.min() < 0:
            raise CertificateError(f"the inequality fails by {-margins.min():.3g} at {worst}")
        leaving = self._leaving() if self.powers.any() else []
        notes = (f"P(x) of degree {self.powers.max()}; bounds of its energy",) if self.powers.any() else ()
        if leaving:
            notes += (f"not invariant: {', '.join(leaving)} may leave; a proof needs curves that stay inside",)
        certificate = DetectabilityCertificate(
            x @ lower @ x,
            x @ upper @ x,
            w @ self._matrix(theta, "Q", 0) @ w if len(self.model.w) else np.zeros((0, 0)),
            y @ self._matrix(theta, "R", 0) @ y,
            self.eta,
            step=self.model.step,
            method={"squares": "sum of squares"}.get(cover, cover),
            rigorous=cover != "grid" and not leaving,
            margin=float(margins.min()),
            domain=self.domain,
            worst=worst,
            notes=notes,
        )
        return Metric(certificate, x @ inner @ x, self.powers, self.nominal)

    def _leaving(self) -> list[str]:
        """Return the states of which P depends on and whose bounds f does not respect, by interval arithmetic."""
        enclosure, found = Enclosure(self.f[self.within], self.v), []
        lower, upper = self.increments.lower, self.increments.upper
        for k, i in enumerate(self.within):
            place = self.increments.place["x"].start + i
            if self.units.discrete:
                low, high = enclosure.over(lower, upper)
                inside = low[k] >= lower[place] and high[k] <= upper[place]
            else:
                face = [
                    np.where(np.arange(len(lower)) == place, end[place], end_)
                    for end, end_ in ((lower, lower), (lower, upper), (upper, lower), (upper, upper))
                ]
                inside = enclosure.over(face[0], face[1])[0][k] >= 0 >= enclosure.over(face[2], face[3])[1][k]
            if not inside:
                found.append(self.increments.names[place])
        return found


def _product(factors: list[Any]) -> Any:
    total = factors[0]
    for factor in factors[1:]:
        total = total * factor
    return total
