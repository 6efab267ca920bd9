"""Thesis 3.4.1, continuous time: the reactor's certificate checked, found again, and what faster ones cost."""

from __future__ import annotations

from typing import Any

import numpy as np
from tqdm import tqdm

from ctmhe.certificates.detectability import certify_detectability
from ctmhe.certificates.increments import Increments
from ctmhe.certificates.inequality import GAIN, Form, Sizes
from ctmhe.certificates.injection import Units
from ctmhe.models.library import batch_reactor
from ctmhe.studies.reproduce.thesis_3_4_1_ct import ETA, HORIZON, P, Q, R
from ctmhe.types import Bounds

DELTA_BAR = 0.19
ETAS = (0.9, 0.7, 0.4, 0.2, 0.1, 0.01)
PUBLISHED = {"P": P.tolist(), "eta": ETA, "rho": 0.86, "t_min": 1.7, "delta_bar": DELTA_BAR, "horizon": HORIZON}
WEIGHTS: dict[str, Any] = {"Q": Q, "R": R}


def printed_margin() -> float:
    """Return the smallest eigenvalue of (7.33), sign changed, for the printed matrices, in their own units."""
    model = batch_reactor()
    plain = Units(np.eye(2), np.eye(3), np.eye(1), np.eye(0), discrete=False)
    form = Form(P, (Q,), np.array([[R]]))
    return float(Sizes(plain).margins(form, ETA, Increments(model).cover("ABCD").jacobians).min())


def reproduce(*, seeds: int = 1, workers: int = 1, progress: bool = False) -> dict[str, Any]:
    """Run the case.

    Parameters
    ----------
    seeds, workers : int
        Not used: nothing is random but the points at which results are verified again.
    progress : bool
        Show a progress bar.

    Returns
    -------
    dict with `published`, `ours` (`P`, `rho`, `t_min`, `best_eta`, `printed_margin`), `settings`, `comment`
    """
    model = batch_reactor()
    own = certify_detectability(model, eta=ETA, objective="P", **WEIGHTS)
    free = certify_detectability(model, Bounds(x={"pA": (0.1, 5.0)}), eta=ETA, objective="P", **WEIGHTS)
    best = certify_detectability(model, **WEIGHTS)
    faster = {}
    for eta in tqdm(ETAS, desc="rates", disable=None if progress else True):
        found = certify_detectability(model, eta=eta, objective="P", **WEIGHTS)
        faster[str(eta)] = {
            "smallest_eigenvalue_of_P": float(np.linalg.eigvalsh(found.P_lower)[0]),
            "t_min": found.shortest_horizon(wait=DELTA_BAR),
        }
    ours = {
        "P": own.P_lower.tolist(),
        "rho": own.contraction(HORIZON, wait=DELTA_BAR),
        "t_min": own.shortest_horizon(wait=DELTA_BAR),
        "longest_wait": own.longest_wait(HORIZON),
        "best_eta": best.eta,
        "best_eta_any_weights": certify_detectability(model).eta,
        "printed_margin": printed_margin(),
        "margin": own.margin,
        "method": own.method,
        "rigorous": own.rigorous,
        "pB_and_w_unbounded_change_P_by": float(np.abs(free.P_lower - own.P_lower).max()),
        "faster": faster,
        "notes": list(own.notes),
    }
    return {
        "case": "thesis-3.4.1-certificate",
        "published": PUBLISHED,
        "ours": ours,
        "settings": {
            "vertices_of_pA": [0.1, 5.0],
            "Q": np.diag(Q).tolist(),
            "R": R,
            "eta": ETA,
            "objective": "largest smallest eigenvalue of P",
            "largest_gain": GAIN,
        },
        "comment": COMMENT,
    }


COMMENT = (
    "The printed P is the optimum to its last digit, rounded: (7.33) then fails by 6e-5. The Jacobian depends on pA "
    "alone and is affine in it, so two vertices prove it for every pB and w. There is no best rate: on what the gauge "
    "does not show, v = (1, -1), (7.33) asks for -ln(eta) v'Pv <= 2 (2 k1 pA + k2) v'P (2, -1), which some P > 0 meets "
    "at any rate, and scaling it down admits the printed Q and R. P becomes singular on the way: `faster` has its "
    "smallest eigenvalue. `best_eta` is the rate at which noise of nominal size (1 bar, 0.1 for w) weighs "
    "`largest_gain` times as much as errors of that size, for the printed Q and R; `best_eta_any_weights` the same for "
    "free ones."
)
