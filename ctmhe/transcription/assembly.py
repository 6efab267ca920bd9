"""From logs, weights and bounds to the arrays of one window: the cost of DESIGN and thesis (3.13), (3.6), exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.data.window import held_inputs, held_signal, point_rows
from ctmhe.errors import InputError
from ctmhe.models.continuous import Model, box_arrays
from ctmhe.models.signals import Signals
from ctmhe.transcription.grid import Mesh, build_mesh, discounted_length, same_time
from ctmhe.transcription.problem import Window
from ctmhe.transcription.stage import StageFunction
from ctmhe.transcription.weights import WeightFunction, square_root, weight_matrix
from ctmhe.types import Array, Bounds, DiscountedCost

HOLDS = ("zero", "linear", "point")


@dataclass(frozen=True, eq=False)
class Records:
    """What is known when a window is assembled: ordered times and rows of measurements (NaN missing) and inputs."""

    y_times: Array
    y: Array
    u_times: Array
    u: Array


class Assembly:
    """Turns records into windows, for one model, cost and set of bounds.

    Parameters
    ----------
    model : Model
    stage : StageFunction
    cost : DiscountedCost
    bounds : Bounds
    interval : float
        Shooting interval and disturbance cell, seconds; the step for a `DiscreteModel`.
    hold : str or mapping output -> str
        How each output's samples enter: `zero`, `linear` (the whole signal, weighted by R) or `point` (each sample at
        its time, weighted by R_point).
    hold_limit : float
        Seconds for which a held sample counts when no newer one has come.
    input_hold : {"zero", "linear"}
    filtering : bool
        `DiscreteModel` only: count the measurement at the window's end (the filtering form).
    """

    def __init__(
        self,
        model: Model,
        stage: StageFunction,
        cost: DiscountedCost,
        bounds: Bounds,
        *,
        interval: float,
        hold: Any,
        hold_limit: float,
        input_hold: str,
        filtering: bool,
    ):
        self.model, self.stage, self.cost = model, stage, cost
        self.interval, self.hold_limit = interval, hold_limit
        self.filtering = filtering
        self.end_slot = filtering or cost.S is not None  # discrete: a slot of no length that carries the newest output
        self.discrete = model.step is not None
        kinds = hold_kinds(model, hold)
        self.held = np.array([kind != "point" for kind in kinds])
        self.linear = np.array([kind == "linear" for kind in kinds])
        if input_hold not in ("zero", "linear"):
            raise InputError(f"input_hold must be 'zero' or 'linear', got {input_hold!r}")
        self.input_linear = input_hold == "linear"
        self.rate = -np.log(cost.eta) / (model.step or 1.0)  # type: ignore[operator]
        self.prior_rate = -np.log(cost.prior_eta) / (model.step or 1.0)  # type: ignore[operator]
        self.Q = WeightFunction(cost.Q, model.w.names, "cost weight Q") if len(model.w) else None
        self.R = WeightFunction(cost.R, model.y.names, "cost weight R")
        self.R_point = WeightFunction(
            cost.R if cost.R_point is None else cost.R_point, model.y.names, "cost weight R_point"
        )
        self.S = None if cost.S is None else WeightFunction(cost.S, model.y.names, "cost weight S")
        self.prior_names, self.p_estimated = prior_names(model, cost)
        if not callable(cost.P):
            weight_matrix(cost.P, self.prior_names, "cost weight P")
        groups = {"x": model.x, "w": model.w, "p": model.p, "y": model.y, "residual": model.y}
        self.boxes = {key: box_arrays(group, getattr(bounds, key), f"bounds {key}") for key, group in groups.items()}
        self.scales = {key: scale_of(groups[key], *self.boxes[key]) for key in "xwpy"}

    def prior_root(self, start: float, length: float, factor: float, weight: Array | None = None) -> Array:
        """Return the square root of the discounted prior weight at `start` for a window of `length` seconds.

        `weight` is that of a prior which has its own; else the cost's P.
        """
        P = self.cost.P if weight is None else weight
        varies = callable(P) or weight is not None
        matrix = weight_matrix(
            P(start, length) if callable(P) else P,
            self.prior_names,
            f"weight P of the prior at t = {start:g}" if varies else "cost weight P",
        )
        return square_root(matrix) * np.sqrt(factor * np.exp(-self.prior_rate * length))

    def mesh(self, start: float, end: float, records: Records, *, growing: bool) -> Mesh:
        """Return the mesh of a window: every sample and every input switch inside it is an edge."""
        if self.discrete:
            return self._steps(start, end)
        samples = records.y_times[np.isfinite(records.y).any(axis=1)]
        at_start = samples[np.abs(samples - start) <= same_time(self.interval, start)]
        point = bool(growing and len(at_start) and np.isfinite(records.y[:, ~self.held]).any())
        instants = np.concatenate([samples, records.u_times, *self._expiries(records)])
        return build_mesh(start, end, self.interval, instants, sample_at_start=point)

    def _expiries(self, records: Records) -> list[Array]:
        """Return when held samples stop counting because no newer one has come: the integrand jumps there."""
        found = []
        for s in np.flatnonzero(self.held):
            spoken = records.y_times[np.isfinite(records.y[:, s])]
            following = np.append(spoken[1:], np.inf)
            found.append(spoken[following > spoken + self.hold_limit] + self.hold_limit)
        return found

    def _steps(self, start: float, end: float) -> Mesh:
        step = self.interval
        tolerance = max(1e-6 * step, same_time(step, end))
        first, last = round(start / step), round(end / step)
        for what, t, k in (("start", start, first), ("end", end, last)):
            if abs(t - k * step) > tolerance:
                raise InputError(
                    f"the window's {what} t = {t:g} s is not a multiple of the discrete model's step {step:g} s; "
                    "estimate and measure at whole steps"
                )
        edges = np.arange(first, last + 1) * step
        if self.end_slot or len(edges) == 1:
            edges = np.append(edges, edges[-1])
        h = np.diff(edges)
        cell = np.arange(first, first + len(h))
        return Mesh(edges, h, np.zeros(len(h), dtype=bool), cell, tolerance)

    def window(
        self,
        start: float,
        end: float,
        records: Records,
        prior: Array,
        *,
        growing: bool,
        prior_factor: float = 1.0,
        prior_weight: Array | None = None,
    ) -> Window:
        """Return the problem over [start, end] as arrays."""
        model, stage, mesh = self.model, self.stage, self.mesh(start, end, records, growing=growing)
        n = len(mesh)
        if len(model.u):
            u0, u1 = held_inputs(records.u_times, records.u, mesh.t, mesh.tolerance, self.input_linear)
        else:
            u0 = u1 = np.empty((n, 0))
        if self.discrete:
            L_y, y_data, end_known = self._outputs_at_steps(mesh, end, records)
        else:
            L_y, y_data, end_known = self._outputs(mesh, end, records)
        y_lower, y_upper = self._output_bounds(n, y_data[:, -1], end_known)
        w_lower, w_upper = (np.broadcast_to(side, (n, stage.nw)).copy() for side in self.boxes["w"])
        if not (self.discrete and self.filtering):
            idle = (mesh.h == 0) & ~mesh.shared
            w_lower[idle] = w_upper[idle] = 0.0
        x_lower, x_upper = (np.broadcast_to(side, (n + 1, stage.nx)) for side in self.boxes["x"])
        p_lower, p_upper = self.boxes["p"]
        return Window(
            mesh=mesh,
            u0=u0,
            u1=u1,
            prior=prior,
            p_estimated=self.p_estimated,
            L_prior=self.prior_root(start, end - start, prior_factor, prior_weight),
            L_w=self._disturbance_roots(mesh, end),
            L_y=L_y,
            y_data=y_data,
            x_lower=x_lower,
            x_upper=x_upper,
            w_lower=w_lower,
            w_upper=w_upper,
            y_lower=y_lower,
            y_upper=y_upper,
            p_lower=p_lower,
            p_upper=p_upper,
            x_scale=self.scales["x"],
            w_scale=self.scales["w"],
            p_scale=self.scales["p"],
            y_scale=self.scales["y"],
        )

    def _disturbance_roots(self, mesh: Mesh, end: float) -> Array:
        if self.Q is None:
            return np.empty((len(mesh), 0, 0))
        weight = (
            self._step_weights(mesh, end) if self.discrete else discounted_length(mesh.t[:-1], mesh.h, end, self.rate)
        )
        return np.sqrt(weight)[:, None, None] * self.Q.roots(mesh.t[:-1] + mesh.h / 2)

    def _step_weights(self, mesh: Mesh, end: float) -> Array:
        """Return eta^(N-j-1) in the prediction form, eta^(N-j) in the filtering form; 0 for an idle end slot."""
        steps = int(np.count_nonzero(mesh.h))
        weight = np.exp(-self.rate * self.interval * (steps - 1 + int(self.filtering) - np.arange(len(mesh))))
        if not self.filtering:
            weight[steps:] = 0.0
        return weight

    def _outputs(self, mesh: Mesh, end: float, records: Records) -> tuple[Array, Array, np.ndarray]:
        stage, n, ny = self.stage, len(mesh), self.stage.ny
        y_data = np.zeros((n, stage.q, ny))
        known = np.zeros((n, stage.q, ny), dtype=bool)
        starts = mesh.t[:-1]
        nodes, shares = stage.quadrature(mesh.h)
        times = np.concatenate([starts[:, None] + nodes, mesh.t[1:, None]], axis=1)
        for s in np.flatnonzero(self.held):
            valid = np.isfinite(records.y[:, s])
            y_data[:, :, s], known[:, :, s] = held_signal(
                records.y_times[valid],
                records.y[valid, s],
                times,
                starts,
                mesh.tolerance,
                self.hold_limit,
                bool(self.linear[s]),
            )
        end_known = known[:, -1].copy()
        known[:, -1] = False
        L_y = np.zeros((n, stage.q, ny, ny))
        for i, share in enumerate(shares.T):
            weight = np.sqrt(share * np.exp(-self.rate * (end - times[:, i])))
            L_y[:, i] = weight[:, None, None] * self.R.roots(times[:, i], known[:, i])
        sample, edge = point_rows(records.y_times, mesh.t, mesh.tolerance)
        if mesh.h[0] == 0.0:  # the samples at the window's start belong to the end of the slot of no length
            edge = np.maximum(edge, 1)
        rows = records.y[sample]
        count, total = np.zeros((n, ny)), np.zeros((n, ny))
        at, sensor = np.nonzero(np.isfinite(rows) & ~self.held & (edge > 0)[:, None])
        np.add.at(count, (edge[at] - 1, sensor), 1.0)
        np.add.at(total, (edge[at] - 1, sensor), rows[at, sensor])
        point = count > 0  # samples of one instant (to round-off) count together: their mean, so often
        y_data[:, -1] = np.where(point, total / np.maximum(count, 1.0), np.where(self.held, y_data[:, -1], 0.0))
        known[:, -1] |= point
        end_known |= point
        at, sensor = np.nonzero(np.isfinite(rows) & self.held & (edge == n)[:, None])  # held ones that speak at the end
        y_data[n - 1, -1, sensor] = rows[at, sensor]
        end_known[n - 1, sensor] = True
        spoken = np.flatnonzero(known[:, -1].any(axis=1))
        if len(spoken):
            weight = np.sqrt(np.exp(-self.rate * (end - mesh.t[1:][spoken])))
            roots = self.R_point.roots(mesh.t[1:][spoken], known[spoken, -1])
            L_y[spoken, -1] = weight[:, None, None] * roots * np.sqrt(count[spoken])[:, None, :]
        if self.S is not None and end_known[-1].any():
            terminal = self.S.root(end, end_known[-1])
            L_y[-1, -1] = square_root(L_y[-1, -1].T @ L_y[-1, -1] + terminal.T @ terminal)
        return L_y, y_data, end_known

    def _outputs_at_steps(self, mesh: Mesh, end: float, records: Records) -> tuple[Array, Array, np.ndarray]:
        n, ny = len(mesh), self.stage.ny
        y_data, known = np.zeros((n, 1, ny)), np.zeros((n, ny), dtype=bool)
        sample, edge = point_rows(records.y_times, mesh.t[:-1], mesh.tolerance)
        at, sensor = np.nonzero(np.isfinite(records.y[sample]))
        y_data[edge[at], 0, sensor] = records.y[sample[at], sensor]
        known[edge[at], sensor] = True
        weight = np.sqrt(self._step_weights(mesh, end))
        L_y = weight[:, None, None] * self.R.roots(mesh.t[:-1], known)
        if self.S is not None and known[-1].any() and mesh.h[-1] == 0:
            terminal = self.S.root(end, known[-1])
            L_y[-1] = square_root(L_y[-1].T @ L_y[-1] + terminal.T @ terminal)
        return L_y[:, None], y_data, known

    def _output_bounds(self, n: int, y_end: Array, known: np.ndarray) -> tuple[Array, Array]:
        lower, upper = (np.broadcast_to(side, (n, self.stage.ny)).copy() for side in self.boxes["y"])
        low, high = self.boxes["residual"]
        if np.isfinite(low).any() or np.isfinite(high).any():  # residual = y - y_hat
            lower = np.where(known, np.maximum(lower, y_end - high), lower)
            upper = np.where(known, np.minimum(upper, y_end - low), upper)
        return lower, upper


def hold_kinds(model: Model, hold: Any) -> list[str]:
    """Return how each output is held; `point` is all that a `DiscreteModel` knows."""
    default = "point" if model.step is not None else "zero"
    if hold is None:
        kinds = [default] * len(model.y)
    elif isinstance(hold, str):
        kinds = [hold] * len(model.y)
    elif not isinstance(hold, Mapping):
        raise InputError(f"hold must be one of {', '.join(HOLDS)}, or a mapping from outputs to these; got {hold!r}")
    else:
        kinds = [default] * len(model.y)
        for name, kind in dict(hold).items():
            kinds[model.y.index(name)] = kind
    for kind in kinds:
        if kind not in HOLDS:
            raise InputError(f"hold must be one of {', '.join(HOLDS)}, got {kind!r}")
        if model.step is not None and kind != "point":
            raise InputError(
                f"hold={kind!r} has no meaning for a DiscreteModel, which measures at its steps; leave it out"
            )
    return kinds


def prior_names(model: Model, cost: DiscountedCost) -> tuple[tuple[str, ...], bool]:
    """Return the names that the prior weighs, and whether the parameters are among them."""
    both = (*model.x.names, *model.p.names)
    if not len(model.p):
        return model.x.names, False
    P: Any = cost.P(0.0, 0.0) if callable(cost.P) else cost.P
    if isinstance(P, dict):
        estimated = any(name in model.p.names for name in P)
    else:
        estimated = np.ndim(P) > 0 and np.shape(P)[0] == len(both)
    return (both if estimated else model.x.names), bool(estimated)


def scale_of(signals: Signals, lower: Array, upper: Array) -> Array:
    """Return typical magnitudes: nominals, or the size of a finite box where the nominal is left at 1."""
    boxed = np.isfinite(lower) & np.isfinite(upper) & (signals.nominal == 1.0)
    size = np.where(boxed, np.maximum(np.abs(np.where(boxed, lower, 0)), np.abs(np.where(boxed, upper, 0))), 0.0)
    return np.where(size > 0, size, signals.nominal)
