"""The benchmark of limits runs every part, and irregular updates leave the core's memory alone."""

from __future__ import annotations

import json

import pytest

from benchmarks import limits
from ctmhe import Measurement
from ctmhe.data.log import SMALLEST
from ctmhe.solvers.codegen import shipped_core

pytestmark = pytest.mark.skipif(shipped_core() is None, reason="no compiled core")

KEYS = {"part", "problem", "what", "value", "unit", "target"}
TINY = ["--problems", "P3", "--updates", "2", "--jumps", "2", "--compile", "off"]


def test_every_part_gives_rows_with_the_agreed_keys(tmp_path, monkeypatch, capsys):
    """Rows are written as they are printed, and what is counted, not timed, meets its target."""
    monkeypatch.setattr(limits, "PROCESSES", 1)
    path = tmp_path / "rows.json"
    rows = limits.main([*TINY, "--json", str(path)])
    assert json.loads(path.read_text()) == rows
    assert all(row.keys() == KEYS for row in rows)
    assert [*dict.fromkeys(row["part"] for row in rows)] == ["startup", "jump", "endurance", "memory"]
    found = {(row["part"], row["what"]): row for row in rows}
    assert found["endurance", "updates"]["value"] == 2
    for what in ("libraries compiled during the run", "IPOPT programs built", "the core's memory, allocated anew"):
        assert found["endurance", what]["value"] == found["endurance", what]["target"] == 0
    assert found["memory", "exponent in N"]["value"] == pytest.approx(1.0, abs=0.15)
    assert "exponent in N" in capsys.readouterr().out


def test_an_unknown_part_is_refused(capsys):
    """The message says which parts there are."""
    with pytest.raises(SystemExit):
        limits.main(["indurance"])
    assert "startup, jump, endurance, memory" in capsys.readouterr().err


def test_irregular_updates_do_not_grow_the_memory():
    """Once the window has its length, 300 updates use the same scratch, logs in proportion to the window, no IPOPT."""
    mhe = limits.reactor("off")
    times, y, x, _ = limits.samples(mhe, 400)
    state, kept, longest = mhe.init(x=x), None, 0
    for k, t in enumerate(times):
        state, estimate = mhe.estimate(mhe.observe(state, Measurement(float(t), y[k])), float(t))
        assert estimate.status.success
        longest = max(longest, state.window.n)
        if k == 100:
            kept = mhe._updates._memory()
        if k >= 100:
            assert mhe._updates._memory() is kept
            assert mhe._updates._memory().scratch is kept.scratch
            assert max(state.measurements.capacity, state.path.capacity) <= max(SMALLEST, 4 * longest)
    assert mhe._reference.built == 0
