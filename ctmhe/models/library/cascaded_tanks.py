"""Two tanks in cascade that can overflow: the plant of the public benchmark record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.library._parts import POSITIVE, Parameters, disturbances
from ctmhe.types import Bounds

# Least-squares output-error fit of this very model (initial levels free, k5 <= 1) to the estimation half of
# the benchmark record; root mean square error 0.45 V there and 0.52 V on the validation half.
NOMINAL = {"k1": 0.0497, "k2": 0.0485, "k3": 0.0474, "k4": 0.0410, "k5": 1.0, "rim": 10.0}
UNITS = {"k1": "V^0.5/s", "k2": "V^0.5/s", "k3": "V^0.5/s", "k4": "1/s", "k5": "1", "rim": "V"}
STATES, OUTPUTS = ("upper", "lower"), ("level",)
EMPTY = 0.01  # V: below it the outflow goes linearly to zero instead of as a square root
EDGE = 0.05  # V: width of the smooth onset of the overflow
SPILL = 1.0  # s: time constant with which water above the rim runs off


def cascaded_tanks(*, noise: bool = True, parameters: str | Sequence[str] = ()) -> ContinuousModel:
    """Return two tanks: a pump fills the upper, which drains into the lower, whose level is measured.

    Levels are in volts of the level sensor. Outflow follows Torricelli's law, and water above the rim runs
    off within about a second; of what the upper tank spills, the lower one catches the fraction k5::

        dupper/dt = -k1 root(upper) + k4 pump - spill(upper) + w_upper
        dlower/dt =  k2 root(upper) - k3 root(lower) + k5 (k2/k1) spill(upper) - spill(lower) + w_lower
        level = lower + v_level

    k2/k1 converts upper volts into lower volts of the same water. Both nonlinearities are smooth: `root(z)`
    is z / (z^2 + 0.01^2)^(1/4), the square root but for a linear, odd piece around the empty tank, so that a
    negative level is drawn back to zero; `spill(z)` is the softplus of z - rim with a width of 0.05 V,
    divided by 1 s. An explicit integrator therefore needs steps below about 2 s while a tank overflows. The
    record's sensor saturates at 10 V; the model's level exceeds that by at most a few tenths of a volt.

    The upper level is never measured: its scale is fixed by `rim` alone, and by nothing in a record without
    overflow. Do not estimate k1, k2, k4 and rim all at once.

    Parameters
    ----------
    noise : bool
        Whether the measurement noise `v_level` is the last entry of w.
    parameters : sequence of str
        Which of `k1`, `k2`, `k3` [V^0.5/s], `k4` [1/s], `k5` [1], `rim` [V] are parameters p. Start values:
        0.0497, 0.0485, 0.0474, 0.0410, 1 and 10, a fit to the benchmark's estimation record.

    Returns
    -------
    ContinuousModel
        x = (upper, lower) [V], u = (pump) [V], w = (w_upper, w_lower [V/s], v_level [V]), y = (level) [V].
        Bounds: 0 <= x <= 11, k1 to k4 and rim positive, 0 <= k5 <= 1.

    Source: Schoukens, Mattsson, Wigren and Noel (2016), cascaded tanks benchmark, for the plant and its
    equations without overflow; the overflow is our smooth, mass-conserving form.
    """
    constants = Parameters("cascaded_tanks", NOMINAL, parameters)
    names = disturbances(STATES, OUTPUTS, noise)

    def f(t, x, u, w, p):
        k = constants(p)
        through, over = smooth_root(x[0]), spill(x[0], k["rim"])
        return (
            -k["k1"] * through + k["k4"] * u[0] - over + w[0],
            k["k2"] * through
            - k["k3"] * smooth_root(x[1])
            + k["k5"] * k["k2"] / k["k1"] * over
            - spill(x[1], k["rim"])
            + w[1],
        )

    def h(t, x, u, w, p):
        return [x[1] + (w[2] if noise else 0.0)]

    return ContinuousModel(
        f,
        h,
        x=STATES,
        u=("pump",),
        w=names,
        p=constants.names,
        y=OUTPUTS,
        units={"upper": "V", "lower": "V", "pump": "V", "level": "V", "w_upper": "V/s", "w_lower": "V/s"}
        | ({"v_level": "V"} if noise else {})
        | {name: UNITS[name] for name in constants.names},
        nominal={"upper": 5.0, "lower": 5.0, "pump": 3.0, "level": 5.0, "w_upper": 0.01, "w_lower": 0.01}
        | ({"v_level": 0.1} if noise else {})
        | constants.nominal,
        p_start=constants.start,
        bounds=Bounds(x=(0.0, 11.0), p=constants.box(dict.fromkeys(NOMINAL, POSITIVE) | {"k5": (0.0, 1.0)})),
        name="cascaded_tanks",
        source="Schoukens et al. (2016)",
    )


def smooth_root(z: Any) -> Any:
    """Return an odd, smooth function that is sqrt(z) for z well above `EMPTY` and linear around zero."""
    return z / (z**2 + EMPTY**2) ** 0.25


def spill(z: Any, rim: Any) -> Any:
    """Return the overflow [V/s] of a level z [V]: the softplus of the height above the rim over `SPILL`."""
    return EDGE * ca.logsumexp(ca.vertcat(0.0, (z - rim) / EDGE)) / SPILL
