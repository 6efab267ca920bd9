"""Policies for limited resources: token bucket, duty cycle, and a hard budget over a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import positive, whole
from ctmhe.triggers.compose import And, Or
from ctmhe.triggers.timing import tolerance
from ctmhe.types import finite_time


@dataclass(frozen=True, repr=False)
class TokenBucket(Trigger):
    """At most burst + rate s samples in any s seconds: `policy & TokenBucket(5, 3)`.

    Every sample takes a token. Tokens grow at `rate` up to `burst`, the bucket is full at the start, and the level is
    tokens(t) - 1. A sample held back for want of a token is taken at the very moment when the token is there. Samples
    of policies joined by `|` take tokens as well, even into debt. Turner, New directions in communications (or which
    way to the information age?), IEEE Communications Magazine 24 (1986), no. 10, 8-15.

    Parameters
    ----------
    rate : float
        Tokens a second, > 0.
    burst : float
        Capacity of the bucket, >= 1.
    """

    rate: float
    burst: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "rate", positive(self.rate, "TokenBucket: rate"))
        object.__setattr__(self, "burst", positive(self.burst, "TokenBucket: burst"))
        if self.burst < 1:
            raise InputError(f"TokenBucket: burst must be >= 1, or no token ever fits in; got {self.burst:g}")

    def guard(self, ctx: TriggerContext) -> float:
        """Return the number of tokens above one, as if the bucket had no rim: a level that stops at 0 has no root."""
        return self._grown(ctx) - 1.0

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Keep when a token was last taken and how many were left; None as long as the bucket is full."""
        return (ctx.t, min(self.burst, self._grown(ctx)) - 1.0) if fired else ctx.state

    def _grown(self, ctx: TriggerContext) -> float:
        if ctx.state is None:
            return self.burst
        since, left = ctx.state
        return left + self.rate * (ctx.t - since)


@dataclass(frozen=True, repr=False)
class DutyCycle(Trigger):
    """A gate that opens for `on` seconds in every `period`: yes for (t - start) mod period < on, not before `start`.

    Used as `policy & DutyCycle(1.0, 0.2)`, for a radio that sleeps. What is due meanwhile is sampled when the gate
    opens. Both the open and the closed time should be longer than the monitoring step, or they may be overlooked.

    Parameters
    ----------
    period : float
        Seconds, > 0.
    on : float
        Seconds of each period in which samples are allowed; 0 < on <= period.
    start : float
        When the gate opens for the first time, in seconds.
    """

    period: float
    on: float
    start: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", positive(self.period, "DutyCycle: period"))
        object.__setattr__(self, "on", positive(self.on, "DutyCycle: on"))
        object.__setattr__(self, "start", finite_time(self.start, "DutyCycle: start"))
        if self.on > self.period:
            raise InputError(f"DutyCycle: on must not exceed the period of {self.period:g} s, got {self.on:g}")

    def guard(self, ctx: TriggerContext) -> float:
        """Return +inf while the gate is open, -inf while it is closed."""
        slack = tolerance(ctx.t)
        since = ctx.t - self.start + slack
        opened = since >= 0 and (self.on == self.period or since % self.period < self.on)
        return np.inf if opened else -np.inf


class Budget(Or):
    """Never more than `samples` samples, and for finite `freedom` all of them by `until`, spread sensibly.

    With n samples and W seconds left, g = W / n is the even gap. The policy may sample from g / freedom seconds after
    the last sample on, so that nothing is burnt at the start; a sample is taken anyway at g freedom seconds, or earlier
    where that would leave the n - 1 others less than g / freedom each: at g min(freedom, n - (n - 1) / freedom). The
    first sample may come at once. freedom = 1 is even sampling, freedom = inf the hard cap alone.

    All samples of the run count, those of policies joined by `|` too. The rule is ours.

    Parameters
    ----------
    policy : Trigger
    samples : int
        >= 1.
    until : float
        End of the time to spread over, in seconds: the time of the last sample, at the latest.
    start : float
        Its beginning; no sample is taken earlier.
    freedom : float
        >= 1; with inf, `until` does not matter. A large one under a policy that never asks leaves the last gaps tiny:
        with 35 samples in 4 s and 5 less than a nanosecond, which is one instant, so that a sample is missing.
    """

    def __init__(self, policy: Trigger, samples: int, until: float, *, start: float = 0.0, freedom: float = 2.0):
        if not isinstance(policy, Trigger):
            raise InputError(f"Budget: {policy!r} is not a Trigger; decorate a function with @trigger, call a class")
        self.policy = policy
        self.samples = whole(samples, "Budget: samples", least=1)
        self.until, self.start = finite_time(until, "Budget: until"), finite_time(start, "Budget: start")
        self.freedom = positive(freedom, "Budget: freedom", infinite=True)
        if not self.start < self.until:
            raise InputError(f"Budget: start must lie before until, got {self.start:g} and {self.until:g}")
        if self.freedom < 1:
            raise InputError(f"Budget: freedom must be >= 1 (1: even gaps, inf: a cap alone), got {freedom!r}")
        bounds = (self.samples, self.until, self.start, self.freedom)
        parts = [And(policy, Allowed(*bounds))]
        super().__init__(*parts, *([Spent(*bounds)] if np.isfinite(self.freedom) else []))

    @property
    def longest_wait(self) -> float:
        """The longest wait until `until`, in seconds: where all earlier samples came as early as they may."""
        if not np.isfinite(self.freedom):
            return self.policy.longest_wait
        left = self.until - self.start
        longest = latest_gap(left, self.samples, self.freedom)
        for n in range(self.samples - 1, 0, -1):  # the first sample at the start, then each at g / freedom
            longest = max(longest, latest_gap(left, n, self.freedom))
            left -= left / n / self.freedom
        return longest

    def __repr__(self) -> str:
        more = f", start={self.start!r}" if self.start else ""
        more += f", freedom={self.freedom!r}" if self.freedom != 2.0 else ""
        return f"Budget({self.policy!r}, {self.samples}, until={self.until!r}{more})"


def latest_gap(left: float, n: int, freedom: float) -> float:
    """Return the seconds after which a sample is due with `n` samples and `left` seconds to go."""
    return left / n * min(freedom, n - (n - 1) / freedom)


@dataclass(frozen=True, repr=False)
class Share(Trigger):
    """What `Budget` hands to its two gates."""

    samples: int
    until: float
    start: float
    freedom: float

    def remaining(self, ctx: TriggerContext) -> tuple[float, float, int]:
        """Return the time from which gaps count, the seconds left from there and the samples left."""
        since = max(ctx.t, self.start)
        return since, self.until - since, self.samples - ctx.samples


@dataclass(frozen=True, repr=False)
class Allowed(Share):
    """From when on the policy of a `Budget` may sample."""

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the end of the shortest gap, inf when nothing is left."""
        since, left, n = self.remaining(ctx)
        if n <= 0:
            return np.inf
        if ctx.samples == 0:
            return since
        return max(since + left / n / self.freedom, ctx.t + 4 * tolerance(ctx.t))


@dataclass(frozen=True, repr=False)
class Spent(Share):
    """When a `Budget` samples whatever its policy says."""

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the end of the longest gap, inf when nothing is left."""
        since, left, n = self.remaining(ctx)
        if n <= 0 or left <= 4 * tolerance(since):
            return np.inf
        return self.until if n == 1 else min(since + latest_gap(left, n, self.freedom), self.until)
