"""Integrators of one step: fixed-step Runge-Kutta and CVODES, as configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.transcription.sensitivities import step_symbols, step_with_sensitivities
from ctmhe.types import Array, positive

ROUND_OFF = 1e-14


@runtime_checkable
class Integrator(Protocol):
    """Carries the state over one integration step and visits the nodes of the output integral.

    `nodes` and `weights` are the quadrature of a step [0, 1]: the integral of g is the sum of weights * g(nodes).
    `accuracy` is how finely results respond to arguments, relative: what a solver cannot ask beyond.
    """

    nodes: Array
    weights: Array

    @property
    def accuracy(self) -> float:
        """Relative accuracy of an evaluation: round-off, or the tolerance of an adaptive method."""
        ...

    def parts(self, interval: float) -> int:
        """Return into how many equal steps a cell of `interval` seconds is divided."""
        ...

    def trace(self, model: Model, signal: bool) -> ca.Function:
        """Return the function (t, h, x, w, p, u0, u1) -> (x_next, y) over one step of h seconds.

        y (ny, nodes + 1): outputs at the nodes (none unless `signal`), then at the step's end.
        """
        ...


def is_symbolic(model: Model) -> bool:
    """Return whether the model is made of scalar symbols, so that its functions can be expanded."""
    return model.dynamics.is_a("SXFunction") and model.output.is_a("SXFunction")


@dataclass(frozen=True)
class RK4:
    """The classic Runge-Kutta method of order 4, in equal steps within a slot.

    The output integral is the augmented RK4: residuals at the four stages with weights h/6, h/3, h/3, h/6.

    Parameters
    ----------
    step : float
        Largest step in seconds.
    """

    step: float

    nodes = np.array([0.0, 0.5, 0.5, 1.0])
    weights = np.array([1.0, 2.0, 2.0, 1.0]) / 6.0
    accuracy = ROUND_OFF
    method = "RK4"

    def __post_init__(self) -> None:
        positive("RK4: step", self.step, "seconds")

    def parts(self, interval: float) -> int:
        """Return the number of equal steps, none longer than `step`, in a cell."""
        return max(1, int(np.ceil(interval / self.step * (1 - 1e-9))))

    def trace(self, model: Model, signal: bool) -> ca.Function:
        """Return (t, h, x, w, p, u0, u1) -> (x_next, y): see `Integrator`."""
        symbols = step_symbols(model, ca.SX if is_symbolic(model) else ca.MX)
        t, h, x, w, p, u0, u1 = symbols
        middle = (u0 + u1) / 2
        k1 = model.dynamics(t, x, u0, w, p)
        x2 = x + h / 2 * k1
        k2 = model.dynamics(t + h / 2, x2, middle, w, p)
        x3 = x + h / 2 * k2
        k3 = model.dynamics(t + h / 2, x3, middle, w, p)
        x4 = x + h * k3
        k4 = model.dynamics(t + h, x4, u1, w, p)
        end = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        outputs = [model.output(t + h, end, u1, w, p)]
        if signal:
            stages = ((t, x, u0), (t + h / 2, x2, middle), (t + h / 2, x3, middle), (t + h, x4, u1))
            outputs = [model.output(*stage, w, p) for stage in stages] + outputs
        return ca.Function("step", symbols, [end, ca.horzcat(*outputs)])


@dataclass(frozen=True)
class CVODES:
    """SUNDIALS CVODES (variable-order BDF) over each slot, with forward sensitivities; for stiff models.

    The output integral uses the three Gauss nodes of the slot (order 6).

    Parameters
    ----------
    rtol, atol : float
        Error tolerances, relative and in the model's units times the signals' nominals.
    """

    rtol: float = 1e-8
    atol: float = 1e-10

    nodes = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
    weights = np.array([5.0, 8.0, 5.0]) / 18.0

    @property
    def accuracy(self) -> float:
        """Return `rtol`."""
        return self.rtol

    def __post_init__(self) -> None:
        for name in ("rtol", "atol"):
            positive(f"CVODES: {name}", getattr(self, name))

    def parts(self, interval: float) -> int:
        """Return 1: CVODES chooses its steps itself."""
        return 1

    def trace(self, model: Model, signal: bool) -> ca.Function:
        """Return (t, h, x, w, p, u0, u1) -> (x_next, y): see `Integrator`."""
        grid = [*self.nodes, 1.0] if signal else [1.0]
        if not is_symbolic(model):
            return step_with_sensitivities(model, grid, self._flow)
        t, h, x, w, p, u0, u1 = step_symbols(model, ca.SX)
        s, scale = ca.SX.sym("s"), ca.DM(np.asarray(model.x.nominal))
        parameters = ca.vertcat(t, h, w, p, u0, u1)
        rate = h * model.dynamics(t + s * h, x * scale, u0 + s * (u1 - u0), w, p) / scale
        flow = self._flow({"x": x, "t": s, "p": parameters, "ode": rate}, grid)
        symbols = step_symbols(model, ca.MX)
        t, h, x, w, p, u0, u1 = symbols
        states = flow(x0=x / scale, p=ca.vertcat(t, h, w, p, u0, u1))["xf"]
        outputs = [model.output(t + c * h, states[:, i] * scale, u0 + c * (u1 - u0), w, p) for i, c in enumerate(grid)]
        return ca.Function("step", symbols, [states[:, -1] * scale, ca.horzcat(*outputs)])

    def _flow(self, problem: dict[str, Any], grid: Sequence[float]) -> ca.Function:
        options = {"reltol": self.rtol, "abstol": self.atol, "max_num_steps": 10_000}
        return ca.integrator("flow", "cvodes", problem, 0.0, list(grid), options)


@dataclass(frozen=True)
class Exact:
    """The matrix exponential, for models that are linear in x, w and u and do not depend on time.

    A step of h seconds is the Taylor series of exp(h A) applied to a vector, with the input linear over the step and w
    held: exact to rounding as long as h times the norm of A is below 1. Parameters may enter A in any way: mixing
    weights of a polytope do. The output integral uses the three Gauss nodes of a step (order 6).

    Parameters
    ----------
    step : float
        Largest step in seconds; longer slots are divided.

    Raises
    ------
    InputError
        For a model that is not linear, or depends on time; when an estimator is built.
    """

    step: float

    nodes = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
    weights = np.array([5.0, 8.0, 5.0]) / 18.0
    accuracy = ROUND_OFF
    order = 18

    def __post_init__(self) -> None:
        positive("Exact: step", self.step, "seconds")

    def parts(self, interval: float) -> int:
        """Return the number of equal steps, none longer than `step`, in a cell."""
        return max(1, int(np.ceil(interval / self.step * (1 - 1e-9))))

    def trace(self, model: Model, signal: bool) -> ca.Function:
        """Return (t, h, x, w, p, u0, u1) -> (x_next, y): see `Integrator`."""
        check_linear(model)
        symbols = step_symbols(model, ca.SX)
        t, h, x, w, p, u0, u1 = symbols
        zero = ca.DM.zeros(len(model.x))
        A = ca.jacobian(model.dynamics(0, x, u0, w, p), x)
        start, end = (model.dynamics(0, zero, u, w, p) for u in (u0, u1))

        def at(share: Any) -> Any:  # terms are derivatives of x at the step's start, times length^k / k!
            length = share * h
            term = length * (A @ x + start)
            total = x + term
            for k in range(2, self.order + 1):
                term = length * (A @ term + (share * (end - start) if k == 2 else 0)) / k
                total = total + term
            return total

        grid = [*self.nodes, 1.0] if signal else [1.0]
        states = [at(share) for share in grid]
        y = [model.output(t + c * h, z, u0 + c * (u1 - u0), w, p) for c, z in zip(grid, states, strict=True)]
        return ca.Function("step", symbols, [states[-1], ca.horzcat(*y)])


def is_linear(model: Model) -> bool:
    """Return whether dynamics and output are affine in x, w and u together and do not depend on time."""
    if not is_symbolic(model):
        return False
    sizes = [model.dynamics.size1_in(i) for i in range(5)]
    t, x, u, w, p = (ca.SX.sym(name, size) for name, size in zip("txuwp", sizes, strict=True))
    free = ca.vertcat(x, u, w)
    for function in (model.dynamics, model.output):
        value = function(t, x, u, w, p)
        if ca.depends_on(value, t) or any(ca.which_depends(value, free, 2, False)):
            return False
    return True


def check_linear(model: Model) -> None:
    """Raise `InputError` unless the model is linear."""
    if not is_linear(model):
        raise InputError(
            f"model {model.name!r} is not linear in its states, inputs and disturbances, or depends on time: use RK4 "
            "or CVODES, and Extended or Unscented for a filter"
        )


@dataclass(frozen=True)
class StepMap:
    """The model's own step map: what a `DiscreteModel` uses. The output belongs to the slot's start.

    A slot of length zero leaves the state where it is: the filtering form ends with one, to count the newest
    measurement.
    """

    nodes = np.empty(0)
    weights = np.empty(0)
    accuracy = ROUND_OFF
    method = "step map"

    def parts(self, interval: float) -> int:
        """Return 1: a cell is a step."""
        return 1

    def trace(self, model: Model, signal: bool) -> ca.Function:
        """Return (t, h, x, w, p, u0, u1) -> (x_next, y) with y taken at the start of the step."""
        symbols = step_symbols(model, ca.SX if is_symbolic(model) else ca.MX)
        t, h, x, w, p, u0, _ = symbols
        x_next = ca.if_else(h > 0, model.dynamics(t, x, u0, w, p), x)
        return ca.Function("step", symbols, [x_next, model.output(t, x, u0, w, p)])
