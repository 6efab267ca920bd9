"""The compiled covariance is that of the NumPy solver, determined or not."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ctmhe.estimators import MHE
from ctmhe.models import ContinuousModel
from ctmhe.models.library import batch_reactor
from ctmhe.solvers.compiled import CompiledGaussNewton
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.transcription import RK4
from ctmhe.transcription.stage import StageFunction
from tests.conftest import REACTOR_COST
from tests.solvers.test_agreement import cases
from tests.solvers.test_core import STAGE, build, case, irregular_window, linear_window, still_guess
from tests.solvers.test_wide import SIZES, chain
from tests.solvers.test_wide import window_of as wide_window


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The core for any sizes."""
    return build(tmp_path_factory.mktemp("core") / "core.so")


def agree(stage, library, window, point, rtol=1e-8):
    """Compare covariance and rank; return them."""
    ours, rank = CompiledGaussNewton(stage, library).covariance(window, point)
    python, expected = GaussNewton(stage).covariance(window, point)
    assert rank == expected
    np.testing.assert_array_equal(np.isposinf(ours), np.isposinf(python))
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(python))
    deviations = np.sqrt(np.diagonal(python))
    known = np.isfinite(python)
    scale = np.where(known, np.outer(deviations, deviations), 1.0)
    np.testing.assert_allclose((ours / scale)[known], (python / scale)[known], rtol=0, atol=rtol)
    return ours, rank


@pytest.mark.parametrize("name", cases())
def test_at_a_solution_both_solvers_agree(name, rng, library):
    """Active bounds are ignored by both; to 1e-8 of the standard deviations."""
    mhe, window, guess = case(name, rng)
    point = GaussNewton(mhe.stage).solve(window, guess).point
    agree(mhe.stage, library, window, point)


@pytest.mark.parametrize("kind", ["zero", "point"])
def test_irregular_samples_share_disturbances(rng, library, kind):
    """Slots inside a cell have one w."""
    mhe = MHE(batch_reactor(), horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=REACTOR_COST, hold=kind)
    window, guess = irregular_window(mhe, rng)
    agree(mhe.stage, library, window, guess)


@pytest.mark.parametrize("p", [False, True])
@pytest.mark.parametrize("shared", [0.0, 0.5])
@pytest.mark.parametrize("n", [1, 2, 9])
def test_linear_windows_of_any_shape(rng, library, n, shared, p):
    """Shared w, slots of no length, silent outputs, estimated parameters."""
    for _ in range(8):
        window = linear_window(rng, n, p_estimated=p, shared=shared, still=0.3)
        agree(STAGE, library, window, still_guess(window))


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_many_states(size, shared, rng, library):
    """The kernels for many states give the same."""
    nx, nw, n_p = size
    stage = chain(nx, nw, n_p, dense=False)
    window, guess = wide_window(stage, 6, rng, boxed=False, shared=shared)
    agree(stage, library, window, guess)


@pytest.mark.parametrize("p", [False, True])
def test_what_the_window_does_not_determine_is_infinite(rng, library, p):
    """No prior and one measured output: the rank, and infinite variances where they belong.

    The NumPy solver has the finite ones from a system of condition 1e13, to a percent.
    """
    for n in (1, 4):
        window = linear_window(rng, n, p_estimated=p)
        L_y = np.zeros_like(window.L_y)
        for seen in range(3):
            if seen:
                L_y[-1, 0, seen - 1, seen - 1] = 2.0
            silent = replace(window, L_prior=0 * window.L_prior, L_y=L_y.copy())
            _, rank = agree(STAGE, library, silent, still_guess(window), rtol=0.05)
            assert rank <= seen


def test_a_signal_that_is_determined_keeps_its_variance(rng, library):
    """Two uncoupled states, one without prior and measurement: the other's variance is what it is alone."""
    model = ContinuousModel(
        lambda t, x, u, w, p: ca.vertcat(-x[0] + w[0], 0 * x[1]), lambda t, x, u, w, p: x[0],
        x=["seen", "hidden"], w=["w"], y=["y"],
    )  # fmt: skip
    stage = StageFunction(model, RK4(0.1), signal=False)
    window, guess = wide_window(stage, 5, rng, boxed=False, shared=False)
    silent = replace(window, L_prior=np.diag([1.0, 0.0]), L_y=np.full_like(window.L_y, 2.0))
    ours, rank = agree(stage, library, silent, guess, rtol=0.05)
    full, _ = agree(stage, library, replace(silent, L_prior=np.eye(2)), guess)
    assert rank == 1 and np.isposinf(ours[1, 1])
    assert ours[0, 0] == pytest.approx(full[0, 0], rel=1e-8)


def test_a_model_that_is_not_finite_determines_nothing(rng, library):
    """Rank 0, infinite variances; no error."""
    stage = chain(3, 3, 0, dense=True)
    window, guess = wide_window(stage, 3, rng, boxed=False, shared=False)
    ours, rank = agree(stage, library, window, replace(guess, x=np.full_like(guess.x, np.nan)))
    assert rank == 0 and np.isposinf(np.diagonal(ours)).all()
