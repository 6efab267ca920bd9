"""Model exchange: an FMU whose derivatives are integrated here, with its state, time and step events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ctmhe.errors import FmuError, FmuEventError
from ctmhe.models.fmu.description import MODEL_EXCHANGE, Description, Variable
from ctmhe.models.fmu.instance import Discard, Event, Instance
from ctmhe.simulation.fmu._integrators import IntegrationError, Integrator, integrator
from ctmhe.simulation.fmu._runner import Checkpoint, Crowd, Runner, cannot_return
from ctmhe.types import Array

LISTED = 6  # states that a message shows
LEAST, MOST = 1e-30, 1e30  # what an indicator counts: never zero, and nothing that single precision cannot hold


class ModelExchange:
    """An FMU that is integrated here.

    An integration goes on across `advance` as long as the input stays on its line and nothing happened; taking a
    checkpoint ends it, so that going on and coming back give the same numbers. An input that jumps is an event, as
    FMI has it, and discrete inputs change there only. The FMU hears of every accepted step if it wants to: what it
    does then (delays, switching of states) depends on the steps. After an `advance` that fails the plant is where the
    last event was on the way, or where it was before.

    An event is due when an indicator becomes positive or stops being so: zero is no sign of its own, and an indicator
    that is zero where event mode is left is not overlooked.
    """

    def __init__(self, description: Description, folder: Path, inputs: Sequence[Variable], rtol: float, atol: float):
        self._about, self._inputs = description, tuple(inputs)
        self._interface = description.kinds[MODEL_EXCHANGE]
        self._runner = Runner(description, folder, MODEL_EXCHANGE)
        self._smooth = np.array([v.variability != "discrete" for v in self._inputs], dtype=bool)
        self._settable = [v for v, smooth in zip(self._inputs, self._smooth, strict=True) if smooth]
        self._noise = 1e-12 * np.array([v.nominal for v in self._inputs])
        self._own_nominals = np.array([state.nominal for state in description.states])
        self._rtol, self._atol = rtol, atol
        self._nominals, self._integrator = self._own_nominals, self._integrator_for(self._own_nominals)
        self.method = self._integrator.name
        self.t, self._x, self._next_event = 0.0, np.zeros(len(description.states)), np.inf
        self._positive = np.zeros(description.event_indicators, dtype=bool)
        self._held = np.zeros(len(self._inputs))  # the inputs, until there is a line
        self._line: tuple[float, Array, Array] | None = None  # from when, from where, slope
        self._push = np.zeros(len(description.states))
        self._fresh, self._eventful = True, True
        self._tried, self._refusal = (0.0, self._x), ""

    def _integrator_for(self, nominals: Array) -> Integrator:
        count, steps = self._about.event_indicators, self._interface.completed_step
        atol = self._atol * nominals
        return integrator(self._derivatives, self._indicators, count, self._rtol, atol, step_by_step=steps)

    @property
    def instance(self) -> Instance:
        """The running instance."""
        return self._runner.instance

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        settable = {name: value for name, value in x.items() if self._about.variables[name].settable}
        event = self._runner.start(t, {**values, **settable})
        self.t, self._line = t, None
        self._held = self.instance.get(self._inputs)
        self._scale(self._own_nominals)
        self._take(event)
        late = {name: value for name, value in x.items() if name not in settable}
        if late:
            names = [state.name for state in self._about.states]
            for name, value in late.items():
                self._x[names.index(name)] = value
            self._handle_event()
        self._eventful = bool(
            len(self._positive) or np.isfinite(event.next_time) or self._interface.completed_step
        ) or not all(self._smooth)

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        self._follow(t, before, after, push)
        crowd = Crowd(self.t)
        while self.t < t or self._next_event <= self.t:
            due = self._next_event <= self.t or self._go(min(t, self._next_event))
            if due:
                changed = self._handle_event()
                if crowd.grows(self.t):
                    raise self._accumulating(changed)

    def _go(self, target: float) -> bool:
        """Go to `target`, or one step when the FMU wants to hear of steps; True when an event is due."""
        if target - self.t <= 1e-13 * max(1.0, abs(target)):
            self.t = target
            return self._next_event <= self.t
        due = self._integrate(target)
        if self._interface.completed_step:
            self._place(self.t, self._x)
            due = self.instance.completed_step(self.t) or due
        return due or self._next_event <= self.t

    def _integrate(self, target: float) -> bool:
        fresh = (self.t, self._x) if self._fresh else None
        self._fresh, self._refusal = True, ""  # should this fail
        try:
            self.t, self._x, rooted = self._integrator.to(target, fresh, self._next_event)
        except IntegrationError as error:
            raise self._stuck(error.t, error.x, self._refusal or str(error)) from error
        except FmuError as error:
            raise self._stuck(*self._tried, str(error)) from error
        self._fresh = False
        return rooted

    def _stuck(self, t: float, x: Array, reason: str) -> FmuError:
        return self._runner.stuck(f"the integration stopped at t = {t:.9g}{self._shown(x)}", reason, self.t)

    def _shown(self, x: Array) -> str:
        shown = [f"{v.name} = {value:.6g}" for v, value in zip(self._about.states, x.tolist(), strict=True)]
        more = [f"and {len(x) - LISTED} more states"] if len(x) > LISTED else []
        return "".join(f", {text}" for text in [*shown[:LISTED], *more])

    def _follow(self, t: float, before: Array, after: Array, push: Array) -> None:
        slope = np.where(self._smooth, (after - before) / (t - self.t) if t > self.t else 0.0, 0.0)
        joined = np.allclose(before, self._present(self.t), 1e-9, self._noise)
        goes_on = joined and not self._fresh and self._line is not None and np.array_equal(push, self._push)
        if goes_on and self._line is not None and np.allclose(slope, self._line[2], 1e-9, self._noise):
            return
        self._line, self._push, self._fresh = (self.t, before, slope), push, True
        if joined:
            self._place(self.t, self._x)
        else:
            self._handle_event()

    def _present(self, t: float) -> Array:
        if self._line is None:
            return self._held
        t0, before, slope = self._line
        return before + slope * (t - t0)

    def _handle_event(self) -> Array:
        """Let the FMU handle an event now; return which indicators had changed their sign."""
        self._place(self.t, self._x)
        changed = self._signs() != self._positive
        self._take(self.instance.event(self.t, self._inputs, self._present(self.t)))
        return changed

    def _take(self, event: Event) -> None:
        self._x, self._next_event = self.instance.states(), event.next_time
        self._eventful = self._eventful or np.isfinite(event.next_time)
        if event.nominals_changed:
            told = np.abs(self.instance.nominals())
            self._scale(np.where(np.isfinite(told) & (told > 0.0), told, self._own_nominals))
        self._positive, self._fresh = self._signs(), True

    def _scale(self, nominals: Array) -> None:
        if not np.array_equal(nominals, self._nominals):
            self._nominals, self._integrator = nominals, self._integrator_for(nominals)
        self._fresh = True

    def _accumulating(self, changed: Array) -> FmuEventError:
        which = ", ".join(str(i + 1) for i in np.flatnonzero(changed))
        cause = f"event indicators {which} change sign again and again" if which else "time or step events repeat"
        return FmuEventError(
            f"{self._about.name}: events accumulate at t = {self.t:.9g}{self._shown(self._x)}: {cause}. Give the "
            "switching in the model a hysteresis, or let it come to rest"
        )

    def _place(self, t: float, x: Array) -> None:
        self.instance.set_time(t)
        self.instance.set_states(x)
        self.instance.set(self._settable, self._present(t)[self._smooth])

    def _derivatives(self, t: float, x: Array) -> Array:
        self._tried = t, x.copy()
        try:
            if self._line is not None and self._line[2].any():
                self._place(t, x)
            else:
                self.instance.set_time(t)
                self.instance.set_states(x)
            rates = self.instance.derivatives() + self._push
            if not np.isfinite(rates).all():
                wrong = [
                    v.name for v, rate in zip(self._about.derivatives, rates, strict=True) if not np.isfinite(rate)
                ]
                raise Discard(f"{', '.join(wrong[:LISTED])} not finite")
        except Discard as error:
            self._refusal = str(error)
            raise
        self._refusal = ""
        return rates

    def _indicators(self, t: float, x: Array) -> Array:
        self._tried = t, x.copy()
        self._place(t, x)
        values = self.instance.event_indicators()
        if not np.isfinite(values).all():
            wrong = ", ".join(str(i + 1) for i in np.flatnonzero(~np.isfinite(values)))
            raise FmuError(f"event indicators {wrong} are not finite")
        return np.where(values > 0.0, np.clip(values, LEAST, MOST), np.clip(values, -MOST, -LEAST))

    def _signs(self) -> Array:
        return self.instance.event_indicators() > 0.0

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        self._place(self.t, self._x)
        present = self._present(self.t)[self._smooth]
        if np.array_equal(inputs[self._smooth], present):
            return self.instance.get(variables)
        self.instance.set(self._settable, inputs[self._smooth])
        values = self.instance.get(variables)
        self.instance.set(self._settable, present)
        return values

    def checkpoint(self) -> Checkpoint:
        self._fresh = True
        saved = self._runner.save()
        if saved is None and self._eventful:
            raise cannot_return(self._about)
        inputs = self._present(self.t)
        return Checkpoint(self.t, self._x.copy(), inputs, saved, self._next_event, self._positive, self._nominals)

    def restore(self, checkpoint: Checkpoint) -> None:
        if checkpoint.saved is not None:
            self.instance.load(checkpoint.saved)
        self.t, self._x, self._next_event = checkpoint.t, checkpoint.x.copy(), checkpoint.next_event
        self._held, self._line, self._positive = checkpoint.inputs, None, checkpoint.positive
        self._scale(checkpoint.nominals)

    def close(self) -> None:
        self._runner.close()
