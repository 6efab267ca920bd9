"""The solver protocol: prepared once for a stage function, then called with one window's data after another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ctmhe.transcription.problem import Guess, Window
from ctmhe.types import Array, Outcome


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a solver stopped.

    Attributes
    ----------
    point : Guess
        Decisions and the bounds active there; never None, also after a failure.
    y : array (N, q, ny)
        Outputs at `point`.
    cost : float
        J at `point`.
    success : bool
        Optimality and feasibility hold to the solver's tolerance.
    message : str
        Why it stopped.
    iterations : int
    optimality : float
        Scaled stationarity residual.
    feasibility : float
        Scaled residual of dynamics and bounds.
    factorizations : int
    multipliers : Multipliers or None
        Of the dynamics and the bounds, in scaled variables, for the cost J / 2.
    stopped : Outcome or None
        The limit (of iterations, of time) that ended a solve which was still making progress.
    notes : tuple of str
        Facts for the status.
    """

    point: Guess
    y: Array
    cost: float
    success: bool
    message: str
    iterations: int = 0
    optimality: float = float("nan")
    feasibility: float = float("nan")
    factorizations: int = 0
    multipliers: Multipliers | None = None
    stopped: Outcome | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Lagrange multipliers in scaled variables for the cost J / 2; positive at upper, negative at lower bounds."""

    dynamics: Array  # (N, nx)
    x: Array  # (N+1, nx)
    w: Array  # (N, nw)
    y: Array  # (N, ny)
    p: Array  # (np,)


class Solver(Protocol):
    """Solves windows from a guess; keeps scratch memory only, so equal arguments give equal results."""

    name: str

    def solve(self, window: Window, guess: Guess) -> Solution:
        """Return the solution, or the best point found with `success=False` and the reason."""
        ...


def clip_to_bounds(window: Window, guess: Guess) -> Guess:
    """Return the guess with x, w, p moved inside their boxes and one w for all slots of a cell."""
    w = np.clip(guess.w, window.w_lower, window.w_upper)
    for k in np.flatnonzero(window.mesh.shared):
        w[k + 1] = w[k]
    return Guess(
        np.clip(guess.x, window.x_lower, window.x_upper),
        w,
        np.clip(guess.p, window.p_lower, window.p_upper) if window.p_estimated else guess.p,
        guess.x_active,
        guess.w_active,
        guess.y_active,
        guess.p_active,
    )
