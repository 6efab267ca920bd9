"""Time every tool on every problem, interleaved in one run: `python -m benchmarks.solvers [--json FILE] [--quick]`.

The tools take turns at every update. Per update the minimum over the repeats counts, of the whole call from Python;
then the median and the 99th percentile over the updates. Methods with a tolerance (ours and SQP's) get the loosest that
gives the common cost. A tool has converged when it says so and its cost agrees with the reference's in every window.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers import AGREEMENT, CONVERGED, ONE, TOOLS, Tool, Unavailable, Update, make_tool
from benchmarks.problems import PROBLEMS, SCALING, Problem
from benchmarks.reference import Reference, refer

SLOW = {"vdp": 10, "tanks40": 30, "chua-N2000": 10, "chua-N5000": 5}  # updates, at most
SCALING_UPDATES = 20
SCALING_TOOLS = ("ctmhe", "ipopt-warm", "fatrop", "sqp-hpipm", "sqp-qrqp")


@dataclass
class Entry:
    """One tool in one mode on one problem, and what was measured of it."""

    tool: str
    mode: str
    compiled: bool
    run: Tool | None = None
    note: str = ""
    build: float = float("nan")
    spent: float = 0.0
    seconds: list[float] = field(default_factory=list)
    results: list[Update] = field(default_factory=list)


@contextmanager
def silence() -> Iterator[None]:
    """Send what libraries write to the terminal nowhere: some print whole matrices when they fail."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(i) for i in (1, 2)]
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        for i in (1, 2):
            os.dup2(sink, i)
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for i, old in zip((1, 2), kept, strict=True):
            os.dup2(old, i)
            os.close(old)
        os.close(sink)


def entries(tools: Sequence[str]) -> list[Entry]:
    """Return every combination of tool, mode and compilation that can exist."""
    result = []
    for tool in tools:
        modes = (CONVERGED, ONE) if tool == "ctmhe" or tool.startswith("sqp") else (CONVERGED,)
        for mode in modes:
            result += [Entry(tool, mode, compiled) for compiled in ((False, True) if tool == "ctmhe" else (False,))]
    return result


def prepare(entry: Entry, problem: Problem, reference: Reference) -> None:
    """Set a tool up and let it solve window 0, both untimed."""
    began = time.perf_counter()
    try:
        entry.run = make_tool(entry.tool, problem, reference, entry.mode, entry.compiled)
        entry.run.update(0)
    except Unavailable as reason:
        entry.run, entry.note = None, str(reason)
    except Exception as error:  # a tool that breaks is a result
        entry.run, entry.note = None, f"{type(error).__name__}: {str(error).strip().splitlines()[-1][:120]}"
    entry.build = time.perf_counter() - began


def measure(entry: Entry, k: int, limit: float) -> float:
    """Time window k once; drop the tool when it broke or has used up its seconds."""
    assert entry.run is not None
    began = time.perf_counter()
    try:
        result = entry.run.update(k)
    except Exception as error:
        entry.run, entry.note = None, f"broke at update {k}: {type(error).__name__}: {str(error).splitlines()[-1][:80]}"
        return float("inf")
    seconds = time.perf_counter() - began
    if len(entry.results) < k:
        entry.results.append(result)
    entry.spent += seconds
    if entry.spent > limit:
        entry.run, entry.note = None, f"stopped after {k} updates: {limit:g} s used up"
    return seconds


def race(problem: Problem, tools: Sequence[str], updates: int, repeats: int, limit: float) -> list[dict[str, Any]]:
    """Run all tools over one problem, one update after the other, and return their rows."""
    reference = refer(problem, updates)
    runners = entries(tools)
    for entry in runners:
        prepare(entry, problem, reference)
    gc.collect()
    gc.disable()
    try:
        for k in range(1, updates + 1):
            best: dict[int, float] = {}
            for i, entry in enumerate(runners):  # in turn; the repeats of one tool follow each other
                for repeat in range(repeats):
                    if entry.run is None or (repeat and best.get(i, 0.0) > 1.0):
                        continue
                    best[i] = min(best.get(i, float("inf")), measure(entry, k, limit))
            for i, seconds in best.items():
                if np.isfinite(seconds):
                    runners[i].seconds.append(seconds)
            if k % 10 == 0:
                gc.collect()
    finally:
        gc.enable()
    return [row_of(problem, reference, entry, updates) for entry in runners]


def row_of(problem: Problem, reference: Reference, entry: Entry, updates: int) -> dict[str, Any]:
    """Return the row of one tool; `cost` is the mean over the windows, `deviation` the largest relative one."""
    done = len(entry.results)
    costs = np.array([result.cost for result in entry.results])
    deviation = np.abs(costs / reference.costs[1 : done + 1] - 1) if done else np.empty(0)
    agrees = done == updates and bool((deviation < AGREEMENT).all())
    said = [result.converged for result in entry.results]
    milliseconds = 1e3 * np.array(entry.seconds)
    note = entry.note
    if done and entry.mode == CONVERGED and not note:
        if not all(said):
            note = f"no convergence in {said.count(False)} of {done} windows"
        elif not agrees:
            note = f"another cost in {int(np.sum(~(deviation < AGREEMENT)))} of {done} windows"
    return {
        "problem": problem.name,
        "tool": entry.tool,
        "mode": entry.mode,
        "compiled": entry.compiled,
        "median_ms": number(np.median(milliseconds)) if done else None,
        "p99_ms": number(np.percentile(milliseconds, 99)) if done else None,
        "cost": number(costs.mean()) if done else None,
        "converged": agrees and (entry.mode == ONE or all(said)),
        "deviation": number(deviation.max()) if done else None,
        "iterations": number(np.mean([result.iterations for result in entry.results])) if done else None,
        "updates": done,
        "active": number(np.mean(reference.active > 0)),
        "build_s": number(entry.build),
        "family": problem.family,
        "size": problem.size,
        "note": note,
    }


def number(value: Any) -> float | None:
    """Return a float for JSON, None where it is not finite."""
    return float(value) if np.isfinite(value) else None


def machine() -> dict[str, Any]:
    """Return what the times depend on."""
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    versions = {"python": platform.python_version(), "numpy": np.__version__}
    for package in ("ctmhe", "casadi", "do-mpc"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {"cpu": model, "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}", **versions}


def base_of(rows: Sequence[dict[str, Any]], mode: str) -> float | None:
    """Return the median of ctmhe in a mode, compiled where there is that."""
    ours = [row for row in rows if row["tool"] == "ctmhe" and row["mode"] == mode and row["median_ms"]]
    return min(ours, key=lambda row: not row["compiled"])["median_ms"] if ours else None


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the rows of one problem as text, with ratios to ctmhe in the same mode."""
    head = f"{'tool':<17} {'mode':<14} {'median ms':>10} {'p99 ms':>10} {'x ctmhe':>8} {'iter':>5} {'deviation':>10}"
    lines = [head]
    for row in rows:
        name = row["tool"] + (" compiled" if row["compiled"] else " VM" if row["tool"] == "ctmhe" else "")
        if row["median_ms"] is None:
            lines.append(f"{name:<17} {row['mode']:<14} {'-':>10}  {row['note']}")
            continue
        base = base_of(rows, row["mode"]) or base_of(rows, CONVERGED)
        ratio = f"{row['median_ms'] / base:8.2f}" if base else f"{'-':>8}"
        deviation = f"{row['deviation']:10.1e}" if row["deviation"] is not None else f"{'-':>10}"
        lines.append(
            f"{name:<17} {row['mode']:<14} {row['median_ms']:10.3f} {row['p99_ms']:10.3f} {ratio} "
            f"{row['iterations']:5.1f} {deviation}  {'' if row['converged'] else 'NOT CONVERGED '}{row['note']}"
        )
    return "\n".join(lines)


def exponents(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return, per family and tool, the exponent of the time per iteration in the size, fitted over all sizes."""
    result = []
    for family in ("N", "nx"):
        keys = {(row["tool"], row["mode"], row["compiled"]) for row in rows if row["family"] == family}
        for tool, mode, compiled in sorted(keys):
            points = [
                (row["size"], row["median_ms"] / max(row["iterations"], 1.0), row["median_ms"])
                for row in rows
                if (row["family"], row["tool"], row["mode"], row["compiled"]) == (family, tool, mode, compiled)
                and row["median_ms"] and row["iterations"] is not None and (family != "N" or row["size"] >= 200)
            ]  # fmt: skip
            if len(points) < 2:
                continue
            size, each, whole = np.log(np.array(points)).T
            result.append(
                {
                    "family": family, "tool": tool, "mode": mode, "compiled": compiled,
                    "per_iteration": float(np.polyfit(size, each, 1)[0]),
                    "per_update": float(np.polyfit(size, whole, 1)[0]),
                    "sizes": [int(np.exp(value) + 0.5) for value in size],
                }
            )  # fmt: skip
    return result


def main(arguments: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Run the benchmark from the command line and return its rows."""
    every = {**PROBLEMS, **SCALING}
    parser = argparse.ArgumentParser(prog="python -m benchmarks.solvers", description="Time ctmhe against its peers.")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--problems", nargs="+", choices=[*every, "scaling"], default=[*PROBLEMS, "scaling"])
    parser.add_argument("--tools", nargs="+", choices=TOOLS, default=list(TOOLS))
    parser.add_argument("--updates", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--limit", type=float, default=60.0, help="seconds a tool may use on one problem")
    parser.add_argument("--quick", action="store_true", help="5 updates, one repeat, no scaling")
    options = parser.parse_args(arguments)
    names = [name for given in options.problems for name in (SCALING if given == "scaling" else [given])]
    updates, repeats = options.updates, options.repeats
    if options.quick:
        updates, repeats = min(updates, 5), 1
        names = [name for name in names if name not in SCALING]
    rows: list[dict[str, Any]] = []
    computer = machine()
    print(", ".join(f"{key} {value}" for key, value in computer.items()))
    for name in names:
        count = min(updates, SLOW.get(name, updates), SCALING_UPDATES if name in SCALING else updates)
        problem = every[name](count)
        tools = [tool for tool in options.tools if name not in SCALING or tool in SCALING_TOOLS]
        with silence():
            new = race(problem, tools, count, repeats, options.limit)
        rows += [row | {"machine": computer} for row in new]
        share = new[0]["active"] if new else 0.0
        print(f"\n{name}: {count} updates, {repeats} repeats, bounds active in {share:.0%} of the windows", flush=True)
        print(table(new), flush=True)
        if options.json:
            options.json.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    for fit in exponents(rows):
        kind = f"{fit['tool']}{' compiled' if fit['compiled'] else ''}, {fit['mode']}"
        print(
            f"{fit['family']}: {kind}: time per iteration ~ size^{fit['per_iteration']:.2f}, "
            f"per update ~ size^{fit['per_update']:.2f} over {fit['sizes']}"
        )
    return rows


if __name__ == "__main__":
    main()
