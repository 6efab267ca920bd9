"""FMUs on paper: their equations are Python, and they refuse every call that the standard does not allow."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

OK, DISCARD, ERROR, FATAL = 0, 2, 3, 4
USUAL = {"modelIdentifier": "paper", "canHandleVariableCommunicationStepSize": "true"}


class Refusal(Exception):
    """What fmpy raises when a call returns a status that is not OK."""

    def __init__(self, status: int, function: str = "paper"):
        super().__init__(f"{function} failed with status {status}")
        self.status, self.function = status, function


@dataclass
class Paper:
    """A model. Its functions get `m` with t, x (by name), v (inputs, parameters, discrete variables by name).

    `update` is a round of the event iteration and returns any of again, terminate, nominals, states (flags), next (a
    time); `completed` whether a step asks for an event and for the end; `step` goes on by a length (co-simulation) and
    returns any of event, terminate, early (flags), setting m.t itself when early. `offers` are attributes in XML.
    """

    states: dict[str, float] = field(default_factory=dict)
    inputs: dict[str, float] = field(default_factory=dict)
    sampled: tuple[str, ...] = ()  # inputs that are discrete
    parameters: dict[str, float] = field(default_factory=dict)
    discretes: dict[str, float] = field(default_factory=dict)
    outputs: Callable[[Any], dict[str, float]] = lambda m: {}
    named: tuple[str, ...] = ()  # outputs
    rates: Callable[[Any], dict[str, float]] = lambda m: dict.fromkeys(m.x, 0.0)
    indicators: int = 0
    indicate: Callable[[Any], list[float]] = lambda m: []
    update: Callable[[Any], dict[str, Any]] = lambda m: {}
    nominals: Callable[[Any], list[float]] = lambda m: [1.0] * len(m.x)
    completed: Callable[[Any], tuple[bool, bool]] = lambda m: (False, False)
    step: Callable[[Any, float], dict[str, Any]] | None = None  # Euler's when left out
    offers: dict[str, str] = field(default_factory=dict)
    kinds: tuple[str, ...] = ("ModelExchange", "CoSimulation")

    def go(self, m: Any, length: float) -> dict[str, Any]:
        """Make a communication step."""
        if self.step is not None:
            return self.step(m, length)
        m.x = {name: m.x[name] + length * rate for name, rate in self.rates(m).items()}
        return {}


class Machine:
    """An instance as fmpy offers it, of either version and kind."""

    def __init__(self, model: Paper, co_simulation: bool, journal: SimpleNamespace, **_identity: str):
        self.model, self.co_simulation, self.journal = model, co_simulation, journal
        self.m = SimpleNamespace(t=0.0, x=dict(model.states), v={**model.inputs, **model.parameters, **model.discretes})
        self.m.slopes = {}
        self.mode, self.component = "made", 1
        self.names = [*model.states, *(f"der({x})" for x in model.states), *self.m.v, *model.named]
        self.event_mode = not co_simulation

    def instantiate(self, callbacks=None, logMessage=None, eventModeUsed=False, earlyReturnAllowed=False):
        assert self.journal.alive == 0 or not self.model.offers.get("canBeInstantiatedOnlyOncePerProcess")
        self.journal.alive += 1
        self.journal.made += 1
        self.event_mode = self.event_mode or eventModeUsed

    def need(self, *modes):
        if self.mode not in modes:
            raise Refusal(ERROR, f"this call in mode {self.mode}")

    # ---- values

    def set_real(self, _component, references, count, values, _count=None):
        for reference, value in zip(references, values, strict=True):
            name = self.names[reference]
            if name in self.model.sampled and self.event_mode:
                self.need("made", "initialization", "event")
            elif name in self.model.states:
                self.need("made", "initialization")
            (self.m.x if name in self.m.x else self.m.v)[name] = value

    def get_real(self, _component, references, count, values, _count=None):
        known = {**self.m.x, **self.m.v, **self.model.outputs(self.m)}
        for i, reference in enumerate(references):
            values[i] = known[self.names[reference]]

    fmi2SetReal = fmi3SetFloat64 = set_real
    fmi2GetReal = fmi3GetFloat64 = get_real

    # ---- modes

    def setupExperiment(self, tolerance, t):
        self.m.t = t

    def enterInitializationMode(self, tolerance=None, t=None):
        self.need("made")
        self.mode, self.m.t = "initialization", self.m.t if t is None else t

    def exitInitializationMode(self):
        self.need("initialization")
        self.mode = "event" if self.event_mode else "step"

    def enterEventMode(self):
        self.need("continuous", "step")
        assert self.event_mode
        self.mode = "event"
        self.journal.events.append(self.m.t)

    def newDiscreteStates(self):
        self.need("event")
        told = {"again": False, "terminate": False, "nominals": False, "states": False, "next": None}
        told |= self.model.update(self.m)
        flags = [told[name] for name in ("again", "terminate", "nominals", "states")]
        return *flags, told["next"] is not None, told["next"] or 0.0

    updateDiscreteStates = newDiscreteStates

    def enterContinuousTimeMode(self):
        self.need("event")
        self.mode = "continuous"

    def enterStepMode(self):
        self.need("event")
        self.mode = "step"

    def terminate(self):
        self.mode = "terminated"

    # ---- model exchange

    def setTime(self, t):
        self.need("continuous")
        self.m.t = t

    def setContinuousStates(self, values, count):
        self.need("continuous")
        assert count > 0
        self.m.x = dict(zip(self.m.x, values, strict=True))

    def getContinuousStates(self, values, count):
        values[:] = list(self.m.x.values())

    def getDerivatives(self, values, count):
        values[:] = list(self.model.rates(self.m).values())

    getContinuousStateDerivatives = getDerivatives

    def getEventIndicators(self, values, count):
        values[:] = self.model.indicate(self.m)

    def getNominalsOfContinuousStates(self, values, count):
        values[:] = self.model.nominals(self.m)

    def completedIntegratorStep(self, final):
        self.need("continuous")
        self.journal.steps.append((self.m.t, dict(self.m.x)))
        return self.model.completed(self.m)

    # ---- co-simulation

    def doStep(self, t, length, final):
        self.need("step")
        assert abs(t - self.m.t) < 1e-12, "the communication time is where the FMU is"
        self.journal.steps.append((t, length))
        answer = self.model.go(self.m, length)
        if not answer.get("early"):
            self.m.t = t + length
        return answer

    def fmi3DoStep(self, _component, t, length, final, event, terminate, early, last):
        answer = {}
        try:
            answer = self.doStep(t, length, final)
        finally:
            for flag, name in ((event, "event"), (terminate, "terminate"), (early, "early")):
                flag._obj.value = answer.get(name, False)
            last._obj.value = self.m.t

    def setRealInputDerivatives(self, references, orders, values):
        self.m.slopes = {self.names[r]: value for r, value in zip(references, values, strict=True)}

    def getRealStatus(self, kind):
        return self.m.t

    def getBooleanStatus(self, kind):
        return self.m.v.get("ended", 0.0) > 0.0

    # ---- state and end

    def getFMUState(self):
        self.journal.saved += 1
        return SimpleNamespace(mode=self.mode, m=copy.deepcopy(self.m))

    def setFMUState(self, state):
        self.mode, self.m = state.mode, copy.deepcopy(state.m)

    def freeFMUState(self, state):
        self.journal.saved -= 1

    def freeInstance(self):
        self.journal.alive -= 1

    def freeLibrary(self):
        pass


def description(model: Paper, version: int) -> str:
    """modelDescription.xml of a model."""
    variables = []
    rows = [(name, "local", "continuous", start) for name, start in model.states.items()]
    rows += [(f"der({name})", "local", "continuous", None) for name in model.states]
    rows += [(n, "input", "discrete" if n in model.sampled else "continuous", s) for n, s in model.inputs.items()]
    rows += [(name, "parameter", "tunable", start) for name, start in model.parameters.items()]
    rows += [(name, "local", "discrete", start) for name, start in model.discretes.items()]
    rows += [(name, "output", "continuous", None) for name in model.named]
    nx = len(model.states)
    for i, (name, causality, variability, start) in enumerate(rows):
        initial = 'initial="exact"' if start is not None and causality != "input" else ""
        value = "" if start is None else f'start="{start!r}"'
        derivative = f'derivative="{i - nx + (version == 2)}"' if name.startswith("der(") else ""
        common = f'name="{name}" valueReference="{i}" causality="{causality}" variability="{variability}" {initial}'
        if version == 2:
            variables.append(f"<ScalarVariable {common}><Real {value} {derivative}/></ScalarVariable>")
        else:
            variables.append(f"<Float64 {common} {value} {derivative}/>")
    offers = " ".join(f'{name}="{value}"' for name, value in (USUAL | model.offers).items())
    kinds = "".join(f"<{kind} {offers}/>" for kind in model.kinds)
    if version == 2:
        head = f'fmiVersion="2.0" guid="paper" numberOfEventIndicators="{model.indicators}"'
        unknowns = "".join(f'<Unknown index="{nx + i + 1}"/>' for i in range(nx))
        structure = f"<Derivatives>{unknowns}</Derivatives>" if nx else ""
    else:
        head = 'fmiVersion="3.0" instantiationToken="paper"'
        structure = "".join(f'<ContinuousStateDerivative valueReference="{nx + i}"/>' for i in range(nx))
    return (
        f'<fmiModelDescription modelName="paper" {head}>{kinds}<ModelVariables>{"".join(variables)}</ModelVariables>'
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )
