"""The cases of thesis chapter 6 in a small size: what the text claims, as orders and factors."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest

from ctmhe.estimators.offline.nonlinear import estimate_offline
from ctmhe.studies.reproduce import reproduce, thesis_6_2_1


@pytest.fixture(scope="module")
def found():
    """Every case once, as it is stored."""
    sizes = {
        "thesis-6.2.1": {},
        "thesis-table-6.1": {"seeds": 2, "lengths": (40, 70, 130), "steps": 250},
        "thesis-table-6.2": {"seeds": 1, "sizes": ((30, 10),), "steps": 573},
        "thesis-6.4.2-cstr": {"seeds": 3, "steps": 120},
        "thesis-6.4.2-quadrotor": {"seeds": 1, "steps": 150},
    }
    return {case: json.loads(json.dumps(reproduce(case, **size))) for case, size in sizes.items()}


def test_every_case_has_the_common_fields(found):
    """What the command line prints and stores."""
    for case, result in found.items():
        assert set(result) == {"case", "published", "ours", "settings", "comment"} and result["case"] == case


def test_the_integrator_is_exact(found):
    """Thesis 6.2.1: x_inf = x + 1; the ends are off by odd powers of the golden ratio, whatever the horizon."""
    ours, published = found["thesis-6.2.1"]["ours"], found["thesis-6.2.1"]["published"]
    golden = (np.sqrt(5) - 1) / 2
    assert ours["x_inf_minus_x"] == pytest.approx(1.0, abs=1e-9) and ours["x_inf_minus_x_spread"] < 1e-9
    np.testing.assert_allclose(ours["end_differences"], golden ** np.array([1, 3, 5, 7]), atol=1e-9)
    np.testing.assert_allclose(ours["end_differences"], published["end_differences"], atol=5e-4)
    np.testing.assert_allclose(ours["start_differences"], ours["end_differences"], atol=1e-9)
    assert ours["decay_per_step"] == pytest.approx(golden**2, abs=1e-6)
    for n, difference in ours["differences"].items():  # antisymmetric about the middle
        np.testing.assert_allclose(difference, -np.array(difference)[::-1], atol=1e-9, err_msg=n)


def test_the_integrator_from_its_normal_equations():
    """A second derivation: the tridiagonal system of P_N."""
    n, y = 12, np.arange(13) + 2.0
    M = np.diag([2.0, *[3.0] * (n - 1), 2.0]) - np.eye(n + 1, k=1) - np.eye(n + 1, k=-1)
    x = estimate_offline(thesis_6_2_1.estimator(), thesis_6_2_1.data(0, n), guess=[0.0], times=np.arange(n + 1.0)).x
    np.testing.assert_allclose(x[:, 0], np.linalg.solve(M, y), atol=1e-9)


def test_blocks_come_down_to_the_full_solution(found):
    """Table 6.1 and Fig. 6.3: SSE and J of the AE fall with N to the full solution's; MHE's do not."""
    ours = found["thesis-table-6.1"]["ours"]
    for table in (ours["table"], ours["performance"]):
        blocks, online = ([row[f"{name}, %"]["mean"] for row in table] for name in ("AE", "MHE"))
        assert blocks[0] > blocks[1] > blocks[2] and blocks[2] < 5.0
        assert online[2] > blocks[2]
    excess = [row["AE, %"]["mean"] for row in ours["performance"]]
    assert min(excess) > -1e-6  # nothing costs less than the full solution, but for its terminal cost
    assert excess[2] < 0.1 * excess[0]


def test_large_linear_records_in_blocks(found):
    """Table 6.2: J and SSE of AE and full solution agree; smoother and filter are behind, in this order."""
    ours = found["thesis-table-6.2"]["ours"]
    J, SSE = ({row["Estimator"]: row[key]["mean"] for row in ours["table"]} for key in ("J_[0,T]", "SSE"))
    assert abs(J["AE"] / J["full"] - 1) < 0.01 and abs(SSE["AE"] / SSE["full"] - 1) < 0.02
    assert J["full"] < J["FIS"] < J["KF"] and SSE["full"] < SSE["FIS"] < SSE["KF"]
    ahead = ours["not_published"][0]
    assert ahead["Estimator"] == "KF, one step ahead" and ahead["J_[0,T]"]["mean"] > 10 * J["KF"]


@pytest.mark.parametrize("case", ["thesis-6.4.2-cstr", "thesis-6.4.2-quadrotor"])
def test_a_delay_brings_the_estimates_to_the_turnpike(found, case):
    """6.4.2: errors, and distances to the infinite-horizon estimate, fall with the delay; the regret falls too."""
    rows = {row["Estimator"]: row for row in found[case]["ours"]["table"]}
    delays = sorted((name for name in rows if name.startswith("delay")), key=lambda name: int(name[6:]))
    order = ["turnpike", *delays]
    for number in ("SSE", "distance to IHE", "regret"):
        means = [rows[name][number]["mean"] for name in order]
        assert all(later < sooner for sooner, later in pairwise(means)), (number, means)
    changes = found[case]["ours"]["change_of_mean_SSE_percent"]
    for name, published in found[case]["published"]["change_of_mean_SSE_percent"].items():
        assert changes[name] == pytest.approx(published, abs=12.0)
    assert rows["IHE"]["SSE"]["mean"] < rows[delays[-1]]["SSE"]["mean"] * 1.02
    for prior in ("filtering", "smoothing"):  # the priors are alike
        assert abs(rows[prior]["SSE against turnpike prior, %"]["mean"]) < 25.0
