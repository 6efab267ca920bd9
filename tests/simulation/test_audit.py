"""Runs with guarantees: what is recorded, what channels cost, and both sides of the theorems."""

from dataclasses import replace

import numpy as np
import pytest

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.guarantee import Guarantee
from ctmhe.errors import InputError
from ctmhe.estimators import MHE
from ctmhe.models.library import batch_reactor
from ctmhe.simulation import Everything, Network, Run, SingleSample, Uniform, WholeSignal, simulate
from ctmhe.simulation.audit import audit
from ctmhe.transcription import RK4
from ctmhe.triggers import Certified, Periodic, Scheduled, SendOnDelta
from ctmhe.types import DiscountedCost
from tests.conftest import P_REACTOR

MODEL = batch_reactor()
CERTIFICATE = DetectabilityCertificate(
    P_REACTOR, P_REACTOR, np.diag([1e3, 1e3, 1e2]), [[1e2]], 0.4, domain=replace(MODEL.bounds, w=None)
)


def reactor(**changes) -> MHE:
    """The estimator of thesis 3.4.1, with a guarantee for |w| <= 0.1 and what holding the output adds."""
    options = {
        "horizon": 2.0,
        "interval": 0.02,
        "integrator": RK4(0.02),
        "cost": DiscountedCost.from_certificate(CERTIFICATE),
        "bounds": MODEL.bounds,
        "hold": "zero",
        "guarantee": Guarantee(CERTIFICATE, {"w_pA": 0.1, "w_pB": 0.1, "v_pressure": 0.13}),
    }
    return MHE(MODEL, **(options | changes))


def certified_run(level=0.1, mhe=None, until=4.0, **changes) -> Run:
    """A run from the thesis' wrong guess."""
    options = {"trigger": Certified(SendOnDelta(0.1), CERTIFICATE, 2.0), "disturbance": Uniform(level, interval=0.02)}
    return simulate(
        MODEL,
        mhe or reactor(),
        **(options | changes),
        until=until,
        guess=[0.1, 4.5],
        truth=[3.0, 1.0],
        monitor=0.02,
        seed=3,
    )


@pytest.mark.parametrize("level", [0.1, 1e-3, 0.0])
def test_neither_bound_is_crossed_and_a_bad_estimate_crosses_both(level):
    """(3.20) per window and (3.32) hold with the true disturbance; at weak ones open loop and a constant break them."""
    mhe = reactor()
    run = certified_run(level, mhe)
    found = audit(run, MODEL, CERTIFICATE)
    assert found["window_ratio"].max() <= 1 and found["theorem_ratio"].max() <= 1
    assert np.allclose(np.sqrt(found["error"]), run.error_size)
    assert (run.error_size <= run.window_bound).all() and (run.window_bound <= run.certified_bound).all()
    start = mhe.init(x=[0.1, 4.5])
    controls = {
        "open loop": lambda times: np.array([mhe.predict(start, float(t)).x for t in times]),
        "constant": lambda times: np.tile([0.1, 4.5], (len(times), 1)),
    }
    for candidate in controls.values():
        worst = audit(run, MODEL, CERTIFICATE, candidate=candidate)
        assert (worst["window_ratio"].max() > 1) == (level < 0.1)
        assert (worst["theorem_ratio"].max() > 1) == (level < 0.1)


def test_the_true_disturbance_gives_a_tighter_bound_than_its_limits():
    """The audit's right sides use what really happened, the run's bounds the worst that was stated."""
    run = certified_run()
    found = audit(run, MODEL, CERTIFICATE)
    assert (found["theorem"] <= run.certified_bound.to_numpy() ** 2 * (1 + 1e-9)).all()


def test_bounds_along_the_trajectory_are_kept():
    """Between solves the retrospective error stays below the bound of (3.20)."""
    run = certified_run()
    error = CERTIFICATE.size(run.retrospective_error().to_numpy())
    bound = run.retrospective_bound.to_numpy()
    known = np.isfinite(bound)
    assert known.sum() > 100 and (error[known] <= bound[known]).all()


def test_a_saved_run_keeps_its_bounds(tmp_path):
    """And the reasons."""
    run = certified_run(until=1.0)
    loaded = Run.load(run.save(tmp_path / "run.nc"))
    assert np.array_equal(loaded.certified_bound, run.certified_bound)
    assert loaded.uncertified == run.uncertified and "guarantee (given, evidence)" in repr(loaded)
    assert np.allclose(loaded.error_size, run.error_size)


def test_lost_messages_cost_the_guarantee_where_they_are_missing():
    """Windows that reach back to a lost message are uncertified, and say when it was lost; others are not."""
    channel = Network(WholeSignal(), loss=0.05)
    run = certified_run(until=12.0, trigger=Periodic(0.2), channel=channel)
    assert run.messages_lost > 0
    lost = [text for text in run.uncertified if "a message was lost" in text]
    assert 0 < len(lost) < run.solves
    assert np.isnan(run.window_bound[[bool(text) for text in run.uncertified]]).all()


def test_channels_that_send_less_are_named():
    """Single samples and delays have no guarantee; records as they are taken have one."""
    late = certified_run(until=1.0, channel=Network(WholeSignal(), delay=0.05))
    assert all("delays" in text for text in late.uncertified)
    single = certified_run(until=1.0, mhe=reactor(hold="point"), channel=SingleSample(), trigger=Periodic(0.1))
    assert all("single samples" in text and "SingleSample" in text for text in single.uncertified)
    assert set(certified_run(until=1.0, channel=Everything()).uncertified) == {""}


def test_a_wait_past_the_limit_is_reported_at_that_instant():
    """One long gap among short ones: uncertified there, certified before and after."""
    times = [0.1, 0.3, 0.4, 1.0, 1.2, 1.3, 1.6, 1.8]
    run = certified_run(until=2.0, trigger=Scheduled(times))
    assert [bool(text) for text in run.uncertified] == [t == 1.0 for t in times]
    assert "waited 0.6 s" in run.uncertified[3]


def test_without_a_guarantee_the_run_says_what_to_build():
    """As do audits and figures."""
    run = certified_run(until=0.5, mhe=reactor(guarantee=None))
    for ask in (lambda: run.certified_bound, lambda: audit(run, MODEL, CERTIFICATE), run.plot_bounds):
        with pytest.raises(InputError, match="guarantee"):
            ask()


def test_an_audit_needs_noise_that_explains_the_held_signal():
    """Without measurement noise in w the model cannot explain what was held, and the audit says so."""
    model = batch_reactor(noise=False)
    certificate = replace(CERTIFICATE, Q=np.diag([1e3, 1e3]), domain=model.bounds)
    mhe = MHE(
        model,
        horizon=2.0,
        interval=0.02,
        integrator=RK4(0.02),
        cost=DiscountedCost.from_certificate(certificate),
        bounds=model.bounds,
        hold="zero",
        guarantee=Guarantee(certificate, 0.1),
    )
    run = simulate(model, mhe, trigger=Periodic(0.1), until=0.5, guess=[1, 1], truth=[2, 1], monitor=0.02)
    with pytest.raises(InputError, match="measurement noise"):
        audit(run, model, certificate)


def test_the_figure_tells_bounds_errors_and_the_domain():
    """Lines for error, both bounds and the domain's width; marks where uncertified."""
    pytest.importorskip("matplotlib")
    run = certified_run(until=2.0, trigger=Scheduled([0.1, 0.3, 0.4, 1.0, 1.2]))
    axes = run.plot_bounds()
    labels = axes.get_legend_handles_labels()[1]
    assert [label[:10] for label in labels] == ["true error", "Theorem 3.", "window's b", "width of t", "uncertifie"]
    assert axes.get_yscale() == "log"
