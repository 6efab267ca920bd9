"""Points whose convex hull holds the values of an expression on a box: where the expression is no polynomial.

What some variables do through one number only becomes one variable, bounded by interval arithmetic (u of a quadrotor:
its lift). Then there are two ways, both rigorous.

**Interpolation.** Let L_a be finitely many combinations of values at nodes, such that for every v the value f(v) is a
convex combination of the L_a f, for all f of a space of functions. If that holds in each of several variables for the
sections of an expression, then J(v) lies in the hull of all products L_a L_b ... J: insert one convex combination into
the other. For polynomials the Bernstein coefficients are such combinations. For other functions we take those of the
interpolant I f at Chebyshev nodes, |f - I f| <= 2 (h/4)^(d+1) max |f^(d+1)| / (d+1)! for degree d on a length h, with
derivatives bounded by `taylor`. The expression must have few sections, n say, of which all others are combinations;
these make a curve in R^n within a box D of the hull H of what the combinations give. H about its centre c holds
c +- t_k e_k (linear programs), so c + D / s for s = sum of r_k / t_k with the sides r_k of D, and H + D is in
H + s (H - c): the combinations are stretched about their mean by 1 + s.

**A box** of the entries in which all others are affine, bounded by interval arithmetic, and its vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from math import comb
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.linalg import qr
from scipy.optimize import linprog, nnls
from scipy.spatial import ConvexHull, QhullError

from ctmhe.certificates.interval import Enclosure, Intervals
from ctmhe.certificates.taylor import derivative_bounds
from ctmhe.types import Array

ROUGH = (
    *(ca.OP_FABS, ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_FMIN, ca.OP_FMAX, ca.OP_FMOD, ca.OP_COPYSIGN),
    *(ca.OP_IF_ELSE_ZERO, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT),
)
"""Instructions that are not analytic: that a derivative vanishes at random points proves nothing of them."""

DEGREE, PIECES = 8, 4
MOST_POINTS = 6000
MOST_SIDES = 12
"""Of a box of entries: 4096 vertices."""

MOST_SECTIONS, CUT = 8, 512
STRETCH = 0.05
"""What the remainder may stretch the hull by."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """An expression in as few variables as it has.

    Attributes
    ----------
    values : SX
        Column.
    variables : SX
        Column, the symbols it depends on.
    lower, upper : array
        Their range.
    source : tuple of int
        Entry of the original vector that each is; -1 for what stands for several.
    """

    values: Any
    variables: Any
    lower: Array
    upper: Array
    source: tuple[int, ...]


def reduced(values: Any, v: Any, lower: Array, upper: Array) -> Reduced:
    """Return an expression with one variable in place of those that act through one number only."""
    values = ca.densify(values)
    function = ca.Function("f", [v], [values])
    if function.n_instructions() <= 4000:
        nodes, needs, parents = _graph(function, v)
        found = _bottlenecks(needs, parents)
    else:
        nodes, found = [], []
    fresh = [ca.SX.sym(f"s{i}") for i in range(len(found))]
    low, high = np.array(lower, dtype=float), np.array(upper, dtype=float)
    source = list(range(v.numel()))
    if found:
        inner = ca.vertcat(*(nodes[k] for k in found))
        ends = Enclosure(inner, v).over(lower, upper)
        values = _replaced(function, v, dict(zip(found, fresh, strict=True)))
        low, high = np.concatenate([low, ends[0]]), np.concatenate([high, ends[1]])
        source += [-1] * len(found)
    variables = ca.vertcat(v, *fresh)
    used = [i for i in range(variables.numel()) if ca.depends_on(values, variables[i])]
    rest = ca.substitute(values, variables, ca.vertcat(*(variables[i] if i in used else 0 for i in range(len(source)))))
    return Reduced(rest, variables[used], low[used], high[used], tuple(source[i] for i in used))


def _graph(function: ca.Function, v: Any) -> tuple[list[Any], list[int], list[tuple[int, ...]]]:
    """Return what every instruction computes, on which entries of v it depends (bits), and from which it is made."""
    nodes, needs, parents, held = [], [], [], {}
    for k in range(function.n_instructions()):
        code, out, into = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            made, node = (held[into[0]],), nodes[held[into[0]]]
        elif code == ca.OP_INPUT:
            made, node = (), v[into[1]]
        elif code == ca.OP_CONST:
            made, node = (), ca.SX(function.instruction_constant(k))
        else:
            made = tuple(held[register] for register in into)
            kind = ca.SX.unary if len(made) == 1 else ca.SX.binary
            node = kind(code, *(nodes[i] for i in made))
        bits = 1 << into[1] if code == ca.OP_INPUT else 0
        for i in made:
            bits |= needs[i]
        nodes.append(node)
        needs.append(bits)
        parents.append(made if code != ca.OP_OUTPUT else (-1, *made))
        if code != ca.OP_OUTPUT:
            held[out[0]] = k
    return nodes, needs, parents


def _bottlenecks(needs: list[int], parents: list[tuple[int, ...]]) -> list[int]:
    """Return instructions through which alone some entries act, disjoint in these, those of most and the last first."""
    found, taken = [], 0
    made = [k for k, bits in enumerate(needs) if bits and parents[k] and -1 not in parents[k]]
    for k in sorted(made, key=lambda k: (-needs[k].bit_count(), -k)):
        if needs[k] & taken:
            continue
        without = list(needs)
        without[k] = 0
        for j in range(k + 1, len(needs)):
            if parents[j]:
                without[j] = 0
                for i in parents[j]:
                    without[j] |= without[i] if i >= 0 else 0
        ends = [without[j] for j, made in enumerate(parents) if -1 in made]
        if not any(bits & needs[k] for bits in ends):
            found.append(k)
            taken |= needs[k]
    return found


def _replaced(function: ca.Function, v: Any, swap: dict[int, Any]) -> Any:
    """Return the values with symbols in place of what some instructions compute."""
    held: dict[int, Any] = {}
    result = ca.SX.zeros(function.numel_out(0), 1)
    for k in range(function.n_instructions()):
        code, out, into = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            result[out[1]] = held[into[0]]
        elif k in swap:
            held[out[0]] = swap[k]
        elif code == ca.OP_INPUT:
            held[out[0]] = v[into[1]]
        elif code == ca.OP_CONST:
            held[out[0]] = ca.SX(function.instruction_constant(k))
        else:
            kind = ca.SX.unary if len(into) == 1 else ca.SX.binary
            held[out[0]] = kind(code, *(held[register] for register in into))
    return result


def is_rough(function: ca.Function) -> bool:
    """Return whether a function has kinks or jumps, as far as its instructions say."""
    return any(function.instruction_id(k) in ROUGH for k in range(function.n_instructions()))


def degrees_of(values: Any, v: Any) -> np.ndarray:
    """Return a bound of the degree of expressions in every entry of v; DEGREE + 1 where they may be no polynomials.

    From the instructions, so that it holds: what cancels is not seen to.
    """
    function = ca.Function("values", [v], [values])
    n, other = v.numel(), DEGREE + 1
    held: dict[int, np.ndarray] = {}
    numbers: dict[int, float] = {}
    found = np.zeros(n, dtype=int)
    for k in range(function.n_instructions()):
        code, into, out = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_OUTPUT:
            found = np.maximum(found, held[into[0]])
            continue
        number = None
        if code == ca.OP_CONST:
            degree, number = np.zeros(n, dtype=int), float(function.instruction_constant(k))
        elif code == ca.OP_INPUT:
            degree = np.eye(n, dtype=int)[into[1]]
        else:
            parts = [held[register] for register in into]
            powers = numbers.get(into[1]) if len(into) > 1 else None
            if code in (ca.OP_ADD, ca.OP_SUB):
                degree = np.maximum(*parts)
            elif code in (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE):
                degree = parts[0]
            elif code == ca.OP_MUL:
                degree = parts[0] + parts[1]
            elif code == ca.OP_SQ:
                degree = 2 * parts[0]
            elif code == ca.OP_DIV and not parts[1].any():
                degree = parts[0]
            elif code in (ca.OP_POW, ca.OP_CONSTPOW) and powers is not None and powers >= 0 and powers % 1 == 0:
                degree = int(powers) * parts[0]
            else:
                degree = other * (np.sum(parts, axis=0) > 0)
        held[out[0]] = np.minimum(degree, other)
        numbers.pop(out[0], None)
        if number is not None:
            numbers[out[0]] = number
    return found


class Rule(NamedTuple):
    """What replaces a value at any point of an interval: combinations (k, n) of the values at nodes (n,)."""

    nodes: Array
    matrix: Array


def bernstein(lower: float, upper: float, degree: int, pieces: int = 1) -> Rule:
    """Return the rule whose combinations are the Bernstein coefficients of a polynomial, or of its interpolant."""
    edges = np.linspace(lower, upper, pieces + 1)
    nodes = (1 - np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))) / 2  # Chebyshev's
    nodes = np.array([0.0, 1.0]) if degree == 1 else nodes
    basis = [[comb(degree, k) * s**k * (1 - s) ** (degree - k) for k in range(degree + 1)] for s in nodes]
    places = edges[:-1, None] + nodes * np.diff(edges)[:, None]
    return Rule(places.ravel(), np.kron(np.eye(pieces), np.linalg.inv(basis)))


def combined(at: Callable[[Array], Array], rules: Sequence[Rule]) -> Array:
    """Return all products of the rules' combinations (k, m) of the values (., m) that `at` gives at points (., n)."""
    grid = np.stack(np.meshgrid(*(rule.nodes for rule in rules), indexing="ij"), axis=-1)
    values = at(grid.reshape(-1, len(rules)))
    shaped = values.reshape(*grid.shape[:-1], -1)
    for axis, rule in enumerate(rules):
        shaped = np.moveaxis(np.tensordot(rule.matrix, shaped, (1, axis)), 0, axis)
    return shaped.reshape(-1, values.shape[1])


def hull_points(values: Any, v: Any, lower: Array, upper: Array, *, smooth: bool) -> Array | None:
    """Return points (k, m) whose hull holds the m values for all v of the box, None if neither way leads there.

    Parameters
    ----------
    values, v : SX
        Columns.
    smooth : bool
        Whether the values are analytic.
    """
    try:
        given = reduced(values, v, lower, upper)
    except NotImplementedError:  # an instruction without an interval version
        return None
    if not np.isfinite([given.lower, given.upper]).all():
        return None
    function = ca.Function("values", [given.variables], [given.values])

    def at(points: Array) -> Array:
        return np.asarray(ca.DM(function(ca.DM(points.T)))).T

    samples = at(np.random.default_rng(3).uniform(given.lower, given.upper, (400, len(given.lower))))
    if not np.isfinite(samples).all():
        return None
    try:
        points = _interpolated(given, at) if smooth else None
        return _boxed(given, samples, smooth=smooth) if points is None else points
    except NotImplementedError:
        return None


def _interpolated(given: Reduced, at: Callable[[Array], Array]) -> Array | None:
    degrees = degrees_of(given.values, given.variables)
    tape = Intervals(given.values, given.variables)
    rules = []
    for i, degree in enumerate(degrees):
        fixed = given.lower[i] == given.upper[i]
        rule = bernstein(given.lower[i], given.upper[i], 0 if fixed else int(degree))
        if degree > DEGREE and not fixed:
            rule = _followed(given, tape, at, i)
        if rule is None:
            return None
        rules.append(rule)
    if np.prod([float(max(rule.matrix.shape)) for rule in rules]) > MOST_POINTS:
        return None
    return combined(at, rules)


def _followed(given: Reduced, tape: Intervals, at: Callable[[Array], Array], i: int) -> Rule | None:
    """Return a rule for a variable in which the expression is no polynomial, of few nodes and little stretch.

    Seen from one variable the expression is a curve in a space of functions; these are sections, in which all other
    variables rest somewhere. The rule has to hold for so many sections that the others are combinations of them.
    """
    lower, upper = given.lower[i], given.upper[i]
    rests = np.random.default_rng(4).uniform(given.lower, given.upper, (3 * MOST_SECTIONS, len(given.lower)))

    def sections(nodes: Array) -> Array:
        points = np.repeat(rests[None], len(nodes), axis=0)
        points[:, :, i] = nodes[:, None]
        return at(points.reshape(-1, rests.shape[1])).reshape(len(nodes), -1)

    samples = sections(bernstein(lower, upper, 3 * MOST_SECTIONS).nodes)
    scale = np.ptp(samples, axis=0)
    moving = np.flatnonzero(scale > 1e-12 * np.abs(samples).max(axis=0))
    free = moving[_free(samples[:, moving] / scale[moving])]
    if len(free) > MOST_SECTIONS:
        return None
    edges, bounds = np.linspace(lower, upper, CUT + 1), np.zeros((DEGREE + 1, len(free)))
    for k, (rest, entry) in enumerate(zip(*np.divmod(free, tape.size), strict=True)):
        low, high = (np.tile(rests[rest], (CUT, 1)) for _ in range(2))
        low[:, i], high[:, i] = edges[:-1], edges[1:]
        bounds[:, k] = derivative_bounds(tape, low, high, i, DEGREE)[:, entry] / scale[free[k]]
    sizes = sorted(product(range(1, DEGREE), (1, 2, 4, 8, 16, 32)), key=lambda c: ((c[0] + 1) * c[1], c[0]))
    for d, q in sizes:
        left = 1e-12 + 2 * ((upper - lower) / q / 4) ** (d + 1) * bounds[d + 1]
        if (d + 1) * q <= len(free) or not (left <= STRETCH).all():
            continue
        nodes, matrix = bernstein(lower, upper, d, q)
        points = matrix @ sections(nodes)[:, free] / scale[free]
        if (stretch := _stretch(points, left)) <= STRETCH:
            matrix = matrix.mean(axis=0) + (1 + stretch) * (matrix - matrix.mean(axis=0))
            return Rule(nodes, matrix[outermost(points)])
    return None


def _stretch(points: Array, left: Array) -> float:
    """Return by how much to stretch the hull of points (k, n) about their mean to hold all that is `left` (n,) away."""
    inner, stretch = points - points.mean(axis=0), 0.0
    equal = np.vstack([np.hstack([inner.T, np.zeros((inner.shape[1], 1))]), [*np.ones(len(inner)), 0.0]])
    cost = np.append(np.zeros(len(inner)), -1.0)
    for k, rest in enumerate(left):
        reached = np.inf
        for sign in (-1.0, 1.0):
            equal[k, -1] = sign
            best = linprog(cost, A_eq=equal, b_eq=[*np.zeros(len(left)), 1.0], bounds=(0, None), method="highs")
            reached = min(reached, -best.fun) if best.status == 0 else 0.0
        equal[k, -1] = 0.0
        stretch += 1.01 * rest / reached if reached > 1e-5 else np.inf  # the program is solved to 1e-7
        if stretch > STRETCH:
            break
    return stretch


def outermost(points: Array) -> np.ndarray:
    """Return which points (k, n) are vertices of their hull, all where that is not quickly found."""
    keep = np.arange(len(points))
    if points.shape[1] == 1:
        keep = np.array([points[:, 0].argmin(), points[:, 0].argmax()])
    elif 2 <= points.shape[1] <= 5 and len(points) > points.shape[1] + 1:
        with suppress(QhullError):
            scaled = (points - points.mean(axis=0)) / np.maximum(np.ptp(points, axis=0), 1e-300)
            hull = ConvexHull(scaled)
            corners = np.vstack([scaled[hull.vertices].T, np.ones(len(hull.vertices))])
            far = (hull.equations[:, :-1] @ scaled.T + hull.equations[:, -1:]).max(axis=0) > -1e-8
            far[hull.vertices] = False  # near a facet: Qhull merges facets, and may have lost some
            lost = [k for k in np.flatnonzero(far) if nnls(corners, np.append(scaled[k], 1.0))[1] > 1e-11]
            keep = np.sort([*hull.vertices, *lost])
    return keep


def _free(flat: Array) -> np.ndarray:
    """Return columns of samples in which the others are affine."""
    found: Any = qr(flat - flat.mean(axis=0), mode="r", pivoting=True)
    sizes, order = np.abs(np.diag(found[0])), found[1]
    return np.sort(order[: int((sizes > 1e-10 * max(sizes[0], 1e-300)).sum())])


def _boxed(given: Reduced, samples: Array, *, smooth: bool) -> Array | None:
    """Return the vertices of a box of entries, in which the others are affine (found at random points)."""
    low, high = Enclosure(given.values, given.variables).over(given.lower, given.upper, boxes=4096)
    if not np.isfinite([low, high]).all():
        return None
    middle = (low + high) / 2
    moving = np.flatnonzero(high - low > 1e-12 * np.maximum(np.abs(middle), 1e-300))
    flat = (samples - middle)[:, moving] / np.maximum((high - low)[moving], 1e-300)
    free, weights = np.arange(len(moving)), np.eye(len(moving))
    if smooth and len(moving):
        lifted = np.hstack([np.ones((len(flat), 1)), flat])
        free = _free(flat)
        weights = np.linalg.lstsq(lifted[:, [0, *(free + 1)]], flat, rcond=None)[0]
    if len(free) > MOST_SIDES:
        return None
    sides = np.indices((2,) * len(free)).reshape(len(free), 2 ** len(free)).T - 0.5
    if smooth and len(moving):
        sides = np.hstack([np.ones((len(sides), 1)), sides])
    points = np.tile(middle, (len(sides), 1))
    points[:, moving] += (sides @ weights) * (high - low)[moving]
    return points
