"""How far predictions can be from the truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.growth import Growth, predict_growth
from ctmhe.certificates.guarantee import Guarantee
from ctmhe.errors import InputError
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import batch_reactor
from ctmhe.types import Bounds


def certificate(P, model, **more):
    """Matrices of the right sizes; only P and the domain matter here."""
    return DetectabilityCertificate(
        P, P, np.eye(len(model.w)), np.eye(len(model.y)), 0.5, step=model.step, domain=model.bounds, **more
    )


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), seconds=st.floats(0.01, 1.5))
def test_no_pair_of_trajectories_parts_faster(seed, seconds):
    """A disturbed and an undisturbed reactor stay within the bound, for random starts and disturbances."""
    model, rng = batch_reactor(), np.random.default_rng(seed)
    root = rng.normal(size=(2, 2))
    P = root @ root.T + 0.1 * np.eye(2)
    growth = predict_growth(model, Guarantee(certificate(P, model), disturbance=0.1))
    assert growth.rigorous and growth.method == "vertices"
    x1, x2 = rng.uniform(1.0, 4.0, (2, 2))
    first, steps = np.sqrt((x1 - x2) @ P @ (x1 - x2)), 200
    for _ in range(steps):
        w = rng.choice([-0.1, 0.1], 3)
        x1, x2 = rk4(model, x1, w, seconds / steps), rk4(model, x2, np.zeros(3), seconds / steps)
    assert np.sqrt((x1 - x2) @ P @ (x1 - x2)) <= growth.ahead(first, seconds) * (1 + 1e-6)


def rk4(model, x, w, h):
    """One step."""

    def f(x):
        return np.asarray(model.dynamics(0.0, x, [], w, [])).ravel()

    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3))


@given(
    rate=st.floats(-3, 3),
    push=st.one_of(st.just(0.0), st.floats(1e-3, 2)),
    size=st.one_of(st.just(0.0), st.floats(1e-3, 1)),
    target=st.floats(1.1, 5),
    step=st.sampled_from([None, 0.1]),
)
def test_the_time_to_a_level_is_when_it_is_reached(rate, push, size, target, step):
    """Before it the bound is below the target, and at it (a step later in discrete time) it has been reached."""
    if step is not None:
        rate = max(rate, -1.0)
    growth = Growth(rate, push, 1.0, step, "given", True)
    seconds = growth.time_to(target, size)
    if np.isinf(seconds):
        assert growth.ahead(size, 50.0) <= target * (1 + 1e-6)
    elif step is None:
        assert growth.ahead(size, seconds) == pytest.approx(target, rel=1e-6)
    else:
        assert growth.ahead(size, seconds) < target <= growth.ahead(size, seconds + step) * (1 + 1e-9)
    assert growth.time_to(size, target) == 0.0


def test_a_discrete_model_grows_by_steps():
    """x+ = 2 x + w doubles a distance and adds the disturbance."""
    model = DiscreteModel(
        lambda t, x, u, w, p: [2 * x[0] + w[0]], lambda t, x, u, w, p: [x[0]], step=0.5, x=("x",), w=("w",), y=("y",)
    )
    growth = predict_growth(model, Guarantee(certificate(np.eye(1), model), disturbance={"w": 0.1}))
    assert growth.ahead(1.0, 1.0) == pytest.approx(2 * (2 + 0.1) + 0.1)


def test_a_domain_without_bounds_is_named():
    """The signal on which the Jacobian depends is named."""
    model = ContinuousModel(
        lambda t, x, u, w, p: [x[0] ** 2 + w[0]],
        lambda t, x, u, w, p: [x[0]],
        x=("x",),
        w=("w",),
        y=("y",),
        bounds=Bounds(),
    )
    with pytest.raises(InputError, match="state 'x'"):
        predict_growth(model, Guarantee(certificate(np.eye(1), model), disturbance=1))
