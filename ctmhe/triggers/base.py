"""What a trigger policy is, and what it is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Any, Protocol

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array, Estimate


class Outlook(Protocol):
    """What is expected from the last estimate on: without disturbance, the last known input held.

    All times are absolute, in seconds, and not before the time of the context.
    """

    def state(self, t: float) -> Array:
        """Return the state predicted for `t`, (nx,)."""
        ...

    def output(self, t: float) -> Array:
        """Return the output predicted for `t`, (ny,): h at the predicted state, without noise."""
        ...

    def covariance(self, t: float) -> Array:
        """Return the covariance predicted for `t` of (x, estimated p), (n, n); infinite where nothing is known.

        It is what `Estimate.covariance` would be at `t` if nothing were measured until then.
        """
        ...


@dataclass(frozen=True, eq=False)
class TriggerContext:
    """What a policy may know at time `t`: only what was measured and sent so far. All arrays are read-only.

    Attributes
    ----------
    t : float
        Time in seconds.
    y : array (ny,)
        Outputs at `t` in the model's units; NaN where a sensor has no value.
    y_last : array (ny,)
        Outputs as last sent; NaN before the first sample.
    elapsed : float
        Seconds since the last sample, or since the start of the run before the first one.
    samples : int
        Samples sent so far.
    outputs : tuple of str
        Names of the entries of `y`.
    states : tuple of str
        Names of the entries of `prediction`.
    parameters : tuple of str
        Names of the estimated parameters, which follow the states in covariances.
    estimate : Estimate or None
        The last estimate, None before the first. Where the channel loses, delays or alters what is sent, it is that of
        a copy of the estimator at the sensor, which knows what was sent.
    state : Any
        The policy's own memory, see `Trigger.init_state`.
    forecast : Outlook or None
        State, output and covariance predicted for `t` and later times; computed when asked.
    seed : int
        The seed of the run: policies that draw lots derive theirs from it, see `lots`.
    """

    t: float
    y: Array
    y_last: Array
    elapsed: float = 0.0
    samples: int = 0
    outputs: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    estimate: Estimate | None = None
    state: Any = None
    forecast: Outlook | None = None
    seed: int = 0

    @property
    def prediction(self) -> Array:
        """State predicted for `t`, (nx,): open loop from the last estimate with w = 0 and the last input held."""
        return self._outlook().state(self.t)

    @property
    def y_hat(self) -> Array:
        """Output predicted for `t`, (ny,): h at the prediction, without noise."""
        return self._outlook().output(self.t)

    @property
    def covariance(self) -> Array:
        """Covariance of the last estimate (n, n), at its own time; see `Estimate.covariance`. Computed when asked."""
        if self.estimate is None:
            raise InputError(
                "TriggerContext.covariance: there is no estimate before the first sample; test ctx.samples"
            )
        return self.estimate.covariance

    @property
    def predicted_covariance(self) -> Array:
        """Covariance of (x, estimated p) predicted for `t`, (n, n), that of the prior before the first sample."""
        return self._outlook().covariance(self.t)

    def lots(self, *key: int) -> np.random.Generator:
        """Return a generator that depends on the run's seed and `key` (integers >= 0) only, so that runs repeat."""
        return np.random.default_rng([self.seed, *key])

    def output_index(self, name: str) -> int:
        """Return the position of output `name` in `y`."""
        try:
            return self.outputs.index(name)
        except ValueError:
            raise InputError(f"unknown output {name!r}. Known: {', '.join(self.outputs) or 'none'}") from None

    def _outlook(self) -> Outlook:
        if self.forecast is None:
            raise InputError("TriggerContext: this context carries no prediction")
        return self.forecast


class Trigger:
    """A policy that says when to sample. Subclass it and write exactly one of `guard`, `next_time` and `fires`.

    - `guard(ctx) -> float`, a level: a sample is taken at the first time it is >= 0, located between monitoring times
      by root finding; where it jumps across zero, at the jump. +inf and -inf mean a certain yes and no.
    - `next_time(ctx) -> float`, self-triggered: asked at the start and after every sample; the absolute time of the
      next sample in seconds, inf for never.
    - `fires(ctx) -> bool`, asked at monitoring times only. `@trigger` makes such a policy from a function.

    A guard that is still >= 0 right after its own sample is asked again at the next monitoring time, so that no policy
    samples more often than the monitoring step by standing still. `a | b` fires when the first of both does, `a & b`
    when both agree; guards stay exactly located, times exact, and a yes from `fires` stands until the next monitoring
    time or sample. Inside `&`, a self-triggered policy agrees from its `next_time` on.

    Policies are immutable. What one has to remember lives in `ctx.state`, which `init_state` starts and `update` and
    `after_sample` replace, so that one policy can serve many runs.
    """

    def guard(self, ctx: TriggerContext) -> float:
        """Return the level; a sample is taken when it reaches zero from below."""
        raise NotImplementedError

    def next_time(self, ctx: TriggerContext) -> float:
        """Return the absolute time of the next sample, in seconds."""
        raise NotImplementedError

    def fires(self, ctx: TriggerContext) -> bool:
        """Return whether to sample now."""
        raise NotImplementedError

    def init_state(self) -> Any:
        """Return the memory at the start of a run; None when there is none.

        Memory is made immutable: arrays read-only, dicts mappings that cannot be changed, lists tuples.
        """
        return None

    def update(self, ctx: TriggerContext, fired: bool) -> Any:
        """Return the new memory. Called at every monitoring time and sample with the context before the sample.

        `ctx.state` is the old memory, which must not be changed in place. `fired` tells whether a sample is taken at
        `ctx.t`, by this or another policy.
        """
        return ctx.state

    def after_sample(self, ctx: TriggerContext) -> Any:
        """Return the new memory. Called after `update` at every sample, with the context that knows of the sample.

        For what depends on the new estimate or on the level that the sample left behind.
        """
        return ctx.state

    @property
    def longest_wait(self) -> float:
        """Seconds between samples that the policy declares not to exceed (delta_bar, thesis 3.19); inf if it cannot."""
        return np.inf

    def __or__(self, other: Trigger) -> Trigger:
        from ctmhe.triggers.compose import Or

        return Or.of(self, other)

    def __and__(self, other: Trigger) -> Trigger:
        from ctmhe.triggers.compose import And

        return And.of(self, other)

    def __repr__(self) -> str:
        shown = []
        for item in fields(self) if is_dataclass(self) else ():
            value = getattr(self, item.name)
            plain = isinstance(value, (str, int, float, type(None)))
            if item.default is MISSING or not (plain and value == item.default):
                shown.append(f"{item.name}={value!r}")
        return f"{type(self).__name__}({', '.join(shown)})"


class Predicate(Trigger):
    """A policy from a function `ctx -> bool` that is asked at monitoring times; made by `@trigger`."""

    def __init__(self, function: Callable[[TriggerContext], bool]):
        if not callable(function):
            raise InputError(f"trigger: expected a function of the context, got {function!r}")
        self.function = function
        self.__doc__ = function.__doc__
        self.__module__ = getattr(function, "__module__", type(self).__module__)
        self.name = getattr(function, "__name__", repr(function))
        self._path = getattr(function, "__qualname__", self.name)

    def fires(self, ctx: TriggerContext) -> bool:
        """Return what the function says."""
        return self.function(ctx)

    def __repr__(self) -> str:
        return self.name

    def __reduce__(self) -> Any:
        import sys

        if getattr(sys.modules.get(self.__module__), self._path, None) is self:
            return self._path  # the decorated name: pickled by reference, as a function is
        return Predicate, (self.function,)


def trigger(function: Callable[[TriggerContext], bool]) -> Predicate:
    """Make a policy from a function that is asked at monitoring times whether to sample.

    >>> from ctmhe.triggers import MaxInterval
    >>> @trigger
    ... def drifted(ctx):
    ...     return abs(ctx.y - ctx.y_hat).max() > 0.1
    >>> drifted | MaxInterval(0.19)
    drifted | MaxInterval(seconds=0.19)
    """
    return Predicate(function)
