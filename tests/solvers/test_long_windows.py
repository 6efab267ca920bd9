"""Long windows of unstable models: rounding must not grow with the state."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from ctmhe.models import ContinuousModel
from ctmhe.solvers.compiled import CompiledGaussNewton
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.transcription import RK4
from ctmhe.transcription.stage import StageFunction
from tests.solvers.test_core import build
from tests.solvers.test_wide import window_of


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The core for any sizes."""
    return build(tmp_path_factory.mktemp("core") / "core.so")


@pytest.mark.parametrize("n_p", [0, 1])
@pytest.mark.parametrize("shared", [False, True])
def test_a_window_in_which_the_model_grows_by_1e35_is_solved(library, rng, shared, n_p):
    """One iteration, the reference's multipliers, a memory in proportion to the length."""
    model = ContinuousModel(
        lambda t, x, u, w, p: ca.vertcat(3 * x[0] + x[1] + w[0], w[1] - x[1] + (p if n_p else 0)),
        lambda t, x, u, w, p: x, x=["a", "b"], w=["v", "w"], p=["c"][:n_p], y=["y", "z"],
        p_start=[0.1] if n_p else None,
    )  # fmt: skip
    stage = StageFunction(model, RK4(0.1), signal=False)
    window, guess = window_of(stage, 400, rng, boxed=False, shared=shared)
    assert 3 * window.mesh.t[-1] > np.log(1e35)
    window = replace(window, L_y=window.L_y + np.eye(2))
    ours, python = CompiledGaussNewton(stage, library).solve(window, guess), GaussNewton(stage).solve(window, guess)
    assert ours.success and python.success
    assert ours.cost == pytest.approx(python.cost, rel=1e-8)
    size = np.abs(python.multipliers.dynamics).max()
    np.testing.assert_allclose(ours.multipliers.dynamics, python.multipliers.dynamics, atol=1e-6 * size)


def test_memory_is_in_proportion_to_the_length(library):
    """Scratch per slot does not grow with the number of slots."""
    model = ContinuousModel(lambda t, x, u, w, p: w - x, lambda t, x, u, w, p: x, x=["x"], w=["w"], y=["y"])
    solver = CompiledGaussNewton(StageFunction(model, RK4(0.1), signal=False), library)
    rng, sizes = np.random.default_rng(0), []
    for n in (100, 1000, 4000):
        window, guess = window_of(solver.stage, n, rng, boxed=False, shared=False)
        solver.solve(window, guess)
        memory = solver._local.memory
        sizes.append(memory.scratch.nbytes / memory.capacity)
    assert max(sizes) < 1.5 * min(sizes)
