"""From a certificate to numbers about one estimator's error: (3.20) window by window, Theorem 3.1 over a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from itertools import product
from typing import Any

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.types import Array, ErrorBound


@dataclass(frozen=True, eq=False)
class Guarantee:
    """What an estimator needs beside its data to say how wrong it can be: `MHE(guarantee=)`.

    Parameters
    ----------
    certificate : DetectabilityCertificate
    disturbance : scalar, array (nw,) or mapping name -> value
        Largest |w_i| that there can be, in the units of the model: process disturbances, measurement noise, and what is
        added to it by holding records between their times (about the output's slope times the time between records)
        and by rounding them (half a quantum).
    error : scalar, array (nx,) or mapping name -> value, optional
        Largest initial error |chi_hat_i - chi_i|; what the certificate's domain leaves when left out.
    """

    certificate: DetectabilityCertificate
    disturbance: Any
    error: Any = None


@dataclass(frozen=True)
class Track:
    """What a bound at a later time needs of the past: an immutable value, part of an estimator's state.

    The estimated trajectory (3.16) has U <= eta^-(t_k - t) levels[k] on (t_(k-1), t_k], with t_k = ends[k].

    Attributes
    ----------
    start : float
        t0 in seconds.
    initial : float
        Bound of |chi_hat - chi|^2_P_upper.
    ends, levels : tuple of float
        Instants of the solves within the last horizon.
    wait : float
        Longest wait since `since`, seconds.
    since, base : float
        From when on everything that Theorem 3.1 asks for was met, and a bound of U over the horizon before.
    period : float
        Seconds between solves while they are equidistant and windows start at them, 0 before the second, NaN when not.
    key : str
        Of the bounds that the levels belong to.
    """

    start: float
    initial: float
    ends: tuple[float, ...] = ()
    levels: tuple[float, ...] = ()
    wait: float = 0.0
    since: float = -np.inf
    base: float = np.inf
    period: float = 0.0
    key: str = ""


@dataclass(frozen=True)
class WindowStart:
    """What is known of a window whose prior is not the filtering prior: thesis 4.2.

    Attributes
    ----------
    prior : float
        Bound of |x_bar - x|^2_P_upper at the window's start.
    theorem : float or None
        Bound of U at the window's end by a theorem of its own.
    reasons : tuple of str
        Why there is none.
    factor : float
        On the cost: 1 / eta where the newest output is counted in it.
    """

    prior: float
    theorem: float | None
    reasons: tuple[str, ...] = ()
    factor: float = 1.0


@dataclass(frozen=True, eq=False)
class WindowBounds:
    """The bounds along a run of one estimator.

    With V a bound of U at the window's start (of |chi_hat - chi|^2_P_upper while it starts at t0, else times
    lambda_max(P_upper, P_lower)), W = integral of eta^(t_i - tau) |w|^2_Q and J the cost that was found, with the
    weights 2 P_upper, 2 Q, R::

        U(t_i) <= 2 eta^T V + 2 W + J                  (3.25), for every trajectory of the model, optimal or not
        J <= 2 eta^T V + 2 W                           (3.26), for an optimal one; both together are (3.20)

    Parameters
    ----------
    certificate : DetectabilityCertificate
        With the weights of the cost.
    horizon : float
        Seconds.
    supply : float
        Bound of |w|^2_Q.
    cap : float
        Bound of U between any two states of the domain; infinite where that is unbounded.
    slack : float
        Seconds within which times are equal.
    stated : tuple of float
        How wrong the initial estimate is stated to be: of influence on the key alone.
    """

    certificate: DetectabilityCertificate
    horizon: float
    supply: float
    cap: float = np.inf
    slack: float = 1e-9
    stated: tuple[float, ...] = ()

    @property
    def unit(self) -> float:
        """Seconds per unit of time in which eta counts."""
        return self.certificate.step or 1.0

    @cached_property
    def limit(self) -> float:
        """Seconds that the wait for a sample must stay below (3.29)."""
        return self.certificate.longest_wait(self.horizon / self.unit) * self.unit

    @cached_property
    def key(self) -> str:
        """Text that tells these bounds from others."""
        c = self.certificate
        numbers = np.concatenate([part.ravel() for part in (c.P_lower, c.P_upper, c.Q, c.R)])
        others = np.array([c.eta, self.unit, self.horizon, self.supply, self.cap, *self.stated])
        return sha256(np.concatenate([numbers, others]).tobytes()).hexdigest()[:16]

    def near(self, t: float) -> float:
        """Return the seconds within which times at `t` are equal."""
        return max(self.slack, 8 * float(np.spacing(abs(t))))

    def fade(self, seconds: float, eta: float | None = None) -> float:
        """Return eta^seconds in the certificate's units."""
        return float((self.certificate.eta if eta is None else eta) ** (seconds / self.unit))

    def energy(self, seconds: float, eta: float | None = None) -> float:
        """Return the most that disturbances can make of the discounted integral (sum) over so many seconds."""
        eta = self.certificate.eta if eta is None else eta
        rate = 1 - eta if self.certificate.step else -np.log(eta)
        return float(self.supply * (1 - self.fade(seconds, eta)) / rate)

    def at(self, track: Track, t: float) -> float:
        """Return the bound of U(x_hat(t), x(t)) along the estimated trajectory (3.16) within the last horizon."""
        if t <= track.start + self.near(t):
            return track.initial
        for end, level in zip(track.ends, track.levels, strict=True):
            if t <= end + self.near(t):
                if level == np.inf:  # the estimate was none within the domain
                    return level
                fade = self.fade(max(end - t, 0.0))
                return min(level / fade, self.cap) if fade > 0 else self.cap
        return self.cap

    def resumed(self, track: Track, t: float, *, since: float) -> Track:
        """Return the track when what was done from `since` to the last solve at `t` rests on something else by now.

        Pieces of the trajectory that end there are bounded by the domain only, and Theorem 3.1 starts anew.
        """
        near = self.near(t)
        levels = tuple(
            max(self.cap, level) if end >= since - near else level
            for end, level in zip(track.ends, track.levels, strict=True)
        )
        base = max(self.cap, *levels) if levels else self.cap
        return replace(track, levels=levels, since=t, base=base, wait=0.0, period=np.nan, key=self.key)

    def before(self, track: Track, start: float) -> float:
        """Return V for a window that starts at `start`."""
        if start <= track.start + self.near(start):
            return min(track.initial, self.cap)
        found = self.at(track, start)
        return found if found == np.inf else min(self.certificate.ratio * found, self.cap)

    def after(
        self,
        track: Track,
        start: float,
        t: float,
        cost: float,
        problems: Sequence[str] = (),
        given: WindowStart | None = None,
        *,
        astray: bool = False,
    ) -> tuple[Track, ErrorBound]:
        """Return the track and the bound after a solve at `t` of the window from `start`.

        `problems` say why the window is not what the theory is about; U is then bounded by the domain only. `given` is
        what is known of its prior, if that is not the filtering prior: Theorem 3.1 then says nothing. With problems,
        the estimate may be `astray`: outside the domain, whose width is then no bound of its error.
        """
        ends, levels, near = track.ends, track.levels, self.near(t)
        if ends and t <= ends[-1] + near:  # a solve repeated takes its own place
            ends, levels = ends[:-1], levels[:-1]
            track = replace(track, ends=ends, levels=levels)
        gap = t - (ends[-1] if ends else track.start)
        period = gap if track.period <= near else track.period
        equal = gap <= near or abs(gap - period) <= near
        equal &= start <= track.start + near or any(abs(end - start) <= near for end in ends)
        past = replace(track, wait=max(track.wait, gap), period=period if equal else np.nan)
        before = self.before(track, start) if given is None else min(given.prior, self.cap)
        most = 2 * (self.fade(t - start) * before + self.energy(t - start))
        level = np.inf if astray else self.cap
        if not problems:
            level = min(most + cost * (given.factor if given else 1.0), self.cap)
        kept = [k for k, end in enumerate(ends) if end > t - self.horizon - near]
        past = replace(past, ends=(*(ends[k] for k in kept), t), levels=(*(levels[k] for k in kept), level))
        reasons = tuple(problems) or (self._unmet(past, cost, most) if given is None else given.reasons)
        theorem = None
        if given is not None:
            theorem = None if reasons else given.theorem
        elif reasons:
            past = replace(past, since=t, base=self._worst(past), wait=0.0)
        else:
            theorem = self._theorem(past, t)
            if not np.isfinite(theorem):
                theorem, reasons = (
                    None,
                    ("nothing bounds the error to start from: give Guarantee(error=), or a bounded domain",),
                )
                if np.isfinite(past.since):  # it starts anew where something does
                    past = replace(past, since=t, base=self._worst(past), wait=0.0)
        known = not problems and np.isfinite(level)
        metric = self.certificate.P_lower
        return past, ErrorBound(level if known else None, theorem, reasons, metric, self.cap)

    def _unmet(self, track: Track, cost: float, most: float) -> tuple[str, ...]:
        """Return why Theorem 3.1 says nothing at this solve."""
        limit = self.limit
        if limit <= 0:
            return (f"the horizon of {self.horizon:g} s must exceed {self.horizon - limit:.4g} s (3.30)",)
        if not self._aligned(track) and (track.wait >= limit or self._rho(track) >= 1):
            return (f"it waited {track.wait:.4g} s, and (3.29) allows less than {limit:.4g} s",)
        if cost > most * (1 + 1e-6) + 1e-12:
            return (
                f"its cost of {cost:.4g} exceeds the {most:.4g} that the truth can cost: the solver found a worse "
                "solution, disturbances or the initial error are larger than stated, or bounds exclude the truth",
            )
        return ()

    def _aligned(self, track: Track) -> bool:
        """Return whether all windows start at solves, the horizon being a multiple of equal gaps (Remark 3.7)."""
        if not track.period > self.slack:
            return track.period <= self.slack
        count = self.horizon / track.period
        return abs(count - round(count)) * track.period <= self.slack

    def _rho(self, track: Track) -> float:
        wait = 0.0 if self._aligned(track) else track.wait
        return self.certificate.contraction(self.horizon / self.unit, wait=wait / self.unit)

    def _worst(self, track: Track) -> float:
        """Return a bound of U over the last horizon."""
        last = track.ends[-1]
        levels = [self.at(track, end) for end in track.ends]
        begins = (max(track.start, last - self.horizon), *track.ends[:-1])
        starts = [self.at(track, begin + 2 * self.near(begin)) for begin in begins]
        early = [track.initial] if last - track.start <= self.horizon else []
        worst = max(*levels, *starts, *early)
        return worst if np.inf in track.levels else min(worst, self.cap)

    def _theorem(self, track: Track, t: float) -> float:
        """Return the right side of (3.32).

        After an instant s at which it did not hold, its proof goes back from window to window as before, and ends with
        the first that starts at or before s: U there is at most `base`, or the window is the growing one of (3.28).
        """
        rho, factor = self._rho(track), 4 if self._aligned(track) else 8
        elapsed, most = t - track.start, min(track.initial, self.cap)
        found = 4 * self.fade(elapsed, rho) * most if track.since < track.start + self.horizon else 0.0
        if np.isfinite(track.since):
            found = max(found, self.fade(t - track.since, rho) * track.base)
        return found + factor * self.energy(elapsed, rho)


def largest_square(matrix: Array, sizes: Array) -> float:
    """Return the largest v' M v over |v_i| <= sizes_i; from 13 entries on a bound of it, the sum of absolute values."""
    used = np.flatnonzero(np.abs(matrix).any(axis=1))
    matrix, sizes = matrix[np.ix_(used, used)], np.asarray(sizes, dtype=float)[used]
    if not len(used):
        return 0.0
    if not np.isfinite(sizes).all():
        return float("inf")
    if len(used) > 12 or not (matrix - np.diag(np.diagonal(matrix))).any():
        return float(sizes @ np.abs(matrix) @ sizes)
    signs = np.array([(1, *rest) for rest in product((1, -1), repeat=len(used) - 1)])
    return float(np.einsum("ki,ij,kj->k", signs * sizes, matrix, signs * sizes).max())
