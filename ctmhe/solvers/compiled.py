"""Gauss-Newton in the compiled core: one call a window, no Python between the iterations."""

from __future__ import annotations

import ctypes
import logging
import time
from collections.abc import Callable
from pathlib import Path
from threading import local
from typing import Any

import numpy as np

from ctmhe.errors import SolverError
from ctmhe.solvers.base import Multipliers, Solution, clip_to_bounds
from ctmhe.solvers.binding import (
    CONVERGED,
    DEADLINE,
    ITERATION_LIMIT,
    NO_DECREASE,
    NOT_FINITE,
    RESULT_ARRAYS,
    SINGULAR,
    Functions,
    Options,
    ResultHeader,
    WindowHeader,
    check_sizes,
    clock_type,
    load,
)
from ctmhe.solvers.codegen import shipped_core, specialised_core
from ctmhe.transcription.problem import Guess, Window
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Outcome

logger = logging.getLogger(__name__)

STOPPED = {ITERATION_LIMIT: Outcome.ITERATION_LIMIT, DEADLINE: Outcome.DEADLINE}

_GUESSED = ("x", "w", "p", "x_active", "w_active", "y_active", "p_active")


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
    deadline : float, optional
        Seconds by `clock` after which no further iteration begins.
    tolerance : float
        Relative predicted decrease of the cost at which a full step is the last.

    Raises
    ------
    SolverError
        When the library is not this version's core or was compiled for another model's sizes.
    """

    name = "compiled Gauss-Newton"

    def __init__(
        self,
        stage: StageFunction,
        library: Path,
        *,
        max_iterations: int = 100,
        deadline: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
        tolerance: float = 1e-9,
    ):
        self.stage, self.library = stage, Path(library)
        self.max_iterations, self.deadline, self.clock, self.tolerance = max_iterations, deadline, clock, tolerance
        self._clock = clock_type(clock)
        self.core = load(self.library)
        check_sizes(self.core, stage, self.library)
        self._local = local()

    def __reduce__(self) -> tuple[Any, ...]:
        options = {key: getattr(self, key) for key in ("max_iterations", "deadline", "clock", "tolerance")}
        return _rebuild, (self.stage, self.library, options)

    def options(self) -> Options:
        """Return what the core is told."""
        clock = ctypes.cast(self._clock, ctypes.c_void_p)
        return Options(self.max_iterations, self.tolerance, self.stage.accuracy, self.deadline or 0.0, clock)

    def solve(self, window: Window, guess: Guess) -> Solution:
        """Return the solution from `guess`; never raises for numerical trouble."""
        memory, n = self._memory(window), len(window.mesh.h)
        memory.write(window, guess, n)
        stop = self.core.ctmhe_solve(*memory.pointers)
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
            STOPPED.get(stop),
        )

    def covariance(self, window: Window, point: Guess) -> tuple[Array, int]:
        """Return the covariance of (x at the window's end, estimated p) and the number of determined directions.

        What `GaussNewton.covariance` returns.
        """
        memory = self._memory(window)
        memory.write(window, point, len(window.mesh.h))
        size = self.stage.nx + self.stage.np * window.p_estimated
        covariance, rank = np.empty((size, size)), ctypes.c_int()
        stage, header, _, result, scratch = memory.pointers
        self.core.ctmhe_covariance(stage, header, result, covariance.ctypes.data, ctypes.addressof(rank), scratch)
        return covariance, rank.value

    def _memory(self, window: Window) -> _Memory:
        """Return this thread's arrays, with room for a window."""
        memory: _Memory | None = getattr(self._local, "memory", None)
        n = len(window.mesh.h)
        if memory is None or memory.capacity < n:
            capacity = max(32, n if memory is None else n + n // 2)
            memory = self._local.memory = _Memory(self.core, self.stage, self.options(), capacity)
        return memory

    def _message(self, stop: int) -> str:
        return {
            CONVERGED: "converged",
            ITERATION_LIMIT: f"no convergence in {self.max_iterations} iterations",
            NO_DECREASE: "no step decreases the merit function",
            DEADLINE: f"no convergence in {self.deadline} s",
            SINGULAR: "no consistent set of active bounds, or a direction without curvature",
        }[stop]


def compiled_solver(
    stage: StageFunction, *, specialise: bool, p_estimated: bool, **limits: Any
) -> CompiledGaussNewton | None:
    """Return the solver in the core, if wished compiled for `stage`; None, with the reason logged, without any."""
    library = (specialised_core(stage, p_estimated) if specialise else None) or shipped_core()
    if library is None:
        logger.info("no compiled core: neither a built one nor a C compiler was found")
        return None
    try:
        return CompiledGaussNewton(stage, library, **limits)
    except (OSError, SolverError) as error:
        logger.warning("the compiled core %s cannot be used: %s", library, error)
        return None


class _Memory:
    """Arrays of one thread for windows of up to `capacity` slots, bound once to the core's structures."""

    def __init__(self, core: ctypes.CDLL, stage: StageFunction, options: Options, capacity: int):
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
        self.window = WindowHeader(**{key: array.ctypes.data for key, array in self.inputs.items()})
        self.result = ResultHeader()
        self._lay_out(capacity)
        self.options = options
        self.functions = Functions(core, stage)
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


def _rebuild(stage: StageFunction, library: Path, options: dict[str, Any]) -> CompiledGaussNewton:
    return CompiledGaussNewton(stage, library, **options)
