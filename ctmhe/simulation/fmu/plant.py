"""FMUs as plants: model exchange and co-simulation, FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ctmhe.errors import FmuError, FmuUnsupportedError, InputError
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.choice import check_kind, finite_values, probe
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, Variable, signals_of
from ctmhe.models.fmu.reading import read_description
from ctmhe.models.signals import Signals
from ctmhe.simulation.fmu._engines import Engine, Setup
from ctmhe.simulation.fmu._isolated import Isolated
from ctmhe.types import Array, Values, finite_time, frozen


class FmuPlant:
    """A plant that is an FMU.

    Model exchange is integrated here, at tight tolerances: state events are located, time events hit, and an FMU that
    wants to hear of integration steps hears of every accepted one and may ask for an event. In co-simulation the FMU
    integrates itself: an input that varies is held over each communication step at its value in the middle, an error
    of second order in `step`; FMUs of FMI 2 that take the slopes of inputs get them instead. FMI 3's event mode and
    early return are used where offered.

    An error of the FMU leaves the plant usable: at the last time that it reached where the message says so, and in any
    case for `start`. A plant can be pickled; its copy is built anew from the file, which must not have changed, and
    stands at its start.

    Parameters
    ----------
    path : str or Path
        The .fmu file, FMI 2.0 or 3.0.
    kind : {"ModelExchange", "CoSimulation"}, optional
        Model exchange where the FMU has it, when left out.
    inputs, outputs : sequence of str, optional
        Names that become `u` and `y`; all (but those in `disturbances`) when left out.
    states : sequence of str, optional
        Variables that are the true state `x`; the continuous states when left out.
    disturbances : sequence of str, optional
        Inputs, or with model exchange also states (`w_<state>` is added to the derivative). When left out: all
        states with model exchange, none with co-simulation.
    parameters : mapping name -> value, optional
        Values set at initialization; the names become `p`.
    step : float, optional
        Largest communication step in seconds (co-simulation). When left out, that of the FMU's default experiment, or
        a 500th of its duration; a varying input makes at least ten steps of every `advance`.
    rtol, atol : float
        Tolerances of the integration (model exchange); `atol` is multiplied by the states' nominals.
    isolated : bool
        Run the FMU in a process of its own. A crash or a hang is then an `FmuBinaryError`, and `start` begins again.
    timeout : float or None
        Seconds within which an isolated FMU has to answer a call; None: any time.

    Attributes
    ----------
    x, u, w, y, p : Signals
        `w` ends with a `v_<output>` for each output, which is added to it.
    integrator : str
        What integrates the plant.
    x_start, u_start : array (nx,), (nu,)
        The FMU's own start.
    description : Description

    Raises
    ------
    FmuKindError
        If the FMU does not offer `kind`.
    FmuBinaryError
        If its binary cannot be loaded or initialized.
    FmuUnsupportedError
        If states are to be disturbed in co-simulation.
    FmuError
        If it cannot be unpacked or read.
    InputError
        If a name is unknown; the message suggests the nearest.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        kind: str | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        states: Sequence[str] | None = None,
        disturbances: Sequence[str] | None = None,
        parameters: Mapping[str, float] | None = None,
        step: float | None = None,
        rtol: float = 1e-10,
        atol: float = 1e-12,
        isolated: bool = False,
        timeout: float | None = 60.0,
    ):
        for name, value in {"step": step, "timeout": timeout, "rtol": rtol, "atol": atol}.items():
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"FmuPlant: {name} must be a positive number, got {value}")
        self._archive = Unpacked(path)
        self.path = self._archive.path
        self._engine: Engine | None = None
        try:
            self.description = about = read_description(self._archive.folder)
            self.kind = chosen_kind(about, kind)
            self.name = about.name
            self._select(about, inputs, outputs, states, disturbances)
            self._parameters = plant_parameters(about, parameters or {})
            self.p = signals_of("parameter", [about.variables[name] for name in self._parameters])
            driven = (*self._inputs, *self._driven)
            if not isolated:
                probe(about, self._archive.folder, self.kind)
            setup = Setup(self.kind, about, self._archive.folder, driven, step, rtol, atol)
            self._engine = Isolated(setup, timeout) if isolated else setup.engine()
            self.integrator = self._engine.method
            self._arguments: dict[str, Any] = {
                "kind": self.kind,
                "inputs": list(self.u.names),
                "outputs": list(self.y.names),
                "states": list(self.x.names),
                "disturbances": [variable.name for variable in self._disturbed],
                "parameters": dict(self._parameters),
                "step": step,
                "rtol": rtol,
                "atol": atol,
                "isolated": isolated,
                "timeout": timeout,
            }
            self.start(0.0, None)
            self.x_start = frozen(self.state())
            self.u_start = frozen([variable.start or 0.0 for variable in self._inputs])
        except BaseException:
            self.close()
            raise

    def _select(
        self,
        about: Description,
        inputs: Sequence[str] | None,
        outputs: Sequence[str] | None,
        states: Sequence[str] | None,
        disturbances: Sequence[str] | None,
    ) -> None:
        exchange = self.kind == MODEL_EXCHANGE
        if disturbances is None:
            disturbances = [state.name for state in about.states] if exchange else []
        known = {v.name: v for v in (*about.inputs, *(about.states if exchange else ()))}
        if not exchange:
            refuse_state_kicks(about, disturbances)
        self._disturbed = disturbed = about.select(
            "disturbance (an input, or a state of model exchange)", disturbances, tuple(known.values())
        )
        if inputs is None:
            inputs = [v.name for v in about.inputs if v not in disturbed]
        self._inputs = about.select("input", inputs, about.inputs)
        for variable in self._inputs:
            if variable in disturbed:
                raise InputError(f"FmuPlant: {variable.name!r} is in both inputs and disturbances; take it out of one")
        readable = tuple(about.variables.values())
        self._outputs = about.select("output", outputs, about.outputs if outputs is None else readable)
        self._states = about.select("state", states, about.states if states is None else readable)
        self._driven = tuple(v for v in disturbed if v.causality == "input")
        self._driven_at = [i for i, v in enumerate(disturbed) if v.causality == "input"]
        names = [state.name for state in about.states]
        self._push = np.zeros((len(names), len(disturbed)))
        for i, variable in enumerate(disturbed):
            if variable.causality != "input":
                self._push[names.index(variable.name), i] = 1.0
        self.x, self.u = signals_of("state", self._states), signals_of("input", self._inputs)
        self.y = signals_of("output", self._outputs)
        parts = [
            signals_of("w", [v]) if v.causality == "input" else signals_of("w", [v], "w_", per_second=True)
            for v in disturbed
        ] + [signals_of("w", self._outputs, "v_")]
        self.w = Signals(
            "disturbance",
            tuple(name for part in parts for name in part.names),
            tuple(unit for part in parts for unit in part.units),
            frozen(np.concatenate([part.nominal for part in parts])),
        )
        self._now = np.zeros(len(self._inputs) + len(self._driven))

    def start(self, t: float, x: Values | None, p: Values | None = None) -> None:
        """Begin anew at time `t`.

        Parameters
        ----------
        t : float
            Time in seconds.
        x : array (nx,) or mapping, or None
            True state at `t`; None for the FMU's own start.
        p : array (np,) or mapping, optional
            Values of the parameters named in `parameters`, where they differ from those given there.

        Raises
        ------
        FmuError
            If the FMU refuses a value; a co-simulation may compute its states itself.
        """
        t = finite_time(t, "FmuPlant.start")
        values = dict(self._parameters)
        if isinstance(p, Mapping):
            values |= plant_parameters(self.description, p)
        elif p is not None and np.size(p):
            values |= dict(zip(self.p.names, self.p.vector(p, "FmuPlant.start").tolist(), strict=True))
        given: dict[str, float] = {}
        if x is not None:
            given = dict(zip(self.x.names, self.x.vector(x, "FmuPlant.start").tolist(), strict=True))
            known = {state.name for state in self.description.states}
            for variable in self._states:
                if variable.name not in known and not variable.settable:
                    raise FmuError(f"{self.name}: {variable.name!r} is computed by the FMU and cannot be given")
        self.engine.start(t, values, given)
        own = [self.description.variables[v.name].start or 0.0 for v in (*self._inputs, *self._driven)]
        self._now = np.array(own, dtype=np.float64)

    @property
    def engine(self) -> Engine:
        """What runs the FMU."""
        if self._engine is None:
            raise FmuError(f"plant {self.path.name} is closed; build a new FmuPlant")
        return self._engine

    def advance(self, t: float, u0: Array, u1: Array, w: Array) -> None:
        """Go to time `t` with the input linear from `u0` (nu,) now to `u1` at `t`, and `w` (nw,) constant."""
        t = finite_time(t, "FmuPlant.advance")
        if t < self.engine.t:
            raise InputError(
                f"FmuPlant.advance: {t} lies before the present time {self.engine.t}; use restore or start"
            )
        disturbance = self.w.vector(w, "FmuPlant.advance")
        before, after = (self._drive(self.u.vector(u, "FmuPlant.advance"), disturbance) for u in (u0, u1))
        self.engine.advance(t, before, after, self._push @ disturbance[: self._push.shape[1]])
        self._now = after

    def _drive(self, u: Array, w: Array) -> Array:
        return np.concatenate([u, w[self._driven_at]])

    def state(self) -> Array:
        """Return the true state now (nx,).

        Raises
        ------
        FmuError
            If the FMU says that it is not finite.
        """
        return self._read(self._states, self._now)

    def output(self, u: Array, w: Array) -> Array:
        """Return the outputs now (ny,), with inputs `u` (nu,) and disturbance `w` (nw,).

        Raises
        ------
        FmuError
            If the FMU says that one is not finite; NaN would be taken for a missing measurement.
        """
        disturbance = self.w.vector(w, "FmuPlant.output")
        values = self._read(self._outputs, self._drive(self.u.vector(u, "FmuPlant.output"), disturbance))
        return values + disturbance[self._push.shape[1] :]

    def _read(self, variables: Sequence[Variable], inputs: Array) -> Array:
        values = self.engine.get(variables, inputs)
        if not np.isfinite(values).all():
            wrong = [f"{v.name} = {x}" for v, x in zip(variables, values.tolist(), strict=True) if not np.isfinite(x)]
            raise FmuError(
                f"{self.name}: {', '.join(wrong)} at t = {self.engine.t:.9g}; restore a checkpoint, or start "
                "again with other values"
            )
        return values

    def checkpoint(self) -> object:
        """Return where the plant is, for `restore`; what it keeps is freed with the object.

        Raises
        ------
        FmuUnsupportedError
            If the FMU cannot save its state and cannot do without (co-simulation, events).
        """
        return self.engine.checkpoint(), self._now

    def restore(self, checkpoint: Any) -> None:
        """Bring the plant back exactly to a checkpoint of the present run.

        Raises
        ------
        FmuError
            If it is a checkpoint of another run.
        """
        place, self._now = checkpoint
        self.engine.restore(place)

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt, (self.path, self._archive.digest, self._arguments)

    def close(self) -> None:
        """Free the FMU and remove its temporary folder; safe to call twice."""
        if self._engine is not None:
            self._engine.close()
            self._engine = None
        self._archive.close()

    def __enter__(self) -> FmuPlant:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"FmuPlant {self.name!r} (FMI {self.description.version}, {self.kind}, {self.integrator})"


def chosen_kind(about: Description, kind: str | None) -> str:
    """Return the kind to use, or raise `FmuKindError` when the FMU does not offer it."""
    if kind is None:
        kind = MODEL_EXCHANGE if MODEL_EXCHANGE in about.kinds else CO_SIMULATION
    check_kind(about, kind, "FmuPlant: ")
    return kind


def refuse_state_kicks(about: Description, disturbances: Sequence[str]) -> None:
    """Raise `FmuUnsupportedError` when states are to be disturbed in co-simulation."""
    inputs = {variable.name for variable in about.inputs}
    for state in about.states:
        if state.name in disturbances and state.name not in inputs:
            raise FmuUnsupportedError(
                f"{about.name}: state {state.name!r} cannot be disturbed in co-simulation, where the FMU integrates "
                "its states itself and FMI lets nobody set them after the initialization. Give the model an input "
                f"that is added to der({state.name}), or use kind={MODEL_EXCHANGE!r}"
            )


def rebuilt(path: Path, digest: str, arguments: Mapping[str, Any]) -> FmuPlant:
    """Return a plant that was pickled, from the file that it was made of."""
    plant = FmuPlant(path, **arguments)
    if plant._archive.digest != digest:
        plant.close()
        raise FmuError(f"{path} has changed since the plant was pickled; build the plant from the new file")
    return plant


def plant_parameters(about: Description, values: Mapping[str, float]) -> dict[str, float]:
    """Return checked values, by name, of variables that may be set at initialization."""
    known: tuple[Variable, ...] = tuple(v for v in about.variables.values() if v.settable and v.causality != "input")
    return finite_values(about, values, known, role="parameter", label="FmuPlant: parameter")
