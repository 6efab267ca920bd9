"""What a network does to messages: loss, delay, reordering, quantisation, a clock that is off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any
from zlib import crc32

import numpy as np

from ctmhe.errors import InputError
from ctmhe.simulation.channel import Channel, Delivery, Link
from ctmhe.triggers.compose import positive
from ctmhe.types import Array, Measurement

LOSS, DELAY = (crc32(word.encode()) for word in ("network loss", "network delay"))
"""Which draws are meant, beside the seed: part of what a seed means, so never changed."""


@dataclass(frozen=True)
class Network:
    """Another channel over a network that loses, delays, rounds and misdates what is sent.

    A message, all that the channel sends at one time, is lost or delayed as a whole. Lost data are not sent again. The
    estimator solves when the message of a sample arrives; what is older than its window by then is dropped and counted
    (`Run.too_late`). The trigger sees the estimates of a copy of the estimator at the sensor, which knows what was
    sent, quantised and with the sensor's times, but not what arrived. Loss and delays depend on the run's seed only.

    Parameters
    ----------
    channel : Channel
        `WholeSignal`, `SingleSample` or `Everything`.
    loss : float
        Share of lost messages in [0, 1].
    outage : float, optional
        Mean length of outages in seconds: up and down times are exponential, in a share of time `loss` nothing gets
        through (the model of Gilbert, Bell System Technical Journal 39 (1960), in continuous time), whatever is sent.
        Each message is lost independently when left out.
    delay : float or pair
        Seconds on the way, >= 0; a pair (shortest, longest) draws them uniformly.
    in_order : bool
        A message waits for those sent before it, as in TCP; else it may overtake them, as in UDP.
    quantum : float or mapping output -> float, optional
        Steps to which values are rounded, in the outputs' units; a mapping names those that are.
    clock_offset : float
        Seconds by which the sensor's clock is ahead: measurements are dated so much too late.
    value_bytes : int
        Bytes that a value takes; the time of a record takes 8 more.
    """

    channel: Channel
    loss: float = 0.0
    outage: float | None = None
    delay: float | tuple[float, float] = 0.0
    in_order: bool = False
    quantum: float | Mapping[str, float] | None = None
    clock_offset: float = 0.0
    value_bytes: int = 8

    def __post_init__(self) -> None:
        if isinstance(self.channel, Network) or not hasattr(self.channel, "open"):
            raise InputError(f"Network: expected WholeSignal(), SingleSample() or Everything(), got {self.channel!r}")
        loss = _number(self.loss, "Network: loss")
        if not 0 <= loss <= 1:
            raise InputError(f"Network: loss must lie in [0, 1], got {self.loss!r}")
        if self.outage is not None:
            positive(self.outage, "Network: outage")
        lags = self.delay if isinstance(self.delay, (tuple, list)) else (self.delay, self.delay)
        if len(lags) != 2 or not 0 <= _number(lags[0], "Network: delay") <= _number(lags[1], "Network: delay"):
            raise InputError(f"Network: delay must be >= 0 s, or a pair (shortest, longest), got {self.delay!r}")
        object.__setattr__(self, "delay", self.delay if np.isscalar(self.delay) else (float(lags[0]), float(lags[1])))
        _number(self.clock_offset, "Network: clock_offset")
        if isinstance(self.value_bytes, bool) or not isinstance(self.value_bytes, int) or self.value_bytes < 1:
            raise InputError(f"Network: value_bytes must be a positive integer, got {self.value_bytes!r}")
        quanta = self.quantum.values() if isinstance(self.quantum, Mapping) else (self.quantum,)
        for value in quanta:
            if value is not None:
                positive(value, "Network: quantum")

    @property
    def late(self) -> bool:
        """Whether measurements arrive later than they are dated, or are dated wrongly."""
        longest = self.delay[1] if isinstance(self.delay, (tuple, list)) else self.delay
        return longest > 0 or self.clock_offset != 0

    @property
    def faithful(self) -> bool:
        """False: what arrives is not what was measured."""
        return False

    @property
    def holds(self) -> tuple[str, ...]:
        """Those of the channel."""
        return self.channel.holds

    def interval(self, monitor: float) -> float | None:
        """Return that of the channel."""
        return self.channel.interval(monitor)

    def open(self, seed: int, outputs: tuple[str, ...]) -> Link:
        """Return a link with messages of its own."""
        return _Messages(self, self.channel.open(seed, outputs), seed, _quanta(self.quantum, outputs))


class _Messages:
    """Messages of one run; the k-th of a kind meets the same fate whatever the policy, an outage everything in it."""

    def __init__(self, network: Network, link: Link, seed: int, quanta: Array):
        self.network, self.link, self.seed, self.quanta = network, link, seed, quanta
        self.count, self.latest = 0, -np.inf
        self.rounded = np.isfinite(quanta)
        outage, loss = network.outage, network.loss
        self.outages = None if outage is None or not 0 < loss < 1 else _Outages(outage, loss, seed)

    def record(self, t: float, y: Array) -> list[Delivery]:
        return self._send(t, self.link.record(t, self._rounded(y)))

    def sample(self, t: float, y: Array) -> list[Delivery]:
        return self._send(t, self.link.sample(t, self._rounded(y)))

    def _rounded(self, y: Array) -> Array:
        values, step = np.array(y), self.quanta[self.rounded]
        values[self.rounded] = step * np.round(values[self.rounded] / step)
        return values

    def _send(self, t: float, message: list[Delivery]) -> list[Delivery]:
        if not message:
            return []
        network, number = self.network, self.count
        self.count += 1
        lost = network.loss > 0 and self._lost(t, number)
        at = t + self._lag(number)
        if network.in_order and not lost:
            at = self.latest = max(at, self.latest)
        values = network.value_bytes
        return [
            replace(
                Delivery.of(item.measurement.t, np.asarray(item.measurement.y), values),
                at=np.inf if lost else at,
                measurement=Measurement(item.measurement.t + network.clock_offset, item.measurement.y),
            )
            for item in message
        ]

    def _lost(self, t: float, number: int) -> bool:
        if self.outages is not None:
            return self.outages.down(t)
        return bool(np.random.default_rng([self.seed, LOSS, number]).random() < self.network.loss)

    def _lag(self, number: int) -> float:
        if not isinstance(self.network.delay, tuple):
            return float(self.network.delay)
        return float(np.random.default_rng([self.seed, DELAY, number]).uniform(*self.network.delay))


class _Outages:
    """Alternating exponential up and down times from t = 0 on; before, it is as at 0."""

    def __init__(self, outage: float, loss: float, seed: int):
        self.means = (outage * (1 - loss) / loss, outage)
        self.rng = np.random.default_rng([seed, LOSS])
        self.began = self.until = 0.0
        self.is_down = bool(self.rng.random() < loss)
        self.until = float(self.rng.exponential(self.means[self.is_down]))

    def down(self, t: float) -> bool:
        """Return whether nothing gets through at `t`, which does not decrease from call to call."""
        while t >= self.until:
            self.is_down = not self.is_down
            self.until += float(self.rng.exponential(self.means[self.is_down]))
        return self.is_down


def _quanta(quantum: Any, outputs: tuple[str, ...]) -> Array:
    """Return the step of each output, inf for none."""
    if quantum is None:
        return np.full(len(outputs), np.inf)
    if not isinstance(quantum, Mapping):
        return np.full(len(outputs), float(quantum))
    for name in quantum:
        if name not in outputs:
            raise InputError(f"Network: quantum for unknown output {name!r}. Known: {', '.join(outputs)}")
    return np.array([float(quantum.get(name, np.inf)) for name in outputs])


def _number(value: Any, what: str) -> float:
    if (
        isinstance(value, bool)
        or not isinstance(value, (int, float, np.integer, np.floating))
        or not np.isfinite(value)
    ):
        raise InputError(f"{what} must be a finite number, got {value!r}")
    return float(value)
