"""Discrete-time models: a given step map, through the same interface as continuous ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel


class DiscreteModel(ContinuousModel):
    """x(t + step) = f(t, x, u, w, p), y = h(t, x, u, w, p): thesis (3.1), with parameters.

    Parameters
    ----------
    f, h : callable (t, x, u, w, p) -> vector or sequence
        As for `ContinuousModel`, but `f` returns the state one step later.
    step : float
        Length of a step in seconds.
    **signals
        As for `ContinuousModel`.
    """

    def __init__(self, f: Callable[..., Any], h: Callable[..., Any], *, step: float, **signals: Any):
        if not (np.isfinite(step) and step > 0):
            raise InputError(f"DiscreteModel: step must be a positive number of seconds, got {step}")
        self.step: float | None = float(step)
        super().__init__(f, h, **signals)
