"""Where one update of ctmhe spends its time: `python -m benchmarks.profile_update [--problems ...] [--compile auto]`.

Functions of the library are wrapped by timers that count their own time only, without that of wrapped functions that
they call; what no wrapped function accounts for is Python's. Wrapping costs about 1 us a call; the total is timed
without it as well. Functions that a version of the library does not have are left out.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.problems import PROBLEMS, SCALING, Problem
from benchmarks.reference import build, grow, observe

PARTS: dict[str, tuple[str, ...]] = {
    "model functions": (
        "ctmhe.transcription.stage:StageFunction.values",
        "ctmhe.transcription.stage:StageFunction.linearize",
        "ctmhe.transcription.stage:StageFunction.curvature",
        "ctmhe.transcription.stage:StageFunction.step",
    ),
    "compiled core, model functions included": ("ctmhe.solvers.compiled:CompiledGaussNewton.solve",),
    "compiled core: copy in and out": (
        "ctmhe.solvers.compiled:_Memory.write",
        "ctmhe.solvers.compiled:_Memory.read",
    ),
    "quadratic program: build": ("ctmhe.solvers.gauss_newton:GaussNewton._quadratic_program",),
    "quadratic program: factorise, solve, bounds": ("ctmhe.solvers.quadratic:KKT.solve",),
    "step length and merit": (
        "ctmhe.solvers.gauss_newton:GaussNewton._line_search",
        "ctmhe.solvers.gauss_newton:GaussNewton._judge",
        "ctmhe.solvers.gauss_newton:GaussNewton._model_decrease",
        "ctmhe.solvers.gauss_newton:GaussNewton._move",
    ),
    "solver, other": ("ctmhe.solvers.gauss_newton:GaussNewton.solve", "ctmhe.solvers.ladder:climb"),
    "reference solver": ("ctmhe.solvers.ipopt:Ipopt.solve",),
    "window assembly": ("ctmhe.transcription.assembly:Assembly.window",),
    "warm start and prior": (
        "ctmhe.estimators.mhe:MHE._guesses",
        "ctmhe.estimators.mhe:MHE._prior",
    ),
    "logs": (
        "ctmhe.estimators.mhe:MHE._records",
        "ctmhe.estimators.mhe:MHE.observe",
        "ctmhe.estimators.mhe:MHE.control",
    ),
    "estimate and new state": ("ctmhe.estimators.mhe:MHE._to_estimate", "ctmhe.estimators.mhe:MHE._advance"),
}


class Clock:
    """Own seconds and calls by part."""

    def __init__(self):
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.calls: defaultdict[str, int] = defaultdict(int)
        self._inner = [0.0]

    def wrap(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose own time is added to a part."""

        @functools.wraps(function)
        def timed(*arguments: Any, **keywords: Any) -> Any:
            self._inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*arguments, **keywords)
            finally:
                whole = time.perf_counter() - began
                inner = self._inner.pop()
                self._inner[-1] += whole
                self.seconds[part] += whole - inner
                self.calls[part] += 1

        return timed


def found(path: str) -> tuple[Any, str] | None:
    """Return the owner and the name of `module:Class.function`, None where this version has none."""
    module, _, name = path.partition(":")
    try:
        owner: Any = importlib.import_module(module)
    except ModuleNotFoundError:
        return None
    *outer, last = name.split(".")
    for part in outer:
        owner = getattr(owner, part, None)
    return (owner, last) if owner is not None and hasattr(owner, last) else None


@contextmanager
def instrumented(clock: Clock) -> Iterator[None]:
    """Wrap the functions of `PARTS`, also where another module imported them by name."""
    changed: list[tuple[Any, str, Any]] = []
    try:
        for part, paths in PARTS.items():
            for path in paths:
                place = found(path)
                if place is None:
                    continue
                owner, name = place
                old = getattr(owner, name)
                new = clock.wrap(part, old)
                targets = [owner] + [importlib.import_module("ctmhe.estimators.mhe")] * (name == "climb")
                for target in targets:
                    changed.append((target, name, old))
                    setattr(target, name, new)
        yield
    finally:
        for owner, name, old in reversed(changed):
            setattr(owner, name, old)


def run(problem: Problem, updates: int, options: dict[str, Any]) -> tuple[float, float, int]:
    """Return the seconds of all updates, the median and the iterations."""
    mhe = build(problem, **options)
    state, _ = grow(mhe, problem)
    seconds, iterations = [], 0
    for k in range(1, updates + 1):
        j = problem.count + k
        began = time.perf_counter()
        state = observe(mhe, state, problem, j)
        state, estimate = mhe.estimate(state, j * problem.interval)
        seconds.append(time.perf_counter() - began)
        iterations += estimate.status.iterations
    return sum(seconds), float(np.median(seconds)), iterations


def profile(problem: Problem, updates: int, options: dict[str, Any]) -> None:
    """Print the shares of one problem."""
    _, median, _ = run(problem, updates, options)
    clock = Clock()
    mhe = build(problem, **options)
    state, _ = grow(mhe, problem)  # not counted: the wrappers are not there yet
    with instrumented(clock):
        began = time.perf_counter()
        iterations = 0
        for k in range(1, updates + 1):
            j = problem.count + k
            state = observe(mhe, state, problem, j)
            state, estimate = mhe.estimate(state, j * problem.interval)
            iterations += estimate.status.iterations
        whole = time.perf_counter() - began
    print(
        f"\n{problem.name}: {1e3 * median:.3f} ms median an update ({1e3 * whole / updates:.3f} ms mean with timers), "
        f"{iterations / updates:.1f} iterations"
    )
    clock.seconds["Python between them"] = whole - sum(clock.seconds.values())
    print(f"  {'part':<46}{'share':>7}{'ms':>10}{'calls':>8}")
    for part, seconds in sorted(clock.seconds.items(), key=lambda item: -item[1]):
        calls = f"{clock.calls[part] / updates:8.1f}" if clock.calls[part] else ""
        print(f"  {part:<46}{seconds / whole:7.1%}{1e3 * seconds / updates:10.4f}{calls}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Profile from the command line."""
    every = {**PROBLEMS, **SCALING}
    parser = argparse.ArgumentParser(prog="python -m benchmarks.profile_update", description="Shares of one update.")
    parser.add_argument("--problems", nargs="+", choices=list(every), default=["P1a", "P1c", "P2", "P2c", "P3"])
    parser.add_argument("--updates", type=int, default=50)
    parser.add_argument("--compile", choices=["auto", "off"], default="auto", help="where the library can compile")
    options = parser.parse_args(arguments)
    chosen = {"compile": options.compile}
    for name in options.problems:
        profile(every[name](options.updates), options.updates, chosen)


if __name__ == "__main__":
    main()
