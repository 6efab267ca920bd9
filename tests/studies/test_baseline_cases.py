"""The cases of paper 003 and of thesis 3.4, in small: orderings that the papers claim, and bounds that hold."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ctmhe.studies.reproduce import paper003_1, paper003_2, thesis_3_4_1_dt, thesis_3_4_2
from ctmhe.studies.reproduce.minmax import minmax, stage_matrix


def rows(table, key="estimator"):
    """A table by its first column."""
    return {row[key]: row for row in table}


def test_mhe_follows_the_reactor_and_kalman_filters_leave_the_physical_domain():
    """Fig. 3.1: after the horizon MHE is orders of magnitude better than the EKF; its own bound is never reached."""
    found = thesis_3_4_1_dt.reproduce(seeds=1, steps=45)
    ours, published = found["ours"], found["published"]
    assert all(ours[key] == published[key] for key in published)
    table = rows(ours["table"])
    assert table["MHE"]["MSE after N"]["mean"] < 0.01 * table["EKF"]["MSE after N"]["mean"]
    assert table["MHE"]["smallest x_hat"]["mean"] >= 0.1 - 1e-6 > table["EKF"]["smallest x_hat"]["mean"]
    assert table["MHE, certified"]["error over its bound"]["mean"] < 1


def test_the_quadrotor_is_estimated_in_flight():
    """Short, with weights from the noise instead of the certificate, which takes minutes: errors fade, domain kept."""
    found = thesis_3_4_2.reproduce(seeds=1, steps=75, certified=False)["ours"]
    table = rows(found["table"])
    assert set(table) == {"MHE", "EKF"}
    assert all(row["|e|_P after N"]["mean"] < 0.7 * row["|e|_P at 0"]["mean"] for row in table.values())
    flight = found["flight"]
    assert flight["largest angle"] < np.pi / 6 and flight["largest rate"] < 1 and flight["largest rotor speed"] < 1500


def test_adapting_the_model_helps_on_the_unknown_linear_system():
    """Table 1's ordering of what has the nominal model and what adapts; nothing beats the filter of the true system."""
    found = paper003_1.reproduce(seeds=2, steps=25, sweep=1, iterations=(1, 5), horizons=(8,))["ours"]
    total = {
        name: sum(row[name]["mean"] for row in found["Table 1"]) for name in ("KF_R", "KF", "FIE", "MHE_R", "MHE_A")
    }
    assert total["KF"] < total["MHE_A"] < total["KF_R"]
    bound = found["Kalman bound"]
    assert 0 < bound["x_0"] < 0.03 and {row["l"] for row in found["Fig. 1"]} == {1, 5}


def test_the_nonlinear_example_runs_as_printed_and_where_the_polytope_holds_it():
    """Table 2 for both drifts: with p1 = 1 the polytope contains the system, and adapting beats the nominal model."""
    found = paper003_2.reproduce(seeds=2, steps=25, sweep=1, iterations=(1,), horizons=(4,))["ours"]
    columns = {"state", "EKF_R", "FIE", "MHE_R", "MHE_A", "EKF, true model"}
    assert all(set(row) == columns for name in ("Table 2", "Table 2, p1 = 1") for row in found[name])
    inside = {name: sum(row[name]["mean"] for row in found["Table 2, p1 = 1"]) for name in ("EKF_R", "MHE_A")}
    assert inside["MHE_A"] < inside["EKF_R"]


@pytest.mark.parametrize("n", [0, 1, 6])
def test_the_min_max_estimator_solves_its_problem(n, rng):
    """Written out with an epigraph variable and given to IPOPT: the same cost."""
    A, C = np.array([[0.8, 0.3], [-0.2, 0.7]]), np.array([[1.0, 0.2]])
    q, r, prior, weights = np.array([0.1, 0.4]), np.array([5.0]), np.array([1.0, -1.0]), (0.3, 1.0 / max(n, 1))
    y = rng.normal(size=(n + 1, 1))
    x = minmax(stage_matrix(A, C, q, r), np.sqrt(r) * y, prior, *weights)

    def stages(x, largest):
        found = []
        for j in range(n + 1):
            stage = 5.0 * (y[j, 0] - (C @ x[j])[0]) ** 2
            if j < n:
                w = x[j + 1] - A @ x[j]
                stage += 0.1 * w[0] ** 2 + 0.4 * w[1] ** 2
            found.append(stage)
        return weights[0] * ((x[0][0] - 1) ** 2 + (x[0][1] + 1) ** 2) + largest(found) + weights[1] * sum(found)

    opti = ca.Opti()
    free, s = opti.variable(2, n + 1), opti.variable()
    columns, tops = [free[:, j] for j in range(n + 1)], []

    def epigraph(found):
        tops.extend(found)
        return s

    cost = stages(columns, epigraph)
    opti.minimize(cost)
    opti.subject_to([top <= s for top in tops])
    opti.solver("ipopt", {"print_time": 0}, {"print_level": 0, "sb": "yes", "tol": 1e-10})
    assert stages(list(x), max) == pytest.approx(float(opti.solve().value(cost)), rel=1e-4)
