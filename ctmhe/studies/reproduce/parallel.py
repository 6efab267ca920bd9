"""Seeds over processes, for cases that run each estimator on the same seeds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tqdm import tqdm

from ctmhe.errors import MissingExtra


def over_seeds(job: Callable[..., Any], seeds: int, workers: int, *, progress: bool = False, **options: Any) -> list:
    """Return `job(seed, **options)` for every seed, in order, on as many processes as there are workers."""
    jobs = tqdm(range(seeds), desc="seeds", disable=None if progress else True)
    if workers == 1:
        return [job(seed, **options) for seed in jobs]
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise MissingExtra("joblib", "study", "reproducing a case on several workers") from None

    return list(Parallel(workers)(delayed(job)(seed, **options) for seed in jobs))
