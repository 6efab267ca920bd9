"""Suboptimal MHE (thesis chapter 4): an auxiliary observer gives the prior, and a candidate that bounds the cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from ctmhe.certificates.guarantee import WindowStart
from ctmhe.certificates.observer_function import LuenbergerObserver
from ctmhe.data.log import Log
from ctmhe.data.window import held_inputs
from ctmhe.errors import InputError
from ctmhe.estimators.guesses import shifted_guess, warm_start
from ctmhe.estimators.priors.base import Anchor, Memory
from ctmhe.estimators.priors.decrease import connected
from ctmhe.estimators.priors.suboptimal_bounds import UNKNOWN, Bounded, SuboptimalBounds, additive
from ctmhe.estimators.trajectories import trajectory_at
from ctmhe.models.continuous import Model
from ctmhe.models.observer import gain, observer_model
from ctmhe.transcription.grid import Mesh
from ctmhe.transcription.problem import Guess, Window
from ctmhe.transcription.solved import Solved
from ctmhe.transcription.stage import StageFunction
from ctmhe.types import Array, ErrorBound

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State

CANDIDATES, STARTS = ("system", "observer"), ("candidate", "last")

Start = Callable[["MHE", "State", Window], Guess]


class Simulated(NamedTuple):
    """The auxiliary observer on its way to some time.

    Attributes
    ----------
    since : float
        When it was initialised, or up to when it was remembered, seconds.
    bounded : Bounded
        What bounds V_o then.
    before : array (m, nx)
        z from then to the window's start, or to the time in question.
    x : array (N+1, nx)
        z at the nodes of the window's mesh.
    notes : tuple of str
        Where it failed.
    """

    since: float
    bounded: Bounded
    before: Array
    x: Array
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Suboptimal:
    """Prior and candidate from an observer that starts anew from the estimate of T seconds ago: `MHE(prior=)`.

    Whatever the solver, its warm start and its number of iterations (`max_iterations`, 0 included), the estimate is
    the cheapest of the candidate and the feasible trajectories that the iterate gives: the decrease condition (4.15).

    Parameters
    ----------
    observer : LuenbergerObserver or array (nx, ny), optional
        Its gain, K in z+ = f(z, u, 0) + K (h(z, u, 0) - y) or dz/dt, with what is known of its error, or alone. Left
        out for an MHE of an `observer_model`.
    horizon : float
        T in seconds, not shorter than that of the MHE (4.16). Infinite: the observer is initialised once, T = t
        (Remark 4.6).
    candidate : {"system", "observer"}
        The undisturbed trajectory from where the observer was at the window's start, (4.19) and, projected onto the
        bounds, (4.56); or that of the observer, with the disturbances which make it one of the system, (4.46) and
        (4.64). That needs one disturbance a state.
    start : {"candidate", "last"} or callable (mhe, state, window) -> Guess
        Where the solver starts: at the candidate, or at the last solution carried forward (Remark 4.3).

    Source: thesis 4.2, (4.15)-(4.19), (4.46), (4.53)-(4.57), (4.64); for trajectories of the observer 4.3, (4.75),
    (4.76), which is a horizon as long as the MHE's, and Remark 4.15.
    """

    observer: Any = None
    horizon: float = np.inf
    candidate: str = "system"
    start: str | Start = "candidate"
    _known: WeakKeyDictionary[MHE, Bound] = field(init=False, repr=False, default_factory=WeakKeyDictionary)

    def __post_init__(self) -> None:
        if not (isinstance(self.horizon, (int, float, np.number)) and self.horizon > 0):
            raise InputError(
                f"Suboptimal: horizon T must be a positive number of seconds (inf: T = t), got {self.horizon!r}"
            )
        if self.candidate not in CANDIDATES:
            raise InputError(f"Suboptimal: candidate must be one of {', '.join(CANDIDATES)}, got {self.candidate!r}")
        if not (callable(self.start) or self.start in STARTS):
            raise InputError(
                f"Suboptimal: start must be {', '.join(STARTS)}, or a function of (mhe, state, window), got "
                f"{self.start!r}"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return Suboptimal, (self.observer, self.horizon, self.candidate, self.start)

    @property
    def reach(self) -> float:
        """Seconds of data that the observer needs before the window."""
        return float(self.horizon) if np.isfinite(self.horizon) else 0.0

    def begin(self, mhe: MHE, state: State) -> Memory:
        """Return the observer at the start: it begins at the initial estimate."""
        bound, x = self.bound(mhe), state.start[: mhe.stage.nx]
        first = Log(len(x) + 2).put(state.t0, np.append(x, bound.bounds.initial(mhe, x)))
        return {"observer": first, "key": Log(1).put(state.t0, np.array([bound.bounds.key]))}

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """Return the observer's state at the window's start, projected onto the bounds: (4.18), (4.57)."""
        nx = mhe.stage.nx
        if growing:
            return Anchor(np.concatenate([self.bound(mhe).projected(state.start[:nx]), state.start[nx:]]))
        run = self._until(mhe, state, start, start + mhe.horizon - self.horizon)
        return Anchor(np.concatenate([self.bound(mhe).projected(run.before[-1]), state.p]), run.notes)

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """Return the estimates of the last T seconds, and before them the observer as far as it has got.

        An observer that is initialised once has got to the window's start.
        """
        bound, anew, slack = self.bound(mhe), np.isfinite(self.horizon), mhe.slack(state.t)
        edge = max(state.t - (self.horizon if anew else mhe.horizon), state.t0)
        log, known = self._log(mhe, state), Log(1).put(state.t0, np.array([bound.bounds.key]))
        times, rows = log.arrays()
        if times[0] < edge - slack:
            run = self._until(mhe, state, edge, edge)
            lacking = bound.lacking(mhe, state, run.since, edge)
            bounded = bound.bounds.passed(run.bounded, edge - run.since, run.before, lacking)
            later = times > edge + slack
            rows = np.vstack([np.append(run.before[-1], bounded), rows[later]])
            log = Log.of(np.append(edge, times[later]), rows, rows.shape[1])
        if not anew or state.t <= state.t0 + slack:
            return {"observer": log, "key": known}
        log = log.drop_after(state.t - slack)  # one that is repeated takes its own place
        return {"observer": log.put(state.t, np.append(state.x, UNKNOWN)), "key": known}

    def _log(self, mhe: MHE, state: State) -> Log:
        """Return what is remembered; bounds that another observer or another certificate gave are not."""
        log, key = state.memory.get("observer"), state.memory.get("key")
        if log is None:  # the state of an estimator with another prior
            t = max(state.t - mhe.horizon, state.t0)
            return Log(mhe.stage.nx + 2).put(t, np.append(mhe.trajectory(state, t), UNKNOWN))
        if key is None or key.arrays()[1][0, 0] != self.bound(mhe).bounds.key:
            return self.revised(state.memory, -np.inf)["observer"]
        return log

    def bounded(self, mhe: MHE, state: State, bound: ErrorBound) -> Memory:
        """Return the memory that also knows the bound of the estimate just made."""
        log = state.memory["observer"]
        row = log.find(state.t)
        if row is None or state.t == state.t0:
            return state.memory
        assert mhe.guaranteed is not None
        row[-2:] = self.bound(mhe).bounds.of(bound, within=mhe.guaranteed.within(state.x))
        return {**state.memory, "observer": log.put(state.t, row)}

    def revised(self, memory: Memory, since: float) -> Memory:
        """Return the memory whose bounds do not rest on what was solved with other data at `since` and later."""
        if "observer" not in memory:  # the state of an estimator with another prior
            return memory
        times, rows = memory["observer"].arrays()
        rows = rows.copy()
        rows[times >= since, -2:] = np.inf
        return {**memory, "observer": Log.of(times, rows, rows.shape[1])}

    def bound(self, mhe: MHE) -> Bound:
        """Return what belongs to one estimator."""
        found = self._known.get(mhe)
        if found is None:
            found = self._known[mhe] = Bound(self, mhe)
        return found

    def simulate(self, mhe: MHE, state: State, window: Window) -> Simulated:
        """Run the observer from the estimate T before the window's end, or what is left of it, to that end: (4.17)."""
        t = window.mesh.t
        run = self._until(mhe, state, t[0], t[-1] - self.horizon)
        x = self.bound(mhe).run(mhe, state, run.before[-1], window.mesh)
        whole = np.isfinite(x).all(axis=1)
        if whole.all():
            return run._replace(x=x)
        bad = int(np.argmin(whole))
        x[bad:] = x[bad - 1]
        notes = (*run.notes, f"the observer fails at t = {t[bad]:g} s: it is held from there on")
        return run._replace(x=x, bounded=UNKNOWN, notes=notes)

    def propose(self, mhe: MHE, state: State, window: Window, run: Simulated) -> Guess:
        """Return the candidate; within the bounds unless the undisturbed model, or its disturbance, leaves them."""
        stage, bound, nx = mhe.stage, self.bound(mhe), mhe.stage.nx
        x, p = bound.projected(run.x), window.prior[nx:]
        if mhe.fed or self.candidate == "system":
            return shifted_guess(stage, window)
        x[0] = window.prior[:nx]
        found = connected(stage, window, x, np.zeros((len(window.mesh), stage.nw)), p, bound.places, exact=bound.affine)
        return shifted_guess(stage, window) if found is None else found

    def first_guess(self, mhe: MHE, state: State, window: Window, candidate: Guess) -> Guess:
        """Return where the solver starts."""
        if callable(self.start):
            return self.start(mhe, state, window)
        if self.start == "last" and state.window is not None and state.t >= window.mesh.t[0]:
            return warm_start(mhe.stage, state, window)
        return candidate

    def known(
        self, mhe: MHE, state: State, window: Window, run: Simulated, candidate: Guess, kept: bool
    ) -> WindowStart:
        """Return what the observer's certificate makes of a window."""
        bound, t = self.bound(mhe), window.mesh.t
        if bound.bounds.unmet:
            return WindowStart(np.inf, None, bound.bounds.unmet)
        error = run.x - bound.projected(run.x)
        lacking = bound.lacking(mhe, state, run.since, float(t[0]))
        if self.candidate == "observer" and error.any() and kept:
            kept = bound.stays(mhe, window, candidate)
        return bound.bounds.window(run, t, error, lacking, kept)

    def _until(self, mhe: MHE, state: State, t: float, latest: float) -> Simulated:
        """Run the observer to `t` from the last estimate at or before `latest`, or from where it is known."""
        bound = self.bound(mhe)
        key = (state.memory.get("observer"), state.measurements, state.inputs, state.window, t, latest)
        if all(a is b or a == b for a, b in zip(key, bound.last[0], strict=True)):
            return bound.last[1]
        found = self._run_until(mhe, state, self._log(mhe, state), t, latest)
        bound.last = (key, found)
        return found

    def _run_until(self, mhe: MHE, state: State, log: Log, t: float, latest: float) -> Simulated:
        bound, slack, nx = self.bound(mhe), mhe.slack(t), mhe.stage.nx
        times, rows = log.arrays()
        k = max(int(np.searchsorted(times, latest + slack, side="right")) - 1, 0)
        since, z, bounded = float(times[k]), rows[k, :nx], Bounded(*rows[k, nx:])
        if t <= since + slack:
            return Simulated(since, bounded, z[None], z[None])
        mesh = mhe.assembly.mesh(since, t, mhe.records(state, since, t), growing=False)
        x = bound.run(mhe, state, z, mesh)
        if np.isfinite(x).all():
            return Simulated(since, bounded, x, x)
        if state.window is not None and state.window.part("t")[0] <= t + slack:
            z = trajectory_at(mhe.stage, state.window.trajectory, t)
        note = f"the observer fails between {since:g} s and {t:g} s: in its place the last solution"
        return Simulated(since, UNKNOWN, z[None], z[None], (note,))


class Bound:
    """A `Suboptimal` as one estimator has it: the observer's stage function, and what its bounds need."""

    def __init__(self, rule: Suboptimal, mhe: MHE):
        model = mhe.model
        if rule.horizon < mhe.horizon * (1 - 1e-9):
            raise InputError(
                f"Suboptimal: the observer's horizon T = {rule.horizon:g} s is shorter than the MHE's, "
                f"{mhe.horizon:g} s; T must be at least N (4.16), or infinite for an observer initialised once"
            )
        pointed = [name for name, kind in mhe.hold.items() if kind != "zero"]
        if model.step is None and (pointed or mhe.assembly.input_linear):
            raise InputError(
                "Suboptimal: an observer in continuous time is fed with held records, hold='zero' and "
                f"input_hold='zero'; got other ones for {', '.join(pointed) or 'inputs'}"
            )
        if mhe.fed:
            self.stage = mhe.stage
        else:
            K = rule.observer.K if isinstance(rule.observer, LuenbergerObserver) else rule.observer
            if K is None:
                raise InputError("Suboptimal: give the auxiliary observer, a LuenbergerObserver or its gain (nx, ny)")
            self.stage = StageFunction(
                observer_model(model, gain(model, K)), mhe.integrator, signal=False, interval=mhe.interval
            )
        self.last: tuple[tuple[Any, ...], Any] = ((None,) * 6, None)  # run, of what: asked for by `at` and `simulate`
        self.lower, self.upper = mhe.assembly.boxes["x"]
        self.process, self.affine = (None, False) if mhe.fed else _full_process(model)
        if rule.candidate == "observer" and self.process is None and not mhe.fed:
            raise InputError(
                f"Suboptimal: candidate 'observer' needs disturbances that can move every state of {model.name!r} "
                "(Assumption 4.6): one a state; take candidate='system'"
            )
        self.bounds = SuboptimalBounds(rule.observer, mhe, kind=rule.candidate, horizon=float(rule.horizon))

    @property
    def places(self) -> np.ndarray:
        """Of the disturbances that can move every state."""
        assert self.process is not None
        return self.process

    def stays(self, mhe: MHE, window: Window, point: Guess) -> bool:
        """Return whether the undisturbed model keeps the states of a point within the bounds, each for one slot."""
        mesh, w = window.mesh, np.zeros_like(point.w)
        try:
            x, _ = mhe.stage.values(mesh.t[:-1], mesh.h, point.x[:-1], w, point.p, window.u0, window.u1)
        except FloatingPointError:
            return False
        return bool((x >= self.lower).all() and (x <= self.upper).all())

    def note(self, window: Window, x: Array, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return in words where and by how much the observer x (N+1, nx) was projected: (4.54)."""
        error = np.abs(x - self.projected(x))
        if not error.any():
            return ()
        k, i = np.unravel_index(int(np.argmax(error)), error.shape)
        size, t = np.linalg.norm(error[k]), window.mesh.t[k]
        return (
            f"the observer leaves the bounds, by {error[k, i]:.3g} of {names[i]} at t = {t:g} s: |eps| = {size:.3g}",
        )

    def projected(self, x: Array) -> Array:
        """Return x (..., nx) projected onto the bounds: (4.53)."""
        return np.clip(x, self.lower, self.upper)

    def run(self, mhe: MHE, state: State, z: Array, mesh: Mesh) -> Array:
        """Return the observer (N+1, nx) at the nodes of a mesh from z (nx,) at its start; NaN from where it fails."""
        start, end = float(mesh.t[0]), float(mesh.t[-1])
        times, rows = mhe.fed_inputs(state, start, end)
        u0, u1 = held_inputs(times, rows, mesh.t, mesh.tolerance, False)
        try:
            return self.stage.roll(mesh.t[:-1], mesh.h, z, np.empty((len(mesh), 0)), state.p, u0, u1)
        except FloatingPointError:
            x = np.full((len(mesh) + 1, len(z)), np.nan)
            x[0] = z
            return x

    def lacking(self, mhe: MHE, state: State, start: float, end: float) -> tuple[str, ...]:
        """Return what is missing, or doubtful, of the data that the observer was fed with on [start, end]."""
        slack = mhe.slack(end)
        if self.bounds.unmet or mhe.guaranteed is None:
            return ()
        if reasons := self.bounds.elsewhere(state.p):
            return reasons
        if end <= start + slack:
            return ()
        times, rows = state.measurements.arrays(end + slack)
        doubts = mhe.guaranteed.current(state.doubts, times, start)
        found = tuple(reason for when, reason in doubts if when <= end + slack or np.isinf(when))
        return found or mhe.guaranteed.lacking(times, rows, start, end)


def _full_process(model: Model) -> tuple[np.ndarray | None, bool]:
    """Return the places in w of as many disturbances as there are states, which together move each, if there are.

    And whether the model is one step that they enter linearly.
    """
    point = (0.0, model.x.nominal, model.u.nominal)

    def moved(w: Array) -> Array:
        return np.asarray(model.dynamics(*point, w, model.p_start)).ravel()

    silent, nominal = np.zeros(len(model.w)), model.w.nominal
    columns = [moved(np.where(np.arange(len(silent)) == i, nominal, 0.0)) - moved(silent) for i in range(len(silent))]
    B = np.array(columns).reshape(len(silent), len(model.x)).T
    places = np.flatnonzero(np.abs(B).max(axis=0, initial=0.0) > 0)
    if len(places) != len(B) or not np.isfinite(B).all() or np.linalg.matrix_rank(B[:, places]) < len(B):
        return None, False
    return places, model.step is not None and additive(model, places.tolist())
