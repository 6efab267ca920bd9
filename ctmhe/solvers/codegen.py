"""Compiles the core into shared libraries, once each: alone, or with a model's stage function and its sizes."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

import casadi as ca

from ctmhe.compilers import NATIVE, Source, build_library, find_compiler, shipped_library, sources_digest
from ctmhe.errors import SolverError
from ctmhe.solvers.tape import Tape, tape_of, written_in_c
from ctmhe.transcription.stage import StageFunction

logger = logging.getLogger(__name__)

CORE = Path(__file__).parent / "core"
GENERATOR = Path(__file__).parent / "tape.py"
LARGE = 6_000  # instructions from which compiling a function takes longer than it is worth: its tape is run

# Of the core. For few states, vectorised loops only cost; for many, the kernels bring their own vectors, and -O3 takes
# twice as long to compile and makes nothing faster.
ANY_SIZE = ("-O2",)
SMALL = ("-O3", "-fno-tree-vectorize")
WIDE = ("-O2",)
WIDE_FROM = 8  # states

# CasADi functions that become plain C without memory of their own; others call libraries or Python
GENERATED = frozenset({
    "SXFunction",
    "MXFunction",
    "Map",
    "MapSum",
    "Switch",
    "BSplineInterpolant",
    "LinearInterpolant",
    "LinearInterpolantJac",
})  # fmt: skip


def shipped_core() -> Path | None:
    """Return the library of the core for any sizes, or None when there is none and nothing to compile it with."""
    return shipped_library(CORE, "core", ANY_SIZE)


def specialised_core(stage: StageFunction, p_estimated: bool) -> Path | None:
    """Return a library of the core and the stage function, with the sizes as constants, compiled at most once.

    It is for windows in which the parameters are estimated, or for those in which they are held.

    It exports what the core exports, `ctmhe_batch_value` and `ctmhe_batch_jacobian`, which take several slots at once,
    and `ctmhe_stage_curvature` in CasADi's calling convention with its `_work`; `ctmhe_stage_value` and
    `ctmhe_stage_jacobian` take their place for models of other expressions. The result is cached under what
    determines it: the functions, the sizes, the core's sources, the compiler, its flags and CasADi's version; code is
    generated only when it is not found.

    Returns
    -------
    Path or None
        None, with a logged reason, when there is no compiler, compiling fails, or the stage function is more than
        plain C: CVODES, callbacks. For a model that evaluates itself (an FMU) it is the core alone, with its sizes.
    """
    functions = {} if stage.method is not None else {"value": stage.value, "jacobian": stage.derivative}
    if stage.symbolic:
        functions["curvature"] = stage.mapped[2][1]
    taped = stage.symbolic and stage.derivative.n_instructions() > LARGE
    for function in functions.values():
        reason = _not_generated(function)
        if reason is not None:
            logger.info("the stage function is not compiled, %s: it runs in CasADi's virtual machine", reason)
            return None
    compiler = find_compiler()
    if compiler is None or not (CORE / "core.c").is_file():
        return None
    flags = SMALL if stage.nx < WIDE_FROM else WIDE
    native = NATIVE if "zig" not in compiler.identity else ()  # which zig takes without being told
    sizes = {"NX": stage.nx, "NW": stage.nw, "NP": stage.np, "NU": stage.nu, "NY": stage.ny, "NQ": stage.q}
    sizes["P"] = int(p_estimated)
    if taped:
        sizes["TAPE"] = 1
    digest = sha256(f"{sources_digest(CORE)}{ca.CasadiMeta.version()}\n{flags, native, LARGE}\n".encode())
    digest.update(GENERATOR.read_bytes())
    for name, function in functions.items():
        digest.update(f"{name}\n{function.serialize()}\n".encode())

    def sources() -> list[Source]:
        if taped:
            return [Source("core.c", (CORE / "core.c").read_text(), flags)]
        taken = {key: tape_of(function) for key, function in functions.items() if key != "curvature"}
        tapes = {key: tape for key, tape in taken.items() if tape is not None}
        rest = {key: function for key, function in functions.items() if key not in tapes}
        return [*_batches(tapes), *_generate(rest), Source("core.c", (CORE / "core.c").read_text(), flags)]

    defines = {f"CTMHE_{name}": size for name, size in sizes.items()}
    return _compiled("stage", sources, digest.hexdigest(), defines, native)


def _compiled(
    name: str, sources: Any, identity: str, defines: dict[str, int] | None = None, flags: tuple[str, ...] = ()
) -> Path | None:
    """Build a library, or return None; the reason is logged once, where it arises."""
    if find_compiler() is None:
        return None
    try:
        return build_library(name, sources, identity=identity, flags=flags, defines=defines or {}, include=[CORE])
    except SolverError:
        return None


# ---- generated code ------------------------------------------------------------------------------------------------


def _not_generated(function: ca.Function) -> str | None:
    """Return why a function does not become plain C, or None."""
    for part in (function, *function.find_functions()):
        if part.class_name() not in GENERATED:
            return f"it contains the {part.class_name()} '{part.name()}'"
    return None


def _generate(functions: dict[str, ca.Function]) -> list[Source]:
    """Return the C of the functions, named ctmhe_stage_<key>.

    Curvature is a unit of its own: compiling it with -O3 takes twice as long as with -O1 and makes it no faster.
    """
    curvature = [key for key in functions if key == "curvature"]
    rest = [key for key in functions if key != "curvature"]
    sources = []
    for name, keys in (("curvature.c", curvature), ("stage.c", rest)):
        if keys:
            large = max(functions[key].n_instructions() for key in keys) > LARGE
            flags = ("-O1",) if large or keys == curvature else ()
            sources.append(Source(name, _code(name, (_renamed(functions[key], key) for key in keys)), flags))
    return sources


def _batches(tapes: dict[str, Tape]) -> list[Source]:
    """Return the C of functions that take several slots at once, named ctmhe_batch_<key>."""
    if not tapes:
        return []
    text = "".join(written_in_c(tape, f"ctmhe_batch_{key}") for key, tape in tapes.items())
    return [Source("batch.c", f'#include "tape.h"\n{text}', ("-O2",))]


def _code(name: str, functions: Iterable[ca.Function]) -> str:
    generator = ca.CodeGenerator(name)
    for function in functions:
        generator.add(function)
    return generator.dump()


def _renamed(function: ca.Function, key: str) -> ca.Function:
    symbols: Any = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    return ca.Function(f"ctmhe_stage_{key}", symbols, function.call(symbols, True, False))
