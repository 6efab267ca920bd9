"""The models once more, independent of the C sources, and where they are compared."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fmus.models import MODELS


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


def circuit(x, u, p):
    p, a1, a2, b1, b2 = p
    current = np.polynomial.Polynomial([0, a1, a2, p])(x[0])
    return np.array([[-0, b1, 0], [1, -1, 1], [0, -b2, 0]]) @ x - [b1 * current, 0, 0] + u


def building(x, u, p):
    r_zw, r_wo, r_zz, c_z, c_w, a1, a2 = p
    # nodes T1, T2, Tw1, Tw2, outdoors; one row an edge of the network
    edges = np.array([[1, -1, 0, 0, 0], [1, 0, -1, 0, 0], [0, 1, 0, -1, 0], [0, 0, 1, 0, -1], [0, 0, 0, 1, -1]])
    conductance = 1 / np.array([r_zz, r_zw, r_zw, r_wo, r_wo])
    flow = -edges.T @ (conductance * (edges @ [*x, u[0]]))
    gain = np.array([a1 * u[1] + u[2], a2 * u[1] + u[3], 0, 0])
    return (flow[:4] + gain) / [c_z, c_z, c_w, c_w]


def pendulum(x, u, p):
    return np.array([x[1], -p[0] * np.sin(x[0]) - p[1] * x[1] + u[0]])


def falling(x, u, p):
    return np.array([x[1], -p[1]])


def heated(x, u, p):
    power, resistance, capacity, _ = p
    return (power + (u - x) / resistance) / capacity


RHS = {
    "batch_reactor": reactor,
    "van_der_pol": oscillator,
    "quadrotor": quadrotor,
    "chua": circuit,
    "building": building,
    "pendulum": pendulum,
    "bouncing_ball": falling,  # in flight
    "switched_heater": heated,  # in its first period, when it is on
}

_OUTPUT = {
    "batch_reactor": lambda x, u, p: x[:2].sum(keepdims=True),
    "quadrotor": lambda x, u, p: x[:6],
    "building": lambda x, u, p: np.array([x[0], x[1], (x[2] + x[3] - 2 * u[0]) / p[1]]),
    "pendulum": lambda x, u, p: np.sin(x[:1]),
}


def output(name, x, u, p):
    """y, the first state unless said otherwise."""
    return _OUTPUT.get(name, lambda x, u, p: x[:1])(x, u, p)


def everything(name):
    """The function (x, u, p) -> (dx, y)."""
    return lambda x, u, p: np.concatenate([RHS[name](x, u, p), output(name, x, u, p)])


def point(name, seed=0):
    """A random point (x, u, p) near the start values, without their symmetry."""
    rng, model = np.random.default_rng(seed), MODELS[name]

    def near(variables, spread):
        return np.array([v.start + spread * rng.uniform(0.5, 1.0) * v.nominal for v in variables])

    return near(model.states, 0.3), near(model.inputs, 0.02), near(model.parameters, 0.2)


def differences(function, a):
    """Jacobian of function at a by central differences."""
    columns = [np.empty((len(function(a)), 0))]
    for j, value in enumerate(a):
        h = 1e-6 * max(abs(value), 1e-3)
        e = h * np.eye(len(a))[j]
        columns.append(((function(a + e) - function(a - e)) / (2 * h))[:, None])
    return np.hstack(columns)


def partial(function, base, group):
    """Jacobian of function(x, u, p) in one of x, u, p at the point `base`, by central differences."""
    named = dict(zip("xup", base, strict=True))
    return differences(lambda value: function(*(named | {group: value}).values()), named[group])


def scales(name, group):
    """What makes entries of d (dx, y) / d group comparable: nominal of the column over that of the row."""
    model = MODELS[name]
    columns = {"x": model.states, "u": model.inputs, "p": model.parameters}[group]
    rows = [v.nominal if v.rate is None else v.rate for v in model.states]
    rows += [v.nominal for v in model.outputs for _ in range(v.size)]
    return np.array([v.nominal for v in columns]) / np.array(rows)[:, None]
