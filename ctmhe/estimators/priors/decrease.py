"""The decrease condition (4.15): the cheapest of the candidate and the feasible points that an iterate gives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from ctmhe.solvers.base import Solution, Solver, clip_to_bounds
from ctmhe.transcription.problem import Guess, Window, bound_violation, cost_of, rollout
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Outcome, Status

FEASIBLE = 1e-8
"""Largest defect of the dynamics, and violation of a bound, relative to the signals' scales."""

NEWTON_STEPS = 4


def improved(
    stage: StageFunction,
    window: Window,
    solver: Solver | None,
    candidate: Guess,
    start: Guess,
    *,
    process: np.ndarray | None,
    exact: bool = False,
    notes: tuple[str, ...] = (),
) -> tuple[Solution, Status, bool]:
    """Return the suboptimal solution (Definition 4.2) after what a solver does from `start`, and whether it may.

    Parameters
    ----------
    solver : Solver or None
        Any, stopped at any iteration; none for zero iterations.
    candidate : Guess
        Wins unless something feasible is cheaper.
    process : int array (nx,) or None
        Disturbances that can move every state, and `exact`: see `connected`.
    notes : tuple of str
        For the status.

    Returns
    -------
    solution : Solution
    status : Status
    kept : bool
        The candidate is feasible: a trajectory of the model within the bounds.
    """
    first = judged(stage, window, candidate)
    found = None if solver is None else solver.solve(window, start)
    points = (
        []
        if found is None or not np.isfinite(found.point.x).all()
        else list(repaired(stage, window, found, process, exact))
    )
    usable = [point for point in (first, *points) if point.feasibility <= FEASIBLE and np.isfinite(point.cost)]
    kept = first.feasibility <= FEASIBLE and bool(np.isfinite(first.cost))
    iterations, optimality, factorizations = 0, float("nan"), 0
    if found is not None:
        iterations, optimality, factorizations = found.iterations, found.optimality, found.factorizations
    if not kept:
        notes = (*notes, "the candidate leaves the bounds")
    if not usable:
        finite = [point for point in (*points, first) if np.isfinite(point.cost)]
        best = min(finite, key=lambda point: point.feasibility) if finite else first
        outcome = Outcome.RELAXED if finite else Outcome.PREDICTED
        status = Status(outcome, False, iterations, optimality, best.feasibility, best.feasibility, (), notes)
        return best, status, False
    best = min(usable, key=lambda point: point.cost)
    solved = found is not None and found.success and best is not first
    if best is first and found is not None:
        notes = (*notes, "the candidate is kept: nothing that is feasible costs less")
    stopped = (None if found is None else found.stopped) or Outcome.ITERATION_LIMIT
    outcome = Outcome.SOLVED if solved or (found is not None and found.success) else stopped
    success = found is not None and found.success
    status = Status(outcome, success, iterations, optimality, best.feasibility, 0.0, (), notes, factorizations)
    return best, status, kept


def repaired(
    stage: StageFunction, window: Window, found: Solution, process: np.ndarray | None, exact: bool
) -> Iterator[Solution]:
    """Yield the iterate if it is feasible, else the trajectories of the model that it gives.

    They are the one that starts where it starts with the disturbances that it has, and the one through its states.
    """
    point = found.point
    if found.feasibility <= FEASIBLE:
        yield found
        return
    clipped = clip_to_bounds(window, point)
    with suppress(FloatingPointError):
        yield judged(stage, window, _with(point, rollout(stage, window, clipped.x[0], point.p, clipped.w)))
    if process is not None and not window.mesh.shared.any():
        through = connected(stage, window, clipped.x, clipped.w, point.p, process, exact=exact)
        if through is not None:
            yield judged(stage, window, _with(point, through))


def connected(
    stage: StageFunction, window: Window, x: Array, w: Array, p: Array, process: np.ndarray, *, exact: bool = False
) -> Guess | None:
    """Return the trajectory through states x (N+1, nx), with the disturbances that lead from each to the next.

    `process` are the places in w of as many of them as there are states. Where slots share their disturbance, its first
    slot decides and the states follow from it. None where there are none, or the model fails. `exact`: they enter as
    f + d, so that one step finds them.
    """
    mesh, nx = window.mesh, stage.nx
    live, w, columns = mesh.h > 0, w.copy(), nx + process
    try:
        if exact:
            x_next, _ = stage.values(mesh.t[:-1], mesh.h, x[:-1], w, p, window.u0, window.u1)
            w[np.ix_(live, process)] += (x[1:] - x_next)[live]
        for _ in range(0 if exact else NEWTON_STEPS):
            linear = stage.linearize(mesh.t[:-1], mesh.h, x[:-1], w, p, window.u0, window.u1)
            missing = np.where(live[:, None], x[1:] - linear.x_next, 0.0)
            if not np.abs(missing / window.x_scale).max(initial=0.0) > 1e-14:
                break
            steps = np.linalg.solve(linear.jacobian[live][:, :nx][:, :, columns], missing[live][..., None])[..., 0]
            w[np.ix_(live, process)] += steps
    except (FloatingPointError, np.linalg.LinAlgError):
        return None
    if not np.isfinite(w).all():
        return None
    if not mesh.shared.any():
        return Guess.of(x, w, p, stage.ny)
    for k in np.flatnonzero(mesh.shared):
        w[k + 1] = w[k]
    try:
        return rollout(stage, window, x[0], p, w)
    except FloatingPointError:
        return None


def judged(stage: StageFunction, window: Window, point: Guess) -> Solution:
    """Return a point with its outputs, cost and feasibility; infinite ones where the model fails."""
    mesh, n = window.mesh, len(window.mesh)
    try:
        x_next, y = stage.values(mesh.t[:-1], mesh.h, point.x[:-1], point.w, point.p, window.u0, window.u1)
    except FloatingPointError as error:
        y = np.full((n, stage.q, stage.ny), np.nan)
        return Solution(point, y, float("inf"), False, str(error), feasibility=float("inf"))
    with np.errstate(all="ignore"):
        defect = np.abs((x_next - point.x[1:]) / window.x_scale).max(initial=0.0)
        feasibility, cost = max(float(defect), bound_violation(window, point, y[:, -1])), cost_of(window, point, y)
    whole = bool(np.isfinite(point.x).all() and np.isfinite(cost) and np.isfinite(feasibility))
    return Solution(
        point,
        y,
        cost if whole else float("inf"),
        False,
        "a candidate",
        feasibility=feasibility if whole else float("inf"),
    )


def _with(point: Guess, path: Guess) -> Guess:
    """Return a trajectory with the bounds believed active at a point."""
    return Guess(path.x, path.w, path.p, point.x_active, point.w_active, point.y_active, point.p_active)
