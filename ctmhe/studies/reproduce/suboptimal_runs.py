"""Thesis 4.2.6 and 4.3.3: runs of a discrete-time plant with one estimator after the other, under the same noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from ctmhe.errors import MissingExtra
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.priors.arrival import ArrivalUpdate
from ctmhe.estimators.priors.suboptimal import Suboptimal
from ctmhe.models.discrete import DiscreteModel
from ctmhe.models.library import three_species_discrete
from ctmhe.models.observer import observer_model
from ctmhe.studies.reproduce.printed_observers import REACTOR, SPECIES, Printed, reactor_discrete
from ctmhe.types import Array, Bounds, DiscountedCost, Measurement

SPECIES_BOUNDS = Bounds(x=(0.0, 3.0))


@dataclass(frozen=True)
class Experiment:
    """A plant in steps: its start, the initial estimate, and how large its uniform disturbances are."""

    model: Callable[[], DiscreteModel]
    truth: tuple[float, ...]
    guess: tuple[float, ...]
    disturbance: float
    noise: float
    steps: int


SPECIES_RUN = Experiment(three_species_discrete, (0.5, 0.05, 0.1), (2.0, 0.5, 0.0), 1e-3, 5e-2, 60)
REACTOR_RUN = Experiment(reactor_discrete, (3.0, 1.0), (0.1, 4.5), 2e-3, 1e-2, 200)


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What one run gave: errors (steps+1, nx), costs and seconds (steps+1,)."""

    errors: Array
    costs: Array
    seconds: Array

    @property
    def sse(self) -> float:
        """Sum of squared errors over all times, the first included."""
        return float(np.sum(self.errors**2))


def one_run(experiment: Experiment, mhe: MHE | DiscreteModel, seed: int, *, gain: Array | None = None) -> Outcomes:
    """Return the outcomes of an estimator, or of z+ = f(z) + K (h(z) - y) for a model and a gain.

    In the prediction form the measurement of a time comes after its estimate.
    """
    model, rng, (nx, n) = experiment.model(), np.random.default_rng(seed), (len(experiment.truth), experiment.steps)
    d = rng.uniform(-experiment.disturbance, experiment.disturbance, (n + 1, nx))
    v = rng.uniform(-experiment.noise, experiment.noise, (n + 1, 1))
    x, z, nothing = np.array(experiment.truth), np.array(experiment.guess), np.zeros(nx + 1)
    step = float(model.step or 1.0)
    state = mhe.init(x=experiment.guess) if isinstance(mhe, MHE) else None
    errors, costs, seconds = np.empty((n + 1, nx)), np.zeros(n + 1), np.zeros(n + 1)
    for k in range(n + 1):
        y = np.asarray(model.output(0.0, x, [], np.append(np.zeros(nx), v[k]), [])).ravel()
        if isinstance(mhe, MHE):
            filtering = mhe.assembly.filtering
            if filtering:
                state = mhe.observe(state, Measurement(k * step, y))  # type: ignore[arg-type]
            state, estimate = mhe.estimate(state, k * step)  # type: ignore[arg-type]
            if not filtering:
                state = mhe.observe(state, Measurement(k * step, y))
            errors[k], costs[k], seconds[k] = estimate.x - x, estimate.cost, estimate.seconds
        else:
            errors[k] = z - x
            assert gain is not None
            output = np.asarray(model.output(0.0, z, [], nothing, [])).ravel()
            z = np.asarray(model.dynamics(0.0, z, [], nothing, [])).ravel() + gain @ (output - y)
        x = np.asarray(model.dynamics(0.0, x, [], np.append(d[k], 0.0), [])).ravel()
    return Outcomes(errors, costs, seconds)


def averaged(experiment: Experiment, build: Callable[[], MHE], seeds: int, steps: int) -> dict[str, Any]:
    """Return SSE, the accumulated cost over N and the milliseconds a sample, from N = `steps` on, over all seeds."""
    mhe = build()
    runs = [one_run(experiment, mhe, seed) for seed in range(seeds)]
    return {
        "SSE": mean_std([run.sse for run in runs]),
        "J_acc": mean_std([run.costs.sum() / steps for run in runs]),
        "tau_avg": float(np.mean([run.seconds[min(steps, experiment.steps) :].mean() for run in runs]) * 1e3),
    }


def mean_std(values: Sequence[float]) -> dict[str, float]:
    """Return mean and standard deviation over seeds."""
    return {"mean": float(np.mean(values)), "std": float(np.std(values, ddof=1)) if len(values) > 1 else 0.0}


def each(jobs: Sequence[Callable[[], Any]], *, workers: int, progress: bool, name: str) -> list[Any]:
    """Return the results of all jobs, in order."""
    hidden = None if progress else True
    if workers == 1:
        return [job() for job in tqdm(jobs, desc=name, disable=hidden)]
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise MissingExtra("joblib", "study", "reproducing a case on several workers") from None
    return list(Parallel(workers)(delayed(_called)(job) for job in tqdm(jobs, desc=name, disable=hidden)))


def _called(job: Callable[[], Any]) -> Any:
    return job()


def rows_of(heads: Sequence[str], table: Sequence[Sequence[Any]], groups: Mapping[str, Sequence[str]]) -> list[Any]:
    """Return a printed table as rows: `heads` first, then the columns of every group."""
    found = []
    for line in table:
        row: dict[str, Any] = dict(zip(heads, line, strict=False))
        rest = list(line[len(heads) :])
        for group, columns in groups.items():
            row[group] = dict(zip(columns, rest[: len(columns)], strict=True))
            rest = rest[len(columns) :]
        found.append(row)
    return found


def system_cost(printed: Printed, *, discounted_prior: bool = False) -> DiscountedCost:
    """Return (4.12)-(4.14) with the printed U; the prior is not discounted unless asked for."""
    P, Q, eta = 2 * printed.P, 2 * printed.system.Q, printed.eta_s
    return DiscountedCost(P=P, Q=Q, R=printed.G_s, eta=eta, prior_eta=eta if discounted_prior else 1.0)


def species_mhe(
    candidate: str, *, N: int, T: int, i: int | None, solver: str, filtering: bool = False, start: str = "candidate"
) -> MHE:
    """Return suboptimal MHE of 4.2.6: X imposed, D and V free."""
    model = three_species_discrete()
    step = float(model.step or 1.0)
    return MHE(
        model,
        horizon=N * step,
        cost=system_cost(SPECIES),
        bounds=SPECIES_BOUNDS,
        filtering=filtering,
        solver=solver,
        max_iterations=i,
        prior=Suboptimal(SPECIES.K, horizon=T * step, candidate=candidate, start=start),
    )


def fast_mhe(printed: Printed, kind: str, *, N: int, i: int, bounds: Bounds | None = None) -> MHE:
    """Return f-MHE_1, with an arrival cost that is updated, or f-MHE_2, which only fits the outputs."""
    model = three_species_discrete() if printed is SPECIES else reactor_discrete()
    horizon, x = N * float(model.step or 1.0), None if bounds is None else bounds.x
    if i == 0:  # the last solution carried forward: open loop, whatever the cost
        still = Suboptimal(np.zeros((len(model.x), 1)))
        return MHE(model, horizon=horizon, cost=system_cost(printed), filtering=True, prior=still, max_iterations=0)
    if kind == "f-MHE_1":
        cost = DiscountedCost(P=2 * printed.P, Q=2 * printed.system.Q, R=printed.G_s)
        prior = ArrivalUpdate()
        return MHE(model, horizon=horizon, cost=cost, bounds=Bounds(x=x), filtering=True, prior=prior, max_iterations=i)
    cost, fixed = DiscountedCost(P=0.0, Q=1.0, R=1.0), Bounds(x=x, w=(0.0, 0.0))
    return MHE(model, horizon=horizon, cost=cost, bounds=fixed, filtering=True, max_iterations=i)


def trajectory_mhe(
    scale: float, *, N: int, i: int | None, horizon: float, stage: float = 1.0, start: str = "candidate"
) -> MHE:
    """Return MHE over observer trajectories (4.73) for the reactor, W = scale P_o, G = 1, in the filtering form.

    `horizon` is T in seconds, `stage` a factor on the stage cost.
    """
    lowest, L_h = float(np.linalg.eigvalsh(REACTOR.P)[0]), np.sqrt(2.0)
    cost = DiscountedCost(
        P=2 * scale * REACTOR.P, Q=[], R=stage * lowest / (2 * L_h**2), eta=REACTOR.eta_o, prior_eta=1.0
    )
    model = observer_model(reactor_discrete(), REACTOR.K)
    prior = Suboptimal(horizon=horizon, start=start)
    return MHE(model, horizon=N * 0.1, cost=cost, filtering=True, prior=prior, max_iterations=i)
