"""Continuous-time models from Python functions on CasADi symbols."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from ctmhe.errors import InputError, ModelError
from ctmhe.models.signals import Signals
from ctmhe.types import Array, Bounds, frozen, names_of

ARGUMENTS = ("t", "x", "u", "w", "p")
KINDS = {"x": "state", "u": "input", "w": "disturbance", "p": "parameter", "y": "output"}


@runtime_checkable
class Model(Protocol):
    """What an estimator needs to know of a plant: signals, and two CasADi functions of (t, x, u, w, p).

    `step` is None for a continuous-time model, whose `dynamics` is dx/dt; for a discrete-time model it is the
    step in seconds and `dynamics` is the state one step later.
    """

    name: str
    x: Signals
    u: Signals
    w: Signals
    p: Signals
    y: Signals
    dynamics: ca.Function
    output: ca.Function
    p_start: Array
    step: float | None
    bounds: Bounds


def build_function(name: str, function: Callable[..., Any], sizes: Mapping[str, int], rows: int) -> ca.Function:
    """Trace `function(t, x, u, w, p)` once and return it as a dense CasADi function with `rows` outputs."""
    symbols = [ca.SX.sym(key, sizes.get(key, 1)) for key in ARGUMENTS]
    try:
        value = function(*symbols)
    except Exception as error:
        raise ModelError(
            f"{name}(t, x, u, w, p) failed on CasADi symbols: {type(error).__name__}: {error}. Use casadi "
            "functions (ca.exp, ca.if_else, ...) instead of numpy, math or Python comparisons"
        ) from error
    try:
        column = ca.SX(value if isinstance(value, (ca.SX, ca.DM, float, int)) else ca.vertcat(*value))
    except Exception as error:
        raise ModelError(f"{name} must return a vector or a sequence of scalars, got {type(value).__name__}") from error
    if column.numel() != rows or 1 not in column.shape:
        what = f"{column.numel()} values" if 1 in column.shape else f"a matrix of shape {column.shape}"
        raise ModelError(f"{name} returned {what}, expected {rows} value{'s' * (rows != 1)}")
    own = {symbol.element_hash() for group in symbols for symbol in ca.symvar(group)}
    foreign = [str(symbol) for symbol in ca.symvar(column) if symbol.element_hash() not in own]
    if foreign:
        raise ModelError(
            f"{name} depends on symbols that are not its arguments: {', '.join(foreign)}. Pass them through "
            "x, u, w or p, or give them numbers"
        )
    traced = ca.Function(name, symbols, [ca.densify(ca.vec(column))], list(ARGUMENTS), ["value"])
    constants = (k for k in range(traced.n_instructions()) if traced.instruction_id(k) == ca.OP_CONST)
    if any(np.isnan(traced.instruction_constant(k)) for k in constants):
        raise ModelError(
            f"{name} contains a NaN constant: functions of the math module and float() turn CasADi symbols "
            "into NaN. Use casadi functions (ca.sin, ca.exp, ...) instead"
        )
    return traced


class ContinuousModel:
    """dx/dt = f(t, x, u, w, p), y = h(t, x, u, w, p): thesis (3.7), with parameters.

    Parameters
    ----------
    f, h : callable (t, x, u, w, p) -> vector or sequence
        Written with CasADi operations; `x`, `u`, `w`, `p` are column vectors of symbols, empty where unused.
    x, y : sequence of str
        Names of states and outputs.
    u, w, p : sequence of str, optional
        Names of known inputs, disturbances (process and measurement noise together) and parameters. Without a
        noise input in `w` the output residual is the noise.
    units : mapping name -> unit, optional
    nominal : mapping name -> typical magnitude, optional
        Scales of the optimisation; where left out, the larger magnitude of two finite bounds, else 1.
    p_start : array (np,) or mapping, optional
        Parameter values used when none are given.
    bounds : Bounds, optional
        Where the model makes sense; documentation for the user, imposed only when passed to the estimator.
    name, source : str, optional

    Raises
    ------
    ModelError
        If f or h fails on symbols, returns the wrong number of values, depends on foreign symbols, or has no
        finite derivative at a trial point.
    InputError
        For names, units, nominals, start values or bounds that do not fit the signals.
    """

    step: float | None = None
    controls: Signals | None = None  # those of the inputs that are not measurements, for `observer_model`

    def __init__(
        self,
        f: Callable[..., Any],
        h: Callable[..., Any],
        *,
        x: str | Sequence[str],
        y: str | Sequence[str],
        u: str | Sequence[str] = (),
        w: str | Sequence[str] = (),
        p: str | Sequence[str] = (),
        units: Mapping[str, str] | None = None,
        nominal: Mapping[str, float] | None = None,
        p_start: Any = None,
        bounds: Bounds | None = None,
        name: str = "model",
        source: str = "",
    ):
        self.name, self.source = name, source
        self.bounds = bounds or Bounds()
        kinds = {"x": x, "u": u, "w": w, "p": p, "y": y}
        known = {label for labels in kinds.values() for label in names_of(labels)}
        for title, mapping in (("units", units), ("nominal", nominal)):
            for label in mapping or {}:
                if label not in known:
                    near = get_close_matches(str(label), known, n=1)
                    hint = f"; did you mean {near[0]!r}?" if near else "."
                    names = ", ".join(sorted(known))
                    raise InputError(f"{title}: unknown signal {label!r}{hint} Known: {names}")
        signals = {key: Signals.of(KINDS[key], labels, units, nominal) for key, labels in kinds.items()}
        for key in "xwpy":
            signals[key] = scaled(signals[key], getattr(self.bounds, key), nominal or {}, f"bounds of {key}")
        box_arrays(signals["y"], self.bounds.residual, "bounds of residual")
        self.x, self.u, self.w, self.p, self.y = (signals[key] for key in "xuwpy")
        if not len(self.x) or not len(self.y):
            raise ModelError(f"model {name!r} needs at least one state and one output")
        sizes = {key: len(group) for key, group in signals.items()}
        self.dynamics = build_function("f", f, sizes, sizes["x"])
        self.output = build_function("h", h, sizes, sizes["y"])
        self.p_start = self.p.vector(np.ones(sizes["p"]) if p_start is None else p_start, "p_start")
        check_differentiable(self)

    def __repr__(self) -> str:
        rows = [f"{type(self).__name__} {self.name!r}"]
        for key in "xuwpy":
            group: Signals = getattr(self, key)
            if len(group):
                pairs = zip(group.names, group.units, strict=True)
                rows.append(f"  {key}: {', '.join(f'{n} [{unit}]' if unit else n for n, unit in pairs)}")
        return "\n".join(rows)


def scaled(signals: Signals, box: Any, nominal: Mapping[str, float], what: str) -> Signals:
    """Return the signals with nominals from the box where `nominal` has none and both sides are finite."""
    size = np.max(np.abs(box_arrays(signals, box, what)), axis=0)
    given = np.array([name in nominal for name in signals.names], dtype=bool)
    from_box = ~given & np.isfinite(size) & (size > 0)
    return replace(signals, nominal=frozen(np.where(from_box, size, signals.nominal)))


def check_differentiable(model: Model) -> None:
    """Evaluate both functions and their Jacobians at a point inside the bounds; raise when not finite."""
    x = trial_point(model.x, model.bounds.x)
    arguments = [0.0, x, trial_point(model.u, None), np.zeros(len(model.w)), model.p_start]
    for function, label in ((model.dynamics, "f"), (model.output, "h")):
        try:
            values = function.call(arguments)
            values = values + function.jacobian().call([*arguments, *values])
        except Exception as error:
            raise ModelError(f"{label} of model {model.name!r} cannot be evaluated at x = {x}: {error}") from error
        if not all(np.isfinite(np.asarray(ca.DM(value))).all() for value in values):
            raise ModelError(
                f"{label} of model {model.name!r} or its Jacobian is not finite at the trial point x = {x}; "
                "give bounds=Bounds(x=...) or nominal= so that it lies where the model makes sense"
            )


def trial_point(signals: Signals, box: Any) -> Array:
    """Return a point inside `box` where both sides are finite, else the nominal values."""
    lower, upper = box_arrays(signals, box, "bounds")
    finite = np.isfinite(lower) & np.isfinite(upper)
    inside = np.where(finite, 0.45 * np.where(finite, lower, 0.0) + 0.55 * np.where(finite, upper, 0.0), 0.0)
    return frozen(np.where(finite, inside, np.clip(signals.nominal, lower, upper)))


def box_arrays(signals: Signals, box: Any, what: str) -> tuple[Array, Array]:
    """Return `(lower, upper)` arrays (n,) for a box in any of the forms of `Bounds`."""
    n = len(signals)
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    if box is None:
        return lower, upper
    if isinstance(box, Mapping):
        for name, pair in box.items():
            i = signals.index(name)
            try:
                lower[i], upper[i] = pair
            except (TypeError, ValueError):
                raise InputError(
                    f"{what}: {signals.kind} {name!r} needs a pair (lower, upper) of numbers, got {pair!r}"
                ) from None
    else:
        try:
            low, high = box
            lower[:], upper[:] = np.asarray(low, float).reshape(-1), np.asarray(high, float).reshape(-1)
        except (TypeError, ValueError):
            raise InputError(
                f"{what}: expected (lower, upper) with scalars or {n} values each, or a mapping from a "
                f"{signals.kind} name to its pair; got {box!r}"
            ) from None
    for i, name in enumerate(signals.names):
        if not lower[i] <= upper[i]:
            raise InputError(f"{what}: {signals.kind} {name!r} has lower {lower[i]} above upper {upper[i]} (or NaN)")
        if lower[i] == np.inf or upper[i] == -np.inf:
            raise InputError(f"{what}: {signals.kind} {name!r} has no finite value between {lower[i]} and {upper[i]}")
    return lower, upper
