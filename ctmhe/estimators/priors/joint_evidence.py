"""Whether one estimator of states and parameters is what (5.42) is about, and its bounds from window to window."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import block_diag

from ctmhe.certificates.excited_set import ExcitationDesign
from ctmhe.certificates.guarantee import largest_square
from ctmhe.certificates.joint_bounds import Errors, Evidence, JointBounds, JointGuarantee
from ctmhe.certificates.weights import FadingWeight
from ctmhe.errors import InputError
from ctmhe.models.signals import Signals
from ctmhe.transcription.solved import Solved
from ctmhe.types import Array, ErrorBound, frozen

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.priors.joint import ExcitedPrior
    from ctmhe.estimators.state import State

INFEASIBLE = 1e-6


@dataclass(frozen=True, eq=False)
class JointLevels:
    """The bounds of one estimator's estimates, or why there are none.

    Attributes
    ----------
    bounds : JointBounds
    unmet : tuple of str
        What the configuration lacks: no estimate has a bound.
    unproved : tuple of str
        What (5.42) lacks beside that.
    """

    guarantee: JointGuarantee
    design: ExcitationDesign
    bounds: JointBounds
    unmet: tuple[str, ...]
    unproved: tuple[str, ...]

    @property
    def cap_x(self) -> float:
        """What the domain makes of U at most."""
        return self.bounds.cap_x

    @property
    def cap_p(self) -> float:
        """What the domain makes of |dp|^2_S at most."""
        return self.bounds.cap_p

    @cached_property
    def key(self) -> float:
        """A number that tells these bounds from others."""
        states, excited, weights = self.bounds.states, self.guarantee.excited, self.guarantee.weights
        parts = [states.P_lower, states.P_upper, states.S, states.Q, states.R, excited.S, excited.P, excited.Q,
                 excited.R, weights.W, weights.V, weights.Q, weights.R, self.bounds.sizes]  # fmt: skip
        model = self.design.model
        first = self.initial(np.concatenate([model.x.nominal, model.p.nominal]))
        numbers = [states.eta, excited.eta, self.bounds.alpha, self.bounds.horizon, first.state, first.prior]
        return digest([*parts, np.array(numbers, dtype=float)])

    def known(self, errors: Array) -> Array:
        """Return `Errors` of level and theorem (6,), those that are unknown by what the domain makes of them."""
        return np.where(np.isnan(errors), [self.cap_x, self.cap_p, self.cap_p] * 2, errors)

    @cached_property
    def metric(self) -> Array:
        """P_lower and S, of states and parameters (nx + np, nx + np)."""
        return frozen(block_diag(self.bounds.states.P_lower, self.guarantee.excited.S))

    def initial(self, start: Array) -> Errors:
        """Return how wrong the initial estimate `start` (nx + np,) can be."""
        lower, upper = box_of(self.design, "xp")
        sizes = np.maximum(upper - start, start - lower)
        model, nx = self.design.model, len(self.design.model.x)
        given = dict(self.guarantee.error or {})
        for name, size in given.items():
            sizes[(*model.x.names, *model.p.names).index(name)] = abs(float(size))
        state = largest_square(self.bounds.states.P_upper, sizes[:nx])
        parameters = largest_square(self.guarantee.excited.S, sizes[nx:])
        return Errors(min(state, self.cap_x), min(parameters, self.cap_p), min(parameters, self.cap_p))

    def after(
        self,
        mhe: MHE,
        state: State,
        solved: Solved,
        before: tuple[Errors, Errors],
        told: tuple[float, float],
        level: float,
        *,
        aligned: bool,
    ) -> tuple[Array, tuple[str, ...]]:
        """Return the errors of level and theorem (6,) after a solve, and what stands against them.

        `before` at the window's start, `told` after the last solve; `aligned`: a solve was there.
        """
        found, reasons = evidence(mhe, state, solved, level), self.unmet
        if isinstance(found, str):
            reasons = (*reasons, found)
        if reasons:
            excited, full = level >= self.bounds.alpha, solved.n >= self.bounds.horizon
            lower, upper = box_of(self.design, "x")
            astray = len(state.x) == len(lower) and bool(((state.x < lower) | (state.x > upper)).any())
            state_cap = np.inf if astray else self.cap_x
            ends = [
                Errors(state_cap, self.cap_p if excited and full else one.prior, self.cap_p if excited else last)
                for one, last in zip(before, told, strict=True)
            ]
        else:
            assert isinstance(found, Evidence)
            first = self.bounds.level(before[0], told[0], found)
            reasons = list(self.unproved)
            if not aligned:
                reasons.append("the window does not start at a solve, as (5.17) has it: estimate at every step")
            if not reasons and (cost := self.bounds.cost(found)) > (most := self.bounds.most(before[1], found)):
                reasons.append(
                    f"its cost of {cost:.4g} exceeds the {most:.4g} that the truth can cost: the solver found a worse "
                    "solution, or disturbances or the initial error are larger than stated"
                )
            second = first if reasons else self.bounds.theorem(before[1], told[1], found)
            ends = [first, second]
        return np.array([(one.state, one.prior, one.told) for one in ends]).ravel(), tuple(reasons)

    def bound(self, errors: Array, reasons: tuple[str, ...]) -> ErrorBound:
        """Return what an estimate tells of its error, from `Errors` of level and theorem (6,)."""
        level, theorem = (float(part[0] + part[2]) for part in (errors[:3], errors[3:]))
        known = not self.unmet and np.isfinite(level) and not any(reason.startswith(DATA) for reason in reasons)
        proved = not reasons and np.isfinite(theorem)
        if not reasons and not proved:
            reasons = ("nothing bounds the error to start from: give JointGuarantee(error=), or a bounded domain",)
        used = [part for part, use in ((errors[:3], known), (errors[3:], proved)) if use]
        own, nx = None, len(self.bounds.states.P_lower)
        if used:
            sizes = np.diagonal(np.linalg.inv(self.metric))
            state, parameters = (min(float(part[i]) for part in used) for i in (0, 2))
            own = frozen(np.sqrt(np.append(state * sizes[:nx], parameters * sizes[nx:])))
        numbers = level if known else None, theorem if proved else None
        return ErrorBound(*numbers, reasons, self.metric, self.cap_x + self.cap_p, own)


DATA = "this window: "


def evidence(mhe: MHE, state: State, solved: Solved, level: float) -> Evidence | str:
    """Return what a solved window says against its data and prior, or what it lacks."""
    model, start, nx = mhe.model, float(solved.part("t")[0]), len(mhe.model.x)
    near = mhe.slack(state.t)
    used = solved.part("t")[:-1][np.diff(solved.part("t")) > 0]
    times, rows = state.measurements.arrays(state.t - near)
    inside = times >= start - near
    times, rows = times[inside], rows[inside]
    doubts = [reason for when, reason in state.doubts if when >= start - near]
    if doubts:
        return f"{DATA}{doubts[-1]}"
    placed = len(rows) == len(used) and bool((np.abs(times - used) <= 1e-6 * mhe.interval).all())
    if not placed or not np.isfinite(rows).all():
        return f"{DATA}{len(used) - int(np.isfinite(rows).all(axis=1).sum())} steps have no complete measurement"
    if start > state.t0 + near and start > state.t - mhe.horizon + near:
        return f"{DATA}it does not reach back over the horizon"
    trajectory, n = solved.trajectory, len(used)
    x, w, p = trajectory.x, trajectory.w[:n], trajectory.p
    columns = [used[None], x[:n].T, trajectory.u0[:n].T, w.T, np.tile(p[:, None], (1, n))]
    ahead = np.asarray(model.dynamics.map(n).call(columns)[0]).T if n else x[:0]
    if np.abs((ahead - x[1 : n + 1]) / model.x.nominal).max(initial=0.0) > INFEASIBLE:
        return f"{DATA}what was found is no trajectory of the model"
    for key, values in (("x", x), ("w", w), ("p", p)):
        lower, upper = mhe.assembly.boxes[key]
        size = INFEASIBLE * np.asarray(getattr(model, key).nominal)
        if ((values < lower - size) | (values > upper + size)).any():
            return f"{DATA}bounds of {key} were relaxed"
    prior = solved.part("prior")
    growing = start <= state.t0 + near
    return Evidence(x[0] - prior[:nx], p - prior[nx:], w, trajectory.y[:n] - rows, growing, level)


def digest(parts: list[Array]) -> float:
    """Return a number that stands for arrays."""
    content = sha256(np.concatenate([np.ravel(np.asarray(part, dtype=float)) for part in parts]).tobytes()).digest()
    return float(int.from_bytes(content[:6], "big"))


def box_of(design: ExcitationDesign, keys: str) -> tuple[Array, Array]:
    """Return the domain of a design for some kinds of signals, one after the other."""
    increments = design.increments
    return tuple(  # type: ignore[return-value]
        np.concatenate([side[increments.place[key]] for key in keys]) for side in (increments.lower, increments.upper)
    )


def sizes_of(value: Any, signals: Signals, what: str) -> Array:
    """Return largest magnitudes (n,) given as one number, an array or a mapping."""
    if np.ndim(value) == 0 and not isinstance(value, dict):
        value = np.full(len(signals), float(value))
    return np.abs(signals.vector(value, what))


@lru_cache(maxsize=8)
def joint_levels(prior: ExcitedPrior, mhe: MHE) -> JointLevels:
    """Return the bounds of an estimator with this prior."""
    guarantee, design, model = prior.guarantee, prior.monitor.design, mhe.model
    assert guarantee is not None
    own = design.model
    for name in guarantee.error or {}:
        if name not in (*own.x.names, *own.p.names):
            raise InputError(f"JointGuarantee: error of {name!r}: no such state or parameter in {own.name!r}")
    unmet = list(_unmet(prior, mhe))
    same = all(getattr(own, key).names == getattr(model, key).names for key in "xuwpy")
    sizes = sizes_of(guarantee.disturbance, own.w, "JointGuarantee: disturbance")
    if same:
        lower, upper = box_of(design, "w")
        beyond = [name for name, s, a, b in zip(own.w, sizes, lower, upper, strict=True) if s > min(-a, b) + 1e-12]
        if beyond:
            unmet.append(f"disturbances as large as stated leave the domain: {', '.join(beyond)}")
    horizon = 1 if model.step is None else max(round(mhe.horizon / model.step), 1)
    (x_low, x_up), (p_low, p_up) = box_of(design, "x"), box_of(design, "p")
    cap_p = largest_square(guarantee.excited.S, p_up - p_low)
    scaled = guarantee.states.scaled(guarantee.weights.scale)
    bounds = JointBounds(guarantee, horizon, prior.alpha, sizes, largest_square(scaled.P_upper, x_up - x_low), cap_p)
    unproved = [] if unmet else list(_unproved(bounds, mhe))
    return JointLevels(guarantee, design, bounds, tuple(unmet), tuple(unproved))


def _unmet(prior: ExcitedPrior, mhe: MHE) -> list[str]:
    design, model, problems = prior.monitor.design, mhe.model, []
    if model.step is None:
        return ["bounds of joint estimates are for discrete time: windows between solves have no (5.17)"]
    if not all(getattr(design.model, key).names == getattr(model, key).names for key in "xuwpy"):
        problems.append("the monitor's model has other signals: parameters that vary have no bound here")
    if mhe.assembly.filtering:
        problems.append("the filtering form has no bound here: leave filtering out")
    if prior.directions:
        problems.append("(5.42) is about parameters that are updated together: directions have no bound")
    if design.scope != "global":
        problems.append("that one trajectory is excited says nothing of the pair with the truth: the design is local")
    assert prior.guarantee is not None
    if not np.allclose(prior.guarantee.excited.S, design.excited_set(prior.alpha).S, rtol=1e-9):
        problems.append("the guarantee's excited set is for another alpha than the prior's")
    for key in "xwp":
        if key == "p" and not problems and not len(model.p):
            continue
        if getattr(design.model, key).names != getattr(model, key).names:
            continue
        lower, upper = mhe.assembly.boxes[key]
        wanted = box_of(design, key)
        outside = (lower < wanted[0] - 1e-9 * np.abs(wanted[0])) | (upper > wanted[1] + 1e-9 * np.abs(wanted[1]))
        if outside.any():
            named = ", ".join(name for name, out in zip(getattr(model, key), outside, strict=True) if out)
            problems.append(f"{named} may leave the domain of the design: give the MHE bounds that keep to it")
    return problems


def _unproved(bounds: JointBounds, mhe: MHE) -> list[str]:
    weights, P = bounds.guarantee.weights, mhe.cost.P
    named = isinstance(P, FadingWeight) and P.weights is weights and P.W is weights.W and P.V is weights.V
    if not named or mhe.cost.Q is not weights.Q or mhe.cost.R is not weights.R or mhe.cost.eta != weights.eta_2:
        return ["the cost is not that of the guarantee's weights: use weights.cost(model)"]
    try:
        met = bounds.conditions
    except InputError as error:
        return [str(error)]
    if not met:
        return [
            f"the horizon of {bounds.horizon} steps is too short: (5.38)-(5.40) are {met.excited:.3g}, {met.prior:.3g} "
            f"and {met.bounded:.3g}, and have to be below one"
        ]
    return []
