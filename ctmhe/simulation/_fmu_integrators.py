"""Integrators that stop where a root function changes sign: what a model-exchange FMU needs."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from ctmhe.errors import FmuError
from ctmhe.types import Array

MOST_STEPS = 200_000  # within one call
Function = Callable[[float, Array], Array]


def cvode_installed() -> bool:
    """Whether scikits.odes is installed."""
    return importlib.util.find_spec("scikits_odes_sundials") is not None


class Integrator(Protocol):
    """Follows dx/dt = derivatives(t, x) until a sign change of `roots(t, x)`."""

    name: str

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        """Go to `t`, or to the first root, and return (t, x, whether a root stopped it).

        `fresh` is where to begin; None goes on where it was. Nothing is evaluated beyond `limit`.
        """
        ...


class Cvode:
    """SUNDIALS CVODE (BDF, Newton) through scikits.odes."""

    def __init__(self, derivatives: Function, roots: Function, count: int, rtol: float, atol: Array):
        self._functions = derivatives, roots
        self._options: dict[str, Any] = {"rtol": rtol, "atol": atol, "max_steps": MOST_STEPS, "old_api": False}
        self._options["err_handler"] = lambda *report: self._messages.append(report[-1])
        if count:
            self._options |= {"rootfn": self._roots, "nr_rootfns": count}
        self.name = f"scikits.odes CVODE, rtol {rtol:g}"
        self._messages: list[Any] = []
        self._failure: Exception | None = None
        self._origin, self._limited, self._solver = 0.0, False, None

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        self._messages.clear()
        self._failure = None
        if fresh is not None:
            self._begin(*fresh, limit)
        assert self._solver is not None
        answer = self._solver.step(t - self._origin)
        if self._failure is not None:
            raise self._failure
        if int(answer.flag) < 0:
            text = self._messages[-1] if self._messages else answer.message
            reason = text.decode(errors="replace") if isinstance(text, bytes) else text
            raise FmuError(f"the integration to t = {t:g} failed: {reason}")
        rooted = answer.flag.name == "ROOT_RETURN"
        return (self._origin + float(answer.values.t) if rooted else t), np.array(answer.values.y), rooted

    def _begin(self, t: float, x: Array, limit: float) -> None:
        self._origin = t  # time is counted from here, since the interface gives zero and negative times a meaning
        if self._solver is None or self._limited:  # a limit cannot be taken back
            module = importlib.import_module("scikits_odes_sundials.cvode")
            self._solver, begin = module.CVODE(self._derivatives, **self._options), "init_step"
        else:
            begin = "reinit_IC"
        self._limited = bool(np.isfinite(limit))
        if self._limited:
            self._solver.set_options(tstop=limit - t)
        getattr(self._solver, begin)(0.0, np.array(x))

    def _derivatives(self, t: float, x: Array, out: Array) -> int:
        return self._fill(self._functions[0], t, x, out)

    def _roots(self, t: float, x: Array, out: Array, *_data: Any) -> int:
        return self._fill(self._functions[1], t, x, out)

    def _fill(self, function: Function, t: float, x: Array, out: Array) -> int:
        try:
            out[:] = function(self._origin + t, x)
        except Exception as error:
            self._failure = error
            return -1
        return 0 if np.isfinite(out).all() else 1  # 1: try a smaller step


class Lsoda:
    """SciPy's LSODA, begun afresh at every call."""

    def __init__(self, derivatives: Function, roots: Function, count: int, rtol: float, atol: Array):
        self._functions, self._count, self._tolerances = (derivatives, roots), count, (rtol, atol)
        self.name = f"SciPy LSODA, rtol {rtol:g}"
        self._last = 0.0, np.zeros(0)

    def to(self, t: float, fresh: tuple[float, Array] | None, limit: float) -> tuple[float, Array, bool]:
        from scipy.integrate import LSODA

        derivatives, roots = self._functions
        rtol, atol = self._tolerances
        begin, x = fresh or self._last
        options: Any = {"rtol": rtol, "atol": atol}
        solver: Any = LSODA(derivatives, begin, x, t, **options)
        before = roots(begin, x) > 0.0
        rooted = False
        while solver.status == "running" and not rooted:
            message = solver.step()
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                raise FmuError(f"the integration to t = {t:g} failed: {message or 'it left the finite numbers'}")
            rooted = bool(self._count and ((roots(solver.t, solver.y) > 0.0) != before).any())
        self._last = (t, solver.y.copy())
        if rooted:
            path, low, high = solver.dense_output(), solver.t_old, solver.t
            while high - low > 1e-14 * max(1.0, abs(high)) and low < (middle := 0.5 * (low + high)) < high:
                same = ((roots(middle, path(middle)) > 0.0) == before).all()
                low, high = (middle, high) if same else (low, middle)
            self._last = (float(high), np.array(path(high)))
        end, x = self._last
        return end, x, rooted
