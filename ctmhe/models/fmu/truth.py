"""Whether CasADi says what the FMU says: values against fmpy, Jacobians against finite differences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import FmuError
from ctmhe.models.fmu.description import MODEL_EXCHANGE, Description, Variable
from ctmhe.models.fmu.functions import FmuFunctions
from ctmhe.models.fmu.instance import Instance
from ctmhe.types import Array

REACH = float(np.cbrt(np.finfo(float).eps))  # relative step of a central difference
VALUE_TOLERANCE = 1e-6  # loose enough for FMUs that solve algebraic loops by iteration
SLOPE_TOLERANCE = 1e-4


class Reference:
    """The FMU as fmpy runs it: start values and evaluations that do not pass through CasADi.

    Parameters
    ----------
    description : Description
    folder : Path
        Where the FMU is unpacked.
    values : mapping name -> value
        Start values other than the FMU's own.
    """

    def __init__(self, description: Description, folder: Path, values: Mapping[str, float]):
        self._about, self._folder, self._values = description, folder, dict(values)

    def start(self, *groups: Sequence[Variable]) -> tuple[float, list[Array]]:
        """Return the time of the first time event (infinite: none) and the start values of `groups`."""
        instance = Instance(self._about, self._folder, MODEL_EXCHANGE)
        try:
            event = instance.initialize(0.0, self._initial({}))
            values = [instance.get(group) for group in groups]
        finally:
            instance.close()
        for name, value in self._values.items():
            for group, numbers in zip(groups, values, strict=True):
                for i, variable in enumerate(group):
                    if variable.name == name:  # a state may be computed by the FMU and still be given here
                        numbers[i] = value
        return event.next_time, values

    def evaluate(
        self,
        t: float,
        x: Array,
        inputs: Mapping[str, float],
        parameters: Mapping[str, float],
        outputs: Sequence[Variable],
    ) -> tuple[Array, Array]:
        """Return (dx/dt, outputs) of a fresh instance; parameters are set before it is initialized."""
        instance = Instance(self._about, self._folder, MODEL_EXCHANGE)
        try:
            instance.initialize(0.0, self._initial(parameters))
            instance.set_time(t)
            instance.set_states(x)
            instance.set([self._about.variables[name] for name in inputs], list(inputs.values()))
            return instance.derivatives(), instance.get(outputs)
        finally:
            instance.close()

    def _initial(self, parameters: Mapping[str, float]) -> dict[str, float]:
        values = self._values | dict(parameters)
        return {name: value for name, value in values.items() if self._about.variables[name].settable}


@dataclass(frozen=True)
class Choice:
    """The variables behind the signals of a model, and where they start."""

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    x: Array
    u: Array
    p: Array


def check(description: Description, reference: Reference, functions: FmuFunctions, choice: Choice) -> None:
    """Compare CasADi's functions with the FMU at its start and at two points nearby.

    Raises
    ------
    FmuError
        Naming the variable whose value or derivative is wrong, or that is not finite at the start.
    """
    states = [state.name for state in description.states]
    rows = {"dynamics": [f"der({name})" for name in states], "output": [v.name for v in choice.outputs]}
    columns = {
        "x": states,
        "u": [v.name for v in choice.inputs],
        "p": [v.name for v in choice.parameters],
    }
    scales = {
        "x": np.array([v.nominal for v in description.states]),
        "u": np.array([v.nominal for v in choice.inputs]),
        "p": np.array([v.nominal for v in choice.parameters]),
    }
    usable = []
    for number, point in enumerate(_points(description, choice)):
        dynamics, output = functions.create()  # an FMU that failed once fails for ever: every point has its own
        try:
            truth = reference.evaluate(
                point["t"],
                point["x"],
                dict(zip(columns["u"], point["u"], strict=True)),
                dict(zip(columns["p"], point["p"], strict=True)),
                choice.outputs,
            )
            found = [_vector(function, point) for function in (dynamics, output)]
        except (FmuError, RuntimeError) as error:
            if number == 0:
                raise FmuError(
                    f"{description.name} cannot be evaluated at its start values: {error}. Give others with "
                    "start={...}"
                ) from error
            continue
        for label, own, ours in zip(rows, truth, found, strict=True):
            if not np.isfinite(own).all():
                if number == 0:
                    bad = rows[label][int(np.flatnonzero(~np.isfinite(own))[0])]
                    raise FmuError(
                        f"{description.name}: {bad!r} is not finite at the start values; give others with start={{...}}"
                    )
                break
            _same_values(description, rows[label], own, ours)
        else:
            usable.append(point)
            for label, function in zip(rows, (dynamics, output), strict=True):
                _same_slopes(description, function, point, names=rows[label], columns=columns, scales=scales)
    _same_when_mapped(description, functions.create()[0], usable, rows["dynamics"])


def _points(description: Description, choice: Choice) -> Iterator[dict[str, Any]]:
    """Yield the start, then two points around it inside the variables' limits."""
    random = np.random.default_rng(20)
    groups = {
        "x": (description.states, choice.x),
        "u": (choice.inputs, choice.u),
        "p": (choice.parameters, choice.p),
    }
    yield {"t": 0.0} | {key: start for key, (_, start) in groups.items()}
    for t in (0.5, 1.5):
        point: dict[str, Any] = {"t": t}
        for key, (variables, start) in groups.items():
            size = np.where(start != 0, np.abs(start), [0.1 * v.nominal for v in variables])
            moved = start + random.uniform(0.01, 0.1, len(start)) * size
            lower = [-np.inf if v.minimum is None else v.minimum for v in variables]
            upper = [np.inf if v.maximum is None else v.maximum for v in variables]
            point[key] = np.clip(moved, lower, upper)
        yield point


def _arguments(function: ca.Function, point: Mapping[str, Any]) -> list[Any]:
    return [point["t"], point["x"], point["u"], np.zeros(function.size1_in(3)), point["p"]]


def _vector(function: ca.Function, point: Mapping[str, Any]) -> Array:
    return np.asarray(function.call(_arguments(function, point))[0], dtype=float).reshape(-1)


def _blocks(function: ca.Function, point: Mapping[str, Any]) -> dict[str, Array]:
    arguments = _arguments(function, point)
    values = function.jacobian().call([*arguments, function.call(arguments)[0]])
    return {key: np.asarray(ca.DM(value)) for key, value in zip("txuwp", values, strict=True)}


def _same_values(description: Description, names: Sequence[str], own: Array, ours: Array) -> None:
    scale = np.maximum(np.abs(own), VALUE_TOLERANCE)
    wrong = ~(np.abs(own - ours) <= VALUE_TOLERANCE * scale)
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise FmuError(
            f"{description.name}: CasADi evaluates {names[i]!r} as {ours[i]:.10g}, the FMU itself as "
            f"{own[i]:.10g}, so it cannot be used in an estimator. Its values may be stale after a set, or a "
            "parameter may only be set before initialization: leave that parameter out, or export the FMU with a "
            "newer tool"
        )


def _same_slopes(
    description: Description,
    function: ca.Function,
    point: Mapping[str, Any],
    *,
    names: Sequence[str],
    columns: Mapping[str, Sequence[str]],
    scales: Mapping[str, Array],
) -> None:
    blocks = _blocks(function, point)
    here = _vector(function, point)
    wrong: list[tuple[str, str, float, float, str]] = []
    for key, labels in columns.items():
        for j, label in enumerate(labels):
            size = max(abs(point[key][j]), scales[key][j])
            step = REACH * size
            shifted = [_vector(function, _moved(point, key, j, sign * step)) for sign in (1.0, -1.0)]
            sides = np.array([(shifted[0] - here) / step, (here - shifted[1]) / step])
            slope = blocks[key][:, j]
            # at a kink any slope between the two sides is right
            off = np.maximum(slope - sides.max(axis=0), sides.min(axis=0) - slope)
            allowed = SLOPE_TOLERANCE * np.maximum(np.abs(here) / size, np.abs(sides).max(axis=0)) + 1e-12
            for i in np.flatnonzero(~(off <= allowed) & np.isfinite(sides).all(axis=0)):
                wrong.append((names[int(i)], label, slope[i], sides[:, i].mean(), key))
    if not wrong:
        return
    # a missing dependency also spoils entries that are listed: first blame one that is zero and should not be
    row, label, slope, expected, key = min(wrong, key=lambda entry: entry[2] != 0.0)
    remedy = f"leave {label!r} out of parameters= (its value is still used), or " if key == "p" else ""
    raise FmuError(
        f"{description.name}: its derivative of {row!r} with respect to {label!r} is {slope:.6g}, but finite "
        f"differences give {expected:.6g}; an estimator would go wrong. Most likely {label!r} is missing from the "
        f"`dependencies` of {row!r} in modelDescription.xml: {remedy}export the FMU again with correct dependencies"
    )


def _moved(point: Mapping[str, Any], key: str, j: int, step: float) -> dict[str, Any]:
    values = np.array(point[key])
    values[j] += step
    return {**point, key: values}


def _same_when_mapped(
    description: Description, function: ca.Function, points: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> None:
    """Compare the Jacobian of three mapped Euler stages, as an estimator takes it, with the one of each stage."""
    stages = [points[i % len(points)] for i in range(3)]
    sizes = [function.size1_in(i) for i in range(5)]
    mapped = [ca.MX.sym(key, size, 3) for key, size in zip("txuwp", sizes, strict=True)]
    chain = mapped[1] + 0.01 * function.map(3)(*mapped)
    derivative = ca.Function("J", mapped, [ca.jacobian(ca.vec(chain), ca.vec(mapped[i])) for i in (1, 4)])
    columns = [np.column_stack(column) for column in zip(*(_arguments(function, s) for s in stages), strict=True)]
    together = [np.asarray(ca.DM(value)) for value in derivative.call(columns)]
    nx = sizes[1]
    for k, stage in enumerate(stages):
        blocks = _blocks(function, stage)
        for value, key, width in ((together[0], "x", nx), (together[1], "p", sizes[4])):
            expected = np.zeros((nx, 3 * width))
            expected[:, k * width : (k + 1) * width] = 0.01 * blocks[key] + (np.eye(nx) if key == "x" else 0.0)
            error = np.abs(value[k * nx : (k + 1) * nx] - expected)
            wrong = ~(error <= 1e-9 * (1.0 + np.abs(expected)))
            if wrong.any():
                name = names[int(np.argwhere(wrong)[0, 0])]
                raise FmuError(
                    f"{description.name}: CasADi's derivative of {name!r} changes when stages are evaluated "
                    "together, so an estimator would go wrong; this is a defect of this CasADi version: use another"
                )
