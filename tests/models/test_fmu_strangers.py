"""FMUs that nobody here wrote: strict, oddly named, needing Python, careless with the process around them."""

import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

pytest.importorskip("fmpy")

from ctmhe import MHE, RK4, DiscountedCost, FmuModel, FmuPlant, Input, Measurement
from ctmhe.errors import FmuBinaryError, FmuDerivativeError, FmuError
from ctmhe.simulation.fmu.check import PARAMETERS, PLANT, UNUSABLE, check_fmu
from tests.models.stranger import PORTABLE, stranger

pytestmark = pytest.mark.skipif(not PORTABLE, reason="needs Linux and a C compiler")
A = np.array([[0.0, 1.0], [-2.0, -0.3]])  # of the oscillator
DISTURBED = ["pos 'ä'[1]", "v", "force", "sampled"]
POINT = {"x": np.array([0.7, -0.4]), "p": np.array([2.2, 0.4])}


@pytest.mark.parametrize("directional", [True, False])
def test_a_strict_fmu_is_an_estimators_model_with_all_its_inputs(tmp_path, directional):
    """Discrete inputs are set in event mode, parameters too; values and derivatives are those of the equations."""
    told = pytest.warns(match="by parameters fail.*it says: a derivative by this variable is refused")
    with told if directional else warnings.catch_warnings():
        model = FmuModel(stranger(tmp_path, directional=directional), parameters=["k", "c"], disturbances=DISTURBED)
    x, (k, c) = POINT["x"], POINT["p"]
    w = np.array([0.1, 0.2, 0.3, 0.4])
    assert model.w.names == ("w_pos 'ä'[1]", "w_v", "w_force", "w_sampled")
    dx, y, J = model.evaluator().evaluate(0.5, x, np.array([0.6, 0.9]), w, POINT["p"])
    force = -k * x[0] - c * x[1] + 0.6 + 0.3 + 0.9 + 0.4
    np.testing.assert_allclose(dx, [x[1] + 0.1, force + 0.2], rtol=1e-12)
    np.testing.assert_allclose(y, [x[0], force], rtol=1e-12)
    rows = [[0, 1, 1, 0, 0, 0, 0, 0], [-k, -c, 0, 1, 1, 1, -x[0], -x[1]]]
    rows += [[1, 0, 0, 0, 0, 0, 0, 0], [-k, -c, 0, 0, 1, 1, -x[0], -x[1]]]
    np.testing.assert_allclose(J, rows, atol=1e-8)
    model.close()


def test_directional_derivatives_are_kept_where_an_fmu_grants_them(tmp_path):
    """An FMU that refuses them by parameters, as FMI 2 has it, gives those by states; without parameters all."""
    path = stranger(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with FmuModel(path) as model:
            assert model.exact_derivatives
    with pytest.warns(match="by parameters fail"), FmuModel(path, parameters=["k"]) as model:
        assert not model.exact_derivatives
        evaluator = model.evaluator()
        evaluator.evaluate(0.0, POINT["x"], np.zeros(2), np.zeros(2), np.array([2.0]))
        before = evaluator.counts()[0]["directional"]
        evaluator.evaluate(0.1, POINT["x"], np.zeros(2), np.zeros(2), np.array([2.0]))
        assert evaluator.counts()[0]["directional"] == before + 2


def test_a_start_value_that_an_equation_gives_is_taken_from_there(tmp_path):
    """v = -k / 2 after the initialization; the estimates go to the true state and parameter from there."""
    with pytest.warns(match="by parameters fail"):
        model = FmuModel(stranger(tmp_path, "INITIAL_EQUATION"), inputs=["force"], outputs=["y"], parameters=["k"])
    np.testing.assert_allclose(model.x_start, [1.0, -1.0])
    cost = DiscountedCost(eta=0.2, P=np.eye(3), Q=1e5, R=1e9)
    mhe = MHE(model, horizon=1.0, interval=0.1, integrator=RK4(0.02), cost=cost, hold="point")
    state = mhe.control(mhe.init(x=model.x_start, p=[1.5]), Input(0.0, [0.0]))
    values, vectors = np.linalg.eig(A)
    for t in 0.05 * np.arange(1, 61):
        truth = (vectors @ np.diag(np.exp(values * t)) @ np.linalg.solve(vectors, model.x_start)).real
        state = mhe.observe(state, Measurement(t, truth[:1]))
        state, estimate = mhe.estimate(state, t)
        assert estimate.status.success
    np.testing.assert_allclose(estimate.x, truth, atol=1e-3)
    np.testing.assert_allclose(estimate.p, [2.0], atol=1e-2)
    model.close()


def test_dependencies_on_an_alias_are_dependencies_on_the_state(tmp_path):
    """The description lists y, another name of the state; no warning says that the state is left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FmuModel(stranger(tmp_path)).close()


@pytest.mark.parametrize(("macro", "said"), [("NO_RESOURCE", "a table that is not there"), ("NO_VALUES", "any value")])
def test_the_fmu_is_asked_why_it_refuses(tmp_path, macro, said):
    """It logs only when it is wanted to, and then the message ends with its own words."""
    path = stranger(tmp_path, macro)
    with pytest.raises(FmuBinaryError, match=f"it says: {said} is refused in mode"):
        FmuModel(path)
    with pytest.raises(FmuError, match=f"it says: {said} is refused in mode"):
        FmuPlant(path, isolated=True)


def test_an_fmu_that_imports_python_modules_finds_those_of_the_session(tmp_path):
    """Loading it in a process of its own first does not refuse what works here."""
    checkup = check_fmu(stranger(tmp_path, "PYTHON"))
    assert checkup.verdict == PARAMETERS, str(checkup)


@pytest.mark.parametrize("kind", ["model", "plant"])
@pytest.mark.parametrize("macro", ["ROUNDS_UP", "GOES_AWAY"])
def test_what_an_fmu_does_to_the_process_is_undone(tmp_path, macro, kind):
    """Rounding, traps and working directory are afterwards as before: 0 / 0 gives NaN and no signal."""
    make = {"model": "FmuModel(path, parameters=['k'])", "plant": "FmuPlant(path)"}[kind]
    program = (
        "import os, sys, numpy as np\nfrom ctmhe import FmuModel, FmuPlant\n"
        f"path, here = sys.argv[1], os.getcwd()\nfmu = {make}\nassert os.getcwd() == here\n"
        "np.seterr(all='ignore')\nassert np.isnan(np.zeros(1) / np.zeros(1))\n"
        "assert np.float64(1.0) + 1e-17 == 1.0\nfmu.close()\n"
    )
    path = stranger(tmp_path, macro)
    ended = subprocess.run([sys.executable, "-W", "ignore", "-c", program, path], cwd=os.getcwd(), check=False)
    assert ended.returncode == 0


def test_an_fmu_that_fails_where_it_did_not_is_no_model(tmp_path):
    """Whatever the check that it fails in, the error is one of FMUs."""
    path = stranger(tmp_path, "TIRES")
    with pytest.raises(FmuDerivativeError, match="discard"):
        FmuModel(path)
    assert check_fmu(path).verdict in {PLANT, UNUSABLE}


def test_an_fmu_that_cannot_be_ended_is_freed(tmp_path, caplog):
    """fmi2Terminate fails; the instance goes all the same."""
    caplog.set_level("DEBUG", "ctmhe.models.fmu")
    FmuPlant(stranger(tmp_path, "ENDLESS")).close()
    assert "freed" in caplog.text
