"""The FMU as fmpy runs it, one fresh instance a question: what evaluators are held to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ctmhe.models.fmu.choice import Choice
from ctmhe.models.fmu.instance import Instance
from ctmhe.types import Array


class Reference:
    """Evaluations that pass through none of our own code for estimators.

    Parameters
    ----------
    choice : Choice
    folder : Path
        Where the FMU is unpacked.
    """

    def __init__(self, choice: Choice, folder: Path):
        self._choice, self._folder = choice, folder

    def evaluate(self, t: float, x: Array, u: Array, p: Array) -> tuple[Array, Array]:
        """Return (dx/dt or the states one step later, outputs); parameters are set before the initialization."""
        choice, about = self._choice, self._choice.about
        inputs = dict(zip([v.name for v in choice.inputs], u, strict=True))
        given = dict(choice.values) | dict(zip([v.name for v in choice.parameters], p, strict=True))
        instance = Instance(about, self._folder, choice.kind)
        try:
            if choice.exchange:
                instance.initialize(about.start_time or 0.0, self._settable(given))
                instance.set_time(t)
                instance.set_states(x)
                if any(v.variability == "discrete" for v in choice.inputs):
                    instance.event(t, choice.inputs, u)
                    instance.set_states(x)  # which an event may change
                else:
                    instance.set(choice.inputs, u)
                return instance.derivatives(), instance.get(choice.outputs)
            states = dict(zip([v.name for v in choice.states], x, strict=True))
            instance.initialize(t, self._settable(given | states | inputs))
            instance.set(choice.inputs, u)
            y = instance.get(choice.outputs)
            instance.do_step(t, choice.step or 0.0)
            return instance.get(choice.states), y
        finally:
            instance.close()

    def _settable(self, values: Mapping[str, float]) -> dict[str, float]:
        return {name: value for name, value in values.items() if self._choice.about.variables[name].settable}
