"""What tables and figures share: a mean's confidence interval, and points that no other point beats."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array


def interval(values: Array, confidence: float = 0.95) -> tuple[float, float, float, float]:
    """Return mean, standard deviation and Student's confidence interval (low, high) of the mean.

    NaN where there are too few values (n,): all for none, all but the mean for one.
    """
    if not 0 < confidence < 1:
        raise InputError(f"confidence must lie between 0 and 1, got {confidence!r}")
    n = len(values)
    if n < 2:
        return (float(np.mean(values)) if n else np.nan), np.nan, np.nan, np.nan
    from scipy.special import stdtrit

    mean, sd = float(np.mean(values)), float(np.std(values, ddof=1))
    half = float(stdtrit(n - 1, 0.5 + confidence / 2)) * sd / np.sqrt(n)
    return mean, sd, mean - half, mean + half


def non_dominated(points: Any) -> Array:
    """Return which points no other point beats, (n,) of bool, all columns to be minimised.

    A point is beaten by one that is nowhere larger and somewhere smaller; a point with a NaN is no candidate.

    Parameters
    ----------
    points : array (n, m)
    """
    array = np.asarray(points, dtype=float)
    if array.ndim != 2:
        raise InputError(f"non_dominated: expected points of shape (n, m), got {array.shape}")
    kept: Array = np.all(~np.isnan(array), axis=1)
    others = array[kept]
    for i in np.flatnonzero(kept):
        kept[i] = not ((others <= array[i]).all(axis=1) & (others < array[i]).any(axis=1)).any()
    return kept
