"""Thesis Table 4.5: MHE over observer trajectories of the batch reactor, by the weight of its prior."""

from __future__ import annotations

from functools import partial
from typing import Any

from ctmhe.certificates.suboptimal_horizons import trajectory_horizon
from ctmhe.estimators.mhe import MHE
from ctmhe.studies.reproduce.printed_observers import REACTOR, reactor_discrete
from ctmhe.studies.reproduce.suboptimal_runs import (
    REACTOR_RUN,
    Experiment,
    averaged,
    each,
    rows_of,
    system_cost,
    trajectory_mhe,
)
from ctmhe.types import Bounds

SCALES = {"a = 1e2": 1e2, "a = 1": 1.0, "a = 1e-3": 1e-3, "a = 1e-4": 1e-4}
PRINTED_HORIZONS = (16, 45, 128, 155)
LIMITS, BENCHMARK, NOISE, DOUBLED = (0, 1, 2, 3, None), 30, 1e-3, 2.0
TABLE = (
    (0, 42.90, 2.30, 42.90, 2.50, 42.90, 2.86, 42.85, 2.97),
    (1, 42.83, 3.09, 42.47, 3.34, 3.49, 3.53, 1.11, 3.61),
    (2, 42.85, 3.14, 42.48, 3.41, 3.49, 4.13, 1.09, 3.45),
    (3, 42.93, 3.14, 42.52, 3.40, 3.46, 4.05, 1.12, 3.36),
    ("*", 42.98, 3.14, 42.53, 3.40, 3.50, 4.10, 1.12, 3.40),
)


def experiment(noise: float) -> Experiment:
    """Return the run with measurement noise up to `noise`."""
    run = REACTOR_RUN
    return Experiment(run.model, run.truth, run.guess, run.disturbance, noise, run.steps)


def benchmark() -> MHE:
    """Return standard MHE, optimised, with the filtering prior and the discounted cost; 0.1 <= pA <= 6."""
    cost, bounds = system_cost(REACTOR, discounted_prior=True), Bounds(x={"pA": (0.1, 6.0)})
    return MHE(reactor_discrete(), horizon=BENCHMARK * 0.1, cost=cost, bounds=bounds, filtering=True)


def reproduce(*, seeds: int = 20, workers: int = 1, progress: bool = False) -> dict[str, Any]:
    """Run the case; see `thesis_table_4_3`.

    Returns
    -------
    dict with `published`, `ours` (`N_min`, `table`, `benchmark`, `as_printed`), `settings`, `comment`
    """
    horizons = {
        name: trajectory_horizon(REACTOR.observer, scale * REACTOR.P, filtering=True) for name, scale in SCALES.items()
    }

    def build(name: str, limit: int | None, stage: float) -> Any:
        N = horizons[name]
        return partial(trajectory_mhe, SCALES[name], N=N, i=limit, horizon=N * 0.1, stage=stage)

    jobs = [
        partial(averaged, experiment(NOISE), build(name, limit, DOUBLED), seeds, horizons[name])
        for limit in LIMITS
        for name in SCALES
    ]
    printed = max(1, seeds // 10)
    jobs += [
        partial(averaged, experiment(REACTOR_RUN.noise), build(name, 1, 1.0), printed, horizons[name])
        for name in SCALES
    ]
    jobs.append(partial(averaged, experiment(NOISE), benchmark, seeds, BENCHMARK))
    cells = [
        {key: cell[key] for key in ("SSE", "tau_avg")}
        for cell in each(jobs, workers=workers, progress=progress, name="Table 4.5")
    ]
    found = iter(cells)
    table = [{"i": "*" if limit is None else limit} | {name: next(found) for name in SCALES} for limit in LIMITS]
    return {
        "case": "thesis-table-4.5",
        "published": {
            "N_min": dict(zip(SCALES, PRINTED_HORIZONS, strict=True)),
            "table": rows_of(("i",), TABLE, dict.fromkeys(SCALES, ("SSE", "tau_avg"))),
            "benchmark": {"SSE": 0.5, "tau_avg": 10.86},
        },
        "ours": {
            "N_min": horizons,
            "table": table,
            "benchmark": cells[-1],
            "as_printed": {name: next(found)["SSE"] for name in SCALES},
        },
        "settings": {
            "seeds": seeds,
            "seeds_as_printed": printed,
            "steps": REACTOR_RUN.steps,
            "noise": NOISE,
            "stage_cost": "2 times (4.73)",
            "form": "filtering, Remark 4.16",
            "solver": "gauss-newton",
            "prior_and_candidate": "(4.75), (4.76)",
            "tau_avg": "milliseconds, on this machine, i iterations of Gauss-Newton",
        },
        "comment": COMMENT,
    }


COMMENT = (
    "Measurement noise up to 1e-3 and twice the stage cost of (4.73) are what gives the published SSE, not the printed "
    "1e-2 and (4.73); `as_printed` has those, for i = 1. Iterations are Gauss-Newton's: IPOPT's 320,000 solves would "
    "take hours here. The orders are as published: only small a improve the observer (i = 0), the first iteration does "
    "it. The printed 42.90 of the observer is 44.4 here, with another realisation of the same noise. Times were taken "
    "while the machine did other things; the benchmark runs wholly in the compiled core, the others do not."
)
