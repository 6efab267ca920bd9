"""An FMU that fails in the middle of a run: the run finishes, what is affected is marked, the rest is as without it."""

import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe import (
    MHE,
    RK4,
    DiscountedCost,
    FmuModel,
    FmuPlant,
    Gaussian,
    Input,
    MaxInterval,
    SingleSample,
    simulate,
)
from ctmhe.types import Outcome
from fmus.build import build

LIMIT = 0.9  # rad; the kick takes the pendulum beyond it
DISCARD, ERROR, NAN, CRASH, HANG = 1, 2, 3, 4, 5


def run(failure: int, *, until: float = 15.0, kicked: float = 7.0, fmi: int = 2, isolated: bool | float = False):
    """A pendulum that swings, estimated with an FMU that fails where the angle exceeds the limit."""
    start = {"limit": LIMIT, "failure": failure} if failure else {}
    model = FmuModel(build("fails", fmi=fmi), outputs=["position"], start=start, isolated=isolated, check="fast")
    mhe = MHE(
        model,
        horizon=1.0,
        interval=0.1,
        integrator=RK4(0.05),
        cost=DiscountedCost(eta=0.5, P=1.0, Q=100.0, R_point=1e4),
        hold="point",
        compile="off",
    )
    with FmuPlant(build("pendulum", fmi=fmi)) as plant:
        found = simulate(
            plant,
            mhe,
            trigger=MaxInterval(0.05),
            until=until,
            guess=[0.4, 0.1],
            channel=SingleSample(),
            inputs=lambda t: np.array([6.0 if kicked <= t < kicked + 0.6 else 0.0]),
            disturbance={"v_position": Gaussian(0.01)},
            seed=3,
        )
    instances = model.evaluator().counts()[2]
    model.close()
    return found.solves_to_pandas(), instances


@pytest.fixture(scope="module")
def undisturbed():
    return run(0)[0]


@pytest.mark.parametrize("failure", [DISCARD, ERROR, NAN])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_run_of_300_samples_survives_an_fmu_that_fails_in_its_middle(undisturbed, failure, fmi):
    """Before: the same numbers. Meanwhile: marked. A horizon after the state has come back: as good as without."""
    events, instances = run(failure, fmi=fmi)
    assert len(events) == 300
    t, success = events["solve_time"].to_numpy(), events["success"].to_numpy()
    states = ["x_hat.angle", "x_hat.rate"]
    off = np.abs(events[states].to_numpy() - undisturbed[states].to_numpy()).max(axis=1)
    beyond = t[np.abs(undisturbed["x_hat.angle"].to_numpy()) > LIMIT]
    affected = t[~success]
    assert len(affected)
    assert beyond.min() - 0.1 <= affected.min()
    assert affected.max() <= beyond.max() + 1.5  # the horizon, and the way back
    assert (off[t < beyond.min() - 0.1] == 0.0).all() or fmi == 3
    assert off[success].max() < 0.05
    assert off[t > beyond.max() + 3.0].max() < 1e-4
    said = events["status"][~success]
    assert said.str.contains("could not be evaluated").all()
    assert said.str.contains(r"at t = .*x = \[").all()
    assert (instances > 1) == (failure == ERROR)


@pytest.mark.slow
def test_a_crash_in_a_worker_is_a_failed_evaluation():
    """The FMU lives in another process, which is replaced; the run ends like one with errors."""
    kwargs = dict(until=6.0, kicked=1.0)
    quiet, (events, instances) = run(0, **kwargs)[0], run(CRASH, isolated=True, **kwargs)
    success = events["success"].to_numpy()
    assert len(events) == len(quiet)
    assert instances > 1
    assert not success.all()
    assert success[-20:].all()
    assert events["status"][~success].str.contains("the worker process died at t = ").any()
    assert np.abs(events["x_hat.angle"] - quiet["x_hat.angle"]).iloc[-20:].max() < 1e-3


def test_a_hang_in_a_worker_is_a_failed_evaluation():
    """Told from slowness by the patience that the user gives."""
    model = FmuModel(build("fails", fmi=3), start={"limit": LIMIT, "failure": HANG}, isolated=0.5, check="off")
    evaluate = model.evaluator().evaluate
    good = evaluate(0.0, [0.5, 0.0], [0.0], np.zeros(2), [])
    with pytest.raises(FloatingPointError, match="did not answer in time at t = 2, x = "):
        evaluate(2.0, [1.0, 0.0], [0.0], np.zeros(2), [])
    again = evaluate(0.0, [0.5, 0.0], [0.0], np.zeros(2), [])
    for one, other in zip(good, again, strict=True):
        np.testing.assert_array_equal(one, other)
    model.close()


def test_an_estimate_outside_of_what_the_fmu_can_do_is_a_prediction():
    """No rung of the ladder gives numbers: the last state is held, and the status says where evaluation failed."""
    model = FmuModel(build("fails", fmi=2), start={"limit": LIMIT, "failure": ERROR}, check="off")
    cost = DiscountedCost(P=1e6, Q=100.0, R_point=1e4)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(0.05), cost=cost, hold="point", compile="off")
    state = mhe.control(mhe.init(x=[1.2, 0.0]), Input(0.0, [0.0]))
    state, estimate = mhe.estimate(state, 0.5)
    assert estimate.status.outcome is Outcome.PREDICTED
    assert not estimate.status.success
    assert "could not be evaluated" in " ".join(estimate.status.notes)
    assert np.isfinite(estimate.x).all()
    model.close()
