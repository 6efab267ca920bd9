"""The example FMUs against independent right-hand sides, and the derivatives that CasADi takes from them."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

fmpy = pytest.importorskip("fmpy")

from fmpy.simulation import instantiate_fmu  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

from ctmhe.errors import FmuError, InputError, MissingExtra  # noqa: E402
from fmus import build as building  # noqa: E402
from fmus.build import build, main  # noqa: E402
from fmus.models import MODELS  # noqa: E402

NO_AD = {"enable_forward": False, "enable_reverse": False}
CASES = [(name, fmi) for name in MODELS for fmi in (2, 3)]


# ---- the models once more, independent of the C sources ----


def reactor(x, u, p):
    k1, k2 = p
    stoichiometry = np.array([-2.0, 1.0])
    return stoichiometry * (k1 * x[0] ** 2 - k2 * x[1]) + u


def oscillator(x, u, p):
    return np.array([x[1], p[0] * (1 - x[0] ** 2) * x[1] - x[0]]) + u


def quadrotor(x, u, p):
    m, g, length, c_t, c_q, j1, j2, j3, b, d = p
    (phi, theta, psi), s, rate = x[3:6], x[6:9], x[9:12]
    e3 = np.array([0.0, 0.0, 1.0])
    skew = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    rotation = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    mixer = [
        [c_t, c_t, c_t, c_t],
        [0, -length * c_t, 0, length * c_t],
        [length * c_t, 0, -length * c_t, 0],
        [-c_q, c_q, -c_q, c_q],
    ]
    thrust, *torque = np.array(mixer) @ u**2
    gamma = np.array(
        [
            [1, np.sin(phi) * np.tan(theta), np.cos(phi) * np.tan(theta)],
            [0, np.cos(phi), -np.sin(phi)],
            [0, np.sin(phi) / np.cos(theta), np.cos(phi) / np.cos(theta)],
        ]
    )
    inertia = np.diag([j1, j2, j3])
    force = m * g * e3 - thrust * rotation @ e3 - rotation @ (b * skew) @ rate
    turning = -np.cross(rate, inertia @ rate) + torque - d * np.outer(e3, e3) @ rate
    return np.concatenate([s, gamma @ rate, force / m, np.linalg.solve(inertia, turning)])


RHS = {"batch_reactor": reactor, "van_der_pol": oscillator, "quadrotor": quadrotor}
OUTPUT = {
    "batch_reactor": lambda x: x[:2].sum(keepdims=True),
    "van_der_pol": lambda x: x[:1],
    "quadrotor": lambda x: x[:6],
}


def point(name, seed=0):
    """A random point (x, u, p) near the start values, without their symmetry."""
    rng, model = np.random.default_rng(seed), MODELS[name]

    def near(variables, spread):
        return np.array([v.start + spread * rng.uniform(0.5, 1.0) * v.nominal for v in variables])

    return near(model.states, 0.3), near(model.inputs, 0.02), near(model.parameters, 0.2)


def differences(function, a):
    """Jacobian of function at a by central differences."""
    columns = []
    for j, value in enumerate(a):
        h = 1e-6 * max(abs(value), 1e-3)
        e = h * np.eye(len(a))[j]
        columns.append((function(a + e) - function(a - e)) / (2 * h))
    return np.array(columns).T


# ---- the FMU in fmpy, by groups of variables ----


class Opened:
    """One initialized instance; the groups x, dx, u, p, y are lists of value references."""

    def __init__(self, folder, name, fmi, kind):
        description = fmpy.read_model_description(folder)
        self.model, self.fmi = MODELS[name], fmi
        reference = {v.name: v.valueReference for v in description.modelVariables}
        groups = {
            "x": self.model.states,
            "u": self.model.inputs,
            "p": self.model.parameters,
            "y": self.model.outputs,
        }
        self.vr = {key: [reference[v.name] for v in group] for key, group in groups.items()}
        self.vr["dx"] = [reference[f"der({v.name})"] for v in self.model.states]
        self.fmu = instantiate_fmu(folder, description, fmi_type=kind)
        if fmi == 2:
            self.fmu.setupExperiment(startTime=0.0)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.exitInitializationMode()
        self.get_values = self.fmu.getReal if fmi == 2 else self.fmu.getFloat64
        self.set_values = self.fmu.setReal if fmi == 2 else self.fmu.setFloat64

    def get(self, group):
        return np.array(self.get_values(self.vr[group]))

    def set(self, group, values):
        self.set_values(self.vr[group], list(values))

    def set_point(self, x, u, p):
        for group, values in zip("xup", (x, u, p), strict=True):
            self.set(group, values)


@pytest.fixture(scope="module")
def unzipped(tmp_path_factory):
    folders = {}

    def folder(name, fmi):
        if (name, fmi) not in folders:
            folders[name, fmi] = str(tmp_path_factory.mktemp(f"{name}{fmi}"))
            with zipfile.ZipFile(build(name, fmi)) as archive:
                archive.extractall(folders[name, fmi])
        return folders[name, fmi]

    return folder


@pytest.fixture
def opened(unzipped):
    instances = []

    def make(name, fmi, kind="ModelExchange"):
        instances.append(Opened(unzipped(name, fmi), name, fmi, kind))
        return instances[-1]

    yield make
    for instance in instances:
        instance.fmu.terminate()
        instance.fmu.freeInstance()


@contextmanager
def no_compiler_may_run():
    def refuse(*_):
        raise AssertionError("a compiler was run")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "_pack", refuse)
        yield


# ---- laws ----


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_fmu_is_valid(name, fmi):
    """The description obeys the standard's schema and rules, as fmpy checks them."""
    assert validate_fmu(str(build(name, fmi))) == []


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_derivatives_and_outputs_equal_the_equations(opened, name, fmi):
    """At random points der(x) and y equal the independent right-hand side, parameters changed after start."""
    instance = opened(name, fmi)
    for seed in range(3):
        x, u, p = point(name, seed)
        instance.set_point(x, u, p)
        np.testing.assert_allclose(instance.get("dx"), RHS[name](x, u, p), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(instance.get("y"), OUTPUT[name](x), rtol=1e-15)


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_simulation_agrees_with_an_independent_integration(unzipped, name, fmi, kind):
    """Both kinds follow x' = f(x, u, p) for a changed parameter and a constant input."""
    model, stop = MODELS[name], 1.0
    _, u, p = point(name)
    parameters = {v.name: value for v, value in zip(model.parameters, p, strict=True)}
    inputs = {v.name: value for v, value in zip(model.inputs, u, strict=True)}
    states = [v.name for v in model.states]
    got = fmpy.simulate_fmu(
        unzipped(name, fmi),
        fmi_type=kind,
        stop_time=stop,
        output_interval=0.1,
        relative_tolerance=1e-9,
        start_values=parameters | inputs,
        output=states,
    )
    start = np.array([v.start for v in model.states])
    true = solve_ivp(lambda _, x: RHS[name](x, u, p), (0, stop), start, "DOP853", got["time"], rtol=1e-12, atol=1e-13)
    # co-simulation is near exact; fmpy's CVODE keeps its tolerance a step, not over the run
    tolerance = 1e-8 if kind == "CoSimulation" else 1e-6
    np.testing.assert_allclose([got[n] for n in states], true.y, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("fmi", [2, 3])
def test_cosimulation_masters_the_stiff_oscillator(opened, fmi):
    """With mu = 100 the co-simulation FMU follows an implicit integration through a fast transition."""
    instance = opened("van_der_pol", fmi, "CoSimulation")
    instance.set("p", [100.0])
    times = np.linspace(0.0, 100.0, 11)  # the first jump is near t = 0.81 mu
    true = solve_ivp(
        lambda _, x: oscillator(x, np.zeros(2), [100.0]),
        (0, 100),
        [2.0, 0.0],
        "Radau",
        times,
        rtol=1e-10,
        atol=1e-12,
    )
    assert true.y[0].min() < 0 < true.y[0].max()
    for k, (t0, t1) in enumerate(pairwise(times)):
        instance.fmu.doStep(t0, t1 - t0)
        np.testing.assert_allclose(instance.get("x"), true.y[:, k + 1], rtol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_cosimulation_does_not_depend_on_the_communication_step(opened, name):
    """One long step, many short ones and irregular ones end in the same state."""
    ends = []
    for times in (np.linspace(0, 0.5, 2), np.linspace(0, 0.5, 51), np.array([0, 0.0137, 0.2, 0.2001, 0.5])):
        instance = opened(name, 2, "CoSimulation")
        _, u, p = point(name)
        instance.set("u", u), instance.set("p", p)
        for t0, t1 in pairwise(times):
            instance.fmu.doStep(t0, t1 - t0)
        ends.append(instance.get("x"))
    np.testing.assert_allclose(ends[1:], [ends[0]] * 2, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_directional_derivatives_equal_finite_differences(opened, name, fmi):
    """Columns of the Jacobian with respect to states, inputs and parameters are those of the function."""
    instance, base = opened(name, fmi), dict(zip("xup", point(name), strict=True))
    unknowns = instance.vr["dx"] + instance.vr["y"]
    for group in "xup":

        def function(value, group=group):
            instance.set_point(*(base | {group: value}).values())
            return np.concatenate([instance.get("dx"), instance.get("y")])

        expected = differences(function, base[group])
        instance.set_point(*base.values())
        columns = [instance.fmu.getDirectionalDerivative(unknowns, [vr], [1.0]) for vr in instance.vr[group]]
        np.testing.assert_allclose(np.array(columns).T, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_adjoint_derivatives_are_the_transpose(opened, name):
    """s' (J v) = (J' s)' v for random seeds."""
    instance, rng = opened(name, 3), np.random.default_rng(1)
    instance.set_point(*point(name))
    unknowns = instance.vr["dx"] + instance.vr["y"]
    knowns = instance.vr["x"] + instance.vr["u"] + instance.vr["p"]
    v, s = rng.normal(size=len(knowns)), rng.normal(size=len(unknowns))
    forward = instance.fmu.getDirectionalDerivative(unknowns, knowns, list(v))
    reverse = instance.fmu.getAdjointDerivative(unknowns, knowns, list(s), len(knowns))
    np.testing.assert_allclose(s @ forward, np.dot(reverse, v), rtol=1e-12)


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_declared_dependencies_are_the_pattern_of_the_jacobian(name, fmi):
    """What is declared is what differs from zero, no entry more and none less."""
    model, pattern = MODELS[name], {}
    base = dict(zip("xup", point(name), strict=True))
    groups = {"x": model.states, "u": model.inputs, "p": model.parameters}
    for group, variables in groups.items():

        def function(value, group=group):
            args = base | {group: value}
            return np.concatenate([RHS[name](*args.values()), OUTPUT[name](args["x"])])

        for j, v in enumerate(variables):
            pattern[v.name] = np.abs(differences(function, base[group])[:, j]) > 1e-6
    for i, row in enumerate(model.states + model.outputs):
        assert {known for known, column in pattern.items() if column[i]} == set(row.depends), row.name


@pytest.mark.parametrize("kind", ["ModelExchange", "CoSimulation"])
@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_state_round_trip_is_exact(opened, name, fmi, kind):
    """A restored FMU state, also a serialized one, repeats everything bit for bit."""
    instance = opened(name, fmi, kind)
    instance.set_point(*point(name))
    everything = ("x", "u", "p", "dx", "y")

    def go_on():
        if kind == "CoSimulation":
            instance.fmu.doStep(0.0, 0.05)
        return np.concatenate([instance.get(group) for group in everything])

    saved = instance.fmu.getFMUState()
    first = go_on()
    restore = getattr(instance.fmu, "deSerializeFMUstate" if fmi == 2 else "deserializeFMUState")
    serialize = getattr(instance.fmu, "serializeFMUstate" if fmi == 2 else "serializeFMUState")
    copies = [saved, restore(serialize(saved))]
    for state in copies:
        instance.set_point(*point(name, seed=7))
        instance.fmu.setFMUState(state)
        np.testing.assert_array_equal(go_on(), first)
        instance.fmu.freeFMUState(state)


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_instances_share_nothing(opened, name, fmi):
    """Setting one instance leaves the other at its start values."""
    one, other = opened(name, fmi), opened(name, fmi)
    before = {group: other.get(group) for group in ("x", "u", "p", "dx", "y")}
    one.set_point(*point(name))
    for group, values in before.items():
        np.testing.assert_array_equal(other.get(group), values)
    start = [v.start for v in MODELS[name].states]
    np.testing.assert_array_equal(before["x"], start)


@pytest.mark.parametrize("fmi", [2, 3])
def test_parameters_can_be_set_in_every_mode(opened, fmi):
    """A tunable parameter set in event mode and in continuous-time mode acts at once."""
    instance = opened("batch_reactor", fmi)
    for mode in (lambda: None, instance.fmu.enterContinuousTimeMode):
        mode()
        for k1 in (0.2, 0.3):
            instance.set("p", [k1, 0.0])
            buffer = (ctypes.c_double * 2)()
            getter = instance.fmu.getDerivatives if fmi == 2 else instance.fmu.getContinuousStateDerivatives
            getter(buffer, 2)
            np.testing.assert_allclose(list(buffer), [-18 * k1, 9 * k1], rtol=1e-15)  # pA = 3


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_failed_step_leaves_the_fmu_where_it_was(opened, fmi):
    """A step that leaves the finite numbers is discarded, and the FMU can go on."""
    instance = opened("batch_reactor", fmi, "CoSimulation")
    instance.set("x", [-1e6, 0.0])  # pA' = -2 k1 pA^2 escapes in finite time
    with pytest.raises(fmpy.fmi1.FMICallException):
        instance.fmu.doStep(0.0, 1.0)
    np.testing.assert_array_equal(instance.get("x"), [-1e6, 0.0])
    instance.set("x", [3.0, 1.0])
    instance.fmu.doStep(0.0, 1.0)


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_casadi_jacobians_equal_finite_differences(unzipped, name, fmi):
    """CasADi's view has the right Jacobian in x, u and p, alone and inside a mapped function."""
    model = MODELS[name]
    dae = ca.DaeBuilder("m", unzipped(name, fmi), {"enable_ls_serialization": False})
    assert dae.x() == [v.name for v in model.states]
    assert dae.u() == [v.name for v in model.inputs]
    assert dae.p() == [v.name for v in model.parameters]
    assert dae.y() == [v.name for v in model.outputs]
    f = dae.create("f", ["t", "x", "u", "p"], ["ode", "y"], NO_AD)
    symbols = [ca.MX.sym(n, f.size1_in(k + 1)) for k, n in enumerate("xup")]
    result = ca.vertcat(*f(0, *symbols))
    jacobian = ca.Function("J", symbols, [ca.densify(ca.jacobian(result, s)) for s in symbols])
    base = dict(zip("xup", point(name), strict=True))
    expected = {}
    for group in "xup":

        def function(value, group=group):
            args = (base | {group: value}).values()
            return np.concatenate([RHS[name](*args), OUTPUT[name]((base | {group: value})["x"])])

        expected[group] = differences(function, base[group])
    for got, group in zip(jacobian(*base.values()), "xup", strict=True):
        np.testing.assert_allclose(got.full(), expected[group], rtol=1e-6, atol=1e-6, err_msg=group)

    stages = ca.MX.sym("X", f.size1_in(1), 3)
    mapped = ca.Function("g", symbols, [result]).map(3)(
        stages, ca.repmat(symbols[1], 1, 3), ca.repmat(symbols[2], 1, 3)
    )
    wrt_p = ca.Function("Jp", [stages, *symbols[1:]], [ca.densify(ca.jacobian(ca.vec(mapped), symbols[2]))])
    got = wrt_p(np.column_stack([base["x"]] * 3), base["u"], base["p"]).full()
    np.testing.assert_allclose(got, np.vstack([expected["p"]] * 3), rtol=1e-6, atol=1e-6)


# ---- building ----


def test_building_twice_compiles_once():
    """The second call returns the same file without touching a compiler."""
    first = build("batch_reactor", 2)
    changed = first.stat().st_mtime_ns
    with no_compiler_may_run():
        assert build("batch_reactor", 2) == first
    assert first.stat().st_mtime_ns == changed
    assert first.name == "batch_reactor_fmi2.fmu"


def test_concurrent_builds_give_the_same_bytes(tmp_path, monkeypatch):
    """Several builders of one FMU into an empty cache end with one whole file; its bytes are reproducible."""
    monkeypatch.setattr(building, "_cache", lambda: tmp_path / "cache")
    with ThreadPoolExecutor(4) as pool:
        paths = list(pool.map(lambda _: build("van_der_pol", 3), range(4)))
    assert len(set(paths)) == 1
    assert [p.name for p in paths[0].parent.iterdir()] == ["van_der_pol_fmi3.fmu"]
    first = paths[0].read_bytes()
    paths[0].unlink()
    assert build("van_der_pol", 3).read_bytes() == first


def test_command_line_prints_the_files(tmp_path, capsys):
    """`python -m fmus.build NAME --out DIR --fmi 3` puts the FMU into DIR and prints its path."""
    assert main(["batch_reactor", "--out", str(tmp_path), "--fmi", "3"]) == 0
    path = tmp_path / "batch_reactor_fmi3.fmu"
    assert capsys.readouterr().out.split() == [str(path)]
    assert zipfile.is_zipfile(path)


def test_errors_say_what_to_do(monkeypatch, tmp_path):
    """An unknown name or version, no compiler and no fmpy each end in an error that names the remedy."""
    with pytest.raises(InputError, match=r"'reactor'.*batch_reactor"):
        build("reactor")
    with pytest.raises(InputError, match="choose 2 or 3"):
        build("batch_reactor", 1)
    monkeypatch.setattr(building, "_cache", lambda: tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(building, "find_spec", lambda _: None)
        with pytest.raises(MissingExtra, match=r"ctmhe\[fmu\]"):
            build("batch_reactor")
    monkeypatch.setenv("CC", "false")
    with pytest.raises(FmuError, match="batch_reactor"):
        build("batch_reactor")
    monkeypatch.setenv("CC", "no-such-compiler -m64")
    with pytest.raises(FmuError, match="CC is set to"):
        build("batch_reactor")
    monkeypatch.delenv("CC")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(FmuError, match="build-essential"):
        build("batch_reactor")


def test_building_does_not_import_fmpy():
    """fmpy is only looked up for its headers: building stays light."""
    code = "import sys, fmus.build as b; b.build('batch_reactor'); sys.exit('fmpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
