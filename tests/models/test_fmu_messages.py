"""What FMI 2 FMUs say, with printf arguments, comes out as C would print it."""

import ctypes
from collections import deque

import pytest

pytest.importorskip("fmpy")

from fmpy import fmi2

from ctmhe.models.fmu.messages import callbacks2

INT, LONG, REAL, TEXT = ctypes.c_int, ctypes.c_int64, ctypes.c_double, ctypes.c_char_p


def said(text, *arguments, status=3):
    """What is kept when an FMU calls its logger; `arguments` are (type, value)."""
    messages: deque[str] = deque()
    callbacks, ear = callbacks2(fmi2, messages)
    named = [ctypes.c_void_p, TEXT, INT, TEXT, TEXT]
    logger = ctypes.cast(callbacks.logger, ctypes.CFUNCTYPE(None, *named, *(kind for kind, _ in arguments)))
    logger(ctypes.addressof(ear), b"fmu", status, b"logStatusError", text, *(value for _, value in arguments))
    return list(messages)


@pytest.mark.parametrize(
    ("text", "arguments", "expected"),
    [
        (b"%s", [(TEXT, b"the tank is empty")], "the tank is empty"),
        (b"%s = %g at %.3f s", [(TEXT, b"x"), (REAL, 0.25), (REAL, 1.5)], "x = 0.25 at 1.500 s"),
        (b"%d of %u, %5.1e, %x", [(INT, -3), (INT, 7), (REAL, 1e-9), (INT, 255)], "-3 of 7, 1.0e-09, ff"),
        (b"%lld %zu %c %%", [(LONG, -(2**40)), (LONG, 2**40), (INT, 65)], f"{-(2**40)} {2**40} A %"),
        (
            b"%-4s|%4d|%*d|%.*f",
            [(TEXT, b"ab"), (INT, 1), (INT, 3), (INT, 2), (INT, 1), (REAL, 0.25)],
            "ab  |   1|  2|0.2",
        ),
        (b"%s %s", [(TEXT, "ü".encode()), (TEXT, None)], "ü (null)"),
        (b"%d %d %d %d %d %g", [(INT, k) for k in range(5)] + [(REAL, 5.5)], "0 1 2 3 4 5.5"),
    ],
)
def test_arguments_are_filled_in(text, arguments, expected):
    """Texts, integers of several sizes, reals, stars, and more of them than registers."""
    assert said(text, *arguments) == [expected]


@pytest.mark.parametrize("text", [b"100%", b"50 %y", b"%n", b"\xff\xfe", b"%5000000000s", b"%Lf and %s", b"100% sure"])
def test_a_text_that_is_no_format_comes_out_as_it_is(text):
    """Nothing is read or written for what is no conversion that we know."""
    assert said(text) == [text.decode("utf-8", "replace")]


def test_information_is_not_kept_and_nothing_is_nothing():
    """Only warnings and worse are quoted in errors; a null message is none."""
    assert said(b"step done", status=0) == [] and said(None) == []
