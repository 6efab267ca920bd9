"""Thesis 5.2.4: joint estimation of the Chua circuit's states and parameter, with and without excitation monitoring."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from ctmhe.certificates.excitation import ExcitationMonitor
from ctmhe.certificates.excitation_design import design_excitation
from ctmhe.certificates.joint_bounds import JointGuarantee
from ctmhe.certificates.joint_horizons import joint_horizon
from ctmhe.certificates.weights import detect_states, joint_weights
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.priors.joint import ExcitedPrior
from ctmhe.models.continuous import box_arrays
from ctmhe.models.library import chua_discrete
from ctmhe.studies.reproduce.joint_runs import over_seeds, rmse, summary, track

TRUTH, P_TRUE, GUESS = [1.0, 0.0, -1.0], [0.45], np.array([-1.0, 0.1, 2.0, 0.2])
ETA_X, MU, ETA_1, ETA_2, CAUTION = 0.91, 0.747, 0.934, 0.9997, 50.0
ALPHA = 1e-3
HORIZON, STEPS = 150, 5000
SIZES = np.array([1e-3, 1e-3, 1e-3, 0.1])
HEADS = ("RMSE(e_x)", "RMSE(e_p)", "tau_avg [ms]")
PUBLISHED = {
    "Scheme": ["MHE1", "MHE2"],
    "RMSE(e_x)": [0.1707, 0.1707],
    "RMSE(e_p)": [0.1379, 0.0209],
    "tau_avg [ms]": [50.01, 49.96],
}


@cache
def schemes() -> tuple[dict[str, MHE], int]:
    """Return the estimators, and N_min of their weights."""
    model = chua_discrete()
    alpha = (
        ALPHA * float(model.p.nominal[0]) ** 2
    )  # the level is that of p over its nominal 0.45, the thesis' that of p
    states, design = detect_states(model, eta=ETA_X), design_excitation(model, mu=MU)
    excited = design.excited_set(alpha)
    weights = joint_weights(states, excited, eta_1=ETA_1, eta_2=ETA_2, caution=CAUTION)
    guarantee = JointGuarantee(states, excited, weights, dict(zip(model.w.names, SIZES, strict=True)))
    priors = {"MHE1": "filtering", "MHE2": ExcitedPrior(ExcitationMonitor(design), alpha, guarantee=guarantee)}
    step = float(model.step or 1.0)
    made = {
        name: MHE(model, horizon=HORIZON * step, cost=weights.cost(model), bounds=model.bounds, prior=prior)
        for name, prior in priors.items()
    }
    return made, joint_horizon(weights, states.scaled(weights.scale), excited)


def one_seed(seed: int, *, steps: int = STEPS) -> dict[str, Any]:
    """Return the errors of both schemes in one run."""
    made, _ = schemes()
    model = made["MHE1"].model
    w = np.random.default_rng(seed).uniform(-1, 1, (steps, 4)) * SIZES
    truth, runs = track(model, made, truth=np.array(TRUTH), guess=GUESS, w=w, p=np.array(P_TRUE))
    aim = np.column_stack([truth, np.full(len(truth), P_TRUE[0])])
    rows = {}
    for name, run in runs.items():
        error = run["estimates"] - aim
        rows[name] = {
            "RMSE(e_x)": rmse(error[:, :3]),
            "RMSE(e_p)": rmse(error[:, 3:]),
            "tau_avg [ms]": 1e3 * run["seconds"],
            "failures": sum(not result["success"] for result in run["results"]),
        }
    error = (runs["MHE2"]["estimates"] - aim)[1:]
    bounds = [result["bound"] for result in runs["MHE2"]["results"]]
    ratios = [
        max(float(e @ M @ e) / value for value in (level, theorem) if value is not None)
        for e, (level, theorem, _, M) in zip(error, bounds, strict=True)
        if level is not None or theorem is not None
    ]
    kept = np.mean([bool(result["notes"]) for result in runs["MHE2"]["results"]])
    lower, upper = box_arrays(model.x, model.bounds.x, "X")
    return {
        "rows": rows,
        "kept": float(kept),
        "ratio": max(ratios, default=float("nan")),
        "as_wide_as_the_domain": float(np.mean([min(b[0], b[1] or b[0]) >= b[2] * (1 - 1e-9) for b in bounds])),
        "inside": bool(((truth >= lower) & (truth <= upper)).all()),
    }


def reproduce(
    *, seeds: int = 5, workers: int = 1, progress: bool = False, steps: int = STEPS, **_: Any
) -> dict[str, Any]:
    """Run both schemes.

    Parameters
    ----------
    seeds : int
        Of disturbances; both schemes see the same.
    workers : int
        Processes.
    progress : bool
        Show a progress bar.
    steps : int
        5000 in the thesis.

    Returns
    -------
    dict with `published`, `ours` (`table`, `N_min`, and more of ours), `settings`, `comment`
    """
    found = over_seeds(partial(one_seed, steps=steps), seeds, workers=workers, progress=progress)
    names = PUBLISHED["Scheme"]
    table = [
        {"Scheme": name, **{head: summary([run["rows"][name][head] for run in found]) for head in HEADS}}
        for name in names
    ]
    return {
        "case": "thesis-5.2.4",
        "published": {
            "table": [dict(zip(PUBLISHED, row, strict=True)) for row in zip(*PUBLISHED.values(), strict=True)],
            "N_min": 137,
            "RMSE(e_p) of MHE1 over MHE2": 0.1379 / 0.0209,
        },
        "ours": {
            "table": table,
            "N_min": schemes()[1],
            "RMSE(e_p) of MHE1 over MHE2": summary(
                [run["rows"]["MHE1"]["RMSE(e_p)"] / run["rows"]["MHE2"]["RMSE(e_p)"] for run in found]
            ),
            "share_of_steps_with_the_prior_kept": summary([run["kept"] for run in found]),
            "largest_error_over_bound": max(run["ratio"] for run in found),
            "share_of_bounds_as_wide_as_the_domain": float(np.mean([run["as_wide_as_the_domain"] for run in found])),
            "failed_solves": sum(run["rows"][name]["failures"] for run in found for name in names),
            "runs_that_stay_in_X": sum(run["inside"] for run in found),
        },
        "settings": {
            "seeds": seeds,
            "steps": steps,
            "N": HORIZON,
            "eta_x": ETA_X,
            "eta_p": MU,
            "eta_1": ETA_1,
            "eta_2": ETA_2,
            "alpha": ALPHA,
            "V": "100 S_p",
            "W": "2 P_x, rescaled",
            "P_x, P, L, Q, R": "our own designs at the printed rates",
            "disturbances": "bounded to their set",
            "guess": GUESS.tolist(),
        },
        "comment": COMMENT,
    }


COMMENT = (
    "One realisation is published; ours are means over seeds. The printed matrices do not meet their inequalities "
    "(thesis-printed-certificates), so P_x, P and L are designed anew at the printed rates eta_x and mu; alpha, eta_1, "
    "eta_2, V = 100 S_p and N are the printed ones, W = 2 P_x as N_min = 137 needs it. RMSE(e_x) is what the first "
    "steps make it: the initial error has norm 3.6. RMSE(e_p) of MHE1 depends on how long the circuit rests near "
    "x1 = 0, where its estimate is anywhere in [0.2, 0.8]. MHE1 has the filtering prior, which differs from (5.17) "
    "with all windows excited between N and 2 N only. The bound (5.42) holds, but says nothing at noise of 0.1: it is "
    "as wide as the domain. Solve times are those of this machine."
)
