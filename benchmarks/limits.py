"""What must stay small: first updates, jumps, a million updates, the core's memory.

    python -m benchmarks.limits [--json FILE] [--updates 1000000] [--problems ...] [startup jump endurance memory]

    startup     in fresh processes with an empty cache: seconds from the construction of `MHE`, imports done, to the
                end of the first estimate, with the model not compiled; seconds of compiling; and the first again, with
                what was compiled. Each the median of `PROCESSES`, compiling once
    jump        one window reached in one jump of many intervals, as after an event, and by moving on by one interval:
                the estimates' median times
    endurance   resident memory, rebuilds and times over very many updates of irregular samples in one process
    memory      bytes of the core for windows of up to N slots

A row is {part, problem, what, value, unit, target}; the target is the largest value that was asked for, or null.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import resource
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from tqdm import tqdm

from benchmarks.problems import PROBLEMS
from benchmarks.reference import build, grow, observe
from ctmhe import MHE, RK4, DiscountedCost, Measurement, Outcome
from ctmhe.compilers import cache_directory
from ctmhe.models.library import batch_reactor
from ctmhe.types import Array

Row = dict[str, Any]

JUMPS = {"P1a": 20, "P2": 5, "P3": 20}  # intervals
REPEATS = 3
PROCESSES = 3
SLOTS = (50, 200, 1000, 5000)
SETTLED = 1000  # updates after which memory counts
POINTS = 20  # readings of it


def row(part: str, problem: str, what: str, value: float, unit: str, target: float | None = None) -> Row:
    """Return one result."""
    return {"part": part, "problem": problem, "what": what, "value": float(value), "unit": unit, "target": target}


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a function returns in a fresh process that has made its imports."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def begin(name: str, compile: str) -> tuple[float, float, float]:
    """Return the seconds of construction and of the first update, and the processor's seconds in compilers."""
    problem = PROBLEMS[name](1)
    start = time.perf_counter()
    mhe = build(problem, compile=compile)
    built = time.perf_counter()
    state = mhe.init(x=problem.x_guess, p=problem.p_guess if len(problem.p_guess) else None)
    _, estimate = mhe.estimate(observe(mhe, state, problem, 1), problem.interval)
    end = time.perf_counter()
    assert estimate.status.success, estimate.status
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return built - start, end - built, children.ru_utime + children.ru_stime


def compilers() -> dict[str, tuple[str, float]]:
    """Return name -> (`$CC`, seconds it may take) of those that are here."""
    found = {}
    if shutil.which("gcc"):
        found["gcc"] = ("gcc", 6.0)
    if find_spec("ziglang"):
        found["zig"] = (f"{shlex.quote(sys.executable)} -m ziglang cc", 15.0)
    return found


def startup(problems: Sequence[str], compile: str) -> Iterator[Row]:
    """Yield the seconds to the first estimate."""
    for name in problems:
        with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, CTMHE_CACHE=folder):
            yield from first(name, "off", "not compiled")
        for kind, (command, target) in compilers().items() if compile == "auto" else ():
            with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, CC=command):
                os.environ |= {"CTMHE_CACHE": f"{folder}/ctmhe", "ZIG_GLOBAL_CACHE_DIR": f"{folder}/zig"}
                seconds, _, busy = apart(begin, name, "auto")
                yield row("startup", name, f"{kind}: construction that compiles", seconds, "s", target)
                yield row("startup", name, f"{kind}: of the processor, in compilers", busy, "s")
                yield from first(name, "auto", f"{kind}, from the cache")


def first(name: str, compile: str, kind: str) -> Iterator[Row]:
    """Yield the rows of a construction that compiles nothing."""
    seconds = np.array([apart(begin, name, compile)[:2] for _ in range(PROCESSES)])
    yield row("startup", name, f"{kind}: construction", np.median(seconds[:, 0]), "s")
    yield row("startup", name, f"{kind}: first update", np.median(seconds[:, 1]), "s")
    yield row("startup", name, f"{kind}: both", np.median(seconds.sum(axis=1)), "s", 0.2)


def jump(problems: Sequence[str], compile: str, updates: int) -> Iterator[Row]:
    """Yield the times of the same windows, reached in one jump and from one interval before."""
    for name in (name for name in problems if name in JUMPS):
        intervals = JUMPS[name]
        problem = PROBLEMS[name](intervals * updates)
        mhe, h = build(problem, compile=compile), problem.interval
        walked = jumped = grow(mhe, problem)[0]
        times, iterations = np.empty((updates, 2)), np.empty((updates, 2))
        for k in tqdm(range(updates), f"jump {name}", leave=False):
            samples = range(problem.count + k * intervals + 1, problem.count + (k + 1) * intervals + 1)
            for j in samples:
                walked, jumped = (observe(mhe, state, problem, j) for state in (walked, jumped))
                if j != samples[-1]:
                    walked, _ = mhe.estimate(walked, j * h)
            results = []
            for i, state in enumerate((walked, jumped)):
                runs = [mhe.estimate(state, samples[-1] * h) for _ in range(REPEATS)]
                assert runs[0][1].status.success, runs[0][1].status
                times[k, i] = min(estimate.seconds for _, estimate in runs)
                iterations[k, i] = runs[0][1].status.iterations
                results.append(runs[0][0])
            walked, jumped = results
        one, many = 1e3 * np.median(times, axis=0)
        yield row("jump", name, "by one interval", one, "ms")
        yield row("jump", name, f"by {intervals} intervals", many, "ms")
        yield row("jump", name, "ratio", many / one, "", 2.0)
        yield row("jump", name, "iterations, by one interval", iterations[:, 0].mean(), "")
        yield row("jump", name, f"iterations, by {intervals} intervals", iterations[:, 1].mean(), "")


def reactor(compile: str) -> MHE:
    """Return an estimator of the batch reactor whose window has about 25 slots."""
    model = batch_reactor(noise=False)
    cost = DiscountedCost(eta=0.4, P=1.0, Q=1e2, R_point=1e2)
    settings: dict[str, Any] = {"horizon": 1.5, "interval": 0.1, "integrator": RK4(0.1), "hold": "point"}
    return MHE(model, cost=cost, bounds=model.bounds, compile=compile, **settings)


def samples(mhe: MHE, count: int = 1000) -> tuple[Array, Array, Array, float]:
    """Return irregular times (count,) and noisy samples (count, 1) of one period of a disturbed reactor.

    Also returns the state at the period's start and its length in seconds. The disturbance has mean zero and returns
    after the period; so does the reactor, which has been left to settle for a few of them.
    """
    rng = np.random.default_rng(20250101)
    gaps = 0.04 + rng.exponential(0.1, count)
    gaps *= 0.14 * count / gaps.sum()
    times, nothing, x = np.cumsum(gaps), np.empty(0), np.array([1.5, 2.0])
    period = float(times[-1])
    edges, y = np.concatenate([[0.0], times]), np.empty((count, 1))
    for _ in range(3):
        start = x
        for i in range(count):
            t, h = edges[i], edges[i + 1] - edges[i]
            w = 0.2 * np.sin(2 * np.pi * (t + h / 2) / period * np.array([20, 31]))
            parts = mhe.integrator.parts(float(h))
            for j in range(parts):
                x, _ = mhe.stage.step(t + j * h / parts, h / parts, x, w, nothing, nothing, nothing)
            y[i] = x.sum()
    return times, y + 0.02 * rng.normal(size=y.shape), start, period


def resident() -> int:
    """Return this process's resident memory in bytes; the largest so far where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def reading(update: int) -> tuple[int, int, int, int]:
    """Return an update's number, and this process's resident bytes, Python objects and libraries compiled by then."""
    gc.collect()
    folder = cache_directory()
    return update, resident(), len(gc.get_objects()), len(list(folder.glob("*.json"))) if folder else 0


def endure(updates: int, compile: str) -> list[Row]:
    """Return the rows of one long run."""
    mhe = reactor(compile)
    times, y, x, period = samples(mhe)
    state, settled = mhe.init(x=x), min(SETTLED, max(updates // POINTS, 1))
    stops = {settled, *(k for k in (updates * (i + 1) // POINTS for i in range(POINTS)) if k > settled)}
    readings, seconds, slots, bad, moved, memory = [reading(0)], [], 0, 0, 0, None
    began, spent = time.perf_counter(), 0.0
    for k in tqdm(range(1, updates + 1), "endurance", mininterval=2.0):
        laps, i = divmod(k - 1, len(times))
        t = laps * period + float(times[i])
        state = mhe.observe(state, Measurement(t, y[i]))
        state, estimate = mhe.estimate(state, t)
        bad += estimate.status.outcome is not Outcome.SOLVED
        slots += state.window.n if state.window is not None else 0
        if mhe._updates is not None:
            moved += memory is not None and memory is not mhe._updates._memory()
            memory = mhe._updates._memory()
        if k in stops:
            spent += time.perf_counter() - began
            seconds.append((k, spent))
            readings.append(reading(k))
            began = time.perf_counter()
    compiled = readings[-1][3] - readings[0][3]
    at, size, objects, _ = np.array(readings[1:], float).T
    slope = np.polyfit(at, size, 1)[0] if len(at) > 1 else 0.0
    edges = np.array([0.0, 0.1, 0.9, 1.0]) * updates
    tenths = 1e7 / updates * np.diff(np.interp(edges, *np.array([(0, 0.0), *seconds]).T))
    kind = "reactor"
    shown = [*range(0, len(at) - 1, POINTS // 5), -1]
    return [
        row("endurance", kind, "updates", updates, ""),
        row("endurance", kind, "slots of a window, mean", slots / updates, ""),
        row("endurance", kind, "updates not solved by the first rung", bad, ""),
        *(row("endurance", kind, f"resident after {at[i]:.0f} updates", size[i] / 2**20, "MiB") for i in shown),
        row("endurance", kind, "resident, slope", slope, "bytes an update", 1.0),
        row("endurance", kind, "Python objects, growth", objects[-1] - objects[0], "", 0.0),
        row("endurance", kind, "libraries compiled during the run", compiled, "", 0.0),
        row("endurance", kind, "IPOPT programs built", mhe._reference.built, "", 0.0),
        row("endurance", kind, "the core's memory, allocated anew", moved, "", 0.0),
        row("endurance", kind, "time in the first tenth", tenths[0], "us an update"),
        row("endurance", kind, "time in the last tenth", tenths[2], "us an update"),
    ]


def endurance(updates: int, compile: str) -> Iterator[Row]:
    """Yield the rows of the long run, which has a process and a cache of its own."""
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ, CTMHE_CACHE=folder):
        yield from apart(endure, updates, compile)


def memory(problems: Sequence[str]) -> Iterator[Row]:
    """Yield what the core needs for windows of N slots, and how that grows with N."""
    for name in problems:
        problem = PROBLEMS[name](1)
        mhe = build(problem, compile="off")
        if mhe._updates is None:
            raise SystemExit(f"{name}: no core here, or none that covers this problem: nothing to measure")
        room = mhe._updates._memory()
        size, stage = mhe._updates.solver.core.ctmhe_update_size, ctypes.addressof(room.functions.structure)
        sizes = np.array([size(stage, n) for n in SLOTS], float)
        own = size(stage, problem.count) / 1024
        yield row("memory", name, f"scratch for its own {problem.count} slots", own, "KiB")
        for n, value in zip(SLOTS, sizes, strict=True):
            yield row("memory", name, f"scratch a slot, N = {n}", value / n, "bytes")
        slope = np.polyfit(np.log(SLOTS), np.log(sizes), 1)[0]
        yield row("memory", name, "exponent in N", slope, "", 1.15)


def line(result: Row) -> str:
    """Return one line of the printed table."""
    target, value = result["target"], result["value"]
    judged = "" if target is None else f"at most {target:g}: {'met' if value <= target else 'MISSED'}"
    return f"{result['problem']:<10}{result['what']:<44}{value:>14.6g} {result['unit']:<16}{judged}".rstrip()


def collected(parts: dict[str, Callable[[], Iterator[Row]]], path: Path | None) -> list[Row]:
    """Run parts of a benchmark, print each row when it is there and rewrite the file with those so far."""
    rows: list[Row] = []
    for title, run in parts.items():
        print(f"\n{title}", flush=True)
        for result in run():
            rows.append(result)
            print(line(result), flush=True)
            if path:
                path.write_text("[\n" + ",\n".join(json.dumps(each) for each in rows) + "\n]\n")
    return rows


def main(arguments: Sequence[str] | None = None) -> list[Row]:
    """Run the benchmark from the command line and return its rows."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.limits", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = ("startup", "jump", "endurance", "memory")
    parser.add_argument("parts", nargs="*", metavar="PARTS", help=f"of {', '.join(parts)}; all when left out")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--updates", type=int, default=1_000_000, help="of the endurance run")
    parser.add_argument("--jumps", type=int, default=40, help="for every problem")
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=["P1a", "P2", "P3", "tanks40"])
    parser.add_argument("--compile", choices=["auto", "off"], default="auto")
    options = parser.parse_args(arguments)
    unknown = set(options.parts) - set(parts)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; choose from {', '.join(parts)}")
    run = {
        "startup": lambda: startup(options.problems, options.compile),
        "jump": lambda: jump(options.problems, options.compile, options.jumps),
        "endurance": lambda: endurance(options.updates, options.compile),
        "memory": lambda: memory(options.problems),
    }
    return collected({part: run[part] for part in options.parts or parts}, options.json)


if __name__ == "__main__":
    main()
