"""Whether one estimator is what its certificate is about, and the bounds of its estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.certificates.guarantee import Guarantee, Track, WindowBounds, WindowStart, largest_square
from ctmhe.errors import InputError
from ctmhe.estimators.priors.base import Filtering
from ctmhe.models.continuous import Model, box_arrays
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
        if not isinstance(own, DetectabilityCertificate):
            raise InputError(f"guarantee: expected a DetectabilityCertificate, got {own!r}")
        n, nw, ny = len(model.x), len(model.w), len(model.y)
        if (own.P_upper.shape[0], own.Q.shape[0], own.R.shape[0]) != (n, nw, ny):
            raise InputError(
                f"guarantee: the certificate is for {own.P_upper.shape[0]} states, {own.Q.shape[0]} disturbances and "
                f"{own.R.shape[0]} outputs; model {model.name!r} has {n}, {nw} and {ny}"
            )
        self.guarantee, self.model = guarantee, model
        sizes = np.abs(model.w.vector(_spread(guarantee.disturbance, nw), "guarantee: disturbance"))
        self.sizes = sizes
        lower, upper = box_arrays(model.x, own.domain.x if own.domain else None, "domain of x")
        self.domain = lower, upper
        certificate, problems = _scaled(own, mhe)
        self.hold_limit = mhe.hold_limit
        self.unmet = (*problems, *_unmet(own, mhe), *_beyond(own, mhe, sizes))
        self.bounds = WindowBounds(
            certificate,
            mhe.horizon,
            supply=largest_square(certificate.Q, sizes),
            cap=largest_square(certificate.P_upper, upper - lower),
            slack=1e-9 * mhe.interval,
            stated=() if guarantee.error is None else tuple(self.first_error(model.x.nominal).tolist()),
        )

    def outside(self, p: Array) -> tuple[str, ...]:
        """Return in words which known parameters (np,) lie outside the certificate's domain."""
        domain = self.guarantee.certificate.domain
        lower, upper = box_arrays(self.model.p, domain.p if domain else None, "domain of p")
        out = [
            name for name, value, a, b in zip(self.model.p.names, p, lower, upper, strict=True) if not a <= value <= b
        ]
        return tuple(f"parameter {name} lies outside the certificate's domain" for name in out)

    def lacking(self, times: Array, rows: Array, start: float, end: float) -> tuple[str, ...]:
        """Return what a window lacks of the whole signal: a value, the record of a step, or a stretch of time."""
        step, near = self.model.step, self.bounds.near(end)
        if step is not None:
            used = (times >= start - near) & (times < end - near)
            if (missing := round((end - start) / step) - len(np.unique(np.round(times[used] / step)))) > 0:
                return (f"{missing} steps of the window have no measurement",)
        else:
            used = (times >= _governing(times, start + near)) & (times <= end + near)
        gaps = np.flatnonzero(np.isnan(rows).any(axis=1) & used)
        if len(gaps):
            k = int(gaps[-1])
            names = [name for name, value in zip(self.model.y.names, rows[k], strict=True) if np.isnan(value)]
            return (f"no value of {', '.join(names)} at t = {times[k]:g} s",)
        if step is None and end > start + near:
            if not len(times) or times[0] > start + near:
                return (f"nothing is measured from the window's start at {start:g} s on",)
            longest = float(np.diff(np.append(times[used], end)).max())
            if longest > self.hold_limit + near:
                return (
                    f"nothing is measured for {longest:.4g} s, longer than a value is held ({self.hold_limit:g} s)",
                )
        return ()

    def resume(self, track: Track | None, t0: float, x0: Array, t: float) -> Track:
        """Return the track to go on with at a state, last solved at `t`, that may come from another configuration."""
        if track is not None and track.key == self.bounds.key:
            return track
        fresh = self.begin(t0, x0)
        if t <= t0 + self.bounds.near(t0):
            return fresh
        return self.bounds.resumed(replace(fresh, ends=(t,), levels=(np.inf,)), t, since=t)

    def first_error(self, x: Array) -> Array:
        """Return how wrong the initial estimate `x` (nx,) can be, state by state (nx,)."""
        if self.guarantee.error is not None:
            return np.abs(self.model.x.vector(_spread(self.guarantee.error, len(x)), "guarantee: error"))
        lower, upper = self.domain
        return np.maximum(upper - x, x - lower)

    def begin(self, t: float, x: Array) -> Track:
        """Return the track at the start: how wrong the initial estimate `x` (nx,) can be."""
        return Track(t, largest_square(self.bounds.certificate.P_upper, self.first_error(x)), key=self.bounds.key)

    def current(self, doubts: Doubts, times: Array, start: float) -> Doubts:
        """Return the doubts that concern windows from `start` on: what is wrong stays held until the next record."""
        near = self.bounds.near(start)
        ahead = [float(times[times > when + near].min(initial=np.inf)) for when, _ in doubts]
        return tuple(doubt for doubt, until in zip(doubts, ahead, strict=True) if until > start + near)

    def after(
        self,
        track: Track,
        start: float,
        t: float,
        cost: float,
        status: Status,
        reasons: Sequence[str],
        given: WindowStart | None = None,
    ) -> tuple[Track, ErrorBound]:
        """Return the track and the bound after a solve; `reasons` say what is doubtful or lacking in its window.

        `given` is what a suboptimal estimator knows of its prior; its estimates are trajectories of the model.
        """
        found = list(dict.fromkeys(reasons))
        problems = list(self.unmet)
        problems += found[-1:] if len(found) < 2 else [f"{found[-1]}, and {len(found) - 1} more like it in this window"]
        solved = status.outcome in (Outcome.SOLVED, Outcome.FALLBACK) and status.success
        if not (solved if given is None else status.outcome not in (Outcome.RELAXED, Outcome.PREDICTED)):
            problems.append(f"the estimate need not be a trajectory of the model: {status.outcome.value}")
        if t > start and "prior predicted, uncertified" in status.notes:
            problems.append("prior predicted, uncertified")
        astray = not solved and status.outcome not in (Outcome.SOLVED, Outcome.FALLBACK)
        return self.bounds.after(track, start, t, cost, problems, given, astray=astray)

    def within(self, x: Array) -> bool:
        """Return whether an estimate (nx,) lies in the domain, so that its width bounds the error."""
        lower, upper = self.domain
        return bool((x >= lower).all() and (x <= upper).all())


def _governing(times: Array, t: float) -> float:
    """Return the time of the last record at or before `t`, -inf if there is none."""
    return float(times[times <= t].max(initial=-np.inf))


def measurement_noise(model: Model) -> tuple[Array, Array] | None:
    """Return which entries of w enter outputs only, and the matrix (., ny) that makes up for an output error with them.

    None where they cannot make up for every error.
    """
    x, u, w, p = (np.asarray(getattr(model, key).nominal) for key in "xuwp")
    symbolic = model.dynamics.is_a("SXFunction") and model.output.is_a("SXFunction")
    kind: Any = ca.SX if symbolic else ca.MX
    free = kind.sym("w", len(w))
    f, h = (ca.jacobian(function(0.0, x, u, free, p), free) for function in (model.dynamics, model.output))
    B, D = (np.asarray(ca.DM(ca.Function("J", [free], [ca.densify(part)])(w))) for part in (f, h))
    silent = [f[:, i].nnz() == 0 if symbolic else not B[:, i].any() for i in range(len(w))]
    noise = np.flatnonzero(silent)
    if not len(noise) or np.linalg.matrix_rank(D[:, noise]) < len(model.y):
        return None
    return noise, np.linalg.pinv(D[:, noise])


def _spread(value: object, n: int) -> object:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        return value
    return np.full(n, float(value))


def _scaled(own: DetectabilityCertificate, mhe: MHE) -> tuple[DetectabilityCertificate, list[str]]:
    """Return the certificate for the estimator's weights, and what stands against it."""
    cost, model, assembly = mhe.cost, mhe.model, mhe.assembly
    problems = []
    if assembly.p_estimated:
        problems.append("parameters are estimated: the certificate is one of states; see certify_jointly")
    varying = [name for name in "PQR" if callable(getattr(cost, name))]
    if varying:
        problems.append(f"weight {', '.join(varying)} varies in time: Remark 3.4 needs bounds for that")
    if mhe.suboptimal is not None:
        for name, value in (("eta", cost.eta), ("prior_eta", cost.prior_eta)):
            if value is not None and value < own.eta * (1 - 1e-12):
                problems.append(f"{name} = {value:g} is below the certificate's {own.eta:g} (4.12)")
    elif cost.prior_eta != cost.eta:
        problems.append(f"prior_eta = {cost.prior_eta:g} differs from eta = {cost.eta:g}: (3.13) has one discount")
    if not (mhe.suboptimal is not None or isinstance(mhe.prior, Filtering)):
        problems.append("the prior is not the filtering prior (3.18)")
    if cost.S is not None:
        problems.append("the terminal weight S is not part of (3.13)")
    if problems:
        return own, problems
    names = model.x.names, model.w.names, model.y.names
    weights = [weight_matrix(getattr(cost, key), group, key) for key, group in zip("PQR", names, strict=True)]
    P, Q, R = weights[0] / 2, weights[1] / 2, weights[2]
    same = ((P, own.P_upper), (Q, own.Q), (R, own.R))
    eta = own.eta if mhe.suboptimal is not None else float(cost.eta or 1.0)  # that of U, whatever the cost's (4.41)
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
    elif model.step is None and measurement_noise(model) is None:
        problems.append(
            "the model has no measurement noise in every output, which has to account for holding records: add it to w"
        )
    if mhe.assembly.filtering and mhe.suboptimal is None:
        problems.append("the filtering form (3.6) has no bound here: leave filtering out")
    for key, group in (("x", model.x), ("w", model.w)):
        wanted = box_arrays(group, getattr(own.domain, key) if own.domain else None, f"domain of {key}")
        lower, upper = mhe.assembly.boxes[key]
        outside = (lower < wanted[0] - 1e-9 * np.abs(wanted[0])) | (upper > wanted[1] + 1e-9 * np.abs(wanted[1]))
        if outside.any():
            named = ", ".join(name for name, out in zip(group.names, outside, strict=True) if out)
            problems.append(f"{named} may leave the certificate's domain: give the MHE bounds that keep to it (3.12d)")
    return problems


def _beyond(own: DetectabilityCertificate, mhe: MHE, sizes: Array) -> list[str]:
    """Return which stated disturbances the certificate does not speak of."""
    w = mhe.model.w
    lower, upper = box_arrays(w, own.domain.w if own.domain else None, "domain of w")
    out = [name for name, size, a, b in zip(w.names, sizes, lower, upper, strict=True) if -size < a or size > b]
    return [f"disturbances as large as stated leave the certificate's domain: {', '.join(out)}"] if out else []
