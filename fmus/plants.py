"""The plants: every name, unit, start value and dependency that their FMUs declare."""

from __future__ import annotations

from math import sqrt

from fmus.variables import Description, Variable

BATCH_REACTOR = Description(
    "batch_reactor",
    "Reversible reaction 2A <-> B in a batch reactor of constant volume",
    states=(
        Variable("pA", "bar", 3.0, 1.0, "partial pressure of A", ("pA", "pB", "d_pA", "k1", "k2")),
        Variable("pB", "bar", 1.0, 1.0, "partial pressure of B", ("pA", "pB", "d_pB", "k1", "k2")),
    ),
    inputs=(
        Variable("d_pA", "bar/s", 0.0, 1.0, "disturbance added to the derivative of pA"),
        Variable("d_pB", "bar/s", 0.0, 1.0, "disturbance added to the derivative of pB"),
    ),
    parameters=(
        Variable("k1", "1/(bar.s)", 0.16, 0.16, "rate constant of the forward reaction"),
        Variable("k2", "1/s", 0.0064, 0.0064, "rate constant of the backward reaction"),
    ),
    outputs=(Variable("pressure", "bar", None, 1.0, "total pressure pA + pB", ("pA", "pB")),),
    stop=10.0,
    step=0.1,
)

VAN_DER_POL = Description(
    "van_der_pol",
    "Van der Pol oscillator, stiff for large mu",
    states=(
        Variable("x0", "1", 2.0, 1.0, "position", ("x1", "d_x0")),
        Variable("x1", "1", 0.0, 1.0, "velocity", ("x0", "x1", "d_x1", "mu")),
    ),
    inputs=(
        Variable("d_x0", "1/s", 0.0, 1.0, "disturbance added to the derivative of x0"),
        Variable("d_x1", "1/s", 0.0, 1.0, "disturbance added to the derivative of x1"),
    ),
    parameters=(Variable("mu", "1", 1.0, 1.0, "strength of the damping"),),
    outputs=(Variable("y_x0", "1", None, 1.0, "position", ("x0",)),),
    stop=20.0,
    step=0.1,
    stiff=True,
)

_ATTITUDE = ("phi", "theta", "psi")
_ROTORS = ("omega1", "omega2", "omega3", "omega4")
_INERTIA = ("J1", "J2", "J3")
_FORCE = ("O1", "O2", *_ROTORS, "m", "cT", "b")
_HOVER = sqrt(1.9 * 9.8 / 4e-5)  # rotor speed whose thrust 4 cT omega^2 carries the weight m g
_POSE = {
    "z1": ("m", "position, north"),
    "z2": ("m", "position, east"),
    "z3": ("m", "position, down"),
    "phi": ("rad", "roll"),
    "theta": ("rad", "pitch"),
    "psi": ("rad", "yaw"),
}

QUADROTOR = Description(
    "quadrotor",
    "Quadrotor with flexible rotor blades in still air",
    states=(
        Variable("z1", "m", 0.0, 1.0, "position, north", ("s1",)),
        Variable("z2", "m", 0.0, 1.0, "position, east", ("s2",)),
        Variable("z3", "m", 0.0, 1.0, "position, down", ("s3",)),
        Variable("phi", "rad", 0.0, 1.0, "roll", ("phi", "theta", "O1", "O2", "O3")),
        Variable("theta", "rad", 0.0, 1.0, "pitch", ("phi", "O2", "O3")),
        Variable("psi", "rad", 0.0, 1.0, "yaw", ("phi", "theta", "O2", "O3")),
        Variable("s1", "m/s", 0.0, 1.0, "velocity, north", (*_ATTITUDE, *_FORCE)),
        Variable("s2", "m/s", 0.0, 1.0, "velocity, east", (*_ATTITUDE, *_FORCE)),
        Variable("s3", "m/s", 0.0, 1.0, "velocity, down", ("phi", "theta", *_FORCE, "g")),
        Variable(
            "O1",
            "rad/s",
            0.0,
            1.0,
            "rate about body axis 1",
            ("O2", "O3", "omega2", "omega4", "l", "cT", *_INERTIA),
        ),
        Variable(
            "O2",
            "rad/s",
            0.0,
            1.0,
            "rate about body axis 2",
            ("O1", "O3", "omega1", "omega3", "l", "cT", *_INERTIA),
        ),
        Variable(
            "O3",
            "rad/s",
            0.0,
            1.0,
            "rate about body axis 3",
            ("O1", "O2", "O3", *_ROTORS, "cQ", "d", *_INERTIA),
        ),
    ),
    inputs=tuple(Variable(name, "rad/s", _HOVER, 1000.0, f"speed of rotor {name[-1]}") for name in _ROTORS),
    parameters=(
        Variable("m", "kg", 1.9, 1.9, "mass"),
        Variable("g", "m/s2", 9.8, 9.8, "gravity"),
        Variable("l", "m", 0.25, 0.25, "arm from the centre to a rotor"),
        Variable("cT", "N.s2", 1e-5, 1e-5, "thrust of a rotor per squared speed"),
        Variable("cQ", "N.m.s2", 1e-6, 1e-6, "torque of a rotor per squared speed"),
        Variable("J1", "kg.m2", 5.9e-3, 5.9e-3, "moment of inertia about body axis 1"),
        Variable("J2", "kg.m2", 5.9e-3, 5.9e-3, "moment of inertia about body axis 2"),
        Variable("J3", "kg.m2", 10.7e-3, 10.7e-3, "moment of inertia about body axis 3"),
        Variable("b", "kg.m/s", 1.14, 1.14, "coupling of body rates into forces, B = b skew(e3)"),
        Variable("d", "N.m.s", 0.0297, 0.0297, "damping of the rate about body axis 3, D = d e3 e3'"),
    ),
    outputs=tuple(Variable(f"y_{n}", unit, None, 1.0, text, (n,)) for n, (unit, text) in _POSE.items()),
    stop=10.0,
    step=0.05,
)

CHUA = Description(
    "chua",
    "Modified Chua circuit: a chaotic oscillator with a cubic resistor, without dimension",
    states=(
        Variable("x1", "1", 0.5, 2.0, "capacitor behind the resistor", ("x1", "x2", "d_x1", "b1", "a1", "a2", "p")),
        Variable("x2", "1", 0.1, 0.3, "second capacitor", ("x1", "x2", "x3", "d_x2")),
        Variable("x3", "1", -0.5, 3.0, "inductor", ("x2", "d_x3", "b2")),
    ),
    inputs=tuple(
        Variable(f"d_{name}", "1/s", 0.0, 0.1, f"disturbance added to the derivative of {name}")
        for name in ("x1", "x2", "x3")
    ),
    parameters=(
        Variable("p", "1", 0.45, 0.45, "cubic coefficient of the resistor"),
        Variable("a1", "1", 0.6, 0.6, "linear coefficient of the resistor"),
        Variable("a2", "1", -1.1, 1.1, "quadratic coefficient of the resistor"),
        Variable("b1", "1/s", 12.8, 12.8, "rate of x1"),
        Variable("b2", "1/s", 19.1, 19.1, "rate of x3"),
    ),
    outputs=(Variable("voltage", "1", None, 2.0, "x1", ("x1",)),),
    stop=10.0,
    step=0.01,
)

_ZONE, _WALL = "temperature of the air in zone ", "temperature of the outer wall of zone "

BUILDING = Description(
    "building",
    "Building of two zones with one outer wall each, heated by radiators and the sun",
    states=(
        Variable(
            "T1",
            "K",
            293.15,
            300.0,
            _ZONE + "1",
            ("T1", "T2", "Tw1", "heat1", "solar", "R_zw", "R_zz", "C_z", "A1"),
            1e-3,
        ),
        Variable(
            "T2",
            "K",
            291.15,
            300.0,
            _ZONE + "2",
            ("T1", "T2", "Tw2", "heat2", "solar", "R_zw", "R_zz", "C_z", "A2"),
            1e-3,
        ),
        Variable("Tw1", "K", 288.15, 300.0, _WALL + "1", ("T1", "Tw1", "T_out", "R_zw", "R_wo", "C_w"), 1e-4),
        Variable("Tw2", "K", 287.15, 300.0, _WALL + "2", ("T2", "Tw2", "T_out", "R_zw", "R_wo", "C_w"), 1e-4),
    ),
    inputs=(
        Variable("T_out", "K", 278.15, 300.0, "temperature outdoors"),
        Variable("solar", "W/m2", 0.0, 500.0, "solar irradiation"),
        Variable("heat1", "W", 0.0, 1e3, "heating power in zone 1"),
        Variable("heat2", "W", 0.0, 1e3, "heating power in zone 2"),
    ),
    parameters=(
        Variable("R_zw", "K/W", 5e-3, 5e-3, "resistance from a zone to its wall"),
        Variable("R_wo", "K/W", 2e-2, 2e-2, "resistance from a wall to the outdoors"),
        Variable("R_zz", "K/W", 1e-2, 1e-2, "resistance between the zones"),
        Variable("C_z", "J/K", 1e6, 1e6, "capacity of a zone: air and furniture"),
        Variable("C_w", "J/K", 1e7, 1e7, "capacity of a wall"),
        Variable("A1", "m2", 4.0, 4.0, "area through which the sun heats zone 1, to the south"),
        Variable("A2", "m2", 1.0, 1.0, "area through which the sun heats zone 2, to the north"),
    ),
    outputs=(
        Variable("y_T1", "K", None, 300.0, _ZONE + "1", ("T1",)),
        Variable("y_T2", "K", None, 300.0, _ZONE + "2", ("T2",)),
        Variable("loss", "W", None, 1e3, "heat flow from the walls to the outdoors", ("Tw1", "Tw2", "T_out", "R_wo")),
    ),
    stop=86400.0,
    step=300.0,
    stiff=True,
)

PENDULUM = Description(
    "pendulum",
    "Damped pendulum with a torque at its pivot: the model of the traps, without a trap",
    states=(
        Variable("angle", "rad", 0.5, 1.0, "angle from the vertical", ("rate",)),
        Variable("rate", "rad/s", 0.0, 1.0, "rate of the angle", ("angle", "rate", "torque", "k", "c")),
    ),
    inputs=(Variable("torque", "rad/s2", 0.0, 1.0, "torque divided by the moment of inertia"),),
    parameters=(
        Variable("k", "1/s2", 4.0, 4.0, "gravity divided by length"),
        Variable("c", "1/s", 0.5, 0.5, "damping"),
    ),
    outputs=(Variable("position", "1", None, 1.0, "horizontal position of the mass, in lengths", ("angle",)),),
    stop=10.0,
    step=0.05,
)

BOUNCING_BALL = Description(
    "bouncing_ball",
    "Ball that bounces on the floor and comes to rest: state events",
    states=(
        Variable("height", "m", 1.0, 1.0, "height over the floor", ("velocity",), reinit=True),
        Variable("velocity", "m/s", 0.0, 1.0, "upward velocity", ("g",), 10.0, reinit=True),
    ),
    inputs=(),
    parameters=(
        Variable("e", "1", 0.7, 1.0, "restitution: ratio of the speeds after and before an impact"),
        Variable("g", "m/s2", 9.81, 9.81, "gravity"),
    ),
    outputs=(Variable("y_height", "m", None, 1.0, "height over the floor", ("height",)),),
    stop=3.0,
    step=0.01,
    indicators=(Variable("floor", "m", None, 1.0, "positive until the ball meets the floor", ("height",)),),
    discretes=(
        Variable("bounces", "1", 0.0, 1.0, "number of impacts so far"),
        Variable("resting", "1", 0.0, 1.0, "1 once the ball has come to rest, else 0"),
    ),
)

SWITCHED_HEATER = Description(
    "switched_heater",
    "Heated body in a cold room whose heater toggles at each multiple of `period`: time events",
    states=(Variable("T", "K", 293.15, 300.0, "temperature", ("T", "T_room", "power", "R", "C"), 1e-2),),
    inputs=(Variable("T_room", "K", 293.15, 300.0, "temperature of the room"),),
    parameters=(
        Variable("power", "W", 500.0, 500.0, "heating power while the heater is on"),
        Variable("R", "K/W", 0.1, 0.1, "resistance from the body to the room"),
        Variable("C", "J/K", 1e4, 1e4, "capacity of the body"),
        Variable("period", "s", 300.0, 300.0, "time from one toggling to the next; it is on first"),
    ),
    outputs=(Variable("y_T", "K", None, 300.0, "temperature", ("T",)),),
    stop=3600.0,
    step=10.0,
    substep=1.0,
    discretes=(Variable("on", "1", 1.0, 1.0, "1 while the heater is on, else 0"),),
    time_events=True,
)

PLANTS = (BATCH_REACTOR, QUADROTOR, VAN_DER_POL, CHUA, BUILDING, PENDULUM, BOUNCING_BALL, SWITCHED_HEATER)
