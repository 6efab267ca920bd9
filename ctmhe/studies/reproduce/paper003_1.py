"""Paper 003, Section 4.1: an unknown linear system, estimated with the polytope it lies in and with a nominal model."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from ctmhe.estimators import MHE, AdaptiveArrival, Estimator, Filter, Kalman, RobustKalman, norm_bounded
from ctmhe.models import DiscreteModel
from ctmhe.models.library import unknown_linear, unknown_linear_matrices
from ctmhe.models.library.polytopes import MODEL, SYSTEM, UNKNOWN_A, UNKNOWN_C
from ctmhe.solvers.dual import DualIterations
from ctmhe.studies.reproduce.minmax import MinMaxEstimator
from ctmhe.studies.reproduce.parallel import over_seeds
from ctmhe.types import Array, Bounds, DiscountedCost, Measurement

SW, SV, HORIZON, ITERATIONS, STEPS = 0.1, 0.05, 8, 10, 40
Q_INVERSE, R_INVERSE, P_INVERSE, SIGMA, LARGEST = 0.1, 5.0, 0.1, 1e-4, 5.0
TRUTH, GUESS = np.array([0.5, 0.3]), np.zeros(2)
COLUMNS = ("KF_R", "KF", "FIE", "MHE_R", "MHE_A")
PUBLISHED_TABLE = [
    {"state": "x_0", "KF_R": 0.78467, "KF": 0.030851, "FIE": 0.0054, "MHE_R": 0.2662, "MHE_A": 0.0212},
    {"state": "x_1", "KF_R": 1.9946, "KF": 0.069122, "FIE": 0.0039, "MHE_R": 0.4675, "MHE_A": 0.0389},
]


def linear(A: Array, C: Array) -> DiscreteModel:
    """Return x+ = A x + w, y = C x in steps of 1 s."""
    return DiscreteModel(
        lambda t, x, u, w, p: ca.DM(A) @ x + w,
        lambda t, x, u, w, p: ca.DM(C) @ x,
        step=1.0,
        x=("x1", "x2"),
        w=("w_x1", "w_x2"),
        y="y1",
    )


@cache
def polytopic(iterations: int = ITERATIONS, horizon: int = HORIZON) -> MHE:
    """Return the adaptive polytopic estimator with the printed weights."""
    return MHE(
        unknown_linear(),
        horizon=float(horizon),
        cost=DiscountedCost(P=P_INVERSE * np.eye(5), Q=Q_INVERSE, R=R_INVERSE),
        bounds=Bounds(p=(0.0, 1.0)),
        solver=DualIterations(iterations),
        prior=AdaptiveArrival(SIGMA, LARGEST),
        filtering=True,
    )


def track(estimator: Estimator, y: Array, guess: Array) -> tuple[Array, Array]:
    """Return the estimates (n, nx) of states and (n, np) of parameters at the steps of outputs y (n, ny)."""
    state, found = estimator.init(x=guess), []
    for k, row in enumerate(y):
        state, estimate = estimator.estimate(estimator.observe(state, Measurement(float(k), row)), float(k))
        found.append((estimate.x, estimate.p))
    x, p = zip(*found, strict=True)
    return np.array(x), np.array(p)


def simulated(seed: int, steps: int, sw: float = SW, sv: float = SV) -> tuple[Array, Array]:
    """Return states (steps, 2) and outputs (steps, 1) of the system."""
    rng, (A, C) = np.random.default_rng(seed), unknown_linear_matrices(SYSTEM)
    x, y = np.empty((steps, 2)), np.empty((steps, 1))
    now = TRUTH
    for k in range(steps):
        x[k], y[k] = now, C @ now + sv * rng.normal(size=1)
        now = A @ now + sw * rng.normal(size=2)
    return x, y


@cache
def filters() -> dict[str, Filter]:
    """Return the Kalman filter of the system, and the robust one of the nominal model and the polytope."""
    cost, model = DiscountedCost(P=P_INVERSE, Q=1 / SW**2, R=1 / SV**2), unknown_linear_matrices(MODEL)
    uncertain = norm_bounded(list(zip(UNKNOWN_A, UNKNOWN_C, strict=True)), model)
    return {
        "KF_R": Filter(linear(*model), RobustKalman(*uncertain), cost=cost),
        "KF": Filter(linear(*unknown_linear_matrices(SYSTEM)), Kalman(), cost=cost),
    }


def one_trial(seed: int, steps: int = STEPS) -> dict[str, Array]:
    """Return the mean square error (2,) of every estimator in one run."""
    system, model = unknown_linear_matrices(SYSTEM), unknown_linear_matrices(MODEL)
    x, y = simulated(seed, steps)
    stage: dict[str, Any] = {"q": np.full(2, Q_INVERSE), "r": np.array([R_INVERSE]), "L": P_INVERSE}
    found = {
        **{name: track(one, y, GUESS)[0] for name, one in filters().items()},
        "FIE": MinMaxEstimator(lambda k, x: system, np.inf, **stage).track(y, GUESS),
        "MHE_R": MinMaxEstimator(lambda k, x: model, HORIZON, **stage).track(y, GUESS),
        "MHE_A": track(polytopic(), y, GUESS)[0],
    }
    return {name: np.mean((x_hat - x) ** 2, axis=0) for name, x_hat in found.items()}


def one_sweep(seed: int, steps: int, iterations: tuple[int, ...], horizons: tuple[int, ...]) -> dict[str, Any]:
    """Return Fig. 1: mean square errors by (l, N); and Fig. 2: the weights' last errors by S_w."""
    x, y = simulated(seed, steps)
    errors = {
        (count, N): float(np.mean((track(polytopic(count, N), y, GUESS)[0] - x) ** 2))
        for count in iterations
        for N in horizons
    }
    weights = {}
    for sw in (0.0, 0.1, 0.5, 1.0):
        p = track(polytopic(), simulated(seed, steps, sw)[1], GUESS)[1]
        weights[sw] = float(np.linalg.norm(p[-1] - SYSTEM))
    return {"errors": errors, "weights": weights}


def kalman_bound() -> Array:
    """Return the mean square errors (2,) that no estimator of the stationary system can beat: Riccati's."""
    A, C = unknown_linear_matrices(SYSTEM)
    S = solve_discrete_are(A.T, C.T, SW**2 * np.eye(2), SV**2 * np.eye(1))
    return np.diagonal(S - S @ C.T @ np.linalg.solve(C @ S @ C.T + SV**2, C @ S))


def averaged(values: Any) -> dict[str, float]:
    """Return mean and standard deviation over trials."""
    return {"mean": float(np.mean(values)), "std": float(np.std(values))}


def table_of(trials: list[Mapping[str, Array]]) -> list[dict[str, Any]]:
    """Return a row for each state with a column for each estimator."""
    return [
        {"state": f"x_{i}"} | {name: averaged([trial[name][i] for trial in trials]) for name in trials[0]}
        for i in range(2)
    ]


def reproduce(
    *,
    seeds: int = 100,
    workers: int = 1,
    progress: bool = False,
    steps: int = STEPS,
    sweep: int = 5,
    iterations: tuple[int, ...] = (1, 2, 5, 10, 20),
    horizons: tuple[int, ...] = (4, 8, 12),
) -> dict[str, Any]:
    """Run the case.

    Parameters
    ----------
    seeds : int
        Trials of Table 1.
    workers : int
        Processes.
    progress : bool
        Show a progress bar.
    steps : int
        Steps of a trial.
    sweep : int
        Trials of Figs. 1 and 2.
    iterations, horizons : tuple of int
        l and N of Fig. 1.

    Returns
    -------
    dict with `published`, `ours` (`Table 1`, `Fig. 1`, `Fig. 2`, `Kalman bound`), `settings`, `comment`
    """
    trials = over_seeds(one_trial, seeds, workers, progress=progress, steps=steps)
    sweeps = over_seeds(
        one_sweep, min(sweep, seeds), workers, progress=progress, steps=steps, iterations=iterations, horizons=horizons
    )
    figure = [
        {"l": count, "N": N, "MSE": averaged([found["errors"][count, N] for found in sweeps])}
        for count in iterations
        for N in horizons
    ]
    weights = [
        {"S_w": sw, "|alpha_hat - alpha|": averaged([found["weights"][sw] for found in sweeps])}
        for sw in sweeps[0]["weights"]
    ]
    return {
        "case": "paper003-1",
        "published": {"Table 1": PUBLISHED_TABLE},
        "ours": {
            "Table 1": table_of(trials),
            "Kalman bound": dict(zip(("x_0", "x_1"), map(float, kalman_bound()), strict=True)),
            "Fig. 1": figure,
            "Fig. 2": weights,
        },
        "settings": {
            "seeds": seeds,
            "seeds_of_figures": len(sweeps),
            "steps": steps,
            "S_w": SW,
            "S_v": SV,
            "N": HORIZON,
            "l": ITERATIONS,
            "Q_inverse": Q_INVERSE,
            "R_inverse": R_INVERSE,
            "P0_inverse": P_INVERSE,
            "sigma": SIGMA,
            "c": LARGEST,
            "not_printed": {
                "x_0": TRUTH.tolist(),
                "guess": GUESS.tolist(),
                "steps": steps,
                "weight of alpha": P_INVERSE,
                "guess of alpha": list(MODEL),
                "L": P_INVERSE,
                "covariances of KF and KF_R": "those of the noise, P0 = 10 I",
            },
        },
        "comment": COMMENT,
    }


COMMENT = (
    "Initial state, number of steps, L of Mueller's cost, prior weight and guess of alpha are not printed, so the "
    "table cannot come out. No estimator of the printed system has a smaller stationary error than `Kalman bound`; "
    "the published FIE lies below it in x_1, and the published KF, which knows the system, is several times above it. "
    "Ours is near it; our FIE shares the weight of the guess with MHE and so has less of a transient. KF_R and MHE_R "
    "have errors of the published order. The method is implemented as printed, and adapting beats KF_R, and MHE_R in "
    "x_0; in x_1 it does not: the weights of alpha are hardly identified from one output at S_w = 0.1, and do not "
    "come as near as Fig. 2 shows, whatever S_w. More iterations help for long windows and not for short ones (Fig. "
    "1, few seeds): the cost of a window falls with each, the error need not. KF_R's bound grows without end, as the "
    "polytope may be unstable."
)
