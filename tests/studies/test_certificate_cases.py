"""The published certificates: what is printed, checked, and found again."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ctmhe.models.library import quadrotor
from ctmhe.studies.reproduce import thesis_3_4_1_certificate, thesis_3_4_2_certificate, thesis_printed_certificates


def test_the_reactor_certificate_is_found_again():
    """Our optimum is the printed P to its rounding; rate, horizon and wait follow from eta alone."""
    result = json.loads(json.dumps(thesis_3_4_1_certificate.reproduce()))
    published, ours = result["published"], result["ours"]
    np.testing.assert_allclose(ours["P"], published["P"], atol=1e-3)
    assert ours["rho"] == pytest.approx(4 ** (1 / (2 - 0.19)) * 0.4)
    assert ours["rho"] == pytest.approx(published["rho"], abs=5e-4)
    assert ours["t_min"] == pytest.approx(published["t_min"], abs=5e-3)
    assert ours["longest_wait"] > published["delta_bar"]
    assert -1e-4 < ours["printed_margin"] < 0 < ours["margin"]
    assert ours["method"] == "vertices" and ours["rigorous"]
    assert ours["pB_and_w_unbounded_change_P_by"] < 1e-6
    assert 0 < ours["best_eta"] < 0.4 and ours["best_eta_any_weights"] < ours["best_eta"]
    sizes = [row["smallest_eigenvalue_of_P"] for row in ours["faster"].values()]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] > 0


def test_printed_certificates_fail_by_their_rounding_only():
    """In continuous time the printed digits fail and matrices that round to them hold; in discrete time they hold."""
    result = json.loads(json.dumps(thesis_printed_certificates.reproduce()))
    discrete, continuous = (result["ours"][f"thesis 3.4.1, {kind} time"] for kind in ("discrete", "continuous"))
    assert discrete["margin"] > 0 and discrete["rigorous"] and discrete["smallest_eta"] < 0.91
    assert -1e-4 < continuous["margin"] < 0 < continuous["best_within_rounding_of_P"]
    assert 0.4 < continuous["smallest_eta"] < 0.41
    assert set(result["published"]) == set(result["ours"]) and "5.2.4" in result["comment"]


@pytest.mark.slow
def test_the_quadrotor_has_certificates_in_both_times():
    """Twelve states at the thesis' eta of 0.87; its horizon of 30 steps is more than enough."""
    ours = json.loads(json.dumps(thesis_3_4_2_certificate.reproduce()))["ours"]
    assert ours["discrete"]["eta"] == 0.87 and ours["discrete"]["t_min"] < 30
    assert all(one["margin"] >= 0 and one["method"] in ("grid", "interval") for one in ours.values())


def test_the_quadrotor_in_steps_is_the_quadrotor():
    """One Euler step of the library's model, with w as a rate."""
    model, flow, rng = thesis_3_4_2_certificate.quadrotor_discrete(), quadrotor(), np.random.default_rng(0)
    x, u, w = rng.normal(size=12) / 3, rng.uniform(500, 800, 4), rng.normal(size=18)
    step, rate = (np.asarray(one.dynamics(0.0, x, u, w, [])).ravel() for one in (model, flow))
    np.testing.assert_allclose(step, x + 0.05 * rate)
