"""Events of an FMU are located, hit, and handled as the standard has it, in both kinds."""

import itertools

import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe.errors import FmuError, FmuEventError
from ctmhe.simulation.fmu.plant import FmuPlant
from fmus.build import build
from tests.simulation.paper import Paper

G, E = 9.81, 0.7


@pytest.fixture(params=[2, 3], ids=["FMI2", "FMI3"])
def version(request):
    return request.param


def follow(plant, *times, u=(), w=()):
    for t in times:
        plant.advance(t, np.array(u, float), np.array(u, float), np.array(w, float))


def value(plant, *names):
    """Values of variables, whatever they are."""
    return plant.engine.get([plant.description.variables[name] for name in names], plant._now)


def bounce(t):
    """Height, velocity and number of bounces of the ball by its parabolas."""
    speed, begin, bounces = 0.0, -np.sqrt(2 / G), 0  # as if it had come up from the floor
    speed = -G * begin
    end = np.sqrt(2 / G)
    while t > end:
        speed, begin, bounces = E * speed, end, bounces + 1
        end = begin + 2 * speed / G
    s = t - begin
    return np.array([speed * s - G / 2 * s**2, speed - G * s, bounces])


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_a_ball_bounces_on_its_parabolas(version, kind, integrator):
    """State events of both kinds and versions: after three impacts the ball is where the parabolas are, within 1e-6."""
    with FmuPlant(build("bouncing_ball", version), kind=kind, disturbances=()) as plant:
        for t in (0.3, 1.0, 1.9):
            follow(plant, t, w=[0])
            np.testing.assert_allclose([*plant.state(), value(plant, "bounces")[0]], bounce(t), atol=1e-6)


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_events_that_accumulate_and_end_are_passed(version, kind):
    """The ball bounces ever faster and comes to rest: that is no chattering."""
    with FmuPlant(build("bouncing_ball", version), kind=kind, disturbances=()) as plant:
        follow(plant, 5.0, w=[0])
        np.testing.assert_array_equal([*plant.state(), *value(plant, "resting")], [0.0, 0.0, 1.0])


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_time_events_are_hit(version, kind, integrator):
    """The heater toggles each 300 s whatever the times of `advance`: equal to the exact response within 1e-6 K."""
    T, switched = 293.15, [(300, 1), (300, 0), (300, 1), (100, 0)]
    for span, on in switched:  # time constant R C = 1000 s, a rise of P R = 50 K
        rest = 293.15 + 50.0 * on
        T = rest + (T - rest) * np.exp(-span / 1000.0)
    with FmuPlant(build("switched_heater", version), kind=kind, disturbances=()) as plant:
        for times in ([1000.0], [100.0, 300.0, 300.0 + 1e-9, 599.0, 1000.0]):
            plant.start(0.0, None)
            follow(plant, *times, u=[293.15], w=[0])
            np.testing.assert_allclose(plant.state(), [T], atol=1e-6)


def test_a_time_event_sees_its_very_time(on_paper, integrator):
    """Time events are handled at the planned floating-point number, between, at and beyond the times of `advance`."""
    model = Paper(states={"x": 0.0}, rates=lambda m: {"x": m.v["slope"]}, discretes={"slope": 0.0})

    def update(m):
        count = round(m.t / 0.1)
        m.v["slope"] = float(count)
        return {"next": 0.1 * (count + 1)}

    model.update = update
    path, journal = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        follow(plant, 0.25, 0.1 * 3, 0.55)
        assert journal.events == [0.1 * k for k in range(1, 6)]
        np.testing.assert_allclose(plant.state(), 0.1 * (0 + 1 + 2 + 3 + 4) + 0.05 * 5, atol=1e-9)


def test_an_indicator_that_is_zero_at_the_start_is_watched(on_paper, integrator):
    """What is not positive when event mode is left is an event on becoming positive, also if it begins at zero."""
    model = Paper(states={"x": 0.0}, discretes={"above": 0.0}, indicators=2)
    model.rates = lambda m: {"x": 1.0}
    model.indicate = lambda m: [m.x["x"], m.x["x"] - 1.0]
    model.update = lambda m: m.v.update(above=float(sum(z > 0 for z in model.indicate(m)))) or {}
    path, journal = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        follow(plant, 0.5)
        assert value(plant, "above") == 1.0
        follow(plant, 2.0)
        assert value(plant, "above") == 2.0
    np.testing.assert_allclose(journal.events, [0.0, 1.0], atol=1e-9)


def test_events_of_several_indicators_come_in_their_order(on_paper, integrator):
    """Two relations switched by one oscillation: each sign change is one event, at the time of its root."""
    model = Paper(states={"x": 0.0, "y": 1.0}, indicators=2)
    model.rates = lambda m: {"x": m.x["y"], "y": -m.x["x"]}
    model.indicate = lambda m: [m.x["x"] - 0.5, m.x["y"] + 0.5]
    path, journal = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        follow(plant, 2 * np.pi)
    expected = np.pi * np.array([1 / 6, 2 / 3, 5 / 6, 4 / 3])  # sin t = 1/2, cos t = -1/2
    np.testing.assert_allclose(journal.events, expected, atol=1e-8)


def test_an_event_iteration_goes_on_until_nothing_changes(on_paper):
    """States that change in any round count, and the time event is that of the last round."""
    model = Paper(states={"x": 0.0}, discretes={"round": 0.0})

    def update(m):
        if m.t < 1.0:
            return {"next": 1.0}
        m.v["round"] += 1
        if m.v["round"] == 1:
            m.x["x"] = 5.0
            return {"again": True, "states": True, "next": 1.5}
        return {"next": None}

    model.update = update
    path, journal = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        follow(plant, 2.0)
        assert plant.state() == 5.0 and value(plant, "round") == 2.0 and journal.events == [1.0]


def test_an_endless_event_iteration_is_told(on_paper):
    """Discrete equations without a solution are an error with the time, not a hang."""
    path, _ = on_paper(
        Paper(states={"x": 0.0}, update=lambda m: {"again": m.t >= 1.0, "next": 1.0 if m.t < 1 else None})
    )
    with FmuPlant(path, disturbances=()) as plant, pytest.raises(FmuEventError, match=r"at t = 1 does not end"):
        follow(plant, 2.0)


def test_chattering_is_told(on_paper, integrator):
    """A relay that slides along its switching line: an error that names time, state and indicator."""
    model = Paper(states={"x": 0.25}, discretes={"sign": 1.0}, indicators=1)
    model.rates = lambda m: {"x": -m.v["sign"]}
    model.indicate = lambda m: [m.x["x"]]
    model.update = lambda m: m.v.update(sign=1.0 if m.x["x"] > 0 else -1.0) or {}
    path, _ = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        with pytest.raises(FmuEventError, match=r"accumulate at t = 0\.25.*, x = .*indicators 1 change"):
            follow(plant, 1.0)
        plant.start(0.0, None)
        follow(plant, 0.2)
        np.testing.assert_allclose(plant.state(), 0.05, atol=1e-9)


def test_tolerances_follow_nominals_that_change(on_paper):
    """An event that rescales a state from 1 to 1e-9: its motion is then resolved on that scale."""
    model = Paper(states={"x": 0.0, "y": 0.0}, discretes={"small": 0.0})

    def update(m):
        if m.t < 1.0:
            return {"next": 1.0}
        m.v["small"], m.x["x"], m.x["y"] = 1.0, 1e-9, 0.0
        return {"states": True, "nominals": True}

    model.update = update
    model.nominals = lambda m: [1e-9, 1e-9]
    model.rates = lambda m: {"x": m.x["y"], "y": -100.0 * m.x["x"]}
    path, _ = on_paper(model)
    with FmuPlant(path, disturbances=(), rtol=1e-8, atol=1e-8) as plant:
        follow(plant, 2.0)
        np.testing.assert_allclose(plant.state()[0], 1e-9 * np.cos(10.0), atol=1e-15)


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_an_input_that_jumps_is_an_event(on_paper, kind):
    """Discrete inputs change in event mode only, at the time of the jump, and are held in between."""
    model = Paper(states={"x": 0.0}, inputs={"u": 0.0, "d": 0.0}, sampled=("d",), offers={"hasEventMode": "true"})
    model.rates = lambda m: {"x": m.v["u"] + m.v["d"]}
    path, journal = on_paper(model, version=3)
    with FmuPlant(path, kind=kind, disturbances=()) as plant:
        for begin, end in itertools.pairwise([0.0, 1.0, 2.0, 3.0]):
            u = np.array([0.5, float(begin >= 2.0)])
            plant.advance(end, u, u, np.zeros(0))
        assert journal.events == [0.0, 2.0]
        np.testing.assert_allclose(plant.state(), 3 * 0.5 + 1.0, atol=1e-8)


def test_a_ramp_is_no_event(on_paper, integrator):
    """An input that goes on where it was does not enter event mode."""
    model = Paper(states={"x": 0.0}, inputs={"u": 0.0}, rates=lambda m: {"x": m.v["u"]})
    path, journal = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        for begin, end in itertools.pairwise(np.linspace(0.0, 1.0, 11)):
            plant.advance(end, np.array([begin]), np.array([end]), np.zeros(0))
        assert journal.events == []
        np.testing.assert_allclose(plant.state(), 0.5, atol=1e-9)


def test_every_accepted_step_is_reported(on_paper, integrator):
    """The FMU hears of its steps in order, at states on the solution, up to the end of every `advance`."""
    model = Paper(states={"x": 1.0}, rates=lambda m: {"x": -m.x["x"]})
    path, journal = on_paper(model)  # in FMI 2 an FMU needs to hear of steps unless it says that it does not
    with FmuPlant(path, disturbances=()) as plant:
        ends = np.linspace(0.0, 1.0, 8)[1:]
        follow(plant, *ends)
    times = [t for t, _ in journal.steps]
    assert (np.diff(times) > 0).all() and set(ends) <= set(times) and len(times) > 2 * len(ends)
    np.testing.assert_allclose([x["x"] for _, x in journal.steps], np.exp(-np.array(times)), atol=1e-8)


def test_no_step_is_reported_to_an_fmu_that_does_not_care(on_paper):
    """`completedIntegratorStepNotNeeded` saves the calls."""
    path, journal = on_paper(Paper(states={"x": 1.0}, offers={"completedIntegratorStepNotNeeded": "true"}))
    with FmuPlant(path, disturbances=()) as plant:
        follow(plant, 1.0)
    assert journal.steps == []


def test_a_step_may_ask_for_an_event(on_paper, integrator):
    """State switching: at the first step beyond 0.5 the FMU changes its state in event mode."""
    model = Paper(states={"x": 0.0}, discretes={"switched": 0.0}, rates=lambda m: {"x": 1.0})
    model.completed = lambda m: (m.x["x"] > 0.5 and not m.v["switched"], False)

    def update(m):
        if m.x["x"] <= 0.5:
            return {}
        m.x["x"], m.v["switched"] = m.x["x"] - 10.0, 1.0
        return {"states": True}

    model.update = update
    path, journal = on_paper(model)
    with FmuPlant(path, disturbances=()) as plant:
        follow(plant, 1.0)
        np.testing.assert_allclose(plant.state(), 1.0 - 10.0, atol=1e-9)
    assert len(journal.events) == 1 and 0.5 < journal.events[0] <= 1.0


def test_the_step_events_of_a_compiled_fmu_are_handled(version):
    """Every tenth step adds 0.1 to a load: ten steps an event, none forgotten."""
    with FmuPlant(build("completed_step", version), disturbances=()) as plant:
        follow(plant, 0.02, u=[0], w=[0])
        load, steps = value(plant, "load", "steps")
        assert load > 0.0 and 0 <= steps < 10


@pytest.mark.parametrize("where", ["update", "completed", "step"])
def test_an_fmu_that_ends_the_simulation_is_told(on_paper, where, version):
    """`terminateSimulation` is an error with the time, from event mode, from a step, from co-simulation."""
    model = Paper(states={"x": 0.0}, discretes={"ended": 0.0}, rates=lambda m: {"x": 1.0})
    if where == "update":
        model.update = lambda m: {"terminate": m.t >= 1.0, "next": 1.0 if m.t < 1.0 else None}
    elif where == "completed":
        model.offers = {"needsCompletedIntegratorStep": "true"}
        model.completed = lambda m: (False, m.x["x"] >= 1.0)
    else:
        model.step = lambda m, h: {"terminate": True} if version == 3 else discard_and_end(m)
    path, _ = on_paper(model, version)
    kind = "CoSimulation" if where == "step" else "ModelExchange"
    with FmuPlant(path, kind=kind, disturbances=()) as plant:
        with pytest.raises(FmuEventError, match=r"asks to end the simulation at t = \d"):
            follow(plant, 1.0, 2.0)
        plant.start(0.0, None)
        assert plant.state() == 0.0


def discard_and_end(m):
    """What FMI 2 does to end: a discarded step, and a status that says why."""
    from tests.simulation.paper import DISCARD, Refusal

    m.v["ended"] = 1.0
    raise Refusal(DISCARD)


def test_an_fmu_without_states_is_a_plant(on_paper):
    """Inputs, outputs, a clock and a comparison of time: events and outputs as with states."""
    model = Paper(inputs={"u": 0.0}, discretes={"held": 0.0, "late": 0.0}, named=("y",), indicators=1)
    model.outputs = lambda m: {"y": 2.0 * m.v["u"] + m.v["held"]}
    model.indicate = lambda m: [m.t - 1.3]

    def update(m):
        m.v["held"], m.v["late"] = np.floor(m.t + 1e-9), float(m.t > 1.3)
        return {"next": np.floor(m.t + 1e-9) + 1.0}

    model.update = update
    path, journal = on_paper(model)
    with FmuPlant(path) as plant:
        assert len(plant.x) == 0 and plant.integrator == "nothing to integrate"
        follow(plant, 2.5, u=[3.0], w=[0.0])
        np.testing.assert_allclose(plant.output(np.array([3.0]), np.array([0.5])), 6.0 + 2.0 + 0.5)
        assert value(plant, "late") == 1.0
    np.testing.assert_allclose(journal.events, [0.0, 1.0, 1.3, 2.0], atol=1e-12)


def test_co_simulation_goes_on_after_early_returns(on_paper):
    """FMI 3 without event mode: the FMU returns wherever it likes, the plant arrives nevertheless."""
    model = Paper(states={"x": 0.0})

    def step(m, h):
        h, early = min(h, 0.3), h > 0.3
        m.x["x"] += h
        m.t += h if early else 0.0
        return {"early": early}

    model.step = step
    path, _ = on_paper(model, version=3)
    with FmuPlant(path, kind="CoSimulation") as plant:
        follow(plant, 1.0)
        np.testing.assert_allclose(plant.state(), 1.0, atol=1e-12)


@pytest.mark.parametrize("early", [True, False])
def test_co_simulation_events_are_handled_where_they_happen(on_paper, early):
    """FMI 3 event mode: entered where the FMU asks for it, within a step or at its end, and left for the rest."""
    model = Paper(states={"x": 0.0}, discretes={"count": 0.0}, offers={"hasEventMode": "true"})

    def step(m, h):
        h = min(h, 0.4 - m.t) if m.t < 0.4 - 1e-12 and early else h
        m.x["x"] += h
        if early and m.t < 0.4 - 1e-12:
            m.t += h
            return {"early": True, "event": True}
        return {"event": not early}

    model.step = step
    model.update = lambda m: m.v.update(count=m.v["count"] + 1) or {}
    path, journal = on_paper(model, version=3)
    with FmuPlant(path, kind="CoSimulation") as plant:
        follow(plant, 1.0)
        np.testing.assert_allclose(plant.state(), 1.0, atol=1e-12)
        assert journal.events == [pytest.approx(0.4 if early else 1.0)] and value(plant, "count") == 2.0


def test_co_simulation_that_stays_where_it_is_is_told(on_paper):
    """Early returns without progress end in an error, not in a hang."""
    path, _ = on_paper(Paper(states={"x": 0.0}, step=lambda m, h: {"early": True}), version=3)
    with FmuPlant(path, kind="CoSimulation") as plant, pytest.raises(FmuError, match="returns early again and again"):
        follow(plant, 1.0)
