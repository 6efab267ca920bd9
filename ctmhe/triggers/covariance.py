"""Policies of uncertainty: sample when the predicted covariance has grown to a bound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import positive
from ctmhe.types import Array

MOST_UNKNOWN = 50
"""Samples in a row that leave the deviation infinite, after which it is taken to stay so."""

Combination = Mapping[str, float] | str | None


@dataclass(frozen=True, repr=False)
class CovarianceBound(Trigger):
    """Sample when the predicted deviation of a combination of states reaches `bound`: sqrt(c' P(t) c) >= bound.

    P(t) is `ctx.predicted_covariance`, that of the last estimate carried along the open loop, the prior's before the
    first sample. An infinite deviation asks for samples until it is finite; where 50 samples in a row do not help, the
    outputs do not determine the combination, and the policy says so instead of sampling for ever. A bound that a sample
    cannot reach brings one at every monitoring time.

    Trimpe, D'Andrea, Event-based state estimation with variance-based triggering, IEEE Trans. Autom. Control 59 (2014),
    3266-3281.

    Parameters
    ----------
    bound : float
        > 0, in the unit of the combination.
    combination : str or mapping name -> weight, optional
        c: one state or estimated parameter, or a weighted sum. Left out: the largest deviation of all, whatever the
        units.
    """

    bound: float
    combination: Combination = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "bound", positive(self.bound, "CovarianceBound: bound"))
        object.__setattr__(self, "combination", checked(self.combination, "CovarianceBound"))

    def init_state(self) -> Any:
        """Return the number of samples in a row that left the deviation infinite."""
        return 0

    def guard(self, ctx: TriggerContext) -> float:
        """Return how far the deviation is above the bound, in its unit."""
        return known_or_stop(deviation(ctx.predicted_covariance, self.combination, ctx), ctx) - self.bound

    def after_sample(self, ctx: TriggerContext) -> Any:
        """Count the samples that left the deviation infinite."""
        return ctx.state + 1 if np.isinf(deviation(ctx.predicted_covariance, self.combination, ctx)) else 0


@dataclass(frozen=True, repr=False)
class CovarianceSelfTriggered(Trigger):
    """The times of `CovarianceBound`, computed ahead: after every sample, when the predicted deviation reaches `bound`.

    Nobody has to look at the sensor in between. The growth is searched at doubling distances from `shortest` to
    `longest` and located to 1e-10 s, some 20 propagations a sample: a deviation that rises above the bound and falls
    again between two of them is not seen. Equal to `CovarianceBound` while the inputs stay what they were.

    Self-triggered sampling: Anta, Tabuada, To sample or not to sample: self-triggered control for nonlinear systems,
    IEEE Trans. Autom. Control 55 (2010), 2030-2042; here by the covariance instead of a Lyapunov function.

    Parameters
    ----------
    bound : float
        > 0, in the unit of the combination.
    combination : str or mapping name -> weight, optional
        One state or estimated parameter, or a weighted sum. Left out: the largest deviation of all.
    longest : float
        Longest wait in seconds, whatever the deviation.
    shortest : float
        Shortest wait in seconds, > 0; the wait where a sample leaves the deviation above the bound.
    """

    bound: float
    combination: Combination = None
    longest: float = field(kw_only=True)
    shortest: float = field(default=1e-3, kw_only=True)

    def __post_init__(self) -> None:
        what = "CovarianceSelfTriggered"
        for name in ("bound", "longest", "shortest"):
            object.__setattr__(self, name, positive(getattr(self, name), f"{what}: {name}"))
        object.__setattr__(self, "combination", checked(self.combination, what))
        if self.shortest > self.longest:
            raise InputError(f"{what}: shortest must not exceed longest, got {self.shortest:g} and {self.longest:g}")

    def init_state(self) -> Any:
        """Return the number of samples in a row that left the deviation infinite."""
        return 0

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the time at which the deviation reaches the bound, `longest` ahead at most."""
        from scipy.optimize import brentq

        outlook = ctx.forecast
        if outlook is None:
            raise InputError("this context carries no prediction")

        def above(wait: float) -> float:
            spread = deviation(outlook.covariance(ctx.t + wait), self.combination, ctx)
            return min(known_or_stop(spread, ctx) - self.bound, 1e12)

        if ctx.samples == 0 and above(0.0) >= 0:
            return ctx.t
        before, wait = 0.0 if ctx.samples == 0 else self.shortest, self.shortest
        while wait < self.longest and above(wait) < 0:
            before, wait = wait, min(2 * wait, self.longest)
        if wait > before and above(wait) >= 0 > above(before):
            wait = float(brentq(above, before, wait, xtol=1e-10))  # type: ignore[arg-type]
        return ctx.t + wait

    def after_sample(self, ctx: TriggerContext) -> Any:
        """Count the samples that left the deviation infinite."""
        return ctx.state + 1 if np.isinf(deviation(ctx.predicted_covariance, self.combination, ctx)) else 0

    @property
    def longest_wait(self) -> float:
        """The declared wait in seconds."""
        return self.longest


def checked(combination: Combination, policy: str) -> Combination:
    """Return a combination with finite weights, not all zero; None stands for the largest deviation."""
    if combination is None or isinstance(combination, str):
        return combination
    if not isinstance(combination, Mapping):
        raise InputError(f"{policy}: combination must be a name or a mapping name -> weight, got {combination!r}")
    try:
        weights = {str(name): float(weight) for name, weight in combination.items()}
    except (TypeError, ValueError):
        raise InputError(f"{policy}: weights of the combination must be numbers, got {dict(combination)!r}") from None
    if not any(weights.values()) or not np.isfinite(list(weights.values())).all():
        raise InputError(f"{policy}: weights of the combination must be finite and not all zero, got {weights!r}")
    return weights


def deviation(covariance: Array, combination: Combination, ctx: TriggerContext) -> float:
    """Return sqrt(c' P c), or the largest standard deviation; inf where a part is unknown."""
    if combination is None:
        return float(np.sqrt(max(np.max(np.diagonal(covariance)), 0.0)))
    names = (*ctx.states, *ctx.parameters)
    weights = {combination: 1.0} if isinstance(combination, str) else combination
    unknown = [name for name in weights if name not in names]
    if unknown:
        raise InputError(
            f"unknown state or estimated parameter {', '.join(map(repr, unknown))}. Known: {', '.join(names) or 'none'}"
        )
    used = [names.index(name) for name, weight in weights.items() if weight]
    part = covariance[np.ix_(used, used)]
    c = np.array([weight for weight in weights.values() if weight])
    if not np.isfinite(part).all():
        return np.inf
    return float(np.sqrt(max(c @ part @ c, 0.0)))


def known_or_stop(spread: float, ctx: TriggerContext) -> float:
    """Return the deviation, or raise when it is infinite after so many samples that it will stay so."""
    if np.isinf(spread) and isinstance(ctx.state, int) and ctx.state >= MOST_UNKNOWN:
        raise InputError(
            f"the predicted deviation is still infinite after {ctx.state} samples in a row: the outputs do not "
            "determine it. Choose another combination, or give the cost a prior weight P"
        )
    return spread
