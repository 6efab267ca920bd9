"""Horizon, rate and longest wait that a certificate guarantees: thesis (3.29)-(3.31), Remark 3.7, discrete time.

They need one number of U, `ratio` = lambda_max(P_upper, P_lower): by (3.20) a window multiplies the error, measured
by U, by at most 4 ratio eta^T. Times are in seconds and eta per second; in discrete time both count steps, and the wait
is zero where every step is solved for, since windows then start and end at an estimate (Remark 3.7).
"""

from __future__ import annotations

from typing import Any

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


def smallest_horizon(ratio: float, eta: float, *, wait: int = 0) -> int:
    """Return the smallest whole N with 4 ratio eta^(N - wait) < 1, in steps: [Sch+23], Theorem 1, where wait = 0.

    Parameters
    ----------
    ratio, eta : float
        As above, eta per step.
    wait : int >= 0
        The longest wait in steps where not every step is solved for: (3.29) with sums for integrals. Zero where windows
        start at estimates, whatever comes between (Remark 3.7).
    """
    limit = shortest_horizon(ratio, eta, wait=wait)
    return int(np.floor(limit * (1 + 1e-12))) + 1  # at the limit itself nothing contracts


def aligned(instants: Any, horizon: float, *, tolerance: float = 1e-9) -> bool:
    """Return whether every window between these sampling instants starts at one of them, or at 0: Remark 3.7.

    Then the wait in (3.29)-(3.31) is zero, and the factor 8 of (3.32) is 4. Equidistant instants are aligned if the
    horizon is a multiple of their distance.

    Parameters
    ----------
    instants : array-like (n,)
        Sampling instants t_i after 0, in seconds or steps.
    horizon : float
    tolerance : float
        How far the times may differ.
    """
    times = np.sort(np.append(np.asarray(instants, dtype=float), 0.0))
    starts = times - horizon
    starts = starts[starts > tolerance]
    after = np.minimum(np.searchsorted(times, starts), len(times) - 1)
    return bool((np.minimum(np.abs(times[after] - starts), np.abs(times[after - 1] - starts)) <= tolerance).all())


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
