"""What a run leaves behind, collected while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ctmhe.models.signals import Signals
from ctmhe.simulation.run import FORMAT, Run
from ctmhe.triggers.timing import tolerance
from ctmhe.types import Array, Estimate

if TYPE_CHECKING:
    from ctmhe.simulation.engine import Loop, Segment

MESSAGES = {
    "x_true": "true state",
    "x_online": "estimate known at the time: open-loop prediction from the last solve",
    "x_retro": "estimated trajectory (thesis 3.16), left-continuous; the prediction where no solve covers it",
    "y": "measured output, noise included",
    "u": "known input from the time on",
    "w": "disturbance from the time on",
    "sample_time": "sampling instants t_i",
    "gap": "time since the previous sample, or since the start",
    "y_sampled": "outputs at the sampling instants",
    "x_hat": "state estimates at the sampling instants",
    "p_hat": "parameter estimates at the sampling instants",
    "p_true": "true parameters",
    "solve_seconds": "wall-clock time of the solve",
    "cost": "value of the cost at the solution",
    "iterations": "solver iterations",
    "success": "optimality conditions hold to tolerance",
    "outcome": "how the estimate came about",
    "status": "what the solvers report",
    "delivered": "measurements delivered at the sample",
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
        }
        self.events: list[dict[str, Any]] = []

    def monitored(self, k: int, x_true: Array, x_online: Array, y: Array, segment: Segment) -> None:
        """Keep the row of monitoring time `k`."""
        known = np.append(x_true, np.nan)  # a state that the plant does not have is unknown
        row = {"x_true": known[self.x_map], "x_online": x_online, "y": y, "u": segment.u0, "w": segment.w}
        for name, values in row.items():
            self.grid[name][k] = values

    def sampled(self, state: Any, estimate: Estimate, t: float, previous: float, y: Array, delivered: int) -> None:
        """Keep an event, and append its piece of the estimated trajectory (3.16) on (previous, t]."""
        status = estimate.status
        self.events.append(
            {
                "sample_time": t,
                "gap": t - previous,
                "y_sampled": y,
                "x_hat": estimate.x,
                "p_hat": estimate.p,
                "solve_seconds": estimate.seconds,
                "cost": estimate.cost,
                "iterations": status.iterations,
                "success": status.success,
                "outcome": status.outcome.name.lower(),
                "status": str(status),
                "delivered": delivered,
            }
        )
        slack = tolerance(t)
        first = max(previous, float(estimate.trajectory.t[0]))
        start, stop = np.searchsorted(self.times, [first + slack, t + slack], side="right")
        for k in range(start, stop):
            self.grid["x_retro"][k] = self.loop.mhe.trajectory(state, min(float(self.times[k]), t))

    def finish(self, p_true: Any) -> Run:
        """Return the run."""
        loop, model, plant, now = self.loop, self.loop.model, self.loop.plant, self.loop.now
        retro, online = self.grid["x_retro"], self.grid["x_online"]
        retro[0] = online[0]
        self.grid["x_retro"] = np.where(np.isnan(retro), online, retro)
        dims = {
            "x_true": "state",
            "x_online": "state",
            "x_retro": "state",
            "y": "output",
            "u": "input",
            "w": "disturbance",
        }
        variables: dict[str, Any] = {name: (("time", dims[name]), values) for name, values in self.grid.items()}
        vectors = {
            "y_sampled": ("output", len(model.y)),
            "x_hat": ("state", len(model.x)),
            "p_hat": ("parameter", len(model.p)),
        }
        texts, integers = ("outcome", "status"), ("iterations", "delivered")
        for name in ("sample_time", "gap", "solve_seconds", "cost", *vectors, *integers, "success", *texts):
            column = [event[name] for event in self.events]
            if name in vectors:
                dim, width = vectors[name]
                variables[name] = (("event", dim), np.array(column, dtype=float).reshape(len(column), width))
            else:
                kind = (
                    object if name in texts else np.int64 if name in integers else bool if name == "success" else float
                )
                variables[name] = ("event", np.array(column, dtype=kind))
        truth = self._true_parameters(p_true)
        if truth is not None:
            variables["p_true"] = ("parameter", truth)
        import xarray as xr

        data = xr.Dataset(
            {name: (*value, {"long_name": MESSAGES[name]}) for name, value in variables.items()},
            coords={"time": ("time", np.array(self.times), {"units": "s"}), "event": np.arange(len(self.events))},
        )
        for dim, group in (
            ("state", model.x),
            ("output", model.y),
            ("input", plant.u),
            ("disturbance", plant.w),
            ("parameter", model.p),
        ):
            data = data.assign_coords(_names(dim, group))
        for name in ("sample_time", "gap", "solve_seconds"):
            data[name].attrs["units"] = "s"
        data.attrs = {
            "format": FORMAT,
            "plant": plant.name,
            "integrator": plant.integrator,
            "model": model.name,
            "estimator": repr(loop.mhe),
            "trigger": repr(loop.watch.policy),
            "channel": repr(loop.channel),
            "location": "root finding" if loop.locate else "at monitoring times",
            "monitor": float(loop.monitor),
            "horizon": float(loop.mhe.horizon),
            "seed": str(loop.seed),
            "measurements": int(now.measurements),
            "too_late": int(now.too_late),
        }
        return Run(data)

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
