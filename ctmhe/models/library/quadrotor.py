"""The quadrotor with flexible rotor blades: twelve states, position and orientation measured."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library._parts import disturbances
from ctmhe.types import Bounds

MASS = 1.9  # kg
INERTIA = (5.9e-3, 5.9e-3, 10.7e-3)  # kg m2, about the body axes
GRAVITY = 9.8  # m/s2
ARM = 0.25  # m, from the centre to a rotor
THRUST = 1e-5  # N s2, thrust over squared rotor speed
TORQUE = 1e-6  # N m s2, drag torque over squared rotor speed
FLAPPING = 1.14  # N s, force over angular velocity by bending blades: B = FLAPPING e3^x
YAW_DAMPING = 0.0297  # N m s: D = YAW_DAMPING e3 e3'

POSITION, ANGLES = ("z1", "z2", "z3"), ("phi", "theta", "psi")
VELOCITY, RATES = ("s1", "s2", "s3"), ("O1", "O2", "O3")
STATES, OUTPUTS = (*POSITION, *ANGLES, *VELOCITY, *RATES), (*POSITION, *ANGLES)
ROTORS = ("omega1", "omega2", "omega3", "omega4")


def quadrotor(*, noise: bool = True) -> ContinuousModel:
    """Return a rigid body driven by four rotors, in an inertial frame whose third axis points down.

    With the rotation R from body to inertial frame (roll phi, pitch theta, yaw psi in zyx order), the matrix
    Gamma that turns body rates into angle rates, the thrust and the torques of the rotors::

        dz/dt       = s
        dxi/dt      = Gamma(xi) O                                         xi = (phi, theta, psi)
        m ds/dt     = m g e3 - thrust R e3 - R B O
        J dO/dt     = -O x (J O) + torque - D O
        thrust      = cT (omega1^2 + omega2^2 + omega3^2 + omega4^2)
        torque      = (l cT (omega4^2 - omega2^2), l cT (omega1^2 - omega3^2),
                       cQ (omega2^2 + omega4^2 - omega1^2 - omega3^2))

    plus one additive disturbance on each of the twelve derivatives. B couples body rates into the force
    (bending blades), D damps the yaw rate. m = 1.9 kg, J = diag(5.9, 5.9, 10.7) 1e-3 kg m2, g = 9.8 m/s2, l =
    0.25 m, cT = 1e-5, cQ = 1e-6, B = 1.14 e3^x, D = 0.0297 e3 e3'. The model is singular at a pitch of 90
    degrees.

    Parameters
    ----------
    noise : bool
        Whether six measurement noises follow the twelve process disturbances in w.

    Returns
    -------
    ContinuousModel
        x = (z1..z3 [m], phi, theta, psi [rad], s1..s3 [m/s], O1..O3 [rad/s]), u = (omega1..omega4) [rad/s],
        w = (w_<state> in the state's unit per second, v_<output> in the output's unit),
        y = (z1..z3 [m], phi, theta, psi [rad]), named as the states that they measure.
        Bounds: |phi|, |theta|, |psi| <= pi/6, |O| <= 1. Rotor speeds are at most 1500 rad/s.

    Source: thesis, Section 3.4.2, (3.45), and Section 6.4.2; after Kai et al. (2017).
    `hover_speed` gives the rotor speed that balances the weight.
    """
    names = disturbances(STATES, OUTPUTS, noise)

    def f(t, x, u, w, p):
        xi, s, rates = x[3:6], x[6:9], x[9:12]
        R, J, e3 = rotation(xi), ca.diag(ca.DM(INERTIA)), ca.DM([0.0, 0.0, 1.0])
        squares = u**2
        lift = THRUST * ca.sum1(squares)
        torque = ca.vertcat(
            ARM * THRUST * (squares[3] - squares[1]),
            ARM * THRUST * (squares[0] - squares[2]),
            TORQUE * (squares[1] + squares[3] - squares[0] - squares[2]),
        )
        force = MASS * GRAVITY * e3 - lift * R[:, 2] - FLAPPING * R @ ca.cross(e3, rates)
        moment = -ca.cross(rates, J @ rates) + torque - YAW_DAMPING * rates[2] * e3
        return ca.vertcat(s, angle_rates(xi) @ rates, force / MASS, moment / ca.DM(INERTIA)) + w[:12]

    def h(t, x, u, w, p):
        return x[:6] + w[12:18] if noise else x[:6]

    length = dict.fromkeys(POSITION, "m") | dict.fromkeys(ANGLES, "rad")
    rate = dict.fromkeys(VELOCITY, "m/s") | dict.fromkeys(RATES, "rad/s")
    second = {"m": "m/s", "rad": "rad/s", "m/s": "m/s2", "rad/s": "rad/s2"}
    units = length | rate
    return ContinuousModel(
        f,
        h,
        x=STATES,
        u=ROTORS,
        w=names,
        y=OUTPUTS,
        units=units
        | dict.fromkeys(ROTORS, "rad/s")
        | {f"w_{name}": second[unit] for name, unit in units.items()}
        | ({f"v_{name}": units[name] for name in OUTPUTS} if noise else {}),
        # the magnitudes that Section 3.4.2 takes for w
        nominal=dict.fromkeys(ANGLES, 0.5)
        | dict.fromkeys(ROTORS, hover_speed())
        | {name: 1e-3 if name.startswith("w_") else 0.1 for name in names},
        bounds=Bounds(
            x=dict.fromkeys(ANGLES, (-np.pi / 6, np.pi / 6)) | dict.fromkeys(RATES, (-1.0, 1.0)),
        ),
        name="quadrotor",
        source="thesis (3.45)",
    )


def quadrotor_discrete(*, step: float = 0.05) -> DiscreteModel:
    """Return one Euler step of `quadrotor`, with additive disturbances.

    Parameters
    ----------
    step : float
        Length of a step in seconds.

    Returns
    -------
    DiscreteModel
        x(k+1) = x + step f(x, u) + w with one w for each state, in the state's unit; y = (z1..z3, phi, theta, psi). The
        output residual is the noise. No bounds.

    Source: thesis, Section 6.4.2.
    """
    flow = quadrotor(noise=False)
    units = dict(zip(flow.x.names, flow.x.units, strict=True))
    sizes = (2e-2, 2e-5, 2e-3, 2e-6)  # of w, as the source draws it: positions, angles, velocities, rates

    return DiscreteModel(
        lambda t, x, u, w, p: x + step * flow.dynamics(t, x, u, 0, p) + w,
        lambda t, x, u, w, p: x[:6],
        step=step,
        x=STATES,
        u=ROTORS,
        w=flow.w.names,
        y=OUTPUTS,
        units=units | dict.fromkeys(ROTORS, "rad/s") | {f"w_{name}": unit for name, unit in units.items()},
        nominal=dict.fromkeys(ANGLES, 0.5)
        | dict.fromkeys(ROTORS, hover_speed())
        | {name: sizes[i // 3] for i, name in enumerate(flow.w.names)},
        name="quadrotor, Euler",
        source="thesis, Section 6.4.2",
    )


def hover_speed() -> float:
    """Return the speed [rad/s] at which four equal rotors carry the weight: sqrt(m g / (4 cT))."""
    return float(np.sqrt(MASS * GRAVITY / (4 * THRUST)))


def rotation(xi: ca.SX) -> ca.SX:
    """Return R (3, 3), body to inertial frame, for angles (phi, theta, psi) [rad] in zyx convention."""
    phi, theta, psi = xi[0], xi[1], xi[2]
    cf, sf, ct, st, cp, sp = ca.cos(phi), ca.sin(phi), ca.cos(theta), ca.sin(theta), ca.cos(psi), ca.sin(psi)
    return ca.vertcat(
        ca.horzcat(ct * cp, sf * st * cp - cf * sp, cf * st * cp + sf * sp),
        ca.horzcat(ct * sp, sf * st * sp + cf * cp, cf * st * sp - sf * cp),
        ca.horzcat(-st, sf * ct, cf * ct),
    )


def angle_rates(xi: ca.SX) -> ca.SX:
    """Return Gamma (3, 3), which maps body rates to the derivatives of (phi, theta, psi)."""
    cf, sf, ct, tt = ca.cos(xi[0]), ca.sin(xi[0]), ca.cos(xi[1]), ca.tan(xi[1])
    return ca.vertcat(
        ca.horzcat(1, sf * tt, cf * tt),
        ca.horzcat(0, cf, -sf),
        ca.horzcat(0, sf / ct, cf / ct),
    )
