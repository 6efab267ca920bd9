"""Parameters that vary, as the last states of a model: thesis (5.1b), (5.76)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel, Model, box_arrays
from ctmhe.models.discrete import DiscreteModel
from ctmhe.types import Bounds


def varying_parameters(
    model: Model, g: Callable[[Any, Any, Any], Any] | None = None, *, drift: Any = None
) -> ContinuousModel | DiscreteModel:
    """Return the model whose states are (x, p), with p+ = g(p, u, w), or dp/dt = g(p, u, w) in continuous time.

    Parameters
    ----------
    model : ContinuousModel or DiscreteModel
        With parameters p.
    g : callable (p, u, w) -> vector (np,), optional
        Written with CasADi operations. When left out p + w_p, or w_p in continuous time.
    drift : scalar or mapping parameter -> size, optional
        Largest |w_p|, per step or per second: bounds and nominal of the new disturbances `w_<parameter>`, which stand
        behind those of the model. Needed without g; with g there are new ones if it is given.

    Raises
    ------
    InputError
        For a model without parameters, or one that is no CasADi expression (an FMU).
    """
    if not len(model.p):
        raise InputError(f"varying_parameters: model {model.name!r} has no parameters; name some with p=")
    if not isinstance(model, ContinuousModel):
        raise InputError(f"varying_parameters: {model.name!r} must be a ContinuousModel or a DiscreteModel")
    if g is None and drift is None:
        raise InputError("varying_parameters: how fast? Give drift=, the largest |w_p|, or g(p, u, w)")
    nx, nw, discrete = len(model.x), len(model.w), model.step is not None
    names = tuple(f"w_{name}" for name in model.p.names) if drift is not None else ()
    sizes = np.empty(0) if drift is None else model.p.vector(
        drift if np.ndim(drift) or isinstance(drift, dict) else np.full(len(model.p), float(drift)), "drift"
    )  # fmt: skip
    own = g if g is not None else lambda p, u, w: (p if discrete else 0) + w[nw:]

    def f(t: Any, x: Any, u: Any, w: Any, p: Any) -> Any:
        return ca.vertcat(
            model.dynamics(t, x[:nx], u, w[:nw], x[nx:]), ca.vertcat(*ca.vertsplit(ca.SX(own(x[nx:], u, w))))
        )

    def h(t: Any, x: Any, u: Any, w: Any, p: Any) -> Any:
        return model.output(t, x[:nx], u, w[:nw], x[nx:])

    groups = {"x": (model.x, model.p), "w": (model.w,)}
    boxes = {
        key: {
            name: (float(a), float(b))
            for group in parts
            for name, a, b in zip(group, *box_arrays(group, _box(model, group), "bounds"), strict=True)
        }
        for key, parts in groups.items()
    }
    boxes["w"] |= {name: (-size, size) for name, size in zip(names, sizes, strict=True)}
    every = [group for key in "xupwy" for group in [getattr(model, key)]]
    options: dict[str, Any] = {
        "x": (*model.x.names, *model.p.names),
        "u": model.u.names,
        "w": (*model.w.names, *names),
        "y": model.y.names,
        "units": {name: unit for group in every for name, unit in zip(group.names, group.units, strict=True) if unit},
        "nominal": {name: float(size) for group in every for name, size in zip(group, group.nominal, strict=True)}
        | dict(zip(names, map(float, sizes), strict=True)),
        "bounds": Bounds(x=boxes["x"], w=boxes["w"], y=model.bounds.y, residual=model.bounds.residual),
        "name": f"{model.name}, parameters vary",
        "source": model.source,
    }
    return ContinuousModel(f, h, **options) if model.step is None else DiscreteModel(f, h, step=model.step, **options)


def _box(model: Model, group: Any) -> Any:
    return {"state": model.bounds.x, "parameter": model.bounds.p, "disturbance": model.bounds.w}[group.kind]
