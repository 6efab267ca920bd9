"""Laws of models built from Python functions: what they accept, what they refuse, what the refusal says."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmhe.errors import CtmheError, InputError, ModelError
from ctmhe.models.continuous import ContinuousModel, Model, box_arrays, trial_point
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.signals import Signals
from ctmhe.types import Bounds

finite = st.floats(-1e6, 1e6)
names = st.lists(st.text("abcdefgh", min_size=1, max_size=4), min_size=1, max_size=5, unique=True)


def pendulum(**changes):
    """A damped pendulum with a torque; keywords replace arguments of the constructor."""
    arguments = {
        "f": lambda t, x, u, w, p: [x[1] + w[0], -p[0] * ca.sin(x[0]) - 0.1 * x[1] + u[0]],
        "h": lambda t, x, u, w, p: x[0],
        "x": ("angle", "rate"),
        "u": "torque",
        "w": "push",
        "p": "stiffness",
        "y": "sensor",
        **changes,
    }
    return ContinuousModel(arguments.pop("f"), arguments.pop("h"), **arguments)


# --- what a model is ----------------------------------------------------------------------------------------


def test_a_model_evaluates_its_functions_in_the_order_of_its_names():
    """dynamics(t, x, u, w, p) is f, output is h, as dense columns."""
    model = pendulum()
    value = model.dynamics(0.0, [0.5, 0.2], [0.3], [0.01], [2.0])
    assert value.is_dense() and value.shape == (2, 1)
    np.testing.assert_allclose(np.asarray(value).ravel(), [0.21, -2 * math.sin(0.5) - 0.02 + 0.3], rtol=1e-14)
    assert float(model.output(0.0, [0.5, 0.2], [0.3], [0.01], [2.0])) == 0.5


def test_a_model_satisfies_the_protocol_and_is_continuous():
    """Estimators see the protocol only; step None means continuous time."""
    assert isinstance(pendulum(), Model)
    assert pendulum().step is None


@pytest.mark.parametrize(
    "f",
    [
        lambda t, x, u, w, p: ca.vertcat(x[1], -x[0]),
        lambda t, x, u, w, p: ca.horzcat(x[1], -x[0]),
        lambda t, x, u, w, p: [x[1], -x[0]],
        lambda t, x, u, w, p: (x[1], -x[0]),
        lambda t, x, u, w, p: np.array([x[1], -x[0]], dtype=object),
    ],
)
def test_the_form_in_which_f_returns_its_values_does_not_matter(f):
    """Columns, rows, lists, tuples and object arrays mean the same vector."""
    model = ContinuousModel(f, lambda t, x, u, w, p: x[0], x=("a", "b"), y="c")
    np.testing.assert_array_equal(np.asarray(model.dynamics(0, [3.0, 4.0], [], [], [])).ravel(), [4.0, -3.0])


@pytest.mark.parametrize("constant", [ca.DM([1.0, 2.0]), [1.0, 2.0], np.array([1, 2])])
def test_constant_dynamics_are_dynamics(constant):
    """A right-hand side without symbols is as good as any."""
    model = ContinuousModel(lambda *_: constant, lambda t, x, u, w, p: x[0], x=("a", "b"), y="c")
    np.testing.assert_array_equal(np.asarray(model.dynamics(0, [0, 0], [], [], [])).ravel(), [1.0, 2.0])


def test_structural_zeros_become_numbers():
    """Sparse results are stored dense, so that every consumer sees all entries."""
    model = ContinuousModel(lambda *_: ca.SX(2, 1), lambda t, x, u, w, p: x[0], x=("a", "b"), y="c")
    assert model.dynamics.sparsity_out(0).nnz() == 2


def test_a_sequence_may_hold_vectors():
    """Pieces of a state may be returned as they are."""
    model = ContinuousModel(lambda t, x, u, w, p: [x[1:], -x[0]], lambda t, x, u, w, p: x[0], x=("a", "b"), y="c")
    np.testing.assert_array_equal(np.asarray(model.dynamics(0, [3.0, 4.0], [], [], [])).ravel(), [4.0, -3.0])


def test_the_display_names_every_signal_with_its_unit_and_leaves_out_empty_groups():
    """What is printed is enough to use the model."""
    text = repr(pendulum(units={"angle": "rad", "rate": "rad/s"}, name="swing"))
    assert "ContinuousModel 'swing'" in text
    assert "x: angle [rad], rate [rad/s]" in text
    assert "u: torque" in text and "torque [" not in text
    bare = ContinuousModel(lambda t, x, u, w, p: -x, lambda t, x, u, w, p: x, x="a", y="b")
    assert not any(f"  {key}: " in repr(bare) for key in "uwp")


def test_parameters_start_at_one_or_where_they_are_told():
    """p_start is ones, an array or a mapping, and read-only."""
    assert pendulum().p_start.tolist() == [1.0]
    assert pendulum(p_start=[2.5]).p_start.tolist() == [2.5]
    model = pendulum(p_start={"stiffness": 2.5})
    assert model.p_start.tolist() == [2.5]
    with pytest.raises(ValueError, match="read-only"):
        model.p_start[0] = 0.0


def test_nominals_come_from_the_user_then_from_finite_bounds_then_are_one():
    """Scaling needs no more than what the user said."""
    bounds = Bounds(x={"angle": (-3.0, 2.0), "rate": (-np.inf, 7.0)}, p=(0.0, 40.0))
    model = pendulum(bounds=bounds, nominal={"stiffness": 5.0})
    assert model.x.nominal.tolist() == [3.0, 1.0]
    assert model.p.nominal.tolist() == [5.0]
    assert pendulum(bounds=Bounds(w=(0.0, 0.0))).w.nominal.tolist() == [1.0]


# --- what a model refuses -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda t, x, u, w, p: x[0], "f returned 1 values, expected 2 values"),
        (lambda t, x, u, w, p: [x, x], "f returned 4 values, expected 2 values"),
        (lambda t, x, u, w, p: x @ x.T, r"matrix of shape \(2, 2\)"),
        (lambda t, x, u, w, p: None, "got NoneType"),
        (lambda t, x, u, w, p: "ab", "must return a vector"),
        (lambda t, x, u, w, p: {"angle": x[0]}, "got dict"),
        (lambda t, x, u, w, p: ca.MX.sym("m", 2), "got MX"),
        (lambda t, x, u, w, p: [x[1], x[0] * math.sin(x[0])], "NaN constant: functions of the math module"),
        (lambda t, x, u, w, p: [x[0] if x[0] > 0 else 0, x[1]], r"failed on CasADi symbols: .*ca\.if_else"),
        (lambda t, x, u, w: x, "failed on CasADi symbols: TypeError"),
        (lambda t, x, u, w, p: [x[5], x[0]], "failed on CasADi symbols"),
        (lambda t, x, u, w, p: x * ca.SX.sym("forgotten"), "not its arguments: forgotten"),
        (lambda t, x, u, w, p: x * ca.SX.sym("p"), "not its arguments: p"),
    ],
)
def test_dynamics_that_cannot_be_used_are_refused_with_the_reason(f, message):
    """A wrong f is caught when the model is built, as a ModelError that says what is wrong with it."""
    with pytest.raises(ModelError, match=message):
        pendulum(f=f)


def test_a_wrong_output_is_told_from_wrong_dynamics():
    """The message names h, not f."""
    with pytest.raises(ModelError, match=r"^h returned 2 values, expected 1 value$"):
        pendulum(h=lambda t, x, u, w, p: x)


@pytest.mark.parametrize(
    ("f", "box"),
    [
        (ca.log, (-3.0, -1.0)),
        (ca.sqrt, (0.0, 0.0)),
        (lambda x: 1 / x, (0.0, 0.0)),
    ],
)
def test_a_function_without_finite_derivative_at_the_trial_point_is_refused(f, box):
    """Value and Jacobian are tried inside the bounds; the message says where and what to change."""
    with pytest.raises(ModelError, match=r"f of model 'bad' or its Jacobian is not finite .* bounds=Bounds"):
        ContinuousModel(
            lambda t, x, u, w, p: f(x),
            lambda t, x, u, w, p: x,
            x="a",
            y="b",
            bounds=Bounds(x=box),
            name="bad",
        )


def test_bounds_move_the_trial_point_to_where_the_model_makes_sense():
    """log(x - 5) cannot be tried at the nominal 1, but can in [6, 8]."""
    arguments = (lambda t, x, u, w, p: ca.log(x - 5), lambda t, x, u, w, p: x)
    with pytest.raises(ModelError):
        ContinuousModel(*arguments, x="a", y="b")
    ContinuousModel(*arguments, x="a", y="b", bounds=Bounds(x=(6.0, 8.0)))
    ContinuousModel(*arguments, x="a", y="b", nominal={"a": 7.0})


@pytest.mark.parametrize("title", ["units", "nominal"])
def test_unknown_names_in_units_and_nominals_raise_with_a_suggestion(title):
    """A misspelled name is never ignored."""
    with pytest.raises(InputError, match=f"{title}: unknown signal 'stifness'; did you mean 'stiffness'"):
        pendulum(**{title: {"stifness": 1.0}})
    with pytest.raises(InputError, match=r"unknown signal 'zzz'\. Known: angle, push"):
        pendulum(**{title: {"zzz": 1.0}})


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_nominal_is_finite_and_positive(value):
    """A scale that cannot scale is refused by the name of its signal."""
    with pytest.raises(InputError, match="nominal of state 'rate'"):
        pendulum(nominal={"rate": value})


def test_names_within_a_kind_differ():
    """Two states of one name could not be told apart."""
    with pytest.raises(InputError, match="state names must differ, got angle"):
        pendulum(x=("angle", "angle"))


@pytest.mark.parametrize("kind", ["x", "y"])
def test_a_model_has_a_state_and_an_output(kind):
    """There is nothing to estimate without the one, and nothing to estimate from without the other."""
    with pytest.raises(ModelError, match="at least one state and one output"):
        pendulum(**{kind: ()})


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (Bounds(x={"angel": (0, 1)}), "unknown state 'angel'; did you mean 'angle'"),
        (Bounds(w={"pusch": (0, 1)}), "unknown disturbance 'pusch'; did you mean 'push'"),
        (Bounds(p={"stiff": (0, 1)}), "unknown parameter 'stiff'"),
        (Bounds(y={"angle": (0, 1)}), "unknown output 'angle'"),
        (Bounds(residual={"angle": (0, 1)}), "unknown output 'angle'"),
        (Bounds(x={"angle": 3.0}), "bounds of x: state 'angle' needs a pair"),  # type: ignore[arg-type]
        (Bounds(x={"angle": (1, 2, 3)}), "bounds of x: state 'angle' needs a pair"),  # type: ignore[arg-type]
        (Bounds(x={"angle": ("a", "b")}), "bounds of x: state 'angle' needs a pair"),  # type: ignore[arg-type]
        (Bounds(x=(1.0, 0.0)), "bounds of x: state 'angle' has lower 1.0 above upper 0.0"),
        (Bounds(x=([0, 0], [1, np.nan])), "bounds of x: state 'rate' has lower 0.0 above upper nan"),
        (Bounds(p=(np.inf, np.inf)), "bounds of p: parameter 'stiffness' has no finite value"),
        (Bounds(x=([0, 0, 0], [1, 1, 1])), "bounds of x: expected .* 2 values each"),
        (Bounds(w=3.0), "bounds of w: expected"),  # type: ignore[arg-type]
    ],
)
def test_bounds_that_do_not_fit_the_signals_are_refused_when_the_model_is_built(bounds, message):
    """Every box is checked, not only that of the states; the message names box and signal."""
    with pytest.raises(InputError, match=message):
        pendulum(bounds=bounds)


@pytest.mark.parametrize("p_start", [[1.0, 2.0], [np.nan], {"stifness": 1.0}, {}])
def test_a_start_value_that_does_not_fit_is_refused(p_start):
    """Wrong length, not finite, misspelled or missing."""
    with pytest.raises(InputError):
        pendulum(p_start=p_start)


# --- discrete time ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.0, -0.1, np.nan, np.inf])
def test_a_step_is_a_positive_finite_number_of_seconds(step):
    """No other step is a step."""
    with pytest.raises(InputError, match="step must be a positive number of seconds"):
        DiscreteModel(lambda t, x, u, w, p: x, lambda t, x, u, w, p: x, step=step, x="a", y="b")


def test_a_discrete_model_keeps_its_step_and_satisfies_the_protocol():
    """Same interface; the step says that dynamics is a map."""
    model = DiscreteModel(lambda t, x, u, w, p: 0.5 * x, lambda t, x, u, w, p: x, step=0.1, x="a", y="b")
    assert isinstance(model, Model) and model.step == 0.1
    assert float(model.dynamics(0, [4.0], [], [], [])) == 2.0


# --- signals ------------------------------------------------------------------------------------------------


@given(data=st.data(), labels=names, sign=st.sampled_from([1, -1]), allow_nan=st.booleans())
def test_a_vector_never_holds_an_infinite_value_and_the_error_names_its_signal(data, labels, sign, allow_nan):
    """Whichever entry is infinite, in whichever form it comes."""
    signals = Signals.of("state", labels)
    culprit = data.draw(st.sampled_from(labels))
    values = {name: data.draw(finite) for name in labels} | {culprit: sign * np.inf}
    for form in (values, list(values.values())):
        with pytest.raises(InputError, match=f"here: state '{culprit}' is -?inf, not finite"):
            signals.vector(form, "here", allow_nan=allow_nan)


@given(data=st.data(), labels=names)
def test_a_vector_by_name_equals_the_vector_by_position(data, labels):
    """The order of a mapping does not matter; the result is read-only."""
    signals = Signals.of("input", labels)
    values = data.draw(st.lists(finite, min_size=len(labels), max_size=len(labels)))
    pairs = data.draw(st.permutations(list(zip(labels, values, strict=True))))
    by_name, by_position = signals.vector(dict(pairs), "here"), signals.vector(values, "here")
    np.testing.assert_array_equal(by_name, by_position)
    assert not by_name.flags.writeable and not by_position.flags.writeable


def test_nan_is_a_missing_sensor_only_where_that_is_allowed():
    """Measurements may miss a value; states and parameters may not."""
    signals = Signals.of("output", ("a", "b"))
    assert np.isnan(signals.vector([1.0, np.nan], "here", allow_nan=True)[1])
    with pytest.raises(InputError, match="output 'b' is nan"):
        signals.vector([1.0, np.nan], "here")


@pytest.mark.parametrize("values", [[1.0], [1.0, 2.0, 3.0], np.ones((2, 2)), 1.0, []])
def test_a_vector_of_the_wrong_shape_is_refused_with_the_names_expected(values):
    """The message says how many and which."""
    with pytest.raises(InputError, match=r"expected 2 state values \(a, b\)"):
        Signals.of("state", ("a", "b")).vector(values, "here")


def test_a_misspelled_name_raises_with_the_nearest_one():
    """The error helps."""
    signals = Signals.of("state", ("pressure", "level"))
    with pytest.raises(InputError, match="unknown state 'presure'; did you mean 'pressure'"):
        signals.index("presure")
    with pytest.raises(InputError, match="no value for state level"):
        signals.vector({"pressure": 1.0}, "here")


# --- bounds -------------------------------------------------------------------------------------------------


@given(data=st.data(), labels=names)
def test_the_forms_of_bounds_are_equivalent(data, labels):
    """Scalars, arrays and a mapping that say the same give the same box."""
    signals = Signals.of("state", labels)
    low, high = sorted((data.draw(finite), data.draw(finite)))
    n = len(labels)
    forms = [
        (low, high),
        (np.full(n, low), np.full(n, high)),
        ([low] * n, high),
        np.array([[low] * n, [high] * n]),
        {name: (low, high) for name in data.draw(st.permutations(labels))},
    ]
    for form in forms:
        lower, upper = box_arrays(signals, form, "here")
        np.testing.assert_array_equal(lower, np.full(n, low))
        np.testing.assert_array_equal(upper, np.full(n, high))


@given(labels=names, pair=st.tuples(finite, finite).map(sorted))
def test_signals_that_a_mapping_does_not_name_are_free(labels, pair):
    """A box constrains what it names and nothing else."""
    lower, upper = box_arrays(Signals.of("state", labels), {labels[0]: pair}, "here")
    assert [lower[0], upper[0]] == pair
    assert np.isneginf(lower[1:]).all() and np.isposinf(upper[1:]).all()


side = st.one_of(finite, st.just(np.inf), st.just(-np.inf))


@given(data=st.data(), labels=names)
@settings(max_examples=200)
def test_the_trial_point_is_finite_and_inside_every_box_that_is_accepted(data, labels):
    """A box is either refused or has a finite trial point inside it."""
    signals = Signals.of("state", labels)
    box = {name: (data.draw(side), data.draw(side)) for name in labels}
    try:
        lower, upper = box_arrays(signals, box, "here")
    except CtmheError:
        assert any(low > high or low == np.inf or high == -np.inf for low, high in box.values())
        return
    x = trial_point(signals, box)
    slack = 1e-9 * (1 + np.abs(x))
    assert np.isfinite(x).all() and (lower - slack <= x).all() and (x <= upper + slack).all()
