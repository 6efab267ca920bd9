"""The kernels for many states: any size, zeros or none in the Jacobian, any length of vectors."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ctmhe.models import ContinuousModel
from ctmhe.solvers.compiled import CompiledGaussNewton
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.transcription import RK4
from ctmhe.transcription.grid import Mesh
from ctmhe.transcription.problem import Guess, Window
from ctmhe.transcription.stage import StageFunction
from tests.solvers.test_core import build

INF = np.inf


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    """The core as compiled here, with vectors of 16 bytes only, and without any."""
    folder = tmp_path_factory.mktemp("wide")
    flags = {"any": (), "baseline": ("-DCTMHE_BASELINE",), "narrow": ("-DCTMHE_NARROW",)}
    exact = "-ffp-contract=off"  # as the library is built: a processor with fused operations gives the same results
    return {key: build(folder / f"{key}.so", exact, *given) for key, given in flags.items()}


def chain(nx: int, nw: int, n_p: int, *, dense: bool) -> StageFunction:
    """Coupled square roots: every state drains into the next, or into all others."""
    mixing = np.random.default_rng(nx).normal(size=(nx, nx)) / nx if dense else np.eye(nx, k=-1) - np.eye(nx)
    entry = np.random.default_rng(nw).normal(size=(nx, nw)) if dense else np.eye(nx, nw)
    names = [f"x{i}" for i in range(nx)]

    def f(t, x, u, w, p):
        drive = ca.mtimes(mixing, ca.sqrt(1 + x**2)) + ca.mtimes(entry, w)
        return drive + (p[0] * x if n_p else 0) + (ca.sum1(p) if n_p else 0)

    model = ContinuousModel(
        f, lambda t, x, u, w, p: x[::3], x=names, w=[f"w{i}" for i in range(nw)], p=[f"p{i}" for i in range(n_p)],
        y=names[::3], p_start=np.full(n_p, 0.1) if n_p else None,
    )  # fmt: skip
    return StageFunction(model, RK4(0.1), signal=False)


def window_of(stage: StageFunction, n: int, rng, *, boxed: bool, shared: bool) -> tuple[Window, Guess]:
    """A window of n slots with random samples, some of them without weight."""
    nx, nw, n_p, ny = stage.nx, stage.nw, stage.np, stage.ny
    h = rng.uniform(0.05, 0.1, n)
    tied = np.append(rng.random(n - 1) < (0.4 if shared else 0.0), False)

    def box(shape, side):
        return np.full(shape, -side if boxed else -INF), np.full(shape, side if boxed else INF)

    (x_low, x_high), (w_low, w_high) = box((n + 1, nx), 1.2), box((n, nw), 0.4)
    L_y = np.eye(ny) * rng.uniform(1, 3, (n, 1, ny, ny)) * (rng.random((n, 1, 1, 1)) < 0.7)
    window = Window(
        mesh=Mesh(np.append(0.0, np.cumsum(h)), h, tied, np.arange(n), 1e-9), u0=np.empty((n, 0)),
        u1=np.empty((n, 0)), prior=np.append(rng.normal(size=nx) * 0.5, np.full(n_p, 0.1)), p_estimated=bool(n_p),
        L_prior=np.eye(nx + n_p), L_w=np.eye(nw) * rng.uniform(2, 4, (n, nw, nw)), L_y=L_y,
        y_data=rng.normal(size=(n, 1, ny)), x_lower=x_low, x_upper=x_high, w_lower=w_low, w_upper=w_high,
        y_lower=np.full((n, ny), -INF), y_upper=np.full((n, ny), INF), p_lower=np.full(n_p, -INF),
        p_upper=np.full(n_p, INF), x_scale=rng.uniform(0.5, 2, nx), w_scale=rng.uniform(0.5, 2, nw),
        p_scale=np.ones(n_p), y_scale=np.ones(ny),
    )  # fmt: skip
    return window, Guess.of(np.zeros((n + 1, nx)), np.zeros((n, nw)), np.full(n_p, 0.1), ny)


SIZES = [(16, 0, 0), (8, 8, 0), (9, 8, 1), (10, 9, 2), (11, 13, 0), (13, 10, 3), (17, 2, 1), (24, 24, 0)]


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_every_size_gives_what_the_reference_gives(libraries, size, dense, shared, boxed, rng):
    """Cost, minimiser and multipliers; vectors of any length give equal bits, none gives equal numbers."""
    nx, nw, n_p = size
    stage = chain(nx, nw, n_p, dense=dense)
    window, guess = window_of(stage, 6, rng, boxed=boxed and nw > 0, shared=shared)
    python = GaussNewton(stage).solve(window, guess)
    assert python.success
    found = {
        key: CompiledGaussNewton(stage, path, tolerance=1e-12).solve(window, guess) for key, path in libraries.items()
    }
    for solution in found.values():
        assert solution.success, solution.message
        assert solution.cost == pytest.approx(python.cost, rel=1e-9)
        np.testing.assert_allclose(solution.point.x, python.point.x, atol=1e-5)
        size_of = np.abs(python.multipliers.dynamics).max()
        np.testing.assert_allclose(solution.multipliers.dynamics, python.multipliers.dynamics, atol=1e-4 * size_of)
    for key in ("x", "w", "p"):
        assert getattr(found["any"].point, key).tobytes() == getattr(found["baseline"].point, key).tobytes()


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_the_library_as_built_takes_every_size(size, boxed, rng, tmp_path):
    """Without further flags: the reference's cost, with disturbances that slots share."""
    nx, nw, n_p = size
    stage = chain(nx, nw, n_p, dense=True)
    window, guess = window_of(stage, 6, rng, boxed=boxed and nw > 0, shared=True)
    python = GaussNewton(stage).solve(window, guess)
    ours = CompiledGaussNewton(stage, build(tmp_path / "core.so"), tolerance=1e-12).solve(window, guess)
    assert ours.success, ours.message
    assert ours.cost == pytest.approx(python.cost, rel=1e-9)
