"""Slots of several integration steps: the chain rule through them, in Python and in the core."""

from __future__ import annotations

import ctypes
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.estimators import MHE
from ctmhe.estimators.guesses import shifted_guess
from ctmhe.models import ContinuousModel
from ctmhe.solvers import tape
from ctmhe.solvers.binding import Functions, load
from ctmhe.solvers.compiled import CompiledGaussNewton
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.solvers.ipopt import Ipopt
from ctmhe.transcription import RK4
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Bounds, DiscountedCost, Input, Measurement
from tests.solvers.test_core import SOURCE, build
from tests.solvers.test_wide import window_of

STEP = 0.1


def pendulum() -> ContinuousModel:
    """A driven pendulum with unknown friction: everything a stage function can depend on, nonlinearly."""
    return ContinuousModel(
        lambda t, x, u, w, p: [x[1] + w[0], -ca.sin(x[0]) - p[0] * x[1] ** 3 + u[0] * ca.cos(x[0]) + w[1] + 0.1 * t],
        lambda t, x, u, w, p: [ca.sin(x[0]) + 0.2 * u[0], x[0] * x[1] + w[0] ** 2],
        x=("angle", "rate"), u=("torque",), w=("v", "w"), p=("friction",), p_start=[0.3], y=("one", "two"),
    )  # fmt: skip


SINGLE = {signal: StageFunction(pendulum(), RK4(STEP), signal=signal) for signal in (False, True)}
CHAINED = {signal: StageFunction(pendulum(), RK4(STEP), signal=signal, interval=5 * STEP) for signal in (False, True)}


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The core for any sizes."""
    return build(tmp_path_factory.mktemp("core") / "core.so")


def slots(rng, n: int):
    """Arguments of n slots of any length up to the longest, some of none."""
    h = rng.uniform(0, 5 * STEP, n) * (rng.random(n) < 0.8)
    return (rng.normal(size=n), h, rng.normal(size=(n, 2)), rng.normal(size=(n, 2)), np.array([0.3]),
            rng.normal(size=(n, 1)), rng.normal(size=(n, 1)))  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), signal=st.booleans())
def test_a_slot_is_its_steps_one_after_the_other(seed, signal):
    """x and y equal those of single steps with the input interpolated; nodes of steps that are not there are zero."""
    t, h, x, w, p, u0, u1 = slots(np.random.default_rng(seed), 4)
    stage, r = CHAINED[signal], 4 * signal
    x_next, y = stage.values(t, h, x, w, p, u0, u1)
    for k in range(4):
        steps = max(1, int(np.ceil(h[k] / STEP * (1 - 1e-9))))
        assert stage.steps_of(h[k : k + 1])[0] == steps
        state, expected = x[k], np.zeros((stage.q, 2))
        for i in range(steps):
            u = [u0[k] + (u1[k] - u0[k]) * share for share in (i / steps, (i + 1) / steps)]
            state, rows = SINGLE[signal].step(t[k] + i * h[k] / steps, h[k] / steps, state, w[k], p, *u)
            expected[i * r : (i + 1) * r], expected[-1] = rows[:-1], rows[-1]
        np.testing.assert_allclose(x_next[k], state, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(y[k], expected, rtol=1e-13, atol=1e-13)
        alone = stage.step(t[k], h[k], x[k], w[k], p, u0[k], u1[k])
        np.testing.assert_allclose(alone[0], state, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(alone[1], expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("signal", [False, True])
def test_derivatives_of_a_slot_are_its_difference_quotients(signal, rng):
    """First derivatives against central differences of values, second ones against those of first ones."""
    t, h, x, w, p, u0, u1 = slots(rng, 8)
    stage, size = CHAINED[signal], 1e-5
    linear = stage.linearize(t, h, x, w, p, u0, u1)
    lambda_x, lambda_y = rng.normal(size=(8, 2)), rng.normal(size=(8, stage.q * 2))
    both = np.concatenate([lambda_x, lambda_y], axis=1)[:, None]
    hessian = stage.curvature(t, h, x, w, p, u0, u1, lambda_x, lambda_y)
    for i in range(5):
        values, gradients = [], []
        for sign in (1, -1):
            moved = [x.copy(), w.copy(), p.copy()]
            moved[i // 2][..., i % 2] += sign * size
            point = stage.linearize(t, h, *moved, u0, u1)
            values.append(np.concatenate([point.x_next, point.y.reshape(8, -1)], axis=1))
            gradients.append((both @ point.jacobian)[:, 0])
        np.testing.assert_allclose(linear.jacobian[:, :, i], (values[0] - values[1]) / (2 * size), atol=1e-8)
        np.testing.assert_allclose(hessian[:, i], (gradients[0] - gradients[1]) / (2 * size), atol=1e-8)


def test_the_nodes_of_the_output_integral_integrate_polynomials_over_the_slot(rng):
    """RK4's weights are Simpson's in every step: exact up to the third power, for any length."""
    h = np.append(rng.uniform(0, 5 * STEP, 20), [0.0, STEP, 5 * STEP])
    nodes, weights = CHAINED[True].quadrature(h)
    for power in range(4):
        np.testing.assert_allclose((weights * nodes**power).sum(axis=1), h ** (power + 1) / (power + 1), atol=1e-15)


@pytest.mark.parametrize("signal", [False, True])
def test_second_derivatives_in_the_core_are_those_in_python(signal, rng, tmp_path):
    """Of slots of any number of steps."""
    harness = tmp_path / "harness.c"
    harness.write_text(
        f'#include "{SOURCE}"\n'
        "int second(const ctmhe_stage *s, const double **a, double *work) {\n"
        "  const slot_call c = {*a[0], *a[1], a[2], a[3], a[4], a[5], a[6], NULL, NULL, NULL};\n"
        "  return slot_curvature(s, &c, a[7], a[8], work);\n}\n"
        "size_t size(const ctmhe_stage *s) { return curvature_work_size(s); }\n"
    )
    core = load(build(tmp_path / "second.so", f"-I{SOURCE.parent}", source=harness))
    stage, n, size = CHAINED[signal], 5, 6
    functions = Functions(core, stage)
    core.size.restype = ctypes.c_size_t
    work = np.zeros(core.size(ctypes.byref(functions.structure)))
    arguments = *slots(rng, size), rng.normal(size=(size, 2)), rng.normal(size=(size, stage.q * 2))
    expected = stage.curvature(*arguments)
    for k in range(size):
        rows = [np.atleast_1d(a if i == 4 else a[k]).astype(float) for i, a in enumerate(arguments)]
        pointers = (ctypes.c_void_p * 9)(*(row.ctypes.data for row in rows))
        assert core.second(ctypes.byref(functions.structure), pointers, ctypes.c_void_p(work.ctypes.data)) == 0
        np.testing.assert_allclose(work[: n * n].reshape(n, n), expected[k], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("hold", ["point", "zero"])
@pytest.mark.parametrize("boxed", [False, True])
def test_all_solvers_find_the_same_in_slots_of_several_steps(hold, boxed, library, rng):
    """Irregular samples, an input, a parameter, bounds; the core evaluates expressions as tapes."""
    cost = DiscountedCost(P=np.diag([4.0, 4.0, 20.0]), Q=50.0, R=100.0, eta=0.7)
    bounds = Bounds(x={"angle": (-1.0, 0.7)}, p=(0.1, 0.35), residual=(-0.4, 0.4)) if boxed else None
    mhe = MHE(
        pendulum(), horizon=2.0, interval=0.4, integrator=RK4(STEP), cost=cost, bounds=bounds, hold=hold, solver="numpy"
    )
    state = mhe.control(mhe.init(x=[0.5, 0.2]), Input(0.0, [0.3]))
    state = mhe.control(state, Input(0.77, [-0.2]))
    for t in np.cumsum(rng.uniform(0.05, 0.3, 12)):
        sample = [np.sin(0.8 * np.cos(t)) + 0.05 * rng.normal(), -0.6 * np.cos(t) * np.sin(t) + 0.05 * rng.normal()]
        state = mhe.observe(state, Measurement(t, sample))
    window, notes = mhe._window(state, 1.93)
    assert not notes and len(set(mhe.stage.steps_of(window.mesh.h))) > 2
    guess = shifted_guess(mhe.stage, window)
    solvers = CompiledGaussNewton(mhe.stage, library), GaussNewton(mhe.stage), Ipopt(mhe.stage)
    found = [solver.solve(window, guess) for solver in solvers]
    assert all(solution.success for solution in found)
    for solution in found[:2]:
        assert solution.cost == pytest.approx(found[2].cost, rel=1e-8)
        np.testing.assert_allclose(solution.point.x, found[2].point.x, atol=1e-4)
    if boxed:
        assert np.abs(found[0].point.x_active).sum() + np.abs(found[0].point.y_active).sum() > 0


@pytest.mark.parametrize("interval", [None, 5 * STEP])
def test_values_on_a_tape_and_jacobians_that_are_too_long_for_one(interval, library, rng, monkeypatch):
    """Eight slots at once without derivatives, one by one with them: the same solution."""
    stage = StageFunction(pendulum(), RK4(STEP), signal=False, interval=interval)
    window, guess = window_of(stage, 12, rng, boxed=False, shared=False)
    window = replace(window, u0=rng.normal(size=(12, 1)), u1=rng.normal(size=(12, 1)))
    expected = CompiledGaussNewton(stage, library).solve(window, guess)
    monkeypatch.setattr(tape, "LARGE", (stage.value.n_instructions() + stage.derivative.n_instructions()) // 2)
    assert tape.tape_of(stage.value) is not None and tape.tape_of(stage.derivative) is None
    mixed = CompiledGaussNewton(stage, library).solve(window, guess)
    assert expected.success and mixed.cost == pytest.approx(expected.cost, rel=1e-12)
