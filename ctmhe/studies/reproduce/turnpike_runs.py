"""What the two online examples of thesis 6.4.2 share: priors and delays on one record, against the full problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.offline.benchmark import performance
from ctmhe.estimators.offline.nonlinear import estimate_offline
from ctmhe.estimators.priors.kalman_weight import KalmanWeight
from ctmhe.studies.reproduce._offline import cell, squares, stepped
from ctmhe.types import Array, Estimate

PRIORS = ("filtering", "smoothing", "turnpike")


@dataclass(frozen=True, eq=False)
class Experiment:
    """One record with its truth: states (T + 1, nx), data, initial guess of the estimators."""

    truth: Array
    log: MeasurementLog
    guess: Array


def delayed(estimates: Sequence[Estimate], steps: int) -> Array:
    """Return the states (T + 1 - steps, nx) of (6.76): of every window the state of so many steps ago."""
    # the last node of a window is there twice: the newest measurement has a slot of its own
    return np.array([estimate.trajectory.x[:-1][-1 - steps] for estimate in estimates[steps:]])


def judged(mhe: MHE, experiment: Experiment, delays: Sequence[int]) -> dict[str, dict[str, float]]:
    """Return SSE over the steps that all estimators reach, and (without the first quarter) performance and distance.

    Performance is (6.53), distance that to the full solution.
    Estimators: standard MHE with each prior, MHE with the turnpike prior and each delay, and the full problem.
    """
    truth, log, guess = experiment.truth, experiment.log, experiment.guess
    runs = {prior: stepped(mhe.changed(prior=KalmanWeight(prior)), log, guess=guess) for prior in PRIORS}
    found = {prior: np.array([estimate.x for estimate in estimates]) for prior, estimates in runs.items()}
    for steps in delays:
        found[f"delay {steps}"] = delayed(runs["turnpike"], steps)
    smoothed = found[f"delay {max(delays)}"]

    def near(t: float) -> Array:  # where the full problem starts
        return smoothed[min(round((t - log.t[0]) / (log.t[1] - log.t[0])), len(smoothed) - 1)]

    nothing = replace(mhe.cost, P=np.zeros((len(guess), len(guess))), rate=None)
    found["IHE"] = estimate_offline(mhe.changed(cost=nothing, prior="filtering"), log, guess=near, times=log.t).x
    last = len(log) - max(delays)
    settled = slice(last // 4, last)
    best, t = found["IHE"][settled], log.t[settled]
    return {
        name: {
            "SSE": squares(x[:last], truth[:last]),
            "J": performance(mhe, log, t, x[settled]),
            "distance to IHE": float(np.sqrt(np.mean(np.sum((x[settled] - best) ** 2, axis=1)))),
            "largest error": float(np.max(np.abs(x[:last] - truth[:last]))),
        }
        for name, x in found.items()
    }


def summary(runs: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, Any]:
    """Return a table of means and spreads over runs, and the changes of SSE against standard MHE."""
    names, numbers = list(runs[0]), list(runs[0]["IHE"])
    table: list[dict[str, Any]] = []
    for name in names:
        row: dict[str, Any] = {"Estimator": name}
        row |= {number: cell([run[name][number] for run in runs]) for number in numbers}
        against = np.array([run[name]["SSE"] / run["turnpike"]["SSE"] for run in runs])
        row["SSE against turnpike prior, %"] = cell(100 * (against - 1))
        row["regret"] = cell([run[name]["J"] - run["IHE"]["J"] for run in runs])
        table.append(row)
    means = {name: float(np.mean([run[name]["SSE"] for run in runs])) for name in names}
    changes = {name: 100 * (means[name] / means["turnpike"] - 1) for name in names if name not in PRIORS}
    return {"table": table, "change_of_mean_SSE_percent": changes}
