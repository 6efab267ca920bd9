"""The non-isothermal stirred-tank reactor A -> B with a variable level."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library._parts import POSITIVE, Parameters, disturbances
from ctmhe.types import Array, Bounds, frozen

NOMINAL = {
    "F0": 0.1,  # feed flow, m3/min
    "T0": 350.0,  # feed temperature, K
    "c0": 1.0,  # feed concentration, kmol/m3
    "r": 0.219,  # radius of the tank, m
    "k0": 7.2e10,  # frequency factor, 1/min
    "E_R": 8750.0,  # activation energy over gas constant, K
    "U": 54.94,  # heat transfer coefficient, kJ/(min m2 K)
    "rho": 1000.0,  # density, kg/m3
    "Cp": 0.239,  # specific heat, kJ/(kg K)
    "DeltaH": -5e4,  # heat of reaction, kJ/kmol
}
UNITS = {
    "F0": "m3/min",
    "T0": "K",
    "c0": "kmol/m3",
    "r": "m",
    "k0": "1/min",
    "E_R": "K",
    "U": "kJ/(min m2 K)",
    "rho": "kg/m3",
    "Cp": "kJ/(kg K)",
    "DeltaH": "kJ/kmol",
}
STATES, OUTPUTS = ("c", "T", "h"), ("temperature",)
MINUTE = 60.0


def cstr(*, noise: bool = True, parameters: str | Sequence[str] = ()) -> ContinuousModel:
    """Return a cooled reactor in which A turns into B and heats the liquid; only the temperature is measured.

    With the area A = pi r^2 and the rate k(T) = k0 exp(-E_R / T), per minute::

        dc/dt = F0 (c0 - c) / (A h) - k(T) c
        dT/dt = F0 (T0 - T) / (A h) - DeltaH k(T) c / (rho Cp) + 2 U (T_c - T) / (r rho Cp)
        dh/dt = (F0 - F) / A
        temperature = T + v_temperature

    **Time.** The source counts minutes. Here, as everywhere in the library, t is in seconds and dynamics are
    per second: the right-hand sides above are divided by 60 before the additive w. The source's step of 0.25
    min is 15 s. Constants and the flows F0 and F keep their customary minutes.

    Parameters
    ----------
    noise : bool
        Whether the measurement noise `v_temperature` is the last entry of w.
    parameters : sequence of str
        Which constants are parameters p, with the nominal values as start: `F0` [m3/min], `T0` [K], `c0`
        [kmol/m3], `r` [m], `k0` [1/min], `E_R` [K], `U` [kJ/(min m2 K)], `rho` [kg/m3], `Cp` [kJ/(kg K)],
        `DeltaH` [kJ/kmol].

    Returns
    -------
    ContinuousModel
        x = (c [kmol/m3], T [K], h [m]), u = (T_c [K], F [m3/min]), w = (w_c [kmol/(m3 s)],
        w_T [K/s], w_h [m/s], v_temperature [K]), y = (temperature) [K].
        Bounds: 0.5 <= c <= 1.5, 200 <= T <= 400, 0.5 <= h <= 1.5; p positive except DeltaH.

    Source: thesis, Section 6.4.2; after Rawlings, Mayne and Diehl (2020), Example 1.11.
    `cstr_steady_states` gives the equilibria.
    """
    constants = Parameters("cstr", NOMINAL, parameters)
    names = disturbances(STATES, OUTPUTS, noise)

    def f(t, x, u, w, p):
        k = constants(p)
        c, T, h = x[0], x[1], x[2]
        area, capacity = np.pi * k["r"] ** 2, k["rho"] * k["Cp"]
        reaction = k["k0"] * ca.exp(-k["E_R"] / T) * c
        renewal = k["F0"] / (area * h)
        return (
            (renewal * (k["c0"] - c) - reaction) / MINUTE + w[0],
            (
                renewal * (k["T0"] - T)
                - k["DeltaH"] / capacity * reaction
                + 2 * k["U"] / (k["r"] * capacity) * (u[0] - T)
            )
            / MINUTE
            + w[1],
            (k["F0"] - u[1]) / area / MINUTE + w[2],
        )

    def output(t, x, u, w, p):
        return [x[1] + (w[3] if noise else 0.0)]

    return ContinuousModel(
        f,
        output,
        x=STATES,
        u=("T_c", "F"),
        w=names,
        p=constants.names,
        y=OUTPUTS,
        units={"c": "kmol/m3", "T": "K", "h": "m", "T_c": "K", "F": "m3/min", "temperature": "K"}
        | {"w_c": "kmol/(m3 s)", "w_T": "K/s", "w_h": "m/s"}
        | ({"v_temperature": "K"} if noise else {})
        | {name: UNITS[name] for name in constants.names},
        # w: the source's disturbance of one step of 15 s, spread over that step
        nominal={"c": 1.0, "T": 300.0, "h": 0.7, "T_c": 300.0, "F": 0.1, "temperature": 300.0}
        | {"w_c": 5e-3 / 15, "w_T": 1.0 / 15, "w_h": 5e-3 / 15}
        | ({"v_temperature": 3.0} if noise else {})
        | constants.nominal,
        p_start=constants.start,
        bounds=Bounds(
            x={"c": (0.5, 1.5), "T": (200.0, 400.0), "h": (0.5, 1.5)},
            p=constants.box({name: POSITIVE for name in NOMINAL if name != "DeltaH"}),
        ),
        name="cstr",
        source="thesis, Section 6.4.2",
    )


def cstr_discrete(*, step: float = 15.0) -> DiscreteModel:
    """Return one step of the classical Runge-Kutta rule on `cstr`, with additive disturbances.

    Parameters
    ----------
    step : float
        Length of a step in seconds; 15 s are the source's 0.25 min.

    Returns
    -------
    DiscreteModel
        x(k+1) = RK4(x, u) + (w_c [kmol/m3], w_T [K], w_h [m]), temperature = T; the output residual is the noise.
        Bounds: those of the states of `cstr`.

    Source: thesis, Section 6.4.2.
    """
    flow = cstr(noise=False)

    def rate(t, x, u, p):
        return flow.dynamics(t, x, u, 0, p)

    def f(t, x, u, w, p):
        k1 = rate(t, x, u, p)
        k2 = rate(t, x + step / 2 * k1, u, p)
        k3 = rate(t, x + step / 2 * k2, u, p)
        k4 = rate(t, x + step * k3, u, p)
        return x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4) + w

    names = flow.w.names
    return DiscreteModel(
        f,
        lambda t, x, u, w, p: x[1],
        step=step,
        x=STATES,
        u=flow.u.names,
        w=names,
        y=OUTPUTS,
        units={"c": "kmol/m3", "T": "K", "h": "m", "T_c": "K", "F": "m3/min", "temperature": "K"}
        | dict(zip(names, ("kmol/m3", "K", "m"), strict=True)),
        nominal=dict(
            zip((*STATES, *flow.u.names, *OUTPUTS), (*flow.x.nominal, *flow.u.nominal, *flow.y.nominal), strict=True)
        )
        | dict(zip(names, (5e-3, 1.0, 5e-3), strict=True)),
        bounds=Bounds(x=flow.bounds.x),
        name="cstr, RK4",
        source="thesis, Section 6.4.2",
    )


def cstr_steady_states(T_c: float = 300.0, *, h: float = 0.659) -> Array:
    """Return the equilibria of the nominal reactor at a coolant temperature and a level, coolest first.

    The level rests at any value when the outflow equals the feed (F = F0 = 0.1 m3/min), so it is given. The
    mass balance then fixes c for every T, and the equilibria are the zeros of the remaining heat balance: one
    or three.

    Parameters
    ----------
    T_c : float
        Coolant temperature [K].
    h : float
        Level [m].

    Returns
    -------
    array (n, 3)
        Rows (c [kmol/m3], T [K], h [m]). The coolest at T_c = 300 K is the source's operating point.

    Raises
    ------
    InputError
        If T_c or h is not positive and finite.
    """
    for name, value in (("T_c", T_c), ("h", h)):
        if not 0.0 < value < float("inf"):
            raise InputError(f"cstr_steady_states: {name} must be positive and finite, got {value}")
    k = NOMINAL
    renewal = k["F0"] / (np.pi * k["r"] ** 2 * h)
    capacity = k["rho"] * k["Cp"]
    cooling = 2 * k["U"] / (k["r"] * capacity)

    def concentration(T: float) -> float:
        return renewal * k["c0"] / (renewal + k["k0"] * np.exp(-k["E_R"] / T))

    def heat(T: float) -> float:
        reaction = renewal * (k["c0"] - concentration(T))
        return renewal * (k["T0"] - T) - k["DeltaH"] / capacity * reaction + cooling * (T_c - T)

    # reaction heat is at most that of the whole feed: all equilibria lie between these two temperatures
    coldest = (renewal * k["T0"] + cooling * T_c) / (renewal + cooling)
    hottest = coldest - k["DeltaH"] / capacity * renewal * k["c0"] / (renewal + cooling)
    grid = np.linspace(coldest - 1e-6, hottest + 1e-6, 2001)
    values = np.array([heat(T) for T in grid])
    crossings = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    from scipy.optimize import brentq

    roots = [float(np.asarray(brentq(heat, grid[i], grid[i + 1], xtol=1e-12))) for i in crossings]
    return frozen([[concentration(T), T, h] for T in roots])
