"""Kalman filters by linearisation: exact on linear models, extended on others, continuous-discrete or in steps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.estimators.filters.filter import Basis, Recursion, Sample, Slot
from ctmhe.estimators.filters.filter_state import Belief
from ctmhe.transcription.integrators import check_linear, is_symbolic
from ctmhe.types import Array


@dataclass(frozen=True)
class Extended:
    """The extended Kalman filter: everything linearised at the last mean.

    With w white, mean and covariance follow dz/dt = f, dP/dt = F P + P F' + G W G' between samples (F, G Jacobians, W
    the inverse of Q), integrated together by RK4. With w held over cells, and for a `DiscreteModel`, w of the cell is
    part of z: a slot carries (z, P) by its exact Jacobian, and a sample within a cell corrects w as well.
    """

    def on(self, basis: Basis) -> Recursion:
        """Return the rule for a model."""
        return Linearised(basis)


@dataclass(frozen=True)
class Kalman:
    """The Kalman filter of a linear model: the minimum of the full information problem with the same weights.

    With `Exact` as integrator, exact to rounding over gaps of any length.

    Raises `InputError` on models that are not linear in x, w and u, or whose parameters are to be estimated.
    """

    def on(self, basis: Basis) -> Recursion:
        """Return the rule for a model."""
        check_linear(basis.model)
        if basis.n > basis.stage.nx:
            raise InputError("Kalman: estimated parameters multiply states, which is not linear; use Extended")
        return Linearised(basis)


class Linearised:
    """Extended Kalman filter on one model."""

    def __init__(self, basis: Basis):
        self.basis = basis
        model, symbolic = basis.model, is_symbolic(basis.model)
        kind: Any = ca.SX if symbolic else ca.MX
        t, x, u, w, p = (kind.sym(name, model.output.size1_in(i)) for i, name in enumerate("txuwp"))
        y = model.output(t, x, u, w, p)
        self.measure = ca.Function("measure", [t, x, u, w, p], [y, ca.jacobian(y, ca.vertcat(x, p, w))])
        self.flow = None if basis.held else covariance_flow(basis)

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
        basis, stage = self.basis, self.basis.stage
        x, p, w = basis.split(belief.z, slot.p)
        if self.flow is not None:
            W = basis.disturbance_covariance(slot.t)
            z, P = self.flow(slot.t, slot.h, belief.z, belief.P, slot.u0, slot.u1, slot.p, W)
            return replace(belief, z=np.asarray(z).reshape(-1), P=symmetric(np.asarray(P)))
        rows = (np.array([slot.t]), np.array([slot.h]), x[None], w[None], p, slot.u0[None], slot.u1[None])
        found = stage.linearize(*rows)
        nx, n, nw = stage.nx, basis.n, stage.nw
        A, J = np.eye(len(belief.z)), found.jacobian[0, :nx]
        A[:nx, :nx], A[:nx, nx:n], A[:nx, n:] = J[:, :nx], J[:, nx + nw : nx + nw + n - nx], J[:, nx : nx + nw]
        z = np.concatenate([found.x_next[0], belief.z[nx:]])
        return replace(belief, z=z, P=symmetric(A @ belief.P @ A.T * np.exp(basis.assembly.rate * slot.h)))

    def correct(self, belief: Belief, sample: Sample) -> tuple[Belief, float]:
        """Return the belief that knows a sample, and its squared innovation."""
        basis, n = self.basis, self.basis.n
        x, p, w = basis.split(belief.z, sample.p)
        y, J = (np.asarray(value) for value in self.measure(sample.t, x, sample.u, w, p))
        C = np.zeros((len(y), len(belief.z)))
        C[:, :n] = J[:, :n]
        if basis.held:
            C[:, n : n + len(w)] = J[:, len(x) + len(p) :]
        return corrected(belief, C, y[:, 0], sample, basis.output_root(sample))


def corrected(belief: Belief, C: Array, y: Array, sample: Sample, root: Array) -> tuple[Belief, float]:
    """Return the belief after a sample with output y + C (z - mean), and its innovation squared by its covariance."""
    error = root @ np.where(np.isfinite(sample.y), sample.y - y, 0.0)
    H = root @ C
    S = H @ belief.P @ H.T + np.eye(len(error))
    K = np.linalg.solve(S, H @ belief.P).T
    P = symmetric(belief.P - K @ S @ K.T)
    return replace(belief, z=belief.z + K @ error, P=P), float(error @ np.linalg.solve(S, error))


def with_disturbance(belief: Belief, n: int, W: Array) -> Belief:
    """Return the belief whose entries from `n` on are a fresh disturbance of mean zero and covariance W."""
    size = n + len(W)
    P = np.zeros((size, size))
    P[:n, :n], P[n:, n:] = belief.P[:n, :n], W
    return replace(belief, z=np.concatenate([belief.z[:n], np.zeros(len(W))]), P=P)


def symmetric(P: Array) -> Array:
    """Return the symmetric part."""
    return (P + P.T) / 2


def covariance_flow(basis: Basis) -> ca.Function:
    """Return one RK4 step (t, h, z, P, u0, u1, p, W) -> (z, P) of mean and covariance, w white of intensity W."""
    model, nx, n, nw, rate = basis.model, basis.stage.nx, basis.n, basis.stage.nw, float(basis.assembly.rate)
    kind: Any = ca.SX if is_symbolic(model) else ca.MX
    t, h, z, P = kind.sym("t"), kind.sym("h"), kind.sym("z", n), kind.sym("P", n, n)
    u0, u1 = kind.sym("u0", len(model.u)), kind.sym("u1", len(model.u))
    p, W = kind.sym("p", len(model.p)), kind.sym("W", nw, nw)
    x, w = kind.sym("x", nx), kind.sym("w", nw)
    u, estimated = kind.sym("u", len(model.u)), n > nx
    f = model.dynamics(t, x, u, w, p)
    still = ca.Function("still", [t, x, u, w, p], [f, ca.jacobian(f, ca.vertcat(x, p)), ca.jacobian(f, w)])

    def slope(s: Any, z: Any, P: Any) -> tuple[Any, Any]:
        rate_x, F, G = still(t + s * h, z[:nx], u0 + s * (u1 - u0), ca.DM.zeros(nw), z[nx:] if estimated else p)
        A = ca.vertcat(F[:, :n], ca.DM.zeros(n - nx, n))
        B = ca.vertcat(G, ca.DM.zeros(n - nx, nw))
        return ca.vertcat(rate_x, ca.DM.zeros(n - nx)), A @ P + P @ A.T + B @ W @ B.T + rate * P

    k1 = slope(0.0, z, P)
    k2 = slope(0.5, z + h / 2 * k1[0], P + h / 2 * k1[1])
    k3 = slope(0.5, z + h / 2 * k2[0], P + h / 2 * k2[1])
    k4 = slope(1.0, z + h * k3[0], P + h * k3[1])
    end = [a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip((z, P), k1, k2, k3, k4, strict=True)]
    return ca.Function("flow", [t, h, z, P, u0, u1, p, W], end)
