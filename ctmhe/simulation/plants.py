"""Plants: what is estimated, integrated as exactly as a plant should be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.models.signals import Signals
from ctmhe.simulation.integration import Buffered, Integration, Level, ScikitsCvode, integration_of
from ctmhe.types import Array

WHOLE = 1e-6
"""Fraction of a step within which a span counts as whole steps."""


@runtime_checkable
class Plant(Protocol):
    """A plant that is advanced in time from event to event.

    `integrator` says what integrates it. The input is linear over an advance and w is constant.
    """

    name: str
    x: Signals
    u: Signals
    w: Signals
    y: Signals
    integrator: str

    def start(self, t: float, x: Array | None, p: Array | None = None) -> None:
        """(Re)start at time `t` (seconds) in state `x` (nx,), the plant's own when None, with parameters `p` (np,)."""
        ...

    def advance(self, t: float, u0: Array, u1: Array, w: Array) -> None:
        """Go on to time `t`; the input goes linearly from `u0` (now) to `u1` (at `t`), the disturbance is `w`."""
        ...

    def state(self) -> Array:
        """Return the true state now, (nx,)."""
        ...

    def output(self, u: Array, w: Array) -> Array:
        """Return the outputs now, (ny,), under input `u` and disturbance `w`."""
        ...

    def checkpoint(self) -> object:
        """Return what `restore` needs to come back to now."""
        ...

    def restore(self, checkpoint: Any) -> None:
        """Go back to a checkpoint, exactly."""
        ...

    def close(self) -> None:
        """Release what the plant holds outside of Python."""
        ...


@dataclass(frozen=True, eq=False)
class _Moment:
    """State of a plant that is a model: time, state and the drive under which it was reached."""

    t: float
    x: Array


class OdePlant:
    """A continuous-time model as plant, dx/dt = f(t, x, u, w, p) (thesis 3.7).

    One solution runs on as long as the input stays on one line and the part of w that enters f does not change; it is
    restarted only there (measurement noise restarts nothing).

    Parameters
    ----------
    model : Model
        Continuous-time; its signals are the plant's.
    rtol : float
        Relative tolerance.
    atol : float
        Absolute tolerance relative to the states' nominal values.
    backend : {"scikits.odes", "casadi"}, optional
        The first that is installed when left out; `integrator` tells.

    Raises
    ------
    InputError
        For a discrete-time model.
    SolverError
        When the solution cannot be continued.
    """

    def __init__(self, model: Model, *, rtol: float = 1e-10, atol: float = 1e-12, backend: str | None = None):
        if model.step is not None:
            raise InputError(f"model {model.name!r} is discrete-time: use MapPlant(model)")
        self.model, self.name = model, model.name
        self._configuration = (model, rtol, atol, backend)
        self.x, self.u, self.w, self.y, self.p = model.x, model.u, model.w, model.y, model.p
        self._integration: Integration = integration_of(model, rtol, atol, backend)
        self.integrator = f"{self._integration.name}, rtol {rtol:g}, atol {atol:g}"
        self._driving = driving_disturbances(model)
        self._output = Buffered(model.output, (len(model.y), 1))
        self._p = model.p_start
        self._now: _Moment | None = None
        self._line: tuple[float, Array, Array, Array] | None = None

    def start(self, t: float, x: Array | None, p: Array | None = None) -> None:
        """(Re)start at `t` in state `x` with parameters `p`, the model's own values when None."""
        self._p = self.model.p_start if p is None else self.model.p.vector(p, "plant parameters")
        self._now, self._line = _Moment(float(t), start_state(self.model, x)), None

    @property
    def finds_roots(self) -> bool:
        """Whether `advance_until` is there: CVODE stops at roots."""
        return isinstance(self._integration, ScikitsCvode)

    def advance(self, t: float, u0: Array, u1: Array, w: Array) -> None:
        """Integrate to `t`."""
        self._advance(t, u0, u1, w, None)

    def advance_until(self, t: float, u0: Array, u1: Array, w: Array, level: Level) -> float:
        """Integrate to the first time up to `t` at which level(time, x) reaches zero from below; return that time.

        CVODE asks for the level in each of its steps. Where a signal has jumped it begins with many tiny ones: then the
        level at `t` is looked at first, and the way is gone again only where that has been reached.
        """
        now = started(self)
        if t > now.t and not self._on_line(now.t, u0, (u1 - u0) / (t - now.t), w):
            self._advance(t, u0, u1, w, None)
            if level(t, self.state()) < 0:
                return t
            self._now, self._line = now, None
        self._advance(t, u0, u1, w, level)
        return started(self).t

    def _advance(self, t: float, u0: Array, u1: Array, w: Array, level: Level | None) -> None:
        now = started(self)
        if t <= now.t:
            if t == now.t:
                return
            raise InputError(f"plant {self.name!r} is at t = {now.t}; it cannot advance to {t}: use restore")
        slope = (u1 - u0) / (t - now.t)
        if not self._on_line(now.t, u0, slope, w):
            self._integration.restart(now.t, now.x, u0, slope, w, self._p)
            self._line = (now.t, np.array(u0), slope, np.array(w))
        try:
            if level is not None and isinstance(self._integration, ScikitsCvode):
                t, x = self._integration.until(t, level)
            else:
                x = self._integration.to(t)
            self._now = _Moment(t, x)
        except Exception:
            self._line = None
            raise

    def state(self) -> Array:
        """Return the true state now."""
        return started(self).x

    def output(self, u: Array, w: Array) -> Array:
        """Return h(t, x, u, w, p) now."""
        now = started(self)
        return self.output_at(now.t, now.x, u, w)

    def output_at(self, t: float, x: Array, u: Array, w: Array) -> Array:
        """Return h(t, x, u, w, p) for another time and state."""
        self._output.w[:], self._output.p[:] = w, self._p
        return self._output(t, x, u)[:, 0].copy()

    def checkpoint(self) -> object:
        """Return time and state."""
        return started(self)

    def restore(self, checkpoint: Any) -> None:
        """Return to a checkpoint; the solution restarts from there."""
        self._now, self._line = checkpoint, None

    def close(self) -> None:
        """Do nothing: the plant holds memory of this process only."""

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, self._configuration  # a plant that was pickled has to be started again

    def _on_line(self, t: float, u0: Array, slope: Array, w: Array) -> bool:
        """Whether the running solution has this input and disturbance (to rounding)."""
        if self._line is None:
            return False
        t_line, u_line, slope_line, w_line = self._line
        scale = 1e-12 * np.asarray(self.u.nominal)
        same_input = (np.abs(slope - slope_line) <= scale + 1e-9 * np.abs(slope_line)).all()
        drift = np.abs(u0 - u_line - slope_line * (t - t_line))
        return bool(
            same_input
            and (drift <= scale + 1e-12 * np.abs(u0)).all()
            and np.array_equal(w[self._driving], w_line[self._driving])
        )


class MapPlant:
    """A discrete-time model as plant, x(t + step) = f(t, x, u, w, p) (thesis 3.1); it advances in whole steps.

    Parameters
    ----------
    model : Model
        Discrete-time (`model.step` in seconds).
    """

    def __init__(self, model: Model):
        if model.step is None:
            raise InputError(f"model {model.name!r} is continuous-time: use OdePlant(model)")
        self.model, self.name, self.step = model, model.name, float(model.step)
        self.x, self.u, self.w, self.y, self.p = model.x, model.u, model.w, model.y, model.p
        self.integrator = f"step map, {self.step:g} s"
        self._p = model.p_start
        self._now: _Moment | None = None

    def start(self, t: float, x: Array | None, p: Array | None = None) -> None:
        """(Re)start at `t` in state `x` with parameters `p`, the model's own values when None."""
        self._p = self.model.p_start if p is None else self.model.p.vector(p, "plant parameters")
        self._now = _Moment(float(t), start_state(self.model, x))

    def advance(self, t: float, u0: Array, u1: Array, w: Array) -> None:
        """Apply the step map until `t`; the input of a step is the one at its start."""
        now = started(self)
        count = (t - now.t) / self.step
        steps = round(count)
        if steps < 0 or abs(count - steps) > WHOLE:
            raise InputError(
                f"plant {self.name!r} is discrete-time with step {self.step:g} s: it cannot advance from "
                f"t = {now.t:g} to {t:g}. Choose monitoring step, sampling times and disturbance interval as multiples "
                "of the step"
            )
        x = now.x
        for k in range(steps):
            u = u0 + (u1 - u0) * k / steps
            x = vector_of(self.model.dynamics(now.t + k * self.step, x, u, w, self._p))
        self._now = _Moment(t, x) if steps else now

    def state(self) -> Array:
        """Return the true state now."""
        return started(self).x

    def output(self, u: Array, w: Array) -> Array:
        """Return h(t, x, u, w, p) now."""
        now = started(self)
        return vector_of(self.model.output(now.t, now.x, u, w, self._p))

    def checkpoint(self) -> object:
        """Return time and state."""
        return started(self)

    def restore(self, checkpoint: Any) -> None:
        """Return to a checkpoint."""
        self._now = checkpoint

    def close(self) -> None:
        """Do nothing: the plant holds memory of this process only."""


def rebuilt(model: Model, rtol: float, atol: float, backend: str | None) -> OdePlant:
    """Return a plant of this configuration."""
    return OdePlant(model, rtol=rtol, atol=atol, backend=backend)


def as_plant(plant: Plant | Model) -> Plant:
    """Return a plant, wrapping a model: `OdePlant` in continuous time, `MapPlant` in discrete time."""
    if hasattr(plant, "advance") and hasattr(plant, "checkpoint"):
        return plant  # type: ignore[return-value]
    if hasattr(plant, "dynamics") and hasattr(plant, "step"):
        return OdePlant(plant) if plant.step is None else MapPlant(plant)  # type: ignore[union-attr, arg-type]
    raise InputError(f"plant must be a plant (OdePlant, MapPlant, FmuPlant) or a model, got {type(plant).__name__}")


def start_state(model: Model, x: Array | None) -> Array:
    """Return the state that a plant starts in: `x`, or the model's own (`x_start` of an FMU)."""
    own = getattr(model, "x_start", None)
    if x is None and own is None:
        raise InputError(f"plant {model.name!r} has no start state of its own; give truth= ({', '.join(model.x)})")
    return model.x.vector(own if x is None else x, "truth")


def driving_disturbances(model: Model) -> np.ndarray:
    """Return which disturbances enter f, (nw,) bool; all where that cannot be told from the expressions."""
    if not model.dynamics.is_a("SXFunction") or not len(model.w):
        return np.ones(len(model.w), dtype=bool)
    pattern = ca.DM(model.dynamics.jac_sparsity(0, 3), 1)
    return np.atleast_1d(np.any(np.asarray(pattern), axis=0))


def started(plant: OdePlant | MapPlant) -> _Moment:
    """Return where a plant is, or raise when it was never started."""
    if plant._now is None:
        raise InputError(f"plant {plant.name!r} was not started; call start(t, x)")
    return plant._now


def vector_of(value: Any) -> Array:
    """Return a CasADi column as a vector."""
    return np.asarray(value, dtype=float).reshape(-1)
