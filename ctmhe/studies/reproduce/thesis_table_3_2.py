"""Thesis Table 3.2: the horizons that four results ask of the discretised batch reactor, from the printed P."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.comparison import compare_horizons
from ctmhe.types import Array

P = np.array([[4.539, 4.171], [4.171, 3.834]])
Q, R, ETA, STEP, ROUNDING = np.diag([1e3, 1e4, 1e3]), np.array([[1e3]]), 0.91, 0.1, 0.0005
PUBLISHED = [15, 8e6, 119, 142]


def certificate(matrix: Array) -> DetectabilityCertificate:
    """Return the printed certificate with another P."""
    return DetectabilityCertificate(matrix, matrix, Q, R, ETA, step=STEP)


def well_conditioned(inside: float = 1.0) -> Array:
    """Return the best conditioned matrix that rounds to P; `inside` = -1: the worst, which is indefinite.

    The condition number of a matrix [[a, c], [c, d]] with c < a, d grows with |c| and falls with a and d here.
    """
    return P + inside * ROUNDING * np.array([[1, -1], [-1, 1]])


def explained() -> tuple[float, float]:
    """Return the ratios lambda_max / lambda_min for which the last two printed horizons come out, as an interval."""
    low, high = (ETA ** -(N - 1) / 8 for N in (PUBLISHED[2], PUBLISHED[2] + 1))
    low_, high_ = (ETA ** -(N - 1) / 72 for N in (PUBLISHED[3], PUBLISHED[3] + 1))
    return max(low, low_), min(high, high_)


def reproduce(**_: Any) -> dict[str, Any]:
    """Compute the table; nothing is random.

    Returns
    -------
    dict with `published`, `ours` (`horizons`), `settings`, `comment`
    """
    rows = compare_horizons(certificate(P))
    least = compare_horizons(certificate(well_conditioned()))
    low, high = explained()
    middle = np.sqrt(low * high)
    within = compare_horizons(certificate(np.diag([middle, 1.0])))
    return {
        "case": "thesis-table-3.2",
        "published": {"results": [row.result for row in rows], "horizons": PUBLISHED},
        "ours": {
            "horizons": [row.horizon for row in rows],
            "C": [row.C for row in rows],
            "mu": [row.mu for row in rows],
            "ratio": float(np.linalg.cond(P)),
            "smallest_within_rounding": [row.horizon for row in least],
            "smallest_ratio_within_rounding": float(np.linalg.cond(well_conditioned())),
            "smallest_eigenvalue_within_rounding": float(np.linalg.eigvalsh(well_conditioned(-1.0))[0]),
            "ratios_that_give_the_print": [low, high],
            "horizons_at_such_a_ratio": [row.horizon for row in within],
        },
        "settings": {"P": P.tolist(), "eta": ETA, "rounding": ROUNDING},
        "comment": COMMENT,
    }


COMMENT = (
    "The first horizon depends on eta alone, since U is a quadratic form. The others depend on lambda_max/lambda_min "
    "of P, which the printed digits leave open: rounding takes it from 5e3 to infinity (an indefinite matrix rounds to "
    "the print too). Ratios between 8512 and 9094 give all published numbers: those of the unrounded P. "
    "[AR21] is a strict lower limit under ideal assumptions."
)
