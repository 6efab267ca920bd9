"""An FMU in a process of its own: when it crashes or hangs, this process stays as it was."""

from __future__ import annotations

import itertools
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from typing import IO, Any

from ctmhe.errors import FmuBinaryError, FmuError
from ctmhe.models.fmu.description import Variable
from ctmhe.simulation.fmu._engines import Setup
from ctmhe.simulation.fmu._worker import HUNG
from ctmhe.types import Array

PATIENCE = 5.0  # seconds until a process that should end is ended
LAST_WORDS = 3  # lines of what the process printed that a message shows
_keys = itertools.count()


class Place:
    """A checkpoint that is kept in the process of the FMU, as long as this object lives."""

    def __init__(self, run: object, forgotten: deque[int]):
        self.run, self.key = run, next(_keys)
        weakref.finalize(self, forgotten.append, self.key).atexit = False


class Isolated:
    """An engine whose FMU runs in a process of its own, which `start` starts (again)."""

    def __init__(self, setup: Setup, timeout: float | None):
        self._setup, self._timeout, self._name = setup, timeout, setup.description.name
        self.method = f"{setup.engine().method}, in a process of its own"
        self.t = 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._forgotten: deque[int] = deque()
        self._run = object()
        self._end: weakref.finalize[..., Any] | None = None

    def start(self, t: float, values: Mapping[str, float], x: Mapping[str, float]) -> None:
        self._run = object()  # checkpoints of the run before are of no use
        self._forgotten = deque()
        if self._process is None:
            self._launch()
        self._ask("start", t, dict(values), dict(x))

    def _launch(self) -> None:
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        command = [sys.executable, "-c", "from ctmhe.simulation.fmu._worker import main; main()"]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=self._said, env=environment, start_new_session=True
        )
        self._end = weakref.finalize(self, _end, self._process, self._said)
        self._send((self._setup, self._timeout))

    def _send(self, message: Any) -> None:
        assert self._process is not None and self._process.stdin is not None
        try:
            pickle.dump(message, self._process.stdin)
            self._process.stdin.flush()
        except OSError:
            raise self._lost("taking a request") from None

    def _ask(self, method: str, *arguments: Any) -> Any:
        if self._process is None:
            raise FmuBinaryError(f"{self._name} is not running in its process: call start (again)")
        forgotten = [self._forgotten.popleft() for _ in range(len(self._forgotten))]
        self._send((forgotten, method, arguments))
        assert self._process.stdout is not None
        try:
            error, value, self.t = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError, OSError):
            raise self._lost(method) from None
        except BaseException:
            self.close()  # interrupted: the reply would be taken for that to the next request
            raise
        if error is not None:
            kind, text = error
            raise kind(text)
        return value

    def _lost(self, method: str) -> FmuBinaryError:
        """Return what to raise after the process ended by itself."""
        assert self._process is not None and self._said is not None
        try:
            code = self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:  # only its streams are closed
            self._process.kill()
            code = self._process.wait()
        self._said.seek(0)
        words = " / ".join(self._said.read().decode("utf-8", "replace").splitlines()[-LAST_WORDS:])
        if code == HUNG:
            what = f"did not come back from {method} within {self._timeout:g} s"
        else:
            what = f"ended its process during {method} ({_told(code)})"
        self.close()
        return FmuBinaryError(
            f"the binary of {self._name} {what}, at t = {self.t:.9g} or later{f'; it said: {words}' if words else ''}. "
            "start begins again in a new process"
        )

    def advance(self, t: float, before: Array, after: Array, push: Array) -> None:
        self._ask("advance", t, before, after, push)

    def get(self, variables: Sequence[Variable], inputs: Array) -> Array:
        values: Array = self._ask("get", [variable.name for variable in variables], inputs)
        return values

    def checkpoint(self) -> Place:
        place = Place(self._run, self._forgotten)
        self._ask("checkpoint", place.key)
        return place

    def restore(self, checkpoint: Place) -> None:
        if checkpoint.run is not self._run:
            raise FmuError(f"{self._name}: a saved state is only good for the run that saved it")
        self._ask("restore", checkpoint.key)

    def close(self) -> None:
        if self._end is not None:
            self._end()
        self._process = self._said = self._end = None


def _told(code: int) -> str:
    if code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def _end(process: subprocess.Popen[bytes], said: IO[bytes]) -> None:
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.close()  # the process ends when there are no more requests
    except OSError:
        process.kill()
    try:
        process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    process.stdout.close()
    said.close()
