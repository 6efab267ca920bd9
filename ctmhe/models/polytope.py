"""Polytopes of linear models: a mixture of vertices, whose weights are the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.types import Array, Bounds, names_of


def polytope(
    A: Sequence[Any],
    C: Sequence[Any],
    *,
    B: Any = None,
    step: float | None = None,
    x: str | Sequence[str] = (),
    y: str | Sequence[str] = (),
    u: str | Sequence[str] = (),
    start: Any = None,
    name: str = "polytope",
    **about: Any,
) -> ContinuousModel:
    """Return the model x(k+1) = sum_i alpha_i A_i x + B u + w, y = sum_i alpha_i C_i x: paper 003, (5).

    The mixing weights alpha1, ..., alphaq are the parameters; they lie on the simplex, which `DualIterations` sees to.
    Every state has a disturbance: process noise and what the mixture cannot say (w and d of the paper, whose sum alone
    matters). With one vertex there are no parameters: a linear model.

    Parameters
    ----------
    A : sequence of q arrays (nx, nx)
        Vertices: per step, or in continuous time dx/dt = sum_i alpha_i A_i x + B u + w.
    C : sequence of q arrays (ny, nx), or one for all
    B : array (nx, nu), optional
        The same for all vertices.
    step : float, optional
        Seconds; continuous time when left out.
    x, y, u : sequence of str, optional
        Names; x1, x2, ..., y1, ... when left out.
    start : array (q,), optional
        Weights when none are given; all the same when left out.
    name : str
    **about
        `units`, `nominal`, `source` of the model.

    Raises
    ------
    InputError
        For vertices that do not fit each other, and a start off the simplex.
    """
    vertices = [_matrix(a, "A") for a in A]
    if not vertices:
        raise InputError("polytope: no vertices")
    nx, q = len(vertices[0]), len(vertices)
    outputs = [_matrix(c, "C") for c in C] if np.ndim(C) == 3 else [_matrix(C, "C")] * q
    if len(outputs) == 1:
        outputs *= q
    for i, (a, c) in enumerate(zip(vertices, outputs, strict=False)):
        if a.shape != (nx, nx) or c.shape != (len(outputs[0]), nx):
            raise InputError(
                f"polytope: vertex {i + 1} has A {a.shape} and C {c.shape}, expected ({nx}, {nx}) and "
                f"({len(outputs[0])}, {nx}) like the first"
            )
    if len(outputs) != q:
        raise InputError(f"polytope: {q} vertices A but {len(outputs)} of C; give one C, or as many")
    drive = np.zeros((nx, 0)) if B is None else _matrix(B, "B")
    states = names_of(x) or tuple(f"x{i + 1}" for i in range(nx))
    weights = tuple(f"alpha{i + 1}" for i in range(q)) if q > 1 else ()
    share = np.full(q, 1.0 / q) if start is None else on_simplex(start, "polytope: start", q)

    def mixed(parts: list[Array], p: Any) -> Any:
        return sum((p[i] * ca.DM(part) for i, part in enumerate(parts)), ca.SX(0)) if q > 1 else ca.DM(parts[0])

    def f(t: Any, x: Any, u: Any, w: Any, p: Any) -> Any:
        return mixed(vertices, p) @ x + ca.DM(drive) @ u + w

    def h(t: Any, x: Any, u: Any, w: Any, p: Any) -> Any:
        return mixed(outputs, p) @ x

    kind: Any = ContinuousModel if step is None else DiscreteModel
    timing = {} if step is None else {"step": step}
    return kind(
        f,
        h,
        **timing,
        x=states,
        y=names_of(y) or tuple(f"y{i + 1}" for i in range(len(outputs[0]))),
        u=names_of(u) or tuple(f"u{i + 1}" for i in range(drive.shape[1])),
        w=tuple(f"w_{label}" for label in states),
        p=weights,
        p_start=share if q > 1 else None,
        bounds=Bounds(p=(0.0, 1.0) if q > 1 else None),
        name=name,
        **about,
    )


def mixture(parts: Sequence[Any], weights: Any) -> Array:
    """Return sum_i weights_i parts_i, of arrays of one shape, for weights on the simplex."""
    arrays = [_matrix(part, "vertex") for part in parts]
    return np.tensordot(on_simplex(weights, "mixture: weights", len(arrays)), np.array(arrays), axes=1)


def on_simplex(weights: Any, what: str, q: int) -> Array:
    """Return weights (q,) as an array, or raise `InputError` when they are negative or do not sum to one."""
    try:
        values = np.asarray(weights, dtype=float).reshape(-1)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected {q} numbers, got {weights!r}") from None
    if values.shape != (q,) or not np.isfinite(values).all():
        raise InputError(f"{what}: expected {q} mixing weights, got {weights!r}")
    if (values < -1e-9).any() or abs(values.sum() - 1) > 1e-6:
        raise InputError(
            f"{what}: mixing weights must be >= 0 and sum to 1, got {np.round(values, 6).tolist()} with sum "
            f"{values.sum():.6g}; divide them by their sum"
        )
    return values


def _matrix(values: Any, what: str) -> Array:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"polytope: {what} must be arrays of numbers, got {values!r}") from None
    array = np.atleast_2d(array)
    if array.ndim != 2 or not np.isfinite(array).all():
        raise InputError(f"polytope: {what} must be finite arrays with two dimensions, got shape {array.shape}")
    return array
