"""CasADi functions of scalar expressions as tapes of instructions for the core, which runs several slots at once."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

logger = logging.getLogger(__name__)

BATCH = 8  # slots at once: CTMHE_BATCH of core.h
LARGE = 50_000  # instructions from which reading them one by one takes too long

CORE = Path(__file__).parent / "core"
INPUT, OUTPUT, CONSTANT = range(3)
_LISTED = re.findall(r"^OPERATION\((\w+), (\w+), (.*)\)$", (CORE / "operations.h").read_text(), re.MULTILINE)
OPERATIONS = ("INPUT", "OUTPUT", "CONST", *(name for name, _, _ in _LISTED))  # as numbered in tape.h
CODES = {getattr(ca, f"OP_{name}"): code for code, name in enumerate(OPERATIONS) if hasattr(ca, f"OP_{name}")}
CODES[ca.OP_CONSTPOW] = OPERATIONS.index("POW")
CODES[ca.OP_LIFT] = OPERATIONS.index("ASSIGN")


@dataclass(frozen=True, eq=False)
class Tape:
    """A function as data.

    Attributes
    ----------
    instructions : int32 array (m, 4)
        Operation, target, left, right: registers; for inputs and outputs the number of the argument or result and the
        element in it, for constants its number. Results that are zero whatever the arguments are left out.
    constants : array
    registers : int
    arguments, results : tuple of int
        Numbers of elements.
    """

    instructions: np.ndarray
    constants: np.ndarray
    registers: int
    arguments: tuple[int, ...]
    results: tuple[int, ...]

    @property
    def written(self) -> list[list[int]]:
        """The elements of each result that are written, in the order of the instructions."""
        outputs = self.instructions[self.instructions[:, 0] == OUTPUT]
        return [outputs[outputs[:, 1] == j, 3].tolist() for j in range(len(self.results))]

    @property
    def sparse(self) -> list[int]:
        """The sizes of results that are not written as a whole, 0 for the others."""
        return [size if len(at) < size else 0 for size, at in zip(self.results, self.written, strict=True)]


def tape_of(function: ca.Function) -> Tape | None:
    """Return the tape of a function with dense arguments, None where it is more than known scalar instructions."""
    if not function.is_a("SXFunction") or function.n_instructions() > LARGE:
        return None
    rows, constants, zero = [], [], set[int]()
    for k in range(function.n_instructions()):
        code = CODES.get(function.instruction_id(k))
        if code is None:
            logger.info("operation %d of %s is left to CasADi", function.instruction_id(k), function.name())
            return None
        target, *element = function.instruction_output(k)
        if code == CONSTANT:
            rows.append((code, target, len(constants), 0))
            constants.append(function.instruction_constant(k))
            (zero.add if constants[-1] == 0 else zero.discard)(target)
            continue
        left, *right = function.instruction_input(k)
        if code != OUTPUT:
            rows.append((code, target, left, right[0] if right else left))
            zero.discard(target)
        elif left not in zero:
            rows.append((code, target, left, element[0]))
    return Tape(
        np.array(rows, np.int32).reshape(-1, 4),
        np.array(constants or [0.0]),
        max(function.sz_w(), 1),
        tuple(function.nnz_in(i) for i in range(function.n_in())),
        tuple(function.nnz_out(i) for i in range(function.n_out())),
    )


def written_in_c(tape: Tape, name: str) -> str:
    """Return the C of a tape: a function of type `ctmhe_batch`, whose registers are variables."""
    first = np.concatenate([[0], np.cumsum(tape.arguments)])
    at = [(j, element) for j, elements in enumerate(tape.written) for element in elements]
    place = {where: i for i, where in enumerate(at)}
    lines = [
        f"static const int taken[] = {{{_listed(tape.arguments)}}}, sizes[] = {{{_listed(tape.results)}}};",
        f"static const int counts[] = {{{_listed(map(len, tape.written))}}}, at[] = {{{_listed(e for _, e in at)}}};",
        f"lanes_of_doubles in[{first[-1] + 1}], out[{len(at) + 1}];",
        f"lanes_of_doubles {', '.join(f'r{i} = {{0}}' for i in range(tape.registers))};",
        f"take_arguments(in, calls, lanes, {len(tape.arguments)}, taken);",
    ]
    for code, target, left, right in tape.instructions.tolist():
        if code == INPUT:
            lines.append(f"r{target} = in[{first[left] + right}];")
        elif code == OUTPUT:
            lines.append(f"out[{place[target, right]}] = r{left};")
        elif code == CONSTANT:
            lines.append(f"FILL(r{target}, {_literal(float(tape.constants[left]))});")
        else:
            _, how, expression = _LISTED[code - 3]
            lines.append(f"{how}(r{target}, r{left}, r{right}, {expression});")
    lines += [f"give_results(out, calls, lanes, {len(tape.results)}, sizes, counts, at);", "return 0;"]
    return "\n  ".join([f"int {name}(const ctmhe_call *calls, int lanes) {{", *lines]) + "\n}\n"


def _listed(values: Iterable[int]) -> str:
    return ", ".join(map(str, values)) or "0"


def _literal(value: float) -> str:
    if np.isfinite(value):
        return float(value).hex()
    return "NAN" if np.isnan(value) else "HUGE_VAL" if value > 0 else "-HUGE_VAL"
