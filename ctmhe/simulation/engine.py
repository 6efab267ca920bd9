"""One run in progress: the plant advances from break to break, events are located, sent, solved and recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctmhe.errors import InputError, TooLate, TriggerError
from ctmhe.estimators.mhe import MHE
from ctmhe.models.signals import Signals
from ctmhe.simulation.channel import Channel, Delivery, check_hold
from ctmhe.simulation.drivers import Driver
from ctmhe.simulation.plants import Plant
from ctmhe.simulation.recorder import Recorder
from ctmhe.simulation.run import Run
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.timing import tolerance
from ctmhe.triggers.watch import Watch, WatchState
from ctmhe.types import Array, Estimate, Input, frozen

LOCATED = 1e-11
"""Seconds to which an event is located between monitoring times."""

MOST_SAMPLES = 1000
"""Samples within one monitoring step beyond which a policy is taken to run away."""

MOST_SHORT_GAPS = 10
"""Consecutive samples at the smallest gap beyond which a policy is taken to run away."""

CLIP = 1e12


@dataclass
class Progress:
    """What changes while a loop runs."""

    t: float
    state: Any
    watch: WatchState
    y_last: Array
    last_event: float
    estimate: Estimate | None = None
    samples: int = 0
    base: tuple[float, Array, Array] = (0.0, np.empty(0), np.empty(0))
    told: Array | None = None
    pending: list[Delivery] = field(default_factory=list)
    measurements: int = 0
    too_late: int = 0
    in_step: int = 0
    short_gaps: int = 0


class Forecast:
    """What is expected from the last estimate on; computed when asked, kept for the last time asked for."""

    def __init__(self, mhe: MHE, now: Progress):
        self.mhe, self.estimator, self.base, self.estimate = mhe, now.state, now.base, now.estimate
        self.known: dict[str, tuple[float, Array]] = {}

    def state(self, t: float) -> Array:
        """Return the predicted state at `t`."""

        def compute() -> Array:
            t0, x0, p = self.base
            return x0 if t <= t0 else self.mhe.propagate(self.estimator, t0, t, x0, p)

        return self._kept("state", t, compute)

    def output(self, t: float) -> Array:
        """Return the predicted output at `t`."""
        return self._kept("output", t, lambda: self.mhe.output(self.estimator, t, self.state(t), self.base[2]))

    def covariance(self, t: float) -> Array:
        """Return the predicted covariance at `t`."""
        return self._kept("covariance", t, lambda: self._covariance(t))

    def _covariance(self, t: float) -> Array:
        state = self.estimator
        known = self.mhe.prior_covariance(state.t) if self.estimate is None else self.estimate.covariance
        return self.mhe.propagate_covariance(state, state.t, t, state.x, state.p, known)

    def _kept(self, name: str, t: float, compute: Callable[[], Array]) -> Array:
        if name not in self.known or self.known[name][0] != t:
            self.known[name] = (t, frozen(compute()))
        return self.known[name][1]


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of time on which the input is linear and w constant."""

    a: float
    b: float
    u0: Array
    u1: Array
    w: Array

    def input_at(self, t: float) -> Array:
        """Return the input at `t` in [a, b]."""
        if t >= self.b or self.b <= self.a:
            return self.u1
        return self.u0 + (self.u1 - self.u0) * ((t - self.a) / (self.b - self.a))


class Loop:
    """One run in progress: `simulate` and `replay` differ in their plant and monitoring times only."""

    def __init__(
        self,
        plant: Plant,
        mhe: MHE,
        *,
        trigger: Trigger,
        channel: Channel,
        disturbance: Driver,
        inputs: Driver,
        times: Array,
        monitor: float,
        seed: int,
        locate: bool,
        sample_time: Callable[[], float] | None = None,
    ):
        self.plant, self.mhe, self.model = plant, mhe, mhe.model
        self.watch = Watch(trigger)
        if np.isfinite(trigger.longest_wait):
            mhe.check_wait(trigger.longest_wait)
        if self.model.step is None:
            check_hold(channel, mhe.hold, self.model.y.names)
        self.y_map = matched(self.model.y, plant.y, "plant", plant.name)
        self.u_map = matched(self.model.u, plant.u, "plant", plant.name)
        self.channel, self.link = channel, channel.open(seed)
        self.sample_time = sample_time
        step = channel.interval(monitor)
        self.recording, self.record_step = step is not None, step if sample_time is None else None
        self.disturbance, self.inputs = disturbance, inputs
        self.times, self.monitor, self.seed = times, monitor, seed
        self.locate = locate and self.watch.has_guard
        self.parameters = self.model.p.names if mhe.assembly.p_estimated else ()
        self.recorder = Recorder(self)

    def run(self, *, truth: Any, p_true: Any, guess: Any, p: Any, progress: bool) -> Run:
        """Go through the monitoring times and return what was recorded."""
        plant, start = self.plant, float(self.times[0])
        x = truth if truth is None else plant.x.vector(truth, "truth")
        plant.start(start, x, p_true)
        state = self.mhe.init(t=start, x=guess, p=p)
        unsent = frozen(np.full(len(self.model.y), np.nan))
        self.now = Progress(start, state, WatchState(()), unsent, start)
        self.now.base = (start, state.x, state.p)
        self.segment = self._segment(self._after(0))
        crossed = False
        for k in steps_of(self.times, progress):
            self._visit(grid=k, crossed=crossed)
            if k + 1 < len(self.times):
                crossed = self._go_to(float(self.times[k + 1]), self._after(k + 1))
        return self.recorder.finish(p_true)

    def _after(self, k: int) -> float:
        """Return the monitoring time after number `k` (one step on, after the last)."""
        return float(self.times[k + 1]) if k + 1 < len(self.times) else float(self.times[k]) + self.monitor

    def _segment(self, end: float) -> Segment:
        """Return the segment from now to the next break or `end`."""
        t = self.now.t
        slack = tolerance(t)
        sources = (self.disturbance.next_jump, self.inputs.next_jump, self._next_record, self.now.watch.next_due)
        b = min(source(t + slack) for source in sources)
        b = end if b > end - slack else b
        u0, u1 = self.inputs.segment(t, b)
        return Segment(t, b, u0, u1, self.disturbance.segment(t, b)[0])

    def _next_record(self, t: float) -> float:
        step = self.record_step
        return np.inf if step is None else (np.floor(t / step + 1e-9) + 1) * step

    def _record_due(self, grid: int | None) -> bool:
        if grid == 0 or self.sample_time is not None:
            return grid is not None and self.recording
        step, t = self.record_step, self.now.t
        return step is not None and abs(t - round(t / step) * step) <= tolerance(t)

    def _go_to(self, end: float, after: float) -> bool:
        """Advance the plant to the monitoring time `end`, stopping at breaks and events; `after` is the next one.

        Returns whether a guard has crossed zero at `end` itself, before any jump there.
        """
        while True:
            segment = self.segment
            before = self.plant.checkpoint() if self.locate else None
            self.plant.advance(segment.b, segment.u0, segment.u1, segment.w)
            crossed = self.locate and self._level_in(segment, segment.b) >= 0
            if crossed:
                at = self._located(segment, before)
                if at < segment.b - tolerance(at):
                    self._advance_from(before, segment, at)
                    self.now.t = at
                    u = segment.input_at(at)
                    self._tell(u)
                    self._event(self._context(at, self._measure(u, segment.w)))
                    self.segment = self._segment(end)
                    continue
            self.now.t = segment.b
            self.segment = self._segment(after if segment.b >= end else end)
            if segment.b >= end:
                return crossed
            self._visit(crossed=crossed)

    def _visit(self, grid: int | None = None, crossed: bool = False) -> None:
        """Do what is due now: tell inputs, record, ask the policy, sample; keep results at monitoring time `grid`."""
        now, segment = self.now, self.segment
        y = self._measure(segment.u0, segment.w)
        self._tell(segment.u0)
        if self._record_due(grid):
            now.pending += self.link.record(now.t, y)
        ctx = self._context(now.t, y)
        if grid is not None:
            now.in_step = 0
            now.watch = self.watch.ask(self.watch.start(ctx) if grid == 0 else now.watch, ctx)
        fired = crossed or self.watch.level(now.watch, ctx) >= 0
        if fired:
            self._event(ctx)
        elif grid is not None:
            now.watch = self.watch.monitored(now.watch, ctx)
        if fired or grid == 0:
            self.segment = self._segment(segment.b)  # policies may have named earlier times
        self._deliver()
        if grid is not None:
            if now.base[0] < now.t:
                now.base = (now.t, ctx.prediction, now.base[2])
            x_online = now.state.start[: len(self.model.x)] if grid == 0 else now.base[1]
            self.recorder.monitored(grid, self.plant.state(), x_online, y, segment)

    def _measure(self, u: Array, w: Array) -> Array:
        return frozen(np.asarray(self.plant.output(u, w))[self.y_map])

    def _tell(self, u: Array) -> None:
        """Tell the estimator an input that changed."""
        now = self.now
        if len(self.model.u) and (now.told is None or not np.array_equal(u, now.told)):
            now.state = self.mhe.control(now.state, Input(now.t, u[self.u_map]))
            now.told = np.array(u)

    def _context(self, t: float, y: Array) -> TriggerContext:
        now = self.now
        return TriggerContext(
            t=t,
            y=y,
            y_last=now.y_last,
            elapsed=t - now.last_event,
            samples=now.samples,
            outputs=self.model.y.names,
            states=self.model.x.names,
            parameters=self.parameters,
            estimate=now.estimate,
            forecast=Forecast(self.mhe, now),
            seed=self.seed,
        )

    def _level_in(self, segment: Segment, t: float) -> float:
        """Return the level at `t` with the plant there, as seen from inside the segment: the left limit at its end."""
        y = self._measure(segment.input_at(t), segment.w)
        return self.watch.level(self.now.watch, self._context(t, y), as_of=segment.a)

    def _advance_from(self, checkpoint: Any, segment: Segment, t: float) -> None:
        self.plant.restore(checkpoint)
        self.plant.advance(t, segment.u0, segment.input_at(t), segment.w)

    def _located(self, segment: Segment, checkpoint: Any) -> float:
        """Return the first time found in the segment at which the level is >= 0, to `LOCATED` seconds."""

        def level(t: float) -> float:
            self._advance_from(checkpoint, segment, t)
            return float(np.clip(self._level_in(segment, t), -CLIP, CLIP))

        a, b = segment.a, segment.b
        if level(b) < 0:
            return b
        a = a if level(a) < 0 else min(a + 2 * tolerance(a), b)
        if level(a) >= 0:
            at = a
        else:
            from scipy.optimize import brentq

            at = float(brentq(level, a, b, xtol=LOCATED, rtol=4 * np.finfo(float).eps, maxiter=200))  # type: ignore[arg-type]
            nudge = LOCATED
            while at < b and level(at) < 0:
                at, nudge = min(at + nudge, b), 2 * nudge
        earliest = self.now.last_event + tolerance(at) if self.now.samples else a
        if at >= b - tolerance(b):
            level(b)
            return b
        return max(at, earliest)

    def _event(self, ctx: TriggerContext) -> None:
        """Sample now: send, deliver, solve, and let the policy plan anew."""
        now, y = self.now, ctx.y
        self._guard_against_zeno(now.t)
        now.pending += self.link.sample(now.t if self.sample_time is None else self.sample_time(), y)
        delivered = self._deliver()
        now.state, now.estimate = self.mhe.estimate(now.state, now.t)
        now.base = (now.t, now.state.x, now.state.p)
        self.recorder.sampled(now.state, now.estimate, now.t, now.last_event, y, delivered)
        now.y_last = frozen(np.where(np.isnan(y), now.y_last, y))
        now.last_event, now.samples = now.t, now.samples + 1
        now.watch = self.watch.sampled(now.watch, ctx, self._context(now.t, y))

    def _deliver(self) -> int:
        """Hand the estimator what has arrived by now; return how many measurements it took."""
        now = self.now
        arrived = [item for item in now.pending if item.at <= now.t]
        now.pending = [item for item in now.pending if item.at > now.t]
        taken = 0
        for item in sorted(arrived, key=lambda item: item.at):
            try:
                now.state = self.mhe.observe(now.state, item.measurement)
                taken += 1
            except TooLate:
                now.too_late += 1
        now.measurements += taken
        return taken

    def _guard_against_zeno(self, t: float) -> None:
        """Raise when the policy samples without end."""
        now = self.now
        now.in_step += 1
        short = now.samples > 0 and t - now.last_event <= 1.5 * tolerance(t)
        now.short_gaps = now.short_gaps + 1 if short else 0
        if now.in_step > MOST_SAMPLES or now.short_gaps > MOST_SHORT_GAPS:
            what = f"{now.in_step} samples within one monitoring step of {self.monitor:g} s"
            if now.short_gaps > MOST_SHORT_GAPS:
                what = f"{now.short_gaps} samples in a row without time passing"
            raise TriggerError(
                f"policy {self.watch.policy!r} fires without end at t = {t:.9g}: {what}. Give it a dead time, for "
                "example policy & MinInterval(1e-3)"
            )


def steps_of(times: Array, progress: bool) -> Any:
    """Return the numbers of the monitoring times, behind a progress bar if wanted."""
    if not progress:
        return range(len(times))
    from tqdm import tqdm

    return tqdm(range(len(times)), desc="simulating", unit="step", leave=False)


def matched(wanted: Signals, offered: Signals, what: str, name: str) -> Array:
    """Return where each wanted signal stands among those offered, by name."""
    missing = [label for label in wanted if label not in offered.names]
    if missing:
        raise InputError(
            f"{what} {name!r} has no {wanted.kind} {', '.join(map(repr, missing))}, which the estimator's model needs; "
            f"it has {', '.join(offered.names) or 'none'}. Give both the same names"
        )
    return np.array([offered.names.index(label) for label in wanted], dtype=int)
