"""An FMU that fails says when and where, and the plant stays usable."""

import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe.errors import FmuBinaryError, FmuError, FmuKindError, FmuParameterError, FmuUnsupportedError
from ctmhe.simulation.fmu.plant import FmuPlant
from fmus.build import build
from tests.simulation.paper import DISCARD, ERROR, FATAL, Paper, Refusal

SAVES = {"canGetAndSetFMUstate": "true", "canGetAndSetFMUState": "true"}


def go(plant, *times):
    u, w = np.zeros(len(plant.u)), np.zeros(len(plant.w))
    for t in times:
        plant.advance(t, u, u, w)


def failing(how):
    """dx/dt = 1, which cannot be evaluated beyond x = 0.5."""

    def rates(m):
        if m.x["x"] > 0.5:
            if how is None:
                return {"x": np.nan}
            raise Refusal(how, "fmi2GetDerivatives")
        return {"x": 1.0}

    return Paper(states={"x": 0.0}, rates=rates, offers=dict(SAVES))


@pytest.mark.parametrize("how", [DISCARD, None], ids=["discard", "NaN"])
def test_a_refused_evaluation_is_answered_by_a_smaller_step(on_paper, integrator, how):
    """Refusals now and then cost steps, not accuracy."""
    calls = []

    def rates(m):
        calls.append(m.t)
        if len(calls) in {10, 25, 40}:
            if how is None:
                return {"x": np.nan}
            raise Refusal(how)
        return {"x": -m.x["x"]}

    path, _ = on_paper(Paper(states={"x": 1.0}, rates=rates))
    with FmuPlant(path, disturbances=()) as plant:
        go(plant, 1.0)
        np.testing.assert_allclose(plant.state(), np.exp(-1.0), atol=1e-8)
    assert len(calls) > 40


@pytest.mark.parametrize("how", [DISCARD, ERROR, None], ids=["discard", "error", "NaN"])
def test_the_error_names_time_and_state(on_paper, integrator, how):
    """Where the way ends the message says so; then a checkpoint or a new start goes on."""
    path, journal = on_paper(failing(how))
    with FmuPlant(path, disturbances=()) as plant:
        go(plant, 0.2)
        here = plant.checkpoint()
        reason = {
            DISCARD: "GetDerivatives failed: discard",
            ERROR: "GetDerivatives failed: error",
            None: r"der\(x\) not",
        }
        with pytest.raises(
            FmuError, match=rf"paper: the integration stopped at t = [\d.]+, x = [\d.]+: .*{reason[how]}"
        ):
            go(plant, 1.0)
        plant.restore(here)  # also after an error, as the standard has it
        go(plant, 0.4)
        np.testing.assert_allclose(plant.state(), 0.4, atol=1e-9)
        with pytest.raises(FmuError):
            go(plant, 1.0)
        plant.start(0.0, None)
        go(plant, 0.3)
        np.testing.assert_allclose(plant.state(), 0.3, atol=1e-9)
        assert journal.alive == 1 and journal.made == (2 if how == ERROR else 1)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
@pytest.mark.parametrize(("failure", "told"), [(1, "cannot be evaluated"), (2, "an error happened"), (3, "finite")])
def test_compiled_fmus_fail_likewise(version, kind, failure, told):
    """Discard, error and NaN beyond an angle of 1 rad: told with the time, and the next run is that of a new plant."""
    values = {"limit": 1.0, "failure": failure}
    with FmuPlant(build("fails", version), kind=kind, disturbances=(), parameters=values) as plant:
        go(plant, 1.0)
        first = plant.state()
        plant.start(0.0, [0.5, 4.0])
        with pytest.raises(FmuError, match=rf"fails: the .* stopped at t = 0\..*{told}"):
            go(plant, 0.05, 1.0)
        plant.start(0.0, None)
        go(plant, 1.0)
        np.testing.assert_array_equal(plant.state(), first)


def test_after_an_error_no_call_reaches_the_fmu(on_paper):
    """The error is told again, with the advice to start anew."""
    path, _ = on_paper(failing(ERROR))
    with FmuPlant(path, disturbances=()) as plant:
        with pytest.raises(FmuError):
            go(plant, 1.0)
        with pytest.raises(FmuError, match=r"failed: error.*takes no more calls: start it again"):
            plant.state()


def test_after_a_fatal_error_nothing_is_called(on_paper):
    """Not even to free it, as the standard has it; `start` makes another instance."""
    path, journal = on_paper(failing(FATAL))
    with FmuPlant(path, disturbances=()) as plant:
        here = plant.checkpoint()
        with pytest.raises(FmuError, match="fatal"):
            go(plant, 1.0)
        with pytest.raises(FmuError, match="no more calls"):
            plant.restore(here)
        plant.start(0.0, None)
        go(plant, 0.3)
    assert journal.made == 2 and journal.alive == 1  # the first one is left alone for ever


@pytest.mark.parametrize("version", [2, 3])
def test_a_step_that_is_made_in_part_goes_on_from_there(on_paper, version):
    """A discarded step that reached 0.3 is no failure: the plant continues from the last successful time."""

    def step(m, h):
        if m.t < 0.3 < m.t + h:
            m.x["x"], m.t = m.x["x"] + 0.3 - m.t, 0.3
            raise Refusal(DISCARD)
        m.x["x"] += h
        return {}

    path, journal = on_paper(Paper(states={"x": 0.0}, step=step), version)
    with FmuPlant(path, kind="CoSimulation") as plant:
        go(plant, 1.0)
        np.testing.assert_allclose(plant.state(), 1.0, atol=1e-12)
    assert journal.steps == [(0.0, 1.0), (0.3, 0.7)]


@pytest.mark.parametrize("version", [2, 3])
def test_a_discarded_step_is_tried_in_smaller_ones(on_paper, version):
    """An FMU that makes steps of 0.2 s at most gets there; one that makes none is told with the time."""

    def step(m, h):
        if h > m.v["longest"]:
            raise Refusal(DISCARD, "doStep")
        m.x["x"] += h
        return {}

    path, _ = on_paper(Paper(states={"x": 0.0}, parameters={"longest": 0.2}, step=step), version)
    with FmuPlant(path, kind="CoSimulation", parameters={"longest": 0.2}) as plant:
        go(plant, 1.0)
        np.testing.assert_allclose(plant.state(), 1.0, atol=1e-12)
        plant.start(0.0, None, {"longest": 0.0})
        with pytest.raises(FmuError, match=r"the step to t = 2 stopped at t = 0: doStep failed: discard"):
            go(plant, 2.0)


def test_what_is_not_finite_is_told(on_paper):
    """A co-simulation that computes NaN and says OK: NaN would pass for a missing measurement."""
    model = Paper(states={"x": 0.0}, named=("y",), outputs=lambda m: {"y": m.x["x"]})
    model.step = lambda m, h: m.x.update(x=np.nan) or {}
    path, _ = on_paper(model)
    with FmuPlant(path, kind="CoSimulation") as plant:
        go(plant, 1.0)
        with pytest.raises(FmuError, match=r"paper: x = nan at t = 1"):
            plant.state()
        with pytest.raises(FmuError, match=r"paper: y = nan at t = 1"):
            plant.output(np.zeros(0), np.zeros(1))


def test_what_is_not_offered_is_told_by_kind():
    """A kind, going back in time, states of a co-simulation: each error has its type and says what to do."""
    with pytest.raises(FmuKindError, match="it offers CoSimulation"):
        FmuPlant(build("co_simulation_only"), kind="ModelExchange")
    with FmuPlant(build("no_saving")) as plant, pytest.raises(FmuUnsupportedError, match="canGetAndSetFMUstate"):
        plant.checkpoint()
    with pytest.raises(FmuUnsupportedError, match=r"'rate' cannot be disturbed.*input that is added to der\(rate\)"):
        FmuPlant(build("co_simulation_only"), disturbances=["rate"])


@pytest.mark.parametrize("version", [2, 3])
def test_steps_of_one_length_are_kept(version):
    """Multiples of the step give what one long way gives; anything else is told before the FMU is called."""
    with FmuPlant(build("fixed_step", version)) as plant:
        go(plant, *(0.05 * np.arange(1, 41)))
        ends = [plant.state()]
        plant.start(0.0, None)
        go(plant, 2.0)
        np.testing.assert_allclose(plant.state(), ends[0], atol=1e-12)
        with pytest.raises(FmuError, match="multiple"):
            go(plant, 2.02)


def test_start_values_that_are_refused_are_told(on_paper):
    """Before the initialization it is the value, in it the FMU."""
    model = Paper(states={"x": 0.0}, parameters={"k": 1.0})
    path, _ = on_paper(model)
    with FmuPlant(path, parameters={"k": 1.0}) as plant:
        model.update = lambda m: (_ for _ in ()).throw(Refusal(ERROR, "newDiscreteStates"))
        with pytest.raises(FmuError, match="newDiscreteStates failed: error"):
            plant.start(0.0, None)
        model.update = lambda m: {}
        plant.start(0.0, None)
        assert plant.state() == 0.0


@pytest.mark.parametrize("call", ["set_real", "exitInitializationMode"])
def test_each_call_of_the_initialization_has_its_error(on_paper, monkeypatch, call):
    """A refused value is a parameter's error, a refused initialization the binary's."""
    from tests.simulation.paper import Machine

    def refuse(*_):
        raise Refusal(ERROR, call)

    path, _ = on_paper(Paper(states={"x": 0.0}, parameters={"k": 1.0}))
    name = "fmi2SetReal" if call == "set_real" else call
    monkeypatch.setattr(Machine, name, refuse)
    expected = FmuParameterError if call == "set_real" else FmuBinaryError
    with pytest.raises(expected, match=f"{call}.* failed: error"):
        FmuPlant(path, parameters={"k": 2.0})


def test_inputs_go_with_their_slopes_where_the_fmu_takes_them(on_paper):
    """FMI 2's input derivatives make a ramp exact in a single step."""
    model = Paper(states={"x": 0.0}, inputs={"u": 0.0}, offers={"canInterpolateInputs": "true"})
    model.step = lambda m, h: m.x.update(x=m.x["x"] + h * m.v["u"] + h * h / 2 * m.slopes["u"]) or {}
    path, journal = on_paper(model)
    with FmuPlant(path, kind="CoSimulation") as plant:
        plant.advance(2.0, np.array([1.0]), np.array([3.0]), np.zeros(0))
        np.testing.assert_allclose(plant.state(), 4.0, atol=1e-12)
    assert len(journal.steps) == 1
