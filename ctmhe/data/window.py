"""What a window sees of a log: held, interpolated and point values on the slots of a mesh."""

from __future__ import annotations

import numpy as np

from ctmhe.types import Array


def held_inputs(times: Array, rows: Array, edges: Array, tolerance: float, linear: bool) -> tuple[Array, Array]:
    """Return the input at the start and the end of each slot (N, nu), linear in between.

    `edges` (N+1,) contain every switching time inside the window, to `tolerance` seconds. Before the first row its
    value holds; after the last one too.
    """
    starts, ends = edges[:-1], edges[1:]
    last = len(times) - 1
    i = np.clip(np.searchsorted(times, starts + tolerance, side="right") - 1, 0, last)
    u0 = rows[i]
    if not linear:
        return u0, u0.copy()
    j = np.minimum(i + 1, last)
    span = np.where(times[j] > times[i], times[j] - times[i], 1.0)
    slope = (rows[j] - rows[i]) / span[:, None]
    return (
        rows[i] + slope * np.clip(starts - times[i], 0.0, span)[:, None],
        rows[i] + slope * np.clip(ends - times[i], 0.0, span)[:, None],
    )


def held_signal(
    times: Array, values: Array, at: Array, slot_start: Array, tolerance: float, limit: float, linear: bool
) -> tuple[Array, Array]:
    """Return one sensor's reconstructed signal at times `at` (N, q) inside slots, and where it is known (N, q).

    Parameters
    ----------
    times, values : array (n,)
        The sensor's samples, ordered, without NaN.
    slot_start : array (N,)
        Slots do not straddle a sample, so the sample that holds on a slot is the last at or before its start.
    limit : float
        Seconds for which a sample is held (or interpolated from) when no newer one has come.
    """
    if not len(times):
        return np.zeros(at.shape), np.zeros(at.shape, dtype=bool)
    i = np.searchsorted(times, slot_start + tolerance, side="right") - 1
    before = i >= 0
    i = np.maximum(i, 0)
    value = np.broadcast_to(values[i][:, None], at.shape)
    if linear:
        j = np.minimum(i + 1, len(times) - 1)
        span = times[j] - times[i]
        slope = np.where(span > 0, (values[j] - values[i]) / np.where(span > 0, span, 1.0), 0.0)
        value = value + slope[:, None] * (at - times[i][:, None])
    middle = (slot_start + at[:, -1]) / 2  # slots do not straddle an expiry either: the middle decides
    known = np.broadcast_to((before & (middle - times[i] <= limit))[:, None], at.shape)
    return np.where(known, value, 0.0), known.copy()


def point_rows(times: Array, edges: Array, tolerance: float) -> tuple[Array, Array]:
    """Return `(sample, edge)` index pairs of the samples that lie on an edge, to `tolerance` seconds."""
    edge = np.clip(np.searchsorted(edges, times), 0, len(edges) - 1)
    below = np.maximum(edge - 1, 0)
    edge = np.where(np.abs(edges[below] - times) < np.abs(edges[edge] - times), below, edge)
    hit = np.abs(edges[edge] - times) <= tolerance
    return np.flatnonzero(hit), edge[hit]


def fed_inputs(
    inputs: tuple[Array, Array], measured: tuple[Array, Array], limit: float, cut: float = np.inf
) -> tuple[Array, Array]:
    """Return times and rows (u, y, known) of an observer that is fed with the measurements: see `observer_model`.

    Parameters
    ----------
    inputs : (times (m,), rows (m, nu))
        Held; before the first the first.
    measured : (times (n,), rows (n, ny))
        NaN where a sensor is silent. What a sensor said counts until it speaks again, or for `limit` seconds; then, and
        from `cut` seconds on, nothing of it is known: y and known are zero.
    """
    (u_times, u), (y_times, y) = inputs, measured
    spoken = np.isfinite(y)
    ends = np.minimum(y_times + limit, cut)
    nu, ny, near = u.shape[1], y.shape[1], 1e-9 * min(limit, 1.0)
    times = np.unique(np.concatenate([u_times, y_times, ends[np.isfinite(ends)]]))
    times = times[np.diff(times, append=np.inf) > near]  # a sample at which another expires is one time
    rows = np.zeros((len(times), nu + 2 * ny))
    if nu and len(u_times):
        rows[:, :nu] = u[np.clip(np.searchsorted(u_times, times + near, side="right") - 1, 0, len(u_times) - 1)]
    for s in range(ny):
        own, values = y_times[spoken[:, s]], y[spoken[:, s], s]
        i = np.searchsorted(own, times + near, side="right") - 1
        if len(own):
            known = (i >= 0) & (times < np.minimum(own[i] + limit, cut) - near)
            rows[:, nu + s] = np.where(known, values[i], 0.0)
            rows[:, nu + ny + s] = known
    return times, rows
