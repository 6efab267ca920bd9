"""Thesis 6.4.2: the stirred-tank reactor online; three priors, delays, and the infinite-horizon estimator."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.estimators.mhe import MHE
from ctmhe.models.library import cstr_discrete
from ctmhe.studies.reproduce._offline import all_of
from ctmhe.studies.reproduce.turnpike_runs import Experiment, judged, summary
from ctmhe.types import DiscountedCost

STEPS, STEP, HORIZON, DELAYS = 200, 15.0, 10, (1, 5)
START, STEADY_INPUT, COOLER = (0.8, 295.0, 0.7), (300.0, 0.1), 25.0
EDGES = (60, 80, 120, 140)  # of the trapezoid of the coolant's temperature, steps
D, V = (5e-3, 1.0, 5e-3), 3.0
PUBLISHED = {"change_of_mean_SSE_percent": {"delay 1": -20.0}}


@cache
def estimator() -> MHE:
    """Return the estimator of (6.62): N = 10, Q, R = S and W(0) as printed, X imposed."""
    model = cstr_discrete(step=STEP)
    cost = DiscountedCost(P=1e-2, Q=np.array([1e3, 1.0, 1e5]), R=1.0, S=1.0)
    return MHE(model, horizon=HORIZON * STEP, cost=cost, bounds=model.bounds)


def experiment(seed: int, steps: int = STEPS) -> Experiment:
    """Return one record, and a guess that is off by up to 25 per cent in every state."""
    rng, model = np.random.default_rng(seed), cstr_discrete(step=STEP)
    d, v = rng.uniform(-1.0, 1.0, (steps, 3)) * D, rng.uniform(-V, V, steps + 1)
    guess = np.array(START) * rng.uniform(0.75, 1.25, 3)
    k = np.arange(steps + 1)
    cooled = np.interp(k, EDGES, (0.0, COOLER, COOLER, 0.0))
    u = np.column_stack([STEADY_INPUT[0] - cooled, np.full(steps + 1, STEADY_INPUT[1])])
    x = np.empty((steps + 1, 3))
    x[0] = START
    for i in range(steps):
        x[i + 1] = np.asarray(model.dynamics(0.0, x[i], u[i], d[i], [])).ravel()
    return Experiment(x, MeasurementLog(k * STEP, x[:, 1] + v, model.y.names, u, model.u.names), guess)


def one_run(seed: int, steps: int) -> dict[str, dict[str, float]]:
    """Return the numbers of all estimators on one record."""
    return judged(estimator(), experiment(seed, steps), DELAYS)


def reproduce(*, seeds: int = 100, steps: int = STEPS, workers: int = 1, progress: bool = False) -> dict[str, Any]:
    """Run the case.

    Parameters
    ----------
    seeds : int
        Simulations.
    steps : int
        T_s.
    workers : int
        Processes.
    progress : bool
        Of no effect.

    Returns
    -------
    dict with `published`, `ours` (`table`, `change_of_mean_SSE_percent`), `settings`, `comment`
    """
    runs = all_of([partial(one_run, seed, steps) for seed in range(seeds)], workers)
    return {
        "case": "thesis-6.4.2-cstr",
        "published": PUBLISHED,
        "ours": summary(runs),
        "settings": {
            "seeds": seeds,
            "T_s": steps,
            "step_s": STEP,
            "N": HORIZON,
            "Q": [1e3, 1.0, 1e5],
            "R": 1.0,
            "S": 1.0,
            "W0": 1e-2,
            "W": "inverse covariance of an extended Kalman filter along the estimates",
            "trapezoid_steps": list(EDGES),
            "x_bounds": [[0.5, 1.5], [200.0, 400.0], [0.5, 1.5]],
            "SSE": f"steps 0 to T_s - {max(DELAYS)}, of all estimators",
            "J": "without the first quarter of the steps",
            "IHE": "the full problem over the record, without prior",
        },
        "comment": COMMENT,
    }


COMMENT = (
    "The trapezoid of the coolant's temperature is not printed; ours goes down and up between steps 60 and 140. "
    "The published 20 per cent is read off a boxplot. The priors hardly differ; one step of delay takes most of "
    "what half a horizon takes, which is close to the infinite-horizon estimate, as published. The regret is "
    "large throughout: J weighs jumps of the level by 1e5, and pieces of different windows do not join smoothly."
)
