"""The process in which an isolated FMU runs: `python -m ctmhe.simulation._fmu_worker`, started by `_fmu_isolated`.

Requests and replies are pickles on the standard streams, so that no port is opened and the end of the parent, however
it comes, ends this process. The watchdog is faulthandler's: it works while the FMU does not give the control back.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import traceback
from typing import Any, BinaryIO

from ctmhe.errors import FmuError
from ctmhe.simulation._fmu_engines import Setup


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
    served = Served(setup)
    while True:
        try:
            forgotten, method, arguments = pickle.load(requests)
        except EOFError:
            break
        if timeout is not None:
            faulthandler.dump_traceback_later(timeout, exit=True)
        served.forget(forgotten)
        error, value = None, None
        try:
            value = served.answer(method, *arguments)
        except FmuError as problem:
            error = type(problem), str(problem)
        except Exception:
            error = RuntimeError, traceback.format_exc()
        faulthandler.cancel_dump_traceback_later()
        pickle.dump((error, value, served.t), replies)
        replies.flush()
    served.close()


def main() -> None:
    """Keep the standard streams for the requests; what the FMU prints goes to the standard error."""
    faulthandler.enable()
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    serve(requests, replies)


if __name__ == "__main__":
    main()
