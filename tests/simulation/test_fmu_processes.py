"""FMU plants in other processes: sent there as their configuration, or run there so that a crash does no harm."""

import pickle
import shutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe import MHE, RK4, DiscountedCost, FmuModel, Gaussian, MaxInterval, SendOnDelta, SingleSample, simulate
from ctmhe.errors import FmuBinaryError, FmuError, FmuEventError, InputError
from ctmhe.simulation.fmu.plant import FmuPlant
from fmus.build import build


def go(plant, *times):
    u, w = np.zeros(len(plant.u)), np.zeros(len(plant.w))
    for t in times:
        plant.advance(t, u, u, w)
    return plant.state()


@pytest.fixture
def child():
    """A plant of the trap `fails` in a process of its own."""
    opened = []

    def make(failure, **options):
        values = {"limit": 1.0, "failure": failure}
        opened.append(FmuPlant(build("fails"), disturbances=(), parameters=values, isolated=True, **options))
        return opened[-1]

    yield make
    for plant in opened:
        plant.close()


def test_a_plant_pickles_as_its_configuration():
    """The copy has the same signals, and the same numbers from its start on."""
    arguments = {"inputs": ["d_pA"], "disturbances": ["d_pB", "pA"], "states": ["pB"], "parameters": {"k1": 0.3}}
    with FmuPlant(build("batch_reactor"), rtol=1e-8, **arguments) as plant:
        go(plant, 0.5)
        with pickle.loads(pickle.dumps(plant)) as copy:
            for kind in ("x", "u", "w", "y", "p"):
                assert getattr(copy, kind).names == getattr(plant, kind).names
            assert copy.integrator == plant.integrator
            plant.start(0.0, None)
            np.testing.assert_array_equal(go(copy, 0.5, 1.0), go(plant, 0.5, 1.0))


def test_a_file_that_changed_is_not_the_plant(tmp_path):
    """A pickle says which file it means; another one under its name is refused."""
    path = shutil.copy(build("batch_reactor"), tmp_path / "plant.fmu")
    with FmuPlant(path) as plant:
        data = pickle.dumps(plant)
    shutil.copy(build("van_der_pol"), path)
    with pytest.raises((FmuError, InputError)):
        pickle.loads(data)
    shutil.copy(build("batch_reactor", 3), path)  # the same names
    with pytest.raises(FmuError, match="has changed since the plant was pickled"):
        pickle.loads(data)


@pytest.mark.slow
def test_workers_give_the_numbers_of_this_process():
    """Two plants in two worker processes, each with its seed: the runs are those made here, bit for bit."""
    path = build("batch_reactor", 3)
    model = FmuModel(path, inputs=[], output_noise=False)
    cost = DiscountedCost(P=0.1, Q=1e3, R_point=1e4)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(step=0.05), cost=cost, hold="point")
    options = {
        "trigger": SendOnDelta(0.05) | MaxInterval(0.5),
        "until": 1.0,
        "guess": [2.5, 1.5],
        "channel": SingleSample(),
        "disturbance": {"v_pressure": Gaussian(0.01)},
    }
    plants = [FmuPlant(path, inputs=[]), FmuPlant(path, kind="CoSimulation", inputs=[], step=0.02)]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        there = [pool.submit(simulate, plant, mhe, seed=seed, **options) for seed, plant in enumerate(plants)]
        for seed, (plant, future) in enumerate(zip(plants, there, strict=True)):
            here = simulate(plant, mhe, seed=seed, **options)
            there_run = future.result()
            for name in ("x_true", "x_online", "sample_time"):
                np.testing.assert_array_equal(there_run.dataset[name], here.dataset[name])
            plant.close()
    model.close()


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
def test_an_isolated_plant_gives_the_same_numbers(kind):
    """State, output, checkpoints and parameters pass through the pipe without a loss."""
    results = []
    for isolated in (False, True):
        with FmuPlant(build("bouncing_ball", 3), kind=kind, isolated=isolated, parameters={"e": 0.8}) as plant:
            go(plant, 0.3, 0.9)
            here = plant.checkpoint()
            numbers = [go(plant, 1.7), plant.output(np.zeros(0), np.full(len(plant.w), 0.5))]
            plant.restore(here)
            numbers += [plant.state(), go(plant, 1.7)]
            plant.start(0.5, [2.0, 0.0], {"e": 0.5})
            results.append(np.concatenate([*numbers, go(plant, 2.0)]))
    np.testing.assert_array_equal(*results)


def test_a_crash_ends_the_child_only(child):
    """An aborting binary is an error that says so; what follows says what to do; `start` begins again."""
    plant = child(4)
    first = go(plant, 1.0)
    plant.start(0.0, [0.5, 4.0])
    with pytest.raises(FmuBinaryError, match=r"binary of fails ended its process during advance \(signal SIGABRT\)"):
        go(plant, 0.05, 1.0)
    with pytest.raises(FmuBinaryError, match="call start"):
        plant.state()
    plant.start(0.0, None)
    np.testing.assert_array_equal(go(plant, 1.0), first)


def test_a_hang_ends_after_the_timeout(child):
    """A binary that does not come back is ended; the plant starts again."""
    plant = child(5, timeout=2.0)
    plant.start(0.0, [0.5, 4.0])
    with pytest.raises(FmuBinaryError, match="did not come back from advance within 2 s"):
        go(plant, 1.0)
    plant.start(0.0, None)
    assert np.isfinite(go(plant, 1.0)).all()


def test_a_crash_at_load_is_told():
    """The plant cannot be built; this process is as before."""
    with pytest.raises(FmuBinaryError, match="crashes_at_load ended its process during start"):
        FmuPlant(build("crashes_at_load"), isolated=True)


def test_errors_keep_their_types_on_the_way(child):
    """What the FMU says in its process is raised here as it would be here, and does not end the process."""
    plant = child(2)
    process = plant.engine._process
    plant.start(0.0, [0.5, 4.0])
    with pytest.raises(FmuError, match=r"fails: the integration stopped at t = .*an error happened"):
        go(plant, 1.0)
    plant.start(0.0, None)
    assert plant.engine._process is process
    old = plant.checkpoint()
    plant.start(0.0, None)
    with pytest.raises(FmuError, match="the run that saved it"):
        plant.restore(old)
    assert not issubclass(FmuBinaryError, FmuEventError)


def test_checkpoints_in_the_child_go_with_those_here(child):
    """The child is told which checkpoints are not wanted any more with the next request."""
    plant = child(0)
    kept = plant.checkpoint()
    for _ in range(50):
        plant.checkpoint()
    assert len(plant.engine._forgotten) <= 1
    plant.restore(kept)


def test_closing_ends_the_child(child):
    """With `close`, and with the object."""
    plant = child(0)
    process = plant.engine._process
    plant.close()
    assert process.returncode == 0
    with pytest.raises(FmuError, match="closed"):
        plant.state()
    other = FmuPlant(build("fails"), isolated=True)
    process = other.engine._process
    del other
    assert process.returncode == 0
