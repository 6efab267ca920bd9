"""A prior weight that follows the covariance of an extended Kalman filter: W(t) of thesis (6.63)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.priors.base import Anchor, Memory, Prior, prior_of
from ctmhe.estimators.trajectories import path_at
from ctmhe.transcription.solved import Solved
from ctmhe.types import Array

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State

COVARIANCES = "covariances"


@dataclass(frozen=True)
class KalmanWeight:
    """The prior of another rule, weighted by the inverse covariance of an extended Kalman filter.

    The filter's covariance starts as the inverse of P. At every measurement it is updated, with the output's Jacobian
    at the estimate of that time, and between them it is carried along the estimate (thesis 6.4.2: the well-known
    formulas). A window that starts at t is given the inverse of the covariance at t that knows what was measured before
    the window; the covariances of one horizon are remembered. A measurement that comes late, or again, changes the
    windows but no covariance.

    Parameters
    ----------
    rule : {"filtering", "smoothing", "turnpike"} or Prior
        Where the prior's mean comes from.

    Raises
    ------
    InputError
        By `MHE.init`: for held outputs (their weight R counts per second; a filter takes samples), outputs that a
        disturbance enters, estimated parameters, or a P without inverse.
    """

    rule: str | Prior = "filtering"

    @property
    def reach(self) -> float:
        """As far as the rule."""
        return prior_of(self.rule).reach

    def begin(self, mhe: MHE, state: State) -> Memory:
        """See `Prior`."""
        held = [name for name, kind in mhe.hold.items() if kind != "point"]
        if held:
            raise InputError(f'KalmanWeight takes samples, and {", ".join(held)} is held: use hold="point"')
        if mhe.assembly.p_estimated:
            raise InputError("KalmanWeight weighs states; parameters are estimated here: weigh them by P itself")
        covariance = mhe.prior_covariance(state.t0)
        if not np.isfinite(covariance).all():
            raise InputError("KalmanWeight starts from the inverse of P, which must be positive definite")
        if mhe.stage.nw and np.any(_output_jacobian(mhe, state, state.t0, state.x)[:, mhe.stage.nx :]):
            raise InputError("KalmanWeight: a disturbance enters the outputs; let the residual be the noise instead")
        row = np.concatenate([state.x, covariance.reshape(-1), covariance.reshape(-1)])
        before = float(np.nextafter(state.t0, -np.inf))  # what is measured at t0 is still to come
        return {**prior_of(self.rule).begin(mhe, state), COVARIANCES: Log.of([before], row, len(row))}

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`."""
        anchor = prior_of(self.rule).at(mhe, state, start, growing)
        if anchor is None or growing:
            return anchor
        times, rows = state.memory[COVARIANCES].arrays(start + mhe.slack(start))
        if not len(times):
            return anchor
        x, before, covariance = _split(mhe, rows[-1])
        if times[-1] < start - mhe.slack(start):
            covariance = mhe.propagate_covariance(state, float(times[-1]), start, x, state.p, covariance)
        elif mhe.model.step is not None:
            covariance = before  # a discrete window counts the measurement at its start itself
        return replace(anchor, weight=np.linalg.inv(covariance))

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        memory = prior_of(self.rule).after(mhe, state, solved)
        if mhe.horizon == np.inf:  # a window without end keeps its first weight
            return {**memory, COVARIANCES: state.memory[COVARIANCES]}
        log = state.memory[COVARIANCES].drop_after(state.since)
        times, rows = state.measurements.arrays(state.t + mhe.slack(state.t))
        last, row = (values[-1] for values in log.arrays())
        x, _, covariance = _split(mhe, row)
        for t, y in zip(times.tolist(), rows, strict=True):
            if t <= last:
                continue
            before = mhe.propagate_covariance(state, max(float(last), state.t0), t, x, state.p, covariance)
            estimated = path_at(mhe.stage, state.path, t, mhe.slack(t))
            x = state.x if estimated is None else estimated[: mhe.stage.nx]
            covariance = _updated(mhe, state, t, x, before, np.isfinite(y))
            log, last = log.put(t, np.concatenate([x, before.reshape(-1), covariance.reshape(-1)])), t
        # the last one before the next window's start still counts
        log = log.drop_before(state.t - mhe.horizon - mhe.interval, keep_holding=True)
        return {**memory, COVARIANCES: log}


def _split(mhe: MHE, row: Array) -> tuple[Array, Array, Array]:
    """Return the estimate at a measurement, and the covariance before and after it."""
    nx = mhe.stage.nx
    before, after = row[nx:].reshape(2, nx, nx)
    return row[:nx], before, after


def _output_jacobian(mhe: MHE, state: State, t: float, x: Array) -> Array:
    """Return the Jacobian (ny, nx + nw) of the outputs at `t`."""
    stage = mhe.stage
    rows = state.inputs.arrays(t + mhe.slack(t))[1]
    u = rows[-1] if len(rows) else np.zeros(stage.nu)
    none, still = np.zeros((1, stage.nw)), np.zeros(1)
    linear = stage.linearize(np.array([t]), still, x[None], none, state.p, u[None], u[None])
    return linear.jacobian[0, -stage.ny :, : stage.nx + stage.nw]


def _updated(mhe: MHE, state: State, t: float, x: Array, covariance: Array, known: Array) -> Array:
    """Return the covariance after the known outputs at `t`."""
    assembly, nx = mhe.assembly, mhe.stage.nx
    root = (assembly.R if mhe.model.step is not None else assembly.R_point).root(t, known)
    C = root @ _output_jacobian(mhe, state, t, x)[:, :nx]  # outputs of unit variance; none where nothing was measured
    gain = np.linalg.solve(C @ covariance @ C.T + np.eye(len(C)), C @ covariance).T
    remaining = np.eye(nx) - gain @ C
    return remaining @ covariance @ remaining.T + gain @ gain.T
