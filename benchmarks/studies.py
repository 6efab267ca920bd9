"""A study of many reactor runs: serial and on two workers, their memory, and what SIGKILL does to its table.

python -m benchmarks.studies [--runs 1000] [--kills 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from ctmhe.studies.metrics import TIMINGS
from ctmhe.studies.reproduce.reactor import run_reactor
from ctmhe.studies.results import StudyResult
from ctmhe.studies.study import Study
from ctmhe.triggers import LinearGaps, Periodic

POLICIES = {"equidistant": Periodic(0.1, start=0.1), "dense first": LinearGaps(0.01, 0.19, 50)}


def study(runs: int, folder: Path) -> Study:
    """Return the study: T = 2 s, 50 samples in 5 s, the whole signal."""
    return Study(run_reactor, {"policy": POLICIES}, runs // len(POLICIES), folder=folder)


def memory_of_workers(seconds: float = 1.0) -> tuple[list[tuple[float, int, float]], threading.Event]:
    """Record (time, process, MB) of this process's children until the event is set."""
    import psutil

    rows: list[tuple[float, int, float]] = []
    done = threading.Event()

    def watch() -> None:
        while not done.wait(seconds):
            for child in psutil.Process().children():
                try:
                    if "resource_tracker" not in " ".join(child.cmdline()):
                        rows.append((time.perf_counter(), child.pid, child.memory_info().rss / 1e6))
                except psutil.Error:
                    continue

    threading.Thread(target=watch, daemon=True).start()
    return rows, done


def timed(runs: int, folder: Path, workers: int) -> tuple[float, StudyResult]:
    """Run the study; return seconds and its result."""
    began = time.perf_counter()
    result = study(runs, folder).run(workers=workers)
    return time.perf_counter() - began, result


def killed(runs: int, folder: Path, kills: int, seconds: float) -> tuple[int, StudyResult]:
    """Kill the study's process with SIGKILL `kills` times at random moments, then let it finish here."""
    moments = random.Random(0)
    struck = 0
    for _ in range(kills):
        command = [sys.executable, "-m", "benchmarks.studies", "--runs", str(runs), "--child", str(folder)]
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
        time.sleep(4.0 + moments.uniform(0.0, seconds / kills))
        if child.poll() is None:
            os.kill(child.pid, signal.SIGKILL)
            struck += 1
        child.wait()
        time.sleep(2.5)  # its workers see that they are alone
    return struck, study(runs, folder).run(workers=2)


def differences(one: StudyResult, other: StudyResult) -> list[str]:
    """Return the columns that differ, bit for bit, those of times left out."""
    left, right = one.table, other.table
    return [name for name in left.columns if name not in TIMINGS and not left[name].equals(right[name])]


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", type=Path)
    given = parser.parse_args()
    if given.child:
        study(given.runs, given.child).run(workers=2)
        return
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        rows, done = memory_of_workers()
        two, parallel = timed(given.runs, folder / "two", 2)
        done.set()
        one, serial = timed(given.runs, folder / "one", 1)
        strikes, resumed = killed(given.runs, folder / "killed", given.kills, 0.5 * two)
    t, megabytes = np.array([row[0] for row in rows]), np.array([row[2] for row in rows])
    share = (t - t[0]) / (t[-1] - t[0])
    found: dict[str, Any] = {
        "runs": len(serial.table),
        "failed": len(serial.failed) + len(parallel.failed) + len(resumed.failed),
        "serial_s": one,
        "two_workers_s": two,
        "two_workers_over_half_serial": two / (one / 2),
        "worker_mb_by_fifth": [float(megabytes[(share >= k / 5) & (share <= (k + 1) / 5)].max()) for k in range(5)],
        "worker_processes": len({row[1] for row in rows}),
        "kills": strikes,
        "columns_that_differ": {
            "two workers": differences(serial, parallel),
            "killed and resumed": differences(serial, resumed),
        },
    }
    print(json.dumps(found, indent=2))
    if given.json:
        given.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
