"""Shared tools of the tests."""

from __future__ import annotations

import os

import casadi as ca
import numpy as np
import pytest
from hypothesis import settings

from ctmhe.estimators import MHE
from ctmhe.models import ContinuousModel
from ctmhe.transcription import RK4
from ctmhe.types import DiscountedCost, Measurement

os.environ.setdefault("CTMHE_COMPILE", "off")  # hundreds of small models: those that need the compiler ask for it

settings.register_profile("ctmhe", deadline=None)  # no test depends on the clock
settings.load_profile("ctmhe")

P_REACTOR = np.array([[4.009, 3.768], [3.768, 3.549]])  # thesis 3.4.1, continuous time
REACTOR_COST = DiscountedCost(eta=0.4, P=2 * P_REACTOR, Q=2 * np.diag([1e3, 1e3, 1e2]), R=1e2)


def linear_model(A, B, C, **keywords) -> ContinuousModel:
    """dx/dt = A x + B w, y = C x, for arrays A, B, C."""
    A, B, C = (np.atleast_2d(matrix) for matrix in (A, B, C))
    return ContinuousModel(
        lambda t, x, u, w, p: ca.mtimes(A, x) + ca.mtimes(B, w),
        lambda t, x, u, w, p: ca.mtimes(C, x),
        x=[f"x{i}" for i in range(len(A))],
        w=[f"w{i}" for i in range(B.shape[1])],
        y=[f"y{i}" for i in range(len(C))],
        **keywords,
    )


def oscillator_mhe(**changes) -> MHE:
    """A small estimator for contract tests: damped oscillator, two sensors."""
    model = linear_model([[0, 1], [-2, -0.3]], np.eye(2), np.eye(2))
    options = dict(horizon=2.0, interval=0.1, integrator=RK4(0.05), cost=DiscountedCost(P=1.0, Q=5.0, R=20.0, eta=0.8))
    return MHE(model, **(options | changes))


def feed(mhe: MHE, state, times, rows):
    """Observe all rows."""
    for t, row in zip(times, rows, strict=True):
        state = mhe.observe(state, Measurement(float(t), row))
    return state


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20240817)
