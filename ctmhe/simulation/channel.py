"""What reaches the estimator, and when: channels between sensor and estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ctmhe.errors import InputError
from ctmhe.triggers.compose import positive
from ctmhe.types import Array, Measurement


@dataclass(frozen=True, eq=False)
class Delivery:
    """A measurement on its way: it reaches the estimator at time `at` (seconds), never when that is inf.

    `bytes` is what it takes on the way: by default 8 for its time and 8 for each value in it.
    """

    at: float
    measurement: Measurement
    bytes: int = 0

    @classmethod
    def of(cls, t: float, y: Array, value_bytes: int = 8) -> Delivery:
        """Return what arrives at once."""
        return cls(t, Measurement(t, y), 8 + value_bytes * int(np.count_nonzero(~np.isnan(y))))


class Link(Protocol):
    """One run's end of a channel; it may hold back, drop or change what it is given.

    What one call returns is one message. Without any at a sample, the estimator solves with what it has; else when
    the message arrives.
    """

    def record(self, t: float, y: Array) -> list[Delivery]:
        """Take a routine record of the sensors at time `t`; return what is put on the way."""
        ...

    def sample(self, t: float, y: Array) -> list[Delivery]:
        """Take the sample at the event at time `t`; return what is put on the way."""
        ...


class Channel(Protocol):
    """A way for measurements from sensor to estimator; immutable, one `Link` a run.

    `holds` are the kinds of measurement (`MHE(hold=)`) that it delivers: "zero" and "linear" mean a signal known
    between its records, "point" single values. `faithful` tells whether all that is sent arrives at once, unchanged:
    where not, the trigger sees the estimates of a copy of the estimator, which knows what was sent.
    """

    @property
    def faithful(self) -> bool:
        """Return whether all that is sent arrives at once, unchanged."""
        ...

    @property
    def holds(self) -> tuple[str, ...]:
        """Return the kinds of measurement delivered."""
        ...

    def interval(self, monitor: float) -> float | None:
        """Return the seconds between routine records, None for none; `monitor` is the monitoring step."""
        ...

    def open(self, seed: int, outputs: tuple[str, ...]) -> Link:
        """Return the link of a new run, for outputs of these names."""
        ...


@dataclass(frozen=True)
class WholeSignal:
    """The whole signal: records are buffered at the sensor and delivered together at the next event.

    The problem (3.12)-(3.13) of the thesis: solves happen at the events t_i, y is known on the whole window.

    Parameters
    ----------
    every : float, optional
        Seconds between records, at absolute multiples; the monitoring step when left out. The values at the start and
        at the event itself are recorded too.
    """

    every: float | None = None

    def __post_init__(self) -> None:
        _check_every(self)

    @property
    def faithful(self) -> bool:
        """True: what is sent arrives at once."""
        return True

    @property
    def holds(self) -> tuple[str, ...]:
        """A signal known between its records."""
        return ("zero", "linear")

    def interval(self, monitor: float) -> float | None:
        """Return the seconds between records."""
        return self.every or monitor

    def open(self, seed: int, outputs: tuple[str, ...]) -> Link:
        """Return a link with an empty buffer."""
        return _Buffer()


@dataclass(frozen=True)
class SingleSample:
    """One value of every sensor, at the event; for `hold="point"`. What a network of smart sensors sends."""

    @property
    def faithful(self) -> bool:
        """True: what is sent arrives at once."""
        return True

    @property
    def holds(self) -> tuple[str, ...]:
        """Single values."""
        return ("point",)

    def interval(self, monitor: float) -> float | None:
        """Return None: there are no routine records."""
        return None

    def open(self, seed: int, outputs: tuple[str, ...]) -> Link:
        """Return a link that passes on samples."""
        return _Through(records=False, samples=True)


@dataclass(frozen=True)
class Everything:
    """Every record is delivered as it is taken; the trigger decides about solves only.

    Parameters
    ----------
    every : float, optional
        Seconds between records, at the start and absolute multiples; the monitoring step when left out.
    """

    every: float | None = None

    def __post_init__(self) -> None:
        _check_every(self)

    @property
    def faithful(self) -> bool:
        """True: what is sent arrives at once."""
        return True

    @property
    def holds(self) -> tuple[str, ...]:
        """A signal known between its records."""
        return ("zero", "linear")

    def interval(self, monitor: float) -> float | None:
        """Return the seconds between records."""
        return self.every or monitor

    def open(self, seed: int, outputs: tuple[str, ...]) -> Link:
        """Return a link that passes on records."""
        return _Through(records=True, samples=False)


def check_hold(channel: Channel, hold: object, outputs: tuple[str, ...]) -> None:
    """Raise when the estimator's `hold` does not fit what the channel delivers."""
    for name in outputs:
        kind = hold.get(name) if isinstance(hold, dict) else hold
        if kind not in channel.holds:
            other = "SingleSample()" if kind == "point" else "WholeSignal() or Everything()"
            raise InputError(
                f"channel {channel!r} delivers measurements for hold={' or '.join(map(repr, channel.holds))}, but the "
                f"estimator takes output {name!r} with hold={kind!r}: use channel={other}, or build the MHE with "
                f"hold={channel.holds[0]!r}"
            )


class _Buffer:
    def __init__(self) -> None:
        self.kept: list[tuple[float, Array]] = []

    def record(self, t: float, y: Array) -> list[Delivery]:
        self.kept.append((t, y))
        return []

    def sample(self, t: float, y: Array) -> list[Delivery]:
        if not self.kept or self.kept[-1][0] != t:
            self.kept.append((t, y))
        sent, self.kept = self.kept, []
        return [replace(Delivery.of(*item), at=t) for item in sent]


class _Through:
    def __init__(self, records: bool, samples: bool):
        self.records, self.samples = records, samples

    def record(self, t: float, y: Array) -> list[Delivery]:
        return [Delivery.of(t, y)] if self.records else []

    def sample(self, t: float, y: Array) -> list[Delivery]:
        return [Delivery.of(t, y)] if self.samples else []


def _check_every(channel: WholeSignal | Everything) -> None:
    if channel.every is not None:
        object.__setattr__(channel, "every", positive(channel.every, f"{type(channel).__name__}: every"))
