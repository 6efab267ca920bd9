"""What FMUs change in the process around them, and must not: the working directory, how floating point works."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

SIZE = 512  # bytes; fenv_t takes 8 to 32


@contextmanager
def kept() -> Iterator[None]:
    """Bring the working directory, the rounding mode and the traps of this thread back in the end."""
    functions = None if os.name == "nt" else ctypes.CDLL(None)
    read, write = getattr(functions, "fegetenv", None), getattr(functions, "fesetenv", None)
    mode = ctypes.create_string_buffer(SIZE)
    if read is not None:
        read(mode)
    here = os.getcwd()
    try:
        yield
    finally:
        if write is not None:
            write(mode)
        os.chdir(here)
