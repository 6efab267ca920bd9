"""A policy at work: its answers so far, its memory, and the level that says how near the next sample is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctmhe.triggers.answers import ask_level, ask_time, ask_yes, initial_memory, kind_of, remember, settle
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.compose import And, Combined
from ctmhe.triggers.timing import tolerance


@dataclass(frozen=True)
class Standing:
    """What is on record about one elementary policy.

    Its memory; its last yes or no; the time that it named; and whether its guard was still >= 0 right after a sample,
    which silences it until the next monitoring time.
    """

    memory: Any = None
    yes: bool = False
    due: float = np.inf
    silent: bool = False


@dataclass(frozen=True)
class WatchState:
    """Memory of a whole policy during a run: one `Standing` for each elementary policy, left to right."""

    standings: tuple[Standing, ...]

    @property
    def dues(self) -> tuple[float, ...]:
        """Times named by self-triggered policies, in seconds."""
        return tuple(standing.due for standing in self.standings)

    def next_due(self, t: float) -> float:
        """Return the first named time after `t`, inf if none."""
        return min((due for due in self.dues if due > t), default=np.inf)


class Watch:
    """Asks the elementary policies inside a composed one, and combines their answers into one level.

    The level is the guard's value, or +inf (yes) and -inf (no) for the two other kinds; `|` takes the largest, `&` the
    smallest. A sample is due as soon as the level is >= 0. A watch holds no state: `start`, `monitored` and `sampled`
    return it, so one policy can serve many runs, or a loop of the user's own.

    Parameters
    ----------
    policy : Trigger
    """

    def __init__(self, policy: Trigger):
        self.policy = policy
        self.leaves = tuple(_leaves(policy))
        self.kinds = tuple(kind_of(leaf) for leaf in self.leaves)
        self.has_guard = "guard" in self.kinds

    def start(self, ctx: TriggerContext) -> WatchState:
        """Return the state at the start of a run; self-triggered policies name their first time."""
        empty = WatchState(tuple(Standing(memory=initial_memory(leaf)) for leaf in self.leaves))
        return self._plan(empty, ctx, earliest=ctx.t)

    def ask(self, state: WatchState, ctx: TriggerContext) -> WatchState:
        """Ask the yes-or-no policies at a monitoring time; the answers stand until the next. Guards speak again."""
        rows = zip(self.leaves, self.kinds, state.standings, strict=True)
        return WatchState(
            tuple(
                replace(row, yes=ask_yes(leaf, replace(ctx, state=row.memory)))
                if kind == "fires"
                else replace(row, silent=False)
                for leaf, kind, row in rows
            )
        )

    def level(self, state: WatchState, ctx: TriggerContext, as_of: float | None = None) -> float:
        """Return the level at `ctx.t`: >= 0 when a sample is due.

        `as_of` judges named times as at that earlier time (seconds): the level is then as smooth as the guards are.
        """
        t = ctx.t if as_of is None else as_of
        rows = zip(self.leaves, self.kinds, state.standings, strict=True)
        return _combine(self.policy, iter([_level(leaf, kind, row, ctx, t) for leaf, kind, row in rows]))

    def monitored(self, state: WatchState, ctx: TriggerContext) -> WatchState:
        """Return the state after a monitoring time at which no sample was taken."""
        return self._remember(state, ctx, fired=False)

    def sampled(self, state: WatchState, before: TriggerContext, after: TriggerContext) -> WatchState:
        """Return the state after a sample; self-triggered policies name their next time.

        `before` is the context at the sample, `after` the one that knows of it and of the new estimate.
        """
        state = self._remember(state, before, fired=True)
        rows = zip(self.leaves, state.standings, strict=True)
        spent = WatchState(
            tuple(
                replace(row, yes=False)
                if type(leaf).after_sample is Trigger.after_sample
                else replace(row, yes=False, memory=settle(leaf, after, row.memory))
                for leaf, row in rows
            )
        )
        state = self._plan(spent, after, earliest=after.t + 2 * tolerance(after.t))
        if self.level(state, after) < 0:
            return state
        rows = zip(self.leaves, self.kinds, state.standings, strict=True)
        return WatchState(
            tuple(
                replace(row, silent=kind == "guard" and _level(leaf, kind, row, after, after.t) >= 0)
                for leaf, kind, row in rows
            )
        )

    def silenced(self, state: WatchState) -> WatchState:
        """Return the state in which no guard speaks until policies are asked again, at the next monitoring time."""
        rows = zip(self.kinds, state.standings, strict=True)
        return WatchState(tuple(replace(row, silent=True) if kind == "guard" else row for kind, row in rows))

    def _remember(self, state: WatchState, ctx: TriggerContext, fired: bool) -> WatchState:
        rows = zip(self.leaves, state.standings, strict=True)
        return WatchState(
            tuple(
                row
                if type(leaf).update is Trigger.update
                else replace(row, memory=remember(leaf, ctx, row.memory, fired))
                for leaf, row in rows
            )
        )

    def _plan(self, state: WatchState, ctx: TriggerContext, earliest: float) -> WatchState:
        rows = zip(self.leaves, self.kinds, state.standings, strict=True)
        return WatchState(
            tuple(
                replace(row, due=ask_time(leaf, replace(ctx, state=row.memory), earliest))
                if kind == "next_time"
                else row
                for leaf, kind, row in rows
            )
        )


def _leaves(policy: Trigger) -> Iterator[Trigger]:
    if isinstance(policy, Combined):
        for part in policy.parts:
            yield from _leaves(part)
    else:
        yield policy


def _level(leaf: Trigger, kind: str, row: Standing, ctx: TriggerContext, t: float) -> float:
    """Return one elementary policy's level at `ctx`, with named times judged at `t`."""
    if kind == "guard":
        if row.silent:
            return -np.inf
        return ask_level(leaf, ctx if row.memory is None else replace(ctx, state=row.memory))
    agrees = row.yes if kind == "fires" else t >= row.due - tolerance(t)
    return np.inf if agrees else -np.inf


def _combine(policy: Trigger, levels: Iterator[float]) -> float:
    if not isinstance(policy, Combined):
        return next(levels)
    values = [_combine(part, levels) for part in policy.parts]
    return min(values) if isinstance(policy, And) else max(values)
