"""One interface to a running instance of an example FMU in fmpy, for both versions and kinds."""

from __future__ import annotations

import ctypes
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.simulation import instantiate_fmu

from fmus.build import build
from fmus.models import MODELS


def unzip(name, fmi, folder):
    """Unpack an example FMU into a folder and return it as text."""
    with zipfile.ZipFile(build(name, fmi)) as archive:
        archive.extractall(folder)
    return str(folder)


def description(folder):
    """Root of the model description in an unpacked FMU."""
    return ElementTree.parse(Path(folder) / "modelDescription.xml").getroot()


DISCARD, ERROR = 2, 3  # status of a call, in both versions


def fails_with(status, call, *arguments):
    """Assert that a call fails with this status."""
    with pytest.raises(FMICallException) as caught:
        call(*arguments)
    assert caught.value.status == status


class Opened:
    """An initialized instance; the groups x, dx, u, p, y, z, q are lists of value references.

    `start` are values by name that are set before the initialization; `mode` are options of fmpy's instantiation.
    Model exchange is left in event mode, after one round of the event iteration.
    """

    def __init__(self, folder, name, fmi, kind=None, start=None, configuration=None, **mode):
        about = fmpy.read_model_description(folder)
        self.model, self.fmi, self.kind = MODELS[name], fmi, kind or MODELS[name].kinds[0]
        self.reference = {v.name: v.valueReference for v in about.modelVariables}
        model = self.model
        groups = {"x": model.states, "u": model.inputs, "p": model.parameters, "y": model.outputs}
        groups |= {"z": model.indicators, "q": model.discretes}
        self.vr = {key: [self.reference[v.name] for v in group] for key, group in groups.items()}
        self.vr["dx"] = [self.reference[f"der({v.name})"] for v in model.states]
        self.size = {key: sum(v.size for v in group) for key, group in groups.items()} | {"dx": len(model.states)}
        self.fmu = instantiate_fmu(folder, about, fmi_type=self.kind, **mode)
        self.get_values = self.fmu.getReal if fmi == 2 else self.fmu.getFloat64
        self.set_values = self.fmu.setReal if fmi == 2 else self.fmu.setFloat64
        for key, value in (configuration or {}).items():
            self.fmu.enterConfigurationMode()
            self.fmu.setUInt64([self.reference[key]], [value])
            self.fmu.exitConfigurationMode()
        for key, value in (start or {}).items():
            self.set_values([self.reference[key]], [value])
        if fmi == 2:
            self.fmu.setupExperiment(startTime=0.0)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.exitInitializationMode()
        if self.kind == "ModelExchange" or mode.get("event_mode_used"):
            self.event()

    def close(self):
        """Free the instance and its library; safe to call twice."""
        if self.fmu is not None:
            self.fmu.freeInstance()
            self.fmu = None

    def event(self):
        """One round of the event iteration: (states changed, time of the next event or None)."""
        update = self.fmu.newDiscreteStates if self.fmi == 2 else self.fmu.updateDiscreteStates
        again, terminate, nominals, states, planned, when = update()
        assert not (again or terminate or nominals)
        return bool(states), when if planned else None

    def get(self, group):
        if self.fmi == 2:
            return np.array(self.get_values(self.vr[group]))
        return np.array(self.get_values(self.vr[group], self.size[group]))

    def named(self, name):
        return self.get_values([self.reference[name]])[0]

    def set(self, group, values):
        self.set_values(self.vr[group], list(values))

    def set_point(self, x, u, p):
        """Set all; the states last and, in model exchange, as an integrator sets them."""
        self.set("u", u)
        if self.model.variability == "tunable":
            self.set("p", p)
        if self.kind == "ModelExchange":
            self.set_states(x)
        else:
            self.set("x", x)

    def set_states(self, x):
        self.fmu.setContinuousStates((ctypes.c_double * len(x))(*x), len(x))

    def _vector(self, name, n):
        buffer = (ctypes.c_double * n)()
        getattr(self.fmu, name)(buffer, n)
        return np.array(buffer[:])

    def derivatives(self):
        name = "getDerivatives" if self.fmi == 2 else "getContinuousStateDerivatives"
        return self._vector(name, len(self.model.states))

    def states(self):
        return self._vector("getContinuousStates", len(self.model.states))

    def indicators(self):
        return self._vector("getEventIndicators", len(self.model.indicators))

    def directional(self, unknowns, knowns, seed):
        """d unknowns / d knowns times seed, for groups of unknowns and value references of knowns."""
        references = [vr for group in unknowns for vr in self.vr[group]]
        if self.fmi == 2:
            return self.fmu.getDirectionalDerivative(references, knowns, seed)
        count = sum(self.size[group] for group in unknowns)
        return self.fmu.getDirectionalDerivative(references, knowns, seed, nSensitivity=count)

    def jacobian(self, group):
        """d (dx, y) / d group, column by column."""
        columns = [self.directional(["dx", "y"], [vr], [1.0]) for vr in self.vr[group]]
        return np.reshape(columns, (len(columns), self.size["dx"] + self.size["y"])).T
