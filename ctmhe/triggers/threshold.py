"""Policies that compare an output with the value that was last sent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.triggers.base import Trigger, TriggerContext
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
        if isinstance(self.delta, Mapping):
            if self.outputs is not None:
                raise InputError("SendOnDelta: a mapping names its outputs; leave outputs= out")
            object.__setattr__(self, "outputs", tuple(self.delta))
            object.__setattr__(self, "delta", tuple(self.delta.values()))
        try:
            deltas = tuple(float(d) for d in np.atleast_1d(np.asarray(self.delta, dtype=float)))
        except (TypeError, ValueError):
            raise InputError(f"SendOnDelta: delta must be numbers, got {self.delta!r}") from None
        if not deltas or not all(d >= 0 for d in deltas):
            raise InputError(f"SendOnDelta: delta must be >= 0 in the outputs' units, got {self.delta!r}")
        object.__setattr__(self, "delta", deltas[0] if len(deltas) == 1 else deltas)
        if self.outputs is not None:
            object.__setattr__(self, "outputs", names_of(self.outputs))
            if len(deltas) not in (1, len(self.outputs)):
                raise InputError(f"SendOnDelta: {len(deltas)} thresholds for {len(self.outputs)} outputs")

    def guard(self, ctx: TriggerContext) -> float:
        """Return the largest excess over the thresholds, in output units."""
        y, y_last, delta = ctx.y, ctx.y_last, np.asarray(self.delta, dtype=float)
        if self.outputs is not None:
            chosen = [ctx.output_index(name) for name in self.outputs]
            y, y_last = y[chosen], y_last[chosen]
        elif delta.size not in (1, y.size):
            raise InputError(f"{delta.size} thresholds for {y.size} outputs ({', '.join(ctx.outputs)})")
        delta = np.broadcast_to(delta, y.shape)
        moved = np.where(np.isnan(y_last), np.inf, np.abs(y - y_last))
        watched = ~np.isnan(y) & np.isfinite(delta)
        return float(np.max(moved[watched] - delta[watched])) if watched.any() else -np.inf
