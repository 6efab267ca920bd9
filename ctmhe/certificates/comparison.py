"""Horizons that four results of the literature ask for, from one certificate: Table 3.1 of the thesis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.errors import InputError


@dataclass(frozen=True)
class HorizonRequirement:
    """C mu^N < 1, which one result asks of the horizon N in steps.

    Attributes
    ----------
    result : str
    C, mu : float
    horizon : int
        The smallest N.
    strict : bool
        Whether C and mu are limits that the result cannot reach, so that N has to be larger still.
    """

    result: str
    C: float
    mu: float
    horizon: int
    strict: bool = False


def compare_horizons(certificate: DetectabilityCertificate) -> tuple[HorizonRequirement, ...]:
    """Return what four results ask of the horizon: Table 3.1, in its order.

    [Sch+23, Thm. 1], which this package's estimator uses; [AR21, Thm. 4.2], in its ideal case; [KM23, Thm. 14] and
    [AR19b, Thm. 1], with the cost functions that need the shortest horizons. The first compares both bounds of U with
    each other; the rest take the ratio lambda_max(P_upper) / lambda_min(P_lower), which is never smaller and changes
    with the units of the states. (The thesis notes that the factor 8 of the last two could be 4.)

    Raises
    ------
    InputError
        For a certificate in continuous time: the other results do not exist there.
    """
    if certificate.step is None:
        raise InputError(
            "compare_horizons: the results that are compared are for discrete time and this certificate is for "
            "continuous time; certify the discretised model, or say step= where the matrices count steps"
        )
    eta = certificate.eta
    largest, least = np.linalg.eigvalsh(certificate.P_upper)[-1], np.linalg.eigvalsh(certificate.P_lower)[0]
    kappa = float(largest / least)
    slow = np.log1p(-(1 - eta) / (4 * kappa)) / 4  # of a mu so close to one that its logarithm needs care
    return (
        _requirement("[Sch+23, Thm. 1]", 4 * certificate.ratio, np.log(eta)),
        _requirement("[AR21, Thm. 4.2]", np.sqrt(4 * kappa), slow, strict=True),
        _requirement("[KM23, Thm. 14]", 8 * kappa, np.log(eta)),
        _requirement("[AR19b, Thm. 1]", 3 * np.sqrt(8 * kappa), np.log(eta) / 2),
    )


def _requirement(result: str, C: float, log_mu: float, *, strict: bool = False) -> HorizonRequirement:
    horizon = int(np.floor(np.log(C) / -log_mu * (1 + 1e-12))) + 1
    return HorizonRequirement(result, float(C), float(np.exp(log_mu)), horizon, strict)
