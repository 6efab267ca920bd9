"""The mesh of a window: slots between the union of cell edges, measurements and input switches."""

from __future__ import annotations

from dataclasses import dataclass
from math import ulp

import numpy as np

from ctmhe.types import Array

ROUND_OFF = 1e-9  # times the shooting interval: edges closer than this are the same instant


def same_time(interval: float, t: float) -> float:
    """Return how close two times near `t` must be to count as one: round-off of the interval or of the clock."""
    return max(ROUND_OFF * interval, 8 * ulp(t))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Slots of a window.

    Attributes
    ----------
    t : array (N+1,)
        Edges in seconds; the first and last are the window's.
    h : array (N,)
        Lengths; a slot may have length zero.
    shared : bool array (N,)
        Slot k+1 lies in the same disturbance cell as slot k and shares its w (False at the last).
    cell : int array (N,)
        Absolute number of the disturbance cell: cell j spans [j interval, (j+1) interval].
    tolerance : float
        Seconds below which two instants are the same.
    """

    t: Array
    h: Array
    shared: np.ndarray
    cell: np.ndarray
    tolerance: float

    def __len__(self) -> int:
        return len(self.h)


def build_mesh(start: float, end: float, interval: float, instants: Array, *, sample_at_start: bool) -> Mesh:
    """Return the mesh of [start, end].

    Parameters
    ----------
    start, end : float
        The window's edges.
    interval : float
        Length of a disturbance cell; cells are anchored at its absolute multiples, whatever the window's edges.
    instants : array
        Measurement times and input switches, in any order, also outside the window.
    sample_at_start : bool
        Put a slot of length zero in front, whose end is the window's start: a sample there has its residual at once.
    """
    tolerance = same_time(interval, end)
    cells = np.arange(np.floor(start / interval), np.ceil(end / interval) + 1) * interval
    inside = np.concatenate([cells, instants])
    inside = np.sort(inside[(inside > start + tolerance) & (inside < end - tolerance)])
    if len(inside):
        inside = inside[np.concatenate([[True], np.diff(inside) > tolerance])]
    edges = np.concatenate([[start], inside, [end]])
    if sample_at_start and end > start:
        edges = np.concatenate([[start], edges])
    h = np.diff(edges)
    cell = np.floor((edges[:-1] + 0.5 * h) / interval + ROUND_OFF).astype(np.int64)
    if sample_at_start and end > start:
        cell[0] = cell[1]
    shared = np.concatenate([cell[1:] == cell[:-1], [False]])
    return Mesh(edges, h, shared, cell, tolerance)


def plain_mesh(start: float, end: float, interval: float) -> Mesh:
    """Return the mesh of [start, end] with no other edges than those of cells: `build_mesh` in few operations."""
    tolerance = same_time(interval, end)
    first, last = int(np.floor(start / interval)), int(np.ceil(end / interval))
    inside = [t for t in (k * interval for k in range(first, last + 1)) if start + tolerance < t < end - tolerance]
    edges = np.array([start, *inside, end])
    cells = np.arange(len(edges) - 1) + int(np.floor(0.5 * (edges[0] + edges[1]) / interval + ROUND_OFF))
    return Mesh(edges, np.diff(edges), np.zeros(len(cells), dtype=bool), cells, tolerance)


def discounted_length(t: Array, h: Array, end: float, rate: float) -> Array:
    """Return the integral of exp(-rate (end - tau)) over each slot [t, t + h], exact and stable for small rate h."""
    if rate < 1e-200:  # none, or so little that the product below underflows
        return h.copy()
    return np.exp(-rate * (end - t - h)) * (-np.expm1(-rate * h)) / rate
