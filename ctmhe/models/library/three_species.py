"""Three species in a gas-phase batch reactor, A <-> B + C and 2 B <-> C, of which only the total is measured."""

from __future__ import annotations

from collections.abc import Sequence

from ctmhe.models.continuous import ContinuousModel
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library._parts import POSITIVE, Parameters, disturbances
from ctmhe.types import Bounds

NOMINAL = {"p1": 0.2, "p2": 0.05, "p3": 0.2, "p4": 0.1}
UNITS = {"p1": "1/s", "p2": "l/(mol s)", "p3": "l/(mol s)", "p4": "1/s"}
STATES, OUTPUTS = ("cA", "cB", "cC"), ("total",)


def three_species(*, noise: bool = True, parameters: str | Sequence[str] = ()) -> ContinuousModel:
    """Return the reversible reactions A <-> B + C and 2 B <-> C in a well-stirred isothermal batch reactor.

    With the rates r1 = p1 cA - p2 cB cC and r2 = p3 cB^2 - p4 cC::

        dcA/dt = -r1            + w_cA
        dcB/dt =  r1 - 2 r2     + w_cB
        dcC/dt =  r1 +   r2     + w_cC
        total  = cA + cB + cC   + v_total

    Without disturbances 3 cA + cB + 2 cC is conserved. The source's concentrations and time have no unit; they are
    taken as mol/l and seconds. Its model is one Euler step of 0.25, with process disturbances of at most 1e-3 a step,
    which are 4e-3 per second here.

    Parameters
    ----------
    noise : bool
        Whether the measurement noise `v_total` is the last entry of w; without it the output residual is the noise.
    parameters : sequence of str
        Which of `p1` (0.2), `p2` (0.05), `p3` (0.2), `p4` (0.1) are parameters p, with these start values.

    Returns
    -------
    ContinuousModel
        x = (cA, cB, cC) [mol/l], no input, w = (w_cA, w_cB, w_cC [mol/(l s)], v_total [mol/l]), y = (total) [mol/l].
        Bounds: 0 <= x <= 3, |w_c| <= 4e-3, |v_total| <= 0.05, p >= 0.

    Source: thesis, Section 4.2.6, (4.70); after Rawlings, Mayne, Diehl (2020), Example 4.39, with other rates.
    """
    constants = Parameters("three_species", NOMINAL, parameters)
    names = disturbances(STATES, OUTPUTS, noise)
    sizes = {name: 0.05 if name == "v_total" else 4e-3 for name in names}

    def f(t, x, u, w, p):
        k = constants(p)
        r1, r2 = k["p1"] * x[0] - k["p2"] * x[1] * x[2], k["p3"] * x[1] ** 2 - k["p4"] * x[2]
        return -r1 + w[0], r1 - 2 * r2 + w[1], r1 + r2 + w[2]

    def h(t, x, u, w, p):
        return [x[0] + x[1] + x[2] + (w[3] if noise else 0.0)]

    return ContinuousModel(
        f,
        h,
        x=STATES,
        w=names,
        p=constants.names,
        y=OUTPUTS,
        units=dict.fromkeys((*STATES, *OUTPUTS), "mol/l")
        | {name: "mol/l" if name == "v_total" else "mol/(l s)" for name in names}
        | {name: UNITS[name] for name in constants.names},
        nominal=dict.fromkeys((*STATES, *OUTPUTS), 1.0) | sizes | constants.nominal,
        p_start=constants.start,
        bounds=Bounds(
            x=(0.0, 3.0),
            w={name: (-size, size) for name, size in sizes.items()},
            p=constants.box(dict.fromkeys(NOMINAL, POSITIVE)),
        ),
        name="three_species",
        source="thesis (4.70)",
    )


def three_species_discrete(*, step: float = 0.25, parameters: str | Sequence[str] = ()) -> DiscreteModel:
    """Return one Euler step of `three_species`, with disturbances a step: (4.70).

    Parameters
    ----------
    step : float
        Length of a step in seconds.
    parameters : sequence of str
        As for `three_species`.

    Returns
    -------
    DiscreteModel
        x(k+1) = x + step f(x, p) + (w_cA, w_cB, w_cC), total = cA + cB + cC + v_total.
        Bounds: those of `three_species`, |w_c| <= 1e-3.

    Source: thesis, Section 4.2.6, (4.70).
    """
    flow = three_species(parameters=parameters)
    sizes = dict.fromkeys(flow.w.names[:3], 1e-3) | {"v_total": 0.05}
    return DiscreteModel(
        lambda t, x, u, w, p: x + step * flow.dynamics(t, x, u, 0, p) + w[:3],
        lambda t, x, u, w, p: x[0] + x[1] + x[2] + w[3],
        step=step,
        x=STATES,
        w=flow.w.names,
        p=flow.p.names,
        y=OUTPUTS,
        units=dict.fromkeys((*STATES, *OUTPUTS, *flow.w.names), "mol/l") | {name: UNITS[name] for name in flow.p.names},
        nominal=dict.fromkeys((*STATES, *OUTPUTS), 1.0) | sizes | dict(zip(flow.p.names, flow.p.nominal, strict=True)),
        p_start=flow.p_start,
        bounds=Bounds(x=flow.bounds.x, w={name: (-size, size) for name, size in sizes.items()}, p=flow.bounds.p),
        name="three_species, Euler",
        source="thesis (4.70)",
    )
