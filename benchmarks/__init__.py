"""Timings of ctmhe and its peers on problems that every tool is given alike.

python -m benchmarks.solvers --json results.json    every tool on every problem
python -m benchmarks.profile_update                 where one update of ctmhe spends its time
python -m benchmarks.limits --json limits.json      first updates, jumps, a million updates, the core's memory
python -m benchmarks.report results.json            docs/benchmarks.md and its plots
"""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # one thread for every tool
    os.environ.setdefault(_name, "1")
