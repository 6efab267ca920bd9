"""Where a level reaches zero on a plant that has no root finding of its own: search with rollback."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ctmhe.simulation.integration import CLIP
from ctmhe.simulation.plants import Plant
from ctmhe.triggers.timing import tolerance

if TYPE_CHECKING:
    from ctmhe.simulation.engine import Segment


def first_reached(
    plant: Plant, segment: Segment, level: Callable[[float], float], within: float, *, after: float
) -> tuple[float, bool]:
    """Advance a plant through a segment, or to where `level` reaches zero in it; return the time, and whether it did.

    `level(t)` is asked with the plant at `t`: at the segment's end first, so that a level that comes back in between is
    not seen; then by Brent's method, going back to the start of the segment for each trial. The time returned is at
    most `within` seconds late, never early, and not before `after`; the plant is there.
    """
    a, b = segment.a, segment.b
    checkpoint = plant.checkpoint()
    plant.advance(b, segment.u0, segment.u1, segment.w)
    if level(b) < 0:
        return b, False

    def at(t: float) -> float:
        plant.restore(checkpoint)
        plant.advance(t, segment.u0, segment.input_at(t), segment.w)
        return float(np.clip(level(t), -CLIP, CLIP))

    begin = a if at(a) < 0 else min(a + 2 * tolerance(a), b)
    if at(begin) >= 0:
        found = begin
    else:
        from scipy.optimize import brentq

        # half of the allowance for the search, half for stepping to the side on which the level is reached
        found = float(brentq(at, begin, b, xtol=within / 2, rtol=4 * np.finfo(float).eps, maxiter=200))  # type: ignore[arg-type]
        step = within / 2
        while found < b and at(found) < 0:
            found, step = min(found + step, b), 2 * step
    found = max(found, after)
    if found >= b - tolerance(b):
        found = b
    at(found)
    return found, True
