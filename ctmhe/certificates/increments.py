"""How two trajectories of a model differ: its Jacobians, their mean values between two points, and their range."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from math import comb
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ctmhe.errors import InputError
from ctmhe.models.continuous import KINDS, Model, box_arrays
from ctmhe.types import Array, Bounds

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2  # exact for Jacobians of degree 15 and less
DEGREE, PIECES, MOST_POINTS, GRID_POINTS, KEPT = 8, 4, 20_000, 400, 40
ROUGH = (
    *(ca.OP_FABS, ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FMOD, ca.OP_COPYSIGN),
    *(ca.OP_IF_ELSE_ZERO, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT),
)
"""Instructions that are not analytic: that a derivative vanishes at random points proves nothing of them."""


class Jacobians(NamedTuple):
    """Derivatives (7.39) at k points, of f by x, w, p and of h by x, w, p, in the model's units.

    A (k, nx, nx), B (k, nx, nw), E (k, nx, np), C (k, ny, nx), D (k, ny, nw), F (k, ny, np).
    """

    A: Array
    B: Array
    E: Array
    C: Array
    D: Array
    F: Array

    def take(self, index: Any) -> Jacobians:
        """Return those of some of the points."""
        return Jacobians(*(part[index] for part in self))


@dataclass(frozen=True, eq=False)
class Cover:
    """Jacobians whose convex hull holds those of the whole domain, or samples of them.

    Attributes
    ----------
    jacobians : Jacobians
    method : str
        `constant`; `vertices` of a multi-affine Jacobian; `bernstein` coefficients of a polynomial one; `grid`.
    rigorous : bool
        The hull holds them all, to rounding; a grid is evidence only.
    """

    jacobians: Jacobians
    method: str
    rigorous: bool


class Increments:
    """The Jacobians of a model on a box of (x, u, w, p), and how they vary there.

    Points are rows of v = (x, u, w, p).

    Parameters
    ----------
    model : Model
        Whose functions do not depend on time; an FMU is evaluated at t = 0.
    domain : Bounds, optional
        Boxes of x, w and p; the model's own bounds when left out.
    u : box, optional
        Range of the inputs, in any form of `Bounds`.

    Attributes
    ----------
    names : tuple of str
    lower, upper, nominal : array (nv,)
        Of the entries of v.
    varying : array of int
        Entries of v on which a Jacobian depends.

    Raises
    ------
    InputError
        If a Jacobian depends on a signal without finite bounds, or the model on time.
    """

    def __init__(self, model: Model, domain: Bounds | None = None, *, u: Any = None):
        self.model, domain = model, domain or model.bounds
        groups = {"x": domain.x, "u": u, "w": domain.w, "p": domain.p}
        boxes = [box_arrays(getattr(model, key), box, f"domain of {key}") for key, box in groups.items()]
        self.lower, self.upper = (np.concatenate([box[side] for box in boxes]) for side in (0, 1))
        self.nominal = np.concatenate([np.asarray(getattr(model, key).nominal) for key in groups])
        self.names = tuple(name for key in groups for name in getattr(model, key).names)
        edges = np.cumsum([0, *(len(getattr(model, key)) for key in groups)])
        self.place = {key: slice(edges[i], edges[i + 1]) for i, key in enumerate(groups)}
        self.symbolic = model.dynamics.is_a("SXFunction") and model.output.is_a("SXFunction")
        kind: Any = ca.SX if self.symbolic else ca.MX
        v, t = kind.sym("v", len(self.names)), (kind.sym("t") if self.symbolic else kind(0.0))
        signals = [v[place] for place in self.place.values()]
        values = [function(t, *signals) for function in (model.dynamics, model.output)]
        if self.symbolic and ca.depends_on(ca.vertcat(*values), t):
            raise InputError(
                f"model {model.name!r} depends on time: make what changes with time a known input, and give its range"
            )
        blocks = [ca.jacobian(value, v)[:, self.place[key]] for value in values for key in "xwp"]
        self._shapes = [block.shape for block in blocks]
        stacked = ca.densify(ca.vertcat(*(ca.vec(block) for block in blocks)))
        self._at = ca.Function("jacobians", [v], [stacked])
        self.degrees: np.ndarray | None = None
        self.varying = np.arange(len(self.names))
        if self.symbolic:
            degrees = _degrees(stacked, v, self.nominal)
            self.varying = np.flatnonzero(degrees)
            rough = any(self._at.instruction_id(k) in ROUGH for k in range(self._at.n_instructions()))
            self.degrees = degrees if (degrees <= DEGREE).all() and not rough else None
        self._demand_bounds()

    def _demand_bounds(self) -> None:
        free = [i for i in self.varying if not np.isfinite([self.lower[i], self.upper[i]]).all()]
        if free:
            kinds = {i: next(key for key, place in self.place.items() if place.start <= i < place.stop) for i in free}
            listed = ", ".join(f"{KINDS[kinds[i]]} {self.names[i]!r}" for i in free)
            where = "u=" if all(kind == "u" for kind in kinds.values()) else "domain=Bounds(...)"
            raise InputError(
                f"domain: the Jacobians of model {self.model.name!r} depend on {listed}, without finite bounds there; "
                f"give both sides with {where}"
            )

    def at(self, v: Array) -> Jacobians:
        """Return the Jacobians at points v (k, nv)."""
        v = np.atleast_2d(np.asarray(v, dtype=float))
        flat = np.asarray(ca.DM(self._at(ca.DM(v.T)))).T
        parts, start = [], 0
        for rows, columns in self._shapes:
            block = flat[:, start : start + rows * columns].reshape(len(v), columns, rows)
            parts.append(block.transpose(0, 2, 1))
            start += rows * columns
        return Jacobians(*parts)

    def between(self, v1: Array, v2: Array) -> Jacobians:
        """Return mean values between points v1 and v2 (k, nv) with equal inputs: f(v1) - f(v2) = A dx + B dw + E dp.

        The path first changes p at the first point, then x and w at p of the second. (7.39) goes straight, which serves
        the proofs equally well, but then E depends on the second point even if f is affine in p, and (7.68) is needed.
        A and E lie in the hulls of theirs, but not together in the hull of both: conditions on both ask for `mean`.
        """
        v1, v2 = np.broadcast_arrays(np.atleast_2d(v1), np.atleast_2d(v2))
        corner = v1.copy()
        corner[:, self.place["p"]] = v2[:, self.place["p"]]
        first, second = self.mean(v1, corner), self.mean(corner, v2)
        return Jacobians(second.A, second.B, first.E, second.C, second.D, first.F)

    def mean(self, start: Array, end: Array) -> Jacobians:
        """Return mean values (7.39) on the lines from start to end (k, nv), in the hull of the point values."""
        found = self.at(np.vstack([start + s * (end - start) for s in NODES]))
        shape = (len(NODES), len(start))
        return Jacobians(*(np.tensordot(WEIGHTS, part.reshape(*shape, *part.shape[1:]), 1) for part in found))

    @property
    def centre(self) -> Array:
        """The middle of the domain (nv,); the nominal value, inside the bounds, where it has no end."""
        finite = np.isfinite(self.lower) & np.isfinite(self.upper)
        middle = (np.where(finite, self.lower, 0.0) + np.where(finite, self.upper, 0.0)) / 2
        return np.where(finite, middle, np.clip(self.nominal, self.lower, self.upper))

    def random(self, count: int, rng: np.random.Generator) -> Array:
        """Return random points (count, nv) of the domain; signals without ends stay at the centre."""
        v = np.tile(self.centre, (count, 1))
        finite = np.isfinite(self.lower) & np.isfinite(self.upper)
        v[:, finite] = rng.uniform(self.lower[finite], self.upper[finite], (count, int(finite.sum())))
        return v

    def random_pairs(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return random pairs of points with equal inputs, (count, nv) each."""
        v1, v2 = self.random(count, rng), self.random(count, rng)
        v2[:, self.place["u"]] = v1[:, self.place["u"]]
        return v1, v2

    def corners(self) -> Array:
        """Return vertices (k, nv) of the box of varying signals: all, or 64 random ones."""
        n = len(self.varying)
        sides = np.random.default_rng(1).integers(0, 2, (64, n))
        if n <= 6:
            sides = np.indices((2,) * n).reshape(n, 2**n).T
        v = np.tile(self.centre, (len(sides), 1))
        v[:, self.varying] = np.where(sides, self.upper[self.varying], self.lower[self.varying])
        return v

    def cover(self, which: str = "ABECDF") -> Cover:
        """Return Jacobians whose hull holds those of the domain, in the named parts together; see `Cover`.

        A polynomial lies in the hull of its Bernstein coefficients; of one that is affine in every signal these are the
        values at the vertices. Signals of higher degree are cut into pieces first, which tightens the hull.
        """
        if self.degrees is None:
            return self._grid(which)
        if not len(self.varying):
            return Cover(self.at(self.centre), "constant", True)
        degrees = self.degrees[self.varying]
        if np.where(degrees > 1, PIECES * (degrees + 1), 2).prod() > MOST_POINTS:
            return self._grid(which)
        found = _pruned(self._coefficients(degrees), which)
        method = "constant" if len(found.A) == 1 else "bernstein" if (degrees > 1).any() else "vertices"
        return Cover(found, method, True)

    def _grid(self, which: str) -> Cover:
        samples = self.random(GRID_POINTS, np.random.default_rng(0))
        found = _pruned(self.at(np.vstack([samples, self.corners()])), which)
        return Cover(_farthest(found, which), "grid", False)

    def _coefficients(self, degrees: np.ndarray) -> Jacobians:
        """Return the Bernstein coefficients of all pieces of the box."""
        axes, inverses = [], []
        for i, d in zip(self.varying, degrees, strict=True):
            edges = np.linspace(self.lower[i], self.upper[i], (PIECES if d > 1 else 1) + 1)
            nodes = np.linspace(0.0, 1.0, d + 1)
            axes.append((edges[:-1, None] + nodes * np.diff(edges)[:, None]).ravel())
            inverse = np.linalg.inv([[comb(d, k) * s**k * (1 - s) ** (d - k) for k in range(d + 1)] for s in nodes])
            inverses.append(np.kron(np.eye(len(edges) - 1), inverse))
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
        v = np.tile(self.centre, (len(grid), 1))
        v[:, self.varying] = grid
        shape = tuple(len(axis) for axis in axes)

        def converted(part: Array) -> Array:
            values = part.reshape(*shape, part[0].size)
            for axis, inverse in enumerate(inverses):
                values = np.moveaxis(np.tensordot(inverse, values, (1, axis)), 0, axis)
            return values.reshape(part.shape)

        return Jacobians(*(converted(part) for part in self.at(v)))


def _degrees(stacked: Any, v: Any, nominal: Array) -> np.ndarray:
    """Return the degree of expressions in every entry of v; DEGREE + 1 for more, or where they are no polynomials."""
    rng, found = np.random.default_rng(0), np.zeros(len(nominal), dtype=int)
    points = ca.DM(nominal[:, None] * rng.normal(size=(len(nominal), 12)))
    for i in range(len(nominal)):
        derivative, scale = stacked, 0.0
        while found[i] <= DEGREE:
            derivative = ca.jacobian(derivative, v[i])
            if derivative.nnz() == 0:
                break
            size = np.abs(np.asarray(ca.DM(ca.Function("d", [v], [ca.densify(derivative)])(points))))
            scale = max(scale, np.nanmax(size, initial=0.0))
            if np.isfinite(size).all() and size.max(initial=0.0) <= 1e-12 * scale:
                break  # analytic functions that vanish at random points vanish everywhere
            found[i] += 1
    return found


def _pruned(jacobians: Jacobians, which: str) -> Jacobians:
    """Return those at the vertices of the hull of the named parts, as far as that is quickly found."""
    count = len(jacobians.A)
    flat = np.concatenate([getattr(jacobians, letter).reshape(count, -1) for letter in which], axis=1)
    flat = np.round(flat / max(np.abs(flat).max(initial=0.0), 1e-300), 13)
    first = np.sort(np.unique(flat, axis=0, return_index=True)[1])
    flat = flat[first] - flat[first].mean(axis=0)
    left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
    rank = int((sizes > 1e-11).sum())
    inner, keep = left[:, :rank] * sizes[:rank], np.arange(len(first))
    if rank == 0:
        keep = keep[:1]
    elif rank == 1:
        keep = np.array([inner.argmin(), inner.argmax()])
    elif rank <= 4 and len(first) > rank + 1:
        with suppress(QhullError):
            keep = np.sort(ConvexHull(inner).vertices)
    return jacobians.take(first[keep])


def _farthest(jacobians: Jacobians, which: str) -> Jacobians:
    """Return those that are farthest out in random directions, a few dozen: of samples, what a program has to see."""
    flat = np.concatenate([getattr(jacobians, letter).reshape(len(jacobians.A), -1) for letter in which], axis=1)
    width = np.ptp(flat, axis=0)
    flat = (flat - flat.mean(axis=0)) / np.where(width > 1e-11 * np.abs(flat).max(), width, np.inf)
    directions = np.random.default_rng(0).normal(size=(flat.shape[1], KEPT))
    return jacobians.take(np.unique((flat @ directions).argmax(axis=0)))


def constant(parts: Array) -> bool:
    """Return whether k matrices are the same, to rounding."""
    return bool(np.ptp(parts, axis=0).max(initial=0.0) <= 1e-11 * np.abs(parts).max(initial=1.0))
