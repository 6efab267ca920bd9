"""Offline estimation: a whole record at once, as one problem or in overlapping blocks (thesis 6.3.4, (6.77))."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from ctmhe.data.log import MeasurementLog
from ctmhe.errors import InputError, MissingExtra
from ctmhe.estimators.guesses import shifted_guess
from ctmhe.estimators.mhe import MHE
from ctmhe.estimators.offline.blocks import Block, blocks_of, in_parallel
from ctmhe.estimators.trajectories import trajectory_at
from ctmhe.transcription.assembly import Records
from ctmhe.transcription.problem import Guess, Window
from ctmhe.types import Array, Outcome, Status, Trajectory, frozen


@dataclass(frozen=True, eq=False)
class BlockReport:
    """How one block came out.

    Attributes
    ----------
    start, stop : float
        What the block saw, seconds.
    keep_from, keep_to : float
        What is used of it.
    cost : float
    seconds : float
        Wall-clock time of the solve.
    status : Status
        `status.success` is False where the block failed.
    failed : str
        Why there are no numbers; empty where there are.
    """

    start: float
    stop: float
    keep_from: float
    keep_to: float
    cost: float
    seconds: float
    status: Status
    failed: str = ""


@dataclass(frozen=True, eq=False)
class OfflineEstimate:
    """The estimated states of a whole record.

    Attributes
    ----------
    t : array (n,)
        The times that were asked for, or the nodes of the blocks, seconds.
    x : array (n, nx)
        NaN where a block failed.
    blocks : tuple of BlockReport
    trajectory : Trajectory or None
        The solution with its disturbance, where there is one block that has not failed.
    p : array (np,)
        Parameters: estimated in the full problem, the known values in blocks.
    """

    t: Array
    x: Array
    blocks: tuple[BlockReport, ...]
    trajectory: Trajectory | None
    p: Array

    @property
    def success(self) -> bool:
        """Whether every block met its optimality conditions."""
        return all(block.status.success for block in self.blocks)

    @property
    def failures(self) -> tuple[BlockReport, ...]:
        """The blocks that did not."""
        return tuple(block for block in self.blocks if not block.status.success)

    def __str__(self) -> str:
        count = len(self.blocks)
        told = [f"offline estimate over [{self.t[0]:g}, {self.t[-1]:g}] s in {count} block{'s' * (count > 1)}"]
        told += [
            f"  block [{block.start:g}, {block.stop:g}] s: {block.failed or block.status}" for block in self.failures
        ]
        return "\n".join(told)


def estimate_offline(
    mhe: MHE,
    log: MeasurementLog,
    *,
    guess: Any,
    p: Any = None,
    block: float | None = None,
    keep: float | None = None,
    times: Any = None,
    workers: int = 1,
    executor: Any = None,
) -> OfflineEstimate:
    """Estimate the states of a whole record: all data known, past and future.

    Without `block` the full problem (6.4) is solved, with the estimator's cost, bounds and transcription over one
    window; its horizon plays no part. With `block` it is approximated by overlapping blocks that know nothing of each
    other (6.77), of each of which the middle is kept (Remark 6.12): what is left out are the arcs at the ends, where a
    solution that does not see the neighbouring data is off.

    The prior P counts at the record's start only: in the full problem, and in the first block. P = 0 is (6.4).

    Parameters
    ----------
    mhe : MHE
        Without discount: offline, all data count alike.
    log : MeasurementLog
        Columns are matched with the model's outputs and inputs by name; an output without a column is missing.
    guess : array (nx,) or mapping, or callable t -> array (nx,)
        Where solvers start, and the mean of the prior. A state is carried forward from the start of each block; a
        function gives states at all times, such as another estimate's.
    p : array (np,) or mapping, optional
        Initial (or known) parameters.
    block : float, optional
        Length of a block, seconds: N steps in the source.
    keep : float, optional
        How much is kept of a block, seconds: 2 Delta + 1 steps in the source; half of the block when left out.
    times : array (n,), optional
        Where states are wanted, seconds; at the nodes of the blocks when left out.
    workers : int
        Processes for the blocks (joblib).
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        In place of our own processes.

    Returns
    -------
    OfflineEstimate
        A block that failed, or whose process died, is reported; its states are NaN and all others are there.

    Raises
    ------
    InputError
        For a discounted cost, a log that lacks inputs, lengths that do not fit, times outside the record, or blocks of
        a model whose parameters are estimated: they are constant over the record, which only the full problem knows.

    Source: thesis, Section 6.3.4. The blocks of irregular samples are ours: the formula counts steps, here seconds.
    """
    records = records_of(mhe, log)
    start, end = float(log.t[0]), float(log.t[-1])
    if mhe.cost.eta != 1.0:
        raise InputError(
            f"estimate_offline: the cost fades by eta = {mhe.cost.eta:g}; offline all data count alike: use eta = 1"
        )
    if block is None and keep is not None:
        raise InputError(f"estimate_offline: keep = {keep!r} without block; give the length of a block")
    blocks = blocks_of(start, end, end - start, end - start)
    if block is not None:
        blocks = blocks_of(start, end, block, block / 2 if keep is None else keep)
    if len(blocks) > 1 and mhe.assembly.p_estimated:
        raise InputError(
            f"estimate_offline: the parameters {', '.join(mhe.model.p.names)} are estimated, and constant over the "
            "record: blocks would find one value each. Solve the full problem, or fix them (P over states only)"
        )
    wanted = None if times is None else np.atleast_1d(np.asarray(times, float))
    slack = 1e-9 * mhe.interval
    if wanted is not None and not (wanted[0] >= start - slack and wanted[-1] <= end + slack):
        raise InputError(f"estimate_offline: times must lie in the record, [{start:g}, {end:g}] s")
    first = guess(start) if callable(guess) else guess
    initial = mhe.init(t=start, x=first, p=p)
    content = pickle.dumps(mhe) if workers > 1 or executor is not None else None
    tasks = [
        partial(
            _solve_block, content or mhe, _seen(mhe, records, part), part, _starting(guess, part, initial.x), initial.p
        )
        for part in blocks
    ]
    if content is not None:
        tasks = _packed(tasks)
    return _joined(mhe, blocks, in_parallel(tasks, workers=workers, executor=executor), wanted, initial.p)


def records_of(mhe: MHE, log: MeasurementLog) -> Records:
    """Return the rows of a log in the order of the model's signals."""
    model = mhe.model
    known = [name for name in log.outputs if name in model.y.names]
    if not known:
        raise InputError(
            f"the log has outputs {', '.join(log.outputs)}, the model {', '.join(model.y.names)}: name the log's "
            "columns like the model's outputs"
        )
    missing = [name for name in model.u.names if name not in log.inputs]
    if missing:
        raise InputError(f"the log has no column for input {', '.join(missing)}, which the model needs")
    y = np.full((len(log), len(model.y)), np.nan)
    for name in known:
        y[:, model.y.index(name)] = log.y[:, log.outputs.index(name)]
    u = log.u[:, [log.inputs.index(name) for name in model.u.names]]
    if not len(model.u):
        return Records(log.t, y, log.t[:0], u[:0])
    if mhe.assembly.input_linear:
        return Records(log.t, y, log.t, u)
    switched = np.concatenate([[True], (np.diff(u, axis=0) != 0).any(axis=1)])  # each row kept is a node of the mesh
    return Records(log.t, y, log.t[switched], u[switched])


def _seen(mhe: MHE, records: Records, block: Block) -> Records:
    """Return the rows that matter in a block."""
    slack = 1e-6 * mhe.interval
    first = int(np.searchsorted(records.y_times, block.start - mhe.hold_limit - slack))
    first_u = max(int(np.searchsorted(records.u_times, block.start + slack, side="right")) - 1, 0)
    last = int(np.searchsorted(records.y_times, block.stop + slack, side="right"))
    last_u = int(np.searchsorted(records.u_times, block.stop + slack, side="right"))
    last_u = min(last_u + int(mhe.assembly.input_linear), len(records.u_times))
    return Records(records.y_times[first:last], records.y[first:last], records.u_times[first_u:last_u],
                   records.u[first_u:last_u])  # fmt: skip


def _starting(guess: Any, block: Block, x: Array) -> Any:
    """Return where a block starts: a function of time, or the state at its start."""
    return guess if callable(guess) else x


@lru_cache(maxsize=4)
def _known(content: bytes) -> MHE:
    """Return the estimator that was sent: built once a process."""
    return pickle.loads(content)


def _packed(tasks: list[Any]) -> list[Any]:
    """Return tasks that other processes can read, whatever function the guess is."""
    try:
        from cloudpickle import dumps
    except ImportError:
        raise MissingExtra("cloudpickle", "study", "estimating on several workers") from None
    return [partial(_sent, dumps(task)) for task in tasks]


def _sent(content: bytes) -> Any:
    """Do a task that came from another process."""
    return pickle.loads(content)()


def _solve_block(mhe: MHE | bytes, records: Records, block: Block, guess: Any, p: Array) -> Any:
    """Return trajectory, cost, status and seconds of one block."""
    if isinstance(mhe, bytes):
        mhe = _known(mhe)
    began = time.perf_counter()
    x = np.asarray(guess(block.start) if callable(guess) else guess, float)
    window = mhe.assembly.window(block.start, block.stop, records, np.concatenate([x, p]), growing=True)
    if not block.first:
        window = replace(window, L_prior=np.zeros_like(window.L_prior))
    guesses: list[tuple[str, Callable[[], Guess]]] = [("shifted guess", lambda: shifted_guess(mhe.stage, window))]
    if callable(guess):
        guesses.insert(0, ("given guess", lambda: _given(mhe, window, guess, p)))
    solved, cost, status = mhe.solve_window(window, guesses)
    return (None if solved is None else solved.trajectory), cost, status, time.perf_counter() - began


def _given(mhe: MHE, window: Window, guess: Callable[[float], Any], p: Array) -> Guess:
    """Return the states of a given function at the nodes, within their bounds."""
    x = np.clip([np.asarray(guess(float(t)), float) for t in window.mesh.t], window.x_lower, window.x_upper)
    return Guess.of(x, np.zeros((len(window.mesh), mhe.stage.nw)), p, mhe.stage.ny)


def _lost(error: Exception) -> tuple[None, float, Status, float]:
    """Return what is left of a block that raised, or whose process died."""
    return None, np.nan, Status(Outcome.PREDICTED, False, rungs=(f"{type(error).__name__}: {error}",)), np.nan


def _joined(mhe: MHE, blocks: list[Block], answers: list[Any], wanted: Array | None, p: Array) -> OfflineEstimate:
    """Put the kept parts together."""
    reports, times, states, trajectory = [], [], [], None
    for block, answer in zip(blocks, answers, strict=True):
        trajectory, cost, status, seconds = _lost(answer) if isinstance(answer, Exception) else answer
        failed = "" if trajectory is not None else "; ".join(status.rungs) or "no solver gave numbers"
        reports.append(
            BlockReport(block.start, block.stop, block.keep_from, block.keep_to, cost, seconds, status, failed)
        )
        if trajectory is None:
            t = np.array([block.keep_from, block.keep_to]) if wanted is None else wanted
        else:
            t = np.unique(trajectory.t) if wanted is None else wanted
        t = t[block.keeps(t)]
        times.append(t)
        if trajectory is None:
            states.append(np.full((len(t), mhe.stage.nx), np.nan))
        else:
            states.append(np.reshape([trajectory_at(mhe.stage, trajectory, s) for s in t], (-1, mhe.stage.nx)))
    alone = trajectory if len(blocks) == 1 else None
    p = p if alone is None else alone.p
    return OfflineEstimate(frozen(np.concatenate(times)), frozen(np.concatenate(states)), tuple(reports), alone, p)
