"""The compiled core behind the public API gives what the NumPy solver gives."""

from __future__ import annotations

import numpy as np
import pytest

from ctmhe.compilers import find_compiler
from ctmhe.errors import InputError
from ctmhe.estimators import MHE
from ctmhe.models.fmu import FmuModel
from ctmhe.models.library import batch_reactor
from ctmhe.transcription import CVODES, RK4
from ctmhe.types import Bounds, DiscountedCost, Measurement
from fmus.build import build
from tests.conftest import REACTOR_COST

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def run(mhe, guess, p=None, count=40):
    """Irregular samples and estimates off the cell grid; returns costs and estimates."""
    rng = np.random.default_rng(11)
    state, t, found = mhe.init(x=guess, p=p), 0.0, []
    for _ in range(count):
        t += rng.exponential(0.06) + 1e-3
        state = mhe.observe(state, Measurement(t, [4.0 - 0.35 * min(t, 3.0) + 0.03 * rng.normal()]))
        state, estimate = mhe.estimate(state, t + 0.01)
        assert estimate.status.success
        found.append([estimate.cost, *estimate.x, *estimate.p])
    return np.array(found)


@needs_compiler
@pytest.mark.parametrize("case", ["bounded", "point, parameter", "CVODES", "FMU"])
def test_a_run_in_the_compiled_core_equals_the_run_in_numpy(case):
    """Costs to 1e-7 relative over a run, estimates to 1e-5, for generated and for virtual-machine stage functions."""
    joint = DiscountedCost(eta=0.5, P=np.diag([8.0, 7.1, 50.0]), Q=2e3, R=1e2)
    fixed = DiscountedCost(eta=0.5, P=[[8.0, 7.5], [7.5, 7.1]], Q=2e3, R=1e2)
    box = Bounds(x=(0.1, 5.0))
    model, options, p = {
        "bounded": (
            batch_reactor(),
            dict(cost=REACTOR_COST, bounds=batch_reactor().bounds, integrator=RK4(0.05)),
            None,
        ),
        "point, parameter": (
            batch_reactor(noise=False, parameters=("k1",)),
            dict(cost=joint, bounds=Bounds(x=(0.1, 5.0), p=(0.1, 0.2)), hold="point", integrator=RK4(0.05)),
            [0.15],
        ),
        "CVODES": (batch_reactor(noise=False), dict(cost=fixed, bounds=box, integrator=CVODES(1e-9, 1e-11)), None),
        "FMU": (FmuModel(build("batch_reactor"), inputs=[]), dict(cost=fixed, bounds=box, integrator=RK4(0.05)), None),
    }[case]
    found = []
    for way in ({"solver": "numpy"}, {"compile": "off"}, {"compile": "auto"}):
        mhe = MHE(model, horizon=1.0, interval=0.1, tolerance=1e-15, **way, **options)
        assert mhe._solver.name == ("Gauss-Newton" if "solver" in way else "compiled Gauss-Newton")
        found.append(run(mhe, [2.5, 1.4], p, count=40 if case != "CVODES" else 12))
    for other in found[1:]:
        np.testing.assert_allclose(other[:, 0], found[0][:, 0], rtol=1e-6 if case == "CVODES" else 1e-7)
        np.testing.assert_allclose(other[:, 1:], found[0][:, 1:], atol=1e-5)


def test_without_a_core_the_numpy_solver_takes_over(monkeypatch):
    """No built library and no compiler: compile="auto" still estimates."""
    monkeypatch.setattr("ctmhe.solvers.compiled.specialised_core", lambda stage, p_estimated: None)
    monkeypatch.setattr("ctmhe.solvers.compiled.shipped_core", lambda: None)
    mhe = MHE(batch_reactor(), horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=REACTOR_COST, compile="auto")
    assert mhe._solver.name == "Gauss-Newton"
    with pytest.raises(InputError, match="compile must be 'off' or 'auto'"):
        MHE(batch_reactor(), horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=REACTOR_COST, compile="fast")
