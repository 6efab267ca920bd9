"""Weights as square roots: user forms, checks, missing sensors, variation in time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array


def weight_matrix(value: Any, names: tuple[str, ...], what: str) -> Array:
    """Return a weight given as scalar, diagonal, matrix or mapping as a symmetric matrix (n, n).

    Raises
    ------
    InputError
        For unknown names, wrong shapes, entries that are not finite, matrices that are not symmetric or have a negative
        eigenvalue (beyond round-off).
    """
    n = len(names)
    if isinstance(value, Mapping):
        unknown = [name for name in value if name not in names]
        absent = [name for name in names if name not in value]
        if unknown or absent:
            listed = ", ".join(unknown or absent)
            raise InputError(f"{what}: {'unknown' if unknown else 'no weight for'} {listed}. Known: {', '.join(names)}")
        value = [value[name] for name in names]
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{what}: weights must be numbers, got {value!r}") from None
    if array.ndim == 0:
        array = np.full(n, float(array))
    if array.ndim == 1 and len(array) == n:
        array = np.diag(array)
    if array.shape != (n, n):
        raise InputError(
            f"{what}: expected a scalar, {n} diagonal entries or a ({n}, {n}) matrix for {', '.join(names)}; "
            f"got shape {array.shape}"
        )
    if not np.isfinite(array).all():
        i = int(np.argwhere(~np.isfinite(array))[0][0])
        raise InputError(f"{what}: the weight of {names[i]!r} is not finite")
    size = np.abs(array).max(initial=0.0)
    if not np.allclose(array, array.T, rtol=0, atol=1e-9 * size):
        raise InputError(f"{what}: the matrix is not symmetric")
    array = (array + array.T) / 2
    if n:
        values, vectors = np.linalg.eigh(array)
        if values[0] < -1e-9 * max(size, 1e-300):
            culprit = names[int(np.argmax(np.abs(vectors[:, 0])))]
            raise InputError(
                f"{what}: the matrix is indefinite (smallest eigenvalue {values[0]:.3g}, mostly along {culprit!r}); "
                "weights must be positive semidefinite"
            )
    return array


def square_root(matrix: Array) -> Array:
    """Return a factor L (n, n) with L' L = matrix, for a positive semidefinite matrix."""
    if not len(matrix):
        return matrix.copy()
    if not (matrix - np.diag(np.diagonal(matrix))).any():
        return np.diag(np.sqrt(np.maximum(np.diagonal(matrix), 0.0)))
    try:
        return np.linalg.cholesky(matrix).T
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
        return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def observed_part(matrix: Array, observed: np.ndarray) -> Array:
    """Return the weight when only some sensors speak.

    The rows and columns of the *covariance* of silent sensors are dropped, not those of the weight: correlated noise
    of a silent sensor is unknown, not zero. (n, n) with zeros for silent sensors.
    """
    if observed.all():
        return matrix
    keep = np.flatnonzero(observed)
    silent = np.flatnonzero(~observed)
    result = np.zeros_like(matrix)
    block = matrix[np.ix_(keep, keep)]
    cross = matrix[np.ix_(keep, silent)]
    if cross.any():  # Schur complement = inverse of the covariance's block
        block = block - cross @ np.linalg.pinv(matrix[np.ix_(silent, silent)]) @ cross.T
    result[np.ix_(keep, keep)] = block
    return result


class WeightFunction:
    """A weight that may vary in time, with the square roots of its observed parts cached while it is constant."""

    def __init__(self, value: Any, names: tuple[str, ...], what: str):
        self.names, self.what = names, what
        self._function: Callable[[float], Any] | None = value if callable(value) else None
        self._constant = None if callable(value) else weight_matrix(value, names, what)
        self._roots: dict[bytes, Array] = {}
        if self._function is None:
            self.root(0.0)

    @property
    def constant(self) -> bool:
        """Whether the weight is the same at all times."""
        return self._constant is not None

    @property
    def is_zero(self) -> bool:
        """Whether this weight is identically zero."""
        return self._constant is not None and not self._constant.any()

    def at(self, t: float) -> Array:
        """Return the matrix at time `t`."""
        if self._constant is not None:
            return self._constant
        assert self._function is not None
        return weight_matrix(self._function(t), self.names, f"{self.what} at t = {t:g}")

    def root(self, t: float, observed: np.ndarray | None = None) -> Array:
        """Return L with L' L = the weight at `t`, restricted to the observed sensors."""
        everything = observed is None or bool(observed.all())
        key = b"" if everything else observed.tobytes()  # type: ignore[union-attr]
        if self._constant is not None and key in self._roots:
            return self._roots[key]
        matrix = self.at(t)
        root = square_root(matrix if everything else observed_part(matrix, observed))  # type: ignore[arg-type]
        if self._constant is not None:
            self._roots[key] = root
        return root

    def roots(self, t: Array, observed: np.ndarray | None = None) -> Array:
        """Return the factors (N, n, n) at times `t` (N,), each for its row of `observed` (N, n)."""
        n = len(self.names)
        if self._constant is not None and (observed is None or observed.all()):
            return np.broadcast_to(self.root(0.0), (len(t), n, n))
        result = np.empty((len(t), n, n))
        if self._constant is not None and observed is not None:
            patterns, inverse = np.unique(observed, axis=0, return_inverse=True)
            for i, pattern in enumerate(patterns):
                result[inverse.reshape(-1) == i] = self.root(0.0, pattern)
            return result
        for k, time in enumerate(t):
            result[k] = self.root(float(time), None if observed is None else observed[k])
        return result
