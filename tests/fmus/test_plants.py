"""The plants among the example FMUs against independent right-hand sides, and CasADi's derivatives of them."""

from __future__ import annotations

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ctmhe.models.library import chua
from fmus.models import MODELS
from tests.fmus.equations import RHS, everything, oscillator, output, partial, point, scales

fmpy = pytest.importorskip("fmpy")

NO_AD = {"enable_forward": False, "enable_reverse": False}
PLANTS = [name for name, model in MODELS.items() if not model.trap]
CASES = [(name, fmi) for name in PLANTS for fmi in (2, 3)]
KINDS = ("ModelExchange", "CoSimulation")


def test_every_plant_has_equations():
    """No plant goes untested."""
    assert set(PLANTS) == set(RHS)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_derivatives_and_outputs_equal_the_equations(opened, name, fmi, kind):
    """At random points der(x) and y equal the independent right-hand side, parameters changed after start."""
    instance = opened(name, fmi, kind)
    for seed in range(3):
        x, u, p = point(name, seed)
        instance.set_point(x, u, p)
        np.testing.assert_allclose(instance.get("dx"), RHS[name](x, u, p), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(instance.get("y"), output(name, x, u, p), rtol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_circuit_is_that_of_the_library(opened, fmi):
    """The FMU of Chua's circuit has the derivatives and the start values of parameters of the Python model."""
    names = [v.name for v in MODELS["chua"].parameters]
    model, instance = chua(parameters=names, noise=False), opened("chua", fmi)
    assert list(model.p.names) == names
    np.testing.assert_array_equal(instance.get("p"), model.p_start)
    x, _, p = point("chua")
    d = np.array([0.1, -0.05, 0.02])
    instance.set_point(x, d, p)
    expected = np.asarray(model.dynamics(0.0, x, (), d, p)).ravel()
    np.testing.assert_allclose(instance.get("dx"), expected, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_simulation_agrees_with_an_independent_integration(unzipped, name, fmi, kind):
    """Both kinds follow x' = f(x, u, p) for changed parameters and a constant input, up to the first event."""
    model = MODELS[name]
    stop = model.stop / 20
    _, u, p = point(name)
    parameters = {v.name: value for v, value in zip(model.parameters, p, strict=True)}
    inputs = {v.name: value for v, value in zip(model.inputs, u, strict=True)}
    states = [v.name for v in model.states]
    got = fmpy.simulate_fmu(
        unzipped(name, fmi),
        fmi_type=kind,
        stop_time=stop,
        output_interval=stop / 10,
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


@pytest.mark.parametrize("name", PLANTS)
def test_cosimulation_depends_neither_on_the_communication_step_nor_on_the_version(opened, name):
    """One long step, many short ones and irregular ones end in the same state, in FMI 2 and 3."""
    _, u, p = point(name)
    ends, stop = [], MODELS[name].stop / 20
    for fmi in (2, 3):
        for times in (np.linspace(0, 1, 2), np.linspace(0, 1, 51), np.array([0, 0.0274, 0.4, 0.4002, 1])):
            instance = opened(name, fmi, "CoSimulation")
            instance.set("u", u)
            instance.set("p", p)
            for t0, t1 in pairwise(times * stop):
                instance.fmu.doStep(t0, t1 - t0)
            ends.append(instance.get("x"))
    np.testing.assert_allclose(ends[1:3], [ends[0]] * 2, rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(ends[:3], ends[3:])


@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_directional_derivatives_equal_finite_differences(opened, name, fmi):
    """Columns of the Jacobian with respect to states, inputs and parameters are those of the function."""
    instance, base = opened(name, fmi), point(name)

    def function(*values):
        instance.set_point(*values)
        return np.concatenate([instance.get("dx"), instance.get("y")])

    for group in "xup":
        expected = partial(function, base, group)
        instance.set_point(*base)
        scale = scales(name, group)
        np.testing.assert_allclose(instance.jacobian(group) * scale, expected * scale, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", PLANTS)
def test_adjoint_derivatives_are_the_transpose(opened, name):
    """s' (J v) = (J' s)' v for random seeds."""
    instance, rng = opened(name, 3), np.random.default_rng(1)
    instance.set_point(*point(name))
    unknowns = instance.vr["dx"] + instance.vr["y"] + instance.vr["z"]
    knowns = instance.vr["x"] + instance.vr["u"] + instance.vr["p"]
    v, s = rng.normal(size=len(knowns)), rng.normal(size=len(unknowns))
    forward = instance.fmu.getDirectionalDerivative(unknowns, knowns, list(v))
    reverse = instance.fmu.getAdjointDerivative(unknowns, knowns, list(s), len(knowns))
    np.testing.assert_allclose(s @ forward, np.dot(reverse, v), rtol=1e-11)


@pytest.mark.parametrize("name", PLANTS)
def test_declared_dependencies_are_the_pattern_of_the_jacobian(name):
    """What is declared is what differs from zero, no entry more and none less."""
    model, pattern = MODELS[name], {}
    groups = {"x": model.states, "u": model.inputs, "p": model.parameters}
    for group, variables in groups.items():
        jacobian = partial(everything(name), point(name), group)
        for j, v in enumerate(variables):
            pattern[v.name] = np.abs(jacobian * scales(name, group))[:, j] > 1e-6
    for i, row in enumerate(model.states + model.outputs):
        assert {known for known, column in pattern.items() if column[i]} == set(row.depends), row.name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("name", "fmi"), CASES)
def test_state_round_trip_is_exact(opened, name, fmi, kind):
    """A restored FMU state, also a serialized one, repeats everything bit for bit."""
    instance = opened(name, fmi, kind)
    instance.set_point(*point(name))
    groups, step = ("x", "u", "p", "dx", "y", "z", "q"), MODELS[name].stop / 200

    def go_on():
        if kind == "CoSimulation":
            instance.fmu.doStep(0.0, step)
        return np.concatenate([instance.get(group) for group in groups])

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
    before = {group: other.get(group) for group in ("x", "u", "p", "dx", "y", "q")}
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
            np.testing.assert_allclose(instance.derivatives(), [-18 * k1, 9 * k1], rtol=1e-15)  # pA = 3


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
    base = point(name)
    expected = {group: partial(everything(name), base, group) for group in "xup"}
    for got, group in zip(jacobian(*base), "xup", strict=True):
        scale = scales(name, group)
        np.testing.assert_allclose(
            got.full().reshape(scale.shape) * scale, expected[group] * scale, rtol=1e-6, atol=1e-6, err_msg=group
        )

    x, u, p = base
    stages = ca.MX.sym("X", f.size1_in(1), 3)
    mapped = ca.Function("g", symbols, [result]).map(3)(
        stages, ca.repmat(symbols[1], 1, 3), ca.repmat(symbols[2], 1, 3)
    )
    wrt_p = ca.Function("Jp", [stages, *symbols[1:]], [ca.densify(ca.jacobian(ca.vec(mapped), symbols[2]))])
    got, scale = wrt_p(np.column_stack([x] * 3), u, p).full(), np.vstack([scales(name, "p")] * 3)
    np.testing.assert_allclose(got * scale, np.vstack([expected["p"]] * 3) * scale, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_building_settles_where_its_heat_balance_says(opened, fmi):
    """A watt in each zone makes walls warmer by R_wo and zones by R_zw + R_wo; slowest time constant 2.6 days."""
    instance = opened("building", fmi)
    outdoors, watts, (r_zw, r_wo) = instance.named("T_out"), 1000.0, instance.get("p")[:2]
    instance.set("u", [outdoors, 0.0, watts, watts])
    instance.set_states(outdoors + watts * np.array([r_zw + r_wo] * 2 + [r_wo] * 2))
    np.testing.assert_allclose(instance.derivatives(), np.zeros(4), atol=1e-15)
    np.testing.assert_allclose(instance.named("loss"), 2 * watts, rtol=1e-12)
    rates = np.linalg.eigvals(instance.jacobian("x")[:4]).real
    np.testing.assert_allclose(-1 / rates.max() / 86400, 2.6, atol=0.05)
