"""Thesis 4.3.3, Table 4.5: the horizons of MHE over observer trajectories for the discretised batch reactor."""

from __future__ import annotations

from typing import Any

from ctmhe.certificates.horizon import smallest_horizon
from ctmhe.certificates.suboptimal_horizons import trajectory_horizon
from ctmhe.studies.reproduce.printed_observers import REACTOR

SCALES = (1e2, 1.0, 1e-3, 1e-4)
PUBLISHED = [16, 45, 128, 155, 30]


def reproduce(**_: Any) -> dict[str, Any]:
    """Compute the horizons; nothing is random.

    Returns
    -------
    dict with `published`, `ours` (`horizons`), `settings`, `comment`
    """
    benchmark = smallest_horizon(REACTOR.system.ratio, REACTOR.eta_s)
    forms = {
        filtering: [trajectory_horizon(REACTOR.observer, a * REACTOR.P, filtering=filtering) for a in SCALES]
        for filtering in (True, False)
    }
    return {
        "case": "thesis-4.3.3-horizons",
        "published": {"a": SCALES, "horizons": PUBLISHED},
        "ours": {"horizons": [*forms[True], benchmark], "prediction_form": forms[False]},
        "settings": {"W": "a P", "eta_o": REACTOR.eta_o, "eta_s": REACTOR.eta_s, "form": "filtering, Remark 4.16"},
        "comment": COMMENT,
    }


COMMENT = (
    "The first four are N_min of (4.91) with gamma_1(N + 1, N, N), by the weight a P of the prior; the last is the "
    "benchmark, 4 eta_s^N < 1. They depend on a and the two rates only, not on the digits of P. The prediction form "
    "needs the same."
)
