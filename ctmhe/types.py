"""Values that pass between the rooms: measurements, inputs, bounds, weights, estimates and their status."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from ctypes import addressof, c_char
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from math import isfinite
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError

Array = np.ndarray[Any, Any]
Values = ArrayLike | Mapping[str, float]
T = TypeVar("T")


def frozen(values: Any) -> Array:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def address(array: Array) -> int:
    """Return where the memory of a writeable array begins: `array.ctypes.data`, at half the cost."""
    return addressof(c_char.from_buffer(array))  # pyright: ignore


def made(kind: type[T], fields: dict[str, Any]) -> T:
    """Return a value of a frozen dataclass from the dictionary of all its fields, which it takes over.

    Where an estimate is a matter of microseconds: `__init__` sets one field after the other, at twice the cost.
    """
    value = object.__new__(kind)
    object.__setattr__(value, "__dict__", fields)
    return value


def positive(what: str, value: Any, unit: str = "") -> float:
    """Return `value` as a positive finite float, or raise `InputError` naming `what`."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not (np.isfinite(number) and number > 0):
        raise InputError(f"{what} must be a positive number{f' of {unit}' if unit else ''}, got {value!r}")
    return number


def _vector(values: Any, what: str, t: float) -> Any:
    """Return values as a read-only vector, mappings unchanged; anything that is not numeric raises."""
    if not isinstance(values, (np.ndarray, list, tuple)) and isinstance(values, Mapping):  # the plain cases are quick
        return values
    try:
        if values is None:
            raise TypeError
        array = np.array(values, dtype=np.float64, ndmin=1)
        array.setflags(write=False)
        return array
    except (TypeError, ValueError):
        raise InputError(
            f"{what} at t = {t:g}: values must be numbers or a mapping from names to numbers, got {values!r}"
        ) from None


def finite_time(t: Any, what: str) -> float:
    """Return `t` as a float, or raise `InputError` when it is not a finite number of seconds."""
    try:
        value = float(t)
    except (TypeError, ValueError):
        raise InputError(f"{what}: time must be a number of seconds, got {t!r}") from None
    if not isfinite(value):
        raise InputError(f"{what}: time must be finite, got {value}")
    return value


@dataclass(frozen=True, eq=False)
class Measurement:
    """What the sensors said at one instant.

    Parameters
    ----------
    t : float
        Time in seconds.
    y : array (ny,) or mapping name -> value
        Outputs in the model's units and order. NaN, or a name left out of the mapping, means that the sensor
        has nothing to say at `t`.
    """

    t: float
    y: Values

    def __post_init__(self) -> None:
        if type(self.t) is not float or not isfinite(self.t):
            object.__setattr__(self, "t", finite_time(self.t, "Measurement"))
        object.__setattr__(self, "y", _vector(self.y, "Measurement", self.t))


@dataclass(frozen=True, eq=False)
class Input:
    """The known input from time `t` on, held (or interpolated) until the next.

    Parameters
    ----------
    t : float
        Time in seconds.
    u : array (nu,) or mapping name -> value
        Inputs in the model's units and order, all of them.
    """

    t: float
    u: Values

    def __post_init__(self) -> None:
        if type(self.t) is not float or not isfinite(self.t):
            object.__setattr__(self, "t", finite_time(self.t, "Input"))
        object.__setattr__(self, "u", _vector(self.u, "Input", self.t))


Box = tuple[ArrayLike, ArrayLike] | Mapping[str, tuple[float, float]] | None


@dataclass(frozen=True, eq=False)
class Bounds:
    """Boxes that the estimate respects, one per kind of signal.

    Each is `(lower, upper)` with scalars or arrays, or a mapping from a signal's name to its pair; signals not named
    are free. `residual` bounds the output residual `y - y_hat` where a measurement is known.

    Parameters
    ----------
    x, w, p, y, residual : (lower, upper) or mapping, optional
        In the model's units. Thesis (3.12d)-(3.12e).
    """

    x: Box = None
    w: Box = None
    p: Box = None
    y: Box = None
    residual: Box = None


Weight = ArrayLike | Mapping[str, float] | Callable[[float], ArrayLike]


@dataclass(frozen=True, eq=False)
class DiscountedCost:
    """The cost prior + stage + terminal (thesis 3.13, discrete 3.6), each part with its own discount and weights.

    For a window [t - T, t] the estimator minimises::

        prior_eta^T |(x, p)(t-T) - prior|^2_P
        + integral of eta^(t - tau) ( |w(tau)|^2_Q + |y_hat(tau) - y(tau)|^2_R ) dtau
        + sum over point samples of eta^(t - t_j) |y_hat(t_j) - y_j|^2_R_point
        + |y_hat(t) - y(t)|^2_S

    with |v|^2_A = v' A v. For a `DiscreteModel` the integral is the sum over steps with eta^(N-j-1) and `eta` is per
    step. The thesis' theory uses 2P, 2Q, R with the undoubled matrices in its bounds; nothing is doubled here.

    Parameters
    ----------
    P : weight of the prior
        Scalar, diagonal (n,), or matrix (n, n). With n = nx the parameters are known and held; with n = nx + np they
        are estimated, cross terms included. A callable `P(t_start, T)` gives a matrix for the window. P = 0 is allowed.
    Q : weight of the disturbance w
        Scalar, diagonal (nw,), matrix (nw, nw), mapping name -> weight, or a callable of time returning one of these.
        Empty for a model without w.
    R : weight of the output error, per second for held signals
        As Q, with ny.
    eta : float in (0, 1]
        Discount of the stage, per second (per step for a `DiscreteModel`).
    rate : float >= 0, optional
        kappa = -ln eta, instead of `eta`.
    prior_eta : float in (0, 1], optional
        Discount of the prior over the window's length; `eta` when left out, 1 for an undiscounted prior (4.12), (6.62).
    R_point : weight of sporadic samples (`hold="point"`), optional
        Inverse covariance of one sample; R when left out.
    S : weight of the terminal output error, optional
        (6.7); none when left out.
    """

    P: Any = 1.0
    Q: Weight = 1.0
    R: Weight = 1.0
    eta: float | None = None
    rate: float | None = None
    prior_eta: float | None = None
    R_point: Weight | None = None
    S: Weight | None = None

    def __post_init__(self) -> None:
        if self.eta is not None and self.rate is not None:
            raise InputError("DiscountedCost: give eta or rate (kappa = -ln eta), not both")
        for name in ("eta", "rate", "prior_eta"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, (int, float, np.floating)) and not isinstance(value, bool)):
                raise InputError(f"DiscountedCost: {name} must be a number, got {value!r}")
        if self.rate is not None:
            if not (np.isfinite(self.rate) and self.rate >= 0):
                raise InputError(f"DiscountedCost: rate must be finite and >= 0 per second, got {self.rate}")
            object.__setattr__(self, "eta", float(np.exp(-self.rate)))
        eta = 1.0 if self.eta is None else self.eta
        prior_eta = eta if self.prior_eta is None else self.prior_eta
        for name, value in (("eta", eta), ("prior_eta", prior_eta)):
            if not (np.isfinite(value) and 0 < value <= 1):
                raise InputError(
                    f"DiscountedCost: {name} must lie in (0, 1], got {value}; it is the factor by which weights "
                    "fade per second, 1 for none"
                )
        object.__setattr__(self, "eta", float(eta))
        object.__setattr__(self, "prior_eta", float(prior_eta))
        object.__setattr__(self, "rate", float(-np.log(eta)))

    @classmethod
    def from_certificate(cls, certificate: Certified) -> DiscountedCost:
        """Return the cost 2 P_upper, 2 Q, R, eta with which the certificate's guarantee holds (thesis 3.2.2)."""
        return cls(P=2 * certificate.P_upper, Q=2 * certificate.Q, R=certificate.R, eta=certificate.eta)


class Certified(Protocol):
    """The matrices and the discount of a `DetectabilityCertificate`."""

    @property
    def P_upper(self) -> Array:
        """Upper bound of U (nx, nx)."""
        ...

    @property
    def Q(self) -> Array:
        """Weight of disturbances (nw, nw)."""
        ...

    @property
    def R(self) -> Array:
        """Weight of outputs (ny, ny)."""
        ...

    @property
    def eta(self) -> float:
        """Discount per second, or step."""
        ...


class Outcome(Enum):
    """How an estimate came about; the value says what to do about it."""

    SOLVED = "solved"
    FALLBACK = "solved by the reference solver"
    ITERATION_LIMIT = "stopped at the iteration limit: the best iterate so far; raise max_iterations"
    DEADLINE = "stopped at the deadline: the best iterate so far; allow more seconds or shorten the window"
    RELAXED = "bounds had to be relaxed; the violation is reported: check the bounds against the data"
    PREDICTED = "no solver succeeded: open-loop prediction; check model, bounds and data"


@dataclass(frozen=True)
class Status:
    """What the solvers report about one estimate.

    Attributes
    ----------
    outcome : Outcome
    success : bool
        The optimality conditions hold to tolerance.
    iterations : int
        Gauss-Newton (or reference solver) iterations of the rung that ended.
    optimality : float
        Scaled stationarity residual, relative to the size of the gradient's terms.
    feasibility : float
        Largest violation of dynamics and bounds, scaled by the signals' nominals.
    violation : float
        Largest violation of a bound in the returned estimate, scaled; 0 unless relaxed.
    rungs : tuple of str
        The failure ladder as far as it was climbed, each with its reason.
    notes : tuple of str
        Facts about the window: `no measurement in window`, `prior predicted, uncertified`.
    factorizations : int
        Of the rung that ended.
    """

    outcome: Outcome
    success: bool
    iterations: int = 0
    optimality: float = float("nan")
    feasibility: float = float("nan")
    violation: float = 0.0
    rungs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    factorizations: int = 0

    def __str__(self) -> str:
        return "; ".join((self.outcome.value, *self.rungs, *self.notes))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The solution over one window: nodes and, between them, slots on which everything is smooth.

    Attributes
    ----------
    t : array (N+1,)
        Node times in seconds; slot k spans [t[k], t[k+1]].
    x : array (N+1, nx)
        States at the nodes.
    w : array (N, nw)
        Disturbance on each slot (equal on slots of one cell).
    y : array (N, ny)
        Estimated outputs at the end of each slot (at its start for a `DiscreteModel`).
    u0, u1 : array (N, nu)
        Known input at the start and the end of each slot, linear in between.
    p : array (np,)
        Parameters.
    """

    t: Array
    x: Array
    w: Array
    y: Array
    u0: Array
    u1: Array
    p: Array


class SolvedWindow(Protocol):
    """What an estimate keeps of its window."""

    @property
    def trajectory(self) -> Trajectory:
        """The solution."""
        ...

    def part(self, name: str) -> Array:
        """Return one array of the solution or the problem, such as the prior."""
        ...


@dataclass(frozen=True, eq=False)
class ErrorBound:
    """What is guaranteed of an estimate's error, in the norm of the certificate's P_lower.

    Attributes
    ----------
    level : float or None
        Bound of U(x_hat, x) from this window and the ones before it: (3.20) with the cost that was found (3.25).
    theorem : float or None
        Bound of U(x_hat, x) by Theorem 3.1 (3.32).
    reasons : tuple of str
        Why there is no bound, or none by the theorem.
    P_lower : array (nx, nx)
    cap : float
        Bound of U between any two states of the domain; a bound that is not smaller says nothing.
    own : array, optional
        Bounds of single errors, where better ones are known than what the norm implies.
    """

    level: float | None
    theorem: float | None
    reasons: tuple[str, ...]
    P_lower: Array
    cap: float = float("inf")
    own: Array | None = None

    @property
    def size(self) -> float | None:
        """Bound of |x_hat - x|_P_lower, the better of both."""
        known = [level for level in (self.level, self.theorem) if level is not None]
        return float(np.sqrt(min(known))) if known else None

    @property
    def certified(self) -> bool:
        """Whether Theorem 3.1 holds at this instant."""
        return self.theorem is not None

    @property
    def radii(self) -> Array | None:
        """Bound of every |x_hat_i - x_i| (nx,), in the units of the states; in joint estimation then of parameters."""
        if self.size is None:
            return None
        implied = self.size * np.sqrt(np.diagonal(np.linalg.inv(self.P_lower)))
        return frozen(implied if self.own is None else np.minimum(implied, self.own))

    def __str__(self) -> str:
        if self.size is None:
            return f"no bound: {'; '.join(self.reasons)}"
        wide = ", as wide as the domain" if self.size**2 >= self.cap * (1 - 1e-9) else ""
        return f"|error|_P <= {self.size:.4g}{wide}" + "".join(f"; not by Theorem 3.1: {r}" for r in self.reasons)


@dataclass(frozen=True, eq=False)
class Delayed:
    """The estimate of a past instant, out of the solution of a later window (thesis 6.47).

    Attributes
    ----------
    t : float
        Time that it is of, seconds.
    x : array (nx,)
        State, model units.
    """

    t: float
    x: Array


@dataclass(frozen=True, eq=False)
class Estimate:
    """The result of one solve, at time `t`.

    Attributes
    ----------
    t : float
        Time in seconds.
    x : array (nx,)
        State estimate (3.15), model units.
    p : array (np,)
        Parameter estimate, or the known values.
    w : array (nw,)
        Disturbance estimate on the last cell.
    y : array (ny,)
        Estimated output at `t`.
    cost : float
        Value of the cost at the solution.
    status : Status
    seconds : float
        Wall-clock time of the call.
    bound : ErrorBound or None
        What is guaranteed of x; None for an estimator without a `Guarantee`.
    delayed : Delayed or None
        The estimate of t - delay from this window, for an estimator with a `delay` (6.47), (6.76); None without, and
        until the delay has passed. No bound is claimed for it.
    """

    t: float
    x: Array
    p: Array
    w: Array
    y: Array
    cost: float
    status: Status
    _solved: SolvedWindow = field(repr=False)
    seconds: float = field(compare=False, default=float("nan"))
    _covariance: Callable[[], tuple[Array, int]] | None = field(default=None, repr=False)
    bound: ErrorBound | None = field(default=None, repr=False)
    delayed: Delayed | None = field(default=None, repr=False)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The whole window."""
        return self._solved.trajectory

    @property
    def prior(self) -> Array:
        """The prior estimate (nx + np,) at the window's left edge."""
        return self._solved.part("prior")

    @property
    def active(self) -> dict[str, np.ndarray]:
        """Bounds active at the solution, -1 (lower), 0, +1 (upper): `x` (N+1, nx), `w` (N, nw), `y` (N, ny), `p`."""
        return {key: self._solved.part(f"{key}_active") for key in "xwyp"}

    @property
    def multipliers(self) -> dict[str, Array]:
        """Lagrange multipliers in scaled variables for the cost J / 2: `dynamics` (N, nx), and bounds as in `active`.

        Positive at upper bounds, negative at lower ones.
        """
        return {key: self._solved.part(f"{key}_multiplier") for key in ("dynamics", *"xwyp")}

    def __getstate__(self) -> dict[str, Any]:
        """Pickle the numbers; the covariance, which would need the window's functions, stays behind."""
        return self.__dict__ | {"_covariance": None}

    @cached_property
    def _covariance_and_rank(self) -> tuple[Array, int]:
        if self._covariance is None:
            raise InputError("Estimate.covariance: this estimate carries no window (it was loaded or predicted)")
        return self._covariance()

    @property
    def covariance(self) -> Array:
        """Covariance of (x(t), estimated p) (n, n): the inverse of half the reduced Gauss-Newton Hessian.

        Active bounds are ignored. It is a statistical covariance only for eta = 1 and inverse-covariance weights. Where
        the window says nothing about a direction, the variances of the signals that it touches are infinite.
        """
        return self._covariance_and_rank[0]

    @property
    def rank(self) -> int:
        """How many independent directions of (x(t), estimated p) the window determines."""
        return self._covariance_and_rank[1]


def names_of(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return signal names as a tuple; a single string counts as one name."""
    return (names,) if isinstance(names, str) else tuple(str(name) for name in names)
