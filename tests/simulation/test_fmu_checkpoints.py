"""Going back is exact, starting again too, and neither leaves anything behind."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("fmpy")

from ctmhe.errors import FmuError
from ctmhe.simulation.fmu.plant import FmuPlant
from fmus.build import build
from tests.simulation.paper import ERROR, Paper, Refusal

SAVES = {"canGetAndSetFMUstate": "true", "canGetAndSetFMUState": "true"}
PLANTS = [
    (name, version, kind)
    for name in ("batch_reactor", "bouncing_ball", "switched_heater")
    for version in (2, 3)
    for kind in ("ModelExchange", "CoSimulation")
]


@cache
def plant_of(name, version, kind):
    """One plant for all examples: starting again is part of what is tested."""
    return FmuPlant(build(name, version), kind=kind)


def follow(plant, start, schedule, scale):
    """Follow steps of (length, input, disturbance); return the states and outputs on the way."""
    t, seen = start, []
    for length, u0, u1, w in schedule:
        t += scale * length
        drive = [plant.u_start + 0.1 * u for u in (u0, u1)]
        disturbance = np.full(len(plant.w), 0.01 * w)
        plant.advance(t, *drive, disturbance)
        seen += [*plant.state(), *plant.output(drive[1], disturbance)]
    return np.array(seen)


numbers = st.floats(-1.0, 1.0, allow_subnormal=False)
schedules = st.lists(st.tuples(st.floats(1e-3, 0.4), numbers, numbers, numbers), min_size=1, max_size=4)


@pytest.mark.parametrize(("name", "version", "kind"), PLANTS)
@given(first=schedules, second=schedules)
def test_going_back_and_on_again_gives_the_same_bits(name, version, kind, first, second):
    """Whatever came before and after, with events or not: from the checkpoint on the numbers are the same."""
    plant, scale = plant_of(name, version, kind), 500.0 if name == "switched_heater" else 1.0
    plant.start(0.0, None)
    before = follow(plant, 0.0, first, scale)
    here, t = plant.checkpoint(), plant.engine.t
    after = follow(plant, t, second, scale)
    plant.restore(here)
    np.testing.assert_array_equal(follow(plant, t, second, scale), after)
    plant.start(0.0, None)
    np.testing.assert_array_equal(follow(plant, 0.0, first, scale), before)


@pytest.mark.parametrize(("name", "version", "kind"), PLANTS)
def test_a_plant_started_again_is_a_new_plant(name, version, kind):
    """Its numbers are those of a plant that was just built."""
    schedule = [(0.7, 0.5, -0.5, 1.0), (0.9, -0.5, -0.5, -1.0)]
    scale = 500.0 if name == "switched_heater" else 1.0
    old = plant_of(name, version, kind)
    old.start(0.0, None)
    with FmuPlant(build(name, version), kind=kind) as new:
        np.testing.assert_array_equal(follow(old, 0.0, schedule, scale), follow(new, 0.0, schedule, scale))


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_saved_states_are_freed(on_paper, kind):
    """After 10,000 checkpoints the FMU holds those that are still wanted, and its start."""
    path, journal = on_paper(Paper(states={"x": 0.0}, offers=SAVES))
    with FmuPlant(path, kind=kind) as plant:
        kept = [plant.checkpoint() for _ in range(10)]
        for _ in range(10_000):
            plant.checkpoint()
        assert journal.saved == len(kept) + 1
        kept.clear()
        assert journal.saved == 1
    assert journal.saved == 0 and journal.alive == 0


def test_an_fmu_that_saves_is_made_once(on_paper):
    """Its state as just made is kept, and brought back at each start."""
    path, journal = on_paper(Paper(states={"x": 0.0}, parameters={"k": 1.0}, offers=SAVES))
    with FmuPlant(path, parameters={"k": 1.0}) as plant:
        for k in (2.0, 3.0, 4.0):
            plant.start(k, None, {"k": k})
            assert plant.engine.get([plant.description.variables["k"]], np.zeros(0)) == k
    assert journal.made == 1


@pytest.mark.parametrize("what", ["nothing", "saving", "returning"])
def test_an_fmu_that_does_not_is_made_anew(on_paper, monkeypatch, what):
    """Without saving, or when it refuses to save or to return: a new instance each time, never two at a time."""
    from tests.simulation.paper import Machine

    def refuse(*_):
        raise Refusal(ERROR)

    if what != "nothing":
        monkeypatch.setattr(Machine, "getFMUState" if what == "saving" else "setFMUState", refuse)
    offers = {"canBeInstantiatedOnlyOncePerProcess": "true"} | ({} if what == "nothing" else SAVES)
    path, journal = on_paper(Paper(states={"x": 0.0}, rates=lambda m: {"x": 1.0}, offers=offers))
    with FmuPlant(path, disturbances=()) as plant:
        for _ in range(3):
            plant.start(0.0, None)
            plant.advance(1.0, np.zeros(0), np.zeros(0), np.zeros(0))
            np.testing.assert_allclose(plant.state(), 1.0, atol=1e-9)
            assert journal.alive == 1
    assert journal.alive == 0 and journal.made >= 4


def test_an_fmu_of_one_instance_a_process_starts_again():
    """The compiled one refuses a second instance: none is made, also where its state is not used."""
    with FmuPlant(build("single_instance")) as plant:
        for reuse in (True, False):
            plant.engine._runner._made = plant.engine._runner._made if reuse else None
            plant.start(0.0, None)
            np.testing.assert_array_equal(plant.state(), plant.x_start)


def test_a_checkpoint_is_good_for_its_run(on_paper):
    """After `start` made a new instance, a checkpoint of the old one is refused."""
    path, _ = on_paper(Paper(states={"x": 0.0}, offers=SAVES))
    with FmuPlant(path) as plant, FmuPlant(path) as other, pytest.raises(FmuError, match="the run that saved it"):
        plant.restore(other.checkpoint())
