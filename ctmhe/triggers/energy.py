"""The rule of event-triggered moving horizon estimation, in continuous time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import matrix_for, positive, weight_matrix
from ctmhe.types import Array


@dataclass(frozen=True, repr=False)
class InnovationEnergy(Trigger):
    """Sample when the discounted output error since the last sample reaches a share of the last cost.

    With t_i the last sample, J_i the cost of its estimate and y_hat the open-loop prediction from it::

        E(t) = integral over (t_i, t] of eta^(t - s) |y(s) - y_hat(s)|^2_R ds  >=  alpha J_i + floor

    E is what the open loop adds to the output part of the cost (3.13): as long as it is small against J_i, another
    solve has little to win. It is counted by the trapezoidal rule on monitoring times and the moment asked about. The
    first sample is taken at once. Outputs without a value (NaN) are passed over. Where the last solve gave no finite
    cost, only `floor` counts.

    The continuous-time form, which is ours, of the rule of Krauss, Schiller, Lopez, Mueller, Event-triggered moving
    horizon estimation for nonlinear systems, arXiv 2408.06208 (2024). `WholeSignal` is the channel that fits.

    Parameters
    ----------
    alpha : float
        Share of the last cost, >= 0.
    eta : float
        Discount per second, 0 < eta <= 1: that of the estimator's cost.
    R : float, array (ny,) of weights or matrix (ny, ny)
        Positive semidefinite: the output weight of the estimator's cost.
    floor : float
        >= 0, in units of the cost. Without it a perfect fit, J_i = 0, asks for the next sample at once.
    """

    alpha: float
    eta: float
    R: ArrayLike = 1.0
    floor: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "alpha", positive(self.alpha, "InnovationEnergy: alpha", zero=True))
        object.__setattr__(self, "eta", positive(self.eta, "InnovationEnergy: eta"))
        object.__setattr__(self, "floor", positive(self.floor, "InnovationEnergy: floor", zero=True))
        object.__setattr__(self, "R", weight_matrix(self.R, "InnovationEnergy: R", definite=False))
        if self.eta > 1:
            raise InputError(f"InnovationEnergy: eta must be <= 1, the discount per second, got {self.eta:g}")

    def guard(self, ctx: TriggerContext) -> float:
        """Return how far the energy is above its threshold, in units of the cost."""
        if ctx.samples == 0:
            return np.inf
        cost = np.nan if ctx.estimate is None else ctx.estimate.cost
        return self._energy(ctx)[1] - (self.alpha * cost if np.isfinite(cost) else 0.0) - self.floor

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Keep when it was counted, the energy so far, and its density then."""
        if fired or ctx.samples == 0:
            return ctx.state  # after_sample begins anew
        density, energy = self._energy(ctx)
        return ctx.t, energy, density

    def after_sample(self, ctx: TriggerContext) -> Any:
        """Begin anew from the new estimate."""
        return ctx.t, 0.0, self._density(ctx)

    def _energy(self, ctx: TriggerContext) -> tuple[float, float]:
        """Return the density at `ctx.t` and the energy up to it."""
        density = self._density(ctx)
        if ctx.state is None:
            return density, 0.0
        since, energy, before = ctx.state
        fade = self.eta ** (ctx.t - since)
        return density, fade * energy + (ctx.t - since) * (fade * before + density) / 2

    def _density(self, ctx: TriggerContext) -> float:
        known = ~np.isnan(ctx.y)
        if not known.any():
            return 0.0
        error: Array = (ctx.y - ctx.y_hat)[known]
        return float(error @ matrix_for(self.R, ctx, "R")[np.ix_(known, known)] @ error)
