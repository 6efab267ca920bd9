"""The Luenberger observer: a copy of the model, driven by the output error through a constant gain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ctmhe.errors import InputError
from ctmhe.estimators.filters.filter import Basis, Recursion, Sample, Slot
from ctmhe.estimators.filters.filter_state import Belief
from ctmhe.models.continuous import Model
from ctmhe.transcription.integrators import is_symbolic
from ctmhe.types import Array, frozen


@dataclass(frozen=True, eq=False)
class Luenberger:
    """dx/dt = f(t, x, u, 0, p) + L (y - h(t, x, u, 0, p)); in steps x(k+1) = f + L (y(k) - h).

    In continuous time a sample holds until the sensor's next one, integrated by RK4; keep samples dense enough for the
    gain, the held error acts as a delay. In steps a sample acts once, a silent sensor not at all. No covariance: it is
    infinite, and policies that look at it fire at once.

    Parameters
    ----------
    gain : array (nx, ny)
        L, per second in continuous time.
    hold_limit : float
        Seconds for which a sample acts when its sensor falls silent; for good when left out. Continuous time only.
    """

    gain: Any
    hold_limit: float = np.inf

    def on(self, basis: Basis) -> Recursion:
        """Return the rule for a model."""
        try:
            gain = frozen(self.gain)
        except (TypeError, ValueError):
            raise InputError(f"Luenberger: the gain must be an array of numbers, got {self.gain!r}") from None
        gain = gain.reshape(-1, 1) if gain.ndim == 1 and len(basis.model.y) == 1 else gain
        shape = (len(basis.model.x), len(basis.model.y))
        if gain.shape != shape or not np.isfinite(gain).all():
            raise InputError(
                f"Luenberger: the gain must be a finite array of shape {shape} for {', '.join(basis.model.x.names)} "
                f"and {', '.join(basis.model.y.names)}, got shape {gain.shape}"
            )
        if basis.n > basis.stage.nx:
            raise InputError("Luenberger: parameters are not estimated; give P over the states only, or Extended()")
        return Observer(basis, gain, self.hold_limit)

    def __repr__(self) -> str:
        return f"Luenberger({np.asarray(self.gain).tolist()})"


class Observer:
    """Luenberger observer on one model. Its memory: what each sensor said last, and when."""

    def __init__(self, basis: Basis, gain: Array, hold_limit: float):
        self.basis, self.hold_limit = basis, hold_limit
        self.step = injection_step(basis.model, gain)

    def start(self, x: Array, p: Array) -> Belief:
        """Return the initial estimate, of unknown covariance."""
        ny = len(self.basis.model.y)
        memory = {"y": np.full(ny, np.nan), "since": np.full(ny, -np.inf)}
        return Belief(np.array(x), np.diag(np.full(len(x), np.inf)), memory)

    def renew(self, belief: Belief, t: float) -> Belief:
        """Return the belief as it is: no disturbance is modelled."""
        return belief

    def advance(self, belief: Belief, slot: Slot) -> Belief:
        """Return the observer's state at the end of a slot."""
        y, since = belief.memory["y"], belief.memory["since"]
        heard = np.isfinite(y) & (slot.t - since <= self.hold_limit)
        rows = (slot.t, slot.h, belief.z, slot.u0, slot.u1, slot.p, np.where(heard, y, 0.0), heard.astype(float))
        z = np.asarray(self.step(*rows)).reshape(-1)
        memory = belief.memory
        if self.basis.model.step is not None:
            memory = dict(memory) | {"y": np.full(len(y), np.nan)}
        return replace(belief, z=z, memory=memory)

    def correct(self, belief: Belief, sample: Sample) -> tuple[Belief, float]:
        """Return the observer that has heard a sample; it acts from now on."""
        said = np.isfinite(sample.y)
        y = np.where(said, sample.y, belief.memory["y"])
        since = np.where(said, sample.t, belief.memory["since"])
        return replace(belief, memory={"y": y, "since": since}), 0.0


def injection_step(model: Model, gain: Array) -> ca.Function:
    """Return one step (t, h, x, u0, u1, p, y, heard) -> x of the observer with y held, by RK4 or the step map."""
    kind: Any = ca.SX if is_symbolic(model) else ca.MX
    t, h, x, p = kind.sym("t"), kind.sym("h"), kind.sym("x", len(model.x)), kind.sym("p", len(model.p))
    u0, u1 = kind.sym("u0", len(model.u)), kind.sym("u1", len(model.u))
    y, heard = kind.sym("y", len(model.y)), kind.sym("heard", len(model.y))
    w = ca.DM.zeros(len(model.w))

    def rate(s: float, x: Any) -> Any:
        at = (t + s * h, x, u0 + s * (u1 - u0), w, p)
        return model.dynamics(*at) + ca.DM(gain) @ (heard * (y - model.output(*at)))

    symbols = [t, h, x, u0, u1, p, y, heard]
    if model.step is not None:
        return ca.Function("observer", symbols, [rate(0.0, x)])
    k1 = rate(0.0, x)
    k2 = rate(0.5, x + h / 2 * k1)
    k3 = rate(0.5, x + h / 2 * k2)
    k4 = rate(1.0, x + h * k3)
    return ca.Function("observer", symbols, [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
