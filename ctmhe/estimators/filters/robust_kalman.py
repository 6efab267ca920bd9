"""A Kalman filter for linear steps with norm-bounded uncertainty, whose covariance bounds that of its error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.estimators.filters.filter import Basis, Recursion, Sample, Slot
from ctmhe.estimators.filters.filter_state import Belief
from ctmhe.estimators.filters.kalman import corrected, symmetric
from ctmhe.transcription.integrators import check_linear
from ctmhe.types import Array

LARGEST = 1e60
"""Trace of X beyond which there is no bound: an uncertain system that may be unstable."""

REMEDY = "make the uncertainty smaller, or start from a smaller covariance"


@dataclass(frozen=True, eq=False)
class RobustKalman:
    """The filter of smallest bound for x(k+1) = (A + M F E) x + B u + G w, y = (C + N F E) x + D w + v, |F| <= 1.

    F may change in every step in any way that does not depend on the noise to come. `Estimate.covariance` is an upper
    bound of the error's covariance for all of them, as far as the means and covariances of the initial error, w and v
    are those stated.

    With a multiplier eps below 1 / |E X E'|, X the bound of E[x x'], each step replaces P and x_hat by::

        P~ = P + P E' (I/eps - E P E')^-1 E P,   x~ = x_hat + eps P~ E' E x_hat,   X~ = X + X E' (I/eps - E X E')^-1 E X

    and is then a Kalman filter's, with one more noise of covariance I/eps that enters by M and N. eps is chosen in
    every step to make the trace of the predicted bound smallest. Derived in docs/baselines.md.

    Where the uncertain system may be unstable X grows without end, and the bound with it; in the end the gain stays as
    it is and the covariance is infinite. In continuous time gaps of
    different lengths have different uncertainties, which are not of this form: `DiscreteModel` only.

    Parameters
    ----------
    M : array (nx, r), N : array (ny, r), E : array (r', nx)
        The uncertainty [M; N] F E with F (r, r'); `norm_bounded` makes them of vertices.

    Source: after Zhu, Soh and Xie (2002), and Xie, Soh and de Souza (1994).
    """

    M: Any
    N: Any
    E: Any

    def on(self, basis: Basis) -> Recursion:
        """Return the rule for a model."""
        model = basis.model
        check_linear(model)
        if model.step is None:
            raise InputError("RobustKalman: the uncertainty of a step is given, so the model must be a DiscreteModel")
        if basis.n > basis.stage.nx:
            raise InputError("RobustKalman: parameters are not estimated; give P over the states only")
        if basis.assembly.rate > 0:
            raise InputError("RobustKalman: no discount, eta = 1: the bound is one of covariances")
        nx, ny = len(model.x), len(model.y)
        M, N, E = (np.atleast_2d(np.asarray(part, dtype=float)) for part in (self.M, self.N, self.E))
        if M.shape[0] != nx or N.shape[0] != ny or E.shape[1] != nx or M.shape[1] != N.shape[1]:
            raise InputError(
                f"RobustKalman: expected M ({nx}, r), N ({ny}, r) and E (r', {nx}), got {M.shape}, {N.shape}, {E.shape}"
            )
        return Bounded(basis, M, N, E)

    def __repr__(self) -> str:
        return f"RobustKalman(M={np.asarray(self.M).tolist()}, N={np.asarray(self.N).tolist()})"


class Bounded:
    """Robust Kalman filter on one model. z = (x, the noise that stands for the uncertainty, w); its memory is X.

    X bounds the second moment of (x, 1): the constant lets inputs and offsets move the mean.
    """

    def __init__(self, basis: Basis, M: Array, N: Array, E: Array):
        self.basis, self.M, self.N, self.E = basis, M, N, E
        model = basis.model
        x, u, w, p = (ca.MX.sym(name, model.output.size1_in(i + 1)) for i, name in enumerate("xuwp"))
        step, output = model.dynamics(0, x, u, w, p), model.output(0, x, u, w, p)
        results = [part for value in (step, output) for part in (value, ca.jacobian(value, x), ca.jacobian(value, w))]
        self.parts = ca.Function("parts", [x, u, w, p], [ca.densify(part) for part in results])

    def linear(self, x: Array, u: Array, p: Array) -> list[Array]:
        """Return f, A, G, h, C, D at `x` with w = 0."""
        f, A, G, h, C, D = (np.asarray(ca.DM(v)) for v in self.parts(x, u, np.zeros(self.basis.stage.nw), p))
        return [f[:, 0], A, G, h[:, 0], C, D]

    def start(self, x: Array, p: Array) -> Belief:
        """Return the belief that the cost's P stands for; the initial estimate is known, its error has mean zero."""
        belief = self.basis.start(x, p)
        known = np.append(x, 1.0)
        X = np.outer(known, known)
        X[: len(x), : len(x)] += belief.P
        nominal = self.linear(x, np.zeros(len(self.basis.model.u)), p)[1]
        return replace(belief, memory={"X": X, "A": nominal})

    def renew(self, belief: Belief, t: float) -> Belief:
        """Return the belief at a step's start, uncertainty included."""
        nx, W, r = self.basis.n, self.basis.disturbance_covariance(t), self.M.shape[1]
        x, P, X, E = belief.z[:nx], belief.P[:nx, :nx], belief.memory["X"], self.E
        if not (self.M.any() or self.N.any()) or not E.any():
            eps = np.inf
        else:
            eps = self._multiplier(P, X, belief.memory["A"])
            P, X = tilted(P, E, eps), tilted(X, np.column_stack([E, np.zeros(len(E))]), eps)
            x = x + eps * P @ (E.T @ (E @ x))
        size = nx + r + len(W)
        wide = np.zeros((size, size))
        wide[:nx, :nx], wide[nx : nx + r, nx : nx + r], wide[nx + r :, nx + r :] = P, np.eye(r) / eps, W
        z = np.concatenate([x, np.zeros(size - nx)])
        memory = dict(belief.memory) | {"X": X, "eps": np.array(eps)}
        memory |= {"before": belief.memory["X"], "P": belief.P[:nx, :nx]}
        return replace(belief, z=z, P=wide, memory=memory)

    def _multiplier(self, P: Array, X: Array, A: Array) -> float:
        """Return the multiplier that keeps the bounds of the next step small: log tr P + 4 log tr X, no sample counted.

        X has the larger part because what makes P small now makes X, and so the next P, grow.
        """
        from scipy.optimize import minimize_scalar  # of SciPy only what is needed, when it is

        nx, M, E = len(P), self.M, self.E
        X = X[:nx, :nx]
        limit = 1.0 / max(float(np.linalg.eigvalsh(E @ X @ E.T)[-1]), 1e-300)

        def size(share: float) -> float:
            eps = limit / (1 + np.exp(-share))
            noise = float(np.sum(M**2)) / eps
            traces = [float(np.trace(A @ tilted(square, E, eps) @ A.T)) + noise for square in (P, X)]
            return float(np.log(traces[0] + 1e-300) + 4 * np.log(traces[1] + 1e-300))

        found: Any = minimize_scalar(size, bounds=(-16.0, 16.0), method="bounded", options={"xatol": 1e-3})
        return limit / (1 + np.exp(-float(found.x)))

    def advance(self, belief: Belief, slot: Slot) -> Belief:
        """Return the belief one step later; `renew` makes a step's start of it."""
        nx, nw, r = self.basis.n, self.basis.stage.nw, self.M.shape[1]
        x, noise, w = np.split(belief.z, [nx, nx + r])
        f, A, G, *_ = self.linear(x, slot.u0, slot.p)
        J = np.column_stack([A, self.M, G])
        z = f + self.M @ noise + G @ w
        offset = f - A @ x
        wide = np.block([[A, offset[:, None]], [np.zeros((1, nx)), np.ones((1, 1))]])
        X = wide @ belief.memory["X"] @ wide.T
        W = self.basis.disturbance_covariance(slot.t)
        X[:nx, :nx] += self.M @ self.M.T / float(belief.memory["eps"]) + (G @ W @ G.T if nw else 0.0)
        P = symmetric(J @ belief.P @ J.T)
        if np.trace(X) > LARGEST or "unbounded" in belief.memory:  # go on with the gain of now
            before = {"X": belief.memory["before"], "A": A, "unbounded": np.ones(1)}
            return Belief(z, belief.memory["P"], before)
        return Belief(z, P, {"X": symmetric(X), "A": A})

    def correct(self, belief: Belief, sample: Sample) -> tuple[Belief, float]:
        """Return the belief that knows a sample."""
        nx, r = self.basis.n, self.M.shape[1]
        x, noise, w = np.split(belief.z, [nx, nx + r])
        _, _, _, h, C, D = self.linear(x, sample.u, sample.p)
        y = h + self.N @ noise + D @ w
        return corrected(belief, np.column_stack([C, self.N, D]), y, sample, self.basis.output_root(sample))


def tilted(P: Array, E: Array, eps: float) -> Array:
    """Return P + P E' (I/eps - E P E')^-1 E P: what (P^-1 - eps E'E)^-1 is where P has an inverse."""
    gap = np.eye(len(E)) / eps - E @ P @ E.T
    if not np.linalg.eigvalsh(gap)[0] > 0:
        raise np.linalg.LinAlgError(f"the bound of the uncertain state is not finite: {REMEDY}")
    return symmetric(P + P @ E.T @ np.linalg.solve(gap, E @ P))


def norm_bounded(
    vertices: Sequence[tuple[Any, Any]], nominal: tuple[Any, Any], *, rounds: int = 30
) -> tuple[Array, Array, Array]:
    """Return M, N, E such that every [A_i; C_i] - [A; C] is [M; N] F E with |F| <= 1: what `RobustKalman` takes.

    With it every mixture of the vertices is covered. Left and right factors are roots of the sums of the deviations'
    squares, which fit their shape; E takes half of the size.

    Parameters
    ----------
    vertices : sequence of (A_i, C_i)
        Arrays (nx, nx) and (ny, nx).
    nominal : (A, C)
        What the filter's model has.
    """
    try:
        A, C = (np.atleast_2d(np.asarray(part, dtype=float)) for part in nominal)
        deviations = [np.vstack([np.atleast_2d(a) - A, np.atleast_2d(c) - C]) for a, c in vertices]
    except ValueError as error:
        raise InputError(f"norm_bounded: vertices and nominal must be pairs (A, C) of one shape: {error}") from None
    if not deviations:
        raise InputError("norm_bounded: no vertices")
    nx, ny = A.shape[1], len(C)
    if not any(deviation.any() for deviation in deviations):
        return np.zeros((nx, 1)), np.zeros((ny, 1)), np.zeros((1, nx))
    left, right = np.eye(nx + ny), np.eye(nx)
    for _ in range(rounds):  # alternate towards factors in which the deviations look round
        left = _root(sum(d @ np.linalg.pinv(right.T @ right) @ d.T for d in deviations), nx + ny)
        right = _root(sum(d.T @ np.linalg.pinv(left @ left.T) @ d for d in deviations), nx).T
        left, right = _scaled(left), _scaled(right)
    inner = [np.linalg.pinv(left) @ d @ np.linalg.pinv(right) for d in deviations]
    size = max(float(np.linalg.norm(part, 2)) for part in inner)
    both = np.sqrt(size) * (1 + 1e-12)
    left, right = left * both, right * both
    return left[:nx], left[nx:], right


def _root(square: Any, n: int) -> Array:
    values, vectors = np.linalg.eigh(np.zeros((n, n)) + square)
    return vectors * np.sqrt(np.maximum(values, 1e-10 * max(float(values[-1]), 1e-300)))


def _scaled(factor: Array) -> Array:
    return factor / max(float(np.linalg.norm(factor, 2)), 1e-300)
