"""Time-ordered records: a persistent log inside the estimator's state, and recorded logs from files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array, address, frozen

SMALLEST = 64  # rows for which a log has room at least


class _Shared:
    """Storage that several versions of a log share: appending at its very end copies nothing."""

    __slots__ = ("addresses", "count", "lock", "rows", "times")

    def __init__(self, times: Array, rows: Array, capacity: int):
        """Copy times (n,) and rows (n, width) to where `capacity` of them have room."""
        self.count, width = rows.shape
        block = np.empty(capacity * (1 + width))
        self.times, self.rows = block[:capacity], block[capacity:].reshape(capacity, width)
        self.times[: self.count], self.rows[: self.count] = times, rows
        start = address(block)
        self.addresses = (start, start + 8 * capacity)
        self.lock = Lock()


class Log:
    """An immutable, time-ordered sequence of rows; `put` returns a new log.

    Appending at the end is O(1) amortised and shares storage between versions; a late row copies what is left of the
    window. Old versions stay valid: this is what lets the estimator's state be explicit.

    Attributes
    ----------
    width : int
    last_time : float
        Time of the newest row, -inf when empty.
    """

    __slots__ = ("_shared", "_start", "_stop", "last_time", "width")

    def __init__(self, width: int, _shared: _Shared | None = None, _start: int = 0, _stop: int = 0):
        self.width = width
        self._shared = _Shared(np.empty(0), np.empty((0, width)), SMALLEST) if _shared is None else _shared
        self._start, self._stop = _start, _stop
        self.last_time: float = self._shared.times.item(_stop - 1) if _stop > _start else -inf

    @classmethod
    def of(cls, times: Sequence[float] | Array, rows: Array, width: int) -> Log:
        """Build from ordered times (n,) and rows (n, width)."""
        count = len(times)
        return cls(width, _Shared(np.asarray(times), np.reshape(rows, (count, width)), max(SMALLEST, count)), 0, count)

    def __reduce__(self) -> tuple[Any, ...]:
        return Log.of, (*self.arrays(), self.width)

    def __len__(self) -> int:
        return self._stop - self._start

    @property
    def memory(self) -> tuple[int, int, int]:
        """Addresses of the first time and of the first row, and the number of rows: what compiled code reads."""
        times, rows = self._shared.addresses
        return times + 8 * self._start, rows + 8 * self.width * self._start, self._stop - self._start

    @property
    def capacity(self) -> int:
        """Rows that the storage behind this log has room for."""
        return len(self._shared.times)

    def find(self, t: float) -> Array | None:
        """Return the row at exactly `t` (a copy), or None."""
        if t > self.last_time:
            return None
        i = self._position(t)
        return self._shared.rows[i].copy() if i < self._stop and self._shared.times[i] == t else None

    def count_until(self, until: float, *, beyond: int = 0) -> int:
        """Return the number of rows up to and including `until`, and `beyond` rows after it, as far as there are."""
        if until >= self.last_time:
            return self._stop - self._start
        return min(self._position(until, "right") + beyond, self._stop) - self._start

    def first_from(self, t: float) -> tuple[float, Array] | None:
        """Return time and row (a copy) of the first row at or after `t`, or None."""
        i = self._position(t)
        return (self._shared.times.item(i), self._shared.rows[i].copy()) if i < self._stop else None

    def put(self, t: float, row: Array) -> Log:
        """Return a log that also holds `row` at `t`, in place of a row at exactly the same time."""
        if t > self.last_time:
            shared, start, stop = self._room(1)
            shared.times[stop], shared.rows[stop] = t, row
            return Log(self.width, shared, start, stop + 1)
        i = self._position(t)
        behind = i + 1 if i < self._stop and self._shared.times[i] == t else i
        times, rows = self._shared.times, self._shared.rows
        parts = (slice(self._start, i), slice(behind, self._stop))
        return Log.of(
            np.concatenate([times[parts[0]], [t], times[parts[1]]]),
            np.concatenate([rows[parts[0]], np.reshape(row, (1, -1)), rows[parts[1]]]),
            self.width,
        )

    def extend(self, times: Array, rows: Array) -> Log:
        """Return a log with ordered rows (n, width) appended, none of them before the last one."""
        count = len(times)
        if not count:
            return self
        shared, start, stop = self._room(count)
        shared.times[stop : stop + count], shared.rows[stop : stop + count] = times, rows
        return Log(self.width, shared, start, stop + count)

    def _room(self, count: int) -> tuple[_Shared, int, int]:
        """Return storage with room for `count` rows behind those of this log, and where they start and stop in it."""
        shared, start, stop = self._shared, self._start, self._stop
        with shared.lock:
            fits = stop == shared.count and stop + count <= len(shared.times)
            if fits:
                shared.count = stop + count
        if not fits:  # another version wrote behind this one, or there is no room: go on in storage of our own
            live = slice(start, stop)
            capacity = max(SMALLEST, 2 * (stop - start + count))
            shared = _Shared(shared.times[live], shared.rows[live], capacity)
            start, stop = 0, shared.count
            shared.count += count
        return shared, start, stop

    def _position(self, t: float, side: Literal["left", "right"] = "left") -> int:
        return self._start + int(self._shared.times[self._start : self._stop].searchsorted(t, side))

    def drop_before(self, t: float, *, keep_holding: bool = False) -> Log:
        """Return the log without rows older than `t`; `keep_holding` keeps the last of them, which still holds."""
        shared, start, stop = self._shared, self._start, self._stop
        time = shared.times.item
        while start < stop and time(start) < t:  # one by one: mostly one or two, and each row goes once
            start += 1
        if keep_holding and start > self._start and (start == stop or time(start) > t):
            start -= 1
        if start == self._start:
            return self
        if len(shared.times) > max(SMALLEST, 8 * (stop - start)):  # do not keep what is long gone
            shared = _Shared(shared.times[start:stop], shared.rows[start:stop], max(SMALLEST, 2 * (stop - start)))
            start, stop = 0, shared.count
        return Log(self.width, shared, start, stop)

    def drop_after(self, t: float) -> Log:
        """Return the log without rows newer than `t`."""
        stop = self._position(t, "right")
        return Log(self.width, self._shared, self._start, stop) if stop < self._stop else self

    def arrays(self, until: float = inf, *, beyond: int = 0) -> tuple[Array, Array]:
        """Return times (n,) and rows (n, width) up to and including `until`, and `beyond` rows after it."""
        stop = self._start + self.count_until(until, beyond=beyond)
        return self._shared.times[self._start : stop].copy(), self._shared.rows[self._start : stop].copy()


@dataclass(frozen=True, eq=False)
class MeasurementLog:
    """A recorded experiment: what the sensors said, and the known inputs, against time.

    Attributes
    ----------
    t : array (n,)
        Strictly increasing times in seconds.
    y : array (n, ny)
        Outputs; NaN where a sensor has no value.
    outputs : tuple of str
        Names of the columns of `y`.
    u : array (n, nu)
        Known inputs, (n, 0) when there are none.
    inputs : tuple of str
        Names of the columns of `u`.
    units : mapping name -> unit
    """

    t: Array
    y: Array
    outputs: tuple[str, ...]
    u: Array
    inputs: tuple[str, ...] = ()
    units: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        t = frozen(np.atleast_1d(self.t))
        y, u = frozen(np.reshape(self.y, (len(t), -1))), frozen(np.reshape(self.u, (len(t), len(self.inputs))))
        if y.shape[1] != len(self.outputs):
            raise InputError(f"log: {y.shape[1]} output columns but {len(self.outputs)} names")
        if not len(t):
            raise InputError("log: no rows")
        if not np.isfinite(t).all():
            raise InputError(f"log: time is not finite in row {int(np.flatnonzero(~np.isfinite(t))[0])}")
        if (np.diff(t) <= 0).any():
            row = int(np.flatnonzero(np.diff(t) <= 0)[0]) + 1
            raise InputError(f"log: times must increase strictly; row {row} has t = {t[row]} after {t[row - 1]}")
        for table, names, allow_nan in ((y, self.outputs, True), (u, self.inputs, False)):
            bad = np.isinf(table) | (np.isnan(table) & (not allow_nan))
            if bad.any():
                row, column = (int(i[0]) for i in np.nonzero(bad))
                raise InputError(
                    f"log: {names[column]!r} is {table[row, column]} at t = {t[row]}; leave missing outputs empty, "
                    "fill missing inputs before loading"
                )
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "y", y)
        object.__setattr__(self, "u", u)

    def __len__(self) -> int:
        return len(self.t)

    @classmethod
    def from_dataframe(
        cls,
        frame: Any,
        *,
        outputs: Sequence[str] | Mapping[str, str],
        inputs: Sequence[str] | Mapping[str, str] = (),
        time: str = "t",
        time_unit: str = "s",
        units: Mapping[str, str] | None = None,
    ) -> MeasurementLog:
        """Build from a pandas DataFrame.

        Parameters
        ----------
        frame : DataFrame
            One row an instant. Dates, or texts of dates in ISO 8601, are read as seconds since the first row.
        outputs, inputs : names, or mapping signal name -> column name
        time : str
            The time column.
        time_unit : {"s", "ms", "us", "min", "h"}
            Unit of the time column; times are converted to seconds.
        units : mapping signal name -> unit, optional

        Raises
        ------
        InputError
            For missing columns, times that do not increase, values that are not numbers.
        """
        import pandas as pd

        seconds = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0}
        if time_unit not in seconds:
            raise InputError(f"time_unit must be one of {', '.join(seconds)}, got {time_unit!r}")
        columns = [_as_mapping(names) for names in (outputs, inputs)]
        for column in (time, *columns[0].values(), *columns[1].values()):
            if column not in frame.columns:
                raise InputError(f"log: no column {column!r}. Columns: {', '.join(map(str, frame.columns))}")
        stamps = _stamps(frame[time], time)
        if pd.api.types.is_datetime64_any_dtype(stamps):
            t = (stamps - stamps.iloc[0]).dt.total_seconds().to_numpy()
        else:
            t = _numbers(stamps, time) * seconds[time_unit]
        y, u = (
            np.column_stack([_numbers(frame[c], c) for c in names.values()]) if names else np.empty((len(t), 0))
            for names in columns
        )
        return cls(t, y, tuple(columns[0]), u, tuple(columns[1]), dict(units or {}))

    @classmethod
    def from_csv(cls, path: str | Path, **columns: Any) -> MeasurementLog:
        """Read a CSV file with a header line; keywords as for `from_dataframe`."""
        import pandas as pd

        try:
            frame = pd.read_csv(path)
        except FileNotFoundError:
            raise InputError(f"log: no file {str(path)!r}") from None
        except Exception as error:
            raise InputError(f"log: {str(path)!r} cannot be read as CSV: {error}") from error
        return cls.from_dataframe(frame, **columns)


def _as_mapping(names: Sequence[str] | Mapping[str, str]) -> dict[str, str]:
    if isinstance(names, Mapping):
        return dict(names)
    return {name: name for name in ([names] if isinstance(names, str) else names)}


def _stamps(column: Any, name: str) -> Any:
    """Return a time column, as dates where it holds texts of dates: CSV files know no other."""
    import pandas as pd

    if pd.api.types.is_datetime64_any_dtype(column):
        return column
    try:
        return pd.to_numeric(column)
    except (TypeError, ValueError):
        pass  # no numbers: dates, or an error below
    try:
        return pd.to_datetime(column, format="ISO8601", utc=True)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"log: time column {name!r} holds neither numbers nor dates like 2025-01-31 08:15:00: {error}"
        ) from None


def _numbers(column: Any, name: str) -> Array:
    import pandas as pd

    try:
        return np.asarray(pd.to_numeric(column), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"log: column {name!r} holds values that are not numbers: {error}") from None
