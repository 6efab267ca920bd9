"""The door to fmpy: one interface to instances of FMUs, FMI 2.0 and 3.0."""

from __future__ import annotations

import ctypes
import logging
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ctmhe.errors import (
    FmuBinaryError,
    FmuError,
    FmuEventError,
    FmuKindError,
    FmuParameterError,
    FmuUnsupportedError,
    MissingExtra,
)
from ctmhe.models.fmu.description import CO_SIMULATION, MODEL_EXCHANGE, Description, Variable
from ctmhe.models.fmu.messages import callbacks2, listener3
from ctmhe.models.fmu.surroundings import kept
from ctmhe.types import Array

log = logging.getLogger(__name__)

OK, DISCARD, ERROR, FATAL, PENDING = 0, 2, 3, 4, 5
_STATUS = {DISCARD: "discard", ERROR: "error", FATAL: "fatal error", PENDING: "pending"}
_TERMINATED, _LAST_TIME = 3, 2  # kinds of status that FMI 2 can be asked for after a discarded step
MOST_ROUNDS = 1000  # of one event iteration


def _fmpy() -> Any:
    try:
        import fmpy
        import fmpy.fmi2
        import fmpy.fmi3
    except ImportError as error:
        raise MissingExtra("fmpy", "fmu", "reading an FMU") from error
    return fmpy


class Discard(FmuError):
    """The FMU cannot be evaluated at this point, but may be at another."""


@dataclass(frozen=True)
class Event:
    """What an event iteration left behind; `next_time` is infinite when no time event is planned."""

    states_changed: bool
    nominals_changed: bool
    next_time: float


@dataclass(frozen=True)
class Step:
    """How far a communication step came: the time reached, and whether an event waits there to be handled."""

    t: float
    event: bool


@dataclass
class _Life:
    """What is freed in the end; shared with the finalizer, which must not hold the instance."""

    fmu: Any
    saved: dict[int, Any] = field(default_factory=dict)
    running: bool = False  # initialized, and no call has failed since
    failure: str = ""  # the error after which the FMU takes no calls but those that bring it back
    fatal: bool = False  # not even to be freed


class Instance:
    """A running instance of an FMU; the same calls for both FMI versions and both kinds.

    A fresh instance is initialized by `initialize`; then model exchange is in continuous-time mode, co-simulation
    ready to step. Vectors are float64 arrays in the order of the variables passed.

    After an error of the FMU only `load` and `close` are possible, as the standard has it; after `Discard` all is.

    Parameters
    ----------
    description : Description
    folder : Path
        Where the FMU is unpacked; must exist as long as the instance.
    kind : str
        `ModelExchange` or `CoSimulation`.

    Raises
    ------
    FmuKindError
        If the FMU does not offer `kind`.
    FmuBinaryError
        If the binary cannot be loaded or refuses.
    FmuError
        From any later call that fails; it names the call, its variables and what the FMU said.
    """

    def __init__(self, description: Description, folder: Path, kind: str):
        fmpy = _fmpy()
        if kind not in description.kinds:
            raise FmuKindError(f"{description.name} offers {', '.join(description.kinds) or 'nothing'}, not {kind}")
        self.description, self.kind = description, kind
        self.interface = description.kinds[kind]
        self.messages: deque[str] = deque(maxlen=5)
        self._version = description.major
        module = fmpy.fmi2 if self._version == 2 else fmpy.fmi3
        suffix = "Model" if kind == MODEL_EXCHANGE else "Slave"
        factory = getattr(module, f"FMU{self._version}{suffix}")
        with kept():  # fmpy, too, steps into the FMU's folder and stays there when loading fails
            self._load(fmpy, factory, folder)
            self._instantiate(fmpy)
        self._life = _Life(self._fmu)
        self._free = weakref.finalize(self, _release, self._life)
        self._nx, self._nz = len(description.states), description.event_indicators
        self._derivatives, self._indicators = (ctypes.c_double * self._nx)(), (ctypes.c_double * self._nz)()

    def _load(self, fmpy: Any, factory: Any, folder: Path) -> None:
        description = self.description
        try:
            self._fmu = factory(
                guid=description.token,
                modelIdentifier=self.interface.identifier,
                unzipDirectory=str(folder),
                instanceName=description.name or "fmu",
            )
        except Exception as error:
            raise FmuBinaryError(
                f"the binary of {description.name} ({self.interface.identifier}) cannot be loaded: {error}. "
                f"The FMU needs a binary for this platform ({fmpy.platform_tuple}) that has every function of FMI"
            ) from error

    @property
    def event_mode(self) -> bool:
        """Whether events are handled with us: always in model exchange, by choice in FMI 3 co-simulation."""
        return self.kind == MODEL_EXCHANGE or (self._version > 2 and self.interface.event_mode)

    @property
    def failed(self) -> bool:
        """Whether the FMU reported an error, after which only `load` and `close` are possible."""
        return bool(self._life.failure)

    def _instantiate(self, fmpy: Any) -> None:
        options: dict[str, Any]
        if self._version == 2:
            options = {}
            options["callbacks"], self._fmu.listener = callbacks2(fmpy.fmi2, self.messages)
        else:
            options = {"logMessage": listener3(self.messages)}
            if self.kind == CO_SIMULATION:
                options |= {"eventModeUsed": self.event_mode, "earlyReturnAllowed": True}
        try:
            try:
                self._fmu.instantiate(**options)
            except Exception:
                if self.messages:
                    raise
                self._fmu.instantiate(**options, loggingOn=True)  # to hear why
            if self.description.complaints:
                self._ask_for_complaints(options)
        except Exception as error:
            self._fmu.freeLibrary()
            advice = (
                "It allows one instance in a process: close the other one"
                if self.interface.single_instance
                else "Its binary and its modelDescription.xml may not belong together: export it again"
            )
            raise FmuBinaryError(
                f"{self.description.name} cannot be instantiated for {self.kind}{self._told()}. {advice}"
            ) from error

    def _ask_for_complaints(self, options: Mapping[str, Any]) -> None:
        """Have the FMU tell what is wrong, and nothing else: all that it could tell takes long."""
        try:
            self._fmu.setDebugLogging(True, list(self.description.complaints))
        except Exception as error:  # after which an instance is of no use
            log.info("%s does not take wishes about its log: %s", self.description.name, error)
            release = self._fmu.fmi2FreeInstance if self._version == 2 else self._fmu.fmi3FreeInstance
            release(self._fmu.component)
            self._fmu.instantiate(**options)

    def _told(self) -> str:
        return f"; it says: {' / '.join(self.messages)}" if self.messages else ""

    def _call(self, name: str, *arguments: Any, about: Iterable[str] = ()) -> Any:
        if not self._free.alive:
            raise FmuError(f"{self.description.name} is closed; start it again or build a new one")
        if self._life.failure and (self._life.fatal or name not in {"setFMUState", "freeFMUState"}):
            raise FmuError(f"{self._life.failure}. It takes no more calls: start it again")
        self.messages.clear()
        try:
            return getattr(self._fmu, name)(*arguments)
        except Exception as error:
            raise self._failure(name, error, about) from error

    def _failure(self, call: str, error: Exception, about: Iterable[str]) -> FmuError:
        names = ", ".join(about)
        what = getattr(error, "function", call) + (f" of {names}" if names else "")
        status = getattr(error, "status", ERROR if isinstance(error, OSError) else OK)
        reason = _STATUS.get(status, str(error))
        text = f"{self.description.name}: {what} failed: {reason}{self._told()}"
        if status == DISCARD:
            return Discard(text)
        if status >= ERROR:
            self._life.failure, self._life.fatal, self._life.running = text, status == FATAL, False
        return FmuError(text)

    def initialize(self, t: float, values: Mapping[str, float], tolerance: float | None = None) -> Event:
        """Initialize at time `t` with start values by name (inputs, parameters, settable states).

        Raises
        ------
        FmuParameterError
            If the FMU refuses a start value.
        FmuBinaryError
            If it cannot be initialized with them.
        """
        chosen = [self.description.variables[name] for name in values]
        numbers = list(values.values())
        try:
            self.set(chosen, numbers)
        except FmuError as error:
            raise FmuParameterError(f"{error}. Leave these start values to the FMU") from error
        try:
            if self._version == 2:
                self._call("setupExperiment", tolerance, t)
                self._call("enterInitializationMode")
            else:
                self._call("enterInitializationMode", tolerance, t)
            self._call("exitInitializationMode")
        except FmuError as error:
            raise FmuBinaryError(f"{error}. It cannot be initialized at t = {t:.9g} with these start values") from error
        self._life.running = True
        return self._iterate(t) if self.event_mode else Event(False, False, np.inf)

    def event(self, t: float, variables: Sequence[Variable] = (), values: ArrayLike = ()) -> Event:
        """Enter event mode at time `t`, set variables there, iterate until nothing changes, and leave it again.

        Raises
        ------
        FmuEventError
            If the iteration does not end, or the FMU asks to end the simulation.
        """
        self._call("enterEventMode")
        self.set(variables, values)
        return self._iterate(t)

    def _iterate(self, t: float) -> Event:
        function = "newDiscreteStates" if self._version == 2 else "updateDiscreteStates"
        changed, rescaled, next_time = False, False, np.inf
        for _ in range(MOST_ROUNDS):
            needed, terminate, nominals, states, planned, when = self._call(function)
            changed, rescaled = changed or bool(states), rescaled or bool(nominals)
            next_time = float(when) if planned else np.inf
            if terminate:
                raise self._ended(t)
            if not needed:
                self._call("enterContinuousTimeMode" if self.kind == MODEL_EXCHANGE else "enterStepMode")
                return Event(changed, rescaled, next_time)
        raise FmuEventError(
            f"{self.description.name}: the event iteration at t = {t:.9g} does not end ({MOST_ROUNDS} rounds)"
            f"{self._told()}. Its discrete equations have no solution there"
        )

    def _ended(self, t: float) -> FmuEventError:
        return FmuEventError(f"{self.description.name} asks to end the simulation at t = {t:.9g}{self._told()}")

    def completed_step(self, t: float) -> bool:
        """Tell the FMU that an integration step ended at `t`; True when it asks for an event (model exchange)."""
        enter, terminate = self._call("completedIntegratorStep", not self.interface.get_set_state)
        if terminate:
            raise self._ended(t)
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
        if not self._nx:
            return  # some FMUs refuse an empty vector
        self._call("setContinuousStates", (ctypes.c_double * self._nx)(*x.tolist()), self._nx)

    def states(self) -> Array:
        """Return all continuous states (model exchange)."""
        buffer = (ctypes.c_double * self._nx)()
        if self._nx:
            self._call("getContinuousStates", buffer, self._nx)
        return np.array(buffer[:], dtype=np.float64)

    def nominals(self) -> Array:
        """Return the present nominal values of the continuous states (model exchange)."""
        buffer = (ctypes.c_double * self._nx)()
        if self._nx:
            self._call("getNominalsOfContinuousStates", buffer, self._nx)
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

    def set_slopes(self, variables: Sequence[Variable], values: ArrayLike) -> None:
        """Set the time derivatives of inputs over the next step (FMI 2, where `interface.input_derivatives`)."""
        references = [variable.reference for variable in variables]
        slopes = np.asarray(values, float).tolist()
        names = (variable.name for variable in variables)
        self._call("setRealInputDerivatives", references, [1] * len(references), slopes, about=names)

    def do_step(self, t: float, length: float) -> Step:
        """Advance a co-simulation from `t` by `length` seconds, or as far as it comes.

        Raises
        ------
        Discard
            If it does not come any further than `t`; a shorter step may succeed.
        FmuEventError
            If the FMU asks to end the simulation.
        FmuUnsupportedError
            If it goes on in the background, which it was not offered.
        """
        return self._step2(t, length) if self._version == 2 else self._step3(t, length)

    def _step2(self, t: float, length: float) -> Step:
        try:
            self._call("doStep", t, length, not self.interface.get_set_state)
        except Discard:
            last = self._status("getRealStatus", _LAST_TIME)
            reached = t if last is None else float(last)
            if self._status("getBooleanStatus", _TERMINATED):
                raise self._ended(reached) from None
            if not t < reached <= t + length:
                raise
            return Step(reached, False)
        except FmuError as error:
            if getattr(error.__cause__, "status", OK) == PENDING:
                raise FmuUnsupportedError(
                    f"{self.description.name}: doStep goes on in the background although it was not offered to; "
                    "export the FMU for synchronous steps"
                ) from error
            raise
        return Step(t + length, False)

    def _status(self, call: str, kind: int) -> Any:
        try:
            return self._call(call, kind)
        except Discard:  # it does not know
            return None

    def _step3(self, t: float, length: float) -> Step:
        event, terminate, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
        last = ctypes.c_double(t + length)
        keep = ctypes.c_bool(not self.interface.get_set_state)
        results = [ctypes.byref(value) for value in (event, terminate, early, last)]
        discarded = False
        try:
            self._call("fmi3DoStep", self._fmu.component, t, length, keep, *results)
        except Discard:
            discarded = True
            if not (terminate or t < last.value <= t + length):
                raise
        reached = last.value if early or discarded else t + length
        if terminate:
            raise self._ended(reached)
        if not t <= reached <= t + length * (1.0 + 1e-9):
            raise FmuError(
                f"{self.description.name}: the step from {t} by {length} s returned early and says that it ended at "
                f"{reached}, which is outside of the step{self._told()}"
            )
        return Step(reached, bool(event) and self.event_mode)

    def save(self) -> SavedState:
        """Return a copy of everything inside the FMU; needs `interface.get_set_state`."""
        pointer = self._call("getFMUState")
        self._life.saved[id(pointer)] = pointer
        return SavedState(self, pointer)

    def load(self, saved: SavedState) -> None:
        """Bring the FMU back to a state that this very instance saved, also after an error."""
        if saved.owner() is not self or id(saved.pointer) not in self._life.saved:
            raise FmuError(f"{self.description.name}: a saved state is only good for the run that saved it")
        self._call("setFMUState", saved.pointer)
        self._life.failure = ""

    def forget(self, pointer: Any) -> None:
        """Free a saved state."""
        if self._free.alive and self._life.saved.pop(id(pointer), None) is not None and not self._life.fatal:
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


def _release(life: _Life) -> None:
    if life.fatal:
        return  # the standard forbids any further call
    calls = [life.fmu.terminate] if life.running else []
    calls += [partial(life.fmu.freeFMUState, pointer) for pointer in life.saved.values()]
    life.saved.clear()
    for call in (*calls, life.fmu.freeInstance):  # an FMU that cannot even be ended is freed all the same
        try:
            call()
        except Exception as error:
            log.debug("freeing an FMU failed", exc_info=True)
            if getattr(error, "status", OK) == FATAL:
                return
