"""Horizons of joint estimation of states and parameters: (5.38)-(5.40) and (5.100) of the thesis. Discrete time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.certificates.certificate import largest_ratio
from ctmhe.certificates.excited_set import ExcitedSet
from ctmhe.certificates.weights import JointWeights, StateDetectability, unmet
from ctmhe.errors import CertificateError, InputError

LONGEST = 2**22
"""Steps beyond which no horizon is looked for."""


@dataclass(frozen=True)
class JointConditions:
    """What has to be below one for a horizon, with constant parameters (5.38)-(5.40) or varying ones (5.100).

    Attributes
    ----------
    horizon : int
    excited : float
        The left side of (5.38), or mu of (5.97) with c of (5.99): an excited window contracts states and parameters.
    prior : float
        That of (5.39); of mu, the part with the parameters' prior.
    bounded : float
        That of (5.40), or rho of (5.98): without excitation the states' error contracts. The first two have no value,
        infinity, where this one is not below one.
    c : float
        Of (5.37) or (5.99): how much the parameters count in the Lyapunov function.
    """

    horizon: int
    excited: float
    prior: float
    bounded: float
    c: float

    def __bool__(self) -> bool:
        return max(self.excited, self.prior, self.bounded) < 1

    @property
    def mu(self) -> float:
        """The contraction per step over an excited window (5.34); for varying parameters the root of (5.97)."""
        return max(self.excited, self.prior) ** (1 / self.horizon)


def joint_conditions(
    weights: JointWeights, states: StateDetectability, excited: ExcitedSet, *, horizon: int
) -> JointConditions:
    """Return the conditions for a horizon.

    Parameters
    ----------
    weights : JointWeights
        With eta_2 < 1 for constant parameters: Theorem 5.1. With eta_2 = 1 the cost is not discounted and parameters
        vary by p+ = p + B_p w: Theorem 5.2.
    states : StateDetectability
        As scaled for the weights: 2 P_upper is not above W.
    excited : ExcitedSet
        Of windows of this length.
    horizon : int
        N >= 1 steps.

    Raises
    ------
    InputError
        For weights that do not meet Assumption 5.2, (5.10)-(5.16).
    """
    if horizon != int(horizon) or horizon < 1:
        raise InputError(f"horizon: a whole number of steps, 1 or more, got {horizon!r}")
    _demand(weights, states, excited)
    parts = _left_sides(weights, states, excited, np.array([float(horizon)]))
    return JointConditions(int(horizon), *(float(part[0]) for part in parts))


def joint_horizon(weights: JointWeights, states: StateDetectability, excited: ExcitedSet) -> int:
    """Return N_min, from which on all conditions hold; arguments as for `joint_conditions`.

    Raises
    ------
    InputError
        As `joint_conditions`.
    CertificateError
        If N_min exceeds 4 million steps.
    """
    _demand(weights, states, excited)
    fade = max(weights.eta_x, weights.eta_p) / weights.eta_1
    constant = weights.eta_2 < 1
    high = 1 if constant else int(np.ceil(max(-1 / np.log(fade), -2 / np.log(weights.eta_1))))
    while max(part[0] for part in _left_sides(weights, states, excited, np.array([float(high)]), over=True)[:3]) >= 1:
        high *= 2  # `over`: bounds of the left sides that fall with N from here on
        if high > LONGEST:
            raise CertificateError(
                f"joint_horizon: the conditions hold for no horizon below {LONGEST} steps; try eta_1 nearer to 1, "
                "scale= of joint_weights smaller, or faster rates of states and excitation"
            )
    N = np.arange(1.0, high + 1)
    unmet_at = np.flatnonzero(np.max(_left_sides(weights, states, excited, N)[:3], axis=0) >= 1)
    return int(unmet_at[-1]) + 2 if len(unmet_at) else 1


def _demand(weights: JointWeights, states: StateDetectability, excited: ExcitedSet) -> None:
    found = [text for text in unmet(weights, states, excited) if weights.eta_2 < 1 or not text.startswith("(5.12)")]
    if found:
        raise InputError(
            f"the weights do not meet Assumption 5.2: {'; '.join(found)}. `joint_weights` makes some that do; states "
            "have to be scaled as they were for the weights (W = 2 P_upper)"
        )


def _left_sides(
    weights: JointWeights, states: StateDetectability, excited: ExcitedSet, N: Any, *, over: bool = False
) -> tuple[Any, ...]:
    """Return `excited`, `prior`, `bounded` and c at horizons N (k,); `over` leaves the 1 - eta_x^N of sums out."""
    if weights.eta_2 < 1:
        return _constant_parameters(weights, states, excited, N, over)
    return _varying_parameters(weights, states, excited, N, over)


def _constant_parameters(w: JointWeights, states: StateDetectability, excited: ExcitedSet, N: Any, over: bool) -> Any:
    summed = (1 - (0 if over else w.eta_x**N)) / (1 - w.eta_x)
    c_1 = largest_ratio(states.S, w.V / 2) * summed + 2  # V constant: V_lower = V / 2 in (5.14)
    prior = largest_ratio(w.W, states.P_lower)
    # (5.40) first: only where it holds has c of (5.37) a meaning
    bounded = c_1 * prior * _faded(w, N)
    rho = np.maximum(bounded, w.eta_2**N)
    c = np.where(rho < 1, 2 * c_1 / np.where(rho < 1, 1 - rho, 1.0) + 1, np.inf)
    c_2 = c * largest_ratio(w.V, excited.S) + largest_ratio(states.S, excited.S) * summed
    return 2 * prior * c_2 * w.gamma(N), c_2 * w.eta_1**N, bounded, c


def _varying_parameters(w: JointWeights, states: StateDetectability, excited: ExcitedSet, N: Any, over: bool) -> Any:
    V = w.V / 2  # of Assumption 5.4, both bounds: the cost (5.77) has twice it
    summed = (N + 1) * (1 - (0 if over else w.eta_x ** (N + 1))) / (1 - w.eta_x)
    share, prior = largest_ratio(states.S, V) / w.eta_x, largest_ratio(w.W / 2, states.P_lower)
    bounded = max(1.0, share) * summed * prior * 2 * _faded(w, N)
    below = bounded < 1
    c = np.where(below, 8 * max(1.0, share) * summed / np.where(below, 1 - bounded, 1.0) + 2, np.inf)
    front = np.maximum(c, share) * summed * max(1.0, largest_ratio(V, excited.S))
    return front * 4 * prior * w.gamma(N), front * 2 * w.eta_1**N, bounded, c


def _faded(w: JointWeights, N: Any) -> Any:
    """Return (eta_x^N + gamma(N)) / eta_1^N."""
    return 2 * (w.eta_x / w.eta_1) ** N + w.ratio * (w.eta_p / w.eta_1) ** N
