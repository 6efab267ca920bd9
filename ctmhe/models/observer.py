"""An observer as a model: its inputs are the system's and the measurements, and nothing disturbs it."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel, Model
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.signals import Signals
from ctmhe.types import Array, Bounds


def observer_model(model: Model, K: Any) -> ContinuousModel:
    """Return z+ = f(z, u, 0) + K (h(z, u, 0) - y) (4.71), or dz/dt, with output h(z, u, 0), as a model in (u, y).

    An `MHE` of it optimises over trajectories of the observer: (4.72), with as many decisions as there are states,
    whatever the horizon. The estimator feeds it with the measurements that it is given; `control` takes the inputs of
    the system only, `controls`. Where an output is not measured, nothing is injected.

    Parameters
    ----------
    model : ContinuousModel or DiscreteModel
        The system.
    K : array (nx, ny)
        Gain, in the model's units (per second in continuous time); negative feedback has negative entries.

    Raises
    ------
    InputError
        For a gain of another size, or one that is not finite.

    Source: thesis 4.3.1.
    """
    K = gain(model, K)
    nu, ny, silent = len(model.u), len(model.y), np.zeros(len(model.w))
    values = tuple(f"measured_{name}" for name in model.y.names)
    known = tuple(f"known_{name}" for name in model.y.names)

    def f(t: Any, z: Any, u: Any, w: Any, p: Any) -> Any:
        here = (t, z, u[:nu], silent, p)
        error = u[nu + ny :] * (model.output(*here) - u[nu : nu + ny])
        return model.dynamics(*here) + ca.mtimes(ca.DM(K), error)

    def h(t: Any, z: Any, u: Any, w: Any, p: Any) -> Any:
        return model.output(t, z, u[:nu], silent, p)

    groups = (model.x, model.u, model.p, model.y)
    signals: dict[str, Any] = {
        "x": model.x.names,
        "u": (*model.u.names, *values, *known),
        "p": model.p.names,
        "y": model.y.names,
        "units": {name: unit for group in groups for name, unit in zip(group.names, group.units, strict=True)}
        | dict(zip(values, model.y.units, strict=True)),
        "nominal": {name: size for group in groups for name, size in zip(group.names, group.nominal, strict=True)},
        "p_start": model.p_start,
        "bounds": Bounds(x=model.bounds.x),
        "name": f"observer of {model.name}",
        "source": "thesis (4.71)",
    }
    made = ContinuousModel(f, h, **signals) if model.step is None else DiscreteModel(f, h, step=model.step, **signals)
    made.controls = model.u
    return made


def known_inputs(model: Model) -> Signals:
    """Return the inputs that are given to an estimator: all of them, but for the measurements that feed an observer."""
    own: Signals | None = getattr(model, "controls", None)
    return model.u if own is None else own


def gain(model: Model, K: Any) -> Array:
    """Return K as an array (nx, ny), or raise `InputError`."""
    try:
        K = np.asarray(K, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"K: expected numbers ({len(model.x)}, {len(model.y)}), got {K!r}") from None
    if K.shape != (len(model.x), len(model.y)) or not np.isfinite(K).all():
        raise InputError(
            f"K: model {model.name!r} has {len(model.x)} states and {len(model.y)} outputs, so a finite gain "
            f"({len(model.x)}, {len(model.y)}) is needed, got {K.tolist()}"
        )
    return K
