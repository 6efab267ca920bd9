"""What a run leaves behind, collected while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.estimators.mhe import MHE
from ctmhe.models.signals import Signals
from ctmhe.simulation.channel import WholeSignal
from ctmhe.simulation.run import FORMAT, Run
from ctmhe.triggers.timing import tolerance
from ctmhe.types import Array, Estimate

if TYPE_CHECKING:
    from ctmhe.simulation.engine import Loop, Segment

MESSAGES = {
    "x_true": "true state",
    "x_online": "estimate known at the time: open-loop prediction from the last solve",
    "x_retro": "estimated trajectory (thesis 3.16), left-continuous; the prediction where no solve covers it",
    "x_delayed": "estimate known a delay later (thesis 6.47), piece by piece; NaN where no solve came in time",
    "y": "measured output, noise included",
    "u": "known input from the time on",
    "w": "disturbance from the time on",
    "level": "level of the trigger, which samples when it reaches zero; inf for a certain yes, -inf for a certain no",
    "sample_time": "sampling instants t_i",
    "gap": "time since the previous sample, or since the start",
    "y_sampled": "outputs at the sampling instants",
    "solve_time": "instants of the estimates: of sampling, or of the message's arrival",
    "x_hat": "state estimates at their instants",
    "p_hat": "parameter estimates at their instants",
    "p_true": "true parameters",
    "solve_seconds": "wall-clock time of the solve",
    "cost": "value of the cost at the solution",
    "iterations": "solver iterations",
    "success": "optimality conditions hold to tolerance",
    "outcome": "how the estimate came about",
    "status": "what the solvers report",
    "delivered": "measurements that the estimate was the first to know",
    "x_true_solve": "true state at the instants of the estimates",
    "window_start": "start of the estimate's window",
    "x_prior": "prior estimate at the start of the window",
    "window_level": "guaranteed bound of U(x_hat, x), window by window (thesis 3.20, 3.25); NaN where there is none",
    "theorem_level": "guaranteed bound of U(x_hat, x) by Theorem 3.1 (thesis 3.32); NaN where there is none",
    "uncertified": "why there is no such bound",
    "retro_level": "guaranteed bound of U along the estimated trajectory (thesis 3.20)",
}


class Recorder:
    """Collects rows at monitoring times and at events, and makes the `Run` of them."""

    def __init__(self, loop: Loop):
        self.loop, self.times = loop, loop.times
        n, model, plant = len(loop.times), loop.model, loop.plant
        self.x_map = [plant.x.names.index(name) if name in plant.x.names else -1 for name in model.x]
        self.grid: dict[str, Array] = {
            "x_true": np.full((n, len(model.x)), np.nan),
            "x_online": np.full((n, len(model.x)), np.nan),
            "x_retro": np.full((n, len(model.x)), np.nan),
            "y": np.full((n, len(model.y)), np.nan),
            "u": np.full((n, len(plant.u)), np.nan),
            "w": np.full((n, len(plant.w)), np.nan),
            "level": np.full(n, np.nan),
        }
        self.guaranteed = None if loop.certified is None else loop.certified.guaranteed
        if self.guaranteed is not None:
            self.grid["retro_level"] = np.full(n, np.nan)
        self.mhe = loop.configured if isinstance(loop.configured, MHE) else None
        self.delay = None if self.mhe is None else self.mhe.delay
        if self.delay is not None:
            self.grid["x_delayed"] = np.full((n, len(model.x)), np.nan)
        self.rows = 0
        self.events: list[dict[str, Any]] = []
        self.solves: list[dict[str, Any]] = []

    def monitored(self, k: int, x_true: Array, x_online: Array, y: Array, level: float, segment: Segment) -> None:
        """Keep the row of monitoring time `k`."""
        known = np.append(x_true, np.nan)  # a state that the plant does not have is unknown
        row = {"x_true": known[self.x_map], "x_online": x_online, "y": y, "u": segment.u0, "w": segment.w}
        for name, values in (row | {"level": level}).items():
            self.grid[name][k] = values
        self.rows = k + 1

    def sampled(self, t: float, previous: float, y: Array) -> None:
        """Keep a sample."""
        self.events.append({"sample_time": t, "gap": t - previous, "y_sampled": y})

    def solved(self, state: Any, estimate: Estimate, t: float, previous: float, delivered: int) -> None:
        """Keep an estimate, and append its piece of the estimated trajectory (3.16) on (previous, t]."""
        status = estimate.status
        known = np.append(self.loop.plant.state(), np.nan)
        self.solves.append(
            {
                "solve_time": t,
                "x_hat": estimate.x,
                "p_hat": estimate.p,
                "solve_seconds": estimate.seconds,
                "cost": estimate.cost,
                "iterations": status.iterations,
                "success": status.success,
                "outcome": status.outcome.name.lower(),
                "status": str(status),
                "delivered": delivered,
                "x_true_solve": known[self.x_map],
            }
        )
        if estimate.bound is not None:
            bound, nx = estimate.bound, len(self.loop.model.x)
            self.solves[-1] |= {
                "window_start": float(estimate.trajectory.t[0]),
                "x_prior": np.array(estimate.prior[:nx]),
                "window_level": np.nan if bound.level is None else bound.level,
                "theorem_level": np.nan if bound.theorem is None else bound.theorem,
                "uncertified": "; ".join(bound.reasons),
            }
        if self.delay is not None:
            self._keep_delayed(state, estimate, previous, t, self.delay)
        slack = tolerance(t)
        first = max(previous, float(estimate.trajectory.t[0]))
        start, stop = np.searchsorted(self.times, [first + slack, t + slack], side="right")
        for k in range(start, stop):
            at = min(float(self.times[k]), t)
            self.grid["x_retro"][k] = self.loop.configured.trajectory(state, at)
            if self.guaranteed is not None and estimate.bound is not None and estimate.bound.level is not None:
                self.grid["retro_level"][k] = self.guaranteed.bounds.at(state.track, at)

    def _keep_delayed(self, state: Any, estimate: Estimate, previous: float, t: float, delay: float) -> None:
        """Append the piece of the delayed trajectory that this window is the first to know: (previous, t] - delay."""
        assert self.mhe is not None
        slack = tolerance(t)
        since = previous - delay
        if since <= self.times[0]:
            since = self.times[0] - 2 * slack  # the first piece has the start as well
        window = float(estimate.trajectory.t[0])  # after a gap longer than horizon - delay something is missing
        start = np.searchsorted(self.times, max(since + slack, window - slack), side="right")
        stop = np.searchsorted(self.times, t - delay + slack, side="right")
        for k in range(start, stop):
            self.grid["x_delayed"][k] = self.mhe.smooth(state, float(self.times[k]))

    def finish(self, p_true: Any) -> Run:
        """Return the run as far as it went."""
        loop, model, plant, now = self.loop, self.loop.model, self.loop.plant, self.loop.now
        grid, times = {name: values[: self.rows] for name, values in self.grid.items()}, self.times[: self.rows]
        retro, online = grid["x_retro"], grid["x_online"]
        retro[:1] = online[:1]
        grid["x_retro"] = np.where(np.isnan(retro), online, retro)
        states, outputs, parameters = ("state", len(model.x)), ("output", len(model.y)), ("parameter", len(model.p))
        dims = {"x_true": "state", "x_online": "state", "x_retro": "state", "y": "output", "u": "input"}
        dims |= {"x_delayed": "state"}
        dims |= {"w": "disturbance"}
        variables: dict[str, Any] = {
            name: (("time", dims[name]) if name in dims else "time", values) for name, values in grid.items()
        }
        events = {"sample_time": float, "gap": float, "y_sampled": outputs}
        solves = {"solve_time": float, "solve_seconds": float, "cost": float, "iterations": np.int64, "success": bool}
        solves |= {"delivered": np.int64, "outcome": object, "status": object, "x_hat": states, "p_hat": parameters}
        solves |= {"x_true_solve": states}
        if self.guaranteed is not None:
            solves |= {"window_start": float, "x_prior": states, "window_level": float, "theorem_level": float}
            solves |= {"uncertified": object}
        for along, rows, columns in (("event", self.events, events), ("solve", self.solves, solves)):
            for name, kind in columns.items():
                column = [row[name] for row in rows]
                if isinstance(kind, tuple):
                    values = np.array(column, dtype=float).reshape(len(column), kind[1])
                    variables[name] = ((along, kind[0]), values)
                else:
                    variables[name] = (along, np.array(column, dtype=kind))
        truth = self._true_parameters(p_true)
        if truth is not None:
            variables["p_true"] = ("parameter", truth)
        import xarray as xr

        data = xr.Dataset(
            {name: (*value, {"long_name": MESSAGES[name]}) for name, value in variables.items()},
            coords={
                "time": ("time", np.array(times), {"units": "s"}),
                "event": np.arange(len(self.events)),
                "solve": np.arange(len(self.solves)),
            },
        )
        for dim, group in (
            ("state", model.x),
            ("output", model.y),
            ("input", plant.u),
            ("disturbance", plant.w),
            ("parameter", model.p),
        ):
            data = data.assign_coords(_names(dim, group))
        for name in ("sample_time", "gap", "solve_time", "solve_seconds", "window_start"):
            if name in data:
                data[name].attrs["units"] = "s"
        data.attrs = {
            "format": FORMAT,
            "plant": plant.name,
            "integrator": plant.integrator,
            "model": model.name,
            "estimator": repr(loop.configured),
            "trigger": repr(loop.watch.policy),
            "channel": repr(loop.channel),
            "location": self._location(),
            "monitor": float(loop.monitor),
            "horizon": float(loop.configured.horizon),
            **({} if self.delay is None else {"delay": self.delay}),
            "seed": str(loop.seed),
            "measurements": int(loop.estimator.taken),
            "too_late": int(loop.estimator.too_late),
            "messages": int(now.sent),
            "messages_lost": int(now.lost),
            "bytes_sent": int(now.bytes),
            "hushed": int(now.hushed),
            **self._certificate(),
            "sensor_solves": 0 if loop.sensor is loop.estimator else int(loop.sensor.solves),
        }
        return Run(data)

    def _certificate(self) -> dict[str, Any]:
        """Return the numbers behind the bounds: as attributes, so that a saved run keeps them."""
        if self.guaranteed is None:
            return {}
        bounds, P = self.guaranteed.bounds, self.guaranteed.bounds.certificate.P_lower
        about = f"{bounds.certificate.method}, {'proof' if bounds.certificate.rigorous else 'evidence'}"
        channel = getattr(self.loop.channel, "channel", self.loop.channel)
        return {
            "certificate": about,
            "P_lower": P.reshape(-1),
            "domain_level": bounds.cap,
            "wait_limit": bounds.limit,
            "holds": ", ".join(sorted(set(self.loop.configured.hold.values()))),
            "records_at_events": int(isinstance(channel, WholeSignal)),
        }

    def _location(self) -> str:
        """Return in words how the times of events were found."""
        loop = self.loop
        if not loop.watch.has_guard:
            return "at their own times"
        if loop.locate is None:
            return f"polled every {loop.monitor:g} s" if loop.sample_time is None else "polled at the records"
        return "roots found by CVODE" if loop.rooted else f"search with rollback to {loop.locate:g} s"

    def _true_parameters(self, p_true: Any) -> Array | None:
        """Return the plant's values of the model's parameters, None where the plant does not tell."""
        model, plant = self.loop.model, self.loop.plant
        signals: Signals = getattr(plant, "p", model.p)
        known: dict[str, float] = {}
        if hasattr(plant, "model"):
            known |= dict(zip(signals.names, plant.model.p_start, strict=True))  # type: ignore[attr-defined]
        if isinstance(p_true, Mapping):
            known |= p_true
        elif p_true is not None:
            known |= dict(zip(signals.names, signals.vector(p_true, "p_true"), strict=True))
        return np.array([known[name] for name in model.p]) if set(model.p.names) <= set(known) else None


def _names(dim: str, group: Signals) -> dict[str, Any]:
    """Return the coordinates of a kind of signal: names, and units beside them."""
    return {
        dim: (dim, np.array(group.names, dtype=object)),
        f"{dim}_unit": (dim, np.array(group.units, dtype=object)),
    }
