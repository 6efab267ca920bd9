"""Thesis 3.4.1, discrete time: the reactor by MHE with N = 30, and by Kalman filters that leave the physical domain."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.detectability import certify_detectability
from ctmhe.certificates.guarantee import Guarantee
from ctmhe.estimators import MHE, Estimator, Extended, Filter, Unscented
from ctmhe.simulation import Uniform, simulate
from ctmhe.studies.reproduce.parallel import over_seeds
from ctmhe.studies.reproduce.thesis_3_4_1_ct import GUESS, TRUTH
from ctmhe.studies.reproduce.thesis_printed_certificates import ETA, SIZES, STEP, P, reactor_discrete
from ctmhe.triggers import Periodic
from ctmhe.types import DiscountedCost

HORIZON, STEPS = 30, 120
Q, R = np.diag([1e3, 1e4, 1e3]), 1e3
COVARIANCES = {"P0": 36.0, "Q": 1e-6, "R": 1e-2}
"""Of the Kalman filters: those of the thesis are not printed."""
PUBLISHED = {"N": HORIZON, "N_min": 15, "MHE follows the states": True, "EKF leaves the physical domain": True}


@cache
def certificate() -> DetectabilityCertificate:
    """Return the certificate with the printed Q, R and eta: its P is the largest, the printed one is rounded."""
    return certify_detectability(reactor_discrete(), eta=ETA, objective="P", Q=Q, R=np.array([[R]]))


@cache
def estimators() -> dict[str, Estimator]:
    """Return MHE with the printed weights, and with a certificate of ours; and Kalman filters."""
    model = reactor_discrete()
    options: dict[str, Any] = {"horizon": HORIZON * STEP, "bounds": model.bounds}
    printed = MHE(model, cost=DiscountedCost(P=2 * P, Q=2 * Q, R=R, eta=ETA), **options)
    own = certificate()
    sizes = list(SIZES.values())
    certified = MHE(model, cost=DiscountedCost.from_certificate(own), guarantee=Guarantee(own, sizes), **options)
    cost = DiscountedCost(
        P=1 / COVARIANCES["P0"], Q=[1 / COVARIANCES["Q"]] * 2 + [1 / COVARIANCES["R"]], R=1e3 / COVARIANCES["R"]
    )  # the noise is part of w here: a residual beside it is next to nothing
    filters = {name: Filter(model, rule, cost=cost) for name, rule in (("EKF", Extended()), ("UKF", Unscented()))}
    return {"MHE": printed, "MHE, certified": certified, **filters}


def one_seed(seed: int, steps: int = STEPS) -> dict[str, dict[str, float]]:
    """Return the numbers of every estimator in one run."""
    found, names = {}, reactor_discrete().w.names
    noise = {label: Uniform(size, interval=STEP) for label, size in zip(names, SIZES.values(), strict=True)}
    for name, estimator in estimators().items():
        run = simulate(
            reactor_discrete(),
            estimator,
            trigger=Periodic(STEP),
            until=steps * STEP,
            guess=GUESS,
            truth=TRUTH,
            disturbance=noise,
            seed=seed,
        )
        error = run.dataset["x_hat"].values - run.dataset["x_true_solve"].values
        row = {
            "MSE": float(np.mean(error[1:] ** 2)),
            "MSE after N": float(np.mean(error[HORIZON:] ** 2)) if steps > HORIZON else float("nan"),
            "smallest x_hat": float(run.dataset["x_hat"].values[1:].min()),
        }
        if "window_level" in run.dataset:
            size = np.einsum("ki,ij,kj->k", error, certificate().P_lower, error)
            row["error over its bound"] = float(np.sqrt(np.max(size / run.dataset["window_level"].values)))
        found[name] = row
    return found


def reproduce(*, seeds: int = 20, workers: int = 1, progress: bool = False, steps: int = STEPS) -> dict[str, Any]:
    """Run the case.

    Parameters
    ----------
    seeds : int
        Seeded runs.
    workers : int
        Processes.
    progress : bool
        Show a progress bar.
    steps : int
        Steps of a run.

    Returns
    -------
    dict with `published`, `ours` (`table`: a row an estimator), `settings`, `comment`
    """
    runs = over_seeds(one_seed, seeds, workers, progress=progress, steps=steps)
    table = []
    for name in runs[0]:
        columns = {key: [run[name][key] for run in runs] for key in runs[0][name]}
        row = {key: {"mean": float(np.mean(column)), "std": float(np.std(column))} for key, column in columns.items()}
        table.append({"estimator": name, **row})
    by_name = {row["estimator"]: row for row in table}
    smallest = {name: min(run[name]["smallest x_hat"] for run in runs) for name in by_name}
    ours = {
        "N": HORIZON,
        "N_min": int(np.ceil(certificate().shortest_horizon())),
        "MHE follows the states": by_name["MHE"]["MSE after N"]["mean"] < by_name["EKF"]["MSE after N"]["mean"],
        "EKF leaves the physical domain": smallest["EKF"] < 0,
        "table": table,
    }
    return {
        "case": "thesis-3.4.1-dt",
        "published": PUBLISHED,
        "ours": ours,
        "settings": {
            "seeds": seeds,
            "steps": steps,
            "step_s": STEP,
            "P": P.tolist(),
            "Q": np.diag(Q).tolist(),
            "R": R,
            "eta": ETA,
            "weights_in_the_cost": "2P, 2Q, R, prediction form (3.6)",
            "x_bounds_bar": [0.1, 4.5],
            "w": "uniform, at most 1e-3, 1e-3, 0.1",
            "guess": list(GUESS),
            "truth": list(TRUTH),
            "kalman_covariances": COVARIANCES,
        },
        "comment": COMMENT,
    }


COMMENT = (
    "Fig. 3.1 shows one run and no numbers; the covariances of the EKF are not printed. With P0 = 36 I, Q = 1e-6 I and "
    "R = 1e-2 it leaves the physical domain, as in the figure. `MHE` has the printed weights; `MHE, certified` the "
    "largest P that meets the condition with the printed Q, R and eta, of which the printed one is a rounding, and so "
    "a bound (3.20): `error over its bound` is the largest ratio of a run, which must stay below one."
)
