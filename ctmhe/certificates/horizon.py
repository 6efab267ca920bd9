"""Horizon, rate and longest wait that a certificate guarantees: thesis (3.29)-(3.31), Remark 3.7, discrete time.

They need one number of U, `ratio` = lambda_max(P_upper, P_lower): by (3.20) a window multiplies the error, measured
by U, by at most 4 ratio eta^T. Times are in seconds and eta per second; in discrete time both count steps, and with an
estimate at every step the wait is zero, since every window starts and ends at one (Remark 3.7).
"""

from __future__ import annotations

import numpy as np

from ctmhe.errors import InputError


def shortest_horizon(ratio: float, eta: float, *, wait: float = 0.0) -> float:
    """Return the limit T_min = -ln(4 ratio) / ln(eta) + wait that the horizon has to exceed (3.30).

    Parameters
    ----------
    ratio : float >= 1
        lambda_max(P_upper, P_lower).
    eta : float in (0, 1)
        Discount per second, or step.
    wait : float >= 0
        delta_bar (3.19), the longest wait for a sample, in the same unit; 0 where windows start at sampling instants
        (Remark 3.7) and in discrete time.
    """
    ratio, eta = _checked(ratio, eta)
    if not (np.isfinite(wait) and wait >= 0):
        raise InputError(f"wait: the longest wait must be finite and >= 0, got {wait!r}")
    return float(np.log(4 * ratio) / -np.log(eta)) + wait


def longest_wait(ratio: float, eta: float, *, horizon: float) -> float:
    """Return the limit that delta_bar has to stay below with this horizon (3.29); if negative, T is too short."""
    return float(horizon) - shortest_horizon(ratio, eta)


def contraction(ratio: float, eta: float, *, horizon: float, wait: float = 0.0) -> float:
    """Return rho = (4 ratio)^(1 / (T - wait)) eta of (3.31), per second or step; 1 and more guarantee nothing."""
    ratio, eta = _checked(ratio, eta)
    if not horizon > wait:
        raise InputError(f"horizon: it must exceed the longest wait of {wait:g} (3.19), got {horizon!r}")
    return float((4 * ratio) ** (1 / (horizon - wait)) * eta)


def _checked(ratio: float, eta: float) -> tuple[float, float]:
    if not (np.isfinite(ratio) and ratio >= 1 - 1e-9):
        raise InputError(f"ratio: lambda_max(P_upper, P_lower) must be finite and at least 1, got {ratio!r}")
    if not 0 < eta < 1:
        raise InputError(f"eta: a guarantee needs a discount in (0, 1), got {eta!r}")
    return max(float(ratio), 1.0), float(eta)
