"""Certificates of detectability for a model on a domain: Theorem 7.2 in continuous, Corollary 7.1 in discrete time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import minimize_scalar

from ctmhe.certificates.certificate import DetectabilityCertificate, as_matrix, definite
from ctmhe.certificates.diagnosis import leaving, point, unseen_mode
from ctmhe.certificates.increments import Cover, Increments, Jacobians
from ctmhe.certificates.inequality import GAIN, Form, Program, Sizes, Wanted
from ctmhe.certificates.injection import Units
from ctmhe.errors import CertificateError, InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds

OBJECTIVES = ("gain", "rate", "P", "conditioning", "horizon")
SLACKS = (1e-7, 1e-6, 1e-5, 1e-4)
FRESH, FIRST, ROUNDS = 2000, 8, 25
MANY, HASTE = 64, 1.25
"""From how many Jacobians on the program is asked for how much more of -ln eta: few of them then suffice."""
ROUNDING = 1e-12
"""Of the terms that an eigenvalue is the difference of: one that is not below its negative is taken for zero."""
FASTEST = 500.0
"""Per second, or step: eta = exp(-rate) is a number then."""


def certify_detectability(
    model: Model,
    domain: Bounds | None = None,
    *,
    u: Any = None,
    eta: float | None = None,
    rate: float | None = None,
    P: Any = None,
    Q: Any = None,
    R: Any = None,
    objective: str | None = None,
    jacobians: Cover | Mapping[str, Any] | None = None,
    seed: int = 0,
) -> DetectabilityCertificate:
    """Find, or check, a quadratic i-iIOSS Lyapunov function of a model on a domain.

    Parameters
    ----------
    model : Model
        Whose functions do not depend on time. Parameters are known and constant, anywhere in their box.
    domain : Bounds, optional
        Boxes of x, w and p, convex therefore; the model's own when left out. What no Jacobian depends on may be free.
    u : box, optional
        Range of the inputs, in any form of `Bounds`.
    eta : float in (0, 1), optional
        Factor per second, or per step; with `objective` "rate" and "horizon" it is found.
    rate : float > 0, optional
        -ln eta, in place of it.
    P, Q, R : scalar, diagonal or matrix, optional
        Weights of one's own, model units. With all of them, and eta, they are only checked.
    objective : str, optional
        `gain`: least Q and R for P at least one, in nominal units; the default if eta is given. `rate`: smallest eta,
        the default if not; noise of nominal size then weighs at most `GAIN` as much as an error of nominal size, since
        otherwise observable models have any. `P`: largest smallest eigenvalue of P, for given Q and R.
        `conditioning`: least condition number of P, in nominal units. `horizon`: shortest horizon
        (3.30); a given P bounds U from above, and the function below it is found; without P the same as `rate`.
    jacobians : mapping letter -> (lower, upper), or Cover, optional
        Bounds of the entries of A, B, C and D (7.32), matrices or scalars, what does not vary left out: for an FMU,
        whose derivatives can be sampled only. Or Jacobians whose hull holds those of the domain. The certificate is
        as rigorous as they are.
    seed : int
        Of the fresh points.

    Returns
    -------
    DetectabilityCertificate
        Whose `margin` is the smallest eigenvalue of the inequality at fresh points: (7.33) and (7.26) with the sign
        changed, x and w in nominals. For outputs that are not affine at fresh pairs, mean values on the line between.

    Raises
    ------
    CertificateError
        If there is none: the direction that shows it, or the worst point.
    InputError
        For a domain without bounds where a Jacobian depends on them, a model that may jump, and arguments that do not
        fit.
    """
    found = _asked(model, eta, rate, objective, P, Q, R)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError(f"certify_detectability: seed must be a whole number, not negative, got {seed!r}")
    increments = Increments(model, domain, u=u)
    search = Search(increments, _cover(increments, jacobians), seed)
    eta, form = found.answer(search)
    values, pairs = search.fresh(form, eta, FRESH, seed + 1)
    if not search.holds(form, eta, pairs):
        raise CertificateError(search.fails(form, eta))
    top = found.wanted.P if found.objective == "horizon" and found.wanted.P is not None else form.P
    notes = list(leaving(increments))
    if search.program.varies:
        notes.insert(0, "outputs are not affine: they enter by a bound that is affine in their Jacobian")
    if jacobians is not None:
        notes.insert(0, "the Jacobians, or their bounds, were given: it is as rigorous as they are")
    if not search.cover.rigorous:
        notes.insert(0, f"evidence, not proof: {len(search.points.A)} Jacobians, then {FRESH} fresh points, hold it")
    worst = dict(zip(increments.names, pairs[0, 0].tolist(), strict=True))
    if search.program.varies:
        worst |= {f"{name} (second)": value for name, value in zip(increments.names, pairs[0, 1].tolist(), strict=True)}
    return DetectabilityCertificate(
        P_lower=form.P,
        P_upper=top,
        Q=form.W[0],
        R=form.R,
        eta=eta,
        step=model.step,
        method=search.cover.method,
        rigorous=search.cover.rigorous,
        margin=float(values[0]),
        domain=_where(increments, domain or model.bounds),
        worst=worst,
        notes=tuple(notes),
    )


def _where(increments: Increments, domain: Bounds) -> Bounds:
    """Return the domain without bounds of the disturbances on which no Jacobian depends: it holds for all of them."""
    names, place = increments.model.w.names, increments.place["w"]
    moving = [i for i in range(len(names)) if place.start + i in increments.varying]
    sides = {names[i]: (increments.lower[place][i], increments.upper[place][i]) for i in moving}
    return replace(domain, w=sides or None)


def _cover(increments: Increments, jacobians: Cover | Mapping[str, Any] | None) -> Cover:
    if isinstance(jacobians, Cover):
        return jacobians
    return increments.cover("ABCD", given=jacobians)


@dataclass(frozen=True, eq=False)
class _Asked:
    """What is given and what is to be found."""

    objective: str
    eta: float | None
    wanted: Wanted

    def answer(self, search: Search) -> tuple[float, Form]:
        """Return eta and the form."""
        if self.objective not in ("rate", "horizon"):
            assert self.eta is not None
            return self.eta, search.form(self.eta, self.wanted)
        eta, form = search.fastest(self.wanted)
        if self.objective == "horizon" and self.wanted.P is not None:
            eta, form = search.shortest(self.wanted, eta)
        return eta, form


def _asked(
    model: Model, eta: float | None, rate: float | None, objective: str | None, P: Any, Q: Any, R: Any
) -> _Asked:
    what = "certify_detectability"
    if eta is not None and rate is not None:
        raise InputError(f"{what}: give eta or rate (-ln eta), not both")
    if rate is not None:
        if not (isinstance(rate, (int, float)) and 0 < rate <= FASTEST):
            raise InputError(f"{what}: rate must be positive, and {FASTEST:g} per second or step at most, got {rate!r}")
        eta = float(np.exp(-rate))
    if eta is not None and not (isinstance(eta, (int, float)) and 0 < eta < 1):
        raise InputError(f"{what}: eta must lie in (0, 1), a factor per second or step, got {eta!r}")
    objective = objective or ("rate" if eta is None else "gain")
    if objective not in OBJECTIVES:
        raise InputError(f"{what}: objective must be one of {', '.join(OBJECTIVES)}, got {objective!r}")
    if (objective in ("rate", "horizon")) == (eta is not None):
        other = "finds eta: leave it out" if eta is not None else "needs eta= or rate="
        raise InputError(f"{what}: objective {objective!r} {other}")
    sizes = (("P", P, len(model.x)), ("Q", Q, len(model.w)), ("R", R, len(model.y)))
    given = {
        name: None if value is None else definite(as_matrix(value, n, name), name, zero=name != "P")
        for name, value, n in sizes
    }
    if not len(model.w):
        given["Q"] = np.zeros((0, 0))
    if objective == "P" and (given["Q"] is None or given["R"] is None or given["P"] is not None):
        raise InputError(f"{what}: objective 'P' needs Q= and R=, which P is measured by, and no P=")
    kind = {"rate": "gain", "horizon": "gain" if P is None else "share"}.get(objective, objective)
    limit = GAIN if objective in ("rate", "horizon", "conditioning") else None
    return _Asked(objective, eta, Wanted(kind, given["P"], (given["Q"],), given["R"], limit=limit))


class Search:
    """Forms for a model whose domain is covered, verified at every Jacobian of the cover and at fresh points."""

    def __init__(self, increments: Increments, cover: Cover, seed: int = 0):
        self.increments, self.cover, self.points = increments, cover, cover.jacobians
        self.sizes, self.seed = Sizes(Units.of(increments.model)), seed
        self.program = Program(self.sizes, increments, cover.jacobians)
        self.active = np.unique(np.linspace(0, len(self.points.A) - 1, FIRST).astype(int))
        if not cover.rigorous:
            v = np.vstack([increments.random(FRESH, np.random.default_rng(seed)), increments.corners()])
            self.points = _joined(self.points, increments.at(v))

    def form(self, eta: float, wanted: Wanted, *, quick: bool = False) -> Form:
        """Return a form for eta that holds at all Jacobians, and at fresh points unless `quick`.

        Jacobians and points where it fails join the program, the worst first.

        Raises
        ------
        CertificateError
        """
        slacks = list(SLACKS)
        haste = HASTE if len(self.points.A) > MANY and not self._checked(wanted) else 1.0
        form: Form | None = None
        for round_ in range(ROUNDS):
            try:
                form = self._solved(eta**haste, replace(wanted, slack=slacks[0]))
            except CertificateError as error:
                if haste > 1:
                    haste = 1.0
                    continue
                why = None if quick else unseen_mode(self.increments, eta)
                said = f": {why}. No weights help; try a slower rate" if why else f": {error}"
                raise CertificateError(f"no quadratic function at eta = {eta:.6g}{said}") from None
            margins = self.sizes.relative(form, eta, self.points)
            failing = np.flatnonzero(~(margins >= -ROUNDING))
            new = np.setdiff1d(failing, self.active)
            if len(new):
                self.active = np.union1d(self.active, self._worst(new, margins))
            elif len(failing):
                if self._checked(wanted) or len(slacks) == 1:
                    raise CertificateError(self.fails(form, eta))
                slacks.pop(0)
            elif quick:
                return form
            else:
                values, pairs = self.fresh(form, eta, FRESH, self.seed + 100 + round_)
                if self.holds(form, eta, pairs):
                    return form
                if self.cover.rigorous or self._checked(wanted):
                    raise CertificateError(self.fails(form, eta))
                self._add(self.increments.at(pairs[values < 0].reshape(-1, pairs.shape[2])))
        assert form is not None
        raise CertificateError(self.fails(form, eta))

    def fastest(self, wanted: Wanted) -> tuple[float, Form]:
        """Return the smallest eta for which a form is found, to one per mille of -ln eta, and the form."""
        if why := unseen_mode(self.increments, 1.0):
            raise CertificateError(f"model {self.increments.model.name!r} is not detectable: {why}")
        best: tuple[float, Form] | None = None
        pace, bracket, last = self.program.pace, [0.0, np.inf], CertificateError()
        rate = min(0.05 * (pace if not self.sizes.units.discrete else 1.0), FASTEST)
        for _ in range(40):
            try:
                best = (rate, self.form(float(np.exp(-rate)), wanted, quick=True))
                bracket[0] = rate
            except CertificateError:
                bracket[1] = rate
            low, high = bracket
            if high < 1e-6 * pace or (low > 0 and high / low < 1.001) or low >= FASTEST:
                break
            rate = rate / 8 if not low else rate * 4 if high == np.inf else float(np.sqrt(low * high))
            rate = min(rate, FASTEST)
        if best is None:
            raise CertificateError(
                f"model {self.increments.model.name!r}: no quadratic function at any rate on this domain, although no "
                "mode of a linearisation that outputs do not see grows. Try a smaller domain"
            )
        for share in (1.0, 0.999, 0.99, 0.9):  # fresh points may ask for less
            eta = float(np.exp(-share * best[0]))
            try:
                return eta, self.form(eta, wanted)
            except CertificateError as error:
                last = error
        raise last

    def shortest(self, wanted: Wanted, fastest: float) -> tuple[float, Form]:
        """Return eta and the form below the given P with the shortest horizon (3.30)."""

        def horizon(log_rate: float) -> float:
            try:
                form = self.form(float(np.exp(-np.exp(log_rate))), wanted, quick=True)
            except CertificateError:
                return 1e9
            return float(np.log(np.log(4 * eigh(wanted.P, form.P, eigvals_only=True)[-1])) - log_rate)

        top = np.log(-np.log(fastest))
        best: Any = minimize_scalar(horizon, bounds=(top - 5, top), method="bounded", options={"xatol": 1e-2})
        eta = float(np.exp(-np.exp(best.x)))
        return eta, self.form(eta, wanted)

    def fresh(self, form: Form, eta: float, count: int, seed: int) -> tuple[Array, Array]:
        """Return margins at the worst fresh points of the domain (k,), the least first, and these (k, 2, nv).

        Random ones and corners, then a local search from the worst of them. Pairs, for outputs that are not affine;
        otherwise the first of each is meant.
        """
        rng, increments, varies = np.random.default_rng(seed), self.increments, self.program.varies

        def margins(v: Array) -> Array:
            first, second = v[:, 0], v[:, 1]
            jacobians = increments.between(first, second) if varies else increments.at(first)
            return self.sizes.margins(replace(form, N=None), eta, jacobians)

        count = count // 4 if varies else count
        v1, v2 = increments.random_pairs(count, rng)
        v1, v2 = (np.vstack([part, increments.corners()]) for part in (v1, v2))
        same = np.r_[tuple(np.arange(len(increments.names))[increments.place[key]] for key in "up")]
        v2[:, same] = v1[:, same]
        pool = np.stack([v1, v2], axis=1)
        values = margins(pool)
        width = increments.upper - increments.lower
        width = np.where(np.isfinite(width), width, 0.0)
        moves = np.isin(np.arange(len(width)), increments.varying) & (width > 0)
        for radius in 0.3 * 0.6 ** np.arange(10 if moves.any() else 0):
            keep = pool[np.argsort(values)[:6]]
            steps = rng.normal(size=(20, *keep.shape)) * (radius * width * moves)
            steps[:, :, 1, same] = steps[:, :, 0, same]
            tried = np.clip(keep + steps, increments.lower, increments.upper).reshape(-1, *keep.shape[1:])
            pool, values = np.concatenate([pool, tried]), np.concatenate([values, margins(tried)])
        chosen, size = [], np.where(width > 0, width, 1.0)
        for i in np.argsort(values):
            if all(np.abs((pool[i] - pool[j]) / size).max() > 0.1 for j in chosen):
                chosen.append(i)
            if len(chosen) == 8:
                break
        return values[chosen], pool[chosen]

    def _worst(self, new: np.ndarray, margins: Array) -> np.ndarray:
        """Return a few of the points that fail: the worst, and the worst of random parts of the rest."""
        parts = np.array_split(np.random.default_rng(len(new)).permutation(new), 5)
        return np.unique(
            [new[np.argmin(margins[new])], *(part[np.argmin(margins[part])] for part in parts if len(part))]
        )

    def _add(self, more: Jacobians) -> None:
        """Add points to those that a form has to hold at."""
        self.active = np.append(self.active, len(self.points.A) + np.arange(len(more.A)))
        self.points = _joined(self.points, more)

    def _checked(self, wanted: Wanted) -> bool:
        return wanted.objective != "share" and all(part is not None for part in (wanted.P, *wanted.W, wanted.R))

    def _solved(self, eta: float, wanted: Wanted) -> Form:
        if self._checked(wanted) and not self.program.varies:
            return Form(wanted.P, wanted.W, wanted.R)  # pyright: ignore[reportArgumentType]
        return self.program.solve(self.points.take(self.active), eta, wanted)

    def holds(self, form: Form, eta: float, pairs: Array) -> bool:
        """Return whether the inequality holds at points, or pairs of them, that `fresh` returned, to rounding."""
        first, second = pairs[:, 0], pairs[:, 1]
        jacobians = self.increments.between(first, second) if self.program.varies else self.increments.at(first)
        return bool((self.sizes.relative(replace(form, N=None), eta, jacobians) >= -ROUNDING).all())

    def fails(self, form: Form, eta: float) -> str:
        """Return where and by how much a form fails, in words."""
        values, pairs = self.fresh(form, eta, FRESH, self.seed)
        margin, v = float(values[0]), pairs[0, 0]
        least = min(margin, float(self.sizes.margins(form, eta, self.points).min()))
        where = f"; at fresh points by {-margin:.3g}, at {point(self.increments, v)}" if margin < 0 else ""
        return (
            f"the inequality fails at eta = {eta:.6g} by {-least:.3g} in nominal units on the cover "
            f"({self.cover.method}){where}; try a slower rate, larger Q and R, or a smaller domain"
        )


def _joined(some: Jacobians, more: Jacobians) -> Jacobians:
    return Jacobians(*(np.concatenate(both) for both in zip(some, more, strict=True)))
