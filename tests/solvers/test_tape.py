"""Tapes: what the core makes of CasADi's scalar instructions is what CasADi makes of them."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctmhe.models.library import quadrotor
from ctmhe.solvers import tape as module
from ctmhe.solvers.binding import Function
from ctmhe.solvers.tape import BATCH, OPERATIONS, Tape, tape_of, written_in_c
from ctmhe.transcription import RK4
from ctmhe.transcription.stage import StageFunction
from tests.solvers.test_core import SOURCE, build

ONE = {
    "sqrt": ca.sqrt, "exp": ca.exp, "log": ca.log, "sin": ca.sin, "cos": ca.cos, "tan": ca.tan, "asin": ca.asin,
    "acos": ca.acos, "atan": ca.atan, "sinh": ca.sinh, "cosh": ca.cosh, "tanh": ca.tanh, "asinh": ca.asinh,
    "acosh": ca.acosh, "atanh": ca.atanh, "fabs": ca.fabs, "sign": ca.sign, "floor": ca.floor, "ceil": ca.ceil,
    "erf": ca.erf, "log1p": ca.log1p, "expm1": ca.expm1, "not": ca.logic_not, "neg": lambda a: -a,
    "sq": lambda a: a * a, "twice": lambda a: 2 * a, "inv": lambda a: 1 / a,
    "constpow": lambda a: a**2.7, "constant": lambda a: a - 1.25,
}  # fmt: skip
TWO = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b, "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b, "atan2": ca.atan2, "copysign": ca.copysign, "fmod": ca.fmod, "fmin": ca.fmin,
    "fmax": ca.fmax, "lt": lambda a, b: a < b, "le": lambda a, b: a <= b, "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b, "and": ca.logic_and, "or": ca.logic_or, "if": lambda a, b: ca.if_else(a > 0, b, a),
    "hypot": ca.hypot, "remainder": ca.remainder,
}  # fmt: skip


class _Call(ctypes.Structure):
    _fields_ = [("arg", ctypes.c_void_p * 9), ("res", ctypes.c_void_p * 3), ("t", ctypes.c_double),
                ("h", ctypes.c_double), ("inner", ctypes.c_int)]  # fmt: skip


@pytest.fixture(scope="module", params=["any", "baseline", "compiled"])
def runner(request, tmp_path_factory):
    """Run a function's tape, as it is or written in C, for some slots: rows of results, one array a result."""
    folder, exact = tmp_path_factory.mktemp("tape"), (f"-I{SOURCE.parent}", "-ffp-contract=off", "-fno-math-errno")
    known = {}

    def library_of(function: ca.Function, tape: Tape) -> ctypes.CDLL:
        compiled = request.param == "compiled"
        key = function.name() if compiled else ""
        if key not in known:
            harness = folder / f"harness_{key}.c"
            harness.write_text(
                '#include "tape.h"\n'
                + (written_in_c(tape, "written") if compiled else "")
                + "int run(const ctmhe_function *f, const call *calls, int lanes) "
                + ("{ (void)f; return written(" if compiled else "{ return run_tape(f, ")
                + "calls, lanes); }"
            )
            flags = ("-DCTMHE_BASELINE",) if request.param == "baseline" else ()
            unused = ("-Wno-unused-function",)
            known[key] = ctypes.CDLL(str(build(folder / f"{key}.so", *exact, *flags, *unused, source=harness)))
        return known[key]

    def run(function: ca.Function, arguments: list[np.ndarray]) -> list[np.ndarray]:
        tape, lanes = tape_of(function), len(arguments[0])
        assert tape is not None
        registers = np.full(BATCH * tape.registers + 8, np.nan)
        structure = Function(
            tape=tape.instructions.ctypes.data, constants=tape.constants.ctypes.data,
            registers=-(-registers.ctypes.data // 64) * 64, tape_length=len(tape.instructions),
            sizes=(ctypes.c_int * 3)(*tape.sparse),
        )  # fmt: skip
        rows = [np.ascontiguousarray(array, dtype=float) for array in arguments]
        results = [np.full((lanes, function.nnz_out(i)), np.nan) for i in range(function.n_out())]
        calls = (_Call * lanes)()
        for lane in range(lanes):
            for i, array in enumerate(rows):
                calls[lane].arg[i] = array[lane].ctypes.data
            for i, array in enumerate(results):
                calls[lane].res[i] = array[lane].ctypes.data
        assert library_of(function, tape).run(ctypes.byref(structure), calls, lanes) == 0
        return results

    return run


numbers = st.one_of(st.floats(-5, 5), st.floats(), st.sampled_from([0.0, -0.0, 1.0, np.inf, -np.inf, np.nan]))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rows=st.lists(st.tuples(numbers, numbers), min_size=1, max_size=BATCH))
def test_every_operation_gives_what_casadi_gives(runner, rows):
    """Bit for bit, also of infinities, NaN and signed zeros, in every lane."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    results = [use(a) for use in ONE.values()] + [use(a, b) for use in TWO.values()]
    function = ca.Function("all", [a, b], [ca.densify(ca.vertcat(*results))])
    with np.errstate(all="ignore"):
        expected = np.array([np.asarray(function(*row)).reshape(-1) for row in rows])
        (found,) = runner(function, [np.array(rows)[:, :1], np.array(rows)[:, 1:]])
    for i, name in enumerate([*ONE, *TWO]):
        np.testing.assert_array_equal(found[:, i], expected[:, i], err_msg=name)
        if name in ("fmin", "fmax"):  # of 0 and -0 the C library may take either
            continue
        known = ~np.isnan(expected[:, i])
        np.testing.assert_array_equal(np.signbit(found[known, i]), np.signbit(expected[known, i]), err_msg=name)


def test_every_operation_of_the_core_is_met_by_a_test():
    """The expressions above use all of them."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    results = [use(a) for use in ONE.values()] + [use(a, b) for use in TWO.values()]
    tape = tape_of(ca.Function("all", [a, b], [ca.vertcat(*results)]))
    assert tape is not None
    missing = set(range(len(OPERATIONS))) - set(tape.instructions[:, 0])
    assert {OPERATIONS[i] for i in missing} <= {"ASSIGN"}


def test_a_stage_function_in_lanes_equals_casadi(runner, rng):
    """The quadrotor's step with its Jacobian: 5 slots at once, to the last bit."""
    stage = StageFunction(quadrotor(noise=False), RK4(0.05), signal=True)
    function = stage.derivative
    arguments = [0.1 * rng.normal(size=(5, function.nnz_in(i))) for i in range(function.n_in())]
    found = runner(function, [array if array.size else np.zeros((5, 1)) for array in arguments])
    for lane in range(5):
        expected = function(*(array[lane] for array in arguments))
        for result, value in zip(found, expected, strict=True):
            np.testing.assert_array_equal(result[lane], np.asarray(value).reshape(-1, order="F"))


def test_what_a_tape_cannot_hold_is_left_to_casadi(monkeypatch):
    """Integrators, unknown operations, and functions too large to read."""
    x = ca.SX.sym("x")
    assert tape_of(ca.Function("f", [x], [ca.erfinv(x)])) is None
    y = ca.MX.sym("y")
    assert tape_of(ca.Function("g", [y], [ca.sin(y)])) is None
    monkeypatch.setattr(module, "LARGE", 2)
    assert tape_of(ca.Function("h", [x], [ca.sin(x) + 1])) is None
