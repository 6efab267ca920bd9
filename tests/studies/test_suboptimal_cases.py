"""Thesis chapter 4 in small: what its tables claim, from few seeds."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ctmhe.studies.reproduce import (
    suboptimal_runs,
    thesis_fig_4_3,
    thesis_table_4_3,
    thesis_table_4_4,
    thesis_table_4_5,
)

SHRUNK = 10 / 11  # the averaging artefact of Table 4.3


def small(case, **options):
    """Return a case's result as it is written."""
    return json.loads(json.dumps(case(**options)))


def test_table_4_3_is_found_again_where_it_is_defined(monkeypatch):
    """Zero iterations and the optimum give the printed SSE and J to some per cent; one takes away most of the error."""
    monkeypatch.setattr(thesis_table_4_3, "LIMITS", (0, 1, None))
    monkeypatch.setattr(thesis_table_4_3, "HORIZONS", ((3, 5),))
    result = small(thesis_table_4_3.reproduce, seeds=2, solver="gauss-newton")
    printed = {row["i"]: row for row in result["published"]["table"] if row["N"] == 3}
    ours = {row["i"]: row for row in result["ours"]["table"]}
    for i in (0, "*"):
        for group in ("(4.56)", "(4.64)"):
            for key, tolerance in (("SSE", 0.08), ("J_acc", 0.1)):
                found = ours[i][group][key]["mean"] * SHRUNK
                assert found == pytest.approx(printed[i][group][key], rel=tolerance)
    assert result["ours"]["Luenberger"]["mean"] == pytest.approx(28.65, rel=0.08)
    assert ours[1]["(4.56)"]["SSE"]["mean"] < 0.25 * ours[0]["(4.56)"]["SSE"]["mean"]
    assert set(printed[0]) == set(ours[0]) and set(printed[0]["(4.56)"]) == set(ours[0]["(4.56)"])


def test_ipopt_after_few_iterations_is_never_worse_than_the_candidate():
    """Stopped after 0, 1, 3 iterations or at the optimum, IPOPT's accumulated cost falls."""
    run = suboptimal_runs.SPECIES_RUN
    short = replace(run, steps=8)
    costs = []
    for limit in (0, 1, 3, None):
        mhe = suboptimal_runs.species_mhe("system", N=3, T=5, i=limit, solver="ipopt")
        costs.append(suboptimal_runs.one_run(short, mhe, 0).costs.sum())
    assert costs == sorted(costs, reverse=True) and costs[-1] < costs[0] / 10


def test_table_4_4_begins_with_the_candidates(monkeypatch):
    """Without iterations: the candidates, and open loop; with one, suboptimal MHE is far better."""
    monkeypatch.setattr(thesis_table_4_4, "LIMITS", (0, 1))
    result = small(thesis_table_4_4.reproduce, seeds=1)
    first, second = result["ours"]["table"]
    for name, value in (("s-MHE_1", 17.70), ("s-MHE_2", 14.22), ("f-MHE_1", 135.12), ("f-MHE_2", 135.12)):
        assert first[name]["SSE"]["mean"] == pytest.approx(value, rel=0.08)
        assert second[name]["SSE"]["mean"] < 0.2 * first[name]["SSE"]["mean"]
    assert set(result["published"]["table"][0]) == set(first)


def test_table_4_5_improves_the_observer_with_weak_priors_only(monkeypatch):
    """The horizons are the printed ones; only small a help, and one iteration does it."""
    monkeypatch.setattr(thesis_table_4_5, "LIMITS", (0, 1))
    monkeypatch.setattr(thesis_table_4_5, "SCALES", {"a = 1e2": 1e2, "a = 1e-4": 1e-4})
    monkeypatch.setattr(thesis_table_4_5, "PRINTED_HORIZONS", (16, 155))
    monkeypatch.setattr(thesis_table_4_5, "TABLE", ())
    monkeypatch.setattr(thesis_table_4_5, "REACTOR_RUN", replace(suboptimal_runs.REACTOR_RUN, steps=60))
    result = small(thesis_table_4_5.reproduce, seeds=1)
    assert result["ours"]["N_min"] == result["published"]["N_min"]
    zero, one = result["ours"]["table"]
    first = zero["a = 1e2"]["SSE"]["mean"]
    assert zero["a = 1e-4"]["SSE"]["mean"] == pytest.approx(first, rel=1e-9)
    assert one["a = 1e2"]["SSE"]["mean"] == pytest.approx(first, rel=0.02)
    assert one["a = 1e-4"]["SSE"]["mean"] < 0.1 * first
    assert result["ours"]["benchmark"]["SSE"]["mean"] < first


def test_figure_4_3_starts_better_than_the_observer(monkeypatch):
    """The transient of every estimator is shorter than the observer's; Table 4.6 names the same ones."""
    monkeypatch.setattr(thesis_fig_4_3, "RUN", replace(thesis_fig_4_3.RUN, steps=20))
    monkeypatch.setattr(thesis_fig_4_3, "SHOWN", (0, 20))
    monkeypatch.setattr(thesis_fig_4_3, "TRANSIENT", 10)
    result = small(thesis_fig_4_3.figure, seeds=1)
    rows = {row["estimator"]: row["transient"]["mean"] for row in result["ours"]["table"]}
    assert all(rows[name] < 0.6 * rows["observer"] for name in thesis_fig_4_3.ESTIMATORS)
    times = small(thesis_fig_4_3.table, seeds=1)
    assert set(times["ours"]) == set(times["published"]) and np.all(np.array(list(times["ours"].values())) > 0)
