"""Estimated trajectories, pieced together from one solution after the other.

A trajectory is kept as a `Log` of slots, its path. A row belongs to the time at which its slot ends and holds the
slot's start, from when on the row counts (a later solve never rewrites what an earlier one said), x, w, u0, u1, p, and
x at its end. The estimated trajectory (3.16) takes from every solution what is new at its end; a trajectory with a lag
takes it so many seconds before the end.
"""

from __future__ import annotations

import numpy as np

from ctmhe.data.log import Log
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Trajectory


def empty_path(stage: StageFunction) -> Log:
    """Return the path before the first estimate."""
    return Log(2 + 2 * stage.nx + stage.nw + 2 * stage.nu + stage.np)


def path_rows(trajectory: Trajectory, since: float) -> tuple[Array, Array]:
    """Return ends (m,) and rows (m, width) of the slots of a window's solution that reach beyond `since`."""
    t, last = trajectory.t, len(trajectory.t) - 2
    first = int(np.clip(np.searchsorted(t, since, side="right") - 1, 0, last))
    slots = np.array([k for k in range(first, last + 1) if t[k + 1] > t[k]], dtype=int)
    p = np.broadcast_to(trajectory.p, (len(slots), len(trajectory.p)))
    start = t[slots]
    parts = (start, np.maximum(start, since), trajectory.x[slots], trajectory.w[slots], trajectory.u0[slots],
             trajectory.u1[slots], p, trajectory.x[slots + 1])  # fmt: skip
    return t[slots + 1], np.column_stack(parts)


def path_at(stage: StageFunction, path: Log, t: float, tolerance: float) -> Array | None:
    """Return (x(t), p(t)) of a trajectory kept as a path, None where it is not kept. Of (3.16): the prior (3.18).

    Where a solve ends and the next begins, the earlier one counts (3.17). Times closer than `tolerance` (seconds) to
    that instant are that instant: round-off must not choose.
    """
    if t > path.last_time + tolerance:
        return None
    found = path.first_from(min(t - tolerance, path.last_time))
    if found is None:
        return None
    end, row = found
    sizes = (stage.nx, stage.nw, stage.nu, stage.nu, stage.np, stage.nx)
    x, w, u0, u1, p, x_end = np.split(row[2:], np.cumsum(sizes)[:-1])
    start, since = row[:2]
    if t <= since + tolerance:
        return None
    if t >= end:
        x = x_end
    elif t > start:
        x = _inside(stage, t, (start, end), (x, x_end), w, p, (u0, u1))
    return np.concatenate([x, p])


def lagged_rows(stage: StageFunction, trajectory: Trajectory, since: float, until: float) -> tuple[Array, Array]:
    """Return ends and rows, as `path_rows`, of the piece (since, until] of a window's solution."""
    ends, rows = path_rows(trajectory, since)
    kept = int(np.searchsorted(ends, until))
    if kept < len(ends):  # the last slot is cut at `until`
        nx, nw, nu = stage.nx, stage.nw, stage.nu
        row, start, end = rows[kept].copy(), rows[kept, 0], ends[kept]
        u1 = slice(2 + nx + nw + nu, 2 + nx + nw + 2 * nu)
        u0, share = row[u1.start - nu : u1.start], (until - start) / (end - start)
        row[u1] = u0 + (row[u1] - u0) * share
        row[len(row) - nx :] = trajectory_at(stage, trajectory, until)
        ends, rows = np.append(ends[:kept], until), np.vstack([rows[:kept], row])
    return ends, rows


def _inside(
    stage: StageFunction,
    t: float,
    span: tuple[float, float],
    ends: tuple[Array, Array],
    w: Array,
    p: Array,
    u: tuple[Array, Array],
) -> Array:
    """Return the state at `t` inside a slot whose ends are known: integrated, or if that fails on a straight line."""
    share = (t - span[0]) / (span[1] - span[0])
    try:
        return stage.step(span[0], t - span[0], ends[0], w, p, u[0], u[0] + (u[1] - u[0]) * share)[0]
    except FloatingPointError:
        return ends[0] + (ends[1] - ends[0]) * share


def trajectory_at(stage: StageFunction, trajectory: Trajectory, t: float) -> Array:
    """Return x(t) inside a trajectory, integrated from the node to its left with the stored w, p and u.

    A node's own value is returned as it is; left of the first node the first, right of the last the last.
    """
    nodes = trajectory.t
    k = int(np.searchsorted(nodes, t, side="left"))
    if k >= len(nodes):
        return trajectory.x[-1]
    if nodes[k] == t or k == 0:
        return trajectory.x[k]
    k -= 1
    inputs, ends = (trajectory.u0[k], trajectory.u1[k]), (trajectory.x[k], trajectory.x[k + 1])
    return _inside(stage, t, (nodes[k], nodes[k + 1]), ends, trajectory.w[k], trajectory.p, inputs)
