"""Convergence from poor guesses: Gauss-Newton in the compiled core against IPOPT, both from the same random points.

    python -m benchmarks.starts [--models NAME ...] [--starts 1000] [--seed 0] [--json FILE]

Every library model has one window of noisy samples at irregular times, with a prior that is off. A start is a
trajectory without disturbance over that window, from x_0 drawn evenly from the model's bounds (`RANGES` where they are
infinite) and, where parameters are estimated, p drawn likewise: every other one is the model's own trajectory
from x_0, moved into the bounds, the others stay at x_0 (so do those that the model carries to infinity). The first
start is the prior itself.

    best       the lowest cost that IPOPT ends at from any start
    ipopt      starts from which IPOPT ends there (cost to 1e-6 relative)
    both       of these, from how many Gauss-Newton does
    elsewhere  of these, from how many Gauss-Newton ends in another minimum, checked to be one
    failed     of these, from how many Gauss-Newton reports no success
    false      of all starts: success reported where IPOPT still gains more than 1e-8 of the cost, or does not stay
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe import MHE, RK4, Bounds, DiscountedCost, Input, Measurement
from ctmhe.models.library import batch_reactor, cascaded_tanks, chua, cstr, hover_speed, quadrotor, van_der_pol
from ctmhe.solvers.base import Solution, Solver, clip_to_bounds
from ctmhe.solvers.compiled import compiled_solver
from ctmhe.solvers.ipopt import Ipopt
from ctmhe.transcription.problem import Guess, Window, rollout
from ctmhe.types import Array

REACHED = 1e-6  # relative difference of two costs that are the same
NEAR = 1e-2  # difference of two trajectories that are the same, relative to the signals' scales
GAIN = 1e-8  # relative to the cost: what may be left to gain where success is reported
NOTHING = 1e-12  # of the cost of explaining nothing: costs below are zero

# Where the model has no bounds: the states a user of the plant would think of.
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "quadrotor": dict.fromkeys(("z1", "z2", "z3"), (-2.0, 2.0)) | dict.fromkeys(("s1", "s2", "s3"), (-2.0, 2.0)),
    "van_der_pol": {"x1": (-4.0, 4.0), "x2": (-6.0, 6.0)},
    "cstr": {"c0": (0.5, 1.5)},
}


@dataclass(frozen=True, eq=False)
class Setting:
    """One window to start in: the estimator, the truth that is simulated, the prior, the known input."""

    mhe: MHE
    truth: Sequence[float]
    prior: Sequence[float]
    p_truth: Sequence[float]
    p_prior: Sequence[float]
    u: Callable[[float], Sequence[float]] | None
    noise: Sequence[float]
    gap: float  # mean seconds between samples


def reactor() -> Setting:
    """Thesis 3.4.1 from its poor guess: [0.1, 4.5] against [3, 1]."""
    model = batch_reactor(noise=False)
    P = 2 * np.array([[4.009, 3.768], [3.768, 3.549]])
    cost = DiscountedCost(eta=0.4, P=P, Q=2e3, R_point=1e2)
    mhe = MHE(model, horizon=4.0, interval=0.1, integrator=RK4(0.05), cost=cost, bounds=model.bounds, hold="point")
    return Setting(mhe, [3.0, 1.0], [0.1, 4.5], [], [], None, [0.05], 0.1)


def copter() -> Setting:
    """The quadrotor in hover, tilted and moving."""
    model = quadrotor(noise=False)
    cost = DiscountedCost(P=1.0, Q=1e3, R_point=[1e3] * 3 + [1e4] * 3, eta=0.9)
    mhe = MHE(model, horizon=1.2, interval=0.1, integrator=RK4(0.1), cost=cost, bounds=model.bounds, hold="point")
    truth = [0.3, -0.2, 0.5, 0.1, -0.15, 0.3, 0.4, -0.2, 0.1, 0.1, -0.1, 0.2]
    return Setting(mhe, truth, [0.0] * 12, [], [], lambda t: [hover_speed()] * 4, [0.03] * 3 + [0.01] * 3, 0.1)


def circuit() -> Setting:
    """The Chua circuit with its cubic coefficient."""
    model = chua(noise=False)
    cost = DiscountedCost(P=np.diag([1.0, 1.0, 1.0, 10.0]), Q=1e2, R_point=4e2, eta=0.9)
    mhe = MHE(model, horizon=2.0, interval=0.05, integrator=RK4(0.025), cost=cost, bounds=model.bounds, hold="point")
    return Setting(mhe, [1.0, 0.0, -1.0], [0.8, 0.1, -0.8], [0.45], [0.4], None, [0.05], 0.05)


def tank() -> Setting:
    """The stirred tank with an unknown feed concentration: one equilibrium of three, temperature only."""
    model = cstr(noise=False, parameters="c0")
    rates = np.array([5e-3, 1.0, 5e-3]) / 15
    cost = DiscountedCost(P=np.diag([10.0, 1e-2, 100.0, 10.0]), Q=1e-2 / rates**2, R_point=0.25, eta=1.0)
    options = dict(interval=15.0, integrator=RK4(7.5), hold="point", bounds=model.bounds)
    mhe = MHE(model, horizon=300.0, cost=cost, **options)  # type: ignore[arg-type]
    return Setting(
        mhe, [0.85, 324.0, 0.66], [0.8, 310.0, 0.7], [1.0], [0.9],
        lambda t: [300.0 + 3.0 * np.sign(np.sin(t / 40)), 0.1], [2.0], 12.0,
    )  # fmt: skip


def oscillator() -> Setting:
    """Van der Pol's oscillator over one period and a half, position only, its damping unknown."""
    model = van_der_pol(noise=False, parameters="mu")
    cost = DiscountedCost(P=np.diag([0.1, 0.1, 0.1]), Q=1e2, R_point=1e2, eta=0.95)
    mhe = MHE(
        model, horizon=8.0, interval=0.4, integrator=RK4(0.1), cost=cost, bounds=Bounds(p=(0.1, 3.0)), hold="point"
    )
    return Setting(mhe, [2.0, 0.0], [1.0, 1.0], [1.0], [0.8], None, [0.1], 0.3)


def tanks() -> Setting:
    """Two tanks that overflow for a while, lower level only."""
    model = cascaded_tanks(noise=False)
    cost = DiscountedCost(P=0.1, Q=1e4, R_point=1e2, eta=0.99)
    mhe = MHE(model, horizon=80.0, interval=4.0, integrator=RK4(1.0), cost=cost, bounds=model.bounds, hold="point")
    return Setting(
        mhe, [9.5, 6.0], [4.0, 3.0], [], [], lambda t: [4.5 + 2.0 * np.sign(np.sin(t / 20))], [0.1], 4.0
    )


SETTINGS: dict[str, Callable[[], Setting]] = {
    "batch_reactor": reactor,
    "quadrotor": copter,
    "chua": circuit,
    "cstr": tank,
    "van_der_pol": oscillator,
    "cascaded_tanks": tanks,
}


def window_of(setting: Setting, seed: int) -> Window:
    """Return the window over a simulated record: samples at irregular times, disturbed and noisy."""
    mhe, rng = setting.mhe, np.random.default_rng([seed, 1])
    state = mhe.init(x=setting.prior, p=setting.p_prior or None)
    if setting.u is not None:
        for t in np.arange(0.0, mhe.horizon, mhe.interval):
            state = mhe.control(state, Input(float(t), setting.u(t)))
    x, p, t = np.array(setting.truth), np.array(setting.p_truth), 0.0
    while True:
        after = t + rng.exponential(0.8 * setting.gap) + 0.2 * setting.gap
        if after >= mhe.horizon:
            break
        x, t = mhe.propagate(state, t, after, x, p), after
        row = mhe.output(state, t, x, p) + np.array(setting.noise) * rng.normal(size=len(setting.noise))
        state = mhe.observe(state, Measurement(t, row))
    return mhe._window(state, mhe.horizon)[0]


def starts_of(name: str, setting: Setting, window: Window, count: int, seed: int) -> Iterator[Guess]:
    """Yield the prior and then random trajectories without disturbance, of the model and constant in turn."""
    mhe, rng = setting.mhe, np.random.default_rng([seed, 2])
    stage, n = mhe.stage, len(window.mesh)
    names = (*mhe.model.x.names, *mhe.model.p.names)
    low = np.concatenate([window.x_lower[0], window.p_lower])
    high = np.concatenate([window.x_upper[0], window.p_upper])
    for at, signal in enumerate(names):
        if signal in RANGES.get(name, {}):
            low[at], high[at] = RANGES[name][signal]
    for i in range(count):
        values = rng.uniform(low, high) if i else window.prior
        x, p = values[: stage.nx], values[stage.nx :]
        guess = Guess.of(np.tile(x, (n + 1, 1)), np.zeros((n, stage.nw)), p, stage.ny)
        if i % 2 == 0:
            with np.errstate(all="ignore"):
                try:
                    rolled = rollout(stage, window, x, p)
                except FloatingPointError:
                    rolled = guess
            if np.isfinite(rolled.x).all():
                guess = rolled
        yield clip_to_bounds(window, guess)


@dataclass(frozen=True, eq=False)
class Trial:
    """One start: where IPOPT and Gauss-Newton ended, and what IPOPT still gains where Gauss-Newton did."""

    ipopt: Solution
    ours: Solution
    seconds: float
    gain: float  # relative to the cost; NaN where no success was reported


def attempt(window: Window, guess: Guess, solver: Solver, reference: Solver, check: Solver) -> Trial:
    """Solve from one start with both, and check the success of ours."""
    ipopt = reference.solve(window, guess)
    began = time.perf_counter()
    ours = solver.solve(window, guess)
    seconds = time.perf_counter() - began
    return Trial(ipopt, ours, seconds, left_to_gain(window, ours, ipopt, check) if ours.success else float("nan"))


def left_to_gain(window: Window, ours: Solution, ipopt: Solution, check: Solver) -> float:
    """Return by how much IPOPT betters a solution, relative: where it ended itself, if that is here, else from here."""
    apart = np.abs(ours.point.x - ipopt.point.x) / window.x_scale
    again = ipopt if ipopt.success and apart.max() < NEAR else check.solve(window, ours.point)
    if not again.success or np.abs((ours.point.x - again.point.x) / window.x_scale).max() > NEAR:
        return float("inf")
    return (ours.cost - again.cost) / max(again.cost, floor(window))


def floor(window: Window) -> float:
    """Return the cost below which costs are zero, as far as that can be told."""
    return NOTHING / GAIN * float(np.sum((window.L_y @ window.y_data[..., None]) ** 2))


def same(cost: float, best: float, window: Window) -> bool:
    """Return whether a cost is the best one."""
    return bool(cost - best <= REACHED * max(best, floor(window)))


def row_of(name: str, window: Window, trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the counts of one model."""
    best = min((t.ipopt.cost for t in trials if t.ipopt.success), default=float("nan"))
    there = [t for t in trials if t.ipopt.success and same(t.ipopt.cost, best, window)]
    both = [t for t in there if t.ours.success and same(t.ours.cost, best, window)]
    succeeded = [t for t in trials if t.ours.success]
    return {
        "model": name,
        "starts": len(trials),
        "slots": len(window.mesh),
        "best": best,
        "ipopt": len(there),
        "both": len(both),
        "share": len(both) / len(there) if there else float("nan"),
        "elsewhere": sum(t.ours.success and not same(t.ours.cost, best, window) and t.gain <= GAIN for t in there),
        "failed": sum(not t.ours.success for t in there),
        "false": sum(not t.gain <= GAIN for t in succeeded),
        "ours": sum(same(t.ours.cost, best, window) for t in succeeded),
        "iterations": float(np.median([t.ours.iterations for t in trials])),
        "most_iterations": max(t.ours.iterations for t in trials),
        "median_ms": 1e3 * float(np.median([t.seconds for t in trials])),
    }


def run(name: str, count: int, seed: int, *, specialise: bool = True, solver: Solver | None = None) -> list[Trial]:
    """Return the trials of one model."""
    setting = SETTINGS[name]()
    window, stage = window_of(setting, seed), setting.mhe.stage
    solver = solver or compiled_solver(stage, specialise=specialise)
    if solver is None:
        raise SystemExit("the compiled core is needed: install a C compiler")
    reference, check = Ipopt(stage), Ipopt(stage, options={"ipopt.mu_init": 1e-8})
    return [attempt(window, g, solver, reference, check) for g in starts_of(name, setting, window, count, seed)]


HEAD = ("model", "starts", "ipopt", "both", "share", "elsewhere", "failed", "false", "iterations", "median_ms")


def table(row: dict[str, Any]) -> str:
    """Return one line of the printed table."""
    return (
        f"{row['model']:15}{row['starts']:>8}{row['ipopt']:>8}{row['both']:>8}{100 * row['share']:>9.1f}%"
        f"{row['elsewhere']:>10}{row['failed']:>9}{row['false']:>8}{row['iterations']:>8.0f} ({row['most_iterations']})"
        f"{row['median_ms']:>11.2f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the starts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    print(
        f"{'model':15}{'starts':>8}{'ipopt':>8}{'both':>8}{'share':>10}{'elsewhere':>10}{'failed':>9}{'false':>8}"
        f"{'iterations (most)':>18}{'median ms':>11}"
    )
    rows = []
    for name in given.models:
        setting = SETTINGS[name]()
        rows.append(row_of(name, window_of(setting, given.seed), run(name, given.starts, given.seed)))
        print(table(rows[-1]))
        sys.stdout.flush()
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
