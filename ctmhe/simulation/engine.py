"""One run in progress: the plant advances from break to break, events are located, sent, solved and recorded."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ctmhe.errors import CtmheError, FmuUnsupportedError, InputError, TriggerError
from ctmhe.estimators.mhe import MHE
from ctmhe.models.observer import known_inputs
from ctmhe.models.signals import Signals
from ctmhe.simulation.channel import Channel, Delivery, Everything, WholeSignal, check_hold
from ctmhe.simulation.drivers import Driver
from ctmhe.simulation.follower import Follower
from ctmhe.simulation.location import first_reached
from ctmhe.simulation.network import Network
from ctmhe.simulation.plants import Plant
from ctmhe.simulation.recorder import Recorder
from ctmhe.simulation.run import Run
from ctmhe.triggers.base import Trigger, TriggerContext
from ctmhe.triggers.timing import tolerance
from ctmhe.triggers.watch import Watch, WatchState
from ctmhe.types import Array, Input, frozen

logger = logging.getLogger(__name__)

MOST_SAMPLES = 1000
"""Samples within one monitoring step beyond which a policy is taken to run away."""

MOST_SHORT_GAPS = 10
"""Consecutive samples without time passing beyond which a policy is taken to run away."""

SHORT = 0.01
"""Share of the monitoring step below which the gap after a sample is short: the third such gap in a row is the last
before the next monitoring time, as far as guards are concerned."""


@dataclass
class Progress:
    """What changes while a loop runs, beside the estimators."""

    t: float
    watch: WatchState
    y_last: Array
    last_event: float
    samples: int = 0
    told: Array | None = None
    records: list[Delivery] = field(default_factory=list)
    messages: list[list[Delivery]] = field(default_factory=list)
    sent: int = 0
    lost: int = 0
    bytes: int = 0
    in_step: int = 0
    short_gaps: int = 0
    standing: int = 0
    hushed: int = 0


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
        locate: float | None,
        sample_time: Callable[[], float] | None = None,
    ):
        self.plant, self.mhe, self.model = plant, mhe, mhe.model
        self.watch = Watch(trigger)
        if np.isfinite(trigger.longest_wait):
            mhe.check_wait(trigger.longest_wait)
        if self.model.step is None:
            check_hold(channel, mhe.hold, self.model.y.names)
        self.y_map = matched(self.model.y, plant.y, "plant", plant.name)
        self.u_map = matched(known_inputs(self.model), plant.u, "plant", plant.name)
        self.channel, self.link = channel, channel.open(seed, self.model.y.names)
        self.sample_time = sample_time
        step = channel.interval(monitor)
        self.recording, self.record_step = step is not None, step if sample_time is None else None
        self.disturbance, self.inputs = disturbance, inputs
        self.times, self.monitor, self.seed = times, monitor, seed
        self.locate = locate if self.watch.has_guard else None
        self.rooted = self.locate is not None and getattr(plant, "finds_roots", False)
        self.parameters = self.model.p.names if mhe.assembly.p_estimated else ()
        self.recorder = Recorder(self)

    def run(self, *, truth: Any, p_true: Any, guess: Any, p: Any, progress: bool) -> Run:
        """Go through the monitoring times and return what was recorded; an error carries what there was until then."""
        plant, start = self.plant, float(self.times[0])
        x = truth if truth is None else plant.x.vector(truth, "truth")
        plant.start(start, x, p_true)
        self._check_way_back()
        self.estimator = Follower(self.mhe, self.mhe.init(t=start, x=guess, p=p))
        self.sensor = self.estimator if self.channel.faithful else Follower(self.mhe, self.estimator.state)
        self.followers = (self.estimator,) if self.channel.faithful else (self.estimator, self.sensor)
        unsent = frozen(np.full(len(self.model.y), np.nan))
        self.now = Progress(start, WatchState(()), unsent, start)
        for reason in self._against_guarantees():
            self._doubt(np.inf, reason)
        self.segment = self._segment(self._after(0))
        crossed = False
        try:
            for k in steps_of(self.times, progress):
                self._visit(grid=k, crossed=crossed)
                if k + 1 < len(self.times):
                    crossed = self._go_to(float(self.times[k + 1]), self._after(k + 1))
        except CtmheError as error:
            error.run = self.recorder.finish(p_true)
            raise
        if not self.now.samples:
            logger.warning("policy %r never fired from %g s to %g s", self.watch.policy, start, self.now.t)
        return self.recorder.finish(p_true)

    def _against_guarantees(self) -> list[str]:
        """Return what stands against a guarantee of the estimator: less than the whole signal, or later."""
        if self.mhe.guaranteed is None:
            return []
        network = self.channel if isinstance(self.channel, Network) else None
        inner = network.channel if network else self.channel
        reasons = [] if isinstance(inner, (WholeSignal, Everything)) else [f"channel {inner!r}: not the whole signal"]
        if network and network.late:
            reasons.append("the channel delays or redates measurements: what is known at a solve ends before it")
        return reasons

    def _doubt(self, t: float, reason: str) -> None:
        """Let the estimator know that its data at `t` are not what a guarantee assumes."""
        if self.mhe.guaranteed is not None:
            self.estimator.state = self.mhe.doubt(self.estimator.state, t, reason)

    def _check_way_back(self) -> None:
        """Raise when events are to be located by going back, and the plant cannot."""
        if self.locate is None or self.rooted:
            return
        try:
            self.plant.checkpoint()
        except FmuUnsupportedError as error:
            raise FmuUnsupportedError(
                f"{error} Or ask policy {self.watch.policy!r} at monitoring times only: locate=None"
            ) from error

    def _after(self, k: int) -> float:
        """Return the monitoring time after number `k` (one step on, after the last)."""
        return float(self.times[k + 1]) if k + 1 < len(self.times) else float(self.times[k]) + self.monitor

    def _segment(self, end: float) -> Segment:
        """Return the segment from now to the next break or `end`."""
        t = self.now.t
        slack = tolerance(t)
        sources = (self.disturbance.next_jump, self.inputs.next_jump, self._next_record, self.now.watch.next_due)
        b = min(source(t + slack) for source in (*sources, self._next_arrival))
        b = end if b > end - slack else b
        u0, u1 = self.inputs.segment(t, b)
        return Segment(t, b, u0, u1, self.disturbance.segment(t, b)[0])

    def _next_arrival(self, t: float) -> float:
        return min((message[0].at for message in self.now.messages if message[0].at > t), default=np.inf)

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
            at, crossed = self._advance(segment)
            if at < segment.b:
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

    def _advance(self, segment: Segment) -> tuple[float, bool]:
        """Advance to the segment's end, or to the event before; return the time, and whether a guard crossed there."""
        plant, b = self.plant, segment.b
        drive = (segment.u0, segment.u1, segment.w)
        if self.locate is None:
            plant.advance(b, *drive)
            return b, False
        if not self.rooted:
            level = partial(self._level_in, segment)
            return first_reached(plant, segment, level, self.locate, after=self._dead_until())
        at = plant.advance_until(b, *drive, partial(self._level_of, segment))  # type: ignore[attr-defined]
        if at < (dead := min(self._dead_until(), b)):
            plant.advance(dead, segment.input_at(at), segment.input_at(dead), segment.w)
            at = dead
        if at >= b - tolerance(b):
            plant.advance(b, segment.input_at(at), segment.u1, segment.w)
            return b, self._level_in(segment, b) >= 0
        return at, True

    def _dead_until(self) -> float:
        """Return the earliest time of another sample: no two within what counts as one instant."""
        now = self.now
        return now.last_event + tolerance(now.last_event) if now.samples else -np.inf

    def _visit(self, grid: int | None = None, crossed: bool = False) -> None:
        """Do what is due now: tell inputs, record, ask the policy, sample; keep results at monitoring time `grid`."""
        now, segment = self.now, self.segment
        y = self._measure(segment.u0, segment.w)
        self._tell(segment.u0)
        if self._record_due(grid):
            self._post(self.link.record(now.t, y), now.records)
        self._arrive()
        ctx = self._context(now.t, y)
        if grid is not None:
            now.in_step = 0
            now.watch = self.watch.ask(self.watch.start(ctx) if grid == 0 else now.watch, ctx)
        level = self.watch.level(now.watch, ctx)
        fired = crossed or level >= 0
        if fired:
            self._event(ctx)
        elif grid is not None:
            now.watch = self.watch.monitored(now.watch, ctx)
        if fired or grid == 0:
            self.segment = self._segment(segment.b)  # policies may have named earlier times
        if grid is not None:
            start = self.estimator.state.start[: len(self.model.x)]
            for follower in self.followers:
                follower.carry(now.t)
            x_online = start if grid == 0 else self.estimator.forecast.x
            level = max(level, 0.0) if crossed else level
            self.recorder.monitored(grid, self.plant.state(), x_online, y, level, segment)

    def _measure(self, u: Array, w: Array) -> Array:
        return frozen(np.asarray(self.plant.output(u, w))[self.y_map])

    def _tell(self, u: Array) -> None:
        """Tell the estimators an input that changed."""
        now = self.now
        if len(self.u_map) and (now.told is None or not np.array_equal(u, now.told)):
            for follower in self.followers:
                follower.tell(Input(now.t, u[self.u_map]))
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
            estimate=self.sensor.estimate,
            forecast=self.sensor.forecast,
            seed=self.seed,
        )

    def _level_in(self, segment: Segment, t: float) -> float:
        """Return the level at `t` with the plant there, as seen from inside the segment: the left limit at its end."""
        return self._level(segment, t, self.plant.output(segment.input_at(t), segment.w))

    def _level_of(self, segment: Segment, t: float, x: Array) -> float:
        """Return the same for a plant that tells its output in another state."""
        return self._level(segment, t, self.plant.output_at(t, x, segment.input_at(t), segment.w))  # type: ignore[attr-defined]

    def _level(self, segment: Segment, t: float, y: Array) -> float:
        ctx = self._context(t, frozen(np.asarray(y)[self.y_map]))
        return self.watch.level(self.now.watch, ctx, as_of=segment.a)

    def _event(self, ctx: TriggerContext) -> None:
        """Sample now: send, solve where it arrives, and let the policy plan anew."""
        now, y = self.now, ctx.y
        self._guard_against_zeno(now.t)
        message = self.link.sample(now.t if self.sample_time is None else self.sample_time(), y)
        self.recorder.sampled(now.t, now.last_event, y)
        now.y_last = frozen(np.where(np.isnan(y), now.y_last, y))
        soon = now.samples > 0 and now.t - now.last_event <= SHORT * self.monitor
        now.standing = now.standing + 1 if soon else 0
        now.last_event, now.samples = now.t, now.samples + 1
        if message:
            self._post(message, now.messages)
            self._arrive()
        else:  # nothing is sent for a sample: it only means to solve
            self._solve(self._take(now.records))
        if self.sensor is not self.estimator:
            self.sensor.solve(now.t)
        now.watch = self.watch.sampled(now.watch, ctx, self._context(now.t, y))
        if now.standing >= 3:
            self._hush()

    def _hush(self) -> None:
        """Silence guards until the next monitoring time: a sample does not lower them, they come back at once."""
        now = self.now
        now.watch, now.standing, now.hushed = self.watch.silenced(now.watch), 0, now.hushed + 1
        if now.hushed == 1:
            logger.warning(
                "policy %r: its guard reaches zero again right after its samples, at t = %.9g s; then it is asked at "
                "monitoring times only. A dead time of your own says better what is meant: policy & MinInterval(%g)",
                self.watch.policy, now.t, self.monitor,
            )  # fmt: skip

    def _post(self, message: list[Delivery], queue: list[Any]) -> None:
        """Put a message on the way, and let the copy at the sensor know what it says."""
        now = self.now
        if not message:
            return
        now.sent += 1
        now.bytes += sum(item.bytes for item in message)
        if self.sensor is not self.estimator:
            self.sensor.observe(item.measurement for item in message)
        if np.isinf(message[0].at):
            now.lost += 1
            self._doubt(now.t, f"a message was lost at t = {now.t:g} s")
        elif queue is now.records:
            queue.extend(message)
        else:
            queue.append(message)

    def _arrive(self) -> None:
        """Hand the estimator what has arrived by now, and let it solve when a sample's message is among it."""
        now = self.now
        until = now.t + tolerance(now.t)
        due = [message for message in now.messages if message[0].at <= until]
        now.messages = [message for message in now.messages if message[0].at > until]
        taken = self._take(now.records)
        for message in sorted(due, key=lambda message: message[0].at):
            taken += self.estimator.observe(item.measurement for item in message)
        if due:
            self._solve(taken)

    def _take(self, records: list[Delivery]) -> int:
        """Hand the estimator the records that have arrived by now; return how many it took."""
        until = self.now.t + tolerance(self.now.t)
        arrived = sorted((item for item in records if item.at <= until), key=lambda item: item.at)
        records[:] = [item for item in records if item.at > until]
        return self.estimator.observe(item.measurement for item in arrived)

    def _solve(self, taken: int) -> None:
        """Estimate now, after `taken` new measurements."""
        previous = self.estimator.state.t
        estimate = self.estimator.solve(self.now.t)
        self.recorder.solved(self.estimator.state, estimate, self.now.t, previous, taken)

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
