"""Integrators that stop where a root function changes sign: what a model-exchange FMU needs."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from ctmhe.models.fmu.instance import Discard
from ctmhe.types import Array

MOST_STEPS = 200_000  # within one call
RETRIES = 12  # LSODA: each with steps at most a quarter as long
PIECES = 100  # of a span without states, between which sign changes are looked for
_NO_STOP = 1e38  # CVODE cannot take a stop back, but move it
Function = Callable[[float, Array], Array]


class IntegrationError(Exception):
    """The integration came no further than to time `t` and state `x`."""

    def __init__(self, t: float, x: Array, reason: str):
        super().__init__(reason)
        self.t, self.x = t, x


def cvode_installed() -> bool:
    """Whether scikits.odes is installed."""
    return importlib.util.find_spec("scikits_odes_sundials") is not None


class Integrator(Protocol):
    """Follows dx/dt = derivatives(t, x) until a sign change of `roots(t, x)`.

    `derivatives` raises `Discard` where it cannot be evaluated; a smaller step is tried then. Any other error ends the
    integration and is passed on.
    """

    name: str

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        """Go to `t`, or to the first root, and return (t, x, whether a root stopped it).

        `fresh` is where to begin; None goes on where it was. Nothing is evaluated beyond `limit`. Integrators that go
        step by step may also return after one accepted step.
        """
        ...


def integrator(
    derivatives: Function, roots: Function, count: int, rtol: float, atol: Array, *, step_by_step: bool
) -> Integrator:
    """Return the best integrator at hand for `len(atol)` states and `count` roots."""
    if not len(atol):
        return Stateless(roots, count)
    if cvode_installed():
        return Cvode(derivatives, roots, count, rtol, atol, step_by_step=step_by_step)
    return Lsoda(derivatives, roots, count, rtol, atol, step_by_step=step_by_step)


class Cvode:
    """SUNDIALS CVODE (BDF, Newton) through scikits.odes.

    The interface rounds the time at which CVODE has to stop to single precision. So CVODE sees time counted from where
    it began, in units of the way to the first stop, which is the number one.
    """

    def __init__(
        self, derivatives: Function, roots: Function, count: int, rtol: float, atol: Array, *, step_by_step: bool
    ):
        self._functions, self._step_by_step = (derivatives, roots), step_by_step
        self._options: dict[str, Any] = {"rtol": rtol, "atol": atol, "max_steps": MOST_STEPS, "old_api": False}
        self._options |= {"one_step_compute": step_by_step}
        self._options["err_handler"] = lambda *report: self._messages.append(report[-1])
        if count:
            self._options |= {"rootfn": self._roots, "nr_rootfns": count}
        self.name = f"scikits.odes CVODE, rtol {rtol:g}"
        self._messages: list[Any] = []
        self._failure: Exception | None = None
        self._origin, self._unit, self._limited = 0.0, 1.0, False
        self._solver: Any = None
        self._last: tuple[float, Array] = (0.0, np.zeros(0))

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        self._messages.clear()
        self._failure = None
        stop = t if self._step_by_step else limit  # a single step would go beyond t
        if fresh is not None:
            self._begin(*fresh, stop)
        elif self._step_by_step and not self._move_stop(t):
            self._begin(*self._last, stop)
        end = (t - self._origin) / self._unit
        answer = self._solver.step(end)
        if self._failure is not None:
            raise self._failure
        if int(answer.flag) < 0:
            text = self._messages[-1] if self._messages else answer.message
            reason = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
            raise IntegrationError(self._time(answer.errors.t), np.array(answer.errors.y), reason)
        rooted = answer.flag.name == "ROOT_RETURN"
        arrived = not rooted and (answer.flag.name == "TSTOP_RETURN" or not self._step_by_step)
        self._last = (t if arrived else self._time(answer.values.t)), np.array(answer.values.y)
        return *self._last, rooted

    def _begin(self, t: float, x: Array, stop: float) -> None:
        limited = bool(np.isfinite(stop))
        self._origin, self._unit = t, (stop - t if limited else 1.0)
        begin = "reinit_IC"
        if self._solver is None:
            module = importlib.import_module("scikits_odes_sundials.cvode")
            self._solver, begin = module.CVODE(self._derivatives, **self._options), "init_step"
        getattr(self._solver, begin)(0.0, np.array(x))
        if limited or self._limited:  # after the beginning: a stop before the present time is refused
            self._solver.set_options(tstop=1.0 if limited else _NO_STOP)
        self._limited = limited

    def _move_stop(self, t: float) -> bool:
        stop = (t - self._origin) / self._unit
        single = float(np.float32(stop))
        if abs(single - stop) > 1e-15 * stop:
            return False
        self._solver.set_options(tstop=single)
        return True

    def _time(self, count: float) -> float:
        return self._origin + float(count) * self._unit

    def _derivatives(self, count: float, x: Array, out: Array) -> int:
        code = self._fill(self._functions[0], count, x, out)
        out *= self._unit
        return code

    def _roots(self, count: float, x: Array, out: Array, *_data: Any) -> int:
        return self._fill(self._functions[1], count, x, out)

    def _fill(self, function: Function, count: float, x: Array, out: Array) -> int:
        try:
            out[:] = function(self._time(count), x)
        except Discard:
            return 1  # try a smaller step
        except Exception as error:
            self._failure = error
            return -1
        return 0


class Lsoda:
    """SciPy's LSODA, begun afresh for every target; when evaluations fail, once more from there with shorter steps."""

    def __init__(
        self, derivatives: Function, roots: Function, count: int, rtol: float, atol: Array, *, step_by_step: bool
    ):
        self._functions, self._count, self._step_by_step = (derivatives, roots), count, step_by_step
        self._options: dict[str, Any] = {"rtol": rtol, "atol": atol}
        self.name = f"SciPy LSODA, rtol {rtol:g}"
        self._last: tuple[float, Array] = (0.0, np.zeros(0))
        self._signs = np.zeros(count, dtype=bool)
        self._solver: Any = None

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        self._last = fresh or self._last
        span = t - self._last[0]
        if fresh is not None or self._solver is None or self._solver.t_bound != t:
            self._begin(t, np.inf)
        refusal = ""
        for retry in range(1, RETRIES):
            try:
                return self._follow()
            except Discard as error:
                refusal = str(error)
                self._begin(t, span / 4.0**retry)
        raise IntegrationError(*self._last, f"no step was small enough: {refusal}")

    def _begin(self, t: float, longest: float) -> None:
        from scipy.integrate import LSODA

        derivatives, roots = self._functions
        self._signs = roots(*self._last) > 0.0
        self._solver = LSODA(derivatives, *self._last, t, max_step=longest, **self._options)

    def _follow(self) -> tuple[float, Array, bool]:
        roots, solver = self._functions[1], self._solver
        while solver.status == "running":
            message = solver.step()
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                raise IntegrationError(*self._last, message or "it left the finite numbers")
            if self._count and ((roots(solver.t, solver.y) > 0.0) != self._signs).any():
                self._last = self._located(solver)
                return *self._last, True
            self._last = (float(solver.t), solver.y.copy())
            if self._step_by_step:
                break
        return *self._last, False

    def _located(self, solver: Any) -> tuple[float, Array]:
        roots, path = self._functions[1], solver.dense_output()
        end = first_change(lambda t: roots(t, path(t)) > 0.0, self._signs, solver.t_old, solver.t)
        return end, np.array(path(end))


class Stateless:
    """For FMUs without continuous states: looks for sign changes only, between pieces of the way."""

    def __init__(self, roots: Function, count: int):
        self._roots, self._count = roots, count
        self.name = "nothing to integrate"
        self._t = 0.0

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        begin, x = (fresh[0] if fresh else self._t), np.zeros(0)
        self._t = t
        if self._count:
            before = self._roots(begin, x) > 0.0
            for low, high in itertools.pairwise(np.linspace(begin, t, PIECES + 1).tolist()):
                if ((self._roots(high, x) > 0.0) != before).any():
                    self._t = first_change(lambda t: self._roots(t, x) > 0.0, before, low, high)
                    return self._t, x, True
        return t, x, False


def first_change(signs: Callable[[float], Array], before: Array, low: float, high: float) -> float:
    """Return by bisection where `signs` is not `before` any more, between `low` where it is and `high`."""
    while high - low > 1e-14 * max(1.0, abs(high)) and low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if (signs(middle) == before).all() else (low, middle)
    return float(high)
