"""Horizons of suboptimal MHE, which inherits its stability from an auxiliary observer: Theorems 4.1-4.5 of the thesis.

Discrete time. The observer brings V_o (Assumption 4.2), the system U (Assumption 4.3), both bounded by quadratic forms.
Then C(N) eta_o^T < 1 (4.44) is what the observer's horizon T has to meet, whatever the horizon N of the optimisation.
An estimator that optimises over trajectories of the observer itself needs gamma_1(N) < 1 (4.91).

Misprints: (4.31) needs L_f^(2s), as its proof and Table 4.1 have it. The 349 of Table 4.2 does not follow from (4.69),
which its proof confirms (274), but from (L_f + kappa L_h)^2 in the place of kappa^2 there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate, largest_ratio
from ctmhe.certificates.observer_function import ObserverFunction
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds


@dataclass(frozen=True)
class Lipschitz:
    """L_f and L_h of Assumptions 4.5 and 4.1: |df| <= L_f (|dx| + |dd|), |dh| <= L_h (|dx| + |dv|); L_f >= 1."""

    f: float
    h: float
    rigorous: bool = False

    @classmethod
    def of(cls, model: Model, domain: Bounds | None = None, *, u: Any = None) -> Lipschitz:
        """Return those of a model on a domain: the largest norms of the Jacobians that cover it."""
        from ctmhe.certificates.increments import Increments  # late: it needs much of SciPy

        cover = Increments(model, domain, u=u).cover("ABCD")
        A, B, _, C, D, _ = (np.linalg.norm(part, 2, axis=(1, 2)).max(initial=0.0) for part in cover.jacobians)
        return cls(float(max(A, B, 1.0)), float(max(C, D)), cover.rigorous)


def cost_factor(
    observer: ObserverFunction,
    system: DetectabilityCertificate,
    *,
    horizon: int,
    L_h: float,
    L_f: float | None = None,
    kappa: float | None = None,
    Q_s: Any = None,
    discount: float | None = None,
    projected: bool = False,
) -> float:
    """Return sigma_bar(N): by how much V_o bounds the cost of the candidate; see `growth` for the arguments.

    (4.31) for a trajectory of the system, also when projected (4.59); (4.50) and (4.69) for one of the observer.
    """
    N, eta = int(horizon), observer.eta
    fade = system.eta if discount is None else float(discount)
    if horizon != N or N < 0:
        raise InputError(f"horizon: N is a whole number of steps, 0 or more, got {horizon!r}")
    if (L_f is None) == (kappa is None):
        raise InputError(
            "the candidate is a trajectory of the system, for which L_f is needed, or of the observer, for which kappa "
            f"is; give one of both, got L_f={L_f!r}, kappa={kappa!r}"
        )
    if fade < system.eta:
        raise InputError(f"discount: the cost must not fade faster than U (eta_s = {system.eta:g}), got {fade!r}")
    if system.eta > observer.eta or largest_ratio(system.P_upper, observer.P_lower) > 1 + 1e-9:
        scale = 1 / largest_ratio(system.P_upper, observer.P_lower)
        raise InputError(
            f"Assumption 4.4: eta_s = {system.eta:g} must not exceed eta_o = {observer.eta:g}, nor P_s that of the "
            f"observer; U times {scale:.4g} (for_weights) meets the latter"
        )
    P_o, Q_o, R_o = (_inverse(part) for part in (observer.P_lower, observer.Q, observer.R))
    output = 2 * _largest(system.R) * L_h**2
    if L_f is not None:
        if L_f < 1:
            raise InputError(f"L_f: Assumption 4.5 has it at least 1, got {L_f!r}; take 1")
        return N * output * max(1.0, P_o, Q_o, R_o) * eta**-N * _geometric(fade, L_f**2, N)
    c_2 = output * max(1.0, P_o, R_o)
    Q_s = system.Q if Q_s is None else np.atleast_2d(np.asarray(Q_s, dtype=float))
    gain = _largest(Q_s) * float(kappa or 0.0) ** 2 / float(np.linalg.eigvalsh(system.R)[0])
    front = 3 / 4 * (1 + 4 * gain) if projected else 1 + 2 * gain
    return front * c_2 * _geometric(fade / eta, 1.0, N)


def growth(
    observer: ObserverFunction, system: DetectabilityCertificate, *, projected: bool = False, **candidate: Any
) -> float:
    """Return C(N) of (4.35): U(t) <= C(N) eta_o^T U(t - T) + what disturbances add: (4.36) or, projected, (4.63).

    Parameters
    ----------
    observer : ObserverFunction
    system : DetectabilityCertificate
        U; its R is G_s, its Q holds Q_s and R_s.
    projected : bool
        Whether the observer may leave X and is projected onto it (Theorems 4.3, 4.4), or not (4.1, 4.2).
    horizon : int
        N, of the optimisation.
    L_h : float
        See `Lipschitz`.
    L_f : float
        For the candidate (4.19) or (4.56), a trajectory of the system.
    kappa : float
        For the candidate (4.46) or (4.64), a trajectory of the observer, which corrects by at most kappa |dy|
        (Assumption 4.7) and whose disturbances are additive.
    Q_s : array, optional
        The part of `system.Q` for the disturbances of the dynamics; without it all of it counts. With kappa only.
    discount : float, optional
        eta_bar of the cost (4.12), not below eta_s, which it is when left out; 1 is allowed.
    """
    sigma = cost_factor(observer, system, projected=projected, **candidate)
    both = (2 + sigma) * max(largest_ratio(observer.P_upper, system.P_lower), 1.0)
    return 2 * both if projected else both


def observer_horizon(
    observer: ObserverFunction, system: DetectabilityCertificate, *, horizon: int, **candidate: Any
) -> int:
    """Return T_min, the smallest T >= N with C(N) eta_o^T < 1 (4.44): Theorems 4.1-4.4; arguments as for `growth`."""
    C = growth(observer, system, horizon=horizon, **candidate)
    return max(int(horizon), int(np.floor(np.log(C) / -np.log(observer.eta) * (1 + 1e-12))) + 1)


def gamma_1(observer: ObserverFunction, W: Any, k: Any, r: Any, s: Any) -> Any:
    """Return 2 lambda_max(P_o, P_o) eta^s + lambda_max(P_o, W) k eta^(r + s): (4.84a)."""
    k, r, s = (np.asarray(value, dtype=float) for value in (k, r, s))
    weight = largest_ratio(observer.P_upper, np.atleast_2d(np.asarray(W, dtype=float)))
    return 2 * observer.ratio * observer.eta**s + weight * k * observer.eta ** (r + s)


def trajectory_horizon(observer: ObserverFunction, W: Any, *, filtering: bool = False) -> int:
    """Return N_min, from which on gamma_1(N) < 1 (4.91): Corollary 4.2.

    Parameters
    ----------
    observer : ObserverFunction
    W : array (nx, nx)
        The prior's weight in (4.73).
    filtering : bool
        Whether the output at t itself is in the cost (Remark 4.16).
    """
    at = lambda N: gamma_1(observer, W, N + filtering, N, N)  # noqa: E731
    high = 1
    while at(high) >= 1:  # gamma_1 begins at 2 or more and has one maximum (Remark 4.12): it falls below 1 once
        high *= 2
    return int(np.flatnonzero(at(np.arange(high + 1)) >= 1)[-1]) + 1


def _largest(matrix: Array) -> float:
    return float(np.linalg.eigvalsh(matrix)[-1]) if len(matrix) else 0.0


def _inverse(matrix: Array) -> float:
    """Return 1 / lambda_min."""
    return 1 / float(np.linalg.eigvalsh(matrix)[0]) if len(matrix) else 0.0


def _geometric(a: float, b: float, n: int) -> float:
    """Return the sum of a^(n-1-j) b^j over j < n, (a^n - b^n) / (a - b) for a != b."""
    powers = np.arange(n)
    return float(np.sum(a ** (n - 1 - powers) * b**powers)) if n else 0.0
