"""What every tool starts from and is judged by: the priors, the first window, the cost of each update."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.problems import Problem
from ctmhe.estimators import MHE
from ctmhe.estimators.state import State
from ctmhe.types import Array, Estimate, Input, Measurement

GROWTH = 8  # estimates while the first window grows to its length


@dataclass(frozen=True, eq=False)
class Reference:
    """The run of ctmhe that defines the windows.

    Attributes
    ----------
    priors : array (updates + 1, nx + np)
        x_hat(k h) and p_hat, thesis (3.18).
    costs : array (updates + 1,)
    x_ends : array (updates + 1, nx)
    x, w, p : array (count + 1, nx), (count, nw), (np,)
        Solution of window 0: everybody's first guess.
    active : array (updates + 1,)
        Entries of x that rest on a bound.
    """

    priors: Array
    costs: Array
    x_ends: Array
    x: Array
    w: Array
    p: Array
    active: Array


def build(problem: Problem, **options: Any) -> MHE:
    """Return ctmhe's estimator of a problem."""
    return MHE(
        problem.model,
        horizon=problem.horizon,
        interval=problem.interval,
        integrator=problem.integrator,
        cost=problem.cost,
        bounds=problem.bounds,
        hold="point",
        **options,
    )


def accepts(option: str) -> bool:
    """Return whether this version of the library knows an option of `MHE`."""
    return option in inspect.signature(MHE).parameters


def observe(mhe: MHE, state: State, problem: Problem, j: int) -> State:
    """Return the state that knows sample j and the input on the interval that it ends."""
    h = problem.interval
    if len(problem.model.u):
        state = mhe.control(state, Input((j - 1) * h, problem.u[j - 1]))
    return mhe.observe(state, Measurement(j * h, problem.y[j]))


def grow(mhe: MHE, problem: Problem) -> tuple[State, Estimate]:
    """Return the state and the estimate at t = T, after a few estimates while the window grew."""
    n = problem.count
    state = mhe.init(x=problem.x_guess, p=problem.p_guess if len(problem.p_guess) else None)
    stops = {max(1, round(n * i / GROWTH)) for i in range(1, GROWTH + 1)}
    estimate = None
    for j in range(1, n + 1):
        state = observe(mhe, state, problem, j)
        if j in stops:
            state, estimate = mhe.estimate(state, j * problem.interval)
    assert estimate is not None
    return state, estimate


def refer(problem: Problem, updates: int) -> Reference:
    """Run ctmhe without a compiler, converged, over all windows."""
    mhe = build(problem, **({"compile": "off"} if accepts("compile") else {}))
    state, estimate = grow(mhe, problem)
    stride = (len(estimate.trajectory.t) - 1) // problem.count
    nodes, cells = estimate.trajectory.x[::stride], estimate.trajectory.w[::stride]
    first = (nodes.copy(), cells.copy(), estimate.p.copy())
    rows = [estimate]
    for k in range(1, updates + 1):
        state = observe(mhe, state, problem, problem.count + k)
        state, estimate = mhe.estimate(state, (problem.count + k) * problem.interval)
        rows.append(estimate)
    lower, upper = problem.x_box
    return Reference(
        priors=np.array([row.prior for row in rows]),
        costs=np.array([row.cost if row.status.success else np.nan for row in rows]),
        x_ends=np.array([row.x for row in rows]),
        x=first[0],
        w=first[1],
        p=first[2],
        active=np.array(
            [np.sum((row.trajectory.x <= lower + 1e-9) | (row.trajectory.x >= upper - 1e-9)) for row in rows]
        ),
    )
