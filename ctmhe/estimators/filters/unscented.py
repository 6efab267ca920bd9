"""The unscented Kalman filter: points instead of Jacobians, continuous-discrete or in steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.estimators.filters.filter import Basis, Recursion, Sample, Slot
from ctmhe.estimators.filters.filter_state import Belief
from ctmhe.estimators.filters.kalman import symmetric, with_disturbance
from ctmhe.types import Array


@dataclass(frozen=True)
class Unscented:
    """The unscented Kalman filter: 2m + 1 points mean +- sqrt(m + lambda) times the columns of a root of P.

    With w held over cells, and for a `DiscreteModel`, w of the cell is part of the m entries and every point goes
    through the slot. With w white, mean and covariance follow the differential equations of the points' moments
    (Sarkka 2007), dP/dt = E[(z - m) f'] + E[f (z - m)'] + G W G', integrated by RK4.

    Parameters
    ----------
    alpha, beta, kappa : float
        lambda = alpha^2 (m + kappa) - m; the mean's point has weight lambda / (m + lambda) in means and 1 - alpha^2 +
        beta more in covariances. The defaults give the mean's point no weight in means (a cubature rule), so that
        covariances stay positive.

    Source: Julier and Uhlmann (2004); Wan and van der Merwe (2000).
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0

    def on(self, basis: Basis) -> Recursion:
        """Return the rule for a model."""
        if not self.alpha > 0:
            raise InputError(f"Unscented: alpha must be positive, got {self.alpha!r}")
        return Points(basis, self)


class Points:
    """Unscented Kalman filter on one model."""

    def __init__(self, basis: Basis, rule: Unscented):
        self.basis, self.rule = basis, rule
        model = basis.model
        symbols = [ca.MX.sym(name, model.output.size1_in(i)) for i, name in enumerate("txuwp")]
        self.output, self.dynamics = model.output, model.dynamics
        self.spread = ca.Function("spread", symbols, [ca.jacobian(model.dynamics(*symbols), symbols[3])])

    def start(self, x: Array, p: Array) -> Belief:
        """Return the belief that the cost's P stands for."""
        return self.basis.start(x, p)

    def renew(self, belief: Belief, t: float) -> Belief:
        """Return the belief with a fresh w, of mean zero."""
        if not self.basis.held:
            return belief
        return with_disturbance(belief, self.basis.n, self.basis.disturbance_covariance(t))

    def advance(self, belief: Belief, slot: Slot) -> Belief:
        """Return the belief at the end of a slot."""
        basis = self.basis
        growth = np.exp(basis.assembly.rate * slot.h)
        if not basis.held:
            return self._flow(belief, slot)
        nx, n = basis.stage.nx, basis.n
        points, mean, spread = self.points(belief.z, belief.P)
        count = len(points)
        p = points[:, nx:n] if n > nx else np.broadcast_to(slot.p, (count, len(slot.p)))
        inputs = (np.tile(slot.u0, (count, 1)), np.tile(slot.u1, (count, 1)))
        t, h = np.full(count, slot.t), np.full(count, slot.h)
        x, _ = basis.stage.values(t, h, points[:, :nx], points[:, n:], p, *inputs)
        after = np.column_stack([x, points[:, nx:]])
        z = mean @ after
        return replace(belief, z=z, P=symmetric((after - z).T @ (spread[:, None] * (after - z))) * growth)

    def correct(self, belief: Belief, sample: Sample) -> tuple[Belief, float]:
        """Return the belief that knows a sample, and its squared innovation."""
        points, mean, spread = self.points(belief.z, belief.P)
        y = np.empty((len(points), len(sample.y)))
        for i, point in enumerate(points):
            x, p, w = self.basis.split(point, sample.p)
            y[i] = np.asarray(self.output(sample.t, x, sample.u, w, p)).reshape(-1)
        expected = mean @ y
        root = self.basis.output_root(sample)
        error = root @ np.where(np.isfinite(sample.y), sample.y - expected, 0.0)
        deviation = (y - expected) @ root.T
        S = deviation.T @ (spread[:, None] * deviation) + np.eye(len(error))
        cross = (points - belief.z).T @ (spread[:, None] * deviation)
        K = np.linalg.solve(S, cross.T).T
        after = replace(belief, z=belief.z + K @ error, P=symmetric(belief.P - K @ S @ K.T))
        return after, float(error @ np.linalg.solve(S, error))

    def points(self, z: Array, P: Array) -> tuple[Array, Array, Array]:
        """Return the points (2m + 1, m) and their weights in means and in covariances."""
        m, rule = len(z), self.rule
        scale = rule.alpha**2 * (m + rule.kappa)
        root = np.sqrt(scale) * root_of(P)
        points = np.concatenate([z[None], z + root.T, z - root.T])
        mean = np.full(2 * m + 1, 0.5 / scale)
        mean[0] = 1 - m / scale
        spread = mean.copy()
        spread[0] += 1 - rule.alpha**2 + rule.beta
        return points, mean, spread

    def _flow(self, belief: Belief, slot: Slot) -> Belief:
        """Return the belief after one RK4 step of the moments' differential equations."""
        basis, h, nx, n = self.basis, slot.h, self.basis.stage.nx, self.basis.n
        W, silent = basis.disturbance_covariance(slot.t), np.zeros(basis.stage.nw)

        def slope(s: float, z: Array, P: Array) -> tuple[Array, Array]:
            points, mean, spread = self.points(z, P)
            t, u = slot.t + s * h, slot.u0 + s * (slot.u1 - slot.u0)
            rates = np.zeros((len(points), n))
            for i, point in enumerate(points):
                x, p, _ = basis.split(point, slot.p)
                rates[i, :nx] = np.asarray(self.dynamics(t, x, u, silent, p)).reshape(-1)
            x, p, _ = basis.split(z, slot.p)
            G = np.zeros((n, len(silent)))
            G[:nx] = np.asarray(ca.DM(self.spread(t, x, u, silent, p)))
            mean_rate = mean @ rates
            cross = (points - z).T @ (spread[:, None] * (rates - mean_rate))
            return mean_rate, cross + cross.T + G @ W @ G.T + basis.assembly.rate * P

        z, P = belief.z, belief.P
        k1 = slope(0.0, z, P)
        k2 = slope(0.5, z + h / 2 * k1[0], P + h / 2 * k1[1])
        k3 = slope(0.5, z + h / 2 * k2[0], P + h / 2 * k2[1])
        k4 = slope(1.0, z + h * k3[0], P + h * k3[1])
        z, P = (a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip((z, P), k1, k2, k3, k4, strict=True))
        return replace(belief, z=z, P=symmetric(P))


def root_of(P: Array) -> Array:
    """Return L with L L' = P, also for a P that is singular or indefinite by rounding."""
    try:
        return np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(P)
        return vectors * np.sqrt(np.maximum(values, 0.0))
