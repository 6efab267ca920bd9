"""Moving horizon estimation on explicit state: thesis 3.2, eq. (3.12)-(3.19), and its discrete-time form (3.6)."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from math import floor
from typing import Any

import numpy as np

from ctmhe.certificates.guarantee import Guarantee, WindowStart
from ctmhe.data.log import Log
from ctmhe.data.window import fed_inputs, held_inputs
from ctmhe.errors import InputError, NotEstimated, TooLate
from ctmhe.estimators.base import check_wait
from ctmhe.estimators.guaranteed import Guaranteed
from ctmhe.estimators.guesses import open_loop, resting_guess, starting_points
from ctmhe.estimators.outlook import carried_covariance, prior_covariance
from ctmhe.estimators.priors.base import Anchor, Filtering, Memory, Prior, Told, prior_of
from ctmhe.estimators.priors.decrease import improved
from ctmhe.estimators.priors.suboptimal import Suboptimal
from ctmhe.estimators.state import State, load_state, save_state
from ctmhe.estimators.trajectories import empty_path, path_at, path_rows, trajectory_at
from ctmhe.models.continuous import Model
from ctmhe.models.observer import known_inputs
from ctmhe.models.signals import Signals
from ctmhe.solvers.base import Solution, Solver
from ctmhe.solvers.compiled import compiled_solver
from ctmhe.solvers.dual import DualIterations
from ctmhe.solvers.gauss_newton import GaussNewton
from ctmhe.solvers.ipopt import Ipopt
from ctmhe.solvers.ladder import climb
from ctmhe.solvers.updates import CompiledUpdates
from ctmhe.solvers.verification import verify as check
from ctmhe.transcription.assembly import Assembly, Records, hold_kinds
from ctmhe.transcription.grid import Mesh, plain_mesh, same_time
from ctmhe.transcription.integrators import Integrator, StepMap
from ctmhe.transcription.problem import Guess, Window
from ctmhe.transcription.solved import Layout, Solved
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import (
    Array,
    Bounds,
    Delayed,
    DiscountedCost,
    Estimate,
    Input,
    Measurement,
    Outcome,
    Status,
    finite_time,
    frozen,
    made,
    positive,
)

logger = logging.getLogger(__name__)

NOTHING = np.empty(0)

SOLVERS = ("gauss-newton", "numpy", "ipopt")


@dataclass(frozen=True, eq=False)
class Prediction:
    """The state carried forward from the last estimate, without disturbance.

    Attributes
    ----------
    t : float
    x : array (nx,), p : array (np,), y : array (ny,)
        State, parameters and predicted output at `t`.
    """

    t: float
    x: Array
    p: Array
    y: Array


class MHE:
    """Moving horizon estimator: configuration and compiled functions, immutable once built.

    All that changes lives in an explicit state: `state = mhe.init(...)`, then `control`, `observe` and `estimate`,
    each of which returns a new state and leaves the old one valid.

    Parameters
    ----------
    model : Model
        A `ContinuousModel`, `DiscreteModel` or `FmuModel`.
    horizon : float
        Length T of the window in seconds; the window grows to it from t0. Infinite: full information estimation, a
        window that goes on growing, and so do the time of a solve and the memory.
    interval : float, optional
        Shooting interval and cell on which w is constant, seconds, anchored at its absolute multiples. The step of a
        `DiscreteModel` when left out.
    integrator : RK4 or CVODES, optional
        Not for a `DiscreteModel`, which has its own step map.
    cost : DiscountedCost
        Weights and discount. A prior weight over states only holds the parameters at their given values; one over
        states and parameters estimates them.
    prior : {"filtering", "smoothing", "turnpike"} or Prior, optional
        Where the window's prior comes from: the estimated trajectory (3.18), the last solution (6.65), the solution
        half a horizon later (6.66), or a rule of your own. P = 0 is no prior at all.
    bounds : Bounds, optional
        Imposed on x at every node (cell edges, samples, input switches), on w and p, and on y and the output residual
        at the nodes.
    hold : {"zero", "linear", "point"} or mapping output -> one of these, optional
        `zero` and `linear` rebuild the whole signal from the samples, weighted by R; `point` counts each sample at
        its own time, weighted by R_point. Default `zero`.
    hold_limit : float, optional
        Seconds for which a held sample counts when its sensor falls silent; the horizon when left out.
    input_hold : {"zero", "linear"}
        How the known input runs between its samples.
    filtering : bool
        `DiscreteModel` only: count the measurement at the estimate's own time.
    delay : float, optional
        Seconds, at most the horizon: every estimate then also has the state of that long ago, `Estimate.delayed`, which
        knows what was measured since (6.47), (6.76). A multiple of the step for a `DiscreteModel`.
    longest_wait : float, optional
        The longest wait between estimates, if declared; must be shorter than the horizon (3.19).
    guarantee : Guarantee, optional
        A certificate and how large disturbances are: every estimate then has a `bound`, or says why not.
    solver : {"gauss-newton", "numpy", "ipopt"} or DualIterations
        `gauss-newton` runs in the compiled core; `numpy` is the same method in Python, which also takes over where
        there is no core; `ipopt` is the reference.
    compile : {"auto", "off"}, optional
        `auto` compiles the model's functions together with the core, where a C compiler is found and they can be
        generated: once per model, in seconds, cached on disk. `off` evaluates them in CasADi's virtual machine. When
        left out, `$CTMHE_COMPILE`, else `auto`.
    tolerance : float, optional
        Of the cost, relative: what a further iteration would still gain (1e-9 when left out). The estimate is then off
        by about the square root of this, in standard deviations.
    max_iterations : int, optional
        Real time: stop after so many iterations and take the iterate for the estimate, `Outcome.ITERATION_LIMIT`; 1 is
        the real-time iteration. When left out, iterate until converged, and where 100 are not enough ask others.
    deadline : float, optional
        Real time: seconds by `clock` after which a solve stops between two iterations, `Outcome.DEADLINE`.
    verify : bool
        Check every converged solve against IPOPT; for tests.
    clock : callable, optional
        Seconds, for `Estimate.seconds`.

    Raises
    ------
    InputError
        For lengths that are not positive, weights and bounds that do not fit, unknown names, a delay that is longer
        than the horizon, and a declared wait that is not shorter.
    """

    def __init__(
        self,
        model: Model,
        *,
        horizon: float,
        interval: float | None = None,
        integrator: Integrator | None = None,
        cost: DiscountedCost,
        prior: str | Prior = "filtering",
        bounds: Bounds | None = None,
        hold: Any = None,
        hold_limit: float | None = None,
        input_hold: str = "zero",
        filtering: bool = False,
        delay: float | None = None,
        longest_wait: float | None = None,
        guarantee: Guarantee | None = None,
        solver: str | DualIterations = "gauss-newton",
        compile: str | None = None,
        tolerance: float | None = None,
        max_iterations: int | None = None,
        deadline: float | None = None,
        verify: bool = False,
        clock: Callable[[], float] = time.perf_counter,
    ):
        given = locals()
        self._configuration: dict[str, Any] = {key: given[key] for key in given if key not in ("self", "__class__")}
        self.model, self.clock = model, clock
        if not isinstance(model, Model):
            raise InputError(f"model must be a ContinuousModel, DiscreteModel or FmuModel, got {type(model).__name__}")
        self.controls = known_inputs(model)
        self.fed = self.controls is not model.u  # an observer, fed with the measurements
        if bounds is not None and not isinstance(bounds, Bounds):
            raise InputError(f"bounds must be a Bounds(x=..., w=..., p=..., y=..., residual=...), got {bounds!r}")
        self.suboptimal = prior if isinstance(prior, Suboptimal) else None
        least = 1 if self.suboptimal is None else 0
        if not (max_iterations is None or (isinstance(max_iterations, int) and max_iterations >= least)):
            zero = " (0 needs a candidate: prior=Suboptimal(...))" if max_iterations == 0 else ""
            raise InputError(f"max_iterations must be a positive integer, got {max_iterations!r}{zero}")
        if deadline is not None:
            deadline = positive("deadline", deadline, "seconds")
        self._real_time = max_iterations is not None or deadline is not None
        if solver == "ipopt" and (deadline is not None or (max_iterations is not None and self.suboptimal is None)):
            raise InputError(
                "deadline is for Gauss-Newton, and so is max_iterations unless a candidate guards the iterate "
                "(prior=Suboptimal(...)): IPOPT runs to convergence"
            )
        self.horizon = np.inf if horizon == np.inf else positive("horizon", horizon, "seconds")
        self.prior = prior_of(prior)
        self._says: Callable[..., Told] | None = getattr(self.prior, "told", None)
        self._revises: Callable[[Memory, float], Memory] | None = getattr(self.prior, "revised", None)
        if model.step is not None:
            if integrator is not None:
                raise InputError("integrator: a DiscreteModel has its own step map; leave the integrator out")
            if interval is not None and abs(interval - model.step) > 1e-9 * model.step:
                raise InputError(f"interval: must be the model's step {model.step:g} s or left out, got {interval:g}")
            integrator, interval = StepMap(), model.step
        elif integrator is None or interval is None:
            raise InputError("a ContinuousModel needs interval= (seconds) and integrator=RK4(step=...) or CVODES(...)")
        elif isinstance(integrator, type) or not isinstance(integrator, Integrator):
            raise InputError(f"integrator must be RK4(step=...) or CVODES(rtol=..., atol=...), got {integrator!r}")
        self.interval = positive("interval", interval, "seconds")
        if self.interval > self.horizon * (1 + 1e-9):
            raise InputError(f"interval {self.interval:g} s is longer than the horizon {self.horizon:g} s")
        self.integrator = integrator
        self.bounds = bounds or Bounds()
        if not isinstance(cost, DiscountedCost):
            raise InputError(f"cost must be a DiscountedCost, got {type(cost).__name__}")
        self.cost = cost
        self.longest_wait = longest_wait
        if longest_wait is not None:
            check_wait(self.horizon, positive("longest_wait", longest_wait, "seconds"))
        self.delay = None if delay is None else self._checked_delay(delay)
        dual = solver if isinstance(solver, DualIterations) else None
        if dual is None and solver not in SOLVERS:
            raise InputError(f"solver must be one of {', '.join(SOLVERS)} or DualIterations(...), got {solver!r}")
        self.hold_limit = self.horizon if hold_limit is None else positive("hold_limit", hold_limit, "seconds")
        # what the core does by itself: the filtering prior with one weight
        self._plain_prior = type(self.prior) is Filtering and not callable(cost.P)
        self.hold = dict(zip(model.y.names, hold_kinds(model, hold), strict=True))
        signal = any(kind != "point" for kind in self.hold.values())
        self.stage = StageFunction(model, integrator, signal=signal, interval=self.interval)
        self.assembly = Assembly(
            model,
            self.stage,
            cost,
            self.bounds,
            interval=self.interval,
            hold=hold,
            hold_limit=self.hold_limit,
            input_hold=input_hold,
            filtering=filtering,
        )
        self.guaranteed = None if guarantee is None else Guaranteed(guarantee, self)
        limits: dict[str, Any] = {"max_iterations": max_iterations or 100, "deadline": deadline, "clock": clock}
        limited = max_iterations or None if self.suboptimal is not None else None
        if tolerance is not None:
            limits["tolerance"] = positive("tolerance", tolerance)
        self._gauss_newton = GaussNewton(self.stage, **limits)
        self._reference = Ipopt(self.stage, max_iterations=limited)
        # how often a model that is not ours (an FMU) could not be evaluated, and the last time in words
        self._failures: Callable[[], tuple[int, str]] | None = getattr(model, "failures", None)
        compile = compile or os.environ.get("CTMHE_COMPILE") or "auto"
        if compile not in ("off", "auto"):
            raise InputError(f"compile must be 'off' or 'auto', got {compile!r}")
        self._solver: Solver = self._reference if solver == "ipopt" else self._gauss_newton
        compiled = None
        if solver == "gauss-newton" or dual:
            choice = {"specialise": compile == "auto" and not dual, "p_estimated": self.assembly.p_estimated}
            compiled = compiled_solver(self.stage, **choice, **limits)
            self._solver = compiled or self._gauss_newton
        self._idle = max_iterations == 0
        self._covariance = (compiled or self._gauss_newton).covariance
        self._layout = Layout.of(self.stage)
        self._updates = None
        if dual is not None:
            self._solver, self._real_time = dual.on(self.stage, self._solver), True
        elif compiled is not None and CompiledUpdates.covers(self.assembly):
            self._updates = CompiledUpdates(compiled, self.assembly, self._layout, real_time=self._real_time)
        self._check = Ipopt(self.stage, options={"ipopt.mu_init": 1e-8}) if verify else None
        self._holds = bool(self.assembly.held.any())
        self._silent, self._unmeasured = np.zeros(len(model.w)), np.empty((0, len(model.y)))
        if self.suboptimal is not None:
            unmet = self.suboptimal.bound(self).bounds.unmet
            if self.guaranteed is not None:
                self.guaranteed.unmet = (*self.guaranteed.unmet, *unmet)
        self._widths = (self.stage.nx + self.stage.np, self.stage.ny)  # of a state of this estimator

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self._configuration,)

    def __repr__(self) -> str:
        kind = f"{type(self.integrator).__name__}, interval {self.interval:g} s"
        return f"MHE of {self.model.name!r}: horizon {self.horizon:g} s, {kind}, eta {self.cost.eta:g}"

    def _checked_delay(self, delay: Any) -> float:
        if delay != 0:
            delay = positive("delay", delay, "seconds")
        if delay > self.horizon * (1 + 1e-9):
            raise InputError(
                f"the delay of {delay:g} s is longer than the horizon of {self.horizon:g} s: no window reaches back to "
                "the state that is asked for. Lengthen the horizon, or wait less; half the horizon is the most of use"
            )
        step = self.model.step
        if step is not None and abs(delay - round(delay / step) * step) > 1e-6 * step:
            raise InputError(f"the delay of {delay:g} s is not a multiple of the discrete model's step {step:g} s")
        return float(delay)

    def changed(self, **configuration: Any) -> MHE:
        """Return this estimator with some arguments changed."""
        unknown = [name for name in configuration if name not in self._configuration]
        if unknown:
            raise InputError(f"MHE has no argument {unknown[0]!r}. Known: {', '.join(self._configuration)}")
        return _rebuild(self._configuration | configuration)

    @property
    def p_estimated(self) -> bool:
        """Whether the prior's weight covers the parameters."""
        return self.assembly.p_estimated

    @property
    def input_linear(self) -> bool:
        """Whether inputs are interpolated between their samples."""
        return self.assembly.input_linear

    def init(self, *, t: float = 0.0, x: Any, p: Any = None) -> State:
        """Return the state at the start of estimation.

        Parameters
        ----------
        t : float
            Time t0 in seconds.
        x : array (nx,) or mapping name -> value
            Initial estimate chi_hat, model units.
        p : array (np,) or mapping, optional
            Initial (or known) parameters; the model's start values when left out.
        """
        t = finite_time(t, "init")
        model = self.model
        x0 = model.x.vector(x, "init")
        p0 = model.p.vector(model.p_start if p is None else self._named(model.p, p, model.p_start), "init")
        inputs = Log(len(self.controls))
        u_start = getattr(model, "u_start", None)
        if len(self.controls) and u_start is not None:
            inputs = inputs.put(t, frozen(u_start))
        start = frozen(np.concatenate([x0, p0]))
        state = State(t, t, start, x0, p0, Log(len(model.y)), inputs, empty_path(self.stage), t)
        state = made(State, state.__dict__ | {"memory": self.prior.begin(self, state)})
        if self.guaranteed is not None:
            state = made(State, state.__dict__ | {"track": self.guaranteed.begin(t, x0)})
            for reason in self.guaranteed.outside(p0):
                state = self.doubt(state, np.inf, reason)
        return state

    def doubt(self, state: State, t: float, reason: str) -> State:
        """Return the state that knows that its data at `t` are not what a guarantee assumes, such as a lost message.

        Estimates whose window reaches back to `t`, or to before the next record, then have no bound, for this reason;
        never again one if `t` is infinite.
        """
        state = _checked(state, self)
        if not isinstance(t, (int, float, np.number)) or np.isnan(t) or not isinstance(reason, str):
            raise InputError(f"doubt: expected a time in seconds (inf: for good) and a reason, got {t!r}, {reason!r}")
        state = self._revised(state, float(t))
        return made(State, state.__dict__ | {"doubts": (*state.doubts, (float(t), reason))})

    def _revised(self, state: State, t: float) -> State:
        """Return the state whose bounds do not rest on what was solved with other data at `t` and later."""
        if t >= state.t - self.slack(t):
            return state
        fields: dict[str, Any] = {}
        if self.guaranteed is not None and state.track is not None:
            fields["track"] = self.guaranteed.bounds.resumed(state.track, state.t, since=t)
        if self._revises is not None:
            fields["memory"] = self._revises(state.memory, t)
        return made(State, state.__dict__ | fields) if fields else state

    @staticmethod
    def _named(signals: Signals, values: Any, default: Array) -> Any:
        """Return a mapping completed by the default values, anything else unchanged."""
        return dict(zip(signals.names, default, strict=True)) | values if isinstance(values, dict) else values

    def observe(self, state: State, measurement: Measurement) -> State:
        """Return the state that also knows `measurement`: any order, late, partial (NaN or names left out).

        Raises
        ------
        TooLate
            If it is older than the window of the last estimate.
        InputError
            For wrong shapes, unknown names, infinite values, or a sensor that says two different things at one time.
        """
        state = _checked(state, self)
        if not isinstance(measurement, Measurement):
            raise InputError(f"observe expects a Measurement(t, y), got {type(measurement).__name__}")
        t = measurement.t
        row: Any = measurement.y
        complete = self.model.y.complete(row)
        if not complete:
            row = self.model.y.vector(row, f"measurement at t = {t:g}", missing=np.nan, allow_nan=True)
        self._check_age(state, t, "measurement")
        if not complete and not np.isfinite(row).any():
            return state if self.guaranteed is None else self.doubt(state, t, f"no output has a value at t = {t:g} s")
        t = self._at_step(t, "measurement")
        known = state.measurements.find(t)
        if known is not None:
            conflict = np.isfinite(known) & np.isfinite(row) & (known != row)
            if conflict.any():
                i = int(np.flatnonzero(conflict)[0])
                raise InputError(
                    f"measurement at t = {t:g}: output {self.model.y.names[i]!r} is {row[i]:g} "
                    f"but was {known[i]:g} at the "
                    "same time; give each sample its own time"
                )
            row = np.where(np.isfinite(row), row, known)
        return self._revised(state, t).knowing(state.measurements.put(t, row), state.inputs)

    def control(self, state: State, value: Input) -> State:
        """Return the state that also knows the input from `value.t` on; at one time the last one given counts."""
        state = _checked(state, self)
        if not isinstance(value, Input):
            raise InputError(f"control expects an Input(t, u), got {type(value).__name__}")
        u: Any = value.u
        if not self.controls.complete(u):
            u = self.controls.vector(u, f"input at t = {value.t:g}")
        if state.solves:
            self._check_age(state, value.t, "input")
        return self._revised(state, value.t).knowing(state.measurements, state.inputs.put(value.t, u))

    def slack(self, t: float) -> float:
        """Return the difference below which two times near `t` are the same."""
        return same_time(self.interval, t)

    def _check_age(self, state: State, t: float, what: str) -> None:
        edge = state.t - self.horizon
        if t >= state.t0 and t >= edge:
            return
        if t < state.t0 - self.slack(t):
            raise TooLate(f"{what} at t = {t:g} s is older than the start of estimation at {state.t0:g} s")
        if t < edge - self.slack(t):
            raise TooLate(
                f"{what} at t = {t:g} s is older than the window, which starts at {edge:g} s; a longer horizon "
                f"(now {self.horizon:g} s) accepts later arrivals"
            )

    def _at_step(self, t: float, what: str) -> float:
        """Return the time of the step at which something was measured: what differs by round-off is one step."""
        step = self.model.step
        if step is None:
            return t
        whole = round(t / step) * step
        if abs(t - whole) > max(1e-6 * step, self.slack(t)):
            raise InputError(f"{what} at t = {t:g} s is not at a multiple of the discrete model's step {step:g} s")
        return whole

    def estimate(self, state: State, t: float) -> tuple[State, Estimate]:
        """Solve the problem of the window that ends at `t`.

        Parameters
        ----------
        state : State
        t : float
            Seconds; not before the last estimate.

        Returns
        -------
        state : State
            With the estimate's piece appended to the trajectory (3.16) and what left the horizon dropped.
        estimate : Estimate

        Raises
        ------
        NotEstimated
            If `t` lies before the last estimate: `smooth` gives that.
        InputError
            If no input is known at the window's start for a model with inputs.
        """
        began = self.clock()
        state = _checked(state, self)
        t = finite_time(t, "estimate")
        if t < state.t:
            if t < state.t - self.slack(t):
                raise NotEstimated(
                    f"estimate at t = {t:g} s lies before the last one at {state.t:g} s; "
                    "smooth(state, t) gives estimates of the past"
                )
            t = state.t
        failing = self._failures
        failures = failing()[0] if failing else 0
        since = state.since if t == state.t else state.t  # a solve repeated with what has arrived takes its own place
        if self.suboptimal is not None:
            return self._improve(state, t, since, failures, began)
        if self._updates is not None:
            span, growing = self._span(state, t)
            logs = self._logs(state, *span)
            anchor, notes = self._anchor(state, span, growing)
            request = (span, growing, *logs, state.window, state.p, (state.t, since), anchor)
            update = self._updates.run(*request, state.prepared)
            if update is not None:
                added, status = (update.path_times, update.path_rows), self._told(update.status, failures)
                if notes:
                    status = replace(status, notes=(*notes, *status.notes))
                return self._conclude(state, t, since, update.solved, added, update.cost, status, began)
        window, notes = self._window(state, t)
        guesses = starting_points(self.stage, state, window)
        rungs = (window, self._solver, lambda: self._reference, guesses, notes)
        evaluable = (lambda: failing()[0] == failures) if failing else (lambda: True)
        nx = self.stage.nx
        held = partial(resting_guess, self.stage, window, state.start[:nx], state.start[nx:])
        solution, status = climb(*rungs, real_time=self._real_time, evaluable=evaluable, rescue=held)
        if solution is None:
            solution = open_loop(self.stage, state, window)
        status = self._told(status, failures)
        solved = self._packed(window, solution)
        added = path_rows(solved.trajectory, since)
        return self._conclude(state, t, since, solved, added, solution.cost, status, began)

    def _improve(self, state: State, t: float, since: float, failures: int, began: float) -> tuple[State, Estimate]:
        """Return what `estimate` does with a candidate at hand: no estimate costs more (4.15)."""
        rule, growing = self.suboptimal, self._span(state, t)[1]
        assert rule is not None
        span = self._span(state, t)[0]
        anchor, notes = self._anchor(state, span, growing)
        window = None
        if self._updates is not None:
            logs, last = self._logs(state, *span), state.window
            found = self._updates.assembled(span, growing, *logs, last, state.p, (state.t, since), anchor)
            window = None if found is None else found[0]
        if window is None:
            window, notes = self._window(state, t)
        elif not window.L_y.any():
            notes = (*notes, "no measurement in window")
        bound = rule.bound(self)
        run = rule.simulate(self, state, window)
        candidate = rule.propose(self, state, window, run)
        start = candidate if self._idle else rule.first_guess(self, state, window, candidate)
        notes = tuple(dict.fromkeys((*notes, *run.notes, *bound.note(window, run.x, self.model.x.names))))
        solver = None if self._idle else self._solver
        solution, status, kept = improved(
            self.stage, window, solver, candidate, start, process=bound.process, exact=bound.affine, notes=notes
        )
        if status.outcome is Outcome.PREDICTED:
            solution = open_loop(self.stage, state, window)
        given = None if self.guaranteed is None else rule.known(self, state, window, run, candidate, kept)
        solved, status = self._packed(window, solution), self._told(status, failures)
        added = path_rows(solved.trajectory, since)
        return self._conclude(state, t, since, solved, added, solution.cost, status, began, given, run.since)

    def _logs(self, state: State, start: float, end: float) -> tuple[Log, Log, Log]:
        """Return what the core reads."""
        if not self.fed:
            return state.measurements, state.inputs, state.path
        times, rows = self._known_inputs(state, start, end, fed_until=np.inf)
        return state.measurements, Log.of(times, rows, rows.shape[1]), state.path

    def prepare(self, state: State, t: float, *, outputs: Iterable[str] | None = None) -> State:
        """Do what can be done for the estimate at `t` before the newest measurement is there.

        Real time: the window that ends at `t` is assembled, linearised at the warm start and factorised, as if
        `outputs` were measured at `t`. When they arrive, `estimate(state, t)` has only the last slot to linearise, and
        a gradient sweep, a step and the outputs to compute. Its result is the same, to the last bit, as without, and
        stays so when something else arrives: what was prepared is compared with what is needed, slot by slot.

        What is prepared lies in this thread's scratch memory until it solves something else. Without the compiled core
        there is nothing to prepare.

        Parameters
        ----------
        state : State
        t : float
            Time of the next estimate, seconds.
        outputs : iterable of str, optional
            Those that will be measured at `t`; all when left out.

        Returns
        -------
        state : State
            To be given to `observe`, `control` and `estimate`.
        """
        state, t = _checked(state, self), finite_time(t, "prepare")
        if t < state.t - self.slack(t):
            raise NotEstimated(f"prepare at t = {t:g} s lies before the last estimate at {state.t:g} s")
        expected = np.full(len(self.model.y), np.nan)
        expected[[self.model.y.index(name) for name in (self.model.y.names if outputs is None else outputs)]] = 0.0
        if self._updates is None or self.fed or self.suboptimal is not None:
            return state
        measurements = state.measurements
        if measurements.find(t) is None:
            measurements = measurements.put(t, expected)
        since = state.since if t == state.t else state.t
        span, growing = self._span(state, t)
        logs, anchor = (measurements, state.inputs, state.path), self._anchor(state, span, growing)[0]
        ticket = self._updates.prepare(span, growing, *logs, state.window, state.p, (state.t, since), anchor)
        return made(State, state.__dict__ | {"prepared": ticket})

    def _told(self, status: Status, before: int) -> Status:
        """Add to a status what the model could not evaluate since it had failed `before` times."""
        if self._failures is None:
            return status
        count, last = self._failures()
        if count == before:
            return status
        times = "once" if count == before + 1 else f"{count - before} times, last"
        return replace(status, notes=(*status.notes, f"the model could not be evaluated ({times}: {last})"))

    def _span(self, state: State, end: float) -> tuple[tuple[float, float], bool]:
        """Return start and end of the window that ends at `end`, and whether it still grows."""
        start = end - self.horizon
        growing = start <= state.t0 + self.slack(end)
        return (state.t0 if growing else start, end), growing

    def _window(self, state: State, end: float) -> tuple[Window, tuple[str, ...]]:
        """Return the problem of the window that ends at `end`, and what there is to note about it."""
        (start, _), growing = self._span(state, end)
        anchor = self._prior(state, start, growing)
        weight = {"prior_factor": anchor.factor, "prior_weight": anchor.weight}
        records = self.records(state, start, end)
        window = self.assembly.window(start, end, records, anchor.value, growing=growing, **weight)
        return window, anchor.notes if window.L_y.any() else (*anchor.notes, "no measurement in window")

    def _anchor(
        self, state: State, span: tuple[float, float], growing: bool
    ) -> tuple[tuple[Array, Array | None] | None, tuple[str, ...]]:
        """Return the prior as the core takes it, with the root of its weight where that is not the cost's; and notes.

        None instead of a prior that the core finds itself.
        """
        if self._plain_prior:
            return (state.start, None) if growing else None, ()
        start, end = span
        anchor = self._prior(state, start, growing)
        if anchor.weight is None and anchor.factor == 1.0 and not callable(self.cost.P):
            return (anchor.value, None), anchor.notes
        root = self.assembly.prior_root(start, end - start, anchor.factor, anchor.weight)
        return (anchor.value, root), anchor.notes

    def _prior(self, state: State, start: float, growing: bool) -> Anchor:
        """Return the prior of a window.

        In a gap longer than the horizon no solution reaches back to the window's start: the prior is the prediction,
        and its weight fades by exp(-g / T) on top of the discount's eta^g for a gap of g seconds beyond it.
        """
        anchor = self.prior.at(self, state, start, growing)
        if anchor is not None:
            return anchor
        gap = max(start - state.t, 0.0)
        x = self.propagate(state, state.t, start, state.x, state.p)
        factor = float(np.exp(-gap * (self.assembly.prior_rate + 1.0 / self.horizon)))
        return Anchor(np.concatenate([x, state.p]), ("prior predicted, uncertified",), factor)

    def records(self, state: State, start: float, end: float) -> Records:
        """Return the measurements and inputs that `state` knows, as far as they matter on [start, end] (seconds)."""
        y_times, y = state.measurements.arrays(end + self.slack(end))
        return Records(y_times, y, *self._known_inputs(state, start, end, fed_until=np.inf))

    def _known_inputs(
        self, state: State, start: float, end: float, *, fed_until: float | None = None
    ) -> tuple[Array, Array]:
        """Return the inputs that matter on [start, end]: for linear hold also the first one behind it, if known.

        An observer is fed with measurements until `fed_until`, `start` when left out: a prediction has none.
        """
        times, rows = state.inputs.arrays(end, beyond=int(self.assembly.input_linear))
        if len(self.controls) and (not len(times) or times[0] > start + self.slack(start)):
            raise InputError(
                f"no input is known at t = {start:g} s for {', '.join(self.controls.names)}; give "
                f"control(state, Input(t={start:g}, u=...)) first"
            )
        if self.fed:
            return self.fed_inputs(state, start, end, until=start if fed_until is None else fed_until)
        return times, rows

    def fed_inputs(self, state: State, start: float, end: float, *, until: float = np.inf) -> tuple[Array, Array]:
        """Return times and rows of an `observer_model`'s inputs: the known ones, and what was measured `until` then."""
        inputs = state.inputs.arrays(end)
        slack, step = self.slack(end), self.model.step
        measured = state.measurements.arrays(min(end, until) + slack)
        limit, until = (self.hold_limit, until) if step is None else (step, np.inf)
        times, rows = fed_inputs(inputs, measured, limit, until)
        if not len(times) or times[0] > start + slack:
            times, rows = np.append(start, times), np.vstack([np.zeros((1, rows.shape[1])), rows])
        return times, rows

    def solve_window(
        self, window: Window, guesses: list[tuple[str, Callable[[], Guess]]]
    ) -> tuple[Solved | None, float, Status]:
        """Solve any window of this estimator's assembly: its solution (None when no solver gave numbers), cost, status.

        Parameters
        ----------
        window : Window
        guesses : list of (name, function returning a Guess)
            Where to start, best first.
        """
        notes = () if window.L_y.any() else ("no measurement in window",)
        solution, status = climb(window, self._solver, lambda: self._reference, guesses, notes)
        if solution is None:
            return None, float("nan"), status
        return self._packed(window, solution), solution.cost, status

    def _packed(self, window: Window, solution: Solution) -> Solved:
        """Return a solver's result as the blocks that the core would have written."""
        point = solution.point
        arrays = vars(point) | {
            "t": window.mesh.t, "y": solution.y, "u0": window.u0, "u1": window.u1, "prior": window.prior,
        }  # fmt: skip
        if solution.multipliers is not None:
            arrays |= {f"{name}_multiplier": array for name, array in vars(solution.multipliers).items()}
        return Solved.of(self._layout, arrays)

    def _conclude(
        self,
        state: State,
        t: float,
        since: float,
        solved: Solved,
        added: tuple[Array, Array],
        cost: float,
        status: Status,
        began: float,
        given: WindowStart | None = None,
        observed: float = np.inf,
    ) -> tuple[State, Estimate]:
        """Return the next state and the estimate of a solved window; `added` is what it adds to the path.

        `given` is what is known of the prior of a suboptimal estimator, whose observer began at `observed`.
        """
        if self._check is not None and status.success:
            check(self._window(state, t)[0], solved, cost, self._check)
        x, p, w, y = solved.last()
        if self.model.step is not None:
            u = solved.part("u1")[-1]
            idle = solved.part("t")[-1] == solved.part("t")[-2]
            y = frozen(self._output(t, x, u, w if idle else self._silent, p))
        edge = t - self.horizon
        slack = 1e-6 * self.interval
        path = state.path if t > state.t else state.path.drop_after(since)
        held = (self.hold_limit if self._holds else 0.0) + self.prior.reach
        inputs = state.inputs
        fields = {
            "t": t,
            "x": x,
            "p": p,
            "measurements": state.measurements.drop_before(edge - held - slack),
            "inputs": inputs.drop_before(edge - self.prior.reach - slack, keep_holding=True) if len(inputs) else inputs,
            "path": path.extend(*added).drop_before(edge - slack),
            "since": since,
            "window": solved,
            "solves": state.solves + 1,
            "prepared": None,
        }
        bound, known = None, state.doubts
        if self.guaranteed is not None:
            first = float(solved.part("t")[0])
            times, rows = state.measurements.arrays(t + self.slack(t))
            track = self.guaranteed.resume(state.track, state.t0, state.start[: self.stage.nx], state.t)
            outside = () if track is state.track else self.guaranteed.outside(state.p)
            known = (*state.doubts, *((np.inf, reason) for reason in outside))
            doubts = self.guaranteed.current(known, times, min(first, observed))
            reasons = [reason for _, reason in doubts] or self.guaranteed.lacking(times, rows, first, t)
            fields["track"], bound = self.guaranteed.after(track, first, t, cost, status, reasons, given)
            fields["doubts"] = self.guaranteed.current(known, times, edge - self.prior.reach - slack)
        new = made(State, state.__dict__ | fields)
        if type(self.prior) is not Filtering:  # a prior that remembers
            # it may look at data that no window needs any more, and at what is doubtful about them
            passing = {"measurements": state.measurements, "inputs": inputs, "doubts": known}
            memory = self.prior.after(self, made(State, new.__dict__ | passing), solved)
            new = made(State, new.__dict__ | {"memory": memory})
        if self.suboptimal is not None and bound is not None:
            new = made(State, new.__dict__ | {"memory": self.suboptimal.bounded(self, new, bound)})
        if self._says is not None:
            told = self._says(self, new, solved)
            x, p = told.value[: self.stage.nx], told.value[self.stage.nx :]
            new, bound = made(State, new.__dict__ | {"x": x, "p": p}), told.bound or bound
            status = replace(status, notes=(*status.notes, *told.notes)) if told.notes else status

        def covariance() -> tuple[Array, int]:
            window, _ = self._window(state, t)
            values, rank = self._covariance(window, solved.guess)
            return frozen(values), rank

        spread = None if status.outcome is Outcome.PREDICTED else covariance
        seconds = self.clock() - began
        fields = {"t": t, "x": x, "p": p, "w": w, "y": y, "cost": cost, "status": status, "_solved": solved,
                  "seconds": seconds, "_covariance": spread, "bound": bound,
                  "delayed": None if self.delay is None else self._delayed(state.t0, t, solved)}  # fmt: skip
        return new, made(Estimate, fields)

    def _delayed(self, t0: float, t: float, solved: Solved) -> Delayed | None:
        """Return the window's state of `delay` seconds ago (6.47), None where that lies before the start."""
        assert self.delay is not None
        past = t - self.delay
        if past < t0 - self.slack(t):
            return None
        past = max(past, t0)
        return made(Delayed, {"t": past, "x": frozen(trajectory_at(self.stage, solved.trajectory, past))})

    def propagate(self, state: State, t0: float, t1: float, x: Array, p: Array) -> Array:
        """Return the state at `t1` from `x` (nx,) at `t0`, without disturbance, under the inputs that `state` knows.

        The last known input is held. For a `DiscreteModel` both times are multiples of its step. Where the model cannot
        be evaluated, the state is held.
        """
        return self.carry(state, t0, t1, x, p)[0] if t1 > t0 else x

    def carry(self, state: State, t0: float, t1: float, x: Array, p: Array) -> tuple[Array, Array]:
        """Return state and output at `t1` along the open loop from `x` at `t0`: `propagate` and `output` in one.

        A slot of the transcription ends with the output there, so that a prediction within a disturbance cell, what a
        trigger asks for at every monitoring time, takes one evaluation.

        Parameters
        ----------
        state : State
            Whose inputs are known; the last one is held.
        t0, t1 : float
            Seconds; multiples of the step for a `DiscreteModel`.
        x : array (nx,)
            At `t0`, in the units of the model.
        p : array (np,)

        Returns
        -------
        x : array (nx,)
            At `t1`, without disturbance; held from where the model cannot be evaluated.
        y : array (ny,)
            Undisturbed output at `t1`; NaN where the model cannot be evaluated.

        Raises
        ------
        InputError
            When no input is known at `t0`.
        """
        if t1 <= t0:
            return x, self.output(state, t1, x, p)
        times, rows = self._known_inputs(state, t0, t1)
        constant = self._is_constant(times, t0)
        slack = self.slack(t1)
        edge = (floor((t0 + slack) / self.interval) + 1) * self.interval
        ends = NOTHING
        try:
            if constant and edge > t0 + slack and edge >= t1 - slack:  # within one cell
                u = rows[-1] if len(rows) else NOTHING
                x, ends = self.stage.step(t0, t1 - t0, x, self._silent, p, u, u)
            else:
                mesh, u0, u1 = self._open_loop(t0, t1, times, rows)
                for k in range(len(mesh)):
                    x, ends = self.stage.step(mesh.t[k], mesh.h[k], x, self._silent, p, u0[k], u1[k])
            if constant:
                return x, ends[-1]
        except FloatingPointError:
            logger.warning("the prediction from t = %g s to %g s holds the state: the model fails", t0, t1)
        return x, self.output(state, t1, x, p)

    def prior_covariance(self, t: float = 0.0) -> Array:
        """Return the covariance (n, n) of (x, estimated p) that the prior's weight P stands for at `t`: its inverse."""
        return frozen(prior_covariance(self.assembly, t))

    def propagate_covariance(self, state: State, t0: float, t1: float, x: Array, p: Array, covariance: Array) -> Array:
        """Return the covariance (n, n) of (x, estimated p) at `t1` along the open loop from `x`, `p` at `t0`.

        What `Estimate.covariance` would be at `t1` if nothing were measured from `t0` on: disturbances of weight Q
        spread it, the discount widens it. Infinite variances stay infinite in all signals that they reach. Where the
        model cannot be evaluated, all variances are infinite.

        Parameters
        ----------
        state : State
            Whose inputs are known; the last one is held.
        t0, t1 : float
            Seconds; multiples of the step for a `DiscreteModel`.
        x : array (nx,)
        p : array (np,)
        covariance : array (n, n)
            At `t0`, with n = nx, or nx + np where the parameters are estimated.
        """
        if t1 <= t0:
            return covariance
        drive = self._open_loop(t0, t1, *self._known_inputs(state, t0, t1))
        try:
            return frozen(carried_covariance(self.stage, self.assembly, *drive, x, p, covariance))
        except FloatingPointError:
            logger.warning("the covariance from t = %g s to %g s is infinite: the model fails", t0, t1)
            return frozen(np.diag(np.full(len(covariance), np.inf)))

    def _is_constant(self, times: Array, t0: float) -> bool:
        """Whether no input known at `times` switches on the way from `t0` on: most predictions in continuous time."""
        return not self.assembly.discrete and not (len(times) and times[-1] > t0)

    def _open_loop(self, t0: float, t1: float, times: Array, rows: Array) -> tuple[Mesh, Array, Array]:
        """Return the mesh of a prediction and the inputs, known at `times`, at both ends of its slots."""
        if self._is_constant(times, t0):
            mesh = plain_mesh(t0, t1, self.interval)
        else:
            mesh = self.assembly.mesh(t0, t1, Records(NOTHING, self._unmeasured, times, rows), growing=False)
        if not len(self.model.u):
            none = np.empty((len(mesh), 0))
            return mesh, none, none
        return mesh, *held_inputs(times, rows, mesh.t, mesh.tolerance, self.assembly.input_linear)

    def output(self, state: State, t: float, x: Array, p: Array) -> Array:
        """Return the undisturbed output (ny,) at `t` for a given state and parameters, under the known input.

        NaN where the model cannot be evaluated.
        """
        u = np.empty(0)
        if len(self.model.u):
            times, rows = self._known_inputs(state, t, t)
            u, _ = held_inputs(times, rows, np.array([t, t]), self.slack(t), self.assembly.input_linear)
            u = u[0]
        return self._output(t, x, u, self._silent, p)

    def _output(self, t: float, x: Array, u: Array, w: Array, p: Array) -> Array:
        try:
            return self.stage.output(t, x, u, w, p)
        except FloatingPointError:  # an FMU that fails there
            return np.full(len(self.model.y), np.nan)

    def predict(self, state: State, t: float) -> Prediction:
        """Return the open-loop prediction at `t` from the last estimate: no disturbance, the last input held.

        Raises
        ------
        NotEstimated
            If `t` lies before the last estimate.
        """
        t = finite_time(t, "predict")
        if t < state.t - self.slack(t):
            raise NotEstimated(
                f"prediction at t = {t:g} s lies before the last estimate at {state.t:g} s; use smooth(state, t)"
            )
        x, y = self.carry(state, state.t, t, state.x, state.p)
        return made(Prediction, {"t": t, "x": frozen(x), "p": state.p, "y": frozen(y)})

    def smooth(self, state: State, t: float) -> Array:
        """Return the state (nx,) at a past time `t` from the last window's solution: all data known then.

        Raises
        ------
        NotEstimated
            If `t` lies outside the last window.
        """
        t = finite_time(t, "smooth")
        if state.window is None:
            raise NotEstimated(f"smooth at t = {t:g} s: the last window covers no estimate yet")
        last = state.window.trajectory
        slack = self.slack(t)
        if not last.t[0] - slack <= t <= last.t[-1] + slack:
            raise NotEstimated(f"smooth at t = {t:g} s: the last window covers [{last.t[0]:g}, {last.t[-1]:g}] s")
        return frozen(trajectory_at(self.stage, last, t))

    def trajectory(self, state: State, t: float) -> Array:
        """Return x_hat(t) (nx,) of the estimated trajectory (3.16), left-continuous, within the last horizon.

        Raises
        ------
        NotEstimated
            If `t` lies outside what the state keeps.
        """
        t = finite_time(t, "trajectory")
        first = state.path.first_from(-np.inf)
        if t == state.t0 and (first is None or first[1][1] == state.t0):
            return frozen(state.start[: self.stage.nx])
        value = path_at(self.stage, state.path, t, self.slack(t))
        if value is None:
            raise NotEstimated(
                f"trajectory at t = {t:g} s: kept is the horizon before the last estimate at {state.t:g} s"
            )
        return frozen(value[: self.stage.nx])

    def trajectory_bound(self, state: State, t: float) -> float | None:
        """Return the guaranteed bound of |x_hat(t) - x(t)|_P_lower along the estimated trajectory (3.20), if any.

        For times within the last horizon, as `trajectory`.
        """
        t = finite_time(t, "trajectory_bound")
        if self.guaranteed is None or state.track is None or self.guaranteed.unmet:
            return None
        if not max(state.t0, state.t - self.horizon) - self.slack(t) <= t <= state.t + self.slack(t):
            raise NotEstimated(
                f"trajectory_bound at t = {t:g} s: kept is the horizon before the last estimate at {state.t:g} s"
            )
        level = self.guaranteed.bounds.at(state.track, t)
        return float(np.sqrt(level)) if np.isfinite(level) else None

    def reference(self, state: State, t: float) -> Estimate:
        """Solve the window that ends at `t` by IPOPT, for checking; the state is not advanced."""
        other = _rebuild(self._configuration | {"solver": "ipopt"})
        return other.estimate(state, t)[1]

    def save(self, state: State, path: Any) -> None:
        """Write a state to a versioned file without pickle."""
        save_state(state, path, self._fingerprint())

    def load(self, path: Any) -> State:
        """Read a state that an estimator of the same signals, horizon, interval, integrator and holds saved.

        Cost, bounds and solver may differ: a saved state can be continued with other weights.
        """
        return load_state(path, self._fingerprint(), self._layout)

    def _fingerprint(self) -> dict[str, Any]:
        return {
            "signals": {key: list(getattr(self.model, key).names) for key in "xuwpy"},
            "horizon": self.horizon,
            "interval": self.interval,
            "integrator": repr(self.integrator),
            "hold": self.hold,
            "hold_limit": self.hold_limit,
            "input_hold": "linear" if self.assembly.input_linear else "zero",
        }


def _checked(state: Any, mhe: MHE) -> State:
    """Return `state`, or raise `InputError` when it is not a state of this estimator."""
    if not isinstance(state, State):
        hint = "; estimate returns the pair (state, estimate): unpack it" if isinstance(state, tuple) else ""
        raise InputError(
            f"expected the state that init, observe or estimate returned, got {type(state).__name__}{hint}"
        )
    if (len(state.start), state.measurements.width) != mhe._widths:
        raise InputError(f"this state belongs to another model than {mhe.model.name!r}: it has other signals")
    return state


def _rebuild(configuration: dict[str, Any]) -> MHE:
    return MHE(**configuration)
