"""A solved window in two blocks of memory: what the core writes, what the estimator keeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.transcription.problem import Guess
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, Trajectory

Part = tuple[slice, tuple[int, ...]]
KEPT = 1000  # layouts for as many numbers of slots


class Layout:
    """Where each array of a solved window lies in its blocks, for one model and any number of slots.

    The order is that of `lay_out_result` in core/update.h.
    """

    def __init__(self, nx: int, nw: int, np: int, nu: int, ny: int, q: int):
        self.sizes = (nx, nw, np, nu, ny, q)
        self._known: dict[int, dict[str, Part]] = {}

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


@dataclass(frozen=True, eq=False, slots=True)
class Solved:
    """A window's solution, read-only.

    Attributes
    ----------
    n : int
        Slots.
    values, active : array
        Blocks of float64 and int8.
    layout : Layout
    """

    n: int
    values: Array
    active: np.ndarray
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
        return cls.closed(layout, n, values, active)

    @classmethod
    def closed(cls, layout: Layout, n: int, values: Array, active: np.ndarray) -> Solved:
        """Take two blocks over, as they are, and make them read-only."""
        values.flags.writeable = active.flags.writeable = False
        return cls(n, values, active, layout)

    def __reduce__(self) -> tuple[Any, ...]:
        return Solved.closed, (self.layout, self.n, self.values, self.active)

    @property
    def addresses(self) -> tuple[int, int, int]:
        """Addresses of the two blocks, and n: what compiled code reads."""
        return self.values.ctypes.data, self.active.ctypes.data, self.n

    def part(self, name: str) -> Array:
        """Return one array by its name, a read-only view."""
        where, shape = self.layout.parts(self.n)[name]
        return (self.active if name.endswith("_active") else self.values)[where].reshape(shape)

    def last(self) -> tuple[Array, Array, Array, Array]:
        """Return copies of x at the window's end, p, and w and y of the last slot."""
        parts, values = self.layout.parts(self.n), self.values
        nx, nw, _, _, ny, _ = self.layout.sizes
        found = []
        for name, size in (("x", nx), ("p", None), ("w", nw), ("y", ny)):
            where = parts[name][0]
            array = values[where if size is None else slice(where.stop - size, where.stop)].copy()
            array.flags.writeable = False
            found.append(array)
        return tuple(found)  # type: ignore[return-value]

    @property
    def guess(self) -> Guess:
        """The decisions and their active set, as a solver starts from them."""
        return Guess(*(self.part(name) for name in ("x", "w", "p", "x_active", "w_active", "y_active", "p_active")))

    @property
    def trajectory(self) -> Trajectory:
        """The solution in the words of the public interface."""
        t, x, w, y, u0, u1, p = (self.part(name) for name in ("t", "x", "w", "y", "u0", "u1", "p"))
        return Trajectory(t, x, w, y[:, -1], u0, u1, p)
