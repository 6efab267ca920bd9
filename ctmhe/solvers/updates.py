"""Whole updates in the compiled core: window and warm start from the logs, and the solve, in one call."""

from __future__ import annotations

import ctypes
from functools import partial
from threading import local
from typing import Any, NamedTuple

import numpy as np

from ctmhe.data.log import Log
from ctmhe.solvers.binding import (
    CONSTANTS,
    CONVERGED,
    REACHED,
    REACHED_AT,
    REQUESTED,
    WRITTEN,
    WRITTEN_AT,
    EstimatorHeader,
    Functions,
    RequestHeader,
    ResultHeader,
    WindowHeader,
)
from ctmhe.solvers.compiled import STOPPED, CompiledGaussNewton
from ctmhe.transcription.assembly import Assembly
from ctmhe.transcription.grid import Mesh, same_time
from ctmhe.transcription.problem import Guess, Window
from ctmhe.transcription.solved import Layout, Solved
from ctmhe.types import Array, Outcome, Status, made

ELSEWHERE, TOO_SMALL = -1, -2
NOTHING = (None, None)  # blocks of no solution
SMALLEST = 64  # slots for which there is room at least


class Update(NamedTuple):
    """What one update gave.

    Attributes
    ----------
    solved : Solved
    path_times, path_rows : array (m,), (m, width)
        What the solution adds to the estimated trajectory; valid until the next update in this thread.
    cost : float
    status : Status
        Solved, or stopped at a limit.
    """

    solved: Solved
    path_times: Array
    path_rows: Array
    cost: float
    status: Status


class CompiledUpdates:
    """Does in one call what `Assembly.window`, the priors, the warm start and the solver do one after the other.

    Windows that need more (weights that are functions of time, correlated weights with sensors missing, a gap longer
    than the horizon), and solves that do not converge, are left to them.
    """

    def __init__(self, solver: CompiledGaussNewton, assembly: Assembly, layout: Layout, *, real_time: bool = False):
        self.solver, self.assembly, self.layout = solver, assembly, layout
        self._outcomes = {CONVERGED: Outcome.SOLVED} | (STOPPED if real_time else {})
        self._local = local()

    @staticmethod
    def covers(assembly: Assembly) -> bool:
        """Return whether an assembly's Q and R are constant and its terminal weight, if any, is diagonal."""
        weights = [weight for weight in (assembly.Q, assembly.R, assembly.R_point, assembly.S) if weight is not None]
        if not all(weight.constant for weight in weights):
            return False
        return assembly.S is None or all(_diagonal(w.root(0.0)) for w in (assembly.S, assembly.R_point, assembly.R))

    def _memory(self, capacity: int = 0) -> _Memory:
        memory: _Memory | None = getattr(self._local, "memory", None)
        if memory is None or memory.capacity < capacity:
            capacity = max(SMALLEST, capacity + capacity // 2)
            memory = self._local.memory = _Memory(self.solver, self.assembly, self.layout, capacity)
        return memory

    def run(
        self,
        span: tuple[float, float],
        growing: bool,
        measurements: Log,
        inputs: Log,
        path: Log,
        last: Solved | None,
        p: Array,
        times: tuple[float, float],
        anchor: tuple[Array, Array | None] | None,
        ticket: object | None = None,
    ) -> Update | None:
        """Return the update of a window, None where the caller's own way has to be taken.

        Parameters
        ----------
        span : (start, end)
            Of the window, seconds.
        growing : bool
            It starts at t0.
        measurements, inputs, path : Log
        last : Solved or None
            The last solution.
        p : array (np,)
            Parameters of the last estimate.
        times : (last, since)
            Time of the last estimate; from when on this one defines the estimated trajectory.
        anchor : (prior (nx + np,), root (n, n) or None), optional
            The prior and the square root of its weight, discount included; that of the cost where the root is None.
            When left out, the prior is the filtering prior (3.18), read from the path.
        ticket : object, optional
            What `prepare` returned. Worth something only in the thread that prepared, and while nothing else was
            solved there; the result is the same without.
        """
        arguments = (span, growing, measurements, inputs, path, last, p, times, anchor)
        memory = self._memory()
        memory.prepared = ticket is not None and ticket is memory.ticket
        memory.ticket = None
        while (stop := memory.call(memory.update, *arguments)) == TOO_SMALL:
            memory = self._memory(memory.request.n)
        outcome = self._outcomes.get(stop)
        return None if outcome is None else memory.found(outcome)

    def prepare(self, *arguments: Any) -> object | None:
        """Linearise and factorise the window that is expected; the arguments are those of `run`.

        Returns
        -------
        object or None
            A ticket for `run`; None where there is nothing to prepare.
        """
        memory = self._memory()
        memory.ticket, memory.prepared = None, False
        while (stop := memory.call(memory.prepare, *arguments)) == TOO_SMALL:
            memory = self._memory(memory.request.n)
        if stop == 0:
            memory.ticket = object()
        return memory.ticket

    def assembled(self, *arguments: Any) -> tuple[Window, Guess] | None:
        """Return copies of the window and the guess that `run` would solve from; None where it would return None."""
        memory = self._memory()
        memory.ticket, memory.prepared = None, False
        while (stop := memory.call(memory.assemble, *arguments)) == TOO_SMALL:
            memory = self._memory(memory.request.n)
        return memory.window_and_guess() if stop == 0 else None


class _Memory:
    """Structures and scratch of one thread, for windows of up to `capacity` slots."""

    def __init__(self, solver: CompiledGaussNewton, assembly: Assembly, layout: Layout, capacity: int):
        self.stage, self.layout, self.assembly, self.capacity = solver.stage, layout, assembly, capacity
        core = solver.core
        self.functions = Functions(core, self.stage)
        self.estimator, self._kept = _estimator(assembly)
        self.request, self.window, self.result = RequestHeader(), WindowHeader(), ResultHeader()
        self.options = solver.options()
        stage = self.functions.structure
        self.scratch = np.empty(core.ctmhe_update_size(ctypes.addressof(stage), capacity) // 8 + 8)
        aligned = -(-self.scratch.ctypes.data // 64) * 64
        parts = layout.parts(capacity)
        self.values, self.active = np.empty(parts["values"][1]), np.empty(parts["active"][1], np.int8)
        width = 2 + 2 * self.stage.nx + self.stage.nw + 2 * self.stage.nu + self.stage.np
        self.path_times, self.path_rows = np.empty(capacity), np.empty((capacity, width))
        self.start, self.p = np.empty(self.stage.nx + self.stage.np), np.empty(self.stage.np)
        width = self.stage.nx + (self.stage.np if assembly.p_estimated else 0)
        self.root = np.empty((width, width))
        self._root = self.root.ctypes.data
        request = self.request
        for name in ("values", "active", "path_times", "path_rows"):
            setattr(request, name, getattr(self, name).ctypes.data)
        self._known = (self.start.ctypes.data, self.p.ctypes.data)
        structures = (stage, self.estimator, request, self.options, self.window, self.result)
        addresses = [ctypes.c_void_p(ctypes.addressof(structure)) for structure in structures]
        room = ctypes.c_void_p(aligned)
        self.update = partial(core.ctmhe_update, *addresses, room)  # assembles and solves what is requested
        self.assemble = partial(core.ctmhe_assemble, *addresses[:3], *addresses[4:], room)
        self.prepare = partial(core.ctmhe_prepare, *addresses[:3], *addresses[4:], room)
        self.ticket: object | None = None  # of what the scratch has been prepared for
        self.prepared = False

    def call(
        self,
        function: Any,
        span: tuple[float, float],
        growing: bool,
        measurements: Log,
        inputs: Log,
        path: Log,
        last: Solved | None,
        p: Array,
        times: tuple[float, float],
        anchor: tuple[Array, Array | None] | None,
    ) -> int:
        """Write the request and call the core."""
        end = span[1]
        y_times, y, y_count = measurements.memory
        if measurements.last_time > end:
            y_count = measurements.count_until(end + same_time(self.assembly.interval, end))
        u_times, u, u_count = inputs.memory
        if inputs.last_time > end:
            u_count = inputs.count_until(end, beyond=int(self.assembly.input_linear))
        path_times, rows, path_count = path.memory
        root = 0
        if anchor is not None:
            self.start[:] = anchor[0]
            if anchor[1] is not None:
                self.root[:], root = anchor[1], self._root
        if self.stage.np:
            self.p[:] = p
        request = self.request
        request.last, request.last_active = NOTHING if last is None else last.blocks
        REQUESTED.pack_into(
            request, 0, *span, *times, growing, self.capacity, y_count, u_count, path_count, last.n if last else 0,
            self.prepared, anchor is not None, y_times, y, u_times, u, path_times, rows, *self._known, root,
        )  # fmt: skip
        return function()

    def found(self, outcome: Outcome) -> Update:
        """Copy the results out."""
        n, added, measured = WRITTEN.unpack_from(self.request, WRITTEN_AT)
        cost, optimality, feasibility, _, iterations, factorizations = REACHED.unpack_from(self.result, REACHED_AT)
        parts = self.layout.parts(n)
        solved = Solved.copied(self.layout, n, self.values[parts["values"][0]], self.active[parts["active"][0]])
        status = {
            "outcome": outcome, "success": outcome is Outcome.SOLVED, "iterations": iterations,
            "optimality": optimality, "feasibility": feasibility, "violation": 0.0, "rungs": (),
            "notes": () if measured else ("no measurement in window",), "factorizations": factorizations,
        }  # fmt: skip
        return Update(solved, self.path_times[:added], self.path_rows[:added], cost, made(Status, status))

    def window_and_guess(self) -> tuple[Window, Guess]:
        """Copy out what was assembled."""
        stage, window, n = self.stage, self.window, self.request.n
        nx, nw, n_p, nu, ny, q = stage.nx, stage.nw, stage.np, stage.nu, stage.ny, stage.q
        width = nx + (n_p if window.p_estimated else 0)
        shapes = {
            "u0": (n, nu), "u1": (n, nu), "prior": (nx + n_p,), "L_prior": (width, width), "L_w": (n, nw, nw),
            "L_y": (n, q, ny, ny), "y_data": (n, q, ny), "x_lower": (n + 1, nx), "x_upper": (n + 1, nx),
            "w_lower": (n, nw), "w_upper": (n, nw), "y_lower": (n, ny), "y_upper": (n, ny), "p_lower": (n_p,),
            "p_upper": (n_p,), "x_scale": (nx,), "w_scale": (nw,), "p_scale": (n_p,), "y_scale": (ny,),
        }  # fmt: skip
        arrays = {key: _copied(getattr(window, key), shape, float) for key, shape in shapes.items()}
        t, h = _copied(window.t, (n + 1,), float), _copied(window.h, (n,), float)
        cell = np.floor((t[:-1] + h / 2) / self.assembly.interval + 1e-9).astype(np.int64)
        mesh = Mesh(t, h, _copied(window.shared, (n,), np.uint8).astype(bool), cell, same_time(1.0, 0.0))
        parts = self.layout.parts(n)
        guess = [
            (self.active if name.endswith("_active") else self.values)[parts[name][0]].reshape(parts[name][1]).copy()
            for name in ("x", "w", "p", "x_active", "w_active", "y_active", "p_active")
        ]
        return Window(mesh=mesh, p_estimated=bool(window.p_estimated), **arrays), Guess(*guess)


def _copied(address: int | None, shape: tuple[int, ...], kind: Any) -> Array:
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    if not size or address is None:
        return np.empty(shape, kind)
    return np.frombuffer(ctypes.string_at(address, size), kind).reshape(shape).copy()


def _diagonal(matrix: Array) -> bool:
    return not (matrix - np.diag(np.diagonal(matrix))).any()


def _estimator(assembly: Assembly) -> tuple[EstimatorHeader, list[np.ndarray]]:
    """Return the structure of an assembly's constants, and the arrays it points to."""
    stage = assembly.stage
    empty = np.empty((0, 0))
    arrays: dict[str, Any] = {
        "held": assembly.held, "linear": assembly.linear, "nodes": stage.nodes, "shares": stage.weights,
        "root_P": empty if callable(assembly.cost.P) else assembly.prior_root(0.0, 0.0, 1.0),
        "root_Q": empty if assembly.Q is None else assembly.Q.root(0.0),
        "root_R": assembly.R.root(0.0), "root_point": assembly.R_point.root(0.0),
        "root_S": empty if assembly.S is None else assembly.S.root(0.0),
    }  # fmt: skip
    for key, (lower, upper) in assembly.boxes.items():
        arrays |= {f"{key}_lower": lower, f"{key}_upper": upper}
    arrays |= {f"{key}_scale": scale for key, scale in assembly.scales.items()}
    header = EstimatorHeader(
        interval=assembly.interval,
        hold_limit=assembly.hold_limit,
        rate=assembly.rate,
        prior_rate=assembly.prior_rate,
        discrete=assembly.discrete,
        filtering=assembly.filtering,
        end_slot=assembly.end_slot,
        input_linear=assembly.input_linear,
        p_estimated=assembly.p_estimated,
        diagonal_R=_diagonal(arrays["root_R"]),
        diagonal_point=_diagonal(arrays["root_point"]),
    )
    kept = []
    for name in CONSTANTS:
        kind = np.uint8 if name in ("held", "linear") else float
        array = np.ascontiguousarray(arrays[name], dtype=kind)
        kept.append(array)
        setattr(header, name, array.ctypes.data if array.size or name != "root_S" else None)
    return header, kept
