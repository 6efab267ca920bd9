"""Thesis 6.2.1: the integrator with constant disturbances; finite horizons against the turnpike, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.offline.benchmark import infinite_horizon
from ctmhe.estimators.offline.nonlinear import estimate_offline
from ctmhe.models.discrete import DiscreteModel
from ctmhe.types import Array, DiscountedCost

LAST, EXTENSION, HORIZONS = 30, 40, (5, 10, 15, 20, 25, 30)
ENDS = (0.618, 0.236, 0.090, 0.034)
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def estimator() -> MHE:
    """Return the problem with Q = R = S = 1 and no prior for x+ = x + d, y = x + v."""
    model = DiscreteModel(lambda t, x, u, w, p: x + w, lambda t, x, u, w, p: x, step=1.0, x="x", w="d", y="y",
                          name="integrator")  # fmt: skip
    return MHE(model, horizon=LAST, cost=DiscountedCost(P=0.0, Q=1.0, R=1.0, S=1.0))


def data(first: int, last: int) -> MeasurementLog:
    """Return what is measured: x(t) = t + 1, d = v = 1."""
    t = np.arange(first, last + 1.0)
    return MeasurementLog(t, t + 2.0, ("y",), np.empty((len(t), 0)))


def difference(horizon: int) -> Array:
    """Return x_inf(j) - x_hat(j), j = 0, ..., N, where P_N ends before the slope and where it begins, in powers.

    Both arcs decay with phi^2 a step, phi = (sqrt(5) - 1) / 2.
    """
    log = data(0, horizon)
    found = estimate_offline(estimator(), log, guess=[2.0], times=log.t)
    return log.t + 2.0 - found.x[:, 0]


def reproduce(*, horizons: Sequence[int] = HORIZONS, **_: Any) -> dict[str, Any]:
    """Run the case; nothing is random.

    Returns
    -------
    dict with `published`, `ours`, `settings`, `comment`
    """
    benchmark = infinite_horizon(estimator(), data(-EXTENSION, LAST + EXTENSION), margin=EXTENSION, guess=[2.0])
    arcs = {str(n): difference(n) for n in horizons}
    longest = arcs[str(max(horizons))]
    left, right = longest[:4], longest[::-1][:4]
    rate = float(np.exp(np.polyfit(np.arange(4), np.log(np.abs(right)), 1)[0]))
    return {
        "case": "thesis-6.2.1",
        "published": {"x_inf_minus_x": 1.0, "end_differences": list(ENDS)},
        "ours": {
            "x_inf_minus_x": float(np.mean(benchmark.x[:, 0] - (benchmark.t + 1.0))),
            "x_inf_minus_x_spread": float(np.ptp(benchmark.x[:, 0] - (benchmark.t + 1.0))),
            "change_with_half_the_margin": benchmark.change,
            "end_differences": np.abs(right).tolist(),
            "start_differences": np.abs(left).tolist(),
            "decay_per_step": rate,
            "decay_per_step_exact": float(GOLDEN**2),
            "differences": {n: values.tolist() for n, values in arcs.items()},
        },
        "settings": {"T": LAST, "T_e": EXTENSION, "Q": 1.0, "R": 1.0, "S": 1.0, "prior": "none"},
        "comment": (
            "The differences are read off Fig. 6.1; exactly they are odd powers of (sqrt(5) - 1) / 2, since both arcs "
            "belong to the eigenvalue (3 - sqrt(5)) / 2 of the Hamiltonian matrix (6.29)."
        ),
    }
