"""The problem of one window as plain arrays: what every solver is given, and how a guess is judged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctmhe.transcription.grid import Mesh
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array


@dataclass(frozen=True, eq=False)
class Window:
    """One estimation problem, as data. All cost terms are squares of L-weighted residuals.

        J = |L_prior (x_0 - x_bar, p - p_bar)|^2 + sum_k |L_w w_k|^2 + sum_kq |L_y (y_kq - y_data)|^2

    Attributes
    ----------
    mesh : Mesh
    u0, u1 : array (N, nu)
        Known input at both ends of each slot.
    prior : array (nx + np,)
        Prior of state and parameters.
    p_estimated : bool
        The parameters are decision variables; else they are held at the prior.
    L_prior : array (n, n)
        Square root of the discounted prior weight, n = nx (+ np when estimated).
    L_w : array (N, nw, nw)
        Square roots of the weights of w, slot length and discount included.
    L_y : array (N, q, ny, ny)
        Square roots of the weights of the output residuals at the q evaluation points; zero where nothing is known.
    y_data : array (N, q, ny)
    x_lower, x_upper : array (N+1, nx)
    w_lower, w_upper : array (N, nw)
    y_lower, y_upper : array (N, ny)
        Bounds of the output at the end of each slot (start for discrete models), residual bounds included.
    p_lower, p_upper : array (np,)
    x_scale, w_scale, p_scale, y_scale : array
        Typical magnitudes.
    """

    mesh: Mesh
    u0: Array
    u1: Array
    prior: Array
    p_estimated: bool
    L_prior: Array
    L_w: Array
    L_y: Array
    y_data: Array
    x_lower: Array
    x_upper: Array
    w_lower: Array
    w_upper: Array
    y_lower: Array
    y_upper: Array
    p_lower: Array
    p_upper: Array
    x_scale: Array
    w_scale: Array
    p_scale: Array
    y_scale: Array

    @property
    def output_bounded(self) -> bool:
        """Whether any output bound is finite."""
        return bool(np.isfinite(self.y_lower).any() or np.isfinite(self.y_upper).any())

    def relaxed(self) -> Window:
        """Return the problem without bounds on x and y: what the last rung of the failure ladder solves."""
        return replace(
            self,
            x_lower=np.full_like(self.x_lower, -np.inf),
            x_upper=np.full_like(self.x_upper, np.inf),
            y_lower=np.full_like(self.y_lower, -np.inf),
            y_upper=np.full_like(self.y_upper, np.inf),
        )


@dataclass(frozen=True, eq=False)
class Guess:
    """A point in the space of decisions: x (N+1, nx), w (N, nw), p (np,), and the bounds believed active there.

    `x_active`, `w_active`, `y_active`, `p_active` hold -1 (lower), 0, +1 (upper).
    """

    x: Array
    w: Array
    p: Array
    x_active: np.ndarray
    w_active: np.ndarray
    y_active: np.ndarray
    p_active: np.ndarray

    @classmethod
    def of(cls, x: Array, w: Array, p: Array, ny: int) -> Guess:
        """Build a guess with no active bounds."""
        shapes = (x.shape, w.shape, (len(w), ny), p.shape)
        return cls(x, w, p, *(np.zeros(shape, dtype=np.int8) for shape in shapes))


def cost_of(window: Window, guess: Guess, y: Array) -> float:
    """Return J at a point whose outputs are `y` (N, q, ny)."""
    deviation = prior_deviation(window, guess)
    total = float(np.sum((window.L_prior @ deviation) ** 2))
    total += float(np.sum((window.L_w @ guess.w[:, :, None]) ** 2))
    total += float(np.sum((window.L_y @ (y - window.y_data)[..., None]) ** 2))
    return total


def prior_deviation(window: Window, guess: Guess) -> Array:
    """Return (x_0, p) - prior over the weighted entries: nx, or nx + np when the parameters are estimated."""
    values = np.concatenate([guess.x[0], guess.p]) - window.prior
    return values[: len(window.L_prior)]


def rollout(stage: StageFunction, window: Window, x: Array, p: Array, w: Array | None = None) -> Guess:
    """Integrate from `x` over the window, with disturbance `w` (N, nw) or none: feasible by construction."""
    mesh = window.mesh
    n = len(mesh)
    w = np.zeros((n, stage.nw)) if w is None else w
    return Guess.of(stage.roll(mesh.t[:-1], mesh.h, x, w, p, window.u0, window.u1), w, p, stage.ny)


def bound_violation(window: Window, guess: Guess, y_end: Array) -> float:
    """Return the largest violation of a bound, relative to the signals' scales."""
    pairs = (
        (guess.x, window.x_lower, window.x_upper, window.x_scale),
        (guess.w, window.w_lower, window.w_upper, window.w_scale),
        (y_end, window.y_lower, window.y_upper, window.y_scale),
        (guess.p, window.p_lower, window.p_upper, window.p_scale),
    )
    worst = 0.0
    for value, lower, upper, scale in pairs:
        if value.size:
            worst = max(worst, float(np.max(np.maximum(lower - value, value - upper) / scale)))
    return max(worst, 0.0)
