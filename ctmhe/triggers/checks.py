"""Arguments of policies are checked: numbers, thresholds for outputs, weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.triggers.base import TriggerContext
from ctmhe.types import Array, names_of


def positive(value: Any, what: str, *, zero: bool = False, infinite: bool = False) -> float:
    """Return `value` as a float, or raise when it is not a positive finite number; 0 and inf on request."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be a number, got {value!r}") from None
    if isinstance(value, (bool, np.bool_, str)):
        raise InputError(f"{what} must be a number, got {value!r}")
    if not ((number > 0 or (zero and number == 0)) and (infinite or np.isfinite(number))):
        expected = ("" if infinite else "finite and ") + (">= 0" if zero else "positive")
        raise InputError(f"{what} must be {expected}, got {value!r}")
    return number


def whole(value: Any, what: str, *, least: int) -> int:
    """Return `value` as an int, or raise when it is no whole number >= `least`."""
    try:
        number = int(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be a whole number, got {value!r}") from None
    if isinstance(value, (bool, np.bool_, str)) or number != value or number < least:
        raise InputError(f"{what} must be a whole number >= {least}, got {value!r}")
    return number


def thresholds(
    value: ArrayLike | Mapping[str, float], outputs: str | Sequence[str] | None, what: str
) -> tuple[float | tuple[float, ...], tuple[str, ...] | None]:
    """Return thresholds >= 0, one for all outputs or one each, and the names of the outputs they are for.

    A mapping names its outputs. `what` is the policy and the argument, as in "SendOnDelta: delta".
    """
    policy = what.partition(":")[0]
    if isinstance(value, Mapping):
        if outputs is not None:
            raise InputError(f"{policy}: a mapping names its outputs; leave outputs= out")
        outputs, value = tuple(value), list(value.values())
    try:
        numbers = tuple(float(d) for d in np.atleast_1d(np.asarray(value, dtype=float)))
    except (TypeError, ValueError):
        raise InputError(f"{what} must be numbers, got {value!r}") from None
    if not numbers or not all(d >= 0 for d in numbers):
        raise InputError(f"{what} must be >= 0, got {value!r}")
    names = None if outputs is None else names_of(outputs)
    if names is not None and len(numbers) not in (1, len(names)):
        raise InputError(f"{policy}: {len(numbers)} thresholds for {len(names)} outputs")
    return numbers[0] if len(numbers) == 1 else numbers, names


def watched(ctx: TriggerContext, outputs: Sequence[str] | None) -> np.ndarray:
    """Return the positions in y of the named outputs, or of all."""
    if outputs is None:
        return np.arange(ctx.y.size)
    return np.array([ctx.output_index(name) for name in outputs], dtype=int)


def spread_over(values: Any, chosen: np.ndarray, ctx: TriggerContext) -> Array:
    """Return thresholds for the chosen outputs, one each."""
    array = np.asarray(values, dtype=float)
    if array.size not in (1, chosen.size):
        raise InputError(f"{array.size} thresholds for {chosen.size} outputs ({', '.join(ctx.outputs)})")
    return np.broadcast_to(array.ravel(), chosen.shape)


def largest_excess(excess: Array, counted: np.ndarray) -> float:
    """Return the largest of those entries that count, -inf when none does."""
    return float(np.max(excess[counted])) if counted.any() else -np.inf


def largest_move(y: Array, held: Array, delta: Array) -> float:
    """Return the largest excess of |y - held| over finite `delta` (n,); +inf where nothing is held (NaN) yet."""
    moved = np.where(np.isnan(held), np.inf, np.abs(y - held))
    counted = ~np.isnan(y) & np.isfinite(delta)
    return largest_excess(moved - np.where(counted, delta, 0.0), counted)


def weight_matrix(value: ArrayLike, what: str, *, definite: bool) -> tuple[tuple[float, ...], ...]:
    """Return a symmetric positive (semi)definite matrix as a tuple of rows; a number or vector is its diagonal."""
    try:
        matrix = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be numbers, got {value!r}") from None
    matrix = np.diag(np.atleast_1d(matrix)) if matrix.ndim < 2 else matrix
    square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1] and matrix.size > 0
    if square and np.isfinite(matrix).all() and np.allclose(matrix, matrix.T):
        values = np.linalg.eigvalsh(matrix)
        if (values > 0).all() or (not definite and (values >= -1e-12 * np.abs(values).max()).all()):
            return tuple(map(tuple, matrix.tolist()))
    kind = "definite" if definite else "semidefinite"
    diagonal = "variances > 0" if definite else "weights >= 0"
    raise InputError(f"{what} must be a symmetric positive {kind} matrix, or {diagonal}")


def matrix_for(rows: Any, ctx: TriggerContext, what: str) -> Array:
    """Return a checked matrix for the outputs of the context; a single number counts for every output."""
    matrix = np.asarray(rows, dtype=float)
    if matrix.shape == (1, 1):
        return matrix[0, 0] * np.eye(ctx.y.size)
    if matrix.shape[0] != ctx.y.size:
        raise InputError(f"{what} is {matrix.shape}, but there are {ctx.y.size} outputs ({', '.join(ctx.outputs)})")
    return matrix
