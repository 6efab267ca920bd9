"""The building's FMU beside the same model in Python: one set of equations, one set of estimates."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ctmhe.estimators import MHE
from ctmhe.models import ContinuousModel
from ctmhe.models.fmu import FmuModel
from ctmhe.transcription import RK4
from ctmhe.types import DiscountedCost, Input, Measurement
from fmus.build import build
from fmus.models import MODELS

pytest.importorskip("fmpy")

FIXED = {v.name: v.start for v in MODELS["building"].parameters}
PAIR = ("R_zw", "R_wo")
STATES, INPUTS = ("T1", "T2", "Tw1", "Tw2"), ("T_out", "solar", "heat1", "heat2")
DAY, CELL, NOISE = 86400.0, 900.0, 0.1
START, TRUE = np.array([291.0, 289.5, 285.5, 284.5]), np.array([6.5e-3, 1.5e-2])
TIMES = np.arange(73) * 2400.0  # two days


def twin() -> ContinuousModel:
    """Return the heat balances of zones and walls, with the resistances of the walls as parameters."""

    def f(t, x, u, w, p):
        c = FIXED | dict(zip(PAIR, (p[0], p[1]), strict=True))
        flows = [[(x[i] - x[2 + i]) / c["R_zw"], (x[2 + i] - u[0]) / c["R_wo"]] for i in range(2)]
        across = (x[0] - x[1]) / c["R_zz"]
        zones = [
            (-flows[i][0] + sign * across + u[2 + i] + c[f"A{i + 1}"] * u[1]) / c["C_z"]
            for i, sign in ((0, -1), (1, 1))
        ]
        walls = [(inside - outside) / c["C_w"] for inside, outside in flows]
        return [value + w[i] for i, value in enumerate((*zones, *walls))]

    scale = {v.name: v.nominal for v in (*MODELS["building"].states, *MODELS["building"].outputs)}
    return ContinuousModel(
        f,
        lambda t, x, u, w, p: [x[0], x[1]],
        x=STATES,
        u=INPUTS,
        w=[f"w_{name}" for name in STATES],
        p=PAIR,
        y=("y_T1", "y_T2"),
        nominal={name: scale[name] for name in (*STATES, "y_T1", "y_T2")} | {name: FIXED[name] for name in PAIR},
        p_start=[FIXED[name] for name in PAIR],
        name="building",
    )


@pytest.fixture(scope="module", params=[2, 3])
def fmu(request):
    model = FmuModel(build("building", fmi=request.param), outputs="y_T?", parameters=PAIR)
    yield model
    model.close()


def input_at(t: float) -> np.ndarray:
    """Return weather and heating: off at night, different in the two zones."""
    day = 2 * np.pi * t / DAY
    heating = 6 < t / 3600 % 24 < 21
    return np.array([275 - 4 * np.cos(day), max(0.0, -400 * np.cos(day)), 1500.0 * heating, 1100.0 * heating])


@cache
def record() -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) and undisturbed states (n, 4) of the twin with the true resistances, by another integrator."""
    model, rows, nothing = twin(), [START], np.zeros(4)
    for a, b in pairwise(TIMES):
        u = input_at(a)
        step = solve_ivp(
            lambda t, x, u=u: np.asarray(model.dynamics(t, x, u, nothing, TRUE)).ravel(),
            (a, b),
            rows[-1],
            "DOP853",
            rtol=1e-11,
            atol=1e-9,
        )
        rows.append(step.y[:, -1])
    return TIMES, np.array(rows)


def run(model, step=CELL):
    """Return the estimate of one window over the record, from the catalogue's resistances and a wrong state."""
    spread = np.array([3.0] * 4 + [0.5 * FIXED[name] for name in PAIR])
    disturbed = np.array([6e-5, 6e-5, 1e-6, 1e-6])
    cost = DiscountedCost(P=1 / spread**2, Q=1 / (disturbed**2 * CELL), R_point=1 / NOISE**2)
    mhe = MHE(model, horizon=3 * DAY, interval=CELL, integrator=RK4(step), cost=cost, hold="point")
    state = mhe.init(x=START + np.array([-1.0, -1.0, 2.0, 2.0]))
    for t, x in zip(*record(), strict=True):
        state = mhe.observe(mhe.control(state, Input(t, input_at(t))), Measurement(t, x[:2]))
    estimate = mhe.estimate(state, TIMES[-1])[1]
    assert estimate.status.success
    return estimate


def test_the_fmu_has_the_derivatives_of_the_twin(fmu, rng):
    """At random states, inputs and parameters, disturbed."""
    model = twin()
    for _ in range(5):
        x, u = 290 + 5 * rng.normal(size=4), np.array([275.0, 300.0, 1500.0, 900.0]) * rng.uniform(0.5, 1, 4)
        w, p = 1e-4 * rng.normal(size=4), fmu.p_start * rng.uniform(0.5, 2, 2)
        ours, its = (np.asarray(m.dynamics(0.0, x, u, w, p)).ravel() for m in (model, fmu))
        np.testing.assert_allclose(its, ours, rtol=1e-11, atol=1e-15)


def test_the_fmu_gives_the_estimates_and_the_covariance_of_the_twin(fmu):
    """States, resistances and their standard deviations from two days: to a hundredth of a standard deviation."""
    ours, its = run(twin()), run(fmu)
    std = np.sqrt(np.diag(ours.covariance))
    assert (np.abs(np.concatenate([its.x - ours.x, its.p - ours.p])) < 0.01 * std).all()
    np.testing.assert_allclose(np.sqrt(np.diag(its.covariance)), std, rtol=1e-3)
    assert its.rank == ours.rank == 6


def test_undisturbed_data_give_the_true_walls_and_resistances():
    """Only the prior pulls away: less than a standard deviation; all are known far better than at the start."""
    found, (_, x) = run(twin()), record()
    std = np.sqrt(np.diag(found.covariance))
    error = np.concatenate([found.x - x[-1], found.p - TRUE])
    assert (np.abs(error) < std).all()
    assert (std[4:] < 0.1 * 0.5 * np.array([FIXED[name] for name in PAIR])).all()


def test_a_step_of_a_cell_is_short_enough():
    """A quarter of the step moves the estimate by less than a hundredth of a standard deviation."""
    coarse, fine = run(twin()), run(twin(), CELL / 4)
    std = np.sqrt(np.diag(coarse.covariance))
    assert (np.abs(np.concatenate([fine.x - coarse.x, fine.p - coarse.p])) < 0.01 * std).all()
