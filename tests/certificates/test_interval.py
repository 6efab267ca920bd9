"""Interval arithmetic over instructions of CasADi: no value lies outside."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.interval import BINARY, UNARY, Enclosure, Intervals

settings.register_profile("certificates", deadline=None, max_examples=40)
settings.load_profile("certificates")

ONE = [
    *(ca.sin, ca.cos, ca.tan, ca.exp, ca.log, ca.sqrt, ca.fabs, ca.tanh, ca.sinh, ca.cosh, ca.atan, ca.asin, ca.acos),
    *(ca.expm1, ca.log1p, ca.asinh, ca.acosh, ca.atanh, ca.erf, ca.sign, ca.floor, ca.ceil, ca.logic_not),
    *(lambda a: a**3, lambda a: a**4, lambda a: a**-2, lambda a: a**-3, lambda a: a**0.5, lambda a: a**-1.5),
    *(lambda a: 1 / a, lambda a: -a, lambda a: a + a, lambda a: a - a, lambda a: a * a, lambda a: 2.0**a),
]
TWO = [
    *(ca.plus, ca.minus, ca.times, ca.rdivide, ca.fmin, ca.fmax, ca.atan2, ca.hypot, ca.fmod, ca.power, ca.copysign),
    *(ca.lt, ca.le, ca.eq, ca.ne, ca.logic_and, ca.logic_or, lambda a, b: ca.if_else(a, b, 0)),
]


def expression(draw, v: ca.SX) -> ca.SX:
    """A random expression: a stack of operations on the symbols, constants and what came before."""
    known = [v[i] for i in range(v.numel())] + [ca.SX(draw(st.sampled_from([-2.0, 0.0, 0.5, 1.0, 3.0])))]
    for _ in range(draw(st.integers(1, 8))):
        pick = st.sampled_from(range(len(known)))
        if draw(st.booleans()):
            known.append(draw(st.sampled_from(ONE))(known[draw(pick)]))
        else:
            known.append(draw(st.sampled_from(TWO))(known[draw(pick)], known[draw(pick)]))
    return known[-1]


@given(data=st.data(), seed=st.integers(0, 10**6))
@settings(max_examples=300)
def test_no_value_lies_outside(data, seed):
    """Of random expressions on random boxes, points and degenerate ones included; plain, and cut into pieces."""
    v, rng = ca.SX.sym("v", 2), np.random.default_rng(seed)
    tree = expression(data.draw, v)
    lower = rng.choice([-3.0, -1.0, 0.0, 0.1, 1.0], 2)
    upper = lower + rng.choice([0.0, 1e-6, 0.5, 1.0, 4.0], 2)
    points = np.vstack([lower, upper, rng.uniform(lower, upper, (200, 2)), rng.choice([lower, upper], (20,))])
    values = np.asarray(ca.DM(ca.Function("f", [v], [ca.densify(tree)])(ca.DM(points.T)))).ravel()
    low, high = Intervals(tree, v)(lower, upper)
    inner = Enclosure(tree, v).over(lower, upper, boxes=16)
    values = values[np.isfinite(values)]
    for a, b in ((low[0, 0], high[0, 0]), (inner[0][0], inner[1][0])):
        assert (values >= a).all() and (values <= b).all(), (tree, lower, upper, a, b)


@pytest.mark.parametrize("function", [*ONE, *TWO])
def test_every_instruction_encloses(function):
    """One instruction at a time, on intervals of all signs and lengths."""
    v = ca.SX.sym("v", 2)
    tree = function(v[0]) if function in ONE else function(v[0], v[1])
    ends = np.array([-7.0, -2.0, -1.0, -0.3, 0.0, 0.2, 1.0, 2.0, 9.0])
    boxes = np.array([(a, b, c, d) for a in ends for b in ends[ends >= a] for c in ends for d in ends[ends >= c]])
    low, high = Intervals(tree, v)(boxes[:, [0, 2]], boxes[:, [1, 3]])
    value = ca.Function("f", [v], [ca.densify(tree)])
    for s, r in np.random.default_rng(0).uniform(size=(20, 2)).round(1):
        at = boxes[:, [0, 2]] + (s, r) * (boxes[:, [1, 3]] - boxes[:, [0, 2]])
        at = np.clip(at, boxes[:, [0, 2]], boxes[:, [1, 3]])
        found = np.asarray(ca.DM(value(ca.DM(at.T)))).ravel()
        known = np.isfinite(found)
        assert (low[known, 0] <= found[known]).all() and (found[known] <= high[known, 0]).all()


def test_pieces_and_mean_values_tighten():
    """x - x^2 on [0, 1] is in [0, 1/4]; plain arithmetic says [-1, 1]."""
    v = ca.SX.sym("v", 1)
    tree = v - v**2
    plain = Intervals(tree, v)(np.zeros(1), np.ones(1))
    low, high = Enclosure(tree, v).over(np.zeros(1), np.ones(1), boxes=256)
    assert plain[0] <= -0.99 and plain[1] >= 0.99
    assert -2e-3 <= low[0] <= 0 and 0.25 <= high[0] <= 0.252


def test_what_is_not_defined_is_not_bounded():
    """A logarithm across zero, a division by what may be zero: no bound instead of a wrong one."""
    v = ca.SX.sym("v", 1)
    for tree in (ca.log(v), 1 / v, ca.sqrt(v), ca.tan(v + 1), v**-1.5):
        low, high = Enclosure(tree, v).over(np.array([-1.0]), np.array([1.0]))
        assert np.isinf(low).all() or np.isinf(high).all()


def test_what_has_no_interval_version_is_refused():
    """Not every instruction is known; the inverse error function is not."""
    v = ca.SX.sym("v", 1)
    assert ca.OP_ERFINV not in {**UNARY, **BINARY}
    with pytest.raises(NotImplementedError, match="no interval version"):
        Intervals(ca.erfinv(v), v)
