"""What a certificate of detectability is, and what it guarantees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from ctmhe.certificates import horizon as horizons
from ctmhe.errors import InputError
from ctmhe.types import Array, Bounds, frozen


def largest_ratio(A: Array, B: Array) -> float:
    """Return lambda_max(A, B), the smallest number with A <= lambda B, for symmetric A and positive definite B."""
    if not len(A):
        return 0.0
    inverse = np.linalg.inv(np.linalg.cholesky(B))  # without SciPy, which would double the time of `import ctmhe`
    return float(np.linalg.eigvalsh(inverse @ A @ inverse.T)[-1])


@dataclass(frozen=True, eq=False)
class DetectabilityCertificate:
    """An i-iIOSS Lyapunov function U with quadratic bounds: exponential detectability, Assumption 3.1 of the thesis.

    For any two trajectories in the domain with the same known inputs, |dx|^2_P_lower <= U <= |dx|^2_P_upper (3.9a), and
    dU/dt <= ln(eta) U + |dw|^2_Q + |dy|^2_R (3.9b); in discrete time U+ <= eta U + |dw|^2_Q + |dy|^2_R. With the cost
    `DiscountedCost.from_certificate`, of weights 2 P_upper, 2 Q, R, the estimation error is bounded: Theorem 3.1.

    Parameters
    ----------
    P_lower, P_upper : array (nx, nx)
        Equal where U is a quadratic form.
    Q : array (nw, nw), R : array (ny, ny)
    eta : float in (0, 1)
        Per second, or per step.
    step : float, optional
        Seconds a step of a `DiscreteModel`; None in continuous time.
    method : str
        How the domain was covered: `constant`, `vertices`, `bernstein`, `interval`, `sum of squares`, `grid`; `given`
        for matrices of one's own.
    rigorous : bool
        Whether that is a proof (to rounding), or evidence.
    margin : float
        Smallest eigenvalue of the inequality at fresh points, in nominal units; see `certify_detectability`.
    domain : Bounds, optional
        Where it holds.
    worst : mapping name -> float, optional
        The fresh point with the smallest margin.
    notes : tuple of str

    Raises
    ------
    InputError
        For matrices that do not fit together, are not symmetric or not definite, and eta out of range.
    """

    P_lower: Array
    P_upper: Array
    Q: Array
    R: Array
    eta: float
    step: float | None = None
    method: str = "given"
    rigorous: bool = False
    margin: float = float("nan")
    domain: Bounds | None = None
    worst: Mapping[str, float] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("P_lower", "P_upper", "Q", "R"):
            object.__setattr__(self, name, frozen(definite(getattr(self, name), name, zero=name == "Q")))
        if self.P_lower.shape != self.P_upper.shape:
            raise InputError(f"P_lower is {self.P_lower.shape}, P_upper {self.P_upper.shape}; they bound one function")
        if largest_ratio(self.P_lower, self.P_upper) > 1 + 1e-9:
            raise InputError("P_lower must not exceed P_upper: they are bounds of one function (3.9a)")
        if not 0 < self.eta < 1:
            raise InputError(
                f"eta must lie in (0, 1), a factor per {'step' if self.step else 'second'}, got {self.eta}"
            )
        object.__setattr__(self, "worst", MappingProxyType(dict(self.worst or {})))

    @cached_property
    def ratio(self) -> float:
        """lambda_max(P_upper, P_lower): 1 where U is a quadratic form."""
        return max(largest_ratio(self.P_upper, self.P_lower), 1.0)

    def shortest_horizon(self, *, wait: float = 0.0) -> float:
        """Return the horizon that has to be exceeded (3.30), in seconds (steps in discrete time).

        Parameters
        ----------
        wait : float
            The longest wait for a sample in seconds; 0 where windows start at sampling instants (Remark 3.7).
        """
        return horizons.shortest_horizon(self.ratio, self.eta, wait=wait)

    def longest_wait(self, horizon: float) -> float:
        """Return what the wait for a sample must stay below with this horizon, in seconds (3.29)."""
        return horizons.longest_wait(self.ratio, self.eta, horizon=horizon)

    def contraction(self, horizon: float, *, wait: float = 0.0) -> float:
        """Return rho (3.31) per second (step) for a horizon and a longest wait; 1 and more guarantee nothing."""
        return horizons.contraction(self.ratio, self.eta, horizon=horizon, wait=wait)

    def for_weights(self, P: Any, Q: Any, R: Any, eta: float | None = None) -> DetectabilityCertificate:
        """Return the certificate that holds with weights of one's own: Remark 3.4 (3.14).

        They are P_upper, Q and R of the result, and U is scaled as far as they allow. The more they differ from the
        certificate's, the longer the horizon has to be.

        Parameters
        ----------
        P, Q, R : scalar, diagonal or matrix
            Positive definite. The cost then has 2 P, 2 Q and R.
        eta : float, optional
            Not below the certificate's, which it is when left out.
        """
        P, Q, R = (
            definite(as_matrix(given, len(own), name), name)
            for given, own, name in ((P, self.P_upper, "P"), (Q, self.Q, "Q"), (R, self.R, "R"))
        )
        eta = self.eta if eta is None else float(eta)
        if not self.eta <= eta < 1:
            raise InputError(
                f"for_weights: eta must lie in [{self.eta:g}, 1): only slower fading keeps (3.9b), got {eta}"
            )
        pairs = ((self.P_upper, P), (self.Q, Q), (self.R, R))
        K = 1 / max(largest_ratio(own, wanted) for own, wanted in pairs)
        note = f"scaled by {K:.4g} for weights of one's own (3.14)"
        return replace(self, P_lower=K * self.P_lower, P_upper=P, Q=Q, R=R, eta=eta, notes=(*self.notes, note))

    def size(self, error: Any) -> Array:
        """Return |e|_P_lower of errors (..., nx): the norm in which bounds are given."""
        error = np.asarray(error, dtype=float)
        return np.sqrt(np.einsum("...i,ij,...j->...", error, self.P_lower, error))


def as_matrix(value: Any, n: int, what: str) -> Array:
    """Return a scalar, a diagonal or a matrix as a matrix (n, n)."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected numbers, got {value!r}") from None
    if array.ndim == 0:
        return array * np.eye(n)
    if array.shape == (n,):
        return np.diag(array)
    if array.shape != (n, n):
        raise InputError(f"{what}: expected a scalar, a diagonal ({n},) or a matrix ({n}, {n}), got {array.shape}")
    return array


def definite(value: Any, what: str, *, zero: bool = False) -> Array:
    """Return a symmetric positive definite matrix; `zero`: or a semidefinite one."""
    array = np.asarray(value, dtype=float)
    if array.ndim != 2 or array.shape[0] != array.shape[1] or not np.isfinite(array).all():
        raise InputError(f"{what} must be a square matrix of finite numbers, got {value!r}")
    if not np.allclose(array, array.T, rtol=1e-8, atol=1e-12 * max(np.abs(array).max(initial=0.0), 1e-300)):
        raise InputError(f"{what} must be symmetric, got {array}")
    array = (array + array.T) / 2
    sizes = np.sqrt(np.maximum(np.abs(np.diagonal(array)), 1e-300))  # entries may have very different units
    least = np.linalg.eigvalsh(array / sizes[:, None] / sizes)[0] if len(array) else 1.0
    if least < -1e-9 if zero else least <= 0:
        kind = "semidefinite" if zero else "definite"
        raise InputError(f"{what} must be positive {kind}; its smallest eigenvalue, of unit diagonal, is {least:.3g}")
    return array
