"""Recursive estimators with the verbs of `MHE`: one loop over cells, inputs and samples; a rule says what is done."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import casadi as ca
import numpy as np

from ctmhe.data.log import Log
from ctmhe.data.window import held_inputs, point_rows
from ctmhe.errors import InputError, NotEstimated, TooLate
from ctmhe.estimators.filters.filter_state import Belief, Filtered, FilterState, load_filter_state, save_filter_state
from ctmhe.estimators.mhe import Prediction
from ctmhe.models.continuous import Model
from ctmhe.transcription.assembly import Assembly, Records
from ctmhe.transcription.grid import Mesh, discounted_length, same_time
from ctmhe.transcription.integrators import Integrator, StepMap
from ctmhe.transcription.stage import StageFunction
from ctmhe.transcription.weights import weight_matrix
from ctmhe.types import (
    Array,
    Bounds,
    DiscountedCost,
    Estimate,
    Input,
    Measurement,
    Outcome,
    Status,
    Trajectory,
    finite_time,
    frozen,
    positive,
)

NOTHING = np.empty(0)


@dataclass(frozen=True, eq=False)
class Slot:
    """A stretch of h seconds from `t` on, on which the input runs from `u0` to `u1` and w is constant."""

    t: float
    h: float
    u0: Array
    u1: Array
    p: Array


@dataclass(frozen=True, eq=False)
class Sample:
    """What the sensors say at `t`: y (ny,), NaN where one is silent."""

    t: float
    u: Array
    p: Array
    y: Array


class Recursion(Protocol):
    """A rule applied to one model. Means and covariances are of z = (x, estimated p, w of the cell)."""

    def start(self, x: Array, p: Array) -> Belief:
        """Return the belief before the first measurement, about the initial estimate."""
        ...

    def renew(self, belief: Belief, t: float) -> Belief:
        """Return the belief at the start of a cell at `t`: its w is unknown."""
        ...

    def advance(self, belief: Belief, slot: Slot) -> Belief:
        """Return the belief at the end of a slot."""
        ...

    def correct(self, belief: Belief, sample: Sample) -> tuple[Belief, float]:
        """Return the belief that knows a sample, and how much the sample cost."""
        ...


class Rule(Protocol):
    """How means and covariances are carried and corrected: `Kalman`, `Extended`, `Unscented`, ..."""

    def on(self, basis: Basis) -> Recursion:
        """Return the rule for a model, or raise `InputError` where it does not apply."""
        ...


@dataclass(frozen=True, eq=False)
class Basis:
    """What rules are made of.

    Attributes
    ----------
    model : Model
    stage : StageFunction
        Slots of the dynamics with w constant.
    assembly : Assembly
        The weights.
    held : bool
        w is held over cells and part of z; else it is white, and z is (x, estimated p).
    """

    model: Model
    stage: StageFunction
    assembly: Assembly
    held: bool

    @property
    def n(self) -> int:
        """Length of (x, estimated p)."""
        return len(self.assembly.prior_names)

    def split(self, z: Array, p: Array) -> tuple[Array, Array, Array]:
        """Return x (nx,), p (np,) and w (nw,) of a z."""
        nx, n, nw = self.stage.nx, self.n, self.stage.nw
        w = z[len(z) - nw :] if len(z) >= n + nw else np.zeros(nw)
        return z[:nx], (z[nx:n] if n > nx else p), w

    def start(self, x: Array, p: Array) -> Belief:
        """Return the belief that the cost's P stands for: its inverse."""
        P = self.assembly.cost.P(0.0, 0.0) if callable(self.assembly.cost.P) else self.assembly.cost.P
        covariance = inverse(weight_matrix(P, self.assembly.prior_names, "cost weight P"), "P", "prior")
        return Belief(np.concatenate([x, p])[: self.n], covariance)

    def disturbance_covariance(self, t: float) -> Array:
        """Return the covariance of w on a cell that starts at `t`, or, where it is white, its intensity."""
        if self.assembly.Q is None:
            return np.zeros((0, 0))
        interval, length = self.assembly.interval, 1.0
        if self.held and not self.assembly.discrete:  # as seen from the cell's start
            length = float(discounted_length(np.zeros(1), np.array([interval]), 0.0, self.assembly.rate)[0])
        return inverse(self.assembly.Q.at(t), "Q", "disturbance") / length

    def output_root(self, sample: Sample) -> Array:
        """Return L (ny, ny) with L' L = the weight of a sample, zero for sensors that are silent."""
        weight = self.assembly.R if self.assembly.discrete else self.assembly.R_point
        return weight.root(sample.t, np.isfinite(sample.y))


def inverse(weight: Array, name: str, what: str) -> Array:
    """Return the covariance that a weight stands for; raise when it is not finite."""
    values = np.linalg.eigvalsh(weight)
    if len(values) and not values[0] > 1e-14 * values[-1]:
        raise InputError(
            f"filter: the weight {name} of the {what} must be positive definite, its inverse is a covariance; an MHE "
            f"does without"
        )
    return np.linalg.inv(weight)


class Filter:
    """A recursive estimator: a model, and a rule such as `Kalman()`. Immutable; its state is a `FilterState`.

    The verbs are those of `MHE`, so that `simulate` and `replay` take it: `init`, `control`, `observe`, `estimate`,
    `predict`. Samples may come at any times, with any of the sensors, but not later than the last estimate: a filter
    has forgotten how it came there, and says `TooLate`. Bounds play no part.

    Parameters
    ----------
    model : Model
        A `ContinuousModel`, `DiscreteModel` or `FmuModel`.
    rule : Kalman, Extended, Unscented, RobustKalman or Luenberger
    cost : DiscountedCost
        The weights of an MHE, here inverse covariances: P of the initial estimate (over states and parameters: these
        are estimated), Q of the disturbance, R_point (R when left out) of a sample. `eta` < 1 forgets: covariances
        grow by eta^-h in h seconds (per step for a `DiscreteModel`).
    integrator : RK4, Exact or CVODES, optional
        Not for a `DiscreteModel`.
    interval : float, optional
        Seconds for which w is constant, as in an MHE with cells of this length; its covariance on a cell is that of
        the cell's cost. When left out, w is white noise of intensity Q^-1 and the covariance follows its differential
        equation. The step of a `DiscreteModel`, whose w has covariance Q^-1 in each step.
    clock : callable, optional
        Seconds, for `Estimate.seconds`.

    Raises
    ------
    InputError
        For a rule that does not fit the model, weights that are no inverse covariances, and as `MHE`.
    """

    guaranteed = None

    def __init__(
        self,
        model: Model,
        rule: Rule,
        *,
        cost: DiscountedCost | None = None,
        integrator: Integrator | None = None,
        interval: float | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ):
        given = locals()
        self._configuration: dict[str, Any] = {key: given[key] for key in given if key not in ("self", "__class__")}
        if not isinstance(model, Model):
            raise InputError(f"model must be a ContinuousModel, DiscreteModel or FmuModel, got {type(model).__name__}")
        if isinstance(rule, type) or not hasattr(rule, "on"):
            raise InputError(f"rule must be a value such as Kalman() or Extended(), got {rule!r}")
        cost = DiscountedCost() if cost is None else cost
        if cost.S is not None or cost.prior_eta != cost.eta:
            raise InputError("filter: the terminal weight S and another prior_eta than eta have no recursive form")
        self.model, self.rule, self.cost, self.clock = model, rule, cost, clock
        held = interval is not None or model.step is not None
        if model.step is not None:
            if integrator is not None or interval not in (None, model.step):
                raise InputError("a DiscreteModel has its own step: leave integrator and interval out")
            integrator, interval = StepMap(), model.step
        elif integrator is None or isinstance(integrator, type):
            raise InputError("a ContinuousModel needs integrator=RK4(step=...), Exact(step=...) or CVODES(...)")
        elif interval is None:
            interval = getattr(integrator, "step", None)
            if interval is None:
                raise InputError("white noise is integrated in equal steps: use RK4(step) or Exact(step), or interval=")
        self.interval, self.integrator = positive("interval", interval, "seconds"), integrator
        self.horizon = np.inf
        self.hold = dict.fromkeys(model.y.names, "point")
        self.stage = StageFunction(model, integrator, signal=False, interval=self.interval)
        self.assembly = Assembly(
            model,
            self.stage,
            cost,
            Bounds(),
            interval=self.interval,
            hold="point",
            hold_limit=np.inf,
            input_hold="zero",
            filtering=False,
        )
        self._basis = Basis(model, self.stage, self.assembly, held)
        symbols = [ca.MX.sym(name, model.output.size1_in(i)) for i, name in enumerate("txuwp")]
        if not held and len(model.w) and any(ca.which_depends(model.output(*symbols), symbols[3], 1, False)):
            raise InputError(
                f"filter: outputs of {model.name!r} depend on w, and a sample of white noise has no finite variance. "
                "Leave the measurement noise out of w and state it by R_point, or hold w by interval=..."
            )
        self._recursion = rule.on(self._basis)
        start = self._recursion.start(np.zeros(len(model.x)), model.p_start)
        self._prior = start.covariance(self._basis.n)

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self._configuration,)

    def __repr__(self) -> str:
        kind = "w held" if self._basis.held else "w white"
        return f"Filter of {self.model.name!r}: {self.rule!r}, {kind}, interval {self.interval:g} s"

    @property
    def p_estimated(self) -> bool:
        """Whether the prior's weight covers the parameters."""
        return self.assembly.p_estimated

    @property
    def input_linear(self) -> bool:
        """False: inputs hold until the next."""
        return False

    def init(self, *, t: float = 0.0, x: Any, p: Any = None) -> FilterState:
        """Return the state at the start of estimation.

        Parameters
        ----------
        t : float
            Time t0 in seconds.
        x : array (nx,) or mapping name -> value
            Initial estimate, model units.
        p : array (np,) or mapping, optional
            Initial (or known) parameters; the model's start values when left out.
        """
        t, model = finite_time(t, "init"), self.model
        x0 = model.x.vector(x, "init")
        if isinstance(p, dict):
            p = dict(zip(model.p.names, model.p_start, strict=True)) | p
        p0 = model.p.vector(model.p_start if p is None else p, "init")
        inputs, u_start = Log(len(model.u)), getattr(model, "u_start", None)
        if len(model.u) and u_start is not None:
            inputs = inputs.put(t, frozen(u_start))
        self._check_step(t, "init")
        belief = self._recursion.renew(self._recursion.start(x0, p0), t)
        cell = round(t / self.interval) if self.assembly.discrete else int(np.floor(t / self.interval + 1e-9))
        silent = frozen(np.full(len(model.y), np.nan))
        return FilterState(t, t, x0, p0, belief, cell, silent, Log(len(model.y)), inputs)

    def observe(self, state: FilterState, measurement: Measurement) -> FilterState:
        """Return the state that also knows `measurement`: partial ones (NaN or names left out) count for what they say.

        Raises
        ------
        TooLate
            If it is older than the last estimate.
        InputError
            For wrong shapes, unknown names, infinite values, or a sensor that says two different things at one time.
        """
        state = self._checked(state)
        if not isinstance(measurement, Measurement):
            raise InputError(f"observe expects a Measurement(t, y), got {type(measurement).__name__}")
        t = measurement.t
        row = self.model.y.vector(measurement.y, f"measurement at t = {t:g}", missing=np.nan, allow_nan=True)
        self._check_age(state, t, "measurement")
        self._check_step(t, "measurement")
        known = state.measurements.find(t)
        for earlier in (known, state.used if abs(t - state.t) <= self._slack(t) else None):
            if earlier is None:
                continue
            both = np.isfinite(earlier) & np.isfinite(row)
            if (both & (earlier != row)).any():
                i = int(np.flatnonzero(both & (earlier != row))[0])
                raise InputError(
                    f"measurement at t = {t:g}: output {self.model.y.names[i]!r} is {row[i]:g} but was "
                    f"{earlier[i]:g} at the same time; give each sample its own time"
                )
            row = np.where(both, np.nan, row)
        if not np.isfinite(row).any():
            return state
        if known is not None:
            row = np.where(np.isfinite(row), row, known)
        return replace(state, measurements=state.measurements.put(t, row))

    def control(self, state: FilterState, value: Input) -> FilterState:
        """Return the state that also knows the input from `value.t` on; at one time the last one given counts.

        Raises `TooLate` for an input from before the last estimate, which has used another.
        """
        state = self._checked(state)
        if not isinstance(value, Input):
            raise InputError(f"control expects an Input(t, u), got {type(value).__name__}")
        u = self.model.u.vector(value.u, f"input at t = {value.t:g}")
        if state.solves:
            self._check_age(state, value.t, "input")
        return replace(state, inputs=state.inputs.put(value.t, u))

    def estimate(self, state: FilterState, t: float) -> tuple[FilterState, Estimate]:
        """Return the state and the estimate at `t`, after all samples up to then, those of `t` included.

        Raises
        ------
        NotEstimated
            If `t` lies before the last estimate.
        InputError
            If no input is known at the last estimate for a model with inputs.
        """
        began = self.clock()
        state, t = self._checked(state), finite_time(t, "estimate")
        if t < state.t - self._slack(t):
            raise NotEstimated(f"estimate at t = {t:g} s lies before the last one at {state.t:g} s: a filter goes on")
        self._check_step(t, "estimate")
        t = max(t, state.t)
        times, rows = state.measurements.arrays(t + self._slack(t))
        mesh, u0, u1 = self._drive(state, state.t, t, times, rows)
        sample, edge = point_rows(times, mesh.t, mesh.tolerance)
        belief, cell, cost, failure, used = state.belief, state.cell, state.cost, "", state.used
        prior = belief.z
        for k in range(len(mesh.t)):
            at = float(mesh.t[k])
            if k:
                slot = Slot(float(mesh.t[k - 1]), float(mesh.h[k - 1]), u0[k - 1], u1[k - 1], state.p)
                if mesh.cell[k - 1] != cell:
                    belief, cell = self._recursion.renew(belief, slot.t), int(mesh.cell[k - 1])
                belief, failure = self._tried(belief, slot, failure)
                cost *= np.exp(-self.assembly.rate * slot.h)
                prior, used = belief.z, np.full(len(self.model.y), np.nan)
                if self.assembly.discrete:
                    belief, cell = self._recursion.renew(belief, at), cell + 1
            now = u1[k - 1] if k and not self.assembly.discrete else self._input_at(state, at)
            for i in sample[edge == k]:
                p = self._basis.split(belief.z, state.p)[1]
                belief, price = self._recursion.correct(belief, Sample(at, now, p, rows[i]))
                cost, used = cost + price, np.where(np.isfinite(rows[i]), rows[i], used)
        x, p, w = (frozen(part) for part in self._basis.split(belief.z, state.p))
        y = self._output(t, x, self._input_at(state, t) if len(mesh.t) == 1 or self.assembly.discrete else u1[-1], w, p)
        notes = (() if len(times) else ("no measurement since the last estimate",)) + ((failure,) if failure else ())
        status = Status(Outcome.PREDICTED if failure else Outcome.SOLVED, not failure, notes=notes)
        after = FilterState(
            state.t0, t, x, p, belief, cell, frozen(used), state.measurements.drop_before(t + 2 * self._slack(t)),
            state.inputs.drop_before(t, keep_holding=True), float(cost), state.solves + 1,
        )  # fmt: skip
        none = np.empty((0, 0))
        path = Trajectory(frozen([t]), frozen(x[None]), none, none, none, none, p)
        kept = Filtered(path, frozen(np.concatenate([prior[: self._basis.n], p])[: len(x) + len(p)]))
        n = self._basis.n
        covariance = belief.covariance(n)
        rank = int(np.isfinite(np.diagonal(covariance)).sum())
        spread = lambda: (covariance, rank)  # noqa: E731
        return after, Estimate(t, x, p, w, y, float(cost), status, kept, self.clock() - began, spread)

    def predict(self, state: FilterState, t: float) -> Prediction:
        """Return the open-loop prediction at `t` from the last estimate: no disturbance, the last input held."""
        state, t = self._checked(state), finite_time(t, "predict")
        if t < state.t - self._slack(t):
            raise NotEstimated(f"prediction at t = {t:g} s lies before the last estimate at {state.t:g} s")
        x, y = self.carry(state, state.t, t, state.x, state.p)
        return Prediction(t, frozen(x), state.p, frozen(y))

    def carry(self, state: FilterState, t0: float, t1: float, x: Array, p: Array) -> tuple[Array, Array]:
        """Return state (nx,) and output (ny,) at `t1` along the undisturbed open loop from `x`, `p` at `t0`."""
        w = np.zeros(self.stage.nw)
        if t1 > t0:
            mesh, u0, u1 = self._drive(state, t0, t1, NOTHING, np.empty((0, len(self.model.y))))
            for k in range(len(mesh)):
                try:
                    x, _ = self.stage.step(mesh.t[k], mesh.h[k], x, w, p, u0[k], u1[k])
                except FloatingPointError:
                    break
        return x, self._output(t1, x, self._input_at(state, t1), w, p)

    def prior_covariance(self, t: float = 0.0) -> Array:
        """Return the covariance (n, n) of (x, estimated p) before the first measurement."""
        return self._prior

    def propagate_covariance(
        self, state: FilterState, t0: float, t1: float, x: Array, p: Array, covariance: Array
    ) -> Array:
        """Return the covariance (n, n) of (x, estimated p) at `t1`, if no sample comes, from `x`, `p` at `t0`.

        A rule that remembers more than a covariance goes on from the last estimate, whatever `covariance` says.
        """
        if t1 <= t0 or not np.isfinite(covariance).all():
            return covariance
        n = self._basis.n
        if state.belief.memory:
            belief, t0 = state.belief, state.t
        else:
            belief = self._recursion.renew(Belief(np.concatenate([x, p])[:n], covariance), t0)
        mesh, u0, u1 = self._drive(state, t0, t1, NOTHING, np.empty((0, len(self.model.y))))
        for k in range(len(mesh)):
            if k and mesh.cell[k] != mesh.cell[k - 1]:
                belief = self._recursion.renew(belief, float(mesh.t[k]))
            belief, _ = self._tried(belief, Slot(float(mesh.t[k]), float(mesh.h[k]), u0[k], u1[k], p), "")
        return belief.covariance(n)

    def trajectory(self, state: FilterState, t: float) -> Array:
        """Return x_hat(t) (nx,), which a filter only knows at the last estimate."""
        if abs(t - state.t) > self._slack(t):
            raise NotEstimated(f"trajectory at t = {t:g} s: a filter keeps the last estimate only, at {state.t:g} s")
        return state.x

    def save(self, state: FilterState, path: Any) -> None:
        """Write a state to a versioned file without pickle."""
        save_filter_state(self._checked(state), path, self._fingerprint())

    def load(self, path: Any) -> FilterState:
        """Read a state that a filter of the same signals, rule and interval saved; weights may differ."""
        return load_filter_state(path, self._fingerprint())

    def _fingerprint(self) -> dict[str, Any]:
        signals = {key: list(getattr(self.model, key).names) for key in "xuwpy"}
        kind = {"rule": type(self.rule).__name__, "held": self._basis.held, "interval": self.interval}
        return {"signals": signals, **kind, "estimated": list(self.assembly.prior_names)}

    def _tried(self, belief: Belief, slot: Slot, failure: str) -> tuple[Belief, str]:
        """Return the belief after a slot, or, where the model cannot be evaluated, the one before and why."""
        try:
            after = self._recursion.advance(belief, slot)
        except (FloatingPointError, np.linalg.LinAlgError) as error:
            return belief, f"held from t = {slot.t:g} s on: {error}"
        if np.isfinite(after.z).all() and not np.isnan(after.P).any():
            return after, failure
        return belief, f"held from t = {slot.t:g} s on: the model or the covariance is not finite"

    def _drive(self, state: FilterState, t0: float, t1: float, times: Array, rows: Array) -> tuple[Mesh, Array, Array]:
        """Return the mesh from `t0` to `t1` and the inputs at both ends of its slots."""
        if t1 <= t0:
            mesh = Mesh(np.array([t0]), NOTHING, NOTHING.astype(bool), NOTHING.astype(int), self._slack(t0))
            none = np.empty((0, len(self.model.u)))
            return mesh, none, none
        u_times, u = state.inputs.arrays(t1)
        mesh = self.assembly.mesh(t0, t1, Records(times, rows, u_times, u), growing=False)
        if not len(self.model.u):
            none = np.empty((len(mesh), 0))
            return mesh, none, none
        self._input_at(state, t0)
        return mesh, *held_inputs(u_times, u, mesh.t, mesh.tolerance, False)

    def _input_at(self, state: FilterState, t: float) -> Array:
        """Return the input (nu,) that holds at `t`."""
        if not len(self.model.u):
            return NOTHING
        times, rows = state.inputs.arrays(t + self._slack(t))
        if not len(times):
            raise InputError(
                f"no input is known at t = {t:g} s for {', '.join(self.model.u.names)}; give "
                f"control(state, Input(t={t:g}, u=...)) first"
            )
        return rows[-1]

    def _output(self, t: float, x: Array, u: Array, w: Array, p: Array) -> Array:
        try:
            return frozen(self.stage.output(t, x, u, w, p))
        except FloatingPointError:
            return frozen(np.full(len(self.model.y), np.nan))

    def _slack(self, t: float) -> float:
        return same_time(self.interval, t)

    def _check_age(self, state: FilterState, t: float, what: str) -> None:
        if t < state.t - self._slack(t):
            raise TooLate(
                f"{what} at t = {t:g} s is older than the last estimate at {state.t:g} s, and a filter cannot go back: "
                "hand it over before estimating, or use an MHE, whose window takes late ones"
            )

    def _check_step(self, t: float, what: str) -> None:
        step = self.model.step
        if step is not None and abs(t - round(t / step) * step) > max(1e-6 * step, self._slack(t)):
            raise InputError(f"{what} at t = {t:g} s is not at a multiple of the discrete model's step {step:g} s")

    def _checked(self, state: Any) -> FilterState:
        if not isinstance(state, FilterState):
            hint = "; estimate returns the pair (state, estimate): unpack it" if isinstance(state, tuple) else ""
            raise InputError(f"expected the state that a filter returned, got {type(state).__name__}{hint}")
        if (len(state.x), state.measurements.width) != (len(self.model.x), len(self.model.y)):
            raise InputError(f"this state belongs to another model than {self.model.name!r}: it has other signals")
        return state


def _rebuild(configuration: dict[str, Any]) -> Filter:
    return Filter(**configuration)
