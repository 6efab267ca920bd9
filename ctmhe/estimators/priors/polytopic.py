"""The adaptive polytopic estimator of paper 003: its arrival cost (8)-(9), its numbers of iterations and steps."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2
from typing import TYPE_CHECKING

import numpy as np

from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.outlook import prior_covariance
from ctmhe.estimators.priors.base import SMOOTHING, Anchor, Memory
from ctmhe.estimators.trajectories import trajectory_at
from ctmhe.transcription.solved import Solved
from ctmhe.types import Array, positive

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State


@dataclass(frozen=True)
class AdaptiveArrival:
    """The prior of paper 003: the last solution (9), with a weight that follows the residuals (8).

    With `MHE(polytope(...), prior=AdaptiveArrival(sigma, largest), solver=DualIterations(10))` the paper's estimator.
    The weight is P^-1, one block for states and one for mixing weights. P begins as the inverse of the cost's P. When
    the window has its full length, every solve renews it by recursive least squares with a forgetting factor, where v
    is the prior that the solve had and e its residual at the window's first sample::

        N = (1 + v' P v) sigma / |e|^2,   theta = 1 - 1/N,   W = P - P v v' P / (1 + v' P v)
        P <- W / theta  if that has a trace of at most `largest` (c), else W

    Where N <= 1, theta is no forgetting factor (residuals larger than sigma allows) and P <- W. The paper has this in
    discrete time with a solve at every step; on irregular instants this form is ours.

    Parameters
    ----------
    sigma : float
        Size of squared residuals that is expected; much larger than the variance of w, says the paper.
    largest : float
        Bound c of the trace.
    """

    sigma: float
    largest: float
    reach = 0.0

    def __post_init__(self) -> None:
        positive("AdaptiveArrival: sigma", self.sigma)
        positive("AdaptiveArrival: largest", self.largest)

    def begin(self, mhe: MHE, state: State) -> Memory:
        """Return the inverse of the cost's P, as one row."""
        P = prior_covariance(mhe.assembly, state.t0)
        if not np.isfinite(P).all():
            raise InputError("AdaptiveArrival: the cost's P must be positive definite, its inverse is where P begins")
        return {"adaptive": Log.of([state.t0], P.reshape(1, -1), P.size)}

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`."""
        anchor = SMOOTHING.at(mhe, state, start, growing)
        if anchor is None:
            return None
        again = state.window is not None and start <= state.window.part("t")[0] + mhe.slack(start)
        P = _square(state.memory["adaptive"], 0 if again and not growing else -1)
        return Anchor(anchor.value, anchor.notes, weight=np.linalg.inv(P))

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        last, slack = solved.trajectory, mhe.slack(state.t)
        if state.t - mhe.horizon < state.t0 - slack:
            return state.memory
        times, rows = state.measurements.arrays()
        first = int(np.searchsorted(times, last.t[0] - slack))
        if first == len(times):
            return state.memory
        x = trajectory_at(mhe.stage, last, float(times[first]))
        residual = rows[first] - mhe.output(state, float(times[first]), x, last.p)
        size = float(np.nansum(residual**2))
        log, nx, value = state.memory["adaptive"], mhe.stage.nx, solved.part("prior")
        before = log.drop_after(state.t - slack) if len(log) > 1 else log  # a solve that is repeated starts from there
        P = _square(before)
        before = before.drop_before(before.last_time)
        for block in (slice(0, nx), slice(nx, len(P))):
            P[block, block] = renewed(P[block, block], value[block], size, self.sigma, self.largest)
        return {"adaptive": before.put(state.t, P.reshape(-1))}


def renewed(P: Array, v: Array, size: float, sigma: float, largest: float) -> Array:
    """Return the next P of (8) from prior `v` and squared residual `size`."""
    if not len(P):
        return P
    reach = 1.0 + float(v @ P @ v)
    W = P - np.outer(P @ v, P @ v) / reach
    theta = 1.0 - size / (reach * sigma)
    if theta <= 0 or np.trace(W) > largest * theta:
        return (W + W.T) / 2
    return (W + W.T) / (2 * theta)


def _square(log: Log, which: int = -1) -> Array:
    row = log.arrays()[1][which]
    return row.reshape(round(len(row) ** 0.5), -1).copy()


def dual_iterations(cost: float, prior: float, smallest_prior: float, epsilon: float) -> int:
    """Return the number of dual iterations l that (33) of paper 003 asks for.

    With it the cost of the states' problem would fall to `epsilon` times its first value. What is certain is less: each
    iteration decreases the joint cost, or has converged, whatever l is.

    Parameters
    ----------
    cost : float
        Psi_x of the first iteration, or for (34) N times the largest stage cost of the true disturbances.
    prior : float
        Gamma of the last iteration, 0 in (34).
    smallest_prior : float
        The smallest Gamma of the iterations.
    epsilon : float
        In (0, 1).
    """
    smallest_prior = positive("dual_iterations: smallest_prior", smallest_prior)
    if not (0 < epsilon < 1 and cost >= 0 and prior >= 0):
        raise InputError(
            f"dual_iterations: expected epsilon in (0, 1) and costs >= 0, got epsilon = {epsilon!r}, cost = {cost!r}, "
            f"prior = {prior!r}"
        )
    ratio = (epsilon * cost - prior) / smallest_prior + 1.0
    return max(ceil(log2(ratio)) + 1, 1) if ratio > 1 else 1


def polytopic_horizon(
    *,
    c_beta: float,
    p: float,
    q: float,
    a: float,
    c_prior: tuple[float, float],
    c_1: float,
    c_2: float,
    b_1: float,
    b_2: float,
    error: float,
    largest_error: float,
    shrink: float = 1.0,
    epsilon: float = 0.1,
) -> int:
    """Return the horizon in steps that (66) of paper 003 asks for.

    N >= (2 (1 + epsilon) (k_1 + k_2 g^eta) e^zeta / r)^(1/eta) with zeta = max(p, a b_1, a b_2), eta = min(q, b_1, b_2)
    and k_1, k_2 of (51)-(52).

    Parameters
    ----------
    c_beta, p, q : float
        beta(r, s) <= c_beta r^p s^-q of i-IOSS (16).
    a, c_prior : float, (lower, upper)
        c_lower r^a <= prior weighting <= c_upper r^a, (12)-(13).
    c_1, c_2, b_1, b_2 : float
        Of (18).
    error, largest_error : float
        e_max, the largest initial error, and r_max.
    shrink : float
        g(k, l) of (24): how far the dual iterations lower the cost, 1 for not at all.
    epsilon : float

    Source: paper 003, Theorem 2.
    """
    low, high = c_prior
    given = {"c_beta": c_beta, "p": p, "q": q, "a": a, "c_prior": low, "b_1": b_1, "b_2": b_2, "r_max": largest_error}
    for name, value in given.items():
        positive(f"polytopic_horizon: {name}", value)
    if q < p / a or not high >= low:
        raise InputError(f"polytopic_horizon: expected q >= p / a and c_prior in order, got q = {q:g}, {c_prior}")
    zeta, eta = max(p, a * b_1, a * b_2), min(q, b_1, b_2)
    k_1 = c_beta * 2**p
    k_2 = 5 ** (p + q) * (high / low) ** q * c_beta * 2**p + c_1 * 5**b_1 * high**b_1 + c_2 * 5**b_2 * high**b_2
    return ceil((2 * (1 + epsilon) * (k_1 + k_2 * shrink**eta) * error**zeta / largest_error) ** (1 / eta))
