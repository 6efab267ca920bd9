"""Plants: accurate, restartable, and clear about what they cannot do."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import InputError, MissingExtra, SolverError
from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.simulation import MapPlant, OdePlant
from ctmhe.simulation.integration import has_sundials
from ctmhe.simulation.plants import as_plant

BACKENDS = ["scikits.odes", "casadi"] if has_sundials() else ["casadi"]
OSCILLATOR = ContinuousModel(
    lambda t, x, u, w, p: [x[1] + w[0], -p[0] * x[0] + u[0]],
    lambda t, x, u, w, p: x[0] + w[1],
    x=("a", "b"),
    u="f",
    w=("d", "v"),
    p="k",
    y="y",
    p_start=[1.0],
    name="oscillator",
)
NONE, QUIET = np.zeros(1), np.zeros(2)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_plant_solves_its_differential_equation(backend):
    """x'' = -x + 0.1 t from (1, 0) has the solution cos t + 0.1 (t - sin t); negative times included."""
    plant = OdePlant(OSCILLATOR, backend=backend)
    assert backend in plant.integrator
    plant.start(-1.0, np.array([1.0, 0.0]))
    for k in range(50):
        plant.advance(-1.0 + 0.1 * (k + 1), np.array([0.01 * k]), np.array([0.01 * (k + 1)]), QUIET)
    assert plant.state()[0] == pytest.approx(np.cos(5) + 0.1 * (5 - np.sin(5)), abs=1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
@given(st.floats(0.01, 0.99), st.floats(-1, 1), st.floats(-1, 1))
@settings(max_examples=10, deadline=None)
def test_restore_brings_the_plant_back_exactly(backend, split, force, disturbance):
    """At the checkpoint the state is the same to the bit, and so is where the same drive leads from there."""
    plant = OdePlant(OSCILLATOR, backend=backend)
    plant.start(0.0, np.array([1.0, 0.0]))
    u, w = np.array([force]), np.array([disturbance, 0.0])
    plant.advance(0.3, u, 2 * u, w)
    there, state = plant.checkpoint(), plant.state().copy()
    ends = []
    for _ in range(2):
        plant.restore(there)
        np.testing.assert_array_equal(plant.state(), state)
        plant.advance(0.3 + split, 2 * u, u, w)
        ends.append(plant.state().copy())
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("backend", BACKENDS)
def test_splitting_an_advance_changes_nothing_but_rounding(backend):
    """Stops at monitoring times do not disturb the solution."""
    one, many = OdePlant(OSCILLATOR, backend=backend), OdePlant(OSCILLATOR, backend=backend)
    for plant, stops in ((one, 1), (many, 400)):
        plant.start(0.0, np.array([1.0, 0.0]), {"k": 2.0})
        for k in range(stops):
            plant.advance(4.0 * (k + 1) / stops, NONE, NONE, QUIET)
    exact = np.cos(np.sqrt(2.0) * 4.0)
    assert one.state()[0] == pytest.approx(exact, abs=1e-8)
    assert many.state()[0] == pytest.approx(exact, abs=1e-7)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_solution_that_ends_says_where(backend, capfd):
    """x' = x^2 from 1 has no solution beyond t = 1; nothing is printed."""
    model = ContinuousModel(lambda t, x, u, w, p: x**2, lambda t, x, u, w, p: x, x="x", y="y", name="escape")
    plant = OdePlant(model, backend=backend, rtol=1e-6, atol=1e-8)
    plant.start(0.0, np.array([1.0]))
    with pytest.raises(SolverError, match="between t = 0 and 2"):
        plant.advance(2.0, np.zeros(0), np.zeros(0), np.zeros(0))
    plant.start(0.0, np.array([1.0]))
    plant.advance(0.5, np.zeros(0), np.zeros(0), np.zeros(0))
    assert plant.state()[0] == pytest.approx(2.0, rel=1e-4)
    assert capfd.readouterr() == ("", "")


def test_measurement_noise_does_not_restart_the_solution(monkeypatch):
    """Only disturbances that enter f, and changes of the input's slope, begin a new solution."""
    plant = OdePlant(OSCILLATOR, backend="casadi")
    starts = []
    monkeypatch.setattr(plant._integration, "restart", lambda *a: starts.append(a))
    monkeypatch.setattr(plant._integration, "to", lambda t: np.zeros(2))
    plant.start(0.0, np.array([1.0, 0.0]))
    for k, (v, d, u) in enumerate([(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 1, 5), (3, 1, 5)]):
        plant.advance(float(k + 1), np.array([u]), np.array([u]), np.array([d, v], dtype=float))
    assert len(starts) == 3


def test_a_missing_backend_names_the_extra(monkeypatch):
    """scikits.odes asked for but absent."""
    monkeypatch.setitem(sys.modules, "scikits_odes_sundials.cvode", None)
    with pytest.raises(MissingExtra, match=r"ctmhe\[sundials\]"):
        OdePlant(OSCILLATOR, backend="scikits.odes")
    with pytest.raises(SolverError, match="'lsoda'"):
        OdePlant(OSCILLATOR, backend="lsoda")


def test_models_become_plants_and_nothing_else_does():
    """Continuous models are integrated, discrete ones mapped; wrong uses name the right one."""
    halving = DiscreteModel(lambda t, x, u, w, p: x / 2, lambda t, x, u, w, p: x, x="x", y="y", step=0.5)
    assert isinstance(as_plant(OSCILLATOR), OdePlant)
    assert isinstance(as_plant(halving), MapPlant)
    with pytest.raises(InputError, match="MapPlant"):
        OdePlant(halving)
    with pytest.raises(InputError, match="OdePlant"):
        MapPlant(OSCILLATOR)
    with pytest.raises(InputError, match="got str"):
        as_plant("plant")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="not started"):
        OdePlant(OSCILLATOR).state()
    with pytest.raises(InputError, match="truth"):
        OdePlant(OSCILLATOR).start(0.0, None)
