"""The batch reactor in discrete time, emptied and refilled by known inputs."""

from __future__ import annotations

import numpy as np

from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library._parts import POSITIVE, disturbances
from ctmhe.models.library.batch_reactor import NOMINAL, OUTPUTS, STATES, batch_reactor
from ctmhe.types import Array, Bounds, frozen

FULL = (3.0, 0.0)  # bar, after refilling


def refilled_reactor(*, step: float = 0.1) -> DiscreteModel:
    """Return one Euler step of `batch_reactor` with additive inputs and disturbances.

    Per step::

        pA+ = pA + step (-2 k1 pA^2 + 2 k2 pB) + u_pA + w_pA
        pB+ = pB + step (   k1 pA^2 -   k2 pB) + u_pB + w_pB
        pressure = pA + pB

    with k1 = 0.16 per bar and second, k2 = 0.0064 per second.

    Parameters
    ----------
    step : float
        Length of a step in seconds.

    Returns
    -------
    DiscreteModel
        x = (pA, pB) [bar], u = (u_pA, u_pB) [bar], w = (w_pA, w_pB) [bar], y = (pressure) [bar]. The output residual is
        the measurement noise. Bounds: x >= 0.

    Source: thesis, Section 6.4.1, (6.80). `refill` gives the input that fills the reactor anew.
    """
    flow = batch_reactor(noise=False)

    def f(t, x, u, w, p):
        return x + step * flow.dynamics(t, x, 0, 0, p) + u + w

    names = disturbances(STATES, OUTPUTS, noise=False)
    inputs = tuple(f"u_{name}" for name in STATES)
    return DiscreteModel(
        f,
        lambda t, x, u, w, p: x[0] + x[1],
        step=step,
        x=STATES,
        u=inputs,
        w=names,
        y=OUTPUTS,
        units=dict.fromkeys((*STATES, *inputs, *names, *OUTPUTS), "bar"),
        nominal=dict.fromkeys(names, 0.05),
        bounds=Bounds(x=POSITIVE),
        name="refilled reactor",
        source="thesis (6.80)",
    )


def refill(x: Array, *, step: float = 0.1) -> Array:
    """Return the input u (2,) [bar] that takes the nominal reactor from `x` (2,) to pA = 3 bar, pB = 0 in one step."""
    rate = NOMINAL["k1"] * x[0] ** 2 - NOMINAL["k2"] * x[1]
    return frozen(np.array(FULL) - x - step * rate * np.array([-2.0, 1.0]))
