"""Policies that keep a certificate's conditions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.growth import Growth, predict_growth
from ctmhe.certificates.guarantee import Guarantee
from ctmhe.errors import InputError
from ctmhe.estimators import MHE
from ctmhe.models import ContinuousModel
from ctmhe.simulation import Everything, Uniform, simulate
from ctmhe.transcription import RK4
from ctmhe.triggers import BoundSelfTriggered, Certified, MinInterval, Periodic, SendOnDelta
from ctmhe.types import Bounds, DiscountedCost

RATE = 1.0
WELL = ContinuousModel(
    lambda t, x, u, w, p: [-RATE * x[0] - x[0] ** 3 + w[0]],
    lambda t, x, u, w, p: [x[0] + w[1]],
    x=("x",),
    w=("w", "v"),
    y=("y",),
    bounds=Bounds(x=(-2, 2), w=(-0.1, 0.1)),
    name="well",
)
# 2 e (-e - (x1^3 - x2^3) + dw) <= -2 e^2 + e^2 + dw^2: eta = 1 / e, P = 1, Q = 1; noise and output may weigh anything
WELL_CERTIFICATE = DetectabilityCertificate(
    [[1.0]], [[1.0]], np.diag([1.0, 1.0]), [[1.0]], np.exp(-RATE), domain=Bounds(x=(-2, 2)), rigorous=True
)


def well(horizon=4.0, disturbance=0.02) -> MHE:
    """An estimator of the contracting plant with its guarantee."""
    return MHE(
        WELL,
        horizon=horizon,
        interval=0.1,
        integrator=RK4(0.1),
        cost=DiscountedCost.from_certificate(WELL_CERTIFICATE),
        bounds=WELL.bounds,
        hold="zero",
        guarantee=Guarantee(WELL_CERTIFICATE, disturbance),
    )


@given(horizon=st.floats(1.5, 20), share=st.floats(0.01, 0.99))
def test_the_declared_wait_keeps_the_theorem(horizon, share):
    """Whatever the policy, the wait is below what (3.29) allows, and rho below one."""
    policy = Certified(SendOnDelta(0.5), WELL_CERTIFICATE, horizon)
    limit = WELL_CERTIFICATE.longest_wait(horizon)
    assert policy.longest_wait == pytest.approx(0.9 * limit) and policy.rho < 1
    shorter = Certified(SendOnDelta(0.5), WELL_CERTIFICATE, horizon, wait=share * limit)
    assert shorter.longest_wait == pytest.approx(share * limit)
    assert f"{limit:.4g} s (3.29)" in shorter.conditions[0] and len(shorter.conditions) == 6


def test_horizons_and_waits_that_guarantee_nothing():
    """Both limits are named; (3.30) is ln 4 here."""
    with pytest.raises(InputError, match=r"must exceed 1\.386 s"):
        Certified(Periodic(0.1), WELL_CERTIFICATE, 1.2)
    with pytest.raises(InputError, match=r"must stay below 0\.6137 s"):
        Certified(Periodic(0.1), WELL_CERTIFICATE, 2.0, wait=0.7)
    with pytest.raises(InputError, match="horizon"):
        Certified(Periodic(0.1), WELL_CERTIFICATE, -1.0)


def test_a_silent_policy_is_overruled_in_time():
    """A threshold that is never reached samples at the longest wait, and every solve is certified."""
    policy = Certified(SendOnDelta(1e9), WELL_CERTIFICATE, 4.0)
    run = simulate(WELL, well(), trigger=policy, until=12.0, guess=[1.0], truth=[-1.0], disturbance=Uniform(0.01))
    assert run.gaps[1:] == pytest.approx(policy.wait)
    assert set(run.uncertified) == {""} and np.isfinite(run.certified_bound).all()
    assert (run.error_size <= run.certified_bound).all()


def test_a_held_back_wait_is_reported_where_it_happens():
    """A dead time past the limit makes the solves after it uncertified, with the seconds that it waited."""
    dead = Certified(SendOnDelta(0.0), WELL_CERTIFICATE, 4.0) & MinInterval(2.7)
    run = simulate(WELL, well(), trigger=dead, until=9.0, guess=[1.0], truth=[-1.0])
    late = run.gaps > WELL_CERTIFICATE.longest_wait(4.0)
    assert late.any() and np.isnan(run.certified_bound[late]).all()
    assert all("waited 2.7 s" in text for text, is_late in zip(run.uncertified, late, strict=True) if is_late)
    assert np.isfinite(run.window_bound).all()  # (3.20) does not mind


def test_the_error_stays_below_the_wanted_level():
    """Self-triggered by the bound: once it is below the level, online errors stay below it until the next sample."""
    mhe = well()
    growth = predict_growth(WELL, mhe.guaranteed.guarantee)
    assert growth.rigorous and growth.rate <= -RATE + 1e-9
    policy = BoundSelfTriggered(0.5, Growth(0.3, growth.push, 1.0, None, "given", True), longest=2.0, shortest=0.05)
    run = simulate(
        WELL,
        mhe,
        trigger=policy,
        until=15.0,
        guess=[1.0],
        truth=[-1.5],
        disturbance=Uniform(0.01),
        channel=Everything(),
    )
    waits, sizes = run.gaps[1:], run.window_bound.to_numpy()[:-1]
    assert (waits[sizes >= 0.5] == pytest.approx(0.05)) and (sizes < 0.5).any()
    assert waits.max() > 0.2
    error = np.abs(run.online_error().to_numpy()[:, 0])
    safe = np.searchsorted(run.sample_times, run.t, side="right") - 1
    promised = sizes[np.minimum(safe, len(sizes) - 1)] < 0.5
    assert promised.any() and (error[promised] < 0.5).all()


def test_a_bound_is_needed_to_wait_for_it():
    """Without a guarantee the policy says what to build; without a bound it samples at the shortest wait."""
    growth = predict_growth(WELL, Guarantee(WELL_CERTIFICATE, 0.1))
    policy = BoundSelfTriggered(0.5, growth, longest=1.0, shortest=0.1)
    assert policy.longest_wait == 1.0
    bare = MHE(WELL, horizon=4.0, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost(), hold="zero")
    with pytest.raises(Exception, match="no guarantee"):
        simulate(WELL, bare, trigger=policy, until=1.0, guess=[0.0], truth=[0.1])
    short = well(horizon=1.2)
    run = simulate(WELL, short, trigger=policy & MinInterval(0.1), until=1.0, guess=[0.0], truth=[0.1])
    assert np.isnan(run.certified_bound).all()
    with pytest.raises(InputError, match="shortest must not exceed"):
        BoundSelfTriggered(0.5, growth, longest=0.1, shortest=0.2)
