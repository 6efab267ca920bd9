"""The stage function: one slot's step, outputs and Jacobians. Its single step is the only thing ever compiled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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

    A slot is covered by as few equal integration steps as its length needs. Only the function of one step is compiled,
    once per model and integrator; steps are chained here, as the core does. Any number of slots is evaluated by the
    same CasADi function, mapped over chunks. Scratch memory is per thread.

    Parameters
    ----------
    model : Model
    integrator : Integrator
    signal : bool
        Outputs are wanted at the nodes of the output integral too.
    interval : float, optional
        Longest slot in seconds; when left out, every slot is one step.

    Attributes
    ----------
    steps : int
        Integration steps of the longest slot.
    step_length : float
        Longest step in seconds.
    q : int
        Output evaluations of a slot: at the nodes of step 0, of step 1, ..., and at the slot's end.
    accuracy : float
        Relative accuracy of an evaluation.
    value, derivative : casadi.Function
        One step: (t, h, x, w, p, u0, u1) -> (x_next, vec y), and the same with the Jacobian as a third result.
    method : str or None
        How the core integrates a model that evaluates itself (`FmuModel.evaluator`): None for other models, and for
        integrators that the core does not have.
    symbolic : bool
        The functions are expanded scalar expressions: exact second derivatives are at hand.
    """

    def __init__(self, model: Model, integrator: Integrator, *, signal: bool, interval: float | None = None):
        self.nx, self.nw, self.np, self.nu, self.ny = (len(getattr(model, key)) for key in "xwpuy")
        self.nodes = integrator.nodes if signal else np.empty(0)
        self.weights = integrator.weights if signal else np.empty(0)
        self.accuracy = integrator.accuracy
        self.steps = 1 if interval is None else integrator.parts(interval)
        self.step_length = np.inf if interval is None else interval / self.steps
        self.q = self.steps * len(self.nodes) + 1
        self.model = model
        own = getattr(model, "evaluator", None) is not None
        self.method = getattr(integrator, "method", None) if own else None
        step = integrator.trace(model, signal)
        symbolic = step.is_a("SXFunction")
        kind: Any = ca.SX if symbolic else ca.MX
        symbols = [kind.sym(step.name_in(i), step.size1_in(i)) for i in range(step.n_in())]
        x_next, y = step(*symbols)
        x_next, y = ca.densify(x_next), ca.densify(ca.vec(y))
        jacobian = ca.densify(ca.jacobian(ca.vertcat(x_next, y), ca.vertcat(*symbols[2:5])))
        shared: Any = ca.cse if symbolic else list  # what occurs twice in scalar expressions is computed once
        self.value = ca.Function("stage", symbols, shared([x_next, y]))
        self.derivative = ca.Function("stage_jacobian", symbols, shared([x_next, y, jacobian]))
        self.symbolic = symbolic
        functions = [self.value, self.derivative]
        if symbolic:  # second derivatives of dot(lambda_x, x_next) + dot(lambda_y, y)
            duals = [kind.sym("lambda_x", self.nx), kind.sym("lambda_y", y.numel())]
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

    def steps_of(self, h: Array) -> np.ndarray:
        """Return the number of integration steps (N,) of slots of h (N,) seconds."""
        needed = np.ceil(np.asarray(h) / self.step_length * (1 - 1e-9))
        return np.clip(needed, 1, self.steps).astype(np.int64)

    def quadrature(self, h: Array) -> tuple[Array, Array]:
        """Return nodes and weights (N, q - 1) of the output integral, in seconds, for slots of h (N,) seconds.

        Nodes of steps that a slot does without have weight zero.
        """
        steps = self.steps_of(h)[:, None, None]
        number = np.arange(self.steps)[:, None]
        used, length = number < steps, h[:, None, None] / steps
        nodes = np.where(used, (number + self.nodes) * length, h[:, None, None])
        weights = np.where(used, self.weights * length, 0.0)
        return nodes.reshape(len(h), -1), weights.reshape(len(h), -1)

    def step(self, t: float, h: float, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> tuple[Array, Array]:
        """Carry one slot: return x (nx,) after h seconds and the outputs (q, ny)."""
        one = self._scratch().one
        if self.steps == 1:
            return one(t, h, x, w, p, u0, u1)
        steps = int(self.steps_of(np.array([h]))[0])
        y, slope, r = np.zeros((self.q, self.ny)), u1 - u0, len(self.nodes)
        for i in range(steps):
            inputs = (u0 + slope * (i / steps), u0 + slope * ((i + 1) / steps))
            x, rows = one(t + i * (h / steps), h / steps, x, w, p, *inputs)
            y[i * r : (i + 1) * r] = rows[:-1]
            y[-1] = rows[-1]
        return x, y

    def roll(self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> Array:
        """Carry x (nx,) through N slots, one after the other: return the states (N+1, nx)."""
        if self.steps == 1:
            return self._scratch().roll(t, h, x, w, p, u0, u1)
        states = np.empty((len(t) + 1, self.nx))
        states[0] = x
        for k in range(len(t)):
            states[k + 1], _ = self.step(t[k], h[k], states[k], w[k], p, u0[k], u1[k])
        return states

    def output(self, t: float, x: Array, u: Array, w: Array, p: Array) -> Array:
        """Return h(t, x, u, w, p), (ny,)."""
        bound = self._scratch().output
        for array, value in zip(bound.inputs, (t, x, u, w, p), strict=True):
            array[0] = value
        bound.run()
        return bound.outputs[0].reshape(-1).copy()

    def values(self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> tuple[Array, Array]:
        """Evaluate N slots: x_next (N, nx) and y (N, q, ny), without Jacobians."""
        x_next, y = np.array(x, dtype=float), np.zeros((len(t), self.q, self.ny))
        for i, live, arguments in self._steps(t, h, x_next, w, p, u0, u1):
            x_next[live], rows = self._scratch().many(0, *arguments)
            self._place(y, i, live, rows.reshape(len(live), -1, self.ny))
        return x_next, y

    def linearize(self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> Linearization:
        """Evaluate N slots with Jacobians."""
        nx, ny, n = self.nx, self.ny, self.nx + self.nw + self.np
        x_next, y = np.array(x, dtype=float), np.zeros((len(t), self.q, ny))
        jacobian, y_jacobian = np.tile(np.eye(nx, n), (len(t), 1, 1)), np.zeros((len(t), self.q, ny, n))
        for i, live, arguments in self._steps(t, h, x_next, w, p, u0, u1):
            x_next[live], rows, derivative = self._scratch().many(1, *arguments)
            derivative = _chained(derivative.transpose(0, 2, 1), jacobian[live])
            jacobian[live] = derivative[:, :nx]
            self._place(y, i, live, rows.reshape(len(live), -1, ny))
            self._place(y_jacobian, i, live, derivative[:, nx:].reshape(len(live), -1, ny, n))
        return Linearization(x_next, y, np.concatenate([jacobian, y_jacobian.reshape(len(t), -1, n)], axis=1))

    def curvature(
        self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array, lambda_x: Array, lambda_y: Array
    ) -> Array:
        """Return the Hessians (N, n, n) of lambda_x' x_next + lambda_y' vec(y) in (x, w, p); symbolic models only."""
        nx, ny, r, n = self.nx, self.ny, len(self.nodes), self.nx + self.nw + self.np
        x_next, jacobian = np.array(x, dtype=float), np.tile(np.eye(nx, n), (len(t), 1, 1))
        forward = []
        for i, live, arguments in self._steps(t, h, x_next, w, p, u0, u1):
            x_next[live], _, derivative = self._scratch().many(1, *arguments)
            derivative = derivative.transpose(0, 2, 1)
            forward.append((i, live, arguments, derivative, jacobian[live]))
            jacobian[live] = _chained(derivative, jacobian[live])[:, :nx]
        weights, lambda_x = lambda_y.reshape(len(t), self.q, ny), lambda_x.copy()
        hessian, steps = np.zeros((len(t), n, n)), self.steps_of(h)
        for i, live, arguments, derivative, before in reversed(forward):
            ends = np.where((steps[live] == i + 1)[:, None], weights[live, -1], 0.0)
            dual = np.concatenate([weights[live, i * r : (i + 1) * r].reshape(len(live), -1), ends], axis=1)
            inner = self._scratch().many(2, *arguments, lambda_x[live], dual)[0]
            moved = np.concatenate([before, np.tile(np.eye(n)[nx:], (len(live), 1, 1))], axis=1)
            hessian[live] += moved.transpose(0, 2, 1) @ inner @ moved
            both = np.concatenate([lambda_x[live], dual], axis=1)[:, None]
            lambda_x[live] = (both @ derivative[:, :, :nx])[:, 0]
        return hessian

    def _steps(
        self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array
    ) -> Iterator[tuple[int, np.ndarray, tuple[Array, ...]]]:
        """Yield, per integration step, its number, the slots that have it, and their arguments; x is read then."""
        steps, slope = self.steps_of(h), u1 - u0
        for i in range(int(steps.max(initial=1))):
            live = np.flatnonzero(steps > i)
            count = steps[live]
            length, begin, end = h[live] / count, (i / count)[:, None], ((i + 1) / count)[:, None]
            inputs = (u0[live] + slope[live] * begin, u0[live] + slope[live] * end)
            yield i, live, (t[live] + i * length, length, x[live], w[live], p, *inputs)

    def _place(self, slots: Array, i: int, live: np.ndarray, rows: Array) -> None:
        """Write the evaluations of step i into those of its slots; the last step's end counts."""
        r = len(self.nodes)
        slots[live, i * r : (i + 1) * r] = rows[:, :-1]
        slots[live, -1] = rows[:, -1]


def _chained(derivative: Array, before: Array) -> Array:
    """Return the derivatives of a step by (x, w, p) at the slot's start, from those at the step's."""
    nx = before.shape[1]
    result = derivative[:, :, :nx] @ before
    result[:, :, nx:] += derivative[:, :, nx:]
    return result


class _Scratch:
    """Buffers of one thread, bound once to CasADi's evaluation buffers."""

    def __init__(self, stage: StageFunction):
        self.stage = stage
        self.bound = [[_bind(function, size) for size, function in group.items()] for group in stage.mapped]
        self.output = _bind(stage.model.output, 1)
        self.rolling: list[_Bound] = []

    def roll(self, t: Array, h: Array, x: Array, w: Array, p: Array, u0: Array, u1: Array) -> Array:
        """Carry x through N slots with functions that hold as many steps as there are in a chunk."""
        if not self.rolling:
            self.rolling = _bind_rolls(self.stage.value)
        n, start = len(t), 0
        arrays = (t[:, None], h[:, None], w, np.broadcast_to(p, (n, self.stage.np)), u0, u1)
        states = np.empty((n + 1, self.stage.nx))
        states[0] = x
        for bound in self.rolling:
            while n - start >= bound.size:
                stop = start + bound.size
                bound.inputs[0][:] = states[start]
                for array, value in zip(bound.inputs[1:], arrays, strict=True):
                    array[:] = value[start:stop]
                bound.run()
                states[start + 1 : stop + 1] = bound.outputs[0]
                start = stop
        return states

    def one(self, *values) -> tuple[Array, Array]:
        bound = self.bound[0][-1]
        for i in bound.live:
            bound.inputs[i][0] = values[i]
        bound.run()
        x_next, y = bound.outputs
        return x_next[0].copy(), y.reshape(-1, self.stage.ny).copy()

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
    return _bound(function, size, inputs, outputs)


def _bind_rolls(value: ca.Function) -> list[_Bound]:
    """Return functions that take a chunk of steps, with memory for one state, their arguments, and the states."""
    names = [value.name_in(i) for i in range(value.n_in())]
    symbols = [ca.MX.sym(name, value.size1_in(i)) for i, name in enumerate(names)]
    one = ca.Function("roll", [symbols[2], *symbols[:2], *symbols[3:]], [value(*symbols)[0]])
    bound = []
    for size in CHUNKS:
        function = one.mapaccum(size)
        inputs = [np.zeros((function.size2_in(i), function.size1_in(i))) for i in range(function.n_in())]
        bound.append(_bound(function, size, inputs, [np.zeros((size, function.size1_out(0)))]))
    return bound


def _bound(function: ca.Function, size: int, inputs: list[Array], outputs: list[Array]) -> _Bound:
    buffer, trigger = function.buffer()
    for i, array in enumerate(inputs):
        if array.size:
            buffer.set_arg(i, memoryview(array))  # pyright: ignore
    for i, array in enumerate(outputs):
        buffer.set_res(i, memoryview(array))  # pyright: ignore
    return _Bound(size, inputs, outputs, trigger, buffer, [i for i, array in enumerate(inputs) if array.size])


@dataclass(frozen=True, eq=False)
class _Bound:
    """A mapped function with its memory: write `inputs`, those that are not empty (`live`), `run`, read `outputs`."""

    size: int
    inputs: list[Array]
    outputs: list[Array]
    trigger: Callable[[], None]
    buffer: Any
    live: list[int]

    def run(self) -> None:
        try:
            self.trigger()
        except Exception as error:
            raise FloatingPointError(f"the model could not be evaluated: {error}") from error
        if self.buffer.ret() != 0:
            raise FloatingPointError("the model could not be evaluated")
