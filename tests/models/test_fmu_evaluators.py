"""Evaluators of FMUs: the same in C, through CasADi and in a process of its own; gone afterwards."""

import gc
import os
import subprocess
import sys
import threading
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe import CVODES, MHE, RK4, DiscountedCost, DiscreteModel, FmuModel, Input, Measurement
from ctmhe.errors import FmuBinaryError, FmuKindError, FmuUnsupportedError, InputError
from ctmhe.models.library import chua
from ctmhe.solvers.compiled import CompiledGaussNewton
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.transcription.problem import Guess
from fmus.build import build

POINT = (0.3, np.array([0.4, -0.3]), np.array([0.1]), np.array([0.01, 0.02]), np.array([4.3, 0.3]))


def pendulum(**arguments):
    return FmuModel(build("pendulum", fmi=arguments.pop("fmi", 2)), parameters=["k", "c"], **arguments)


def run(mhe, samples=12, u=0.2):
    """Estimates over irregular samples."""
    random = np.random.default_rng(5)
    state = mhe.control(mhe.init(x=[0.4, 0.1], p=mhe.model.p_start), Input(0.0, [u]))
    found, t = [], 0.0
    for _ in range(samples):
        t += random.uniform(0.02, 0.2)
        state = mhe.observe(state, Measurement(t, [0.4 * np.cos(2 * t) + 0.01 * random.normal()]))
        state, estimate = mhe.estimate(state, t)
        assert estimate.status.success
        found.append(np.concatenate([estimate.x, estimate.p]))
    return np.array(found)


def estimator(model, **options):
    p = len(model.p)
    cost = DiscountedCost(eta=0.5, P=np.diag([1.0, 1.0] + [5.0] * p), Q=50.0, R=1e3)
    return MHE(model, **{"horizon": 1.0, "interval": 0.1, "integrator": RK4(0.04), "cost": cost} | options)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("hold", ["zero", "point"])
def test_the_core_integrates_an_fmu_as_casadi_does(fmi, hold):
    """One Gauss-Newton step by the core's own RK4 and by NumPy over CasADi functions: values and Jacobians agree."""
    model = pendulum(fmi=fmi, output_noise=False)
    mhe = estimator(model, hold=hold, compile="off", max_iterations=1)
    assert isinstance(mhe._solver, CompiledGaussNewton)
    assert mhe.stage.method == "RK4"
    state = mhe.control(mhe.init(x=[0.4, 0.1], p=model.p_start), Input(0.0, [0.2]))
    for t in (0.05, 0.17, 0.4, 0.62):
        state = mhe.observe(state, Measurement(t, [0.4 * np.cos(2 * t)]))
    window, _ = mhe._window(state, 0.7)
    x = np.column_stack([np.linspace(0.4, 0.1, len(window.mesh) + 1), np.linspace(0.0, -0.5, len(window.mesh) + 1)])
    guess = Guess.of(x, np.zeros((len(window.mesh), 2)), model.p_start, 1)
    ours, theirs = mhe._solver.solve(window, guess), GaussNewton(mhe.stage, max_iterations=1).solve(window, guess)
    assert ours.iterations == theirs.iterations == 1
    for key in "xwp":
        np.testing.assert_allclose(getattr(ours.point, key), getattr(theirs.point, key), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(ours.y, theirs.y, rtol=1e-10, atol=1e-12)
    model.close()


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_isolated_fmu_gives_the_same_numbers(fmi):
    """Bit for bit, in values, Jacobians and estimates."""
    here, away = pendulum(fmi=fmi), pendulum(fmi=fmi, isolated=True)
    for mine, other in zip(here.evaluator().evaluate(*POINT), away.evaluator().evaluate(*POINT), strict=True):
        np.testing.assert_array_equal(mine, other)
    np.testing.assert_array_equal(run(estimator(here)), run(estimator(away)))
    here.close()
    away.close()


def test_disturbed_inputs_and_outputs_enter_as_they_say():
    """w of an input adds to its value, w of an output to the output; derivatives follow, also where u is given too."""
    model = pendulum(disturbances=["rate", "torque", "position"])
    assert model.w.names == ("w_rate", "w_torque", "v_position")
    assert model.w.units[1] == model.u.units[0]
    t, x, u, _, p = POINT
    w = np.array([0.02, 0.05, 0.3])
    dx, y, J = model.evaluator().evaluate(t, x, u, w, p)
    plain = pendulum()
    dx0, y0, J0 = plain.evaluator().evaluate(t, x, u + 0.05, np.array([0.0, 0.02]), p)
    np.testing.assert_allclose(dx, dx0, rtol=1e-15)
    np.testing.assert_allclose(y, y0 + 0.3, rtol=1e-15)
    np.testing.assert_allclose(J[:, [0, 1, 5, 6]], J0[:, [0, 1, 4, 5]])
    np.testing.assert_array_equal(J[:, 2], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(J[:, 4], [0.0, 0.0, 1.0])
    step = 1e-6
    high, low = (model.evaluator().evaluate(t, x, u, w + np.array([0, s, 0]), p)[0] for s in (step, -step))
    np.testing.assert_allclose(J[:2, 3], (high - low) / (2 * step), atol=1e-8)


def test_outputs_may_be_any_real_variable():
    """A derivative as an output has no directional derivative; its row is a difference, and right."""
    model = pendulum(outputs=["position", "der(rate)", "rate"])
    dx, y, J = model.evaluator().evaluate(*POINT)
    np.testing.assert_allclose(y[1:], [dx[1] - POINT[3][1], POINT[1][1]], rtol=1e-12)
    np.testing.assert_allclose(J[3, :2], J[1, :2], rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(J[4], [0, 1, 0, 0, 0, 0])


def test_a_stiff_fmu_and_a_chaotic_one_agree_with_their_python_models():
    """CVODES through CasADi's functions of the evaluator; Chua's circuit by RK4 in the core."""
    python, fmu = chua(noise=False), FmuModel(build("chua", fmi=3), inputs=[])
    cost = DiscountedCost(eta=0.5, P=1.0, Q=1e2, R=1e3)
    found = []
    for model in (python, fmu):
        for integrator in (RK4(0.02), CVODES(1e-10, 1e-12)):
            mhe = MHE(model, horizon=0.5, interval=0.1, integrator=integrator, cost=cost, compile="off")
            state = mhe.init(x=[0.6, 0.1, -0.5])
            for k in range(8):
                state = mhe.observe(state, Measurement(0.07 * k, [0.7 + 0.02 * k]))
            found.append(mhe.estimate(state, 0.5)[1].x)
    np.testing.assert_allclose(found[2], found[0], atol=1e-6)
    np.testing.assert_allclose(found[3], found[1], atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_co_simulation_is_a_step_map(fmi):
    """The FMU's steps are the Python model's, integrated finely; so are estimates in discrete time."""
    step, model = 0.1, FmuModel(build("co_simulation_only", fmi=fmi), step=0.1)

    def f(t, x, u, w, p):
        h = step / 100  # RK4 with steps of 1 ms, as the FMU does it
        for _ in range(100):
            k = []
            for reach in (0.0, 0.5, 0.5, 1.0):
                at = x + reach * h * k[-1] if k else x
                k.append(ca.vertcat(at[1], -4.0 * ca.sin(at[0]) - 0.5 * at[1] + u[0]))
            x = x + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
        return x + w

    names = dict(x=("angle", "rate"), u="torque", w=("w_angle", "w_rate"), y="position")
    python = DiscreteModel(f, lambda t, x, u, w, p: ca.sin(x[0]), step=step, **names)
    x, u = [0.4, -0.3], [0.1]
    ours, theirs = (np.array(m.dynamics(0, x, u, [0, 0], [])).ravel() for m in (model, python))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    np.testing.assert_allclose(
        np.array(model.dynamics.jacobian()(0, x, u, [0, 0], [], ours)[1]),
        np.array(python.dynamics.jacobian()(0, x, u, [0, 0], [], ours)[1]),
        atol=1e-7,
    )
    found = []
    for m in (model, python):
        cost = DiscountedCost(eta=0.9, P=1.0, Q=50.0, R=1e3)
        mhe = MHE(m, horizon=1.0, cost=cost, compile="off")
        state = mhe.control(mhe.init(x=[0.5, 0.0]), Input(0.0, [0.1]))
        for k in range(15):
            state = mhe.observe(state, Measurement(k * step, [0.4 * np.cos(0.2 * k)]))
            if k > 5:
                state, estimate = mhe.estimate(state, k * step)
                assert estimate.status.success
                found.append(estimate.x)
    np.testing.assert_allclose(found[: len(found) // 2], found[len(found) // 2 :], atol=1e-6)


def test_what_co_simulation_cannot_do_is_refused_with_the_reason():
    """No step; no way back; a step that the FMU does not take; a step map that depends on time."""
    with pytest.raises(FmuKindError, match="say step="):
        FmuModel(build("co_simulation_only", fmi=2))
    with pytest.raises(FmuKindError, match="canGetAndSetFMUstate"):
        FmuModel(build("no_saving", fmi=2), step=0.1)
    with pytest.raises(FmuKindError, match=r"steps of 0\.05 s only"):
        FmuModel(build("fixed_step", fmi=2), step=0.1)
    with pytest.raises(FmuUnsupportedError, match="another time"):
        FmuModel(build("switched_heater", fmi=2), kind="CoSimulation", step=100.0)
    with pytest.raises(InputError, match="step= is for co-simulation"):
        FmuModel(build("pendulum", fmi=2), kind="ModelExchange", step=0.1)
    with pytest.raises(InputError, match="check: expected one of"):
        FmuModel(build("pendulum", fmi=2), check="maybe")


def in_thread(function):
    """Run in another thread; return what it returns or raises."""
    answer = []

    def body():
        try:
            answer.append(function())
        except Exception as error:
            answer.append(error)

    thread = threading.Thread(target=body)
    thread.start()
    thread.join()
    return answer[0]


def test_threads_have_evaluators_of_their_own_where_the_fmu_allows():
    """Two threads, the same numbers; a single-instance FMU refuses the second thread with the reason."""
    model = pendulum()
    mhe = estimator(model)
    mine = run(mhe)
    np.testing.assert_array_equal(in_thread(lambda: run(mhe)), mine)
    single = FmuModel(build("single_instance", fmi=2))
    assert single.single_instance
    single.evaluator()
    assert isinstance(in_thread(single.evaluator), FmuUnsupportedError)
    single.close()
    again = FmuModel(build("single_instance", fmi=2))
    assert not isinstance(in_thread(again.evaluator), Exception)
    del again
    gc.collect()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_has_a_worker_of_its_own():
    """Parent and child ask at the same time and get their own answers; the parent's worker outlives the child."""
    model = pendulum(isolated=True)
    evaluate, worker = model.evaluator().evaluate, model.evaluator()._worker
    expected = evaluate(*POINT)[0]
    child = os.fork()
    if child == 0:
        right = all(np.array_equal(evaluate(*POINT)[0], expected) for _ in range(200))
        os._exit(0 if right else 1)
    other = (POINT[0], 2 * POINT[1], *POINT[2:])
    mine = [evaluate(*other)[0] for _ in range(200)]
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    np.testing.assert_array_equal(mine, np.tile(pendulum().evaluator().evaluate(*other)[0], (200, 1)))
    assert model.evaluator()._worker is worker
    assert worker.process.poll() is None
    model.close()


def test_after_close_a_model_says_so():
    """Its evaluator is gone, and so is the folder."""
    model = pendulum()
    folder = model._archive.folder
    model.close()
    assert not folder.exists()
    with pytest.raises(Exception, match="closed"):
        model.evaluator()


def test_a_binary_that_crashes_when_loaded_does_not_take_the_interpreter_along():
    """The error is raised here, in the process that asked."""
    for fmi in (2, 3):
        with pytest.raises(FmuBinaryError, match="crashes when it is loaded"):
            FmuModel(build("crashes_at_load", fmi=fmi))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_models_come_and_go_without_a_trace(tmp_path):
    """Load, estimate, close, 200 times in a process of its own: memory levels off, no folder and no file stays open."""
    code = f"""
import gc, os, resource, tempfile
tempfile.tempdir = {str(tmp_path)!r}
import numpy as np
from ctmhe import MHE, RK4, DiscountedCost, FmuModel, Input, Measurement
from fmus.build import build
path = build("pendulum", fmi=2)
def cycle():
    model = FmuModel(path, parameters=["k"], check="fast")
    mhe = MHE(model, horizon=0.5, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost(P=1.0, Q=10.0, R=100.0),
              compile="off")
    state = mhe.control(mhe.init(x=[0.4, 0.0]), Input(0.0, [0.0]))
    state = mhe.observe(state, Measurement(0.1, [0.4]))
    mhe.estimate(state, 0.2)
    model.close()
def pages():
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
for _ in range(100): cycle()
files, first = len(os.listdir("/proc/self/fd")), pages()
for _ in range(100): cycle()
print((pages() - first) / 100, len(os.listdir("/proc/self/fd")) - files, len(os.listdir({str(tmp_path)!r})))
"""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert answer.returncode == 0, answer.stderr
    slope, files, folders = map(float, answer.stdout.split())
    assert slope < 5_000  # bytes a cycle
    assert files == folders == 0
