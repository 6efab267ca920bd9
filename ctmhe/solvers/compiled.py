"""Gauss-Newton in the compiled core: one call a window, no Python between the iterations."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from threading import local
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import SolverError
from ctmhe.solvers.base import Multipliers, Solution, clip_to_bounds
from ctmhe.solvers.codegen import shipped_core, specialised_core
from ctmhe.transcription.problem import Guess, Window
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array

logger = logging.getLogger(__name__)

VERSION = 2
MAX_ARGUMENTS = 64
CONVERGED, ITERATION_LIMIT, NOT_FINITE, NO_DECREASE, SINGULAR = range(5)
STAGE_FUNCTIONS = ("ctmhe_stage_value", "ctmhe_stage_jacobian", "ctmhe_stage_curvature")

_pointer, _int, _double = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
_eval_type = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_get_pointer.restype, _get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


class _Function(ctypes.Structure):
    _fields_ = [
        ("function", _pointer), ("iw", _pointer), ("w", _pointer), ("eval", _pointer), ("self", _pointer),
        ("failed", _pointer), ("arg", _pointer * 9), ("res", _pointer * 3),
    ]  # fmt: skip


class _Stage(ctypes.Structure):
    _fields_ = [
        *((name, _int) for name in ("nx", "nw", "np", "nu", "ny", "q", "symbolic")),
        *((name, _Function) for name in ("value", "jacobian", "curvature")),
    ]


WINDOW_ARRAYS = (
    "t", "h", "shared", "u0", "u1", "prior", "L_prior", "L_w", "L_y", "y_data", "x_lower", "x_upper", "w_lower",
    "w_upper", "y_lower", "y_upper", "p_lower", "p_upper", "x_scale", "w_scale", "p_scale", "y_scale",
)  # fmt: skip
RESULT_ARRAYS = (
    "x", "w", "p", "x_active", "w_active", "y_active", "p_active", "y", "dynamics_multiplier", "x_multiplier",
    "w_multiplier", "y_multiplier", "p_multiplier",
)  # fmt: skip


class _Window(ctypes.Structure):
    _fields_ = [
        *((name, _int) for name in ("n", "p_estimated", "output_bounded")),
        *((name, _pointer) for name in WINDOW_ARRAYS),
    ]


class _Options(ctypes.Structure):
    _fields_ = [("max_iterations", _int), ("tolerance", _double), ("accuracy", _double)]


class _Result(ctypes.Structure):
    _fields_ = [
        *((name, _pointer) for name in RESULT_ARRAYS),
        *((name, _double) for name in ("cost", "optimality", "feasibility")),
        *((name, _int) for name in ("stop", "iterations", "factorizations")),
    ]


class CompiledGaussNewton:
    """The method of `GaussNewton`, in C.

    Parameters
    ----------
    stage : StageFunction
    library : Path
        The core as a shared library: for any sizes, or compiled together with the stage's functions, which it then
        exports as `ctmhe_stage_value`, `ctmhe_stage_jacobian` and `ctmhe_stage_curvature`; the ones it lacks are
        evaluated by CasADi.
    max_iterations : int
    tolerance : float
        Relative predicted decrease of the cost at which a full step is the last.

    Raises
    ------
    SolverError
        When the library is not this version's core or was compiled for another model's sizes.
    """

    name = "compiled Gauss-Newton"

    def __init__(self, stage: StageFunction, library: Path, *, max_iterations: int = 50, tolerance: float = 1e-11):
        self.stage, self.library = stage, Path(library)
        self.max_iterations, self.tolerance = max_iterations, tolerance
        self._core = _load(self.library)
        _check_sizes(self._core, stage, self.library)
        self._local = local()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self.stage, self.library, self.max_iterations, self.tolerance)

    def solve(self, window: Window, guess: Guess) -> Solution:
        """Return the solution from `guess`; never raises for numerical trouble."""
        memory: _Memory | None = getattr(self._local, "memory", None)
        n = len(window.mesh.h)
        if memory is None or memory.capacity < n:
            capacity = max(32, n if memory is None else n + n // 2)
            memory = self._local.memory = _Memory(self._core, self.stage, capacity)
        memory.write(window, guess, n)
        options = memory.options
        options.max_iterations, options.tolerance = self.max_iterations, self.tolerance
        options.accuracy = self.stage.accuracy
        stop = self._core.ctmhe_solve(*memory.pointers)
        result = memory.result
        if stop == NOT_FINITE:
            y = np.full((n, self.stage.q, self.stage.ny), np.nan)
            message = "the model is not finite at the guess"
            return Solution(clip_to_bounds(window, guess), y, float("inf"), False, message)
        x, w, p, x_active, w_active, y_active, p_active, y, *multipliers = memory.read()
        return Solution(
            Guess(x, w, p, x_active, w_active, y_active, p_active),
            y,
            result.cost,
            stop == CONVERGED,
            self._message(stop),
            result.iterations,
            result.optimality,
            result.feasibility,
            result.factorizations,
            Multipliers(*multipliers),
        )

    def _message(self, stop: int) -> str:
        return {
            CONVERGED: "converged",
            ITERATION_LIMIT: f"no convergence in {self.max_iterations} iterations",
            NO_DECREASE: "no step decreases the merit function",
            SINGULAR: "no consistent set of active bounds, or a direction without curvature",
        }[stop]


def compiled_solver(stage: StageFunction, *, max_iterations: int) -> CompiledGaussNewton | None:
    """Return the solver in the fastest core that can be had for `stage`; None, with the reason logged, without any."""
    library = specialised_core(stage) or shipped_core()
    if library is None:
        logger.info("no compiled core: neither a built one nor a C compiler was found")
        return None
    try:
        return CompiledGaussNewton(stage, library, max_iterations=max_iterations)
    except (OSError, SolverError) as error:
        logger.warning("the compiled core %s cannot be used: %s", library, error)
        return None


class _Memory:
    """Arrays of one thread for windows of up to `capacity` slots, bound once to the core's structures."""

    def __init__(self, core: ctypes.CDLL, stage: StageFunction, capacity: int):
        self.stage, self.capacity = stage, capacity
        nx, nw, n_p, nu, ny, q, n = stage.nx, stage.nw, stage.np, stage.nu, stage.ny, stage.q, capacity
        width = nx + n_p
        shapes: dict[str, tuple[int, ...]] = {
            "t": (n + 1,), "h": (n,), "shared": (n,), "u0": (n, nu), "u1": (n, nu), "prior": (width,),
            "L_prior": (width * width,), "L_w": (n, nw, nw), "L_y": (n, q, ny, ny), "y_data": (n, q, ny),
            "x_lower": (n + 1, nx), "x_upper": (n + 1, nx), "w_lower": (n, nw), "w_upper": (n, nw),
            "y_lower": (n, ny), "y_upper": (n, ny), "p_lower": (n_p,), "p_upper": (n_p,),
            "x_scale": (nx,), "w_scale": (nw,), "p_scale": (n_p,), "y_scale": (ny,),
        }  # fmt: skip
        self.inputs = {key: np.zeros(s, np.uint8 if key == "shared" else float) for key, s in shapes.items()}
        self.window = _Window(**{key: array.ctypes.data for key, array in self.inputs.items()})
        self.result = _Result()
        self._lay_out(capacity)
        self.options = _Options()
        self.functions = _Functions(core, stage)
        structure = self.functions.structure
        self.scratch = np.empty(core.ctmhe_scratch_size(ctypes.addressof(structure), n) // 8 + 8)
        aligned = -(-self.scratch.ctypes.data // 64) * 64
        self.pointers = (
            *(ctypes.addressof(s) for s in (structure, self.window, self.options, self.result)),
            aligned,
        )
        edge, fixed = {"x_lower", "x_upper"}, {"p_lower", "p_upper"}
        per_slot = [key for key in ("L_w", "L_y", "y_data", "w_lower", "w_upper", "y_lower", "y_upper", "u0", "u1")]
        self._rows = [(key, self.inputs[key], key in edge) for key in (*per_slot, *edge) if self.inputs[key].size]
        self._whole = [(key, self.inputs[key]) for key in fixed if self.inputs[key].size]
        self._scales = [(key, self.inputs[key]) for key in ("x_scale", "w_scale", "p_scale", "y_scale")]
        self._known: list[Any] = [None] * 4

    def _lay_out(self, n: int) -> None:
        """Place the results of a window of n slots in two blocks of memory, so that two copies fetch them."""
        stage = self.stage
        x, w, y, p = (n + 1, stage.nx), (n, stage.nw), (n, stage.ny), (stage.np,)
        shapes = (x, w, p, x, w, y, p, (n, stage.q, stage.ny), (n, stage.nx), x, w, y, p)
        used = {float: 0, np.int8: 0}
        self._views: list[tuple[bool, slice, tuple[int, ...]]] = []
        for key, shape in zip(RESULT_ARRAYS, shapes, strict=True):
            kind = np.int8 if key.endswith("active") else float
            start = used[kind]
            used[kind] += int(np.prod(shape))
            self._views.append((kind is np.int8, slice(start, used[kind]), shape))
        self._blocks = [np.zeros(used[kind] + 1, kind) for kind in (float, np.int8)]
        outputs = self._view(self._blocks)
        for key, array in zip(RESULT_ARRAYS, outputs, strict=True):
            setattr(self.result, key, array.ctypes.data)
        self._start = list(zip(_GUESSED, outputs, strict=False))
        self.n = n

    def _view(self, blocks: list[np.ndarray]) -> list[np.ndarray]:
        return [blocks[which][part].reshape(shape) for which, part, shape in self._views]

    def write(self, window: Window, guess: Guess, n: int) -> None:
        """Copy a window and a guess to where the core reads them."""
        mesh, inputs, header = window.mesh, self.inputs, self.window
        header.n, header.p_estimated = n, bool(window.p_estimated and self.stage.np)
        header.output_bounded = window.output_bounded
        inputs["t"][: n + 1] = mesh.t
        inputs["h"][:n] = mesh.h
        inputs["shared"][:n] = mesh.shared
        inputs["prior"][:] = window.prior
        root = window.L_prior
        inputs["L_prior"][: root.size] = root.reshape(-1)
        for key, array, edge in self._rows:
            array[: n + edge] = getattr(window, key)
        for key, array in self._whole:
            array[:] = getattr(window, key)
        for i, (key, array) in enumerate(self._scales):
            scale = getattr(window, key)
            if scale is not self._known[i]:
                array[:] = self._known[i] = scale
        if n != self.n:
            self._lay_out(n)
        for key, array in self._start:
            array[...] = getattr(guess, key)

    def read(self) -> list[Array]:
        """Return copies of the results, in the order of `RESULT_ARRAYS`."""
        return self._view([block.copy() for block in self._blocks])


_GUESSED = ("x", "w", "p", "x_active", "w_active", "y_active", "p_active")


class _Functions:
    """The stage's functions as the core calls them, with their memory."""

    def __init__(self, core: ctypes.CDLL, stage: StageFunction):
        self.kept: list[Any] = []
        functions = [group[1] for group in stage.mapped]
        structures = []
        for name, function in zip(STAGE_FUNCTIONS, functions, strict=False):
            exported = getattr(core, name, None)
            structures.append(self._virtual(stage, function) if exported is None else self._compiled(core, name))
        self.structure = _Stage(
            stage.nx, stage.nw, stage.np, stage.nu, stage.ny, stage.q, bool(stage.symbolic), *structures
        )

    def _compiled(self, core: ctypes.CDLL, name: str) -> _Function:
        sizes = (ctypes.c_longlong * 4)()
        getattr(core, f"{name}_work")(*(ctypes.byref(sizes, 8 * i) for i in range(4)))
        if max(sizes[0], sizes[1]) > MAX_ARGUMENTS:
            raise SolverError(
                f"the compiled function {name} needs {max(sizes[0], sizes[1])} pointers; rebuild the core"
            )
        iw, w = np.zeros(sizes[2] + 1, np.int64), np.zeros(sizes[3] + 1)
        self.kept += [iw, w]
        address = ctypes.cast(getattr(core, name), ctypes.c_void_p).value
        return _Function(function=address, iw=iw.ctypes.data, w=w.ctypes.data)

    def _virtual(self, stage: StageFunction, function: ca.Function) -> _Function:
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
        structure = _Function(
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


def _load(library: Path) -> ctypes.CDLL:
    core = ctypes.CDLL(str(library))
    core.ctmhe_scratch_size.argtypes, core.ctmhe_scratch_size.restype = [_pointer, _int], ctypes.c_size_t
    core.ctmhe_solve.argtypes, core.ctmhe_solve.restype = [_pointer] * 5, _int
    core.ctmhe_sizes.argtypes, core.ctmhe_sizes.restype = [_pointer] * 6, None
    return core


def _check_sizes(core: ctypes.CDLL, stage: StageFunction, library: Path) -> None:
    values = (_int * 6)()
    core.ctmhe_sizes(*(ctypes.addressof(values) + 4 * i for i in range(6)))
    *sizes, version = values
    if version != VERSION:
        raise SolverError(f"{library} is version {version} of the core, not {VERSION}; rebuild it")
    wanted = [stage.nx, stage.nw, stage.np, stage.ny, stage.q]
    if any(sizes) and sizes != wanted:
        raise SolverError(f"{library} was compiled for nx, nw, np, ny, q = {sizes}, the model has {wanted}; rebuild it")


def _rebuild(stage: StageFunction, library: Path, max_iterations: int, tolerance: float) -> CompiledGaussNewton:
    return CompiledGaussNewton(stage, library, max_iterations=max_iterations, tolerance=tolerance)
