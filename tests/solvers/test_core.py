"""The compiled core solves what Gauss-Newton and IPOPT solve, whatever the window looks like."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ctmhe.solvers
from ctmhe.compilers import extra_flags
from ctmhe.errors import SolverError
from ctmhe.estimators import MHE
from ctmhe.estimators.guesses import shifted_guess
from ctmhe.models import ContinuousModel
from ctmhe.models.library import batch_reactor
from ctmhe.solvers.compiled import CompiledGaussNewton
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.solvers.ipopt import Ipopt
from ctmhe.transcription import RK4
from ctmhe.transcription.grid import Mesh
from ctmhe.transcription.problem import Guess, Window, bound_violation
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Bounds, DiscountedCost, Input, Measurement
from tests.conftest import REACTOR_COST
from tests.solvers.test_agreement import cases, noisy_record

COMPILER = next((p for p in (os.environ.get("CC"), "cc", "gcc", "clang") if p and shutil.which(p)), None)
SOURCE = Path(ctmhe.solvers.__file__).parent / "core" / "core.c"
INF = np.inf


@pytest.fixture(scope="session")
def library(tmp_path_factory) -> Path:
    """The core for any sizes."""
    return build(tmp_path_factory.mktemp("core") / "core.so")


def build(target: Path, *flags: str, source: Path = SOURCE) -> Path:
    """Compile the core, or what includes it, with `$CTMHE_CFLAGS` as the library would; the same once only."""
    if COMPILER is None:
        pytest.skip("no C compiler found ($CC, cc, gcc, clang)")
    target.write_bytes(compiled(COMPILER, source, *flags, *extra_flags()))
    return target


@cache
def compiled(compiler: str, source: Path, *flags: str) -> bytes:
    """A library's content."""
    options = ["-O2", "-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", *flags]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "core.so"
        subprocess.run([compiler, *options, str(source), "-o", str(target), "-lm"], check=True)
        return target.read_bytes()


def window_of(mhe: MHE, state, end: float) -> tuple[Window, Guess]:
    """The window that `estimate` would solve, and its last guess."""
    anchor = mhe._prior(state, max(end - mhe.horizon, 0.0), end <= mhe.horizon)
    start = max(end - mhe.horizon, 0.0)
    records = mhe.records(state, start, end)
    window = mhe.assembly.window(start, end, records, anchor.value, growing=end <= mhe.horizon)
    return window, shifted_guess(mhe.stage, window)


def irregular_window(mhe: MHE, rng) -> tuple[Window, Guess]:
    """A window of the reactor whose samples split cells."""
    state, t = mhe.init(x=[2.0, 1.0]), 0.0
    while t < 0.93:
        state = mhe.observe(state, Measurement(t, [3.0 + 0.1 * rng.normal()]))
        t += rng.exponential(0.05) + 1e-3
    window, guess = window_of(mhe, state, 0.95)
    assert window.mesh.shared.any()
    return window, guess


def case(name: str, rng) -> tuple[MHE, Window, Guess]:
    """One of the agreement cases as a window."""
    model, options, guess, truth, p_guess, p_true, u, noise = cases()[name]
    mhe = MHE(model, horizon=20 * options["interval"], **options)
    rows = noisy_record(mhe, truth, p_true, u, 20, noise, rng)
    state = mhe.init(x=guess, p=p_guess if len(p_guess) else None)
    if len(u):
        state = mhe.control(state, Input(0.0, u))
    for k, row in enumerate(rows):
        state = mhe.observe(state, Measurement(k * mhe.interval, row))
    return mhe, *window_of(mhe, state, 20 * mhe.interval)


def agree(stage, library, window, guess, *, multipliers=True, reference=True):
    """Solve with all; compare costs at the default tolerance, and at a tight one active sets and multipliers too."""
    python, usual = GaussNewton(stage).solve(window, guess), CompiledGaussNewton(stage, library).solve(window, guess)
    ours = CompiledGaussNewton(stage, library, tolerance=1e-12).solve(window, guess)
    assert python.success, python.message
    assert usual.success, usual.message
    assert usual.cost == pytest.approx(python.cost, rel=1e-8, abs=1e-12)
    assert usual.iterations <= ours.iterations
    assert ours.success, ours.message
    assert ours.feasibility < 1e-8
    assert ours.cost == pytest.approx(python.cost, rel=1e-8, abs=1e-12)
    if reference:
        ipopt = Ipopt(stage).solve(window, guess)
        assert ipopt.success
        assert ours.cost == pytest.approx(ipopt.cost, rel=1e-8, abs=1e-9)
    if multipliers:
        for key in ("x", "w", "p"):
            np.testing.assert_array_equal(getattr(ours.point, f"{key}_active"), getattr(python.point, f"{key}_active"))
        size = np.abs(python.multipliers.dynamics).max(initial=1e-3)
        for key in ("dynamics", "x", "w", "y", "p"):
            mine, other = (getattr(s.multipliers, key) for s in (ours, python))
            if other.size:
                np.testing.assert_allclose(mine, other, atol=1e-5 * size)
    return ours


@pytest.mark.parametrize("name", cases())
def test_core_gauss_newton_and_ipopt_find_the_same(name, rng, library):
    """Cost to 1e-8, active sets, multipliers."""
    mhe, window, guess = case(name, rng)
    agree(mhe.stage, library, window, guess)


@pytest.mark.parametrize("kind", ["zero", "point"])
def test_irregular_samples_share_disturbances(rng, library, kind):
    """Slots inside a cell have one w, bounded or not, at irregular samples and with a residual bound."""
    model = batch_reactor()
    for bounds in (Bounds(), Bounds(w=(-0.05, 0.05)), Bounds(w=(-0.3, 0.3), x=(0.1, 2.2), residual=(-0.4, 0.4))):
        mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=REACTOR_COST, bounds=bounds, hold=kind)
        window, guess = irregular_window(mhe, rng)
        agree(mhe.stage, library, window, guess)


def test_output_bounds_are_met(rng, library):
    """Bounds of an output, active, cost what they cost IPOPT."""
    model = batch_reactor()
    mhe = MHE(model, horizon=1.0, interval=0.05, integrator=RK4(0.05), cost=REACTOR_COST, bounds=Bounds(y=(3.2, 4.0)))
    state = mhe.init(x=[2.5, 1.0])
    for k in range(20):
        state = mhe.observe(state, Measurement(0.05 * k, [3.2 + 0.05 * rng.normal()]))
    window, guess = window_of(mhe, state, 0.96)
    solution = agree(mhe.stage, library, window, guess)
    assert solution.point.y_active.any()
    assert (solution.y[:, -1] >= 3.2 - 1e-8).all()


def test_a_library_for_one_model_does_the_same_and_refuses_another(rng, library, tmp_path):
    """Sizes as constants change nothing; a model of other sizes is refused."""
    mhe, window, guess = case("Chua, parameter and its bound", rng)
    stage = mhe.stage
    sizes = dict(NX=stage.nx, NW=stage.nw, NP=stage.np, NY=stage.ny, NQ=stage.q, TAPE=1)
    special = build(tmp_path / "special.so", *(f"-DCTMHE_{key}={value}" for key, value in sizes.items()))
    assert CompiledGaussNewton(stage, special).solve(window, guess).cost == pytest.approx(
        CompiledGaussNewton(stage, library).solve(window, guess).cost, rel=1e-12
    )
    other = MHE(batch_reactor(), horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=REACTOR_COST)
    with pytest.raises(SolverError, match="compiled for"):
        CompiledGaussNewton(other.stage, special)


def test_equal_arguments_give_equal_bits(rng, library):
    """The core keeps nothing between calls: other windows in between change nothing."""
    mhe, window, guess = case("quadrotor, tilt bounded", rng)
    solver = CompiledGaussNewton(mhe.stage, library)
    first = solver.solve(window, guess)
    solver.solve(window.relaxed(), guess)
    second, fresh = solver.solve(window, guess), CompiledGaussNewton(mhe.stage, library).solve(window, guess)
    for other in (second, fresh):
        assert (other.cost, other.optimality, other.iterations) == (first.cost, first.optimality, first.iterations)
        assert other.point.x.tobytes() == first.point.x.tobytes()
        assert other.multipliers.x.tobytes() == first.multipliers.x.tobytes()


# ---- Linear-quadratic windows of any shape ----------------------------------------------------------------------


def linear_stage() -> StageFunction:
    """Two states, two disturbances, one parameter, two outputs; linear."""
    A, B, E = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[1.0, 0.0], [0.2, 1.0]]), np.array([[0.3], [1.0]])
    model = ContinuousModel(
        lambda t, x, u, w, p: ca.mtimes(A, x) + ca.mtimes(B, w) + ca.mtimes(E, p),
        lambda t, x, u, w, p: ca.vertcat(x[0] + 0.1 * w[0], x[1] - 0.5 * p[0]),
        x=["a", "b"], w=["v", "w"], p=["c"], y=["y", "z"], p_start=[0.5],
    )  # fmt: skip
    return StageFunction(model, RK4(0.1), signal=False)


STAGE = linear_stage()
IPOPT = Ipopt(STAGE)


def linear_window(rng, n: int, *, boxes=0.0, p_estimated=True, shared=0.0, still=0.0, outputs=False) -> Window:
    """A random window that a trajectory inside all its boxes exists for."""
    h = np.where(rng.random(n) < still, 0.0, rng.uniform(0.05, 0.3, n))
    tied = rng.random(n) < shared
    tied[-1] = False
    t = np.concatenate([[0.0], np.cumsum(h)])
    width = 2 + p_estimated
    w = rng.normal(size=(n, 2))
    for k in range(1, n):
        if tied[k - 1]:
            w[k] = w[k - 1]
    p = rng.normal(size=1) if p_estimated else np.array([0.5])
    x, y = np.zeros((n + 1, 2)), np.zeros((n, 2))
    x[0] = rng.normal(size=2)
    none = np.empty(0)
    for k in range(n):
        x[k + 1], row = STAGE.step(t[k], h[k], x[k], w[k], p, none, none)
        y[k] = row[-1]

    def box(value, share):
        low = np.where(rng.random(value.shape) < share, value - rng.exponential(0.2, value.shape), -INF)
        high = np.where(rng.random(value.shape) < share, value + rng.exponential(0.2, value.shape), INF)
        fixed = rng.random(value.shape) < 0.05 * share
        return np.where(fixed, value, low), np.where(fixed, value, high)

    (x_low, x_high), (w_low, w_high), (p_low, p_high) = box(x, boxes), box(w, boxes), box(p, boxes)
    for k in range(1, n):
        if tied[k - 1]:
            w_low[k], w_high[k] = w_low[k - 1], w_high[k - 1]
    for k in range(n):
        if h[k] == 0:
            x_low[k + 1], x_high[k + 1] = x_low[k], x_high[k]
    y_low, y_high = box(y, boxes if outputs else 0.0)
    L_y = np.zeros((n, 1, 2, 2))
    L_y[:, 0, 0, 0], L_y[:, 0, 1, 1], L_y[:, 0, 0, 1] = rng.uniform(0, 3, n), rng.uniform(0, 3, n), rng.normal(size=n)
    L_y[rng.random(n) < 0.3] = 0.0
    ones = np.ones
    return Window(
        mesh=Mesh(t, h, tied, np.arange(n), 1e-9), u0=np.empty((n, 0)), u1=np.empty((n, 0)),
        prior=np.array([*rng.normal(size=2), 0.5]), p_estimated=p_estimated,
        L_prior=np.triu(rng.normal(size=(width, width))) + 0.5 * np.eye(width),
        L_w=np.triu(rng.normal(size=(n, 2, 2)) * 0.3) + rng.uniform(0.3, 2.0, (n, 1, 1)) * np.eye(2),
        L_y=L_y, y_data=y[:, None] + rng.normal(size=(n, 1, 2)),
        x_lower=x_low, x_upper=x_high, w_lower=w_low, w_upper=w_high, y_lower=y_low, y_upper=y_high,
        p_lower=p_low, p_upper=p_high,
        x_scale=np.array([1.0, 3.0]), w_scale=np.array([0.5, 1.0]), p_scale=np.array([2.0]), y_scale=ones(2),
    )  # fmt: skip


def still_guess(window: Window) -> Guess:
    """All zero."""
    n = len(window.mesh)
    return Guess.of(np.zeros((n + 1, 2)), np.zeros((n, 2)), np.array([0.5]), 2)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1), n=st.integers(1, 12), boxes=st.sampled_from([0.0, 0.3, 0.8]), p=st.booleans(),
    shared=st.sampled_from([0.0, 0.5]), still=st.sampled_from([0.0, 0.3]), outputs=st.booleans(),
)  # fmt: skip
def test_random_quadratic_programs_match_ipopt(library, seed, n, boxes, p, shared, still, outputs):
    """A linear model and random boxes: one iteration finds IPOPT's minimum."""
    rng = np.random.default_rng(seed)
    window = linear_window(rng, n, boxes=boxes, p_estimated=p, shared=shared, still=still, outputs=outputs)
    guess = still_guess(window)
    reference = IPOPT.solve(window, guess)
    ours = CompiledGaussNewton(STAGE, library).solve(window, guess)
    assert ours.success, ours.message
    assert bound_violation(window, ours.point, ours.y[:, -1]) < 1e-8
    assert ours.feasibility < 1e-8
    if reference.success:  # which loses digits where two bounds say the same; a feasible point that costs less is right
        assert ours.cost <= reference.cost * (1 + 1e-7) + 1e-7
        assert ours.cost == pytest.approx(reference.cost, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("what", ["prior", "outputs", "outputs and prior", "disturbances", "all"])
@pytest.mark.parametrize("boxes", [0.0, 0.5])
def test_zero_weights_are_solved(library, what, boxes):
    """Directions without weight are left alone: the cost is IPOPT's."""
    window = linear_window(np.random.default_rng(1), 8, boxes=boxes)
    if what in ("prior", "outputs and prior", "all"):
        window = replace(window, L_prior=np.zeros((3, 3)))
    if what in ("outputs", "outputs and prior", "all"):
        window = replace(window, L_y=np.zeros_like(window.L_y))
    if what in ("disturbances", "all"):
        window = replace(window, L_w=np.zeros_like(window.L_w))
    guess = still_guess(window)
    ours, reference = CompiledGaussNewton(STAGE, library).solve(window, guess), IPOPT.solve(window, guess)
    assert ours.success, ours.message
    assert ours.cost == pytest.approx(reference.cost, rel=1e-7, abs=1e-7)
    assert ours.feasibility < 1e-8


def test_contradictory_bounds_end_with_a_reason(library):
    """lower > upper, or boxes no trajectory can meet: no success, finite numbers, no crash."""
    window = linear_window(np.random.default_rng(2), 6)
    impossible = window.x_lower.copy()
    impossible[3, 0] = 1.0
    crossed = replace(window, x_lower=impossible, x_upper=np.where(impossible > 0, -1.0, INF))
    still = np.zeros_like(window.w_lower)
    x_low, x_high = np.full((7, 2), -INF), np.full((7, 2), INF)
    x_low[0], x_high[0], x_low[4, 0] = 0.0, 0.0, 50.0
    unreachable = replace(
        window, w_lower=still, w_upper=still, x_lower=x_low, x_upper=x_high, p_lower=still[0, :1], p_upper=still[0, :1]
    )
    for problem in (crossed, unreachable):
        solution = CompiledGaussNewton(STAGE, library).solve(problem, still_guess(problem))
        assert not solution.success
        assert solution.message != "converged"
        assert np.isfinite(solution.point.x).all()


def test_models_that_are_not_finite_far_away_are_approached_slowly(library):
    """NaN in a trial step is a rejected step; at the guess it is the answer."""
    model = ContinuousModel(
        lambda t, x, u, w, p: -ca.sqrt(x) + w, lambda t, x, u, w, p: ca.log(x), x=["x"], w=["w"], y=["y"]
    )
    cost = DiscountedCost(P=0.1, Q=1.0, R=10.0, eta=1.0)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=cost, hold="point")
    state = mhe.init(x=[8.0])
    for k in range(11):
        state = mhe.observe(state, Measurement(0.1 * k, [np.log(max((0.6 - 0.05 * k), 0.05) ** 2)]))
    window, guess = window_of(mhe, state, 1.0)
    agree(mhe.stage, library, window, guess, reference=False)
    bad = replace(guess, x=-np.ones_like(guess.x))
    solution = CompiledGaussNewton(mhe.stage, library).solve(window, bad)
    assert not solution.success
    assert "not finite at the guess" in solution.message


def test_fixed_variables_do_not_move(library):
    """lower = upper on w, x and p is held exactly."""
    window = linear_window(np.random.default_rng(4), 6)
    w_low, w_high = window.w_lower.copy(), window.w_upper.copy()
    w_low[:, 0] = w_high[:, 0] = 0.3
    x_low, x_high = window.x_lower.copy(), window.x_upper.copy()
    x_low[2, 1] = x_high[2, 1] = -0.4
    window = replace(
        window, w_lower=w_low, w_upper=w_high, x_lower=x_low, x_upper=x_high, p_lower=np.ones(1), p_upper=np.ones(1)
    )
    ours = agree(STAGE, library, window, still_guess(window))
    assert (ours.point.w[:, 0] == 0.3).all()
    assert ours.point.x[2, 1] == -0.4
    assert ours.point.p[0] == 1.0
