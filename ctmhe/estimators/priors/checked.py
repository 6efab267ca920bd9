"""The scheme of paper 000: the filtering prior of states and parameters, conditions (33)-(34), and the bound (9)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ctmhe.certificates.guarantee import largest_square
from ctmhe.certificates.joint import JointCertificate
from ctmhe.certificates.joint_bounds import joint_level
from ctmhe.data.log import Log
from ctmhe.errors import InputError
from ctmhe.estimators.priors.base import Anchor, Filtering, Memory, Told
from ctmhe.estimators.priors.joint_evidence import DATA, box_of, digest, evidence, sizes_of
from ctmhe.transcription.solved import Solved
from ctmhe.types import Array, ErrorBound, frozen, positive

if TYPE_CHECKING:
    from ctmhe.estimators.mhe import MHE
    from ctmhe.estimators.state import State

FILTERING = Filtering()
NAME = "conditions"


@dataclass(frozen=True, eq=False)
class CheckedPrior:
    """The filtering prior of states and parameters, with (33) and (34) checked at every solve: paper 000, Remark 11.

    The status says which condition a window does not meet. With `disturbance`, estimates have a `bound` of states and
    parameters in the norm of the window's own M, which tells how well what is known. With the kappa of the window that
    ended at s, where this one starts, `theorem` is ::

        U(t) <= 4 eta^N kappa(s) U(s) + 4 sum of eta^(j-1) |w(t-j)|^2_Q         (9)

    and `level` is from what the window found. (33) and (34) promise that (9) contracts; it holds without them too.

    Parameters
    ----------
    joint : JointCertificate
        Of a global design; the cost is `joint.cost()`.
    kappa : float, optional
        Of (33); the certificate's own when left out.
    disturbance : scalar, array (nw,) or mapping name -> value, optional
        Largest |w_i| that there can be, in the model's units.
    error : mapping name -> value, optional
        Largest initial errors of states and parameters; what the domain leaves for those left out.
    """

    joint: JointCertificate
    kappa: float | None = None
    disturbance: Any = None
    error: Any = None
    reach: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.joint, JointCertificate):
            raise InputError(f"CheckedPrior: expected a JointCertificate, got {self.joint!r}")
        if self.joint.design.scope != "global":
            raise InputError(
                "CheckedPrior: (33)-(34) say something of the truth only where one trajectory gives the information of "
                "every pair, and this design is local; ExcitedPrior works with it"
            )
        if self.kappa is not None:
            positive("CheckedPrior: kappa", self.kappa)

    def begin(self, mhe: MHE, state: State) -> Memory:
        """See `Prior`."""
        _fitting(self, mhe)
        n = len(self.joint.M_0)
        return {NAME: Log(5 + n * n)}

    def at(self, mhe: MHE, state: State, start: float, growing: bool) -> Anchor | None:
        """See `Prior`."""
        return FILTERING.at(mhe, state, start, growing)

    def after(self, mhe: MHE, state: State, solved: Solved) -> Memory:
        """See `Prior`."""
        slack = mhe.slack(state.t)
        log = self._log(mhe, state).drop_after(state.t - slack)
        M, conditions = self.joint.window(solved.trajectory, kappa=self.kappa)
        level, theorem, reasons = self._levels(mhe, state, log, solved, M)
        row = np.concatenate([[conditions.kappa, conditions.alpha, level, theorem, not reasons], M.ravel()])
        log = log.put(state.t, row).drop_before(state.t - mhe.horizon - slack)
        return {NAME: log, "key": Log(1).put(state.t0, np.array([_fitting(self, mhe)[3]]))}

    def revised(self, memory: Memory, since: float) -> Memory:
        """Return the memory whose bounds do not rest on what was solved with other data at `since` and later."""
        if NAME not in memory:
            return memory
        times, rows = memory[NAME].arrays()
        rows = rows.copy()
        rows[times >= since, 2:4] = np.nan
        return {**memory, NAME: Log.of(times, rows, rows.shape[1])}

    def _log(self, mhe: MHE, state: State) -> Log:
        """Return what is remembered; bounds that another certificate gave are not."""
        if NAME not in state.memory:  # the state of an estimator with another prior
            return self.begin(mhe, state)[NAME]
        key = state.memory.get("key")
        if key is not None and len(key) and key.arrays()[1][0, 0] != _fitting(self, mhe)[3]:
            return self.revised(state.memory, -np.inf)[NAME]
        return state.memory[NAME]

    def told(self, mhe: MHE, state: State, solved: Solved) -> Told:
        """Return the estimate as it is, with the conditions that are not met, and the bound."""
        log, joint = state.memory[NAME], self.joint
        row = log.first_from(log.last_time)[1]  # type: ignore[index]
        kappa, alpha, level, theorem, met = row[:5]
        limit, notes = joint.kappa if self.kappa is None else self.kappa, []
        if kappa > limit:
            notes.append(f"(33) is not met: kappa = {kappa:.3g} above {limit:.3g}")
        if state.t - state.t0 >= mhe.horizon - mhe.slack(state.t) and not alpha > joint.alpha:
            notes.append(f"(34) is not met: {alpha:.3g} not above {joint.alpha:.3g}")
        bound = None
        if self.disturbance is not None:
            reasons: tuple[str, ...] = ()
            M = frozen(row[5:].reshape(joint.M_0.shape))
            if not met:
                reasons = self._levels(mhe, state, log.drop_after(state.t - mhe.slack(state.t)), solved, M)[2]
            known = np.isfinite(level) and not any(reason.startswith((DATA, NONE)) for reason in reasons)
            proved = not reasons and np.isfinite(theorem)
            cap = largest_square(M, np.subtract(*box_of(joint.design, "xp")[::-1]))
            bound = ErrorBound(float(level) if known else None, float(theorem) if proved else None, reasons, M, cap)
        return Told(np.concatenate([state.x, state.p]), tuple(notes), bound)

    def _levels(
        self, mhe: MHE, state: State, log: Log, solved: Solved, M: Array
    ) -> tuple[float, float, tuple[str, ...]]:
        """Return level and (9) after a solve, capped by the domain, and what stands against them."""
        unmet, sizes, initial, _ = _fitting(self, mhe)
        joint, start = self.joint, float(solved.part("t")[0])
        widths = np.subtract(*box_of(joint.design, "xp")[::-1])
        cap = largest_square(M, widths)
        found = evidence(mhe, state, solved, 0.0) if not unmet else ""
        if isinstance(found, str):
            lower, upper = box_of(joint.design, "xp")
            values = np.concatenate([state.x, state.p])
            astray = bool(((values < lower) | (values > upper)).any())
            most = np.inf if astray else cap
            return most, most, (*unmet, *([found] if found else []))
        reasons, before = [], (initial(state.start),) * 2
        if not found.growing:
            earlier = log.first_from(start - mhe.slack(start))
            if earlier is None or earlier[0] > start + mhe.slack(start):
                before = (largest_square(joint.M_0, widths),) * 2
                reasons.append("the window does not start at a solve, as (7) has it: estimate at every step")
            else:
                kept = earlier[1][2:4]
                widest = largest_square(joint.M_0, widths)
                before = tuple(np.where(np.isnan(kept), widest, earlier[1][0] * kept).tolist())
        level = joint_level(joint, before[0], found, sizes)[0]
        _, theorem, cost = joint_level(joint, before[1], found, sizes)
        if not reasons and cost > theorem / 2 * (1 + 1e-6) + 1e-12:
            reasons.append(
                f"its cost of {cost:.4g} exceeds the {theorem / 2:.4g} that the truth can cost: the solver found a "
                "worse solution, or disturbances or the initial error are larger than stated"
            )
            theorem = level
        return min(level, cap), min(theorem, cap), tuple(reasons)


NONE = "no bound: "


@lru_cache(maxsize=8)
def _fitting(prior: CheckedPrior, mhe: MHE) -> tuple[tuple[str, ...], Array, Any, float]:
    """Return what stands against bounds, the largest |w|, |e(0)|^2_M_0 at most as a function of the guess, and a key.

    Raises `InputError` where the estimator's signals are others, or its parameters are known.
    """
    joint, model = prior.joint, mhe.model
    own, widths = joint.design.model, box_of(joint.design, "xp")
    for key in "xuwpy":
        if getattr(own, key).names != getattr(model, key).names:
            raise InputError(
                f"CheckedPrior: the certificate's model has {key} = {', '.join(getattr(own, key).names)}, the "
                f"estimator's {', '.join(getattr(model, key).names) or 'none'}"
            )
    if not mhe.assembly.p_estimated:
        raise InputError("CheckedPrior: the estimator takes the parameters for known; its cost is joint.cost()")
    unmet = []
    if model.step is None:
        unmet.append(f"{NONE}(9) is for discrete time; in continuous time windows start between solves")
    if mhe.assembly.filtering:
        unmet.append(f"{NONE}the filtering form is not that of (7)")
    cost, wanted = mhe.cost, joint.cost()
    same = cost.eta == wanted.eta and cost.prior_eta == wanted.prior_eta and cost.S is None
    parts = [(getattr(cost, key), getattr(wanted, key)) for key in "PQR"]
    if not same or not all(np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-12) for a, b in parts):
        unmet.append(f"{NONE}the cost is not joint.cost(), (7)")
    for key in "xwp":
        lower, upper = mhe.assembly.boxes[key]
        low, high = box_of(joint.design, key)
        outside = (lower < low - 1e-9 * np.abs(low)) | (upper > high + 1e-9 * np.abs(high))
        if outside.any():
            named = ", ".join(name for name, out in zip(getattr(model, key), outside, strict=True) if out)
            unmet.append(f"{NONE}{named} may leave the domain of the design: give the MHE bounds that keep to it")
    sizes = np.zeros(len(model.w)) if prior.disturbance is None else sizes_of(prior.disturbance, model.w, "disturbance")
    names, given = (*model.x.names, *model.p.names), dict(prior.error or {})
    for name in given:
        if name not in names:
            raise InputError(f"CheckedPrior: error of {name!r}: no such state or parameter in {model.name!r}")

    def initial(start: Array) -> float:
        error = np.maximum(widths[1] - start, start - widths[0])
        for name, size in given.items():
            error[names.index(name)] = abs(float(size))
        return largest_square(joint.M_0, error)

    told = [
        joint.M_0,
        joint.Q,
        joint.R,
        sizes,
        np.array([joint.eta, initial(np.concatenate([model.x.nominal, model.p.nominal]))]),
        *widths,
    ]
    return tuple(unmet), sizes, initial, digest(told)
