"""Whole records: full problem and blocks, on workers and clusters, with failures; performance and regret."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ctmhe import MHE, RK4, Bounds, ContinuousModel, DiscountedCost, DiscreteModel, MeasurementLog
from ctmhe.errors import InputError
from ctmhe.estimators.offline.benchmark import infinite_horizon, performance, rebuilt_disturbance, regret
from ctmhe.estimators.offline.blocks import in_parallel
from ctmhe.estimators.offline.linear import LinearProblem, solve_linear
from ctmhe.estimators.offline.nonlinear import estimate_offline
from ctmhe.models.library import batch_reactor, random_stable
from ctmhe.studies.reproduce.thesis_table_6_1 import FULL, estimator, experiment

A, B, C = random_stable(3, 1, 1, seed=9)


def linear_model() -> DiscreteModel:
    """A linear system of three states with one disturbance each."""
    return DiscreteModel(
        lambda t, x, u, w, p: A @ x + B @ u + w, lambda t, x, u, w, p: C @ x, step=0.5,
        x=("a", "b", "c"), u="u", w=("d", "e", "f"), y="y", name="linear",
    )  # fmt: skip


def linear_record(steps: int = 60) -> tuple[MeasurementLog, LinearProblem]:
    """Return a record, and the same as matrices with prior P = 2 around 1."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(steps + 1, 1)), rng.normal(size=(steps + 1, 1))
    problem = LinearProblem(A, C, y, u[:-1] @ B.T, Q=3.0, R=2.0, P=2.0, mean=1.0)
    return MeasurementLog(np.arange(steps + 1) * 0.5, y, ("y",), u, ("u",)), problem


def linear_mhe(**cost) -> MHE:
    """Return the estimator with the weights of `linear_record`."""
    weights = {"P": 2.0, "Q": 3.0, "R": 2.0, "S": 2.0} | cost
    return MHE(linear_model(), horizon=10.0, cost=DiscountedCost(**weights))


def reactor_mhe() -> MHE:
    """Return a continuous-time estimator without prior, for irregular samples."""
    model = batch_reactor(noise=False)
    cost = DiscountedCost(P=np.zeros((2, 2)), Q=1e2, R_point=1e2)
    return MHE(
        model, horizon=2.0, interval=0.1, integrator=RK4(0.05), cost=cost, bounds=Bounds(x=(0.0, 9.0)), hold="point"
    )


def reactor_record(until: float = 6.0) -> tuple[MeasurementLog, np.ndarray]:
    """Return irregular samples of the reactor, and the true states at their times."""
    mhe, rng = reactor_mhe(), np.random.default_rng(1)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 0.25, 100))])
    t = np.append(t[t < until - 0.01], until)
    state, x = mhe.init(x=[3.0, 1.0]), [np.array([3.0, 1.0])]
    for a, b in pairwise(t):
        x.append(mhe.propagate(state, a, b, x[-1], np.empty(0)))
    x = np.array(x)
    y = x.sum(axis=1) + rng.uniform(-0.05, 0.05, len(t))
    return MeasurementLog(t, y, ("pressure",), np.empty((len(t), 0))), x


def test_the_full_problem_equals_the_structured_one():
    """A linear record through the transcription and the same through matrices: one minimiser."""
    log, problem = linear_record()
    found = estimate_offline(linear_mhe(), log, guess=np.ones(3), times=log.t)
    np.testing.assert_allclose(found.x, solve_linear(problem), atol=1e-6)
    assert found.success and not found.failures


@pytest.mark.parametrize("continuous", [True, False])
def test_one_block_is_the_full_solution(continuous):
    """The approximate estimator with one block is the full solution, prior included."""
    if continuous:
        mhe, log, guess = reactor_mhe(), reactor_record()[0], [3.0, 0.5]
    else:
        mhe, log, guess = linear_mhe(), linear_record()[0], np.ones(3)
    full = estimate_offline(mhe, log, guess=guess)
    one = estimate_offline(mhe, log, guess=guess, block=log.t[-1], keep=0.5)
    assert len(one.blocks) == 1
    np.testing.assert_array_equal(full.x, one.x)


def test_irregular_samples_in_blocks_approach_the_full_solution():
    """In continuous time too: longer blocks come closer, and every node has its state once."""
    log, truth = reactor_record()
    mhe = reactor_mhe()
    full = estimate_offline(mhe, log, guess=[3.0, 0.5], times=log.t)
    errors = []
    for block in (1.0, 2.0, 4.0):
        found = estimate_offline(mhe, log, guess=[3.0, 0.5], block=block, keep=0.5, times=log.t)
        assert found.success
        errors.append(np.abs(found.x - full.x).max())
    assert errors[2] < errors[1] < errors[0]
    nodes = estimate_offline(mhe, log, guess=[3.0, 0.5], block=2.0, keep=0.5)
    assert (np.diff(nodes.t) > 0).all() and np.isfinite(nodes.x).all()
    assert np.abs(full.x - truth).max() < 1.0


def test_workers_and_executors_find_the_same():
    """In this process, in two others and on an executor that was given: the same numbers."""
    _, log = experiment(0, 60)
    options = {"guess": FULL, "block": 2.0, "keep": 0.5, "times": log.t}
    here = estimate_offline(estimator(40), log, **options)
    there = estimate_offline(estimator(40), log, workers=2, **options)
    with ThreadPoolExecutor(2) as pool:
        given = estimate_offline(estimator(40), log, executor=pool, **options)
    np.testing.assert_array_equal(here.x, there.x)
    np.testing.assert_array_equal(here.x, given.x)


def test_a_dask_client_finds_the_same():
    """A Dask client is an executor like any other."""
    distributed = pytest.importorskip("distributed")
    _, log = experiment(0, 60)
    options = {"guess": FULL, "block": 2.0, "keep": 0.5, "times": log.t}
    here = estimate_offline(estimator(40), log, **options)
    settings = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**settings) as cluster, distributed.Client(cluster) as client:
        there = estimate_offline(estimator(40), log, executor=client, **options)
    np.testing.assert_array_equal(here.x, there.x)


class Deadly:
    """A starting function that kills its process in one block, or raises there."""

    def __init__(self, kill: bool):
        self.kill, self.home = kill, os.getpid()

    def __call__(self, t: float) -> np.ndarray:
        if 2.9 < t < 3.1:
            if self.kill and os.getpid() != self.home:
                os._exit(1)
            if not self.kill:
                raise ValueError("nothing is known here")
        return np.array(FULL)


@pytest.mark.parametrize("kill", [True, False])
def test_a_lost_block_is_reported_and_the_rest_is_usable(kill):
    """A block that raises, or whose process dies, is named; its states are NaN, all others are those of a good run."""
    _, log = experiment(0, 80)
    options = {"block": 2.0, "keep": 1.0, "times": log.t}
    good = estimate_offline(estimator(40), log, guess=FULL, **options)
    hurt = estimate_offline(estimator(40), log, guess=Deadly(kill), workers=2 if kill else 1, **options)
    # the function is asked at every node: blocks that see t = 3 s are lost
    lost = [block.start < 3.1 and block.stop > 2.9 for block in hurt.blocks]
    assert [bool(block.failed) for block in hurt.blocks] == lost and 0 < sum(lost) < len(lost)
    missing = np.isnan(hurt.x).any(axis=1)
    assert missing.any() and not missing.all() and not hurt.success
    np.testing.assert_allclose(hurt.x[~missing], good.x[~missing], atol=1e-3)
    assert "block [" in str(hurt) and ("Terminated" in str(hurt) or "nothing is known" in str(hurt))


def test_a_task_that_raises_gives_its_exception():
    """What a task raises stands in its place."""
    results = in_parallel([lambda: 1, lambda: 1 / 0, lambda: 3])
    assert results[0] == 1 and isinstance(results[1], ZeroDivisionError) and results[2] == 3


def test_the_full_problem_takes_time_in_proportion_to_the_record():
    """A record ten times as long takes as many iterations, not more: the work is O(T)."""
    short, long = (estimate_offline(linear_mhe(), linear_record(n)[0], guess=np.ones(3)) for n in (60, 600))
    assert long.blocks[0].status.iterations <= short.blocks[0].status.iterations + 1
    assert long.blocks[0].status.factorizations <= short.blocks[0].status.factorizations + 1


def test_performance_counts_disturbance_and_output_error():
    """J (6.53) is the sum by hand, whatever the estimates; the truth rebuilt gives its own disturbance (6.52)."""
    log, problem = linear_record()
    x = np.random.default_rng(3).normal(size=(61, 3))
    d = x[1:] - x[:-1] @ A.T - problem.b
    v = log.y[:-1] - x[:-1] @ C.T
    mhe = linear_mhe()
    t, w = rebuilt_disturbance(mhe, log, log.t, x)
    np.testing.assert_allclose(w[: len(d)], d, atol=1e-12)
    np.testing.assert_allclose(t[:61], log.t)
    np.testing.assert_allclose(performance(mhe, log, log.t, x), 3 * np.sum(d**2) + 2 * np.sum(v**2))
    part = performance(mhe, log, log.t[10:31], x[10:31])
    np.testing.assert_allclose(part, 3 * np.sum(d[10:30] ** 2) + 2 * np.sum(v[10:30] ** 2))


def test_in_continuous_time_the_performance_of_the_solution_is_its_cost():
    """Rebuilding the solution's own disturbance from its states gives back its cost: nothing is lost on the way."""
    log, _ = reactor_record()
    mhe = reactor_mhe()
    full = estimate_offline(mhe, log, guess=[3.0, 0.5])
    y0 = (log.y[0, 0] - full.x[0].sum()) ** 2 * 1e2  # a sample at the first instant is not part of (t1, t2]
    assert performance(mhe, log, full.t, full.x) + y0 <= full.blocks[0].cost * (1 + 1e-9)
    np.testing.assert_allclose(performance(mhe, log, full.t, full.x) + y0, full.blocks[0].cost, rtol=1e-3)


def test_no_estimates_have_less_regret_than_the_best_with_both_ends_fixed():
    """The benchmark is optimal between its own ends: the regret of others with these ends is positive."""
    log, _ = linear_record()
    mhe = linear_mhe(P=0.0)
    best = infinite_horizon(mhe, log, margin=6.0, guess=np.ones(3))
    rng = np.random.default_rng(0)
    assert regret(mhe, log, best.t, best.x, best.x).total == 0.0
    for _ in range(5):
        other = best.x + 0.1 * rng.normal(size=best.x.shape)
        other[[0, -1]] = best.x[[0, -1]]
        found = regret(mhe, log, best.t, other, best.x)
        assert found.total > 0 and found.rate == found.total / found.length and found.relative > 0


def test_smoothing_errors_decay_with_the_distance_from_the_ends():
    """The difference to the benchmark falls exponentially towards the middle: at the rate of the Hamiltonian (6.29)."""
    log, problem = linear_record(120)
    mhe = linear_mhe(P=0.0)
    best = infinite_horizon(mhe, log, margin=20.0, guess=np.ones(3))
    assert best.change < 1e-3
    inner = (log.t >= best.t[0]) & (log.t <= best.t[-1])
    part = MeasurementLog(log.t[inner], log.y[inner], log.outputs, log.u[inner], log.inputs)
    finite = estimate_offline(mhe, part, guess=np.ones(3), times=best.t)
    error = np.linalg.norm(finite.x - best.x, axis=1)
    H, D, steps = C.T @ problem.R @ C, np.linalg.inv(A).T, np.arange(3, 12)
    E = np.linalg.inv(problem.Q)  # x+ = A x - E l+ and l = A' l+ + H x
    moduli = np.abs(np.linalg.eigvals(np.block([[A + E @ D @ H, -E @ D], [-D @ H, D]])))
    slowest = moduli[moduli < 1].max()
    for arc in (error, error[::-1]):
        rate = np.exp(np.polyfit(steps, np.log(arc[steps]), 1)[0])
        assert abs(rate - slowest) < 0.05 and arc[len(arc) // 2] < 1e-4


def test_what_does_not_fit_is_named():
    """Discount, missing inputs and outputs, lengths, times and estimated parameters in blocks are named."""
    log, _ = linear_record()
    mhe = linear_mhe()
    with pytest.raises(InputError, match=r"eta = 0\.9"):
        estimate_offline(linear_mhe(eta=0.9), log, guess=np.ones(3))
    with pytest.raises(InputError, match="without block"):
        estimate_offline(mhe, log, guess=np.ones(3), keep=1.0)
    with pytest.raises(InputError, match="keep at most the block"):
        estimate_offline(mhe, log, guess=np.ones(3), block=1.0, keep=2.0)
    with pytest.raises(InputError, match="times must lie"):
        estimate_offline(mhe, log, guess=np.ones(3), times=[1e3])
    with pytest.raises(InputError, match="no column for input u"):
        estimate_offline(mhe, replace(log, u=np.empty((61, 0)), inputs=()), guess=np.ones(3))
    with pytest.raises(InputError, match="the model y"):
        estimate_offline(mhe, replace(log, outputs=("z",)), guess=np.ones(3))
    model = batch_reactor(noise=False, parameters="k1")
    joint = MHE(
        model, horizon=2.0, interval=0.1, integrator=RK4(0.1), hold="point",
        cost=DiscountedCost(P=np.ones(3), Q=1.0, R=1.0),
    )  # fmt: skip
    with pytest.raises(InputError, match="parameters k1 are estimated"):
        estimate_offline(joint, reactor_record()[0], guess=[3.0, 1.0], block=2.0)
    with pytest.raises(InputError, match="margin"):
        infinite_horizon(mhe, log, margin=15.0, guess=np.ones(3))
    with pytest.raises(InputError, match=r"no estimate at t = 0\.5"):
        performance(mhe, log, log.t[::2], np.zeros((31, 3)))
    stiff = ContinuousModel(
        lambda t, x, u, w, p: [x[1], w[0]], lambda t, x, u, w, p: x[0], x=("q", "v"), w="a", y="z", name="mass"
    )
    one_push = MHE(stiff, horizon=1.0, interval=0.1, integrator=RK4(0.1), cost=DiscountedCost())
    record = MeasurementLog(np.arange(5) * 0.1, np.zeros(5), ("z",), np.empty((5, 0)))
    with pytest.raises(InputError, match="reach 1 of them"):
        performance(one_push, record, record.t, np.random.default_rng(0).normal(size=(5, 2)))
