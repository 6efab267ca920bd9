"""Thesis Table 4.4: suboptimal and fast MHE of the three species after i generalised Gauss-Newton iterations."""

from __future__ import annotations

from functools import partial
from typing import Any

from ctmhe.estimators.mhe import MHE
from ctmhe.studies.reproduce.printed_observers import SPECIES
from ctmhe.studies.reproduce.suboptimal_runs import (
    SPECIES_BOUNDS,
    SPECIES_RUN,
    averaged,
    each,
    fast_mhe,
    rows_of,
    species_mhe,
)

ESTIMATORS = ("s-MHE_1", "s-MHE_2", "f-MHE_1", "f-MHE_2")
LIMITS, N, T = (0, 1, 2, 3, 4), 3, 5
TABLE = (
    (0, 17.70, 0.07, 14.22, 0.08, 135.12, 0.05, 135.12, 0.01),
    (1, 3.02, 0.51, 2.98, 0.51, 2.23, 0.52, 1.63, 0.43),
    (2, 0.73, 0.87, 0.73, 0.87, 0.77, 0.92, 0.79, 0.80),
    (3, 0.67, 1.27, 0.68, 1.28, 0.41, 1.35, 0.54, 1.20),
    (4, 0.28, 1.62, 0.25, 1.63, 0.27, 1.72, 0.42, 1.56),
)


def estimator(name: str, limit: int) -> MHE:
    """Return a column's estimator, stopped after so many iterations."""
    if name.startswith("f"):
        return fast_mhe(SPECIES, name, N=N, i=limit, bounds=SPECIES_BOUNDS)
    candidate = "system" if name == "s-MHE_1" else "observer"
    return species_mhe(candidate, N=N, T=T, i=limit, solver="gauss-newton", filtering=True, start="last")


def reproduce(*, seeds: int = 50, workers: int = 1, progress: bool = False) -> dict[str, Any]:
    """Run the case; see `thesis_table_4_3`.

    Returns
    -------
    dict with `published`, `ours` (`table`), `settings`, `comment`
    """
    jobs = [
        partial(averaged, SPECIES_RUN, partial(estimator, name, limit), seeds, N)
        for limit in LIMITS
        for name in ESTIMATORS
    ]
    found = iter(each(jobs, workers=workers, progress=progress, name="Table 4.4"))
    kept = ("SSE", "tau_avg")
    table: list[dict[str, Any]] = []
    for limit in LIMITS:
        cells = {name: next(found) for name in ESTIMATORS}
        table.append({"i": limit} | {name: {key: cell[key] for key in kept} for name, cell in cells.items()})
    return {
        "case": "thesis-table-4.4",
        "published": {"table": rows_of(("i",), TABLE, dict.fromkeys(ESTIMATORS, ("SSE", "tau_avg")))},
        "ours": {"table": table},
        "settings": {
            "seeds": seeds,
            "steps": SPECIES_RUN.steps,
            "N": N,
            "T": T,
            "form": "filtering",
            "s-MHE": "(4.12)-(4.14) with eta_bar = eta_s, X imposed, warm start: the last solution",
            "f-MHE_1": "the same weights without discount, arrival cost updated by QR decompositions",
            "f-MHE_2": "P = 0, no disturbance: the outputs are fitted, over the initial state of the window",
            "tau_avg": "milliseconds, on this machine",
        },
        "comment": COMMENT,
    }


COMMENT = (
    "Only i = 0 is well defined, and comes out: the candidates, and open loop from the initial estimate. The others "
    "rest on an active-set method and a relaxation that are not published. Ours treats the bounds exactly in each "
    "iteration, so that one is close to the optimum already, and further ones change little. As published: one "
    "iteration takes away most of the error. Unlike there, f-MHE_2 is the least accurate: four outputs hardly "
    "determine three states."
)
