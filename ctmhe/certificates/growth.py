"""How fast two trajectories of a model can part, whatever outputs say: what a prediction is worth."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.linalg import eigh

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.guarantee import Guarantee
from ctmhe.certificates.increments import Increments
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array


@dataclass(frozen=True)
class Growth:
    """A bound of the distance r = |x_1 - x_2|_P of two trajectories with equal inputs, one of them undisturbed.

    dr/dt <= rate r + push; in discrete time r+ <= (1 + rate) r + push.

    Attributes
    ----------
    rate : float
        Per second, or per step; negative where the model contracts in this norm.
    push : float
        Of the disturbances, in the norm's unit per second, or step.
    ratio : float
        lambda_max(P_upper, P_lower) of the certificate, whose P_upper is P.
    step : float or None
        Seconds of a step.
    method : str
        How the domain was covered.
    rigorous : bool
        Whether that is a proof.
    """

    rate: float
    push: float
    ratio: float
    step: float | None
    method: str
    rigorous: bool

    def ahead(self, size: float, seconds: float) -> float:
        """Return the bound of r so many seconds after it was at most `size`; in between for steps not begun."""
        if self.step is None:
            growth, span = np.exp(self.rate * seconds), seconds
        else:
            span = np.ceil(seconds / self.step * (1 - 1e-9))
            growth = (1 + self.rate) ** span
        reach = span if abs(self.rate) * span < 1e-9 else (growth - 1) / self.rate
        return float(growth * size + self.push * reach)

    def time_to(self, target: float, size: float) -> float:
        """Return the seconds until the bound reaches `target`, from `size`; inf if it never does, 0 if it has."""
        if size >= target:
            return 0.0
        if self.step is not None:
            count, bound = 0, size
            while bound < target and count < 100_000:
                bound, before = (1 + self.rate) * bound + self.push, bound
                if bound <= before:
                    return float("inf")
                count += 1
            return max(count - 1, 0) * self.step if bound >= target else float("inf")
        slopes = self.rate * size + self.push, self.rate * target + self.push
        if min(slopes) <= 0:
            return float("inf")
        change = self.rate * (target - size) / slopes[0]
        return float((target - size) / slopes[0] if abs(change) < 1e-9 else np.log1p(change) / self.rate)


def predict_growth(model: Model, guarantee: Guarantee, *, u: Any = None) -> Growth:
    """Bound how far a prediction without disturbance can move away from the truth, while both stay inside the domain.

    The difference e of both obeys de/dt = A e - B w, with A and B mean values of the Jacobians between them. So the
    norm |e|_P grows at most by half the largest eigenvalue of P A + A'P relative to P, and by |B w|_P. Both are convex
    in A, B and w: their largest values on a hull of the Jacobians and on the box of disturbances are at its corners.

    Parameters
    ----------
    model : Model
    guarantee : Guarantee
        Whose certificate has the norm, P_upper, and the domain.
    u : box, optional
        Range of the inputs.

    Raises
    ------
    InputError
        If a Jacobian depends on a signal without finite bounds; see `Increments`.
    """
    certificate: DetectabilityCertificate = guarantee.certificate
    cover = Increments(model, certificate.domain, u=u).cover("AB")
    P, root = certificate.P_upper, np.linalg.cholesky(certificate.P_upper).T
    if len(P) != len(model.x):
        raise InputError(f"predict_growth: the certificate has {len(P)} states, model {model.name!r} {len(model.x)}")
    inverse = np.linalg.inv(root)
    if model.step is None:
        rate = max(float(eigh(P @ A + A.T @ P, P, eigvals_only=True)[-1]) for A in cover.jacobians.A) / 2
    else:
        rate = max(float(np.linalg.norm(root @ A @ inverse, 2)) for A in cover.jacobians.A) - 1
    given = guarantee.disturbance
    sizes = np.abs(
        model.w.vector(np.full(len(model.w), given) if np.isscalar(given) else given, "guarantee: disturbance")
    )
    push = max(_longest(root @ B * sizes) for B in cover.jacobians.B)
    return Growth(rate, push, certificate.ratio, model.step, cover.method, cover.rigorous)


def _longest(columns: Array) -> float:
    """Return the largest norm of a sum of columns with any signs, a bound of it from 13 columns on."""
    used = columns[:, np.abs(columns).any(axis=0)]
    if used.shape[1] > 12:
        return float(np.linalg.norm(used, axis=0).sum())
    return max((float(np.linalg.norm(used @ signs)) for signs in product((1, -1), repeat=used.shape[1])), default=0.0)
