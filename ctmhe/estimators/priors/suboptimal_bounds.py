"""How wrong a suboptimal estimate can be: the observer's V_o carried to the window, and from there U (4.41)."""

from __future__ import annotations

from functools import cached_property
from hashlib import sha256
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ctmhe.certificates.certificate import largest_ratio
from ctmhe.certificates.guarantee import WindowStart, largest_square
from ctmhe.certificates.observer_function import LuenbergerObserver
from ctmhe.certificates.suboptimal_horizons import Lipschitz, cost_factor
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model, box_arrays
from ctmhe.types import Array, ErrorBound

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.priors.suboptimal import Simulated


class Bounded(NamedTuple):
    """Bounds of V_o between the observer and the truth: from costs that were found, and by theorem (4.35)."""

    found: float
    theorem: float


UNKNOWN = Bounded(np.inf, np.inf)


class SuboptimalBounds:
    """What an observer's certificate makes of one estimator's windows.

    With V_o <= |z - x|^2_P_o at the window's start, carried there by (4.20), the prior's error is at most
    (sqrt(r V_o) + |eps|)^2 in the norm of P_s, where r = lambda_max(P_s, P_o) and eps is the projection error. So, for
    every trajectory of the model, (4.41) holds with the cost that was found. By theorem, the cost of the candidate is
    bounded too: (4.35), (4.62) with the constants of `cost_factor`.

    Attributes
    ----------
    unmet : tuple of str
        Why there is no bound.
    """

    def __init__(self, observer: Any, mhe: MHE, *, kind: str, horizon: float):
        self.kind, self.horizon = kind, horizon
        self.unmet: tuple[str, ...] = ()
        self._sigmas: dict[tuple[int, bool], float] = {}
        self.key = 0.0  # tells these bounds from others
        self.observer = observer if isinstance(observer, LuenbergerObserver) else None
        if mhe.guaranteed is None:
            self.unmet = ("no guarantee was asked for",)
        elif mhe.fed:
            self.unmet = ("trajectories of the observer: see (4.95) and trajectory_horizon",)
        elif self.observer is None:
            self.unmet = ("the auxiliary observer is a gain without certificate: see design_observer",)
        else:
            self.unmet = self._against(self.observer, mhe)
        if self.unmet or mhe.guaranteed is None or self.observer is None:
            return
        model, U = mhe.model, mhe.guaranteed.bounds.certificate
        watching = self.observer
        factor = max(largest_ratio(U.P_upper, watching.function.P_lower) * (1 + 1e-12), 1.0)
        V = watching.function.scaled(factor)  # Assumption 4.4: without loss of generality
        self.function, self.system, self.energy = V, U, mhe.guaranteed.bounds.energy
        sizes = mhe.guaranteed.sizes
        places = [model.w.index(name) for name in (*self.observer.process, *self.observer.noise)]
        self.supply = largest_square(_beside(V.Q, V.R), np.asarray(sizes)[places])
        self.to_system = largest_ratio(U.P_upper, V.P_lower)
        self.to_observer = largest_ratio(V.P_upper, U.P_lower)
        self.unit = model.step or 1.0
        self.lower, self.upper = box_arrays(model.x, self.observer.domain.x, "the observer's domain")
        self.widest = largest_square(V.P_upper, self.upper - self.lower)
        self.x_names = model.x.names
        self.process = [model.w.index(name) for name in self.observer.process]
        self.discount, self.filtering = float(mhe.cost.eta or 1.0), mhe.assembly.filtering
        self.cap = mhe.guaranteed.bounds.cap
        self.without_theorem = self._theorem_unmet(mhe)
        first = mhe.guaranteed.bounds
        told = (V.P_upper, V.Q, V.R, U.P_lower, U.P_upper, U.Q, np.array([V.eta, U.eta, self.supply]), watching.K)
        told = (*told, np.array([first.supply, *first.stated]), self.lower, self.upper)
        digest = sha256(np.concatenate([np.ravel(part) for part in told]).tobytes()).digest()
        self.key = float(int.from_bytes(digest[:6], "big"))

    def _against(self, observer: LuenbergerObserver, mhe: MHE) -> tuple[str, ...]:
        """Return why the observer's certificate is not about this estimator."""
        found, model = [], mhe.model
        if observer.model.x.names != model.x.names or observer.model.w.names != model.w.names:
            found.append(f"the auxiliary observer is one of {observer.model.name!r}")
            return tuple(found)
        if (observer.model.step or 0.0) != (model.step or 0.0):
            found.append("the auxiliary observer lives in another time than the model")
        if not _same(observer.model, model):
            found.append(f"the auxiliary observer is one of {observer.model.name!r}, whose functions are others")
        if observer.margin < 0:
            found.append(f"the auxiliary observer's V_o fails by {-observer.margin:.2g}: no certificate")
        assert mhe.guaranteed is not None
        lower, upper = box_arrays(model.x, observer.domain.x, "the observer's domain")
        own = mhe.assembly.boxes["x"]
        out = [n for n, a, b, c, d in zip(model.x.names, *own, lower, upper, strict=True) if a < c or b > d]
        if out:
            found.append(f"{', '.join(out)} may leave the observer's domain: give the MHE bounds that keep to it")
        low, high = box_arrays(model.w, observer.domain.w, "the observer's domain of w")
        sizes = mhe.guaranteed.sizes
        big = [n for n, s, a, b in zip(model.w.names, sizes, low, high, strict=True) if s > b or -s < a]
        if big:
            found.append(f"disturbances as large as stated leave the observer's domain: {', '.join(big)}")
        return tuple(found)

    def _theorem_unmet(self, mhe: MHE) -> tuple[str, ...]:
        """Return why Theorems 4.1-4.4 say nothing, at any time."""
        rest = "; the bound rests on the cost that was found"
        if mhe.model.step is None:
            return (f"Theorems 4.1-4.4 are in discrete time{rest}",)
        if self.filtering:
            return (f"Theorems 4.1-4.4 are evaluated for the prediction form{rest}",)
        if not np.isfinite(mhe.horizon):
            return (f"Corollary 4.1, for a window without end, is not evaluated{rest}",)
        if self.kind == "observer" and not additive(mhe.model, self.process):
            return (f"the disturbances are not f + d (Assumption 4.6), which the candidate needs{rest}",)
        try:
            growth = (2 + self._sigma(round(mhe.horizon / self.unit), False)) * self.to_observer
        except InputError as error:
            return (str(error),)
        steps = self.horizon / self.unit
        if np.isfinite(steps) and growth * self.function.eta**steps >= 1:
            needed = int(np.floor(np.log(growth) / -np.log(self.function.eta))) + 1
            return (f"(4.44) asks for an observer horizon of {needed * self.unit:g} s, it is {self.horizon:g} s{rest}",)
        return ()

    def _sigma(self, steps: int, projected: bool) -> float:
        """Return sigma_bar(N) of (4.31), (4.50) or (4.69)."""
        found = self._sigmas.get((steps, projected))
        if found is None:
            candidate: dict[str, Any] = {"L_f": self.lipschitz.f}
            if self.kind == "observer":
                Q_s = self.system.Q[np.ix_(self.process, self.process)]
                candidate = {"kappa": self.kappa, "Q_s": Q_s}
            options = {"horizon": steps, "L_h": self.lipschitz.h, "discount": self.discount, "projected": projected}
            found = self._sigmas[steps, projected] = cost_factor(self.function, self.system, **options, **candidate)
        return found

    @cached_property
    def lipschitz(self) -> Lipschitz:
        """L_f and L_h on the observer's domain."""
        assert self.observer is not None
        return Lipschitz.of(self.observer.model, self.observer.domain)

    @property
    def kappa(self) -> float:
        """Of Assumption 4.7."""
        assert self.observer is not None
        return self.observer.kappa

    def initial(self, mhe: MHE, x: Array) -> Bounded:
        """Return the bound of V_o at the start, from how wrong the initial estimate `x` (nx,) can be."""
        if self.unmet or mhe.guaranteed is None:
            return UNKNOWN
        level = largest_square(self.function.P_upper, mhe.guaranteed.first_error(x))
        return Bounded(level, level)

    def outside(self, x: Array) -> list[str]:
        """Return which states of the observer, z (m, nx), leave its domain."""
        out = np.any((x < self.lower) | (x > self.upper), axis=0).tolist()
        return [name for name, left in zip(self.x_names, out, strict=True) if left]

    def passed(self, bounded: Bounded, seconds: float, x: Array, lacking: tuple[str, ...]) -> Bounded:
        """Return bounds of V_o after a way x (m, nx) of the observer, none where it or its data were not as assumed."""
        if self.unmet or lacking or self.outside(x):
            return UNKNOWN
        return self.carried(self.capped(bounded), seconds)

    def capped(self, bounded: Bounded) -> Bounded:
        """Return bounds of V_o for an observer that is in its domain, as the truth is; the theorem's as it was."""
        return Bounded(min(bounded.found, self.widest), bounded.theorem)

    def carried(self, bounded: Bounded, seconds: float) -> Bounded:
        """Return bounds of V_o after so many seconds: (4.20), with the largest disturbances."""
        if self.unmet:
            return UNKNOWN
        eta, steps = self.function.eta, seconds / self.unit
        rate = 1 - eta if self.observer and self.observer.model.step else -np.log(eta)
        added = self.supply * (1 - eta**steps) / rate
        return Bounded(*(eta**steps * value + added for value in bounded))

    def elsewhere(self, p: Array) -> tuple[str, ...]:
        """Return which known parameters (np,) the observer's certificate is not about."""
        assert self.observer is not None
        model = self.observer.model
        lower, upper = box_arrays(model.p, self.observer.domain.p, "the observer's domain of p")
        out = [name for name, value, a, b in zip(model.p.names, p, lower, upper, strict=True) if not a <= value <= b]
        return (f"parameter {', '.join(out)} lies outside the observer's domain",) if out else ()

    def of(self, bound: ErrorBound | None, *, within: bool) -> Bounded:
        """Return bounds of V_o between an estimate and the truth, from those of U (4.43).

        The domain caps them for an estimate that lies `within` it.
        """
        if self.unmet or bound is None:
            return UNKNOWN
        level, theorem = (np.inf if part is None else self.to_observer * part for part in (bound.level, bound.theorem))
        return Bounded(min(level, self.to_observer * self.cap) if within else level, theorem)

    def window(
        self, observer: Simulated, times: Array, error: Array, lacking: tuple[str, ...], kept: bool
    ) -> WindowStart:
        """Return what is known of a window: the prior's error, and the theorem's bound of U at its end.

        Parameters
        ----------
        observer : Simulated
        times : array (N+1,)
            Nodes of the window.
        error : array (N+1, nx)
            Projection error eps (4.54).
        lacking : tuple of str
            What is missing of the data since the observer was initialised.
        kept : bool
            The candidate keeps to the bounds.
        """
        if self.unmet:
            return WindowStart(np.inf, None, self.unmet)
        reasons = list(lacking)
        every = np.vstack([observer.before, observer.x])
        if out := self.outside(every):
            reasons.append(f"the auxiliary observer leaves its domain: {', '.join(out)}")
        start, end = float(times[0]), float(times[-1])
        own = self.capped(observer.bounded)
        V = self.carried(own, start - observer.since) if not reasons else UNKNOWN
        first = np.sqrt(max(error[0] @ self.system.P_upper @ error[0], 0.0))
        prior = (np.sqrt(self.to_system * V.found) + first) ** 2
        reasons = reasons or list(self.without_theorem)
        if not kept:
            reasons.append("the candidate leaves the bounds")
        theorem = None if reasons else self._theorem(own, end - start, end - observer.since, error)
        if theorem is not None and not np.isfinite(theorem):
            theorem = None
            reasons = ["by theorem nothing bounds the error that the observer started from: give Guarantee(error=)"]
        factor = 1 / self.discount if self.filtering else 1.0  # the newest output counts fully there
        return WindowStart(float(prior), theorem, tuple(reasons), factor)

    def _theorem(self, first: Bounded, window: float, run: float, error: Array) -> float:
        """Return the right side of (4.35), or (4.62) where the observer was projected."""
        steps, U, V = round(window / self.unit), self.system, self.function
        projected = bool(error.any())
        sigma = self._sigma(steps, projected)
        end = self.carried(first, run).theorem
        found = (2 + sigma) * end * (2 if projected else 1) + 2 * self.energy(window)
        if not projected:
            return found
        squares = np.einsum("ki,ki->k", error, error)
        top = float(np.linalg.eigvalsh(U.P_upper)[-1])
        found += 4 * top * U.eta**steps * squares[0]
        if self.kind == "system":
            return found + 2 * sigma * V.eta**steps * squares[0]
        Q_s = U.Q[np.ix_(self.process, self.process)]
        largest = float(np.linalg.eigvalsh(Q_s)[-1])
        weight = 2 * sigma + 4 * largest * (self.lipschitz.f + self.kappa * self.lipschitz.h) ** 2
        weight *= max(1.0, (self.discount / V.eta) ** steps)
        return found + weight * float(np.sum(self.discount ** np.arange(steps) * squares[:steps][::-1]))


def additive(model: Model, process: list[int]) -> bool:
    """Return whether the disturbances at `process` enter as f + d, as far as three points of nominal size tell."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        x, u, w = (rng.uniform(0.1, 1, len(part)) * part.nominal for part in (model.x, model.u, model.w))
        still = np.array(w)
        still[process] = 0.0
        moved, plain = (np.asarray(model.dynamics(0.0, x, u, v, model.p_start)).ravel() for v in (w, still))
        if len(process) != len(model.x) or not np.allclose(moved - plain, w[process], rtol=1e-9, atol=1e-12):
            return False
    return True


def _same(one: Model, other: Model) -> bool:
    """Return whether two models with the same signals have the same functions, as far as three points tell."""
    if any(getattr(one, key).names != getattr(other, key).names for key in "xuwpy"):
        return False
    rng = np.random.default_rng(4)
    for _ in range(3):
        x, u, w = (rng.uniform(0.1, 1, len(part)) * part.nominal for part in (one.x, one.u, one.w))
        for name in ("dynamics", "output"):
            values = [np.asarray(getattr(model, name)(0.0, x, u, w, one.p_start)).ravel() for model in (one, other)]
            if not np.allclose(*values, rtol=1e-9, atol=1e-12, equal_nan=True):
                return False
    return True


def _beside(first: Array, second: Array) -> Array:
    """Return the block-diagonal matrix of two."""
    n = len(first)
    whole = np.zeros((n + len(second), n + len(second)))
    whole[:n, :n], whole[n:, n:] = first, second
    return whole
