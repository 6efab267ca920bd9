"""Excitation along a run: how much a trajectory says of the parameters, and of which combinations; thesis 7.2."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.linalg import expm

from ctmhe.certificates.excited_set import ExcitationDesign
from ctmhe.certificates.increments import Jacobians
from ctmhe.errors import InputError
from ctmhe.types import Array, Trajectory, frozen


@dataclass(frozen=True)
class Direction:
    """A combination of parameters and how much is known of it.

    Attributes
    ----------
    level : float
        Information on the combination, in y's units squared.
    weights : mapping name -> float
        Of parameters divided by their nominals; the squares sum to one.
    """

    level: float
    weights: MappingProxyType[str, float]

    def __str__(self) -> str:
        terms = (f"{weight:+.2f} {name}" for name, weight in self.weights.items() if abs(weight) >= 0.005)
        return f"{self.level:.3g}: {' '.join(terms)}"


@dataclass(frozen=True, eq=False)
class Information:
    """What a trajectory says of the parameters.

    Attributes
    ----------
    matrix : array (np, np)
        O_T (7.62), (7.93), or C_T (7.44), (7.75) of a pair: S of (7.52) when it starts at zero.
    undiscounted : array (np, np)
        The same sum, or integral, without mu: (34) of paper 000.
    Y : array (nx, np)
        Of (7.45) at the end.
    parameters : tuple of str
    nominal : array (np,)
    """

    matrix: Array
    undiscounted: Array
    Y: Array
    parameters: tuple[str, ...]
    nominal: Array

    @property
    def _in_nominals(self) -> Array:
        return self.nominal[:, None] * self.matrix * self.nominal

    @property
    def level(self) -> float:
        """alpha_t: the smallest eigenvalue of the matrix, for parameters in units of their nominals.

        So it does not depend on the parameters' units. That of `matrix` itself is the thesis'.
        """
        return float(np.linalg.eigvalsh(self._in_nominals)[0])

    @property
    def directions(self) -> tuple[Direction, ...]:
        """Combinations of parameters that are told apart from one another, the least excited first.

        Eigenvectors of the matrix for parameters in units of their nominals; which combinations are excited when the
        level says that some are not.
        """
        values, vectors = np.linalg.eigh(self._in_nominals)
        signs = np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(len(values))])
        named = (dict(zip(self.parameters, map(float, column), strict=True)) for column in (vectors * signs).T)
        pairs = zip(values, named, strict=True)
        return tuple(Direction(float(value), MappingProxyType(weights)) for value, weights in pairs)

    def excited(self, alpha: float) -> Array:
        """Return a basis (np, k) of the combinations, of nominal parameters, whose level is at least alpha."""
        values, vectors = np.linalg.eigh(self._in_nominals)
        return vectors[:, values >= alpha]


@dataclass(frozen=True, eq=False)
class ExcitationMonitor:
    """Evaluates the recursion (7.45), (7.69), (7.76) and the sums (7.44), (7.62), (7.75), (7.93) on trajectories.

    What the level promises: if that of a pair is at least alpha, `design.excited_set(alpha)` holds for the pair. The
    level of one trajectory, an estimated one, is that of every pair with it where `design.scope` is `global`, and near
    that of pairs near it where it is `local`.

    In continuous time Phi and the regressor are held over slots and half slots, between which x runs as a cubic: errors
    are of second order in the slots' lengths, however fast Phi is.

    Parameters
    ----------
    design : ExcitationDesign
    """

    design: ExcitationDesign

    def along(self, trajectory: Trajectory, *, until: float | None = None, start: Any = None) -> Information:
        """Return the information of one trajectory, such as `estimate.trajectory`.

        Parameters
        ----------
        trajectory : Trajectory
            Of a `DiscreteModel` one slot a step. `p` may have a row a slot (N, np) where parameters vary.
        until : float, optional
            Seconds: the trajectory is continued to then without disturbance, its last input and parameters held.
        start : tuple of Y (nx, np) and S (np, np), optional
            At the beginning, of paper 000 (18)-(19); zero when left out.
        """
        if until is not None:
            trajectory = self._continued(trajectory, until)
        h, points = self._points(trajectory)
        return self._gathered(h, self.design.increments.at(points), start)

    def between(self, first: Trajectory, second: Trajectory, *, start: Any = None) -> Information:
        """Return the information C_T of a pair of trajectories on the same mesh, with the same inputs."""
        h, points = self._points(first)
        again, others = self._points(second)
        if len(h) != len(again) or not np.allclose(h, again, rtol=1e-9, atol=1e-12):
            raise InputError("between: both trajectories must have the same nodes; give them on one mesh")
        return self._gathered(h, self.design.increments.between(points, others), start)

    def level(self, trajectory: Trajectory, *, until: float | None = None) -> float:
        """Return alpha_t of a trajectory; see `along`."""
        return self.along(trajectory, until=until).level

    def _points(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """Return lengths of slots (N,), and points (x, u, w, p) where Jacobians are asked, discrete (N, nv).

        Continuous (3 N, nv): of all slots the middles, then the middles of the first halves, then of the second ones.
        """
        used = np.diff(trajectory.t) > 0
        h, x = np.diff(trajectory.t)[used], np.asarray(trajectory.x)
        ends = (x[:-1][used], x[1:][used])
        w, u0, u1 = (np.asarray(part)[used] for part in (trajectory.w, trajectory.u0, trajectory.u1))
        p = np.asarray(trajectory.p, dtype=float)
        p = p[used] if p.ndim == 2 else np.tile(p, (len(h), 1))
        if self.design.discrete:
            return h, np.hstack([ends[0], u0, w, p])
        slopes = [self._rate(end, u, w, p) * h[:, None] for end, u in zip(ends, (u0, u1), strict=True)]
        rows = []
        for s in (0.5, 0.25, 0.75):
            cubic = (1 - s) * ends[0] + s * ends[1]
            jump = ends[1] - ends[0]
            cubic = cubic + s * (s - 1) * ((1 - 2 * s) * jump + (s - 1) * slopes[0] + s * slopes[1])
            rows.append(np.hstack([cubic, u0 + s * (u1 - u0), w, p]))
        return h, np.vstack(rows)

    def _rate(self, x: Array, u: Array, w: Array, p: Array) -> Array:
        """Return f of n points (n, nx)."""
        if not len(x):
            return np.zeros_like(x)
        dynamics = self.design.model.dynamics
        if len(x) > 1:
            dynamics = dynamics.map(len(x))
        times = np.zeros((1, len(x)))
        return np.asarray(dynamics.call([times, x.T, u.T, w.T, p.T])[0]).reshape(x.shape[1], len(x)).T

    def _continued(self, trajectory: Trajectory, until: float) -> Trajectory:
        """Return the trajectory carried on to `until` without disturbance, in slots like its last."""
        design, t = self.design, float(trajectory.t[-1])
        if until <= t + 1e-12 * max(1.0, abs(t)):
            return trajectory
        lengths = np.diff(trajectory.t)
        longest = float(design.model.step or (lengths.max() if len(lengths) else until - t))
        count = round((until - t) / longest) if design.discrete else int(np.ceil((until - t) / longest * (1 - 1e-9)))
        h = longest if design.discrete else (until - t) / max(count, 1)
        nw, nu = len(design.model.w), len(design.model.u)
        u = np.asarray(trajectory.u1)[-1:] if len(lengths) else np.zeros((1, nu))
        p = np.asarray(trajectory.p, dtype=float)
        p_end, w, states = np.atleast_2d(p)[-1:], np.zeros((1, nw)), [np.asarray(trajectory.x)[-1:]]
        for _ in range(count):
            x = states[-1]
            k1 = self._rate(x, u, w, p_end)
            if design.discrete:
                states.append(k1)
                continue
            k2 = self._rate(x + h / 2 * k1, u, w, p_end)
            k3 = self._rate(x + h / 2 * k2, u, w, p_end)
            k4 = self._rate(x + h * k3, u, w, p_end)
            states.append(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        held = np.tile(u, (count, 1))
        return replace(
            trajectory,
            t=np.concatenate([trajectory.t, t + h * np.arange(1, count + 1)]),
            x=np.vstack([trajectory.x, *states[1:]]),
            w=np.vstack([trajectory.w, np.zeros((count, nw))]),
            u0=np.vstack([trajectory.u0, held]),
            u1=np.vstack([trajectory.u1, held]),
            p=p if p.ndim == 1 else np.vstack([p, np.tile(p_end, (count, 1))]),
        )

    def _gathered(self, h: Array, jacobians: Jacobians, start: Any) -> Information:
        design, model = self.design, self.design.model
        n, o, N = len(model.x), len(model.p), len(h)
        Y, S = np.zeros((n, o)), np.zeros((o, o))
        if start is not None:
            Y, S = (np.array(part, dtype=float) for part in start)
            if Y.shape != (n, o) or S.shape != (o, o):
                raise InputError(f"start: expected Y ({n}, {o}) and S ({o}, {o}), got {Y.shape} and {S.shape}")
        Phi, G, C, F = design.recursion(jacobians)
        if design.discrete:
            Ys = np.empty((N + 1, n, o))
            Ys[0] = Y
            for k in range(N):
                Ys[k + 1] = Phi[k] @ Ys[k] + G[k]
            gains = _squares(C @ Ys[:-1] + F)
            weights, fade, Y = np.ones(N), design.mu ** np.arange(N - 1.0, -1.0, -1.0), Ys[-1]
            S = design.mu**N * S
        else:
            carry, feed = _half_slots(Phi[:N], h, constant=design.Phi is not None) if N else (Phi, Phi)
            Ys = np.empty((3, N, n, o))  # at starts, middles and ends of slots
            for k in range(N):
                Ys[0, k] = Y
                Ys[1, k] = carry[k] @ Y + feed[k] @ G[N + k]
                Ys[2, k] = Y = carry[k] @ Ys[1, k] + feed[k] @ G[2 * N + k]
            gains = _squares(C[:N] @ Ys + F[:N]).reshape(3 * N, o, o)
            weights = np.outer([1 / 6, 4 / 6, 1 / 6], h).ravel()  # Simpson's rule
            behind = np.append(np.cumsum(h[::-1])[-2::-1], 0.0) if N else h  # from a slot's end to the last one's
            fade = design.mu ** (behind + np.outer([1.0, 0.5, 0.0], h)).ravel()
            S = design.mu ** h.sum() * S
        S = S + np.einsum("k,kij->ij", weights * fade, gains)
        plain = np.einsum("k,kij->ij", weights, gains)
        return Information(frozen(S), frozen(plain), frozen(Y), model.p.names, frozen(model.p.nominal))


def _squares(seen: Array) -> Array:
    """Return v'v of matrices v (..., ny, np)."""
    return np.swapaxes(seen, -1, -2) @ seen


def _half_slots(Phi: Array, h: Array, *, constant: bool) -> tuple[Array, Array]:
    """Return the matrices (N, nx, nx) that carry Y, and a constant regressor, over half of each slot."""
    n = Phi.shape[1]
    where = np.arange(len(h))
    if constant:  # equal slots share theirs
        lengths = np.round(h / max(h.max(), 1e-300), 12)
        _, first, where = np.unique(lengths, return_index=True, return_inverse=True)
        Phi, h = Phi[first], h[first]
    block = np.zeros((len(h), 2 * n, 2 * n))
    block[:, :n, :n], block[:, :n, n:] = Phi, np.eye(n)
    flow = expm(block * (h / 2)[:, None, None])[where.ravel()]
    return flow[:, :n, :n], flow[:, :n, n:]
