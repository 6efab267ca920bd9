"""An arrival cost that is updated: what left the window, condensed into a quadratic by one QR decomposition a slot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.priors.base import Anchor, Memory
from ctmhe.transcription.solved import Solved
from ctmhe.transcription.weights import weight_matrix
from ctmhe.types import Array

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State


class ArrivalUpdate:
    """Prior and weight that an extended Kalman filter would carry to the window's start: `MHE(prior=ArrivalUpdate())`.

    The cost of what has left the window, linearised at the last solution that covered it, is minimised over everything
    but the state at the new start. What remains is |x - x_bar|^2_P: thesis 4.2.6, after Kuehl et al. (2011). The first
    prior and weight are the initial estimate and the cost's P, which must be positive definite. Slots count as
    disturbance cells of their own. There is no guarantee (thesis 4.2.6).
    """

    reach = 0.0

    def begin(self, mhe: MHE, state: State) -> Memory:
        """Return the initial estimate with the cost's weight."""
        if mhe.assembly.p_estimated or callable(mhe.cost.P):
            raise InputError("ArrivalUpdate: the cost's P must be a constant weight of the states, and only of them")
        weight = weight_matrix(mhe.cost.P, mhe.assembly.prior_names, "cost weight P")
        if np.linalg.eigvalsh(weight)[0] <= 0:
            raise InputError(
                f"ArrivalUpdate: the cost's P must be positive definite, got {weight.tolist()}; a small one says little"
            )
        nx, nw = mhe.stage.nx, mhe.stage.nw
        return {"arrival": _entry(state.t0, state.start[:nx], weight), "points": Log(nx + nw)}

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """Return the prior and its weight at the window's start."""
        if start > state.t + mhe.slack(state.t):
            return None
        x, weight = self._carried(mhe, state, start)
        return Anchor(np.concatenate([x, state.p]), weight=weight)

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """Return the arrival cost at the solved window's start, and the solution to linearise at from there on."""
        t = solved.part("t")
        start, last = float(t[0]), solved.trajectory
        if start > state.memory["arrival"].last_time or not len(state.memory["points"]):
            x, weight = self._carried(mhe, state, min(start, state.t))
            entry = _entry(start, x, weight)
        else:
            entry = state.memory["arrival"]
        live = np.flatnonzero(np.diff(t) > 0)
        rows = np.column_stack([last.x[live], last.w[live]])
        return {"arrival": entry, "points": Log.of(t[live], rows, rows.shape[1])}

    def _carried(self, mhe: MHE, state: State, start: float) -> tuple[Array, Array]:
        """Return prior (nx,) and weight (nx, nx) at `start`, from where they are known."""
        stage, assembly, nx = mhe.stage, mhe.assembly, mhe.stage.nx
        times, rows = state.memory["arrival"].arrays(np.inf)
        since, x, weight = float(times[0]), rows[0, :nx], rows[0, nx:].reshape(nx, nx)
        when, points = state.memory["points"].arrays(np.inf)
        if start <= since + mhe.slack(start) or not len(when):
            return x, weight
        prior, records = np.concatenate([x, state.p]), mhe.records(state, since, start)
        gone = assembly.window(since, start, records, prior, growing=False, prior_weight=weight)
        mesh = gone.mesh
        slots = [k for k in range(len(mesh)) if mesh.h[k] > 0]
        near = np.clip(np.searchsorted(when, mesh.t[:-1] + mesh.tolerance) - 1, 0, len(when) - 1)
        xs = np.column_stack([np.interp(mesh.t[:-1], when, points[:, i]) for i in range(nx)])
        ws = points[near, nx:]
        linear = stage.linearize(mesh.t[:-1], mesh.h, xs, ws, state.p, gone.u0, gone.u1)
        root = gone.L_prior
        for k in slots:
            jacobian = linear.jacobian[k, :, : nx + stage.nw]
            output = jacobian[nx:].reshape(stage.q, stage.ny, -1)
            missed = (gone.L_y[k] @ (linear.y[k] - gone.y_data[k])[..., None]).ravel()
            rows = np.vstack(
                [
                    np.hstack([root, np.zeros((nx, stage.nw))]),
                    (gone.L_y[k] @ output).reshape(-1, nx + stage.nw),
                    np.hstack([np.zeros((stage.nw, nx)), gone.L_w[k]]),
                ]
            )
            right = -np.concatenate([root @ (xs[k] - x), missed, gone.L_w[k] @ ws[k]])
            orthogonal, triangle = np.linalg.qr(rows)
            step = np.linalg.solve(triangle, orthogonal.T @ right)
            x = linear.x_next[k] + jacobian[:nx] @ step
            spread = np.linalg.solve(triangle.T, jacobian[:nx].T)  # its square is the covariance of x
            root = np.linalg.inv(np.linalg.qr(spread, mode="r")).T
        return x, root.T @ root


def _entry(t: float, x: Array, weight: Array) -> Log:
    row = np.concatenate([x, weight.ravel()])
    return Log(len(row)).put(t, row)
