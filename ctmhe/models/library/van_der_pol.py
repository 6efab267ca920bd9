"""The van der Pol oscillator, measured through its position."""

from __future__ import annotations

from collections.abc import Sequence

from ctmhe.errors import InputError
from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.library._parts import POSITIVE, Parameters, disturbances
from ctmhe.types import Bounds

STATES, OUTPUTS = ("x1", "x2"), ("position",)


def van_der_pol(*, mu: float = 1.0, noise: bool = True, parameters: str | Sequence[str] = ()) -> ContinuousModel:
    """Return an oscillator whose damping feeds small swings and brakes large ones.

    Position and velocity obey::

        dx1/dt = x2 + w_x1
        dx2/dt = mu (1 - x1^2) x2 - x1 + w_x2
        position = x1 + v_position

    Every orbit but the origin ends on one limit cycle of amplitude close to 2, stiff for large mu.

    Parameters
    ----------
    mu : float >= 0
        Strength of the damping.
    noise : bool
        Whether the measurement noise `v_position` is the last entry of w.
    parameters : sequence of str
        `("mu",)` makes mu the parameter p, with start value `mu`.

    Returns
    -------
    ContinuousModel
        x = (x1, x2), no input, w = (w_x1, w_x2, v_position), y = (position), without dimension except time in
        seconds. Bounds: p >= 0; the states are free.

    Raises
    ------
    InputError
        For mu < 0, where the origin attracts and orbits outside the cycle run away.

    Source: van der Pol (1926), in the scaling where the undamped period is 2 pi.
    """
    if not 0.0 <= mu < float("inf"):
        raise InputError(f"van_der_pol: mu must be finite and not negative, got {mu}")
    constants = Parameters("van_der_pol", {"mu": float(mu)}, parameters)

    def f(t, x, u, w, p):
        damping = constants(p)["mu"] * (1 - x[0] ** 2)
        return x[1] + w[0], damping * x[1] - x[0] + w[1]

    def h(t, x, u, w, p):
        return [x[0] + (w[2] if noise else 0.0)]

    return ContinuousModel(
        f,
        h,
        x=STATES,
        w=disturbances(STATES, OUTPUTS, noise),
        p=constants.names,
        y=OUTPUTS,
        nominal={"x1": 2.0, "x2": 2.0, "position": 2.0}
        | dict.fromkeys(disturbances(STATES, OUTPUTS, noise), 0.1)
        | constants.nominal,
        p_start=constants.start,
        bounds=Bounds(p=constants.box({"mu": POSITIVE})),
        name="van_der_pol",
        source="van der Pol (1926)",
    )
