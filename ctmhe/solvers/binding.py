"""The core as ctypes sees it: the structures of core.h, the model's functions, loading and checking a library."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from pathlib import Path
from struct import Struct
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import SolverError
from ctmhe.solvers.tape import BATCH, tape_of
from ctmhe.transcription.stage import StageFunction

VERSION = 9
MAX_ARGUMENTS = 64
CONVERGED, ITERATION_LIMIT, NOT_FINITE, NO_DECREASE, SINGULAR, DEADLINE = range(6)
METHODS = {"step map": 0, "RK4": 1}
STAGE_FUNCTIONS = ("ctmhe_stage_value", "ctmhe_stage_jacobian", "ctmhe_stage_curvature")

_pointer, _int, _double = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
clock_type = ctypes.CFUNCTYPE(_double)
_eval_type = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_get_pointer.restype, _get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


class Function(ctypes.Structure):
    """A stage function and its memory."""

    _fields_ = [
        *((name, _pointer) for name in ("batch", "function", "iw", "w", "tape", "constants", "registers")),
        ("tape_length", _int), ("sizes", _int * 3),
        ("evaluate", _pointer), ("model", _pointer), ("work", _pointer), ("input", _pointer), ("method", _int),
        ("eval", _pointer), ("self", _pointer), ("failed", _pointer),
        ("arg", _pointer * 9), ("res", _pointer * 3),
    ]  # fmt: skip


class Stage(ctypes.Structure):
    """The model's functions and sizes."""

    _fields_ = [
        *((name, _int) for name in ("nx", "nw", "np", "nu", "ny", "q", "steps")),
        ("step_length", _double),
        ("symbolic", _int),
        *((name, Function) for name in ("value", "jacobian", "curvature")),
    ]


WINDOW_ARRAYS = (
    "t", "h", "shared", "u0", "u1", "prior", "L_prior", "L_w", "L_y", "y_data", "x_lower", "x_upper", "w_lower",
    "w_upper", "y_lower", "y_upper", "p_lower", "p_upper", "x_scale", "w_scale", "p_scale", "y_scale",
)  # fmt: skip
RESULT_ARRAYS = (
    "x", "w", "p", "x_active", "w_active", "y_active", "p_active", "y", "dynamics_multiplier", "x_multiplier",
    "w_multiplier", "y_multiplier", "p_multiplier",
)  # fmt: skip


class WindowHeader(ctypes.Structure):
    """One window's arrays."""

    _fields_ = [
        *((name, _int) for name in ("n", "p_estimated", "output_bounded")),
        *((name, _pointer) for name in WINDOW_ARRAYS),
    ]


class Options(ctypes.Structure):
    """What the solver is told."""

    _fields_ = [
        *(("max_iterations", _int), ("tolerance", _double), ("accuracy", _double)),
        *(("seconds", _double), ("clock", _pointer)),
    ]


class ResultHeader(ctypes.Structure):
    """Guess in, solution out."""

    _fields_ = [
        *((name, _pointer) for name in RESULT_ARRAYS),
        *((name, _double) for name in ("cost", "optimality", "feasibility")),
        *((name, _int) for name in ("stop", "iterations", "factorizations")),
    ]


NUMBERS = ("interval", "hold_limit", "rate", "prior_rate")
SWITCHES = ("discrete", "filtering", "end_slot", "input_linear", "p_estimated", "diagonal_R", "diagonal_point")
CONSTANTS = (
    "held", "linear", "nodes", "shares", "root_P", "root_Q", "root_R", "root_point", "root_S", "x_lower", "x_upper",
    "w_lower", "w_upper", "y_lower", "y_upper", "residual_lower", "residual_upper", "p_lower", "p_upper", "x_scale",
    "w_scale", "p_scale", "y_scale",
)  # fmt: skip


class EstimatorHeader(ctypes.Structure):
    """What does not change from update to update."""

    _fields_ = [
        *((name, _double) for name in NUMBERS),
        *((name, _int) for name in SWITCHES),
        *((name, _pointer) for name in CONSTANTS),
    ]


class RequestHeader(ctypes.Structure):
    """One update: what is known, and where the results go."""

    _fields_ = [
        *((name, _double) for name in ("start", "end", "last_end", "since")),
        *(
            (name, _int)
            for name in (
                "growing", "capacity", "y_count", "u_count", "path_count", "last_n", "prepared", "anchored",
            )
        ),
        *(
            (name, _pointer)
            for name in (
                "y_t", "y", "u_t", "u", "path_t", "path", "prior", "p", "root_prior",
            )
        ),
        *((name, ctypes.c_char_p) for name in ("last", "last_active")),
        *((name, _pointer) for name in ("values", "active", "path_times", "path_rows")),
        *((name, _int) for name in ("n", "path_added", "measured")),
    ]  # fmt: skip


# One call for the fields that change from update to update: a field of a structure costs as much as five of them here.
REQUESTED = Struct("4d 8i 9P")  # the request from `start` to `root_prior`
WRITTEN, WRITTEN_AT = Struct("3i"), RequestHeader.n.offset  # the request from `n` on
REACHED, REACHED_AT = Struct("3d 3i"), ResultHeader.cost.offset  # the result from `cost` on


class Functions:
    """The stage's functions as the core calls them, with their memory."""

    def __init__(self, core: ctypes.CDLL, stage: StageFunction):
        self.kept: list[Any] = []
        functions = [] if stage.method is not None else [group[1] for group in stage.mapped]
        structures = [self._own(stage)] * 2 if stage.method is not None else []
        for name, function in zip(STAGE_FUNCTIONS, functions, strict=False):
            batch = getattr(core, name.replace("_stage_", "_batch_"), None)
            if batch is not None:
                structures.append(Function(batch=ctypes.cast(batch, ctypes.c_void_p).value))
            elif getattr(core, name, None) is not None:
                structures.append(self._compiled(core, name))
            else:
                # second derivatives are asked for slot by slot: a tape, slow to read, would be no faster than CasADi
                alone = name == "ctmhe_stage_curvature" and _casadi_eval() is not None
                structures.append((None if alone else self._taped(function)) or self._virtual(stage, function))
        sizes = (stage.nx, stage.nw, stage.np, stage.nu, stage.ny, stage.q, stage.steps)
        self.structure = Stage(*sizes, stage.step_length, bool(stage.symbolic), *structures)

    def _own(self, stage: StageFunction) -> Function:
        evaluator = stage.model.evaluator()  # pyright: ignore
        nx, ny, n = stage.nx, stage.ny, stage.nx + stage.nw + stage.np
        work = np.zeros(3 * nx + 2 * (nx + ny) * n + 2 * nx * n)  # see core/own.h
        u = np.zeros(stage.nu + 1)
        self.kept += [evaluator, work, u]
        addresses = {"work": work.ctypes.data, "input": u.ctypes.data, "method": METHODS[stage.method or ""]}
        return Function(evaluate=evaluator.address, model=evaluator.pointer, **addresses)

    def _compiled(self, core: ctypes.CDLL, name: str) -> Function:
        sizes = (ctypes.c_longlong * 4)()
        getattr(core, f"{name}_work")(*(ctypes.byref(sizes, 8 * i) for i in range(4)))
        if max(sizes[0], sizes[1]) > MAX_ARGUMENTS:
            raise SolverError(
                f"the compiled function {name} needs {max(sizes[0], sizes[1])} pointers; rebuild the core"
            )
        iw, w = np.zeros(sizes[2] + 1, np.int64), np.zeros(sizes[3] + 1)
        self.kept += [iw, w]
        address = ctypes.cast(getattr(core, name), ctypes.c_void_p).value
        return Function(function=address, iw=iw.ctypes.data, w=w.ctypes.data)

    def _taped(self, function: ca.Function) -> Function | None:
        tape = tape_of(function)
        if tape is None:
            return None
        registers = np.zeros(BATCH * tape.registers + 8)
        self.kept += [tape, registers]
        return Function(
            tape=tape.instructions.ctypes.data,
            constants=tape.constants.ctypes.data,
            registers=-(-registers.ctypes.data // 64) * 64,
            tape_length=len(tape.instructions),
            sizes=(_int * 3)(*tape.sparse),
        )

    def _virtual(self, stage: StageFunction, function: ca.Function) -> Function:
        inputs = [np.zeros(max(function.nnz_in(i), 1)) for i in range(function.n_in())]
        outputs = [np.zeros(max(function.nnz_out(i), 1)) for i in range(function.n_out())]
        buffer, trigger = function.buffer()
        for i, array in enumerate(inputs):
            if function.nnz_in(i):
                buffer.set_arg(i, memoryview(array))  # pyright: ignore
        for i, array in enumerate(outputs):
            if function.nnz_out(i):
                buffer.set_res(i, memoryview(array))  # pyright: ignore
        self.kept += [inputs, outputs, buffer, trigger]
        structure = Function(
            arg=(_pointer * 9)(*(array.ctypes.data for array in inputs)),
            res=(_pointer * 3)(*(array.ctypes.data for array in outputs)),
        )
        direct = _casadi_eval()
        if stage.symbolic and direct is not None:  # expressions cannot fail: call CasADi directly
            structure.eval = direct
            structure.self = _get_pointer(buffer._self(), None)  # pyright: ignore
        else:  # an integrator or an FMU raises, which must not pass through C
            failed = np.zeros(1, np.int32)
            callback = _eval_type(_guarded(trigger, buffer, failed))
            self.kept += [failed, callback]
            structure.failed = failed.ctypes.data
            structure.eval = ctypes.cast(callback, ctypes.c_void_p).value
        return structure


@cache
def _casadi_eval() -> int | None:
    """Return the address of CasADi's `_function_buffer_eval(void*)`, or None where its name is another."""
    folder = Path(ca.__file__).parent  # the extension module first: its handle finds the library it is linked to
    for path in (*folder.glob("_casadi.*"), *folder.glob("libcasadi.*")):
        try:
            function = ctypes.CDLL(str(path))["_ZN6casadi21_function_buffer_evalEPv"]
        except (OSError, AttributeError):
            continue
        return ctypes.cast(function, ctypes.c_void_p).value
    return None


def _guarded(trigger: Callable[[], None], buffer: Any, failed: np.ndarray) -> Callable[[Any], None]:
    def run(_: Any) -> None:
        try:
            trigger()
            failed[0] = buffer.ret() != 0
        except Exception:
            failed[0] = 1

    return run


def load(library: Path) -> ctypes.CDLL:
    """Load a core and declare its functions."""
    core = ctypes.CDLL(str(library))
    core.ctmhe_scratch_size.argtypes, core.ctmhe_scratch_size.restype = [_pointer, _int], ctypes.c_size_t
    core.ctmhe_solve.argtypes, core.ctmhe_solve.restype = [_pointer] * 5, _int
    core.ctmhe_update_size.argtypes, core.ctmhe_update_size.restype = [_pointer, _int], ctypes.c_size_t
    core.ctmhe_assemble.argtypes, core.ctmhe_assemble.restype = [_pointer] * 6, _int
    core.ctmhe_prepare.argtypes, core.ctmhe_prepare.restype = [_pointer] * 6, _int
    core.ctmhe_update.argtypes, core.ctmhe_update.restype = [_pointer] * 7, _int
    core.ctmhe_covariance.argtypes, core.ctmhe_covariance.restype = [_pointer] * 6, _int
    core.ctmhe_sizes.argtypes, core.ctmhe_sizes.restype = [_pointer] * 6, None
    return core


def check_sizes(core: ctypes.CDLL, stage: StageFunction, library: Path) -> None:
    """Raise `SolverError` unless a library is this version's core, for any sizes or for those of the model."""
    values = (_int * 6)()
    core.ctmhe_sizes(*(ctypes.addressof(values) + 4 * i for i in range(6)))
    *sizes, version = values
    if version != VERSION:
        raise SolverError(f"{library} is version {version} of the core, not {VERSION}; rebuild it")
    wanted = [stage.nx, stage.nw, stage.np, stage.ny, stage.q]
    if any(sizes) and sizes != wanted:
        raise SolverError(f"{library} was compiled for nx, nw, np, ny, q = {sizes}, the model has {wanted}; rebuild it")
