"""Signals that drive a plant: seeded disturbance and noise, recorded signals, and known inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import InputError
from ctmhe.models.signals import Signals
from ctmhe.simulation.drivers import BLOCK, Cells, Driver, Joined, Sampled, Table
from ctmhe.types import Array, Input, Values, frozen


class Process(Protocol):
    """A description of a signal, which becomes values once names and a seed are known."""

    def bind(self, signals: Signals, seed: int) -> Driver:
        """Return the signal for `signals`; the same seed and name give the same values, whoever asks."""
        ...


@dataclass(frozen=True, eq=False)
class Uniform:
    """Independent uniform values, held on the cells [k * interval, (k + 1) * interval).

    Parameters
    ----------
    bound : float or array (n,), optional
        Values lie in [-bound, bound], in the signals' units. Or give `low` and `high`.
    interval : float
        Length of a cell in seconds.
    low, high : float or array (n,), optional
    """

    bound: ArrayLike | None = None
    interval: float = 0.01
    low: ArrayLike | None = None
    high: ArrayLike | None = None

    def __post_init__(self) -> None:
        if (self.bound is None) == (self.low is None) or (self.low is None) != (self.high is None):
            raise InputError("Uniform: give bound, or low and high")
        _check_interval("Uniform", self.interval)

    def bind(self, signals: Signals, seed: int) -> Driver:
        """Return the signal for `signals` under `seed`."""
        low, high = (-np.asarray(self.bound), self.bound) if self.low is None else (self.low, self.high)
        lower, upper = (_spread(value, signals, "Uniform") for value in (low, high))
        if not (lower <= upper).all():
            worst = signals.names[int(np.flatnonzero(~(lower <= upper))[0])]
            raise InputError(f"Uniform: {worst!r} has its lower limit above the upper one")
        return Cells(signals, seed, self.interval, lambda rng: rng.random(BLOCK), lower, upper - lower)


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal values of mean zero, held on the cells [k * interval, (k + 1) * interval).

    Parameters
    ----------
    std : float or array (n,)
        Standard deviation in the signals' units. White noise of intensity S is approached with std^2 = S / interval.
    interval : float
        Length of a cell in seconds.
    """

    std: ArrayLike
    interval: float = 0.01

    def __post_init__(self) -> None:
        _check_interval("Gaussian", self.interval)

    def bind(self, signals: Signals, seed: int) -> Driver:
        """Return the signal for `signals` under `seed`."""
        std = _spread(self.std, signals, "Gaussian")
        if not (std >= 0).all():
            raise InputError(f"Gaussian: std must be >= 0, got {self.std!r}")
        draw: Callable[[np.random.Generator], Array] = lambda rng: rng.standard_normal(BLOCK)  # noqa: E731
        return Cells(signals, seed, self.interval, draw, np.zeros(len(signals)), std)


@dataclass(frozen=True, eq=False)
class Waveform:
    """A function of time, held on the cells [k * interval, (k + 1) * interval) at its value in their middle.

    Parameters
    ----------
    function : callable t -> float or array (n,)
        In the signals' units, t in seconds.
    interval : float
        Length of a cell in seconds.
    """

    function: Callable[[float], ArrayLike]
    interval: float = 0.01

    def __post_init__(self) -> None:
        _check_interval("Waveform", self.interval)

    def bind(self, signals: Signals, seed: int) -> Driver:
        """Return the signal for `signals`; the seed plays no part."""
        return Sampled(self.function, signals, self.interval, shift=0.5)


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recorded signal. Before the first time the first value holds, after the last the last.

    Parameters
    ----------
    t : array (N,)
        Strictly increasing times in seconds.
    values : array (N,) or (N, n), or mapping name -> array (N,)
        In the signals' units; a mapping leaves signals it does not name at zero.
    hold : {"zero", "linear"}
        Each value holds until the next, or the signal is linear in between (inputs only).
    """

    t: ArrayLike
    values: ArrayLike | Mapping[str, ArrayLike]
    hold: str = "zero"

    def __post_init__(self) -> None:
        t = frozen(np.atleast_1d(np.asarray(self.t, dtype=float)))
        if t.ndim != 1 or not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
            raise InputError("Recorded: t must be finite and strictly increasing, at least one time")
        if self.hold not in ("zero", "linear"):
            raise InputError(f"Recorded: hold must be 'zero' or 'linear', got {self.hold!r}")
        object.__setattr__(self, "t", t)

    def bind(self, signals: Signals, seed: int) -> Driver:
        """Return the signal for `signals`; the seed plays no part."""
        t = np.asarray(self.t, dtype=float)
        if isinstance(self.values, Mapping):
            rows = np.zeros((len(t), len(signals)))
            for name, column in self.values.items():
                rows[:, signals.index(name)] = _rows(column, len(t), 1, name)[:, 0]
        else:
            rows = _rows(self.values, len(t), len(signals), ", ".join(signals.names))
        return Table(t, frozen(rows), linear=self.hold == "linear")


Drive = Process | Mapping[str, Process | float] | None
Inputs = Process | Callable[[float], ArrayLike] | Sequence[Input] | Values | None


def bind_disturbance(drive: Drive, signals: Signals, seed: int) -> Driver:
    """Return the disturbance of a plant: one process for all signals, or one for each name, zero where none is."""
    if drive is None:
        return Table(np.zeros(1), np.zeros((1, len(signals))), linear=False)
    if isinstance(drive, Mapping):
        parts: list[tuple[int, Driver]] = []
        for name, process in drive.items():
            index = signals.index(name)
            one = _one(signals, index)
            if isinstance(process, (int, float)):
                parts.append((index, Recorded([0.0], [process]).bind(one, seed)))
            else:
                parts.append((index, _bind(process, one, seed)))
        return Joined(len(signals), parts)
    if not hasattr(drive, "bind"):
        raise InputError(
            f"disturbance: expected a process such as Uniform(0.1), or a mapping from {signals.kind} name to one; got "
            f"{drive!r}. Signals: {', '.join(signals.names) or 'none'}"
        )
    if not len(signals):
        raise InputError("disturbance: the plant has no disturbance signals; leave disturbance out")
    return _bind(drive, signals, seed)


def bind_inputs(inputs: Inputs, signals: Signals, monitor: float) -> Driver:
    """Return the known inputs: constant, a list of `Input` (held), a `Recorded`, or a function of time.

    A function is sampled at the multiples of `monitor` and held, as a digital controller would.
    """
    if inputs is None or (isinstance(inputs, (list, tuple)) and not len(inputs)):
        if len(signals):
            raise InputError(
                f"inputs: the plant has {len(signals)} ({', '.join(signals.names)}); give inputs= as values, a "
                "function of time, a list of Input, or Recorded"
            )
        return Table(np.zeros(1), np.zeros((1, 0)), linear=False)
    if hasattr(inputs, "bind"):
        return inputs.bind(signals, 0)  # type: ignore[union-attr]
    if callable(inputs):
        return Sampled(inputs, signals, monitor, shift=0.0)
    if isinstance(inputs, (list, tuple)) and isinstance(inputs[0], Input):
        if not all(isinstance(item, Input) for item in inputs):
            raise InputError("inputs: a list must hold Input values only")
        switches: list[Any] = list(inputs)
        ordered = sorted(switches, key=lambda item: item.t)
        rows = [signals.vector(item.u, f"inputs at t = {item.t:g}") for item in ordered]
        return Recorded([item.t for item in ordered], np.array(rows)).bind(signals, 0)
    return Table(np.zeros(1), signals.vector(inputs, "inputs").reshape(1, -1), linear=False)


def seed_of(seed: int | np.random.Generator) -> int:
    """Return a seed as a non-negative integer; a generator is asked for one."""
    if isinstance(seed, np.random.Generator):
        return int(seed.integers(2**63))
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"seed must be a non-negative integer or a numpy Generator, got {seed!r}")
    return int(seed)


def _bind(process: Process, signals: Signals, seed: int) -> Driver:
    if isinstance(process, Recorded) and process.hold == "linear":
        raise InputError(
            "disturbance: a plant holds w constant between its jumps; give Recorded with hold='zero' on a fine grid, "
            "or Waveform"
        )
    return process.bind(signals, seed)


def _one(signals: Signals, index: int) -> Signals:
    chosen = slice(index, index + 1)
    return Signals(signals.kind, signals.names[chosen], signals.units[chosen], frozen(signals.nominal[chosen]))


def _spread(value: Any, signals: Signals, what: str) -> Array:
    """Return one number for each signal, finite."""
    array = np.asarray(value, dtype=float)
    return signals.vector(np.full(len(signals), array.item()) if array.size == 1 else array, what)


def _rows(values: Any, n: int, width: int, names: str) -> Array:
    rows = np.asarray(values, dtype=float)
    rows = rows.reshape(-1, 1) if rows.ndim == 1 else rows
    if rows.shape != (n, width):
        raise InputError(f"Recorded: expected values of shape ({n}, {width}) for {names}, got {rows.shape}")
    if not np.isfinite(rows).all():
        raise InputError(f"Recorded: values of {names} are not all finite")
    return rows


def _check_interval(what: str, interval: float) -> None:
    if not (np.isfinite(interval) and interval > 0):
        raise InputError(f"{what}: interval must be a positive number of seconds, got {interval!r}")
