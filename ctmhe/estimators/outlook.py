"""How uncertain a prediction is: the covariance carried forward along the open loop."""

from __future__ import annotations

import numpy as np

from ctmhe.transcription.assembly import Assembly
from ctmhe.transcription.grid import Mesh, discounted_length
from ctmhe.transcription.stage import StageFunction
from ctmhe.transcription.weights import weight_matrix
from ctmhe.types import Array


def prior_covariance(assembly: Assembly, t: float) -> Array:
    """Return the covariance (n, n) that the prior's weight P stands for at `t`: its inverse, infinite where it is 0."""
    P = assembly.cost.P(t, 0.0) if callable(assembly.cost.P) else assembly.cost.P
    values, vectors = np.linalg.eigh(weight_matrix(P, assembly.prior_names, "cost weight P"))
    known = values > 1e-14 * max(values.max(initial=0.0), 1e-300)
    covariance = (vectors[:, known] / values[known]) @ vectors[:, known].T
    return with_unknown(covariance, _touched(vectors[:, ~known]))


def carried_covariance(
    stage: StageFunction, assembly: Assembly, mesh: Mesh, u0: Array, u1: Array, x: Array, p: Array, covariance: Array
) -> Array:
    """Return the covariance (n, n) of (x, estimated p) at the end of a mesh, from `covariance` at its start.

    Along the open loop P(k+1) = A P(k) A' / eta^h + B Q_k^-1 B', where A and B are the Jacobians of a slot of h seconds
    and Q_k is Q times the discounted length of the slot: the inverse Hessian of the cost at the end when no output is
    counted (thesis 3.13 with R = 0). The mesh's slots count as cells of their own.
    """
    nx, nw = stage.nx, stage.nw
    n = len(covariance)
    unknown = np.isinf(np.diagonal(covariance))
    covariance = np.where(unknown[:, None] | unknown, 0.0, covariance)
    silent = np.zeros(nw)
    for k in range(len(mesh)):
        if mesh.h[k] <= 0.0:
            continue
        slot = slice(k, k + 1)
        rows = (x[None], silent[None], p, u0[slot], u1[slot])
        linear = stage.linearize(mesh.t[slot], mesh.h[slot], *rows)
        jacobian = linear.jacobian[0, :nx]
        A = np.eye(n)
        A[:nx, :nx] = jacobian[:, :nx]
        A[:nx, nx:] = jacobian[:, nx + nw : nx + nw + n - nx]
        B = np.zeros((n, nw))
        B[:nx] = jacobian[:, nx : nx + nw]
        covariance = A @ covariance @ A.T * np.exp(assembly.rate * mesh.h[k])
        unknown = _touched(A[:, unknown])
        if assembly.Q is not None:
            length = 1.0 if assembly.discrete else discounted_length(
                np.zeros(1), mesh.h[slot], float(mesh.h[k]), assembly.rate
            )[0]  # fmt: skip
            values, vectors = np.linalg.eigh(assembly.Q.at(float(mesh.t[k] + mesh.h[k] / 2)) * length)
            weighed = values > 1e-14 * max(values.max(initial=0.0), 1e-300)
            spread = B @ vectors
            covariance = covariance + (spread[:, weighed] / values[weighed]) @ spread[:, weighed].T
            unknown = unknown | _touched(spread[:, ~weighed])
        x = linear.x_next[0]
    return with_unknown(covariance, unknown)


def with_unknown(covariance: Array, unknown: np.ndarray) -> Array:
    """Return a covariance with infinite variances, and no correlations, for the signals that nothing is known of."""
    covariance = np.where(unknown[:, None] | unknown, 0.0, (covariance + covariance.T) / 2)
    covariance[unknown, unknown] = np.inf
    return covariance


def _touched(directions: Array) -> np.ndarray:
    """Return which signals (n,) take part in unknown directions (n, m), to rounding."""
    size = np.abs(directions).max(axis=1, initial=0.0)
    return size > 1e-9 * max(size.max(initial=0.0), 1e-300) if size.any() else size > 0
