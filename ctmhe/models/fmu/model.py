"""FMUs as models: model exchange in continuous time, co-simulation as a step map in discrete time."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.errors import FmuDerivativeError, FmuError, FmuEventError, FmuWarning, InputError
from ctmhe.models.fmu.archive import Unpacked
from ctmhe.models.fmu.choice import Choice, Names, choose
from ctmhe.models.fmu.evaluators import Evaluator, Evaluators, Worker
from ctmhe.models.fmu.functions import FmuFunctions
from ctmhe.models.fmu.reading import read_description
from ctmhe.models.fmu.reference import Reference
from ctmhe.models.fmu.truth import Examination, Point, same_when_mapped
from ctmhe.models.signals import Signals
from ctmhe.types import Bounds, frozen

CHECKS = ("full", "fast", "off")
PATIENCE = 10.0  # seconds that an isolated FMU may take for one evaluation


class FmuModel:
    """dx/dt = f(t, x, u, p) + w, y = h(t, x, u, p) (+ v) of an FMU: thesis (3.7), with p.

    An FMU of co-simulation is a step map, x(t + step) = f(x, u, p) + w, like a `DiscreteModel` (thesis (3.1)): each
    step starts from the state that the FMU had after its initialization, with x, u and p set. What else it remembers
    (discrete variables, the integrator's own memory) is as it was there, and it must not depend on time.

    The archive is unpacked into a private temporary folder that lives as long as the model, or until `close`. The
    binary is loaded in another process first. Pickles as its configuration: path, hash of the file, arguments.

    Parameters
    ----------
    path : str or Path
        The .fmu file, FMI 2.0 or 3.0.
    kind : {"ModelExchange", "CoSimulation"}, optional
        Model exchange where the FMU has it and no step is given, when left out.
    step : float, optional
        Seconds, of co-simulation.
    inputs, outputs, states, parameters : str or sequence of str, optional
        What becomes u, y, x (co-simulation only; else all continuous states) and p: names, patterns (`zone*.T`) and
        selectors (`causality:output`, `variability:tunable`). Inputs and outputs: all when left out; an output may be
        any real variable. Inputs that are left out keep their start values. Only tunable parameters can be estimated.
    disturbances : str or sequence of str, optional
        What w adds to, in the FMU's units: states (`w_<state>`, added to the derivative, per second, or to the next
        state), inputs (`w_<input>`, added to the value), outputs (`v_<output>`). All states when left out.
    output_noise : bool
        Whether `w` also holds a `v_<output>` for each output.
    start : mapping name -> value, optional
        Values of states, inputs and parameters to start with instead of the FMU's own.
    allow_frozen_events : bool
        Accept an FMU with events; its discrete variables then stay as they are after initialization.
    check : {"full", "fast", "off"}
        How thoroughly values and derivatives are compared with the FMU's own: at three points, at the start, not.
    isolated : bool or float
        Run the FMU in a process of its own, so that its crash or hang (longer than so many seconds, 10 for True) is a
        failed evaluation. A round trip more per evaluation.

    Attributes
    ----------
    x, u, w, p, y : Signals
        Units and nominals are the FMU's.
    dynamics, output : casadi.Function
        Of (t, x, u, w, p). Derivatives with respect to t and u are finite differences.
    x_start, u_start, p_start : array (nx,), (nu,), (np,)
        Values after initialization.
    description : Description
    warnings : tuple of str
        What was found wrong and worked around.
    exact_derivatives : bool
        All of x, p and disturbed inputs have directional derivatives; otherwise some are central differences.
    single_instance : bool
        The FMU allows one instance per process (`canBeInstantiatedOnlyOncePerProcess`): no threads.

    Raises
    ------
    FmuArchiveError, FmuVersionError, FmuKindError, FmuBinaryError, FmuUnsupportedError, FmuEventError,
    FmuParameterError, FmuDerivativeError
        In the order of the checks; all are `FmuError`, name the variable or entry, and say what to do.
    InputError
        If a name is unknown; the message suggests the nearest.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        kind: str | None = None,
        step: float | None = None,
        inputs: Names = None,
        outputs: Names = None,
        states: Names = None,
        parameters: Names = (),
        disturbances: Names = None,
        output_noise: bool = False,
        start: Mapping[str, float] | None = None,
        allow_frozen_events: bool = False,
        check: str = "full",
        isolated: bool | float = False,
    ):
        if check not in CHECKS:
            raise InputError(f"check: expected one of {', '.join(CHECKS)}, got {check!r}")
        choice: dict[str, Any] = {
            "kind": kind,
            "step": step,
            "inputs": inputs,
            "outputs": outputs,
            "states": states,
            "parameters": parameters,
            "disturbances": disturbances,
            "output_noise": output_noise,
            "start": dict(start or {}),
        }
        others = {"allow_frozen_events": allow_frozen_events, "check": check, "isolated": isolated}
        self._arguments: dict[str, Any] = choice | others
        self._evaluators: Evaluators | None = None
        self._archive = Unpacked(path)
        self.path = self._archive.path
        try:
            self.description = read_description(self._archive.folder)
            self._build(choose(self.description, **choice), **others)
        except BaseException:
            self.close()
            raise

    def _build(self, choice: Choice, *, allow_frozen_events: bool, check: str, isolated: bool | float) -> None:
        about, folder = choice.about, self._archive.folder
        self.name, self.bounds, self.step = about.name, Bounds(), choice.step
        self.single_instance = about.kinds[choice.kind].single_instance
        signals = choice.signals()
        self.x, self.u, self.w, self.p, self.y = (signals[key] for key in "xuwpy")
        seconds = None if isolated is False else PATIENCE if isolated is True else float(isolated)

        configuration = choice.configuration(folder)
        references = [v.reference for v in choice.read_at_start]
        probe = Worker(configuration, references)
        probe.close()
        check_events(choice, probe.next_event, allowed=allow_frozen_events)
        nx, nu, nv = len(choice.states), len(choice.inputs), len(choice.driven)
        values = [choice.values.get(v.name, found) for v, found in zip(choice.read_at_start, probe.values, strict=True)]
        self.x_start, self.u_start = frozen(values[:nx]), frozen(values[nx : nx + nu])
        self.p_start = frozen(values[nx + nv :])
        configuration = choice.configuration(folder, values[nx : nx + nv])

        found = tuple(f"{about.name}: {remark}" for remark in about.remarks)
        points: tuple[Point, ...] = ()
        if check != "off":
            start = Point(about.start_time or 0.0, self.x_start, self.u_start, self.p_start)
            examination = Examination(
                choice,
                Reference(choice, folder),
                configuration,
                start,
                seconds=seconds,
                thorough=check == "full",
            )
            try:
                findings = examination.run()
            except FloatingPointError as error:
                raise _unsteady(about.name, str(error)) from error
            configuration, found, points = findings.configuration, found + findings.warnings, findings.usable
        self.warnings = found
        asked = [True] * nx + [v in choice.disturbed for v in choice.driven] + [True] * len(choice.parameters)
        differenced = [d and a for d, a in zip(configuration["differenced"], asked, strict=True)]
        differenced += configuration["rows_differenced"]
        self.exact_derivatives = bool(configuration["directional"]) and not any(differenced)
        self._evaluators = Evaluators(configuration, references, alone=self.single_instance, seconds=seconds)
        sizes = tuple(configuration[key] for key in ("nx", "nu", "nw", "np", "ny"))
        functions = FmuFunctions(self._evaluators, sizes, self.u.nominal)
        self._functions, self.dynamics, self.output = functions, functions.dynamics, functions.output
        if check == "full":
            try:
                same_when_mapped(self.name, self.dynamics, points, self.x.names, len(self.w))
            except RuntimeError as error:  # CasADi's, which has no cause
                raise _unsteady(about.name, self._evaluators.mine().message()) from error
        if self.single_instance:
            self._evaluators.release()
        for text in found:
            warnings.warn(text, FmuWarning, stacklevel=3)

    def evaluator(self) -> Evaluator:
        """Return this thread's evaluator, which solvers call without CasADi."""
        if self._evaluators is None:
            raise FmuError(f"{self.path.name} is closed: build the model again")
        return self._evaluators.mine()

    def failures(self) -> tuple[int, str]:
        """Return how many evaluations of this thread have failed so far, and the last one in words.

        To ask is to begin a new attempt: an isolated FMU's lost processes are replaced again, ten times at most.
        """
        evaluator = self.evaluator()
        evaluator.begin()
        return evaluator.failures(), evaluator.message()

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

    def __enter__(self) -> FmuModel:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the FMU and remove its temporary folder; the model must not be used any more."""
        if self._evaluators is not None:
            self._evaluators.close()
            self._evaluators = None
        self._archive.close()


def _unsteady(name: str, reason: str) -> FmuDerivativeError:
    return FmuDerivativeError(
        f"{name} fails where it could be evaluated before: {reason}. What it says must not depend on the calls made "
        "before: export it with another tool, or use it as the plant (FmuPlant)"
    )


def _reopen(path: str, digest: str, arguments: dict[str, Any]) -> FmuModel:
    model = FmuModel(path, **arguments)
    if model._archive.digest != digest:
        model.close()
        raise FmuError(f"{path} has changed since this model was saved; build the model again")
    return model


def check_events(choice: Choice, next_time: float, *, allowed: bool) -> None:
    """Raise `FmuEventError` when an FMU has events and freezing them is not allowed."""
    about = choice.about
    if allowed or not choice.exchange or (about.event_indicators == 0 and not np.isfinite(next_time)):
        return
    count = about.event_indicators
    what = f"{count} event indicator{'s' * (count > 1)}" if count else f"a time event at t = {next_time}"
    raise FmuEventError(
        f"{about.name} has {what}; inside an estimator its discrete variables would stay frozen. If that is "
        "acceptable in the range of interest, say allow_frozen_events=True; as the plant (FmuPlant) events are handled"
    )
