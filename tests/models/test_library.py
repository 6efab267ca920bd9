"""Every plant of the library against a second derivation, its balances and what is published about it."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel, box_arrays
from ctmhe.models.library import (
    batch_reactor,
    cascaded_tanks,
    chua,
    cstr,
    cstr_discrete,
    cstr_steady_states,
    hover_speed,
    quadrotor,
    quadrotor_discrete,
    random_stable,
    refill,
    refilled_reactor,
    three_species,
    three_species_discrete,
    van_der_pol,
)

PLANTS = {
    "batch_reactor": lambda **k: batch_reactor(parameters=("k1", "k2"), **k),
    "cascaded_tanks": lambda **k: cascaded_tanks(parameters=("k1", "k2", "k3", "k4", "k5", "rim"), **k),
    "chua": lambda **k: chua(parameters=("p", "a1", "a2", "b1", "b2"), **k),
    "cstr": lambda **k: cstr(parameters=("F0", "T0", "c0", "r", "k0", "E_R", "U", "rho", "Cp", "DeltaH"), **k),
    "quadrotor": quadrotor,
    "three_species": lambda **k: three_species(parameters=("p1", "p2", "p3", "p4"), **k),
    "van_der_pol": lambda **k: van_der_pol(parameters=("mu",), **k),
}
NO_PARAMETERS = {
    "batch_reactor": batch_reactor,
    "cascaded_tanks": cascaded_tanks,
    "chua": lambda **k: chua(parameters=(), **k),
    "cstr": cstr,
    "quadrotor": quadrotor,
    "three_species": three_species,
    "van_der_pol": van_der_pol,
}
every_plant = pytest.mark.parametrize("plant", PLANTS)


def evaluate(function, x, u=(), w=None, p=()):
    """Value of dynamics or output as a flat array; w = 0 unless given."""
    w = np.zeros(function.size1_in(3)) if w is None else w
    return np.asarray(function(0.0, x, u, w, p)).ravel()


def random_point(model: ContinuousModel, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A point in the bounds; signals without bounds within one nominal of zero, inputs and p near nominal."""
    lower, upper = box_arrays(model.x, model.bounds.x, "x")
    lower = np.where(np.isfinite(lower), lower, -model.x.nominal)
    upper = np.where(np.isfinite(upper), upper, model.x.nominal)
    return {
        "x": rng.uniform(lower, upper),
        "u": model.u.nominal * rng.uniform(0.8, 1.2, len(model.u)),
        "w": model.w.nominal * rng.uniform(-1, 1, len(model.w)),
        "p": model.p_start * rng.uniform(0.9, 1.1, len(model.p)),
    }


def points(plant: str, count: int = 10):
    """The model with all its parameters in p, and random points of it."""
    model, rng = PLANTS[plant](), np.random.default_rng(7)
    return model, [random_point(model, rng) for _ in range(count)]


# --- what all plants share ----------------------------------------------------------------------------------


@every_plant
def test_jacobians_agree_with_finite_differences(plant):
    """Derivatives of both functions with respect to x, u, w and p, at random points in the bounds.

    Central differences with a step of 1e-6 nominals: truncation (1e-12 times the third derivative) and
    rounding (1e-16 / 1e-6 times the value) are both below the tolerance, relative to the size of the row.
    """
    model, places = points(plant)
    for function in (model.dynamics, model.output):
        symbols = [ca.SX.sym(key, function.size1_in(i)) for i, key in enumerate("txuwp")]
        value = function(*symbols)
        scales = [getattr(model, key).nominal for key in "xuwp"]
        exact = ca.Function("J", symbols, [ca.jacobian(value, ca.vertcat(*symbols[1:]))])
        scale = np.concatenate(scales)
        splits = np.cumsum([len(part) for part in scales])[:-1]

        def at(v, function=function, splits=splits):
            return evaluate(function, *np.split(v, splits))

        for place in places:
            v = np.concatenate([place[key] for key in "xuwp"])
            J = np.asarray(exact(0.0, *np.split(v, splits))) * scale
            steps = 1e-6 * np.diag(scale)
            numeric = np.column_stack([(at(v + step) - at(v - step)) / 2e-6 for step in steps])
            row = np.abs(J).sum(axis=1) + np.abs(at(v))
            assert (np.abs(numeric - J).max(axis=1) <= 1e-6 * row).all()


@every_plant
def test_process_disturbances_are_added_to_the_derivatives_and_noise_to_the_outputs(plant):
    """f(w) - f(0) is the first nx entries of w, h(w) - h(0) is the rest."""
    model, places = points(plant, 3)
    n = len(model.x)
    assert model.w.names == (*(f"w_{s}" for s in model.x), *(f"v_{s}" for s in model.y))
    for place in places:
        x, u, w, p = (place[key] for key in "xuwp")
        change_f = evaluate(model.dynamics, x, u, w, p) - evaluate(model.dynamics, x, u, None, p)
        change_h = evaluate(model.output, x, u, w, p) - evaluate(model.output, x, u, None, p)
        rounding = 1e-12 * (1 + np.abs(evaluate(model.dynamics, x, u, w, p)).max())
        np.testing.assert_allclose(change_f, w[:n], atol=rounding)
        np.testing.assert_allclose(change_h, w[n:], atol=1e-12 * np.abs(x).max())


@every_plant
def test_without_noise_only_the_process_disturbances_are_left(plant):
    """noise=False removes the last ny entries of w and changes nothing else."""
    noisy, quiet = PLANTS[plant](), PLANTS[plant](noise=False)
    assert quiet.w.names == noisy.w.names[: len(noisy.x)]
    place = points(plant, 1)[1][0]
    x, u, p = place["x"], place["u"], place["p"]
    for key in ("dynamics", "output"):
        np.testing.assert_array_equal(
            evaluate(getattr(quiet, key), x, u, None, p), evaluate(getattr(noisy, key), x, u, None, p)
        )


@every_plant
def test_parameters_at_their_start_values_give_the_model_without_parameters(plant):
    """Making a constant a parameter does not change the plant."""
    free, fixed = PLANTS[plant](), NO_PARAMETERS[plant]()
    assert len(fixed.p) == 0
    place = points(plant, 1)[1][0]
    np.testing.assert_allclose(
        evaluate(free.dynamics, place["x"], place["u"], None, free.p_start),
        evaluate(fixed.dynamics, place["x"], place["u"]),
        rtol=1e-12,
        atol=1e-14,
    )


@every_plant
def test_every_quantity_with_a_unit_carries_it(plant):
    """Where the states have units so has everything else; the display shows them; each model has a source."""
    model = PLANTS[plant]()
    if plant not in {"chua", "van_der_pol"}:
        assert all(unit for key in "xuwpy" for unit in getattr(model, key).units)
    assert f"ContinuousModel '{plant}'" in repr(model)
    assert model.source


@pytest.mark.parametrize("plant", [batch_reactor, chua, cstr, van_der_pol, cascaded_tanks, three_species])
def test_unknown_and_repeated_parameters_raise(plant):
    """A parameter is chosen by its name, once."""
    known = {
        batch_reactor: "k1",
        chua: "a1",
        cstr: "DeltaH",
        van_der_pol: "mu",
        cascaded_tanks: "rim",
        three_species: "p3",
    }[plant]
    with pytest.raises(InputError, match=f"unknown parameter '{known}x'; did you mean '{known}'"):
        plant(parameters=(known + "x",))
    with pytest.raises(InputError, match=re.escape(f"parameters must differ, got {known}, {known}")):
        plant(parameters=(known, known))
    assert plant(parameters=known).p.names == (known,)


@pytest.mark.parametrize("plant", [batch_reactor, chua, cstr, cascaded_tanks])
def test_the_order_of_the_parameters_is_that_of_the_user(plant):
    """p[0] is the first name given."""
    chosen = {
        batch_reactor: ("k2", "k1"),
        chua: ("b1", "p"),
        cstr: ("U", "T0"),
        cascaded_tanks: ("rim", "k1"),
    }
    model = plant(parameters=chosen[plant])
    assert model.p.names == chosen[plant]
    np.testing.assert_array_equal(model.p_start, [plant(parameters=name).p_start[0] for name in chosen[plant]])
    np.testing.assert_allclose(
        evaluate(model.dynamics, model.x.nominal, model.u.nominal, None, model.p_start),
        evaluate(plant(parameters=()).dynamics, model.x.nominal, model.u.nominal),
        rtol=1e-12,
    )


# --- batch reactor ------------------------------------------------------------------------------------------

pressure = st.floats(0.1, 5.0)
reactor = batch_reactor()


@given(pA=pressure, pB=pressure)
def test_reactor_follows_the_mass_action_of_its_stoichiometry(pA, pB):
    """dx/dt = stoichiometric matrix times (forward rate - backward rate), nominal k1 and k2 of (3.42)."""
    stoichiometry = np.array([[-2.0, 2.0], [1.0, -1.0]])
    expected = stoichiometry @ [0.16 * pA * pA, 0.0064 * pB]
    np.testing.assert_allclose(evaluate(reactor.dynamics, [pA, pB]), expected, rtol=1e-12, atol=1e-14)
    assert evaluate(reactor.output, [pA, pB])[0] == pA + pB


def test_reactor_conserves_the_substance_and_ends_at_its_equilibrium():
    """pA + 2 pB is constant; from (3, 1) the end solves k1 pA^2 = k2 pB with pA + 2 pB = 5."""
    f = reactor.dynamics
    run = solve_ivp(lambda t, x: evaluate(f, x), (0, 1000), [3.0, 1.0], rtol=1e-10, atol=1e-12, method="LSODA")
    np.testing.assert_allclose(run.y[0] + 2 * run.y[1], 5.0, rtol=1e-12)
    # 2 k1 pA^2 + k2 pA - 5 k2 = 0
    pA = np.roots([2 * 0.16, 0.0064, -5 * 0.0064]).max()
    np.testing.assert_allclose(run.y[:, -1], [pA, (5 - pA) / 2], rtol=1e-8)
    np.testing.assert_allclose(evaluate(f, [pA, (5 - pA) / 2]), 0.0, atol=1e-15)


# --- three species --------------------------------------------------------------------------------------------

concentration = st.floats(0.0, 3.0)


@given(cA=concentration, cB=concentration, cC=concentration)
def test_three_species_follow_the_mass_action_of_their_stoichiometry(cA, cB, cC):
    """dx/dt = stoichiometric matrix times (forward rates - backward rates); 3 cA + cB + 2 cC does not change."""
    stoichiometry = np.array([[-1.0, 0.0], [1.0, -2.0], [1.0, 1.0]])
    expected = stoichiometry @ [0.2 * cA - 0.05 * cB * cC, 0.2 * cB * cB - 0.1 * cC]
    found = evaluate(three_species().dynamics, [cA, cB, cC])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
    assert found @ [3.0, 1.0, 2.0] == pytest.approx(0.0, abs=1e-14)


def test_three_species_euler_step_is_the_published_map():
    """x + 0.25 f(x) + d is (4.70), term by term."""
    (a, b, c), d = (1.3, 0.4, 0.7), np.array([1e-3, -2e-3, 3e-3])
    published = [
        a + 0.25 * (-0.2 * a + 0.05 * b * c) + d[0],
        b + 0.25 * (0.2 * a - 0.05 * b * c - 2 * 0.2 * b**2 + 2 * 0.1 * c) + d[1],
        c + 0.25 * (0.2 * a - 0.05 * b * c + 0.2 * b**2 - 0.1 * c) + d[2],
    ]
    model = three_species_discrete()
    np.testing.assert_allclose(evaluate(model.dynamics, [a, b, c], w=[*d, 0.01]), published, rtol=1e-13)
    assert evaluate(model.output, [a, b, c], w=[*d, 0.01])[0] == pytest.approx(a + b + c + 0.01)
    assert model.step == 0.25


def test_three_species_stay_positive_and_end_at_the_equilibrium_of_both_reactions():
    """From (0.5, 0.05, 0.1) both rates fade; what is conserved decides where."""
    f = three_species().dynamics
    run = solve_ivp(lambda t, x: evaluate(f, x), (0, 500), [0.5, 0.05, 0.1], rtol=1e-10, atol=1e-12, method="LSODA")
    assert run.y.min() > 0
    a, b, c = run.y[:, -1]
    np.testing.assert_allclose([0.2 * a, 0.2 * b**2], [0.05 * b * c, 0.1 * c], rtol=1e-7)
    assert 3 * a + b + 2 * c == pytest.approx(1.75)


# --- quadrotor ----------------------------------------------------------------------------------------------

G, M, INERTIA = 9.8, 1.9, np.diag([5.9e-3, 5.9e-3, 10.7e-3])
E3 = np.array([0.0, 0.0, 1.0])


def wrench(omega):
    """Thrust and torques from the places of the rotors: on the axes x1, x2, -x1, -x2, alternating in spin."""
    positions = 0.25 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    forces = -1e-5 * np.outer(omega**2, E3)  # up, against the third axis
    drag = 1e-6 * np.array([-1, 1, -1, 1]) @ omega**2 * E3
    return -forces.sum(axis=0)[2], np.cross(positions, forces).sum(axis=0) + drag


def attitude(xi):
    """R from the library of rotations: intrinsic yaw, pitch, roll."""
    return Rotation.from_euler("ZYX", [xi[2], xi[1], xi[0]]).as_matrix()


def flight_cases():
    rng = np.random.default_rng(3)
    for _ in range(20):
        angles, rates = rng.uniform(-np.pi / 6, np.pi / 6, 3), rng.uniform(-1, 1, 3)
        yield rng.normal(size=3), angles, rng.normal(size=3), rates, rng.uniform(0, 1500, 4)


def derivative(z, xi, s, rates, u):
    value = evaluate(quadrotor_dynamics, np.concatenate([z, xi, s, rates]), u)
    return value[:3], value[3:6], value[6:9], value[9:]


quadrotor_dynamics = quadrotor().dynamics


def test_quadrotor_attitude_moves_as_a_rotation_with_the_body_rates():
    """dR/dt = R O^x, the derivative of R along dxi/dt by central differences (error about h^2 = 1e-10)."""
    for z, xi, s, rates, u in flight_cases():
        _, dxi, _, _ = derivative(z, xi, s, rates, u)
        h = 1e-5
        numeric = (attitude(xi + h * dxi) - attitude(xi - h * dxi)) / (2 * h)
        cross = np.cross(np.eye(3), rates)  # rows e_i x O: the matrix O^x
        np.testing.assert_allclose(cross @ s, np.cross(rates, s), atol=1e-12)
        np.testing.assert_allclose(numeric, attitude(xi) @ cross, atol=1e-8)


def test_quadrotor_obeys_newton_and_euler():
    """Accelerations from forces on the rotors in their places, with an independent rotation: (3.45)."""
    for z, xi, s, rates, u in flight_cases():
        dz, _, ds, dO = derivative(z, xi, s, rates, u)
        thrust, torque = wrench(u)
        R = attitude(xi)
        force = M * G * E3 - thrust * R @ E3 - R @ (1.14 * np.cross(E3, rates))
        moment = torque - np.cross(rates, INERTIA @ rates) - 0.0297 * rates[2] * E3
        np.testing.assert_array_equal(dz, s)
        np.testing.assert_allclose(ds, force / M, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(dO, np.linalg.solve(INERTIA, moment), rtol=1e-11, atol=1e-10)


def test_quadrotor_energy_changes_by_the_power_of_thrust_torques_and_drag():
    """d/dt (m |s|^2 / 2 - m g z3 + O' J O / 2): gravity and the gyroscopic torque do no net work."""
    for z, xi, s, rates, u in flight_cases():
        dz, _, ds, dO = derivative(z, xi, s, rates, u)
        change = M * s @ ds - M * G * dz[2] + rates @ INERTIA @ dO
        thrust, torque = wrench(u)
        R = attitude(xi)
        power = -thrust * s @ R @ E3 - s @ R @ (1.14 * np.cross(E3, rates)) + rates @ torque - 0.0297 * rates[2] ** 2
        np.testing.assert_allclose(change, power, rtol=1e-10, atol=1e-10)


@given(place=st.tuples(*[st.floats(-100, 100)] * 3), heading=st.floats(-np.pi, np.pi))
def test_quadrotor_hovers_anywhere_at_the_hover_speed(place, heading):
    """Level, at rest, with four times the hover speed: an equilibrium, for every position and yaw."""
    x = np.concatenate([place, [0.0, 0.0, heading], np.zeros(6)])
    np.testing.assert_allclose(evaluate(quadrotor_dynamics, x, np.full(4, hover_speed())), 0.0, atol=1e-12)
    assert 4 * 1e-5 * hover_speed() ** 2 == pytest.approx(M * G, rel=1e-14)


def test_quadrotor_measures_position_and_orientation():
    """y = (z, xi)."""
    np.testing.assert_array_equal(evaluate(quadrotor().output, np.arange(12.0), np.zeros(4)), np.arange(6.0))


# --- modified Chua circuit ----------------------------------------------------------------------------------


circuit = chua().dynamics


def chua_second_form(x, p=0.45):
    """Linear part as a matrix, nonlinearity as a polynomial."""
    A = np.array([[0.0, 12.8, 0.0], [1.0, -1.0, 1.0], [0.0, -19.1, 0.0]])
    return A @ x - 12.8 * np.polyval([p, -1.1, 0.6, 0.0], x[0]) * np.array([1.0, 0.0, 0.0])


@given(x=st.tuples(st.floats(-1, 3), st.floats(-1, 1), st.floats(-3, 3)), p=st.floats(0.2, 0.8))
def test_chua_equals_its_matrix_form(x, p):
    """Written another way, the same derivative."""
    np.testing.assert_allclose(evaluate(circuit, x, p=[p]), chua_second_form(np.array(x), p), rtol=1e-11, atol=1e-11)


def test_chua_euler_step_is_the_published_map():
    """x + 0.01 f(x) is the discrete-time system of thesis 5.2.4, term by term."""
    x1, x2, x3, p = 1.3, -0.2, 0.7, 0.45
    step = np.array([x1, x2, x3]) + 0.01 * evaluate(circuit, [x1, x2, x3], p=[p])
    published = [
        x1 + 0.01 * 12.8 * (x2 - 0.6 * x1 + 1.1 * x1**2 - p * x1**3),
        x2 + 0.01 * (x1 - x2 + x3),
        x3 - 0.01 * 19.1 * x2,
    ]
    np.testing.assert_allclose(step, published, rtol=1e-13)


def test_chua_has_the_equilibria_of_its_cubic():
    """x2 = 0, x3 = -x1 and x1 a real root of x1 (p x1^2 + a2 x1 + a1): three of them need a2^2 > 4 p a1."""
    for p in (0.45, 0.2):
        roots = np.roots([p, -1.1, 0.6])
        three = np.square(-1.1) > 4 * p * 0.6
        assert bool(np.isreal(roots).all()) == three
        for x1 in (0.0, *roots[np.isreal(roots)].real):
            np.testing.assert_allclose(evaluate(circuit, [x1, 0.0, -x1], p=[p]), 0.0, atol=1e-13)


def test_chua_is_chaotic_inside_the_published_box():
    """Two starts 1e-9 apart differ by more than 0.1 within 200 s, and both stay in the set X of 5.2.4."""
    model = chua(parameters=())
    lower, upper = box_arrays(model.x, model.bounds.x, "x")
    symbols = [ca.SX.sym(key, model.dynamics.size1_in(i)) for i, key in enumerate("txuwp")]
    x, h = symbols[1], 0.01

    def f(state):
        return model.dynamics(0, state, [], np.zeros(4), [])

    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    k4 = f(x + h * k3)
    run = ca.Function("step", [x], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)]).mapaccum(20000)
    near = [np.asarray(run(start)) for start in ([1.0, 0.0, -1.0], [1.0 + 1e-9, 0.0, -1.0])]
    for path in near:
        assert (path >= lower[:, None]).all() and (path <= upper[:, None]).all()
    assert np.abs(near[0] - near[1]).max() > 0.1


# --- stirred tank -------------------------------------------------------------------------------------------


tank = cstr().dynamics


def test_cstr_rests_at_the_published_steady_state():
    """[0.878, 324.5, 0.659] at u = [300, 0.1], to its digits (thesis 6.4.2, misprint 323.5 corrected)."""
    coolest = cstr_steady_states(300.0, h=0.659)[0]
    half_a_digit = np.array([0.5e-3, 0.05, 0.5e-3])
    assert (np.abs(coolest - [0.878, 324.5, 0.659]) <= half_a_digit).all()
    np.testing.assert_allclose(evaluate(tank, coolest, [300.0, 0.1]), 0.0, atol=1e-12)
    # the rounded values are at rest too, as far as rounding allows: |f| <= |J| half a digit
    f = tank
    symbols = [ca.SX.sym(key, f.size1_in(i)) for i, key in enumerate("txuwp")]
    J = ca.Function("J", symbols, [ca.jacobian(f(*symbols), symbols[1])])
    allowed = np.abs(np.asarray(J(0, coolest, [300, 0.1], np.zeros(4), []))) @ half_a_digit
    assert (np.abs(evaluate(f, [0.878, 324.5, 0.659], [300.0, 0.1])) <= 1.1 * allowed + 1e-15).all()


@settings(max_examples=30)
@given(T_c=st.floats(250.0, 350.0), h=st.floats(0.5, 1.5))
def test_every_reported_steady_state_is_one_and_their_number_is_odd(T_c, h):
    """The heat balance is positive in the cold and negative in the heat: one or three zeros."""
    states = cstr_steady_states(T_c, h=h)
    assert len(states) in {1, 3}
    assert (np.diff(states[:, 1]) > 0).all()
    for state in states:
        np.testing.assert_allclose(evaluate(tank, state, [T_c, 0.1]), 0.0, atol=1e-9)


def test_the_operating_point_is_stable_and_the_middle_one_is_not():
    """The source calls the coolest steady state open-loop stable; the level integrates."""
    f = tank
    symbols = [ca.SX.sym(key, f.size1_in(i)) for i, key in enumerate("txuwp")]
    J = ca.Function("J", symbols, [ca.jacobian(f(*symbols), symbols[1])])
    cool, middle, _ = (
        np.linalg.eigvals(np.asarray(J(0, x, [300, 0.1], np.zeros(4), []))[:2, :2]) for x in cstr_steady_states()
    )
    assert cool.real.max() < 0
    assert middle.real.max() > 0


vessel = st.tuples(st.floats(0.5, 1.5), st.floats(200.0, 400.0), st.floats(0.5, 1.5))


@given(x=vessel, u=st.tuples(st.floats(250, 350), st.floats(0.0, 0.2)))
def test_cstr_balances_substance_heat_and_volume(x, u):
    """Moles, enthalpy and volume of the contents, in SI time: in - out + made, from first principles.

    The outlet carries the composition and temperature of the contents, the wall 2 pi r h exchanges heat.
    """
    (c, T, h), (T_c, F) = x, u
    dc, dT, dh = evaluate(tank, x, u)
    area, F0, out = np.pi * 0.219**2, 0.1 / 60, F / 60
    rate = 7.2e10 / 60 * np.exp(-8750 / T) * c * area * h  # kmol/s
    tolerance = {"rtol": 1e-9, "atol": 1e-9}
    np.testing.assert_allclose(area * dh, F0 - out, **tolerance)
    np.testing.assert_allclose(area * (h * dc + c * dh), F0 * 1.0 - out * c - rate, **tolerance)
    heat_capacity = 1000 * 0.239
    wall = 2 * np.pi * 0.219 * h * 54.94 / 60 * (T_c - T)
    np.testing.assert_allclose(
        heat_capacity * area * (h * dT + T * dh),
        heat_capacity * (F0 * 350 - out * T) + 5e4 * rate + wall,
        rtol=1e-9,
        atol=1e-7,
    )


def test_cstr_counts_seconds():
    """An overflow of 0.01 m3/min lowers the level by 0.01 / A over 60 s, not over 1 s."""
    dh = evaluate(tank, [0.9, 320.0, 0.7], [300.0, 0.11])[2]
    assert 60 * dh == pytest.approx(-0.01 / (np.pi * 0.219**2), rel=1e-12)


@pytest.mark.parametrize("arguments", [{"T_c": 0.0}, {"h": -1.0}, {"h": np.nan}, {"T_c": np.inf}])
def test_steady_states_of_an_impossible_tank_raise(arguments):
    """Temperatures and levels are positive."""
    with pytest.raises(InputError, match="must be positive and finite"):
        cstr_steady_states(**arguments)


# --- van der Pol --------------------------------------------------------------------------------------------


def test_van_der_pol_cycle_has_the_published_period():
    """For mu = 1 the limit cycle has period 6.66328686 (a standard value), whatever the start."""
    f = van_der_pol().dynamics

    def crossing(t, x):
        return x[0]

    crossing.direction = 1.0  # type: ignore[attr-defined]
    for start in ([0.1, 0.0], [4.0, -1.0]):
        run = solve_ivp(
            lambda t, x: evaluate(f, x),
            (0, 60),
            start,
            events=crossing,
            rtol=1e-9,
            atol=1e-11,
            method="DOP853",
        )
        assert np.diff(run.t_events[0])[-1] == pytest.approx(6.66328686, abs=1e-6)


oscillator = van_der_pol(parameters="mu").dynamics


@given(x1=st.floats(-3, 3), x2=st.floats(-3, 3), mu=st.floats(0, 10))
def test_van_der_pol_energy_changes_by_its_damping(x1, x2, mu):
    """d/dt (x1^2 + x2^2) / 2 = mu (1 - x1^2) x2^2: gained inside |x1| < 1, lost outside."""
    dx = evaluate(oscillator, [x1, x2], p=[mu])
    np.testing.assert_allclose(x1 * dx[0] + x2 * dx[1], mu * (1 - x1**2) * x2**2, rtol=1e-9, atol=1e-9)
    assert dx[0] == x2


@pytest.mark.parametrize("mu", [-0.1, np.nan, np.inf])
def test_van_der_pol_damping_is_finite_and_not_negative(mu):
    """Other values have no limit cycle."""
    with pytest.raises(InputError, match="mu must be finite and not negative"):
        van_der_pol(mu=mu)


# --- cascaded tanks -----------------------------------------------------------------------------------------

K = {"k1": 0.05, "k2": 0.03, "k3": 0.04, "k4": 0.06}
ALL = (*K, "k5")
tanks = cascaded_tanks(parameters=ALL).dynamics
below = st.floats(0.5, 9.0)


@given(upper=below, lower=below, pump=st.floats(0, 7), k5=st.floats(0, 1))
def test_tanks_below_the_rim_follow_torricelli(upper, lower, pump, k5):
    """The benchmark's equations without overflow.

    The guard changes the root by a factor 1 - (0.01/z)^2 / 4 > 1 - 1.1e-4; the spill at 1 V below the rim is
    0.05 exp(-20) = 1e-10.
    """
    k1, k2, k3, k4 = K.values()
    expected = [-k1 * np.sqrt(upper) + k4 * pump, k2 * np.sqrt(upper) - k3 * np.sqrt(lower)]
    got = evaluate(tanks, [upper, lower], [pump], p=[*K.values(), k5])
    np.testing.assert_allclose(got, expected, atol=1.1e-4 * (k1 + k2 + k3) * 3)


@given(upper=below, lower=below, pump=st.floats(0, 7))
def test_tanks_conserve_water_below_the_rim(upper, lower, pump):
    """In lower volts (factor k2/k1) the contents change by what is pumped in less what runs out below."""
    k1, k2, _, k4 = K.values()
    d_upper, d_lower = evaluate(tanks, [upper, lower], [pump], p=[*K.values(), 0.5])
    drain = evaluate(tanks, [0.0, lower], [0.0], p=[*K.values(), 0.5])[1]  # -k3 root(lower), nothing else
    np.testing.assert_allclose(k2 / k1 * d_upper + d_lower, k2 / k1 * k4 * pump + drain, atol=1e-9)


@given(upper=st.floats(9.0, 13.0), lower=st.floats(0.0, 13.0), k5=st.floats(0, 1))
def test_tanks_lose_only_what_is_spilled_and_not_caught(upper, lower, k5):
    """With k5 = 1 the upper tank's overflow is not lost; each per cent less loses a per cent of it."""
    scale = K["k2"] / K["k1"]

    def total(fraction):
        d_upper, d_lower = evaluate(tanks, [upper, lower], [3.0], p=[*K.values(), fraction])
        return scale * d_upper + d_lower

    inflow = scale * K["k4"] * 3.0
    bottom_and_rim = evaluate(tanks, [0.0, lower], [0.0], p=[*K.values(), 1.0])[1]
    np.testing.assert_allclose(total(1.0), inflow + bottom_and_rim, atol=1e-9)
    spilled = scale * 0.05 * np.logaddexp(0.0, (upper - 10.0) / 0.05)
    np.testing.assert_allclose(total(1.0) - total(k5), (1 - k5) * spilled, atol=1e-9)


def test_a_flooded_tank_stays_near_its_rim():
    """At full pump voltage the level ends where inflow = outflow + spill: at most k4 u * 1 s above the rim."""
    f = cascaded_tanks().dynamics
    run = solve_ivp(lambda t, x: evaluate(f, x, [6.5]), (0, 2000), [3.0, 3.0], method="LSODA", rtol=1e-8)
    upper, lower = run.y[:, -1]
    assert 10.0 < upper < 10.0 + 0.0410 * 6.5
    assert 10.0 < lower < 10.0 + 0.0485 / 0.0497 * 0.0410 * 6.5
    assert run.y.max() == pytest.approx(max(upper, lower), abs=1e-4)


only_k3 = cascaded_tanks(parameters="k3").dynamics


@given(z=st.floats(-11, 11))
def test_outflow_is_odd_smooth_and_never_infinite(z):
    """An empty or slightly negative tank has a finite slope: at most k3 / sqrt(0.01) everywhere."""
    f = only_k3
    out = -evaluate(f, [0.0, z], [0.0], p=[1.0])[1]
    mirrored = -evaluate(f, [0.0, -z], [0.0], p=[1.0])[1]
    over = 0.05 * (np.logaddexp(0, (z - 10) / 0.05) + np.logaddexp(0, (-z - 10) / 0.05))
    np.testing.assert_allclose(out + mirrored, over, atol=1e-10)
    symbols = [ca.SX.sym(key, f.size1_in(i)) for i, key in enumerate("txuwp")]
    J = ca.Function("J", symbols, [ca.jacobian(f(*symbols)[1], symbols[1][1])])
    slope = -float(J(0, [0.0, z], [0.0], np.zeros(3), [1.0]))
    assert 0.0 < slope <= 10.0 + 1.0


def test_an_empty_tank_without_pump_rests():
    """Zero is an equilibrium, up to the softplus tail 0.05 exp(-200)."""
    np.testing.assert_allclose(evaluate(cascaded_tanks().dynamics, [0.0, 0.0], [0.0]), 0.0, atol=1e-80)


# --- discrete-time plants of thesis 6.4 ----------------------------------------------------------------------


@given(x=st.tuples(st.floats(0.0, 5.0), st.floats(0.0, 5.0)), w=st.tuples(*[st.floats(-0.05, 0.05)] * 2))
def test_the_refilled_reactor_conserves_and_fills(x, w):
    """(6.80): pA + 2 pB changes by inputs and disturbances only, pB by the rate; refilling gives (3, 0) exactly."""
    model, u = refilled_reactor(step=0.1), np.array([0.3, -0.2])
    after = evaluate(model.dynamics, x, u, w)
    gained = np.array([1.0, 2.0]) @ (u + np.array(w))
    np.testing.assert_allclose(after[0] + 2 * after[1], x[0] + 2 * x[1] + gained, atol=1e-12)
    np.testing.assert_allclose(after[1] - x[1] - u[1] - w[1], 0.1 * (0.16 * x[0] ** 2 - 0.0064 * x[1]), atol=1e-12)
    np.testing.assert_allclose(evaluate(model.dynamics, x, refill(np.array(x))), [3.0, 0.0], atol=1e-12)
    assert evaluate(model.output, x, u)[0] == pytest.approx(x[0] + x[1])


def test_the_discrete_stirred_tank_is_the_flow_over_a_step():
    """One Runge-Kutta step of 15 s against a fine integration: off by the method's error only, w on top."""
    flow, model, rng = cstr(noise=False).dynamics, cstr_discrete(), np.random.default_rng(0)
    for _ in range(5):
        x = np.array([0.88, 324.0, 0.66]) * rng.uniform(0.98, 1.02, 3)
        u, w = np.array([rng.uniform(290, 305), rng.uniform(0.09, 0.11)]), rng.normal(size=3) * 1e-3
        fine = solve_ivp(lambda _, z, u=u: evaluate(flow, z, u), (0, 15.0), x, rtol=1e-10, atol=1e-10).y[:, -1]
        np.testing.assert_allclose(evaluate(model.dynamics, x, u, w), fine + w, rtol=2e-3)
    coarse, half = cstr_discrete(step=4.0), cstr_discrete(step=2.0)
    fine = solve_ivp(lambda _, z: evaluate(flow, z, u), (0, 4.0), x, rtol=1e-12, atol=1e-12).y[:, -1]
    twice = evaluate(half.dynamics, evaluate(half.dynamics, x, u), u)
    assert abs(twice[1] - fine[1]) < abs(evaluate(coarse.dynamics, x, u)[1] - fine[1]) / 12  # order 4: a sixteenth


def test_the_discrete_quadrotor_is_an_euler_step_of_the_flow():
    """x + 0.05 f(x, u) + w with f from forces on the rotors: the balance of momentum over a step."""
    model, rng = quadrotor_discrete(), np.random.default_rng(1)
    for z, xi, s, rates, u in flight_cases():
        w = rng.normal(size=12) * 1e-2
        x = np.concatenate([z, xi, s, rates])
        thrust, _ = wrench(u)
        R = attitude(xi)
        force = M * G * E3 - thrust * R @ E3 - R @ (1.14 * np.cross(E3, rates))
        after = evaluate(model.dynamics, x, u, w)
        np.testing.assert_allclose(after[:3], z + 0.05 * s + w[:3], atol=1e-12)
        np.testing.assert_allclose(after[6:9], s + 0.05 * force / M + w[6:9], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(evaluate(model.output, x, u), x[:6])


@given(states=st.integers(1, 24), seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_random_systems_are_stable_and_the_seed_decides(states, seed):
    """All poles inside the unit circle, A normal (so that no state grows even in passing), the same for one seed."""
    A, B, C = random_stable(states, 2, 3, seed=seed)
    assert np.abs(np.linalg.eigvals(A)).max() < 1.0 and np.linalg.norm(A, 2) < 1.0
    np.testing.assert_allclose(A @ A.T, A.T @ A, atol=1e-12)
    assert (B.shape, C.shape) == ((states, 2), (3, states))
    for one, other in zip((A, B, C), random_stable(states, 2, 3, seed=np.random.default_rng(seed)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_sizes_of_random_systems_are_checked():
    """Sizes are positive integers."""
    with pytest.raises(InputError, match="random_stable: outputs"):
        random_stable(3, 1, 0)
