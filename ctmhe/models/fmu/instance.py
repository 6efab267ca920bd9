"""The door to fmpy: one interface to instances of FMUs, FMI 2.0 and 3.0."""

from __future__ import annotations

import ctypes
import logging
import os
import platform
import sys
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import FmuError, MissingExtra
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, Variable
from ctmhe.types import Array

log = logging.getLogger(__name__)


def _fmpy() -> Any:
    try:
        import fmpy
        import fmpy.fmi2
        import fmpy.fmi3
    except ImportError as error:
        raise MissingExtra("fmpy", "fmu", "reading an FMU") from error
    return fmpy


@dataclass(frozen=True)
class Event:
    """What an event iteration left behind; `next_time` is infinite when no time event is planned."""

    states_changed: bool
    next_time: float


class Instance:
    """A running instance of an FMU; the same calls for both FMI versions and both kinds.

    A fresh instance is initialized by `initialize`; then model exchange is in continuous-time mode, co-simulation
    ready to step. Vectors are float64 arrays in the order of the variables passed.

    Parameters
    ----------
    description : Description
    folder : Path
        Where the FMU is unpacked; must exist as long as the instance.
    kind : str
        `ModelExchange` or `CoSimulation`.

    Raises
    ------
    FmuError
        If the binary cannot be loaded or refuses; any later failing call names itself and its variables.
    """

    def __init__(self, description: Description, folder: Path, kind: str):
        fmpy = _fmpy()
        if kind not in description.kinds:
            raise FmuError(f"{description.name} offers {', '.join(description.kinds) or 'nothing'}, not {kind}")
        self.description, self.kind = description, kind
        self.interface = description.kinds[kind]
        self.messages: deque[str] = deque(maxlen=5)
        self._version = description.major
        module = fmpy.fmi2 if self._version == 2 else fmpy.fmi3
        suffix = "Model" if kind == MODEL_EXCHANGE else "Slave"
        factory = getattr(module, f"FMU{self._version}{suffix}")
        here = os.getcwd()
        try:
            self._fmu = factory(
                guid=description.token,
                modelIdentifier=self.interface.identifier,
                unzipDirectory=str(folder),
                instanceName=description.name or "fmu",
            )
        except Exception as error:
            raise FmuError(
                f"the binary of {description.name} ({self.interface.identifier}) cannot be loaded: {error}. "
                f"The FMU needs a binary for this platform ({fmpy.platform_tuple})"
            ) from error
        finally:
            os.chdir(here)  # fmpy steps into the FMU's folder and stays there when loading fails
        self._instantiate(fmpy)
        self._saved: dict[int, Any] = {}
        self._free = weakref.finalize(self, _release, self._fmu, self._saved)
        self._nx, self._nz = len(description.states), description.event_indicators
        self._derivatives, self._indicators = (ctypes.c_double * self._nx)(), (ctypes.c_double * self._nz)()

    def _instantiate(self, fmpy: Any) -> None:
        options: dict[str, Any]
        if self._version == 2:
            options = {}
            options["callbacks"], self._fmu.listener = _fmi2_callbacks(fmpy.fmi2, self.messages)
        else:
            options = {"logMessage": partial(_listen3, self.messages)}
        try:
            self._fmu.instantiate(**options)
        except Exception as error:
            self._fmu.freeLibrary()
            raise FmuError(
                f"{self.description.name} cannot be instantiated for {self.kind}{self._told()}. Its binary and "
                "its modelDescription.xml may not belong together: export it again"
            ) from error

    def _told(self) -> str:
        return f"; it says: {' / '.join(self.messages)}" if self.messages else ""

    def _call(self, name: str, *arguments: Any, about: Iterable[str] = ()) -> Any:
        if not self._free.alive:
            raise FmuError(f"{self.description.name} is closed; start it again or build a new one")
        try:
            return getattr(self._fmu, name)(*arguments)
        except Exception as error:
            names = ", ".join(about)
            what = f"{name} of {names}" if names else name
            raise FmuError(f"{self.description.name}: {what} failed: {error}{self._told()}") from error

    def initialize(self, t: float, values: Mapping[str, float], tolerance: float | None = None) -> Event:
        """Initialize at time `t` with start values by name (inputs, parameters, settable states)."""
        chosen = [self.description.variables[name] for name in values]
        numbers = list(values.values())
        if self._version == 2:
            self.set(chosen, numbers)
            self._call("setupExperiment", tolerance, t)
            self._call("enterInitializationMode")
        else:
            self.set(chosen, numbers)
            self._call("enterInitializationMode", tolerance, t)
        self._call("exitInitializationMode")
        if self.kind == CO_SIMULATION:
            return Event(False, np.inf)
        return self._iterate()

    def event(self) -> Event:
        """Enter event mode, iterate until nothing changes, and leave it again (model exchange)."""
        self._call("enterEventMode")
        return self._iterate()

    def _iterate(self) -> Event:
        function = "newDiscreteStates" if self._version == 2 else "updateDiscreteStates"
        changed, next_time = False, np.inf
        for _ in range(1000):
            needed, terminate, _, states, planned, when = self._call(function)
            changed |= bool(states)
            next_time = float(when) if planned else np.inf
            if terminate:
                raise FmuError(f"{self.description.name} asks to end the simulation{self._told()}")
            if not needed:
                self._call("enterContinuousTimeMode")
                return Event(changed, next_time)
        raise FmuError(f"{self.description.name}: the event iteration does not end (1000 rounds)")

    def completed_step(self) -> bool:
        """Tell the FMU that an integration step ended; True when it asks for an event (model exchange)."""
        enter, terminate = self._call("completedIntegratorStep")
        if terminate:
            raise FmuError(f"{self.description.name} asks to end the simulation{self._told()}")
        return bool(enter)

    def set(self, variables: Sequence[Variable], values: ArrayLike) -> None:
        """Set real variables."""
        count = len(variables)
        if count:
            numbers = (ctypes.c_double * count)(*np.asarray(values, float).tolist())
            references = (ctypes.c_uint * count)(*(variable.reference for variable in variables))
            names = (variable.name for variable in variables)
            if self._version == 2:
                self._call("fmi2SetReal", self._fmu.component, references, count, numbers, about=names)
            else:
                self._call("fmi3SetFloat64", self._fmu.component, references, count, numbers, count, about=names)

    def get(self, variables: Sequence[Variable]) -> Array:
        """Return real variables."""
        count = len(variables)
        numbers = (ctypes.c_double * count)()
        if count:
            references = (ctypes.c_uint * count)(*(variable.reference for variable in variables))
            names = (variable.name for variable in variables)
            if self._version == 2:
                self._call("fmi2GetReal", self._fmu.component, references, count, numbers, about=names)
            else:
                self._call("fmi3GetFloat64", self._fmu.component, references, count, numbers, count, about=names)
        return np.array(numbers[:], dtype=np.float64)

    def set_time(self, t: float) -> None:
        """Set the time (model exchange)."""
        self._call("setTime", float(t))

    def set_states(self, x: Array) -> None:
        """Set all continuous states (model exchange)."""
        self._call("setContinuousStates", (ctypes.c_double * self._nx)(*x.tolist()), self._nx)

    def states(self) -> Array:
        """Return all continuous states (model exchange)."""
        buffer = (ctypes.c_double * self._nx)()
        self._call("getContinuousStates", buffer, self._nx)
        return np.array(buffer[:], dtype=np.float64)

    def derivatives(self) -> Array:
        """Return dx/dt (model exchange)."""
        name = "getDerivatives" if self._version == 2 else "getContinuousStateDerivatives"
        self._call(name, self._derivatives, self._nx)
        return np.array(self._derivatives[:], dtype=np.float64)

    def event_indicators(self) -> Array:
        """Return the functions whose sign changes are state events (model exchange)."""
        if self._nz:
            self._call("getEventIndicators", self._indicators, self._nz)
        return np.array(self._indicators[:], dtype=np.float64)

    def directional(self, unknowns: Sequence[Variable], knowns: Sequence[Variable], seed: ArrayLike) -> Array:
        """Return d unknowns / d knowns times `seed`."""
        arguments = (
            [v.reference for v in unknowns],
            [v.reference for v in knowns],
            np.asarray(seed, float).tolist(),
        )
        names = (variable.name for variable in (*unknowns, *knowns))
        return np.array(self._call("getDirectionalDerivative", *arguments, about=names), dtype=np.float64)

    def do_step(self, t: float, length: float) -> None:
        """Advance a co-simulation from `t` by `length` seconds."""
        answer = self._call("doStep", t, length)
        if answer is not None and (answer[1] or abs(answer[3] - t - length) > 1e-9 * max(1.0, abs(t), length)):
            raise FmuError(
                f"{self.description.name}: the step from {t} by {length} s ended at {answer[3]}"
                f"{', asking to end the simulation' if answer[1] else ''}{self._told()}"
            )

    def save(self) -> SavedState:
        """Return a copy of everything inside the FMU; needs `interface.get_set_state`."""
        pointer = self._call("getFMUState")
        self._saved[id(pointer)] = pointer
        return SavedState(self, pointer)

    def load(self, saved: SavedState) -> None:
        """Bring the FMU back to a state that this very instance saved."""
        if saved.owner() is not self or id(saved.pointer) not in self._saved:
            raise FmuError(f"{self.description.name}: a saved state is only good for the run that saved it")
        self._call("setFMUState", saved.pointer)

    def forget(self, pointer: Any) -> None:
        """Free a saved state."""
        if self._free.alive and self._saved.pop(id(pointer), None) is not None:
            self._call("freeFMUState", pointer)

    def close(self) -> None:
        """Free saved states, the instance and its library; safe to call twice."""
        self._free()


class SavedState:
    """A state inside an FMU, freed when this object goes away."""

    def __init__(self, instance: Instance, pointer: Any):
        self.owner = weakref.ref(instance)
        self.pointer = pointer
        weakref.finalize(self, _forget, self.owner, pointer).atexit = False


def _forget(owner: Callable[[], Instance | None], pointer: Any) -> None:
    instance = owner()
    if instance is not None:
        instance.forget(pointer)


def _release(fmu: Any, saved: dict[int, Any]) -> None:
    try:
        for pointer in saved.values():
            fmu.freeFMUState(pointer)
        saved.clear()
        fmu.freeInstance()
    except Exception:
        log.debug("freeing an FMU failed", exc_info=True)


def _listen(messages: deque[str], status: int, text: bytes | None) -> None:
    message = (text or b"").decode("utf-8", "replace").strip()
    log.debug("FMU message (status %s): %s", status, message)
    if status != 0:
        messages.append(message)


def _listen3(messages: deque[str], environment: Any, status: int, category: bytes, text: bytes | None) -> None:
    _listen(messages, status, text)


def _fmi2_callbacks(fmi2: Any, messages: deque[str]) -> tuple[Any, Any]:
    """Return fmpy's callback structure and what must be kept alive with it.

    A message is a printf format with arguments, which a Python callback cannot walk through. fmpy's addLoggerProxy
    does, but keeps one logger for the whole process. Most FMUs pass "%s" and one text; the calling conventions
    (but Apple's on ARM) hand that over like an ordinary sixth argument.
    """
    apple = sys.platform == "darwin" and platform.machine() == "arm64"

    def listen(environment: Any, name: bytes, status: int, category: bytes, text: bytes, extra: int | None) -> None:
        if text == b"%s" and extra is not None and not apple:
            text = ctypes.string_at(extra)
        _listen(messages, status, text)

    pointer, text = ctypes.c_void_p, ctypes.c_char_p
    listener = ctypes.CFUNCTYPE(None, pointer, text, ctypes.c_int, text, text, pointer)(listen)
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = ctypes.cast(listener, fmi2.fmi2CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
    callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
    return callbacks, listener
