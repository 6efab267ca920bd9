"""Each trap is what it says, called directly: it shows itself, and but for that it is the pendulum."""

from __future__ import annotations

import numpy as np
import pytest

from fmus.models import MODELS
from tests.fmus.equations import everything, partial, point

fmpy = pytest.importorskip("fmpy")

from tests.fmus.instances import ERROR, description, fails_with  # noqa: E402

BOTH = pytest.mark.parametrize("fmi", [2, 3])
TRAPS = {name: model for name, model in MODELS.items() if model.trap}
LOADABLE = [(name, fmi) for name, model in TRAPS.items() if name != "crashes_at_load" for fmi in model.versions]
X, U, P = point("pendulum")
FREE = everything("pendulum")(X, U, P)  # dx and y


def dependencies(root, fmi):
    """Declared dependencies of der(rate) in continuous-time mode, as names; None when not declared."""
    variables = [v.get("name") for v in root.find("ModelVariables")]
    row = str(variables.index("der(rate)") + (fmi == 2))
    structure = root.find("ModelStructure")
    unknowns = structure.find("Derivatives") if fmi == 2 else structure.findall("ContinuousStateDerivative")
    entry = next(e for e in unknowns if row in (e.get("index"), e.get("valueReference")))
    declared = entry.get("dependencies")
    return None if declared is None else {variables[int(k) - (fmi == 2)] for k in declared.split()}


# ---- what they have in common ----


@pytest.mark.parametrize(("name", "fmi"), LOADABLE)
def test_a_trap_is_a_pendulum(opened, name, fmi):
    """Whatever else is wrong, derivatives and outputs are those of the equations, set as an integrator sets them."""
    instance = opened(name, fmi, start={"k": P[0], "c": P[1]})
    instance.set("u", U)
    if instance.kind == "ModelExchange":
        instance.set_states(X)
    else:
        instance.set("x", X)
    np.testing.assert_allclose(np.concatenate([instance.get("dx"), instance.get("y")])[:3], FREE, rtol=1e-14)


@pytest.mark.parametrize(
    ("name", "fmi"), [(n, f) for n, f in LOADABLE if n not in {"no_derivatives", "wrong_derivatives"}]
)
def test_directional_derivatives_are_right_where_that_is_not_the_trap(opened, name, fmi):
    """Jacobians in x, u and p equal central differences of the equations."""
    instance = opened(name, fmi, start={"k": P[0], "c": P[1], "angle": X[0], "rate": X[1], "torque": U[0]})
    for group in "xup":
        got = instance.jacobian(group)[:3, : {"x": 2, "u": 1, "p": 2}[group]]
        np.testing.assert_allclose(got, partial(everything("pendulum"), (X, U, P), group), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("name", "fmi"), [(n, f) for n, f in LOADABLE if "CoSimulation" in MODELS[n].kinds])
def test_the_traps_simulate_alike(opened, name, fmi):
    """Steps of the default length in co-simulation are those of the pendulum."""
    one, other = (opened(n, fmi, "CoSimulation") for n in (name, "pendulum"))
    for k in range(20):
        for instance in (one, other):
            instance.fmu.doStep(k * 0.05, 0.05)
    np.testing.assert_array_equal(one.get("x"), other.get("x"))


# ---- dependencies and derivatives ----


@BOTH
def test_wrong_dependencies_leave_out_a_state_and_a_parameter(unzipped, opened, fmi):
    """The column of angle differs from zero and is not declared; in FMI 3, where parameters count, nor is c."""
    declared = dependencies(description(unzipped("wrong_dependencies", fmi)), fmi)
    assert declared == ({"rate", "torque"} if fmi == 2 else {"rate", "torque", "k"})
    instance = opened("wrong_dependencies", fmi)
    instance.set_point(X, U, P)
    for name in ("angle", "c"):
        assert abs(instance.directional(["dx"], [instance.reference[name]], [1.0])[1]) > 0.1


@BOTH
def test_no_dependencies_declares_none(unzipped, fmi):
    """No element has the attribute; the pendulum's have it."""
    for name, count in (("no_dependencies", 0), ("pendulum", 6)):  # y, two derivatives, and all three initially
        unknowns = description(unzipped(name, fmi)).find("ModelStructure").iter()
        assert sum("dependencies" in unknown.attrib for unknown in unknowns) == count


@BOTH
def test_no_derivatives_says_so_and_fails(unzipped, opened, fmi):
    """The model description denies directional derivatives, and calling the function is an error."""
    root = description(unzipped("no_derivatives", fmi))
    name = "providesDirectionalDerivative" + "s" * (fmi == 3)
    assert [root.find(kind).get(name) for kind in ("ModelExchange", "CoSimulation")] == ["false"] * 2
    instance = opened("no_derivatives", fmi)
    fails_with(ERROR, instance.directional, ["dx"], instance.vr["x"][:1], [1.0])


@BOTH
def test_wrong_derivatives_have_one_wrong_sign(opened, fmi):
    """d der(rate) / d angle is the negative of what it should be, all other entries are right."""
    instance = opened("wrong_derivatives", fmi)
    instance.set_point(X, U, P)
    sign = np.array([[1, 1], [-1, 1], [1, 1]])
    np.testing.assert_allclose(
        instance.jacobian("x"), sign * partial(everything("pendulum"), (X, U, P), "x"), rtol=1e-7, atol=1e-9
    )


@BOTH
def test_stale_values_are_from_before(opened, fmi):
    """Values read after setting states and inputs one by one are old; after setContinuousStates they are right."""
    instance = opened("stale", fmi)
    instance.fmu.enterContinuousTimeMode()
    before = np.concatenate([instance.get("dx"), instance.get("y")])
    for group, values in zip("xup", (X, U, P), strict=True):
        instance.set(group, values)
    np.testing.assert_array_equal(instance.get("x"), X)
    np.testing.assert_array_equal(np.concatenate([instance.get("dx"), instance.get("y")]), before)
    np.testing.assert_array_equal(instance.derivatives(), before[:2])
    instance.set_states(X)
    np.testing.assert_allclose(instance.derivatives(), FREE[:2], rtol=1e-14)
    np.testing.assert_allclose(instance.get("y"), FREE[2:], rtol=1e-14)


# ---- parameters ----


@BOTH
def test_fixed_parameters_refuse_to_change(unzipped, opened, fmi):
    """They are declared fixed, take a value before the initialization, and none after it."""
    known = {v.name: v for v in fmpy.read_model_description(unzipped("fixed_parameters", fmi)).modelVariables}
    assert [known[name].variability for name in ("k", "c")] == ["fixed"] * 2
    instance = opened("fixed_parameters", fmi, start={"k": P[0]})
    for mode in (lambda: None, instance.fmu.enterContinuousTimeMode):
        mode()
        fails_with(ERROR, instance.set, "p", P)
        np.testing.assert_array_equal(instance.get("p"), [P[0], 0.5])
    slave = opened("fixed_parameters", fmi, "CoSimulation")
    fails_with(ERROR, slave.set, "p", P)


@BOTH
def test_strict_parameters_can_be_set_in_event_mode_only(unzipped, opened, fmi):
    """They are declared tunable; event mode takes a value, continuous-time mode does not."""
    known = {v.name: v for v in fmpy.read_model_description(unzipped("strict_parameters", fmi)).modelVariables}
    assert [known[name].variability for name in ("k", "c")] == ["tunable"] * 2
    instance = opened("strict_parameters", fmi)
    instance.set("p", P)
    instance.fmu.enterContinuousTimeMode()
    fails_with(ERROR, instance.set, "p", 2 * P)
    np.testing.assert_array_equal(instance.get("p"), P)
    instance.set("u", U)  # only parameters are refused
    instance.fmu.enterEventMode()
    instance.set("p", 2 * P)
    np.testing.assert_array_equal(instance.get("p"), 2 * P)


# ---- co-simulation ----


@BOTH
@pytest.mark.parametrize("name", ["co_simulation_only", "no_saving", "fixed_step"])
def test_co_simulation_only_knows_its_states(unzipped, opened, name, fmi):
    """There is no model exchange; derivatives and states are listed, and a state that is set is where a step starts."""
    about = fmpy.read_model_description(unzipped(name, fmi))
    assert about.modelExchange is None
    assert [d.variable.derivative.name for d in about.derivatives] == ["angle", "rate"]
    assert about.coSimulation.canGetAndSetFMUstate == (name != "no_saving")
    one, other = opened(name, fmi), opened("pendulum", fmi, "CoSimulation", start={"angle": X[0], "rate": X[1]})
    one.set("x", X)
    for instance in (one, other):
        instance.fmu.doStep(0.0, 0.05)
    np.testing.assert_array_equal(one.get("x"), other.get("x"))


@BOTH
def test_co_simulation_only_cannot_be_instantiated_for_model_exchange(unzipped, fmi):
    """The binary, too, refuses the kind that it does not offer."""
    folder, module = unzipped("co_simulation_only", fmi), getattr(fmpy, f"fmi{fmi}")
    about = fmpy.read_model_description(folder)
    model = getattr(module, f"FMU{fmi}Model")(
        guid=about.guid, modelIdentifier=about.coSimulation.modelIdentifier, unzipDirectory=folder
    )
    with pytest.raises(Exception, match=r"[Ii]nstantiate"):
        model.instantiate()
    model.freeLibrary()


@BOTH
def test_no_saving_cannot_save(opened, fmi):
    """Getting the FMU state is an error."""
    fails_with(ERROR, opened("no_saving", fmi).fmu.getFMUState)


@BOTH
def test_fixed_step_takes_no_other(unzipped, opened, fmi):
    """Steps of the default experiment's stepSize work, longer and shorter ones are errors that change nothing."""
    about = fmpy.read_model_description(unzipped("fixed_step", fmi))
    assert not about.coSimulation.canHandleVariableCommunicationStepSize
    step = float(about.defaultExperiment.stepSize)
    assert fmi == 2 or float(about.coSimulation.fixedInternalStepSize) == step
    instance = opened("fixed_step", fmi)
    for other in (0.5 * step, 2 * step, 1.001 * step):
        fails_with(ERROR, instance.fmu.doStep, 0.0, other)
    np.testing.assert_array_equal(instance.get("x"), [0.5, 0.0])
    instance.fmu.doStep(0.0, step)
    instance.fmu.doStep(step, 2 * step - step)
    assert instance.named("angle") < 0.5


# ---- variables ----


@BOTH
def test_zero_nominal_is_zero_everywhere(unzipped, opened, fmi):
    """In the model description, and in what the binary answers."""
    known = {v.name: v for v in fmpy.read_model_description(unzipped("zero_nominal", fmi)).modelVariables}
    assert float(known["angle"].nominal) == 0.0
    instance = opened("zero_nominal", fmi)
    np.testing.assert_array_equal(instance._vector("getNominalsOfContinuousStates", 2), [0.0, 1.0])


@BOTH
def test_completed_step_counts(unzipped, opened, fmi):
    """Each tenth completed step asks for an event, at which the load grows by 0.1 and der(rate) falls by as much."""
    root = description(unzipped("completed_step", fmi))
    interface = root.find("ModelExchange")
    told = interface.get("completedIntegratorStepNotNeeded"), interface.get("needsCompletedIntegratorStep")
    assert told == (("false", None) if fmi == 2 else (None, "true"))
    instance = opened("completed_step", fmi)
    rate = instance.derivatives()[1]
    for k in (1, 2):
        instance.fmu.enterContinuousTimeMode()
        asked = [instance.fmu.completedIntegratorStep()[0] for _ in range(10)]
        assert asked == [False] * 9 + [True]
        instance.fmu.enterEventMode()
        assert instance.event() == (False, None)
        np.testing.assert_allclose(instance.named("load"), 0.1 * k)
        np.testing.assert_allclose(instance.derivatives()[1], rate - 0.1 * k)


def test_arrays_have_two_entries(opened):
    """The output `motion` is read as one reference and two values; one value for it is an error."""
    instance = opened("arrays", 3)
    instance.set_states(X)
    reference = [instance.reference["motion"]]
    np.testing.assert_array_equal(instance.fmu.getFloat64(reference, 2), X)
    np.testing.assert_array_equal(instance.get("y"), [np.sin(X[0]), *X])
    fails_with(ERROR, instance.fmu.getFloat64, reference, 1)
    fails_with(ERROR, instance.fmu.getFloat64, [reference[0] + 1], 1)  # the second entry has no name
    np.testing.assert_array_equal(instance.jacobian("x")[3:], np.eye(2))
    references = [*instance.vr["dx"], *instance.vr["y"]]
    adjoint = instance.fmu.getAdjointDerivative(references, instance.vr["x"], [0.0, 0.0, 0.0, 2.0, 3.0], 2)
    np.testing.assert_array_equal(adjoint, [2.0, 3.0])


def test_structural_multiplies_the_damping_from_configuration_mode_only(opened):
    """With three dampers der(rate) is that of three times c; outside configuration mode there is no setting it."""
    instance = opened("structural", 3, configuration={"dampers": 3})
    instance.set_point(X, U, P)
    tripled = everything("pendulum")(X, U, P * [1, 3])
    np.testing.assert_allclose(instance.derivatives(), tripled[:2], rtol=1e-14)
    np.testing.assert_allclose(
        instance.jacobian("x"), partial(everything("pendulum"), (X, U, P * [1, 3]), "x"), rtol=1e-7, atol=1e-9
    )
    reference = [instance.reference["dampers"]]
    assert instance.fmu.getUInt64(reference) == [3]
    fails_with(ERROR, instance.fmu.setUInt64, reference, [1])
    fails_with(ERROR, instance.fmu.getFloat64, reference)
