"""What the offline and delayed cases share: records of discrete plants, estimators stepped along them, cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.offline.blocks import in_parallel
from ctmhe.types import Array, Estimate, Input, Measurement


def stepped(mhe: MHE, log: MeasurementLog, *, guess: Any) -> list[Estimate]:
    """Return the estimates at every row of a log."""
    state = mhe.init(t=float(log.t[0]), x=guess)
    estimates = []
    for t, y, u in zip(log.t.tolist(), log.y, log.u, strict=True):
        if len(u):
            state = mhe.control(state, Input(t, u))
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(t, y)), t)
        estimates.append(estimate)
    return estimates


def squares(x: Array, truth: Array) -> float:
    """Return the sum of squared errors."""
    return float(np.sum((x - truth) ** 2))


def cell(values: Sequence[float] | Array) -> dict[str, float]:
    """Return mean and standard deviation over seeds."""
    values = np.asarray(values, float)
    return {"mean": float(values.mean()), "std": float(values.std(ddof=1)) if len(values) > 1 else 0.0}


def all_of(tasks: Sequence[Callable[[], Any]], workers: int) -> list[Any]:
    """Return what tasks return; raise what one of them raised."""
    answers = in_parallel(tasks, workers=workers)
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
    return answers
