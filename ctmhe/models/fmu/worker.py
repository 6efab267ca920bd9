"""The evaluator's library through ctypes, and a process of its own for an FMU.

Run as a script, without the rest of the package, so that a process starts in a moment: it reads a request (a length
of 8 bytes, then JSON) from its standard input, opens the FMU, says how that went in the same form, and then answers
questions until its input ends.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from contextlib import suppress
from typing import Any

VERSION = 2  # of fmu.h
CALLS = ("set time", "set states", "set values", "get derivatives", "get values", "directional", "step", "other")

_text, _int, _double, _pointer = ctypes.c_char_p, ctypes.c_int, ctypes.c_double, ctypes.c_void_p
_references, _doubles, _ints, _flags = (
    ctypes.POINTER(kind) for kind in (ctypes.c_uint32, _double, _int, ctypes.c_uint8)
)


class Configuration(ctypes.Structure):
    """`ctmhe_fmu_configuration` of fmu.h."""

    _fields_ = [
        *((name, _text) for name in ("library", "name", "token", "resources")),
        ("complaints", ctypes.POINTER(_text)),
        ("complaint_count", _int),
        *((name, _int) for name in ("version", "co_simulation", "nx", "nu", "nw", "np", "ny", "inputs", "starts")),
        *((name, _references) for name in ("x", "dx", "input", "p", "y", "start")),
        *((name, _doubles) for name in ("start_value", "input_base")),
        *((name, _ints) for name in ("input_u", "input_w", "w_state", "w_output", "y_state")),
        *((name, _doubles) for name in ("x_size", "input_size", "p_size")),
        *((name, _double) for name in ("start_time", "step")),
        *((name, _int) for name in ("p_in_event_mode", "inputs_in_event_mode", "directional")),
        ("reach", _double),
        *((name, _flags) for name in ("differenced", "rows_differenced")),
    ]  # fmt: skip


def configuration(values: dict[str, Any]) -> Configuration:
    """Return the structure of what `values` says; it keeps its arrays alive."""
    made = Configuration()
    kept: list[Any] = []
    fields: Any = Configuration._fields_
    for name, kind in fields:
        value = values[name]
        if kind is _text:
            value = os.fsencode(value)
        elif kind is ctypes.POINTER(_text):
            value = (_text * max(len(value), 1))(*map(os.fsencode, value))
            kept.append(value)
            value = ctypes.cast(value, kind)
        elif kind not in (_int, _double):
            value = (kind._type_ * max(len(value), 1))(*value)
            kept.append(value)
            value = ctypes.cast(value, kind)
        setattr(made, name, value)
    made.kept = kept  # pyright: ignore
    return made


def load(path: str) -> ctypes.CDLL:
    """Load the evaluator's library and declare its functions."""
    library = ctypes.CDLL(path)
    declared = {
        "open": ([ctypes.POINTER(Configuration), _text, ctypes.c_size_t], _pointer),
        "close": ([_pointer], None),
        "evaluate": ([_pointer, _double, *[_pointer] * 7], _int),
        "get": ([_pointer, _references, ctypes.c_size_t, _doubles], _int),
        "next_event": ([_pointer], _double),
        "counts": ([_pointer] * 4, None),
        "begin": ([_pointer], None),
        "failures": ([_pointer], ctypes.c_int64),
        "message": ([_pointer], _text),
        "repeat": ([_pointer, _pointer, _pointer], _int),
        "serve": ([_pointer, _int, _int], _int),
        "remote": ([*[_int] * 7, _double, _pointer], _pointer),
        "version": ([], _int),
    }
    for name, (arguments, result) in declared.items():
        function = getattr(library, f"ctmhe_fmu_{name}")
        function.argtypes, function.restype = arguments, result
    if library.ctmhe_fmu_version() != VERSION:
        raise OSError(f"{path} is version {library.ctmhe_fmu_version()} of the evaluator, not {VERSION}")
    return library


def opened(library: ctypes.CDLL, made: Configuration) -> int:
    """Open an FMU and return the evaluator; `OSError` with the reason when that fails."""
    message = ctypes.create_string_buffer(1024)
    model = library.ctmhe_fmu_open(ctypes.byref(made), message, len(message))
    if not model:
        raise OSError(message.value.decode("utf-8", "replace") or "it cannot be opened")
    return model


def start_values(library: ctypes.CDLL, model: int, references: list[int]) -> tuple[list[float], float]:
    """Return the values of variables after initialization, and the time of the first time event."""
    count = len(references)
    values = (_double * max(count, 1))()
    if count and library.ctmhe_fmu_get(model, (ctypes.c_uint32 * count)(*references), count, values):
        raise OSError(library.ctmhe_fmu_message(model).decode("utf-8", "replace"))
    return values[:count], library.ctmhe_fmu_next_event(model)


def send(file: int, message: dict[str, Any]) -> None:
    """Write a message: its length, then JSON."""
    content = json.dumps(message).encode()
    content = len(content).to_bytes(8, "little") + content
    while content:
        content = content[os.write(file, content) :]


def receive(file: int) -> dict[str, Any]:
    """Read a message; `EOFError` when the other end is gone."""
    return json.loads(_read(file, int.from_bytes(_read(file, 8), "little")))


def _read(file: int, size: int) -> bytes:
    content = b""
    while len(content) < size:
        more = os.read(file, size - len(content))
        if not more:
            raise EOFError
        content += more
    return content


def main() -> None:
    """Serve one FMU."""
    out = os.dup(1)
    os.dup2(2, 1)  # whatever the FMU prints is no answer
    with suppress(OSError, AttributeError):  # Linux: no process is left when its parent dies
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    request = receive(0)
    sys.path[:] = request["path"]  # FMUs written in Python import what the session that asks could
    try:
        library = load(request["evaluator"])
        made = configuration(request["configuration"])  # which the evaluator points to
        model = opened(library, made)
        values, event = start_values(library, model, request["references"])
    except OSError as error:
        send(out, {"failed": str(error)})
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # whoever reads them stops here
        os.dup2(nowhere, stream)
    os.close(nowhere)
    send(out, {"values": values, "next_event": event})
    library.ctmhe_fmu_serve(model, 0, out)
    library.ctmhe_fmu_close(model)


if __name__ == "__main__":
    sys.exit(main())
