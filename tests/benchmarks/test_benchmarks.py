"""Every tool of the benchmarks is given the same problem, and the rows say what the page needs."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.peers import AGREEMENT, CONVERGED, TOOLS, Unavailable, make_tool
from benchmarks.problems import chain, circuit, copter, reactor
from benchmarks.profile_update import FUNCTIONS, Run, profile, repeated
from benchmarks.reference import refer
from benchmarks.report import main as report
from benchmarks.solvers import exponents, race, silence
from benchmarks.solvers import main as run
from ctmhe.solvers.codegen import shipped_core

pytestmark = pytest.mark.filterwarnings("ignore")  # the peers' own

KEYS = {"problem", "tool", "mode", "compiled", "median_ms", "p99_ms", "cost", "converged"}
TINY = {
    "reactor, substeps": lambda: reactor("tiny", 3, count=8, steps=4),
    "quadrotor, bounds": lambda: copter("tiny", 3, count=10, tight=True),
    "Chua, parameter": lambda: circuit("tiny", 3, count=12),
    "tanks, input": lambda: chain("tiny", 3, tanks=4, count=6),
}


@pytest.mark.parametrize("name", TINY)
@pytest.mark.parametrize("tool", TOOLS)
def test_every_tool_reaches_the_cost_of_every_window(tool, name):
    """Same discretised problem, same weights, same prior: the same cost and state, or the tool is not installed."""
    problem = TINY[name]()
    reference = refer(problem, 3)
    with silence():
        try:
            solver = make_tool(tool, problem, reference, CONVERGED, False)
        except Unavailable as reason:
            assert tool == "do-mpc", reason
            pytest.skip(str(reason))
        rows = [solver.update(k) for k in range(4)]
    assert all(row.converged for row in rows)
    np.testing.assert_allclose([row.cost for row in rows], reference.costs, rtol=AGREEMENT)
    np.testing.assert_allclose([row.x_end for row in rows], reference.x_ends, atol=1e-3)


@pytest.mark.parametrize("tool", ["ctmhe", "ipopt-warm", "sqp-qrqp"])
def test_an_update_can_be_repeated_without_moving_on(tool):
    """Repeats of one update, as the timing needs them, start from the same window."""
    problem = TINY["Chua, parameter"]()
    solver = make_tool(tool, problem, refer(problem, 3), CONVERGED, False)
    with silence():
        once = [solver.update(k) for k in (0, 1, 2)]
        again = [solver.update(2), solver.update(2)]
    assert all(row.cost == once[2].cost and (row.x_end == once[2].x_end).all() for row in again)


def test_rows_have_the_agreed_keys_and_make_a_page(tmp_path):
    """The command writes a list of rows; the page and its plots come from them alone."""
    path = tmp_path / "rows.json"
    run(["--quick", "--updates", "2", "--problems", "P1b", "--tools", "ctmhe", "ipopt-warm", "--json", str(path)])
    rows = json.loads(path.read_text())
    assert all(row.keys() >= KEYS for row in rows)
    done = [row for row in rows if row["median_ms"] is not None and row["mode"] == CONVERGED]
    assert {row["tool"] for row in done} == {"ctmhe", "ipopt-warm"}
    assert all(row["converged"] and row["p99_ms"] >= row["median_ms"] > 0 for row in done)
    report([str(path), "--docs", str(tmp_path)])
    assert "ipopt-warm" in (tmp_path / "benchmarks.md").read_text()
    assert (tmp_path / "images" / "benchmark_medians.png").stat().st_size < 200_000


def test_a_tool_that_breaks_is_a_row_that_says_so(monkeypatch):
    """A tool that raises is reported as not converged with its reason, and the others go on."""

    def broken(name, *_):
        if name == "fatrop":
            raise RuntimeError("no such luck")
        raise Unavailable("not installed")

    monkeypatch.setattr("benchmarks.solvers.make_tool", broken)
    rows = race(TINY["Chua, parameter"](), ["fatrop", "do-mpc"], 1, 1, 10.0)
    assert [row["converged"] for row in rows] == [False, False]
    assert "no such luck" in rows[0]["note"]
    assert rows[1]["note"] == "not installed"


def test_exponents_are_the_slopes_of_time_over_size():
    """Twice the size at four times the time is an exponent of two, over the sizes from 200 on."""
    rows = [
        dict(family="N", tool="t", mode=CONVERGED, compiled=False, size=n, median_ms=1e-6 * n**2, iterations=1.0)
        for n in (50, 200, 400, 800)
    ]
    (fit,) = exponents(rows)
    assert fit["per_iteration"] == pytest.approx(2.0)
    assert fit["sizes"] == [200, 400, 800]


@pytest.mark.skipif(shipped_core() is None, reason="no compiled core")
@pytest.mark.parametrize("compile", ["off", "auto"])
def test_the_profile_accounts_for_an_update_without_changing_it(compile, capsys):
    """Its parts are named, and a model that is evaluated three times at every point gives the same solution."""
    problem = TINY["Chua, parameter"]()
    profile(problem, 3, {"compile": compile})
    printed = capsys.readouterr().out
    for part in ("Python: observe", "Python: estimate", "window and guess", *list(FUNCTIONS.values())[:2], "algebra"):
        assert part in printed
    plain, slowed = (Run(problem, {"compile": compile}) for _ in range(2))
    stage = slowed.memory.functions.structure
    functions = [repeated(getattr(stage, name), name) for name in ("value", "jacobian")]
    for function in functions:
        function.times.value = 3
    for k in (1, 2, 3):
        plain.update(k), slowed.update(k)
        assert plain.state.window.blocks == slowed.state.window.blocks
    if compile == "auto" and stage.jacobian.batch:
        assert functions[1].calls.value >= 3 * problem.count
