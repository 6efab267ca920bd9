"""A solved window in two blocks of memory: what the core writes and reads, what the estimator keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import frombuffer

from ctmhe.transcription.problem import Guess
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Trajectory, frozen

Part = tuple[slice, tuple[int, ...]]
NONE = frozen([])
KEPT = 1000  # layouts for as many numbers of slots


class Layout:
    """Where each array of a solved window lies in its blocks, for one model and any number of slots.

    The order is that of `lay_out_result` in core/update.h.
    """

    def __init__(self, nx: int, nw: int, np: int, nu: int, ny: int, q: int):
        self.sizes = (nx, nw, np, nu, ny, q)
        self._known: dict[int, dict[str, Part]] = {}
        self._ends: dict[int, list[slice | None]] = {}

    @classmethod
    def of(cls, stage: StageFunction) -> Layout:
        """Return the layout of a model's windows."""
        return cls(stage.nx, stage.nw, stage.np, stage.nu, stage.ny, stage.q)

    def __reduce__(self) -> tuple[Any, ...]:
        return Layout, self.sizes

    def parts(self, n: int) -> dict[str, Part]:
        """Return slice and shape of every array of a window of n slots."""
        found = self._known.get(n)
        if found is None:
            if len(self._known) >= KEPT:
                self._known.clear()
            found = self._known[n] = self._lay_out(n)
        return found

    def _lay_out(self, n: int) -> dict[str, Part]:
        nx, nw, n_p, nu, ny, q = self.sizes
        x, w, y, p = (n + 1, nx), (n, nw), (n, ny), (n_p,)
        values = {
            "t": (n + 1,), "x": x, "w": w, "y": (n, q, ny), "u0": (n, nu), "u1": (n, nu), "p": p, "prior": (nx + n_p,),
            "dynamics_multiplier": (n, nx), "x_multiplier": x, "w_multiplier": w, "y_multiplier": y, "p_multiplier": p,
        }  # fmt: skip
        active = {"x_active": x, "w_active": w, "y_active": y, "p_active": p}
        parts: dict[str, Part] = {}
        for block, shapes in (("values", values), ("active", active)):
            start = 0
            for name, shape in shapes.items():
                stop = start + int(np.prod(shape))
                parts[name] = (slice(start, stop), shape)
                start = stop
            parts[block] = (slice(0, start), (start,))
        return parts

    def ends(self, n: int) -> list[slice | None]:
        """Return which bytes of the values hold x at the window's end, p, and w and y of the last slot, if any."""
        found = self._ends.get(n)
        if found is None:
            if len(self._ends) >= KEPT:
                self._ends.clear()
            nx, nw, n_p, _, ny, _ = self.sizes
            stops = (
                (self.parts(n)[name][0].stop, size) for name, size in (("x", nx), ("p", n_p), ("w", nw), ("y", ny))
            )
            found = self._ends[n] = [slice(8 * (stop - size), 8 * stop) if size else None for stop, size in stops]
        return found


@dataclass(frozen=True, eq=False, slots=True)
class Solved:
    """A window's solution, read-only.

    Attributes
    ----------
    n : int
        Slots.
    blocks : (bytes, bytes)
        float64 values and int8 active set, in the layout's order. Compiled code reads them where they are, so they are
        bytes: an array's address costs more than all that is done with it.
    layout : Layout
    """

    n: int
    blocks: tuple[bytes, bytes]
    layout: Layout

    @classmethod
    def of(cls, layout: Layout, arrays: dict[str, Any]) -> Solved:
        """Pack arrays by name; those left out are zero."""
        n = len(arrays["t"]) - 1
        parts = layout.parts(n)
        values, active = np.zeros(parts["values"][1]), np.zeros(parts["active"][1], np.int8)
        for name, array in arrays.items():
            if np.size(array):  # multipliers of bounds that are not there may be left empty
                block = active if name.endswith("_active") else values
                block[parts[name][0]] = np.reshape(array, -1)
        return cls.copied(layout, n, values, active)

    @classmethod
    def copied(cls, layout: Layout, n: int, values: Array, active: np.ndarray) -> Solved:
        """Copy the two blocks, float64 and int8."""
        return cls(n, (values.tobytes(), active.tobytes()), layout)

    def __reduce__(self) -> tuple[Any, ...]:
        return Solved, (self.n, self.blocks, self.layout)

    @property
    def values(self) -> Array:
        """The first block, a view."""
        return frombuffer(self.blocks[0])

    @property
    def active(self) -> np.ndarray:
        """The second block, a view."""
        return frombuffer(self.blocks[1], np.int8)

    def part(self, name: str) -> Array:
        """Return one array by its name, a read-only view."""
        where, shape = self.layout.parts(self.n)[name]
        return (self.active if name.endswith("_active") else self.values)[where].reshape(shape)

    def last(self) -> tuple[Array, Array, Array, Array]:
        """Return copies of x at the window's end, p, and w and y of the last slot."""
        block = self.blocks[0]
        x, p, w, y = [frombuffer(block[where]) if where else NONE for where in self.layout.ends(self.n)]
        return x, p, w, y

    @property
    def guess(self) -> Guess:
        """The decisions and their active set, as a solver starts from them."""
        return Guess(*(self.part(name) for name in ("x", "w", "p", "x_active", "w_active", "y_active", "p_active")))

    @property
    def trajectory(self) -> Trajectory:
        """The solution in the words of the public interface."""
        t, x, w, y, u0, u1, p = (self.part(name) for name in ("t", "x", "w", "y", "u0", "u1", "p"))
        return Trajectory(t, x, w, y[:, -1], u0, u1, p)
