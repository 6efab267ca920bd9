"""Co-simulation: an FMU that integrates itself from one communication time to the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ctmhe.errors import FmuError, FmuEventError
from ctmhe.models.fmu.description import CO_SIMULATION, Description, Variable
from ctmhe.models.fmu.instance import Discard, Instance
from ctmhe.simulation.fmu._runner import Checkpoint, Crowd, Runner, cannot_return
from ctmhe.types import Array

SHORTEST = 2.0**-10  # of a communication step, when the FMU discards longer ones


EXPERIMENT = 500  # steps that the default experiment takes when it does not say


class CoSimulation:
    """An FMU that integrates itself.

    An input that varies is held over a communication step at its value in the middle, or handed over with its slope
    where the FMU takes slopes (FMI 2). The FMU may return early, at an event or before what it cannot compute; it goes
    on from there. A step that it discards is tried again with half the length. With FMI 3's event mode an input that
    jumps is an event, too.
    """

    def __init__(self, description: Description, folder: Path, inputs: Sequence[Variable], step: float | None):
        self._about, self._inputs = description, tuple(inputs)
        self._interface = description.kinds[CO_SIMULATION]
        self._runner = Runner(description, folder, CO_SIMULATION)
        self._fixed = not self._interface.variable_step
        self._step = step or ((self._interface.fixed_step or description.step) if self._fixed else None)
        if self._fixed and self._step is None:
            raise FmuError(f"{description.name} needs communication steps of one length; give it with step=")
        # FMUs that integrate with one step each communication step (explicit Euler in some tools) need short ones
        span = (description.stop_time or 0.0) - (description.start_time or 0.0)
        self._longest = description.step or (span / EXPERIMENT if span > 0 else np.inf)
        if self._step:
            length = f"steps of {self._step} s"
        else:
            length = f"steps of at most {self._longest:g} s" if self._longest < np.inf else "steps as they come"
        self.method = f"the FMU itself (co-simulation, {length})"
        self.t, self._held = 0.0, np.zeros(len(self._inputs))
        events = description.major > 2 and self._interface.event_mode  # then discrete inputs change in event mode only
        self._free = np.array([not events or v.variability != "discrete" for v in self._inputs], dtype=bool)
        self._settable = [v for v, free in zip(self._inputs, self._free, strict=True) if free]

    @property
    def instance(self) -> Instance:
        """The running instance."""
        return self._runner.instance

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        for name in x:
            if not self._about.variables[name].settable:
                raise FmuError(
                    f"{self._about.name}: state {name!r} is computed by the FMU and cannot be given to a "
                    "co-simulation; use kind='ModelExchange', or the FMU's own start and parameters="
                )
        self._runner.start(t, {**values, **x})
        self.t, self._held = t, self.instance.get(self._inputs)

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        begin, span = self.t, t - self.t
        if span <= 1e-13 * max(1.0, abs(t)):
            return
        count = self._count(span, varying=not np.array_equal(before, after))
        if self.instance.event_mode and not np.array_equal(before, self._held):
            self.instance.event(self.t, self._inputs, before)
        slope = (after - before) / span
        self._held = np.where(self._free, after, before)
        for k in range(count):
            end = t if k == count - 1 else begin + span * (k + 1) / count
            if not self._interface.input_derivatives:
                self._set(before + (after - before) * (k + 0.5) / count)
            self._go(end, before + slope * (self.t - begin), slope)

    def _go(self, end: float, value: Array, slope: Array) -> None:
        """Go to `end`; an FMU that takes slopes starts from the input `value`."""
        begin = self.t
        whole = length = self._step if self._fixed and self._step else end - begin
        crowd = Crowd(begin)
        while self.t < end:
            rest = end - self.t
            length = whole if self._fixed else min(length, rest)
            if self._interface.input_derivatives and self._inputs:
                self.instance.set(self._inputs, value + slope * (self.t - begin))
                self.instance.set_slopes(self._inputs, slope)
            try:
                step = self.instance.do_step(self.t, length)
            except FmuEventError:
                raise
            except FmuError as error:
                length /= 2.0
                if isinstance(error, Discard) and not self._fixed and length >= SHORTEST * whole:
                    continue
                what = f"the step to t = {end:.9g} stopped at t = {self.t:.9g}"
                raise self._runner.stuck(what, str(error), self.t) from error
            stayed = step.t <= self.t
            self.t = end if end - step.t <= 1e-12 * max(1.0, abs(end), whole) else max(self.t, step.t)
            if step.event:
                self.instance.event(self.t)
            if (step.event or stayed) and crowd.grows(self.t):
                raise FmuEventError(
                    f"{self._about.name}: events accumulate at t = {self.t:.9g}: it returns early again and again. "
                    "Give the switching in the model a hysteresis, or let it come to rest"
                )
            length *= 2.0

    def _count(self, span: float, *, varying: bool) -> int:
        step = self._step
        if step is None:
            step = self._longest
            if varying and not self._interface.input_derivatives:
                step = min(step, span / 10)
        count = max(1, int(np.ceil(span / step - 1e-6)))
        if self._fixed and abs(span - count * step) > 1e-6 * step:
            raise FmuError(
                f"{self._about.name} takes steps of {step} s only, and {span} s is no multiple; choose monitoring "
                "and sampling times that are multiples, or give another step="
            )
        return count

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        self._set(inputs)
        return self.instance.get(variables)

    def _set(self, values: Array) -> None:
        self.instance.set(self._settable, values[self._free])

    def checkpoint(self) -> Checkpoint:
        saved = self._runner.save()
        if saved is None:
            raise cannot_return(self._about)
        nothing = np.zeros(0)
        return Checkpoint(self.t, nothing, self._held, saved, np.inf, nothing, nothing)

    def restore(self, checkpoint: Checkpoint) -> None:
        assert checkpoint.saved is not None
        self.instance.load(checkpoint.saved)
        self.t, self._held = checkpoint.t, checkpoint.inputs

    def close(self) -> None:
        self._runner.close()
