"""Write docs/benchmarks.md and its plots from a run's rows: `python -m benchmarks.report FILE.json [--docs DIR]`.

Beside the file, `starts.json`, `limits.json` and `fmus.json` give the sections of these benchmarks.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt

from benchmarks.peers import CONVERGED, ONE, TOOLS
from benchmarks.problems import PROBLEMS
from benchmarks.solvers import base_of, exponents

Rows = Sequence[dict[str, Any]]

INTRODUCTION = """# Benchmarks

How long one update of a moving horizon estimator takes, for this library and for tools that pip can install. This page
is generated: `python -m benchmarks.solvers --json FILE` measures, `python -m benchmarks.report FILE` writes.

Every tool solves the same problem: a window of N intervals, discretised with the same Runge-Kutta steps, the same
samples, discounted weights, prior and bounds, that moves on by one interval per update and starts from the last
solution. The tools take turns in one run on one thread. Per update the fastest of the repeats of the whole call from
Python counts; below are medians over the updates in milliseconds and, in brackets, how many times longer than ctmhe.
Look at the ratios: the milliseconds belong to a machine.

| problem | model | N | what is special |
|---|---|---|---|
| P1a | batch reactor, 2 states | 200 | one RK4 step an interval |
| P1b | the same | 20 | ten RK4 steps an interval |
| P1c | the same as P1a | 200 | an upper bound on one state is active in every update |
| P2 | quadrotor, 12 states and disturbances | 30 | boxes on angles and rates, rarely active |
| P2c | the same | 30 | boxes on two angles and a velocity, active in every update |
| P3 | Chua circuit, 3 states and a parameter | 150 | the parameter is estimated |
| vdp | stiff van der Pol oscillator | 30 | CVODES inside the stage function |
| tanks40 | 40 tanks in a row | 20 | 40 states and disturbances |

The tools: `ipopt` is CasADi's IPOPT with the exact Hessian as it is usually set up; `ipopt-warm` starts with a barrier
parameter of 1e-6 and the shifted multipliers; `fatrop` is CasADi's plugin; `sqp-hpipm` and `sqp-qrqp` are CasADi's
sqpmethod with the Gauss-Newton Hessian; `do-mpc` is its MHE class. `ctmhe` is timed with the model compiled and, "not
compiled", with the model's tape (for vdp, CasADi's CVODES) in the core that the package ships. Methods with a
tolerance, ours included, get the loosest (of powers of ten) that still gives the common cost in the first windows.
*Converged* means that a tool says so and that its cost agrees with the common one to 1e-6 in every window.
"""


def title(row: dict[str, Any]) -> str:
    """Return a tool's name with its kind of model functions."""
    if row["tool"] != "ctmhe":
        return row["tool"]
    return "ctmhe, compiled" if row["compiled"] else "ctmhe, not compiled"


def cell(row: dict[str, Any], base: float | None) -> str:
    """Return the median and the ratio, and how it failed where it did."""
    if row["median_ms"] is None:
        return "–"
    text = f"{row['median_ms']:.3g}" + (f" ({row['median_ms'] / base:.2g})" if base else "")
    return text if row["converged"] or row["mode"] == ONE else f"{text} ✗"


def medians(rows: Rows, mode: str) -> list[str]:
    """Return the lines of a table: tools down, problems across."""
    problems = [name for name in PROBLEMS if any(row["problem"] == name for row in rows)]
    lines = ["| tool | " + " | ".join(problems) + " |", "|---" * (len(problems) + 1) + "|"]
    for tool in TOOLS:
        for compiled in (True, False):
            cells, name = [], ""
            for problem in problems:
                here = [row for row in rows if row["problem"] == problem]
                mine = [r for r in here if (r["tool"], r["mode"], r["compiled"]) == (tool, mode, compiled)]
                base = base_of(here, mode) or base_of(here, CONVERGED)
                cells.append(cell(mine[0], base) if mine else "–")
                name = title(mine[0]) if mine else name
            if name and any(text != "–" for text in cells):
                lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def tails(rows: Rows) -> list[str]:
    """Return the 99th percentile over the median and the iterations of every converged tool."""
    lines = [
        "| problem | tool | 99th percentile / median | iterations | set-up and first solve, s |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        if row["median_ms"] and row["mode"] == CONVERGED and not row["family"]:
            tail = f"{row['p99_ms'] / row['median_ms']:.1f}"
            lines.append(
                f"| {row['problem']} | {title(row)} | {tail} | {row['iterations'] or 0:.1f} | {row['build_s']:.2g} |"
            )
    return lines


def failures(rows: Rows) -> list[str]:
    """Return what did not run or did not converge, and why."""
    seen: dict[str, list[str]] = {}
    for row in rows:
        if row["note"]:
            where = seen.setdefault(f"{title(row)}, {row['mode']}: {row['note']}", [])
            where.append(row["problem"])
    every = {row["problem"] for row in rows}
    return [
        f"- {text} ({'every problem' if every == set(where) else ', '.join(dict.fromkeys(where))})"
        for text, where in seen.items()
    ]


def bars(rows: Rows, path: Path) -> None:
    """Draw the converged medians of every problem, on a logarithmic scale."""
    problems = [name for name in PROBLEMS if any(row["problem"] == name for row in rows)]
    shown = [r for r in rows if r["median_ms"] and r["mode"] == CONVERGED and r["problem"] in problems]
    labels = list(
        dict.fromkeys(title(row) for row in sorted(shown, key=lambda r: (r["tool"] != "ctmhe", not r["compiled"])))
    )
    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    width = 0.8 / max(len(labels), 1)
    for i, label in enumerate(labels):
        mine = {row["problem"]: row["median_ms"] for row in shown if title(row) == label}
        place = [j + (i - len(labels) / 2 + 0.5) * width for j, name in enumerate(problems) if name in mine]
        axes.bar(place, [mine[name] for name in problems if name in mine], width, label=label)
    axes.set_yscale("log")
    axes.set_ylabel("median ms per update")
    axes.set_xticks(range(len(problems)), problems)
    axes.legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    axes.grid(axis="y", alpha=0.3)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def scaling(rows: Rows, path: Path) -> bool:
    """Draw the medians over N and over the number of states; return whether there was anything to draw."""
    families = [name for name in ("N", "nx") if any(row["family"] == name and row["median_ms"] for row in rows)]
    if not families:
        return False
    figure, every = plt.subplots(
        1, len(families), figsize=(4 * len(families), 3.4), layout="constrained", squeeze=False
    )
    for axes, family in zip(every[0], families, strict=True):
        mine = [r for r in rows if r["family"] == family and r["median_ms"] and r["mode"] == CONVERGED]
        for label in dict.fromkeys(title(row) for row in mine):
            points = sorted((row["size"], row["median_ms"]) for row in mine if title(row) == label)
            axes.loglog(*zip(*points, strict=True), marker="o", markersize=3, label=label)
        axes.set_xlabel("intervals N (Chua circuit)" if family == "N" else "states (tanks, N = 20)")
        axes.grid(alpha=0.3, which="both")
    every[0][0].set_ylabel("median ms per update")
    every[0][0].legend(fontsize=7, frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)
    return True


def ratios(rows: Rows) -> list[str]:
    """Return how many times faster than two peers, compiled and not; converged tools only."""
    lines = ["| problem | IPOPT warm | sqpmethod + qrqp | IPOPT warm, not compiled |", "|---|---|---|---|"]
    for problem in (name for name in PROBLEMS if any(row["problem"] == name for row in rows)):
        here = {
            (row["tool"], row["compiled"]): row["median_ms"]
            for row in rows
            if row["problem"] == problem and row["mode"] == CONVERGED and row["converged"]
        }
        pairs = ((True, "ipopt-warm"), (True, "sqp-qrqp"), (False, "ipopt-warm"))
        cells = [
            f"{here[tool, False] / here['ctmhe', compiled]:.1f}"
            if (tool, False) in here and ("ctmhe", compiled) in here
            else "–"
            for compiled, tool in pairs
        ]
        lines.append(f"| {problem} | " + " | ".join(cells) + " |")
    return lines


def starts(rows: Rows) -> list[str]:
    """Return the section on random starts."""
    lines = [
        "## Poor guesses", "",
        "Random starts within the bounds of every library model (`python -m benchmarks.starts`): how often IPOPT and",
        "Gauss-Newton end at the lowest cost that IPOPT finds at all. *Share*: of the starts from which IPOPT gets",
        "there, those from which Gauss-Newton does. *False*: success where IPOPT still gains more than 1e-8.", "",
        "| model | starts | IPOPT | Gauss-Newton | share | false | median iterations |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    return (
        lines
        + [
            f"| {row['model']} | {row['starts']} | {row['ipopt']:.1%} | {row['ours']:.1%} | {row['share']:.2%} | "
            f"{row['false']} | {row['iterations']:.0f} |"
            for row in rows
        ]
        + [""]
    )


def limits(rows: Rows) -> list[str]:
    """Return the section on start-up, jumps, endurance and memory."""
    lines = [
        "## Start-up, jumps, endurance, memory", "",
        "`python -m benchmarks.limits`, with what was asked for where something was.", "",
    ]  # fmt: skip
    return [*lines, *asked(rows), ""]


def fmus(rows: Rows) -> list[str]:
    """Return the section on FMUs in the place of Python models."""
    lines = [
        "## FMUs", "",
        "`python -m benchmarks.fmus`: one update with a Python model and with its FMU, taking turns. What is compiled",
        "or not is the core. *Calls alone*: the FMI calls of that update, repeated without anything around them.",
        "", *asked(rows),
    ]  # fmt: skip
    return [*lines, ""]


def asked(rows: Rows) -> list[str]:
    """Return the lines of a table of values and what was asked for."""
    lines = ["| part | problem | what | value | at most |", "|---|---|---|---|---|"]
    for row in rows:
        most = "" if row["target"] is None else f"{row['target']:g}"
        value = f"{row['value']:.3g}" if abs(row["value"]) < 1e5 else f"{row['value']:.0f}"
        lines.append(f"| {row['part']} | {row['problem']} | {row['what']} | {value} {row['unit']} | {most} |")
    return lines


def page(rows: Rows, docs: Path, beside: Path) -> Path:
    """Write the page and its plots below `docs`, with the rows of the other benchmarks that lie in a folder."""
    images = docs / "images"
    images.mkdir(parents=True, exist_ok=True)
    bars(rows, images / "benchmark_medians.png")
    machine = rows[0].get("machine", {})
    lines = [INTRODUCTION, "## Converged", "", *medians(rows, CONVERGED), "", "✗: not converged in every window.", ""]
    lines += ["How many times faster than these:", "", *ratios(rows), ""]
    lines += ["![medians](images/benchmark_medians.png)", "", "## One iteration an update", ""]
    lines += ["What such an iteration costs is no longer the optimum's; where it stays within 1e-6 is luck.", ""]
    lines += [*medians(rows, ONE), ""]
    if scaling(rows, images / "benchmark_scaling.png"):
        lines += ["## Scaling", "", "![scaling](images/benchmark_scaling.png)", ""]
        lines += [
            "Exponents fitted over the sizes (N from 200 on):",
            "",
            "| in | tool | mode | time per iteration | time per update |",
        ]
        lines += ["|---|---|---|---|---|"]
        lines += [
            f"| {fit['family']} | {title(fit)} | {fit['mode']} | {fit['per_iteration']:.2f} | {fit['per_update']:.2f} |"
            for fit in exponents(rows)
        ]
        lines += [""]
    for name, section in (("starts", starts), ("limits", limits), ("fmus", fmus)):
        if (beside / f"{name}.json").exists():
            lines += section(json.loads((beside / f"{name}.json").read_text()))
    lines += [
        "## Spread, iterations, set-up",
        "",
        *tails(rows),
        "",
        "## What did not run, and why",
        "",
        *failures(rows),
    ]
    lines += ["", "Machine: " + ", ".join(f"{key} {value}" for key, value in machine.items()) + ".", ""]
    path = docs / "benchmarks.md"
    path.write_text("\n".join(lines))
    return path


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the page from the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.report", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("rows", type=Path, help="JSON written by benchmarks.solvers")
    parser.add_argument("--docs", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args(arguments)
    print(page(json.loads(options.rows.read_text()), options.docs, options.rows.parent))


if __name__ == "__main__":
    main()
