"""Where one update of ctmhe spends its time: `python -m benchmarks.profile_update [--problems ...] [--compile auto]`.

An update is one call into the core, which has no clock inside. Its parts are found from outside:

- Python: what `control`, `observe` and `estimate` take without the core's call, in a run that nothing disturbs;
- window and guess: the core's `ctmhe_assemble` alone, on the request that the update left behind;
- model functions: how much longer the same update takes when each evaluation is made twice. A few lines of C stand
  between the core and the model, evaluate as often as they are told, and count. Results stay the same;
- the rest of the core: linear algebra, bounds, step lengths.

Parts of the core are differences between the fastest of `REPEATS` calls. All figures are medians over the updates.
"""

from __future__ import annotations

import argparse
import ctypes
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.problems import PROBLEMS, SCALING, Problem
from benchmarks.reference import build, grow
from ctmhe.compilers import Source, build_library
from ctmhe.types import Input, Measurement, Status

REPEATS = 15
MOST = 3  # evaluations in the place of one
FUNCTIONS = {"value": "model, values", "jacobian": "model, Jacobians", "curvature": "model, second derivatives"}
COUNTING = """
#include <string.h>
typedef int (*casadi)(const double **, double **, long long *, double *, int);
typedef void (*buffer)(void *);
typedef int (*batch)(const void *, int);
casadi function_NAME;
buffer eval_NAME;
batch batch_NAME;
int times_NAME = 1;
long long calls_NAME;
volatile long long nothing_NAME = 0;

int repeated_function_NAME(const double **arg, double **res, long long *iw, double *w, int mem) {
  const double *given[64];
  double *taken[64];
  long long shift = 0, bits;
  calls_NAME++;
  for (int i = 1; i < times_NAME; i++) {
    for (int j = 0; j < 9; j++) given[j] = arg[j] + shift; /* the function may do as it likes with both lists */
    for (int j = 0; j < 3; j++) taken[j] = res[j];
    if (function_NAME(given, taken, iw, w, mem)) return 1;
    memcpy(&bits, res[0], sizeof bits);
    shift = bits & nothing_NAME; /* zero, but the processor cannot begin the next evaluation before this one's end */
  }
  for (int j = 0; j < 9; j++) given[j] = arg[j] + shift;
  return function_NAME(given, res, iw, w, mem);
}

int repeated_batch_NAME(const void *calls, int lanes) {
  calls_NAME += lanes;
  for (int i = 1; i < times_NAME; i++)
    if (batch_NAME(calls, lanes)) return 1;
  return batch_NAME(calls, lanes);
}

void repeated_eval_NAME(void *self) {
  calls_NAME++;
  for (int i = 0; i < times_NAME; i++) eval_NAME(self);
}
"""


class Repeated:
    """A stage function of a core that is evaluated as often as it is told."""

    def __init__(self, structure: Any, name: str):
        text = COUNTING.replace("NAME", name)
        self.library = ctypes.CDLL(str(build_library(f"repeated-{name}", [Source(f"{name}.c", text)])))
        self.times = ctypes.c_int.in_dll(self.library, f"times_{name}")
        self.calls = ctypes.c_longlong.in_dll(self.library, f"calls_{name}")
        kind = next(kind for kind in ("batch", "function", "eval") if getattr(structure, kind))
        ctypes.c_void_p.in_dll(self.library, f"{kind}_{name}").value = getattr(structure, kind)
        wrapper = getattr(self.library, f"repeated_{kind}_{name}")
        setattr(structure, kind, ctypes.cast(wrapper, ctypes.c_void_p).value)


class RepeatedTape:
    """The same for a function on a tape: its instructions, written behind each other so often."""

    def __init__(self, structure: Any):
        size = 4 * structure.tape_length
        once = np.ctypeslib.as_array(ctypes.cast(structure.tape, ctypes.POINTER(ctypes.c_int32)), (size,))
        self.kept, self.length = np.tile(once, MOST), structure.tape_length
        structure.tape, self.structure, self.calls = self.kept.ctypes.data, structure, ctypes.c_longlong()

    @property
    def times(self) -> RepeatedTape:
        """What is told how often."""
        return self

    @property
    def value(self) -> int:
        """How often every evaluation is made."""
        return self.structure.tape_length // self.length

    @value.setter
    def value(self, times: int) -> None:
        self.structure.tape_length = times * self.length


def repeated(structure: Any, name: str) -> Repeated | RepeatedTape:
    """Take a stage function over; those on tapes cannot be counted."""
    return RepeatedTape(structure) if structure.tape else Repeated(structure, name)


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Return the seconds that a call takes, and its result."""
    began = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - began, result


def fastest(function: Callable[[], Any]) -> float:
    """Return the seconds of the fastest of several calls."""
    return min(timed(function)[0] for _ in range(REPEATS))


class Run:
    """A run of one problem, update by update, that knows how long the core's calls take."""

    def __init__(self, problem: Problem, options: dict[str, Any]):
        self.problem, self.mhe = problem, build(problem, **options)
        self.state, _ = grow(self.mhe, problem)
        if self.mhe._updates is None:
            raise SystemExit(f"{problem.name}: no core here, or none that covers this problem: nothing to profile")
        self.memory = self.mhe._updates._memory()
        self.core, self.seconds = self.memory.update, 0.0
        self.memory.update = self._timed  # type: ignore[assignment]

    def _timed(self) -> int:
        self.seconds, stop = timed(self.core)
        return stop

    def update(self, k: int) -> tuple[dict[str, float], Status]:
        """Move on to window k; return the seconds of control, observe, estimate and the core, and the status."""
        problem, mhe, seconds = self.problem, self.mhe, {}
        j, h = problem.count + k, problem.interval
        if len(problem.model.u):
            u = problem.u[j - 1]
            seconds["control"], self.state = timed(lambda: mhe.control(self.state, Input((j - 1) * h, u)))
        y = problem.y[j]
        seconds["observe"], self.state = timed(lambda: mhe.observe(self.state, Measurement(j * h, y)))
        whole, (self.state, estimate) = timed(lambda: mhe.estimate(self.state, j * h))
        assert mhe._updates is not None and mhe._updates._memory() is self.memory  # no window has outgrown the first
        return seconds | {"estimate": whole - self.seconds, "core": self.seconds}, estimate.status


def moving_on(problem: Problem, updates: int, options: dict[str, Any]) -> tuple[dict[str, float], list[Status]]:
    """Return the median seconds of Python's calls and of the core's in an undisturbed run, and the statuses."""
    run = Run(problem, options)
    rows, statuses = zip(*(run.update(k) for k in range(1, updates + 1)), strict=True)
    return {part: float(np.median([row[part] for row in rows])) for part in rows[0]}, list(statuses)


def inside(problem: Problem, updates: int, options: dict[str, Any]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the median seconds of parts of the core, and the mean numbers of evaluations."""
    run = Run(problem, options)
    stage = run.memory.functions.structure
    kinds = ("batch", "function", "eval", "tape")
    there = [name for name in FUNCTIONS if any(getattr(getattr(stage, name), kind) for kind in kinds)]
    functions = {FUNCTIONS[name]: repeated(getattr(stage, name), name) for name in there}
    rows, counts = [], []
    for k in range(1, updates + 1):
        for function in functions.values():
            function.calls.value = 0
        run.update(k)
        counts.append({part: function.calls.value for part, function in functions.items()})
        once = fastest(run.core)
        seconds = {"window and guess": fastest(run.memory.assemble)}
        for part, function in functions.items():
            function.times.value = 2
            never = isinstance(function, Repeated) and not counts[-1][part]
            seconds[part] = 0.0 if never else fastest(run.core) - once
            function.times.value = 1
        rows.append(seconds)
    median = {part: float(np.median([row[part] for row in rows])) for part in rows[0]}
    return median, {part: float(np.mean([row[part] for row in counts])) for part in counts[0]}


def profile(problem: Problem, updates: int, options: dict[str, Any]) -> None:
    """Print the shares of one problem."""
    seconds, statuses = moving_on(problem, updates, options)
    parts, calls = inside(problem, updates, options)
    whole, core = sum(seconds.values()), seconds.pop("core")
    rows = {f"Python: {part}": value for part, value in seconds.items()}
    rows |= {f"core: {part}": value for part, value in parts.items()}
    rows["core: linear algebra, bounds, steps"] = core - sum(parts.values())
    iterations, factorizations = (
        np.mean([getattr(status, name) for status in statuses]) for name in ("iterations", "factorizations")
    )
    numbers = f"{iterations:.1f} iterations, {factorizations:.1f} factorisations"
    print(f"\n{problem.name}: {1e6 * whole:.0f} us an update, {numbers}")
    print(f"  {'part':<40}{'share':>7}{'us':>9}{'calls':>8}")
    for part, value in rows.items():
        number = calls.get(part.removeprefix("core: "))
        print(f"  {part:<40}{value / whole:7.1%}{1e6 * value:9.1f}" + (f"{number:8.1f}" if number else ""))


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
