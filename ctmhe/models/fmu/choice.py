"""Which variables of an FMU make up a model, and what that means for its evaluator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.errors import FmuBinaryError, FmuKindError, FmuParameterError, FmuUnsupportedError, InputError
from ctmhe.models.fmu.description import (
    CO_SIMULATION,
    MODEL_EXCHANGE,
    Description,
    Variable,
    library_suffix,
    platform_folder,
    signals_of,
)
from ctmhe.models.fmu.evaluators import Worker
from ctmhe.models.fmu.functions import REACH
from ctmhe.models.signals import Signals

Names = Iterable[str] | str | None


@dataclass(frozen=True)
class Choice:
    """The variables behind the signals of a model.

    Attributes
    ----------
    about : Description
    kind : str
        `ModelExchange` or `CoSimulation`.
    step : float or None
        Of co-simulation, seconds.
    states, inputs, outputs, parameters : tuple of Variable
        x, u, y and p; an output may be a state.
    disturbed : tuple of Variable
        States (w adds to their derivatives, or to the next state) and inputs (w adds to their values), in the order
        of w.
    noisy : tuple of Variable
        Outputs that w adds to, behind them.
    values : mapping name -> value
        Start values other than the FMU's own.
    """

    about: Description
    kind: str
    step: float | None
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    disturbed: tuple[Variable, ...]
    noisy: tuple[Variable, ...]
    values: Mapping[str, float]

    @property
    def exchange(self) -> bool:
        """Model exchange rather than co-simulation."""
        return self.kind == MODEL_EXCHANGE

    @property
    def driven(self) -> tuple[Variable, ...]:
        """The FMU's inputs that are set: those of u, then those that are only disturbed."""
        extra = (v for v in self.disturbed if v not in self.states and v not in self.inputs)
        return (*self.inputs, *extra)

    @property
    def read_at_start(self) -> list[Variable]:
        """Variables whose values after initialization are wanted: states, driven inputs, parameters."""
        return [*self.states, *self.driven, *self.parameters]

    def signals(self) -> dict[str, Signals]:
        """Return the signals x, u, w, p, y."""
        process = [
            signals_of("w", [v], "w_", per_second=self.exchange and v in self.states) for v in self.disturbed
        ] + [signals_of("v", self.noisy, "v_")]
        w = Signals.of(
            "disturbance",
            [name for part in process for name in part.names],
            {name: unit for part in process for name, unit in zip(part.names, part.units, strict=True)},
            {name: size for part in process for name, size in zip(part.names, part.nominal, strict=True)},
        )
        return {
            "x": signals_of("state", self.states),
            "u": signals_of("input", self.inputs),
            "w": w,
            "p": signals_of("parameter", [replace(v, nominal=magnitude(v)) for v in self.parameters]),
            "y": signals_of("output", self.outputs),
        }

    def configuration(self, folder: Path, base: Sequence[float] | None = None) -> dict[str, Any]:
        """Return the fields of `worker.Configuration`; `base` are values of the driven inputs without u and w."""
        about, driven = self.about, self.driven
        states, outputs = list(self.states), list(self.outputs)
        at = {v.name: i for i, v in enumerate(driven)}
        w = {v.name: i for i, v in enumerate(self.disturbed)}
        nx, nw = len(states), len(self.disturbed) + len(self.noisy)
        none = [-1] * len(self.disturbed)
        rates = {x.name: dx for x, dx in zip(about.states, about.derivatives, strict=True)}
        settable = {name: v for name, v in self.values.items() if about.variables[name].settable}
        interface = about.kinds[self.kind]
        resources = folder / "resources"
        place = {v.reference: i for i, v in enumerate(states)}
        known = [v.causality == "output" or v.reference in place for v in outputs]
        return {
            "library": str(binary(about, folder, self.kind)),
            "name": about.name or "fmu",
            "token": about.token,
            "complaints": list(about.complaints),
            "complaint_count": len(about.complaints),
            "resources": resources.as_uri() if about.major == 2 else f"{resources}/",
            "version": about.major,
            "co_simulation": int(not self.exchange),
            "nx": nx,
            "nu": len(self.inputs),
            "nw": nw,
            "np": len(self.parameters),
            "ny": len(outputs),
            "inputs": len(driven),
            "starts": len(settable),
            "x": [v.reference for v in states],
            "dx": [(rates[v.name] if self.exchange else v).reference for v in states],
            "input": [v.reference for v in driven],
            "p": [v.reference for v in self.parameters],
            "y": [v.reference for v in outputs],
            "start": [about.variables[name].reference for name in settable],
            "start_value": list(settable.values()),
            "input_base": [v.start or 0.0 for v in driven] if base is None else list(base),
            "input_u": [i if i < len(self.inputs) else -1 for i in range(len(driven))],
            "input_w": [w.get(v.name, -1) for v in driven],
            "w_state": [-1 if v.name in at else states.index(v) for v in self.disturbed] + [-1] * len(self.noisy),
            "w_output": none + [outputs.index(v) for v in self.noisy],
            "y_state": [place.get(v.reference, -1) for v in outputs],
            "x_size": [v.nominal for v in states],
            "input_size": [magnitude(v) for v in driven],
            "p_size": [magnitude(v) for v in self.parameters],
            "start_time": about.start_time or 0.0,
            "step": self.step or 0.0,
            "p_in_event_mode": 0,
            # the standards let discrete inputs change there only
            "inputs_in_event_mode": int(self.exchange and any(v.variability == "discrete" for v in driven)),
            "directional": int(self.exchange and interface.directional_derivatives),
            "reach": REACH,
            # only by states and continuous inputs may directional derivatives be asked, parameters are tried,
            "differenced": [0] * nx + [int(v.variability == "discrete") for v in driven] + [0] * len(self.parameters),
            # and only of outputs and derivatives may directional derivatives be asked
            "rows_differenced": [0] * nx + [int(not k) for k in known],
        }


def magnitude(variable: Variable) -> float:
    """Return the typical size of an input or parameter: its nominal, or without one the size of its start value."""
    return abs(variable.start) if variable.nominal == 1.0 and variable.start else variable.nominal


def binary(about: Description, folder: Path, kind: str) -> Path:
    """Return an FMU's library for this platform, or raise `FmuBinaryError` saying what there is."""
    name = f"{about.kinds[kind].identifier}{library_suffix()}"
    wanted = f"binaries/{platform_folder(about.major)}/{name}"
    path = folder / wanted
    if not path.is_file():
        there = ", ".join(about.platforms) or "none"
        remedy = (
            "it has C sources: compile them with 'ctmhe fmu build'"
            if about.sources.get(kind)
            else "export it for this platform"
        )
        raise FmuBinaryError(f"{about.name} has no {wanted} (platforms with binaries: {there}); {remedy}")
    return path


def choose(
    about: Description,
    *,
    kind: str | None,
    step: float | None,
    states: Names,
    inputs: Names,
    outputs: Names,
    parameters: Names,
    disturbances: Names,
    output_noise: bool,
    start: Mapping[str, float],
) -> Choice:
    """Return the choice that the arguments of `FmuModel` mean.

    Raises
    ------
    FmuKindError, FmuUnsupportedError, FmuParameterError
        The FMU cannot serve an estimator like that.
    InputError
        A name is unknown, or an argument does not fit.
    """
    kind = model_kind(about, kind, step)
    check_supported(about)
    exchange = kind == MODEL_EXCHANGE
    reals = tuple(v for v in about.variables.values() if v.causality != "independent")
    if exchange and states is not None:
        raise InputError(f"{about.name}: states= is for co-simulation; model exchange has its own: leave it out")
    chosen_states = about.states if states is None else about.select("state", states, reals)
    if not chosen_states:
        which = "continuous states" if exchange else "continuous states in its description; name them with states=[...]"
        raise FmuUnsupportedError(f"{about.name} has no {which}, so there is nothing to estimate")
    readable = {v.name: v for v in (*about.outputs, *chosen_states, *reals)}
    chosen_outputs = about.outputs if outputs is None else about.select("output", outputs, tuple(readable.values()))
    if not chosen_outputs:
        raise FmuUnsupportedError(
            f"{about.name} has no real output; name what is measured: outputs=[{chosen_states[0].name!r}]"
        )
    chosen_parameters = about.select("parameter", parameters, about.parameters)
    for parameter in chosen_parameters:
        if parameter.variability != "tunable":
            raise FmuParameterError(
                f"{about.name}: parameter {parameter.name!r} is {parameter.variability}, only tunable parameters can "
                f"be estimated; set it with start={{{parameter.name!r}: ...}}, or export the FMU with it tunable"
            )
    known = {v.name: v for v in (*chosen_states, *about.inputs, *chosen_outputs)}
    named = chosen_states if disturbances is None else about.select("disturbance", disturbances, tuple(known.values()))
    disturbed = tuple(v for v in named if v in chosen_states or v in about.inputs)
    noisy = chosen_outputs if output_noise else tuple(v for v in named if v not in disturbed)
    return Choice(
        about,
        kind,
        step,
        tuple(chosen_states),
        about.select("input", inputs, about.inputs),
        tuple(chosen_outputs),
        chosen_parameters,
        disturbed,
        noisy,
        start_values(about, start, chosen_states),
    )


def probe(about: Description, folder: Path, kind: str, values: Mapping[str, float] | None = None) -> None:
    """Load and initialize an FMU in a process of its own.

    Raises
    ------
    FmuBinaryError
        It crashes there, refuses, or hangs.
    """
    bare = Choice(about, kind, None, (), (), (), (), (), (), values or {})
    Worker(bare.configuration(folder), []).close()


def model_kind(about: Description, kind: str | None, step: float | None) -> str:
    """Return the kind an estimator uses, or raise `FmuKindError`."""
    if kind is None:
        kind = MODEL_EXCHANGE if MODEL_EXCHANGE in about.kinds and step is None else CO_SIMULATION
    check_kind(about, kind)
    if kind == MODEL_EXCHANGE:
        if step is not None:
            raise InputError("step= is for co-simulation; the integrator of model exchange is the estimator's")
        return kind
    if not about.kinds[kind].get_set_state:
        raise FmuKindError(
            f"{about.name} offers co-simulation, but cannot save and restore its state (canGetAndSetFMUstate): an "
            "estimator has to go back. Export it as model exchange, or use it as the plant (FmuPlant)"
        )
    if step is None:
        raise FmuKindError(
            f"{about.name} offers co-simulation only: an estimator can use it as a step map in discrete time; say "
            "step=... (seconds). For continuous time export it as model exchange"
        )
    if not (np.isfinite(step) and step > 0):
        raise InputError(f"step must be a positive number of seconds, got {step}")
    fixed = about.kinds[kind].fixed_step or about.step
    if not about.kinds[kind].variable_step and fixed and abs(step - fixed) > 1e-9 * fixed:
        raise FmuKindError(
            f"{about.name} takes communication steps of {fixed:g} s only: say step={fixed:g}, not {step:g}"
        )
    return kind


def check_kind(about: Description, kind: str, whose: str = "") -> None:
    """Raise `InputError` for what is no kind, `FmuKindError` for one that the FMU does not offer."""
    if kind not in (MODEL_EXCHANGE, CO_SIMULATION):
        raise InputError(f"{whose}kind must be {MODEL_EXCHANGE!r} or {CO_SIMULATION!r}, got {kind!r}")
    if kind not in about.kinds:
        raise FmuKindError(f"{about.name} does not offer {kind}; it offers {', '.join(about.kinds) or 'neither kind'}")


def check_supported(about: Description) -> None:
    """Raise `FmuUnsupportedError` for arrays and structural parameters."""
    for name, what in about.unsupported.items():
        raise FmuUnsupportedError(
            f"{about.name}: variable {name!r} is {what}, which is not supported; export it with scalars"
        )


def start_values(about: Description, start: Mapping[str, float], states: Sequence[Variable]) -> dict[str, float]:
    """Return checked start values by name."""
    known = tuple(v for v in about.variables.values() if v.settable or v in states)
    return finite_values(about, start, known, role="start value", label="start:")


def finite_values(
    about: Description, values: Mapping[str, float], known: Sequence[Variable], *, role: str, label: str
) -> dict[str, float]:
    """Return values of `known` variables by name; the keys may be patterns, and each value has to be finite."""
    found: dict[str, float] = {}
    for key, value in values.items():
        for variable in about.select(role, key, known):
            if not np.isfinite(value):
                raise InputError(f"{label} {variable.name!r} is {value}, not finite")
            found[variable.name] = float(value)
    return found
