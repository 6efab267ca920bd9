"""What FMUs say while they run."""

from __future__ import annotations

import ctypes
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

from ctmhe.models.fmu.evaluators import library

log = logging.getLogger(__name__)

_hear_type = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_char_p)


class _Ear(ctypes.Structure):
    """`ctmhe_fmu_ear` of fmu.h."""

    _fields_ = [("hear", _hear_type)]


def listen(messages: deque[str], status: int, text: bytes | None) -> None:
    """Log a message, and keep it when it is more than information."""
    message = (text or b"").decode("utf-8", "replace").strip()
    log.debug("FMU message (status %s): %s", status, message)
    if status != 0 and message:
        messages.append(message)


def listener3(messages: deque[str]) -> Callable[..., None]:
    """Return a function that FMI 3 FMUs can call."""

    def hear(environment: Any, status: int, category: bytes, text: bytes | None) -> None:
        listen(messages, status, text)

    return hear


def callbacks2(fmi2: Any, messages: deque[str]) -> tuple[Any, Any]:
    """Return fmpy's callback structure for FMI 2, and what must be kept alive with it.

    Messages are printf formats with arguments, which C has to fill in. fmpy's own way, addLoggerProxy, has one listener
    for the whole process and takes any text with a percent sign for a format: an FMU that passes one can crash there.
    """

    def hear(status: int, text: bytes | None) -> None:
        listen(messages, status, text)

    ear = _Ear(_hear_type(hear))
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = ctypes.cast(library().ctmhe_fmu_listen, fmi2.fmi2CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
    callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
    callbacks.componentEnvironment = ctypes.addressof(ear)
    return callbacks, ear
