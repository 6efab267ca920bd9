"""Time-ordered records: a persistent log inside the estimator's state, and recorded logs from files."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from ctmhe.errors import InputError
from ctmhe.types import Array, frozen


class _Shared:
    """Storage that several versions of a log share: appending at its very end copies nothing."""

    __slots__ = ("lock", "rows", "times")

    def __init__(self, times: list[float], rows: list[Array]):
        self.times, self.rows, self.lock = times, rows, Lock()


class Log:
    """An immutable, time-ordered sequence of rows; `put` returns a new log.

    Appending at the end is O(1) amortised and shares storage between versions; a late row copies what is left of the
    window. Old versions stay valid: this is what lets the estimator's state be explicit.
    """

    __slots__ = ("_shared", "_start", "_stop", "width")

    def __init__(self, width: int, _shared: _Shared | None = None, _start: int = 0, _stop: int = 0):
        self.width = width
        self._shared = _shared or _Shared([], [])
        self._start, self._stop = _start, _stop

    @classmethod
    def of(cls, times: Sequence[float] | Array, rows: Array, width: int) -> Log:
        """Build from ordered times (n,) and rows (n, width)."""
        return cls(width, _Shared([float(t) for t in times], [frozen(row) for row in rows]), 0, len(times))

    def __reduce__(self) -> tuple[Any, ...]:
        return Log.of, (*self.arrays(), self.width)

    def __len__(self) -> int:
        return self._stop - self._start

    @property
    def last_time(self) -> float:
        """Time of the newest row, -inf when empty."""
        return self._shared.times[self._stop - 1] if len(self) else -np.inf

    def find(self, t: float) -> Array | None:
        """Return the row at exactly `t`, or None."""
        i = bisect_left(self._shared.times, t, self._start, self._stop)
        return self._shared.rows[i] if i < self._stop and self._shared.times[i] == t else None

    def put(self, t: float, row: Array) -> Log:
        """Return a log that also holds `row` at `t`, in place of a row at exactly the same time."""
        shared = self._shared
        if not len(self) or t > shared.times[self._stop - 1]:
            with shared.lock:
                if self._stop == len(shared.times):
                    shared.times.append(t)
                    shared.rows.append(row)
                    return Log(self.width, shared, self._start, self._stop + 1)
        times, rows = shared.times[self._start : self._stop], shared.rows[self._start : self._stop]
        i = bisect_left(times, t)
        if i < len(times) and times[i] == t:
            rows[i] = row
        else:
            times.insert(i, t)
            rows.insert(i, row)
        return Log(self.width, _Shared(times, rows), 0, len(times))

    def drop_before(self, t: float, *, keep_holding: bool = False) -> Log:
        """Return the log without rows older than `t`; `keep_holding` keeps the last of them, which still holds."""
        start = bisect_left(self._shared.times, t, self._start, self._stop)
        if keep_holding and start > self._start and (start == self._stop or self._shared.times[start] > t):
            start -= 1
        if start > max(64, 2 * (self._stop - start)):
            shared = _Shared(self._shared.times[start : self._stop], self._shared.rows[start : self._stop])
            return Log(self.width, shared, 0, len(shared.times))
        return Log(self.width, self._shared, start, self._stop)

    def arrays(self, until: float = np.inf, *, beyond: int = 0) -> tuple[Array, Array]:
        """Return times (n,) and rows (n, width) up to and including `until`, and `beyond` rows after it."""
        stop = min(bisect_right(self._shared.times, until, self._start, self._stop) + beyond, self._stop)
        times = np.array(self._shared.times[self._start : stop])
        rows = self._shared.rows[self._start : stop]
        return times, np.array(rows) if rows else np.empty((0, self.width))


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
            One row an instant. Datetime columns are read as seconds since the first row.
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
        stamps = frame[time]
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


def _numbers(column: Any, name: str) -> Array:
    import pandas as pd

    try:
        return np.asarray(pd.to_numeric(column), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"log: column {name!r} holds values that are not numbers: {error}") from None
