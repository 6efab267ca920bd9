"""Whether one estimator is what its certificate is about, and the bounds of its estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.guarantee import Guarantee, Track, WindowBounds, largest_square
from ctmhe.errors import InputError
from ctmhe.models.continuous import box_arrays
from ctmhe.transcription.weights import weight_matrix
from ctmhe.types import Array, ErrorBound, Outcome, Status

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE

Doubts = tuple[tuple[float, str], ...]
"""Times at which data are not what the theory assumes, and why; infinite for good."""


class Guaranteed:
    """The bounds of one estimator's estimates, or why there are none.

    Attributes
    ----------
    unmet : tuple of str
        What the configuration lacks: then no estimate has a bound.
    bounds : WindowBounds
        With the certificate scaled to the estimator's weights: Remark 3.4 (3.14).
    """

    def __init__(self, guarantee: Guarantee, mhe: MHE):
        if not isinstance(guarantee, Guarantee):
            raise InputError(f"guarantee: expected Guarantee(certificate, disturbance=...), got {guarantee!r}")
        own, model = guarantee.certificate, mhe.model
        n, nw, ny = len(model.x), len(model.w), len(model.y)
        if (own.P_upper.shape[0], own.Q.shape[0], own.R.shape[0]) != (n, nw, ny):
            raise InputError(
                f"guarantee: the certificate is for {own.P_upper.shape[0]} states, {own.Q.shape[0]} disturbances and "
                f"{own.R.shape[0]} outputs; model {model.name!r} has {n}, {nw} and {ny}"
            )
        self.guarantee, self.model = guarantee, model
        sizes = np.abs(model.w.vector(_spread(guarantee.disturbance, nw), "guarantee: disturbance"))
        lower, upper = box_arrays(model.x, own.domain.x if own.domain else None, "domain of x")
        self.domain = lower, upper
        certificate, problems = _scaled(own, mhe)
        self.unmet = (*problems, *_unmet(own, mhe))
        self.bounds = WindowBounds(
            certificate,
            mhe.horizon,
            supply=largest_square(certificate.Q, sizes),
            cap=largest_square(certificate.P_upper, upper - lower),
            slack=1e-6 * mhe.interval,
        )

    def outside(self, p: Array) -> tuple[str, ...]:
        """Return in words which known parameters (np,) lie outside the certificate's domain."""
        domain = self.guarantee.certificate.domain
        lower, upper = box_arrays(self.model.p, domain.p if domain else None, "domain of p")
        out = [
            name for name, value, a, b in zip(self.model.p.names, p, lower, upper, strict=True) if not a <= value <= b
        ]
        return tuple(f"parameter {name} lies outside the certificate's domain" for name in out)

    def incomplete(self, times: Array, rows: Array, start: float, end: float) -> Doubts:
        """Return a doubt where a record of the window lacks an output, or a step of a discrete model its record."""
        step, slack = self.model.step, self.bounds.slack
        if step is not None:
            known = int(np.count_nonzero((times >= start - slack) & (times < end - slack)))
            if (lacking := round((end - start) / step) - known) > 0:
                return ((np.inf, f"{lacking} steps of the window have no measurement"),)
        gaps = np.flatnonzero(np.isnan(rows).any(axis=1) & (times >= start - slack))
        if not len(gaps):
            return ()
        k = int(gaps[-1])
        names = [name for name, value in zip(self.model.y.names, rows[k], strict=True) if np.isnan(value)]
        return ((np.inf, f"no value of {', '.join(names)} at t = {times[k]:g} s"),)

    def begin(self, t: float, x: Array) -> Track:
        """Return the track at the start: how wrong the initial estimate `x` (nx,) can be."""
        lower, upper = self.domain
        sizes = np.maximum(upper - x, x - lower)
        if self.guarantee.error is not None:
            given = _spread(self.guarantee.error, len(x))
            sizes = np.abs(self.model.x.vector(given, "guarantee: error"))
        return Track(t, largest_square(self.bounds.certificate.P_upper, sizes))

    def after(
        self, track: Track, start: float, t: float, cost: float, status: Status, doubts: Doubts
    ) -> tuple[Track, ErrorBound]:
        """Return the track and the bound after a solve."""
        problems = list(self.unmet)
        found = list(dict.fromkeys(why for when, why in doubts if when > start))
        problems += found[-1:] if len(found) < 2 else [f"{found[-1]}, and {len(found) - 1} more like it in this window"]
        if not (status.outcome in (Outcome.SOLVED, Outcome.FALLBACK) and status.success):
            problems.append(f"the estimate need not be a trajectory of the model: {status.outcome.value}")
        lacking = ("prior predicted, uncertified", "no measurement in window")
        problems += [note for note in status.notes if note in lacking and t > start]
        return self.bounds.after(track, start, t, cost, problems)


def _spread(value: object, n: int) -> object:
    return np.full(n, value, dtype=float) if isinstance(value, (int, float)) else value


def _scaled(own: DetectabilityCertificate, mhe: MHE) -> tuple[DetectabilityCertificate, list[str]]:
    """Return the certificate for the estimator's weights, and what stands against it."""
    cost, model, assembly = mhe.cost, mhe.model, mhe.assembly
    problems = []
    if assembly.p_estimated:
        problems.append("parameters are estimated: the certificate is one of states; see certify_jointly")
    varying = [name for name in "PQR" if callable(getattr(cost, name))]
    if varying:
        problems.append(f"weight {', '.join(varying)} varies in time: Remark 3.4 needs bounds for that")
    if cost.prior_eta != cost.eta:
        problems.append(f"prior_eta = {cost.prior_eta:g} differs from eta = {cost.eta:g}: (3.13) has one discount")
    if cost.S is not None:
        problems.append("the terminal weight S is not part of (3.13)")
    if problems:
        return own, problems
    names = model.x.names, model.w.names, model.y.names
    weights = [weight_matrix(getattr(cost, key), group, key) for key, group in zip("PQR", names, strict=True)]
    P, Q, R = weights[0] / 2, weights[1] / 2, weights[2]
    same = ((P, own.P_upper), (Q, own.Q), (R, own.R))
    eta = float(cost.eta or 1.0)
    if abs(eta - own.eta) <= 1e-12 and all(np.allclose(a, b, rtol=1e-12, atol=0.0) for a, b in same):
        return own, []
    try:
        return own.for_weights(P, Q, R, eta), []
    except InputError as error:
        return own, [f"the cost's weights are not covered (3.14): {error}"]


def _unmet(own: DetectabilityCertificate, mhe: MHE) -> list[str]:
    """Return what the estimator lacks beside weights."""
    model, problems = mhe.model, []
    steps = own.step or 0.0, model.step or 0.0
    if abs(steps[0] - steps[1]) > 1e-9 * steps[0]:
        times = [f"steps of {step:g} s" if step else "continuous time" for step in steps]
        problems.append(f"the certificate is for {times[0]}, the model in {times[1]}")
    pointed = [name for name, kind in mhe.hold.items() if kind == "point" and model.step is None]
    if pointed:
        problems.append(f"single samples of {', '.join(pointed)}: the theory needs the whole signal")
    if mhe.assembly.filtering:
        problems.append("the filtering form (3.6) has no bound here: leave filtering out")
    for key, group in (("x", model.x), ("w", model.w)):
        wanted = box_arrays(group, getattr(own.domain, key) if own.domain else None, f"domain of {key}")
        lower, upper = mhe.assembly.boxes[key]
        outside = (lower < wanted[0] - 1e-9 * np.abs(wanted[0])) | (upper > wanted[1] + 1e-9 * np.abs(wanted[1]))
        if outside.any():
            named = ", ".join(name for name, out in zip(group.names, outside, strict=True) if out)
            problems.append(f"{named} may leave the certificate's domain: give the MHE bounds that keep to it (3.12d)")
    return problems
