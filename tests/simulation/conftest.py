"""Shared tools of the tests of plants."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import settings

from tests.simulation.paper import Machine, Paper, description

settings.register_profile("no deadline", deadline=None)  # a busy machine is not a failing law
settings.load_profile("no deadline")


@pytest.fixture(params=["scikits.odes", "scipy"])
def integrator(request, monkeypatch) -> str:
    """What integrates FMU plants: each in turn."""
    if request.param == "scipy":
        monkeypatch.setattr("ctmhe.simulation.fmu._integrators.cvode_installed", lambda: False)
    else:
        pytest.importorskip("scikits_odes_sundials")
    return request.param


@pytest.fixture
def on_paper(monkeypatch, tmp_path) -> Callable[..., tuple[Path, SimpleNamespace]]:
    """Return a function that makes a model an FMU: (its path, a journal of what happens to its instances)."""
    import fmpy.fmi2
    import fmpy.fmi3

    monkeypatch.setattr("ctmhe.simulation.fmu.plant.probe", lambda *_: None)  # there is no binary

    def make(model: Paper, version: int = 2):
        journal = SimpleNamespace(alive=0, made=0, saved=0, events=[], steps=[])
        path = tmp_path / "paper.fmu"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", description(model, version))
        for suffix, co_simulation in (("Model", False), ("Slave", True)):
            for major, module in ((2, fmpy.fmi2), (3, fmpy.fmi3)):
                machine = partial(Machine, model, co_simulation, journal)
                monkeypatch.setattr(module, f"FMU{major}{suffix}", machine)
        return path, journal

    return make
