"""Policies that compare an output with the values that were last sent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.checks import largest_excess, largest_move, positive, spread_over, thresholds, watched
from ctmhe.types import names_of


@dataclass(frozen=True, repr=False)
class SendOnDelta(Trigger):
    """Sample when an output has moved by `delta` since it was last sent: max_i (|y_i - y_i,last| - delta_i) >= 0.

    The first sample is taken at once, unless every `delta` is infinite. Outputs without a value (NaN) are passed over.
    Miskowicz, Send-on-delta concept: an event-based data reporting strategy, Sensors 6 (2006), 49-63.

    Parameters
    ----------
    delta : float, array (n,) or mapping name -> float
        Thresholds >= 0 in the outputs' units; a mapping names the outputs that are watched.
    outputs : names, optional
        The outputs that are watched, in the order of `delta`; all when left out.
    """

    delta: ArrayLike | Mapping[str, float]
    outputs: str | Sequence[str] | None = None

    def __post_init__(self) -> None:
        delta, outputs = thresholds(self.delta, self.outputs, "SendOnDelta: delta")
        object.__setattr__(self, "delta", delta)
        object.__setattr__(self, "outputs", outputs)

    def guard(self, ctx: TriggerContext) -> float:
        """Return the largest excess over the thresholds, in output units."""
        chosen = watched(ctx, self.outputs)
        y, y_last, delta = ctx.y[chosen], ctx.y_last[chosen], spread_over(self.delta, chosen, ctx)
        return largest_move(y, y_last, delta)


@dataclass(frozen=True, repr=False)
class Deadband(Trigger):
    """Sample when an output has moved by a share of what was sent: |y - y_last| >= max(floor, relative |y_last|).

    Weber's law: the larger the value, the larger the least difference that counts. The first sample is taken at once.
    Outputs without a value are passed over. Hinterseer, Hirche, Chaudhuri, Steinbach, Buss, Perception-based data
    reduction and transmission of haptic data in telepresence and teleaction systems, IEEE Trans. Signal Process. 56
    (2008), 588-597.

    Parameters
    ----------
    relative : float
        Share of the value last sent, >= 0.
    floor : float
        Smallest deadband, > 0, in the outputs' unit: without it a value near zero would be sent without end.
    outputs : names, optional
        The outputs that are watched; all when left out.
    """

    relative: float
    floor: float
    outputs: str | Sequence[str] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "relative", positive(self.relative, "Deadband: relative", zero=True))
        object.__setattr__(self, "floor", positive(self.floor, "Deadband: floor"))
        object.__setattr__(self, "outputs", None if self.outputs is None else names_of(self.outputs))

    def guard(self, ctx: TriggerContext) -> float:
        """Return the largest excess over the deadbands, in output units."""
        chosen = watched(ctx, self.outputs)
        y, y_last = ctx.y[chosen], ctx.y_last[chosen]
        excess = np.abs(y - y_last) - np.maximum(self.floor, self.relative * np.abs(y_last))
        return largest_excess(np.where(np.isnan(y_last), np.inf, excess), ~np.isnan(y))


@dataclass(frozen=True, repr=False)
class SendOnSlope(Trigger):
    """Sample when an output leaves the straight line through the last two values sent, by `delta`.

    With (t_0, y_0) and (t_1, y_1) sent last, |y - y_1 - (y_1 - y_0) (t - t_1) / (t_1 - t_0)| >= delta: the receiver can
    draw the same line. After a single sample the line is level, as in `SendOnDelta`; the first is taken at once. Noise
    of y tilts the line when two samples lie close together: join a `MinInterval`. Outputs without a value are passed
    over.

    Suh, Send-on-delta sensor data transmission with a linear predictor, Sensors 7 (2007), 537-547; here the predictor
    uses values that were sent anyway.

    Parameters
    ----------
    delta : float, array (n,) or mapping name -> float
        Thresholds >= 0 in the outputs' units; a mapping names the outputs that are watched.
    outputs : names, optional
        The outputs that are watched, in the order of `delta`; all when left out.
    """

    delta: ArrayLike | Mapping[str, float]
    outputs: str | Sequence[str] | None = None

    def __post_init__(self) -> None:
        delta, outputs = thresholds(self.delta, self.outputs, "SendOnSlope: delta")
        object.__setattr__(self, "delta", delta)
        object.__setattr__(self, "outputs", outputs)

    def guard(self, ctx: TriggerContext) -> float:
        """Return the largest distance from the line beyond the thresholds, in output units."""
        chosen = watched(ctx, self.outputs)
        y, line, delta = ctx.y[chosen], ctx.y_last[chosen], spread_over(self.delta, chosen, ctx)
        if ctx.state is not None:
            times, values, slopes = (row[chosen] for row in ctx.state)
            line = np.where(np.isnan(times), line, values + slopes * (ctx.t - times))
        return largest_move(y, line, delta)

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Keep for every output when it was last sent, the value, and the slope from the one before."""
        if not fired:
            return ctx.state
        times, values, slopes = np.full((3, ctx.y.size), np.nan) if ctx.state is None else ctx.state
        sent = ~np.isnan(ctx.y)
        known = sent & (ctx.t > np.where(np.isnan(times), np.inf, times))
        slope = np.divide(ctx.y - values, ctx.t - times, out=np.zeros(ctx.y.size), where=known)
        return np.where(sent, ctx.t, times), np.where(sent, ctx.y, values), np.where(sent, slope, slopes)


@dataclass(frozen=True, repr=False)
class SendOnArea(Trigger):
    """Sample when the deviation since the last sample, integrated over time, reaches `area`.

    The integral of |y_i - y_i,last| dt over (t_last, t] >= area_i for one of the outputs, by the trapezoidal rule on
    monitoring times and the moment asked about. A small deviation that stays is sent too, which send-on-delta never
    does. The first sample is taken at once, unless every `area` is infinite. Time without a value (NaN) does not count.

    Miskowicz, Asymptotic effectiveness of the event-based sampling according to the integral criterion, Sensors 7
    (2007), 16-37.

    Parameters
    ----------
    area : float, array (n,) or mapping name -> float
        Thresholds >= 0 in the outputs' units times seconds; a mapping names the outputs that are watched.
    outputs : names, optional
        The outputs that are watched, in the order of `area`; all when left out.
    """

    area: ArrayLike | Mapping[str, float]
    outputs: str | Sequence[str] | None = None

    def __post_init__(self) -> None:
        area, outputs = thresholds(self.area, self.outputs, "SendOnArea: area")
        object.__setattr__(self, "area", area)
        object.__setattr__(self, "outputs", outputs)

    def guard(self, ctx: TriggerContext) -> float:
        """Return the largest excess of an integral over its threshold, in output units times seconds."""
        chosen = watched(ctx, self.outputs)
        limit = spread_over(self.area, chosen, ctx)
        so_far = np.where(np.isnan(ctx.y_last), np.inf, self._areas(ctx))[chosen]
        counted = ~np.isnan(ctx.y[chosen]) & np.isfinite(limit)
        return largest_excess(so_far - np.where(counted, limit, 0.0), counted)

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Keep when it was counted, the deviations then, and the integrals so far; what is sent begins anew."""
        deviation, areas = np.abs(ctx.y - ctx.y_last), self._areas(ctx)
        if fired:
            sent = ~np.isnan(ctx.y)
            deviation, areas = np.where(sent, 0.0, deviation), np.where(sent, 0.0, areas)
        return ctx.t, deviation, areas

    def _areas(self, ctx: TriggerContext) -> np.ndarray:
        if ctx.state is None:
            return np.zeros(ctx.y.size)
        since, deviation, areas = ctx.state
        more = (ctx.t - since) * (deviation + np.abs(ctx.y - ctx.y_last)) / 2
        return areas + np.where(np.isnan(more), 0.0, more)
