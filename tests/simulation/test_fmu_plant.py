"""An FMU as plant follows the differential equation that it stands for, and comes back where it was."""

import gc
import itertools
import tempfile
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("fmpy")

from ctmhe.errors import FmuError, InputError
from ctmhe.simulation.fmu.plant import FmuPlant
from fmus.build import build

K1, K2 = 0.2, 0.0064


@pytest.fixture(scope="module", params=[2, 3], ids=["FMI2", "FMI3"])
def path(request):
    return build("batch_reactor", fmi=request.param)


def truth(x, start, end, d_pA=lambda t: 0.0, d_pB=lambda t: 0.0):
    """The reactor by SciPy, to 1e-12."""

    def f(t, x):
        rate = K1 * x[0] ** 2 - K2 * x[1]
        return [-2 * rate + d_pA(t), rate + d_pB(t)]

    return solve_ivp(f, (start, end), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def follow(plant: FmuPlant, times, u, w) -> None:
    for begin, end in itertools.pairwise(times):
        plant.advance(end, u(begin), u(end), w)


def test_model_exchange_follows_the_equation(path, integrator):
    """A ramp input, a disturbance on a derivative, noise on the output: 1e-7 after 50 restarts at rtol 1e-10."""
    with FmuPlant(path, parameters={"k1": K1}) as plant:
        assert plant.w.names == ("w_pA", "w_pB", "v_pressure")
        assert {"scikits.odes": "CVODE", "scipy": "LSODA"}[integrator] in plant.integrator
        plant.start(0.5, [2.5, 0.5])
        w = np.array([0.04, -0.01, 0.3])
        follow(plant, np.linspace(0.5, 1.5, 51), lambda t: np.array([0.1 * t, 0.02]), w)
        expected = truth([2.5, 0.5], 0.5, 1.5, lambda t: 0.1 * t + 0.04, lambda t: 0.01)
        np.testing.assert_allclose(plant.state(), expected, atol=1e-7)
        np.testing.assert_allclose(plant.output(np.array([0.15, 0.02]), w), expected.sum() + 0.3, atol=1e-7)


def test_co_simulation_follows_the_equation_at_second_order(path):
    """A varying input is held at its middle: ten times smaller steps give a hundred times smaller errors."""
    errors = []
    for step in (0.1, 0.01):
        with FmuPlant(path, kind="CoSimulation", disturbances=["d_pB"], parameters={"k1": K1}, step=step) as plant:
            assert (plant.u.names, plant.w.names) == (("d_pA",), ("d_pB", "v_pressure"))
            plant.start(0.0, {"pA": 2.5, "pB": 0.5})
            follow(plant, [0.0, 1.0], lambda t: np.array([2.0 * t]), np.array([0.02, 0.0]))
            expected = truth([2.5, 0.5], 0.0, 1.0, lambda t: 2.0 * t, lambda t: 0.02)
            errors.append(np.abs(plant.state() - expected).max())
    assert 50 < errors[0] / errors[1] < 200
    assert errors[1] < 2.0 * 0.01**2 / 10  # slope step^2 / 12 for a linear equation


def test_constant_input_needs_no_communication_steps(path):
    """A co-simulation goes straight to the next time, exactly as its own integrator does."""
    with FmuPlant(path, kind="CoSimulation", parameters={"k1": K1}) as plant:
        plant.start(0.0, [3.0, 1.0])
        plant.advance(1.7, np.array([0.1, 0.0]), np.array([0.1, 0.0]), np.zeros(1))
        np.testing.assert_allclose(plant.state(), truth([3.0, 1.0], 0.0, 1.7, lambda t: 0.1), atol=1e-8)


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_restore_brings_the_plant_back_exactly(path, integrator, kind):
    """Going on, and coming back and going on again, give the same bits."""
    with FmuPlant(path, kind=kind, disturbances=["d_pB"]) as plant:
        w, u = np.array([0.1, 0.0]), lambda t: np.array([0.2])
        follow(plant, [0.0, 0.3, 0.5], u, w)
        here, before = plant.checkpoint(), plant.state()
        follow(plant, [0.5, 0.6, 0.9], u, w)
        first = plant.state()
        plant.restore(here)
        np.testing.assert_array_equal(plant.state(), before)
        follow(plant, [0.5, 0.6, 0.9], u, w)
        np.testing.assert_array_equal(plant.state(), first)
        assert np.abs(first - before).max() > 0.1


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_restart_is_deterministic(path, kind):
    """`start` forgets everything, parameters of the last run included."""
    with FmuPlant(path, kind=kind, disturbances=["d_pB"], parameters={"k1": K1}) as plant:
        np.testing.assert_array_equal(plant.x_start, [3.0, 1.0])
        runs = []
        for p in (None, [0.3], {"k1": 0.3, "k2": 0.1}, None):
            plant.start(0.0, None, p)
            np.testing.assert_array_equal(plant.state(), plant.x_start)
            follow(plant, [0.0, 0.4, 1.0], lambda t: np.array([0.1]), np.array([0.05, 0.0]))
            runs.append(plant.state())
        np.testing.assert_array_equal(runs[0], runs[3])
        assert np.abs(runs[1] - runs[0]).max() > 0.01 and np.abs(runs[2] - runs[1]).max() > 0.01


def test_an_integration_that_goes_on_equals_one_that_restarts(path, integrator):
    """Constant inputs let CVODE go on; the result is that of one long integration within tolerance."""
    with FmuPlant(path, parameters={"k1": K1}) as plant:
        for times in ([0.0, 2.0], np.linspace(0.0, 2.0, 101)):
            plant.start(0.0, None)
            follow(plant, times, lambda t: np.zeros(2), np.zeros(3))
            np.testing.assert_allclose(plant.state(), truth([3.0, 1.0], 0.0, 2.0), atol=2e-8)


@pytest.mark.slow
def test_stiff_oscillator_is_followed_by_both_kinds():
    """Van der Pol: the FMU's own integrator and ours agree."""
    path = build("van_der_pol")
    ends = []
    for kind in ("ModelExchange", "CoSimulation"):
        with FmuPlant(path, kind=kind, disturbances=()) as plant:
            nothing = np.zeros(len(plant.u))
            plant.advance(1.0, nothing, nothing, np.zeros(len(plant.w)))
            ends.append(plant.state())
    np.testing.assert_allclose(ends[0], ends[1], rtol=1e-6, atol=1e-6)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A ball that keeps 0.8 of its speed when it hits the ground, as an FMU with one event indicator."""
    import fmpy

    dae = ca.DaeBuilder("ball")
    h, v, y = dae.add("h", {"start": 1.0}), dae.add("v"), dae.add("y", "output")
    dae.eq(dae.der(h), v)
    dae.eq(dae.der(v), -9.81)
    dae.eq(y, h)
    dae.when(h < 0, [dae.reinit("v", -0.8 * v)])
    folder = tmp_path_factory.mktemp("ball")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)  # CasADi writes into the working directory
        files = dae.export_fmu({"no_warning": True})
        headers = str(Path(fmpy.__file__).parent / "c-code")
        dae.pack_fmu(dae.compile_fmu(files, {"include_dirs": [headers]}), {"path": "ball.fmu"})
    return folder / "ball.fmu"


def test_state_events_are_located(ball, integrator):
    """Height and speed after two bounces are those of the parabola, within 1e-7."""
    first = np.sqrt(2 / 9.81)
    speed = 0.8 * 9.81 * first
    second = first + 2 * speed / 9.81
    with FmuPlant(ball, disturbances=()) as plant:
        plant.start(0.0, [1.0, 0.0])
        follow(plant, np.linspace(0.0, 1.5, 16), lambda t: np.zeros(0), np.zeros(1))
        after = 1.5 - second
        speed *= 0.8
        expected = [speed * after - 9.81 / 2 * after**2, speed - 9.81 * after]
        np.testing.assert_allclose(plant.state(), expected, atol=1e-7)
        with pytest.raises(FmuError, match="canGetAndSetFMUstate"):
            plant.restore(plant.checkpoint())


@pytest.mark.parametrize(
    ("arguments", "near"),
    [
        ({"inputs": ["dpA"]}, "d_pA"),
        ({"outputs": ["presure"]}, "pressure"),
        ({"states": ["pAA"]}, "pA"),
        ({"disturbances": ["dpB"]}, "d_pB"),
        ({"parameters": {"k11": 0.1}}, "k1"),
    ],
)
def test_unknown_names_suggest_the_nearest(path, arguments, near):
    """Every way to name a variable helps after a slip."""
    with pytest.raises(InputError, match=f"did you mean '{near}'"):
        FmuPlant(path, **arguments)


def test_bad_calls_are_told(path):
    """Going back in time, a wrong shape, an unknown kind, a plant that is closed."""
    with pytest.raises(InputError, match="kind must be"):
        FmuPlant(path, kind="Simulation")
    with pytest.raises(InputError, match="both inputs and disturbances"):
        FmuPlant(path, inputs=["d_pA"], disturbances=["d_pA"])
    plant = FmuPlant(path)
    nothing = np.zeros(2), np.zeros(2), np.zeros(3)
    plant.advance(1.0, *nothing)
    with pytest.raises(InputError, match="lies before"):
        plant.advance(0.5, *nothing)
    with pytest.raises(InputError, match="d_pA, d_pB"):
        plant.advance(1.5, np.zeros(3), np.zeros(2), np.zeros(3))
    plant.close()
    plant.close()
    with pytest.raises(FmuError, match="closed"):
        plant.state()


def test_a_failing_fmu_is_told_in_its_own_words(path):
    """A state that blows up: the error names the FMU, not an index."""
    with FmuPlant(path, kind="CoSimulation", disturbances=()) as plant:
        plant.start(0.0, [-1e200, 1.0])
        with pytest.raises(
            FmuError, match=r"batch_reactor: the step to t = 0.1 .*DoStep failed: discard.*finite numbers"
        ):
            plant.advance(1.0, np.zeros(2), np.zeros(2), np.zeros(1))
    with FmuPlant(path) as plant:
        plant.start(0.0, [-1e200, 1.0])
        with pytest.raises(FmuError, match="batch_reactor: the integration"):
            plant.advance(1.0, np.zeros(2), np.zeros(2), np.zeros(3))


def test_nothing_is_left_behind(path, tmp_path, monkeypatch):
    """The folder goes with close, with the context, and with the object."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with FmuPlant(path, kind="CoSimulation") as plant:
        kept = plant.checkpoint()
        assert len(list(tmp_path.iterdir())) == 1
    assert list(tmp_path.iterdir()) == []
    del kept
    holder = SimpleNamespace(plant=FmuPlant(path))
    holder.plant.advance(0.1, np.zeros(2), np.zeros(2), np.zeros(3))
    del holder
    gc.collect()
    assert list(tmp_path.iterdir()) == []
