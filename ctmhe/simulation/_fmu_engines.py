"""How a running FMU gets from one time to the next: integrated here, or by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from ctmhe.errors import FmuError
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, Variable
from ctmhe.models.fmu.instance import Instance, SavedState
from ctmhe.simulation import _fmu_integrators as integrators
from ctmhe.types import Array

MOST_EVENTS = 10_000  # within one advance; more means that events accumulate


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Where an engine was; `saved` is the inside of the FMU, None where it cannot tell or need not."""

    t: float
    x: Array
    next_event: float
    saved: SavedState | None


class Engine(Protocol):
    """A running FMU: `inputs` are values of the variables given when it was made."""

    method: str
    t: float

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        """Begin at `t` with start values by name; `x` holds the states among them."""
        ...

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        """Go to `t`, inputs linear from `before` to `after`, `push` (nx,) added to the derivatives."""
        ...

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        """Return variables now, with these inputs."""
        ...

    def checkpoint(self) -> Checkpoint: ...

    def restore(self, checkpoint: Checkpoint) -> None: ...

    def close(self) -> None: ...


class ModelExchange:
    """An FMU whose derivatives are integrated here, with state, time and (after each `advance`) step events.

    An integration goes on across `advance` as long as the input stays on its line and nothing happened; taking
    a checkpoint ends it, so that going on and coming back give the same numbers.
    """

    def __init__(self, description: Description, folder: Path, inputs: Sequence[Variable], rtol: float, atol: Array):
        self._about, self._folder, self._inputs = description, folder, tuple(inputs)
        self._instance: Instance | None = None
        make = integrators.Cvode if integrators.cvode_installed() else integrators.Lsoda
        self._integrator: integrators.Integrator = make(
            self._derivatives, self._indicators, description.event_indicators, rtol, atol
        )
        self.method = self._integrator.name
        self.t, self._x, self._next_event = 0.0, np.zeros(len(description.states)), np.inf
        self._line: tuple[float, Array, Array, Array] = (0.0, np.zeros(0), np.zeros(0), np.zeros(0))
        self._fresh, self._eventful = True, description.event_indicators > 0

    @property
    def instance(self) -> Instance:
        """The running instance."""
        if self._instance is None:
            raise FmuError(f"{self._about.name} has not been started, or is closed: call start first")
        return self._instance

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        self.close()
        self._instance = instance = Instance(self._about, self._folder, MODEL_EXCHANGE)
        settable = {name: value for name, value in x.items() if self._about.variables[name].settable}
        event = instance.initialize(t, {**values, **settable})
        self.t, self._x, self._next_event = t, instance.states(), event.next_time
        names = [state.name for state in self._about.states]
        for name, value in x.items():
            if name in names:
                self._x[names.index(name)] = value
        instance.set_states(self._x)
        self._line = (t, np.zeros(0), np.zeros(0), np.zeros(0))
        self._fresh, self._eventful = True, self._about.event_indicators > 0 or np.isfinite(event.next_time)

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        slope = (after - before) / (t - self.t) if t > self.t else np.zeros_like(before)
        self._follow((self.t, before, slope, push))
        for _ in range(MOST_EVENTS):
            target = min(t, self._next_event)
            happened = False
            if target - self.t > 1e-13 * max(1.0, abs(t)):
                happened = self._integrate(target)
            else:
                self.t = target
            if not happened and self._instance is not None and self.instance.interface.completed_step:
                self._place(self.t, self._x)
                happened = self.instance.completed_step()
            if happened or self.t >= self._next_event:
                self._handle_event()
            if self.t >= t:
                return
        raise FmuError(
            f"{self._about.name}: more than {MOST_EVENTS} events before t = {t}; they accumulate at {self.t}"
        )

    def _integrate(self, target: float) -> bool:
        fresh = (self.t, self._x) if self._fresh else None
        self._fresh = True  # should this fail
        try:
            self.t, self._x, rooted = self._integrator.to(target, fresh, self._next_event)
        except FmuError as error:
            told = self._about.name in str(error)
            raise FmuError(f"{'' if told else f'{self._about.name}: '}{error}") from error
        self._fresh = False
        return rooted

    def _follow(self, line: tuple[float, Array, Array, Array]) -> None:
        t, before, slope, push = line
        t0, start, old_slope, old_push = self._line
        if (
            start.shape != before.shape
            or not np.array_equal(push, old_push)
            or not (
                np.allclose(slope, old_slope, 1e-9, 1e-12) and np.allclose(before, start + old_slope * (t - t0), 1e-12)
            )
        ):
            self._fresh = True
        if self._fresh:
            self._line = line
            self._place(t, self._x)

    def _handle_event(self) -> None:
        self._place(self.t, self._x)
        event = self.instance.event()
        self._x, self._next_event = self.instance.states(), event.next_time
        self._fresh = self._eventful = True

    def _place(self, t: float, x: Array) -> None:
        t0, before, slope, _ = self._line
        self.instance.set_time(t)
        self.instance.set_states(x)
        if len(before):
            self.instance.set(self._inputs, before + slope * (t - t0))

    def _derivatives(self, t: float, x: Array) -> Array:
        if self._line[2].any():
            self._place(t, x)
        else:
            self.instance.set_time(t)
            self.instance.set_states(x)
        return self.instance.derivatives() + self._line[3]

    def _indicators(self, t: float, x: Array) -> Array:
        self._place(t, x)
        return self.instance.event_indicators()

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        self.instance.set_time(self.t)
        self.instance.set_states(self._x)
        self.instance.set(self._inputs, inputs)
        values = self.instance.get(variables)
        if len(self._line[1]):
            self._place(self.t, self._x)
        return values

    def checkpoint(self) -> Checkpoint:
        self._fresh = True
        saved = self.instance.save() if self._eventful and self.instance.interface.get_set_state else None
        return Checkpoint(self.t, self._x.copy(), self._next_event, saved)

    def restore(self, checkpoint: Checkpoint) -> None:
        if checkpoint.saved is not None:
            self.instance.load(checkpoint.saved)
        elif self._eventful:
            raise _cannot_return(self._about)
        self.t, self._x, self._next_event = checkpoint.t, checkpoint.x.copy(), checkpoint.next_event
        self._fresh = True

    def close(self) -> None:
        if self._instance is not None:
            self._instance.close()
            self._instance = None


class CoSimulation:
    """An FMU that integrates itself; inputs are held over a step at their value in its middle."""

    def __init__(self, description: Description, folder: Path, inputs: Sequence[Variable], step: float | None):
        self._about, self._folder, self._inputs = description, folder, tuple(inputs)
        self._instance: Instance | None = None
        self._fixed = not description.kinds[CO_SIMULATION].variable_step
        self._step = step or (description.step if self._fixed else None)
        if self._fixed and self._step is None:
            raise FmuError(f"{description.name} needs communication steps of one length; give it with step=")
        length = f"steps of {self._step} s" if self._step else "steps as they come"
        self.method = f"the FMU itself (co-simulation, {length})"
        self.t = 0.0

    @property
    def instance(self) -> Instance:
        """The running instance."""
        if self._instance is None:
            raise FmuError(f"{self._about.name} has not been started, or is closed: call start first")
        return self._instance

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        for name in x:
            if not self._about.variables[name].settable:
                raise FmuError(
                    f"{self._about.name}: state {name!r} is computed by the FMU and cannot be given to a "
                    "co-simulation; use kind='ModelExchange', or the FMU's own start and parameters="
                )
        self.close()
        self._instance = Instance(self._about, self._folder, CO_SIMULATION)
        self._instance.initialize(t, {**values, **x})
        self.t = t

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        start, span = self.t, t - self.t
        if span <= 1e-13 * max(1.0, abs(t)):
            return
        count = self._count(span, varying=not np.array_equal(before, after))
        for k in range(count):
            self.instance.set(self._inputs, before + (after - before) * (k + 0.5) / count)
            begin, end = start + span * k / count, start + span * (k + 1) / count
            self.instance.do_step(begin, end - begin)
            self.t = end
        self.t = t

    def _count(self, span: float, *, varying: bool) -> int:
        step = self._step
        if step is None:
            if not varying:
                return 1
            step = min(span / 10, self._about.step or np.inf)
        count = max(1, int(np.ceil(span / step - 1e-6)))
        if self._fixed and abs(span - count * step) > 1e-6 * step:
            raise FmuError(
                f"{self._about.name} takes steps of {step} s only, and {span} s is no multiple; choose monitoring "
                "and sampling times that are multiples, or give another step="
            )
        return count

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        self.instance.set(self._inputs, inputs)
        return self.instance.get(variables)

    def checkpoint(self) -> Checkpoint:
        saved = self.instance.save() if self.instance.interface.get_set_state else None
        return Checkpoint(self.t, np.zeros(0), np.inf, saved)

    def restore(self, checkpoint: Checkpoint) -> None:
        if checkpoint.saved is None:
            raise _cannot_return(self._about)
        self.instance.load(checkpoint.saved)
        self.t = checkpoint.t

    def close(self) -> None:
        if self._instance is not None:
            self._instance.close()
            self._instance = None


def _cannot_return(about: Description) -> FmuError:
    return FmuError(
        f"{about.name} cannot be brought back to an earlier time: it does not offer canGetAndSetFMUstate. Use "
        "triggers that are asked at monitoring times (no guards), or export it with that capability"
    )
