"""Policies of time alone whose gaps differ: jittered, random and growing."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import positive, whole
from ctmhe.triggers.timing import tolerance
from ctmhe.types import finite_time


@dataclass(frozen=True, repr=False)
class Jittered(Trigger):
    """Sample at start + k period + jitter U_k, k = 0, 1, ..., with U_k uniform on (-1/2, 1/2); none before `start`.

    Every U_k depends on the run's seed, `seed` and k only: nothing is remembered, and runs repeat. Sampling with jitter
    about a grid: Balakrishnan, On the problem of time jitter in sampling, IRE Trans. Inf. Theory 8 (1962), 226-236.

    Parameters
    ----------
    period : float
        Seconds, > 0.
    jitter : float
        Width in seconds of the interval about k period in which a sample falls; 0 <= jitter <= period.
    start : float
        Time about which the first sample lies. A run that begins later joins at the next one.
    seed : int
        Tells apart the lots of several policies of this kind in one run.
    """

    period: float
    jitter: float
    start: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", positive(self.period, "Jittered: period"))
        object.__setattr__(self, "jitter", positive(self.jitter, "Jittered: jitter", zero=True))
        object.__setattr__(self, "start", finite_time(self.start, "Jittered: start"))
        object.__setattr__(self, "seed", whole(self.seed, "Jittered: seed", least=0))
        if self.jitter > self.period:
            raise InputError(
                f"Jittered: jitter must not exceed the period of {self.period:g} s, or samples would change their "
                f"order; got {self.jitter:g}"
            )

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the first jittered instant after the last sample (at the start of the run: not before it)."""

        def instant(k: int) -> float:
            u = ctx.lots(crc32(b"Jittered"), self.seed, k).random() - 0.5
            return max(self.start, self.start + k * self.period + self.jitter * u)

        k = max(0, int((ctx.t - self.start) / self.period) - 2)
        return first_after(instant, ctx, k, k + 6)

    @property
    def longest_wait(self) -> float:
        """The period and the jitter, in seconds."""
        return self.period + self.jitter


@dataclass(frozen=True, repr=False)
class Poisson(Trigger):
    """Sample at the points of a Poisson process: gaps are independent with P(gap > s) = exp(-rate s).

    Such samples tell spectra of any width apart, without aliases (Shapiro, Silverman, Alias-free sampling of random
    noise, J. SIAM 8 (1960), 225-248). The gaps depend on the run's seed, `seed` and the number of samples; since the
    process has no memory, drawing anew after another policy's sample changes nothing.

    Parameters
    ----------
    rate : float
        Mean number of samples a second, > 0.
    seed : int
        Tells apart the lots of several policies of this kind in one run.
    """

    rate: float
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "rate", positive(self.rate, "Poisson: rate"))
        object.__setattr__(self, "seed", whole(self.seed, "Poisson: seed", least=0))

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the time after an exponential gap."""
        gap = ctx.lots(crc32(b"Poisson"), self.seed, ctx.samples).exponential(1 / self.rate)
        return ctx.t + max(gap, 4 * tolerance(ctx.t))


@dataclass(frozen=True, repr=False)
class LinearGaps(Trigger):
    """Sample at start + sum of gaps that grow linearly: the k-th gap is first + (last - first) (k - 1) / (count - 1).

    From gap number `count` on, gaps stay `last`. Dense first, when the guess is still wrong: thesis Fig. 3.2 has
    `LinearGaps(0.01, 0.19, 50)`, 50 samples up to count (first + last) / 2 = 5 s.

    Parameters
    ----------
    first, last : float
        First and last gap in seconds, > 0.
    count : int
        Number of gaps over which they change, >= 2.
    start : float
        Time from which the gaps are counted; the first sample is at start + first. A run that begins later joins.
    """

    first: float
    last: float
    count: int
    start: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "first", positive(self.first, "LinearGaps: first"))
        object.__setattr__(self, "last", positive(self.last, "LinearGaps: last"))
        object.__setattr__(self, "count", whole(self.count, "LinearGaps: count", least=2))
        object.__setattr__(self, "start", finite_time(self.start, "LinearGaps: start"))

    def instant(self, k: int) -> float:
        """Return the time of sample number k = 1, 2, ... in seconds, without accumulated rounding."""
        first, last, n = self.first, self.last, min(k, self.count)
        gap = last if n == self.count else first + (last - first) * (n - 1) / (self.count - 1)
        return self.start + n * (first + gap) / 2 + (k - n) * last

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the first instant after the last sample (at the start of the run: not before it)."""
        most = int(max(ctx.t - self.start, 0.0) / min(self.first, self.last))
        return first_after(self.instant, ctx, 1, most + 4)

    @property
    def longest_wait(self) -> float:
        """The larger of the first and last gap, in seconds."""
        return max(self.first, self.last)


@dataclass(frozen=True, repr=False)
class GeometricGaps(Trigger):
    """Sample at start + sum of gaps that grow by a factor: the k-th gap is min(first ratio^(k - 1), longest).

    Dense first, as long as an exponentially decaying error is large; the gaps then settle at `longest`.

    Parameters
    ----------
    first : float
        First gap in seconds, > 0.
    ratio : float
        Growth from gap to gap, >= 1 (a smaller one would crowd all samples before some instant).
    longest : float
        Largest gap in seconds, >= first; inf lets them grow without end.
    start : float
        Time from which the gaps are counted; the first sample is at start + first. A run that begins later joins.
    """

    first: float
    ratio: float
    longest: float = np.inf
    start: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "first", positive(self.first, "GeometricGaps: first"))
        object.__setattr__(self, "ratio", positive(self.ratio, "GeometricGaps: ratio"))
        object.__setattr__(self, "longest", positive(self.longest, "GeometricGaps: longest", infinite=True))
        object.__setattr__(self, "start", finite_time(self.start, "GeometricGaps: start"))
        if self.ratio < 1:
            raise InputError(f"GeometricGaps: ratio must be >= 1, or gaps shrink to nothing; got {self.ratio:g}")
        if self.longest < self.first:
            raise InputError(
                f"GeometricGaps: longest must not be below the first gap of {self.first:g} s, got {self.longest:g}"
            )

    def instant(self, k: int) -> float:
        """Return the time of sample number k = 1, 2, ... in seconds; inf where it is beyond all numbers."""
        growth = np.log(self.ratio)
        if growth == 0.0:
            return self.start + k * self.first
        growing = min(k, int(np.log(self.longest / self.first) / growth) + 1) if np.isfinite(self.longest) else k
        with np.errstate(over="ignore"):
            total = self.first * np.expm1(growing * growth) / (self.ratio - 1)
        return float(self.start + total + ((k - growing) * self.longest if k > growing else 0.0))

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the first instant after the last sample (at the start of the run: not before it)."""
        most = int(max(ctx.t - self.start, 0.0) / self.first)
        return first_after(self.instant, ctx, 1, most + 4)

    @property
    def longest_wait(self) -> float:
        """The largest gap in seconds; inf when gaps grow without end."""
        return self.first if self.ratio == 1 else self.longest


def first_after(instant: Callable[[int], float], ctx: TriggerContext, k: int, most: int) -> float:
    """Return the first of the instants k ... most after the last sample (none yet: not before `ctx.t`)."""
    after = ctx.t + (2 * tolerance(ctx.t) if ctx.samples else -tolerance(ctx.t))
    return max(instant(bisect_right(range(most), after, lo=k, key=instant)), ctx.t)
