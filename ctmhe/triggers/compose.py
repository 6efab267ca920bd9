"""Policies made of policies: earliest of several, all of several, dead time and longest wait."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext


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
        texts = (f"({part!r})" if isinstance(part, Combined) else repr(part) for part in self.parts)
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


def positive(value: float, what: str) -> float:
    """Return `value` as a float, or raise when it is not a positive finite number."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what} must be a number, got {value!r}") from None
    if not (np.isfinite(number) and number > 0):
        raise InputError(f"{what} must be finite and positive, got {value!r}")
    return number
