"""The gas-phase batch reactor 2 A <-> B, with a pressure gauge only."""

from __future__ import annotations

from collections.abc import Sequence

from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.library._parts import POSITIVE, Parameters, disturbances
from ctmhe.types import Bounds

NOMINAL = {"k1": 0.16, "k2": 0.0064}
STATES, OUTPUTS = ("pA", "pB"), ("pressure",)


def batch_reactor(*, noise: bool = True, parameters: str | Sequence[str] = ()) -> ContinuousModel:
    """Return the reversible reaction 2 A <-> B in a closed vessel of constant volume and temperature.

    Two A make one B at the rate k1 pA^2 and B falls apart at the rate k2 pB, so that::

        dpA/dt = -2 (k1 pA^2 - k2 pB) + w_pA
        dpB/dt =     k1 pA^2 - k2 pB  + w_pB
        pressure = pA + pB + v_pressure

    Without disturbances pA + 2 pB is conserved. Estimators that do not know that pressures are positive can
    settle on a wrong, negative solution: the reason why this plant is a classic.

    Parameters
    ----------
    noise : bool
        Whether the measurement noise `v_pressure` is the last entry of w; without it the output residual is
        the noise.
    parameters : sequence of str
        Which of `k1` (0.16 per bar and second) and `k2` (0.0064 per second) are parameters p, with these
        start values.

    Returns
    -------
    ContinuousModel
        x = (pA, pB) [bar], no input, w = (w_pA, w_pB [bar/s], v_pressure [bar]), y = (pressure) [bar].
        Bounds: 0.1 <= x <= 5, |w| <= 0.1, p >= 0.

    Source: thesis, Section 3.4.1, (3.44); after Tenny and Rawlings (2002), Section 5.
    """
    constants = Parameters("batch_reactor", NOMINAL, parameters)

    def f(t, x, u, w, p):
        k = constants(p)
        rate = k["k1"] * x[0] ** 2 - k["k2"] * x[1]
        return -2 * rate + w[0], rate + w[1]

    def h(t, x, u, w, p):
        return [x[0] + x[1] + (w[2] if noise else 0.0)]

    return ContinuousModel(
        f,
        h,
        x=STATES,
        w=disturbances(STATES, OUTPUTS, noise),
        p=constants.names,
        y=OUTPUTS,
        units={"pA": "bar", "pB": "bar", "w_pA": "bar/s", "w_pB": "bar/s", "pressure": "bar"}
        | ({"v_pressure": "bar"} if noise else {})
        | {name: unit for name, unit in (("k1", "1/(bar s)"), ("k2", "1/s")) if name in constants.names},
        nominal=dict.fromkeys((*STATES, *OUTPUTS), 1.0)
        | dict.fromkeys(disturbances(STATES, OUTPUTS, noise), 0.1)
        | constants.nominal,
        p_start=constants.start,
        bounds=Bounds(x=(0.1, 5.0), w=(-0.1, 0.1), p=constants.box(dict.fromkeys(NOMINAL, POSITIVE))),
        name="batch_reactor",
        source="thesis (3.44)",
    )
