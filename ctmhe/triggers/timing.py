"""Policies of time alone: periodic and scheduled sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import positive
from ctmhe.types import Array, finite_time

SAME = 1e-9
"""Seconds within which two instants count as one (more where rounding alone is larger)."""


def tolerance(t: float) -> float:
    """Return the distance in seconds within which an instant counts as `t`."""
    return max(SAME, 1e-14 * abs(t))


@dataclass(frozen=True, repr=False)
class Periodic(Trigger):
    """Sample at start + k * period, k = 0, 1, ...: t_i = start + i * period, without accumulated rounding.

    Parameters
    ----------
    period : float
        Seconds, > 0.
    start : float
        Time of the first sample in seconds. A run that begins later joins at the next multiple.
    """

    period: float
    start: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", positive(self.period, "Periodic: period"))
        object.__setattr__(self, "start", finite_time(self.start, "Periodic: start"))

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the first multiple after the last sample (at the start of the run: not before it)."""
        slack = 2 * tolerance(ctx.t) if ctx.samples else -tolerance(ctx.t)
        k = max(0, int(np.floor((ctx.t - self.start + slack) / self.period)) + 1)
        return max(self.start + k * self.period, ctx.t)

    @property
    def longest_wait(self) -> float:
        """The period in seconds."""
        return self.period


@dataclass(frozen=True, repr=False)
class Scheduled(Trigger):
    """Sample at given times, such as the instants of thesis Fig. 3.2; none after the last.

    Parameters
    ----------
    times : sequence of float
        Strictly increasing times in seconds. Those before the start of the run are skipped.
    """

    times: Sequence[float] | Array

    def __post_init__(self) -> None:
        try:
            times = tuple(float(t) for t in np.atleast_1d(np.asarray(self.times, dtype=float)))
        except (TypeError, ValueError):
            raise InputError(f"Scheduled: times must be numbers of seconds, got {self.times!r}") from None
        if not times or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError("Scheduled: times must be finite and strictly increasing, at least one")
        object.__setattr__(self, "times", times)

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the first time of the schedule after the last sample, inf when it is over."""
        slack = 2 * tolerance(ctx.t) if ctx.samples else -tolerance(ctx.t)
        k = int(np.searchsorted(np.asarray(self.times), ctx.t + slack, side="right"))
        return max(float(self.times[k]), ctx.t) if k < len(self.times) else np.inf

    @property
    def longest_wait(self) -> float:
        """The longest gap of the schedule in seconds; inf for a single time."""
        return float(np.max(np.diff(self.times))) if len(self.times) > 1 else np.inf

    def __repr__(self) -> str:
        return f"Scheduled({len(self.times)} times from {self.times[0]:g} to {self.times[-1]:g})"
