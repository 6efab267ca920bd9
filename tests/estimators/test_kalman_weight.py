"""The prior weight that follows a Kalman filter: with it, a short window knows as much as a long one."""

from __future__ import annotations

import numpy as np
import pytest

from ctmhe import MHE, RK4, ContinuousModel, DiscountedCost, InputError, Measurement
from ctmhe.estimators.offline.linear import rauch_tung_striebel
from ctmhe.estimators.priors.kalman_weight import KalmanWeight
from ctmhe.models.library import batch_reactor
from ctmhe.studies.reproduce._offline import stepped
from tests.estimators.test_offline import linear_mhe, linear_record, reactor_mhe


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_with_its_weight_any_horizon_gives_the_kalman_predictor(steps):
    """Linear, prediction form: the estimate and its covariance are the Kalman predictor's, however short the window."""
    log, problem = linear_record(25)
    mhe = linear_mhe(S=None).changed(prior=KalmanWeight(), horizon=steps * 0.5)
    filtered = rauch_tung_striebel(problem, smooth=False).filtered
    ahead = filtered[:-1] @ problem.A.T + problem.b
    found = stepped(mhe, log, guess=np.ones(3))
    np.testing.assert_allclose([estimate.x for estimate in found[1:]], ahead, atol=1e-7)


def continuous(horizon: float, prior) -> MHE:
    """A mass on a spring whose position is measured now and then."""
    model = ContinuousModel(
        lambda t, x, u, w, p: [x[1], -x[0] - 0.2 * x[1] + w[0]], lambda t, x, u, w, p: x[0],
        x=("q", "v"), w="a", y="z", name="spring",
    )  # fmt: skip
    cost = DiscountedCost(P=np.diag([2.0, 1.0]), Q=5.0, R_point=40.0)
    integrator = RK4(0.05)
    return MHE(model, horizon=horizon, interval=0.1, integrator=integrator, cost=cost, hold="point", prior=prior)


def test_irregular_samples_are_remembered_in_continuous_time():
    """Irregular samples, a solve in every cell: a short window with the weight gives the full information estimate."""
    rng = np.random.default_rng(0)
    sampled = set(np.cumsum(rng.integers(1, 5, 25)).tolist())
    short, long = continuous(0.8, KalmanWeight()), continuous(np.inf, "filtering")
    states = [mhe.init(x=[0.5, 0.0]) for mhe in (short, long)]
    for k in range(60):
        t, y, found = k * 0.1, [np.sin(k * 0.1) + 0.1 * rng.normal()], []
        for i, mhe in enumerate((short, long)):
            state = mhe.observe(states[i], Measurement(t, y)) if k in sampled else states[i]
            states[i], estimate = mhe.estimate(state, t)
            found.append(estimate)
        np.testing.assert_allclose(found[0].x, found[1].x, atol=1e-6)
        np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-6, atol=1e-12)
    assert len(states[0].memory["covariances"]) < 12


def test_the_memory_is_saved_with_the_state(tmp_path):
    """Continue from a file: the same estimates to the last bit."""
    log, _ = linear_record(20)
    mhe = linear_mhe().changed(prior=KalmanWeight("turnpike"), horizon=2.0)
    state = mhe.init(x=np.ones(3))
    from ctmhe import Input

    for k, (t, y, u) in enumerate(zip(log.t.tolist(), log.y, log.u, strict=True)):
        if k == 12:
            mhe.save(state, tmp_path / "state.npz")
            other = mhe.load(tmp_path / "state.npz")
        state = mhe.observe(mhe.control(state, Input(t, u)), Measurement(t, y))
        state, estimate = mhe.estimate(state, t)
        if k >= 12:
            other = mhe.observe(mhe.control(other, Input(t, u)), Measurement(t, y))
            other, again = mhe.estimate(other, t)
            np.testing.assert_array_equal(estimate.x, again.x)


def test_what_a_filter_cannot_take_is_named():
    """Held outputs, estimated parameters, no prior at all, noise inside the model: refused, with what to do."""
    held = reactor_mhe().changed(hold="zero", prior=KalmanWeight(), cost=DiscountedCost(P=1.0, Q=1.0, R=1.0))
    with pytest.raises(InputError, match="pressure is held"):
        held.init(x=[3.0, 1.0])
    with pytest.raises(InputError, match="positive definite"):
        reactor_mhe().changed(prior=KalmanWeight()).init(x=[3.0, 1.0])
    options = {"horizon": 2.0, "interval": 0.1, "integrator": RK4(0.1), "hold": "point", "prior": KalmanWeight()}
    with pytest.raises(InputError, match="enters the outputs"):
        MHE(batch_reactor(), cost=DiscountedCost(), **options).init(x=[3.0, 1.0])
    joint = batch_reactor(noise=False, parameters="k1")
    with pytest.raises(InputError, match="parameters are estimated"):
        MHE(joint, cost=DiscountedCost(P=np.ones(3)), **options).init(x=[3.0, 1.0])
    with pytest.raises(InputError, match="prior must be"):
        MHE(batch_reactor(noise=False), cost=DiscountedCost(), **(options | {"prior": KalmanWeight("best")})).init(
            x=[3.0, 1.0]
        )
