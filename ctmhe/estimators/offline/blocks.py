"""A long record in overlapping blocks: where they lie, what is kept of each, and how they are computed side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ctmhe.errors import InputError, MissingExtra
from ctmhe.types import Array, positive

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Block:
    """A truncated problem over [start, stop], of whose solution (keep_from, keep_to] is kept.

    The first block also keeps its start. Seconds, or steps of a linear problem.
    """

    start: float
    stop: float
    keep_from: float
    keep_to: float
    first: bool = False

    def keeps(self, t: Array) -> Array:
        """Return which of the times `t` are kept from this block."""
        return (t <= self.keep_to) & ((t >= self.start) if self.first else (t > self.keep_from))


def blocks_of(start: float, end: float, block: float, keep: float) -> list[Block]:
    """Return the blocks of the approximate estimator (6.77) with Remark 6.12.

    Blocks of length `block` follow each other at distance `keep`; of each the middle is kept, of the first and the last
    also the ends of the record. With N steps in a block and 2 Delta + 1 samples kept, T = N + (k + 1)(2 Delta + 1)
    needs k + 2 blocks; where T is no such number the last block is moved to the left, so that it ends with the record.

    Parameters
    ----------
    start, end : float
        Of the record.
    block, keep : float
        N and 2 Delta + 1, in the unit of `start`.

    Raises
    ------
    InputError
        For lengths that are not positive, or when more than a whole block is to be kept.
    """
    block, keep = positive("block", block), positive("keep", keep)
    slack = 1e-9 * keep
    if keep > block + slack:
        raise InputError(
            f"keep = {keep:g} is longer than block = {block:g}: between the blocks' middles something would be "
            "missing; keep at most the block, and clearly less, so that both arcs are dropped"
        )
    if block >= end - start - slack:
        return [Block(start, end, start, end, True)]
    count = int(np.ceil((end - start - block - slack) / keep)) + 1
    starts = [min(start + i * keep, end - block) for i in range(count)]
    edges = [start, *(begin + (block + keep) / 2 for begin in starts[:-1]), end]
    return [
        Block(begin, begin + block if i < count - 1 else end, edges[i], edges[i + 1], i == 0)
        for i, begin in enumerate(starts)
    ]


def in_parallel(tasks: Sequence[Callable[[], Any]], *, workers: int = 1, executor: Any = None) -> list[Any]:
    """Return what the tasks return, in order; in place of a result the exception that a task raised.

    Parameters
    ----------
    tasks : sequence of callables without arguments
        They can be pickled when there are several workers.
    workers : int
        1: in this process; more: that many of joblib's processes, one BLAS thread each. When one dies, what was not
        finished is done again, task by task, so that only the one that kills its process is lost.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        In place of our own processes: anything with `submit`.
    """
    if executor is not None:
        return [_result(future) for future in [executor.submit(task) for task in tasks]]
    if workers == 1 or not tasks:
        return [_attempt(task) for task in tasks]
    results = _submitted(tasks, workers)
    for i, result in enumerate(results):
        if isinstance(result, BrokenExecutor):
            results[i] = _submitted(tasks[i : i + 1], 1)[0]
    return results


def _attempt(task: Callable[[], Any]) -> Any:
    try:
        return task()
    except Exception as error:
        return error


def _submitted(tasks: Sequence[Callable[[], Any]], workers: int) -> list[Any]:
    try:
        from joblib.externals.loky import get_reusable_executor
    except ImportError:
        raise MissingExtra("joblib", "study", "estimating on several workers") from None
    pool = get_reusable_executor(max_workers=workers, timeout=60, env=ONE_THREAD)
    futures: list[Any] = []
    for task in tasks:
        try:
            futures.append(pool.submit(task))
        except BrokenExecutor as error:
            futures.append(error)
    return [future if isinstance(future, BrokenExecutor) else _result(future) for future in futures]


def _result(future: Any) -> Any:
    try:
        return future.result()
    except Exception as error:
        return error
