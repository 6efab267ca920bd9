"""Checks a solution against the reference solver: same cost, same active bounds, multipliers of the right sign."""

from __future__ import annotations

import numpy as np

from ctmhe.errors import SolverError
from ctmhe.solvers.ipopt import Ipopt
from ctmhe.transcription.problem import Window
from ctmhe.transcription.solved import Solved

COST = 1e-8  # relative difference that counts
STRONG = 1e-3  # multipliers below this share of the largest may be active or not
SMALL = 1e-12  # of the cost of explaining nothing: costs below are zero


def verify(window: Window, solved: Solved, cost: float, reference: Ipopt) -> None:
    """Solve a window again from its solution by IPOPT and compare.

    Parameters
    ----------
    window : Window
    solved : Solved
        A converged solution.
    cost : float
        Its cost.
    reference : Ipopt
        Should start with a small barrier parameter, so that it stays near the solution.

    Raises
    ------
    SolverError
        IPOPT finds another cost (relative 1e-8, or ten times the integrator's accuracy), strongly active bounds differ,
        or a multiplier has the wrong sign.
    """
    other = reference.solve(window, solved.guess)
    if not other.success or other.multipliers is None:
        raise SolverError(f"verify: IPOPT does not converge from the solution ({other.message})")
    tolerance = max(COST, 10 * reference.stage.accuracy)
    data = float(np.sum((window.L_y @ window.y_data[..., None]) ** 2))
    if abs(cost - other.cost) > tolerance * max(abs(other.cost), SMALL * data / COST):
        raise SolverError(f"verify: cost {cost:.12g}, IPOPT continues to {other.cost:.12g}")
    tied = {"w": window.mesh.shared[:-1], "x": window.mesh.h == 0}  # copies of one variable share its bound's force
    level = STRONG * np.abs(other.multipliers.dynamics).max(initial=0.0)
    for key in "xwyp" if window.p_estimated else "xwy":
        mine, theirs = solved.part(f"{key}_multiplier"), getattr(other.multipliers, key)
        if not (np.size(mine) and np.size(theirs)):
            continue
        free = getattr(window, f"{key}_lower") < getattr(window, f"{key}_upper")
        wrong = (solved.part(f"{key}_active") * mine < 0) & free
        first = np.flatnonzero(np.concatenate([[True], ~tied[key]])) if key in tied else np.arange(len(mine))
        mine, theirs = (np.add.reduceat(np.where(free, values, 0.0), first) for values in (mine, theirs))
        strong = np.maximum(np.abs(mine), np.abs(theirs)) > max(level, STRONG * np.abs(theirs).max())
        differ = strong & (np.sign(mine) != np.sign(theirs))
        for what, where in (("a multiplier has the wrong sign", wrong), ("another active set", differ)):
            if where.any():
                at = tuple(int(i[0]) for i in np.nonzero(where))
                raise SolverError(f"verify: {what} at {key}{list(at)}")
