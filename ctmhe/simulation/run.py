"""The result of a run: trajectories, samples, solves and errors, with names and units; saved to NetCDF."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.errors import InputError
from ctmhe.types import Array, names_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

FORMAT = "ctmhe run 2"


class Run:
    """What happened in a simulated or replayed run.

    Attributes
    ----------
    dataset : xarray.Dataset
        On `time` (monitoring times, seconds): `x_true`, `x_online`, `x_retro` (and `x_delayed`, of an estimator with a
        delay) by state, `y` by output, `u` by input, `w` by disturbance, `level` of the trigger. On `event` (samples):
        `sample_time`, `gap`, `y_sampled`. On `solve` (estimates: one a sample, or a message that arrived):
        `solve_time`, `x_hat`, `p_hat`, `solve_seconds`, `cost`, `iterations`, `success`, `outcome`, `status`,
        `delivered`, `x_true_solve`; with a guarantee also its levels.
        Units are in the coordinates `state_unit`, ... and in attributes; how the run was made is in the dataset's
        attributes.
    """

    def __init__(self, dataset: xr.Dataset):
        self.dataset = dataset

    @property
    def t(self) -> Array:
        """Monitoring times in seconds, (n,)."""
        return self.dataset["time"].to_numpy()

    @property
    def sample_times(self) -> Array:
        """Sampling instants t_i in seconds, (samples,)."""
        return self.dataset["sample_time"].to_numpy()

    @property
    def gaps(self) -> Array:
        """Seconds between samples, the first counted from the start, (samples,)."""
        return self.dataset["gap"].to_numpy()

    @property
    def samples(self) -> int:
        """Number of samples taken."""
        return self.dataset.sizes["event"]

    @property
    def solves(self) -> int:
        """Number of estimation problems solved, or tried, by the estimator."""
        return self.dataset.sizes["solve"]

    @property
    def sensor_solves(self) -> int:
        """Number of those of the copy at the sensor, where the channel is not faithful (see `Network`)."""
        return int(self.dataset.attrs["sensor_solves"])

    @property
    def messages(self) -> int:
        """Number of messages sent, lost ones included: records together as the channel sends them."""
        return int(self.dataset.attrs["messages"])

    @property
    def messages_lost(self) -> int:
        """Number of messages that never arrived."""
        return int(self.dataset.attrs["messages_lost"])

    @property
    def bytes_sent(self) -> int:
        """Payload sent: 8 bytes for the time of a record and 8 (or the channel's own) for each value in it."""
        return int(self.dataset.attrs["bytes_sent"])

    @property
    def hushed(self) -> int:
        """How often guards were silenced until the next monitoring time, since they came back right after a sample."""
        return int(self.dataset.attrs["hushed"])

    @property
    def measurements(self) -> int:
        """Number of measurements (time points) that reached the estimator."""
        return int(self.dataset.attrs["measurements"])

    @property
    def too_late(self) -> int:
        """Number of measurements that arrived after the window had passed them."""
        return int(self.dataset.attrs["too_late"])

    @property
    def solve_seconds(self) -> Array:
        """Wall-clock time of every solve in seconds, (solves,)."""
        return self.dataset["solve_seconds"].to_numpy()

    @property
    def outcomes(self) -> Mapping[str, int]:
        """How many estimates came about in which way, such as `{"solved": 49, "predicted": 1}`; see `Outcome`."""
        names, counts = np.unique(self.dataset["outcome"].to_numpy().astype(str), return_counts=True)
        return {str(name): int(count) for name, count in zip(names, counts, strict=True)}

    def online_error(self) -> xr.DataArray:
        """Return the online error x_online - x_true on the monitoring times, by state."""
        return self._error("x_online")

    def retrospective_error(self) -> xr.DataArray:
        """Return the error of the estimated trajectory (3.16) on the monitoring times, by state."""
        return self._error("x_retro")

    def delayed_error(self) -> xr.DataArray:
        """Return the error of the delayed estimate (6.47) on the monitoring times, by state.

        NaN in the last `delay` seconds, which the run did not live to see, and where no solve came in time.

        Raises
        ------
        InputError
            For a run whose estimator had no delay, or whose true state is not known.
        """
        if "x_delayed" not in self.dataset:
            raise InputError("run: its estimator had no delay; build it with MHE(delay=seconds)")
        return self._error("x_delayed")

    def delayed_rms(self, state: str | Sequence[str] | None = None, *, since: float = -np.inf) -> float:
        """Return the same as `online_rms` for the delayed estimate (6.47), where there is one."""
        error = self.delayed_error() if state is None else self._error_of("x_delayed", names_of(state))
        values = error.to_numpy()[self.t >= since]
        known = np.isfinite(values).all(axis=1)
        if not known.any():
            raise InputError(f"run: there is no delayed estimate at or after since = {since!r} s")
        return float(np.sqrt(np.mean(np.sum(values[known] ** 2, axis=1))))

    def online_rms(self, state: str | Sequence[str] | None = None, *, since: float = -np.inf) -> float:
        """Return the root of the mean squared online error over the monitoring times.

        Parameters
        ----------
        state : str or sequence of str, optional
            One state's error in its unit; the Euclidean norm over several, or all when left out (numbers in their
            units).
        since : float
            Seconds; monitoring times before it are left out, such as those in which a wrong guess is corrected.

        Raises
        ------
        InputError
            When the true state is not known, as in a replayed log; for an unknown state; when the run ends before
            `since`.
        """
        return self._rms("x_online", state, since)

    def retrospective_rms(self, state: str | Sequence[str] | None = None, *, since: float = -np.inf) -> float:
        """Return the same for the estimated trajectory (3.16), which uses data up to the next sample."""
        return self._rms("x_retro", state, since)

    @property
    def ise(self) -> float:
        """Integrated squared error of the estimated trajectory (3.16): trapezoidal rule on the monitoring times."""
        squares = np.sum(self._error("x_retro").to_numpy() ** 2, axis=1)
        return float(np.trapezoid(squares, self.t))

    @property
    def certified_bound(self) -> xr.DataArray:
        """Guaranteed bound of |x_hat(t_i) - x(t_i)|_P_lower by Theorem 3.1 (3.32), on the solves.

        NaN where the theorem's conditions were not met; `uncertified` says why. See docs/guarantees.md.

        Raises
        ------
        InputError
            For a run whose estimator had no `Guarantee`.
        """
        return self._level("theorem_level")

    @property
    def window_bound(self) -> xr.DataArray:
        """Guaranteed bound of |x_hat(t_i) - x(t_i)|_P_lower from the windows' own costs (3.25), on the solves."""
        return self._level("window_level")

    @property
    def retrospective_bound(self) -> xr.DataArray:
        """Guaranteed bound of |x_hat - x|_P_lower along the estimated trajectory (3.20), on the monitoring times."""
        return self._level("retro_level")

    @property
    def uncertified(self) -> tuple[str, ...]:
        """Why Theorem 3.1 gives no bound, for every solve; an empty text where it does."""
        self._level("theorem_level")
        return tuple(str(text) for text in self.dataset["uncertified"].to_numpy())

    @property
    def error_size(self) -> xr.DataArray:
        """The true |x_hat(t_i) - x(t_i)|_P_lower on the solves, to be compared with the bounds."""
        self._level("theorem_level")
        n = self.dataset.sizes["state"]
        P = np.asarray(self.dataset.attrs["P_lower"], dtype=float).reshape(n, n)
        error = self.dataset["x_hat"] - self.dataset["x_true_solve"]
        squares = np.einsum("ki,ij,kj->k", error.to_numpy(), P, error.to_numpy())
        return error.isel(state=0, drop=True).copy(data=np.sqrt(squares))

    def _level(self, name: str) -> xr.DataArray:
        if name not in self.dataset:
            raise InputError("run: its estimator had no certificate; build it with MHE(guarantee=Guarantee(...))")
        levels = self.dataset[name]
        return levels.copy(data=np.sqrt(levels.to_numpy()))

    def to_pandas(self) -> pd.DataFrame:
        """Return a table over the monitoring times with columns `x_true.<state>`, ..., `y.<output>`, ..."""
        import pandas as pd

        columns = {}
        delayed = ("x_delayed",) if "x_delayed" in self.dataset else ()
        for variable in ("x_true", "x_online", "x_retro", *delayed, "y", "u", "w"):
            array = self.dataset[variable]
            names = array[array.dims[1]].to_numpy()
            columns |= {f"{variable}.{name}": array.to_numpy()[:, i] for i, name in enumerate(names)}
        return pd.DataFrame(columns, index=pd.Index(self.t, name="time"))

    def to_log(self) -> MeasurementLog:
        """Return what was sampled, and the inputs, as a record: for `replay`, `estimate_offline` and `regret`.

        A row at every monitoring time and every sample; outputs are missing (NaN) where none was taken.
        """
        times, data = np.union1d(self.t, self.sample_times), self.dataset
        y = np.full((len(times), data.sizes["output"]), np.nan)
        y[np.searchsorted(times, self.sample_times)] = data["y_sampled"].to_numpy()
        held = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, None)
        names = [tuple(map(str, data[kind].to_numpy())) for kind in ("output", "input")]
        return MeasurementLog(times, y, names[0], data["u"].to_numpy()[held], names[1])

    def events_to_pandas(self) -> pd.DataFrame:
        """Return a table over the samples: time, gap and outputs."""
        return self._along("event")

    def solves_to_pandas(self) -> pd.DataFrame:
        """Return a table over the solves: time, status, cost, iterations, seconds and estimates."""
        return self._along("solve")

    def _along(self, dim: str) -> pd.DataFrame:
        import pandas as pd

        columns: dict[str, Any] = {}
        for variable, array in self.dataset.data_vars.items():
            if array.dims == (dim,):
                columns[str(variable)] = array.to_numpy()
            elif array.dims and array.dims[0] == dim:
                names = array[array.dims[1]].to_numpy()
                columns |= {f"{variable}.{name}": array.to_numpy()[:, i] for i, name in enumerate(names)}
        return pd.DataFrame(columns)

    def save(self, path: str | Path) -> Path:
        """Write the run to a NetCDF file, in one atomic step, and return its path."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{uuid4().hex}")
        try:
            self.dataset.to_netcdf(temporary, engine="h5netcdf")
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        return path

    @classmethod
    def load(cls, path: str | Path) -> Run:
        """Read a run that `save` wrote.

        Raises
        ------
        InputError
            If there is no such file, or it is not a run.
        """
        if not Path(path).is_file():
            raise InputError(f"run: no file {str(path)!r}")
        try:
            import xarray as xr

            with xr.open_dataset(path, engine="h5netcdf") as stored:
                dataset = stored.load()
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"run: {str(path)!r} cannot be read as NetCDF: {error}") from error
        if dataset.attrs.get("format") != FORMAT:
            raise InputError(
                f"run: {str(path)!r} has format {dataset.attrs.get('format')!r}, this version reads {FORMAT!r}"
            )
        for variable in dataset.variables.values():
            variable.encoding = {}
        return cls(dataset)

    def plot(self, axes: Any = None) -> Any:
        """Draw states, outputs and samples; return the array of Axes. See `ctmhe.plotting.plot_run`."""
        from ctmhe.plotting import plot_run

        return plot_run(self.dataset, axes)

    def plot_bounds(self, axes: Any = None) -> Any:
        """Draw the guaranteed bounds beside the true error; return the Axes. See `ctmhe.plotting.plot_bounds`."""
        from ctmhe.plotting import plot_bounds

        return plot_bounds(self.dataset, axes)

    def __repr__(self) -> str:
        about, n = self.dataset.attrs, self.samples
        between = self.gaps[1:]
        rows = [
            f"Run of {about['plant']!r}, t = {self.t[0]:g} to {self.t[-1]:g} s ({about['integrator']})",
            f"  trigger: {about['trigger']}",
            f"  channel: {about['channel']}",
            f"  samples: {n}"
            + (f", gaps {between.min():.4g} to {between.max():.4g} s" if n > 1 else "" if n else ": it never fired")
            + f" ({about['location']})",
            f"  solves: {self.solves}" + "".join(f", {count} {name}" for name, count in self.outcomes.items()),
            f"  messages: {self.messages}, {self.bytes_sent} bytes"
            + f", {self.messages_lost} lost" * bool(self.messages_lost),
            f"  measurements: {self.measurements} delivered, {self.too_late} too late",
        ]
        if self.hushed:
            rows.append(f"  guards silenced {self.hushed} times: they came back right after a sample")
        if "theorem_level" in self.dataset and self.solves:
            met = int(np.isfinite(self.dataset["theorem_level"].to_numpy()).sum())
            known = int(np.isfinite(self.dataset["window_level"].to_numpy()).sum())
            rows.append(
                f"  guarantee ({about['certificate']}): Theorem 3.1 at {met} solves, a window's bound at {known}"
            )
        if self.solves:
            rows.append(f"  solve time: median {1e3 * np.median(self.solve_seconds):.3g} ms")
        if not np.isnan(self.dataset["x_true"].to_numpy()).any():
            rows.append(f"  rms error: {self.online_rms():.4g} online, {self.retrospective_rms():.4g} retrospective")
        return "\n".join(rows)

    def _error(self, variable: str) -> xr.DataArray:
        truth = self.dataset["x_true"]
        unknown = np.isnan(truth.to_numpy()).any(axis=0)
        if unknown.any():
            names = ", ".join(map(str, self.dataset["state"].to_numpy()[unknown]))
            raise InputError(f"run: the true value of {names} is not known (a replayed log, or another model's state)")
        return self.dataset[variable] - truth

    def _rms(self, variable: str, state: str | Sequence[str] | None, since: float) -> float:
        error = self._error(variable) if state is None else self._error_of(variable, names_of(state))
        late = self.t >= since
        if not late.any():
            raise InputError(f"run: no monitoring time at or after since = {since!r} s; the last is {self.t[-1]:g} s")
        return float(np.sqrt(np.mean(np.sum(error.to_numpy()[late] ** 2, axis=1))))

    def _error_of(self, variable: str, states: tuple[str, ...]) -> xr.DataArray:
        names = [str(name) for name in self.dataset["state"].to_numpy()]
        for state in states or ("",):
            if state not in names:
                raise InputError(f"unknown state {state!r}. Known: {', '.join(names)}")
        error = (self.dataset[variable] - self.dataset["x_true"]).sel(state=list(states))
        unknown = [state for state in states if np.isnan(self.dataset["x_true"].sel(state=state)).any()]
        if unknown:
            raise InputError(f"run: the true value of {', '.join(unknown)} is not known")
        return error
