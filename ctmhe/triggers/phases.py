"""One policy after the other: gates in time, and switching by phase."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.compose import And, Or
from ctmhe.types import finite_time


@dataclass(frozen=True, repr=False)
class During(Trigger):
    """A gate in time: yes for start <= t < stop, no otherwise. Used as `policy & During(0.0, 2.0)`.

    Parameters
    ----------
    start, stop : float
        Seconds, start < stop; -inf and inf are allowed.
    """

    start: float
    stop: float

    def __post_init__(self) -> None:
        for name, value in (("start", self.start), ("stop", self.stop)):
            infinite = isinstance(value, float) and np.isinf(value)
            object.__setattr__(self, name, float(value) if infinite else finite_time(value, f"During: {name}"))
        if not self.start < self.stop:
            raise InputError(f"During: start must lie before stop, got {self.start:g} and {self.stop:g}")

    def guard(self, ctx: TriggerContext) -> float:
        """Return +inf inside, -inf outside."""
        return np.inf if self.start <= ctx.t < self.stop else -np.inf


class Phases(Or):
    """Switch policies by time: `Phases((2.0, first), (5.0, second), last)` uses `first` before t = 2 s, and so on.

    What is due while a policy's phase has not begun is sampled when it begins. A policy that another one follows has no
    say from its end on, that instant included.

    Parameters
    ----------
    *phases : pairs (until, policy), then a policy
        Times in seconds, increasing.
    """

    def __init__(self, *phases: Any):
        if not phases or not isinstance(phases[-1], Trigger):
            raise InputError("Phases: expected pairs (until, policy) and a last policy without a time")
        self.phases = tuple(self._pair(phase) for phase in phases[:-1])
        self.last = phases[-1]
        edges = [-np.inf, *(until for until, _ in self.phases), np.inf]
        if (np.diff(edges[1:]) <= 0).any():
            raise InputError(f"Phases: times must increase, got {', '.join(f'{edge:g}' for edge in edges[1:-1])}")
        spans = zip(self._policies(), edges[:-1], edges[1:], strict=True)
        super().__init__(*(And(policy, During(start, stop)) for policy, start, stop in spans))

    @staticmethod
    def _pair(phase: Any) -> tuple[float, Trigger]:
        if not isinstance(phase, (tuple, list)) or len(phase) != 2 or not isinstance(phase[1], Trigger):
            raise InputError(f"Phases: expected a pair (until, policy), got {phase!r}")
        return finite_time(phase[0], "Phases: until"), phase[1]

    def _policies(self) -> Iterator[Trigger]:
        yield from (policy for _, policy in self.phases)
        yield self.last

    @property
    def longest_wait(self) -> float:
        """The longest that any of the policies declares, in seconds.

        Proof, for a last sample at s and policies i with waits L_i and phases [a_i, b_i): policy i is due at s + L_i at
        the latest, so phase i brings a sample by max(a_i, s + L_i) unless it ends first. Phases j ... k - 1 without one
        thus mean s + L_i >= b_i for each. Phase k then samples by s + L_k, or already at a_k = b_(k-1) <= s + L_(k-1).
        """
        return max(policy.longest_wait for policy in self._policies())

    def __repr__(self) -> str:
        return f"Phases({', '.join([*map(repr, self.phases), repr(self.last)])})"
