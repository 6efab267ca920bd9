"""Bounds of joint estimates from window to window: thesis Lemmas 5.1 and 5.2, which make (5.42); paper 000 (9).

Along a window of N steps, with the differences d between the estimated and the true trajectory, Assumption 5.1 and
Definition 5.1 say ::

    U(N)     <= eta_x^N |dx(0)|^2_P_upper + sum of eta_x^(N-1-j) ( |dp|^2_S_x + |dw|^2_Q_x + |dy|^2_R_x )
    |dp|^2_S <= eta_p^N |dx(0)|^2_P_p     + sum of eta_p^(N-1-j) ( |dw|^2_Q_p + |dy|^2_R_p )     where excited

The right sides hold dx(0) = (x*(0) - x_bar) + (x_bar - x(0)) and dw = w* - w, whose first parts are known when the
window is solved and whose second ones are bounded, by what the window that gave x_bar said and by the largest
disturbance. So they bound the error of any trajectory of the model, whatever cost it came from: the *level*. The lemmas
bound the known parts too, by what the truth would cost: the *theorem*, which needs the weights of (5.9) to be those of
Assumption 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ctmhe.certificates.certificate import largest_ratio
from ctmhe.certificates.excited_set import ExcitedSet
from ctmhe.certificates.guarantee import largest_square
from ctmhe.certificates.joint import JointCertificate
from ctmhe.certificates.joint_horizons import JointConditions, joint_conditions
from ctmhe.certificates.weights import JointWeights, StateDetectability
from ctmhe.types import Array


@dataclass(frozen=True, eq=False)
class JointGuarantee:
    """What joint estimation needs beside data to say how wrong it can be: `ExcitedPrior(guarantee=)`.

    Parameters
    ----------
    states : StateDetectability
        As given to `joint_weights`.
    excited : ExcitedSet
        Of the prior's own alpha: `design.excited_set(alpha)`.
    weights : JointWeights
        Of the cost.
    disturbance : scalar, array (nw,) or mapping name -> value
        Largest |w_i| that there can be, measurement noise included, in the model's units.
    error : mapping name -> value, optional
        Largest initial errors of states and parameters; what the domain leaves for those left out.
    """

    states: StateDetectability
    excited: ExcitedSet
    weights: JointWeights
    disturbance: Any
    error: Any = None


@dataclass(frozen=True, eq=False)
class Evidence:
    """A solved window against its data: what is known of how far it is from the truth.

    Attributes
    ----------
    x : array (nx,), p : array (np,)
        x*(0) - x_bar and p* - p_bar.
    w : array (N, nw), y : array (N, ny)
        w* and y* - y.
    growing : bool
        The window starts at t0.
    level : float
        Of its information.
    """

    x: Array
    p: Array
    w: Array
    y: Array
    growing: bool
    level: float


@dataclass(frozen=True)
class Errors:
    """Bounds at one solve.

    Attributes
    ----------
    state : float
        Of U(x_hat(t), x(t)); before the first solve of |chi_hat - chi|^2_P_upper.
    prior : float
        Of |p_bar(t) - p|^2_S, S being that of the excited set.
    told : float
        Of |p_hat(t) - p|^2_S for the parameters that the estimate tells.
    """

    state: float
    prior: float
    told: float


@dataclass(frozen=True, eq=False)
class JointBounds:
    """Level and theorem from one window to the next, for windows of N steps.

    Parameters
    ----------
    guarantee : JointGuarantee
    horizon : int
        N.
    alpha : float
        Level of information from which a window counts as excited.
    sizes : array (nw,)
        Largest |w|.
    cap_x, cap_p : float
        What the domain makes of |dx|^2_P_upper and |dp|^2_S at most.
    """

    guarantee: JointGuarantee
    horizon: int
    alpha: float
    sizes: Array
    cap_x: float
    cap_p: float

    @cached_property
    def states(self) -> StateDetectability:
        """U as scaled for the weights."""
        return self.guarantee.states.scaled(self.guarantee.weights.scale)

    @cached_property
    def conditions(self) -> JointConditions:
        """(5.38)-(5.40) at this horizon."""
        weights, excited = self.guarantee.weights, self.guarantee.excited
        return joint_conditions(weights, self.states, excited, horizon=self.horizon)

    @cached_property
    def _ratios(self) -> dict[str, float]:
        weights, states, excited = self.guarantee.weights, self.states, self.guarantee.excited
        pairs = {
            "P P_lower": (states.P_upper, states.P_lower), "P_p P_lower": (excited.P, states.P_lower),
            "P_p P": (excited.P, states.P_upper), "S_x S": (states.S, excited.S), "S_x V": (states.S, weights.V / 2),
            "V S": (weights.V, excited.S), "S V": (excited.S, weights.V), "W P_lower": (weights.W, states.P_lower),
            "W P": (weights.W, states.P_upper),
        }  # fmt: skip
        return {name: largest_ratio(*pair) for name, pair in pairs.items()}

    @cached_property
    def _supplies(self) -> dict[str, float]:
        weights = {"x": self.states.Q, "p": self.guarantee.excited.Q, "cost": self.guarantee.weights.Q}
        return {name: largest_square(Q, self.sizes) for name, Q in weights.items()}

    def level(self, before: Errors, told: float, found: Evidence) -> Errors:
        """Return the bounds after a window from what it found; `before` at its start, `told` before the solve."""
        states, excited, n, ratios = self.states, self.guarantee.excited, len(found.w), self._ratios
        ratio = 1.0 if found.growing else ratios["P P_lower"]
        start = (square(states.P_upper, found.x) ** 0.5 + (ratio * before.state) ** 0.5) ** 2
        parameters = (square(excited.S, found.p) ** 0.5 + before.prior**0.5) ** 2
        if found.level >= self.alpha:  # E_T is in proportion to the level
            ratio = ratios["P_p P" if found.growing else "P_p P_lower"]
            shown = (square(excited.P, found.x) ** 0.5 + (ratio * before.state) ** 0.5) ** 2
            seen = excited.eta**n * shown + self._supplied("p", excited, found)
            parameters = min(parameters, self.alpha / found.level * seen)
        parameters = min(parameters, self.cap_p)
        pushed = ratios["S_x S"] * (1 - states.eta**n) / (1 - states.eta) * parameters
        end = states.eta**n * min(start, self.cap_x) + pushed
        end = min(end + self._supplied("x", states, found), self.cap_x)
        return self._concluded(before, told, end, parameters, found)

    def theorem(self, before: Errors, told: float, found: Evidence) -> Errors:
        """Return the bounds of Lemma 5.2 after an excited full window, of Lemma 5.1 after any other."""
        weights, states, ratios = self.guarantee.weights, self.states, self._ratios
        N, n = self.horizon, len(found.w)
        supply, prior = self._energy("cost", weights.eta_2, n), ratios["V S"] * before.prior
        if found.level >= self.alpha and n == N:
            met, summed = self.conditions, (1 - states.eta**N) / (1 - states.eta)
            c_2 = met.c * ratios["V S"] + ratios["S_x S"] * summed
            end = max(met.excited, met.prior) * (before.state + prior) + 2 * c_2 * supply
            parameters = ratios["S V"] * end / met.c
        else:
            c_1 = ratios["S_x V"] * (1 - states.eta**n) / (1 - states.eta) + 2
            ratio = ratios["W P" if found.growing else "W P_lower"]
            spread = (states.eta**n + weights.gamma(n)) * ratio * before.state
            end = weights.eta_1**-N * c_1 * (spread + 2 * weights.eta_1**n * prior + 2 * supply)
            parameters = ratios["S V"] * end
        return self._concluded(before, told, min(end, self.cap_x), min(parameters, self.cap_p), found)

    def most(self, before: Errors, found: Evidence) -> float:
        """Return what the truth can cost at most: the right side of (5.32)."""
        weights, ratios, n = self.guarantee.weights, self._ratios, len(found.w)
        ratio, prior = ratios["W P" if found.growing else "W P_lower"], ratios["V S"] * before.prior
        spread = weights.gamma(n) * ratio * before.state + weights.eta_1**n * prior
        return spread + self._energy("cost", weights.eta_2, n)

    def cost(self, found: Evidence) -> float:
        """Return the cost (5.9) of what was found."""
        weights, n = self.guarantee.weights, len(found.w)
        prior = weights.gamma(n) * square(weights.W, found.x) + weights.eta_1**n * square(weights.V, found.p)
        return prior + discounted(weights.Q, found.w, weights.eta_2) + discounted(weights.R, found.y, weights.eta_2)

    def _concluded(self, before: Errors, told: float, end: float, parameters: float, found: Evidence) -> Errors:
        excited = found.level >= self.alpha
        whole = excited and len(found.w) == self.horizon
        return Errors(end, parameters if whole else before.prior, parameters if excited else told)

    def _energy(self, name: str, eta: float, n: int) -> float:
        return self._supplies[name] * (1 - eta**n) / (1 - eta)

    def _supplied(self, name: str, part: StateDetectability | ExcitedSet, found: Evidence) -> float:
        """Return a bound of the discounted sum of |dw|^2_Q + |dy|^2_R."""
        known, unknown = discounted(part.Q, found.w, part.eta), self._energy(name, part.eta, len(found.w))
        return (known**0.5 + unknown**0.5) ** 2 + discounted(part.R, found.y, part.eta)


def joint_level(joint: JointCertificate, before: float, found: Evidence, sizes: Array) -> tuple[float, float, float]:
    """Return the level of U at the end of a window, (9) there, and the cost (7), for the scheme of paper 000.

    `before` bounds |(x_bar, p_bar) - (x, p)|^2_M_0. The level is from what was found; (9) from what the truth can cost.
    """
    n, eta = len(found.w), joint.eta
    prior = square(joint.M_0, np.concatenate([found.x, found.p]))
    push, energy = discounted(joint.Q, found.w, eta), largest_square(joint.Q, sizes) * (1 - eta**n) / (1 - eta)
    seen = discounted(joint.R, found.y, eta)
    level = eta**n * (prior**0.5 + before**0.5) ** 2 + (push**0.5 + energy**0.5) ** 2 + seen
    cost = 2 * eta**n * prior + 2 * push + seen
    return level, 4 * eta**n * before + 4 * energy, cost


def square(weight: Array, v: Array) -> float:
    """Return |v|^2 of one vector (n,)."""
    return float(v @ weight @ v) if len(v) else 0.0


def discounted(weight: Array, rows: Array, eta: float) -> float:
    """Return the sum of eta^(N-1-j) |v(j)|^2 over rows (N, n)."""
    fade = eta ** np.arange(len(rows) - 1.0, -1.0, -1.0)
    return float(fade @ ((rows @ weight) * rows).sum(axis=1))
