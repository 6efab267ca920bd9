"""The bounds of a simulated run beside what truly happened: how close does it come to (3.20) and (3.32)?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.certificates.certificate import DetectabilityCertificate
from ctmhe.errors import InputError
from ctmhe.estimators.guaranteed import measurement_noise
from ctmhe.models.continuous import Model
from ctmhe.simulation.run import Run
from ctmhe.types import Array

if TYPE_CHECKING:
    import xarray as xr


def audit(run: Run, model: Model, certificate: DetectabilityCertificate, *, candidate: Any = None) -> xr.Dataset:
    """Evaluate both sides of (3.20) and (3.32) with the true error and the true disturbance.

    The measured signal is held between its records, so that the truth explains it only together with a measurement
    noise that makes up for what happened in between. That noise is used: the rows of w that enter outputs only must be
    able to produce it.

    Parameters
    ----------
    run : Run
        Simulated with a plant of the same states and disturbances as `model`, under `WholeSignal()` or `Everything()`
        with records at monitoring times, by an estimator with a `Guarantee`.
    model : Model
    certificate : DetectabilityCertificate
        For the estimator's weights.
    candidate : callable t (n,) -> states (n, nx), optional
        A negative control, such as an open loop, in place of the estimates; its window errors are its own.

    Returns
    -------
    xarray.Dataset
        On `solve`: `error` |x_hat - x|^2_P_lower; `window`, the right side of (3.20) at the solve with the true error
        at the window's start, and `theorem`, that of (3.32) with the true initial error, NaN where waits exceed (3.29);
        `window_ratio`, `theorem_ratio`: left over right side, the first at its worst over the window's piece of the
        trajectory. Above one, the bound is broken.

    Raises
    ------
    InputError
        When the truth is not known, or nothing in w can stand for the measurement noise.
    """
    import xarray as xr

    data = run.dataset
    if "window_start" not in data:
        raise InputError("audit: the run's estimator had no certificate; build it with MHE(guarantee=Guarantee(...))")
    if data["x_true"].isnull().any():
        raise InputError("audit: the true state is not known (a replayed log, or a plant with other states)")
    if data.attrs["holds"] not in ("zero", "point" if model.step else "zero"):
        raise InputError(f"audit: outputs are held by hold={data.attrs['holds']!r}; it knows 'zero' only")
    truth = _Truth(run, model, certificate)
    solve_time, start = data["solve_time"].to_numpy(), data["window_start"].to_numpy()
    x_hat, x_prior = data["x_hat"].to_numpy(), data["x_prior"].to_numpy()
    times, x_retro = run.t, data["x_retro"].to_numpy()
    guess = data["x_online"].to_numpy()[0]
    if candidate is not None:
        x_hat, x_prior, x_retro = (np.asarray(candidate(t), dtype=float) for t in (solve_time, start, times))
    n, unit, eta = len(solve_time), certificate.step or 1.0, certificate.eta
    columns = {name: np.full(n, np.nan) for name in ("error", "window", "theorem", "window_ratio", "theorem_ratio")}
    x_true = data["x_true_solve"].to_numpy()
    horizon, begin = float(data.attrs["horizon"]), float(times[0])
    first = _square(guess - data["x_true"].to_numpy()[0], certificate.P_upper)
    gaps = np.diff(solve_time, prepend=begin)
    for i, (t, a) in enumerate(zip(solve_time, start, strict=True)):
        columns["error"][i] = error = _square(x_hat[i] - x_true[i], certificate.P_lower)
        fade = eta ** ((t - a) / unit)
        inside = 4 * (fade * _square(x_prior[i] - truth.state(a), certificate.P_upper) + truth.energy(a, t, eta))
        columns["window"][i] = inside
        piece = (times > (solve_time[i - 1] if i else begin)) & (times <= t + 1e-12)
        left = [error, *(_square(x_retro[k] - truth.known[k], certificate.P_lower) for k in np.flatnonzero(piece))]
        ahead = np.array([0.0, *(t - times[piece])]) / unit
        columns["window_ratio"][i] = max(np.array(left) * eta**ahead) / max(inside, 1e-300)
        wait = gaps[: i + 1].max()
        if certificate.longest_wait(horizon / unit) * unit > wait:
            rho = certificate.contraction(horizon / unit, wait=wait / unit)
            right = 4 * rho ** ((t - begin) / unit) * first + 8 * truth.energy(begin, t, rho)
            columns["theorem"][i] = right
            columns["theorem_ratio"][i] = error / max(right, 1e-300)
    return xr.Dataset(
        {name: ("solve", values) for name, values in columns.items()}, coords={"t": ("solve", solve_time)}
    )


def _square(error: Array, matrix: Array) -> float:
    return float(error @ matrix @ error)


class _Truth:
    """The true state between the monitoring times, and the disturbance that explains what was measured."""

    def __init__(self, run: Run, model: Model, certificate: DetectabilityCertificate):
        data, self.model, self.Q = run.dataset, model, certificate.Q
        self.unit, self.step = certificate.step or 1.0, model.step
        keep = np.unique(np.concatenate([run.t, data["solve_time"].to_numpy()]).round(12), return_index=True)[1]
        where = np.concatenate([run.t, data["solve_time"].to_numpy()])
        states = np.concatenate([data["x_true"].to_numpy(), data["x_true_solve"].to_numpy()])
        self.t, self.x, self.known = where[keep], states[keep], data["x_true"].to_numpy()
        names = [str(name) for name in data["disturbance"].to_numpy()]
        rows = np.clip(np.searchsorted(run.t, self.t + 1e-12) - 1, 0, None)
        try:
            order = [names.index(name) for name in model.w]
            inputs = [[str(name) for name in data["input"].to_numpy()].index(name) for name in model.u]
        except ValueError as error:
            raise InputError(f"audit: the plant lacks a disturbance or input of the model: {error}") from None
        self.w, self.u = data["w"].to_numpy()[rows][:, order], data["u"].to_numpy()[rows][:, inputs]
        self.p = data["p_true"].to_numpy() if len(model.p) and "p_true" in data else np.asarray(model.p_start)
        self.at_events = bool(data.attrs["records_at_events"])
        self.recorded = np.isin(self.t.round(12), run.t.round(12))
        self.densities = self._densities()

    def _rate(self, x: Array, u: Array, w: Array) -> Array:
        return np.asarray(self.model.dynamics(0.0, x, u, w, self.p)).ravel()

    def state(self, t: float) -> Array:
        """Return the true state, between the recorded times as a cubic."""
        k = int(np.clip(np.searchsorted(self.t, t + 1e-12) - 1, 0, len(self.t) - 2))
        a, b = self.t[k], self.t[k + 1]
        s = (t - a) / (b - a)
        if s <= 1e-9 or s >= 1 - 1e-9 or self.step is not None:
            return self.x[k] if s < 0.5 else self.x[k + 1]
        slopes = [self._rate(self.x[j], self.u[k], self.w[k]) * (b - a) for j in (k, k + 1)]
        jump = self.x[k + 1] - self.x[k]
        cubic = (1 - s) * self.x[k] + s * self.x[k + 1]
        return cubic + s * (s - 1) * ((1 - 2 * s) * jump + (s - 1) * slopes[0] + s * slopes[1])

    def _densities(self) -> Array:
        """Return |w|^2_Q at the start, middle and end of every slot (n, 3); one value a step in discrete time."""
        if self.step is not None:
            return np.einsum("ki,ij,kj->k", self.w, self.Q, self.w)[:-1]
        found = measurement_noise(self.model)
        if found is None:
            raise InputError(
                f"audit: no disturbance of {self.model.name!r} stands for measurement noise alone in every output, "
                "which has to make up for the measured signal being held between its records; give the model such noise"
            )
        noise, inverse = found
        densities, held = np.empty((len(self.t) - 1, 3)), np.zeros(len(self.model.y))
        for k in range(len(self.t) - 1):
            if self.at_events or self.recorded[k]:
                held = self._output(self.x[k], k)
            for j, t in enumerate((self.t[k], (self.t[k] + self.t[k + 1]) / 2, self.t[k + 1])):
                w = self.w[k].copy()
                w[noise] += inverse @ (held - self._output(self.state(t), k))
                densities[k, j] = _square(w, self.Q)
        return densities

    def _output(self, x: Array, k: int) -> Array:
        return np.asarray(self.model.output(self.t[k], x, self.u[k], self.w[k], self.p)).ravel()

    def energy(self, a: float, b: float, eta: float) -> float:
        """Return the discounted integral (sum) of |w|^2_Q from a to b, by Simpson's rule."""
        left, right = np.clip(self.t[:-1], a, b), np.clip(self.t[1:], a, b)
        used = right - left > 1e-12
        if self.step is not None:
            ahead = np.round((b - self.t[1:][used]) / self.unit)
            return float(self.densities[used] @ eta**ahead)
        ends = self.t[1:][used] - self.t[:-1][used]
        start, stop = (left[used] - self.t[:-1][used]) / ends, (right[used] - self.t[:-1][used]) / ends
        f0, f1, f2 = self.densities[used].T
        total = np.zeros(len(ends))
        for s, weight in ((start, 1.0), ((start + stop) / 2, 4.0), (stop, 1.0)):
            value = f0 * (1 - s) * (1 - 2 * s) + 4 * f1 * s * (1 - s) + f2 * s * (2 * s - 1)
            total += weight * value * eta ** ((b - self.t[:-1][used] - s * ends) / self.unit)
        return float(np.sum(total * (right - left)[used] / 6))
