"""Joint estimation of Chua's circuit in small: what the thesis and paper 000 claim."""

from __future__ import annotations

import numpy as np

from ctmhe.studies.reproduce import CASES, paper_000_5, thesis_5_2_4, thesis_5_3_3


def test_monitoring_keeps_the_parameter_through_weak_excitation():
    """Thesis 5.2.4 over 650 steps, of which the last 150 rest near x1 = 0: e_p is much smaller, e_x is the same."""
    found = CASES["thesis-5.2.4"](seeds=1, steps=650)
    plain, watched = (row for row in found["ours"]["table"])
    assert watched["RMSE(e_p)"]["mean"] < plain["RMSE(e_p)"]["mean"] / 2
    assert abs(watched["RMSE(e_x)"]["mean"] / plain["RMSE(e_x)"]["mean"] - 1) < 1e-3
    assert found["ours"]["N_min"] == found["published"]["N_min"] == 137
    assert found["ours"]["largest_error_over_bound"] <= 1 and found["ours"]["failed_solves"] == 0
    assert found["published"]["table"][0].keys() == plain.keys()


def test_monitoring_keeps_a_parameter_that_varies():
    """Thesis 5.3.3 over 330 steps, where the circuit comes to rest; states are those of the scheme without."""
    run = thesis_5_3_3.one_seed(0, steps=420)["rows"]
    plain, watched = run["without monitoring"], run["with monitoring"]
    assert watched["largest |e_p| after 200 steps"] < plain["largest |e_p| after 200 steps"] / 3
    assert abs(watched["RMSE(e_x)"] / plain["RMSE(e_x)"] - 1) < 1e-6
    w4 = thesis_5_3_3.drift(4000)
    np.testing.assert_allclose(np.unique(np.round(w4, 12)), [-1e-4, 0.0, 1e-4], atol=1e-15)
    assert abs(w4.sum()) < 1e-9


def test_the_conditions_of_paper_000_hold_while_the_circuit_swings():
    """(33) and (34) along 240 steps, 4 kappa lambda^N < 1, errors within their bounds, and convergence."""
    run = paper_000_5.one_seed(0, steps=240, size=1e-3)
    assert run["violated"] == run["unexcited"] == run["failures"] == 0
    assert run["ratio"] <= 1 and run["normalised"] < 1e-3
    assert 4 * paper_000_5.KAPPA * paper_000_5.LAMBDA**paper_000_5.HORIZON < 1


def test_errors_are_averaged_as_below_table_5_1():
    """sqrt of the sum over t = 0...N, over N."""
    from ctmhe.studies.reproduce.joint_runs import rmse

    assert rmse(np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 0.0]])) == np.sqrt(25 / 2)
    assert set(thesis_5_2_4.HEADS) <= set(thesis_5_2_4.PUBLISHED)
