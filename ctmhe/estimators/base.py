"""What a run needs of an estimator: the verbs that `MHE` and the filters share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ctmhe.errors import InputError
from ctmhe.models.continuous import Model
from ctmhe.types import Array, Estimate, Input, Measurement


class EstimatorState(Protocol):
    """What can be read from the state of any estimator: the last estimate."""

    @property
    def t(self) -> float:
        """Time of the last estimate, seconds."""
        ...

    @property
    def x(self) -> Array:
        """State estimate (nx,) at `t`."""
        ...

    @property
    def p(self) -> Array:
        """Parameter estimate (np,), or the known values."""
        ...


class Estimator(Protocol):
    """An estimator on explicit state: immutable configuration; each verb returns a new state and leaves the old one.

    `simulate` and `replay` take anything of this kind. A state is an immutable value with at least the fields of
    `EstimatorState`; only the estimator that made it looks further into it.

    Attributes
    ----------
    model : Model
    horizon : float
        Seconds of data that an estimate uses; infinite for recursive filters. A trigger's longest wait must be shorter.
    interval : float
        Seconds: covariances are carried from multiples of it to the next.
    hold : mapping output -> str
        How samples enter: see `MHE`. A recursive filter takes each at its own time, `point`.
    p_estimated : bool
        Covariances are of (x, p), else of x.
    input_linear : bool
        An input that becomes known changes what was predicted before it.
    """

    @property
    def model(self) -> Model:
        """The model."""
        ...

    @property
    def horizon(self) -> float:
        """Seconds of data that an estimate uses."""
        ...

    @property
    def interval(self) -> float:
        """Seconds from one edge to the next."""
        ...

    @property
    def hold(self) -> Mapping[str, str]:
        """How samples enter."""
        ...

    @property
    def p_estimated(self) -> bool:
        """Whether parameters are estimated."""
        ...

    @property
    def input_linear(self) -> bool:
        """Whether inputs are interpolated between their samples."""
        ...

    def init(self, *, t: float = 0.0, x: Any, p: Any = None) -> Any:
        """Return the state at the start of estimation."""
        ...

    def control(self, state: Any, value: Input) -> Any:
        """Return the state that also knows the input from `value.t` on."""
        ...

    def observe(self, state: Any, measurement: Measurement) -> Any:
        """Return the state that also knows `measurement`; raise `TooLate` where it can no longer be used."""
        ...

    def estimate(self, state: Any, t: float) -> tuple[Any, Estimate]:
        """Return the state after the estimate at `t`, and the estimate."""
        ...

    def carry(self, state: Any, t0: float, t1: float, x: Array, p: Array) -> tuple[Array, Array]:
        """Return state and output at `t1` along the open loop from `x`, `p` at `t0`."""
        ...

    def prior_covariance(self, t: float = 0.0) -> Array:
        """Return the covariance (n, n) before the first measurement."""
        ...

    def propagate_covariance(self, state: Any, t0: float, t1: float, x: Array, p: Array, covariance: Array) -> Array:
        """Return the covariance (n, n) at `t1` along the open loop from `x`, `p` and `covariance` at `t0`."""
        ...

    def trajectory(self, state: Any, t: float) -> Array:
        """Return x_hat(t) (nx,) for a past `t` that the last estimate is the first to cover."""
        ...


def check_wait(horizon: float, wait: float) -> None:
    """Raise `InputError` unless a declared longest wait between estimates is shorter than the horizon (3.19)."""
    if not wait < horizon:
        raise InputError(
            f"the declared longest wait of {wait:g} s is not shorter than the horizon of {horizon:g} s: the prior at "
            "the window's edge would not be estimated yet (thesis 3.19). Lengthen the horizon or bound the wait, "
            "for example with | MaxInterval(...)"
        )
