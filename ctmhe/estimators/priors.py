"""The estimated trajectory (3.16) and the priors read from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Trajectory


@dataclass(frozen=True, eq=False)
class Piece:
    """One segment of the estimated trajectory: valid on (start, end], taken from one solve and never rewritten."""

    start: float
    end: float
    trajectory: Trajectory

    @classmethod
    def of(cls, trajectory: Trajectory, start: float) -> Piece:
        """Cut the slots of a window's solution that reach beyond `start`."""
        t = trajectory.t
        first = int(np.clip(np.searchsorted(t, start, side="right") - 1, 0, len(t) - 2))
        cut = Trajectory(
            t[first:],
            trajectory.x[first:],
            trajectory.w[first:],
            trajectory.y[first:],
            trajectory.u0[first:],
            trajectory.u1[first:],
            trajectory.p,
        )
        return cls(start, float(t[-1]), cut)


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
    length, passed = nodes[k + 1] - nodes[k], t - nodes[k]
    u0 = trajectory.u0[k]
    u = u0 + (trajectory.u1[k] - u0) * (passed / length)
    x, _ = stage.step(nodes[k], passed, trajectory.x[k], trajectory.w[k], trajectory.p, u0, u)
    return x


def piece_at(pieces: tuple[Piece, ...], t: float, tolerance: float) -> Piece | None:
    """Return the piece whose solve is the first at or after `t` (3.17), None when `t` lies outside what is kept.

    Times closer than `tolerance` (seconds) to a solve instant are that instant: round-off must not choose the piece.
    """
    if not pieces or t > pieces[-1].end + tolerance or t <= pieces[0].start + tolerance:
        return None
    low, high = 0, len(pieces) - 1
    while low < high:
        middle = (low + high) // 2
        if pieces[middle].end >= t - tolerance:
            high = middle
        else:
            low = middle + 1
    return pieces[low]


def filtering_prior(stage: StageFunction, pieces: tuple[Piece, ...], t: float, tolerance: float) -> Array | None:
    """Return (x_hat(t), p_hat(t)) of the estimated trajectory: the prior (3.18). None where it is not kept."""
    piece = piece_at(pieces, t, tolerance)
    if piece is None:
        return None
    t = min(t, piece.end)
    return np.concatenate([trajectory_at(stage, piece.trajectory, t), piece.trajectory.p])
