"""The stage function: one slot's step, outputs and Jacobians. The only thing that is ever compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import local
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.models.continuous import Model
from ctmhe.transcription.integrators import Integrator
from ctmhe.types import Array

CHUNKS = (32, 8, 1)  # any number of slots is evaluated by functions mapped over these sizes


@dataclass(frozen=True, eq=False)
class Linearization:
    """All slots of a window at once.

    Attributes
    ----------
    x_next : array (N, nx)
    y : array (N, q, ny)
        Outputs at the quadrature nodes, then at the slot's end.
    jacobian : array (N, nx + q ny, nx + nw + np)
        d(x_next, y) / d(x, w, p).
    """

    x_next: Array
    y: Array
    jacobian: Array


class StageFunction:
    """x_next, y and their Jacobians over slots whose times, lengths and inputs are data.

    Built once per model and integrator; any number of slots is evaluated by the same CasADi function, mapped over
    chunks. Scratch memory is per thread.

    Attributes
    ----------
    nodes, weights : array (q - 1,)
        Quadrature of a slot (empty unless `signal`); the end follows as the last of the q outputs.
    accuracy : float
        Relative accuracy of an evaluation.
    value, derivative : casadi.Function
        (t, h, x, w, p, u0, u1) -> (x_next, vec y), and the same with the Jacobian as a third result.
    symbolic : bool
        The functions are expanded scalar expressions: exact second derivatives are at hand.
    """

    def __init__(self, model: Model, integrator: Integrator, *, signal: bool):
        self.nx, self.nw, self.np, self.nu, self.ny = (len(getattr(model, key)) for key in "xwpuy")
        self.nodes = integrator.nodes if signal else np.empty(0)
        self.weights = integrator.weights if signal else np.empty(0)
        self.accuracy = integrator.accuracy
        slot = integrator.trace(model, signal)
        self.q = slot.size2_out(1)
        symbolic = slot.is_a("SXFunction")
        kind: Any = ca.SX if symbolic else ca.MX
        symbols = [kind.sym(slot.name_in(i), slot.size1_in(i)) for i in range(slot.n_in())]
        x_next, y = slot(*symbols)
        x_next, y = ca.densify(x_next), ca.densify(ca.vec(y))
        jacobian = ca.densify(ca.jacobian(ca.vertcat(x_next, y), ca.vertcat(*symbols[2:5])))
        self.value = ca.Function("stage", symbols, [x_next, y])
        self.derivative = ca.Function("stage_jacobian", symbols, [x_next, y, jacobian])
        self.symbolic = symbolic
        functions = [self.value, self.derivative]
        if symbolic:  # second derivatives of dot(lambda_x, x_next) + dot(lambda_y, y)
            duals = [kind.sym("lambda_x", self.nx), kind.sym("lambda_y", self.q * self.ny)]
            lagrangian = ca.dot(duals[0], x_next) + ca.dot(duals[1], y)
            hessian, _ = ca.hessian(lagrangian, ca.vertcat(*symbols[2:5]))
            functions.append(ca.Function("stage_curvature", symbols + duals, [ca.densify(hessian)]))
        self.mapped = [{size: function.map(size) for size in CHUNKS} for function in functions]
        self._local = local()

    def _scratch(self) -> _Scratch:
        scratch = getattr(self._local, "scratch", None)
        if scratch is None:
            scratch = self._local.scratch = _Scratch(self)
        return scratch

    def step(self, t: float, h: float, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> tuple[Array, Array]:
        """Carry one slot: return x (nx,) after h seconds and the outputs (q, ny)."""
        return self._scratch().one(t, h, x, w, p, u0, u1)

    def values(self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> tuple[Array, Array]:
        """Evaluate N slots: x_next (N, nx) and y (N, q, ny), without Jacobians."""
        x_next, y = self._scratch().many(0, t, h, x, w, p, u0, u1)
        return x_next, y.reshape(len(t), self.q, self.ny)

    def linearize(self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> Linearization:
        """Evaluate N slots with Jacobians."""
        x_next, y, jacobian = self._scratch().many(1, t, h, x, w, p, u0, u1)
        return Linearization(x_next, y.reshape(len(t), self.q, self.ny), jacobian.transpose(0, 2, 1))

    def curvature(
        self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array, lambda_x: Array, lambda_y: Array
    ) -> Array:
        """Return the Hessians (N, n, n) of lambda_x' x_next + lambda_y' vec(y) in (x, w, p); symbolic models only."""
        return self._scratch().many(2, t, h, x, w, p, u0, u1, lambda_x, lambda_y)[0]


class _Scratch:
    """Buffers of one thread, bound once to CasADi's evaluation buffers."""

    def __init__(self, stage: StageFunction):
        self.stage = stage
        self.bound = [[_bind(function, size) for size, function in group.items()] for group in stage.mapped]

    def one(self, *values) -> tuple[Array, Array]:
        bound = self.bound[0][-1]
        for array, value in zip(bound.inputs, values, strict=True):
            array[0] = value
        bound.run()
        x_next, y = bound.outputs
        return x_next[0].copy(), y.reshape(self.stage.q, self.stage.ny).copy()

    def many(self, order: int, t: Array, h: Array, x: Array, w: Array, p: Array, *rest: Array) -> list[Array]:
        """Evaluate n slots with the function of derivative `order`; results have n rows, columns before rows."""
        n = len(t)
        arrays = (t[:, None], h[:, None], x, w, np.broadcast_to(p, (n, self.stage.np)), *rest)
        group = self.bound[order]
        results = [np.empty((n, *output.shape[1:])) for output in group[0].outputs]
        start = 0
        for bound in group:
            while n - start >= bound.size:
                stop = start + bound.size
                for array, value in zip(bound.inputs, arrays, strict=True):
                    array[:] = value[start:stop]
                bound.run()
                for result, array in zip(results, bound.outputs, strict=True):
                    result[start:stop] = array
                start = stop
        return results


def _bind(function: ca.Function, size: int) -> _Bound:
    """Return a function mapped `size` times together with memory for its arguments and results."""
    inputs: list[Array] = [np.zeros((size, function.size1_in(i))) for i in range(function.n_in())]
    outputs: list[Array] = []
    for i in range(function.n_out()):
        rows, columns = function.size1_out(i), function.size2_out(i) // size
        outputs.append(
            np.zeros((size, rows) if columns == 1 and i < 2 and function.n_out() > 1 else (size, columns, rows))
        )
    buffer, trigger = function.buffer()
    for i, array in enumerate(inputs):
        if array.size:
            buffer.set_arg(i, memoryview(array))  # pyright: ignore
    for i, array in enumerate(outputs):
        buffer.set_res(i, memoryview(array))  # pyright: ignore
    return _Bound(size, inputs, outputs, trigger, buffer)


@dataclass(frozen=True, eq=False)
class _Bound:
    """A mapped function with its memory: write `inputs`, `run`, read `outputs`."""

    size: int
    inputs: list[Array]
    outputs: list[Array]
    trigger: Callable[[], None]
    buffer: Any

    def run(self) -> None:
        try:
            self.trigger()
        except Exception as error:
            raise FloatingPointError(f"the model could not be evaluated: {error}") from error
        if self.buffer.ret() != 0:
            raise FloatingPointError("the model could not be evaluated")
