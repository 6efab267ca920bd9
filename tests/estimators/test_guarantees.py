"""Estimates with a guarantee: bounds that hold, conditions that are checked, states that keep them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.guarantee import Guarantee
from ctmhe.errors import InputError
from ctmhe.estimators import MHE
from ctmhe.models import ContinuousModel, DiscreteModel
from ctmhe.models.library import batch_reactor
from ctmhe.transcription import RK4
from ctmhe.types import Bounds, DiscountedCost, Measurement
from tests.conftest import P_REACTOR

MODEL = batch_reactor()
CERTIFICATE = DetectabilityCertificate(
    P_REACTOR, P_REACTOR, np.diag([1e3, 1e3, 1e2]), [[1e2]], 0.4, domain=replace(MODEL.bounds, w=None)
)
COST = DiscountedCost.from_certificate(CERTIFICATE)


def reactor(level=0.1, **changes) -> MHE:
    """The estimator of thesis 3.4.1 with its guarantee."""
    options = {"cost": COST, "bounds": MODEL.bounds, "hold": "zero", "guarantee": Guarantee(CERTIFICATE, level)}
    return MHE(MODEL, **{"horizon": 2.0, "interval": 0.05, "integrator": RK4(0.05), **options, **changes})


def observed(mhe, *, until=3.0, every=2, level=0.0, seed=0, estimate=True):
    """Feed the reactor's outputs at every cell, estimate after every few; return state, estimates and true states."""
    rng, x, state, found = np.random.default_rng(seed), np.array([3.0, 1.0]), mhe.init(x=[0.1, 4.5]), []
    none = np.empty(0)
    for k in range(round(until / 0.05)):
        w = level * rng.uniform(-1, 1, 3)
        state = mhe.observe(state, Measurement(k * 0.05, [x[0] + x[1] + w[2]]))
        if estimate and k and k % every == 0:
            state, result = mhe.estimate(state, k * 0.05)
            found.append((result, x))
        x, _ = mhe.stage.step(0.0, 0.05, x, w, none, none, none)
    return state, found


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), every=st.integers(1, 4), level=st.sampled_from([0.0, 1e-3, 0.05]))
def test_the_error_stays_below_its_bounds(seed, every, level):
    """In the norm and state by state; holding the output between records counts as noise of 0.07 bar at most."""
    _, found = observed(reactor(level=level + 0.07), every=every, level=level, seed=seed)
    for estimate, x in found:
        error, bound = estimate.x - x, estimate.bound
        assert CERTIFICATE.size(error) <= bound.size
        assert (np.abs(error) <= bound.radii).all()
        assert bound.level <= bound.theorem


def test_the_trajectory_has_bounds_too():
    """At a solve that of the estimate, and larger before it on its piece; none for an estimator without guarantee."""
    mhe = reactor()
    state, found = observed(mhe, until=2.5)
    last = found[-1][0]
    assert mhe.trajectory_bound(state, last.t) == pytest.approx(np.sqrt(last.bound.level))
    assert mhe.trajectory_bound(state, last.t - 0.05) > mhe.trajectory_bound(state, last.t)
    assert reactor(guarantee=None).trajectory_bound(state, last.t) is None


def test_known_parameters_must_lie_in_the_domain():
    """A rate constant beyond the certificate's box costs the bound, by name."""
    model = batch_reactor(parameters="k1")
    domain = replace(CERTIFICATE.domain, p={"k1": (0.1, 0.2)})
    certificate = replace(CERTIFICATE, domain=domain)
    mhe = MHE(
        model,
        horizon=2.0,
        interval=0.05,
        integrator=RK4(0.05),
        cost=COST,
        bounds=MODEL.bounds,
        hold="zero",
        guarantee=Guarantee(certificate, 0.1),
    )
    for k1, known in ((0.16, True), (0.3, False)):
        state = mhe.observe(mhe.init(x=[0.1, 4.5], p=[k1]), Measurement(0.0, [4.0]))
        bound = mhe.estimate(state, 0.1)[1].bound
        assert (bound.size is not None) == known and ("k1" in str(bound)) != known


def test_the_bound_gets_below_the_domains_width():
    """It starts with the domain, and tells more after a horizon."""
    _, found = observed(reactor(level=1e-3))
    sizes = [estimate.bound.size for estimate, _ in found]
    assert sizes[0] == pytest.approx(np.sqrt(found[0][0].bound.cap))
    assert "as wide as the domain" in str(found[0][0].bound)
    assert sizes[-1] < 0.7 * sizes[0] and "as wide" not in str(found[-1][0].bound)


@pytest.mark.parametrize("factor", [1e-3, 7.0])
def test_a_factor_on_all_weights_changes_no_bound_in_units(factor):
    """Remark 3.4: the certificate is scaled to the cost; radii in bar stay."""
    cost = DiscountedCost(P=factor * COST.P, Q=factor * COST.Q, R=factor * COST.R, eta=0.4)
    radii = [[e.bound.radii for e, _ in observed(mhe)[1]] for mhe in (reactor(), reactor(cost=cost))]
    assert np.allclose(radii[0], radii[1], rtol=1e-5)


def test_weights_of_ones_own_keep_a_bound():
    """Other weights, and slower fading, have a longer shortest horizon; the windows' bounds hold with them."""
    mhe = reactor(cost=DiscountedCost(P=2 * P_REACTOR, Q=[500, 500, 200], R=50, eta=0.5))
    assert mhe.guaranteed.unmet == () and mhe.guaranteed.bounds.certificate.ratio > 1
    scaled = mhe.guaranteed.bounds.certificate
    for estimate, x in observed(mhe)[1]:
        assert scaled.size(estimate.x - x) <= estimate.bound.size
        assert estimate.bound.theorem is None and "must exceed" in estimate.bound.reasons[0]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"hold": "point"}, "single samples of pressure"),
        ({"bounds": None}, "pA, pB may leave"),
        ({"bounds": replace(MODEL.bounds, x=(0.1, 6.0))}, "pA, pB may leave"),
        ({"cost": DiscountedCost(P=lambda t, T: 2 * P_REACTOR, Q=COST.Q, R=COST.R, eta=0.4)}, "weight P varies"),
        ({"cost": replace(COST, rate=None, prior_eta=0.9)}, "prior_eta = 0.9"),
        ({"cost": DiscountedCost(P=COST.P, Q=COST.Q, R=COST.R, eta=0.3)}, "only slower fading"),
        ({"cost": DiscountedCost(P=COST.P, Q=COST.Q, R=COST.R)}, "only slower fading"),
        ({"cost": DiscountedCost(P=COST.P, Q=COST.Q, R=0.0, eta=0.4)}, "R must be positive definite"),
        ({"max_iterations": 1}, "need not be a trajectory"),
    ],
)
def test_what_a_guarantee_lacks_is_named(changes, reason):
    """No bound, and the reason with every estimate."""
    mhe = reactor(**changes)
    _, found = observed(mhe, until=0.5)
    assert all(estimate.bound.size is None for estimate, _ in found)
    assert reason in str(found[0][0].bound)


def test_disturbances_beyond_the_certificate_are_no_guarantee():
    """Where the certificate holds for a box of w only, larger ones are named."""
    narrow = replace(CERTIFICATE, domain=MODEL.bounds)
    assert "leave the certificate's domain: w_pA" in " ".join(
        reactor(guarantee=Guarantee(narrow, 0.2)).guaranteed.unmet
    )


def test_a_guarantee_for_another_model_is_refused():
    """Sizes are compared when the estimator is built; numbers and names are checked."""
    other = DetectabilityCertificate(np.eye(3), np.eye(3), np.eye(3), np.eye(1), 0.4)
    with pytest.raises(InputError, match="3 states"):
        reactor(guarantee=Guarantee(other, 0.1))
    with pytest.raises(InputError, match="expected Guarantee"):
        reactor(guarantee=CERTIFICATE)
    with pytest.raises(InputError, match="disturbance"):
        reactor(guarantee=Guarantee(CERTIFICATE, {"w_pA": 0.1}))


def test_a_known_initial_error_tightens_the_bound():
    """`error` takes the place of what the domain leaves."""
    near = reactor(guarantee=Guarantee(CERTIFICATE, 0.1, error={"pA": 2.9, "pB": 3.5}))
    first = [observed(mhe, until=0.3)[1][0][0].bound.theorem for mhe in (near, reactor())]
    assert first[0] < first[1]


def test_doubt_costs_the_windows_that_reach_back_to_it():
    """While a lost message lies in the window there is no bound; behind it there is one again."""
    mhe = reactor()
    state, found = observed(mhe, until=1.0)
    assert found[-1][0].bound.certified
    state = mhe.doubt(state, 1.0, "a message was lost at t = 1 s")
    for t in np.arange(1.05, 4.0, 0.05):
        state = mhe.observe(state, Measurement(t, [3.5]))
        state, estimate = mhe.estimate(state, t)
        inside = t - 2.0 < 1.05 - 1e-9  # until the next record the last good one is held
        assert (estimate.bound.size is None) == inside
        assert ("lost at t = 1 s" in " ".join(estimate.bound.reasons)) == inside
    state = mhe.doubt(state, np.inf, "not the whole signal")
    assert mhe.estimate(state, 4.0)[1].bound.reasons == ("not the whole signal",)


def test_a_saved_state_keeps_its_bounds(tmp_path):
    """Going on from a file gives the bounds of never having stopped, doubts included."""
    mhe = reactor()
    state, _ = observed(mhe, until=2.5)
    for doubtful in (state, mhe.doubt(state, 1.5, "lost")):
        mhe.save(doubtful, tmp_path / "state.npz")
        loaded = mhe.load(tmp_path / "state.npz")
        pair = [mhe.estimate(s, 2.5)[1].bound for s in (doubtful, loaded)]
        assert pair[0].level == pair[1].level and pair[0].reasons == pair[1].reasons


def test_estimating_again_at_one_time_keeps_the_bound():
    """A repeated solve takes the first one's place in the recursion."""
    mhe = reactor()
    state, _ = observed(mhe, until=2.5)
    state, first = mhe.estimate(state, 2.5)
    state, again = mhe.estimate(state, 2.5)
    assert again.bound.level == pytest.approx(first.bound.level, rel=1e-6)
    assert len(state.track.ends) == len(set(state.track.ends))


def test_missing_values_cost_the_bound():
    """A record without a value, or without one of a sensor, is not the whole signal: windows with it have no bound."""
    mhe = reactor()
    state, _ = observed(mhe, until=1.0)
    state, estimate = mhe.estimate(mhe.observe(state, Measurement(1.0, [np.nan])), 1.0)
    assert estimate.bound.reasons == ("no output has a value at t = 1 s",)
    model = ContinuousModel(
        lambda t, x, u, w, p: [-x[0] + w[0]],
        lambda t, x, u, w, p: [x[0] + w[1], x[0] + w[2]],
        x=("x",),
        w=("w", "v0", "v1"),
        y=("y0", "y1"),
    )
    certificate = DetectabilityCertificate([[1.0]], [[1.0]], np.eye(3), np.eye(2), np.exp(-1.0))
    pair = MHE(
        model,
        horizon=2.0,
        interval=0.1,
        integrator=RK4(0.1),
        cost=DiscountedCost.from_certificate(certificate),
        hold="zero",
        guarantee=Guarantee(certificate, 0.1, error=1.0),
    )
    state = pair.observe(pair.init(x=[0.0]), Measurement(0.0, [0.1, 0.1]))
    assert pair.estimate(state, 0.2)[1].bound.size is not None
    half = pair.observe(state, Measurement(0.1, {"y0": 0.1}))
    assert pair.estimate(half, 0.2)[1].bound.reasons == ("no value of y1 at t = 0.1 s",)
    whole = pair.observe(half, Measurement(0.1, {"y1": 0.1}))
    assert pair.estimate(whole, 0.2)[1].bound.size is not None


def test_stretches_without_data_cost_the_bound():
    """Before the first record, and where a value has been held for longer than `hold_limit`, nothing is known."""
    late = reactor()
    state = late.observe(late.init(x=[0.1, 4.5]), Measurement(0.2, [4.0]))
    assert "from the window's start at 0 s on" in str(late.estimate(state, 0.5)[1].bound)
    forgetful = reactor(hold_limit=0.3)
    state = forgetful.observe(forgetful.init(x=[0.1, 4.5]), Measurement(0.0, [4.0]))
    assert forgetful.estimate(state, 0.3)[1].bound.size is not None
    assert "nothing is measured for 0.5 s" in str(forgetful.estimate(state, 0.5)[1].bound)


def test_a_doubt_at_the_start_counts():
    """A lost first message concerns every window that starts there."""
    mhe = reactor()
    state = mhe.doubt(mhe.init(x=[0.1, 4.5]), 0.0, "the first message was lost")
    state = mhe.observe(state, Measurement(0.0, [4.0]))
    assert mhe.estimate(state, 0.1)[1].bound.reasons == ("the first message was lost",)
    with pytest.raises(InputError, match="doubt: expected a time"):
        mhe.doubt(state, np.nan, "no time")


def test_what_comes_late_takes_back_what_was_solved_without_it():
    """Pieces solved before a late record or doubt are bounded by the domain only, and the theorem starts anew."""
    mhe = reactor(level=1e-3)
    state, _ = observed(mhe, until=3.0)
    cap = np.sqrt(mhe.guaranteed.bounds.cap)
    last = state.t
    assert mhe.trajectory_bound(state, last) < 0.9 * cap
    for later in (mhe.observe(state, Measurement(last - 0.025, [3.9])), mhe.doubt(state, last - 0.3, "wrong")):
        assert mhe.trajectory_bound(later, last) == pytest.approx(cap)
        assert mhe.trajectory_bound(later, last - 1.0) < 1.2 * cap and later.track.since == last


def test_another_configuration_starts_its_bounds_anew(tmp_path):
    """Levels of other weights, or of no guarantee, say nothing; other estimates may have left this one's domain."""
    scaled = DiscountedCost(P=100 * COST.P, Q=100 * COST.Q, R=100 * COST.R, eta=0.4)
    for other in (reactor(guarantee=None), reactor(cost=scaled)):
        state, _ = observed(other, until=2.5)
        other.save(state, tmp_path / "state.npz")
        mhe = reactor()
        state, estimate = mhe.estimate(mhe.load(tmp_path / "state.npz"), 2.5)
        assert estimate.bound.level <= mhe.guaranteed.bounds.cap * (1 + 1e-9)
        assert mhe.trajectory_bound(state, 1.0) is None


def test_a_model_without_noise_has_no_guarantee():
    """Holding the output between records has to be somebody's disturbance."""
    model = batch_reactor(noise=False)
    certificate = replace(CERTIFICATE, Q=np.diag([1e3, 1e3]))
    mhe = MHE(
        model,
        horizon=2.0,
        interval=0.05,
        integrator=RK4(0.05),
        cost=DiscountedCost.from_certificate(certificate),
        bounds=replace(MODEL.bounds, w=None),
        hold="zero",
        guarantee=Guarantee(certificate, 0.1),
    )
    assert "no measurement noise in every output" in " ".join(mhe.guaranteed.unmet)


def test_steps_without_a_measurement_cost_the_bound():
    """A discrete model's windows need the output of every step."""
    model = DiscreteModel(
        lambda t, x, u, w, p: [0.5 * x[0] + w[0]], lambda t, x, u, w, p: [x[0]], step=0.1, x=("x",), w=("w",), y=("y",)
    )
    certificate = DetectabilityCertificate([[1.0]], [[1.0]], [[2.0]], [[1.0]], 0.5, step=0.1)
    cost, guarantee = DiscountedCost.from_certificate(certificate), Guarantee(certificate, 0.1, error=1.0)
    mhe = MHE(model, horizon=1.0, cost=cost, guarantee=guarantee)
    state = mhe.init(x=[0.0])
    for k in (0, 1, 3):
        state = mhe.observe(state, Measurement(0.1 * k, [0.0]))
    assert mhe.estimate(state, 0.2)[1].bound.certified
    assert mhe.estimate(state, 0.4)[1].bound.reasons == ("1 steps of the window have no measurement",)


def test_without_guarantee_there_is_no_bound():
    """And nothing is kept for one."""
    state, found = observed(reactor(guarantee=None), until=0.3)
    assert found[0][0].bound is None and state.track is None


def test_an_unbounded_initial_error_says_so():
    """With neither a bounded domain nor `error` the reason asks for one of them."""
    free = replace(CERTIFICATE, domain=None)
    mhe = reactor(bounds=Bounds(x=(0.1, np.inf)), guarantee=Guarantee(free, 0.1))
    bound = observed(mhe, until=0.3)[1][0][0].bound
    assert bound.size is None and "Guarantee(error=)" in bound.reasons[0]
