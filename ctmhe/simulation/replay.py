"""A recorded log through estimator and trigger, exactly as a live plant."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.errors import InputError
from ctmhe.estimators.mhe import MHE
from ctmhe.models.continuous import Model
from ctmhe.models.fmu import FmuModel
from ctmhe.models.fmu.units import conversion, instruction, known_unit
from ctmhe.models.observer import known_inputs
from ctmhe.models.signals import Signals
from ctmhe.simulation.channel import Channel, SingleSample, WholeSignal
from ctmhe.simulation.engine import Loop
from ctmhe.simulation.run import Run
from ctmhe.simulation.signals import Recorded, bind_disturbance
from ctmhe.triggers.base import Trigger
from ctmhe.types import Array, frozen


class RecordedPlant:
    """A log as plant: its output at any time is the last record, its state is unknown.

    Parameters
    ----------
    log : MeasurementLog
    outputs, inputs : Signals
        What the estimator's model expects; an output without a column is missing (NaN).
    """

    name = "recorded log"
    integrator = "none: recorded"

    def __init__(self, log: MeasurementLog, outputs: Signals, inputs: Signals):
        unknown = [label for label in log.outputs if label not in outputs.names]
        if len(unknown) == len(log.outputs):
            raise InputError(
                f"replay: the log has outputs {', '.join(log.outputs)}, the model {', '.join(outputs)}: name the log's "
                "columns like the model's outputs, outputs={'model name': 'column'}"
            )
        missing = [label for label in inputs if label not in log.inputs]
        if missing:
            raise InputError(f"replay: the log has no column for input {', '.join(missing)}, which the model needs")
        none = Signals.of("disturbance", ())
        self.x, self.w, self.u, self.y = Signals.of("state", ()), none, inputs, outputs
        column = {label: log.y[:, i] for i, label in enumerate(log.outputs)}
        silent = np.full(len(log), np.nan)
        self._t, self._y = log.t, np.column_stack([column.get(label, silent) for label in outputs])
        self._row = 0

    @property
    def record_time(self) -> float:
        """Time of the last record, in seconds."""
        return float(self._t[self._row])

    def start(self, t: float, x: Array | None, p: Array | None = None) -> None:
        """Go to the last record at or before `t`."""
        self._go(t)

    def advance(self, t: float, u0: Array, u1: Array, w: Array) -> None:
        """Go to the last record at or before `t`."""
        self._go(t)

    def state(self) -> Array:
        """Return an empty vector: nothing is known."""
        return np.empty(0)

    def output(self, u: Array, w: Array) -> Array:
        """Return the last record, NaN where a sensor was silent."""
        return frozen(self._y[self._row])

    def checkpoint(self) -> object:
        """Return the number of the last record."""
        return self._row

    def restore(self, checkpoint: Any) -> None:
        """Go back to a checkpoint."""
        self._row = checkpoint

    def close(self) -> None:
        """Do nothing."""

    def _go(self, t: float) -> None:
        self._row = max(int(np.searchsorted(self._t, t, side="right")) - 1, 0)


def replay(
    log: MeasurementLog,
    mhe: MHE,
    *,
    trigger: Trigger,
    guess: Any,
    p: Any = None,
    channel: Channel | None = None,
    start: float | None = None,
    until: float | None = None,
    progress: bool = False,
) -> Run:
    """Send a recorded log through trigger, channel and estimator, as if it were happening: nothing looks ahead.

    Monitoring times are the log's times. Guards are asked there and not located in between, where no output is known;
    self-triggered policies act at their exact times, on the last record. The input holds from row to row.

    Parameters
    ----------
    log : MeasurementLog
        Columns are matched with the model's outputs and inputs by name; an output without a column is missing.
    mhe : MHE
    trigger : Trigger
    guess : array (nx,) or mapping
        Initial estimate at the first row.
    p : array (np,) or mapping, optional
        Initial (or known) parameters.
    channel : Channel, optional
        `WholeSignal()` when left out, `SingleSample()` for an estimator with `hold="point"`. Its `every` plays no part.
    start, until : float, optional
        First and last time used, in seconds; all rows when left out.
    progress : bool

    Returns
    -------
    Run
        Without a truth: `x_true` is NaN.

    Raises
    ------
    InputError
        For a log without the model's signals, in other units than the model's where it states them, or without rows in
        the chosen span; and as `simulate`.
    TriggerError
        As `simulate`.
    """
    low, high = -np.inf if start is None else start, np.inf if until is None else until
    times = log.t[(log.t >= low) & (log.t <= high)]
    if len(times) < 2:
        raise InputError(f"replay: the log has {len(times)} rows between {low:g} and {high:g} s; at least 2 are needed")
    model = mhe.model
    check_units(log, model)
    plant = RecordedPlant(log, model.y, known_inputs(model))
    columns = [log.inputs.index(name) for name in known_inputs(model)]
    if channel is None:
        channel = SingleSample() if set(mhe.hold.values()) == {"point"} and model.step is None else WholeSignal()
    loop = Loop(
        plant,
        mhe,
        trigger=trigger,
        channel=channel,
        disturbance=bind_disturbance(None, plant.w, 0),
        inputs=Recorded(log.t, log.u[:, columns]).bind(plant.u, 0),
        times=frozen(times),
        monitor=float(np.median(np.diff(times))),
        seed=0,
        locate=None,
        sample_time=lambda: plant.record_time,
    )
    return loop.run(truth=None, p_true=None, guess=guess, p=p, progress=progress)


def check_units(log: MeasurementLog, model: Model) -> None:
    """Raise `InputError` when the log states a unit other than the model's; with the conversion to apply.

    Two spellings of one unit are accepted, as far as an FMU or common use defines them. What the log does not state is
    not checked.
    """
    stated, units = log.units or {}, model.description.units if isinstance(model, FmuModel) else {}
    for signals in (model.y, known_inputs(model)):
        for name, unit in zip(signals.names, signals.units, strict=True):
            given = stated.get(name)
            if not given or not unit:
                continue
            change = conversion(units, given, unit)
            if change is not None and not instruction(*change):
                continue
            told = f"log: {name!r} is in {given!r} but the model has {unit!r}"
            if change is not None:
                remedy = f"convert the column ({instruction(*change)})"
            elif known_unit(units, given) and known_unit(units, unit):
                raise InputError(f"{told}, and these measure different things; is it the right column?")
            else:
                unknown = unit if known_unit(units, given) else given
                remedy = f"convert the column ({unknown!r} is defined nowhere, so the factor is yours to find)"
            raise InputError(f"{told}; {remedy} and state units.{name} = {unit!r}")
