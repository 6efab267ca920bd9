"""The modified Chua circuit: a chaotic oscillator whose cubic coefficient is to be estimated."""

from __future__ import annotations

from collections.abc import Sequence

from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library._parts import Parameters, disturbances
from ctmhe.types import Bounds

NOMINAL = {"b1": 12.8, "b2": 19.1, "a1": 0.6, "a2": -1.1, "p": 0.45}
STATES, OUTPUTS = ("x1", "x2", "x3"), ("voltage",)


def chua(*, noise: bool = True, parameters: str | Sequence[str] = ("p",)) -> ContinuousModel:
    """Return the modified Chua circuit in continuous time.

    A capacitor behind a cubic resistor (x1), a second capacitor (x2) and an inductor (x3), all without
    dimension::

        dx1/dt = b1 (x2 - a1 x1 - a2 x1^2 - p x1^3) + w_x1
        dx2/dt = x1 - x2 + x3 + w_x2
        dx3/dt = -b2 x2 + w_x3
        voltage = x1 + v_voltage

    The parameter p enters through p x1^3 only: while x1 stays near zero the measurements say nothing about
    it. The source's time has no unit either; one unit is taken as one second. Its discrete-time model is one
    Euler step of 0.01 of this one, and its process disturbances of at most 1e-3 per step are 0.1 per second
    here.

    Parameters
    ----------
    noise : bool
        Whether the measurement noise `v_voltage` is the last entry of w; without it the output residual is
        the noise.
    parameters : sequence of str
        Which of `p` (0.45), `a1` (0.6), `a2` (-1.1), `b1` (12.8), `b2` (19.1) are parameters p, with these
        start values.

    Returns
    -------
    ContinuousModel
        x = (x1, x2, x3), no input, w = (w_x1, w_x2, w_x3 [1/s], v_voltage), y = (voltage).
        Bounds: -1 <= x1 <= 3, |x2| <= 1, |x3| <= 3, |w| <= 0.1, 0.2 <= p <= 0.8.

    Source: thesis, Section 5.2.4 (discrete-time form without number); after Yang and Zhao (2015).
    """
    constants = Parameters("chua", NOMINAL, parameters)
    names = disturbances(STATES, OUTPUTS, noise)

    def f(t, x, u, w, p):
        c = constants(p)
        return (
            c["b1"] * (x[1] - c["a1"] * x[0] - c["a2"] * x[0] ** 2 - c["p"] * x[0] ** 3) + w[0],
            x[0] - x[1] + x[2] + w[1],
            -c["b2"] * x[1] + w[2],
        )

    def h(t, x, u, w, p):
        return [x[0] + (w[3] if noise else 0.0)]

    return ContinuousModel(
        f,
        h,
        x=STATES,
        w=names,
        p=constants.names,
        y=OUTPUTS,
        units={"w_x1": "1/s", "w_x2": "1/s", "w_x3": "1/s"},
        nominal={"x1": 2.0, "x2": 0.3, "x3": 3.0, "voltage": 2.0} | dict.fromkeys(names, 0.1) | constants.nominal,
        p_start=constants.start,
        bounds=Bounds(
            x={"x1": (-1.0, 3.0), "x2": (-1.0, 1.0), "x3": (-3.0, 3.0)},
            w=(-0.1, 0.1),
            p=constants.box({"p": (0.2, 0.8)}),
        ),
        name="chua",
        source="thesis, Section 5.2.4",
    )


def chua_discrete(*, step: float = 0.01, parameters: str | Sequence[str] = ("p",)) -> DiscreteModel:
    """Return one Euler step of `chua`, with disturbances a step: the joint estimation example of the thesis.

    Parameters
    ----------
    step : float
        Length of a step in seconds.
    parameters : sequence of str
        As for `chua`.

    Returns
    -------
    DiscreteModel
        x(k+1) = x + step f(x, p) + (w_x1, w_x2, w_x3), voltage = x1 + v_voltage.
        Bounds: those of `chua`, |w_x| <= 1e-3, |v_voltage| <= 0.1.

    Source: thesis, Sections 5.2.4 and (with p+ = p + w_4) 5.3.3; paper 000, Section 5 (with |x1| <= 5).
    """
    flow = chua(parameters=parameters)

    def f(t, x, u, w, p):
        return x + step * flow.dynamics(t, x, u, 0, p) + w[:3]

    sizes = dict.fromkeys(flow.w.names[:3], 1e-3) | {"v_voltage": 0.1}
    return DiscreteModel(
        f,
        lambda t, x, u, w, p: x[0] + w[3],
        step=step,
        x=STATES,
        w=flow.w.names,
        p=flow.p.names,
        y=OUTPUTS,
        nominal=dict(
            zip((*STATES, *OUTPUTS, *flow.p.names), (*flow.x.nominal, *flow.y.nominal, *flow.p.nominal), strict=True)
        ),
        p_start=flow.p_start,
        bounds=Bounds(x=flow.bounds.x, w={name: (-size, size) for name, size in sizes.items()}, p=flow.bounds.p),
        name="chua, Euler",
        source="thesis, Section 5.2.4",
    )
