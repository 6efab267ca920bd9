"""The matrix inequality behind excitation monitoring, as a semidefinite program; `excitation_design` derives it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag, eigh, expm, solve_continuous_are, solve_discrete_are

from ctmhe.certificates.increments import Jacobians
from ctmhe.certificates.lmi import require_cvxpy, solved
from ctmhe.models.continuous import Model
from ctmhe.types import Array

SLACKS = (1e-7, 1e-6, 1e-6, 1e-5, 1e-5)
"""Demanded of the program in its own units; solutions are inaccurate, and one that fails is sought with more."""

SPEEDS = (1.0, 1.0, 3.0, 30.0, 300.0)
"""Continuous time: how much faster than the model itself Phi may be, from round to round.

Without a limit the best gain is infinite, which costs no noise but leaves no information in Y: on the models of the
library a limit of one leaves 3 to 10 times more per noise than one of ten. A slow mode that has to fade faster by far
than by itself asks for more.
"""


@dataclass(frozen=True, eq=False)
class Units:
    """Nominal magnitudes as diagonal matrices, and whether the model counts steps."""

    x: Array
    w: Array
    y: Array
    p: Array
    discrete: bool

    @classmethod
    def of(cls, model: Model) -> Units:
        """Return those of a model."""
        sizes = (np.diag(np.asarray(getattr(model, key).nominal)) for key in "xwyp")
        return cls(*sizes, discrete=model.step is not None)

    def scaled(self, jacobians: Jacobians) -> Jacobians:
        """Return Jacobians between signals divided by their nominals."""
        x, y = np.linalg.inv(self.x), np.linalg.inv(self.y)
        rows, columns = (x, x, x, y, y, y), (self.x, self.w, self.p) * 2
        return Jacobians(*(r @ part @ c for r, part, c in zip(rows, jacobians, columns, strict=True)))

    def right_inverse(self, C: Array) -> Array:
        """Return C^+ (nx, ny), the pseudo-inverse between signals divided by their nominals."""
        return self.x @ np.linalg.pinv(np.linalg.inv(self.y) @ C @ self.x) @ np.linalg.inv(self.y)

    def pace(self, jacobians: Jacobians) -> float:
        """Return a rate of the model, per step or second: the largest of A, or of A - I."""
        A = np.subtract(self.scaled(jacobians).A, float(self.discrete) * np.eye(len(self.x)))
        return float(np.linalg.norm(A, 2, axis=(1, 2)).max()) or 1.0


def slack(units: Units, mu: float, weights: tuple[Array, Array, Array], L: Array, jacobians: Jacobians) -> Array:
    """Return by how much the inequality holds at k points (k,): the smallest eigenvalue in nominal units, over tr R.

    `weights` are P, Q, R; `L` is (k, nx, ny).
    """
    P, Q, R = weights
    A, B, _, C, D, _ = jacobians
    n, rate = len(P), -np.log(mu)
    identity = np.broadcast_to(np.eye(len(R)), (len(A), *R.shape))
    gain = np.concatenate([A + L @ C, B + L @ D, -L], axis=2)
    seen = np.concatenate([-C, -D, identity], axis=2)
    left: Array = np.matmul(seen.transpose(0, 2, 1), seen)
    if units.discrete:
        left = left + gain.transpose(0, 2, 1) @ P @ gain
    else:
        left[:, :n] += P @ gain
        left[:, :, :n] += (P @ gain).transpose(0, 2, 1)
    right = block_diag(mu * P if units.discrete else -rate * P, Q, R)
    scale = block_diag(units.x, units.w, units.y)
    matrices = scale @ (right - left) @ scale
    return np.linalg.eigvalsh((matrices + matrices.transpose(0, 2, 1)) / 2)[:, 0] / np.trace(units.y @ R @ units.y)


def coordinates(units: Units, points: Jacobians, centre: Jacobians, mu: float) -> Array:
    """Return the basis (nx, nx) of states in which the program is solved: there P is about of size one.

    The square root of what a filter that forgets by mu would take for the covariance, for noise of nominal size, to
    which the change of A over the domain adds.
    """
    pace = 1.0 if units.discrete else units.pace(points)  # the program's unit of time
    A, B, _, C, _, _ = (part[0] for part in units.scaled(centre))
    change = (units.scaled(points).A - A) @ np.linalg.pinv(C) / pace
    A, B, shift = A / pace, B / pace, np.log(mu) / pace / 2
    noise, identity = B @ B.T + (change @ change.transpose(0, 2, 1)).mean(axis=0), np.eye(len(C))
    noise = noise + 1e-6 * np.trace(noise) * np.eye(len(A))
    try:
        if units.discrete:
            covariance = solve_discrete_are(A.T / np.sqrt(mu), C.T, noise, identity)
        else:
            covariance = solve_continuous_are((A - shift * np.eye(len(A))).T, C.T, noise, identity)
        return units.x @ np.linalg.cholesky(covariance)
    except (np.linalg.LinAlgError, ValueError):
        return units.x


def design(
    units: Units,
    points: Jacobians,
    centre: Jacobians,
    mu: float,
    horizon: float,
    *,
    compensated: bool,
    least: float = SLACKS[0],
    speed: float = SPEEDS[0],
) -> tuple[float, Array, Array, Array, Array]:
    """Return what noise of nominal size adds to W per step or second, per nominal |y|^2, and P, Q, R, L at the centre.

    That is made small, together with what a start that is wrong by nominal states leaves in W after the horizon.
    `compensated`: L follows A, so that only the part of A that outputs do not see varies in Phi. `least`: smallest
    eigenvalue demanded; `speed`: see `SPEEDS`.
    """
    cp = require_cvxpy()
    pace = 1.0 if units.discrete else units.pace(points)  # the program's unit of time: entries of size one
    basis = coordinates(units, points, centre, mu)
    start = np.linalg.inv(units.x) @ basis  # of nominal size
    inverse = np.linalg.inv(basis) @ units.right_inverse(centre.C[0]) @ units.y
    units = replace(units, x=basis)
    points, centre = units.scaled(points), units.scaled(centre)
    n, nw, ny = points.A.shape[1], points.B.shape[2], points.C.shape[1]
    size = float(np.mean(np.diag(units.y) ** 2))
    P, R, Y = cp.Variable((n, n), symmetric=True), cp.Variable((ny, ny), symmetric=True), cp.Variable((n, ny))
    Q = cp.Variable((nw, nw), symmetric=True) if nw else None
    m = n + nw + ny
    in_z, in_w, in_y = np.split(np.eye(m), [n, n + nw], axis=1)
    rate = -np.log(mu) / pace
    constraints: list[Any] = [P >> least * np.eye(n)]
    for A, B, C, D in zip(points.A, points.B, points.C, points.D, strict=True):
        PL = Y - P @ ((A - centre.A[0]) @ inverse / pace) if compensated else Y
        gain = P @ (np.hstack([A, B, np.zeros((n, ny))]) / pace) + PL @ np.hstack([C, D, -np.eye(ny)])
        seen = np.hstack([-C, -D, np.eye(ny)])
        matrix = in_y @ R @ in_y.T - seen.T @ (units.y**2 / size) @ seen
        matrix = matrix + in_w @ Q @ in_w.T if Q is not None else matrix
        if units.discrete:
            matrix = cp.bmat([[mu * (in_z @ P @ in_z.T) + matrix, gain.T], [gain, P]])
        else:
            half = in_z @ gain
            matrix = matrix - rate * (in_z @ P @ in_z.T) - half - half.T
            constraints.append(gain[:, :n] + gain[:, :n].T >> -2 * max(speed, 3 * rate) * P)
        constraints.append((matrix + matrix.T) / 2 >> least * np.eye(matrix.shape[0]))
    inside = np.linalg.inv(start)
    left = np.exp(-rate * pace * horizon)
    noise = cp.trace(R) + (cp.trace(Q) if Q is not None else 0.0)
    wrong = cp.trace(inside.T @ P @ inside)
    solved(cp.Problem(cp.Minimize(noise + (rate * left / (1 - left) + 1e-6) * wrong), constraints))
    x, w, y = (np.linalg.inv(part) for part in (units.x, units.w, units.y))
    L = pace * units.x @ np.linalg.solve(P.value, Y.value) @ y
    supply = w @ (Q.value if Q is not None else np.zeros((0, 0))) @ w
    P_, Q_, R_ = (size * (part + part.T) / 2 for part in (x.T @ P.value @ x / pace, supply, y @ R.value @ y))
    return float(np.squeeze(noise.value)), P_, Q_, R_, L


def gathered(units: Units, mu: float, horizon: float, Phi: Array, G: Array, C: Array, F: Array) -> tuple[float, float]:
    """Return the information (7.62) on nominal parameters that k constant regressors G, F gather, on average.

    And how many steps or seconds of constant noise W remembers of the horizon: (1 - mu^T) / (1 - mu).
    """
    steps = max(int(horizon), 1) if units.discrete else 200
    h, n, kept = horizon / steps, len(Phi), mu
    if not units.discrete:
        kept = mu**h
        block = expm(h * np.block([[Phi, np.eye(n)], [np.zeros((n, 2 * n))]]))
        Phi, G = block[:n, :n], block[:n, n:] @ G
    Y, total, memory = np.zeros_like(G), 0.0, 0.0
    for _ in range(min(steps, 5000)):
        total = kept * total + np.mean(np.sum(((C @ Y + F) @ units.p) ** 2, axis=(1, 2))) * h
        memory = kept * memory + h
        Y = Phi @ Y + G
    return float(total / np.mean(np.diag(units.y) ** 2)), memory


def phi_factor(P: Array, Phi: Array, *, discrete: bool = True) -> float:
    """Return the smallest eta with Phi'P Phi <= eta P (7.41); in continuous time with P Phi + Phi'P <= ln(eta) P."""
    left = Phi.T @ P @ Phi if discrete else P @ Phi + Phi.T @ P
    largest = float(eigh(left, P, eigvals_only=True)[-1])
    return largest if discrete else float(np.exp(largest))


def least_upper_bound(matrices: Array, units: Array) -> Array:
    """Return the H of least trace, in units (n, n) diagonal, that is not below any of the `matrices` (k, n, n)."""
    n = matrices.shape[1]
    if n <= 1 or len(matrices) == 1:
        return matrices.max(axis=0)
    cp = require_cvxpy()
    scaled = units @ matrices @ units
    scaled, size = scaled / np.abs(scaled).max(), np.abs(scaled).max()
    H = cp.Variable((n, n), symmetric=True)
    solved(cp.Problem(cp.Minimize(cp.trace(H)), [H >> matrix for matrix in scaled]))
    lifted = H.value + max(0.0, *(float(np.linalg.eigvalsh(m - H.value)[-1]) for m in scaled)) * np.eye(n)
    back = np.linalg.inv(units)
    return size * back @ lifted @ back
