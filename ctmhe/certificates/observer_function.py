"""An observer of constant gain and what is known of its error, as values; `observers.py` designs them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctmhe.certificates.certificate import largest_ratio
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Bounds, frozen


@dataclass(frozen=True, eq=False)
class ObserverFunction:
    """V_o of Assumption 4.2, an i-ISS Lyapunov function of an observer z against the state x.

    |z - x|^2_P_lower <= V_o <= |z - x|^2_P_upper (4.6a) and V_o+ <= eta V_o + |d|^2_Q + |v|^2_R (4.6b), where d are the
    disturbances that enter the dynamics and v those of the outputs; in continuous time dV_o/dt <= ln(eta) V_o + ...

    Parameters
    ----------
    P_lower, P_upper : array (nx, nx)
    Q : array (nd, nd), R : array (nv, nv)
    eta : float in (0, 1)
        Per step, or second.
    """

    P_lower: Array
    P_upper: Array
    Q: Array
    R: Array
    eta: float

    def __post_init__(self) -> None:
        for name in ("P_lower", "P_upper", "Q", "R"):
            matrix = np.atleast_2d(np.array(getattr(self, name), dtype=float))
            if len(matrix) and not (np.allclose(matrix, matrix.T) and np.linalg.eigvalsh(matrix)[0] > 0):
                raise InputError(f"ObserverFunction: {name} must be symmetric and positive definite, got {matrix}")
            object.__setattr__(self, name, frozen(matrix))
        if self.P_lower.shape != self.P_upper.shape or largest_ratio(self.P_lower, self.P_upper) > 1 + 1e-9:
            raise InputError(
                "ObserverFunction: P_lower must not exceed P_upper: they are bounds of one function (4.6a)"
            )
        if not 0 < self.eta < 1:
            raise InputError(f"ObserverFunction: eta must lie in (0, 1), got {self.eta}")

    @property
    def ratio(self) -> float:
        """lambda_max(P_upper, P_lower)."""
        return max(largest_ratio(self.P_upper, self.P_lower), 1.0)

    def scaled(self, factor: float) -> ObserverFunction:
        """Return the same for factor V_o."""
        parts = (factor * part for part in (self.P_lower, self.P_upper, self.Q, self.R))
        return ObserverFunction(*parts, eta=self.eta)


@dataclass(frozen=True, eq=False)
class LuenbergerObserver:
    """An observer of constant gain, and what is known of its error; made by `design_observer`.

    Attributes
    ----------
    model : Model
    K : array (nx, ny)
        In z+ = f(z, u, 0) + K (h(z, u, 0) - y) (4.71), or dz/dt.
    function : ObserverFunction
        V_o for z and x in `domain`.
    domain : Bounds
        O, the set of z and x; nothing keeps z in it (thesis 4.2.5 projects).
    method : str
        How it was covered, see `Cover`.
    rigorous : bool
        Whether that is a proof.
    margin : float
        Smallest eigenvalue of the inequality at fresh random pairs, points, vertices and on the cover, in nominal
        units.
    worst : mapping name -> float
        The point x, u, w, p of the fresh pair with the smallest one.
    process, noise : tuple of str
        Disturbances that enter the dynamics, d, and others, v: rows of `function.Q` and `function.R`.
    """

    model: Model = field(repr=False)
    K: Array
    function: ObserverFunction
    domain: Bounds
    method: str
    rigorous: bool
    margin: float
    worst: Mapping[str, float]
    process: tuple[str, ...]
    noise: tuple[str, ...]

    @property
    def kappa(self) -> float:
        """|K|: by how much at most the correction answers an output error (Assumption 4.7)."""
        return float(np.linalg.norm(self.K, 2))

    def advance(self, z: Any, *, y: Any, u: Any = (), p: Any = None, t: float = 0.0) -> Array:
        """Return z one step later, or dz/dt in continuous time.

        Parameters
        ----------
        z : array (nx,), y : array (ny,), u : array (nu,)
            Of time t.
        p : array (np,), optional
            The model's start values when left out.
        """
        point = (t, z, u, np.zeros(len(self.model.w)), self.model.p_start if p is None else p)
        ahead, output = (np.asarray(part(*point)).ravel() for part in (self.model.dynamics, self.model.output))
        return ahead + self.K @ (output - np.asarray(y, dtype=float).ravel())
