"""Where a solve starts: the last solution on the new mesh, the prior carried forward; and what is left if all fail."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ctmhe.estimators.state import State
from ctmhe.estimators.trajectories import trajectory_at
from ctmhe.solvers.base import Solution
from ctmhe.transcription.problem import Guess, Window, rollout
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array


def starting_points(stage: StageFunction, state: State, window: Window) -> list[tuple[str, Callable[[], Guess]]]:
    """Return the names of the guesses and how to make them, best first."""
    points: list[tuple[str, Callable[[], Guess]]] = [("shifted guess", lambda: shifted_guess(stage, window))]
    if state.window is not None and state.t >= window.mesh.t[0]:
        points.insert(0, ("warm start", lambda: warm_start(stage, state, window)))
    return points


def shifted_guess(stage: StageFunction, window: Window) -> Guess:
    """Return the prior carried forward without disturbance; held where that leaves the model's domain."""
    nx = stage.nx
    x0 = np.clip(window.prior[:nx], window.x_lower[0], window.x_upper[0])
    try:
        guess = rollout(stage, window, x0, window.prior[nx:])
        if np.isfinite(guess.x).all():
            return guess
    except FloatingPointError:
        pass
    return resting_guess(stage, window, x0, window.prior[nx:])


def resting_guess(stage: StageFunction, window: Window, x: Array, p: Array) -> Guess:
    """Return a state (nx,) at which the model could be evaluated once, held over the window."""
    return Guess.of(np.tile(x, (len(window.mesh) + 1, 1)), np.zeros((len(window.mesh), stage.nw)), p, stage.ny)


def warm_start(stage: StageFunction, state: State, window: Window) -> Guess:
    """Return the last solution on the new mesh, carried forward behind its end, with its active set."""
    assert state.window is not None
    last, mesh, n = state.window.trajectory, window.mesh, len(window.mesh)
    old = int(np.searchsorted(mesh.t, last.t[-1], side="right"))  # nodes that the last window covers
    x = np.empty((n + 1, stage.nx))
    for i in range(stage.nx):
        x[:old, i] = np.interp(mesh.t[:old], last.t, last.x[:, i])
    middle = mesh.t[:-1] + mesh.h / 2
    slot = np.clip(np.searchsorted(last.t, middle, side="right") - 1, 0, len(last.w) - 1)
    inside = ((middle >= last.t[0]) & (middle <= last.t[-1]))[:, None]
    w = np.where(inside, last.w[slot], 0.0)
    for k in np.flatnonzero(mesh.shared):
        w[k + 1] = w[k]  # the last cell goes on with its w
    p = last.p if window.p_estimated else window.prior[stage.nx :]
    try:
        carry_forward(stage, window, x, w, p, max(old - 1, 0))
    except FloatingPointError:
        return shifted_guess(stage, window)
    node = np.clip(np.searchsorted(last.t, mesh.t - mesh.tolerance), 0, len(last.x) - 1)
    covered = (mesh.t <= last.t[-1] + mesh.tolerance)[:, None]
    x_active, w_active, y_active, p_active = (state.window.part(f"{key}_active") for key in "xwyp")
    return Guess(
        x,
        w,
        p,
        np.where(covered, x_active[node], 0).astype(np.int8),
        np.where(inside, w_active[slot], 0).astype(np.int8),
        np.where(inside, y_active[slot], 0).astype(np.int8),
        p_active,
    )


def carry_forward(stage: StageFunction, window: Window, x: Array, w: Array, p: Array, first: int) -> None:
    """Integrate from node `first` to the window's end, writing the states into `x` (N+1, nx)."""
    mesh = window.mesh
    for k in range(first, len(mesh)):
        x[k + 1], _ = stage.step(mesh.t[k], mesh.h[k], x[k], w[k], p, window.u0[k], window.u1[k])


def open_loop(stage: StageFunction, state: State, window: Window) -> Solution:
    """Return the last solution, and behind it the prediction without disturbance: when no solver gave numbers."""
    mesh, n = window.mesh, len(window.mesh)
    x, w = np.tile(state.x, (n + 1, 1)), np.zeros((n, stage.nw))
    passed = int(np.searchsorted(mesh.t, state.t, side="right"))  # nodes up to the last estimate
    if state.window is not None:
        last = state.window.trajectory
        for k in range(passed):
            if mesh.t[k] >= last.t[0]:
                x[k] = trajectory_at(stage, last, mesh.t[k])
    try:
        if 0 < passed <= n:  # from the last estimate, which may lie inside a slot, to the next node
            k = passed - 1
            rest = mesh.t[passed] - state.t
            share = (state.t - mesh.t[k]) / mesh.h[k] if mesh.h[k] > 0 else 0.0
            u = window.u0[k] + share * (window.u1[k] - window.u0[k])
            x[passed], _ = stage.step(state.t, rest, state.x, w[k], state.p, u, window.u1[k])
        elif passed == 0:  # a gap longer than the horizon: the prior is the prediction
            x[0] = window.prior[: stage.nx]
        carry_forward(stage, window, x, w, state.p, passed)
    except FloatingPointError:
        pass
    x[~np.isfinite(x).all(axis=1)] = state.x  # never keep what is not finite: the next estimate starts from here
    point = Guess.of(x, w, state.p, stage.ny)
    try:
        _, y = stage.values(mesh.t[:-1], mesh.h, x[:-1], w, state.p, window.u0, window.u1)
    except FloatingPointError:
        y = np.full((n, stage.q, stage.ny), np.nan)
    return Solution(point, y, float("nan"), False, "open loop")
