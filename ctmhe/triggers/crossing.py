"""Sampling at levels: Lebesgue's way to look at a signal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import largest_excess, positive, watched
from ctmhe.types import Array, names_of


@dataclass(frozen=True, repr=False)
class LevelCrossing(Trigger):
    """Sample whenever an output crosses one of the levels, in either direction.

    An output below the level L crosses it where y >= L + hysteresis / 2, one above it where y <= L - hysteresis / 2.
    The side on which an output lies is remembered, and changes with a sample only: a crossing that another policy holds
    back (a dead time) is sent as soon as it may, if the output still is on the new side. The first context decides the
    side; no sample is taken for it, so join a `MaxInterval` or `Periodic`. Outputs without a value are passed over.

    Lebesgue sampling: Astrom, Bernhardsson, Comparison of Riemann and Lebesgue sampling for first order stochastic
    systems, 41st IEEE Conference on Decision and Control (2002), 2011-2016.

    Parameters
    ----------
    levels : float or sequence of float
        In the outputs' unit.
    outputs : names, optional
        The outputs that are watched; all when left out.
    hysteresis : float
        Distance between the crossings upward and downward, >= 0; more than the noise of y, or noise crosses for it.
    """

    levels: ArrayLike
    outputs: str | Sequence[str] | None = None
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        try:
            levels = tuple(float(level) for level in np.atleast_1d(np.asarray(self.levels, dtype=float)))
        except (TypeError, ValueError):
            raise InputError(f"LevelCrossing: levels must be numbers, got {self.levels!r}") from None
        if not levels or not np.isfinite(levels).all() or len(set(levels)) < len(levels):
            raise InputError(f"LevelCrossing: levels must be finite and differ, at least one, got {self.levels!r}")
        object.__setattr__(self, "levels", levels)
        object.__setattr__(self, "outputs", None if self.outputs is None else names_of(self.outputs))
        object.__setattr__(self, "hysteresis", positive(self.hysteresis, "LevelCrossing: hysteresis", zero=True))

    def guard(self, ctx: TriggerContext) -> float:
        """Return how far the output is beyond a level that it has not crossed yet, in output units."""
        if ctx.state is None:
            return -np.inf
        return largest_excess(*self._beyond(ctx, ctx.state))

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Keep the sides, (outputs, levels): -1 below, +1 above, 0 not known yet."""
        levels = np.asarray(self.levels)
        y = ctx.y[watched(ctx, self.outputs)][:, None]
        first = np.where(np.isnan(y), 0, np.where(y >= levels, 1, -1))
        if ctx.state is None:
            return first
        sides = np.where(ctx.state == 0, first, ctx.state)
        if not fired:
            return sides
        beyond, known = self._beyond(ctx, sides)
        # The sample may lie a rounding error before the level that it was taken for: that level counts as crossed.
        return np.where(known & (beyond >= -1e-12 - 1e-9 * np.abs(levels)), -sides, sides)

    def _beyond(self, ctx: TriggerContext, sides: np.ndarray) -> tuple[Array, np.ndarray]:
        y = ctx.y[watched(ctx, self.outputs)][:, None]
        beyond = -sides * (y - np.asarray(self.levels)) - self.hysteresis / 2
        return beyond, (sides != 0) & ~np.isnan(beyond)
