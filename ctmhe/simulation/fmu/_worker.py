"""The process in which an isolated FMU runs; `_fmu_isolated` starts it.

Requests and replies are pickles on the standard streams, so that no port is opened and the end of the parent, however
it comes, ends this process.
"""

from __future__ import annotations

import os
import pickle
import threading
import time
import traceback
from typing import Any, BinaryIO

from ctmhe.errors import FmuError
from ctmhe.simulation.fmu._engines import Setup

HUNG = 124  # exit code, as of the command timeout
CHECKS = 20  # of the time limit within its length


class Watchdog:
    """Ends the process when a call takes longer than `limit` seconds; it can, since calls into an FMU free the GIL."""

    def __init__(self, limit: float | None):
        self._limit, self._deadline = limit, float("inf")
        if limit is not None:
            threading.Thread(target=self._watch, args=(limit / CHECKS,), daemon=True).start()

    def __enter__(self) -> None:
        if self._limit is not None:
            self._deadline = time.monotonic() + self._limit

    def __exit__(self, *_: object) -> None:
        self._deadline = float("inf")

    def _watch(self, pause: float) -> None:
        while time.monotonic() < self._deadline:
            time.sleep(pause)
        os._exit(HUNG)


class Served:
    """An engine whose checkpoints stay here, and whose variables go by name."""

    def __init__(self, setup: Setup):
        self._setup, self._engine = setup, setup.engine()
        self._kept: dict[int, Any] = {}

    def answer(self, method: str, *arguments: Any) -> Any:
        """Call one method of the engine."""
        if method == "get":
            names, inputs = arguments
            return self._engine.get([self._setup.description.variables[name] for name in names], inputs)
        if method == "checkpoint":
            (key,) = arguments
            self._kept[key] = self._engine.checkpoint()
            return None
        if method == "restore":
            (key,) = arguments
            return self._engine.restore(self._kept[key])
        if method == "start":
            self._kept.clear()
        return getattr(self._engine, method)(*arguments)

    def forget(self, keys: list[int]) -> None:
        """Free checkpoints."""
        for key in keys:
            self._kept.pop(key, None)

    @property
    def t(self) -> float:
        """Where the engine is."""
        return self._engine.t

    def close(self) -> None:
        """Free the FMU."""
        self._kept.clear()
        self._engine.close()


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Answer requests until there are no more."""
    setup, timeout = pickle.load(requests)
    served, watchdog = Served(setup), Watchdog(timeout)
    while True:
        try:
            forgotten, method, arguments = pickle.load(requests)
        except EOFError:
            break
        error, value = None, None
        try:
            with watchdog:
                served.forget(forgotten)
                value = served.answer(method, *arguments)
        except FmuError as problem:
            error = type(problem), str(problem)
        except Exception:
            error = RuntimeError, traceback.format_exc()
        pickle.dump((error, value, served.t), replies)
        replies.flush()
    served.close()


def main() -> None:
    """Keep the standard streams for the requests; what the FMU prints goes to the standard error."""
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    serve(requests, replies)
