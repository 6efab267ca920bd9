"""How output differences bound parameter differences: the design behind the excitation monitor, thesis 7.2.

One function carries the proofs of thesis 7.2 and of Theorem 10 of the joint estimation paper (000)::

    W = |z|^2_P + |dp|^2_S,  z = dx - Y dp,  Y+ = Phi Y + E + L F,  S+ = mu S + (C Y + F)' (C Y + F)

Along every pair of trajectories in the domain W+ <= mu W + |dw|^2_Q + |dy|^2_R. There this follows from (7.41) by
Young's inequality, with numbers eps, gamma, or a, eps1, eps2, that have to be tuned. Here it is asked for directly.
Since C Y dp + F dp = dy - C z - D dw, it reads ::

    |Phi z + (B + L D) dw - L dy|^2_P + |dy - C z - D dw|^2 <= mu |z|^2_P + |dw|^2_Q + |dy|^2_R

for all z, dw, dy: a linear matrix inequality in (P, P L, Q, R), whose solution is at least as good as the best choice
of those numbers (gamma = a = 1, since W may be scaled). (7.41) is its part dw = dy = 0. In continuous time, with
-kappa = ln mu, dY/dt = Phi Y + E + L F, dS/dt = -kappa S + (C Y + F)' (C Y + F),

    2 z'P (Phi z + (B + L D) dw - L dy) + |dy - C z - D dw|^2 <= -kappa |z|^2_P + |dw|^2_Q + |dy|^2_R

gives dW/dt <= -kappa W + |dw|^2_Q + |dy|^2_R. Both are convex in A and B where C and D are constant, so that they hold
for the mean values of every pair if they hold on a hull of the point values.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import minimize_scalar

from ctmhe.certificates.excited_set import Drift, ExcitationDesign
from ctmhe.certificates.increments import AT_ONCE, Cover, Increments, Jacobians, constant
from ctmhe.certificates.injection import SLACKS, SPEEDS, Units, design, gathered, least_upper_bound, phi_factor
from ctmhe.errors import CertificateError, InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds, frozen, positive

FRESH = 400
FASTEST = 500.0
"""Rate per second; what fades faster than by exp(-500) is zero for a computer."""

SEEN = 0.02
"""What shows less in y, both in nominal units, is worth a word when there is no design."""


def design_excitation(
    model: Model,
    domain: Bounds | None = None,
    *,
    u: Any = None,
    mu: float | None = None,
    horizon: float | None = None,
    B_p: Any = None,
) -> ExcitationDesign:
    """Find L(z1, z2), P, Q, R with which excitation can be monitored on a domain: thesis (7.40)-(7.41), (7.55)-(7.57).

    Where outputs are linear, L follows A, so that Phi is as constant as they allow. If it is constant, f affine in p
    and h free of it, the result is global: Corollary 7.2, which also asks for (7.65) and (7.68).

    Parameters
    ----------
    model : Model
        With parameters p; discrete or continuous.
    domain : Bounds, optional
        Of x, w and p; the model's own bounds when left out. Signals on which no Jacobian depends may be free. It need
        not be invariant: what is claimed holds for pairs that stay inside.
    u : box, optional
        Range of the inputs.
    mu : float in (0, 1), optional
        Factor per step or second. When left out, the one with the least of what noise of nominal size makes of the
        parameters, (7.46) over 1 - 4 mu^T: slow ones average more noise, fast ones contract more over the horizon.
    horizon : float, optional
        T in steps or seconds, the window from which parameters are to be judged; it decides about `mu` only. 200 times
        the model's fastest time constant when left out. What is claimed holds for any T.
    B_p : array (np, nw), optional
        Parameters vary: p+ = p + B_p w, or dp/dt = B_p w (7.73b).

    Raises
    ------
    CertificateError
        If there is no such injection, with a mode that shows it where one is known.
    InputError
        For a model without parameters, a domain without bounds where they matter, numbers out of range.
    """
    if not len(model.p):
        raise InputError(f"design_excitation: model {model.name!r} has no parameters; name some with p=")
    if mu is not None and not 0 < mu < 1:
        raise InputError(f"design_excitation: mu must lie in (0, 1), a factor per step or second, got {mu}")
    increments, units = Increments(model, domain, u=u), Units.of(model)
    if B_p is not None:
        B_p = np.asarray(B_p, dtype=float)
        if B_p.shape != (len(model.p), len(model.w)):
            expected = f"({len(model.p)}, {len(model.w)}), parameters by disturbances"
            raise InputError(f"design_excitation: B_p must have shape {expected}, got {B_p.shape}")
    cover, notes = _cover(increments)
    points, centre = cover.jacobians, increments.at(increments.centre)
    linear = constant(points.C) and constant(points.D)
    compensated = linear and not constant(points.A)
    unseen = np.eye(len(units.x)) - units.right_inverse(centre.C[0]) @ centre.C[0]
    samples = increments.at(increments.random(64, np.random.default_rng(2)))
    fixed = linear and constant(np.concatenate([points.A, samples.A]) @ unseen)
    pace = units.pace(centre)
    T = 200.0 / pace if horizon is None else positive("design_excitation: horizon", horizon)
    if not units.discrete and 1.1 * np.log(4) / T > FASTEST:
        raise InputError(
            f"design_excitation: to contract within {T:.2g} s, W would have to fade by less than exp(-{FASTEST:g}) per "
            "second; give a longer horizon=, or a model that counts milliseconds"
        )

    def attempt(factor: float, least: float, speed: float) -> tuple[float, Any]:
        noise, *found, L = design(units, points, centre, factor, T, compensated=compensated, least=least, speed=speed)
        Phi, G = centre.A[0] + L @ centre.C[0], samples.E + L @ samples.F
        information, memory = gathered(units, factor, T, Phi, G, centre.C[0], samples.F)
        contracts = max(1 - 4 * factor**T, 1e-12)
        return noise * memory / (max(information, 1e-300) * contracts), (*found, L)

    failure, chosen = None, mu
    for round_, (least, speed) in enumerate(zip(SLACKS, SPEEDS, strict=True)):
        try:
            if chosen is None:
                slowest, fastest = 1.1 * np.log(4) / T, min(pace, 4.0 if units.discrete else FASTEST)
                chosen = best_factor(lambda factor: attempt(factor, SLACKS[0], speed)[0], slowest, fastest)  # noqa: B023
            P, Q, R, L = attempt(chosen, least, speed)[1]
        except CertificateError as error:
            failure = error
            continue
        made = ExcitationDesign(
            increments, frozen(P), frozen(Q), frozen(R), float(chosen), float(chosen), frozen(L),
            A=frozen(centre.A[0]) if compensated else None, C=frozen(centre.C[0]),
            Phi=frozen(centre.A[0] + L @ centre.C[0]) if fixed else None,
            scope="global" if fixed and _follows_one(increments, compensated) else "local", H=None,
            method=cover.method, rigorous=cover.rigorous, margin=np.nan, notes=notes,
            worst=(increments.centre, increments.centre),
        )  # fmt: skip
        made, met = _verified(made, points, round_)
        if made.margin >= -1e-10:
            return made if B_p is None else replace(made, drift=_drift(made, B_p))
        failure = (
            f"the inequality fails by {-made.margin:.2g} (nominal units, over R) at points that the solver did not "
            f"see, or by its inaccuracy. Try another mu than {chosen:.4g}, a smaller domain, or nominal= nearer to the "
            "sizes of the signals"
        )
        if not cover.rigorous:  # samples are refined where they were too few
            points = Jacobians(*(np.concatenate(parts) for parts in zip(points, met, strict=True)))
    raise CertificateError(f"design_excitation: {_why_not(increments, chosen)}{failure}")


def _cover(increments: Increments) -> tuple[Cover, tuple[str, ...]]:
    cover = increments.cover("ABCD", most=AT_ONCE)
    if constant(cover.jacobians.C) and constant(cover.jacobians.D):
        return cover, ()
    pairs = increments.between(*increments.random_pairs(100, np.random.default_rng(3)))
    both = Jacobians(*(np.concatenate(parts) for parts in zip(cover.jacobians, pairs, strict=True)))
    note = "outputs are not linear: mean values of their Jacobians over pairs were sampled"
    return Cover(both, "grid", False), (note,)


def best_factor(score_of: Any, slowest: float, fastest: float) -> float:
    """Return mu of the least score for rates between two: a coarse search, then a fine one.

    Raises
    ------
    CertificateError
        If there is no design at any of the rates.
    """
    rates, failure = np.geomspace(slowest, max(fastest, 1.5 * slowest), 6), None

    def score(log_rate: float) -> float:
        nonlocal failure
        try:
            return float(np.log(score_of(float(np.exp(-np.exp(log_rate))))))
        except CertificateError as error:
            failure = error
            return 1e3

    scores = [score(np.log(rate)) for rate in rates]
    best = int(np.argmin(scores))
    if scores[best] >= 1e3:
        raise failure or CertificateError("no rate was tried")
    edges = np.log(rates[[max(best - 1, 0), min(best + 1, len(rates) - 1)]])
    found: Any = minimize_scalar(score, bounds=tuple(edges), method="bounded", options={"maxiter": 7})
    return float(np.exp(-np.exp(found.x) if found.fun < scores[best] else -rates[best]))


def _why_not(increments: Increments, mu: float | None) -> str:
    """Return a sentence on the mode that is seen least of those that fade too slowly, where it is hardly seen.

    By the Popov-Belevitch-Hautus test at points of the domain, the centre first: no L moves a mode that is unseen.
    """
    model, units = increments.model, Units.of(increments.model)
    v = np.vstack([increments.centre, increments.random(FRESH, np.random.default_rng(7)), increments.corners()])
    jacobians = units.scaled(increments.at(v))
    limit, n, worst = (mu or 1.0) ** 0.5, len(model.x), (SEEN, np.zeros(len(model.x)), 0.0, v[0])
    for point, A, C in zip(v, jacobians.A, jacobians.C, strict=True):
        size = np.linalg.norm(A, 2) or 1.0
        for value in np.linalg.eigvals(A):
            if (abs(value) if units.discrete else np.exp(value.real)) >= limit:
                _, seen, modes = np.linalg.svd(np.vstack([(A - value * np.eye(n)) / size, C]))
                if seen[-1] < worst[0] * (1 - 1e-6):
                    worst = (float(seen[-1]), np.abs(modes[-1]), value, point)
    if worst[0] >= SEEN:
        return ""
    parts = ", ".join(f"{name} {part:.2g}" for name, part in zip(model.x.names, worst[1], strict=True))
    where = ", ".join(f"{increments.names[i]} = {worst[3][i]:.3g}" for i in increments.varying)
    how = "do not see" if worst[0] < 1e-8 else "hardly see"
    return f"outputs {how} the mode ({parts}) with eigenvalue {worst[2]:.3g}, which fades too slowly at {where}; "


def _follows_one(increments: Increments, compensated: bool) -> bool:
    """Return whether E, L F and F of a pair depend on its first point only."""
    if not increments.symbolic:
        return False
    v1, v2 = increments.random_pairs(32, np.random.default_rng(4))
    moved = v1.copy()
    moved[:, increments.place["p"]] = v2[:, increments.place["p"]]
    here, there = increments.at(v1), increments.at(moved)
    same = np.allclose(here.E, there.E, rtol=1e-12, atol=1e-14) and np.allclose(here.F, there.F, rtol=1e-12, atol=1e-14)
    return bool(same and not (compensated and here.F.any()))


def _verified(made: ExcitationDesign, points: Jacobians, round_: int) -> tuple[ExcitationDesign, Jacobians]:
    """Return the design with what fresh pairs say of it (margin, eta, H), and the worst of these."""
    increments = made.increments
    v1, v2 = increments.random_pairs(FRESH, np.random.default_rng([5, round_]))
    corners = increments.corners()
    v1, v2 = np.vstack([v1, corners]), np.vstack([v2, corners])
    fresh = increments.between(v1, v2)
    at_pairs = made.slack(fresh)
    order = np.argsort(at_pairs)
    Phi = np.concatenate([made.recursion(part)[0] for part in (fresh, points)])
    eta = max(phi_factor(made.P, phi, discrete=made.discrete) for phi in Phi)
    margin = float(min(at_pairs.min(), made.slack(points).min()))
    worst = (frozen(v1[order[0]]), frozen(v2[order[0]]))
    return replace(made, margin=margin, worst=worst, eta=eta, H=regressor_bound(made)), fresh.take(order[:20])


def regressor_bound(made: ExcitationDesign) -> Array | None:
    """Return H of (7.68) if f is affine in p, outputs are linear, and the regressor varies only with what they show."""
    increments, place = made.increments, made.increments.place["p"]
    rng = np.random.default_rng(6)
    v = np.vstack([increments.random(200, rng), increments.corners()])
    moved = v.copy()
    moved[:, place] = increments.random(len(v), rng)[:, place]
    if not np.allclose(increments.at(v).E, increments.at(moved).E, rtol=1e-9):
        return None  # before it is asked for p = 0, where a model need not be defined
    zero, double = v.copy(), v.copy()
    zero[:, place], double[:, place] = 0.0, 2 * v[:, place]
    here, none, twice = (increments.at(points) for points in (v, zero, double))
    change, inverse = here.A - none.A, Units.of(made.model).right_inverse(made.C)
    hidden = np.abs(change - change @ inverse @ made.C).max(initial=0.0)
    affine = np.allclose(twice.A - none.A, 2 * change) and not here.F.any() and np.allclose(here.C, made.C)
    if not affine or hidden > 1e-9 * np.abs(change).max(initial=1e-300):
        return None
    seen = change @ inverse
    return frozen(least_upper_bound(seen.transpose(0, 2, 1) @ made.P @ seen, Units.of(made.model).y))


def filter_bounds(made: ExcitationDesign) -> tuple[float, float]:
    """Return bounds of |Y v|_P and |v|^2_S along pairs that start with zero: (7.78) at its best eps3, (7.85).

    For |v| = 1, v being parameters over their nominals.
    """
    nominal = Units.of(made.model).p
    points, other = _cover(made.increments)[0].jacobians, made.increments.cover("EF").jacobians
    L = made.injection(points.A)
    forces = (other.E[:, None] + L[None] @ other.F[:, None]).reshape(-1, *other.E.shape[1:])
    force = np.sqrt(max(np.linalg.eigvalsh(G.T @ made.P @ G)[-1] for G in forces @ nominal))
    Y = force / (1 - np.sqrt(made.eta)) if made.discrete else -2 * force / np.log(made.eta)
    seen = np.sqrt(max(eigh(C.T @ C, made.P, eigvals_only=True)[-1] for C in points.C))
    feed = max(np.linalg.norm(F, 2) for F in other.F @ nominal)
    return float(Y), float((seen * Y + feed) ** 2 / ((1 - made.mu) if made.discrete else -np.log(made.mu)))


def _drift(made: ExcitationDesign, B_p: Array) -> Drift:
    """Return what W needs for parameters that vary: thesis 7.2.2, where the proof drops B_p after (7.83).

    Y enters by Young's inequality on the whole step: W+ <= (1 + e) W+(constant) + (1 + 1/e) (|Y B_p dw|^2_P +
    |B_p dw|^2_S); in continuous time 2 |z'P Y B_p dw| + 2 |dp'S B_p dw| <= e W + (1/e) (the same).
    """
    (Y, S), mu, rate = filter_bounds(made), made.mu, -np.log(made.mu)
    share = np.linalg.solve(Units.of(made.model).p, B_p)
    added = (Y**2 + S) * share.T @ share
    if made.discrete:
        contraction = (1 + mu) / 2
        e = contraction / mu - 1
        return Drift(frozen(B_p), contraction, frozen((1 + e) * made.Q + (1 + 1 / e) * added), (1 + e) * made.R, Y, S)
    e = rate / 2
    return Drift(frozen(B_p), float(np.exp(e - rate)), frozen(made.Q + added / e), made.R, Y, S)
