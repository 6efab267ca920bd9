"""Convergence from poor guesses: Gauss-Newton in the compiled core against IPOPT, both from the same random points.

    python -m benchmarks.starts [--models NAME ...] [--starts 1000] [--ipopt N] [--json FILE]

Every library model has one window of noisy samples at irregular times, with a prior that is off. A start is a
trajectory without disturbance over that window, from x_0 drawn evenly from the model's bounds (`RANGES` where they are
infinite) and, where parameters are estimated, p drawn likewise: every other one is the model's own trajectory
from x_0, moved into the bounds, the others stay at x_0 (so do those that the model carries to infinity). The first
start is the prior itself.

    asked       starts from which IPOPT was asked (`--ipopt`; beyond these only where ours misses the best cost)
    IPOPT       of these, the share from which it ends at the lowest cost that it finds at all (to 1e-6 relative)
    ours        the share of all starts from which Gauss-Newton ends there
    lost        starts from which IPOPT ends there and Gauss-Newton does not
    elsewhere   of these, where Gauss-Newton ends in another minimum
    share       of the starts from which IPOPT ends there, how many Gauss-Newton does: 1 - lost / (IPOPT starts)
    false       success reported where IPOPT still gains more than 1e-8 of the cost, or does not stay
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
from ctmhe.transcription.stage import StageFunction

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
    return Setting(mhe, [9.5, 6.0], [4.0, 3.0], [], [], lambda t: [4.5 + 2.0 * np.sign(np.sin(t / 20))], [0.1], 4.0)


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
    """One start: where IPOPT (None: not asked) and Gauss-Newton ended, and what IPOPT still gains from there."""

    ipopt: Solution | None
    ours: Solution
    seconds: float
    gain: float  # relative to the cost; NaN where no success was reported


class Judge:
    """IPOPT, and the minima that it has found in one window."""

    def __init__(self, window: Window, stage: StageFunction):
        self.window, self.minima = window, list[Solution]()
        self.reference, self.nearby = Ipopt(stage), Ipopt(stage, options={"ipopt.mu_init": 1e-8})
        self.floor = NOTHING / GAIN * float(np.sum((window.L_y @ window.y_data[..., None]) ** 2))

    def solve(self, guess: Guess, solver: Solver | None = None) -> Solution:
        """Return where IPOPT ends from a guess; remember new minima."""
        found = (solver or self.reference).solve(self.window, guess)
        if found.success and self.known(found) is None:
            self.minima.append(found)
        return found

    def known(self, solution: Solution) -> Solution | None:
        """Return the minimum that a solution lies at, if IPOPT has been there."""

        def apart(other: Solution) -> float:
            x = np.abs(solution.point.x - other.point.x) / self.window.x_scale
            p = np.abs(solution.point.p - other.point.p) / self.window.p_scale
            return max(float(x.max()), float(p.max(initial=0.0)))

        return next((other for other in self.minima if apart(other) < NEAR), None)

    def gain(self, solution: Solution) -> float:
        """Return by how much IPOPT betters a solution, relative; infinite when it does not stay there."""
        if self.known(solution) is None:
            self.solve(solution.point, self.nearby)
        minimum = self.known(solution)
        if minimum is None:
            return float("inf")
        return (solution.cost - minimum.cost) / max(minimum.cost, self.floor)

    def best(self, solution: Solution | None) -> bool:
        """Return whether a solution has the lowest cost of all minima."""
        lowest = min((minimum.cost for minimum in self.minima), default=float("nan"))
        return bool(
            solution is not None and solution.success and solution.cost - lowest <= REACHED * max(lowest, self.floor)
        )


def run(
    name: str, starts: int, seed: int = 0, *, asked: int | None = None, solver: Solver | None = None
) -> tuple[Judge, list[Trial]]:
    """Return the trials of one model; IPOPT solves the first `asked` (default: all) and those that ours misses."""
    setting = SETTINGS[name]()
    window, stage = window_of(setting, seed), setting.mhe.stage
    solver = solver or compiled_solver(stage, specialise=True, p_estimated=window.p_estimated)
    if solver is None:
        raise SystemExit("the compiled core is needed: install a C compiler")
    judge, trials = Judge(window, stage), list[Trial]()
    for i, guess in enumerate(starts_of(name, setting, window, starts, seed)):
        ipopt = judge.solve(guess) if asked is None or i < asked else None
        began = time.perf_counter()
        ours = solver.solve(window, guess)
        seconds = time.perf_counter() - began
        gain = judge.gain(ours) if ours.success else float("nan")
        if ipopt is None and not judge.best(ours):
            ipopt = judge.solve(guess)
        trials.append(Trial(ipopt, ours, seconds, gain))
    return judge, trials


def row_of(name: str, judge: Judge, trials: Sequence[Trial], asked: int | None = None) -> dict[str, Any]:
    """Return the counts of one model."""
    sample = trials[:asked]
    reached = sum(judge.best(t.ipopt) for t in sample) / len(sample)
    lost = [t for t in trials if judge.best(t.ipopt) and not judge.best(t.ours)]
    return {
        "model": name,
        "slots": len(judge.window.mesh),
        "starts": len(trials),
        "asked": len(sample),
        "ipopt": reached,
        "ours": sum(judge.best(t.ours) for t in trials) / len(trials),
        "lost": len(lost),
        "elsewhere": sum(t.ours.success for t in lost),
        "share": 1.0 - len(lost) / (reached * len(trials)) if reached else float("nan"),
        "false": sum(t.ours.success and not t.gain <= GAIN for t in trials),
        "best": min(minimum.cost for minimum in judge.minima),
        "minima": len(judge.minima),
        "iterations": float(np.median([t.ours.iterations for t in trials])),
        "most_iterations": max(t.ours.iterations for t in trials),
        "median_ms": 1e3 * float(np.median([t.seconds for t in trials])),
    }


HEAD = (
    f"{'model':15}{'starts':>7}{'asked':>7}{'IPOPT':>8}{'ours':>8}{'lost':>6}{'elsewhere':>11}{'share':>9}{'false':>7}"
    f"{'iterations':>12}{'most':>6}{'median ms':>11}"
)


def line(row: dict[str, Any]) -> str:
    """Return one line of the printed table."""
    return (
        f"{row['model']:15}{row['starts']:>7}{row['asked']:>7}{row['ipopt']:>8.1%}{row['ours']:>8.1%}{row['lost']:>6}"
        f"{row['elsewhere']:>11}{row['share']:>9.2%}{row['false']:>7}{row['iterations']:>12.0f}"
        f"{row['most_iterations']:>6}{row['median_ms']:>11.2f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the starts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--ipopt", type=int, help="starts that IPOPT solves whatever ours does; all when left out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    print(HEAD)
    rows = []
    for name in given.models:
        rows.append(row_of(name, *run(name, given.starts, given.seed, asked=given.ipopt), asked=given.ipopt))
        print(line(rows[-1]))
        sys.stdout.flush()
        if given.json:
            given.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
