"""What an FMU costs in the place of a Python model: updates, isolation, loading, and a thousand times over.

    python -m benchmarks.fmus [--json FILE] [--updates 30] [--cycles 1000] [update load cycles]

    update      one update of the same estimator with the Python model and with its FMU, taking turns. Per update the
                fastest of some repeats counts; then medians over the updates. Beside it the FMI calls that an update
                makes, counted, and the time of exactly these calls alone, which take their turn too
    load        seconds to build a model, by how thoroughly it is checked; medians, the checks taking turns
    cycles      resident memory of one process that loads, estimates and closes again and again, and the temporary
                folders that it leaves

A row is {part, problem, what, value, unit, target}; the target is the largest value that was asked for, or null.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.limits import Row, apart, collected, resident, row
from ctmhe import CVODES, MHE, RK4, ContinuousModel, DiscountedCost, FmuModel, Input, Measurement
from ctmhe.models.library import batch_reactor, hover_speed, quadrotor, van_der_pol
from ctmhe.types import Array, Estimate
from fmus.build import build

REPEATS = 5
LOADS = 7  # of every kind
# standard deviations between the estimates of all models: each converges to the root of its tolerance, 3e-5, and goes
# on from priors of its own, which were as near
AGREEMENT = 1e-3
MOST_RATIO, MOST_OVERHEAD = 5.0, 1.5  # FMU over Python model, neither compiled; update over its bare calls
COMPILE = {"not compiled": "off", "compiled": "auto"}  # of the core: an FMU's own code stays as it is
CHECKS = ("full", "fast", "off")
ISOLATED = "FMI 2, isolated"
SETTLED = 100  # cycles after which memory counts
READING = 25  # cycles from one reading of it to the next


@dataclass(frozen=True)
class Problem:
    """A model both ways, and how it is estimated.

    Attributes
    ----------
    fmu : str
        Name of the FMU.
    arguments : dict
        Of `FmuModel`.
    python : callable
        Returns the same model in Python.
    settings : dict
        Of `MHE`.
    guess : array (nx,)
    outputs : callable k -> array (ny,)
        What is measured at the end of interval k.
    u : array (nu,)
    updates, repeats : int
        At most; a window that takes seconds is not solved as often as others.
    """

    fmu: str
    arguments: dict[str, Any]
    python: Callable[[], ContinuousModel]
    settings: dict[str, Any]
    guess: Any
    outputs: Callable[[int], Any]
    u: Any = ()
    updates: int = 10_000
    repeats: int = REPEATS

    def model(self, fmi: int, **options: Any) -> FmuModel:
        """Return the FMU as a model."""
        return FmuModel(build(self.fmu, fmi=fmi), **self.arguments, **options)

    @property
    def intervals(self) -> int:
        """Number of intervals in the window."""
        return round(self.settings["horizon"] / self.settings["interval"])


def noise(k: int, count: int) -> Array:
    """Return standard normal numbers (count,) that belong to interval k."""
    return np.random.default_rng(k).normal(size=count)


def weights(**changes: Any) -> DiscountedCost:
    """Return the cost of a problem."""
    return DiscountedCost(**({"eta": 0.5, "P": 10.0, "Q": 1e3, "R": 1e2} | changes))


PROBLEMS = {
    "reactor": Problem(
        "batch_reactor",
        {"inputs": []},
        lambda: batch_reactor(noise=False),
        {"horizon": 2.0, "interval": 0.1, "integrator": RK4(0.01), "cost": weights(P=[8.0, 7.1], Q=2e3)},
        [2.5, 1.4],
        lambda k: 4.0 - 0.08 * k + 0.01 * noise(k, 1) if k < 20 else 2.4 + 0.01 * noise(k, 1),
    ),
    "quadrotor": Problem(
        "quadrotor",
        {},
        lambda: quadrotor(noise=False),
        {"horizon": 1.0, "interval": 0.05, "integrator": RK4(0.05), "cost": weights(), "hold": "point"},
        np.full(12, 0.02),
        lambda k: 0.02 * noise(k, 6),
        hover_speed() * np.array([1.01, 0.99, 1.02, 1.0]),
    ),
    "vdp": Problem(
        "van_der_pol",
        {"inputs": [], "start": {"mu": 100.0}},
        lambda: van_der_pol(mu=100.0, noise=False),
        {"horizon": 0.5, "interval": 0.1, "integrator": CVODES(), "cost": weights(eta=0.9), "hold": "point"},
        [1.9, 0.0],
        lambda k: 2.0 - 6.6e-4 * k + 1e-3 * noise(k, 1),
        updates=2,
        repeats=2,
    ),
}


@dataclass
class Runner:
    """One model's estimator as it moves on, and what was measured of it."""

    model: Any
    mhe: MHE
    state: Any
    seconds: list[float] = field(default_factory=list)
    bare: list[float] = field(default_factory=list)
    calls: list[dict[str, int]] = field(default_factory=list)

    @classmethod
    def of(cls, problem: Problem, model: Any, compile: str) -> Runner:
        """Return the estimator at its start."""
        mhe = MHE(model, compile=compile, **problem.settings)
        state = mhe.init(x=problem.guess)
        if len(model.u):
            state = mhe.control(state, Input(0.0, problem.u))
        return cls(model, mhe, state)

    @property
    def counts(self) -> dict[str, int]:
        """FMI calls so far, by kind; none of a Python model, nor of one in another process."""
        return self.model.evaluator().counts()[0] if isinstance(self.model, FmuModel) else {}


def estimate(runners: dict[str, Runner], t: float, repeats: int) -> dict[str, Estimate]:
    """Let all move on to `t`, in turns, as often as told; keep the fastest and go on from there."""
    fastest, bare = dict.fromkeys(runners, np.inf), dict.fromkeys(runners, np.inf)
    results: dict[str, tuple[Any, Estimate]] = {}
    for _ in range(repeats):
        for name, runner in runners.items():
            before = runner.counts
            began = time.perf_counter()
            results[name] = runner.mhe.estimate(runner.state, t)
            fastest[name] = min(fastest[name], time.perf_counter() - began)
            calls = {kind: count - before[kind] for kind, count in runner.counts.items()}
            if any(calls.values()):
                began = time.perf_counter()
                runner.model.evaluator().repeat(results[name][1].x, calls)
                bare[name] = min(bare[name], time.perf_counter() - began)
                runner.calls.append(calls)
    for name, runner in runners.items():
        runner.state = results[name][0]
        runner.seconds.append(fastest[name])
        runner.bare.append(bare[name])
    return {name: result for name, (_, result) in results.items()}


def race(problem: Problem, updates: int) -> dict[str, Runner]:
    """Return the runners of a problem after so many updates of a full window."""
    models = {"Python": problem.python(), "FMI 2": problem.model(2), "FMI 3": problem.model(3)}
    pairs = [(kind, how) for kind in models for how in COMPILE]
    runners = {f"{kind}, {how}": Runner.of(problem, models[kind], COMPILE[how]) for kind, how in pairs}
    runners[ISOLATED] = Runner.of(problem, problem.model(2, isolated=True), COMPILE["compiled"])
    first = "Python, not compiled"
    for k in tqdm(range(problem.intervals + updates), f"update {problem.fmu}", leave=False):
        t, y = k * problem.settings["interval"], problem.outputs(k)
        for runner in runners.values():
            runner.state = runner.mhe.observe(runner.state, Measurement(t, y))
        found = estimate(runners, t, problem.repeats if k >= problem.intervals else 1)
        std = np.sqrt(np.diag(found[first].covariance))
        for name, result in found.items():
            if not result.status.success:
                raise SystemExit(f"{problem.fmu}, {name}: not solved at t = {t:g}: {result.status}")
            off = float(np.max(np.abs(result.x - found[first].x) / std))
            if off > AGREEMENT:
                raise SystemExit(f"{problem.fmu}, {name}: {off:.1e} standard deviations from {first} at t = {t:g}")
    for runner in runners.values():
        runner.seconds, runner.bare = runner.seconds[-updates:], runner.bare[-updates:]
        runner.calls = runner.calls[-updates * problem.repeats :]
    return runners


def update(names: Sequence[str], updates: int) -> Iterator[Row]:
    """Yield the times of updates, of their FMI calls, and the ratios."""
    for name in names:
        problem = PROBLEMS[name]
        runners = race(problem, min(updates, problem.updates))
        seconds = {kind: np.array(runner.seconds) for kind, runner in runners.items()}
        for kind, values in seconds.items():
            yield row("update", name, kind, 1e3 * np.median(values), "ms")
        for kind, how in ((kind, how) for kind in ("FMI 2", "FMI 3") for how in COMPILE):
            runner, values = runners[f"{kind}, {how}"], seconds[f"{kind}, {how}"]
            ratio = np.median(values / seconds[f"Python, {how}"])
            yield row(
                "update", name, f"{kind} / Python, {how}", ratio, "", MOST_RATIO if how == "not compiled" else None
            )
            for call in runner.calls[0] if how == "compiled" else ():
                count = np.median([calls[call] for calls in runner.calls])
                if count:
                    yield row("update", name, f"{kind}: calls of {call}", count, "")
            bare = np.array(runner.bare)
            yield row("update", name, f"{kind}: its FMI calls alone, {how}", 1e3 * np.median(bare), "ms")
            yield row("update", name, f"{kind}: update / calls, {how}", np.median(values / bare), "", MOST_OVERHEAD)
        cost = np.median(seconds[ISOLATED] / seconds["FMI 2, compiled"])
        yield row("update", name, f"{ISOLATED} / in this process", cost, "")
        for runner in runners.values():
            if isinstance(runner.model, FmuModel):
                runner.model.close()


def load(names: Sequence[str]) -> Iterator[Row]:
    """Yield the seconds to build a model."""
    for name in names:
        seconds = np.empty((LOADS, len(CHECKS)))
        for i in range(LOADS):
            for j, check in enumerate(CHECKS):
                began = time.perf_counter()
                model = PROBLEMS[name].model(2, check=check)
                seconds[i, j] = time.perf_counter() - began
                model.close()
        for j, check in enumerate(CHECKS):
            yield row("load", name, f'check="{check}"', 1e3 * np.median(seconds[:, j]), "ms")


def go_round(count: int) -> list[tuple[int, int, int]]:
    """Return (cycle, resident bytes, temporary folders) of a process that loads, estimates and closes."""
    problem, readings = PROBLEMS["reactor"], []
    build(problem.fmu)
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder
        for cycle in tqdm(range(1, count + 1), "cycles", mininterval=2.0):
            model = problem.model(2, check="fast")
            runner = Runner.of(problem, model, "off")
            state = runner.mhe.observe(runner.state, Measurement(0.5, problem.outputs(5)))
            _, result = runner.mhe.estimate(state, 0.5)
            assert result.status.success, result.status
            model.close()
            del model, runner, state, result
            if cycle % READING == 0 or cycle == count:
                gc.collect()
                readings.append((cycle, resident(), len(list(Path(folder).glob("*")))))
        tempfile.tempdir = None
    return readings


def cycles(count: int) -> Iterator[Row]:
    """Yield what loading again and again leaves behind, in a process of its own."""
    at, memory, folders = np.array(apart(go_round, count), float).T
    settled = at >= min(SETTLED, count / 2)
    yield row("cycles", "reactor", "load, estimate, close: cycles", count, "")
    for i in (int(np.flatnonzero(settled)[0]), -1):
        yield row("cycles", "reactor", f"resident after {at[i]:.0f} cycles", memory[i] / 2**20, "MiB")
    slope = np.polyfit(at[settled], memory[settled], 1)[0] if settled.sum() > 1 else 0.0
    yield row("cycles", "reactor", "resident, slope", slope / 1024, "KiB a cycle")
    yield row("cycles", "reactor", "temporary folders left", folders[-1], "", 0.0)


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """Run the benchmark from the command line and return its rows."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fmus", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = ("update", "load", "cycles")
    parser.add_argument("parts", nargs="*", metavar="PARTS", help=f"of {', '.join(parts)}; all when left out")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--updates", type=int, default=30, help="for every problem, at most")
    parser.add_argument("--cycles", type=int, default=1000)
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    options = parser.parse_args(arguments)
    unknown = set(options.parts) - set(parts)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; choose from {', '.join(parts)}")
    run = {
        "update": lambda: update(options.problems, options.updates),
        "load": lambda: load(options.problems),
        "cycles": lambda: cycles(options.cycles),
    }
    return collected({part: run[part] for part in options.parts or parts}, options.json)


if __name__ == "__main__":
    main()
