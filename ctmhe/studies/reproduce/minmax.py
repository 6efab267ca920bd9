"""Robust MHE of Mueller (2017) for linear models: a cost with the largest stage, and its full information form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from ctmhe.types import Array


@dataclass(frozen=True, eq=False)
class MinMaxEstimator:
    """min delta_1 L |x(0) - prior|^2 + max_j l_j + delta_2 sum_j l_j, with l = |w|^2 by q + |y - C x|^2 by r.

    Over a window of at most `horizon` steps, the newest output included; delta_1 = kappa^n and delta_2 = 1/n for n
    steps. The prior is the estimate made at the window's start. An infinite horizon is full information.

    Parameters
    ----------
    matrices : callable (k, x_hat) -> (A, C)
        The linear model that the estimate at step k uses over its whole window, from the estimate before.
    horizon : float
    q : array (nx,), r : array (ny,)
    L, kappa : float

    Source: Mueller (2017), (3), with delta = 1; Ji et al. (2016).
    """

    matrices: Callable[[int, Array], tuple[Array, Array]]
    horizon: float
    q: Array
    r: Array
    L: float
    kappa: float = 0.89

    def track(self, y: Array, guess: Array) -> Array:
        """Return the estimates (n, nx) at the steps of outputs y (n, ny)."""
        found, last = np.empty((len(y), len(guess))), guess
        for k in range(len(y)):
            n = int(min(k, self.horizon))
            prior, weights = guess if n == k else found[k - n], (self.L * self.kappa**n, 1.0 / max(n, 1))
            G = stage_matrix(*self.matrices(k, last), self.q, self.r)
            found[k] = last = minmax(G, np.sqrt(self.r) * y[k - n : k + 1], prior, *weights)[-1]
        return found


def stage_matrix(A: Array, C: Array, q: Array, r: Array) -> Array:
    """Return G with l_j = |G (x_j, x_j+1) - (0, sqrt(r) y_j)|^2."""
    top = np.sqrt(q)[:, None] * np.column_stack([-A, np.eye(len(A))])
    return np.vstack([top, np.sqrt(r)[:, None] * np.column_stack([C, np.zeros((len(C), len(A)))])])


def minmax(G: Array, y: Array, prior: Array, weight: float, mean: float) -> Array:
    """Return the states (n + 1, nx) that minimise weight |x_0 - prior|^2 + max_j l_j + mean sum_j l_j.

    min s subject to l_j <= s, by a primal-dual interior method; every stage sees two neighbouring states, so Newton's
    matrix is banded but for the row of s.

    Parameters
    ----------
    G : array (nx + ny, 2 nx)
        Of a stage; the last has its outputs only.
    y : array (n + 1, ny)
        Outputs times the square roots of their weights.
    """
    n, nx, ny = len(y) - 1, len(prior), y.shape[1]
    if not n:  # one output: least squares
        C = G[len(G) - ny :, :nx]
        gain = np.linalg.solve(weight * np.eye(nx) + (1 + mean) * C.T @ C, (1 + mean) * C.T)
        return (prior + gain @ (y[0] - C @ prior))[None]
    blocks = np.repeat(G[None], n + 1, axis=0)
    blocks[n, : len(G) - ny] = blocks[n, :, nx:] = (
        0.0  # the last stage has no w; the state behind it is free, and fixed
    )
    data = np.zeros((n + 1, len(G)))
    data[:, len(G) - ny :] = y
    square = np.einsum("jri,jrk->jik", blocks, blocks)
    x = np.tile(prior, (n + 2, 1))

    def stages(x: Array) -> tuple[Array, Array]:
        residual = np.einsum("jri,ji->jr", blocks, np.column_stack([x[:-1], x[1:]])) - data
        return np.einsum("jr,jr->j", residual, residual), 2 * np.einsum("jri,jr->ji", blocks, residual)

    level, slope = stages(x)
    s = float(level.max()) * 1.5 + 1e-6
    multipliers, centre = np.full(n + 1, 1.0 / (n + 1)), 0.1
    for _ in range(80):
        gap = s - level
        mu = centre * float(multipliers @ gap) / (n + 1)
        ratio = multipliers / gap
        gradient = _gathered((mean + mu / gap)[:, None] * slope, n, nx)
        gradient[:nx] += 2 * weight * (x[0] - prior)
        local = 2 * (mean + multipliers)[:, None, None] * square
        local += ratio[:, None, None] * slope[:, :, None] * slope[:, None, :]
        band = _banded(local, n, nx)
        band[0, :nx] += 2 * weight
        band[0] += 1e-12 * float(band[0].max()) + 1e-12
        band[0, -nx:] += 1.0  # the state behind the last
        border = -_gathered(ratio[:, None] * slope, n, nx)
        try:
            both = solveh_banded(band, np.column_stack([-gradient, border]), lower=True)
        except np.linalg.LinAlgError:  # as exact as rounding allows
            break
        bend = float(ratio.sum() - border @ both[:, 1])
        ds = (-(1 - float(np.sum(mu / gap))) - float(border @ both[:, 0])) / max(bend, 1e-300)
        dx = both[:, 0] - both[:, 1] * ds
        move = dx.reshape(n + 2, nx)
        along = np.einsum("ji,ji->j", slope, np.column_stack([move[:-1], move[1:]]))
        dm = mu / gap - multipliers - ratio * (ds - along)
        share = min(1.0, 0.99 / max(float((-dm / multipliers).max()), 1e-300))
        step = 1.0
        while (s + step * ds - stages(x + step * move)[0] <= 0.005 * gap).any() and step > 1e-10:
            step *= 0.7
        if step <= 1e-10:
            break
        x, s, multipliers = x + step * move, s + step * ds, multipliers + share * dm
        level, slope = stages(x)
        centre = 0.1 if min(step, share) > 0.3 else 0.5
        if float(multipliers @ (s - level)) < 1e-6 * max(s, 1e-9) and step > 0.9:
            break
    return x[:-1]


def _gathered(parts: Array, n: int, nx: int) -> Array:
    """Return the sum of vectors (n + 1, 2 nx) of neighbouring states, flat."""
    total = np.zeros((n + 2, nx))
    total[:-1] += parts[:, :nx]
    total[1:] += parts[:, nx:]
    return total.reshape(-1)


def _banded(local: Array, n: int, nx: int) -> Array:
    """Return the sum of matrices (n + 1, 2 nx, 2 nx) of neighbouring states, lower banded."""
    band = np.zeros((2 * nx, (n + 2) * nx))
    for i in range(2 * nx):
        for j in range(i + 1):
            band[i - j, j : j + (n + 1) * nx : nx] += local[:, i, j]
    return band
