"""Runs of joint state and parameter estimators of Chua's circuit side by side: thesis 5.2.4, 5.3.3, paper 000."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ctmhe.errors import MissingExtra
from ctmhe.estimators.mhe import MHE
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Estimate, Measurement


def track(
    world: Model, schemes: Mapping[str, MHE], *, truth: Array, guess: Array, w: Array, p: Array
) -> tuple[Array, dict[str, dict[str, Any]]]:
    """Run estimators on the same data, one estimate a step, in the prediction form.

    Parameters
    ----------
    world : DiscreteModel
        With the parameters `p` (np,), if any, and the disturbances `w` (steps, nw).
    schemes : mapping name -> MHE
        Whose (x, p) are those of `guess` (nx + np,), in this order.
    truth : array (nx,)

    Returns
    -------
    states : array (steps + 1, nx)
    runs : mapping name -> dict with `estimates` (steps + 1, nx + np), `results` (list of Estimate), `seconds`
    """
    step, x, nothing = float(world.step or 1.0), np.asarray(truth, float), np.empty(0)
    states, found = [x], {}
    measured = []
    for row in w:
        measured.append(np.asarray(world.output(0.0, x, nothing, row, p)).ravel())
        x = np.asarray(world.dynamics(0.0, x, nothing, row, p)).ravel()
        states.append(x)
    for name, mhe in schemes.items():
        nx = len(mhe.model.x)
        state, estimates, results = mhe.init(x=guess[:nx], p=guess[nx:]), [np.asarray(guess, float)], []
        seconds = 0.0
        for k, y in enumerate(measured):
            state = mhe.observe(state, Measurement(k * step, y))
            began = time.perf_counter()
            state, estimate = mhe.estimate(state, (k + 1) * step)
            seconds += time.perf_counter() - began
            estimates.append(np.concatenate([estimate.x, estimate.p]))
            results.append(slim(estimate))
        found[name] = {"estimates": np.array(estimates), "results": results, "seconds": seconds / len(measured)}
    return np.array(states), found


def slim(estimate: Estimate) -> dict[str, Any]:
    """Return what is looked at later of an estimate, without its window."""
    bound = estimate.bound
    return {
        "success": estimate.status.success,
        "notes": estimate.status.notes,
        "bound": None if bound is None else (bound.level, bound.theorem, bound.cap, bound.P_lower),
    }


def rmse(errors: Array) -> float:
    """Return sqrt of sum |e(t)|^2 over t = 0...N, over N: as the thesis has it below Table 5.1."""
    return float(np.sqrt(np.sum(errors**2) / max(len(errors) - 1, 1)))


def summary(values: Any) -> dict[str, float]:
    """Return mean and standard deviation over seeds."""
    values = np.asarray(values, float)
    return {"mean": float(values.mean()), "std": float(values.std(ddof=1)) if len(values) > 1 else 0.0}


def over_seeds(run: Callable[[int], dict[str, Any]], seeds: int, *, workers: int, progress: bool) -> list[Any]:
    """Return what a run gives for each seed."""
    if workers == 1:
        from tqdm import tqdm

        return [run(seed) for seed in tqdm(range(seeds), disable=None if progress else True)]
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise MissingExtra("joblib", "study", "reproducing a case on several workers") from None
    return list(Parallel(workers)(delayed(run)(seed) for seed in range(seeds)))
