"""FMUs as models: FMI 2.0 and 3.0 model exchange, evaluated and differentiated by CasADi."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.errors import FmuError, InputError
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, Variable, signals_of
from ctmhe.models.fmu.functions import FmuFunctions
from ctmhe.models.fmu.reading import read_description
from ctmhe.models.fmu.truth import Choice, Reference, check
from ctmhe.models.signals import Signals
from ctmhe.types import Bounds, frozen


class FmuModel:
    """dx/dt = f(t, x, u, p) + w, y = h(t, x, u, p) (+ v) of a model-exchange FMU: thesis (3.7), with p.

    The archive is unpacked into a private temporary folder that lives as long as the model, or until `close`.
    Pickles as its configuration: path, hash of the file's contents, arguments.

    Parameters
    ----------
    path : str or Path
        The .fmu file, FMI 2.0 or 3.0 with model exchange.
    inputs : sequence of str, optional
        Inputs that become `u`; all when left out. The others keep their start values.
    outputs : sequence of str, optional
        Outputs, or states, that become `y`; all outputs when left out.
    parameters : sequence of str
        Tunable parameters that become `p`. The others keep their values.
    disturbances : sequence of str, optional
        States whose derivatives a disturbance `w_<state>` is added to; all when left out.
    output_noise : bool
        Whether `w` also holds a `v_<output>` added to each output.
    start : mapping name -> value, optional
        Values of states, inputs and parameters to start with instead of the FMU's own.
    allow_frozen_events : bool
        Accept an FMU with events; its discrete variables then stay as they are after initialization.

    Attributes
    ----------
    x, u, w, p, y : Signals
        Units and nominals are the FMU's; those of `w_<state>` are per second.
    dynamics, output : casadi.Function
        Of (t, x, u, w, p). The derivative with respect to t is a finite difference.
    x_start, u_start, p_start : array (nx,), (nu,), (np,)
        Values after initialization.
    description : Description
    exact_derivatives : bool
        The FMU computes directional derivatives; otherwise Jacobians are central differences.
    single_instance : bool
        The FMU allows one instance per process (`canBeInstantiatedOnlyOncePerProcess`): no threads.

    Raises
    ------
    FmuError
        If the FMU cannot be unpacked, read, loaded or evaluated, has no model exchange or no states, has events,
        or if CasADi's values or Jacobians differ from the FMU's own; the message names the variable.
    InputError
        If a name is unknown; the message suggests the nearest.
    """

    step: float | None = None

    def __init__(
        self,
        path: str | Path,
        *,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        parameters: Sequence[str] = (),
        disturbances: Sequence[str] | None = None,
        output_noise: bool = False,
        start: Mapping[str, float] | None = None,
        allow_frozen_events: bool = False,
    ):
        self._arguments: dict[str, Any] = {
            "inputs": inputs,
            "outputs": outputs,
            "parameters": parameters,
            "disturbances": disturbances,
            "output_noise": output_noise,
            "start": dict(start or {}),
            "allow_frozen_events": allow_frozen_events,
        }
        self._archive = Unpacked(path)
        self.path = self._archive.path
        try:
            self._build(disturbances, output_noise)
        except BaseException:
            self.close()
            raise

    def _build(self, disturbances: Sequence[str] | None, output_noise: bool) -> None:
        self.description = about = read_description(self._archive.folder)
        self.name, self.bounds = about.name, Bounds()
        check_suitable(about)
        self.exact_derivatives = about.kinds[MODEL_EXCHANGE].directional_derivatives
        self.single_instance = about.kinds[MODEL_EXCHANGE].single_instance

        inputs, outputs, parameters = self._select(about)
        values = start_values(about, self._arguments["start"])
        disturbed = about.select("state", disturbances, about.states)
        noisy = outputs if output_noise else ()
        self.x, self.u = signals_of("state", about.states), signals_of("input", inputs)
        self.p, self.y = signals_of("parameter", parameters), signals_of("output", outputs)
        self.w = disturbance_signals(disturbed, noisy)

        reference = Reference(about, self._archive.folder, values)
        event, starts = reference.start(about.states, inputs, parameters)
        check_events(about, event, allowed=self._arguments["allow_frozen_events"])
        self.x_start, self.u_start, self.p_start = (frozen(start) for start in starts)

        none = np.zeros
        functions = FmuFunctions(
            self._archive.folder,
            about,
            inputs=inputs,
            outputs=outputs,
            parameters=parameters,
            values=values,
            entry=np.hstack([incidence(about.states, disturbed), none((len(self.x), len(noisy)))]),
            exit=np.hstack([none((len(self.y), len(disturbed))), incidence(outputs, noisy)]),
        )
        choice = Choice(inputs, outputs, parameters, self.x_start, self.u_start, self.p_start)
        check(about, reference, functions, choice)
        self.dynamics, self.output = functions.create()

    def _select(self, about: Description) -> tuple[tuple[Variable, ...], ...]:
        wanted = self._arguments["outputs"]
        known = {v.name: v for v in about.outputs + (about.states if wanted is not None else ())}
        outputs = about.select("output", wanted, tuple(known.values()))
        if not outputs:
            raise FmuError(f"{about.name} has no real output; name measured states: outputs=[{about.states[0].name!r}]")
        parameters = about.select("parameter", self._arguments["parameters"], about.parameters)
        for parameter in parameters:
            if parameter.variability != "tunable":
                raise FmuError(
                    f"{about.name}: parameter {parameter.name!r} is {parameter.variability}, only tunable "
                    f"parameters can be estimated; set it with start={{{parameter.name!r}: ...}}, or export the "
                    "FMU with it tunable"
                )
        return about.select("input", self._arguments["inputs"], about.inputs), outputs, parameters

    def __repr__(self) -> str:
        rows = [f"FmuModel {self.name!r} (FMI {self.description.version}, {self.path.name})"]
        for key in "xuwpy":
            group: Signals = getattr(self, key)
            if len(group):
                labels = (f"{n} [{unit}]" if unit else n for n, unit in zip(group.names, group.units, strict=True))
                rows.append(f"  {key}: {', '.join(labels)}")
        return "\n".join(rows)

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, (str(self.path), self._archive.digest, self._arguments)

    def close(self) -> None:
        """Remove the temporary folder; the model and its functions must not be used any more."""
        self._archive.close()


def _reopen(path: str, digest: str, arguments: dict[str, Any]) -> FmuModel:
    model = FmuModel(path, **arguments)
    if model._archive.digest != digest:
        model.close()
        raise FmuError(f"{path} has changed since this model was saved; build the model again")
    return model


def check_suitable(about: Description) -> None:
    """Raise `FmuError` when an FMU cannot serve an estimator, judged by its description alone."""
    if MODEL_EXCHANGE not in about.kinds:
        has = f"{CO_SIMULATION} only" if CO_SIMULATION in about.kinds else "neither kind"
        raise FmuError(
            f"{about.name} offers {has}; an estimator needs model exchange: export it as such, or use it as the "
            "plant (FmuPlant)"
        )
    for name, what in about.unsupported.items():
        raise FmuError(f"{about.name}: variable {name!r} is {what}, which is not supported; export it with scalars")
    if not about.states:
        raise FmuError(f"{about.name} has no continuous states, so there is nothing to estimate")


def check_events(about: Description, next_time: float, *, allowed: bool) -> None:
    """Raise `FmuError` when an FMU has events and freezing them is not allowed."""
    if allowed or (about.event_indicators == 0 and not np.isfinite(next_time)):
        return
    count = about.event_indicators
    what = f"{count} event indicator{'s' * (count > 1)}" if count else f"a time event at t = {next_time}"
    raise FmuError(
        f"{about.name} has {what}; inside an estimator its discrete variables would stay frozen. If that is "
        "acceptable in the range of interest, say allow_frozen_events=True; as the plant (FmuPlant) events are handled"
    )


def start_values(about: Description, start: Mapping[str, float]) -> dict[str, float]:
    """Return checked start values by name."""
    known = tuple(v for v in about.variables.values() if v.settable or v in about.states)
    values = {}
    for name, value in start.items():
        if not np.isfinite(value):
            raise InputError(f"start: {name!r} is {value}, not finite")
        values |= {variable.name: float(value) for variable in about.select("start value", name, known)}
    return values


def disturbance_signals(disturbed: Sequence[Variable], noisy: Sequence[Variable]) -> Signals:
    """Return `w_<state>` for every disturbed state, then `v_<output>` for every noisy output."""
    process, noise = signals_of("w", disturbed, "w_", per_second=True), signals_of("v", noisy, "v_")
    nominal = frozen([*process.nominal, *noise.nominal])
    return Signals("disturbance", process.names + noise.names, process.units + noise.units, nominal)


def incidence(rows: Sequence[Variable], columns: Sequence[Variable]) -> np.ndarray:
    """Return the matrix (rows, columns) with 1 where both are the same variable."""
    return np.array([[float(row.name == column.name) for column in columns] for row in rows]).reshape(len(rows), -1)
