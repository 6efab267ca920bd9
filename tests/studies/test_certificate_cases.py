"""The published certificates: what is printed, checked, and found again."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ctmhe.studies.reproduce import thesis_3_4_1_certificate


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
