"""Where the values of an expression lie on a box: interval arithmetic over its instructions, outward rounded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from scipy.special import erf

from ctmhe.types import Array

Pair = tuple[Array, Array]

ULPS = 2.0**-50
"""Four units in the last place: what NumPy's functions may be off by."""

JUMPS = (
    *(ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_FMOD, ca.OP_COPYSIGN, ca.OP_IF_ELSE_ZERO, ca.OP_LT, ca.OP_LE),
    *(ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT, ca.OP_ATAN2),
)
"""Instructions that jump where their derivative does not say so: no mean-value form."""

TURN = 1e-9
"""An extremum this near an interval counts as inside: widening is safe."""


class Intervals:
    """The instructions of a scalar function of one vector, evaluated on boxes.

    Parameters
    ----------
    expression : SX
        Dense column.
    v : SX
        Its symbols, a column.

    Raises
    ------
    NotImplementedError
        For an instruction without an interval version.
    """

    def __init__(self, expression: Any, v: Any):
        function = ca.Function("f", [v], [ca.densify(expression)])
        self.size, self.steps = expression.numel(), []
        for k in range(function.n_instructions()):
            code, out = function.instruction_id(k), function.instruction_output(k)
            if code == ca.OP_CONST:
                self.steps.append((code, out[0], function.instruction_constant(k), 0))
            elif code == ca.OP_OUTPUT:
                self.steps.append((code, out[1], function.instruction_input(k)[0], 0))
            elif code == ca.OP_INPUT:
                self.steps.append((code, out[0], function.instruction_input(k)[1], 0))
            elif code in UNARY or code in BINARY:
                left, *right = function.instruction_input(k)
                self.steps.append((code, out[0], left, right[0] if right else left))
            else:
                raise NotImplementedError(f"no interval version of CasADi's operation {code}")
        self.registers = function.sz_w()

    def __call__(self, lower: Array, upper: Array) -> Pair:
        """Return bounds (k, size) on boxes with corners `lower` and `upper`, (k, nv) each.

        They are infinite where the expression is not defined on all of a box.
        """
        lower, upper = np.atleast_2d(lower), np.atleast_2d(upper)
        kept: list[Any] = [None] * (self.registers + 1)
        results = np.zeros((2, len(lower), self.size))
        with np.errstate(all="ignore"):
            for code, target, left, right in self.steps:
                if code == ca.OP_CONST:
                    kept[target] = (np.full(len(lower), left),) * 2
                elif code == ca.OP_INPUT:
                    kept[target] = lower[:, left], upper[:, left]
                elif code == ca.OP_OUTPUT:
                    results[:, :, target] = kept[left]
                elif code in UNARY:
                    kept[target] = outward(UNARY[code](*kept[left]))
                elif left == right and code in ALIKE:
                    kept[target] = outward(ALIKE[code](*kept[left]))
                else:
                    kept[target] = outward(BINARY[code](*kept[left], *kept[right]))
        return results[0], results[1]


class Enclosure:
    """Bounds of an expression over a box: on pieces of it, in mean-value form where that is tighter.

    Parameters as of `Intervals`.
    """

    def __init__(self, expression: Any, v: Any):
        expression = ca.densify(expression)
        self.plain = Intervals(expression, v)
        self.entries = v.numel()
        jumps = any(step[0] in JUMPS for step in self.plain.steps)
        slopes = ca.DM.inf(expression.numel(), self.entries) if jumps else ca.jacobian(expression, v)
        self.slopes = Intervals(ca.densify(ca.vec(slopes)), v)

    def on(self, lower: Array, upper: Array) -> tuple[Array, Array, Array]:
        """Return bounds (k, size) on k boxes, and how far a side of the box moves the values, (k, size, nv).

        f(v) = f(c) + f'(v') (v - c) with some v' of the box for each entry.
        """
        lower, upper = np.atleast_2d(lower), np.atleast_2d(upper)
        low, high = self.plain(lower, upper)
        steep = np.stack(self.slopes(lower, upper)).reshape(2, len(lower), self.entries, -1).transpose(0, 1, 3, 2)
        middle = lower + (upper - lower) / 2
        reach = np.maximum(upper - middle, middle - lower)[:, None, :] * (1 + ULPS)
        with np.errstate(invalid="ignore"):
            size = np.nan_to_num(np.abs(steep).max(axis=0) * reach, nan=0.0, posinf=np.inf)
        way = size.sum(axis=2) * (1 + self.entries * ULPS)
        at = self.plain(middle, middle)
        with np.errstate(invalid="ignore"):
            nearer = outward((at[0] - way, at[1] + way))
        return np.fmax(low, nearer[0]), np.fmin(high, nearer[1]), size

    def over(self, lower: Array, upper: Array, *, boxes: int = 1024) -> Pair:
        """Return bounds (size,) over one box, cut into pieces: always across the side that moves the values most."""
        lower, upper = np.atleast_2d(lower), np.atleast_2d(upper)
        low, high, size = self.on(lower, upper)
        while 2 * len(lower) <= boxes:
            with np.errstate(invalid="ignore"):
                width = np.fmax(high.max(axis=0) - low.min(axis=0), 1e-300)
                share = np.nan_to_num(size / width[:, None], nan=1.0, posinf=1e9).max(axis=1)
            share = np.where(upper > lower, share, 0.0)
            if share.max(initial=0.0) <= 1e-12:
                break
            rows, side = np.arange(len(lower)), share.argmax(axis=1)
            middle = (lower + (upper - lower) / 2)[rows, side]
            left, right = upper.copy(), lower.copy()
            left[rows, side], right[rows, side] = middle, middle
            lower, upper = np.vstack([lower, right]), np.vstack([left, upper])
            before = low.min(axis=0), high.max(axis=0)
            low, high, size = self.on(lower, upper)
            low, high = np.fmax(low, before[0]), np.fmin(high, before[1])
        return low.min(axis=0), high.max(axis=0)


def outward(pair: Pair) -> Pair:
    """Widen relatively: zero stays zero, so that roots of squares stay defined."""
    low, high = pair
    low = np.where(np.isnan(low), -np.inf, low - ULPS * np.abs(low))
    high = np.where(np.isnan(high), np.inf, high + ULPS * np.abs(high))
    return low, high


def _rising(function: Callable[[Any], Any]) -> Callable[[Array, Array], Pair]:
    return lambda a, b: (function(a), function(b))


def _falling(function: Callable[[Any], Any]) -> Callable[[Array, Array], Pair]:
    return lambda a, b: (function(b), function(a))


def _defined(function: Callable[[Array, Array], Pair], low: float, high: float = np.inf) -> Any:
    """Return the version that says nothing unless the function is defined on the whole interval."""

    def guarded(a: Array, b: Array) -> Pair:
        inside = (a >= low) & (b <= high)
        first, second = function(np.clip(a, low, high), np.clip(b, low, high))
        return np.where(inside, first, -np.inf), np.where(inside, second, np.inf)

    return guarded


def _times(a: Array, b: Array, c: Array, d: Array) -> Pair:
    products = np.stack([a * c, a * d, b * c, b * d])
    products[np.isnan(products)] = 0.0  # zero times an end that is infinite
    return products.min(axis=0), products.max(axis=0)


def _inverse(a: Array, b: Array) -> Pair:
    whole = (a <= 0) & (b >= 0)
    return np.where(whole, -np.inf, 1 / b), np.where(whole, np.inf, 1 / a)


def _square(a: Array, b: Array) -> Pair:
    return np.where((a <= 0) & (b >= 0), 0.0, np.minimum(a * a, b * b)), np.maximum(a * a, b * b)


def _absolute(a: Array, b: Array) -> Pair:
    return np.where((a <= 0) & (b >= 0), 0.0, np.minimum(np.abs(a), np.abs(b))), np.maximum(np.abs(a), np.abs(b))


def _cosine(a: Array, b: Array) -> Pair:
    """Between its ends unless an extremum lies inside, at a multiple of pi."""
    first, last = np.ceil((a - TURN) / (2 * np.pi)), np.floor((b + TURN) / (2 * np.pi))
    under, over = np.ceil((a - np.pi - TURN) / (2 * np.pi)), np.floor((b - np.pi + TURN) / (2 * np.pi))
    low = np.where(under <= over, -1.0, np.minimum(np.cos(a), np.cos(b)))
    high = np.where(first <= last, 1.0, np.maximum(np.cos(a), np.cos(b)))
    far = np.maximum(np.abs(a), np.abs(b)) > 1e6  # multiples of pi are no longer told apart surely
    return np.where(far, -1.0, low), np.where(far, 1.0, high)


def _sine(a: Array, b: Array) -> Pair:
    low, high = _cosine(a - np.pi / 2, b - np.pi / 2)
    slack = 4 * ULPS * (1 + np.maximum(np.abs(a), np.abs(b)))  # of pi / 2 and of the difference
    return np.maximum(low - slack, -1.0), np.minimum(high + slack, 1.0)


def _tangent(a: Array, b: Array) -> Pair:
    same = np.floor((a + np.pi / 2 - TURN) / np.pi) == np.floor((b + np.pi / 2 + TURN) / np.pi)
    same &= np.maximum(np.abs(a), np.abs(b)) < 1e6
    return np.where(same, np.tan(a), -np.inf), np.where(same, np.tan(b), np.inf)


def _hyperbolic_cosine(a: Array, b: Array) -> Pair:
    low, high = _absolute(a, b)
    return np.cosh(low), np.cosh(high)


def _power(a: Array, b: Array, c: Array, d: Array) -> Pair:
    """Whole exponents for any base, others for positive ones."""
    positive = np.stack([a**c, a**d, b**c, b**d])
    low, high = positive.min(axis=0), positive.max(axis=0)
    low, high = np.where(a > 0, low, -np.inf), np.where(a > 0, high, np.inf)
    whole = (c == d) & (c == np.round(c))
    n = np.where(whole, np.abs(c), 1.0)
    ends = np.stack([a**n, b**n])
    below = np.where((n % 2 == 0) & (a <= 0) & (b >= 0), 0.0, ends.min(axis=0))
    below, above = np.where(n == 0, 1.0, below), ends.max(axis=0)
    if whole.any() and (c < 0).any():
        widened = outward((below, above))
        under = _inverse(*widened)
        below, above = np.where(c < 0, under[0], below), np.where(c < 0, under[1], above)
    low, high = np.where(whole, below, low), np.where(whole, above, high)
    root = ~whole & (c == d) & (c > 0) & (a == 0)
    return np.where(root, 0.0, low), np.where(root, b**c, high)


def _angle(a: Array, b: Array, c: Array, d: Array) -> Pair:
    """atan2(y, x) on a rectangle that the branch cut does not meet lies between its values at the corners."""
    corners = np.stack([np.arctan2(y, x) for y in (a, b) for x in (c, d)])
    clear = (c > 0) | (a > 0) | (b < 0)
    return np.where(clear, corners.min(axis=0), -np.pi), np.where(clear, corners.max(axis=0), np.pi)


def _hypotenuse(a: Array, b: Array, c: Array, d: Array) -> Pair:
    (e, f), (g, h) = _absolute(a, b), _absolute(c, d)
    return np.hypot(e, g), np.hypot(f, h)


def _truth(surely: Any, never: Any) -> Pair:
    return np.where(surely, 1.0, 0.0), np.where(never, 0.0, 1.0)


def _chosen(a: Array, b: Array, c: Array, d: Array) -> Pair:
    """Return the second where the first is not zero, else zero."""
    always, never = (a > 0) | (b < 0), (a == 0) & (b == 0)
    low, high = np.where(always, c, np.minimum(c, 0.0)), np.where(always, d, np.maximum(d, 0.0))
    return np.where(never, 0.0, low), np.where(never, 0.0, high)


def _rest(a: Array, b: Array, c: Array, d: Array) -> Pair:
    size = np.minimum(np.maximum(np.abs(c), np.abs(d)), np.maximum(np.abs(a), np.abs(b)))
    undefined = (c <= 0) & (d >= 0)  # no number for a divisor of zero
    low, high = np.where(a >= 0, 0.0, -size), np.where(b <= 0, 0.0, size)
    return np.where(undefined, -np.inf, low), np.where(undefined, np.inf, high)


def _signed(a: Array, b: Array, c: Array, d: Array) -> Pair:
    low, high = _absolute(a, b)
    return np.where(c > 0, low, -high), np.where(d < 0, -low, high)


UNARY: dict[int, Callable[[Array, Array], Pair]] = {
    ca.OP_ASSIGN: lambda a, b: (a, b),
    ca.OP_LIFT: lambda a, b: (a, b),
    ca.OP_NEG: lambda a, b: (-b, -a),
    ca.OP_TWICE: lambda a, b: (2 * a, 2 * b),
    ca.OP_SQ: _square,
    ca.OP_INV: _inverse,
    ca.OP_FABS: _absolute,
    ca.OP_EXP: _rising(np.exp),
    ca.OP_EXPM1: _rising(np.expm1),
    ca.OP_LOG: _defined(_rising(np.log), 0.0),
    ca.OP_LOG1P: _defined(_rising(np.log1p), -1.0),
    ca.OP_SQRT: _defined(_rising(np.sqrt), 0.0),
    ca.OP_SIN: _sine,
    ca.OP_COS: _cosine,
    ca.OP_TAN: _tangent,
    ca.OP_ASIN: _defined(_rising(np.arcsin), -1.0, 1.0),
    ca.OP_ACOS: _defined(_falling(np.arccos), -1.0, 1.0),
    ca.OP_ATAN: _rising(np.arctan),
    ca.OP_SINH: _rising(np.sinh),
    ca.OP_COSH: _hyperbolic_cosine,
    ca.OP_TANH: _rising(np.tanh),
    ca.OP_ASINH: _rising(np.arcsinh),
    ca.OP_ACOSH: _defined(_rising(np.arccosh), 1.0),
    ca.OP_ATANH: _defined(_rising(np.arctanh), -1.0, 1.0),
    ca.OP_ERF: _rising(erf),
    ca.OP_FLOOR: _rising(np.floor),
    ca.OP_CEIL: _rising(np.ceil),
    ca.OP_SIGN: _rising(np.sign),
    ca.OP_NOT: lambda a, b: _truth((a == 0) & (b == 0), (a > 0) | (b < 0)),
}
"""Bounds [a, b] of an argument -> bounds of the value."""

BINARY: dict[int, Callable[[Array, Array, Array, Array], Pair]] = {
    ca.OP_ADD: lambda a, b, c, d: (a + c, b + d),
    ca.OP_SUB: lambda a, b, c, d: (a - d, b - c),
    ca.OP_MUL: _times,
    ca.OP_DIV: lambda a, b, c, d: _times(a, b, *outward(_inverse(c, d))),
    ca.OP_POW: _power,
    ca.OP_CONSTPOW: _power,
    ca.OP_FMIN: lambda a, b, c, d: (np.minimum(a, c), np.minimum(b, d)),
    ca.OP_FMAX: lambda a, b, c, d: (np.maximum(a, c), np.maximum(b, d)),
    ca.OP_ATAN2: _angle,
    ca.OP_HYPOT: _hypotenuse,
    ca.OP_FMOD: _rest,
    ca.OP_COPYSIGN: _signed,
    ca.OP_LT: lambda a, b, c, d: _truth(b < c, a >= d),
    ca.OP_LE: lambda a, b, c, d: _truth(b <= c, a > d),
    ca.OP_EQ: lambda a, b, c, d: _truth((a == b) & (c == d) & (a == c), (b < c) | (a > d)),
    ca.OP_NE: lambda a, b, c, d: _truth((b < c) | (a > d), (a == b) & (c == d) & (a == c)),
    ca.OP_AND: lambda a, b, c, d: _truth(
        ((a > 0) | (b < 0)) & ((c > 0) | (d < 0)), ((a == 0) & (b == 0)) | ((c == 0) & (d == 0))
    ),
    ca.OP_OR: lambda a, b, c, d: _truth(
        (a > 0) | (b < 0) | (c > 0) | (d < 0), (a == 0) & (b == 0) & (c == 0) & (d == 0)
    ),
    ca.OP_IF_ELSE_ZERO: _chosen,
}
"""Bounds [a, b] and [c, d] of two arguments -> bounds of the value."""

ALIKE: dict[int, Callable[[Array, Array], Pair]] = {
    ca.OP_MUL: _square,
    ca.OP_SUB: lambda a, b: (0 * a, 0 * a),
    ca.OP_ADD: lambda a, b: (2 * a, 2 * b),
}
"""The same for two arguments that are one register."""
