"""Weights of the joint estimator of thesis ch. 5 from what is known of states and parameters: (5.10)-(5.16), (5.78)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag, eigh

from ctmhe.certificates.excited_set import ExcitedSet
from ctmhe.certificates.increments import AT_ONCE, Increments, Jacobians, constant
from ctmhe.certificates.injection import Units, coordinates
from ctmhe.certificates.lmi import require_cvxpy, solved
from ctmhe.errors import CertificateError, InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds, DiscountedCost, frozen, positive


@dataclass(frozen=True, eq=False)
class StateDetectability:
    """Assumption 5.1: U+ <= eta U + |dp|^2_S + |dw|^2_Q + |dy|^2_R, with |dx|^2_P_lower <= U <= |dx|^2_P_upper.

    `rigorous` tells whether the domain was covered, by `method`; `margin` is the smallest eigenvalue at fresh pairs.
    """

    P_lower: Array
    P_upper: Array
    S: Array
    Q: Array
    R: Array
    eta: float
    method: str = "given"
    rigorous: bool = False
    margin: float = float("nan")

    def scaled(self, factor: float) -> StateDetectability:
        """Return the same for factor U (Remark 3.4)."""
        names = ("P_lower", "P_upper", "S", "Q", "R")
        return replace(self, **{name: frozen(factor * getattr(self, name)) for name in names})


def detectability_margin(
    units: Units, eta: float, weights: tuple[Array, Array, Array, Array], jacobians: Jacobians
) -> Array:
    """Return the smallest eigenvalue of the dissipation inequality (5.5) at k points (k,), in nominal units.

    `weights` are P, S, Q, R of U = |dx|^2_P. In continuous time dU/dt <= ln(eta) U + ...
    """
    P, S, Q, R = weights
    A, B, E, C, D, F = jacobians
    f, h, n = np.concatenate([A, B, E], axis=2), np.concatenate([C, D, F], axis=2), len(P)
    right = block_diag(eta * P if units.discrete else np.log(eta) * P, Q, S) + h.transpose(0, 2, 1) @ R @ h
    if units.discrete:
        right = right - f.transpose(0, 2, 1) @ P @ f
    else:
        right[:, :n] -= P @ f
        right[:, :, :n] -= (P @ f).transpose(0, 2, 1)
    scale = block_diag(units.x, units.w, units.p)
    return np.linalg.eigvalsh(scale @ right @ scale)[:, 0]


def detect_states(model: Model, domain: Bounds | None = None, *, eta: float, u: Any = None) -> StateDetectability:
    """Find a quadratic i-IOSS Lyapunov function of the states with parameters as a further disturbance: Assumption 5.1.

    Corollary 7.1 and Theorem 7.2 with (w, p) for w. Of all, that with the least Q, S and R for P at least one, all in
    nominal units.

    Raises
    ------
    CertificateError
        If there is none at this rate.
    """
    if not 0 < eta < 1:
        raise InputError(f"detect_states: eta must lie in (0, 1), a factor per step or second, got {eta}")
    cp = require_cvxpy()
    increments, units = Increments(model, domain, u=u), Units.of(model)
    cover, centre = increments.cover(most=AT_ONCE), increments.at(increments.centre)
    parts, method, rigorous = cover.jacobians, cover.method, cover.rigorous
    if not all(constant(part) for part in parts[3:]):
        pairs = increments.mean(*increments.random_pairs(100, np.random.default_rng(3)))
        parts = Jacobians(*(np.concatenate(both) for both in zip(parts, pairs, strict=True)))
        method, rigorous = "grid", False
    pace = 1.0 if units.discrete else units.pace(parts)  # the program's unit of time
    basis = coordinates(units, parts, centre, eta)
    inside = replace(units, x=basis)
    n, nw, o, ny = (len(getattr(model, key)) for key in "xwpy")
    P, R = cp.Variable((n, n), symmetric=True), cp.Variable((ny, ny), symmetric=True)
    supply = [cp.Variable((k, k), symmetric=True) if k else None for k in (nw, o)]
    in_x, *places = np.split(np.eye(n + nw + o), [n, n + nw], axis=1)
    least = np.linalg.inv(units.x) @ basis
    constraints: list[Any] = [P >> least.T @ least, R >> 0, *(weight >> 0 for weight in supply if weight is not None)]
    for A, B, E, C, D, F in zip(*inside.scaled(parts), strict=True):
        f, h = np.hstack([A, B, E]) / pace, np.hstack([C, D, F])
        matrix = h.T @ R @ h
        for weight, place in zip(supply, places, strict=True):
            matrix = matrix if weight is None else matrix + place @ weight @ place.T
        if units.discrete:
            matrix = cp.bmat([[matrix + eta * in_x @ P @ in_x.T, f.T @ P], [P @ f, P]])
        else:
            half = in_x @ P @ f
            matrix = matrix + np.log(eta) / pace * in_x @ P @ in_x.T - half - half.T
        constraints.append((matrix + matrix.T) / 2 >> 1e-6 * np.eye(matrix.shape[0]))
    total = sum((cp.trace(weight) for weight in supply if weight is not None), cp.trace(R))
    try:
        solved(cp.Problem(cp.Minimize(total + 1e-6 * cp.trace(P)), constraints))
    except CertificateError as error:
        raise CertificateError(f"detect_states: no quadratic function at eta = {eta:g}: {error}") from None
    x, w, p, y = (np.linalg.inv(part) for part in (basis, units.w, units.p, units.y))
    Q, S = (
        np.zeros((0, 0)) if weight is None else unit @ weight.value @ unit
        for weight, unit in zip(supply, (w, p), strict=True)
    )
    values = (x.T @ P.value @ x, pace * S, pace * Q, pace * y @ R.value @ y)
    P_, S_, Q_, R_ = (frozen((value + value.T) / 2) for value in values)
    fresh = increments.mean(*increments.random_pairs(400, np.random.default_rng(5)))
    margin = min(detectability_margin(units, eta, (P_, S_, Q_, R_), part).min() for part in (fresh, parts))
    if margin < -1e-9:
        raise CertificateError(
            f"detect_states: (5.5) fails by {-margin:.2g} in nominal units at points that the solver did not see; try "
            "a slower rate or a smaller domain"
        )
    return StateDetectability(P_, P_, S_, Q_, R_, eta, method=method, rigorous=rigorous, margin=float(margin))


@dataclass(frozen=True, eq=False)
class JointWeights:
    """Weights and discounts of the cost (5.9), constant in time.

    J = gamma(N) |x(0) - x_bar|^2_W + eta_1^N |p - p_bar|^2_V + sum of eta_2^(N-1-j) ( |w|^2_Q + |y_hat - y|^2_R ).

    Attributes
    ----------
    W, V, Q, R : array
    eta_1, eta_2, eta_x, eta_p : float
    ratio : float
        lambda_max(P_p, P_upper), of gamma.
    scale : float
        By which U was scaled: `states.scaled(weights.scale)` is what they are for.
    """

    W: Array
    V: Array
    Q: Array
    R: Array
    eta_1: float
    eta_2: float
    eta_x: float
    eta_p: float
    ratio: float
    scale: float = 1.0

    def gamma(self, s: Any) -> Any:
        """Return gamma(s) of (5.10), s a number or an array."""
        return self.eta_x**s + self.ratio * self.eta_p**s

    def cost(self, model: Model, **varying: Any) -> DiscountedCost:
        """Return the cost (5.9), or (5.77) for a model that has its parameters as its last states.

        Its prior fades by gamma and eta_1, its stage by eta_2: per step, or per second in continuous time.

        Parameters
        ----------
        model : Model
            Of the estimator.
        **varying : callable of time, or matrix
            W, V, Q or R in place of the constant ones, W and V of the time at which the window starts. Not below the
            floors (5.13)-(5.16), which `unmet` compares.
        """
        unknown = sorted(set(varying) - set("WVQR"))
        if unknown:
            raise InputError(f"cost: weights are W, V, Q and R, got {', '.join(unknown)}")
        given = {name: varying.get(name, getattr(self, name)) for name in "WVQR"}
        prior = FadingWeight(self, model.step or 1.0, given["W"], given["V"])
        return DiscountedCost(P=prior, Q=given["Q"], R=given["R"], eta=self.eta_2, prior_eta=1.0)


@dataclass(frozen=True, eq=False)
class FadingWeight:
    """The prior's weight of (5.9): gamma(N_t) W for the states, eta_1^N_t V for the parameters.

    Attributes
    ----------
    weights : JointWeights
        Whose discounts they are.
    step : float
        Seconds in which discounts count.
    W, V : array, or callable of the window's start in seconds
    """

    weights: JointWeights
    step: float
    W: Array | Callable[[float], Any]
    V: Array | Callable[[float], Any]

    def __call__(self, start: float, length: float) -> Array:
        """Return the weight (nx + np, nx + np) for a window of `length` seconds."""
        n = length / self.step
        W, V = (np.asarray(part(start) if callable(part) else part) for part in (self.W, self.V))
        nx, both = len(W), np.zeros((len(W) + len(V),) * 2)
        both[:nx, :nx], both[nx:, nx:] = self.weights.gamma(n) * W, self.weights.eta_1**n * V
        return both


def joint_weights(
    states: StateDetectability,
    excited: ExcitedSet,
    *,
    eta_1: float | None = None,
    eta_2: float | None = None,
    scale: float | None = None,
    caution: float = 1.0,
    B_p: Any = None,
) -> JointWeights:
    """Return the smallest constant weights that Assumption 5.2 allows: (5.10)-(5.16).

    Parameters
    ----------
    states, excited
        Of the same model; `design.excited_set(alpha)`.
    eta_1, eta_2 : float, optional
        (5.11) and (5.12); midway to one when left out, and the larger of both rates.
    scale : float, optional
        Factor of U before it is used (Remark 3.4). When left out 1 / lambda_max(S_x, S_p), as in thesis 5.2.4: a larger
        one lengthens the horizon (5.35), a smaller one trusts the model less.
    caution : float >= 1
        V over 2 S_p: how much a parameter counts that was found with enough excitation.
    B_p : array (np, nw), optional
        Parameters vary by p+ = p + B_p w, `excited` being made for the horizon: (5.77)-(5.79), where the stage is not
        discounted and Q_v = B_p' (V / 2) B_p is added to Q.

    Raises
    ------
    InputError
        For discounts outside their intervals.
    """
    fade = max(states.eta, excited.eta)
    eta_1 = (1 + fade) / 2 if eta_1 is None else float(eta_1)
    eta_2 = (fade if B_p is None else 1.0) if eta_2 is None else float(eta_2)
    if not fade < eta_1 < 1:
        raise InputError(f"joint_weights: eta_1 must lie in ({fade:.6g}, 1) (5.11), got {eta_1}")
    if not (fade <= eta_2 < 1 or (B_p is not None and eta_2 == 1)):
        raise InputError(f"joint_weights: eta_2 must lie in [{fade:.6g}, 1) (5.12), got {eta_2}")
    if not (np.isfinite(caution) and caution >= 1):
        raise InputError(f"joint_weights: caution must be at least 1 (5.14), got {caution}")
    if scale is None:
        scale = 1 / max(float(eigh(states.S, excited.S, eigvals_only=True)[-1]), 1e-300)
    states = states.scaled(positive("joint_weights: scale", scale))
    ratio = float(eigh(excited.P, states.P_upper, eigvals_only=True)[-1])
    V, Q = 2 * caution * excited.S, 2 * (states.Q + excited.Q)
    if B_p is not None:
        Q = Q + np.transpose(B_p) @ V @ np.asarray(B_p)
    W, R = 2 * states.P_upper, states.R + excited.R
    return JointWeights(frozen(W), frozen(V), frozen(Q), frozen(R), eta_1, eta_2, states.eta, excited.eta, ratio, scale)


def unmet(weights: JointWeights, states: StateDetectability, excited: ExcitedSet) -> tuple[str, ...]:
    """Return which of (5.10)-(5.16) weights of one's own do not meet, in words; `states` as scaled for them."""
    fade = max(states.eta, excited.eta)
    ratio = float(eigh(excited.P, states.P_upper, eigvals_only=True)[-1])
    found = []
    if weights.eta_x < states.eta or weights.eta_p < excited.eta or weights.ratio < ratio * (1 - 1e-9):
        found.append("(5.10): gamma fades faster than states or parameters, or its ratio is too small")
    if not fade < weights.eta_1 < 1:
        found.append(f"(5.11): eta_1 = {weights.eta_1:g} outside ({fade:g}, 1)")
    if not fade <= weights.eta_2 < 1:
        found.append(f"(5.12): eta_2 = {weights.eta_2:g} outside [{fade:g}, 1)")
    floors = {
        "(5.13): W": (weights.W, 2 * states.P_upper),
        "(5.14): V": (weights.V, 2 * excited.S),
        "(5.15): Q": (weights.Q, 2 * (states.Q + excited.Q)),
        "(5.16): R": (weights.R, states.R + excited.R),
    }
    for name, (weight, floor) in floors.items():
        below = float(np.linalg.eigvalsh(weight - floor).min(initial=np.inf))
        if below < -1e-9 * np.abs(floor).max(initial=0.0):
            found.append(f"{name} is below its floor by {-below:.3g}")
    return tuple(found)
