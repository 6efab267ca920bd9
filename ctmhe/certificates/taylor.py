"""Bounds of higher derivatives on boxes: Taylor coefficients in one variable, as intervals, instruction by instruction.

A series is a list of intervals c_0, c_1, ... with c_n = f^(n) / n!; None stands for zero. The recursions are those of
automatic differentiation, from derivatives of the functions: exp(a)' = a' exp(a), log(a)' = a' / a, and so on. Symbolic
derivatives of the same order would be thousands of times as long.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ctmhe.certificates.interval import BINARY, UNARY, Intervals, Pair, outward
from ctmhe.types import Array

Series = list[Any]


def derivative_bounds(tape: Intervals, lower: Array, upper: Array, index: int, order: int) -> Array:
    """Return max |f^(n)| / n! over boxes (k, nv) in entry `index`, for n = 0 .. order: (order + 1, size).

    Raises
    ------
    NotImplementedError
        Where an instruction that is not analytic acts on that entry.
    """
    count, top = len(lower), order + 1
    kept: list[Series] = [[] for _ in range(tape.registers + 1)]
    found = np.zeros((top, tape.size))
    with np.errstate(all="ignore"):
        for code, target, left, right in tape.steps:
            if code == ca.OP_CONST:
                kept[target] = [(np.full(count, float(left)),) * 2] + [None] * order
            elif code == ca.OP_INPUT:
                one = (np.ones(count),) * 2 if left == index and order else None
                kept[target] = [(lower[:, left], upper[:, left]), one] + [None] * (order - 1)
                kept[target] = kept[target][:top]
            elif code == ca.OP_OUTPUT:
                found[:, target] = [0.0 if c is None else np.abs(c).max() for c in kept[left]]
            else:
                kept[target] = _applied(code, kept[left], kept[right])
    return np.where(np.isnan(found), np.inf, found)


def _applied(code: int, a: Series, b: Series) -> Series:
    still = all(c is None for c in (*a[1:], *(b[1:] if code in BINARY else ())))  # a constant in this variable
    if code in LINEAR:
        return LINEAR[code](a, b)
    if still:
        bounds: Any = UNARY.get(code) or BINARY[code]
        return [outward(bounds(*a[0]) if code in UNARY else bounds(*a[0], *b[0])), *[None] * (len(a) - 1)]
    if code in ANALYTIC:
        return ANALYTIC[code](a, b)
    raise NotImplementedError(f"no Taylor series of CasADi's operation {code}")


def _add(x: Pair | None, y: Pair | None) -> Pair | None:
    return y if x is None else x if y is None else outward(BINARY[ca.OP_ADD](*x, *y))


def _times(x: Pair | None, y: Pair | None) -> Pair | None:
    return None if x is None or y is None else outward(BINARY[ca.OP_MUL](*x, *y))


def _over(x: Pair | None, y: Pair) -> Pair | None:
    return None if x is None else outward(BINARY[ca.OP_DIV](*x, *y))


def _scaled(x: Pair | None, factor: float) -> Pair | None:
    """Return `factor` times an interval; thirds and the like are not exact, hence the widening."""
    if x is None or factor == 0:
        return None
    low, high = x if factor > 0 else (x[1], x[0])
    return outward(outward((low * factor, high * factor)))


def _sum(terms: Any) -> Pair | None:
    total = None
    for term in terms:
        total = _add(total, term)
    return total


def _product(a: Series, b: Series) -> Series:
    made = [_sum(_times(a[i], b[n - i]) for i in range(n + 1)) for n in range(len(a))]
    if a is b:
        made[0] = outward(UNARY[ca.OP_SQ](*a[0]))
    return made


def _quotient(a: Series, b: Series) -> Series:
    made: Series = []
    for n in range(len(a)):
        known = _sum(_times(b[i], made[n - i]) for i in range(1, n + 1))
        made.append(_over(_add(a[n], _scaled(known, -1.0)), b[0]))
    return made


def _constant(value: float, like: Series) -> Series:
    return [(np.full(len(like[0][0]), value),) * 2, *[None] * (len(like) - 1)]


def _plus(value: float, a: Series, sign: float = 1.0) -> Series:
    """Return value + sign a."""
    scaled = [_scaled(c, sign) for c in a]
    return [_add(_constant(value, a)[0], scaled[0]), *scaled[1:]]


def _follows(first: Pair, a: Series, made: Series, factor: Series, sign: float = 1.0) -> None:
    """Append to `made` the next coefficient of g with g' = sign a' `factor`."""
    n = len(made)
    if n == 0:
        made.append(first)
    else:
        made.append(_scaled(_sum(_scaled(_times(a[i], factor[n - i]), float(i)) for i in range(1, n + 1)), sign / n))


def _exponential(a: Series, _: Series | None = None) -> Series:
    made: Series = []
    for _n in a:
        _follows(outward(UNARY[ca.OP_EXP](*a[0])), a, made, made)
    return made


def _pair(a: Series, first: int, second: int, sign: float) -> tuple[Series, Series]:
    """Return g and h with g' = a' h and h' = sign a' g: sine and cosine, hyperbolic or not."""
    g: Series = []
    h: Series = []
    for _n in a:
        ahead = list(g)
        _follows(outward(UNARY[first](*a[0])), a, g, h)
        _follows(outward(UNARY[second](*a[0])), a, h, ahead, sign)
    return g, h


def _saturating(code: int, sign: float) -> Any:
    """Return g with g' = a' (1 + sign g^2): the tangent, hyperbolic or not."""

    def series(a: Series, _: Series) -> Series:
        made: Series = []
        factor: Series = []
        for n in range(len(a)):
            _follows(outward(UNARY[code](*a[0])), a, made, factor)
            square = _sum(_times(made[i], made[n - i]) for i in range(n + 1))
            if n == 0:
                square = outward(UNARY[ca.OP_SQ](*made[0]))
            square = _scaled(square, sign)
            factor.append(_add((np.ones_like(a[0][0]),) * 2, square) if n == 0 else square)
        return made

    return series


def _integral(code: int, slope: Any) -> Any:
    """Return g with g' = a' / slope(a)."""

    def series(a: Series, _: Series) -> Series:
        q = slope(a)
        made: Series = [outward(UNARY[code](*a[0]))]
        for n in range(1, len(a)):
            known = _sum(_scaled(_times(made[i], q[n - i]), i / n) for i in range(1, n))
            made.append(_over(_add(a[n], _scaled(known, -1.0)), q[0]))
        return made

    return series


def _power(a: Series, exponent: float) -> Series:
    """Return a^r: whole powers by products, others by a g' = r a' g."""
    if exponent == round(exponent) and abs(exponent) <= 16:
        whole = _constant(1.0, a)
        for _n in range(int(abs(exponent)) // 2):
            whole = _product(whole, _product(a, a))
        whole = _product(whole, a) if int(abs(exponent)) % 2 else whole
        return _quotient(_constant(1.0, a), whole) if exponent < 0 else whole
    ends = (np.full_like(a[0][0], exponent),) * 2
    made: Series = [outward(BINARY[ca.OP_POW](*a[0], *ends))]
    for n in range(1, len(a)):
        terms = (_scaled(_times(a[i], made[n - i]), (exponent * i - (n - i)) / n) for i in range(1, n + 1))
        made.append(_over(_sum(terms), a[0]))
    return made


def _raised(a: Series, b: Series) -> Series:
    still = all(c is None for c in b[1:]) and (b[0][0] == b[0][0][0]).all() and (b[0][0] == b[0][1]).all()
    return _power(a, float(b[0][0][0])) if still else _exponential(_product(b, ANALYTIC[ca.OP_LOG](a, a)))


LINEAR: dict[int, Any] = {
    ca.OP_ASSIGN: lambda a, b: a,
    ca.OP_LIFT: lambda a, b: a,
    ca.OP_NEG: lambda a, b: [_scaled(c, -1.0) for c in a],
    ca.OP_TWICE: lambda a, b: [_scaled(c, 2.0) for c in a],
    ca.OP_ADD: lambda a, b: [_add(c, d) for c, d in zip(a, b, strict=True)],
    ca.OP_SUB: lambda a, b: [_add(c, _scaled(d, -1.0)) for c, d in zip(a, b, strict=True)],
    ca.OP_MUL: _product,
}

ANALYTIC: dict[int, Any] = {
    ca.OP_SQ: lambda a, b: _product(a, a),
    ca.OP_INV: lambda a, b: _quotient(_constant(1.0, a), a),
    ca.OP_DIV: _quotient,
    ca.OP_EXP: _exponential,
    ca.OP_EXPM1: lambda a, b: _plus(-1.0, _exponential(a)),
    ca.OP_LOG: _integral(ca.OP_LOG, lambda a: a),
    ca.OP_LOG1P: _integral(ca.OP_LOG1P, lambda a: _plus(1.0, a)),
    ca.OP_SQRT: lambda a, b: _power(a, 0.5),
    ca.OP_SIN: lambda a, b: _pair(a, ca.OP_SIN, ca.OP_COS, -1.0)[0],
    ca.OP_COS: lambda a, b: _pair(a, ca.OP_SIN, ca.OP_COS, -1.0)[1],
    ca.OP_SINH: lambda a, b: _pair(a, ca.OP_SINH, ca.OP_COSH, 1.0)[0],
    ca.OP_COSH: lambda a, b: _pair(a, ca.OP_SINH, ca.OP_COSH, 1.0)[1],
    ca.OP_TAN: _saturating(ca.OP_TAN, 1.0),
    ca.OP_TANH: _saturating(ca.OP_TANH, -1.0),
    ca.OP_ATAN: _integral(ca.OP_ATAN, lambda a: _plus(1.0, _product(a, a))),
    ca.OP_ASIN: _integral(ca.OP_ASIN, lambda a: _power(_plus(1.0, _product(a, a), -1.0), 0.5)),
    ca.OP_ASINH: _integral(ca.OP_ASINH, lambda a: _power(_plus(1.0, _product(a, a)), 0.5)),
    ca.OP_ATANH: _integral(ca.OP_ATANH, lambda a: _plus(1.0, _product(a, a), -1.0)),
    ca.OP_POW: _raised,
    ca.OP_CONSTPOW: _raised,
}
"""Series of an analytic instruction's arguments -> its own."""
