"""How good a trajectory of estimates is without knowing the truth: performance (6.53) and regret (6.54), (6.60)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.errors import InputError
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.offline.nonlinear import OfflineEstimate, estimate_offline, records_of
from ctmhe.transcription.assembly import Assembly, Records
from ctmhe.transcription.problem import Guess, Window, cost_of
from ctmhe.types import Array, frozen

NEWTON_STEPS = 20


def rebuilt_disturbance(mhe: MHE, log: MeasurementLog, t: Array, x: Array, *, p: Any = None) -> tuple[Array, Array]:
    """Return the disturbance that makes a trajectory of the model out of estimates (6.52).

    Between two nodes the smallest w, in the norm of Q, that takes one estimate to the next. In continuous time w is
    constant between nodes, which are the cell edges, samples and input switches; unlike an estimator's, it may then
    differ within a cell.

    Parameters
    ----------
    mhe : MHE
        Model, transcription and weights.
    log : MeasurementLog
        Data and inputs.
    t : array (n,), x : array (n, nx)
        Estimates; all nodes between the first and the last time must be among them.
    p : array (np,), optional
        Parameters; the model's start values when left out.

    Returns
    -------
    t : array (m + 1,)
        Nodes, seconds.
    w : array (m, nw)

    Raises
    ------
    InputError
        When estimates are missing at nodes, or the disturbance does not reach all states (6.49).
    """
    window, w = _rebuilt(mhe, log, t, x, p)
    return frozen(window.mesh.t), frozen(w)


def performance(mhe: MHE, log: MeasurementLog, t: Array, x: Array, *, p: Any = None) -> float:
    """Return J (6.53) of estimates over [t[0], t[-1]]: what the disturbance and the output errors cost.

    The stage cost of the estimator, undiscounted, without prior and terminal cost: the sum over the steps j < t[-1] in
    discrete time, the integral (and the samples in (t[0], t[-1]]) in continuous time.

    Parameters and errors as for `rebuilt_disturbance`.
    """
    window, w = _rebuilt(mhe, log, t, x, p)
    mesh = window.mesh
    nodes = _at_nodes(mhe, mesh.t, np.asarray(t, float), np.asarray(x, float))
    point = Guess.of(nodes, w, window.prior[mhe.stage.nx :], mhe.stage.ny)
    _, y = mhe.stage.values(mesh.t[:-1], mesh.h, nodes[:-1], w, point.p, window.u0, window.u1)
    return cost_of(window, point, y)


@dataclass(frozen=True)
class Regret:
    """What estimates cost beyond a benchmark, over the same stretch of time.

    Attributes
    ----------
    performance, benchmark : float
        J (6.53) of both.
    length : float
        Seconds.
    """

    performance: float
    benchmark: float
    length: float

    @property
    def total(self) -> float:
        """J - J_benchmark: the left side of (6.60)."""
        return self.performance - self.benchmark

    @property
    def rate(self) -> float:
        """Regret per second: what stays bounded, and vanishes with a growing delay (6.61)."""
        return self.total / self.length

    @property
    def relative(self) -> float:
        """Regret relative to the benchmark's cost: epsilon of (6.54) where the second term is neglected."""
        return self.total / self.benchmark if self.benchmark > 0 else float("inf") if self.total > 0 else 0.0


def regret(
    mhe: MHE, log: MeasurementLog, t: Array, x: Array, benchmark: Array | OfflineEstimate | Benchmark, *, p: Any = None
) -> Regret:
    """Return the empirical regret of estimates against a benchmark at the same times (6.54), (6.60).

    Parameters
    ----------
    benchmark : array (n, nx), or OfflineEstimate or Benchmark with states at `t`
        Such as the full problem's solution, or `infinite_horizon`'s.

    Other parameters and errors as for `rebuilt_disturbance`.
    """
    t = np.asarray(t, float)
    if isinstance(benchmark, (OfflineEstimate, Benchmark)):
        other = _at_nodes(mhe, t, benchmark.t, benchmark.x)
    else:
        other = np.asarray(benchmark, float)
    own, best = performance(mhe, log, t, x, p=p), performance(mhe, log, t, other, p=p)
    return Regret(own, best, float(t[-1] - t[0]))


@dataclass(frozen=True, eq=False)
class Benchmark:
    """The infinite-horizon estimate over the middle of a record.

    Attributes
    ----------
    t : array (n,), x : array (n, nx)
    change : float
        Largest difference of a state, in nominals, to what half the margin gives: how far the ends still reach.
    """

    t: Array
    x: Array
    change: float


def infinite_horizon(
    mhe: MHE, log: MeasurementLog, *, margin: float, guess: Any, p: Any = None, **options: Any
) -> Benchmark:
    """Return the solution of the problem with all past and future data (6.9), as nearly as a record allows.

    The full problem is solved without prior and without terminal cost, and `margin` seconds are dropped at both ends,
    where a solution that does not see the data beyond is off. Whether that is enough is measured: it is solved again
    with only half the margin, and `change` is what that changes.

    Parameters
    ----------
    mhe : MHE
    log : MeasurementLog
    margin : float
        Seconds, more than 0 and less than half of the record.
    guess, p, **options
        As for `estimate_offline`.
    """
    start, end = float(log.t[0]), float(log.t[-1])
    if not 0 < margin < (end - start) / 2:
        raise InputError(
            f"infinite_horizon: margin = {margin!r} s; it must be positive and less than half of the record's "
            f"{end - start:g} s"
        )
    bare = _without_ends(mhe)
    far = estimate_offline(bare, log, guess=guess, p=p, **options)
    slack = mhe.slack(end)
    middle = (far.t >= start + margin - slack) & (far.t <= end - margin + slack)
    t, x = far.t[middle], far.x[middle]
    rows = (log.t >= start + margin / 2 - slack) & (log.t <= end - margin / 2 + slack)
    shorter = MeasurementLog(log.t[rows], log.y[rows], log.outputs, log.u[rows], log.inputs, log.units)
    again = guess if callable(guess) else _between(far.t, far.x)
    near = estimate_offline(bare, shorter, guess=again, p=p, times=t, **options)
    change = float(np.max(np.abs(near.x - x) / mhe.model.x.nominal)) if len(t) else float("nan")
    return Benchmark(frozen(t), frozen(x), change)


def _between(t: Array, x: Array) -> Callable[[float], Array]:
    return lambda s: np.array([np.interp(s, t, column) for column in x.T])


def _without_ends(mhe: MHE) -> MHE:
    """Return the estimator whose cost has neither prior nor terminal weight nor discount."""
    size = mhe.stage.nx + (mhe.stage.np if mhe.assembly.p_estimated else 0)
    return mhe.changed(cost=replace(mhe.cost, P=np.zeros((size, size)), S=None, eta=1.0, rate=None, prior_eta=1.0))


def _rebuilt(mhe: MHE, log: MeasurementLog, t: Array, x: Array, p: Any) -> tuple[Window, Array]:
    t, x = np.asarray(t, float), np.asarray(x, float)
    window = _window(mhe, log, t, p)
    nodes = _at_nodes(mhe, window.mesh.t, t, x)
    return window, _disturbance(mhe, window, nodes)


def _window(mhe: MHE, log: MeasurementLog, t: Array, p: Any) -> Window:
    """Return the problem over [t[0], t[-1]] whose cost is (6.53)."""
    model = mhe.model
    parameters = model.p.vector(model.p_start if p is None else p, "performance")
    size = mhe.stage.nx + (mhe.stage.np if mhe.assembly.p_estimated else 0)
    cost = replace(mhe.cost, P=np.zeros((size, size)), S=None, eta=1.0, rate=None, prior_eta=1.0)
    assembly = Assembly(
        model,
        mhe.stage,
        cost,
        mhe.bounds,
        interval=mhe.interval,
        hold=mhe.hold,
        hold_limit=mhe.hold_limit,
        input_hold="linear" if mhe.assembly.input_linear else "zero",
        filtering=False,
    )
    records = records_of(mhe, log)
    end = float(t[-1])
    last = int(np.searchsorted(records.y_times, end + mhe.slack(end), side="right"))
    seen = Records(records.y_times[:last], records.y[:last], records.u_times, records.u)
    prior = np.concatenate([np.zeros(mhe.stage.nx), parameters])
    return assembly.window(float(t[0]), end, seen, prior, growing=False)


def _at_nodes(mhe: MHE, nodes: Array, t: Array, x: Array) -> Array:
    """Return the estimates at the nodes."""
    if len(t) != len(x) or (np.diff(t) < 0).any():
        raise InputError(f"estimates: expected increasing times (n,) and states (n, nx), got {t.shape} and {x.shape}")
    slack = mhe.slack(float(nodes[-1]))
    i = np.clip(np.searchsorted(t, nodes - slack), 0, len(t) - 1)
    missing = (np.abs(t[i] - nodes) > 2 * slack) | ~np.isfinite(x[i]).all(axis=1)
    if missing.any():
        raise InputError(
            f"there is no estimate at t = {nodes[missing][0]:g} s, a node of the transcription (a cell edge, sample or "
            f"input switch); {missing.sum()} of {len(nodes)} nodes lack one"
        )
    return x[i]


def _disturbance(mhe: MHE, window: Window, nodes: Array) -> Array:
    """Return w (m, nw) of (6.52): Newton steps, each with the least |w|_Q."""
    stage, mesh = mhe.stage, window.mesh
    n, nx, nw = len(mesh), stage.nx, stage.nw
    w, p = np.zeros((n, nw)), window.prior[nx:]
    live = np.flatnonzero(mesh.h > 0)
    scale = mhe.model.x.nominal
    free = np.linalg.pinv(window.L_w[live])  # |w|_Q = |L_w w|
    for _ in range(NEWTON_STEPS):
        linear = stage.linearize(mesh.t[:-1], mesh.h, nodes[:-1], w, p, window.u0, window.u1)
        gap = (nodes[1:] - linear.x_next)[live] / scale
        if np.max(np.abs(gap), initial=0.0) <= 1e-12:
            break
        B = linear.jacobian[live, :nx, nx : nx + nw] / scale[:, None]
        reach = B @ free
        rank = np.linalg.matrix_rank(reach).min() if nw else 0
        if rank < nx:
            raise InputError(
                "(6.52) needs a disturbance that takes any state to any other in one step (6.49): the states "
                f"{', '.join(mhe.model.x.names)} have {nx} dimensions, the disturbances "
                f"{', '.join(mhe.model.w.names) or 'none'} reach {rank} of them"
            )
        # least norm of the whole w, not of the correction: the step lands on B (w + step) = B w + gap
        target = B @ w[live][..., None] + gap[..., None]
        w[live] = (free @ np.linalg.pinv(reach) @ target)[..., 0]
    return w
