"""The FMU of a model gives the Python model's estimates."""

from __future__ import annotations

import numpy as np
import pytest

from ctmhe.estimators import MHE
from ctmhe.models.fmu import FmuModel
from ctmhe.models.library import batch_reactor, hover_speed, quadrotor, van_der_pol
from ctmhe.transcription import CVODES, RK4
from ctmhe.types import Bounds, DiscountedCost, Input, Measurement
from fmus.build import build


def estimates(model, options, guess, rows, u=None, p=None):
    """A run of three estimates over common data."""
    mhe = MHE(model, **options)
    state = mhe.init(x=guess, p=p)
    if u is not None:
        state = mhe.control(state, Input(0.0, u))
    found = []
    for k, row in enumerate(rows):
        state = mhe.observe(state, Measurement(k * 0.07, row))
        if k % 4 == 3:
            state, estimate = mhe.estimate(state, k * 0.07 + 0.01)
            assert estimate.status.success
            found.append(np.concatenate([estimate.x, estimate.p]))
    return np.array(found)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("integrator", [RK4(0.05), CVODES(1e-10, 1e-12)], ids=["RK4", "CVODES"])
def test_the_reactor_fmu_with_a_parameter_gives_the_python_models_estimates(fmi, integrator):
    """States and tunable k1, estimated from pressure, agree to 1e-6 in both FMI versions and integrators."""
    cost = DiscountedCost(eta=0.5, P=np.diag([8.0, 7.1, 50.0]), Q=2e3, R=1e2)
    options = dict(horizon=0.6, interval=0.1, integrator=integrator, cost=cost, bounds=Bounds(x=(0.1, 5.0)))
    rows = [[4.0 - 0.08 * k] for k in range(16)]
    python = estimates(batch_reactor(noise=False, parameters=("k1",)), options, [2.5, 1.4], rows, p=[0.2])
    fmu = FmuModel(build("batch_reactor", fmi=fmi), inputs=[], parameters=["k1"])
    np.testing.assert_allclose(estimates(fmu, options, [2.5, 1.4], rows, p=[0.2]), python, atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_quadrotor_fmu_gives_the_python_models_estimates(fmi, rng):
    """Twelve states, four inputs."""
    cost = DiscountedCost(eta=0.5, P=10.0, Q=1e3, R=1e2)
    options = dict(horizon=0.6, interval=0.05, integrator=RK4(0.05), cost=cost, hold="point")
    rows = 0.05 * rng.normal(size=(8, 6))
    u = hover_speed() * np.array([1.01, 0.99, 1.02, 1.0])
    python = estimates(quadrotor(noise=False), options, np.full(12, 0.02), rows, u)
    model = FmuModel(build("quadrotor", fmi=fmi))
    np.testing.assert_allclose(estimates(model, options, np.full(12, 0.02), rows, u), python, atol=1e-6)


def test_a_stiff_fmu_is_estimated_by_cvodes():
    """Van der Pol with mu = 100 as FMU and as Python model, integrated by CVODES."""
    cost = DiscountedCost(eta=0.9, P=1.0, Q=1e2, R=1e3)
    options = dict(horizon=0.6, interval=0.1, integrator=CVODES(1e-9, 1e-11), cost=cost, hold="point")
    rows = [[2.0 - 0.0066 * 0.07 * k] for k in range(8)]
    python = estimates(van_der_pol(mu=100.0, noise=False), options, [1.9, 0.0], rows)
    fmu = FmuModel(build("van_der_pol", fmi=2), inputs=[], start={"mu": 100.0})
    np.testing.assert_allclose(estimates(fmu, options, [1.9, 0.0], rows), python, atol=1e-6)
