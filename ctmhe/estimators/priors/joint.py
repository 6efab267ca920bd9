"""Priors of joint state and parameter estimation that heed excitation: thesis ch. 5, (5.17), (5.80), Remark 5.2."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from ctmhe.certificates.excitation import ExcitationMonitor, Information
from ctmhe.certificates.excited_set import ExcitationDesign
from ctmhe.certificates.joint_bounds import Errors, JointGuarantee
from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.priors.base import Anchor, Filtering, Memory, Told
from ctmhe.estimators.priors.joint_evidence import joint_levels
from ctmhe.models.continuous import Model
from ctmhe.transcription.solved import Solved
from ctmhe.types import Array, Trajectory, frozen, positive

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State

FILTERING = Filtering()
NAME = "parameters"


class Row(NamedTuple):
    """What is remembered of a solve.

    `whole` and `level` (,), `prior`, `told` and `seen` (k,): p_bar(t), the parameters that the estimate told, and when
    each was last excited; `bounds` (7,): `Errors` of level and theorem, and whether there was nothing against them.
    """

    whole: float
    level: float
    prior: Array
    told: Array
    seen: Array
    bounds: Array

    @classmethod
    def of(cls, row: Array, k: int) -> Row:
        """Take a row of the log apart."""
        prior, told, seen = row[2 : 2 + 3 * k].reshape(3, k)
        return cls(row[0], row[1], prior, told, seen, row[2 + 3 * k :])

    @property
    def array(self) -> Array:
        """The row of the log."""
        return np.concatenate([[self.whole, self.level], self.prior, self.told, self.seen, self.bounds])


@dataclass(frozen=True, eq=False)
class ExcitedPrior:
    """Parameters' prior is renewed by windows that tell the parameters, and kept by others: (5.17), (5.80).

    At the end of every full window whose level of information alpha_t reaches `alpha`, its parameters become the prior
    of the windows that start there; else that is the prior which the window had itself. States have the filtering
    prior. The estimate tells the parameters of the most recent window that was excited (Remark 5.2), growing ones
    included; `estimate.trajectory.p` has those of the window itself.

    Where the parameters are states of the estimator's model (they vary, p+ = g(p, u, w)), by their names in the
    monitor's model, what is kept is carried along g without disturbance (5.80).

    In continuous time windows start between solves: there the solve that the estimated trajectory (3.17) is made of
    decides. The level is that of the whole signal; between samples the outputs are those of the estimate. A window in
    which nothing was measured is not excited.

    Parameters
    ----------
    monitor : ExcitationMonitor
        Of a model with the estimator's signals, by name.
    alpha : float
        In y's units squared, of parameters over their nominals: from when on the parameters count as excited.
    directions : bool
        Ours, beyond the thesis: when the level says that not all combinations of parameters are excited, those that
        are move, the others are kept. Combinations are the eigenvectors of the information of parameters over their
        nominals; in |dp|^2 weighed by it they do not interact.
    guarantee : JointGuarantee, optional
        Estimates then have a `bound` of states and parameters, or say why not.

    Raises
    ------
    InputError
        For an alpha that is not positive, and at `init` for an estimator that the monitor's model does not fit.
    """

    monitor: ExcitationMonitor
    alpha: float
    directions: bool = False
    guarantee: JointGuarantee | None = None
    reach: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.monitor, ExcitationMonitor):
            raise InputError(
                f"ExcitedPrior: expected ExcitationMonitor(design_excitation(model)), got {self.monitor!r}"
            )
        object.__setattr__(self, "alpha", positive("ExcitedPrior: alpha", self.alpha))
        if not (self.guarantee is None or isinstance(self.guarantee, JointGuarantee)):
            raise InputError(f"ExcitedPrior: guarantee must be a JointGuarantee(...), got {self.guarantee!r}")

    def begin(self, mhe: MHE, state: State) -> Memory:
        """See `Prior`."""
        places(self.monitor.design, mhe)
        if self.guarantee is not None:
            joint_levels(self, mhe)
        return {NAME: Log(2 + 3 * self._count + 7)}

    @property
    def _count(self) -> int:
        return len(self.monitor.design.model.p)

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`: the filtering prior, but for the parameters that are kept."""
        anchor = FILTERING.at(mhe, state, start, growing)
        if growing or anchor is None:
            return anchor  # with nothing known there, the prior is predicted from what the last estimate told
        found = self._row(self._log(mhe, state), start - mhe.slack(start))
        if found is None or found.whole:
            return anchor
        value = anchor.value.copy()
        value[places(self.monitor.design, mhe).p] = found.prior
        return Anchor(value, anchor.notes, anchor.factor, anchor.weight)

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        place, slack = places(self.monitor.design, mhe), mhe.slack(state.t)
        log, start = self._log(mhe, state).drop_after(state.t - slack), float(solved.part("t")[0])
        before = self._row(log, log.last_time)
        trajectory = solved.trajectory
        found = place.end(trajectory)
        kept = self._carried(mhe, state, start, trajectory, solved.part("prior")[place.p])
        told = kept if before is None else self._carried(mhe, state, log.last_time, trajectory, before.told)
        information = self.monitor.along(place.seen(trajectory))
        measured = self._measured(mhe, state, start)
        level = max(information.level, 0.0) if measured else 0.0
        whole, move = level >= self.alpha, None
        if self.directions and measured and not whole:
            move = self._projection(information)
        full = state.t - state.t0 >= mhe.horizon - slack
        seen = np.full(self._count, -np.inf) if before is None else before.seen
        if measured:
            seen = np.where(marginal(information) >= self.alpha, state.t, seen)
        row = Row(
            float(whole and full), level, _moved(kept, found, whole, move) if full else kept,
            _moved(told, found, whole, move), seen, np.full(7, np.nan),
        )  # fmt: skip
        if self.guarantee is not None:
            bounds, reasons = self._levels(mhe, state, log, solved, level)
            row = row._replace(bounds=np.append(bounds, float(not reasons)))
        log = log.put(state.t, row.array).drop_before(state.t - mhe.horizon - slack)
        return {NAME: log, "key": Log(1).put(state.t0, np.array([self._key(mhe)]))}

    def revised(self, memory: Memory, since: float) -> Memory:
        """Return the memory whose bounds do not rest on what was solved with other data at `since` and later."""
        return {**memory, NAME: forgotten(memory[NAME], since, 7)} if NAME in memory else memory

    def _key(self, mhe: MHE) -> float:
        return 0.0 if self.guarantee is None else joint_levels(self, mhe).key

    def _log(self, mhe: MHE, state: State) -> Log:
        """Return what is remembered; bounds that another guarantee gave are not."""
        log, key = state.memory.get(NAME), state.memory.get("key")
        if log is None:  # the state of an estimator with another prior
            return self.begin(mhe, state)[NAME]
        if key is not None and len(key) and key.arrays()[1][0, 0] != self._key(mhe):
            return forgotten(log, -np.inf, 7)
        return log

    def told(self, mhe: MHE, state: State, solved: Solved) -> Told:
        """Return what the estimate says in place of the window's own end: its parameters, a bound, notes."""
        log, place = state.memory[NAME], places(self.monitor.design, mhe)
        row = self._row(log, log.last_time)
        assert row is not None
        value = np.concatenate([state.x, state.p])
        value[place.p] = row.told
        names = self.monitor.design.model.p.names
        never = [name for name, t in zip(names, row.seen, strict=True) if t == -np.inf]
        weak = [name for name, t in zip(names, row.seen, strict=True) if -np.inf < t < state.t]
        notes = [f"never excited, kept at the initial value: {', '.join(never)}"] if never else []
        if weak:
            notes.append(f"information {row.level:.2g} below {self.alpha:.2g}, kept: {', '.join(weak)}")
        bound = None
        if self.guarantee is not None:
            reasons: tuple[str, ...] = ()
            if not row.bounds[-1]:
                earlier = log.drop_after(state.t - mhe.slack(state.t))
                reasons = self._levels(mhe, state, earlier, solved, row.level)[1]
            bound = joint_levels(self, mhe).bound(row.bounds[:-1], reasons)
        return Told(frozen(value), tuple(notes), bound)

    def _row(self, log: Log, t: float) -> Row | None:
        """Return what is remembered of the first solve from `t` on, else of the last."""
        found = log.first_from(t) or log.first_from(log.last_time)
        return None if found is None else Row.of(found[1], self._count)

    def _levels(self, mhe: MHE, state: State, log: Log, solved: Solved, level: float) -> tuple[Array, tuple[str, ...]]:
        """Return `Errors` of level and theorem (6,) after a solve, and what stands against them."""
        levels = joint_levels(self, mhe)
        start, last = float(solved.part("t")[0]), self._row(log, log.last_time)
        growing, row = start <= state.t0 + mhe.slack(state.t0), None
        if not growing:
            found = log.first_from(start - mhe.slack(start))
            if found is not None and found[0] <= start + mhe.slack(start):
                row = levels.known(Row.of(found[1], self._count).bounds[:-1])
        known_last = None if last is None else levels.known(last.bounds[:-1])
        told = None if known_last is None else (float(known_last[2]), float(known_last[5]))
        initial = levels.initial(state.start) if growing or told is None else None
        if told is None:
            told = (initial.told, initial.told) if initial is not None else (levels.cap_p, levels.cap_p)
        if growing and initial is not None:
            before = (initial, initial)
        elif row is not None:
            before = (Errors(row[0], row[1], row[2]), Errors(row[3], row[4], row[5]))
        else:  # between solves: of states only the domain is known
            prior = max(*told, *([] if known_last is None else [known_last[1], known_last[4]]))
            known = Errors(levels.cap_x, prior, prior)
            before = (known, known)
        return levels.after(mhe, state, solved, before, told, level, aligned=growing or row is not None)

    def _carried(self, mhe: MHE, state: State, since: float, trajectory: Trajectory, p: Array) -> Array:
        """Return parameters (k,) at the window's end from those at `since`, without disturbance."""
        place = places(self.monitor.design, mhe)
        if place.still or since >= state.t:
            return p
        x = trajectory.x[-1].copy()  # where the states are does not matter: g depends on p, u and w only
        x[place.p] = p
        return mhe.propagate(state, since, state.t, x, trajectory.p)[place.p]

    @staticmethod
    def _measured(mhe: MHE, state: State, start: float) -> bool:
        times, rows = state.measurements.arrays(state.t + mhe.slack(state.t))
        return bool(np.isfinite(rows[times >= start - mhe.slack(start)]).any())

    def _projection(self, information: Information) -> Array | None:
        """Return the projection (k, k) on the excited combinations, None where there is none."""
        basis, nominal = information.excited(self.alpha), information.nominal
        return nominal[:, None] * (basis @ basis.T) / nominal if basis.shape[1] else None


def forgotten(log: Log, since: float, width: int) -> Log:
    """Return a log whose last `width` columns are unknown from `since` on."""
    times, rows = log.arrays()
    rows = rows.copy()
    rows[times >= since, -width:] = np.nan
    return Log.of(times, rows, rows.shape[1])


def marginal(information: Information) -> Array:
    """Return what is known of each parameter when all others are unknown (k,): 1 / (O^-1)_ii, over their nominals."""
    nominal = information.nominal
    values, vectors = np.linalg.eigh(nominal[:, None] * information.matrix * nominal)
    shares = vectors**2 / np.maximum(values, 1e-300)
    return 1 / np.where(vectors**2 > 1e-24, shares, 0.0).sum(axis=1)


def _moved(kept: Array, found: Array, whole: bool, move: Array | None) -> Array:
    if whole:
        return found
    return kept if move is None else kept + move @ (found - kept)


class Places(NamedTuple):
    """Where an estimator has the signals of a monitor's model.

    `x`, `w` : positions among its states and disturbances; `p`: of the parameters in (x, p), its states and parameters;
    `varying`: they are states; `still`: without disturbance they do not change.
    """

    x: Array
    w: Array
    p: Array
    varying: bool
    still: bool

    def seen(self, trajectory: Trajectory) -> Trajectory:
        """Return an estimator's trajectory as one of the monitor's model."""
        nx = trajectory.x.shape[1]
        p = trajectory.x[:-1, self.p] if self.varying else trajectory.p[self.p - nx]
        return replace(trajectory, x=trajectory.x[:, self.x], w=trajectory.w[:, self.w], p=p)

    def end(self, trajectory: Trajectory) -> Array:
        """Return the parameters (k,) at the end."""
        return np.concatenate([trajectory.x[-1], trajectory.p])[self.p]


@lru_cache(maxsize=16)
def places(design: ExcitationDesign, mhe: MHE) -> Places:
    """Return where an estimator has a design's signals, or raise `InputError` where it lacks one."""
    own, model = design.model, mhe.model
    if own.step != model.step:
        raise InputError(f"ExcitedPrior: the monitor counts steps of {own.step} s, the estimator of {model.step} s")
    for key in "wx":
        lost = [name for name in getattr(own, key).names if name not in getattr(model, key).names]
        if lost:
            raise InputError(
                f"ExcitedPrior: the estimator's model {model.name!r} has no {getattr(own, key).kind} "
                f"{', '.join(lost)}; the monitor's model {own.name!r} needs it"
            )
    if own.u.names != model.u.names:
        raise InputError(f"ExcitedPrior: the monitor's inputs are {own.u.names}, the estimator's {model.u.names}")
    varying = all(name in model.x.names for name in own.p.names)
    names = model.x.names if varying else model.p.names
    lost = [name for name in own.p.names if name not in names]
    if lost:
        raise InputError(
            f"ExcitedPrior: {', '.join(lost)} is neither a parameter nor a state of the estimator's model "
            f"{model.name!r}; the monitor's design is about {', '.join(own.p.names)}"
        )
    if not varying and not mhe.assembly.p_estimated:
        raise InputError(
            f"ExcitedPrior: the estimator takes {', '.join(own.p.names)} for known: its P weighs states only. Give a "
            "weight over states and parameters, such as weights.cost(model)"
        )
    p = np.array([names.index(name) for name in own.p.names]) + (0 if varying else len(model.x))
    x, w = (np.array([getattr(model, key).index(name) for name in getattr(own, key)], dtype=int) for key in "xw")
    return Places(x, w, p, varying, not varying or _still(model, p))


def _still(model: Model, p: Array) -> bool:
    """Return whether it can be seen from a model's expressions that without disturbance these states stay."""
    if not model.dynamics.is_a("SXFunction"):
        return False
    sizes = (1, len(model.x), len(model.u), len(model.p))
    t, x, u, q = (ca.SX.sym(key, size) for key, size in zip("txup", sizes, strict=True))
    value = model.dynamics(t, x, u, np.zeros(len(model.w)), q)
    rest = value - x if model.step is not None else value
    return all(ca.simplify(rest[int(i)]).is_zero() for i in p)
