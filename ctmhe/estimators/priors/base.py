"""Priors: how a window's past enters its cost, and what has to be remembered for it.

A prior is asked for its value at the start of every window and told every solution. All that it remembers lies in
`State.memory`, as logs: rows of numbers, each with its time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.trajectories import empty_path, lagged_rows, path_at, trajectory_at
from ctmhe.transcription.solved import Solved
from ctmhe.types import Array, ErrorBound, frozen

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State

Memory = Mapping[str, Log]
NOTHING: Memory = {}


@dataclass(frozen=True, eq=False)
class Anchor:
    """The prior of one window.

    Attributes
    ----------
    value : array (nx + np,)
        Prior of state and parameters at the window's start.
    notes : tuple of str
        For the status of the estimate.
    factor : float
        On the weight, beside its discount.
    weight : array (n, n), optional
        In place of the cost's P, n = nx, or nx + np where the parameters are estimated.
    """

    value: Array
    notes: tuple[str, ...] = ()
    factor: float = 1.0
    weight: Array | None = None


@dataclass(frozen=True, eq=False)
class Told:
    """What an estimate says in place of its window's end, where a prior has a say in that: its method `told`.

    Attributes
    ----------
    value : array (nx + np,)
        State and parameters.
    notes : tuple of str
        For the status of the estimate.
    bound : ErrorBound, optional
    """

    value: Array
    notes: tuple[str, ...] = ()
    bound: ErrorBound | None = None


@runtime_checkable
class Prior(Protocol):
    """The prior of every window: a rule, without state of its own.

    One that also has a method `told(mhe, state, solved) -> Told`, asked last, has a say in what the estimate says. One
    that remembers bounds has a method `revised(memory, since) -> Memory`, called when data at `since`, before the last
    estimate, turn out to be others.
    """

    @property
    def reach(self) -> float:
        """For how many seconds before the horizon measurements and inputs are needed."""
        ...

    def begin(self, mhe: MHE, state: State) -> Memory:
        """Return what is remembered at the start of estimation."""
        ...

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """Return the prior of the window that starts at `start` (seconds), which is t0 while the window grows.

        None where nothing is known there: in a gap longer than the horizon. The prior is then the prediction.
        """
        ...

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """Return what is remembered after a solve; `state` holds the new estimate already, and the memory before it."""
        ...


class Filtering:
    """The estimated trajectory at the window's start: (3.18), (5.17), the initial estimate while the window grows."""

    reach = 0.0

    def begin(self, mhe: MHE, state: State) -> Memory:
        """Return nothing: the state keeps the estimated trajectory in any case."""
        return NOTHING

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`."""
        if growing:
            return Anchor(state.start)
        slack = mhe.slack(state.t)
        if start > state.t + slack:
            return None
        value = path_at(mhe.stage, state.path, min(start, state.t), slack)
        return None if value is None else Anchor(value)

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        return state.memory


class Smoothing:
    """The last solution at the window's start: (6.65), which is its second node when every step is solved.

    The thesis has it in discrete time, solved at every step; on irregular instants this form is ours.
    """

    reach = 0.0

    def begin(self, mhe: MHE, state: State) -> Memory:
        """Return nothing: the state keeps the last solution in any case."""
        return NOTHING

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`."""
        if growing:
            return Anchor(state.start)
        if state.window is None or start > state.t + mhe.slack(state.t):
            return None
        last = state.window.trajectory
        if start <= last.t[0] + mhe.slack(start):  # a solve that is repeated
            return Anchor(frozen(state.window.part("prior")))
        return Anchor(np.concatenate([trajectory_at(mhe.stage, last, start), last.p]))

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        return state.memory


class Turnpike:
    """The first solution made half a horizon after the window's start, or later, there: (6.66).

    That is about the middle of its window, far from both ends: near the turnpike. The thesis has it in discrete time,
    solved at every step; on irregular instants this form is ours. Solutions are remembered as the trajectory that lags
    by half a horizon.
    """

    reach = 0.0

    def begin(self, mhe: MHE, state: State) -> Memory:
        """See `Prior`."""
        return {"turnpike": empty_path(mhe.stage)}

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`."""
        if growing:
            return Anchor(state.start)
        slack = mhe.slack(state.t)
        value = path_at(mhe.stage, state.memory["turnpike"], start, slack)
        if value is not None:
            return Anchor(value)
        return SMOOTHING.at(mhe, state, start, growing)  # no solve in the last half of the horizon

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        last, lag, slack = solved.trajectory, mhe.horizon / 2, mhe.slack(state.t)
        if mhe.model.step is not None and np.isfinite(lag):  # whole steps
            lag = np.floor(lag / mhe.model.step + 1e-6) * mhe.model.step
        since, until = max(state.since - lag, last.t[0]), state.t - lag
        path = state.memory["turnpike"].drop_after(since)  # a solve that is repeated replaces its own piece
        if until > since + slack:
            path = path.extend(*lagged_rows(mhe.stage, last, since, until))
        return {"turnpike": path.drop_before(state.t - mhe.horizon - slack)}


SMOOTHING = Smoothing()
PRIORS = {"filtering": Filtering(), "smoothing": SMOOTHING, "turnpike": Turnpike()}


def prior_of(given: object) -> Prior:
    """Return a prior given by name or as an object."""
    if isinstance(given, str) and given in PRIORS:
        return PRIORS[given]
    if isinstance(given, type) or not isinstance(given, Prior):
        raise InputError(
            f"prior must be {', '.join(map(repr, PRIORS))}, or an object with reach, begin, at and after; got {given!r}"
        )
    return given
