"""Where runs are computed: in this process, in processes of our own, or by an executor that was given.

What every run needs, the case and the values of its parameters, is pickled once (`Book`) and kept by every worker; a
task is a few numbers. A worker that does not know the book yet says so and is asked again, with the book.
"""

from __future__ import annotations

import logging
import os
import pickle
import re
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from ctmhe.errors import InputError, MissingExtra
from ctmhe.studies.design import Design, named
from ctmhe.studies.metrics import Value, read_answer
from ctmhe.studies.store import replacing
from ctmhe.studies.trajectories import write_trajectory

log = logging.getLogger(__name__)

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
RENEW_AFTER = 100
"""Runs after which a process of our own that has grown is replaced: compiled libraries leak (scikits.odes half a
kilobyte with every restart of a solution), and a study is long."""

GIVEN_WIDTH = 1000
"""Tasks that are handed to a cluster at a time, so that a cluster that grows with its queue has reason to."""


@dataclass(frozen=True)
class Task:
    """A run to do: position of its point in the design, seed, and the file for its trajectory, if it is kept."""

    key: str
    point: int
    seed: int
    trajectory: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What came of a run: metrics, error ("" for none), wall-clock seconds."""

    values: dict[str, Value]
    error: str
    seconds: float


Outcomes = Generator[tuple[Task, Outcome], None, None]


@dataclass(frozen=True)
class Book:
    """A case and its points, pickled once; `digest` is how workers know it."""

    digest: str
    content: bytes

    @classmethod
    def of(cls, case: Callable[..., Any], design: Design) -> Book:
        """Pickle a case and the points of a design.

        Raises
        ------
        InputError
            Naming the case or the value that cannot be pickled, and why.
        """
        try:
            from cloudpickle import dumps
        except ImportError:
            raise MissingExtra("cloudpickle", "study", "running a study in other processes") from None

        try:
            content = dumps((case, design.values))
        except Exception as error:
            raise _culprit(case, design, dumps) or InputError(f"study: the case cannot be pickled: {error}") from error
        return cls(sha256(content).hexdigest(), content)


_HEARD: set[str] = set()
"""What runs of studies have warned of in this process."""

_RUNNING = threading.local()
"""`depth`: how many runs of studies this thread is within; a case may run a study of its own."""


def _is_new(record: logging.LogRecord) -> bool:
    """Let a warning of a study's runs pass once a process, whatever the numbers in it: searches run many studies."""
    if not getattr(_RUNNING, "depth", 0) or record.levelno > logging.WARNING:
        return True
    new = record.msg not in _HEARD
    _HEARD.add(record.msg)
    return new


logging.getLogger("ctmhe.simulation.engine").addFilter(_is_new)


def perform(case: Callable[..., Any], point: dict[str, Any], task: Task) -> Outcome:
    """Do a run; whatever it raises becomes its error."""
    start = time.perf_counter()
    _RUNNING.depth = getattr(_RUNNING, "depth", 0) + 1
    try:
        run, values = read_answer(case(seed=task.seed, **point))
        if task.trajectory is not None:
            if run is None:
                raise InputError("the case returned no Run: there is no trajectory to keep")
            with replacing(Path(task.trajectory)) as temporary:
                write_trajectory(run, temporary)
        return Outcome(values, "", time.perf_counter() - start)
    except (Exception, SystemExit) as error:
        log.debug("a run failed", exc_info=True)
        return Outcome({}, f"{type(error).__name__}: {error}", time.perf_counter() - start)
    finally:
        _RUNNING.depth -= 1


def execute(
    case: Callable[..., Any],
    design: Design,
    tasks: Sequence[Task],
    *,
    workers: int = 1,
    executor: Any = None,
) -> Outcomes:
    """Return a generator that does runs and yields their outcomes as they come.

    A run whose process dies is tried once more, alone, when the others are done; if it dies again, that is its error.

    Parameters
    ----------
    workers : int
        1: in this process; more: that many processes of our own (joblib's loky), one BLAS thread each.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        In place of our own processes.

    Raises
    ------
    InputError
        At once, when the case or a value cannot be sent to another process.
    """
    if not tasks or (executor is None and workers == 1):
        points = list(design)
        return ((task, perform(case, points[task.point], task)) for task in tasks)
    book = Book.of(case, design)
    if executor is None:
        pool: _Pool = _Processes(min(workers, len(tasks)))
    elif hasattr(executor, "get_executor"):
        pool = _Dask(executor)
    else:
        pool = _Given(executor, workers)
    return _watched(pool, _spread(design.parameters, book, tasks, pool))


def _watched(pool: _Pool, outcomes: Outcomes) -> Outcomes:
    try:
        yield from outcomes
    except BaseException:  # an interrupt is the usual one
        pool.abort()
        raise


def _spread(parameters: tuple[str, ...], book: Book, tasks: Sequence[Task], pool: _Pool) -> Outcomes:
    queue, suspects = deque(tasks), deque[Task]()
    running: dict[Future[Any], Task] = {}
    broken = False

    def start(task: Task, content: Any) -> None:
        future = pool.submit(_work, book.digest, content, parameters, task)
        running[future] = task

    while queue or suspects or running:
        alone = not queue and bool(suspects)
        try:
            while queue and not broken and len(running) < pool.width:
                start(queue[0], pool.content(book))
                queue.popleft()
            if alone and not running and not broken:
                start(suspects[0], book.content)
        except BrokenExecutor:  # died meanwhile
            broken = True
        if running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                try:
                    outcome = future.result()
                except Exception as error:
                    if not _died(error):
                        raise
                    broken = broken or isinstance(error, BrokenExecutor)
                    if suspects and task is suspects[0]:
                        suspects.popleft()
                        yield task, Outcome({}, _death(error), float("nan"))
                    else:
                        if not suspects:
                            log.warning("a worker process died; what it may have been doing is tried again, run by run")
                        suspects.append(task)
                    continue
                if outcome is None:  # the worker does not know the book yet
                    try:
                        start(task, book.content)
                    except BrokenExecutor:
                        broken = True
                        suspects.append(task)
                    continue
                if suspects and task is suspects[0]:
                    suspects.popleft()
                yield task, outcome
        if broken and not running:
            pool.renew()
            broken = False


_KNOWN = threading.local()
"""The book that this worker knows. One, so that a worker that serves many studies does not grow; and each thread has
its own, since plants are no values: two runs must not share one at a time."""


def _work(digest: str, content: Any, parameters: tuple[str, ...], task: Task) -> Outcome | None:
    """Do a run in a worker; return None when the book is needed first."""
    if getattr(_KNOWN, "digest", None) != digest:
        if content is None:
            return None
        try:
            _KNOWN.digest, _KNOWN.book = None, None
            _KNOWN.book = pickle.loads(content)
            _KNOWN.digest = digest
        except Exception as error:
            raise InputError(
                f"study: a worker cannot load the case: {type(error).__name__}: {error}. It needs the "
                "same packages, and the module of the case"
            ) from error
    case, values = _KNOWN.book
    outcome = perform(case, dict(zip(parameters, values[task.point], strict=True)), task)
    _KNOWN.runs = getattr(_KNOWN, "runs", 0) + 1
    if _KNOWN.runs == RENEW_AFTER and "joblib.externals.loky.process_executor" in sys.modules:
        # loky replaces a worker, without losing a task, when it has grown by more than this since its first one
        sys.modules["joblib.externals.loky.process_executor"]._MAX_MEMORY_LEAK_SIZE = 0  # type: ignore[attr-defined]
    return outcome


def _follow(parent: int) -> None:
    """Leave when the process that made this one is gone: killed, it cannot say so."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class _Pool:
    """Where tasks are submitted to; `width` of them at a time."""

    width: int
    executor: Executor

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a task."""
        return self.executor.submit(function, *arguments)

    def content(self, book: Book) -> Any:
        """Return the book as it goes with a first attempt."""
        return None

    def renew(self) -> None:
        """Replace what a dying process has broken."""

    def abort(self) -> None:
        """Stop what is still running."""


class _Processes(_Pool):
    """Processes of our own. They stay for the next study, and leave when they are idle for a minute."""

    def __init__(self, workers: int):
        self.workers, self.width = workers, 2 * workers
        self.renew()

    def renew(self) -> None:
        try:
            from joblib.externals.loky import get_reusable_executor
        except ImportError:
            raise MissingExtra("joblib", "study", "running a study on several workers") from None
        warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)  # ours do, see RENEW_AFTER
        self.executor = get_reusable_executor(
            max_workers=self.workers, timeout=60, env=ONE_THREAD, initializer=_follow, initargs=(os.getpid(),)
        )

    def abort(self) -> None:
        self.executor.shutdown(wait=True, kill_workers=True)  # pyright: ignore


class _Given(_Pool):
    """An executor of the user's; when it breaks, processes of our own take over."""

    def __init__(self, executor: Executor, workers: int):
        self.executor, self.own = executor, None
        self.workers = getattr(executor, "_max_workers", None) or max(workers, 2)
        self.width = 2 * self.workers

    def renew(self) -> None:
        if self.own is None:
            log.warning("the executor is broken; the study goes on in %d processes of its own", self.workers)
            self.own = _Processes(self.workers)
        else:
            self.own.renew()
        self.executor = self.own.executor

    def abort(self) -> None:
        if self.own is not None:
            self.own.abort()


class _Dask(_Pool):
    """A Dask client: the book is a task of its own, whose result workers fetch from each other, once each."""

    width = GIVEN_WIDTH

    def __init__(self, client: Any):
        self.client, self.executor, self.known = client, client.get_executor(pure=False), None

    def content(self, book: Book) -> Any:
        if self.known is None:
            self.known = self.client.submit(bytes, book.content, key=f"ctmhe-study-{book.digest}")
        return self.known

    def abort(self) -> None:
        self.executor.shutdown(wait=False)


def _died(error: Exception) -> bool:
    """Return whether an error means that the process died that did the run; KilledWorker is Dask's word for it."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


def _death(error: Exception) -> str:
    """Return what is said of a run whose process died again."""
    signal = re.search(r"[A-Z]+\(-\d+\)", str(error))
    how = f" ({signal[0]})" if signal else ""
    return (
        f"{type(error).__name__}: the process of this run died{how}, twice: a crash in compiled code, or out of memory"
    )


def _culprit(case: Callable[..., Any], design: Design, dumps: Callable[[Any], bytes]) -> InputError | None:
    """Return an error that names what cannot be pickled."""
    parts = [("the case", case)]
    for labels, values in zip(design.labels, design.values, strict=True):
        parts += [
            (named([name], [label]), value)
            for name, label, value in zip(design.parameters, labels, values, strict=True)
        ]
    for what, part in parts:
        try:
            dumps(part)
        except Exception as error:
            return InputError(
                f"study: {what} cannot be sent to another process: {type(error).__name__}: {error}. Make what it holds "
                "(open files, locks, generators) inside the case, or run with workers=1"
            )
    return None
