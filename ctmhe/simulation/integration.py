"""Accurate integration of dx/dt = f(t, x, u, w, p): SUNDIALS CVODE through scikits.odes, or CasADi's cvodes.

The only file that imports scikits.odes.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any, Protocol

import casadi as ca
import numpy as np

from ctmhe.errors import CtmheError, MissingExtra, SolverError
from ctmhe.models.continuous import Model
from ctmhe.types import Array

MAX_STEPS = 50_000

MOST_ROOTS = 50
"""Roots after which scikits.odes begins anew at the next restart: it keeps and copies all of them at every call."""

CLIP = 1e12
"""Largest magnitude of a level that CVODE is shown: +-inf mean a certain yes and no."""


class Integration(Protocol):
    """One solution in progress; the input is linear in time and w is constant until the next `restart`."""

    name: str

    def restart(self, t: float, x: Array, u: Array, slope: Array, w: Array, p: Array) -> None:
        """Begin anew at time `t` from `x`, with input u + slope * (time - t)."""
        ...

    def to(self, t: float) -> Array:
        """Return the state at `t`, which lies after the last time asked for."""
        ...


Level = Callable[[float, Array], float]
"""A trigger's level at a time (seconds), given the state (nx,)."""


def has_sundials() -> bool:
    """Return whether scikits.odes is installed."""
    return importlib.util.find_spec("scikits_odes_sundials") is not None


def integration_of(model: Model, rtol: float, atol: float, backend: str | None) -> Integration:
    """Return the integration that `backend` names: "scikits.odes", "casadi", or None for the first installed."""
    if backend == "casadi" or (backend is None and not has_sundials()):
        return CasadiCvodes(model, rtol, atol)
    if backend not in (None, "scikits.odes"):
        raise SolverError(f"backend must be 'scikits.odes' or 'casadi', got {backend!r}")
    return ScikitsCvode(model, rtol, atol)


class ScikitsCvode:
    """CVODE (BDF, Newton) through scikits.odes; f and its Jacobian are evaluated by CasADi into fixed buffers.

    Restarts only when told: CVODE begins at order 1, so restarts cost steps and accuracy.
    """

    name = "scikits.odes CVODE"

    def __init__(self, model: Model, rtol: float, atol: float):
        try:
            cvode = importlib.import_module("scikits_odes_sundials.cvode")
        except ImportError as error:
            raise MissingExtra("scikits.odes", "sundials", "OdePlant(backend='scikits.odes')") from error
        self._messages: list[str] = []
        self._value = Buffered(model.dynamics, (len(model.x), 1))
        jacobian = ca.Function("dfdx", *_jacobian(model))
        self._jacobian = Buffered(jacobian, (len(model.x), len(model.x)))
        self._u = self._slope = np.zeros(len(model.u))
        self._start = 0.0
        self._clock = 0.0
        self._state = np.zeros(len(model.x))
        self._solver: Any = cvode.CVODE(
            self._rhs,
            jacfn=self._jac,
            rtol=rtol,
            atol=atol * np.asarray(model.x.nominal),
            max_steps=MAX_STEPS,
            old_api=False,
            err_handler=lambda *report: self._messages.append(_text(report[-1])),
        )
        self._begun = self._rooted = False
        self._level: Level | None = None
        self._roots = 0
        self._failure: Exception | None = None

    def restart(self, t: float, x: Array, u: Array, slope: Array, w: Array, p: Array) -> None:
        """Begin anew at `t`. Time is counted from `t`, since CVODE's interface gives negative times a meaning."""
        self._start, self._u, self._slope = t, u, slope
        self._clock, self._state = t, np.array(x)
        for buffered in (self._value, self._jacobian):
            buffered.w[:], buffered.p[:] = w, p
        anew = not self._begun or self._roots > MOST_ROOTS
        self._begun, self._roots = True, 0 if anew else self._roots
        begin = self._solver.init_step if anew else self._solver.reinit_IC
        begin(0.0, np.array(x, dtype=np.float64))

    def to(self, t: float) -> Array:
        """Return the state at `t`; the solver keeps its order and step across calls."""
        while t != self._clock:
            self._go(t)
        return self._state

    def until(self, t: float, level: Level) -> tuple[float, Array]:
        """Return the first time up to `t` at which `level` reaches zero from below, `t` if none, and the state there.

        CVODE looks for it within each of its steps, to its own rounding; the time is as exact as the solution.
        """
        if not self._rooted:
            self._solver.set_options(rootfn=self._root, nr_rootfns=1)
            self._rooted = True
        self._level = level
        try:
            while t != self._clock:
                if self._go(t) and level(self._clock, self._state) >= 0:
                    break
        finally:
            self._level = None
        return self._clock, self._state

    def _go(self, t: float) -> bool:
        """Go on to `t`, or to a root; return whether it is a root."""
        result = self._solver.step(t - self._start)
        if self._failure is not None or int(result.flag) < 0:
            failure, self._failure = self._failure, None
            if isinstance(failure, CtmheError):  # a policy's, in its own words
                raise failure
            reason = self._messages[-1] if self._messages else result.message
            self._messages.clear()
            raise SolverError(
                f"{self.name} stopped between t = {self._clock:.9g} and {t:.9g}: {reason}. Check that the model makes "
                "sense at the plant's state, inputs and disturbance there"
            ) from failure
        root = result.flag.name == "ROOT_RETURN"
        self._roots += root
        self._clock = min(self._start + float(result.values.t), t) if root else t
        self._state = np.array(result.values.y)
        return root

    def _rhs(self, t: float, x: Array, value: Array) -> int:
        try:
            value[:] = self._value(self._start + t, x, self._u + self._slope * t)[:, 0]
        except Exception as error:
            self._failure = error
            return -1
        return 0

    def _root(self, t: float, x: Array, value: Array) -> int:
        try:
            level = -1.0 if self._level is None else self._level(self._start + t, x)
            value[0] = min(max(level, -CLIP), CLIP)
        except Exception as error:
            self._failure = error
            return -1
        return 0

    def _jac(self, t: float, x: Array, _value: Array, jacobian: Array, *_: Any) -> int:
        try:
            jacobian[:, :] = self._jacobian(self._start + t, x, self._u + self._slope * t)
        except Exception as error:
            self._failure = error
            return -1
        return 0


class CasadiCvodes:
    """CasADi's cvodes on the unit interval, built once; every call restarts."""

    name = "casadi cvodes"

    def __init__(self, model: Model, rtol: float, atol: float):
        nx, nu, nw, np_ = (len(group) for group in (model.x, model.u, model.w, model.p))
        x, s = ca.MX.sym("x", nx), ca.MX.sym("s")
        parameters = ca.MX.sym("parameters", 2 + 2 * nu + nw + np_)
        t0, length, u, slope, w, p = ca.vertsplit(parameters, list(np.cumsum([0, 1, 1, nu, nu, nw, np_])))
        t = t0 + s * length
        problem = {
            "x": x,
            "t": s,
            "p": parameters,
            "ode": length * model.dynamics(t, x, u + slope * (t - t0), w, p) / model.x.nominal,
        }
        scaled = ca.MX.sym("scaled", nx)
        problem["ode"] = ca.substitute(problem["ode"], x, scaled * model.x.nominal)
        problem["x"] = scaled
        options = {
            "reltol": rtol,
            "abstol": atol,
            "max_num_steps": MAX_STEPS,
            "disable_internal_warnings": True,
            "show_eval_warnings": False,
        }
        self._scale = np.asarray(model.x.nominal)
        self._step = ca.integrator("plant", "cvodes", problem, 0.0, 1.0, options)

    def restart(self, t: float, x: Array, u: Array, slope: Array, w: Array, p: Array) -> None:
        """Begin anew at `t`."""
        self._t, self._x, self._rest = t, np.array(x), (u, slope, w, p)

    def to(self, t: float) -> Array:
        """Return the state at `t`."""
        if t == self._t:
            return self._x
        u, slope, w, p = self._rest
        try:
            parameters = np.concatenate([[self._t, t - self._t], u, slope, w, p])
            end = self._step(x0=self._x / self._scale, p=parameters)["xf"]
        except RuntimeError as error:
            raise SolverError(
                f"{self.name} stopped between t = {self._t:.9g} and {t:.9g}: {str(error).splitlines()[-1]}. Check that "
                "the model makes sense at the plant's state, inputs and disturbance there"
            ) from error
        self._rest = (u + slope * (t - self._t), slope, w, p)
        self._t, self._x = t, np.asarray(end).reshape(-1) * self._scale
        return self._x


class Buffered:
    """A CasADi function of (t, x, u, w, p) on memory of its own: w and p stay, a call writes over the last result."""

    def __init__(self, function: ca.Function, shape: tuple[int, int]):
        sizes = [function.numel_in(i) for i in range(5)]
        self._arguments = [np.zeros(max(size, 1)) for size in sizes]
        self.w, self.p = self._arguments[3][: sizes[3]], self._arguments[4][: sizes[4]]
        self._x, self._u = self._arguments[1], self._arguments[2][: sizes[2]]
        self._result = np.zeros(shape, order="F")
        buffer: Any
        buffer, self._evaluate = function.buffer()
        self._buffer = buffer
        for i, argument in enumerate(self._arguments):
            buffer.set_arg(i, memoryview(argument))  # type: ignore[arg-type]
        buffer.set_res(0, memoryview(self._result.reshape(-1, order="F")))  # type: ignore[arg-type]

    def __call__(self, t: float, x: Array, u: Array) -> Array:
        """Return the value, valid until the next call."""
        self._arguments[0][0] = t
        self._x[:], self._u[:] = x, u
        self._evaluate()
        if self._buffer.ret():
            raise SolverError("the model's function could not be evaluated")
        return self._result


def _jacobian(model: Model) -> tuple[list[ca.MX], list[ca.MX]]:
    symbols = [ca.MX.sym(name, model.dynamics.numel_in(i)) for i, name in enumerate("txuwp")]
    return symbols, [ca.densify(ca.jacobian(model.dynamics(*symbols), symbols[1]))]


def _text(message: Any) -> str:
    return message.decode(errors="replace") if isinstance(message, bytes) else str(message)
