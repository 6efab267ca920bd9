"""Thesis 5.2.4: the horizon of joint estimation of states and parameter of the Chua circuit, (5.38)-(5.40)."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ctmhe.certificates.excited_set import ExcitedSet
from ctmhe.certificates.joint_horizons import joint_conditions, joint_horizon
from ctmhe.certificates.weights import JointWeights, StateDetectability, joint_weights
from ctmhe.studies.reproduce import printed_joint as printed
from ctmhe.types import Array, frozen

ALPHA, ETA_1, ETA_2, CAUTION = 1e-3, 0.934, 0.9997, 50.0
PUBLISHED = [137]


def parts(P_x: Array = printed.P_X, P: Array = printed.P) -> tuple[JointWeights, StateDetectability, ExcitedSet]:
    """Return weights, U rescaled for them, and E_N, of the printed matrices or others."""
    S_p = ALPHA * printed.GAMMA * np.eye(1)
    states = StateDetectability(P_x, P_x, printed.S_X, printed.Q_X, printed.R_X, printed.ETA_X)
    excited = ExcitedSet(S_p, P, printed.Q_P, printed.R_P * np.eye(1), printed.MU)
    weights = joint_weights(states, excited, eta_1=ETA_1, eta_2=ETA_2, caution=CAUTION)
    return weights, states.scaled(float(S_p[0, 0] / printed.S_X[0, 0])), excited


def unscaled() -> tuple[JointWeights, StateDetectability]:
    """Return weights for U as it is printed."""
    _, states, excited = parts()
    states = states.scaled(float(printed.S_X[0, 0] / excited.S[0, 0]))
    return joint_weights(states, excited, eta_1=ETA_1, eta_2=ETA_2, caution=CAUTION, scale=1.0), states


def within_rounding(count: int = 100) -> list[int]:
    """Return the smallest and largest horizon of random matrices that round to the printed ones."""
    rng, found = np.random.default_rng(0), []
    while len(found) < count:
        noise = rng.uniform(-printed.ROUNDING, printed.ROUNDING, (2, 3, 3))
        P_x, P = (M + (E + E.T) / 2 for M, E in zip((printed.P_X, printed.P), noise, strict=True))
        if min(np.linalg.eigvalsh(P_x)[0], np.linalg.eigvalsh(P)[0]) > 0:
            found.append(joint_horizon(*parts(P_x, P)))
    return [min(found), max(found)]


def reproduce(**_: Any) -> dict[str, Any]:
    """Compute the horizon; the effect of rounding from seeded random matrices.

    Returns
    -------
    dict with `published`, `ours` (`horizons`), `settings`, `comment`
    """
    weights, states, excited = parts()
    best = joint_horizon(weights, states, excited)
    return {
        "case": "thesis-5.2.4-horizon",
        "published": {"horizons": PUBLISHED},
        "ours": {
            "horizons": [best],
            "conditions": [asdict(joint_conditions(weights, states, excited, horizon=N)) for N in (best - 1, best)],
            "with_W_as_printed": joint_horizon(replace(weights, W=frozen(2 * excited.P)), states, excited),
            "within_rounding": within_rounding(),
            "without_rescaling": joint_horizon(*unscaled(), excited),
        },
        "settings": {
            "eta_x": states.eta,
            "eta_p": excited.eta,
            "eta_1": ETA_1,
            "eta_2": ETA_2,
            "S_p": float(excited.S[0, 0]),
            "V": "100 S_p",
            "W": "2 P_x, rescaled",
        },
        "comment": COMMENT,
    }


COMMENT = (
    "The published horizon needs W = 2 P_x, of the U rescaled by 1 / lambda_max(S_x, S_p), the least that (5.13) "
    "allows; the print says 2 P_p, which is allowed too but so large that N_min is seven times as long. (5.39), the "
    "parameters' prior, decides; the digits of the printed matrices do not matter."
)
