"""Evaluators of an FMU: one a thread, in this process or in one of its own."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import weakref
from contextlib import suppress
from functools import cache
from pathlib import Path
from select import select
from typing import Any, BinaryIO

import numpy as np

from ctmhe.compilers import shipped_library
from ctmhe.errors import FmuBinaryError, FmuUnsupportedError
from ctmhe.models.fmu import worker
from ctmhe.types import Array

log = logging.getLogger(__name__)

SOURCES = Path(__file__).parent / "evaluator"
LOADING = 60.0  # seconds that an FMU may take to load and initialize in a worker
LONGEST = 1e6  # seconds of patience that can be counted
LAST_WORDS, TAIL = 3, 2000  # lines and bytes of what an FMU printed before it failed that a message shows
_renew_type = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_int), ctypes.POINTER(ctypes.c_int))


@cache
def library() -> ctypes.CDLL:
    """Return the evaluator's library.

    Raises
    ------
    FmuBinaryError
        There is none, and no C compiler to make it.
    """
    path = shipped_library(SOURCES, "fmu", ("-O2",))
    if path is None:
        raise FmuBinaryError(
            "FMUs as models need the library that evaluates them, which was not built with this installation, and "
            "there is no C compiler to build it now: pip install 'ctmhe[compile]' brings one"
        )
    loaded = worker.load(str(path))
    loaded.path = str(path)  # pyright: ignore
    return loaded


class Worker:
    """A process with an FMU in it.

    Parameters
    ----------
    configuration : dict
        Fields of `worker.Configuration`.
    references : list of int
        Variables whose values after initialization are wanted.

    Attributes
    ----------
    values : list of float
    next_event : float
        Time of the first time event.

    Raises
    ------
    FmuBinaryError
        When the FMU cannot be opened there, crashes, or does not answer.
    """

    def __init__(self, configuration: dict[str, Any], references: list[int]):
        self.name, self.owner = configuration["name"], os.getpid()
        command = [sys.executable, "-I", "-S", worker.__file__]
        pipe = subprocess.PIPE
        with tempfile.TemporaryFile() as printed:  # what it prints while it opens
            self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=printed, bufsize=0)
            assert self.process.stdin and self.process.stdout
            self.to, self.back = self.process.stdin.fileno(), self.process.stdout.fileno()
            self._end = weakref.finalize(self, _end, self.process, self.owner)
            answer = self._opened(configuration, references, printed)
        self.values, self.next_event = answer["values"], answer["next_event"]

    def _opened(self, configuration: dict[str, Any], references: list[int], printed: BinaryIO) -> dict[str, Any]:
        """Have the FMU opened and return the answer."""
        try:
            with suppress(BrokenPipeError):
                request = {"evaluator": library().path, "configuration": configuration, "references": references}  # pyright: ignore
                worker.send(self.to, request | {"path": [path for path in sys.path if path]})
            if not select([self.back], [], [], LOADING)[0]:
                raise FmuBinaryError(f"the binary of {self.name} does not finish loading: no answer in {LOADING:g} s")
            answer = worker.receive(self.back)
        except EOFError:
            fate = self.fate()
            raise FmuBinaryError(
                f"the binary of {self.name} crashes when it is loaded ({fate}{_last_words(printed)}): it is damaged, "
                "or was made for another system; export the FMU again"
            ) from None
        except BaseException:
            self.close()
            raise
        if "failed" in answer:
            self.close()
            raise unusable(self.name, answer["failed"] + _last_words(printed))
        return answer

    def fate(self) -> str:
        """Return how the process ended."""
        self.close()
        code = self.process.returncode
        with suppress(ValueError):
            return signal.Signals(-code).name
        return f"exit code {code}"

    def close(self) -> None:
        """End the process."""
        self._end()


def _last_words(printed: BinaryIO) -> str:
    """Return the end of what an FMU printed, to follow a reason."""
    printed.seek(max(0, printed.seek(0, os.SEEK_END) - TAIL))
    lines = [line.strip() for line in printed.read().decode("utf-8", "replace").splitlines() if line.strip()]
    return f"; it printed: {' / '.join(lines[-LAST_WORDS:])}" if lines else ""


def _end(process: subprocess.Popen[bytes], owner: int) -> None:
    for stream in (process.stdin, process.stdout):
        if stream:
            stream.close()
    if owner != os.getpid():
        return
    try:
        process.wait(timeout=1.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def unusable(name: str, reason: str) -> FmuBinaryError:
    """Return the error of an FMU that cannot be opened."""
    return FmuBinaryError(
        f"{name} cannot be opened: {reason}. Its binary has to be for this system ({sys.platform}) and to belong to "
        "its modelDescription.xml: export the FMU again, or compile its sources (ctmhe fmu build)"
    )


class Evaluator:
    """dx/dt (or the states one step later), outputs and their Jacobian of one FMU, for one thread.

    Attributes
    ----------
    address, pointer : int
        Of the C function `ctmhe_fmu_evaluate`, and of what it takes first.
    values : list of float
        Of `references`, after initialization.
    next_event : float
    point : tuple of arrays (nx,), (nu,), (nw,), (np,)
        Where `run` evaluates: x, u, w, p.
    """

    def __init__(self, configuration: dict[str, Any], references: list[int], seconds: float | None):
        self._library = library()
        self._sizes = tuple(configuration[key] for key in ("nx", "nu", "nw", "np", "ny"))
        self._worker: Worker | None = None
        self._arguments = configuration, references
        if seconds is None:
            self._made = worker.configuration(configuration)
            try:
                self.pointer = worker.opened(self._library, self._made)
                self._end = weakref.finalize(self, self._library.ctmhe_fmu_close, self.pointer)
                self.values, self.next_event = worker.start_values(self._library, self.pointer, references)
            except OSError as error:
                raise unusable(configuration["name"], str(error)) from None
        else:
            self._worker = Worker(configuration, references)
            self.values, self.next_event = self._worker.values, self._worker.next_event
            itself = weakref.ref(self)  # which the callback would keep alive
            self._renew = _renew_type(lambda to, back: _renew(itself, to, back))
            away = (self._worker.back, self._worker.to, min(seconds, LONGEST), self._renew)
            self.pointer = self._library.ctmhe_fmu_remote(*self._sizes, *away)
            self._end = weakref.finalize(self, self._library.ctmhe_fmu_close, self.pointer)
        self.point = tuple(np.zeros(size) for size in self._sizes[:4])
        self._addresses = tuple(array.ctypes.data for array in self.point)
        self.address = ctypes.cast(self._library.ctmhe_fmu_evaluate, ctypes.c_void_p).value

    def evaluate(
        self, t: float, x: Array, u: Array, w: Array, p: Array, *, jacobian: bool = True
    ) -> tuple[Array, Array, Array]:
        """Return dx (nx,), y (ny,) and d(dx, y) / d(x, w, p) (nx + ny, nx + nw + np).

        Raises
        ------
        FloatingPointError
            The FMU cannot be evaluated there; with the call, the point and its own words.
        """
        nx, _, nw, n_p, ny = self._sizes
        for own, value in zip(self.point, (x, u, w, p), strict=True):
            own[:] = value
        dx, y, J = np.empty(nx), np.empty(ny), np.empty((nx + nw + n_p, nx + ny))
        self.run(t, dx.ctypes.data, y.ctypes.data, J.ctypes.data if jacobian else None)
        return dx, y, J.T

    def run(self, t: float, dx: int | None, y: int | None, J: int | None) -> None:
        """Evaluate at `point`, the arrays x, u, w, p, into memory at these addresses: see `ctmhe_fmu_evaluate`.

        Raises
        ------
        FloatingPointError
            As for `evaluate`.
        """
        if self._library.ctmhe_fmu_evaluate(self.pointer, t, *self._addresses, dx, y, J):
            raise FloatingPointError(self.message())

    def message(self) -> str:
        """Return what the last failure was."""
        return self._library.ctmhe_fmu_message(self.pointer).decode("utf-8", "replace")

    def counts(self) -> tuple[dict[str, int], int, int]:
        """Return the number of FMI calls by kind (of this process), of failed evaluations, and of instances made."""
        calls, failures, instances = (ctypes.c_int64 * len(worker.CALLS))(), ctypes.c_int64(), ctypes.c_int64()
        pointers = (ctypes.addressof(value) for value in (calls, failures, instances))
        self._library.ctmhe_fmu_counts(self.pointer, *pointers)
        return dict(zip(worker.CALLS, calls, strict=True)), failures.value, instances.value

    def begin(self) -> None:
        """Begin a new attempt: lost worker processes are replaced again, ten times at most."""
        self._library.ctmhe_fmu_begin(self.pointer)

    def failures(self) -> int:
        """Return the number of failed evaluations."""
        return self._library.ctmhe_fmu_failures(self.pointer)

    def repeat(self, x: Array, calls: dict[str, int]) -> None:
        """Make FMI calls at x (nx,) and nothing else, for measurements."""
        counts = (ctypes.c_int64 * len(worker.CALLS))(*(calls.get(kind, 0) for kind in worker.CALLS))
        if self._library.ctmhe_fmu_repeat(self.pointer, np.array(x, dtype=float).ctypes.data, counts):
            raise FloatingPointError("a repeated FMI call failed")

    def close(self) -> None:
        """Free the instance."""
        self._end()
        if self._worker is not None:
            self._worker.close()

    def new_worker(self) -> Worker:
        """Replace the worker process."""
        assert self._worker is not None
        if self._worker.owner == os.getpid():  # else this is a forked child, and the worker its parent's
            self._worker.process.kill()
            fate = self._worker.fate()
            log.warning("the worker process of %s ended (%s); a new one is started", self._worker.name, fate)
        self._worker = Worker(*self._arguments)
        return self._worker


def _renew(itself: Any, to: Any, back: Any) -> int:
    """Answer the C side's wish for a new worker; called from a solve, so nothing may be raised."""
    evaluator = itself()
    if evaluator is None:
        return 1
    try:
        new = evaluator.new_worker()
    except Exception:
        log.warning("no new worker process could be started", exc_info=True)
        return 1
    to[0], back[0] = new.back, new.to
    return 0


class Evaluators:
    """One evaluator a thread, made when a thread first asks.

    Parameters
    ----------
    configuration : dict
        Fields of `worker.Configuration`.
    references : list of int
        Variables whose start values are wanted.
    alone : bool
        The FMU allows one instance in a process.
    seconds : float, optional
        Each evaluator's FMU lives in a process of its own, which may be silent for so long.
    """

    def __init__(
        self, configuration: dict[str, Any], references: list[int], *, alone: bool = False, seconds: float | None = None
    ):
        self.configuration, self.references, self.alone, self.seconds = configuration, references, alone, seconds
        self._local = threading.local()
        self._lock = threading.Lock()
        self._all: weakref.WeakSet[Evaluator] = weakref.WeakSet()
        self._closed = False

    def mine(self) -> Evaluator:
        """Return this thread's evaluator.

        Raises
        ------
        FmuBinaryError
            It cannot be made.
        FmuUnsupportedError
            The FMU allows one instance only, and another thread has it.
        """
        found: Evaluator | None = getattr(self._local, "evaluator", None)
        if found is not None:
            return found
        name = self.configuration["name"]
        if self._closed:
            raise FmuBinaryError(f"{name} is closed: build the model again")
        with self._lock:
            if self.alone and self.seconds is None and len(self._all):
                raise FmuUnsupportedError(
                    f"{name} allows one instance in a process (canBeInstantiatedOnlyOncePerProcess), and another "
                    "thread has it: use one thread, worker processes, or isolated=True"
                )
            found = Evaluator(self.configuration, self.references, self.seconds)
            self._all.add(found)
        self._local.evaluator = found
        return found

    def release(self) -> None:
        """Free this thread's, so that another thread can have the only instance."""
        found: Evaluator | None = getattr(self._local, "evaluator", None)
        if found is not None:
            del self._local.evaluator
            self._all.discard(found)
            found.close()

    def close(self) -> None:
        """Free all."""
        self._closed = True
        self._local = threading.local()
        for evaluator in list(self._all):
            evaluator.close()
