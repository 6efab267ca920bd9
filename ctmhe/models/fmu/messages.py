"""What FMUs say: FMI 2 hands over a printf format and loose arguments, FMI 3 a finished text."""

from __future__ import annotations

import ctypes
import logging
import platform
import re
import struct
import sys
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

log = logging.getLogger(__name__)

INTEGERS, REALS = 14, 8  # arguments that are looked at; registers hold eight real ones
LONGEST = 2000  # characters kept of one text
NULL_PAGE = 4096  # no text lies below: what a format takes for an address there is none
_CONVERSION = re.compile(r"%([-+ #0]*)(\*|\d{1,3})?(?:\.(\*|\d{0,3}))?(hh|h|ll|l|z|j|t|q|I64)?([diouxXcsfFeEgGaAp%])")
_SIZES = {"hh": "b", "h": "h", "": "i", "l": "l", "ll": "q", "z": "N", "j": "q", "t": "n", "q": "q", "I64": "q"}

# Where the arguments after the five named ones are. A callback that declares more parameters than it was given reads
# the registers and stack slots in which a variadic caller left its own. On x86-64 and ARM outside of Windows and
# Apple's systems integers and reals are counted apart; on the others each argument fills the next slot of the stack.
_APART = not (sys.platform in {"win32", "cygwin"} or (sys.platform == "darwin" and platform.machine() == "arm64"))
_UNUSED = 3 if sys.platform == "darwin" and not _APART else 0  # registers that Apple's variadic calls leave empty


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

    fmpy's own way to formatted messages, addLoggerProxy, has one listener for the whole process and hands the format
    to C as it is: an FMU whose text merely contains a percent sign can crash there.
    """

    def hear(environment: Any, name: bytes, status: int, category: bytes, text: bytes | None, *rest: Any) -> None:
        listen(messages, status, formatted(text or b"", rest))

    pointer, string = ctypes.c_void_p, ctypes.c_char_p
    extra = [ctypes.c_int64] * (_UNUSED + INTEGERS) + [ctypes.c_double] * (REALS if _APART else 0)
    listener = ctypes.CFUNCTYPE(None, pointer, string, ctypes.c_int, string, string, *extra)(hear)
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = ctypes.cast(listener, fmi2.fmi2CallbackLoggerTYPE)
    callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
    callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
    return callbacks, listener


def formatted(text: bytes, rest: tuple[Any, ...]) -> bytes:
    """Return a printf format with its arguments filled in; from what cannot be filled in on, the format itself.

    Parameters
    ----------
    text : bytes
        The format.
    rest : tuple of int and float
        What lay where its arguments may be, as `callbacks2` declares it.
    """
    if b"%" not in text:
        return text
    integers = iter(rest[_UNUSED : _UNUSED + INTEGERS])
    reals = iter(rest[_UNUSED + INTEGERS :]) if _APART else (_as_real(slot) for slot in integers)
    pieces, position = [], 0
    source = text.decode("utf-8", "replace")
    while (at := source.find("%", position)) >= 0:
        match = _CONVERSION.match(source, at)
        filled = _filled(match, integers, reals) if match else None
        if match is None or filled is None:  # where the next argument lies is not known any more
            break
        pieces += [source[position:at], filled]
        position = match.end()
    return "".join([*pieces, source[position:]]).encode()


def _filled(match: re.Match[str], integers: Iterator[int], reals: Iterator[float]) -> str | None:
    flags, width, precision, size, kind = match.groups()
    if kind == "%":
        return "%"
    try:
        if width == "*":
            width = str(_length(next(integers)))
        if precision == "*":
            precision = str(_length(next(integers)))
        value: Any
        if kind == "s":
            value = _text_at(next(integers))
        elif kind == "p":
            value, kind = f"{next(integers) & 0xFFFFFFFFFFFFFFFF:#x}", "s"
        elif kind in "aA":
            value, kind = next(reals).hex(), "s"
        elif kind in "fFeEgG":
            value = next(reals)
        elif kind == "c":
            value = chr(next(integers) & 0xFF)
        else:
            code = _SIZES[size or ""]
            value = _sized(next(integers), code if kind in "di" else code.upper())
        return f"%{flags}{width or ''}{'' if precision is None else '.' + precision}{kind}" % value
    except (StopIteration, ValueError, OverflowError):
        return None


def _length(slot: int) -> int:
    length = _sized(slot, "i")
    if abs(length) > LONGEST:
        raise ValueError(f"a field of {length} characters")
    return length


def _sized(slot: int, code: str) -> int:
    size = struct.calcsize(code)
    (value,) = struct.unpack(code, struct.pack("q", slot)[:size] if sys.byteorder == "little" else _high(slot, size))
    return int(value)


def _high(slot: int, size: int) -> bytes:
    return struct.pack("q", slot)[-size:]


def _as_real(slot: int) -> float:
    return float(struct.unpack("d", struct.pack("q", slot))[0])


def _text_at(address: int) -> str:
    address &= 0xFFFFFFFFFFFFFFFF
    if address < NULL_PAGE:
        return "(null)"
    return ctypes.string_at(address)[:LONGEST].decode("utf-8", "replace")
