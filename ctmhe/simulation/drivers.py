"""Signals bound to names: values on cells, in tables, or of functions, and the times at which they jump."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.models.signals import Signals
from ctmhe.types import Array

BLOCK = 256
"""Cells drawn at once; part of what a seed means, so never changed."""

EDGE = 1e-6
"""Fraction of a cell within which an instant counts as lying on the cell's edge."""


class Driver(Protocol):
    """A signal bound to names, defined for all times, that is smooth (for w: constant) between its jumps."""

    def next_jump(self, t: float) -> float:
        """Return the first jump after `t` in seconds, inf if none."""
        ...

    def segment(self, a: float, b: float) -> tuple[Array, Array]:
        """Return the values at the start and the end of [a, b], which has no jump inside."""
        ...


class Cells:
    """Random values by cell, drawn in blocks so that cell k of a name is the same whoever asks, in any order."""

    def __init__(self, signals: Signals, seed: int, interval: float, draw: Callable, offset: Array, scale: Array):
        self.keys = [(seed, crc32(name.encode())) for name in signals.names]
        self.interval, self.draw = float(interval), draw
        self.offset, self.scale = offset, scale
        self.blocks: dict[int, Array] = {}

    def next_jump(self, t: float) -> float:
        """Return the first jump after `t`."""
        return (np.floor(t / self.interval + EDGE) + 1) * self.interval

    def segment(self, a: float, b: float) -> tuple[Array, Array]:
        """Return the values at both ends of [a, b]."""
        block, row = divmod(int(np.floor(0.5 * (a + b) / self.interval)), BLOCK)
        if block not in self.blocks:
            if len(self.blocks) >= 8:
                self.blocks.pop(next(iter(self.blocks)))
            self.blocks[block] = np.column_stack(
                [self.draw(np.random.default_rng([*key, block % 2**32])) for key in self.keys]
            )
        value = self.offset + self.scale * self.blocks[block][row]
        return value, value


class Sampled:
    """A function of time, held on cells at its value at their start plus `shift` cells."""

    def __init__(self, function: Callable[[float], ArrayLike], signals: Signals, interval: float, shift: float):
        self.function, self.signals, self.interval, self.shift = function, signals, float(interval), shift

    def next_jump(self, t: float) -> float:
        """Return the first jump after `t`."""
        return (np.floor(t / self.interval + EDGE) + 1) * self.interval

    def segment(self, a: float, b: float) -> tuple[Array, Array]:
        """Return the values at both ends of [a, b]."""
        at = (np.floor(0.5 * (a + b) / self.interval) + self.shift) * self.interval
        value = self.signals.vector(self.function(at), f"{self.signals.kind} function at t = {at:g}")
        return value, value


class Table:
    """Values at given times, held or linear in between."""

    def __init__(self, t: Array, rows: Array, linear: bool):
        self.t, self.rows, self.linear = t, rows, linear

    def next_jump(self, t: float) -> float:
        """Return the first jump after `t`."""
        if len(self.t) == 1:
            return np.inf
        k = int(np.searchsorted(self.t, t + EDGE * self._gap(t), side="right"))
        return float(self.t[k]) if k < len(self.t) else np.inf

    def segment(self, a: float, b: float) -> tuple[Array, Array]:
        """Return the values at both ends of [a, b]."""
        last = len(self.t) - 1
        k = int(np.searchsorted(self.t, 0.5 * (a + b), side="right")) - 1
        if not self.linear or k < 0 or k == last:
            value = self.rows[min(max(k, 0), last)]
            return value, value
        share = (np.clip([a, b], self.t[k], self.t[k + 1]) - self.t[k]) / (self.t[k + 1] - self.t[k])
        step = self.rows[k + 1] - self.rows[k]
        return self.rows[k] + share[0] * step, self.rows[k] + share[1] * step

    def _gap(self, t: float) -> float:
        k = int(np.clip(np.searchsorted(self.t, t), 1, len(self.t) - 1))
        return float(self.t[k] - self.t[k - 1])


class Joined:
    """One driver for each of some signals, zero for the others."""

    def __init__(self, size: int, parts: list[tuple[int, Driver]]):
        self.size, self.parts = size, parts

    def next_jump(self, t: float) -> float:
        """Return the first jump after `t`."""
        return min((driver.next_jump(t) for _, driver in self.parts), default=np.inf)

    def segment(self, a: float, b: float) -> tuple[Array, Array]:
        """Return the values at both ends of [a, b]."""
        value = np.zeros(self.size)
        for index, driver in self.parts:
            value[index] = driver.segment(a, b)[0][0]
        return value, value
