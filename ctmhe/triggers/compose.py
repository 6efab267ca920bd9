"""Policies made of policies: earliest of several, all of several, dead time, longest wait, hysteresis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.answers import ask_level, initial_memory, kind_of, remember, settle
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import positive


class Combined(Trigger):
    """Several policies under one operator; they are asked one by one (see `Watch`)."""

    sign = "?"

    def __init__(self, *parts: Trigger):
        for part in parts:
            if not isinstance(part, Trigger):
                raise InputError(
                    f"{type(self).__name__}: {part!r} is not a Trigger; decorate a function with @trigger, call a class"
                )
        if not parts:
            raise InputError(f"{type(self).__name__} needs at least one policy")
        self.parts = parts

    @classmethod
    def of(cls, left: Trigger, right: Trigger) -> Trigger:
        """Join two policies, flattening what is joined by the same operator already."""
        sides = [side.parts if type(side) is cls else (side,) for side in (left, right)]
        return cls(*sides[0], *sides[1])

    def __repr__(self) -> str:
        texts = (f"({part!r})" if type(part) in (Or, And) else repr(part) for part in self.parts)
        return f" {self.sign} ".join(texts)


class Or(Combined):
    """Sample when the first of the policies says so: the largest of their levels, the earliest of their times."""

    sign = "|"

    @property
    def longest_wait(self) -> float:
        """The shortest that any of the policies declares, in seconds."""
        return min(part.longest_wait for part in self.parts)


class And(Combined):
    """Sample when all policies agree: the smallest of their levels, the latest of their times."""

    sign = "&"

    @property
    def longest_wait(self) -> float:
        """The longest that any of the policies declares, in seconds; inf when one of them declares none."""
        return max(part.longest_wait for part in self.parts)


@dataclass(frozen=True, repr=False)
class MinInterval(Trigger):
    """Dead time: no sample within `seconds` of the last, t_i - t_(i-1) >= seconds.

    Used as `policy & MinInterval(0.05)`. The first sample is not held back. When the dead time ends while the policy's
    guard is >= 0, the sample is taken at that very moment.

    Parameters
    ----------
    seconds : float
        Shortest time between samples, > 0. The remedy against Zeno behaviour of event-triggered sampling (Heemels,
        Johansson, Tabuada, CDC 2012, An introduction to event-triggered and self-triggered control, sec. III).
    """

    seconds: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "seconds", positive(self.seconds, "MinInterval: seconds"))

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the end of the dead time."""
        return ctx.t + self.seconds if ctx.samples else ctx.t

    @property
    def longest_wait(self) -> float:
        """The dead time itself: alone, the policy samples as soon as it is over."""
        return self.seconds


@dataclass(frozen=True, repr=False)
class MaxInterval(Trigger):
    """Longest wait: a sample `seconds` after the last one (or the start), t_i - t_(i-1) <= seconds, at the exact time.

    Used as `policy | MaxInterval(0.19)`; it bounds delta_bar of thesis (3.19).

    Parameters
    ----------
    seconds : float
        Longest time between samples, > 0.
    """

    seconds: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "seconds", positive(self.seconds, "MaxInterval: seconds"))

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the time when waiting ends."""
        return ctx.t + self.seconds

    @property
    def longest_wait(self) -> float:
        """The declared wait in seconds."""
        return self.seconds


@dataclass(frozen=True, repr=False)
class Hysteresis(Trigger):
    """A guard that speaks once: after a sample it is silent until its level has fallen to <= -release.

    Against a level that hovers about zero. Its fall is noticed right after the sample and at monitoring times. A sample
    of another policy silences it as well, until the level is as low.

    Parameters
    ----------
    policy : Trigger
        With a guard, not joined by `|` or `&`.
    release : float
        How far below zero the level must fall, >= 0, in the unit of the level.
    """

    policy: Trigger
    release: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "release", positive(self.release, "Hysteresis: release", zero=True))
        if isinstance(self.policy, Combined) or kind_of(self.policy) != "guard":
            raise InputError(
                f"Hysteresis: expected one policy with a guard, got {self.policy!r}; wrap the guards inside | and & "
                "one by one"
            )

    def init_state(self) -> Any:
        """Return the memory of the policy inside, and that it is armed."""
        return initial_memory(self.policy), True

    def guard(self, ctx: TriggerContext) -> float:
        """Return the level of the policy inside while it is armed."""
        return self._level(ctx) if ctx.state[1] else -np.inf

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Disarm at a sample; arm again when the level is low."""
        memory, armed = ctx.state
        armed = not fired and (armed or self._level(ctx) <= -self.release)
        return remember(self.policy, ctx, memory, fired), armed

    def after_sample(self, ctx: TriggerContext) -> Any:
        """Arm at once when the sample has brought the level down."""
        memory = settle(self.policy, ctx, ctx.state[0])
        return memory, self._level(replace(ctx, state=(memory, False))) <= -self.release

    def _level(self, ctx: TriggerContext) -> float:
        return ask_level(self.policy, replace(ctx, state=ctx.state[0]))
