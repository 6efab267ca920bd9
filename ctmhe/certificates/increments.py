"""How two trajectories of a model differ: its Jacobians, their mean values between two points, and their range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctmhe.certificates.embedding import (
    DEGREE,
    MOST_SIDES,
    PIECES,
    bernstein,
    combined,
    degrees_of,
    hull_points,
    is_rough,
    outermost,
)
from ctmhe.errors import InputError
from ctmhe.models.continuous import KINDS, Model, box_arrays
from ctmhe.types import Array, Bounds

NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2  # exact for Jacobians of degree 15 and less
MOST_POINTS, GRID_POINTS, KEPT = 20_000, 400, 40

AT_ONCE = 80
"""Jacobians that a program takes which has to see all of them at once; domains that need more are sampled for it."""

REMAINDER = getattr(ca, "OP_REMAINDER", 97)
JUMPS = {
    ca.OP_SIGN: "sign",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_FMOD: "fmod",
    ca.OP_COPYSIGN: "copysign",
    ca.OP_IF_ELSE_ZERO: "if_else",
    ca.OP_LT: "<",
    ca.OP_LE: "<=",
    ca.OP_EQ: "==",
    ca.OP_NE: "!=",
    ca.OP_NOT: "not",
    ca.OP_AND: "and",
    ca.OP_OR: "or",
    ca.OP_ATAN2: "atan2",
    REMAINDER: "remainder",
}
"""Instructions that may jump, as users write them: no Jacobian sees that, and mean values of it say nothing."""


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
        `constant`; `vertices` of a multi-affine Jacobian; `bernstein` coefficients of a polynomial one; `interval`
        bounds of any; `grid`.
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
        If a Jacobian depends on a signal without finite bounds, the model on time, or if it may jump.
    """

    def __init__(self, model: Model, domain: Bounds | None = None, *, u: Any = None):
        self.model, domain = model, domain or model.bounds
        self._boxes = domain, u
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
        ends = np.cumsum([0, *(block.numel() for block in blocks)])
        self._columns = [slice(start, end) for start, end in pairwise(ends)]
        stacked = ca.densify(ca.vertcat(*(ca.vec(block) for block in blocks)))
        self._at = ca.Function("jacobians", [v], [stacked])
        self.degrees: np.ndarray | None = None
        self.varying = np.arange(len(self.names))
        if self.symbolic:
            self._expression, self._rough = (blocks, v), is_rough(self._at)
            self._demand_continuity()
            degrees = degrees_of(stacked, v)
            self.varying = np.flatnonzero(degrees)
            self.degrees = degrees if (degrees <= DEGREE).all() and not self._rough else None
        self._demand_bounds()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.model, *self._boxes)  # expressions cannot be pickled

    def _demand_continuity(self) -> None:
        for function, label in ((self.model.dynamics, "f"), (self.model.output, "h")):
            used = {function.instruction_id(k) for k in range(function.n_instructions())}
            if found := [name for operation, name in JUMPS.items() if operation in used]:
                raise InputError(
                    f"model {self.model.name!r}: {label} uses {', '.join(found)} and may jump; Jacobians do not tell. "
                    "Write it with smooth functions (ca.tanh, ca.sqrt, ca.atan for atan2 where x > 0), or with "
                    "ca.fabs, ca.fmin and ca.fmax if it is continuous"
                )

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
        return self._parts(self._flat(np.atleast_2d(np.asarray(v, dtype=float))))

    def _flat(self, v: Array) -> Array:
        return np.asarray(ca.DM(self._at(ca.DM(v.T)))).T

    def _parts(self, flat: Array) -> Jacobians:
        shapes = zip(self._shapes, self._columns, strict=True)
        parts = (flat[:, place].reshape(len(flat), columns, rows) for (rows, columns), place in shapes)
        return Jacobians(*(part.transpose(0, 2, 1) for part in parts))

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

    def cover(self, which: str = "ABECDF", *, given: Mapping[str, Any] | None = None, most: int | None = None) -> Cover:
        """Return Jacobians whose hull holds those of the domain, in the named parts together; see `Cover`.

        A polynomial lies in the hull of its Bernstein coefficients; of one that is affine in every signal these are the
        values at the vertices. Signals of higher degree are cut into pieces first, which tightens the hull. What is no
        polynomial, or one in too many signals, is bounded as `embedding` explains. Parts that are not named are those
        at some point of the domain.

        Parameters
        ----------
        given : mapping letter -> (lower, upper), optional
            Bounds of the entries of one's own, for an FMU: matrices or scalars. All parts that are not constant at
            samples must be there; the proof is as good as these bounds.
        most : int, optional
            For programs that have to see all of them at once: where more would be needed, a grid takes their place.

        Raises
        ------
        InputError
            If bounds are missing, of the wrong size, contradicted by a sample, or of more than 12 varying entries.
        """
        if given is not None:
            return self._given(which, given)
        if not len(self.varying):
            return Cover(self.at(self.centre), "constant", True)
        found = self._polynomial(which) or self._embedded(which) or self._grid(which)
        if most is not None and len(found.jacobians.A) > most:
            return self._grid(which)
        return replace(found, method="constant") if len(found.jacobians.A) == 1 and found.rigorous else found

    def _polynomial(self, which: str) -> Cover | None:
        if self.degrees is None:
            return None
        degrees, lower, upper = (part[self.varying] for part in (self.degrees, self.lower, self.upper))
        if np.where(degrees > 1, PIECES * (degrees + 1), 2).prod() > MOST_POINTS:
            return None

        def at(points: Array) -> Array:
            v = np.tile(self.centre, (len(points), 1))
            v[:, self.varying] = points
            return self._flat(v)

        sides = zip(lower, upper, degrees, strict=True)
        coefficients = combined(at, [bernstein(a, b, int(d), PIECES if d > 1 else 1) for a, b, d in sides])
        method = "bernstein" if (degrees > 1).any() else "vertices"
        return Cover(_pruned(self._parts(coefficients), which), method, True)

    def _embedded(self, which: str) -> Cover | None:
        if not self.symbolic:
            return None
        blocks, v = self._expression
        of_interest = ca.vertcat(*(ca.vec(blocks["ABECDF".index(letter)]) for letter in which))
        lower, upper = self.lower.copy(), self.upper.copy()
        fixed = np.setdiff1d(np.arange(len(self.names)), self.varying)
        lower[fixed], upper[fixed] = self.centre[fixed], self.centre[fixed]
        found = hull_points(of_interest, v, lower, upper, smooth=not self._rough)
        if found is None:
            return None
        return Cover(_pruned(self._filled(which, found), which), "interval", True)

    def _given(self, which: str, given: Mapping[str, Any]) -> Cover:
        if unknown := set(given) - set(which):
            raise InputError(f"cover: bounds of {sorted(unknown)}, but asked for the parts {which!r}")
        points = np.vstack([self.random(GRID_POINTS, np.random.default_rng(0)), self.corners()])
        samples, low, high = self.at(points), {}, {}
        for letter in which:
            part = getattr(samples, letter)
            if letter not in given and not constant(part):
                raise InputError(
                    f"cover: {letter} varies over the domain: give its bounds too, ({letter!r}: (lower, upper))"
                )
            ends = given.get(letter, (part[0], part[0]))
            try:
                low[letter], high[letter] = (
                    np.broadcast_to(np.asarray(end, dtype=float), part[0].shape) for end in ends
                )
            except ValueError:
                raise InputError(f"cover: bounds of {letter} must be two of shape {part[0].shape} or scalar") from None
            slack = 1e-9 * np.abs(part).max(initial=1e-300)
            outside = (part < low[letter] - slack) | (part > high[letter] + slack)
            if outside.any():
                k, i, j = np.argwhere(outside)[0]
                at = ", ".join(f"{name} = {value:.4g}" for name, value in zip(self.names, points[k], strict=True))
                raise InputError(f"cover: {letter}[{i}, {j}] is {part[k, i, j]:.6g}, outside the given bounds, at {at}")
        flat = [np.concatenate([side[letter].T.ravel() for letter in which]) for side in (low, high)]
        moving = np.flatnonzero(flat[1] > flat[0])
        if len(moving) > MOST_SIDES:
            raise InputError(f"cover: {len(moving)} entries vary; the vertices of at most {MOST_SIDES} can be taken")
        corners = np.tile(flat[0], (2 ** len(moving), 1))
        sides = np.indices((2,) * len(moving)).reshape(len(moving), -1).T
        corners[:, moving] = np.where(sides, flat[1][moving], flat[0][moving])
        return Cover(self._filled(which, corners), "interval", True)

    def _filled(self, which: str, values: Array) -> Jacobians:
        """Return Jacobians with the named parts given, (k, entries of these), the others as at the centre."""
        flat, start = np.repeat(self._flat(self.centre[None]), len(values), axis=0), 0
        for letter in which:
            place = self._columns["ABECDF".index(letter)]
            flat[:, place] = values[:, start : start + place.stop - place.start]
            start += place.stop - place.start
        return self._parts(flat)

    def _grid(self, which: str) -> Cover:
        samples = self.random(GRID_POINTS, np.random.default_rng(0))
        found = _pruned(self.at(np.vstack([samples, self.corners()])), which)
        return Cover(_farthest(found, which), "grid", False)


def _pruned(jacobians: Jacobians, which: str) -> Jacobians:
    """Return those at the vertices of the hull of the named parts, as far as that is quickly found."""
    count = len(jacobians.A)
    flat = np.concatenate([getattr(jacobians, letter).reshape(count, -1) for letter in which], axis=1)
    flat = np.round(flat / max(np.abs(flat).max(initial=0.0), 1e-300), 13)
    flat = flat[:, np.ptp(flat, axis=0) > 0] if count > 1 else flat
    if not flat.shape[1]:
        return jacobians.take([0])
    first = np.sort(np.unique(flat, axis=0, return_index=True)[1])
    flat = flat[first] - flat[first].mean(axis=0)
    left, sizes, _ = np.linalg.svd(flat, full_matrices=False)
    rank = int((sizes > 1e-11).sum())
    inner, keep = left[:, :rank] * sizes[:rank], np.arange(len(first))
    keep = outermost(inner) if rank else keep[:1]
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
    return bool(np.ptp(parts, axis=0).max(initial=0.0) <= 1e-11 * np.abs(parts).max(initial=0.0))


def _rebuilt(model: Model, domain: Bounds, u: Any) -> Increments:
    return Increments(model, domain, u=u)
