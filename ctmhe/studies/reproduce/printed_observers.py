"""Thesis 4.2.6 and 4.3.3: the printed observers and functions U, their margins, and what rounding does to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.suboptimal_horizons import ObserverFunction
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library import batch_reactor, three_species_discrete
from ctmhe.types import Array, Bounds


@dataclass(frozen=True, eq=False)
class Printed:
    """What a section prints: P of V_o and of U, the gain K, Q_o, R_o, eta_o, Q_s, R_s, G_s, eta_s, and the sets."""

    P: Array
    K: Array
    Q_o: float
    R_o: float
    eta_o: float
    Q_s: float
    R_s: float
    G_s: float
    eta_s: float
    rounding: float

    @property
    def observer(self) -> ObserverFunction:
        """V_o."""
        return ObserverFunction(self.P, self.P, self.Q_o * np.eye(len(self.P)), np.array([[self.R_o]]), self.eta_o)

    @property
    def system(self) -> DetectabilityCertificate:
        """U, with w = (d, v)."""
        Q = np.diag([self.Q_s] * len(self.P) + [self.R_s])
        return DetectabilityCertificate(self.P, self.P, Q, np.array([[self.G_s]]), self.eta_s, step=1.0)


SPECIES = Printed(
    P=np.array([[3.100, 2.170, 1.674], [2.170, 4.210, 2.154], [1.674, 2.154, 3.077]]),
    K=np.array([[-0.1], [-0.1], [-0.5]]),
    Q_o=1e3,
    R_o=1e3,
    eta_o=0.97,
    Q_s=1e2,
    R_s=1e2,
    G_s=50.0,
    eta_s=0.9383,
    rounding=0.0005,
)
REACTOR = Printed(
    P=np.array([[1.537, 1.380], [1.380, 1.254]]),
    K=np.array([[7.999], [-9.997]]),
    Q_o=1e3,
    R_o=1e2,
    eta_o=0.955,
    Q_s=2e3,
    R_s=2e3,
    G_s=200.0,
    eta_s=0.9545,
    rounding=0.0005,
)
SPECIES_DOMAIN = Bounds(x={"cB": (-0.04, 4.0), "cC": (-2.0, 4.0)})
REACTOR_DOMAIN = Bounds(x={"pA": (0.1, 6.0)})


def reactor_discrete(step: float = 0.1) -> DiscreteModel:
    """Return one Euler step of the batch reactor, disturbances a step: (4.96)."""
    flow = batch_reactor()
    return DiscreteModel(
        lambda t, x, u, w, p: x + step * flow.dynamics(t, x, u, 0, p) + w[:2],
        lambda t, x, u, w, p: x[0] + x[1] + w[2],
        step=step,
        x=flow.x.names,
        w=flow.w.names,
        y=flow.y.names,
        nominal=dict.fromkeys((*flow.x.names, *flow.y.names), 1.0) | {"w_pA": 2e-3, "w_pB": 2e-3, "v_pressure": 1e-2},
        bounds=Bounds(x=(0.1, 6.0), w={"w_pA": (-2e-3, 2e-3), "w_pB": (-2e-3, 2e-3), "v_pressure": (-1e-2, 1e-2)}),
        name="batch_reactor, Euler",
        source="thesis (4.96)",
    )


MODELS = {"thesis 4.2.6": three_species_discrete, "thesis 4.3.3": reactor_discrete}
