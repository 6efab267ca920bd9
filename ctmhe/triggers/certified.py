"""Policies that keep what a certificate guarantees: never wait too long, or as long as a bound allows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import positive
from ctmhe.triggers.compose import MaxInterval, Or

if TYPE_CHECKING:
    from ctmhe.certificates.certificate import DetectabilityCertificate
    from ctmhe.certificates.growth import Growth

CONDITIONS = (
    "the whole signal reaches the estimator, without loss and in time (WholeSignal, Everything)",
    "the prior is the estimated trajectory at the window's start (3.18)",
    "the cost has the certificate's weights 2 P_upper, 2 Q, R and its eta, or others by Remark 3.4",
    "every solve is at least as good as the truth",
    "true and estimated states, and disturbances, stay inside the certificate's domain",
)
"""What Theorem 3.1 needs beside short waits."""


class Certified(Or):
    """A policy that never waits longer than Theorem 3.1 allows with this horizon: policy or a longest wait (3.29).

    The wait is all that a trigger can see to; `conditions` lists what else the theorem needs. An estimator with a
    `Guarantee` checks it solve by solve, and `Run.uncertified` tells where something was missing.

    Parameters
    ----------
    policy : Trigger
    certificate : DetectabilityCertificate
        For the estimator's weights (`for_weights`, where they are one's own).
    horizon : float
        Of the estimator, seconds.
    wait : float, optional
        A shorter longest wait in seconds; the shorter, the faster the guaranteed decay `rho`. Nine tenths of what
        (3.29) allows when left out, in whole steps of a discrete model.

    Raises
    ------
    InputError
        When the horizon is too short for any wait, or `wait` is too long for it.
    """

    def __init__(
        self, policy: Trigger, certificate: DetectabilityCertificate, horizon: float, *, wait: float | None = None
    ):
        unit = certificate.step or 1.0
        self.horizon = positive(horizon, "Certified: horizon")
        self.limit = certificate.longest_wait(self.horizon / unit) * unit
        if self.limit <= 0:
            raise InputError(
                f"Certified: a horizon of {self.horizon:g} s guarantees nothing: it must exceed "
                f"{certificate.shortest_horizon() * unit:.4g} s, and the longest wait on top of it (3.30)"
            )
        if wait is None:
            wait = 0.9 * self.limit
            if certificate.step is not None:
                wait = np.floor(wait / certificate.step) * certificate.step
                if not wait:
                    raise InputError(
                        f"Certified: with a horizon of {self.horizon:g} s not even a wait of one step is short enough; "
                        f"lengthen it, or solve at every step without this policy (Remark 3.7)"
                    )
        self.wait = positive(wait, "Certified: wait")
        if self.wait >= self.limit:
            raise InputError(
                f"Certified: with a horizon of {self.horizon:g} s the wait must stay below {self.limit:.4g} s (3.29), "
                f"got {self.wait:g} s"
            )
        self.policy, self.certificate = policy, certificate
        super().__init__(policy, MaxInterval(self.wait))

    @property
    def rho(self) -> float:
        """The decay per second (per step in discrete time) that is guaranteed with the declared wait (3.31)."""
        unit = self.certificate.step or 1.0
        return self.certificate.contraction(self.horizon / unit, wait=self.wait / unit)

    @property
    def conditions(self) -> tuple[str, ...]:
        """What Theorem 3.1 needs, in words, the wait first."""
        return (f"waits stay below {self.limit:.4g} s (3.29): seen to, at most {self.wait:.4g} s", *CONDITIONS)

    def __repr__(self) -> str:
        return f"Certified({self.policy!r}, horizon={self.horizon:g}, wait={self.wait:.4g})"


@dataclass(frozen=True, repr=False)
class BoundSelfTriggered(Trigger):
    """Sample as late as the guaranteed bound allows: before the prediction can be wrong by `size`.

    Proof. Let b bound |x_hat(t_i) - x(t_i)|_P_upper after the sample at t_i: by (3.20), (3.25) U <= level there, and
    |e|^2_P_upper <= ratio |e|^2_P_lower <= ratio level, so that b = sqrt(ratio level). The prediction from there on
    has no disturbance, so its error r in this norm obeys dr/dt <= rate r + push (`predict_growth`), whatever the
    plant does inside the domain. The comparison lemma gives r(t_i + s) <= `growth.ahead(b, s)`, which reaches `size`
    no earlier than at `growth.time_to(size, b)`: that is when the next sample is taken. Until then
    |x_online - x|_P_lower <= |x_online - x|_P_upper < size.

    It needs the prediction to stay inside the domain, as the plant does: the growth is that of the domain.

    Where the bound after a sample is not below `size`, or there is none, the next sample follows after `shortest`: the
    wanted level cannot be promised yet. `longest` keeps (3.29), as in `Certified`.

    Parameters
    ----------
    size : float
        Wanted error level in the certificate's norm, > 0.
    growth : Growth
        `predict_growth(model, guarantee)` for the estimator's guarantee.
    longest : float
        Longest wait in seconds.
    shortest : float
        Shortest wait in seconds.
    """

    size: float
    growth: Growth
    longest: float = field(kw_only=True)
    shortest: float = field(kw_only=True)

    def __post_init__(self) -> None:
        for name in ("size", "longest", "shortest"):
            object.__setattr__(self, name, positive(getattr(self, name), f"BoundSelfTriggered: {name}"))
        if self.shortest > self.longest:
            raise InputError(
                f"BoundSelfTriggered: shortest must not exceed longest of {self.longest:g} s, got {self.shortest!r}"
            )

    def next_time(self, ctx: TriggerContext) -> float:
        """Return when the prediction's bound reaches `size`."""
        if ctx.samples == 0:
            return ctx.t
        bound = ctx.estimate.bound if ctx.estimate is not None else None
        if ctx.estimate is not None and bound is None:
            raise InputError("BoundSelfTriggered: the estimator has no guarantee; build it with MHE(guarantee=...)")
        if bound is None or bound.size is None:
            return ctx.t + self.shortest
        wait = self.growth.time_to(self.size, np.sqrt(self.growth.ratio) * bound.size)
        return ctx.t + float(np.clip(wait, self.shortest, self.longest))

    @property
    def longest_wait(self) -> float:
        """The declared wait in seconds."""
        return self.longest
