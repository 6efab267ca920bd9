"""The example models as data: every name, unit, start value and dependency that an FMU of them declares."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt


@dataclass(frozen=True)
class Variable:
    """One scalar variable of a model.

    Attributes
    ----------
    name, unit, description : str
    start : float or None
        Start value in `unit`; None for an output, which is calculated.
    nominal : float
        Typical magnitude in `unit`.
    depends : tuple of str
        Of a state: what its derivative depends on; of an output: what it depends on. Names of states,
        inputs and tunable parameters; exactly these entries of the Jacobian may differ from zero.
    """

    name: str
    unit: str
    start: float | None
    nominal: float
    description: str
    depends: tuple[str, ...] = ()


@dataclass(frozen=True)
class Description:
    """A model x' = f(x, u, p), y = h(x, u, p), written in C in `src/<name>.c`.

    `stiff` chooses the integrator of co-simulation: RK4 with a fixed step of at most 1 ms, or an L-stable
    Rosenbrock method with error control.
    """

    name: str
    description: str
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    stop: float
    step: float
    stiff: bool = False


# unit -> exponents of SI base units and factor
UNITS: dict[str, dict[str, float]] = {
    "1": {},
    "1/s": {"s": -1},
    "bar": {"kg": 1, "m": -1, "s": -2, "factor": 1e5},
    "bar/s": {"kg": 1, "m": -1, "s": -3, "factor": 1e5},
    "1/(bar.s)": {"kg": -1, "m": 1, "s": 1, "factor": 1e-5},
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "rad/s2": {"rad": 1, "s": -2},
    "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2},
    "kg.m/s": {"kg": 1, "m": 1, "s": -1},
    "N.s2": {"kg": 1, "m": 1},
    "N.m.s": {"kg": 1, "m": 2, "s": -1},
    "N.m.s2": {"kg": 1, "m": 2},
}

RATE = {"1": "1/s", "bar": "bar/s", "m": "m/s", "rad": "rad/s", "m/s": "m/s2", "rad/s": "rad/s2"}
"""The unit of the derivative of a state in a given unit."""


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

MODELS: dict[str, Description] = {m.name: m for m in (BATCH_REACTOR, QUADROTOR, VAN_DER_POL)}
