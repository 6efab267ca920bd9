"""The benchmark of FMUs runs every part, and what it counts, not times, meets its target."""

from __future__ import annotations

import json

import pytest

from benchmarks import fmus
from benchmarks.report import fmus as section
from ctmhe.solvers.codegen import shipped_core

pytestmark = pytest.mark.skipif(shipped_core() is None, reason="no compiled core")


def test_every_part_gives_rows_and_a_section_of_the_page(tmp_path, monkeypatch):
    """Rows are written as they are printed; no temporary folder is left; the page shows every row."""
    monkeypatch.setattr(fmus, "LOADS", 1)
    monkeypatch.setattr(fmus, "COMPILE", {"not compiled": "off", "compiled": "off"})
    path = tmp_path / "rows.json"
    rows = fmus.main(["--problems", "quadrotor", "--updates", "2", "--cycles", "2", "--json", str(path)])
    assert json.loads(path.read_text()) == rows
    assert [*dict.fromkeys(row["part"] for row in rows)] == ["update", "load", "cycles"]
    found = {row["what"]: row["value"] for row in rows}
    assert found["temporary folders left"] == 0
    assert len([line for line in section(rows) if line.startswith("| ")]) == len(rows) + 1


def test_the_calls_of_an_update_are_those_of_its_steps():
    """Directional derivatives: of 12 states, in each stage of every step of every iteration's linearisation."""
    runners = fmus.race(fmus.PROBLEMS["quadrotor"], 1)
    calls = runners["FMI 3, compiled"].calls
    assert calls and all(call["directional"] % 12 == 0 and call["step"] == 0 for call in calls)
    assert calls == runners["FMI 2, compiled"].calls


def test_an_unknown_part_is_refused(capsys):
    """The message says which parts there are."""
    with pytest.raises(SystemExit):
        fmus.main(["lode"])
    assert "update, load, cycles" in capsys.readouterr().err
