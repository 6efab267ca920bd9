"""Contexts for policies, and a walk through a signal without plant and estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ctmhe.triggers import Trigger, TriggerContext, Watch
from ctmhe.types import frozen


@dataclass(frozen=True, eq=False)
class Foreseen:
    """An outlook: an output that stays, and a covariance that is a function of time."""

    y: np.ndarray
    spread: object = None

    def state(self, t):
        return frozen([0.0])

    def output(self, t):
        return self.y

    def covariance(self, t):
        return frozen([[1.0]] if self.spread is None else self.spread(t))


@dataclass(frozen=True, eq=False)
class Solved:
    """What a policy reads of an estimate."""

    t: float
    cost: float = 1.0


def context(t=1.0, y=(0.0,), y_last=None, samples=1, y_hat=None, **more):
    """Build a context with outputs a, b, ..., zero where last sent, and prediction `y_hat`."""
    prediction = None if y_hat is None else Foreseen(frozen(y_hat))
    known = {"samples": samples, "outputs": tuple("abcdef"[: len(y)]), "forecast": prediction} | more
    return TriggerContext(t, frozen(y), frozen(np.zeros(len(y)) if y_last is None else y_last), **known)


def level(policy, ctx):
    """Return the level of a policy that was just started at `ctx`."""
    watch = Watch(policy)
    return watch.level(watch.ask(watch.start(ctx), ctx), ctx)


def walk(policy: Trigger, until: float, signal=lambda t: 0.0, *, step=0.01, start=0.0, spread=None, cost=1.0, seed=0):
    """Return the times at which `policy` samples: guards are asked at monitoring times and at named times only.

    The prediction is the output last sent; `spread(t, t_last)` is the covariance (1, 1) predicted from there.
    """
    watch, last, samples, y_last = Watch(policy), start, 0, np.array([np.nan])
    times = []

    def seen(t):
        outlook = Foreseen(frozen(np.nan_to_num(y_last)), spread and (lambda s, last=last: [[spread(s, last)]]))
        y = frozen(np.atleast_1d(signal(t)))
        estimate = Solved(last, cost) if samples else None
        more = {"states": ("x",), "seed": seed, "estimate": estimate, "elapsed": t - last, "forecast": outlook}
        return context(t, y, y_last, samples, **more)

    state = watch.start(seen(start))
    grid = start + step * np.arange(round((until - start) / step) + 1)
    for k, t in enumerate(grid):
        state = watch.ask(state, seen(t))
        end = grid[k + 1] if k + 1 < len(grid) else t + 1e-9
        due, monitoring = t, True
        while due < end - 1e-9 or monitoring:
            ctx = seen(due)
            if watch.level(state, ctx) >= 0:
                assert len(times) < 100_000
                times.append(float(due))
                before, last, samples, y_last = ctx, due, samples + 1, np.array(ctx.y)
                state = watch.sampled(state, before, seen(due))
            elif monitoring:
                state = watch.monitored(state, ctx)
            monitoring, due = False, state.next_due(due + 1e-9)
    return np.array(times)


def at(ctx, **changes):
    """Return the context with some fields changed; arrays are made read-only."""
    arrays = {name: frozen(value) for name, value in changes.items() if name in ("y", "y_last")}
    return replace(ctx, **(changes | arrays))
