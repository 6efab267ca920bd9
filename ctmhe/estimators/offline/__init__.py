"""Whole records: nonlinear ones as one problem or in blocks, large linear ones on matrices, and their benchmark."""

from ctmhe.estimators.offline.benchmark import (
    Benchmark,
    Regret,
    infinite_horizon,
    performance,
    rebuilt_disturbance,
    regret,
)
from ctmhe.estimators.offline.linear import (
    LinearProblem,
    Smoothed,
    rauch_tung_striebel,
    solve_blocks,
    solve_linear,
)
from ctmhe.estimators.offline.nonlinear import BlockReport, OfflineEstimate, estimate_offline

__all__ = [
    "Benchmark",
    "BlockReport",
    "LinearProblem",
    "OfflineEstimate",
    "Regret",
    "Smoothed",
    "estimate_offline",
    "infinite_horizon",
    "performance",
    "rauch_tung_striebel",
    "rebuilt_disturbance",
    "regret",
    "solve_blocks",
    "solve_linear",
]
