"""Joint detectability of states and parameters: Theorem 10 of paper 000, and its conditions along a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag, eigh
from scipy.optimize import minimize_scalar

from ctmhe.certificates.excitation import ExcitationMonitor
from ctmhe.certificates.excitation_design import best_factor, design_excitation, filter_bounds
from ctmhe.certificates.excited_set import ExcitationDesign, ExcitedSet
from ctmhe.certificates.injection import Units, least_upper_bound
from ctmhe.certificates.weights import StateDetectability
from ctmhe.errors import CertificateError, InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds, DiscountedCost, Trajectory, frozen, positive


def lyapunov_matrix(P: Array, Y: Array, S: Array) -> Array:
    """Return M of U = |(dx, dp)|^2_M = |dx - Y dp|^2_P + |dp|^2_S: (23), with a in S."""
    return np.block([[P, -P @ Y], [-Y.T @ P, Y.T @ P @ Y + S]])


@dataclass(frozen=True, eq=False)
class JointCertificate:
    """A joint i-IOSS Lyapunov function U = |(dx, dp)|^2_M(t) for excited pairs: Theorem 10 of paper 000.

    U+ <= eta U + |dw|^2_Q + |dy|^2_R along every pair in the domain; M(t) from (23) with the recursions (18)-(19),
    which start anew in every window with Y = 0, S = S_0. a, eps1 and eps2 of the paper are found with P, Q, R by one
    program, see `excitation_design`; lambda = eta is its mu.

    Attributes
    ----------
    design : ExcitationDesign
    S_0 : array (np, np)
    M_0 : array (nx + np, nx + np)
        Gamma, the prior's weight in (7), undoubled.
    eta : float
        Factor per step, or per second.
    Q, R : array
    alpha : float
        Level of information in every window, that of `ExcitationMonitor`, for which the rest is computed.
    M_lower : array
        M >= M_lower at the end of every window that reaches alpha.
    kappa : float
        lambda_max(M_0, M_lower), of (33).
    horizon : float
        From here on 4 kappa eta^T < 1, in whole steps or in seconds (Theorem 2 with Remark 11).
    """

    design: ExcitationDesign
    S_0: Array
    M_0: Array
    eta: float
    Q: Array
    R: Array
    alpha: float
    M_lower: Array
    kappa: float
    horizon: float

    def rho(self, horizon: float, kappa: float | None = None) -> float:
        """Return 4 kappa eta^T, by which U falls over a window of T steps or seconds."""
        return 4 * (self.kappa if kappa is None else kappa) * self.eta**horizon

    def cost(self) -> DiscountedCost:
        """Return the cost (7) for this package's estimator: weights 2 M_0, 2 Q, R.

        For discrete-time models; in continuous time for outputs held as signals (`hold="zero"` or `"linear"`).
        """
        return DiscountedCost(P=2 * self.M_0, Q=2 * self.Q, R=self.R, eta=self.eta)

    def check(self, trajectory: Trajectory, *, kappa: float | None = None) -> OnlineConditions:
        """Return (33) and (34) along an estimated window: what Remark 11 asks for instead of M_lower and alpha.

        Parameters
        ----------
        trajectory : Trajectory
            `estimate.trajectory` over a full window.
        kappa : float, optional
            Of (33); the certificate's own when left out.
        """
        return self.window(trajectory, kappa=kappa)[1]

    def window(self, trajectory: Trajectory, *, kappa: float | None = None) -> tuple[Array, OnlineConditions]:
        """Return M at the end of an estimated window (nx + np, nx + np), and what `check` returns."""
        if self.design.scope != "global":
            raise CertificateError(
                "check: conditions (33)-(34) say something of the true trajectory only where one trajectory gives the "
                "information of every pair; here Phi varies, or f is not affine in p, or h depends on p"
            )
        n, o = self.design.P.shape[0], self.S_0.shape[0]
        found = ExcitationMonitor(self.design).along(trajectory, start=(np.zeros((n, o)), self.S_0))
        M = lyapunov_matrix(self.design.P, found.Y, found.matrix)
        largest = float(eigh(self.M_0, M, eigvals_only=True)[-1])
        length = float(trajectory.t[-1] - trajectory.t[0])
        T = round(length / self.design.model.step) if self.design.model.step else length
        nominal = Units.of(self.design.model).p
        alpha = float(np.linalg.eigvalsh(nominal @ found.undiscounted @ nominal)[0])
        limit = self.kappa if kappa is None else positive("check: kappa", kappa)
        return M, OnlineConditions(largest, limit, alpha, self.alpha, self.rho(T, largest))


@dataclass(frozen=True)
class OnlineConditions:
    """Conditions (33)-(34) of paper 000 along one window.

    Attributes
    ----------
    kappa : float
        lambda_max(M_0, M) at its end; (33) is `kappa <= kappa_limit`.
    kappa_limit : float
    alpha : float
        Level of the undiscounted sum; (34) is `alpha > alpha_limit`. Implied by (33) if S_0 > 0; kept
        since it tells excitation from memory.
    alpha_limit : float
    rho : float
        4 kappa eta^T with this window's own kappa: below one the error contracts over it.
    """

    kappa: float
    kappa_limit: float
    alpha: float
    alpha_limit: float
    rho: float

    @property
    def bounded(self) -> bool:
        """Whether (33) holds."""
        return self.kappa <= self.kappa_limit

    @property
    def excited(self) -> bool:
        """Whether (34) holds."""
        return self.alpha > self.alpha_limit

    def __bool__(self) -> bool:
        return self.bounded and self.excited


def certify_jointly(design: ExcitationDesign, *, alpha: float, S_0: Any = None) -> JointCertificate:
    """Return the joint certificate for windows whose level of information is at least alpha.

    Parameters
    ----------
    design : ExcitationDesign
        With constant parameters.
    alpha : float
        A level in y's units squared; what `ExcitationMonitor` finds on the trajectories that are expected.
    S_0 : array (np, np), optional
        Weight of the parameters' prior in (7), positive definite; of level alpha when left out. The smaller, the less
        a wrong prior counts and the faster U contracts.

    Raises
    ------
    InputError
        For an alpha or S_0 that is not positive.
    """
    if design.drift is not None:
        raise InputError("certify_jointly: Theorem 10 is for constant parameters; design without B_p")
    alpha, o, nominal = positive("certify_jointly: alpha", alpha), len(design.model.p), Units.of(design.model).p
    one = np.linalg.inv(nominal**2)  # weight of parameters over their nominals
    S_0 = alpha * one if S_0 is None else np.array(S_0, dtype=float)
    if S_0.shape != (o, o) or not np.allclose(S_0, S_0.T) or np.linalg.eigvalsh(S_0)[0] <= 0:
        raise InputError(f"certify_jointly: S_0 must be a symmetric positive definite ({o}, {o}) matrix, got {S_0}")
    size, largest = filter_bounds(design)[0], float(np.linalg.eigvalsh(nominal @ S_0 @ nominal)[-1])

    def factor(share: float) -> float:
        """kappa, as |dx - Y dp|^2_P >= share |dx|^2_P - share / (1 - share) |Y dp|^2_P by Young's inequality."""
        rest = alpha - share / (1 - share) * size**2
        return max(1 / share, largest / rest) if rest > 0 else np.inf

    top = alpha / (alpha + size**2)  # where nothing is left for the parameters
    found: Any = minimize_scalar(
        lambda s: np.log(min(factor(top * s), 1e300)), bounds=(1e-9, 1 - 1e-9), method="bounded"
    )
    share = top * float(found.x)
    M_lower = block_diag(share * design.P, (alpha - share / (1 - share) * size**2) * one)
    M_0 = block_diag(design.P, S_0)
    kappa = float(eigh(M_0, M_lower, eigvals_only=True)[-1])
    horizon = np.log(4 * kappa) / -np.log(design.mu)
    if design.discrete:
        horizon = float(np.floor(horizon) + 1)
    parts = (frozen(S_0), frozen(M_0), design.mu, design.Q, design.R, alpha, frozen(M_lower), kappa, float(horizon))
    return JointCertificate(design, *parts)


def search_jointly(
    model: Model, expected: Trajectory, domain: Bounds | None = None, *, u: Any = None
) -> JointCertificate:
    """Return the joint certificate with the least error of parameters in the long run; lambda is searched too.

    For windows like the expected one and w of nominal size, by (9) of paper 000: the sum of 4 lambda^(j-1) |w|^2_Q over
    1 - rho and over the window's level. Slow fading averages more noise, fast fading contracts more: rho < 1 by the
    window's own kappa (33). alpha is half the level of the expected window.

    Parameters
    ----------
    model : Model
        With constant parameters, for which a global design exists.
    expected : Trajectory
        Of the length of a window.
    domain, u
        As for `design_excitation`.

    Raises
    ------
    CertificateError
        If there is no design at any rate, none is global, or the window says nothing of some parameters.
    """
    length = float(expected.t[-1] - expected.t[0]) / (model.step or 1.0)
    found: dict[float, JointCertificate] = {}
    w = Units.of(model).w

    def error(mu: float) -> float:
        design = design_excitation(model, domain, u=u, mu=mu)
        information = ExcitationMonitor(design).along(expected)
        if information.level <= 1e-12 * information.directions[-1].level:
            raise CertificateError(f"search_jointly: the expected window says nothing of {information.directions[0]}")
        joint = certify_jointly(design, alpha=information.level / 2)
        rho = joint.check(expected).rho
        if rho >= 1:
            raise CertificateError(
                f"search_jointly: over the expected window U falls by {rho:.3g} at best; it is too short, or says too "
                f"little of {information.directions[0]}"
            )
        found[mu] = joint
        memory = 1 / (1 - mu) if design.discrete else -1 / np.log(mu)
        return float(np.trace(w @ joint.Q @ w)) * memory / (information.level * (1 - rho))

    best = best_factor(error, 1.1 * np.log(4) / length, 30 / length)
    return found[min(found, key=lambda mu: abs(mu - best))]


@dataclass(frozen=True, eq=False)
class JointBound:
    """lower |e(t)|^2 <= upper eta^t |e(0)|^2 + sum of eta^(j-1) ( |dw(t-j)|^2_Q + |dy(t-j)|^2_R ), with e = (dx, dp).

    Thesis (5.69).
    """

    lower: float
    upper: float
    eta: float
    Q: Array
    R: Array


def joint_bound(states: StateDetectability, excited: ExcitedSet, *, T: int) -> JointBound:
    """Return the i-IOSS bound of states and parameters, if all pairs over at least T steps are excited.

    Proposition 5.1, (a) to (b), up to the converse theorem that makes a Lyapunov function of it. Discrete time.
    """
    eta, sum_x = max(states.eta, excited.eta), 1 / (1 - states.eta) + 1
    c = sum_x * float(eigh(states.S, excited.S, eigvals_only=True)[-1])
    largest = [float(np.linalg.eigvalsh(part)[-1]) for part in (states.P_upper + c * excited.P, states.S)]
    lower = min(float(np.linalg.eigvalsh(part)[0]) for part in (states.P_lower, states.S))
    upper = max(largest[0], largest[1] * eta ** (1 - T) * sum_x)
    return JointBound(lower, upper, eta, frozen(states.Q + c * excited.Q), frozen(states.R + c * excited.R))


def uniform_excitation(bound: JointBound, *, states: int, parameters: int) -> tuple[int, ExcitedSet]:
    """Return T, and the matrices of E_K for all K >= T, that a bound on states and parameters implies.

    Proposition 5.1, (b) to (a): joint detectability is uniform excitation. T is twice the shortest possible.
    """
    T = 2 * max(int(np.ceil(np.log(bound.lower / bound.upper) / np.log(bound.eta))), 1)
    left = bound.lower - bound.upper * bound.eta**T
    S, P = left * np.eye(parameters), bound.upper * np.eye(states)
    return T, ExcitedSet(frozen(S), frozen(P), bound.Q, bound.R, bound.eta)


def young_weights(design: ExcitationDesign, *, eps1: float, eps2: float, a: float) -> tuple[float, Array, Array]:
    """Return lambda, Q, R that the proofs give for P and L of the design and numbers of one's choice.

    Theorem 10 of paper 000 (31)-(32), in which (7.55)-(7.57) of the thesis are eps1 = eps, eps2 = 2, a = gamma; for U,
    or W, whose S counts a times. With the mean values of `Increments.between`, so with 2 for 3 in front and without H,
    and with lambda_max(C'C, P) for |C|^2 / lambda_min(P). For comparison: the design does without them.
    """
    units, points = Units.of(design.model), design.increments.cover("ABCD").jacobians
    L = design.injection(points.A)
    seen = max(float(eigh(C.T @ C, design.P, eigvals_only=True)[-1]) for C in points.C)
    front, rest = (2 * (1 + eps1) / eps1, 2 * a * (1 + eps2) / eps2)
    push = points.B + L @ points.D
    Q = front * push.transpose(0, 2, 1) @ design.P @ push + rest * points.D.transpose(0, 2, 1) @ points.D
    R = front * L.transpose(0, 2, 1) @ design.P @ L + rest * np.eye(len(design.R))
    Q, R = least_upper_bound(Q, units.w), least_upper_bound(R, units.y)
    return (1 + eps1) * design.eta + a * (1 + eps2) * seen, Q, R
