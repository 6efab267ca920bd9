"""What a design for excitation monitoring is, and what it says; `excitation_design` derives and makes it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ctmhe.certificates.increments import Increments, Jacobians
from ctmhe.certificates.injection import Units, slack
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, frozen, positive


@dataclass(frozen=True, eq=False)
class ExcitedSet:
    """The matrices of E_T (Definitions 5.1 and 5.2): how output differences bound the parameters'.

    For every pair of trajectories over T whose information is at least the level it was made for::

        |dp|^2_S <= eta^T |dx(0)|^2_P + sum of eta^(T-1-j) ( |dw(j)|^2_Q + |dy(j)|^2_R )

    In continuous time the sum is an integral and eta a factor per second. With parameters that vary, dp is their
    difference at the start and the sum is not discounted (5.75).
    """

    S: Array
    P: Array
    Q: Array
    R: Array
    eta: float


@dataclass(frozen=True, eq=False)
class Drift:
    """W+ <= mu W + |dw|^2_Q + |dy|^2_R for parameters that vary, p+ = p + B_p w (7.73b) or dp/dt = B_p w.

    |v| is of parameters over their nominals.

    Attributes
    ----------
    B_p : array (np, nw)
    mu : float
        Contraction of W; information still fades with the design's own.
    Q, R : array
    Y : float
        |Y v|_P <= Y |v| along every pair: (7.78) with its best eps3.
    S : float
        |v|^2_S <= S |v|^2 (7.85).
    """

    B_p: Array
    mu: float
    Q: Array
    R: Array
    Y: float
    S: float


@dataclass(frozen=True, eq=False)
class ExcitationDesign:
    """An injection L(z1, z2) and weights with which excitation can be monitored; made by `design_excitation`.

    Attributes
    ----------
    increments : Increments
        Model and domain.
    P : array (nx, nx), Q : array (nw, nw), R : array (ny, ny)
        Of W and its inequality, in y's units squared.
    mu : float
        Factor per step, or second, by which W and old information fade.
    eta : float
        The smallest for which (7.41) holds with P on the domain; not above mu.
    L : array (nx, ny)
        Injection where the mean value of A is `A`.
    A : array (nx, nx) or None
        L(z1, z2) = L - (A(z1, z2) - A) C^+ where given (C^+ in nominal units); the injection is constant where None.
    C : array (ny, nx)
        At the centre of the domain; constant where `A` is given.
    Phi : array (nx, nx) or None
        Where it is constant.
    scope : str
        `global`: the information of one trajectory is that of every pair with it (Corollary 7.2); `local`: nearly that
        of pairs near it (Proposition 7.2).
    H : array (ny, ny) or None
        Of (7.68), if there is one, from samples. Nothing here rests on it: see `Increments.between`.
    method : str
        How the domain was covered, see `Cover`.
    rigorous : bool
        Whether that is a proof.
    margin : float
        Smallest eigenvalue of the inequality at fresh random pairs and on the cover, in nominal units, over tr R.
    worst : tuple of two arrays (nv,)
        The fresh pair (x, u, w, p) with the smallest one.
    drift : Drift or None
    notes : tuple of str
    """

    increments: Increments = field(repr=False)
    P: Array
    Q: Array
    R: Array
    mu: float
    eta: float
    L: Array
    A: Array | None
    C: Array
    Phi: Array | None
    scope: str
    H: Array | None
    method: str
    rigorous: bool
    margin: float
    worst: tuple[Array, Array]
    drift: Drift | None = None
    notes: tuple[str, ...] = ()

    @property
    def model(self) -> Model:
        """The model."""
        return self.increments.model

    @property
    def discrete(self) -> bool:
        """Whether it counts steps."""
        return self.model.step is not None

    def injection(self, A: Array) -> Array:
        """Return L (k, nx, ny) for Jacobians A (k, nx, nx)."""
        constant = np.broadcast_to(self.L, (len(A), *self.L.shape))
        return constant if self.A is None else constant - (A - self.A) @ Units.of(self.model).right_inverse(self.C)

    def recursion(self, jacobians: Jacobians) -> tuple[Array, Array, Array, Array]:
        """Return Phi, E + L F, C, F of (7.45) at k points or pairs."""
        A, _, E, C, _, F = jacobians
        L = self.injection(A)
        return A + L @ C, E + L @ F, C, F

    def slack(self, jacobians: Jacobians) -> Array:
        """Return by how much the inequality holds (k,), as in `margin`."""
        weights = (self.P, self.Q, self.R)
        return slack(Units.of(self.model), self.mu, weights, self.injection(jacobians.A), jacobians)

    def excited_set(self, alpha: float, *, horizon: float | None = None) -> ExcitedSet:
        """Return the matrices of E_T for pairs whose information C_T has at least the level alpha (7.44), (7.75).

        Parameters
        ----------
        alpha : float
            In y's units squared, of parameters over their nominals.
        horizon : float
            T, in steps or seconds; only where parameters vary, and always there. The thesis' matrices for that case do
            not depend on it, but the last step of its proof drops squares: |dp(0)|^2 <= 2 |dp(T)|^2 + 2 T sum of
            |B_p dw|^2.
        """
        alpha = positive("excited_set: alpha", alpha)
        S = alpha * np.linalg.inv(Units.of(self.model).p ** 2)
        drift = self.drift
        if drift is None:
            if horizon is not None:
                raise InputError("excited_set: with constant parameters the matrices do not depend on T; omit horizon")
            return ExcitedSet(frozen(S), self.P, self.Q, self.R, self.mu)
        T = positive("excited_set: horizon", horizon, "steps" if self.discrete else "seconds")
        Q = drift.Q + T * drift.B_p.T @ S @ drift.B_p
        return ExcitedSet(frozen(S / 2), self.P, frozen(Q), drift.R, drift.mu)

    def __str__(self) -> str:
        per = "step" if self.discrete else "second"
        rows = (
            f"Excitation of {self.model.name!r}: W fades by mu = {self.mu:.4g} per {per}; (7.41) with {self.eta:.4g}",
            f"  Phi {'constant' if self.Phi is not None else 'varies'}; from one trajectory: {self.scope}",
            f"  domain: {self.method}, {'proof' if self.rigorous else 'evidence'}; margin {self.margin:.2g}",
            *(f"  {note}" for note in self.notes),
        )
        return "\n".join(rows)
